//! Frame stream of an ESP32 that prints lines.

use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use radome_dsp::{Frame, FrameSource, SourceError, SourceEvent, Waveform};

use super::resequencer::Resequencer;
use crate::board::BoardError;
use crate::board::host::{disconnected, open_port};
use crate::board::reconnect::{Outage, Reconnect, Reconnectable, Recovery, next_event};
use crate::protocol::ascii::{self, Line, LineParser};
use crate::transport::serial::{BAUD_RATE, BUFFER, OpenPort, read, read_more};
use crate::transport::trace;

/// Longest wait for the line in which the firmware states its waveform.
const WAVEFORM_TIMEOUT: Duration = Duration::from_secs(3);
/// Most bytes that are searched for that line.
const MAX_SEARCHED_BYTES: usize = 1 << 22;

/// Frame stream of a board that prints lines, from the next whole line on.
///
/// Lines have no check sum: a digit of a code that becomes another digit is not detected. Lines that are lost, doubled,
/// cut, out of order or wrongly numbered are detected. A number that does not follow its predecessor counts when the
/// next line confirms it.
pub struct Esp32Stream {
    path: PathBuf,
    /// `None` while the board is disconnected.
    port: Option<OpenPort>,
    parser: LineParser,
    buffer: Vec<u8>,
    resequencer: Resequencer,
    /// Whether a line that does not fit the waveform was logged since the last frame.
    has_warned: bool,
    /// Longest silence, from the frame interval and the duration of a line.
    deadline: Duration,
    waveform: Waveform,
    recovery: Recovery,
}

impl Esp32Stream {
    /// Opens the port and listens. Without a waveform the firmware has to state its own.
    ///
    /// # Errors
    /// [`BoardError::Open`], [`BoardError::Busy`] or [`BoardError::PermissionDenied`] if the port cannot be opened;
    /// [`BoardError::WaveformUnknown`] if no waveform is given and the firmware states none,
    /// [`BoardError::WaveformStated`] if it states one that cannot be used.
    pub fn open(path: &Path, waveform: Option<&Waveform>) -> Result<Self, BoardError> {
        Esp32Stream::listen(path, open_port(path)?, Vec::new(), waveform)
    }

    /// Starts a stream on an open port, from which the bytes `received` were read before.
    pub(in crate::board) fn listen(
        path: &Path,
        mut port: OpenPort,
        mut received: Vec<u8>,
        waveform: Option<&Waveform>,
    ) -> Result<Self, BoardError> {
        let waveform = match waveform {
            Some(waveform) => waveform.clone(),
            None => read_waveform_line(path, &mut port, &mut received)?,
        };
        let codes = waveform.shape().codes();
        // A code takes six characters, a character ten bits.
        let line_s = codes as f64 * 60.0 / f64::from(BAUD_RATE);
        let mut parser = LineParser::new(codes);
        parser.push(&received);
        Ok(Esp32Stream {
            path: path.into(),
            port: Some(port),
            parser,
            buffer: vec![0; BUFFER],
            resequencer: Resequencer::new(&waveform),
            has_warned: false,
            deadline: Duration::from_secs_f64(1.0 + 3.0 * waveform.frame_interval_s().max(line_s)),
            waveform,
            recovery: Recovery::default(),
        })
    }

    /// Makes the stream reconnect after the board was unplugged or fell silent. The frames lost meanwhile become a gap,
    /// counted by the host's clock.
    pub fn with_reconnect(mut self, policy: Reconnect) -> Self {
        self.recovery.policy = Some(policy);
        self
    }

    /// Returns a handle that tells, from any thread, whether the board is away.
    pub fn outage(&self) -> Outage {
        self.recovery.outage.clone()
    }
}

/// Listens until the firmware states its waveform; appends all bytes to `received`.
fn read_waveform_line(path: &Path, port: &mut OpenPort, received: &mut Vec<u8>) -> Result<Waveform, BoardError> {
    let start = Instant::now();
    let mut line_start = 0;
    loop {
        while let Some(length) = received.get(line_start..).unwrap_or(&[]).iter().position(|b| *b == b'\n') {
            let line = received.get(line_start..line_start + length).unwrap_or(&[]);
            line_start += length + 1;
            if let Some(request) = ascii::decode_waveform(line.strip_suffix(b"\r").unwrap_or(line)) {
                let unusable = |reason: String| BoardError::WaveformStated { path: path.to_owned(), reason };
                let request = request.map_err(|error| unusable(error.to_string()))?;
                return Waveform::realise(request).map_err(|error| unusable(error.to_string()));
            }
        }
        if start.elapsed() > WAVEFORM_TIMEOUT || received.len() > MAX_SEARCHED_BYTES {
            return Err(BoardError::WaveformUnknown { path: path.to_owned() });
        }
        read_more(port, received).map_err(disconnected(path))?;
    }
}

