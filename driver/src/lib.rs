//! Frames of chirps from bytes: boards, protocols, recordings, emulated boards.
//!
//! All providers of frames implement [`FrameSource`](radome_dsp::FrameSource): streams of boards ([`Mcu7Stream`],
//! [`DeepcraftStream`], [`Esp32Stream`]), recordings ([`recording::Recording`]), sources in real time ([`RealTime`]),
//! recordings that can be paused and sought ([`Player`]), and sources sent through an emulated board
//! ([`EmulatedSource`]). Parsers are pure functions over bytes, beside their encoders ([`protocol`], [`chip`]). Other
//! modules do input and output ([`board`], [`emulator`]). The library never prints: it returns errors and emits
//! `tracing` events.
//!
//! This writes a recording and reads it back:
//!
//! ```
//! use radome_driver::RecordingHeader;
//! use radome_driver::recording::{Format, Recording, RecordingWriter};
//! use radome_dsp::{Frame, FrameSource, SourceEvent, Waveform, WaveformRequest};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error + Send + Sync>> {
//! let folder = tempfile::tempdir()?;
//! let path = folder.path().join("empty.mcap");
//! let waveform = Waveform::realise(WaveformRequest::paper())?;
//! let mut frame = Frame::zeroed(waveform.shape());
//!
//! let mut writer = RecordingWriter::create(&path, Format::Mcap, &RecordingHeader::new(waveform.clone()))?;
//! for sequence in 0..3 {
//!     frame.sequence = sequence;
//!     frame.time_ns = (sequence as f64 * waveform.frame_interval_s() * 1e9) as u64;
//!     writer.frame(&frame)?;
//! }
//! writer.finish()?;
//!
//! let mut source = Recording::open(&path)?;
//! let mut frames = 0;
//! while source.next_frame(&mut frame)? == SourceEvent::Frame {
//!     frames += 1;
//! }
//! assert_eq!(frames, 3);
//! # Ok(())
//! # }
//! ```

#![warn(clippy::missing_errors_doc, clippy::missing_panics_doc)]

pub mod board;
mod candidate;
pub mod chip;
pub mod discover;
pub mod emulator;
mod error_text;
mod named_board;
// Known frames for the tests within modules; the tests of the public API use the same.
#[cfg(test)]
#[path = "../tests/common/pattern.rs"]
mod pattern;
pub mod player;
pub mod probe;
pub mod protocol;
pub mod recording;
pub mod replay;
pub mod transport;

pub use board::{
    BoardError, BoardIdentity, DeepcraftBoard, DeepcraftError, DeepcraftStream, Detected, Esp32Stream, Mcu7Board,
    Mcu7Stream, Outage, Reconnect, StartedBoard,
};
pub use discover::{Candidate, candidates};
pub use emulator::{
    EmulatedBoard, EmulatedSource, EmulatorError, EmulatorOptions, Fault, FaultError, Feed, Kind, Pace,
};
pub use named_board::start_board;
pub use player::{Player, Transport};
pub use recording::RecordingError;
pub use recording::infineon::InfineonReader;
pub use recording::mcap::{
    FrameResult, Judge, LabelSpan, McapReader, Recorder, RecorderOptions, RecordingHeader, SyncOptions,
};
pub use replay::RealTime;
pub use transport::{Address, UsbAddress};
