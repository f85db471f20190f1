//! One frame of a scene: truth, paths, chirps. A pure function of (scene, seed, index).

use std::ops::Range;
use std::sync::{Arc, Mutex, PoisonError};

use num_complex::{Complex, Complex64};
use radome_dsp::{Frame, FrameShape, Occupancy, Truth, Waveform};
use rand::Rng;
use rand_distr::{Distribution, StandardNormal};
use rand_xoshiro::Xoshiro256PlusPlus;
use rayon::prelude::*;

use crate::actor::body::{CHEST, SEGMENTS};
use crate::actor::motion::Motion;
use crate::actor::program::{Program, half_extent};
use crate::actor::skin::{EDGE_M, WalkingMesh};
use crate::diffuse;
use crate::echo::demand::{Demand, Missed};
use crate::echo::dense;
use crate::echo::skin::SkinnedPerson;
use crate::echo::{EchoReport, FrameTimes, Paths, Snapshot, audible_pairs, loud_pairs};
use crate::field::curved_triangle::Integrator;
use crate::field::highlight::Ellipsoid;
use crate::field::image::ImageIndex;
use crate::keys::{Instants, KeyDemand, KeyedPaths, MOST_HALVINGS};
use crate::random::{Purpose, generator};
use crate::receiver::RxChannel;
use crate::receiver::adc::{leakage_by_delay_lsb_s, leakage_chirp_lsb, quantise};
use crate::receiver::chirp_turn::{ChirpTurn, ChirpTurns};
use crate::receiver::noise::{NoiseScratch, NoiseShaper, channel_density_lsb2};
use crate::receiver::phase_noise::PhaseRates;
use crate::receiver::spurs::Spurs;
use crate::scene::Scene;
use crate::scene::file::{BodyFile, ShadowFile};
use crate::shadow::{self, Column};
use crate::simulator::{FrameReport, PersonState, SimulateOptions};
use crate::stage::{Stage, drift, drift_phases, threshold_lsb};
use crate::sway::SwayingReflectors;
use crate::synthesis::{CHIRPS, ChirpGrids, Grid, Grids, HeldEchoes, Places, SynthesisScratch, Synthesiser, Tone};
use crate::tracks::Tracks;

/// A frame's stretches between keys, for shades and skins, to begin with: halves, and halved again (quarters, eighths) while
/// skins between them are not predicted well enough.
const FIRST_HALVINGS: u32 = 1;
/// Most of that.
const MOST_SKIN_HALVINGS: u32 = 3;
/// What may be missed between keys of an ellipsoid's echo for half a decibel, relative to it (-40 dB of error vector magnitude):
/// weak paths have cells of their own in a map, where nothing stronger hides their errors.
const KEY_TOLERANCE: f64 = 0.01;
/// The same of all of a skin's echoes.
const SKIN_KEY_TOLERANCE: f64 = 0.03;
/// Truth is looked up at this many times of a frame: its quarters.
const TRUTH_TIMES: usize = 5;

/// How far below the noise of a cell a path is left out, dB: those of 10 dB below it add half a decibel to a cell that
/// stands just above it.
fn margin_db(tolerance_db: f64) -> f64 {
    10.0 - 20.0 * (tolerance_db / 0.5).log10()
}

/// Everything about a scene and a seed that frames share.
#[derive(Debug)]
pub(crate) struct Renderer {
    pub(crate) scene: Scene,
    pub(crate) options: SimulateOptions,
    program: Program,
    stage: Stage,
    /// Points of the walls that each segment of a body takes.
    points_a_segment: usize,
    sway: SwayingReflectors,
    /// Errors that all echoes of a chirp share; `None` where there are none.
    turns: Option<ChirpTurns>,
    /// Spurious tones of each receiver.
    spurs: Vec<Spurs>,
    synthesiser: Synthesiser,
    noise: Vec<(NoiseShaper, f32)>,
    leakage: Vec<Vec<f32>>,
    /// Factor on the jitter of leakage.
    leakage_jitter: f64,
    phase_rates: Option<PhaseRates>,
    integrator: Integrator,
    /// People as meshes, those last seen at the end; none where people are ellipsoids.
    skins: Mutex<Vec<(Arc<Motion>, Arc<SkinnedPerson>)>>,
}

/// Buffers of one frame.
#[derive(Default)]
struct Scratch {
    synthesis: SynthesisScratch,
    noise: NoiseScratch,
    chirp: Vec<f32>,
}

/// Everybody's paths in a frame.
struct Traced {
    /// `[end of a stretch][person]`.
    snapshots: Vec<Vec<Snapshot>>,
    /// How often the frame is halved into those stretches.
    halvings: u32,
    /// Paths to all receivers.
    tracks: Tracks,
    /// Diffuse echoes in each of those stretches; none where walls throw nothing about.
    diffuse: Vec<HeldEchoes>,
    /// Echoes of those who have a skin.
    skins: Option<ChirpGrids>,
    report: FrameReport,
}

