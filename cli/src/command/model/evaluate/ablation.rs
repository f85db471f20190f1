//! Recalls with parts of the maps replaced by noise. They show which parts a model uses.

use anyhow::{Context, bail};
use radome_driver::recording::Recording;
use radome_dsp::{Frame, FrameSource, Occupancy};
use radome_models::ablation::{Ablation, AblationScores, ablate};
use radome_models::dataset::Dataset;
use radome_models::evaluate::Confusion;
use radome_models::{Classifier, Metrics};
use serde::Serialize;

use super::labelled::LabelledRecording;
use crate::classifier::{CFAR, Model, Prediction};
use crate::output::{self, or_dash};
use crate::source;

/// Scores of single maps with one part replaced.
#[derive(Serialize)]
pub struct Row {
    /// Name of the ablation: the cells that noise replaced, or the change of the echoes.
    replaced: String,
    /// Recall of empty, one and two; absent for a class without maps.
    recall: [Option<f64>; Occupancy::ALL.len()],
    balanced_accuracy: f64,
    /// Counts `[truth][label]`.
    confusion: Confusion,
}

/// Scores a network on the single labelled frames of recordings, with people up to a range or in the whole room.
///
/// # Errors
/// A recording cannot be read, or the model does not take its waveform.
pub fn ablate_recordings(
    model: &mut Model,
    recordings: &[&LabelledRecording],
    max_range_m: Option<f64>,
) -> anyhow::Result<Vec<Row>> {
    let Model::Network(classifier) = &*model else { bail!("{CFAR} has no maps of which parts can be replaced") };
    let mut scores = AblationScores::new(classifier.card());
    let bar = output::progress(recordings.len() as u64, "ablation");
    for recording in recordings {
        let path = &recording.path;
        let mut source = Recording::open(path)?;
        let mut frame = Frame::zeroed(source.waveform().shape());
        let mut frame_classifier =
            model.for_waveform(source.waveform(), max_range_m).with_context(|| path.display().to_string())?;
        while source::next_frame_noting_gaps(&mut source, &mut frame, || frame_classifier.reset_at_gap())? {
            let prediction = frame_classifier.classify(&frame)?;
            let label = recording.truth(&frame, source.waveform());
            if let (Prediction::Probabilities(_), Some(label)) = (prediction, label) {
                let map = frame_classifier.map().clone();
                if let Some(network) = frame_classifier.network() {
                    scores.add(&map, label, |map| network.classify(map))?;
                }
            }
        }
        bar.inc(1);
    }
    bar.finish_and_clear();
    Ok(rows(&scores))
}

/// Scores a network on the maps of a dataset.
///
/// # Errors
/// A map cannot be read, or the network fails.
pub fn ablate_dataset(classifier: &mut Classifier, dataset: &Dataset, indices: &[usize]) -> anyhow::Result<Vec<Row>> {
    Ok(rows(&ablate(classifier, dataset, indices)?))
}

fn rows(scores: &AblationScores) -> Vec<Row> {
    let row = |(ablation, metrics): (Ablation, Metrics)| Row {
        replaced: ablation.to_string(),
        recall: metrics.recall,
        balanced_accuracy: metrics.balanced_accuracy,
        confusion: metrics.confusion,
    };
    scores.metrics().into_iter().map(row).collect()
}

/// Prints a table; prints nothing if there are no rows.
///
/// # Errors
/// Standard output cannot be written.
pub fn print(rows: &[Row]) -> anyhow::Result<()> {
    if rows.is_empty() {
        return Ok(());
    }
    let [empty, one, two] = Occupancy::ALL.map(Occupancy::name);
    output::text_line(&format!(
        "{:<38} {empty:>6} {one:>6} {two:>6} {:>9}",
        "replaced by noise, single maps", "balanced"
    ))?;
    for row in rows {
        let [empty, one, two] = row.recall.map(|recall| or_dash(recall, 2));
        let (replaced, balanced) = (&row.replaced, row.balanced_accuracy);
        output::text_line(&format!("{replaced:<38} {empty:>6} {one:>6} {two:>6} {balanced:>9.3}"))?;
    }
    Ok(())
}
