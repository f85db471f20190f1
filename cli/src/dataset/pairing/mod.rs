//! Pairs of a recording and a scene that mirrors it.
//!
//! People in the recording are tracked by range, speed and the angle between receivers ([`tracking`], [`smooth`]). Their
//! trajectories become scripts ([`script`]) in a scene file ([`mirror`]), which is simulated at the times of the
//! recording's frames. Tracking the people of the mirror gives the errors of the trajectories, which are subtracted
//! ([`bias`]). Maps of both are stored as one dataset, under one pair and one sequence, with the recording's labels. Frames in
//! which the mirror has another number of people than the labels say are left out of both.

mod bias;
mod detections;
mod echo_finder;
mod mirror;
mod report;
mod script;
mod smooth;
mod store;
mod tracking;
mod way_points;

use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};
use radome_driver::LabelSpan;
use radome_driver::recording::Recording;
use radome_driver::recording::span_check::check_spans;
use radome_dsp::detect::Baseline;
use radome_dsp::{Frame, MapStatus, Occupancy, RdmProcessor, RdmSpec, Truth, Waveform};
use radome_models::dataset::{DatasetHeader, DatasetWriter, Domain};
use radome_sim::scene_file::StepFile;
use radome_sim::{Scene, SimulateOptions, Simulator};
use rayon::prelude::*;

use self::detections::Detections;
use self::echo_finder::{EchoFinder, FrameInfo};
use self::mirror::SceneTemplate;
pub use self::report::Report;
use self::script::{PersonTrack, ScriptError};
use self::smooth::Sensor;
use self::store::{Store, WaitingMaps};
use self::way_points::WayPoints;
use crate::exit::wrong_use;
use crate::map_preset::MapPreset;
use crate::output::Interrupted;
use crate::source::{self, DEFAULT_SEED, Source, SourceOptions};
use crate::{labels, output, shell};

/// Number of frames that are simulated before maps are made of them.
const CHUNK: usize = 32;

/// Inputs and options of a pair.
#[derive(clap::Args)]
pub struct Settings {
    /// Recording of any kind, or another source with --frames
    #[arg(value_hint = clap::ValueHint::AnyPath)]
    recording: String,
    /// Scene file with room, furniture, radar and receiver; its people and waveform are not used
    scene: PathBuf,
    /// Dataset folder to make
    #[arg(short, long, value_name = "DIR")]
    pub output: PathBuf,
    /// File with labels instead of the recording's own: .txt is an Audacity label track, .label a DEEPCRAFT file, .json a JSON array
    #[arg(long, value_name = "FILE")]
    labels: Option<PathBuf>,
    /// Number of people in frames without a label
    #[arg(long, value_parser = clap::value_parser!(u8).range(0..=2))]
    people: Option<u8>,
    /// TOML file with positions of people when they were not visible: [[person]] with point = [{ time_s = 1.5, position_m = [2.0, 1.0] },
    /// ...]. They take the place of tracked positions from which nobody could walk there. Messages number the people from 1, in the order
    /// of the file
    #[arg(long, value_name = "FILE.toml")]
    waypoints: Option<PathBuf>,
    /// Body height of the people, m
    #[arg(long, value_name = "METRES", default_value_t = 1.75)]
    height_m: f64,
    /// Simulate people who stay in one place as sitting
    #[arg(long)]
    seated: bool,
    /// Kind of map
    #[arg(long, alias = "map", value_enum, default_value_t)]
    preset: MapPreset,
    /// Name of the pair; the name of the recording if absent
    #[arg(long)]
    name: Option<String>,
    /// Name of the person in the recording
    #[arg(long)]
    subject: Option<String>,
    /// Number of corrections of the trajectory, each from tracking people in the mirrored scene
    #[arg(long, default_value_t = 2, value_parser = clap::value_parser!(u8).range(0..=4))]
    corrections: u8,
    /// Stop after this number of frames
    #[arg(long)]
    frames: Option<u64>,
    /// Seed of the mirrored scene
    #[arg(long, default_value_t = DEFAULT_SEED)]
    seed: u64,
}

pub struct Paired {
    pub name: String,
    /// Number of maps of both sides.
    pub maps: usize,
    pub report: Report,
}

