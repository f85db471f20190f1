//! Resequencer of DEEPCRAFT streams. It does no I/O: it turns chunks and times of the host into ordered frames and
//! gaps.

use std::collections::VecDeque;
use std::time::Duration;

use radome_dsp::{Frame, Gap, GapReason, SourceEvent, Waveform};

use crate::protocol::deepcraft::FIFO_LEVEL_CODES;
use crate::protocol::fifo;

pub(super) struct Resequencer {
    waveform: Waveform,
    /// Sequence number of the next frame: the number of earlier frames that were handed out, lost or queued.
    next_sequence: u64,
    /// Firmware's number of the next frame, modulo 2^32.
    next_number: u32,
    /// Reason of the last restart of the stream, until the next chunk. After a restart only the host's clock gives the
    /// number of lost frames.
    restart_reason: Option<GapReason>,
    damaged: bool,
    /// Gaps that come before the queued frames.
    gaps: VecDeque<Gap>,
    /// Number of frames that the device has dropped since it was configured and that gaps already account for.
    accounted_drops: u64,
    /// Codes of the queued frames, each in FIFO order; the first `popped` frames have been handed out.
    codes: Vec<u16>,
    popped: usize,
}

impl Resequencer {
    /// Creates a resequencer of a stream whose first frame has the number `next_number`.
    pub fn new(waveform: &Waveform, next_number: u32) -> Self {
        Resequencer {
            waveform: waveform.clone(),
            next_sequence: 0,
            next_number,
            restart_reason: None,
            damaged: false,
            gaps: VecDeque::new(),
            accounted_drops: 0,
            // Room for the frames that one read of the firmware can complete.
            codes: Vec::with_capacity(FIFO_LEVEL_CODES + waveform.shape().codes()),
            popped: 0,
        }
    }

    /// Notes that a chunk was discarded as damaged, which is the reason of the next missing frames.
    pub fn note_damage(&mut self) {
        self.damaged = true;
    }

    /// Notes that the stream has been restarted.
    pub fn restart(&mut self, reason: GapReason) {
        self.restart_reason = Some(reason);
        self.damaged = false;
        self.accounted_drops = 0;
    }

    /// Takes a chunk. All earlier events must have been popped. `elapsed` is the host's time since the previous chunk.
    pub fn push_chunk(&mut self, frame_number: u32, frame_count: usize, codes: &[[u8; 2]], elapsed: Duration) {
        let missing = match self.restart_reason.take() {
            Some(reason) => {
                // A chunk arrives when its last frame is complete.
                let intervals = elapsed.as_secs_f64() / self.waveform.frame_interval_s().max(1e-6);
                // At least the frame that was cut short is lost.
                let missing = (intervals.round() as u64).saturating_sub(frame_count as u64).max(1);
                Some((missing, reason))
            }
            None => {
                let ahead = frame_number.wrapping_sub(self.next_number);
                if ahead > u32::MAX / 2 {
                    tracing::debug!(frame_number, "frames came again, or late");
                    return;
                }
                let reason = if self.damaged { GapReason::Crc } else { GapReason::PacketLost };
                (ahead > 0).then_some((u64::from(ahead), reason))
            }
        };
        self.damaged = false;
        if let Some((frames, reason)) = missing {
            self.gaps.push_back(Gap { first_sequence: self.next_sequence, frames, reason });
            self.next_sequence += frames;
        }
        self.next_number = frame_number.wrapping_add(frame_count as u32);
        self.codes.clear();
        self.codes.extend(codes.iter().map(|code| u16::from_le_bytes(*code)));
        self.popped = 0;
    }

    /// Returns whether the numbers of the queued frames have jumped for an unknown reason.
    pub fn needs_reason(&self) -> bool {
        self.gaps.back().is_some_and(|gap| gap.reason == GapReason::PacketLost)
    }

    /// Sets the number of frames that the device has dropped since it was configured. Those frames were not lost on the
    /// line.
    pub fn set_dropped(&mut self, dropped: u64) {
        let dropped_by_device = dropped.saturating_sub(self.accounted_drops);
        let Some(gap) = self.gaps.back_mut().filter(|gap| gap.reason == GapReason::PacketLost && dropped_by_device > 0)
        else {
            return;
        };
        let frames = dropped_by_device.min(gap.frames);
        // Dropped frames beyond this gap belong to later gaps.
        self.accounted_drops += frames;
        let rest = Gap { first_sequence: gap.first_sequence + frames, frames: gap.frames - frames, ..*gap };
        *gap = Gap { frames, reason: GapReason::FifoOverflow, ..*gap };
        if rest.frames > 0 {
            self.gaps.push_back(rest);
        }
    }

