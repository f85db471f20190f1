//! Frames of a scene as a stream or one by one, in any order and on any number of threads.

use std::collections::VecDeque;
use std::sync::Arc;

use glam::DVec3;
use radome_dsp::{Frame, FrameSource, SourceError, SourceEvent, Truth, Waveform};
use rayon::prelude::*;
use thiserror::Error;

use crate::render::Renderer;
use crate::scene::Scene;

/// What may be chosen beside the scene.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SimulateOptions {
    /// All random draws depend on it.
    pub seed: u64,
    /// How many people there are at most (slots of visits, people at a desk, actors); the scene's own number if `None`, and
    /// 0 for an empty room.
    pub people: Option<usize>,
    /// End after this many frames; endless if `None`.
    pub frames: Option<u64>,
    /// Paths are left out when they are this far below the noise of a cell of the map, dB. More is slower and finer.
    pub tolerance_db: f64,
}

impl Default for SimulateOptions {
    fn default() -> Self {
        SimulateOptions { seed: 0, people: None, frames: None, tolerance_db: 10.0 }
    }
}

/// Options that cannot be met.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum SimError {
    /// More people than there are classes or actors for.
    #[error("simulation: {asked} people asked for, {scene} has room for at most {most}")]
    TooManyPeople {
        /// Asked for.
        asked: usize,
        /// The scene.
        scene: String,
        /// Most possible.
        most: usize,
    },
    /// The tolerance is not a number in range.
    #[error("simulation: tolerance_db is {got}, expected -60 to 80 dB")]
    Tolerance {
        /// What was given.
        got: f64,
    },
}

/// Where somebody is in a frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PersonState {
    /// Slot: the same person keeps it over a visit.
    pub slot: usize,
    /// Middle of the chest, m, in the room.
    pub position: DVec3,
    /// Its velocity, m/s.
    pub velocity: DVec3,
    /// Distance from the radar, m.
    pub range_m: f64,
    /// Radial speed, positive receding, m/s.
    pub radial_speed_m_per_s: f64,
    /// Whether any part is in the room.
    pub in_room: bool,
}

/// What it took to make a frame.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct FrameReport {
    /// Static paths.
    pub static_paths: usize,
    /// Moving paths that were evaluated at the keys.
    pub traced_paths: usize,
    /// Those of them that are strong enough to be heard, and so were synthesised.
    pub moving_paths: usize,
    /// Key times.
    pub keys: usize,
    /// Estimated power-weighted phase error of interpolation between keys, rad.
    pub phase_error_rad: f64,
    /// Amplitudes clamped because an antenna was nearer than 10 cm, or inside a body.
    pub clamped: usize,
    /// Codes at either end of the ADC.
    pub clipped: usize,
}

/// Frames of a scene.
#[derive(Debug, Clone)]
pub struct Simulator {
    inner: Arc<Renderer>,
    next: u64,
    ready: VecDeque<Frame>,
    spare: Vec<Frame>,
}

impl Simulator {
    /// Prepares a scene: traces what is static, draws who comes.
    pub fn new(scene: &Scene, options: SimulateOptions) -> Result<Self, SimError> {
        let people = &scene.file().people;
        let most = if people.actor.is_empty() { 2 } else { people.actor.len() };
        if let Some(asked) = options.people
            && asked > most
        {
            return Err(SimError::TooManyPeople { asked, scene: scene.name().to_owned(), most });
        }
        if !(options.tolerance_db >= -60.0 && options.tolerance_db <= 80.0) {
            return Err(SimError::Tolerance { got: options.tolerance_db });
        }
        let inner = Renderer::new(scene, options);
        Ok(Simulator { inner: Arc::new(inner), next: 0, ready: VecDeque::new(), spare: Vec::new() })
    }

    /// One frame, whichever came before.
    pub fn render(&self, index: u64) -> Frame {
        let mut frame = Frame::zeroed(self.inner.scene.waveform().shape());
        self.inner.render_into(index, &mut frame);
        frame
    }

    /// One frame, and what it took.
    pub fn render_with_report(&self, index: u64) -> (Frame, FrameReport) {
        let mut frame = Frame::zeroed(self.inner.scene.waveform().shape());
        let report = self.inner.render_into(index, &mut frame);
        (frame, report)
    }

    /// What is true of a frame.
    pub fn truth(&self, index: u64) -> Truth {
        self.inner.truth(index)
    }

    /// Who is where in the middle of a frame, those on their way outside the room included.
    pub fn people(&self, index: u64) -> Vec<PersonState> {
        self.inner.people(index)
    }

    /// The scene.
    pub fn scene(&self) -> &Scene {
        &self.inner.scene
    }

    /// The next frame of the stream is this one.
    pub fn seek(&mut self, index: u64) {
        self.next = index;
        self.spare.extend(self.ready.drain(..));
    }

    fn refill(&mut self) {
        let ahead = 2 * rayon::current_num_threads().max(1) as u64;
        let left = self.inner.options.frames.map_or(u64::MAX, |n| n.saturating_sub(self.next));
        let shape = self.inner.scene.waveform().shape();
        let mut batch: Vec<(u64, Frame)> = (0..ahead.min(left))
            .map(|i| (self.next + i, self.spare.pop().unwrap_or_else(|| Frame::zeroed(shape))))
            .collect();
        let inner = &self.inner;
        batch.par_iter_mut().for_each(|(index, frame)| {
            inner.render_into(*index, frame);
        });
        self.next += batch.len() as u64;
        self.ready.extend(batch.into_iter().map(|(_, frame)| frame));
    }
}

impl FrameSource for Simulator {
    fn waveform(&self) -> &Waveform {
        self.inner.scene.waveform()
    }

    fn next_frame(&mut self, frame: &mut Frame) -> Result<SourceEvent, SourceError> {
        if self.ready.is_empty() {
            self.refill();
        }
        match self.ready.pop_front() {
            Some(ready) => {
                self.spare.push(std::mem::replace(frame, ready));
                Ok(SourceEvent::Frame)
            }
            None => Ok(SourceEvent::End),
        }
    }

    fn frame_count(&self) -> Option<u64> {
        self.inner.options.frames
    }
}
