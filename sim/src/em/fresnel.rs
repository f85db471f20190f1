//! Reflection and transmission at half-spaces and slabs, `e^{+jwt}`, permittivity `eps' - j eps''`.
//!
//! `q = sqrt(eps - sin^2)` on the branch `Im q <= 0`; TE `(c - q)/(c + q)`, TM `(eps c - q)/(eps c + q)`; slab `R = G
//! (1 - P)/(1 - G^2 P)`, `T = (1 - G^2) sqrt(P)/(1 - G^2 P)` with `P = e^{-2 j k d q}`. Only decaying exponentials
//! occur, and `expm1` gives `1 - P`, so that neither thick walls nor foils lose digits.

use num_complex::Complex64;

/// Reflection or transmission coefficients of both polarisations.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Coefficients {
    /// Electric field normal to the plane of incidence.
    pub te: Complex64,
    /// Electric field in the plane of incidence.
    pub tm: Complex64,
}

impl Coefficients {
    /// Returns both coefficients times a real factor.
    pub(crate) fn times(self, factor: f64) -> Self {
        Coefficients { te: self.te * factor, tm: self.tm * factor }
    }
}

/// Reflection and transmission of a slab in air.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Slab {
    /// Reflection.
    pub reflection: Coefficients,
    /// Transmission, from front face to back face.
    pub transmission: Coefficients,
}

/// Computes the normal component of the wave vector inside, over k.
fn normal_index(permittivity: Complex64, cosine: f64) -> Complex64 {
    let square = permittivity - (1.0 - cosine * cosine);
    // The complex root is computed by real ones, which need no angle. The larger part is first, so that nothing
    // cancels.
    let modulus = square.norm_sqr().sqrt();
    if square.re >= 0.0 {
        let re = (0.5 * (modulus + square.re)).sqrt();
        let im = if re > 0.0 { 0.5 * square.im / re } else { 0.0 };
        if im > 0.0 { Complex64::new(-re, -im) } else { Complex64::new(re, im) }
    } else {
        let im = -(0.5 * (modulus - square.re)).sqrt();
        Complex64::new(0.5 * square.im / im, im)
    }
}

/// Computes the reflection of a half-space at the cosine of the angle of incidence.
pub fn half_space(permittivity: Complex64, cosine: f64) -> Coefficients {
    if cosine == 0.0 {
        // All materials have this limit. The quotients have none where the permittivity is 1.
        return Coefficients { te: Complex64::from(-1.0), tm: Complex64::from(-1.0) };
    }
    let q = normal_index(permittivity, cosine);
    let c = Complex64::from(cosine);
    Coefficients { te: (c - q) / (c + q), tm: (permittivity * c - q) / (permittivity * c + q) }
}

/// Computes `e^z - 1` without cancellation near zero.
fn exp_m1(z: Complex64) -> Complex64 {
    let half_sine = (0.5 * z.im).sin();
    Complex64::new(z.re.exp_m1() * z.im.cos() - 2.0 * half_sine * half_sine, z.re.exp() * z.im.sin())
}

/// Computes the coefficients of a slab at the cosine of the angle of incidence.
pub fn slab(permittivity: Complex64, thickness_m: f64, wavenumber_per_m: f64, cosine: f64) -> Slab {
    let face = half_space(permittivity, cosine);
    let exponent = Complex64::new(0.0, -wavenumber_per_m * thickness_m) * normal_index(permittivity, cosine);
    let one_way = exponent.exp();
    let round_trip = one_way * one_way;
    let one_minus = -exp_m1(exponent + exponent);
    let both = |g: Complex64| {
        let denominator = 1.0 - g * g * round_trip;
        if denominator == Complex64::ZERO {
            // This is a slab without thickness at grazing incidence, which has no effect.
            return (Complex64::ZERO, Complex64::ONE);
        }
        (g * one_minus / denominator, (1.0 - g * g) * one_way / denominator)
    };
    let (te, te_through) = both(face.te);
    let (tm, tm_through) = both(face.tm);
    Slab { reflection: Coefficients { te, tm }, transmission: Coefficients { te: te_through, tm: tm_through } }
}

/// Computes the factor of a slab on a field that passes straight through, relative to the same path through air. It is
/// the transmission without the phase of the air that the slab displaces. The path to a person behind a wall and back
/// contains it twice.
pub fn straight_through(permittivity: Complex64, thickness_m: f64, wavenumber_per_m: f64, cosine: f64) -> Coefficients {
    let through = slab(permittivity, thickness_m, wavenumber_per_m, cosine).transmission;
    let air = Complex64::from_polar(1.0, wavenumber_per_m * thickness_m * cosine);
    Coefficients { te: through.te * air, tm: through.tm * air }
}

#[cfg(test)]
mod tests {
    use super::*;

    const K: f64 = 1_257.507_013_171_009;

