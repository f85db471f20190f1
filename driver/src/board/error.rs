//! Errors of boards.

mod deepcraft;

use std::path::PathBuf;
use std::time::Duration;

pub use deepcraft::DeepcraftError;
use thiserror::Error;

use crate::chip::ChipError;
use crate::protocol::ascii::LineError;
use crate::protocol::mcu7::{PayloadError, Status};
use crate::transport::usb::OpenError;
use crate::transport::{UsbAddress, UsbAddressError};

/// Errors of a board and its connection.
#[derive(Debug, Error)]
#[allow(missing_docs, reason = "the message says what each field is")]
pub enum BoardError {
    /// The port cannot be opened.
    #[error("{path}: cannot be opened\n\nhint: radome board list lists the ports of boards")]
    Open { path: PathBuf, source: std::io::Error },
    /// No board of this address is attached.
    #[error(
        "no board with bulk firmware (058b:0252) is attached at {path}\n\nhint: radome board list lists what is attached; boards with \
         the vendor's shipped firmware answer on serial:/dev/ttyACM0"
    )]
    Absent { path: PathBuf },
    /// More than one board matches the address.
    #[error("{path}: more than one board would do: {}\n\nhint: name one of these", found.join(", "))]
    Ambiguous { path: PathBuf, found: Vec<String> },
    /// Another program holds the port.
    #[error("{path}: another program has this port open; close it and try again")]
    Busy { path: PathBuf },
    /// The user may not open the port.
    #[error(
        "{path}: permission denied\n\nhint: {remedy}; for a serial port of another board, such as an ESP32: \
         sudo usermod -aG dialout \"$USER\", and log in again",
        remedy = crate::transport::PERMISSION_REMEDY
    )]
    PermissionDenied { path: PathBuf },
    /// The connection broke.
    #[error("{path}: the connection broke; was the board unplugged?")]
    Disconnected { path: PathBuf, source: std::io::Error },
    /// The board did not answer a request.
    #[error("{path}: no answer to the request for {command}; is this a radar board with Strata or DEEPCRAFT firmware?")]
    NoAnswer { path: PathBuf, command: &'static str },
    /// The board answered a request with an error status.
    #[error("{path}: the board answered {status} to the request for {command}")]
    Refused { path: PathBuf, command: &'static str, status: Status },
    /// An answer does not have the form of its kind.
    #[error("{path}: the answer is malformed")]
    Malformed { path: PathBuf, source: PayloadError },
    /// The firmware speaks another version of the protocol.
    #[error(
        "{path}: the firmware speaks protocol {major}.{minor}, this program speaks 4 and 3; update the board's firmware"
    )]
    Protocol { path: PathBuf, major: u16, minor: u16 },
    /// The board has no radar chip that answers.
    #[error("{path}: the radar chip does not answer (CHIP_ID reads {chip_id:#08x}); check that the shield is seated")]
    ChipSilent { path: PathBuf, chip_id: u32 },
    /// The board has another radar chip.
    #[error("{path}: the radar chip is {chip} (CHIP_ID {chip_id:#08x}), this program drives the BGT60TR13C")]
    OtherChip { path: PathBuf, chip: &'static str, chip_id: u32 },
    /// Another board is on the port of the one that measured.
    #[error("{path}: the board that came back is another one (UUID {found}, it was {expected}); start again to use it")]
    OtherBoard { path: PathBuf, expected: String, found: String },
    /// The chip cannot hold the waveform.
    #[error(transparent)]
    Chip(#[from] ChipError),
    /// The board stopped measuring by itself.
    #[error("{path}: the board stopped measuring with error code {code}")]
    Acquisition { path: PathBuf, code: u32 },
    /// The board was started anew many times, and no frame came.
    #[error(
        "{path}: the board has been started {restarts} times and sends no whole frame ({reason})\n\n\
         hint: lengthen frame_interval_s or take fewer chirps, samples or receivers, so that the connection carries \
         the frames; or connect the board without a hub"
    )]
    NoFrame { path: PathBuf, restarts: u32, reason: &'static str },
    /// No frame came within the deadline.
    #[error("{path}: no frame for {waited:.1?}; the board has stalled")]
    Stalled { path: PathBuf, waited: Duration },
    /// The board sends lines, but none is a frame of the waveform.
    #[error("{path}: no frame among its lines")]
    Line { path: PathBuf, source: LineError },
    /// No board is attached.
    #[error("no board is attached\n\nhint: radome board list says what was found; emulated:SCENE.toml needs no board")]
    NoneAttached,
    /// More than one board is attached.
    #[error(
        "more than one board is attached\n\nhint: name one with serial:PORT; radome board list and, in Python, radome.boards() list them"
    )]
    SeveralAttached,
    /// A text is not the address of a USB device.
    #[error(transparent)]
    UsbAddress(#[from] UsbAddressError),
    /// The board has no waveform yet, and the caller gave none.
    #[error("{lack}\n\nhint: name one with --waveform {example}, in Python with waveform=")]
    NoWaveform { lack: &'static str, example: &'static str },
    /// The board does not state its waveform, and the caller gave none.
    #[error(
        "{path}: the board does not say what it measures\n\nhint: name the waveform that it was built for, with --waveform paper or --waveform FILE.toml"
    )]
    WaveformUnknown { path: PathBuf },
    /// The waveform that the board states cannot be used.
    #[error(
        "{path}: the board states a waveform that cannot be used: {reason}\n\nhint: mend the firmware's line `Waveform: {{...}}`, or name the \
         waveform that it was built for, with --waveform FILE.toml"
    )]
    WaveformStated { path: PathBuf, reason: String },
    /// An error that only DEEPCRAFT boards have.
    #[error("{path}: {source}")]
    Deepcraft { path: PathBuf, source: DeepcraftError },
    /// The stream was stopped before.
    #[error("the acquisition has been stopped")]
    Stopped,
}

