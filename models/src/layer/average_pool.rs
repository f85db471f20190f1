//! Adaptive average pooling of maps of any size to a fixed size.

use candle_core::{Result, Shape, Tensor, bail};
use rayon::prelude::*;

use super::feature::Feature;
use super::operation::{Argument, Gradients, Operation, apply};
use crate::kernel::KernelLevel;
use crate::kernel::buffer::uninitialised;
use crate::kernel::level::for_each_level;
use crate::kernel::spin_pool::for_each_chunk;

/// Channels that are summed at once.
const LANES: usize = 16;
const NAME: &str = "adaptive_average_pool";

/// Means over bins: `[batch][row][column][channel]` to `[batch][channel * rows * columns]`, flattened channel-first as
/// PyTorch's `AdaptiveAvgPool2d` and `Flatten` would, so that weights are interchangeable.
///
/// Bin `i` of `n` over a length `l` runs from `floor(i l / n)` to `ceil((i + 1) l / n)`.
///
/// # Errors
/// An axis or a number of bins is 0, the input has another number of axes, or it is not f32 on the CPU.
pub fn adaptive_average_pool(input: &Tensor, rows: usize, columns: usize) -> Result<Tensor> {
    apply(NAME, &[input], AveragePool { rows, columns })
}

/// First and end index of bin `index` of `bins` over `length` cells.
pub(crate) fn bin_bounds(index: usize, bins: usize, length: usize) -> (usize, usize) {
    (index * length / bins, ((index + 1) * length).div_ceil(bins))
}

struct AveragePool {
    rows: usize,
    columns: usize,
}

impl AveragePool {
    fn sizes(&self, dims: &[usize]) -> Result<[usize; 4]> {
        match *dims {
            [batch, rows, columns, channels]
                if rows > 0 && columns > 0 && channels > 0 && self.rows > 0 && self.columns > 0 =>
            {
                Ok([batch, rows, columns, channels])
            }
            _ => bail!(
                "{NAME}: expected [batch, rows, columns, channels] without empty axes, got {dims:?} to ({}, {})",
                self.rows,
                self.columns
            ),
        }
    }

    /// Calls `f` for each bin with its index, its first and end row, its first and end column, and the weight of a cell in it.
    fn for_each_bin(&self, rows: usize, columns: usize, mut f: impl FnMut(usize, (usize, usize), (usize, usize), f32)) {
        for i in 0..self.rows {
            let row_range = bin_bounds(i, self.rows, rows);
            for j in 0..self.columns {
                let column_range = bin_bounds(j, self.columns, columns);
                let cells = (row_range.1 - row_range.0) * (column_range.1 - column_range.0);
                f(i * self.columns + j, row_range, column_range, 1.0 / cells as f32);
            }
        }
    }

    /// Computes the means. A task is one map, or a group of [`LANES`] channels of it if they divide its channels.
    fn run(&self, [_, rows, columns, channels]: [usize; 4], input: &[f32], result: &mut [f32]) {
        let (bins, level) = (self.rows * self.columns, KernelLevel::detect());
        let group = if channels.is_multiple_of(LANES) { LANES } else { channels };
        for_each_chunk(result, group * bins, |index, out| {
            let (image, first) = (index / (channels / group), index % (channels / group) * group);
            let map = &input[image * rows * columns * channels..][..rows * columns * channels];
            let mut sums = vec![0.0f32; group];
            self.for_each_bin(rows, columns, |index, (top, bottom), (left, right), weight| {
                sums.fill(0.0);
                for row in top..bottom {
                    let cells = &map[(row * columns + left) * channels..(row * columns + right) * channels];
                    add_cells(level, cells, channels, first, &mut sums);
                }
                for (channel, &sum) in sums.iter().enumerate() {
                    out[channel * bins + index] = sum * weight;
                }
            });
        });
    }
}

for_each_level! {
    /// Adds the channels from `first` on of cells with this number of `channels` to `sums`. Nothing is multiplied, so that every
    /// level gives the same bits.
    fn add_cells(cells: &[f32], channels: usize, first: usize, sums: &mut [f32]) {
        let cells = cells.chunks_exact(channels);
        if let Ok(sums) = <&mut [f32; LANES]>::try_from(&mut *sums) {
            // The sums stay in registers over all cells.
            let mut register_sums = *sums;
            for values in cells.filter_map(|cell| cell[first..].first_chunk::<LANES>()) {
                register_sums.iter_mut().zip(values).for_each(|(s, &v)| *s += v);
            }
            *sums = register_sums;
            return;
        }
        for cell in cells {
            sums.iter_mut().zip(&cell[first..]).for_each(|(s, &v)| *s += v);
        }
    }
}

impl Feature {
    /// [`adaptive_average_pool`] without a graph of gradients: `[batch][1][1][channel * rows * columns]`.
    ///
    /// # Errors
    /// An axis or a number of bins is 0.
    pub fn adaptive_average_pool(&self, rows: usize, columns: usize, output: &mut Feature) -> Result<()> {
        let pool = AveragePool { rows, columns };
        let sizes @ [batch, _, _, channels] = pool.sizes(&self.dims())?;
        output.reshape([batch, 1, 1, channels * rows * columns]);
        pool.run(sizes, self.values(), output.values_mut());
        Ok(())
    }
}

impl Operation for AveragePool {
    fn forward(&self, inputs: &[Argument<'_>]) -> Result<(Vec<f32>, Shape)> {
        let [input] = inputs else { bail!("{NAME}: expected one input") };
        let sizes @ [batch, _, _, channels] = self.sizes(input.dims)?;
        let length = channels * self.rows * self.columns;
        let mut result = uninitialised(batch * length);
        self.run(sizes, input.values, &mut result);
        Ok((result, Shape::from((batch, length))))
    }

    fn backward(&self, inputs: &[Argument<'_>], _output: &[f32], gradient: Vec<f32>) -> Result<Gradients> {
        let [input] = inputs else { bail!("{NAME}: expected one input") };
        let [_, rows, columns, channels] = self.sizes(input.dims)?;
        let bins = self.rows * self.columns;
        let mut input_gradient = vec![0.0f32; input.values.len()];
        input_gradient
            .par_chunks_exact_mut(rows * columns * channels)
            .zip(gradient.par_chunks_exact(channels * bins))
            .for_each(|(map, g)| {
                let mut share = vec![0.0f32; channels];
                self.for_each_bin(rows, columns, |index, (top, bottom), (left, right), weight| {
                    for (channel, share) in share.iter_mut().enumerate() {
                        *share = g[channel * bins + index] * weight;
                    }
                    for row in top..bottom {
                        let cells = &mut map[(row * columns + left) * channels..(row * columns + right) * channels];
                        for cell in cells.chunks_exact_mut(channels) {
                            cell.iter_mut().zip(&share).for_each(|(v, &s)| *v += s);
                        }
                    }
                });
            });
        Ok(vec![Some(input_gradient)])
    }
}
