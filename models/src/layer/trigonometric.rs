//! Layer of the five trigonometric features, of which the two-qubit circuit is a linear combination.

use candle_core::{Result, Shape, Tensor, bail};

use super::operation::{Argument, Gradients, Operation, apply};
use crate::quantum::features;

const NAME: &str = "trigonometric";

/// `[batch][2]` radians to the features a, b, c, d, e of [`crate::quantum`], `[batch][5]`.
///
/// # Errors
/// The input has another shape, or it is not f32 on the CPU.
pub fn trigonometric(input: &Tensor) -> Result<Tensor> {
    apply(NAME, &[input], Trigonometric)
}

struct Trigonometric;

fn rows<'a>(inputs: &[Argument<'a>]) -> Result<impl Iterator<Item = [f64; 2]> + 'a> {
    match inputs {
        &[Argument { values, dims: &[_, 2] }] => Ok(values.as_chunks::<2>().0.iter().map(|row| row.map(f64::from))),
        _ => {
            let dims: Vec<_> = inputs.iter().map(|input| input.dims).collect();
            bail!("{NAME}: expected input [batch, 2], got {dims:?}")
        }
    }
}

impl Operation for Trigonometric {
    fn forward(&self, inputs: &[Argument<'_>]) -> Result<(Vec<f32>, Shape)> {
        let output: Vec<f32> = rows(inputs)?.flat_map(|x| features(x).0.map(|value| value as f32)).collect();
        let batch = output.len() / 5;
        Ok((output, Shape::from((batch, 5))))
    }

    fn backward(&self, inputs: &[Argument<'_>], _output: &[f32], gradient: Vec<f32>) -> Result<Gradients> {
        let row_gradient = |(x, gradient): ([f64; 2], &[f32; 5])| {
            let (_, derivatives) = features(x);
            derivatives.map(|by| by.iter().zip(gradient).map(|(f, &g)| f * f64::from(g)).sum::<f64>() as f32)
        };
        Ok(vec![Some(rows(inputs)?.zip(gradient.as_chunks::<5>().0).flat_map(row_gradient).collect())])
    }
}
