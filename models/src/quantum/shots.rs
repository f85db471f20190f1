//! Expectations as a quantum computer would estimate them: from a finite number of measurements.

use rand::Rng;

use super::state_vector;

/// `[<ZI>, <IZ>]` estimated from `shots` measurements of both qubits: unbiased, with variance `(1 - <Z>^2) / shots`.
/// `None` for no shots or an input that is not finite.
pub fn estimate(x: [f64; 2], theta: [f64; 4], shots: u32, rng: &mut impl Rng) -> Option<[f64; 2]> {
    let [p00, p01, p10, p11] = state_vector::run(x, theta).probabilities();
    if shots == 0 || !(p00 + p01 + p10 + p11).is_finite() {
        return None;
    }
    let (mut zi, mut iz) = (0i64, 0i64);
    for _ in 0..shots {
        let u: f64 = rng.random();
        let (q1, q0) = match u {
            u if u < p00 => (1, 1),
            u if u < p00 + p01 => (1, -1),
            u if u < p00 + p01 + p10 => (-1, 1),
            _ => (-1, -1),
        };
        zi += q1;
        iz += q0;
    }
    Some([zi as f64 / f64::from(shots), iz as f64 / f64::from(shots)])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{quantum::expectations, stream};

    #[test]
    fn estimates_scatter_about_the_expectation_as_they_should() {
        let (x, theta, shots, runs) = ([0.8, 2.1], [0.4, -1.2, 2.0, 0.7], 4096, 400);
        let exact = expectations(x, theta);
        let mut rng = stream(1, "shots", 0);
        let estimates: Vec<[f64; 2]> =
            (0..runs).map(|_| estimate(x, theta, shots, &mut rng).expect("estimate")).collect();
        for k in 0..2 {
            let variance = (1.0 - exact[k] * exact[k]) / f64::from(shots);
            let mean = estimates.iter().map(|e| e[k]).sum::<f64>() / f64::from(runs);
            // Five standard errors; the variance of a variance over n normal draws is 2 / n of its square.
            assert!((mean - exact[k]).abs() < 5.0 * (variance / f64::from(runs)).sqrt());
            let found = estimates.iter().map(|e| (e[k] - exact[k]).powi(2)).sum::<f64>() / f64::from(runs);
            assert!((found / variance - 1.0).abs() < 5.0 * (2.0 / f64::from(runs)).sqrt(), "{found} {variance}");
        }
        assert_eq!(estimate(x, theta, 0, &mut rng), None);
        assert_eq!(estimate([f64::NAN, 0.0], theta, 10, &mut rng), None);
    }
}
