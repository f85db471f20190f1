//! Features of maps of people beyond mean and sigma, which compare simulated rooms with real ones.
//!
//! Powers are relative to the noise of their range bin. This noise is the lower quartile of the bin's cells off zero
//! Doppler, divided by `ln(4/3)`. The lower quartile of an exponential distribution is `ln(4/3)` times its mean.

use radome_dsp::{MapStatus, Occupancy, RdmProcessor, rdm::SpecError};
use rand_distr::{Distribution, StandardNormal};
use serde::Serialize;
use thiserror::Error;

use super::error::DatasetError;
use super::reader::Dataset;
use crate::random::stream;

/// Range bins of leakage, which are ignored.
pub use radome_dsp::detect::LEAKAGE_BINS;
/// Number of Doppler bins on either side of zero into which a window spreads static echoes.
const STATIC_CELLS: usize = 1;
/// Least distance of a second echo behind the strongest, m.
const SECOND_ECHO_DISTANCE_M: f64 = 0.6;
/// Largest distance below the peak at which bins count as filled, dB.
const FILLED_BELOW_PEAK_DB: f64 = 20.0;
/// Level below the peak down to which the width of a Doppler spectrum is measured, dB.
const WIDTH_BELOW_PEAK_DB: f64 = 25.0;
/// Least peak over noise of a map in which people are visible, dB.
const VISIBLE_PEAK_DB: f64 = 26.0;
/// Number of range bins beyond leakage whose noise counts as the noise of the map.
const NEAR_BINS: usize = 8;
/// Power over noise, a ratio, that about one cell in a map of noise exceeds.
const NOISE_EXCEEDANCE: f64 = 8.0;

/// Quantiles over maps.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Spread {
    /// Quantile of 10 %: one map in ten is below.
    pub low: f64,
    /// Median.
    pub median: f64,
    /// Quantile of 90 %: one map in ten is above.
    pub high: f64,
}

impl Spread {
    /// Quantiles of numbers in any order; `None` without numbers.
    pub fn of(mut values: Vec<f64>) -> Option<Self> {
        values.sort_by(f64::total_cmp);
        let at = |share: f64| values.get((share * values.len().saturating_sub(1) as f64).round() as usize).copied();
        Some(Spread { low: at(0.1)?, median: at(0.5)?, high: at(0.9)? })
    }
}

/// Features of the maps of one class.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ClassFeatures {
    /// The class.
    pub class: Occupancy,
    /// Number of maps of the class without transitions.
    pub maps: usize,
    /// Number of these maps that enter the features. Maps with people need a peak of 26 dB over noise or more.
    pub seen: usize,
    /// Moving power relative to the noise of the eight nearest bins, dB: a mean over Doppler, summed over range. (The
    /// figures that it is compared with do not state their definition. This is the simplest definition that gives their
    /// 13 dB for an empty room from noise alone.)
    pub moving_energy_db: Option<Spread>,
    /// Level of the strongest cell, dB over noise.
    pub peak_db: Option<Spread>,
    /// Difference between the strongest bin and the strongest one 0.6 m or more behind it, dB.
    pub second_echo_db: Option<Spread>,
    /// Share of maps in which `second_echo_db` is 13 dB at most.
    pub second_echo_share: Option<f64>,
    /// Number of range bins within 20 dB of the strongest.
    pub filled_bins: Option<Spread>,
    /// Extent of the Doppler spectrum 25 dB down, m/s.
    pub doppler_width_m_per_s: Option<Spread>,
    /// Radial speed of the strongest cell, m/s.
    pub speed_m_per_s: Option<Spread>,
}

/// Features of a dataset.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Features {
    /// Noise level in the samples, LSB: the standard deviation of white noise with the density of each range bin.
    /// Median over empty maps, or over all maps if none is empty.
    pub noise_lsb: Vec<f64>,
    /// Features by class, for classes with maps.
    pub classes: Vec<ClassFeatures>,
}

