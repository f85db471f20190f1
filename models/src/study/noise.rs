//! Gaussian noise on maps by the rule of the paper.

use rand_distr::{Distribution, StandardNormal};

use crate::random::stream;

/// Adds noise to the map `index` of a dataset: `Y = X + W` with `W ~ N(0, P / 10^(SNR / 10))` for each cell, where `P` is the mean
/// square of the map's dB values before any standardisation. There is one draw for each map and ratio, the same for every model.
///
/// On maps in dB, `P` depends on the dB reference: ratios are comparable between maps of one preset only.
pub(super) fn add_noise(map: &mut [f32], index: usize, snr_db: f64) {
    let power = map.iter().map(|&v| f64::from(v) * f64::from(v)).sum::<f64>() / map.len().max(1) as f64;
    let sigma = (power / 10f64.powf(0.1 * snr_db)).sqrt();
    let mut rng = stream(snr_db.to_bits(), "noise on maps", index as u64);
    for value in map {
        let draw: f64 = StandardNormal.sample(&mut rng);
        *value += (sigma * draw) as f32;
    }
}
