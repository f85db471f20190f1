//! When to try again with a board that has gone or fallen silent, and what was lost.

use std::thread;
use std::time::{Duration, Instant};

use radome_dsp::{Gap, GapReason};

use super::BoardError;

/// How a stream comes back after its board was unplugged or has stalled: the port is opened again, at first soon, then
/// after longer and longer waits.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Reconnect {
    /// Wait before the first attempt.
    pub first_wait: Duration,
    /// Longest wait: each is twice the one before until it is this long.
    pub longest_wait: Duration,
    /// After so long without a frame the stream ends with the error that began it.
    pub give_up_after: Duration,
}

impl Default for Reconnect {
    /// From 50 ms to 2 s, for half a minute.
    fn default() -> Self {
        Reconnect {
            first_wait: Duration::from_millis(50),
            longest_wait: Duration::from_secs(2),
            give_up_after: Duration::from_secs(30),
        }
    }
}

impl Reconnect {
    /// The waits before one attempt after another.
    pub fn waits(self) -> impl Iterator<Item = Duration> {
        let longest = self.longest_wait.max(self.first_wait);
        std::iter::successors(Some(self.first_wait), move |wait| Some(wait.saturating_mul(2).min(longest)))
    }

    /// Tries again and again until the board is back; gives the error that led here if it does not come. The last frame
    /// came at `last_frame`.
    pub(super) fn until_back(
        self,
        last_frame: Instant,
        error: BoardError,
        mut reopen: impl FnMut() -> Result<(), BoardError>,
    ) -> Result<(), BoardError> {
        tracing::warn!(%error, "the board is opened again");
        for wait in self.waits() {
            let left = self.give_up_after.saturating_sub(last_frame.elapsed());
            if left.is_zero() {
                break;
            }
            thread::sleep(wait.min(left));
            match reopen() {
                Err(error) if error.is_passing() => tracing::debug!(%error, "the board is not back yet"),
                result => return result,
            }
        }
        Err(error)
    }
}

/// Frames lost, by reason.
#[derive(Debug, Default)]
pub(super) struct Losses(Vec<(GapReason, u64)>);

impl Losses {
    pub fn count(&mut self, gap: &Gap) {
        match self.0.iter_mut().find(|(reason, _)| *reason == gap.reason) {
            Some((_, frames)) => *frames += gap.frames,
            None => self.0.push((gap.reason, gap.frames)),
        }
    }

    pub fn frames(&self, reason: GapReason) -> u64 {
        self.0.iter().filter(|(r, _)| *r == reason).map(|(_, frames)| frames).sum()
    }
}

impl BoardError {
    /// Whether the board may be well again when its port is opened anew. A port that has just come back may be without
    /// its permissions for a moment.
    pub fn is_passing(&self) -> bool {
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
            | BoardError::Stalled { .. } => true,
            BoardError::Deepcraft { source, .. } => source.is_passing(),
            BoardError::Protocol { .. }
            | BoardError::OtherChip { .. }
            | BoardError::OtherBoard { .. }
            | BoardError::Ambiguous { .. }
            | BoardError::Chip(_)
            | BoardError::Line { .. }
            | BoardError::WaveformUntold { .. }
            | BoardError::Stopped => false,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn waits_double_up_to_the_longest() {
        let policy = Reconnect { longest_wait: Duration::from_millis(350), ..Reconnect::default() };
        let waits: Vec<u128> = policy.waits().take(5).map(|w| w.as_millis()).collect();
        assert_eq!(waits, [50, 100, 200, 350, 350]);
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn waits_neither_overflow_nor_shrink() {
            let policy = Reconnect { first_wait: Duration::MAX, longest_wait: Duration::ZERO, ..Reconnect::default() };
            assert!(policy.waits().take(100).all(|w| w == Duration::MAX));
        }
    }
}
