//! Protocol trace for bug reports: events of [`TARGET`] at the level trace, one for each message to or from a board.
//! They cost one comparison when no subscriber listens.

use std::fmt;

use crate::protocol::mcu7::{BoardEvent, Packet, Response};

/// Target of the events. Each has one field: `opened` names the port or device; `sent` and `received` show bytes as on
/// the wire but without check sums, and only the headers of measurements. `identity` is the unique identifier of the
/// board; remove its bytes before a trace is published.
pub const TARGET: &str = "radome_driver::wire";
/// Largest number of bytes shown of a message.
const MAX_SHOWN_BYTES: usize = 96;

pub(crate) fn opened(name: &dyn fmt::Display) {
    tracing::trace!(target: TARGET, opened = %name);
}

/// Traces the unique identifier of the board, in hexadecimal.
pub(crate) fn identity(uuid: &str) {
    tracing::trace!(target: TARGET, identity = %uuid);
}

pub(crate) fn sent(bytes: &[u8]) {
    tracing::trace!(target: TARGET, sent = %Hex(bytes));
}

/// Traces a message from the board that holds no measurement.
pub(crate) fn received(bytes: &[u8]) {
    tracing::trace!(target: TARGET, received = %Hex(bytes));
}

/// Traces the number of bytes of a measurement, in a protocol whose headers are not parsed here.
pub(crate) fn measured(bytes: usize) {
    tracing::trace!(target: TARGET, received = %format_args!("{bytes} bytes"));
}

/// Traces a message of the MCU7 protocol from the board.
pub(crate) fn event(event: &BoardEvent<'_>) {
    match event {
        BoardEvent::Response(Response { kind_code, status, payload }) => {
            let [l0, l1] = (payload.len() as u16).to_le_bytes();
            let header = [*kind_code, status.code(), l0, l1];
            let separator = if payload.is_empty() { "" } else { " " };
            let (header, payload) = (Hex(&header), Hex(payload));
            tracing::trace!(target: TARGET, received = %format_args!("{header}{separator}{payload}"));
        }
        BoardEvent::Packet(packet) => self::packet(packet),
        BoardEvent::Damaged { .. } => damaged(),
    }
}

pub(crate) fn packet(packet: &Packet<'_>) {
    let (header, more) = (packet.header_bytes(), packet.payload.len());
    tracing::trace!(target: TARGET, received = %format_args!("{} and {more} bytes", Hex(&header)));
}

/// Traces bytes that are not a message.
pub(crate) fn damaged() {
    tracing::trace!(target: TARGET, received = "bytes that are no message");
}

pub(crate) fn failed(why: &dyn fmt::Debug) {
    tracing::trace!(target: TARGET, received = %format_args!("nothing: {why:?}"));
}

/// Displays the first bytes in hexadecimal and the number of further bytes.
struct Hex<'a>(&'a [u8]);

impl fmt::Display for Hex<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut separator = "";
        for byte in self.0.iter().take(MAX_SHOWN_BYTES) {
            write!(f, "{separator}{byte:02x}")?;
            separator = " ";
        }
        match self.0.len().saturating_sub(MAX_SHOWN_BYTES) {
            0 => Ok(()),
            more => write!(f, " and {more} bytes"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_beyond_the_most_are_counted_only() {
        let bytes: Vec<u8> = (0..103).collect();
        let hex = |count: usize| Hex(&bytes[..count]).to_string();
        assert!(hex(103).starts_with("00 01 02 ") && hex(103).ends_with(" 5e 5f and 7 bytes"), "{}", hex(103));
        assert!(hex(96).ends_with(" 5e 5f"), "{}", hex(96));
        assert_eq!((hex(3), hex(0)), ("00 01 02".into(), String::new()));
    }
}
