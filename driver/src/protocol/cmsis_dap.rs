//! The commands of a CMSIS-DAP debug probe that identify it and reset its target (Arm's CMSIS-DAP specification,
//! version 2).
//!
//! A command is one packet; its first byte is the code, and the answer begins with the same byte. Over HID a packet is
//! a report, padded with zeros; over bulk transfers it is a transfer.

use thiserror::Error;

/// Bit of the nRESET line in [`Command::Pins`].
pub const NRESET: u8 = 1 << 7;
/// Bytes of a report of a full-speed HID probe.
pub const HID_PACKET: usize = 64;
/// Longest packet: the most that a high-speed probe may send in one bulk transfer.
pub const MAX_PACKET: usize = 512;

/// Property of a probe that DAP_Info reads.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Info {
    /// Vendor's name.
    Vendor,
    /// Product's name.
    Product,
    /// Serial number.
    SerialNumber,
    /// Version of the protocol; in early probes the version of the firmware.
    ProtocolVersion,
    /// Version of the product's firmware; probes from before protocol 2.1 have none.
    FirmwareVersion,
    /// Capabilities: bit 0 SWD, bit 1 JTAG.
    Capabilities,
}

impl Info {
    /// All properties.
    pub const ALL: [Info; 6] = [
        Info::Vendor,
        Info::Product,
        Info::SerialNumber,
        Info::ProtocolVersion,
        Info::FirmwareVersion,
        Info::Capabilities,
    ];

    fn code(self) -> u8 {
        match self {
            Info::Vendor => 0x01,
            Info::Product => 0x02,
            Info::SerialNumber => 0x03,
            Info::ProtocolVersion => 0x04,
            Info::FirmwareVersion => 0x09,
            Info::Capabilities => 0xF0,
        }
    }
}

/// Command of a host.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[allow(missing_docs, reason = "each variant says what its fields are")]
pub enum Command {
    /// DAP_Info.
    Info(Info),
    /// DAP_Connect by the probe's default port.
    Connect,
    /// DAP_Disconnect.
    Disconnect,
    /// DAP_ResetTarget: runs the probe's own reset sequence for its target.
    ResetTarget,
    /// DAP_SWJ_Pins: sets the selected pins to these levels and waits until they have them, at most `wait_us`.
    Pins { output: u8, select: u8, wait_us: u32 },
}

const INFO: u8 = 0x00;
const CONNECT: u8 = 0x02;
const DISCONNECT: u8 = 0x03;
const RESET_TARGET: u8 = 0x0A;
const PINS: u8 = 0x10;
/// Code of the answer to an unknown command.
pub const INVALID: u8 = 0xFF;
const OK: u8 = 0;

/// Answer of a probe, with borrowed data.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[allow(missing_docs, reason = "each variant says what its fields are")]
pub enum Answer<'a> {
    /// Answer to [`Command::Info`]: a text, with or without its NUL, or numbers.
    Info(&'a [u8]),
    /// Answer to [`Command::Connect`]: 1 SWD, 2 JTAG, 0 failed.
    Port(u8),
    /// Answer to [`Command::Disconnect`]: whether the probe has disconnected.
    Disconnected(bool),
    /// Answer to [`Command::ResetTarget`]: whether the probe has not failed, and whether it has a reset sequence for
    /// its target.
    Reset { is_ok: bool, is_implemented: bool },
    /// Answer to [`Command::Pins`]: the levels of all pins.
    Pins(u8),
}

/// Error of an answer that does not belong to the command.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[allow(missing_docs, reason = "the message says what each field is")]
pub enum AnswerError {
    /// The probe does not know the command.
    #[error("CMSIS-DAP: the probe does not know command {command:#04x}")]
    Unknown { command: u8 },
    /// The answer belongs to another command.
    #[error("CMSIS-DAP: an answer to command {got:#04x}, expected one to {expected:#04x}")]
    Other { got: u8, expected: u8 },
    /// The answer is too short.
    #[error("CMSIS-DAP: the answer to command {command:#04x} has {got} bytes, it lacks some")]
    Short { command: u8, got: usize },
}

impl Command {
    fn code(self) -> u8 {
        match self {
            Command::Info(_) => INFO,
            Command::Connect => CONNECT,
            Command::Disconnect => DISCONNECT,
            Command::ResetTarget => RESET_TARGET,
            Command::Pins { .. } => PINS,
        }
    }

    /// Encodes the packet.
    pub fn encode(self) -> Vec<u8> {
        let mut bytes = vec![self.code()];
        match self {
            Command::Info(info) => bytes.push(info.code()),
            Command::Connect => bytes.push(0),
            Command::Disconnect | Command::ResetTarget => {}
            Command::Pins { output, select, wait_us } => {
                bytes.extend([output, select]);
                bytes.extend(wait_us.to_le_bytes());
            }
        }
        bytes
    }

    /// Decodes a packet and ignores bytes behind it; `None` if it is not one of these commands.
    pub fn decode(bytes: &[u8]) -> Option<Self> {
        match *bytes {
            [INFO, code, ..] => Info::ALL.into_iter().find(|info| info.code() == code).map(Command::Info),
            [CONNECT, _, ..] => Some(Command::Connect),
            [DISCONNECT, ..] => Some(Command::Disconnect),
            [RESET_TARGET, ..] => Some(Command::ResetTarget),
            [PINS, output, select, a, b, c, d, ..] => {
                Some(Command::Pins { output, select, wait_us: u32::from_le_bytes([a, b, c, d]) })
            }
            _ => None,
        }
    }

