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

    /// Repeats `reopen` until it succeeds. Returns `error` if the time since the loss was noticed runs out, and logs the error of the
    /// last attempt.
    fn retry(
        self,
        noticed: Instant,
        error: BoardError,
        mut reopen: impl FnMut() -> Result<(), BoardError>,
    ) -> Result<(), BoardError> {
        let mut last_error = None;
        for wait in self.waits() {
            let remaining = self.give_up_after.saturating_sub(noticed.elapsed());
            if remaining.is_zero() {
                break;
            }
            thread::sleep(wait.min(remaining));
            match reopen() {
                Err(error) if error.is_transient() => {
                    tracing::debug!(%error, "the board is not back yet");
                    last_error = Some(error);
                }
                result => return result,
            }
        }
        if let Some(last_error) = last_error {
            tracing::warn!("the board did not come back; the last attempt: {last_error}");
        }
        Err(error)
    }
}

/// Flag that tells whether the board of a stream is away: from a loss until the next frame. A stream that is stopped meanwhile
/// reports no gap itself.
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
    /// Last loss.
    loss: Option<Loss>,
}

/// Loss of a board. A board that answers but sends no frame counts as lost.
#[derive(Debug, Clone, Copy)]
struct Loss {
    /// Time of the last frame before the loss.
    last_frame: Instant,
    /// Time at which the loss was noticed.
    noticed: Instant,
}

impl Recovery {
    /// Returns the time at which the loss after this frame was noticed: now, if the loss is new.
    fn loss_noticed(&mut self, last_frame: Instant) -> Instant {
        match self.loss {
            Some(loss) if loss.last_frame == last_frame => loss.noticed,
            _ => self.loss.insert(Loss { last_frame, noticed: Instant::now() }).noticed,
        }
    }

    /// Notes that the board is away, and reports it unless it was away already.
    fn note_loss(&self, policy: Reconnect, error: &BoardError) {
        if !self.outage.0.swap(true, Ordering::SeqCst) {
            let give_up_after_s = policy.give_up_after.as_secs_f64();
            tracing::warn!(%error, give_up_after_s, "the board is lost: its port is opened again and again");
        }
    }

    /// Notes that a frame has come, and reports the end of an outage.
    fn note_frame(&self) {
        if self.outage.0.swap(false, Ordering::SeqCst) {
            let away_s = self.loss.map_or(0.0, |loss| loss.last_frame.elapsed().as_secs_f64());
            tracing::warn!(away_s, "the board is back");
        }
    }
}

/// Stream that can open the connection to its board again.
pub(super) trait Reconnectable {
    /// Reads the next frame or gap; fails after the deadline.
    fn read_event(&mut self, frame: &mut Frame) -> Result<SourceEvent, BoardError>;

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
        let error = match stream.read_event(frame) {
            Ok(event) => {
                // The gap of an outage comes before its first frame. Until that frame has come, the board may be lost again.
                if event == SourceEvent::Frame {
                    stream.recovery().note_frame();
                }
                return Ok(event);
            }
            Err(error) => error,
        };
        let Some(policy) = stream.recovery().policy.filter(|_| error.is_transient()) else { return Err(error) };
        stream.recovery().note_loss(policy, &error);
        stream.close();
        let last_frame = stream.last_frame();
        let noticed = stream.recovery().loss_noticed(last_frame);
        let reopen = || {
            // An earlier attempt may have opened the port and failed later.
            stream.close();
            stream.reopen()
        };
        policy.retry(noticed, error, reopen)?;
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

    /// Stream whose events are given. `gaps` are the gaps of the outage at each attempt to reopen.
    struct ScriptedStream {
        recovery: Recovery,
        events: Vec<Option<SourceEvent>>,
        gaps: Vec<Option<Gap>>,
        last_frame: Instant,
    }

    impl Reconnectable for ScriptedStream {
        fn read_event(&mut self, _frame: &mut Frame) -> Result<SourceEvent, BoardError> {
            let event = self.events.pop().unwrap_or(Some(SourceEvent::End));
            event.ok_or_else(|| BoardError::Stalled { path: "port".into(), waited: Duration::ZERO })
        }

        fn close(&mut self) {}

        fn reopen(&mut self) -> Result<(), BoardError> {
            self.gaps.push(self.recovery.outage.gap(1));
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
        let mut stream = ScriptedStream {
            recovery: Recovery { policy: Some(policy), ..Recovery::default() },
            // From the last to the first.
            events: vec![Some(SourceEvent::Frame), Some(gap), None, Some(SourceEvent::Frame)],
            gaps: Vec::new(),
            last_frame: Instant::now(),
        };
        let outage = stream.recovery.outage.clone();
        let mut frame = Frame::zeroed(FrameShape { rx: 1, chirps: 1, samples: 1 });
        for (event, is_away) in [(SourceEvent::Frame, false), (gap, true), (SourceEvent::Frame, false)] {
            assert_eq!(next_event(&mut stream, &mut frame).expect("an event"), event);
            assert_eq!(outage.gap(1).is_some(), is_away, "{event:?}");
        }
        assert_eq!(stream.gaps, [Some(Gap { first_sequence: 1, frames: 0, reason: GapReason::Disconnected })]);
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
        fn a_loss_that_is_noticed_late_is_retried() {
            let give_up_after = Duration::from_secs(1);
            let policy = Reconnect { first_wait: Duration::from_millis(1), give_up_after, ..Reconnect::default() };
            let stalled = || BoardError::Stalled { path: "port".into(), waited: Duration::from_secs(31) };
            let last_frame = Instant::now();
            thread::sleep(Duration::from_millis(20));
            let (mut recovery, mut attempts) = (Recovery::default(), 0);
            // The port opens each time but no frame comes: the stream must end too.
            let error = loop {
                let noticed = recovery.loss_noticed(last_frame);
                assert!(noticed >= last_frame + Duration::from_millis(20));
                let reopen = || {
                    attempts += 1;
                    Ok(())
                };
                if let Err(error) = policy.retry(noticed, stalled(), reopen) {
                    break error;
                }
            };
            assert!(attempts > 0 && matches!(error, BoardError::Stalled { .. }), "{attempts} attempts: {error}");
            // The next loss has its own time.
            assert!(recovery.loss_noticed(Instant::now()) > last_frame + Duration::from_millis(20));
        }

        #[test]
        fn waits_neither_overflow_nor_shrink() {
            let policy = Reconnect { first_wait: Duration::MAX, longest_wait: Duration::ZERO, ..Reconnect::default() };
            assert!(policy.waits().take(100).all(|w| w == Duration::MAX));
        }
    }
}
