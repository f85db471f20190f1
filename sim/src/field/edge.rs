//! Edges: Fresnel's integral, the knife edge, and Sommerfeld's half-plane beside it.

use std::f64::consts::{FRAC_PI_2, PI};

use num_complex::Complex64;

/// `C(x) + j S(x) = int_0^x exp(j pi t^2/2) dt`: a power series near zero, a continued fraction (of the complementary error
/// function, by Lentz) beyond.
pub fn fresnel_integral(x: f64) -> Complex64 {
    let magnitude = x.abs();
    let value = if magnitude < 1.5 { fresnel_series(magnitude) } else { fresnel_fraction(magnitude) };
    if x < 0.0 { -value } else { value }
}

fn fresnel_series(x: f64) -> Complex64 {
    // x sum (j pi x^2/2)^n / (n! (2n + 1))
    let step = Complex64::new(0.0, FRAC_PI_2 * x * x);
    let mut term = Complex64::from(x);
    let mut sum = term;
    for n in 1..60 {
        term *= step / f64::from(n);
        let part = term / f64::from(2 * n + 1);
        sum += part;
        if part.norm() < 1e-17 * sum.norm() {
            break;
        }
    }
    sum
}

fn fresnel_fraction(x: f64) -> Complex64 {
    let square = PI * x * x;
    let mut b = Complex64::new(1.0, -square);
    let mut c = Complex64::from(1e300);
    let mut d = b.inv();
    let mut h = d;
    let mut n = -1.0;
    for _ in 2..200 {
        n += 2.0;
        let a = -n * (n + 1.0);
        b += 4.0;
        d = (a * d + b).inv();
        c = b + a / c;
        let change = c * d;
        h *= change;
        if (change - 1.0).norm() < 1e-16 {
            break;
        }
    }
    h *= Complex64::new(x, -x);
    Complex64::new(0.5, 0.5) * (1.0 - Complex64::from_polar(1.0, 0.5 * square) * h)
}

/// Field past a knife edge over the free field, `e^{+jwt}`: `(1 + j)/2 int_nu^inf exp(-j pi t^2/2) dt`. Exactly a half at the
/// shadow's boundary, rippling about one in the light, dying in the shadow; smooth throughout. Its phase is relative to the
/// straight path.
pub fn knife_edge(nu: f64) -> Complex64 {
    let rest = Complex64::new(0.5, 0.5) - fresnel_integral(nu);
    Complex64::new(0.5, 0.5) * rest.conj()
}

/// The knife edge's parameter from the detour that the way over the edge is, m, negative in the light:
/// `nu = 2 sqrt(detour/lambda)`.
pub fn knife_edge_parameter(detour_m: f64, shadowed: bool, wavelength_m: f64) -> f64 {
    let nu = 2.0 * (detour_m.max(0.0) / wavelength_m).sqrt();
    if shadowed { nu } else { -nu }
}

/// Sommerfeld's exact field of a plane wave of unit strength behind a conducting half-plane, at cylinder coordinates about
/// its edge, both angles from the screen's lit face: electric field along the edge (`soft`, zero on the screen) or magnetic.
/// Phase zero at the edge.
pub fn half_plane(k_rho: f64, angle_rad: f64, incidence_rad: f64, soft: bool) -> Complex64 {
    let part = |angle: f64| {
        // e^{j pi/4}/sqrt(pi) int_a^inf exp(-j t^2) dt is the knife edge at nu = a sqrt(2/pi).
        let a = -(2.0 * k_rho).sqrt() * (0.5 * angle).cos();
        Complex64::from_polar(1.0, k_rho * angle.cos()) * knife_edge(a * (2.0 / PI).sqrt())
    };
    let (incident, reflected) = (part(angle_rad - incidence_rad), part(angle_rad + incidence_rad));
    if soft { incident - reflected } else { incident + reflected }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn db(v: Complex64) -> f64 {
        20.0 * v.norm().log10()
    }

    /// C(1), S(1) and the limit (Abramowitz and Stegun, table 7.7), and the two forms where they meet.
    #[test]
    fn fresnel_integrals_have_their_tabulated_values() {
        let one = fresnel_integral(1.0);
        assert!((one - Complex64::new(0.779_893_400_376_823, 0.438_259_147_390_355)).norm() < 1e-14);
        assert!((fresnel_integral(1e6) - Complex64::new(0.5, 0.5)).norm() < 1e-6);
        assert!((fresnel_series(1.5) - fresnel_fraction(1.5)).norm() < 1e-13);
        assert_eq!(fresnel_integral(-0.3), -fresnel_integral(0.3));
        assert_eq!(fresnel_integral(0.0), Complex64::ZERO);
    }

    /// The screen's own condition, the free field far in the light, and half of it on the boundary.
    #[test]
    fn the_half_plane_is_dark_on_a_screen_and_half_at_the_boundary() {
        let (k_rho, incidence) = (900.0, 1.1);
        assert!(half_plane(k_rho, 0.0, incidence, true).norm() < 1e-12);
        let lit = half_plane(k_rho, PI + incidence - 0.8, incidence, true);
        assert!(db(lit).abs() < 0.3);
        let edge = db(half_plane(k_rho, PI + incidence, incidence, false));
        assert!((edge + 6.02).abs() < 0.2, "{edge}");
    }

    /// Six decibels at the boundary, and the exact field of the half-plane within 0.3 dB across it, for both polarisations:
    /// from well in the light to where the screen's own reflection, which a weight does not know of, is a thirtieth of what is
    /// left, and that is the deeper the further behind.
    #[test]
    fn the_knife_edge_is_the_half_plane_across_the_boundary() {
        assert!((db(knife_edge(0.0)) + 6.0206).abs() < 1e-3);
        let wavelength_m = 299_792_458.0 / 60e9;
        for (behind_m, shadow_db) in [(0.5, -12.0), (2.0, -17.0), (5.0, -21.0)] {
            let k_rho = std::f64::consts::TAU * behind_m / wavelength_m;
            let incidence = FRAC_PI_2;
            let mut worst: f64 = 0.0;
            for i in -400..=400 {
                let past = f64::from(i) * 1e-3;
                let detour_m = behind_m * (1.0 - past.cos());
                let weight = knife_edge(knife_edge_parameter(detour_m, past > 0.0, wavelength_m));
                if db(weight) < shadow_db {
                    continue;
                }
                for soft in [true, false] {
                    let exact = half_plane(k_rho, PI + incidence + past, incidence, soft);
                    worst = worst.max((db(weight) - db(exact)).abs());
                }
            }
            assert!(worst < 0.3, "{behind_m} m: {worst} dB");
        }
    }
}
