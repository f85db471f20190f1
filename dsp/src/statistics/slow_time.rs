//! Statistics of slow time over seconds, from the range profile of each frame's mean chirp.
//!
//! Frames are divided into windows of some seconds. The mean profile of a window is static; the power of the remainder is motion.
//! A person who breathes shows as a line: a range bin with more motion than the bins around it.

use num_complex::Complex64;
use serde::Serialize;

use crate::detect::LEAKAGE_BINS;
use crate::spectrum::{RangeFft, peak_offset};
use crate::{Frame, Waveform, Window};

/// Least ratio of the power of a line to the power of the median bin.
const LINE_OVER_MEDIAN: f64 = 10.0;
/// Lowest and highest rate of breathing, Hz.
const BREATH_HZ: (f64, f64) = (0.1, 0.7);
/// Step of the rates of breathing that are tried, Hz.
const BREATH_STEP_HZ: f64 = 0.005;

/// Static power, moving power and breathing by receiver and range bin, over all windows.
///
/// ```
/// use radome_dsp::statistics::SlowTimeStatistics;
/// use radome_dsp::{Frame, Waveform, WaveformRequest};
///
/// let waveform = Waveform::realise(WaveformRequest::paper()).expect("the chip can produce it");
/// let mut statistics = SlowTimeStatistics::new(&waveform, 1.0);
/// let mut frame = Frame::zeroed(waveform.shape());
/// for sequence in 0..10 {
///     frame.sequence = sequence;
///     statistics.push(&frame);
/// }
/// assert_eq!(statistics.moving(0, 20), Some(0.0));
/// ```
pub struct SlowTimeStatistics {
    waveform: Waveform,
    /// Number of frames of a window.
    window: usize,
    fft: RangeFft,
    /// Profiles `[frame][rx][bin]` of the current window.
    profiles: Vec<Vec<Complex64>>,
    last_sequence: u64,
    windows: usize,
    /// Sum of the static power over windows, `[rx][bin]`.
    static_power: Vec<f64>,
    /// Sum of the moving power over windows, `[rx][bin]`.
    moving_power: Vec<f64>,
    /// Sum of the changes of the static echo over windows, `[rx][bin]`.
    changes: Vec<StaticChanges>,
    breath_hz: Vec<f64>,
}

/// Mean squares of the changes of a static echo, noise included.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct StaticChanges {
    /// Half of the mean square step of its phase from frame to frame, rad^2.
    pub phase_rad2: f64,
    /// Half of the mean square step of its amplitude from frame to frame, relative to the amplitude.
    pub amplitude: f64,
    /// Mean square change of its phase over ten seconds, as of a random walk, rad^2.
    pub drift_rad2_per_10s: f64,
}

/// Line of a person in the moving power.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct MotionLine {
    /// Moving power in the strongest bin, mean of windows and receivers, dBFS: 0 dB is the power of a full-scale sine.
    pub level_dbfs: f64,
    /// Range, m, interpolated between bins.
    pub range_m: f64,
    /// Rate of the strongest oscillation of the phase, median of the windows, Hz; `None` if windows are too short for one.
    pub breath_hz: Option<f64>,
    /// Range bin.
    #[serde(skip)]
    pub bin: usize,
    /// Number of windows.
    pub windows: usize,
}

impl SlowTimeStatistics {
    /// Creates empty statistics for frames of a waveform in windows of `window_s` seconds.
    pub fn new(waveform: &Waveform, window_s: f64) -> Self {
        let shape = waveform.shape();
        let window = (window_s / waveform.frame_interval_s()).round().clamp(4.0, 1e6) as usize;
        let cells = shape.rx * (shape.samples / 2);
        SlowTimeStatistics {
            waveform: waveform.clone(),
            window,
            fft: RangeFft::new(Window::Hann.weights(shape.samples), shape.samples),
            profiles: Vec::new(),
            last_sequence: 0,
            windows: 0,
            static_power: vec![0.0; cells],
            moving_power: vec![0.0; cells],
            changes: vec![StaticChanges::default(); cells],
            breath_hz: Vec::new(),
        }
    }

