//! Slow reference of maps: discrete Fourier sums in f64, by the formula.

use std::f64::consts::TAU;

use num_complex::Complex64;

use super::error::SpecError;
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
    let shape = spec.shape(waveform)?;
    let frame_shape = waveform.shape();
    let (n, slow) = (frame_shape.samples, spec.slow_time_length(waveform));
    let (factor, offset) = spec.scale.affine();
    let mut channels: Vec<usize> = match spec.channels {
        Channels::One(index) => vec![index],
        Channels::All | Channels::IncoherentSum => (0..frame_shape.rx).collect(),
    };
    let axes = spec.physical_axes.map(|axes| (axes, axes.coverage(waveform)));
    if let (Some(_), Some(frame)) = (&axes, frames.last()) {
        let alive: Vec<usize> = (0..frame_shape.rx).filter(|rx| !frame.is_receiver_dead(*rx)).collect();
        match (spec.channels, alive.first().copied()) {
            (Channels::IncoherentSum, Some(_)) => channels = alive,
            (Channels::One(index), Some(first)) if !alive.contains(&index) => channels = vec![first],
            _ => {}
        }
    }
    // Samples and chirps that are transformed, and the cells that are measured.
    let (samples, chirps, range_bins, velocity_bins) = match &axes {
        Some((_, c)) => (c.samples.clone(), c.chirps.clone(), 0..c.range_bins, c.velocity_bins.clone()),
        None => (0..n, 0..slow, 0..shape.range, 0..shape.doppler),
    };
    let range_window = spec.range_window.weights(samples.len());
    let doppler_window = spec.doppler_window.weights(chirps.len());
    let range_fft = spec.range_fft_length.unwrap_or(n);
    // Phases in cycles.
    let range_cycles = |k: usize, s: usize| match &axes {
        Some((axes, _)) => k as f64 * axes.range_step_m / waveform.range_step_m(1) * s as f64,
        None => ((k * s) % range_fft) as f64 / range_fft as f64,
    };
    let doppler_cycles = |i: usize, m: usize| match &axes {
        Some((axes, _)) => {
            let velocity_m_per_s = (i as f64 - (shape.doppler / 2) as f64) * axes.velocity_step_m_per_s;
            velocity_m_per_s / waveform.velocity_step_m_per_s(1) * m as f64
        }
        None => {
            // Index i holds the Doppler bin i - M/2.
            let l = (i + shape.doppler - shape.doppler / 2) % shape.doppler;
            ((l * m) % shape.doppler) as f64 / shape.doppler as f64
        }
    };
    let window_sum = range_window.iter().sum::<f64>() * doppler_window.iter().sum::<f64>();
    let one_sided = |bin: usize| if bin == 0 { 1.0 } else { 2.0 };
    let amplitude = |bin: usize| match spec.amplitude {
        AmplitudeScale::FullScaleSine => one_sided(bin) / window_sum,
        AmplitudeScale::Unnormalised => 1.0,
        AmplitudeScale::Vendor => one_sided(bin) / (samples.len() * chirps.len()) as f64,
    };

    let mut power = vec![0.0; channels.len() * shape.doppler * shape.range];
    for (index, &rx) in channels.iter().enumerate() {
        // x[frame][chirp][sample] with offset removal.
        let mut x: Vec<Vec<Vec<f64>>> = frames
            .iter()
            .map(|frame| {
                (0..frame_shape.chirps)
                    .map(|chirp| {
                        let mut row: Vec<f64> =
                            frame.chirp(rx, chirp).iter().map(|c| f64::from(*c) * factor + offset).collect();
                        if spec.chirp_mean_removal {
                            let mean = row.iter().sum::<f64>() / n as f64;
                            row.iter_mut().for_each(|v| *v -= mean);
                        }
                        row
                    })
                    .collect()
            })
            .collect();
        if let StaticRemoval::RecursiveMti { alpha } = spec.static_removal {
            let mut background = vec![vec![0.0; n]; frame_shape.chirps];
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
        let frames_before = x.clone();
        let slow_time: Vec<Vec<f64>> = match spec.slow_time {
            SlowTime::Chirps => x.pop().unwrap_or_default(),
            SlowTime::Frames { .. } => x
                .iter()
                .map(|frame| (0..n).map(|s| frame.iter().map(|row| row[s]).sum::<f64>() / frame.len() as f64).collect())
                .collect(),
        };
        let profile_of = |slow_time: &[Vec<f64>], k: usize| -> Vec<Complex64> {
            let of_chirp = |row: &Vec<f64>| {
                row[samples.clone()]
                    .iter()
                    .zip(&range_window)
                    .enumerate()
                    .map(|(s, (v, w))| Complex64::from_polar(v * w, -TAU * range_cycles(k, s)))
                    .sum()
            };
            slow_time.iter().take(chirps.end).skip(chirps.start).map(of_chirp).collect()
        };
        for k in range_bins.clone() {
            let mut profile = profile_of(&slow_time, k);
            if spec.static_removal == StaticRemoval::SlowTimeMean {
                let mean = profile.iter().sum::<Complex64>() / profile.len() as f64;
                profile.iter_mut().for_each(|v| *v -= mean);
            }
            for i in velocity_bins.clone() {
                let sum: Complex64 = profile
                    .iter()
                    .zip(&doppler_window)
                    .enumerate()
                    .map(|(m, (v, w))| v * Complex64::from_polar(*w, -TAU * doppler_cycles(i, m)))
                    .sum();
                power[(index * shape.doppler + i) * shape.range + k] = (amplitude(k) * sum.norm()).powi(2);
            }
            if let Some(time_s) = spec.change_over_s {
                let zero_velocity = |frame: &Vec<Vec<f64>>| -> Complex64 {
                    profile_of(frame, k).iter().zip(&doppler_window).map(|(v, w)| v * w).sum()
                };
                let sums: Vec<Complex64> = frames_before.iter().map(zero_velocity).collect();
                let i = shape.doppler / 2;
                power[(index * shape.doppler + i) * shape.range + k] =
                    amplitude(k).powi(2) * change(&sums, waveform.frame_interval_s() / time_s);
            }
        }
    }
    if spec.channels == Channels::IncoherentSum {
        let cells = shape.doppler * shape.range;
        power = (0..cells)
            .map(|cell| power.iter().skip(cell).step_by(cells).sum::<f64>() / channels.len() as f64)
            .collect();
    }
    let floor_power = 10f64.powf(spec.floor_db / 10.0);
    Ok(power.into_iter().map(|p| 10.0 * if p < floor_power { floor_power } else { p }.log10()).collect())
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
