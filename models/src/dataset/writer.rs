//! Writing of dataset folders.

use std::ffi::OsStr;
use std::fs::{self, File};
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use npyz::WriterBuilder;
use radome_dsp::rdm::Motion;
use radome_dsp::{Rdm, RdmShape};
use radome_files::{parent_folder, with_suffix};
use sha2::{Digest, Sha256};

use super::error::DatasetError;
use super::header::DatasetHeader;
use super::layout::{MAPS_PER_SHARD, shard_name};
use super::lock::{LOCK_FILE, lock_folder};
use super::manifest::ManifestRow;
use crate::atomic_file::sync_folder;

/// Writer of a dataset, map by map. [`DatasetWriter::finish`] gives the folder its name. Until then it is called `NAME.partial`,
/// and one process at a time may write it. The next writer removes the files of a killed one. A folder of this name that holds
/// other files is refused.
pub struct DatasetWriter {
    target: PathBuf,
    temporary: PathBuf,
    /// Lock on the temporary folder.
    _lock: File,
    header: DatasetHeader,
    manifest: BufWriter<File>,
    /// Cells of the maps of the next shard.
    pending: Vec<f32>,
    maps: usize,
    /// Names of the files that were added.
    added: Vec<String>,
    finished: bool,
}

/// SHA-256 of a map's cells and motion, hex.
pub(super) fn map_hash(db: &[f32], motion: Option<Motion>) -> String {
    let mut hash = Sha256::new();
    for value in db.iter().chain(motion.map(Motion::to_array).iter().flatten()) {
        hash.update(value.to_le_bytes());
    }
    format!("{:x}", hash.finalize())
}

/// Checks that a map has the shape and the motion of a dataset, and finite numbers.
pub(super) fn check_map(map: &Rdm, header: &DatasetHeader) -> Result<(), DatasetError> {
    let (expected, frame) = (header.shape, map.sequence);
    if map.shape != expected || map.db.len() != expected.cells() {
        return Err(DatasetError::Shape { sequence: frame, expected, got: map.shape });
    }
    let cells = map.db.iter().filter(|v| !v.is_finite()).count();
    if cells > 0 {
        return Err(DatasetError::NonFinite { map: format!("of frame {frame}"), cells });
    }
    check_motion(map.motion, header, || format!("of frame {frame}"))
}

/// Checks that a map has motion if the map spec says so, and that it is finite. `map` names the map.
pub(super) fn check_motion(
    motion: Option<Motion>,
    header: &DatasetHeader,
    map: impl FnOnce() -> String,
) -> Result<(), DatasetError> {
    let is_finite = |motion: Motion| motion.to_array().iter().all(|quantity| quantity.is_finite());
    let expected = match header.rdm_spec.motion_over_s {
        Some(_) if !motion.is_some_and(is_finite) => "motion of finite numbers, as the map spec has motion_over_s",
        None if motion.is_some() => "no motion, as the map spec has no motion_over_s",
        _ => return Ok(()),
    };
    Err(DatasetError::Motion { map: map(), expected })
}

