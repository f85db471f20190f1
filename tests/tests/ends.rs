//! Every program end reports its cause on stderr, prints its summary and has its exit status: 0 done, 1 failed, 2 wrong
//! use, 3 done with losses.

use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use radome_driver::{McapReader, Recorder, RecordingHeader};
use radome_dsp::{Frame, FrameSource, Gap, GapReason, SourceEvent};
use radome_tests::browser::{Served, page};
use radome_tests::running::{Running, emulated_board, unplug, wait_for};
use radome_tests::{
    command, emulated_corridor, fails_with, failure, fixture, frames_and_gaps, json_lines, live_command, outcome,
    radome, simulate, skip, subcommand, with_file_size_limit, write_file, wrong_use_with,
};
use serde_json::Value;
use tungstenite::Message;

/// Simulates a desk recording with this number of frames.
fn simulate_desk(frames: u64, to: &Path) {
    simulate(&fixture("scenes/desk.toml"), &format!("--frames {frames}"), to);
}

/// Writes twenty frames of a simulated desk, of which three, from number 8 on, are missing.
fn write_recording_with_gap(folder: &Path) -> PathBuf {
    let (whole, holed) = (folder.join("whole.mcap"), folder.join("holed.mcap"));
    simulate_desk(20, &whole);
    let mut reader = McapReader::open(&whole).expect("a recording");
    let header: RecordingHeader = reader.header().clone();
    let mut frame = Frame::zeroed(header.waveform.shape());
    let mut recorder = Recorder::create(&holed, &header).expect("a file");
    while reader.next_frame(&mut frame).expect("readable") == SourceEvent::Frame {
        match frame.sequence {
            8 => recorder.gap(&Gap { first_sequence: 8, frames: 3, reason: GapReason::PacketLost }).expect("written"),
            9 | 10 => {}
            _ => recorder.frame(&frame).expect("written"),
        }
    }
    recorder.finish().expect("finished");
    holed
}

/// Whether a recording is marked as finished, its number of frames, and its gaps.
fn read_extent(path: &Path) -> (bool, u64, Vec<Gap>) {
    let reader = McapReader::open(path).expect("a file that opens");
    let (frames, gaps) = frames_and_gaps(path);
    (reader.is_complete(), frames.len() as u64, gaps)
}

/// Starts an emulated board behind a link with a unique path, and returns the path.
fn emulate_board(folder: &Path, protocol: &str) -> (Running, String) {
    let link = folder.join(format!("{protocol}-board")).display().to_string();
    emulated_board(&fixture("scenes/desk.toml"), &["--protocol", protocol, "--link", &link])
}

/// Starts a recorder of boards that reports each frame and searches for a lost board for one second.
fn start_recorder(mut command: Command, recording: &Path) -> Running {
    command.args(["--give-up-after-s", "1", "--json", "--allow-loss", "-o"]).arg(recording);
    Running::start(command.env("RADOME_LOG", "warn,radome_driver::recording=trace"))
}

fn wait_for_frames(running: &Running) {
    wait_for("some frames", || {
        let frames = running.stderr.all().iter().filter(|line| line.contains("frame recorded")).count();
        (frames >= 5).then_some(())
    });
}

#[test]
fn a_board_that_is_lost_for_good_ends_a_recording_with_its_cause_and_what_was_captured() {
    let lose = |protocol: &str, scheme: &str| {
        let folder = tempfile::tempdir().expect("a folder");
        let (board, port) = emulate_board(folder.path(), protocol);
        let recording = folder.path().join("run.mcap");
        let mut record = start_recorder(command!("record", format!("{scheme}:{port}")), &recording);
        wait_for_frames(&record);
        unplug(&board, &port);
        let status = record.wait();
        let said = record.stderr.all().join("\n");
        assert_eq!(status.code(), Some(1), "{protocol}: {said}");
        let error = said.lines().find(|line| line.starts_with("error: ")).expect("an error");
        assert!(error.contains(&port), "{protocol}: {error}");
        let summary = record.stdout.all();
        let summary: Value = serde_json::from_str(summary.last().expect("a summary")).expect("JSON");
        let (is_finished, frames, gaps) = read_extent(&recording);
        assert!(is_finished && frames >= 5 && summary["frames"] == frames, "{protocol}: {frames}, {summary}");
        assert_eq!(summary["gaps_of_unknown_length"], 1, "{protocol}: {summary}");
        // The frames that the board would have sent form a gap of unknown length.
        let last = gaps.last().expect("a gap");
        assert_eq!((last.frames, last.reason), (0, GapReason::Disconnected), "{protocol}: {gaps:?}");
    };
    std::thread::scope(|scope| {
        let lose = &lose;
        for (protocol, scheme) in
            [("mcu7-4", "serial"), ("mcu7-bulk", "usb"), ("deepcraft", "serial"), ("esp32", "serial")]
        {
            scope.spawn(move || lose(protocol, scheme));
        }
    });
}

