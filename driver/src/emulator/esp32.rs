//! Emulated ESP32 that prints the frames of its chip ([`crate::protocol::ascii`]).
//!
//! The circuit for flashing resets such boards when their port is opened; the emulated board resets too.

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use radome_dsp::WaveformRequest;

use super::chip::Chip;
use super::sample_source::Slice;
use super::wire::{FaultAction, Firmware, Wire};
use super::{EmulatorOptions, Feed, Shared};
use crate::chip::{ChipConfiguration, RegisterList};
use crate::protocol::ascii;
use crate::protocol::mcu7::SliceLayout;

const BANNER: &[u8] = b"I (312) main: radar started\r\n";
/// Frames that the board's memory holds.
const BUFFER_FRAMES: usize = 2;
const FRAMES_BETWEEN_WAVEFORMS: u64 = 16;

/// Firmware that measures and prints as soon as it has power. It takes no requests.
pub(super) struct Esp32 {
    chip: Chip,
    /// Waveform that the firmware was built for.
    request: WaveformRequest,
    registers: RegisterList,
    slice: SliceLayout,
    codes_per_frame: usize,
    /// Codes of the frame that is being read from the chip, FIFO order.
    codes: Vec<u16>,
    /// Frames to be printed, with their numbers.
    frames: VecDeque<(u64, Vec<u16>)>,
    is_up: bool,
    /// Number of the next frame to be read.
    number: u64,
    /// Number of the first frame since the chip's start, less the frames that the source lacked since.
    first_number: u64,
    stalled: bool,
    shared: Arc<Shared>,
}

impl Esp32 {
    pub fn new(feed: Feed, options: &EmulatorOptions, shared: Arc<Shared>) -> std::io::Result<Self> {
        let waveform = feed.source.waveform().clone();
        let codes_per_frame = waveform.shape().codes();
        let slice = SliceLayout::for_frame(codes_per_frame);
        let request = waveform.request.clone();
        let configuration = ChipConfiguration { waveform, slice_samples: slice.samples };
        let registers = configuration.compile().map_err(std::io::Error::other)?;
        Ok(Esp32 {
            chip: Chip::new(feed, options, &shared)?,
            request,
            registers,
            slice,
            codes_per_frame,
            codes: Vec::new(),
            frames: VecDeque::new(),
            is_up: false,
            number: 0,
            first_number: 0,
            stalled: false,
            shared,
        })
    }

    /// Resets the chip and starts frames. The content of its FIFO is lost; the chip's frame counter gives the
    /// number of lost frames, so that later frames keep their numbers.
    fn start(&mut self) {
        self.chip.source.stop();
        let begun = u64::from(self.chip.frames_begun());
        self.number += begun.wrapping_sub(self.number - self.first_number) % 4096;
        self.first_number = self.number;
        self.codes.clear();
        self.chip.reset();
        for register in &self.registers {
            self.chip.transfer((*register).into());
        }
    }

    /// Reads the chip's FIFO at each interrupt, as long as there is room for another frame.
    fn read_fifo(&mut self) {
        let frames = if self.chip.source.waits_for_reader() { 1 } else { BUFFER_FRAMES };
        while self.frames.len() < frames && !self.chip.fifo_failed() {
            match self.chip.poll(self.slice.samples as u64) {
                Slice::Ready { .. } => {
                    self.chip.read_fifo(self.slice.samples, &mut self.codes);
                    self.split_frames();
                }
                Slice::Missing { frames } => {
                    self.number += frames;
                    self.first_number += frames;
                }
                Slice::Wait => return,
                Slice::End => {
                    if self.frames.is_empty() {
                        self.shared.finished.store(true, Ordering::Release);
                    }
                    return;
                }
            }
        }
        self.chip.check_overflow();
    }

    /// Skips numbers as if the firmware had lost frames.
    fn skip(&mut self, frames: u64) {
        self.frames.iter_mut().for_each(|(number, _)| *number += frames);
        self.number += frames;
        self.first_number += frames;
    }

    /// Moves whole frames from `codes` to `frames`.
    fn split_frames(&mut self) {
        while self.codes.len() >= self.codes_per_frame {
            let rest = self.codes.split_off(self.codes_per_frame);
            self.frames.push_back((self.number, std::mem::replace(&mut self.codes, rest)));
            self.number += 1;
        }
    }
}

impl Firmware for Esp32 {
    fn receive(&mut self, _: &[u8], _: &mut Vec<u8>) {}

    fn next_message(&mut self, wire: &mut Wire) -> bool {
        if self.stalled {
            return false;
        }
        if !self.is_up {
            self.is_up = true;
            self.start();
            wire.send(|out| {
                out.extend_from_slice(BANNER);
                ascii::encode_waveform(&self.request, out);
            });
            return true;
        }
        self.read_fifo();
        if self.chip.fifo_failed() {
            self.shared.overflows.fetch_add(1, Ordering::Relaxed);
            self.start();
            return true;
        }
        if self.frames.is_empty() {
            return false;
        }
        let (packet, actions) = wire.next_number();
        for action in actions {
            match action {
                FaultAction::Overflow => {
                    self.chip.overflow();
                    return true;
                }
                FaultAction::Stall => {
                    self.stalled = true;
                    return false;
                }
                FaultAction::Skip(by) => self.skip(u64::from(by)),
            }
        }
        if let Some((number, codes)) = self.frames.pop_front() {
            wire.send_data(packet, |out| ascii::encode(number, &codes, out));
            if number % FRAMES_BETWEEN_WAVEFORMS == FRAMES_BETWEEN_WAVEFORMS - 1 {
                wire.send(|out| ascii::encode_waveform(&self.request, out));
            }
            self.shared.frames.fetch_add(1, Ordering::Relaxed);
        }
        true
    }

    fn advance(&mut self) {
        self.chip.source.advance();
        if self.is_up && !self.stalled {
            self.read_fifo();
        }
    }

    fn restarts_when_opened(&self) -> bool {
        true
    }

    /// Does nothing, because the firmware restarts with the next client.
    fn client_left(&mut self) {}

    fn power_up(&mut self) {
        (self.is_up, self.stalled) = (false, false);
        (self.number, self.first_number) = (0, 0);
        self.chip.reset();
        self.codes.clear();
        self.frames.clear();
    }
}
