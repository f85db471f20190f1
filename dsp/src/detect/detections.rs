//! Detections of people and objects, finer than a cell: range, radial speed and direction.
//!
//! There are two methods. Anything that moves within a frame ([`Detector::detect_moving`]) has cells of its own in the
//! frame's range-Doppler maps, one complex map for each receiver. A person who sits or stands moves too little for
//! that, but changes from frame to frame ([`Detector::detect_still`]). The change at a range has a direction too.
//!
//! Ranges are those in the middle of the frame. A beat frequency is `S tau + 2 v f / c`; the range bias by the second term is
//! subtracted.

use std::sync::Arc;

use num_complex::Complex64;
use rustfft::Fft;

use super::angle::Baseline;
use crate::spectrum::{RangeFft, complex_fft, peak_offset};
use crate::{Frame, FrameMismatch, Waveform, Window};

/// Points of the range FFT for each sample. Padding lets the offset of a peak from its bin be interpolated.
const RANGE_PADDING: usize = 2;
/// Least level of a local maximum over the mean noise of its range, dB. Noise of one receiver alone reaches it once in about five
/// hundred million cells; the summed noise of several receivers does so less often. Rounding of a strong echo's codes reaches 12 dB.
const LEAST_SNR_DB: f64 = 13.0;
/// Largest number of detections of a frame; the strongest are kept.
const MOST_DETECTIONS: usize = 12;
/// Largest difference of two maxima of one detection, in range resolutions.
const SAME_RANGE: f64 = 1.5;
/// Largest difference of two maxima of one detection, m/s.
const SAME_VELOCITY_M_PER_S: f64 = 0.3;
/// Half width of the Doppler interval around a maximum over which the speed is averaged, m/s. The speeds of the parts
/// of a trunk differ by as much.
const TRUNK_M_PER_S: f64 = 0.15;
/// Least share of the energy of a person's echo that changes between frames. The echo of walls and furniture only drifts and
/// jitters.
const LEAST_CHANGING: f64 = 0.05;
/// Number of the first range bins, which hold leakage from transmitter to receiver and the transient of a chirp. Nothing can be
/// detected there.
pub const LEAKAGE_BINS: usize = 3;

/// Detection of an echo.
#[derive(Debug, Clone, PartialEq)]
pub struct Detection {
    /// Range, m.
    pub range_m: f64,
    /// Radial velocity, positive receding, m/s, within the unambiguous span. 0 if `is_still`.
    pub velocity_m_per_s: f64,
    /// Power of its cell over the noise at its range, dB.
    pub snr_db: f64,
    /// Cosine of the angle to each baseline of the detector; `None` where the phases give none.
    pub cosines: Vec<Option<f64>>,
    /// Whether it was found by its change between frames, not by motion within a frame.
    pub is_still: bool,
}

/// Local maximum of the power of a map.
struct Peak {
    power: f64,
    range: usize,
    doppler: usize,
}

/// Range profiles of the mean chirp of a frame, `[rx][range]`, for [`Detector::detect_still`].
#[derive(Debug, Clone, PartialEq)]
pub struct RangeProfile(Vec<Complex64>);

/// Detector of echoes in frames of a waveform. Owns its plans and buffers.
///
/// ```
/// use radome_dsp::detect::{AngleCalibration, Detector, Receivers};
/// use radome_dsp::{Frame, Waveform, WaveformRequest};
///
/// let waveform = Waveform::realise(WaveformRequest::paper()).expect("the chip can produce it");
/// let receivers = Receivers::new(waveform.request.rx_antennas, AngleCalibration::default());
/// let mut detector = Detector::new(&waveform, &receivers.baselines());
///
/// let (detections, _profile) = detector.detect_moving(&Frame::zeroed(waveform.shape()))?;
/// for detection in &detections {
///     let direction = receivers.direction(&detection.cosines);
///     println!("{:.2} m, {:.2} m/s, {direction:?}", detection.range_m, detection.velocity_m_per_s);
/// }
/// assert!(detections.is_empty(), "a frame without signal");
/// # Ok::<(), radome_dsp::FrameMismatch>(())
/// ```
pub struct Detector {
    waveform: Waveform,
    baselines: Vec<Baseline>,
    doppler_window: Vec<f64>,
    range_fft: RangeFft,
    /// Spectrum of one chirp.
    spectrum: Vec<Complex64>,
    doppler_fft: Arc<dyn Fft<f64>>,
    /// Number of range bins with padding.
    bins: usize,
    /// `[rx][range][chirp]`, later `[rx][range][doppler]` with zero Doppler in the middle.
    cells: Vec<Complex64>,
    /// `[range][doppler]`, sum of all receivers.
    power: Vec<f64>,
}

