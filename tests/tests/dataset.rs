//! Tests of datasets: identical bytes after kills, in shards and out of order; labelled folders of every kind; error
//! messages.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use radome_driver::recording::{Format, Recording, RecordingWriter};
use radome_tests::running::{Running, wait_for};
use radome_tests::{
    add_signal, command, convert, fails_with, failure, fixture, fixture_text, frames_and_gaps, json_lines, labels_of,
    model_of_one_waveform, npy_bytes, outcome, simulate, subcommand, success, write_file, wrong_use_with,
};

/// TOML section for maps of one channel in decibels.
const MAP: &str = r#"[map]
scale = "minus_one_to_one"
channels = { one = 0 }
chirp_mean_removal = false
static_removal = "slow_time_mean"
range_window = "hann"
doppler_window = "hann"
slow_time = "chirps"
amplitude = "unnormalised"
floor_db = -200.0"#;

/// Writes a spec with `runs` short runs of each of the paper's two scenes; every unit takes a moment.
fn spec(folder: &Path, runs: u64, more: &str) -> PathBuf {
    let scene = |name: &str| fixture(&format!("scenes/{name}.toml")).canonicalize().expect("a scene");
    let text = format!(
        r#"format = 1
{more}
{MAP}
[[simulated]]
scene = {corridor:?}
seeds = [1, {runs}]
people = [2]
frames = 200
every = 50
[[simulated]]
scene = {room:?}
seeds = [5, 6]
frames = 300
every = 100
"#,
        corridor = scene("corridor"),
        room = scene("room"),
    );
    write_file(folder, "spec.toml", text)
}

fn build_command(spec: &Path, output: &Path) -> Command {
    command!("dataset build --json", spec, "-o", output)
}

/// Contents of all files of a dataset, by name.
fn read_files(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let entries = std::fs::read_dir(folder).expect("a folder").map(|entry| entry.expect("an entry"));
    entries.map(|e| (e.file_name().to_string_lossy().into_owned(), std::fs::read(e.path()).expect("reads"))).collect()
}

/// Sorted names of the files in a folder that may be absent.
fn names(folder: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let mut names: Vec<String> = entries.map(|e| e.file_name().to_string_lossy().into_owned()).collect();
    names.sort();
    names
}

/// Starts a build and kills it by SIGKILL when it has made some units, but not all.
fn kill_midway(command: &mut Command, parts: &Path, after: usize) {
    let mut build = Running::start(command);
    let until = Instant::now() + Duration::from_secs(300);
    let done = || names(parts).iter().filter(|n| n.starts_with("unit-") && !n.ends_with(".partial")).count();
    while done() < after && build.is_running() {
        assert!(Instant::now() < until, "no unit was ever made");
        std::thread::sleep(Duration::from_millis(2));
    }
}

#[test]
fn a_build_killed_over_and_over_gives_the_bytes_of_one_that_was_not() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| folder.path().join(name);
    let spec = spec(folder.path(), 8, "");
    let said = json_lines(build_command(&spec, &path("whole"))).remove(0);
    assert_eq!(
        (said["maps"].as_u64(), said["units"].as_u64(), said["units_found"].as_u64()),
        (Some(38), Some(10), Some(0))
    );

    for after in [1, 3, 6] {
        kill_midway(&mut build_command(&spec, &path("again")), &path("again.parts"), after);
        assert!(!path("again").exists() || after == 6);
    }
    if !path("again").exists() {
        // A changed spec is refused with an error, and no unit is lost.
        let text = std::fs::read_to_string(&spec).expect("reads");
        std::fs::write(&spec, text.replace("every = 50", "every = 25")).expect("writable");
        let said = failure(build_command(&spec, &path("again")));
        assert!(said.contains("again.parts holds the beginning of another build, made from another spec"), "{said}");
        std::fs::write(&spec, text).expect("writable");
        let said = json_lines(build_command(&spec, &path("again"))).remove(0);
        assert!(said["units_found"].as_u64() >= Some(3), "{said}");
    }
    assert_eq!(read_files(&path("again")), read_files(&path("whole")));
    assert_eq!(names(folder.path()), ["again", "spec.toml", "whole"], "nothing else is left");
    fails_with(build_command(&spec, &path("again")), &["again exists already"]);
}

