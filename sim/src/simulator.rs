//! Simulation of a scene's frames, as a stream or one by one, in any order and on any number of threads.

use std::collections::VecDeque;
use std::sync::Arc;

use radome_dsp::{Frame, FrameSource, SourceError, SourceEvent, Truth, Waveform};
use rayon::{ThreadPool, ThreadPoolBuilder};
use thiserror::Error;

use crate::frame::FrameSimulator;
pub use crate::frame::{FrameReport, PersonState, SimulateOptions};
use crate::scene::Scene;
use queued::Queued;

mod queued;

/// Error of options that cannot be satisfied.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum SimError {
    /// The scene has fewer actors, slots or places than requested people.
    #[error("simulation: {requested} people asked for, {scene} has room for at most {limit}")]
    TooManyPeople {
        /// Requested number of people.
        requested: usize,
        /// Name of the scene.
        scene: String,
        /// Greatest possible number of people.
        limit: usize,
    },
    /// The seed's random values do not form a valid scene.
    #[error("simulation: {reason}")]
    Scene {
        /// Reason why the scene is not valid.
        reason: String,
    },
    /// The tolerance is not a number in range.
    #[error("simulation: tolerance_db is {got}, expected 0.01 to 20 dB")]
    Tolerance {
        /// Value that was given.
        got: f64,
    },
}

/// Simulator of a scene's frames. A stream is simulated a few frames ahead, on rayon's threads or on threads [of its
/// own](Simulator::on_own_threads). This begins with the first requested frame. It ends when the simulator is dropped
/// or moved by [`seek`](Simulator::seek).
#[derive(Debug)]
pub struct Simulator {
    inner: Arc<FrameSimulator>,
    /// Index of the stream's next frame.
    next: u64,
    /// Frames from `next` on that are being simulated.
    queue: VecDeque<Queued<(Frame, FrameReport)>>,
    /// Frames whose buffers are used again.
    spare: Vec<Frame>,
    last_report: Option<FrameReport>,
    /// Threads for the stream, if it does not use the shared ones.
    pool: Option<Arc<ThreadPool>>,
}

impl Clone for Simulator {
    /// Clones the stream at the same position.
    fn clone(&self) -> Self {
        Simulator {
            inner: Arc::clone(&self.inner),
            next: self.next,
            queue: VecDeque::new(),
            spare: Vec::new(),
            last_report: None,
            pool: self.pool.clone(),
        }
    }
}

impl Simulator {
    /// Prepares a scene: draws the values that differ between seeds, traces static paths, and draws the people.
    ///
    /// # Errors
    /// [`SimError`] for more people than the scene has room for, for a tolerance out of range, and for a seed whose
    /// values form no valid scene.
    pub fn new(scene: &Scene, options: SimulateOptions) -> Result<Self, SimError> {
        Self::check_people(scene, options.people)?;
        Self::check_tolerance(options.tolerance_db)?;
        let scene = scene.drawn(options.seed).map_err(|error| SimError::Scene { reason: error.to_string() })?;
        let inner = FrameSimulator::new(&scene, options);
        let (queue, spare) = (VecDeque::new(), Vec::new());
        Ok(Simulator { inner: Arc::new(inner), next: 0, queue, spare, last_report: None, pool: None })
    }

    /// Checks that a scene has room for the requested number of people.
    ///
    /// # Errors
    /// [`SimError::TooManyPeople`] if it has not.
    pub fn check_people(scene: &Scene, requested: Option<usize>) -> Result<(), SimError> {
        let people = &scene.file().people;
        let limit = match &people.visits {
            _ if !people.actor.is_empty() => people.actor.len(),
            Some(visits) => visits.max_people.max(2),
            None => 2,
        };
        match requested.filter(|requested| *requested > limit) {
            Some(requested) => Err(SimError::TooManyPeople { requested, scene: scene.name().to_owned(), limit }),
            None => Ok(()),
        }
    }

    /// Checks that a tolerance, dB, is in range.
    ///
    /// # Errors
    /// [`SimError::Tolerance`] if it is not.
    pub fn check_tolerance(tolerance_db: f64) -> Result<(), SimError> {
        match (0.01..=20.0).contains(&tolerance_db) {
            true => Ok(()),
            false => Err(SimError::Tolerance { got: tolerance_db }),
        }
    }

    /// Simulates the stream on its own threads, as many as rayon has. When the simulator replaces a board, the
    /// processing of a frame must not wait behind the simulation of the next ones.
    ///
    /// # Errors
    /// An I/O error if the system cannot start the threads.
    pub fn on_own_threads(mut self) -> std::io::Result<Self> {
        let pool = ThreadPoolBuilder::new().num_threads(rayon::current_num_threads());
        let pool = pool.thread_name(|i| format!("simulator-{i}")).build().map_err(std::io::Error::other)?;
        self.pool = Some(Arc::new(pool));
        Ok(self)
    }

