//! Tests of labels that are imported into a recording and exported in formats of other tools; frames do not change.

use std::path::Path;
use std::process::Command;

use radome_driver::recording::{Format, Recording, RecordingWriter};
use radome_tests::browser::{Served, page};
use radome_tests::running::wait_for;
use radome_tests::{
    command, convert, fails_with, failure, fixture, frames_and_gaps, json_lines, json_lines_of, labels_of, maps_of,
    radome, simulate, subcommand, success, write_file, wrong_use,
};
use serde_json::Value;
use tungstenite::Message;

#[test]
fn labels_are_stored_in_a_recording_and_its_frames_stay_unchanged() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| folder.path().join(name);
    simulate(&fixture("scenes/desk.toml"), "--frames 40", &path("run.mcap"));
    let before = maps_of(&path("run.mcap"));
    std::fs::write(path("track.txt"), "0.500000\t1.250000\tempty\n1.250000\t3.000000\tone\n").expect("writable");
    let import = ["--who", "a test", "--json", "--import"];
    let spans = json_lines(command!("recording labels", path("run.mcap"), ..import, path("track.txt"))).remove(0);
    assert_eq!((spans[0]["label"].as_str(), spans[1]["end_s"].as_f64()), (Some("empty"), Some(3.0)));
    assert_eq!(spans[1]["who"], "a test");
    json_lines(command!("recording labels --json", path("run.mcap"), "--export", path("out.label")));
    let text = std::fs::read_to_string(path("out.label")).expect("written");
    assert!(text.starts_with("Time(Seconds),Length(Seconds),") && text.contains("1.250000,1.750000,one,"), "{text}");
    assert!(maps_of(&path("run.mcap")) == before);

    std::fs::write(path("bad.txt"), "0.5\tempty\n").expect("writable");
    fails_with(command!("recording labels", path("run.mcap"), "--import", path("bad.txt")), &["bad.txt", "line 1"]);
}

/// Asserts that labels are checked against the recording wherever they go, and that near misses of classes are told.
#[test]
fn impossible_labels_are_refused_and_unclear_ones_reported() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| folder.path().join(name);
    simulate(&fixture("scenes/desk.toml"), "--frames 40", &path("run.mcap"));
    let label = |name: &str, options: &[&str]| command!("recording label", path(name), ..options);
    // A time before the recording is out of range, and no option of the command.
    fails_with(label("run.mcap", &["--span", "-1:2=two"]), &["'two' from -1 to 2 s is out of range"]);
    let file = path("labels.txt").display().to_string();
    let said = failure(label("run.mcap", &["--span", "0:99=two", "-o", &file]));
    assert!(said.contains("out of range") && !path("labels.txt").exists(), "{said}");
    let (_, said) = success(label("run.mcap", &["--span", "0:1=Empty", "--span", "1:2="]));
    assert!(said.contains("'Empty' is kept as free text; the class is written 'empty'"), "{said}");
    assert!(said.contains("the label from 1 to 2 s has no text: its frames count as not labelled"), "{said}");
    assert!(!said.contains("no class"), "a word for each label is enough: {said}");
    // Of several texts, only the first one was named.
    let spans = ["--span", "2:3=three", "--span", "2:3=two people", "--span", "1:2=two people ", "--span", "1:2=1"];
    let (_, said) = success(label("run.mcap", &spans));
    assert!(said.contains("no class are kept as free text"), "{said}");
    assert!(said.contains("not labelled: '1' (1), 'three' (1), 'two people' (2)"), "{said}");
    let said = wrong_use(label("run.mcap", &["--propose", "truth", "--who", "me"]));
    assert!(said.contains("--who names the author") && said.contains("hint: "), "{said}");
    // Files of labels hold no author, which was dropped without a word.
    convert(&path("run.mcap"), &path("run.txt"));
    for (name, output) in [("run.txt", &[][..]), ("run.mcap", &["-o", file.as_str()][..])] {
        let said = wrong_use(label(name, &["--span", "0:1=empty", "--who", "me"]).args(output));
        assert!(said.contains("--who has no effect") && !path("run.label").exists(), "{name}: {said}");
    }

    let header = Recording::open(&path("run.mcap")).expect("opens").header();
    RecordingWriter::create(&path("none.mcap"), Format::Mcap, &header)
        .and_then(RecordingWriter::finish)
        .expect("writes");
    let said = failure(label("none.mcap", &["--span", "0:1=empty"]));
    assert!(said.contains("none.mcap: labels refused: the recording has no frame"), "{said}");
}

