//! Tests of receivers fitted to recordings, and of models judged on them.

use std::path::Path;

use radome_tests::{
    command, fails_with, failure, fixture, json_lines, shared, simulate, subcommand, write_file, wrong_use_with,
};
use serde_json::Value;

fn number(value: &Value) -> f64 {
    value.as_f64().expect("a number")
}

/// Asserts that a receiver fitted to the first half of a real recording, of a breathing person, describes the second
/// half.
#[test]
fn a_receiver_fitted_to_half_a_recording_matches_the_other_half() {
    let Some(recording) = shared("data/recordings/breathing-person-20260106") else { return };
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("receiver.toml");
    let lines = json_lines(command!("scene calibrate --json", recording, "-o", &file));
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
    // The gap has intervals, which contain the figures. Halves of the recording are closer to each other than to a
    // simulation.
    assert_eq!(answer["resampled"], "contiguous blocks of the one recording");
    for (channel, between) in after.iter().zip(answer["between_real"].as_array().expect("channels")) {
        for name in ["mean_difference_db", "kolmogorov_smirnov", "wasserstein_db", "doppler_m_per_s", "range_m"] {
            let [low, high] = [0, 1].map(|end| number(&channel["interval"][name][end]));
            assert!(low < high, "{name}: {channel}");
        }
        assert!(number(&between["wasserstein_db"]) < 0.2, "{between}");
    }
    let distance = |which: &str| -> f64 {
        let channels = answer[which].as_array().expect("channels");
        channels.iter().map(|channel| number(&channel["wasserstein_db"])).sum()
    };
    assert!(distance("after") < distance("before"), "{answer}");
    // The file states the command that made it, but no absolute path.
    let text = std::fs::read_to_string(&file).expect("readable");
    assert!(
        text.contains("radome scene calibrate breathing-person-20260106 --copies 16 --part 0.5 -o receiver.toml"),
        "{text}"
    );
    assert!(!text.contains("/breathing-person"), "{text}");
    // A scene accepts the written file.
    let scene = std::fs::read_to_string(fixture("scenes/desk.toml")).expect("readable");
    let scene = scene.replace("../receivers/desk.toml", "receiver.toml");
    let path = write_file(folder.path(), "scene.toml", scene);
    let made = json_lines(command!("scene simulate --json", &path, "--frames 4"));
    assert_eq!(made[0]["frames"], 4);
}

/// Asserts that simulated persons at the recording's distance, through the receiver fitted to it, give a slow-time line
/// of equal strength and range. Persons of average build differ, so that many are drawn; none is selected by the
/// recording.
#[test]
fn a_simulated_copy_of_the_recording_breathes_as_strongly_and_as_far_away() {
    let Some(recording) = shared("data/recordings/breathing-person-20260106") else { return };
    let scene = fixture("scenes/desk-person.toml");
    let lines = json_lines(command!("scene calibrate --json", recording, "--scene", scene, "--people 1"));
    let (answer, line) = (&lines[0], &lines[0]["line"]);
    let real = &line["real"];
    // reference/hardware.md section 6: bins 12 and 13, corrected 0.36 to 0.39 m, 0.20 to 0.25 Hz.
    assert!((0.34..0.40).contains(&number(&real["range_m"])), "{real}");
    assert!((0.15..0.30).contains(&number(&real["breath_hz"])), "{real}");
    let after = &line["after"];
    assert_eq!(after["copies"], 16);
    assert!(number(&after["level_difference_db"]).abs() < 3.0, "{line}");
    assert!(number(&after["range_difference_m"]).abs() < 0.05, "{line}");
    assert!((0.15..0.40).contains(&number(&after["breath_hz"])), "{line}");
    // This recording does not determine the echo strength: everything beyond half a metre moves.
    assert!(answer["gain"]["gain_db"].is_null() && number(&answer["gain"]["bins"]) < 9.0, "{answer}");
}

/// Simulates a corridor recording by a receiver that is 5 dB louder than the assumed one. Recordings differ in seed and
/// drift.
fn corridor(folder: &Path, seed: u64, frames: u32) -> std::path::PathBuf {
    let paper = std::fs::read_to_string(fixture("receivers/paper.toml")).expect("readable");
    let loud = paper.replace("gain_correction_db = 0.0 ", "gain_correction_db = 5.0 ");
    assert_ne!(loud, paper);
    std::fs::write(folder.join("loud.toml"), loud).expect("written");
    let scene = std::fs::read_to_string(fixture("scenes/corridor.toml")).expect("readable");
    std::fs::write(folder.join("scene.toml"), scene.replace("../receivers/paper.toml", "loud.toml")).expect("written");
    let recording = folder.join(format!("corridor-{seed}.mcap"));
    simulate(&folder.join("scene.toml"), &format!("--people 0 --seed {seed} --frames {frames}"), &recording);
    recording
}

/// Asserts that static echoes determine the echo strength, and its deviation from constant.
#[test]
fn levels_and_jitter_of_static_echoes_are_recovered() {
    let folder = tempfile::tempdir().expect("a folder");
    let recording = corridor(folder.path(), 3, 130);
    let (scene, base) = (fixture("scenes/corridor.toml"), fixture("receivers/typical.toml"));
    let calibrate =
        command!("scene calibrate --json --people 0 --copies 1", recording, "--scene", scene, "--base", base);
    let lines = json_lines(calibrate);
    let (gain, clutter) = (&lines[0]["gain"], &lines[0]["clutter"]);
    assert!(number(&gain["bins"]) >= 20.0, "{gain}");
    assert!((number(&gain["gain_db"]) - 5.0).abs() < 3.0 * number(&gain["error_db"]), "{gain}");
    // The simulated values are 30 mrad, 0.3 rad in ten seconds, and 1 %.
    assert!((0.02..0.045).contains(&number(&clutter["phase_jitter_rad"])), "{clutter}");
    assert!((0.1..0.6).contains(&number(&clutter["phase_drift_rad_per_10s"])), "{clutter}");
    assert!((0.006..0.02).contains(&number(&clutter["amplitude_jitter"])), "{clutter}");
}

