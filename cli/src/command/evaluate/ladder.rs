//! `radome evaluate --ladder`: models compared on simulated recordings that differ from training, one way a rung.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use indicatif::ProgressBar;
use radome_driver::recording::mcap::{Recorder, RecorderOptions, RecordingHeader};
use radome_driver::recording::{Existing, Recording};
use radome_dsp::{Frame, FrameSource, Occupancy, SourceEvent};
use radome_models::calibration::{Reliability, ReliabilitySums};
use radome_models::evaluate::{FalseAlarms, FoundTimes, Metrics, RecordingScores};
use radome_models::train::{FilterSequence, SmoothingFit, fit_smoothing};
use radome_sim::bounded_file::{TEXT_LIMIT_BYTES, named_by_spec, read_text};
use radome_sim::scene::file::BodyFile;
use radome_sim::{Scene, SimulateOptions, Simulator};
use serde::{Deserialize, Serialize};
use serde_json::json;

use super::Confusion;
use super::candidate::{Candidate, Predictions, Refused, Run, add_confusion};
use crate::judge::Model;
use crate::output;
use crate::panics::Guarded;

/// Format of a rung's file.
const FORMAT: u32 = 1;
/// Most frames of a rung: a day at ten a second.
const MOST_FRAMES: u64 = 864_000;
/// Length of the recordings of empty rooms at most, s: hours are watched in several rooms.
const EMPTY_RECORDING_S: f64 = 360.0;

/// A rung's file.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RungFile {
    format: u32,
    /// Short name: letters, digits, `-` and `_`.
    name: String,
    /// One sentence that says how it differs from training.
    about: String,
    /// Scenes that are simulated.
    scene: Vec<RungScene>,
}

/// Recordings of one scene.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RungScene {
    /// Scene file, relative to the rung's file.
    path: PathBuf,
    /// First and last seed: a recording each.
    seeds: (u64, u64),
    /// People that the scene is forced to have at most; its own number if absent.
    #[serde(default)]
    people: Option<usize>,
    /// Frames of a recording.
    frames: u64,
    /// Bodies of people, "ellipsoids" or "mesh"; those of the scene if absent.
    #[serde(default)]
    body: Option<BodyFile>,
}

/// A rung, ready to be simulated.
struct Rung {
    name: String,
    about: String,
    simulations: Vec<Simulation>,
}

/// A recording to be simulated.
struct Simulation {
    name: String,
    /// Name of its scene's file.
    stem: String,
    scene: Scene,
    seed: u64,
    people: Option<usize>,
    frames: u64,
}

/// Puts models on a ladder and says how they did; with `fit`, also which settings of the filter would suit all of them best.
///
/// With `empty_hours` the rungs' recordings are replaced by so many hours of each rung's rooms without people.
pub fn run(
    models: &[PathBuf],
    ladder: &Path,
    empty_hours: Option<f64>,
    keep: Option<&Path>,
    fit: bool,
    json: bool,
) -> anyhow::Result<()> {
    output::catch_interrupts()?;
    if models.is_empty() {
        bail!("no model to evaluate on {}\n\nhint: name one or more with --model", ladder.display());
    }
    let mut rungs = load(ladder)?;
    if let Some(hours) = empty_hours {
        rungs = rungs.into_iter().map(|rung| rung.without_people(hours)).collect::<anyhow::Result<_>>()?;
    }
    let open = |path: &PathBuf| anyhow::Ok(Candidate::new(path.clone(), Model::open(path)?));
    let mut candidates = models.iter().map(open).collect::<anyhow::Result<Vec<_>>>()?;
    if let Some(folder) = keep {
        std::fs::create_dir_all(folder).with_context(|| format!("cannot make the folder {}", folder.display()))?;
    }
    let frames: u64 = rungs.iter().flat_map(|rung| &rung.simulations).map(|simulation| simulation.frames).sum();
    let bar = output::progress(frames, "ladder");
    // [model][rung]
    let mut all: Vec<Vec<RungScores>> = candidates.iter().map(|_| Vec::new()).collect();
    for rung in &rungs {
        bar.set_message(rung.name.clone());
        let mut scores: Vec<RungScores> = candidates.iter().map(|_| RungScores::default()).collect();
        for simulation in &rung.simulations {
            simulation
                .judge(&mut candidates, &mut scores, keep, &bar)
                .with_context(|| format!("rung {}, recording {}", rung.name, simulation.name))?;
        }
        for (all, scores) in all.iter_mut().zip(scores) {
            all.push(scores);
        }
    }
    bar.finish_and_clear();
    let answers: Vec<OfModel> =
        candidates.iter().zip(&all).map(|(candidate, scores)| OfModel::new(candidate.path(), &rungs, scores)).collect();
    let fitted = if fit {
        let groups: Vec<Vec<FilterSequence>> =
            all.iter_mut().flatten().map(|scores| std::mem::take(&mut scores.sequences)).collect();
        fit_smoothing(&groups)
    } else {
        None
    };
    if json {
        let of_rung = |rung: &Rung| {
            let frames: u64 = rung.simulations.iter().map(|simulation| simulation.frames).sum();
            json!({ "rung": rung.name, "about": rung.about, "recordings": rung.simulations.len(), "frames": frames })
        };
        let ladder: Vec<_> = rungs.iter().map(of_rung).collect();
        let mut answer = json!({ "ladder": ladder, "models": answers });
        if let Some(fitted) = &fitted {
            answer["fitted_smoothing"] = serde_json::to_value(fitted)?;
        }
        return output::json_line(&answer);
    }
    print(&answers)?;
    fitted.map_or(Ok(()), |fitted| print_fit(&fitted))
}

