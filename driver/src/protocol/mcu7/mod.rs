//! Protocol of the Radar Baseboard MCU7 (vendor's name: Strata), versions 4 and 3, on its CDC serial port.
//!
//! The host sends a [`Request`], the board answers with a [`Response`]. While data runs, the board also sends
//! [`Packet`]s on its own account; a response may come between two packets but never within one. A *slice* of the
//! chip's FIFO is cut into packets; it is not a radar frame. All integers are little-endian but the CRC, which is
//! big-endian. Firmware built for it uses USB's control and bulk transfers instead ([`bulk`]).

pub mod bulk;
mod component;
mod framing;
mod packet;
mod parser;
mod request;
mod response;
mod slice;
mod version;

pub use crate::chip::SpiWord;
pub use component::{COMPONENT_AVIAN, COMPONENT_RADAR, FIFO_ADDRESS, IMPLEMENTATION_AVIAN};
pub use framing::{Framing, MAX_MESSAGE};
pub use packet::{DataError, Packet, PacketFlags};
pub use parser::{BoardEvent, BoardParser, HostEvent, HostParser};
pub use request::{Command, REQUEST_HEADER_LENGTH, Request, RequestKind};
pub(crate) use response::text;
pub use response::{BoardInfo, FirmwareVersion, PayloadError, Response, Status};
pub use slice::{SliceLayout, TIMESTAMP_LENGTH};
pub use version::Protocol;
