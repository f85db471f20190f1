//! Pairs of a recording and the scene that mirrors it.
//!
//! People in the recording are followed by range, speed and the angle between receivers ([`follow`], [`smooth`]); their ways
//! become a script ([`script`]) in a scene file ([`mirror`]), which is simulated at the times of the recording's frames; errors of
//! the trajectories, measured by following the people of the mirror, are taken off ([`bias`]).
//! Maps of both are stored as one dataset, under one pair and one sequence, with the recording's labels.

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

use anyhow::{Context, bail};
use radome_driver::LabelSpan;
use radome_driver::recording::Recording;
use radome_driver::recording::span_check::check_spans;
use radome_dsp::{Frame, MapStatus, Occupancy, RdmProcessor, SourceEvent, Truth};
use radome_models::dataset::{DatasetHeader, DatasetWriter, Domain};
use radome_sim::{Scene, SimulateOptions, Simulator};
use rayon::prelude::*;

use self::mirror::Stage;
pub use self::report::Report;
use self::script::{Role, WayPoints};
use self::smooth::Sensor;
use self::store::Store;
use self::watcher::{Taken, Watcher};
use crate::map_preset::MapPreset;
use crate::output::Interrupted;
use crate::source::{self, SourceOptions};
use crate::{files, labels, output};

/// Frames that are rendered before maps are made of them.
const CHUNK: usize = 32;

/// Inputs and options of a pair.
pub struct Settings {
    /// Recording of any kind, or another source if `frames` is given.
    pub recording: String,
    /// Scene file: room, furniture, radar, receiver. Its people and waveform are not used.
    pub scene: PathBuf,
    /// Dataset folder to make.
    pub output: PathBuf,
    /// File with labels instead of the recording's own: .txt is an Audacity label track, .label a DEEPCRAFT file.
    pub labels: Option<PathBuf>,
    /// Number of people where there is no label.
    pub people: Option<u8>,
    /// Positions of people at times when they were not seen: TOML with a list `person` of `point`s.
    pub waypoints: Option<PathBuf>,
    /// Body height of the people, m.
    pub height_m: f64,
    /// Whether people who stay in one place sit.
    pub seated: bool,
    /// Kind of map.
    pub map: MapPreset,
    /// Name of the pair; the recording's name if `None`.
    pub name: Option<String>,
    /// Name of the person in the recording.
    pub subject: Option<String>,
    /// Number of times that the trajectory is corrected by following the mirror.
    pub corrections: u8,
    /// Number of frames to read; all if `None`.
    pub frames: Option<u64>,
    /// Seed of the mirror.
    pub seed: u64,
}

/// Pair that was stored.
pub struct Paired {
    /// Name of the pair.
    pub name: String,
    /// Number of maps of both sides.
    pub maps: usize,
    /// Differences between the sides.
    pub report: Report,
}

