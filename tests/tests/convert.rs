//! Tests of conversions between formats, and of recorders that are killed.

use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::Duration;

use radome_driver::LabelSpan;
use radome_driver::recording::{Format, Recording, RecordingWriter};
use radome_dsp::{Frame, FrameSource, Gap, GapReason};
use radome_tests::{
    command, convert, fails_with, failure, fixture, frames_and_gaps, json_lines_of, labels_of, radome, shared,
    simulate, subcommand, success, with_file_size_limit, wrong_use_with,
};
use serde_json::Value;

/// All frames of a recording, and the number of lost frames.
fn read_frames(path: &Path) -> (Vec<Frame>, u64) {
    let (frames, gaps) = frames_and_gaps(path);
    (frames, gaps.iter().map(|gap| gap.frames).sum())
}

fn simulate_desk(path: &Path, frames: &str) {
    simulate(&fixture("scenes/corridor.toml"), &format!("--frames {frames} --seed 5"), path);
}

fn codes(frames: &[Frame]) -> Vec<&[u16]> {
    frames.iter().map(|frame| frame.codes.as_slice()).collect()
}

#[test]
fn a_simulation_becomes_a_folder_and_a_text_file() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name);
    simulate_desk(&at("x.mcap"), "15");
    let (told, said) = success(command!("recording convert --json", at("x.mcap"), at("session/")));
    assert!(said.contains("truth of 15 frames"), "{said}");
    let report: Value = serde_json::from_str(&told).expect("JSON");
    assert_eq!((&report["frames"], &report["gaps"], &report["lost"]), (&15.into(), &0.into(), &0.into()));

    let (frames, _) = read_frames(&at("x.mcap"));
    let bytes = std::fs::read(at("session/RadarIfxAvian_00/radar.npy")).expect("an array");
    let array = npyz::NpyFile::new(bytes.as_slice()).expect("an array");
    assert_eq!(array.shape(), [15, 3, 128, 256]);
    let samples: Vec<u16> = array.into_vec().expect("codes");
    assert!(samples == codes(&frames).concat());
    assert_eq!(report["written"], bytes.len());

    convert(&at("session"), &at("y.txt"));
    convert(&at("y.txt"), &at("z.mcap"));
    assert!(codes(&read_frames(&at("z.mcap")).0) == codes(&frames));
    let waveform = |name: &str| Recording::open(&at(name)).expect("opens").waveform().clone();
    assert_eq!(waveform("z.mcap"), waveform("x.mcap"));
}

#[test]
fn the_real_recording_is_unchanged_after_conversion_there_and_back() {
    let Some(real) = shared("data/recordings/breathing-person-20260106") else { return };
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name);
    let report = convert(&real, &at("real.mcap"));
    assert_eq!((&report["frames"], &report["lost"]), (&256.into(), &0.into()));
    convert(&at("real.mcap"), &at("back"));
    let file = |root: &Path, name: &str| std::fs::read(root.join("RadarIfxAvian_00").join(name)).expect("reads");
    assert!(file(&real, "radar.npy") == file(&at("back"), "radar.npy"));
    let config = |root: &Path| serde_json::from_slice::<Value>(&file(root, "config.json")).expect("JSON");
    assert_eq!(config(&real), config(&at("back")));
    assert_eq!(read_frames(&real), read_frames(&at("back")));
}

#[test]
fn a_recording_cut_in_two_is_repaired() {
    let folder = tempfile::tempdir().expect("a folder");
    let (cut, fixed) = (folder.path().join("cut.mcap"), folder.path().join("fixed.mcap"));
    simulate_desk(&cut, "35");
    let (whole, _) = read_frames(&cut);
    let bytes = std::fs::read(&cut).expect("reads");
    std::fs::write(&cut, &bytes[..bytes.len() / 2]).expect("writes");
    let report = json_lines_of(command!("recording repair --json", &cut, "-o", &fixed), &[3]).remove(0);
    let (frames, _) = read_frames(&fixed);
    assert!(frames.len() >= 10 && frames == whole[..frames.len()]);
    assert_eq!((&report["frames"], &report["was_finished"]), (&frames.len().into(), &false.into()));
    assert!(report["lost_bytes"].as_u64().is_some_and(|bytes| bytes > 0));
    assert!(std::fs::read(&cut).expect("reads") == bytes[..bytes.len() / 2]);
    // A conversion is no success either, and the copy, which is finished, says that its end may be missing.
    let copy = folder.path().join("copy.mcap");
    let report = json_lines_of(command!("recording convert --json", &cut, &copy), &[3]).remove(0);
    assert_eq!((&report["frames"], &report["gaps_of_unknown_length"]), (&frames.len().into(), &1.into()));
    let (frames, gaps) = radome_tests::frames_and_gaps(&copy);
    assert!(frames == whole[..frames.len()], "{} frames", frames.len());
    let end = Gap { first_sequence: frames.len() as u64, frames: 0, reason: GapReason::Recorded };
    assert_eq!(gaps, [end]);
}