#[test]
fn a_board_that_is_lost_for_good_ends_live_with_its_cause_and_a_summary() {
    let folder = tempfile::tempdir().expect("a folder");
    let (board, port) = emulate_board(folder.path(), "mcu7-4");
    let recording = folder.path().join("night.mcap");
    let mut live = start_recorder(command!("live --model cfar", format!("serial:{port}")), &recording);
    wait_for_frames(&live);
    // Regression test: the signal for a report ended a run that keeps none.
    live.signal("USR1");
    live.stderr.find(0, "a word on reports", |line| line.contains("--keep-to").then_some(()));
    unplug(&board, &port);
    let status = live.wait();
    let said = live.stderr.all().join("\n");
    assert_eq!(status.code(), Some(1), "{said}");
    assert!(said.lines().any(|line| line.starts_with("error: ") && line.contains(&port)), "{said}");
    let answers = live.stdout.all();
    let summary: Value = serde_json::from_str(answers.last().expect("a summary")).expect("JSON");
    assert!(summary["summary"]["frames"].as_u64().is_some_and(|frames| frames >= 1), "{summary}");
    assert_eq!(summary["summary"]["gaps_of_unknown_length"], 1, "{summary}");
    let gap = answers.iter().rfind(|line| line.contains("\"gap\""));
    assert!(gap.is_some_and(|gap| gap.contains("\"frames\":0,\"reason\":\"disconnected\"")), "{gap:?}");
    let (is_finished, frames, gaps) = read_extent(&recording);
    assert!(is_finished && frames >= 5, "{frames} frames");
    assert_eq!(gaps.last().map(|gap| (gap.frames, gap.reason)), Some((0, GapReason::Disconnected)));
}

/// Regression test: a user who stopped while the board was away got a recording without a gap, and exit status 0.
#[test]
fn a_stop_while_the_board_is_away_leaves_a_gap_of_unknown_length_and_ends_with_3() {
    let folder = tempfile::tempdir().expect("a folder");
    for arguments in [&["record"][..], &["live", "--model", "cfar"]] {
        let (board, port) = emulate_board(folder.path(), "mcu7-4");
        let recording = folder.path().join(arguments[0]).with_extension("mcap");
        let mut command = radome();
        command.args(arguments).arg(format!("serial:{port}")).arg("-o").arg(&recording);
        let mut run = Running::start(command.env("RADOME_LOG", "warn,radome_driver::recording=trace"));
        wait_for_frames(&run);
        unplug(&board, &port);
        run.stderr.find(0, "the loss", |line| line.contains("the board is lost").then_some(()));
        run.signal("INT");
        let status = run.wait();
        let said = run.stderr.all().join("\n");
        assert_eq!(status.code(), Some(3), "{arguments:?}: {said}");
        let (is_finished, frames, gaps) = read_extent(&recording);
        assert!(is_finished && frames >= 5, "{arguments:?}: {frames} frames");
        let last = gaps.last().map(|gap| (gap.frames, gap.reason));
        assert_eq!(last, Some((0, GapReason::Disconnected)), "{arguments:?}: {gaps:?}");
    }
}