/// Regression test: a folder of the vendor's had other labels under the name of its session than under that of its radar, and
/// one recording was judged and learnt twice under two names.
#[test]
fn two_names_of_a_recording_are_one_recording() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| folder.path().join(name);
    simulate(&fixture("scenes/corridor.toml"), "--frames 40 --people 1", &path("run.mcap"));
    convert(&path("run.mcap"), &path("session"));
    let radar = path("session/RadarIfxAvian_00");
    success(command!("recording label --span 0:1=one", path("session")));
    assert_eq!(labels_of(&radar), labels_of(&path("session")));
    success(command!("recording label --span 1:2=two", &radar));
    assert_eq!((labels_of(&radar), labels_of(&radar).len()), (labels_of(&path("session")), 2));
    fails_with(command!("model evaluate cfar", path("session"), &radar), &["is named twice", "hint: "]);

    std::os::unix::fs::symlink(path("run.mcap"), path("again.mcap")).expect("a link");
    let spec = |names: &[&str]| {
        let sources = names.iter().map(|name| format!("[[recorded]]\nrecording = \"{name}\"\n"));
        write_file(folder.path(), "maps.toml", format!("format = 1\n[map]\n{}", sources.collect::<String>()))
    };
    let twice = spec(&["run.mcap", "again.mcap"]);
    fails_with(command!("dataset build", twice, "-o", path("maps")), &["'run' and 'again' are one", "hint: "]);

    // Where there are labels, frames outside of them have none, whatever a simulator wrote with them.
    success(command!("recording label --span 0:1=empty", path("run.mcap")));
    success(command!("dataset build", spec(&["run.mcap"]), "-o", path("maps")));
    let rows = std::fs::read_to_string(path("maps/manifest.jsonl")).expect("written");
    assert_eq!((rows.lines().count(), rows.matches("\"label\":\"empty\"").count()), (10, 10), "{rows}");
}

/// Regression test: of a label that ends at the end of a recording, as `--propose truth` makes it, a rest of less than a
/// nanosecond stayed, which the file beside a folder held as a label without duration, and nothing could be built. Frames in
/// which somebody is partly in the room were no transitions any more.
#[test]
fn proposed_truth_is_replaced_whole_and_keeps_transitions() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| folder.path().join(name);
    simulate(&fixture("scenes/corridor.toml"), "--frames 300 --seed 3", &path("run.mcap"));
    let spec = write_file(folder.path(), "maps.toml", "format = 1\n[map]\n[[recorded]]\nrecording = \"run.mcap\"\n");
    let transitions = |name: &str| -> usize {
        success(command!("dataset build", &spec, "-o", path(name)));
        let rows = std::fs::read_to_string(path(&format!("{name}/manifest.jsonl"))).expect("written");
        rows.matches("\"transition\":true").count()
    };
    let before = transitions("unlabelled");
    success(command!("recording label --propose truth", path("run.mcap")));
    assert_eq!((transitions("labelled"), before > 0), (before, true));

    success(command!("recording label --replace --span 0:30=two", path("run.mcap")));
    assert_eq!(labels_of(&path("run.mcap")).len(), 1);
    convert(&path("run.mcap"), &path("session"));
    success(command!("recording label", path("run.mcap"), "-o", path("session/radome.label")));
    success(command!("model evaluate cfar", path("session")));
}