impl Detector {
    /// Creates the detector for frames of a waveform, with the pairs of receivers that measure direction.
    pub fn new(waveform: &Waveform, baselines: &[Baseline]) -> Self {
        let shape = waveform.shape();
        let length = RANGE_PADDING * shape.samples;
        let bins = length / 2;
        let range_fft = RangeFft::new(Window::Hann.weights(shape.samples), length);
        Detector {
            waveform: waveform.clone(),
            baselines: baselines.to_vec(),
            doppler_window: Window::Hann.weights(shape.chirps),
            spectrum: vec![Complex64::default(); range_fft.bins()],
            range_fft,
            doppler_fft: complex_fft(shape.chirps),
            bins,
            cells: vec![Complex64::default(); shape.rx * bins * shape.chirps],
            power: vec![0.0; bins * shape.chirps],
        }
    }

    /// Detects motion within a frame, the strongest first. Returns the frame's profile too, for [`Detector::detect_still`].
    ///
    /// # Errors
    /// [`FrameMismatch`] if the frame's shape is not the waveform's, or if the number of its codes is not that of its shape.
    pub fn detect_moving(&mut self, frame: &Frame) -> Result<(Vec<Detection>, RangeProfile), FrameMismatch> {
        let profile = self.transform(frame)?;
        let (doppler, bins, rx) = (self.doppler_window.len(), self.bins, self.waveform.shape().rx);
        let noise: Vec<f64> =
            self.power.chunks_exact(doppler.max(1)).map(|row| noise_power(row.iter().copied(), rx)).collect();
        let at = |range: usize, d: usize| self.power.get(range * doppler + d).copied().unwrap_or(0.0);
        let zero = doppler / 2;
        let least = 10f64.powf(0.1 * LEAST_SNR_DB);
        let mut peaks: Vec<Peak> = Vec::new();
        for range in (RANGE_PADDING * LEAKAGE_BINS)..bins.saturating_sub(1) {
            for d in 0..doppler {
                let cell = at(range, d);
                // Static removal leaves nothing at zero Doppler. The velocity axis is periodic.
                if d == zero || cell <= least * noise.get(range).copied().unwrap_or(f64::INFINITY) {
                    continue;
                }
                let (before, after) = ((d + doppler - 1) % doppler, (d + 1) % doppler);
                let has_higher_neighbour =
                    [before, d, after].iter().any(|&d| at(range - 1, d) > cell || at(range + 1, d) > cell)
                        || at(range, before) > cell
                        || at(range, after) > cell;
                if !has_higher_neighbour {
                    peaks.push(Peak { power: cell, range, doppler: d });
                }
            }
        }
        peaks.sort_by(|a, b| b.power.total_cmp(&a.power));
        let mut detections: Vec<Detection> = Vec::new();
        for Peak { power, range, doppler } in peaks {
            let detection =
                self.moving_detection(range, doppler, ratio_db(power, noise.get(range).copied().unwrap_or(power)));
            let span = 2.0 * self.waveform.max_velocity_m_per_s();
            let is_duplicate = detections.iter().any(|other| {
                let difference = other.velocity_m_per_s - detection.velocity_m_per_s;
                let difference = difference - span * (difference / span).round();
                (other.range_m - detection.range_m).abs() < SAME_RANGE * self.waveform.range_resolution_m()
                    && difference.abs() < SAME_VELOCITY_M_PER_S
            });
            if !is_duplicate {
                detections.push(detection);
            }
            if detections.len() == MOST_DETECTIONS {
                break;
            }
        }
        Ok((detections, profile))
    }

