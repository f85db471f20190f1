//! Writing of dataset folders.

use std::fs::{self, File};
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use npyz::WriterBuilder;
use radome_dsp::{Rdm, RdmShape};
use sha2::{Digest, Sha256};

use super::error::DatasetError;
use super::header::DatasetHeader;
use super::layout::{MAPS_PER_SHARD, shard_name};
use super::lock::{LOCK, lock_folder};
use super::manifest::ManifestRow;
use crate::whole_file::sync_folder;

/// Writer of a dataset, map by map. [`DatasetWriter::finish`] gives the folder its name. Until then it is called `NAME.partial`:
/// the next writer removes the files of a killed one, and only one process at a time may write it.
pub struct DatasetWriter {
    target: PathBuf,
    temporary: PathBuf,
    /// Held as long as the folder is written.
    _lock: File,
    header: DatasetHeader,
    manifest: BufWriter<File>,
    pending: Vec<f32>,
    maps: usize,
    finished: bool,
}

pub(super) fn map_hash(db: &[f32]) -> String {
    let mut hash = Sha256::new();
    for value in db {
        hash.update(value.to_le_bytes());
    }
    format!("{:x}", hash.finalize())
}

pub(super) fn check_map(db: &[f32], shape: RdmShape, expected: RdmShape, frame: u64) -> Result<(), DatasetError> {
    if shape != expected || db.len() != expected.cells() {
        return Err(DatasetError::Shape { sequence: frame, expected, got: shape });
    }
    let cells = db.iter().filter(|v| !v.is_finite()).count();
    if cells > 0 {
        return Err(DatasetError::NonFinite { map: format!("of frame {frame}"), cells });
    }
    Ok(())
}

impl DatasetWriter {
    /// Starts a dataset that will be at `dir`, which must not exist.
    ///
    /// # Errors
    /// [`DatasetError::Exists`] if `dir` exists, [`DatasetError::Busy`] if another process writes it, and [`DatasetError::Io`] if
    /// its files cannot be created.
    pub fn create(dir: &Path, header: &DatasetHeader) -> Result<Self, DatasetError> {
        if dir.exists() {
            return Err(DatasetError::Exists { path: dir.to_owned() });
        }
        let mut name = dir.file_name().unwrap_or_default().to_owned();
        name.push(".partial");
        let temporary = dir.with_file_name(name);
        fs::create_dir_all(&temporary).map_err(DatasetError::io(&temporary, "creating the folder"))?;
        let lock = lock_folder(&temporary)?;
        // The process that held the lock may have finished in the meantime.
        if dir.exists() {
            let _ = fs::remove_dir_all(&temporary);
            return Err(DatasetError::Exists { path: dir.to_owned() });
        }
        remove_leftovers(&temporary).map_err(DatasetError::io(&temporary, "removing what an earlier run left"))?;
        let path = temporary.join("manifest.jsonl");
        let manifest = File::create(&path).map_err(DatasetError::io(&path, "creating"))?;
        Ok(DatasetWriter {
            target: dir.to_owned(),
            temporary,
            _lock: lock,
            header: header.clone(),
            manifest: BufWriter::new(manifest),
            pending: Vec::new(),
            maps: 0,
            finished: false,
        })
    }

    /// Appends a map; its hash is filled in here. A map with NaN, infinity or another shape is refused.
    ///
    /// # Errors
    /// [`DatasetError::Shape`] or [`DatasetError::NonFinite`] for a map that is refused, [`DatasetError::Io`] or
    /// [`DatasetError::Json`] if it cannot be written.
    pub fn push(&mut self, map: &Rdm, row: ManifestRow) -> Result<(), DatasetError> {
        check_map(&map.db, map.shape, self.header.shape, map.sequence)?;
        self.push_checked(&map.db, row)
    }

