//! Access of the user to devices.

/// Udev rules that give every user access to the boards and probes: content of a file below `/etc/udev/rules.d`.
pub const UDEV_RULES: &str = include_str!("../../udev/70-radome.rules");

/// Commands that give the user access to a device.
pub const PERMISSION_REMEDY: &str = "radome board list --udev-rules | sudo tee /etc/udev/rules.d/70-radome.rules && \
                                     sudo udevadm control --reload && sudo udevadm trigger";
