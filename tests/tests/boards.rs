//! Every emulated board serves a recording through its own bytes, and what is recorded from it is the recording.

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Output, Stdio};

use radome_tests::{failure, fixture, json_lines, radome};

const FRAMES: usize = 60;

fn codes(folder: &Path) -> Vec<u16> {
    let file = std::fs::File::open(folder.join("RadarIfxAvian_00/radar.npy")).expect("a recording folder");
    npyz::NpyFile::new(BufReader::new(file)).expect("npy").into_vec().expect("u16")
}

fn simulate(frames: usize, fed: &Path) {
    let frames = frames.to_string();
    json_lines(
        radome().arg("simulate").arg(fixture("scenes/desk.toml")).args(["--frames", &frames, "--json", "-o"]).arg(fed),
    );
}

/// An emulated board, and its port.
fn emulate(from: &Path, arguments: &[&str]) -> (Child, String) {
    let mut board = radome()
        .arg("emulate")
        .args(arguments)
        .arg("--from")
        .arg(from)
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .expect("starts");
    let mut port = String::new();
    BufReader::new(board.stdout.take().expect("piped")).read_line(&mut port).expect("a line");
    (board, port.trim().to_owned())
}

/// Records frames of a board, which is then unplugged for good.
fn record(mut board: Child, source: &str, frames: usize, recorded: &Path) -> Output {
    let output = radome()
        .args(["record", source, "--json", "--allow-loss", "--frames", &frames.to_string(), "-o"])
        .arg(recorded)
        .output()
        .expect("runs");
    let _ = board.kill();
    let _ = board.wait();
    output
}

#[test]
fn what_a_board_is_fed_is_what_is_recorded_sample_for_sample() {
    let folder = tempfile::tempdir().expect("a folder");
    let fed = folder.path().join("fed.mcap");
    simulate(FRAMES + 20, &fed);
    let source = folder.path().join("fed");
    json_lines(radome().arg("convert").arg(&fed).arg(&source).arg("--json"));
    let expected = codes(&source);
    let check = |protocol: &str, scheme: &str| {
        let link = folder.path().join(format!("{protocol}-board")).display().to_string();
        let (board, port) = emulate(&source, &["--protocol", protocol, "--link", &link]);
        let recorded = folder.path().join(format!("{protocol}.mcap"));
        let copy = folder.path().join(protocol);
        // Nobody names the waveform: the board knows.
        let output = record(board, &format!("{scheme}:{port}"), FRAMES, &recorded);
        assert!(output.status.success(), "{protocol}: {}", String::from_utf8_lossy(&output.stderr));
        json_lines(radome().arg("convert").arg(&recorded).arg(&copy).arg("--json"));
        let got = codes(&copy);
        let frame = expected.len() / (FRAMES + 20);
        assert_eq!(got.len(), frame * FRAMES, "{protocol}");
        // A machine with other things to do may be late to read, and real time does not wait: what is lost then is told, and
        // nothing else differs.
        let summary: serde_json::Value = serde_json::from_slice(&output.stdout).expect("a summary");
        let (mut next, mut lost) = (0, 0);
        for (number, recorded) in got.chunks(frame).enumerate() {
            let ahead = expected.chunks(frame).skip(next).position(|sent| sent == recorded);
            let ahead =
                ahead.unwrap_or_else(|| panic!("{protocol}: frame {number} was never sent, or was sent before"));
            // An ESP32 talks whether or not somebody listens yet.
            lost += if number == 0 && protocol == "esp32" { 0 } else { ahead };
            next += ahead + 1;
        }
        assert_eq!(summary["dropped"], lost, "{protocol}");
    };
    // They take their real time, side by side.
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

/// A PSoC 6 kit says what it is set to: nobody has to name a waveform.
#[test]
fn a_deepcraft_board_is_recorded_with_the_waveform_that_it_is_set_to() {
    let folder = tempfile::tempdir().expect("a folder");
    let fed = folder.path().join("fed.mcap");
    simulate(40, &fed);
    let (mut board, port) = emulate(&fed, &["--protocol", "deepcraft"]);
    let recorded = folder.path().join("recorded.mcap");
    let summary = json_lines(
        radome().args(["record", &format!("deepcraft:{port}"), "--frames", "20", "--json", "-o"]).arg(&recorded),
    );
    let _ = board.kill();
    let _ = board.wait();
    assert_eq!((&summary[0]["frames"], &summary[0]["dropped"]), (&20.into(), &0.into()));
}

mod hard_cases {
    use super::*;

    #[test]
    fn what_a_script_of_faults_costs_is_counted_and_recorded_and_the_rest_is_whole() {
        let folder = tempfile::tempdir().expect("a folder");
        let fed = folder.path().join("fed.mcap");
        simulate(80, &fed);
        let link = folder.path().join("board").display().to_string();
        let (board, port) =
            emulate(&fed, &["--speed", "0", "--faults", "drop 5, double 9, flip 12:345", "--link", &link]);
        assert_eq!(port, link);
        let recorded = folder.path().join("recorded.mcap");
        let output = record(board, &format!("serial:{port}"), 40, &recorded);
        let said = String::from_utf8_lossy(&output.stdout);
        let summary: serde_json::Value = serde_json::from_str(said.trim()).expect("one object");
        let dropped = summary["dropped"].as_u64().expect("a number");
        assert!(summary["frames"] == 40 && dropped >= 2, "{said}");
        let whole = json_lines(radome().arg("convert").arg(&recorded).arg(folder.path().join("copy")).arg("--json"));
        assert_eq!((&whole[0]["frames"], whole[0]["lost"].as_u64()), (&40.into(), Some(dropped)));
    }

    #[test]
    fn a_fault_that_nobody_can_follow_is_wrong_use() {
        let output =
            radome().args(["emulate", "--from", "nowhere.mcap", "--faults", "explode 3"]).output().expect("runs");
        let said = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.code() == Some(2) && said.contains("no such kind"), "{said}");
    }
}

/// Nobody has told the board a waveform, and the detector needs none of its own.
#[test]
fn a_board_that_was_told_nothing_is_watched_with_the_waveform_that_is_named() {
    let (mut board, port) = emulate(&fixture("scenes/corridor.toml"), &[]);
    // Who opens it resets its chip.
    drop(radome_driver::Board::open(Path::new(&port)).expect("a board"));
    let live = |model: &str, more: &[&str]| {
        let mut command = radome();
        command.args(["live", &format!("serial:{port}"), "--frames", "5", "--json", "--model", model]).args(more);
        command
    };
    let said = failure(&mut live("cfar", &[]));
    assert!(said.contains("not been told a waveform") && said.contains("--waveform"), "{said}");

    // The model's waveform and the one named cannot both be: the board is not even opened.
    let (model, other) = (fixture("models/paper-hqnn.safetensors"), fixture("models/desk-hqnn.safetensors"));
    let (model, other) = (model.display().to_string(), other.display().to_string());
    let said = failure(&mut live(&model, &["--waveform", &other]));
    assert!(said.contains(&model) && said.contains(&other) && said.contains("hint: leave --waveform away"), "{said}");

    for (model, waveform) in [("cfar", "paper"), ("cfar", &model), (&model, "paper")] {
        let lines = json_lines(&mut live(model, &["--waveform", waveform]));
        assert_eq!(lines.last().expect("a summary")["summary"]["frames"], 5, "{model} {waveform}");
    }
    let _ = board.kill();
    let _ = board.wait();
}
