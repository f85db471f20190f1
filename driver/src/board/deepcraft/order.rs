//! From chunks to frames and gaps in order. Pure: chunks and the host's clock in, frames and gaps out.

use std::collections::VecDeque;
use std::time::Duration;

use radome_dsp::{Frame, Gap, GapReason, SourceEvent, Waveform};

use crate::protocol::fifo;

pub(super) struct Order {
    waveform: Waveform,
    /// Frames handed out or given up, and those that wait.
    next_sequence: u64,
    /// Number of the frame with that sequence number, modulo 2^32.
    next_number: u32,
    /// The stream has begun anew: how many frames were lost only the host's clock knows.
    restarted: Option<GapReason>,
    damaged: bool,
    /// Gaps that come before the frames that wait.
    gaps: VecDeque<Gap>,
    /// Frames that the device has dropped since it was set, as far as gaps have been put down to that.
    dropped: u64,
    /// Codes of the frames that wait, each in FIFO order, and how many of them have gone.
    codes: Vec<u16>,
    gone: usize,
}

impl Order {
    /// A stream whose first frame has this number.
    pub fn new(waveform: &Waveform, next_number: u32) -> Self {
        Order {
            waveform: waveform.clone(),
            next_sequence: 0,
            next_number,
            restarted: None,
            damaged: false,
            gaps: VecDeque::new(),
            dropped: 0,
            codes: Vec::new(),
            gone: 0,
        }
    }

    /// A chunk was passed over: frames missing now are missing for that reason.
    pub fn damaged(&mut self) {
        self.damaged = true;
    }

    /// The stream begins anew.
    pub fn restart(&mut self, reason: GapReason) {
        self.restarted = Some(reason);
        self.damaged = false;
        self.dropped = 0;
    }

    /// Takes a chunk when all before it has been popped. `elapsed` is the host's time since the chunk before.
    pub fn take(&mut self, frame_number: u32, frame_count: usize, codes: &[[u8; 2]], elapsed: Duration) {
        let missing = match self.restarted.take() {
            Some(reason) => {
                // Both chunks came when their last frames were complete.
                let intervals = elapsed.as_secs_f64() / self.waveform.frame_interval_s().max(1e-6);
                // What was cut short is lost at least.
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
        self.gone = 0;
    }

    /// Whether the numbers of the frames that wait have jumped, and nothing else says why.
    pub fn wants_to_know(&self) -> bool {
        self.gaps.back().is_some_and(|gap| gap.reason == GapReason::PacketLost)
    }

    /// The device says how many frames it has dropped since it was set: they were not lost on the line.
    pub fn explain(&mut self, dropped: u64) {
        let by_device = dropped.saturating_sub(self.dropped);
        let Some(gap) = self.gaps.back_mut().filter(|gap| gap.reason == GapReason::PacketLost && by_device > 0) else {
            return;
        };
        let frames = by_device.min(gap.frames);
        // Those beyond it are missing later on the line.
        self.dropped += frames;
        let rest = Gap { first_sequence: gap.first_sequence + frames, frames: gap.frames - frames, ..*gap };
        *gap = Gap { frames, reason: GapReason::FifoOverflow, ..*gap };
        if rest.frames > 0 {
            self.gaps.push_back(rest);
        }
    }

    /// The next frame or gap. The frame's memory is used again.
    pub fn pop(&mut self, frame: &mut Frame) -> Option<SourceEvent> {
        if let Some(gap) = self.gaps.pop_front() {
            return Some(SourceEvent::Gap(gap));
        }
        let shape = self.waveform.shape();
        let start = self.gone * shape.codes();
        let codes = self.codes.get(start..start + shape.codes())?;
        frame.shape = shape;
        frame.codes.resize(shape.codes(), 0);
        fifo::deinterleave(codes, shape, &mut frame.codes);
        frame.sequence = self.next_sequence;
        // Chunks carry no time: frames come at their interval.
        frame.time_ns = (self.next_sequence as f64 * self.waveform.frame_interval_s() * 1e9).round() as u64;
        (frame.truth, frame.temperature_millicelsius) = (None, None);
        self.gone += 1;
        self.next_sequence += 1;
        Some(SourceEvent::Frame)
    }
}
