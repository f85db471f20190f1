//! Tests of exported ONNX models in onnxruntime, where it is installed: `tests/run` installs it under `target/`.

use std::path::{Path, PathBuf};

use radome_tests::{command, fails_with, failure, fixture, json_lines, simulate, skip, write_file};
use serde_json::Value;

/// Shipped models that have an ONNX form, each with a scene of its waveform.
const MODELS: [(&str, &str); 3] = [("paper-hqnn", "corridor"), ("desk-hqnn", "desk"), ("room-cnn", "hall")];

fn export(model: &Path, folder: &Path) -> PathBuf {
    let file = folder.join(model.with_extension("onnx").file_name().expect("a name"));
    let lines = json_lines(command!("model export --json", model, "-o", &file));
    assert_eq!(lines[0]["bytes"].as_u64(), std::fs::metadata(&file).map(|of| of.len()).ok(), "{lines:?}");
    file
}

/// Whether onnxruntime is installed, according to the program's message about an ONNX file. Counts the test as skipped
/// where it is not.
fn is_installed(onnx: &Path) -> bool {
    let said = failure(command!("model evaluate --model", onnx, "nowhere=one"));
    let installed = !said.contains("onnxruntime");
    if !installed {
        assert!(said.contains("pip install") && said.contains("ORT_DYLIB_PATH"), "{said}");
        skip("onnxruntime", &said);
    }
    installed
}

fn without_latency(answer: &Value) -> Value {
    let mut answer = answer.clone();
    answer["latency_ms"] = Value::Null;
    answer
}

/// Asserts that two values are equal except for the last digits of numbers.
fn assert_alike(a: &Value, b: &Value) {
    match (a, b) {
        (Value::Object(a), Value::Object(b)) => {
            assert!(a.keys().eq(b.keys()), "{a:?} {b:?}");
            a.values().zip(b.values()).for_each(|(a, b)| assert_alike(a, b));
        }
        (Value::Array(a), Value::Array(b)) => {
            assert_eq!(a.len(), b.len());
            a.iter().zip(b).for_each(|(a, b)| assert_alike(a, b));
        }
        (Value::Number(x), Value::Number(y)) => {
            let (x, y) = (x.as_f64().expect("f64"), y.as_f64().expect("f64"));
            assert!((x - y).abs() <= 1e-5, "{x} {y}");
        }
        (a, b) => assert_eq!(a, b),
    }
}

#[test]
fn exported_models_give_the_same_answers() {
    let folder = tempfile::tempdir().expect("a folder");
    for (model, scene) in MODELS {
        let native = fixture(&format!("models/{model}.safetensors"));
        let onnx = export(&native, folder.path());
        if !is_installed(&onnx) {
            return;
        }
        let recording = folder.path().join(format!("{model}.mcap"));
        let scene = fixture(&format!("scenes/{scene}.toml"));
        // More frames than the window of the desk's maps holds.
        simulate(&scene, "--frames 140 --people 1", &recording);
        // Probabilities of every frame from `live`.
        let live = |model: &Path| json_lines(command!("live --json", &recording, "--model", model));
        let (ours, theirs) = (live(&native), live(&onnx));
        assert!(ours.len() > 140 && ours.len() == theirs.len(), "{model}: {} {}", ours.len(), theirs.len());
        assert!(ours.iter().any(|answer| answer["probabilities"]["one"].is_number()), "{model}");
        for (a, b) in ours.iter().zip(&theirs).take(140) {
            assert_alike(&without_latency(a), &without_latency(b));
        }
        let labelled = format!("{}=one", recording.display());
        let evaluate = |model: &Path| json_lines(command!("model evaluate --json --model", model, &labelled));
        assert_alike(&evaluate(&native)[0], &evaluate(&onnx)[0]);
    }
}

/// Asserts that an ONNX file can program a board, since its card holds the waveform.
#[test]
fn an_exported_model_keeps_the_waveform() {
    let folder = tempfile::tempdir().expect("a folder");
    let native = fixture("models/paper-hqnn.safetensors");
    let onnx = export(&native, folder.path());
    let config = |path: &Path| json_lines(command!("board config --json", path));
    assert_eq!(config(&native), config(&onnx));
}

