//! Requests and packets of the MCU7 protocol over a serial port or USB.

mod bulk;
mod serial;

use std::path::PathBuf;
use std::time::Duration;

use crate::board::BoardError;
use crate::protocol::mcu7::{Command, Framing, Packet, Protocol, Request, SliceLayout, Status};
use crate::transport::{Address, trace};
use bulk::Bulk;
use serial::Serial;

/// Longest time that a board takes to answer.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(1);
/// Silence after which the rest of a message is given up.
const SILENCE: Duration = Duration::from_millis(200);

pub(super) enum Incoming<'a> {
    Packet(Packet<'a>),
    Damaged,
}

enum Failure {
    /// No answer came.
    NoAnswer,
    /// The connection broke.
    Lost(std::io::Error),
}

enum Connection {
    Serial(Serial),
    Bulk(Bulk),
}

pub(super) struct Link {
    /// Name of the board's address in messages.
    pub path: PathBuf,
    /// Address under which the board is found when it has been plugged in again.
    pub address: Address,
    /// Version that requests are sent in.
    pub protocol: Protocol,
    connection: Connection,
}

impl Link {
    pub fn open(address: &Address) -> Result<Self, BoardError> {
        let path = address.name();
        let (connection, address) = match address {
            Address::Serial(port) => (Connection::Serial(Serial::open(port)?), address.clone()),
            Address::Usb(usb) => {
                let (bulk, stable_address) = Bulk::open(usb)?;
                (Connection::Bulk(bulk), Address::Usb(stable_address))
            }
        };
        Ok(Link { path, address, protocol: Protocol::default(), connection })
    }

    /// Framing of data packets on this transport.
    pub fn framing(&self) -> Framing {
        match self.connection {
            Connection::Serial(_) => Framing::Serial,
            Connection::Bulk(_) => Framing::Bulk,
        }
    }

    /// Sets the layout of the slices that the board sends; `None` while it sends none.
    pub fn set_slice_layout(&mut self, slice: Option<SliceLayout>) {
        match &mut self.connection {
            Connection::Serial(serial) => serial.set_slice_layout(slice),
            // The end of a transfer is the end of a packet.
            Connection::Bulk(_) => {}
        }
    }

    fn error(&self, failure: Failure, command: &'static str) -> BoardError {
        let path = self.path.clone();
        match failure {
            Failure::NoAnswer => BoardError::NoAnswer { path, command },
            Failure::Lost(source) => BoardError::Disconnected { path, source },
        }
    }

    /// Waits for data, at most `timeout`; returns whether any came.
    pub fn receive(&mut self, timeout: Duration) -> Result<bool, BoardError> {
        let received = match &mut self.connection {
            Connection::Serial(serial) => serial.receive(timeout),
            Connection::Bulk(bulk) => bulk.receive(timeout),
        };
        received.map_err(|failure| self.error(failure, "data"))
    }

    /// Returns the next packet among the bytes received; answers to earlier requests are discarded.
    pub fn next_incoming(&mut self) -> Option<Incoming<'_>> {
        let incoming = match &mut self.connection {
            Connection::Serial(serial) => serial.next_incoming(),
            Connection::Bulk(bulk) => bulk.next_incoming(),
        };
        match &incoming {
            Some(Incoming::Packet(packet)) => trace::packet(packet),
            Some(Incoming::Damaged) => trace::damaged(),
            None => {}
        }
        incoming
    }

    /// Sends a request and waits for its answer. After [`Command::StopData`] no packet sent before is left.
    pub fn request(&mut self, command: &Command) -> Result<(Status, Vec<u8>), BoardError> {
        let request: Request = command.to_request(self.protocol);
        let result = match &mut self.connection {
            Connection::Serial(serial) => serial.request(&request),
            Connection::Bulk(bulk) => bulk.request(&request).and_then(|answer| {
                if *command == Command::StopData {
                    bulk.drain()?;
                }
                Ok(answer)
            }),
        };
        result.map_err(|failure| self.error(failure, command_name(command)))
    }

    /// Sends a request that must succeed; returns the payload of the answer.
    pub fn request_ok(&mut self, command: &Command) -> Result<Vec<u8>, BoardError> {
        match self.request(command)? {
            (Status::Ok, payload) => Ok(payload),
            (status, _) => Err(BoardError::Refused { path: self.path.clone(), command: command_name(command), status }),
        }
    }
}

fn command_name(command: &Command) -> &'static str {
    match command {
        Command::BoardInfo | Command::BoardInfoFixed { .. } => "board info",
        Command::FirmwareVersion => "firmware version",
        Command::Uuid => "UUID",
        Command::ExtendedVersion => "extended version",
        Command::ComponentCount { .. } | Command::ComponentImplementation { .. } => "count of radar chips",
        Command::DataIndex => "data index",
        Command::WriteRegisters { .. } | Command::SetBits { .. } => "register write",
        Command::ReadRegisters { .. } => "register read",
        Command::HardwareReset => "hardware reset",
        Command::InterruptLevel => "interrupt level",
        Command::Execute { .. } => "SPI transfer",
        Command::ConfigureData { .. } => "data configuration",
        Command::DataStatus => "data status",
        Command::StartData => "data start",
        Command::StopData => "data stop",
    }
}
