//! A Radar Baseboard MCU7 on a pseudo-terminal, measuring whatever a [`FrameSource`] provides.
//!
//! It answers what the firmware answers and sends what it sends, so that any client of the board can be pointed at
//! [`EmulatedBoard::path`]. Differences: a waveform other than the source's is refused, and so is a slice that would
//! trip a known firmware bug. Frames that the source itself lacks appear as packets lost. How much the board buffers
//! beyond the chip's FIFO is assumed from its memory (192 KiB).
//!
//! [`EmulatedLines`] is the same for a board that prints its frames.

mod firmware;
mod lines;
mod pty;
mod script;
mod source;
mod world;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use radome_dsp::{FrameSource, Waveform};
use thiserror::Error;

use crate::board::CHIP_ID_BGT60TR13C;
use crate::protocol::packed12;
use crate::protocol::strata::{DataError, HostParser, MAX_PACKET_PAYLOAD, Packet, PacketFlags, Protocol, SliceLayout};
use firmware::Firmware;
pub use lines::EmulatedLines;
use pty::Pty;
pub use script::FaultError;
pub use source::{EmulatedSource, EmulatedSourceError};
use world::{Slice, World};

/// How fast the emulated world goes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Pace {
    /// By the source's time stamps, this many times as fast as they say.
    RealTime(f64),
    /// As fast as the host reads: the pseudo-terminal's back-pressure sets the pace, nothing overflows.
    AsFastAsRead,
}

/// Something to go wrong on the wire. Packets are counted from 0 since the emulator was started.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fault {
    /// The packet is not sent.
    DropPacket(u64),
    /// The packet is sent twice.
    DoublePacket(u64),
    /// One bit of the packet is inverted, counted from its first byte's lowest bit, modulo its length.
    FlipBit {
        /// Which packet.
        packet: u64,
        /// Which bit.
        bit: usize,
    },
    /// Only the packet's first bytes are sent.
    TruncatePacket {
        /// Which packet.
        packet: u64,
        /// How many bytes.
        bytes: usize,
    },
    /// The packet is sent after its successor.
    ReorderPacket(u64),
    /// The firmware's counter jumps before this packet, as if others had been sent.
    SkipCounter {
        /// Which packet.
        packet: u64,
        /// By how much.
        by: u16,
    },
    /// The chip's FIFO overflows instead of this packet being sent.
    Overflow(u64),
    /// Nothing more is sent from this packet on until the host starts the board anew. Requests are answered.
    Stall(u64),
    /// The board is unplugged instead of this packet being sent, and so loses its power. It comes back after a while,
    /// at [`EmulatorOptions::link`].
    Unplug {
        /// Which packet.
        packet: u64,
        /// For how long.
        duration: Duration,
    },
}

/// How the emulated board behaves.
#[derive(Debug, Clone)]
pub struct EmulatorOptions {
    /// How fast its world goes.
    pub pace: Pace,
    /// What goes wrong.
    pub faults: Vec<Fault>,
    /// What the chip's CHIP_ID register reads.
    pub chip_id: u32,
    /// Major version of the protocol that the firmware reports. It speaks version 3 if that is 3, otherwise version 4.
    pub protocol_version: u16,
    /// Symbolic link to the pseudo-terminal, to be made anew each time the board is plugged in: the terminal itself has
    /// another name then.
    pub link: Option<PathBuf>,
}

impl Default for EmulatorOptions {
    fn default() -> Self {
        EmulatorOptions {
            pace: Pace::RealTime(1.0),
            faults: Vec::new(),
            chip_id: CHIP_ID_BGT60TR13C,
            protocol_version: Protocol::default().major(),
            link: None,
        }
    }
}