#[test]
fn several_recordings_are_fitted_together_and_resampled() {
    let folder = tempfile::tempdir().expect("a folder");
    let recordings = [1, 2, 3].map(|seed| corridor(folder.path(), seed, 40));
    let file = folder.path().join("receiver.toml");
    let lines = json_lines(command!("scene calibrate --json", ..&recordings, "--copies 1 -o", &file));
    let answer = &lines[0];
    assert_eq!((&answer["frames_fitted"], &answer["frames_judged"]), (&Value::from(60), &Value::from(60)));
    assert_eq!(answer["resampled"], "recordings");
    for channel in answer["after"].as_array().expect("channels") {
        assert!(number(&channel["noise_worst_db"]) < 1.0, "{channel}");
    }
    let text = std::fs::read_to_string(&file).expect("readable");
    assert!(text.contains("corridor-1: 20 of 40 frames; corridor-2: 20 of 40 frames"), "{text}");
    // All recordings must have the same waveform.
    let Some(other) = shared("data/recordings/breathing-person-20260106") else { return };
    fails_with(command!("scene calibrate", ..&recordings, other), &["another waveform", "hint:"]);
}

#[test]
fn recordings_are_evaluated_by_their_labels() {
    let Some(recording) = shared("data/recordings/breathing-person-20260106") else { return };
    let model = fixture("models/desk-hqnn.safetensors");
    let labelled = |label: &str| format!("{}={label}", recording.display());
    let lines = json_lines(command!("model evaluate --json --model", &model, labelled("one")));
    let (answer, judged) = (&lines[0], &lines[0]["recordings"][0]);
    assert_eq!(judged["label"], "one");
    let frames = number(&judged["frames"]);
    let row: f64 = answer["confusion"][1].as_array().expect("a row").iter().map(number).sum();
    assert_eq!((frames, row), (129.0, 129.0));
    assert!((number(&judged["share"]) * frames).fract() < 1e-6, "{judged}");
    // No recording may be named twice, so the one without labels stands alone.
    let alone = recording.display().to_string();
    for (inputs, expected) in [(vec![alone], "no label"), (vec!["nowhere=one".to_owned(), labelled("one")], "nowhere")]
    {
        fails_with(command!("model evaluate --model", &model, ..&inputs), &[expected]);
    }
    let inputs = [labelled("three"), labelled("one")];
    wrong_use_with(command!("model evaluate --model", &model, ..&inputs), &["three is not empty, one or two"]);
    let other = fixture("models/paper-hqnn.safetensors");
    fails_with(command!("model evaluate --model", other, labelled("one")), &["256 samples", "64 samples"]);
}

/// A name with a line's end broke the comment at the head of the file.
#[test]
fn a_receiver_of_any_name_can_be_read() {
    let folder = tempfile::tempdir().expect("a folder");
    let recording = corridor(folder.path(), 3, 40);
    let file = folder.path().join("my receiver.toml");
    let mut command = subcommand("scene calibrate --copies 1 --json");
    json_lines(command.arg(&recording).args(["--name", "a\"b\nc"]).arg("-o").arg(&file));
    let text = std::fs::read_to_string(&file).expect("written");
    let made =
        "#     radome scene calibrate corridor-3.mcap --name 'a\"b?c' --copies 1 --part 0.5 -o 'my receiver.toml'\n";
    assert!(text.contains(made), "{text}");
    assert_eq!(radome_sim::load_receiver(&file).expect("a receiver").name, "a\"b\nc");
    wrong_use_with(command!("scene calibrate", &recording, "--people 2"), &["--people needs --scene"]);
    fails_with(command!("scene calibrate", &recording, "--part 0.99"), &["hint: choose a --part nearer to 0.5"]);
    let hall = fixture("scenes/desk.toml");
    let other = failure(command!("scene calibrate", &recording, "--scene", hall));
    assert!(other.contains("desk.toml") && other.contains("hint: ") && !other.contains("model"), "{other}");
}

/// Regression test: the frames of a recording that was named twice, or by a link, counted twice, and the difference between real
/// recordings was none.
#[test]
fn a_recording_that_is_named_twice_is_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let recording = corridor(folder.path(), 3, 40);
    let link = folder.path().join("link.mcap");
    std::os::unix::fs::symlink(&recording, &link).expect("a link");
    for other in [&recording, &link] {
        fails_with(command!("scene calibrate", &recording, other), &["is named twice", "hint: "]);
    }
}

#[test]
fn what_cannot_be_calibrated_is_refused() {
    fails_with(subcommand("scene calibrate nowhere.mcap"), &["nowhere.mcap"]);
    let Some(recording) = shared("data/recordings/breathing-person-20260106") else { return };
    fails_with(command!("scene calibrate", &recording, "--part 0.02"), &["to judge by", "hint:"]);
    let corridor = fixture("scenes/corridor.toml");
    fails_with(command!("scene calibrate", &recording, "--scene", corridor), &["waveform"]);
}