impl Traced {
    /// The same paths, each times `j` and its delay.
    fn by_delay(&mut self) -> Self {
        Traced {
            snapshots: Vec::new(),
            halvings: self.halvings,
            tracks: self.tracks.by_delay(),
            diffuse: self.diffuse.iter().map(HeldEchoes::by_delay).collect(),
            skins: self.skins.as_mut().and_then(ChirpGrids::take_by_delay),
            report: self.report,
        }
    }
}

/// What phase noise multiplies in a frame: everybody's paths by delay, and the phase's rates.
struct NoisyPhase<'a> {
    traced: Traced,
    rates: &'a PhaseRates,
}

/// Everything that the receivers' parts of a frame share.
struct OfFrame<'a> {
    index: u64,
    /// Its first sample, s.
    start_s: f64,
    traced: &'a Traced,
    phase: Option<&'a NoisyPhase<'a>>,
    clutter: &'a Clutter,
    /// Errors of the chirps; empty where there are none.
    turns: &'a [ChirpTurn],
}

/// Weights of static paths in a frame.
struct Clutter {
    /// `[time][path]`.
    weights: Vec<Vec<Complex64>>,
    /// Whether the times are the middles of all chirps; the ends of the frame's stretches if not.
    by_chirp: bool,
}

/// Grids of static paths at the same times.
struct StaticGrids {
    /// `[rx][time]`.
    grids: Vec<Vec<Grid>>,
    by_chirp: bool,
}

/// Nothing static.
const NO_STATIC: StaticGrids = StaticGrids { grids: Vec::new(), by_chirp: false };

/// What one receiver adds to the echoes of a frame, chirp after chirp.
struct Channel<'a> {
    noise: Xoshiro256PlusPlus,
    phase_noise: Xoshiro256PlusPlus,
    /// Spurious tones, and their phases.
    spurs: Option<(&'a Spurs, Xoshiro256PlusPlus)>,
    /// Offset, LSB, and factor on leakage.
    offset: (f32, f32),
    leakage: &'a [f32],
    shaper: Option<&'a (NoiseShaper, f32)>,
}

/// Skins of this many people are kept: those in the room, and who comes next.
const MOST_SKINS: usize = 8;

impl Renderer {
    /// Traces what is static, draws who comes.
    pub(crate) fn new(scene: &Scene, options: SimulateOptions) -> Self {
        let stage = Stage::new(scene, options.seed, margin_db(options.tolerance_db));
        let waveform = scene.waveform();
        let samples = waveform.request.samples_per_chirp;
        let (noise_db, leakage_jitter) = match &scene.file().people.desk {
            Some(desk) => {
                let mut rng = generator(options.seed, Purpose::Desk, [3, 0]);
                let [low, high] = desk.noise_db;
                let noise_db = low + (high - low) * rng.random::<f64>();
                let [low, high] = desk.leakage_jitter_factor.map(f64::ln);
                (noise_db, (low + (high - low) * rng.random::<f64>()).exp())
            }
            None => (0.0, 1.0),
        };
        let noise = |c: &RxChannel| {
            let density_lsb2 = channel_density_lsb2(scene.receiver(), c, waveform);
            (NoiseShaper::new(&density_lsb2, samples), 10f64.powf(0.05 * noise_db) as f32)
        };
        let noise = stage.channels.iter().map(noise).collect();
        let leakage = stage.channels.iter().map(|c| leakage_chirp_lsb(c, waveform)).collect();
        let spurs = |rx| Spurs::draw(&scene.receiver().noise, waveform.sample_rate_hz, options.seed, rx);
        tracing::debug!(scene = scene.name(), static_paths = stage.static_paths.len(), "scene traced");
        Renderer {
            scene: scene.clone(),
            options,
            program: Program::new(scene, options.seed, options.people),
            points_a_segment: diffuse::points_a_segment(stage.wall_points.len(), options.tolerance_db),
            sway: SwayingReflectors::new(scene, &stage, options.seed),
            turns: ChirpTurns::new(scene, options.seed),
            spurs: (0..stage.channels.len()).map(spurs).collect(),
            stage,
            synthesiser: Synthesiser::new(samples),
            noise,
            leakage,
            leakage_jitter,
            phase_rates: scene.receiver().phase_noise.map(|noise| PhaseRates::new(&noise, waveform.sample_rate_hz)),
            integrator: Integrator::default(),
            skins: Mutex::default(),
        }
    }

    /// Somebody's skin; `None` where people are ellipsoids.
    fn skin(&self, motion: &Arc<Motion>) -> Option<Arc<SkinnedPerson>> {
        if self.scene.file().people.body != BodyFile::Mesh {
            return None;
        }
        let mut skins = self.skins.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(at) = skins.iter().position(|(of, _)| Arc::ptr_eq(of, motion)) {
            let kept = skins.remove(at);
            let skin = Arc::clone(&kept.1);
            skins.push(kept);
            return Some(skin);
        }
        let skin = Arc::new(SkinnedPerson::new(WalkingMesh::new(Arc::clone(motion), EDGE_M)));
        if skins.len() >= MOST_SKINS {
            skins.remove(0);
        }
        skins.push((Arc::clone(motion), Arc::clone(&skin)));
        Some(skin)
    }

    fn waveform(&self) -> &Waveform {
        self.scene.waveform()
    }

