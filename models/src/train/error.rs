//! Errors of a training.

use std::fmt::Display;
use std::path::PathBuf;

use radome_dsp::Occupancy;
use thiserror::Error;

use crate::dataset::{DatasetError, Split};
use crate::model::{ClassifyError, ModelError};
use crate::network::{MissingLayer, NetworkKind, UnreadableMaps, WeightsError};
use crate::quantum::CircuitError;
use crate::standardise::StandardiseError;

/// Error of a training.
#[derive(Debug, Error)]
#[allow(missing_docs, reason = "the message says what each field is")]
pub enum TrainError {
    /// A setting, a field of [`TrainSpec`](super::TrainSpec), is out of range.
    #[error("training: {name} is {value}, expected {expected}")]
    Setting { name: &'static str, value: String, expected: &'static str },
    /// A setting of the circuit in the head is out of range.
    #[error("training: head.{error}")]
    Circuit { error: CircuitError },
    /// A setting of the [`Augmentation`](super::Augmentation) needs levels over noise, which maps of an absolute reference lack.
    #[error(
        "training: augmentation.{setting} changes levels over noise, which maps of an absolute reference do not have\n\nhint: add [reference.over_noise] with skip_range_bins = 3 to the training's settings, or take augmentation.{setting} out"
    )]
    NeedsOverNoise { setting: &'static str },
    /// A setting of the [`Augmentation`](super::Augmentation) changes how echoes move, which the motion of the maps does not follow.
    #[error(
        "training: augmentation.{setting} changes the echoes of maps, but not their motion over frames\n\nhint: take \
         augmentation.{setting} out, or build the dataset without motion_over_s in its map spec"
    )]
    UnfollowedMotion { setting: &'static str },
    /// Networks take one channel.
    #[error(
        "the dataset's maps have {rx} channels, a network takes one\n\nhint: build the dataset with channels = {{ one = 0 }} or \"incoherent_sum\" in its map spec"
    )]
    Channels { rx: usize },
    /// Maps are too small for the network's poolings.
    #[error("maps are {range} range x {doppler} doppler bins, too few for the network's layer {layer}")]
    TooSmall { layer: String, range: usize, doppler: usize },
    /// No range bin is left to learn from.
    #[error(
        "training: reference.over_noise.skip_range_bins is {skipped}, and the dataset's maps have {range} range bins\n\nhint: skip the few bins that show leakage, such as 3"
    )]
    AllSkipped { skipped: usize, range: usize },
    /// A required split is empty.
    #[error(
        "the {split} split is empty: {maps} maps in {sequences} sequences\n\nhint: splits are made of whole sequences; record more of them, or give rows a split"
    )]
    EmptySplit { split: Split, maps: usize, sequences: usize },
    /// The training split has maps of one class only.
    #[error("the training split holds maps of one class only ({class}); at least two are needed")]
    OneClass { class: Occupancy },
    /// The network cannot read such maps.
    #[error(transparent)]
    Maps(#[from] UnreadableMaps),
    /// The network lacks a layer that training looks for.
    #[error(transparent)]
    Layer(#[from] MissingLayer),
    /// Maps cannot be standardised.
    #[error(transparent)]
    Standardise(#[from] StandardiseError),
    /// A number became NaN or infinite. Starts count from 0 (from 1 in the message, as in the log), epochs and the steps of a start
    /// from 1.
    #[error(
        "{what} is not finite at start {}, epoch {epoch}, step {step}\n\nhint: the learning rate of {learning_rate} may be too high",
        start + 1
    )]
    NonFinite { what: String, start: u64, epoch: usize, step: usize, learning_rate: f64 },
    /// A training step does not fit into the memory of the machine, or of the process's control group where it has a limit.
    #[error(
        "a training of {network} with {batch_size} maps in a step takes {:.1} GB of memory or more, this process may use {:.1}\n\nhint: lower batch_size or most_training_maps in the training's settings",
        gigabytes(.needed_bytes), gigabytes(.available_bytes)
    )]
    Memory { network: NetworkKind, batch_size: usize, needed_bytes: u64, available_bytes: u64 },
    /// Initial weights do not fit.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// A checkpoint cannot be read.
    #[error(
        "checkpoint: {what}\n\nhint: name another file for the checkpoint; if this one is a checkpoint that was damaged, remove it to start again"
    )]
    Checkpoint { what: String },
    /// A checkpoint is of another training.
    #[error(
        "checkpoint: {path} is of a training with other settings, data or instructions\n\nhint: the command of that training goes on with it; name another file for this checkpoint, or remove that one to start again"
    )]
    OtherTraining { path: PathBuf },
    /// A checkpoint cannot be written.
    #[error("checkpoint: {path} cannot be written: {reason}")]
    CheckpointWrite { path: PathBuf, reason: String },
    /// The dataset cannot be read or split.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// The trained model cannot be applied.
    #[error(transparent)]
    Classify(#[from] ClassifyError),
    /// The model cannot be built.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// A tensor operation failed.
    #[error("network: {0}")]
    Network(#[from] candle_core::Error),
}

/// Checks one setting of a training.
///
/// # Errors
/// [`TrainError::Setting`] with its value unless it `is_valid`.
pub(super) fn check_setting(
    is_valid: bool,
    name: &'static str,
    value: impl Display,
    expected: &'static str,
) -> Result<(), TrainError> {
    if is_valid { Ok(()) } else { Err(TrainError::Setting { name, value: value.to_string(), expected }) }
}

fn gigabytes(bytes: &u64) -> f64 {
    *bytes as f64 * 1e-9
}