/// Mirrors a recording and stores the maps of both sides.
///
/// # Errors
/// The recording, the scene, labels or way-points cannot be read, they contradict each other, the dataset cannot be
/// written, or the user interrupts.
pub fn pair(settings: &Settings) -> anyhow::Result<Paired> {
    if !(0.5..=2.5).contains(&settings.height_m) {
        wrong_use!("--height-m is {}, expected 0.5 to 2.5 m", settings.height_m);
    }
    let points = settings.waypoints.as_deref().map_or(Ok(WayPoints::default()), WayPoints::read)?;
    let of_points = || settings.waypoints.as_deref().unwrap_or(Path::new("")).display().to_string();
    let source = open(settings)?;
    let pairing = Pairing::new(settings, source.frames.waveform().clone())?;
    points.check_positions(&pairing.template.scene.file().room).with_context(of_points)?;
    let spans = spans(settings)?;
    let header = DatasetHeader::new(pairing.waveform.clone(), pairing.spec)?;
    let mut store = Store {
        writer: DatasetWriter::create(&settings.output, &header)?,
        pair: pairing.name.clone(),
        scene: source_name(&settings.scene),
        subject: settings.subject.clone(),
    };
    let (recording, maps) = pairing.read_recording(source, &spans)?;
    // As labels may, way-points may go on where the settings cut the recording.
    let end_s = if settings.frames.is_some() { f64::INFINITY } else { recording.end_s(&pairing.waveform) };
    points.check_times(recording.start_s, end_s).with_context(of_points)?;

    // Trajectories of the people.
    let labelled = recording.frames.iter().filter_map(|info| info.truth).map(|truth| truth.occupancy.index()).max();
    let people = labelled.unwrap_or(0).max(points.person.len()).min(2);
    let tracklets = tracking::track_people(&recording.detections, people, &pairing.sensor);
    let mut tracks = script::assign(tracklets, people);
    // Way-points use the recording's clock; the mirror begins with its first frame.
    let points = points.shifted(-recording.start_s);
    let tracked = tracks.clone();
    let (mut text, mut simulator) = pairing.mirror(&mut tracks, &recording, &points)?;
    for _ in 0..if tracks.iter().all(|track| track.tracklets.is_empty()) { 0 } else { settings.corrections } {
        let mut echo_finder = pairing.echo_finder();
        recording.simulate(&simulator, "checking", |_, frame| echo_finder.add_frame(frame))?;
        let mirror_detections = echo_finder.finish(&recording.times_s, &recording.frames, &pairing.waveform);
        bias::correct(&mut tracks, &tracked, &tracking::track_people(&mirror_detections, people, &pairing.sensor));
        (text, simulator) = pairing.mirror(&mut tracks, &recording, &points)?;
    }
    let truths = recording.common_truths(&simulator);
    let agreeing_frames = truths.iter().flatten().count();
    ensure!(
        agreeing_frames > 0,
        "{}: in no frame does the mirror have as many people as the labels say\n\nhint: correct the labels, or say where people are \
         with --waypoints",
        settings.recording
    );
    let mirrored = pairing.store_maps(&simulator, &recording, maps, &truths, &mut store)?;

    let maps = store.writer.maps();
    store.writer.add_file(MIRROR, text.as_bytes())?;
    for (name, bytes) in pairing.template.mesh_files()? {
        store.writer.add_file(name, &bytes)?;
    }
    let report = Report::new(&tracks, &recording.detections, &mirrored, &pairing.sensor, agreeing_frames);
    let frames: Vec<(u64, f64)> =
        recording.frames.iter().map(|info| (info.sequence, info.time_ns as f64 * 1e-9)).collect();
    store.writer.add_file(TRACK, report::track_lines(&tracks, &frames)?.as_bytes())?;
    store.writer.finish()?;
    Ok(Paired { name: pairing.name, maps, report })
}

/// File of the mirror's scene in the dataset's folder.
const MIRROR: &str = "mirror.toml";
/// File of the people's positions there, with a line for each frame and person.
const TRACK: &str = "track.jsonl";

fn source_name(path: &Path) -> String {
    source::name_of(path).to_string_lossy().into_owned()
}

