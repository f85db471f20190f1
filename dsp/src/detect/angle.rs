//! Directions from the phase between two receivers.
//!
//! A target in the direction of the unit vector `u` is nearer to receiver `a` than to `b` by `d u.e`, where `d e` is the vector
//! from `b` to `a`. Its echo reaches `a` earlier, and the phase of a beat at positive frequency falls with the delay
//! (crate page, signs): `arg(X_a conj(X_b)) = -2 pi d (u.e) / lambda`.

use std::f64::consts::TAU;

use num_complex::Complex64;
use serde::{Deserialize, Serialize};

use crate::RxMask;

/// Distance between neighbouring receivers on the package, m (BGT60TR13C datasheet V2.4.9, table 72).
pub const RECEIVER_SPACING_M: f64 = 2.5e-3;

/// Baseline between two receivers whose phases are compared.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Baseline {
    /// Index in the frame of the receiver at the end of the baseline.
    pub to: usize,
    /// Index in the frame of the receiver at the start of the baseline.
    pub from: usize,
    /// Length, m.
    pub length_m: f64,
    /// Phase offset `arg(X_to conj(X_from))` of an echo from broadside, rad: 0 for identical receivers.
    pub phase_rad: f64,
}

impl Baseline {
    /// Cosine of the angle between a target's direction and this baseline, from `cross = X_to conj(X_from)`. `None` if the phase
    /// belongs to no direction.
    pub fn cosine(&self, cross: Complex64, wavelength_m: f64) -> Option<f64> {
        direction_cosine(cross * Complex64::from_polar(1.0, -self.phase_rad), self.length_m, wavelength_m)
    }
}

/// Phase offsets between the receivers of one board, as of an echo from straight ahead. They are measured with a reflector in a
/// known direction ([`Receivers::calibrate`]).
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AngleCalibration {
    /// Phase of RX1 relative to RX3, rad.
    pub azimuth_phase_rad: f64,
    /// Phase of RX2 relative to RX3, rad.
    pub elevation_phase_rad: f64,
}

/// Direction of a detection in the radar's frame: x ahead, y to the left, z up.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Direction {
    /// Azimuth from straight ahead, positive to the left, rad; `None` where it cannot be measured.
    pub azimuth_rad: Option<f64>,
    /// Elevation above the radar's horizon, rad; `None` where it cannot be measured.
    pub elevation_rad: Option<f64>,
}

/// Receivers that a waveform uses. They form an L with RX3 in its corner: RX1 lies to the left of it, RX2 above.
///
/// ```
/// use radome_dsp::RxMask;
/// use radome_dsp::detect::{AngleCalibration, Receivers};
///
/// let receivers = Receivers::new(RxMask::ALL, AngleCalibration::default());
/// assert_eq!(receivers.baselines().len(), 2);
/// let direction = receivers.direction(&[Some(0.5), Some(0.0)]);
/// assert!((direction.azimuth_rad.expect("measured").to_degrees() - 30.0).abs() < 1e-9);
/// assert_eq!(direction.elevation_rad, Some(0.0));
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Receivers {
    azimuth: Option<Baseline>,
    elevation: Option<Baseline>,
}

impl Receivers {
    /// Creates the receivers of a waveform with their calibration. Without RX3 there is no angle, without RX1 no azimuth, without RX2
    /// no elevation.
    pub fn new(mask: RxMask, calibration: AngleCalibration) -> Self {
        let antennas = mask.antennas();
        let index = |antenna: u8| antennas.iter().position(|a| *a == antenna);
        let pair = |antenna: u8, phase_rad: f64| {
            Some(Baseline { to: index(antenna)?, from: index(3)?, length_m: RECEIVER_SPACING_M, phase_rad })
        };
        Receivers {
            azimuth: pair(1, calibration.azimuth_phase_rad),
            elevation: pair(2, calibration.elevation_phase_rad),
        }
    }

    /// Baselines that exist, azimuth first, for a [`Detector`](super::Detector).
    pub fn baselines(&self) -> Vec<Baseline> {
        self.azimuth.into_iter().chain(self.elevation).collect()
    }

