//! Line between a firmware and its host: the port, the data to be sent, and the injected faults.

use std::collections::VecDeque;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::thread;
use std::time::{Duration, Instant};

use super::port::{HostLine, Port, link, unlink};
use super::{EmulatorOptions, Fault, Shared};
use crate::transport::usb::Setup;

/// Longest time in which a stopping board completes the slice that it is sending.
const FINISH_TIMEOUT: Duration = Duration::from_millis(500);
/// Largest number of pieces of requests in transit. A host that sends more has to wait.
const MAX_IN_TRANSIT: usize = 256;

/// Firmware of a board: it answers requests and sends data.
pub(super) trait Firmware {
    /// Takes bytes of the host; the answers are appended to `out`.
    fn receive(&mut self, bytes: &[u8], out: &mut Vec<u8>);
    /// Takes a control transfer of the host; returns the data of an IN transfer, or `None` to stall.
    fn control(&mut self, _setup: &Setup, _data: &[u8]) -> Option<Vec<u8>> {
        None
    }
    /// Sends the next data message, if one is due; returns whether there was anything to do.
    fn next_message(&mut self, wire: &mut Wire) -> bool;
    /// Lets the chip keep sampling while the host reads nothing.
    fn advance(&mut self);
    /// Resets the firmware after a loss of power; the source of samples goes on.
    fn power_up(&mut self);
    /// Stops after the last client has left, perhaps within a request or a stream, and waits for another.
    fn client_left(&mut self);
    /// Returns whether the host needs another data message to interpret the last one.
    fn is_within_data(&self) -> bool {
        false
    }
    /// Returns whether the firmware restarts each time that a client opens the port, and sends nothing while no client
    /// has it open.
    fn restarts_when_opened(&self) -> bool {
        false
    }
}

/// Line to the host.
pub(super) struct Wire {
    port: Port,
    line: HostLine,
    faults: Vec<Fault>,
    /// Message that is sent after its successor.
    reordered: Vec<u8>,
    out: Vec<u8>,
    written: usize,
    /// Duration for which the board has to be unplugged.
    unplug_duration: Option<Duration>,
    has_client: bool,
    /// Time until which the host reads nothing.
    host_is_slow_until: Option<Instant>,
    /// Delay of the host's bytes to the firmware.
    latency: Duration,
    /// Bytes on their way to the firmware, with their times of arrival.
    in_transit: VecDeque<(Instant, Vec<u8>)>,
    pub shared: Arc<Shared>,
}

/// Action of the firmware before a message, by a fault.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum FaultAction {
    /// The FIFO overflows instead of the message.
    Overflow,
    /// Nothing is sent until the host starts the board anew.
    Stall,
    /// The counter jumps by this number.
    Skip(u16),
}

impl Wire {
    /// Opens the line: plugs the board in.
    pub fn new(line: HostLine, options: &EmulatorOptions, shared: Arc<Shared>) -> std::io::Result<Self> {
        let wire = Wire {
            port: line.open()?,
            line,
            faults: options.faults.clone(),
            reordered: Vec::new(),
            out: Vec::new(),
            written: 0,
            unplug_duration: None,
            has_client: false,
            host_is_slow_until: None,
            latency: options.latency,
            in_transit: VecDeque::new(),
            shared,
        };
        wire.make_link()?;
        Ok(wire)
    }

    /// Makes the link to the terminal.
    fn make_link(&self) -> std::io::Result<()> {
        match &self.line {
            HostLine::Pseudoterminal { link: Some(path) } => link(self.port.path(), path),
            _ => Ok(()),
        }
    }

    /// Removes the link, unless the link of another board has replaced it.
    fn remove_link(&self) -> std::io::Result<()> {
        match &self.line {
            HostLine::Pseudoterminal { link: Some(path) } => unlink(self.port.path(), path),
            _ => Ok(()),
        }
    }

    /// Returns the number of the next message, and the actions before it. A board that is about to be unplugged does
    /// not send it.
    pub fn next_number(&mut self) -> (u64, Vec<FaultAction>) {
        let number = self.shared.packets.fetch_add(1, Ordering::Relaxed);
        let mut actions = Vec::new();
        for fault in &self.faults {
            match *fault {
                Fault::Overflow(n) if n == number => actions.push(FaultAction::Overflow),
                Fault::Stall(n) if n == number => actions.push(FaultAction::Stall),
                Fault::SkipCounter { packet, by } if packet == number => actions.push(FaultAction::Skip(by)),
                Fault::Unplug { packet, duration } if packet == number => {
                    self.unplug_duration = Some(duration);
                    actions.push(FaultAction::Stall);
                }
                Fault::SlowHost { packet, duration } if packet == number => {
                    self.host_is_slow_until = Some(Instant::now() + duration);
                }
                _ => {}
            }
        }
        (number, actions)
    }

