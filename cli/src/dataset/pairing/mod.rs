//! Pairs of a recording and a scene that mirrors it.
//!
//! People in the recording are tracked by range, speed and the angle between receivers ([`follow`], [`smooth`]). Their
//! trajectories become scripts ([`script`]) in a scene file ([`mirror`]), which is simulated at the times of the
//! recording's frames. Tracking the people of the mirror gives the errors of the trajectories, which are subtracted
//! ([`bias`]). Maps of both are stored as one dataset, under one pair and one sequence, with the recording's labels.

mod bias;
mod detections;
mod follow;
mod mirror;
mod report;
mod script;
mod smooth;
mod store;
mod watcher;

use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};
use radome_driver::LabelSpan;
use radome_driver::recording::Recording;
use radome_driver::recording::span_check::check_spans;
use radome_dsp::detect::Baseline;
use radome_dsp::{Frame, MapStatus, Occupancy, RdmProcessor, RdmSpec, SourceEvent, Truth, Waveform};
use radome_models::dataset::{DatasetHeader, DatasetWriter, Domain};
use radome_sim::{Scene, SimulateOptions, Simulator};
use rayon::prelude::*;

use self::detections::Detections;
use self::mirror::Stage;
pub use self::report::Report;
use self::script::{Role, WayPoints};
use self::smooth::Sensor;
use self::store::Store;
use self::watcher::{Taken, Watcher};
use crate::exit::wrong_use;
use crate::map_preset::MapPreset;
use crate::output::Interrupted;
use crate::source::{self, DEFAULT_SEED, Source, SourceOptions};
use crate::{files, labels, output, shell};

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
    /// File with labels instead of the recording's own: .txt is an Audacity label track, .label a DEEPCRAFT file
    #[arg(long, value_name = "FILE")]
    labels: Option<PathBuf>,
    /// Number of people in frames without a label
    #[arg(long, value_parser = clap::value_parser!(u8).range(0..=2))]
    people: Option<u8>,
    /// TOML file with positions of people when they were not visible: [[person]] with point = [{ time_s = 1.5, position_m = [2.0, 1.0] },
    /// ...]. Messages number the people from 1, in the order of the file
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
    files::check_parent(&settings.output)?;
    if !(0.5..=2.5).contains(&settings.height_m) {
        wrong_use!("--height-m is {}, expected 0.5 to 2.5 m", settings.height_m);
    }
    let points = settings.waypoints.as_deref().map_or(Ok(WayPoints::default()), read_waypoints)?;
    let source = open(settings)?;
    let pairing = Pairing::new(settings, source.frames.waveform().clone())?;
    let spans = spans(settings)?;
    let header = DatasetHeader::new(pairing.waveform.clone(), pairing.spec)?;
    let mut store = Store {
        writer: DatasetWriter::create(&settings.output, &header)?,
        pair: pairing.name.clone(),
        scene: stem(&settings.scene),
        subject: settings.subject.clone(),
    };
    let recording = pairing.follow_recording(source, &spans, &mut store)?;

    // Trajectories of the people.
    let labelled = recording.taken.iter().filter_map(|of| of.truth).map(|truth| truth.occupancy.index()).max();
    let people = labelled.unwrap_or(0).max(points.person.len()).min(2);
    let tracklets = follow::follow(&recording.detections, people, &pairing.sensor);
    let mut roles = script::deal(tracklets, people);
    // Way-points use the recording's clock; the mirror begins with its first frame.
    let points = points.shifted(-recording.start_s);
    let tracked = roles.clone();
    let (mut text, mut simulator) = pairing.mirror(&mut roles, &recording.detections, &points)?;
    for _ in 0..if roles.iter().all(|role| role.tracklets.is_empty()) { 0 } else { settings.corrections } {
        let mut watcher = pairing.watcher();
        recording.render(&simulator, "checking", |_, frame| watcher.take(frame))?;
        let seen = watcher.finish(&recording.times_s, &recording.taken, &pairing.waveform);
        bias::correct(&mut roles, &tracked, &follow::follow(&seen, people, &pairing.sensor));
        (text, simulator) = pairing.mirror(&mut roles, &recording.detections, &points)?;
    }
    let (mirrored, agreed) = pairing.store_mirror(&simulator, &recording, &mut store)?;

    let maps = store.writer.maps();
    store.writer.add_file(MIRROR, text.as_bytes())?;
    for (name, bytes) in pairing.stage.mesh_files()? {
        store.writer.add_file(name, &bytes)?;
    }
    let report = Report::new(&roles, &recording.detections, &mirrored, &pairing.sensor, agreed);
    let frames: Vec<(u64, f64)> = recording.taken.iter().map(|of| (of.sequence, of.time_ns as f64 * 1e-9)).collect();
    store.writer.add_file(TRACK, report::track_lines(&roles, &frames)?.as_bytes())?;
    store.writer.finish()?;
    Ok(Paired { name: pairing.name, maps, report })
}

/// Names in the dataset's folder: of the mirror's scene, and of people's positions with one line per frame and person.
const MIRROR: &str = "mirror.toml";
const TRACK: &str = "track.jsonl";

