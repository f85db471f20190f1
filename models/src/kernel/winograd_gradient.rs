//! Gradients of weights by Winograd's algorithm (`winograd.rs`): 16 products for each window instead of 36, as in its
//! forward pass.
//!
//! The output is linear in the transformed weights `G g G^T`. Their gradient at a point is the sum over all windows of
//! `A y A^T` times `B^T d B`. `y` are the gradients of the window's four output cells, and `d` are its 4x4 input cells.

use rayon::prelude::*;

use super::buffer::uninitialised;
use super::tile::{OuterTile, SharedBuffer, Tiles, part};
use super::winograd::WindowGrid;
use super::winograd_transform::POINTS;
use super::winograd_weights::gradient_of_weights;

/// Number of transformed values of a block of windows. They stay in the caches until their products are summed, unless
/// [`LEAST_BLOCK`] makes the block larger.
const BLOCK_VALUES: usize = 1 << 19;
/// Least number of windows of a block: each block reads and writes all sums once.
const LEAST_BLOCK: usize = 128;
/// Largest number of windows of a block. Longer sums in f32 are less exact.
const MOST_BLOCK: usize = 256;
/// Number of windows that one task transforms.
const WINDOWS_PER_TASK: usize = 16;
/// Number of tasks for each point.
const TASKS: usize = 4;
/// Values that a task fills with zeros.
const CHUNK: usize = 1 << 16;
/// Padding after the values of each point. Without it, points could compete for the same cache lines, because their
/// distances would be multiples of a power of two.
const GAP: usize = 16;

/// Gradient `[o][i][3][3]` of the weights of a 3x3 convolution of stride 1 and padding 1 on `source` `[batch][row][column][i]`, whose
/// output has `gradient` `[batch][row][column][o]`.
///
/// Blocks depend on shapes only and are added in their order: the same bits for any number of threads.
///
/// # Panics
/// Lengths differ from the shapes above.
pub(crate) fn weight_gradient(
    source: &[f32],
    [batch, rows, columns]: [usize; 3],
    gradient: &[f32],
    [outputs, inputs]: [usize; 2],
    tiles: Tiles,
) -> Vec<f32> {
    assert_eq!(source.len(), batch * rows * columns * inputs);
    assert_eq!(gradient.len(), batch * rows * columns * outputs);
    let window_grid = WindowGrid { rows, columns, grid: [rows.div_ceil(2), columns.div_ceil(2)] };
    let windows = batch * window_grid.grid[0] * window_grid.grid[1];
    let block = (BLOCK_VALUES / (POINTS * (inputs + outputs)).max(1)).clamp(LEAST_BLOCK, MOST_BLOCK).min(windows);
    let [source_stride, gradient_stride] = [inputs, outputs].map(|channels| block * channels + GAP);
    let mut gradients = uninitialised(POINTS * gradient_stride);
    let mut sources = uninitialised(POINTS * source_stride);
    let transformed = Transformed {
        gradients: SharedBuffer::new(&mut gradients),
        sources: SharedBuffer::new(&mut sources),
        outputs,
        inputs,
        gradient_stride,
        source_stride,
        block,
        tiles,
    };
    let mut sums = uninitialised(POINTS * outputs * inputs);
    sums.par_chunks_mut(CHUNK).for_each(|sums| sums.fill(0.0));
    let blocks = windows.div_ceil(block.max(1));
    for index in 0..blocks {
        let windows = part(windows, blocks, index);
        (0..windows.len().div_ceil(WINDOWS_PER_TASK)).into_par_iter().for_each(|task| {
            let first = task * WINDOWS_PER_TASK;
            for k in first..windows.len().min(first + WINDOWS_PER_TASK) {
                transformed.write(&window_grid, windows.start + k, k, source, gradient);
            }
        });
        let sums = SharedBuffer::new(&mut sums);
        (0..POINTS * TASKS).into_par_iter().for_each(|task| transformed.add_products(windows.len(), task, sums));
    }
    gradient_of_weights(&sums, [outputs, inputs], tiles.level)
}

/// Transformed windows of a block.
struct Transformed {
    /// Gradients `[point][window][output]`.
    gradients: SharedBuffer,
    /// Inputs `[point][window][input]`.
    sources: SharedBuffer,
    outputs: usize,
    inputs: usize,
    /// Stride of `gradients` from point to point.
    gradient_stride: usize,
    /// Stride of `sources` from point to point.
    source_stride: usize,
    /// Largest number of windows of a block.
    block: usize,
    tiles: Tiles,
}

impl Transformed {
    /// Writes the transforms of a window of the maps as those of window `k` of the block.
    fn write(&self, window_grid: &WindowGrid, window: usize, k: usize, source: &[f32], gradient: &[f32]) {
        debug_assert!(k < self.block);
        let source_target = self.sources.get().wrapping_add(k * self.inputs);
        let gradient_target = self.gradients.get().wrapping_add(k * self.outputs);
        let source_window = window_grid.input_window(source, window, self.inputs, source_target, self.source_stride);
        let gradient_window =
            window_grid.gradient_window(gradient, window, self.outputs, gradient_target, self.gradient_stride);
        // SAFETY: only cells in the map are read. There is room for a block of windows at every point, and no other task writes
        // this window.
        unsafe {
            source_window.transform(self.tiles.level);
            gradient_window.transform(self.tiles.level);
        }
    }

    /// Adds the products of the first `windows` windows to `sums` `[point][o][i]`, for the point and the outputs of one task.
    fn add_products(&self, windows: usize, task: usize, sums: SharedBuffer) {
        let (point, task) = (task / TASKS, task % TASKS);
        let Transformed { outputs, inputs, tiles, .. } = *self;
        let sources = self.sources.get().wrapping_add(point * self.source_stride);
        let addresses: Vec<*const f32> = (0..windows).map(|k| sources.wrapping_add(k * inputs).cast_const()).collect();
        let output_tiles = outputs.div_ceil(tiles.rows);
        for first_input in (0..inputs).step_by(tiles.width()) {
            for output_tile in part(output_tiles, TASKS, task) {
                let rows = part(outputs, output_tiles, output_tile);
                let tile = OuterTile {
                    left: self.gradients.get().wrapping_add(point * self.gradient_stride + rows.start),
                    left_stride: outputs,
                    right: addresses.as_ptr(),
                    right_offset: first_input,
                    cells: windows,
                    target: sums.get().wrapping_add((point * outputs + rows.start) * inputs + first_input),
                    target_stride: inputs,
                    columns: tiles.width().min(inputs - first_input),
                };
                // SAFETY: operands are windows of this block; no other task has this point and these outputs.
                unsafe { tiles.outer_tile(rows.len(), &tile) };
            }
        }
    }
}
