//! Tests of the findings of `radome doctor`.

use std::borrow::BorrowMut;
use std::collections::BTreeMap;
use std::io::{Cursor, Read};
use std::net::TcpListener;
use std::path::Path;
use std::process::Command;

use radome_driver::{Recorder, RecordingHeader};
use radome_dsp::{Frame, Gap, GapReason, Waveform, WaveformRequest};
use radome_tests::{
    command, convert, fixture, help, json_lines, outcome, radome, subcommand, success, with_file_size_limit, write_file,
};
use serde_json::Value;

fn doctor_command() -> Command {
    command!("doctor --json --record-to", std::env::temp_dir())
}

fn find_check<'a>(checks: &'a [Value], name: &str) -> &'a Value {
    checks.iter().find(|check| check["check"] == name).unwrap_or_else(|| panic!("no {name} in {checks:?}"))
}

/// Checks of a run that fails, and its stderr.
fn failed_checks(command: impl BorrowMut<Command>) -> (Vec<Value>, String) {
    let (status, told, said) = outcome(command);
    assert_eq!(status, Some(1), "{said}");
    (told.lines().map(|line| serde_json::from_str(line).expect("JSON")).collect(), said)
}

#[test]
fn a_source_that_works_is_examined_and_packed() {
    let folder = tempfile::tempdir().expect("a folder");
    let bundle = folder.path().join("report.zip");
    let mut command = doctor_command();
    command.arg(format!("emulated:{}", fixture("scenes/corridor.toml").display()));
    command.arg("--model").arg(fixture("models/paper-hqnn.safetensors")).arg("--bundle").arg(&bundle);
    command.env("RADOME_MQTT_PASSWORD", "hunter2");
    let checks = json_lines(&mut command);
    for name in ["program", "model", "source", "fit", "frames", "speed"] {
        assert_eq!(find_check(&checks, name)["verdict"], "ok", "{checks:?}");
    }
    assert!(find_check(&checks, "frames")["found"].as_str().is_some_and(|found| found.starts_with("20 frames")));
    let summary = &checks.last().expect("a summary")["summary"];
    assert_eq!((&summary["failures"], &summary["checks"]), (&0.into(), &(checks.len() - 1).into()));

    let parts = unpack(&bundle);
    let packed = "README.txt checks.json program.json devices.json source.json registers.txt frames.mcap model.json";
    for name in packed.split(' ').chain(["wire.txt"]) {
        assert!(parts.get(name).is_some_and(|part| !part.is_empty()), "{name}");
    }
    let path = write_file(folder.path(), "frames.mcap", &parts["frames.mcap"]);
    assert_eq!(convert(&path, &folder.path().join("copy.mcap"))["frames"], 20);
    wire_is_bytes_with_times_and_directions(&String::from_utf8_lossy(&parts["wire.txt"]));
    let secret = b"hunter2";
    let has_secret = |part: &Vec<u8>| part.windows(secret.len()).any(|bytes| bytes == secret);
    assert!(!parts.values().any(has_secret), "a secret leaves the house");
}

/// Files of an archive by name.
fn unpack(bundle: &Path) -> BTreeMap<String, Vec<u8>> {
    let mut archive = zip::ZipArchive::new(Cursor::new(std::fs::read(bundle).expect("packed"))).expect("an archive");
    let mut parts = BTreeMap::new();
    for index in 0..archive.len() {
        let mut part = archive.by_index(index).expect("a part");
        let mut bytes = Vec::new();
        part.read_to_end(&mut bytes).expect("whole");
        parts.insert(part.name().expect("a name").into_owned(), bytes);
    }
    parts
}

/// Asserts that the archive has tokens in place of all names of persons, machines and networks, and that stderr lists
/// the packed files.
#[test]
fn a_bundle_hides_names_and_lists_its_content() {
    let folder = tempfile::tempdir().expect("a folder");
    let temporary = tempfile::tempdir().expect("a folder");
    let home = folder.path().join("zqhome of zqzoe");
    std::fs::create_dir(&home).expect("writable");
    std::fs::copy(fixture("models/paper-hqnn.safetensors"), home.join("zqmodel.safetensors")).expect("copied");
    let bundle = home.join("zqreport.zip");
    let mut command = radome();
    command.args(["doctor", "--json"]).arg(format!("emulated:{}", fixture("scenes/corridor.toml").display()));
    // The model has a relative path; scene and archive have absolute paths.
    command.current_dir(&home).args(["--model", "zqmodel.safetensors", "--record-to", ".", "--bundle"]).arg(&bundle);
    command.args(["--mqtt", "mqtt://zquser:zqhunter@zqhost.example:18x83"]);
    command.env("HOME", &home).env("USER", "zqzoe").env("TMPDIR", temporary.path());
    command.env("RADOME_MQTT_USER", "zqradar").env("RADOME_MQTT_PASSWORD", "zqpassword");
    let (checks, said) = failed_checks(&mut command);
    assert_eq!(find_check(&checks, "mqtt")["verdict"], "fail");
    assert_eq!(find_check(&checks, "frames")["verdict"], "ok");

    let parts = unpack(&bundle);
    for (name, bytes) in &parts {
        let line = format!("{:>10} bytes  {name}", bytes.len());
        assert!(said.lines().any(|said| said == line), "no {line:?} in {said}");
        let text = String::from_utf8_lossy(bytes).to_lowercase();
        // Identity of the emulated board, as text and as bytes of the protocol trace.
        let identity = ["000102030405060708090a0b0c0d0e0f", "00 01 02 03 04 05 06 07"];
        let names = ["zqhome", "zqzoe", "zqmodel", "zqreport", "zquser", "zqhunter", "zqhost", "zqradar", "zqpassword"];
        for secret in identity.iter().chain(&names).chain(&["corridor.toml"]) {
            assert!(!text.contains(secret), "{secret} in {name}: {text}");
        }
    }
    assert!(parts.len() >= 9 && said.contains("<path-N>") && said.contains("<serial-N>"), "{said}");
    let checks = String::from_utf8_lossy(&parts["checks.json"]).into_owned();
    assert!(checks.contains("<path-") && checks.contains("MB/s"), "{checks}");
    // No file remains in the folder for temporary files.
    assert_eq!(std::fs::read_dir(temporary.path()).expect("readable").count(), 0);
}

