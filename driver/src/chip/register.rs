//! Register file of a chip.

use super::table::{Field, REGISTERS};

/// Bits of MAIN that trigger something and clear themselves.
pub mod main_bits {
    /// Starts frames.
    pub const FRAME_START: u32 = 1;
    /// Resets all registers.
    pub const SW_RESET: u32 = 1 << 1;
    /// Stops frames.
    pub const FSM_RESET: u32 = 1 << 2;
    /// Empties the FIFO.
    pub const FIFO_RESET: u32 = 1 << 3;
    /// All of these bits.
    pub const ALL: u32 = 0xF;
}

/// Registers of a chip, by address; addresses beyond 0x7F do not exist.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RegisterFile {
    values: [u32; 128],
}

impl Default for RegisterFile {
    /// Returns the contents after a reset.
    fn default() -> Self {
        let mut file = RegisterFile { values: [0; 128] };
        REGISTERS.iter().for_each(|register| file.set(register.address, register.reset));
        file
    }
}

impl RegisterFile {
    /// Content of a register; 0 if the address does not exist.
    pub fn get(&self, address: u8) -> u32 {
        self.values.get(usize::from(address)).copied().unwrap_or(0)
    }

    /// Sets the 24 bits of a register; does nothing if the address does not exist.
    pub fn set(&mut self, address: u8, value: u32) {
        if let Some(register) = self.values.get_mut(usize::from(address)) {
            *register = value & 0xFF_FFFF;
        }
    }

    /// Value of a field.
    pub fn field(&self, field: Field) -> u32 {
        field.of(self.get(field.address))
    }
}
