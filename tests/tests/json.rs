//! Compares `docs/json.md` with the program: every command with `--json` has a section, which lists every key that it
//! prints.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::process::Command;

use radome_tests::{fixture, help, json_lines, json_lines_of, radome, root, subcommands};
use serde_json::Value;

/// Rows of a section: key and meaning.
type Rows = Vec<(String, String)>;

/// Sections of the page by the anchors of their headings.
struct Page(BTreeMap<String, Rows>);

impl Page {
    fn read() -> Self {
        let text = std::fs::read_to_string(root().join("docs/json.md")).expect("the page");
        let mut sections: BTreeMap<String, Rows> = BTreeMap::new();
        let mut heading = String::new();
        for line in text.lines() {
            if let Some(name) = line.strip_prefix("## ") {
                heading = name.replace('`', "").to_lowercase().replace(' ', "-");
                assert!(sections.insert(heading.clone(), Rows::new()).is_none(), "two sections {name}");
            } else if let Some((key, meaning)) = line.strip_prefix("| `").and_then(|row| row.split_once("` | ")) {
                let rows = sections.get_mut(&heading).expect("a heading above the table");
                rows.push((key.to_owned(), meaning.trim_end_matches(" |").to_owned()));
            }
        }
        Page(sections)
    }

    /// Keys of a section, including those of the sections that its rows refer to.
    fn keys(&self, anchor: &str) -> Vec<String> {
        let rows = self.0.get(anchor).unwrap_or_else(|| panic!("docs/json.md has no section #{anchor}"));
        let mut keys = Vec::new();
        for (key, meaning) in rows {
            let link = meaning.split_once("](#").and_then(|(_, rest)| rest.split_once(')'));
            let Some((target, _)) = link else {
                keys.push(key.clone());
                continue;
            };
            let below = self.keys(target);
            match key.as_str() {
                "*" => keys.extend(below),
                _ => keys.extend(below.into_iter().map(|name| format!("{key}.{name}"))),
            }
        }
        keys
    }
}

/// Whether a key of the page covers a printed key: it is equal, a wildcard for it, or a key within it.
fn covers(documented: &str, printed: &str) -> bool {
    let is_within = documented.strip_prefix(printed).is_some_and(|rest| rest.starts_with(['.', '[']));
    let is_wildcard = documented.strip_suffix('*').is_some_and(|prefix| printed.starts_with(prefix));
    documented == printed || is_within || is_wildcard
}

/// Adds the keys of a value: `a.b` within objects, `a[].b` within lists.
fn add_keys(value: &Value, place: &str, found: &mut BTreeSet<String>) {
    match value {
        Value::Object(object) => {
            for (name, value) in object {
                let key = if place.is_empty() { name.clone() } else { format!("{place}.{name}") };
                add_keys(value, &key, found);
                found.insert(key);
            }
        }
        Value::Array(list) => list.iter().for_each(|value| add_keys(value, &format!("{place}[]"), found)),
        _ => {}
    }
}

/// Asserts that the section of a command lists every key that it printed.
fn assert_documented(page: &Page, command: &str, printed: &[Value]) {
    let mut found = BTreeSet::new();
    printed.iter().for_each(|value| add_keys(value, "", &mut found));
    let documented = page.keys(&format!("radome-{}", command.replace(' ', "-")));
    let missing: Vec<_> = found.iter().filter(|printed| !documented.iter().any(|key| covers(key, printed))).collect();
    assert!(missing.is_empty(), "radome {command} prints keys that docs/json.md lacks: {missing:?}");
}

/// A command with its arguments and `--json`.
fn with_json(command: &str, arguments: &[&str]) -> Command {
    let mut with = radome();
    with.args(command.split(' ')).args(arguments).arg("--json");
    with
}

fn path_text(path: &Path) -> &str {
    path.to_str().expect("a path in UTF-8")
}

/// Adds the commands of a group that take `--json`, according to their help.
fn add_commands(group: &str, found: &mut Vec<String>) {
    let help = help(group);
    if help.contains("--json") {
        found.push(group.to_owned());
    }
    for name in subcommands(&help) {
        add_commands(format!("{group} {name}").trim_start(), found);
    }
}