    /// Adds a frame. A frame of another shape is ignored. A window ends where frames are missing.
    pub fn push(&mut self, frame: &Frame) {
        let shape = self.waveform.shape();
        if frame.shape != shape || frame.codes.len() != shape.codes() {
            return;
        }
        if !self.profiles.is_empty() && frame.sequence != self.last_sequence.wrapping_add(1) {
            self.end();
        }
        self.last_sequence = frame.sequence;
        let factor = self.fft.full_scale_factor();
        let (mut chirp_sum, mut spectrum) = (vec![0.0; shape.samples], vec![Complex64::default(); self.fft.bins()]);
        let mut profile = Vec::with_capacity(self.static_power.len());
        for codes in frame.codes.chunks(shape.chirps * shape.samples) {
            chirp_sum.fill(0.0);
            for chirp in codes.chunks(shape.samples) {
                chirp_sum.iter_mut().zip(chirp).for_each(|(sum, &code)| *sum += f64::from(code));
            }
            // The scale turns the sum of the chirps into their mean.
            self.fft.transform_codes(chirp_sum.iter().copied(), |x| x * factor / shape.chirps as f64, &mut spectrum);
            profile.extend(spectrum.iter().take(shape.samples / 2));
        }
        self.profiles.push(profile);
        if self.profiles.len() == self.window {
            self.end();
        }
    }

    /// Ends the current window. It counts if it is at least half full.
    pub fn end(&mut self) {
        let profiles = std::mem::take(&mut self.profiles);
        if 2 * profiles.len() < self.window {
            return;
        }
        let count = profiles.len() as f64;
        let mean = |cell: usize| profiles.iter().map(|p| p[cell]).sum::<Complex64>() / count;
        let (mut strongest_power, mut strongest_cell) = (0.0, None);
        let first = self.first_bin();
        for cell in 0..self.static_power.len() {
            let static_echo = mean(cell);
            let moving_power = profiles.iter().map(|p| (p[cell] - static_echo).norm_sqr()).sum::<f64>() / count;
            self.static_power[cell] += static_echo.norm_sqr();
            self.moving_power[cell] += moving_power;
            self.add_changes(&profiles, cell, static_echo.norm());
            if moving_power > strongest_power && cell % self.bins() >= first {
                (strongest_power, strongest_cell) = (moving_power, Some(cell));
            }
        }
        self.windows += 1;
        if let Some(cell) = strongest_cell {
            let series: Vec<Complex64> = profiles.iter().map(|p| p[cell]).collect();
            self.breath_hz.extend(oscillation_rate_hz(&series, self.waveform.frame_interval_s()));
        }
    }

    /// Adds the changes of one cell over a window, in which its static echo has the given amplitude.
    fn add_changes(&mut self, profiles: &[Vec<Complex64>], cell: usize, static_amplitude: f64) {
        let interval_s = self.waveform.frame_interval_s();
        let frames_per_second = ((1.0 / interval_s).round() as usize).clamp(1, profiles.len() / 2);
        let (mut phase, mut amplitude) = (0.0, 0.0);
        for pair in profiles.windows(2) {
            let [a, b] = [pair[0][cell], pair[1][cell]];
            phase += (b * a.conj()).arg().powi(2);
            amplitude += ((b.norm() - a.norm()) / static_amplitude).powi(2);
        }
        // Sums over a second at both ends, so that jitter does not count as drift.
        let sum = |part: &[Vec<Complex64>]| part.iter().map(|p| p[cell]).sum::<Complex64>();
        let (first, last) = (sum(&profiles[..frames_per_second]), sum(&profiles[profiles.len() - frames_per_second..]));
        let span_s = (profiles.len() - frames_per_second) as f64 * interval_s;
        let steps = 2.0 * (profiles.len() - 1) as f64;
        let changes = &mut self.changes[cell];
        changes.phase_rad2 += phase / steps;
        changes.amplitude += amplitude / steps;
        changes.drift_rad2_per_10s += (last * first.conj()).arg().powi(2) * 10.0 / span_s;
    }

    /// Number of range bins of a profile.
    pub fn bins(&self) -> usize {
        (self.waveform.request.samples_per_chirp / 2).max(1)
    }