    fn start_s(&self, index: u64) -> f64 {
        index as f64 * self.waveform().frame_interval_s()
    }

    /// From the first sample of a frame to its last chirp's middle, s.
    fn active_s(&self) -> f64 {
        let w = self.waveform();
        w.request.chirps_per_frame as f64 * w.chirp_interval_s
    }

    pub(crate) fn truth(&self, index: u64) -> Truth {
        let start_s = self.start_s(index);
        let motions = self.motions(start_s);
        self.truth_of(&motions, start_s, |person, time| {
            Some(motions.get(person)?.body(self.truth_time_s(start_s, time)))
        })
    }

    /// Time at which truth is looked up, s.
    fn truth_time_s(&self, start_s: f64, time: usize) -> f64 {
        start_s + self.active_s() * time as f64 / (TRUTH_TIMES - 1) as f64
    }

    /// What is true of a frame, given the bodies of people by the number of the time.
    fn truth_of(
        &self,
        motions: &[Arc<Motion>],
        start_s: f64,
        body: impl Fn(usize, usize) -> Option<[Ellipsoid; SEGMENTS]>,
    ) -> Truth {
        let size = self.stage.room.size_m;
        let (mut count, mut transition) = (0, false);
        for (person, motion) in motions.iter().enumerate() {
            let (mut in_room, mut outside) = (false, false);
            for time in 0..TRUTH_TIMES {
                if !motion.exists(self.truth_time_s(start_s, time)) {
                    outside = true;
                    continue;
                }
                for segment in body(person, time).iter().flatten() {
                    let half = half_extent(segment);
                    let (low, high) = (segment.centre - half, segment.centre + half);
                    in_room |= high.x > 0.0 && high.y > 0.0 && low.x < size.x && low.y < size.y;
                    outside |= low.x < 0.0 || low.y < 0.0 || high.x > size.x || high.y > size.y;
                }
            }
            count += usize::from(in_room);
            transition |= in_room && outside;
        }
        let occupancy = Occupancy::from_index(count.min(2)).unwrap_or(Occupancy::Two);
        Truth { occupancy, transition }
    }

    /// How everybody moves who is there in a frame.
    fn motions(&self, start_s: f64) -> Vec<Arc<Motion>> {
        self.program.between(start_s, start_s + self.active_s()).into_iter().map(|(_, motion)| motion).collect()
    }

    pub(crate) fn people(&self, index: u64) -> Vec<PersonState> {
        let t = self.start_s(index) + 0.5 * self.active_s();
        let radar = self.scene.radar_position();
        let size = self.stage.room.size_m;
        let state = |(slot, motion): (usize, Arc<Motion>)| {
            let at = |t: f64| motion.body(t)[CHEST].centre;
            let h = 5e-4;
            let (position, velocity) = (at(t), (at(t + h) - at(t - h)) / (2.0 * h));
            let offset = position - radar;
            let in_room = motion.body(t).iter().any(|s| {
                let half = half_extent(s);
                (s.centre + half).min_element() > 0.0 && s.centre.x - half.x < size.x && s.centre.y - half.y < size.y
            });
            PersonState {
                slot,
                position,
                velocity,
                range_m: offset.length(),
                radial_speed_m_per_s: velocity.dot(offset.normalize_or_zero()),
                in_room,
            }
        };
        self.program.between(t, t).into_iter().map(state).collect()
    }

    /// What is asked of skins.
    fn demand(&self) -> Demand {
        let noise_lsb = threshold_lsb(self.scene.receiver(), self.waveform(), 0.0);
        Demand { tolerance_db: self.options.tolerance_db, noise_lsb }
    }

    /// Ends of a frame's stretches, s.
    fn ends_s(&self, start_s: f64, halvings: u32) -> Vec<f64> {
        let stretches = 1u32 << halvings;
        (0..=stretches).map(|k| start_s + self.active_s() * f64::from(k) / f64::from(stretches)).collect()
    }

    /// Echoes of everybody's skins, and what they miss.
    fn skin_echoes(
        &self,
        motions: &[Arc<Motion>],
        snapshots: &[Vec<Snapshot>],
        keys_s: Vec<f64>,
        report: &mut EchoReport,
    ) -> (ChirpGrids, Missed) {
        let shape = self.waveform().shape();
        let (start_s, middle) = (keys_s.first().copied().unwrap_or_default(), keys_s.len() / 2);
        let now = snapshots.get(middle).map(Vec::as_slice).unwrap_or_default();
        let chirp = |i: usize| start_s + i as f64 * self.waveform().chirp_interval_s;
        let chirps_s = (0..shape.chirps).map(|i| chirp(i) + self.stage.chirp.middle_s).collect();
        let times = FrameTimes::new(keys_s, chirps_s);
        let (demand, stage, integrator) = (self.demand(), &self.stage, &self.integrator);
        let mut grids = ChirpGrids::new(&self.synthesiser, shape.rx, shape.chirps);
        if self.phase_rates.is_some() {
            grids = grids.with_delays();
        }
        let mut most = Missed::default();
        for (me, motion) in motions.iter().enumerate() {
            let Some(skin) = self.skin(motion) else { continue };
            let pairs = audible_pairs(stage, motion, start_s + 0.5 * self.active_s());
            let loud = loud_pairs(stage, motion, now, me, &pairs);
            let missed = skin.add_echoes(stage, integrator, &demand, &times, snapshots, me, &loud, &mut grids, report);
            most = most.max(missed);
        }
        (grids, most)
    }

