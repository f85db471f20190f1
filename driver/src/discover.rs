//! Boards and probes on this machine, including those that this user may not open.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::Serialize;

/// Gives every user access to the vendor's boards and to debug probes.
pub const UDEV_RULE: &str = "SUBSYSTEMS==\"usb\", ATTRS{idVendor}==\"058b|04b4\", MODE=\"0666\"";

const INFINEON: u16 = 0x058B;
const CYPRESS: u16 = 0x04B4;

/// What a device is believed to be, by its USB ids.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Belief {
    /// Radar Baseboard MCU7, serial.
    Mcu7Serial,
    /// Radar Baseboard MCU7 with the firmware's bulk variant.
    Mcu7Bulk,
    /// PSoC 6 kit with DEEPCRAFT streaming firmware.
    Deepcraft,
    /// KitProg3 debug probe of a PSoC 6 kit.
    KitProg3,
    /// A serial port of which nothing is known: a board answers only when asked.
    SerialPort,
}

impl Belief {
    fn by_usb_id(vendor_id: u16, product_id: u16) -> Option<Self> {
        match (vendor_id, product_id) {
            (INFINEON, 0x0251) => Some(Belief::Mcu7Serial),
            (INFINEON, 0x0252) => Some(Belief::Mcu7Bulk),
            (INFINEON, 0x027D) => Some(Belief::Deepcraft),
            (CYPRESS, 0xF151..=0xF15A) => Some(Belief::KitProg3),
            _ => None,
        }
    }

    /// In words.
    pub fn description(self) -> &'static str {
        match self {
            Belief::Mcu7Serial => "Radar Baseboard MCU7",
            Belief::Mcu7Bulk => "Radar Baseboard MCU7, bulk firmware",
            Belief::Deepcraft => "DEEPCRAFT streaming device",
            Belief::KitProg3 => "KitProg3 debug probe",
            Belief::SerialPort => "serial port",
        }
    }
}

/// Whether a device can be used.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case", tag = "state")]
pub enum Accessibility {
    /// It can be opened.
    Ready,
    /// Another program has it.
    Busy,
    /// This user may not open it.
    PermissionDenied {
        /// Line to put into a file below `/etc/udev/rules.d`.
        udev_rule: &'static str,
    },
    /// Its state cannot be told; trying is the way to find out.
    Unknown,
}

/// How a device is attached.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Transport {
    /// Serial port.
    Serial,
    /// USB device, by libusb.
    Usb,
    /// HID.
    Hid,
}

/// Something that may be a board.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Candidate {
    /// Device node.
    pub path: PathBuf,
    /// How it is attached.
    pub transport: Transport,
    /// What it is believed to be.
    pub belief: Belief,
    /// USB vendor and product, where known.
    pub usb_id: Option<(u16, u16)>,
    /// Name that the device gives itself.
    pub name: Option<String>,
    /// Whether it can be used.
    pub accessibility: Accessibility,
}

/// All candidates, in the order of their paths. Nothing is opened for longer than it takes to see whether it opens,
/// and nothing is sent. A machine without USB has none.
pub fn candidates() -> Vec<Candidate> {
    let mut found = BTreeMap::new();
    for candidate in serial_ports().into_iter().chain(usb_devices()).chain(hid_devices()) {
        found.entry(candidate.path.clone()).or_insert(candidate);
    }
    found.into_values().collect()
}

/// Whether this user may read and write a device node; nothing is opened.
fn node_access(path: &Path) -> Accessibility {
    use rustix::fs::{Access, access};
    match access(path, Access::READ_OK | Access::WRITE_OK) {
        Ok(()) => Accessibility::Ready,
        Err(rustix::io::Errno::ACCESS | rustix::io::Errno::PERM) => {
            Accessibility::PermissionDenied { udev_rule: UDEV_RULE }
        }
        Err(_) => Accessibility::Unknown,
    }
}

