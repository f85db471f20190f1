//! Who is there, by asking.

use serde::Serialize;

use super::{Access, Belief, Candidate, PERMISSION_REMEDY, Transport};
use crate::probe::{Probe, ProbeError, ProbeIdentity};
use crate::{Address, Board, BoardError, BoardIdentity, DeepcraftBoard};

/// What state a device is in.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case", tag = "state")]
pub enum State {
    /// It has answered, and can be used.
    Ready {
        /// Who it says it is.
        identity: Identity,
    },
    /// Nobody has asked it.
    NotAsked,
    /// Another program has it.
    Busy,
    /// This user may not open it.
    PermissionDenied {
        /// What to do about it.
        remedy: &'static str,
    },
    /// It cannot be opened, does not answer, or says what makes no sense.
    NotAnswering {
        /// In words.
        why: String,
    },
    /// A board with a radar chip that this program does not drive.
    OtherChip {
        /// Name of the chip.
        chip: String,
    },
    /// The system has no driver for it, so that it has no port.
    NoDriver,
}

/// Who a device says it is.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[serde(untagged)]
pub enum Identity {
    /// A board.
    Board(BoardIdentity),
    /// A debug probe.
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
            error => State::NotAnswering { why: in_words(&error) },
        }
    }
}

impl From<ProbeError> for State {
    fn from(error: ProbeError) -> Self {
        match error {
            ProbeError::Busy { .. } => State::Busy,
            ProbeError::PermissionDenied { .. } => State::PermissionDenied { remedy: PERMISSION_REMEDY },
            error => State::NotAnswering { why: in_words(&error) },
        }
    }
}

/// An error with its causes.
fn in_words(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(error) = cause {
        text += &format!(": {error}");
        cause = error.source();
    }
    text
}

/// Asks a device who it is. Boards and probes are opened and sent requests, which stops a board that measures but leaves its
/// chip [as it was programmed](Board::identity_at); serial ports of which nothing is known only if `any_port` is set.
pub fn ask(candidate: &Candidate, any_port: bool) -> State {
    match candidate.access {
        Access::Denied => return State::PermissionDenied { remedy: PERMISSION_REMEDY },
        Access::Absent => return State::NotAnswering { why: "it has no device node".into() },
        Access::Granted => {}
    }
    let board = |address: &Address| match Board::identity_at(address) {
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
        (None, _, Transport::Serial) if any_port => board(&Address::Serial(candidate.path.clone())),
        _ => State::NotAsked,
    }
}
