//! Sigmoid scaled to (0, pi), which converts the latent to angles.

use std::f32::consts::PI;

use candle_core::{Result, Shape, Tensor};

use super::operation::{Argument, Gradients, Operation, apply};

const NAME: &str = "scaled_sigmoid";

/// `pi * sigmoid(u)` of each value: radians in (0, pi).
///
/// `penalty` times the mean of `u^2` is part of the loss, and keeps `u` off the flat ends of the sigmoid. The backward pass adds its
/// gradient; the output does not depend on it.
///
/// # Errors
/// The tensor is not f32 on the CPU.
pub fn scaled_sigmoid(input: &Tensor, penalty: f32) -> Result<Tensor> {
    apply(NAME, &[input], ScaledSigmoid { penalty })
}

struct ScaledSigmoid {
    penalty: f32,
}

/// `pi * sigmoid(u)`, by a hyperbolic tangent, which does not overflow.
pub(crate) fn scaled_sigmoid_of(u: f32) -> f32 {
    0.5 * PI * (1.0 + (0.5 * u).tanh())
}

impl Operation for ScaledSigmoid {
    fn forward(&self, inputs: &[Argument<'_>]) -> Result<(Vec<f32>, Shape)> {
        let [input] = inputs else { candle_core::bail!("{NAME}: expected one input") };
        Ok((input.values.iter().map(|&u| scaled_sigmoid_of(u)).collect(), Shape::from(input.dims)))
    }

    fn backward(&self, inputs: &[Argument<'_>], output: &[f32], mut gradient: Vec<f32>) -> Result<Gradients> {
        let [input] = inputs else { candle_core::bail!("{NAME}: expected one input") };
        let penalty_slope = 2.0 * self.penalty / input.values.len().max(1) as f32;
        for ((g, &u), &y) in gradient.iter_mut().zip(input.values).zip(output) {
            // The derivative is pi s (1 - s) with s = y / pi.
            *g = *g * y * (1.0 - y / PI) + penalty_slope * u;
        }
        Ok(vec![Some(gradient)])
    }
}
