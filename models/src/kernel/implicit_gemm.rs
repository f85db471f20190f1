//! Implicit GEMM: dense products over all cells of a grid, for convolutions, the gradients of their inputs, and linear layers.

use std::cell::RefCell;

use super::packed::Packed;
use super::spin_pool::for_each_task;
use super::tile::{RowTile, SharedBuffer, cell_position, part};

/// Position of one cell of a convolution kernel.
#[derive(Debug, Clone, Copy)]
pub(crate) struct KernelOffset {
    /// Rows and columns from the corner of a window in the source.
    pub shift: [isize; 2],
    /// Index of its weights in the packed weights.
    pub index: u32,
}

/// Product of a source with weights over the cells of a grid. Defines which source cells a grid cell reads, and which target cell
/// it writes.
#[derive(Debug, Clone)]
pub(crate) struct ImplicitGemm {
    pub batch: usize,
    /// Rows and columns of the grid.
    pub grid: [usize; 2],
    /// Rows and columns of the source.
    pub source: [usize; 2],
    /// Channels of the source.
    pub channels: usize,
    /// The source row of grid row `r` is `source_step r + source_start`, plus the kernel offset; columns alike.
    pub source_step: isize,
    pub source_start: [isize; 2],
    pub offsets: Vec<KernelOffset>,
    /// Rows and columns of the target.
    pub target: [usize; 2],
    /// The target row of grid row `r` is `target_step r + target_start`; columns alike.
    pub target_step: usize,
    pub target_start: [usize; 2],
}

/// Tiles of a task: enough to reuse weights, few enough to stay in the second-level cache.
const TILES_PER_TASK: usize = 16;
/// Least number of tasks, where the product is large enough.
const TASKS: usize = 16;
/// Sources with fewer channels are copied into patches, because loops over so few channels cost more than the copy.
const FEW_CHANNELS: usize = 8;
/// Number of packed weights up to which they stay in the second-level cache over all tiles.
const SMALL_WEIGHTS: usize = 1 << 16;

impl ImplicitGemm {
    /// Product over the rows of a matrix `[row][channel]`.
    pub fn rows(rows: usize, channels: usize) -> Self {
        ImplicitGemm {
            batch: rows,
            grid: [1; 2],
            source: [1; 2],
            channels,
            source_step: 1,
            source_start: [0; 2],
            offsets: vec![KernelOffset { shift: [0; 2], index: 0 }],
            target: [1; 2],
            target_step: 1,
            target_start: [0; 2],
        }
    }

    /// Number of cells.
    pub fn cells(&self) -> usize {
        self.batch * self.grid[0] * self.grid[1]
    }

    /// Returns whether the cells at all offsets are gathered into patches before the product.
    pub fn is_gathered(&self) -> bool {
        let all_in_order = || self.offsets.iter().enumerate().all(|(k, offset)| offset.index as usize == k);
        self.channels < FEW_CHANNELS && self.offsets.len() > 1 && all_in_order()
    }

