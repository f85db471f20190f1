//! Scene and receiver files: what is wrong is said with file, line and expectation.

mod common;

use std::path::Path;

use common::hall;
use radome_sim::{Receiver, Scene, SceneError, load_receiver};

const NOBODY: &str = "[people.desk]\nmax_people = 0\n";

fn message(text: &str) -> String {
    Scene::parse(text, Path::new("a/b.toml")).map(|_| ()).expect_err("a fault").to_string()
}

fn line_of(text: &str, needle: &str) -> usize {
    text.lines().position(|l| l.contains(needle)).expect("written") + 1
}

#[test]
fn fixture_scenes_load_and_name_their_waveform() {
    for (name, samples) in
        [("corridor", 256), ("room", 256), ("desk", 64), ("room-mesh", 256), ("bedroom", 256), ("bathroom", 256)]
    {
        let scene = common::scene(name);
        assert_eq!(scene.waveform().request.samples_per_chirp, samples);
        assert_eq!(scene.name(), name);
    }
}

#[test]
fn the_typical_receiver_file_is_the_built_in_default() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fixtures/receivers/typical.toml");
    let file = load_receiver(&path).expect("fixture");
    let built_in = Receiver::typical();
    assert!((file.transmit_power_step_db - built_in.transmit_power_step_db).abs() < 1e-3);
    let same = Receiver {
        measured_from: built_in.measured_from.clone(),
        transmit_power_step_db: built_in.transmit_power_step_db,
        ..file
    };
    assert_eq!(same, built_in);
}

#[test]
fn every_receiver_fixture_loads() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fixtures/receivers");
    for entry in std::fs::read_dir(folder).expect("folder") {
        let path = entry.expect("entry").path();
        if path.extension().is_some_and(|e| e == "toml") {
            assert!(load_receiver(&path).is_ok(), "{}: {:?}", path.display(), load_receiver(&path).err());
        }
    }
}

mod hard_cases {
    use super::*;

    #[test]
    fn a_wrong_key_names_file_line_and_what_would_do() {
        let text = hall(NOBODY)
            .replace("azimuth", "azimut")
            .replace("position_m = [1.0, 10.0, 1.2]", "posiiton_m = [1.0, 10.0, 1.2]");
        let message = message(&text);
        let line = line_of(&text, "posiiton_m");
        assert!(message.starts_with(&format!("a/b.toml:{line}: ")), "{message}");
        assert!(message.contains("posiiton_m") && message.contains("position_m"), "{message}");
    }

    #[test]
    fn values_that_make_no_sense_are_refused_with_line_and_bounds() {
        let cases = [
            ("size_m = [20.0, 20.0, 3.0]", "size_m = [20.0, -2.0, 3.0]", "size_m", "0.5 to 100 m"),
            ("position_m = [1.0, 10.0, 1.2]", "position_m = [1.0, 10.0, 9.2]", "position_m", "in the room"),
            ("position_m = [1.0, 10.0, 1.2]", "position_m = [nan, 10.0, 1.2]", "position_m", "in the room"),
            ("x_low = { material = \"open\" }", "x_low = { material = \"cheese\" }", "x_low", "concrete"),
            (
                "x_low = { material = \"open\" }",
                "x_low = { material = \"wood\", thickness_m = -1.0 }",
                "thickness_m",
                "0 to 10 m",
            ),
            ("sample_rate_hz = 1e6", "sample_rate_hz = 9e6", "[waveform]", "sample_rate_hz"),
            ("sample_rate_hz = 1e6", "sample_rate_hz = \"fast\"", "sample_rate_hz", "f64"),
            ("max_people = 0", "max_people = 3", "max_people", "two"),
            ("adc_white_lsb = 2.0", "adc_white_lsb = -2.0", "adc_white_lsb", "physical"),
            ("format = 1\nname = \"hall\"", "format = 2\nname = \"hall\"", "format", "expected 1"),
        ];
        for (from, to, at, expected) in cases {
            let text = hall(NOBODY).replacen(from, to, 1);
            assert_ne!(text, hall(NOBODY), "{from}");
            let message = message(&text);
            let line = line_of(&text, at);
            assert!(message.starts_with(&format!("a/b.toml:{line}: ")), "{to}: {message} (line {line})");
            assert!(message.contains(expected), "{to}: {message}");
        }
    }

    #[test]
    fn programs_must_be_one_and_complete() {
        for (people, expected) in [
            ("[people]\n", "exactly one"),
            ("[people.desk]\n[people.visits]\n", "exactly one"),
            ("[people.visits]\n", "door"),
            ("[people]\nactor = [{ step = [{ stand_s = 1.0 }] }]\n", "walk_to_m"),
            ("[people]\nactor = [{ step = [{ walk_to_m = [1.0, 1.0] }, { sit_s = 3.0, seat = 2 }] }]\n", "[[seat]]"),
            ("[[door]]\nposition_m = [3.0, 3.0]\n[people.visits]\n", "wall"),
        ] {
            let message = message(&hall(people));
            assert!(message.contains(expected), "{people}: {message}");
        }
    }

    #[test]
    fn missing_files_are_named() {
        let error = Scene::load(Path::new("/nowhere/scene.toml")).map(|_| ()).expect_err("missing");
        assert!(matches!(error, SceneError::Read { .. }) && error.to_string().contains("/nowhere/scene.toml"));
        let text = hall(NOBODY);
        let from = text.find("[receiver]").expect("receiver");
        let to = text.find("[room]").expect("room");
        let text = format!("{}{}", &text[..from], &text[to..])
            .replace("name = \"hall\"", "name = \"hall\"\nreceiver = \"none.toml\"");
        assert!(message(&text).contains("a/none.toml"), "{}", message(&text));
        assert!(message("").contains("a/b.toml:1"));
        assert!(message("\u{0}\u{1}[[[").contains("a/b.toml:1"));
    }
}