/// Error: features cannot be measured.
#[derive(Debug, Error)]
#[allow(missing_docs, reason = "the message says what each field is")]
pub enum FeatureError {
    /// A map could not be read.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// The maps' own spec cannot be applied to measure the level of noise.
    #[error(transparent)]
    Spec(#[from] SpecError),
    /// The maps have too few cells to separate noise from echoes.
    #[error(
        "maps of {range} range x {doppler} Doppler bins show too little; at least {LEAKAGE_BINS} + {NEAR_BINS} x 16 are needed"
    )]
    TooSmall { range: usize, doppler: usize },
}

/// Features of one map.
struct MapFeatures {
    /// Noise power by range bin, linear.
    noise: Vec<f64>,
    moving_energy: f64,
    peak: f64,
    second_echo_db: f64,
    filled_bins: f64,
    doppler_width_m_per_s: f64,
    speed_m_per_s: f64,
}

/// Features of the first channel of the maps with these indices.
///
/// # Errors
/// [`FeatureError::TooSmall`] if the maps have too few bins, [`FeatureError::Dataset`] if a map cannot be read, and
/// [`FeatureError::Spec`] if the dataset's map spec cannot be applied.
pub fn features(dataset: &Dataset, indices: &[usize]) -> Result<Features, FeatureError> {
    let header = dataset.header();
    let (range, doppler) = (header.shape.range, header.shape.doppler);
    if range < LEAKAGE_BINS + NEAR_BINS || doppler < 16 {
        return Err(FeatureError::TooSmall { range, doppler });
    }
    let steps = header.rdm_spec.steps(&header.waveform);
    let mut by_class: [Vec<MapFeatures>; 3] = Default::default();
    let mut maps = [0; 3];
    for &index in indices {
        let Some(row) = dataset.rows().get(index).filter(|row| !row.transition) else { continue };
        let map = map_features(&dataset.input(index, 0)?, doppler, steps);
        maps[row.label.index()] += 1;
        if row.label == Occupancy::Empty || map.peak >= 10f64.powf(0.1 * VISIBLE_PEAK_DB) {
            by_class[row.label.index()].push(map);
        }
    }
    let lsb_power = power_of_one_lsb(dataset)?;
    let noise_maps: Vec<&MapFeatures> = match by_class[Occupancy::Empty.index()].as_slice() {
        [] => by_class.iter().flatten().collect(),
        empty => empty.iter().collect(),
    };
    let noise_lsb = |bin: usize| {
        let powers = noise_maps.iter().filter_map(|map| map.noise.get(bin).copied()).collect();
        Spread::of(powers).map_or(f64::NAN, |spread| (spread.median / lsb_power).sqrt())
    };
    let classes = Occupancy::ALL.into_iter().filter(|class| maps[class.index()] > 0);
    let classes = classes.map(|class| class_features(class, maps[class.index()], &by_class[class.index()]));
    Ok(Features { noise_lsb: (0..range).map(noise_lsb).collect(), classes: classes.collect() })
}

/// Features of a class from those of its maps. `maps` is the number of all maps of the class, `seen` are those that count.
fn class_features(class: Occupancy, maps: usize, seen: &[MapFeatures]) -> ClassFeatures {
    let spread = |feature: fn(&MapFeatures) -> f64| Spread::of(seen.iter().map(feature).collect());
    let people_spread = |feature| spread(feature).filter(|_| class != Occupancy::Empty);
    let strong_second_echoes = seen.iter().filter(|map| map.second_echo_db <= 13.0).count();
    let has_people = class != Occupancy::Empty && !seen.is_empty();
    ClassFeatures {
        class,
        maps,
        seen: seen.len(),
        moving_energy_db: spread(|map| to_db(map.moving_energy)),
        peak_db: spread(|map| to_db(map.peak)),
        second_echo_db: people_spread(|map| map.second_echo_db),
        second_echo_share: has_people.then(|| strong_second_echoes as f64 / seen.len() as f64),
        filled_bins: people_spread(|map| map.filled_bins),
        doppler_width_m_per_s: people_spread(|map| map.doppler_width_m_per_s),
        speed_m_per_s: people_spread(|map| map.speed_m_per_s),
    }
}

