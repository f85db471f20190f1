//! The DEEPCRAFT streaming protocol 2.3 of PSoC 6 kits, on their CDC serial port (reference: hardware notes section 3.1).
//!
//! Each message is a varint length and so many bytes of protobuf. The host sends a [`Request`], the board answers with a
//! [`Response`]; while a device is active, the board also sends [`DataChunk`]s on its own account.
//!
//! # The trap
//! The radar's stream says that a frame is Antenna x Chirp x Sample. It is not: the firmware sends the FIFO as it is, chirp
//! by chirp, in a chirp sample by sample, in a sample the receivers ([`crate::protocol::fifo`]). It also says that a chunk
//! holds one frame at most, and sends as many as its reads of 6144 codes complete. Codes are 12 bits in 16, 0 to 4095.
//!
//! # What is detected, and what cannot be
//! There is no checksum and no mark where a message begins. A chunk is therefore believed only when what follows it on the
//! line confirms it ([`ChunkParser`]): lost, doubled, shortened and exchanged messages, and flipped bits in all but the
//! samples, cost frames but never falsify one. A flipped bit in a sample is found only if it makes a code beyond 4095; else
//! nobody can know. USB checks and repeats its packets, so that nothing of this is to be expected on its line.

mod capabilities;
mod chunk;
mod custom;
mod delimited;
mod error;
mod preset;
mod request;
mod response;

pub use capabilities::*;
pub use chunk::{Beginning, ChunkEvent, ChunkHeader, ChunkLayout, ChunkParser, MAX_RESPONSE};
pub use custom::{Custom, CustomError, FIFO_LEVEL_CODES};
pub use delimited::{MessageParser, TooLong};
pub use error::ErrorCode;
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
