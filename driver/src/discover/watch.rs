//! What is plugged and unplugged, by looking again and again: sysfs is there wherever the kernel is, with or without a udev
//! daemon to listen to.

use super::{Candidate, Roots, candidates_in};

/// What has changed since the last look.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Change {
    /// It has been plugged in.
    Added(Candidate),
    /// It has been unplugged.
    Removed(Candidate),
    /// Something about it has changed: mostly udev has given access to it.
    Changed(Candidate),
}

/// Looks at the devices from time to time.
#[derive(Debug, Default)]
pub struct Watch {
    roots: Roots,
    known: Vec<Candidate>,
}

/// Whether both are one device in one stay: plugged in anew it has another address.
fn is_same(a: &Candidate, b: &Candidate) -> bool {
    (&a.path, a.transport) == (&b.path, b.transport)
        && a.usb.as_ref().map(|u| (u.bus, u.address)) == b.usb.as_ref().map(|u| (u.bus, u.address))
}

impl Watch {
    /// Of the devices below these roots, none of which is known yet.
    pub fn new(roots: Roots) -> Self {
        Watch { roots, known: Vec::new() }
    }

    /// Looks: what has gone first, then what has come or changed.
    pub fn look(&mut self) -> Vec<Change> {
        let now = candidates_in(&self.roots);
        let known = std::mem::replace(&mut self.known, now.clone());
        let removed = known.iter().filter(|old| !now.iter().any(|new| is_same(old, new)));
        let mut changes: Vec<Change> = removed.cloned().map(Change::Removed).collect();
        for new in now {
            match known.iter().find(|old| is_same(old, &new)) {
                None => changes.push(Change::Added(new)),
                Some(old) if *old != new => changes.push(Change::Changed(new)),
                Some(_) => {}
            }
        }
        changes
    }
}
