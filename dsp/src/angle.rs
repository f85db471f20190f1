//! Directions from the phase between two receivers.
//!
//! A target in the direction of the unit vector `u` is nearer to receiver `a` than to `b` by `d u.e`, where `d e` is the way
//! from `b` to `a`. Nearer is earlier, and the phase of a beat at positive frequency falls with the delay
//! (crate page, signs): `arg(X_a conj(X_b)) = -2 pi d (u.e) / lambda`.

use std::f64::consts::TAU;

use num_complex::Complex64;

/// Cosine of the angle between a target's direction and the baseline from receiver `b` to receiver `a`, from their
/// cross-spectrum `X_a conj(X_b)`.
///
/// Baselines up to half a wavelength have one answer; of longer ones this is the answer nearest to broadside. `None` where
/// nothing was received, and where what was received comes from no direction: noise, or several echoes in one cell.
pub fn direction_cosine(cross: Complex64, baseline_m: f64, wavelength_m: f64) -> Option<f64> {
    let cosine = -cross.arg() * wavelength_m / (TAU * baseline_m);
    (cross.norm_sqr() > 0.0 && cosine.abs() <= 1.0).then_some(cosine)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two receivers 2.5 mm apart, a target far off to either side: the difference of two ways, in closed form.
    #[test]
    fn phase_between_receivers_tells_the_side_and_the_angle() {
        let (wavelength_m, baseline_m) = (5e-3, 2.5e-3);
        for degrees in [-80.0, -30.0, -1.0, 0.0, 12.5, 45.0, 85.0f64] {
            let target = (1e4 * degrees.to_radians().cos(), 1e4 * degrees.to_radians().sin());
            let beat = |y: f64| {
                let way = target.0.hypot(target.1) + target.0.hypot(target.1 - y);
                Complex64::from_polar(1.0, TAU * (way / wavelength_m).fract())
            };
            let cross = beat(baseline_m) * beat(0.0).conj();
            let cosine = direction_cosine(cross, baseline_m, wavelength_m).expect("a direction");
            assert!((cosine - degrees.to_radians().sin()).abs() < 1e-5, "{degrees}: {cosine}");
        }
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn silence_and_what_comes_from_nowhere_have_no_direction() {
            assert_eq!(direction_cosine(Complex64::new(0.0, 0.0), 2.5e-3, 5e-3), None);
            assert_eq!(direction_cosine(Complex64::new(f64::NAN, 0.0), 2.5e-3, 5e-3), None);
            // Receivers closer than half a wavelength cannot be more than so far apart in phase.
            assert_eq!(direction_cosine(Complex64::new(-1.0, 0.1), 2e-3, 5e-3), None);
        }
    }
}
