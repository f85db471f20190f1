//! Outputs that appear whole or not at all.

use std::ffi::OsString;
use std::path::{Path, PathBuf};

use super::RecordingError;

/// A file or folder under a temporary name beside its own: renamed when whole, removed if dropped before.
#[derive(Debug)]
pub(super) struct Partial {
    partial: PathBuf,
    target: PathBuf,
}

impl Partial {
    /// Decides on the temporary name, `.NAME.partial`, and removes what an interrupted run left there.
    pub fn new(target: &Path) -> Result<Self, RecordingError> {
        let Some(name) = target.file_name() else {
            let source = std::io::Error::new(std::io::ErrorKind::InvalidInput, "the path names no file");
            return Err(RecordingError::cannot_write(target)(source));
        };
        let mut hidden = OsString::from(".");
        hidden.push(name);
        hidden.push(".partial");
        let partial = Partial { partial: target.with_file_name(hidden), target: target.to_owned() };
        partial.remove();
        Ok(partial)
    }

    /// Where to write.
    pub fn path(&self) -> &Path {
        &self.partial
    }

    /// Gives the output its name. An existing file is replaced, an existing folder only if it is empty.
    pub fn finish(self) -> Result<(), RecordingError> {
        std::fs::rename(&self.partial, &self.target).map_err(RecordingError::cannot_write(&self.target))
    }

    fn remove(&self) {
        // What is not there need not go.
        let _ = match self.partial.is_dir() {
            true => std::fs::remove_dir_all(&self.partial),
            false => std::fs::remove_file(&self.partial),
        };
    }
}

impl Drop for Partial {
    fn drop(&mut self) {
        self.remove();
    }
}