fn to_db(power: f64) -> f64 {
    10.0 * power.max(1e-30).log10()
}

/// Features of the cells `[range][doppler]`, dB, of a map with these steps (m, m/s).
fn map_features(db_cells: &[f32], doppler: usize, (range_step_m, velocity_step_m_per_s): (f64, f64)) -> MapFeatures {
    let zero = doppler / 2;
    let is_moving = |column: usize| column.abs_diff(zero) > STATIC_CELLS;
    let powers: Vec<f64> = db_cells.iter().map(|db| 10f64.powf(0.1 * f64::from(*db))).collect();
    let noise: Vec<f64> = powers.chunks_exact(doppler).map(bin_noise).collect();
    // Largest moving power of each range bin, and of each Doppler bin.
    let mut profile = vec![0.0f64; noise.len()];
    let mut spectrum = vec![0.0f64; doppler];
    let (mut moving_energy, mut peak, mut peak_column) = (0.0, 0.0, zero);
    for (bin, (row, noise)) in powers.chunks_exact(doppler).zip(&noise).enumerate().skip(LEAKAGE_BINS) {
        for (column, power) in row.iter().enumerate().filter(|(column, _)| is_moving(*column)) {
            profile[bin] = profile[bin].max(*power);
            spectrum[column] = spectrum[column].max(*power);
            moving_energy += power;
            let over_noise = power / noise;
            if over_noise > peak {
                (peak, peak_column) = (over_noise, column);
            }
        }
    }
    // Echoes are compared without their noise, because filters attenuate the noise of a bin together with its echoes.
    let (strongest_bin, strongest) = profile
        .iter()
        .enumerate()
        .fold((0, 0.0), |(best_bin, best), (bin, &power)| if power > best { (bin, power) } else { (best_bin, best) });
    let first_behind = strongest_bin + (SECOND_ECHO_DISTANCE_M / range_step_m).ceil() as usize;
    let second = profile.iter().skip(first_behind).copied().fold(0.0, f64::max);
    let filled = profile.iter().filter(|power| **power > strongest * 10f64.powf(-0.1 * FILLED_BELOW_PEAK_DB)).count();
    // The width of a weak echo counts cells above the noise only.
    let mut sorted_noise: Vec<f64> = noise.iter().skip(LEAKAGE_BINS).copied().collect();
    let middle = sorted_noise.len() / 2;
    let median_noise = *sorted_noise.select_nth_unstable_by(middle, f64::total_cmp).1;
    let threshold = (strongest * 10f64.powf(-0.1 * WIDTH_BELOW_PEAK_DB)).max(NOISE_EXCEEDANCE * 1.5 * median_noise);
    let is_above = |column: &usize| spectrum.get(*column).is_some_and(|power| *power > threshold);
    let (low, high) = ((0..doppler).find(is_above), (0..doppler).rev().find(is_above));
    let near: Vec<f64> = noise.iter().skip(LEAKAGE_BINS).take(NEAR_BINS).copied().collect();
    let moving_columns = (0..doppler).filter(|column| is_moving(*column)).count();
    MapFeatures {
        moving_energy: moving_energy / moving_columns as f64 * near.len() as f64 / near.iter().sum::<f64>(),
        noise,
        peak,
        second_echo_db: to_db(strongest) - to_db(second),
        filled_bins: filled as f64,
        doppler_width_m_per_s: low.zip(high).map_or(0.0, |(low, high)| (high - low) as f64 * velocity_step_m_per_s),
        speed_m_per_s: peak_column.abs_diff(zero) as f64 * velocity_step_m_per_s,
    }
}

