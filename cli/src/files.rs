//! Where the program's own scenes and models lie, and files that appear whole or not at all.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};

/// Path of a file under `fixtures/`: from the working directory, beside the executable, or in the source tree.
pub fn fixture(name: &str) -> anyhow::Result<PathBuf> {
    let beside_executable = std::env::current_exe().ok().and_then(|exe| Some(exe.parent()?.join("fixtures")));
    let roots = [
        Some(PathBuf::from("fixtures")),
        beside_executable,
        Some(Path::new(env!("CARGO_MANIFEST_DIR")).join("../fixtures")),
    ];
    for root in roots.iter().flatten() {
        let path = root.join(name);
        if path.exists() {
            return Ok(path);
        }
    }
    bail!("fixtures/{name} is not here\n\nhint: run radome in its source folder, or name a file of your own")
}

/// Writes a file under a temporary name and renames it when `write` is done: it is whole or absent.
pub fn write_atomically(
    path: &Path,
    write: impl FnOnce(&mut std::io::BufWriter<std::fs::File>) -> anyhow::Result<()>,
) -> anyhow::Result<()> {
    use std::io::Write;
    let mut name = path.file_name().unwrap_or_default().to_owned();
    name.push(".partial");
    let partial = path.with_file_name(name);
    let attempt = || {
        let file = std::fs::File::create(&partial).with_context(|| format!("cannot create {}", partial.display()))?;
        let mut writer = std::io::BufWriter::new(file);
        write(&mut writer)?;
        writer.flush().with_context(|| format!("cannot write {}", partial.display()))?;
        std::fs::rename(&partial, path).with_context(|| format!("cannot rename to {}", path.display()))
    };
    attempt().inspect_err(|_| {
        let _ = std::fs::remove_file(&partial);
    })
}

/// Fails early if the folder of an output file is missing.
pub fn check_parent(path: &Path) -> anyhow::Result<()> {
    let parent = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    if !parent.is_dir() {
        bail!("folder {} does not exist\n\nhint: mkdir -p {0}", parent.display());
    }
    Ok(())
}
