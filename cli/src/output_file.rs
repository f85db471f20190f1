//! Output files named by `-o`. Existing files are replaced only on request, and names can include the time.

use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use anyhow::bail;
use radome_driver::recording::{Existing, Format, utc};

use crate::files;

/// Returns whether `-o` names stdout: `-`. A file of this name is `./-`.
pub fn is_stdout(path: &Path) -> bool {
    path.as_os_str() == "-"
}

/// Placeholder of the time in the name of an output.
const TIME: &str = "{time}";

/// Permission to replace an existing output file.
#[derive(Debug, Clone, Copy, Default, clap::Args)]
pub struct Overwrite {
    /// Replace the output file if it exists. The old file stays until the new one is complete; a recording replaces it at its start
    #[arg(long)]
    overwrite: bool,
}

impl Overwrite {
    /// Replaces whatever is there.
    pub fn yes() -> Self {
        Overwrite { overwrite: true }
    }

    /// Converts to the recording library's type.
    pub fn existing(self) -> Existing {
        if self.overwrite { Existing::Replace } else { Existing::Refuse }
    }

    /// Fails early if the output file could not be written later, or would replace one of the files that are read.
    ///
    /// # Errors
    /// Those of [`check_name`](Self::check_name), or the output is a folder.
    pub fn check(self, path: &Path, inputs: &[&Path]) -> anyhow::Result<()> {
        self.check_name(path, inputs)?;
        if path.is_dir() {
            bail!("{} is a folder\n\nhint: name a file in it", path.display());
        }
        Ok(())
    }

    /// Fails early if an output, file or folder, could not be written later: its folder is missing, or a file has its
    /// name. Existing non-files, such as devices, may be written to.
    ///
    /// # Errors
    /// The folder is missing, the file exists and is not to be replaced, the output is an input or a file of one, or it is
    /// named `-`, where this would be no stdout.
    pub fn check_name(self, path: &Path, inputs: &[&Path]) -> anyhow::Result<()> {
        if is_stdout(path) {
            bail!("this output does not go to stdout\n\nhint: name a file; ./- is one of this name");
        }
        files::check_parent(path)?;
        inputs.iter().try_for_each(|input| check_not_input(path, input))?;
        if !self.overwrite && path.is_file() {
            bail!("{} exists already\n\nhint: --overwrite replaces it; or choose another name", path.display());
        }
        Ok(())
    }
}

/// Files of recordings and datasets that are folders.
const PARTS: [&str; 9] = [
    "radar.npy",
    "radar_timestamp.csv",
    "temperature.npy",
    "temperature_timestamp.csv",
    "config.json",
    "meta.json",
    "dataset.json",
    "manifest.jsonl",
    "radome.label",
];

/// Fails if an output would replace an input, or a file of an input that is a folder.
fn check_not_input(output: &Path, input: &Path) -> anyhow::Result<()> {
    let (Ok(written), Ok(read)) = (output.canonicalize(), input.canonicalize()) else { return Ok(()) };
    let name = written.file_name().unwrap_or_default().to_string_lossy();
    let is_part = PARTS.contains(&&*name) || (name.starts_with("maps-") && name.ends_with(".npy"));
    if written == read || (written.starts_with(read) && is_part) {
        bail!("{} is input and output at once\n\nhint: choose another name", output.display());
    }
    Ok(())
}

/// Returns the file to record to. In a folder, its name is the time; `{time}` in a name is replaced by the time, in
/// UTC. If that file exists, a number is appended, so that no two runs use the same file.
pub fn dated(path: &Path) -> PathBuf {
    let now_s = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |now| now.as_secs());
    dated_at(path, &utc::file_stamp(now_s))
}

fn dated_at(path: &Path, stamp: &str) -> PathBuf {
    let is_folder = path.is_dir() || path.as_os_str().as_encoded_bytes().ends_with(b"/");
    let pattern = if is_folder { path.join(format!("{TIME}.mcap")) } else { path.to_owned() };
    let Some(name) = pattern.file_name().and_then(|name| name.to_str()).filter(|name| name.contains(TIME)) else {
        return pattern;
    };
    let with = |time: &str| pattern.with_file_name(name.replace(TIME, time));
    let numbered = (2..).map(|number: u32| with(&format!("{stamp}-{number}")));
    let mut names = std::iter::once(with(stamp)).chain(numbered);
    names.find(|path| path.symlink_metadata().is_err()).unwrap_or(pattern)
}

