//! Emulated Radar Baseboard MCU7: samples of its chip, cut into slices and sent as by its firmware.

mod control;
mod firmware;

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use super::chip::Chip;
use super::sample_source::Slice;
use super::wire::{FaultAction, Firmware, Wire};
use super::{EmulatorOptions, Feed, Shared};
use crate::protocol::mcu7::{DataError, Framing, HostParser, Packet, PacketFlags, Protocol, SliceLayout};
use crate::protocol::packed12;
use crate::transport::usb::Setup;
use control::ControlEndpoint;
use firmware::Requests;

/// Bytes of slices that the board's memory holds (192 KiB).
const BUFFER_BYTES: usize = 192 * 1024;

/// Data that the board has read from its chip and not yet sent.
enum Buffered {
    Slice(Vec<u8>),
    /// Number of packets that count as lost.
    LostPackets(u16),
}

pub(super) struct Mcu7 {
    /// Source time at which the board's clock started again after it was unplugged; `Some(None)` until the next slice.
    powered_up_us: Option<Option<u64>>,
    requests: Requests,
    framing: Framing,
    parser: HostParser,
    control: ControlEndpoint,
    buffer: VecDeque<Buffered>,
    buffered_bytes: usize,
    /// Index of the next packet of the first slice in the buffer.
    next_packet: usize,
    counter: u16,
    /// Starts of frames and of data when the buffer was begun.
    starts: (u64, u64),
    /// Codes of slices sent since the buffer was begun.
    sent: u64,
    codes: Vec<u16>,
    shared: Arc<Shared>,
}

impl Mcu7 {
    pub fn new(
        feed: Feed,
        protocol: Protocol,
        framing: Framing,
        options: &EmulatorOptions,
        shared: Arc<Shared>,
    ) -> std::io::Result<Self> {
        let chip = Chip::new(feed, options, &shared)?;
        Ok(Mcu7 {
            powered_up_us: None,
            requests: Requests::new(chip, protocol, framing, &options.faults, shared.clone()),
            framing,
            parser: HostParser::new(protocol),
            control: ControlEndpoint::default(),
            buffer: VecDeque::new(),
            buffered_bytes: 0,
            next_packet: 0,
            counter: 0,
            starts: (0, 0),
            sent: 0,
            codes: Vec::new(),
            shared,
        })
    }

    /// Empties the buffer.
    fn clear(&mut self) {
        self.buffer.clear();
        (self.buffered_bytes, self.next_packet) = (0, 0);
    }

    fn has_room(&mut self, slice: SliceLayout) -> bool {
        let source = &self.requests.chip.source;
        match source.waits_for_reader() {
            // Reading ahead gains nothing.
            true => self.buffer.is_empty(),
            false => self.buffered_bytes + slice.data_bytes() <= (BUFFER_BYTES as f64 * source.speed()) as usize,
        }
    }

    /// Reads the chip's FIFO at each interrupt, as long as there is room; returns the slice while data run. Without
    /// room the FIFO goes on filling.
    fn read_fifo(&mut self) -> Option<SliceLayout> {
        let Some(slice) = self.requests.streaming() else {
            self.clear();
            return None;
        };
        let starts = (self.requests.chip.starts, self.requests.starts);
        if self.starts != starts {
            self.starts = starts;
            self.clear();
            (self.counter, self.sent) = (0, 0);
        }
        while self.has_room(slice) && !self.requests.chip.fifo_failed() {
            match self.requests.chip.poll(slice.samples as u64) {
                Slice::Ready { time_us } => self.read_slice(slice, time_us),
                Slice::Missing { frames } => self.skip(slice, frames),
                Slice::Wait => break,
                Slice::End => {
                    if self.buffer.is_empty() {
                        self.shared.finished.store(true, Ordering::Release);
                    }
                    break;
                }
            }
        }
        if !self.has_room(slice) {
            self.requests.chip.check_overflow();
        }
        Some(slice)
    }

    fn read_slice(&mut self, slice: SliceLayout, time_us: u64) {
        self.codes.clear();
        self.requests.chip.read_fifo(slice.samples, &mut self.codes);
        let mut bytes = Vec::with_capacity(slice.data_bytes() + 8);
        packed12::pack(&self.codes, &mut bytes);
        let clock_start_us = match &mut self.powered_up_us {
            Some(start) => *start.get_or_insert(time_us),
            None => 0,
        };
        bytes.extend(time_us.saturating_sub(clock_start_us).to_le_bytes());
        self.buffered_bytes += slice.data_bytes();
        self.buffer.push_back(Buffered::Slice(bytes));
    }

