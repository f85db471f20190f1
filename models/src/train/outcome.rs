//! Results of a training and of its epochs.

use serde::{Deserialize, Serialize};

use crate::metrics::Metrics;
use crate::model::Model;

/// Results of one pass over the training split.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EpochReport {
    /// Index of the initialisation, from 0.
    pub start: u64,
    /// Whether this initialisation was chosen.
    pub chosen: bool,
    /// Epoch, from 1.
    pub epoch: usize,
    /// Epochs in total.
    pub epochs: usize,
    /// Mean loss over the epoch's steps, weighted by class.
    pub training_loss: f64,
    /// Balanced accuracy over the epoch, measured batch by batch.
    pub training_balanced_accuracy: f64,
    /// Loss on the validation split after the epoch, with the classes' weights of the training split.
    pub validation_loss: f64,
    /// Balanced accuracy on the validation split after the epoch.
    pub validation_balanced_accuracy: f64,
    /// Time of the epoch, s.
    pub seconds: f64,
}

/// Times of the parts of a training.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct StepTimes {
    /// Time of fitting the head at the end of the warm-up, s.
    pub head_s: f64,
    /// Time of a step with the whole network, s.
    pub step_s: f64,
    /// Time of one map of the validation split, s.
    pub validation_map_s: f64,
}

/// Result of a training.
pub struct TrainOutcome {
    /// The trained model.
    pub model: Model,
    /// One report for each epoch, in order.
    pub history: Vec<EpochReport>,
    /// Scores of the model on the validation split.
    pub validation: Metrics,
    /// Scores on the test split, if there is one.
    pub test: Option<Metrics>,
    /// Warnings for the user, for example of missing classes.
    pub warnings: Vec<String>,
}
