//! Received data, failures and timeouts that both carriers share.

use std::time::Duration;

use crate::protocol::mcu7::Packet;

/// Longest time that a board takes to answer.
pub(super) const ANSWER_TIMEOUT: Duration = Duration::from_secs(1);
/// Silence after which the rest of a message will not come.
pub(super) const SILENCE: Duration = Duration::from_millis(200);

/// Received data.
pub(in crate::board::mcu7) enum Incoming<'a> {
    Packet(Packet<'a>),
    Damaged,
}

/// Failure of a carrier.
pub(super) enum Failure {
    /// No answer came.
    NoAnswer,
    /// The connection broke.
    Lost(std::io::Error),
}
