//! Fit of the echo level, from static echoes in a recording and in a scene that is a copy of the recorded one.
//!
//! Where echoes interfere, a single bin is unreliable: a displacement of furniture by a millimetre can change it by 6
//! dB. The median over many bins is reliable.

use serde::Serialize;

use crate::math::weighted_median;

/// Range below which bins contain leakage, m.
pub const LEAST_RANGE_M: f64 = 0.5;
/// Least power ratio of static echoes to noise and to moving echoes.
pub const LEAST_OVER_NOISE: f64 = 10.0;
/// Least number of bins for a fit. With fewer bins, the error of the gain would be 2 dB and more.
pub const LEAST_BINS: usize = 9;
/// Standard deviation due to interference within a bin, dB.
const BIN_SIGMA_DB: f64 = 6.0;

/// Powers in a range bin of one receiver, all in the same unit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bin {
    /// Range, m.
    pub range_m: f64,
    /// Static power in the recording.
    pub measured: f64,
    /// Moving power in the recording.
    pub moving: f64,
    /// Static power in the scene.
    pub simulated: f64,
    /// Noise power of recording and scene.
    pub noise: f64,
}

/// Gain of a recording's echoes over those of a scene.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct GainFit {
    /// Weighted median, dB; `None` for fewer than [`LEAST_BINS`] bins.
    pub gain_db: Option<f64>,
    /// Uncertainty of the gain, dB.
    pub error_db: Option<f64>,
    /// Number of bins that were used.
    pub bins: usize,
    /// Number of bins beyond [`LEAST_RANGE_M`].
    pub of: usize,
}

/// Fits the gain to static echoes that are far enough above noise in both.
pub fn fit_gain(bins: &[Bin]) -> GainFit {
    let far_bins = bins.iter().filter(|bin| bin.range_m > LEAST_RANGE_M);
    let is_usable = |bin: &&Bin| {
        let least_power = LEAST_OVER_NOISE * bin.noise;
        bin.measured >= least_power && bin.simulated >= least_power && bin.measured >= LEAST_OVER_NOISE * bin.moving
    };
    let weighted_gains_db: Vec<(f64, f64)> = (far_bins.clone().filter(is_usable))
        .map(|bin| {
            // Noise adds to interference: 8.7 dB over the root of twice the power ratio, for each of the two.
            let noise_db2 = 37.7 * bin.noise * (1.0 / bin.measured + 1.0 / bin.simulated);
            (10.0 * (bin.measured / bin.simulated).log10(), 1.0 / (BIN_SIGMA_DB.powi(2) + noise_db2))
        })
        .collect();
    let (bins, of) = (weighted_gains_db.len(), far_bins.count());
    if bins < LEAST_BINS {
        return GainFit { bins, of, ..GainFit::default() };
    }
    let error_db = Some(BIN_SIGMA_DB / (bins as f64).sqrt());
    GainFit { gain_db: weighted_median(weighted_gains_db), error_db, bins, of }
}

#[cfg(test)]
mod tests {
    use rand::Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;
    use crate::random::{Purpose, generator};

    /// Bins of echoes with random interference. Some of them contain moving echoes, leakage, or only noise.
    fn bins(count: usize, gain_db: f64) -> Vec<Bin> {
        let mut rng = generator(11, Purpose::Furniture, [0, 0]);
        let bin = |i: usize| {
            let mut interference = || {
                let (a, b): (f64, f64) = (StandardNormal.sample(&mut rng), StandardNormal.sample(&mut rng));
                0.5 * (a * a + b * b)
            };
            let simulated = 1e-6 * interference();
            let mut bin = Bin {
                range_m: 0.6 + 0.1 * i as f64,
                measured: 1e-6 * interference() * 10f64.powf(0.1 * gain_db),
                moving: 1e-10,
                simulated,
                noise: 1e-9,
            };
            match i % 5 {
                0 => bin.moving = 1e-4,
                1 => bin.range_m = 0.2,
                _ => {}
            }
            if bin.moving > 1e-6 || bin.range_m < 0.5 {
                bin.measured = rng.random_range(1e-5..5e-4);
            }
            bin
        };
        (0..count).map(bin).collect()
    }

    #[test]
    fn the_gain_is_found_among_bins_with_moving_echoes_and_leakage() {
        for gain_db in [-5.0, 0.0, 8.0] {
            let fit = fit_gain(&bins(300, gain_db));
            let error_db = fit.error_db.expect("enough bins");
            assert!(fit.bins > 150 && fit.of == 240, "{fit:?}");
            assert!((fit.gain_db.expect("enough bins") - gain_db).abs() < 3.0 * error_db, "{fit:?}");
        }
    }

    #[test]
    fn too_few_bins_give_no_gain() {
        let fit = fit_gain(&bins(12, 3.0));
        assert_eq!((fit.gain_db, fit.error_db), (None, None));
        assert!(fit.bins < LEAST_BINS, "{fit:?}");
        assert_eq!(fit_gain(&[]), GainFit::default());
    }
}
