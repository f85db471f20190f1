//! Faults of an emulated board and their text form: `drop 5, double 9, flip 12:345, truncate 20:100, reorder 30, skip
//! 40:3, overflow 50, stall 60, unplug 70:2.5, slow 80:0.5, chip 0x606, version 5`. The first number is the packet.

use std::str::FromStr;
use std::time::Duration;

use thiserror::Error;

/// Injected fault. Packets are the firmware's data messages (an ESP32's lines), counted from 0 since the emulator was
/// started.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[allow(missing_docs, reason = "each variant says what its fields are")]
pub enum Fault {
    /// The packet is not sent.
    DropPacket(u64),
    /// The packet is sent twice.
    DoublePacket(u64),
    /// One bit of the packet is inverted, counted from its first byte's lowest bit, modulo its length.
    FlipBit { packet: u64, bit: usize },
    /// Only the packet's first bytes are sent.
    TruncatePacket { packet: u64, bytes: usize },
    /// The packet is sent after its successor.
    ReorderPacket(u64),
    /// The firmware's counter jumps before this packet, as if others had been sent.
    SkipCounter { packet: u64, by: u16 },
    /// The chip's FIFO overflows instead of this packet being sent.
    Overflow(u64),
    /// Nothing more is sent from this packet on until the host starts the board anew. Requests are answered.
    Stall(u64),
    /// The board is unplugged instead of this packet being sent, and so loses its power. It comes back after a while,
    /// at [`EmulatorOptions::link`](super::EmulatorOptions::link).
    Unplug { packet: u64, duration: Duration },
    /// The host reads nothing from this packet on: the port takes no more bytes while the chip keeps sampling.
    SlowHost { packet: u64, duration: Duration },
    /// CHIP_ID reads this value: another chip, or one that does not answer (0, all ones).
    ForeignChip(u32),
    /// The firmware reports this major version of its protocol, but its messages do not change.
    WrongVersion(u16),
}

/// Longest time for which a board may be unplugged or its host be slow, s.
const LONGEST_WAIT_S: f64 = 3600.0;

/// Error of a text that is not a fault.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("fault '{text}': {what}\n\nhint: one of {FORMS}; commas between several")]
pub struct FaultError {
    /// Text that was given.
    pub text: String,
    /// Description of the error.
    pub what: &'static str,
}

const FORMS: &str = "drop N, double N, reorder N, overflow N, stall N, flip N:BIT, truncate N:BYTES, skip N:BY, \
                     unplug N:SECONDS, slow N:SECONDS, chip ID, version MAJOR";

/// Parses a whole number, decimal or hexadecimal after `0x`.
fn number(text: &str) -> Option<u32> {
    match text.strip_prefix("0x") {
        Some(digits) => u32::from_str_radix(digits, 16).ok(),
        None => text.parse().ok(),
    }
}

impl FromStr for Fault {
    type Err = FaultError;

    fn from_str(text: &str) -> Result<Self, FaultError> {
        let text = text.trim();
        parse(text).map_err(|what| FaultError { text: text.to_owned(), what })
    }
}

/// Parses a fault; the error says what is wrong.
fn parse(text: &str) -> Result<Fault, &'static str> {
    let (kind, rest) = text.split_once(char::is_whitespace).ok_or("expected a kind and a number")?;
    let rest = rest.trim();
    match kind {
        "chip" => {
            let chip_id = number(rest).filter(|id| *id <= 0xFF_FFFF);
            return chip_id.map(Fault::ForeignChip).ok_or("the chip's id is not 0 to 0xFFFFFF");
        }
        "version" => return rest.parse().map(Fault::WrongVersion).map_err(|_| "the version is not 0 to 65535"),
        _ => {}
    }
    let (packet, detail) = match rest.split_once(':') {
        Some((packet, detail)) => (packet.trim(), Some(detail.trim())),
        None => (rest, None),
    };
    let packet: u64 = packet.parse().map_err(|_| "the packet is no whole number")?;
    Ok(match (kind, detail) {
        ("drop", None) => Fault::DropPacket(packet),
        ("double", None) => Fault::DoublePacket(packet),
        ("reorder", None) => Fault::ReorderPacket(packet),
        ("overflow", None) => Fault::Overflow(packet),
        ("stall", None) => Fault::Stall(packet),
        ("drop" | "double" | "reorder" | "overflow" | "stall", Some(_)) => return Err("takes the packet alone"),
        ("flip", _) => {
            Fault::FlipBit { packet, bit: parse_detail(detail, "lacks the bit", "the bit is no whole number")? }
        }
        ("truncate", _) => {
            let bytes = parse_detail(detail, "lacks the bytes", "the bytes are no whole number")?;
            Fault::TruncatePacket { packet, bytes }
        }
        ("skip", _) => {
            Fault::SkipCounter { packet, by: parse_detail(detail, "lacks the jump", "the jump is not 0 to 65535")? }
        }
        ("unplug" | "slow", _) => {
            let seconds: f64 = parse_detail(detail, "lacks the seconds", "the seconds are no number")?;
            if !(0.0..=LONGEST_WAIT_S).contains(&seconds) {
                return Err("the seconds are not 0 to 3600");
            }
            let duration = Duration::from_secs_f64(seconds);
            if kind == "slow" { Fault::SlowHost { packet, duration } } else { Fault::Unplug { packet, duration } }
        }
        _ => return Err("no such kind"),
    })
}

/// Parses the number behind the packet; the error is `lacks` if there is none, and `wrong` if it is not of this type.
fn parse_detail<T: FromStr>(detail: Option<&str>, lacks: &'static str, wrong: &'static str) -> Result<T, &'static str> {
    detail.ok_or(lacks)?.parse().map_err(|_| wrong)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_kind_is_parsed() {
        let script = "drop 5, double 9,flip 12:345, truncate 20:100, reorder 30, skip 40:3, overflow 50, stall 60, unplug 70:2.5, \
                      slow 80:0.5, chip 0x606, version 5";
        let faults: Vec<Fault> = script.split(',').map(|f| f.parse().unwrap_or_else(|e| panic!("{e}"))).collect();
        let expected = [
            Fault::DropPacket(5),
            Fault::DoublePacket(9),
            Fault::FlipBit { packet: 12, bit: 345 },
            Fault::TruncatePacket { packet: 20, bytes: 100 },
            Fault::ReorderPacket(30),
            Fault::SkipCounter { packet: 40, by: 3 },
            Fault::Overflow(50),
            Fault::Stall(60),
            Fault::Unplug { packet: 70, duration: Duration::from_millis(2500) },
            Fault::SlowHost { packet: 80, duration: Duration::from_millis(500) },
            Fault::ForeignChip(0x606),
            Fault::WrongVersion(5),
        ];
        assert_eq!(faults, expected);
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn invalid_faults_are_refused_with_a_hint() {
            for (text, what) in [
                ("", "expected a kind"),
                ("drop", "expected a kind"),
                ("drop x", "no whole number"),
                ("drop -1", "no whole number"),
                ("drop 1:2", "alone"),
                ("flip 3", "lacks the bit"),
                ("skip 3:70000", "0 to 65535"),
                ("unplug 3:NaN", "0 to 3600"),
                ("unplug 3:-1", "0 to 3600"),
                ("slow 3", "lacks the seconds"),
                ("chip 0x1000000", "0 to 0xFFFFFF"),
                ("version -1", "0 to 65535"),
                ("explode 3", "no such kind"),
            ] {
                let error = text.parse::<Fault>().expect_err(text).to_string();
                assert!(error.contains(what) && error.contains("hint:"), "{error}");
            }
        }
    }
}
