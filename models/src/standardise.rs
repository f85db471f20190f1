//! Label-free standardisation of maps: against their own noise where asked for, then one mean and one sigma for all cells of
//! the training split.
//!
//! The paper standardises by scene *and occupancy*, which tells the network the label of every test map
//! (paper.md section 4); this does not.

use radome_dsp::Occupancy;
use radome_dsp::decibel::power_to_db_portable;
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::dataset::Moments;

/// Least sigma that maps can be divided by, dB. Receiver noise alone gives 5.6 dB.
pub const LEAST_SIGMA_DB: f64 = 1e-3;

/// What the cells of a map are measured against before mean and sigma are taken off.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MapReference {
    /// The map's own 0 dB.
    #[default]
    Absolute,
    /// The noise of each range bin in this very map: a cell of power `P` in a bin of noise `N` becomes
    /// `10 log10(1 + P / N)`, so that a board's gain and the colour of its noise are gone, and noise below its mean is not
    /// spread over tens of dB. `N` is the lower quartile of the bin's cells over `ln(4/3)`, which it is of the mean of an
    /// exponential distribution; echoes in less than half of the Doppler bins hardly move it.
    OverNoise {
        /// Range bins from the nearest that show leakage and not the room: they read as noise.
        skip_range_bins: usize,
    },
}

impl MapReference {
    /// Puts the cells `[range][doppler]` dB of a map in reference to what this says.
    pub fn apply(self, cells: &mut [f32], doppler: usize) {
        let MapReference::OverNoise { skip_range_bins } = self else { return };
        /// `10 / ln 10`.
        const DB: f32 = 4.342_944_8;
        /// 347 dB over noise, natural.
        const MOST: f32 = 80.0;
        let mut sorted = Vec::with_capacity(doppler);
        for (bin, row) in cells.chunks_exact_mut(doppler.max(1)).enumerate() {
            if bin < skip_range_bins {
                row.fill(DB * std::f32::consts::LN_2);
                continue;
            }
            sorted.clear();
            sorted.extend_from_slice(row);
            let (_, &mut quartile_db, _) = sorted.select_nth_unstable_by(row.len() / 4, f32::total_cmp);
            let noise_db = quartile_db - DB * (4.0f32 / 3.0).ln().ln();
            for cell in row.iter_mut() {
                let x = (*cell - noise_db) / DB;
                // Not `f32::min`, which would hide what is not a number.
                let x = if x > MOST { MOST } else { x };
                *cell = 1.0 + x.exp();
            }
            power_to_db_portable(row, 1.0);
        }
    }

    fn is_absolute(&self) -> bool {
        *self == MapReference::Absolute
    }
}

/// `(dB - mean) / sigma`, of cells in reference to what they are measured against.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Standardisation {
    /// What 0 dB is.
    #[serde(default, skip_serializing_if = "MapReference::is_absolute")]
    pub reference: MapReference,
    /// Mean of all cells, dB.
    pub mean_db: f64,
    /// Standard deviation of all cells, dB.
    pub sigma_db: f64,
    /// Instead, for maps of these scenes with so many people in them: the paper's rule, which tells the network the label of
    /// every map that it is shown.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub label_leaking_cells: Vec<CellConstants>,
}

/// Mean and standard deviation of the training maps of one scene and class.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CellConstants {
    /// Scene or place.
    pub scene: String,
    /// How many are in it.
    pub class: Occupancy,
    /// Mean, dB.
    pub mean_db: f64,
    /// Standard deviation, dB.
    pub sigma_db: f64,
}

/// Maps that cannot be standardised.
#[derive(Debug, Clone, PartialEq, Error)]
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
    /// Those of one scene and class are.
    #[error("of scene {scene} with class {class}, {of}")]
    Cell {
        /// Scene.
        scene: String,
        /// Class.
        class: Occupancy,
        /// What is wrong with its maps.
        of: Box<StandardiseError>,
    },
    /// There is no cell.
    #[error("there are no training maps to take mean and standard deviation from")]
    Empty,
}

