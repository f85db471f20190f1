//! Diffraction at straight edges of finite length, in Kirchhoff's approximation.
//!
//! The field behind a screen relative to free space is `1 - (j/2) int int exp(-j pi r^2/2)` over the screen projected
//! across the path. Lengths across the path are in units of `sqrt(lambda d1 d2 / (2 (d1 + d2)))`. In polar coordinates
//! around the path the radial integral is elementary. One integral along the outline remains (Maggi and Rubinowicz's
//! boundary wave): `1 - W + (1/2 pi) int exp(-j pi r^2/2) dphi`, where `W` is 1 if the path meets the screen and 0
//! otherwise. Each side of the outline contributes separately; for an infinite side the contribution is Fresnel's
//! integral ([`half_plane`]).

use std::f64::consts::TAU;

use num_complex::Complex64;

use crate::diffraction::{fresnel_phasor, half_plane};

/// Positive abscissae and weights of the Gauss-Legendre rules with 4, 8 and 16 nodes on -1..1.
const GAUSS_4: [(f64, f64); 2] =
    [(0.339_981_043_584_856_3, 0.652_145_154_862_546_1), (0.861_136_311_594_052_6, 0.347_854_845_137_453_9)];
const GAUSS_8: [(f64, f64); 4] = [
    (0.183_434_642_495_649_8, 0.362_683_783_378_362),
    (0.525_532_409_916_329, 0.313_706_645_877_887_3),
    (0.796_666_477_413_626_7, 0.222_381_034_453_374_5),
    (0.960_289_856_497_536_2, 0.101_228_536_290_376_3),
];
const GAUSS_16: [(f64, f64); 8] = [
    (0.095_012_509_837_637_4, 0.189_450_610_455_068_5),
    (0.281_603_550_779_258_9, 0.182_603_415_044_923_6),
    (0.458_016_777_657_227_4, 0.169_156_519_395_002_5),
    (0.617_876_244_402_643_7, 0.149_595_988_816_576_7),
    (0.755_404_408_355_003, 0.124_628_971_255_533_9),
    (0.865_631_202_387_831_7, 0.095_158_511_682_492_8),
    (0.944_575_023_073_232_6, 0.062_253_523_938_647_9),
    (0.989_400_934_991_649_9, 0.027_152_459_411_754_1),
];
/// Lengths of a side up to which the rules with 4 and 8 nodes have errors below 1e-4.
const SHORT: f64 = 1.5;
const MEDIUM: f64 = 2.5;

/// Contribution of a part of a straight side: `(1/2 pi) int exp(-j pi r^2/2) dphi` between two positions on it.
/// Positions are measured from the foot of the perpendicular, which is `distance` away (not negative). They may have
/// either sign and be infinite.
pub fn side_integral(distance: f64, [low, high]: [f64; 2]) -> Complex64 {
    let at_foot = half_plane(-distance);
    from_foot(distance, at_foot, high) - from_foot(distance, at_foot, low)
}

/// Same integral from the foot to a position, given the half-plane field at the distance of the foot.
fn from_foot(distance: f64, at_foot: Complex64, along: f64) -> Complex64 {
    let (p, s) = (distance, along.abs());
    let part = if s.is_infinite() {
        0.5 * at_foot
    } else if s <= p {
        quadrature(p, s)
    } else {
        // The field beyond both of two crossed edges is a product of two Fresnel integrals, and equals the sum of their
        // sides.
        0.5 * at_foot + half_plane(-s) * (0.5 - at_foot) - quadrature(s, p)
    };
    if along < 0.0 { -part } else { part }
}

/// Same integral for a position not farther along than the distance, where the integrand is smooth. With `t` along the
/// side it is `exp(-j pi p^2/2) int_0^s exp(-j pi t^2/2) p / (p^2 + t^2) dt`.
fn quadrature(p: f64, s: f64) -> Complex64 {
    if s == 0.0 {
        return Complex64::ZERO;
    }
    let at = |t: f64| {
        let square = t * t;
        fresnel_phasor(square) * (p / (p * p + square))
    };
    let half = 0.5 * s;
    let symmetric_pair = |&(x, weight): &(f64, f64)| (at(half * (1.0 - x)) + at(half * (1.0 + x))) * weight;
    let sum: Complex64 = if s <= SHORT {
        GAUSS_4.iter().map(symmetric_pair).sum()
    } else if s <= MEDIUM {
        GAUSS_8.iter().map(symmetric_pair).sum()
    } else {
        GAUSS_16.iter().map(symmetric_pair).sum()
    };
    fresnel_phasor(p * p) * sum * (half / TAU)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Evaluates the definition by the midpoint rule over the angle.
    fn by_midpoint_rule(p: f64, s: f64) -> Complex64 {
        let steps = 200_000;
        let step = s.atan2(p) / f64::from(steps);
        let at = |i: i32| {
            let r = p / ((f64::from(i) + 0.5) * step).cos();
            Complex64::from_polar(step, -0.5 * std::f64::consts::PI * r * r)
        };
        (0..steps).map(at).sum::<Complex64>() / std::f64::consts::TAU
    }

    #[test]
    fn contributions_of_sides_are_their_integrals() {
        for (p, s) in [(0.3, 0.2), (0.3, 1.4), (1.2, 1.1), (1.2, 2.5), (0.05, 3.0), (3.0, 2.9), (2.0, 4.0), (4.2, 1.0)]
        {
            let (fast, slow) = (side_integral(p, [0.0, s]), by_midpoint_rule(p, s));
            assert!((fast - slow).norm() < 0.004, "{p} {s}: {fast} {slow}");
            assert_eq!(side_integral(p, [0.0, -s]), -fast);
        }
    }

    /// Tests every rule over all lengths for which it is used, within the reach of edges.
    #[test]
    fn rules_of_few_nodes_are_the_integral() {
        for s in [0.1, 0.7, 1.49, 1.51, 2.0, 2.49, 2.51, 3.3, 4.24] {
            for p in [s, 1.2 * s, 3.0 * s] {
                let (fast, slow) = (quadrature(p, s), by_midpoint_rule(p, s));
                assert!((fast - slow).norm() < 1e-4, "{p} {s}: {fast} {slow}");
            }
        }
    }

    /// An infinite edge is a half-plane, and the sum is continuous where a path crosses an edge between its ends.
    #[test]
    fn endless_edges_are_half_planes() {
        for nu in [0.0, 0.4, 1.2, 3.0] {
            let edge = side_integral(nu, [f64::NEG_INFINITY, f64::INFINITY]);
            assert!((1.0 - edge - half_plane(nu)).norm() < 1e-12, "{nu}");
        }
        let crossing = side_integral(1e-9, [-0.7, 2.0]);
        assert!((crossing - 0.5).norm() < 1e-6, "{crossing}");
        let beyond = side_integral(1e-9, [0.7, 2.0]);
        assert!(beyond.norm() < 1e-6, "{beyond}");
    }
}
