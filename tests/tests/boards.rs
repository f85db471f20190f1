//! Every emulated board serves a recording in its own protocol; a recording made from it equals the original.

use std::io::BufReader;
use std::path::{Path, PathBuf};
use std::process::Output;

use radome_driver::recording::Recording;
use radome_driver::{Address, Mcu7Board};
use radome_dsp::{Frame, FrameSource, RxMask, Waveform, WaveformRequest};
use radome_tests::running::{Running, emulated_board, wait_for};
use radome_tests::{
    command, convert, fails_with, failure, fixture, json_lines, outcome, simulate, subcommand, write_file,
};

const FRAMES: usize = 60;

fn read_codes(folder: &Path) -> Vec<u16> {
    let file = std::fs::File::open(folder.join("RadarIfxAvian_00/radar.npy")).expect("a recording folder");
    npyz::NpyFile::new(BufReader::new(file)).expect("npy").into_vec().expect("u16")
}

/// Folder with a recording of a simulated desk, and the path of the recording.
fn desk_recording(frames: usize) -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().expect("a folder");
    let fed = folder.path().join("fed.mcap");
    simulate(&fixture("scenes/desk.toml"), &format!("--frames {frames}"), &fed);
    (folder, fed)
}

/// Records frames of a board, which then disconnects for good.
fn record(_board: Running, source: &str, frames: usize, recorded: &Path) -> Output {
    let mut record = subcommand(&format!("record --json --allow-loss --frames {frames} -o"));
    record.arg(recorded).arg(source).output().expect("runs")
}

#[test]
fn samples_of_an_emulated_board_are_recorded_unchanged() {
    let (folder, fed) = desk_recording(FRAMES + 20);
    let source = folder.path().join("fed");
    convert(&fed, &source);
    let expected = read_codes(&source);
    let check = |protocol: &str, scheme: &str| {
        let link = folder.path().join(format!("{protocol}-board")).display().to_string();
        let (board, port) = emulated_board(&source, &["--protocol", protocol, "--link", &link]);
        let recorded = folder.path().join(format!("{protocol}.mcap"));
        let copy = folder.path().join(protocol);
        // The command names no waveform, since the board reports its own.
        let output = record(board, &format!("{scheme}:{port}"), FRAMES, &recorded);
        assert!(output.status.success(), "{protocol}: {}", String::from_utf8_lossy(&output.stderr));
        convert(&recorded, &copy);
        let got = read_codes(&copy);
        let frame = expected.len() / (FRAMES + 20);
        assert_eq!(got.len(), frame * FRAMES, "{protocol}");
        // A busy machine may read late, and the board does not wait. Lost frames are then reported, and nothing else
        // differs.
        let summary: serde_json::Value = serde_json::from_slice(&output.stdout).expect("a summary");
        let (mut next, mut lost) = (0, 0);
        for (number, recorded) in got.chunks(frame).enumerate() {
            let ahead = expected.chunks(frame).skip(next).position(|sent| sent == recorded);
            let ahead =
                ahead.unwrap_or_else(|| panic!("{protocol}: frame {number} was never sent, or was sent before"));
            // An ESP32 sends before a client listens, so that its first frames may be lost.
            lost += if number == 0 && protocol == "esp32" { 0 } else { ahead };
            next += ahead + 1;
        }
        assert_eq!(summary["dropped"], lost, "{protocol}");
    };
    // The boards run in real time, in parallel.
    std::thread::scope(|scope| {
        let check = &check;
        for (protocol, scheme) in [
            ("mcu7-4", "serial"),
            ("mcu7-3", "serial"),
            ("mcu7-bulk", "usb"),
            ("deepcraft", "serial"),
            ("esp32", "serial"),
        ] {
            scope.spawn(move || check(protocol, scheme));
        }
    });
}

/// Asserts that a PSoC 6 kit reports its waveform, so that no option has to name one.
#[test]
fn a_deepcraft_board_is_recorded_with_the_waveform_that_it_is_set_to() {
    let (folder, fed) = desk_recording(40);
    let (_board, port) = emulated_board(&fed, &["--protocol", "deepcraft"]);
    let recorded = folder.path().join("recorded.mcap");
    let summary = json_lines(command!("record --json", format!("deepcraft:{port}"), "--frames 20 -o", &recorded));
    assert_eq!((&summary[0]["frames"], &summary[0]["dropped"]), (&20.into(), &0.into()));
}

