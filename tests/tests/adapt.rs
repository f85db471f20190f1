//! Tests of adapting a model to a room with swaying objects, absent from its training: by labelled recordings, or by
//! the empty room alone.

use std::f64::consts::TAU;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

use radome_driver::recording::{Format, Recording, RecordingWriter};
use radome_models::ModelCard;
use radome_tests::{
    add_signal, command, fails_with, failure, fixture, fixture_text, json_lines, outcome, simulate, subcommand,
    success, write_file, wrong_use_with,
};
use serde_json::Value;

const TRAINING: &str = "epochs = 25\nlearning_rate = 0.01\nstarts = 1\nreference = { over_noise = { skip_range_bins = 3 } }\n\
    smoothing = { dwell_s = 60.0, independent_s = 1.0, temperature = 1.0, newest = 0.0, one_share = 0.5 }\nsplit = { by = \"seed\" }\n\
    [augmentation]\ndoppler_flip = true\necho_gain_db = [-7.0, 7.0]\nrange_shift_bins = 6\n\
    [augmentation.sway]\nprobability = 0.7\nlevel_db = [0.0, 18.0]\nvelocity_bins = 3\nstretches = [1, 3]\n\
    stretch_bins = [4, 16]\n";

/// Folder with a small dataset of halls in `maps`, a model of it in `model.safetensors`, and recordings
/// `PEOPLE-SEED.mcap`. They show 30 s of a hall with swaying objects; `1-1.mcap` has a label.
fn adaptation_folder() -> &'static Path {
    static MADE: OnceLock<tempfile::TempDir> = OnceLock::new();
    let folder = MADE.get_or_init(|| {
        let folder = tempfile::tempdir().expect("a folder");
        let at = |name: &str| folder.path().join(name);
        let write = |name: &str, text: &str| std::fs::write(at(name), text).expect("writable");
        write("maps.toml", &fixture_text("datasets/quick.toml"));
        json_lines(command!("dataset build --json", at("maps.toml"), "-o", at("maps")));
        write("training.toml", TRAINING);
        let mut train = command!("model train --json --network descriptor_linear -o", at("model.safetensors"));
        json_lines(train.arg(at("maps")).arg("--spec").arg(at("training.toml")));
        let scene = fixture_text("scenes/hall.toml");
        let (hall, _) = scene.split_once("\n[random]").expect("a table");
        let receiver = "\"receiver.antenna.azimuth_beamwidth_deg\" = { between = [90.0, 90.0] }\n\
                        \"receiver.antenna.elevation_beamwidth_deg\" = { between = [90.0, 90.0] }\n\
                        \"receiver.gain_correction_db\" = { between = [4.0, 4.0] }\n";
        write("room.toml", &format!("{hall}\n\n[random]\n{receiver}"));
        for (people, seed) in (0..3).flat_map(|people| (1..4).map(move |seed| (people, seed))) {
            let options = format!("--people {people} --seed {seed} --frames 300");
            simulate(&at("room.toml"), &options, &at("still.mcap"));
            add_swaying_objects(
                &at("still.mcap"),
                &at(&format!("{people}-{seed}.mcap")),
                f64::from(10 * people + seed),
            );
        }
        json_lines(command!("recording label --json --span 0:30=one", at("1-1.mcap")));
        folder
    });
    folder.path()
}

/// Copies a recording without its truth, and adds three objects at 2.6 to 3.6 m. They sway by 2 cm about once a second,
/// with an amplitude of 8 codes.
fn add_swaying_objects(from: &Path, to: &Path, phase: f64) {
    add_signal(from, to, false, |waveform, time_s, in_chirp_s| {
        let slope = waveform.sampled_bandwidth_hz() * waveform.sample_rate_hz / waveform.shape().samples as f64;
        let start_hz = waveform.centre_frequency_hz() - 0.5 * waveform.sampled_bandwidth_hz();
        let echo = |thing: f64| {
            let turn = TAU * (0.7 + 0.1 * thing) * time_s + phase + thing;
            let delay_s = 2.0 * (2.6 + 0.5 * thing + 0.02 * turn.sin()) / 299_792_458.0;
            8.0 * (TAU * delay_s * (start_hz + slope * in_chirp_s)).cos()
        };
        echo(0.0) + echo(1.0) + echo(2.0)
    });
}

