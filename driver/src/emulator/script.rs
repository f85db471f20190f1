//! Faults as a person writes them: `drop 5, double 9, flip 12:345, truncate 20:100, reorder 30, skip 40:3, overflow 50, stall 60,
//! unplug 70:2.5`. The first number is the packet, counted from 0.

use std::str::FromStr;
use std::time::Duration;

use thiserror::Error;

use super::Fault;

/// Longest that a board may be unplugged, s.
const LONGEST_UNPLUG_S: f64 = 3600.0;

/// A fault that nobody can follow.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("fault '{text}': {what}\n\nhint: one of {FORMS}; commas between several")]
pub struct FaultError {
    /// What was written.
    pub text: String,
    /// What is wrong with it.
    pub what: &'static str,
}

const FORMS: &str =
    "drop N, double N, reorder N, overflow N, stall N, flip N:BIT, truncate N:BYTES, skip N:BY, unplug N:SECONDS";

impl FromStr for Fault {
    type Err = FaultError;

    fn from_str(text: &str) -> Result<Self, FaultError> {
        let fault = |what| FaultError { text: text.trim().to_owned(), what };
        let (kind, rest) = text.trim().split_once(char::is_whitespace).ok_or(fault("expected a kind and a number"))?;
        let (packet, detail) = match rest.trim().split_once(':') {
            Some((packet, detail)) => (packet, Some(detail.trim())),
            None => (rest.trim(), None),
        };
        let packet: u64 = packet.trim().parse().map_err(|_| fault("the packet is no whole number"))?;
        let detail_of = |what| detail.ok_or(fault(what));
        match (kind, detail) {
            ("drop", None) => Ok(Fault::DropPacket(packet)),
            ("double", None) => Ok(Fault::DoublePacket(packet)),
            ("reorder", None) => Ok(Fault::ReorderPacket(packet)),
            ("overflow", None) => Ok(Fault::Overflow(packet)),
            ("stall", None) => Ok(Fault::Stall(packet)),
            ("drop" | "double" | "reorder" | "overflow" | "stall", Some(_)) => Err(fault("takes the packet alone")),
            ("flip", _) => {
                let bit = detail_of("lacks the bit")?.parse().map_err(|_| fault("the bit is no whole number"))?;
                Ok(Fault::FlipBit { packet, bit })
            }
            ("truncate", _) => {
                let bytes =
                    detail_of("lacks the bytes")?.parse().map_err(|_| fault("the bytes are no whole number"))?;
                Ok(Fault::TruncatePacket { packet, bytes })
            }
            ("skip", _) => {
                let by = detail_of("lacks the jump")?.parse().map_err(|_| fault("the jump is not 0 to 65535"))?;
                Ok(Fault::SkipCounter { packet, by })
            }
            ("unplug", _) => {
                let seconds: f64 =
                    detail_of("lacks the seconds")?.parse().map_err(|_| fault("the seconds are no number"))?;
                if !(0.0..=LONGEST_UNPLUG_S).contains(&seconds) {
                    return Err(fault("the seconds are not 0 to 3600"));
                }
                Ok(Fault::Unplug { packet, duration: Duration::from_secs_f64(seconds) })
            }
            _ => Err(fault("no such kind")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_kind_is_understood() {
        let script = "drop 5, double 9,flip 12:345, truncate 20:100, reorder 30, skip 40:3, overflow 50, stall 60, unplug 70:2.5";
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
        ];
        assert_eq!(faults, expected);
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn what_cannot_be_followed_is_named_with_what_would_do() {
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
                ("explode 3", "no such kind"),
            ] {
                let error = text.parse::<Fault>().expect_err(text).to_string();
                assert!(error.contains(what) && error.contains("hint:"), "{error}");
            }
        }
    }
}
