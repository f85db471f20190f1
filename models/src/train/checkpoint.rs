//! Checkpoints: the state of a training after each epoch, so that a stopped and continued training gives the same weights.

use std::collections::{BTreeMap, HashMap};
use std::fs::File;
use std::path::{Path, PathBuf};

use radome_files::{read, with_suffix};
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde::{Deserialize, Deserializer, Serialize};

use super::error::TrainError;
use super::outcome::EpochReport;
use crate::array_hash;
use crate::atomic_file;
use crate::dataset::{DatasetError, lock_file};
use crate::network::Normalisation;

/// Largest checkpoint that is read: two starts with moments and best weights, seven times the largest model.
const LIMIT_BYTES: u64 = 4 << 30;
/// Key in the metadata of all that is not an array.
const KEY: &str = "radome-training";

/// Lock on a checkpoint, so that two trainings do not use the same one. It is the file `CHECKPOINT.lock`, which is removed when the
/// lock is dropped: after the model is saved and the checkpoint removed.
#[derive(Debug)]
pub struct CheckpointLock {
    path: PathBuf,
    _file: File,
}

impl CheckpointLock {
    /// Locks the checkpoint of this path, which need not exist.
    ///
    /// # Errors
    /// [`DatasetError::Busy`] if another training holds it, and [`DatasetError::Io`] if the file of the lock cannot be made.
    pub fn new(checkpoint: &Path) -> Result<Self, DatasetError> {
        let path = Self::path_of(checkpoint);
        let file = lock_file(&path)?;
        Ok(CheckpointLock { path, _file: file })
    }

    /// Path of the lock's file, which is removed at the end.
    pub fn path_of(checkpoint: &Path) -> PathBuf {
        with_suffix(checkpoint, ".lock")
    }
}

impl Drop for CheckpointLock {
    fn drop(&mut self) {
        // Removed while locked: another training that has opened the file notices that it is deleted.
        let _ = std::fs::remove_file(&self.path);
    }
}

/// State after the best epoch so far.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct Best {
    pub balanced_accuracy: f64,
    pub loss: f64,
    pub epoch: usize,
    #[serde(skip)]
    pub values: BTreeMap<String, Vec<f32>>,
    pub latent: Normalisation,
}

/// State of one initialisation between two epochs.
#[derive(Serialize, Deserialize)]
pub(super) struct RunState {
    pub start: u64,
    pub epoch: usize,
    pub step: usize,
    pub warming_up: bool,
    pub head_step: usize,
    pub adam_steps: i32,
    /// Infinity is written as `null`, because JSON lacks it.
    #[serde(deserialize_with = "infinity_if_null")]
    pub latest_loss: f64,
    #[serde(rename = "centrings")]
    pub normalisations: BTreeMap<String, Normalisation>,
    /// Parameters and running statistics.
    #[serde(skip)]
    pub values: BTreeMap<String, Vec<f32>>,
    /// Adam's moments.
    #[serde(skip)]
    pub moments: BTreeMap<String, Vec<f32>>,
    pub best: Option<Best>,
}

/// State of a training between two epochs. Numbers are JSON in the metadata of the file, arrays are its tensors.
#[derive(Serialize, Deserialize)]
pub(super) struct Checkpoint {
    /// Text of everything that decides the outcome: spec, dataset, kernel level.
    pub fingerprint: String,
    pub history: Vec<EpochReport>,
    /// Index of the next start.
    pub next_start: u64,
    /// Best of the starts after their trial.
    pub leader: Option<RunState>,
    /// Start in its trial.
    pub trial: Option<RunState>,
}

fn infinity_if_null<'de, D: Deserializer<'de>>(number: D) -> Result<f64, D::Error> {
    Ok(Option::deserialize(number)?.unwrap_or(f64::INFINITY))
}

