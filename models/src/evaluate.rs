//! Scores of a classifier over the maps of a dataset.

pub use crate::metrics::{
    Confusion, FalseAlarms, FoundTimes, FramePrediction, Metrics, RecordingScores, Stretch, add_confusion,
    most_probable,
};

use crate::dataset::Dataset;
use crate::model::{Classifier, ClassifyError};

/// Scores of a classifier over the maps `indices` of a dataset.
///
/// # Errors
/// [`ClassifyError::OtherMaps`] if the dataset's maps were made with other settings than the model's, and [`ClassifyError`] for
/// the first map that cannot be read or classified.
pub fn evaluate(classifier: &mut Classifier, dataset: &Dataset, indices: &[usize]) -> Result<Metrics, ClassifyError> {
    evaluate_changed(classifier, dataset, indices, |_, _| ())
}

/// Evaluates as [`evaluate`] does, after `change` has modified each map. Its arguments are the index and the cells of the map. The
/// motion of the maps stays.
pub(crate) fn evaluate_changed(
    classifier: &mut Classifier,
    dataset: &Dataset,
    indices: &[usize],
    change: impl Fn(usize, &mut [f32]),
) -> Result<Metrics, ClassifyError> {
    classifier.card().check_maps(&dataset.header().rdm_spec, &dataset.header().waveform)?;
    let mut pairs = Vec::with_capacity(indices.len());
    for &index in indices {
        let mut map = dataset.map(index)?;
        change(index, &mut map);
        let Some(row) = dataset.rows().get(index) else { continue };
        let probabilities = classifier.classify_row(&map, dataset.header().shape, row)?;
        pairs.push((row.label, most_probable(&probabilities)));
    }
    Ok(Metrics::from_predictions(pairs))
}
