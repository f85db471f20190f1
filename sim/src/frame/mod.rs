//! Simulation of one frame of a scene, a pure function of (scene, seed, index). The steps are truth, paths, clutter,
//! chirps and receiver, each in its own file. `skins.rs` has the paths of people who are meshes.

use std::sync::{Arc, Mutex};

use radome_dsp::{Frame, FrameShape, Waveform};

use crate::echo::diffuse::Thinning;
use crate::echo::skin::SkinnedPerson;
use crate::em::curved_triangle::Integrator;
use crate::people::motion::Motion;
use crate::prepared_scene::PreparedScene;
use crate::random::{Purpose, draw, generator};
use crate::receiver::RxChannel;
use crate::receiver::adc::leakage_chirp_lsb;
use crate::receiver::noise::{NoiseShaper, channel_density_lsb2};
use crate::receiver::phase_noise::PhaseRates;
use crate::receiver::spurs::Spurs;
use crate::scenario::Scenario;
use crate::scene::Scene;
use crate::scene::ground::Floor;
use crate::sway::SwayingReflectors;
use crate::synthesis::Synthesiser;
use chirp_distortion::ChirpDistortions;
use receiver::{FrameInputs, PhaseNoiseInputs};

mod chirp_distortion;
mod chirps;
mod clutter;
mod held_runs;
mod paths;
mod receiver;
mod report;
mod skins;
mod truth;

pub use report::{FrameReport, PersonState};

/// Returns the distance below the noise of a cell at which a path is left out, dB. Paths 10 dB below it add half a
/// decibel to a cell just above noise.
fn margin_db(tolerance_db: f64) -> f64 {
    10.0 - 20.0 * (tolerance_db / 0.5).log10()
}

/// Options of a simulation other than the scene.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SimulateOptions {
    /// Seed of all random draws.
    pub seed: u64,
    /// Largest number of people (slots of visits, people at a desk, actors): the scene's own number if `None`, and 0
    /// for an empty room.
    pub people: Option<usize>,
    /// Number of frames; endless if `None`.
    pub frames: Option<u64>,
    /// Error, dB, of the echoes in the maps, rms over the cells in which they exceed the receiver's noise. It
    /// determines which echoes are left out and how finely the rest is integrated.
    pub tolerance_db: f64,
}

impl Default for SimulateOptions {
    fn default() -> Self {
        SimulateOptions { seed: 0, people: None, frames: None, tolerance_db: 0.5 }
    }
}

/// State of a scene and a seed that all frames share.
#[derive(Debug)]
pub(crate) struct FrameSimulator {
    pub(crate) scene: Scene,
    pub(crate) options: SimulateOptions,
    scenario: Scenario,
    /// Floor area in which people count as in the room.
    floor: Floor,
    prepared: PreparedScene,
    /// Part of the diffuse echoes that is computed.
    thinning: Thinning,
    sway: SwayingReflectors,
    /// Errors common to all echoes of a chirp; `None` where there are none.
    distortions: Option<ChirpDistortions>,
    /// Spurious tones of each receiver.
    spurs: Vec<Spurs>,
    synthesiser: Synthesiser,
    /// Noise of each receiver, and a factor on it.
    noise: Vec<(NoiseShaper, f32)>,
    /// Leakage between the antennas in a chirp, for each receiver, LSB.
    leakage: Vec<Vec<f32>>,
    /// Factor on the jitter of leakage.
    leakage_jitter: f64,
    phase_rates: Option<PhaseRates>,
    integrator: Integrator,
    /// Cached meshes of people, the most recently used last; empty where people are ellipsoids.
    skins: Mutex<Vec<(Arc<Motion>, Arc<SkinnedPerson>)>>,
}

