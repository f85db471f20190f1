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
    /// Digest of the last accepted codes, by which a doubled line is detected.
    last_digest: u64,
    /// Line whose number was not the expected one.
    unconfirmed: Option<NumberedLine>,
    /// Whether a damaged line came since the last good one.
    pub(super) damaged: bool,
    /// Whether the port was opened again: the firmware may have restarted too.
    reopened: bool,
    ready: VecDeque<Ready>,
    spare: Vec<Vec<u16>>,
    pub(super) last_frame: Instant,
}

/// Line with the firmware's number and its time of arrival.
struct NumberedLine {
    number: u64,
    codes: Vec<u16>,
    arrival: Instant,
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
            last_digest: 0,
            unconfirmed: None,
            damaged: false,
            reopened: false,
            ready: VecDeque::with_capacity(4),
            spare: Vec::with_capacity(4),
            last_frame: Instant::now(),
        }
    }

    /// Notes that the port was opened again. Earlier lines then say nothing about the next ones.
    pub(super) fn note_reopening(&mut self) {
        self.unconfirmed = None;
        self.reopened = true;
    }

    /// Takes a line with the firmware's number, which arrived at `arrival`.
    pub(super) fn push_line(&mut self, number: u64, codes: &[u16], arrival: Instant) {
        if self.reopened {
            self.reopened = false;
            self.note_restart(number, arrival);
        }
        let next = *self.next_number.get_or_insert(number);
        if number == next {
            self.push_next(number, codes, arrival);
        } else if follows(next, number) && self.last_digest == digest(codes) {
            tracing::debug!(number, "a line came twice");
        } else {
            self.push_unexpected(next, number, codes, arrival);
        }
    }

    /// Takes a line with the expected number.
    fn push_next(&mut self, number: u64, codes: &[u16], arrival: Instant) {
        match self.unconfirmed.take() {
            // A line with the last number and other codes, then its successor: the firmware has restarted at its first
            // number.
            Some(line) if follows(number, line.number) => {
                self.note_restart(line.number, line.arrival);
                self.accept(&line.codes, line.arrival);
                self.accept(codes, arrival);
            }
            // The previous line arrived before this one, out of order.
            Some(line) if follows(line.number, number) => {
                self.accept(codes, arrival);
                self.accept(&line.codes, arrival);
            }
            _ => self.accept(codes, arrival),
        }
    }

    /// Takes a line with another number than `next`, the expected one. It counts when the next line confirms it.
    fn push_unexpected(&mut self, next: u64, number: u64, codes: &[u16], arrival: Instant) {
        match self.unconfirmed.take() {
            // Two lines have one number: one of them is wrong, and it is unknown which.
            Some(line) if line.number == number => {
                if line.codes == codes {
                    self.unconfirmed = Some(line);
                } else {
                    self.damaged = true;
                }
            }
            // Either both lines are ahead, perhaps with losses between them, or the firmware has restarted its count.
            Some(line)
                if follows(number, line.number) || (is_ahead(line.number, next) && is_ahead(number, line.number)) =>
            {
                if is_ahead(line.number, next) {
                    self.push_gap(line.number.wrapping_sub(next));
                } else {
                    self.note_restart(line.number, line.arrival);
                }
                self.next_number = Some(line.number);
                self.accept(&line.codes, line.arrival);
                self.push_line(number, codes, arrival);
            }
            line => {
                self.damaged |= line.is_some();
                self.unconfirmed = Some(NumberedLine { number, codes: self.copy_codes(codes), arrival });
            }
        }
    }

    fn copy_codes(&mut self, codes: &[u16]) -> Vec<u16> {
        let mut copy = self.spare.pop().unwrap_or_default();
        copy.clear();
        copy.extend_from_slice(codes);
        copy
    }

    fn accept(&mut self, codes: &[u16], arrival: Instant) {
        self.last_digest = digest(codes);
        self.next_number = self.next_number.map(|number| number.wrapping_add(1));
        let codes = self.copy_codes(codes);
        self.ready.push_back(Ready::Frame(codes));
        self.damaged = false;
        self.last_frame = arrival;
    }

    fn push_gap(&mut self, frames: u64) {
        let reason = if self.damaged { GapReason::Crc } else { GapReason::PacketLost };
        self.ready.push_back(Ready::Gap(Gap { first_sequence: 0, frames, reason }));
    }

    /// Notes a gap after a loss of the connection or a restart of the firmware. Firmware that has restarted counts from 0, so
    /// that only the host's clock gives the length of the gap. Firmware that has kept running has a number ahead: by no more
    /// than the host's clock allows, and further than firmware could have counted since a restart.
    fn note_restart(&mut self, number: u64, arrival: Instant) {
        let Some(next) = self.next_number.replace(number) else { return };
        let intervals = arrival.saturating_duration_since(self.last_frame).as_secs_f64()
            / self.waveform.frame_interval_s().max(1e-6);
        let frames_by_host = (intervals.round() as u64).saturating_sub(1);
        let has_kept_running =
            |ahead: &u64| ahead.abs_diff(frames_by_host) <= 1 || (*ahead <= frames_by_host && number > frames_by_host);
        let frames = Some(number.wrapping_sub(next)).filter(has_kept_running).unwrap_or(frames_by_host);
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

/// Returns whether `number` comes right after `previous`.
fn follows(number: u64, previous: u64) -> bool {
    number == previous.wrapping_add(1)
}

/// Returns whether `number` comes after `previous`, by at most as many frames as a board can lose.
fn is_ahead(number: u64, previous: u64) -> bool {
    (1..=u64::from(u32::MAX)).contains(&number.wrapping_sub(previous))
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
            resequencer.push_line(*number, &vec![*code; frame.shape.codes()], Instant::now());
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
    fn the_stream_continues_after_a_restart_of_the_firmware() {
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
        fn an_overtaken_line_is_put_in_order() {
            assert_eq!(ordered(&mut resequencer(), &lines(&[1, 3, 2, 4])), [Ok(1), Ok(2), Ok(3), Ok(4)]);
        }

        /// One or two inverted bits turn the number 12 into 92, 8, 13 or 11. Only that line is lost, and no frame gets
        /// the number of another.
        #[test]
        fn a_wrong_number_loses_only_its_line() {
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
        fn a_restart_after_one_or_two_lines_is_no_doubled_line() {
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
        fn a_gap_of_a_restart_ends_at_the_first_line_after_it() {
            let start = Instant::now();
            // Numbers and arrival times of lines, in frame intervals: a restart at another number, and one at the last
            // number.
            for lines in [&[(10, 0), (11, 1), (0, 6), (1, 7)][..], &[(0, 0), (0, 5), (1, 6)]] {
                let mut resequencer = resequencer();
                let interval_s = resequencer.waveform.frame_interval_s();
                for (number, intervals) in lines {
                    let codes = vec![*intervals; resequencer.waveform.shape().codes()];
                    resequencer.push_line(
                        *number,
                        &codes,
                        start + Duration::from_secs_f64(f64::from(*intervals) * interval_s),
                    );
                }
                let gaps = resequencer.ready.iter().filter_map(|ready| match ready {
                    Ready::Gap(gap) => Some(gap.frames),
                    Ready::Frame(_) => None,
                });
                assert_eq!(gaps.collect::<Vec<_>>(), [4], "{lines:?}");
            }
        }

        #[test]
        fn a_stream_with_every_second_line_lost_continues() {
            let found = ordered(&mut resequencer(), &lines(&[1, 3, 5, 7, 9]));
            assert_eq!(found, [Ok(1), Err((1, LOST)), Ok(3), Err((1, LOST)), Ok(5), Err((1, LOST)), Ok(7)]);
        }
    }
}
