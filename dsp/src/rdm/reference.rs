//! The slow, obvious map: discrete Fourier sums in f64, straight from the formula.

use std::f64::consts::TAU;

use num_complex::Complex64;

use super::{AmplitudeScale, Channels, RdmSpec, SlowTime, SpecError, StaticRemoval};
use crate::{Frame, Waveform};

/// Map of the last of `frames` in dB, `[rx][doppler][range]`, in f64.
///
/// With `x[m, n]` the samples of slow time `m` and fast time `n`,
/// `X[l, k] = sum_m sum_n w_m w_n x[m, n] exp(-j 2 pi (l m / M + k n / N))`, and the cell is
/// `20 log10(a_k |X[l, k]|)` with the scale `a_k` of the spec's [`AmplitudeScale`].
/// With [`SlowTime::Frames`] exactly the window must be given; recursive MTI runs over all frames given.
pub fn map(spec: &RdmSpec, waveform: &Waveform, frames: &[Frame]) -> Result<Vec<f64>, SpecError> {
    let shape = spec.shape(waveform)?;
    let frame_shape = waveform.shape();
    let (n, slow) = (frame_shape.samples, spec.slow_time_length(waveform));
    let (factor, offset) = spec.scale.affine();
    let channels: Vec<usize> = match spec.channels {
        Channels::One(index) => vec![index],
        Channels::All | Channels::IncoherentSum => (0..frame_shape.rx).collect(),
    };
    let range_window = spec.range_window.weights(n);
    let doppler_window = spec.doppler_window.weights(slow);
    let range_fft = spec.range_fft_length.unwrap_or(n);
    let window_sum = range_window.iter().sum::<f64>() * doppler_window.iter().sum::<f64>();
    let one_sided = |bin: usize| if bin == 0 { 1.0 } else { 2.0 };
    let amplitude = |bin: usize| match spec.amplitude {
        AmplitudeScale::FullScaleSine => one_sided(bin) / window_sum,
        AmplitudeScale::Unnormalised => 1.0,
        AmplitudeScale::Vendor => one_sided(bin) / (n * slow) as f64,
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
        let slow_time: Vec<Vec<f64>> = match spec.slow_time {
            SlowTime::Chirps => x.pop().unwrap_or_default(),
            SlowTime::Frames { .. } => x
                .iter()
                .map(|frame| (0..n).map(|s| frame.iter().map(|row| row[s]).sum::<f64>() / frame.len() as f64).collect())
                .collect(),
        };
        for k in 0..shape.range {
            let mut profile: Vec<Complex64> = slow_time
                .iter()
                .map(|row| {
                    row.iter()
                        .zip(&range_window)
                        .enumerate()
                        .map(|(s, (v, w))| {
                            Complex64::from_polar(v * w, -TAU * ((k * s) % range_fft) as f64 / range_fft as f64)
                        })
                        .sum()
                })
                .collect();
            if spec.static_removal == StaticRemoval::SlowTimeMean {
                let mean = profile.iter().sum::<Complex64>() / slow as f64;
                profile.iter_mut().for_each(|v| *v -= mean);
            }
            for i in 0..shape.doppler {
                // Index i holds the Doppler bin i - M/2.
                let l = (i + shape.doppler - shape.doppler / 2) % shape.doppler;
                let sum: Complex64 = profile
                    .iter()
                    .zip(&doppler_window)
                    .enumerate()
                    .map(|(m, (v, w))| {
                        v * Complex64::from_polar(*w, -TAU * ((l * m) % shape.doppler) as f64 / shape.doppler as f64)
                    })
                    .sum();
                power[(index * shape.doppler + i) * shape.range + k] = (amplitude(k) * sum.norm()).powi(2);
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
