//! Thermal noise on the raw samples of frames, added before maps are computed.

use radome_dsp::rdm::SampleScale;
use radome_dsp::{Frame, FrameMismatch, MapStatus, Rdm, RdmProcessor};
use radome_models::stream;
use rand_distr::{Distribution, StandardNormal};

/// Sum of the squared deviations of codes from the mean of their chirp of `samples` samples. An offset is no signal.
pub fn signal_squares(codes: &[u16], samples: usize) -> f64 {
    let of_chirp = |chirp: &[u16]| {
        let mean = chirp.iter().map(|&code| f64::from(code)).sum::<f64>() / chirp.len() as f64;
        chirp.iter().map(|&code| (f64::from(code) - mean).powi(2)).sum::<f64>()
    };
    codes.chunks_exact(samples.max(1)).map(of_chirp).sum()
}

/// White Gaussian noise on the samples of one recording or run.
///
/// In each frame, the variance of a receiver's noise is the mean square of its samples about the mean of their chirp,
/// over `10^(snr_db / 10)`. Static echoes, leakage and the receiver's own noise count as signal. The noise is drawn by
/// recording, receiver and frame. Its draws are the same at all ratios except for their scale, and do not depend on the
/// number of receivers in a frame. Samples are not rounded to codes again, and noise is not clipped to the ADC's range.
pub struct RawNoise<'a> {
    /// Signal-to-noise power ratio, dB.
    pub snr_db: f64,
    /// Seed of the run; 0 for a recording.
    pub seed: u64,
    pub recording: &'a str,
}

impl RawNoise<'_> {
    /// Writes the samples of a frame with noise into `samples`, `[rx][chirp][sample]` in the given scale.
    fn samples(&self, frame: &Frame, scale: SampleScale, samples: &mut Vec<f32>) {
        let (factor, offset) = scale.affine();
        samples.clear();
        samples.extend(frame.codes.iter().map(|&code| (f64::from(code) * factor + offset) as f32));
        let length = (frame.shape.chirps * frame.shape.samples).max(1);
        let receivers = samples.chunks_exact_mut(length).zip(frame.codes.chunks_exact(length));
        for (rx, (samples, codes)) in receivers.enumerate() {
            let power = signal_squares(codes, frame.shape.samples) / length as f64;
            let sigma = factor * (power / 10f64.powf(0.1 * self.snr_db)).sqrt();
            let purpose = format!("thermal noise of {} on receiver {rx}", self.recording);
            let mut rng = stream(self.seed, &purpose, frame.sequence);
            for sample in samples {
                let draw: f64 = StandardNormal.sample(&mut rng);
                *sample += (sigma * draw) as f32;
            }
        }
    }
}

/// Processor from frames to maps, optionally with noise on the samples of the frames.
pub struct NoisyProcessor<'a> {
    pub processor: RdmProcessor,
    noise: Option<RawNoise<'a>>,
    samples: Vec<f32>,
}

impl<'a> NoisyProcessor<'a> {
    pub fn new(processor: RdmProcessor, noise: Option<RawNoise<'a>>) -> Self {
        NoisyProcessor { processor, noise, samples: Vec::new() }
    }

    /// Computes the map of a frame ([`RdmProcessor::process`]).
    ///
    /// # Errors
    /// Those of [`RdmProcessor::process`].
    pub fn process(&mut self, frame: &Frame, map: &mut Rdm) -> Result<MapStatus, FrameMismatch> {
        let Some(noise) = &self.noise else { return self.processor.process(frame, map) };
        noise.samples(frame, self.processor.spec().scale, &mut self.samples);
        self.processor.process_changed_samples(frame, &self.samples, map)
    }
}

#[cfg(test)]
mod tests {
    use radome_dsp::FrameShape;

    use super::*;

    const SHAPE: FrameShape = FrameShape { rx: 3, chirps: 64, samples: 64 };

