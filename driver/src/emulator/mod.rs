//! Emulated board on a pseudo-terminal, or behind sockets that stand for USB endpoints. It measures the frames of a
//! [`FrameSource`](radome_dsp::FrameSource), or frames made for the waveform that a client programs ([`Feed`]).
//!
//! It answers and sends as the firmware does, so that any client of the board can open [`EmulatedBoard::path`]
//! ([`Mcu7Board::open`](crate::Mcu7Board::open) at [`EmulatedBoard::address`]). There are two differences. The
//! board sends no frames for a waveform that the source does not have ([`EmulatedBoard::refusal`] holds the reason). It
//! also refuses a slice that would trigger a known firmware bug. Frames that the source itself lacks appear as lost
//! packets. The size of the board's buffer beyond the chip's FIFO is assumed from its memory (192 KiB).
//!
//! On a pseudo-terminal the board detects that its last client has closed the port or was killed. It then stops and
//! discards an incomplete request and unread data, so that the next client finds an idle board.

mod board;
mod chip;
mod deepcraft;
mod error;
mod esp32;
mod faults;
mod feed;
pub mod function_fs;
mod mcu7;
mod options;
mod port;
pub mod probe;
mod sample_source;
mod shared;
mod source;
mod thermometer;
mod wire;

pub use board::EmulatedBoard;
pub use error::EmulatorError;
pub use faults::{Fault, FaultError};
pub use feed::Feed;
pub use options::{EmulatorOptions, Kind, Pace};
pub use shared::EmulatorCounts;
use shared::Shared;
pub use source::{EmulatedSource, EmulatedSourceError};
