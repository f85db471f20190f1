//! Receivers fitted to recordings, and models judged on them.

use radome_tests::{failure, fixture, json_lines, radome, shared};
use serde_json::Value;

fn number(value: &Value) -> f64 {
    value.as_f64().expect("a number")
}

/// The first half of a real recording, in which somebody breathes, says what the second half will be like.
#[test]
fn a_receiver_fitted_to_half_a_recording_meets_the_other_half() {
    let Some(recording) = shared("data/recordings/breathing-person-20260106") else { return };
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("receiver.toml");
    let lines = json_lines(radome().arg("calibrate").arg(recording).arg("--json").arg("-o").arg(&file));
    let answer = lines.first().expect("an answer");
    assert_eq!((&answer["frames_fitted"], &answer["frames_judged"]), (&Value::from(128), &Value::from(128)));
    let after = answer["after"].as_array().expect("channels");
    assert_eq!(after.len(), 3);
    for channel in after {
        assert!(number(&channel["noise_worst_db"]) < 1.0, "{channel}");
        assert!(number(&channel["leakage_error"]) < 0.10, "{channel}");
        let sigma = number(&channel["sigma_simulated_db"]) - number(&channel["sigma_real_db"]);
        assert!(sigma.abs() < 0.2, "{channel}");
    }
    // A scene takes the file that was written.
    let scene = std::fs::read_to_string(fixture("scenes/desk.toml")).expect("readable");
    let scene = scene.replace("../receivers/desk.toml", "receiver.toml");
    let path = folder.path().join("scene.toml");
    std::fs::write(&path, scene).expect("written");
    let made = json_lines(radome().arg("simulate").arg(&path).args(["--frames", "4", "--json"]));
    assert_eq!(made[0]["frames"], 4);
}

#[test]
fn recordings_are_judged_by_their_labels() {
    let Some(recording) = shared("data/recordings/breathing-person-20260106") else { return };
    let model = fixture("models/desk-hqnn.safetensors");
    let labelled = |label: &str| format!("{}={label}", recording.display());
    let lines = json_lines(radome().arg("evaluate").arg("--model").arg(&model).arg(labelled("one")).arg("--json"));
    let (answer, judged) = (&lines[0], &lines[0]["recordings"][0]);
    assert_eq!(judged["label"], "one");
    let frames = number(&judged["frames"]);
    let row: f64 = answer["confusion"][1].as_array().expect("a row").iter().map(number).sum();
    assert_eq!((frames, row), (129.0, 129.0));
    assert!((number(&judged["share"]) * frames).fract() < 1e-6, "{judged}");
    for (input, expected) in [
        (labelled("three"), "three is not empty, one or two"),
        (recording.display().to_string(), "no label"),
        ("nowhere=one".to_owned(), "nowhere"),
    ] {
        let said = failure(radome().arg("evaluate").arg("--model").arg(&model).arg(&input).arg(labelled("one")));
        assert!(said.contains(expected), "{input}: {said}");
    }
    let other = fixture("models/paper-hqnn.safetensors");
    let said = failure(radome().arg("evaluate").arg("--model").arg(other).arg(labelled("one")));
    assert!(said.contains("256 samples") && said.contains("64 samples"), "{said}");
}

#[test]
fn what_cannot_be_calibrated_is_refused() {
    let said = failure(radome().args(["calibrate", "nowhere.mcap"]));
    assert!(said.contains("nowhere.mcap"), "{said}");
    let Some(recording) = shared("data/recordings/breathing-person-20260106") else { return };
    let said = failure(radome().arg("calibrate").arg(&recording).args(["--part", "1.5"]));
    assert!(said.contains("between 0 and 1"), "{said}");
    let said = failure(radome().arg("calibrate").arg(&recording).args(["--part", "0.02"]));
    assert!(said.contains("to judge by") && said.contains("hint:"), "{said}");
    let corridor = fixture("scenes/corridor.toml");
    let said = failure(radome().arg("calibrate").arg(&recording).arg("--scene").arg(corridor));
    assert!(said.contains("waveform"), "{said}");
}