/// Regression test: the card of the built-in model was not packed, and its name was hidden as a path.
#[test]
fn the_built_in_model_is_packed_and_named() {
    let folder = tempfile::tempdir().expect("a folder");
    let bundle = folder.path().join("report.zip");
    json_lines(doctor_command().args(["--model", "room-hqnn", "--bundle"]).arg(&bundle));
    let parts = unpack(&bundle);
    let card: Value = serde_json::from_slice(&parts["model.json"]).expect("JSON");
    assert!(card["waveform"].is_object(), "{card}");
    let checks = String::from_utf8_lossy(&parts["checks.json"]);
    assert!(checks.contains("room-hqnn: "), "{checks}");
}

#[test]
fn a_bundle_is_not_written_over_another_file() {
    let folder = tempfile::tempdir().expect("a folder");
    let (bundle, target) = (folder.path().join("report.zip"), folder.path().join("target"));
    std::fs::write(&bundle, "mine").expect("writable");
    let (checks, said) = failed_checks(doctor_command().arg("--bundle").arg(&bundle));
    assert!(checks.is_empty() && said.contains("exists") && said.contains("hint:"), "{said}");
    assert_eq!(std::fs::read(&bundle).expect("readable"), b"mine");
    std::fs::remove_file(&bundle).expect("removable");
    std::os::unix::fs::symlink(&target, &bundle).expect("a link");
    let (_, said) = failed_checks(doctor_command().arg("--bundle").arg(&bundle));
    assert!(said.contains("exists") && !target.exists(), "{said}");
}

/// Checks the trace of the emulated board: requests, answers and the headers of frames.
fn wire_is_bytes_with_times_and_directions(text: &str) {
    assert!(text.len() < 100_000, "{} bytes", text.len());
    let (mut last_s, mut sent, mut received, mut pieces) = (0.0, Vec::new(), Vec::new(), 0);
    for line in text.lines().filter(|line| !line.starts_with("...")) {
        let (seconds, rest) = line.trim_start().split_once(' ').unwrap_or_else(|| panic!("{line}"));
        let seconds: f64 = seconds.parse().unwrap_or_else(|e| panic!("{line}: {e}"));
        assert!(seconds >= last_s, "{line}");
        last_s = seconds;
        let (mark, shown) = rest.split_once(' ').unwrap_or_else(|| panic!("{line}"));
        let (hex, more) = shown.split_once(" and ").unwrap_or((shown, "0 bytes"));
        let bytes = || -> Vec<u8> {
            // The bytes of the board's identity are hidden.
            let byte = |hex: &str| if hex == "xx" { Ok(0) } else { u8::from_str_radix(hex, 16) };
            hex.split(' ').map(|hex| byte(hex).unwrap_or_else(|e| panic!("{line}: {e}"))).collect()
        };
        match mark {
            "opened" => assert!(shown.starts_with("/dev/"), "{line}"),
            ">" => sent.push(bytes()),
            // Messages of the Strata protocol that carry frame data begin with a byte from 0xD0 on and have a header of
            // six bytes.
            "<" if bytes()[0] >= 0xD0 => {
                assert!(bytes().len() == 6 && more.ends_with(" bytes"), "{line}");
                pieces += 1;
            }
            "<" => received.push(bytes()),
            _ => panic!("{line}"),
        }
    }
    assert!(text.contains("opened /dev/") && sent.len() > 10 && pieces > 20, "{text}");
    // Each answer begins with the code of its request.
    let codes = |messages: &[Vec<u8>]| messages.iter().map(|bytes| bytes[0]).collect::<Vec<u8>>();
    assert_eq!(codes(&received), codes(&sent));
}

