//! Features of the frames that a model is adapted to.

use anyhow::Context;
use radome_dsp::{Frame, Occupancy, SourceEvent, Waveform};
use radome_models::train::{AdaptFrame, AdaptRecording, Adapter};

use crate::classifier::{Model, Prediction};

/// Computes the features of recordings with one model.
pub struct FeatureReader<'a> {
    /// Model, which is absent while in use and after an error.
    model: Option<Model>,
    adapter: &'a Adapter,
    /// Greatest range at which people count, m.
    max_range_m: Option<f64>,
}

impl<'a> FeatureReader<'a> {
    pub fn new(model: Model, adapter: &'a Adapter, max_range_m: Option<f64>) -> Self {
        FeatureReader { model: Some(model), adapter, max_range_m }
    }

    /// Reads features and labels of the frames that `next` returns one after another.
    ///
    /// # Errors
    /// `next` fails, the model does not take the waveform, or an earlier call has failed.
    pub fn read(
        &mut self,
        waveform: &Waveform,
        mut next: impl FnMut(&mut Frame) -> anyhow::Result<SourceEvent>,
        truth: impl Fn(&Frame) -> Option<Occupancy>,
    ) -> anyhow::Result<AdaptRecording> {
        let mut classifier =
            self.model.take().context("an earlier recording has failed")?.for_waveform(waveform, self.max_range_m)?;
        let mut frame = Frame::zeroed(waveform.shape());
        let mut frames = Vec::new();
        loop {
            match next(&mut frame)? {
                SourceEvent::End => break,
                SourceEvent::Gap(_) => classifier.reset(),
                SourceEvent::Frame => {
                    if let Prediction::Probabilities(_) = classifier.classify(&frame)? {
                        let features = self.adapter.features(classifier.map())?;
                        frames.push(AdaptFrame { time_s: frame.time_s(), features, label: truth(&frame) });
                    }
                }
            }
        }
        self.model = Some(classifier.into_model());
        Ok(AdaptRecording { frame_interval_s: waveform.frame_interval_s(), frames })
    }
}
