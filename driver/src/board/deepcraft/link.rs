//! Requests and answers over a serial port.

use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use prost::Message;
use serialport::SerialPort;

use crate::board::host::{disconnected, open_port};
use crate::board::{BoardError, DeepcraftError};
use crate::protocol::deepcraft::{
    ALL_DEVICES, Answer, CapabilitiesRequest, CapabilitiesResponse, Command, ConfigureResponse, ErrorCode,
    MAX_RESPONSE, MessageParser, Request, Response, StopRequest,
};
use crate::transport::serial::{BUFFER, OpenPort, read_within};
use crate::transport::trace;

/// Longest time that a board takes to answer, for the first attempt to reach it and for later ones.
const FIRST_ANSWER: Duration = Duration::from_millis(300);
const ANSWER: Duration = Duration::from_secs(1);
/// Attempts to reach a board.
const ATTEMPTS: u32 = 3;
/// Silence after which a stopped board sends nothing more.
const DRAIN_SILENCE: Duration = Duration::from_millis(30);
/// Longest time for which a board is drained: the duration of the longest chunk and of the bytes that the host has not
/// read. A device that sends for longer is not a board of this kind.
const DRAIN_LIMIT: Duration = Duration::from_millis(500);
const FIRST_DRAIN_LIMIT: Duration = Duration::from_millis(150);
/// Empty requests that complete an unfinished request on the board. A program that mistakes the port for a modem sends
/// `AT`, which announces a request of 65 bytes to the board.
const UNBLOCK: [u8; 128] = [0; 128];
/// First tag. A tag of four bytes makes a request for the capabilities ten bytes long. Firmware with headers of eight
/// bytes refuses such a request at once instead of waiting for more bytes.
const FIRST_TAG: i32 = 1 << 24;

/// Encoded [`Command::WatchdogReset`]: a running stream sends it without allocating.
const WATCHDOG_RESET: [u8; 3] = [2, 5 << 3 | 2, 0];

pub(super) struct Link {
    pub path: PathBuf,
    port: OpenPort,
    buffer: Vec<u8>,
    tag: i32,
}

impl Link {
    pub fn open(path: &Path) -> Result<Self, BoardError> {
        Ok(Link { path: path.into(), port: open_port(path)?, buffer: vec![0; BUFFER], tag: FIRST_TAG })
    }

    /// Error of this board.
    pub fn error(&self, source: DeepcraftError) -> BoardError {
        BoardError::Deepcraft { path: self.path.clone(), source }
    }

    /// Reads bytes, waiting at most `timeout`; returns an empty slice if none came.
    pub fn receive(&mut self, timeout: Duration) -> Result<&[u8], BoardError> {
        let count = read_within(&mut self.port, timeout, &mut self.buffer).map_err(disconnected(&self.path))?;
        Ok(self.buffer.get(..count).unwrap_or(&[]))
    }

    fn write(&mut self, bytes: &[u8], command: &'static str) -> Result<(), BoardError> {
        trace::sent(bytes);
        self.port.set_timeout(ANSWER).map_err(|e| disconnected(&self.path)(e.into()))?;
        self.port.write_all(bytes).map_err(|e| match e.kind() {
            ErrorKind::TimedOut => BoardError::NoAnswer { path: self.path.clone(), command },
            _ => disconnected(&self.path)(e),
        })
    }

    /// Sends a request whose answer, if it has one, is not awaited. `name` is for messages.
    pub fn send(&mut self, name: &'static str, command: Command) -> Result<(), BoardError> {
        let mut bytes = Vec::new();
        Request::from(command).encode_to(&mut bytes);
        self.write(&bytes, name)
    }

    /// Tells the board that the host is alive.
    pub fn reset_watchdog(&mut self) -> Result<(), BoardError> {
        self.write(&WATCHDOG_RESET, "watchdog reset")
    }

    /// Stops all devices and discards the bytes that they have sent.
    pub fn stop(&mut self) -> Result<(), BoardError> {
        self.send("stop", Command::Stop(StopRequest { device: ALL_DEVICES }))?;
        self.drain(DRAIN_LIMIT)
    }