impl FrameSource for Esp32Stream {
    fn waveform(&self) -> &Waveform {
        &self.waveform
    }

    fn next_frame(&mut self, frame: &mut Frame) -> Result<SourceEvent, SourceError> {
        Ok(next_event(self, frame)?)
    }
}

impl Reconnectable for Esp32Stream {
    fn read_event(&mut self, frame: &mut Frame) -> Result<SourceEvent, BoardError> {
        // The deadline is not extended by bytes alone: lines of another waveform would keep the stream waiting for
        // ever.
        let start = Instant::now();
        let mut line_error = None;
        loop {
            if let Some(event) = self.resequencer.pop(frame) {
                return Ok(event);
            }
            match self.parser.next_line() {
                Some(Ok(Line::Frame { number, codes })) => {
                    self.resequencer.push_line(number, codes, Instant::now());
                    self.has_warned = false;
                    continue;
                }
                Some(Ok(Line::Log(text))) => {
                    tracing::debug!("{}: {}", self.path.display(), String::from_utf8_lossy(text));
                    continue;
                }
                Some(Err(error)) => {
                    // If the firmware has another waveform, no line fits.
                    if !std::mem::replace(&mut self.has_warned, true) {
                        tracing::warn!("{}: {error}", self.path.display());
                    }
                    self.resequencer.damaged = true;
                    line_error = Some(error);
                    continue;
                }
                None => {}
            }
            // Received lines are parsed first, so that a caller that did not read for long does not report a lost board.
            if start.elapsed() > self.deadline {
                let path = self.path.clone();
                return Err(match line_error {
                    // After a first frame the waveform is known to be right: a damaged line is then only the last one
                    // before a silence.
                    Some(source) if self.resequencer.next_number.is_none() => BoardError::Line { path, source },
                    _ => BoardError::Stalled { path, waited: self.deadline },
                });
            }
            let port = self.port.as_mut().ok_or_else(|| disconnected(&self.path)(ErrorKind::NotConnected.into()))?;
            let count = read(port, &mut self.buffer).map_err(disconnected(&self.path))?;
            if count > 0 {
                trace::measured(count);
                self.parser.push(self.buffer.get(..count).unwrap_or(&[]));
            }
        }
    }

    fn close(&mut self) {
        self.port = None;
    }

    fn reopen(&mut self) -> Result<(), BoardError> {
        self.port = Some(open_port(&self.path)?);
        self.parser = LineParser::new(self.waveform.shape().codes());
        self.resequencer.note_reopening();
        Ok(())
    }

    fn last_frame(&self) -> Instant {
        self.resequencer.last_frame
    }

    fn recovery(&mut self) -> &mut Recovery {
        &mut self.recovery
    }
}

#[cfg(test)]
mod hard_cases {
    use radome_dsp::WaveformRequest;
    use serialport::TTYPort;

    use super::*;

    /// Regression test: firmware that stated a waveform with a wrong key or value was said to state none.
    #[test]
    fn a_stated_waveform_that_cannot_be_used_is_an_error_with_its_reason() {
        let mut impossible = Vec::new();
        let request = WaveformRequest { if_gain_db: 7.0, ..WaveformRequest::paper() };
        ascii::encode_waveform(&request, &mut impossible);
        let wrong_key = b"I (312) main: radar started\r\nWaveform: {\"start_hz\": 60e9}\r\n".to_vec();
        for (received, reason) in [(impossible, "if_gain_db is 7"), (wrong_key, "start_hz")] {
            let (_firmware, port) = TTYPort::pair().expect("a pty");
            let error = Esp32Stream::listen(Path::new("port"), port.into(), received, None).err().expect("refused");
            assert!(matches!(&error, BoardError::WaveformStated { reason: r, .. } if r.contains(reason)), "{error}");
            assert!(!error.is_transient() && error.to_string().contains("--waveform"), "{error}");
        }
    }
}
