//! Tiles: products of dense and depthwise layers, with one tile of sums in registers at a time.
//!
//! Operands are not copied first. Channels are contiguous in channel-last maps, so a product over channels and offsets needs
//! only the addresses of the cells (Dukhan, "The Indirect Convolution Algorithm", 2019).

use super::level::KernelLevel;
#[cfg(target_arch = "x86_64")]
use super::vector::{Avx2, Avx512};
use super::vector::{Plain, Vector};

/// Columns of the widest tile.
pub(crate) const WIDEST: usize = 32;
const _: () = assert!(2 * Plain::LANES <= WIDEST);
#[cfg(target_arch = "x86_64")]
const _: () = assert!(2 * Avx512::LANES <= WIDEST && 2 * Avx2::LANES <= WIDEST);

/// Tile of a dense product:
/// `target[r][column] = init[column] + sum over offsets and channels of cells[offset][r][channel] panel[offset][channel][column]`.
pub(crate) struct RowTile {
    /// Addresses of the rows' operands, `[offset][row]`.
    pub cells: *const *const f32,
    /// Stride of `cells` from offset to offset.
    pub cell_stride: usize,
    /// Index in the panel of each offset.
    pub offsets: *const u32,
    pub offset_count: usize,
    pub channels: usize,
    /// Weights `[offset][channel][column]`, as wide as the tile.
    pub panel: *const f32,
    /// Accumulator init, as wide as the tile, or null for zero.
    pub init: *const f32,
    /// Addresses of the rows' results.
    pub targets: *const *mut f32,
    /// Column of the results that the tile starts at.
    pub first: usize,
    /// Columns that exist; the panel's others are padding.
    pub columns: usize,
}

/// Tile of a sum of outer products: `target[r][column] += sum over cells of left[cell][r] right[cell][column]`.
pub(crate) struct OuterTile {
    /// First row of the first cell.
    pub left: *const f32,
    /// Stride of `left` from cell to cell.
    pub left_stride: usize,
    /// Address of each cell's operand.
    pub right: *const *const f32,
    /// First column of the tile in each of them.
    pub right_offset: usize,
    pub cells: usize,
    pub target: *mut f32,
    /// Stride of `target` from row to row.
    pub target_stride: usize,
    pub columns: usize,
}

/// Tile of a depthwise product:
/// `target[r][channel] = init[channel] + sum over offsets of cells[offset][r][channel] weights[offset][channel]`.
pub(crate) struct ChannelTile {
    /// Addresses of the rows' operands, `[offset][row]`.
    pub cells: *const *const f32,
    /// Stride of `cells` from offset to offset.
    pub cell_stride: usize,
    /// Index in the weights of each offset.
    pub offsets: *const u32,
    pub offset_count: usize,
    /// `[offset][channel]`.
    pub weights: *const f32,
    /// A value for each channel, or null for zero.
    pub init: *const f32,
    /// Addresses of the rows' results.
    pub targets: *const *mut f32,
    pub channels: usize,
}

impl ChannelTile {
    /// Largest number of rows of a tile.
    pub const ROWS: usize = 6;
}

/// Tile of the weight gradient of a depthwise product:
/// `target[offset][channel] += sum over cells of cells[offset][cell][channel] gradient[cell][channel]`.
pub(crate) struct OffsetTile {
    /// Addresses of the operands, `[offset][cell]`.
    pub cells: *const *const f32,
    pub cell_count: usize,
    pub gradient: *const f32,
    pub target: *mut f32,
    pub channels: usize,
}

