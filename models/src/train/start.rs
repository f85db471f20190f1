//! Initialisation of a network from training maps: measures values and rescales layers.

use super::data::{Data, Part};
use super::error::TrainError;
use crate::network::{Mode, Network, Normalisation, Value, names};

/// Largest number of training maps that an initialisation is measured on.
pub(super) const START_MAPS: usize = 256;
/// Maps of a forward pass without gradients.
pub(super) const EVALUATION_BATCH: usize = 64;

/// Least deviation of the latent that it is divided by.
pub(super) const LEAST_LATENT_SIGMA: f32 = 1e-3;

/// Mean and standard deviation of each column.
pub(super) fn moments(rows: &[Vec<f32>]) -> Normalisation {
    let n = rows.len().max(1) as f64;
    let width = rows.first().map_or(0, Vec::len);
    let column = |k: usize| rows.iter().filter_map(move |r| r.get(k)).map(|&v| f64::from(v));
    let mean: Vec<f64> = (0..width).map(|k| column(k).sum::<f64>() / n).collect();
    let sigma = |(k, mean): (usize, &f64)| (column(k).map(|v| (v - mean).powi(2)).sum::<f64>() / n).sqrt() as f32;
    let sigma = mean.iter().enumerate().map(sigma).map(|s| s.max(LEAST_LATENT_SIGMA)).collect();
    Normalisation { mean: mean.iter().map(|&v| v as f32).collect(), sigma }
}

/// Rows of one of the network's values for the maps at `positions`.
pub(super) fn rows_of(
    network: &Network,
    data: &Data,
    part: &Part,
    positions: &[usize],
    value: Value,
) -> Result<Vec<Vec<f32>>, TrainError> {
    let mut rows = Vec::with_capacity(positions.len());
    for batch in positions.chunks(EVALUATION_BATCH) {
        let mut values = network.run(&data.batch(part, batch)?, value, Mode::Evaluation)?;
        rows.extend(values.take(value)?.to_vec2::<f32>()?);
    }
    Ok(rows)
}

/// Constants that give each feature mean 0 and standard deviation `sigma`. The least deviation is a fifth of the root mean square
/// of all, so that a feature that hardly varies (such as a dead unit) is not amplified.
pub(super) fn feature_normalisation(rows: &[Vec<f32>], sigma: f32) -> Normalisation {
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
    Normalisation {
        mean: mean.iter().map(|&m| m as f32).collect(),
        sigma: variance.iter().map(|v| v.sqrt().max(floor) as f32 / sigma).collect(),
    }
}

/// Least deviation of a descriptor, dB, bins or natural logarithms. It keeps descriptors that hardly vary on the training maps from
/// being amplified on others.
const LEAST_DESCRIPTOR_SIGMA: f32 = 0.1;

/// Constants that give each descriptor mean 0 and standard deviation 1, each in its own unit.
pub(super) fn descriptor_normalisation(rows: &[Vec<f32>]) -> Normalisation {
    let Normalisation { mean, sigma } = moments(rows);
    Normalisation { mean, sigma: sigma.into_iter().map(|sigma| sigma.max(LEAST_DESCRIPTOR_SIGMA)).collect() }
}

/// Rescales the dense layer before the hidden one so that the hidden values have a mean square of 1/2. The ReLU of a
/// value of unit variance has this mean square.
pub(super) fn scale_hidden(network: &Network, hidden: &[Vec<f32>]) -> Result<(), TrainError> {
    let count = hidden.iter().map(Vec::len).sum::<usize>().max(1);
    let square = hidden.iter().flatten().map(|&v| f64::from(v) * f64::from(v)).sum::<f64>() / count as f64;
    let factor = (0.5 / square.max(1e-12)).sqrt() as f32;
    let name = format!("{}.weight", names::HIDDEN_DENSE);
    let mut weight = network.parameters().numbers(&name)?;
    weight.iter_mut().for_each(|w| *w *= factor);
    network.parameters().set_numbers(&name, &weight)?;
    Ok(())
}

/// Names of weight `[component][input]` and bias of the dense layer before the latent.
pub(super) fn latent_arrays() -> [String; 2] {
    ["weight", "bias"].map(|what| format!("{}.{what}", names::LATENT_DENSE))
}

/// Rescales the layer before the latent so that each component has mean 0 and standard deviation `sigma`.
pub(super) fn scale_latent(network: &Network, latent: &[Vec<f32>], sigma: f32) -> Result<(), TrainError> {
    let measured = moments(latent);
    let [weight_name, bias_name] = latent_arrays();
    let mut weight = network.parameters().numbers(&weight_name)?;
    let mut bias = network.parameters().numbers(&bias_name)?;
    let width = (weight.len() / bias.len().max(1)).max(1);
    let columns = measured.mean.iter().zip(&measured.sigma);
    for ((row, bias), (mean, measured_sigma)) in weight.chunks_exact_mut(width).zip(&mut bias).zip(columns) {
        let factor = sigma / measured_sigma;
        row.iter_mut().for_each(|w| *w *= factor);
        *bias = (*bias - mean) * factor;
    }
    network.parameters().set_numbers(&weight_name, &weight)?;
    network.parameters().set_numbers(&bias_name, &bias)?;
    Ok(())
}
