//! Errors that only DEEPCRAFT boards have.

use thiserror::Error;

use crate::protocol::deepcraft::{CustomError, ErrorCode, PROTOCOL_VERSION, RING_CODES};

/// Errors that only DEEPCRAFT boards have.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum DeepcraftError {
    /// The board answered a request with an error.
    #[error("the board answered {code} to the request for {command}: {message}")]
    Refused {
        /// Name of the request.
        command: &'static str,
        /// Error code that it answered.
        code: ErrorCode,
        /// Text that it answered.
        message: String,
    },
    /// The radar reports an error after configuration.
    #[error("the radar reports an error: {message}")]
    Device {
        /// Text of the error.
        message: String,
    },
    /// The firmware speaks another version.
    #[error(
        "the firmware speaks version {major}.{minor} of the streaming protocol, this program speaks {spoken}; update the board's firmware",
        spoken = PROTOCOL_VERSION[0]
    )]
    Protocol {
        /// Major version.
        major: u32,
        /// Minor version.
        minor: u32,
    },
    /// No device of the board is a radar.
    #[error("none of the board's devices is a radar (it has: {devices}); check that the firmware is built with it")]
    NoRadar {
        /// Names of the devices.
        devices: String,
    },
    /// The radar lacks an option, or an item of it.
    #[error("the radar has no {what}; is its firmware older than 1.2?")]
    NoOption {
        /// Name of the option or item.
        what: &'static str,
    },
    /// The radar's stream does not match the waveform.
    #[error("the radar's stream has {what} {got}, {expected} was asked for")]
    Stream {
        /// Quantity that differs.
        what: &'static str,
        /// Value asked for.
        expected: String,
        /// Value stated.
        got: String,
    },
    /// The firmware cannot hold a frame.
    #[error(
        "a frame has {codes} codes, the firmware sends even numbers up to {RING_CODES}; use fewer chirps or samples"
    )]
    Frame {
        /// Codes of a frame.
        codes: usize,
    },
    /// The custom data of the radar are not a waveform.
    #[error(transparent)]
    Custom(#[from] CustomError),
}

impl DeepcraftError {
    /// Returns whether opening the port again may remove the error.
    pub fn is_passing(&self) -> bool {
        matches!(self, DeepcraftError::Refused { .. } | DeepcraftError::Device { .. })
    }
}
