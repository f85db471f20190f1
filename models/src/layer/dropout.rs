//! Dropout of values and of whole samples.

use candle_core::{Result, Shape, Tensor, bail};
use rand::Rng;
use rayon::prelude::*;

use super::operation::{Argument, Gradients, Operation, apply};
use crate::random::stream;

/// Number of values for which one random generator is used.
const BLOCK: usize = 4096;

/// Sets each value to zero with `probability` and scales the others by `1 / (1 - probability)`, in training only. The choice is a
/// function of `seed`, `draw` (for example the number of the step) and the index of the value.
///
/// # Errors
/// The probability is outside of `0..1`, or the tensor is not f32 on the CPU.
pub fn dropout(input: &Tensor, probability: f32, seed: u64, draw: u64) -> Result<Tensor> {
    let name = "dropout";
    let kept = scale(name, probability)?;
    let drop = move |values: &mut [f32]| {
        values.par_chunks_mut(BLOCK).enumerate().for_each(|(block, values)| {
            let mut random = stream(seed, &format!("{name} {draw}"), block as u64);
            for value in values {
                *value = if random.random::<f32>() < probability { 0.0 } else { *value * kept };
            }
        });
    };
    apply(name, &[input], Dropout(drop))
}

/// Sets whole samples of a batch to zero with `probability` and scales the others by `1 / (1 - probability)`, in training only
/// (stochastic depth: Huang et al., ECCV 2016; torchvision's "row" mode). The choice is a function of `seed` and `draw`.
///
/// # Errors
/// The probability is outside of `0..1`, or the tensor is not f32 on the CPU.
pub fn drop_samples(input: &Tensor, probability: f32, seed: u64, draw: u64) -> Result<Tensor> {
    let name = "drop_samples";
    let kept = scale(name, probability)?;
    let batch = input.dims().first().copied().unwrap_or_default();
    let mut rng = stream(seed, name, draw);
    let factors: Vec<f32> = (0..batch).map(|_| if rng.random::<f32>() < probability { 0.0 } else { kept }).collect();
    let drop = move |values: &mut [f32]| {
        let length = values.len() / factors.len().max(1);
        let samples = values.par_chunks_exact_mut(length.max(1)).zip(&factors);
        samples.for_each(|(sample, factor)| sample.iter_mut().for_each(|x| *x *= factor));
    };
    apply(name, &[input], Dropout(drop))
}

/// Factor of the values that are kept.
fn scale(name: &str, probability: f32) -> Result<f32> {
    if !(0.0..1.0).contains(&probability) {
        bail!("{name}: expected a probability from 0 to below 1, got {probability}");
    }
    Ok(1.0 / (1.0 - probability))
}

/// A layer that multiplies values by constants, and gradients by the same ones.
struct Dropout<F>(F);

impl<F: Fn(&mut [f32]) + Send + Sync + 'static> Operation for Dropout<F> {
    fn forward(&self, inputs: &[Argument<'_>]) -> Result<(Vec<f32>, Shape)> {
        let [input] = inputs else { bail!("dropout: expected one input") };
        let mut output = input.values.to_vec();
        (self.0)(&mut output);
        Ok((output, Shape::from(input.dims)))
    }

    fn backward(&self, _inputs: &[Argument<'_>], _output: &[f32], mut gradient: Vec<f32>) -> Result<Gradients> {
        (self.0)(&mut gradient);
        Ok(vec![Some(gradient)])
    }
}
