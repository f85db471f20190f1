//! What can go wrong with a DEEPCRAFT board beyond what can with any.

use thiserror::Error;

use crate::protocol::deepcraft::{CustomError, ErrorCode, PROTOCOL_VERSION, RING_CODES};

/// What can go wrong with a DEEPCRAFT board beyond what can with any.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum DeepcraftError {
    /// The board said no.
    #[error("the board answered {code} to the request for {command}: {message}")]
    Refused {
        /// Request.
        command: &'static str,
        /// Its answer.
        code: ErrorCode,
        /// What it says of it.
        message: String,
    },
    /// The radar cannot be used as it is set.
    #[error("the radar reports an error: {message}")]
    Device {
        /// What it says.
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
        /// What it lacks.
        what: &'static str,
    },
    /// The radar's stream is not what the waveform makes.
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
    /// The radar is set to something that is no waveform.
    #[error(transparent)]
    Custom(#[from] CustomError),
}

impl DeepcraftError {
    /// Whether the board may be well again when its port is opened anew.
    pub fn is_passing(&self) -> bool {
        matches!(self, DeepcraftError::Refused { .. } | DeepcraftError::Device { .. })
    }
}
