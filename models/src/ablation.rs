//! Ablation: classifies maps again with parts replaced by noise, which shows the parts that a model relies on.
//!
//! The noise level of a range bin is estimated from the map, as [`crate::standardise::MapReference::OverNoise`] does.
//! Replaced cells are drawn from an exponential distribution with this mean, the distribution of cells without echoes.

use radome_dsp::{Occupancy, Rdm, RdmShape};

use crate::dataset::{Dataset, LEAKAGE_BINS, network_input};
use crate::metrics::{Metrics, most_probable};
use crate::model::{Classifier, ClassifyError, ModelCard};
use crate::random::stream;
use crate::standardise::{DB_PER_E_FOLD, bin_noise_db, echo_share, noise_power};

/// Seed of the noise that replaces cells.
const SEED: u64 = 1;

/// Change of a map before it is classified again. Range bins of leakage stay unchanged.
#[derive(Debug, Clone, Copy, PartialEq)]
#[allow(missing_docs, reason = "each variant says what its fields are")]
pub enum Ablation {
    /// No change, for comparison.
    Nothing,
    /// Cells of these speeds or less become noise.
    Slow { most_m_per_s: f64 },
    /// Cells of more than these speeds become noise.
    Fast { most_m_per_s: f64 },
    /// The nearest tenth of the range bins beyond those of leakage becomes noise.
    Near,
    /// The farthest third of the range bins becomes noise.
    Far,
    /// Cells of less than this over noise become noise.
    Weak { least_db: f32 },
    /// Echoes are shifted by range bins to larger ranges; vacated bins become noise.
    Shifted { bins: usize },
    /// Echoes are weakened.
    Weaker { by_db: f32 },
}

/// All ablations: near zero Doppler and away from it, ranges, weak cells, and position and level of echoes.
pub const ABLATIONS: [Ablation; 11] = [
    Ablation::Nothing,
    Ablation::Slow { most_m_per_s: 0.15 },
    Ablation::Slow { most_m_per_s: 0.35 },
    Ablation::Fast { most_m_per_s: 0.35 },
    Ablation::Near,
    Ablation::Far,
    Ablation::Weak { least_db: 10.0 },
    Ablation::Shifted { bins: 4 },
    Ablation::Shifted { bins: 8 },
    Ablation::Weaker { by_db: 6.0 },
    Ablation::Weaker { by_db: 12.0 },
];

impl std::fmt::Display for Ablation {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Ablation::Nothing => write!(f, "nothing"),
            Ablation::Slow { most_m_per_s } => write!(f, "speeds up to {most_m_per_s} m/s"),
            Ablation::Fast { most_m_per_s } => write!(f, "speeds above {most_m_per_s} m/s"),
            Ablation::Near => write!(f, "near ranges"),
            Ablation::Far => write!(f, "far ranges"),
            Ablation::Weak { least_db } => write!(f, "cells below {least_db} dB over noise"),
            Ablation::Shifted { bins } => write!(f, "nothing, echoes {bins} range bins away"),
            Ablation::Weaker { by_db } => write!(f, "nothing, echoes {by_db} dB weaker"),
        }
    }
}

impl Ablation {
    /// Returns the changed map. Its noise is a function of `index`. Its motion stays. A map whose cells do not match its shape stays
    /// unchanged.
    pub fn apply(self, map: &Rdm, skip_range_bins: usize, index: u64) -> Rdm {
        let mut changed = map.clone();
        let RdmShape { rx, doppler, range } = map.shape;
        if self == Ablation::Nothing {
            return changed;
        }
        let mut rng = stream(SEED, &format!("ablation: {self}"), index);
        let mut sorted = Vec::with_capacity(doppler);
        for channel in 0..rx {
            let Some(cells) = network_input(&map.db, map.shape, channel) else { continue };
            let rows: Vec<&[f32]> = cells.chunks_exact(doppler.max(1)).collect();
            let noise_db: Vec<f32> = rows.iter().map(|row| bin_noise_db(row, &mut sorted)).collect();
            for (bin, row) in rows.iter().enumerate().skip(skip_range_bins) {
                for (column, &cell) in row.iter().enumerate() {
                    let over_db = cell - noise_db[bin];
                    let speed = map.velocity_m_per_s(column).abs();
                    let kept_db = match self {
                        Ablation::Nothing => Some(over_db),
                        Ablation::Slow { most_m_per_s } => (speed > most_m_per_s).then_some(over_db),
                        Ablation::Fast { most_m_per_s } => (speed <= most_m_per_s).then_some(over_db),
                        Ablation::Near => {
                            let near = range.saturating_sub(skip_range_bins).div_ceil(10);
                            (bin >= skip_range_bins + near).then_some(over_db)
                        }
                        Ablation::Far => (bin < range - range / 3).then_some(over_db),
                        Ablation::Weak { least_db } => (over_db >= least_db).then_some(over_db),
                        Ablation::Shifted { bins } => {
                            let source = bin.checked_sub(bins).filter(|source| *source >= skip_range_bins);
                            source.map(|source| rows[source][column] - noise_db[source])
                        }
                        Ablation::Weaker { by_db } => {
                            Some(over_db - by_db * echo_share((over_db / DB_PER_E_FOLD).exp()))
                        }
                    };
                    let over_db = kept_db.unwrap_or_else(|| DB_PER_E_FOLD * noise_power(&mut rng).ln());
                    if let Some(cell) = changed.db.get_mut((channel * doppler + column) * range + bin) {
                        *cell = noise_db[bin] + over_db;
                    }
                }
            }
        }
        changed
    }
}

