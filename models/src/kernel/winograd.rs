//! Winograd's algorithm for 3x3 convolutions of stride 1 and padding 1: 16 products instead of 36.
//!
//! This is F(2x2, 3x3) of minimal filtering (Lavin and Gray, "Fast Algorithms for Convolutional Neural Networks",
//! 2016). The four cells of a 2x2 window are `A^T [sum over channels of (B^T d B) * (G g G^T)] A`. `d` are their 4x4
//! input cells, and `g` is the kernel. The sums over channels are 16 dense products, one for each point of the
//! transformed window. The output transform is fused with the operation behind the convolution. Rounding errors are at
//! most about twice those of the direct sums. The gradient of the input is the same with rotated kernels; that of the
//! weights is in `winograd_gradient.rs`.

use std::cell::RefCell;

use super::packed::{Packed, Side};
use super::spin_pool::for_each_task;
use super::tile::{RowTile, SharedBuffer, Tiles, WIDEST, cell_position, part};
use super::winograd_transform::{GradientWindow, InputWindow, OutputWindow, POINTS};
use super::winograd_weights::transformed;

/// Point that contributes to each of the four cells with factor 1. Its sums start from the bias.
const BIAS_POINT: usize = 5;
/// Least number of tasks, where the map is large enough.
const TASKS: usize = 8;
/// Values of a row of sums.
const WIDTH: usize = WIDEST;

/// Transformed weights of a convolution, and accumulator init.
pub(crate) struct Winograd {
    inputs: usize,
    outputs: usize,
    weight: Packed,
    init: Vec<f32>,
}

/// Operation on the four output cells of a window.
#[derive(Clone, Copy)]
pub(crate) enum Epilogue<'a> {
    /// ReLU and 2x2 max-pooling. An odd last row or column is dropped.
    Pool,
    /// Optional sum with a map of the same shape, then optional ReLU.
    Cells { residual: Option<&'a [f32]>, rectified: bool },
}

impl Epilogue<'_> {
    /// Leaves the cells unchanged.
    pub const NONE: Self = Epilogue::Cells { residual: None, rectified: false };
}

#[derive(Default)]
struct Scratch {
    /// Transformed windows `[point][window][channel]`.
    windows: Vec<f32>,
    /// `[point][window][column]`, [`WIDTH`] columns.
    sums: Vec<f32>,
    sources: Vec<*const f32>,
    targets: Vec<*mut f32>,
}

thread_local! {
    static SCRATCH: RefCell<Scratch> = RefCell::default();
}

impl Winograd {
    /// Transforms weights `[o][i][3][3]`, whose `shape` is `[o, i]`. `init` is the initial value of the sums of each output; if it is
    /// empty, they start from zero.
    pub fn new(weight: &[f32], [outputs, inputs]: [usize; 2], init: &[f32], tiles: Tiles) -> Self {
        let weight = transformed(weight, [outputs, inputs], Side::Forward, tiles);
        let init = weight.pad(init);
        Winograd { inputs, outputs, weight, init }
    }

    /// Prepares the gradient of the input of a convolution with these weights, from the gradient of its output.
    pub fn backward(weight: &[f32], [outputs, inputs]: [usize; 2], tiles: Tiles) -> Self {
        let weight = transformed(weight, [outputs, inputs], Side::Backward, tiles);
        let init = weight.pad(&[]);
        Winograd { inputs: outputs, outputs: inputs, weight, init }
    }

    /// Convolves `source` `[batch][row][column][i]` into `target`: `[batch][row / 2][column / 2][o]` where it is
    /// pooled, `[batch][row][column][o]` otherwise.
    ///
    /// # Panics
    /// Lengths of `source`, `target` and the residual differ from the shapes above.
    pub fn run(&self, source: &[f32], [batch, rows, columns]: [usize; 3], epilogue: Epilogue<'_>, target: &mut [f32]) {
        let (grid, cells) = match epilogue {
            Epilogue::Pool => ([rows / 2, columns / 2], rows / 2 * (columns / 2)),
            Epilogue::Cells { .. } => ([rows.div_ceil(2), columns.div_ceil(2)], rows * columns),
        };
        assert_eq!(source.len(), batch * rows * columns * self.inputs);
        assert_eq!(target.len(), batch * cells * self.outputs);
        if let Epilogue::Cells { residual: Some(residual), .. } = epilogue {
            assert_eq!(residual.len(), target.len());
        }
        let windows = batch * grid[0] * grid[1];
        let (panels, shared) = (self.weight.panels(), SharedBuffer::new(target));
        // Each task computes one row of tiles, so intermediate results stay in the cache.
        let parts = windows.div_ceil(self.weight.tiles.rows);
        let panel_parts = TASKS.div_ceil(parts.max(1)).min(panels);
        let window_grid = WindowGrid { rows, columns, grid };
        for_each_task(parts * panel_parts, |index| {
            let windows = part(windows, parts, index / panel_parts);
            let panels = part(panels, panel_parts, index % panel_parts);
            SCRATCH.with_borrow_mut(|scratch| {
                self.task(scratch, source, &window_grid, windows, panels, epilogue, shared);
            });
        });
    }