impl FrameSimulator {
    /// Traces the static paths and draws the people.
    pub(crate) fn new(scene: &Scene, options: SimulateOptions) -> Self {
        let prepared = PreparedScene::new(scene, options.seed, margin_db(options.tolerance_db));
        let waveform = scene.waveform();
        let samples = waveform.request.samples_per_chirp;
        let (noise_db, leakage_jitter) = match &scene.file().people.desk {
            Some(desk) => {
                let mut rng = generator(options.seed, Purpose::Desk, [3, 0]);
                let noise_db = draw(&mut rng, desk.noise_db);
                (noise_db, draw(&mut rng, desk.leakage_jitter_factor.map(f64::ln)).exp())
            }
            None => (0.0, 1.0),
        };
        let noise = |c: &RxChannel| {
            let density_lsb2 = channel_density_lsb2(scene.receiver(), c, waveform);
            (NoiseShaper::new(&density_lsb2, samples), 10f64.powf(0.05 * noise_db) as f32)
        };
        let noise = prepared.channels.iter().map(noise).collect();
        let leakage = prepared.channels.iter().map(|c| leakage_chirp_lsb(c, waveform)).collect();
        let spurs = |rx| Spurs::draw(&scene.receiver().noise, waveform.sample_rate_hz, options.seed, rx);
        tracing::debug!(scene = scene.name(), static_paths = prepared.static_paths.len(), "scene traced");
        FrameSimulator {
            scene: scene.clone(),
            options,
            scenario: Scenario::new(scene, options.seed, options.people),
            floor: Floor::of(scene),
            thinning: Thinning::new(prepared.wall_points.len(), options.tolerance_db, prepared.threshold_lsb),
            sway: SwayingReflectors::new(scene, &prepared, options.seed),
            distortions: ChirpDistortions::new(scene, options.seed),
            spurs: (0..prepared.channels.len()).map(spurs).collect(),
            prepared,
            synthesiser: Synthesiser::new(samples),
            noise,
            leakage,
            leakage_jitter,
            phase_rates: scene.receiver().phase_noise.map(|noise| PhaseRates::new(&noise, waveform.sample_rate_hz)),
            integrator: Integrator::default(),
            skins: Mutex::default(),
        }
    }

    /// Simulates a frame at its own time.
    pub(crate) fn simulate_into(&self, index: u64, frame: &mut Frame) -> FrameReport {
        self.simulate_from(index, self.start_s(index), frame)
    }

    /// Simulates a frame whose first chirp is at another time.
    pub(crate) fn simulate_from(&self, index: u64, start_s: f64, frame: &mut Frame) -> FrameReport {
        let waveform = self.waveform();
        let shape: FrameShape = waveform.shape();
        frame.sequence = index;
        frame.time_ns = (start_s * 1e9).round() as u64;
        frame.host_time_ns = 0;
        frame.shape = shape;
        frame.temperature_millicelsius = None;
        frame.codes.clear();
        frame.codes.resize(shape.codes(), 0);

        let motions = self.motions(start_s);
        let instants = self.instants(&motions, start_s, None);
        let mut paths = self.trace_paths(&instants, None);
        // Tracing has already computed the bodies.
        let body = |person: usize, quarter: usize| instants.body_at_quarter(person, quarter);
        frame.truth = Some(self.truth_of(&motions, start_s, body));
        self.add_sway(start_s, &mut paths);
        let phase = self.phase_rates.as_ref().map(|rates| PhaseNoiseInputs { paths: paths.by_delay(), rates });
        let mut report = paths.report;
        let clutter = self.clutter(index, start_s, &paths);
        let middles_s = (0..shape.chirps).map(|chirp| self.middle_s(chirp));
        let distortions = self.distortions.as_ref().map(|generator| generator.of_frame(index, start_s, middles_s));
        let distortions = distortions.unwrap_or_default();
        let inputs = FrameInputs {
            index,
            start_s,
            paths: &paths,
            phase: phase.as_ref(),
            clutter: &clutter,
            distortions: &distortions,
        };
        report.clipped = self.simulate_channels(&inputs, frame);
        report
    }

    /// Returns the motions of all people present in a frame.
    fn motions(&self, start_s: f64) -> Vec<Arc<Motion>> {
        self.scenario.between(start_s, start_s + self.active_s()).into_iter().map(|(_, motion)| motion).collect()
    }

    fn waveform(&self) -> &Waveform {
        self.scene.waveform()
    }

    /// Returns the time of a frame's first sample, s.
    fn start_s(&self, index: u64) -> f64 {
        index as f64 * self.waveform().frame_interval_s()
    }

    /// Returns the duration of a frame's chirps, s.
    fn active_s(&self) -> f64 {
        let w = self.waveform();
        w.request.chirps_per_frame as f64 * w.chirp_interval_s
    }

    /// Returns the middle of a chirp, relative to the frame's first sample, s.
    fn middle_s(&self, chirp: usize) -> f64 {
        chirp as f64 * self.waveform().chirp_interval_s + self.prepared.chirp.middle_s
    }
}