fn stem(path: &Path) -> String {
    source::name_of(path).to_string_lossy().into_owned()
}

/// Opens the source to be mirrored, which must be finite.
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
    stage: Stage,
    sensor: Sensor,
    baselines: Vec<Baseline>,
}

/// Frames of the recording, with their echoes.
struct Followed {
    taken: Vec<Taken>,
    /// Time of the first frame, s.
    start_s: f64,
    /// Times of all frames since the first, s.
    times_s: Vec<f64>,
    detections: Vec<Detections>,
}

impl<'a> Pairing<'a> {
    fn new(settings: &'a Settings, waveform: Waveform) -> anyhow::Result<Self> {
        let stage = Stage::load(&settings.scene, &waveform)?;
        let mut height_m = settings.height_m;
        if settings.seated {
            // Height of a standing person whose chest is as high as that of the sitting person.
            height_m = (0.54 + 0.19 * settings.height_m) / smooth::CHEST_HEIGHT;
        }
        let (sensor, baselines) = Sensor::new(&stage.scene, &waveform, height_m);
        let name = settings.name.clone().unwrap_or_else(|| stem(Path::new(&settings.recording)));
        let spec = settings.preset.spec(&waveform);
        Ok(Pairing { settings, name, waveform, spec, stage, sensor, baselines })
    }

    fn watcher(&self) -> Watcher {
        Watcher::new(&self.waveform, &self.baselines)
    }

    /// Returns the class of a frame of the recording: by its labels, by its own truth, or from the settings.
    fn truth(&self, spans: &[LabelSpan], frame: &Frame) -> Option<Truth> {
        let by_count = self.settings.people.and_then(|n| Occupancy::from_index(usize::from(n)));
        let by_count = by_count.map(|occupancy| Truth { occupancy, transition: false });
        labels::truth_of_frame(spans, frame, &self.waveform).or(frame.truth).or(by_count)
    }

    /// Finds the echoes of the recording and stores its maps.
    fn follow_recording(&self, mut source: Source, spans: &[LabelSpan], store: &mut Store) -> anyhow::Result<Followed> {
        if !self.sensor.tells_direction() {
            message!("no two receivers side by side: people are taken to move along the boresight");
        }
        if self.stage.waveform_replaced {
            let scene = self.settings.scene.display();
            message!("{scene}: the mirror has the recording's waveform, not the scene's");
        }
        let mut watcher = self.watcher();
        let mut processor = RdmProcessor::new(&self.spec, &self.waveform)?;
        let mut map = processor.empty_map();
        let mut frame = Frame::zeroed(self.waveform.shape());
        let mut taken: Vec<Taken> = Vec::new();
        let mut unlabelled = 0u64;
        let mut after_gap = false;
        let bar = output::progress(source.frames.frame_count().unwrap_or(0), "following");
        while self.settings.frames.is_none_or(|most| (taken.len() as u64) < most) {
            if output::interrupted() {
                return Err(Interrupted.into());
            }
            match source.frames.next_frame(&mut frame).map_err(anyhow::Error::from_boxed)? {
                SourceEvent::End => break,
                SourceEvent::Gap(_) => {
                    processor.reset();
                    after_gap = true;
                }
                SourceEvent::Frame => {
                    let truth = self.truth(spans, &frame);
                    let of = Taken { sequence: frame.sequence, time_ns: frame.time_ns, after_gap, truth };
                    after_gap = false;
                    watcher.take(&frame)?;
                    if processor.process(&frame, &mut map)? == MapStatus::Ready {
                        match truth {
                            Some(truth) => store.push(Domain::Real, &map, &of, truth, None)?,
                            None => unlabelled += 1,
                        }
                    }
                    taken.push(of);
                    bar.inc(1);
                }
            }
        }
        bar.finish_and_clear();
        let first_ns = self.check(&taken, spans)?;
        if unlabelled > 0 {
            message!("{}: {unlabelled} maps without a label were left out", self.name);
        }
        let times_s: Vec<f64> = taken.iter().map(|of| (of.time_ns - first_ns) as f64 * 1e-9).collect();
        let detections = watcher.finish(&times_s, &taken, &self.waveform);
        Ok(Followed { taken, start_s: first_ns as f64 * 1e-9, times_s, detections })
    }

