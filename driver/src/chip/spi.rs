//! SPI words between the chip and its board.

/// SPI word as on the chip's MOSI line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SpiWord {
    /// Register address, 0..=0x7F.
    pub address: u8,
    /// Whether the word writes; otherwise it reads.
    pub write: bool,
    /// 24-bit content.
    pub value: u32,
}

impl SpiWord {
    /// Creates a word that writes a register.
    pub fn write(address: u8, value: u32) -> Self {
        SpiWord { address, write: true, value }
    }

    /// Creates a word that reads a register.
    pub fn read(address: u8) -> Self {
        SpiWord { address, write: false, value: 0 }
    }

    /// Encodes the four bytes, in the order of the line.
    pub fn to_bytes(self) -> [u8; 4] {
        let [_, a, b, c] = self.value.to_be_bytes();
        [self.address << 1 | u8::from(self.write), a, b, c]
    }

    /// Decodes four bytes in the order of the line.
    pub fn from_bytes([command, a, b, c]: [u8; 4]) -> Self {
        SpiWord { address: command >> 1, write: command & 1 != 0, value: u32::from_be_bytes([0, a, b, c]) }
    }
}
