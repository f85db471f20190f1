//! How far two sets of maps are apart: what a simulation has yet to meet.
//!
//! Samples count their cells in a histogram, so that they take no more memory for more maps and add up: a resampled set of
//! recordings is the sum of its recordings' samples.

use std::ops::Range;

use crate::Rdm;

/// Cells are counted in steps of so much, dB, from [`LEAST_DB`] on; what is beyond either end counts in the last step there.
const STEP_DB: f64 = 0.05;
const LEAST_DB: f64 = -250.0;
const STEPS: usize = 7000;
/// Mean of an exponentially distributed power in dB over the dB of its mean, and its variance, dB^2.
const NOISE_MEAN_DB: f64 = -2.506_818;
const NOISE_VARIANCE_DB2: f64 = 31.025_36;
/// A mean that is raised by less says nothing: noise itself is not known better.
const LEAST_RAISED_DB: f64 = 0.05;

/// The distribution of some cells, dB.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Cells {
    count: u64,
    sum: f64,
    squares: f64,
    /// By step; empty while there are none.
    counts: Vec<u64>,
}

/// Differences between two distributions of cells: the second less the first where there is a sign.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CellDistance {
    /// Of the means, dB.
    pub mean_db: f64,
    /// Of the standard deviations, dB.
    pub sigma_db: f64,
    /// Kolmogorov's and Smirnov's distance, 0..1.
    pub kolmogorov_smirnov: f64,
    /// Wasserstein's distance of order one, dB.
    pub wasserstein_db: f64,
}

impl Cells {
    /// Counts a cell; one that is not finite is left out.
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

    /// Counts another distribution's cells too.
    pub fn merge(&mut self, other: &Cells) {
        self.counts.resize(self.counts.len().max(other.counts.len()), 0);
        self.counts.iter_mut().zip(&other.counts).for_each(|(a, b)| *a += b);
        self.count += other.count;
        self.sum += other.sum;
        self.squares += other.squares;
    }

    /// How many there are.
    pub fn count(&self) -> u64 {
        self.count
    }

    /// Their mean, dB; zero of none.
    pub fn mean_db(&self) -> f64 {
        self.sum / self.count.max(1) as f64
    }

    /// Their standard deviation, dB.
    pub fn sigma_db(&self) -> f64 {
        (self.squares / self.count.max(1) as f64 - self.mean_db().powi(2)).max(0.0).sqrt()
    }

    /// How far another distribution is from this one; `None` where either is empty.
    pub fn distance_to(&self, other: &Cells) -> Option<CellDistance> {
        if self.count == 0 || other.count == 0 {
            return None;
        }
        let (whole_a, whole_b) = (self.count as f64, other.count as f64);
        let (mut a, mut b, mut greatest, mut area) = (0u64, 0u64, 0f64, 0.0);
        for (in_a, in_b) in self.counts.iter().zip(&other.counts) {
            a += in_a;
            b += in_b;
            let apart = (a as f64 / whole_a - b as f64 / whole_b).abs();
            greatest = greatest.max(apart);
            area += apart * STEP_DB;
        }
        Some(CellDistance {
            mean_db: other.mean_db() - self.mean_db(),
            sigma_db: other.sigma_db() - self.sigma_db(),
            kolmogorov_smirnov: greatest,
            wasserstein_db: area,
        })
    }
}

/// Where to look in maps.
#[derive(Debug, Clone, PartialEq)]
pub struct Regions {
    /// The first range bin that says anything: leakage lies below.
    pub first_bin: usize,
    /// Range bins of who is there.
    pub target: Range<usize>,
}

/// What is compared of a set of maps: distributions of cells, and how power lies along velocity and range.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct MapSample {
    /// All cells.
    pub all: Cells,
    /// Those of the range bins in which somebody is.
    pub target: Cells,
    /// The row of zero Doppler of maps in which what stands still was left.
    pub zero_doppler: Cells,
    /// Cells beside zero Doppler, by range bin.
    beside: Vec<Moments>,
    /// Power of each Doppler row and of each range column.
    doppler: Vec<f64>,
    range: Vec<f64>,
}

/// Count, sum and sum of squares.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct Moments([f64; 3]);

