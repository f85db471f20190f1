//! Tests of the built-in model on difficult recordings: few and many chirps, too narrow a band, dead and saturated
//! receivers, and people present from the first frame on. All frames are simulated, in rooms like those of the
//! training, with other seeds.

use std::path::{Path, PathBuf};

use radome_driver::recording::{Format, Recording, RecordingWriter};
use radome_dsp::{Frame, FrameSource, MAX_CODE, SourceEvent};
use radome_tests::{
    command, fails_with, failure, fixture, fixture_text, json_lines, outcome, simulate, success, write_file,
    wrong_use_with,
};
use serde_json::Value;

/// Writes the scene `fixtures/scenes/rooms.toml` with other values for these keys of the waveform.
fn write_rooms(folder: &Path, waveform: &[(&str, &str)]) -> PathBuf {
    let mut text = fixture_text("scenes/rooms.toml");
    for (key, value) in waveform {
        let is_key = |line: &str| line.split_once(" = ").is_some_and(|(name, _)| name == *key);
        assert_eq!(text.lines().filter(|line| is_key(line)).count(), 1, "{key}");
        let lines = text.lines().map(|line| if is_key(line) { format!("{key} = {value}") } else { line.to_owned() });
        text = lines.collect::<Vec<_>>().join("\n");
    }
    write_file(folder, "scene.toml", text)
}

/// Simulates a recording of a scene.
fn simulate_recording(scene: &Path, people: usize, seed: u64, frames: usize) -> PathBuf {
    let path = scene.with_file_name(format!("people{people}-seed{seed}.mcap"));
    simulate(scene, &format!("--people {people} --seed {seed} --frames {frames}"), &path);
    path
}

/// Copies a recording without its first frames; `change` edits the others, numbered from 0.
fn copy_changed(from: &Path, name: &str, skipped: usize, mut change: impl FnMut(usize, &mut Frame)) -> PathBuf {
    let to = from.with_file_name(name);
    let mut source = Recording::open(from).expect("opens");
    let mut writer = RecordingWriter::create(&to, Format::Mcap, &source.header()).expect("creates");
    let mut frame = Frame::zeroed(source.waveform().shape());
    let mut index = 0;
    while source.next_frame(&mut frame).expect("reads") == SourceEvent::Frame {
        if index >= skipped {
            change(index - skipped, &mut frame);
            writer.frame(&frame).expect("writes");
        }
        index += 1;
    }
    writer.finish().expect("finishes");
    to
}

/// Answers of the built-in model, one a frame, and the program's stderr.
fn classify(recording: &Path) -> (Vec<Value>, String) {
    let (text, said) = success(command!("live --json", recording));
    let lines = text.lines().map(|line| serde_json::from_str::<Value>(line).expect("JSON"));
    // The last line is a summary.
    let answers: Vec<Value> = lines.filter(|line| line.get("sequence").is_some()).collect();
    for answer in answers.iter().filter(|answer| !answer["label"].is_null()) {
        let sum: f64 = ["empty", "one", "two"].map(|class| probability(answer, class)).iter().sum();
        assert!((sum - 1.0).abs() < 1e-3, "{answer}");
    }
    (answers, said)
}

/// Probability of a class, asserted to be finite: NaN and infinity are null in JSON.
fn probability(answer: &Value, class: &str) -> f64 {
    answer["probabilities"][class].as_f64().unwrap_or_else(|| panic!("no finite probability of {class}: {answer}"))
}

/// Number of frames with this truth in which nobody enters or leaves, and number of those with the label.
fn count_labelled(answers: &[Value], truth: &str, label: &str) -> (usize, usize) {
    let of = answers.iter().filter(|answer| answer["truth"] == truth && answer["transition"] == false);
    let labels: Vec<&Value> = of.map(|answer| &answer["label"]).collect();
    (labels.len(), labels.iter().filter(|given| ***given == label).count())
}

