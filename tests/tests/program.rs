//! Tests of the small commands, and of behaviour that all commands share.

use std::path::Path;
use std::process::Stdio;

use radome_tests::{
    command, fails_with, failure, fixture, json_lines, radome, simulate, subcommand, success, write_file,
    wrong_use_with,
};
use serde_json::json;

#[test]
fn models_lists_the_hqnn_with_its_parameters() {
    let lists = json_lines(subcommand("model list --json"));
    let hqnn = lists[0].as_array().expect("a list").iter().find(|n| n["name"] == "hqnn").expect("hqnn");
    assert_eq!(hqnn["parameters"], 66_447);
}

#[test]
fn config_derives_axes_from_the_sampled_band() {
    let paper = &json_lines(subcommand("board config paper --json"))[0];
    let resolution = paper["range_resolution_m"].as_f64().expect("number");
    assert!((resolution - 0.171).abs() < 0.003, "{resolution}");
    let velocity = paper["max_velocity_m_per_s"].as_f64().expect("number");
    assert!((velocity - 2.5).abs() < 0.01, "{velocity}");
}

/// Asserts the reported register values: gain in steps of 5 dB over 18 or 30, and a frame of 98304 samples in twelve
/// halves of the FIFO.
#[test]
fn config_reports_what_the_registers_hold_instead_and_how_frames_are_sliced() {
    let paper = &json_lines(subcommand("board config paper --json"))[0];
    let nearest = paper["nearest"].as_array().expect("a list");
    let gain = nearest.iter().find(|n| n["name"] == "IF gain").expect("48 dB is no step");
    assert_eq!((gain["requested"].as_f64(), gain["realised"].as_f64()), (Some(48.0), Some(50.0)));
    assert_eq!(paper["slice"]["samples"], 8192);
    assert_eq!(paper["slice"]["slices_per_frame"], 12.0);
    let current_a = paper["supply_current_a"].as_f64().expect("a current");
    assert!((0.01..0.201).contains(&current_a), "{current_a}");
}

/// Regression test: an impossible waveform was not said to be that of a file, and of a folder that is no recording the hint was
/// to write its content to a file.
#[test]
fn config_names_what_it_cannot_use() {
    let folder = tempfile::tempdir().expect("a folder");
    let keys = "start_frequency_hz = 10e9\nend_frequency_hz = 61.5e9\nsamples_per_chirp = 128\nchirps_per_frame = 64\n\
                sample_rate_hz = 2e6\nchirp_interval_s = 400e-6\nframe_interval_s = 0.1\n";
    let file = write_file(folder.path(), "far.toml", keys);
    fails_with(command!("board config", &file), &["far.toml", "start_frequency_hz"]);
    // The registers alone cannot hold this one.
    let keys = "start_frequency_hz = 60.5e9\nend_frequency_hz = 61.5e9\nsamples_per_chirp = 2048\nchirps_per_frame = 4\n\
                sample_rate_hz = 1e6\nchirp_interval_s = 4e-3\nframe_interval_s = 0.1\n";
    let file = write_file(folder.path(), "long.toml", keys);
    fails_with(command!("board config", &file), &["long.toml is no waveform of this chip", "chip: the ramp"]);
    let said = failure(command!("board config", folder.path()));
    assert!(said.contains("not a recording") && !said.contains("write its content"), "{said}");
}

#[test]
fn errors_name_the_cause_and_a_remedy() {
    let said = failure(subcommand("live nowhere.mcap --model nothing.safetensors"));
    assert!(said.starts_with("error: ") && said.contains("nothing.safetensors"), "{said}");
    fails_with(subcommand("recording maps /nonexistent -o /tmp/never.npy"), &["/nonexistent"]);
}