impl BoardError {
    /// Converts the error of opening the port or device `path`.
    pub(super) fn opening(path: PathBuf, error: OpenError) -> BoardError {
        match error {
            OpenError::Absent => BoardError::Absent { path },
            OpenError::Ambiguous(found) => {
                BoardError::Ambiguous { path, found: found.iter().map(UsbAddress::to_string).collect() }
            }
            OpenError::Busy => BoardError::Busy { path },
            OpenError::PermissionDenied => BoardError::PermissionDenied { path },
            OpenError::Other(source) => BoardError::Open { path, source },
        }
    }

    /// Returns whether opening the port again may remove the error. A port that has just come back may lack its
    /// permissions for a moment, so that [`BoardError::PermissionDenied`] counts too.
    pub fn is_transient(&self) -> bool {
        match self {
            BoardError::Open { .. }
            | BoardError::Absent { .. }
            | BoardError::Busy { .. }
            | BoardError::PermissionDenied { .. }
            | BoardError::Disconnected { .. }
            | BoardError::NoAnswer { .. }
            | BoardError::Refused { .. }
            | BoardError::Malformed { .. }
            | BoardError::ChipSilent { .. }
            | BoardError::Acquisition { .. }
            | BoardError::NoFrame { .. }
            | BoardError::Stalled { .. } => true,
            BoardError::Deepcraft { source, .. } => source.is_transient(),
            BoardError::Protocol { .. }
            | BoardError::OtherChip { .. }
            | BoardError::OtherBoard { .. }
            | BoardError::Ambiguous { .. }
            | BoardError::Chip(_)
            | BoardError::Line { .. }
            | BoardError::NoneAttached
            | BoardError::SeveralAttached
            | BoardError::UsbAddress(_)
            | BoardError::NoWaveform { .. }
            | BoardError::WaveformUnknown { .. }
            | BoardError::WaveformStated { .. }
            | BoardError::Stopped => false,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::transport::Address;

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
            assert!(hint.contains("radome board list"), "{hint}");
            let ambiguous =
                BoardError::Ambiguous { path: path.clone(), found: vec!["usb:1-4".into(), "usb:1-5".into()] };
            for message in [absent, ambiguous.to_string(), BoardError::Busy { path }.to_string()] {
                assert!(!message.contains("::") && message.contains(name), "{message}");
            }
        }
    }
}