    /// Writes the addresses `[offset][cell]` of the source cells that `cells` read to `addresses`. Padding has the address of
    /// `zeros`. With `patches`, the source cells at all offsets are copied there, and each cell has one address.
    pub fn addresses(
        &self,
        cells: std::ops::Range<usize>,
        source: &[f32],
        zeros: &[f32],
        mut patches: Option<&mut [f32]>,
        addresses: &mut [*const f32],
    ) {
        let (count, offsets) = (cells.len(), self.offsets.len());
        let [rows, columns] = [self.source[0] as isize, self.source[1] as isize];
        let step = self.source_step;
        let mut first = 0;
        while first < count {
            // Cells of one row of the grid.
            let [image, row, column] = cell_position(cells.start + first, self.grid);
            let run_length = (self.grid[1] - column).min(count - first);
            if let Some(patches) = &mut patches {
                let length = offsets * self.channels;
                let patches = &mut patches[first * length..(first + run_length) * length];
                for (k, patch) in patches.chunks_exact_mut(length).enumerate() {
                    self.gather([image, row, column + k], source, patch);
                }
                first += run_length;
                continue;
            }
            for (t, offset) in self.offsets.iter().enumerate() {
                let source_row = step * row as isize + self.source_start[0] + offset.shift[0];
                let corner = step * column as isize + self.source_start[1] + offset.shift[1];
                // Cells from `left` to `right` read the source, the others padding.
                let inside = (0..rows).contains(&source_row);
                let steps_to =
                    |distance: isize| if distance <= 0 { 0 } else { ((distance + step - 1) / step) as usize };
                let right = if inside { steps_to(columns - corner).min(run_length) } else { 0 };
                let left = steps_to(-corner).min(right);
                let line = (image as isize * rows + source_row) * columns + corner;
                let index = |k: usize| (line + step * k as isize) as usize * self.channels;
                let addresses = &mut addresses[t * count + first..][..run_length];
                addresses[..left].fill(zeros.as_ptr());
                addresses[right..].fill(zeros.as_ptr());
                if left < right {
                    // Both ends are checked, so the cells between them are in bounds.
                    let start = source[index(left)..=index(right - 1) + self.channels - 1].as_ptr();
                    let stride = step as usize * self.channels;
                    for (k, address) in addresses[left..right].iter_mut().enumerate() {
                        *address = start.wrapping_add(k * stride);
                    }
                }
            }
            first += run_length;
        }
        if let Some(patches) = patches {
            for (address, patch) in addresses.iter_mut().zip(patches.chunks_exact(offsets * self.channels)) {
                *address = patch.as_ptr();
            }
        }
    }

    /// Copies the source cells at all offsets of a cell. Neighbouring offsets in one row are also contiguous in the source.
    fn gather(&self, [image, row, column]: [usize; 3], source: &[f32], patch: &mut [f32]) {
        let [rows, columns] = [self.source[0] as isize, self.source[1] as isize];
        let row = self.source_step * row as isize + self.source_start[0];
        let column = self.source_step * column as isize + self.source_start[1];
        let neighbours = self.offsets.chunk_by(|a, b| a.shift[0] == b.shift[0] && a.shift[1] + 1 == b.shift[1]);
        let mut patch = patch;
        for offsets in neighbours {
            let (values, rest) = patch.split_at_mut(offsets.len() * self.channels);
            patch = rest;
            let [y, x] = offsets[0].shift;
            let (row, column) = (row + y, column + x);
            let end = column + offsets.len() as isize;
            let line = (image as isize * rows + row) * columns;
            if !(0..rows).contains(&row) || end <= 0 || column >= columns {
                values.fill(0.0);
            } else if column >= 0 && end <= columns {
                let from = &source[(line + column) as usize * self.channels..][..values.len()];
                values.iter_mut().zip(from).for_each(|(v, &s)| *v = s);
            } else {
                for (value, column) in values.chunks_exact_mut(self.channels).zip(column..) {
                    if (0..columns).contains(&column) {
                        value.copy_from_slice(&source[(line + column) as usize * self.channels..][..self.channels]);
                    } else {
                        value.fill(0.0);
                    }
                }
            }
        }
    }

    /// Writes the addresses of the results of `cells` to `targets`.
    pub fn targets(
        &self,
        cells: std::ops::Range<usize>,
        outputs: usize,
        target: SharedBuffer,
        targets: &mut Vec<*mut f32>,
    ) {
        targets.clear();
        let mut cell = cells.start;
        while cell < cells.end {
            let [image, row, column] = cell_position(cell, self.grid);
            let run_length = (self.grid[1] - column).min(cells.end - cell);
            let row = self.target_step * row + self.target_start[0];
            let column = self.target_step * column + self.target_start[1];
            let first = ((image * self.target[0] + row) * self.target[1] + column) * outputs;
            let start = target.get().wrapping_add(first);
            targets.extend((0..run_length).map(|k| start.wrapping_add(k * self.target_step * outputs)));
            cell += run_length;
        }
    }