/// Regression test: commands that took frames where signals are answered heard none until the search for the board ended,
/// and then failed without their file.
#[test]
fn a_stop_while_the_board_is_away_keeps_what_was_taken_by_every_command() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name);
    let written = |name: &str| std::fs::metadata(at(name)).is_ok_and(|file| file.len() > 100_000);
    for (command, output, status) in [
        ("recording maps", Some("maps.npy"), 0),
        ("recording echoes", None, 0),
        // A second of frames is too short for a background.
        ("model background", Some("empty.json"), 1),
    ] {
        let (board, port) = emulate_board(folder.path(), "mcu7-4");
        let mut arguments = subcommand(command);
        arguments.arg(format!("serial:{port}")).args(["--give-up-after-s", "600", "--json"]);
        if let Some(output) = output {
            arguments.arg("-o").arg(at(output));
        }
        let mut run = Running::start(&mut arguments);
        wait_for("some frames", || match command {
            "recording maps" => written(".maps.npy.partial").then_some(()),
            "recording echoes" => (run.stdout.all().len() >= 5).then_some(()),
            _ => run.stderr.all().iter().any(|line| line.contains("nobody should be")).then_some(()),
        });
        unplug(&board, &port);
        run.stderr.find(0, "the loss", |line| line.contains("the board is lost").then_some(()));
        run.signal("TERM");
        assert_eq!(run.wait().code(), Some(status), "{command}: {:?}", run.stderr.all());
    }
    assert!(written("maps.npy") && !at("empty.json").exists());
}

/// Regression test: the part that was done took the place of a whole array, with status 0.
#[test]
fn maps_of_a_recording_that_are_stopped_replace_no_array() {
    let folder = tempfile::tempdir().expect("a folder");
    let maps = write_file(folder.path(), "maps.npy", "whole");
    let desk = fixture("scenes/desk.toml");
    let mut run = Running::start(command!("recording maps", desk, "--frames 1000000 --overwrite -o", &maps));
    let part = folder.path().join(".maps.npy.partial");
    wait_for("maps", || std::fs::metadata(&part).is_ok_and(|file| file.len() > 100_000).then_some(()));
    run.signal("TERM");
    assert_eq!(run.wait().code(), Some(1));
    assert!(run.stderr.all().iter().any(|line| line.contains("interrupted after")), "{:?}", run.stderr.all());
    assert_eq!((std::fs::read(&maps).expect("there"), part.exists()), (b"whole".to_vec(), false));
}

/// Regression test: the description of a recording did not say that frames are missing.
#[test]
fn a_recording_reports_how_many_frames_are_missing() {
    let folder = tempfile::tempdir().expect("a folder");
    let info = json_lines(command!("recording info --json", write_recording_with_gap(folder.path()))).remove(0);
    assert_eq!((&info["frames"], &info["gaps"], &info["missing"]), (&17.into(), &1.into(), &3.into()), "{info}");
}

#[test]
fn a_port_that_is_not_there_is_a_failure() {
    let folder = tempfile::tempdir().expect("a folder");
    let recording = folder.path().join("run.mcap");
    let said = failure(command!("record serial:/dev/no-such-port -o", &recording));
    assert!(said.contains("/dev/no-such-port") && !recording.exists(), "{said}");
}

/// Runs a command and closes its stdout after this number of lines.
fn run_with_closed_stdout(command: &mut Command, lines: usize) -> (Option<i32>, String) {
    let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("starts");
    let stderr = child.stderr.take().expect("piped");
    let said = std::thread::spawn(move || std::io::read_to_string(stderr).expect("reads"));
    let stdout = BufReader::new(child.stdout.take().expect("piped"));
    assert_eq!(stdout.lines().take(lines).count(), lines, "{command:?}");
    let status = child.wait().expect("ends");
    (status.code(), said.join().expect("no panic"))
}

#[test]
fn a_closed_stdout_ends_every_command_quietly() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name);
    simulate_desk(40, &at("desk.mcap"));
    let quiet = |mut command: Command, lines: usize| {
        let (status, said) = run_with_closed_stdout(&mut command, lines);
        assert_eq!(status, Some(0), "{command:?}: {said}");
        assert!(!said.contains("panic") && !said.contains("error"), "{command:?}: {said}");
    };
    quiet(command!("scene simulate", fixture("scenes/desk.toml"), "--frames 3 -o", at("x.mcap")), 0);
    quiet(command!("recording answers", fixture("formats/judged.mcap")), 1);
    quiet(subcommand("completions bash"), 0);
    quiet(subcommand("model list --json"), 0);
    quiet(command!("record", at("desk.mcap"), "-o", at("y.mcap")), 0);
    for (lines, arguments) in [(0, &[] as &[&str]), (1, &[]), (3, &["--json"])] {
        let name = format!("night-{}-{lines}.mcap", arguments.len());
        quiet(command!("live", at("desk.mcap"), "--model cfar", ..arguments, "-o", at(&name)), lines);
        // If stdout closes before the first frame, there may be no recording; an existing recording is complete.
        assert!(!at(&name).exists() || read_extent(&at(&name)).0, "{name}");
    }
}

