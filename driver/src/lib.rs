//! Chirp frames from bytes: boards, protocols, recordings, the emulated board.
//!
//! Everything that provides frames is a [`FrameSource`](radome_dsp::FrameSource): a [`Mcu7Stream`], a recording
//! ([`recording::open`]), either of them paced by [`RealTime`], a recording that can be paused and sought ([`Player`]),
//! and any source sent through an emulated board ([`EmulatedSource`]). Parsing is a pure function over bytes beside its
//! encoder ([`protocol`], [`chip`]); input and output wrap it ([`board`], [`emulator`]). The library never prints: it
//! reports errors and `tracing` events.

pub mod board;
mod candidate;
pub mod chip;
pub mod discover;
pub mod emulator;
pub mod player;
pub mod probe;
pub mod protocol;
pub mod recording;
pub mod replay;
pub mod transport;

pub use board::{
    BoardError, BoardIdentity, DeepcraftBoard, DeepcraftError, DeepcraftStream, Detected, Esp32Stream, Mcu7Board,
    Mcu7Stream, Reconnect,
};
pub use discover::{Candidate, candidates};
pub use emulator::{
    EmulatedBoard, EmulatedSource, EmulatorError, EmulatorOptions, Fault, FaultError, Feed, Kind, Pace,
};
pub use player::{Player, Transport};
pub use recording::RecordingError;
pub use recording::infineon::InfineonReader;
pub use recording::mcap::{
    FrameResult, Judge, LabelSpan, McapReader, Recorder, RecorderOptions, RecordingHeader, RecordingSummary,
    SyncOptions,
};
pub use replay::RealTime;
pub use transport::{Address, UsbAddress};
