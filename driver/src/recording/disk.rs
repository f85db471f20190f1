//! Operations on files that a power cut can interrupt. MCAP recordings, labels and the names of outputs change on the
//! disk through these functions only. Tests can therefore make each operation fail, be lost or be incomplete.
//!
//! Samples of the other formats are written directly. Until they are on the disk, they have a hidden name:
//! [`Partial`](super::Partial).

use std::fs::File;
use std::io::{self, Seek, SeekFrom, Write};
use std::os::unix::fs::MetadataExt;
use std::path::Path;

use radome_files::parent_folder;
use rustix::fs::{CWD, RenameFlags, renameat_with};
use rustix::io::Errno;

/// Appends to a file that is `at` bytes long and whose position is its end.
pub(super) fn append(mut file: &File, path: &Path, at: u64, bytes: &[u8]) -> io::Result<()> {
    let _ = (path, at);
    #[cfg(test)]
    if let Err(error) =
        trial::before(path, || trial::Change::Write { inode: trial::inode(file), at, bytes: bytes.into() })
    {
        // A full disk stores as much as it has room for.
        file.write_all(bytes.get(..bytes.len() / 2).unwrap_or(&[]))?;
        return Err(error);
    }
    file.write_all(bytes)
}

/// Fails for a file that is shorter than what was written to it. Another program has cut it, and more data would follow a
/// hole.
pub(super) fn check_length(file: &File, written: u64) -> io::Result<()> {
    let metadata = file.metadata()?;
    if metadata.is_file() && metadata.len() < written {
        let why = format!("it was cut to {} of {written} bytes while it was written", metadata.len());
        return Err(io::Error::new(io::ErrorKind::UnexpectedEof, why));
    }
    Ok(())
}

/// Writes over a file from `at` on.
pub(super) fn overwrite(mut file: &File, path: &Path, at: u64, bytes: &[u8]) -> io::Result<()> {
    file.seek(SeekFrom::Start(at))?;
    append(file, path, at, bytes)
}

/// Writes a small file and waits until it is on the disk.
pub(super) fn write_file(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let file = File::create(path)?;
    append(&file, path, 0, bytes)?;
    sync(&file, path)
}

/// Shortens a file, or extends it with zeros.
pub(super) fn set_length(file: &File, path: &Path, length: u64) -> io::Result<()> {
    let _ = path;
    #[cfg(test)]
    trial::before(path, || trial::Change::SetLength { inode: trial::inode(file), length })?;
    file.set_len(length)
}

/// Reserves room on the disk, so that a full disk is detected before anything is overwritten. File systems that cannot
/// reserve room detect it later.
pub(super) fn reserve(file: &File, at: u64, bytes: u64) -> io::Result<()> {
    match rustix::fs::fallocate(file, rustix::fs::FallocateFlags::KEEP_SIZE, at, bytes) {
        Err(error) if error == Errno::NOSPC => Err(error.into()),
        _ => Ok(()),
    }
}

/// Waits until all data written to a file or folder are on the disk. Returns at once for a device or a pipe. Fails for a
/// file that was removed, because its data would vanish when it is closed.
pub(super) fn sync(file: &File, path: &Path) -> io::Result<()> {
    let metadata = file.metadata()?;
    if !metadata.is_file() && !metadata.is_dir() {
        return Ok(());
    }
    // Some file systems do not count names, so the path is checked, too.
    let has_path = || std::fs::metadata(path).is_ok_and(|found| found.ino() == metadata.ino());
    if metadata.nlink() == 0 && !has_path() {
        return Err(io::Error::new(io::ErrorKind::NotFound, "it was removed while it was written"));
    }
    #[cfg(test)]
    trial::before(path, || trial::Change::Sync { inode: trial::inode(file) })?;
    file.sync_data()
}

/// Waits until the names in the folder of `path` are on the disk.
pub(super) fn sync_folder(path: &Path) -> io::Result<()> {
    #[cfg(test)]
    trial::before(path, || trial::Change::SyncFolder)?;
    File::open(parent_folder(path))?.sync_all()
}

/// Creates an empty file without a name, for writing and reading, in the folder of `path`. If `file`, which has that
/// path, is a device or a pipe, the new file is among the system's temporary files. It vanishes when it is closed or
/// its process ends.
pub(super) fn unnamed(file: &File, path: &Path) -> io::Result<File> {
    if file.metadata()?.is_file() { tempfile::tempfile_in(parent_folder(path)) } else { tempfile::tempfile() }
}

/// Renames a file and replaces a file of the new name.
pub(super) fn rename(from: &Path, to: &Path) -> io::Result<()> {
    #[cfg(test)]
    trial::before(to, || trial::Change::Rename { from: from.into(), to: to.into() })?;
    std::fs::rename(from, to)
}