/// Opens the source to mirror, which must be finite.
fn open(settings: &Settings) -> anyhow::Result<Source> {
    let options = SourceOptions { frames: settings.frames, seed: settings.seed, ..SourceOptions::default() };
    let source = source::open(&settings.recording, &options)?;
    let is_recording = Recording::open(Path::new(&settings.recording)).is_ok();
    if settings.frames.is_none() && source.frames.frame_count().is_none() && !is_recording {
        bail!("{} has no end\n\nhint: say how much of it with --frames", settings.recording);
    }
    Ok(source)
}

/// Inputs of both sides of a pair.
struct Pairing<'a> {
    settings: &'a Settings,
    name: String,
    waveform: Waveform,
    spec: RdmSpec,
    template: SceneTemplate,
    sensor: Sensor,
    baselines: Vec<Baseline>,
}

/// Frames of the recording, with their echoes.
struct RecordingEchoes {
    frames: Vec<FrameInfo>,
    /// Time of the first frame, s.
    start_s: f64,
    /// Times of all frames since the first, s.
    times_s: Vec<f64>,
    detections: Vec<Detections>,
}

impl<'a> Pairing<'a> {
    fn new(settings: &'a Settings, waveform: Waveform) -> anyhow::Result<Self> {
        let template = SceneTemplate::load(&settings.scene, &waveform)?;
        let mut height_m = settings.height_m;
        if settings.seated {
            // Height of a standing person whose chest is as high as that of the sitting person.
            height_m = (0.54 + 0.19 * settings.height_m) / smooth::CHEST_HEIGHT;
        }
        let (sensor, baselines) = Sensor::new(&template.scene, &waveform, height_m);
        let name = settings.name.clone().unwrap_or_else(|| source_name(Path::new(&settings.recording)));
        let spec = settings.preset.spec(&waveform);
        Ok(Pairing { settings, name, waveform, spec, template, sensor, baselines })
    }

    fn echo_finder(&self) -> EchoFinder {
        EchoFinder::new(&self.waveform, &self.baselines)
    }

    /// Returns the class of a frame of the recording: by its labels, or by the simulator's truth if it has no labels; for other
    /// frames from the settings.
    fn truth(&self, spans: &[LabelSpan], frame: &Frame) -> Option<Truth> {
        let given_class = self.settings.people.and_then(|n| Occupancy::from_index(usize::from(n)));
        let given_truth = given_class.map(|occupancy| Truth { occupancy, transition: false });
        let own_truth =
            if spans.is_empty() { frame.truth } else { labels::truth_of_frame(spans, frame, &self.waveform) };
        own_truth.or(given_truth)
    }

    /// Reads the recording: finds its echoes and makes the maps of its labelled frames.
    fn read_recording(
        &self,
        mut source: Source,
        spans: &[LabelSpan],
    ) -> anyhow::Result<(RecordingEchoes, WaitingMaps)> {
        if !self.sensor.measures_direction() {
            message!("no two receivers side by side: people are taken to move along the boresight");
        }
        if self.template.waveform_replaced {
            let scene = self.settings.scene.display();
            message!("{scene}: the mirror has the recording's waveform, not the scene's");
        }
        let mut echo_finder = self.echo_finder();
        let mut processor = RdmProcessor::new(&self.spec, &self.waveform)?;
        let mut map = processor.empty_map();
        let mut frame = Frame::zeroed(self.waveform.shape());
        let mut frames: Vec<FrameInfo> = Vec::new();
        let mut maps = WaitingMaps::new(radome_files::parent_folder(&self.settings.output))?;
        let mut unlabelled = 0u64;
        let bar = output::progress(source.frames.frame_count().unwrap_or(0), "following");
        while self.settings.frames.is_none_or(|most| (frames.len() as u64) < most) {
            if output::interrupted() {
                return Err(Interrupted.into());
            }
            let mut after_gap = false;
            if !source::next_frame_noting_gaps(source.frames.as_mut(), &mut frame, || after_gap = true)? {
                break;
            }
            if after_gap {
                processor.reset_at_gap();
            }
            let truth = self.truth(spans, &frame);
            let info = FrameInfo { sequence: frame.sequence, time_ns: frame.time_ns, after_gap, truth };
            echo_finder.add_frame(&frame)?;
            if processor.process(&frame, &mut map)? == MapStatus::Ready {
                match truth {
                    Some(_) => maps.push(frames.len(), &map)?,
                    None => unlabelled += 1,
                }
            }
            frames.push(info);
            bar.inc(1);
        }
        bar.finish_and_clear();
        let first_ns = self.check(&frames, spans)?;
        if unlabelled > 0 {
            message!("{}: {unlabelled} maps without a label were left out", self.name);
        }
        let times_s: Vec<f64> = frames.iter().map(|info| (info.time_ns - first_ns) as f64 * 1e-9).collect();
        let detections = echo_finder.finish(&times_s, &frames, &self.waveform);
        Ok((RecordingEchoes { frames, start_s: first_ns as f64 * 1e-9, times_s, detections }, maps))
    }

