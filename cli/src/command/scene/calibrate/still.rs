//! Static echoes in recordings: their level relative to a scene's, and their drift.

use radome_dsp::{Waveform, Window};
use radome_sim::receiver::calibration::gain::{self, Bin, GainFit, fit_gain};
use serde::Serialize;

use super::copies::Copies;
use super::measured::Measured;

/// Power ratio of an echo to the noise from which its jitter can be measured.
const LEAST_OVER_NOISE: f64 = 100.0;
/// Largest moving fraction of an echo's power, which a drift of 0.6 rad in ten seconds reaches.
const MOST_MOVING: f64 = 0.3;
/// Least number of bins for an estimate of clutter.
const LEAST_BINS: usize = 3;

/// Drift of static echoes: medians of bins, noise subtracted.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Clutter {
    pub phase_jitter_rad: f64,
    pub phase_drift_rad_per_10s: f64,
    pub amplitude_jitter: f64,
    /// Number of bins that contributed.
    pub bins: usize,
}

/// Fits jitter and drift of clutter to the static echoes, if there are enough.
pub fn fit_clutter(waveform: &Waveform, measured: &mut Measured) -> Option<Clutter> {
    let step_m = waveform.range_step_m(waveform.request.samples_per_chirp);
    let first = (gain::LEAST_RANGE_M / step_m).ceil() as usize;
    let real = &measured.fitted_slow_time;
    let (mut phases, mut drifts, mut amplitudes) = (Vec::new(), Vec::new(), Vec::new());
    for (rx, channel) in measured.fit.channels.iter().enumerate() {
        let noise = frame_noise(&channel.density_lsb2, waveform);
        for (bin, noise) in noise.iter().enumerate().take(real.bins()).skip(first) {
            let (Some(still), Some(moving)) = (real.still(rx, bin), real.moving(rx, bin)) else { continue };
            let Some(changes) = real.changes(rx, bin).filter(|_| still >= LEAST_OVER_NOISE * noise) else { continue };
            if moving <= MOST_MOVING * still {
                // Half of the noise is in phase with the echo, half in quadrature.
                let noise_share = 0.5 * noise / still;
                phases.push((changes.phase_rad2 - noise_share).max(0.0).sqrt());
                amplitudes.push((changes.amplitude - noise_share).max(0.0).sqrt());
                drifts.push(changes.drift_rad2_per_10s.sqrt());
            }
        }
    }
    if phases.len() < LEAST_BINS {
        return None;
    }
    let bins = phases.len();
    let clutter = Clutter {
        phase_jitter_rad: median(phases),
        phase_drift_rad_per_10s: median(drifts),
        amplitude_jitter: median(amplitudes).min(1.0),
        bins,
    };
    let fitted = &mut measured.fit.receiver.clutter;
    fitted.phase_jitter_rad = clutter.phase_jitter_rad;
    fitted.phase_drift_rad_per_10s = clutter.phase_drift_rad_per_10s;
    fitted.amplitude_jitter = clutter.amplitude_jitter;
    Some(clutter)
}

/// Fits the level of echoes to the static echoes in the recordings and in the scene without people, if there are
/// enough.
///
/// # Errors
/// The simulation fails.
pub fn fit_level(waveform: &Waveform, copies: &Copies, measured: &mut Measured) -> anyhow::Result<GainFit> {
    let clutter = copies.clutter(&measured.fit.receiver)?;
    let real = &measured.fitted_slow_time;
    let step_m = waveform.range_step_m(waveform.request.samples_per_chirp);
    let mut bins = Vec::new();
    for (rx, channel) in measured.fit.channels.iter().enumerate() {
        let noise = frame_noise(&channel.density_lsb2, waveform);
        bins.extend(noise.iter().enumerate().filter_map(|(bin, noise)| {
            Some(Bin {
                range_m: bin as f64 * step_m,
                measured: real.still(rx, bin)?,
                moving: real.moving(rx, bin)?,
                simulated: clutter.still(rx, bin)?,
                noise: *noise,
            })
        }));
    }
    let fit = fit_gain(&bins);
    measured.fit.receiver.gain_correction_db += fit.gain_db.unwrap_or(0.0);
    Ok(fit)
}

/// Noise power in the bins of a frame's mean range profile, relative to full scale, in the convention of the slow-time
/// statistics.
fn frame_noise(density_lsb2: &[f64], waveform: &Waveform) -> Vec<f64> {
    let taper = Window::Hann.weights(waveform.request.samples_per_chirp);
    let (sum, squares) = taper.iter().fold((0.0, 0.0), |(s, q), w| (s + w, q + w * w));
    let scale = squares * (2.0 / (sum * 2048.0)).powi(2) / waveform.request.chirps_per_frame as f64;
    density_lsb2.iter().map(|density| density * scale).collect()
}

/// Returns the median; zero of an empty list.
fn median(mut values: Vec<f64>) -> f64 {
    values.sort_unstable_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or_default()
}
