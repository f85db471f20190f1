//! Max-pooling.

use std::sync::OnceLock;

use candle_core::{Result, Shape, Tensor, bail};
use rayon::prelude::*;

use super::feature::Feature;
use super::operation::{Argument, Gradients, Operation, apply};
use crate::kernel::KernelLevel;
use crate::kernel::buffer::uninitialised;
use crate::kernel::level::for_each_level;
use crate::kernel::spin_pool::for_each_chunk;

const NAME: &str = "max_pool2d";

/// PyTorch's `max_pool2d` of `[batch][row][column][channel]` with a square window. Padding is never the maximum, and a NaN always is.
/// Among equal cells, the maximum is the first in row-major order.
///
/// # Errors
/// The kernel has a side of 0 or more than 15 cells, the stride is 0, the padding exceeds half of the kernel, the padded input is
/// smaller than the kernel or has an empty axis, or it is not f32 on the CPU.
pub fn max_pool2d(input: &Tensor, kernel: usize, stride: usize, padding: usize, level: KernelLevel) -> Result<Tensor> {
    apply(NAME, &[input], MaxPool { kernel, stride, padding, level: level.available(), winners: OnceLock::new() })
}

struct MaxPool {
    kernel: usize,
    stride: usize,
    padding: usize,
    level: KernelLevel,
    /// Index of each output's cell in its window.
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
        bail!(
            "{NAME}: expected [batch, rows, columns, channels] that hold a window of 1 to 15 cells a side, padded by half \
             of it at most; got {dims:?} with kernel {kernel}, stride {stride}, padding {padding}"
        )
    }

    /// Input cells in the window of output cell `(row, column)`: index in the window, and index of the cell in the input.
    fn window(&self, sizes: &Sizes, row: usize, column: usize) -> impl Iterator<Item = (u8, usize)> {
        let (kernel, stride, padding) = (self.kernel, self.stride, self.padding);
        let [rows, columns] = sizes.input;
        (0..kernel * kernel).filter_map(move |k| {
            let y = (row * stride + k / kernel).checked_sub(padding)?;
            let x = (column * stride + k % kernel).checked_sub(padding)?;
            (y < rows && x < columns).then_some((k as u8, y * columns + x))
        })
    }

    /// Computes the largest values and their indices in the windows.
    fn run(&self, sizes: &Sizes, input: &[f32], output: &mut [f32], winners: &mut [u8]) {
        let channels = sizes.channels;
        let line = sizes.output[1] * channels;
        let map = sizes.input[0] * sizes.input[1] * channels;
        output.par_chunks_exact_mut(line).zip(winners.par_chunks_exact_mut(line)).enumerate().for_each(
            |(index, (output, winners))| {
                let (image, row) = (index / sizes.output[0], index % sizes.output[0]);
                let input = &input[image * map..(image + 1) * map];
                let cells = output.chunks_exact_mut(channels).zip(winners.chunks_exact_mut(channels));
                let mut window = Vec::new();
                for (column, (best, winner)) in cells.enumerate() {
                    window.clear();
                    window.extend(self.window(sizes, row, column));
                    window_maxima(self.level, input, &window, best, winner);
                }
            },
        );
    }
}

impl Feature {
    /// [`max_pool2d`] without a graph of gradients.
    ///
    /// # Errors
    /// Those of [`max_pool2d`].
    pub fn max_pool2d(
        &self,
        kernel: usize,
        stride: usize,
        padding: usize,
        level: KernelLevel,
        output: &mut Feature,
    ) -> Result<()> {
        let pool = MaxPool { kernel, stride, padding, level: level.available(), winners: OnceLock::new() };
        let (batch, sizes) = pool.sizes(&self.dims())?;
        output.reshape([batch, sizes.output[0], sizes.output[1], sizes.channels]);
        let map = sizes.input[0] * sizes.input[1] * sizes.channels;
        for_each_chunk(output.values_mut(), sizes.output[1] * sizes.channels, |index, line| {
            let (image, row) = (index / sizes.output[0], index % sizes.output[0]);
            let input = &self.values()[image * map..(image + 1) * map];
            for (column, best) in line.chunks_exact_mut(sizes.channels).enumerate() {
                best.fill(f32::NEG_INFINITY);
                for (_, cell) in pool.window(&sizes, row, column) {
                    update_maxima(pool.level, &input[cell * sizes.channels..][..sizes.channels], best);
                }
            }
        });
        Ok(())
    }
}

for_each_level! {
    /// Replaces maxima by larger values. A NaN is larger than any number, and stays.
    fn update_maxima(values: &[f32], best: &mut [f32]) {
        for (best, &value) in best.iter_mut().zip(values) {
            *best = if (value > *best) | value.is_nan() { value } else { *best };
        }
    }
}

