//! `radome dataset pair`: a recording, and the scene that mirrors it.
//!
//! Whoever is in the recording is followed by range, speed and the angle between receivers ([`follow`], [`smooth`]); what they
//! did becomes a script ([`script`]) in a scene file ([`mirror`]), which is simulated at the times of the recording's frames; what
//! following them there misses is taken off ([`bias`]).
//! Maps of both are stored as one dataset, under one pair and one sequence, with the recording's labels.

mod bias;
mod follow;
mod mirror;
mod report;
mod script;
mod smooth;

use std::collections::VecDeque;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use radome_driver::LabelSpan;
use radome_driver::recording::Recording;
use radome_driver::recording::span_check::check_spans;
use radome_dsp::detect::{Baseline, Detection, Detector, RangeProfile};
use radome_dsp::{Frame, MapStatus, RdmProcessor, RdmSpec, SourceEvent, Truth, Waveform};
use radome_models::dataset::{DatasetHeader, DatasetWriter, Domain, ManifestRow};
use radome_sim::{Scene, SimulateOptions, Simulator};
use rayon::prelude::*;

use super::unit::Interrupted;
use crate::source::{self, SourceOptions};
use crate::{files, labels, output};
use follow::Look;
use mirror::Stage;
use script::{Role, WayPoints};
use smooth::Sensor;

/// Half the time over which frames are compared with each other for who is still, s.
const STILL_HALF_S: f64 = 1.0;
/// Moving echoes keep still ones away within this, m.
const KEEPS_AWAY_M: f64 = 1.0;
/// Frames that are rendered before maps are made of them.
const CHUNK: usize = 32;

/// `radome dataset pair`
#[derive(clap::Args)]
pub struct Arguments {
    /// Recording of any kind, or another source with --frames
    recording: String,
    /// Scene file: room, furniture, radar, receiver. Its people and waveform are not used
    scene: PathBuf,
    /// Dataset folder to make
    #[arg(short, long)]
    output: PathBuf,
    /// File with labels instead of the recording's own: .txt is an Audacity label track, .label a DEEPCRAFT file
    #[arg(long)]
    labels: Option<PathBuf>,
    /// So many people are there wherever no label says otherwise
    #[arg(long, value_parser = clap::value_parser!(u8).range(0..=2))]
    people: Option<u8>,
    /// Where people were when they were not seen: TOML, [[person]] with point = [{ time_s = 1.5, position_m = [2.0, 1.0] }, ...]
    #[arg(long)]
    waypoints: Option<PathBuf>,
    /// Body height of the people, m
    #[arg(long, default_value_t = 1.75)]
    height_m: f64,
    /// Those who stay in one place sit
    #[arg(long)]
    seated: bool,
    /// Which kind of map
    #[arg(long, value_enum, default_value_t = Map::House)]
    map: Map,
    /// Name of the pair; the recording's without
    #[arg(long)]
    name: Option<String>,
    /// Who is in it
    #[arg(long)]
    subject: Option<String>,
    /// How often the trajectory is corrected by what following the mirror misses
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u8).range(0..=4))]
    corrections: u8,
    /// End after this many frames
    #[arg(long)]
    frames: Option<u64>,
    /// Seed of what is random in the mirror
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// One object
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, clap::ValueEnum)]
enum Map {
    /// All receivers, Hann x Hann, dBFS, nothing removed
    House,
    /// As the paper's statistics
    Paper,
    /// As the vendor's examples
    Sdk,
}

/// A frame of the recording, without its samples.
#[derive(Debug, Clone, Copy)]
struct Taken {
    sequence: u64,
    time_ns: u64,
    /// Frames were lost before it.
    after_gap: bool,
    truth: Option<Truth>,
}

