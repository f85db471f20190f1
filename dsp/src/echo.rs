//! Echoes of what moves, finer than a cell: range, radial speed and direction of each.
//!
//! Two looks. What moves within a frame ([`EchoFinder::moving`]) has cells of its own in the frame's range-Doppler maps, one
//! complex map a receiver. What sits or stands moves too little for that; but it changes from frame to frame
//! ([`EchoFinder::still`]), and what changes at a range has a direction as well.
//!
//! Ranges are those of the echo itself in the middle of the frame: a beat is `S tau + 2 v f / c`, and the second term, range
//! bias by speed, is taken off.

use std::sync::Arc;

use num_complex::Complex64;
use realfft::{RealFftPlanner, RealToComplex};
use rustfft::{Fft, FftPlanner};

use crate::angle::Baseline;
use crate::{Frame, MapError, Waveform, Window};

/// Points of the range transform for each sample: peaks between bins are told from the shape of the window's main lobe.
const RANGE_PADDING: usize = 2;
/// An echo is a local maximum so far above the noise of its range, dB: noise alone, of three receivers together, reaches it
/// once in some ten million cells.
const LEAST_SNR_DB: f64 = 12.0;
/// Echoes of a frame, the strongest.
const MOST_ECHOES: usize = 12;
/// Two maxima nearer than this to each other are one echo: in range resolutions, and in m/s.
const SAME_RANGE: f64 = 1.5;
const SAME_VELOCITY_M_PER_S: f64 = 0.3;
/// Half the width of Doppler about a maximum that makes up a trunk's speed: the parts of a trunk differ by as much, m/s.
const TRUNK_M_PER_S: f64 = 0.15;
/// Of what is alive at least so much of the energy changes between frames: the echo of walls and furniture only drifts and
/// jitters.
const LEAST_CHANGING: f64 = 0.05;
/// Range bins, from the first, that hold what leaks from transmitter to receiver and how a chirp begins: no map tells anything
/// there.
pub const LEAKAGE_BINS: usize = 3;

/// An echo.
#[derive(Debug, Clone, PartialEq)]
pub struct Echo {
    /// Range, m.
    pub range_m: f64,
    /// Radial speed, positive receding, m/s; within the unambiguous span. 0 of what is still.
    pub velocity_m_per_s: f64,
    /// Its cell over the noise at its range, dB.
    pub snr_db: f64,
    /// Cosine of the angle to each baseline; `None` where there is none.
    pub cosines: Vec<Option<f64>>,
    /// Whether it was found between frames.
    pub is_still: bool,
}

/// A frame's mean chirp as a range profile of each receiver, `[rx][range]`: what [`EchoFinder::still`] compares.
#[derive(Debug, Clone, PartialEq)]
pub struct RangeProfile(Vec<Complex64>);

/// Finds echoes in frames of a waveform. Owns its plans and buffers.
pub struct EchoFinder {
    waveform: Waveform,
    baselines: Vec<Baseline>,
    range_window: Vec<f64>,
    doppler_window: Vec<f64>,
    range_fft: Arc<dyn RealToComplex<f64>>,
    doppler_fft: Arc<dyn Fft<f64>>,
    /// Range bins, padded.
    bins: usize,
    /// `[rx][range][chirp]`, later `[rx][range][doppler]` with zero Doppler in the middle.
    cells: Vec<Complex64>,
    /// `[range][doppler]`, all receivers.
    power: Vec<f64>,
}

impl EchoFinder {
    /// For frames of a waveform, with the pairs of receivers that tell direction.
    pub fn new(waveform: &Waveform, baselines: &[Baseline]) -> Self {
        let shape = waveform.shape();
        let length = RANGE_PADDING * shape.samples;
        let bins = length / 2;
        EchoFinder {
            waveform: waveform.clone(),
            baselines: baselines.to_vec(),
            range_window: Window::Hann.weights(shape.samples),
            doppler_window: Window::Hann.weights(shape.chirps),
            range_fft: RealFftPlanner::new().plan_fft_forward(length),
            doppler_fft: FftPlanner::new().plan_fft_forward(shape.chirps),
            bins,
            cells: vec![Complex64::default(); shape.rx * bins * shape.chirps],
            power: vec![0.0; bins * shape.chirps],
        }
    }

