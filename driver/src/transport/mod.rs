//! Serial ports and USB devices, and the trace of the bytes that they carry.

mod address;
mod permission;
pub(crate) mod serial;
pub mod trace;
pub mod usb;

pub use address::Address;
pub use permission::{PERMISSION_REMEDY, UDEV_RULES};
pub use usb::{UsbAddress, UsbAddressError};
