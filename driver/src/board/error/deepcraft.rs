//! Errors that only DEEPCRAFT boards have.

use thiserror::Error;

use crate::protocol::deepcraft::{ErrorCode, PROTOCOL_VERSION, RING_CODES};

/// Errors that only DEEPCRAFT boards have.
#[derive(Debug, Clone, PartialEq, Error)]
#[allow(missing_docs, reason = "the message says what each field is")]
pub enum DeepcraftError {
    /// The board answered a request with an error.
    #[error("the board answered {code} to the request for {command}: {message}")]
    Refused { command: &'static str, code: ErrorCode, message: String },
    /// The radar reports an error after configuration.
    #[error("the radar reports an error: {message}")]
    Device { message: String },
    /// The firmware speaks another version.
    #[error(
        "the firmware speaks version {major}.{minor} of the streaming protocol, this program speaks {spoken}; update the board's firmware",
        spoken = PROTOCOL_VERSION[0]
    )]
    Protocol { major: u32, minor: u32 },
    /// No device of the board is a radar.
    #[error("none of the board's devices is a radar (it has: {devices}); check that the firmware is built with it")]
    NoRadar { devices: String },
    /// The radar lacks an option, or an item of it.
    #[error("the radar has no {what}; is its firmware older than 1.2?")]
    NoOption { what: &'static str },
    /// The radar's stream does not match the waveform.
    #[error("the radar's stream has {what} {got}, {expected} was asked for")]
    Stream { what: &'static str, expected: String, got: String },
    /// The firmware cannot hold a frame.
    #[error(
        "a frame has {codes} codes, the firmware sends even numbers up to {RING_CODES}; use fewer chirps or samples"
    )]
    Frame { codes: usize },
}

impl DeepcraftError {
    /// Returns whether opening the port again may remove the error.
    pub fn is_transient(&self) -> bool {
        matches!(self, DeepcraftError::Refused { .. } | DeepcraftError::Device { .. })
    }
}