#[inline(always)]
#[allow(clippy::needless_range_loop)]
unsafe fn row_tile<V: Vector, const R: usize, const N: usize>(tile: &RowTile) {
    // SAFETY: the caller gives addresses that are valid for the sizes of the tile, and the processor has the instructions of V.
    unsafe {
        let mut sums = [[V::splat(0.0); N]; R];
        if !tile.init.is_null() {
            for n in 0..N {
                let init = V::load(tile.init.add(n * V::LANES));
                for sums in &mut sums {
                    sums[n] = init;
                }
            }
        }
        for offset in 0..tile.offset_count {
            let mut cells = [std::ptr::null::<f32>(); R];
            for (r, cell) in cells.iter_mut().enumerate() {
                *cell = *tile.cells.add(offset * tile.cell_stride + r);
            }
            let mut weights = tile.panel.add(*tile.offsets.add(offset) as usize * tile.channels * N * V::LANES);
            for channel in 0..tile.channels {
                let mut w = [V::splat(0.0); N];
                for (n, w) in w.iter_mut().enumerate() {
                    *w = V::load(weights.add(n * V::LANES));
                }
                for r in 0..R {
                    let value = V::splat(*cells[r].add(channel));
                    for n in 0..N {
                        sums[r][n] = value.multiply_add(w[n], sums[r][n]);
                    }
                }
                weights = weights.add(N * V::LANES);
            }
        }
        let whole = tile.columns >= N * V::LANES;
        for r in 0..R {
            let target = (*tile.targets.add(r)).add(tile.first);
            for n in 0..N {
                let at = n * V::LANES;
                if whole {
                    sums[r][n].store(target.add(at));
                } else if at < tile.columns {
                    sums[r][n].store_first(target.add(at), tile.columns - at);
                }
            }
        }
    }
}

#[inline(always)]
#[allow(clippy::needless_range_loop)]
unsafe fn outer_tile<V: Vector, const R: usize, const N: usize, const WHOLE: bool>(tile: &OuterTile) {
    // SAFETY: as in `row_tile`.
    unsafe {
        let last = tile.columns - (N - 1) * V::LANES;
        let load = |at: *const f32, n: usize| {
            let at = at.add(n * V::LANES);
            if WHOLE || n + 1 < N { V::load(at) } else { V::load_first(at, last) }
        };
        let mut sums = [[V::splat(0.0); N]; R];
        let mut left = tile.left;
        for cell in 0..tile.cells {
            let right = (*tile.right.add(cell)).add(tile.right_offset);
            let mut x = [V::splat(0.0); N];
            for (n, x) in x.iter_mut().enumerate() {
                *x = load(right, n);
            }
            for r in 0..R {
                let value = V::splat(*left.add(r));
                for n in 0..N {
                    sums[r][n] = value.multiply_add(x[n], sums[r][n]);
                }
            }
            left = left.add(tile.left_stride);
        }
        for (r, sums) in sums.iter().enumerate() {
            let target = tile.target.add(r * tile.target_stride);
            for (n, sum) in sums.iter().enumerate() {
                let at = target.add(n * V::LANES);
                let sum = load(target, n).add(*sum);
                if WHOLE || n + 1 < N { sum.store(at) } else { sum.store_first(at, last) }
            }
        }
    }
}

#[inline(always)]
unsafe fn channel_tile<V: Vector, const R: usize>(tile: &ChannelTile) {
    // SAFETY: as in `row_tile`.
    unsafe {
        for channel in (0..tile.channels).step_by(V::LANES) {
            let remaining = tile.channels - channel;
            let load = |from: *const f32| {
                if remaining >= V::LANES { V::load(from) } else { V::load_first(from, remaining) }
            };
            let init = if tile.init.is_null() { V::splat(0.0) } else { load(tile.init.add(channel)) };
            let mut sums = [init; R];
            for offset in 0..tile.offset_count {
                let weight = load(tile.weights.add(*tile.offsets.add(offset) as usize * tile.channels + channel));
                for (r, sum) in sums.iter_mut().enumerate() {
                    *sum =
                        load((*tile.cells.add(offset * tile.cell_stride + r)).add(channel)).multiply_add(weight, *sum);
                }
            }
            for (r, sum) in sums.into_iter().enumerate() {
                let target = (*tile.targets.add(r)).add(channel);
                if remaining >= V::LANES { sum.store(target) } else { sum.store_first(target, remaining) }
            }
        }
    }
}

#[inline(always)]
unsafe fn offset_tile<V: Vector, const R: usize>(tile: &OffsetTile) {
    // SAFETY: as in `row_tile`.
    unsafe {
        for channel in (0..tile.channels).step_by(V::LANES) {
            let remaining = tile.channels - channel;
            let load = |from: *const f32| {
                if remaining >= V::LANES { V::load(from) } else { V::load_first(from, remaining) }
            };
            let mut sums = [V::splat(0.0); R];
            for cell in 0..tile.cell_count {
                let gradient = load(tile.gradient.add(cell * tile.channels + channel));
                for (r, sum) in sums.iter_mut().enumerate() {
                    *sum =
                        load((*tile.cells.add(r * tile.cell_count + cell)).add(channel)).multiply_add(gradient, *sum);
                }
            }
            for (r, sum) in sums.into_iter().enumerate() {
                let target = tile.target.add(r * tile.channels + channel);
                let sum = load(target).add(sum);
                if remaining >= V::LANES { sum.store(target) } else { sum.store_first(target, remaining) }
            }
        }
    }
}

