//! Paths of the program's own scenes and models, and atomic writes of files.

use std::fs::File;
use std::io::{self, BufWriter, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};
use radome_driver::recording::{Existing, Partial};
use radome_files::{TEXT_LIMIT_BYTES, named_by_spec, parent_folder, parse_toml, read_text};
use serde::de::DeserializeOwned;

use crate::{output, shell};

/// Finds a file under `fixtures/`: from the working directory, beside the executable, or in the source tree.
///
/// # Errors
/// The file is in none of these places.
pub fn fixture(name: &str) -> anyhow::Result<PathBuf> {
    let beside_executable = std::env::current_exe().ok().and_then(|exe| Some(exe.parent()?.join("fixtures")));
    let roots = [
        Some(PathBuf::from("fixtures")),
        beside_executable,
        Some(Path::new(env!("CARGO_MANIFEST_DIR")).join("../fixtures")),
    ];
    for root in roots.iter().flatten() {
        let path = root.join(name);
        if path.exists() {
            return Ok(path);
        }
    }
    bail!("fixtures/{name} is not here\n\nhint: run radome in its source folder, or name a file of your own")
}

/// Reads a text file of limited length.
///
/// # Errors
/// The file cannot be read, is too long or is not UTF-8.
pub fn read_text_file(path: &Path) -> anyhow::Result<String> {
    read_text(path, TEXT_LIMIT_BYTES).with_context(|| format!("cannot read {}", path.display()))
}

/// Reads a TOML file. Errors name `what` the file should be.
///
/// # Errors
/// The file cannot be read, or its content does not match the type.
pub fn read_toml<T: DeserializeOwned>(path: &Path, what: &str) -> anyhow::Result<T> {
    parse_toml(&read_text_file(path)?).with_context(|| format!("{} is no {what}", path.display()))
}

/// Returns the path of a file that a spec in a folder names.
///
/// # Errors
/// There is no such file, or it lies where files that others name may not be.
pub fn resolve_named(folder: &Path, name: &Path) -> anyhow::Result<PathBuf> {
    named_by_spec(folder, name).with_context(|| format!("cannot read {}", folder.join(name).display()))
}

/// Output that is written under a temporary name. Errors of writing name the output.
pub struct OutputFile {
    file: File,
    target: PathBuf,
}

impl OutputFile {
    /// Adds the path of the output to an error.
    fn with_path<T>(&self, result: io::Result<T>) -> io::Result<T> {
        result.map_err(|error| io::Error::new(error.kind(), format!("{}: {error}", self.target.display())))
    }
}

impl Write for OutputFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let written = self.file.write(bytes);
        self.with_path(written)
    }

    fn flush(&mut self) -> io::Result<()> {
        let flushed = self.file.flush();
        self.with_path(flushed)
    }
}

impl Seek for OutputFile {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        let sought = self.file.seek(to);
        self.with_path(sought)
    }
}

/// Writes a file atomically: under a temporary name, synced to the disk, and renamed when `write` is done.
///
/// # Errors
/// The file exists and is not to be replaced, cannot be written, or `write` fails.
pub fn write_output(
    path: &Path,
    existing: Existing,
    write: impl FnOnce(&mut BufWriter<OutputFile>) -> anyhow::Result<()>,
) -> anyhow::Result<()> {
    let partial = Partial::file(path, existing)?;
    write_partial(&partial, write)?;
    Ok(partial.finish()?)
}

/// Writes bytes to a file atomically, as [`write_output`] does.
///
/// # Errors
/// The file exists and is not to be replaced, or cannot be written.
pub fn write_bytes(path: &Path, existing: Existing, bytes: &[u8]) -> anyhow::Result<()> {
    write_output(path, existing, |file| Ok(file.write_all(bytes)?))
}

/// Creates a file that only its owner may read. It gets its name when it is on the disk, and replaces no file or link.
///
/// # Errors
/// [`io::ErrorKind::AlreadyExists`] if the name is taken, and other errors of the system.
pub fn create_private(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let mut file = tempfile::NamedTempFile::new_in(parent_folder(path))?;
    file.write_all(bytes)?;
    file.as_file().sync_all()?;
    file.persist_noclobber(path).map(drop).map_err(|error| error.error)
}

