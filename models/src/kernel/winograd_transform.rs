//! Input and output transforms of Winograd's F(2x2, 3x3) (`winograd.rs`), a vector of channels at a time.

use super::level::KernelLevel;
#[cfg(target_arch = "x86_64")]
use super::vector::{Avx2, Avx512};
use super::vector::{Plain, Vector};

/// The 4x4 input cells of a window.
pub(crate) struct InputWindow {
    /// Address of the first cell, also if it lies outside the map.
    pub corner: *const f32,
    /// Values from row to row.
    pub line: usize,
    pub channels: usize,
    /// First and end row and column of the cells that are in the map; the others are zero.
    pub rows: [usize; 2],
    pub columns: [usize; 2],
    /// Address of the points `[point][channel]`, and stride from point to point.
    pub target: *mut f32,
    pub stride: usize,
}

/// Four cells of a convolution from the 16 sums of their transformed window.
pub(crate) struct OutputWindow {
    /// Sums of the window's first point; whole vectors of them.
    pub sums: *const f32,
    /// Stride of `sums` from point to point.
    pub stride: usize,
    pub columns: usize,
    /// Addresses of the four cells, null for none. With pooling only the first is used.
    pub targets: [*mut f32; 4],
    /// Added to the cells, or null.
    pub residual: [*const f32; 4],
    pub rectified: bool,
}

// The code below uses loops instead of closures, because closures are not compiled for the kernel's instructions.

/// The first `left` lanes, or all.
#[inline(always)]
unsafe fn load_up_to<V: Vector>(from: *const f32, left: usize) -> V {
    // SAFETY: as in `transform`.
    unsafe { if left >= V::LANES { V::load(from) } else { V::load_first(from, left) } }
}

/// The first `left` lanes, or all.
#[inline(always)]
unsafe fn store_up_to<V: Vector>(value: V, to: *mut f32, left: usize) {
    // SAFETY: as in `transform`.
    unsafe { if left >= V::LANES { value.store(to) } else { value.store_first(to, left) } }
}

/// `B^T d` of four numbers.
#[inline(always)]
unsafe fn forth<V: Vector>(d: [V; 4]) -> [V; 4] {
    // SAFETY: as in `transform`.
    unsafe { [d[0].subtract(d[2]), d[1].add(d[2]), d[2].subtract(d[1]), d[1].subtract(d[3])] }
}

/// `A^T m` of four numbers.
#[inline(always)]
unsafe fn back<V: Vector>(m: [V; 4]) -> [V; 2] {
    // SAFETY: as in `transform`.
    unsafe { [m[0].add(m[1].add(m[2])), m[1].subtract(m[2]).subtract(m[3])] }
}

/// `B^T d B`. `BORDER` if some cells are not in the map.
#[inline(always)]
#[allow(clippy::needless_range_loop)]
unsafe fn transform<V: Vector, const BORDER: bool>(patch: &InputWindow) {
    // SAFETY: the caller gives addresses that are valid for the sizes of the window, and the processor has the instructions of V.
    unsafe {
        let [top, bottom] = patch.rows;
        let [first, end] = patch.columns;
        for channel in (0..patch.channels).step_by(V::LANES) {
            let left = patch.channels - channel;
            let mut columns = [[V::splat(0.0); 4]; 4];
            for k in 0..4 {
                let mut cells = [V::splat(0.0); 4];
                for row in 0..4 {
                    if !BORDER || (row >= top && row < bottom && k >= first && k < end) {
                        let from = patch.corner.wrapping_add(row * patch.line + k * patch.channels + channel);
                        cells[row] = load_up_to(from, left);
                    }
                }
                columns[k] = forth(cells);
            }
            for row in 0..4 {
                let points = forth([columns[0][row], columns[1][row], columns[2][row], columns[3][row]]);
                for k in 0..4 {
                    store_up_to(points[k], patch.target.add((4 * row + k) * patch.stride + channel), left);
                }
            }
        }
    }
}

