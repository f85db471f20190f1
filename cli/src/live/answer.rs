//! Answers to frames, and the summary of a run.

use std::collections::BTreeMap;

use radome_dsp::Occupancy;
use radome_models::evaluate::Metrics;
use serde::Serialize;

/// Probabilities of the classes by name.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Probabilities {
    empty: f32,
    one: f32,
    two: f32,
}

impl std::fmt::Display for Probabilities {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{:5.3}   {:5.3}   {:5.3}", self.empty, self.one, self.two)
    }
}

impl Probabilities {
    /// Probabilities of empty, one and two.
    pub fn values(self) -> [f32; 3] {
        [self.empty, self.one, self.two]
    }
}

impl From<[f32; 3]> for Probabilities {
    fn from([empty, one, two]: [f32; 3]) -> Self {
        Probabilities { empty, one, two }
    }
}

/// Answer to one frame.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Answer {
    pub sequence: u64,
    /// Time since the acquisition started, s.
    pub time_s: f64,
    /// Most likely class; `None` while the window over frames fills, and where no receiver gives a signal.
    pub label: Option<Occupancy>,
    /// Probabilities of the filter over the frames so far.
    pub probabilities: Option<Probabilities>,
    /// Probabilities by the model without the filter.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub frame_probabilities: Option<Probabilities>,
    /// Whether the room counts as occupied, after delays that suppress flicker. A frame without a label keeps the value, until the
    /// last frame with a signal is too old.
    pub occupied: bool,
    /// Number of people in the room, after the same delays.
    pub people: usize,
    /// Whether `people` is due to labels, see [`super::occupancy::PeopleCount::is_settled`].
    #[serde(rename = "settled")]
    pub is_settled: bool,
    /// Whether the frame comes before the one that was sought in a recording, only to fill the model's window and the filter. Such
    /// an answer is neither counted nor passed on.
    #[serde(skip)]
    pub is_preroll: bool,
    /// `n/K` while a window over K frames fills.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub warming_up: Option<String>,
    /// Whether no receiver gives a signal in the frame. Such a frame has no label.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub no_signal: bool,
    /// True class, where it is known.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub truth: Option<Occupancy>,
    /// Whether someone is partly in the room.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub transition: Option<bool>,
    /// Number of codes at either end of the ADC range.
    #[serde(skip_serializing_if = "is_zero")]
    pub saturated_samples: u32,
    /// Time from the frame's last byte to its label, ms.
    pub latency_ms: f64,
}

fn is_zero<T: Default + PartialEq>(n: &T) -> bool {
    *n == T::default()
}

/// Quantiles of the latency, ms.
#[derive(Debug, Clone, Serialize)]
pub struct Latency {
    pub p50: f64,
    pub p95: f64,
    pub p99: f64,
}

#[derive(Debug, Clone, Serialize)]
pub struct Summary {
    /// Frames that arrived.
    pub frames: u64,
    /// Frames that were lost on the way.
    pub dropped: u64,
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub dropped_by_reason: BTreeMap<&'static str, u64>,
    /// Gaps of unknown length, whose frames are not counted.
    #[serde(skip_serializing_if = "is_zero")]
    pub gaps_of_unknown_length: u64,
    pub labelled: u64,
    pub labels: BTreeMap<&'static str, u64>,
    /// Mean recall over the classes that occurred, over all frames with truth.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub balanced_accuracy: Option<f64>,
    /// All metrics over all frames with truth.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub metrics: Option<Metrics>,
    /// Metrics over the frames in which nobody was entering or leaving.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub metrics_without_transitions: Option<Metrics>,
    /// Number of frames in which somebody was entering or leaving.
    pub transition_frames: u64,
    /// Metrics by the model without the filter: of each frame, and of those before it where the model has a memory.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub metrics_unfiltered: Option<Metrics>,
    /// Latency from the last byte to the label.
    pub latency_ms: Latency,
    /// Time from the start of the program to the first label, s.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub first_label_s: Option<f64>,
}
