//! Augmentation of training maps: random changes that imitate differences between rooms, boards and people.
//!
//! All but noise and flip work on maps over their own noise ([`MapReference::OverNoise`]). They change the power
//! `p = P / N` of a cell over the noise of its range bin; `p` of a cell of noise is exponential with mean 1. They are
//! applied in the order of the fields of [`Augmentation`] from `superpose` to `sway`. The bound of the reference,
//! standardisation, flip and noise follow.

use std::collections::BTreeMap;

use rand::Rng;
use rand_distr::{Distribution, Normal};
use rand_xoshiro::Xoshiro256PlusPlus;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::error::{TrainError, check_setting};
use crate::metrics::CLASSES;
use crate::random::stream;
use crate::standardise::{MapReference, apply_echo_gain, echo_share, levels_to_powers, noise_power, powers_to_levels};

/// Largest standard deviation of noise on cells, dB.
const MOST_NOISE_DB: f32 = 60.0;
/// Largest gain on echoes, dB. Up to it, stronger cells stay stronger.
const MOST_GAIN_DB: f32 = 15.0;
/// Largest stretch of an axis.
const MOST_STRETCH: f32 = 0.5;
/// Largest number of range bins that a map is shifted by, and largest number of stretches and bins of sway.
const MOST_BINS: usize = 256;
/// Strongest sway, dB over noise.
const MOST_SWAY_DB: f32 = 60.0;
/// Largest number of draws of a map until one is of another sequence.
const MOST_DRAWS: usize = 16;

/// Settings of the changes made to a training map each time it is used; none by default.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Augmentation {
    /// Standard deviation of Gaussian noise added to each cell, dB; 0 for none.
    pub noise_db: f32,
    /// Whether receding and approaching are exchanged in half of the maps. Zero Doppler keeps its bin.
    pub doppler_flip: bool,
    /// Addition of the echoes and the people of another map.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub superpose: Option<Superpose>,
    /// Gain on echoes above noise, uniform between these, dB; noise stays. It imitates other people, distances and orientations.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub echo_gain_db: Option<[f32; 2]>,
    /// Largest relative stretch or compression of ranges about range zero. It imitates another range step.
    #[serde(skip_serializing_if = "crate::is_default")]
    pub range_stretch: f32,
    /// Most range bins by which the map is shifted either way; vacated bins become noise. It imitates another position in the room.
    #[serde(skip_serializing_if = "crate::is_default")]
    pub range_shift_bins: usize,
    /// Largest relative stretch or compression of velocities about zero Doppler. It imitates faster and slower people.
    #[serde(skip_serializing_if = "crate::is_default")]
    pub velocity_stretch: f32,
    /// Addition of weak slow echoes. It imitates cables, curtains and desks that sway in real rooms.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sway: Option<Sway>,
}

/// Adds to a map the echoes of a map of another sequence, such that there are two people at most: the class is that of both
/// together. How many people the other map shows is drawn evenly from what is possible.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Superpose {
    /// Share of the maps to which one is added.
    pub probability: f64,
}

/// Adds slow energy about zero Doppler to maps of all classes, in stretches of neighbouring range bins. The power of a cell is
/// exponential.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Sway {
    /// Share of the maps that it is added to.
    pub probability: f64,
    /// Mean power of a stretch, drawn evenly between these, dB over noise.
    pub level_db: [f32; 2],
    /// Velocity bins at either side of zero Doppler.
    pub velocity_bins: usize,
    /// Fewest and most stretches of a map.
    pub stretches: [usize; 2],
    /// Fewest and most range bins of a stretch.
    pub stretch_bins: [usize; 2],
}

impl Default for Sway {
    fn default() -> Self {
        Sway { probability: 0.7, level_db: [0.0, 18.0], velocity_bins: 3, stretches: [1, 3], stretch_bins: [4, 16] }
    }
}

/// One use of a training map. Its random changes are a function of this.
#[derive(Debug, Clone, Copy)]
pub(super) struct MapUse {
    /// Seed of the training.
    pub seed: u64,
    /// Index of the use among those of all epochs.
    pub index: u64,
}

