//! Mean and sigma of the cells of maps by domain, scene and class: the paper's table.

use std::collections::BTreeMap;

use radome_dsp::Occupancy;
use serde::{Deserialize, Serialize};

use super::error::DatasetError;
use super::manifest::Domain;
use super::reader::Dataset;
use crate::interval::t_interval;

/// Count, mean and standard deviation of numbers that come in blocks (Welford's update, block by block, in f64).
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Moments {
    count: f64,
    mean: f64,
    /// Sum of the squared deviations from the mean.
    squared_deviations: f64,
}

impl Moments {
    /// Adds a block.
    pub fn add(&mut self, block: &[f32]) {
        self.merge(&Self::of(block));
    }

    /// Moments of one block.
    fn of(block: &[f32]) -> Self {
        if block.is_empty() {
            return Self::default();
        }
        let count = block.len() as f64;
        let mean = block.iter().map(|&v| f64::from(v)).sum::<f64>() / count;
        Moments { count, mean, squared_deviations: block.iter().map(|&v| (f64::from(v) - mean).powi(2)).sum() }
    }

    fn merge(&mut self, other: &Self) {
        if other.count == 0.0 {
            return;
        }
        let delta = other.mean - self.mean;
        self.squared_deviations +=
            other.squared_deviations + delta * delta * self.count * other.count / (self.count + other.count);
        self.mean += delta * other.count / (self.count + other.count);
        self.count += other.count;
    }

    /// Moments of the values that remain without `part`; `None` if none remain.
    fn without(&self, part: &Self) -> Option<Self> {
        let count = self.count - part.count;
        if count <= 0.0 {
            return None;
        }
        let mean = self.mean + (self.mean - part.mean) * part.count / count;
        let delta = part.mean - mean;
        let squared_deviations =
            self.squared_deviations - part.squared_deviations - delta * delta * count * part.count / self.count;
        Some(Moments { count, mean, squared_deviations: squared_deviations.max(0.0) })
    }

    /// Number of values.
    pub fn count(&self) -> f64 {
        self.count
    }

    /// Mean; 0 without values.
    pub fn mean(&self) -> f64 {
        self.mean
    }

    /// Standard deviation about the mean; NaN without values.
    pub fn sigma(&self) -> f64 {
        (self.squared_deviations / self.count).sqrt()
    }
}

/// Row of the table: statistics of the maps of one domain, scene and class.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct GroupStatistics {
    /// Scene or place.
    pub scene: String,
    /// The class.
    pub class: Occupancy,
    /// Source of the frames.
    pub domain: Domain,
    /// Number of maps.
    pub maps: usize,
    /// Number of sequences of these maps.
    pub sequences: usize,
    /// Mean of all cells of all maps, dB.
    pub mean_db: f64,
    /// Half width of the 95 % interval of `mean_db`, dB. The interval is over sequences, because frames of one sequence
    /// are alike. `None` for one sequence.
    pub mean_half_width_db: Option<f64>,
    /// Standard deviation of the cells, dB.
    pub sigma_db: f64,
    /// Half width of the 95 % interval of `sigma_db` over sequences, dB. `None` for one sequence.
    pub sigma_half_width_db: Option<f64>,
    /// Share `p` of the empty scene's cells that people raise by `U` dB. The mean then rises by `p U` and the variance
    /// by `p (1 - p) U^2`. `None` for empty scenes, if there is no empty map of the same scene and domain, or if mean
    /// or variance did not rise.
    pub raised_fraction: Option<f64>,
    /// Level `U` by which these cells are raised, dB.
    pub raised_level_db: Option<f64>,
}

/// Moments of the maps of one row.
#[derive(Default)]
struct GroupMaps<'a> {
    /// Number of maps.
    count: usize,
    all: Moments,
    by_sequence: BTreeMap<&'a str, Moments>,
}

impl GroupMaps<'_> {
    /// Half width of the 95 % interval of a statistic of all maps, over sequences. It is the t interval of the jackknife's
    /// pseudo-values (B. Efron and C. Stein, "The jackknife estimate of variance", Annals of Statistics 9, 1981). For the mean of
    /// sequences of equal length, it is the t interval of their means.
    fn half_width(&self, statistic: fn(&Moments) -> f64) -> Option<f64> {
        let count = self.by_sequence.len() as f64;
        let pseudo_value =
            |part: &Moments| Some(count * statistic(&self.all) - (count - 1.0) * statistic(&self.all.without(part)?));
        let values: Option<Vec<f64>> = self.by_sequence.values().map(pseudo_value).collect();
        t_interval(&values?)?.half_width
    }
}

