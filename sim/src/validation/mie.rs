//! Mie's exact series for the sphere.

use std::f64::consts::PI;

use num_complex::Complex64;

/// Monostatic cross-section, m^2, of a sphere in a plane wave. `permittivity` is `eps' - j eps''`, or `None` for a
/// perfect conductor.
///
/// `sigma = lambda^2/(4 pi) |sum (-1)^n (2n + 1)(a_n - b_n)|^2` with the coefficients of Bohren and Huffman,
/// "Absorption and Scattering of Light by Small Particles", section 4.8, in their `e^{-iwt}`. The spherical Bessel
/// functions and the logarithmic derivative use downward recurrence, the Neumann functions upward, each in its stable
/// direction.
pub fn cross_section_m2(radius_m: f64, wavelength_m: f64, permittivity: Option<Complex64>) -> f64 {
    let x = 2.0 * PI * radius_m / wavelength_m;
    // Wiscombe's number of terms, with an inexpensive margin.
    let terms = (x + 4.05 * x.cbrt() + 12.0).ceil() as usize;
    let psi = riccati_bessel(x, terms);
    let inside = permittivity.map(|eps| {
        let index = eps.conj().sqrt();
        (index, logarithmic_derivative(index * x, terms))
    });
    let (mut chi_before, mut chi) = (x.cos(), x.cos() / x + x.sin());
    let mut sum = Complex64::ZERO;
    for n in 1..=terms {
        let order = n as f64;
        let (xi, xi_before) = (Complex64::new(psi[n], -chi), Complex64::new(psi[n - 1], -chi_before));
        let coefficient = |factor: Complex64| {
            let f = factor + order / x;
            (f * psi[n] - psi[n - 1]) / (f * xi - xi_before)
        };
        let (a, b) = match &inside {
            None => (coefficient(Complex64::ZERO), psi[n] / xi),
            Some((index, d)) => (coefficient(d[n] / index), coefficient(d[n] * index)),
        };
        let sign = if n % 2 == 0 { 1.0 } else { -1.0 };
        sum += sign * (2.0 * order + 1.0) * (a - b);
        (chi_before, chi) = (chi, (2.0 * order + 1.0) / x * chi - chi_before);
    }
    wavelength_m * wavelength_m / (4.0 * PI) * sum.norm_sqr()
}

/// `x j_n(x)` for n from 0 (Miller's algorithm).
fn riccati_bessel(x: f64, terms: usize) -> Vec<f64> {
    let start = terms + 40;
    let mut all = vec![0.0; start + 2];
    all[start] = 1e-200;
    for n in (1..=start).rev() {
        all[n - 1] = (2.0 * n as f64 + 1.0) / x * all[n] - all[n + 1];
        if all[n - 1].abs() > 1e200 {
            all.iter_mut().for_each(|v| *v *= 1e-250);
        }
    }
    // The scale is fixed by whichever of the first two is not near a zero.
    let (zeroth, first) = (x.sin(), x.sin() / x - x.cos());
    let scale = if zeroth.abs() > first.abs() { zeroth / all[0] } else { first / all[1] };
    all.iter().map(|v| v * scale).take(terms + 1).collect()
}

/// `psi_n'(z)/psi_n(z)` for n from 0.
fn logarithmic_derivative(z: Complex64, terms: usize) -> Vec<Complex64> {
    let start = terms.max(z.norm().ceil() as usize) + 16;
    let mut all = vec![Complex64::ZERO; start + 1];
    for n in (1..=start).rev() {
        let ratio = n as f64 / z;
        all[n - 1] = ratio - 1.0 / (all[n] + ratio);
    }
    all
}
