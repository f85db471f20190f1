//! Stochastic depth.

use candle_core::{Error, Result, Shape, Tensor};
use rand::Rng;
use rayon::prelude::*;

use super::operation::{Argument, Gradients, Operation, apply};
use crate::random::stream;

const NAME: &str = "drop_samples";

/// Sets whole samples of a batch to zero with `probability` and scales the others by `1 / (1 - probability)`, in training only
/// (Huang et al., ECCV 2016; torchvision's "row" mode). The choice is a function of `seed` and `draw`.
///
/// # Errors
/// The probability is outside of `0..1`, or the tensor is not f32 on the CPU.
pub fn drop_samples(input: &Tensor, probability: f32, seed: u64, draw: u64) -> Result<Tensor> {
    if !(0.0..1.0).contains(&probability) {
        return Err(Error::Msg(format!("{NAME}: expected a probability from 0 to below 1, got {probability}")).bt());
    }
    let batch = input.dims().first().copied().unwrap_or_default();
    let mut rng = stream(seed, NAME, draw);
    let kept = 1.0 / (1.0 - probability);
    let factors = (0..batch).map(|_| if rng.random::<f32>() < probability { 0.0 } else { kept }).collect();
    apply(&[input], DropSamples { factors })
}

struct DropSamples {
    factors: Vec<f32>,
}

impl DropSamples {
    fn scale(&self, values: &mut [f32]) {
        let length = values.len() / self.factors.len().max(1);
        let samples = values.par_chunks_exact_mut(length.max(1)).zip(&self.factors);
        samples.for_each(|(sample, factor)| sample.iter_mut().for_each(|x| *x *= factor));
    }
}

impl Operation for DropSamples {
    fn name(&self) -> &'static str {
        NAME
    }

    fn forward(&self, inputs: &[Argument<'_>]) -> Result<(Vec<f32>, Shape)> {
        let [input] = inputs else { candle_core::bail!("{NAME}: expected one input") };
        let mut output = input.values.to_vec();
        self.scale(&mut output);
        Ok((output, Shape::from(input.dims)))
    }

    fn backward(&self, _inputs: &[Argument<'_>], _output: &[f32], mut gradient: Vec<f32>) -> Result<Gradients> {
        self.scale(&mut gradient);
        Ok(vec![Some(gradient)])
    }
}
