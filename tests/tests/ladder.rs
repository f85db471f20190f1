//! Tests of `radome model evaluate` on recordings whose labels change, on recordings that a model refuses, and on a
//! ladder of simulated recordings.

use std::path::{Path, PathBuf};

use radome_tests::{
    command, fails_with, fixture, json_lines, json_lines_of, model_of_one_waveform, simulate, success, write_file,
    wrong_use_with,
};
use serde_json::Value;

fn evaluate_command(model: &str) -> std::process::Command {
    let model = if model == "cfar" { PathBuf::from(model) } else { fixture(&format!("models/{model}.safetensors")) };
    command!("model evaluate --json --model", model)
}

fn as_count(value: &Value) -> u64 {
    value.as_u64().unwrap_or_else(|| panic!("{value} is no whole number"))
}

fn sum_of_counts(confusion: &Value) -> u64 {
    confusion.as_array().expect("rows").iter().flat_map(|row| row.as_array().expect("a row")).map(as_count).sum()
}

/// Asserts that labelled spans, from a file or from the recording, select the frames that are judged.
#[test]
fn frames_are_scored_by_the_span_that_contains_them() {
    let folder = tempfile::tempdir().expect("a folder");
    let recording = folder.path().join("walk.mcap");
    simulate(&fixture("scenes/hall.toml"), "--seed 700101 --people 1 --frames 60", &recording);

    // Without spans the simulator's truth counts, except for frames in which a person enters.
    let truth = json_lines(evaluate_command("cfar").arg(&recording)).remove(0);
    assert!((1..=60).contains(&as_count(&truth["recordings"][0]["frames"])), "{truth}");

    let track = write_file(folder.path(), "track.txt", "0\t2\tempty\n2\t4\tone\n4\t5\tsomebody coughs\n");
    let given = format!("{}={}", recording.display(), track.display());
    let by_file = json_lines(evaluate_command("cfar").arg(&given)).remove(0);
    let judged = &by_file["recordings"][0];
    assert_eq!((judged["label"].as_str(), as_count(&judged["frames"])), (Some("mixed"), 40), "{by_file}");
    assert!(["empty", "one", "two"].iter().any(|class| judged["majority"] == *class), "{by_file}");
    for (index, label) in ["empty", "one"].into_iter().enumerate() {
        let (of, stretch) = (&judged["by_label"][index], &judged["stretches"][index]);
        assert_eq!((&of["label"], as_count(&of["frames"])), (&Value::from(label), 20), "{by_file}");
        let called: u64 = of["called"].as_array().expect("three counts").iter().map(as_count).sum();
        assert_eq!(called, 20, "{by_file}");
        assert_eq!(stretch["label"], label);
        assert!((stretch["start_s"].as_f64().expect("a time") - 2.0 * index as f64).abs() < 1e-6, "{by_file}");
        let found = stretch["found_within_s"].as_f64();
        assert!(found.is_none_or(|seconds| (0.0..2.0).contains(&seconds)), "{by_file}");
        assert_eq!(found.is_none(), of["right"].as_f64() == Some(0.0), "{by_file}");
    }
    assert_eq!(
        (sum_of_counts(&by_file["confusion"]), as_count(&by_file["reliability"]["frames"])),
        (40, 40),
        "{by_file}"
    );
    for key in ["balanced_accuracy", "balanced_accuracy_by_single_frames"] {
        assert!(by_file[key].is_f64(), "{key}: {by_file}");
    }

    json_lines(command!("recording labels --json", &recording, "--import", &track));
    let held = json_lines(evaluate_command("cfar").arg(&recording)).remove(0);
    assert_eq!(held, by_file);
}

/// Asserts that the other recordings are judged, and that the exit status reports the refused one.
#[test]
fn a_refused_recording_is_listed_and_the_others_are_evaluated() {
    let folder = tempfile::tempdir().expect("a folder");
    let (hall, desk) = (folder.path().join("hall.mcap"), folder.path().join("desk.mcap"));
    // Range bins of 15 cm do not suffice for a model with bins of 3 cm.
    simulate(&fixture("scenes/hall.toml"), "--seed 700101 --people 1 --frames 5", &hall);
    simulate(&fixture("scenes/desk.toml"), "--seed 700101 --people 1 --frames 135", &desk);
    let inputs = [&hall, &desk].map(|path| format!("{}=one", path.display()));
    let answer = json_lines_of(evaluate_command("desk-hqnn").args(&inputs), &[1]).remove(0);
    let (judged, refused) = (&answer["recordings"], &answer["refused"]);
    assert_eq!((judged.as_array().map(Vec::len), refused.as_array().map(Vec::len)), (Some(1), Some(1)), "{answer}");
    assert_eq!((&judged[0]["label"], &judged[0]["path"]), (&"one".into(), &desk.display().to_string().into()));
    assert!(refused[0]["recording"].as_str().is_some_and(|name| name.ends_with("hall.mcap")), "{answer}");
    assert!(refused[0]["reason"].as_str().is_some_and(|reason| !reason.contains("hint")), "{answer}");
    assert_eq!(json_lines(evaluate_command("desk-hqnn").args(&inputs).arg("--skip-refused")), [answer]);
    fails_with(evaluate_command("desk-hqnn").args(&inputs), &["1 of 2 recordings were refused", "--skip-refused"]);
    // If no recording was judged, the command fails in any case.
    fails_with(evaluate_command("desk-hqnn").arg(&inputs[0]).arg("--skip-refused"), &["hall.mcap"]);
}

