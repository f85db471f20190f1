//! Resequencer of lines. It does no I/O: it turns numbered lines and their times into ordered frames and gaps.

use std::collections::VecDeque;
use std::time::Instant;

use radome_dsp::{Frame, Gap, GapReason, SourceEvent, Waveform};

use crate::board::host::now_ns;
use crate::protocol::fifo;

pub(super) struct Resequencer {
    waveform: Waveform,
    /// Sequence number of the next frame.
    next_sequence: u64,
    /// Number expected of the next line; unknown before the first line.
    pub(super) next_number: Option<u64>,
    /// Digest of the codes taken last, by which a doubled line is detected.
    last_codes: u64,
    /// Line whose number was not the expected one, and its time of arrival.
    unconfirmed: Option<(u64, Vec<u16>, Instant)>,
    /// Whether a damaged line came since the last good one.
    pub(super) damaged: bool,
    /// Whether the port was opened again: the firmware may have restarted too.
    reopened: bool,
    ready: VecDeque<Ready>,
    spare: Vec<Vec<u16>>,
    pub(super) last_frame: Instant,
}

enum Ready {
    Gap(Gap),
    /// Codes in FIFO order.
    Frame(Vec<u16>),
}

impl Resequencer {
    pub(super) fn new(waveform: &Waveform) -> Self {
        Resequencer {
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

    /// Notes that the port was opened again. Earlier lines then say nothing about the next ones.
    pub(super) fn reopened(&mut self) {
        self.unconfirmed = None;
        self.reopened = true;
    }

    /// Takes a line with the firmware's number, which came at `now`.
    pub(super) fn take(&mut self, number: u64, codes: &[u16], now: Instant) {
        if self.reopened {
            self.reopened = false;
            self.begin_anew(number, now);
        }
        let next = *self.next_number.get_or_insert(number);
        let follows = |number: u64, other: u64| number == other.wrapping_add(1);
        if number == next {
            match self.unconfirmed.take() {
                // A line with the last number and other codes, then its successor: the firmware has restarted at its
                // first number.
                Some((before, other, came)) if follows(next, before) => {
                    self.begin_anew(before, came);
                    self.accept(&other, came);
                    self.accept(codes, now);
                }
                // The previous line arrived before this one, out of order.
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
                // Two lines have one number: one of them is wrong, and it is unknown which.
                Some((before, other, came)) if before == number => {
                    if other == codes {
                        self.unconfirmed = Some((before, other, came));
                    } else {
                        self.damaged = true;
                    }
                }
                // Either both lines are ahead, perhaps with losses between them, or the firmware has restarted its
                // count.
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

    /// Notes a gap after a restart of the firmware. Firmware that has restarted counts from its start, so that only the
    /// host's clock tells the length of the gap. Firmware that has kept running has a number ahead. It is ahead by no
    /// more than the host's clock allows, and further than a count from the firmware's start could be.
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

    pub(super) fn pop(&mut self, frame: &mut Frame) -> Option<SourceEvent> {
        match self.ready.pop_front()? {
            Ready::Gap(gap) => {
                let first_sequence = self.next_sequence;
                self.next_sequence += gap.frames;
                Some(SourceEvent::Gap(Gap { first_sequence, ..gap }))
            }
            Ready::Frame(codes) => {
                fifo::fill_frame(&codes, &self.waveform, self.next_sequence, frame);
                frame.host_time_ns = now_ns();
                self.next_sequence += 1;
                self.spare.push(codes);
                Some(SourceEvent::Frame)
            }
        }
    }
}

/// Computes a digest of codes (FNV-1a over words).
fn digest(codes: &[u16]) -> u64 {
    codes.iter().fold(0xCBF2_9CE4_8422_2325, |hash, code| (hash ^ u64::from(*code)).wrapping_mul(0x100_0000_01B3))
}

/// Returns whether `number` comes after `of`, by at most as many frames as a board can lose.
fn is_ahead(number: u64, of: u64) -> bool {
    (1..=u64::from(u32::MAX)).contains(&number.wrapping_sub(of))
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;
    use crate::pattern::waveform;

    fn resequencer() -> Resequencer {
        Resequencer::new(&waveform(&[1, 2, 3], 2, 8, 0.1))
    }

    /// Feeds lines, given as number and code; all codes of a line are equal. Returns the codes of the resulting frames,
    /// and the gaps.
    fn ordered(resequencer: &mut Resequencer, lines: &[(u64, u16)]) -> Vec<Result<u16, (u64, GapReason)>> {
        let mut frame = Frame::zeroed(resequencer.waveform.shape());
        let (mut found, mut next) = (Vec::new(), resequencer.next_sequence);
        for (number, code) in lines {
            resequencer.take(*number, &vec![*code; frame.shape.codes()], Instant::now());
            while let Some(event) = resequencer.pop(&mut frame) {
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
        let found = ordered(&mut resequencer(), &lines(&[100, 101, 104, 105, 108, 110, 111]));
        let expected = [Ok(100), Ok(101), Err((2, LOST)), Ok(104), Ok(105), Err((2, LOST)), Ok(108), Err((1, LOST))];
        assert_eq!(found, [&expected[..], &[Ok(110), Ok(111)]].concat());
        let mut resequencer = resequencer();
        ordered(&mut resequencer, &lines(&[7]));
        resequencer.damaged = true;
        assert_eq!(ordered(&mut resequencer, &lines(&[9, 10])), [Err((1, GapReason::Crc)), Ok(9), Ok(10)]);
    }

    #[test]
    fn a_firmware_that_starts_anew_goes_on_where_the_stream_was() {
        let mut resequencer = resequencer();
        ordered(&mut resequencer, &lines(&[10, 11, 12, 13]));
        let found = ordered(&mut resequencer, &lines(&[0, 1, 2]));
        assert!(matches!(found[0], Err((1.., GapReason::Disconnected))), "{found:?}");
        assert_eq!(found[1..], [Ok(0), Ok(1), Ok(2)]);
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn a_line_that_comes_twice_is_taken_once() {
            let found = ordered(&mut resequencer(), &lines(&[1, 2, 2, 3, 3, 4]));
            assert_eq!(found, [Ok(1), Ok(2), Ok(3), Ok(4)]);
            // The doubled line is the first one behind a gap.
            assert_eq!(ordered(&mut resequencer(), &lines(&[1, 3, 3, 4])), [Ok(1), Err((1, LOST)), Ok(3), Ok(4)]);
        }

        #[test]
        fn a_line_that_was_overtaken_takes_its_place() {
            assert_eq!(ordered(&mut resequencer(), &lines(&[1, 3, 2, 4])), [Ok(1), Ok(2), Ok(3), Ok(4)]);
        }

        /// One or two inverted bits turn the number 12 into 92, 8, 13 or 11. Only that line is lost, and no frame gets
        /// the number of another.
        #[test]
        fn a_wrong_number_costs_its_line() {
            let lost = |frames| Err((frames, GapReason::Crc));
            for wrong in [92, 8] {
                let found =
                    ordered(&mut resequencer(), &[(10, 10), (11, 11), (wrong, 12), (13, 13), (14, 14), (15, 15)]);
                assert_eq!(found, [Ok(10), Ok(11), lost(1), Ok(13), Ok(14), Ok(15)], "12 as {wrong}");
            }
            let found = ordered(&mut resequencer(), &[(10, 10), (11, 11), (11, 12), (13, 13), (14, 14)]);
            assert_eq!(found, [Ok(10), Ok(11), lost(1), Ok(13), Ok(14)]);
            // Two lines have one number: both are discarded.
            let found = ordered(&mut resequencer(), &[(10, 10), (11, 11), (13, 12), (13, 13), (14, 14), (15, 15)]);
            assert_eq!(found, [Ok(10), Ok(11), lost(2), Ok(14), Ok(15)]);
        }

        /// Firmware that restarts after its first or second line repeats its last numbers.
        #[test]
        fn a_firmware_that_starts_anew_at_once_is_no_doubled_line() {
            for first in [&[(0, 7)][..], &[(0, 7), (1, 8)]] {
                let lines = [first, &[(0, 20), (1, 21), (2, 22)]].concat();
                let found = ordered(&mut resequencer(), &lines);
                let (before, after) = found.split_at(first.len());
                assert!(before.iter().all(Result::is_ok), "{found:?}");
                assert_eq!(after, [Err((1, GapReason::Disconnected)), Ok(20), Ok(21), Ok(22)]);
            }
        }

        /// Only the second line shows that the firmware has restarted; the restart began with the first line.
        #[test]
        fn what_was_lost_before_a_new_beginning_ends_with_its_first_line() {
            let began = Instant::now();
            // Numbers and arrival times of lines, in frame intervals: a restart at another number, and one at the last
            // number.
            for lines in [&[(10, 0), (11, 1), (0, 6), (1, 7)][..], &[(0, 0), (0, 5), (1, 6)]] {
                let mut resequencer = resequencer();
                let interval_s = resequencer.waveform.frame_interval_s();
                for (number, place) in lines {
                    let codes = vec![*place; resequencer.waveform.shape().codes()];
                    resequencer.take(*number, &codes, began + Duration::from_secs_f64(f64::from(*place) * interval_s));
                }
                let gaps = resequencer.ready.iter().filter_map(|ready| match ready {
                    Ready::Gap(gap) => Some(gap.frames),
                    Ready::Frame(_) => None,
                });
                assert_eq!(gaps.collect::<Vec<_>>(), [4], "{lines:?}");
            }
        }

        #[test]
        fn every_second_line_lost_is_no_standstill() {
            let found = ordered(&mut resequencer(), &lines(&[1, 3, 5, 7, 9]));
            assert_eq!(found, [Ok(1), Err((1, LOST)), Ok(3), Err((1, LOST)), Ok(5), Err((1, LOST)), Ok(7)]);
        }
    }
}