/// Only the first radar of a session was converted, and data behind its frames were left out, without a word.
#[test]
fn parts_of_a_session_that_are_left_out_are_reported() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name);
    for radar in ["session/RadarIfxAvian_00", "session/RadarIfxAvian_01"] {
        std::fs::create_dir_all(at(radar)).expect("creates");
        for file in std::fs::read_dir(fixture("formats/infineon/RadarIfxAvian_00")).expect("lists") {
            let file = file.expect("an entry");
            std::fs::copy(file.path(), at(radar).join(file.file_name())).expect("copies");
        }
    }
    let (_, said) = success(command!("recording convert", at("session"), at("a.mcap")));
    assert!(said.contains("2 radars; only RadarIfxAvian_00 is read"), "{said}");
    let second = at("session/RadarIfxAvian_01");
    let data = std::fs::read(second.join("radar.npy")).expect("reads");
    std::fs::write(second.join("radar.npy"), [data.as_slice(), &[0; 7]].concat()).expect("writes");
    let (_, said) = success(command!("recording convert", &second, at("b.mcap")));
    assert!(said.contains("7 bytes behind the 8 frames") && !said.contains("radars"), "{said}");
}

/// Kills a recorder at a random moment; returns the numbers of frames that it was given and that can be read.
///
/// The recorder says on stderr which frames it has, so that no clock is needed to know what must be there.
fn kill_recorder(arguments: &[&str], path: &Path, draw: &mut dyn FnMut(u64) -> u64, whole: &[Frame]) -> (usize, usize) {
    let mut child = radome()
        .args(arguments)
        .arg(path)
        .env("RADOME_LOG", "radome_driver::recording=trace")
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .expect("runs");
    let mut stderr = BufReader::new(child.stderr.take().expect("piped"));
    let mut said = String::new();
    let wait_for = draw(whole.len() as u64 - 10);
    let mut seen = 0;
    while seen < wait_for {
        let start = said.len();
        assert!(stderr.read_line(&mut said).expect("reads") > 0, "ended after {seen} frames: {said}");
        seen += u64::from(said[start..].contains("frame recorded"));
    }
    std::thread::sleep(Duration::from_micros(draw(60_000)));
    child.kill().expect("kill -9");
    child.wait().expect("ends");
    stderr.read_to_string(&mut said).expect("reads");
    let given = said.matches("frame recorded").count();
    let (frames, lost) = match path.exists() && std::fs::metadata(path).expect("there").len() > 0 {
        true => read_frames(path),
        // The file has no content yet.
        false => (Vec::new(), 0),
    };
    assert!(frames.len() <= given + 1 && lost == 0, "{given} frames given, {} read", frames.len());
    for (frame, expected) in frames.iter().zip(whole) {
        assert!(frame.sequence == expected.sequence && frame.codes == expected.codes);
    }
    if let Some(last) = given.checked_sub(1).and_then(|last| whole.get(last)) {
        // A board's clock counts microseconds.
        let due = whole.iter().filter(|frame| frame.time_ns + 1_000_010_000 <= last.time_ns).count();
        assert!(frames.len() >= due, "{given} frames given, {due} due, {} read", frames.len());
    }
    (given, frames.len())
}

/// Asserts what `kill -9` at random moments leaves, for 100 recorders where `RADOME_LONG` is set.
#[test]
#[allow(clippy::print_stderr)]
fn a_killed_recorder_leaves_all_but_the_last_second() {
    let folder = tempfile::tempdir().expect("a folder");
    let reference = folder.path().join("whole.mcap");
    simulate_desk(&reference, "60");
    let (whole, _) = read_frames(&reference);
    let scene = fixture("scenes/corridor.toml").display().to_string();
    let emulated = format!("emulated:{scene}");
    let mut state = 0x2026_1121_u64;
    let mut draw = |below: u64| {
        state = state.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mixed = (state ^ state >> 30).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        (mixed ^ mixed >> 31) % below
    };
    let rounds = if std::env::var_os("RADOME_LONG").is_some() { 100 } else { 10 };
    let (mut worst, mut frames_given) = (0, 0);
    for round in 0..rounds {
        let path = folder.path().join(format!("{round}.mcap"));
        let simulate = ["scene", "simulate", &scene, "--frames", "60", "--seed", "5", "-o"];
        let record = ["record", &emulated, "--frames", "60", "--seed", "5", "-o"];
        let arguments: &[&str] = if round % 2 == 0 { &simulate } else { &record };
        let (given, read) = kill_recorder(arguments, &path, &mut draw, &whole);
        worst = worst.max(given.saturating_sub(read));
        frames_given += given;
        // The file does not exist if the recorder was killed before it created it.
        let _ = std::fs::remove_file(&path);
    }
    eprintln!(
        "{rounds} recorders killed after {frames_given} frames; at most {worst} frames, all of the last second, lost"
    );
    assert!(worst > 0, "no recorder was killed with frames on its hands: the test tests nothing");
}

