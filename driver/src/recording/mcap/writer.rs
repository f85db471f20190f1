//! Writer of a native recording that appears under its name when it is complete.

use std::path::Path;

use super::{Recorder, RecordingHeader, staged};
use crate::recording::partial::Partial;
use crate::recording::{Existing, RecordingError, WriteReport};

/// Writer of a native recording that appears under its name when [`McapWriter::finish`] has completed it, and not at
/// all otherwise. A file that [`Recorder::create`] starts has its name as soon as its header is on the disk.
pub(in crate::recording) struct McapWriter {
    pub recorder: Recorder,
    partial: Partial,
}

impl McapWriter {
    /// Starts a recording.
    ///
    /// # Errors
    /// Those of [`Recorder::with_options`].
    pub fn create(path: &Path, header: &RecordingHeader, existing: Existing) -> Result<Self, RecordingError> {
        let partial = Partial::file(path, existing)?;
        let recorder = Recorder::start(partial.open()?, path, header, None)?;
        Ok(McapWriter { recorder, partial })
    }

    /// Completes the file and gives it its name.
    ///
    /// # Errors
    /// [`RecordingError::Io`], or [`RecordingError::Occupied`] if something has taken the name meanwhile.
    pub fn finish(self) -> Result<WriteReport, RecordingError> {
        let path = self.partial.target().to_owned();
        let report = self.recorder.finish()?;
        self.partial.finish()?;
        // The labels belong to an earlier recording of this name.
        staged::remove(&path).map_err(RecordingError::cannot_write(&path))?;
        Ok(report)
    }
}
