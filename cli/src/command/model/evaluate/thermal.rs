//! Thermal noise on a recording's raw samples, with a given signal-to-noise ratio.

use std::path::Path;

use radome_driver::recording::Recording;
use radome_dsp::{Frame, FrameSource, MAX_CODE};
use rand_distr::{Distribution, Normal};

use crate::dataset::spec::MOST_SNR_DB;
use crate::dataset::thermal::signal_squares;
use crate::source;

/// Gaussian noise that is added to every sample before it is rounded to a code again.
pub struct ThermalNoise {
    normal: Normal<f64>,
    seed: u64,
}

/// Parses a signal-to-noise ratio, dB.
///
/// # Errors
/// The text is no number within [`MOST_SNR_DB`].
pub fn snr_db(text: &str) -> Result<f64, String> {
    let number = text.parse::<f64>().ok().filter(|number| (-MOST_SNR_DB..=MOST_SNR_DB).contains(number));
    number.ok_or_else(|| format!("expected -{MOST_SNR_DB} to {MOST_SNR_DB}"))
}

impl ThermalNoise {
    /// Creates noise whose variance is the signal's over `10^(snr_db / 10)`. The signal's variance is that of the
    /// samples about the mean of their chirp, over the whole recording: an offset is no signal.
    ///
    /// # Errors
    /// The recording cannot be read, or the ratio gives no finite noise.
    pub fn for_recording(path: &Path, snr_db: f64) -> anyhow::Result<Self> {
        let mut source = Recording::open(path)?;
        let shape = source.waveform().shape();
        let mut frame = Frame::zeroed(shape);
        let (mut sum, mut count) = (0f64, 0u64);
        while source::next_frame(&mut source, &mut frame)? {
            sum += signal_squares(&frame.codes, shape.samples);
            count += frame.codes.len() as u64;
        }
        let sigma = (sum / count.max(1) as f64 / 10f64.powf(0.1 * snr_db)).sqrt();
        // Each recording has noise of its own, which is the same at every ratio but for its size.
        Ok(ThermalNoise { normal: Normal::new(0.0, sigma)?, seed: sum.to_bits() })
    }

    /// Returns a frame with noise, the same in every call. Codes are limited to the converter's range, so noise at its ends has
    /// less variance. Noise of datasets ([`RawNoise`](crate::dataset::thermal::RawNoise)) is not cut off.
    pub fn add_to(&self, frame: &Frame) -> Frame {
        let mut noisy = frame.clone();
        let mut rng = radome_models::stream(self.seed, "thermal noise", frame.sequence);
        for code in &mut noisy.codes {
            let sample = f64::from(*code) + self.normal.sample(&mut rng);
            *code = sample.round().clamp(0.0, f64::from(MAX_CODE)) as u16;
        }
        noisy
    }
}

#[cfg(test)]
mod tests {
    use radome_driver::RecordingHeader;
    use radome_driver::recording::{Format, RecordingWriter};
    use radome_dsp::{Waveform, WaveformRequest};

    use super::*;

    /// Noise that is added to a recording of one frame with a tone of this amplitude, codes.
    fn added_noise(amplitude: f64, snr_db: f64) -> Vec<f64> {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("tone.mcap");
        let request = WaveformRequest { samples_per_chirp: 64, chirps_per_frame: 16, ..WaveformRequest::paper() };
        let waveform = Waveform::realise(request).expect("a waveform");
        let mut frame = Frame::zeroed(waveform.shape());
        for (index, code) in frame.codes.iter_mut().enumerate() {
            *code = (2048.0 + amplitude * (index as f64).sin()).round() as u16;
        }
        let header = RecordingHeader::new(waveform);
        let mut writer = RecordingWriter::create(&path, Format::Mcap, &header).expect("a file");
        writer.frame(&frame).expect("written");
        writer.finish().expect("written");
        let noisy = ThermalNoise::for_recording(&path, snr_db).expect("noise").add_to(&frame);
        noisy.codes.iter().zip(&frame.codes).map(|(noisy, code)| f64::from(*noisy) - f64::from(*code)).collect()
    }

    /// Frames of one number had the same noise in all recordings, and other noise at another ratio.
    #[test]
    fn each_recording_has_its_own_noise_and_only_its_size_follows_the_ratio() {
        let (one, twice) = (added_noise(100.0, 0.0), added_noise(100.0, -20.0 * 2f64.log10()));
        // Both are rounded to codes.
        assert!(one.iter().zip(&twice).all(|(one, twice)| (2.0 * one - twice).abs() < 1.6));
        let other = added_noise(90.0, 0.0);
        let product = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        let correlation = product(&one, &other) / (product(&one, &one) * product(&other, &other)).sqrt();
        assert!(correlation.abs() < 0.2, "{correlation}");
    }
}
