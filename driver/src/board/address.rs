//! Where a board is.

use std::fmt;
use std::path::PathBuf;

use crate::usb::UsbAddress;

/// Where a board is, and so what carries its requests and packets.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Address {
    /// On a serial port.
    Serial(PathBuf),
    /// A USB device with the firmware's bulk variant.
    Usb(UsbAddress),
}

impl Address {
    /// As it stands in messages.
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

impl From<UsbAddress> for Address {
    fn from(usb: UsbAddress) -> Self {
        Address::Usb(usb)
    }
}
