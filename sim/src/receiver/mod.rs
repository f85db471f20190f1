//! Receiver: converts the field at the antennas to 12-bit codes.

pub mod adc;
pub mod budget;
pub mod calibration;
mod file;
pub mod noise;
pub mod phase_noise;
pub mod spurs;

pub use file::{
    Antenna, ClutterDrift, InvalidConstant, Leakage, Noise, OffsetDrift, PhaseNoise, RECEIVER_FORMAT, Receiver,
    RxChannel, SpurPhase, Transient,
};
