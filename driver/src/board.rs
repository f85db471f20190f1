//! Boards: a Radar Baseboard MCU7 ([`Board`]) on its serial port or its USB endpoints, a PSoC 6 kit with DEEPCRAFT firmware
//! ([`DeepcraftBoard`]), and one that only prints ([`LineStream`]).

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

use crate::chip::{ChipConfiguration, ChipError};
use crate::protocol::ascii::LineError;
use crate::protocol::strata::{Command, PayloadError, SpiWord, Status};
pub use address::Address;
pub use deepcraft::{DeepcraftBoard, DeepcraftError, DeepcraftStream};
pub use detect::Detected;
pub(crate) use identify::CHIP_ID_BGT60TR13C;
use identify::{Greeting, chip_name};
pub use lines::LineStream;
use link::Link;
pub use reconnect::Reconnect;
pub use stream::BoardStream;

/// Who a board says it is. Written into recordings with these names.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct BoardIdentity {
    /// Name of the board.
    pub name: String,
    /// USB vendor.
    pub vendor_id: u16,
    /// USB product.
    pub product_id: u16,
    /// Firmware: major, minor, patch.
    pub firmware_version: String,
    /// What the firmware says of itself beyond that.
    pub extended_version: String,
    /// Protocol: major, minor.
    pub protocol_version: String,
    /// Identity of this very board, 32 hexadecimal digits; all zero where it has none.
    pub uuid: String,
    /// Radar chip.
    pub chip: String,
    /// Content of the chip's CHIP_ID register.
    pub chip_id: u32,
}

/// What can go wrong with a board.
#[derive(Debug, Error)]
pub enum BoardError {
    /// The port cannot be opened.
    #[error("{path}: cannot be opened", path = path.display())]
    Open {
        /// Port.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// No such board is attached.
    #[error(
        "no board with bulk firmware (058b:0252) is attached at {path}\n\nhint: radome devices lists what is attached; boards with \
         the vendor's shipped firmware answer on serial:/dev/ttyACM0",
        path = path.display()
    )]
    Absent {
        /// What was asked for.
        path: PathBuf,
    },
    /// More than one board would do.
    #[error("{path}: more than one board would do: {}\n\nhint: name one of these", found.join(", "), path = path.display())]
    Ambiguous {
        /// What was asked for.
        path: PathBuf,
        /// Those that are there.
        found: Vec<String>,
    },
    /// Another program has it.
    #[error("{path}: another program has this port open; close it and try again", path = path.display())]
    Busy {
        /// Port.
        path: PathBuf,
    },
    /// This user may not.
    #[error(
        "{path}: permission denied\n\nhint: {remedy}",
        path = path.display(),
        remedy = crate::discover::PERMISSION_REMEDY
    )]
    PermissionDenied {
        /// Port.
        path: PathBuf,
    },
    /// The port has gone.
    #[error("{path}: the connection broke; was the board unplugged?", path = path.display())]
    Disconnected {
        /// Port.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// Nothing came back.
    #[error("{path}: no answer to the request for {command}; is this a radar board with Strata or DEEPCRAFT firmware?", path = path.display())]
    NoAnswer {
        /// Port.
        path: PathBuf,
        /// Request.
        command: &'static str,
    },
    /// The board said no.
    #[error("{path}: the board answered {status} to the request for {command}", path = path.display())]
    Refused {
        /// Port.
        path: PathBuf,
        /// Request.
        command: &'static str,
        /// Its answer.
        status: Status,
    },
    /// The answer makes no sense.
    #[error("{path}: the answer is malformed", path = path.display())]
    Malformed {
        /// Port.
        path: PathBuf,
        /// How.
        source: PayloadError,
    },
    /// The firmware speaks another protocol.
    #[error(
        "{path}: the firmware speaks protocol {major}.{minor}, this program speaks 4 and 3; update the board's firmware",
        path = path.display()
    )]
    Protocol {
        /// Port.
        path: PathBuf,
        /// Major version.
        major: u16,
        /// Minor version.
        minor: u16,
    },
    /// The board has no radar chip that answers.
    #[error("{path}: the radar chip does not answer (CHIP_ID reads {chip_id:#08x}); check that the shield is seated", path = path.display())]
    ChipSilent {
        /// Port.
        path: PathBuf,
        /// What its register reads.
        chip_id: u32,
    },
    /// The board has another radar chip.
    #[error("{path}: the radar chip is {chip} (CHIP_ID {chip_id:#08x}), this program drives the BGT60TR13C", path = path.display())]
    OtherChip {
        /// Port.
        path: PathBuf,
        /// Its name.
        chip: &'static str,
        /// What its register reads.
        chip_id: u32,
    },
    /// Another board has taken the place of the one that measured.
    #[error("{path}: the board that came back is another one (UUID {found}, it was {expected}); start again to use it", path = path.display())]
    OtherBoard {
        /// Port.
        path: PathBuf,
        /// UUID of the board that measured.
        expected: String,
        /// UUID of the board that is there now.
        found: String,
    },
    /// The waveform does not fit the chip.
    #[error(transparent)]
    Chip(#[from] ChipError),
    /// The board gave up measuring.
    #[error("{path}: the board stopped measuring with error code {code}", path = path.display())]
    Acquisition {
        /// Port.
        path: PathBuf,
        /// Its code.
        code: u32,
    },
    /// Frames ceased to come.
    #[error("{path}: no frame for {waited:.1?}; the board has stalled", path = path.display())]
    Stalled {
        /// Port.
        path: PathBuf,
        /// How long was waited.
        waited: Duration,
    },
    /// Lines come, but none that is a frame of the waveform.
    #[error("{path}: no frame among its lines", path = path.display())]
    Line {
        /// Port.
        path: PathBuf,
        /// What was wrong with the last one.
        source: LineError,
    },
    /// Nobody says what is measured.
    #[error(
        "{path}: the board does not say what it measures\n\nhint: name the waveform that it was built for, with --waveform paper or --waveform FILE.toml",
        path = path.display()
    )]
    WaveformUntold {
        /// Port.
        path: PathBuf,
    },
    /// What only DEEPCRAFT boards do.
    #[error("{path}: {source}", path = path.display())]
    Deepcraft {
        /// Port.
        path: PathBuf,
        /// What it is.
        source: DeepcraftError,
    },
    /// The acquisition has ended.
    #[error("the acquisition has been stopped")]
    Stopped,
}

