//! Recordings survive the end of the program that makes them. No file is replaced without the option, a recording has
//! one writer at a time, and a kill leaves a readable file.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use radome_driver::recording::Recording;
use radome_driver::{McapReader, Reconnect, Recorder, RecordingHeader};
use radome_dsp::{Frame, FrameSource, RxMask, SourceEvent, Waveform, WaveformRequest};
use radome_tests::running::{Running, wait_for};
use radome_tests::{
    command, convert, fails_with, failure, fixture, json_lines, labels_of, radome, root, success, success_at_once,
    write_file,
};

/// Waveform of one receiver at ten frames a second: 64 KiB a frame.
fn waveform() -> Waveform {
    let rx_antennas = RxMask::from_antennas(&[1]).expect("an antenna");
    Waveform::realise(WaveformRequest { rx_antennas, ..WaveformRequest::paper() }).expect("possible")
}

/// Writes a recording of noise, which hardly compresses.
fn write_noise(path: &Path, frames: u64) {
    let waveform = waveform();
    let mut recorder = Recorder::create(path, &RecordingHeader::new(waveform.clone())).expect("creates");
    let mut frame = Frame::zeroed(waveform.shape());
    let mut state = 1u64;
    for sequence in 0..frames {
        for code in &mut frame.codes {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            *code = (state >> 52) as u16;
        }
        frame.sequence = sequence;
        frame.time_ns = (sequence as f64 * waveform.frame_interval_s() * 1e9) as u64;
        recorder.frame(&frame).expect("records");
    }
    recorder.finish().expect("finishes");
}

/// Number of consecutive frames that can be read from the first on.
fn readable_frames(path: &Path) -> u64 {
    let mut source = Recording::open(path).unwrap_or_else(|e| panic!("{e}"));
    let mut frame = Frame::zeroed(source.waveform().shape());
    let mut count = 0;
    while source.next_frame(&mut frame).unwrap_or_else(|e| panic!("{e}")) == SourceEvent::Frame {
        assert_eq!(frame.sequence, count);
        count += 1;
    }
    count
}

fn is_complete(path: &Path) -> bool {
    McapReader::open(path).expect("opens").is_complete()
}

/// Number of frames in an unfinished recording so far.
fn frames_so_far(path: &Path) -> u64 {
    McapReader::open(path).ok().and_then(|reader| reader.frame_count()).unwrap_or(0)
}

fn files(folder: &Path) -> Vec<PathBuf> {
    let mut files: Vec<PathBuf> =
        std::fs::read_dir(folder).expect("lists").map(|entry| entry.expect("an entry").path()).collect();
    files.sort();
    files
}

/// Commands that record, without their source.
const RECORDERS: [&[&str]; 2] = [&["record"], &["live", "--model", "cfar", "--json"]];

#[test]
fn an_output_that_exists_is_refused_and_stays_as_it_is() {
    let folder = tempfile::tempdir().expect("a folder");
    let kept = write_file(folder.path(), "kept.mcap", "a night of frames");
    let sources = tempfile::tempdir().expect("a folder");
    write_noise(&sources.path().join("noise.mcap"), 3);
    let plain = sources.path().join("noise.mcap").display().to_string();
    let input = |name: &str| fixture(name).display().to_string();
    let judged = input("formats/judged.mcap");
    let model = input("models/desk-hqnn.safetensors");
    let scene = input("scenes/desk.toml");
    let commands: [&[&str]; 11] = [
        &["record", &plain, "-o"],
        &["live", &plain, "--model", "cfar", "-o"],
        &["scene", "simulate", &scene, "--frames", "2", "-o"],
        &["recording", "convert", &plain],
        &["recording", "repair", &plain, "-o"],
        &["recording", "maps", &plain, "-o"],
        &["model", "export", &model, "-o"],
        &["model", "background", &plain, "--model", "cfar", "-o"],
        &["model", "train", "no-dataset", "-o"],
        &["recording", "labels", &plain, "--export"],
        &["recording", "answers", &judged, "--csv"],
    ];
    for command in commands {
        fails_with(radome().args(command).arg(&kept), &["kept.mcap exists already", "--overwrite"]);
        assert_eq!(std::fs::read(&kept).expect("readable"), b"a night of frames", "{command:?}");
        assert_eq!(files(folder.path()), std::slice::from_ref(&kept), "{command:?}");
    }
    let replaces =
        |command: &&&[&str]| command[..2].iter().any(|word| ["record", "simulate", "convert", "maps"].contains(word));
    // An ONNX file has no other name.
    let onnx = write_file(sources.path(), "kept.onnx", "a night of frames");
    fails_with(command!("model export", &model, "-o", &onnx), &["kept.onnx exists already", "--overwrite"]);
    success(command!("model export --overwrite", &model, "-o", &onnx));
    assert_ne!(std::fs::read(&onnx).expect("readable"), b"a night of frames");
    for command in commands.iter().filter(replaces) {
        std::fs::write(&kept, "a night of frames").expect("writable");
        success(radome().args(*command).arg(&kept).arg("--overwrite"));
        assert_ne!(std::fs::read(&kept).expect("readable"), b"a night of frames", "{command:?}");
        assert_eq!(files(folder.path()), std::slice::from_ref(&kept), "{command:?}");
    }
}

