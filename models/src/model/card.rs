//! Model card: everything about a model but its numbers.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use radome_dsp::{Occupancy, RdmSpec, Waveform};
use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::adapted::Adapted;
use super::onnx_runtime::OnnxError;
use crate::array_hash::{self, Damaged};
use crate::dataset::{Dataset, SplitSpec, sequence_hash};
use crate::evidence_mean::{MEMORY_RANGE, is_valid_memory};
use crate::kernel::KernelLevel;
use crate::metrics::Metrics;
use crate::network::{Head, MOST_POOLED, NetworkKind, NetworkSpec, Normalisation, PAPER_POOLED};
use crate::occupancy_filter::Smoothing;
use crate::quantum::CircuitError;
use crate::standardise::{SceneClassConstants, Standardisation};

/// Version of the format that is written; older ones are read.
pub const MODEL_FORMAT_VERSION: u32 = 1;
/// Key of the card in a file's metadata, safetensors or ONNX.
pub(crate) const CARD_KEY: &str = "radome";

/// Summary of a model's training.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TrainingSummary {
    /// Epochs trained.
    pub epochs: usize,
    /// Epoch of these parameters, from 1: the best on the validation split.
    pub best_epoch: usize,
    /// Maps trained on.
    pub training_maps: usize,
    /// Sequences of the maps that the model was trained or chosen on or adapted to, by the first 16 hex digits of the SHA-256 of their
    /// names; empty in old models.
    #[serde(default, skip_serializing_if = "BTreeSet::is_empty")]
    pub seen_sequences: BTreeSet<String>,
    /// SHA-256 of the file of initial weights; absent if they were random.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub weights_hash: Option<String>,
    /// Index of the initialisation that was chosen.
    pub chosen_start: u64,
    /// Instruction set of the inner loops in training.
    pub kernel_level: KernelLevel,
    /// Scores on the validation split.
    pub validation: Metrics,
    /// Scores on the test split, if there is one.
    pub test: Option<Metrics>,
}

/// Everything about a model but its numbers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ModelCard {
    /// [`MODEL_FORMAT_VERSION`] of the writer.
    pub format_version: u32,
    /// Kind of the network.
    pub network: NetworkKind,
    /// Layers behind the latent of the HQNN or of descriptors.
    #[serde(default, skip_serializing_if = "crate::is_default")]
    pub head: Head,
    /// Classes in the order of the probabilities.
    pub classes: Vec<Occupancy>,
    /// Shape of the input, `axes` long.
    pub input_shape: [usize; 3],
    /// Names of the axes of the input, slowest first.
    pub axes: [String; 3],
    /// Waveform that maps must come from. With physical axes in `rdm_spec`, it is the waveform that a board is
    /// programmed with, and maps may come from any waveform within the limits of
    /// [`PhysicalAxes`](radome_dsp::rdm::PhysicalAxes).
    pub waveform: Waveform,
    /// Settings by which maps must be made.
    pub rdm_spec: RdmSpec,
    /// Standardisation of the input.
    pub standardisation: Standardisation,
    /// Rows and columns that the network's second block is averaged to.
    #[serde(default = "paper_pooled", skip_serializing_if = "is_paper_pooled")]
    pub pooled: [usize; 2],
    /// Time over which the evidence of frames is averaged, s ([`EvidenceMean`](crate::evidence_mean::EvidenceMean)): an answer of the
    /// model is of the last frames. 0, and absent, if each frame is judged by itself.
    #[serde(default, skip_serializing_if = "crate::is_default")]
    pub memory_s: f64,
    /// Settings of the filter over answers of the model.
    #[serde(default = "Smoothing::of_old_models")]
    pub smoothing: Smoothing,
    /// Standardisation of the latent; empty where there is none.
    pub latent: Normalisation,
    /// Logits are divided by this before the softmax, so that probabilities are calibrated on the validation split.
    pub temperature: f64,
    /// Hash of the dataset trained on.
    pub dataset_hash: String,
    /// Rule that divided that dataset into splits. Absent in old models, and where the dataset itself says the split of each map and the
    /// rule names no groups.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub split: Option<SplitSpec>,
    /// Seed of the training.
    pub seed: u64,
    /// Summary of the training.
    pub training: TrainingSummary,
    /// Data of the last adaptation after the training.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub adapted: Option<Adapted>,
}

