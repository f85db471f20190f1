//! Boards by the names that users give them.

use radome_dsp::Waveform;

use crate::board::{BoardError, DeepcraftBoard, Detected, Reconnect, StartedBoard};
use crate::candidate::Candidate;
use crate::discover::candidates;
use crate::transport::Address;

/// Opens the board that a user names and starts its frames; `None` if the text is not the name of a board.
///
/// The name is `serial:PORT`, `deepcraft:PORT` (DEEPCRAFT firmware, without asking in other protocols first), `usb:` with a
/// [`UsbAddress`](crate::UsbAddress), or `auto` for the only board. The board is programmed with `waveform`, else with `default`, else
/// with the waveform that it has already. A board that prints its frames has `waveform`, or else its own.
///
/// # Errors
/// [`BoardError`] if there is not exactly one board of this name, or it cannot be opened, has no waveform, or cannot be started.
pub fn start_board(
    name: &str,
    waveform: Option<&Waveform>,
    default: Option<&Waveform>,
    reconnect: Reconnect,
) -> Result<Option<StartedBoard>, BoardError> {
    let address = match name.split_once(':') {
        Some(("serial" | "deepcraft", port)) => Address::Serial(port.into()),
        Some(("usb", device)) => Address::Usb(device.parse()?),
        None if name == "auto" => only_board()?,
        _ => return Ok(None),
    };
    let board = match &address {
        Address::Serial(port) if name.starts_with("deepcraft:") => {
            Detected::Deepcraft(Box::new(DeepcraftBoard::open(port)?))
        }
        _ => Detected::open(&address, waveform)?,
    };
    let started = board.start(waveform.or(default), reconnect)?;
    Ok(Some(StartedBoard { description: format!("{} on {address}", started.description), ..started }))
}

/// Address of the only board that discovery finds.
fn only_board() -> Result<Address, BoardError> {
    let mut found: Vec<Address> = candidates().iter().filter_map(Candidate::address).collect();
    match (found.pop(), found.is_empty()) {
        (Some(address), true) => Ok(address),
        (Some(_), false) => Err(BoardError::SeveralAttached),
        (None, _) => Err(BoardError::NoneAttached),
    }
}
