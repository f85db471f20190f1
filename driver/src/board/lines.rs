//! Board with an ESP32 that prints its frames as lines ([`crate::protocol::ascii`]). It takes no requests and measures
//! the waveform that it was built for. The user has to name that waveform unless the firmware states it.

use std::collections::VecDeque;
use std::io::{ErrorKind, Read};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use radome_dsp::{Frame, FrameSource, Gap, GapReason, SourceError, SourceEvent, Waveform};
use serialport::TTYPort;

use super::reconnect::{Losses, Outage, Reconnect};
use super::{BoardError, link, wire};
use crate::protocol::ascii::{self, Line, LineParser};
use crate::protocol::fifo;

const BAUD_RATE: u32 = 921_600;
const BUFFER: usize = 65_536;
/// Longest wait for the line in which the firmware states its waveform.
const WAVEFORM_TIMEOUT: Duration = Duration::from_secs(3);
/// Most bytes that are searched for that line.
const MOST_HEARD: usize = 1 << 22;

/// Frame stream of a board that prints lines, from the next whole line on.
///
/// Lines have no check sum: a digit of a code that becomes another digit is not detected. Lines that are lost, doubled,
/// cut, out of order or wrongly numbered are detected: a number that does not follow its predecessor counts when the
/// next line confirms it.
pub struct LineStream {
    path: PathBuf,
    /// `None` while the board is disconnected.
    port: Option<TTYPort>,
    parser: LineParser,
    buffer: Vec<u8>,
    order: Order,
    /// Longest silence, from the frame interval and the duration of a line.
    deadline: Duration,
    waveform: Waveform,
    reconnect: Option<Reconnect>,
    outage: Outage,
    losses: Losses,
}

/// Resequencer of lines: numbered lines in, frames and gaps in order out.
struct Order {
    waveform: Waveform,
    /// Sequence number of the next frame.
    next_sequence: u64,
    /// Number expected of the next line; unknown before the first line.
    next_number: Option<u64>,
    /// Digest of the codes taken last, by which a doubled line is detected.
    last_codes: u64,
    /// Line whose number was not the expected one, and its time of arrival.
    unconfirmed: Option<(u64, Vec<u16>, Instant)>,
    /// Whether a damaged line came since the last good one.
    damaged: bool,
    /// The port was opened anew: the firmware may have started anew too.
    reopened: bool,
    ready: VecDeque<Ready>,
    spare: Vec<Vec<u16>>,
    last_frame: Instant,
}

enum Ready {
    Gap(Gap),
    /// Codes in FIFO order.
    Frame(Vec<u16>),
}

impl LineStream {
    /// Opens the port and listens. Without a waveform the firmware has to state its own.
    ///
    /// # Errors
    /// [`BoardError::Open`], [`BoardError::Busy`] or [`BoardError::PermissionDenied`] if the port cannot be opened;
    /// [`BoardError::WaveformUntold`] if no waveform is given and the firmware states none.
    pub fn open(path: &Path, waveform: Option<&Waveform>) -> Result<Self, BoardError> {
        LineStream::listen(path, link::open_port(path, BAUD_RATE)?, Vec::new(), waveform)
    }

