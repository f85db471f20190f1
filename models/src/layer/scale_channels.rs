//! Multiplication of each channel of each map by a factor: the last step of squeeze-and-excitation.

use candle_core::{Result, Shape, Tensor, bail};
use rayon::prelude::*;

use super::feature::Feature;
use super::operation::{Argument, Gradients, Operation, apply};
use crate::kernel::buffer::uninitialised;
use crate::kernel::spin_pool::for_each_chunk;

const NAME: &str = "scale_channels";

/// `input` `[batch][row][column][channel]` times `scale` `[batch][channel]`.
///
/// # Errors
/// Shapes differ from those above, or a tensor is not f32 on the CPU.
pub fn scale_channels(input: &Tensor, scale: &Tensor) -> Result<Tensor> {
    apply(NAME, &[input, scale], ScaleChannels)
}

struct ScaleChannels;

/// Number of values of a map, and number of channels.
fn sizes(inputs: &[Argument<'_>]) -> Result<(usize, usize)> {
    match inputs {
        &[Argument { dims: &[batch, rows, columns, channels], .. }, Argument { dims: &[b, c], .. }]
            if batch == b && channels == c && rows * columns * channels > 0 =>
        {
            Ok((rows * columns * channels, channels))
        }
        _ => {
            let dims: Vec<_> = inputs.iter().map(|a| a.dims).collect();
            bail!("{NAME}: expected input [batch, rows, columns, c], scale [batch, c]; got {dims:?}")
        }
    }
}

impl Feature {
    /// [`scale_channels`] in place; `scale` is `[batch][1][1][channel]`.
    ///
    /// # Errors
    /// Shapes differ from those above, or an axis is empty.
    pub fn scale_channels(&mut self, scale: &Feature) -> Result<()> {
        let ([batch, rows, columns, channels], [b, 1, 1, c]) = (self.dims(), scale.dims()) else {
            bail!("{NAME}: expected a scale [batch, 1, 1, c], got {:?}", scale.dims());
        };
        if batch != b || channels != c || rows * columns * channels == 0 {
            bail!("{NAME}: expected a scale [{batch}, 1, 1, {channels}], got {:?}", scale.dims());
        }
        for_each_chunk(self.values_mut(), columns * channels, |index, row| {
            let scale = &scale.values()[index / rows * channels..][..channels];
            for cell in row.chunks_exact_mut(channels) {
                cell.iter_mut().zip(scale).for_each(|(v, &s)| *v *= s);
            }
        });
        Ok(())
    }
}

impl Operation for ScaleChannels {
    fn forward(&self, inputs: &[Argument<'_>]) -> Result<(Vec<f32>, Shape)> {
        let (map, channels) = sizes(inputs)?;
        let [input, scale] = inputs else { bail!("{NAME}: expected two inputs") };
        let mut output = uninitialised(input.values.len());
        output
            .par_chunks_exact_mut(map)
            .zip(input.values.par_chunks_exact(map))
            .zip(scale.values.par_chunks_exact(channels))
            .for_each(|((output, input), scale)| {
                for (output, input) in output.chunks_exact_mut(channels).zip(input.chunks_exact(channels)) {
                    output.iter_mut().zip(input).zip(scale).for_each(|((y, &x), &s)| *y = x * s);
                }
            });
        Ok((output, Shape::from(input.dims)))
    }

    fn backward(&self, inputs: &[Argument<'_>], _output: &[f32], mut gradient: Vec<f32>) -> Result<Gradients> {
        let (map, channels) = sizes(inputs)?;
        let [input, scale] = inputs else { bail!("{NAME}: expected two inputs") };
        let mut scale_gradient = vec![0.0f32; scale.values.len()];
        gradient
            .par_chunks_exact_mut(map)
            .zip(input.values.par_chunks_exact(map))
            .zip(scale.values.par_chunks_exact(channels).zip(scale_gradient.par_chunks_exact_mut(channels)))
            .for_each(|((gradient, input), (scale, sums))| {
                for (gradient, input) in gradient.chunks_exact_mut(channels).zip(input.chunks_exact(channels)) {
                    for (((g, &x), &s), sum) in gradient.iter_mut().zip(input).zip(scale).zip(sums.iter_mut()) {
                        *sum += *g * x;
                        *g *= s;
                    }
                }
            });
        Ok(vec![Some(gradient), Some(scale_gradient)])
    }
}
