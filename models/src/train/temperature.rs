//! Calibration of probabilities by one temperature (Guo et al., ICML 2017, section 4.2).

use super::data::Data;
use super::error::TrainError;
use crate::layer::softmax;
use crate::network::Network;

/// Range of temperatures.
const RANGE: (f64, f64) = (0.05, 20.0);
/// Lower bound of probabilities in the loss, which limits the weight of a single confident mistake.
const LEAST_PROBABILITY: f64 = 1e-12;

/// Fits the temperature with the least class-weighted cross-entropy on the validation split, by golden-section search on its
/// logarithm (the loss is convex in 1/T).
pub(super) fn fit(network: &Network, data: &Data) -> Result<f64, TrainError> {
    let part = &data.validation;
    let positions: Vec<usize> = (0..part.maps.len()).collect();
    let mut logits = Vec::new();
    for batch in positions.chunks(64) {
        logits.extend(network.logits(&data.batch(part, batch)?)?.to_vec2::<f32>()?);
    }
    Ok(minimise(&logits, &part.labels, &data.class_weights))
}

fn minimise(logits: &[Vec<f32>], labels: &[usize], class_weights: &[f32]) -> f64 {
    // Classes that were not trained on have weight 0: with only such maps, the loss is 0 at every temperature.
    if labels.iter().all(|&label| class_weights.get(label).is_none_or(|weight| *weight <= 0.0)) {
        return 1.0;
    }
    let loss = |log_temperature: f64| -> f64 {
        let temperature = log_temperature.exp();
        let terms = logits.iter().zip(labels).map(|(row, &label)| {
            let p = softmax(row, temperature).get(label).copied().unwrap_or(0.0).max(LEAST_PROBABILITY);
            -class_weights.get(label).copied().map_or(0.0, f64::from) * p.ln()
        });
        terms.sum()
    };
    let golden = 0.5 * (5f64.sqrt() - 1.0);
    let (mut low, mut high) = (RANGE.0.ln(), RANGE.1.ln());
    for _ in 0..60 {
        let (a, b) = (high - golden * (high - low), low + golden * (high - low));
        if loss(a) <= loss(b) { high = b } else { low = a }
    }
    (0.5 * (low + high)).exp()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::stream;
    use rand::Rng;

    /// Labels drawn from softmax(z / 2.5) are explained best by a temperature of 2.5.
    #[test]
    fn the_true_temperature_is_found() {
        let mut rng = stream(9, "temperature", 0);
        let logits: Vec<Vec<f32>> =
            (0..20_000).map(|_| (0..3).map(|_| rng.random_range(-5.0..5.0)).collect()).collect();
        let labels: Vec<usize> = logits
            .iter()
            .map(|row| {
                let p = softmax(row, 2.5);
                let u: f64 = rng.random();
                if u < p[0] {
                    0
                } else if u < p[0] + p[1] {
                    1
                } else {
                    2
                }
            })
            .collect();
        let found = minimise(&logits, &labels, &[1.0; 3]);
        assert!((found / 2.5 - 1.0).abs() < 0.05, "{found}");
    }

    /// Regression test: the temperature was 0.05, so all probabilities of the model were near 0 or 1.
    #[test]
    fn without_a_map_of_a_trained_class_it_is_1() {
        assert_eq!(minimise(&[vec![1.0, 0.5, 0.0], vec![0.0, 0.2, 0.1]], &[2, 2], &[1.0, 1.0, 0.0]), 1.0);
    }
}
