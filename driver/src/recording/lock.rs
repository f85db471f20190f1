//! Locks that give a file to one writer at a time.

use std::fs::File;
use std::io;
use std::path::Path;
use std::time::Duration;

use super::RecordingError;

/// Longest wait of a program that changes labels for another writer. Another change of labels has finished by then, a recorder
/// has not.
pub(super) const LABELS_LOCK_TIMEOUT: Duration = Duration::from_secs(2);

/// Open file that is locked against other processes and other parts of this one.
#[derive(Debug)]
pub(super) struct Locked(File);

impl Locked {
    /// Returns the file.
    pub fn file(&self) -> &File {
        &self.0
    }
}

impl Drop for Locked {
    /// Unlocks the file, so that a thread that still holds a copy of the file does not hold the lock.
    fn drop(&mut self) {
        let _ = self.0.unlock();
    }
}

/// Opens and locks the file of this name as [`radome_files::lock`] does.
///
/// # Errors
/// [`RecordingError::Locked`] if another writer holds the file for longer than `timeout`; [`RecordingError::Io`] otherwise.
pub(super) fn lock(
    path: &Path,
    timeout: Duration,
    open: impl Fn() -> io::Result<File>,
) -> Result<Locked, RecordingError> {
    let open = || open().map_err(RecordingError::io(path, "cannot be opened"));
    let convert_error = |source| RecordingError::Io { path: path.to_owned(), what: "cannot be locked", source };
    let locked = radome_files::lock(path, timeout, open, File::try_lock, convert_error)?;
    locked.map(Locked).ok_or_else(|| RecordingError::Locked { path: path.to_owned() })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_second_writer_is_refused_until_the_first_has_gone() {
        let folder = tempfile::tempdir().expect("folder");
        let path = folder.path().join("a");
        let try_lock =
            || lock(&path, Duration::ZERO, || File::options().write(true).create(true).truncate(false).open(&path));
        let first = try_lock().expect("locks");
        assert!(matches!(try_lock(), Err(RecordingError::Locked { .. })));
        // A copy of the file that outlives the lock does not keep it.
        let copy = first.file().try_clone().expect("copies");
        drop(first);
        try_lock().expect("locks");
        drop(copy);
    }
}
