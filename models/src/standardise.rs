//! Label-free standardisation of maps: optionally over their own noise, then by one mean and one sigma for all cells of the
//! training split.
//!
//! The paper standardises by scene *and occupancy*, which leaks the label of every test map to the network.

use std::borrow::Cow;

use radome_dsp::Occupancy;
use radome_dsp::decibel::power_to_db_portable;
use rand::Rng;
use rand_distr::{Distribution, Exp1};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::dataset::Moments;

/// Least sigma that maps can be divided by, dB. Receiver noise alone gives 5.6 dB.
pub const LEAST_SIGMA_DB: f64 = 1e-3;

/// Bounds of maps ([`MapReference::OverNoise`]) that a training may set, dB over noise. Cells of noise have a mean of 2.6 dB, and none exceeds
/// 347 dB.
pub(crate) const TRAINED_BOUNDS_DB: std::ops::RangeInclusive<f32> = 3.0..=350.0;

/// Reference level of the cells of a map before the normalisation by mean and sigma.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
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
        /// Number of nearest range bins, which show leakage and not the room. They are set to noise.
        skip_range_bins: usize,
        /// Level above which all cells read the same, dB over noise, 3 to 350. Unbounded if absent, as in models of before it.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        most_db: Option<f32>,
    },
}

/// `10 / ln 10`: dB for a factor of e in power.
pub(crate) const DB_PER_E_FOLD: f32 = 4.342_944_8;
/// Natural logarithm of the largest power over noise that is represented, 347 dB.
const MAX_LN_POWER: f32 = 80.0;

impl MapReference {
    /// Converts the cells `[range][doppler]`, dB, of a map to this reference.
    pub fn apply(self, cells: &mut [f32], doppler: usize) {
        self.apply_unclipped(cells, doppler);
        self.clip(cells);
    }

    /// [`MapReference::apply`] without clipping. A training clips after its augmentation.
    pub(crate) fn apply_unclipped(self, cells: &mut [f32], doppler: usize) {
        let MapReference::OverNoise { skip_range_bins, .. } = self else { return };
        let mut sorted = Vec::with_capacity(doppler);
        for (bin, row) in cells.chunks_exact_mut(doppler.max(1)).enumerate() {
            if bin < skip_range_bins {
                row.fill(DB_PER_E_FOLD * std::f32::consts::LN_2);
                continue;
            }
            let noise_db = bin_noise_db(row, &mut sorted);
            for cell in row.iter_mut() {
                let x = (*cell - noise_db) / DB_PER_E_FOLD;
                // Not `f32::min`, which would hide a NaN.
                let x = if x > MAX_LN_POWER { MAX_LN_POWER } else { x };
                *cell = 1.0 + x.exp();
            }
            power_to_db_portable(row, 1.0);
        }
    }

    /// Clips converted cells at `most_db`, where it is set.
    pub(crate) fn clip(self, cells: &mut [f32]) {
        let MapReference::OverNoise { most_db: Some(most_db), .. } = self else { return };
        for cell in cells {
            // Not `f32::min`, which would hide a NaN.
            if *cell > most_db {
                *cell = most_db;
            }
        }
    }

    /// Number of nearest range bins that show leakage and not the room; `None` for an absolute reference.
    pub fn skipped_range_bins(self) -> Option<usize> {
        match self {
            MapReference::Absolute => None,
            MapReference::OverNoise { skip_range_bins, .. } => Some(skip_range_bins),
        }
    }

    /// First setting that is out of range: `(name, value, expected)`.
    pub(crate) fn invalid_setting(self) -> Option<(&'static str, f32, &'static str)> {
        match self {
            MapReference::OverNoise { most_db: Some(most_db), .. } if !(most_db.is_finite() && most_db > 0.0) => {
                Some(("reference.over_noise.most_db", most_db, "a finite level above 0 dB"))
            }
            _ => None,
        }
    }

    /// Copy of converted cells, clipped at `most_db` where it is set.
    pub(crate) fn clipped(self, cells: &[f32]) -> Cow<'_, [f32]> {
        if !matches!(self, MapReference::OverNoise { most_db: Some(_), .. }) {
            return Cow::Borrowed(cells);
        }
        let mut cells = cells.to_vec();
        self.clip(&mut cells);
        Cow::Owned(cells)
    }
}

