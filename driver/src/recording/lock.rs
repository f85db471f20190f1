//! Locks that give a file to one writer at a time.

use std::fs::{File, TryLockError};
use std::io;
use std::path::Path;
use std::time::{Duration, Instant};

use super::RecordingError;

/// Time between two attempts to lock.
const RETRY: Duration = Duration::from_millis(10);

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

/// Opens and locks the file of this name, and waits up to `patience` for another writer. The lock belongs to the file
/// and not to its name. If the file was renamed or replaced before it was locked, the new one is opened.
///
/// # Errors
/// [`RecordingError::Locked`] if another writer holds the file for longer; [`RecordingError::Io`] otherwise. On a file
/// system without locks a warning is logged instead.
pub(super) fn lock(
    path: &Path,
    patience: Duration,
    open: impl Fn() -> io::Result<File>,
) -> Result<Locked, RecordingError> {
    let start = Instant::now();
    loop {
        let file = open().map_err(RecordingError::io(path, "cannot be opened"))?;
        match file.try_lock() {
            Ok(()) if leads_to(path, &file) => return Ok(Locked(file)),
            Ok(()) => {}
            Err(TryLockError::WouldBlock) if start.elapsed() < patience => std::thread::sleep(RETRY),
            Err(TryLockError::WouldBlock) => return Err(RecordingError::Locked { path: path.to_owned() }),
            Err(TryLockError::Error(error)) if error.kind() == io::ErrorKind::Unsupported => {
                tracing::warn!(
                    "{}: this file system knows no locks; see that only one program writes to it",
                    path.display()
                );
                return Ok(Locked(file));
            }
            Err(TryLockError::Error(source)) => {
                return Err(RecordingError::Io { path: path.to_owned(), what: "cannot be locked", source });
            }
        }
    }
}

/// Returns whether a name still refers to an open file.
#[cfg(unix)]
fn leads_to(path: &Path, file: &File) -> bool {
    use std::os::unix::fs::MetadataExt;
    match (std::fs::metadata(path), file.metadata()) {
        (Ok(named), Ok(open)) => (named.dev(), named.ino()) == (open.dev(), open.ino()),
        _ => false,
    }
}

#[cfg(not(unix))]
fn leads_to(_: &Path, _: &File) -> bool {
    true
}

#[cfg(test)]
mod tests {
    use super::*;

    fn opened(path: &Path) -> Result<Locked, RecordingError> {
        lock(path, Duration::ZERO, || File::options().write(true).create(true).truncate(false).open(path))
    }

    #[test]
    fn a_second_writer_is_refused_until_the_first_has_gone() {
        let folder = tempfile::tempdir().expect("folder");
        let path = folder.path().join("a");
        let first = opened(&path).expect("locks");
        assert!(matches!(opened(&path), Err(RecordingError::Locked { .. })));
        // A copy of the file that outlives the lock does not keep it.
        let copy = first.file().try_clone().expect("copies");
        drop(first);
        opened(&path).expect("locks");
        drop(copy);
    }

    #[test]
    fn the_lock_is_that_of_the_file_which_has_the_name() {
        let folder = tempfile::tempdir().expect("folder");
        let (path, other) = (folder.path().join("a"), folder.path().join("b"));
        let first = opened(&path).expect("locks");
        std::fs::rename(&path, &other).expect("renames");
        let second = opened(&path).expect("a new file of the old name");
        assert!(matches!(opened(&other), Err(RecordingError::Locked { .. })), "the first kept its lock");
        drop((first, second));
    }
}
