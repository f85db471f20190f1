//! Newest state of a run, written by the classifier's thread and read by the integrations.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use radome_dsp::Gap;
use tokio::sync::watch;

use crate::live::health::Health;
use crate::live::sink::{ClassifiedFrame, Sink};
use crate::panics::lock;

/// Answer whose number of people is settled.
#[derive(Debug, Clone, Copy)]
pub struct SettledAnswer {
    /// Probabilities of empty, one and two.
    pub probabilities: [f32; 3],
    /// Number of people in the room, after delays: the one authoritative answer.
    pub people: usize,
}

impl SettledAnswer {
    /// Returns the probability of the number of people that counts.
    pub fn confidence(&self) -> f32 {
        self.probabilities.get(self.people).copied().unwrap_or(0.0)
    }
}

/// Newest state of a run.
#[derive(Debug, Clone)]
pub struct RunState {
    /// Newest answer; `None` until the first settled one, and again after a long gap.
    pub answer: Option<SettledAnswer>,
    /// Time at which the last frame with a signal was classified, with or without a label.
    pub last_classified: Option<Instant>,
    pub health: Health,
}

/// Counters of external requests to the run, and of refusals.
#[derive(Debug, Default)]
pub struct Counters {
    /// Whether the connection to the broker is up.
    pub mqtt_connected: AtomicBool,
    /// Number of established connections to the broker.
    pub mqtt_connections: AtomicU64,
    pub mqtt_published: AtomicU64,
    /// Number of publications and subscriptions that the broker rejected.
    pub mqtt_rejected: AtomicU64,
    /// Number of received messages that were not understood or not followed.
    pub mqtt_refused: AtomicU64,
    /// Number of connections to the metrics that were replaced by newer ones because there were too many.
    pub http_turned_away: AtomicU64,
    /// Number of requests that were malformed, too long, too slow, without the token, or for an unknown path.
    pub http_refused: AtomicU64,
    /// Number of reports of wrong answers that were saved as recordings.
    pub reports_kept: AtomicU64,
    /// Number of reports that were not saved: too many at once, or no space.
    pub reports_refused: AtomicU64,
}

pub fn count(counter: &AtomicU64) {
    counter.fetch_add(1, Ordering::Relaxed);
}

/// Newest state of a run, shared between threads.
pub struct Latest {
    newest: Mutex<RunState>,
    changes: watch::Sender<u64>,
    silence: Duration,
    pub counters: Counters,
}

impl Latest {
    /// Creates the state of a run without answers. A board that is silent for `silence` counts as gone.
    pub fn new(started: Instant, silence: Duration) -> Arc<Self> {
        let newest = Mutex::new(RunState { answer: None, last_classified: None, health: Health::new(started) });
        Arc::new(Latest { newest, changes: watch::Sender::new(0), silence, counters: Counters::default() })
    }

    /// Returns a copy, so that slow readers hold no lock.
    pub fn newest(&self) -> RunState {
        lock(&self.newest).clone()
    }

    /// Returns the newest answer; `None` if there is no settled one, or if frames no longer arrive.
    pub fn answer(&self) -> Option<SettledAnswer> {
        let newest = lock(&self.newest);
        newest.answer.filter(|_| newest.last_classified.is_some_and(|at| at.elapsed() < self.silence))
    }

    /// Frame rate over the newest frames, 1/s; 0 if frames no longer arrive.
    pub fn frames_per_s(&self) -> f64 {
        let newest = lock(&self.newest);
        if newest.health.is_silent(self.silence) { 0.0 } else { newest.health.frames_per_s() }
    }

    /// Number of frames classified and lost so far.
    pub fn frames(&self) -> (u64, u64) {
        let newest = lock(&self.newest);
        (newest.health.frames, newest.health.dropped_total())
    }

    /// Returns a receiver that is notified when the number of people changes, and of the first settled answer.
    pub fn changes(&self) -> watch::Receiver<u64> {
        self.changes.subscribe()
    }
}

pub struct LatestSink(pub Arc<Latest>);