#[test]
fn a_stdout_that_is_full_is_a_failure() {
    let Ok(full) = std::fs::File::options().write(true).open("/dev/full") else {
        return skip("/dev/full", "a device of Linux");
    };
    fails_with(subcommand("model list --json").stdout(full), &["cannot write to stdout"]);
    // A recording to a device that is full names it.
    fails_with(live_command(emulated_corridor(), "--frames 60 --json -o /dev/full"), &["/dev/full"]);
}

#[test]
fn a_repair_that_drops_a_chunk_ends_with_3_and_one_that_loses_nothing_with_0() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name);
    simulate_desk(40, &at("whole.mcap"));
    let repair = |from: &str| {
        let (status, _, said) = outcome(command!("recording repair", at(from), "-o", at(&format!("fixed-{from}"))));
        (status, said)
    };
    assert_eq!(repair("whole.mcap").0, Some(0));
    let bytes = std::fs::read(at("whole.mcap")).expect("readable");
    let mut flipped = bytes.clone();
    flipped[bytes.len() / 3] ^= 0x10;
    std::fs::write(at("flipped.mcap"), flipped).expect("writable");
    let (status, said) = repair("flipped.mcap");
    assert!(status == Some(3) && said.contains("bytes lost"), "{status:?}: {said}");
    let (_, frames, _) = read_extent(&at("fixed-flipped.mcap"));
    assert!(frames > 0 && frames < 40, "{frames} frames");
    std::fs::write(at("cut.mcap"), &bytes[..2 * bytes.len() / 3]).expect("writable");
    assert_eq!(repair("cut.mcap").0, Some(3));
}

#[test]
fn a_recording_with_gaps_ends_with_3_unless_that_is_allowed() {
    let folder = tempfile::tempdir().expect("a folder");
    let holed = write_recording_with_gap(folder.path());
    let expected = [Gap { first_sequence: 8, frames: 3, reason: GapReason::PacketLost }];
    for (command, more) in [("record", &[] as &[&str]), ("live", &["--model", "cfar"])] {
        let run = |arguments: &[&str]| {
            let to = folder.path().join(format!("{command}-{}.mcap", arguments.join("")));
            let mut run = radome();
            run.arg(command).arg(&holed).args(more).args(arguments).arg("-o").arg(&to);
            let (status, told, said) = outcome(&mut run);
            let (is_finished, frames, gaps) = read_extent(&to);
            assert!(is_finished && frames == 17 && gaps == expected, "{command}: {frames}, {gaps:?}");
            assert!(told.contains("17 frames"), "{command}: {told}");
            (status, said)
        };
        let (status, said) = run(&[]);
        assert!(status == Some(3) && said.contains("--allow-loss"), "{command}: {status:?}: {said}");
        assert_eq!(run(&["--allow-loss"]).0, Some(0), "{command}");
        if command == "record" {
            let (status, said) = run(&["--max-dropped", "2"]);
            assert!(status == Some(1) && said.contains("3 frames were lost"), "{status:?}: {said}");
            assert_eq!(run(&["--max-dropped", "3"]).0, Some(3));
        }
    }
    // How many frames a gap of unknown length stands for is not known, so it is within no limit.
    let (away, again) = (folder.path().join("away.mcap"), folder.path().join("again.mcap"));
    let header = McapReader::open(&holed).expect("a recording").header().clone();
    let mut recorder = Recorder::create(&away, &header).expect("a file");
    recorder.gap(&Gap { first_sequence: 0, frames: 0, reason: GapReason::Disconnected }).expect("written");
    recorder.finish().expect("finished");
    let (status, told, said) = outcome(command!("record", &away, "--allow-loss --max-dropped 9 -o", &again));
    assert!(status == Some(1) && told.contains("unknown number") && said.contains("at most 9"), "{told}{said}");
    // Without a recording, lost frames do not change the exit status.
    assert_eq!(outcome(command!("live", &holed, "--model cfar")).0, Some(0));
}