#[test]
fn a_mismatch_is_a_failure_with_a_hint() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = write_file(folder.path(), "broken.safetensors", b"nonsense");
    let (checks, said) = failed_checks(doctor_command().arg("--model").arg(&path));
    assert_eq!(find_check(&checks, "model")["verdict"], "fail");
    assert!(said.contains("failed"), "{said}");

    let bundle = folder.path().join("report.zip");
    let (checks, _) = failed_checks(doctor_command().arg("serial:/dev/no-such-port").arg("--bundle").arg(&bundle));
    assert!(find_check(&checks, "source")["found"].as_str().is_some_and(|found| found.contains("/dev/no-such-port")));
    let parts = unpack(&bundle);
    let wire = String::from_utf8_lossy(&parts["wire.txt"]).into_owned();
    // Each path has one token.
    let token = wire.trim_end().rsplit_once("opened ").map(|(_, token)| token).expect("a path");
    assert!(token.starts_with("<path-"), "{wire}");
    let checks = String::from_utf8_lossy(&parts["checks.json"]).into_owned();
    assert!(checks.contains(token) && !checks.contains("no-such-port"), "{checks}");

    let closed = TcpListener::bind("127.0.0.1:0").and_then(|l| l.local_addr()).expect("a port");
    for url in [format!("mqtt://u@{closed}"), format!("mqtt://u:hunter2@{closed}"), "mqtt://u@h:hunter2".into()] {
        let (checks, said) =
            failed_checks(doctor_command().args(["--mqtt", &url]).env("RADOME_MQTT_PASSWORD", "hunter2"));
        let broker = find_check(&checks, "mqtt");
        assert!(broker["verdict"] == "fail" && broker["hint"].is_string(), "{broker}");
        assert!(!said.contains("hunter2") && !broker.to_string().contains("hunter2"), "{said} {broker}");
    }

    let (checks, _) = failed_checks(subcommand("doctor --json --record-to /no/such/folder"));
    assert_eq!(find_check(&checks, "space")["verdict"], "fail");
}

/// Regression test: of a recording without frames it said that the board is silent, and a gap of unknown length counted as
/// no loss.
#[test]
fn findings_about_a_recording_are_not_those_of_a_board() {
    let folder = tempfile::tempdir().expect("a folder");
    let (empty, holed) = (folder.path().join("empty.mcap"), folder.path().join("holed.mcap"));
    let header = RecordingHeader::new(Waveform::realise(WaveformRequest::paper()).expect("possible"));
    Recorder::create(&empty, &header).expect("creates").finish().expect("finishes");
    let mut recorder = Recorder::create(&holed, &header).expect("creates");
    let mut frame = Frame::zeroed(header.waveform.shape());
    frame.codes.iter_mut().zip((2000..2007).cycle()).for_each(|(code, value)| *code = value);
    recorder.frame(&frame).expect("records");
    recorder.gap(&Gap { first_sequence: 1, frames: 0, reason: GapReason::Disconnected }).expect("records");
    recorder.finish().expect("finishes");

    let (checks, _) = failed_checks(doctor_command().arg(&empty));
    let frames = find_check(&checks, "frames");
    assert!(
        frames["verdict"] == "fail" && !frames["hint"].as_str().is_some_and(|hint| hint.contains("board")),
        "{frames}"
    );
    let checks = json_lines(doctor_command().arg(&holed));
    let frames = find_check(&checks, "frames");
    let found = frames["found"].as_str().expect("a finding");
    assert!(frames["verdict"] == "warn" && found.contains("unknown number"), "{frames}");
    assert!(frames["hint"].as_str().is_some_and(|hint| hint.contains("while it was recorded")), "{frames}");
}

/// Regression test: the hint for a disk without room was to name a folder that the user may write.
#[test]
fn the_remedy_for_a_write_that_fails_is_that_of_its_cause() {
    let (checks, _) = failed_checks(with_file_size_limit(1000, doctor_command()));
    let speed = find_check(&checks, "speed");
    assert!(
        speed["verdict"] == "fail" && speed["hint"].as_str().is_some_and(|hint| hint.contains("ulimit")),
        "{speed}"
    );
}

#[test]
fn the_packaged_rules_are_the_programs_and_the_unit_names_options_that_exist() {
    let read =
        |name: &str| std::fs::read_to_string(radome_tests::root().join("packaging").join(name)).expect("packaged");
    let (printed, _) = success(subcommand("board list --udev-rules"));
    assert_eq!(printed.trim(), read("udev/70-radome.rules").trim());
    let unit = read("systemd/radome@.service");
    let help = help("live");
    let options: Vec<&str> = unit.split_whitespace().map(|word| word.trim_start_matches("RADOME_OPTIONS=")).collect();
    let options: Vec<&str> =
        options.into_iter().filter(|word| word.starts_with("--m") || word.starts_with("--keep")).collect();
    assert!(options.len() >= 4 && options.iter().all(|option| help.contains(option)), "{options:?}");
    assert!(unit.contains("Type=notify") && unit.contains("WatchdogSec="));
    // Two radars on one machine have settings and folders of their own.
    let settings = unit.lines().filter(|line| !line.starts_with('#'));
    for line in
        settings.filter(|line| line.contains("/etc/") || line.contains("StateDirectory=") || line.contains("/var/"))
    {
        assert!(line.split_whitespace().all(|place| place.contains("%i")), "{line}");
    }
}
