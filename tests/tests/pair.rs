//! Tests of recordings and the scenes that mirror them: simulated recordings with known trajectories, and a real one.

use std::path::{Path, PathBuf};
use std::process::Command;

use radome_sim::people::motion::{Motion, MotionBuilder, Person};
use radome_tests::{
    command, fails_with, failure, fixture, fixture_text, json_lines, shared, simulate, success, write_file,
    wrong_use_with,
};
use serde_json::Value;

/// Path of a walker: way-points, and the speed towards each. A repeated way-point is a pause of two seconds.
type Path2 = [([f64; 2], f64)];

/// Motion along the way-points, which are rounded as in scene files. The choice of the person does not matter.
fn motion(path: &Path2) -> Motion {
    let mut builder = MotionBuilder::new(Person::draw(0, [0, 0], 1.75), 0.0, path[0].0, 0.0);
    for (place, speed) in &path[1..] {
        builder = if builder.place() == *place { builder.stand(2.0) } else { builder.walk_to(*place, *speed) };
    }
    builder.stay()
}

/// Writes a scene of the fixtures with these people in it.
fn scene(folder: &Path, fixture_name: &str, paths: &[&Path2]) -> PathBuf {
    let text = fixture_text(fixture_name);
    let (room, _) = text.split_once("[people.visits]").expect("a program of visits");
    let mut text = room.to_owned();
    for path in paths {
        let step = |(i, (place, speed)): (usize, &([f64; 2], f64))| match i {
            0 => format!("{{ walk_to_m = {place:?} }}"),
            _ if path[i - 1].0 == *place => "{ stand_s = 2.0 }".to_owned(),
            _ => format!("{{ walk_to_m = {place:?}, speed_m_per_s = {speed:?} }}"),
        };
        let steps: Vec<String> = path.iter().enumerate().map(step).collect();
        text += &format!("[[people.actor]]\nstep = [{}]\n", steps.join(", "));
    }
    write_file(folder, "walk.toml", text)
}

fn record(scene: &Path, frames: u64, seed: u64) -> PathBuf {
    let file = scene.with_extension("mcap");
    simulate(scene, &format!("--frames {frames} --seed {seed}"), &file);
    file
}

fn pair_command(recording: &Path, scene: &Path, output: &Path) -> Command {
    command!("scene pair --json", recording, scene, "-o", output)
}

fn numbers(value: &Value) -> [f64; 2] {
    let number = |i: usize| value[i].as_f64().expect("a number");
    [number(0), number(1)]
}

/// Errors of an estimated trajectory against the true one.
#[derive(Debug, Default)]
struct Errors {
    /// Number of frames in which the person was visible, followed by the number of all frames.
    visible: usize,
    frames: usize,
    /// Sorted errors of position (m), of velocity (m/s) and of radial velocity.
    place: Vec<f64>,
    velocity: Vec<f64>,
    radial: Vec<f64>,
}

impl Errors {
    /// Computes the errors of a person's track. Velocities are not compared within the intervals `turns` (s, from and
    /// to), in which the walker turns, starts or stops.
    fn of(set: &Path, person: u64, truth: &Motion, radar: [f64; 2], frames: usize, turns: &[[f64; 2]]) -> Self {
        /// Time from the start to the middle of a frame of the paper's waveform, s.
        const MIDDLE_S: f64 = 0.032;
        let text = std::fs::read_to_string(set.join("track.jsonl")).expect("a track");
        let mut errors = Errors { frames, ..Errors::default() };
        for line in text.lines() {
            let line: Value = serde_json::from_str(line).expect("JSON");
            if line["person"] != person || line["visible"] != true {
                continue;
            }
            errors.visible += 1;
            let time_s = line["frame_begins_s"].as_f64().expect("a time") + MIDDLE_S;
            let at = |t: f64| truth.walk(t).position_m;
            let (place, [before, after]) = (at(time_s), [at(time_s - 0.01), at(time_s + 0.01)]);
            let velocity = [0, 1].map(|i| (after[i] - before[i]) / 0.02);
            let (told, told_velocity) = (numbers(&line["position_m"]), numbers(&line["velocity_m_per_s"]));
            errors.place.push((told[0] - place[0]).hypot(told[1] - place[1]));
            if turns.iter().any(|[from, to]| (*from..*to).contains(&time_s)) {
                continue;
            }
            let off = [0, 1].map(|i| told_velocity[i] - velocity[i]);
            let sight = [place[0] - radar[0], place[1] - radar[1]];
            errors.velocity.push(off[0].hypot(off[1]));
            errors.radial.push(((off[0] * sight[0] + off[1] * sight[1]) / sight[0].hypot(sight[1])).abs());
        }
        for all in [&mut errors.place, &mut errors.velocity, &mut errors.radial] {
            all.sort_by(f64::total_cmp);
        }
        errors
    }

