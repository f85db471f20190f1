//! Frames of a scene as a stream or one by one, in any order and on any number of threads.

use std::collections::VecDeque;
use std::sync::Arc;

use radome_dsp::{Frame, FrameSource, SourceError, SourceEvent, Truth, Waveform};
use rayon::{ThreadPool, ThreadPoolBuilder};
use thiserror::Error;

use crate::frame::FrameSimulator;
pub use crate::frame::{FrameReport, PersonState, SimulateOptions};
use crate::scene::Scene;
use ahead::Ahead;

mod ahead;

/// Options that cannot be met.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum SimError {
    /// More people than the scene has actors, slots or places for.
    #[error("simulation: {asked} people asked for, {scene} has room for at most {most}")]
    TooManyPeople {
        /// Asked for.
        asked: usize,
        /// The scene.
        scene: String,
        /// Most possible.
        most: usize,
    },
    /// The seed makes no scene of the file's random values.
    #[error("simulation: {reason}")]
    Scene {
        /// Reason.
        reason: String,
    },
    /// The tolerance is not a number in range.
    #[error("simulation: tolerance_db is {got}, expected 0.01 to 20 dB")]
    Tolerance {
        /// Value that was given.
        got: f64,
    },
}

/// Frames of a scene. A stream is rendered a few frames ahead on rayon's threads, or [its own](Simulator::on_own_threads), from
/// the first frame asked for until it is dropped or told to [`seek`](Simulator::seek).
#[derive(Debug)]
pub struct Simulator {
    inner: Arc<FrameSimulator>,
    /// The stream's next frame.
    next: u64,
    /// Frames from that one on.
    ahead: VecDeque<Ahead<(Frame, FrameReport)>>,
    spare: Vec<Frame>,
    last_report: Option<FrameReport>,
    /// Threads on which they are made, if not those that all share.
    pool: Option<Arc<ThreadPool>>,
}

impl Clone for Simulator {
    /// The same stream at the same place.
    fn clone(&self) -> Self {
        Simulator {
            inner: Arc::clone(&self.inner),
            next: self.next,
            ahead: VecDeque::new(),
            spare: Vec::new(),
            last_report: None,
            pool: self.pool.clone(),
        }
    }
}

impl Simulator {
    /// Prepares a scene: draws what differs between seeds, traces what is static, draws who comes.
    ///
    /// # Errors
    /// [`SimError`] for more people than the scene has room for, for a tolerance out of range, and for a seed that makes no scene.
    pub fn new(scene: &Scene, options: SimulateOptions) -> Result<Self, SimError> {
        Self::check_people(scene, options.people)?;
        if !(options.tolerance_db >= 0.01 && options.tolerance_db <= 20.0) {
            return Err(SimError::Tolerance { got: options.tolerance_db });
        }
        let scene = scene.drawn(options.seed).map_err(|error| SimError::Scene { reason: error.to_string() })?;
        let inner = FrameSimulator::new(&scene, options);
        let (ahead, spare) = (VecDeque::new(), Vec::new());
        Ok(Simulator { inner: Arc::new(inner), next: 0, ahead, spare, last_report: None, pool: None })
    }

    /// Checks that a scene has room for the people that are asked for.
    ///
    /// # Errors
    /// [`SimError::TooManyPeople`].
    pub fn check_people(scene: &Scene, asked: Option<usize>) -> Result<(), SimError> {
        let people = &scene.file().people;
        let most = match &people.visits {
            _ if !people.actor.is_empty() => people.actor.len(),
            Some(visits) => visits.max_people.max(2),
            None => 2,
        };
        match asked.filter(|asked| *asked > most) {
            Some(asked) => Err(SimError::TooManyPeople { asked, scene: scene.name().to_owned(), most }),
            None => Ok(()),
        }
    }

    /// The stream is rendered on threads of its own, as many as rayon has: where it stands in for a board, who judges its frames
    /// must not queue behind the next ones.
    ///
    /// # Errors
    /// If the system gives no threads.
    pub fn on_own_threads(mut self) -> std::io::Result<Self> {
        let pool = ThreadPoolBuilder::new().num_threads(rayon::current_num_threads());
        let pool = pool.thread_name(|i| format!("simulator-{i}")).build().map_err(std::io::Error::other)?;
        self.pool = Some(Arc::new(pool));
        Ok(self)
    }

