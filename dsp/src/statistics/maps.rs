//! Statistics of sets of maps, and distances between two sets, such as recorded and simulated maps.
//!
//! Cells are counted in histograms, so memory does not grow with the number of maps. Statistics can be added: those of
//! a resampled set of recordings are the sum of those of its recordings.

use std::ops::Range;

use crate::Rdm;

/// Width of the steps of a histogram, dB. They begin at [`LEAST_DB`]; cells beyond either end count in the last step there.
const STEP_DB: f64 = 0.05;
const LEAST_DB: f64 = -250.0;
const STEPS: usize = 7000;
/// Mean of the level of an exponentially distributed power, over the level of its mean, dB.
const NOISE_MEAN_DB: f64 = -2.506_818;
/// Variance of the level of an exponentially distributed power, dB^2.
const NOISE_VARIANCE_DB2: f64 = 31.025_36;
/// Least significant excess of a mean, dB. The level of the noise is not known more accurately.
const LEAST_RAISED_DB: f64 = 0.05;

/// Distribution of the levels of cells, dB.
///
/// ```
/// use radome_dsp::statistics::CellHistogram;
///
/// let (mut first, mut second) = (CellHistogram::default(), CellHistogram::default());
/// for cell_db in [-61.0, -60.0, -59.0] {
///     first.add(cell_db);
///     second.add(cell_db + 2.0);
/// }
/// let distance = first.distance_to(&second).expect("neither is empty");
/// assert!((distance.mean_db - 2.0).abs() < 1e-9);
/// ```
#[derive(Debug, Clone, Default, PartialEq)]
pub struct CellHistogram {
    count: u64,
    sum: f64,
    squares: f64,
    /// Counts by step; empty while there are no cells.
    counts: Vec<u64>,
}

/// Differences between two distributions of cells: the second less the first where they have a sign.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CellDistance {
    /// Difference of the means, dB.
    pub mean_db: f64,
    /// Difference of the standard deviations, dB.
    pub sigma_db: f64,
    /// Kolmogorov-Smirnov distance, 0 to 1.
    pub kolmogorov_smirnov: f64,
    /// Wasserstein distance of order one, dB.
    pub wasserstein_db: f64,
}

impl CellHistogram {
    /// Counts a cell. A level that is not finite is left out.
    pub fn add(&mut self, cell_db: f64) {
        if !cell_db.is_finite() {
            return;
        }
        self.counts.resize(STEPS, 0);
        let step = ((cell_db - LEAST_DB) / STEP_DB).max(0.0) as usize;
        if let Some(count) = self.counts.get_mut(step.min(STEPS - 1)) {
            *count += 1;
        }
        self.count += 1;
        self.sum += cell_db;
        self.squares += cell_db * cell_db;
    }

    /// Adds the cells of another distribution.
    pub fn merge(&mut self, other: &CellHistogram) {
        self.counts.resize(self.counts.len().max(other.counts.len()), 0);
        self.counts.iter_mut().zip(&other.counts).for_each(|(a, b)| *a += b);
        self.count += other.count;
        self.sum += other.sum;
        self.squares += other.squares;
    }

    /// Number of cells.
    pub fn count(&self) -> u64 {
        self.count
    }

    /// Mean, dB; 0 if there are no cells.
    pub fn mean_db(&self) -> f64 {
        self.sum / self.count.max(1) as f64
    }

    /// Standard deviation, dB; 0 if there are no cells.
    pub fn sigma_db(&self) -> f64 {
        (self.squares / self.count.max(1) as f64 - self.mean_db().powi(2)).max(0.0).sqrt()
    }

    /// Distance of another distribution from this one; `None` if either is empty.
    pub fn distance_to(&self, other: &CellHistogram) -> Option<CellDistance> {
        if self.count == 0 || other.count == 0 {
            return None;
        }
        let (total_a, total_b) = (self.count as f64, other.count as f64);
        let (mut below_a, mut below_b, mut greatest, mut area) = (0u64, 0u64, 0f64, 0.0);
        for (count_a, count_b) in self.counts.iter().zip(&other.counts) {
            below_a += count_a;
            below_b += count_b;
            // Difference of the cumulative distributions.
            let difference = (below_a as f64 / total_a - below_b as f64 / total_b).abs();
            greatest = greatest.max(difference);
            area += difference * STEP_DB;
        }
        Some(CellDistance {
            mean_db: other.mean_db() - self.mean_db(),
            sigma_db: other.sigma_db() - self.sigma_db(),
            kolmogorov_smirnov: greatest,
            wasserstein_db: area,
        })
    }
}

/// Range bins of maps that enter the statistics.
#[derive(Debug, Clone, PartialEq)]
pub struct Regions {
    /// First range bin that is used; bins below hold leakage.
    pub first_bin: usize,
    /// Range bins of a person; empty if there is none.
    pub target: Range<usize>,
}

