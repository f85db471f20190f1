//! Gaussian noise on maps by the rule of the paper.

use rand_distr::{Distribution, StandardNormal};

use crate::dataset::Dataset;
use crate::metrics::{Metrics, most_probable};
use crate::model::{Classifier, ClassifyError};
use crate::random::stream;

/// Test maps with noise on them.
pub struct NoisyMaps<'a> {
    dataset: &'a Dataset,
    maps: Vec<(usize, Vec<f32>)>,
}

/// Adds noise to maps: `Y = X + W` with `W ~ N(0, P / 10^(SNR / 10))` for each cell, where `P` is the mean square of the map's dB
/// values before any standardisation. There is one draw for each map and ratio, the same for every model.
///
/// On maps in dB, `P` depends on the dB reference: ratios are comparable between maps of one preset only.
///
/// # Errors
/// [`ClassifyError::Dataset`] if a map cannot be read.
pub fn with_noise<'a>(dataset: &'a Dataset, indices: &[usize], snr_db: f64) -> Result<NoisyMaps<'a>, ClassifyError> {
    let mut maps = Vec::with_capacity(indices.len());
    for &index in indices {
        let mut map = dataset.map(index)?;
        let power = map.iter().map(|&v| f64::from(v) * f64::from(v)).sum::<f64>() / map.len().max(1) as f64;
        let sigma = (power / 10f64.powf(0.1 * snr_db)).sqrt();
        let mut rng = stream(snr_db.to_bits(), "noise on maps", index as u64);
        for value in &mut map {
            let draw: f64 = StandardNormal.sample(&mut rng);
            *value += (sigma * draw) as f32;
        }
        maps.push((index, map));
    }
    Ok(NoisyMaps { dataset, maps })
}

impl NoisyMaps<'_> {
    /// Computes the scores of a classifier.
    ///
    /// # Errors
    /// Those of [`Classifier::classify_row`].
    pub fn evaluate(&self, classifier: &mut Classifier) -> Result<Metrics, ClassifyError> {
        let shape = self.dataset.header().shape;
        let mut pairs = Vec::with_capacity(self.maps.len());
        for (index, map) in &self.maps {
            let Some(row) = self.dataset.rows().get(*index) else { continue };
            let probabilities = classifier.classify_row(map, shape, row)?;
            pairs.push((row.label, most_probable(&probabilities)));
        }
        Ok(Metrics::from_predictions(pairs))
    }
}