/// Asserts that nearly all frames with this truth have its label, and that there are at least `at_least` such frames.
fn assert_mostly_right(answers: &[Value], truth: &str, at_least: usize) {
    let (frames, right) = count_labelled(answers, truth, truth);
    assert!(frames >= at_least, "{frames} frames are {truth}");
    assert!(10 * right >= 9 * frames, "{right} of {frames} frames are called {truth}");
}

/// Judges simulations of a scene without people and with one person, of this many frames each. Asserts that all frames
/// of the empty room are right. With the person, all frames must have a label and most the right one; the person must
/// be present in half of them. Returns the program's stderr for the empty room.
fn assert_empty_and_one_are_recognised(scene: &Path, frames: usize) -> String {
    let (empty, said) = classify(&simulate_recording(scene, 0, 731_012, frames));
    assert!(empty.iter().all(|answer| answer["label"] == "empty") && empty.len() == frames, "{empty:?}");
    let (one, _) = classify(&simulate_recording(scene, 1, 731_012, frames));
    assert_eq!(one.iter().filter(|answer| !answer["label"].is_null()).count(), frames);
    assert_mostly_right(&one, "one", frames / 2);
    said
}

const FEW_CHIRPS: [(&str, &str); 3] =
    [("chirps_per_frame", "8"), ("samples_per_chirp", "64"), ("chirp_interval_s", "591.125e-6")];

#[test]
fn frames_of_eight_chirps_are_classified_and_the_loss_is_reported() {
    let folder = tempfile::tempdir().expect("a folder");
    let said = assert_empty_and_one_are_recognised(&write_rooms(folder.path(), &FEW_CHIRPS), 80);
    assert!(said.contains("velocity resolution is 0.52 m/s") && said.contains("counted as one"), "{said}");
}

#[test]
fn frames_of_512_chirps_are_classified() {
    let folder = tempfile::tempdir().expect("a folder");
    let many = [("chirps_per_frame", "512"), ("samples_per_chirp", "64"), ("chirp_interval_s", "150e-6")];
    assert_empty_and_one_are_recognised(&write_rooms(folder.path(), &many), 40);
}

/// With half a gigahertz, the echo of one person covers as many bins of the model's range axis as those of two with the
/// model's own waveform.
#[test]
fn one_person_is_one_with_coarse_ranges() {
    let folder = tempfile::tempdir().expect("a folder");
    let coarse = [("end_frequency_hz", "61.0e9"), ("samples_per_chirp", "64")];
    let scene = write_rooms(folder.path(), &coarse);
    let (mut frames, mut right) = (0, 0);
    for seed in [731_013, 731_014, 731_015, 731_016] {
        let (answers, _) = classify(&simulate_recording(&scene, 1, seed, 120));
        let (of_seed, right_ones) = count_labelled(&answers, "one", "one");
        (frames, right) = (frames + of_seed, right + right_ones);
    }
    assert!(frames >= 300 && 10 * right >= 9 * frames, "{right} of {frames}");
}

#[test]
fn a_band_below_the_limit_is_refused_with_the_limit() {
    let folder = tempfile::tempdir().expect("a folder");
    let scene = write_rooms(folder.path(), &[("end_frequency_hz", "60.75e9")]);
    let recording = simulate_recording(&scene, 0, 731_012, 2);
    let said = failure(command!("live --json", &recording));
    assert!(said.contains("sampled band is 0.238 GHz") && said.contains("0.300 GHz or more"), "{said}");
    assert!(said.contains("hint: capture with a waveform within this limit"), "{said}");
    fails_with(command!("model evaluate room-hqnn", &recording), &["sampled band is 0.238 GHz", "hint:"]);
}

/// Codes of the receiver with this index.
fn receiver_codes(frame: &mut Frame, rx: usize) -> &mut [u16] {
    let length = frame.shape.chirps * frame.shape.samples;
    &mut frame.codes[rx * length..(rx + 1) * length]
}

/// Function that gives a sample by its index.
type Sample = fn(usize) -> u16;

