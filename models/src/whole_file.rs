//! Files that are whole or not there.

use std::io::Write;
use std::path::Path;

/// Writes a file under another name beside it, through to the disk, and renames it: a kill or a power cut leaves the old file or the
/// new one.
pub(crate) fn write(path: &Path, bytes: &[u8]) -> std::io::Result<()> {
    let mut name = path.file_name().unwrap_or_default().to_owned();
    // Another process may write the same one; the last to finish stays.
    name.push(format!(".partial-{}", std::process::id()));
    let temporary = path.with_file_name(name);
    let attempt = || {
        let mut file = std::fs::File::create(&temporary)?;
        file.write_all(bytes)?;
        file.sync_all()?;
        std::fs::rename(&temporary, path)?;
        sync_folder(path.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new(".")))
    };
    attempt().inspect_err(|_| drop(std::fs::remove_file(&temporary)))
}

/// Writes the names in a folder down to the disk, where the system lets folders be opened.
pub(crate) fn sync_folder(folder: &Path) -> std::io::Result<()> {
    if cfg!(unix) { std::fs::File::open(folder)?.sync_all() } else { Ok(()) }
}