#[test]
fn eight_shards_of_which_one_was_killed_merge_to_the_single_builds_bytes() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| folder.path().join(name);
    let spec = spec(folder.path(), 16, "split = { by = \"sequence\", test = 0.25, validation = 0.25 }");
    json_lines(build_command(&spec, &path("single")));
    let shard = |index: usize| {
        let mut command = build_command(&spec, &path("shards"));
        command.args(["--shard", "auto/8"]).env("SLURM_ARRAY_TASK_ID", index.to_string());
        command
    };
    // Shards run out of order, as in array jobs. One of them is killed, and one is started twice.
    for index in [3, 0, 7, 5, 1, 6, 2] {
        json_lines(shard(index));
    }
    kill_midway(&mut shard(4), &path("shards/shard-00004-of-00008.parts"), 1);
    let all = |skip: Option<usize>| {
        let shards = (0..8).filter(move |i| Some(*i) != skip);
        shards.map(|i| folder.path().join(format!("shards/shard-{i:05}-of-00008"))).collect::<Vec<_>>()
    };
    let merge =
        |parts: &[PathBuf], output: &str| command!("dataset merge --json", ..parts, "-o", folder.path().join(output));
    if !path("shards/shard-00004-of-00008").exists() {
        fails_with(merge(&all(Some(4)), "merged"), &["shards 4 of 8 are missing", "--shard 4/8"]);
    }
    json_lines(shard(4));
    assert_eq!(json_lines(shard(2)).remove(0)["units_found"], 2, "a shard that is there is not made again");
    json_lines(merge(&all(None), "merged"));
    assert_eq!(read_files(&path("merged")), read_files(&path("single")));
    let report = json_lines(command!("dataset verify --json", path("merged"))).remove(0);
    assert!(
        report["maps"] == 70 && report["split_maps"].as_array().is_some_and(|n| n.iter().all(|n| *n != 0)),
        "{report}"
    );

    // Duplicate and foreign shards are refused.
    let mut doubled = all(None);
    doubled.push(path("copy"));
    assert!(Command::new("cp").arg("-r").arg(&doubled[6]).arg(path("copy")).status().expect("cp").success());
    fails_with(merge(&doubled, "no"), &["copy are both shard 6/8"]);
    let text = std::fs::read_to_string(&spec).expect("reads");
    let other = write_file(folder.path(), "other.toml", text.replace("seeds = [5, 6]", "seeds = [6, 7]"));
    json_lines(build_command(&other, &path("other")).args(["--shard", "6/8"]));
    let mut foreign = all(Some(6));
    foreign.push(path("other/shard-00006-of-00008"));
    fails_with(merge(&foreign, "no"), &["shard-00006-of-00008 is no shard of the build of", "another spec"]);
    assert!(!path("no").exists());
}

#[test]
fn two_builds_at_once_in_one_place_are_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| folder.path().join(name);
    let spec = spec(folder.path(), 400, "");
    let _first = Running::start(build_command(&spec, &path("set")));
    wait_for("a plan", || path("set.parts/plan.json").exists().then_some(()));
    fails_with(build_command(&spec, &path("set")), &["set.parts: another process is at work here"]);
}

/// The folder was taken for that of an unfinished build, and removed when the build was done.
#[test]
fn a_folder_of_the_user_with_the_name_of_an_unfinished_build_stays() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| folder.path().join(name);
    let spec = spec(folder.path(), 1, "");
    for taken in ["set.parts", "set.partial"] {
        std::fs::create_dir(path(taken)).expect("a folder");
        write_file(&path(taken), "notes.txt", "mine");
        fails_with(build_command(&spec, &path("set")), &[taken, "holds notes.txt", "hint: move the folder away"]);
        assert_eq!(names(&path(taken)), ["notes.txt"]);
        assert!(!path("set").exists());
        std::fs::remove_dir_all(path(taken)).expect("removed");
    }
    // The units that were made are used.
    assert_eq!(json_lines(build_command(&spec, &path("set"))).remove(0)["units_found"], 3);
    assert_eq!(names(folder.path()), ["set", "spec.toml"]);
}

/// Such a link was noticed when all units had been made.
#[test]
fn a_link_that_leads_nowhere_takes_the_name_of_a_dataset() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| folder.path().join(name);
    std::os::unix::fs::symlink(path("nowhere"), path("set")).expect("a link");
    fails_with(build_command(&spec(folder.path(), 1, ""), &path("set")), &["set exists already", "hint: "]);
    assert_eq!(names(folder.path()), ["set", "spec.toml"]);
}

