//! Range-Doppler maps: their specification ([`RdmSpec`]), the processor ([`RdmProcessor`]) and a slow [`mod@reference`].
//!
//! [`RdmProcessor`] checks a specification against a waveform and derives a plan: sizes, windows and scales. One of three
//! transforms then computes power from samples by that plan:
//! - `lanes`: both FFTs in vector registers, for sizes that are powers of two;
//! - `fourier`: `realfft` and `rustfft`, for any size, and for slow time across frames;
//! - `physical`: discrete Fourier sums at the ranges and velocities of [`PhysicalAxes`].

mod axes;
mod change;
mod error;
mod fourier;
mod lanes;
mod library_chain;
mod map;
mod motion;
mod motion_average;
mod nearer_change;
mod physical;
mod plan;
mod processor;
pub mod reference;
mod saturation;
mod spec;

pub use axes::{AxesCoverage, LEAST_CHIRPS, LEAST_SAMPLED_BAND_HZ, LEAST_SAMPLES, MOST_AXIS_BINS, PhysicalAxes};
pub use error::{MapMismatch, SpecError};
pub use library_chain::LibraryChain;
pub use map::{MapFlags, Rdm, RdmShape};
pub use motion::Motion;
pub use nearer_change::nearer_change;
pub use processor::{MapStatus, RdmProcessor};
pub use spec::{AmplitudeScale, Channels, RdmSpec, SampleScale, SlowTime, StaticRemoval};

#[cfg(test)]
mod tests;
