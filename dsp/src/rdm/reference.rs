//! Slow reference of maps and of motion: sums in f64, by the formulas.

use std::f64::consts::TAU;

use num_complex::Complex64;

use super::axes::AxesCoverage;
use super::error::SpecError;
use super::map::{Rdm, RdmShape};
use super::motion::Motion;
use super::motion_average as average;
use super::nearer_change::nearer_change;
use super::spec::{AmplitudeScale, Channels, RdmSpec, SlowTime, StaticRemoval};
use crate::{Frame, Waveform};

/// Map of the last of `frames` in dB, `[rx][doppler][range]`, in f64.
///
/// With `x[m, n]` the samples of slow time `m` and fast time `n`,
/// `X[l, k] = sum_m sum_n w_m w_n x[m, n] exp(-j 2 pi (l m / M + k n / N))`, and the cell is
/// `20 log10(a_k |X[l, k]|)` with the scale `a_k` of the spec's [`AmplitudeScale`].
/// With [`SlowTime::Frames`], `frames` must be exactly the window. Recursive MTI and change run over all of `frames`.
///
/// On physical axes `k / N` is the range of a cell over the range of one cycle per sample, `l / M` its velocity over that of one
/// cycle per chirp. Cells that the waveform does not measure read the floor; [`RdmProcessor`](super::RdmProcessor) fills them
/// with drawn noise.
///
/// # Errors
/// [`SpecError`] under the conditions of [`RdmSpec::shape`].
///
/// # Panics
/// If a frame has another shape than the waveform's, or fewer codes than its shape says.
pub fn map(spec: &RdmSpec, waveform: &Waveform, frames: &[Frame]) -> Result<Vec<f64>, SpecError> {
    let sums = Sums::new(spec, waveform)?;
    let cells = sums.shape.doppler * sums.shape.range;
    let channels = channels(spec, waveform, frames.last());
    let mut power = vec![0.0; channels.len() * cells];
    for (rx, power) in channels.iter().zip(power.chunks_exact_mut(cells)) {
        sums.channel(&samples(spec, waveform, frames, *rx), power);
    }
    if spec.channels == Channels::IncoherentSum {
        power = (0..cells)
            .map(|cell| power.iter().skip(cell).step_by(cells).sum::<f64>() / channels.len() as f64)
            .collect();
    }
    let floor_power = 10f64.powf(spec.floor_db / 10.0);
    Ok(power.into_iter().map(|p| 10.0 * if p < floor_power { floor_power } else { p }.log10()).collect())
}

/// Indices of the channels that the map of a frame shows or sums.
fn channels(spec: &RdmSpec, waveform: &Waveform, frame: Option<&Frame>) -> Vec<usize> {
    let all: Vec<usize> = (0..waveform.shape().rx).collect();
    let is_alive = |rx: &usize| !frame.is_some_and(|frame| frame.is_receiver_dead(*rx));
    let alive: Vec<usize> = all.iter().copied().filter(is_alive).collect();
    let replaces_dead = spec.physical_axes.is_some() && !alive.is_empty();
    match spec.channels {
        Channels::One(index) if replaces_dead && !alive.contains(&index) => alive.into_iter().take(1).collect(),
        Channels::One(index) => vec![index],
        Channels::IncoherentSum if replaces_dead => alive,
        Channels::All | Channels::IncoherentSum => all,
    }
}

/// Samples `[frame][chirp][sample]` of one channel in the spec's scale, after removal of chirp means and recursive MTI.
fn samples(spec: &RdmSpec, waveform: &Waveform, frames: &[Frame], rx: usize) -> Vec<Vec<Vec<f64>>> {
    let shape = waveform.shape();
    let (factor, offset) = spec.scale.affine();
    let row = |frame: &Frame, chirp: usize| {
        let mut row: Vec<f64> = frame.chirp(rx, chirp).iter().map(|c| f64::from(*c) * factor + offset).collect();
        if spec.chirp_mean_removal {
            let mean = row.iter().sum::<f64>() / shape.samples as f64;
            row.iter_mut().for_each(|v| *v -= mean);
        }
        row
    };
    let mut x: Vec<Vec<Vec<f64>>> =
        frames.iter().map(|frame| (0..shape.chirps).map(|chirp| row(frame, chirp)).collect()).collect();
    if let StaticRemoval::RecursiveMti { alpha } = spec.static_removal {
        let mut background = vec![vec![0.0; shape.samples]; shape.chirps];
        for frame in &mut x {
            for (row, h) in frame.iter_mut().zip(&mut background) {
                for (v, h) in row.iter_mut().zip(h) {
                    let raw = *v;
                    *v = raw - *h;
                    *h = alpha * raw + (1.0 - alpha) * *h;
                }
            }
        }
    }
    x
}