#[test]
fn a_zero_sigma_is_reported() {
    let folder = tempfile::tempdir().expect("a folder");
    let spec = spec(folder.path(), 4, "");
    json_lines(build_command(&spec, &folder.path().join("set")));
    let stats = |set: &Path| command!("dataset stats --json", set);
    let table = json_lines(stats(&folder.path().join("set"))).remove(0);
    let row = |scene: &str, class: &str| {
        let rows = table.as_array().expect("a list");
        rows.iter().find(|r| r["scene"] == scene && r["class"] == class).unwrap_or_else(|| panic!("{scene} {class}"))
    };
    let empty = row("corridor", "empty");
    // Sigma of the receiver's noise in dB is 5.57 dB for any radar.
    assert!((empty["sigma_db"].as_f64().expect("a number") - 5.6).abs() < 0.1 && empty["domain"] == "sim", "{empty}");
    assert!(empty["raised_fraction"].is_null() && empty["mean_db"].is_number(), "{empty}");
    let two = row("corridor", "two");
    let (fraction, level) = (two["raised_fraction"].as_f64(), two["raised_level_db"].as_f64());
    assert!(fraction > Some(0.002) && fraction < Some(0.2) && level > Some(4.0) && level < Some(40.0), "{two}");
    // Intervals are over sequences; rows with a single sequence have none.
    for row in table.as_array().expect("a list") {
        let halves = ["mean_half_width_db", "sigma_half_width_db"].map(|key| row[key].as_f64());
        assert!(halves.iter().all(|half| half.is_some() == (row["sequences"].as_u64() > Some(1))), "{row}");
    }

    // Without receiver noise, as in the paper, every cell of an empty map lies at the floor.
    let text = std::fs::read_to_string(&spec).expect("reads");
    std::fs::write(&spec, text.replace("floor_db = -200.0", "floor_db = 50.0")).expect("writable");
    json_lines(build_command(&spec, &folder.path().join("flat")));
    let (status, table, said) = outcome(stats(&folder.path().join("flat")));
    assert!(status == Some(1) && table.contains("\"sigma_db\":0.0"), "{table}");
    assert!(said.contains("sigma is zero in sim corridor empty (all cells at 50.00 dB)"), "{said}");
    // `dataset verify` reports that these maps are identical.
    fails_with(command!("dataset verify", folder.path().join("flat")), &["1 groups of duplicates"]);
}

/// Statistics of all maps were refused where a sequence is in two splits, and those of a split did not say how the maps were divided.
#[test]
fn statistics_ask_for_splits_only_where_one_is_named() {
    let folder = tempfile::tempdir().expect("a folder");
    let set = folder.path().join("set");
    json_lines(build_command(&spec(folder.path(), 4, ""), &set));
    let stats = |more: &[&str]| command!("dataset stats --json", &set, ..more);
    let rule =
        "no split of their own: their sequences are divided by the default rule of trainings, 15 % for validation";
    assert!(success(stats(&["--split", "train"])).1.contains(rule));
    let (all, said) = success(stats(&[]));
    assert!(!said.contains("split"), "{said}");
    // The first two maps are of one run.
    let manifest = std::fs::read_to_string(set.join("manifest.jsonl")).expect("reads");
    let with_split = |(index, line): (usize, &str)| {
        let mut row: serde_json::Value = serde_json::from_str(line).expect("JSON");
        row["split"] = if index == 0 { "train".into() } else { "test".into() };
        format!("{row}\n")
    };
    let leaking: String = manifest.lines().enumerate().map(with_split).collect();
    std::fs::write(set.join("manifest.jsonl"), leaking).expect("writable");
    assert_eq!(success(stats(&[])).0, all);
    fails_with(stats(&["--split", "train"]), &["is in two splits"]);
}

/// Writes a session with a few simulated frames in the format of Radar Fusion GUI.
fn write_session(folder: &Path, frames: u32) -> PathBuf {
    let (recording, session) = (folder.join("made.mcap"), folder.join("made"));
    simulate(&fixture("scenes/corridor.toml"), &format!("--frames {frames}"), &recording);
    json_lines(command!("recording convert --json", &recording, &session, "--to infineon"));
    session
}

fn copy_folder(from: &Path, to: &Path) {
    std::fs::create_dir_all(to.parent().expect("a parent")).expect("writable");
    assert!(Command::new("cp").arg("-r").args([from, to]).status().expect("cp").success());
}

fn edit_json(file: &Path, change: impl FnOnce(&mut serde_json::Value)) {
    let mut value = serde_json::from_str(&std::fs::read_to_string(file).expect("reads")).expect("JSON");
    change(&mut value);
    std::fs::write(file, serde_json::to_string_pretty(&value).expect("JSON")).expect("writable");
}

