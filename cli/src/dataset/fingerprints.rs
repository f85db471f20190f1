//! Fingerprints of the inputs of a build, with which a change between two runs is detected.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use anyhow::Context;
use radome_files::named_by_spec;
use sha2::{Digest, Sha256};

use crate::files;

/// Length of the parts at either end of a file that are hashed together with the file's length, bytes. Otherwise recordings of
/// many gigabytes would be read twice.
const END_BYTES: u64 = 1 << 19;
/// Largest nesting depth of files that name other files.
const MOST_DEPTH: usize = 4;

/// Fingerprints by name.
pub struct Fingerprints {
    base: PathBuf,
    hashes: BTreeMap<String, String>,
}

impl Fingerprints {
    /// Creates a collector for files named relative to a folder.
    pub fn new(base: &Path) -> Self {
        Fingerprints { base: base.to_owned(), hashes: BTreeMap::new() }
    }

    pub fn into_map(self) -> BTreeMap<String, String> {
        self.hashes
    }

    /// Adds a file.
    ///
    /// # Errors
    /// The file cannot be read.
    pub fn add_file(&mut self, name: &Path) -> anyhow::Result<()> {
        let hash = hash_file(&self.base.join(name))?;
        self.hashes.insert(name.display().to_string(), hash);
        Ok(())
    }

    /// Adds a scene file and, recursively, every file that it names.
    ///
    /// # Errors
    /// A file cannot be read, or files name each other too deeply.
    pub fn add_scene(&mut self, name: &Path) -> anyhow::Result<()> {
        self.add_recursively(name, 0)
    }

    fn add_recursively(&mut self, name: &Path, depth: usize) -> anyhow::Result<()> {
        let key = name.display().to_string();
        let path = self.base.join(name);
        if self.hashes.contains_key(&key) || !path.is_file() {
            return Ok(());
        }
        self.hashes.insert(key, hash_file(&path)?);
        if depth == MOST_DEPTH || path.extension().is_none_or(|e| e != "toml") {
            return Ok(());
        }
        let text = files::read_text_file(&path)?;
        // The scene's reader has rejected files that are not TOML.
        let Ok(table) = text.parse::<toml::Table>() else { return Ok(()) };
        let mut strings = Vec::new();
        collect_strings(&toml::Value::Table(table), &mut strings);
        let folder = name.parent().unwrap_or(Path::new(""));
        // Only names that a scene may use; other strings do not name a file.
        let scene_folder = self.base.join(folder);
        let files = strings.iter().filter(|string| named_by_spec(&scene_folder, Path::new(string)).is_ok());
        files.into_iter().try_for_each(|string| self.add_recursively(&folder.join(string), depth + 1))
    }

    /// Adds a recording, file or folder, and the file of its labels.
    ///
    /// # Errors
    /// A file of the recording cannot be read.
    pub fn add_recording(&mut self, name: &str, path: &Path, labels: Option<&Path>) -> anyhow::Result<()> {
        let mut files: Vec<PathBuf> = Vec::new();
        if path.is_dir() {
            let cannot = || format!("{}: cannot be listed", path.display());
            for entry in std::fs::read_dir(path).with_context(cannot)? {
                let file = entry.with_context(cannot)?.path();
                files.extend(file.is_file().then_some(file));
            }
            files.sort();
        } else {
            files.push(path.to_owned());
        }
        files.extend(labels.map(Path::to_owned));
        let mut hasher = Sha256::new();
        for file in files {
            hasher.update(file.file_name().unwrap_or_default().as_encoded_bytes());
            hasher.update(hash_file(&file)?);
        }
        self.hashes.insert(name.to_owned(), format!("{:x}", hasher.finalize()));
        Ok(())
    }
}

/// Collects all strings of a TOML value.
fn collect_strings(value: &toml::Value, strings: &mut Vec<String>) {
    match value {
        toml::Value::String(string) => strings.push(string.clone()),
        toml::Value::Array(values) => values.iter().for_each(|value| collect_strings(value, strings)),
        toml::Value::Table(table) => table.values().for_each(|value| collect_strings(value, strings)),
        _ => {}
    }
}

/// Returns the hash of a file's length and of its two ends.
fn hash_file(path: &Path) -> anyhow::Result<String> {
    let read = || -> std::io::Result<String> {
        let mut file = File::open(path)?;
        let length = file.metadata()?.len();
        let mut hasher = Sha256::new();
        hasher.update(length.to_le_bytes());
        let mut bytes = Vec::new();
        file.by_ref().take(END_BYTES).read_to_end(&mut bytes)?;
        if length > END_BYTES {
            file.seek(SeekFrom::Start(length.saturating_sub(END_BYTES).max(END_BYTES)))?;
            file.take(END_BYTES).read_to_end(&mut bytes)?;
        }
        hasher.update(&bytes);
        Ok(format!("{:x}", hasher.finalize()))
    };
    read().with_context(|| format!("cannot read {}", path.display()))
}