    pub(crate) fn render_into(&self, index: u64, frame: &mut Frame) -> FrameReport {
        self.render_from(index, self.start_s(index), frame)
    }

    /// The same with its first chirp at another time.
    pub(crate) fn render_from(&self, index: u64, start_s: f64, frame: &mut Frame) -> FrameReport {
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
        let mut traced = self.traced(&instants, None);
        // Bodies that paths were traced by are known by now.
        let body = |person: usize, quarter: usize| instants.body_at_quarter(person, quarter);
        frame.truth = Some(self.truth_of(&motions, start_s, body));
        self.add_sway(start_s, &mut traced);
        let phase = self.phase_rates.as_ref().map(|rates| NoisyPhase { traced: traced.by_delay(), rates });
        let mut report = traced.report;
        let clutter = self.clutter(index, start_s, &traced);
        let middles_s = (0..shape.chirps).map(|chirp| self.middle_s(chirp));
        let turns = self.turns.as_ref().map(|turns| turns.of_frame(index, start_s, middles_s)).unwrap_or_default();
        let of_frame =
            OfFrame { index, start_s, traced: &traced, phase: phase.as_ref(), clutter: &clutter, turns: &turns };
        report.clipped = self.render_channels(&of_frame, frame);
        report
    }

    /// Middle of a chirp, counted from the frame's first sample, s.
    fn middle_s(&self, chirp: usize) -> f64 {
        chirp as f64 * self.waveform().chirp_interval_s + self.stage.chirp.middle_s
    }

    /// Adds the echoes of swaying reflectors to the paths of a frame.
    fn add_sway(&self, start_s: f64, traced: &mut Traced) {
        let columns = columns(&traced.snapshots);
        self.sway.add(start_s, self.active_s(), &columns, self.stage.wavelength_m, &mut traced.tracks);
    }

