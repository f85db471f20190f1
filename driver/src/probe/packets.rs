//! Transports of CMSIS-DAP packets: HID reports (version 1) or bulk transfers (version 2).

use std::ffi::CString;
use std::io;
use std::os::unix::ffi::OsStrExt;
use std::path::Path;
use std::time::Duration;

use hidapi::{HidApi, HidDevice};
use rusb::{Context, Device, DeviceHandle, Direction, TransferType, UsbContext};

use crate::protocol::cmsis_dap::HID_PACKET;

/// Longest time that a probe takes to answer.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(1);
const VENDOR_SPECIFIC: u8 = 0xFF;

pub(crate) trait Packets {
    /// Sends a packet and waits for the answer; returns its length, 0 if none came.
    fn exchange(&mut self, packet: &[u8], answer: &mut [u8]) -> io::Result<usize>;
}

impl Packets for HidDevice {
    fn exchange(&mut self, packet: &[u8], answer: &mut [u8]) -> io::Result<usize> {
        // Report number 0: the device has only one.
        let mut report = vec![0; 1 + HID_PACKET];
        report.iter_mut().skip(1).zip(packet).for_each(|(to, from)| *to = *from);
        self.write(&report).map_err(io::Error::other)?;
        self.read_timeout(answer, ANSWER_TIMEOUT.as_millis() as i32).map_err(io::Error::other)
    }
}

/// Opens a probe by its HID device node.
pub(super) fn hid(path: &Path) -> io::Result<Box<dyn Packets>> {
    use rustix::fs::{Access, access};
    access(path, Access::READ_OK | Access::WRITE_OK)?;
    let device =
        HidApi::new().and_then(|api| api.open_path(&CString::new(path.as_os_str().as_bytes()).unwrap_or_default()));
    Ok(Box::new(device.map_err(io::Error::other)?))
}

struct BulkProbe {
    handle: DeviceHandle<Context>,
    to_probe: u8,
    from_probe: u8,
}

impl Packets for BulkProbe {
    fn exchange(&mut self, packet: &[u8], answer: &mut [u8]) -> io::Result<usize> {
        self.handle.write_bulk(self.to_probe, packet, ANSWER_TIMEOUT).map_err(io_error)?;
        match self.handle.read_bulk(self.from_probe, answer, ANSWER_TIMEOUT) {
            Err(rusb::Error::Timeout) => Ok(0),
            result => result.map_err(io_error),
        }
    }
}

fn io_error(error: rusb::Error) -> io::Error {
    match error {
        rusb::Error::Access => io::ErrorKind::PermissionDenied.into(),
        rusb::Error::Busy => io::ErrorKind::ResourceBusy.into(),
        rusb::Error::NotFound | rusb::Error::NoDevice => io::ErrorKind::NotFound.into(),
        error => io::Error::other(error),
    }
}

/// Opens a probe by its bus and its address on it.
pub(super) fn bulk(bus: u8, address: u8) -> io::Result<Box<dyn Packets>> {
    let open = || {
        let devices = Context::new()?.devices()?;
        let is_wanted = |device: &Device<Context>| (device.bus_number(), device.address()) == (bus, address);
        let device = devices.iter().find(is_wanted).ok_or(rusb::Error::NotFound)?;
        let handle = device.open()?;
        let (interface, to_probe, from_probe) = endpoints(&device, &handle)?.ok_or(rusb::Error::NotFound)?;
        // Not every system has drivers to detach.
        let _ = handle.set_auto_detach_kernel_driver(true);
        handle.claim_interface(interface)?;
        Ok(BulkProbe { handle, to_probe, from_probe })
    };
    Ok(Box::new(open().map_err(io_error)?))
}

/// Finds the interface that is named CMSIS-DAP and its first bulk endpoints to and from the probe. Their order is
/// specified; a third one is for trace.
fn endpoints(device: &Device<Context>, handle: &DeviceHandle<Context>) -> rusb::Result<Option<(u8, u8, u8)>> {
    let configuration = device.active_config_descriptor()?;
    for setting in configuration.interfaces().flat_map(|interface| interface.descriptors()) {
        let name = setting.description_string_index().map(|index| handle.read_string_descriptor_ascii(index));
        let is_probe = name.is_some_and(|name| name.is_ok_and(|name| name.contains("CMSIS-DAP")));
        if setting.class_code() != VENDOR_SPECIFIC || !is_probe {
            continue;
        }
        let bulk = |direction| {
            let mut endpoints = setting.endpoint_descriptors();
            endpoints
                .find(|e| (e.transfer_type(), e.direction()) == (TransferType::Bulk, direction))
                .map(|e| e.address())
        };
        if let (Some(to_probe), Some(from_probe)) = (bulk(Direction::Out), bulk(Direction::In)) {
            return Ok(Some((setting.interface_number(), to_probe, from_probe)));
        }
    }
    Ok(None)
}