    /// Appends cells that passed the checks.
    pub(super) fn push_checked(&mut self, db: &[f32], mut row: ManifestRow) -> Result<(), DatasetError> {
        row.hash = map_hash(db);
        let path = self.temporary.join("manifest.jsonl");
        serde_json::to_writer(&mut self.manifest, &row).map_err(|source| DatasetError::Json {
            path: path.clone(),
            line: self.maps + 1,
            source,
        })?;
        self.manifest.write_all(b"\n").map_err(DatasetError::io(&path, "writing"))?;
        self.pending.extend_from_slice(db);
        self.maps += 1;
        if self.pending.len() >= MAPS_PER_SHARD * self.header.shape.cells() {
            self.write_shard()?;
        }
        Ok(())
    }

    /// Adds another file to the folder, which appears with the maps.
    ///
    /// # Errors
    /// [`DatasetError::Io`] if the file cannot be written.
    pub fn add_file(&mut self, name: &str, content: &[u8]) -> Result<(), DatasetError> {
        let path = self.temporary.join(name);
        let write = || File::create(&path).and_then(|mut f| f.write_all(content).and(f.sync_all()));
        write().map_err(DatasetError::io(&path, "writing"))
    }

    /// Number of maps so far.
    pub fn maps(&self) -> usize {
        self.maps
    }

    fn write_shard(&mut self) -> Result<(), DatasetError> {
        if self.pending.is_empty() {
            return Ok(());
        }
        let RdmShape { rx, doppler, range } = self.header.shape;
        let path = self.temporary.join(shard_name((self.maps - 1) / MAPS_PER_SHARD));
        let maps = self.pending.len() / self.header.shape.cells();
        let write = || -> std::io::Result<()> {
            let mut file = BufWriter::new(File::create(&path)?);
            let mut writer = npyz::WriteOptions::new()
                .default_dtype()
                .shape(&[maps as u64, rx as u64, doppler as u64, range as u64])
                .writer(&mut file)
                .begin_nd()?;
            writer.extend(self.pending.iter().copied())?;
            writer.finish()?;
            file.into_inner().map_err(|e| e.into_error())?.sync_all()
        };
        write().map_err(DatasetError::io(&path, "writing"))?;
        self.pending.clear();
        Ok(())
    }

    /// Writes the remaining maps and gives the folder its name.
    ///
    /// # Errors
    /// [`DatasetError::Io`] or [`DatasetError::Json`] if a file cannot be written or the folder cannot be renamed.
    pub fn finish(mut self) -> Result<(), DatasetError> {
        self.write_shard()?;
        let path = self.temporary.join("manifest.jsonl");
        self.manifest.flush().map_err(DatasetError::io(&path, "writing"))?;
        self.manifest.get_ref().sync_all().map_err(DatasetError::io(&path, "writing"))?;
        let text = serde_json::to_string_pretty(&self.header).map_err(|source| DatasetError::Json {
            path: self.temporary.join("dataset.json"),
            line: 1,
            source,
        })?;
        self.add_file("dataset.json", (text + "\n").as_bytes())?;
        let lock = self.temporary.join(LOCK);
        fs::remove_file(&lock).map_err(DatasetError::io(&lock, "removing"))?;
        sync_folder(&self.temporary).map_err(DatasetError::io(&self.temporary, "writing"))?;
        // Renaming succeeds over an empty folder only.
        fs::rename(&self.temporary, &self.target).map_err(DatasetError::io(&self.target, "renaming to"))?;
        let parent = self.target.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
        sync_folder(parent).map_err(DatasetError::io(parent, "writing"))?;
        self.finished = true;
        Ok(())
    }
}

impl Drop for DatasetWriter {
    /// Removes the folder of a writer that was not finished.
    fn drop(&mut self) {
        if !self.finished {
            let _ = fs::remove_dir_all(&self.temporary);
        }
    }
}

fn remove_leftovers(folder: &Path) -> std::io::Result<()> {
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        if entry.file_name() != LOCK {
            fs::remove_file(entry.path())?;
        }
    }
    Ok(())
}