/// Noise level of the cells of one range bin, dB: their lower quartile over `ln(4/3)`, or 0 dB without cells.
/// `sorted` is scratch memory.
pub(crate) fn bin_noise_db(row: &[f32], sorted: &mut Vec<f32>) -> f32 {
    if row.is_empty() {
        return 0.0;
    }
    sorted.clear();
    sorted.extend_from_slice(row);
    let (_, &mut quartile_db, _) = sorted.select_nth_unstable_by(row.len() / 4, f32::total_cmp);
    quartile_db - DB_PER_E_FOLD * (4.0f32 / 3.0).ln().ln()
}

/// Converts levels `10 log10(1 + P / N)`, dB, to powers over noise `P / N`, in place.
pub(crate) fn levels_to_powers(cells: &mut [f32]) {
    for cell in cells {
        let x = *cell / DB_PER_E_FOLD;
        let x = if x > MAX_LN_POWER { MAX_LN_POWER } else { x };
        *cell = x.exp_m1();
    }
}

/// Converts powers over noise `P / N` to levels `10 log10(1 + P / N)`, dB, in place.
pub(crate) fn powers_to_levels(powers: &mut [f32]) {
    /// `exp(MAX_LN_POWER)`.
    const MAX_POWER: f32 = 5.540_622_4e34;
    for power in powers.iter_mut() {
        *power = 1.0 + if *power > MAX_POWER { MAX_POWER } else { *power };
    }
    power_to_db_portable(powers, 1.0);
}

/// Power over noise of one cell of noise, drawn from its exponential distribution; never zero.
pub(crate) fn noise_power(rng: &mut impl Rng) -> f32 {
    let power: f32 = Exp1.sample(rng);
    power.max(1e-9)
}

/// Power over noise of a cell after a gain on echoes, from its `power` before. The gain in dB is weighted by
/// [`echo_share`]: it applies fully to echoes and hardly to noise. Gains of -7 and 7 dB change the mean level of noise
/// by -0.5 and 0.6 dB.
pub(crate) fn apply_echo_gain(power: f32, gain_db: f32) -> f32 {
    power * (gain_db / DB_PER_E_FOLD * echo_share(power)).exp()
}

/// Share of a cell's power over noise that counts as an echo: `power / (power + 5)`, a half at 7 dB.
pub(crate) fn echo_share(power: f32) -> f32 {
    // An infinite power is all echo.
    if power < 1e30 { power / (power + 5.0) } else { 1.0 }
}

/// Standardisation `(dB - mean) / sigma` of cells that are relative to a reference level.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Standardisation {
    /// Reference of 0 dB.
    #[serde(default, skip_serializing_if = "crate::is_default")]
    pub reference: MapReference,
    /// Mean of all cells, dB.
    pub mean_db: f64,
    /// Standard deviation of all cells, dB.
    pub sigma_db: f64,
    /// Constants by scene and class, which replace the others for maps of these scenes with these numbers of people.
    /// This is the paper's rule, which leaks the label of every map to the network.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub label_leaking_cells: Vec<SceneClassConstants>,
}

/// Mean and standard deviation of the training maps of one scene and class.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SceneClassConstants {
    /// Scene or place.
    pub scene: String,
    /// Number of people in it.
    pub class: Occupancy,
    /// Mean, dB.
    pub mean_db: f64,
    /// Standard deviation, dB.
    pub sigma_db: f64,
}

/// Error: maps cannot be standardised.
#[derive(Debug, Clone, PartialEq, Error)]
#[allow(missing_docs, reason = "the message says what each field is")]
pub enum StandardiseError {
    /// All cells are the same.
    #[error(
        "the cells of the training maps have standard deviation {sigma_db} dB about {mean_db} dB, too little to divide by (least {LEAST_SIGMA_DB} dB)\n\nhint: noise-free simulated maps sit at the dB floor; add receiver noise to the simulation"
    )]
    NoSpread { mean_db: f64, sigma_db: f64 },
    /// The cells of one scene and class cannot be standardised.
    #[error("of scene {scene} with class {class}, {cause}")]
    SceneAndClass { scene: String, class: Occupancy, cause: Box<StandardiseError> },
    /// There are no cells.
    #[error("there are no training maps to take mean and standard deviation from")]
    Empty,
}

