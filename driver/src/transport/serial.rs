//! Serial ports.

use std::io::{ErrorKind, Read};
use std::os::fd::{AsRawFd, BorrowedFd};
use std::path::Path;
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use serialport::TTYPort;

use super::trace;
use super::usb::OpenError;

/// Opens a serial port for exclusive use.
pub(crate) fn open_port(path: &Path, baud_rate: u32) -> Result<TTYPort, OpenError> {
    let name = path.to_string_lossy();
    trace::opened(&path.display());
    serialport::new(name, baud_rate).timeout(Duration::from_millis(20)).open_native().map_err(|e| {
        // The crate reports `NoDevice` for a port that another program holds, and `Io` for one that does not exist.
        let is_held = e.kind() == serialport::ErrorKind::NoDevice;
        let source = std::io::Error::from(e);
        match source.kind() {
            _ if is_held => OpenError::Busy,
            ErrorKind::PermissionDenied => OpenError::PermissionDenied,
            _ => OpenError::Other(source),
        }
    })
}

/// Reads bytes, waiting at most `timeout`. A plain read of the port waits too, but makes an error each time that
/// nothing comes, which allocates.
pub(crate) fn read_within(port: &mut TTYPort, timeout: Duration, buffer: &mut [u8]) -> std::io::Result<usize> {
    // SAFETY: the port is borrowed, and so its descriptor open, for as long as this one lives.
    let descriptor = unsafe { BorrowedFd::borrow_raw(port.as_raw_fd()) };
    let timeout = Timespec { tv_sec: timeout.as_secs() as i64, tv_nsec: i64::from(timeout.subsec_nanos()) };
    match poll(&mut [PollFd::new(&descriptor, PollFlags::IN)], Some(&timeout)) {
        Ok(0) | Err(rustix::io::Errno::INTR) => Err(ErrorKind::TimedOut.into()),
        Ok(_) => port.read(buffer),
        Err(e) => Err(e.into()),
    }
}

/// Appends the bytes that come within some milliseconds.
pub(crate) fn read_more(port: &mut TTYPort, heard: &mut Vec<u8>) -> std::io::Result<()> {
    let mut buffer = [0; 4096];
    match port.read(&mut buffer) {
        Ok(0) => Err(ErrorKind::UnexpectedEof.into()),
        Ok(count) => {
            heard.extend_from_slice(buffer.get(..count).unwrap_or(&[]));
            Ok(())
        }
        Err(e) if matches!(e.kind(), ErrorKind::TimedOut | ErrorKind::Interrupted | ErrorKind::WouldBlock) => Ok(()),
        Err(e) => Err(e),
    }
}
