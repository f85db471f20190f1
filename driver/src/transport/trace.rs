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

/// Traces that a connection is opened.
pub(crate) fn opened(carrier: &dyn fmt::Display) {
    tracing::trace!(target: TARGET, opened = %carrier);
}

/// Traces the unique identifier of the board, in hexadecimal.
pub(crate) fn identity(uuid: &str) {
    tracing::trace!(target: TARGET, identity = %uuid);
}

/// Traces a message to the board.
pub(crate) fn sent(bytes: &[u8]) {
    tracing::trace!(target: TARGET, sent = %Shown { bytes, most: MOST_SHOWN });
}

/// Traces a message from the board that holds no measurement.
pub(crate) fn received(bytes: &[u8]) {
    tracing::trace!(target: TARGET, received = %Shown { bytes, most: MOST_SHOWN });
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
            let (header, payload) = (Shown::header(&header), Shown { bytes: payload, most: MOST_SHOWN });
            tracing::trace!(target: TARGET, received = %format_args!("{header}{gap}{payload}"));
        }
        BoardEvent::Packet(packet) => self::packet(packet),
        BoardEvent::Damaged { .. } => damaged(),
    }
}

/// Traces a data packet.
pub(crate) fn packet(packet: &Packet<'_>) {
    let (header, more) = (packet.header_bytes(), packet.payload.len());
    tracing::trace!(target: TARGET, received = %format_args!("{} and {more} bytes", Shown::header(&header)));
}

/// Traces bytes that are not a message.
pub(crate) fn damaged() {
    tracing::trace!(target: TARGET, received = "bytes that are no message");
}

/// Traces a read that failed.
pub(crate) fn failed(why: &dyn fmt::Debug) {
    tracing::trace!(target: TARGET, received = %format_args!("nothing: {why:?}"));
}

/// Displays the first bytes in hexadecimal and the number of further bytes.
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
