//! Datasets: the same bytes after kills, in shards and out of order; labelled folders of every kind; what is wrong is said.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use radome_tests::{failure, fixture, json_lines, radome};

/// A spec of `runs` short runs of the paper's two scenes; every unit takes a moment.
fn spec(folder: &Path, runs: u64, more: &str) -> PathBuf {
    let path = folder.join("spec.toml");
    let scene = |name: &str| fixture(&format!("scenes/{name}.toml")).canonicalize().expect("a scene");
    let text = format!(
        r#"format = 1
{more}
[map]
scale = "minus_one_to_one"
channels = {{ one = 0 }}
chirp_mean_removal = false
static_removal = "slow_time_mean"
range_window = "hann"
doppler_window = "hann"
slow_time = "chirps"
amplitude = "unnormalised"
floor_db = -200.0
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
    std::fs::write(&path, text).expect("writable");
    path
}

fn build(spec: &Path, output: &Path) -> Command {
    let mut command = radome();
    command.args(["dataset", "build"]).arg(spec).arg("-o").arg(output).arg("--json");
    command
}

/// Every file of a dataset with its content.
fn files(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let entries = std::fs::read_dir(folder).expect("a folder").map(|entry| entry.expect("an entry"));
    entries.map(|e| (e.file_name().to_string_lossy().into_owned(), std::fs::read(e.path()).expect("reads"))).collect()
}

fn names(folder: &Path) -> Vec<String> {
    files_of(folder).into_iter().collect()
}

fn files_of(folder: &Path) -> std::collections::BTreeSet<String> {
    let Ok(entries) = std::fs::read_dir(folder) else { return Default::default() };
    entries.flatten().map(|e| e.file_name().to_string_lossy().into_owned()).collect()
}

/// Starts a build and kills it, without a word, when it has made some units and not all.
fn kill_midway(command: &mut Command, parts: &Path, after: usize) {
    let mut child = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().expect("starts");
    let until = Instant::now() + Duration::from_secs(300);
    let done = || files_of(parts).iter().filter(|n| n.starts_with("unit-") && !n.ends_with(".partial")).count();
    while done() < after && child.try_wait().expect("a child").is_none() {
        assert!(Instant::now() < until, "no unit was ever made");
        std::thread::sleep(Duration::from_millis(2));
    }
    // SIGKILL.
    let _ = child.kill();
    child.wait().expect("ended");
}

#[test]
fn a_build_killed_over_and_over_gives_the_bytes_of_one_that_was_not() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| folder.path().join(name);
    let spec = spec(folder.path(), 8, "");
    let said = json_lines(&mut build(&spec, &path("whole"))).remove(0);
    assert_eq!((said["maps"].as_u64(), said["units"].as_u64(), said["units_found"].as_u64()), (Some(38), Some(10), Some(0)));

    for after in [1, 3, 6] {
        kill_midway(&mut build(&spec, &path("again")), &path("again.parts"), after);
        assert!(!path("again").exists() || after == 6);
    }
    if !path("again").exists() {
        // Whoever changes the spec meanwhile is told so, and nothing is lost.
        let text = std::fs::read_to_string(&spec).expect("reads");
        std::fs::write(&spec, text.replace("every = 50", "every = 25")).expect("writable");
        let said = failure(&mut build(&spec, &path("again")));
        assert!(said.contains("again.parts holds the beginning of another build, made from another spec"), "{said}");
        std::fs::write(&spec, text).expect("writable");
        let said = json_lines(&mut build(&spec, &path("again"))).remove(0);
        assert!(said["units_found"].as_u64() >= Some(3), "{said}");
    }
    assert_eq!(files(&path("again")), files(&path("whole")));
    assert_eq!(names(folder.path()), ["again", "spec.toml", "whole"], "nothing else is left");
    let said = failure(&mut build(&spec, &path("again")));
    assert!(said.contains("again exists already"), "{said}");
}