/// A board that has been identified and does not measure.
pub struct Board {
    link: Link,
    identity: BoardIdentity,
}

impl Board {
    /// Asks a board who it is and leaves its chip as it is: whoever opens the board next still finds what the chip was
    /// programmed with. Only a chip that cannot be read before its SPI is set up is written to, the one register of the SPI and
    /// the FIFO. A board that measures is stopped from sending.
    pub fn identity_at(address: &Address) -> Result<BoardIdentity, BoardError> {
        let mut link = Link::open(address)?;
        Greeting::exchange(&mut link)?.identity(&mut link, identify::read_chip_id)
    }

    /// Opens a serial port, asks what is there and resets the chip, as the vendor's client does.
    pub fn open(path: &Path) -> Result<Board, BoardError> {
        Board::open_at(&Address::Serial(path.into()))
    }

    /// Like [`Board::open`], wherever the board is.
    pub fn open_at(address: &Address) -> Result<Board, BoardError> {
        let mut link = Link::open(address)?;
        let greeting = Greeting::exchange(&mut link)?;
        Board::reset(link, greeting)
    }

    /// Like [`Board::open_at`], and reads from the chip what it was programmed with before: nothing since it has power, or
    /// the waveform of the program that used it last.
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

    /// Who the board says it is.
    pub fn identity(&self) -> &BoardIdentity {
        &self.identity
    }

    /// Port that it is on, or what names it on USB.
    pub fn path(&self) -> &Path {
        &self.link.path
    }

    /// Where it is to be looked for when it has been plugged in anew.
    pub fn address(&self) -> &Address {
        &self.link.address
    }

    /// Programs the chip and starts measuring. The stream's waveform has the chirp interval that the registers realise.
    pub fn start(self, waveform: &Waveform) -> Result<BoardStream, BoardError> {
        BoardStream::start(self, waveform, false)
    }

    /// Like [`Board::start`], but the chip sends its [test pattern](crate::chip::test_pattern) as the samples of RX1,
    /// which the waveform must have.
    pub fn start_test_pattern(self, waveform: &Waveform) -> Result<BoardStream, BoardError> {
        BoardStream::start(self, waveform, true)
    }

    /// Contents of registers, read one by one.
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