/// Asserts that one rule labels every kind of folder that the references describe (real-frames.md, hardware.md sections
/// 5 and 6).
#[test]
fn infineon_folders_of_every_kind_become_labelled_sequences() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| folder.path().join(name);
    let frames = 12;
    let made = write_session(folder.path(), frames);
    let single_shape = |value: &mut serde_json::Value| value["device_config"]["fmcw_single_shape"].take();
    let put = |value: &mut serde_json::Value, shape| value["device_config"]["fmcw_single_shape"] = shape;

    // Folders of the present recorder, and a GUI export with the board's own values, CRLF and a session without keys.
    copy_folder(&made, &path("data/home/empty_20260106-151615"));
    copy_folder(&made, &path("data/home/empty_gui"));
    let radar = path("data/home/empty_gui/RadarIfxAvian_00");
    edit_json(&radar.join("config.json"), |value| value["device_info"] = "Radar Baseboard MCU7 (MCU A)".into());
    edit_json(&path("data/home/empty_gui/meta.json"), |value| {
        *value = serde_json::json!({ "_comment": null, "os_release": null })
    });
    std::fs::write(radar.join("format.version"), "1.0.0\r\n").expect("writable");
    // SDK 3.4 and before use other names for the band and have no filters.
    copy_folder(&made, &path("data/home/ann/one_old"));
    edit_json(&path("data/home/ann/one_old/RadarIfxAvian_00/config.json"), |value| {
        let mut shape = single_shape(value);
        let object = shape.as_object_mut().expect("an object");
        for (new, old) in [("start_frequency_Hz", "lower_frequency_Hz"), ("end_frequency_Hz", "upper_frequency_Hz")] {
            let band = object.remove(new).expect("a frequency");
            object.insert(old.into(), band);
        }
        object.remove("hp_cutoff_Hz");
        object.remove("aaf_cutoff_Hz");
        put(value, shape);
    });
    // ifxdaq 3.0.1 of 2022 has time stamps, temperatures, numbers with exponents, and frames at uneven times.
    copy_folder(&made, &path("data/home/ann/one_2022"));
    let radar = path("data/home/ann/one_2022/RadarIfxAvian_00");
    let text = std::fs::read_to_string(radar.join("config.json")).expect("reads");
    std::fs::write(radar.join("config.json"), text.replace("59558825000", "59.558825e9")).expect("writable");
    let stamps: String =
        (0..frames).map(|i| format!("{:.6}\n", 1.6633e9 + 0.095 * f64::from(i) + 0.01 * f64::from(i % 2))).collect();
    std::fs::write(radar.join("radar_timestamp.csv"), stamps).expect("writable");
    std::fs::write(radar.join("temperature_timestamp.csv"), "1663300000.1\n").expect("writable");
    let mut temperature = b"\x93NUMPY\x01\x00\x76\x00".to_vec();
    temperature.extend(format!("{:<117}\n", "{'descr': '<f8', 'fortran_order': False, 'shape': (1,), }").bytes());
    temperature.extend(41.5f64.to_le_bytes());
    std::fs::write(radar.join("temperature.npy"), temperature).expect("writable");
    edit_json(&path("data/home/ann/one_2022/meta.json"), |value| {
        *value = serde_json::json!({ "ifxdaq": "3.0.1", "user": "x" })
    });
    // Two boards of one session form one sequence.
    copy_folder(&made, &path("data/home/bob/two_boards"));
    let second = path("data/home/bob/two_boards/RadarIfxAvian_01");
    copy_folder(&made.join("RadarIfxAvian_00"), &second);
    let bytes = std::fs::read(second.join("radar.npy")).expect("reads");
    let codes: Vec<u16> = npyz::NpyFile::new(bytes.as_slice()).expect("an array").into_vec().expect("codes");
    let other: Vec<u16> = codes.iter().map(|code| (code + 1).min(4095)).collect();
    std::fs::write(second.join("radar.npy"), npy_bytes([frames as usize, 3, 128, 256], &other)).expect("writable");
    // One receiver alone, without a session's folder. Its maps have the same cells, but another waveform and therefore
    // a dataset of their own.
    copy_folder(&made.join("RadarIfxAvian_00"), &path("single/bob/two_rx1"));
    edit_json(&path("single/bob/two_rx1/config.json"), |value| {
        value["device_config"]["fmcw_single_shape"]["rx_antennas"] = serde_json::json!([1]);
    });
    let first_rx: Vec<u16> = codes.chunks(3 * 128 * 256).flat_map(|frame| frame[..128 * 256].to_vec()).collect();
    std::fs::write(path("single/bob/two_rx1/radar.npy"), npy_bytes([frames as usize, 1, 128, 256], &first_rx))
        .expect("writable");
    // The SDK's text recording, a native recording, and a recording that contains its labels.
    convert(&made, &path("data/home/bob/two_sdk.txt"));
    copy_folder(&path("made.mcap"), &path("data/home/bob/two_native.mcap"));
    copy_folder(&made, &path("data/home/mixed_1"));
    let header = "Time(Seconds),Length(Seconds),Label(string),Confidence(double),Comment(string)";
    std::fs::write(path("data/home/mixed_1/labels.label"), format!("{header}\n0,0.5,empty,1,\n0.5,0.4,one,1,\n"))
        .expect("writable");
    copy_folder(&made, &path("data/home/calibration"));

    let text = format!(
        r#"format = 1
{MAP}
[[recorded]]
folders = "data"
labels = {{ "empty*" = "empty", "{{scene}}/{{subject}}/one_*" = "one", "{{scene}}/{{subject}}/two_*" = "two", "mixed_?" = "spans", "calibration" = "skip" }}
scene = "home"
"#
    );
    let spec = write_file(folder.path(), "spec.toml", &text);
    let said = json_lines(build_command(&spec, &path("set"))).remove(0);
    let frames = u64::from(frames);
    let counts = ["empty", "one", "two", "maps", "units"].map(|key| said[key].as_u64().expect("a number"));
    assert_eq!(counts, [2 * frames + 5, 2 * frames + 4, 4 * frames, 8 * frames + 9, 9], "{said}");
    let manifest = std::fs::read_to_string(path("set/manifest.jsonl")).expect("reads");
    let rows: Vec<serde_json::Value> = manifest.lines().map(|line| serde_json::from_str(line).expect("JSON")).collect();
    assert!(rows.iter().all(|row| row["scene"] == "home" && row["domain"] == "real"));
    let of = |recording: &str| {
        rows.iter().find(|row| row["recording"] == recording).unwrap_or_else(|| panic!("{recording}"))
    };
    assert_eq!(of("home/ann/one_2022")["subject"], "ann");
    assert_eq!(of("home/bob/two_boards/RadarIfxAvian_01")["sequence"], "home/bob/two_boards");
    assert_eq!(of("home/bob/two_sdk")["label"], "two");
    assert!(of("home/empty_gui").get("subject").is_none());
    // Neither the filter settings nor the names of the band change the samples. The other receivers do not matter here
    // either.
    let alone = write_file(
        folder.path(),
        "alone.toml",
        text.replace("folders = \"data\"", "folders = \"single\"").replace("{scene}/", ""),
    );
    assert_eq!(json_lines(build_command(&alone, &path("alone"))).remove(0)["two"], frames);
    let manifest = std::fs::read_to_string(path("alone/manifest.jsonl")).expect("reads");
    let row: serde_json::Value =
        manifest.lines().next().and_then(|line| serde_json::from_str(line).ok()).expect("a row");
    assert_eq!((&row["hash"], &row["subject"]), (&of("home/ann/one_old")["hash"], &"bob".into()));

    // Folders that match no rule, or two, are named in the error.
    copy_folder(&made, &path("data/home/nobody_knows"));
    fails_with(build_command(&spec, &path("set2")), &["'home/nobody_knows' fits none of the patterns"]);
    std::fs::write(&spec, text.replace("\"calibration\" =", "\"*y_*\" = \"empty\", \"calibration\" ="))
        .expect("writable");
    let said = failure(build_command(&spec, &path("set2")));
    assert!(said.contains("'home/empty_20260106-151615' fits two patterns") || said.contains("empty_gui"), "{said}");
    assert_eq!(names(folder.path()).iter().filter(|name| name.starts_with("set2")).count(), 0);
}