    /// What moves within a frame, the strongest first; and the frame's profile, for [`EchoFinder::still`].
    ///
    /// # Errors
    /// A frame of another shape than the waveform's.
    pub fn moving(&mut self, frame: &Frame) -> Result<(Vec<Echo>, RangeProfile), MapError> {
        let profile = self.transform(frame)?;
        let (doppler, bins) = (self.doppler_window.len(), self.bins);
        let noise: Vec<f64> =
            self.power.chunks_exact(doppler.max(1)).map(|row| noise_power(row.iter().copied())).collect();
        let at = |range: usize, d: usize| self.power.get(range * doppler + d).copied().unwrap_or(0.0);
        let zero = doppler / 2;
        let least = 10f64.powf(0.1 * LEAST_SNR_DB);
        let mut peaks: Vec<(f64, usize, usize)> = Vec::new();
        for range in (RANGE_PADDING * LEAKAGE_BINS)..bins.saturating_sub(1) {
            for d in 0..doppler {
                let cell = at(range, d);
                // Static removal leaves nothing at zero Doppler; velocity goes round.
                if d == zero || cell <= least * noise.get(range).copied().unwrap_or(f64::INFINITY) {
                    continue;
                }
                let (before, after) = ((d + doppler - 1) % doppler, (d + 1) % doppler);
                let higher = [before, d, after].iter().any(|&d| at(range - 1, d) > cell || at(range + 1, d) > cell)
                    || at(range, before) > cell
                    || at(range, after) > cell;
                if !higher {
                    peaks.push((cell, range, d));
                }
            }
        }
        peaks.sort_by(|a, b| b.0.total_cmp(&a.0));
        let mut echoes: Vec<Echo> = Vec::new();
        for (power, range, d) in peaks {
            let echo = self.echo_at(range, d, ratio_db(power, noise.get(range).copied().unwrap_or(power)));
            let span = 2.0 * self.waveform.max_velocity_m_per_s();
            let is_known = echoes.iter().any(|other| {
                let apart = other.velocity_m_per_s - echo.velocity_m_per_s;
                let apart = apart - span * (apart / span).round();
                (other.range_m - echo.range_m).abs() < SAME_RANGE * self.waveform.range_resolution_m()
                    && apart.abs() < SAME_VELOCITY_M_PER_S
            });
            if !is_known {
                echoes.push(echo);
            }
            if echoes.len() == MOST_ECHOES {
                break;
            }
        }
        Ok((echoes, profile))
    }

