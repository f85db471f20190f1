//! Errors of recordings.

use std::path::{Path, PathBuf};

use radome_dsp::WaveformError;
use thiserror::Error;

/// Errors of recordings.
#[derive(Debug, Error)]
#[allow(missing_docs, reason = "the message says what each field is")]
pub enum RecordingError {
    /// A file cannot be read or written.
    #[error("{path}: {what}")]
    Io { path: PathBuf, what: &'static str, source: std::io::Error },
    /// The recording, or a file that belongs to it, is absent.
    #[error("{path}: there is no such file or folder")]
    Missing { path: PathBuf },
    /// An output exists and must not be replaced.
    #[error(
        "{path}: exists already{and}\n\nhint: choose another name, or remove it",
        and = if path.is_dir() { " and is not empty" } else { "" }
    )]
    Occupied { path: PathBuf },
    /// Another writer has the file.
    #[error(
        "{path}: another program is writing to it\n\nhint: stop that program, wait for its end, or choose another name"
    )]
    Locked { path: PathBuf },
    /// The disk accepts data but does not store them.
    #[error(
        "{path}: the disk has not stored any of it for {waited_s:.0} s\n\nhint: record to a faster disk, and see the system's log for \
         errors of this one"
    )]
    Stalled { path: PathBuf, waited_s: f64 },
    /// The path is not a recording.
    #[error(
        "{path}: not a recording: expected an MCAP file, a folder with RadarIfxAvian_00 or radar.npy in it, or the \
         vendor's text file with its _config.json beside it"
    )]
    Unknown { path: PathBuf },
    /// The path names a pipe, a device, or a folder in the place of a file.
    #[error(
        "{path}: not a regular file, but a folder, a pipe or a device\n\nhint: name a file; what a pipe brings has to be written to one \
         first"
    )]
    NotRegular { path: PathBuf },
    /// An output is a pipe that nobody reads.
    #[error("{path}: a pipe that nobody reads\n\nhint: start its reader first, or name a file")]
    NoReader { path: PathBuf },
    /// The content breaks the format's rules.
    #[error("{path}: at byte {offset}: {reason}")]
    Corrupt { path: PathBuf, offset: u64, reason: String },
    /// A chunk is compressed in a way that is not supported.
    #[error(
        "{path}: at byte {offset}: a chunk is compressed with lz4, expected zstd or none\n\nhint: write the file again with zstd, such as \
         with `mcap compress --compression zstd`"
    )]
    Compression { path: PathBuf, offset: u64 },
    /// A field of a JSON file is absent or of the wrong kind.
    #[error("{path}: field `{field}`: {reason}")]
    Field { path: PathBuf, field: String, reason: String },
    /// Configuration and data disagree.
    #[error(
        "{data}: frames are {got}, but {config} says {expected}; one of the two files is not this recording's",
        data = data.display(),
        config = config.display()
    )]
    Shape { data: PathBuf, got: String, config: PathBuf, expected: String },
    /// The file ends too early.
    #[error(
        "{path}: cut short at byte {offset}: {whole_frames} whole frames can be read, {expected_frames} were promised"
    )]
    Truncated { path: PathBuf, offset: u64, whole_frames: u64, expected_frames: u64 },
    /// The file was never finished.
    #[error("{path}: the recording was not finished; radome recording repair FILE -o OUT makes a finished one")]
    Unfinished { path: PathBuf },
    /// The file was written by a newer program.
    #[error("{path}: format version {got}, this program reads up to {supported}; update it")]
    Newer { path: PathBuf, got: String, supported: &'static str },
    /// A sample is not a 12-bit code.
    #[error("{path}: at byte {offset}: code {code} in frame {frame}, largest possible is 4095")]
    Code { path: PathBuf, offset: u64, frame: u64, code: u16 },
    /// The waveform is impossible.
    #[error("{path}: the waveform is impossible")]
    Waveform { path: PathBuf, source: WaveformError },
    /// The work was stopped.
    #[error("{path}: interrupted; nothing has been written")]
    Interrupted { path: PathBuf },
    /// A frame has another shape than the recording.
    #[error("{path}: frame {sequence} is {got}, the recording holds {expected}")]
    FrameShape { path: PathBuf, sequence: u64, got: String, expected: String },
}

impl RecordingError {
    pub(super) fn io(path: &Path, what: &'static str) -> impl FnOnce(std::io::Error) -> RecordingError {
        let path = path.to_owned();
        move |source| match source.kind() {
            std::io::ErrorKind::NotFound => RecordingError::Missing { path },
            _ => RecordingError::Io { path, what, source },
        }
    }

    pub(super) fn cannot_read(path: &Path) -> impl FnOnce(std::io::Error) -> RecordingError {
        Self::io(path, "cannot be read")
    }

    pub(super) fn cannot_write(path: &Path) -> impl FnOnce(std::io::Error) -> RecordingError {
        let path = path.to_owned();
        move |source| RecordingError::Io { path, what: "cannot be written", source }
    }
}
