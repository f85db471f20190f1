//! Errors of emulated boards.

use std::path::PathBuf;

use radome_dsp::WaveformError;
use thiserror::Error;

use crate::chip::ChipError;
use crate::protocol::deepcraft::RING_CODES;

/// Error of starting an emulated board.
#[derive(Debug, Error)]
#[allow(missing_docs, reason = "the message says what each field is")]
pub enum EmulatorError {
    /// The line to the host cannot be opened.
    #[error("emulator: cannot make {what}")]
    Line { what: String, source: std::io::Error },
    /// Another emulated board has the link.
    #[error(
        "emulator: another emulated board has the link {link}\n\nhint: stop that board, or give this one another link",
        link = link.display()
    )]
    LinkTaken { link: PathBuf },
    /// The path of the link exists and is not the remains of an emulated board.
    #[error(
        "emulator: {link} exists and is no link that an emulated board has left behind\n\nhint: remove it, or give the board another link",
        link = link.display()
    )]
    LinkExists { link: PathBuf },
    /// A board with USB endpoints cannot use a terminal.
    #[error("emulator: a board with bulk transfers cannot be on the terminal {path}")]
    NoTerminal { path: PathBuf },
    /// The thread cannot be started.
    #[error("emulator: cannot start a thread")]
    Thread(#[source] std::io::Error),
    /// The chip cannot hold the waveform of the source.
    #[error(transparent)]
    Chip(#[from] ChipError),
    /// DEEPCRAFT firmware cannot hold a frame of the source, which has no other frames.
    #[error(
        "emulator: a frame of the source has {codes} codes, DEEPCRAFT firmware sends even numbers up to {RING_CODES}\n\n\
         hint: give it frames of fewer chirps or samples, or emulate another protocol"
    )]
    Frame { codes: usize },
    /// A preset of the firmware cannot be realised.
    #[error(transparent)]
    Waveform(#[from] WaveformError),
    /// The speed is not a positive number.
    #[error("emulator: speed is {speed}, it must be a positive number")]
    Speed { speed: f64 },
}