/// Differences between two samples.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Distance {
    /// Of all cells.
    pub all: CellDistance,
    /// Of those about who is there; `None` where there are none.
    pub target: Option<CellDistance>,
    /// Of zero Doppler; `None` where there are none.
    pub zero_doppler: Option<CellDistance>,
    /// Wasserstein's distance between the profiles of power along velocity, in cells.
    pub doppler_cells: f64,
    /// The same along range.
    pub range_cells: f64,
}

/// A mixture of noise and noise raised: a summary of what stands above noise by two numbers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Raised {
    /// Share of the cells that are raised, 0..1.
    pub fraction: f64,
    /// By how much, dB.
    pub level_db: f64,
}

impl MapSample {
    /// Takes in one receiver of a map from which what stands still was removed.
    pub fn add(&mut self, map: &Rdm, rx: usize, regions: &Regions) {
        let (doppler, range) = (map.shape.doppler, map.shape.range);
        self.doppler.resize(doppler, 0.0);
        self.range.resize(range, 0.0);
        self.beside.resize(range, Moments::default());
        for (row, cells) in map.db.chunks(range.max(1)).skip(rx * doppler).take(doppler).enumerate() {
            // Removal takes noise away too, as far as the window of slow time reaches.
            let is_beside = row.abs_diff(doppler / 2) > 1;
            for (bin, &cell) in cells.iter().enumerate().skip(regions.first_bin).filter(|(_, cell)| cell.is_finite()) {
                let cell = f64::from(cell);
                let power = 10f64.powf(0.1 * cell);
                self.all.add(cell);
                self.doppler[row] += power;
                self.range[bin] += power;
                if regions.target.contains(&bin) {
                    self.target.add(cell);
                }
                if is_beside {
                    let Moments([count, sum, squares]) = &mut self.beside[bin];
                    *count += 1.0;
                    *sum += cell;
                    *squares += cell * cell;
                }
            }
        }
    }

    /// Takes in the row of zero Doppler of one receiver of a map in which what stands still was left.
    pub fn add_zero_doppler(&mut self, map: &Rdm, rx: usize, regions: &Regions) {
        let (doppler, range) = (map.shape.doppler, map.shape.range);
        let row = map.db.chunks(range.max(1)).nth(rx * doppler + doppler / 2).unwrap_or_default();
        row.iter().skip(regions.first_bin).for_each(|&cell| self.zero_doppler.add(f64::from(cell)));
    }

    /// Takes in another sample.
    pub fn merge(&mut self, other: &MapSample) {
        self.all.merge(&other.all);
        self.target.merge(&other.target);
        self.zero_doppler.merge(&other.zero_doppler);
        self.beside.resize(self.beside.len().max(other.beside.len()), Moments::default());
        for (Moments(mine), Moments(others)) in self.beside.iter_mut().zip(&other.beside) {
            mine.iter_mut().zip(others).for_each(|(a, b)| *a += b);
        }
        for (mine, others) in [(&mut self.doppler, &other.doppler), (&mut self.range, &other.range)] {
            mine.resize(mine.len().max(others.len()), 0.0);
            mine.iter_mut().zip(others).for_each(|(a, b)| *a += b);
        }
    }

    /// The share of cells that stand above noise and by how much, from their mean and variance over those of noise, whose mean
    /// power by range bin is given in dB. `None` where nothing stands above it.
    pub fn raised(&self, noise_db: &[f64]) -> Option<Raised> {
        let (mut count, mut sum, mut squares) = (0.0, 0.0, 0.0);
        for (Moments([n, cells, square]), noise) in self.beside.iter().zip(noise_db) {
            count += n;
            sum += cells - n * noise;
            squares += square - 2.0 * noise * cells + n * noise * noise;
        }
        let mean = sum / count - NOISE_MEAN_DB;
        let variance = squares / count - (sum / count).powi(2) - NOISE_VARIANCE_DB2;
        // Of no cells neither is a number.
        if !(mean > LEAST_RAISED_DB && variance > 0.0) {
            return None;
        }
        let level_db = variance / mean + mean;
        Some(Raised { fraction: mean / level_db, level_db })
    }