    /// What changes between frames, the strongest first: profiles of a few seconds, whatever stands out at its range from
    /// what changes at most ranges.
    pub fn still(&self, profiles: &[&RangeProfile]) -> Vec<Echo> {
        let rx = self.waveform.shape().rx;
        if profiles.len() < 3 {
            return Vec::new();
        }
        let count = profiles.len() as f64;
        let row = |profile: &&RangeProfile, cell: usize| profile.0.get(cell).copied().unwrap_or_default();
        // What is left of each cell when its mean over the frames is taken out.
        let changes: Vec<Vec<Complex64>> = (0..rx * self.bins)
            .map(|cell| {
                let mean = profiles.iter().map(|p| row(p, cell)).sum::<Complex64>() / count;
                profiles.iter().map(|p| row(p, cell) - mean).collect()
            })
            .collect();
        let power_of = |cell: usize| changes.get(cell).map_or(0.0, |c| c.iter().map(Complex64::norm_sqr).sum::<f64>());
        let power: Vec<f64> =
            (0..self.bins).map(|range| (0..rx).map(|rx| power_of(rx * self.bins + range)).sum()).collect();
        let noise = noise_power(power.iter().skip(RANGE_PADDING * LEAKAGE_BINS).copied());
        let mean_power = |cell: usize| profiles.iter().map(|p| row(p, cell)).sum::<Complex64>().norm_sqr() / count;
        let mut echoes = Vec::new();
        for range in (RANGE_PADDING * LEAKAGE_BINS)..self.bins.saturating_sub(1) {
            let [before, cell, after] = [range - 1, range, range + 1].map(|i| power.get(i).copied().unwrap_or(0.0));
            let snr_db = ratio_db(cell, noise);
            let still = (0..rx).map(|rx| mean_power(rx * self.bins + range)).sum::<f64>();
            if before > cell || after > cell || snr_db < LEAST_SNR_DB || cell < LEAST_CHANGING * (cell + still) {
                continue;
            }
            let cosines = self.baselines.iter().map(|baseline| {
                let pair = |range: usize| {
                    let of = |rx: usize| changes.get(rx * self.bins + range).map_or(&[][..], Vec::as_slice);
                    of(baseline.to).iter().zip(of(baseline.from)).map(|(a, b)| a * b.conj()).sum::<Complex64>()
                };
                let cross = pair(range - 1) + pair(range) + pair(range + 1);
                baseline.cosine(cross, self.waveform.wavelength_m())
            });
            echoes.push(Echo {
                range_m: (range as f64 + vertex(before, cell, after)) * self.bin_m(),
                velocity_m_per_s: 0.0,
                snr_db,
                cosines: cosines.collect(),
                is_still: true,
            });
        }
        echoes.sort_by(|a, b| b.snr_db.total_cmp(&a.snr_db));
        echoes.truncate(MOST_ECHOES);
        echoes
    }

    /// The strongest of what stands still between two ranges, m, in the mean of profiles: a reflector that was put there.
    /// Its level is over the noise of a cell as ranges about it show it, which is no noise where rooms are full.
    pub fn standing(&self, profiles: &[&RangeProfile], within_m: std::ops::Range<f64>) -> Option<Echo> {
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
        let range = (1..self.bins.saturating_sub(1)).filter(is_within).max_by(|&a, &b| at(a).total_cmp(&at(b)))?;
        let cosines = self.baselines.iter().map(|baseline| {
            let pair = |range: usize| cell(baseline.to, range) * cell(baseline.from, range).conj();
            baseline.cosine(pair(range - 1) + pair(range) + pair(range + 1), self.waveform.wavelength_m())
        });
        Some(Echo {
            range_m: (range as f64 + vertex(at(range - 1), at(range), at(range + 1))) * self.bin_m(),
            velocity_m_per_s: 0.0,
            snr_db: ratio_db(at(range), noise_power(power.iter().copied())),
            cosines: cosines.collect(),
            is_still: true,
        })
    }

    fn bin_m(&self) -> f64 {
        self.waveform.range_step_m(RANGE_PADDING * self.range_window.len())
    }

