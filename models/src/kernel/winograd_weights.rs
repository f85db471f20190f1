//! Weights of Winograd's F(2x2, 3x3) (`winograd.rs`), and the gradients of weights.

use rayon::prelude::*;

use super::buffer::uninitialised;
use super::level::KernelLevel;
use super::packed::{Packed, Side};
use super::tile::Tiles;
use super::winograd_transform::{Kernels, POINTS};

const CELLS: usize = Kernels::CELLS;
const WIDTH: usize = Kernels::WIDTH;

/// Number of channels whose kernels are read together. Kernels of neighbouring inputs are contiguous in memory.
const GROUP: usize = 8;

/// `G g G^T` of weights `[o][i][3][3]`, packed with the points as offsets. For the backward pass, kernels are rotated by 180 degrees.
pub(super) fn transformed(weight: &[f32], [outputs, inputs]: [usize; 2], side: Side, tiles: Tiles) -> Packed {
    let (columns, channels) = match side {
        Side::Forward => (outputs, inputs),
        Side::Backward => (inputs, outputs),
    };
    let weight = weight.as_chunks::<CELLS>().0;
    Packed::with_panels(columns, POINTS * channels, tiles, |columns, width, target| {
        // Values behind the last column stay zero.
        let mut cells = [[[0.0; WIDTH]; CELLS]; GROUP];
        for first in (0..channels).step_by(GROUP) {
            let group = first..channels.min(first + GROUP);
            for (k, column) in (0..WIDTH).zip(columns.clone()) {
                for (channel, cells) in group.clone().zip(&mut cells) {
                    let mut kernel = match side {
                        Side::Forward => weight[column * inputs + channel],
                        Side::Backward => weight[channel * inputs + column],
                    };
                    if matches!(side, Side::Backward) {
                        kernel.reverse();
                    }
                    cells.iter_mut().zip(kernel).for_each(|(cell, value)| cell[k] = value);
                }
            }
            for (channel, cells) in group.zip(&mut cells) {
                let points = target[channel * width..].as_mut_ptr();
                let cells = cells.as_mut_ptr().cast();
                let kernels = Kernels { cells, points, stride: channels * width, count: width };
                // SAFETY: the panel has `width` columns, at most those of the widest tile, for each point and channel.
                unsafe { kernels.transform(tiles.level, false) };
            }
        }
    })
}

/// Gradient `[o][i][3][3]` of weights, `G^T u G` of the gradients `u` `[point][o][i]` of the transformed ones.
pub(super) fn gradient_of_weights(points: &[f32], [outputs, inputs]: [usize; 2], level: KernelLevel) -> Vec<f32> {
    assert_eq!(points.len(), POINTS * outputs * inputs);
    let mut gradient = uninitialised(outputs * inputs * CELLS);
    gradient.par_chunks_exact_mut((inputs * CELLS).max(1)).enumerate().for_each(|(output, gradient)| {
        let mut cells = [[0.0; WIDTH]; CELLS];
        for (chunk, target) in gradient.chunks_mut(WIDTH * CELLS).enumerate() {
            let target = target.as_chunks_mut::<CELLS>().0;
            let points = points[output * inputs + chunk * WIDTH..].as_ptr().cast_mut();
            let kernels =
                Kernels { cells: cells.as_mut_ptr().cast(), points, stride: outputs * inputs, count: target.len() };
            // SAFETY: points have as many values from here on as there are kernels in the chunk; they are only read.
            unsafe { kernels.transform(level, true) };
            for (k, kernel) in (0..WIDTH).zip(target) {
                kernel.iter_mut().zip(&cells).for_each(|(value, cell)| *value = cell[k]);
            }
        }
    });
    gradient
}
