//! Protocol trace for bug reports: events of [`TARGET`] at the level trace, one for each message to or from a board.
//! They cost one comparison when no subscriber listens.

use std::fmt;

use crate::protocol::mcu7::{BoardEvent, Packet, Response};

/// Target of the events. Each has one field: `opened` names the port or device; `sent` and `received` show bytes as on
/// the wire but without check sums, and only the headers of measurements. `identity` is the unique identifier of the
/// board; remove its bytes before a trace is published.
pub const TARGET: &str = "radome_driver::wire";
/// Most bytes shown of a message.
const MOST_SHOWN: usize = 96;

pub(crate) fn opened(carrier: &dyn fmt::Display) {
    tracing::trace!(target: TARGET, opened = %carrier);
}

/// Traces the unique identifier of the board, in hexadecimal.
pub(crate) fn identity(uuid: &str) {
    tracing::trace!(target: TARGET, identity = %uuid);
}

pub(crate) fn sent(bytes: &[u8]) {
    tracing::trace!(target: TARGET, sent = %Shown(bytes));
}

/// Traces a message from the board that holds no measurement.
pub(crate) fn received(bytes: &[u8]) {
    tracing::trace!(target: TARGET, received = %Shown(bytes));
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
            let gap = if payload.is_empty() { "" } else { " " };
            let (header, payload) = (Shown(&header), Shown(payload));
            tracing::trace!(target: TARGET, received = %format_args!("{header}{gap}{payload}"));
        }
        BoardEvent::Packet(packet) => self::packet(packet),
        BoardEvent::Damaged { .. } => damaged(),
    }
}

pub(crate) fn packet(packet: &Packet<'_>) {
    let (header, more) = (packet.header_bytes(), packet.payload.len());
    tracing::trace!(target: TARGET, received = %format_args!("{} and {more} bytes", Shown(&header)));
}

/// Traces bytes that are not a message.
pub(crate) fn damaged() {
    tracing::trace!(target: TARGET, received = "bytes that are no message");
}

pub(crate) fn failed(why: &dyn fmt::Debug) {
    tracing::trace!(target: TARGET, received = %format_args!("nothing: {why:?}"));
}

/// Displays the first bytes in hexadecimal and the number of further bytes.
struct Shown<'a>(&'a [u8]);

impl fmt::Display for Shown<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut separator = "";
        for byte in self.0.iter().take(MOST_SHOWN) {
            write!(f, "{separator}{byte:02x}")?;
            separator = " ";
        }
        match self.0.len().saturating_sub(MOST_SHOWN) {
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
        let shown = |count: usize| Shown(&bytes[..count]).to_string();
        assert!(shown(103).starts_with("00 01 02 ") && shown(103).ends_with(" 5e 5f and 7 bytes"), "{}", shown(103));
        assert!(shown(96).ends_with(" 5e 5f"), "{}", shown(96));
        assert_eq!((shown(3), shown(0)), ("00 01 02".into(), String::new()));
    }
}