mod hard_cases {
    use super::*;

    fn partial_files(folder: &Path) -> Vec<PathBuf> {
        std::fs::read_dir(folder).expect("lists").flatten().map(|entry| entry.path()).collect()
    }

    /// Labels beside a recording of another format were dropped without a word.
    #[test]
    fn labels_beside_a_recording_are_converted_with_it() {
        let folder = tempfile::tempdir().expect("a folder");
        let at = |name: &str| folder.path().join(name);
        simulate_desk(&at("x.mcap"), "6");
        for input in ["session", "y.txt"] {
            convert(&at("x.mcap"), &at(input));
            let mut label = subcommand("recording label --span 0:0.2=empty --span 0.2:0.5=one");
            success(label.arg(at(input)));
            let native = at(&format!("{input}.mcap"));
            convert(&at(input), &native);
            let labels = labels_of(&native);
            let names: Vec<_> = labels.iter().map(|label| label["label"].as_str()).collect();
            assert_eq!(names, [Some("empty"), Some("one")], "{input}");
        }
        // A format that cannot hold them says so.
        let (_, said) = success(command!("recording convert", at("session"), at("z.txt")));
        assert!(said.contains("not held by this format: 2 labels"), "{said}");
    }

    /// Labels that cannot be read were found after all frames had been converted, and labels behind the end were not told of.
    #[test]
    fn labels_beside_a_recording_are_checked() {
        let folder = tempfile::tempdir().expect("a folder");
        let at = |name: &str| folder.path().join(name);
        simulate_desk(&at("x.mcap"), "6");
        convert(&at("x.mcap"), &at("y.txt"));
        let converted = || command!("recording convert", at("y.txt"), at("z.mcap"));
        std::fs::write(at("y.label"), "no labels").expect("writes");
        fails_with(converted(), &["the labels of", "hint: ", "y.label", "move it away"]);
        assert!(!at("z.mcap").exists());
        std::fs::write(
            at("y.label"),
            "Time(Seconds),Length(Seconds),Label(string),Confidence(double),Comment(string)\n0,1000,one,,\n",
        )
        .expect("writes");
        let (_, said) = success(converted());
        assert!(said.contains("the label 'one' from 0 to 1000 s is out of range"), "{said}");
        assert_eq!(labels_of(&at("z.mcap")).len(), 1);
    }

    /// Labels were offered to recordings whose frames have other times: behind gaps, which text closes, and in a folder
    /// with dates, which begins at 0 s.
    #[test]
    fn labels_are_offered_only_where_frames_keep_their_times() {
        let folder = tempfile::tempdir().expect("a folder");
        let at = |name: &str| folder.path().join(name);
        let whole = fixture("formats/recording.mcap");
        let said = |from: &Path, to: &str| success(command!("recording convert", from, at(to))).1;
        let offered = said(&whole, "session");
        assert!(offered.contains("hint: radome recording label"), "{offered}");
        assert!(offered.contains("session/radome.label writes the labels beside it"), "{offered}");

        let later = at("later.mcap");
        let header = Recording::open(&whole).expect("opens").header();
        let mut writer = RecordingWriter::create(&later, Format::Mcap, &header).expect("creates");
        read_frames(&whole).0.iter().skip(1).for_each(|frame| writer.frame(frame).expect("writes"));
        writer.label(&LabelSpan::new(0.4, 1.6, "one")).expect("writes");
        writer.finish().expect("finishes");
        let moved = said(&later, "later");
        assert!(moved.contains("not held by this format: the time of the first frame, 0.4 s"), "{moved}");
        for (said, shift) in [(said(&whole, "y.txt"), "0.800 s"), (moved, "0.400 s")] {
            assert!(said.contains(&format!("times of frames differ by up to {shift}")), "{said}");
            assert!(!said.contains("writes the labels beside it"), "{said}");
        }
    }

    /// A file of labels that was there before became the labels of a new text recording.
    #[test]
    fn labels_of_an_earlier_text_recording_are_not_taken_over() {
        let folder = tempfile::tempdir().expect("a folder");
        let at = |name: &str| folder.path().join(name);
        std::fs::write(at("y.label"), "").expect("writes");
        let converted = command!("recording convert", fixture("formats/recording.mcap"), at("y.txt"));
        fails_with(converted, &["y.label holds the labels of", "hint: move it away"]);
        assert_eq!(partial_files(folder.path()), [at("y.label")]);
    }