    /// How far another sample is from this one; `None` where either is empty.
    pub fn distance_to(&self, other: &MapSample) -> Option<Distance> {
        Some(Distance {
            all: self.all.distance_to(&other.all)?,
            target: self.target.distance_to(&other.target),
            zero_doppler: self.zero_doppler.distance_to(&other.zero_doppler),
            doppler_cells: profile_distance(&self.doppler, &other.doppler),
            range_cells: profile_distance(&self.range, &other.range),
        })
    }
}

/// Wasserstein's distance between two profiles of the same length, each as a distribution over its cells.
fn profile_distance(a: &[f64], b: &[f64]) -> f64 {
    let (whole_a, whole_b) = (a.iter().sum::<f64>(), b.iter().sum::<f64>());
    let (mut apart, mut distance) = (0.0, 0.0);
    for (x, y) in a.iter().zip(b) {
        apart += x / whole_a - y / whole_b;
        distance += f64::abs(apart);
    }
    distance
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{RdmProcessor, RdmSpec, Waveform, WaveformRequest};

    fn cells(values: impl IntoIterator<Item = f64>) -> Cells {
        let mut cells = Cells::default();
        values.into_iter().for_each(|value| cells.add(value));
        cells
    }

    #[test]
    fn a_shift_is_its_own_distance() {
        let of = |shift: f64, step: usize| {
            cells((0..1000).step_by(step).map(|i| f64::from(i as u32) * 0.01 + 0.003 + shift))
        };
        let far = of(0.0, 1).distance_to(&of(2.0, 1)).expect("cells");
        assert!((far.wasserstein_db - 2.0).abs() < 1e-4 && (far.mean_db - 2.0).abs() < 1e-9, "{far:?}");
        assert!((far.kolmogorov_smirnov - 0.2).abs() < 6e-3 && far.sigma_db.abs() < 1e-9, "{far:?}");
        let same = of(0.0, 1).distance_to(&of(0.0, 1)).expect("cells");
        assert_eq!((same.kolmogorov_smirnov, same.wasserstein_db), (0.0, 0.0));
        // Of other lengths.
        assert!(of(0.0, 1).distance_to(&of(0.0, 2)).expect("cells").wasserstein_db < 0.01);
        assert_eq!(of(0.0, 1).distance_to(&Cells::default()), None);
    }

    #[test]
    fn power_that_moves_by_cells_is_that_far_apart() {
        let mut a = vec![0.0; 32];
        let mut b = a.clone();
        (a[4], b[9]) = (3.0, 7.0);
        assert!((profile_distance(&a, &b) - 5.0).abs() < 1e-12);
    }

    /// Exponential noise of which every twentieth cell is nine decibels up: both numbers come back, and none without.
    #[test]
    fn what_is_raised_is_found_again() {
        let waveform = Waveform::realise(WaveformRequest::paper()).expect("a waveform");
        let mut map = RdmProcessor::new(&RdmSpec::default(), &waveform).expect("a processor").empty_map();
        let regions = Regions { first_bin: 3, target: 10..13 };
        let noise_db = vec![-60.0; map.shape.range];
        let (mut plain, mut raised, mut halves) = (MapSample::default(), MapSample::default(), MapSample::default());
        for (sample, step) in [(&mut plain, usize::MAX), (&mut raised, 20)] {
            for (i, cell) in map.db.iter_mut().enumerate() {
                // Golden-ratio sequence: even over 0..1.
                let u = ((i + 1) as f64 * 0.618_033_988_749_895).fract();
                let up = if i % step == step - 1 { 9.0 } else { 0.0 };
                *cell = (-60.0 + 10.0 * (-(1.0 - u).ln()).log10() + up) as f32;
            }
            sample.add(&map, 0, &regions);
            sample.add_zero_doppler(&map, 0, &regions);
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
        fn what_is_no_number_is_left_out_and_what_is_beyond_counts_at_the_end() {
            let odd = cells([f64::NAN, f64::INFINITY, f64::NEG_INFINITY, -400.0, 300.0]);
            assert_eq!(odd.count(), 2);
            assert_eq!(odd.mean_db(), -50.0);
            assert!(odd.distance_to(&cells([0.0])).expect("cells").wasserstein_db.is_finite());
        }
    }
}