/// Regression test: a file of labels that is empty, and labels of which none is a class, were replaced by the truth that a simulator
/// wrote, without a word.
#[test]
fn labels_without_a_class_are_not_replaced_by_truth() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| folder.path().join(name);
    let scene = fixture("scenes/corridor.toml");
    simulate(&scene, "--frames 20 --people 1", &path("run.mcap"));
    let none = write_file(folder.path(), "none.txt", "");
    let spec = |more: &str| {
        let text = format!("format = 1\n[map]\n[[recorded]]\nrecording = \"run.mcap\"\n{more}");
        write_file(folder.path(), "maps.toml", text)
    };
    let refused = ["none.txt: no label in it is empty, one or two", "hint: "];
    fails_with(command!("dataset build", spec("label_file = \"none.txt\"\n"), "-o", path("maps")), &refused);
    assert!(!path("maps.parts").exists());
    fails_with(command!("scene pair", path("run.mcap"), &scene, "--labels", none, "-o", path("pair")), &refused);

    success(command!("recording label --span 0:2=person", path("run.mcap")));
    fails_with(command!("dataset build", spec(""), "-o", path("maps")), &["no source gave a map"]);
    fails_with(command!("model evaluate cfar", path("run.mcap")), &["no label says of any of its frames"]);
    fails_with(command!("scene pair", path("run.mcap"), &scene, "-o", path("pair")), &["no frame has a label"]);
}

/// Regression test: labels beyond the end of a recording were counted as if nothing were wrong.
#[test]
fn labels_beyond_a_recording_are_refused_wherever_they_are_read() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| folder.path().join(name);
    simulate(&fixture("scenes/corridor.toml"), "--frames 20 --people 1", &path("run.mcap"));
    let evaluate = |label: &str| {
        let file = write_file(folder.path(), "labels.txt", label);
        command!("model evaluate --json cfar", format!("{}={}", path("run.mcap").display(), file.display()))
    };
    let far = ["'one' from 0 to 99 s is out of range", "from 0 to 2 s"];
    fails_with(evaluate("0\t99\tone\n"), &far);
    fails_with(evaluate("0\t1\tone\n50\t60\tempty\n"), &["'empty' from 50 to 60 s is out of range"]);
    // Tracks whose last times are rounded were refused, too.
    for track in ["0\t2.1\tone\n", "-0.2\t2\tone\n", "0\t2\tone\n2\t2.5\tempty\n"] {
        let answer = json_lines(evaluate(track)).remove(0);
        assert_eq!(answer["recordings"][0]["frames"], 20, "{track}: {answer}");
    }
}

/// Regression test: a wrong label could be taken back on the page alone.
#[test]
fn labels_are_replaced_and_erased_where_it_is_asked_for() {
    let folder = tempfile::tempdir().expect("a folder");
    let recording = folder.path().join("run.mcap");
    simulate(&fixture("scenes/desk.toml"), "--frames 40", &recording);
    let label = |options: &[&str]| command!("recording label", &recording, ..options);
    success(label(&["--span", "0:3=two", "--span", "1:2=a knock"]));
    fails_with(label(&["--span", "1:2=one"]), &["overlap", "--replace"]);
    let found = || {
        let spans = json_lines(label(&["--json"])).remove(0);
        let of = |span: &Value| {
            format!("{}-{} {}", span["start_s"], span["end_s"], span["label"].as_str().expect("a label"))
        };
        let mut found: Vec<String> = spans.as_array().expect("a list").iter().map(of).collect();
        found.sort();
        found
    };
    success(label(&["--span", "1:2=one", "--replace"]));
    assert_eq!(found(), ["0.0-1.0 two", "1.0-2.0 a knock", "1.0-2.0 one", "2.0-3.0 two"]);
    success(label(&["--erase", "0.5:1.5"]));
    assert_eq!(found(), ["0.0-0.5 two", "1.5-2.0 a knock", "1.5-2.0 one", "2.0-3.0 two"]);
    let said = wrong_use(label(&["--span", "0.7:0.7=one"]));
    assert!(said.contains("no duration"), "{said}");
    // Between two frames, such a label was accepted.
    let said = wrong_use(label(&["--span", "0.71:0.75=one", "--replace"]));
    assert!(said.contains("'one' from 0.71 to 0.75 s covers no frame: frames are 0.077 s apart"), "{said}");
    let said = failure(label(&["--span", "90:90.05=one"]));
    assert!(said.contains("'one' from 90 to 90.05 s is out of range"), "{said}");

    // Each of these was answered by "labels erased".
    let before = found();
    let (_, said) = success(label(&["--erase", "0.6:1.4", "--erase", "50:60"]));
    assert!(said.contains("no label is there to be erased"), "{said}");
    let empty = write_file(folder.path(), "empty.txt", "");
    let (_, said) = success(command!("recording label", &recording, "--from", empty));
    assert!(said.contains("no label was given"), "{said}");
    assert_eq!(found(), before);
    let (_, said) = success(label(&["--erase", "0.4:1.6"]));
    assert!(said.contains("3 labels cut or removed"), "{said}");
}

