//! Behaviour on malformed input: a right answer, or an error that states the problem, its place and the remedy. No
//! partial file remains.

use std::path::Path;

use radome_tests::{
    command, fails_with, failure, fixture, json_lines, npy_bytes, outcome, subcommand, with_file_size_limit,
    write_file, wrong_use_with,
};
use serde_json::json;

/// Shape of the made-up recording: frames, channels, chirps, samples.
const SHAPE: [usize; 4] = [3, 3, 8, 64];

/// Writes a recording folder in Infineon's format with these codes, in a shape that may contradict its configuration.
fn write_infineon_folder(folder: &Path, samples_per_chirp: usize, code: impl Fn(usize) -> u16) {
    let shape = json!({
        "rx_antennas": [1, 2, 3], "tx_antennas": [1], "tx_power_level": 31, "if_gain_dB": 23,
        "start_frequency_Hz": 58e9, "end_frequency_Hz": 63.5e9,
        "num_chirps_per_frame": SHAPE[2], "num_samples_per_chirp": samples_per_chirp,
        "chirp_repetition_time_s": 591.125e-6, "frame_repetition_time_s": 77.268846e-3,
        "mimo_mode": "off", "sample_rate_Hz": 2_000_000, "hp_cutoff_Hz": 80_000, "aaf_cutoff_Hz": 500_000,
    });
    let config = json!({ "device_config": { "fmcw_single_shape": shape } });
    std::fs::write(folder.join("config.json"), config.to_string()).expect("writable");
    let codes: Vec<u16> = (0..SHAPE.iter().product::<usize>()).map(code).collect();
    std::fs::write(folder.join("radar.npy"), npy_bytes(SHAPE, &codes)).expect("writable");
    std::fs::write(folder.join("format.version"), "1.0.0").expect("writable");
}

fn compute_maps(folder: &Path) -> (serde_json::Value, Vec<f32>) {
    let output = folder.join("maps.npy");
    let said = json_lines(command!("recording maps --json", folder, "-o", &output));
    let file = std::io::BufReader::new(std::fs::File::open(output).expect("written"));
    let values = npyz::NpyFile::new(file).expect("an array").into_vec().expect("f32");
    (said.last().expect("a line").clone(), values)
}

/// Messages had radians for the degrees that were given, and words of the parser of another format.
#[test]
fn targets_that_cannot_be_computed_are_reported_by_the_names_of_options() {
    for (option, value, status, expected) in [
        ("--azimuth-deg", "1e9", 2, "the azimuth is 1000000000 degrees"),
        ("--elevation-deg", "91", 2, "the elevation is 91 degrees"),
        ("--range-m", "-1", 2, "the range is -1 m"),
        ("--tolerance-db", "0", 2, "the tolerance is 0 dB"),
        ("--material", "foo", 2, "--material is \"foo\", expected one of pec, skin, concrete, "),
        ("--edge-m", "1", 2, "--edge-m does not belong to sphere"),
    ] {
        let (ended, _, said) = outcome(command!("bench rcs sphere", option, value));
        assert_eq!(ended, Some(status), "{said}");
        assert!(said.contains(expected) && !said.contains(" rad") && !said.contains("variant"), "{said}");
    }
    wrong_use_with(subcommand("bench rcs plate --width-m 0"), &["the width is 0 m"]);
    wrong_use_with(subcommand("bench rcs teapot"), &["there is no target teapot", "hint: plate, "]);
}

#[test]
fn frames_of_the_middle_code_read_the_floor_everywhere() {
    let folder = tempfile::tempdir().expect("a folder");
    write_infineon_folder(folder.path(), SHAPE[3], |_| 2048);
    let (_, values) = compute_maps(folder.path());
    assert_eq!(values.len(), SHAPE.iter().product::<usize>() / 2);
    assert!(values.iter().all(|&db| db == -200.0));
}

#[test]
fn saturated_frames_are_mapped_and_reported_as_saturated() {
    let folder = tempfile::tempdir().expect("a folder");
    write_infineon_folder(folder.path(), SHAPE[3], |i| if i % 2 == 0 { 0 } else { 4095 });
    let (said, values) = compute_maps(folder.path());
    assert!(values.iter().all(|db| db.is_finite()));
    assert_eq!(said["saturated_samples"], SHAPE.iter().product::<usize>());
}

#[test]
fn a_configuration_that_disagrees_with_the_data_names_both_shapes() {
    let folder = tempfile::tempdir().expect("a folder");
    write_infineon_folder(folder.path(), 128, |_| 2048);
    let output = folder.path().join("maps.npy");
    fails_with(command!("recording maps", folder.path(), "-o", &output), &["128", "64", "config.json"]);
    assert!(!output.exists());
}

#[test]
fn an_output_that_cannot_be_written_is_named_before_any_work() {
    fails_with(
        command!("scene simulate --frames 2 -o /nonexistent/run.mcap", fixture("scenes/desk.toml")),
        &["/nonexistent"],
    );
}

/// Regression test: files of labels, captures of the empty room and files of angles were read whole, however long they were, and
/// a pipe was waited for.
#[test]
fn files_that_options_name_are_read_up_to_a_limit() {
    let folder = tempfile::tempdir().expect("a folder");
    let recording = fixture("formats/recording.mcap");
    for (command, option, name) in [
        ("recording label", "--from", "labels.txt"),
        ("recording echoes", "--angles", "angles.toml"),
        ("live", "--background", "empty.json"),
    ] {
        // The file has holes only and takes no space.
        let path = folder.path().join(name);
        std::fs::File::create(&path).and_then(|file| file.set_len(1 << 40)).expect("writable");
        fails_with(subcommand(command).arg(&recording).arg(option).arg(&path), &[name, "bytes or more, and at most"]);
    }
}

/// Regression test: of a full disk only the system's words were left, without the file.
#[test]
fn an_output_that_does_not_fit_on_the_disk_is_named() {
    let folder = tempfile::tempdir().expect("a folder");
    for (command, input, name) in [
        ("recording maps", "formats/judged.mcap", "maps.npy"),
        ("recording answers", "formats/judged.mcap", "answers.csv"),
        ("recording label", "formats/judged.mcap", "labels.txt"),
        ("model export", "models/room-cnn.safetensors", "cnn.onnx"),
    ] {
        let output = folder.path().join(name);
        let mut on_full_disk = with_file_size_limit(0, subcommand(command).arg(fixture(input)).arg("-o").arg(&output));
        let named = format!("{}: ", output.display());
        fails_with(&mut on_full_disk, &[named.as_str(), "os error"]);
    }
    assert_eq!(std::fs::read_dir(folder.path()).expect("lists").count(), 0);
}

#[test]
fn a_damaged_model_is_refused_by_its_path() {
    let folder = tempfile::tempdir().expect("a folder");
    let bytes = std::fs::read(fixture("models/desk-hqnn.safetensors")).expect("readable");
    let path = write_file(folder.path(), "half.safetensors", &bytes[..bytes.len() / 2]);
    let said = failure(command!("live nowhere.mcap --model", &path));
    assert!(said.contains("half.safetensors") && !said.contains("panicked"), "{said}");
}

#[test]
fn a_model_and_a_scene_of_different_waveforms_are_refused() {
    fails_with(
        command!("demo --frames 1 --speed 0 --json --scene", fixture("scenes/desk.toml")),
        &["samples", "hint:"],
    );
}
