//! Results of a training and of its epochs.

use serde::{Deserialize, Serialize};

use crate::metrics::Metrics;
use crate::model::Model;

/// What one pass over the training split came to.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EpochReport {
    /// Which initialisation, from 0.
    pub start: u64,
    /// Whether this start has been chosen to be carried on with.
    pub chosen: bool,
    /// Epoch, from 1.
    pub epoch: usize,
    /// Epochs in total.
    pub epochs: usize,
    /// Mean loss over the epoch's steps.
    pub training_loss: f64,
    /// Balanced accuracy over the epoch's batches as they were met.
    pub training_balanced_accuracy: f64,
    /// Loss on the validation split after the epoch.
    pub validation_loss: f64,
    /// Balanced accuracy on the validation split after the epoch.
    pub validation_balanced_accuracy: f64,
    /// Time of the epoch, s.
    pub seconds: f64,
}

/// What a training came to.
pub struct TrainOutcome {
    /// The model, ready to save or to put to work.
    pub model: Model,
    /// One report for each epoch, in order.
    pub history: Vec<EpochReport>,
    /// Scores of the model on the validation split.
    pub validation: Metrics,
    /// Scores on the test split, if there is one.
    pub test: Option<Metrics>,
    /// What the user should know: classes that are missing, and the like.
    pub warnings: Vec<String>,
}
