//! Tests of methods without training: the CFAR people counter, and directions of echoes.

use std::path::Path;

use radome_tests::{
    command, fails_with, fixture, fixture_text, json_lines, radome, simulate, success, write_file, wrong_use_with,
};
use serde_json::Value;

/// Writes the hall scene without its reverberation, with which the detector counts one walker as two.
fn hall_without_reverberation(folder: &Path) -> std::path::PathBuf {
    let hall = fixture_text("scenes/hall.toml");
    let (points, bounces) = ("diffuse_points = 64\n", "diffuse_bounces = 8\n");
    assert!(hall.contains(points) && hall.contains(bounces), "the hall has other walls now");
    let hall = hall.replace(points, "").replace(bounces, "");
    write_file(folder, "hall.toml", hall)
}

/// Asserts that the detector calls empty halls empty and walkers occupied, with the same filter and metrics as a
/// network.
#[test]
fn the_detector_classifies_recordings_in_place_of_a_model() {
    let folder = tempfile::tempdir().expect("a folder");
    let hall = hall_without_reverberation(folder.path());
    let labelled = [(0, "empty"), (1, "one")].map(|(people, label)| {
        let path = folder.path().join(format!("people-{people}.mcap"));
        simulate(&hall, &format!("--people {people} --seed 200001 --frames 150"), &path);
        format!("{}={label}", path.display())
    });
    let answer = &json_lines(command!("model evaluate --model cfar --json", ..labelled))[0];
    let recordings = answer["recordings"].as_array().expect("a list");
    assert_eq!(recordings[0]["majority"], "empty", "{answer}");
    assert!(recordings[0]["share"].as_f64().expect("number") > 0.95, "{answer}");
    assert_eq!(recordings[1]["majority"], "one", "{answer}");
}

/// Asserts that the detector accepts any waveform, also live.
#[test]
fn the_detector_classifies_any_source() {
    let args = ["live", "--model", "cfar", "--frames", "60", "--people", "0", "--json"];
    let lines = json_lines(radome().args(args).arg(fixture("scenes/corridor.toml")));
    let (summary, frames) = lines.split_last().expect("some lines");
    assert_eq!(frames.len(), 60);
    assert!(frames.iter().all(|frame| frame["label"] == "empty"), "{summary}");
}

#[test]
fn the_detector_needs_frames_and_not_maps() {
    let folder = tempfile::tempdir().expect("a folder");
    wrong_use_with(command!("model evaluate --model cfar", folder.path()), &["raw frames", "hint:"]);
}

/// Writes the corridor scene with `rest` after its furniture, in place of its people or before them.
fn write_corridor(folder: &Path, name: &str, rest: &str) -> std::path::PathBuf {
    let corridor = fixture_text("scenes/corridor.toml");
    let (head, people) = corridor.split_at(corridor.find("[people").expect("a people table"));
    let people = if rest.contains("[people") { "" } else { people };
    write_file(folder, name, format!("{head}{rest}{people}"))
}

/// Asserts that the strongest echo is the walker's: its azimuth is positive on the radar's left and negative on its
/// right.
#[test]
fn azimuth_is_on_the_side_on_which_somebody_walks() {
    let folder = tempfile::tempdir().expect("a folder");
    for (y_m, sign) in [(1.55, 1.0), (0.45, -1.0)] {
        let walk = format!(
            "[people]\n[[people.actor]]\nstep = [{{ walk_to_m = [2.0, {y_m}] }}, {{ walk_to_m = [5.0, {y_m}], speed_m_per_s = 1.0 }}]\n"
        );
        let path = write_corridor(folder.path(), "walk.toml", &walk);
        let frames = json_lines(command!("recording echoes --frames 30 --json", path));
        let strongest = frames.iter().filter_map(|frame| frame["echoes"].get(0));
        let sides: Vec<f64> = strongest.filter_map(|echo| echo["azimuth_deg"].as_f64()).collect();
        let right = sides.iter().filter(|azimuth| *azimuth * sign > 0.0).count();
        assert!(sides.len() >= 15 && 10 * right >= 9 * sides.len(), "{y_m}: {sides:?}");
    }
}