/// The rungs of a folder by their files' names, or the one rung of a file.
fn load(path: &Path) -> anyhow::Result<Vec<Rung>> {
    let mut files = Vec::new();
    if path.is_dir() {
        let cannot = || format!("cannot list {}", path.display());
        for entry in std::fs::read_dir(path).with_context(cannot)? {
            let file = entry.with_context(cannot)?.path();
            if file.is_file() && file.extension().is_some_and(|extension| extension == "toml") {
                files.push(file);
            }
        }
        files.sort();
        if files.is_empty() {
            bail!("{}: no rung in it\n\nhint: a rung is a .toml file; fixtures/ladder has some", path.display());
        }
    } else {
        files.push(path.to_owned());
    }
    // Each scene is read once: reading says what is to be warned of.
    let mut scenes = BTreeMap::new();
    let rungs = files.iter().map(|file| Rung::load(file, &mut scenes)).collect::<anyhow::Result<Vec<_>>>()?;
    let mut names = BTreeSet::new();
    if let Some(twice) = rungs.iter().find(|rung| !names.insert(rung.name.as_str())) {
        bail!("{}: two rungs are called {}", path.display(), twice.name);
    }
    Ok(rungs)
}

impl RungFile {
    fn check(&self) -> anyhow::Result<()> {
        if self.format != FORMAT {
            bail!("format is {}, this program knows {FORMAT}", self.format);
        }
        let is_plain = |letter: char| letter.is_ascii_alphanumeric() || letter == '-' || letter == '_';
        if self.name.is_empty() || !self.name.chars().all(is_plain) {
            bail!("name is {:?}, expected letters, digits, - and _", self.name);
        }
        if self.scene.is_empty() {
            bail!("no [[scene]]");
        }
        let mut frames = 0u64;
        for scene in &self.scene {
            let (first, last) = scene.seeds;
            if first > last {
                bail!("seeds are [{first}, {last}], expected the first one first");
            }
            if scene.frames == 0 {
                bail!("frames is 0, expected 1 or more");
            }
            frames = frames.saturating_add((last - first).saturating_add(1).saturating_mul(scene.frames));
        }
        if frames > MOST_FRAMES {
            bail!("{frames} frames, expected {MOST_FRAMES} at most");
        }
        Ok(())
    }
}