impl DatasetWriter {
    /// Starts a dataset that will be at `dir`, which must not exist.
    ///
    /// # Errors
    /// [`DatasetError::Exists`] if `dir` exists, [`DatasetError::Busy`] if another process writes it, [`DatasetError::ForeignFile`] if
    /// `NAME.partial` holds a file that no writer made, and [`DatasetError::Io`] if its files cannot be created.
    pub fn create(dir: &Path, header: &DatasetHeader) -> Result<Self, DatasetError> {
        if is_taken(dir) {
            return Err(DatasetError::Exists { path: dir.to_owned() });
        }
        let temporary = with_suffix(dir, ".partial");
        fs::create_dir_all(&temporary).map_err(DatasetError::io(&temporary, "creating the folder"))?;
        // This comes before locking: the lock file distinguishes the folder of a killed writer from a complete dataset.
        let foreign = foreign_file(&temporary).map_err(DatasetError::io(&temporary, "listing"))?;
        let lock = lock_folder(&temporary)?;
        if let Some(name) = foreign {
            let _ = fs::remove_file(temporary.join(LOCK_FILE));
            return Err(DatasetError::ForeignFile { path: temporary, name });
        }
        // The process that had the lock may have finished in the meantime.
        if is_taken(dir) {
            remove_folder(&temporary, &[]);
            return Err(DatasetError::Exists { path: dir.to_owned() });
        }
        remove_files(&temporary, &[]).map_err(DatasetError::io(&temporary, "removing what an earlier run left"))?;
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
            added: Vec::new(),
            finished: false,
        })
    }

    /// Appends a map. The motion and the hash of its row are those of the map.
    ///
    /// # Errors
    /// [`DatasetError::Shape`] for a map of another shape, [`DatasetError::NonFinite`] for one with NaN or infinity,
    /// [`DatasetError::Motion`] if motion is missing or not expected, and [`DatasetError::Io`] if it cannot be written.
    pub fn push(&mut self, map: &Rdm, row: ManifestRow) -> Result<(), DatasetError> {
        check_map(map, &self.header)?;
        self.push_checked(&map.db, ManifestRow { motion: map.motion, ..row })
    }

    /// Appends cells that passed [`check_map`].
    pub(super) fn push_checked(&mut self, db: &[f32], mut row: ManifestRow) -> Result<(), DatasetError> {
        row.hash = map_hash(db, row.motion);
        let path = self.temporary.join("manifest.jsonl");
        serde_json::to_writer(&mut self.manifest, &row)
            .map_err(|error| DatasetError::io(&path, "writing")(error.into()))?;
        self.manifest.write_all(b"\n").map_err(DatasetError::io(&path, "writing"))?;
        self.pending.extend_from_slice(db);
        self.maps += 1;
        if self.pending.len() >= MAPS_PER_SHARD * self.header.shape.cells() {
            self.write_shard()?;
        }
        Ok(())
    }

    /// Adds another file to the folder. It becomes visible with the maps.
    ///
    /// # Errors
    /// [`DatasetError::Io`] if the file cannot be written.
    pub fn add_file(&mut self, name: &str, content: &[u8]) -> Result<(), DatasetError> {
        let path = self.temporary.join(name);
        self.added.push(name.to_owned());
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
    /// [`DatasetError::Io`] if a file cannot be written or the folder cannot be renamed.
    pub fn finish(mut self) -> Result<(), DatasetError> {
        self.write_shard()?;
        let path = self.temporary.join("manifest.jsonl");
        self.manifest.flush().map_err(DatasetError::io(&path, "writing"))?;
        self.manifest.get_ref().sync_all().map_err(DatasetError::io(&path, "writing"))?;
        let text = serde_json::to_string_pretty(&self.header)
            .map_err(|error| DatasetError::io(&self.temporary.join("dataset.json"), "writing")(error.into()))?;
        self.add_file("dataset.json", (text + "\n").as_bytes())?;
        sync_folder(&self.temporary).map_err(DatasetError::io(&self.temporary, "writing"))?;
        // Renaming replaces an empty folder only.
        fs::rename(&self.temporary, &self.target).map_err(DatasetError::io(&self.target, "renaming to"))?;
        // Removed after renaming, so that a temporary folder always has its lock file. A lock file that stays in the dataset does no
        // harm.
        let _ = fs::remove_file(self.target.join(LOCK_FILE));
        let parent = parent_folder(&self.target);
        sync_folder(parent).map_err(DatasetError::io(parent, "writing"))?;
        self.finished = true;
        Ok(())
    }
}

impl Drop for DatasetWriter {
    /// Removes the files of a writer that was not finished, and its folder if it holds no other files.
    fn drop(&mut self) {
        if !self.finished {
            remove_folder(&self.temporary, &self.added);
        }
    }
}

/// Returns whether something has this name: a folder, or also a link that leads nowhere, which no folder replaces.
fn is_taken(path: &Path) -> bool {
    path.symlink_metadata().is_ok()
}

/// Returns whether dataset writers make files of this name. The lock file and added files are not included.
fn is_writer_file(name: &OsStr) -> bool {
    let name = name.to_str().unwrap_or_default();
    let shard = name.strip_prefix("maps-").and_then(|rest| rest.strip_suffix(".npy"));
    ["dataset.json", "manifest.jsonl"].contains(&name) || shard.is_some_and(|number| number.parse::<usize>().is_ok())
}

/// Name of a file in the folder that is not of a killed writer; `None` if there is none.
fn foreign_file(folder: &Path) -> std::io::Result<Option<String>> {
    let has = |name: &str| folder.join(name).exists();
    // A complete dataset has no lock file: a user has given it this name.
    if has("dataset.json") && !has(LOCK_FILE) {
        return Ok(Some("dataset.json".to_owned()));
    }
    for entry in fs::read_dir(folder)? {
        let name = entry?.file_name();
        if name != LOCK_FILE && !is_writer_file(&name) {
            return Ok(Some(name.to_string_lossy().into_owned()));
        }
    }
    Ok(None)
}

/// Removes the files of a writer except its lock file.
fn remove_files(folder: &Path, added: &[String]) -> std::io::Result<()> {
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        let name = entry.file_name();
        if is_writer_file(&name) || added.iter().any(|added| name == added.as_str()) {
            fs::remove_file(entry.path())?;
        }
    }
    Ok(())
}

/// Removes the files of a writer, and its folder if it is then empty.
fn remove_folder(folder: &Path, added: &[String]) {
    let _ = remove_files(folder, added);
    let _ = fs::remove_file(folder.join(LOCK_FILE));
    let _ = fs::remove_dir(folder);
}