/// Predictions of a model under each of [`ABLATIONS`].
#[derive(Debug, Clone)]
pub struct AblationScores {
    skip_range_bins: usize,
    maps: u64,
    confusion: [[[u64; Occupancy::ALL.len()]; Occupancy::ALL.len()]; ABLATIONS.len()],
}

impl AblationScores {
    /// Starts without predictions, for a model with this card.
    pub fn new(card: &ModelCard) -> Self {
        let skip_range_bins = card.standardisation.reference.skipped_range_bins().unwrap_or(LEAKAGE_BINS);
        AblationScores { skip_range_bins, maps: 0, confusion: Default::default() }
    }

    /// Classifies a map under each ablation.
    ///
    /// # Errors
    /// The first error of `classify`.
    pub fn add<E>(
        &mut self,
        map: &Rdm,
        truth: Occupancy,
        mut classify: impl FnMut(&Rdm) -> Result<[f32; 3], E>,
    ) -> Result<(), E> {
        for (ablation, confusion) in ABLATIONS.into_iter().zip(&mut self.confusion) {
            let probabilities = classify(&ablation.apply(map, self.skip_range_bins, self.maps))?;
            confusion[truth.index()][most_probable(&probabilities).index()] += 1;
        }
        self.maps += 1;
        Ok(())
    }

    /// Scores of single maps under each ablation.
    pub fn metrics(&self) -> Vec<(Ablation, Metrics)> {
        ABLATIONS.into_iter().zip(self.confusion.map(Metrics::from_confusion)).collect()
    }
}

/// Scores of a classifier over the maps `indices` of a dataset, under each of [`ABLATIONS`].
///
/// # Errors
/// If a map cannot be read or classified.
pub fn ablate(
    classifier: &mut Classifier,
    dataset: &Dataset,
    indices: &[usize],
) -> Result<AblationScores, ClassifyError> {
    let mut scores = AblationScores::new(classifier.card());
    let header = dataset.header();
    for &index in indices {
        let Some(row) = dataset.rows().get(index) else { continue };
        let map = Rdm { motion: row.motion, ..header.rdm(dataset.map(index)?, row.frame) };
        scores.add(&map, row.label, |map| classifier.classify_row(&map.db, map.shape, row))?;
    }
    Ok(scores)
}

#[cfg(test)]
mod tests {
    use radome_dsp::MapFlags;

    use super::*;

    const SHAPE: RdmShape = RdmShape { rx: 2, doppler: 32, range: 33 };
    const SKIP: usize = 3;
    /// Velocity step with which 0.15 m/s are one Doppler bin and 0.35 m/s are three.
    const VELOCITY_STEP: f64 = 0.1;

    /// Index of a cell.
    fn at(rx: usize, doppler: usize, range: usize) -> usize {
        (rx * SHAPE.doppler + doppler) * SHAPE.range + range
    }

    fn rdm(db: Vec<f32>) -> Rdm {
        Rdm {
            shape: SHAPE,
            db,
            range_step_m: 0.15,
            velocity_step_m_per_s: VELOCITY_STEP,
            sequence: 0,
            flags: MapFlags::default(),
            motion: None,
        }
    }

    /// Level of the noise in a range bin; it differs from bin to bin.
    fn level_db(range: usize) -> f32 {
        -90.0 - 0.5 * range as f32
    }

    fn noise() -> Rdm {
        let mut rng = stream(3, "noise", 0);
        let mut db = vec![0.0; SHAPE.cells()];
        for (index, cell) in db.iter_mut().enumerate() {
            *cell = level_db(index % SHAPE.range) + 10.0 * noise_power(&mut rng).log10();
        }
        rdm(db)
    }

    fn over_level(map: &Rdm, index: usize) -> f32 {
        map.db[index] - level_db(index % SHAPE.range)
    }