impl Rung {
    fn load(path: &Path, scenes: &mut BTreeMap<PathBuf, Scene>) -> anyhow::Result<Self> {
        let text = read_text(path, TEXT_LIMIT_BYTES).with_context(|| format!("cannot read {}", path.display()))?;
        let file: RungFile =
            toml::from_str(&text).with_context(|| format!("{} is no rung of a ladder", path.display()))?;
        file.check().with_context(|| path.display().to_string())?;
        let folder = path.parent().unwrap_or(Path::new(""));
        let mut simulations = Vec::new();
        for of in &file.scene {
            let named = named_by_spec(folder, &of.path)
                .with_context(|| format!("{}: cannot read {}", path.display(), of.path.display()))?;
            let mut scene = match scenes.get(&named) {
                Some(scene) => scene.clone(),
                None => {
                    let scene = Scene::load(&named).with_context(|| path.display().to_string())?;
                    scenes.insert(named.clone(), scene.clone());
                    scene
                }
            };
            if let Some(body) = of.body {
                scene = scene.with_body(body);
            }
            let stem = named.file_stem().unwrap_or_default().to_string_lossy().into_owned();
            let people = of.people.map_or(String::new(), |people| format!("-people{people}"));
            for seed in of.seeds.0..=of.seeds.1 {
                simulations.push(Simulation {
                    name: format!("{}-{stem}-seed{seed}{people}", file.name),
                    stem: stem.clone(),
                    scene: scene.clone(),
                    seed,
                    people: of.people,
                    frames: of.frames,
                });
            }
        }
        Ok(Rung { name: file.name, about: file.about, simulations })
    }

    /// The same scenes without people, for so many hours together: each in recordings of six minutes at most, whose seeds follow
    /// those that the rung has of it.
    fn without_people(self, hours: f64) -> anyhow::Result<Self> {
        // By name of the scene: skins and ellipsoids of one scene are in different rungs.
        let mut last_of_scene: BTreeMap<&str, &Simulation> = BTreeMap::new();
        for simulation in &self.simulations {
            let last = last_of_scene.entry(simulation.stem.as_str()).or_insert(simulation);
            if simulation.seed > last.seed {
                *last = simulation;
            }
        }
        let time_s = hours * 3600.0 / last_of_scene.len().max(1) as f64;
        let mut simulations = Vec::new();
        for (stem, last) in &last_of_scene {
            let recordings = (time_s / EMPTY_RECORDING_S).ceil();
            let frames = (time_s / recordings / last.scene.waveform().frame_interval_s()).ceil();
            if !(1.0..=MOST_FRAMES as f64).contains(&(recordings * frames)) {
                bail!(
                    "--empty-hours {hours}: {} frames of {stem}, expected 1 to {MOST_FRAMES}\n\nhint: a day is enough for any rate \
                     that can be told",
                    recordings * frames
                );
            }
            simulations.extend((1..=recordings as u64).map(|after| {
                let seed = last.seed.saturating_add(after);
                Simulation {
                    name: format!("{}-{stem}-seed{seed}-empty", self.name),
                    stem: (*stem).to_owned(),
                    scene: last.scene.clone(),
                    seed,
                    people: Some(0),
                    frames: frames as u64,
                }
            }));
        }
        Ok(Rung { name: self.name.clone(), about: self.about.clone(), simulations })
    }
}

impl Simulation {
    /// Has all models judge the frames, each of which is simulated once.
    fn judge(
        &self,
        candidates: &mut [Candidate],
        scores: &mut [RungScores],
        keep: Option<&Path>,
        bar: &ProgressBar,
    ) -> anyhow::Result<()> {
        let (mut source, mut recorder) = self.open(keep)?;
        let waveform = source.waveform().clone();
        let mut runs: Vec<Option<Run>> = Vec::new();
        for (candidate, scores) in candidates.iter_mut().zip(scores.iter_mut()) {
            let started = candidate.start(&waveform);
            if let Err(refusal) = &started {
                scores.refused.push(Refused::new(self.name.clone(), refusal));
            }
            runs.push(started.ok());
        }
        if runs.iter().all(Option::is_none) && recorder.is_none() {
            bar.inc(self.frames);
            return Ok(());
        }
        let mut frame = Frame::zeroed(waveform.shape());
        loop {
            if output::interrupted() {
                bail!("interrupted");
            }
            match source.next_frame(&mut frame).map_err(anyhow::Error::from_boxed)? {
                SourceEvent::End => break,
                SourceEvent::Gap(_) => runs.iter_mut().flatten().for_each(Run::gap),
                SourceEvent::Frame => {
                    if let Some(recorder) = &mut recorder {
                        recorder.frame(&frame)?;
                    }
                    let truth = frame.truth.filter(|truth| !truth.transition).map(|truth| truth.occupancy);
                    for run in runs.iter_mut().flatten() {
                        run.frame(&frame, truth)?;
                    }
                    bar.inc(1);
                }
            }
        }
        if let Some(recorder) = recorder {
            recorder.finish()?;
        }
        for ((candidate, run), scores) in candidates.iter_mut().zip(runs).zip(scores.iter_mut()) {
            if let Some(run) = run {
                scores.add(&self.name, &candidate.end(run));
            }
        }
        Ok(())
    }

