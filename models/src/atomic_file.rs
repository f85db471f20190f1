//! Atomic writing of files: a file is either complete or absent.

use std::ffi::OsStr;
use std::fs::File;
use std::hash::{BuildHasher, RandomState};
use std::io::Write;
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};

use radome_files::parent_folder;

/// Writes a file under a temporary name beside it, syncs it to the disk, and renames it. After a kill or a power cut, `path` is
/// the old file or the new one. A temporary file may remain; the next writer of `path` removes it.
pub(crate) fn write(path: &Path, bytes: &[u8]) -> std::io::Result<()> {
    static WRITTEN: AtomicU64 = AtomicU64::new(0);
    let folder = parent_folder(path);
    let mut name = path.file_name().unwrap_or_default().to_owned();
    name.push(".partial-");
    remove_leftovers(folder, &name);
    // Another process or thread may write the same file; the last to finish wins. Processes in containers may have the same id,
    // so the name also has a random number.
    let random = RandomState::new().hash_one(WRITTEN.fetch_add(1, Ordering::Relaxed));
    name.push(format!("{}-{random:x}", std::process::id()));
    let temporary = path.with_file_name(name);
    let attempt = || {
        let mut file = File::create_new(&temporary)?;
        // The lock shows that the writer is alive. Without locks in the file system, files of killed writers stay.
        let _ = file.lock();
        file.write_all(bytes)?;
        file.sync_all()?;
        std::fs::rename(&temporary, path)?;
        sync_folder(folder)
    };
    attempt().inspect_err(|_| drop(std::fs::remove_file(&temporary)))
}

/// Removes the temporary files of killed writers: files that are not locked and whose names [`write`] makes from `prefix`. A
/// file that cannot be removed does no harm.
fn remove_leftovers(folder: &Path, prefix: &OsStr) {
    for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
        if !is_temporary(&entry.file_name(), prefix) || !entry.file_type().is_ok_and(|kind| kind.is_file()) {
            continue;
        }
        let Ok(file) = File::options().write(true).open(entry.path()) else { continue };
        // The writer of an empty file may be about to lock it.
        if file.try_lock().is_ok() && file.metadata().is_ok_and(|metadata| metadata.len() > 0) {
            let _ = std::fs::remove_file(entry.path());
        }
    }
}

/// Returns whether a name consists of the prefix, a process id, a hyphen and a hexadecimal number.
fn is_temporary(name: &OsStr, prefix: &OsStr) -> bool {
    let rest = name.as_encoded_bytes().strip_prefix(prefix.as_encoded_bytes());
    let numbers = rest.and_then(|rest| std::str::from_utf8(rest).ok()).and_then(|rest| rest.split_once('-'));
    numbers.is_some_and(|(process, random)| process.parse::<u32>().is_ok() && u64::from_str_radix(random, 16).is_ok())
}

/// Syncs the names in a folder to the disk, on systems that can open folders.
pub(crate) fn sync_folder(folder: &Path) -> std::io::Result<()> {
    if cfg!(unix) { File::open(folder)?.sync_all() } else { Ok(()) }
}

#[cfg(test)]
mod hard_cases {
    use super::*;

    /// Regression test: after a kill during the writing of a checkpoint, its temporary file was never removed.
    #[test]
    fn files_of_a_killed_writer_are_removed_by_the_next() {
        let folder = tempfile::tempdir().expect("a folder");
        let at = |name: &str| folder.path().join(name);
        let foreign = ["ab.partial-1-2f", "a.partial", "a.partial-1", "a.partial-old", "a.partial-1-best"];
        for name in ["a.partial-1-2f", "a.partial-1-3f"].into_iter().chain(foreign) {
            std::fs::write(at(name), "half").expect("written");
        }
        // An open file with a lock simulates a running writer.
        let running = File::options().write(true).open(at("a.partial-1-3f")).expect("opens");
        running.try_lock().expect("locked");
        write(&at("a"), b"whole").expect("written");
        assert_eq!(std::fs::read(at("a")).expect("read"), b"whole");
        let names = std::fs::read_dir(folder.path()).expect("a folder").flatten();
        let mut names: Vec<_> = names.map(|entry| entry.file_name().into_string().expect("text")).collect();
        names.sort();
        let kept =
            ["a", "a.partial", "a.partial-1", "a.partial-1-3f", "a.partial-1-best", "a.partial-old", "ab.partial-1-2f"];
        assert_eq!(names, kept);
    }
}