    /// Refuses a recording without frames or labels, times that do not increase, and labels beyond its end. If the settings cut the
    /// recording, labels may go on. Returns the time of the first frame, ns.
    fn check(&self, frames: &[FrameInfo], spans: &[LabelSpan]) -> anyhow::Result<u64> {
        let recording = &self.settings.recording;
        let (Some(first), Some(last)) = (frames.first(), frames.last()) else { bail!("{recording}: no frame") };
        ensure!(
            frames.iter().any(|info| info.truth.is_some()),
            "{recording}: no frame has a label\n\nhint: say how many people there are with --people, or label it: radome recording \
             label {recording} --propose detector"
        );
        if let Some(pair) = frames.windows(2).find(|pair| matches!(pair, [a, b] if b.time_ns <= a.time_ns)) {
            bail!("{recording}: frame {} is not later than the one before", pair[1].sequence);
        }
        if !spans.is_empty() {
            let end_s = last.time_ns as f64 * 1e-9 + self.waveform.frame_interval_s();
            let is_cut = self.settings.frames.is_some();
            let before_end = spans.iter().filter(|span| !is_cut || span.start_s < end_s);
            let cut = |span: &LabelSpan| match is_cut {
                true => LabelSpan { end_s: span.end_s.min(end_s), ..span.clone() },
                false => span.clone(),
            };
            check_spans(&before_end.map(cut).collect::<Vec<_>>(), Some((first.time_ns as f64 * 1e-9, end_s)))?;
        }
        Ok(first.time_ns)
    }

    /// Completes the people's paths. Returns the text of the mirror's scene file, and its simulation.
    fn mirror(
        &self,
        tracks: &mut [PersonTrack],
        recording: &RecordingEchoes,
        points: &WayPoints,
    ) -> anyhow::Result<(String, Simulator)> {
        let scripts = script::complete(tracks, &recording.detections, self.template.scene.file(), points)
            .and_then(|()| self.scripts(tracks))
            // Scripts begin with the first frame, and way-points use the recording's clock.
            .map_err(|error| error.shifted(recording.start_s))
            .with_context(|| format!("{} cannot be mirrored as it is", self.settings.recording))?;
        let scene = Scene::parse(&self.mirror_text(&self.template.table, &scripts)?, &self.settings.scene)?;
        let options = SimulateOptions { seed: self.settings.seed, ..SimulateOptions::default() };
        Ok((self.mirror_text(&self.template.stored, &scripts)?, Simulator::new(&scene, options)?))
    }

    /// Returns start time and steps of each person who is there at all.
    fn scripts(&self, tracks: &[PersonTrack]) -> Result<Vec<(f64, Vec<StepFile>)>, ScriptError> {
        let radar = self.template.scene.radar_position().truncate();
        let steps = |(person, track): (usize, &PersonTrack)| {
            script::steps(person, &track.path, radar, self.settings.seated).transpose()
        };
        tracks.iter().enumerate().filter_map(steps).collect()
    }

