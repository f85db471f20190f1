//! Range FFT of one chirp.

use std::sync::Arc;

use num_complex::Complex64;
use realfft::RealToComplex;
use rustfft::{Fft, FftPlannerScalar};

use super::plan::real_fft;

/// Range FFT of windowed samples, padded with zeros. Owns its buffers; transforms do not allocate.
pub(crate) struct RangeFft {
    transform: Transform,
    samples: usize,
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
    /// Plans an FFT of `length` points for chirps of `samples` samples. The library chooses the instructions.
    pub(crate) fn new(samples: usize, length: usize) -> Self {
        Self::with(Transform::Real(real_fft(length)), samples, length)
    }

    /// Plans the FFT with scalar instructions, so that different machines agree.
    pub(crate) fn scalar(samples: usize, length: usize) -> Self {
        Self::with(Transform::Scalar(FftPlannerScalar::new().plan_fft_forward(length)), samples, length)
    }

    fn with(transform: Transform, samples: usize, length: usize) -> Self {
        let scratch = match &transform {
            Transform::Real(fft) => fft.get_scratch_len(),
            Transform::Scalar(fft) => fft.get_inplace_scratch_len(),
        };
        RangeFft { transform, samples, input: vec![0.0; length], scratch: vec![Complex64::default(); scratch] }
    }

    /// Number of cells that [`transform`](Self::transform) writes: at least the bins up to the Nyquist frequency.
    pub(crate) fn bins(&self) -> usize {
        match self.transform {
            Transform::Real(_) => self.input.len() / 2 + 1,
            Transform::Scalar(_) => self.input.len(),
        }
    }

    /// Transforms the windowed samples of a chirp into `spectrum`, which has [`bins`](Self::bins) cells.
    pub(crate) fn transform(&mut self, windowed: impl Iterator<Item = f64>, spectrum: &mut [Complex64]) {
        self.input.iter_mut().zip(windowed).for_each(|(slot, x)| *slot = x);
        // The transform uses its input as scratch.
        self.input[self.samples..].fill(0.0);
        match &self.transform {
            Transform::Real(fft) => {
                let planned = fft.process_with_scratch(&mut self.input, spectrum, &mut self.scratch);
                debug_assert!(planned.is_ok(), "buffers have the planned lengths");
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

    /// A tone on a bin, padded twofold: half its amplitude times the samples, at twice the bin, by either planner and repeatedly.
    #[test]
    fn a_tone_is_found_in_its_bin_after_padding() {
        for mut fft in [RangeFft::new(16, 32), RangeFft::scalar(16, 32)] {
            let mut spectrum = vec![Complex64::default(); fft.bins()];
            for _ in 0..2 {
                fft.transform((0..16).map(|n| (TAU * 3.0 * f64::from(n) / 16.0).cos()), &mut spectrum);
                assert!((spectrum[6] - Complex64::new(8.0, 0.0)).norm() < 1e-12, "{}", spectrum[6]);
                assert!(spectrum[4].norm() < 1e-12 && spectrum[8].norm() < 1e-12);
            }
        }
    }
}
