//! Outputs that appear complete or not at all.

use std::ffi::OsString;
use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

use super::lock::{LABELS_LOCK_TIMEOUT, Locked, lock};
use super::{RecordingError, disk};

/// Policy for an output whose file exists already.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Existing {
    /// The file is kept: [`RecordingError::Occupied`].
    Refuse,
    /// The file is replaced once the output is complete.
    Replace,
}

/// File or folder under a temporary name beside its own, `.NAME.partial`: renamed when complete, removed if dropped
/// before. It is locked, so that two writers never share one. The remains of a killed writer are overwritten.
#[derive(Debug)]
pub struct Partial {
    partial: PathBuf,
    target: PathBuf,
    existing: Existing,
    is_published: bool,
    /// Lock of the file or folder, until it is handed out.
    lock: Option<Locked>,
    /// Lock of the file that will be replaced, against other writers.
    _replaced: Option<Locked>,
}

impl Partial {
    /// Starts a file.
    ///
    /// # Errors
    /// [`RecordingError::Occupied`] if the file exists and must not be replaced, [`RecordingError::Locked`] if another
    /// writer has or creates it, and [`RecordingError::Io`].
    pub fn file(target: &Path, existing: Existing) -> Result<Self, RecordingError> {
        Self::file_with_timeout(Duration::ZERO, target, existing)
    }

    /// Starts a file of labels beside a recording, which replaces an earlier one. Waits for another writer as long as
    /// [`LabelEditor::open`](super::mcap::LabelEditor::open) does.
    ///
    /// # Errors
    /// Those of [`Partial::file`].
    pub fn labels(target: &Path) -> Result<Self, RecordingError> {
        Self::file_with_timeout(LABELS_LOCK_TIMEOUT, target, Existing::Replace)
    }

    fn file_with_timeout(timeout: Duration, target: &Path, existing: Existing) -> Result<Self, RecordingError> {
        let partial = hidden(target, ".partial")?;
        let replaced = lock_replaced(target, existing, timeout)?;
        let open = || File::options().read(true).write(true).create(true).truncate(false).open(&partial);
        let locked = lock(&partial, timeout, open).map_err(with_name_of(target))?;
        let file = locked.file();
        #[cfg(test)]
        disk::trial::before(&partial, || disk::trial::Change::Create {
            inode: disk::trial::inode(file),
            path: partial.clone(),
        })
        .map_err(RecordingError::cannot_write(target))?;
        disk::set_length(file, &partial, 0).map_err(RecordingError::cannot_write(target))?;
        Ok(Partial {
            partial,
            target: target.to_owned(),
            existing,
            is_published: false,
            lock: Some(locked),
            _replaced: replaced,
        })
    }

    /// Starts a folder. A folder of its name is replaced if it is empty.
    ///
    /// # Errors
    /// [`RecordingError::Locked`] if another writer creates it, and [`RecordingError::Io`].
    pub fn folder(target: &Path) -> Result<Self, RecordingError> {
        let partial = hidden(target, ".partial")?;
        match std::fs::create_dir(&partial) {
            Err(error) if error.kind() != io::ErrorKind::AlreadyExists => {
                return Err(RecordingError::cannot_write(target)(error));
            }
            _ => {}
        }
        let lock = Some(lock(&partial, Duration::ZERO, || File::open(&partial)).map_err(with_name_of(target))?);
        let remove_content = || -> io::Result<()> {
            for entry in std::fs::read_dir(&partial)? {
                let entry = entry?;
                match entry.file_type()?.is_dir() {
                    true => std::fs::remove_dir_all(entry.path())?,
                    false => std::fs::remove_file(entry.path())?,
                }
            }
            Ok(())
        };
        remove_content().map_err(RecordingError::cannot_write(target))?;
        let (target, existing) = (target.to_owned(), Existing::Replace);
        Ok(Partial { partial, target, existing, is_published: false, lock, _replaced: None })
    }

    /// Name that the output will have.
    pub fn target(&self) -> &Path {
        &self.target
    }

    /// Temporary path to write to.
    pub fn path(&self) -> &Path {
        &self.partial
    }