    /// Reference by the characteristic matrix of a layer (Born and Wolf, section 1.6): `[cos, j sin/p; j p sin, cos]`
    /// with admittances p of TE and TM.
    fn by_matrix(eps: Complex64, thickness_m: f64, cosine: f64, tm: bool) -> (Complex64, Complex64) {
        let q = (eps - (1.0 - cosine * cosine)).sqrt();
        let (inside, air) = if tm { (eps / q, 1.0 / cosine) } else { (q, cosine) };
        let phase = q * (K * thickness_m);
        let (sine, cos) = (phase.sin(), phase.cos());
        let j = Complex64::I;
        let sum = (cos + j * sine / inside * air) * air;
        let other = j * inside * sine + cos * air;
        let through = 2.0 * air / (sum + other);
        // The matrix gives the tangential field. In TM the magnetic field's reflection has our sign.
        let back = (sum - other) / (sum + other);
        (if tm { -back } else { back }, through)
    }

    /// Compares reflections and the two-way factor with the matrix over angles, thicknesses and materials of thin
    /// walls.
    #[test]
    fn thin_walls_reflect_and_transmit_as_the_characteristic_matrix_says() {
        let mut worst: f64 = 0.0;
        for eps in [Complex64::new(2.73, -0.119), Complex64::new(6.31, -0.26), Complex64::new(1.99, -0.113)] {
            for thickness_m in [0.0005, 0.006, 0.0125, 0.018] {
                for degrees in [0.0f64, 20.0, 45.0, 60.0, 80.0] {
                    let cosine = degrees.to_radians().cos();
                    let ours = straight_through(eps, thickness_m, K, cosine);
                    let back = slab(eps, thickness_m, K, cosine).reflection;
                    let air = Complex64::from_polar(1.0, K * thickness_m * cosine);
                    for (got, back, tm) in [(ours.te, back.te, false), (ours.tm, back.tm, true)] {
                        let (reflected, through) = by_matrix(eps, thickness_m, cosine, tm);
                        let expected = through * air;
                        worst = worst.max((40.0 * (got.norm() / expected.norm()).log10()).abs());
                        for (got, expected) in [(got, expected), (back, reflected)] {
                            let is_right = (got - expected).norm() < 1e-10;
                            assert!(is_right, "{eps} {thickness_m} {degrees} {tm}: {got} {expected}");
                        }
                    }
                }
            }
        }
        assert!(worst < 1e-8, "{worst} dB");
    }

    #[test]
    fn air_is_no_wall() {
        let air = straight_through(Complex64::ONE, 0.3, K, 0.4);
        assert!((air.te - 1.0).norm() < 1e-9 && (air.tm - 1.0).norm() < 1e-9);
    }
}

#[cfg(test)]
mod hard_cases {
    use super::*;

    const K: f64 = 1_257.507_013_171_009;

    /// Beyond the critical angle (incidence from the denser medium) the decaying branch is taken, and reflection is
    /// total.
    #[test]
    fn total_reflection_takes_the_branch_that_decays() {
        let inside_out = Complex64::new(1.0 / 6.31, 0.0);
        for cosine in [0.05, 0.3, 0.6] {
            assert!(normal_index(inside_out, cosine).im <= 0.0);
            let face = half_space(inside_out, cosine);
            assert!((face.te.norm() - 1.0).abs() < 1e-12 && (face.tm.norm() - 1.0).abs() < 1e-12);
            assert!(slab(inside_out, 0.05, K, cosine).transmission.te.norm() < 1e-9);
        }
    }

    /// At grazing incidence `1 + G` loses digits where G tends to -1. The terms of the currents do not: both `c (1 +
    /// G)` and G itself keep full precision (`1 + G = 2 c/(c + q)` in TE, `2 eps c/(eps c + q)` in TM).
    #[test]
    fn grazing_incidence_keeps_full_precision_in_the_terms_of_currents() {
        let eps = Complex64::new(7.98, -10.9);
        for cosine in [1e-2, 1e-4, 1e-8, 1e-12, 1e-300, 0.0] {
            let face = half_space(eps, cosine);
            let (q, c) = (normal_index(eps, cosine), Complex64::from(cosine));
            for (g, sum) in [(face.te, 2.0 * c / (c + q)), (face.tm, 2.0 * eps * c / (eps * c + q))] {
                assert!((g - (sum - 1.0)).norm() < 4e-16, "{cosine}: {g}");
                assert!((cosine * (1.0 + g) - cosine * sum).norm() <= 4e-16 * cosine, "{cosine}: {g}");
            }
        }
    }

    /// The reflection of thin slabs is `-j k d (eps - 1)/2` to first order. It is proportional to the thickness down to
    /// a picometre and below, where `1 - P` as a difference would have four digits left.
    #[test]
    fn a_foil_reflects_in_proportion_to_its_thickness() {
        let eps = Complex64::new(5.24, -0.34);
        for thickness_m in [1e-9, 1e-12, 1e-15, 1e-20] {
            let foil = slab(eps, thickness_m, K, 1.0);
            let first_order = Complex64::new(0.0, -0.5 * K * thickness_m) * (eps - 1.0);
            for r in [foil.reflection.te, -foil.reflection.tm] {
                let relative = (r / first_order - 1.0).norm();
                assert!(relative < 1e-12 + 10.0 * K * thickness_m, "{thickness_m}: {r}, {relative:e}");
            }
            assert!((foil.transmission.te - 1.0).norm() < 10.0 * K * thickness_m);
        }
    }
}