    /// Detects change between the frames of a few seconds, the strongest first. A range is a detection if its echo
    /// changes more than the echoes at most ranges. Fewer than three profiles give no detection.
    pub fn detect_still(&self, profiles: &[&RangeProfile]) -> Vec<Detection> {
        let rx = self.waveform.shape().rx;
        if profiles.len() < 3 {
            return Vec::new();
        }
        let count = profiles.len() as f64;
        let value = |profile: &&RangeProfile, cell: usize| profile.0.get(cell).copied().unwrap_or_default();
        // Each cell less its mean over the frames.
        let changes: Vec<Vec<Complex64>> = (0..rx * self.bins)
            .map(|cell| {
                let mean = profiles.iter().map(|p| value(p, cell)).sum::<Complex64>() / count;
                profiles.iter().map(|p| value(p, cell) - mean).collect()
            })
            .collect();
        let power_of = |cell: usize| changes.get(cell).map_or(0.0, |c| c.iter().map(Complex64::norm_sqr).sum::<f64>());
        let power: Vec<f64> =
            (0..self.bins).map(|range| (0..rx).map(|rx| power_of(rx * self.bins + range)).sum()).collect();
        let noise = noise_power(power.iter().skip(RANGE_PADDING * LEAKAGE_BINS).copied(), rx * (profiles.len() - 1));
        let mean_power = |cell: usize| profiles.iter().map(|p| value(p, cell)).sum::<Complex64>().norm_sqr() / count;
        let mut detections = Vec::new();
        for range in (RANGE_PADDING * LEAKAGE_BINS)..self.bins.saturating_sub(1) {
            let [before, cell, after] = [range - 1, range, range + 1].map(|i| power.get(i).copied().unwrap_or(0.0));
            let snr_db = ratio_db(cell, noise);
            let static_power = (0..rx).map(|rx| mean_power(rx * self.bins + range)).sum::<f64>();
            if before > cell || after > cell || snr_db < LEAST_SNR_DB || cell < LEAST_CHANGING * (cell + static_power) {
                continue;
            }
            let cross = |baseline: &Baseline, range: usize| {
                let changes_of = |rx: usize| changes.get(rx * self.bins + range).map_or(&[][..], Vec::as_slice);
                changes_of(baseline.to)
                    .iter()
                    .zip(changes_of(baseline.from))
                    .map(|(a, b)| a * b.conj())
                    .sum::<Complex64>()
            };
            detections.push(self.static_detection(range, [before, cell, after], snr_db, cross));
        }
        detections.sort_by(|a, b| b.snr_db.total_cmp(&a.snr_db));
        detections.truncate(MOST_DETECTIONS);
        detections
    }

    /// Finds the strongest static echo between two ranges, m, in the mean of profiles, such as a calibration reflector. `None` if no
    /// range bin between them is stronger than both of its neighbours.
    ///
    /// Its `snr_db` is the level over the median cell of all ranges, which is clutter rather than noise in a furnished room.
    pub fn find_reflector(&self, profiles: &[&RangeProfile], within_m: std::ops::Range<f64>) -> Option<Detection> {
        let rx = self.waveform.shape().rx;
        let mean = |cell: usize| {
            profiles.iter().map(|p| p.0.get(cell).copied().unwrap_or_default()).sum::<Complex64>()
                / profiles.len().max(1) as f64
        };
        let means: Vec<Complex64> = (0..rx * self.bins).map(mean).collect();
        let cell = |rx: usize, range: usize| means.get(rx * self.bins + range).copied().unwrap_or_default();
        let power: Vec<f64> =
            (0..self.bins).map(|range| (0..rx).map(|rx| cell(rx, range).norm_sqr()).sum::<f64>()).collect();
        let at = |range: usize| power.get(range).copied().unwrap_or(0.0);
        let is_within = |range: &usize| within_m.contains(&(*range as f64 * self.bin_m()));
        let is_peak = |&range: &usize| at(range) > at(range - 1) && at(range) >= at(range + 1);
        let bins = (1..self.bins.saturating_sub(1)).filter(is_within).filter(is_peak);
        let range = bins.max_by(|&a, &b| at(a).total_cmp(&at(b)))?;
        let cross = |baseline: &Baseline, range: usize| cell(baseline.to, range) * cell(baseline.from, range).conj();
        let snr_db = ratio_db(at(range), noise_power(power.iter().copied(), rx));
        Some(self.static_detection(range, [at(range - 1), at(range), at(range + 1)], snr_db, cross))
    }