mod hard_cases {
    use super::*;

    fn refusal_of(bytes: &[u8]) -> String {
        let folder = tempfile::tempdir().expect("a folder");
        let path = write_file(folder.path(), "some.onnx", bytes);
        failure(command!("live nowhere.mcap --model", &path))
    }

    fn exported_bytes() -> Vec<u8> {
        let folder = tempfile::tempdir().expect("a folder");
        std::fs::read(export(&fixture("models/paper-hqnn.safetensors"), folder.path())).expect("readable")
    }

    /// Asserts that files which are no model are refused by their path, before any runtime is loaded.
    #[test]
    fn files_that_are_no_model_are_refused() {
        let whole = exported_bytes();
        let with = |from: &[u8], to: &[u8]| {
            let mut bytes = whole.clone();
            let at = bytes.windows(from.len()).rposition(|window| window == from).expect("a part of the card");
            bytes[at..at + to.len()].copy_from_slice(to);
            bytes
        };
        for (bytes, expected) in [
            (whole[..whole.len() / 2].to_vec(), "truncated"),
            (b"{\"this\": \"is json\"}".to_vec(), "ONNX"),
            (with(b"\x0a\x06radome", b"\x0a\x06foreig"), "'radome' entry"),
            (with(b"\"format_version\"", b"!"), "model card"),
        ] {
            let said = refusal_of(&bytes);
            assert!(said.contains("some.onnx") && said.contains(expected) && !said.contains("onnxruntime"), "{said}");
        }
        // An ONNX file with a safetensors name is refused too.
        let folder = tempfile::tempdir().expect("a folder");
        let path = write_file(folder.path(), "renamed.safetensors", whole);
        fails_with(command!("live nowhere.mcap --model", &path), &["safetensors"]);
    }

    /// Asserts that files of another user in the working folder do not count as an installation.
    #[test]
    fn a_library_in_the_working_folder_is_not_loaded() {
        let folder = tempfile::tempdir().expect("a folder");
        let onnx = export(&fixture("models/paper-hqnn.safetensors"), folder.path());
        let package = folder.path().join("onnxruntime");
        std::fs::create_dir_all(package.join("capi")).expect("writable");
        std::fs::write(package.join("__init__.py"), "").expect("writable");
        std::fs::write(package.join("capi/libonnxruntime.so.1"), "planted").expect("writable");
        // Plants a python3, found if PATH names the working folder.
        let python = write_file(folder.path(), "python3", format!("#!/bin/sh\necho {}\n", package.display()));
        std::fs::set_permissions(&python, std::os::unix::fs::PermissionsExt::from_mode(0o755)).expect("settable");
        let path = std::env::var("PATH").unwrap_or_default();
        for (variable, value) in [
            ("IGNORED", String::new()),
            ("PYTHONPATH", folder.path().display().to_string()),
            ("PATH", format!(".:{path}")),
        ] {
            let mut command = command!("model evaluate --model", &onnx, "nowhere=one");
            command.current_dir(folder.path()).env_remove("ORT_DYLIB_PATH");
            command.env_remove("PYTHONPATH").env(variable, value);
            // Where onnxruntime is installed, the missing recording causes the failure.
            let said = failure(command);
            assert!(!said.contains("cannot be loaded"), "{variable}: {said}");
        }
    }

    #[test]
    fn a_library_that_is_not_there_is_named_with_the_remedy() {
        let folder = tempfile::tempdir().expect("a folder");
        let onnx = export(&fixture("models/paper-hqnn.safetensors"), folder.path());
        for (library, expected) in [("/nowhere", "/nowhere"), ("Cargo.toml", "cannot be loaded")] {
            let said = failure(command!("model evaluate --model", &onnx, "x=one").env("ORT_DYLIB_PATH", library));
            assert!(said.contains(expected) && said.contains("pip install"), "{said}");
        }
    }
}
