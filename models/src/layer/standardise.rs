//! Normalisation by constants.

use candle_core::{Result, Shape, Tensor, bail};
use rayon::prelude::*;

use super::operation::{Argument, Gradients, Operation, apply};

const NAME: &str = "standardise";

/// `(input - mean) / sigma`, with `input` `[batch][feature]` and a mean and a sigma for each feature. The constants have no gradient.
///
/// # Errors
/// There is not one mean and one sigma for each feature, there are none, or the tensor is not f32 on the CPU.
pub fn standardise(input: &Tensor, mean: &[f32], sigma: &[f32]) -> Result<Tensor> {
    let factor = sigma.iter().map(|sigma| 1.0 / sigma).collect();
    apply(NAME, &[input], Standardise { mean: mean.to_vec(), factor })
}

struct Standardise {
    mean: Vec<f32>,
    /// One over sigma.
    factor: Vec<f32>,
}

impl Operation for Standardise {
    fn forward(&self, inputs: &[Argument<'_>]) -> Result<(Vec<f32>, Shape)> {
        let [input] = inputs else { bail!("{NAME}: expected one input") };
        let width = self.mean.len();
        if width == 0 || width != self.factor.len() || input.dims.last() != Some(&width) {
            bail!(
                "{NAME}: expected input [batch, {width}] and as many sigmas, got {:?} and {}",
                input.dims,
                self.factor.len()
            );
        }
        let mut output = input.values.to_vec();
        output.par_chunks_exact_mut(width).for_each(|row| {
            row.iter_mut().zip(&self.mean).zip(&self.factor).for_each(|((x, mean), factor)| *x = (*x - mean) * factor);
        });
        Ok((output, Shape::from(input.dims)))
    }

    fn backward(&self, _inputs: &[Argument<'_>], _output: &[f32], mut gradient: Vec<f32>) -> Result<Gradients> {
        gradient.par_chunks_exact_mut(self.mean.len()).for_each(|row| {
            row.iter_mut().zip(&self.factor).for_each(|(g, factor)| *g *= factor);
        });
        Ok(vec![Some(gradient)])
    }
}
