//! Watch for devices that are plugged in and unplugged. It polls sysfs, which exists with or without a udev daemon.

use super::candidates_in;
use super::sysfs::Roots;
use crate::candidate::Candidate;

/// Change since the last poll.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Change {
    /// The device has been plugged in.
    Added(Candidate),
    /// The device has been unplugged.
    Removed(Candidate),
    /// A property of the device has changed, usually because udev has given access to it.
    Changed(Candidate),
}

/// Poller of the attached devices.
#[derive(Debug, Default)]
pub struct Watch {
    roots: Roots,
    known: Vec<Candidate>,
}

/// Returns whether both are one device that has stayed plugged in. A device that is plugged in again has another
/// address.
fn is_same(a: &Candidate, b: &Candidate) -> bool {
    (&a.path, a.transport) == (&b.path, b.transport)
        && a.usb.as_ref().map(|u| (u.bus, u.address)) == b.usb.as_ref().map(|u| (u.bus, u.address))
}

impl Watch {
    /// Creates a watch of the devices below these roots; none is known yet.
    pub fn new(roots: Roots) -> Self {
        Watch { roots, known: Vec::new() }
    }

    /// Polls the devices; returns removed ones first, then added and changed ones.
    pub fn look(&mut self) -> Vec<Change> {
        let current = candidates_in(&self.roots);
        let known = std::mem::replace(&mut self.known, current.clone());
        let removed = known.iter().filter(|old| !current.iter().any(|new| is_same(old, new)));
        let mut changes: Vec<Change> = removed.cloned().map(Change::Removed).collect();
        for new in current {
            match known.iter().find(|old| is_same(old, &new)) {
                None => changes.push(Change::Added(new)),
                Some(old) if *old != new => changes.push(Change::Changed(new)),
                Some(_) => {}
            }
        }
        changes
    }
}
