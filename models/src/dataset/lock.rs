//! Locks on files and folders that several processes use. The system releases them when a process ends for any reason.

use std::fs::{File, TryLockError};
use std::path::Path;
use std::time::Duration;

use super::error::DatasetError;

/// Name of the file whose lock stands for the lock on its folder.
pub(super) const LOCK_FILE: &str = ".lock";

/// Locks a folder that one process at a time may write, until the returned file is dropped.
///
/// # Errors
/// [`DatasetError::Busy`] if another process holds or shares the lock, and [`DatasetError::Io`] if its file cannot be created. On
/// file systems without locks, it succeeds without a lock.
pub fn lock_folder(folder: &Path) -> Result<File, DatasetError> {
    lock(&folder.join(LOCK_FILE), folder, File::try_lock)
}

/// Locks a folder as [`lock_folder`] does, but shares the lock with other processes that call this function.
///
/// # Errors
/// [`DatasetError::Busy`] if another process holds the lock exclusively, and otherwise those of [`lock_folder`].
pub fn share_folder(folder: &Path) -> Result<File, DatasetError> {
    lock(&folder.join(LOCK_FILE), folder, File::try_lock_shared)
}

/// Locks a file as [`lock_folder`] locks a folder. It is created if it is absent.
///
/// # Errors
/// Those of [`lock_folder`].
pub fn lock_file(path: &Path) -> Result<File, DatasetError> {
    lock(path, path, File::try_lock)
}

/// Locks the file at `path` by `try_lock`; `locked_path` is named in [`DatasetError::Busy`].
fn lock(
    path: &Path,
    locked_path: &Path,
    try_lock: fn(&File) -> Result<(), TryLockError>,
) -> Result<File, DatasetError> {
    let open = || {
        // Network file systems grant a shared lock only on files that can be read.
        let opened = File::options().read(true).write(true).create(true).truncate(false).open(path);
        opened.map_err(DatasetError::io(path, "creating"))
    };
    let locked = radome_files::lock(path, Duration::ZERO, open, try_lock, DatasetError::io(path, "locking"))?;
    locked.ok_or_else(|| DatasetError::Busy { path: locked_path.to_owned() })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Opening the file a second time simulates another process.
    #[test]
    fn a_folder_is_locked_by_one_or_shared_by_many() {
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