    /// A text recording or a folder that is cut was said to be finished, and a folder to have the frames that it lacks.
    #[test]
    fn recordings_of_other_formats_that_are_cut_are_not_finished() {
        let folder = tempfile::tempdir().expect("a folder");
        let at = |name: &str| folder.path().join(name);
        simulate_desk(&at("x.mcap"), "4");
        for (name, samples) in [("y.txt", "y.txt"), ("session", "session/RadarIfxAvian_00/radar.npy")] {
            convert(&at("x.mcap"), &at(name));
            let info = || {
                let info = json_lines_of(command!("recording info --json", at(name)), &[0]).remove(0);
                (info["finished"].as_bool(), info["frames"].as_u64())
            };
            assert_eq!(info(), (Some(true), Some(4)), "{name}");
            let bytes = std::fs::read(at(samples)).expect("reads");
            std::fs::write(at(samples), &bytes[..bytes.len() - 100]).expect("writes");
            assert_eq!(info(), (Some(false), Some(3)), "{name}");
            let (_, said) = success(command!("recording info", at(name)));
            assert!(said.contains("the recording is cut short"), "{said}");
            // Nothing is converted by halves, but the frames before the cut are not lost.
            fails_with(command!("recording convert", at(name), at("z.mcap")), &["cut short", "hint: radome record"]);
            failure(command!("record --overwrite -o", at("kept.mcap"), at(name)));
            assert_eq!(read_frames(&at("kept.mcap")).0.len(), 3, "{name}");
        }
    }

    /// Asserts that a full disk ends the recording; a file-size limit stands for it.
    #[test]
    fn a_full_disk_leaves_nothing_that_looks_whole() {
        let source = tempfile::tempdir().expect("a folder");
        let input = source.path().join("x.mcap");
        simulate_desk(&input, "12");
        for name in ["session", "y.txt", "y.mcap"] {
            let folder = tempfile::tempdir().expect("a folder");
            let output = folder.path().join(name);
            let mut convert = with_file_size_limit(1000, subcommand("recording convert").arg(&input).arg(output));
            fails_with(&mut convert, &[name, "cannot be"]);
            assert!(partial_files(folder.path()).is_empty());
        }
    }

    /// Regression test: the writer for viewers panicked where the disk was full as a chunk began.
    #[test]
    fn a_full_disk_ends_an_export_for_viewers_by_an_error() {
        let folder = tempfile::tempdir().expect("a folder");
        let output = folder.path().join("v.mcap");
        let input = fixture("formats/judged.mcap");
        let said =
            failure(with_file_size_limit(0, subcommand("recording convert --to viewers").arg(input).arg(&output)));
        assert!(said.contains("cannot write the file for viewers") && !said.contains("internal error"), "{said}");
        assert!(partial_files(folder.path()).is_empty());
    }

    #[test]
    fn wrong_inputs_and_outputs_are_refused_and_nothing_is_left() {
        let folder = tempfile::tempdir().expect("a folder");
        let at = |name: &str| folder.path().join(name);
        simulate_desk(&at("x.mcap"), "25");
        let convert = |from: &str, to: &str| command!("recording convert", at(from), at(to));
        wrong_use_with(convert("x.mcap", "x.mcap"), &["input and output"]);
        wrong_use_with(convert("x.mcap", "y.wav"), &["--to"]);
        let refused = |from: &str, to: &str| failure(convert(from, to));
        assert!(refused("x.mcap", "absent/y.mcap").contains("mkdir"));
        assert!(refused("z.mcap", "y.mcap").contains("z.mcap"));
        std::fs::create_dir(at("full")).expect("creates");
        std::fs::write(at("full/thesis.tex"), "x").expect("writes");
        assert!(refused("x.mcap", "full").contains("not empty"));
        fails_with(
            command!("recording convert --overwrite", at("x.mcap"), at("full")),
            &["not empty", "--overwrite replaces files, never folders"],
        );

        let mut bytes = std::fs::read(at("x.mcap")).expect("reads");
        let middle = bytes.len() / 2;
        bytes[middle] ^= 0x10;
        std::fs::write(at("x.mcap"), bytes).expect("writes");
        let said = refused("x.mcap", "session");
        assert!(said.contains("at byte") && said.contains("radome recording repair"), "{said}");
        fails_with(command!("recording repair", at("full/thesis.tex"), "-o", at("y.mcap")), &["not an MCAP file"]);
        let mut left = partial_files(folder.path());
        left.sort();
        assert_eq!(left, [at("full"), at("x.mcap")]);
    }
}