    /// The frames: simulated, or kept from an earlier time. With a recorder if they are to be kept.
    fn open(&self, keep: Option<&Path>) -> anyhow::Result<(Box<dyn FrameSource>, Option<Recorder>)> {
        let options = SimulateOptions {
            seed: self.seed,
            people: self.people,
            frames: Some(self.frames),
            ..SimulateOptions::default()
        };
        let simulator = Simulator::new(&self.scene, options)?;
        let mut recorder = None;
        if let Some(folder) = keep {
            let path = folder.join(format!("{}.mcap", self.name));
            if self.is_kept(&path, &simulator) {
                return Ok((radome_driver::recording::open(&path)?, None));
            }
            let header = RecordingHeader::new(simulator.waveform().clone());
            let options = RecorderOptions { existing: Existing::Replace, sync: None };
            recorder = Some(Recorder::with_options(&path, &header, &options)?);
        }
        // Models judge on this thread: they must not queue behind the next frames.
        let source: Box<dyn FrameSource> = Box::new(Guarded::new(Box::new(simulator.on_own_threads()?)));
        Ok((source, recorder))
    }

    /// Whether a file is this recording, by its last frame. Whatever changes a scene or the simulator shows there.
    fn is_kept(&self, path: &Path, simulator: &Simulator) -> bool {
        let last = self.frames - 1;
        let read = || -> Option<Frame> {
            let mut recording = Recording::open(path).ok()?;
            recording.seek_frame(last).ok()?;
            let mut frame = Frame::zeroed(recording.waveform().shape());
            let is_there = matches!(recording.next_frame(&mut frame), Ok(SourceEvent::Frame));
            let mut behind = Frame::zeroed(recording.waveform().shape());
            let is_last = matches!(recording.next_frame(&mut behind), Ok(SourceEvent::End));
            (is_there && is_last).then_some(frame)
        };
        read().is_some_and(|kept| {
            let again = simulator.render(last);
            (kept.sequence, kept.time_ns, kept.shape, kept.truth)
                == (again.sequence, again.time_ns, again.shape, again.truth)
                && kept.codes == again.codes
        })
    }
}

/// Scores of a model on the recordings of a rung that it did not refuse.
#[derive(Default)]
struct RungScores {
    filtered: Confusion,
    alone: Confusion,
    recordings: Vec<OfRecording>,
    scores: Vec<RecordingScores>,
    reliability: ReliabilitySums,
    refused: Vec<Refused>,
    /// What a filter is fitted to.
    sequences: Vec<FilterSequence>,
}

/// Judgement of a recording, behind the filter.
#[derive(Debug, Clone, Serialize)]
struct OfRecording {
    recording: String,
    /// Its label, or "mixed" where it has several.
    label: &'static str,
    majority: Occupancy,
    frames: u64,
    /// Share of the frames that were called what their label says.
    right: f64,
    is_right: bool,
}

impl RungScores {
    fn add(&mut self, name: &str, predictions: &Predictions) {
        let scores = predictions.filtered_scores();
        if scores.frames() == 0 {
            return;
        }
        add_confusion(&mut self.filtered, &scores.confusion);
        add_confusion(&mut self.alone, &predictions.alone_scores().confusion);
        predictions.count_reliability(&mut self.reliability);
        self.sequences.push(predictions.sequence());
        self.recordings.push(OfRecording {
            recording: name.to_owned(),
            label: scores.label().map_or("mixed", Occupancy::name),
            majority: scores.majority(),
            frames: scores.frames(),
            right: scores.right() as f64 / scores.frames() as f64,
            is_right: scores.is_right(),
        });
        self.scores.push(scores);
    }