    /// First bin beyond leakage.
    fn first_bin(&self) -> usize {
        LEAKAGE_BINS.min(self.bins())
    }

    /// Mean static power of a range bin over windows, relative to a full-scale sine; `None` before the end of the first window, and
    /// if there is no such bin.
    pub fn still(&self, rx: usize, bin: usize) -> Option<f64> {
        self.mean_over_windows(&self.static_power, rx, bin)
    }

    /// Mean moving power of a range bin over windows, relative to a full-scale sine; `None` before the end of the first window, and
    /// if there is no such bin.
    pub fn moving(&self, rx: usize, bin: usize) -> Option<f64> {
        self.mean_over_windows(&self.moving_power, rx, bin)
    }

    /// Changes of the static echo of a range bin, mean of the windows; `None` before the end of the first window, and if there is no
    /// such bin.
    pub fn changes(&self, rx: usize, bin: usize) -> Option<StaticChanges> {
        let sums = self.changes.get(rx * self.bins() + bin).filter(|_| bin < self.bins() && self.windows > 0)?;
        let windows = self.windows as f64;
        Some(StaticChanges {
            phase_rad2: sums.phase_rad2 / windows,
            amplitude: sums.amplitude / windows,
            drift_rad2_per_10s: sums.drift_rad2_per_10s / windows,
        })
    }

    fn mean_over_windows(&self, sums: &[f64], rx: usize, bin: usize) -> Option<f64> {
        let sum = sums.get(rx * self.bins() + bin).filter(|_| bin < self.bins() && self.windows > 0)?;
        Some(sum / self.windows as f64)
    }

    /// Strongest line; `None` if no bin exceeds the median by enough.
    pub fn line(&self) -> Option<MotionLine> {
        let receivers = self.waveform.shape().rx.max(1);
        let power = |bin: usize| {
            (0..receivers).filter_map(|rx| self.moving(rx, bin)).sum::<f64>().max(1e-30) / receivers as f64
        };
        let first = self.first_bin();
        let bin = (first..self.bins()).max_by(|a, b| power(*a).total_cmp(&power(*b)))?;
        let mut sorted: Vec<f64> = (first..self.bins()).map(power).collect();
        sorted.sort_unstable_by(f64::total_cmp);
        if self.windows == 0 || power(bin) < LINE_OVER_MEDIAN * sorted.get(sorted.len() / 2)? {
            return None;
        }
        let offset = if bin > first && bin + 1 < self.bins() {
            peak_offset(power(bin - 1), power(bin), power(bin + 1))
        } else {
            0.0
        };
        let mut rates = self.breath_hz.clone();
        rates.sort_unstable_by(f64::total_cmp);
        Some(MotionLine {
            range_m: (bin as f64 + offset) * self.waveform.range_step_m(self.waveform.request.samples_per_chirp),
            level_dbfs: 10.0 * power(bin).log10(),
            breath_hz: rates.get(rates.len() / 2).map(|upper| 0.5 * (upper + rates[(rates.len() - 1) / 2])),
            bin,
            windows: self.windows,
        })
    }
}