fn write_rung(folder: &Path) -> PathBuf {
    let path = folder.join("rung.toml");
    let scene = |name: &str, seeds: &str, more: &str| {
        let path = fixture(&format!("scenes/{name}.toml"));
        format!("[[scene]]\npath = \"{}\"\nseeds = {seeds}\n{more}\n", path.display())
    };
    let text = format!(
        "format = 1\nname = \"small\"\nabout = \"Few frames.\"\n{}{}{}",
        scene("hall", "[700001, 700002]", "people = 0\nframes = 12"),
        scene("hall", "[700003, 700003]", "people = 2\nframes = 30"),
        scene("desk", "[700004, 700004]", "people = 1\nframes = 5"),
    );
    std::fs::write(&path, text).expect("writable");
    path
}

/// Asserts that each frame is simulated once and judged by both models, and that kept recordings give the same answer.
#[test]
fn models_are_compared_on_the_same_frames() {
    let folder = tempfile::tempdir().expect("a folder");
    let rung = write_rung(folder.path());
    let keep = folder.path().join("kept");
    let model = model_of_one_waveform(folder.path());
    let ladder = || command!("model evaluate --json --model", &model, "--model cfar --ladder", &rung);
    let answer = json_lines(ladder()).remove(0);
    let told = &answer["ladder"][0];
    assert_eq!((&told["rung"], &told["about"]), (&"small".into(), &"Few frames.".into()), "{answer}");
    assert_eq!((as_count(&told["recordings"]), as_count(&told["frames"])), (4, 59), "{answer}");
    let models = answer["models"].as_array().expect("models");
    assert!(models[0]["model"].as_str().is_some_and(|name| name.ends_with("one-waveform.safetensors")), "{answer}");
    assert_eq!(models[1]["model"], "cfar");
    for (model, refused) in models.iter().zip([1, 0]) {
        let row = &model["rungs"][0];
        assert_eq!(row["refused"].as_array().map(Vec::len), Some(refused), "{row}");
        assert_eq!(as_count(&row["recordings_judged"]) as usize, 4 - refused, "{row}");
        assert_eq!(row["recordings"].as_array().map(Vec::len), Some(4 - refused), "{row}");
        // The truth of two people leaves out the frames in which a person enters.
        let frames = sum_of_counts(&row["confusion"]);
        assert!((24..=59).contains(&frames) && frames == as_count(&row["reliability"]["frames"]), "{row}");
        assert_eq!(row["reliability"]["bins"].as_array().map(Vec::len), Some(10), "{row}");
        for key in ["balanced_accuracy", "balanced_accuracy_by_single_frames"] {
            assert!(row[key].as_f64().is_some_and(|score| (0.0..=1.0).contains(&score)), "{row}");
            assert_eq!(model["all"][key], row[key]);
        }
        assert!(row["empty_s"].as_f64().is_some_and(|seconds| seconds > 2.3), "{row}");
        assert!(row["false_alarms_per_hour"].is_f64() && row["second_person_found"]["stretches"].is_u64(), "{row}");
    }

    let kept = || json_lines(ladder().arg("--keep").arg(&keep)).remove(0);
    assert_eq!(kept(), answer);
    let files = || {
        let entries = std::fs::read_dir(&keep).expect("a folder").map(|entry| entry.expect("an entry"));
        let time = |entry: std::fs::DirEntry| {
            (entry.file_name(), entry.metadata().expect("metadata").modified().expect("a time"))
        };
        let mut all: Vec<_> = entries.map(time).collect();
        all.sort();
        all
    };
    let first = files();
    assert_eq!(first.len(), 4, "{first:?}");
    assert_eq!(kept(), answer);
    assert_eq!(files(), first, "kept recordings were made anew");

    // Fits one set of filter settings to all judged recordings of both models.
    assert!(answer["fitted_smoothing"].is_null(), "{answer}");
    let fitted = json_lines(ladder().arg("--keep").arg(&keep).arg("--fit-smoothing")).remove(0);
    let fit = &fitted["fitted_smoothing"];
    for key in ["dwell_s", "independent_s", "temperature"] {
        assert!(fit["smoothing"][key].as_f64().is_some_and(|value| value > 0.0), "{key}: {fit}");
    }
    assert!(fit["log_loss"].is_f64() && fit["log_loss_by_frame"].is_f64(), "{fit}");
    assert_eq!(fitted["models"], answer["models"]);

    // Prints the same result as a table.
    let (table, _) = success(command!("model evaluate", model, "cfar --ladder", &rung));
    assert!(table.contains("small") && table.contains("1 refused"), "{table}");
}

mod hard_cases {
    use super::*;

    #[test]
    fn contradictory_and_unreadable_labels_are_refused() {
        let folder = tempfile::tempdir().expect("a folder");
        let recording = folder.path().join("empty.mcap");
        simulate(&fixture("scenes/hall.toml"), "--seed 700101 --people 0 --frames 3", &recording);
        let given = |name: &str| format!("{}={}", recording.display(), folder.path().join(name).display());
        for (name, text, expected) in [
            ("both.txt", "0\t0.2\tempty\n0.1\t0.3\tone\n", "overlap"),
            ("free.txt", "0\t0.2\tsomebody coughs\n", "no label"),
            ("broken.txt", "0\tempty\n", "line 1"),
        ] {
            std::fs::write(folder.path().join(name), text).expect("writable");
            fails_with(evaluate_command("cfar").arg(given(name)), &[expected]);
        }
        wrong_use_with(evaluate_command("cfar").arg(given("absent.txt")), &["no file of labels"]);
    }

    #[test]
    fn what_cannot_be_compared_is_refused() {
        wrong_use_with(evaluate_command("cfar").args(["--model", "cfar", "x.mcap=one"]), &["2 models", "--ladder"]);
        fails_with(command!("model evaluate --ladder", fixture("ladder")), &["no model"]);
        fails_with(evaluate_command("cfar").args(["--ladder", "nowhere"]), &["nowhere"]);
    }
}