    fn merge(&mut self, other: &RungScores) {
        add_confusion(&mut self.filtered, &other.filtered);
        add_confusion(&mut self.alone, &other.alone);
        self.reliability.merge(&other.reliability);
        self.recordings.extend_from_slice(&other.recordings);
        self.scores.extend_from_slice(&other.scores);
        self.refused.extend_from_slice(&other.refused);
    }
}

/// A model on a rung, or on all of them.
#[derive(Serialize)]
struct Row {
    rung: String,
    /// Behind the filter; absent if the model refused all recordings.
    balanced_accuracy: Option<f64>,
    balanced_accuracy_by_single_frames: Option<f64>,
    /// Behind the filter, `[truth][called]`.
    confusion: Confusion,
    recordings_right: usize,
    recordings_judged: usize,
    /// Time from the start of a stretch of `two` to the first frame of it that was called two.
    second_person_found: FoundTimes,
    /// Behind the filter.
    #[serde(flatten)]
    false_alarms: FalseAlarms,
    /// Reliability of the filter's largest probability.
    reliability: Reliability,
    recordings: Vec<OfRecording>,
    refused: Vec<Refused>,
}

impl Row {
    fn new(rung: &str, scores: &RungScores) -> Self {
        let balanced = |confusion: Confusion| {
            (!scores.recordings.is_empty()).then(|| Metrics::from_confusion(confusion).balanced_accuracy)
        };
        Row {
            rung: rung.to_owned(),
            balanced_accuracy: balanced(scores.filtered),
            balanced_accuracy_by_single_frames: balanced(scores.alone),
            confusion: scores.filtered,
            recordings_right: scores.recordings.iter().filter(|recording| recording.is_right).count(),
            recordings_judged: scores.recordings.len(),
            second_person_found: FoundTimes::of(Occupancy::Two, scores.scores.iter().flat_map(|of| &of.stretches)),
            false_alarms: FalseAlarms::of(&scores.scores),
            reliability: scores.reliability.reliability(),
            recordings: scores.recordings.clone(),
            refused: scores.refused.clone(),
        }
    }
}

/// A model on a ladder.
#[derive(Serialize)]
struct OfModel {
    model: PathBuf,
    rungs: Vec<Row>,
    /// Accuracies are means over the rungs, so that each weighs the same; all else is over all recordings.
    all: Row,
}

