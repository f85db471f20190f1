//! Boards: a Radar Baseboard MCU7 ([`Board`]) on its serial port or its USB endpoints, a PSoC 6 kit with DEEPCRAFT
//! firmware ([`DeepcraftBoard`]), and one that only prints ([`LineStream`]).

mod address;
mod assembler;
mod deepcraft;
mod detect;
mod identify;
mod lines;
mod link;
mod reconnect;
mod stream;
pub mod wire;

use std::path::{Path, PathBuf};
use std::time::Duration;

use radome_dsp::Waveform;
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::chip::{ChipConfiguration, ChipError, SpiWord};
use crate::protocol::ascii::LineError;
use crate::protocol::mcu7::{Command, PayloadError, Status};
pub use address::Address;
pub use deepcraft::{DeepcraftBoard, DeepcraftError, DeepcraftStream};
pub use detect::Detected;
use identify::Greeting;
pub use lines::LineStream;
use link::Link;
pub use reconnect::Reconnect;
pub use stream::BoardStream;

/// Identity that a board reports. Recordings hold it under these field names.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct BoardIdentity {
    /// Name of the board.
    pub name: String,
    /// USB vendor id.
    pub vendor_id: u16,
    /// USB product id.
    pub product_id: u16,
    /// Version of the firmware: major, minor, patch.
    pub firmware_version: String,
    /// Text in which the firmware describes itself further.
    pub extended_version: String,
    /// Version of the protocol: major, minor.
    pub protocol_version: String,
    /// Unique identifier of the board, 32 hexadecimal digits; all zero where it has none.
    pub uuid: String,
    /// Name of the radar chip.
    pub chip: String,
    /// Content of the chip's CHIP_ID register.
    pub chip_id: u32,
}

