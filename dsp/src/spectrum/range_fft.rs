//! Range FFT of one chirp.

use std::sync::Arc;

use num_complex::Complex64;
use realfft::RealToComplex;
use rustfft::{Fft, FftPlannerScalar};

use super::plan::real_fft;

/// Range FFT of chirps under a window, padded with zeros. Owns its buffers; transforms do not allocate.
pub(crate) struct RangeFft {
    transform: Transform,
    /// Weights of the samples of a chirp.
    window: Vec<f64>,
    /// Windowed samples, padded to the length of the FFT.
    input: Vec<f64>,
    scratch: Vec<Complex64>,
}

enum Transform {
    Real(Arc<dyn RealToComplex<f64>>),
    /// The scalar planner has no transform for real input.
    Scalar(Arc<dyn Fft<f64>>),
}

impl RangeFft {
    /// Plans an FFT of `length` points for chirps of as many samples as the window has weights. The library chooses the
    /// instructions.
    pub(crate) fn new(window: Vec<f64>, length: usize) -> Self {
        Self::with_transform(Transform::Real(real_fft(length)), window, length)
    }

    /// Plans the FFT with scalar instructions, so that different machines agree.
    pub(crate) fn scalar(window: Vec<f64>, length: usize) -> Self {
        Self::with_transform(Transform::Scalar(FftPlannerScalar::new().plan_fft_forward(length)), window, length)
    }

    fn with_transform(transform: Transform, window: Vec<f64>, length: usize) -> Self {
        let scratch = match &transform {
            Transform::Real(fft) => fft.get_scratch_len(),
            Transform::Scalar(fft) => fft.get_inplace_scratch_len(),
        };
        RangeFft { transform, window, input: vec![0.0; length], scratch: vec![Complex64::default(); scratch] }
    }

    /// Number of cells of a spectrum: at least the bins up to the Nyquist frequency.
    pub(crate) fn bins(&self) -> usize {
        match self.transform {
            Transform::Real(_) => self.input.len() / 2 + 1,
            Transform::Scalar(_) => self.input.len(),
        }
    }

    /// Factor by which the amplitude of a sine of codes over the whole range of the ADC becomes 1.
    pub(crate) fn full_scale_factor(&self) -> f64 {
        2.0 / (self.window.iter().sum::<f64>() * 2048.0)
    }

    /// Transforms the samples of a chirp into `spectrum`, which has [`bins`](Self::bins) cells.
    pub(crate) fn transform(&mut self, samples: impl Iterator<Item = f64>, spectrum: &mut [Complex64]) {
        self.input.iter_mut().zip(samples.zip(&self.window)).for_each(|(slot, (x, w))| *slot = x * w);
        self.transform_input(spectrum);
    }

    /// Transforms the codes of a chirp less their mean into `spectrum`. `scale` applies to the windowed samples.
    pub(crate) fn transform_codes(
        &mut self,
        codes: impl Iterator<Item = f64> + Clone,
        scale: impl Fn(f64) -> f64,
        spectrum: &mut [Complex64],
    ) {
        let mean = codes.clone().sum::<f64>() / self.window.len() as f64;
        let windowed = codes.zip(&self.window).map(|(code, w)| scale((code - mean) * w));
        self.input.iter_mut().zip(windowed).for_each(|(slot, x)| *slot = x);
        self.transform_input(spectrum);
    }

    fn transform_input(&mut self, spectrum: &mut [Complex64]) {
        // The last transform overwrote the padding: it uses its input as scratch.
        self.input[self.window.len()..].fill(0.0);
        match &self.transform {
            Transform::Real(fft) => {
                let result = fft.process_with_scratch(&mut self.input, spectrum, &mut self.scratch);
                debug_assert!(result.is_ok(), "buffers have the planned lengths");
            }
            Transform::Scalar(fft) => {
                spectrum.iter_mut().zip(&self.input).for_each(|(y, x)| *y = Complex64::new(*x, 0.0));
                fft.process_with_scratch(spectrum, &mut self.scratch);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::TAU;

    use super::*;
    use crate::Window;

    /// A tone on a bin, padded twofold: half its amplitude times the samples, at twice the bin, by either planner and repeatedly.
    #[test]
    fn a_tone_is_found_in_its_bin_after_padding() {
        for mut fft in [RangeFft::new(vec![1.0; 16], 32), RangeFft::scalar(vec![1.0; 16], 32)] {
            let mut spectrum = vec![Complex64::default(); fft.bins()];
            for _ in 0..2 {
                fft.transform((0..16).map(|n| (TAU * 3.0 * f64::from(n) / 16.0).cos()), &mut spectrum);
                assert!((spectrum[6] - Complex64::new(8.0, 0.0)).norm() < 1e-12, "{}", spectrum[6]);
                assert!(spectrum[4].norm() < 1e-12 && spectrum[8].norm() < 1e-12);
            }
        }
    }

    #[test]
    fn a_full_scale_sine_of_codes_has_amplitude_one() {
        let mut fft = RangeFft::new(Window::Hann.weights(16), 16);
        let factor = fft.full_scale_factor();
        let mut spectrum = vec![Complex64::default(); fft.bins()];
        let codes = (0..16).map(|n| 2048.0 + 2048.0 * (TAU * 3.0 * f64::from(n) / 16.0).cos());
        fft.transform_codes(codes, |x| x * factor, &mut spectrum);
        assert!((spectrum[3] - Complex64::new(1.0, 0.0)).norm() < 1e-12, "{}", spectrum[3]);
        assert!(spectrum[0].norm() < 1e-12, "the mean is removed");
    }
}