/// Mirrors a recording.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    output::catch_interrupts()?;
    files::check_parent(&arguments.output)?;
    if !(0.5..=2.5).contains(&arguments.height_m) {
        bail!("--height-m is {}, expected 0.5 to 2.5 m", arguments.height_m);
    }
    let points = arguments.waypoints.as_deref().map_or(Ok(WayPoints::default()), read_waypoints)?;
    let options = SourceOptions { frames: arguments.frames, seed: arguments.seed, ..SourceOptions::default() };
    let mut source = source::open(&arguments.recording, &options)?;
    let is_recording = Recording::open(Path::new(&arguments.recording)).is_ok();
    if arguments.frames.is_none() && source.frames.frame_count().is_none() && !is_recording {
        bail!("{} has no end\n\nhint: say how much of it with --frames", arguments.recording);
    }
    let waveform = source.frames.waveform().clone();
    let stage = Stage::load(&arguments.scene, &waveform)?;
    let name = arguments.name.clone().unwrap_or_else(|| {
        Path::new(&arguments.recording).file_stem().unwrap_or_default().to_string_lossy().into_owned()
    });
    let spans = spans(arguments)?;
    let spec = match arguments.map {
        Map::House => RdmSpec::default(),
        Map::Paper => RdmSpec::paper(),
        Map::Sdk => RdmSpec::sdk(&waveform),
    };
    let header = DatasetHeader::new(waveform.clone(), spec)?;
    let writer = DatasetWriter::create(&arguments.output, &header)?;
    let scene_name = arguments.scene.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let mut store = Store { writer, pair: name.clone(), scene: scene_name, subject: arguments.subject.clone() };

    // The recording.
    let mut height_m = arguments.height_m;
    if arguments.seated {
        // The chest of who sits is as high as that of somebody this tall who stands.
        height_m = (0.54 + 0.19 * arguments.height_m) / smooth::CHEST_HEIGHT;
    }
    let (sensor, baselines) = Sensor::new(&stage.scene, &waveform, height_m);
    if !sensor.tells_direction() {
        eprintln!("no two receivers side by side: people are taken to move along the boresight");
    }
    if stage.waveform_replaced {
        eprintln!("{}: the mirror has the recording's waveform, not the scene's", arguments.scene.display());
    }
    let mut watcher = Watcher::new(&waveform, &baselines);
    let mut processor = RdmProcessor::new(&spec, &waveform)?;
    let mut map = processor.empty_map();
    let mut frame = Frame::zeroed(waveform.shape());
    let mut taken: Vec<Taken> = Vec::new();
    let mut unlabelled = 0u64;
    let mut after_gap = false;
    let bar = output::progress(source.frames.frame_count().unwrap_or(0), "following");
    while arguments.frames.is_none_or(|most| (taken.len() as u64) < most) {
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
                let by_count = arguments.people.and_then(|n| radome_dsp::Occupancy::from_index(usize::from(n)));
                let by_count = by_count.map(|occupancy| Truth { occupancy, transition: false });
                let truth = labels::by_span(&spans, &frame, &waveform).or(frame.truth).or(by_count);
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
    let Some(first) = taken.first().copied() else { bail!("{}: no frame", arguments.recording) };
    if taken.iter().all(|of| of.truth.is_none()) {
        bail!(
            "{}: no frame has a label\n\nhint: say how many people there are with --people, or label it: radome dataset label {0} \
             --propose detector",
            arguments.recording
        );
    }
    if let Some(pair) = taken.windows(2).find(|pair| matches!(pair, [a, b] if b.time_ns <= a.time_ns)) {
        bail!("{}: frame {} is not later than the one before", arguments.recording, pair[1].sequence);
    }
    let times_s: Vec<f64> = taken.iter().map(|of| (of.time_ns - first.time_ns) as f64 * 1e-9).collect();
    if !spans.is_empty() {
        let end_s = taken.last().map_or(0, |of| of.time_ns) as f64 * 1e-9 + waveform.frame_interval_s();
        check_spans(&spans, Some((first.time_ns as f64 * 1e-9, end_s)))?;
    }
    if unlabelled > 0 {
        eprintln!("{name}: {unlabelled} maps without a label were left out");
    }
    let looks = watcher.finish(&times_s, &taken, &waveform);

    // Who did what.
    let labelled = taken.iter().filter_map(|of| of.truth).map(|truth| truth.occupancy.index()).max().unwrap_or(0);
    let people = labelled.max(points.person.len()).min(2);
    let sightings = follow::follow(&looks, people, &sensor);
    let mut roles = script::deal(sightings, people);
    // Way-points have the recording's clock, the mirror begins with its first frame.
    let points = points.shifted(-(first.time_ns as f64) * 1e-9);
    let written = |roles: &mut [Role]| -> anyhow::Result<(String, Simulator)> {
        script::fill(roles, &looks, stage.scene.file(), &points)
            .with_context(|| format!("{} cannot be mirrored as it is", arguments.recording))?;
        let text = mirror_text(arguments, &stage, stage.table(), &name, roles)?;
        let scene = Scene::parse(&text, &arguments.scene)?;
        let options = SimulateOptions { seed: arguments.seed, ..SimulateOptions::default() };
        Ok((mirror_text(arguments, &stage, &stage.stored, &name, roles)?, Simulator::new(&scene, options)?))
    };

    // The mirror.
    let (mut text, mut simulator) = written(&mut roles)?;
    for _ in 0..if roles.iter().all(|role| role.sightings.is_empty()) { 0 } else { arguments.corrections } {
        let mut watcher = Watcher::new(&waveform, &baselines);
        render(&simulator, &taken, &times_s, "checking", |_, frame| watcher.take(frame))?;
        let seen = follow::follow(&watcher.finish(&times_s, &taken, &waveform), people, &sensor);
        bias::correct(&mut roles, &seen);
        (text, simulator) = written(&mut roles)?;
    }
    let mut watcher = Watcher::new(&waveform, &baselines);
    let mut processor = RdmProcessor::new(&spec, &waveform)?;
    let mut agreed = 0usize;
    render(&simulator, &taken, &times_s, "mirroring", |of, frame| {
        if of.after_gap {
            processor.reset();
        }
        watcher.take(frame)?;
        agreed += usize::from(frame.truth.map(|t| t.occupancy) == of.truth.map(|t| t.occupancy));
        match of.truth {
            Some(truth) if processor.process(frame, &mut map)? == MapStatus::Ready => {
                store.push(Domain::Sim, &map, of, truth, Some(arguments.seed))
            }
            Some(_) => Ok(()),
            None => processor.process(frame, &mut map).map(|_| ()).map_err(Into::into),
        }
    })?;
    let mirror_looks = watcher.finish(&times_s, &taken, &waveform);

    let maps = store.writer.maps();
    store.writer.add_file(MIRROR, text.as_bytes())?;
    for (name, bytes) in stage.mesh_files()? {
        store.writer.add_file(name, &bytes)?;
    }
    let report = report::Report::new(&roles, &looks, &mirror_looks, &sensor, agreed);
    store.writer.add_file(TRACK, report::track_lines(&roles, &taken_numbers(&taken))?.as_bytes())?;
    store.writer.finish()?;
    report.tell(&arguments.output, &name, maps, arguments.json)
}