/// Channels that are compared at once.
const LANES: usize = 16;

/// Maxima of [`LANES`] channels from `first` on over the cells of a window, and their indices in the window.
#[inline(always)]
fn lane_maxima(input: &[f32], window: &[(u8, usize)], channels: usize, first: usize) -> ([f32; LANES], [u32; LANES]) {
    let (mut best, mut winner) = ([f32::NEG_INFINITY; LANES], [u32::MAX; LANES]);
    for &(k, cell) in window {
        let Some(values) = input[cell * channels + first..].first_chunk::<LANES>() else { break };
        for lane in 0..LANES {
            let value = values[lane];
            // The first cell is always taken. A NaN is taken and stays, because comparisons with it are false.
            let better = (winner[lane] == u32::MAX) | (value > best[lane]) | value.is_nan();
            best[lane] = if better { value } else { best[lane] };
            winner[lane] = if better { u32::from(k) } else { winner[lane] };
        }
    }
    (best, winner)
}

for_each_level! {
    /// Computes the maximum of each channel over the cells of a window, and its index in the window.
    fn window_maxima(input: &[f32], window: &[(u8, usize)], best: &mut [f32], winner: &mut [u8]) {
        let channels = best.len();
        for first in (0..channels).step_by(LANES) {
            let lanes = LANES.min(channels - first);
            let (values, winners) = if lanes == LANES {
                lane_maxima(input, window, channels, first)
            } else {
                let mut rest = [0.0; 225 * LANES];
                let mut cells = [(0, 0); 225];
                for (index, &(k, cell)) in window.iter().enumerate() {
                    rest[index * LANES..][..lanes].copy_from_slice(&input[cell * channels + first..][..lanes]);
                    cells[index] = (k, index);
                }
                lane_maxima(&rest, &cells[..window.len()], LANES, 0)
            };
            best[first..first + lanes].copy_from_slice(&values[..lanes]);
            for (to, &k) in winner[first..first + lanes].iter_mut().zip(&winners) {
                *to = k as u8;
            }
        }
    }
}

for_each_level! {
    /// Adds each channel's gradient to the largest cell of the window.
    fn scatter_gradient(gradient: &[f32], winners: &[u8], window: &[(u8, usize)], map: &mut [f32]) {
        let channels = gradient.len();
        for &(k, cell) in window {
            let sums = &mut map[cell * channels..(cell + 1) * channels];
            for ((sum, &g), &winner) in sums.iter_mut().zip(gradient).zip(winners) {
                *sum += if winner == k { g } else { 0.0 };
            }
        }
    }
}

impl Operation for MaxPool {
    fn forward(&self, inputs: &[Argument<'_>]) -> Result<(Vec<f32>, Shape)> {
        let [input] = inputs else { bail!("{NAME}: expected one input") };
        let (batch, sizes) = self.sizes(input.dims)?;
        let mut output = uninitialised(batch * sizes.output[0] * sizes.output[1] * sizes.channels);
        let mut winners = vec![0u8; output.len()];
        self.run(&sizes, input.values, &mut output, &mut winners);
        let _ = self.winners.set(winners);
        Ok((output, Shape::from((batch, sizes.output[0], sizes.output[1], sizes.channels))))
    }

    fn backward(&self, inputs: &[Argument<'_>], _output: &[f32], gradient: Vec<f32>) -> Result<Gradients> {
        let [input] = inputs else { bail!("{NAME}: expected one input") };
        let (_, sizes) = self.sizes(input.dims)?;
        let Some(winners) = self.winners.get() else {
            bail!("{NAME}: backward pass without a forward pass");
        };
        let channels = sizes.channels;
        let pooled = sizes.output[0] * sizes.output[1] * channels;
        let mut input_gradient = vec![0.0f32; input.values.len()];
        input_gradient
            .par_chunks_exact_mut(sizes.input[0] * sizes.input[1] * channels)
            .zip(gradient.par_chunks_exact(pooled).zip(winners.par_chunks_exact(pooled)))
            .for_each(|(map, (gradient, winners))| {
                let cells = gradient.chunks_exact(channels).zip(winners.chunks_exact(channels));
                let mut window = Vec::new();
                for (index, (gradient, winners)) in cells.enumerate() {
                    window.clear();
                    window.extend(self.window(&sizes, index / sizes.output[1], index % sizes.output[1]));
                    scatter_gradient(self.level, gradient, winners, &window, map);
                }
            });
        Ok(vec![Some(input_gradient)])
    }
}
