//! Attached devices as the kernel lists them in sysfs.

use std::path::{Path, PathBuf};

use crate::candidate::{Access, Belief, Candidate, Transport, UsbIdentity};

/// Folders in which the kernel lists its devices.
#[derive(Debug, Clone)]
pub struct Roots {
    /// Mount point of sysfs.
    pub sys: PathBuf,
    /// Folder of the device nodes.
    pub dev: PathBuf,
}

impl Default for Roots {
    fn default() -> Self {
        Roots { sys: "/sys".into(), dev: "/dev".into() }
    }
}

/// Prefixes of the names of serial ports that a board can be on.
const SERIAL_PORTS: [&str; 2] = ["ttyACM", "ttyUSB"];
/// Part of the product's or interface's name of a CMSIS-DAP probe, by its specification.
const CMSIS_DAP: &str = "CMSIS-DAP";
/// bInterfaceClass of an interface for bulk transfers.
const VENDOR_SPECIFIC: &str = "ff";

/// Returns the access of the user to a device node; nothing is opened.
pub(super) fn node_access(path: &Path) -> Access {
    use rustix::fs::{Access as Mode, access};
    match access(path, Mode::READ_OK | Mode::WRITE_OK) {
        Ok(()) => Access::Granted,
        Err(rustix::io::Errno::ACCESS | rustix::io::Errno::PERM | rustix::io::Errno::ROFS) => Access::Denied,
        Err(_) => Access::Absent,
    }
}

/// Reads a file's text; `None` if it is absent, empty or not text.
fn text(path: &Path) -> Option<String> {
    let text = std::fs::read_to_string(path).ok()?;
    let text = text.trim();
    (!text.is_empty()).then(|| text.to_owned())
}

/// Names in a folder, sorted.
fn names(folder: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let mut names: Vec<String> = entries.filter_map(|e| e.file_name().into_string().ok()).collect();
    names.sort();
    names
}

/// Reads the descriptors of the USB device with this folder.
fn usb_identity(folder: &Path) -> Option<UsbIdentity> {
    let attribute = |name: &str| text(&folder.join(name));
    let id = |name| u16::from_str_radix(&attribute(name)?, 16).ok();
    let number = |name| attribute(name)?.parse().ok();
    Some(UsbIdentity {
        vendor_id: id("idVendor")?,
        product_id: id("idProduct")?,
        manufacturer: attribute("manufacturer"),
        product: attribute("product"),
        serial_number: attribute("serial"),
        bus: number("busnum").unwrap_or(0),
        address: number("devnum").unwrap_or(0),
        socket: folder.file_name()?.to_str()?.to_owned(),
    })
}

/// Finds the folder of a device of a class, and the folder of its USB device if it has one.
fn device_of(roots: &Roots, class: &str, name: &str) -> Option<(PathBuf, Option<UsbIdentity>)> {
    let folder = roots.sys.join("class").join(class).join(name).join("device").canonicalize().ok()?;
    let usb = folder.ancestors().find_map(usb_identity);
    Some((folder, usb))
}

/// Kind of a USB device with known ids.
fn belief(usb: Option<&UsbIdentity>) -> Option<Belief> {
    usb.and_then(|usb| Belief::by_usb_id(usb.vendor_id, usb.product_id))
}

fn candidate(path: PathBuf, transport: Transport, belief: Belief, usb: Option<UsbIdentity>) -> Candidate {
    Candidate { access: node_access(&path), path, transport, belief, usb, debug_probe: None }
}

/// Lists serial ports that a board can be on.
pub(super) fn serial_ports(roots: &Roots) -> Vec<Candidate> {
    let port = |name: String| {
        let (_, usb) = device_of(roots, "tty", &name)?;
        let belief = belief(usb.as_ref()).unwrap_or(Belief::SerialPort);
        Some(candidate(roots.dev.join(name), Transport::Serial, belief, usb))
    };
    let is_port = |name: &String| SERIAL_PORTS.iter().any(|prefix| name.starts_with(prefix));
    names(&roots.sys.join("class/tty")).into_iter().filter(is_port).filter_map(port).collect()
}

/// Lists debug probes that are HID devices.
pub(super) fn hid_devices(roots: &Roots) -> Vec<Candidate> {
    let device = |name: String| {
        let (folder, usb) = device_of(roots, "hidraw", &name)?;
        let usb = usb?;
        let interface = folder.parent().and_then(|interface| text(&interface.join("interface")));
        let is_probe = [&usb.product, &interface].into_iter().flatten().any(|name| name.contains(CMSIS_DAP));
        let belief = belief(Some(&usb)).or(is_probe.then_some(Belief::DebugProbe))?;
        Some(candidate(roots.dev.join(name), Transport::Hid, belief, Some(usb)))
    };
    names(&roots.sys.join("class/hidraw")).into_iter().filter_map(device).collect()
}

/// Returns whether a USB device has a vendor-specific interface whose name marks it as a debug probe with bulk
/// transfers.
fn has_bulk_probe(folder: &Path) -> bool {
    let is_bulk_probe = |name: String| {
        let interface = folder.join(name);
        text(&interface.join("bInterfaceClass")).is_some_and(|class| class == VENDOR_SPECIFIC)
            && text(&interface.join("interface")).is_some_and(|name| name.contains(CMSIS_DAP))
    };
    names(folder).into_iter().filter(|name| name.contains(':')).any(is_bulk_probe)
}

/// Lists USB devices with known ids, and debug probes. The flag marks probes with bulk transfers.
pub(super) fn usb_devices(roots: &Roots) -> Vec<(Candidate, bool)> {
    let device = |name: String| {
        let folder = roots.sys.join("bus/usb/devices").join(name);
        let usb = usb_identity(&folder)?;
        let path = roots.dev.join(format!("bus/usb/{:03}/{:03}", usb.bus, usb.address));
        let is_probe = has_bulk_probe(&folder);
        let belief = belief(Some(&usb)).or(is_probe.then_some(Belief::DebugProbe))?;
        Some((candidate(path, Transport::Usb, belief, Some(usb)), is_probe))
    };
    names(&roots.sys.join("bus/usb/devices")).into_iter().filter_map(device).collect()
}
