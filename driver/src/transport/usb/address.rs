//! Addresses of USB devices.

use std::fmt;
use std::path::PathBuf;
use std::str::FromStr;

use thiserror::Error;

/// Address of an attached device. As text: empty (the only one), `1-4` (bus and address, as `lsusb` shows them), a
/// serial number, or the folder of an emulated board, which contains a slash.
#[derive(Debug, Clone, PartialEq, Eq)]
#[allow(missing_docs, reason = "each variant says what its fields are")]
pub enum UsbAddress {
    /// The only attached device.
    Any,
    /// Device with this bus and address. The address is another one each time the device is plugged in.
    Device { bus: u8, address: u8 },
    /// Device in this socket, given by the bus and the port of each hub on the way.
    Port { bus: u8, ports: Vec<u8> },
    /// Device with this serial number.
    Serial(String),
    /// Emulated board, given by the folder in which its endpoints are sockets.
    Emulated(PathBuf),
}

/// Error of a text that is not an address.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error(
    "usb:{text}: bus and address are 1 to 255\n\nhint: usb: is the only board, usb:1-4 is bus 1, address 4 (lsusb), usb:SERIAL goes by serial number"
)]
pub struct UsbAddressError {
    text: String,
}

impl FromStr for UsbAddress {
    type Err = UsbAddressError;

    fn from_str(text: &str) -> Result<Self, UsbAddressError> {
        if text.is_empty() {
            return Ok(UsbAddress::Any);
        }
        if text.contains('/') {
            return Ok(UsbAddress::Emulated(text.into()));
        }
        let is_number = |t: &str| !t.is_empty() && t.bytes().all(|b| b.is_ascii_digit());
        match text.split_once('-') {
            Some((bus, address)) if is_number(bus) && is_number(address) => {
                let number = |t: &str| t.parse::<u8>().ok().filter(|n| *n > 0);
                match (number(bus), number(address)) {
                    (Some(bus), Some(address)) => Ok(UsbAddress::Device { bus, address }),
                    _ => Err(UsbAddressError { text: text.into() }),
                }
            }
            _ => Ok(UsbAddress::Serial(text.to_owned())),
        }
    }
}

impl UsbAddress {
    /// Name of the address in messages, where a colon may follow.
    pub(crate) fn name(&self) -> PathBuf {
        match self {
            UsbAddress::Any => "usb".into(),
            other => other.to_string().into(),
        }
    }
}

impl fmt::Display for UsbAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            UsbAddress::Any => write!(f, "usb:"),
            UsbAddress::Device { bus, address } => write!(f, "usb:{bus}-{address}"),
            UsbAddress::Port { bus, ports } => {
                let ports: Vec<String> = ports.iter().map(u8::to_string).collect();
                write!(f, "usb port {bus}-{}", ports.join("."))
            }
            UsbAddress::Serial(serial) => write!(f, "usb:{serial}"),
            UsbAddress::Emulated(folder) => write!(f, "usb:{}", folder.display()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_form_round_trips() {
        for (text, expected) in [
            ("", UsbAddress::Any),
            ("1-4", UsbAddress::Device { bus: 1, address: 4 }),
            ("001-012", UsbAddress::Device { bus: 1, address: 12 }),
            ("0A1B-77", UsbAddress::Serial("0A1B-77".into())),
            ("12345", UsbAddress::Serial("12345".into())),
            ("/tmp/board", UsbAddress::Emulated("/tmp/board".into())),
        ] {
            let address: UsbAddress = text.parse().expect(text);
            assert_eq!(address, expected);
            let again = address.to_string().strip_prefix("usb:").expect("usb:").parse();
            assert_eq!(again, Ok(expected));
        }
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn invalid_buses_and_addresses_are_refused() {
            for text in ["0-4", "1-0", "1-256", "99999-1"] {
                assert!(text.parse::<UsbAddress>().is_err(), "{text}");
            }
        }
    }
}
