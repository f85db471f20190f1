//! Expectations estimated from a finite number of measurements of all qubits, as a quantum computer does.

use rand::Rng;
use rand_distr::{Binomial, Distribution};

use super::state_vector::z_expectations;

/// `<Z>` of each qubit, the highest first, estimated from `shots` measurements (at least one) with these probabilities
/// of outcomes: unbiased, with variance `(1 - <Z>^2) / shots`. NaN where a probability is not finite.
///
/// The counts of the outcomes are one multinomial draw, outcome by outcome from the remaining shots. The cost does not depend on
/// the number of shots.
pub(super) fn estimate(probabilities: &[f64], shots: u32, rng: &mut impl Rng) -> Vec<f64> {
    // Sums from the end, so that the last possible outcome takes all remaining shots in spite of rounding.
    let mut tails: Vec<f64> = probabilities.iter().map(|&p| if p < 0.0 { 0.0 } else { p }).collect();
    for k in (1..tails.len()).rev() {
        tails[k - 1] += tails[k];
    }
    let mut remaining = u64::from(shots);
    let mut sampled_frequency = |k: usize| {
        let next = tails.get(k + 1).copied().unwrap_or(0.0);
        // The probability of this outcome among those that remain; 1 for the last possible one.
        let hits = match Binomial::new(remaining, (tails[k] - next) / tails[k]) {
            _ if remaining == 0 || tails[k] == 0.0 => 0,
            Ok(law) => law.sample(rng),
            Err(_) => return f64::NAN,
        };
        remaining -= hits;
        hits as f64 / f64::from(shots)
    };
    z_expectations(&(0..probabilities.len()).map(&mut sampled_frequency).collect::<Vec<f64>>())
}