/// Sample patterns that a dead receiver may send, each with the name of its recording.
const DEAD: [(&str, Sample); 3] = [
    ("middle.mcap", |_| 2048),
    ("zero.mcap", |_| 0),
    ("rails.mcap", |index| if index.is_multiple_of(2) { 0 } else { MAX_CODE }),
];

#[test]
fn another_receiver_replaces_a_dead_one() {
    let folder = tempfile::tempdir().expect("a folder");
    let three = [
        ("chirps_per_frame", "16"),
        ("samples_per_chirp", "64"),
        ("chirp_interval_s", "591.125e-6"),
        ("rx_antennas", "[1, 2, 3]"),
    ];
    let whole = simulate_recording(&write_rooms(folder.path(), &three), 1, 731_012, 60);
    let labels = |answers: &[Value]| -> Vec<(Value, Value)> {
        answers.iter().map(|answer| (answer["label"].clone(), answer["frame_probabilities"].clone())).collect()
    };
    let (first, said) = classify(&whole);
    assert!(!said.contains("receiver 1 of 3"), "{said}");
    // Reference: the second receiver alone, copied over the first one.
    let second = copy_changed(&whole, "second.mcap", 0, |_, frame| {
        let codes = receiver_codes(frame, 1).to_vec();
        receiver_codes(frame, 0).copy_from_slice(&codes);
    });
    let (second, _) = classify(&second);
    assert_mostly_right(&second, "one", 30);
    assert_ne!(labels(&first), labels(&second));
    for (name, code) in DEAD {
        for (rx, expected) in [(0, &second), (1, &first)] {
            let dead = copy_changed(&whole, name, 0, |_, frame| {
                receiver_codes(frame, rx).iter_mut().enumerate().for_each(|(index, value)| *value = code(index));
            });
            let (answers, said) = classify(&dead);
            assert_eq!(labels(&answers), labels(expected), "{name}, receiver {rx}");
            assert!(said.contains(&format!("warning: receiver {} of 3", rx + 1)) && said.contains("hint:"), "{said}");
            std::fs::remove_file(dead).expect("removable");
        }
    }
}

/// Regression test: with one of its receivers dead, a model of one waveform saw two people in every frame, and nobody was told.
#[test]
fn a_model_that_needs_a_dead_receiver_gives_no_answer() {
    let folder = tempfile::tempdir().expect("a folder");
    let whole = folder.path().join("whole.mcap");
    simulate(&fixture("scenes/corridor.toml"), "--people 0 --seed 5 --frames 12", &whole);
    let model = fixture("models/paper-hqnn.safetensors");
    let classify = |path: &Path| json_lines(command!("live --json", path, "--model", &model));
    let is_dead = |path: &Path| {
        let mut answers = classify(path);
        answers.retain(|answer| answer["sequence"].is_number());
        assert_eq!(answers.len(), 12);
        answers.iter().all(|answer| answer["no_signal"] == true && answer["label"].is_null())
    };
    assert!(!is_dead(&whole));
    let doctor = |path: &Path| success(command!("doctor", path)).0;
    assert!(!doctor(&whole).contains("gives no signal") && !doctor(&whole).contains("no receiver"));
    for rx in 0..3 {
        let dead = copy_changed(&whole, &format!("dead-{rx}.mcap"), 0, |_, frame| receiver_codes(frame, rx).fill(2048));
        assert!(is_dead(&dead), "receiver {rx}");
        let said = doctor(&dead);
        assert!(said.contains(&format!("receiver {} of 3 gives no signal", rx + 1)), "{said}");
    }
    let all = copy_changed(&whole, "all.mcap", 0, |_, frame| frame.codes.fill(2048));
    let (status, said, _) = outcome(command!("doctor", &all));
    assert!(status == Some(1) && said.contains("no receiver gives a signal"), "{status:?} {said}");
}