    /// Pops the next frame or gap into `frame`, whose memory is reused.
    pub fn pop(&mut self, frame: &mut Frame) -> Option<SourceEvent> {
        if let Some(gap) = self.gaps.pop_front() {
            return Some(SourceEvent::Gap(gap));
        }
        let length = self.waveform.shape().codes();
        let codes = self.codes.get(self.popped * length..(self.popped + 1) * length)?;
        fifo::fill_frame(codes, &self.waveform, self.next_sequence, frame);
        self.popped += 1;
        self.next_sequence += 1;
        Some(SourceEvent::Frame)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pattern::waveform;

    fn resequencer() -> (Resequencer, Frame) {
        let waveform = waveform(&[1, 3], 2, 8, 0.1);
        let frame = Frame::zeroed(waveform.shape());
        (Resequencer::new(&waveform, 5), frame)
    }

    /// Codes of `frames` frames in FIFO order: the codes of the first receiver are even, those of the second odd.
    fn codes(frames: usize) -> Vec<[u8; 2]> {
        (0..frames * 32).map(|i| (i as u16).to_le_bytes()).collect()
    }

    fn gap(first_sequence: u64, frames: u64, reason: GapReason) -> Option<SourceEvent> {
        Some(SourceEvent::Gap(Gap { first_sequence, frames, reason }))
    }

    const NOW: Duration = Duration::ZERO;

    #[test]
    fn a_chunk_of_frames_comes_out_one_by_one_receiver_by_receiver() {
        let (mut resequencer, mut frame) = resequencer();
        resequencer.push_chunk(5, 3, &codes(3), NOW);
        for sequence in 0..3 {
            assert_eq!(resequencer.pop(&mut frame), Some(SourceEvent::Frame));
            assert_eq!((frame.sequence, frame.time_ns), (sequence, sequence * 100_000_000));
            let (first, second) = frame.codes.split_at(16);
            let start = sequence as u16 * 32;
            assert!(first.iter().zip((start..).step_by(2)).all(|(code, i)| *code == i));
            assert!(second.iter().zip((start + 1..).step_by(2)).all(|(code, i)| *code == i));
        }
        assert_eq!(resequencer.pop(&mut frame), None);
    }

    #[test]
    fn a_jump_of_the_number_is_a_gap_with_the_boards_reason() {
        let (mut resequencer, mut frame) = resequencer();
        resequencer.push_chunk(7, 1, &codes(1), NOW);
        assert!(resequencer.needs_reason());
        resequencer.set_dropped(0);
        assert_eq!(resequencer.pop(&mut frame), gap(0, 2, GapReason::PacketLost));
        assert_eq!(resequencer.pop(&mut frame), Some(SourceEvent::Frame));
        assert_eq!(frame.sequence, 2);
        resequencer.push_chunk(13, 1, &codes(1), NOW);
        // Five frames are missing, but the board has dropped six: the sixth belongs to a later gap.
        resequencer.set_dropped(6);
        assert_eq!(resequencer.pop(&mut frame), gap(3, 5, GapReason::FifoOverflow));
        assert_eq!(resequencer.pop(&mut frame), Some(SourceEvent::Frame));
        resequencer.push_chunk(17, 1, &codes(1), NOW);
        resequencer.set_dropped(6);
        assert_eq!(resequencer.pop(&mut frame), gap(9, 1, GapReason::FifoOverflow));
        assert_eq!(resequencer.pop(&mut frame), gap(10, 2, GapReason::PacketLost));
        assert!(!resequencer.needs_reason());
    }

    #[test]
    fn frames_that_come_again_or_late_are_ignored() {
        let (mut resequencer, mut frame) = resequencer();
        resequencer.push_chunk(5, 2, &codes(2), NOW);
        assert!(resequencer.pop(&mut frame).is_some() && resequencer.pop(&mut frame).is_some());
        resequencer.push_chunk(5, 2, &codes(2), NOW);
        resequencer.push_chunk(6, 1, &codes(1), NOW);
        assert_eq!(resequencer.pop(&mut frame), None);
        resequencer.push_chunk(7, 1, &codes(1), NOW);
        assert_eq!(resequencer.pop(&mut frame), Some(SourceEvent::Frame));
    }

    /// A chunk arrives when its last frame is complete. 1.2 s are twelve frame intervals: ten frames are missing if the
    /// new chunk holds two.
    #[test]
    fn after_a_restart_the_hosts_clock_gives_the_number_of_missing_frames() {
        let (mut resequencer, mut frame) = resequencer();
        resequencer.push_chunk(5, 1, &codes(1), NOW);
        assert_eq!(resequencer.pop(&mut frame), Some(SourceEvent::Frame));
        resequencer.restart(GapReason::Crc);
        resequencer.push_chunk(0, 2, &codes(2), Duration::from_millis(1210));
        assert!(!resequencer.needs_reason());
        assert_eq!(resequencer.pop(&mut frame), gap(1, 10, GapReason::Crc));
        assert_eq!(resequencer.pop(&mut frame), Some(SourceEvent::Frame));
        assert_eq!(frame.sequence, 11);
        // At least the frame that the restart cut short is missing.
        assert_eq!(resequencer.pop(&mut frame), Some(SourceEvent::Frame));
        resequencer.restart(GapReason::Disconnected);
        resequencer.push_chunk(0, 2, &codes(2), NOW);
        assert_eq!(resequencer.pop(&mut frame), gap(13, 1, GapReason::Disconnected));
    }
}