    /// Complex maps of all receivers, and their power; returns the mean chirps' profiles.
    fn transform(&mut self, frame: &Frame) -> Result<RangeProfile, MapError> {
        let shape = self.waveform.shape();
        if frame.shape != shape {
            return Err(MapError::Shape { sequence: frame.sequence, expected: shape, got: frame.shape });
        }
        if frame.codes.len() != shape.codes() {
            return Err(MapError::Length { sequence: frame.sequence, expected: shape.codes(), got: frame.codes.len() });
        }
        let (bins, chirps) = (self.bins, shape.chirps);
        let mut input = self.range_fft.make_input_vec();
        let mut output = self.range_fft.make_output_vec();
        let mut profile = vec![Complex64::default(); shape.rx * bins];
        for (index, chirp) in frame.codes.chunks_exact(shape.samples).enumerate() {
            let (rx, m) = (index / chirps, index % chirps);
            let mean = chirp.iter().map(|&code| f64::from(code)).sum::<f64>() / shape.samples as f64;
            input.fill(0.0);
            for ((x, &code), w) in input.iter_mut().zip(chirp).zip(&self.range_window) {
                *x = (f64::from(code) - mean) * w;
            }
            let planned = self.range_fft.process(&mut input, &mut output);
            debug_assert!(planned.is_ok(), "buffers have the planned lengths");
            for (bin, value) in output.iter().take(bins).enumerate() {
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

    /// The echo about a local maximum.
    fn echo_at(&self, range: usize, d: usize, snr_db: f64) -> Echo {
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
        let near = |range: usize| at(range, d - 1) + at(range, d) + at(range, d + 1);
        let place = range as f64 + vertex(near(range - 1), near(range), near(range + 1));
        // c f_D / 2 S = v f / S.
        let by_speed_m = velocity_m_per_s * self.waveform.centre_frequency_hz() / self.waveform.slope_hz_per_s;
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
        Echo {
            range_m: place * self.bin_m() - by_speed_m,
            velocity_m_per_s,
            snr_db,
            cosines: cosines.collect(),
            is_still: false,
        }
    }
}

/// Where between -1/2 and 1/2 a parabola through the decibels of three neighbours has its top. With a Hann window padded twice
/// it is right within a two-hundredth of a range resolution.
fn vertex(before: f64, middle: f64, after: f64) -> f64 {
    let [a, b, c] = [before, middle, after].map(|p| p.max(f64::MIN_POSITIVE).ln());
    let curvature = a - 2.0 * b + c;
    if curvature < 0.0 { (0.5 * (a - c) / curvature).clamp(-0.5, 0.5) } else { 0.0 }
}

/// Power over noise, dB: of nothing none, and no more than a 12-bit sample can hold where there is no noise.
fn ratio_db(power: f64, noise: f64) -> f64 {
    const MOST_DB: f64 = 120.0;
    if power > 0.0 { (10.0 * (power / noise).log10()).min(MOST_DB) } else { 0.0 }
}

/// Mean of exponentially distributed noise from its median, which targets hardly move.
fn noise_power(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_unstable_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(0.0) / std::f64::consts::LN_2
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
            let nearer_m = if rx == BASELINE.to { BASELINE.length_m * sine } else { 0.0 };
            let way_m = 2.0 * (range_m + velocity_m_per_s * (slow_s + t - middle_s)) - nearer_m;
            let tau = way_m / SPEED_OF_LIGHT_M_PER_S;
            let (f0, slope) = (waveform.sampled_start_frequency_hz, waveform.slope_hz_per_s);
            let cycles = f0 * tau + slope * tau * t - 0.5 * slope * tau * tau;
            *code = (2048.0 + level_lsb * (TAU * cycles.fract()).cos()).round() as u16;
        }
        frame
    }

    fn waveform() -> Waveform {
        Waveform::realise(WaveformRequest::paper()).expect("valid")
    }

    #[test]
    fn range_speed_and_direction_of_a_point_are_told_within_a_cell() {
        let waveform = waveform();
        let mut finder = EchoFinder::new(&waveform, &[BASELINE]);
        for (range_m, velocity, sine) in
            [(2.0, 1.2, 0.1), (2.043, -1.13, -0.4), (5.51, 0.31, 0.0), (9.99, -2.2, 0.7), (3.3, 0.777, -0.2)]
        {
            let (echoes, _) = finder.moving(&frame(&waveform, range_m, velocity, sine, 200.0)).expect("a frame");
            let echo = echoes.first().expect("an echo");
            assert!((echo.range_m - range_m).abs() < 0.005, "{range_m} m: {echo:?}");
            assert!((echo.velocity_m_per_s - velocity).abs() < 0.005, "{velocity} m/s: {echo:?}");
            let told = echo.cosines.first().copied().flatten().expect("a direction");
            assert!((told - sine).abs() < 0.005, "{sine}: {echo:?}");
        }
    }

    /// Half a millimetre to and fro, as a chest does in a breath, changes the phase by a quarter turn and more.
    #[test]
    fn what_only_breathes_is_found_between_frames() {
        let waveform = waveform();
        let mut finder = EchoFinder::new(&waveform, &[BASELINE]);
        let profiles: Vec<RangeProfile> = (0..20)
            .map(|i| {
                let range_m = 3.02 + 1e-3 * (0.3 * f64::from(i)).sin();
                let (echoes, profile) = finder.moving(&frame(&waveform, range_m, 0.0, 0.25, 100.0)).expect("a frame");
                assert!(echoes.iter().all(|e| (e.range_m - 3.02).abs() > 0.1), "nothing moves within a frame");
                profile
            })
            .collect();
        let echoes = finder.still(&profiles.iter().collect::<Vec<_>>());
        let echo = echoes.first().expect("an echo");
        assert!((echo.range_m - 3.02).abs() < 0.01, "{echo:?}");
        assert!((echo.cosines[0].expect("a direction") - 0.25).abs() < 0.01, "{echo:?}");
    }

    #[test]
    fn a_reflector_that_stands_there_is_found_between_its_ranges() {
        let waveform = waveform();
        let mut finder = EchoFinder::new(&waveform, &[BASELINE]);
        let mut scene = frame(&waveform, 2.5, 0.0, -0.3, 60.0);
        let wall = frame(&waveform, 5.0, 0.0, 0.1, 300.0);
        scene.codes.iter_mut().zip(&wall.codes).for_each(|(a, b)| *a = *a + *b - 2048);
        let (_, profile) = finder.moving(&scene).expect("a frame");
        let echo = finder.standing(&[&profile, &profile], 2.0..3.0).expect("an echo");
        assert!((echo.range_m - 2.5).abs() < 0.01, "{echo:?}");
        assert!((echo.cosines[0].expect("a direction") + 0.3).abs() < 0.01, "{echo:?}");
        assert_eq!(finder.standing(&[&profile], 100.0..200.0), None);
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn empty_and_foreign_frames() {
            let waveform = waveform();
            let mut finder = EchoFinder::new(&waveform, &[]);
            let (echoes, profile) = finder.moving(&Frame::zeroed(waveform.shape())).expect("a frame");
            assert!(echoes.is_empty());
            assert!(finder.still(&[&profile; 5]).is_empty() && finder.still(&[]).is_empty());
            let mut other = waveform.shape();
            other.chirps += 1;
            assert!(matches!(finder.moving(&Frame::zeroed(other)), Err(MapError::Shape { .. })));
            let mut cut = Frame::zeroed(waveform.shape());
            cut.codes.pop();
            assert!(matches!(finder.moving(&cut), Err(MapError::Length { .. })));
        }

        #[test]
        fn two_who_cross_at_one_range_are_two_echoes_by_speed() {
            let waveform = waveform();
            let mut both = frame(&waveform, 4.0, 1.0, 0.2, 300.0);
            let other = frame(&waveform, 4.05, -0.8, -0.2, 200.0);
            both.codes.iter_mut().zip(&other.codes).for_each(|(a, b)| *a = *a + *b - 2048);
            let mut finder = EchoFinder::new(&waveform, &[BASELINE]);
            let (echoes, _) = finder.moving(&both).expect("a frame");
            let near = |v: f64, sine: f64| {
                echoes.iter().any(|e| {
                    (e.velocity_m_per_s - v).abs() < 0.02 && e.cosines[0].is_some_and(|c| (c - sine).abs() < 0.02)
                })
            };
            assert!(near(1.0, 0.2) && near(-0.8, -0.2), "{echoes:?}");
        }
    }
}
