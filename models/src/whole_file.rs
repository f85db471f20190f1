//! Files that are whole or not there.

use std::io::Write;
use std::path::Path;

/// Writes a file under another name beside it, through to the disk, and renames it: whoever is killed meanwhile leaves the old one.
pub(crate) fn write(path: &Path, bytes: &[u8]) -> std::io::Result<()> {
    let mut name = path.file_name().unwrap_or_default().to_owned();
    // Another process may write the same one; the last to finish stays.
    name.push(format!(".partial-{}", std::process::id()));
    let temporary = path.with_file_name(name);
    let attempt = || {
        let mut file = std::fs::File::create(&temporary)?;
        file.write_all(bytes)?;
        file.sync_all()?;
        std::fs::rename(&temporary, path)
    };
    attempt().inspect_err(|_| drop(std::fs::remove_file(&temporary)))
}