#[test]
fn wrong_use_ends_with_2() {
    for arguments in [&["record", "x.mcap"][..], &["recording", "repair", "--nonsense"], &["live"], &["nonsense"], &[]]
    {
        assert_eq!(outcome(radome().args(arguments)).0, Some(2), "{arguments:?}");
    }
    // Options without effect are refused.
    for arguments in [
        &["--listen", "127.0.0.1:0"][..],
        &["--read-only-labels"],
        &["--pair", "pair"],
        &["--allow-loss"],
        &["--keep-last-s", "5"],
    ] {
        let (status, _, said) = outcome(command!("live x.mcap", ..arguments));
        assert!(status == Some(2) && said.contains("required"), "{arguments:?}: {said}");
    }
    // Options are checked before the source is opened, which may be a board.
    for (arguments, reason) in [
        (&["--mqtt", "http://x"][..], "does not begin with mqtt://"),
        (&["--mqtt", "mqtt://x", "--mqtt-discovery-prefix", "#"], "--mqtt-discovery-prefix"),
        (&["--mqtt", "mqtt://x", "--mqtt-ca", "x.pem"], "--mqtt-ca is for"),
        (&["--token-file", "x"], "for a page or metrics"),
        (&["--metrics", "0.0.0.0:0"], "reached from the network"),
    ] {
        let (status, _, said) = outcome(command!("live serial:/dev/no-such-port", ..arguments));
        assert!(status == Some(2) && said.contains(reason) && said.contains("hint:"), "{arguments:?}: {said}");
    }
    for (arguments, reason) in [
        (&["--keep-to", "x", "--keep-last-s", "0"][..], "above 0"),
        (&["--keep-to", "x", "--keep-memory-mib", "0"], "--keep-memory-mib"),
        (&["--mqtt", "mqtt://x", "--mqtt-name", ""], "--mqtt-name"),
    ] {
        let (status, _, said) = outcome(command!("live serial:/dev/no-such-port", ..arguments));
        assert!(status == Some(2) && said.contains(reason), "{arguments:?}: {said}");
    }
    for option in ["--on-delay-s", "--off-delay-s", "--speed"] {
        for value in ["nan", "inf", "-3"] {
            let (status, _, said) = outcome(command!("live x.mcap", option, value));
            assert!(status == Some(2) && said.contains("0 or more"), "{option} {value}: {said}");
        }
    }
}

/// Regression test: each seek on the page went into the recording, in which frames were repeated and others were missing.
#[test]
fn a_recording_that_the_page_plays_is_not_recorded() {
    let folder = tempfile::tempdir().expect("a folder");
    let (fed, copy) = (folder.path().join("fed.mcap"), folder.path().join("copy.mcap"));
    simulate_desk(3, &fed);
    let live = command!("live --model cfar --frames 3 --view --listen 127.0.0.1:0", &fed, "-o", &copy);
    wrong_use_with(live, &["-o cannot record", "hint: leave out --view or -o"]);
    assert!(!copy.exists());
}

#[test]
fn help_lists_the_exit_statuses() {
    for arguments in [&["--help"][..], &["record", "--help"], &["live", "--help"]] {
        let (status, told, _) = outcome(radome().args(arguments));
        assert!(status == Some(0) && told.contains("Exit status: 0"), "{arguments:?}: {told}");
    }
}

#[test]
fn a_command_that_a_signal_stops_ends_in_order_with_0() {
    let folder = tempfile::tempdir().expect("a folder");
    let (mut board, port) = emulate_board(folder.path(), "mcu7-4");
    let recording = folder.path().join("run.mcap");
    let mut record = start_recorder(command!("record", format!("serial:{port}")), &recording);
    wait_for_frames(&record);
    record.signal("TERM");
    // A terminal that closes sends several signals at once.
    record.signal("HUP");
    assert_eq!(record.wait().code(), Some(0), "{:?}", record.stderr.all());
    assert!(read_extent(&recording).0);
    board.signal("TERM");
    assert_eq!(board.wait().code(), Some(0), "{:?}", board.stderr.all());
    assert!(board.stderr.all().iter().any(|line| line.contains("packets sent")), "{:?}", board.stderr.all());
}