    /// Computes `target = init + source * weights` for all cells. `init` has a value for each column of the weights.
    ///
    /// Target cells that no grid cell writes stay unchanged. Every cell is summed in the same order on any thread.
    ///
    /// # Panics
    /// Lengths of `source`, `target` and `weights` differ from the sizes of the product.
    pub fn run(&self, source: &[f32], weights: &Packed, init: Option<&[f32]>, target: &mut [f32]) {
        let cells = self.cells();
        if cells == 0 {
            return;
        }
        let tiles = weights.tiles;
        assert_eq!(source.len(), self.batch * self.source[0] * self.source[1] * self.channels);
        assert_eq!(target.len(), self.batch * self.target[0] * self.target[1] * weights.columns);
        assert!(self.offsets.iter().all(|t| (t.index as usize + 1) * self.channels <= weights.depth));
        let init = init.map(|values| weights.pad(values));
        let zeros = vec![0.0f32; self.channels];
        let row_tasks = cells.div_ceil(TILES_PER_TASK * tiles.rows);
        let panels = weights.panels();
        let panel_tasks = TASKS.div_ceil(row_tasks).min(panels);
        let shared = SharedBuffer::new(target);
        for_each_task(row_tasks * panel_tasks, |index| {
            let cells = part(cells, row_tasks, index / panel_tasks);
            let panels = part(panels, panel_tasks, index % panel_tasks);
            SCRATCH.with_borrow_mut(|scratch| {
                self.task(scratch, cells, panels, source, weights, init.as_deref(), &zeros, shared);
            });
        });
    }

    /// Computes the products of some cells with some panels of the weights.
    #[allow(clippy::too_many_arguments)]
    fn task(
        &self,
        scratch: &mut Scratch,
        cells: std::ops::Range<usize>,
        panels: std::ops::Range<usize>,
        source: &[f32],
        weights: &Packed,
        init: Option<&[f32]>,
        zeros: &[f32],
        target: SharedBuffer,
    ) {
        let tiles = weights.tiles;
        let gathered = self.is_gathered();
        let (offsets, channels) =
            if gathered { (1, self.offsets.len() * self.channels) } else { (self.offsets.len(), self.channels) };
        scratch.offsets.clear();
        scratch.offsets.extend(self.offsets.iter().map(|t| t.index));
        if gathered {
            // A patch holds the values at all offsets, in order.
            scratch.offsets[0] = 0;
        }
        scratch.addresses.resize(offsets * cells.len(), std::ptr::null());
        scratch.patches.resize(if gathered { channels * cells.len() } else { 0 }, 0.0);
        self.targets(cells.clone(), weights.columns, target, &mut scratch.targets);
        let patches = gathered.then_some(&mut scratch.patches[..]);
        self.addresses(cells.clone(), source, zeros, patches, &mut scratch.addresses);
        let row_tiles = cells.len().div_ceil(tiles.rows);
        let compute = |tile: usize, panel: usize| {
            let rows = part(cells.len(), row_tiles, tile);
            let first = panel * tiles.width();
            let row_tile = RowTile {
                cells: scratch.addresses[rows.start..].as_ptr(),
                cell_stride: cells.len(),
                offsets: scratch.offsets.as_ptr(),
                offset_count: offsets,
                channels,
                panel: weights.values[first * weights.depth..].as_ptr(),
                init: init.map_or(std::ptr::null(), |s| s[first..].as_ptr()),
                // Addresses of the rows in the target; the tile adds the panel's first column.
                targets: scratch.targets[rows.start..].as_ptr(),
                first,
                columns: tiles.width().min(weights.columns - first),
            };
            // SAFETY: addresses are of whole cells of the source, of zeros or of patches, each `channels` long; panel
            // and init are padded to the tile's width; no other task writes to these rows and columns.
            unsafe { tiles.row_tile(rows.len(), &row_tile) };
        };
        if weights.values.len() <= SMALL_WEIGHTS {
            (0..row_tiles).for_each(|tile| panels.clone().for_each(|panel| compute(tile, panel)));
        } else {
            panels.for_each(|panel| (0..row_tiles).for_each(|tile| compute(tile, panel)));
        }
    }
}

/// Scratch memory of a task, reused by the next one.
#[derive(Default)]
struct Scratch {
    offsets: Vec<u32>,
    addresses: Vec<*const f32>,
    targets: Vec<*mut f32>,
    patches: Vec<f32>,
}

thread_local! {
    static SCRATCH: RefCell<Scratch> = RefCell::default();
}
