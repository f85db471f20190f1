//! Dropout.

use candle_core::{Error, Result, Shape, Tensor};
use rand::Rng;
use rayon::prelude::*;

use super::operation::{Argument, Gradients, Operation, apply};
use crate::random::stream;

const NAME: &str = "dropout";
/// Values for which one generator is used.
const BLOCK: usize = 4096;

/// Sets each value to zero with `probability` and scales the others by `1 / (1 - probability)`, in training only. The choice is a
/// function of `seed`, `draw` (for example the number of the step) and the index of the value.
///
/// # Errors
/// The probability is outside of `0..1`, or the tensor is not f32 on the CPU.
pub fn dropout(input: &Tensor, probability: f32, seed: u64, draw: u64) -> Result<Tensor> {
    if !(0.0..1.0).contains(&probability) {
        return Err(Error::Msg(format!("{NAME}: expected a probability from 0 to below 1, got {probability}")).bt());
    }
    apply(&[input], Dropout { probability, seed, draw })
}

struct Dropout {
    probability: f32,
    seed: u64,
    draw: u64,
}

impl Dropout {
    fn drop(&self, values: &mut [f32]) {
        let scale = 1.0 / (1.0 - self.probability);
        values.par_chunks_mut(BLOCK).enumerate().for_each(|(block, values)| {
            let mut random = stream(self.seed, &format!("{NAME} {}", self.draw), block as u64);
            for value in values {
                *value = if random.random::<f32>() < self.probability { 0.0 } else { *value * scale };
            }
        });
    }
}

impl Operation for Dropout {
    fn name(&self) -> &'static str {
        NAME
    }

    fn forward(&self, inputs: &[Argument<'_>]) -> Result<(Vec<f32>, Shape)> {
        let [input] = inputs else { candle_core::bail!("{NAME}: expected one input") };
        let mut output = input.values.to_vec();
        self.drop(&mut output);
        Ok((output, Shape::from(input.dims)))
    }

    fn backward(&self, _inputs: &[Argument<'_>], _output: &[f32], mut gradient: Vec<f32>) -> Result<Gradients> {
        self.drop(&mut gradient);
        Ok(vec![Some(gradient)])
    }
}
