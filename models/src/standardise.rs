//! Label-free standardisation of maps: one mean and one sigma for all cells of the training split.
//!
//! The paper standardises by scene *and occupancy*, which tells the network the label of every test map
//! (paper.md section 4); this does not.

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::dataset::Moments;

/// Least sigma that maps can be divided by, dB. Receiver noise alone gives 5.6 dB.
pub const LEAST_SIGMA_DB: f64 = 1e-3;

/// `(dB - mean) / sigma`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Standardisation {
    /// Mean of all cells, dB.
    pub mean_db: f64,
    /// Standard deviation of all cells, dB.
    pub sigma_db: f64,
}

/// Maps that cannot be standardised.
#[derive(Debug, Clone, Copy, PartialEq, Error)]
pub enum StandardiseError {
    /// All cells are the same.
    #[error(
        "the cells of the training maps have standard deviation {sigma_db} dB about {mean_db} dB, too little to divide by (least {LEAST_SIGMA_DB} dB)\n\nhint: noise-free simulated maps sit at the dB floor; add receiver noise to the simulation"
    )]
    NoSpread {
        /// Mean, dB.
        mean_db: f64,
        /// Standard deviation, dB.
        sigma_db: f64,
    },
    /// There is no cell.
    #[error("there are no training maps to take mean and standard deviation from")]
    Empty,
}

impl Standardisation {
    /// Mean and standard deviation over all cells of all maps, in f64.
    pub fn measure<'a>(maps: impl Iterator<Item = &'a [f32]>) -> Result<Self, StandardiseError> {
        let mut moments = Moments::default();
        maps.for_each(|map| moments.add(map));
        if moments.count() == 0.0 {
            return Err(StandardiseError::Empty);
        }
        let (mean, sigma) = (moments.mean(), moments.sigma());
        if sigma.is_nan() || sigma < LEAST_SIGMA_DB {
            return Err(StandardiseError::NoSpread { mean_db: mean, sigma_db: sigma });
        }
        Ok(Standardisation { mean_db: mean, sigma_db: sigma })
    }

    /// Standardises cells in place.
    pub fn apply(&self, cells: &mut [f32]) {
        for cell in cells {
            *cell = ((f64::from(*cell) - self.mean_db) / self.sigma_db) as f32;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn moments_are_those_of_all_cells_together() {
        let maps = [vec![1.0f32, 2.0, 3.0], vec![10.0], vec![-4.0, 0.5]];
        let all: Vec<f64> = maps.iter().flatten().map(|&v| f64::from(v)).collect();
        let mean = all.iter().sum::<f64>() / all.len() as f64;
        let variance = all.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / all.len() as f64;
        let s = Standardisation::measure(maps.iter().map(Vec::as_slice)).expect("spread");
        assert!((s.mean_db - mean).abs() < 1e-12 && (s.sigma_db - variance.sqrt()).abs() < 1e-12);
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn maps_without_spread_are_refused_with_the_reason() {
            let flat = [-200.0f32; 16];
            let error = Standardisation::measure([&flat[..], &flat[..]].into_iter()).expect_err("sigma is zero");
            assert!(error.to_string().contains("-200 dB") && error.to_string().contains("receiver noise"), "{error}");
            assert_eq!(Standardisation::measure(std::iter::empty()), Err(StandardiseError::Empty));
            assert!(Standardisation::measure([&[f32::NAN, 1.0][..]].into_iter()).is_err());
        }
    }
}