/// Regression test: a label without duration at the start of the interval stayed.
#[test]
fn labels_without_duration_are_erased() {
    let folder = tempfile::tempdir().expect("a folder");
    let recording = folder.path().join("run.mcap");
    std::fs::copy(fixture("formats/recording.mcap"), &recording).expect("copies");
    let before = labels_of(&recording);
    success(command!("recording label --span 3.7:3.7=knock --span 3.9:3.9=knock", &recording));
    let (_, said) = success(command!("recording label --erase 3.7:3.9", &recording));
    assert!(said.contains("1 label cut or removed"), "{said}");
    let mut left = labels_of(&recording);
    assert_eq!(left.pop().expect("the label at the end")["start_s"], 3.9);
    assert_eq!(left, before);
}

/// Regression test: parts of labels were left out, and a confidence of 1 was put in, without a word.
#[test]
fn parts_that_a_file_of_labels_does_not_hold_are_reported() {
    let folder = tempfile::tempdir().expect("a folder");
    let recording = fixture("formats/recording.mcap");
    let both = ["authors", "times of labelling"];
    for (name, others) in [("a.txt", &["confidences", "notes"][..]), ("a.label", &["the lack of a confidence"][..])] {
        let (_, said) = success(command!("recording label", &recording, "-o", folder.path().join(name)));
        let told: Vec<&str> = said.lines().filter_map(|line| line.strip_prefix("not held by this format: ")).collect();
        assert_eq!(told.len(), both.len() + others.len(), "{name}: {said}");
        for (what, told) in both.iter().chain(others).zip(told) {
            assert!(told.starts_with(what), "{name}: {told}");
        }
    }
}

/// JSON holds all parts of labels, and is read again, as that of the page is.
#[test]
fn labels_in_json_lose_nothing() {
    let folder = tempfile::tempdir().expect("a folder");
    let (recording, json) = (fixture("formats/recording.mcap"), folder.path().join("labels.json"));
    let (_, said) = success(command!("recording label", &recording, "-o", &json));
    assert!(!said.contains("not held"), "{said}");
    let copy = folder.path().join("run.mcap");
    std::fs::copy(&recording, &copy).expect("copies");
    success(command!("recording label --erase 0:1000", &copy));
    assert!(labels_of(&copy).is_empty());
    success(command!("recording label --from", &json, &copy));
    assert_eq!(labels_of(&copy), labels_of(&recording));
}

/// Regression test: labels that the page exports were refused if one of them was in the recording already, as it is when another program
/// changes the labels of a recording whose page saves no more.
#[test]
fn exported_labels_are_added_to_those_that_were_saved() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| folder.path().join(name);
    simulate(&fixture("scenes/desk.toml"), "--frames 40", &path("run.mcap"));
    let add = |file: &Path| success(command!("recording label", path("run.mcap"), "--from", file)).1;
    let all = r#"[{"start_s":0.0,"end_s":1.0,"label":"empty"},{"start_s":1.0,"end_s":2.0,"label":"one"}]"#;
    let (all, other) = (write_file(folder.path(), "all.json", all), path("saved.txt"));
    success(command!("recording label --span 0:1=empty", path("run.mcap")));
    let said = add(&all);
    assert!(said.contains("1 label there already") && said.contains("1 label written"), "{said}");
    assert_eq!(labels_of(&path("run.mcap")).len(), 2);
    // Files of other tools hold rounded times.
    success(command!("recording label", path("run.mcap"), "-o", &other));
    let said = add(&other);
    assert!(said.contains("2 labels there already") && !said.contains("written"), "{said}");
    assert_eq!(labels_of(&path("run.mcap")).len(), 2);
    let text = r#"[{"start_s":0.0,"end_s":1.0,"label":"one"}]"#;
    let text = write_file(folder.path(), "other.json", text);
    fails_with(command!("recording label", path("run.mcap"), "--from", text), &["overlap", "--replace"]);
}