    fn text(&self) -> String {
        let spread = |all: &[f64]| format!("{:.3}/{:.3}/{:.3}", rms(all), quantile(all, 0.9), quantile(all, 1.0));
        let (place, velocity, radial) = (spread(&self.place), spread(&self.velocity), spread(&self.radial));
        let (visible, frames) = (self.visible, self.frames);
        format!(
            "visible in {visible} of {frames}; rms/p90/worst: place {place} m, velocity {velocity} m/s, radial {radial} m/s"
        )
    }
}

fn rms(all: &[f64]) -> f64 {
    (all.iter().map(|e| e * e).sum::<f64>() / all.len() as f64).sqrt()
}

fn quantile(sorted: &[f64], share: f64) -> f64 {
    sorted[((sorted.len() - 1) as f64 * share).round() as usize]
}

/// Intervals of half a second either side of a path's corners, where velocities change by up to 3 m/s in a second.
fn turn_intervals(path: &Path2) -> Vec<[f64; 2]> {
    let mut time_s = 0.0;
    let mut turns = vec![[-0.5, 0.5]];
    for pair in path.windows(2) {
        let (from, (to, speed)) = (pair[0].0, pair[1]);
        let way_m = (to[0] - from[0]).hypot(to[1] - from[1]);
        time_s += if way_m > 0.0 { way_m / speed } else { 2.0 };
        turns.push([time_s - 0.5, time_s + 0.5]);
    }
    turns
}

const CORRIDOR: [f64; 2] = [0.35, 1.0];
const ROOM: [f64; 2] = [0.1, 3.0];

/// Asserts errors below 10 cm and 0.1 m/s, for nine in ten frames and on average, wherever the person is visible. The
/// paths run along the corridor and past its walls, with noise and multipath. Tangential velocity follows from
/// positions alone and lags at sharp turns, where only positions are compared.
#[test]
fn a_walker_is_recovered_within_ten_centimetres_where_visible() {
    let up_and_down: &Path2 = &[([6.5, 0.5], 0.0), ([2.0, 1.5], 1.3), ([6.0, 0.6], 0.9)];
    let stands: &Path2 = &[([8.0, 1.3], 0.0), ([1.2, 0.7], 1.2), ([1.2, 0.7], 0.0), ([7.0, 1.0], 1.0)];
    let crosses: &Path2 = &[([5.5, 1.4], 0.0), ([2.0, 4.0], 1.1), ([2.6, 2.0], 0.8), ([5.0, 3.4], 1.2)];
    for (name, path, radar, frames, seed, least_visible) in [
        ("scenes/corridor.toml", up_and_down, CORRIDOR, 100, 1, 0.6),
        ("scenes/corridor.toml", stands, CORRIDOR, 130, 1, 0.75),
        ("scenes/room.toml", crosses, ROOM, 100, 3, 0.95),
        ("scenes/room.toml", crosses, ROOM, 100, 4, 0.95),
    ] {
        let folder = tempfile::tempdir().expect("a folder");
        let scene = scene(folder.path(), name, &[path]);
        let recording = record(&scene, frames, seed);
        let set = folder.path().join("set");
        // The command takes only the room from the scene file, whose people are others.
        let said = json_lines(pair_command(&recording, &fixture(name), &set)).remove(0);
        let errors = Errors::of(&set, 1, &motion(path), radar, frames as usize, &turn_intervals(path));
        let told = format!("{name} seed {seed}: {}", errors.text());
        assert!(errors.visible as f64 >= least_visible * frames as f64, "{told}");
        assert_eq!(said["people"][0]["visible"], errors.visible);
        assert!(rms(&errors.place) < 0.1 && quantile(&errors.place, 0.9) < 0.1, "{told}");
        assert!(rms(&errors.velocity) < 0.1, "{told}");
        assert!(quantile(&errors.radial, 0.9) < 0.1, "{told}");
        // Echoes of the mirrored scene lie at the ranges of the recording's.
        let person = &said["people"][0];
        assert!(person["compared"].as_u64() > Some(frames * 8 / 10), "{said}");
        assert!(person["range_m"]["rms"].as_f64() < Some(0.1), "{said}");
        assert_eq!(said["labels_agree"], frames);
    }
}