/// The mirrored scene's name in the dataset's folder, and that of where people were: a line a frame and person.
const MIRROR: &str = "mirror.toml";
const TRACK: &str = "track.jsonl";

/// The scene file of a mirror.
fn mirror_text(
    arguments: &Arguments,
    stage: &Stage,
    table: &toml::Table,
    name: &str,
    roles: &[Role],
) -> anyhow::Result<String> {
    let radar = stage.scene.radar_position().truncate();
    let mut scripts = Vec::new();
    for (person, role) in roles.iter().enumerate() {
        scripts.extend(script::steps(person, &role.knots, radar, arguments.seated)?);
    }
    Ok(format!(
        "# The scene that mirrors a recording, from its first frame on. Made by:\n#     radome dataset pair {} {} -o {}\n# Schema: \
         sim/src/scene/file.rs.\n{}",
        arguments.recording,
        arguments.scene.display(),
        arguments.output.display(),
        Stage::with_scripts(table, &format!("{name}-mirror"), arguments.height_m, &scripts)
    ))
}

/// Frames of a simulation at the times of those taken, in order.
fn render(
    simulator: &Simulator,
    taken: &[Taken],
    times_s: &[f64],
    what: &'static str,
    mut each: impl FnMut(&Taken, &Frame) -> anyhow::Result<()>,
) -> anyhow::Result<()> {
    let bar = output::progress(taken.len() as u64, what);
    for (chunk, times_s) in taken.chunks(CHUNK).zip(times_s.chunks(CHUNK)) {
        if output::interrupted() {
            return Err(Interrupted.into());
        }
        let both = chunk.par_iter().zip(times_s.par_iter());
        let frames: Vec<Frame> = both.map(|(of, time_s)| simulator.render_at(of.sequence, *time_s)).collect();
        chunk.iter().zip(&frames).try_for_each(|(of, frame)| each(of, frame))?;
        bar.inc(chunk.len() as u64);
    }
    bar.finish_and_clear();
    Ok(())
}