impl MapUse {
    fn stream(self, purpose: &str) -> Xoshiro256PlusPlus {
        stream(self.seed, purpose, self.index)
    }
}

impl Augmentation {
    /// Name of the first setting that changes how echoes move over frames; `None` if there is none.
    pub(super) fn first_motion_setting(&self) -> Option<&'static str> {
        [
            ("superpose", self.superpose.is_some()),
            ("range_stretch", self.range_stretch > 0.0),
            ("velocity_stretch", self.velocity_stretch > 0.0),
            ("sway", self.sway.is_some()),
        ]
        .into_iter()
        .find_map(|(name, is_on)| is_on.then_some(name))
    }

    /// Name of the first setting that changes powers over noise; `None` if there is none.
    pub(super) fn first_power_setting(&self) -> Option<&'static str> {
        [
            ("superpose", self.superpose.is_some()),
            ("echo_gain_db", self.echo_gain_db.is_some()),
            ("range_stretch", self.range_stretch > 0.0),
            ("range_shift_bins", self.range_shift_bins > 0),
            ("velocity_stretch", self.velocity_stretch > 0.0),
            ("sway", self.sway.is_some()),
        ]
        .into_iter()
        .find_map(|(name, is_on)| is_on.then_some(name))
    }

    /// Checks that settings are in range and can be applied to maps in `reference`.
    pub(super) fn check(&self, reference: MapReference) -> Result<(), TrainError> {
        let is_interval = |[low, high]: [f32; 2], most: f32| low >= -most && low <= high && high <= most;
        let is_count = |[low, high]: [usize; 2]| low >= 1 && low <= high && high <= MOST_BINS;
        let check_share = |name, share: f64| check_setting((0.0..=1.0).contains(&share), name, share, "0 to 1");
        let check_bins = |name, bins: usize| check_setting(bins <= MOST_BINS, name, bins, "0 to 256 bins");
        let is_sigma = (0.0..=MOST_NOISE_DB).contains(&self.noise_db);
        check_setting(is_sigma, "augmentation.noise_db", self.noise_db, "0 to 60 dB")?;
        if let Some(superpose) = self.superpose {
            check_share("augmentation.superpose.probability", superpose.probability)?;
        }
        if let Some(gain_db) = self.echo_gain_db {
            let expected = "two gains from -15 to 15 dB, the lower one first";
            let is_valid = is_interval(gain_db, MOST_GAIN_DB);
            check_setting(is_valid, "augmentation.echo_gain_db", format!("{gain_db:?}"), expected)?;
        }
        for (name, stretch) in [
            ("augmentation.range_stretch", self.range_stretch),
            ("augmentation.velocity_stretch", self.velocity_stretch),
        ] {
            check_setting((0.0..=MOST_STRETCH).contains(&stretch), name, stretch, "a part from 0 to 0.5")?;
        }
        check_bins("augmentation.range_shift_bins", self.range_shift_bins)?;
        if let Some(sway) = self.sway {
            check_share("augmentation.sway.probability", sway.probability)?;
            let expected = "two levels from -60 to 60 dB, the lower one first";
            let is_valid = is_interval(sway.level_db, MOST_SWAY_DB);
            check_setting(is_valid, "augmentation.sway.level_db", format!("{:?}", sway.level_db), expected)?;
            check_bins("augmentation.sway.velocity_bins", sway.velocity_bins)?;
            let expected = "two numbers from 1 to 256, the lower one first";
            for (name, count) in
                [("augmentation.sway.stretches", sway.stretches), ("augmentation.sway.stretch_bins", sway.stretch_bins)]
            {
                check_setting(is_count(count), name, format!("{count:?}"), expected)?;
            }
        }
        match self.first_power_setting() {
            Some(setting) if reference == MapReference::Absolute => Err(TrainError::NeedsOverNoise { setting }),
            _ => Ok(()),
        }
    }

    /// Changes the cells `[range][doppler]`, dB over noise, of a map except its first `skip` range bins. `other` is a map whose
    /// echoes are added.
    pub(super) fn change_powers(
        &self,
        cells: &mut [f32],
        other: Option<&[f32]>,
        doppler: usize,
        skip: usize,
        map_use: MapUse,
    ) {
        let doppler = doppler.max(1);
        let first = skip.saturating_mul(doppler).min(cells.len());
        let (_, powers) = cells.split_at_mut(first);
        levels_to_powers(powers);
        if let Some(other) = other {
            let mut other = other.get(first..).unwrap_or_default().to_vec();
            levels_to_powers(&mut other);
            add_echoes(powers, &other);
        }
        if let Some([low, high]) = self.echo_gain_db {
            let gain_db = map_use.stream("echo gain").random_range(low..=high);
            powers.iter_mut().for_each(|power| *power = apply_echo_gain(*power, gain_db));
        }
        let factor = |rng: &mut Xoshiro256PlusPlus, most: f32| 1.0 + f64::from(rng.random_range(-most..=most));
        if self.range_stretch > 0.0 {
            let mut rng = map_use.stream("range stretch");
            let factor = factor(&mut rng, self.range_stretch);
            stretch_range(powers, doppler, skip, factor, &mut rng);
        }
        if self.range_shift_bins > 0 {
            let mut rng = map_use.stream("range shift");
            let most = self.range_shift_bins as i64;
            let bins = rng.random_range(-most..=most);
            shift_range(powers, doppler, bins as isize, &mut rng);
        }
        if self.velocity_stretch > 0.0 {
            let mut rng = map_use.stream("velocity stretch");
            let factor = factor(&mut rng, self.velocity_stretch);
            stretch_velocity(powers, doppler, factor, &mut rng);
        }
        if let Some(sway) = self.sway {
            let mut rng = map_use.stream("sway");
            if rng.random::<f64>() < sway.probability {
                add_sway(powers, doppler, &sway, &mut rng);
            }
        }
        powers_to_levels(powers);
    }

    /// Flips a standardised map `[range][doppler]` and adds noise to it; `sigma_db` is the deviation that maps were divided by.
    pub(super) fn flip_and_add_noise(&self, cells: &mut [f32], doppler: usize, sigma_db: f32, map_use: MapUse) {
        let mut rng = map_use.stream("augmentation");
        if self.doppler_flip && rng.random::<bool>() {
            flip_doppler(cells, doppler);
        }
        let sigma = self.noise_db / sigma_db;
        if sigma > 0.0
            && let Ok(normal) = Normal::new(0.0f32, sigma)
        {
            cells.iter_mut().for_each(|v| *v += normal.sample(&mut rng));
        }
    }
}