/// Fourier sums of a spec over frames of a waveform.
struct Sums<'a> {
    spec: &'a RdmSpec,
    waveform: &'a Waveform,
    shape: RdmShape,
    /// Samples and chirps that are transformed, and cells that are measured.
    coverage: AxesCoverage,
    range_window: Vec<f64>,
    doppler_window: Vec<f64>,
}

impl<'a> Sums<'a> {
    fn new(spec: &'a RdmSpec, waveform: &'a Waveform) -> Result<Self, SpecError> {
        let shape = spec.shape(waveform)?;
        let (range_resolution_m, velocity_resolution_m_per_s) = spec.steps(waveform);
        let all = AxesCoverage {
            samples: 0..waveform.shape().samples,
            chirps: 0..spec.slow_time_length(waveform),
            range_bins: shape.range,
            velocity_bins: 0..shape.doppler,
            range_resolution_m,
            velocity_resolution_m_per_s,
        };
        let coverage = spec.coverage(waveform).unwrap_or(all);
        let range_window = spec.range_window.weights(coverage.samples.len());
        let doppler_window = spec.doppler_window.weights(coverage.chirps.len());
        Ok(Sums { spec, waveform, shape, coverage, range_window, doppler_window })
    }

    /// Power of the measured cells, `[doppler][range]`, of one channel's samples `[frame][chirp][sample]`.
    fn channel(&self, frames: &[Vec<Vec<f64>>], power: &mut [f64]) {
        let mean_chirp = |frame: &Vec<Vec<f64>>| -> Vec<f64> {
            let samples = 0..self.waveform.shape().samples;
            samples.map(|s| frame.iter().map(|row| row[s]).sum::<f64>() / frame.len() as f64).collect()
        };
        let slow_time: Vec<Vec<f64>> = match self.spec.slow_time {
            SlowTime::Chirps => frames.last().cloned().unwrap_or_default(),
            SlowTime::Frames { .. } => frames.iter().map(mean_chirp).collect(),
        };
        for k in 0..self.coverage.range_bins {
            let amplitude = self.amplitude(k);
            let mut profile = self.profile(&slow_time, k);
            if self.spec.static_removal == StaticRemoval::SlowTimeMean {
                let mean = profile.iter().sum::<Complex64>() / profile.len() as f64;
                profile.iter_mut().for_each(|v| *v -= mean);
            }
            for i in self.coverage.velocity_bins.clone() {
                let terms = profile.iter().zip(&self.doppler_window).enumerate();
                let sum: Complex64 =
                    terms.map(|(m, (v, w))| v * Complex64::from_polar(*w, -TAU * self.doppler_cycles(i, m))).sum();
                power[i * self.shape.range + k] = (amplitude * sum.norm()).powi(2);
            }
            if let Some(time_s) = self.spec.change_over_s {
                let zero_velocity = |frame: &Vec<Vec<f64>>| -> Complex64 {
                    self.profile(frame, k).iter().zip(&self.doppler_window).map(|(v, w)| v * w).sum()
                };
                let sums: Vec<Complex64> = frames.iter().map(zero_velocity).collect();
                power[self.shape.doppler / 2 * self.shape.range + k] =
                    amplitude.powi(2) * change(&sums, self.waveform.frame_interval_s() / time_s);
            }
        }
    }