/// Command `radome model adapt` of the model with recordings such as `0-1=empty`.
fn adapt(recordings: &[&str]) -> Command {
    let recordings = recordings.iter().map(|recording| {
        let (name, label) =
            recording.split_once('=').map_or((*recording, String::new()), |(n, l)| (n, format!("={l}")));
        format!("{}{label}", adaptation_folder().join(format!("{name}.mcap")).display())
    });
    command!("model adapt --json", adaptation_folder().join("model.safetensors"), ..recordings)
}

const ROOM: [&str; 6] = ["0-1=empty", "0-2=empty", "1-1", "1-2=one", "2-1=two", "2-2=two"];

fn evaluate(model: &Path, args: &[&str], inputs: &[PathBuf]) -> Value {
    json_lines(command!("model evaluate --json", model, ..inputs, ..args)).remove(0)
}

fn score(answer: &Value) -> f64 {
    answer["balanced_accuracy"].as_f64().expect("a score")
}

#[test]
fn adaptation_improves_other_recordings_of_the_room_and_keeps_scores_in_halls() {
    let folder = tempfile::tempdir().expect("a folder");
    let model = adaptation_folder().join("model.safetensors");
    let run = |name: &str| {
        let output = folder.path().join(name);
        let answer =
            json_lines(adapt(&ROOM).arg("--simulated").arg(adaptation_folder().join("maps")).arg("-o").arg(&output))
                .remove(0);
        (answer, std::fs::read(&output).expect("written"))
    };
    let ((answer, bytes), (_, again)) = (run("a.safetensors"), run("b.safetensors"));
    assert!(bytes == again, "a second run gives other bytes");
    let adapted = folder.path().join("a.safetensors");
    let [before, after] = ["before", "after"].map(|when| {
        let by_frame = &answer["adapted"]["held_out"][when]["by_frame"];
        by_frame.as_f64().unwrap_or_else(|| panic!("{answer}"))
    });
    assert!(after > before + 0.05, "{answer}");
    assert_eq!(answer["not_measured"].as_array().map(Vec::len), Some(0), "{answer}");
    assert!(answer["recordings"][2]["held_out"]["after"]["filtered"].is_number(), "{answer}");
    let [seen, seen_before] =
        [&adapted, &model].map(|path| ModelCard::load(path).expect("a model").training.seen_sequences);
    // Of the simulated maps, those of the training split are mixed in, which the list has already.
    assert_eq!(seen.difference(&seen_before).count(), ROOM.len());
    assert!(seen.is_superset(&seen_before));
    let card = ModelCard::load(&adapted).expect("a model").adapted.expect("an entry");
    assert!(card.recordings == 6 && card.simulated_maps > 100, "{card:?}");
    assert!(card.seconds.iter().all(|seconds| (59.0..61.0).contains(seconds)), "{card:?}");
    assert!(!String::from_utf8_lossy(&bytes).contains(".mcap"), "the card names files");
    fails_with(adapt(&ROOM).arg("-o").arg(&adapted), &["exists already"]);

    let others = ["0-3.mcap=empty", "1-3.mcap=one", "2-3.mcap=two"].map(|name| adaptation_folder().join(name));
    let of_room = |model: &Path| score(&evaluate(model, &["--no-smoothing"], &others));
    let (before, after) = (of_room(&model), of_room(&adapted));
    assert!(after > before + 0.08, "other recordings of the room: {before}, then {after}");
    let of_halls = |model: &Path| score(&evaluate(model, &[], &[adaptation_folder().join("maps")]));
    let (before, after) = (of_halls(&model), of_halls(&adapted));
    assert!(after > before - 0.02, "halls: {before}, then {after}");

    // Recordings that the model was adapted to are evaluated, with a warning.
    let said_of = |recording: &Path| success(command!("model evaluate", &adapted, recording)).1;
    let said = said_of(&adaptation_folder().join("0-1.mcap=empty"));
    assert!(said.contains("warning: ") && said.contains("adapted to them") && said.contains("0-1.mcap"), "{said}");
    assert!(!said_of(&others[0]).contains("adapted to them"));
}

#[test]
fn the_empty_room_alone_lowers_false_alarms() {
    let folder = tempfile::tempdir().expect("a folder");
    let output = folder.path().join("a.safetensors");
    let mut command = adapt(&[]);
    command.arg("--empty").arg(adaptation_folder().join("0-1.mcap")).arg("-o").arg(&output);
    let answer = json_lines(&mut command).remove(0);
    // A single recording leaves none to hold out, and without people no misses can be measured.
    assert_eq!(answer["not_measured"].as_array().map(Vec::len), Some(3), "{answer}");
    assert!(answer["adapted"]["held_out"].is_null() && answer["file"].is_string(), "{answer}");
    let of = |model: &Path| score(&evaluate(model, &["--no-smoothing"], &[adaptation_folder().join("0-3.mcap=empty")]));
    let (before, after) = (of(&adaptation_folder().join("model.safetensors")), of(&output));
    assert!(after > before + 0.3, "frames of the empty room that are called empty: {before}, then {after}");
}

