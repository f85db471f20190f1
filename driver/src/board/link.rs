//! Requests and packets over a serial port.

use std::io::{ErrorKind, Read, Write};
use std::os::fd::{AsRawFd, BorrowedFd};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use serialport::{SerialPort, TTYPort};

use super::BoardError;
use crate::protocol::strata::{BoardEvent, BoardParser, Command, Packet, Protocol, Status};

const BAUD_RATE: u32 = 921_600;
/// Longest that a board takes to answer.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(1);
/// Bytes taken from the port at once.
const BUFFER: usize = 65_536;
/// After so long without a byte the rest of a message will not come.
const SILENCE: Duration = Duration::from_millis(200);

/// What came over the line.
pub(super) enum Incoming<'a> {
    Packet(Packet<'a>),
    Damaged,
}

pub(super) struct Link {
    pub path: PathBuf,
    /// Version that requests are sent in.
    pub protocol: Protocol,
    port: TTYPort,
    parser: BoardParser,
    buffer: Vec<u8>,
    last_byte: Instant,
}

/// Opens a serial port for this program alone.
pub(super) fn open_port(path: &Path, baud_rate: u32) -> Result<TTYPort, BoardError> {
    let name = path.to_string_lossy();
    serialport::new(name, baud_rate).timeout(Duration::from_millis(20)).open_native().map_err(|e| {
        let source = std::io::Error::from(e);
        // Another program holds the port's lock.
        let busy = matches!(source.kind(), ErrorKind::WouldBlock | ErrorKind::ResourceBusy);
        match (busy, source.kind()) {
            (true, _) => BoardError::Busy { path: path.into() },
            (_, ErrorKind::PermissionDenied) => BoardError::PermissionDenied { path: path.into() },
            _ => BoardError::Open { path: path.into(), source },
        }
    })
}

/// Reads what comes, waiting for it at most so long. A read of the port by itself waits as well, but makes an error each time
/// that nothing comes, which allocates.
pub(super) fn read_within(port: &mut TTYPort, timeout: Duration, buffer: &mut [u8]) -> std::io::Result<usize> {
    // SAFETY: the port is borrowed, and so its descriptor open, for as long as this one lives.
    let descriptor = unsafe { BorrowedFd::borrow_raw(port.as_raw_fd()) };
    let timeout = Timespec { tv_sec: timeout.as_secs() as i64, tv_nsec: i64::from(timeout.subsec_nanos()) };
    match poll(&mut [PollFd::new(&descriptor, PollFlags::IN)], Some(&timeout)) {
        Ok(0) | Err(rustix::io::Errno::INTR) => Err(ErrorKind::TimedOut.into()),
        Ok(_) => port.read(buffer),
        Err(e) => Err(e.into()),
    }
}

/// Appends what comes within some milliseconds.
pub(super) fn read_more(path: &Path, port: &mut TTYPort, heard: &mut Vec<u8>) -> Result<(), BoardError> {
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

impl Link {
    pub fn open(path: &Path) -> Result<Self, BoardError> {
        let port = open_port(path, BAUD_RATE)?;
        Ok(Link {
            path: path.into(),
            protocol: Protocol::default(),
            port,
            parser: BoardParser::with_capacity(BUFFER),
            buffer: vec![0; BUFFER],
            last_byte: Instant::now(),
        })
    }

    fn lost(&self, source: std::io::Error) -> BoardError {
        BoardError::Disconnected { path: self.path.clone(), source }
    }

    /// Waits for bytes, at most so long; whether any came.
    pub fn receive(&mut self, timeout: Duration) -> Result<bool, BoardError> {
        match read_within(&mut self.port, timeout.max(Duration::from_millis(1)), &mut self.buffer) {
            Ok(0) => Err(self.lost(ErrorKind::UnexpectedEof.into())),
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
            Err(e) => Err(self.lost(e)),
        }
    }

    /// The next packet among the bytes received; answers that nobody waits for are passed over.
    pub fn next_incoming(&mut self) -> Option<Incoming<'_>> {
        loop {
            // Looking at a message and keeping it are two steps for the borrow checker's sake.
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

    /// Sends a request and waits for its answer; data packets that come before it are dropped.
    pub fn request(&mut self, command: &Command) -> Result<(Status, Vec<u8>), BoardError> {
        let request = command.to_request(self.protocol);
        let bytes = request.encode();
        self.port.set_timeout(ANSWER_TIMEOUT).map_err(|e| self.lost(e.into()))?;
        self.port.write_all(&bytes).map_err(|e| match e.kind() {
            ErrorKind::TimedOut => BoardError::NoAnswer { path: self.path.clone(), command: name(command) },
            _ => self.lost(e),
        })?;
        let deadline = Instant::now() + ANSWER_TIMEOUT;
        loop {
            while let Some(event) = self.parser.next_event() {
                if let BoardEvent::Response(response) = event
                    && response.kind_code == request.kind_code()
                {
                    return Ok((response.status, response.payload.to_vec()));
                }
            }
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Err(BoardError::NoAnswer { path: self.path.clone(), command: name(command) });
            }
            self.receive(left.min(Duration::from_millis(50)))?;
        }
    }

    /// Sends a request that must succeed and gives the answer's payload.
    pub fn demand(&mut self, command: &Command) -> Result<Vec<u8>, BoardError> {
        match self.request(command)? {
            (Status::Ok, payload) => Ok(payload),
            (status, _) => Err(BoardError::Refused { path: self.path.clone(), command: name(command), status }),
        }
    }
}

/// What a command is for, in words.
fn name(command: &Command) -> &'static str {
    match command {
        Command::BoardInfo | Command::BoardInfoFixed { .. } => "board info",
        Command::FirmwareVersion => "firmware version",
        Command::Uuid => "UUID",
        Command::ExtendedVersion => "extended version",
        Command::ComponentCount { .. } | Command::ComponentImplementation { .. } => "count of radar chips",
        Command::DataIndex => "data index",
        Command::WriteRegisters { .. } | Command::SetBits { .. } => "register write",
        Command::ReadRegisters { .. } => "register read",
        Command::HardwareReset => "hardware reset",
        Command::InterruptLevel => "interrupt level",
        Command::Execute { .. } => "SPI transfer",
        Command::ConfigureData { .. } => "data configuration",
        Command::DataStatus => "data status",
        Command::StartData => "data start",
        Command::StopData => "data stop",
    }
}
