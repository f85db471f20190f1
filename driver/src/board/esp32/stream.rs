//! Frame stream of an ESP32 that prints lines.

use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use radome_dsp::{Frame, FrameSource, SourceError, SourceEvent, Waveform};

use super::resequencer::Resequencer;
use crate::board::BoardError;
use crate::board::host::{lost, open_port};
use crate::board::reconnect::{Outage, Reconnect, Reconnectable, Recovery, next_event};
use crate::protocol::ascii::{self, Line, LineParser};
use crate::transport::serial::{BAUD_RATE, BUFFER, OpenPort, read, read_more};
use crate::transport::trace;

/// Longest wait for the line in which the firmware states its waveform.
const WAVEFORM_TIMEOUT: Duration = Duration::from_secs(3);
/// Most bytes that are searched for that line.
const MAX_HEARD_BYTES: usize = 1 << 22;

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
    /// Whether the log has a line that does not fit the waveform since the last frame.
    is_unfit_told: bool,
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

    /// Starts a stream on an open port; `heard` are the bytes read from it so far.
    pub(in crate::board) fn listen(
        path: &Path,
        mut port: OpenPort,
        mut heard: Vec<u8>,
        waveform: Option<&Waveform>,
    ) -> Result<Self, BoardError> {
        let waveform = match waveform {
            Some(waveform) => waveform.clone(),
            None => read_waveform_line(path, &mut port, &mut heard)?,
        };
        let codes = waveform.shape().codes();
        // A code takes six characters, a character ten bits.
        let line_s = codes as f64 * 60.0 / f64::from(BAUD_RATE);
        let mut parser = LineParser::new(codes);
        parser.push(&heard);
        Ok(Esp32Stream {
            path: path.into(),
            port: Some(port),
            parser,
            buffer: vec![0; BUFFER],
            resequencer: Resequencer::new(&waveform),
            is_unfit_told: false,
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

    /// Returns what tells, from any thread, whether the board is away.
    pub fn outage(&self) -> Outage {
        self.recovery.outage.clone()
    }
}

/// Listens until the firmware states its waveform; appends all bytes to `heard`.
fn read_waveform_line(path: &Path, port: &mut OpenPort, heard: &mut Vec<u8>) -> Result<Waveform, BoardError> {
    let began = Instant::now();
    let mut begin = 0;
    loop {
        while let Some(length) = heard.get(begin..).unwrap_or(&[]).iter().position(|b| *b == b'\n') {
            let line = heard.get(begin..begin + length).unwrap_or(&[]);
            begin += length + 1;
            if let Some(request) = ascii::decode_waveform(line.strip_suffix(b"\r").unwrap_or(line)) {
                let unusable = |reason: String| BoardError::WaveformStated { path: path.to_owned(), reason };
                let request = request.map_err(|error| unusable(error.to_string()))?;
                return Waveform::realise(request).map_err(|error| unusable(error.to_string()));
            }
        }
        if began.elapsed() > WAVEFORM_TIMEOUT || heard.len() > MAX_HEARD_BYTES {
            return Err(BoardError::WaveformUnknown { path: path.to_owned() });
        }
        read_more(port, heard).map_err(lost(path))?;
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
    fn wait(&mut self, frame: &mut Frame) -> Result<SourceEvent, BoardError> {
        // The deadline is not extended by bytes alone: lines of another waveform would keep the stream waiting for
        // ever.
        let began = Instant::now();
        let mut unfit = None;
        loop {
            if let Some(event) = self.resequencer.pop(frame) {
                return Ok(event);
            }
            match self.parser.next_line() {
                Some(Ok(Line::Frame { number, codes })) => {
                    self.resequencer.take(number, codes, Instant::now());
                    self.is_unfit_told = false;
                    continue;
                }
                Some(Ok(Line::Log(text))) => {
                    tracing::debug!("{}: {}", self.path.display(), String::from_utf8_lossy(text));
                    continue;
                }
                Some(Err(error)) => {
                    // If the firmware has another waveform, no line fits.
                    if !std::mem::replace(&mut self.is_unfit_told, true) {
                        tracing::warn!("{}: {error}", self.path.display());
                    }
                    self.resequencer.damaged = true;
                    unfit = Some(error);
                    continue;
                }
                None => {}
            }
            // Received lines were parsed first: a caller that did not read for so long has not lost the board.
            if began.elapsed() > self.deadline {
                let path = self.path.clone();
                return Err(match unfit {
                    // After a first frame the waveform is known to be right: a damaged line is then only the last one
                    // before a silence.
                    Some(source) if self.resequencer.next_number.is_none() => BoardError::Line { path, source },
                    _ => BoardError::Stalled { path, waited: self.deadline },
                });
            }
            let port = self.port.as_mut().ok_or_else(|| lost(&self.path)(ErrorKind::NotConnected.into()))?;
            let count = read(port, &mut self.buffer).map_err(lost(&self.path))?;
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
        self.resequencer.reopened();
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
    fn a_stated_waveform_that_cannot_be_used_is_told_with_its_reason() {
        let mut impossible = Vec::new();
        let request = WaveformRequest { if_gain_db: 7.0, ..WaveformRequest::paper() };
        ascii::encode_waveform(&request, &mut impossible);
        let wrong_key = b"I (312) main: radar started\r\nWaveform: {\"start_hz\": 60e9}\r\n".to_vec();
        for (heard, reason) in [(impossible, "if_gain_db is 7"), (wrong_key, "start_hz")] {
            let (_firmware, port) = TTYPort::pair().expect("a pty");
            let error = Esp32Stream::listen(Path::new("port"), port.into(), heard, None).err().expect("refused");
            assert!(matches!(&error, BoardError::WaveformStated { reason: r, .. } if r.contains(reason)), "{error}");
            assert!(!error.is_passing() && error.to_string().contains("--waveform"), "{error}");
        }
    }
}