    #[allow(clippy::too_many_arguments)]
    fn task(
        &self,
        scratch: &mut Scratch,
        source: &[f32],
        window_grid: &WindowGrid,
        windows: std::ops::Range<usize>,
        panels: std::ops::Range<usize>,
        epilogue: Epilogue<'_>,
        target: SharedBuffer,
    ) {
        let (tiles, count, inputs) = (self.weight.tiles, windows.len(), self.inputs);
        let Scratch { windows: transformed, sums, sources, targets } = scratch;
        transformed.resize(POINTS * count * inputs, 0.0);
        sums.resize(POINTS * count * WIDTH, 0.0);
        let (transformed, sums) = (transformed.as_mut_ptr(), sums.as_mut_ptr());
        for (k, window) in windows.clone().enumerate() {
            let target = transformed.wrapping_add(k * inputs);
            let window = window_grid.input_window(source, window, inputs, target, count * inputs);
            // SAFETY: only cells in the map are read, and there is room for the points of all windows.
            unsafe { window.transform(tiles.level) };
        }
        sources.clear();
        targets.clear();
        for row in 0..POINTS * count {
            sources.push(transformed.wrapping_add(row * inputs).cast_const());
            targets.push(sums.wrapping_add(row * WIDTH));
        }
        for panel in panels {
            let first = panel * tiles.width();
            let columns = tiles.width().min(self.outputs - first);
            for point in 0..POINTS {
                let (at, offsets) = (point * count, [point as u32]);
                let tile = RowTile {
                    cells: sources[at..].as_ptr(),
                    cell_stride: 0,
                    offsets: offsets.as_ptr(),
                    offset_count: 1,
                    channels: inputs,
                    panel: self.weight.values[first * self.weight.depth..].as_ptr(),
                    init: if point == BIAS_POINT { self.init[first..].as_ptr() } else { std::ptr::null() },
                    targets: targets[at..].as_ptr(),
                    first: 0,
                    // Whole vectors: there is room for them.
                    columns: columns.next_multiple_of(tiles.lanes),
                };
                // SAFETY: sources are windows of `inputs` values each, targets rows as wide as the widest tile; panel and init are
                // padded to the tile's width.
                unsafe { tiles.row_tile(count, &tile) };
            }
            for (k, window) in windows.clone().enumerate() {
                let sums = sums.wrapping_add(k * WIDTH).cast_const();
                let stride = count * WIDTH;
                let window =
                    window_grid.output_window(window, first, columns, self.outputs, epilogue, target, sums, stride);
                // SAFETY: each target has `columns` values that no other task writes, and so has each residual that there
                // is; sums are of all points, as wide as whole vectors.
                unsafe { window.transform(tiles.level, matches!(epilogue, Epilogue::Pool)) };
            }
        }
    }
}

/// Sizes of maps `[batch][row][column][channel]`, and of the grid of 2x2 windows over each.
pub(super) struct WindowGrid {
    pub rows: usize,
    pub columns: usize,
    /// Rows and columns of windows.
    pub grid: [usize; 2],
}

impl WindowGrid {
    /// Input cells of a window.
    pub fn input_window(
        &self,
        source: &[f32],
        window: usize,
        channels: usize,
        target: *mut f32,
        stride: usize,
    ) -> InputWindow {
        let [image, row, column] = cell_position(window, self.grid);
        // First and end of the cells inside an axis of this `length`, among the four cells from cell `2 index - 1` on.
        let inside = |index: usize, length: usize| [usize::from(index == 0), (length + 1 - 2 * index).min(4)];
        let first = ((image * self.rows + 2 * row) * self.columns + 2 * column) * channels;
        InputWindow {
            corner: source.as_ptr().wrapping_add(first).wrapping_sub((self.columns + 1) * channels),
            line: self.columns * channels,
            channels,
            rows: inside(row, self.rows),
            columns: inside(column, self.columns),
            target,
            stride,
        }
    }

    /// Gradients of the four output cells of a window.
    pub fn gradient_window(
        &self,
        gradient: &[f32],
        window: usize,
        channels: usize,
        target: *mut f32,
        stride: usize,
    ) -> GradientWindow {
        let [image, row, column] = cell_position(window, self.grid);
        let mut cells = [std::ptr::null(); 4];
        for (k, cell) in cells.iter_mut().enumerate() {
            let (row, column) = (2 * row + k / 2, 2 * column + k % 2);
            if row < self.rows && column < self.columns {
                *cell = gradient[((image * self.rows + row) * self.columns + column) * channels..].as_ptr();
            }
        }
        GradientWindow { cells, channels, target, stride }
    }

    /// Output cells of a window: `columns` of their `outputs` channels, from `first` on.
    #[allow(clippy::too_many_arguments)]
    fn output_window(
        &self,
        window: usize,
        first: usize,
        columns: usize,
        outputs: usize,
        epilogue: Epilogue<'_>,
        target: SharedBuffer,
        sums: *const f32,
        stride: usize,
    ) -> OutputWindow {
        let [image, row, column] = cell_position(window, self.grid);
        let (mut targets, mut residual) = ([std::ptr::null_mut(); 4], [std::ptr::null(); 4]);
        let Epilogue::Cells { residual: residual_map, rectified } = epilogue else {
            targets[0] = target.get().wrapping_add(window * outputs + first);
            return OutputWindow { sums, stride, columns, targets, residual, rectified: true };
        };
        for k in 0..4 {
            let (row, column) = (2 * row + k / 2, 2 * column + k % 2);
            if row < self.rows && column < self.columns {
                let at = ((image * self.rows + row) * self.columns + column) * outputs + first;
                targets[k] = target.get().wrapping_add(at);
                residual[k] = residual_map.map_or(std::ptr::null(), |map| map[at..at + columns].as_ptr());
            }
        }
        OutputWindow { sums, stride, columns, targets, residual, rectified }
    }
}
