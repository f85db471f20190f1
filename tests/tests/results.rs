//! Tests of answers that a recording stores beside its frames.

use std::path::Path;

use radome_driver::McapReader;
use radome_tests::running::{Running, wait_for};
use radome_tests::{command, convert, emulated_corridor, fails_with, json_lines, live_command, success, write_file};
use serde_json::Value;

/// Runs `live` on this number of frames of the simulated corridor and records them; returns its JSON lines.
fn record_live(output: &Path, frames: &str) -> Vec<Value> {
    json_lines(live_command(emulated_corridor(), &format!("--frames {frames} --json -o")).arg(output))
}

fn read_results(path: &Path) -> Vec<Value> {
    json_lines(command!("recording answers --json", path))
}

#[test]
fn results_equal_the_printed_answers_and_survive_every_copy_that_can_hold_them() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name);
    let said = record_live(&at("night.mcap"), "40");
    let said = &said[..40];
    let kept = read_results(&at("night.mcap"));
    assert_eq!(kept.len(), 40);
    for (said, kept) in said.iter().zip(&kept) {
        for field in ["sequence", "label", "occupied", "people"] {
            assert_eq!(said[field], kept[field], "{field}");
        }
        let p = |class: &str| said["probabilities"][class].clone();
        assert_eq!(kept["probabilities"], Value::from(vec![p("empty"), p("one"), p("two")]));
    }
    // The frames equal those of a recording without answers.
    let judged_again = json_lines(live_command(at("night.mcap"), "--json"));
    assert!(judged_again.iter().zip(said).all(|(again, said)| again["probabilities"] == said["probabilities"]));

    convert(&at("night.mcap"), &at("copy.mcap"));
    assert_eq!(read_results(&at("copy.mcap")), kept);
    // Frames that are recorded again keep their board, and the answers are said to stay behind.
    let (_, said) = success(command!("record", at("night.mcap"), "-o", at("again.mcap")));
    assert!(said.contains("answers of") && said.contains("recording convert"), "{said}");
    json_lines(live_command(at("night.mcap"), &format!("--json -o {}", at("judged.mcap").display())));
    let header = |name: &str| McapReader::open(&at(name)).expect("a recording").header().clone();
    let first = header("night.mcap");
    assert!(first.board.is_some() && !first.registers.is_empty());
    for name in ["again.mcap", "judged.mcap"] {
        let header = header(name);
        assert_eq!((&header.board, &header.registers), (&first.board, &first.registers), "{name}");
    }
    json_lines(command!("recording repair --json", at("night.mcap"), "-o", at("fixed.mcap")));
    assert_eq!(read_results(&at("fixed.mcap")), kept);
    let track = write_file(folder.path(), "track.txt", "0.5\t1.5\tone\n");
    json_lines(command!("recording labels --json", at("copy.mcap"), "--import", &track));
    assert_eq!(read_results(&at("copy.mcap")), kept);

    let (_, said) = success(command!("recording convert", at("night.mcap"), at("folder/")));
    assert!(said.contains("the answers of 40 frames"), "{said}");
    fails_with(command!("recording answers", at("folder")), &["holds no answers", "hint:"]);
}

#[test]
fn csv_has_a_line_a_frame_or_one_a_change() {
    let folder = tempfile::tempdir().expect("a folder");
    let (night, table) = (folder.path().join("night.mcap"), folder.path().join("night.csv"));
    let said = record_live(&night, "80");
    let (told, named) = success(command!("recording answers", &night, "--csv", &table));
    assert!(told.is_empty() && named.contains("paper-hqnn.safetensors"), "{told}{named}");
    let table = std::fs::read_to_string(&table).expect("a table");
    let rows: Vec<Vec<&str>> = table.lines().map(|line| line.split(',').collect()).collect();
    assert_eq!(rows.len(), 81);
    assert!(rows.iter().all(|row| row.len() == rows[0].len()), "{table}");
    let column = |name: &str| rows[0].iter().position(|head| *head == name).expect("a column");
    for (row, said) in rows[1..].iter().zip(&said) {
        assert_eq!(row[column("label")], said["label"].as_str().expect("a label"));
        assert_eq!(row[column("people")], said["people"].to_string());
    }
    let (changes, _) = success(command!("recording answers", &night, "--changes"));
    let people: Vec<_> = said[..80].iter().map(|said| said["people"].as_u64()).collect();
    let expected = 1 + people.windows(2).filter(|pair| pair[0] != pair[1]).count();
    assert!(expected > 1, "somebody comes");
    assert_eq!(changes.lines().count(), expected + 1, "and a line with the names of the columns");
}

#[test]
fn a_run_that_is_stopped_leaves_a_whole_recording_and_one_that_is_killed_a_readable_one() {
    for (signal, is_whole) in [("INT", true), ("KILL", false)] {
        let folder = tempfile::tempdir().expect("a folder");
        let night = folder.path().join("night.mcap");
        // A slow machine may lose frames in real time, which this test permits.
        let mut command = live_command(emulated_corridor(), "--speed 1 --allow-loss --json -o");
        let mut live = Running::start(command.arg(&night));
        wait_for("frames", || (live.stdout.all().len() >= 45).then_some(()));
        live.signal(signal);
        let status = live.wait();
        assert_eq!(status.success(), is_whole, "{:?}", live.stderr.all());
        let lines = live.stdout.all();
        let said = lines.iter().map(|line| serde_json::from_str::<Value>(line).expect("JSON"));
        let said: Vec<u64> = said.filter_map(|line| line["sequence"].as_u64()).collect();
        let kept = read_results(&night);
        let sequences: Vec<_> = kept.iter().map(|result| result["sequence"].as_u64().expect("a number")).collect();
        assert!(said.starts_with(&sequences), "{sequences:?} of {said:?}");
        assert!(
            kept.iter().all(|result| result["host_time_ns"].as_u64().is_some_and(|ns| ns > 0)),
            "a board's frames have times"
        );
        if is_whole {
            assert_eq!(sequences, said);
        } else {
            // A chunk spans one second, and answers follow the chunk of their frames.
            assert!(kept.len() + 25 >= said.len() && !kept.is_empty(), "{} of {said:?}", kept.len());
        }
    }
}
