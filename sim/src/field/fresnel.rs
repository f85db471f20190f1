//! Reflection and transmission at half-spaces and slabs, `e^{+jwt}`, permittivity `eps' - j eps''`.
//!
//! `q = sqrt(eps - sin^2)` on the branch `Im q <= 0`; TE `(c - q)/(c + q)`, TM `(eps c - q)/(eps c + q)`; slab
//! `R = G (1 - P)/(1 - G^2 P)`, `T = (1 - G^2) sqrt(P)/(1 - G^2 P)` with `P = e^{-2 j k d q}`. Only decaying exponentials
//! occur, and `1 - P` comes from `expm1`, so that neither thick walls nor foils lose digits.

use num_complex::Complex64;

/// Reflection coefficients for both polarisations.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reflection {
    /// Electric field normal to the plane of incidence.
    pub te: Complex64,
    /// Electric field in the plane of incidence.
    pub tm: Complex64,
}

/// Reflection and transmission of a slab in air.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Slab {
    /// Reflection.
    pub reflection: Reflection,
    /// Transmission, from front face to back face.
    pub transmission: Reflection,
}

/// Normal component of the wave vector inside, over k.
fn normal_index(permittivity: Complex64, cosine: f64) -> Complex64 {
    let q = (permittivity - (1.0 - cosine * cosine)).sqrt();
    if q.im > 0.0 { -q } else { q }
}

/// Reflection of a half-space at the cosine of the angle of incidence.
pub fn half_space(permittivity: Complex64, cosine: f64) -> Reflection {
    let q = normal_index(permittivity, cosine);
    let c = Complex64::from(cosine);
    Reflection { te: (c - q) / (c + q), tm: (permittivity * c - q) / (permittivity * c + q) }
}

/// `e^z - 1` without cancellation near zero.
fn exp_m1(z: Complex64) -> Complex64 {
    let half_sine = (0.5 * z.im).sin();
    Complex64::new(z.re.exp_m1() * z.im.cos() - 2.0 * half_sine * half_sine, z.re.exp() * z.im.sin())
}

/// Slab of this thickness at the cosine of the angle of incidence.
pub fn slab(permittivity: Complex64, thickness_m: f64, wavenumber_per_m: f64, cosine: f64) -> Slab {
    let face = half_space(permittivity, cosine);
    let exponent = Complex64::new(0.0, -wavenumber_per_m * thickness_m) * normal_index(permittivity, cosine);
    let one_way = exponent.exp();
    let round_trip = one_way * one_way;
    let one_minus = -exp_m1(exponent + exponent);
    let both = |g: Complex64| {
        let denominator = 1.0 - g * g * round_trip;
        if denominator == Complex64::ZERO {
            // No thickness at grazing incidence: nothing is there.
            return (Complex64::ZERO, Complex64::ONE);
        }
        (g * one_minus / denominator, (1.0 - g * g) * one_way / denominator)
    };
    let (te, te_through) = both(face.te);
    let (tm, tm_through) = both(face.tm);
    Slab { reflection: Reflection { te, tm }, transmission: Reflection { te: te_through, tm: tm_through } }
}