    /// Sends a message without faults.
    pub fn send(&mut self, encode: impl FnOnce(&mut Vec<u8>)) {
        encode(&mut self.out);
    }

    /// Discards the message that is sent after its successor, when the board restarts.
    pub fn discard_reordered(&mut self) {
        self.reordered.clear();
    }

    /// Sends the data message of this number, changed by its faults.
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
                Fault::ReorderPacket(n) if n == number => self.reordered.extend(self.out.drain(start..)),
                Fault::ReorderPacket(n) if n + 1 == number => self.out.append(&mut self.reordered),
                _ => {}
            }
        }
    }

    /// Serves the host until the emulator is stopped. Nothing is sent between the bytes of a message; requests are
    /// answered between messages. On endpoints, control transfers are answered at any time.
    pub fn serve(&mut self, firmware: &mut dyn Firmware) -> std::io::Result<()> {
        if firmware.restarts_when_opened() {
            self.port.watch_clients();
        }
        while !self.shared.stop.load(Ordering::Acquire) {
            if let Some(duration) = self.unplug_duration.take() {
                self.unplug(duration, firmware)?;
            }
            if self.port.is_hung_up() {
                self.unplug(Duration::ZERO, firmware)?;
            }
            self.check_departure(firmware)?;
            if self.has_reader(firmware)? {
                self.exchange(firmware)?;
            } else {
                thread::sleep(Duration::from_millis(1));
                firmware.advance();
            }
        }
        self.finish(firmware)
    }

    /// Takes bytes of the host, and sends a part of the current message or begins the next one.
    fn exchange(&mut self, firmware: &mut dyn Firmware) -> std::io::Result<()> {
        let is_sending = self.written < self.out.len();
        if is_sending {
            self.port.wait(true, Duration::from_millis(20))?;
            firmware.advance();
        } else {
            self.out.clear();
            self.written = 0;
        }
        let has_answered = self.receive(firmware, is_sending)?;
        if !is_sending {
            self.deliver(firmware);
            if self.out.is_empty() && !has_answered && !firmware.next_message(self) {
                self.port.wait(false, self.until_delivery().min(Duration::from_millis(1)))?;
            }
        }
        self.write_out()
    }

    /// Writes as much of the current message as the port takes.
    fn write_out(&mut self) -> std::io::Result<()> {
        self.written += self.port.write(self.out.get(self.written..).unwrap_or(&[]))?;
        Ok(())
    }

    /// Returns whether a host reads: a client has the port open, and no fault makes it slow. Firmware that restarts
    /// when the port is opened does so for a new client.
    fn has_reader(&mut self, firmware: &mut dyn Firmware) -> std::io::Result<bool> {
        if firmware.restarts_when_opened() {
            let had_client = std::mem::replace(&mut self.has_client, self.port.has_client()?);
            if !self.has_client {
                return Ok(false);
            }
            if !had_client {
                self.restart(firmware);
            }
        }
        self.host_is_slow_until = self.host_is_slow_until.filter(|moment| Instant::now() < *moment);
        Ok(self.host_is_slow_until.is_none())
    }

    /// Takes bytes of the host from a terminal, or answers a control transfer; returns whether one was answered.
    fn receive(&mut self, firmware: &mut dyn Firmware, is_sending: bool) -> std::io::Result<bool> {
        let mut buffer = [0; 4096];
        match &mut self.port {
            Port::Endpoints(endpoints) => {
                let count = endpoints.read(&mut buffer)?;
                if let Some((setup, data)) = buffer.get(..count).and_then(|transfer| transfer.split_first_chunk()) {
                    endpoints.answer(firmware.control(setup, data).as_deref())?;
                    return Ok(true);
                }
            }
            Port::Terminal(terminal) if !is_sending && self.in_transit.len() < MAX_IN_TRANSIT => {
                let count = terminal.read(&mut buffer)?;
                if let Some(bytes) = buffer.get(..count).filter(|bytes| !bytes.is_empty()) {
                    self.in_transit.push_back((Instant::now() + self.latency, bytes.to_vec()));
                }
            }
            Port::Terminal(_) | Port::Unplugged => {}
        }
        Ok(false)
    }

    /// Gives the firmware the bytes that have arrived by now.
    fn deliver(&mut self, firmware: &mut dyn Firmware) {
        while self.until_delivery().is_zero() {
            let Some((_, bytes)) = self.in_transit.pop_front() else { return };
            firmware.receive(&bytes, &mut self.out);
        }
    }

    /// Time until the next bytes arrive.
    fn until_delivery(&self) -> Duration {
        self.in_transit.front().map_or(Duration::MAX, |(due, _)| due.saturating_duration_since(Instant::now()))
    }

    /// Checks whether the last client has left, and resets the board for the next one.
    fn check_departure(&mut self, firmware: &mut dyn Firmware) -> std::io::Result<()> {
        let mut received = Vec::new();
        if self.port.has_disconnected(&mut received)? {
            firmware.client_left();
            self.discard_data();
            self.shared.departures.fetch_add(1, Ordering::Relaxed);
        } else if !received.is_empty() {
            self.in_transit.push_back((Instant::now() + self.latency, received));
        }
        Ok(())
    }

    /// Completes the current message, and those that belong to it, for a host that reads.
    fn finish(&mut self, firmware: &mut dyn Firmware) -> std::io::Result<()> {
        let end = Instant::now() + FINISH_TIMEOUT;
        while Instant::now() < end {
            if self.written >= self.out.len() {
                self.out.clear();
                self.written = 0;
                if !firmware.is_within_data() || !firmware.next_message(self) {
                    break;
                }
            }
            self.port.wait(true, Duration::from_millis(10))?;
            self.write_out()?;
        }
        // The host loses data that it has not read when the line closes. The system may still hold more than it has
        // handed over.
        let mut idle_checks = 0;
        while Instant::now() < end && idle_checks < 5 {
            idle_checks = if self.port.holds_unread() { 0 } else { idle_checks + 1 };
            thread::sleep(Duration::from_millis(1));
        }
        Ok(())
    }

    /// Unplugs the board and plugs it in later at the same place: a terminal under another name.
    fn unplug(&mut self, duration: Duration, firmware: &mut dyn Firmware) -> std::io::Result<()> {
        let mut new_port = None;
        match &self.line {
            HostLine::Pseudoterminal { .. } => {
                // The new port is opened before the old one is closed, so that it has another name.
                new_port = Some(self.line.open()?);
                self.remove_link()?;
            }
            HostLine::Terminal(_) | HostLine::Endpoints(_) => {}
        }
        self.port = Port::Unplugged;
        let end = Instant::now() + duration;
        let mut is_stopped = false;
        while (Instant::now() < end || new_port.is_none()) && !is_stopped {
            thread::sleep(Duration::from_millis(5));
            firmware.advance();
            is_stopped = self.shared.stop.load(Ordering::Acquire);
            if Instant::now() >= end && new_port.is_none() {
                // The terminal of a gadget may be absent for a while.
                new_port = self.line.open().ok();
            }
        }
        if let Some(mut port) = new_port {
            if firmware.restarts_when_opened() {
                port.watch_clients();
            }
            self.port = port;
        }
        self.has_client = false;
        self.restart(firmware);
        if is_stopped { Ok(()) } else { self.make_link() }
    }

    /// Resets the firmware and discards all data.
    fn restart(&mut self, firmware: &mut dyn Firmware) {
        firmware.power_up();
        self.discard_data();
    }

    /// Discards the data in transit in both directions.
    fn discard_data(&mut self) {
        self.out.clear();
        self.written = 0;
        self.reordered.clear();
        self.in_transit.clear();
    }

    /// Path for the host.
    pub fn path(&self) -> &Path {
        match &self.line {
            HostLine::Pseudoterminal { link: Some(link) } => link,
            _ => self.port.path(),
        }
    }
}

impl Drop for Wire {
    /// Removes the link, because the system will use the terminal's name again.
    fn drop(&mut self) {
        if let Err(error) = self.remove_link() {
            tracing::warn!(%error, line = %self.line.description(), "the link could not be removed");
        }
    }
}
