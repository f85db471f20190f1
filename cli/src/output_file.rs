//! Output files named by `-o`. Existing files are replaced only on request, and names can include the time.

use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use anyhow::{bail, ensure};
use radome_driver::recording::text::config_path;
use radome_driver::recording::{Existing, Format, Partial, RecordingError, infineon, utc};
use radome_driver::{Recorder, RecorderOptions, RecordingHeader};
use radome_files::parent_folder;

use crate::exit::wrong_use;
use crate::{files, labels};

/// Returns whether `-o` names stdout: `-`. A file of this name is `./-`.
pub fn is_stdout(path: &Path) -> bool {
    path.as_os_str() == "-"
}

/// Placeholder of the time in the name of an output.
const TIME: &str = "{time}";

/// Permission to replace an existing output file.
#[derive(Debug, Clone, Copy, Default, clap::Args)]
pub struct Overwrite {
    /// Replace the output file if it exists. The old file stays until the new one is complete
    #[arg(long)]
    overwrite: bool,
}

impl Overwrite {
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
        ensure!(!path.is_dir(), "{} is a folder\n\nhint: name a file in it", path.display());
        Ok(())
    }

    /// Fails early if an output, file or folder, could not be written later: its folder is missing, or a file has its
    /// name. Existing non-files, such as devices, may be written to.
    ///
    /// # Errors
    /// The folder is missing, or the file exists and is not to be replaced. [`WrongUse`](crate::exit::WrongUse) if the output is
    /// an input or a file of one, or if it is named `-`, where this would be no stdout.
    pub fn check_name(self, path: &Path, inputs: &[&Path]) -> anyhow::Result<()> {
        if is_stdout(path) {
            wrong_use!("this output does not go to stdout\n\nhint: name a file; ./- is one of this name");
        }
        files::check_parent(path)?;
        inputs.iter().try_for_each(|input| check_not_input(path, input))?;
        if !self.overwrite && path.is_file() {
            bail!("{} exists already\n\nhint: --overwrite replaces it; or choose another name", path.display());
        }
        Ok(())
    }
}

/// Names of files in inputs that are folders: recordings, their labels, and datasets. Shards of datasets have numbered names.
const PARTS: [&[&str]; 3] = [&infineon::FILES, &labels::NAMES_IN_FOLDER, &["dataset.json", "manifest.jsonl"]];

/// Fails if an output would replace an input, a file of an input that is a folder, the configuration beside a text
/// recording, or labels beside a recording that cannot hold any.
fn check_not_input(output: &Path, input: &Path) -> anyhow::Result<()> {
    let (Ok(written), Ok(read)) = (output.canonicalize(), input.canonicalize()) else { return Ok(()) };
    let name = written.file_name().unwrap_or_default().to_string_lossy();
    let is_part =
        PARTS.iter().any(|names| names.contains(&&*name)) || (name.starts_with("maps-") && name.ends_with(".npy"));
    let configuration = config_path(&read);
    // Labels beside a file of any other kind are not read with it.
    let labels = labels::file_beside(input).filter(|_| read.is_dir() || configuration.is_some());
    let is_output = |path: PathBuf| path.canonicalize().is_ok_and(|path| path == written);
    let is_beside = [configuration, labels].into_iter().flatten().any(is_output);
    if written == read || is_beside || (written.starts_with(read) && is_part) {
        wrong_use!("{} is input and output at once\n\nhint: choose another name", output.display());
    }
    Ok(())
}

/// Fails if two outputs of a command are the same file.
///
/// # Errors
/// [`WrongUse`](crate::exit::WrongUse) if both paths name one file, which need not exist yet.
pub fn check_distinct(path: &Path, other: &Path) -> anyhow::Result<()> {
    if resolved(path).is_some_and(|path| resolved(other) == Some(path)) {
        wrong_use!(
            "{} and {} are one file\n\nhint: choose another name for one of them",
            path.display(),
            other.display()
        );
    }
    Ok(())
}

/// Path of a file with all links resolved. For a file that does not exist yet, those of its folder are resolved.
fn resolved(path: &Path) -> Option<PathBuf> {
    let of_new_file = || Some(parent_folder(path).canonicalize().ok()?.join(path.file_name()?));
    path.canonicalize().ok().or_else(of_new_file)
}

/// Recording that does not exist yet. A name that contains the time is reserved, so that no other run takes it.
pub struct NewRecording {
    path: PathBuf,
    /// File that reserves the name; removed if the recording is not made.
    reserved: Option<Partial>,
}

