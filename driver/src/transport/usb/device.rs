//! Real devices through libusb.

use std::io;
use std::time::Duration;

use rusb::{Context, Device, DeviceHandle, Direction, TransferType, UsbContext};

use super::address::UsbAddress;
use super::endpoints::{CONTROL_TIMEOUT, Endpoints, OpenError, Setup, TransferError};
use super::socket::HostSockets;

/// Number of the interface that the vendor's firmware has.
const INTERFACE: u8 = 0;

struct LibusbDevice {
    handle: DeviceHandle<Context>,
    bulk_in: u8,
}

/// Opens the device of this address among those with these ids. Also returns the address under which the same device is
/// found when it has been plugged in again. This is its serial number if it has one, else its socket if it was chosen
/// by bus and address.
pub(crate) fn open(usb_id: (u16, u16), address: &UsbAddress) -> Result<(Box<dyn Endpoints>, UsbAddress), OpenError> {
    if let UsbAddress::Emulated(folder) = address {
        let sockets = HostSockets::connect(folder).map_err(|e| match e.kind() {
            io::ErrorKind::NotFound | io::ErrorKind::ConnectionRefused => OpenError::Absent,
            io::ErrorKind::PermissionDenied => OpenError::PermissionDenied,
            _ => OpenError::Other(e),
        })?;
        return Ok((Box::new(sockets), address.clone()));
    }
    // Without a bus libusb fails to start (and its global context panics); that is an empty bus.
    let devices = Context::new().and_then(|context| context.devices()).map_err(|_| OpenError::Absent)?;
    let has_ids =
        |device: &Device<Context>| device.device_descriptor().is_ok_and(|d| (d.vendor_id(), d.product_id()) == usb_id);
    let devices: Vec<Device<Context>> = devices.iter().filter(has_ids).collect();
    let mut found = devices.iter().filter(|device| matches_address(device, address));
    let Some(device) = found.next() else {
        // A serial number cannot be read without permission: the device may be the requested one.
        let is_closed = |device: &Device<Context>| matches!(device.open(), Err(rusb::Error::Access));
        let is_hidden = matches!(address, UsbAddress::Serial(_)) && devices.iter().any(is_closed);
        return Err(if is_hidden { OpenError::PermissionDenied } else { OpenError::Absent });
    };
    let further: Vec<_> = found.collect();
    if !further.is_empty() {
        let all = std::iter::once(device).chain(further);
        return Err(OpenError::Ambiguous(all.map(bus_address).collect()));
    }
    let handle = device.open().map_err(open_error)?;
    // Not every system has drivers to detach.
    let _ = handle.set_auto_detach_kernel_driver(true);
    handle.claim_interface(INTERFACE).map_err(open_error)?;
    let bulk_in = bulk_in_endpoint(device).map_err(open_error)?;
    let stable_address = match (serial_number(device, &handle), address) {
        (Some(serial), _) => UsbAddress::Serial(serial),
        (None, UsbAddress::Device { bus, .. }) => {
            UsbAddress::Port { bus: *bus, ports: device.port_numbers().unwrap_or_default() }
        }
        (None, _) => address.clone(),
    };
    Ok((Box::new(LibusbDevice { handle, bulk_in }), stable_address))
}

fn bus_address(device: &Device<Context>) -> UsbAddress {
    UsbAddress::Device { bus: device.bus_number(), address: device.address() }
}

fn matches_address(device: &Device<Context>, address: &UsbAddress) -> bool {
    match address {
        UsbAddress::Any => true,
        UsbAddress::Device { .. } => bus_address(device) == *address,
        UsbAddress::Port { bus, ports } => {
            device.bus_number() == *bus && device.port_numbers().is_ok_and(|p| p == *ports)
        }
        UsbAddress::Serial(serial) => {
            device.open().ok().and_then(|handle| serial_number(device, &handle)).is_some_and(|s| s == *serial)
        }
        UsbAddress::Emulated(_) => false,
    }
}

fn serial_number(device: &Device<Context>, handle: &DeviceHandle<Context>) -> Option<String> {
    let descriptor = device.device_descriptor().ok()?;
    handle.read_serial_number_string_ascii(&descriptor).ok().filter(|serial| !serial.is_empty())
}

/// Bulk IN endpoint of the device; endpoint 1 on the vendor's firmware.
fn bulk_in_endpoint(device: &Device<Context>) -> rusb::Result<u8> {
    let configuration = device.active_config_descriptor()?;
    let endpoints = configuration
        .interfaces()
        .filter(|interface| interface.number() == INTERFACE)
        .flat_map(|interface| interface.descriptors())
        .flat_map(|setting| {
            setting.endpoint_descriptors().map(|e| (e.address(), e.direction(), e.transfer_type())).collect::<Vec<_>>()
        })
        .find(|(_, direction, kind)| (*direction, *kind) == (Direction::In, TransferType::Bulk));
    endpoints.map(|(address, ..)| address).ok_or(rusb::Error::NotFound)
}

fn open_error(error: rusb::Error) -> OpenError {
    match error {
        rusb::Error::Access => OpenError::PermissionDenied,
        rusb::Error::Busy => OpenError::Busy,
        rusb::Error::NoDevice => OpenError::Absent,
        error => OpenError::Other(io::Error::other(error)),
    }
}

fn transfer_error(error: rusb::Error) -> TransferError {
    match error {
        rusb::Error::Pipe => TransferError::Stall,
        rusb::Error::Timeout => TransferError::Timeout,
        error => TransferError::Lost(io::Error::other(error)),
    }
}

impl Endpoints for LibusbDevice {
    fn control_out(&mut self, setup: &Setup, data: &[u8]) -> Result<(), TransferError> {
        let &[kind, request, v0, v1, i0, i1, ..] = setup;
        let (value, index) = (u16::from_le_bytes([v0, v1]), u16::from_le_bytes([i0, i1]));
        match self.handle.write_control(kind, request, value, index, data, CONTROL_TIMEOUT) {
            Ok(written) if written == data.len() => Ok(()),
            Ok(_) => Err(TransferError::Timeout),
            Err(error) => Err(transfer_error(error)),
        }
    }

    fn control_in(&mut self, setup: &Setup, buffer: &mut [u8]) -> Result<usize, TransferError> {
        let &[kind, request, v0, v1, i0, i1, l0, l1] = setup;
        let (value, index) = (u16::from_le_bytes([v0, v1]), u16::from_le_bytes([i0, i1]));
        let length = usize::from(u16::from_le_bytes([l0, l1])).min(buffer.len());
        let buffer = buffer.get_mut(..length).unwrap_or_default();
        self.handle.read_control(kind, request, value, index, buffer, CONTROL_TIMEOUT).map_err(transfer_error)
    }

    fn read_bulk(&mut self, buffer: &mut [u8], timeout: Duration) -> Result<usize, TransferError> {
        // In libusb a timeout of zero means no timeout.
        match self.handle.read_bulk(self.bulk_in, buffer, timeout.max(Duration::from_millis(1))) {
            Ok(count) => Ok(count),
            Err(rusb::Error::Timeout | rusb::Error::Interrupted) => Ok(0),
            Err(error) => Err(transfer_error(error)),
        }
    }
}
