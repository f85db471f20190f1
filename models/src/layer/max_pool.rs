//! Max-pooling.

use std::sync::OnceLock;

use candle_core::{Error, Result, Shape, Tensor};
use rayon::prelude::*;

use super::operation::{Argument, Gradients, Operation, apply};

const NAME: &str = "max_pool2d";

/// PyTorch's `max_pool2d` of `[batch][row][column][channel]` with a square window; padding never wins, a NaN always does,
/// and of equals the first in row-major order.
pub fn max_pool2d(input: &Tensor, kernel: usize, stride: usize, padding: usize) -> Result<Tensor> {
    apply(&[input], MaxPool { kernel, stride, padding, winners: OnceLock::new() })
}

struct MaxPool {
    kernel: usize,
    stride: usize,
    padding: usize,
    /// Which cell of its window each output is.
    winners: OnceLock<Vec<u8>>,
}

struct Sizes {
    input: [usize; 2],
    output: [usize; 2],
    channels: usize,
}

impl MaxPool {
    fn sizes(&self, dims: &[usize]) -> Result<(usize, Sizes)> {
        let MaxPool { kernel, stride, padding, .. } = *self;
        if let &[batch, rows, columns, channels] = dims
            && (1..=15).contains(&kernel)
            && stride > 0
            && 2 * padding <= kernel
            && rows + 2 * padding >= kernel
            && columns + 2 * padding >= kernel
            && rows * columns * channels > 0
        {
            let length = |input: usize| (input + 2 * padding - kernel) / stride + 1;
            let sizes = Sizes { input: [rows, columns], output: [length(rows), length(columns)], channels };
            return Ok((batch, sizes));
        }
        Err(Error::Msg(format!(
            "{NAME}: expected [batch, rows, columns, channels] that hold a window of 1 to 15 cells a side, padded by half \
             of it at most; got {dims:?} with kernel {kernel}, stride {stride}, padding {padding}"
        ))
        .bt())
    }

    /// Cells of the window of output cell `(row, column)` that are in the input: index in the window, and cell.
    fn window(&self, sizes: &Sizes, row: usize, column: usize) -> impl Iterator<Item = (u8, usize)> {
        let (kernel, stride, padding) = (self.kernel, self.stride, self.padding);
        let [rows, columns] = sizes.input;
        (0..kernel * kernel).filter_map(move |k| {
            let y = (row * stride + k / kernel).checked_sub(padding)?;
            let x = (column * stride + k % kernel).checked_sub(padding)?;
            (y < rows && x < columns).then_some((k as u8, y * columns + x))
        })
    }
}

impl Operation for MaxPool {
    fn name(&self) -> &'static str {
        NAME
    }

    fn forward(&self, inputs: &[Argument<'_>]) -> Result<(Vec<f32>, Shape)> {
        let [input] = inputs else { candle_core::bail!("{NAME}: expected one input") };
        let (batch, sizes) = self.sizes(input.dims)?;
        let channels = sizes.channels;
        let line = sizes.output[1] * channels;
        let map = sizes.input[0] * sizes.input[1] * channels;
        let mut output = vec![0.0f32; batch * sizes.output[0] * line];
        let mut winners = vec![0u8; output.len()];
        output.par_chunks_exact_mut(line).zip(winners.par_chunks_exact_mut(line)).enumerate().for_each(
            |(index, (output, winners))| {
                let (image, row) = (index / sizes.output[0], index % sizes.output[0]);
                let input = &input.values[image * map..(image + 1) * map];
                let cells = output.chunks_exact_mut(channels).zip(winners.chunks_exact_mut(channels));
                for (column, (best, winner)) in cells.enumerate() {
                    let mut first = true;
                    for (k, cell) in self.window(&sizes, row, column) {
                        let values = &input[cell * channels..(cell + 1) * channels];
                        if first {
                            best.copy_from_slice(values);
                            winner.fill(k);
                            first = false;
                            continue;
                        }
                        for ((best, winner), &value) in best.iter_mut().zip(winner.iter_mut()).zip(values) {
                            // A NaN wins, and stays: comparisons with it are false.
                            let better = value > *best || value.is_nan();
                            *best = if better { value } else { *best };
                            *winner = if better { k } else { *winner };
                        }
                    }
                }
            },
        );
        let _ = self.winners.set(winners);
        Ok((output, Shape::from((batch, sizes.output[0], sizes.output[1], channels))))
    }

    fn backward(&self, inputs: &[Argument<'_>], _output: &[f32], gradient: Vec<f32>) -> Result<Gradients> {
        let [input] = inputs else { candle_core::bail!("{NAME}: expected one input") };
        let (_, sizes) = self.sizes(input.dims)?;
        let Some(winners) = self.winners.get() else {
            candle_core::bail!("{NAME}: backward pass without a forward pass");
        };
        let channels = sizes.channels;
        let pooled = sizes.output[0] * sizes.output[1] * channels;
        let mut input_gradient = vec![0.0f32; input.values.len()];
        input_gradient
            .par_chunks_exact_mut(sizes.input[0] * sizes.input[1] * channels)
            .zip(gradient.par_chunks_exact(pooled).zip(winners.par_chunks_exact(pooled)))
            .for_each(|(map, (gradient, winners))| {
                let cells = gradient.chunks_exact(channels).zip(winners.chunks_exact(channels));
                for (index, (gradient, winners)) in cells.enumerate() {
                    for (k, cell) in self.window(&sizes, index / sizes.output[1], index % sizes.output[1]) {
                        let sums = &mut map[cell * channels..(cell + 1) * channels];
                        for ((sum, &g), &winner) in sums.iter_mut().zip(gradient).zip(winners) {
                            *sum += if winner == k { g } else { 0.0 };
                        }
                    }
                }
            });
        Ok(vec![Some(input_gradient)])
    }
}
