//! Locks that keep processes out of each other's files. The system releases them when a process ends, however it ends.

use std::fs::{File, TryLockError};
use std::path::Path;
use std::time::Duration;

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

fn lock(path: &Path, what: &Path, attempt: fn(&File) -> Result<(), TryLockError>) -> Result<File, DatasetError> {
    let open = || {
        // Network file systems grant a shared lock only on files that can be read.
        let opened = File::options().read(true).write(true).create(true).truncate(false).open(path);
        opened.map_err(DatasetError::io(path, "creating"))
    };
    let locked = radome_files::lock(path, Duration::ZERO, open, attempt, DatasetError::io(path, "locking"))?;
    locked.ok_or_else(|| DatasetError::Busy { path: what.to_owned() })
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
}
