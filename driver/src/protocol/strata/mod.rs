//! The wire protocol of the Radar Baseboard MCU7, version 4, on its CDC serial port (reference: hardware notes section 2).
//!
//! The host sends a [`Request`], the board answers with a [`Response`]. While data runs, the board also sends
//! [`Packet`]s on its own account; a response may come between two packets but never within one. A *slice* of the chip's
//! FIFO is cut into packets; it is not a radar frame. All integers are little-endian but the CRC, which is big-endian.

mod packet;
mod parser;
mod request;
mod response;
mod slice;

pub use packet::{DataError, MAX_PACKET_PAYLOAD, Packet, PacketFlags};
pub use parser::{BoardEvent, BoardParser, HostEvent, HostParser};
pub use request::{Command, DataFormat, DecodeError, REQUEST_HEADER_LENGTH, Request, RequestKind, SpiWord};
pub(crate) use response::text;
pub use response::{BoardInfo, FirmwareVersion, PayloadError, Response, Status};
pub use slice::{SliceLayout, TIMESTAMP_LENGTH};

/// Longest message of either direction: header, payload and CRC.
pub const MAX_MESSAGE: usize = 4095;
/// Version of the protocol that this module speaks.
pub const PROTOCOL_VERSION: u16 = 4;
/// Component type of all BGT60TRxx chips.
pub const COMPONENT_AVIAN: u16 = 0x0103;
/// Register address that stands for the FIFO in a data configuration.
pub const FIFO_ADDRESS: u16 = 0x60;

#[cfg(test)]
mod tests;