    fn mirror_text(&self, table: &toml::Table, scripts: &[(f64, Vec<StepFile>)]) -> anyhow::Result<String> {
        let recording = shell::word(&self.settings.recording);
        let scene = shell::word(&self.settings.scene.to_string_lossy());
        let output = shell::word(&self.settings.output.to_string_lossy());
        let command = shell::comment(&format!("radome scene pair {recording} {scene} -o {output}"));
        Ok(format!(
            "# The scene that mirrors a recording, from its first frame on. Made by:\n#     {command}\n# Schema: \
             sim/src/scene_file/mod.rs.\n{}",
            SceneTemplate::with_scripts(table, &format!("{}-mirror", self.name), self.settings.height_m, scripts)?
        ))
    }

    /// Stores the maps of both sides, of the frames that have a common truth. Returns the echoes of the mirror.
    fn store_maps(
        &self,
        simulator: &Simulator,
        recording: &RecordingEchoes,
        maps: WaitingMaps,
        truths: &[Option<Truth>],
        store: &mut Store,
    ) -> anyhow::Result<Vec<Detections>> {
        let mut echo_finder = self.echo_finder();
        let mut processor = RdmProcessor::new(&self.spec, &self.waveform)?;
        let mut map = processor.empty_map();
        maps.for_each(&mut map, |frame, map| match (recording.frames.get(frame), truths.get(frame)) {
            (Some(info), Some(Some(truth))) => store.push(Domain::Real, map, info, *truth, None),
            _ => Ok(()),
        })?;
        let mut truths = truths.iter();
        recording.simulate(simulator, "mirroring", |info, frame| {
            if info.after_gap {
                processor.reset_at_gap();
            }
            echo_finder.add_frame(frame)?;
            match (processor.process(frame, &mut map)?, truths.next()) {
                (MapStatus::Ready, Some(Some(truth))) => {
                    store.push(Domain::Sim, &map, info, *truth, Some(self.settings.seed))
                }
                _ => Ok(()),
            }
        })?;
        Ok(echo_finder.finish(&recording.times_s, &recording.frames, &self.waveform))
    }
}

impl RecordingEchoes {
    /// Returns the end of the last frame by the recording's clock, s.
    fn end_s(&self, waveform: &Waveform) -> f64 {
        self.start_s + self.times_s.last().copied().unwrap_or(0.0) + waveform.frame_interval_s()
    }

    /// Returns the truth that each frame shares with its mirror: the class by the labels if the mirror has it too, and a transition if
    /// either side is one. `None` for frames without a label, and for those whose mirror is of another class.
    fn common_truths(&self, simulator: &Simulator) -> Vec<Option<Truth>> {
        let common = |(info, time_s): (&FrameInfo, &f64)| {
            let (own, mirror) = (info.truth?, simulator.truth_at(*time_s));
            let transition = own.transition || mirror.transition;
            (own.occupancy == mirror.occupancy).then_some(Truth { transition, ..own })
        };
        self.frames.iter().zip(&self.times_s).map(common).collect()
    }

    /// Simulates a frame at the time of each frame of the recording, in order.
    fn simulate(
        &self,
        simulator: &Simulator,
        what: &'static str,
        mut handle: impl FnMut(&FrameInfo, &Frame) -> anyhow::Result<()>,
    ) -> anyhow::Result<()> {
        let bar = output::progress(self.frames.len() as u64, what);
        for (chunk, times_s) in self.frames.chunks(CHUNK).zip(self.times_s.chunks(CHUNK)) {
            if output::interrupted() {
                return Err(Interrupted.into());
            }
            let pairs = chunk.par_iter().zip(times_s.par_iter());
            let frames: Vec<Frame> = pairs.map(|(info, time_s)| simulator.frame_at(info.sequence, *time_s)).collect();
            chunk.iter().zip(&frames).try_for_each(|(info, frame)| handle(info, frame))?;
            bar.inc(chunk.len() as u64);
        }
        bar.finish_and_clear();
        Ok(())
    }
}

/// Reads the labels from the file that the settings name, or else from the recording.
fn spans(settings: &Settings) -> anyhow::Result<Vec<LabelSpan>> {
    let spans = match (&settings.labels, Path::new(&settings.recording)) {
        (Some(file), _) => labels::read_replacing(file)?,
        (None, path) if path.exists() && Recording::open(path).is_ok() => labels::of_recording(path)?,
        _ => Vec::new(),
    };
    check_spans(&spans, None)?;
    Ok(spans)
}
