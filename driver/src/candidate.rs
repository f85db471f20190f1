//! Devices that may be boards or debug probes, as the kernel lists them.

use std::path::PathBuf;

use serde::Serialize;

use crate::transport::{Address, UsbAddress};

const INFINEON: u16 = 0x058B;
const CYPRESS: u16 = 0x04B4;

/// Kind of a device, by its USB ids.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Belief {
    /// Radar Baseboard MCU7, serial.
    Mcu7Serial,
    /// Radar Baseboard MCU7 with the firmware's bulk variant.
    Mcu7Bulk,
    /// PSoC 6 kit with DEEPCRAFT streaming firmware.
    Deepcraft,
    /// KitProg3 of a PSoC 6 kit: a debug probe, and a serial port beside it.
    KitProg3,
    /// Another CMSIS-DAP debug probe.
    DebugProbe,
    /// Serial port of an unknown device: only a request can tell whether it is a board.
    SerialPort,
}

impl Belief {
    pub(crate) fn by_usb_id(vendor_id: u16, product_id: u16) -> Option<Self> {
        match (vendor_id, product_id) {
            (INFINEON, 0x0251) => Some(Belief::Mcu7Serial),
            (INFINEON, 0x0252) => Some(Belief::Mcu7Bulk),
            (INFINEON, 0x027D) => Some(Belief::Deepcraft),
            (CYPRESS, 0xF151 | 0xF152 | 0xF154 | 0xF155 | 0xF166) => Some(Belief::KitProg3),
            _ => None,
        }
    }

    /// Description for lists.
    pub fn description(self) -> &'static str {
        match self {
            Belief::Mcu7Serial => "Radar Baseboard MCU7",
            Belief::Mcu7Bulk => "Radar Baseboard MCU7, bulk firmware",
            Belief::Deepcraft => "DEEPCRAFT streaming device",
            Belief::KitProg3 => "KitProg3",
            Belief::DebugProbe => "CMSIS-DAP debug probe",
            Belief::SerialPort => "serial port",
        }
    }
}

/// Access of the user to a device node.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Access {
    /// The node may be read and written.
    Granted,
    /// The node may not be read and written.
    Denied,
    /// The node does not exist.
    Absent,
}

/// Transport by which a device is attached.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Transport {
    /// Serial port.
    Serial,
    /// HID.
    Hid,
    /// USB device, by libusb.
    Usb,
}

/// Descriptors of a USB device.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct UsbIdentity {
    /// Vendor id.
    pub vendor_id: u16,
    /// Product id.
    pub product_id: u16,
    /// Name of the vendor.
    pub manufacturer: Option<String>,
    /// Name of the product.
    pub product: Option<String>,
    /// Serial number.
    pub serial_number: Option<String>,
    /// Number of the bus.
    pub bus: u8,
    /// Address on the bus, which changes each time the device is plugged in.
    pub address: u8,
    /// Socket of the device, as the kernel names it: `1-1.2` is bus 1, port 1, port 2 of the hub there.
    pub socket: String,
}

/// Device that may be a board or its probe.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Candidate {
    /// Device node.
    pub path: PathBuf,
    /// Transport by which it is attached.
    pub transport: Transport,
    /// Kind of the device by its ids.
    pub belief: Belief,
    /// USB device that it belongs to, if any.
    pub usb: Option<UsbIdentity>,
    /// Device node of the debug probe of the same kit, which can reset it.
    pub debug_probe: Option<PathBuf>,
    /// Access of the user to it.
    #[serde(skip)]
    pub access: Access,
}

impl Candidate {
    /// Address of the board; `None` if the device is not a supported board.
    pub fn address(&self) -> Option<Address> {
        match (self.belief, self.transport, &self.usb) {
            (Belief::Mcu7Serial | Belief::Deepcraft, Transport::Serial, _) => Some(Address::Serial(self.path.clone())),
            (Belief::Mcu7Bulk, Transport::Usb, Some(usb)) => {
                Some(Address::Usb(UsbAddress::Device { bus: usb.bus, address: usb.address }))
            }
            _ => None,
        }
    }

    /// Returns whether it is a debug probe itself, and not the serial port beside one.
    pub fn is_probe(&self) -> bool {
        matches!(self.belief, Belief::KitProg3 | Belief::DebugProbe) && self.transport != Transport::Serial
    }

    /// Returns whether both belong to one USB device.
    pub(crate) fn is_same_device(&self, other: &Candidate) -> bool {
        self.usb.as_ref().zip(other.usb.as_ref()).is_some_and(|(a, b)| a.socket == b.socket)
    }

    /// Returns whether both belong to one kit: one USB device, or two devices with one serial number.
    pub(crate) fn is_same_kit(&self, other: &Candidate) -> bool {
        let serial_number = |c: &Candidate| c.usb.as_ref().and_then(|usb| usb.serial_number.clone());
        self.is_same_device(other) || serial_number(self).is_some_and(|serial| Some(serial) == serial_number(other))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::transport::{PERMISSION_REMEDY, UDEV_RULES};

    #[test]
    fn boards_are_known_by_their_usb_ids() {
        assert_eq!(Belief::by_usb_id(0x058B, 0x0251), Some(Belief::Mcu7Serial));
        assert_eq!(Belief::by_usb_id(0x058B, 0x027D), Some(Belief::Deepcraft));
        assert_eq!(Belief::by_usb_id(0x04B4, 0xF155), Some(Belief::KitProg3));
        assert_eq!(Belief::by_usb_id(0x04B4, 0x0001), None);
    }

    #[test]
    fn the_udev_rules_name_every_known_device() {
        let is_listed = |vendor: u16, product: u16| {
            UDEV_RULES.lines().any(|line| {
                line.contains(&format!("{{idVendor}}==\"{vendor:04x}\"")) && line.contains(&format!("{product:04x}"))
            })
        };
        for (vendor, product) in [INFINEON, CYPRESS].iter().flat_map(|v| (0..=u16::MAX).map(move |p| (*v, p))) {
            if Belief::by_usb_id(vendor, product).is_some() {
                assert!(is_listed(vendor, product), "{vendor:04x}:{product:04x}");
            }
        }
        assert!(UDEV_RULES.contains(PERMISSION_REMEDY.split(" && ").next().expect("a command")));
    }
}
