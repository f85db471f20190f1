//! Endpoints of USB devices, and the errors of opening and using them.

use std::io;
use std::time::Duration;

use super::address::UsbAddress;

/// A setup packet: bmRequestType, bRequest, wValue, wIndex, wLength.
pub(crate) type Setup = [u8; 8];

/// The endpoints of a device with one bulk IN endpoint.
pub(crate) trait Endpoints: Send {
    /// Makes a control transfer with data to the device.
    fn control_out(&mut self, setup: &Setup, data: &[u8]) -> Result<(), TransferError>;
    /// Makes a control transfer with data from the device; returns the number of bytes.
    fn control_in(&mut self, setup: &Setup, buffer: &mut [u8]) -> Result<usize, TransferError>;
    /// Reads from the bulk endpoint, waiting at most `timeout`; returns the number of bytes, 0 if none came.
    fn read_bulk(&mut self, buffer: &mut [u8], timeout: Duration) -> Result<usize, TransferError>;
}

#[derive(Debug)]
pub(crate) enum TransferError {
    /// The device refused it.
    Stall,
    /// The device did not answer in time.
    Timeout,
    /// The connection broke.
    Lost(io::Error),
}

/// Error of opening a serial port or a USB device.
#[derive(Debug)]
pub(crate) enum OpenError {
    /// No such device is attached.
    Absent,
    /// More than one device matches: these addresses.
    Ambiguous(Vec<UsbAddress>),
    /// Another program holds the device.
    Busy,
    /// The user may not open the device.
    PermissionDenied,
    /// Any other error of the system.
    Other(io::Error),
}

/// Longest time that a device takes to answer a control transfer.
pub(super) const CONTROL_TIMEOUT: Duration = Duration::from_secs(1);