/// Noise power of a range bin, from the lower quartile of its cells off zero Doppler.
fn bin_noise(row: &[f64]) -> f64 {
    let zero = row.len() / 2;
    let is_moving = |column: usize| column.abs_diff(zero) > STATIC_CELLS;
    let mut cells: Vec<f64> =
        row.iter().enumerate().filter(|(column, _)| is_moving(*column)).map(|(_, power)| *power).collect();
    let quarter = cells.len() / 4;
    let (_, quartile, _) = cells.select_nth_unstable_by(quarter, f64::total_cmp);
    *quartile / (4.0f64 / 3.0).ln()
}

/// Power in the maps of white noise of one LSB, measured on simulated noise. It includes all scales and windows.
fn power_of_one_lsb(dataset: &Dataset) -> Result<f64, FeatureError> {
    const MAPS: u64 = 16;
    let header = dataset.header();
    let mut processor = RdmProcessor::new(&header.rdm_spec, &header.waveform)?;
    let mut map = processor.empty_map();
    let scale = header.rdm_spec.scale.affine().0 as f32;
    let mut rng = stream(1, "noise of one LSB", 0);
    let mut samples = vec![0.0f32; header.waveform.shape().codes()];
    let (mut sum, mut cells) = (0.0, 0usize);
    for sequence in 0..MAPS + header.rdm_spec.slow_time_length(&header.waveform) as u64 {
        samples.fill_with(|| scale * <StandardNormal as Distribution<f32>>::sample(&StandardNormal, &mut rng));
        // The frame has the waveform's size, so this does not fail. Frames that only initialise filters give no map.
        if !matches!(processor.process_samples(sequence, &samples, &mut map), Ok(MapStatus::Ready)) {
            continue;
        }
        let zero = map.shape.doppler / 2;
        let columns = map.db.chunks_exact(map.shape.range).take(map.shape.doppler).enumerate();
        for (_, column) in columns.filter(|(doppler_bin, _)| doppler_bin.abs_diff(zero) > STATIC_CELLS) {
            for power in column.iter().skip(LEAKAGE_BINS).map(|db| 10f64.powf(0.1 * f64::from(*db))) {
                (sum, cells) = (sum + power, cells + 1);
            }
        }
    }
    Ok(sum / cells.max(1) as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Noise of one level, an echo two range bins wide at bin 20 that moves by ten Doppler bins, and a second echo 1.2 m behind and
    /// 11 dB weaker.
    #[test]
    fn features_of_known_echoes_are_measured() {
        let (range, doppler, steps) = (64, 64, (0.15, 0.1));
        let mut rng = stream(7, "features", 0);
        let mut map: Vec<f32> = (0..range * doppler)
            .map(|_| {
                let uniform: f64 = rand::Rng::random_range(&mut rng, f64::MIN_POSITIVE..1.0);
                to_db(-uniform.ln()) as f32
            })
            .collect();
        for (bin, level_db) in [(20, 40.0), (21, 35.0), (28, 29.0)] {
            for column in 38..=47 {
                map[bin * doppler + column] = if column == 42 { level_db } else { level_db - 10.0 };
            }
        }
        let found = map_features(&map, doppler, steps);
        assert!((to_db(found.peak) - 40.0).abs() < 1.5, "{}", to_db(found.peak));
        assert!((found.second_echo_db - 11.0).abs() < 1e-3, "{}", found.second_echo_db);
        assert_eq!(found.filled_bins, 3.0);
        assert!((found.doppler_width_m_per_s - 0.9).abs() < 1e-9, "{}", found.doppler_width_m_per_s);
        assert!((found.speed_m_per_s - 1.0).abs() < 1e-9);
        let noise = found.noise.iter().sum::<f64>() / range as f64;
        assert!((noise - 1.0).abs() < 0.1, "{noise}");
    }

    #[test]
    fn quantiles_of_known_numbers() {
        let spread = Spread::of((0..=100).rev().map(f64::from).collect()).expect("some");
        assert_eq!((spread.low, spread.median, spread.high), (10.0, 50.0, 90.0));
        assert_eq!(Spread::of(Vec::new()), None);
    }
}
