//! Cross-section of an open rectangular cavity by waveguide modes.
//!
//! The wave enters through the aperture as if there were no rim (Kirchhoff), which excites the modes of the guide. Each
//! mode that propagates travels to the conducting end and back, and its aperture field radiates. This is the reference
//! of Ling, Chou and Lee, "Shooting and bouncing rays: calculating the RCS of an arbitrarily shaped cavity", IEEE
//! Trans. Antennas Propag. 37 (2), 1989. Fields on the outside of the walls are not included.

use std::f64::consts::{PI, TAU};

use glam::DVec3;
use num_complex::Complex64;

use super::Setup;
use crate::em::triangle::sinc;

/// `int cos(m pi (u/L + 1/2)) e^{jqu} du` over `-L/2..L/2`, and the same with the sine.
fn cosine_and_sine(m: usize, length_m: f64, q_per_m: f64) -> [Complex64; 2] {
    let wavenumber = m as f64 * PI / length_m;
    // Integral of the exponential with this sign, of which cosine and sine are the half sum and the half difference.
    let exponential = |sign: f64| {
        let magnitude = length_m * sinc(0.5 * length_m * (q_per_m + sign * wavenumber));
        Complex64::from_polar(magnitude, sign * 0.5 * m as f64 * PI)
    };
    let (positive, negative) = (exponential(1.0), exponential(-1.0));
    [0.5 * (positive + negative), (positive - negative) / Complex64::new(0.0, 2.0)]
}

/// Largest number of modes that are summed, which takes about a second.
const MOST_MODES: f64 = 1e7;

/// Cross-section of a conducting cavity of this width (y), height (z) and depth, open towards +x, for a far radar, m^2.
/// `None` if the aperture is so large that it has more than ten million modes.
///
/// With `I_n = int (E x h_n - e_n x H) . x` over the aperture, and `Y_n` the admittance of mode n, the reaction of the
/// returning modes with the wave of the receiver is `V = -sum I_n^2 e^{-2j beta_n d}/(2 Y_n)`; the cross-section is
/// `k^2 |V|^2/4 pi`, with admittances relative to that of free space.
pub fn cross_section_m2(setup: &Setup, width_m: f64, height_m: f64, depth_m: f64) -> Option<f64> {
    let k = setup.wavenumber_per_m();
    let towards = setup.towards();
    let electric = setup.radar(DVec3::ZERO).polarisation;
    let magnetic = electric.cross(towards);
    let highest = |length_m: f64| (k * length_m / PI) as usize;
    (highest(width_m) as f64 * highest(height_m) as f64 <= MOST_MODES).then_some(())?;
    let mut reaction = Complex64::ZERO;
    let along_z: Vec<_> = (0..=highest(height_m)).map(|n| cosine_and_sine(n, height_m, k * towards.z)).collect();
    for m in 0..=highest(width_m) {
        let [cos_y, sin_y] = cosine_and_sine(m, width_m, k * towards.y);
        for (n, &[cos_z, sin_z]) in along_z.iter().enumerate() {
            let (across, up) = (m as f64 * PI / width_m, n as f64 * PI / height_m);
            let cutoff_square = across * across + up * up;
            let along_square = k * k - cutoff_square;
            if cutoff_square == 0.0 || along_square <= 0.0 {
                continue;
            }
            let along = along_square.sqrt();
            let halves = if m == 0 { 1.0 } else { 2.0 } * if n == 0 { 1.0 } else { 2.0 };
            let scale = (halves / (width_m * height_m * cutoff_square)).sqrt();
            let (y, z) = (scale * cos_y * sin_z, scale * sin_y * cos_z);
            let returned = Complex64::from_polar(1.0, -2.0 * along * depth_m);
            let mut add = |e_y: Complex64, e_z: Complex64, admittance: f64| {
                let coupling =
                    admittance * (electric.y * e_y + electric.z * e_z) - (e_y * magnetic.z - e_z * magnetic.y);
                reaction -= coupling * coupling * returned / (2.0 * admittance);
            };
            add(up * y, -across * z, along / k);
            if m > 0 && n > 0 {
                add(across * y, up * z, k / along);
            }
        }
    }
    Some(k * k * reaction.norm_sqr() / (2.0 * TAU))
}