/// Regression test: labels of a text recording were those of every other whose name was the same up to its last dot. The vendor's SDK
/// gives its recordings no ending.
#[test]
fn labels_beside_a_recording_are_its_own() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| folder.path().join(name);
    simulate(&fixture("scenes/desk.toml"), "--frames 20", &path("run.mcap"));
    for name in ["walk_0.5m", "walk_0.7m", "walk.txt"] {
        success(command!("recording convert --to text", path("run.mcap"), path(name)));
    }
    for (name, labels) in [("walk_0.5m", "walk_0.5m.label"), ("walk.txt", "walk.label")] {
        success(command!("recording label --span 0:1=two", path(name)));
        assert!(path(labels).exists() && labels_of(&path(name)).len() == 1, "{name}");
    }
    assert!(labels_of(&path("walk_0.7m")).is_empty());
}

/// They were in the order in which they had been made.
#[test]
fn labels_are_listed_and_exported_in_order_of_time() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| folder.path().join(name);
    simulate(&fixture("scenes/desk.toml"), "--frames 40", &path("run.mcap"));
    for span in ["2:3=two", "0:1=empty", "1:2=one"] {
        success(command!("recording label --span", span, path("run.mcap")));
    }
    let times: Vec<_> = labels_of(&path("run.mcap")).iter().map(|label| label["start_s"].as_f64()).collect();
    assert_eq!(times, [Some(0.0), Some(1.0), Some(2.0)]);
    success(command!("recording label", path("run.mcap"), "-o", path("run.txt")));
    let text = std::fs::read_to_string(path("run.txt")).expect("written");
    let exported: Vec<_> = text.lines().filter_map(|line| line.split('\t').nth(2)).collect();
    assert_eq!(exported, ["empty", "one", "two"]);
}

/// Regression test: the rest of such a label was a line of its own.
#[test]
fn a_label_with_a_line_end_is_one_line_of_the_table() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("run.mcap");
    simulate(&fixture("scenes/desk.toml"), "--frames 20", &path);
    success(subcommand("recording label").arg(&path).args(["--span", "0:1=two\npeople\x1b[2J"]));
    assert_eq!(labels_of(&path)[0]["label"], "two\npeople\x1b[2J");
    let (table, _) = success(command!("recording label", &path));
    assert!(table.lines().count() == 1 && table.contains(r"two\npeople\u{1b}[2J"), "{table}");
    let (table, _) = success(command!("recording labels", &path));
    assert!(table.lines().count() == 1 && table.contains(r"two\npeople\u{1b}[2J"), "{table}");
    let (info, _) = success(command!("recording info", &path));
    assert!(info.contains(r"two\npeople\u{1b}[2J 1.0 s"), "{info}");
}

