//! Addresses of boards.

use std::fmt;
use std::path::PathBuf;

use super::usb::UsbAddress;

/// Address of a board, which also selects the transport.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Address {
    /// Serial port.
    Serial(PathBuf),
    /// USB device with the bulk variant of the firmware.
    Usb(UsbAddress),
}

impl Address {
    /// Name of the address in messages.
    pub(crate) fn name(&self) -> PathBuf {
        match self {
            Address::Serial(port) => port.clone(),
            Address::Usb(usb) => usb.name(),
        }
    }
}

impl fmt::Display for Address {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Address::Serial(port) => write!(f, "{}", port.display()),
            Address::Usb(usb) => write!(f, "{usb}"),
        }
    }
}
