//! Tests of a captured background with a fan in the room: no false alarm in the empty room, and people are still
//! detected.

use std::f64::consts::TAU;
use std::path::Path;

use radome_tests::{
    add_signal, command, fails_with, failure, fixture, json_lines, live_command, simulate, success, wrong_use_with,
};
use serde_json::Value;

/// Simulates thirty seconds of a corridor with this number of people.
fn simulate_corridor(path: &Path, people: &str, seed: &str) {
    let options = format!("--people {people} --seed {seed} --frames 300");
    simulate(&fixture("scenes/corridor.toml"), &options, path);
}

/// Copies a recording and adds a fan at 3 m: three blades that move by 6 cm 2.3 times a second, with an amplitude of 3
/// codes.
fn add_fan(from: &Path, to: &Path, phase: f64) {
    add_signal(from, to, true, |waveform, time_s, in_chirp_s| {
        let slope = waveform.sampled_bandwidth_hz() * waveform.sample_rate_hz / waveform.shape().samples as f64;
        let frequency_hz = waveform.centre_frequency_hz() + slope * in_chirp_s;
        let echo = |blade: i32| {
            let turn = TAU * (2.3 * time_s + f64::from(blade) / 3.0) + phase;
            let delay_s = 2.0 * (3.0 + 0.06 * turn.sin()) / 299_792_458.0;
            3.0 * (TAU * delay_s * frequency_hz).cos()
        };
        (0..3).map(echo).sum()
    });
}

fn classify(recording: &Path, background: Option<&Path>) -> Vec<Value> {
    let mut command = live_command(recording, "--json");
    if let Some(background) = background {
        command.arg("--background").arg(background);
    }
    let mut lines = json_lines(&mut command);
    lines.pop();
    lines
}

fn fraction(frames: &[Value], of: impl Fn(&Value) -> bool) -> f64 {
    frames.iter().filter(|frame| of(frame)).count() as f64 / frames.len().max(1) as f64
}

#[test]
#[allow(clippy::print_stderr)]
fn a_fan_does_not_count_after_a_background_measurement_and_people_still_do() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name);
    simulate_corridor(&at("capture.mcap"), "0", "1");
    add_fan(&at("capture.mcap"), &at("capture-fan.mcap"), 0.0);
    let model = fixture("models/paper-hqnn.safetensors");
    let capture =
        command!("model background --json", at("capture-fan.mcap"), "--model", &model, "-o", at("empty.json"));
    let report = json_lines(capture);
    assert_eq!(report[0]["frames"], 300);

    let is_occupied = |frame: &Value| frame["occupied"] == true;
    for seed in ["100007", "100008"] {
        // Another recording, with another phase of the fan.
        simulate_corridor(&at("empty.mcap"), "0", seed);
        add_fan(&at("empty.mcap"), &at("empty-fan.mcap"), 1.0);
        let before = fraction(&classify(&at("empty-fan.mcap"), None), is_occupied);
        let after = fraction(&classify(&at("empty-fan.mcap"), Some(&at("empty.json"))), is_occupied);
        eprintln!(
            "seed {seed}: the empty room with a fan counts as occupied in {before:.3} of frames, then {after:.3}"
        );
        assert!(before > 0.9 && after == 0.0, "{before} {after}");

        simulate_corridor(&at("one.mcap"), "1", seed);
        add_fan(&at("one.mcap"), &at("one-fan.mcap"), 1.0);
        let there = |lines: Vec<Value>| -> f64 {
            let there: Vec<Value> =
                lines.into_iter().filter(|frame| frame["truth"] != "empty" && frame["transition"] == false).collect();
            fraction(&there, |frame| frame["label"] != "empty")
        };
        let without_fan = there(classify(&at("one.mcap"), None));
        let with_both = there(classify(&at("one-fan.mcap"), Some(&at("empty.json"))));
        eprintln!(
            "seed {seed}: who is there is seen in {without_fan:.3} without a fan, {with_both:.3} with fan and capture"
        );
        assert!(with_both > without_fan - 0.08, "{with_both} of {without_fan}");
    }
}

mod hard_cases {
    use super::*;

    #[test]
    fn an_occupied_room_a_short_measurement_and_another_models_background_are_refused() {
        let folder = tempfile::tempdir().expect("a folder");
        let at = |name: &str| folder.path().join(name);
        simulate_corridor(&at("one.mcap"), "1", "100007");
        simulate_corridor(&at("empty.mcap"), "0", "1");
        let model = fixture("models/paper-hqnn.safetensors");
        let capture = |source: &Path, seconds: &str| {
            command!("model background", source, "--model", &model, "--seconds", seconds, "-o", at("room.json"))
        };
        fails_with(capture(&at("one.mcap"), "60"), &["was not empty", "hint:"]);
        wrong_use_with(capture(&at("empty.mcap"), "2"), &["expected 90", "hint: --seconds 10"]);
        assert!(!at("room.json").exists());
        let of_nobody = command!("model background", at("empty.mcap"), "--model nope -o", at("room.json"));
        fails_with(of_nobody, &["nope: there is no such model", "model background also take cfar"]);
        let as_text = command!("model background", at("empty.mcap"), "-o", at("room.txt"));
        wrong_use_with(as_text, &[".txt stands for", "hint: end its name in .json"]);
        let (_, said) = success(capture(&at("empty.mcap"), "60"));
        assert!(said.contains("end after 30.0 s") && said.contains("shorter than --seconds 60"), "{said}");
        let with = |background: &Path, model: &str| {
            failure(command!("live", at("empty.mcap"), "--model", model, "--background", background))
        };
        assert!(with(&at("room.json"), "cfar").contains("another model"));
        // With a greatest range, cells beyond it hold other noise.
        let near = command!("model background --max-range-m 3", at("empty.mcap"), "-o", at("near.json"));
        let (_, said) = success(near);
        assert!(!said.contains("shorter than"), "{said}");
        let classify = |range: &str| {
            command!("live", at("empty.mcap"), "--background", at("near.json"), ..range.split_whitespace())
        };
        success(classify("--max-range-m 3"));
        fails_with(classify("--max-range-m 2"), &["--max-range-m 3", "--max-range-m 2", "hint:"]);
        fails_with(classify(""), &["--max-range-m 3", "no --max-range-m"]);
        std::fs::write(at("nonsense.json"), "{\"format\":1}").expect("writable");
        assert!(with(&at("nonsense.json"), model.to_str().expect("text")).contains("nonsense.json"));
    }
}