    /// Simulates one frame, independently of the previous calls.
    pub fn frame(&self, index: u64) -> Frame {
        self.frame_with_report(index).0
    }

    /// Simulates one frame that begins at any time of the scene. As for real boards, the time need not be a multiple of
    /// the frame interval. Random draws are those of frame `index`.
    pub fn frame_at(&self, index: u64, start_s: f64) -> Frame {
        let mut frame = Frame::zeroed(self.inner.scene.waveform().shape());
        self.inner.simulate_from(index, start_s, &mut frame);
        frame
    }

    /// Simulates one frame and reports its cost.
    pub fn frame_with_report(&self, index: u64) -> (Frame, FrameReport) {
        let mut frame = Frame::zeroed(self.inner.scene.waveform().shape());
        let report = self.inner.simulate_into(index, &mut frame);
        (frame, report)
    }

    /// Simulates only the echoes of people in a frame, without static echoes and receiver noise, LSB:
    /// `[rx][chirp][sample]`.
    pub fn echo_samples(&self, index: u64) -> Vec<f32> {
        self.inner.echo_samples(index, None)
    }

    /// Simulates the same as [`echo_samples`](Simulator::echo_samples), with a fixed number of halvings of the frame.
    /// Paths and skins are traced at the ends of all parts, without error control at the midpoints. Seven halvings
    /// trace anew in every one of 128 chirps.
    pub fn echo_samples_halved(&self, index: u64, halvings: u32) -> Vec<f32> {
        self.inner.echo_samples(index, Some(halvings.min(12)))
    }

    /// Simulates one chirp of the echoes of people by the slow reference method, LSB: `[rx][sample]`. It is dense
    /// physical optics over the skins, anew in every chirp, in f64, by all pairs of images whose level is above the
    /// noise of a cell less `margin_db`. A frame takes minutes. People modelled as ellipsoids have no such echoes.
    pub fn dense_echo_chirp(&self, index: u64, chirp: usize, margin_db: f64) -> Vec<Vec<f64>> {
        self.inner.dense_echo_chirp(index, chirp, margin_db)
    }

    /// Cost of simulating the stream's last frame.
    pub fn last_report(&self) -> Option<&FrameReport> {
        self.last_report.as_ref()
    }

    /// Ground truth of a frame.
    pub fn truth(&self, index: u64) -> Truth {
        self.inner.truth(index)
    }

    /// Ground truth of a frame that begins at any time of the scene, as [`frame_at`](Simulator::frame_at) simulates it.
    pub fn truth_at(&self, start_s: f64) -> Truth {
        self.inner.truth_at(start_s)
    }

    /// Returns the people and their places in the middle of a frame, including people outside the room.
    pub fn people(&self, index: u64) -> Vec<PersonState> {
        self.inner.people(index)
    }

    /// Scene with the values that its seed drew.
    pub fn scene(&self) -> &Scene {
        &self.inner.scene
    }

    /// Sets the index of the stream's next frame.
    pub fn seek(&mut self, index: u64) {
        self.next = index;
        self.queue.clear();
    }

    /// Queues enough frames to keep all threads busy while one frame is processed.
    fn fill_queue(&mut self) {
        let pool = self.pool.as_deref();
        let threads = pool.map_or_else(rayon::current_num_threads, ThreadPool::current_num_threads);
        let limit = 2 * threads.max(1) as u64;
        let remaining = self.inner.options.frames.map_or(u64::MAX, |n| n.saturating_sub(self.next));
        for i in self.queue.len() as u64..limit.min(remaining) {
            let (inner, index) = (Arc::clone(&self.inner), self.next.saturating_add(i));
            let mut frame = self.spare.pop().unwrap_or_else(|| Frame::zeroed(self.waveform().shape()));
            self.queue.push_back(Queued::new(pool, move || {
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
        self.fill_queue();
        let Some(queued) = self.queue.pop_front() else { return Ok(SourceEvent::End) };
        let index = self.next;
        self.next = index.saturating_add(1);
        match queued.wait() {
            Some((simulated, report)) => {
                self.last_report = Some(report);
                self.spare.push(std::mem::replace(frame, simulated));
            }
            None => self.last_report = Some(self.inner.simulate_into(index, frame)),
        }
        Ok(SourceEvent::Frame)
    }

    fn frame_count(&self) -> Option<u64> {
        self.inner.options.frames
    }
}