impl Checkpoint {
    /// Writes under a temporary name and renames, so that the file is always complete.
    pub(super) fn save(&self, path: &Path) -> Result<(), TrainError> {
        let mut arrays: Vec<(String, Vec<u8>)> = Vec::new();
        for (role, state) in [("leader", &self.leader), ("trial", &self.trial)] {
            let Some(state) = state else { continue };
            let best = state.best.as_ref().map(|best| ("best", &best.values));
            for (kind, by_name) in [("value", &state.values), ("moment", &state.moments)].into_iter().chain(best) {
                for (name, values) in by_name {
                    let bytes = values.iter().flat_map(|v| v.to_le_bytes()).collect();
                    arrays.push((format!("{role}/{kind}/{name}"), bytes));
                }
            }
        }
        let named_bytes = arrays.iter().map(|(name, bytes)| (name.as_str(), bytes.as_slice()));
        let text = array_hash::to_json(self, named_bytes).map_err(|e| write_error(path, e))?;
        let views = arrays
            .iter()
            .map(|(name, bytes)| Ok((name, TensorView::new(Dtype::F32, vec![bytes.len() / 4], bytes)?)))
            .collect::<Result<Vec<_>, safetensors::SafeTensorError>>()
            .map_err(|e| write_error(path, e))?;
        let metadata = HashMap::from([(KEY.to_owned(), text)]);
        let data = safetensors::serialize(views, Some(metadata)).map_err(|e| write_error(path, e))?;
        atomic_file::write(path, &data).map_err(|e| write_error(path, e))
    }

    /// Reads a checkpoint; `None` if there is no file.
    pub(super) fn load(path: &Path) -> Result<Option<Self>, TrainError> {
        let data = match read(path, LIMIT_BYTES) {
            Ok(data) => data,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
            Err(error) => return Err(unusable(path, error)),
        };
        let (_, header) = SafeTensors::read_metadata(&data).map_err(|e| unusable(path, e))?;
        let tensors = SafeTensors::deserialize(&data).map_err(|e| unusable(path, e))?;
        let text = header.metadata().as_ref().and_then(|metadata| metadata.get(KEY)).cloned();
        let Some(text) = text else { return Err(unusable(path, "it is no checkpoint of a training")) };
        let arrays: Vec<(&str, &[u8])> = tensors.iter().map(|(name, view)| (name, view.data())).collect();
        if array_hash::check(&text, arrays).map_err(|e| unusable(path, e))?.is_some() {
            return Err(unusable(path, "its numbers are not those that were written; the file was changed or damaged"));
        }
        if array_hash::check_text(&text).map_err(|e| unusable(path, e))?.is_some() {
            return Err(unusable(
                path,
                "its metadata are not those that were written; the file was changed or damaged",
            ));
        }
        let mut checkpoint: Checkpoint = serde_json::from_str(&text).map_err(|e| unusable(path, e))?;
        for name in tensors.names() {
            let mut parts = name.splitn(3, '/');
            let state = match parts.next() {
                Some("leader") => &mut checkpoint.leader,
                Some("trial") => &mut checkpoint.trial,
                _ => continue,
            };
            let by_name = match (parts.next(), state) {
                (Some("value"), Some(state)) => &mut state.values,
                (Some("moment"), Some(state)) => &mut state.moments,
                (Some("best"), Some(RunState { best: Some(best), .. })) => &mut best.values,
                _ => continue,
            };
            let Some(array) = parts.next() else { continue };
            let bytes = tensors.tensor(name).map_err(|e| unusable(path, e))?.data();
            let values = bytes.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
            by_name.insert(array.to_owned(), values);
        }
        Ok(Some(checkpoint))
    }
}

fn write_error(path: &Path, reason: impl std::fmt::Display) -> TrainError {
    TrainError::CheckpointWrite { path: path.to_owned(), reason: reason.to_string() }
}

fn unusable(path: &Path, reason: impl std::fmt::Display) -> TrainError {
    TrainError::Checkpoint { what: format!("{}: {reason}", path.display()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_training_at_a_time_locks_a_checkpoint() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("half.checkpoint");
        let lock = CheckpointLock::new(&path).expect("free");
        assert!(matches!(CheckpointLock::new(&path), Err(DatasetError::Busy { .. })));
        drop(lock);
        assert!(!folder.path().join("half.checkpoint.lock").exists());
        CheckpointLock::new(&path).expect("free");
    }
}
