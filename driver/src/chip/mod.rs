//! Registers of the BGT60TR13C, and their contents for a waveform.

mod configuration;
mod register;
mod supply;
mod table;
pub mod test_pattern;

pub use configuration::{ChipConfiguration, ChipError, RegisterList, RegisterValue};
pub use register::{RegisterFile, main_bits};
pub use table::{Field, REGISTERS, Register, address, field, register};
