//! Identification of candidates by requests.

use serde::Serialize;

use crate::board::{BoardError, BoardIdentity, DeepcraftBoard, Mcu7Board, identity_on};
use crate::candidate::{Access, Belief, Candidate, Transport};
use crate::error_text::with_causes;
use crate::probe::{Probe, ProbeError, ProbeIdentity};
use crate::transport::{Address, PERMISSION_REMEDY};

/// State of a device.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case", tag = "state")]
#[allow(missing_docs, reason = "each variant says what its fields are")]
pub enum State {
    /// The device has answered with its identity and can be used.
    Ready { identity: Identity },
    /// The device prints lines by itself, like a board that takes no requests.
    Prints,
    /// The device has not been asked.
    NotAsked,
    /// Another program holds the device.
    Busy,
    /// The user may not open the device until commands have given access.
    PermissionDenied { remedy: &'static str },
    /// The device cannot be opened, does not answer, or its answer is malformed.
    NotAnswering { why: String },
    /// The board has a radar chip that this program does not support.
    OtherChip { chip: String },
    /// The system has no driver for the device, so that it has no port.
    NoDriver,
}

/// Identity that a device reports.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[serde(untagged)]
pub enum Identity {
    /// Identity of a board.
    Board(BoardIdentity),
    /// Identity of a debug probe.
    Probe(ProbeIdentity),
}

impl From<BoardError> for State {
    fn from(error: BoardError) -> Self {
        match error {
            BoardError::Busy { .. } => State::Busy,
            BoardError::PermissionDenied { .. } => State::PermissionDenied { remedy: PERMISSION_REMEDY },
            BoardError::OtherChip { chip, chip_id, .. } => {
                State::OtherChip { chip: format!("{chip} (CHIP_ID {chip_id:#08x})") }
            }
            BoardError::ChipSilent { chip_id, .. } => State::NotAnswering {
                why: format!(
                    "the board answers, its radar chip does not (CHIP_ID reads {chip_id:#08x}); is the shield seated?"
                ),
            },
            BoardError::NoAnswer { .. } => State::NotAnswering { why: "no answer to the vendor's protocol".into() },
            error => State::NotAnswering { why: with_causes(&error) },
        }
    }
}

impl From<ProbeError> for State {
    fn from(error: ProbeError) -> Self {
        match error {
            ProbeError::Busy { .. } => State::Busy,
            ProbeError::PermissionDenied { .. } => State::PermissionDenied { remedy: PERMISSION_REMEDY },
            error => State::NotAnswering { why: with_causes(&error) },
        }
    }
}

/// Reads the identity of a device. Boards and probes are opened and sent requests, which stops a board that measures
/// but leaves its chip [as it was programmed](Mcu7Board::identity_at). Serial ports of unknown devices are opened only
/// if `any_port` is set.
pub fn ask(candidate: &Candidate, any_port: bool) -> State {
    match candidate.access {
        Access::Denied => return State::PermissionDenied { remedy: PERMISSION_REMEDY },
        Access::Absent => return State::NotAnswering { why: "it has no device node".into() },
        Access::Granted => {}
    }
    let board = |address: &Address| match Mcu7Board::identity_at(address) {
        Ok(identity) => State::Ready { identity: Identity::Board(identity) },
        Err(error) => error.into(),
    };
    match (candidate.address(), candidate.belief, candidate.transport) {
        (Some(_), Belief::Deepcraft, _) => match DeepcraftBoard::open(&candidate.path) {
            Ok(board) => State::Ready { identity: Identity::Board(board.identity().clone()) },
            Err(error) => error.into(),
        },
        (Some(address), ..) => board(&address),
        _ if candidate.is_probe() => match Probe::open(candidate).and_then(|mut probe| probe.identity()) {
            Ok(identity) => State::Ready { identity: Identity::Probe(identity) },
            Err(error) => error.into(),
        },
        (None, Belief::Mcu7Serial | Belief::Deepcraft, _) => State::NoDriver,
        (None, _, Transport::Serial) if any_port => match identity_on(&candidate.path) {
            Ok(Some(identity)) => State::Ready { identity: Identity::Board(identity) },
            Ok(None) => State::Prints,
            Err(error) => error.into(),
        },
        _ => State::NotAsked,
    }
}