impl Sink for LatestSink {
    fn answer(&mut self, classified: &ClassifiedFrame) -> anyhow::Result<()> {
        let answer = classified.answer;
        let mut newest = lock(&self.0.newest);
        newest.health.copy_from(classified.health);
        if !answer.no_signal {
            newest.last_classified = Some(Instant::now());
        }
        // Other programs act on a room that becomes empty: an unsettled count is unknown to them.
        if !answer.is_settled {
            newest.answer = None;
        }
        let Some(probabilities) = answer.probabilities.filter(|_| answer.is_settled) else { return Ok(()) };
        let settled = SettledAnswer { probabilities: probabilities.values(), people: answer.people };
        let has_changed = newest.answer.replace(settled).is_none_or(|last| last.people != settled.people);
        drop(newest);
        if has_changed {
            self.0.changes.send_modify(|changes| *changes += 1);
        }
        Ok(())
    }

    fn gap(&mut self, _gap: &Gap, health: &Health) -> anyhow::Result<()> {
        lock(&self.0.newest).health.copy_from(health);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use radome_dsp::{Frame, Waveform, WaveformRequest};

    use super::*;
    use crate::classifier::{Delays, Model};
    use crate::live::classify::LiveClassifier;

    /// Classifier of frames of an empty room, with the sink that receives its answers.
    struct Room {
        waveform: Waveform,
        classifier: LiveClassifier<'static>,
        sink: LatestSink,
        noise: u32,
    }

    impl Room {
        fn new() -> Self {
            let waveform = Waveform::realise(WaveformRequest::paper()).expect("a valid waveform");
            let started = Instant::now();
            let model = Box::leak(Box::new(Model::Cfar));
            let classifier =
                LiveClassifier::new(model, &waveform, Delays::default(), None, started).expect("a classifier");
            Room { waveform, classifier, sink: LatestSink(Latest::new(started, Duration::from_secs(600))), noise: 1 }
        }

        /// Passes the answer to a frame with or without a signal to the sink; returns whether the sink has a settled answer.
        fn is_settled_after(&mut self, time_s: f64, has_signal: bool) -> bool {
            let mut frame = Frame::zeroed(self.waveform.shape());
            (frame.sequence, frame.time_ns) = ((time_s * 10.0).round() as u64, (time_s * 1e9) as u64);
            for code in frame.codes.iter_mut().filter(|_| has_signal) {
                self.noise = self.noise.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                *code = 2000 + (self.noise >> 26) as u16;
            }
            let frame = Arc::new(frame);
            let answer = self.classifier.classify(&frame, Instant::now()).expect("an answer");
            assert_eq!(answer.no_signal, !has_signal);
            let classified = ClassifiedFrame {
                answer: &answer,
                frame: &frame,
                map: self.classifier.map(),
                health: &self.classifier.health,
            };
            self.sink.answer(&classified).expect("accepted");
            self.sink.0.answer().is_some()
        }

        /// Passes the answers to 3.5 s of frames with a signal; returns for each whether the sink then has a settled answer.
        fn settled_during(&mut self, first_s: f64) -> Vec<bool> {
            (0..=35).map(|tenth| self.is_settled_after(first_s + 0.1 * f64::from(tenth), true)).collect()
        }
    }

    /// Regression test: when a board came back, the count from before its outage was reported until the delays were over.
    #[test]
    fn after_a_long_gap_the_count_is_unknown_until_it_is_settled_again() {
        let mut room = Room::new();
        for first_s in [0.0, 12.5] {
            let is_settled = room.settled_during(first_s);
            assert!(!is_settled[0] && is_settled[35], "from {first_s} s on: {is_settled:?}");
            assert!(room.is_settled_after(first_s + 4.5, true), "a second without frames changes nothing");
        }
    }

    /// Regression test: after minutes of frames without a signal, the count from before them was reported as current.
    #[test]
    fn after_long_without_a_signal_the_count_is_unknown_until_it_is_settled_again() {
        let mut room = Room::new();
        assert!(room.settled_during(0.0)[35]);
        room.is_settled_after(4.0, false);
        assert!(room.is_settled_after(4.1, true), "half a second without a signal changes nothing");
        for tenth in 42..=120 {
            room.is_settled_after(0.1 * f64::from(tenth), false);
        }
        let is_settled = room.settled_during(12.1);
        assert!(!is_settled[0] && is_settled[35], "{is_settled:?}");
    }
}