/// Asserts that the axes are those of the waveform that an ESP32 reports. It takes no requests, so that no model can
/// program it.
#[test]
fn frames_of_an_esp32_are_classified_on_the_axes_that_it_states() {
    let (_folder, fed) = desk_recording(40);
    let (_board, port) = emulated_board(&fed, &["--protocol", "esp32"]);
    let judged = json_lines(command!("live --json", format!("serial:{port}"), "--frames 10"));
    assert!(judged.iter().filter(|line| line["probabilities"].is_object()).count() >= 10, "{judged:?}");
}

mod hard_cases {
    use std::time::Duration;

    use super::*;

    /// Pauses a recorder of an emulated board for longer than its patience with a silent board. Returns the lines that
    /// it wrote to stderr, and the number of frames lost.
    fn record_with_pause(protocol: &str, pause: Duration) -> (Vec<String>, Option<u64>) {
        let folder = tempfile::tempdir().expect("a folder");
        // A frame is longer than one read of the port, and the board holds those of some seconds.
        let text = "start_frequency_hz = 60e9\nend_frequency_hz = 62e9\nsamples_per_chirp = 64\nchirps_per_frame = 32\n\
            sample_rate_hz = 2e6\nchirp_interval_s = 600e-6\nframe_interval_s = 0.2\n";
        let waveform = write_file(folder.path(), "slow.toml", text);
        let (_board, port) = emulated_board(&fixture("scenes/desk.toml"), &["--protocol", protocol]);
        let recorded = folder.path().join("recorded.mcap");
        let port = format!("serial:{port}");
        let record = command!("record --allow-loss --frames 30 -o", &recorded, port, "--waveform", &waveform);
        let mut recorder = Running::start(record);
        wait_for("a recording that grows", || {
            std::fs::metadata(&recorded).ok().filter(|file| file.len() > 30_000).map(|_| ())
        });
        recorder.signal("STOP");
        std::thread::sleep(pause);
        recorder.signal("CONT");
        recorder.wait();
        let copy = convert(&recorded, &folder.path().join("copy"));
        (recorder.stderr.all(), copy["lost"].as_u64())
    }

    /// Regression test: the board counted as stalled, and the frames that it still held were lost.
    #[test]
    fn a_recorder_that_is_paused_loses_no_frame_that_the_board_holds() {
        let (said, lost) = record_with_pause("mcu7-4", Duration::from_millis(2500));
        assert!(!said.iter().any(|line| line.contains("the board is")), "{said:?}");
        assert_eq!(lost, Some(0), "{said:?}");
    }

    /// Regression test: a board that its watchdog had stopped was started anew, and counted as stalled at once.
    #[test]
    fn a_board_that_stopped_while_its_recorder_was_paused_is_started_once() {
        let (said, _) = record_with_pause("deepcraft", Duration::from_millis(3500));
        assert_eq!(said.iter().filter(|line| line.contains("the board is started anew")).count(), 1, "{said:?}");
        assert!(!said.iter().any(|line| line.contains("the board is lost")), "{said:?}");
    }

    /// Regression test: each line was told, several a second, until the deadline.
    #[test]
    fn lines_of_another_waveform_are_reported_once() {
        let (folder, fed) = desk_recording(60);
        let (_board, port) = emulated_board(&fed, &["--protocol", "esp32"]);
        let (_, other) = other_waveform(folder.path());
        let none = folder.path().join("none.mcap");
        let said = failure(command!("record", format!("serial:{port}"), "--waveform", &other, "-o", none));
        assert!(said.contains("no frame among its lines") && said.contains("hint: name the waveform"), "{said}");
        assert_eq!(said.matches("WARN").count(), 1, "{said}");
    }

    #[test]
    fn losses_by_scripted_faults_are_counted_and_recorded_and_other_frames_are_whole() {
        let (folder, fed) = desk_recording(80);
        let link = folder.path().join("board").display().to_string();
        let (board, port) =
            emulated_board(&fed, &["--speed", "0", "--faults", "drop 5, double 9, flip 12:345", "--link", &link]);
        assert_eq!(port, link);
        let recorded = folder.path().join("recorded.mcap");
        let output = record(board, &format!("serial:{port}"), 40, &recorded);
        let said = String::from_utf8_lossy(&output.stdout);
        let summary: serde_json::Value = serde_json::from_str(said.trim()).expect("one object");
        let dropped = summary["dropped"].as_u64().expect("a number");
        assert!(summary["frames"] == 40 && dropped >= 2, "{said}");
        let whole = convert(&recorded, &folder.path().join("copy"));
        assert_eq!((&whole["frames"], whole["lost"].as_u64()), (&40.into(), Some(dropped)));
    }