/// Opens a port for a moment: only that tells whether another program has it.
fn port_access(path: &Path) -> Accessibility {
    match node_access(path) {
        Accessibility::Ready => {}
        other => return other,
    }
    match serialport::new(path.to_string_lossy(), 921_600).dtr_on_open(false).open_native() {
        Ok(_) => Accessibility::Ready,
        Err(e) => match std::io::Error::from(e).kind() {
            std::io::ErrorKind::WouldBlock | std::io::ErrorKind::ResourceBusy => Accessibility::Busy,
            std::io::ErrorKind::PermissionDenied => Accessibility::PermissionDenied { udev_rule: UDEV_RULE },
            _ => Accessibility::Unknown,
        },
    }
}

/// USB ids and product name, where known.
type UsbIdentity = (Option<(u16, u16)>, Option<String>);

fn serial_ports() -> Vec<Candidate> {
    let mut ports: BTreeMap<PathBuf, UsbIdentity> = BTreeMap::new();
    for port in serialport::available_ports().unwrap_or_default() {
        if let serialport::SerialPortType::UsbPort(usb) = port.port_type {
            ports.insert(port.port_name.into(), (Some((usb.vid, usb.pid)), usb.product));
        }
    }
    for entry in std::fs::read_dir("/dev").into_iter().flatten().flatten() {
        let name = entry.file_name().to_string_lossy().into_owned();
        if name.starts_with("ttyACM") || name.starts_with("ttyUSB") {
            ports.entry(entry.path()).or_default();
        }
    }
    let candidate = |(path, (usb_id, name)): (PathBuf, UsbIdentity)| Candidate {
        accessibility: port_access(&path),
        transport: Transport::Serial,
        belief: usb_id.and_then(|(v, p)| Belief::by_usb_id(v, p)).unwrap_or(Belief::SerialPort),
        usb_id,
        name,
        path,
    };
    ports.into_iter().map(candidate).collect()
}

fn usb_devices() -> Vec<Candidate> {
    // Without a bus libusb fails to start; that is an empty bus.
    if !Path::new("/dev/bus/usb").exists() {
        return Vec::new();
    }
    let Ok(devices) = rusb::devices() else { return Vec::new() };
    let candidate = |device: rusb::Device<rusb::GlobalContext>| {
        let descriptor = device.device_descriptor().ok()?;
        let usb_id = (descriptor.vendor_id(), descriptor.product_id());
        let path = PathBuf::from(format!("/dev/bus/usb/{:03}/{:03}", device.bus_number(), device.address()));
        Some(Candidate {
            belief: Belief::by_usb_id(usb_id.0, usb_id.1)?,
            accessibility: node_access(&path),
            transport: Transport::Usb,
            usb_id: Some(usb_id),
            name: None,
            path,
        })
    };
    devices.iter().filter_map(candidate).collect()
}

fn hid_devices() -> Vec<Candidate> {
    if !Path::new("/sys/class/hidraw").exists() {
        return Vec::new();
    }
    let Ok(api) = hidapi::HidApi::new() else { return Vec::new() };
    let candidate = |device: &hidapi::DeviceInfo| {
        let path = PathBuf::from(device.path().to_string_lossy().into_owned());
        Some(Candidate {
            belief: Belief::by_usb_id(device.vendor_id(), device.product_id())?,
            accessibility: node_access(&path),
            transport: Transport::Hid,
            usb_id: Some((device.vendor_id(), device.product_id())),
            name: device.product_string().map(str::to_owned),
            path,
        })
    };
    api.device_list().filter_map(candidate).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn boards_are_known_by_their_usb_ids() {
        assert_eq!(Belief::by_usb_id(0x058B, 0x0251), Some(Belief::Mcu7Serial));
        assert_eq!(Belief::by_usb_id(0x058B, 0x027D), Some(Belief::Deepcraft));
        assert_eq!(Belief::by_usb_id(0x04B4, 0xF155), Some(Belief::KitProg3));
        assert_eq!(Belief::by_usb_id(0x04B4, 0x0001), None);
    }

    mod hard_cases {
        use super::*;

        /// With or without USB, a list comes back.
        #[test]
        fn any_machine_can_be_asked() {
            candidates();
            assert_eq!(node_access(Path::new("/dev/no-such-node")), Accessibility::Unknown);
        }
    }
}