/// Command line that systemd makes from the packaged unit.
fn service_command(source: &Path, options: &[&str]) -> Command {
    let unit = std::fs::read_to_string(root().join("packaging/systemd/radome@.service")).expect("packaged");
    let line = unit.lines().find_map(|line| line.strip_prefix("ExecStart=")).expect("a command");
    let mut command = radome();
    for word in line.split_whitespace().skip(1) {
        match word {
            "${RADOME_SOURCE}" => command.arg(source),
            "${RADOME_MODEL}" => command.arg("cfar"),
            "$RADOME_OPTIONS" => command.args(options),
            word => command.arg(word),
        };
    }
    command
}

#[test]
fn a_service_that_starts_again_records_to_another_file() {
    let folder = tempfile::tempdir().expect("a folder");
    let (source, nights) = (folder.path().join("source.mcap"), folder.path().join("nights"));
    write_noise(&source, 12);
    std::fs::create_dir(&nights).expect("creates");
    let output = format!("{}/", nights.display());
    let mut before: Vec<(PathBuf, Vec<u8>)> = Vec::new();
    for run in 1..=3 {
        success(service_command(&source, &["-o", &output]));
        for (path, bytes) in &before {
            assert!(&std::fs::read(path).expect("readable") == bytes, "{} has changed", path.display());
        }
        let now = files(&nights);
        assert_eq!(now.len(), run, "{now:?}");
        assert!(now.iter().all(|path| readable_frames(path) == 12 && is_complete(path)));
        before = now.into_iter().map(|path| (path.clone(), std::fs::read(&path).expect("readable"))).collect();
    }
    // With a file name instead of a folder, the second start of the service is refused.
    let one = folder.path().join("one.mcap").display().to_string();
    success(service_command(&source, &["-o", &one]));
    assert!(failure(service_command(&source, &["-o", &one])).contains("exists already"));
}

#[test]
fn the_time_replaces_its_placeholder_in_a_name() {
    let folder = tempfile::tempdir().expect("a folder");
    let source = folder.path().join("source.mcap");
    write_noise(&source, 6);
    let pattern = folder.path().join("night-{time}.mcap");
    for _ in 0..2 {
        let said = json_lines(command!("record --json", &source, "-o", &pattern)).remove(0);
        let file = PathBuf::from(said["file"].as_str().expect("a name"));
        assert_eq!(readable_frames(&file), 6);
        let name = file.file_name().expect("a name").to_string_lossy().into_owned();
        let time = name.strip_prefix("night-20").expect("this century");
        assert!(time[6..].starts_with('T') && time.contains('Z') && time.ends_with(".mcap"), "{name}");
    }
    assert_eq!(files(folder.path()).len(), 3);
}

#[test]
fn runs_that_begin_at_once_in_one_folder_record_to_a_file_each() {
    let folder = tempfile::tempdir().expect("a folder");
    let (source, nights) = (folder.path().join("source.mcap"), folder.path().join("nights"));
    write_noise(&source, 6);
    std::fs::create_dir(&nights).expect("creates");
    let runs = RECORDERS.repeat(3).into_iter().map(|arguments| {
        let mut command = radome();
        command.args(arguments).arg(&source).arg("-o").arg(&nights);
        command
    });
    success_at_once(runs);
    let made = files(&nights);
    assert!(made.len() == 6 && made.iter().all(|path| readable_frames(path) == 6 && is_complete(path)), "{made:?}");
}