    /// Starts a stream on an open port; `heard` are the bytes read from it so far.
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
            port: Some(port),
            parser,
            buffer: vec![0; BUFFER],
            order: Order::new(&waveform),
            deadline: Duration::from_secs_f64(1.0 + 3.0 * waveform.frame_interval_s().max(line_s)),
            waveform,
            reconnect: None,
            outage: Outage::default(),
            losses: Losses::default(),
        })
    }

    /// Makes the stream reconnect after the board was unplugged or fell silent. The frames lost meanwhile become a gap,
    /// counted by the host's clock.
    pub fn with_reconnect(mut self, policy: Reconnect) -> Self {
        self.reconnect = Some(policy);
        self
    }

    /// Number of frames lost so far for this reason.
    pub fn lost_frames(&self, reason: GapReason) -> u64 {
        self.losses.frames(reason)
    }

    fn wait(&mut self, frame: &mut Frame) -> Result<SourceEvent, BoardError> {
        // The deadline is not extended by bytes alone: lines of another waveform would keep the stream waiting for
        // ever.
        let began = Instant::now();
        let mut unfit = None;
        loop {
            if let Some(event) = self.order.pop(frame) {
                return Ok(event);
            }
            match self.parser.next_line() {
                Some(Ok(Line::Frame { number, codes })) => {
                    self.order.take(number, codes, Instant::now());
                    continue;
                }
                Some(Ok(Line::Log(text))) => {
                    tracing::debug!("{}: {}", self.path.display(), String::from_utf8_lossy(text));
                    continue;
                }
                Some(Err(error)) => {
                    tracing::warn!("{}: {error}", self.path.display());
                    self.order.damaged = true;
                    unfit = Some(error);
                    continue;
                }
                None => {}
            }
            // Received lines were parsed first: a caller that did not read for so long has not lost the board.
            if began.elapsed() > self.deadline {
                let path = self.path.clone();
                return Err(match unfit {
                    // Once a frame has come the waveform is right, and a damaged line only the last before a silence.
                    Some(source) if self.order.next_number.is_none() => BoardError::Line { path, source },
                    _ => BoardError::Stalled { path, waited: self.deadline },
                });
            }
            let lost = |source| BoardError::Disconnected { path: self.path.clone(), source };
            let port = self.port.as_mut().ok_or_else(|| lost(ErrorKind::NotConnected.into()))?;
            match port.read(&mut self.buffer) {
                Ok(0) => return Err(lost(ErrorKind::UnexpectedEof.into())),
                Ok(count) => {
                    wire::measured(count);
                    self.parser.push(self.buffer.get(..count).unwrap_or(&[]));
                }
                Err(e) if matches!(e.kind(), ErrorKind::TimedOut | ErrorKind::Interrupted | ErrorKind::WouldBlock) => {}
                Err(e) => return Err(lost(e)),
            }
        }
    }

    /// Opens the port again until that works; returns `error` if it does not.
    fn reopen(&mut self, policy: Reconnect, error: BoardError) -> Result<(), BoardError> {
        // The old port must be closed before the new one can be opened.
        self.port = None;
        policy.until_back(self.outage.noticed(self.order.last_frame), error, || {
            self.port = Some(link::open_port(&self.path, BAUD_RATE)?);
            self.parser = LineParser::new(self.waveform.shape().codes());
            self.order.reopened();
            Ok(())
        })
    }
}

/// Listens until the firmware states its waveform; appends all bytes to `heard`.
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
            next_number: None,
            last_codes: 0,
            unconfirmed: None,
            damaged: false,
            reopened: false,
            ready: VecDeque::with_capacity(4),
            spare: Vec::with_capacity(4),
            last_frame: Instant::now(),
        }
    }

    /// Notes that the port was opened again: earlier lines tell nothing about the next ones.
    fn reopened(&mut self) {
        self.unconfirmed = None;
        self.reopened = true;
    }

    /// Takes a line with the firmware's number, which came at `now`.
    fn take(&mut self, number: u64, codes: &[u16], now: Instant) {
        if self.reopened {
            self.reopened = false;
            self.begin_anew(number, now);
        }
        let next = *self.next_number.get_or_insert(number);
        let follows = |number: u64, other: u64| number == other.wrapping_add(1);
        if number == next {
            match self.unconfirmed.take() {
                // The last number with other codes and its successor: the firmware has started anew at its first
                // number.
                Some((before, other, came)) if follows(next, before) => {
                    self.begin_anew(before, came);
                    self.accept(&other, came);
                    self.accept(codes, now);
                }
                // The line before has overtaken this one.
                Some((later, other, _)) if follows(later, number) => {
                    self.accept(codes, now);
                    self.accept(&other, now);
                }
                _ => self.accept(codes, now),
            }
        } else if follows(next, number) && self.last_codes == digest(codes) {
            tracing::debug!(number, "a line came twice");
        } else {
            match self.unconfirmed.take() {
                // Two lines with one number: one of them is wrong, and it is unknown which.
                Some((before, other, came)) if before == number => {
                    if other == codes {
                        self.unconfirmed = Some((before, other, came));
                    } else {
                        self.damaged = true;
                    }
                }
                // Either both are ahead, perhaps with losses between them, or the firmware counts from its start.
                Some((before, other, came))
                    if follows(number, before) || (is_ahead(before, next) && is_ahead(number, before)) =>
                {
                    if is_ahead(before, next) {
                        self.lose(before.wrapping_sub(next));
                    } else {
                        self.begin_anew(before, came);
                    }
                    self.next_number = Some(before);
                    self.accept(&other, came);
                    self.take(number, codes, now);
                }
                before => {
                    self.damaged |= before.is_some();
                    self.unconfirmed = Some((number, self.copy(codes), now));
                }
            }
        }
    }

    fn copy(&mut self, codes: &[u16]) -> Vec<u16> {
        let mut copy = self.spare.pop().unwrap_or_default();
        copy.clear();
        copy.extend_from_slice(codes);
        copy
    }

    fn accept(&mut self, codes: &[u16], came: Instant) {
        self.last_codes = digest(codes);
        self.next_number = self.next_number.map(|number| number.wrapping_add(1));
        let codes = self.copy(codes);
        self.ready.push_back(Ready::Frame(codes));
        self.damaged = false;
        self.last_frame = came;
    }

    fn lose(&mut self, frames: u64) {
        let reason = if self.damaged { GapReason::Crc } else { GapReason::PacketLost };
        self.ready.push_back(Ready::Gap(Gap { first_sequence: 0, frames, reason }));
    }

    /// Notes a gap after a restart of the firmware. Firmware that has started anew counts from its start, so that only
    /// the host's clock tells the length of the gap. Firmware that has run on has a number ahead: by no more than that
    /// clock allows, and further than it could have counted from its start.
    fn begin_anew(&mut self, number: u64, came: Instant) {
        let Some(next) = self.next_number.replace(number) else { return };
        let intervals =
            came.saturating_duration_since(self.last_frame).as_secs_f64() / self.waveform.frame_interval_s().max(1e-6);
        let by_host = (intervals.round() as u64).saturating_sub(1);
        let has_run_on = |ahead: &u64| ahead.abs_diff(by_host) <= 1 || (*ahead <= by_host && number > by_host);
        let frames = Some(number.wrapping_sub(next)).filter(has_run_on).unwrap_or(by_host);
        // At least the line that was cut short is lost.
        let gap = Gap { first_sequence: 0, frames: frames.max(1), reason: GapReason::Disconnected };
        self.ready.push_back(Ready::Gap(gap));
    }

    /// Pops the next frame or gap.
    fn pop(&mut self, frame: &mut Frame) -> Option<SourceEvent> {
        match self.ready.pop_front()? {
            Ready::Gap(gap) => {
                let first_sequence = self.next_sequence;
                self.next_sequence += gap.frames;
                Some(SourceEvent::Gap(Gap { first_sequence, ..gap }))
            }
            Ready::Frame(codes) => {
                self.deliver(&codes, frame);
                self.spare.push(codes);
                Some(SourceEvent::Frame)
            }
        }
    }

    fn deliver(&mut self, codes: &[u16], frame: &mut Frame) {
        let shape = self.waveform.shape();
        frame.shape = shape;
        frame.codes.resize(shape.codes(), 0);
        fifo::deinterleave(codes, shape, &mut frame.codes);
        frame.sequence = self.next_sequence;
        // Lines carry no time: frames are taken to come at their interval.
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
        loop {
            let error = match self.wait(frame) {
                Ok(SourceEvent::Gap(gap)) => {
                    self.losses.count(&gap);
                    return Ok(SourceEvent::Gap(gap));
                }
                Ok(event) => return Ok(event),
                Err(error) => error,
            };
            match self.reconnect {
                Some(policy) if error.is_passing() => self.reopen(policy, error)?,
                _ => return Err(error.into()),
            }
        }
    }
}