/// The emulated board cannot be set up.
#[derive(Debug, Error)]
pub enum EmulatorError {
    /// No pseudo-terminal.
    #[error("emulator: cannot open a pseudo-terminal")]
    Pty(#[source] std::io::Error),
    /// No symbolic link.
    #[error("emulator: cannot make the link {path}", path = path.display())]
    Link {
        /// Where.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// No thread.
    #[error("emulator: cannot start a thread")]
    Thread(#[source] std::io::Error),
    /// The speed makes no sense.
    #[error("emulator: speed is {speed}, it must be a positive number")]
    Speed {
        /// What was given.
        speed: f64,
    },
}

/// What the emulated board has done so far.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct EmulatorCounts {
    /// Slices sent.
    pub slices: u64,
    /// Data packets, faulty ones included.
    pub packets: u64,
    /// FIFO overflows.
    pub overflows: u64,
}

#[derive(Default)]
struct Shared {
    stop: AtomicBool,
    dead: AtomicBool,
    finished: AtomicBool,
    slices: AtomicU64,
    packets: AtomicU64,
    overflows: AtomicU64,
    refusal: Mutex<Option<String>>,
}

/// A running emulated board. It ends with [`EmulatedBoard::stop`] or when dropped.
pub struct EmulatedBoard {
    path: PathBuf,
    link: Option<PathBuf>,
    waveform: Waveform,
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

impl EmulatedBoard {
    /// Opens a pseudo-terminal and serves it in a thread.
    pub fn spawn(source: Box<dyn FrameSource>, options: EmulatorOptions) -> Result<EmulatedBoard, EmulatorError> {
        if let Pace::RealTime(speed) = options.pace
            && !(speed > 0.0 && speed.is_finite())
        {
            return Err(EmulatorError::Speed { speed });
        }
        let waveform = source.waveform().clone();
        let pty = Pty::open().map_err(EmulatorError::Pty)?;
        if let Some(link) = &options.link {
            pty.link(link).map_err(|source| EmulatorError::Link { path: link.clone(), source })?;
        }
        let path = options.link.clone().unwrap_or_else(|| pty.path.clone());
        let shared = Arc::new(Shared::default());
        let world = World::new(source, options.pace).map_err(EmulatorError::Thread)?;
        let firmware = Firmware::new(&waveform, &options);
        let link = options.link.clone();
        let mut device = Device {
            pty,
            link: options.link,
            unplugged: None,
            powered_up_us: None,
            held: Vec::new(),
            world,
            firmware,
            source: waveform.clone(),
            parser: HostParser::new(if options.protocol_version == 3 { Protocol::V3 } else { Protocol::V4 }),
            faults: options.faults,
            sending: None,
            counter: 0,
            starts: 0,
            out: Vec::new(),
            written: 0,
            shared: shared.clone(),
        };
        let thread = thread::Builder::new()
            .name("emulated board".into())
            .spawn(move || {
                if let Err(error) = device.serve() {
                    tracing::error!(%error, "the emulated board failed");
                }
                device.shared.dead.store(true, Ordering::Release);
            })
            .map_err(EmulatorError::Thread)?;
        Ok(EmulatedBoard { path, link, waveform, shared, thread: Some(thread) })
    }

    /// Device node to open as a serial port.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Waveform of the source: the one that the board accepts.
    pub fn waveform(&self) -> &Waveform {
        &self.waveform
    }

    /// Whether the source has ended and all of it has been handed to the port.
    pub fn finished(&self) -> bool {
        self.shared.finished.load(Ordering::Acquire)
    }

    /// Why the board last refused to start, if it did.
    pub fn refusal(&self) -> Option<String> {
        self.shared.refusal.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// What it has done so far.
    pub fn counts(&self) -> EmulatorCounts {
        let load = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        let Shared { slices, packets, overflows, .. } = &*self.shared;
        EmulatorCounts { slices: load(slices), packets: load(packets), overflows: load(overflows) }
    }

    /// Waits until the source has been sent to its end, or the board has stopped. It goes on answering.
    pub fn wait(&self) {
        while !self.finished() && !self.shared.dead.load(Ordering::Acquire) {
            thread::sleep(Duration::from_millis(10));
        }
    }

    /// Ends it.
    pub fn stop(&mut self) {
        self.shared.stop.store(true, Ordering::Release);
        if let Some(thread) = self.thread.take()
            && thread.join().is_err()
        {
            tracing::error!("the emulated board panicked");
        }
        // The terminal's name will be another's: nothing must lead there.
        if let Some(link) = self.link.take()
            && let Err(error) = std::fs::remove_file(&link)
        {
            tracing::warn!(%error, link = %link.display(), "the link could not be removed");
        }
    }
}

impl Drop for EmulatedBoard {
    fn drop(&mut self) {
        self.stop();
    }
}

/// A slice on its way.
struct Sending {
    layout: SliceLayout,
    bytes: Vec<u8>,
    next: usize,
}

struct Device {
    pty: Pty,
    link: Option<PathBuf>,
    /// To be unplugged for so long.
    unplugged: Option<Duration>,
    /// World time at which the board's clock began again after it was unplugged; `Some(None)` until the next slice.
    powered_up_us: Option<Option<u64>>,
    /// A packet to be sent after its successor.
    held: Vec<u8>,
    world: World,
    firmware: Firmware,
    source: Waveform,
    parser: HostParser,
    faults: Vec<Fault>,
    sending: Option<Sending>,
    counter: u16,
    starts: u64,
    out: Vec<u8>,
    written: usize,
    shared: Arc<Shared>,
}

impl Device {
    fn serve(&mut self) -> std::io::Result<()> {
        let mut buffer = [0; 4096];
        while !self.shared.stop.load(Ordering::Acquire) {
            if let Some(duration) = self.unplugged.take() {
                self.unplug(duration)?;
            }
            // Between the bytes of a message nothing else is sent; between messages requests are answered.
            if self.written < self.out.len() {
                self.pty.wait(true, Duration::from_millis(20))?;
                self.world.advance();
            } else {
                self.out.clear();
                self.written = 0;
                let count = self.pty.read(&mut buffer)?;
                self.parser.push(buffer.get(..count).unwrap_or(&[]));
                while let Some(event) = self.parser.next_event() {
                    self.firmware.handle(&event, &mut self.out);
                    let mut refusal = self.shared.refusal.lock().unwrap_or_else(PoisonError::into_inner);
                    refusal.clone_from(&self.firmware.refusal);
                }
                if self.out.is_empty() && !self.next_packet() {
                    self.pty.wait(false, Duration::from_millis(1))?;
                }
            }
            self.written += self.pty.write(self.out.get(self.written..).unwrap_or(&[]))?;
        }
        Ok(())
    }

    /// The terminal goes, and another comes in its place.
    fn unplug(&mut self, duration: Duration) -> std::io::Result<()> {
        let is_back = Pty::open()?;
        drop(std::mem::replace(&mut self.pty, is_back));
        if let Some(link) = &self.link {
            std::fs::remove_file(link)?;
        }
        let end = Instant::now() + duration;
        while Instant::now() < end && !self.shared.stop.load(Ordering::Acquire) {
            thread::sleep(Duration::from_millis(5));
            self.world.advance();
        }
        self.firmware.power_up();
        self.parser = HostParser::new(self.parser.protocol());
        self.out.clear();
        self.written = 0;
        self.held.clear();
        self.powered_up_us = Some(None);
        match &self.link {
            Some(link) => self.pty.link(link),
            None => Ok(()),
        }
    }

    /// Puts the next data packet into `out`; whether there was anything to do.
    fn next_packet(&mut self) -> bool {
        let Some((layout, waveform)) = self.firmware.streaming() else {
            self.sending = None;
            return false;
        };
        if self.starts != self.firmware.starts {
            self.starts = self.firmware.starts;
            (self.counter, self.sending) = (0, None);
            let antennas = self.source.request.rx_antennas.antennas();
            let wanted = waveform.request.rx_antennas.antennas();
            let channels = wanted.iter().filter_map(|a| antennas.iter().position(|b| a == b)).collect();
            let waveform = waveform.clone();
            let test_pattern = wanted.iter().position(|a| *a == 1).filter(|_| self.firmware.test_pattern());
            self.world.restart(&waveform, channels, test_pattern);
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
                    let codes = frames * waveform_codes(&self.firmware);
                    let samples = layout.samples as u64;
                    let packets = codes / samples * layout.packets() as u64;
                    if codes.is_multiple_of(samples) && self.world.at_frame_boundary() && packets < 0x8000 {
                        self.counter = self.counter.wrapping_add(packets as u16);
                    }
                    return true;
                }
                Slice::Wait => return false,
                Slice::Overflow => {
                    self.overflow();
                    return true;
                }
                Slice::End => {
                    self.shared.finished.store(true, Ordering::Release);
                    return false;
                }
            }
        }
        self.send_packet();
        true
    }

    fn send_packet(&mut self) {
        let number = self.shared.packets.fetch_add(1, Ordering::Relaxed);
        if self.faults.contains(&Fault::Overflow(number)) {
            self.overflow();
            return;
        }
        for fault in &self.faults {
            match *fault {
                Fault::Stall(packet) if packet == number => {
                    self.sending = None;
                    self.firmware.stop_by_itself();
                }
                Fault::Unplug { packet, duration } if packet == number => {
                    self.sending = None;
                    self.unplugged = Some(duration);
                }
                Fault::SkipCounter { packet, by } if packet == number => self.counter = self.counter.wrapping_add(by),
                _ => {}
            }
        }
        let Some(sending) = &mut self.sending else { return };
        let index = sending.next;
        let start = index * MAX_PACKET_PAYLOAD;
        let last = index + 1 == sending.layout.packets();
        let end = start + sending.layout.payload_length(index);
        let payload = sending.bytes.get(start..end).unwrap_or(&[]);
        let flags = PacketFlags { first: index == 0, last, timestamp: last, error: false };
        Packet { flags, channel: 0, counter: self.counter, payload }.encode(&mut self.out);
        self.counter = self.counter.wrapping_add(1);
        sending.next += 1;
        if last {
            self.sending = None;
        }
        for fault in &self.faults {
            match *fault {
                Fault::DropPacket(n) if n == number => self.out.clear(),
                Fault::DoublePacket(n) if n == number => self.out.extend_from_within(..),
                Fault::FlipBit { packet, bit } if packet == number => {
                    let length = self.out.len().max(1);
                    if let Some(byte) = self.out.get_mut(bit / 8 % length) {
                        *byte ^= 1 << (bit % 8);
                    }
                }
                Fault::TruncatePacket { packet, bytes } if packet == number => self.out.truncate(bytes),
                Fault::ReorderPacket(n) if n == number => self.held.append(&mut self.out),
                Fault::ReorderPacket(n) if n + 1 == number => self.out.append(&mut self.held),
                _ => {}
            }
        }
    }

    /// The firmware reports that the chip's FIFO has overflowed, and stops.
    fn overflow(&mut self) {
        self.shared.overflows.fetch_add(1, Ordering::Relaxed);
        self.sending = None;
        self.firmware.stop_by_itself();
        let flags = PacketFlags { first: true, last: true, timestamp: false, error: true };
        let payload = &DataError::FifoOverflow.code().to_le_bytes();
        Packet { flags, channel: 0, counter: self.counter, payload }.encode(&mut self.out);
    }
}

fn waveform_codes(firmware: &Firmware) -> u64 {
    firmware.streaming().map_or(0, |(_, waveform)| waveform.shape().codes() as u64)
}