/// Values that an option cannot have ended with the status of a failure, or had the name of a key.
#[test]
fn wrong_values_of_options_are_wrong_use() {
    let scene = "fixtures/scenes/corridor.toml";
    for (command, expected) in [
        (format!("scene simulate {scene} --tolerance-db 0"), "--tolerance-db is 0, expected 0.01 to 20 dB"),
        (format!("scene paths {scene} --time -1"), "--time -1 is not within a day"),
        (format!("scene paths {scene} --time inf"), "--time inf is not within a day"),
        (format!("scene paths {scene} --margin-db nan"), "--margin-db NaN is no number"),
        ("scene calibrate nowhere.mcap --part 0".to_owned(), "--part is 0, expected a number between 0 and 1"),
        ("scene calibrate nowhere.mcap --part 1.5".to_owned(), "--part is 1.5, expected a number between 0 and 1"),
        ("scene calibrate nowhere.mcap --copies 0".to_owned(), "--copies is 0, expected 1 to 10000"),
        (format!("recording echoes {scene} --reflector 1,2"), "--reflector takes three numbers"),
        (format!("recording echoes {scene} --reflector 0,0,0"), "--reflector 0,0,0: expected a range above 0"),
    ] {
        wrong_use_with(radome().args(command.split(' ')), &[expected]);
    }
}

#[test]
fn devices_answers_on_a_machine_without_usb() {
    json_lines(subcommand("board list --json"));
}

#[test]
fn info_shows_waveform_length_and_labels_of_a_recording() {
    let folder = tempfile::tempdir().expect("a folder");
    let recording = folder.path().join("run.mcap");
    simulate(&fixture("scenes/hall.toml"), "--people 0 --frames 20", &recording);
    let info = json_lines(command!("recording info --json", &recording)).remove(0);
    assert_eq!(
        (&info["format"], &info["frames"], &info["labelled_s"]),
        (&"mcap".into(), &20.into(), &json!({})),
        "{info}"
    );
    let of_recording = json_lines(command!("board config --json", &recording)).remove(0);
    assert_eq!(of_recording["waveform"], info["waveform"]);

    let label = ["recording", "label", "--json"];
    let added = json_lines(radome().args(label).args(["--span", "0:1=empty"]).arg(&recording)).remove(0);
    let shown = json_lines(radome().args(label).arg(&recording)).remove(0);
    for key in ["start_s", "end_s", "label"] {
        assert!(shown[0][key] == added[0][key] && !shown[0][key].is_null(), "{shown}, {added}");
    }
    assert_eq!(shown.as_array().map(Vec::len), Some(1), "{shown}");
    let track = folder.path().join("track.txt");
    json_lines(radome().args(label).arg(&recording).arg("-o").arg(&track));
    assert!(std::fs::read_to_string(&track).is_ok_and(|text| text.contains("empty")));
    let info = json_lines(command!("recording info --json", &recording)).remove(0);
    assert_eq!(info["labelled_s"], json!({ "empty": 1.0 }), "{info}");
}

#[test]
fn a_preview_is_drawn_and_replaces_no_file() {
    let folder = tempfile::tempdir().expect("a folder");
    let picture = folder.path().join("scene.png");
    let draw = || command!("scene preview --frames 20 --json -o", &picture, fixture("scenes/corridor.toml"));
    let drawn = json_lines(draw()).remove(0);
    assert_eq!(drawn["preview"], picture.display().to_string(), "{drawn}");
    assert!(std::fs::read(&picture).is_ok_and(|bytes| bytes.starts_with(b"\x89PNG")));
    assert!(failure(draw()).contains("exists already"));
    let by_former_option = folder.path().join("former.png");
    let former = ["scene", "simulate", "fixtures/scenes/corridor.toml", "--frames", "20", "--json", "--preview"];
    json_lines(radome().args(former).arg(&by_former_option));
    assert_eq!(std::fs::read(by_former_option).expect("a picture"), std::fs::read(picture).expect("a picture"));
}