impl Standardisation {
    /// Mean and standard deviation over all cells of all maps, in f64. The maps must be in `reference`.
    ///
    /// # Errors
    /// If there is no map, or if the cells have no spread to divide by.
    pub fn measure(
        reference: MapReference,
        maps: impl Iterator<Item = impl AsRef<[f32]>>,
    ) -> Result<Self, StandardiseError> {
        let mut moments = Moments::default();
        maps.for_each(|map| moments.add(map.as_ref()));
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
    pub(crate) fn add_scene_and_class(
        &mut self,
        scene: &str,
        class: Occupancy,
        maps: impl Iterator<Item = impl AsRef<[f32]>>,
    ) -> Result<(), StandardiseError> {
        let scene = scene.to_owned();
        match Self::measure(self.reference, maps) {
            Ok(Standardisation { mean_db, sigma_db, .. }) => {
                self.label_leaking_cells.push(SceneClassConstants { scene, class, mean_db, sigma_db });
                Ok(())
            }
            Err(cause) => Err(StandardiseError::SceneAndClass { scene, class, cause: Box::new(cause) }),
        }
    }

    /// Returns whether maps without a label cannot be standardised.
    pub fn needs_labels(&self) -> bool {
        !self.label_leaking_cells.is_empty()
    }

    /// Standardises the cells `[range][doppler]` of a map in place. `scene_and_class` are known for labelled maps only.
    pub fn apply(&self, cells: &mut [f32], doppler: usize, scene_and_class: Option<(&str, Occupancy)>) {
        self.reference.apply(cells, doppler);
        self.scale(scene_and_class).apply(cells);
    }

    /// Constants of a map. `scene_and_class` are known for labelled maps only.
    pub(crate) fn scale(&self, scene_and_class: Option<(&str, Occupancy)>) -> Scale {
        let constants = scene_and_class.and_then(|(scene, class)| {
            self.label_leaking_cells.iter().find(|constants| constants.scene == scene && constants.class == class)
        });
        match constants {
            Some(&SceneClassConstants { mean_db, sigma_db, .. }) => Scale { mean_db, sigma_db },
            None => Scale { mean_db: self.mean_db, sigma_db: self.sigma_db },
        }
    }
}

/// Mean and standard deviation by which the cells of one map are normalised.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Scale {
    mean_db: f64,
    sigma_db: f64,
}

