//! Locks that keep processes out of each other's files. The system releases them when a process ends, however it ends.

use std::fs::{File, TryLockError};
use std::path::Path;

use super::error::DatasetError;

/// Name of the file in a folder that is locked.
pub(super) const LOCK: &str = ".lock";

/// Locks a folder that one process at a time may write, until the returned file is dropped.
///
/// # Errors
/// [`DatasetError::Busy`] if another process holds or shares the lock, and [`DatasetError::Io`] if its file cannot be made. On file
/// systems without locks it succeeds without one.
pub fn lock_folder(folder: &Path) -> Result<File, DatasetError> {
    lock(&folder.join(LOCK), folder, File::try_lock)
}

/// Locks a folder as [`lock_folder`] does, together with other processes that share it.
///
/// # Errors
/// [`DatasetError::Busy`] if another process holds the lock alone, and otherwise those of [`lock_folder`].
pub fn share_folder(folder: &Path) -> Result<File, DatasetError> {
    lock(&folder.join(LOCK), folder, File::try_lock_shared)
}

/// Locks a file, which is made if it is absent, as [`lock_folder`] locks a folder.
///
/// # Errors
/// Those of [`lock_folder`].
pub fn lock_file(path: &Path) -> Result<File, DatasetError> {
    lock(path, path, File::try_lock)
}

/// Number of times that a file is opened again because another process has removed it before it was locked.
const ATTEMPTS: usize = 100;

/// Opens and locks a file. The lock belongs to the file and not to its name: whoever locks a file that its last holder has removed holds
/// nothing, so the file that has the name now is opened then.
fn lock(path: &Path, what: &Path, attempt: impl Fn(&File) -> Result<(), TryLockError>) -> Result<File, DatasetError> {
    for _ in 0..ATTEMPTS {
        // Network file systems grant a shared lock only on files that can be read.
        let open = File::options().read(true).write(true).create(true).truncate(false).open(path);
        let file = open.map_err(DatasetError::io(path, "creating"))?;
        match attempt(&file) {
            Ok(()) if leads_to(path, &file) => return Ok(file),
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => break,
            Err(TryLockError::Error(error)) if error.kind() == std::io::ErrorKind::Unsupported => {
                tracing::warn!(
                    "{}: this file system knows no locks; see that only one process writes here",
                    path.display()
                );
                return Ok(file);
            }
            Err(TryLockError::Error(error)) => return Err(DatasetError::io(path, "locking")(error)),
        }
    }
    Err(DatasetError::Busy { path: what.to_owned() })
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

    /// A second opening of the file stands for another process.
    #[test]
    fn a_folder_is_held_by_one_or_shared_by_many() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path();
        let is_busy = |result: Result<File, DatasetError>| matches!(result, Err(DatasetError::Busy { .. }));
        let alone = lock_folder(path).expect("free");
        assert!(is_busy(lock_folder(path)) && is_busy(share_folder(path)));
        drop(alone);
        let shares = [share_folder(path).expect("free"), share_folder(path).expect("shared")];
        assert!(is_busy(lock_folder(path)));
        drop(shares);
        assert!(lock_folder(path).is_ok());
    }

    mod hard_cases {
        use std::cell::Cell;

        use super::*;

        /// A file that its holder removed between opening and locking gave a lock that kept nobody out.
        #[test]
        fn a_file_that_was_removed_meanwhile_is_made_again() {
            let folder = tempfile::tempdir().expect("a folder");
            let path = folder.path().join("a.lock");
            let attempts = Cell::new(0);
            let locked = lock(&path, &path, |file: &File| {
                if attempts.replace(attempts.get() + 1) == 0 {
                    std::fs::remove_file(&path).expect("removed");
                }
                file.try_lock()
            });
            let held = locked.expect("free");
            assert_eq!(attempts.get(), 2);
            assert!(matches!(lock_file(&path), Err(DatasetError::Busy { .. })));
            drop(held);
            assert!(lock_file(&path).is_ok());
        }
    }
}
