//! Serial ports.

use std::fs::File;
use std::io::{ErrorKind, IsTerminal, Read};
use std::os::fd::{AsRawFd, BorrowedFd};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::OFlags;
use serialport::TTYPort;

use super::trace;
use super::usb::OpenError;

/// Bytes that a buffer takes from a port at once.
pub(crate) const BUFFER: usize = 65_536;
/// Baud rate of boards with a UART; ports on USB ignore it.
pub(crate) const BAUD_RATE: u32 = 921_600;

/// Opens a serial port for exclusive use.
pub(crate) fn open_port(path: &Path) -> Result<TTYPort, OpenError> {
    let name = path.to_string_lossy();
    trace::opened(&path.display());
    serialport::new(name, BAUD_RATE).timeout(Duration::from_millis(20)).open_native().map_err(|e| {
        // The crate reports `NoDevice` for a port that another program holds, and `Io` for one that does not exist.
        let is_held = e.kind() == serialport::ErrorKind::NoDevice;
        let source = std::io::Error::from(e);
        match source.kind() {
            _ if is_held => OpenError::Busy,
            ErrorKind::PermissionDenied => OpenError::PermissionDenied,
            _ if is_no_port(path) => {
                OpenError::Other(std::io::Error::new(ErrorKind::InvalidInput, "it is not a serial port"))
            }
            _ => OpenError::Other(source),
        }
    })
}

/// Returns whether something else than a serial port has this name.
fn is_no_port(path: &Path) -> bool {
    let flags = (OFlags::NONBLOCK | OFlags::NOCTTY).bits() as i32;
    File::options().read(true).custom_flags(flags).open(path).is_ok_and(|file| !file.is_terminal())
}

/// Reads bytes, waiting at most `timeout`, and a millisecond at least; returns 0 if none came. A plain read of the port
/// waits too, but makes an error each time that nothing comes, which allocates.
pub(crate) fn read_within(port: &mut TTYPort, timeout: Duration, buffer: &mut [u8]) -> std::io::Result<usize> {
    // SAFETY: the port is borrowed, and so its descriptor open, for as long as this one lives.
    let descriptor = unsafe { BorrowedFd::borrow_raw(port.as_raw_fd()) };
    let timeout = timeout.max(Duration::from_millis(1));
    let timeout = Timespec { tv_sec: timeout.as_secs() as i64, tv_nsec: i64::from(timeout.subsec_nanos()) };
    match poll(&mut [PollFd::new(&descriptor, PollFlags::IN)], Some(&timeout)) {
        Ok(0) | Err(rustix::io::Errno::INTR) => Ok(0),
        Ok(_) => read(port, buffer),
        Err(e) => Err(e.into()),
    }
}

/// Reads the bytes that come within some milliseconds; returns 0 if none came. The end of a port is an error.
pub(crate) fn read(port: &mut TTYPort, buffer: &mut [u8]) -> std::io::Result<usize> {
    match port.read(buffer) {
        Ok(0) => Err(ErrorKind::UnexpectedEof.into()),
        Err(e) if matches!(e.kind(), ErrorKind::TimedOut | ErrorKind::Interrupted | ErrorKind::WouldBlock) => Ok(0),
        result => result,
    }
}

/// Appends the bytes that come within some milliseconds.
pub(crate) fn read_more(port: &mut TTYPort, heard: &mut Vec<u8>) -> std::io::Result<()> {
    let mut buffer = [0; 4096];
    let count = read(port, &mut buffer)?;
    heard.extend_from_slice(buffer.get(..count).unwrap_or(&[]));
    Ok(())
}
