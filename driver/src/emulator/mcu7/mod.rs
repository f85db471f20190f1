//! The Radar Baseboard MCU7: what its chip measures, sliced and sent as its firmware does.

mod firmware;

use std::sync::atomic::Ordering;
use std::sync::{Arc, PoisonError};

use radome_dsp::{FrameSource, Waveform};

use super::wire::{Before, Firmware, Wire};
use super::world::{Slice, World};
use super::{EmulatorOptions, Shared};
use crate::protocol::packed12;
use crate::protocol::strata::{DataError, HostParser, MAX_PACKET_PAYLOAD, Packet, PacketFlags, Protocol, SliceLayout};
use firmware::Requests;

/// A slice on its way.
struct Sending {
    layout: SliceLayout,
    bytes: Vec<u8>,
    next: usize,
}

pub(super) struct Mcu7 {
    /// World time at which the board's clock began again after it was unplugged; `Some(None)` until the next slice.
    powered_up_us: Option<Option<u64>>,
    world: World,
    requests: Requests,
    source: Waveform,
    parser: HostParser,
    sending: Option<Sending>,
    counter: u16,
    starts: u64,
    shared: Arc<Shared>,
}

impl Mcu7 {
    pub fn new(
        source: Box<dyn FrameSource>,
        protocol: Protocol,
        options: &EmulatorOptions,
        shared: Arc<Shared>,
    ) -> std::io::Result<Self> {
        let waveform = source.waveform().clone();
        Ok(Mcu7 {
            powered_up_us: None,
            world: World::new(source, options.pace)?,
            requests: Requests::new(&waveform, protocol, &options.faults),
            source: waveform,
            parser: HostParser::new(protocol),
            sending: None,
            counter: 0,
            starts: 0,
            shared,
        })
    }

    /// The firmware reports that the chip's FIFO has overflowed, and stops.
    fn overflow(&mut self, wire: &mut Wire) {
        self.shared.overflows.fetch_add(1, Ordering::Relaxed);
        self.sending = None;
        self.requests.stop_by_itself();
        let flags = PacketFlags { first: true, last: true, timestamp: false, error: true };
        let payload = &DataError::FifoOverflow.code().to_le_bytes();
        wire.send(|out| Packet { flags, channel: 0, counter: self.counter, payload }.encode(out));
    }

    fn send_packet(&mut self, wire: &mut Wire) {
        let (number, before) = wire.next_number();
        for before in before {
            match before {
                Before::Overflow => return self.overflow(wire),
                Before::Stall => {
                    self.sending = None;
                    self.requests.stop_by_itself();
                }
                Before::Skip(by) => self.counter = self.counter.wrapping_add(by),
            }
        }
        let Some(sending) = &mut self.sending else { return };
        let index = sending.next;
        let start = index * MAX_PACKET_PAYLOAD;
        let last = index + 1 == sending.layout.packets();
        let end = start + sending.layout.payload_length(index);
        let payload = sending.bytes.get(start..end).unwrap_or(&[]);
        let flags = PacketFlags { first: index == 0, last, timestamp: last, error: false };
        wire.send_data(number, |out| Packet { flags, channel: 0, counter: self.counter, payload }.encode(out));
        self.counter = self.counter.wrapping_add(1);
        sending.next += 1;
        if last {
            self.sending = None;
        }
    }

    fn begin_anew(&mut self, waveform: &Waveform) {
        (self.counter, self.sending) = (0, None);
        let antennas = self.source.request.rx_antennas.antennas();
        let wanted = waveform.request.rx_antennas.antennas();
        let channels = wanted.iter().filter_map(|a| antennas.iter().position(|b| a == b)).collect();
        let test_pattern = wanted.iter().position(|a| *a == 1).filter(|_| self.requests.test_pattern());
        self.world.restart(waveform, channels, test_pattern);
    }
}

impl Firmware for Mcu7 {
    fn receive(&mut self, bytes: &[u8], out: &mut Vec<u8>) {
        self.parser.push(bytes);
        while let Some(event) = self.parser.next_event() {
            self.requests.handle(&event, out);
            let mut refusal = self.shared.refusal.lock().unwrap_or_else(PoisonError::into_inner);
            refusal.clone_from(&self.requests.refusal);
        }
    }

    fn next_message(&mut self, wire: &mut Wire) -> bool {
        let Some((layout, waveform)) = self.requests.streaming() else {
            self.sending = None;
            return false;
        };
        let codes_per_frame = waveform.shape().codes() as u64;
        if self.starts != self.requests.starts {
            self.starts = self.requests.starts;
            let waveform = waveform.clone();
            self.begin_anew(&waveform);
        }
        if self.sending.is_none() {
            match self.world.slice(layout.samples as u64) {
                Slice::Ready { time_us } => {
                    let mut bytes = Vec::with_capacity(layout.data_bytes() + 8);
                    packed12::pack(self.world.codes(layout.samples), &mut bytes);
                    let clock_began_us = match &mut self.powered_up_us {
                        Some(began) => *began.get_or_insert(time_us),
                        None => 0,
                    };
                    bytes.extend(time_us.saturating_sub(clock_began_us).to_le_bytes());
                    self.world.take(layout.samples);
                    self.sending = Some(Sending { layout, bytes, next: 0 });
                    self.shared.slices.fetch_add(1, Ordering::Relaxed);
                }
                Slice::Missing { frames } => {
                    // As if the packets had been lost; a gap that the counter cannot express stays untold.
                    let codes = frames * codes_per_frame;
                    let samples = layout.samples as u64;
                    let packets = codes / samples * layout.packets() as u64;
                    if codes.is_multiple_of(samples) && self.world.at_frame_boundary() && packets < 0x8000 {
                        self.counter = self.counter.wrapping_add(packets as u16);
                    }
                    return true;
                }
                Slice::Wait => return false,
                Slice::Overflow => {
                    self.overflow(wire);
                    return true;
                }
                Slice::End => {
                    self.shared.finished.store(true, Ordering::Release);
                    return false;
                }
            }
        }
        self.send_packet(wire);
        true
    }

    fn advance(&mut self) {
        self.world.advance();
    }

    fn power_up(&mut self) {
        self.requests.power_up();
        self.parser = HostParser::new(self.parser.protocol());
        self.sending = None;
        self.powered_up_us = Some(None);
    }
}
