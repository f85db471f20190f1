//! Requests and packets over a serial port.

use std::io::{ErrorKind, Write};
use std::path::Path;
use std::time::{Duration, Instant};

use serialport::SerialPort;

use super::{ANSWER_TIMEOUT, Failure, Incoming, SILENCE};
use crate::board::BoardError;
use crate::board::host::open_port;
use crate::protocol::mcu7::{BoardEvent, BoardParser, Request, SliceLayout, Status};
use crate::transport::serial::{BUFFER, OpenPort, read_within};
use crate::transport::trace;

pub(super) struct Serial {
    port: OpenPort,
    parser: BoardParser,
    buffer: Vec<u8>,
    last_byte: Instant,
}

impl Serial {
    pub fn open(path: &Path) -> Result<Self, BoardError> {
        Ok(Serial {
            port: open_port(path)?,
            parser: BoardParser::with_capacity(BUFFER),
            buffer: vec![0; BUFFER],
            last_byte: Instant::now(),
        })
    }

    /// Sets the layout of the slices that the board sends.
    pub fn set_slice_layout(&mut self, slice: Option<SliceLayout>) {
        self.parser.set_slice_layout(slice);
    }

    pub fn receive(&mut self, timeout: Duration) -> Result<bool, Failure> {
        let count = read_within(&mut self.port, timeout, &mut self.buffer).map_err(Failure::Lost)?;
        if count > 0 {
            self.last_byte = Instant::now();
            self.parser.push(self.buffer.get(..count).unwrap_or(&[]));
            return Ok(true);
        }
        let is_cut = self.parser.is_waiting() && self.last_byte.elapsed() > SILENCE;
        if is_cut {
            self.parser.on_silence();
        }
        Ok(is_cut)
    }

    pub fn next_incoming(&mut self) -> Option<Incoming<'_>> {
        // Peeking and taking are two steps because of the borrow checker.
        while self.parser.peek_is_response()? {
            self.parser.next_event();
        }
        match self.parser.next_event()? {
            BoardEvent::Packet(packet) => Some(Incoming::Packet(packet)),
            _ => Some(Incoming::Damaged),
        }
    }

    /// Sends a request and waits for its answer. Data packets that come before the answer are dropped.
    pub fn request(&mut self, request: &Request) -> Result<(Status, Vec<u8>), Failure> {
        self.port.set_timeout(ANSWER_TIMEOUT).map_err(|e| Failure::Lost(e.into()))?;
        let message = request.encode();
        trace::sent(&message);
        self.port.write_all(&message).map_err(|e| match e.kind() {
            ErrorKind::TimedOut => Failure::NoAnswer,
            _ => Failure::Lost(e),
        })?;
        let deadline = Instant::now() + ANSWER_TIMEOUT;
        loop {
            while let Some(event) = self.parser.next_event() {
                trace::event(&event);
                if let BoardEvent::Response(response) = event
                    && response.kind_code == request.kind_code()
                {
                    return Ok((response.status, response.payload.to_vec()));
                }
            }
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                trace::failed(&ErrorKind::TimedOut);
                return Err(Failure::NoAnswer);
            }
            self.receive(left.min(Duration::from_millis(50)))?;
        }
    }
}
