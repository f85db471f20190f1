//! Registers of the BGT60TR13C, and their contents for a waveform.

mod configuration;
mod id;
mod register;
mod spi;
mod supply;
mod table;
mod timing;

pub use configuration::{ChipConfiguration, ChipError, RegisterList, RegisterValue};
pub(crate) use id::{CHIP_ID_BGT60TR13C, chip_name};
pub use register::{RegisterFile, main_bits};
pub use spi::SpiWord;
pub use table::{Field, REGISTERS, Register, address, field, register};
pub(crate) use timing::SampleTiming;