    #[test]
    fn an_unknown_kind_of_fault_is_wrong_use() {
        let mut emulate = subcommand("board emulate --from nowhere.mcap --faults");
        let (status, _, said) = outcome(emulate.arg("explode 3"));
        assert!(status == Some(2) && said.contains("no such kind"), "{said}");
    }
}

/// Asserts that a named waveform programs a board without one, for a detector that needs no particular waveform.
#[test]
fn a_board_without_a_waveform_is_programmed_with_the_named_one() {
    let (_board, port) = emulated_board(&fixture("scenes/corridor.toml"), &[]);
    // Opening the board resets its chip.
    drop(Mcu7Board::open(&Address::Serial((&port).into())).expect("a board"));
    let live = |model: &str, more: &[&str]| {
        command!("live --json", format!("serial:{port}"), "--frames 5 --model", model, ..more)
    };
    fails_with(live("cfar", &[]), &["not been told a waveform", "--waveform"]);

    // The model's waveform contradicts the named one: the command fails before it opens the board.
    let (model, other) = (fixture("models/paper-hqnn.safetensors"), fixture("models/desk-hqnn.safetensors"));
    let (model, other) = (model.display().to_string(), other.display().to_string());
    fails_with(live(&model, &["--waveform", &other]), &[&model, &other, "hint: leave --waveform away"]);

    for (model, waveform) in [("cfar", "paper"), ("cfar", &model), (&model, "paper")] {
        let lines = json_lines(live(model, &["--waveform", waveform]));
        assert_eq!(lines.last().expect("a summary")["summary"]["frames"], 5, "{model} {waveform}");
    }
}

/// Waveform of another shape than the desk's, and the path of its file.
fn other_waveform(folder: &Path) -> (Waveform, PathBuf) {
    let text = "start_frequency_hz = 60e9\nend_frequency_hz = 62e9\nsamples_per_chirp = 32\nchirps_per_frame = 16\n\
        sample_rate_hz = 1e6\nchirp_interval_s = 800e-6\nframe_interval_s = 50e-3\nrx_antennas = [1, 3]\n";
    let path = write_file(folder, "other.toml", text);
    let request = WaveformRequest {
        start_frequency_hz: 60e9,
        end_frequency_hz: 62e9,
        samples_per_chirp: 32,
        chirps_per_frame: 16,
        sample_rate_hz: 1e6,
        chirp_interval_s: 800e-6,
        frame_interval_s: 50e-3,
        rx_antennas: RxMask::from_antennas(&[1, 3]).expect("receivers"),
        ..WaveformRequest::paper()
    };
    (Waveform::realise(request).expect("a waveform"), path)
}

/// Records this number of frames of a board; none may be missing.
fn record_frames(port: &str, frames: usize, waveform: Option<&Path>, recorded: &Path) {
    let port = format!("serial:{port}");
    let mut record = command!("record --json", port, "--frames", frames.to_string(), "-o", recorded);
    if let Some(waveform) = waveform {
        record.arg("--waveform").arg(waveform);
    }
    let summary = json_lines(record);
    assert_eq!((&summary[0]["frames"], &summary[0]["dropped"]), (&frames.into(), &0.into()));
}

#[test]
fn a_scene_is_simulated_in_the_waveform_that_the_client_programs() {
    let folder = tempfile::tempdir().expect("a folder");
    let (_, other) = other_waveform(folder.path());
    let (board, port) = emulated_board(&fixture("scenes/desk.toml"), &["--speed", "0"]);
    // A client that names no waveform gets that of the client before it.
    for (number, waveform, frame) in [(0, None, 3 * 8 * 64), (1, Some(&other), 2 * 16 * 32), (2, None, 2 * 16 * 32)] {
        let recorded = folder.path().join(format!("{number}.mcap"));
        record_frames(&port, 10, waveform.map(PathBuf::as_path), &recorded);
        let copy = folder.path().join(number.to_string());
        convert(&recorded, &copy);
        let codes = read_codes(&copy);
        assert_eq!(codes.len(), 10 * frame, "recording {number}");
        assert!(codes.iter().any(|code| *code != codes[0]), "there is something in it");
    }
    let said = board.stderr.all();
    assert!(!said.iter().any(|line| line.contains("sends no frames")), "{said:?}");
}