    /// Range bin `k` of each transformed chirp.
    fn profile(&self, slow_time: &[Vec<f64>], k: usize) -> Vec<Complex64> {
        let AxesCoverage { samples, chirps, .. } = &self.coverage;
        let bin_of_chirp = |row: &Vec<f64>| {
            let terms = row[samples.clone()].iter().zip(&self.range_window).enumerate();
            terms.map(|(s, (v, w))| Complex64::from_polar(v * w, -TAU * self.range_cycles(k, s))).sum()
        };
        slow_time.iter().take(chirps.end).skip(chirps.start).map(bin_of_chirp).collect()
    }

    /// Phase of range bin `k` at sample `s`, in cycles.
    fn range_cycles(&self, k: usize, s: usize) -> f64 {
        if let Some(axes) = self.spec.physical_axes {
            return k as f64 * axes.range_step_m / self.waveform.range_step_m(1) * s as f64;
        }
        let range_fft = self.spec.range_fft_length.unwrap_or(self.waveform.shape().samples);
        ((k * s) % range_fft) as f64 / range_fft as f64
    }

    /// Phase of Doppler index `i` at chirp `m`, in cycles.
    fn doppler_cycles(&self, i: usize, m: usize) -> f64 {
        let doppler = self.shape.doppler;
        if let Some(axes) = self.spec.physical_axes {
            let velocity_m_per_s = (i as f64 - (doppler / 2) as f64) * axes.velocity_step_m_per_s;
            return velocity_m_per_s / self.waveform.velocity_step_m_per_s(1) * m as f64;
        }
        // Index i holds the Doppler bin i - M/2.
        let l = (i + doppler - doppler / 2) % doppler;
        ((l * m) % doppler) as f64 / doppler as f64
    }

    /// Scale of range bin `k`.
    fn amplitude(&self, k: usize) -> f64 {
        let one_sided = if k == 0 { 1.0 } else { 2.0 };
        match self.spec.amplitude {
            AmplitudeScale::FullScaleSine => {
                one_sided / (self.range_window.iter().sum::<f64>() * self.doppler_window.iter().sum::<f64>())
            }
            AmplitudeScale::Unnormalised => 1.0,
            AmplitudeScale::Vendor => 2.0 / (self.coverage.samples.len() * self.coverage.chirps.len()) as f64,
        }
    }
}

/// Power of change of a sequence. Its weights fall by `exp(-step)` from a frame to the one before, and are equal at the beginning.
fn change(sums: &[Complex64], step: f64) -> f64 {
    let mut weights: Vec<f64> = Vec::new();
    for count in 1..=sums.len() {
        let newest = (1.0 - (-step).exp()).max(1.0 / count as f64);
        weights.iter_mut().for_each(|weight| *weight *= 1.0 - newest);
        weights.push(newest);
    }
    let weighted = || sums.iter().zip(&weights);
    let mean: Complex64 = weighted().map(|(z, w)| z * w).sum();
    let variance: f64 = weighted().map(|(z, w)| w * (z - mean).norm_sqr()).sum();
    variance * variance / (variance + mean.norm_sqr()).max(f64::MIN_POSITIVE)
}

/// Motion of the last of `maps`, in f64. They are of one channel, finite, and in the order of their sequence numbers.
///
/// Each map is compared with the earlier one whose age is closest to 0.3 s, and the comparisons are averaged with weights that fall by
/// `1/e` over `over_s`. Change nearer than the motion counts only if `has_change`. Maps before a gap of more than a second do not count.
/// Intervals of frames must be at least 20 ms.
///
/// # Panics
/// If sequence numbers decrease.
pub fn motion(maps: &[Rdm], frame_interval_s: f64, over_s: f64, has_change: bool) -> Motion {
    let seconds = |from: &Rdm, to: &Rdm| (to.sequence - from.sequence) as f64 * frame_interval_s;
    let is_gap = |pair: &[Rdm]| seconds(&pair[0], &pair[1]) > average::MOST_AGE_S;
    let maps = &maps[maps.windows(2).rposition(is_gap).map_or(0, |gap| gap + 1)..];
    let Some(last) = maps.last() else { return Motion::default() };
    let profiles: Vec<MovingProfile> = maps.iter().map(MovingProfile::new).collect();
    let (mut sums, mut weights, mut nearer_change) = ([0.0; average::AVERAGES], 0.0, 0f64);
    for (index, map) in maps.iter().enumerate() {
        let age = |earlier: usize| seconds(&maps[earlier], map);
        let from_lag = |earlier: usize| (age(earlier) - average::LAG_S).abs();
        let closest = (0..=index).rev().min_by(|a, b| from_lag(*a).total_cmp(&from_lag(*b))).unwrap_or(index);
        let weight = (-seconds(map, last) / over_s).exp();
        let comparison = profiles[index].compare(&profiles[closest], age(closest));
        sums.iter_mut().zip(comparison).for_each(|(sum, quantity)| *sum += weight * quantity);
        weights += weight;
        let of_map = if has_change { nearer_change_of(map) } else { 0.0 };
        nearer_change = nearer_change.max(of_map * (-seconds(map, last) / average::HELD_S).exp());
    }
    let averages = sums.map(|sum| (sum / weights) as f32);
    Motion::from_array(std::array::from_fn(|k| averages.get(k).copied().unwrap_or(nearer_change as f32)))
}

