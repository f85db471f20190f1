//! Diffraction at straight edges of finite length, in Kirchhoff's approximation.
//!
//! The field behind a screen relative to free space is `1 - (j/2) int int exp(-j pi r^2/2)` over the screen as the way sees it,
//! with lengths across the way in units of `sqrt(lambda d1 d2 / (2 (d1 + d2)))`. In polar coordinates around the way the
//! integral along the radius is elementary and leaves one along the outline (Maggi and Rubinowicz's boundary wave):
//! `1 - W + (1/2 pi) int exp(-j pi r^2/2) dphi`, with `W` 1 where the way meets the screen and 0 where it does not. Each side of
//! the outline contributes by itself; of an endless side remains Fresnel's integral ([`half_plane`]).

use num_complex::Complex64;

use crate::shadow::half_plane;

/// Abscissae and weights of the Gauss-Legendre rule with 16 places on -1..1, those of the positive half.
const GAUSS: [(f64, f64); 8] = [
    (0.095_012_509_837_637_4, 0.189_450_610_455_068_5),
    (0.281_603_550_779_258_9, 0.182_603_415_044_923_6),
    (0.458_016_777_657_227_4, 0.169_156_519_395_002_5),
    (0.617_876_244_402_643_7, 0.149_595_988_816_576_7),
    (0.755_404_408_355_003, 0.124_628_971_255_533_9),
    (0.865_631_202_387_831_7, 0.095_158_511_682_492_8),
    (0.944_575_023_073_232_6, 0.062_253_523_938_647_9),
    (0.989_400_934_991_649_9, 0.027_152_459_411_754_1),
];

/// `(1/2 pi) int exp(-j pi r^2/2) dphi` along a straight side, from the foot of the perpendicular, `distance` away (not
/// negative), to a place `along` the side, of either sign and perhaps infinite.
pub fn side_from_foot(distance: f64, along: f64) -> Complex64 {
    let (p, s) = (distance, along.abs());
    let half = |x: f64| if x.is_infinite() { Complex64::ZERO } else { half_plane(-x) };
    let part = if s <= p {
        quadrature(p, s)
    } else {
        // What lies beyond both of two crossed edges is a product of two of Fresnel's integrals, and the sum of their sides.
        let (at_p, at_s) = (half(p), half(s));
        let other = if s.is_infinite() { Complex64::ZERO } else { quadrature(s, p) };
        let both = if s.is_infinite() { Complex64::ZERO } else { at_s * (0.5 - at_p) };
        0.5 * at_p + both - other
    };
    if along < 0.0 { -part } else { part }
}

/// The same for a place not farther along than the distance, where the integrand is smooth.
fn quadrature(p: f64, s: f64) -> Complex64 {
    if s == 0.0 {
        return Complex64::ZERO;
    }
    let half_angle = 0.5 * s.atan2(p);
    let at = |phi: f64| {
        let r = p / phi.cos();
        Complex64::from_polar(1.0, -0.5 * std::f64::consts::PI * r * r)
    };
    let sum: Complex64 =
        GAUSS.iter().map(|&(x, w)| (at(half_angle * (1.0 - x)) + at(half_angle * (1.0 + x))) * w).sum();
    sum * (half_angle / std::f64::consts::TAU)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The definition, by the midpoint rule over the angle.
    fn slowly(p: f64, s: f64) -> Complex64 {
        let steps = 200_000;
        let step = s.atan2(p) / f64::from(steps);
        let at = |i: i32| {
            let r = p / ((f64::from(i) + 0.5) * step).cos();
            Complex64::from_polar(step, -0.5 * std::f64::consts::PI * r * r)
        };
        (0..steps).map(at).sum::<Complex64>() / std::f64::consts::TAU
    }

    #[test]
    fn sides_are_their_integrals() {
        for (p, s) in [(0.3, 0.2), (0.3, 1.4), (1.2, 1.1), (1.2, 2.5), (0.05, 3.0), (3.0, 2.9), (2.0, 4.0), (4.2, 1.0)]
        {
            let (fast, slow) = (side_from_foot(p, s), slowly(p, s));
            assert!((fast - slow).norm() < 0.004, "{p} {s}: {fast} {slow}");
            assert_eq!(side_from_foot(p, -s), -fast);
        }
    }

    /// An endless edge is a half-plane, and the sum does not jump where a way crosses an edge between its ends.
    #[test]
    fn endless_edges_are_half_planes() {
        for nu in [0.0, 0.4, 1.2, 3.0] {
            let edge = side_from_foot(nu, f64::INFINITY) - side_from_foot(nu, f64::NEG_INFINITY);
            assert!((1.0 - edge - half_plane(nu)).norm() < 1e-12, "{nu}");
        }
        let crossing = side_from_foot(1e-9, 2.0) - side_from_foot(1e-9, -0.7);
        assert!((crossing - 0.5).norm() < 1e-6, "{crossing}");
        let beyond = side_from_foot(1e-9, 2.0) - side_from_foot(1e-9, 0.7);
        assert!(beyond.norm() < 1e-6, "{beyond}");
    }
}