/// Writes lines to a file atomically, as [`write_output`] does. Without a file, writes them to stdout, each at once.
///
/// # Errors
/// A line is an error, the file exists and is not to be replaced, the output cannot be written, or the user interrupts.
pub fn write_lines(
    path: Option<&Path>,
    existing: Existing,
    lines: impl Iterator<Item = anyhow::Result<String>>,
) -> anyhow::Result<()> {
    let Some(path) = path else {
        for line in lines {
            output::text_line(&line?)?;
        }
        ensure!(!output::interrupted(), "interrupted");
        return Ok(());
    };
    write_output(path, existing, |file| {
        for line in lines {
            writeln!(file, "{}", line?).context("cannot write the file")?;
        }
        ensure!(!output::interrupted(), "interrupted: nothing is written");
        Ok(())
    })
}

/// Writes an output that has been started.
///
/// # Errors
/// The file cannot be written, or `write` fails.
pub fn write_partial(
    partial: &Partial,
    write: impl FnOnce(&mut BufWriter<OutputFile>) -> anyhow::Result<()>,
) -> anyhow::Result<()> {
    let mut writer = BufWriter::new(OutputFile { file: partial.open()?, target: partial.target().to_owned() });
    write(&mut writer)?;
    writer.flush().context("cannot write the file")
}

/// Length of the header of a growing array, bytes. Any number of rows fits, so the header can be completed last.
const ARRAY_HEADER_BYTES: usize = 192;

/// Formats the header of an array of f32 in the NPY format, version 1.0.
fn array_header(rows: u64, row_shape: &[u64]) -> Vec<u8> {
    let row: String = row_shape.iter().map(|n| format!(" {n},")).collect();
    let text = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({rows},{row}), }}");
    let length = ARRAY_HEADER_BYTES - 10;
    let mut header = b"\x93NUMPY\x01\x00".to_vec();
    header.extend((length as u16).to_le_bytes());
    header.extend(format!("{text:<width$}\n", width = length - 1).into_bytes());
    header
}

/// Writes an `.npy` of f32. `write` writes the values and returns the length of the first axis.
///
/// # Errors
/// The file cannot be written, or `write` fails.
pub fn write_growing_array<W: Write + Seek>(
    file: &mut W,
    row_shape: &[u64],
    write: impl FnOnce(&mut W) -> anyhow::Result<u64>,
) -> anyhow::Result<()> {
    let cannot = "cannot write the array";
    file.write_all(&array_header(0, row_shape)).context(cannot)?;
    let rows = write(file)?;
    file.seek(SeekFrom::Start(0)).context(cannot)?;
    file.write_all(&array_header(rows, row_shape)).context(cannot)
}

/// Fails early if the folder of an output file is missing.
///
/// # Errors
/// The folder does not exist, or is a file.
pub fn check_parent(path: &Path) -> anyhow::Result<()> {
    let parent = parent_folder(path);
    ensure!(
        parent.is_dir() || !parent.exists(),
        "{} is a file, and no folder for {}\n\nhint: name another place",
        parent.display(),
        path.display()
    );
    ensure!(
        parent.is_dir(),
        "folder {} does not exist\n\nhint: mkdir -p {}",
        parent.display(),
        shell::word(&parent.to_string_lossy())
    );
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Regression test: the hint was to make the folder, although a file has its name.
    #[test]
    fn the_error_reports_that_a_file_has_the_name_of_the_outputs_folder() {
        let folder = tempfile::tempdir().expect("a folder");
        let file = folder.path().join("night.mcap");
        std::fs::write(&file, "").expect("writes");
        let error = check_parent(&file.join("maps.npy")).expect_err("refused").to_string();
        assert!(error.contains("night.mcap is a file") && !error.contains("mkdir"), "{error}");
        let error = check_parent(&folder.path().join("new/maps.npy")).expect_err("refused").to_string();
        assert!(error.contains("mkdir -p"), "{error}");
        check_parent(&file).expect("a folder");
    }

    #[test]
    fn a_growing_array_reads_back_as_what_was_written() {
        let mut file = std::io::Cursor::new(Vec::new());
        write_growing_array(&mut file, &[2, 3], |file| {
            (0..12u8).try_for_each(|i| std::io::Write::write_all(file, &f32::from(i).to_le_bytes()))?;
            Ok(2)
        })
        .expect("writes");
        let array = npyz::NpyFile::new(file.get_ref().as_slice()).expect("an array");
        assert_eq!(array.shape(), [2, 2, 3]);
        assert_eq!(array.into_vec::<f32>().expect("f32"), (0..12u8).map(f32::from).collect::<Vec<_>>());
        // The longest possible header still fits.
        assert_eq!(array_header(u64::MAX, &[u64::MAX; 3]).len(), ARRAY_HEADER_BYTES);
    }
}