#[test]
fn the_watchdog_waits_longer_than_a_lost_board_is_searched_for() {
    let unit = std::fs::read_to_string(root().join("packaging/systemd/radome@.service")).expect("packaged");
    let seconds = unit.lines().find_map(|line| line.strip_prefix("WatchdogSec=")).expect("a watchdog");
    let watchdog = Duration::from_secs(seconds.parse().expect("seconds"));
    assert!(watchdog >= 2 * Reconnect::default().give_up_after, "{watchdog:?}");
}

#[test]
fn a_second_writer_is_refused_while_the_first_goes_on() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name);
    write_noise(&at("source.mcap"), 600);
    let made = at("made.mcap");
    let mut recorder = Running::start(command!("record --json", at("source.mcap"), "--speed 1 -o", &made));
    wait_for("frames in the file", || (frames_so_far(&made) >= 5).then_some(()));
    let busy = "another program is writing to it";
    let source = at("source.mcap");
    assert!(failure(command!("record", &source, "-o", &made)).contains("exists already"));
    assert!(failure(command!("record", &source, "--overwrite -o", &made)).contains(busy));
    assert!(failure(command!("recording convert", &source, &made, "--overwrite")).contains(busy));
    std::fs::write(at("track.txt"), "0.0\t0.3\tone\n").expect("writable");
    fails_with(command!("recording labels", &made, "--import", at("track.txt")), &[busy, "made.mcap"]);
    recorder.signal("INT");
    assert!(recorder.wait().success(), "{:?}", recorder.stderr.all());
    assert!(is_complete(&made) && readable_frames(&made) >= 5);
    // The waiting writer may now write.
    json_lines(command!("recording labels --json", &made, "--import", at("track.txt")));
    assert_eq!(McapReader::open(&made).expect("opens").labels().expect("labels").len(), 1);
    assert_eq!(files(folder.path()), [made, source, at("track.txt")]);
}

#[test]
fn labels_that_are_imported_at_once_are_all_stored() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name);
    write_noise(&at("a.mcap"), 20);
    convert(&at("a.mcap"), &at("b.txt"));
    // Labels of a text recording are in a file beside it.
    for recording in ["a.mcap", "b.txt"] {
        success_at_once((0..8).map(|k| {
            let track = at(&format!("{k}-track.txt"));
            std::fs::write(&track, format!("0.{k}\t0.{k}5\tone\n")).expect("writable");
            command!("recording labels --json", at(recording), "--import", track)
        }));
        let labels = labels_of(&at(recording));
        let mut starts: Vec<f64> = labels.iter().map(|label| label["start_s"].as_f64().expect("a start")).collect();
        starts.sort_by(f64::total_cmp);
        assert_eq!(starts, [0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7], "{recording}");
    }
    assert_eq!(readable_frames(&at("a.mcap")), 20);
}

/// Asserts that SIGKILL leaves the written frames, releases the lock, and that the file name is not used again.
#[test]
fn a_recorder_that_is_killed_leaves_what_it_had_written() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name);
    write_noise(&at("source.mcap"), 600);
    for (name, command) in [("record.mcap", &["record"][..]), ("live.mcap", &["live", "--model", "cfar"][..])] {
        let made = at(name);
        let mut recorder =
            Running::start(radome().args(command).arg(at("source.mcap")).args(["--speed", "1", "-o"]).arg(&made));
        let seen = wait_for("frames in the file", || Some(frames_so_far(&made)).filter(|count| *count >= 20));
        recorder.signal("KILL");
        recorder.wait();
        let count = readable_frames(&made);
        assert!(count >= seen && !is_complete(&made), "{count} of {seen}");
        let repaired = at(&format!("repaired-{name}"));
        // The exit status reports that the end was lost.
        command!("recording repair", &made, "-o", &repaired).output().expect("runs");
        assert!(readable_frames(&repaired) == count && is_complete(&repaired));
        fails_with(command!("record", at("source.mcap"), "-o", &made), &["exists already"]);
        assert_eq!(readable_frames(&made), count);
    }
}