#[test]
fn an_emulated_recording_is_not_sent_in_another_waveform_and_stderr_names_both() {
    let (folder, fed) = desk_recording(60);
    let (board, port) = emulated_board(&fed, &["--speed", "0"]);
    let (other, _) = other_waveform(folder.path());
    let client = Mcu7Board::open(&Address::Serial((&port).into())).expect("a board");
    let mut stream = client.start(&other).expect("a real board starts as well");
    stream.next_frame(&mut Frame::zeroed(other.shape())).expect_err("no frames");
    let said = board.stderr.find(0, "a word", |line| line.contains("sends no frames").then(|| line.to_owned()));
    assert!(said.contains("16 chirps x 32 samples") && said.contains("8 chirps x 64 samples"), "{said}");
    // The same client continues.
    let client = stream.stop().expect("answers");
    let own = Recording::open(&fed).expect("opens").waveform().clone();
    let mut stream = client.start(&own).expect("starts");
    stream.next_frame(&mut Frame::zeroed(own.shape())).expect("frames");
}

#[test]
fn the_end_of_a_recording_is_reported_once_and_a_loop_has_none() {
    let (folder, fed) = desk_recording(30);

    let (board, port) = emulated_board(&fed, &["--speed", "0"]);
    let mut client = Running::start(command!("record", format!("serial:{port}"), "-o", folder.path().join("all.mcap")));
    let said = board.stderr.find(0, "the end", |line| line.contains("has ended").then(|| line.to_owned()));
    assert!(said.contains("30 frames were sent") && said.contains("silent") && said.contains("--loop"), "{said}");
    client.signal("TERM");
    client.wait();
    // The board still answers.
    Mcu7Board::open(&Address::Serial((&port).into())).expect("answers");
    assert_eq!(board.stderr.all().iter().filter(|line| line.contains("has ended")).count(), 1);

    let (board, port) = emulated_board(&fed, &["--speed", "0", "--loop"]);
    let recorded = folder.path().join("loop.mcap");
    record_frames(&port, 75, None, &recorded);
    assert!(!board.stderr.all().iter().any(|line| line.contains("has ended")), "{:?}", board.stderr.all());
    let copies = [(&fed, "fed"), (&recorded, "loop")].map(|(recording, name)| {
        let copy = folder.path().join(name);
        convert(recording, &copy);
        read_codes(&copy)
    });
    let frame = copies[0].len() / 30;
    for (number, got) in copies[1].chunks(frame).enumerate() {
        let expected = copies[0].chunks(frame).nth(number % 30).expect("a frame");
        assert!(got == expected, "frame {number}");
    }
}

#[test]
fn a_link_belongs_to_one_board_and_is_removed_with_it() {
    let (folder, fed) = desk_recording(30);
    let link = folder.path().join("board");
    let link_text = link.display().to_string();
    let arguments = ["--speed", "0", "--loop", "--link", &link_text];
    let second = || command!("board emulate", ..arguments, "--from", &fed);
    let (mut first, port) = emulated_board(&fed, &arguments);
    assert_eq!(port, link_text);
    for _ in 0..3 {
        fails_with(second(), &[&link_text, "hint:"]);
    }
    record_frames(&port, 5, None, &folder.path().join("first.mcap"));
    first.signal("TERM");
    first.wait();
    assert!(std::fs::read_link(&link).is_err(), "it goes with its board");

    // A killed emulator leaves its link behind, and the next one replaces it.
    let (mut killed, _) = emulated_board(&fed, &arguments);
    killed.signal("KILL");
    killed.wait();
    assert!(std::fs::read_link(&link).is_ok());
    let (_next, port) = emulated_board(&fed, &arguments);
    record_frames(&port, 5, None, &folder.path().join("next.mcap"));
}

#[test]
fn a_recorder_that_is_killed_leaves_a_board_for_the_next() {
    let (folder, fed) = desk_recording(60);
    let (_board, port) = emulated_board(&fed, &["--speed", "0", "--loop"]);
    for number in 0..5 {
        let recorded = folder.path().join(format!("killed-{number}.mcap"));
        let mut killed = Running::start(command!("record", format!("serial:{port}"), "-o", &recorded));
        wait_for("a recording that grows", || {
            std::fs::metadata(&recorded).ok().filter(|file| file.len() > 100_000).map(|_| ())
        });
        killed.signal("KILL");
        killed.wait();
        let info = json_lines(command!("recording info --json", &recorded)).remove(0);
        assert_eq!(info["finished"], false, "{info}");
        record_frames(&port, 20, None, &folder.path().join(format!("next-{number}.mcap")));
    }
}
