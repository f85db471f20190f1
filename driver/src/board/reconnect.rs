//! Policy for boards that were unplugged or fell silent.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use radome_dsp::{Frame, Gap, GapReason, SourceEvent};

use super::{BoardError, BoardIdentity};

/// Reconnection policy of a stream whose board was unplugged or has stalled: the port is opened again after waits that
/// double.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Reconnect {
    /// Wait before the first attempt.
    pub first_wait: Duration,
    /// Longest wait: each wait is twice the one before until it is this long.
    pub longest_wait: Duration,
    /// Time from the detection of the loss until the stream ends with the error that began it, if no frame has come
    /// since. Long frame intervals or rare polls do not make it begin earlier.
    pub give_up_after: Duration,
}

impl Default for Reconnect {
    /// Returns a policy with waits from 50 ms to 2 s that gives up after 30 s.
    fn default() -> Self {
        Reconnect {
            first_wait: Duration::from_millis(50),
            longest_wait: Duration::from_secs(2),
            give_up_after: Duration::from_secs(30),
        }
    }
}

impl Reconnect {
    /// Iterator over the waits before the attempts, in order. It does not end.
    pub fn waits(self) -> impl Iterator<Item = Duration> {
        let longest = self.longest_wait.max(self.first_wait);
        std::iter::successors(Some(self.first_wait), move |wait| Some(wait.saturating_mul(2).min(longest)))
    }

    /// Repeats `reopen` until it succeeds; returns `error` if the time since `noticed` runs out, and logs what came in its place.
    fn until_back(
        self,
        noticed: Instant,
        error: BoardError,
        mut reopen: impl FnMut() -> Result<(), BoardError>,
    ) -> Result<(), BoardError> {
        let mut last = None;
        for wait in self.waits() {
            let left = self.give_up_after.saturating_sub(noticed.elapsed());
            if left.is_zero() {
                break;
            }
            thread::sleep(wait.min(left));
            match reopen() {
                Err(error) if error.is_passing() => {
                    tracing::debug!(%error, "the board is not back yet");
                    last = Some(error);
                }
                result => return result,
            }
        }
        if let Some(last) = last {
            tracing::warn!("the board did not come back; the last attempt: {last}");
        }
        Err(error)
    }
}

/// Tells whether the board of a stream is away: from a loss that the stream tries to end until the next frame. A stream that
/// is stopped meanwhile reports no gap itself.
#[derive(Debug, Clone, Default)]
pub struct Outage(Arc<AtomicBool>);

impl Outage {
    /// Gap that the stream leaves if it is stopped now, while its board is away. The number of its frames is unknown.
    pub fn gap(&self, first_sequence: u64) -> Option<Gap> {
        let is_away = self.0.load(Ordering::SeqCst);
        is_away.then_some(Gap { first_sequence, frames: 0, reason: GapReason::Disconnected })
    }
}

#[derive(Debug, Default)]
pub(super) struct Recovery {
    /// `None` ends the stream at the first error.
    pub policy: Option<Reconnect>,
    /// Whether the board is away.
    pub outage: Outage,
    /// Time of the last frame before a loss and time at which the loss was noticed. A board that answers but sends no
    /// frame counts as lost.
    loss: Option<(Instant, Instant)>,
}

impl Recovery {
    /// Returns the time at which the loss after this frame was noticed: now, if the loss is new.
    fn noticed(&mut self, last_frame: Instant) -> Instant {
        match self.loss {
            Some((before, noticed)) if before == last_frame => noticed,
            _ => self.loss.insert((last_frame, Instant::now())).1,
        }
    }

    /// Notes that the board is away, and reports it unless it was away already.
    fn is_lost(&self, policy: Reconnect, error: &BoardError) {
        if !self.outage.0.swap(true, Ordering::SeqCst) {
            let give_up_after_s = policy.give_up_after.as_secs_f64();
            tracing::warn!(%error, give_up_after_s, "the board is lost: its port is opened again and again");
        }
    }

    /// Notes that a frame has come, and reports the end of an outage.
    fn frame_came(&self) {
        if self.outage.0.swap(false, Ordering::SeqCst) {
            let away_s = self.loss.map_or(0.0, |(last_frame, _)| last_frame.elapsed().as_secs_f64());
            tracing::warn!(away_s, "the board is back");
        }
    }
}

/// Stream that can open the connection to its board again.
pub(super) trait Reconnectable {
    /// Reads the next frame or gap; fails after the deadline.
    fn wait(&mut self, frame: &mut Frame) -> Result<SourceEvent, BoardError>;

    /// Closes the connection: the old port must be closed before the new one can be opened.
    fn close(&mut self);

    /// Opens the closed connection again and starts frames.
    fn reopen(&mut self) -> Result<(), BoardError>;

    /// Time at which the last frame came.
    fn last_frame(&self) -> Instant;

    fn recovery(&mut self) -> &mut Recovery;
}