    fn drain(&mut self, limit: Duration) -> Result<(), BoardError> {
        let end = Instant::now() + limit;
        while Instant::now() < end && !self.receive(DRAIN_SILENCE)?.is_empty() {}
        Ok(())
    }

    /// Reads the capabilities of the board. Bytes that are on the line when it is opened are discarded.
    pub fn capabilities(&mut self) -> Result<CapabilitiesResponse, BoardError> {
        for attempt in 0..ATTEMPTS {
            if attempt > 0 {
                self.write(&UNBLOCK, "capabilities")?;
                self.drain(FIRST_DRAIN_LIMIT)?;
            }
            let tag = self.next_tag();
            let mut bytes = Vec::new();
            Request::from(Command::Stop(StopRequest { device: ALL_DEVICES })).encode_to(&mut bytes);
            Request::from(Command::Capabilities(CapabilitiesRequest { device: ALL_DEVICES, tag }))
                .encode_to(&mut bytes);
            self.write(&bytes, "capabilities")?;
            let found = self.wait_for(FIRST_ANSWER, |answer| match answer {
                Answer::Capabilities(response) if response.tag == tag => Some(Ok(response)),
                _ => None,
            })?;
            if let Some(response) = found {
                return response;
            }
        }
        Err(BoardError::NoAnswer { path: self.path.clone(), command: "capabilities" })
    }

    /// Stops the board and sets options. Bytes before the answer belong to a former stream and are discarded.
    pub fn configure(&mut self, command: impl Fn(i32) -> Command) -> Result<ConfigureResponse, BoardError> {
        for _ in 0..ATTEMPTS {
            self.stop()?;
            let tag = self.next_tag();
            self.send("configuration", command(tag))?;
            let refused = |code, message| DeepcraftError::Refused { command: "configuration", code, message };
            let found = self.wait_for(ANSWER, |answer| match answer {
                Answer::Configuration(response) if response.tag == tag => Some(Ok(response)),
                Answer::Error(error) => Some(Err(refused(ErrorCode(error.code), error.message))),
                _ => None,
            })?;
            match found {
                Some(Ok(response)) => return Ok(response),
                Some(Err(refused)) => return Err(self.error(refused)),
                // The rest of a message came before the answer, or the board was not silent yet.
                None => {}
            }
        }
        Err(BoardError::NoAnswer { path: self.path.clone(), command: "configuration" })
    }

    /// Returns a tag that no earlier request has used.
    pub fn next_tag(&mut self) -> i32 {
        self.tag += 1;
        self.tag
    }

    /// Waits for an answer for which `accept` returns a value. `None` if none comes, or if the bytes are not a message.
    fn wait_for<T>(
        &mut self,
        timeout: Duration,
        mut accept: impl FnMut(Answer) -> Option<T>,
    ) -> Result<Option<T>, BoardError> {
        let end = Instant::now() + timeout;
        let mut parser = MessageParser::new(MAX_RESPONSE);
        loop {
            while let Some(message) = parser.next_message() {
                let Some((message, response)) = message.ok().and_then(|m| Some((m, Response::decode(m).ok()?))) else {
                    trace::damaged();
                    return Ok(None);
                };
                match &response.answer {
                    Some(Answer::Data(_)) => trace::measured(message.len()),
                    _ => trace::received(message),
                }
                if let Some(accepted) = response.answer.and_then(&mut accept) {
                    return Ok(Some(accepted));
                }
            }
            let left = end.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Ok(None);
            }
            parser.push(self.receive(left.min(Duration::from_millis(50)))?);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::protocol::deepcraft::Empty;

    #[test]
    fn the_watchdog_reset_is_the_encoded_request() {
        let mut bytes = Vec::new();
        Request::from(Command::WatchdogReset(Empty {})).encode_to(&mut bytes);
        assert_eq!(bytes, WATCHDOG_RESET);
    }
}