    /// Direction from the cosines of [`Receivers::baselines`]. Without an elevation, the target is taken to lie in the radar's
    /// horizon. Both angles are `None` if no point in front of the radar has both cosines.
    pub fn direction(&self, cosines: &[Option<f64>]) -> Direction {
        let mut cosines = cosines.iter().copied();
        let left = self.azimuth.and_then(|_| cosines.next().flatten());
        let up = self.elevation.and_then(|_| cosines.next().flatten());
        let ahead = (1.0 - up.unwrap_or(0.0).powi(2) - left.unwrap_or(0.0).powi(2)).max(0.0).sqrt();
        let is_direction = up.unwrap_or(0.0).powi(2) + left.unwrap_or(0.0).powi(2) <= 1.0;
        Direction {
            azimuth_rad: left.filter(|_| is_direction).map(|left| left.atan2(ahead)),
            elevation_rad: up.filter(|_| is_direction).map(f64::asin),
        }
    }

    /// Computes the calibration from the cosines that these receivers, with their present calibration, measured of a reflector in
    /// the direction `truth`, `(azimuth_rad, elevation_rad)`. A baseline without a cosine keeps its phase.
    pub fn calibrate(&self, cosines: &[Option<f64>], truth: (f64, f64), wavelength_m: f64) -> AngleCalibration {
        let (azimuth_rad, elevation_rad) = truth;
        let expected = [elevation_rad.cos() * azimuth_rad.sin(), elevation_rad.sin()];
        let mut cosines = cosines.iter().copied();
        let mut phase = |baseline: Option<Baseline>, expected: f64| {
            let Some(baseline) = baseline else { return 0.0 };
            let measured = cosines.next().flatten().unwrap_or(expected);
            let phase = baseline.phase_rad - TAU * baseline.length_m / wavelength_m * (measured - expected);
            phase - TAU * (phase / TAU).round()
        };
        let [left, up] = expected;
        AngleCalibration {
            azimuth_phase_rad: phase(self.azimuth, left),
            elevation_phase_rad: phase(self.elevation, up),
        }
    }
}

