//! Least-squares taps: weights of a few cells of a grid whose tones sum to a tone between them.

use super::held::POSITIONS;

/// Regularisation of the normal equations where there are fewer points than taps.
const LEAST_EIGENVALUE: f64 = 1e-6;

/// Point of the domain to which a grid is transformed: a sample of a chirp, or a chirp of a run.
#[derive(Debug, Clone, Copy)]
pub(super) struct Point {
    /// Factor of the transformed grid at the point.
    pub(super) weight: f64,
    /// Angle at the point of a tone one cell up, rad.
    pub(super) angle: f64,
}

/// Computes the taps at quantised positions between cells, `[position][tap]`, with the least squared error over all
/// points. `wanted` gives the desired sum at a point from the point and the tone's angle there, rad; it must be even in
/// both together.
pub(super) fn fitted_taps<const N: usize>(points: &[Point], wanted: impl Fn(&Point, f64) -> f64) -> Vec<[f32; N]> {
    let sum = |of: &dyn Fn(&Point) -> f64| -> f64 { points.iter().map(of).sum() };
    let products: [f64; N] =
        std::array::from_fn(|distance| sum(&|p| p.weight * p.weight * (distance as f64 * p.angle).cos()));
    let matrix: [[f64; N]; N] = std::array::from_fn(|k| {
        std::array::from_fn(|l| {
            let ridge = if k == l { LEAST_EIGENVALUE * products[0] } else { 0.0 };
            products[k.abs_diff(l)] + ridge
        })
    });
    let root = cholesky(&matrix);
    let taps_at = |position: u32| {
        // Distance of a tap from the tone, cells.
        let distance = |tap: usize| tap as f64 - 0.5 * N as f64 + f64::from(position) / f64::from(POSITIONS);
        let right: [f64; N] = std::array::from_fn(|tap| sum(&|p| p.weight * wanted(p, distance(tap) * p.angle)));
        solved(&root, right).map(|tap| tap as f32)
    };
    (0..POSITIONS).map(taps_at).collect()
}

/// Returns the Cholesky factor of a positive definite matrix: the lower triangle whose product with its transpose is
/// the matrix.
fn cholesky<const N: usize>(matrix: &[[f64; N]; N]) -> [[f64; N]; N] {
    let mut root = [[0.0; N]; N];
    for row in 0..N {
        for column in 0..=row {
            let known: f64 = (0..column).map(|k| root[row][k] * root[column][k]).sum();
            let rest = matrix[row][column] - known;
            root[row][column] = if row == column { rest.sqrt() } else { rest / root[column][column] };
        }
    }
    root
}

/// Solves the equations whose matrix has this Cholesky factor.
fn solved<const N: usize>(root: &[[f64; N]; N], right: [f64; N]) -> [f64; N] {
    let mut x = right;
    for row in 0..N {
        let known: f64 = (0..row).map(|k| root[row][k] * x[k]).sum();
        x[row] = (x[row] - known) / root[row][row];
    }
    for row in (0..N).rev() {
        let known: f64 = (row + 1..N).map(|k| root[k][row] * x[k]).sum();
        x[row] = (x[row] - known) / root[row][row];
    }
    x
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equations_are_solved() {
        let matrix = [[4.0, 1.0, 0.5], [1.0, 3.0, 0.2], [0.5, 0.2, 2.0]];
        let x = solved(&cholesky(&matrix), [1.0, -2.0, 0.7]);
        for (row, right) in matrix.iter().zip([1.0, -2.0, 0.7]) {
            let left: f64 = row.iter().zip(x).map(|(a, x)| a * x).sum();
            assert!((left - right).abs() < 1e-14, "{left} {right}");
        }
    }
}