/// Reads the next frame or gap, and reconnects by the stream's policy after an error that may pass.
pub(super) fn next_event(stream: &mut impl Reconnectable, frame: &mut Frame) -> Result<SourceEvent, BoardError> {
    loop {
        let error = match stream.wait(frame) {
            Ok(event) => {
                // The gap of an outage comes first. Until its frame has come too, the board may be away for longer.
                if event == SourceEvent::Frame {
                    stream.recovery().frame_came();
                }
                return Ok(event);
            }
            Err(error) => error,
        };
        let Some(policy) = stream.recovery().policy.filter(|_| error.is_passing()) else { return Err(error) };
        stream.recovery().is_lost(policy, &error);
        stream.close();
        let last_frame = stream.last_frame();
        let noticed = stream.recovery().noticed(last_frame);
        let reopen = || {
            // A former attempt may have opened the port and failed later.
            stream.close();
            stream.reopen()
        };
        policy.until_back(noticed, error, reopen)?;
    }
}

/// Checks that the board that was opened again at `path` is the one with this UUID.
pub(super) fn check_same(path: &Path, uuid: &str, found: &BoardIdentity) -> Result<(), BoardError> {
    if found.uuid == uuid {
        return Ok(());
    }
    let (expected, found) = (uuid.to_owned(), found.uuid.clone());
    Err(BoardError::OtherBoard { path: path.to_owned(), expected, found })
}

#[cfg(test)]
mod tests {
    use radome_dsp::FrameShape;

    use super::*;

    /// Board that falls silent once. `seen` is the gap of the outage when the board was looked for.
    struct Silent {
        recovery: Recovery,
        events: Vec<Option<SourceEvent>>,
        seen: Vec<Option<Gap>>,
        last_frame: Instant,
    }

    impl Reconnectable for Silent {
        fn wait(&mut self, _frame: &mut Frame) -> Result<SourceEvent, BoardError> {
            let event = self.events.pop().unwrap_or(Some(SourceEvent::End));
            event.ok_or_else(|| BoardError::Stalled { path: "port".into(), waited: Duration::ZERO })
        }

        fn close(&mut self) {}

        fn reopen(&mut self) -> Result<(), BoardError> {
            self.seen.push(self.recovery.outage.gap(1));
            Ok(())
        }

        fn last_frame(&self) -> Instant {
            self.last_frame
        }

        fn recovery(&mut self) -> &mut Recovery {
            &mut self.recovery
        }
    }

    #[test]
    fn an_outage_lasts_from_the_loss_to_the_next_frame() {
        let policy = Reconnect { first_wait: Duration::from_millis(1), ..Reconnect::default() };
        let gap = SourceEvent::Gap(Gap { first_sequence: 1, frames: 2, reason: GapReason::Disconnected });
        let mut stream = Silent {
            recovery: Recovery { policy: Some(policy), ..Recovery::default() },
            // From the last to the first.
            events: vec![Some(SourceEvent::Frame), Some(gap), None, Some(SourceEvent::Frame)],
            seen: Vec::new(),
            last_frame: Instant::now(),
        };
        let outage = stream.recovery.outage.clone();
        let mut frame = Frame::zeroed(FrameShape { rx: 1, chirps: 1, samples: 1 });
        for (event, is_away) in [(SourceEvent::Frame, false), (gap, true), (SourceEvent::Frame, false)] {
            assert_eq!(next_event(&mut stream, &mut frame).expect("an event"), event);
            assert_eq!(outage.gap(1).is_some(), is_away, "{event:?}");
        }
        assert_eq!(stream.seen, [Some(Gap { first_sequence: 1, frames: 0, reason: GapReason::Disconnected })]);
    }

    #[test]
    fn waits_double_up_to_the_longest() {
        let policy = Reconnect { longest_wait: Duration::from_millis(350), ..Reconnect::default() };
        let waits: Vec<u128> = policy.waits().take(5).map(|w| w.as_millis()).collect();
        assert_eq!(waits, [50, 100, 200, 350, 350]);
    }

    mod hard_cases {
        use super::*;

        /// Regression test: the loss of frames 10 s apart is noticed after half a minute. The stream then ended without
        /// an attempt to reconnect.
        #[test]
        fn a_loss_that_is_noticed_late_is_looked_after_all_the_same() {
            let give_up_after = Duration::from_secs(1);
            let policy = Reconnect { first_wait: Duration::from_millis(1), give_up_after, ..Reconnect::default() };
            let stalled = || BoardError::Stalled { path: "port".into(), waited: Duration::from_secs(31) };
            let last_frame = Instant::now();
            thread::sleep(Duration::from_millis(20));
            let (mut recovery, mut attempts) = (Recovery::default(), 0);
            // The port opens each time but no frame comes: the stream must end too.
            let error = loop {
                let noticed = recovery.noticed(last_frame);
                assert!(noticed >= last_frame + Duration::from_millis(20));
                let reopen = || {
                    attempts += 1;
                    Ok(())
                };
                if let Err(error) = policy.until_back(noticed, stalled(), reopen) {
                    break error;
                }
            };
            assert!(attempts > 0 && matches!(error, BoardError::Stalled { .. }), "{attempts} attempts: {error}");
            // The next loss has its own time.
            assert!(recovery.noticed(Instant::now()) > last_frame + Duration::from_millis(20));
        }

        #[test]
        fn waits_neither_overflow_nor_shrink() {
            let policy = Reconnect { first_wait: Duration::MAX, longest_wait: Duration::ZERO, ..Reconnect::default() };
            assert!(policy.waits().take(100).all(|w| w == Duration::MAX));
        }
    }
}
