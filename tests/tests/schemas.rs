//! Compares `radome schema` with `docs/schemas`, and checks the fixtures that name these schemas.
//! `python/tests/test_schemas.py` checks that the schemas accept the fixtures and refuse wrong keys.

use std::fs;

use radome_tests::{command, fixture, root, success};
use serde_json::Value;

const KINDS: [&str; 6] = ["dataset", "receiver", "scene", "study", "training", "waveform"];

/// Folders of fixtures, each with the kind of its files. Settings of trainings lie in the same folders as datasets.
const FOLDERS: [(&str, &str); 5] = [
    ("datasets", "dataset"),
    ("ladder/scenes", "scene"),
    ("receivers", "receiver"),
    ("scenes", "scene"),
    ("studies", "study"),
];

fn print_schema(kind: &str) -> Value {
    serde_json::from_str(&success(command!("schema", kind)).0).expect("JSON")
}

#[test]
fn the_schemas_in_docs_are_those_of_the_program() {
    for kind in KINDS {
        let text = fs::read_to_string(root().join(format!("docs/schemas/{kind}.json"))).unwrap_or_default();
        let kept: Option<Value> = serde_json::from_str(&text).ok();
        assert!(
            kept == Some(print_schema(kind)),
            "docs/schemas/{kind}.json is not what the program prints\n\nhint: target/release/radome schema {kind} > \
             docs/schemas/{kind}.json"
        );
    }
}

#[test]
fn fixtures_name_their_schemas_in_their_first_lines() {
    let mut count = 0;
    for (folder, kind) in FOLDERS {
        let up = "../".repeat(2 + folder.matches('/').count());
        for entry in fs::read_dir(fixture(folder)).expect("a folder") {
            let path = entry.expect("an entry").path();
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            if !name.ends_with(".toml") {
                continue;
            }
            let kind = if name.ends_with("-training.toml") { "training" } else { kind };
            let text = fs::read_to_string(&path).expect("a fixture");
            let expected = format!("#:schema {up}docs/schemas/{kind}.json");
            assert_eq!(text.lines().next(), Some(expected.as_str()), "{}", path.display());
            count += 1;
        }
    }
    assert!(count > 45, "{count} fixtures found");
}

/// Asserts that every key has a description, which editors show as help, and that no type is null, which TOML lacks.
#[test]
fn schemas_describe_their_keys_and_know_no_null() {
    for kind in KINDS {
        let schema = print_schema(kind);
        assert_eq!(schema["additionalProperties"], false, "{kind}");
        let keys = schema["properties"].as_object().expect("keys");
        assert!(keys.len() > 5, "{kind}: {keys:?}");
        for (key, of_key) in keys {
            assert!(of_key["description"].is_string(), "{kind}: {key} has no description: {of_key}");
        }
        let text = schema.to_string();
        assert!(!text.contains("\"null\"") && !text.contains("\"default\":null"), "{kind}: {text}");
    }
}