    /// Refuses a recording without frames or labels, times that do not increase, and labels beyond its end, unless the
    /// settings end it. Returns the time of the first frame, ns.
    fn check(&self, taken: &[Taken], spans: &[LabelSpan]) -> anyhow::Result<u64> {
        let recording = &self.settings.recording;
        let (Some(first), Some(last)) = (taken.first(), taken.last()) else { bail!("{recording}: no frame") };
        ensure!(
            taken.iter().any(|of| of.truth.is_some()),
            "{recording}: no frame has a label\n\nhint: say how many people there are with --people, or label it: radome recording \
             label {recording} --propose detector"
        );
        if let Some(pair) = taken.windows(2).find(|pair| matches!(pair, [a, b] if b.time_ns <= a.time_ns)) {
            bail!("{recording}: frame {} is not later than the one before", pair[1].sequence);
        }
        if !spans.is_empty() {
            let end_s = last.time_ns as f64 * 1e-9 + self.waveform.frame_interval_s();
            // Labels go on where the settings end the recording.
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

    /// Completes the trajectories of the people. Returns the text of the mirror's scene file, and its simulation.
    fn mirror(
        &self,
        roles: &mut [Role],
        detections: &[Detections],
        points: &WayPoints,
    ) -> anyhow::Result<(String, Simulator)> {
        script::fill(roles, detections, self.stage.scene.file(), points)
            .with_context(|| format!("{} cannot be mirrored as it is", self.settings.recording))?;
        let scene = Scene::parse(&self.mirror_text(&self.stage.table, roles)?, &self.settings.scene)?;
        let options = SimulateOptions { seed: self.settings.seed, ..SimulateOptions::default() };
        Ok((self.mirror_text(&self.stage.stored, roles)?, Simulator::new(&scene, options)?))
    }

    fn mirror_text(&self, table: &toml::Table, roles: &[Role]) -> anyhow::Result<String> {
        let radar = self.stage.scene.radar_position().truncate();
        let mut scripts = Vec::new();
        for (person, role) in roles.iter().enumerate() {
            scripts.extend(script::steps(person, &role.knots, radar, self.settings.seated)?);
        }
        let recording = shell::word(&self.settings.recording);
        let scene = shell::word(&self.settings.scene.to_string_lossy());
        let output = shell::word(&self.settings.output.to_string_lossy());
        let command = shell::comment(&format!("radome scene pair {recording} {scene} -o {output}"));
        Ok(format!(
            "# The scene that mirrors a recording, from its first frame on. Made by:\n#     {command}\n# Schema: \
             sim/src/scene_file/mod.rs.\n{}",
            Stage::with_scripts(table, &format!("{}-mirror", self.name), self.settings.height_m, &scripts)?
        ))
    }

    /// Stores the maps of the mirror. Returns its echoes, and the number of its frames in which as many people are
    /// present as in the recording's.
    fn store_mirror(
        &self,
        simulator: &Simulator,
        recording: &Followed,
        store: &mut Store,
    ) -> anyhow::Result<(Vec<Detections>, usize)> {
        let mut watcher = self.watcher();
        let mut processor = RdmProcessor::new(&self.spec, &self.waveform)?;
        let mut map = processor.empty_map();
        let mut agreed = 0usize;
        recording.render(simulator, "mirroring", |of, frame| {
            if of.after_gap {
                processor.reset();
            }
            watcher.take(frame)?;
            agreed += usize::from(frame.truth.map(|t| t.occupancy) == of.truth.map(|t| t.occupancy));
            match (processor.process(frame, &mut map)?, of.truth) {
                (MapStatus::Ready, Some(truth)) => store.push(Domain::Sim, &map, of, truth, Some(self.settings.seed)),
                _ => Ok(()),
            }
        })?;
        Ok((watcher.finish(&recording.times_s, &recording.taken, &self.waveform), agreed))
    }
}

impl Followed {
    /// Simulates a frame at the time of each frame of the recording, in order.
    fn render(
        &self,
        simulator: &Simulator,
        what: &'static str,
        mut each: impl FnMut(&Taken, &Frame) -> anyhow::Result<()>,
    ) -> anyhow::Result<()> {
        let bar = output::progress(self.taken.len() as u64, what);
        for (chunk, times_s) in self.taken.chunks(CHUNK).zip(self.times_s.chunks(CHUNK)) {
            if output::interrupted() {
                return Err(Interrupted.into());
            }
            let both = chunk.par_iter().zip(times_s.par_iter());
            let frames: Vec<Frame> = both.map(|(of, time_s)| simulator.frame_at(of.sequence, *time_s)).collect();
            chunk.iter().zip(&frames).try_for_each(|(of, frame)| each(of, frame))?;
            bar.inc(chunk.len() as u64);
        }
        bar.finish_and_clear();
        Ok(())
    }
}

/// Reads the labels from a file if one is named, else from the recording.
fn spans(settings: &Settings) -> anyhow::Result<Vec<LabelSpan>> {
    let spans = match (&settings.labels, Path::new(&settings.recording)) {
        (Some(file), _) => labels::read_file(file)?,
        (None, path) if path.exists() && Recording::open(path).is_ok() => labels::of_recording(path)?,
        _ => Vec::new(),
    };
    check_spans(&spans, None)?;
    Ok(spans)
}

fn read_waypoints(path: &Path) -> anyhow::Result<WayPoints> {
    let text = radome_files::read_text(path, radome_files::TEXT_LIMIT_BYTES)
        .with_context(|| format!("{} cannot be read", path.display()))?;
    let points: WayPoints = radome_files::parse_toml(&text).with_context(|| {
        format!(
            "{} holds no way-points\n\nhint: for each person [[person]] with point = [{{ time_s = 1.5, position_m = [2.0, 1.0] }}, ...]",
            path.display()
        )
    })?;
    if points.person.len() > 2 {
        bail!("{}: way-points of {} people, expected two at most", path.display(), points.person.len());
    }
    Ok(points)
}