    /// Detection of an echo without motion within a frame. The powers are those of the previous, this and the next
    /// range bin. `cross` is the product of the two receivers of a baseline at a range.
    fn static_detection(
        &self,
        range: usize,
        [before, cell, after]: [f64; 3],
        snr_db: f64,
        cross: impl Fn(&Baseline, usize) -> Complex64,
    ) -> Detection {
        let cosines = self.baselines.iter().map(|baseline| {
            let sum = cross(baseline, range - 1) + cross(baseline, range) + cross(baseline, range + 1);
            baseline.cosine(sum, self.waveform.wavelength_m())
        });
        Detection {
            range_m: (range as f64 + peak_offset(before, cell, after)) * self.bin_m(),
            velocity_m_per_s: 0.0,
            snr_db,
            cosines: cosines.collect(),
            is_still: true,
        }
    }

    /// Width of a padded range bin, m.
    fn bin_m(&self) -> f64 {
        self.waveform.range_step_m(RANGE_PADDING * self.waveform.request.samples_per_chirp)
    }

    /// Computes the complex maps of all receivers and their power. Returns the profiles of the mean chirps.
    fn transform(&mut self, frame: &Frame) -> Result<RangeProfile, FrameMismatch> {
        let shape = self.waveform.shape();
        FrameMismatch::check(frame, shape)?;
        let (bins, chirps) = (self.bins, shape.chirps);
        let mut profile = vec![Complex64::default(); shape.rx * bins];
        for (index, chirp) in frame.codes.chunks_exact(shape.samples).enumerate() {
            let (rx, m) = (index / chirps, index % chirps);
            // The scale does not matter, because only ratios of powers are used.
            let codes = chirp.iter().map(|&code| f64::from(code));
            self.range_fft.transform_codes(codes, |windowed| windowed, &mut self.spectrum);
            for (bin, value) in self.spectrum.iter().take(bins).enumerate() {
                if let Some(cell) = self.cells.get_mut((rx * bins + bin) * chirps + m) {
                    *cell = *value;
                }
            }
        }
        self.power.fill(0.0);
        let mut spectrum = vec![Complex64::default(); chirps];
        for (index, row) in self.cells.chunks_exact_mut(chirps).enumerate() {
            let mean = row.iter().sum::<Complex64>() / chirps as f64;
            if let Some(cell) = profile.get_mut(index) {
                *cell = mean;
            }
            for ((s, x), w) in spectrum.iter_mut().zip(row.iter()).zip(&self.doppler_window) {
                *s = (x - mean) * w;
            }
            self.doppler_fft.process(&mut spectrum);
            spectrum.rotate_right(chirps / 2);
            row.copy_from_slice(&spectrum);
            let range = index % bins;
            for (power, x) in self.power.iter_mut().skip(range * chirps).zip(row.iter()) {
                *power += x.norm_sqr();
            }
        }
        Ok(RangeProfile(profile))
    }

    /// Detection at a local maximum of the map.
    fn moving_detection(&self, range: usize, d: usize, snr_db: f64) -> Detection {
        let doppler = self.doppler_window.len();
        let step = self.waveform.velocity_step_m_per_s(doppler);
        let half = ((TRUNK_M_PER_S / step).round() as isize).clamp(1, (doppler as isize - 1) / 2);
        let at = |range: usize, d: isize| {
            let d = (d.rem_euclid(doppler as isize)) as usize;
            self.power.get(range * doppler + d).copied().unwrap_or(0.0)
        };
        let d = d as isize;
        let (mut sum, mut moment) = (0.0, 0.0);
        for offset in -half..=half {
            let power = at(range - 1, d + offset) + at(range, d + offset) + at(range + 1, d + offset);
            sum += power;
            moment += power * offset as f64;
        }
        let cells = d as f64 + if sum > 0.0 { moment / sum } else { 0.0 } - (doppler / 2) as f64;
        let velocity_m_per_s = cells * step;
        let power_at = |range: usize| at(range, d - 1) + at(range, d) + at(range, d + 1);
        let peak_bin = range as f64 + peak_offset(power_at(range - 1), power_at(range), power_at(range + 1));
        // c f_D / 2 S = v f / S.
        let range_bias_m = velocity_m_per_s * self.waveform.centre_frequency_hz() / self.waveform.slope_hz_per_s;
        let cosines = self.baselines.iter().map(|baseline| {
            let mut cross = Complex64::default();
            for range in range - 1..=range + 1 {
                for offset in -half..=half {
                    let d = (d + offset).rem_euclid(doppler as isize) as usize;
                    let cell = |rx: usize| self.cells.get((rx * self.bins + range) * doppler + d);
                    if let (Some(a), Some(b)) = (cell(baseline.to), cell(baseline.from)) {
                        cross += a * b.conj();
                    }
                }
            }
            baseline.cosine(cross, self.waveform.wavelength_m())
        });
        Detection {
            range_m: peak_bin * self.bin_m() - range_bias_m,
            velocity_m_per_s,
            snr_db,
            cosines: cosines.collect(),
            is_still: false,
        }
    }
}