/// Change nearer than the motion in one map, 0 to 1.
fn nearer_change_of(map: &Rdm) -> f64 {
    let zero = map.shape.doppler / 2;
    let cells: Vec<(f64, f64, f64)> = (0..map.shape.range)
        .filter(|range| map.range_m(*range) >= average::LEAKAGE_M)
        .flat_map(|range| {
            let levels: Vec<f64> = (0..map.shape.doppler).map(|d| f64::from(map.at(0, d, range))).collect();
            let over_noise_db = move |d: usize| over_noise_db(&levels, levels[d]);
            (0..map.shape.doppler).map(move |d| (map.range_m(range), map.velocity_m_per_s(d), over_noise_db(d)))
        })
        .collect();
    let (changes, motions): (Vec<_>, Vec<_>) = cells.into_iter().partition(|cell| cell.1 == map.velocity_m_per_s(zero));
    let strongest = motions.into_iter().reduce(|best, cell| if cell.2 > best.2 { cell } else { best });
    let Some((range_m, velocity, motion_db)) = strongest else { return 0.0 };
    let nearer = changes.into_iter().filter(|change| range_m - change.0 > average::NEARER_M);
    let change_db = nearer.map(|change| change.2).fold(0.0, f64::max);
    if velocity.abs() > average::SLOW_M_PER_S { nearer_change(change_db as f32, motion_db as f32) } else { 0.0 }
}

/// `1 + P / N` of a cell in dB, for the levels of its range bin.
fn over_noise_db(levels: &[f64], level_db: f64) -> f64 {
    let mut sorted = levels.to_vec();
    sorted.sort_unstable_by(f64::total_cmp);
    let noise_db = sorted[sorted.len() / 4] - 10.0 * (4.0f64 / 3.0).ln().log10();
    10.0 * (1.0 + 10f64.powf((level_db - noise_db) / 10.0)).log10()
}

/// Strongest moving cells of a map by range: `(range_m, velocity_m_per_s, dB over noise)`.
struct MovingProfile(Vec<(f64, f64, f64)>);

impl MovingProfile {
    fn new(map: &Rdm) -> Self {
        let cell = |range: usize| {
            let levels: Vec<f64> = (0..map.shape.doppler).map(|d| f64::from(map.at(0, d, range))).collect();
            let moving = (0..map.shape.doppler).filter(|d| map.velocity_m_per_s(*d).abs() > average::SLOW_M_PER_S);
            let strongest = moving.reduce(|best, d| if levels[d] > levels[best] { d } else { best });
            let (velocity, level_db) = strongest.map_or((0.0, f64::MIN), |d| (map.velocity_m_per_s(d), levels[d]));
            let is_leakage = map.range_m(range) < average::LEAKAGE_M;
            (map.range_m(range), velocity, if is_leakage { 0.0 } else { over_noise_db(&levels, level_db) })
        };
        MovingProfile((0..map.shape.range).map(cell).collect())
    }