/// Choice of maps that are added to other maps.
pub(super) struct Partners {
    probability: f64,
    /// Number of the sequence of each map.
    sequences: Vec<usize>,
    /// Positions of the maps of each class.
    by_class: [Vec<usize>; CLASSES],
}

impl Partners {
    /// Makes the choice among maps of these classes and sequences.
    pub(super) fn new<'a>(
        superpose: Superpose,
        labels: &[usize],
        sequences: impl Iterator<Item = &'a str>,
    ) -> Partners {
        let mut numbers = BTreeMap::new();
        let number = |sequence: &'a str| {
            let next = numbers.len();
            *numbers.entry(sequence).or_insert(next)
        };
        let sequences: Vec<usize> = sequences.map(number).collect();
        let by_class = std::array::from_fn(|class| (0..labels.len()).filter(|&p| labels[p] == class).collect());
        Partners { probability: superpose.probability, sequences, by_class }
    }

    /// Classes with maps that can be added to a map of this class.
    fn addable_classes(&self, label: usize) -> Vec<usize> {
        (0..CLASSES.saturating_sub(label)).filter(|&class| !self.by_class[class].is_empty()).collect()
    }

    /// Expected number of maps of each class in an epoch.
    pub(super) fn expected(&self) -> [f64; CLASSES] {
        let mut expected = [0.0; CLASSES];
        for (label, maps) in self.by_class.iter().enumerate() {
            let addable = self.addable_classes(label);
            let probability = if addable.is_empty() { 0.0 } else { self.probability };
            expected[label] += (1.0 - probability) * maps.len() as f64;
            for class in &addable {
                expected[label + class] += probability * maps.len() as f64 / addable.len() as f64;
            }
        }
        expected
    }

    /// Position of the map that is added to the map at `position` of this class; `None` if none is added.
    pub(super) fn partner(&self, position: usize, label: usize, map_use: MapUse) -> Option<usize> {
        let mut rng = map_use.stream("superpose");
        if rng.random::<f64>() >= self.probability {
            return None;
        }
        let addable = self.addable_classes(label);
        if addable.is_empty() {
            return None;
        }
        let maps = self.by_class.get(*addable.get(rng.random_range(0..addable.len()))?)?;
        let own_sequence = self.sequences.get(position)?;
        (0..MOST_DRAWS)
            .filter_map(|_| maps.get(rng.random_range(0..maps.len())).copied())
            .find(|&other| self.sequences.get(other).is_some_and(|sequence| sequence != own_sequence))
    }
}

