//! A PSoC 6 kit with the DEEPCRAFT streaming firmware ([`crate::protocol::deepcraft`]), measuring whatever a [`FrameSource`]
//! provides.

mod requests;

use std::sync::atomic::Ordering;
use std::sync::{Arc, PoisonError};
use std::time::{Duration, Instant};

use radome_dsp::FrameSource;

use super::wire::{Before, Firmware, Wire};
use super::world::{Slice, World};
use super::{EmulatorError, EmulatorOptions, Shared};
use crate::protocol::deepcraft::{ChunkLayout, FIFO_LEVEL_CODES};
use requests::Requests;

/// The firmware stops after so long without a sign of its host, ms.
const WATCHDOG_TIMEOUT_MS: i32 = 3000;
/// Number of the radar among the board's devices, and of its stream.
const DEVICE: i32 = 0;
const STREAM: i32 = 0;

/// The firmware, and the frames that it has read from the chip.
///
/// It reads 6144 codes at a time and sends the frames that these complete as one chunk. Where the source has a gap, and at its
/// end, it sends what it has.
pub(super) struct Deepcraft {
    world: World,
    requests: Requests,
    starts: u64,
    stalled: bool,
    /// Number of the first frame in `codes`.
    number: u32,
    /// Frames that wait to be sent, in FIFO order.
    codes: Vec<u16>,
    frame_codes: usize,
    /// Codes that the chip has sampled since chunks were last even with reads, and frames sent since.
    sampled: usize,
    sent: usize,
    /// Time of the last frame before the FIFO overflowed, microseconds.
    overflowed: Option<Option<u64>>,
    last_frame_us: Option<u64>,
    interval_us: f64,
    shared: Arc<Shared>,
}

impl Deepcraft {
    pub fn new(
        source: Box<dyn FrameSource>,
        options: &EmulatorOptions,
        shared: Arc<Shared>,
    ) -> Result<Self, EmulatorError> {
        let waveform = source.waveform().clone();
        Ok(Deepcraft {
            requests: Requests::new(&waveform, &options.faults)?,
            world: World::new(source, options.pace).map_err(EmulatorError::Thread)?,
            starts: 0,
            stalled: false,
            number: 0,
            codes: Vec::new(),
            frame_codes: waveform.shape().codes(),
            sampled: 0,
            sent: 0,
            overflowed: None,
            last_frame_us: None,
            interval_us: waveform.frame_interval_s() * 1e6,
            shared,
        })
    }

    fn begin_anew(&mut self) {
        let (waveform, channels) = self.requests.measured();
        self.frame_codes = waveform.shape().codes();
        self.world.restart(&waveform, channels, None);
        self.codes.clear();
        (self.number, self.sampled, self.sent) = (0, 0, 0);
        (self.stalled, self.overflowed, self.last_frame_us) = (false, None, None);
    }

    /// Frames that reads of the FIFO have completed and that have not been sent.
    fn complete(&self) -> usize {
        let read = self.sampled / FIFO_LEVEL_CODES * FIFO_LEVEL_CODES;
        (read / self.frame_codes.max(1)).saturating_sub(self.sent)
    }

    fn skip(&mut self, frames: u32) {
        self.number = self.number.wrapping_add(frames);
        self.requests.dropped += frames as i32;
    }

    /// Sends so many of the frames that wait, as one chunk.
    fn send(&mut self, frames: usize, wire: &mut Wire) {
        if frames == 0 {
            return;
        }
        let (number, before) = wire.next_number();
        let codes = frames * self.frame_codes;
        for before in before {
            match before {
                Before::Overflow => {
                    self.shared.overflows.fetch_add(1, Ordering::Relaxed);
                    self.codes.drain(..codes);
                    self.sent += frames;
                    return self.skip(frames as u32);
                }
                Before::Stall => {
                    self.stalled = true;
                    return;
                }
                Before::Skip(by) => self.number = self.number.wrapping_add(u32::from(by)),
            }
        }
        let layout = ChunkLayout { device: DEVICE, stream: STREAM, frame_codes: self.frame_codes };
        wire.send_data(number, |out| layout.encode(self.number, self.codes.get(..codes).unwrap_or(&[]), out));
        self.codes.drain(..codes);
        self.number = self.number.wrapping_add(frames as u32);
        self.requests.current_frame = self.number;
        self.sent += frames;
        self.shared.slices.fetch_add(1, Ordering::Relaxed);
    }

    /// Sends all frames that wait.
    fn flush(&mut self, wire: &mut Wire) {
        self.send(self.codes.len() / self.frame_codes.max(1), wire);
        (self.sampled, self.sent) = (0, 0);
    }

    /// A frame that comes after an overflow: the clock tells how many are missing.
    fn count_overflown(&mut self, time_us: u64) {
        if let Some(Some(last_us)) = self.overflowed.take() {
            let intervals = (time_us.saturating_sub(last_us) as f64 / self.interval_us).round();
            self.skip((intervals as u32).saturating_sub(1));
        }
        self.last_frame_us = Some(time_us);
    }
}

impl Firmware for Deepcraft {
    fn receive(&mut self, bytes: &[u8], out: &mut Vec<u8>) {
        self.requests.receive(bytes, out);
        let mut refusal = self.shared.refusal.lock().unwrap_or_else(PoisonError::into_inner);
        refusal.clone_from(&self.requests.refusal);
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
            self.begin_anew();
        }
        if self.stalled {
            return false;
        }
        match self.world.slice(self.frame_codes as u64) {
            Slice::Ready { time_us } => {
                self.count_overflown(time_us);
                self.codes.extend_from_slice(self.world.codes(self.frame_codes));
                self.world.take(self.frame_codes);
                self.sampled += self.frame_codes;
                self.send(self.complete(), wire);
                true
            }
            Slice::Missing { frames } => {
                self.flush(wire);
                self.number = self.number.wrapping_add(frames as u32);
                true
            }
            Slice::Overflow => {
                self.shared.overflows.fetch_add(1, Ordering::Relaxed);
                self.flush(wire);
                let (waveform, channels) = self.requests.measured();
                self.world.restart(&waveform, channels, None);
                self.overflowed = Some(self.last_frame_us);
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
        self.world.advance();
    }

    fn power_up(&mut self) {
        self.requests.power_up();
    }
}

/// When the firmware gives its host up.
fn watchdog() -> Instant {
    Instant::now() + Duration::from_millis(WATCHDOG_TIMEOUT_MS as u64)
}