#[test]
fn a_recording_under_nohup_survives_its_terminal() {
    let folder = tempfile::tempdir().expect("a folder");
    let recording = folder.path().join("night.mcap");
    let mut command = Command::new("nohup");
    command.arg(radome().get_program()).args(["record", "--frames", "40", "--speed", "1"]);
    command.arg(fixture("scenes/desk.toml")).arg("-o").arg(&recording);
    let mut record = Running::start(command.env("RADOME_LOG", "warn,radome_driver::recording=trace"));
    wait_for_frames(&record);
    record.signal("HUP");
    assert_eq!(record.wait().code(), Some(0), "{:?}", record.stderr.all());
    let (is_finished, frames, _) = read_extent(&recording);
    assert!(is_finished && frames == 40, "{frames}");
}

#[test]
fn live_ends_although_nobody_reads_its_stdout() {
    let folder = tempfile::tempdir().expect("a folder");
    let (desk_path, recording) = (folder.path().join("desk.mcap"), folder.path().join("run.mcap"));
    simulate_desk(1200, &desk_path);
    let mut live = command!("live", &desk_path, "--model cfar --json -o", &recording);
    live.env("RADOME_LOG", "warn,radome_driver::recording=trace").stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child = live.spawn().expect("starts");
    // The pipe and the queue hold some hundred answers.
    let mut said = BufReader::new(child.stderr.take().expect("piped")).lines().map_while(Result::ok);
    let recorded = said.by_ref().filter(|line| line.contains("frame recorded")).take(400).count();
    assert_eq!(recorded, 400);
    let rest = std::thread::spawn(move || said.filter(|line| line.contains("error")).collect::<Vec<_>>());
    std::thread::sleep(std::time::Duration::from_millis(500));
    let status = Command::new("kill").args(["-s", "TERM", &child.id().to_string()]).status();
    assert!(status.is_ok_and(|status| status.success()));
    let status = wait_for("the program's end", || child.try_wait().ok().flatten());
    let errors = rest.join().expect("no panic");
    assert_eq!(status.code(), Some(1), "{errors:?}");
    assert!(errors.iter().any(|line| line.contains("stdout is not read")), "{errors:?}");
    assert!(read_extent(&recording).0);
}

/// Regression test: the summary of a board's run was dropped without a word where the reader of stdout was slow.
#[test]
fn the_summary_of_a_board_waits_for_a_slow_reader() {
    let folder = tempfile::tempdir().expect("a folder");
    let desk_path = folder.path().join("desk.mcap");
    simulate_desk(1200, &desk_path);
    let board = format!("emulated:{}", desk_path.display());
    let mut live = command!("live --model cfar --json --speed 40 --frames 1100", board);
    let mut child = live.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("starts");
    // The pipe and the queue hold some hundred answers.
    let mut said = BufReader::new(child.stderr.take().expect("piped")).lines().map_while(Result::ok);
    let lost = std::thread::spawn(move || said.any(|line| line.contains("answers were not printed")));
    wait_for("lost answers", || lost.is_finished().then_some(()));
    assert!(lost.join().expect("no panic"));
    std::thread::sleep(std::time::Duration::from_millis(500));
    let mut told = String::new();
    child.stdout.take().expect("piped").read_to_string(&mut told).expect("text");
    assert!(told.lines().last().is_some_and(|line| line.contains("\"summary\"")), "{:?}", told.lines().last());
    assert_eq!(child.wait().expect("ends").code(), Some(0));
}

/// Tests with a file-size limit in place of a full disk.
mod full_disk {
    use super::*;

    /// Number of frames. A chunk holds one second: thirteen frames of at most 3 KiB, of which some fit in a file and
    /// others do not.
    const FRAMES: u64 = 240;
    const BLOCKS: u32 = 120;

