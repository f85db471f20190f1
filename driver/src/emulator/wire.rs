//! What stands between a firmware and its host: the port, what waits to be sent, and what goes wrong there.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::thread;
use std::time::{Duration, Instant};

use super::port::Port;
use super::{Fault, Shared};

/// A board's program: it answers, and has data to send.
pub(super) trait Firmware {
    /// Takes bytes of the host; the answers are appended to `out`.
    fn receive(&mut self, bytes: &[u8], out: &mut Vec<u8>);
    /// Sends the next data message, if one is due; whether there was anything to do.
    fn next_message(&mut self, wire: &mut Wire) -> bool;
    /// Lets the world go on while the host reads nothing.
    fn advance(&mut self);
    /// The board was without power: everything is as at first, but the world.
    fn power_up(&mut self);
    /// Whether it starts anew each time that a client opens the port, and sends nothing while none has.
    fn restarts_when_opened(&self) -> bool {
        false
    }
}

/// The line to the host.
pub(super) struct Wire {
    port: Port,
    link: Option<PathBuf>,
    faults: Vec<Fault>,
    /// A message to be sent after its successor.
    held: Vec<u8>,
    out: Vec<u8>,
    written: usize,
    /// To be unplugged for so long.
    unplugged: Option<Duration>,
    has_client: bool,
    /// The host takes nothing until then.
    host_reads_from: Option<Instant>,
    pub shared: Arc<Shared>,
}

/// What a fault asks of the firmware before a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Before {
    /// The FIFO overflows instead.
    Overflow,
    /// Nothing is sent until the host starts the board anew.
    Stall,
    /// The counter jumps by so much.
    Skip(u16),
}

impl Wire {
    pub fn new(port: Port, link: Option<PathBuf>, faults: Vec<Fault>, shared: Arc<Shared>) -> Self {
        Wire {
            port,
            link,
            faults,
            held: Vec::new(),
            out: Vec::new(),
            written: 0,
            unplugged: None,
            has_client: false,
            host_reads_from: None,
            shared,
        }
    }

    /// Number of the next message, and what happens before it. A board that is about to be unplugged does not send it.
    pub fn next_number(&mut self) -> (u64, Vec<Before>) {
        let number = self.shared.packets.fetch_add(1, Ordering::Relaxed);
        let mut before = Vec::new();
        for fault in &self.faults {
            match *fault {
                Fault::Overflow(n) if n == number => before.push(Before::Overflow),
                Fault::Stall(n) if n == number => before.push(Before::Stall),
                Fault::SkipCounter { packet, by } if packet == number => before.push(Before::Skip(by)),
                Fault::Unplug { packet, duration } if packet == number => {
                    self.unplugged = Some(duration);
                    before.push(Before::Stall);
                }
                Fault::SlowHost { packet, duration } if packet == number => {
                    self.host_reads_from = Some(Instant::now() + duration);
                }
                _ => {}
            }
        }
        (number, before)
    }

    /// Sends a message as it is.
    pub fn send(&mut self, encode: impl FnOnce(&mut Vec<u8>)) {
        encode(&mut self.out);
    }

    /// The board starts anew: nothing from before is sent any more.
    pub fn forget_held(&mut self) {
        self.held.clear();
    }

    /// Sends the data message of this number, or what its faults leave of it.
    pub fn send_data(&mut self, number: u64, encode: impl FnOnce(&mut Vec<u8>)) {
        let start = self.out.len();
        encode(&mut self.out);
        for fault in &self.faults {
            match *fault {
                Fault::DropPacket(n) if n == number => self.out.truncate(start),
                Fault::DoublePacket(n) if n == number => self.out.extend_from_within(start..),
                Fault::FlipBit { packet, bit } if packet == number => {
                    let length = (self.out.len() - start).max(1);
                    if let Some(byte) = self.out.get_mut(start + bit / 8 % length) {
                        *byte ^= 1 << (bit % 8);
                    }
                }
                Fault::TruncatePacket { packet, bytes } if packet == number => self.out.truncate(start + bytes),
                Fault::ReorderPacket(n) if n == number => self.held.extend(self.out.drain(start..)),
                Fault::ReorderPacket(n) if n + 1 == number => self.out.append(&mut self.held),
                _ => {}
            }
        }
    }

    /// Serves the host until the emulator is stopped. Between the bytes of a message nothing else is sent; between messages
    /// requests are answered.
    pub fn serve(&mut self, firmware: &mut dyn Firmware) -> std::io::Result<()> {
        let mut buffer = [0; 4096];
        let watches_clients = firmware.restarts_when_opened();
        if watches_clients {
            self.port.watch_clients();
        }
        while !self.shared.stop.load(Ordering::Acquire) {
            if let Some(duration) = self.unplugged.take() {
                self.unplug(duration, firmware)?;
            }
            if watches_clients {
                let had_client = std::mem::replace(&mut self.has_client, self.port.has_client()?);
                if !self.has_client {
                    thread::sleep(Duration::from_millis(1));
                    firmware.advance();
                    continue;
                }
                if !had_client {
                    self.restart(firmware);
                }
            }
            if let Some(moment) = self.host_reads_from {
                if Instant::now() < moment {
                    thread::sleep(Duration::from_millis(1));
                    firmware.advance();
                    continue;
                }
                self.host_reads_from = None;
            }
            if self.written < self.out.len() {
                self.port.wait(true, Duration::from_millis(20))?;
                firmware.advance();
            } else {
                self.out.clear();
                self.written = 0;
                let count = self.port.read(&mut buffer)?;
                firmware.receive(buffer.get(..count).unwrap_or(&[]), &mut self.out);
                if self.out.is_empty() && !firmware.next_message(self) {
                    self.port.wait(false, Duration::from_millis(1))?;
                }
            }
            self.written += self.port.write(self.out.get(self.written..).unwrap_or(&[]))?;
        }
        Ok(())
    }

    /// The terminal goes, and another comes in its place.
    fn unplug(&mut self, duration: Duration, firmware: &mut dyn Firmware) -> std::io::Result<()> {
        let mut is_back = Port::open()?;
        if firmware.restarts_when_opened() {
            is_back.watch_clients();
        }
        drop(std::mem::replace(&mut self.port, is_back));
        if let Some(link) = &self.link {
            std::fs::remove_file(link)?;
        }
        let end = Instant::now() + duration;
        while Instant::now() < end && !self.shared.stop.load(Ordering::Acquire) {
            thread::sleep(Duration::from_millis(5));
            firmware.advance();
        }
        self.has_client = false;
        self.restart(firmware);
        match &self.link {
            Some(link) => self.port.link(link),
            None => Ok(()),
        }
    }

    fn restart(&mut self, firmware: &mut dyn Firmware) {
        firmware.power_up();
        self.out.clear();
        self.written = 0;
        self.held.clear();
    }

    /// Where the host finds the board.
    pub fn path(&self) -> &Path {
        self.link.as_deref().unwrap_or(&self.port.path)
    }
}
