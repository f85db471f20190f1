//! `radome model adapt --curve`: accuracy against minutes of labels, on simulated rooms that no model has seen.
//!
//! A room is the layout that a seed draws from a scene. It stays fixed while the scenario of its people continues, so
//! recordings of it are intervals of one simulation. Intervals for adaptation come first, followed by one test interval
//! for each number of people.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};
use radome_dsp::{Frame, FrameSource, Occupancy, SourceEvent, source_from_fn};
use radome_files::named_by_spec;
use radome_models::train::{AdaptRecording, Adapter, Scores};
use radome_sim::{Scene, SimulateOptions, Simulator};
use serde::{Deserialize, Serialize};
use serde_json::json;

use super::feature_reader::FeatureReader;
use crate::classifier::Model;
use crate::{files, output};

const FORMAT: u32 = 1;
/// Time between the adaptation intervals and the test intervals, s. It is long enough for all people to have left in
/// between.
const GAP_S: f64 = 60.0;
/// Longest time in the file, s.
const LONGEST_S: f64 = 86_400.0;
/// Longest time of the empty room that is used to adapt with empty frames only, minutes.
const EMPTY_MINUTES: f64 = 1.0;
const CLASSES: usize = Occupancy::ALL.len();

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RoomsFile {
    format: u32,
    /// Total labelled minutes, a third of them for each class.
    minutes: Vec<f64>,
    /// Longest recording to adapt to, s.
    recording_s: f64,
    /// Time of each class in the test recordings, s.
    test_s: f64,
    room: Vec<RoomFile>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RoomFile {
    name: String,
    /// Scene file, relative to this file.
    scene: PathBuf,
    seed: u64,
}

impl RoomsFile {
    fn check(&self) -> anyhow::Result<()> {
        ensure!(self.format == FORMAT, "format is {}, this program knows {FORMAT}", self.format);
        let is_time = |seconds: f64| seconds > 0.0 && seconds <= LONGEST_S;
        if self.minutes.is_empty() || !self.minutes.iter().all(|minutes| is_time(60.0 * minutes)) {
            bail!("minutes are {:?}, expected some above 0 and up to {}", self.minutes, LONGEST_S / 60.0);
        }
        for (key, seconds) in [("recording_s", self.recording_s), ("test_s", self.test_s)] {
            ensure!(is_time(seconds), "{key} is {seconds}, expected above 0 and up to {LONGEST_S}");
        }
        let mut names = BTreeSet::new();
        match self.room.iter().find(|room| !names.insert(&room.name)) {
            Some(room) => bail!("two rooms are called {}", room.name),
            None if self.room.is_empty() => bail!("no [[room]]"),
            None => Ok(()),
        }
    }

    /// Time of each class for the longest of the labelled times, s.
    fn labelled_s(&self) -> f64 {
        self.minutes.iter().copied().fold(0.0, f64::max) * 60.0 / CLASSES as f64
    }
}

struct Room {
    name: String,
    /// Recordings to adapt to, `[people]`.
    training: [Vec<AdaptRecording>; CLASSES],
    test: Vec<AdaptRecording>,
}

/// Scores of an adapted model on its own room and on the other rooms.
#[derive(Debug, Clone, Copy, Serialize)]
struct Point {
    room: Scores,
    /// Scores on the other rooms; absent where there is one room.
    others: Option<Scores>,
}

/// Scores of all adaptations to a room.
#[derive(Serialize)]
struct Curve {
    room: String,
    before: Point,
    /// Scores after a minute of the empty room alone.
    empty: Point,
    /// Scores after each of the labelled times.
    labelled: Vec<Point>,
}

/// Adapts the model to each room of a file and reports the accuracy.
///
/// # Errors
/// The file of rooms or a scene cannot be read, or the model does not take their waveform.
pub fn run(model: Model, adapter: &Adapter, path: &Path, json: bool) -> anyhow::Result<()> {
    output::catch_interrupts()?;
    let file: RoomsFile = files::read_toml(path, "list of rooms")?;
    file.check().with_context(|| path.display().to_string())?;
    let folder = path.parent().unwrap_or(Path::new(""));
    let bar = output::progress(file.room.len() as u64, "rooms");
    let mut reader = FeatureReader::new(model, adapter, None);
    let mut rooms = Vec::with_capacity(file.room.len());
    for room_file in &file.room {
        bar.set_message(room_file.name.clone());
        rooms
            .push(simulate(&mut reader, &file, folder, room_file).with_context(|| format!("room {}", room_file.name))?);
        bar.inc(1);
    }
    bar.finish_and_clear();
    let curves =
        rooms.iter().map(|room| measure_curve(adapter, &file, &rooms, room)).collect::<anyhow::Result<Vec<_>>>()?;
    if json {
        return output::json_line(&json!({ "minutes": file.minutes, "curves": curves, "mean": mean_curve(&curves) }));
    }
    print(&file.minutes, &curves)
}

fn simulate(reader: &mut FeatureReader, file: &RoomsFile, folder: &Path, room_file: &RoomFile) -> anyhow::Result<Room> {
    let scene_path = named_by_spec(folder, &room_file.scene)
        .with_context(|| format!("cannot read {}", room_file.scene.display()))?;
    let scene = Scene::load(&scene_path)?;
    let interval_s = scene.waveform().frame_interval_s();
    let count = |seconds: f64| ((seconds / interval_s).round() as u64).max(1);
    let (labelled, recording, test) = (count(file.labelled_s()), count(file.recording_s), count(file.test_s));
    let mut training: [Vec<AdaptRecording>; CLASSES] = Default::default();
    let mut tests = Vec::new();
    for (people, training) in training.iter_mut().enumerate() {
        let options = SimulateOptions { seed: room_file.seed, people: Some(people), ..SimulateOptions::default() };
        // Features are computed on this thread. On the shared thread pool they would queue behind the next frames.
        let mut simulator = Simulator::new(&scene, options)?.on_own_threads()?;
        // No two intervals cover the same time, since people would move in both alike.
        let start = people as u64 * labelled;
        let mut position = start;
        while position < start + labelled {
            let length = recording.min(start + labelled - position);
            simulator.seek(position);
            training.push(read_recording(reader, &mut simulator, length)?);
            position += length;
        }
        simulator.seek(CLASSES as u64 * labelled + count(GAP_S) + people as u64 * test);
        tests.push(read_recording(reader, &mut simulator, test)?);
    }
    Ok(Room { name: room_file.name.clone(), training, test: tests })
}

/// Reads the next frames of a simulation as a recording.
fn read_recording(
    reader: &mut FeatureReader,
    simulator: &mut Simulator,
    length: u64,
) -> anyhow::Result<AdaptRecording> {
    let mut remaining = length;
    let mut source = source_from_fn(simulator.waveform().clone(), |frame| {
        if output::interrupted() {
            return Err("interrupted".into());
        }
        if remaining == 0 {
            return Ok(SourceEvent::End);
        }
        remaining -= 1;
        simulator.next_frame(frame)
    });
    let truth = |frame: &Frame| frame.truth.filter(|truth| !truth.transition).map(|truth| truth.occupancy);
    reader.read(&mut source, truth)
}

/// Copies the first seconds of the recordings.
fn first_seconds(recordings: &[AdaptRecording], seconds: f64) -> Vec<AdaptRecording> {
    let mut remaining_s = seconds;
    let mut all = Vec::new();
    for recording in recordings {
        let count = (remaining_s / recording.frame_interval_s).round().max(0.0) as usize;
        let frames: Vec<_> = recording.frames.iter().take(count).cloned().collect();
        if frames.is_empty() {
            break;
        }
        remaining_s -= frames.len() as f64 * recording.frame_interval_s;
        all.push(AdaptRecording { frame_interval_s: recording.frame_interval_s, frames });
    }
    all
}

fn measure_curve(adapter: &Adapter, file: &RoomsFile, rooms: &[Room], room: &Room) -> anyhow::Result<Curve> {
    let others = rooms.iter().filter(|other| other.name != room.name);
    let others: Vec<AdaptRecording> = others.flat_map(|other| other.test.iter().cloned()).collect();
    let point = |recordings: Option<Vec<AdaptRecording>>| -> anyhow::Result<Point> {
        let fit = recordings.map(|recordings| adapter.fit(&recordings)).transpose()?;
        let scores = |test: &[AdaptRecording]| adapter.scores(fit.as_ref(), test);
        let others = if others.is_empty() { None } else { Some(scores(&others)?) };
        Ok(Point { room: scores(&room.test)?, others })
    };
    let labelled = |minutes: &f64| {
        let of_class = |training: &Vec<AdaptRecording>| first_seconds(training, 60.0 * minutes / CLASSES as f64);
        point(Some(room.training.iter().flat_map(of_class).collect()))
    };
    Ok(Curve {
        room: room.name.clone(),
        before: point(None)?,
        empty: point(Some(first_seconds(&room.training[0], 60.0 * EMPTY_MINUTES)))?,
        labelled: file.minutes.iter().map(labelled).collect::<anyhow::Result<_>>()?,
    })
}

/// Averages over rooms.
fn mean_curve(curves: &[Curve]) -> Curve {
    let mean_scores = |point: &dyn Fn(&Curve) -> Option<Scores>| -> Option<Scores> {
        let all: Vec<Scores> = curves.iter().filter_map(point).collect();
        let mean = |value: fn(&Scores) -> f64| all.iter().map(value).sum::<f64>() / all.len() as f64;
        let scores = Scores { by_frame: mean(|scores| scores.by_frame), filtered: mean(|scores| scores.filtered) };
        (!all.is_empty()).then_some(scores)
    };
    let none = Scores { by_frame: f64::NAN, filtered: f64::NAN };
    let mean_point = |select: &dyn Fn(&Curve) -> Option<Point>| Point {
        room: mean_scores(&|curve| select(curve).map(|point| point.room)).unwrap_or(none),
        others: mean_scores(&|curve| select(curve).and_then(|point| point.others)),
    };
    let count = curves.iter().map(|curve| curve.labelled.len()).min().unwrap_or(0);
    Curve {
        room: "mean".to_owned(),
        before: mean_point(&|curve| Some(curve.before)),
        empty: mean_point(&|curve| Some(curve.empty)),
        labelled: (0..count).map(|index| mean_point(&|curve| curve.labelled.get(index).copied())).collect(),
    }
}

fn print(minutes: &[f64], curves: &[Curve]) -> anyhow::Result<()> {
    message!("balanced accuracy by frame / filtered, on other recordings of the room, by minutes of labels");
    let scores_text = |scores: Option<Scores>| {
        scores.map_or("-".to_owned(), |scores| format!("{:.2}/{:.2}", scores.by_frame, scores.filtered))
    };
    let line = |name: &str, cells: Vec<String>| {
        let cells: String = cells.iter().map(|cell| format!(" {cell:>9}")).collect();
        output::text_line(&format!("{name:<12}{cells}"))
    };
    let heading = ["0".to_owned(), "empty 1".to_owned()].into_iter().chain(minutes.iter().map(f64::to_string));
    line("room", heading.collect())?;
    let points = |curve: &Curve| {
        [curve.before, curve.empty].into_iter().chain(curve.labelled.iter().copied()).collect::<Vec<Point>>()
    };
    let mean = mean_curve(curves);
    for curve in curves.iter().chain([&mean]) {
        line(&curve.room, points(curve).iter().map(|point| scores_text(Some(point.room))).collect())?;
    }
    line("other rooms", points(&mean).iter().map(|point| scores_text(point.others)).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shipped_rooms_are_those_of_no_training_and_can_be_drawn() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fixtures");
        let text = std::fs::read_to_string(folder.join("strangers.toml")).expect("readable");
        let file: RoomsFile = toml::from_str(&text).expect("a list of rooms");
        file.check().expect("valid");
        assert!(file.room.len() >= 4 && file.minutes == [0.5, 1.0, 2.0, 5.0, 10.0]);
        for room in &file.room {
            assert!(room.seed > 800_000, "{}", room.name);
            let named = named_by_spec(&folder, &room.scene).expect("a scene");
            Scene::load(&named).and_then(|scene| scene.drawn(room.seed)).expect("a room");
        }
    }

    #[test]
    fn first_seconds_are_cut_from_the_last_recording() {
        let frames = |count: usize| {
            let frame = |index: usize| radome_models::train::AdaptFrame {
                time_s: 0.1 * index as f64,
                features: Vec::new(),
                label: None,
            };
            AdaptRecording { frame_interval_s: 0.1, frames: (0..count).map(frame).collect() }
        };
        let lengths = |seconds: f64| -> Vec<usize> {
            first_seconds(&[frames(100), frames(100), frames(100)], seconds)
                .iter()
                .map(|recording| recording.frames.len())
                .collect()
        };
        assert_eq!(lengths(5.0), [50]);
        assert_eq!(lengths(20.0), [100, 100]);
        assert_eq!(lengths(23.0), [100, 100, 30]);
        assert_eq!(lengths(60.0), [100, 100, 100]);
    }
}
