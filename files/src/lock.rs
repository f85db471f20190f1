//! Locks on files. The system releases them when a process ends, however it ends.

use std::fs::{File, TryLockError};
use std::io;
use std::path::Path;
use std::time::{Duration, Instant};

/// Time between two attempts to lock.
const RETRY: Duration = Duration::from_millis(10);
/// Number of times that a file is opened again because another file has got its name before it was locked.
const REOPENINGS: usize = 100;

/// Opens the file of this name by `open` and locks it by `try_lock`, such as [`File::try_lock`]. Waits up to `timeout` for
/// another holder of the lock; returns `None` if that one holds it for longer.
///
/// The lock belongs to the file and not to its name. If the file was renamed, replaced or removed before it was locked, the
/// file that has the name now is opened. On a file system without locks, a warning is logged and the file is not locked.
///
/// # Errors
/// Those of `open`, and those of the system, which `convert_error` converts.
pub fn lock<E>(
    path: &Path,
    timeout: Duration,
    open: impl Fn() -> Result<File, E>,
    try_lock: impl Fn(&File) -> Result<(), TryLockError>,
    convert_error: impl FnOnce(io::Error) -> E,
) -> Result<Option<File>, E> {
    let start = Instant::now();
    let mut reopened = 0;
    while reopened < REOPENINGS {
        let file = open()?;
        match try_lock(&file) {
            Ok(()) if refers_to(path, &file) => return Ok(Some(file)),
            Ok(()) => reopened += 1,
            Err(TryLockError::WouldBlock) if start.elapsed() < timeout => std::thread::sleep(RETRY),
            Err(TryLockError::WouldBlock) => break,
            Err(TryLockError::Error(error)) if error.kind() == io::ErrorKind::Unsupported => {
                let path = path.display();
                tracing::warn!("{path}: this file system knows no locks; see that only one process writes here");
                return Ok(Some(file));
            }
            Err(TryLockError::Error(error)) => return Err(convert_error(error)),
        }
    }
    Ok(None)
}

/// Returns whether a name still refers to an open file.
#[cfg(unix)]
fn refers_to(path: &Path, file: &File) -> bool {
    use std::os::unix::fs::MetadataExt;
    match (std::fs::metadata(path), file.metadata()) {
        (Ok(of_path), Ok(of_file)) => (of_path.dev(), of_path.ino()) == (of_file.dev(), of_file.ino()),
        _ => false,
    }
}

#[cfg(not(unix))]
fn refers_to(_: &Path, _: &File) -> bool {
    true
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;

    use super::*;

    fn locked(path: &Path, try_lock: impl Fn(&File) -> Result<(), TryLockError>) -> Option<File> {
        let open = || File::options().write(true).create(true).truncate(false).open(path);
        lock(path, Duration::ZERO, open, try_lock, |error| error).expect("opens")
    }

    #[test]
    fn the_lock_is_that_of_the_file_which_has_the_name() {
        let folder = tempfile::tempdir().expect("a folder");
        let (path, other) = (folder.path().join("a"), folder.path().join("b"));
        let first = locked(&path, File::try_lock).expect("free");
        std::fs::rename(&path, &other).expect("renames");
        let second = locked(&path, File::try_lock).expect("a new file of the old name");
        assert!(locked(&other, File::try_lock).is_none(), "the first kept its lock");
        drop((first, second));
    }

    /// Regression test: if its holder removed the file between opening and locking, the lock excluded nobody.
    #[test]
    fn a_file_that_was_removed_meanwhile_is_made_again() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("a.lock");
        let attempts = Cell::new(0);
        let locked_file = locked(&path, |file| {
            if attempts.replace(attempts.get() + 1) == 0 {
                std::fs::remove_file(&path).expect("removed");
            }
            file.try_lock()
        });
        let locked_file = locked_file.expect("free");
        assert_eq!(attempts.get(), 2);
        assert!(locked(&path, File::try_lock).is_none());
        drop(locked_file);
        assert!(locked(&path, File::try_lock).is_some());
    }
}