    /// Counts frames that the source lacks as lost packets; the counter cannot express every gap.
    fn skip(&mut self, slice: SliceLayout, frames: u64) {
        let codes = frames * self.requests.chip.running.as_ref().map_or(0, |w| w.shape().codes() as u64);
        let samples = slice.samples as u64;
        let packets = codes / samples * slice.packets() as u64;
        if codes.is_multiple_of(samples) && self.requests.chip.source.at_frame_boundary() && packets < 0x8000 {
            self.buffer.push_back(Buffered::LostPackets(packets as u16));
        }
    }

    /// Reports an overflow of the chip's FIFO and stops, as the firmware does at the start of a burst.
    fn overflow(&mut self, wire: &mut Wire) {
        self.shared.overflows.fetch_add(1, Ordering::Relaxed);
        self.clear();
        self.requests.stop_data();
        let flags = PacketFlags { first: true, last: true, timestamp: false, error: true };
        let payload = &DataError::FifoOverflow.code().to_le_bytes();
        let packet = Packet { flags, channel: 0, counter: self.counter, payload };
        wire.send(|out| packet.encode_as(self.framing, out));
    }

    /// Counts the frames that a sent slice completes.
    fn count_frames(&mut self, slice: SliceLayout) {
        let per_frame =
            self.requests.chip.running.as_ref().map_or(1, |waveform| waveform.shape().codes().max(1)) as u64;
        let before = self.sent / per_frame;
        self.sent += slice.samples as u64;
        self.shared.frames.fetch_add(self.sent / per_frame - before, Ordering::Relaxed);
    }

    /// Sends the next packet of the first slice in the buffer.
    fn send_packet(&mut self, slice: SliceLayout, wire: &mut Wire) {
        let (number, actions) = wire.next_number();
        if self.counter == 0 {
            wire.discard_reordered();
        }
        for action in actions {
            match action {
                FaultAction::Overflow => {
                    self.requests.chip.overflow();
                    return self.overflow(wire);
                }
                FaultAction::Stall => {
                    self.clear();
                    self.requests.stop_data();
                }
                FaultAction::Skip(by) => self.counter = self.counter.wrapping_add(by),
            }
        }
        let Some(Buffered::Slice(bytes)) = self.buffer.front() else { return };
        let index = self.next_packet;
        let start = index * self.framing.max_packet_payload();
        let is_last = index + 1 == slice.packets();
        let payload = bytes.get(start..start + slice.payload_length(index)).unwrap_or(&[]);
        let flags = PacketFlags { first: index == 0, last: is_last, timestamp: is_last, error: false };
        let packet = Packet { flags, channel: 0, counter: self.counter, payload };
        wire.send_data(number, |out| packet.encode_as(self.framing, out));
        self.counter = self.counter.wrapping_add(1);
        self.next_packet += 1;
        if is_last {
            self.buffer.pop_front();
            self.buffered_bytes -= slice.data_bytes();
            self.next_packet = 0;
            self.count_frames(slice);
        }
    }
}

impl Firmware for Mcu7 {
    fn receive(&mut self, bytes: &[u8], out: &mut Vec<u8>) {
        self.parser.push(bytes);
        while let Some(event) = self.parser.next_event() {
            self.requests.handle(&event, out);
        }
    }

    fn control(&mut self, setup: &Setup, data: &[u8]) -> Option<Vec<u8>> {
        self.control.transfer(setup, data, &mut self.requests)
    }

    fn next_message(&mut self, wire: &mut Wire) -> bool {
        let Some(slice) = self.read_fifo() else { return false };
        if self.requests.chip.fifo_failed() {
            self.overflow(wire);
            return true;
        }
        match self.buffer.front() {
            None => false,
            Some(Buffered::LostPackets(packets)) => {
                self.counter = self.counter.wrapping_add(*packets);
                self.buffer.pop_front();
                true
            }
            Some(Buffered::Slice(_)) => {
                self.send_packet(slice, wire);
                true
            }
        }
    }

    fn advance(&mut self) {
        self.requests.chip.source.advance();
        self.read_fifo();
    }

    fn power_up(&mut self) {
        self.requests.power_up();
        self.parser = HostParser::new(self.parser.protocol());
        self.control = ControlEndpoint::default();
        self.clear();
        self.powered_up_us = Some(None);
    }

    fn client_left(&mut self) {
        self.requests.client_left();
        self.parser = HostParser::new(self.parser.protocol());
        self.control = ControlEndpoint::default();
        self.clear();
    }

    fn is_within_data(&self) -> bool {
        self.next_packet > 0
    }
}