    /// Decodes the answer to this command from a packet.
    ///
    /// # Errors
    /// [`AnswerError`] if the packet is too short, or answers something else.
    pub fn answer(self, bytes: &[u8]) -> Result<Answer<'_>, AnswerError> {
        let command = self.code();
        let short = AnswerError::Short { command, got: bytes.len() };
        let (&got, rest) = bytes.split_first().ok_or(short.clone())?;
        if got == INVALID {
            return Err(AnswerError::Unknown { command });
        }
        if got != command {
            return Err(AnswerError::Other { got, expected: command });
        }
        match (self, rest) {
            (Command::Info(_), [length, data @ ..]) => Ok(Answer::Info(data.get(..usize::from(*length)).ok_or(short)?)),
            (Command::Connect, [port, ..]) => Ok(Answer::Port(*port)),
            (Command::Disconnect, [status, ..]) => Ok(Answer::Disconnected(*status == OK)),
            (Command::ResetTarget, [status, execute, ..]) => {
                Ok(Answer::Reset { is_ok: *status == OK, is_implemented: *execute != 0 })
            }
            (Command::Pins { .. }, [pins, ..]) => Ok(Answer::Pins(*pins)),
            _ => Err(short),
        }
    }
}

impl Answer<'_> {
    /// Encodes the packet. Info of more than 255 bytes is cut.
    pub fn encode(&self) -> Vec<u8> {
        let status = |is_ok: bool| if is_ok { OK } else { INVALID };
        match self {
            Answer::Info(data) => {
                let data = data.get(..255).unwrap_or(data);
                [&[INFO, data.len() as u8], data].concat()
            }
            Answer::Port(port) => vec![CONNECT, *port],
            Answer::Disconnected(is_ok) => vec![DISCONNECT, status(*is_ok)],
            Answer::Reset { is_ok, is_implemented } => vec![RESET_TARGET, status(*is_ok), u8::from(*is_implemented)],
            Answer::Pins(pins) => vec![PINS, *pins],
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn commands() -> Vec<Command> {
        let pins = Command::Pins { output: 0, select: NRESET, wait_us: 0x0102_0304 };
        let others = [Command::Connect, Command::Disconnect, Command::ResetTarget, pins];
        Info::ALL.into_iter().map(Command::Info).chain(others).collect()
    }

    #[test]
    fn commands_are_as_specified() {
        assert_eq!(Command::Info(Info::FirmwareVersion).encode(), [0, 9]);
        assert_eq!(Command::ResetTarget.encode(), [0x0A]);
        let low = Command::Pins { output: 0, select: NRESET, wait_us: 10_000 };
        assert_eq!(low.encode(), [0x10, 0, 0x80, 0x10, 0x27, 0, 0]);
        assert_eq!(Command::Info(Info::Vendor).answer(&[0, 3, b'A', b'B', 0, 9]), Ok(Answer::Info(b"AB\0")));
        assert_eq!(Command::ResetTarget.answer(&[0x0A, 0, 1]), Ok(Answer::Reset { is_ok: true, is_implemented: true }));
    }

    #[test]
    fn commands_come_back_from_a_report() {
        for command in commands() {
            let mut report = command.encode();
            report.resize(HID_PACKET, 0);
            assert_eq!(Command::decode(&report), Some(command));
        }
    }

    proptest! {
        #[test]
        fn answers_come_back(data in prop::collection::vec(any::<u8>(), 0..60), byte: u8, a: bool, b: bool) {
            let pins = Command::Pins { output: 0, select: 0, wait_us: 0 };
            let answers = [
                (Command::Info(Info::Product), Answer::Info(&data)),
                (Command::Connect, Answer::Port(byte)),
                (Command::Disconnect, Answer::Disconnected(a)),
                (Command::ResetTarget, Answer::Reset { is_ok: a, is_implemented: b }),
                (pins, Answer::Pins(byte)),
            ];
            for (command, answer) in answers {
                let packet = answer.encode();
                prop_assert_eq!(command.answer(&packet), Ok(answer));
            }
        }
    }

    mod hard_cases {
        use super::*;

        proptest! {
            #[test]
            fn any_bytes_are_an_answer_or_an_error(bytes in prop::collection::vec(any::<u8>(), 0..70)) {
                for command in commands() {
                    let _ = command.answer(&bytes);
                }
                if let Some(command) = Command::decode(&bytes) {
                    prop_assert!(bytes.starts_with(&command.encode()) || command == Command::Connect);
                }
            }
        }

        #[test]
        fn a_length_beyond_the_packet_is_an_error() {
            let command = Command::Info(Info::Vendor);
            assert_eq!(command.answer(&[0, 9, 1, 2]), Err(AnswerError::Short { command: 0, got: 4 }));
            assert_eq!(command.answer(&[]), Err(AnswerError::Short { command: 0, got: 0 }));
            assert_eq!(command.answer(&[0xFF]), Err(AnswerError::Unknown { command: 0 }));
            assert_eq!(command.answer(&[2, 1]), Err(AnswerError::Other { got: 2, expected: 0 }));
        }
    }
}
