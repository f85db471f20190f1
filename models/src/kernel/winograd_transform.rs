//! Transforms of Winograd's F(2x2, 3x3) (`winograd.rs`), a vector of channels or weights at a time: inputs, outputs, weights, and the
//! gradients of outputs and weights.

use super::level::KernelLevel;
use super::tile::WIDEST;
#[cfg(target_arch = "x86_64")]
use super::vector::{Avx2, Avx512};
use super::vector::{Plain, Vector};

/// Number of points of a transformed window.
pub(crate) const POINTS: usize = 16;

/// The 4x4 input cells of a window.
pub(crate) struct InputWindow {
    /// Address of the first cell, also if it lies outside the map.
    pub corner: *const f32,
    /// Stride from row to row.
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

/// The gradients of the four output cells of a window.
pub(crate) struct GradientWindow {
    /// Addresses of the cells, null for those that are not in the map.
    pub cells: [*const f32; 4],
    pub channels: usize,
    /// Address of the points `[point][channel]`, and stride from point to point.
    pub target: *mut f32,
    pub stride: usize,
}

/// Kernels side by side, and their points.
pub(crate) struct Kernels {
    /// Values `[cell][kernel]`, [`Kernels::WIDTH`] from cell to cell.
    pub cells: *mut f32,
    /// Values `[point][kernel]`, and stride from point to point.
    pub points: *mut f32,
    pub stride: usize,
    pub count: usize,
}

impl Kernels {
    /// Largest number of kernels.
    pub const WIDTH: usize = WIDEST;
    /// Number of values of a kernel.
    pub const CELLS: usize = 9;
}

// The code below uses loops instead of closures, because closures are not compiled for the kernel's instructions.

/// Loads the first `left` lanes, or all.
#[inline(always)]
unsafe fn load_up_to<V: Vector>(from: *const f32, left: usize) -> V {
    // SAFETY: as in `transform`.
    unsafe { if left >= V::LANES { V::load(from) } else { V::load_first(from, left) } }
}

/// Stores the first `left` lanes, or all.
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

/// `A y` of two numbers: the transpose of [`back`].
#[inline(always)]
unsafe fn back_transposed<V: Vector>(y: [V; 2]) -> [V; 4] {
    // SAFETY: as in `transform`.
    unsafe { [y[0], y[0].add(y[1]), y[0].subtract(y[1]), V::splat(0.0).subtract(y[1])] }
}

/// `A y A^T`. `BORDER` if some cells are not in the map.
#[inline(always)]
#[allow(clippy::needless_range_loop)]
unsafe fn transform_gradient<V: Vector, const BORDER: bool>(window: &GradientWindow) {
    // SAFETY: as in `transform`.
    unsafe {
        for channel in (0..window.channels).step_by(V::LANES) {
            let left = window.channels - channel;
            let mut cells = [V::splat(0.0); 4];
            for k in 0..4 {
                if !BORDER || !window.cells[k].is_null() {
                    cells[k] = load_up_to(window.cells[k].add(channel), left);
                }
            }
            let columns = [back_transposed([cells[0], cells[2]]), back_transposed([cells[1], cells[3]])];
            for row in 0..4 {
                let points = back_transposed([columns[0][row], columns[1][row]]);
                for k in 0..4 {
                    store_up_to(points[k], window.target.add((4 * row + k) * window.stride + channel), left);
                }
            }
        }
    }
}

/// `G g` of three numbers.
#[inline(always)]
unsafe fn weights_forth<V: Vector>(g: [V; 3]) -> [V; 4] {
    // SAFETY: as in `transform`.
    unsafe {
        let (half, zero, outer) = (V::splat(0.5), V::splat(0.0), g[0].add(g[2]));
        [g[0], outer.add(g[1]).multiply_add(half, zero), outer.subtract(g[1]).multiply_add(half, zero), g[2]]
    }
}

/// `G^T u` of four numbers.
#[inline(always)]
unsafe fn weights_back<V: Vector>(u: [V; 4]) -> [V; 3] {
    // SAFETY: as in `transform`.
    unsafe {
        let (half, zero, inner) = (V::splat(0.5), V::splat(0.0), u[1].add(u[2]));
        let outer = [inner.multiply_add(half, u[0]), inner.multiply_add(half, u[3])];
        [outer[0], u[1].subtract(u[2]).multiply_add(half, zero), outer[1]]
    }
}

/// `G g G^T` of cells to points, or `G^T u G` of points to cells if `BACK`.
#[inline(always)]
#[allow(clippy::needless_range_loop)]
unsafe fn transform_kernels<V: Vector, const BACK: bool>(kernels: &Kernels) {
    // SAFETY: as in `transform`.
    unsafe {
        for first in (0..kernels.count).step_by(V::LANES) {
            let left = kernels.count - first;
            let cells = kernels.cells.add(first);
            let points = kernels.points.add(first);
            if BACK {
                let mut columns = [[V::splat(0.0); 3]; 4];
                for k in 0..4 {
                    let mut u = [V::splat(0.0); 4];
                    for row in 0..4 {
                        u[row] = load_up_to(points.add((4 * row + k) * kernels.stride), left);
                    }
                    columns[k] = weights_back(u);
                }
                for row in 0..3 {
                    let g = weights_back([columns[0][row], columns[1][row], columns[2][row], columns[3][row]]);
                    for k in 0..3 {
                        store_up_to(g[k], cells.add((3 * row + k) * Kernels::WIDTH), left);
                    }
                }
                continue;
            }
            let mut columns = [[V::splat(0.0); 4]; 3];
            for k in 0..3 {
                let mut g = [V::splat(0.0); 3];
                for row in 0..3 {
                    g[row] = load_up_to(cells.add((3 * row + k) * Kernels::WIDTH), left);
                }
                columns[k] = weights_forth(g);
            }
            for row in 0..4 {
                let u = weights_forth([columns[0][row], columns[1][row], columns[2][row]]);
                for k in 0..4 {
                    store_up_to(u[k], points.add((4 * row + k) * kernels.stride), left);
                }
            }
        }
    }
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

/// The function of a level, compiled for its instructions, with a flag as its constant parameter.
macro_rules! by_level {
    ($level:expr, $flag:expr, $function:ident, $window:ty) => {{
        #[cfg(target_arch = "x86_64")]
        #[target_feature(enable = "avx2,fma,avx512f,avx512bw,avx512dq,avx512vl")]
        unsafe fn avx512<const FLAG: bool>(window: &$window) {
            // SAFETY: passed on.
            unsafe { $function::<Avx512, FLAG>(window) }
        }
        #[cfg(target_arch = "x86_64")]
        #[target_feature(enable = "avx2,fma")]
        unsafe fn avx2<const FLAG: bool>(window: &$window) {
            // SAFETY: passed on.
            unsafe { $function::<Avx2, FLAG>(window) }
        }
        match ($level, $flag) {
            #[cfg(target_arch = "x86_64")]
            (KernelLevel::Avx512, true) => avx512::<true>,
            #[cfg(target_arch = "x86_64")]
            (KernelLevel::Avx512, false) => avx512::<false>,
            #[cfg(target_arch = "x86_64")]
            (KernelLevel::Avx2, true) => avx2::<true>,
            #[cfg(target_arch = "x86_64")]
            (KernelLevel::Avx2, false) => avx2::<false>,
            (_, true) => $function::<Plain, true>,
            (_, false) => $function::<Plain, false>,
        }
    }};
}

impl InputWindow {
    /// Transforms the cells.
    ///
    /// # Safety
    /// The level is available. Cells in the map and points have `channels` values each.
    pub unsafe fn transform(&self, level: KernelLevel) {
        let border = self.rows != [0, 4] || self.columns != [0, 4];
        let kernel = by_level!(level, border, transform, InputWindow);
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
        let kernel = by_level!(level, pooled, transform_back, OutputWindow);
        // SAFETY: guaranteed by the caller.
        unsafe { kernel(self) }
    }
}

impl GradientWindow {
    /// Transforms the cells.
    ///
    /// # Safety
    /// The level is available. Cells that are not null and points have `channels` values each.
    pub unsafe fn transform(&self, level: KernelLevel) {
        let border = self.cells.iter().any(|cell| cell.is_null());
        let kernel = by_level!(level, border, transform_gradient, GradientWindow);
        // SAFETY: guaranteed by the caller.
        unsafe { kernel(self) }
    }
}

impl Kernels {
    /// Writes the points of the cells, or the cells of the gradients at the points if `back`.
    ///
    /// # Safety
    /// The level is available. There are `count` values at each cell and at each point.
    pub unsafe fn transform(&self, level: KernelLevel, back: bool) {
        let kernel = by_level!(level, back, transform_kernels, Kernels);
        // SAFETY: guaranteed by the caller.
        unsafe { kernel(self) }
    }
}
