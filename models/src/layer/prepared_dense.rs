//! Dense layer prepared for inference, summed in f64.
//!
//! The circuit amplifies an error of 1e-6 in the latent to 1e-5 in a probability, and f32 sums over a thousand features
//! have such errors.

use candle_core::{Result, bail};

use super::activation::{Activation, activate_in_place};
use super::feature::Feature;
use crate::kernel::KernelLevel;
use crate::kernel::level::for_each_level;

/// Number of outputs that are summed at once, in registers.
const LANES: usize = 32;

/// `activation(input weight^T + bias)`, each output rounded once.
pub struct PreparedDense {
    inputs: usize,
    outputs: usize,
    /// `[output / 32][input][output % 32]`, padded with zeros.
    weight: Vec<f32>,
    /// `[output / 32][output % 32]`.
    bias: Vec<f32>,
    activation: Activation,
    level: KernelLevel,
}

impl PreparedDense {
    /// Prepares weights `[o][i]`, `shape` `[o, i]`.
    ///
    /// # Errors
    /// A number of values differs from what `shape` asks for, or there are no weights.
    pub fn new(
        weight: &[f32],
        shape: [usize; 2],
        bias: &[f32],
        activation: Activation,
        level: KernelLevel,
    ) -> Result<Self> {
        let [outputs, inputs] = shape;
        if weight.is_empty() || weight.len() != outputs * inputs || bias.len() != outputs {
            bail!(
                "prepared dense layer: expected weight [o, i] and o values of bias; got {} values for {shape:?} and {}",
                weight.len(),
                bias.len()
            );
        }
        let groups = outputs.div_ceil(LANES);
        let mut packed = vec![0.0; groups * inputs * LANES];
        for (o, row) in weight.chunks_exact(inputs).enumerate() {
            for (i, &w) in row.iter().enumerate() {
                packed[(o / LANES * inputs + i) * LANES + o % LANES] = w;
            }
        }
        let mut padded = bias.to_vec();
        padded.resize(groups * LANES, 0.0);
        Ok(PreparedDense { inputs, outputs, weight: packed, bias: padded, activation, level: level.available() })
    }

    /// Runs the layer on `input` `[batch][i]`, where `i` is the product of rows, columns and channels; `output` becomes
    /// `[batch][1][1][o]`.
    ///
    /// # Errors
    /// The input has another number of features.
    pub fn run(&self, input: &Feature, output: &mut Feature) -> Result<()> {
        let [batch, rows, columns, channels] = input.dims();
        if rows * columns * channels != self.inputs {
            bail!("prepared dense layer: expected input [batch, {}], got {:?}", self.inputs, input.dims());
        }
        output.reshape([batch, 1, 1, self.outputs]);
        let rows = output.values_mut().chunks_exact_mut(self.outputs).zip(input.values().chunks_exact(self.inputs));
        for (output, input) in rows {
            row(self.level, input, &self.weight, &self.bias, output);
            activate_in_place(self.level, self.activation, output);
        }
        Ok(())
    }
}

for_each_level! {
    /// Computes one row of outputs, before the activation.
    fn row(input: &[f32], weight: &[f32], bias: &[f32], output: &mut [f32]) {
        let groups = weight.chunks_exact(input.len() * LANES).zip(bias.as_chunks::<LANES>().0);
        for ((weight, bias), output) in groups.zip(output.chunks_mut(LANES)) {
            let mut sums: [f64; LANES] = bias.map(f64::from);
            for (&x, weight) in input.iter().zip(weight.as_chunks::<LANES>().0) {
                let x = f64::from(x);
                for lane in 0..LANES {
                    let w = f64::from(weight[lane]);
                    // The product of two f32 is exact in f64: fused or not, the same bits.
                    sums[lane] = if FUSED { x.mul_add(w, sums[lane]) } else { x * w + sums[lane] };
                }
            }
            output.iter_mut().zip(sums).for_each(|(output, sum)| *output = sum as f32);
        }
    }
}