#[test]
fn every_command_with_json_has_a_section() {
    let page = Page::read();
    let mut commands = Vec::new();
    add_commands("", &mut commands);
    assert!(commands.len() > 30, "{commands:?}");
    for command in &commands {
        assert!(!page.keys(&format!("radome-{}", command.replace(' ', "-"))).is_empty(), "{command}");
    }
    let of_commands = page.0.keys().filter(|anchor| anchor.starts_with("radome-")).count();
    assert_eq!(of_commands, commands.len(), "docs/json.md has sections of commands that are gone");
}

#[test]
fn every_key_of_recordings_is_documented() {
    let page = Page::read();
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name);
    let judged = fixture("formats/judged.mcap");
    let golden = path_text(&judged);
    for (command, arguments) in [
        ("recording info", vec![golden]),
        ("recording convert", vec![golden, path_text(&at("session.txt"))]),
        ("recording convert", vec![golden, path_text(&at("viewers.mcap")), "--to", "viewers"]),
        ("recording repair", vec![golden, "-o", path_text(&at("repaired.mcap"))]),
        ("recording label", vec![golden]),
        ("recording answers", vec![golden]),
        ("recording maps", vec![golden, "-o", path_text(&at("maps.npy"))]),
        ("record", vec![golden, "-o", path_text(&at("copy.mcap")), "--allow-loss"]),
    ] {
        assert_documented(&page, command, &json_lines(with_json(command, &arguments)));
    }
}

#[test]
fn every_key_of_scenes_answers_and_scores_is_documented() {
    let page = Page::read();
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name);
    let (corridor, room) = (fixture("scenes/corridor.toml"), at("room.mcap"));
    let (scene, room) = (path_text(&corridor), path_text(&room));
    let labelled = format!("{room}=empty");
    for (command, arguments) in [
        ("scene simulate", vec![scene, "--frames", "3", "--seed", "5", "-o", room]),
        ("scene preview", vec![scene, "-o", path_text(&at("room.png"))]),
        ("scene paths", vec![scene]),
        ("scene people", vec![scene]),
        ("recording echoes", vec![room]),
        ("live", vec![room]),
        ("model evaluate", vec!["--model", "cfar", labelled.as_str()]),
    ] {
        assert_documented(&page, command, &json_lines(with_json(command, &arguments)));
    }
}

#[test]
fn every_key_of_boards_models_and_stages_is_documented() {
    let page = Page::read();
    let folder = tempfile::tempdir().expect("a folder");
    let (model, onnx) = (fixture("models/paper-hqnn.safetensors"), folder.path().join("model.onnx"));
    for (command, arguments) in [
        ("board list", vec![]),
        ("board config", vec!["--registers"]),
        ("model list", vec![]),
        ("model export", vec![path_text(&model), "-o", path_text(&onnx)]),
        ("bench circuit", vec!["--x", "0.1,0.2", "--theta", "0.1,0.2,0.3,0.4"]),
        ("bench rcs", vec!["sphere"]),
        ("bench trainability", vec!["--qubits", "2", "--points", "2"]),
    ] {
        assert_documented(&page, command, &json_lines(with_json(command, &arguments)));
    }
    // `doctor` fails where one of its checks fails.
    assert_documented(&page, "doctor", &json_lines_of(with_json("doctor", &[]), &[0, 1]));
}

mod hard_cases {
    use super::*;

    #[test]
    fn a_key_that_is_not_documented_is_found() {
        assert!(covers("a.b", "a.b") && covers("a.b", "a") && covers("a[].b", "a"));
        assert!(covers("labels.*", "labels.one") && covers("labels.*", "labels"));
        assert!(!covers("a.b", "a.c") && !covers("a", "a.b") && !covers("ab.c", "a"));
        let page = Page::read();
        assert!(page.keys("radome-recording-info").contains(&"waveform.request.start_frequency_hz".to_owned()));
        assert!(!page.keys("radome-recording-info").iter().any(|key| covers(key, "waveform.request.speed")));
        assert!(page.keys("radome-recording-label").contains(&"[].start_s".to_owned()));
    }
}
