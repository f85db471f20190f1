//! What the tests of several modules need.

use std::path::PathBuf;

/// A file or folder below the shared data, which `RADOME_SHARED` or `../../shared` beside the workspace names. Says so
/// and gives `None` where it is absent: the test is then skipped.
pub fn shared(path: &str) -> Option<PathBuf> {
    let root = std::env::var_os("RADOME_SHARED")
        .map_or_else(|| PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../shared")), PathBuf::from);
    let path = root.join(path);
    if !path.exists() {
        #[allow(clippy::print_stderr)]
        {
            eprintln!("skipped: {} is absent; set RADOME_SHARED to the folder that holds data/", path.display());
        }
        return None;
    }
    Some(path)
}
