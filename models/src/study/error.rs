//! Errors of a study.

use std::path::PathBuf;

use thiserror::Error;

use crate::dataset::DatasetError;
use crate::model::{ClassifyError, ModelError};
use crate::train::TrainError;

/// Error of a study.
#[derive(Debug, Error)]
pub enum StudyError {
    /// A setting is out of range.
    #[error("study: {what} is {value}, expected {expected}")]
    Setting {
        /// Name of the setting.
        what: String,
        /// Its value.
        value: String,
        /// Allowed values.
        expected: String,
    },
    /// A file of the study cannot be written or read.
    #[error("{path}: {reason}")]
    File {
        /// File or folder.
        path: PathBuf,
        /// Cause.
        reason: String,
    },
    /// Results of another study or dataset are in the folder.
    #[error("{path} holds results of another study or dataset\n\nhint: give this one a folder of its own")]
    Foreign {
        /// Folder.
        path: PathBuf,
    },
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
