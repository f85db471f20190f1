//! Sum and concatenation of two arrays.

use candle_core::{Result, Shape, Tensor, bail};

use super::activation::map_pairs;
use super::operation::{Argument, Gradients, Operation, apply};

const ADD: &str = "add";

/// `a + b`, of one shape.
///
/// # Errors
/// The shapes differ, or a tensor is not f32 on the CPU.
pub fn add(a: &Tensor, b: &Tensor) -> Result<Tensor> {
    apply(ADD, &[a, b], Add)
}

struct Add;

impl Operation for Add {
    fn forward(&self, inputs: &[Argument<'_>]) -> Result<(Vec<f32>, Shape)> {
        map_pairs(ADD, inputs, |a, b, output| {
            output.iter_mut().zip(a).zip(b).for_each(|((y, a), b)| *y = a + b);
        })
    }

    fn backward(&self, _inputs: &[Argument<'_>], _output: &[f32], gradient: Vec<f32>) -> Result<Gradients> {
        Ok(vec![Some(gradient.clone()), Some(gradient)])
    }
}

/// `[batch][a]` and `[batch][b]` to `[batch][a + b]`.
///
/// # Errors
/// Shapes differ from those above, or a tensor is not f32 on the CPU.
pub fn concatenate(a: &Tensor, b: &Tensor) -> Result<Tensor> {
    apply("concatenate", &[a, b], Concatenate)
}

struct Concatenate;

/// Number of rows, and widths of both arrays.
fn widths(inputs: &[Argument<'_>]) -> Result<[usize; 3]> {
    match inputs {
        &[Argument { dims: &[batch, a], .. }, Argument { dims: &[rows, b], .. }] if batch == rows && a * b > 0 => {
            Ok([batch, a, b])
        }
        _ => {
            let dims: Vec<_> = inputs.iter().map(|input| input.dims).collect();
            bail!("concatenate: expected [batch, a] and [batch, b], got {dims:?}")
        }
    }
}

impl Operation for Concatenate {
    fn forward(&self, inputs: &[Argument<'_>]) -> Result<(Vec<f32>, Shape)> {
        let [batch, a, b] = widths(inputs)?;
        let [first, second] = inputs else { bail!("concatenate: expected two inputs") };
        let mut output = Vec::with_capacity(batch * (a + b));
        for (first, second) in first.values.chunks_exact(a).zip(second.values.chunks_exact(b)) {
            output.extend_from_slice(first);
            output.extend_from_slice(second);
        }
        Ok((output, Shape::from((batch, a + b))))
    }

    fn backward(&self, inputs: &[Argument<'_>], _output: &[f32], gradient: Vec<f32>) -> Result<Gradients> {
        let [_, a, b] = widths(inputs)?;
        let rows = gradient.chunks_exact(a + b).map(|row| row.split_at(a));
        let (first, second): (Vec<&[f32]>, Vec<&[f32]>) = rows.unzip();
        Ok(vec![Some(first.concat()), Some(second.concat())])
    }
}
