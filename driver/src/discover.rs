//! Boards and probes on this machine, including those that this user may not open.

/// Gives every user access to the vendor's boards and to debug probes.
pub const UDEV_RULE: &str =
    "/etc/udev/rules.d/70-radome.rules: SUBSYSTEMS==\"usb\", ATTRS{idVendor}==\"058b\", MODE=\"0666\"";