#[test]
fn labels_are_given_by_hand_from_truth_and_by_a_detector() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| folder.path().join(name);
    let simulate = |name: &str, people: &str| {
        let options = format!("--frames 150 --seed 100021 --people {people}");
        simulate(&fixture("scenes/corridor.toml"), &options, &path(name))
    };
    let label = |name: &str| command!("recording label --json", path(name));
    simulate("one.mcap", "1");
    let truth = json_lines(label("one.mcap").args(["--propose", "truth", "-o"]).arg(path("truth.label"))).remove(0);
    let spans = truth.as_array().expect("a list");
    let ends = |span: &serde_json::Value| (span["start_s"].as_f64().expect("s"), span["end_s"].as_f64().expect("s"));
    assert_eq!((ends(&spans[0]).0, ends(&spans[spans.len() - 1]).1), (0.0, 15.0));
    assert!(spans.windows(2).all(|pair| ends(&pair[0]).1 == ends(&pair[1]).0 && pair[0]["label"] != pair[1]["label"]));

    // The detector calls an empty corridor empty in all frames, and a walker occupied in most frames.
    simulate("nobody.mcap", "0");
    let nobody = json_lines(label("nobody.mcap").args(["--propose", "detector"])).remove(0);
    assert_eq!((nobody[0]["label"].as_str(), nobody.as_array().map(Vec::len)), (Some("empty"), Some(1)), "{nobody}");
    let found = json_lines(label("one.mcap").args(["--propose", "detector"])).remove(0);
    let at = |spans: &serde_json::Value, time_s: f64| {
        let span = spans.as_array().and_then(|s| s.iter().find(|s| ends(s).0 <= time_s && time_s < ends(s).1).cloned());
        span.map(|s| s["label"] == "empty")
    };
    let agree =
        (0..150).filter(|i| at(&truth, f64::from(*i) * 0.1 + 0.05) == at(&found, f64::from(*i) * 0.1 + 0.05)).count();
    assert!(agree > 120, "{agree} of 150 frames: {found}");
    // The recording now contains the labels, and a dataset is built from them.
    let held = labels_of(&path("one.mcap"));
    assert_eq!(Some(&held), found.as_array());

    // Labels that overlap, run backwards or lie outside the recording are refused by name, and nothing is written.
    wrong_use_with(label("one.mcap").args(["--span", "3:2=one"]), &["'one' is reversed"]);
    for (span, what) in [("14:16=two", "'two' from 14 to 16 s is out of range"), ("1:2=two", "overlap")] {
        fails_with(label("one.mcap").args(["--span", span]), &[what]);
    }
    assert_eq!(labels_of(&path("one.mcap")), held);
    json_lines(label("one.mcap").args(["--span", "1:2=somebody coughs", "--who", "a test"]));

    // A folder keeps its labels beside the samples; a label file is imported.
    let session = write_session(folder.path(), 12);
    std::fs::write(path("track.txt"), "0.0\t0.6\tempty\n").expect("writable");
    json_lines(label("made").args(["--span", "0.6:1.2=one", "--from"]).arg(path("track.txt")));
    let text = std::fs::read_to_string(session.join("radome.label")).expect("written");
    assert!(text.contains("0.000000,0.600000,empty,") && text.contains("0.600000,0.600000,one,"), "{text}");
    let said = failure(label("made").args(["--span", "0.5:0.7=two"]));
    assert!(said.contains("'empty' (0 to 0.6 s) and 'two' (0.5 to 0.7 s) overlap"), "{said}");
}

