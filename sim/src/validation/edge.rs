//! Edge diffraction: Fresnel's integral, the knife edge, and Sommerfeld's half-plane, as references for the diffraction
//! in scenes.

use std::f64::consts::{FRAC_PI_2, PI};

use num_complex::Complex64;

/// `C(x) + j S(x) = int_0^x exp(j pi t^2/2) dt`: a power series near zero, and beyond it a continued fraction (of the
/// complementary error function, by Lentz).
pub fn fresnel_integral(x: f64) -> Complex64 {
    let magnitude = x.abs();
    let value = if magnitude < 1.5 { fresnel_series(magnitude) } else { fresnel_fraction(magnitude) };
    if x < 0.0 { -value } else { value }
}

/// Power series `x sum (j pi x^2/2)^n / (n! (2n + 1))`.
fn fresnel_series(x: f64) -> Complex64 {
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

/// Continued fraction of the complementary error function, by Lentz's algorithm.
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

/// Field past a knife edge relative to the free field, `e^{+jwt}`: `(1 + j)/2 int_nu^inf exp(-j pi t^2/2) dt`. It is
/// exactly a half at the shadow boundary, oscillates about one in the lit region, decays in the shadow, and is smooth
/// throughout. Its phase is relative to the straight path.
pub fn knife_edge(nu: f64) -> Complex64 {
    let rest = Complex64::new(0.5, 0.5) - fresnel_integral(nu);
    Complex64::new(0.5, 0.5) * rest.conj()
}

/// Sommerfeld's exact field of a plane wave of unit strength at a conducting half-plane, in cylinder coordinates about
/// its edge. Both angles are measured from the screen's lit face. The field is the electric field along the edge
/// (`soft`, zero on the screen) or otherwise the magnetic field. The phase is zero at the edge.
pub fn half_plane(k_rho: f64, angle_rad: f64, incidence_rad: f64, soft: bool) -> Complex64 {
    let wave = |angle: f64| {
        // e^{j pi/4}/sqrt(pi) int_a^inf exp(-j t^2) dt is the knife edge at nu = a sqrt(2/pi).
        let a = -(2.0 * k_rho).sqrt() * (0.5 * angle).cos();
        Complex64::from_polar(1.0, k_rho * angle.cos()) * knife_edge(a * (2.0 / PI).sqrt())
    };
    let (incident, reflected) = (wave(angle_rad - incidence_rad), wave(angle_rad + incidence_rad));
    if soft { incident - reflected } else { incident + reflected }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::paths::edge_field::side_integral;

    fn db(v: Complex64) -> f64 {
        20.0 * v.norm().log10()
    }

    /// C(1), S(1) and the limit (Abramowitz and Stegun, table 7.7), and the agreement of both forms where they meet.
    #[test]
    fn fresnel_integrals_have_their_tabulated_values() {
        let one = fresnel_integral(1.0);
        assert!((one - Complex64::new(0.779_893_400_376_823, 0.438_259_147_390_355)).norm() < 1e-14);
        assert!((fresnel_integral(1e6) - Complex64::new(0.5, 0.5)).norm() < 1e-6);
        assert!((fresnel_series(1.5) - fresnel_fraction(1.5)).norm() < 1e-13);
        assert_eq!(fresnel_integral(-0.3), -fresnel_integral(0.3));
        assert_eq!(fresnel_integral(0.0), Complex64::ZERO);
    }

    /// The field meets the screen's boundary condition, is free far in the lit region, and is half of the free field on
    /// the boundary.
    #[test]
    fn the_half_plane_is_dark_on_a_screen_and_half_at_the_boundary() {
        let (k_rho, incidence) = (900.0, 1.1);
        assert!(half_plane(k_rho, 0.0, incidence, true).norm() < 1e-12);
        let lit = half_plane(k_rho, PI + incidence - 0.8, incidence, true);
        assert!(db(lit).abs() < 0.3);
        let edge = db(half_plane(k_rho, PI + incidence, incidence, false));
        assert!((edge + 6.02).abs() < 0.2, "{edge}");
    }

    /// The field is exact. It satisfies the wave equation (by differences of fourth order). On a screen's faces it
    /// vanishes, or its normal derivative does. At the edge it grows no faster than the root of the distance.
    #[test]
    fn the_half_plane_solves_its_equation_and_its_boundary_conditions() {
        for soft in [true, false] {
            for incidence in [0.4, 1.1, FRAC_PI_2, 2.5] {
                let u = |x: f64, y: f64| half_plane(x.hypot(y), y.atan2(x).rem_euclid(2.0 * PI), incidence, soft);
                for (x, y) in [(1.0, 2.0), (-3.0, 0.7), (-2.0, -2.5), (4.0, -6.0), (20.0, -1.0), (-0.3, 0.2)] {
                    let h = 0.01;
                    let second = |at: &dyn Fn(f64) -> Complex64| {
                        (16.0 * (at(h) + at(-h)) - at(2.0 * h) - at(-2.0 * h) - 30.0 * at(0.0)) / (12.0 * h * h)
                    };
                    let laplacian = second(&|d| u(x + d, y)) + second(&|d| u(x, y + d));
                    assert!((laplacian + u(x, y)).norm() < 1e-5, "{soft} {incidence} at {x} {y}");
                }
                for k_rho in [0.3, 4.0, 900.0] {
                    for face in [0.0, 2.0 * PI] {
                        let inward = if face == 0.0 { 1e-6 } else { -1e-6 };
                        let (on, off) = (
                            half_plane(k_rho, face, incidence, soft),
                            half_plane(k_rho, face + inward, incidence, soft),
                        );
                        let error = if soft { on.norm() } else { (off - on).norm() / (1e-6 * k_rho) };
                        assert!(error < if soft { 1e-12 } else { 1e-2 }, "{soft} {incidence} {k_rho} {face}: {error}");
                    }
                }
            }
        }
        assert!(half_plane(1e-8, 4.0, 1.0, true).norm() < 1e-3);
    }

    /// The diffraction in scenes is the mean of both polarisations, from the lit region to deep shadow.
    #[test]
    fn scenes_diffract_as_the_half_plane_does() {
        let of_scenes = crate::diffraction::half_plane;
        for half in [knife_edge(0.0), of_scenes(0.0)] {
            assert!((half - 0.5).norm() < 1e-12, "{half}");
        }
        assert!((of_scenes(40.0) - 1.0).norm() < 0.01 && of_scenes(-40.0).norm() < 0.01);
        let wavelength_m = 299_792_458.0 / 60e9;
        for (behind_m, incidence) in [(0.1, FRAC_PI_2), (0.5, 1.2), (2.0, 0.9), (5.0, 2.2)] {
            let k_rho = 2.0 * PI * behind_m / wavelength_m;
            for i in -400..=400 {
                let past = f64::from(i) * 1e-3;
                let angle = PI + incidence + past;
                let both = [true, false].map(|soft| half_plane(k_rho, angle, incidence, soft));
                // Relative to the plane wave's field there, whose phase is zero at the edge.
                let free = Complex64::from_polar(1.0, k_rho * (angle - incidence).cos());
                let exact = 0.5 * (both[0] + both[1]) / free;
                let nu = (4.0 * k_rho / PI).sqrt() * (0.5 * past).sin();
                let edge = side_integral(nu.abs(), [f64::NEG_INFINITY, f64::INFINITY]);
                let by_outline = if nu > 0.0 { edge } else { 1.0 - edge };
                for scene in [of_scenes(-nu), by_outline] {
                    assert!((scene - exact).norm() < 0.005, "{behind_m} m, {past} rad: {scene} {exact}");
                }
            }
        }
    }
}