/// Statistics of a set of maps: distributions of cells, and profiles of power along velocity and range.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct MapStatistics {
    /// Cells of all range bins that are used.
    pub all: CellHistogram,
    /// Cells of the range bins of a person.
    pub target: CellHistogram,
    /// Cells of zero Doppler of maps without static removal.
    pub zero_doppler: CellHistogram,
    /// Moments of the cells off zero Doppler, by range bin.
    off_zero_doppler: Vec<Moments>,
    /// Power of each Doppler row.
    doppler: Vec<f64>,
    /// Power of each range column.
    range: Vec<f64>,
}

/// Count, sum and sum of squares of levels in dB.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct Moments {
    count: f64,
    sum: f64,
    squares: f64,
}

/// Differences between the statistics of two sets of maps.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MapDistance {
    /// Distance of all cells.
    pub all: CellDistance,
    /// Distance of the cells of a person; `None` if either set has none.
    pub target: Option<CellDistance>,
    /// Distance of the cells of zero Doppler; `None` if either set has none.
    pub zero_doppler: Option<CellDistance>,
    /// Wasserstein distance between the profiles of power along velocity, in cells.
    pub doppler_cells: f64,
    /// Wasserstein distance between the profiles of power along range, in cells.
    pub range_cells: f64,
}

/// Model of cells as a mixture of noise and raised noise: two numbers that summarise everything above the noise.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RaisedCells {
    /// Share of the cells that are raised, 0..1.
    pub fraction: f64,
    /// Excess of the raised cells over noise, dB.
    pub level_db: f64,
}

impl MapStatistics {
    /// Adds one receiver of a map with static removal.
    pub fn add(&mut self, map: &Rdm, rx: usize, regions: &Regions) {
        let (doppler, range) = (map.shape.doppler, map.shape.range);
        self.doppler.resize(doppler, 0.0);
        self.range.resize(range, 0.0);
        self.off_zero_doppler.resize(range, Moments::default());
        for (row, cells) in map.db.chunks(range.max(1)).skip(rx * doppler).take(doppler).enumerate() {
            // Static removal removes noise too, within the main lobe of the window over slow time.
            let is_off_zero_doppler = row.abs_diff(doppler / 2) > 1;
            for (bin, &cell) in cells.iter().enumerate().skip(regions.first_bin).filter(|(_, cell)| cell.is_finite()) {
                let cell = f64::from(cell);
                let power = 10f64.powf(0.1 * cell);
                self.all.add(cell);
                self.doppler[row] += power;
                self.range[bin] += power;
                if regions.target.contains(&bin) {
                    self.target.add(cell);
                }
                if is_off_zero_doppler {
                    let moments = &mut self.off_zero_doppler[bin];
                    moments.count += 1.0;
                    moments.sum += cell;
                    moments.squares += cell * cell;
                }
            }
        }
    }

    /// Adds the row of zero Doppler of one receiver of a map without static removal.
    pub fn add_zero_doppler(&mut self, map: &Rdm, rx: usize, regions: &Regions) {
        let (doppler, range) = (map.shape.doppler, map.shape.range);
        let row = map.db.chunks(range.max(1)).nth(rx * doppler + doppler / 2).unwrap_or_default();
        row.iter().skip(regions.first_bin).for_each(|&cell| self.zero_doppler.add(f64::from(cell)));
    }

    /// Adds the statistics of another set.
    pub fn merge(&mut self, other: &MapStatistics) {
        self.all.merge(&other.all);
        self.target.merge(&other.target);
        self.zero_doppler.merge(&other.zero_doppler);
        self.off_zero_doppler.resize(self.off_zero_doppler.len().max(other.off_zero_doppler.len()), Moments::default());
        for (mine, others) in self.off_zero_doppler.iter_mut().zip(&other.off_zero_doppler) {
            mine.count += others.count;
            mine.sum += others.sum;
            mine.squares += others.squares;
        }
        for (mine, others) in [(&mut self.doppler, &other.doppler), (&mut self.range, &other.range)] {
            mine.resize(mine.len().max(others.len()), 0.0);
            mine.iter_mut().zip(others).for_each(|(a, b)| *a += b);
        }
    }

    /// Share and excess of the cells above noise, from the mean and variance of all cells off zero Doppler. `noise_db` is the mean
    /// noise power by range bin, dB. `None` if nothing exceeds the noise.
    pub fn raised(&self, noise_db: &[f64]) -> Option<RaisedCells> {
        let (mut count, mut sum, mut squares) = (0.0, 0.0, 0.0);
        for (bin, noise) in self.off_zero_doppler.iter().zip(noise_db) {
            count += bin.count;
            sum += bin.sum - bin.count * noise;
            squares += bin.squares - 2.0 * noise * bin.sum + bin.count * noise * noise;
        }
        let mean = sum / count - NOISE_MEAN_DB;
        let variance = squares / count - (sum / count).powi(2) - NOISE_VARIANCE_DB2;
        // Both are NaN without cells.
        if !(mean > LEAST_RAISED_DB && variance > 0.0) {
            return None;
        }
        let level_db = variance / mean + mean;
        Some(RaisedCells { fraction: mean / level_db, level_db })
    }