/// Errors of a board and its connection.
#[derive(Debug, Error)]
pub enum BoardError {
    /// The port cannot be opened.
    #[error("{path}: cannot be opened", path = path.display())]
    Open {
        /// Name of the port or USB device.
        path: PathBuf,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// No board of this address is attached.
    #[error(
        "no board with bulk firmware (058b:0252) is attached at {path}\n\nhint: radome devices lists what is attached; boards with \
         the vendor's shipped firmware answer on serial:/dev/ttyACM0",
        path = path.display()
    )]
    Absent {
        /// Address that was asked for.
        path: PathBuf,
    },
    /// More than one board matches the address.
    #[error("{path}: more than one board would do: {}\n\nhint: name one of these", found.join(", "), path = path.display())]
    Ambiguous {
        /// Address that was asked for.
        path: PathBuf,
        /// Addresses of the boards that match.
        found: Vec<String>,
    },
    /// Another program holds the port.
    #[error("{path}: another program has this port open; close it and try again", path = path.display())]
    Busy {
        /// Name of the port or USB device.
        path: PathBuf,
    },
    /// The user may not open the port.
    #[error(
        "{path}: permission denied\n\nhint: {remedy}",
        path = path.display(),
        remedy = crate::discover::PERMISSION_REMEDY
    )]
    PermissionDenied {
        /// Name of the port or USB device.
        path: PathBuf,
    },
    /// The connection broke.
    #[error("{path}: the connection broke; was the board unplugged?", path = path.display())]
    Disconnected {
        /// Name of the port or USB device.
        path: PathBuf,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// The board did not answer a request.
    #[error("{path}: no answer to the request for {command}; is this a radar board with Strata or DEEPCRAFT firmware?", path = path.display())]
    NoAnswer {
        /// Name of the port or USB device.
        path: PathBuf,
        /// Name of the request.
        command: &'static str,
    },
    /// The board answered a request with an error status.
    #[error("{path}: the board answered {status} to the request for {command}", path = path.display())]
    Refused {
        /// Name of the port or USB device.
        path: PathBuf,
        /// Name of the request.
        command: &'static str,
        /// Status that it answered.
        status: Status,
    },
    /// An answer does not have the form of its kind.
    #[error("{path}: the answer is malformed", path = path.display())]
    Malformed {
        /// Name of the port or USB device.
        path: PathBuf,
        /// Difference from the expected form.
        source: PayloadError,
    },
    /// The firmware speaks another version of the protocol.
    #[error(
        "{path}: the firmware speaks protocol {major}.{minor}, this program speaks 4 and 3; update the board's firmware",
        path = path.display()
    )]
    Protocol {
        /// Name of the port or USB device.
        path: PathBuf,
        /// Major version.
        major: u16,
        /// Minor version.
        minor: u16,
    },
    /// The board has no radar chip that answers.
    #[error("{path}: the radar chip does not answer (CHIP_ID reads {chip_id:#08x}); check that the shield is seated", path = path.display())]
    ChipSilent {
        /// Name of the port or USB device.
        path: PathBuf,
        /// Content of its CHIP_ID register.
        chip_id: u32,
    },
    /// The board has another radar chip.
    #[error("{path}: the radar chip is {chip} (CHIP_ID {chip_id:#08x}), this program drives the BGT60TR13C", path = path.display())]
    OtherChip {
        /// Name of the port or USB device.
        path: PathBuf,
        /// Name of the chip.
        chip: &'static str,
        /// Content of its CHIP_ID register.
        chip_id: u32,
    },
    /// Another board is on the port of the one that measured.
    #[error("{path}: the board that came back is another one (UUID {found}, it was {expected}); start again to use it", path = path.display())]
    OtherBoard {
        /// Name of the port or USB device.
        path: PathBuf,
        /// UUID of the board that measured.
        expected: String,
        /// UUID of the board that is there now.
        found: String,
    },
    /// The chip cannot hold the waveform.
    #[error(transparent)]
    Chip(#[from] ChipError),
    /// The board stopped measuring by itself.
    #[error("{path}: the board stopped measuring with error code {code}", path = path.display())]
    Acquisition {
        /// Name of the port or USB device.
        path: PathBuf,
        /// Error code of the board.
        code: u32,
    },
    /// No frame came within the deadline.
    #[error("{path}: no frame for {waited:.1?}; the board has stalled", path = path.display())]
    Stalled {
        /// Name of the port or USB device.
        path: PathBuf,
        /// Time since the last frame.
        waited: Duration,
    },
    /// The board sends lines, but none is a frame of the waveform.
    #[error("{path}: no frame among its lines", path = path.display())]
    Line {
        /// Name of the port or USB device.
        path: PathBuf,
        /// Error of the last line.
        source: LineError,
    },
    /// The board does not state its waveform, and the caller gave none.
    #[error(
        "{path}: the board does not say what it measures\n\nhint: name the waveform that it was built for, with --waveform paper or --waveform FILE.toml",
        path = path.display()
    )]
    WaveformUntold {
        /// Name of the port or USB device.
        path: PathBuf,
    },
    /// An error that only DEEPCRAFT boards have.
    #[error("{path}: {source}", path = path.display())]
    Deepcraft {
        /// Name of the port or USB device.
        path: PathBuf,
        /// The error.
        source: DeepcraftError,
    },
    /// The stream was stopped before.
    #[error("the acquisition has been stopped")]
    Stopped,
}

/// Radar Baseboard MCU7 that has been identified and does not measure.
pub struct Board {
    link: Link,
    identity: BoardIdentity,
}

impl Board {
    /// Reads the identity of a board and leaves the registers of its chip as they are, so that the next client still
    /// finds the programmed waveform. Only a chip that cannot be read before its SPI is set up is written to: register
    /// SFCTL alone. A board that measures stops sending.
    ///
    /// # Errors
    /// [`BoardError`] if the port cannot be opened, if the board does not answer or answers with an error, or if its
    /// firmware or chip is not supported.
    pub fn identity_at(address: &Address) -> Result<BoardIdentity, BoardError> {
        let mut link = Link::open(address)?;
        Greeting::exchange(&mut link)?.identity(&mut link, identify::read_chip_id)
    }

    /// Opens a serial port, reads the identity of the board and resets the chip, as the vendor's client does.
    ///
    /// # Errors
    /// Those of [`Board::identity_at`].
    pub fn open(path: &Path) -> Result<Board, BoardError> {
        Board::open_at(&Address::Serial(path.into()))
    }