/// Error of writing or reading a model file.
#[derive(Debug, Error)]
#[allow(missing_docs, reason = "the message says what each field is")]
pub enum ModelError {
    /// A file operation failed.
    #[error("{path}: {action} failed: {source}")]
    Io { path: PathBuf, action: &'static str, source: std::io::Error },
    /// The file is no complete safetensors file.
    #[error(
        "{path}: expected a safetensors file, but {reason} ({length} bytes); it is truncated, damaged or of another kind"
    )]
    NotSafetensors { path: PathBuf, reason: String, length: usize },
    /// The file is no complete ONNX file.
    #[error(
        "{path}: expected an ONNX file, but {reason} ({length} bytes); it is truncated, damaged or of another kind"
    )]
    NotOnnx { path: PathBuf, reason: String, length: usize },
    /// The safetensors or ONNX file has no card.
    #[error(
        "{path}: the metadata has no '{CARD_KEY}' entry, which says which maps the network needs and how they are \
         standardised\n\nhint: only models that `radome model train` and `radome model export` wrote can be loaded"
    )]
    NoCard { path: PathBuf },
    /// The card is no valid JSON of a card.
    #[error("{path}: model card: {source}")]
    Card { path: PathBuf, source: serde_json::Error },
    /// A newer program wrote the file.
    #[error("{path}: model format {found} is newer than {supported}, the newest this program reads\n\nhint: update it")]
    Newer { path: PathBuf, found: u32, supported: u32 },
    /// A value in the file contradicts another one or is out of range.
    #[error("{path}: {what}: expected {expected}, found {found}")]
    Inconsistent { path: PathBuf, what: String, expected: String, found: String },
    /// A setting of the circuit in the head is out of range.
    #[error("{path}: head.{error}")]
    Circuit { path: PathBuf, error: CircuitError },
    /// The numbers are not those that were written.
    #[error(
        "{path}: the numbers have SHA-256 {found}, the card says {expected}; the file was changed or damaged\n\nhint: copy it once more \
         from where it comes, or train or export it again"
    )]
    Hash { path: PathBuf, expected: String, found: String },
    /// The card is not the one that was written.
    #[error(
        "{path}: the model card has SHA-256 {found}, the file says {expected}; it was changed or damaged\n\nhint: copy the file once more \
         from where it comes, or train or export it again"
    )]
    CardHash { path: PathBuf, expected: String, found: String },
    /// An ONNX network cannot be run.
    #[error(transparent)]
    Onnx(#[from] OnnxError),
    /// A tensor operation failed.
    #[error("network: {0}")]
    Network(#[from] candle_core::Error),
}

impl ModelCard {
    /// Reads a card and checks that it makes sense; `path` is used in errors only.
    pub(crate) fn parse(path: &Path, text: &str) -> Result<Self, ModelError> {
        let json = |source| ModelError::Card { path: path.to_owned(), source };
        // Reads the version alone first: a newer card may have other fields.
        #[derive(Deserialize)]
        struct Version {
            format_version: u32,
        }
        let found = serde_json::from_str::<Version>(text).map_err(json)?.format_version;
        if found > MODEL_FORMAT_VERSION {
            return Err(ModelError::Newer { path: path.to_owned(), found, supported: MODEL_FORMAT_VERSION });
        }
        // Checked before the values, of which a damaged one may be out of range. Files of earlier versions have no hash.
        if let Some(Damaged { expected, found }) = array_hash::check_text(text).map_err(json)? {
            return Err(ModelError::CardHash { path: path.to_owned(), expected, found });
        }
        let card: ModelCard = serde_json::from_str(text).map_err(json)?;
        card.check(path)?;
        Ok(card)
    }

    /// Settings of the network.
    pub fn network_spec(&self) -> NetworkSpec {
        NetworkSpec { kind: self.network, pooled: self.pooled, head: self.head.clone() }
    }

    /// Rule that divided this dataset into splits in the model's training; `None` if the model was trained on another dataset, or
    /// its file does not say.
    pub fn split_of(&self, dataset: &Dataset) -> Option<&SplitSpec> {
        self.split.as_ref().filter(|_| self.dataset_hash == dataset.hash())
    }

    /// Rule that divides a dataset for this model: that of the model's training, and for another dataset the same rule without a
    /// held-out sequence. It is the default rule if the model's file does not name a rule by which the model was trained.
    pub fn split_rule(&self, dataset: &Dataset) -> SplitSpec {
        match self.split_of(dataset) {
            Some(known) => known.clone(),
            None => SplitSpec { held_out: None, ..self.split.clone().unwrap_or_default() },
        }
    }

    /// Returns whether the card lists a sequence of this name: the model was trained or chosen on it, or adapted to it. Cards of older
    /// models list nothing.
    pub fn has_seen(&self, name: &str) -> bool {
        self.training.seen_sequences.contains(&sequence_hash(name))
    }

    /// Sequences of a dataset that the model was trained, chosen or adapted on, found by their names with or without folders. `None`
    /// if the model's file does not list its sequences.
    pub fn seen_in<'a>(&self, dataset: &'a Dataset) -> Option<BTreeSet<&'a str>> {
        let seen = &self.training.seen_sequences;
        let sequences: BTreeSet<&str> = dataset.rows().iter().map(|row| row.sequence.as_str()).collect();
        // A recording that the model was adapted to has no folder in its name.
        let hash_without_folders = |name: &str| sequence_hash(name.rsplit('/').next().unwrap_or(name));
        let is_seen = |name: &&str| seen.contains(&sequence_hash(name)) || seen.contains(&hash_without_folders(name));
        (!seen.is_empty()).then(|| sequences.into_iter().filter(is_seen).collect())
    }

    /// Returns whether the network sees range and Doppler exchanged.
    pub fn is_transposed(&self) -> bool {
        self.axes == input_axes(true)
    }

    /// Shape `[channel, range, Doppler]` of a map of the network's input, also where the network sees them exchanged.
    pub fn map_shape(&self) -> [usize; 3] {
        let [channels, rows, columns] = self.input_shape;
        if self.is_transposed() { [channels, columns, rows] } else { self.input_shape }
    }

    fn check(&self, path: &Path) -> Result<(), ModelError> {
        let check = |is_valid: bool, what: &str, expected: String, found: String| match is_valid {
            true => Ok(()),
            false => Err(ModelError::Inconsistent { path: path.to_owned(), what: what.to_owned(), expected, found }),
        };
        let is_complete = self.classes == Occupancy::ALL;
        check(is_complete, "classes", format!("{:?}", Occupancy::ALL), format!("{:?}", self.classes))?;
        let has_known_axes = self.axes == input_axes(false) || self.axes == input_axes(true);
        check(has_known_axes, "axes", format!("{:?}", input_axes(false)), format!("{:?}", self.axes))?;
        let found = format!("{:?}", self.input_shape);
        match self.rdm_spec.shape(&self.waveform) {
            Ok(shape) => {
                let map_shape = input_shape(shape.range, shape.doppler, self.is_transposed());
                let is_map_shape = shape.rx == 1 && self.input_shape == map_shape;
                check(is_map_shape, "input_shape", format!("that of a map of {shape}"), found.clone())?;
            }
            Err(error) => check(false, "rdm_spec", "one that fits the waveform".to_owned(), error.to_string())?,
        }
        // Checked before the layout of the network, whose sizes are products of these numbers.
        let is_pooled = self.pooled.iter().all(|n| (1..=MOST_POOLED).contains(n));
        let expected = format!("1 to {MOST_POOLED} rows and columns");
        check(is_pooled, "pooled", expected, format!("{:?}", self.pooled))?;
        if let Head::Circuit { circuit, .. } = &self.head
            && let Err(error) = circuit.check()
        {
            return Err(ModelError::Circuit { path: path.to_owned(), error });
        }
        let [_, rows, columns] = self.input_shape;
        if let Some(layer) = self.network_spec().too_small_for(rows, columns) {
            return check(false, "input_shape", format!("a map that is large enough for layer {layer}"), found);
        }
        let Normalisation { mean, sigma } = &self.latent;
        let width = if self.network.has_latent() { self.head.width() } else { 0 };
        let fits_latent = mean.len() == sigma.len() && (mean.is_empty() || mean.len() == width);
        let found = format!("{} means and {} sigmas", mean.len(), sigma.len());
        check(fits_latent, "latent", format!("{width} constants or none"), found)?;
        check(is_valid_memory(self.memory_s), "memory_s", MEMORY_RANGE.to_owned(), self.memory_s.to_string())?;
        if let Some((name, value, expected)) = self.smoothing.invalid_setting() {
            return check(false, name, expected.to_owned(), value.to_string());
        }
        let Standardisation { reference, mean_db, sigma_db, ref label_leaking_cells } = self.standardisation;
        if let Some((name, value, expected)) = reference.invalid_setting() {
            return check(false, name, expected.to_owned(), value.to_string());
        }
        let range = if self.is_transposed() { columns } else { rows };
        let skipped = reference.skipped_range_bins().unwrap_or(0);
        let expected = format!("fewer than the {range} range bins of a map");
        check(skipped < range, "reference.over_noise.skip_range_bins", expected, skipped.to_string())?;
        let readable = self.network.check_maps(reference, self.is_transposed(), self.standardisation.needs_labels());
        if let Err(error) = readable {
            let expected = "dB over noise, range by velocity".to_owned();
            return check(false, "standardisation", expected, error.found.to_owned());
        }
        let is_in_db = !self.network.reads_descriptors() || (mean_db == 0.0 && sigma_db == 1.0);
        let expected = "mean 0 dB, sigma 1 dB: descriptors are of levels in dB".to_owned();
        check(is_in_db, "standardisation", expected, format!("mean {mean_db} dB, sigma {sigma_db} dB"))?;
        let is_above_zero = |value: f64| value.is_finite() && value > 0.0;
        let above_zero = || "a finite number above 0".to_owned();
        check(is_above_zero(self.temperature), "temperature", above_zero(), self.temperature.to_string())?;
        check(mean_db.is_finite(), "standardisation.mean_db", "a finite number".to_owned(), mean_db.to_string())?;
        check(is_above_zero(sigma_db), "standardisation.sigma_db", above_zero(), sigma_db.to_string())?;
        for SceneClassConstants { scene, class, mean_db, sigma_db } in label_leaking_cells {
            let what = format!("standardisation of scene {scene} with class {class}");
            let found = format!("mean {mean_db} dB, sigma {sigma_db} dB");
            let is_valid = mean_db.is_finite() && is_above_zero(*sigma_db);
            check(is_valid, &what, "a finite mean, and a finite sigma above 0".to_owned(), found)?;
        }
        for (mean, sigma) in mean.iter().zip(sigma) {
            let is_valid = mean.is_finite() && is_above_zero(f64::from(*sigma));
            let found = format!("mean {mean}, sigma {sigma}");
            check(is_valid, "latent", "a finite mean, and a finite sigma above 0".to_owned(), found)?;
        }
        Ok(())
    }
}

fn paper_pooled() -> [usize; 2] {
    PAPER_POOLED
}

fn is_paper_pooled(pooled: &[usize; 2]) -> bool {
    *pooled == PAPER_POOLED
}

/// Names of the axes of a network's input.
pub(crate) fn input_axes(transposed: bool) -> [String; 3] {
    let axes = if transposed { ["channel", "doppler", "range"] } else { ["channel", "range", "doppler"] };
    axes.map(str::to_owned)
}

/// Shape of a network's input.
pub(crate) fn input_shape(range: usize, doppler: usize, transposed: bool) -> [usize; 3] {
    if transposed { [1, doppler, range] } else { [1, range, doppler] }
}
