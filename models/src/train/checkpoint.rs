//! Checkpoints: the state of a training after each epoch, so that a stopped training ends with the same weights as one that was
//! not.

use std::collections::{BTreeMap, HashMap};
use std::path::Path;

use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde::{Deserialize, Serialize};

use super::error::TrainError;
use super::outcome::EpochReport;
use crate::bounded_file::read;
use crate::network::Normalisation;
use crate::whole_file;

/// Largest checkpoint that is read: two starts with moments and best weights, seven times the largest model.
const LIMIT_BYTES: u64 = 4 << 30;
/// Key in the metadata of the numbers that are no arrays.
const KEY: &str = "radome-training";

/// State after the best epoch so far.
#[derive(Debug, Clone)]
pub(super) struct Best {
    pub balanced_accuracy: f64,
    pub loss: f64,
    pub epoch: usize,
    pub values: BTreeMap<String, Vec<f32>>,
    pub latent: Normalisation,
}

/// State of one initialisation between two epochs.
pub(super) struct RunState {
    pub start: u64,
    pub epoch: usize,
    pub step: usize,
    pub warming_up: bool,
    pub head_step: usize,
    pub adam_steps: i32,
    pub latest_loss: f64,
    pub normalisations: BTreeMap<String, Normalisation>,
    /// Parameters and running statistics.
    pub values: BTreeMap<String, Vec<f32>>,
    /// Adam's.
    pub moments: BTreeMap<String, Vec<f32>>,
    pub best: Option<Best>,
}

/// State of a training between two epochs.
pub(super) struct Checkpoint {
    /// Text of everything that decides the outcome: spec, dataset, kernel level.
    pub fingerprint: String,
    pub history: Vec<EpochReport>,
    /// Best of the starts after their trial.
    pub leader: Option<RunState>,
    /// Start in its trial.
    pub trial: Option<RunState>,
    /// Index of the next start.
    pub next_start: u64,
}

#[derive(Serialize, Deserialize)]
struct Numbers {
    fingerprint: String,
    history: Vec<EpochReport>,
    next_start: u64,
    leader: Option<RunNumbers>,
    trial: Option<RunNumbers>,
}

#[derive(Serialize, Deserialize)]
struct RunNumbers {
    start: u64,
    epoch: usize,
    step: usize,
    warming_up: bool,
    head_step: usize,
    adam_steps: i32,
    /// `None` for infinity, which JSON lacks.
    latest_loss: Option<f64>,
    #[serde(rename = "centrings")]
    normalisations: BTreeMap<String, Normalisation>,
    best: Option<BestNumbers>,
}

#[derive(Serialize, Deserialize)]
struct BestNumbers {
    balanced_accuracy: f64,
    loss: f64,
    epoch: usize,
    latent: Normalisation,
}

impl Checkpoint {
    /// Writes under a temporary name and renames, so that a file of this name is whole.
    pub(super) fn save(&self, path: &Path) -> Result<(), TrainError> {
        let numbers = Numbers {
            fingerprint: self.fingerprint.clone(),
            history: self.history.clone(),
            next_start: self.next_start,
            leader: self.leader.as_ref().map(RunState::numbers),
            trial: self.trial.as_ref().map(RunState::numbers),
        };
        let text = serde_json::to_string(&numbers).map_err(|e| unusable(path, e))?;
        let mut arrays: Vec<(String, Vec<u8>)> = Vec::new();
        for (role, state) in [("leader", &self.leader), ("trial", &self.trial)] {
            let Some(state) = state else { continue };
            let best = state.best.iter().flat_map(|best| &best.values);
            for (kind, name, values) in state
                .values
                .iter()
                .map(|(name, values)| ("value", name, values))
                .chain(state.moments.iter().map(|(name, values)| ("moment", name, values)))
                .chain(best.map(|(name, values)| ("best", name, values)))
            {
                let bytes = values.iter().flat_map(|v| v.to_le_bytes()).collect();
                arrays.push((format!("{role}/{kind}/{name}"), bytes));
            }
        }
        let views = arrays
            .iter()
            .map(|(name, bytes)| Ok((name, TensorView::new(Dtype::F32, vec![bytes.len() / 4], bytes)?)))
            .collect::<Result<Vec<_>, safetensors::SafeTensorError>>()
            .map_err(|e| unusable(path, e))?;
        let metadata = HashMap::from([(KEY.to_owned(), text)]);
        let data = safetensors::serialize(views, Some(metadata)).map_err(|e| unusable(path, e))?;
        whole_file::write(path, &data).map_err(|e| unusable(path, e))
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
        let numbers: Numbers = serde_json::from_str(&text).map_err(|e| unusable(path, e))?;
        let mut arrays: HashMap<(&str, &str), BTreeMap<String, Vec<f32>>> = HashMap::new();
        let names = tensors.names();
        for name in &names {
            let mut parts = name.splitn(3, '/');
            if let (Some(role), Some(kind), Some(rest)) = (parts.next(), parts.next(), parts.next()) {
                let bytes = tensors.tensor(name).map_err(|e| unusable(path, e))?.data();
                let values = bytes.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
                arrays.entry((role, kind)).or_default().insert(rest.to_owned(), values);
            }
        }
        let mut state = |role: &'static str, numbers: Option<RunNumbers>| {
            let mut take = |kind: &'static str| arrays.remove(&(role, kind)).unwrap_or_default();
            let numbers = numbers?;
            let best = numbers.best.map(|best| Best {
                balanced_accuracy: best.balanced_accuracy,
                loss: best.loss,
                epoch: best.epoch,
                latent: best.latent,
                values: take("best"),
            });
            Some(RunState {
                start: numbers.start,
                epoch: numbers.epoch,
                step: numbers.step,
                warming_up: numbers.warming_up,
                head_step: numbers.head_step,
                adam_steps: numbers.adam_steps,
                latest_loss: numbers.latest_loss.unwrap_or(f64::INFINITY),
                normalisations: numbers.normalisations,
                values: take("value"),
                moments: take("moment"),
                best,
            })
        };
        Ok(Some(Checkpoint {
            leader: state("leader", numbers.leader),
            trial: state("trial", numbers.trial),
            fingerprint: numbers.fingerprint,
            history: numbers.history,
            next_start: numbers.next_start,
        }))
    }
}

impl RunState {
    fn numbers(&self) -> RunNumbers {
        RunNumbers {
            start: self.start,
            epoch: self.epoch,
            step: self.step,
            warming_up: self.warming_up,
            head_step: self.head_step,
            adam_steps: self.adam_steps,
            latest_loss: self.latest_loss.is_finite().then_some(self.latest_loss),
            normalisations: self.normalisations.clone(),
            best: self.best.as_ref().map(|best| BestNumbers {
                balanced_accuracy: best.balanced_accuracy,
                loss: best.loss,
                epoch: best.epoch,
                latent: best.latent.clone(),
            }),
        }
    }
}

fn unusable(path: &Path, reason: impl std::fmt::Display) -> TrainError {
    TrainError::Checkpoint { what: format!("{}: {reason}", path.display()) }
}