impl OfModel {
    fn new(model: &Path, rungs: &[Rung], scores: &[RungScores]) -> Self {
        let rows: Vec<Row> = rungs.iter().zip(scores).map(|(rung, scores)| Row::new(&rung.name, scores)).collect();
        let mut sum = RungScores::default();
        scores.iter().for_each(|scores| sum.merge(scores));
        let mean = |of: fn(&Row) -> Option<f64>| {
            let values: Vec<f64> = rows.iter().filter_map(of).collect();
            (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
        };
        let all = Row {
            balanced_accuracy: mean(|row| row.balanced_accuracy),
            balanced_accuracy_by_single_frames: mean(|row| row.balanced_accuracy_by_single_frames),
            // They stand in their rungs.
            recordings: Vec::new(),
            ..Row::new("all", &sum)
        };
        OfModel { model: model.to_owned(), rungs: rows, all }
    }
}

fn print(answers: &[OfModel]) -> anyhow::Result<()> {
    eprintln!("frames in which someone enters or leaves are left out; `two` means two people or more");
    let number = |value: Option<f64>, decimals: usize| value.map_or("-".to_owned(), |v| format!("{v:.decimals$}"));
    for of in answers {
        output::text_line(&of.model.display().to_string())?;
        output::text_line(&format!(
            "  {:<12} {:>9} {:>9} {:>11} {:>12} {:>9} {:>9} {:>9} {:>12}",
            "rung",
            "by frame",
            "filtered",
            "recordings",
            "two found, s",
            "empty, h",
            "alarms/h",
            "alarm, %",
            "calibration"
        ))?;
        for row in of.rungs.iter().chain([&of.all]) {
            let some = match row.refused.len() {
                0 => String::new(),
                refused => format!("  {refused} refused"),
            };
            if row.recordings_judged == 0 {
                output::text_line(&format!("  {:<12} refused", row.rung))?;
                continue;
            }
            output::text_line(&format!(
                "  {:<12} {:>9} {:>9} {:>11} {:>12} {:>9.3} {:>9} {:>9} {:>12}{some}",
                row.rung,
                number(row.balanced_accuracy_by_single_frames, 3),
                number(row.balanced_accuracy, 3),
                format!("{} of {}", row.recordings_right, row.recordings_judged),
                number(row.second_person_found.median_s, 1),
                row.false_alarms.empty_s / 3600.0,
                number(row.false_alarms.false_alarms_per_hour, 1),
                number(row.false_alarms.false_alarm_share.map(|share| 100.0 * share), 2),
                number(row.reliability.expected_calibration_error, 3),
            ))?;
        }
        for row in &of.rungs {
            if let Some(first) = row.refused.first() {
                eprintln!("{}: {} refused: {}", of.model.display(), first.recording, first.reason);
            }
        }
    }
    Ok(())
}

/// Prints settings as a training's file takes them.
fn print_fit(fit: &SmoothingFit) -> anyhow::Result<()> {
    eprintln!(
        "log loss, the mean over models and rungs: {:.3} by frame, {:.3} through the fitted filter",
        fit.log_loss_by_frame, fit.log_loss
    );
    output::text_line("[smoothing]")?;
    output::text_line(&format!("dwell_s = {:.2}", fit.smoothing.dwell_s))?;
    output::text_line(&format!("independent_s = {:.2}", fit.smoothing.independent_s.unwrap_or_default()))?;
    output::text_line(&format!("temperature = {:.2}", fit.smoothing.temperature))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ladder() -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../fixtures/ladder")
    }

    /// Every rung can be read, says what is strange, and its scenes give frames with a truth. Seeds are those of no training.
    #[test]
    fn all_rungs_can_be_simulated() {
        let rungs = load(&ladder()).expect("rungs");
        let mut frames = 0;
        for rung in &rungs {
            assert!(rung.about.ends_with('.') && (3..=16).contains(&rung.simulations.len()), "{}", rung.name);
            frames += rung.simulations.iter().map(|simulation| simulation.frames).sum::<u64>();
            for simulation in &rung.simulations {
                assert!(simulation.seed > 700_000, "{}", simulation.name);
                let (mut source, recorder) = simulation.open(None).expect("a simulation");
                assert!(recorder.is_none());
                let mut frame = Frame::zeroed(source.waveform().shape());
                for _ in 0..3 {
                    assert_eq!(source.next_frame(&mut frame).expect("a frame"), SourceEvent::Frame);
                    assert!(frame.truth.is_some());
                }
            }
        }
        assert!((8_000..16_000).contains(&frames), "{frames} frames");
        let names: Vec<&str> = rungs.iter().map(|rung| rung.name.as_str()).collect();
        let expected = [
            "furnished",
            "gait",
            "ghosts",
            "receiver",
            "rest",
            "rooms",
            "skins",
            "still",
            "three",
            "wander",
            "waveforms",
        ];
        assert_eq!(names, expected);
    }

    /// An hour of each rung, in rooms that the rung itself does not have.
    #[test]
    fn hours_of_empty_rooms_are_of_other_seeds() {
        for rung in load(&ladder()).expect("rungs") {
            let of_rung: Vec<(String, u64)> = rung.simulations.iter().map(|of| (of.stem.clone(), of.seed)).collect();
            let scenes: BTreeSet<String> = of_rung.iter().map(|(stem, _)| stem.clone()).collect();
            let name = rung.name.clone();
            let empty = rung.without_people(1.0).expect("an hour").simulations;
            let mut time_s = 0.0;
            for simulation in &empty {
                assert_eq!(simulation.people, Some(0));
                assert!(!of_rung.contains(&(simulation.stem.clone(), simulation.seed)), "{}", simulation.name);
                let of_it_s = simulation.frames as f64 * simulation.scene.waveform().frame_interval_s();
                assert!(of_it_s < EMPTY_RECORDING_S + 1.0, "{}", simulation.name);
                time_s += of_it_s;
            }
            assert!((3600.0..3610.0).contains(&time_s), "{name}: {time_s} s");
            assert_eq!(empty.iter().map(|of| of.stem.clone()).collect::<BTreeSet<_>>(), scenes);
            assert_eq!(empty.iter().map(|of| &of.name).collect::<BTreeSet<_>>().len(), empty.len(), "{name}");
        }
    }