#[test]
fn two_walkers_who_pass_each_other_are_both_recovered() {
    let to: &Path2 = &[([7.0, 0.6], 0.0), ([1.5, 0.6], 1.2), ([5.0, 0.6], 1.0)];
    let fro: &Path2 = &[([2.0, 1.4], 0.0), ([6.5, 1.4], 0.9), ([3.0, 1.4], 1.2)];
    let folder = tempfile::tempdir().expect("a folder");
    let scene = scene(folder.path(), "scenes/corridor.toml", &[to, fro]);
    let recording = record(&scene, 100, 3);
    let set = folder.path().join("set");
    json_lines(pair_command(&recording, &scene, &set));
    for path in [to, fro] {
        let of = |person| Errors::of(&set, person, &motion(path), CORRIDOR, 100, &turn_intervals(path));
        let errors = [of(1), of(2)].into_iter().min_by(|a, b| rms(&a.place).total_cmp(&rms(&b.place)));
        let errors = errors.expect("two");
        assert!(errors.visible > 60 && rms(&errors.place) < 0.1, "{}", errors.text());
        assert!(rms(&errors.velocity) < 0.12, "{}", errors.text());
    }
}

/// Asserts that the output is a regular dataset, whose splits keep both sides together, and that the mirror is a
/// regular scene.
#[test]
fn a_pair_is_a_dataset_and_its_mirror_a_scene() {
    let folder = tempfile::tempdir().expect("a folder");
    let path: &Path2 = &[([5.0, 1.2], 0.0), ([2.0, 0.8], 1.1)];
    let scene = scene(folder.path(), "scenes/corridor.toml", &[path]);
    // With some seeds a ghost of the walker is followed as the second person of the labels.
    let recording = record(&scene, 30, 1);
    // Labels of a file take the place of the recording's own truth: the last ten of its frames have no label.
    let labels = write_file(folder.path(), "labels.txt", "0.0\t2.0\ttwo\n");
    let set = folder.path().join("set");
    let make = |output: &Path| {
        let mut command = pair_command(&recording, &scene, output);
        command.args(["--map", "paper", "--subject", "somebody", "--name", "walk-1"]);
        command
    };
    let said = json_lines(make(&set)).remove(0);
    assert_eq!((said["maps"].as_u64(), said["pair"].as_str()), (Some(60), Some("walk-1")));
    let manifest = std::fs::read_to_string(set.join("manifest.jsonl")).expect("a manifest");
    let rows: Vec<Value> = manifest.lines().map(|line| serde_json::from_str(line).expect("JSON")).collect();
    let (real, sim) = rows.split_at(30);
    for (a, b) in real.iter().zip(sim) {
        assert_eq!((&a["domain"], &b["domain"]), (&Value::from("real"), &Value::from("sim")));
        for key in ["pair", "sequence", "scene", "subject", "frame", "time_ns", "label", "transition"] {
            assert_eq!(a[key], b[key], "{key}");
        }
        assert_ne!(a["recording"], b["recording"]);
        assert_ne!(a["hash"], b["hash"]);
    }
    let verified = json_lines(command!("dataset verify --json", &set)).remove(0);
    assert_eq!((verified["pairs"].as_u64(), verified["sequences"].as_u64()), (Some(1), Some(1)));
    assert_eq!(verified["unpaired"], Value::Array(Vec::new()));
    json_lines(command!("dataset stats --json", &set));
    // The mirrored scene gives the same number of frames again.
    let again = json_lines(command!("scene simulate --json --frames 30", set.join("mirror.toml")));
    assert_eq!(again[0]["frames"], 30);
    let twice = folder.path().join("twice");
    json_lines(make(&twice));
    for file in ["manifest.jsonl", "mirror.toml", "track.jsonl", "maps-00000.npy"] {
        let read = |set: &Path| std::fs::read(set.join(file)).expect("a file");
        let (a, b) = (read(&set), read(&twice));
        // Only the folder's name in the header of `mirror.toml` differs.
        assert!(a == b || file == "mirror.toml" && a.len() == b.len() + "set".len() - "twice".len(), "{file}");
    }
    fails_with(make(&set), &["exists already"]);
    // If labels state two people but one is detected, the error names the missing person.
    let said = failure(make(&folder.path().join("three")).arg("--labels").arg(&labels));
    assert!(said.contains("person 2 is in the room") && said.contains("--waypoints"), "{said}");
    assert!(!folder.path().join("three").exists() && !folder.path().join("three.partial").exists());
    let points = write_file(
        folder.path(),
        "points.toml",
        "[[person]]\npoint = []\n[[person]]\npoint = [{ time_s = 0.0, position_m = [9.0, 1.0] }]\n",
    );
    let mut command = make(&folder.path().join("three"));
    let said = json_lines(command.arg("--labels").arg(&labels).arg("--waypoints").arg(&points)).remove(0);
    assert_eq!((said["maps"].as_u64(), said["people"].as_array().map(Vec::len)), (Some(40), Some(2)));
}

