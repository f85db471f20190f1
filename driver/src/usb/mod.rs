//! USB devices by their endpoints: real ones through libusb, emulated ones through sockets.

mod address;
mod device;
#[cfg(target_os = "linux")]
pub mod function_fs;
mod socket;

use std::io;
use std::time::Duration;

pub use address::{UsbAddress, UsbAddressError};
pub(crate) use device::open;
pub(crate) use socket::DeviceSockets;

/// A setup packet: bmRequestType, bRequest, wValue, wIndex, wLength.
pub(crate) type Setup = [u8; 8];

/// The endpoints of a device with one bulk IN endpoint.
pub(crate) trait Endpoints: Send {
    /// A control transfer with data to the device.
    fn control_out(&mut self, setup: &Setup, data: &[u8]) -> Result<(), TransferError>;
    /// A control transfer with data from the device; how many bytes came.
    fn control_in(&mut self, setup: &Setup, buffer: &mut [u8]) -> Result<usize, TransferError>;
    /// Reads from the bulk endpoint, at most so long; how many bytes came, 0 if none.
    fn read_bulk(&mut self, buffer: &mut [u8], timeout: Duration) -> Result<usize, TransferError>;
}

/// A transfer that was not made.
#[derive(Debug)]
pub(crate) enum TransferError {
    /// The device refused it.
    Stall,
    /// The device did not answer in time.
    Timeout,
    /// The device has gone.
    Lost(io::Error),
}

/// A device that cannot be opened.
#[derive(Debug)]
pub(crate) enum OpenError {
    /// None such is attached.
    Absent,
    /// More than one is attached: these.
    Ambiguous(Vec<UsbAddress>),
    /// Another program has it.
    Busy,
    /// This user may not.
    PermissionDenied,
    /// Anything else.
    Other(io::Error),
}

/// Longest that a device takes to answer a control transfer.
const CONTROL_TIMEOUT: Duration = Duration::from_secs(1);
