//! The five features of which the two-qubit circuit is a linear combination, as a layer.

use std::f64::consts::PI;

use candle_core::{Result, Shape, Tensor, bail};

use super::operation::{Argument, Gradients, Operation, apply};

const NAME: &str = "trigonometric";

/// `[batch][2]` radians to the features a, b, c, d, e of [`crate::quantum`], `[batch][5]`.
///
/// # Errors
/// The input has another shape, or it is not f32 on the CPU.
pub fn trigonometric(input: &Tensor) -> Result<Tensor> {
    apply(&[input], Trigonometric)
}

struct Trigonometric;

/// The features at a point and their derivatives by both inputs.
pub(crate) fn features([x0, x1]: [f64; 2]) -> [[f64; 3]; 5] {
    let (sw, cw) = (2.0 * (PI - x0) * (PI - x1)).sin_cos();
    let (w0, w1) = (-2.0 * (PI - x1), -2.0 * (PI - x0));
    let ((s0, c0), (s1, c1)) = ((2.0 * x0).sin_cos(), (2.0 * x1).sin_cos());
    [
        [s1 * sw, s1 * cw * w0, 2.0 * c1 * sw + s1 * cw * w1],
        [s0 * sw, 2.0 * c0 * sw + s0 * cw * w0, s0 * cw * w1],
        [c0 * c1, -2.0 * s0 * c1, -2.0 * c0 * s1],
        [c1 * cw, -c1 * sw * w0, -2.0 * s1 * cw - c1 * sw * w1],
        [c0 * cw, -2.0 * s0 * cw - c0 * sw * w0, -c0 * sw * w1],
    ]
}

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
    fn name(&self) -> &'static str {
        NAME
    }

    fn forward(&self, inputs: &[Argument<'_>]) -> Result<(Vec<f32>, Shape)> {
        let output: Vec<f32> = rows(inputs)?.flat_map(|x| features(x).map(|[value, ..]| value as f32)).collect();
        let batch = output.len() / 5;
        Ok((output, Shape::from((batch, 5))))
    }

    fn backward(&self, inputs: &[Argument<'_>], _output: &[f32], gradient: Vec<f32>) -> Result<Gradients> {
        let by_row = |(x, gradient): ([f64; 2], &[f32; 5])| {
            let of = features(x);
            let along = |k: usize| of.iter().zip(gradient).map(|(f, &g)| f[k] * f64::from(g)).sum::<f64>() as f32;
            [along(1), along(2)]
        };
        Ok(vec![Some(rows(inputs)?.zip(gradient.as_chunks::<5>().0).flat_map(by_row).collect())])
    }
}
