//! Files that are read.

use std::fs::File;
use std::path::Path;

use super::RecordingError;

/// Opens a regular file. Other files are refused first, because they cannot be sought and opening a pipe waits for its writer.
pub(super) fn open_file(path: &Path) -> Result<File, RecordingError> {
    let cannot = || RecordingError::io(path, "cannot be opened");
    if !std::fs::metadata(path).map_err(cannot())?.is_file() {
        return Err(RecordingError::NotRegular { path: path.to_owned() });
    }
    File::open(path).map_err(cannot())
}

/// Reads a regular file of at most `limit_bytes`.
pub(super) fn read(path: &Path, limit_bytes: u64) -> Result<Vec<u8>, RecordingError> {
    radome_files::read(path, limit_bytes).map_err(RecordingError::cannot_read(path))
}

/// Reads a text file of at most `limit_bytes`.
pub(super) fn read_text(path: &Path, limit_bytes: u64) -> Result<String, RecordingError> {
    String::from_utf8(read(path, limit_bytes)?).map_err(|e| RecordingError::Corrupt {
        path: path.to_owned(),
        offset: e.utf8_error().valid_up_to() as u64,
        reason: "not text in UTF-8".into(),
    })
}
