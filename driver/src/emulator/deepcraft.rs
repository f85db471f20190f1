//! Emulated PSoC 6 kit with the DEEPCRAFT streaming firmware ([`crate::protocol::deepcraft`]), which measures the
//! frames of a [`Feed`].

mod requests;

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Instant;

use super::chip::Chip;
use super::sample_source::Slice;
use super::wire::{FaultAction, Firmware, Wire};
use super::{EmulatorError, EmulatorOptions, Feed, Shared};
use crate::protocol::deepcraft::{ChunkLayout, FIFO_LEVEL_CODES};
use requests::{DEVICE, Requests};

/// Id of the radar's stream.
const STREAM: i32 = 0;

/// State of the firmware, and the frames that it has read from the chip.
///
/// The firmware reads 6144 codes at a time. It sends all frames that a read completes as one chunk, although the
/// stream's `max_frame_count` says 1. The vendor's firmware 1.2 does the same (`dev_bgt60trxx.c`, where that 1 has the
/// comment "Max frame_count?" and the loop over the frames read has no limit). While the host takes no data, the
/// chip's FIFO goes on filling. At a gap and at the end of the source the firmware sends the frames that it has. The
/// real firmware does not check for an overflow of the FIFO, so that its behaviour then is unknown. This one counts the
/// frames as dropped and starts the chip again.
pub(super) struct Deepcraft {
    requests: Requests,
    /// Number of starts of the radar when `codes` was last emptied.
    starts: u64,
    stalled: bool,
    /// Number of the first frame in `codes`.
    number: u32,
    /// Number of the first frame since the chip's start, less the frames skipped since.
    first_number: u32,
    /// Codes that have been read and not sent, FIFO order.
    codes: Vec<u16>,
    frame_codes: usize,
    /// Codes read, and frames sent, since the last start or flush.
    read: usize,
    sent: usize,
    shared: Arc<Shared>,
}

impl Deepcraft {
    pub fn new(feed: Feed, options: &EmulatorOptions, shared: Arc<Shared>) -> Result<Self, EmulatorError> {
        let waveform = feed.source.waveform().clone();
        let chip = Chip::new(feed, options, &shared).map_err(EmulatorError::Thread)?;
        Ok(Deepcraft {
            requests: Requests::new(chip, &waveform, &options.faults, shared.clone())?,
            starts: 0,
            stalled: false,
            number: 0,
            first_number: 0,
            codes: Vec::new(),
            frame_codes: waveform.shape().codes().max(1),
            read: 0,
            sent: 0,
            shared,
        })
    }

    /// Resets the buffer and all numbers after a start of the radar.
    fn restart(&mut self) {
        self.frame_codes = self.requests.chip.running.as_ref().map_or(1, |w| w.shape().codes().max(1));
        self.codes.clear();
        (self.number, self.first_number, self.read, self.sent, self.stalled) = (0, 0, 0, 0, false);
    }

    /// Frames that reads of the FIFO have completed and that have not been sent.
    fn complete_frames(&self) -> usize {
        let read = self.read / FIFO_LEVEL_CODES * FIFO_LEVEL_CODES;
        (read / self.frame_codes).saturating_sub(self.sent)
    }

    /// Counts frames as dropped by the device: they will not be sent.
    fn drop_frames(&mut self, frames: u32) {
        self.number = self.number.wrapping_add(frames);
        self.requests.dropped = self.requests.dropped.wrapping_add(frames as i32);
    }

    /// Skips frames that the source lacks, or that a fault pretends were sent.
    fn skip(&mut self, frames: u32) {
        self.number = self.number.wrapping_add(frames);
        self.first_number = self.first_number.wrapping_add(frames);
    }

    /// Sends `frames` of the buffered frames as one chunk.
    fn send(&mut self, frames: usize, wire: &mut Wire) {
        if frames == 0 {
            return;
        }
        let (number, actions) = wire.next_number();
        let codes = frames * self.frame_codes;
        self.sent += frames;
        for action in actions {
            match action {
                FaultAction::Overflow => {
                    self.shared.overflows.fetch_add(1, Ordering::Relaxed);
                    self.codes.drain(..codes);
                    return self.drop_frames(frames as u32);
                }
                FaultAction::Stall => {
                    self.stalled = true;
                    return;
                }
                FaultAction::Skip(by) => self.skip(u32::from(by)),
            }
        }
        let layout = ChunkLayout { device: DEVICE, stream: STREAM, frame_codes: self.frame_codes };
        wire.send_data(number, |out| layout.encode(self.number, self.codes.get(..codes).unwrap_or(&[]), out));
        self.codes.drain(..codes);
        self.number = self.number.wrapping_add(frames as u32);
        self.requests.current_frame = self.number;
        self.shared.frames.fetch_add(frames as u64, Ordering::Relaxed);
    }

    /// Sends all whole buffered frames.
    fn flush(&mut self, wire: &mut Wire) {
        self.send(self.codes.len() / self.frame_codes, wire);
        (self.read, self.sent) = (0, 0);
    }

    /// Starts the chip again after an overflow of its FIFO. The chip's frame counter gives the number of lost frames.
    fn overflow(&mut self, wire: &mut Wire) {
        self.shared.overflows.fetch_add(1, Ordering::Relaxed);
        self.flush(wire);
        self.codes.clear();
        let begun = self.requests.chip.frames_begun();
        self.drop_frames(begun.wrapping_sub(self.number.wrapping_sub(self.first_number)) % 4096);
        self.first_number = self.number;
        self.requests.start_chip();
    }
}

impl Firmware for Deepcraft {
    fn receive(&mut self, bytes: &[u8], out: &mut Vec<u8>) {
        self.requests.receive(bytes, out);
    }

    fn next_message(&mut self, wire: &mut Wire) -> bool {
        let Some(until) = self.requests.active_until else { return false };
        if Instant::now() >= until {
            tracing::warn!("the emulated board stops: its watchdog has not been reset");
            self.requests.stop();
            return false;
        }
        if self.starts != self.requests.starts {
            self.starts = self.requests.starts;
            self.restart();
        }
        if self.stalled {
            return false;
        }
        if self.requests.chip.fifo_failed() {
            self.overflow(wire);
            return true;
        }
        // Reads end where frames do, so that a gap of the source comes between two reads.
        let codes = (self.frame_codes - self.codes.len() % self.frame_codes).min(FIFO_LEVEL_CODES);
        match self.requests.chip.poll(codes as u64) {
            Slice::Ready { .. } => {
                self.requests.chip.read_fifo(codes, &mut self.codes);
                self.read += codes;
                self.send(self.complete_frames(), wire);
                true
            }
            Slice::Missing { frames } => {
                self.flush(wire);
                self.skip(frames as u32);
                true
            }
            Slice::Wait => false,
            Slice::End => {
                self.flush(wire);
                self.shared.finished.store(true, Ordering::Release);
                false
            }
        }
    }

    fn advance(&mut self) {
        self.requests.chip.source.advance();
        self.requests.chip.check_overflow();
    }

    fn power_up(&mut self) {
        self.requests.power_up();
    }

    fn client_left(&mut self) {
        self.requests.client_left();
    }
}