fn taken_numbers(taken: &[Taken]) -> Vec<(u64, f64)> {
    taken.iter().map(|of| (of.sequence, of.time_ns as f64 * 1e-9)).collect()
}

/// Labels of the recording, or of a file instead.
fn spans(arguments: &Arguments) -> anyhow::Result<Vec<LabelSpan>> {
    let spans = match (&arguments.labels, Path::new(&arguments.recording)) {
        (Some(file), _) => labels::read(file)?,
        (None, path) if path.exists() && Recording::open(path).is_ok() => labels::of(path)?,
        _ => Vec::new(),
    };
    check_spans(&spans, None)?;
    Ok(spans)
}

fn read_waypoints(path: &Path) -> anyhow::Result<WayPoints> {
    let text = radome_sim::bounded_file::read_text(path, radome_sim::bounded_file::TEXT_LIMIT_BYTES)
        .with_context(|| format!("{} cannot be read", path.display()))?;
    let points: WayPoints = toml::from_str(&text).with_context(|| {
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

/// The dataset.
struct Store {
    writer: DatasetWriter,
    pair: String,
    scene: String,
    subject: Option<String>,
}

impl Store {
    fn push(
        &mut self,
        domain: Domain,
        map: &radome_dsp::Rdm,
        of: &Taken,
        truth: Truth,
        seed: Option<u64>,
    ) -> anyhow::Result<()> {
        let recording = match domain {
            Domain::Real => self.pair.clone(),
            Domain::Sim => format!("{}-mirror", self.pair),
        };
        let mut row = ManifestRow::new(domain, &self.scene, &recording, &self.pair, of.sequence, truth.occupancy);
        row.subject.clone_from(&self.subject);
        row.time_ns = Some(of.time_ns);
        row.pair = Some(self.pair.clone());
        row.transition = truth.transition;
        row.seed = seed;
        Ok(self.writer.push(map, row)?)
    }
}

/// Looks at frames as they come.
struct Watcher {
    detector: Detector,
    looks: Vec<Vec<Detection>>,
    profiles: VecDeque<RangeProfile>,
    still: Vec<Vec<Detection>>,
    /// Frames of a window.
    window: usize,
}

impl Watcher {
    fn new(waveform: &Waveform, baselines: &[Baseline]) -> Self {
        let half = (STILL_HALF_S / waveform.frame_interval_s()).round().clamp(2.0, 200.0) as usize;
        Watcher {
            detector: Detector::new(waveform, baselines),
            looks: Vec::new(),
            profiles: VecDeque::new(),
            still: Vec::new(),
            window: 2 * half + 1,
        }
    }

    fn take(&mut self, frame: &Frame) -> anyhow::Result<()> {
        let (echoes, profile) = self.detector.detect_moving(frame)?;
        self.looks.push(echoes);
        self.profiles.push_back(profile);
        if self.profiles.len() > self.window {
            self.profiles.pop_front();
        }
        if self.profiles.len() == self.window {
            self.still.push(self.detector.detect_still(&self.profiles.iter().collect::<Vec<_>>()));
        }
        Ok(())
    }

    /// Looks with what is still in the middle of each window; at either end the first and last whole window answer.
    fn finish(mut self, times_s: &[f64], taken: &[Taken], waveform: &Waveform) -> Vec<Look> {
        if self.still.is_empty() && !self.profiles.is_empty() {
            self.still.push(self.detector.detect_still(&self.profiles.iter().collect::<Vec<_>>()));
        }
        let middle_s = 0.5 * waveform.request.chirps_per_frame as f64 * waveform.chirp_interval_s;
        let half = self.window / 2;
        let looks = std::mem::take(&mut self.looks);
        let of = |(k, mut echoes): (usize, Vec<Detection>)| {
            let still = self.still.get(k.saturating_sub(half).min(self.still.len().saturating_sub(1)));
            let near = |still: &Detection| echoes.iter().any(|e| (e.range_m - still.range_m).abs() < KEEPS_AWAY_M);
            let quiet: Vec<_> = still.into_iter().flatten().filter(|s| !near(s)).cloned().collect();
            echoes.extend(quiet);
            Look {
                time_s: times_s.get(k).copied().unwrap_or(0.0) + middle_s,
                people: taken.get(k).and_then(|of| of.truth).map_or(2, |truth| truth.occupancy.index()),
                echoes,
            }
        };
        looks.into_iter().enumerate().map(of).collect()
    }
}