/// Adds the echoes above noise of another map.
fn add_echoes(powers: &mut [f32], other: &[f32]) {
    for (power, other) in powers.iter_mut().zip(other) {
        *power += other * echo_share(*other);
    }
}

/// Shifts all ranges by `bins`; vacated bins are filled with noise.
fn shift_range(powers: &mut [f32], doppler: usize, bins: isize, rng: &mut impl Rng) {
    let source = powers.to_vec();
    for (bin, row) in powers.chunks_exact_mut(doppler).enumerate() {
        let from = bin.checked_add_signed(-bins);
        match from.and_then(|from| source.get(from * doppler..(from + 1) * doppler)) {
            Some(from) => row.copy_from_slice(from),
            None => row.fill_with(|| noise_power(rng)),
        }
    }
}

/// Multiplies ranges by `factor`, with linear interpolation of power between bins. The first row is range bin `first_bin`; vacated
/// rows are filled with noise.
fn stretch_range(powers: &mut [f32], doppler: usize, first_bin: usize, factor: f64, rng: &mut impl Rng) {
    let source = powers.to_vec();
    let bins = source.len() / doppler;
    for (bin, row) in powers.chunks_exact_mut(doppler).enumerate() {
        let position = (first_bin + bin) as f64 / factor - first_bin as f64;
        match neighbours(position, bins) {
            Some((low, high, part)) => {
                let (low, high) = (source.iter().skip(low * doppler), source.iter().skip(high * doppler));
                for (cell, (low, high)) in row.iter_mut().zip(low.zip(high)) {
                    *cell = low + part * (high - low);
                }
            }
            None => row.fill_with(|| noise_power(rng)),
        }
    }
}

/// Multiplies velocities by `factor`, with linear interpolation of power between bins; vacated bins are filled with noise.
fn stretch_velocity(powers: &mut [f32], doppler: usize, factor: f64, rng: &mut impl Rng) {
    let zero = (doppler / 2) as f64;
    for row in powers.chunks_exact_mut(doppler) {
        let source = row.to_vec();
        for (bin, cell) in row.iter_mut().enumerate() {
            let position = zero + (bin as f64 - zero) / factor;
            *cell = match neighbours(position, doppler) {
                Some((low, high, part)) => source[low] + part * (source[high] - source[low]),
                None => noise_power(rng),
            };
        }
    }
}

/// Bins on both sides of a position on an axis of `length` bins, and the fraction of the way from the first to the second; `None`
/// off the axis.
fn neighbours(position: f64, length: usize) -> Option<(usize, usize, f32)> {
    let last = length.checked_sub(1)?;
    if !(0.0..=last as f64).contains(&position) {
        return None;
    }
    let low = position.floor();
    Some((low as usize, (low as usize + 1).min(last), (position - low) as f32))
}

