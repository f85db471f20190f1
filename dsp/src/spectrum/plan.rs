//! Plans of the FFT library.
//!
//! The library's transforms are generic, so each crate that plans one compiles all of them again. These functions are
//! compiled only once, in this crate, and never inlined elsewhere.

use std::sync::Arc;

use realfft::{ComplexToReal, RealFftPlanner, RealToComplex};
use rustfft::{Fft, FftPlanner};

/// Plans the forward FFT of `length` complex values.
#[inline(never)]
pub fn complex_fft(length: usize) -> Arc<dyn Fft<f64>> {
    FftPlanner::new().plan_fft_forward(length)
}

/// Plans the forward FFT of `length` complex values in single precision.
#[inline(never)]
pub fn complex_fft_f32(length: usize) -> Arc<dyn Fft<f32>> {
    FftPlanner::new().plan_fft_forward(length)
}

/// Plans the forward FFT of `length` real values: `length / 2 + 1` complex ones come out.
#[inline(never)]
pub fn real_fft(length: usize) -> Arc<dyn RealToComplex<f64>> {
    RealFftPlanner::new().plan_fft_forward(length)
}

/// Plans the forward FFT of `length` real values in single precision.
#[inline(never)]
pub fn real_fft_f32(length: usize) -> Arc<dyn RealToComplex<f32>> {
    RealFftPlanner::new().plan_fft_forward(length)
}

/// Plans the inverse FFT to `length` real values in single precision, without normalisation.
#[inline(never)]
pub fn inverse_real_fft_f32(length: usize) -> Arc<dyn ComplexToReal<f32>> {
    RealFftPlanner::new().plan_fft_inverse(length)
}
