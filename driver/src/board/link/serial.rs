//! Requests and packets over a serial port.

use std::io::{ErrorKind, Read, Write};
use std::os::fd::{AsRawFd, BorrowedFd};
use std::path::Path;
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use serialport::{SerialPort, TTYPort};

use super::super::{BoardError, wire};
use super::{ANSWER_TIMEOUT, Failure, Incoming, SILENCE};
use crate::protocol::mcu7::{BoardEvent, BoardParser, Request, Status};

const BAUD_RATE: u32 = 921_600;
/// Bytes taken from the port at once.
const BUFFER: usize = 65_536;

pub(super) struct Serial {
    port: TTYPort,
    parser: BoardParser,
    buffer: Vec<u8>,
    last_byte: Instant,
}

/// Opens a serial port for exclusive use.
pub(in crate::board) fn open_port(path: &Path, baud_rate: u32) -> Result<TTYPort, BoardError> {
    let name = path.to_string_lossy();
    wire::opened(&path.display());
    serialport::new(name, baud_rate).timeout(Duration::from_millis(20)).open_native().map_err(|e| {
        // The crate reports `NoDevice` for a port that another program holds, and `Io` for one that does not exist.
        let is_held = e.kind() == serialport::ErrorKind::NoDevice;
        let source = std::io::Error::from(e);
        match source.kind() {
            _ if is_held => BoardError::Busy { path: path.into() },
            ErrorKind::PermissionDenied => BoardError::PermissionDenied { path: path.into() },
            _ => BoardError::Open { path: path.into(), source },
        }
    })
}

/// Reads bytes, waiting at most `timeout`. A plain read of the port waits too, but makes an error each time that
/// nothing comes, which allocates.
pub(in crate::board) fn read_within(
    port: &mut TTYPort,
    timeout: Duration,
    buffer: &mut [u8],
) -> std::io::Result<usize> {
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
pub(in crate::board) fn read_more(path: &Path, port: &mut TTYPort, heard: &mut Vec<u8>) -> Result<(), BoardError> {
    let mut buffer = [0; 4096];
    let lost = |source| BoardError::Disconnected { path: path.to_owned(), source };
    match port.read(&mut buffer) {
        Ok(0) => Err(lost(ErrorKind::UnexpectedEof.into())),
        Ok(count) => {
            heard.extend_from_slice(buffer.get(..count).unwrap_or(&[]));
            Ok(())
        }
        Err(e) if matches!(e.kind(), ErrorKind::TimedOut | ErrorKind::Interrupted | ErrorKind::WouldBlock) => Ok(()),
        Err(e) => Err(lost(e)),
    }
}

impl Serial {
    pub fn open(path: &Path) -> Result<Self, BoardError> {
        let port = open_port(path, BAUD_RATE)?;
        Ok(Serial {
            port,
            parser: BoardParser::with_capacity(BUFFER),
            buffer: vec![0; BUFFER],
            last_byte: Instant::now(),
        })
    }

    pub fn receive(&mut self, timeout: Duration) -> Result<bool, Failure> {
        match read_within(&mut self.port, timeout.max(Duration::from_millis(1)), &mut self.buffer) {
            Ok(0) => Err(Failure::Lost(ErrorKind::UnexpectedEof.into())),
            Ok(count) => {
                self.last_byte = Instant::now();
                self.parser.push(self.buffer.get(..count).unwrap_or(&[]));
                Ok(true)
            }
            Err(e) if matches!(e.kind(), ErrorKind::TimedOut | ErrorKind::Interrupted | ErrorKind::WouldBlock) => {
                if self.parser.is_waiting() && self.last_byte.elapsed() > SILENCE {
                    self.parser.on_silence();
                    return Ok(true);
                }
                Ok(false)
            }
            Err(e) => Err(Failure::Lost(e)),
        }
    }

    pub fn next_incoming(&mut self) -> Option<Incoming<'_>> {
        loop {
            // Peeking and taking are two steps because the borrow checker asks for it.
            match self.parser.peek_is_response()? {
                true => {
                    self.parser.next_event();
                }
                false => {
                    return match self.parser.next_event()? {
                        BoardEvent::Packet(packet) => Some(Incoming::Packet(packet)),
                        _ => Some(Incoming::Damaged),
                    };
                }
            }
        }
    }

    /// Data packets that come before the answer are dropped.
    pub fn request(&mut self, request: &Request) -> Result<(Status, Vec<u8>), Failure> {
        self.port.set_timeout(ANSWER_TIMEOUT).map_err(|e| Failure::Lost(e.into()))?;
        let message = request.encode();
        wire::sent(&message);
        self.port.write_all(&message).map_err(|e| match e.kind() {
            ErrorKind::TimedOut => Failure::NoAnswer,
            _ => Failure::Lost(e),
        })?;
        let deadline = Instant::now() + ANSWER_TIMEOUT;
        loop {
            while let Some(event) = self.parser.next_event() {
                wire::event(&event);
                if let BoardEvent::Response(response) = event
                    && response.kind_code == request.kind_code()
                {
                    return Ok((response.status, response.payload.to_vec()));
                }
            }
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                wire::failed(&ErrorKind::TimedOut);
                return Err(Failure::NoAnswer);
            }
            self.receive(left.min(Duration::from_millis(50)))?;
        }
    }
}