    /// Strongest of the cells that fulfil a condition.
    fn strongest(&self, condition: impl Fn(f64) -> bool) -> (f64, f64, f64) {
        let cells = self.0.iter().copied().filter(|cell| condition(cell.0));
        cells.reduce(|best, cell| if cell.2 > best.2 { cell } else { best }).unwrap_or((0.0, 0.0, 0.0))
    }

    fn is_moving(&self) -> bool {
        self.strongest(|_| true).2 > f64::from(average::MOTION_DB)
    }

    /// The larger of a level below the strongest cell and a level over noise.
    fn threshold(&self, [below_db, over_noise_db]: [f32; 2]) -> f64 {
        (self.strongest(|_| true).2 - f64::from(below_db)).max(f64::from(over_noise_db))
    }

    fn weight(&self, bin: i64) -> f64 {
        let cell = usize::try_from(bin).ok().and_then(|bin| self.0.get(bin));
        cell.map_or(0.0, |cell| (cell.2 - self.threshold(average::PROFILE_DB)).max(0.0).sqrt())
    }

    /// Sum over ranges of the products of the weights with those of another profile, shifted.
    fn overlap(&self, other: &MovingProfile, shift: i64) -> f64 {
        (0..self.0.len() as i64).map(|bin| self.weight(bin) * other.weight(bin - shift)).sum()
    }

    fn nearest(&self) -> (f64, f64, f64) {
        let least_db = self.threshold(average::NEAREST_DB);
        self.0.iter().copied().find(|cell| cell.2 > least_db).unwrap_or((0.0, 0.0, 0.0))
    }

    fn second(&self) -> Option<(f64, f64, f64)> {
        let nearest_m = self.nearest().0;
        let second = self.strongest(|range_m| range_m - nearest_m > average::BEHIND_M);
        (second.2 > f64::from(average::SECOND_DB)).then_some(second)
    }

    fn compare(&self, earlier: &MovingProfile, age_s: f64) -> [f64; average::AVERAGES] {
        let second = self.second().filter(|_| self.is_moving());
        let share = if second.is_some() { 1.0 } else { 0.0 };
        let velocity_difference = second.map_or(0.0, |second| (second.1 - self.nearest().1).abs());
        if age_s == 0.0 || !self.is_moving() || !earlier.is_moving() {
            return [0.0, 0.0, 0.0, 0.0, share, velocity_difference];
        }
        let spacings = |profile: &MovingProfile| -> Vec<f64> {
            (1..profile.0.len() as i64).map(|distance| profile.overlap(profile, distance)).collect()
        };
        let product = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        let (now, before) = (spacings(self), spacings(earlier));
        let lengths = (product(&now, &now) * product(&before, &before)).sqrt();
        let spacing_change_rad = if lengths == 0.0 { 0.0 } else { (product(&now, &before) / lengths).min(1.0).acos() };

        let range_step_m = self.0.get(1).map_or(1.0, |second| second.0 - self.0[0].0);
        let most = (average::MOST_SHIFT_M / range_step_m).round() as i64;
        let overlaps = (-most..=most).map(|shift| (shift, self.overlap(earlier, shift)));
        let best = overlaps.reduce(|best, other| if other.1 > best.1 { other } else { best }).unwrap_or((0, 0.0));
        let error_m = |way_m: f64, velocity: f64, velocity_before: f64| {
            (way_m - 0.5 * (velocity + velocity_before) * age_s).abs().min(average::MOST_DISTANCE_M)
        };
        let (strongest, strongest_before) = (self.strongest(|_| true), earlier.strongest(|_| true));
        let (nearest, nearest_before) = (self.nearest(), earlier.nearest());
        let separation_change_m = match (second, earlier.second()) {
            (Some(second), Some(second_before)) => {
                ((second.0 - nearest.0) - (second_before.0 - nearest_before.0)).abs().min(average::MOST_DISTANCE_M)
            }
            _ => 0.0,
        };
        [
            spacing_change_rad,
            error_m(best.0 as f64 * range_step_m, strongest.1, strongest_before.1),
            error_m(nearest.0 - nearest_before.0, nearest.1, nearest_before.1),
            separation_change_m,
            share,
            velocity_difference,
        ]
    }
}
