//! A board with an ESP32 that prints its frames as lines ([`crate::protocol::ascii`]). It takes no requests: it measures what
//! it was built for, and the user has to name that waveform unless the firmware says it.

use std::io::{ErrorKind, Read};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use radome_dsp::{Frame, FrameSource, Gap, GapReason, SourceError, SourceEvent, Waveform};
use serialport::TTYPort;

use super::{BoardError, link};
use crate::protocol::ascii::{self, Line, LineParser};
use crate::protocol::fifo;

const BAUD_RATE: u32 = 921_600;
const BUFFER: usize = 65_536;
/// How long firmware may take to say what it measures.
const WAVEFORM_TIMEOUT: Duration = Duration::from_secs(3);
/// Bytes among which it must have said so.
const MOST_HEARD: usize = 1 << 22;

/// Frames of such a board, from the next whole line on.
pub struct LineStream {
    path: PathBuf,
    port: TTYPort,
    parser: LineParser,
    buffer: Vec<u8>,
    order: Order,
    /// Longest silence, by the frame interval and by how long a line takes.
    deadline: Duration,
    waveform: Waveform,
}

/// From the firmware's numbers to frames and gaps in order.
struct Order {
    waveform: Waveform,
    /// Frames handed out or given up.
    next_sequence: u64,
    /// The firmware's number of sequence number 0, modulo 2^64.
    base: Option<u64>,
    /// Whether a damaged line came since the last good one.
    damaged: bool,
    /// A frame that waits behind its gap: FIFO order.
    waiting: Option<Vec<u16>>,
    last_frame: Instant,
}

impl LineStream {
    /// Opens the port and listens. Without a waveform the firmware has to say what it measures.
    ///
    /// # Errors
    /// The port cannot be opened, is busy, or may not be opened by this user; no waveform is given and none is heard.
    pub fn open(path: &Path, waveform: Option<&Waveform>) -> Result<Self, BoardError> {
        LineStream::listen(path, link::open_port(path, BAUD_RATE)?, Vec::new(), waveform)
    }

    /// Goes on with a port that has been listened to, and what was heard.
    pub(super) fn listen(
        path: &Path,
        mut port: TTYPort,
        mut heard: Vec<u8>,
        waveform: Option<&Waveform>,
    ) -> Result<Self, BoardError> {
        let waveform = match waveform {
            Some(waveform) => waveform.clone(),
            None => hear_waveform(path, &mut port, &mut heard)?,
        };
        let codes = waveform.shape().codes();
        // Six characters a code, ten bits a character.
        let line_s = codes as f64 * 60.0 / f64::from(BAUD_RATE);
        let mut parser = LineParser::new(codes);
        parser.push(&heard);
        Ok(LineStream {
            path: path.into(),
            port,
            parser,
            buffer: vec![0; BUFFER],
            order: Order::new(&waveform),
            deadline: Duration::from_secs_f64(1.0 + 3.0 * waveform.frame_interval_s().max(line_s)),
            waveform,
        })
    }

    fn wait(&mut self, frame: &mut Frame) -> Result<SourceEvent, BoardError> {
        if self.order.deliver_waiting(frame) {
            return Ok(SourceEvent::Frame);
        }
        // Bytes alone are no sign of life: lines of another waveform would be waited on for good.
        let began = Instant::now();
        let mut unfit = None;
        loop {
            while let Some(line) = self.parser.next_line() {
                match line {
                    Ok(Line::Frame { number, codes }) => return Ok(self.order.take(number, codes, frame)),
                    Ok(Line::Log(text)) => {
                        tracing::debug!("{}: {}", self.path.display(), String::from_utf8_lossy(text));
                    }
                    Err(error) => {
                        tracing::warn!("{}: {error}", self.path.display());
                        self.order.damaged = true;
                        unfit = Some(error);
                    }
                }
            }
            let lost = |source| BoardError::Disconnected { path: self.path.clone(), source };
            match self.port.read(&mut self.buffer) {
                Ok(0) => return Err(lost(ErrorKind::UnexpectedEof.into())),
                Ok(count) => {
                    self.parser.push(self.buffer.get(..count).unwrap_or(&[]));
                }
                Err(e) if matches!(e.kind(), ErrorKind::TimedOut | ErrorKind::Interrupted | ErrorKind::WouldBlock) => {}
                Err(e) => return Err(lost(e)),
            }
            if began.elapsed() > self.deadline {
                let path = self.path.clone();
                return Err(match unfit {
                    Some(source) => BoardError::Line { path, source },
                    None => BoardError::Stalled { path, waited: self.deadline },
                });
            }
        }
    }
}