    /// Distance of another set from this one; `None` if either is empty.
    pub fn distance_to(&self, other: &MapStatistics) -> Option<MapDistance> {
        Some(MapDistance {
            all: self.all.distance_to(&other.all)?,
            target: self.target.distance_to(&other.target),
            zero_doppler: self.zero_doppler.distance_to(&other.zero_doppler),
            doppler_cells: profile_distance(&self.doppler, &other.doppler),
            range_cells: profile_distance(&self.range, &other.range),
        })
    }
}

/// Wasserstein distance between two profiles of the same length, each as a distribution over its cells.
fn profile_distance(a: &[f64], b: &[f64]) -> f64 {
    let (total_a, total_b) = (a.iter().sum::<f64>(), b.iter().sum::<f64>());
    let (mut difference, mut distance) = (0.0, 0.0);
    for (x, y) in a.iter().zip(b) {
        // Difference of the cumulative distributions.
        difference += x / total_a - y / total_b;
        distance += f64::abs(difference);
    }
    distance
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{RdmProcessor, RdmSpec, Waveform, WaveformRequest};

    fn cells(values: impl IntoIterator<Item = f64>) -> CellHistogram {
        let mut cells = CellHistogram::default();
        values.into_iter().for_each(|value| cells.add(value));
        cells
    }

    #[test]
    fn shifted_cells_are_as_far_apart_as_the_shift() {
        let shifted = |shift: f64, step: usize| {
            cells((0..1000).step_by(step).map(|i| f64::from(i as u32) * 0.01 + 0.003 + shift))
        };
        let far = shifted(0.0, 1).distance_to(&shifted(2.0, 1)).expect("cells");
        assert!((far.wasserstein_db - 2.0).abs() < 1e-4 && (far.mean_db - 2.0).abs() < 1e-9, "{far:?}");
        assert!((far.kolmogorov_smirnov - 0.2).abs() < 6e-3 && far.sigma_db.abs() < 1e-9, "{far:?}");
        let same = shifted(0.0, 1).distance_to(&shifted(0.0, 1)).expect("cells");
        assert_eq!((same.kolmogorov_smirnov, same.wasserstein_db), (0.0, 0.0));
        // Sets of different sizes.
        assert!(shifted(0.0, 1).distance_to(&shifted(0.0, 2)).expect("cells").wasserstein_db < 0.01);
        assert_eq!(shifted(0.0, 1).distance_to(&CellHistogram::default()), None);
    }

    #[test]
    fn the_distance_of_profiles_is_their_shift_in_cells() {
        let mut a = vec![0.0; 32];
        let mut b = a.clone();
        (a[4], b[9]) = (3.0, 7.0);
        assert!((profile_distance(&a, &b) - 5.0).abs() < 1e-12);
    }

    /// Exponential noise with every twentieth cell raised by 9 dB: share and excess are recovered. Plain noise gives neither.
    #[test]
    fn raised_cells_are_recovered() {
        let waveform = Waveform::realise(WaveformRequest::paper()).expect("a waveform");
        let mut map = RdmProcessor::new(&RdmSpec::default(), &waveform).expect("a processor").empty_map();
        let regions = Regions { first_bin: 3, target: 10..13 };
        let noise_db = vec![-60.0; map.shape.range];
        let (mut plain, mut raised, mut halves) =
            (MapStatistics::default(), MapStatistics::default(), MapStatistics::default());
        for (statistics, step) in [(&mut plain, usize::MAX), (&mut raised, 20)] {
            for (i, cell) in map.db.iter_mut().enumerate() {
                // Golden-ratio sequence: even over 0..1.
                let u = ((i + 1) as f64 * 0.618_033_988_749_895).fract();
                let up = if i % step == step - 1 { 9.0 } else { 0.0 };
                *cell = (-60.0 + 10.0 * (-(1.0 - u).ln()).log10() + up) as f32;
            }
            statistics.add(&map, 0, &regions);
            statistics.add_zero_doppler(&map, 0, &regions);
        }
        assert!((plain.all.sigma_db() - 5.57).abs() < 0.02, "{}", plain.all.sigma_db());
        let none = plain.raised(&noise_db);
        assert!(none.is_none_or(|r| r.fraction * r.level_db < 0.02), "{none:?}");
        let found = raised.raised(&noise_db).expect("raised");
        assert!((found.fraction - 0.05).abs() < 5e-3 && (found.level_db - 9.0).abs() < 0.7, "{found:?}");
        // Parts add up to the whole.
        halves.merge(&raised);
        halves.merge(&plain);
        assert_eq!(halves.all.count(), raised.all.count() + plain.all.count());
        assert_eq!(raised.zero_doppler.count() as usize, map.shape.range - 3);
        assert_eq!(raised.target.count() as usize, 3 * map.shape.doppler);
        let distance = plain.distance_to(&raised).expect("cells");
        assert!((distance.all.mean_db - 0.45).abs() < 0.02, "{distance:?}");
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn non_finite_levels_are_left_out_and_levels_beyond_the_ends_count_there() {
            let odd = cells([f64::NAN, f64::INFINITY, f64::NEG_INFINITY, -400.0, 300.0]);
            assert_eq!(odd.count(), 2);
            assert_eq!(odd.mean_db(), -50.0);
            assert!(odd.distance_to(&cells([0.0])).expect("cells").wasserstein_db.is_finite());
        }
    }
}
