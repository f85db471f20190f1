//! DEEPCRAFT streaming protocol 2.3 of PSoC 6 kits, on their CDC serial port.
//!
//! Each message is its length as a varint and that many bytes of protobuf. The host sends a [`Request`], the board
//! answers with a [`Response`]; while a device is active, the board also sends [`DataChunk`]s on its own account.
//!
//! # Differences from the stated stream
//! The radar's stream states that a frame is Antenna x Chirp x Sample. In fact the firmware sends the FIFO as it is,
//! chirp by chirp, in a chirp sample by sample, in a sample the receivers ([`crate::protocol::fifo`]). It also states
//! that a chunk holds one frame at most, but sends as many as its reads of 6144 codes complete. Codes are 12 bits in
//! 16, 0 to 4095.
//!
//! # Error detection
//! There is no checksum and no mark at the start of a message. A chunk therefore counts only when the bytes behind it
//! confirm it ([`ChunkParser`]). Lost, doubled, shortened and exchanged messages, and inverted bits outside the
//! samples, cost frames but never falsify one. An inverted bit in a sample is detected only if it makes a code
//! beyond 4095. USB checks and repeats its packets, so that such errors are not expected there.

mod capabilities;
mod chunk;
mod custom;
mod delimited;
mod error;
mod option;
mod preset;
mod request;
mod response;

pub use capabilities::*;
pub use chunk::{Beginning, ChunkEvent, ChunkHeader, ChunkLayout, ChunkParser, MAX_RESPONSE};
pub use custom::{Custom, CustomError, FIFO_LEVEL_CODES};
pub use delimited::{MessageParser, TooLong};
pub use error::ErrorCode;
pub use option::{OptionValue, Value};
pub use preset::{CUSTOM, ITEMS, Preset, stated_frequency_hz};
pub use request::*;
pub use response::*;

/// Version of the protocol that is spoken here: major, minor, build, revision.
pub const PROTOCOL_VERSION: [u32; 4] = [2, 3, 20_241_218, 0];
/// Number of the radar's option "Use case".
pub const USE_CASE: i32 = 1;
/// Number of the radar's option "Custom data".
pub const CUSTOM_DATA: i32 = 2;
/// Longest request that is taken.
pub const MAX_REQUEST: usize = 4096;
/// Codes that the firmware's ring holds: larger frames never become whole there.
pub const RING_CODES: usize = 65_536;

/// Returns whether the firmware can send frames of this number of codes.
pub fn holds_frames_of(codes: usize) -> bool {
    codes <= RING_CODES && codes.is_multiple_of(2)
}