/// Cosine of the angle between a target's direction and the baseline from receiver `b` to receiver `a`, from their
/// cross-spectrum `X_a conj(X_b)`.
///
/// The result is unique for baselines up to half a wavelength. For longer ones it is the result nearest to broadside. `None`
/// without power, and where the phase belongs to no direction: noise, or several echoes in one cell.
fn direction_cosine(cross: Complex64, baseline_m: f64, wavelength_m: f64) -> Option<f64> {
    let cosine = -cross.arg() * wavelength_m / (TAU * baseline_m);
    (cross.norm_sqr() > 0.0 && cosine.abs() <= 1.0).then_some(cosine)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two receivers 2.5 mm apart and a distant target: the path difference in closed form.
    #[test]
    fn phase_between_receivers_gives_side_and_angle() {
        let (wavelength_m, baseline_m) = (5e-3, 2.5e-3);
        for degrees in [-80.0, -30.0, -1.0, 0.0, 12.5, 45.0, 85.0f64] {
            let target = (1e4 * degrees.to_radians().cos(), 1e4 * degrees.to_radians().sin());
            let beat = |y: f64| {
                let path_m = target.0.hypot(target.1) + target.0.hypot(target.1 - y);
                Complex64::from_polar(1.0, TAU * (path_m / wavelength_m).fract())
            };
            let cross = beat(baseline_m) * beat(0.0).conj();
            let cosine = direction_cosine(cross, baseline_m, wavelength_m).expect("a direction");
            assert!((cosine - degrees.to_radians().sin()).abs() < 1e-5, "{degrees}: {cosine}");
        }
    }

    fn receivers(calibration: AngleCalibration) -> Receivers {
        Receivers::new(RxMask::from_antennas(&[1, 2, 3]).expect("three"), calibration)
    }

    /// Cosines of a far target by the definition of the phase, with phase offsets between the receivers.
    fn cosines(
        receivers: &Receivers,
        direction: (f64, f64),
        offsets: AngleCalibration,
        wavelength_m: f64,
    ) -> Vec<Option<f64>> {
        let (azimuth, elevation) = direction;
        let true_cosines = [elevation.cos() * azimuth.sin(), elevation.sin()];
        let offsets = [offsets.azimuth_phase_rad, offsets.elevation_phase_rad];
        let baselines = receivers.baselines().into_iter().zip(true_cosines).zip(offsets);
        let measured = baselines.map(|((baseline, cosine), offset)| {
            let phase = offset - TAU * RECEIVER_SPACING_M / wavelength_m * cosine;
            baseline.cosine(Complex64::from_polar(2.0, phase), wavelength_m)
        });
        measured.collect()
    }

    #[test]
    fn azimuth_is_to_the_left_and_elevation_up() {
        let identical = receivers(AngleCalibration::default());
        for (azimuth_deg, elevation_deg) in [(0.0, 0.0), (40.0, 0.0), (-25.0, 10.0), (10.0, -35.0), (60.0, 20.0f64)] {
            let truth = (f64::to_radians(azimuth_deg), elevation_deg.to_radians());
            let measured = identical.direction(&cosines(&identical, truth, AngleCalibration::default(), 5e-3));
            assert!((measured.azimuth_rad.expect("measured") - truth.0).abs() < 1e-12, "{azimuth_deg}: {measured:?}");
            assert!(
                (measured.elevation_rad.expect("measured") - truth.1).abs() < 1e-12,
                "{elevation_deg}: {measured:?}"
            );
        }
    }

    #[test]
    fn one_reflector_calibrates_all_directions() {
        let offsets = AngleCalibration { azimuth_phase_rad: 0.7, elevation_phase_rad: -1.1 };
        let uncalibrated = receivers(AngleCalibration::default());
        let truth = (0.2, -0.1);
        let measured = cosines(&uncalibrated, truth, offsets, 4.95e-3);
        let calibration = uncalibrated.calibrate(&measured, truth, 4.95e-3);
        assert!((calibration.azimuth_phase_rad - 0.7).abs() < 1e-12, "{calibration:?}");
        assert!((calibration.elevation_phase_rad + 1.1).abs() < 1e-12, "{calibration:?}");
        let calibrated = receivers(calibration);
        let direction = calibrated.direction(&cosines(&calibrated, (-0.5, 0.3), offsets, 4.95e-3));
        assert!((direction.azimuth_rad.expect("measured") + 0.5).abs() < 1e-12);
        assert!((direction.elevation_rad.expect("measured") - 0.3).abs() < 1e-12);
        // A second calibration gives the same result.
        let again = calibrated.calibrate(&cosines(&calibrated, truth, offsets, 4.95e-3), truth, 4.95e-3);
        assert!((again.azimuth_phase_rad - 0.7).abs() < 1e-12, "{again:?}");
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn fewer_receivers_measure_fewer_angles() {
            let pair = |antennas: &[u8]| {
                Receivers::new(RxMask::from_antennas(antennas).expect("valid"), AngleCalibration::default())
            };
            assert!(pair(&[1]).baselines().is_empty() && pair(&[1, 2]).baselines().is_empty());
            let side = pair(&[1, 3]);
            assert_eq!(side.baselines().iter().map(|b| (b.to, b.from)).collect::<Vec<_>>(), [(0, 1)]);
            let direction = side.direction(&[Some(0.5)]);
            assert!((direction.azimuth_rad.expect("measured") - 30f64.to_radians()).abs() < 1e-12);
            assert_eq!(direction.elevation_rad, None);
            assert_eq!(pair(&[2, 3]).direction(&[Some(0.5)]).azimuth_rad, None);
            assert_eq!(side.direction(&[]), Direction { azimuth_rad: None, elevation_rad: None });
        }

        #[test]
        fn cosines_of_no_direction_are_none() {
            let direction = receivers(AngleCalibration::default()).direction(&[Some(0.9), Some(0.8)]);
            assert_eq!(direction, Direction { azimuth_rad: None, elevation_rad: None });
        }

        #[test]
        fn zero_power_and_impossible_phases_have_no_direction() {
            assert_eq!(direction_cosine(Complex64::new(0.0, 0.0), 2.5e-3, 5e-3), None);
            assert_eq!(direction_cosine(Complex64::new(f64::NAN, 0.0), 2.5e-3, 5e-3), None);
            // The phase between receivers closer than half a wavelength is limited.
            assert_eq!(direction_cosine(Complex64::new(-1.0, 0.1), 2e-3, 5e-3), None);
        }
    }
}
