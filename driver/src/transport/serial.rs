//! Serial ports.

use std::fs::File;
use std::io::{ErrorKind, IsTerminal, Read};
use std::ops::{Deref, DerefMut};
use std::os::fd::{AsRawFd, BorrowedFd};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::{FlockOperation, OFlags, flock};
use serialport::TTYPort;

use super::trace;
use super::usb::OpenError;

/// Bytes that a buffer takes from a port at once.
pub(crate) const BUFFER: usize = 65_536;
/// Baud rate of boards with a UART; ports on USB ignore it.
pub(crate) const BAUD_RATE: u32 = 921_600;

/// Open serial port, for exclusive use until it is dropped.
#[derive(Debug)]
pub(crate) struct OpenPort(TTYPort);

impl From<TTYPort> for OpenPort {
    fn from(port: TTYPort) -> Self {
        OpenPort(port)
    }
}

impl Deref for OpenPort {
    type Target = TTYPort;

    fn deref(&self) -> &TTYPort {
        &self.0
    }
}

impl DerefMut for OpenPort {
    fn deref_mut(&mut self) -> &mut TTYPort {
        &mut self.0
    }
}

impl Drop for OpenPort {
    /// Unlocks the port, so that a copy of it does not hold the lock. A process that this one is starting has copies of
    /// all open files until it runs its program.
    fn drop(&mut self) {
        let _ = flock(descriptor(&self.0), FlockOperation::Unlock);
    }
}

fn descriptor(port: &TTYPort) -> BorrowedFd<'_> {
    // SAFETY: the port is borrowed for the lifetime of the result, so its descriptor stays open.
    unsafe { BorrowedFd::borrow_raw(port.as_raw_fd()) }
}

/// Opens a serial port for exclusive use.
pub(crate) fn open_port(path: &Path) -> Result<OpenPort, OpenError> {
    let name = path.to_string_lossy();
    trace::opened(&path.display());
    let result = serialport::new(name, BAUD_RATE).timeout(Duration::from_millis(20)).open_native();
    result.map(OpenPort::from).map_err(|e| {
        // The crate reports `NoDevice` for a port that another program holds, and `Io` for one that does not exist.
        let is_busy = e.kind() == serialport::ErrorKind::NoDevice;
        let source = std::io::Error::from(e);
        match source.kind() {
            _ if is_busy => OpenError::Busy,
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

/// Reads bytes, waiting at most `timeout` and at least a millisecond; returns 0 if none came. A plain read of the port waits
/// too, but allocates an error each time that nothing comes.
pub(crate) fn read_within(port: &mut TTYPort, timeout: Duration, buffer: &mut [u8]) -> std::io::Result<usize> {
    let timeout = Timespec::try_from(timeout.max(Duration::from_millis(1))).ok();
    let result = poll(&mut [PollFd::from_borrowed_fd(descriptor(port), PollFlags::IN)], timeout.as_ref());
    match result {
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
pub(crate) fn read_more(port: &mut TTYPort, received: &mut Vec<u8>) -> std::io::Result<()> {
    let mut buffer = [0; 4096];
    let count = read(port, &mut buffer)?;
    received.extend_from_slice(buffer.get(..count).unwrap_or(&[]));
    Ok(())
}

#[cfg(test)]
mod hard_cases {
    use serialport::SerialPort;

    use super::*;

    /// Regression test: a port could not be opened again while another thread was starting a process.
    #[test]
    fn a_closed_port_can_be_opened_while_a_copy_of_it_is_open() {
        let (_board, host) = TTYPort::pair().expect("a pty");
        let name = host.name().expect("a name");
        let path = Path::new(&name);
        let port = open_port(path).expect("opens");
        assert!(matches!(open_port(path), Err(OpenError::Busy)));
        let copy = port.try_clone_native().expect("copies");
        drop(port);
        open_port(path).expect("opens again");
        drop(copy);
    }
}