impl Standardisation {
    /// Mean and standard deviation over all cells of all maps, in f64. The maps are in `reference` already.
    pub fn measure<'a>(
        reference: MapReference,
        maps: impl Iterator<Item = &'a [f32]>,
    ) -> Result<Self, StandardiseError> {
        let mut moments = Moments::default();
        maps.for_each(|map| moments.add(map));
        if moments.count() == 0.0 {
            return Err(StandardiseError::Empty);
        }
        let (mean, sigma) = (moments.mean(), moments.sigma());
        if sigma.is_nan() || sigma < LEAST_SIGMA_DB {
            return Err(StandardiseError::NoSpread { mean_db: mean, sigma_db: sigma });
        }
        Ok(Standardisation { reference, mean_db: mean, sigma_db: sigma, label_leaking_cells: Vec::new() })
    }

    /// Adds the constants of one scene and class, from its training maps.
    pub(crate) fn add_cell<'a>(
        &mut self,
        scene: &str,
        class: Occupancy,
        maps: impl Iterator<Item = &'a [f32]>,
    ) -> Result<(), StandardiseError> {
        let of_cell = Self::measure(self.reference, maps);
        let of_cell =
            of_cell.map_err(|of| StandardiseError::Cell { scene: scene.to_owned(), class, of: Box::new(of) })?;
        let Standardisation { mean_db, sigma_db, .. } = of_cell;
        self.label_leaking_cells.push(CellConstants { scene: scene.to_owned(), class, mean_db, sigma_db });
        Ok(())
    }

    /// Whether maps without a label cannot be standardised.
    pub fn needs_labels(&self) -> bool {
        !self.label_leaking_cells.is_empty()
    }

    /// Standardises the cells `[range][doppler]` of a map in place; `of` is its scene and label, where it has them.
    pub fn apply(&self, cells: &mut [f32], doppler: usize, of: Option<(&str, Occupancy)>) {
        self.reference.apply(cells, doppler);
        self.scale(cells, of);
    }

    /// The constants alone, for cells that are in reference already.
    pub(crate) fn scale(&self, cells: &mut [f32], of: Option<(&str, Occupancy)>) {
        let of_cell = of.and_then(|(scene, class)| {
            self.label_leaking_cells.iter().find(|cell| cell.scene == scene && cell.class == class)
        });
        let (mean_db, sigma_db) = of_cell.map_or((self.mean_db, self.sigma_db), |cell| (cell.mean_db, cell.sigma_db));
        for cell in cells {
            *cell = ((f64::from(*cell) - mean_db) / sigma_db) as f32;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::Rng;

    #[test]
    fn moments_are_those_of_all_cells_together() {
        let maps = [vec![1.0f32, 2.0, 3.0], vec![10.0], vec![-4.0, 0.5]];
        let all: Vec<f64> = maps.iter().flatten().map(|&v| f64::from(v)).collect();
        let mean = all.iter().sum::<f64>() / all.len() as f64;
        let variance = all.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / all.len() as f64;
        let s = Standardisation::measure(MapReference::Absolute, maps.iter().map(Vec::as_slice)).expect("spread");
        assert!((s.mean_db - mean).abs() < 1e-12 && (s.sigma_db - variance.sqrt()).abs() < 1e-12);
    }

    /// The definition in f64 beside it, from far below the noise to far above.
    #[test]
    fn over_noise_is_its_definition() {
        let mut row: Vec<f32> = (0..128).map(|i| -160.0 + 1.7 * i as f32).collect();
        let given = row.clone();
        MapReference::OverNoise { skip_range_bins: 0 }.apply(&mut row, 128);
        let noise_db = f64::from(given[32]) - 10.0 * (4.0f64 / 3.0).ln().log10();
        for (given, got) in given.iter().zip(&row) {
            let expected = 10.0 * (1.0 + 10f64.powf(0.1 * (f64::from(*given) - noise_db))).log10();
            assert!((f64::from(*got) - expected).abs() < 5e-5, "{got} for {expected}");
        }
        let mut broken = given;
        broken[100] = f32::NAN;
        MapReference::OverNoise { skip_range_bins: 0 }.apply(&mut broken, 128);
        assert!(broken[100].is_nan() && broken[99].is_finite());
    }

    /// Exponential noise of any level and colour reads the same, an echo 20 dB above it reads 20 dB, and what stands on the
    /// bins of the leakage is not seen.
    #[test]
    fn over_noise_neither_gain_nor_colour_is_left() {
        let (range, doppler, skip) = (24, 64, 3);
        let mut rng = crate::stream(3, "noise", 0);
        let mut map = vec![0.0f32; range * doppler];
        for (bin, row) in map.chunks_exact_mut(doppler).enumerate() {
            let level_db = -40.0 - 0.8 * bin as f32;
            row.fill_with(|| level_db + 10.0 * (-rng.random_range(f32::MIN_POSITIVE..1.0).ln()).log10());
        }
        map[7 * doppler + 40] = -40.0 - 0.8 * 7.0 + 20.0;
        map[doppler + 40] = 0.0;
        let mut louder: Vec<f32> = map.iter().map(|db| db + 11.0).collect();
        let reference = MapReference::OverNoise { skip_range_bins: skip };
        reference.apply(&mut map, doppler);
        reference.apply(&mut louder, doppler);
        for (a, b) in map.iter().zip(&louder) {
            assert!((a - b).abs() < 1e-3, "{a} {b}");
        }
        assert!((map[7 * doppler + 40] - 20.0).abs() < 2.0, "{}", map[7 * doppler + 40]);
        assert!(map[..skip * doppler].iter().all(|v| (v - 3.0103).abs() < 1e-3));
        // The mean of 10 log10(1 + P/N) over exponential P/N: 10/ln(10) e E1(1) = 2.5898 dB.
        let rest = &map[skip * doppler..];
        let mean = rest.iter().map(|v| f64::from(*v)).sum::<f64>() / rest.len() as f64;
        assert!((mean - 2.59).abs() < 0.25, "{mean}");
    }

    /// The paper's rule makes maps of unlike scenes and classes the same in mean and sigma; a cell that is flat is named.
    #[test]
    fn cells_have_constants_of_their_own() {
        let maps = [vec![1.0f32, 3.0], vec![10.0, 20.0]];
        let mut s = Standardisation::measure(MapReference::Absolute, maps.iter().map(Vec::as_slice)).expect("spread");
        assert!(!s.needs_labels());
        for (map, class) in maps.iter().zip([Occupancy::Empty, Occupancy::One]) {
            s.add_cell("hall", class, [map.as_slice()].into_iter()).expect("a cell");
        }
        assert!(s.needs_labels());
        for (map, class) in maps.iter().zip([Occupancy::Empty, Occupancy::One]) {
            let mut map = map.clone();
            s.apply(&mut map, 2, Some(("hall", class)));
            assert_eq!(map, [-1.0, 1.0]);
        }
        let error = s.add_cell("cellar", Occupancy::Two, [&[5.0f32; 4][..]].into_iter()).expect_err("flat");
        assert!(error.to_string().starts_with("of scene cellar with class two"), "{error}");
    }

    mod hard_cases {
        use super::*;

        const ABSOLUTE: MapReference = MapReference::Absolute;

        /// Cells at the floor of silence, a map of one cell and more bins to skip than there are.
        #[test]
        fn odd_maps_stay_finite() {
            for (mut map, doppler, skip) in
                [(vec![-370.0f32; 64], 8, 2), (vec![5.0], 1, 0), (vec![100.0; 16], 4, 9), (vec![], 4, 1)]
            {
                MapReference::OverNoise { skip_range_bins: skip }.apply(&mut map, doppler);
                assert!(map.iter().all(|v| v.is_finite()), "{map:?}");
            }
            let mut spread = vec![-370.0f32, -370.0, -370.0, 60.0];
            MapReference::OverNoise { skip_range_bins: 0 }.apply(&mut spread, 4);
            assert!(spread.iter().all(|v| v.is_finite()), "{spread:?}");
        }

        #[test]
        fn maps_without_spread_are_refused_with_the_reason() {
            let flat = [-200.0f32; 16];
            let error =
                Standardisation::measure(ABSOLUTE, [&flat[..], &flat[..]].into_iter()).expect_err("sigma is zero");
            assert!(error.to_string().contains("-200 dB") && error.to_string().contains("receiver noise"), "{error}");
            assert_eq!(Standardisation::measure(ABSOLUTE, std::iter::empty()), Err(StandardiseError::Empty));
            assert!(Standardisation::measure(ABSOLUTE, [&[f32::NAN, 1.0][..]].into_iter()).is_err());
        }
    }
}