#[test]
fn frames_without_a_signal_get_no_answer_and_change_none() {
    let folder = tempfile::tempdir().expect("a folder");
    let whole = simulate_recording(&write_rooms(folder.path(), &FEW_CHIRPS), 1, 731_012, 60);
    // The receiver dies while a person has been present for some time.
    for (name, code) in DEAD {
        let dead = copy_changed(&whole, name, 0, |index, frame| {
            if index >= 50 {
                frame.codes.iter_mut().enumerate().for_each(|(index, value)| *value = code(index));
            }
        });
        let (answers, said) = classify(&dead);
        assert_eq!(answers.len(), 60);
        let (before, after) = answers.split_at(50);
        assert!(before.iter().all(|answer| answer["label"].is_string() && answer["no_signal"].is_null()), "{name}");
        assert_eq!(before[49]["people"], 1, "{name}: {}", before[49]);
        for answer in after {
            assert!(answer["label"].is_null() && answer["probabilities"].is_null(), "{name}: {answer}");
            assert_eq!((&answer["no_signal"], &answer["people"]), (&true.into(), &1.into()), "{name}: {answer}");
        }
        assert!(said.contains("warning: receiver 1 of 1") && said.contains("get no answer"), "{said}");
        // Frames without an answer are in no score, and are counted.
        let labelled = format!("{}=one", dead.display());
        let scores = json_lines(command!("model evaluate room-hqnn --json", &labelled)).remove(0);
        let recording = &scores["recordings"][0];
        let counts = [&recording["frames"], &recording["unanswered"], &scores["unanswered"]].map(Value::as_u64);
        assert_eq!(counts, [Some(50), Some(10), Some(10)], "{name}: {scores}");
        let (told, _) = success(command!("model evaluate room-hqnn", &labelled));
        assert!(told.contains("    10 of 60 labelled frames have no answer"), "{name}: {told}");
        let labels = write_file(folder.path(), "labels.txt", "5.0\t5.9\tone\n");
        let labelled = format!("{}={}", dead.display(), labels.display());
        fails_with(command!("model evaluate room-hqnn", labelled), &["no answer to any of its 9 labelled frames"]);
        // A recording with dead frames only is refused, without other messages.
        let nothing = copy_changed(&dead, "nothing.mcap", 50, |_, _| ());
        let said = failure(command!("model evaluate room-hqnn", format!("{}=one", nothing.display())));
        assert!(said.contains("no frame of it can be judged") && said.contains("no signal"), "{name}: {said}");
        std::fs::remove_file(nothing).expect("removable");
    }
}

/// Asserts that frames with too much gain are judged and reported: a tenth of the samples lie at the ends of the ADC.
#[test]
fn clipped_frames_are_classified_and_reported_as_clipped() {
    let folder = tempfile::tempdir().expect("a folder");
    let scene = write_rooms(folder.path(), &[]);
    let clip = |path: &Path, name: &str| {
        copy_changed(path, name, 0, |_, frame| {
            for code in &mut frame.codes {
                *code = ((f64::from(*code) - 1250.0) * 4.0 + 2048.0).round().clamp(0.0, f64::from(MAX_CODE)) as u16;
            }
        })
    };
    let (empty, said) = classify(&clip(&simulate_recording(&scene, 0, 731_012, 60), "empty.mcap"));
    assert!(empty.iter().all(|answer| answer["label"] == "empty") && empty.len() == 60, "{empty:?}");
    let saturated = empty.iter().filter_map(|answer| answer["saturated_samples"].as_u64());
    assert!(saturated.sum::<u64>() > 60 * 128 * 64 / 100, "{}", empty[0]);
    assert!(
        said.contains("warning: receiver 1 of 1") && said.contains("distorts") && said.contains("if_gain_db"),
        "{said}"
    );
    let (one, _) = classify(&clip(&simulate_recording(&scene, 1, 731_012, 60), "one.mcap"));
    assert_mostly_right(&one, "one", 40);
}