/// Selects the instance of `$f` for a number of rows, which is its first constant parameter.
macro_rules! by_rows {
    ($rows:expr, $f:ident, [], $($r:literal)*) => {
        match $rows { $($r => $f::<$r>,)* _ => unreachable!("a tile of {} rows", $rows) }
    };
    ($rows:expr, $f:ident, [$a:tt], $($r:literal)*) => {
        match $rows { $($r => $f::<$r, $a>,)* _ => unreachable!("a tile of {} rows", $rows) }
    };
    ($rows:expr, $f:ident, [$a:tt, $b:tt], $($r:literal)*) => {
        match $rows { $($r => $f::<$r, $a, $b>,)* _ => unreachable!("a tile of {} rows", $rows) }
    };
}

/// Defines the functions that select the kernels of one level: four kinds of tiles, compiled for each number of rows.
macro_rules! kernels {
    ($rows:ident, $outer:ident, $channels:ident, $offsets:ident, $v:ty, $(#[$feature:meta])*, $($r:literal)*) => {
        fn $rows(rows: usize, wide: bool) -> unsafe fn(&RowTile) {
            $(#[$feature])*
            unsafe fn kernel<const R: usize, const N: usize>(tile: &RowTile) {
                // SAFETY: passed on.
                unsafe { row_tile::<$v, R, N>(tile) }
            }
            if wide { by_rows!(rows, kernel, [2], $($r)*) } else { by_rows!(rows, kernel, [1], $($r)*) }
        }

        fn $outer(rows: usize, columns: usize) -> unsafe fn(&OuterTile) {
            $(#[$feature])*
            unsafe fn kernel<const R: usize, const N: usize, const WHOLE: bool>(tile: &OuterTile) {
                // SAFETY: passed on.
                unsafe { outer_tile::<$v, R, N, WHOLE>(tile) }
            }
            match (columns > <$v>::LANES, columns % <$v>::LANES == 0) {
                (true, true) => by_rows!(rows, kernel, [2, true], $($r)*),
                (true, false) => by_rows!(rows, kernel, [2, false], $($r)*),
                (false, true) => by_rows!(rows, kernel, [1, true], $($r)*),
                (false, false) => by_rows!(rows, kernel, [1, false], $($r)*),
            }
        }

        fn $channels(rows: usize) -> unsafe fn(&ChannelTile) {
            $(#[$feature])*
            unsafe fn kernel<const R: usize>(tile: &ChannelTile) {
                // SAFETY: passed on.
                unsafe { channel_tile::<$v, R>(tile) }
            }
            by_rows!(rows, kernel, [], 1 2 3 4 5 6)
        }

        fn $offsets(rows: usize) -> unsafe fn(&OffsetTile) {
            $(#[$feature])*
            unsafe fn kernel<const R: usize>(tile: &OffsetTile) {
                // SAFETY: passed on.
                unsafe { offset_tile::<$v, R>(tile) }
            }
            by_rows!(rows, kernel, [], $($r)*)
        }
    };
}

kernels!(
    plain_rows, plain_outer, plain_channels, plain_offsets, Plain, , 1 2 3 4 5 6
);
#[cfg(target_arch = "x86_64")]
kernels!(
    avx2_rows, avx2_outer, avx2_channels, avx2_offsets, Avx2,
    #[target_feature(enable = "avx2,fma")],
    1 2 3 4 5 6
);
#[cfg(target_arch = "x86_64")]
kernels!(
    avx512_rows, avx512_outer, avx512_channels, avx512_offsets, Avx512,
    #[target_feature(enable = "avx2,fma,avx512f,avx512bw,avx512dq,avx512vl")],
    1 2 3 4 5 6 7 8 9 10 11 12 13 14
);

/// Selects the kernel of a level: calls the level's function among those of [`kernels`].
macro_rules! select_kernel {
    ($level:expr, $avx512:ident, $avx2:ident, $plain:ident, $($argument:expr),*) => {
        match $level {
            #[cfg(target_arch = "x86_64")]
            KernelLevel::Avx512 => $avx512($($argument),*),
            #[cfg(target_arch = "x86_64")]
            KernelLevel::Avx2 => $avx2($($argument),*),
            _ => $plain($($argument),*),
        }
    };
}

/// Sizes of the tiles of one kernel level, and its kernels.
#[derive(Clone, Copy)]
pub(crate) struct Tiles {
    pub level: KernelLevel,
    /// Values in a vector.
    pub lanes: usize,
    /// Largest number of rows of a tile.
    pub rows: usize,
}

impl Tiles {
    /// Selects the tiles of the level, or of the next lower one that the processor supports.
    pub fn new(level: KernelLevel) -> Self {
        let level = level.available();
        let (lanes, rows) = match level {
            #[cfg(target_arch = "x86_64")]
            KernelLevel::Avx512 => (Avx512::LANES, Avx512::ROWS),
            #[cfg(target_arch = "x86_64")]
            KernelLevel::Avx2 => (Avx2::LANES, Avx2::ROWS),
            _ => (Plain::LANES, Plain::ROWS),
        };
        Tiles { level, lanes, rows }
    }

    /// Columns of a tile: two vectors.
    pub fn width(self) -> usize {
        2 * self.lanes
    }

    /// Computes a tile of `rows` rows, one or two vectors wide.
    ///
    /// # Safety
    /// All addresses in `tile` are valid for its sizes; `init` and `panel` as wide as the tile.
    pub unsafe fn row_tile(self, rows: usize, tile: &RowTile) {
        let wide = tile.columns > self.lanes;
        let kernel = select_kernel!(self.level, avx512_rows, avx2_rows, plain_rows, rows, wide);
        // SAFETY: the level is available, and the caller guarantees the addresses.
        unsafe { kernel(tile) }
    }

    /// Adds to a tile of `rows` rows.
    ///
    /// # Safety
    /// All addresses in `tile` are valid for its sizes.
    pub unsafe fn outer_tile(self, rows: usize, tile: &OuterTile) {
        let kernel = select_kernel!(self.level, avx512_outer, avx2_outer, plain_outer, rows, tile.columns);
        // SAFETY: the level is available, and the caller guarantees the addresses.
        unsafe { kernel(tile) }
    }

    /// Computes a tile of `rows` rows of a depthwise product, [`ChannelTile::ROWS`] at most.
    ///
    /// # Safety
    /// All addresses in `tile` are valid for its sizes.
    pub unsafe fn channel_tile(self, rows: usize, tile: &ChannelTile) {
        let kernel = select_kernel!(self.level, avx512_channels, avx2_channels, plain_channels, rows);
        // SAFETY: the level is available, and the caller guarantees the addresses.
        unsafe { kernel(tile) }
    }

    /// Adds to `offsets` rows of a depthwise product's weight gradient.
    ///
    /// # Safety
    /// All addresses in `tile` are valid for its sizes.
    pub unsafe fn offset_tile(self, offsets: usize, tile: &OffsetTile) {
        let kernel = select_kernel!(self.level, avx512_offsets, avx2_offsets, plain_offsets, offsets);
        // SAFETY: the level is available, and the caller guarantees the addresses.
        unsafe { kernel(tile) }
    }
}

/// Part `index` of `0..length`, divided into `parts` parts whose lengths differ by one at most.
pub(crate) fn part(length: usize, parts: usize, index: usize) -> std::ops::Range<usize> {
    length * index / parts..length * (index + 1) / parts
}

/// Image, row and column of a cell, where each image has this number of rows and columns.
pub(crate) fn cell_position(cell: usize, [rows, columns]: [usize; 2]) -> [usize; 3] {
    [cell / (rows * columns), cell / columns % rows, cell % columns]
}

/// Address of a buffer to which several threads write disjoint parts.
#[derive(Clone, Copy)]
pub(crate) struct SharedBuffer(*mut f32);

// SAFETY: an address. Threads that write through it write disjoint parts.
unsafe impl Send for SharedBuffer {}
// SAFETY: as above.
unsafe impl Sync for SharedBuffer {}

impl SharedBuffer {
    pub fn new(values: &mut [f32]) -> Self {
        SharedBuffer(values.as_mut_ptr())
    }

    pub fn get(&self) -> *mut f32 {
        self.0
    }
}