/// `A^T m A`, residual sum, and ReLU or pooling.
#[inline(always)]
#[allow(clippy::needless_range_loop)]
unsafe fn transform_back<V: Vector, const POOLED: bool>(window: &OutputWindow) {
    // SAFETY: as in `transform`.
    unsafe {
        let zero = V::splat(0.0);
        for column in (0..window.columns).step_by(V::LANES) {
            let left = window.columns - column;
            let mut columns = [[zero; 2]; 4];
            for k in 0..4 {
                let mut points = [zero; 4];
                for row in 0..4 {
                    points[row] = V::load(window.sums.add((4 * row + k) * window.stride + column));
                }
                columns[k] = back(points);
            }
            let mut cells = [zero; 4];
            for row in 0..2 {
                let pair = back([columns[0][row], columns[1][row], columns[2][row], columns[3][row]]);
                cells[2 * row] = pair[0];
                cells[2 * row + 1] = pair[1];
            }
            if POOLED {
                let largest = cells[3].larger(cells[2].larger(cells[1].larger(cells[0])));
                store_up_to(zero.larger(largest), window.targets[0].add(column), left);
                continue;
            }
            for k in 0..4 {
                if window.targets[k].is_null() {
                    continue;
                }
                if !window.residual[k].is_null() {
                    cells[k] = cells[k].add(load_up_to(window.residual[k].add(column), left));
                }
                if window.rectified {
                    cells[k] = zero.larger(cells[k]);
                }
                store_up_to(cells[k], window.targets[k].add(column), left);
            }
        }
    }
}

macro_rules! kernels {
    ($transform:ident, $back:ident, $v:ty, $(#[$feature:meta])*) => {
        $(#[$feature])*
        unsafe fn $transform<const BORDER: bool>(patch: &InputWindow) {
            // SAFETY: passed on.
            unsafe { transform::<$v, BORDER>(patch) }
        }

        $(#[$feature])*
        unsafe fn $back<const POOLED: bool>(window: &OutputWindow) {
            // SAFETY: passed on.
            unsafe { transform_back::<$v, POOLED>(window) }
        }
    };
}

kernels!(plain_transform, plain_back, Plain,);
#[cfg(target_arch = "x86_64")]
kernels!(avx2_transform, avx2_back, Avx2, #[target_feature(enable = "avx2,fma")]);
#[cfg(target_arch = "x86_64")]
kernels!(
    avx512_transform, avx512_back, Avx512,
    #[target_feature(enable = "avx2,fma,avx512f,avx512bw,avx512dq,avx512vl")]
);

/// The kernel of a level, with a flag as its constant parameter.
macro_rules! by_level {
    ($level:expr, $flag:expr, $avx512:ident, $avx2:ident, $plain:ident) => {
        match ($level, $flag) {
            #[cfg(target_arch = "x86_64")]
            (KernelLevel::Avx512, true) => $avx512::<true>,
            #[cfg(target_arch = "x86_64")]
            (KernelLevel::Avx512, false) => $avx512::<false>,
            #[cfg(target_arch = "x86_64")]
            (KernelLevel::Avx2, true) => $avx2::<true>,
            #[cfg(target_arch = "x86_64")]
            (KernelLevel::Avx2, false) => $avx2::<false>,
            (_, true) => $plain::<true>,
            (_, false) => $plain::<false>,
        }
    };
}

impl InputWindow {
    /// Transforms the cells.
    ///
    /// # Safety
    /// The level is available. Cells in the map and points have `channels` values each.
    pub unsafe fn transform(&self, level: KernelLevel) {
        let border = self.rows != [0, 4] || self.columns != [0, 4];
        let kernel = by_level!(level, border, avx512_transform, avx2_transform, plain_transform);
        // SAFETY: guaranteed by the caller.
        unsafe { kernel(self) }
    }
}

impl OutputWindow {
    /// Transforms the sums back, to the largest of the four cells or zero where they are `pooled`.
    ///
    /// # Safety
    /// The level is available. Targets and residuals that are not null have `columns` values, points whole vectors of them.
    pub unsafe fn transform_back(&self, level: KernelLevel, pooled: bool) {
        let kernel = by_level!(level, pooled, avx512_back, avx2_back, plain_back);
        // SAFETY: guaranteed by the caller.
        unsafe { kernel(self) }
    }
}
