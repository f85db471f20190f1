//! Files that are read.

use std::fs::File;
use std::path::Path;

use super::RecordingError;

/// Opens a regular file. Others are refused beforehand: they cannot be sought in, and opening a pipe waits for its writer.
pub(super) fn open_file(path: &Path) -> Result<File, RecordingError> {
    let cannot = || RecordingError::io(path, "cannot be opened");
    if !std::fs::metadata(path).map_err(cannot())?.is_file() {
        return Err(RecordingError::NotRegular { path: path.to_owned() });
    }
    File::open(path).map_err(cannot())
}