/// Asserts that labels and doors complete a path whose ends lie outside the beam: a person enters, walks and leaves.
#[test]
fn visitors_come_and_go_by_doors() {
    let folder = tempfile::tempdir().expect("a folder");
    let text = fixture_text("scenes/corridor.toml").replace("max_people = 2", "max_people = 1");
    let scene = write_file(folder.path(), "visits.toml", text);
    let recording = record(&scene, 150, 2);
    let said = json_lines(pair_command(&recording, &scene, &folder.path().join("set"))).remove(0);
    assert!(said["labels_agree"].as_u64() >= Some(135), "{said}");
    assert!(said["people"][0]["followed"].as_u64() > Some(40), "{said}");
}

#[test]
fn one_receiver_gives_only_distance() {
    let folder = tempfile::tempdir().expect("a folder");
    let path: &Path2 = &[([6.0, 1.0], 0.0), ([2.0, 1.0], 1.0)];
    let scene = scene(folder.path(), "scenes/corridor.toml", &[path]);
    let text = std::fs::read_to_string(&scene).expect("a scene").replace("[1, 2, 3]", "[1]");
    std::fs::write(&scene, text).expect("writable");
    let recording = record(&scene, 30, 2);
    // A scene of three receivers is accepted, since the recording determines the waveform.
    let set = folder.path().join("set");
    let (told, said) = success(pair_command(&recording, &fixture("scenes/corridor.toml"), &set));
    assert!(said.contains("along the boresight"), "{said}");
    assert!(said.contains("the mirror has the recording's waveform"), "{said}");
    let answer: Value = serde_json::from_str(&told).expect("JSON");
    assert_eq!(answer["tells_direction"], false);
    let errors = Errors::of(&set, 1, &motion(path), CORRIDOR, 30, &[]);
    // The person walked along the boresight.
    assert!(errors.visible > 10 && rms(&errors.place) < 0.1, "{}", errors.text());
}

/// Asserts that a recording of a sitting, breathing person is processed completely: no walking speed, eight chirps a
/// frame.
#[test]
fn a_real_recording_is_paired_up_to_its_end() {
    let Some(recording) = shared("data/recordings/breathing-person-20260106") else { return };
    let folder = tempfile::tempdir().expect("a folder");
    let scene = fixture("scenes/desk.toml");
    fails_with(pair_command(&recording, &scene, &folder.path().join("set")), &["no frame has a label", "--people"]);
    let set = folder.path().join("set");
    let said = json_lines(pair_command(&recording, &scene, &set).args(["--people", "1", "--seated"])).remove(0);
    assert_eq!((said["frames"].as_u64(), said["maps"].as_u64()), (Some(256), Some(512)));
    assert_eq!(said["labels_agree"], 256);
    json_lines(command!("dataset verify --json", &set));
    // Bins 12 and 13: the person's surface is 0.36 to 0.39 m away.
    let person = &said["people"][0];
    assert_eq!(person["followed"], 256, "{said}");
    assert!(person["range_m"]["rms"].as_f64() < Some(0.1), "{said}");
}

