//! Plans of FFTs, range spectra in f64 and their peaks.

mod peak;
mod plan;
mod range_fft;

pub use plan::{complex_fft, complex_fft_f32, inverse_real_fft_f32, real_fft, real_fft_f32};

pub(crate) use peak::peak_offset;
pub(crate) use range_fft::RangeFft;