/// Computes the table over the maps with these indices, by domain, scene and class.
///
/// # Errors
/// Those of [`Dataset::map`].
pub fn statistics(dataset: &Dataset, indices: &[usize]) -> Result<Vec<GroupStatistics>, DatasetError> {
    let mut groups: BTreeMap<(Domain, &str, Occupancy), GroupMaps> = BTreeMap::new();
    for &index in indices {
        let map = dataset.map(index)?;
        let Some(row) = dataset.rows().get(index) else { continue };
        let (group, moments) = (groups.entry((row.domain, &row.scene, row.label)).or_default(), Moments::of(&map));
        group.count += 1;
        group.all.merge(&moments);
        group.by_sequence.entry(&row.sequence).or_default().merge(&moments);
    }
    let row = |(&(domain, scene, class), maps): (&(Domain, &str, Occupancy), &GroupMaps)| {
        let empty = groups.get(&(domain, scene, Occupancy::Empty)).filter(|_| class != Occupancy::Empty);
        let raised = empty.and_then(|empty| raised_fraction_and_level(&empty.all, &maps.all));
        GroupStatistics {
            scene: scene.to_owned(),
            class,
            domain,
            maps: maps.count,
            sequences: maps.by_sequence.len(),
            mean_db: maps.all.mean(),
            mean_half_width_db: maps.half_width(Moments::mean),
            sigma_db: maps.all.sigma(),
            sigma_half_width_db: maps.half_width(Moments::sigma),
            raised_fraction: raised.map(|(fraction, _)| fraction),
            raised_level_db: raised.map(|(_, level)| level),
        }
    };
    Ok(groups.iter().map(row).collect())
}

/// Share of the cells that people raise above those of the empty scene, and level by which they raise them, dB. `None` if mean or
/// variance did not rise.
fn raised_fraction_and_level(empty: &Moments, with_people: &Moments) -> Option<(f64, f64)> {
    let mean = with_people.mean() - empty.mean();
    let variance = with_people.sigma().powi(2) - empty.sigma().powi(2);
    if !(mean > 0.0 && variance > 0.0) {
        return None;
    }
    let level_db = variance / mean + mean;
    Some((mean / level_db, level_db))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn moments(mean: f64, sigma: f64) -> Moments {
        Moments { count: 1e6, mean, squared_deviations: 1e6 * sigma * sigma }
    }

    /// Shares and levels that follow from the paper's table of real maps.
    #[test]
    fn the_papers_table_gives_the_published_shares() {
        let (corridor, room) = (moments(-24.98, 5.48), moments(-24.63, 5.52));
        for (empty, mean, sigma, fraction, level_db) in [
            (corridor, -24.55, 5.83, 0.045, 9.6),
            (corridor, -24.36, 5.90, 0.074, 8.3),
            (room, -24.40, 5.70, 0.026, 9.0),
            (room, -24.19, 5.67, 0.103, 4.3),
        ] {
            let (p, u) = raised_fraction_and_level(&empty, &moments(mean, sigma)).expect("raised");
            assert!((p - fraction).abs() < 5e-4 && (u - level_db).abs() < 0.05, "{p} {u}");
        }
        assert_eq!(raised_fraction_and_level(&corridor, &moments(-25.0, 5.5)), None);
    }

    /// The interval is the t interval of the means of sequences of equal length. One sequence has none.
    #[test]
    fn intervals_are_over_sequences() {
        let sequences: [[f32; 2]; 3] = [[1.0, 3.0], [2.0, 6.0], [6.0, 6.0]];
        let mut maps = GroupMaps::default();
        for (name, cells) in ["a", "b", "c"].into_iter().zip(sequences) {
            maps.all.add(&cells);
            maps.by_sequence.entry(name).or_default().add(&cells);
        }
        let expected = t_interval(&[2.0, 4.0, 6.0]).and_then(|interval| interval.half_width).expect("a width");
        let found = maps.half_width(Moments::mean).expect("a width");
        assert!((found - expected).abs() < 1e-9, "{found} {expected}");
        // Moments without a sequence are those of the others.
        let (mut others, part) = (Moments::of(&sequences[0]), Moments::of(&sequences[1]));
        others.add(&sequences[2]);
        let remaining = maps.all.without(&part).expect("the others");
        assert!((remaining.mean() - others.mean()).abs() < 1e-12, "{remaining:?}");
        assert!((remaining.sigma() - others.sigma()).abs() < 1e-12, "{remaining:?}");
        maps.by_sequence = BTreeMap::from([("all", maps.all)]);
        assert_eq!(maps.half_width(Moments::mean), None);
    }

    #[test]
    fn a_mixture_gives_back_its_share_and_level() {
        let spread = |k: u64| (k.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 40) as f32 / (1u64 << 24) as f32;
        let noise: Vec<f32> = (0..100_000).map(|k| 20.0 * spread(k)).collect();
        let raised_cells: Vec<f32> =
            noise.iter().enumerate().map(|(k, v)| if k % 20 == 0 { v + 9.0 } else { *v }).collect();
        let (mut empty, mut people) = (Moments::default(), Moments::default());
        noise.chunks(97).for_each(|block| empty.add(block));
        raised_cells.chunks(1000).for_each(|block| people.add(block));
        let (p, u) = raised_fraction_and_level(&empty, &people).expect("raised");
        // The choice of raised cells is independent of their noise.
        assert!((p - 0.05).abs() < 2e-3 && (u - 9.0).abs() < 0.3, "{p} {u}");
    }
}
