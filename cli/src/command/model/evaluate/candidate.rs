//! Model under evaluation, and its predictions for the frames of a recording.

use std::path::{Path, PathBuf};

use radome_dsp::{Frame, Occupancy, Waveform};
use radome_models::calibration::ReliabilitySums;
use radome_models::evaluate::{FramePrediction, RecordingScores};
use radome_models::occupancy_filter::OccupancyFilter;
use radome_models::train::FilterSequence;
use serde::Serialize;

use crate::classifier::{FrameClassifier, Model, Prediction};
use crate::output;

/// Model that predicts one recording after another.
pub struct Candidate {
    path: PathBuf,
    /// Greatest range at which people count, m.
    max_range_m: Option<f64>,
    pub model: Model,
}

impl Candidate {
    /// Creates a candidate that counts people up to a range, or in the whole room.
    pub fn new(path: PathBuf, model: Model, max_range_m: Option<f64>) -> Self {
        Candidate { path, max_range_m, model }
    }

    /// Returns the path of the model as it was given.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Starts the model on the frames of a recording.
    ///
    /// # Errors
    /// The model refuses the waveform.
    pub fn start_run(&mut self, waveform: &Waveform) -> anyhow::Result<Run<'_>> {
        let frame_interval_s = waveform.frame_interval_s();
        let filter = OccupancyFilter::new(self.model.smoothing(), frame_interval_s);
        let classifier = self.model.for_waveform(waveform, self.max_range_m)?;
        Ok(Run {
            classifier,
            filter,
            predictions: Predictions {
                filtered: Vec::new(),
                single_frames: Vec::new(),
                unanswered: 0,
                frame_interval_s,
            },
        })
    }
}

/// Model running on a recording.
pub struct Run<'m> {
    classifier: FrameClassifier<'m>,
    filter: OccupancyFilter,
    /// Predictions for the frames so far.
    pub predictions: Predictions,
}

impl Run<'_> {
    /// Predicts the next frame, whose label is `truth`.
    ///
    /// # Errors
    /// The model cannot classify it.
    pub fn predict(&mut self, frame: &Frame, truth: Option<Occupancy>) -> anyhow::Result<()> {
        self.predict_changed(frame, frame, truth)
    }

    /// Predicts the next frame with other codes than it was `received` with ([`FrameClassifier::classify_changed`]).
    ///
    /// # Errors
    /// The model cannot classify it.
    pub fn predict_changed(
        &mut self,
        received: &Frame,
        changed: &Frame,
        truth: Option<Occupancy>,
    ) -> anyhow::Result<()> {
        match self.classifier.classify_changed(received, changed)? {
            Prediction::Probabilities(probabilities) => {
                let time_s = received.time_s();
                let filtered = self.filter.update(time_s, probabilities);
                self.predictions.filtered.push(FramePrediction { time_s, truth, probabilities: filtered });
                self.predictions.single_frames.push(FramePrediction { time_s, truth, probabilities });
            }
            Prediction::WarmingUp { .. } | Prediction::NoSignal => {
                self.predictions.unanswered += u64::from(truth.is_some());
            }
        }
        Ok(())
    }

    /// Notes that frames are missing before the next one.
    pub fn note_gap(&mut self) {
        self.classifier.reset_at_gap();
    }
}

/// Predictions for the frames of a recording, including those without a label.
pub struct Predictions {
    /// Predictions after the filter.
    pub filtered: Vec<FramePrediction>,
    /// Predictions for each single frame.
    pub single_frames: Vec<FramePrediction>,
    /// Number of labelled frames without a prediction: receivers gave no signal, or the window over frames was not full.
    pub unanswered: u64,
    frame_interval_s: f64,
}

impl Predictions {
    pub fn filtered_scores(&self) -> RecordingScores {
        RecordingScores::new(&self.filtered, self.frame_interval_s)
    }

    pub fn single_frame_scores(&self) -> RecordingScores {
        RecordingScores::new(&self.single_frames, self.frame_interval_s)
    }

    /// Returns the single-frame predictions, to which a filter is fitted.
    pub fn sequence(&self) -> FilterSequence {
        FilterSequence { frame_interval_s: self.frame_interval_s, frames: self.single_frames.clone() }
    }
}

/// Adds the reliability of the predictions' confidence to the sums.
pub fn add_reliability(predictions: &[FramePrediction], sums: &mut ReliabilitySums) {
    for prediction in predictions {
        if let Some(truth) = prediction.truth {
            sums.add(&prediction.probabilities, truth);
        }
    }
}

/// Recording that a model refused.
#[derive(Debug, Clone, Serialize)]
pub struct Refusal {
    pub recording: String,
    pub reason: String,
}

impl Refusal {
    /// Stores the reason of a refusal without its hint.
    pub fn new(recording: String, refusal: &anyhow::Error) -> Self {
        let reason = output::chain(refusal);
        let reason = reason.split_once("\n\nhint: ").map_or(reason.as_str(), |(reason, _)| reason).to_owned();
        Refusal { recording, reason }
    }
}
