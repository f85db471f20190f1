//! Recordings on disk: the native MCAP file, the vendor's folder and the vendor's text file. [`open`] and
//! [`Recording::open`] read all of them, [`RecordingWriter`] writes them. A recording is locked by its writer: other
//! writers get [`RecordingError::Locked`].

mod disk;
pub mod infineon;
pub mod label_text;
mod lock;
pub mod mcap;
mod opened;
mod partial;
pub mod span_check;
pub mod text;
pub mod utc;
mod vendor_config;
mod vendor_scene;
mod writer;

use std::path::{Path, PathBuf};

pub use opened::Recording;
pub use partial::Partial;
pub(crate) use writer::Tally;
pub use writer::{Format, RecordingWriter, WriteReport};

use radome_dsp::{FrameSource, WaveformError};
use thiserror::Error;

/// Policy for an output whose file exists already.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Existing {
    /// The file is kept: [`RecordingError::Occupied`].
    Refuse,
    /// The file is replaced once the output is complete.
    Replace,
}

/// Position of a frame in its recording.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Position {
    /// Sequence number of the frame.
    pub sequence: u64,
    /// Time on the frames' own clock, ns.
    pub time_ns: u64,
}

impl Position {
    /// Time on the frames' own clock, s.
    pub fn time_s(self) -> f64 {
        self.time_ns as f64 * 1e-9
    }
}

/// First and last frame of a recording.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Extent {
    /// First frame.
    pub first: Position,
    /// Last frame.
    pub last: Position,
}

/// Errors of recordings.
#[derive(Debug, Error)]
pub enum RecordingError {
    /// A file cannot be read or written.
    #[error("{path}: {what}", path = path.display())]
    Io {
        /// File.
        path: PathBuf,
        /// Operation that failed.
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
    /// An output exists and must not be replaced.
    #[error(
        "{path}: exists already{and}\n\nhint: choose another name, or remove it",
        path = path.display(),
        and = if path.is_dir() { " and is not empty" } else { "" }
    )]
    Occupied {
        /// File or folder that exists.
        path: PathBuf,
    },
    /// Another writer has the file.
    #[error(
        "{path}: another program is writing to it\n\nhint: stop that program, wait for its end, or choose another name",
        path = path.display()
    )]
    Locked {
        /// File.
        path: PathBuf,
    },
    /// The disk accepts data but does not store them.
    #[error(
        "{path}: the disk has not stored any of it for {waited_s:.0} s\n\nhint: record to a faster disk, and see the system's log for \
         errors of this one",
        path = path.display()
    )]
    Stalled {
        /// File.
        path: PathBuf,
        /// Time waited, s.
        waited_s: f64,
    },
    /// The path is not a recording.
    #[error(
        "{path}: not a recording: expected an MCAP file, a folder with RadarIfxAvian_00 or radar.npy in it, or the \
         vendor's text file with its _config.json beside it",
        path = path.display()
    )]
    Unknown {
        /// Path that was given.
        path: PathBuf,
    },
    /// The content breaks the format's rules.
    #[error("{path}: at byte {offset}: {reason}", path = path.display())]
    Corrupt {
        /// File.
        path: PathBuf,
        /// Offset in the file, bytes.
        offset: u64,
        /// Description of the error and of the expected content.
        reason: String,
    },
    /// A field of a JSON file is absent or of the wrong kind.
    #[error("{path}: field `{field}`: {reason}", path = path.display())]
    Field {
        /// File.
        path: PathBuf,
        /// Field.
        field: String,
        /// Description of the error and of the expected content.
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
    /// The file was written by a newer program.
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
        /// Offset in the file, bytes.
        offset: u64,
        /// Frame.
        frame: u64,
        /// Value of the sample.
        code: u16,
    },
    /// The waveform is impossible.
    #[error("{path}: the waveform is impossible", path = path.display())]
    Waveform {
        /// File.
        path: PathBuf,
        /// Error of the waveform.
        source: WaveformError,
    },
    /// A frame has another shape than the recording.
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

    fn cannot_write(path: &Path) -> impl FnOnce(std::io::Error) -> RecordingError {
        let path = path.to_owned();
        move |source| RecordingError::Io { path, what: "cannot be written", source }
    }
}

/// Renames a file in the same file system, replaces a file of that name, and waits until the name is on the disk. The
/// content of the file must be there already.
///
/// # Errors
/// [`RecordingError::Io`].
pub fn rename_synced(from: &Path, to: &Path) -> Result<(), RecordingError> {
    disk::rename(from, to).and_then(|()| disk::sync_folder(to)).map_err(RecordingError::cannot_write(to))
}

/// Opens a recording of any kind as a source of frames.
///
/// # Errors
/// [`RecordingError`] if the path cannot be read or is not a recording.
pub fn open(path: &Path) -> Result<Box<dyn FrameSource>, RecordingError> {
    Ok(match Recording::open(path)? {
        Recording::Mcap(reader) => reader,
        Recording::Infineon(reader) => reader,
        Recording::Text(reader) => reader,
    })
}

/// Reads a small text file.
fn read_text(path: &Path) -> Result<String, RecordingError> {
    let bytes = std::fs::read(path).map_err(RecordingError::io(path, "cannot be read"))?;
    String::from_utf8(bytes).map_err(|e| RecordingError::Corrupt {
        path: path.to_owned(),
        offset: e.utf8_error().valid_up_to() as u64,
        reason: "not text in UTF-8".into(),
    })
}

/// Converts a time to nanoseconds; 0 if it is negative or not a number.
fn time_ns(time_s: f64) -> u64 {
    (time_s * 1e9).round() as u64
}

/// Finds by bisection the first of `count` indices for which `holds` is true; `count` if there is none. It must hold
/// for all indices behind one for which it holds.
fn first_index(count: u64, mut holds: impl FnMut(u64) -> bool) -> u64 {
    let (mut low, mut high) = (0, count);
    while low < high {
        let middle = low + (high - low) / 2;
        if holds(middle) {
            high = middle;
        } else {
            low = middle + 1;
        }
    }
    low
}
