//! Recordings on disk: the native MCAP file and the vendor's folder.

pub mod infineon;
pub mod mcap;

use std::path::{Path, PathBuf};

use radome_dsp::{FrameSource, WaveformError};
use thiserror::Error;

/// What can be wrong with a recording.
#[derive(Debug, Error)]
pub enum RecordingError {
    /// A file cannot be read or written.
    #[error("{path}: {what}", path = path.display())]
    Io {
        /// File.
        path: PathBuf,
        /// What was being done.
        what: &'static str,
        /// Why it failed.
        source: std::io::Error,
    },
    /// A file that belongs to the recording is absent.
    #[error("{path}: no such file, though the recording needs it", path = path.display())]
    Missing {
        /// File.
        path: PathBuf,
    },
    /// Neither kind of recording.
    #[error(
        "{path}: not a recording: expected an MCAP file, or a folder with RadarIfxAvian_00 or radar.npy in it",
        path = path.display()
    )]
    Unknown {
        /// What was given.
        path: PathBuf,
    },
    /// The content breaks the format's rules.
    #[error("{path}: at byte {offset}: {reason}", path = path.display())]
    Corrupt {
        /// File.
        path: PathBuf,
        /// Where.
        offset: u64,
        /// What is wrong and what was expected.
        reason: String,
    },
    /// A field of a JSON file is absent or of the wrong kind.
    #[error("{path}: field `{field}`: {reason}", path = path.display())]
    Field {
        /// File.
        path: PathBuf,
        /// Field.
        field: String,
        /// What is wrong and what was expected.
        reason: String,
    },
    /// Configuration and data disagree.
    #[error(
        "{data}: frames are {got}, but {config} says {expected}; one of the two files is not this recording's",
        data = data.display(),
        config = config.display()
    )]
    Shape {
        /// File with the samples.
        data: PathBuf,
        /// Shape of its frames.
        got: String,
        /// File with the configuration.
        config: PathBuf,
        /// Shape that it states.
        expected: String,
    },
    /// The file ends too early.
    #[error(
        "{path}: cut short at byte {offset}: {whole_frames} whole frames can be read, {expected_frames} were promised",
        path = path.display()
    )]
    Truncated {
        /// File.
        path: PathBuf,
        /// Its length.
        offset: u64,
        /// Whole frames that are there.
        whole_frames: u64,
        /// Frames that its header promises.
        expected_frames: u64,
    },
    /// The file was never finished and ends within a record.
    #[error("{path}: the recording was not finished: its last whole chunk ends at byte {offset}", path = path.display())]
    Unfinished {
        /// File.
        path: PathBuf,
        /// End of what can be read.
        offset: u64,
    },
    /// Written by a newer program.
    #[error("{path}: format version {got}, this program reads up to {supported}; update it", path = path.display())]
    Newer {
        /// File.
        path: PathBuf,
        /// Version found.
        got: String,
        /// Newest known.
        supported: &'static str,
    },
    /// A sample is not a 12-bit code.
    #[error("{path}: at byte {offset}: code {code} in frame {frame}, largest possible is 4095", path = path.display())]
    Code {
        /// File.
        path: PathBuf,
        /// Where.
        offset: u64,
        /// Frame.
        frame: u64,
        /// What is there.
        code: u16,
    },
    /// The waveform is impossible.
    #[error("{path}: the waveform is impossible", path = path.display())]
    Waveform {
        /// File.
        path: PathBuf,
        /// Why.
        source: WaveformError,
    },
    /// A frame given to a recorder does not belong there.
    #[error("{path}: frame {sequence} is {got}, the recording holds {expected}", path = path.display())]
    FrameShape {
        /// File.
        path: PathBuf,
        /// Frame.
        sequence: u64,
        /// Its shape.
        got: String,
        /// Shape of the recording.
        expected: String,
    },
}

impl RecordingError {
    fn io(path: &Path, what: &'static str) -> impl FnOnce(std::io::Error) -> RecordingError {
        let path = path.to_owned();
        move |source| match source.kind() {
            std::io::ErrorKind::NotFound => RecordingError::Missing { path },
            _ => RecordingError::Io { path, what, source },
        }
    }
}

/// Opens a recording of either kind.
pub fn open(path: &Path) -> Result<Box<dyn FrameSource>, RecordingError> {
    let metadata = std::fs::metadata(path).map_err(RecordingError::io(path, "cannot be opened"))?;
    if metadata.is_dir() {
        return Ok(Box::new(infineon::InfineonReader::open(path)?));
    }
    let mut magic = [0; 8];
    let file = std::fs::File::open(path).map_err(RecordingError::io(path, "cannot be opened"))?;
    let read = std::io::Read::read_exact(&mut { file }, &mut magic);
    if read.is_ok() && magic == *::mcap::MAGIC {
        return Ok(Box::new(mcap::McapReader::open(path)?));
    }
    Err(RecordingError::Unknown { path: path.to_owned() })
}
