//! Signals that the receiver adds to every chirp independently of the scene, and quantisation by the ADC.

use radome_dsp::{MAX_CODE, Waveform};

use super::{Leakage, RxChannel};
use crate::lanes::compiled_for_levels;

/// Leakage and settling over one chirp, LSB.
pub fn leakage_chirp_lsb(channel: &RxChannel, waveform: &Waveform) -> Vec<f32> {
    (0..waveform.request.samples_per_chirp)
        .map(|n| {
            let t = n as f64 / waveform.sample_rate_hz;
            let tones = channel.leakage.iter().map(|l| l.amplitude_lsb * l.phase_at_rad(waveform, t).cos());
            let settling = channel.transient.iter().map(|s| s.amplitude_lsb * (-t / s.time_constant_s).exp());
            (tones.sum::<f64>() + settling.sum::<f64>()) as f32
        })
        .collect()
}

/// Contribution of the leakage to the signal that phase noise multiplies ([`super::phase_noise`]), over one chirp, LSB
/// s.
pub fn leakage_by_delay_lsb_s(channel: &RxChannel, waveform: &Waveform) -> Vec<f32> {
    (0..waveform.request.samples_per_chirp)
        .map(|n| {
            let t = n as f64 / waveform.sample_rate_hz;
            let tone = |l: &Leakage| -l.delay_s * l.amplitude_lsb * l.phase_at_rad(waveform, t).sin();
            channel.leakage.iter().map(tone).sum::<f64>() as f32
        })
        .collect()
}

/// Rounds to the nearest code and clips at both ends; NaN reads 0.
#[inline(always)]
pub fn quantise(lsb: f32) -> u16 {
    /// 2^23: adding it leaves an integer in a number's last bits. A conversion would be one lane at a time.
    const SHIFT: f32 = 8_388_608.0;
    // Comparisons convert NaN to 0.
    let code = if lsb > 0.0 { lsb + 0.5 } else { 0.0 };
    let code = if code < f32::from(MAX_CODE) { code.floor() } else { f32::from(MAX_CODE) };
    (code + SHIFT).to_bits() as u16
}

compiled_for_levels! {
    /// Rounds samples to codes ([`quantise`]).
    pub(crate) fn quantise_all(samples: &[f32], codes: &mut [u16]) = quantise_body;
}

#[inline(always)]
fn quantise_body(samples: &[f32], codes: &mut [u16]) {
    for (code, sample) in codes.iter_mut().zip(samples) {
        *code = quantise(*sample);
    }
}
