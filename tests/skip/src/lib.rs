//! Tests that cannot run on a machine, counted.
//!
//! libtest cannot ignore a test while it runs. A test that lacks something calls [`skip`] and returns; `tests/run` lists such
//! tests at its end, and can fail for them.

use std::fs::OpenOptions;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

/// Variable that names the file to which skipped tests are appended; `tests/run` sets it.
const FILE_VARIABLE: &str = "RADOME_SKIPPED";

/// Counts the running test as skipped: what it lacks, one word, and how to get it.
///
/// Without `RADOME_SKIPPED` it is said on stderr.
///
/// # Panics
/// If the file that `RADOME_SKIPPED` names cannot be written: a skip that nobody sees is a failure.
#[allow(clippy::print_stderr)]
pub fn skip(lacks: &str, hint: &str) {
    let line = line(&name_of_test(), lacks, hint);
    match std::env::var_os(FILE_VARIABLE) {
        Some(path) => {
            append(Path::new(&path), &line).unwrap_or_else(|e| panic!("{FILE_VARIABLE}, {}: {e}", path.display()));
        }
        None => eprint!("skipped: {line}"),
    }
}

/// A file or folder of the data that lies beside the project: in the folder that `RADOME_SHARED` names, or in `../shared`.
/// `None` where it is absent: the test is then counted as skipped, and returns.
pub fn shared(name: &str) -> Option<PathBuf> {
    let path = shared_folder().join(name);
    if !path.exists() {
        skip("shared-data", &format!("{} is absent; RADOME_SHARED names the folder that holds data/", path.display()));
        return None;
    }
    Some(path)
}

/// Folder of the data that lies beside the project, whether or not it exists.
pub fn shared_folder() -> PathBuf {
    std::env::var_os("RADOME_SHARED")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared"), PathBuf::from)
}

/// Fields in the order in which `tests/run` reads them, one line a test.
fn line(test: &str, lacks: &str, hint: &str) -> String {
    let one_line = |text: &str| text.split_whitespace().collect::<Vec<_>>().join(" ");
    format!("{}\t{}\t{}\n", one_line(lacks), one_line(test), one_line(hint))
}

/// Test programs run in parallel: a line is one write at the end of the file.
fn append(path: &Path, line: &str) -> io::Result<()> {
    OpenOptions::new().append(true).create(true).open(path)?.write_all(line.as_bytes())
}

/// Program without the hash in its name, and test: libtest names the thread of a test after it.
fn name_of_test() -> String {
    let program = std::env::current_exe().ok();
    let stem = program.as_deref().and_then(Path::file_stem).unwrap_or_default().to_string_lossy().into_owned();
    let program = stem.rsplit_once('-').map_or(stem.as_str(), |(name, _hash)| name);
    format!("{program}::{}", std::thread::current().name().unwrap_or("a test"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_skip_is_one_line_with_what_is_lacking_and_the_test() {
        let name = name_of_test();
        assert_eq!(name, "radome_skip::tests::a_skip_is_one_line_with_what_is_lacking_and_the_test");
        assert_eq!(line(&name, "mosquitto", "no\tbroker\nhere"), format!("mosquitto\t{name}\tno broker here\n"));
    }

    #[test]
    fn skips_of_parallel_tests_are_whole_lines() {
        let path = std::env::temp_dir().join(format!("radome-skip-{}", std::process::id()));
        std::thread::scope(|scope| {
            for test in 0..8 {
                let path = &path;
                scope.spawn(move || {
                    for _ in 0..50 {
                        append(path, &line(&test.to_string(), "broker", "install one")).expect("a file");
                    }
                });
            }
        });
        let text = std::fs::read_to_string(&path).expect("a file");
        std::fs::remove_file(&path).expect("removable");
        assert_eq!(text.lines().count(), 400);
        assert!(text.lines().all(|line| line.starts_with("broker\t") && line.ends_with("\tinstall one")), "{text}");
    }
}