    /// Cells of the ablated part are drawn again at the noise level of their bin, and all others stay unchanged.
    #[test]
    fn parts_are_replaced_and_nothing_else() {
        let map = noise();
        let zero = SHAPE.doppler / 2;
        let slow = |d: usize, bins: usize| d.abs_diff(zero) <= bins;
        type Part<'a> = (Ablation, &'a dyn Fn(usize, usize, usize) -> bool);
        let parts: [Part; 6] = [
            (Ablation::Nothing, &|_, _, _| false),
            (Ablation::Slow { most_m_per_s: 0.15 }, &|_, d, r| r >= SKIP && slow(d, 1)),
            (Ablation::Slow { most_m_per_s: 0.35 }, &|_, d, r| r >= SKIP && slow(d, 3)),
            (Ablation::Fast { most_m_per_s: 0.35 }, &|_, d, r| r >= SKIP && !slow(d, 3)),
            (Ablation::Near, &|_, _, r| (SKIP..SKIP + 3).contains(&r)),
            (Ablation::Far, &|_, _, r| r >= 22),
        ];
        for (ablation, replaces) in parts {
            let changed = ablation.apply(&map, SKIP, 7);
            assert_eq!(changed, ablation.apply(&map, SKIP, 7), "{ablation}: the same noise again");
            let mut powers = Vec::new();
            for rx in 0..SHAPE.rx {
                for d in 0..SHAPE.doppler {
                    for r in 0..SHAPE.range {
                        let index = at(rx, d, r);
                        let difference = (changed.db[index] - map.db[index]).abs();
                        if replaces(rx, d, r) {
                            assert!(difference > 0.0, "{ablation}: {rx} {d} {r}");
                            powers.push(10f64.powf(0.1 * f64::from(over_level(&changed, index))));
                        } else {
                            assert!(difference < 1e-4, "{ablation}: {rx} {d} {r}: {difference} dB");
                        }
                    }
                }
            }
            if !powers.is_empty() {
                // The noise of a bin is estimated from the quartile of 32 cells.
                let mean = powers.iter().sum::<f64>() / powers.len() as f64;
                assert!((0.6..1.7).contains(&mean), "{ablation}: {mean}");
            }
        }
    }

    #[test]
    fn weak_cells_go_and_strong_ones_stay() {
        let mut map = noise();
        let (strong, weak) = (at(0, 20, 10), at(1, 9, 20));
        map.db[strong] = level_db(10) + 25.0;
        map.db[weak] = level_db(20) + 3.0;
        let changed = Ablation::Weak { least_db: 10.0 }.apply(&map, SKIP, 1);
        assert!((changed.db[strong] - map.db[strong]).abs() < 1e-4);
        assert_ne!(changed.db[weak], map.db[weak]);
        assert_ne!(changed, Ablation::Weak { least_db: 10.0 }.apply(&map, SKIP, 2), "another map, other noise");
    }

    /// A shifted echo keeps its level over the noise of its new bin; a weakened one loses the given level.
    #[test]
    fn echoes_are_moved_and_weakened_over_noise() {
        let mut map = noise();
        let echo = at(1, 25, 12);
        map.db[echo] = level_db(12) + 40.0;
        let before_db = over_level(&map, echo);
        for bins in [4, 8] {
            let moved = Ablation::Shifted { bins }.apply(&map, SKIP, 1);
            let moved_db = over_level(&moved, at(1, 25, 12 + bins));
            // The noise of each of the two bins is estimated from a quartile.
            assert!((moved_db - before_db).abs() < 9.0, "{moved_db} {before_db}");
            assert!(over_level(&moved, echo) < 25.0);
            assert_eq!(moved.db[at(0, 3, 1)], map.db[at(0, 3, 1)], "leakage stays");
        }
        for by_db in [6.0, 12.0] {
            let weaker = Ablation::Weaker { by_db }.apply(&map, SKIP, 1);
            assert!((over_level(&weaker, echo) - before_db + by_db).abs() < 0.5);
            let mean = |map: &Rdm| map.db.iter().map(|db| f64::from(*db)).sum::<f64>() / map.db.len() as f64;
            assert!((mean(&weaker) - mean(&map)).abs() < 2.5, "noise stays nearly where it is");
        }
    }

    mod hard_cases {
        use super::*;

        /// Maps at the floor, of one cell, of a wrong number of cells, and with more bins to skip than there are.
        #[test]
        fn odd_maps_stay_finite() {
            let one = RdmShape { rx: 1, doppler: 1, range: 1 };
            let none = RdmShape { rx: 1, doppler: 0, range: 4 };
            for (shape, db, skip) in [
                (SHAPE, vec![-200.0; SHAPE.cells()], SKIP),
                (SHAPE, vec![-200.0; 5], SKIP),
                (SHAPE, vec![3e38; SHAPE.cells()], 0),
                (SHAPE, vec![1.0; SHAPE.cells()], 99),
                (one, vec![0.0], 0),
                (none, Vec::new(), 0),
            ] {
                let map = Rdm { shape, db, ..rdm(Vec::new()) };
                for ablation in ABLATIONS {
                    let changed = ablation.apply(&map, skip, 0);
                    assert_eq!(changed.db.len(), map.db.len());
                    assert!(changed.db.iter().all(|v| v.is_finite()), "{ablation} {shape}");
                }
            }
        }
    }
}