mod hard_cases {
    use super::*;

    /// Regression test: maps of a mirror with one person had the label of its recording with two. The second person of this mirror
    /// leaves the room, which the labels do not say.
    #[test]
    fn frames_whose_mirror_has_other_people_than_the_labels_are_left_out_of_both_parts() {
        let folder = tempfile::tempdir().expect("a folder");
        let scene = scene(folder.path(), "scenes/corridor.toml", &[&[([5.0, 1.2], 0.0), ([2.0, 0.8], 1.1)]]);
        let recording = record(&scene, 30, 1);
        let labels = write_file(folder.path(), "labels.txt", "0.0\t3.0\ttwo\n");
        let [stands, leaves, left] = [(0.0, 11.0), (1.0, 11.0), (2.0, 12.7)]
            .map(|(time_s, x)| format!("{{ time_s = {time_s:?}, position_m = [{x:?}, 1.0] }}"));
        let points = format!("[[person]]\npoint = []\n[[person]]\npoint = [{stands}, {leaves}, {left}]\n");
        let points = write_file(folder.path(), "points.toml", points);
        let set = folder.path().join("set");
        let mut command = pair_command(&recording, &scene, &set);
        let said = json_lines(command.arg("--labels").arg(labels).arg("--waypoints").arg(points)).remove(0);
        // The person is in the doorway at 1.8 s.
        let agreeing = said["labels_agree"].as_u64().expect("a number");
        assert!((15..25).contains(&agreeing), "{said}");
        assert_eq!(said["maps"], 2 * agreeing);
        let manifest = std::fs::read_to_string(set.join("manifest.jsonl")).expect("a manifest");
        let rows: Vec<Value> = manifest.lines().map(|line| serde_json::from_str(line).expect("JSON")).collect();
        let simulator = radome_sim::Simulator::new(
            &radome_sim::Scene::load(&set.join("mirror.toml")).expect("a scene"),
            radome_sim::SimulateOptions { seed: 1, ..Default::default() },
        );
        let simulator = simulator.expect("a simulator");
        for row in &rows {
            let truth = simulator.truth(row["frame"].as_u64().expect("a number"));
            assert_eq!(row["label"], truth.occupancy.name(), "{row}");
            assert_eq!(row["transition"], truth.transition, "{row}");
        }
        assert!(rows.iter().any(|row| row["transition"] == true));
        let verified = json_lines(command!("dataset verify --json", &set)).remove(0);
        assert_eq!(verified["unpaired"], Value::Array(Vec::new()));
    }

    #[test]
    fn an_empty_recording_is_paired_with_a_scene_without_people() {
        let folder = tempfile::tempdir().expect("a folder");
        let scene_file = scene(folder.path(), "scenes/corridor.toml", &[&[([5.0, 1.0], 0.0)]]);
        let recording = folder.path().join("empty.mcap");
        simulate(&scene_file, "--frames 12 --people 0", &recording);
        let text = std::fs::read_to_string(&scene_file).expect("a scene");
        let (room, _) = text.split_once("[[people.actor]]").expect("people");
        std::fs::write(&scene_file, room).expect("writable");
        // As of a dataset that is built, the folder above is made.
        let said = json_lines(pair_command(&recording, &scene_file, &folder.path().join("new/set"))).remove(0);
        assert_eq!((said["maps"].as_u64(), said["labels_agree"].as_u64()), (Some(24), Some(12)));
        assert_eq!(said["people"], Value::Array(Vec::new()));
        // Regression test: shards of one run were sequences of their own, so that splits could divide the run.
        let (shard, set) = (folder.path().join("run-shard-00001-of-00002.mcap"), folder.path().join("shard"));
        std::fs::copy(&recording, &shard).expect("copied");
        json_lines(pair_command(&shard, &scene_file, &set));
        let manifest = std::fs::read_to_string(set.join("manifest.jsonl")).expect("a manifest");
        assert_eq!(manifest.matches("\"sequence\":\"run\"").count(), 24, "{manifest}");
        assert_eq!(manifest.matches("\"pair\":\"run-shard-00001-of-00002\"").count(), 24, "{manifest}");
    }