impl NewRecording {
    /// Returns the recording that `-o` names. In a folder, its name is the time; `{time}` in a name is replaced by the
    /// time, in UTC. If another run has taken that name, a number is appended, so that no two runs use the same file.
    pub fn named(output: &Path) -> Self {
        let now_s = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |now| now.as_secs());
        Self::at(output, &utc::file_stamp(now_s))
    }

    fn at(output: &Path, stamp: &str) -> Self {
        let is_folder = output.is_dir() || output.as_os_str().as_encoded_bytes().ends_with(b"/");
        let pattern = if is_folder { output.join(format!("{TIME}.mcap")) } else { output.to_owned() };
        let Some(name) = pattern.file_name().and_then(|name| name.to_str()).filter(|name| name.contains(TIME)) else {
            return NewRecording { path: pattern, reserved: None };
        };
        let with = |time: &str| pattern.with_file_name(name.replace(TIME, time));
        let numbered = (2..).map(|number: u32| with(&format!("{stamp}-{number}")));
        let mut names = std::iter::once(with(stamp)).chain(numbered);
        let free = names.find_map(|path| match reserve(&path) {
            Err(RecordingError::Occupied { .. } | RecordingError::Locked { .. }) => None,
            // A folder that cannot be written to is reported when the recording is made.
            reserved => Some(NewRecording { reserved: reserved.ok(), path }),
        });
        free.unwrap_or_else(|| NewRecording { path: pattern.clone(), reserved: None })
    }

    /// Path that the recording will have.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Creates the recording.
    ///
    /// # Errors
    /// Those of [`Recorder::with_options`].
    pub fn create(self, header: &RecordingHeader, options: &RecorderOptions) -> Result<Recorder, RecordingError> {
        match self.reserved {
            Some(reserved) => Recorder::in_partial(reserved, header, options.sync),
            None => Recorder::with_options(&self.path, header, options),
        }
    }
}

/// Reserves a name. Other runs reserve names in the same way.
fn reserve(path: &Path) -> Result<Partial, RecordingError> {
    let check_free = || match path.symlink_metadata() {
        Ok(_) => Err(RecordingError::Occupied { path: path.to_owned() }),
        Err(_) => Ok(()),
    };
    check_free()?;
    let reserved = Partial::file(path, Existing::Refuse)?;
    // Another run may have made its recording under this name between the two checks.
    check_free().map(|()| reserved)
}

/// Endings of names that stand for one format each: of recordings, models, arrays, tables, pictures and texts.
const ENDINGS: &str = "csv gif h5 hdf5 jpeg jpg json mat npy npz onnx pdf png safetensors svg toml txt";

/// Hint on the name of a model's file.
pub const MODEL_HINT: &str = "end its name in .safetensors; radome model export writes ONNX";

/// Fails if the ending of an output's name stands for another format than the written one, whose endings are `own`.
///
/// # Errors
/// [`WrongUse`](crate::exit::WrongUse) if the name has an ending of another format.
pub fn check_ending(path: &Path, own: &[&str], hint: &str) -> anyhow::Result<()> {
    let ending = path.extension().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
    if ENDINGS.split(' ').any(|listed| listed == ending) && !own.contains(&ending.as_str()) {
        wrong_use!("{}: what is written is not what .{ending} stands for\n\nhint: {hint}", path.display());
    }
    Ok(())
}

/// Fails if the name of a picture stands for another format than PNG and SVG.
///
/// # Errors
/// Those of [`check_ending`].
pub fn check_is_picture(path: &Path) -> anyhow::Result<()> {
    check_ending(path, &["png", "svg"], "end the picture's name in .png or .svg")
}

