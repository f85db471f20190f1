//! Register addresses, reset values and a register file.

/// Addresses of the registers that this program names (register table of the datasheet, V2.4.9).
pub mod address {
    #![allow(missing_docs)]
    pub const MAIN: u8 = 0x00;
    pub const ADC0: u8 = 0x01;
    pub const CHIP_ID: u8 = 0x02;
    pub const PACR1: u8 = 0x04;
    pub const PACR2: u8 = 0x05;
    pub const SFCTL: u8 = 0x06;
    pub const SADC_CTRL: u8 = 0x07;
    pub const CSCI: u8 = 0x0B;
    pub const CSCDS: u8 = 0x0F;
    pub const CS1_U_0: u8 = 0x10;
    pub const CS1_U_1: u8 = 0x11;
    pub const CS1_U_2: u8 = 0x12;
    pub const CS1: u8 = 0x16;
    pub const CS2: u8 = 0x1D;
    pub const CS3: u8 = 0x24;
    pub const CS4: u8 = 0x2B;
    pub const CCR0: u8 = 0x2C;
    pub const CCR1: u8 = 0x2D;
    pub const CCR2: u8 = 0x2E;
    pub const CCR3: u8 = 0x2F;
    pub const PLL1_0: u8 = 0x30;
    pub const PLL1_1: u8 = 0x31;
    pub const PLL1_2: u8 = 0x32;
    pub const PLL1_3: u8 = 0x33;
    pub const PLL1_7: u8 = 0x37;
    pub const PLL2_7: u8 = 0x3F;
    pub const PLL3_7: u8 = 0x47;
    pub const PLL4_7: u8 = 0x4F;
    pub const RFT1: u8 = 0x56;
    pub const SDFT0: u8 = 0x5B;
    pub const FSTAT: u8 = 0x5F;
}

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
    /// All of them.
    pub const ALL: u32 = 0xF;
}

/// Registers of a chip, by address; addresses beyond 0x7F do not exist.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RegisterFile {
    values: [u32; 128],
}

impl Default for RegisterFile {
    /// As after a reset.
    fn default() -> Self {
        use address::*;
        let mut file = RegisterFile { values: [0; 128] };
        for (address, value) in [
            (MAIN, 0x1E_0000),
            (ADC0, 0x0A_2240),
            (CHIP_ID, 0x00_0303),
            (PACR1, 0x19_6524),
            (PACR2, 0x04_0014),
            (SFCTL, 0x71_0000),
            (CSCI, 0xB60),
            (CSCDS, 0xB60),
            (CS1, 0xB60),
            (CS2, 0xB60),
            (CS3, 0xB60),
            (CS4, 0xB60),
            (0x55, 0x1F40),
            (RFT1, 0x06_0000),
            (0x57, 0x200),
            (0x5D, 0xA8),
            (FSTAT, 0x10_0000),
        ] {
            file.set(address, value);
        }
        file
    }
}

impl RegisterFile {
    /// Content of a register; 0 where there is none.
    pub fn get(&self, address: u8) -> u32 {
        self.values.get(usize::from(address)).copied().unwrap_or(0)
    }

    /// Sets a register's 24 bits; nothing happens where there is none.
    pub fn set(&mut self, address: u8, value: u32) {
        if let Some(register) = self.values.get_mut(usize::from(address)) {
            *register = value & 0xFF_FFFF;
        }
    }

    /// Bits `high..=low` of a register.
    pub fn field(&self, address: u8, high: u32, low: u32) -> u32 {
        self.get(address) >> low & ((1 << (high - low + 1)) - 1)
    }
}