/// Mirrors a recording and stores the maps of both sides.
///
/// # Errors
/// The recording, the scene, labels or way-points cannot be read, they contradict each other, the dataset cannot be written, or the
/// user interrupts.
pub fn pair(settings: &Settings) -> anyhow::Result<Paired> {
    files::check_parent(&settings.output)?;
    if !(0.5..=2.5).contains(&settings.height_m) {
        bail!("--height-m is {}, expected 0.5 to 2.5 m", settings.height_m);
    }
    let points = settings.waypoints.as_deref().map_or(Ok(WayPoints::default()), read_waypoints)?;
    let options = SourceOptions { frames: settings.frames, seed: settings.seed, ..SourceOptions::default() };
    let mut source = source::open(&settings.recording, &options)?;
    let is_recording = Recording::open(Path::new(&settings.recording)).is_ok();
    if settings.frames.is_none() && source.frames.frame_count().is_none() && !is_recording {
        bail!("{} has no end\n\nhint: say how much of it with --frames", settings.recording);
    }
    let waveform = source.frames.waveform().clone();
    let stage = Stage::load(&settings.scene, &waveform)?;
    let name = settings.name.clone().unwrap_or_else(|| {
        Path::new(&settings.recording).file_stem().unwrap_or_default().to_string_lossy().into_owned()
    });
    let spans = spans(settings)?;
    let spec = settings.map.spec(&waveform);
    let header = DatasetHeader::new(waveform.clone(), spec)?;
    let writer = DatasetWriter::create(&settings.output, &header)?;
    let scene_name = settings.scene.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let mut store = Store { writer, pair: name.clone(), scene: scene_name, subject: settings.subject.clone() };

    // The recording.
    let mut height_m = settings.height_m;
    if settings.seated {
        // The chest of who sits is as high as that of somebody this tall who stands.
        height_m = (0.54 + 0.19 * settings.height_m) / smooth::CHEST_HEIGHT;
    }
    let (sensor, baselines) = Sensor::new(&stage.scene, &waveform, height_m);
    if !sensor.tells_direction() {
        eprintln!("no two receivers side by side: people are taken to move along the boresight");
    }
    if stage.waveform_replaced {
        eprintln!("{}: the mirror has the recording's waveform, not the scene's", settings.scene.display());
    }
    let mut watcher = Watcher::new(&waveform, &baselines);
    let mut processor = RdmProcessor::new(&spec, &waveform)?;
    let mut map = processor.empty_map();
    let mut frame = Frame::zeroed(waveform.shape());
    let mut taken: Vec<Taken> = Vec::new();
    let mut unlabelled = 0u64;
    let mut after_gap = false;
    let bar = output::progress(source.frames.frame_count().unwrap_or(0), "following");
    while settings.frames.is_none_or(|most| (taken.len() as u64) < most) {
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
                let by_count = settings.people.and_then(|n| Occupancy::from_index(usize::from(n)));
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
    let Some(first) = taken.first().copied() else { bail!("{}: no frame", settings.recording) };
    if taken.iter().all(|of| of.truth.is_none()) {
        bail!(
            "{}: no frame has a label\n\nhint: say how many people there are with --people, or label it: radome recording label {0} \
             --propose detector",
            settings.recording
        );
    }
    if let Some(pair) = taken.windows(2).find(|pair| matches!(pair, [a, b] if b.time_ns <= a.time_ns)) {
        bail!("{}: frame {} is not later than the one before", settings.recording, pair[1].sequence);
    }
    let times_s: Vec<f64> = taken.iter().map(|of| (of.time_ns - first.time_ns) as f64 * 1e-9).collect();
    if !spans.is_empty() {
        let end_s = taken.last().map_or(0, |of| of.time_ns) as f64 * 1e-9 + waveform.frame_interval_s();
        check_spans(&spans, Some((first.time_ns as f64 * 1e-9, end_s)))?;
    }
    if unlabelled > 0 {
        eprintln!("{name}: {unlabelled} maps without a label were left out");
    }
    let detections = watcher.finish(&times_s, &taken, &waveform);

    // Ways of the people.
    let labelled = taken.iter().filter_map(|of| of.truth).map(|truth| truth.occupancy.index()).max().unwrap_or(0);
    let people = labelled.max(points.person.len()).min(2);
    let tracklets = follow::follow(&detections, people, &sensor);
    let mut roles = script::deal(tracklets, people);
    // Way-points have the recording's clock, the mirror begins with its first frame.
    let points = points.shifted(-(first.time_ns as f64) * 1e-9);
    let written = |roles: &mut [Role]| -> anyhow::Result<(String, Simulator)> {
        script::fill(roles, &detections, stage.scene.file(), &points)
            .with_context(|| format!("{} cannot be mirrored as it is", settings.recording))?;
        let text = mirror_text(settings, &stage, stage.table(), &name, roles)?;
        let scene = Scene::parse(&text, &settings.scene)?;
        let options = SimulateOptions { seed: settings.seed, ..SimulateOptions::default() };
        Ok((mirror_text(settings, &stage, &stage.stored, &name, roles)?, Simulator::new(&scene, options)?))
    };

    // The mirror.
    let (mut text, mut simulator) = written(&mut roles)?;
    for _ in 0..if roles.iter().all(|role| role.tracklets.is_empty()) { 0 } else { settings.corrections } {
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
                store.push(Domain::Sim, &map, of, truth, Some(settings.seed))
            }
            Some(_) => Ok(()),
            None => processor.process(frame, &mut map).map(|_| ()).map_err(Into::into),
        }
    })?;
    let mirror_detections = watcher.finish(&times_s, &taken, &waveform);

    let maps = store.writer.maps();
    store.writer.add_file(MIRROR, text.as_bytes())?;
    for (name, bytes) in stage.mesh_files()? {
        store.writer.add_file(name, &bytes)?;
    }
    let report = report::Report::new(&roles, &detections, &mirror_detections, &sensor, agreed);
    store.writer.add_file(TRACK, report::track_lines(&roles, &taken_numbers(&taken))?.as_bytes())?;
    store.writer.finish()?;
    Ok(Paired { name, maps, report })
}

/// Names in the dataset's folder: of the mirror's scene, and of people's positions, a line a frame and person.
const MIRROR: &str = "mirror.toml";
const TRACK: &str = "track.jsonl";

/// The scene file of a mirror.
fn mirror_text(
    settings: &Settings,
    stage: &Stage,
    table: &toml::Table,
    name: &str,
    roles: &[Role],
) -> anyhow::Result<String> {
    let radar = stage.scene.radar_position().truncate();
    let mut scripts = Vec::new();
    for (person, role) in roles.iter().enumerate() {
        scripts.extend(script::steps(person, &role.knots, radar, settings.seated)?);
    }
    Ok(format!(
        "# The scene that mirrors a recording, from its first frame on. Made by:\n#     radome scene pair {} {} -o {}\n# Schema: \
         sim/src/scene_file/mod.rs.\n{}",
        settings.recording,
        settings.scene.display(),
        settings.output.display(),
        Stage::with_scripts(table, &format!("{name}-mirror"), settings.height_m, &scripts)
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
fn spans(settings: &Settings) -> anyhow::Result<Vec<LabelSpan>> {
    let spans = match (&settings.labels, Path::new(&settings.recording)) {
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
