//! Boards and probes on this machine, including those that the user may not open.
//!
//! [`candidates`] opens nothing and sends nothing: it reads the kernel's list of devices. [`ask`] sends requests, as
//! the vendor's client does to find boards. Call it for devices with the USB ids of a board, or when the user asks for
//! it.

mod ask;
mod sysfs;
mod watch;

pub use crate::candidate::{Access, Belief, Candidate, Transport, UsbIdentity};
pub use crate::transport::{PERMISSION_REMEDY, UDEV_RULES};
pub use ask::{Identity, State, ask};
pub use sysfs::Roots;
pub use watch::{Change, Watch};

/// Lists all candidates of this machine. Nothing is opened, and nothing is sent. A machine without USB has none.
pub fn candidates() -> Vec<Candidate> {
    candidates_in(&Roots::default())
}

/// Lists all candidates below these roots, in the order of their paths.
pub fn candidates_in(roots: &Roots) -> Vec<Candidate> {
    let mut found = sysfs::serial_ports(roots);
    found.extend(sysfs::hid_devices(roots));
    // The USB device itself is listed if it is opened directly, or if no driver has created a node for it.
    let is_listed = |(device, is_probe): &(Candidate, bool)| {
        let mut nodes = found.iter().filter(|other| other.is_same_device(device));
        match device.belief {
            Belief::Mcu7Bulk => true,
            _ if *is_probe => !nodes.any(|other| other.transport == Transport::Hid),
            _ => nodes.next().is_none(),
        }
    };
    let devices: Vec<_> = sysfs::usb_devices(roots).into_iter().filter(is_listed).map(|(device, _)| device).collect();
    found.extend(devices);
    found.sort_by(|a, b| (&a.path, a.transport).cmp(&(&b.path, b.transport)));
    let probes: Vec<Candidate> = found.iter().filter(|c| c.is_probe()).cloned().collect();
    for candidate in found.iter_mut().filter(|c| !c.is_probe()) {
        candidate.debug_probe =
            probes.iter().find(|probe| candidate.is_same_kit(probe)).map(|probe| probe.path.clone());
    }
    found
}

#[cfg(test)]
mod tests {
    mod hard_cases {
        use std::path::Path;

        use crate::discover::sysfs::node_access;
        use crate::discover::{Access, Roots, candidates, candidates_in};

        #[test]
        fn candidates_are_listed_on_any_machine() {
            candidates();
            assert_eq!(node_access(Path::new("/dev/no-such-node")), Access::Absent);
            let nowhere = Roots { sys: "/no/such/sys".into(), dev: "/no/such/dev".into() };
            assert_eq!(candidates_in(&nowhere), []);
        }
    }
}