impl Scale {
    /// Standardises cells that are already in their reference.
    pub(crate) fn apply(self, cells: &mut [f32]) {
        for cell in cells {
            *cell = ((f64::from(*cell) - self.mean_db) / self.sigma_db) as f32;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn over_noise(skip_range_bins: usize) -> MapReference {
        MapReference::OverNoise { skip_range_bins, most_db: None }
    }

    #[test]
    fn moments_are_those_of_all_cells_together() {
        let maps = [vec![1.0f32, 2.0, 3.0], vec![10.0], vec![-4.0, 0.5]];
        let all: Vec<f64> = maps.iter().flatten().map(|&v| f64::from(v)).collect();
        let mean = all.iter().sum::<f64>() / all.len() as f64;
        let variance = all.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / all.len() as f64;
        let s = Standardisation::measure(MapReference::Absolute, maps.iter().map(Vec::as_slice)).expect("spread");
        assert!((s.mean_db - mean).abs() < 1e-12 && (s.sigma_db - variance.sqrt()).abs() < 1e-12);
    }

    /// Compares with the definition in f64, from far below the noise to far above.
    #[test]
    fn over_noise_is_its_definition() {
        let mut row: Vec<f32> = (0..128).map(|i| -160.0 + 1.7 * i as f32).collect();
        let given = row.clone();
        over_noise(0).apply(&mut row, 128);
        let noise_db = f64::from(given[32]) - 10.0 * (4.0f64 / 3.0).ln().log10();
        for (given, got) in given.iter().zip(&row) {
            let expected = 10.0 * (1.0 + 10f64.powf(0.1 * (f64::from(*given) - noise_db))).log10();
            assert!((f64::from(*got) - expected).abs() < 5e-5, "{got} for {expected}");
        }
        let mut broken = given;
        broken[100] = f32::NAN;
        over_noise(0).apply(&mut broken, 128);
        assert!(broken[100].is_nan() && broken[99].is_finite());
    }

    /// Exponential noise of any level and colour gives the same cells. An echo 20 dB above it has 20 dB, and bins of leakage
    /// are hidden.
    #[test]
    fn over_noise_neither_gain_nor_colour_is_left() {
        let (range, doppler, skip) = (24, 64, 3);
        let mut rng = crate::random::stream(3, "noise", 0);
        let mut map = vec![0.0f32; range * doppler];
        for (bin, row) in map.chunks_exact_mut(doppler).enumerate() {
            let level_db = -40.0 - 0.8 * bin as f32;
            row.fill_with(|| level_db + 10.0 * (-rng.random_range(f32::MIN_POSITIVE..1.0).ln()).log10());
        }
        map[7 * doppler + 40] = -40.0 - 0.8 * 7.0 + 20.0;
        map[doppler + 40] = 0.0;
        let mut louder: Vec<f32> = map.iter().map(|db| db + 11.0).collect();
        let reference = over_noise(skip);
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

    /// Levels to powers over noise and back, from far below the noise to the largest power.
    #[test]
    fn powers_over_noise_are_their_definition() {
        let levels: Vec<f32> = (0..400).map(|i| i as f32).collect();
        let mut powers = levels.clone();
        levels_to_powers(&mut powers);
        for (level, power) in levels.iter().zip(&powers).take(340) {
            let expected = 10f64.powf(0.1 * f64::from(*level)) - 1.0;
            assert!((f64::from(*power) - expected).abs() <= 1e-4 * expected, "{power} for {expected}");
        }
        powers_to_levels(&mut powers);
        for (level, again) in levels.iter().zip(&powers) {
            assert!((level.min(347.4) - again).abs() < 0.1, "{again} for {level}");
        }
        let mut broken = [f32::NAN, f32::INFINITY];
        powers_to_levels(&mut broken);
        assert!(broken[0].is_nan() && broken[1].is_finite());
    }

    /// Clipping changes the cells above the bound only, and a NaN stays.
    #[test]
    fn a_bound_clips_strong_cells_only() {
        let given: Vec<f32> = (0..128).map(|i| -160.0 + 1.7 * i as f32).collect();
        let (mut free, mut clipped) = (given.clone(), given.clone());
        over_noise(0).apply(&mut free, 128);
        let reference = MapReference::OverNoise { skip_range_bins: 0, most_db: Some(50.0) };
        reference.apply(&mut clipped, 128);
        assert!(free.iter().any(|cell| *cell > 60.0));
        for (free, clipped) in free.iter().zip(&clipped) {
            assert_eq!(*clipped, if *free > 50.0 { 50.0 } else { *free });
        }
        let mut broken = given;
        broken[100] = f32::NAN;
        reference.apply(&mut broken, 128);
        assert!(broken[100].is_nan());
        for most_db in [0.0, -3.0, f32::NAN, f32::INFINITY] {
            assert!(MapReference::OverNoise { skip_range_bins: 0, most_db: Some(most_db) }.invalid_setting().is_some());
        }
    }

    /// References of models without a bound are read and written unchanged.
    #[test]
    fn references_without_a_bound_keep_their_bytes() {
        let old = r#"{"over_noise":{"skip_range_bins":3}}"#;
        let read: MapReference = serde_json::from_str(old).expect("an old reference");
        assert_eq!(read, over_noise(3));
        assert_eq!(serde_json::to_string(&read).expect("JSON"), old);
        let new = MapReference::OverNoise { skip_range_bins: 3, most_db: Some(50.0) };
        let text = serde_json::to_string(&new).expect("JSON");
        assert_eq!(text, r#"{"over_noise":{"skip_range_bins":3,"most_db":50.0}}"#);
        assert_eq!(serde_json::from_str::<MapReference>(&text).expect("read again"), new);
    }

    /// The gain applies fully to echoes, noise keeps its level within 0.7 dB, and the order of cells by power is kept.
    #[test]
    fn a_gain_on_echoes_leaves_noise() {
        for gain_db in [-12.0f32, -7.0, 0.0, 7.0] {
            let echo_db = 10.0 * apply_echo_gain(1e4, gain_db).log10();
            assert!((echo_db - 40.0 - gain_db).abs() < 0.02, "{echo_db} for {gain_db}");
            let powers: Vec<f32> = (0..2000).map(|i| 10f32.powf(0.003 * i as f32 - 2.0)).collect();
            assert!(powers.windows(2).all(|p| apply_echo_gain(p[0], gain_db) < apply_echo_gain(p[1], gain_db)));
        }
        let mut rng = crate::random::stream(5, "noise", 0);
        let noise: Vec<f32> = (0..20_000).map(|_| noise_power(&mut rng)).collect();
        let mean_db = |gain_db: f32| {
            let levels = noise.iter().map(|p| 10.0 * f64::from(1.0 + apply_echo_gain(*p, gain_db)).log10());
            levels.sum::<f64>() / noise.len() as f64
        };
        assert!((mean_db(0.0) - 2.59).abs() < 0.05, "{}", mean_db(0.0));
        for gain_db in [-7.0, 7.0] {
            assert!((mean_db(gain_db) - mean_db(0.0)).abs() < 0.7, "{gain_db}: {}", mean_db(gain_db));
        }
    }

    /// With the paper's rule, maps of different scenes and classes have the same mean and sigma. An error names the scene and
    /// class.
    #[test]
    fn scenes_and_classes_have_constants_of_their_own() {
        let maps = [vec![1.0f32, 3.0], vec![10.0, 20.0]];
        let mut s = Standardisation::measure(MapReference::Absolute, maps.iter().map(Vec::as_slice)).expect("spread");
        assert!(!s.needs_labels());
        for (map, class) in maps.iter().zip([Occupancy::Empty, Occupancy::One]) {
            s.add_scene_and_class("hall", class, [map.as_slice()].into_iter()).expect("a cell");
        }
        assert!(s.needs_labels());
        for (map, class) in maps.iter().zip([Occupancy::Empty, Occupancy::One]) {
            let mut map = map.clone();
            s.apply(&mut map, 2, Some(("hall", class)));
            assert_eq!(map, [-1.0, 1.0]);
        }
        let error = s.add_scene_and_class("cellar", Occupancy::Two, [&[5.0f32; 4][..]].into_iter()).expect_err("flat");
        assert!(error.to_string().starts_with("of scene cellar with class two"), "{error}");
    }

    mod hard_cases {
        use super::*;

        const ABSOLUTE: MapReference = MapReference::Absolute;

        /// Cells at the dB floor, a map of one cell, and more bins to skip than there are.
        #[test]
        fn odd_maps_stay_finite() {
            for (mut map, doppler, skip) in
                [(vec![-370.0f32; 64], 8, 2), (vec![5.0], 1, 0), (vec![100.0; 16], 4, 9), (vec![], 4, 1)]
            {
                over_noise(skip).apply(&mut map, doppler);
                assert!(map.iter().all(|v| v.is_finite()), "{map:?}");
            }
            let mut spread = vec![-370.0f32, -370.0, -370.0, 60.0];
            over_noise(0).apply(&mut spread, 4);
            assert!(spread.iter().all(|v| v.is_finite()), "{spread:?}");
        }

        #[test]
        fn maps_without_spread_are_refused_with_the_reason() {
            let flat = [-200.0f32; 16];
            let error =
                Standardisation::measure(ABSOLUTE, [&flat[..], &flat[..]].into_iter()).expect_err("sigma is zero");
            assert!(error.to_string().contains("-200 dB") && error.to_string().contains("receiver noise"), "{error}");
            assert_eq!(
                Standardisation::measure(ABSOLUTE, std::iter::empty::<Vec<f32>>()),
                Err(StandardiseError::Empty)
            );
            assert!(Standardisation::measure(ABSOLUTE, [&[f32::NAN, 1.0][..]].into_iter()).is_err());
        }
    }
}