    /// A tone in each receiver, each with its own amplitude (codes), on an offset that differs between chirps.
    fn frame(amplitudes: [f64; 3], sequence: u64) -> Frame {
        let mut frame = Frame { sequence, ..Frame::zeroed(SHAPE) };
        for (index, code) in frame.codes.iter_mut().enumerate() {
            let (rx, chirp, sample) = (index / (64 * 64), index / 64 % 64, index % 64);
            let tone = amplitudes[rx] * (std::f64::consts::TAU * 5.0 * sample as f64 / 64.0).cos();
            *code = (2000.0 + chirp as f64 + tone).round() as u16;
        }
        frame
    }

    fn samples(frame: &Frame, snr_db: f64) -> Vec<f32> {
        let noise = RawNoise { snr_db, seed: 7, recording: "hall-seed7" };
        let mut samples = Vec::new();
        noise.samples(frame, SampleScale::FullScale, &mut samples);
        samples
    }

    /// Noise that is added to the samples of a frame, codes.
    fn added(frame: &Frame, snr_db: f64) -> Vec<f64> {
        let clean = samples(frame, f64::INFINITY);
        let difference = |(noisy, clean): (&f32, &f32)| 2048.0 * f64::from(noisy - clean);
        samples(frame, snr_db).iter().zip(&clean).map(difference).collect()
    }

    fn mean_square(values: &[f64]) -> f64 {
        values.iter().map(|value| value * value).sum::<f64>() / values.len() as f64
    }

    /// A tone of amplitude A has the power A^2 / 2, regardless of its offset.
    #[test]
    fn the_power_of_the_noise_is_that_of_the_ratio_in_each_receiver() {
        let amplitudes = [400.0, 100.0, 25.0];
        for snr_db in [-20.0, -10.0, 0.0, 10.0, 20.0] {
            let added = added(&frame(amplitudes, 3), snr_db);
            for (added, amplitude) in added.chunks_exact(64 * 64).zip(amplitudes) {
                let ratio = 0.5 * amplitude * amplitude / mean_square(added);
                let found_db = 10.0 * ratio.log10();
                // The mean square of 4096 draws deviates by 0.1 dB.
                assert!((found_db - snr_db).abs() < 0.4, "{amplitude}: {found_db} dB, expected {snr_db} dB");
            }
        }
    }

    /// White noise: neighbouring samples, chirps and receivers are uncorrelated.
    #[test]
    fn the_noise_is_white() {
        let added = added(&frame([200.0; 3], 3), 0.0);
        let power = mean_square(&added);
        for lag in [1, 64, 64 * 64] {
            let products = added.iter().zip(&added[lag..]).map(|(a, b)| a * b);
            let correlation = products.sum::<f64>() / (added.len() - lag) as f64 / power;
            assert!(correlation.abs() < 0.05, "lag {lag}: {correlation}");
        }
    }

    #[test]
    fn noise_is_drawn_by_frame_and_receiver_and_only_its_size_follows_the_ratio() {
        let three = frame([200.0; 3], 3);
        let weak = added(&three, 20.0);
        for (weak, strong) in weak.iter().zip(added(&three, 0.0)) {
            assert!((10.0 * weak - strong).abs() < 1e-2, "{weak} {strong}");
        }
        assert_ne!(weak, added(&frame([200.0; 3], 4), 20.0));
        // Receivers that no map uses are not simulated. The others have the same noise without them.
        let mut first = Frame::zeroed(FrameShape { rx: 1, ..SHAPE });
        first.sequence = 3;
        first.codes.copy_from_slice(&three.codes[..64 * 64]);
        assert_eq!(samples(&first, 20.0)[..], samples(&three, 20.0)[..64 * 64]);
    }

    mod hard_cases {
        use super::*;

        /// Without noise, samples are those that a processor computes from codes. A constant signal has no power and
        /// gets no noise.
        #[test]
        fn an_infinite_ratio_and_no_signal_give_no_noise() {
            let three = frame([200.0; 3], 3);
            let clean: Vec<f32> = three.codes.iter().map(|&code| (f64::from(code) / 2048.0 - 1.0) as f32).collect();
            assert_eq!(samples(&three, f64::INFINITY), clean);
            let mut constant = Frame::zeroed(SHAPE);
            constant.codes.fill(2048);
            assert!(samples(&constant, -20.0).iter().all(|sample| *sample == 0.0));
        }
    }
}
