//! The BGT60TR13C: its registers, and what a waveform makes of them.

mod configuration;
mod register;

pub use configuration::{ChipConfiguration, ChipError, RegisterList, RegisterValue};
pub use register::{RegisterFile, address, main_bits};
