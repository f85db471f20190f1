//! Features of the frames that a model is adapted to.

use radome_dsp::{Frame, FrameSource, Occupancy};
use radome_models::train::{AdaptFrame, AdaptRecording, Adapter};

use crate::classifier::{Model, Prediction};
use crate::source;

/// Computes the features of recordings with one model.
pub struct FeatureReader<'a> {
    model: Model,
    adapter: &'a Adapter,
    /// Greatest range at which people count, m.
    max_range_m: Option<f64>,
}

impl<'a> FeatureReader<'a> {
    pub fn new(model: Model, adapter: &'a Adapter, max_range_m: Option<f64>) -> Self {
        FeatureReader { model, adapter, max_range_m }
    }

    /// Reads features of all frames of a source, and their labels by `truth`.
    ///
    /// # Errors
    /// The source cannot be read, or the model does not take its waveform.
    pub fn read(
        &mut self,
        source: &mut dyn FrameSource,
        truth: impl Fn(&Frame) -> Option<Occupancy>,
    ) -> anyhow::Result<AdaptRecording> {
        let mut classifier = self.model.for_waveform(source.waveform(), self.max_range_m)?;
        let mut frame = Frame::zeroed(source.waveform().shape());
        let mut frames = Vec::new();
        while source::next_frame_noting_gaps(source, &mut frame, || classifier.reset_at_gap())? {
            if let Prediction::Probabilities(_) = classifier.classify(&frame)? {
                let features = self.adapter.features(classifier.map())?;
                frames.push(AdaptFrame { time_s: frame.time_s(), features, label: truth(&frame) });
            }
        }
        Ok(AdaptRecording { frame_interval_s: source.waveform().frame_interval_s(), frames })
    }
}