    /// Three people are there at a time, and read as two.
    #[test]
    fn the_rung_of_three_people_has_three_people() {
        let rung = load(&ladder().join("three.toml")).expect("a rung").remove(0);
        let busiest = rung.simulations.iter().filter(|simulation| simulation.people.is_none()).map(|simulation| {
            let options = SimulateOptions { seed: simulation.seed, ..SimulateOptions::default() };
            let simulator = Simulator::new(&simulation.scene, options).expect("a simulation");
            let people = |index: u64| simulator.people(index).iter().filter(|person| person.in_room).count();
            let most = (0..simulation.frames).map(|index| (people(index), index)).max().expect("frames");
            (most.0, simulator.truth(most.1).occupancy)
        });
        for (people, truth) in busiest {
            assert_eq!((people, truth), (3, Occupancy::Two));
        }
    }

    #[test]
    fn a_kept_recording_is_known_again() {
        let folder = tempfile::tempdir().expect("a folder");
        let mut simulation = load(&ladder().join("rooms.toml")).expect("a rung").remove(0).simulations.remove(0);
        simulation.frames = 4;
        let bar = ProgressBar::hidden();
        let path = folder.path().join(format!("{}.mcap", simulation.name));
        simulation.judge(&mut [], &mut [], Some(folder.path()), &bar).expect("simulated");
        assert!(path.exists());
        assert!(simulation.open(Some(folder.path())).expect("kept").1.is_none());
        // Of another seed or length it is another recording.
        simulation.frames = 3;
        assert!(simulation.open(Some(folder.path())).expect("anew").1.is_some());
        simulation.frames = 4;
        simulation.seed += 1;
        assert!(simulation.open(Some(folder.path())).expect("anew").1.is_some());
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn hours_that_cannot_be_simulated_are_refused() {
            for hours in [0.0, -1.0, f64::NAN, f64::INFINITY, 1e9, 25.0] {
                let rung = load(&ladder().join("rooms.toml")).expect("a rung").remove(0);
                let error = output::chain(&rung.without_people(hours).err().expect("refused"));
                assert!(error.contains("--empty-hours") && error.contains("864000"), "{error}");
            }
            let rung = load(&ladder().join("rooms.toml")).expect("a rung").remove(0);
            let few = rung.without_people(1e-9).expect("a frame").simulations;
            assert_eq!(few.iter().map(|of| of.frames).collect::<Vec<_>>(), [1]);
        }

        #[test]
        fn a_wrong_rung_is_refused_with_its_reason() {
            let folder = tempfile::tempdir().expect("a folder");
            let path = folder.path().join("rung.toml");
            let good = "format = 1\nname = \"a\"\nabout = \"b\"\n[[scene]]\npath = \"hall.toml\"\nseeds = [1, 2]\nframes = 3\n";
            for (from, to, expected) in [
                ("format = 1", "format = 2", "format is 2"),
                ("\"a\"", "\"../a\"", "expected letters"),
                ("[1, 2]", "[2, 1]", "first one first"),
                ("frames = 3", "frames = 0", "expected 1 or more"),
                ("frames = 3", "frames = 864001", "at most"),
                ("seeds", "seed", "seed"),
                ("", "", "hall.toml"),
            ] {
                std::fs::write(&path, good.replacen(from, to, 1)).expect("writable");
                let error = output::chain(&load(&path).err().expect("refused"));
                assert!(error.contains("rung.toml") && error.contains(expected), "{to}: {error}");
            }
            std::fs::remove_file(&path).expect("removed");
            let error = output::chain(&load(folder.path()).err().expect("refused"));
            assert!(error.contains("no rung") && error.contains("hint:"), "{error}");
        }
    }
}