    /// Labels beyond the frames that were asked for made an error.
    #[test]
    fn labels_may_extend_beyond_the_frames() {
        let folder = tempfile::tempdir().expect("a folder");
        let path: &Path2 = &[([5.0, 1.0], 0.0), ([3.0, 1.0], 1.0)];
        let scene_file = scene(folder.path(), "scenes/corridor.toml", &[path]);
        let recording = record(&scene_file, 12, 1);
        let labels = write_file(folder.path(), "labels.txt", "0.0\t0.8\tone\n0.8\t1.2\tempty\n");
        let mut command = pair_command(&recording, &scene_file, &folder.path().join("set"));
        let said = json_lines(command.arg("--labels").arg(&labels).args(["--frames", "6"])).remove(0);
        assert_eq!(said["maps"], 12, "{said}");
    }

    #[test]
    fn what_cannot_be_mirrored_is_named() {
        let folder = tempfile::tempdir().expect("a folder");
        let path: &Path2 = &[([5.0, 1.0], 0.0), ([3.0, 1.0], 1.0)];
        let scene_file = scene(folder.path(), "scenes/corridor.toml", &[path]);
        let recording = record(&scene_file, 12, 1);
        let set = folder.path().join("set");
        let write = |name: &str, text: &str| write_file(folder.path(), name, text);
        fails_with(pair_command(&folder.path().join("nowhere.mcap"), &scene_file, &set), &["nowhere.mcap"]);
        fails_with(pair_command(&recording, &folder.path().join("nowhere.toml"), &set), &["nowhere.toml"]);
        fails_with(pair_command(&recording, &fixture("scenes/hall.toml"), &set), &["another for each seed", "hint:"]);
        fails_with(pair_command(&scene_file, &scene_file, &set), &["--frames"]);
        for height_m in ["17", "nan"] {
            wrong_use_with(
                pair_command(&recording, &scene_file, &set).args(["--height-m", height_m]),
                &["0.5 to 2.5 m"],
            );
        }
        let order = write(
            "order.toml",
            "[[person]]\npoint = [{ time_s = 2.0, position_m = [1.0, 1.0] }, { time_s = 1.0, position_m = [1.0, 1.0] }]\n",
        );
        fails_with(
            pair_command(&recording, &scene_file, &set).arg("--waypoints").arg(&order),
            &["1 s comes after 2 s"],
        );
        for (point, said) in [
            ("{ time_s = 0.5, position_m = [nan, 1.0] }", "point 1 of person 1: expected a finite time and position"),
            ("{ time_s = inf, position_m = [5.0, 1.0] }", "point 1 of person 1: expected a finite time and position"),
            (
                "{ time_s = 0.5, position_m = [500.0, 1.0] }",
                "point 1 of person 1 is at [500.0, 1.0] m, outside of the scene's room",
            ),
            (
                "{ time_s = 1e9, position_m = [5.0, 1.0] }",
                "point 1 of person 1 is at 1000000000 s, expected a time of the recording",
            ),
        ] {
            let points = write("points.toml", &format!("[[person]]\npoint = [{point}]\n"));
            let mut command = pair_command(&recording, &scene_file, &set);
            fails_with(command.arg("--waypoints").arg(points), &["points.toml: ", said]);
        }
        let other = write("other.toml", "[[person]]\nplaces = 3\n");
        fails_with(pair_command(&recording, &scene_file, &set).arg("--waypoints").arg(&other), &["no way-points"]);
        let late = write("late.txt", "0.0\t99.0\tone\n");
        fails_with(pair_command(&recording, &scene_file, &set).arg("--labels").arg(&late), &["99"]);
        assert!(!set.exists() && !folder.path().join("set.partial").exists());
    }
}