/// Rate of the strongest oscillation of a phase about the centre of the circle that a series follows, Hz. `None` if the series is
/// too short, or lies on a line.
fn oscillation_rate_hz(series: &[Complex64], interval_s: f64) -> Option<f64> {
    let span_s = series.len() as f64 * interval_s;
    let (lowest_hz, highest_hz) = (BREATH_HZ.0.max(1.5 / span_s), BREATH_HZ.1.min(0.4 / interval_s));
    if series.len() < 16 || lowest_hz >= highest_hz {
        return None;
    }
    let centre = circle_centre(series)?;
    let mut phase = Vec::with_capacity(series.len());
    let (mut last_angle, mut unwrapped) = (0.0, 0.0);
    for z in series {
        let angle = (z - centre).arg();
        let step: f64 = angle - last_angle;
        unwrapped += step - std::f64::consts::TAU * (step / std::f64::consts::TAU).round();
        last_angle = angle;
        phase.push(unwrapped);
    }
    // The phase less its linear trend, windowed.
    let n = phase.len() as f64;
    let mean = phase.iter().sum::<f64>() / n;
    let middle = 0.5 * (n - 1.0);
    let (mut covariance, mut variance) = (0.0, 0.0);
    for (i, y) in phase.iter().enumerate() {
        let x = i as f64 - middle;
        covariance += x * (y - mean);
        variance += x * x;
    }
    let slope = covariance / variance;
    let window = Window::Hann.weights(phase.len());
    let detrended: Vec<f64> = (phase.iter().zip(&window).enumerate())
        .map(|(i, (y, w))| (y - mean - slope * (i as f64 - middle)) * w)
        .collect();
    let power = |hz: f64| {
        let radians_per_frame = -std::f64::consts::TAU * hz * interval_s;
        detrended
            .iter()
            .enumerate()
            .map(|(i, x)| Complex64::from_polar(*x, radians_per_frame * i as f64))
            .sum::<Complex64>()
            .norm_sqr()
    };
    let steps = ((highest_hz - lowest_hz) / BREATH_STEP_HZ) as usize;
    let rates = (0..=steps).map(|i| lowest_hz + i as f64 * BREATH_STEP_HZ);
    rates.map(|hz| (hz, power(hz))).max_by(|a, b| a.1.total_cmp(&b.1)).map(|(hz, _)| hz)
}

