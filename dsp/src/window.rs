//! Window functions.

use std::f64::consts::TAU;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Window over samples or chirps. Periodic (DFT-even) unless the name says symmetric.
///
/// ```
/// use radome_dsp::Window;
///
/// let weights = Window::Hann.weights(64);
/// assert!((weights.iter().sum::<f64>() - 32.0).abs() < 1e-12);
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Window {
    /// All weights 1.
    Rectangular,
    /// `(1 - cos) / 2`: sidelobes -31 dB, falling 18 dB an octave.
    Hann,
    /// `0.54 - 0.46 cos`: sidelobes -43 dB.
    Hamming,
    /// Four-term Blackman-Harris: sidelobes -92 dB.
    BlackmanHarris,
    /// Four-term Blackman-Harris with period `N - 1`, as in the vendor's examples.
    BlackmanHarrisSymmetric,
}

impl Window {
    /// Returns the `length` weights.
    pub fn weights(self, length: usize) -> Vec<f64> {
        const HANN: [f64; 2] = [0.5, 0.5];
        const HAMMING: [f64; 2] = [0.54, 0.46];
        const BLACKMAN_HARRIS: [f64; 4] = [0.35875, 0.48829, 0.14128, 0.01168];
        let (terms, symmetric): (&[f64], bool) = match self {
            Window::Rectangular => (&[1.0], false),
            Window::Hann => (&HANN, false),
            Window::Hamming => (&HAMMING, false),
            Window::BlackmanHarris => (&BLACKMAN_HARRIS, false),
            Window::BlackmanHarrisSymmetric => (&BLACKMAN_HARRIS, true),
        };
        let period = if symmetric { length.saturating_sub(1).max(1) } else { length } as f64;
        (0..length)
            .map(|n| {
                let phase = TAU * n as f64 / period;
                terms
                    .iter()
                    .enumerate()
                    .map(|(k, a)| if k % 2 == 0 { *a } else { -*a } * (k as f64 * phase).cos())
                    .sum()
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_bandwidths_are_the_textbook_ones() {
        // Harris, Proc. IEEE 66(1), 1978, table 1.
        for (window, bins) in
            [(Window::Rectangular, 1.0), (Window::Hann, 1.5), (Window::Hamming, 1.363), (Window::BlackmanHarris, 2.004)]
        {
            // Equivalent noise bandwidth: N sum w^2 / (sum w)^2.
            let (sum, squares) = window.weights(256).iter().fold((0.0, 0.0), |(s, q), x| (s + x, q + x * x));
            assert!((256.0 * squares / (sum * sum) - bins).abs() < 2e-3, "{window:?}");
        }
    }

    #[test]
    fn periodic_windows_sum_to_their_first_term_and_symmetric_ones_mirror() {
        assert!((Window::Hann.weights(64).iter().sum::<f64>() - 32.0).abs() < 1e-12);
        let w = Window::BlackmanHarrisSymmetric.weights(33);
        for i in 0..33 {
            assert!((w[i] - w[32 - i]).abs() < 1e-15);
        }
        assert_eq!(Window::Rectangular.weights(3), [1.0; 3]);
    }
}
