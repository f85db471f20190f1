//! Waveforms, frames and range-Doppler maps of the BGT60TR13C radar chip. Pure maths: no files, no sockets, no threads.
//!
//! What flows: [`FrameSource`] -> [`Frame`] -> `RdmProcessor` -> [`Rdm`].
//!
//! # Conventions
//! The whole workspace keeps these; they are stated here once.
//! - **Units.** SI, and the unit stands in the name: `start_frequency_hz`, `range_m`. Angles are in radians.
//! - **Samples** are real 12-bit codes in `u16`, `[rx][chirp][sample]`; a recording is `[frame][rx][chirp][sample]`.
//! - **Maps** are `f32` dB, `[rx][doppler][range]`. Zero Doppler is at index `M/2`; the velocity of index `i` is
//!   `(i - M/2) * velocity_step`, **positive when receding**. Range bin `k` is at `k * range_step`. Both steps follow
//!   from the band that is *sampled* ([`Waveform`]), not from the one requested.
//! - **Signs.** Fields and materials in `e^{+jwt}`, propagation `e^{-jkR}`. The beat of a path with delay `tau` and
//!   complex amplitude `A` (every coefficient but the propagation phase) is
//!   `Re[ conj(A) exp(+j 2 pi (f0 tau + S tau t - S tau^2 / 2)) ]`: a receding target raises `tau`, the phase rises
//!   from chirp to chirp, the velocity is positive.
//! - **Windows** are periodic (DFT-even) unless they say otherwise.
//! - **Decibels.** 0 dBFS is a full-scale sine after correction for the coherent gain of the windows. The floor is
//!   named in the [`RdmSpec`]; `-inf` never appears. NaN and infinity stay visible and are flagged.
//! - **Kernel level.** Maps are made with the widest vector instructions that the machine has. The same binary at the
//!   same [`KernelLevel`] gives the same bits on any machine that has the level; it is recorded and can be forced. That
//!   holds for the powers of two that the lane kernel takes; other sizes go through a library's f64 transform, which chooses
//!   its own instructions, and may differ between machines in the last bit.
//! - **Randomness** is a function of (seed, purpose, index), never of thread or order.

pub mod angle;
pub mod cfar;
pub mod decibel;
pub mod distance;
pub mod echo;
mod frame;
mod level;
mod noise;
pub mod people;
pub mod rdm;
pub mod slow_time;
mod source;
mod waveform;
mod window;

pub use frame::{Frame, FrameShape, MAX_CODE, Occupancy, ReceiverFault, Truth};
pub use level::KernelLevel;
pub use noise::noise_floor_db;
pub use rdm::{MapError, MapFlags, MapStatus, Rdm, RdmProcessor, RdmShape, RdmSpec};
pub use source::{FrameSource, Gap, GapReason, SourceError, SourceEvent};
pub use waveform::{
    ADC_START_DELAY_S, FIFO_SAMPLES, REFERENCE_CLOCK_HZ, RxMask, SLOPE_STEP_HZ_PER_S, Waveform, WaveformError,
    WaveformMismatch, WaveformRequest,
};
pub use window::Window;

/// Speed of light in vacuum, m/s.
pub const SPEED_OF_LIGHT_M_PER_S: f64 = 299_792_458.0;
