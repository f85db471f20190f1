//! Entry of a model card on the adaptation of the model.

use serde::{Deserialize, Serialize};

use crate::metrics::CLASSES;

/// Balanced accuracies over recordings, frame by frame and behind the occupancy filter.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Scores {
    /// Balanced accuracy of single frames.
    pub by_frame: f64,
    /// Balanced accuracy behind the filter.
    pub filtered: f64,
}

/// Scores of the model before and after an adaptation that has not seen the recordings.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct BeforeAfter {
    /// Scores of the model before.
    pub before: Scores,
    /// Scores of the adapted model.
    pub after: Scores,
}

impl Scores {
    /// Sum of both scores, by which adaptations are compared.
    pub(crate) fn sum(self) -> f64 {
        self.by_frame + self.filtered
    }
}

impl BeforeAfter {
    /// Returns whether the adaptation lowers the mean of both scores.
    pub fn is_worse(&self) -> bool {
        self.after.sum() < self.before.sum() - 1e-9
    }
}

/// Entry of a model card: data of the last adaptation.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Adapted {
    /// Labelled seconds of empty, one and two.
    pub seconds: [f64; CLASSES],
    /// Number of recordings.
    pub recordings: usize,
    /// Strength of the quadratic penalty on the distance from the parameters before, s of labelled frames for a squared
    /// deviation.
    pub strength: f64,
    /// Number of simulated maps that were mixed in.
    pub simulated_maps: usize,
    /// Cross-validated scores: each recording, or each tenth of more than ten, is held out in turn. Absent if none could be held
    /// out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub held_out: Option<BeforeAfter>,
}