    /// Opens a board like [`Board::open`], on a serial port or on USB.
    ///
    /// # Errors
    /// Those of [`Board::identity_at`].
    pub fn open_at(address: &Address) -> Result<Board, BoardError> {
        let mut link = Link::open(address)?;
        let greeting = Greeting::exchange(&mut link)?;
        Board::reset(link, greeting)
    }

    /// Opens a board like [`Board::open_at`], and reads the waveform that the chip was programmed with before; `None`
    /// if it has not been programmed since it has power.
    ///
    /// # Errors
    /// Those of [`Board::identity_at`].
    pub fn open_as_left(address: &Address) -> Result<(Board, Option<Waveform>), BoardError> {
        let mut link = Link::open(address)?;
        let greeting = Greeting::exchange(&mut link)?;
        let registers = identify::read_every_register(&mut link)?;
        let waveform = ChipConfiguration::decode(&registers).ok().map(|configuration| configuration.waveform);
        Ok((Board::reset(link, greeting)?, waveform))
    }

    fn reset(mut link: Link, greeting: Greeting) -> Result<Board, BoardError> {
        identify::set_up_spi(&mut link)?;
        let identity = greeting.identity(&mut link, identify::reset_and_read_chip_id)?;
        Ok(Board { link, identity })
    }

    /// Identity that the board reports.
    pub fn identity(&self) -> &BoardIdentity {
        &self.identity
    }

    /// Path of the serial port, or name of the USB device in messages.
    pub fn path(&self) -> &Path {
        &self.link.path
    }

    /// Address under which the board is found when it has been plugged in anew.
    pub fn address(&self) -> &Address {
        &self.link.address
    }

    /// Programs the chip and starts frames. The stream's waveform has the chirp interval that the registers realise.
    ///
    /// # Errors
    /// [`BoardError::Chip`] if the registers cannot hold the waveform; else an error of the connection or of the board.
    pub fn start(self, waveform: &Waveform) -> Result<BoardStream, BoardError> {
        BoardStream::start(self, waveform, false)
    }

    /// Starts frames like [`Board::start`], with the chip's [test pattern](crate::chip::test_pattern) in place of the
    /// samples of RX1, which the waveform must have.
    ///
    /// # Errors
    /// Those of [`Board::start`].
    pub fn start_test_pattern(self, waveform: &Waveform) -> Result<BoardStream, BoardError> {
        BoardStream::start(self, waveform, true)
    }

    /// Reads registers one by one; returns 24-bit contents in the order of `addresses`.
    ///
    /// # Errors
    /// An error of the connection, or [`BoardError::Refused`].
    pub fn read_registers(&mut self, addresses: &[u8]) -> Result<Vec<u32>, BoardError> {
        let words = addresses.iter().map(|a| SpiWord::read(*a)).collect();
        let answer = self.link.demand(&Command::Execute { words, answer: true })?;
        Ok(answer.as_chunks::<4>().0.iter().map(|w| u32::from_le_bytes(*w) & 0xFF_FFFF).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::usb::UsbAddress;

    /// The address of the only board ends with a colon, and the addresses of others hold one.
    #[test]
    fn messages_name_the_board_in_every_form_of_address() {
        for (address, name) in [
            (UsbAddress::Any, "usb"),
            (UsbAddress::Device { bus: 1, address: 4 }, "usb:1-4"),
            (UsbAddress::Port { bus: 1, ports: vec![2, 3] }, "usb port 1-2.3"),
            (UsbAddress::Serial("77AB".into()), "usb:77AB"),
            (UsbAddress::Emulated("/tmp/board".into()), "usb:/tmp/board"),
        ] {
            let path = Address::Usb(address).name();
            let absent = BoardError::Absent { path: path.clone() }.to_string();
            let (sentence, hint) = absent.split_once("\n\nhint: ").expect("a hint");
            assert_eq!(sentence, format!("no board with bulk firmware (058b:0252) is attached at {name}"));
            assert!(hint.contains("radome devices"), "{hint}");
            let ambiguous =
                BoardError::Ambiguous { path: path.clone(), found: vec!["usb:1-4".into(), "usb:1-5".into()] };
            for message in [absent, ambiguous.to_string(), BoardError::Busy { path }.to_string()] {
                assert!(!message.contains("::") && message.contains(name), "{message}");
            }
        }
    }
}
