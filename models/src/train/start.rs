//! Measuring a network on training maps, and rescaling its layers so that it starts where it can learn.

use candle_core::Tensor;

use super::TrainError;
use super::data::{Data, Part};
use crate::network::{FeatureScale, Hqnn, LatentConstants, Stages};

/// Training maps that the start is measured on.
pub(super) const START_MAPS: usize = 256;
/// Maps of a forward pass without gradients.
pub(super) const EVALUATION_BATCH: usize = 64;

/// A latent that does not vary is not blown up.
pub(super) const LEAST_LATENT_SIGMA: f32 = 1e-3;

pub(super) fn moments(rows: &[Vec<f32>]) -> LatentConstants {
    let n = rows.len().max(1) as f64;
    let column = |k: usize| rows.iter().filter_map(move |r| r.get(k)).map(|&v| f64::from(v));
    let mean: [f64; 2] = std::array::from_fn(|k| column(k).sum::<f64>() / n);
    let sigma = std::array::from_fn(|k| (column(k).map(|v| (v - mean[k]).powi(2)).sum::<f64>() / n).sqrt() as f32);
    LatentConstants { mean: mean.map(|v| v as f32), sigma: sigma.map(|s: f32| s.max(LEAST_LATENT_SIGMA)) }
}

/// One stage's rows for the maps at `positions`.
pub(super) fn collect(
    network: &Hqnn,
    data: &Data,
    part: &Part,
    positions: &[usize],
    stage: impl Fn(&Stages) -> &Tensor,
) -> Result<Vec<Vec<f32>>, TrainError> {
    let mut rows = Vec::with_capacity(positions.len());
    for batch in positions.chunks(EVALUATION_BATCH) {
        let stages = network.stages(&data.batch(part, batch)?)?;
        rows.extend(stage(&stages).to_vec2::<f32>()?);
    }
    Ok(rows)
}

/// Mean of each feature and one over its standard deviation. A feature that hardly varies (a dead unit, or one far off
/// every target) is not blown up: no deviation counts as less than a fifth of the root mean square of all.
pub(super) fn feature_scale(rows: &[Vec<f32>], sigma: f32) -> FeatureScale {
    let n = rows.len().max(1) as f64;
    let width = rows.first().map_or(0, Vec::len);
    let mut mean = vec![0.0f64; width];
    for row in rows {
        mean.iter_mut().zip(row).for_each(|(m, &v)| *m += f64::from(v) / n);
    }
    let mut variance = vec![0.0f64; width];
    for row in rows {
        for ((s, &v), m) in variance.iter_mut().zip(row).zip(&mean) {
            *s += (f64::from(v) - m).powi(2) / n;
        }
    }
    let typical = (variance.iter().sum::<f64>() / width.max(1) as f64).sqrt();
    let floor = (0.2 * typical).max(1e-6);
    FeatureScale {
        mean: mean.iter().map(|&m| m as f32).collect(),
        scale: variance.iter().map(|v| sigma / v.sqrt().max(floor) as f32).collect(),
    }
}

/// Rescales the first dense layer so that its outputs have a mean square of 1/2 after the ReLU, as those of unit variance
/// before it would.
pub(super) fn place_hidden(network: &Hqnn, hidden: &[Vec<f32>]) -> Result<(), TrainError> {
    let count = hidden.iter().map(Vec::len).sum::<usize>().max(1);
    let square = hidden.iter().flatten().map(|&v| f64::from(v) * f64::from(v)).sum::<f64>() / count as f64;
    let factor = (0.5 / square.max(1e-12)).sqrt() as f32;
    let mut values = network.values()?;
    if let [_, _, _, _, weight, ..] = values.as_mut_slice() {
        weight.iter_mut().for_each(|w| *w *= factor);
    }
    network.set_values(&values)?;
    Ok(())
}

/// Rescales the layer before the latent so that each component has mean 0 and standard deviation `sigma`.
pub(super) fn place_latent(network: &Hqnn, latent: &[Vec<f32>], sigma: f32) -> Result<(), TrainError> {
    let found = moments(latent);
    let mut values = network.values()?;
    if let [_, _, _, _, _, _, weight, bias, ..] = values.as_mut_slice() {
        let width = weight.len() / 2;
        for (k, (row, bias)) in weight.chunks_exact_mut(width).zip(bias).enumerate() {
            let factor = sigma / found.sigma[k];
            row.iter_mut().for_each(|w| *w *= factor);
            *bias = (*bias - found.mean[k]) * factor;
        }
    }
    network.set_values(&values)?;
    Ok(())
}