/// Asserts that the curve has a point for each labelled time, for the room itself and for the other room.
#[test]
fn a_curve_gives_accuracy_against_minutes_of_labels() {
    let folder = tempfile::tempdir().expect("a folder");
    let scene = fixture("scenes/hall.toml").canonicalize().expect("a scene");
    let room = |name: &str, seed: u64| format!("[[room]]\nname = \"{name}\"\nscene = {scene:?}\nseed = {seed}\n");
    let times = "format = 1\nminutes = [0.1, 0.2]\nrecording_s = 1.0\ntest_s = 2.0\n";
    let rooms = write_file(folder.path(), "rooms.toml", format!("{times}{}{}", room("a", 800_001), room("b", 800_002)));
    let curve = || command!("model adapt --json", adaptation_folder().join("model.safetensors"), "--curve", &rooms);
    let answer = json_lines(curve()).remove(0);
    let curves = answer["curves"].as_array().expect("curves");
    assert_eq!(curves.iter().map(|curve| &curve["room"]).collect::<Vec<_>>(), ["a", "b"], "{answer}");
    for curve in curves.iter().chain([&answer["mean"]]) {
        let labelled = curve["labelled"].as_array().expect("points");
        assert_eq!(labelled.len(), 2, "{answer}");
        for point in labelled.iter().chain([&curve["before"], &curve["empty"]]) {
            for on in ["room", "others"] {
                for score in ["by_frame", "filtered"] {
                    let score = point[on][score].as_f64().unwrap_or_else(|| panic!("{on} {score}: {answer}"));
                    assert!((0.0..=1.0).contains(&score), "{answer}");
                }
            }
        }
    }
    let again = json_lines(curve()).remove(0);
    assert_eq!(again, answer, "another run gives other scores");

    std::fs::write(&rooms, times).expect("writable");
    fails_with(curve(), &["rooms.toml"]);
    std::fs::write(&rooms, format!("{times}{}{}", room("a", 1), room("a", 2))).expect("writable");
    fails_with(curve(), &["two rooms are called a"]);
}

mod hard_cases {
    use super::*;

    /// Regression test: labels of the empty room and of one person made models call two people one person. The truth of recordings
    /// of two people, with one person for the few seconds between their arrivals, made them call one person two.
    #[test]
    fn a_class_without_labels_is_still_distinguished_from_its_neighbour() {
        let folder = tempfile::tempdir().expect("a folder");
        let recordings = |people: usize, seeds: [u64; 2]| {
            seeds.map(|seed| {
                let path = folder.path().join(format!("{people}-{seed}.mcap"));
                let options = format!("--people {people} --seed {seed} --frames 300");
                simulate(&fixture("scenes/rooms.toml"), &options, &path);
                path
            })
        };
        let labelled = [0, 1, 2].map(|people| recordings(people, [31, 32]));
        let others = [1, 2].map(|people| recordings(people, [41, 42]));
        let adapted = folder.path().join("adapted.safetensors");
        for model in ["room-hqnn", "room-linear"] {
            let model = fixture(&format!("models/{model}.safetensors"));
            let recall = |model: &Path, class: usize| {
                let answer = evaluate(model, &[], &others[class - 1]);
                let row = answer["confusion"][class].as_array().expect("a row");
                let counts: Vec<f64> = row.iter().map(|count| count.as_f64().expect("a count")).collect();
                counts[class] / counts.iter().sum::<f64>()
            };
            for (shown, class, by_truth) in [([0, 1], 2, false), ([0, 2], 1, false), ([0, 2], 1, true)] {
                let mut adapt = subcommand("model adapt");
                adapt.arg(&model);
                for people in shown {
                    let label = ["empty", "one", "two"][people];
                    let label = if by_truth { String::new() } else { format!("={label}") };
                    adapt.args(labelled[people].iter().map(|path| format!("{}{label}", path.display())));
                }
                json_lines(adapt.args(["--json", "--force", "--overwrite", "-o"]).arg(&adapted));
                let (before, after) = (recall(&model, class), recall(&adapted, class));
                let told = format!("{}: {class} people after labels of {shown:?}: {after}", model.display());
                assert!(before > 0.6 && after > before - 0.15, "{told}, {before} before");
            }
        }
    }

