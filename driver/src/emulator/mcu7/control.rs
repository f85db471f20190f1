//! Requests as control transfers, and the state of the firmware between them.

use super::firmware::Requests;
use crate::protocol::mcu7::bulk::{Control, LastError, is_in};
use crate::protocol::mcu7::{RequestKind, Status};
use crate::transport::usb::Setup;

/// Control endpoint of firmware with bulk transfers.
pub(super) struct ControlEndpoint {
    last: LastError,
    /// Answer to the last *transfer* that has not been fetched.
    answer: Vec<u8>,
}

impl Default for ControlEndpoint {
    fn default() -> Self {
        ControlEndpoint { last: LastError { kind_code: 0, status: Status::Ok }, answer: Vec::new() }
    }
}

impl ControlEndpoint {
    /// Serves a transfer; returns the data of an IN transfer, nothing for an OUT transfer, or `None` to stall. OUT
    /// transfers never stall: their data have been acknowledged before the firmware gets them.
    pub fn transfer(&mut self, setup: &Setup, data: &[u8], requests: &mut Requests) -> Option<Vec<u8>> {
        let control = Control::decode(setup, data);
        let request = match control {
            Control::Request(request) => request,
            Control::Answer { length } if self.last.kind_code == TRANSFER => {
                let is_available = self.last.status == Status::Ok;
                return is_available.then(|| truncated(std::mem::take(&mut self.answer), length));
            }
            Control::Answer { .. } => {
                self.last = LastError { kind_code: setup[0], status: Status::RequestNotAvailable };
                return None;
            }
            Control::Unknown { kind_code } => {
                self.last = LastError { kind_code, status: Status::RequestTypeInvalid };
                return (!is_in(setup)).then(Vec::new);
            }
        };
        if request == LastError::request() {
            return Some(self.last.encode().to_vec());
        }
        let (status, payload) = requests.answer(&request);
        self.last = LastError { kind_code: request.kind_code(), status };
        match request.kind {
            RequestKind::Read => (status == Status::Ok).then(|| truncated(payload, request.length)),
            RequestKind::Write => Some(Vec::new()),
            RequestKind::Transfer => {
                self.answer = payload;
                Some(Vec::new())
            }
        }
    }
}

/// bmRequestType of a *transfer*.
const TRANSFER: u8 = 0x43;

/// Data of at most `length` bytes.
fn truncated(mut data: Vec<u8>, length: u16) -> Vec<u8> {
    data.truncate(usize::from(length));
    data
}
