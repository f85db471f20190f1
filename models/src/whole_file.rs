//! Atomic writing of files: a file is complete or absent.

use std::hash::{BuildHasher, RandomState};
use std::io::Write;
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};

/// Writes a file under a temporary name beside it, syncs it to the disk, and renames it. A kill or a power cut leaves the old file
/// or the new one.
pub(crate) fn write(path: &Path, bytes: &[u8]) -> std::io::Result<()> {
    static WRITTEN: AtomicU64 = AtomicU64::new(0);
    let mut name = path.file_name().unwrap_or_default().to_owned();
    // Another process or thread may write the same file; the last to finish wins. Processes in containers have the same
    // number, so a random one tells them apart.
    let random = RandomState::new().hash_one(WRITTEN.fetch_add(1, Ordering::Relaxed));
    name.push(format!(".partial-{}-{random:x}", std::process::id()));
    let temporary = path.with_file_name(name);
    let attempt = || {
        let mut file = std::fs::File::create_new(&temporary)?;
        file.write_all(bytes)?;
        file.sync_all()?;
        std::fs::rename(&temporary, path)?;
        sync_folder(path.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new(".")))
    };
    attempt().inspect_err(|_| drop(std::fs::remove_file(&temporary)))
}

/// Syncs the names in a folder to the disk, on systems that can open folders.
pub(crate) fn sync_folder(folder: &Path) -> std::io::Result<()> {
    if cfg!(unix) { std::fs::File::open(folder)?.sync_all() } else { Ok(()) }
}