    /// The warning said that the class stays about as before.
    #[test]
    fn a_class_that_only_simulated_maps_show_is_reported_as_learnt_from_them() {
        let why = |command: &mut Command| {
            let answer = json_lines(command).remove(0);
            let two = answer["not_measured"].as_array().and_then(|all| all.iter().find(|of| of["class"] == "two"));
            two.unwrap_or_else(|| panic!("{answer}"))["why"].as_str().expect("a reason").to_owned()
        };
        let shown = ["0-1=empty", "0-2=empty", "1-1", "1-2=one"];
        let simulated = why(adapt(&shown).arg("--simulated").arg(adaptation_folder().join("maps")));
        assert_eq!(simulated, "no recording shows it; it is learnt from simulated maps only");
        assert_eq!(why(&mut adapt(&shown)), "no recording shows it; it is told from its neighbour about as before");
    }

    /// With `--no-smoothing` the reliability was that of the filter, beside scores of single frames.
    #[test]
    fn reliability_is_of_the_predictions_that_are_scored() {
        let model = adaptation_folder().join("model.safetensors");
        let recordings = ["0-3.mcap=empty", "1-3.mcap=one"].map(|name| adaptation_folder().join(name));
        let [alone, filtered] = [&["--no-smoothing"][..], &[]].map(|args| {
            let answer = evaluate(&model, args, &recordings);
            let right = |of: &Value| of["right"].as_f64().unwrap_or(0.0) * of["frames"].as_f64().expect("a number");
            let sum = |list: &Value| list.as_array().expect("a list").iter().map(right).sum::<f64>();
            let (scored, binned) = (sum(&answer["recordings"]), sum(&answer["reliability"]["bins"]));
            assert!((scored - binned).abs() < 1e-6, "{args:?}: {scored} right, {binned} by confidence");
            answer["reliability"].clone()
        });
        assert_ne!(alone, filtered);
    }

    #[test]
    fn wrong_labels_are_refused_unless_forced() {
        let folder = tempfile::tempdir().expect("a folder");
        let output = folder.path().join("a.safetensors");
        let wrong = ["0-1=one", "0-2=two", "1-1=two", "1-2=one"];
        let said = failure(adapt(&wrong).arg("-o").arg(&output));
        assert!(said.contains("worse") && said.contains("--force") && !output.exists(), "{said}");
        assert!(said.contains("warning: empty cannot be measured: no recording"), "{said}");
        json_lines(adapt(&wrong).arg("--force").arg("-o").arg(&output));
        assert!(output.exists());
    }

    #[test]
    fn recordings_that_are_missing_damaged_unlabelled_or_named_twice_are_refused() {
        let text = tempfile::NamedTempFile::new().expect("a file");
        std::fs::write(text.path(), "no recording").expect("writable");
        fails_with(adapt(&[]).arg("nowhere.mcap=empty"), &["nowhere.mcap"]);
        fails_with(adapt(&[]).arg(text.path()), &[&text.path().display().to_string()]);
        for (recordings, expected) in [(&["0-1"][..], "no label"), (&["0-1=empty", "0-1=one"][..], "named twice")] {
            fails_with(adapt(recordings), &[expected]);
        }
        wrong_use_with(adapt(&["0-1=three"]), &["not empty, one or two"]);
        let folder = tempfile::tempdir().expect("a folder");
        let none = folder.path().join("none.mcap");
        let header = Recording::open(&adaptation_folder().join("0-1.mcap")).expect("opens").header();
        RecordingWriter::create(&none, Format::Mcap, &header).and_then(RecordingWriter::finish).expect("writes");
        let labelled = format!("{}=empty", none.display());
        fails_with(adapt(&[]).arg(labelled), &["none.mcap: no frame of it can be judged"]);
        // Frames that count twice would give a wrong score.
        let twice = [adaptation_folder().join("0-1.mcap=empty"), adaptation_folder().join("./0-1.mcap=one")];
        fails_with(command!("model evaluate cfar", ..twice), &["0-1.mcap is named twice", "hint: "]);
        fails_with(command!("model adapt cfar", text.path()), &["cannot be adapted"]);
        assert_eq!(outcome(subcommand("model adapt a.safetensors")).0, Some(2));
    }
}