/// Faults of a spec were found when its units had been made for hours, and the corrected spec was another one, whose units were
/// made anew.
#[test]
fn a_spec_that_contradicts_itself_is_refused_before_units_are_made() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| folder.path().join(name);
    let sound = std::fs::read_to_string(spec(folder.path(), 2, "")).expect("reads");
    let refused = |text: &str, expected: &str| {
        std::fs::write(path("odd.toml"), text).expect("writable");
        fails_with(build_command(&path("odd.toml"), &path("set")), &[expected]);
        assert!(!path("set.parts").exists(), "{expected}");
    };
    let split = |rule: &str| sound.replacen("format = 1", &format!("format = 1\nsplit = {rule}"), 1);
    refused(&split("{ validation = 0.5, test = 0.6 }"), "odd.toml: split: validation 0.5 and test 0.6");
    refused(&split("{ held_out = \"corridor\" }"), "no sequence 'corridor' to hold out");
    refused(&sound.replace("people = [2]", "people = [2, 99]"), "99 people asked for");
    refused(&format!("{sound}tolerance_db = -1.0\n"), "tolerance_db is -1");
    // Two recordings were said to have one name, and the hint was about folders.
    let (_, last) = sound.rsplit_once("[[simulated]]").expect("two scenes");
    let overlap = format!("{sound}[[simulated]]{}", last.replace("[5, 6]", "[6, 7]"));
    refused(
        &overlap,
        "two simulated runs would be called 'room-seed6'\n\nhint: give each [[simulated]] of a scene its own seeds",
    );
}

/// Units of a build that gave no map stayed, so that the corrected spec was refused.
#[test]
fn a_build_without_labels_says_what_is_missing_and_can_be_repeated() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| folder.path().join(name);
    simulate(&fixture("scenes/corridor.toml"), "--frames 3", &path("made.mcap"));
    std::fs::create_dir(path("captures")).expect("writable");
    add_signal(&path("made.mcap"), &path("captures/a.mcap"), false, |_, _, _| 0.0);
    let header = Recording::open(&path("made.mcap")).expect("opens").header();
    let none = RecordingWriter::create(&path("captures/none.mcap"), Format::Mcap, &header);
    none.and_then(RecordingWriter::finish).expect("writes");
    let spec = |label: &str| {
        let text = "format = 1\n[[recorded]]\nfolders = \"captures\"\nlabels = { \"*\" = \"LABEL\" }\n";
        std::fs::write(path("spec.toml"), text.replace("LABEL", label)).expect("writable");
        path("spec.toml")
    };
    let said = failure(build_command(&spec("spans"), &path("set")));
    assert!(said.contains("no source gave a map") && said.contains("hint: frames need a label"), "{said}");
    assert!(said.contains("none: no frame, and so no map"), "{said}");
    assert!(!path("set.parts").exists(), "{said}");
    assert_eq!(json_lines(build_command(&spec("empty"), &path("set"))).remove(0)["empty"], 3);
}