    /// Everybody in a frame, at the times that its paths may take if they are halved this often.
    fn instants<'a>(&self, motions: &'a [Arc<Motion>], start_s: f64, halvings: Option<u32>) -> Instants<'a> {
        let most = MOST_HALVINGS.max(MOST_SKIN_HALVINGS).max(halvings.unwrap_or(0));
        Instants::new(motions, start_s, self.active_s(), most)
    }

    /// Everybody's paths in a frame, at as many keys as it takes, or halved this often.
    fn traced(&self, instants: &Instants, halvings: Option<u32>) -> Traced {
        let mut traced = match self.scene.file().people.body {
            BodyFile::Mesh => self.traced_skins(instants, halvings),
            BodyFile::Ellipsoids => self.traced_highlights(instants, halvings),
        };
        if !self.stage.wall_points.is_empty() {
            let stretch_s = self.active_s() / f64::from(1u32 << traced.halvings);
            traced.diffuse = vec![HeldEchoes::new(stretch_s); 1 << traced.halvings];
            for me in 0..instants.motions().len() {
                diffuse::add(&self.stage, self.points_a_segment, &traced.snapshots, me, &mut traced.diffuse);
            }
        }
        traced
    }

    /// The same of ellipsoids, without what walls throw in all directions.
    fn traced_highlights(&self, instants: &Instants, halvings: Option<u32>) -> Traced {
        let (paths, echo_report) =
            self.keyed_paths(instants, halvings, |me, motion, pairs| Some(Paths::new(&self.stage, motion, me, pairs)));
        let report = FrameReport {
            static_paths: self.stage.static_paths.len(),
            traced_paths: paths.traced,
            moving_paths: paths.heard,
            keys: paths.keys,
            between_keys: paths.error(),
            estimate_db: None,
            clamped: echo_report.clamped,
            clipped: 0,
        };
        let snapshots = instants.at_ends(FIRST_HALVINGS);
        Traced { snapshots, halvings: FIRST_HALVINGS, tracks: paths.tracks, diffuse: Vec::new(), skins: None, report }
    }

    /// Some of everybody's paths, each at as many keys as it takes.
    fn keyed_paths<'a>(
        &'a self,
        instants: &Instants<'a>,
        halvings: Option<u32>,
        of: impl Fn(usize, &'a Motion, &[(ImageIndex, ImageIndex)]) -> Option<Paths<'a>>,
    ) -> (KeyedPaths, EchoReport) {
        let demand = KeyDemand {
            // 6 dB further down than a path alone in its cell, since many weak ones add up; errors further still.
            heard_lsb: 0.5 * self.stage.threshold_lsb,
            least_lsb: 0.02 * self.stage.threshold_lsb,
            tolerance: KEY_TOLERANCE * self.options.tolerance_db / 0.5,
            halvings,
            frequency_hz: self.stage.chirp.start_hz,
        };
        let mut paths = KeyedPaths::default();
        let mut report = EchoReport::default();
        for (me, motion) in instants.motions().iter().enumerate() {
            let pairs = audible_pairs(&self.stage, motion, instants.start_s() + 0.5 * self.active_s());
            if let Some(some) = of(me, motion, &pairs) {
                paths.add(instants, &some, &demand, &mut report);
            }
        }
        (paths, report)
    }

    /// The same where people have skins.
    fn traced_skins(&self, instants: &Instants, asked: Option<u32>) -> Traced {
        let mut halvings = asked.unwrap_or(FIRST_HALVINGS);
        loop {
            let mut echo_report = EchoReport::default();
            let ends_s = self.ends_s(instants.start_s(), halvings);
            let (keys, snapshots) = (ends_s.len(), instants.at_ends(halvings));
            let (grids, missed) = self.skin_echoes(instants.motions(), &snapshots, ends_s, &mut echo_report);
            if missed.between_keys > SKIN_KEY_TOLERANCE && halvings < MOST_SKIN_HALVINGS && asked.is_none() {
                halvings += 1;
                continue;
            }
            let (folds, of_folds) =
                self.keyed_paths(instants, None, |me, motion, pairs| Paths::of_folds(&self.stage, motion, me, pairs));
            echo_report.clamped += of_folds.clamped;
            let report = FrameReport {
                static_paths: self.stage.static_paths.len(),
                traced_paths: echo_report.paths / keys + folds.traced,
                moving_paths: echo_report.synthesised + folds.heard,
                keys,
                between_keys: missed.between_keys,
                estimate_db: (!instants.motions().is_empty()).then(|| missed.db()),
                clamped: echo_report.clamped,
                clipped: 0,
            };
            let (tracks, skins) = (folds.tracks, Some(grids));
            return Traced { snapshots, halvings, tracks, diffuse: Vec::new(), skins, report };
        }
    }

    /// What comes back from people alone, without anything static and without a receiver's noise, LSB: `[rx][chirp][sample]`.
    pub(crate) fn echo_samples(&self, index: u64, halvings: Option<u32>) -> Vec<f32> {
        let shape = self.waveform().shape();
        let start_s = self.start_s(index);
        let motions = self.motions(start_s);
        let traced = self.traced(&self.instants(&motions, start_s, halvings), halvings);
        let mut scratch = SynthesisScratch::default();
        let mut all = vec![0f32; shape.codes()];
        self.each_chirp(&traced, &NO_STATIC, &[], |rx, chirp, grid| {
            let first = (rx * shape.chirps + chirp) * shape.samples;
            if let Some(samples) = all.get_mut(first..first + shape.samples) {
                self.synthesiser.transform(grid, samples, &mut scratch);
            }
        });
        all
    }

    /// The same the slow way ([`dense`]): skins only.
    pub(crate) fn dense_echo_samples(&self, index: u64, margin_db: f64) -> Vec<f64> {
        let shape = self.waveform().shape();
        let chirp = |chirp| self.dense_echo_chirp(index, chirp, margin_db);
        let chirps: Vec<Vec<Vec<f64>>> = (0..shape.chirps).into_par_iter().map(chirp).collect();
        (0..shape.rx).flat_map(|rx| chirps.iter().flat_map(move |c| c[rx].iter().copied())).collect()
    }

    /// One chirp of it: `[rx][sample]`.
    pub(crate) fn dense_echo_chirp(&self, index: u64, chirp: usize, margin_db: f64) -> Vec<Vec<f64>> {
        let (shape, start_s) = (self.waveform().shape(), self.start_s(index));
        let motions = self.motions(start_s);
        let mut stage = self.stage.clone();
        stage.threshold_lsb = threshold_lsb(self.scene.receiver(), self.waveform(), margin_db);
        let middle_s = start_s + 0.5 * self.active_s();
        let middle: Vec<Snapshot> = motions.iter().map(|m| Snapshot::new(m, middle_s)).collect();
        let time_s = start_s + chirp as f64 * self.waveform().chirp_interval_s + stage.chirp.middle_s;
        let people: Vec<Snapshot> = motions.iter().map(|m| Snapshot::new(m, time_s)).collect();
        let mut sum = vec![vec![0.0; shape.samples]; shape.rx];
        for (me, motion) in motions.iter().enumerate() {
            let Some(skin) = self.skin(motion) else { continue };
            let pairs = audible_pairs(&stage, motion, middle_s);
            let pairs = loud_pairs(&stage, motion, &middle, me, &pairs);
            let pairs: Vec<_> = pairs.into_iter().map(|(pair, _)| pair).collect();
            let own = dense::chirp(&stage, &skin, &people, me, &pairs, time_s, shape.samples);
            for (sum, own) in sum.iter_mut().flatten().zip(own.iter().flatten()) {
                *sum += own;
            }
        }
        sum
    }

    /// Weights of all static paths in a frame: in every chirp where people diffract them, at the ends of stretches if not.
    fn clutter(&self, index: u64, start_s: f64, traced: &Traced) -> Clutter {
        let is_strip = self.scene.file().people.shadow == ShadowFile::Strip;
        let has_people = traced.snapshots.iter().any(|people| !people.is_empty());
        if !(is_strip && has_people) {
            let weights = self.clutter_weights(index, &self.ends_s(start_s, traced.halvings), &traced.snapshots);
            return Clutter { weights, by_chirp: false };
        }
        let without_people = self.clutter_weights(index, &[start_s], &[Vec::new()]);
        let without_people = without_people.first().map(Vec::as_slice).unwrap_or_default();
        let (at_ends, active_s) = (columns(&traced.snapshots), self.active_s());
        let weights: Vec<Vec<Complex64>> = (0..self.waveform().shape().chirps)
            .map(|chirp| {
                let people = columns_between(&at_ends, self.middle_s(chirp) / active_s);
                let paths = self.stage.static_paths.iter().zip(without_people);
                // Conjugated, as amplitudes at the ADC are.
                paths
                    .map(|(path, weight)| {
                        weight * shadow::along_strips(&path.polyline, &people, self.stage.wavelength_m).conj()
                    })
                    .collect()
            })
            .collect();
        Clutter { weights, by_chirp: true }
    }

    /// Complex weight of every static path at the ends of stretches: `[end][path]`.
    fn clutter_weights(&self, index: u64, ends_s: &[f64], snapshots: &[Vec<Snapshot>]) -> Vec<Vec<Complex64>> {
        let constants = &self.scene.receiver().clutter;
        let mut rng = generator(self.options.seed, Purpose::FrameJitter, [index, 0]);
        let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
        let steps = self.clutter_steps(index);
        // Half of the power of jitter and drift is common to all echoes, half each one's own.
        let half = constants.phase_jitter_rad * 0.5f64.sqrt();
        let half_drift = constants.phase_drift_rad_per_10s * 0.5f64.sqrt();
        let common = half * normal();
        let jitter: Vec<Complex64> = self
            .stage
            .static_paths
            .iter()
            .map(|_| {
                let phase = common + half * normal();
                Complex64::from_polar((1.0 + constants.amplitude_jitter * normal()).max(0.0), phase)
            })
            .collect();
        ends_s
            .iter()
            .zip(snapshots)
            .map(|(&t, people)| {
                let columns: Vec<_> = people.iter().map(|p| p.column).collect();
                let common = drift(t, &self.stage.common_drift);
                let paths = self.stage.static_paths.iter().zip(&jitter);
                paths
                    .enumerate()
                    .map(|(i, (path, jitter))| {
                        let shade = shadow::along(&path.polyline, &columns, self.stage.wavelength_m);
                        let step = steps.get(i).copied().unwrap_or_default();
                        let turn = half_drift * (common + drift(t, &path.drift)) + step;
                        jitter * Complex64::from_polar(shade, turn)
                    })
                    .collect()
            })
            .collect()
    }

    /// Phase of every static path by the steps before a frame, rad; nothing where there are none. Time is cut into intervals
    /// with one step each, anywhere in it; between two steps paths rest at levels whose differences are the steps.
    fn clutter_steps(&self, index: u64) -> Vec<f64> {
        let constants = &self.scene.receiver().clutter;
        if constants.phase_step_rad == 0.0 {
            return Vec::new();
        }
        let at = self.start_s(index) / constants.phase_step_interval_s;
        let interval = at as u64;
        let step = generator(self.options.seed, Purpose::ClutterStep, [interval, 0]).random::<f64>();
        let level = interval + u64::from(at - interval as f64 >= step);
        let mut rng = generator(self.options.seed, Purpose::ClutterStep, [level, 1]);
        let sigma_rad = constants.phase_step_rad * 0.5f64.sqrt();
        let phase = |_| {
            let normal: f64 = StandardNormal.sample(&mut rng);
            sigma_rad * normal
        };
        self.stage.static_paths.iter().map(phase).collect()
    }

    /// Samples of all receivers of a frame; returns how many lie at an end of the ADC's range.
    fn render_channels(&self, of_frame: &OfFrame, frame: &mut Frame) -> usize {
        let &OfFrame { index, start_s, traced, phase, clutter, turns } = of_frame;
        let shape = self.waveform().shape();
        let static_grids = self.static_grids(clutter, false);
        let by_delay = phase.map(|phase| self.by_delay(phase, clutter, turns)).unwrap_or_default();
        let mut channels: Vec<Channel> = (0..shape.rx).map(|rx| self.channel(rx, index)).collect();
        let (mut scratch, mut clipped) = (Scratch::default(), 0);
        self.each_chirp(traced, &static_grids, turns, |rx, chirp, grid| {
            let Some(channel) = channels.get_mut(rx) else { return };
            let (offset, leakage_scale) = channel.offset;
            scratch.chirp.clear();
            scratch.chirp.extend(channel.leakage.iter().map(|l| offset + l * leakage_scale));
            self.synthesiser.transform(grid, &mut scratch.chirp, &mut scratch.synthesis);
            let first = (rx * shape.chirps + chirp) * shape.samples;
            if let (Some(phase), Some(beside)) = (phase, by_delay.get(first..first + shape.samples)) {
                phase.rates.add(&mut channel.phase_noise, beside, &mut scratch.chirp);
            }
            if let Some((spurs, phases)) = &mut channel.spurs {
                let first_s = start_s + chirp as f64 * self.waveform().chirp_interval_s;
                spurs.add(first_s, phases, &mut scratch.chirp);
            }
            if let Some((shaper, scale)) = channel.shaper {
                shaper.add(&mut channel.noise, *scale, &mut scratch.chirp, &mut scratch.noise);
            }
            if let Some(codes) = frame.codes.get_mut(first..first + shape.samples) {
                for (code, x) in codes.iter_mut().zip(&scratch.chirp) {
                    *code = quantise(*x);
                    clipped += usize::from(*code == 0 || *code == radome_dsp::MAX_CODE);
                }
            }
        });
        clipped
    }

    /// What a receiver adds to the echoes of a frame.
    fn channel(&self, rx: usize, index: u64) -> Channel<'_> {
        let seed = self.options.seed;
        // Runs of one seed with other numbers of people are other recordings: where nobody is seen they are not copies.
        let people = self.options.people.map_or(0, |people| people as u64 + 1) << 32;
        Channel {
            noise: generator(seed, Purpose::Noise, [index, people | rx as u64]),
            // The same phase in all receivers.
            phase_noise: generator(seed, Purpose::PhaseNoise, [index, 0]),
            spurs: self.spurs.get(rx).map(|spurs| (spurs, spurs.phases(index))),
            offset: self.offset(rx, index),
            leakage: self.leakage.get(rx).map(Vec::as_slice).unwrap_or_default(),
            shaper: self.noise.get(rx),
        }
    }

    /// Grids of static paths at the times of their weights; with every tone times `j` and its delay if so asked.
    fn static_grids(&self, clutter: &Clutter, is_by_delay: bool) -> StaticGrids {
        let of = |rx: usize| clutter.weights.iter().map(|weights| self.static_grid(rx, weights, is_by_delay)).collect();
        StaticGrids { grids: (0..self.waveform().shape().rx).map(of).collect(), by_chirp: clutter.by_chirp }
    }

    /// What stands beside the phase's rate in every sample, LSB s: `[rx][chirp][sample]`.
    fn by_delay(&self, phase: &NoisyPhase, clutter: &Clutter, turns: &[ChirpTurn]) -> Vec<f32> {
        let shape = self.waveform().shape();
        let grids = self.static_grids(clutter, true);
        let leakage = |channel: &RxChannel| leakage_by_delay_lsb_s(channel, self.waveform());
        let leakage: Vec<Vec<f32>> = self.stage.channels.iter().map(leakage).collect();
        let mut scratch = SynthesisScratch::default();
        let mut all = vec![0f32; shape.codes()];
        self.each_chirp(&phase.traced, &grids, turns, |rx, chirp, grid| {
            let first = (rx * shape.chirps + chirp) * shape.samples;
            if let (Some(samples), Some(leakage)) = (all.get_mut(first..first + shape.samples), leakage.get(rx)) {
                samples.iter_mut().zip(leakage).for_each(|(sample, leakage)| *sample = *leakage);
                self.synthesiser.transform(grid, samples, &mut scratch);
            }
        });
        all
    }

    /// The frequency grid of every chirp of every receiver: static grids, paths, and skins, with the errors that all echoes of the
    /// chirp share, if there are any. Chirps of a receiver come in their order.
    fn each_chirp(
        &self,
        traced: &Traced,
        static_grids: &StaticGrids,
        turns: &[ChirpTurn],
        mut visit: impl FnMut(usize, usize, &Grid),
    ) {
        let shape = self.waveform().shape();
        let mut grids = vec![self.synthesiser.grids(); shape.rx];
        let mut grid = self.synthesiser.grid();
        for begin in (0..shape.chirps).step_by(CHIRPS) {
            let end = (begin + CHIRPS).min(shape.chirps);
            self.lay_static(begin..end, traced.halvings, static_grids, &mut grids);
            for halvings in (0..=traced.tracks.most_halvings()).filter(|&h| !traced.tracks.is_empty_at(h)) {
                for (stretch, places) in self.stretches_of(begin..end, halvings) {
                    let tracks = traced.tracks.at(halvings, stretch);
                    self.synthesiser.spread_tracks(&self.stage.chirp, tracks, &places, &mut grids);
                }
            }
            if !traced.diffuse.is_empty() {
                for (stretch, places) in self.stretches_of(begin..end, traced.halvings) {
                    if let Some(echoes) = traced.diffuse.get(stretch) {
                        self.synthesiser.spread_held(&self.stage.chirp, echoes, &places, &mut grids);
                    }
                }
            }
            for (rx, grids) in grids.iter().enumerate() {
                for (lane, chirp) in (begin..end).enumerate() {
                    grids.extract(lane, &mut grid);
                    if let Some(skins) = &traced.skins {
                        skins.add_to(rx, chirp, &mut grid);
                    }
                    if static_grids.by_chirp
                        && let Some(own) = static_grids.grids.get(rx).and_then(|grids| grids.get(chirp))
                    {
                        grid.add(own);
                    }
                    if let Some(turn) = turns.get(chirp) {
                        let factor = Complex::new(turn.factor.re as f32, turn.factor.im as f32);
                        self.synthesiser.turn(factor, turn.late_s * self.stage.chirp.sample_rate_hz, &mut grid);
                    }
                    visit(rx, chirp, &grid);
                }
            }
        }
    }

    /// Replaces what is on the grids of a block of chirps by static paths between the ends of stretches.
    fn lay_static(&self, block: Range<usize>, halvings: u32, static_grids: &StaticGrids, grids: &mut [Grids]) {
        for (rx, grids) in grids.iter_mut().enumerate() {
            grids.clear();
            let at_ends = static_grids.grids.get(rx).filter(|_| !static_grids.by_chirp);
            let Some(at_ends) = at_ends else { continue };
            for (stretch, places) in self.stretches_of(block.clone(), halvings) {
                if let Some([a, b]) = at_ends.get(stretch..stretch + 2) {
                    grids.blend(a, b, &places);
                }
            }
        }
    }

    /// The stretches of a frame that is halved this often in which chirps of a block lie, each with the places of those chirps.
    fn stretches_of(&self, block: Range<usize>, halvings: u32) -> Vec<(usize, Places)> {
        let (active_s, stretches) = (self.active_s(), 1usize << halvings);
        let at = |chirp: usize| self.middle_s(chirp) / active_s * stretches as f64;
        let stretch_of = |chirp: usize| (at(chirp) as usize).min(stretches - 1);
        let mut of_block = Vec::new();
        let mut begin = block.start;
        while begin < block.end {
            let stretch = stretch_of(begin);
            let end = (begin..block.end).find(|&chirp| stretch_of(chirp) != stretch).unwrap_or(block.end);
            let lanes = begin - block.start..end - block.start;
            of_block.push((stretch, Places::new(lanes, |lane| at(block.start + lane) - stretch as f64)));
            begin = end;
        }
        of_block
    }

    /// What stands still; with every tone times `j` and its delay if so asked.
    fn static_grid(&self, rx: usize, weights: &[Complex64], is_by_delay: bool) -> Grid {
        let mut grid = self.synthesiser.grid();
        // Of a tone of one cycle a sample: what stands still has no Doppler.
        let delay_s = self.stage.chirp.sample_rate_hz / self.stage.chirp.slope_hz_per_s;
        for (path, weight) in self.stage.static_paths.iter().zip(weights) {
            if let Some(&(phase_cycles, cycles_per_sample, amplitude)) = path.tones.get(rx) {
                let mut a = amplitude * weight;
                if is_by_delay {
                    a *= Complex64::new(0.0, cycles_per_sample * delay_s);
                }
                let amplitude = Complex::new(a.re as f32, a.im as f32);
                self.synthesiser.add(&Tone { phase_cycles, cycles_per_sample, amplitude }, &mut grid);
            }
        }
        grid
    }

    /// Offset (LSB) and factor on leakage of a channel in a frame.
    fn offset(&self, rx: usize, index: u64) -> (f32, f32) {
        let receiver = self.scene.receiver();
        let t = self.start_s(index);
        let mut rng = generator(self.options.seed, Purpose::FrameJitter, [index, 1 + rx as u64]);
        let (a, b): (f64, f64) = (StandardNormal.sample(&mut rng), StandardNormal.sample(&mut rng));
        let phases = drift_phases(self.options.seed, [rx as u64, 1]);
        let dc = self.stage.channels.get(rx).map_or(2048.0, |c| c.dc_code);
        // There and back between the limits.
        let limit = receiver.drift.dc_limit_lsb.max(1e-9);
        let walked = (receiver.drift.dc_lsb_per_s * t + limit).rem_euclid(4.0 * limit);
        let wander = if walked < 2.0 * limit { walked - limit } else { 3.0 * limit - walked };
        let offset = dc + wander + receiver.drift.dc_jitter_lsb * a;
        let leakage = 1.0
            + self.leakage_jitter * receiver.clutter.leakage_jitter * b
            + receiver.clutter.leakage_drift_per_10s * drift(t, &phases);
        (offset as f32, leakage as f32)
    }
}

/// People as columns in other paths' way, at each of several times.
fn columns(snapshots: &[Vec<Snapshot>]) -> Vec<Vec<Column>> {
    snapshots.iter().map(|people| people.iter().map(|person| person.column).collect()).collect()
}

/// The same at a place, 0 to 1, between times that are evenly spread.
fn columns_between(at_times: &[Vec<Column>], at: f64) -> Vec<Column> {
    let place = at.clamp(0.0, 1.0) * at_times.len().saturating_sub(1) as f64;
    let whole = place as usize;
    let Some(here) = at_times.get(whole) else { return Vec::new() };
    let next = at_times.get(whole + 1).unwrap_or(here);
    let part = place - whole as f64;
    let between = |a: f64, b: f64| a + (b - a) * part;
    here.iter()
        .zip(next)
        .map(|(a, b)| Column {
            x: between(a.x, b.x),
            y: between(a.y, b.y),
            radius_m: between(a.radius_m, b.radius_m),
            height_m: between(a.height_m, b.height_m),
        })
        .collect()
}
