//! Waveforms, frames and range-Doppler maps of the BGT60TR13C radar chip. Computations only: no files, sockets or threads.
//!
//! A [`FrameSource`] fills a [`Frame`], and an [`RdmProcessor`] computes its map, an [`Rdm`]:
//!
//! ```
//! use radome_dsp::{Frame, MapStatus, RdmProcessor, RdmSpec, SPEED_OF_LIGHT_M_PER_S, Waveform, WaveformRequest};
//!
//! let waveform = Waveform::realise(WaveformRequest::paper()).expect("the chip can produce it");
//!
//! // A static reflector at 3 m.
//! let mut frame = Frame::zeroed(waveform.shape());
//! let beat_hz = 2.0 * 3.0 * waveform.slope_hz_per_s / SPEED_OF_LIGHT_M_PER_S;
//! for (index, code) in frame.codes.iter_mut().enumerate() {
//!     let time_s = (index % frame.shape.samples) as f64 / waveform.sample_rate_hz;
//!     let beat = (std::f64::consts::TAU * beat_hz * time_s).cos();
//!     *code = (2048.0 + 500.0 * beat).round() as u16;
//! }
//!
//! let mut processor = RdmProcessor::new(&RdmSpec::default(), &waveform).expect("the spec suits the waveform");
//! let mut map = processor.empty_map();
//! assert_eq!(processor.process(&frame, &mut map).expect("a frame of this waveform"), MapStatus::Ready);
//!
//! // The strongest cell beyond zero range is at 3 m and 0 m/s.
//! let zero = map.shape.doppler / 2;
//! let range = (3..map.shape.range).max_by(|a, b| map.at(0, zero, *a).total_cmp(&map.at(0, zero, *b)));
//! let range_m = map.range_m(range.expect("a bin"));
//! assert!((range_m - 3.0).abs() < map.range_step_m);
//! assert_eq!(map.velocity_m_per_s(zero), 0.0);
//! ```
//!
//! # Modules
//! Each imports only those above it.
//! - Basic types, re-exported here: [`Frame`], [`Waveform`], [`FrameSource`], [`Window`], [`KernelLevel`].
//! - [`decibel`]: conversion of power to dB.
//! - [`spectrum`]: plans of FFTs, for all crates.
//! - [`rdm`]: range-Doppler maps.
//! - [`detect`]: CFAR, detections with range, radial velocity and direction, a classical counter of people.
//! - [`statistics`]: distributions of cells, noise floor, static and moving power over seconds.
//!
//! # Conventions
//! The whole workspace follows these conventions.
//! - **Units.** SI, and the unit is part of the name: `start_frequency_hz`, `range_m`. Angles are in radians, except where
//!   the name ends in `_deg`.
//! - **Samples** are real 12-bit codes in `u16`, `[rx][chirp][sample]`; a recording is `[frame][rx][chirp][sample]`.
//! - **Maps** are `f32` dB, `[rx][doppler][range]`. Zero Doppler is at index `M/2`; the velocity of index `i` is
//!   `(i - M/2) * velocity_step`, **positive when receding**. Range bin `k` is at `k * range_step`. Both steps follow
//!   from the band that is *sampled* ([`Waveform`]), not from the requested one.
//! - **Signs.** Fields and materials in `e^{+jwt}`, propagation `e^{-jkR}`. The beat of a path with delay `tau` and
//!   complex amplitude `A` (every coefficient but the propagation phase) is
//!   `Re[ conj(A) exp(+j 2 pi (f0 tau + S tau t - S tau^2 / 2)) ]`: a receding target raises `tau`, the phase rises
//!   from chirp to chirp, the velocity is positive.
//! - **Windows** are periodic (DFT-even) unless they say otherwise.
//! - **Decibels.** 0 dBFS is a full-scale sine after correction for the coherent gain of the windows. The floor is
//!   given by the [`RdmSpec`]; `-inf` never appears. NaN and infinity pass through and are counted in [`MapFlags`].
//! - **Kernel level.** Maps are computed with the widest vector instructions that the machine has. The same binary at the
//!   same [`KernelLevel`] gives the same bits on any machine that has the level; the level is recorded and can be set. This
//!   holds for sizes that are powers of two. Other sizes go through a library's f64 transform, which chooses its own
//!   instructions, and may differ between machines in the last bit.
//! - **Randomness** is a function of (seed, purpose, index), not of threads or their order.

#![warn(clippy::missing_errors_doc, clippy::missing_panics_doc)]

mod frame;
mod level;
mod source;
mod split_mix;
mod waveform;
mod window;

pub mod decibel;
pub mod spectrum;

pub mod rdm;

pub mod detect;

pub mod statistics;

pub use frame::{Frame, FrameMismatch, FrameShape, MAX_CODE, Occupancy, ReceiverFault, Truth};
pub use level::KernelLevel;
pub use rdm::{MapFlags, MapStatus, Rdm, RdmProcessor, RdmShape, RdmSpec};
pub use source::{FrameSource, Gap, GapReason, SourceError, SourceEvent, source_from_fn};
pub use split_mix::split_mix_64;
pub use statistics::noise_floor_db;
pub use waveform::{
    ADC_START_DELAY_S, FIFO_SAMPLES, LEAST_BAND_HZ, REFERENCE_CLOCK_HZ, RF_BAND_HZ, RxMask, SLOPE_STEP_HZ_PER_S,
    SPEED_OF_LIGHT_M_PER_S, Waveform, WaveformError, WaveformMismatch, WaveformRequest,
};
pub use window::Window;