#[test]
fn a_build_by_subjects_names_recordings_of_people_without_one() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| folder.path().join(name);
    simulate(&fixture("scenes/corridor.toml"), "--frames 3", &path("made.mcap"));
    for name in ["ann/one_a", "bob/one_b", "one_x", "empty_e"] {
        let copy = path(&format!("captures/{name}.mcap"));
        std::fs::create_dir_all(copy.parent().expect("a parent")).expect("writable");
        std::fs::copy(path("made.mcap"), copy).expect("writable");
    }
    let text = "format = 1\nsplit = { by = \"subject\" }\n[[recorded]]\nfolders = \"captures\"\n\
                labels = { \"{subject}/one*\" = \"one\", \"one_x\" = \"one\", \"empty*\" = \"empty\" }\n";
    std::fs::write(path("spec.toml"), text).expect("writable");
    let (_, said) = success(build_command(&path("spec.toml"), &path("set")));
    assert!(said.contains("warning: 1 sequences with people have no subject: 'one_x'"), "{said}");
}

#[test]
fn shards_of_a_simulation_are_its_frames_cut_into_pieces() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| folder.path().join(name);
    let simulate = |options: &str| {
        let mut command = subcommand(&format!("scene simulate --frames 20 --seed 3 --json {options}"));
        json_lines(command.arg(fixture("scenes/corridor.toml")).arg("-o").arg(path("run.mcap"))).remove(0)
    };
    simulate("");
    let said: Vec<u64> = (0..3).map(|i| simulate(&format!("--shard {i}/3"))["frames"].as_u64().expect("n")).collect();
    assert_eq!(said, [6, 7, 7]);
    assert_eq!(simulate("--shard 1/3")["found"], true);
    let pieces: Vec<_> =
        (0..3).flat_map(|i| frames_and_gaps(&path(&format!("run-shard-{i:05}-of-00003.mcap"))).0).collect();
    assert!(
        pieces == frames_and_gaps(&path("run.mcap")).0,
        "the frames of the shards are those of the whole, numbers, times and truth too"
    );
}

/// Regression test: shards of one run were in several splits, so that a model was tested on a run that it had learnt from.
#[test]
fn shards_of_a_simulation_are_one_sequence() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| folder.path().join(name);
    std::fs::create_dir(path("captures")).expect("writable");
    for shard in ["0/3", "1/3", "2/3"] {
        let scene = fixture("scenes/corridor.toml");
        success(command!("scene simulate --frames 9 --shard", shard, scene, "-o", path("captures/run.mcap")));
    }
    let text = "format = 1\n[[recorded]]\nfolders = \"captures\"\nlabels = { \"*\" = \"empty\" }\n";
    json_lines(build_command(&write_file(folder.path(), "spec.toml", text), &path("set")));
    let manifest = std::fs::read_to_string(path("set/manifest.jsonl")).expect("reads");
    assert_eq!(manifest.lines().count(), 9);
    assert_eq!(manifest.matches("\"sequence\":\"run\"").count(), 9, "{manifest}");
    assert_eq!(manifest.matches("\"recording\":\"run-shard-00001-of-00003\"").count(), 3, "{manifest}");
}

/// Writes the hall scene with other values for these keys of its waveform.
fn write_hall(path: &Path, changes: &[(&str, &str)]) {
    let mut text = fixture_text("scenes/hall.toml");
    for (key, value) in changes {
        let line = text.lines().find(|line| line.starts_with(key)).expect("a key of the waveform").to_owned();
        text = text.replace(&line, &format!("{key} = {value}"));
    }
    std::fs::write(path, text).expect("writable");
}

