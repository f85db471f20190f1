//! Formats of recordings: which one a path has, and what each can hold.

use std::io::Read;
use std::path::Path;

use super::input::open_file;
use super::{RecordingError, infineon, text};

/// Length of the beginning of a file that identifies its format, bytes.
const HEAD_BYTES: u64 = 16;

/// Kinds of recordings.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// The native MCAP file.
    Mcap,
    /// The vendor's folder.
    Infineon,
    /// The vendor's text file.
    Text,
}

impl Format {
    /// Finds the format of a recording by its content; `None` for a file or folder that is no recording.
    ///
    /// # Errors
    /// [`RecordingError`] if the path cannot be read; [`RecordingError::NotRegular`] for a pipe or a device.
    pub fn of_content(path: &Path) -> Result<Option<Self>, RecordingError> {
        let metadata = std::fs::metadata(path).map_err(RecordingError::io(path, "cannot be opened"))?;
        if metadata.is_dir() {
            let radars = infineon::radar_folders(path)?;
            return Ok((!radars.is_empty()).then_some(Format::Infineon));
        }
        let mut head = Vec::new();
        let read = open_file(path)?.take(HEAD_BYTES).read_to_end(&mut head);
        read.map_err(RecordingError::cannot_read(path))?;
        if head.starts_with(::mcap::MAGIC) {
            return Ok(Some(Format::Mcap));
        }
        Ok(text::is_recording(path, &head).then_some(Format::Text))
    }

    /// Chooses the format by the name of an output: `.mcap`, `.txt`, or a folder. A folder is one that exists, or a
    /// name without extension or with a slash at its end.
    pub fn of_output(path: &Path) -> Option<Self> {
        let is_folder = path.is_dir() || path.as_os_str().to_string_lossy().ends_with('/');
        match path.extension().and_then(|e| e.to_str()) {
            _ if is_folder => Some(Format::Infineon),
            Some("mcap") => Some(Format::Mcap),
            Some("txt") => Some(Format::Text),
            None => Some(Format::Infineon),
            Some(_) => None,
        }
    }

    /// Name of the format in the program's options and its JSON.
    pub fn name(self) -> &'static str {
        match self {
            Format::Mcap => "mcap",
            Format::Infineon => "infineon",
            Format::Text => "text",
        }
    }

    /// Returns whether a recording is a folder.
    pub fn is_folder(self) -> bool {
        match self {
            Format::Infineon => true,
            Format::Mcap | Format::Text => false,
        }
    }

    /// Returns whether a recording holds its labels, with their authors. Those of other formats are in a file beside
    /// the recording.
    pub fn holds_labels(self) -> bool {
        match self {
            Format::Mcap => true,
            Format::Infineon | Format::Text => false,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Regression test: datasets took text recordings with other names and folders with other files than the reader did.
    #[test]
    fn a_recording_is_recognised_by_its_content() {
        let folder = tempfile::tempdir().expect("a folder");
        let at = |name: &str| folder.path().join(name);
        let write = |name: &str, content: &str| {
            std::fs::create_dir_all(at(name).parent().expect("a folder")).expect("creates");
            std::fs::write(at(name), content).expect("writes");
        };
        let samples = "0.512332\n0.512332\n\n";
        for name in ["walk", "walk.dat", "walk.txt", "other.dat"] {
            write(name, samples);
        }
        write("walk_config.json", "{}");
        write("walk.label", "Time(Seconds),Length(Seconds)\n");
        write("walk.csv", "0.51,0.52\n");
        write("walk.empty", "");
        write("cut.txt", "");
        write("cut.txt_config.json", "{}");
        std::fs::write(at("night"), ::mcap::MAGIC).expect("writes");
        write("flat/radar.npy", "");
        write("session/RadarIfxAvian_00/format.version", "1.0.0\n");
        write("project/config.json", "{}");
        for (name, format) in [
            ("walk", Some(Format::Text)),
            ("walk.dat", Some(Format::Text)),
            ("walk.txt", Some(Format::Text)),
            ("cut.txt", Some(Format::Text)),
            ("night", Some(Format::Mcap)),
            ("flat", Some(Format::Infineon)),
            ("session", Some(Format::Infineon)),
            ("session/RadarIfxAvian_00", Some(Format::Infineon)),
            ("other.dat", None),
            ("walk_config.json", None),
            ("walk.label", None),
            ("walk.csv", None),
            ("walk.empty", None),
            ("project", None),
            ("", None),
        ] {
            assert_eq!(Format::of_content(&at(name)).expect(name), format, "{name}");
        }
        assert!(matches!(Format::of_content(&at("none")), Err(RecordingError::Missing { .. })));
    }
}