    fn assert_first_cause(said: &str, full: &Path) {
        let error = said.lines().find(|line| line.starts_with("error: ")).unwrap_or_else(|| panic!("no error: {said}"));
        assert!(error.contains("File too large") && error.contains(&*full.to_string_lossy()), "{said}");
        assert!(!error.contains("attempted another write"), "{said}");
        assert!(!said.contains("after a write method failed"), "{said}");
    }

    #[test]
    fn ends_a_recording_with_its_first_cause_and_leaves_a_file_that_opens() {
        let folder = tempfile::tempdir().expect("a folder");
        let fed = folder.path().join("fed.mcap");
        simulate_desk(FRAMES, &fed);
        // The smaller limit has room for no frame.
        for blocks in [8, BLOCKS] {
            let full = folder.path().join(format!("full-{blocks}.mcap"));
            let record = command!("record", &fed, "--json -o", &full);
            let (status, told, said) = outcome(with_file_size_limit(blocks, record));
            assert_eq!(status, Some(1), "{said}");
            assert_first_cause(&said, &full);
            assert!(said.contains("hint: radome recording repair"), "{said}");
            let summary: Value = serde_json::from_str(told.trim()).expect("a summary");
            let (is_finished, frames, _) = read_extent(&full);
            assert!(!is_finished && (frames > 0) == (blocks == BLOCKS) && frames < FRAMES, "{frames} of {summary}");
            // The frames of the chunk that did not fit do not count.
            assert_eq!(summary["frames"], frames, "{said}");
            assert!(said.contains(&format!("ended after {frames} frames")), "{said}");
        }
    }

    #[test]
    fn is_reported_at_once_by_live_whose_answers_go_on() {
        let folder = tempfile::tempdir().expect("a folder");
        let (fed, full) = (folder.path().join("fed.mcap"), folder.path().join("full.mcap"));
        simulate_desk(FRAMES, &fed);
        let live = command!("live", &fed, "--model cfar --json -o", &full);
        let (status, told, said) = outcome(with_file_size_limit(BLOCKS, live));
        assert_eq!(status, Some(1), "{said}");
        assert_first_cause(&said, &full);
        assert!(said.contains("marked unfinished") && said.contains("hint: radome recording repair"), "{said}");
        let answers = told.lines().filter(|line| line.contains("\"sequence\"")).count();
        assert_eq!(answers as u64, FRAMES, "{said}");
        let (is_finished, frames, _) = read_extent(&full);
        assert!(!is_finished && frames > 0 && frames < FRAMES, "{frames} frames");
        assert!(said.contains(&format!("ended after {frames} frames")), "{said}");
    }

    /// Regression test: the page said that labels were saved and that the recording would be complete, and at the end nothing was
    /// said of labels without frames.
    #[test]
    fn is_reported_on_the_page_of_live_and_at_the_end_of_its_labels() {
        let folder = tempfile::tempdir().expect("a folder");
        let full = folder.path().join("full.mcap");
        let live = command!("live --model cfar --json --speed 4", fixture("scenes/desk.toml"), "-o", &full);
        let mut served = Served::start(with_file_size_limit(BLOCKS, live));
        let failed = |line: &str| line.contains("goes on without recording").then_some(());
        served.program.stderr.find(0, "the failure", failed);
        let mut socket = page(&served.address);
        let add = r#"{"do":"add","start_s":1000,"end_s":1001,"occupancy":"one","who":null}"#;
        socket.send(Message::text(add)).expect("sent");
        let labels = loop {
            let Message::Text(text) = socket.read().expect("a message") else { continue };
            let said: Value = serde_json::from_str(&text).expect("JSON");
            if said["labels"]["spans"].as_array().is_some_and(|spans| !spans.is_empty()) {
                break said["labels"].clone();
            }
        };
        assert!(labels["fault"].as_str().is_some_and(|fault| fault.contains("recording has failed")), "{labels}");
        assert!(labels["saved"] == false && labels["adaptation"].is_null(), "{labels}");
        served.program.signal("INT");
        assert_eq!(served.program.wait().code(), Some(1));
        let said = served.program.stderr.all().join("\n");
        assert!(said.contains("without frames for some labels (1)"), "{said}");
    }
}