/// Ratio of power to noise, dB: 0 without power, and at most what a 12-bit sample can represent where there is no noise.
fn ratio_db(power: f64, noise: f64) -> f64 {
    const MOST_DB: f64 = 120.0;
    if power > 0.0 { (10.0 * (power / noise).log10()).min(MOST_DB) } else { 0.0 }
}

/// Estimates the mean of noise from the median, which targets hardly change. Each value is the sum of the powers of `looks`
/// independent complex normal cells, which has a gamma distribution. The ratio of its median to its mean is that of Wilson and
/// Hilferty, Proc. Natl. Acad. Sci. 17, 1931, within 1.4 %.
fn noise_power(values: impl Iterator<Item = f64>, looks: usize) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_unstable_by(f64::total_cmp);
    let median_over_mean = (1.0 - 1.0 / (9.0 * looks.max(1) as f64)).powi(3);
    values.get(values.len() / 2).copied().unwrap_or(0.0) / median_over_mean
}

#[cfg(test)]
mod tests {
    use std::f64::consts::TAU;

    use super::*;
    use crate::{SPEED_OF_LIGHT_M_PER_S, WaveformRequest};

    const BASELINE: Baseline = Baseline { to: 0, from: 2, length_m: 2.5e-3, phase_rad: 0.0 };

    /// Samples of one point that recedes, straight from the beat's formula, rounded to codes.
    fn frame(waveform: &Waveform, range_m: f64, velocity_m_per_s: f64, sine: f64, level_lsb: f64) -> Frame {
        let shape = waveform.shape();
        let mut frame = Frame::zeroed(shape);
        let middle_s = 0.5 * (shape.chirps - 1) as f64 * waveform.chirp_interval_s
            + 0.5 * shape.samples as f64 / waveform.sample_rate_hz;
        for (index, code) in frame.codes.iter_mut().enumerate() {
            let (rx, rest) = (index / (shape.chirps * shape.samples), index % (shape.chirps * shape.samples));
            let t = (rest % shape.samples) as f64 / waveform.sample_rate_hz;
            let slow_s = (rest / shape.samples) as f64 * waveform.chirp_interval_s;
            let path_difference_m = if rx == BASELINE.to { BASELINE.length_m * sine } else { 0.0 };
            let path_m = 2.0 * (range_m + velocity_m_per_s * (slow_s + t - middle_s)) - path_difference_m;
            let tau = path_m / SPEED_OF_LIGHT_M_PER_S;
            let (f0, slope) = (waveform.sampled_start_frequency_hz, waveform.slope_hz_per_s);
            let cycles = f0 * tau + slope * tau * t - 0.5 * slope * tau * tau;
            *code = (2048.0 + level_lsb * (TAU * cycles.fract()).cos()).round() as u16;
        }
        frame
    }

    fn waveform() -> Waveform {
        Waveform::realise(WaveformRequest::paper()).expect("valid")
    }