/// Fails if the name of a new recording implies another format than MCAP.
///
/// # Errors
/// [`WrongUse`](crate::exit::WrongUse) if the name is that of a file in another format.
pub fn check_is_mcap(path: &Path) -> anyhow::Result<()> {
    if Format::of_output(path).is_some_and(|format| format != Format::Mcap && !format.is_folder()) {
        wrong_use!(
            "{}: frames are recorded as MCAP only\n\nhint: record to FILE.mcap, then radome recording convert FILE.mcap FILE.txt",
            path.display()
        );
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use radome_dsp::{Waveform, WaveformRequest};

    use super::*;

    #[test]
    fn a_folder_and_a_pattern_give_names_that_are_free() {
        let temporary = tempfile::tempdir().expect("a folder");
        let folder = temporary.path();
        let stamp = "20261122T212200Z";
        let dated_at = |output: &Path| NewRecording::at(output, stamp).path().to_owned();
        let first = dated_at(folder);
        assert_eq!(first, folder.join("20261122T212200Z.mcap"));
        std::fs::write(&first, "").expect("writes");
        assert_eq!(dated_at(folder), folder.join("20261122T212200Z-2.mcap"));
        let pattern = folder.join("night-{time}.mcap");
        assert_eq!(dated_at(&pattern), folder.join("night-20261122T212200Z.mcap"));
        std::fs::write(folder.join("night-20261122T212200Z.mcap"), "").expect("writes");
        assert_eq!(dated_at(&pattern), folder.join("night-20261122T212200Z-2.mcap"));
        // Names without a placeholder stay, and a missing folder is reported when the file is written.
        assert_eq!(dated_at(&folder.join("a.mcap")), folder.join("a.mcap"));
        assert_eq!(dated_at(Path::new("no/such/")), Path::new("no/such/20261122T212200Z.mcap"));
    }

    /// Regression test: runs that began in the same second took one name, and all but one of them failed.
    #[test]
    fn runs_that_begin_in_the_same_second_have_a_name_each() {
        let temporary = tempfile::tempdir().expect("a folder");
        let folder = temporary.path();
        let stamp = "20261122T212200Z";
        let runs = [(); 3].map(|()| NewRecording::at(folder, stamp));
        // A run that ends before its recording is made gives its name back.
        drop(NewRecording::at(folder, stamp));
        let header = RecordingHeader::new(Waveform::realise(WaveformRequest::paper()).expect("possible"));
        for run in runs {
            run.create(&header, &RecorderOptions::default()).expect("creates").finish().expect("finishes");
        }
        let files = std::fs::read_dir(folder).expect("lists").flatten();
        let mut names: Vec<_> = files.map(|file| file.file_name().to_string_lossy().into_owned()).collect();
        names.sort();
        assert_eq!(names, ["20261122T212200Z-2.mcap", "20261122T212200Z-3.mcap", "20261122T212200Z.mcap"]);
    }

    #[test]
    fn a_recording_is_not_written_into_a_text_file() {
        let said = check_is_mcap(Path::new("no/such/night.txt")).expect_err("refused").to_string();
        assert!(said.contains("MCAP") && said.contains("recording convert"), "{said}");
        for name in ["night.mcap", "no/such/night", "/dev/null"] {
            check_is_mcap(Path::new(name)).expect(name);
        }
    }

    /// Regression test: the configuration of a text recording could be replaced by a recording of its frames.
    #[test]
    fn the_configuration_beside_a_text_recording_is_an_input() {
        let folder = tempfile::tempdir().expect("a folder");
        for (recording, configuration) in [("a.txt", "a.txt_config.json"), ("b.txt", "b_config.json")] {
            let [recording, configuration] = [recording, configuration].map(|name| folder.path().join(name));
            std::fs::write(&recording, "").expect("writes");
            std::fs::write(&configuration, "").expect("writes");
            let said = Overwrite::yes().check(&configuration, &[&recording]).expect_err("refused").to_string();
            assert!(said.contains("input and output at once"), "{said}");
        }
        Overwrite::yes()
            .check(&folder.path().join("a.txt_config.json"), &[&folder.path().join("b.txt")])
            .expect("free");
    }

    /// Regression test: labels beside a recording that cannot hold any could be replaced while they were read.
    #[test]
    fn the_labels_beside_a_recording_are_inputs() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = |name: &str| folder.path().join(name);
        let radar = path("session/RadarIfxAvian_00");
        std::fs::create_dir_all(&radar).expect("creates");
        for name in ["a.txt", "a.txt_config.json", "a.label", "b.mcap", "b.mcap.label", "session/radome.label"] {
            std::fs::write(path(name), "").expect("writes");
        }
        for (input, labels) in [(path("a.txt"), "a.label"), (radar, "session/radome.label")] {
            let said = Overwrite::yes().check(&path(labels), &[&input]).expect_err(labels).to_string();
            assert!(said.contains("input and output at once"), "{said}");
        }
        Overwrite::yes().check(&path("b.mcap.label"), &[&path("b.mcap")]).expect("the recording holds its labels");
        Overwrite::yes().check(&path("a.label"), &[&path("b.mcap")]).expect("labels of another recording");
    }

    /// Regression test: the version of a folder's format and two of the names of its labels could be written over while
    /// the folder was read.
    #[test]
    fn the_files_of_a_folder_are_inputs() {
        let folder = tempfile::tempdir().expect("a folder");
        let radar = folder.path().join("RadarIfxAvian_00");
        std::fs::create_dir(&radar).expect("creates");
        let check = |path: &Path| {
            std::fs::write(path, "").expect("writes");
            Overwrite::yes().check(path, &[folder.path()])
        };
        for name in PARTS.concat() {
            for path in [folder.path().join(name), radar.join(name)] {
                let said = check(&path).expect_err(name).to_string();
                assert!(said.contains("input and output at once"), "{said}");
            }
        }
        for name in ["format.version", "labels.label", "labels.txt"] {
            assert!(PARTS.concat().contains(&name), "{name}");
        }
        check(&radar.join("maps.npy")).expect("no part of the recording");
    }

    #[test]
    fn two_names_of_one_file_are_refused_before_it_exists() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = |name: &str| folder.path().join(name);
        std::fs::create_dir(path("sub")).expect("creates");
        for exists in [false, true] {
            if exists {
                std::fs::write(path("a"), "").expect("writes");
            }
            for name in ["a", "./a", "sub/../a"] {
                let said = check_distinct(&path(name), &path("a")).expect_err(name).to_string();
                assert!(said.contains("are one file") && said.contains("hint: "), "{said}");
            }
            for name in ["b", "sub/a", "none/a"] {
                check_distinct(&path(name), &path("a")).expect(name);
            }
        }
    }

    #[test]
    fn a_name_of_another_format_is_refused() {
        let check = |name: &str| check_ending(Path::new(name), &["npy"], "end its name in .npy");
        for name in ["maps.npy", "maps.NPY", "maps", "maps.dat", "/dev/null", "v1.0"] {
            check(name).expect(name);
        }
        for name in ["maps.png", "maps.PNG", "maps.csv", "maps.txt", "a/maps.safetensors"] {
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
