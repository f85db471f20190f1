//! Jobs of a study and their outcomes.

use serde::{Deserialize, Serialize};

use super::cost::Cost;
use crate::metrics::Metrics;
use crate::train::EpochReport;

/// Balanced accuracy on the training maps below which a training has failed: chance is a third.
pub const FAILED_BELOW: f64 = 0.45;

/// One training and its evaluation.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Job {
    /// Name of the variant.
    pub variant: String,
    /// Share of the training maps.
    pub label_fraction: f64,
    /// Learning rate.
    pub learning_rate: f64,
    /// Seed.
    pub seed: u64,
    /// Recording that is the test split together with the rest of its group, in studies that hold out each group in turn.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub held_out: Option<String>,
}

/// Outcome of a job.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Outcome {
    /// The job.
    pub job: Job,
    /// Error that ended the training early, if any.
    pub error: Option<String>,
    /// Balanced accuracy on the training maps in the last epoch, measured batch by batch.
    pub training: f64,
    /// Scores on the validation split.
    pub validation: Option<Metrics>,
    /// Scores on the test split.
    pub test: Option<Metrics>,
    /// Scores on the test split under noise, in the order of the spec.
    pub noisy: Vec<Noisy>,
    /// Epochs until the target was reached on the validation split.
    pub epochs_to_target: Option<usize>,
    /// Time until the target was reached on the validation split, s.
    pub seconds_to_target: Option<f64>,
    /// Epochs of the initialisation that was chosen; none if the training broke off.
    #[serde(default)]
    pub curve: Vec<EpochReport>,
    /// Time of the epochs, s.
    pub training_seconds: f64,
    /// Cost of the training to this process. It is lower than the whole cost if the training continued from a
    /// checkpoint.
    #[serde(default)]
    pub training_cost: Cost,
    /// Cost of one map through the classifier.
    #[serde(default)]
    pub label_cost: Cost,
    /// Median time of one map through the classifier, ms.
    pub latency_ms: f64,
    /// Number of trained parameters.
    pub parameters: usize,
    /// Multiply-adds of one map.
    pub multiply_adds: u64,
}

impl Outcome {
    /// Returns whether the training failed.
    pub fn failed(&self) -> bool {
        self.error.is_some() || self.training < FAILED_BELOW
    }
}

/// Scores under noise.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Noisy {
    /// Signal-to-noise ratio, dB.
    pub snr_db: f64,
    /// Scores.
    pub metrics: Metrics,
}
