//! Errors of a study.

use std::fmt::Display;
use std::path::PathBuf;

use thiserror::Error;

use crate::dataset::DatasetError;
use crate::model::{ClassifyError, ModelError};
use crate::quantum::CircuitError;
use crate::train::TrainError;

/// Error of a study.
#[derive(Debug, Error)]
#[allow(missing_docs, reason = "the message says what each field is")]
pub enum StudyError {
    /// A setting is out of range.
    #[error("study: {what} is {value}, expected {expected}")]
    Setting { what: String, value: String, expected: String },
    /// A setting of the circuit of a variant is out of range.
    #[error("study: variant {variant}: {error}")]
    Circuit { variant: String, error: CircuitError },
    /// A file of the study cannot be written or read.
    #[error("{path}: {reason}")]
    File { path: PathBuf, reason: String },
    /// Results of another study or dataset are in the folder.
    #[error("{path} holds results of another study or dataset\n\nhint: give this one a folder of its own")]
    Foreign { path: PathBuf },
    /// The maps of a condition are of another kind than those that the networks are trained on.
    #[error(
        "condition '{condition}': {what}\n\nhint: build its dataset with the [map] of the study's, from like waveforms"
    )]
    Maps { condition: String, what: String },
    /// All maps of a condition are of sequences that a training saw.
    #[error(
        "condition '{condition}': all of its maps are of sequences that the networks are trained or chosen by\n\nhint: name a \
         dataset with other sequences, or with all of the study's"
    )]
    NothingUnseen { condition: String },
    /// The model of a training is not there, although the training is done.
    #[error("{path} is not there\n\nhint: remove {result} and the study trains it again")]
    NoModel { path: PathBuf, result: PathBuf },
    /// The result of a training is damaged or of another training.
    #[error("{path}: {reason}\n\nhint: remove it, and the study trains it again")]
    DamagedResult { path: PathBuf, reason: String },
    /// The model of a training is damaged.
    #[error("{source}\n\nhint: remove {result}, and the study trains it again")]
    DamagedModel { source: Box<ModelError>, result: PathBuf },
    /// A training cannot be run.
    #[error(transparent)]
    Train(#[from] TrainError),
    /// A model cannot be evaluated.
    #[error(transparent)]
    Classify(#[from] ClassifyError),
    /// A trained model cannot be written.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// The dataset cannot be read or split.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
}

/// Checks one setting of a study.
///
/// # Errors
/// [`StudyError::Setting`] with its value unless it `is_valid`.
pub(super) fn check_setting(
    is_valid: bool,
    what: impl Display,
    value: impl Display,
    expected: impl Display,
) -> Result<(), StudyError> {
    if is_valid {
        return Ok(());
    }
    Err(StudyError::Setting { what: what.to_string(), value: value.to_string(), expected: expected.to_string() })
}