#[test]
fn scenes_of_several_waveforms_make_one_dataset_on_physical_axes() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| folder.path().join(name);
    write_hall(&path("own.toml"), &[]);
    write_hall(
        &path("short.toml"),
        &[
            ("samples_per_chirp", "64"),
            ("chirps_per_frame", "16"),
            ("frame_interval_s", "0.05"),
            ("rx_antennas", "[1, 3]"),
        ],
    );
    write_hall(&path("slow.toml"), &[("chirp_interval_s", "500e-6"), ("end_frequency_hz", "61.1e9")]);
    write_hall(&path("narrow.toml"), &[("end_frequency_hz", "60.75e9")]);
    let axes =
        "physical_axes = { range_step_m = 0.15, range_bins = 64, velocity_step_m_per_s = 0.098, velocity_bins = 64 }";
    let write = |axes: &str, scenes: &[&str]| {
        let source = |scene: &&str| {
            format!("[[simulated]]\nscene = \"{scene}.toml\"\nseeds = [1, 2]\npeople = [0, 2]\nframes = 8\nevery = 4\n")
        };
        let sources: String = scenes.iter().map(source).collect();
        std::fs::write(path("spec.toml"), format!("format = 1\n[map]\n{axes}\n{sources}")).expect("writable");
        path("spec.toml")
    };
    let said = json_lines(build_command(&write(axes, &["own", "short", "slow"]), &path("set"))).remove(0);
    assert_eq!((said["maps"].as_u64(), said["units"].as_u64()), (Some(24), Some(12)), "{said}");
    let header = std::fs::read_to_string(path("set/dataset.json")).expect("reads");
    let header: serde_json::Value = serde_json::from_str(&header).expect("JSON");
    assert_eq!(header["waveform"]["request"]["samples_per_chirp"], 128, "the first waveform is the nominal one");
    assert_eq!(header["rdm_spec"]["physical_axes"]["velocity_bins"], 64);
    assert_eq!(header["shape"], serde_json::json!({ "rx": 1, "doppler": 64, "range": 64 }));

    fails_with(
        build_command(&write(axes, &["own", "narrow"]), &path("no")),
        &["the sampled band is 0.2", "0.300 GHz or more"],
    );
    let said = failure(build_command(&write("", &["own", "short"]), &path("no")));
    assert!(
        said.contains("sources of one dataset must agree")
            && said.contains("waveforms differ in map size")
            && said.contains("hint: leave one of them out"),
        "{said}"
    );
}

/// Asserts that a waveform in the spec gives the same maps as a scene with that waveform.
#[test]
fn a_spec_gives_a_scene_another_waveform() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| folder.path().join(name);
    write_hall(&path("own.toml"), &[]);
    write_hall(&path("short.toml"), &[("samples_per_chirp", "64"), ("chirps_per_frame", "16")]);
    let built = |scene: &str, waveform: &str, name: &str| {
        let axes =
            "physical_axes = { range_step_m = 0.15, range_bins = 64, velocity_step_m_per_s = 0.1, velocity_bins = 64 }";
        let source =
            format!("scene = \"{scene}.toml\"\n{waveform}\nseeds = [1, 2]\npeople = [1]\nframes = 8\nevery = 4\n");
        std::fs::write(path("spec.toml"), format!("format = 1\n[map]\n{axes}\n[[simulated]]\n{source}"))
            .expect("writable");
        build_command(&path("spec.toml"), &path(name))
    };
    json_lines(built("short", "", "expected"));
    json_lines(built("own", "waveform = { samples_per_chirp = 64, chirps_per_frame = 16 }", "given"));
    let (expected, given) = (read_files(&path("expected")), read_files(&path("given")));
    assert_eq!(expected.keys().collect::<Vec<_>>(), given.keys().collect::<Vec<_>>());
    let maps = expected.keys().find(|name| name.starts_with("maps")).expect("maps");
    assert!(!expected[maps].is_empty() && expected[maps] == given[maps], "{maps}");
    let samples = std::fs::read_to_string(path("given").join("dataset.json")).expect("reads");
    assert!(samples.contains("\"samples_per_chirp\": 64"), "{samples}");

    fails_with(built("own", "waveform = { chirps = 16 }", "no"), &["own.toml", "unknown field `chirps`"]);
}

#[test]
fn a_model_on_physical_axes_classifies_frames_of_another_waveform_and_reports_what_is_lost() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| folder.path().join(name);
    write_hall(
        &path("short.toml"),
        &[("samples_per_chirp", "64"), ("chirps_per_frame", "16"), ("rx_antennas", "[1, 3]")],
    );
    simulate(&path("short.toml"), "--people 1 --frames 6", &path("short.mcap"));
    let evaluate = |model: &Path| {
        let input = format!("{}=one", path("short.mcap").display());
        command!("model evaluate --json --thermal-snr-db=10,-40 --model", model, input)
    };
    let (told, said) = success(evaluate(&fixture("models/room-cnn.safetensors")));
    let answer: serde_json::Value = serde_json::from_str(&told).expect("JSON");
    assert_eq!(answer["recordings"][0]["frames"], 6, "{answer}");
    // Frames whose samples strong noise drives to the ends of the ADC were left out of the scores, and it was taken for a fault.
    for thermal in answer["thermal"].as_array().expect("a list") {
        let called = thermal["confusion"][1].as_array().expect("a row");
        assert_eq!(called.iter().filter_map(|count| count.as_u64()).sum::<u64>(), 6, "{thermal}");
    }
    assert!(!said.contains("ends of the ADC"), "{said}");
    // The message appears once, although the recording is judged twice.
    assert_eq!(said.matches("brought onto its axes").count(), 1, "{said}");
    assert!(said.contains("velocity resolution is 0.39 m/s, not 0.10 m/s"), "{said}");

    fails_with(evaluate(&model_of_one_waveform(folder.path())), &["waveforms differ in map size", "hint: "]);
}
