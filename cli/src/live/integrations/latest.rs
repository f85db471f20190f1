//! The newest of a run, in one place: written by the classifier's thread, read by whoever tells others.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use radome_dsp::Gap;
use tokio::sync::watch;

use crate::live::answer::Summary;
use crate::live::health::Health;
use crate::live::sink::{Moment, Sink};

/// Newest answer and counters.
#[derive(Debug, Clone, Copy)]
pub struct Said {
    /// Probabilities of empty, one and two.
    pub probabilities: [f32; 3],
    /// People that the room counts as holding, after delays: the one authoritative answer.
    pub people: usize,
}

impl Said {
    /// Probability of what the room counts as.
    pub fn confidence(&self) -> f32 {
        self.probabilities.get(self.people).copied().unwrap_or(0.0)
    }
}

/// The newest of a run.
#[derive(Debug, Clone)]
pub struct Newest {
    /// Nothing until the first label.
    pub said: Option<Said>,
    /// Time at which the last frame with a signal was judged, labelled or not.
    pub judged: Option<Instant>,
    pub health: Health,
}

/// Requests of others to the run and refusals of them, each with a counter.
#[derive(Debug, Default)]
pub struct Counters {
    /// Whether the broker listens.
    pub mqtt_connected: AtomicBool,
    /// Connections to the broker that came about.
    pub mqtt_connections: AtomicU64,
    pub mqtt_published: AtomicU64,
    /// Messages of others that were not understood or not obeyed.
    pub mqtt_refused: AtomicU64,
    /// Connections to the metrics that gave way to newer ones because there were too many.
    pub http_turned_away: AtomicU64,
    /// Requests that were malformed, too long, too slow, without the token, or for what is not there.
    pub http_refused: AtomicU64,
    /// Reports of wrong answers that became recordings.
    pub reports_kept: AtomicU64,
    /// Reports that did not: too many at once, or no room.
    pub reports_refused: AtomicU64,
}

/// Adds one.
pub fn count(counter: &AtomicU64) {
    counter.fetch_add(1, Ordering::Relaxed);
}

/// The newest of a run, shared.
pub struct Latest {
    newest: Mutex<Newest>,
    changes: watch::Sender<u64>,
    silence: Duration,
    /// Requests of others.
    pub counters: Counters,
}

impl Latest {
    /// Health of a run that has reported nothing yet; a board that is silent for `silence` counts as gone.
    pub fn new(started: Instant, silence: Duration) -> Arc<Self> {
        let newest = Mutex::new(Newest { said: None, judged: None, health: Health::new(started) });
        Arc::new(Latest { newest, changes: watch::Sender::new(0), silence, counters: Counters::default() })
    }

    fn lock(&self) -> MutexGuard<'_, Newest> {
        self.newest.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A copy, for whoever takes longer over it.
    pub fn newest(&self) -> Newest {
        self.lock().clone()
    }

    /// Newest answer, if frames still come: an old answer is none.
    pub fn said(&self) -> Option<Said> {
        let newest = self.lock();
        newest.said.filter(|_| newest.judged.is_some_and(|judged| judged.elapsed() < self.silence))
    }

    /// Frames judged and frames lost so far.
    pub fn frames(&self) -> (u64, u64) {
        let newest = self.lock();
        (newest.health.frames, newest.health.dropped_total())
    }

    /// Changes whenever the number of people does, and with the first label.
    pub fn changes(&self) -> watch::Receiver<u64> {
        self.changes.subscribe()
    }
}

/// Keeps a [`Latest`] up to date.
pub struct LatestSink(pub Arc<Latest>);

impl Sink for LatestSink {
    fn answer(&mut self, moment: &Moment) -> anyhow::Result<()> {
        let answer = moment.answer;
        let mut newest = self.0.lock();
        newest.health.copy_from(moment.health);
        if !answer.no_signal {
            newest.judged = Some(Instant::now());
        }
        let Some(probabilities) = answer.probabilities else { return Ok(()) };
        let said = Said { probabilities: probabilities.values(), people: answer.people };
        let is_change = newest.said.replace(said).is_none_or(|last| last.people != said.people);
        drop(newest);
        if is_change {
            self.0.changes.send_modify(|changes| *changes += 1);
        }
        Ok(())
    }

    fn gap(&mut self, _gap: &Gap, health: &Health) -> anyhow::Result<()> {
        self.0.lock().health.copy_from(health);
        Ok(())
    }

    fn end(&mut self, _summary: &Summary) -> anyhow::Result<()> {
        Ok(())
    }
}
