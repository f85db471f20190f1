//! Serial ports and clock of the host, for all boards.

use std::io;
use std::path::Path;
use std::time::{SystemTime, UNIX_EPOCH};

use super::BoardError;
use crate::transport::serial::{self, OpenPort};

/// Opens a board's serial port for exclusive use.
pub(super) fn open_port(path: &Path) -> Result<OpenPort, BoardError> {
    serial::open_port(path).map_err(|error| BoardError::opening(path.into(), error))
}

/// Returns a function that converts an error of the system to that of a broken connection.
pub(super) fn disconnected(path: &Path) -> impl FnOnce(io::Error) -> BoardError {
    move |source| BoardError::Disconnected { path: path.to_owned(), source }
}

/// Time of the host, ns since 1970.
pub(super) fn now_ns() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_nanos() as u64
}
