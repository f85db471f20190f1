//! Conversion of delays to tones: phase and beat frequency of a path at the middle of a chirp.

use radome_dsp::Waveform;

/// Constants of a waveform's chirp.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Chirp {
    /// Transmit frequency at the first sample, Hz.
    pub start_hz: f64,
    /// Slope, Hz/s.
    pub slope_hz_per_s: f64,
    /// ADC rate, Hz.
    pub sample_rate_hz: f64,
    /// Time from the first sample to sample N/2, s.
    pub middle_s: f64,
}

impl Chirp {
    /// Returns the chirp constants of a waveform.
    pub fn new(waveform: &Waveform) -> Self {
        Chirp {
            start_hz: waveform.sampled_start_frequency_hz,
            slope_hz_per_s: waveform.slope_hz_per_s,
            sample_rate_hz: waveform.sample_rate_hz,
            middle_s: (waveform.request.samples_per_chirp / 2) as f64 / waveform.sample_rate_hz,
        }
    }

    /// Phase at the middle of the chirp, cycles: `f0 tau + S tau t_c - S tau^2/2`.
    #[inline(always)]
    pub fn phase_cycles(&self, delay_s: f64) -> f64 {
        delay_s * (self.start_hz + self.slope_hz_per_s * (self.middle_s - 0.5 * delay_s))
    }

    /// Beat frequency, Hz: `S tau + (f0 + S t_c - S tau) tau'`.
    #[inline(always)]
    pub fn beat_hz(&self, delay_s: f64, delay_rate: f64) -> f64 {
        let s = self.slope_hz_per_s;
        s * delay_s + (self.start_hz + s * (self.middle_s - delay_s)) * delay_rate
    }
}
