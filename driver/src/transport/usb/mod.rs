//! USB devices by their endpoints: real ones through libusb, emulated ones through sockets.

mod address;
mod device;
mod endpoints;
mod socket;

pub use address::{UsbAddress, UsbAddressError};
pub(crate) use device::open;
pub(crate) use endpoints::{Endpoints, OpenError, Setup, TransferError};
pub(crate) use socket::{DeviceSockets, HostSockets};