    /// Opens the file, to be written from its start.
    ///
    /// # Errors
    /// [`RecordingError::Io`].
    pub fn open(&self) -> Result<File, RecordingError> {
        let locked = self.lock.as_ref().ok_or_else(|| io::Error::from(io::ErrorKind::IsADirectory));
        locked.and_then(|locked| locked.file().try_clone()).map_err(RecordingError::cannot_write(&self.target))
    }

    /// Gives the output its name, once it is on the disk. An existing folder is replaced only if it is empty.
    ///
    /// # Errors
    /// [`RecordingError::Occupied`] if a file has taken the name meanwhile and must not be replaced, and
    /// [`RecordingError::Io`].
    pub fn finish(self) -> Result<(), RecordingError> {
        self.publish().map(drop)
    }

    /// Gives a file its name while it is still written to, and returns its lock.
    pub(super) fn publish(mut self) -> Result<Option<Locked>, RecordingError> {
        let cannot = || RecordingError::cannot_write(&self.target);
        if let Some(lock) = &self.lock {
            disk::sync(lock.file(), &self.partial).map_err(cannot())?;
        }
        let result = match self.existing {
            Existing::Refuse => disk::rename_new(&self.partial, &self.target),
            Existing::Replace => disk::rename(&self.partial, &self.target),
        };
        match result {
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {
                return Err(RecordingError::Occupied { path: self.target.clone() });
            }
            result => result.map_err(cannot())?,
        }
        self.is_published = true;
        disk::sync_folder(&self.target).map_err(RecordingError::cannot_write(&self.target))?;
        Ok(self.lock.take())
    }
}

impl Drop for Partial {
    fn drop(&mut self) {
        if !self.is_published {
            // A file that cannot be removed does no harm.
            let _ = match self.partial.is_dir() {
                true => std::fs::remove_dir_all(&self.partial),
                false => disk::remove(&self.partial),
            };
        }
    }
}

/// Longest name of a file on most file systems, bytes.
const LONGEST_NAME: usize = 255;

/// Returns the path `.NAME` with an ending, beside NAME. If that name is too long, a hash replaces the end of NAME.
pub(super) fn hidden(target: &Path, ending: &str) -> Result<PathBuf, RecordingError> {
    let Some(name) = target.file_name() else {
        let source = io::Error::new(io::ErrorKind::InvalidInput, "the path names no file");
        return Err(RecordingError::cannot_write(target)(source));
    };
    let mut hidden = OsString::from(".");
    if name.len() + 1 + ending.len() > LONGEST_NAME {
        let hash = format!("~{:08x}", crc32fast::hash(name.as_encoded_bytes()));
        let text = name.to_string_lossy();
        let room = LONGEST_NAME - 1 - hash.len() - ending.len();
        hidden.push(&text[..text.floor_char_boundary(room)]);
        hidden.push(hash);
    } else {
        hidden.push(name);
    }
    hidden.push(ending);
    Ok(target.with_file_name(hidden))
}

/// Locks a file that will be replaced, if there is one.
fn lock_replaced(target: &Path, existing: Existing, timeout: Duration) -> Result<Option<Locked>, RecordingError> {
    let not_a_file = |what: &str| {
        let source = io::Error::new(io::ErrorKind::InvalidInput, format!("it is {what}, expected a file"));
        RecordingError::cannot_write(target)(source)
    };
    let metadata = match std::fs::metadata(target) {
        Ok(metadata) => metadata,
        // A link that leads nowhere is replaced like a file.
        Err(_) if existing == Existing::Replace || std::fs::symlink_metadata(target).is_err() => return Ok(None),
        Err(_) => return Err(RecordingError::Occupied { path: target.to_owned() }),
    };
    if metadata.is_dir() {
        return Err(not_a_file("a folder"));
    }
    if !metadata.is_file() {
        return Err(not_a_file("a device"));
    }
    if existing == Existing::Refuse {
        return Err(RecordingError::Occupied { path: target.to_owned() });
    }
    match lock(target, timeout, || File::open(target)) {
        // A file that may not be read may still be replaced.
        Err(RecordingError::Io { source, .. }) if source.kind() == io::ErrorKind::PermissionDenied => Ok(None),
        locked => locked.map(Some),
    }
}