    /// The estimate is the mean of noise, of one receiver and of several together.
    #[test]
    fn the_median_gives_the_mean_of_noise() {
        let mut state = 1u64;
        let mut exponential = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            -(1.0 - (state >> 11) as f64 / (1u64 << 53) as f64).ln()
        };
        for looks in [1, 3, 57] {
            let values: Vec<f64> = (0..40_000).map(|_| (0..looks).map(|_| exponential()).sum()).collect();
            let found = noise_power(values.into_iter(), looks) / looks as f64;
            assert!((found - 1.0).abs() < 0.03, "{looks} looks: {found}");
        }
    }

    #[test]
    fn range_speed_and_direction_of_a_point_are_finer_than_a_cell() {
        let waveform = waveform();
        let mut detector = Detector::new(&waveform, &[BASELINE]);
        for (range_m, velocity, sine) in
            [(2.0, 1.2, 0.1), (2.043, -1.13, -0.4), (5.51, 0.31, 0.0), (9.99, -2.2, 0.7), (3.3, 0.777, -0.2)]
        {
            let (detections, _) =
                detector.detect_moving(&frame(&waveform, range_m, velocity, sine, 200.0)).expect("a frame");
            let detection = detections.first().expect("an echo");
            assert!((detection.range_m - range_m).abs() < 0.005, "{range_m} m: {detection:?}");
            assert!((detection.velocity_m_per_s - velocity).abs() < 0.005, "{velocity} m/s: {detection:?}");
            let cosine = detection.cosines.first().copied().flatten().expect("a direction");
            assert!((cosine - sine).abs() < 0.005, "{sine}: {detection:?}");
        }
    }

    /// A millimetre back and forth, as a chest moves in a breath, changes the phase by more than a quarter turn.
    #[test]
    fn a_breathing_chest_is_found_by_its_change_between_frames() {
        let waveform = waveform();
        let mut detector = Detector::new(&waveform, &[BASELINE]);
        let profiles: Vec<RangeProfile> = (0..20)
            .map(|i| {
                let range_m = 3.02 + 1e-3 * (0.3 * f64::from(i)).sin();
                let (detections, profile) =
                    detector.detect_moving(&frame(&waveform, range_m, 0.0, 0.25, 100.0)).expect("a frame");
                assert!(detections.iter().all(|e| (e.range_m - 3.02).abs() > 0.1), "nothing moves within a frame");
                profile
            })
            .collect();
        let detections = detector.detect_still(&profiles.iter().collect::<Vec<_>>());
        let detection = detections.first().expect("an echo");
        assert!((detection.range_m - 3.02).abs() < 0.01, "{detection:?}");
        assert!((detection.cosines[0].expect("a direction") - 0.25).abs() < 0.01, "{detection:?}");
    }

    #[test]
    fn a_reflector_is_found_between_two_ranges() {
        let waveform = waveform();
        let mut detector = Detector::new(&waveform, &[BASELINE]);
        let mut scene = frame(&waveform, 2.5, 0.0, -0.3, 60.0);
        let wall = frame(&waveform, 5.0, 0.0, 0.1, 300.0);
        scene.codes.iter_mut().zip(&wall.codes).for_each(|(a, b)| *a = *a + *b - 2048);
        let (_, profile) = detector.detect_moving(&scene).expect("a frame");
        let detection = detector.find_reflector(&[&profile, &profile], 2.0..3.0).expect("an echo");
        assert!((detection.range_m - 2.5).abs() < 0.01, "{detection:?}");
        assert!((detection.cosines[0].expect("a direction") + 0.3).abs() < 0.01, "{detection:?}");
        assert_eq!(detector.find_reflector(&[&profile], 100.0..200.0), None);
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn frames_without_signal_and_of_other_shapes() {
            let waveform = waveform();
            let mut detector = Detector::new(&waveform, &[]);
            let (detections, profile) = detector.detect_moving(&Frame::zeroed(waveform.shape())).expect("a frame");
            assert!(detections.is_empty());
            assert!(detector.detect_still(&[&profile; 5]).is_empty() && detector.detect_still(&[]).is_empty());
            let mut other = waveform.shape();
            other.chirps += 1;
            assert!(matches!(detector.detect_moving(&Frame::zeroed(other)), Err(FrameMismatch::Shape { .. })));
            let mut cut = Frame::zeroed(waveform.shape());
            cut.codes.pop();
            assert!(matches!(detector.detect_moving(&cut), Err(FrameMismatch::Length { .. })));
        }

        #[test]
        fn two_people_at_one_range_are_separated_by_speed() {
            let waveform = waveform();
            let mut both = frame(&waveform, 4.0, 1.0, 0.2, 300.0);
            let other = frame(&waveform, 4.05, -0.8, -0.2, 200.0);
            both.codes.iter_mut().zip(&other.codes).for_each(|(a, b)| *a = *a + *b - 2048);
            let mut detector = Detector::new(&waveform, &[BASELINE]);
            let (detections, _) = detector.detect_moving(&both).expect("a frame");
            let near = |v: f64, sine: f64| {
                detections.iter().any(|e| {
                    (e.velocity_m_per_s - v).abs() < 0.02 && e.cosines[0].is_some_and(|c| (c - sine).abs() < 0.02)
                })
            };
            assert!(near(1.0, 0.2) && near(-0.8, -0.2), "{detections:?}");
        }
    }
}