#[test]
fn no_output_replaces_an_input() {
    let folder = tempfile::tempdir().expect("a folder");
    let (recording, scene) = ("formats/recording.mcap", "scenes/corridor.toml");
    for (command, input) in [
        ("scene simulate INPUT", scene),
        ("scene preview INPUT", scene),
        ("scene calibrate INPUT", recording),
        ("recording maps INPUT", recording),
        ("recording label INPUT", recording),
        ("recording echoes INPUT --reflector 3,0,0", recording),
        ("recording repair INPUT", recording),
        ("record INPUT", recording),
        ("record emulated:INPUT", recording),
        ("record emulated:emulated:INPUT", recording),
        ("record serial:/dev/no-such-port --waveform INPUT", recording),
        ("live INPUT", recording),
        ("live serial:/dev/no-such-port --waveform INPUT", recording),
        ("model export INPUT", "models/room-cnn.safetensors"),
        ("model adapt room-hqnn INPUT=empty", recording),
        ("model background INPUT", recording),
    ] {
        let copy = folder.path().join(Path::new(input).file_name().expect("a name"));
        std::fs::copy(fixture(input), &copy).expect("copies");
        let before = std::fs::read(&copy).expect("readable");
        let words = command.split(' ').map(|word| word.replace("INPUT", &copy.to_string_lossy()));
        wrong_use_with(radome().args(words).arg("-o").arg(&copy).arg("--overwrite"), &["is input and output at once"]);
        assert!(std::fs::read(&copy).expect("readable") == before, "{command} changed its input");
    }
}

#[test]
fn an_output_that_is_a_folder_is_refused_before_any_work() {
    let folder = tempfile::tempdir().expect("a folder");
    for (command, input) in [
        ("model export", "models/room-cnn.safetensors"),
        ("recording echoes --reflector 3,0,0", "formats/recording.mcap"),
    ] {
        let mut command = subcommand(command);
        fails_with(command.arg(fixture(input)).arg("-o").arg(folder.path()), &["is a folder", "hint: "]);
    }
    let judged = fixture("formats/judged.mcap");
    wrong_use_with(command!("recording answers", &judged, "-o -"), &["does not go to stdout"]);
}

#[test]
fn labels_beside_a_text_recording_do_not_become_those_of_another() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name);
    simulate(&fixture("scenes/desk.toml"), "--frames 20", &at("desk.mcap"));
    let convert = || command!("recording convert", at("desk.mcap"), at("old.txt"), "--overwrite");
    success(convert());
    success(command!("recording label", at("old.txt"), "--span 0:1=two"));
    let before = [at("old.txt"), at("old.label")].map(|path| std::fs::read(path).expect("readable"));
    fails_with(convert(), &["old.label holds the labels of", "hint: move it away"]);
    let after = [at("old.txt"), at("old.label")].map(|path| std::fs::read(path).expect("readable"));
    assert!(before == after);
}

#[test]
fn a_background_of_another_waveform_is_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let background = folder.path().join("empty.json");
    success(command!("model background", fixture("scenes/desk.toml"), "--frames 100 --model cfar -o", &background));
    let live = |scene: &str| command!("live", fixture(scene), "--frames 5 --model cfar --background", &background);
    success(live("scenes/desk.toml"));
    fails_with(live("scenes/hall.toml"), &["was captured with another waveform", "hint: "]);
}

/// A stderr that cannot be written, as that of a service whose journal is full.
#[test]
fn a_full_stderr_stops_nothing() {
    if !Path::new("/dev/full").exists() {
        return;
    }
    let folder = tempfile::tempdir().expect("a folder");
    let to = folder.path().join("a.mcap");
    let full = || std::fs::File::options().write(true).open("/dev/full").expect("a device");
    let mut record = command!("record", fixture("formats/recording.mcap"), "-o", &to, "--allow-loss");
    let status = record.stderr(full()).status().expect("runs");
    assert!(status.success(), "{status}");
    let desk = folder.path().join("desk.mcap");
    simulate(&fixture("scenes/desk.toml"), "--frames 20", &desk);
    let mut live = command!("live", &desk, "--model cfar");
    assert!(live.stderr(full()).stdout(Stdio::null()).status().expect("runs").success());
}

#[test]
fn a_reset_without_a_probe_says_where_probes_are_listed() {
    for arguments in [&["board", "reset", "nothing"][..], &["board", "list", "--reset", "nothing"]] {
        fails_with(radome().args(arguments), &["nothing is no debug probe", "lists the probes"]);
    }
}