/// Asserts that `scene people` says where the strongest echo comes from, and that its velocities are those of its places.
#[test]
fn people_are_where_their_echoes_come_from() {
    let folder = tempfile::tempdir().expect("a folder");
    let walk = "[people]\n[[people.actor]]\nstep = [{ walk_to_m = [2.0, 1.55] }, { walk_to_m = [5.5, 0.45], speed_m_per_s = 1.0 }]\n";
    let path = write_corridor(folder.path(), "walk.toml", walk);
    let people = json_lines(command!("scene people --frames 30 --json", &path));
    let number = |value: &Value, key: &str| value[key].as_f64().unwrap_or_else(|| panic!("{key} of {value}"));
    let differs = |a: &Value, b: &Value, key: &str| (number(a, key) - number(b, key)).abs();
    let frames = json_lines(command!("recording echoes --frames 30 --json", &path));
    assert_eq!((people.len(), frames.len()), (30, 30));
    let is_there = |(person, frame): &(&Value, &Value)| {
        assert_eq!((&person["sequence"], &person["in_room"]), (&frame["sequence"], &true.into()));
        frame["echoes"].get(0).is_some_and(|echo| {
            differs(person, echo, "range_m") < 0.4
                && !echo["azimuth_deg"].is_null()
                && differs(person, echo, "azimuth_deg") < 12.0
        })
    };
    let there = people.iter().zip(&frames).filter(is_there).count();
    assert!(there >= 22, "{there} of 30");
    for (before, after) in people.iter().zip(&people[1..]) {
        let per_s = 1.0 / (number(after, "time_s") - number(before, "time_s"));
        let mean = 0.5 * (number(before, "radial_velocity_m_per_s") + number(after, "radial_velocity_m_per_s"));
        let rate = (number(after, "range_m") - number(before, "range_m")) * per_s;
        assert!((rate - mean).abs() < 0.1, "{before} {after}");
    }
    // The same numbers as CSV.
    let csv = folder.path().join("people.csv");
    success(command!("scene people --frames 30 -o", &csv, &path));
    let text = std::fs::read_to_string(&csv).expect("written");
    let (heading, lines) = text.split_once('\n').expect("a heading");
    let column = heading.split(',').position(|name| name == "range_m").expect("a column");
    let ranges: Vec<f64> =
        lines.lines().map(|line| line.split(',').nth(column).unwrap_or("").parse().expect("a number")).collect();
    assert!(
        ranges.len() == 30 && ranges.iter().zip(&people).all(|(range, p)| (range - number(p, "range_m")).abs() < 1e-4)
    );
    fails_with(command!("scene people --frames 3 -o", &csv, &path), &["people.csv", "--overwrite"]);
}

/// Regression test: without `--frames` the echoes of a recording ended after 100 frames, without a word.
#[test]
fn echoes_are_measured_up_to_the_end_of_a_recording() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("long.mcap");
    simulate(&fixture("scenes/desk.toml"), "--frames 110", &path);
    let frames = json_lines(command!("recording echoes --json", &path));
    assert_eq!((frames.len(), &frames[109]["sequence"]), (110, &Value::from(109)));
}

/// Asserts phase offsets near zero: the simulator's receivers are equal and the reflector's position is known. The
/// written file can be read again.
#[test]
fn a_reflector_gives_the_phase_offsets_between_receivers() {
    let folder = tempfile::tempdir().expect("a folder");
    let thing = "[[furniture]]\nname = \"corner\"\nposition_m = [2.85, 0.99, 1.49]\nsize_m = [0.02, 0.02, 0.02]\ncross_section_dbsm = 5.0\n";
    let path = write_corridor(folder.path(), "corner.toml", thing);
    let angles = folder.path().join("angles.toml");
    let args = ["recording", "echoes", "--people", "0", "--reflector", "2.5,0,0", "--json", "-o"];
    let told: Value = json_lines(radome().args(args).arg(&angles).arg(&path)).remove(0);
    for phase in ["azimuth_phase_rad", "elevation_phase_rad"] {
        assert!(told[phase].as_f64().expect("number").abs() < 0.35, "{told}");
    }
    json_lines(command!("recording echoes --frames 5 --people 0 --json --angles", &angles, &path));
    std::fs::write(&angles, "format = 7\n").expect("writable");
    fails_with(command!("recording echoes --frames 5 --angles", &angles, &path), &["hint:", "angles.toml"]);
}

/// Regression test: phase offsets were measured from noise, from somebody who walked, and from no frame at all.
#[test]
fn without_a_reflector_nothing_is_measured() {
    let folder = tempfile::tempdir().expect("a folder");
    let angles = folder.path().join("angles.toml");
    let corridor = fixture("scenes/corridor.toml");
    for (options, range, expected) in [
        ("--people 0", "4.7,0,0", "no reflector stands out at 4.7 m"),
        ("--people 1", "10,0,0", "something moves within 0.3 m of"),
        ("--people 0 --frames 0", "2.5,0,0", "no frame to measure a reflector in"),
    ] {
        let mut command = command!("recording echoes --reflector", range, &corridor, "-o", &angles);
        fails_with(command.args(options.split(' ')), &[expected]);
        assert!(!angles.exists(), "{options}");
    }
}

#[test]
fn a_source_without_echoes_is_reported_to_have_none() {
    let empty = fixture("scenes/corridor.toml");
    let (told, said) = success(command!("recording echoes --frames 5 --people 0", empty));
    assert!(told.is_empty() && said.contains("no echo stands out of the noise in 5 frames"), "{told}{said}");
}
