//! Transforms of Winograd's F(2x2, 3x3) (`winograd.rs`) of inputs, outputs, weights, and the gradients of outputs and weights. Each
//! handles a vector of channels or weights at a time.

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

/// The four output cells of a window, computed from the 16 sums of its transform.
pub(crate) struct OutputWindow {
    /// Sums of the window's first point, padded to whole vectors.
    pub sums: *const f32,
    /// Stride of `sums` from point to point.
    pub stride: usize,
    pub columns: usize,
    /// Addresses of the four cells, null for those outside the map. With pooling, only the first is used.
    pub targets: [*mut f32; 4],
    /// Addresses of the values that are added to the cells, or null.
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

/// Several kernels as vector lanes, and their points.
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

/// Loads `remaining` values into the first lanes, or a whole vector if there are enough.
#[inline(always)]
unsafe fn load_up_to<V: Vector>(from: *const f32, remaining: usize) -> V {
    // SAFETY: as in `transform_input`.
    unsafe { if remaining >= V::LANES { V::load(from) } else { V::load_first(from, remaining) } }
}

/// Stores the first `remaining` lanes, or all if there are fewer.
#[inline(always)]
unsafe fn store_up_to<V: Vector>(value: V, to: *mut f32, remaining: usize) {
    // SAFETY: as in `transform_input`.
    unsafe { if remaining >= V::LANES { value.store(to) } else { value.store_first(to, remaining) } }
}

/// `B^T d` of four numbers.
#[inline(always)]
unsafe fn input_transform<V: Vector>(d: [V; 4]) -> [V; 4] {
    // SAFETY: as in `transform_input`.
    unsafe { [d[0].subtract(d[2]), d[1].add(d[2]), d[2].subtract(d[1]), d[1].subtract(d[3])] }
}

/// `A^T m` of four numbers.
#[inline(always)]
unsafe fn output_transform<V: Vector>(m: [V; 4]) -> [V; 2] {
    // SAFETY: as in `transform_input`.
    unsafe { [m[0].add(m[1].add(m[2])), m[1].subtract(m[2]).subtract(m[3])] }
}

/// `A y` of two numbers: the transpose of [`output_transform`].
#[inline(always)]
unsafe fn gradient_transform<V: Vector>(y: [V; 2]) -> [V; 4] {
    // SAFETY: as in `transform_input`.
    unsafe { [y[0], y[0].add(y[1]), y[0].subtract(y[1]), V::splat(0.0).subtract(y[1])] }
}

/// `A y A^T`. `BORDER` if some cells are not in the map.
#[inline(always)]
#[allow(clippy::needless_range_loop)]
unsafe fn transform_gradient<V: Vector, const BORDER: bool>(window: &GradientWindow) {
    // SAFETY: as in `transform_input`.
    unsafe {
        for channel in (0..window.channels).step_by(V::LANES) {
            let remaining = window.channels - channel;
            let mut cells = [V::splat(0.0); 4];
            for k in 0..4 {
                if !BORDER || !window.cells[k].is_null() {
                    cells[k] = load_up_to(window.cells[k].add(channel), remaining);
                }
            }
            let columns = [gradient_transform([cells[0], cells[2]]), gradient_transform([cells[1], cells[3]])];
            for row in 0..4 {
                let points = gradient_transform([columns[0][row], columns[1][row]]);
                for k in 0..4 {
                    store_up_to(points[k], window.target.add((4 * row + k) * window.stride + channel), remaining);
                }
            }
        }
    }
}

/// `G g` of three numbers.
#[inline(always)]
unsafe fn weight_transform<V: Vector>(g: [V; 3]) -> [V; 4] {
    // SAFETY: as in `transform_input`.
    unsafe {
        let (half, zero, outer) = (V::splat(0.5), V::splat(0.0), g[0].add(g[2]));
        [g[0], outer.add(g[1]).multiply_add(half, zero), outer.subtract(g[1]).multiply_add(half, zero), g[2]]
    }
}

/// `G^T u` of four numbers.
#[inline(always)]
unsafe fn weight_gradient_transform<V: Vector>(u: [V; 4]) -> [V; 3] {
    // SAFETY: as in `transform_input`.
    unsafe {
        let (half, zero, inner) = (V::splat(0.5), V::splat(0.0), u[1].add(u[2]));
        let outer = [inner.multiply_add(half, u[0]), inner.multiply_add(half, u[3])];
        [outer[0], u[1].subtract(u[2]).multiply_add(half, zero), outer[1]]
    }
}

/// `G g G^T` of cells to points, or `G^T u G` of points to cells if `TRANSPOSED`.
#[inline(always)]
#[allow(clippy::needless_range_loop)]
unsafe fn transform_kernels<V: Vector, const TRANSPOSED: bool>(kernels: &Kernels) {
    // SAFETY: as in `transform_input`.
    unsafe {
        for first in (0..kernels.count).step_by(V::LANES) {
            let remaining = kernels.count - first;
            let cells = kernels.cells.add(first);
            let points = kernels.points.add(first);
            if TRANSPOSED {
                let mut columns = [[V::splat(0.0); 3]; 4];
                for k in 0..4 {
                    let mut u = [V::splat(0.0); 4];
                    for row in 0..4 {
                        u[row] = load_up_to(points.add((4 * row + k) * kernels.stride), remaining);
                    }
                    columns[k] = weight_gradient_transform(u);
                }
                for row in 0..3 {
                    let g =
                        weight_gradient_transform([columns[0][row], columns[1][row], columns[2][row], columns[3][row]]);
                    for k in 0..3 {
                        store_up_to(g[k], cells.add((3 * row + k) * Kernels::WIDTH), remaining);
                    }
                }
                continue;
            }
            let mut columns = [[V::splat(0.0); 4]; 3];
            for k in 0..3 {
                let mut g = [V::splat(0.0); 3];
                for row in 0..3 {
                    g[row] = load_up_to(cells.add((3 * row + k) * Kernels::WIDTH), remaining);
                }
                columns[k] = weight_transform(g);
            }
            for row in 0..4 {
                let u = weight_transform([columns[0][row], columns[1][row], columns[2][row]]);
                for k in 0..4 {
                    store_up_to(u[k], points.add((4 * row + k) * kernels.stride), remaining);
                }
            }
        }
    }
}

/// `B^T d B`. `BORDER` if some cells are not in the map.
#[inline(always)]
#[allow(clippy::needless_range_loop)]
unsafe fn transform_input<V: Vector, const BORDER: bool>(window: &InputWindow) {
    // SAFETY: the caller gives addresses that are valid for the sizes of the window, and the processor has the instructions of V.
    unsafe {
        let [top, bottom] = window.rows;
        let [first, end] = window.columns;
        for channel in (0..window.channels).step_by(V::LANES) {
            let remaining = window.channels - channel;
            let mut columns = [[V::splat(0.0); 4]; 4];
            for k in 0..4 {
                let mut cells = [V::splat(0.0); 4];
                for row in 0..4 {
                    if !BORDER || (row >= top && row < bottom && k >= first && k < end) {
                        let from = window.corner.wrapping_add(row * window.line + k * window.channels + channel);
                        cells[row] = load_up_to(from, remaining);
                    }
                }
                columns[k] = input_transform(cells);
            }
            for row in 0..4 {
                let points = input_transform([columns[0][row], columns[1][row], columns[2][row], columns[3][row]]);
                for k in 0..4 {
                    store_up_to(points[k], window.target.add((4 * row + k) * window.stride + channel), remaining);
                }
            }
        }
    }
}

/// `A^T m A`, sum with the residual, and ReLU or pooling.
#[inline(always)]
#[allow(clippy::needless_range_loop)]
unsafe fn transform_output<V: Vector, const POOLED: bool>(window: &OutputWindow) {
    // SAFETY: as in `transform_input`.
    unsafe {
        let zero = V::splat(0.0);
        for column in (0..window.columns).step_by(V::LANES) {
            let remaining = window.columns - column;
            let mut columns = [[zero; 2]; 4];
            for k in 0..4 {
                let mut points = [zero; 4];
                for row in 0..4 {
                    points[row] = V::load(window.sums.add((4 * row + k) * window.stride + column));
                }
                columns[k] = output_transform(points);
            }
            let mut cells = [zero; 4];
            for row in 0..2 {
                let pair = output_transform([columns[0][row], columns[1][row], columns[2][row], columns[3][row]]);
                cells[2 * row] = pair[0];
                cells[2 * row + 1] = pair[1];
            }
            if POOLED {
                let largest = cells[3].larger(cells[2].larger(cells[1].larger(cells[0])));
                store_up_to(zero.larger(largest), window.targets[0].add(column), remaining);
                continue;
            }
            for k in 0..4 {
                if window.targets[k].is_null() {
                    continue;
                }
                if !window.residual[k].is_null() {
                    cells[k] = cells[k].add(load_up_to(window.residual[k].add(column), remaining));
                }
                if window.rectified {
                    cells[k] = zero.larger(cells[k]);
                }
                store_up_to(cells[k], window.targets[k].add(column), remaining);
            }
        }
    }
}

/// Selects the function that is compiled for the instructions of a level, with a flag as its constant parameter.
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
        let kernel = by_level!(level, border, transform_input, InputWindow);
        // SAFETY: guaranteed by the caller.
        unsafe { kernel(self) }
    }
}

impl OutputWindow {
    /// Transforms the sums to the four cells, or if `pooled` to the largest of the four cells and zero.
    ///
    /// # Safety
    /// The level is available. Targets and residuals that are not null have `columns` values, points whole vectors of them.
    pub unsafe fn transform(&self, level: KernelLevel, pooled: bool) {
        let kernel = by_level!(level, pooled, transform_output, OutputWindow);
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
    /// Computes the points from the cells or, if `transposed`, the gradients of the cells from those of the points.
    ///
    /// # Safety
    /// The level is available. There are `count` values at each cell and at each point.
    pub unsafe fn transform(&self, level: KernelLevel, transposed: bool) {
        let kernel = by_level!(level, transposed, transform_kernels, Kernels);
        // SAFETY: guaranteed by the caller.
        unsafe { kernel(self) }
    }
}