/// Endings of models, arrays and pictures, each of which stands for one format.
const ENDINGS: [&str; 5] = ["npy", "onnx", "png", "safetensors", "svg"];

/// Hint on the name of a model's file.
pub const MODEL_HINT: &str = "end its name in .safetensors; radome model export writes ONNX";

/// Fails if the name of an output stands for another format than the one that is written. `own` are the endings of that format.
///
/// # Errors
/// The name has an ending of another format.
pub fn check_ending(path: &Path, own: &[&str], hint: &str) -> anyhow::Result<()> {
    let ending = path.extension().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
    if ENDINGS.contains(&ending.as_str()) && !own.contains(&ending.as_str()) {
        bail!("{}: what is written is not what .{ending} stands for\n\nhint: {hint}", path.display());
    }
    Ok(())
}

/// Fails if the name of a new recording implies another format than MCAP.
///
/// # Errors
/// The name is that of a text recording.
pub fn check_is_mcap(path: &Path) -> anyhow::Result<()> {
    if Format::of_output(path) == Some(Format::Text) {
        bail!(
            "{}: frames are recorded as MCAP only\n\nhint: record to FILE.mcap, then radome recording convert FILE.mcap FILE.txt",
            path.display()
        );
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_and_a_pattern_give_names_that_are_free() {
        let temporary = tempfile::tempdir().expect("a folder");
        let folder = temporary.path();
        let stamp = "20261122T212200Z";
        let first = dated_at(folder, stamp);
        assert_eq!(first, folder.join("20261122T212200Z.mcap"));
        std::fs::write(&first, "").expect("writes");
        assert_eq!(dated_at(folder, stamp), folder.join("20261122T212200Z-2.mcap"));
        let pattern = folder.join("night-{time}.mcap");
        assert_eq!(dated_at(&pattern, stamp), folder.join("night-20261122T212200Z.mcap"));
        std::fs::write(folder.join("night-20261122T212200Z.mcap"), "").expect("writes");
        assert_eq!(dated_at(&pattern, stamp), folder.join("night-20261122T212200Z-2.mcap"));
        // Names without a placeholder stay, and a missing folder is reported when the file is written.
        assert_eq!(dated_at(&folder.join("a.mcap"), stamp), folder.join("a.mcap"));
        assert_eq!(dated_at(Path::new("no/such/"), stamp), Path::new("no/such/20261122T212200Z.mcap"));
    }

    #[test]
    fn a_recording_is_not_written_into_a_text_file() {
        let said = check_is_mcap(Path::new("no/such/night.txt")).expect_err("refused").to_string();
        assert!(said.contains("MCAP") && said.contains("recording convert"), "{said}");
        for name in ["night.mcap", "no/such/night", "/dev/null"] {
            check_is_mcap(Path::new(name)).expect(name);
        }
    }

    #[test]
    fn a_name_of_another_format_is_refused() {
        let check = |name: &str| check_ending(Path::new(name), &["npy"], "end its name in .npy");
        for name in ["maps.npy", "maps.NPY", "maps", "maps.dat", "/dev/null", "v1.0"] {
            check(name).expect(name);
        }
        for name in ["maps.png", "maps.PNG", "a/maps.safetensors"] {
            let said = check(name).expect_err(name).to_string();
            assert!(said.contains("hint: end its name in .npy"), "{said}");
        }
    }

    #[test]
    fn a_file_that_exists_is_refused_and_a_device_is_not() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("a.mcap");
        Overwrite::default().check(&path, &[]).expect("free");
        std::fs::write(&path, "").expect("writes");
        let said = Overwrite::default().check(&path, &[]).expect_err("refused").to_string();
        assert!(said.contains("exists already") && said.contains("--overwrite"), "{said}");
        Overwrite { overwrite: true }.check(&path, &[]).expect("allowed");
        if Path::new("/dev/null").exists() {
            Overwrite::default().check(Path::new("/dev/null"), &[]).expect("a device");
        }
        assert!(Overwrite::default().check(Path::new("no/such/folder/a.mcap"), &[]).is_err());
    }
}