/// Centre of the circle through points, by least squares (Kasa, "A circle fitting procedure and its error analysis", 1976); `None`
/// if they lie on a line.
fn circle_centre(points: &[Complex64]) -> Option<Complex64> {
    let n = points.len() as f64;
    let mean = points.iter().sum::<Complex64>() / n;
    let (mut uu, mut uv, mut vv, mut u3, mut v3) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for z in points.iter().map(|z| z - mean) {
        let square = z.norm_sqr();
        uu += z.re * z.re;
        uv += z.re * z.im;
        vv += z.im * z.im;
        u3 += z.re * square;
        v3 += z.im * square;
    }
    let determinant = uu * vv - uv * uv;
    if determinant.is_nan() || determinant <= 1e-12 * (uu + vv).powi(2) {
        return None;
    }
    Some(mean + Complex64::new(u3 * vv - v3 * uv, v3 * uu - u3 * uv) * 0.5 / determinant)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{SPEED_OF_LIGHT_M_PER_S, WaveformRequest};

    fn waveform() -> Waveform {
        let request = WaveformRequest {
            samples_per_chirp: 64,
            chirps_per_frame: 4,
            start_frequency_hz: 58e9,
            end_frequency_hz: 63e9,
            ..WaveformRequest::paper()
        };
        Waveform::realise(request).expect("a waveform")
    }

    /// Frames of an echo at a range that changes with time, beside a static echo.
    fn frames(count: u64, amplitude_lsb: f64, range_m: impl Fn(f64) -> f64) -> Vec<Frame> {
        let w = waveform();
        let shape = w.shape();
        let frame = |sequence: u64| {
            let mut frame = Frame::zeroed(shape);
            frame.sequence = sequence;
            let delay_s = 2.0 * range_m(sequence as f64 * w.frame_interval_s()) / SPEED_OF_LIGHT_M_PER_S;
            for (i, code) in frame.codes.iter_mut().enumerate() {
                let t = (i % shape.samples) as f64 / w.sample_rate_hz;
                let cycles = delay_s * (w.sampled_start_frequency_hz + w.slope_hz_per_s * t);
                let still = 150.0 * (0.9 + 6e9 * w.slope_hz_per_s / 1e15 * 1e-3 * t * 1e3).cos();
                // Dither: rounding errors of identical chirps would add up.
                let mixed = (i as u64 + 1_000_003 * sequence).wrapping_mul(0x9e37_79b9_7f4a_7c15);
                let mixed = (mixed ^ (mixed >> 29)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
                let dither = (mixed >> 40) as f64 / (1u64 << 24) as f64 - 0.5;
                let x = 2048.0 + amplitude_lsb * (std::f64::consts::TAU * cycles).cos() + still + dither;
                *code = (x + 0.5) as u16;
            }
            frame
        };
        (0..count).map(frame).collect()
    }

    fn statistics_of(frames: &[Frame]) -> SlowTimeStatistics {
        let mut slow_time = SlowTimeStatistics::new(&waveform(), 10.0);
        frames.iter().for_each(|frame| slow_time.push(frame));
        slow_time.end();
        slow_time
    }

    /// A chest that moves by several wavelengths, and one that moves by a fraction of one.
    #[test]
    fn breathing_gives_level_range_and_rate() {
        for (swing_m, hz) in [(4e-3, 0.25), (0.25e-3, 0.3)] {
            let breath = |t: f64| 0.5 + swing_m * (std::f64::consts::TAU * hz * t + 0.4).sin();
            let line = statistics_of(&frames(200, 100.0, breath)).line().expect("a line");
            assert_eq!(line.windows, 2);
            assert!((line.range_m - 0.5).abs() < 0.01, "{line:?}");
            assert!(line.breath_hz.is_some_and(|found| (found - hz).abs() < 0.02), "{line:?}");
            // All power is moving if the phase turns fully; for a small oscillation only the sidebands are.
            let m = 4.0 * std::f64::consts::PI * swing_m / waveform().wavelength_m();
            let still: f64 =
                (0..4000).map(|i| (m * (std::f64::consts::TAU * f64::from(i) / 4000.0).sin()).cos()).sum::<f64>() / 4e3;
            let expected = 20.0 * (100.0 / 2048.0f64).log10() + 10.0 * (1.0 - still * still).log10();
            assert!((line.level_dbfs - expected).abs() < 1.0, "{line:?}, expected {expected}");
        }
    }

    #[test]
    fn a_static_echo_has_no_line_and_hardly_any_moving_power() {
        let still = statistics_of(&frames(100, 200.0, |_| 0.6));
        assert_eq!(still.line(), None);
        let bin = (0.6 / waveform().range_step_m(64)).round() as usize;
        let level_db = 10.0 * still.still(0, bin).expect("a window").log10();
        assert!((level_db - 20.0 * (200.0 / 2048.0f64).log10()).abs() < 1.5, "{level_db}");
        assert!(still.moving(0, bin).expect("a window") < 1e-7);
        let changes = still.changes(0, bin).expect("a window");
        assert!(
            changes.phase_rad2 < 1e-5 && changes.amplitude < 1e-5 && changes.drift_rad2_per_10s < 1e-4,
            "{changes:?}"
        );
    }

    /// Jitter of 10 um from frame to frame and drift of 40 um in ten seconds are recovered from the phase.
    #[test]
    fn small_motion_is_measured_by_its_phase() {
        let at = |t: f64| {
            let even = ((t / waveform().frame_interval_s()).round() as u64).is_multiple_of(2);
            0.5 + if even { 0.0 } else { 10e-6 } + 40e-6 * t / 10.0
        };
        let changes =
            statistics_of(&frames(100, 200.0, at)).changes(0, (0.5 / waveform().range_step_m(64)).round() as usize);
        let changes = changes.expect("a window");
        let rad_per_m = 4.0 * std::f64::consts::PI / waveform().wavelength_m();
        let jitter = (2.0 * changes.phase_rad2).sqrt() / rad_per_m;
        assert!((jitter / 10e-6 - 1.0).abs() < 0.1, "{jitter} m");
        let drift = changes.drift_rad2_per_10s.sqrt() / rad_per_m;
        assert!((drift / 40e-6 - 1.0).abs() < 0.15, "{drift} m");
        assert!(changes.amplitude < 1e-4, "{changes:?}");
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn windows_end_at_gaps_and_frames_of_other_shapes_are_ignored() {
            let mut all = frames(200, 100.0, |t| 0.5 + 2e-3 * (1.6 * t).sin());
            all.iter_mut().skip(60).for_each(|frame| frame.sequence += 7);
            all[3].codes.pop();
            let statistics = statistics_of(&all);
            // 57 to 60 frames, 100, and 40, which is less than half a window.
            assert_eq!(statistics.windows, 2);
            assert!(SlowTimeStatistics::new(&waveform(), 10.0).line().is_none());
            assert!(statistics.moving(0, 1000).is_none() && statistics.moving(9, 0).is_none());
        }
    }
}