#[test]
fn eight_shards_of_which_one_was_killed_merge_to_the_single_builds_bytes() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| folder.path().join(name);
    let spec = spec(folder.path(), 16, "split = { by = \"sequence\", test = 0.25, validation = 0.25 }");
    json_lines(&mut build(&spec, &path("single")));
    let shard = |index: usize| {
        let mut command = build(&spec, &path("shards"));
        command.args(["--shard", "auto/8"]).env("SLURM_ARRAY_TASK_ID", index.to_string());
        command
    };
    // Out of order, as arrays run; one killed, and one asked for twice.
    for index in [3, 0, 7, 5, 1, 6, 2] {
        json_lines(&mut shard(index));
    }
    kill_midway(&mut shard(4), &path("shards/shard-00004-of-00008.parts"), 1);
    let all = |skip: Option<usize>| {
        let shards = (0..8).filter(move |i| Some(*i) != skip);
        shards.map(|i| folder.path().join(format!("shards/shard-{i:05}-of-00008"))).collect::<Vec<_>>()
    };
    let merge = |parts: &[PathBuf], output: &str| {
        let mut command = radome();
        command.args(["dataset", "merge", "--json"]).args(parts).arg("-o").arg(folder.path().join(output));
        command
    };
    if !path("shards/shard-00004-of-00008").exists() {
        let said = failure(&mut merge(&all(Some(4)), "merged"));
        assert!(said.contains("shards 4 of 8 are missing") && said.contains("--shard 4/8"), "{said}");
    }
    json_lines(&mut shard(4));
    assert_eq!(json_lines(&mut shard(2)).remove(0)["units_found"], 2, "a shard that is there is not made again");
    json_lines(&mut merge(&all(None), "merged"));
    assert_eq!(files(&path("merged")), files(&path("single")));
    let report = json_lines(radome().args(["dataset", "verify", "--json"]).arg(path("merged"))).remove(0);
    assert!(report["maps"] == 70 && report["split_maps"].as_array().is_some_and(|n| n.iter().all(|n| *n != 0)), "{report}");

    // Doubled and foreign ones.
    let mut doubled = all(None);
    doubled.push(path("copy"));
    assert!(Command::new("cp").arg("-r").arg(&doubled[6]).arg(path("copy")).status().expect("cp").success());
    let said = failure(&mut merge(&doubled, "no"));
    assert!(said.contains("copy are both shard 6/8"), "{said}");
    let other = folder.path().join("other.toml");
    let text = std::fs::read_to_string(&spec).expect("reads");
    std::fs::write(&other, text.replace("seeds = [5, 6]", "seeds = [6, 7]")).expect("writable");
    json_lines(build(&other, &path("other")).args(["--shard", "6/8"]));
    let mut foreign = all(Some(6));
    foreign.push(path("other/shard-00006-of-00008"));
    let said = failure(&mut merge(&foreign, "no"));
    assert!(said.contains("shard-00006-of-00008 is no shard of the build of") && said.contains("another spec"), "{said}");
    assert!(!path("no").exists());
}

#[test]
fn two_builds_at_once_in_one_place_are_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| folder.path().join(name);
    let spec = spec(folder.path(), 400, "");
    let mut first = build(&spec, &path("set")).stdout(Stdio::null()).stderr(Stdio::null()).spawn().expect("starts");
    while !path("set.parts/plan.json").exists() {
        assert!(first.try_wait().expect("a child").is_none(), "ended before it began");
        std::thread::sleep(Duration::from_millis(2));
    }
    let said = failure(&mut build(&spec, &path("set")));
    let _ = first.kill();
    first.wait().expect("ended");
    assert!(said.contains("set.parts: another process is at work here"), "{said}");
}

#[test]
fn a_zero_sigma_is_not_hidden() {
    let folder = tempfile::tempdir().expect("a folder");
    let spec = spec(folder.path(), 4, "");
    json_lines(&mut build(&spec, &folder.path().join("set")));
    let stats = |set: &Path| {
        let mut command = radome();
        command.args(["dataset", "stats", "--json"]).arg(set);
        command
    };
    let table = json_lines(&mut stats(&folder.path().join("set"))).remove(0);
    let row = |scene: &str, class: &str| {
        let rows = table.as_array().expect("a list");
        rows.iter().find(|r| r["scene"] == scene && r["class"] == class).unwrap_or_else(|| panic!("{scene} {class}"))
    };
    let empty = row("corridor", "empty");
    // The receiver's noise: 5.57 dB for any radar.
    assert!((empty["sigma_db"].as_f64().expect("a number") - 5.6).abs() < 0.1 && empty["domain"] == "sim", "{empty}");
    assert!(empty["raised_fraction"].is_null() && empty["mean_db"].is_number(), "{empty}");
    let two = row("corridor", "two");
    let (fraction, level) = (two["raised_fraction"].as_f64(), two["raised_level_db"].as_f64());
    assert!(fraction > Some(0.002) && fraction < Some(0.2) && level > Some(4.0) && level < Some(40.0), "{two}");

    // The same without a receiver's noise, as in the paper: every cell of an empty map lies at the floor.
    let text = std::fs::read_to_string(&spec).expect("reads");
    std::fs::write(&spec, text.replace("floor_db = -200.0", "floor_db = 50.0")).expect("writable");
    json_lines(&mut build(&spec, &folder.path().join("flat")));
    let output = stats(&folder.path().join("flat")).output().expect("runs");
    let (table, said) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.code() == Some(1) && table.contains("\"sigma_db\":0.0"), "{table}");
    assert!(said.contains("sigma is zero in sim corridor empty (all cells at 50.00 dB)"), "{said}");
    // And verify finds that these maps are all the same.
    let said = failure(radome().args(["dataset", "verify"]).arg(folder.path().join("flat")));
    assert!(said.contains("1 groups of duplicates"), "{said}");
}