/// Tells codes from others, all but surely.
fn digest(codes: &[u16]) -> u64 {
    codes.iter().fold(0xCBF2_9CE4_8422_2325, |hash, code| (hash ^ u64::from(*code)).wrapping_mul(0x100_0000_01B3))
}

/// Returns whether a number comes after another, by no more than boards lose.
fn is_ahead(number: u64, of: u64) -> bool {
    (1..=u64::from(u32::MAX)).contains(&number.wrapping_sub(of))
}

#[cfg(test)]
mod tests {
    use super::*;
    use radome_dsp::WaveformRequest;

    fn order() -> Order {
        let request = WaveformRequest { samples_per_chirp: 8, chirps_per_frame: 2, ..WaveformRequest::paper() };
        Order::new(&Waveform::realise(request).expect("valid"))
    }

    /// Numbers of lines as they come; each line's codes are all as its number, or as told. Gives the numbers that the
    /// frames' codes tell, and the gaps.
    fn ordered(order: &mut Order, lines: &[(u64, u16)]) -> Vec<Result<u16, (u64, GapReason)>> {
        let mut frame = Frame::zeroed(order.waveform.shape());
        let (mut found, mut next) = (Vec::new(), order.next_sequence);
        for (number, code) in lines {
            order.take(*number, &vec![*code; frame.shape.codes()], Instant::now());
            while let Some(event) = order.pop(&mut frame) {
                match event {
                    SourceEvent::Frame => {
                        assert_eq!(frame.sequence, next);
                        next += 1;
                        found.push(Ok(frame.codes[0]));
                    }
                    SourceEvent::Gap(gap) => {
                        assert_eq!(gap.first_sequence, next);
                        next += gap.frames;
                        found.push(Err((gap.frames, gap.reason)));
                    }
                    SourceEvent::End => panic!("no end"),
                }
            }
        }
        found
    }

    fn lines(numbers: &[u16]) -> Vec<(u64, u16)> {
        numbers.iter().map(|n| (u64::from(*n), *n)).collect()
    }

    const LOST: GapReason = GapReason::PacketLost;