#[test]
fn labels_of_a_live_recording_outlive_a_program_that_is_killed() {
    let folder = tempfile::tempdir().expect("a folder");
    let made = folder.path().join("made.mcap");
    let source = format!("emulated:{}", fixture("scenes/desk.toml").display());
    let served = Served::start(command!("live", &source, "--model cfar --speed 1 -o", &made));
    let mut socket = page(&served.address);
    // Waits for the first frame, since labels begin at the newest one.
    while !socket.read().expect("a message").is_binary() {}
    for (key, ended) in [("one", 0), ("two", 1), ("empty", 2)] {
        // Waits for more frames, so that the previous label has a length.
        let before = labels_of(&made).last().map_or(0.0, |span| span["end_s"].as_f64().expect("a time"));
        wait_for("a label that grows in the file", || {
            (ended == 0 || labels_of(&made).last()?["end_s"].as_f64()? > before).then_some(())
        });
        socket.send(Message::text(format!("{{\"do\":\"label\",\"occupancy\":\"{key}\"}}"))).expect("sent");
        loop {
            let Message::Text(text) = socket.read().expect("a message") else { continue };
            let said: Value = serde_json::from_str(&text).expect("JSON");
            let labels = &said["labels"];
            let is_there = labels["open"]["label"] == key && labels["spans"].as_array().map(Vec::len) == Some(ended);
            if is_there && labels["saved"] == true {
                assert_eq!(labels["place"], made.display().to_string());
                break;
            }
        }
    }
    // Dropping kills the program by SIGKILL.
    drop(served);
    let killed = labels_of(&made);
    let names: Vec<&str> = killed.iter().filter_map(|span| span["label"].as_str()).collect();
    assert!(names == ["one", "two", "empty"] || names == ["one", "two"], "{killed:?}");
    for pair in killed.windows(2) {
        assert_eq!(pair[0]["end_s"], pair[1]["start_s"]);
    }
    let repaired = folder.path().join("repaired.mcap");
    // The program may have been killed within a chunk, which is then lost.
    json_lines_of(command!("recording repair --json", &made, "-o", &repaired), &[0, 3]);
    // A label that grows is ahead of the frames in the file, to which a repair cuts it.
    let interval_s = Recording::open(&repaired).expect("opens").header().waveform.frame_interval_s();
    let end_s = frames_and_gaps(&repaired).0.last().expect("a frame").time_s() + interval_s;
    let mut cut = killed;
    cut.retain(|span| span["start_s"].as_f64().expect("a time") < end_s - 1e-3);
    let mut kept = labels_of(&repaired);
    assert_eq!(kept.len(), cut.len(), "{kept:?}, {cut:?}");
    for (kept, cut) in kept.iter_mut().zip(&mut cut) {
        let [kept_s, cut_s] = [&mut *kept, &mut *cut].map(|span| span["end_s"].take().as_f64().expect("a time"));
        assert!((kept_s - cut_s.min(end_s)).abs() < 1e-6, "{kept_s} of {cut_s} up to {end_s}");
        assert_eq!(kept, cut);
    }
}

/// Asserts that the page shows the command that adapts the model by the labels, that it reports missing labels, and
/// that the command works.
#[test]
fn the_page_offers_to_adapt_the_model_once_there_are_labels() {
    let folder = tempfile::tempdir().expect("a folder");
    let recording = folder.path().join("it is mine.mcap");
    simulate(&fixture("scenes/hall.toml"), "--people 1 --seed 700101 --frames 60", &recording);
    let served = Served::start(command!("live", &recording, "--speed 1"));
    let mut socket = page(&served.address);
    let mut told_with = |spans: usize, request: Option<&str>| -> Value {
        if let Some(request) = request {
            socket.send(Message::text(request)).expect("sent");
        }
        loop {
            let Message::Text(text) = socket.read().expect("a message") else { continue };
            let said: Value = serde_json::from_str(&text).expect("JSON");
            let labels = &said["labels"];
            if labels["spans"].as_array().map(Vec::len) == Some(spans) && labels["saved"] == true {
                return labels.clone();
            }
        }
    };
    assert!(told_with(0, None)["adaptation"].is_null());
    let add = r#"{"do":"add","start_s":0.5,"end_s":2.5,"occupancy":"empty","who":null}"#;
    let told = told_with(1, Some(add));
    let (text, command) = (&told["adaptation"]["text"], &told["adaptation"]["command"]);
    let text = text.as_str().unwrap_or_else(|| panic!("{told}"));
    assert!(text.contains("2 s empty, 0 s one, 0 s two") && text.contains("Without people"), "{text}");
    let command = command.as_str().unwrap_or_else(|| panic!("{told}")).to_owned();
    assert!(command.starts_with("radome model adapt room-hqnn '"), "{command}");
    assert!(served.stop(), "an orderly end");

    // Runs the command in a shell, as a user would.
    let program = radome();
    let folder_of_program = Path::new(program.get_program()).parent().expect("a folder");
    let mut shell = Command::new("/bin/sh");
    shell.args(["-c", &command]).current_dir(folder.path()).env("PATH", folder_of_program);
    success(&mut shell);
    assert!(folder.path().join("room-mine.safetensors").is_file());
}
