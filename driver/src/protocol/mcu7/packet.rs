//! Data packets: 6-byte header, payload, CRC.

use super::framing::{Framing, PACKET_HEADER_LENGTH};
use crate::protocol::crc::crc16;

/// Flags of a data packet, without the 0xD0 that marks it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct PacketFlags {
    /// First of its slice.
    pub first: bool,
    /// Last of its slice.
    pub last: bool,
    /// The last eight bytes are the board's clock in microseconds.
    pub timestamp: bool,
    /// The payload is an error code or a text.
    pub error: bool,
}

impl PacketFlags {
    fn code(self) -> u8 {
        0xD0 | u8::from(self.first)
            | u8::from(self.last) << 1
            | u8::from(self.timestamp) << 2
            | u8::from(self.error) << 3
    }

    fn from_code(code: u8) -> Option<Self> {
        let bit = |n: u8| code >> n & 1 == 1;
        (code & 0xF0 == 0xD0).then(|| PacketFlags { first: bit(0), last: bit(1), timestamp: bit(2), error: bit(3) })
    }
}

/// Piece of a slice, with a borrowed payload.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Packet<'a> {
    /// Flags of the packet.
    pub flags: PacketFlags,
    /// Data index.
    pub channel: u8,
    /// Packets since the start, modulo 65536.
    pub counter: u16,
    /// Data, and at the end of the last packet the timestamp.
    pub payload: &'a [u8],
}

/// Reason for which the board stopped by itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DataError {
    /// The chip's FIFO overflowed.
    FifoOverflow,
    /// Another code.
    Other(u32),
}

impl DataError {
    /// Number on the wire.
    pub fn code(self) -> u32 {
        match self {
            DataError::FifoOverflow => 7,
            DataError::Other(code) => code,
        }
    }
}

impl<'a> Packet<'a> {
    /// Bytes before the payload.
    pub const HEADER_LENGTH: usize = PACKET_HEADER_LENGTH;

    /// Appends the bytes on the serial port.
    pub fn encode(&self, out: &mut Vec<u8>) {
        self.encode_as(Framing::Serial, out);
    }

    /// Appends the bytes on the wire. Payloads longer than the framing allows are the caller's fault and are cut.
    pub fn encode_as(&self, framing: Framing, out: &mut Vec<u8>) {
        let payload = self.payload.get(..framing.max_packet_payload()).unwrap_or(self.payload);
        let start = out.len();
        out.extend(Packet { payload, ..*self }.header_bytes());
        out.extend(payload);
        if framing == Framing::Serial {
            let crc = crc16(out.get(start..).unwrap_or(&[]));
            out.extend(crc.to_be_bytes());
        }
    }

    /// Encodes the header.
    pub fn header_bytes(&self) -> [u8; Packet::HEADER_LENGTH] {
        let ([c0, c1], [l0, l1]) = (self.counter.to_le_bytes(), (self.payload.len() as u16).to_le_bytes());
        [self.flags.code(), self.channel, c0, c1, l0, l1]
    }

    /// Decodes flags and payload length from a header; `None` if it is not one.
    pub(super) fn header(framing: Framing, header: &[u8; 6]) -> Option<(PacketFlags, usize)> {
        let length = usize::from(u16::from_le_bytes([header[4], header[5]]));
        let flags = PacketFlags::from_code(header[0])?;
        (header[1] == 0 && length <= framing.max_packet_payload()).then_some((flags, length))
    }

    /// Returns the payload without the timestamp, and the timestamp in microseconds of the board's clock.
    pub fn split_timestamp(&self) -> (&'a [u8], Option<u64>) {
        match self.payload.split_last_chunk::<8>() {
            Some((data, stamp)) if self.flags.timestamp => (data, Some(u64::from_le_bytes(*stamp))),
            _ => (self.payload, None),
        }
    }

    /// Decodes the error of an error packet: a code, and the timestamp if its flag is set. An error packet of another
    /// length holds a text of the firmware.
    pub fn error(&self) -> Option<DataError> {
        let code = <[u8; 4]>::try_from(self.split_timestamp().0).ok().filter(|_| self.flags.error);
        let code = u32::from_le_bytes(code?);
        Some(if code == 7 { DataError::FifoOverflow } else { DataError::Other(code) })
    }
}