    #[test]
    fn a_jump_of_the_number_is_a_gap_before_its_frame() {
        let found = ordered(&mut order(), &lines(&[100, 101, 104, 105, 108, 110, 111]));
        let expected = [Ok(100), Ok(101), Err((2, LOST)), Ok(104), Ok(105), Err((2, LOST)), Ok(108), Err((1, LOST))];
        assert_eq!(found, [&expected[..], &[Ok(110), Ok(111)]].concat());
        let mut order = order();
        ordered(&mut order, &lines(&[7]));
        order.damaged = true;
        assert_eq!(ordered(&mut order, &lines(&[9, 10])), [Err((1, GapReason::Crc)), Ok(9), Ok(10)]);
    }

    #[test]
    fn a_firmware_that_starts_anew_goes_on_where_the_stream_was() {
        let mut order = order();
        ordered(&mut order, &lines(&[10, 11, 12, 13]));
        let found = ordered(&mut order, &lines(&[0, 1, 2]));
        assert!(matches!(found[0], Err((1.., GapReason::Disconnected))), "{found:?}");
        assert_eq!(found[1..], [Ok(0), Ok(1), Ok(2)]);
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn a_line_that_comes_twice_is_taken_once() {
            let found = ordered(&mut order(), &lines(&[1, 2, 2, 3, 3, 4]));
            assert_eq!(found, [Ok(1), Ok(2), Ok(3), Ok(4)]);
            // The doubled one is the first behind a gap.
            assert_eq!(ordered(&mut order(), &lines(&[1, 3, 3, 4])), [Ok(1), Err((1, LOST)), Ok(3), Ok(4)]);
        }

        #[test]
        fn a_line_that_was_overtaken_takes_its_place() {
            assert_eq!(ordered(&mut order(), &lines(&[1, 3, 2, 4])), [Ok(1), Ok(2), Ok(3), Ok(4)]);
        }

        /// 12 as 92, as 8, as 13 and as 11, each a flipped bit or two: the line is lost and no other, and no frame has
        /// another's number.
        #[test]
        fn a_wrong_number_costs_its_line() {
            let lost = |frames| Err((frames, GapReason::Crc));
            for wrong in [92, 8] {
                let found = ordered(&mut order(), &[(10, 10), (11, 11), (wrong, 12), (13, 13), (14, 14), (15, 15)]);
                assert_eq!(found, [Ok(10), Ok(11), lost(1), Ok(13), Ok(14), Ok(15)], "12 as {wrong}");
            }
            let found = ordered(&mut order(), &[(10, 10), (11, 11), (11, 12), (13, 13), (14, 14)]);
            assert_eq!(found, [Ok(10), Ok(11), lost(1), Ok(13), Ok(14)]);
            // Two lines of one number: neither is believed.
            let found = ordered(&mut order(), &[(10, 10), (11, 11), (13, 12), (13, 13), (14, 14), (15, 15)]);
            assert_eq!(found, [Ok(10), Ok(11), lost(2), Ok(14), Ok(15)]);
        }

        /// After its first line, or its second, a firmware that begins anew repeats numbers that were the last ones.
        #[test]
        fn a_firmware_that_starts_anew_at_once_is_no_doubled_line() {
            for first in [&[(0, 7)][..], &[(0, 7), (1, 8)]] {
                let lines = [first, &[(0, 20), (1, 21), (2, 22)]].concat();
                let found = ordered(&mut order(), &lines);
                let (before, after) = found.split_at(first.len());
                assert!(before.iter().all(Result::is_ok), "{found:?}");
                assert_eq!(after, [Err((1, GapReason::Disconnected)), Ok(20), Ok(21), Ok(22)]);
            }
        }

        /// Returns whether it has begun anew only its second line says; it began with the first.
        #[test]
        fn what_was_lost_before_a_new_beginning_ends_with_its_first_line() {
            let began = Instant::now();
            // Numbers and when they come, in frame intervals: one that begins at another number, and one at the last
            // again.
            for lines in [&[(10, 0), (11, 1), (0, 6), (1, 7)][..], &[(0, 0), (0, 5), (1, 6)]] {
                let mut order = order();
                let interval_s = order.waveform.frame_interval_s();
                for (number, place) in lines {
                    let codes = vec![*place; order.waveform.shape().codes()];
                    order.take(*number, &codes, began + Duration::from_secs_f64(f64::from(*place) * interval_s));
                }
                let gaps = order.ready.iter().filter_map(|ready| match ready {
                    Ready::Gap(gap) => Some(gap.frames),
                    Ready::Frame(_) => None,
                });
                assert_eq!(gaps.collect::<Vec<_>>(), [4], "{lines:?}");
            }
        }

        #[test]
        fn every_second_line_lost_is_no_standstill() {
            let found = ordered(&mut order(), &lines(&[1, 3, 5, 7, 9]));
            assert_eq!(found, [Ok(1), Err((1, LOST)), Ok(3), Err((1, LOST)), Ok(5), Err((1, LOST)), Ok(7)]);
        }
    }
}