    /// One frame, whichever came before.
    pub fn frame(&self, index: u64) -> Frame {
        self.frame_with_report(index).0
    }

    /// One frame whose first chirp is at a time of the scene that need not be a multiple of the frame interval, as boards' are
    /// not: what is drawn by chance is frame `index`'s.
    pub fn frame_at(&self, index: u64, start_s: f64) -> Frame {
        let mut frame = Frame::zeroed(self.inner.scene.waveform().shape());
        self.inner.simulate_from(index, start_s, &mut frame);
        frame
    }

    /// One frame, and what it took.
    pub fn frame_with_report(&self, index: u64) -> (Frame, FrameReport) {
        let mut frame = Frame::zeroed(self.inner.scene.waveform().shape());
        let report = self.inner.simulate_into(index, &mut frame);
        (frame, report)
    }

    /// Echoes of people alone in a frame, without anything static and without a receiver's noise, LSB:
    /// `[rx][chirp][sample]`.
    pub fn echo_samples(&self, index: u64) -> Vec<f32> {
        self.inner.echo_samples(index, None)
    }

    /// The same with every path, or skin, traced at the ends of so many halvings of the frame, whatever the midpoints say: with
    /// seven of them, anew in every one of 128 chirps.
    pub fn echo_samples_halved(&self, index: u64, halvings: u32) -> Vec<f32> {
        self.inner.echo_samples(index, Some(halvings.min(12)))
    }

    /// The same the slow way, on all threads: dense physical optics over the skins, anew in every chirp, in f64, by all pairs
    /// of images louder than this far below the noise of a cell. Minutes a frame; people who are ellipsoids have none.
    pub fn dense_echo_samples(&self, index: u64, margin_db: f64) -> Vec<f64> {
        self.inner.dense_echo_samples(index, margin_db)
    }

    /// One chirp of that, on this thread: `[rx][sample]`.
    pub fn dense_echo_chirp(&self, index: u64, chirp: usize, margin_db: f64) -> Vec<Vec<f64>> {
        self.inner.dense_echo_chirp(index, chirp, margin_db)
    }

    /// Cost of making the stream's last frame.
    pub fn last_report(&self) -> Option<&FrameReport> {
        self.last_report.as_ref()
    }

    /// Ground truth of a frame.
    pub fn truth(&self, index: u64) -> Truth {
        self.inner.truth(index)
    }

    /// People and their places in the middle of a frame, those on their way outside the room included.
    pub fn people(&self, index: u64) -> Vec<PersonState> {
        self.inner.people(index)
    }

    /// The scene, as its seed drew it.
    pub fn scene(&self) -> &Scene {
        &self.inner.scene
    }

    /// The next frame of the stream is this one.
    pub fn seek(&mut self, index: u64) {
        self.next = index;
        self.ahead.clear();
    }

    /// Has enough frames under way to keep all threads busy while one is looked at.
    fn look_ahead(&mut self) {
        let pool = self.pool.as_deref();
        let threads = pool.map_or_else(rayon::current_num_threads, ThreadPool::current_num_threads);
        let most = 2 * threads.max(1) as u64;
        let left = self.inner.options.frames.map_or(u64::MAX, |n| n.saturating_sub(self.next));
        for i in self.ahead.len() as u64..most.min(left) {
            let (inner, index) = (Arc::clone(&self.inner), self.next.saturating_add(i));
            let mut frame = self.spare.pop().unwrap_or_else(|| Frame::zeroed(self.waveform().shape()));
            self.ahead.push_back(Ahead::new(pool, move || {
                let report = inner.simulate_into(index, &mut frame);
                (frame, report)
            }));
        }
    }
}

impl FrameSource for Simulator {
    fn waveform(&self) -> &Waveform {
        self.inner.scene.waveform()
    }

    fn next_frame(&mut self, frame: &mut Frame) -> Result<SourceEvent, SourceError> {
        self.look_ahead();
        let Some(ahead) = self.ahead.pop_front() else { return Ok(SourceEvent::End) };
        let index = self.next;
        self.next = index.saturating_add(1);
        match ahead.wait() {
            Some((rendered, report)) => {
                self.last_report = Some(report);
                self.spare.push(std::mem::replace(frame, rendered));
            }
            None => self.last_report = Some(self.inner.simulate_into(index, frame)),
        }
        Ok(SourceEvent::Frame)
    }

    fn frame_count(&self) -> Option<u64> {
        self.inner.options.frames
    }
}