/// Returns a function that replaces the path in an error by the output's own name.
fn with_name_of(target: &Path) -> impl FnOnce(RecordingError) -> RecordingError {
    let path = target.to_owned();
    move |error| match error {
        RecordingError::Locked { .. } => RecordingError::Locked { path },
        RecordingError::Io { source, .. } => RecordingError::Io { path, what: "cannot be written", source },
        RecordingError::Missing { .. } => {
            RecordingError::Io { path, what: "cannot be written", source: io::ErrorKind::NotFound.into() }
        }
        other => other,
    }
}

/// Renames a file in the same file system, replaces a file of that name, and waits until the name is on the disk. The
/// content of the file must be there already.
///
/// # Errors
/// [`RecordingError::Io`].
pub fn rename_synced(from: &Path, to: &Path) -> Result<(), RecordingError> {
    disk::rename(from, to).and_then(|()| disk::sync_folder(to)).map_err(RecordingError::cannot_write(to))
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::*;

    #[test]
    fn an_output_is_whole_or_absent_and_a_second_writer_is_refused() {
        let folder = tempfile::tempdir().expect("folder");
        let path = folder.path().join("a.bin");
        let partial = Partial::file(&path, Existing::Refuse).expect("starts");
        partial.open().expect("opens").write_all(b"half").expect("writes");
        assert!(matches!(Partial::file(&path, Existing::Refuse), Err(RecordingError::Locked { .. })));
        assert!(!path.exists());
        drop(partial);
        assert_eq!(std::fs::read_dir(folder.path()).expect("lists").count(), 0);

        let partial = Partial::file(&path, Existing::Refuse).expect("starts");
        partial.open().expect("opens").write_all(b"whole").expect("writes");
        partial.finish().expect("finishes");
        assert_eq!(std::fs::read(&path).expect("reads"), b"whole");
        assert_eq!(std::fs::read_dir(folder.path()).expect("lists").count(), 1);
    }

    #[test]
    fn an_existing_file_is_replaced_only_on_demand() {
        let folder = tempfile::tempdir().expect("folder");
        let path = folder.path().join("a.bin");
        let early = Partial::file(&path, Existing::Refuse).expect("starts");
        // Another writer takes the name first.
        std::fs::write(&path, "old").expect("writes");
        assert!(matches!(early.finish(), Err(RecordingError::Occupied { .. })));
        assert!(matches!(Partial::file(&path, Existing::Refuse), Err(RecordingError::Occupied { .. })));
        let partial = Partial::file(&path, Existing::Replace).expect("starts");
        partial.open().expect("opens").write_all(b"new").expect("writes");
        assert_eq!(std::fs::read(&path).expect("reads"), b"old");
        partial.finish().expect("finishes");
        assert_eq!(std::fs::read(&path).expect("reads"), b"new");
    }

    /// Regression test: names of more than 246 bytes were refused, since the temporary name was too long.
    #[test]
    fn a_name_may_be_as_long_as_the_file_system_allows() {
        let folder = tempfile::tempdir().expect("folder");
        for name in ["a".repeat(246), "a".repeat(247), "a".repeat(255), format!("b{}", "é".repeat(127))] {
            let path = folder.path().join(&name);
            let partial = Partial::file(&path, Existing::Refuse).expect("starts");
            let other = Partial::file(&folder.path().join(format!("{}z", &name[..name.len() - 2])), Existing::Refuse);
            other.expect("starts").finish().expect("another name");
            partial.finish().expect("finishes");
            assert!(path.exists(), "{name}");
        }
    }

    #[test]
    fn remains_of_a_killed_writer_are_overwritten() {
        let folder = tempfile::tempdir().expect("folder");
        std::fs::write(folder.path().join(".a.bin.partial"), "left over and longer").expect("writes");
        let path = folder.path().join("a.bin");
        let partial = Partial::file(&path, Existing::Refuse).expect("starts");
        partial.open().expect("opens").write_all(b"new").expect("writes");
        partial.finish().expect("finishes");
        assert_eq!(std::fs::read(&path).expect("reads"), b"new");
    }
}
