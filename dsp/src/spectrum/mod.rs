//! Range spectra in f64 and their peaks.

mod peak;
mod range_fft;

pub(crate) use peak::peak_offset;
pub(crate) use range_fft::RangeFft;
