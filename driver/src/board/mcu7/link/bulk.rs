//! Requests as control transfers, packets as bulk transfers ([`crate::protocol::mcu7::bulk`]).

use std::time::{Duration, Instant};

use super::{ANSWER_TIMEOUT, Failure, Incoming, SILENCE};
use crate::board::BoardError;
use crate::protocol::mcu7::bulk::{BulkParser, LastError, MAX_BULK, MAX_CONTROL, answer_setup};
use crate::protocol::mcu7::{BoardEvent, Request, RequestKind, Status};
use crate::transport::trace;
use crate::transport::usb::{self, Endpoints, Setup, TransferError, UsbAddress};

/// Vendor and product id of firmware built for bulk transfers.
const USB_ID: (u16, u16) = (0x058B, 0x0252);
/// Silence after which a stopped board sends nothing more.
const DRAIN_SILENCE: Duration = Duration::from_millis(50);

pub(super) struct Bulk {
    endpoints: Box<dyn Endpoints>,
    parser: BulkParser,
    buffer: Vec<u8>,
    last_byte: Instant,
    /// Whether the rest of a packet did not come.
    is_cut: bool,
}

impl From<TransferError> for Failure {
    fn from(error: TransferError) -> Self {
        match error {
            TransferError::Stall | TransferError::Timeout => Failure::NoAnswer,
            TransferError::Lost(source) => Failure::Lost(source),
        }
    }
}

impl Bulk {
    /// Opens the device. Also returns the address under which it is found when it has been plugged in again.
    pub fn open(address: &UsbAddress) -> Result<(Self, UsbAddress), BoardError> {
        let path = address.name();
        trace::opened(&path.display());
        let (endpoints, stable_address) =
            usb::open(USB_ID, address).map_err(|error| BoardError::opening(path, error))?;
        let (parser, buffer) = (BulkParser::new(), vec![0; MAX_BULK]);
        Ok((Bulk { endpoints, parser, buffer, last_byte: Instant::now(), is_cut: false }, stable_address))
    }

    pub fn receive(&mut self, timeout: Duration) -> Result<bool, Failure> {
        let count = match self.endpoints.read_bulk(&mut self.buffer, timeout) {
            // A halted endpoint counts as a lost board.
            Err(TransferError::Stall) => {
                return Err(Failure::Lost(std::io::Error::other("the data endpoint is halted")));
            }
            result => result?,
        };
        if count > 0 {
            self.last_byte = Instant::now();
            self.parser.push(self.buffer.get(..count).unwrap_or(&[]));
        } else if self.parser.is_waiting() && self.last_byte.elapsed() > SILENCE {
            self.is_cut = self.parser.give_up() > 0;
        }
        Ok(count > 0 || self.is_cut)
    }

    pub fn next_incoming(&mut self) -> Option<Incoming<'_>> {
        if std::mem::take(&mut self.is_cut) {
            return Some(Incoming::Damaged);
        }
        match self.parser.next_event()? {
            BoardEvent::Packet(packet) => Some(Incoming::Packet(packet)),
            _ => Some(Incoming::Damaged),
        }
    }

    pub fn request(&mut self, request: &Request) -> Result<(Status, Vec<u8>), Failure> {
        let setup = request.header();
        let mut payload = vec![0; MAX_CONTROL];
        let result = match request.kind {
            RequestKind::Write => {
                self.control_out(&setup, &request.payload)?;
                return Ok((self.last_error()?, Vec::new()));
            }
            RequestKind::Read => self.control_in(&setup, &mut payload),
            RequestKind::Transfer => {
                self.control_out(&setup, &request.payload)?;
                self.control_in(&answer_setup(request), &mut payload)
            }
        };
        match result {
            Ok(count) => {
                payload.truncate(count);
                Ok((Status::Ok, payload))
            }
            // A stall without an error code is a failed request, too.
            Err(TransferError::Stall) => match self.last_error()? {
                Status::Ok => Ok((Status::Failed, Vec::new())),
                status => Ok((status, Vec::new())),
            },
            Err(error) => Err(error.into()),
        }
    }

    fn control_out(&mut self, setup: &Setup, data: &[u8]) -> Result<(), TransferError> {
        trace::sent(setup);
        trace::sent(data);
        self.endpoints.control_out(setup, data).inspect_err(|error| trace::failed(error))
    }

    fn control_in(&mut self, setup: &Setup, buffer: &mut [u8]) -> Result<usize, TransferError> {
        trace::sent(setup);
        let count = self.endpoints.control_in(setup, buffer).inspect_err(|error| trace::failed(error))?;
        trace::received(buffer.get(..count).unwrap_or(&[]));
        Ok(count)
    }

    fn last_error(&mut self) -> Result<Status, Failure> {
        let mut answer = [0; LastError::LENGTH];
        let count = self.control_in(&LastError::request().header(), &mut answer)?;
        let error = answer.get(..count).and_then(LastError::decode).ok_or(Failure::NoAnswer)?;
        Ok(error.status)
    }

    /// Discards the packets that a stopped board has left in its endpoint. They would otherwise be mistaken for packets
    /// of the next start.
    pub fn drain(&mut self) -> Result<(), Failure> {
        let end = Instant::now() + ANSWER_TIMEOUT;
        while Instant::now() < end && self.endpoints.read_bulk(&mut self.buffer, DRAIN_SILENCE)? > 0 {}
        self.parser.give_up();
        self.is_cut = false;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Device that has halted its bulk endpoint and refuses all other transfers.
    struct Halted;

    impl Endpoints for Halted {
        fn control_out(&mut self, _: &Setup, _: &[u8]) -> Result<(), TransferError> {
            Err(TransferError::Stall)
        }

        fn control_in(&mut self, _: &Setup, _: &mut [u8]) -> Result<usize, TransferError> {
            Err(TransferError::Stall)
        }

        fn read_bulk(&mut self, _: &mut [u8], _: Duration) -> Result<usize, TransferError> {
            Err(TransferError::Stall)
        }
    }

    /// The error must not have the kind of a broken pipe: callers that check only the kind take that for a closed
    /// stdout.
    #[test]
    fn a_halted_endpoint_is_a_lost_board_with_this_message() {
        let parser = BulkParser::new();
        let endpoints = Box::new(Halted);
        let mut bulk = Bulk { endpoints, parser, buffer: vec![0; MAX_BULK], last_byte: Instant::now(), is_cut: false };
        match bulk.receive(Duration::ZERO) {
            Err(Failure::Lost(error)) => {
                assert_ne!(error.kind(), std::io::ErrorKind::BrokenPipe);
                assert!(error.to_string().contains("halted"), "{error}");
            }
            Err(Failure::NoAnswer) => panic!("the board has gone for good"),
            Ok(received) => panic!("received {received}"),
        }
    }
}
