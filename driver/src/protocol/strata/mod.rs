//! Protocol of the Radar Baseboard MCU7 (vendor's name: Strata), versions 4 and 3, on its CDC serial port.
//!
//! The host sends a [`Request`], the board answers with a [`Response`]. While data runs, the board also sends
//! [`Packet`]s on its own account; a response may come between two packets but never within one. A *slice* of the
//! chip's FIFO is cut into packets; it is not a radar frame. All integers are little-endian but the CRC, which is
//! big-endian. Firmware built for it uses USB's control and bulk transfers instead ([`bulk`]).

pub mod bulk;
mod framing;
mod packet;
mod parser;
mod request;
mod response;
mod slice;
mod version;

pub use framing::Framing;
pub use packet::{DataError, MAX_PACKET_PAYLOAD, Packet, PacketFlags};
pub use parser::{BoardEvent, BoardParser, HostEvent, HostParser};
pub use request::{Command, DataFormat, DecodeError, REQUEST_HEADER_LENGTH, Request, RequestKind, SpiWord};
pub(crate) use response::text;
pub use response::{BoardInfo, FirmwareVersion, PayloadError, Response, Status};
pub use slice::{SliceLayout, TIMESTAMP_LENGTH};
pub use version::Protocol;

/// Longest message of either direction: header, payload and CRC.
pub const MAX_MESSAGE: usize = 4095;
/// Component type of all BGT60TRxx chips, version 4.
pub const COMPONENT_AVIAN: u16 = 0x0103;
/// Component type of all radar chips, version 3.
pub const COMPONENT_RADAR: u16 = 0x0001;
/// Implementation that version 3 reports for a radar component that is a BGT60TRxx chip.
pub const IMPLEMENTATION_AVIAN: u8 = 3;
/// Register address that stands for the FIFO in a data configuration.
pub const FIFO_ADDRESS: u16 = 0x60;
