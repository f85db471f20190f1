//! Framing of data packets.

/// Longest message of either direction: header, payload and CRC.
pub const MAX_MESSAGE: usize = 4095;
/// Bytes of a data packet before its payload.
pub(super) const PACKET_HEADER_LENGTH: usize = 6;

/// Framing of data packets, which decides their longest payload and whether they have a CRC.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Framing {
    /// One after another on the serial port, each with a CRC.
    #[default]
    Serial,
    /// Each a bulk transfer of its own, without CRC.
    Bulk,
}

impl Framing {
    /// Bytes of a packet on the bulk endpoint of a high-speed device.
    pub const USB_PACKET: usize = 512;

    /// Longest payload of a data packet. In bulk transfers header and payload together are at most 31 USB packets, as
    /// many as one microframe carries.
    pub const fn max_packet_payload(self) -> usize {
        match self {
            Framing::Serial => MAX_MESSAGE - 2 - PACKET_HEADER_LENGTH,
            Framing::Bulk => 31 * Self::USB_PACKET - PACKET_HEADER_LENGTH,
        }
    }
}
