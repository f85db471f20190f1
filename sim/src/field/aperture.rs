//! Far field of an aperture, after Ling, Chou and Lee, "Shooting and bouncing rays: calculating the RCS of an arbitrarily
//! shaped cavity" (IEEE T-AP 37(2), 1989): the field in the plane z = 0, by which rays leave a cavity, is replaced by a sheet of
//! magnetic current `K = 2 E x z`, and
//!
//! `A_theta = (jk/2pi) int (E_x cos phi + E_y sin phi) e^{j(k_x x + k_y y)} dx dy`,
//! `A_phi = (jk/2pi) int (-E_x sin phi + E_y cos phi) cos theta e^{j(k_x x + k_y y)} dx dy`,
//!
//! so that `E_s = e^{-jkr}/r (theta A_theta + phi A_phi)`.

use std::f64::consts::PI;

use glam::DVec2;
use num_complex::Complex64;

use super::triangle;

/// A ray tube's cross-section with the aperture: a triangle over which the field has constant strength and linear phase.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tube {
    /// Corners in the aperture's plane, m.
    pub corners: [DVec2; 3],
    /// Phase of the field at the corners, rad.
    pub phases_rad: [f64; 3],
    /// `E_x` and `E_y` at phase zero.
    pub field: [Complex64; 2],
}

/// `(A_theta, A_phi)` of an aperture's tubes in a direction, angles from z and from x.
pub fn far_field(tubes: &[Tube], wavenumber_per_m: f64, theta_rad: f64, phi_rad: f64) -> (Complex64, Complex64) {
    let ((st, ct), (sp, cp)) = (theta_rad.sin_cos(), phi_rad.sin_cos());
    let k = DVec2::new(cp, sp) * (wavenumber_per_m * st);
    let (mut along_theta, mut along_phi) = (Complex64::ZERO, Complex64::ZERO);
    for tube in tubes {
        let [a, b, c] = tube.corners;
        let [p, q, r] = [0, 1, 2].map(|i| tube.phases_rad[i] + k.dot(tube.corners[i]));
        let integral = triangle::integral(p, q, r) * (b - a).perp_dot(c - a).abs();
        let [x, y] = tube.field;
        along_theta += integral * (x * cp + y * sp);
        along_phi += integral * (y * cp - x * sp) * ct;
    }
    let factor = Complex64::new(0.0, 0.5 * wavenumber_per_m / PI);
    (along_theta * factor, along_phi * factor)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::triangle::sinc;

    /// A plane wave that falls on a rectangular opening and whose specular image leaves it, in both polarisations, over cuts
    /// of any fineness: `A = (jk/2pi) E a b sinc sinc` in closed form.
    #[test]
    fn a_plane_wave_on_a_rectangle_has_its_closed_form_in_both_polarisations() {
        let k = 1_257.507_013_171_009;
        let (width, height) = (0.031, 0.047);
        let (ti, fi): (f64, f64) = (0.5, 0.8);
        // Incident from (theta_i, phi_i): phase k . r with k towards the source, as the paper's convention has it.
        let ki = DVec2::new(ti.sin() * fi.cos(), ti.sin() * fi.sin()) * k;
        // E_i = -phi^ or theta^, tangential parts.
        let polarisations = [[fi.sin(), -fi.cos()], [ti.cos() * fi.cos(), ti.cos() * fi.sin()]];
        for cuts in [1usize, 3, 16] {
            for polarisation in polarisations {
                let field = polarisation.map(Complex64::from);
                let mut tubes = Vec::new();
                let at = |i: usize, j: usize| {
                    DVec2::new(width * (i as f64 / cuts as f64 - 0.5), height * (j as f64 / cuts as f64 - 0.5))
                };
                for i in 0..cuts {
                    for j in 0..cuts {
                        let [a, b, c, d] = [at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)];
                        for corners in [[a, b, c], [a, c, d]] {
                            tubes.push(Tube { corners, phases_rad: corners.map(|p| ki.dot(p)), field });
                        }
                    }
                }
                for (theta, phi) in [(0.5, 0.8), (0.0, 0.0), (0.5, 0.8 + PI), (0.3, -1.0), (1.2, 2.0)] {
                    let (theta, phi): (f64, f64) = (theta, phi);
                    let sum = ki + DVec2::new(phi.cos(), phi.sin()) * (k * theta.sin());
                    let area = width * height * sinc(0.5 * sum.x * width) * sinc(0.5 * sum.y * height);
                    let scale = Complex64::new(0.0, 0.5 * k / PI) * area;
                    let [x, y] = polarisation;
                    let expected = (
                        scale * (x * phi.cos() + y * phi.sin()),
                        scale * ((y * phi.cos() - x * phi.sin()) * theta.cos()),
                    );
                    let (along_theta, along_phi) = far_field(&tubes, k, theta, phi);
                    let peak = 0.5 * k / PI * width * height;
                    let error = (along_theta - expected.0).norm().max((along_phi - expected.1).norm()) / peak;
                    assert!(error < 1e-12, "{cuts} cuts, {theta} {phi}: {error:e}");
                }
            }
        }
    }

    /// A conducting plate at z = 0 reflects as an opening does that is filled with the reflected wave: at normal incidence the
    /// aperture's cross-section is the plate's, `4 pi A^2/lambda^2`.
    #[test]
    fn the_plate_is_an_aperture() {
        let k = 1_257.507_013_171_009;
        let corner = |x: f64, y: f64| DVec2::new(0.05 * x, 0.05 * y);
        let [a, b, c, d] = [corner(-1.0, -1.0), corner(1.0, -1.0), corner(1.0, 1.0), corner(-1.0, 1.0)];
        let field = [Complex64::ONE, Complex64::ZERO];
        let tubes = [[a, b, c], [a, c, d]].map(|corners| Tube { corners, phases_rad: [0.0; 3], field });
        let (along_theta, _) = far_field(&tubes, k, 0.0, 0.0);
        let sigma_db = 10.0 * (4.0 * PI * along_theta.norm_sqr()).log10();
        assert!((sigma_db - 17.018_709_589).abs() < 1e-6, "{sigma_db}");
    }
}