/// Adds slow energy about zero Doppler.
fn add_sway(powers: &mut [f32], doppler: usize, sway: &Sway, rng: &mut impl Rng) {
    let rows = powers.len() / doppler;
    let zero = doppler / 2;
    let slow = zero.saturating_sub(sway.velocity_bins)..(zero + sway.velocity_bins + 1).min(doppler);
    let ([few, many], [short, long], [low, high]) = (sway.stretches, sway.stretch_bins, sway.level_db);
    for _ in 0..rng.random_range(few..=many) {
        let bins = rng.random_range(short..=long).min(rows);
        let first = rng.random_range(0..=rows - bins);
        let mean = 10f32.powf(0.1 * rng.random_range(low..=high));
        for row in powers.chunks_exact_mut(doppler).skip(first).take(bins) {
            for power in row.get_mut(slow.clone()).unwrap_or_default() {
                *power += mean * noise_power(rng);
            }
        }
    }
}

/// Exchanges velocities `v` and `-v` in `[range][doppler]`. Zero is at `n / 2`; for an even n, bin 0 (the most negative
/// velocity) has no counterpart and stays.
fn flip_doppler(map: &mut [f32], doppler: usize) {
    for row in map.chunks_exact_mut(doppler) {
        if doppler.is_multiple_of(2) { row[1..].reverse() } else { row.reverse() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const DOPPLER: usize = 32;
    const RANGE: usize = 48;
    const OVER_NOISE: MapReference = MapReference::OverNoise { skip_range_bins: 3, most_db: Some(50.0) };

    /// All augmentations at once.
    fn all_augmentations() -> Augmentation {
        Augmentation {
            noise_db: 1.0,
            doppler_flip: true,
            superpose: Some(Superpose { probability: 0.5 }),
            echo_gain_db: Some([-7.0, 7.0]),
            range_stretch: 0.1,
            range_shift_bins: 6,
            velocity_stretch: 0.2,
            sway: Some(Sway { probability: 1.0, ..Sway::default() }),
        }
    }

    fn rng(index: u64) -> Xoshiro256PlusPlus {
        stream(17, "test", index)
    }

    fn noise(rows: usize, index: u64) -> Vec<f32> {
        let mut rng = rng(index);
        (0..rows * DOPPLER).map(|_| noise_power(&mut rng)).collect()
    }

    fn mean(powers: &[f32]) -> f64 {
        powers.iter().map(|p| f64::from(*p)).sum::<f64>() / powers.len() as f64
    }

    #[test]
    fn flipping_keeps_zero_doppler_and_is_its_own_inverse() {
        let mut even = vec![-3.0, -2.0, -1.0, 0.0, 1.0, 2.0];
        flip_doppler(&mut even, 6);
        assert_eq!(even, [-3.0, 2.0, 1.0, 0.0, -1.0, -2.0]);
        let mut odd = vec![-1.0, 0.0, 1.0];
        flip_doppler(&mut odd, 3);
        assert_eq!(odd, [1.0, 0.0, -1.0]);
        for doppler in [1, 2, 31, 32] {
            let given: Vec<f32> = (0..4 * doppler).map(|i| i as f32).collect();
            let mut twice = given.clone();
            flip_doppler(&mut twice, doppler);
            flip_doppler(&mut twice, doppler);
            assert_eq!(twice, given);
        }
    }

    /// Shifted cells keep their power, and vacated bins have the level of noise.
    #[test]
    fn a_shift_keeps_cells_inside_the_map() {
        for bins in [-7isize, -1, 0, 4, 8, 200] {
            let given: Vec<f32> = (0..RANGE * DOPPLER).map(|i| 100.0 + i as f32).collect();
            let mut shifted = given.clone();
            shift_range(&mut shifted, DOPPLER, bins, &mut rng(1));
            let mut vacated = Vec::new();
            for bin in 0..RANGE as isize {
                let row = &shifted[bin as usize * DOPPLER..][..DOPPLER];
                let from = bin - bins;
                if (0..RANGE as isize).contains(&from) {
                    assert_eq!(row, &given[from as usize * DOPPLER..][..DOPPLER], "bin {bin} by {bins}");
                } else {
                    vacated.extend_from_slice(row);
                }
            }
            assert_eq!(vacated.len() / DOPPLER, bins.unsigned_abs().min(RANGE));
            if vacated.len() > 100 {
                assert!((mean(&vacated) - 1.0).abs() < 0.3, "{bins}: {}", mean(&vacated));
            }
        }
    }

    /// Stretches agree with their definition, cell by cell, in f64.
    #[test]
    fn stretches_agree_with_their_definition() {
        let given = noise(RANGE, 2);
        let at = |bin: f64, column: f64, first: f64| {
            let value = |bin: f64, column: f64| {
                let inside = (0.0..RANGE as f64).contains(&bin) && (0.0..DOPPLER as f64).contains(&column);
                inside.then(|| f64::from(given[bin as usize * DOPPLER + column as usize]))
            };
            let (bin, column) = (bin - first, column);
            let (part_b, part_c) = (bin - bin.floor(), column - column.floor());
            let corners = [(0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (1.0, 1.0)].map(|(b, c)| {
                let weight = (1.0 - part_b - b + 2.0 * part_b * b) * (1.0 - part_c - c + 2.0 * part_c * c);
                if weight == 0.0 { Some(0.0) } else { value(bin.floor() + b, column.floor() + c).map(|v| v * weight) }
            });
            corners.into_iter().sum::<Option<f64>>()
        };
        for factor in [0.7, 0.95, 1.0, 1.1, 1.5] {
            let (first, zero) = (3.0, (DOPPLER / 2) as f64);
            let (mut far, mut fast) = (given.clone(), given.clone());
            stretch_range(&mut far, DOPPLER, 3, factor, &mut rng(3));
            stretch_velocity(&mut fast, DOPPLER, factor, &mut rng(4));
            if factor == 1.0 {
                assert_eq!((&far, &fast), (&given, &given));
            }
            let mut vacated = 0;
            for (i, (far, fast)) in far.iter().zip(&fast).enumerate() {
                let (bin, column) = ((i / DOPPLER) as f64, (i % DOPPLER) as f64);
                let by_range = at((first + bin) / factor, column, first);
                let by_velocity = at(bin, zero + (column - zero) / factor, 0.0);
                for (got, expected) in [(*far, by_range), (*fast, by_velocity)] {
                    match expected {
                        Some(expected) => {
                            let error = (f64::from(got) - expected).abs();
                            assert!(error < 1e-4 * (1.0 + expected), "{got} for {expected}");
                        }
                        None => vacated += 1,
                    }
                }
            }
            assert_eq!(vacated > 0, factor != 1.0, "{factor}: {vacated}");
        }
    }

    #[test]
    fn a_gain_moves_echoes_and_leaves_noise_and_leakage() {
        let skip = 3;
        let mut levels = noise(RANGE, 5);
        levels[20 * DOPPLER + 9] = 1e3;
        powers_to_levels(&mut levels);
        for gain_db in [-7.0f32, 7.0] {
            let augmentation = Augmentation { echo_gain_db: Some([gain_db; 2]), ..Augmentation::default() };
            let mut changed = levels.clone();
            augmentation.change_powers(&mut changed, None, DOPPLER, skip, MapUse { seed: 1, index: 2 });
            let echo = 20 * DOPPLER + 9;
            assert!((changed[echo] - levels[echo] - gain_db).abs() < 0.1, "{} {}", changed[echo], levels[echo]);
            assert_eq!(changed[..skip * DOPPLER], levels[..skip * DOPPLER]);
            assert!((mean(&changed) - mean(&levels)).abs() < 0.8, "{gain_db}: {} {}", mean(&changed), mean(&levels));
            // A setting without a gain changes nothing.
            let none = Augmentation { echo_gain_db: Some([0.0; 2]), ..Augmentation::default() };
            let mut same = levels.clone();
            none.change_powers(&mut same, None, DOPPLER, skip, MapUse { seed: 1, index: 2 });
            assert!(same.iter().zip(&levels).all(|(a, b)| (a - b).abs() < 1e-4));
        }
    }

    /// Sway is in its range of velocities, has its level, and changes no other cells.
    #[test]
    fn sway_is_slow_and_has_its_level() {
        let sway =
            Sway { probability: 1.0, level_db: [20.0; 2], velocity_bins: 2, stretches: [1, 1], stretch_bins: [10, 10] };
        let mut added = Vec::new();
        for index in 0..40 {
            let mut powers = vec![0.0; RANGE * DOPPLER];
            add_sway(&mut powers, DOPPLER, &sway, &mut rng(index));
            let touched: Vec<usize> = (0..powers.len()).filter(|&i| powers[i] > 0.0).collect();
            assert_eq!(touched.len(), 10 * 5);
            assert!(touched.iter().all(|i| (i % DOPPLER).abs_diff(DOPPLER / 2) <= 2));
            assert_eq!(touched[touched.len() - 1] / DOPPLER - touched[0] / DOPPLER, 9);
            added.extend(touched.iter().map(|&i| powers[i]));
        }
        assert!((mean(&added) / 100.0 - 1.0).abs() < 0.1, "{}", mean(&added));
        // Exponential: a share of 1 - 1/e is below the mean.
        let below = added.iter().filter(|p| **p < 100.0).count() as f64 / added.len() as f64;
        assert!((below - 0.632).abs() < 0.05, "{below}");
    }

    /// The class of superposed maps is the sum of both, at most two, and their sequences differ.
    #[test]
    fn people_of_two_maps_add_up() {
        let labels: Vec<usize> = (0..90).map(|i| i % 3).collect();
        let names: Vec<String> = (0..90).map(|i| format!("s{}", i / 9)).collect();
        let superpose = Superpose { probability: 0.5 };
        let partners = Partners::new(superpose, &labels, names.iter().map(String::as_str));
        let mut counts = [0.0f64; 3];
        let epochs = 200;
        for epoch in 0..epochs {
            for (position, &label) in labels.iter().enumerate() {
                let other = partners.partner(position, label, MapUse { seed: 3, index: epoch * 90 + position as u64 });
                if let Some(other) = other {
                    assert_ne!(names[other], names[position]);
                }
                let together = label + other.map_or(0, |other| labels[other]);
                assert!(together <= 2);
                counts[together] += 1.0 / epochs as f64;
            }
        }
        // Half of the 30 maps of each class get another map: a third of the empty ones go to each class, half of those of one to two.
        let expected = partners.expected();
        assert!((expected[0] - 20.0).abs() < 1e-9 && (expected[1] - 27.5).abs() < 1e-9, "{expected:?}");
        assert!((expected.iter().sum::<f64>() - 90.0).abs() < 1e-9);
        assert!(counts.iter().zip(expected).all(|(count, expected)| (count - expected).abs() < 1.0), "{counts:?}");
        // Powers of echoes add, and the noise below them does not double.
        let (mut a, mut b) = (noise(RANGE, 6), noise(RANGE, 7));
        (a[5], b[5], a[6], b[7]) = (1e4, 1e4, 1e4, 1e4);
        let before = a.clone();
        add_echoes(&mut a, &b);
        assert!((a[5] / 2e4 - 1.0).abs() < 1e-3 && (a[6] / 1e4 - 1.0).abs() < 1e-3 && (a[7] / 1e4 - 1.0).abs() < 1e-3);
        assert!(mean(&a[8..]) / mean(&before[8..]) < 1.4);
        // With one sequence there is no partner.
        let alone = Partners::new(Superpose { probability: 1.0 }, &labels, labels.iter().map(|_| "the same"));
        assert_eq!(alone.partner(0, 0, MapUse { seed: 3, index: 0 }), None);
    }

    /// Changes depend on the use of a map only.
    #[test]
    fn changes_are_a_function_of_the_use() {
        let mut levels = noise(RANGE, 8);
        powers_to_levels(&mut levels);
        let change = |index| {
            let mut changed = levels.clone();
            all_augmentations().change_powers(&mut changed, None, DOPPLER, 3, MapUse { seed: 5, index });
            all_augmentations().flip_and_add_noise(&mut changed, DOPPLER, 3.0, MapUse { seed: 5, index });
            changed
        };
        assert_eq!(change(1), change(1));
        assert_ne!(change(1), change(2));
    }

    /// Old training files are read as before, written as before, and a misspelt key is no setting.
    #[test]
    fn settings_are_read_by_name() {
        let old = Augmentation { noise_db: 1.0, doppler_flip: true, ..Augmentation::default() };
        assert_eq!(serde_json::to_string(&old).expect("JSON"), r#"{"noise_db":1.0,"doppler_flip":true}"#);
        let text = serde_json::to_string(&all_augmentations()).expect("JSON");
        assert_eq!(serde_json::from_str::<Augmentation>(&text).expect("settings"), all_augmentations());
        let sway: Augmentation = serde_json::from_str(r#"{"sway":{"probability":0.7}}"#).expect("settings");
        assert_eq!(sway.sway, Some(Sway::default()));
        assert!(serde_json::from_str::<Augmentation>(r#"{"echo_gain":[0,1]}"#).is_err());
    }

    mod hard_cases {
        use super::*;

        /// Finite maps stay finite: at zero, at enormous levels, of odd shapes, and with more bins to skip than they have.
        #[test]
        fn finite_maps_stay_finite() {
            for (cells, doppler, skip) in [
                (vec![0.0f32; 12], 4, 1),
                (vec![1e30; 64], 8, 0),
                (vec![350.0; 64], 8, 3),
                (vec![3.0], 1, 0),
                (vec![3.0; 6], 3, 9),
                (Vec::new(), 4, 2),
            ] {
                for index in 0..20 {
                    let (mut changed, map_use) = (cells.clone(), MapUse { seed: 2, index });
                    all_augmentations().change_powers(&mut changed, Some(&cells), doppler, skip, map_use);
                    assert!(changed.iter().all(|v| v.is_finite() && *v >= 0.0), "{changed:?}");
                    all_augmentations().flip_and_add_noise(&mut changed, doppler, 3.0, map_use);
                    assert!(changed.iter().all(|v| v.is_finite()), "{changed:?}");
                }
            }
        }

        #[test]
        fn settings_out_of_range_are_named() {
            let sway = Sway::default();
            let with = |sway: Sway| Augmentation { sway: Some(sway), ..Augmentation::default() };
            let none = Augmentation::default();
            for (bad, name) in [
                (Augmentation { noise_db: -1.0, ..none }, "noise_db"),
                (Augmentation { noise_db: 1e30, ..none }, "noise_db"),
                (Augmentation { noise_db: f32::NAN, ..none }, "noise_db"),
                (Augmentation { echo_gain_db: Some([3.0, -3.0]), ..none }, "echo_gain_db"),
                (Augmentation { echo_gain_db: Some([f32::NAN, 3.0]), ..none }, "echo_gain_db"),
                (Augmentation { range_stretch: 0.9, ..none }, "range_stretch"),
                (Augmentation { velocity_stretch: f32::NAN, ..none }, "velocity_stretch"),
                (Augmentation { range_shift_bins: 100_000, ..none }, "range_shift_bins"),
                (Augmentation { superpose: Some(Superpose { probability: 1.5 }), ..none }, "superpose.probability"),
                (with(Sway { probability: -0.1, ..sway }), "sway.probability"),
                (with(Sway { level_db: [0.0, f32::INFINITY], ..sway }), "sway.level_db"),
                (with(Sway { stretches: [0, 1], ..sway }), "sway.stretches"),
                (with(Sway { stretch_bins: [9, 2], ..sway }), "sway.stretch_bins"),
                (with(Sway { velocity_bins: 1000, ..sway }), "sway.velocity_bins"),
            ] {
                let error = bad.check(OVER_NOISE).expect_err("out of range").to_string();
                assert!(error.contains(name), "{name}: {error}");
            }
            assert!(all_augmentations().check(OVER_NOISE).is_ok());
        }

        /// Maps of an absolute reference have no powers over noise. Noise and flip do not need them.
        #[test]
        fn absolute_maps_are_refused_where_noise_must_be_known() {
            let error = all_augmentations().check(MapReference::Absolute).expect_err("no noise").to_string();
            assert!(error.contains("superpose") && error.contains("hint:") && error.contains("over_noise"), "{error}");
            let simple = Augmentation { noise_db: 2.0, doppler_flip: true, ..Augmentation::default() };
            assert!(simple.check(MapReference::Absolute).is_ok());
        }
    }
}
