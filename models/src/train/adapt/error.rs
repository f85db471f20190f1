//! Errors of an adaptation.

use thiserror::Error;

use crate::dataset::DatasetError;
use crate::model::ClassifyError;
use crate::network::{MissingLayer, NetworkKind};

/// Error of an adaptation.
#[derive(Debug, Error)]
#[allow(missing_docs, reason = "the message says what each field is")]
pub enum AdaptError {
    /// The network has no layer to adapt.
    #[error("{network} does not end in a linear layer; only such networks can be adapted")]
    Network { network: NetworkKind },
    /// The network lacks a layer that adaptation looks for.
    #[error(transparent)]
    Layer(#[from] MissingLayer),
    /// No frame has a label.
    #[error(
        "none of the {recordings} recordings has a labelled frame\n\nhint: label them, or say what all of a recording shows: RECORDING=empty"
    )]
    NoLabels { recordings: usize },
    /// The simulated maps are made with other settings than the model's.
    #[error(
        "the simulated maps are not those of the model: {what}\n\nhint: build the dataset with the scene's waveform and the map spec that the model was trained with"
    )]
    Simulated { what: String },
    /// The objective is not finite at the start.
    #[error("the loss on the recordings is not finite")]
    NonFinite,
    /// A map cannot be classified.
    #[error(transparent)]
    Classify(#[from] ClassifyError),
    /// The simulated maps cannot be read.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// A tensor operation failed.
    #[error("network: {0}")]
    Operation(#[from] candle_core::Error),
}
