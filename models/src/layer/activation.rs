//! Activations, alone or after a sum of two maps.

use candle_core::{Result, Shape, Tensor, bail};
use rayon::prelude::*;

use super::operation::{Argument, Gradients, Operation, apply};
use crate::kernel::KernelLevel;
use crate::kernel::buffer::uninitialised;
use crate::kernel::level::{for_each_level, multiply_add};

const ADD_RELU: &str = "add_relu";
/// Number of values that one task processes.
pub(super) const CHUNK: usize = 1 << 14;

/// Defines the activations, and the list of all for tests.
macro_rules! activations {
    ($($(#[$doc:meta])* $name:ident,)*) => {
        /// A function of each value.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
        pub enum Activation {
            $($(#[$doc])* $name,)*
        }

        #[cfg(test)]
        impl Activation {
            /// All activations.
            pub(crate) const ALL: &'static [Activation] = &[$(Activation::$name,)*];
        }
    };
}

activations! {
    /// The value itself.
    None,
    /// `max(x, 0)`; a NaN stays.
    Relu,
    /// `x / (1 + exp(-x))`, also called swish.
    Silu,
    /// `1 / (1 + exp(-x))`.
    Sigmoid,
}

impl Activation {
    /// Activation of one value by the exponential of the standard library, for inference where no convolution or dense layer comes
    /// before it. Its rounding differs from that of [`activate`], which runs in vectors.
    #[inline]
    pub(crate) fn apply(self, x: f32) -> f32 {
        match self {
            Activation::Relu if x < 0.0 => 0.0,
            Activation::None | Activation::Relu => x,
            Activation::Silu => x / (1.0 + (-x).exp()),
            Activation::Sigmoid => 1.0 / (1.0 + (-x).exp()),
        }
    }
}

/// Compiles `$body` once for each activation, which is the constant `$constant` in it, and runs the one for `$activation`.
macro_rules! by_activation {
    ($activation:expr, $constant:ident => $body:expr) => {
        by_activation!($activation, $constant => $body; None Relu Silu Sigmoid)
    };
    ($activation:expr, $constant:ident => $body:expr; $($name:ident)*) => {
        match $activation {
            $(Activation::$name => {
                const $constant: Activation = Activation::$name;
                $body
            })*
        }
    };
}
pub(super) use by_activation;

/// `exp(x)` to about two units in the last place, from e^-87 to e^88, in operations that run in vectors. A NaN stays.
#[inline(always)]
fn exponential<const FUSED: bool>(x: f32) -> f32 {
    let x = x.clamp(-87.0, 88.0);
    // Adding 1.5 * 2^23 rounds to a whole number and leaves it in the low bits.
    const ROUND: f32 = 12_582_912.0;
    let rounded = multiply_add::<FUSED>(x, std::f32::consts::LOG2_E, ROUND);
    let whole = rounded - ROUND;
    // ln 2 in two parts, the first of which is exact in products with small whole numbers (Cody and Waite, 1980).
    let rest = multiply_add::<FUSED>(whole, -0.693_359_4, x);
    let rest = multiply_add::<FUSED>(whole, 2.121_944_4e-4, rest);
    let mut sum = 1.0 / 5040.0;
    for coefficient in [1.0 / 720.0, 1.0 / 120.0, 1.0 / 24.0, 1.0 / 6.0, 0.5, 1.0, 1.0] {
        sum = multiply_add::<FUSED>(sum, rest, coefficient);
    }
    let power = f32::from_bits((rounded.to_bits() << 23).wrapping_add(127 << 23));
    sum * power
}

#[inline(always)]
fn sigmoid<const FUSED: bool>(x: f32) -> f32 {
    1.0 / (1.0 + exponential::<FUSED>(-x))
}

/// The activation of `x`. In loops, `activation` is a constant ([`by_activation`]).
#[inline(always)]
pub(super) fn activate<const FUSED: bool>(activation: Activation, x: f32) -> f32 {
    match activation {
        Activation::Relu if x < 0.0 => 0.0,
        Activation::None | Activation::Relu => x,
        Activation::Silu => x * sigmoid::<FUSED>(x),
        Activation::Sigmoid => sigmoid::<FUSED>(x),
    }
}

/// `gradient` times the derivative of the activation at `x`. The derivative of ReLU is zero at zero, as in PyTorch. In
/// loops, `activation` is a constant ([`by_activation`]).
#[inline(always)]
pub(super) fn activation_gradient<const FUSED: bool>(activation: Activation, x: f32, gradient: f32) -> f32 {
    match activation {
        Activation::Relu if x <= 0.0 => 0.0,
        Activation::None | Activation::Relu => gradient,
        Activation::Silu => {
            let s = sigmoid::<FUSED>(x);
            gradient * s * multiply_add::<FUSED>(x, 1.0 - s, 1.0)
        }
        Activation::Sigmoid => {
            let s = sigmoid::<FUSED>(x);
            gradient * s * (1.0 - s)
        }
    }
}

for_each_level! {
    fn forward(activation: Activation, input: &[f32], output: &mut [f32]) {
        by_activation!(activation, A => output.iter_mut().zip(input).for_each(|(y, &x)| *y = activate::<FUSED>(A, x)))
    }
}

for_each_level! {
    fn backward(activation: Activation, input: &[f32], gradient: &mut [f32]) {
        by_activation!(
            activation, A => gradient.iter_mut().zip(input).for_each(|(g, &x)| *g = activation_gradient::<FUSED>(A, x, *g))
        )
    }
}

for_each_level! {
    /// Replaces values by their activation.
    pub(super) fn activate_in_place(activation: Activation, values: &mut [f32]) {
        by_activation!(activation, A => values.iter_mut().for_each(|v| *v = activate::<FUSED>(A, *v)))
    }
}

for_each_level! {
    /// Adds `others` to values and replaces the sums by their activation.
    pub(super) fn add_and_activate(activation: Activation, values: &mut [f32], others: &[f32]) {
        by_activation!(
            activation, A => values.iter_mut().zip(others).for_each(|(v, &o)| *v = activate::<FUSED>(A, *v + o))
        )
    }
}

/// Applies an activation to every value of a tensor of any shape.
///
/// # Errors
/// The tensor is not f32 on the CPU.
pub fn activation(input: &Tensor, activation: Activation, level: KernelLevel) -> Result<Tensor> {
    apply("activation", &[input], Activate { activation, level: level.available() })
}

struct Activate {
    activation: Activation,
    level: KernelLevel,
}

impl Operation for Activate {
    fn forward(&self, inputs: &[Argument<'_>]) -> Result<(Vec<f32>, Shape)> {
        let [input] = inputs else { bail!("activation: expected one input") };
        let mut output = uninitialised(input.values.len());
        output
            .par_chunks_mut(CHUNK)
            .zip(input.values.par_chunks(CHUNK))
            .for_each(|(output, input)| forward(self.level, self.activation, input, output));
        Ok((output, Shape::from(input.dims)))
    }

    fn backward(&self, inputs: &[Argument<'_>], _output: &[f32], mut gradient: Vec<f32>) -> Result<Gradients> {
        let [input] = inputs else { bail!("activation: expected one input") };
        gradient
            .par_chunks_mut(CHUNK)
            .zip(input.values.par_chunks(CHUNK))
            .for_each(|(gradient, input)| backward(self.level, self.activation, input, gradient));
        Ok(vec![Some(gradient)])
    }
}

for_each_level! {
    fn sum_relu(a: &[f32], b: &[f32], output: &mut [f32]) {
        for ((y, &a), &b) in output.iter_mut().zip(a).zip(b) {
            *y = activate::<FUSED>(Activation::Relu, a + b);
        }
    }
}

/// Applies a function to the corresponding chunks of two arrays of one shape. Its arguments are both chunks and the output.
pub(super) fn map_pairs(
    name: &str,
    inputs: &[Argument<'_>],
    function: impl Fn(&[f32], &[f32], &mut [f32]) + Sync,
) -> Result<(Vec<f32>, Shape)> {
    let [a, b] = inputs else { bail!("{name}: expected two inputs") };
    if a.dims != b.dims {
        bail!("{name}: expected equal shapes, got {:?} and {:?}", a.dims, b.dims);
    }
    let mut output = uninitialised(a.values.len());
    let parts = output.par_chunks_mut(CHUNK).zip(a.values.par_chunks(CHUNK)).zip(b.values.par_chunks(CHUNK));
    parts.for_each(|((output, a), b)| function(a, b, output));
    Ok((output, Shape::from(a.dims)))
}

/// `max(a + b, 0)`: the end of a residual block.
///
/// # Errors
/// The shapes differ, or a tensor is not f32 on the CPU.
pub fn add_relu(a: &Tensor, b: &Tensor, level: KernelLevel) -> Result<Tensor> {
    apply(ADD_RELU, &[a, b], AddRelu { level: level.available() })
}

struct AddRelu {
    level: KernelLevel,
}

impl Operation for AddRelu {
    fn forward(&self, inputs: &[Argument<'_>]) -> Result<(Vec<f32>, Shape)> {
        map_pairs(ADD_RELU, inputs, |a, b, output| sum_relu(self.level, a, b, output))
    }

    fn backward(&self, _inputs: &[Argument<'_>], output: &[f32], mut gradient: Vec<f32>) -> Result<Gradients> {
        // ReLU's output is positive where its input is.
        gradient
            .par_chunks_mut(CHUNK)
            .zip(output.par_chunks(CHUNK))
            .for_each(|(gradient, output)| backward(self.level, Activation::Relu, output, gradient));
        Ok(vec![Some(gradient.clone()), Some(gradient)])
    }
}
