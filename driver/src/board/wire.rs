//! What is said to a board and by it, for bug reports: events of [`TARGET`] at the level trace, one a message. They cost a
//! comparison where nobody listens.

use std::fmt;

use crate::protocol::strata::{BoardEvent, Packet, Response};

/// Target of the events. Each has one field: `opened` names what carries the bytes, `sent` and `received` show them, as they are
/// on the wire but without check sums. Of measurements they show headers. `identity` tells this board from all others; whoever
/// passes a trace on removes its bytes.
pub const TARGET: &str = "radome_driver::wire";
/// Bytes shown of a message: few are longer.
const MOST_SHOWN: usize = 96;

/// A connection is made.
pub(super) fn opened(carrier: &dyn fmt::Display) {
    tracing::trace!(target: TARGET, opened = %carrier);
}

/// Identifier of this board, in hexadecimal.
pub(super) fn identity(uuid: &str) {
    tracing::trace!(target: TARGET, identity = %uuid);
}

/// A message to the board.
pub(super) fn sent(bytes: &[u8]) {
    tracing::trace!(target: TARGET, sent = %Shown { bytes, most: MOST_SHOWN });
}

/// A message from the board that holds no measurement.
pub(super) fn received(bytes: &[u8]) {
    tracing::trace!(target: TARGET, received = %Shown { bytes, most: MOST_SHOWN });
}

/// Bytes of a measurement, in a protocol whose headers are not looked at here.
pub(super) fn measured(bytes: usize) {
    tracing::trace!(target: TARGET, received = %format_args!("{bytes} bytes"));
}

/// What a board said in the vendor's protocol.
pub(super) fn event(event: &BoardEvent<'_>) {
    match event {
        BoardEvent::Response(Response { kind_code, status, payload }) => {
            let [l0, l1] = (payload.len() as u16).to_le_bytes();
            let header = [*kind_code, status.code(), l0, l1];
            let gap = if payload.is_empty() { "" } else { " " };
            let (header, payload) = (Shown::header(&header), Shown { bytes: payload, most: MOST_SHOWN });
            tracing::trace!(target: TARGET, received = %format_args!("{header}{gap}{payload}"));
        }
        BoardEvent::Packet(packet) => self::packet(packet),
        BoardEvent::Damaged { .. } => damaged(),
    }
}

/// A piece of a measurement.
pub(super) fn packet(packet: &Packet<'_>) {
    let (header, more) = (packet.header_bytes(), packet.payload.len());
    tracing::trace!(target: TARGET, received = %format_args!("{} and {more} bytes", Shown::header(&header)));
}

/// Bytes that are no message.
pub(super) fn damaged() {
    tracing::trace!(target: TARGET, received = "what is no message");
}

/// Nothing came, and why.
pub(super) fn failed(why: &dyn fmt::Debug) {
    tracing::trace!(target: TARGET, received = %format_args!("nothing: {why:?}"));
}

/// The first bytes in hexadecimal, and how many there are beyond them.
struct Shown<'a> {
    bytes: &'a [u8],
    most: usize,
}

impl<'a> Shown<'a> {
    fn header(bytes: &'a [u8]) -> Self {
        Shown { bytes, most: bytes.len() }
    }
}

impl fmt::Display for Shown<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut separator = "";
        for byte in self.bytes.iter().take(self.most) {
            write!(f, "{separator}{byte:02x}")?;
            separator = " ";
        }
        match self.bytes.len().saturating_sub(self.most) {
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
        let bytes: Vec<u8> = (0..10).collect();
        let shown = |most| Shown { bytes: &bytes, most }.to_string();
        assert_eq!(shown(3), "00 01 02 and 7 bytes");
        assert_eq!(shown(10), "00 01 02 03 04 05 06 07 08 09");
        assert_eq!(Shown { bytes: &[], most: 3 }.to_string(), "");
    }
}
