//! An ESP32 that prints whatever frames a [`FrameSource`] provides ([`crate::protocol::ascii`]).

use std::sync::Arc;
use std::sync::atomic::Ordering;

use radome_dsp::{FrameSource, Waveform};

use super::wire::{Before, Firmware, Wire};
use super::world::{Slice, World};
use super::{EmulatorOptions, Shared};
use crate::protocol::ascii;

const BANNER: &[u8] = b"I (312) main: radar started\r\n";

/// Firmware that measures and prints from the moment it has power. It takes no requests.
pub(super) struct Esp32 {
    world: World,
    waveform: Waveform,
    channels: Vec<usize>,
    /// Whether the banner has been printed since the board has power.
    is_up: bool,
    /// Number of the next frame.
    number: u64,
    stalled: bool,
    shared: Arc<Shared>,
}

impl Esp32 {
    pub fn new(source: Box<dyn FrameSource>, options: &EmulatorOptions, shared: Arc<Shared>) -> std::io::Result<Self> {
        let waveform = source.waveform().clone();
        Ok(Esp32 {
            world: World::new(source, options.pace)?,
            channels: (0..waveform.shape().rx).collect(),
            waveform,
            is_up: false,
            number: 0,
            stalled: false,
            shared,
        })
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
            wire.send(|out| out.extend_from_slice(BANNER));
        }
        let codes = self.waveform.shape().codes();
        match self.world.slice(codes as u64) {
            Slice::Ready { .. } => {}
            Slice::Missing { frames } => {
                self.number += frames;
                return true;
            }
            Slice::Overflow => {
                // The firmware counts the frames that it reads; those that its FIFO lost it never knew.
                self.shared.overflows.fetch_add(1, Ordering::Relaxed);
                self.world.restart(&self.waveform, self.channels.clone(), None);
                return true;
            }
            Slice::Wait => return false,
            Slice::End => {
                self.shared.finished.store(true, Ordering::Release);
                return false;
            }
        }
        let (number, before) = wire.next_number();
        for before in before {
            match before {
                Before::Overflow => {
                    self.shared.overflows.fetch_add(1, Ordering::Relaxed);
                    self.world.take(codes);
                    return true;
                }
                Before::Stall => {
                    self.stalled = true;
                    return false;
                }
                Before::Skip(by) => self.number += u64::from(by),
            }
        }
        wire.send_data(number, |out| ascii::encode(self.number, self.world.codes(codes), out));
        self.world.take(codes);
        self.number += 1;
        self.shared.slices.fetch_add(1, Ordering::Relaxed);
        true
    }

    fn advance(&mut self) {
        self.world.advance();
    }

    fn power_up(&mut self) {
        (self.is_up, self.number, self.stalled) = (false, 0, false);
        self.world.restart(&self.waveform, self.channels.clone(), None);
    }
}