/// Renames a file, or fails with [`io::ErrorKind::AlreadyExists`].
pub(super) fn rename_new(from: &Path, to: &Path) -> io::Result<()> {
    #[cfg(test)]
    trial::before(to, || trial::Change::Rename { from: from.into(), to: to.into() })?;
    match renameat_with(CWD, from, CWD, to, RenameFlags::NOREPLACE) {
        // The file system cannot rename without replacing in one step.
        Err(error) if error == Errno::INVAL || error == Errno::NOSYS || error == Errno::OPNOTSUPP => {}
        done => return Ok(done?),
    }
    if std::fs::symlink_metadata(to).is_ok() {
        return Err(io::ErrorKind::AlreadyExists.into());
    }
    std::fs::rename(from, to)
}

/// Removes a file; an absent file is no error.
pub(super) fn remove(path: &Path) -> io::Result<()> {
    #[cfg(test)]
    trial::before(path, || trial::Change::Remove { path: path.into() })?;
    match std::fs::remove_file(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
        done => done,
    }
}

/// Record of the disk operations below a test's folder, and the faults injected into them.
#[cfg(test)]
pub(super) mod trial {
    use std::fs::File;
    use std::io;
    use std::os::unix::fs::MetadataExt;
    use std::path::{Path, PathBuf};
    use std::sync::{Arc, Mutex, PoisonError};
    use std::time::Duration;

    /// Disk operation.
    #[derive(Debug, Clone)]
    pub enum Change {
        /// Creation of an empty file with this name.
        Create { inode: u64, path: PathBuf },
        /// Write of bytes at an offset.
        Write { inode: u64, at: u64, bytes: Vec<u8> },
        /// Change of a file's length.
        SetLength { inode: u64, length: u64 },
        /// Sync of a file: all its changes so far are on the disk.
        Sync { inode: u64 },
        /// Sync of the folder: all its names so far are on the disk.
        SyncFolder,
        /// Change of a name.
        Rename { from: PathBuf, to: PathBuf },
        /// Removal of a name.
        Remove { path: PathBuf },
        /// Progress mark of the test; no operation.
        Mark(u64),
    }

    impl Change {
        fn needs_room(&self) -> bool {
            matches!(self, Change::Create { .. } | Change::Write { .. })
        }
    }

    /// Plan of the injected faults.
    #[derive(Debug, Clone, Copy)]
    pub enum Plan {
        /// No operation fails.
        Work,
        /// The operation with this number fails with an input/output error.
        Fail(usize),
        /// From the operation with this number on, the disk is full.
        Full(usize),
        /// Every sync takes this long.
        Slow(Duration),
    }

    /// Operations below a folder so far, and the faults to inject.
    pub struct Trial {
        folder: PathBuf,
        plan: Plan,
        changes: Mutex<Vec<Change>>,
    }

    static TRIALS: Mutex<Vec<Arc<Trial>>> = Mutex::new(Vec::new());

    fn trials() -> std::sync::MutexGuard<'static, Vec<Arc<Trial>>> {
        TRIALS.lock().unwrap_or_else(PoisonError::into_inner)
    }

    impl Trial {
        /// Watches a folder until dropped.
        pub fn start(folder: &Path, plan: Plan) -> Watched {
            let trial = Arc::new(Trial { folder: folder.to_owned(), plan, changes: Mutex::default() });
            trials().push(trial.clone());
            Watched(trial)
        }
    }

    /// Handle of a watched folder.
    pub struct Watched(Arc<Trial>);

    impl Watched {
        /// Returns all operations so far.
        pub fn changes(&self) -> Vec<Change> {
            self.0.changes.lock().unwrap_or_else(PoisonError::into_inner).clone()
        }

        /// Notes how far the test has got.
        pub fn mark(&self, number: u64) {
            self.0.changes.lock().unwrap_or_else(PoisonError::into_inner).push(Change::Mark(number));
        }
    }

    impl Drop for Watched {
        fn drop(&mut self) {
            trials().retain(|trial| !Arc::ptr_eq(trial, &self.0));
        }
    }

    /// Number of a file, which stays the same when the file is renamed.
    pub fn inode(file: &File) -> u64 {
        file.metadata().map_or(0, |metadata| metadata.ino())
    }

    /// Records an operation before it is executed. An error is returned instead of the execution.
    pub fn before(path: &Path, change: impl FnOnce() -> Change) -> io::Result<()> {
        let found = trials().iter().find(|trial| path.starts_with(&trial.folder)).cloned();
        let Some(trial) = found else { return Ok(()) };
        let change = change();
        let is_sync = matches!(change, Change::Sync { .. });
        {
            let mut changes = trial.changes.lock().unwrap_or_else(PoisonError::into_inner);
            let number = changes.iter().filter(|change| !matches!(change, Change::Mark(_))).count();
            let fails = match trial.plan {
                Plan::Fail(at) => number == at,
                Plan::Full(from) => number >= from && change.needs_room(),
                Plan::Work | Plan::Slow(_) => false,
            };
            // A failed operation counts too, so that only one operation fails.
            changes.push(if fails { Change::SetLength { inode: 0, length: 0 } } else { change });
            if fails {
                let full = matches!(trial.plan, Plan::Full(_));
                return Err(io::Error::from_raw_os_error(if full { 28 } else { 5 }));
            }
        }
        if let Plan::Slow(wait) = trial.plan
            && is_sync
        {
            std::thread::sleep(wait);
        }
        Ok(())
    }
}
