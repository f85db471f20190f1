//! Slow reference of maps: discrete Fourier sums in f64, by the formula.

use std::f64::consts::TAU;

use num_complex::Complex64;

use super::axes::AxesCoverage;
use super::error::SpecError;
use super::map::RdmShape;
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