/// Asserts that bursts of saturated frames, in any order, cause no false alarm; nearly all of their samples lie at the
/// ends of the ADC.
#[test]
fn bursts_of_saturated_frames_do_not_populate_an_empty_room() {
    let folder = tempfile::tempdir().expect("a folder");
    let empty = simulate_recording(&write_rooms(folder.path(), &[]), 0, 731_012, 60);
    let bursts = copy_changed(&empty, "bursts.mcap", 0, |index, frame| {
        if index % 10 < 5 {
            let mut state = index as u32 + 1;
            for code in &mut frame.codes {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                *code = if state >> 31 == 0 { 0 } else { MAX_CODE };
            }
        }
    });
    let (answers, _) = classify(&bursts);
    assert_eq!(answers.len(), 60);
    for (index, answer) in answers.iter().enumerate() {
        let expected = if index % 10 < 5 { Value::Null } else { "empty".into() };
        assert_eq!((&answer["label"], &answer["occupied"]), (&expected, &false.into()), "{answer}");
    }
}

#[test]
fn people_who_are_there_from_the_first_frame_are_found_within_a_second() {
    let folder = tempfile::tempdir().expect("a folder");
    let scene = write_rooms(folder.path(), &[]);
    for (people, seed, label) in [(1, 731_011, "one"), (1, 731_014, "one"), (2, 731_012, "two"), (2, 731_014, "two")] {
        let whole = simulate_recording(&scene, people, seed, 100);
        let begins = copy_changed(&whole, "begins.mcap", 45, |_, _| ());
        let (answers, _) = classify(&begins);
        assert_eq!(answers.len(), 55);
        assert!(answers.iter().all(|answer| answer["truth"] == label), "seed {seed}: {}", answers[0]);
        let (frames, right) = count_labelled(&answers[10..], label, label);
        assert!(10 * right >= 9 * frames && frames >= 30, "seed {seed}: {right} of {frames}");
        std::fs::remove_file(begins).expect("removable");
    }
}

#[test]
fn false_alarms_an_hour_are_reported_by_rung_and_of_recordings() {
    let folder = tempfile::tempdir().expect("a folder");
    let scene = write_rooms(folder.path(), &[]);
    let text = "format = 1\nname = \"rooms\"\nabout = \"Few frames.\"\n[[scene]]\npath = \"scene.toml\"\n\
                seeds = [731010, 731011]\npeople = 2\nframes = 5\n";
    let rung = write_file(folder.path(), "rung.toml", text);
    let ladder =
        |hours: &str| command!("model evaluate --model room-hqnn --json --empty-hours", hours, "--ladder", &rung);
    let answer = json_lines(ladder("0.005")).remove(0);
    let row = &answer["models"][0]["rungs"][0];
    assert!(row["empty_s"].as_f64().is_some_and(|seconds| (17.9..18.3).contains(&seconds)), "{row}");
    assert_eq!((&row["recordings"][0]["label"], &row["recordings_judged"]), (&"empty".into(), &1.into()), "{row}");
    assert_eq!(row["recordings"][0]["recording"], "rooms-scene-seed731012-empty");
    assert_eq!((&row["false_alarms"], &row["false_alarm_share"]), (&0.into(), &0.0.into()), "{row}");
    assert_eq!(row["false_alarms_per_hour"], 0.0, "{row}");
    wrong_use_with(ladder("1e6"), &["--empty-hours", "hint:"]);

    // A person walks through a room that is labelled empty.
    let walked = simulate_recording(&scene, 1, 731_012, 60);
    let empty = format!("{}=empty", walked.display());
    let answer = json_lines(command!("model evaluate --json room-hqnn", &empty)).remove(0);
    assert!(answer["empty_s"].as_f64().is_some_and(|seconds| (5.9..6.1).contains(&seconds)), "{answer}");
    assert!(answer["false_alarms"].as_u64().is_some_and(|alarms| alarms > 0), "{answer}");
    assert!(answer["false_alarms_per_hour"].as_f64().is_some_and(|rate| rate > 500.0), "{answer}");
    assert!(answer["false_alarm_share"].as_f64().is_some_and(|share| (0.5..1.0).contains(&share)), "{answer}");
    let (table, _) = success(command!("model evaluate room-hqnn", &empty));
    assert!(table.contains("false alarms") && table.contains("an hour"), "{table}");
}