/// Listens until the firmware says what it measures; everything heard is kept.
fn hear_waveform(path: &Path, port: &mut TTYPort, heard: &mut Vec<u8>) -> Result<Waveform, BoardError> {
    let untold = || BoardError::WaveformUntold { path: path.to_owned() };
    let began = Instant::now();
    let mut begin = 0;
    loop {
        while let Some(length) = heard.get(begin..).unwrap_or(&[]).iter().position(|b| *b == b'\n') {
            let line = heard.get(begin..begin + length).unwrap_or(&[]);
            begin += length + 1;
            match ascii::decode_waveform(line.strip_suffix(b"\r").unwrap_or(line)).map(|r| r.map(Waveform::realise)) {
                None => {}
                Some(Ok(Ok(waveform))) => return Ok(waveform),
                Some(_) => return Err(untold()),
            }
        }
        if began.elapsed() > WAVEFORM_TIMEOUT || heard.len() > MOST_HEARD {
            return Err(untold());
        }
        link::read_more(path, port, heard)?;
    }
}

impl Order {
    fn new(waveform: &Waveform) -> Self {
        Order {
            waveform: waveform.clone(),
            next_sequence: 0,
            base: None,
            damaged: false,
            waiting: None,
            last_frame: Instant::now(),
        }
    }

    /// A whole frame by the firmware's number: itself, or the gap before it.
    fn take(&mut self, number: u64, codes: &[u16], frame: &mut Frame) -> SourceEvent {
        let base = *self.base.get_or_insert(number);
        let mut sequence = number.wrapping_sub(base);
        let mut reason = if self.damaged { GapReason::Crc } else { GapReason::PacketLost };
        if sequence < self.next_sequence || sequence - self.next_sequence > u64::from(u32::MAX) {
            // The firmware has started anew and counts from its own beginning: only the host's clock knows how long it was
            // away.
            let intervals = self.last_frame.elapsed().as_secs_f64() / self.waveform.frame_interval_s().max(1e-6);
            sequence = self.next_sequence + (intervals.round() as u64).saturating_sub(1);
            self.base = Some(number.wrapping_sub(sequence));
            reason = GapReason::Disconnected;
        }
        self.damaged = false;
        self.last_frame = Instant::now();
        let missing = sequence - self.next_sequence;
        if missing == 0 {
            self.deliver(codes, frame);
            return SourceEvent::Frame;
        }
        let gap = Gap { first_sequence: self.next_sequence, frames: missing, reason };
        self.next_sequence = sequence;
        self.waiting = Some(codes.to_vec());
        SourceEvent::Gap(gap)
    }

    fn deliver_waiting(&mut self, frame: &mut Frame) -> bool {
        let Some(codes) = self.waiting.take() else { return false };
        self.deliver(&codes, frame);
        true
    }

    fn deliver(&mut self, codes: &[u16], frame: &mut Frame) {
        let shape = self.waveform.shape();
        frame.shape = shape;
        frame.codes.resize(shape.codes(), 0);
        fifo::deinterleave(codes, shape, &mut frame.codes);
        frame.sequence = self.next_sequence;
        // Lines carry no time: frames come at their interval.
        frame.time_ns = (self.next_sequence as f64 * self.waveform.frame_interval_s() * 1e9).round() as u64;
        frame.host_time_ns = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_nanos() as u64);
        frame.truth = None;
        frame.temperature_millicelsius = None;
        self.next_sequence += 1;
    }
}

impl FrameSource for LineStream {
    fn waveform(&self) -> &Waveform {
        &self.waveform
    }

    fn next_frame(&mut self, frame: &mut Frame) -> Result<SourceEvent, SourceError> {
        Ok(self.wait(frame)?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use radome_dsp::WaveformRequest;

    fn order() -> (Order, Frame) {
        let request = WaveformRequest { samples_per_chirp: 8, chirps_per_frame: 2, ..WaveformRequest::paper() };
        let waveform = Waveform::realise(request).expect("valid");
        (Order::new(&waveform), Frame::zeroed(waveform.shape()))
    }

    #[test]
    fn a_jump_of_the_number_is_a_gap_before_its_frame() {
        let (mut order, mut frame) = order();
        let codes = vec![5; frame.codes.len()];
        assert_eq!(order.take(100, &codes, &mut frame), SourceEvent::Frame);
        let gap = Gap { first_sequence: 1, frames: 2, reason: GapReason::PacketLost };
        assert_eq!(order.take(103, &codes, &mut frame), SourceEvent::Gap(gap));
        assert!(order.deliver_waiting(&mut frame) && frame.sequence == 3);
        order.damaged = true;
        let gap = Gap { first_sequence: 4, frames: 1, reason: GapReason::Crc };
        assert_eq!(order.take(105, &codes, &mut frame), SourceEvent::Gap(gap));
    }

    #[test]
    fn a_firmware_that_starts_anew_goes_on_where_the_stream_was() {
        let (mut order, mut frame) = order();
        let codes = vec![5; frame.codes.len()];
        for number in 10..20 {
            assert_eq!(order.take(number, &codes, &mut frame), SourceEvent::Frame);
        }
        match order.take(0, &codes, &mut frame) {
            SourceEvent::Frame => assert_eq!(frame.sequence, 10),
            SourceEvent::Gap(gap) => assert_eq!((gap.first_sequence, gap.reason), (10, GapReason::Disconnected)),
            SourceEvent::End => panic!("no end"),
        }
    }
}
