//! How far two sets of maps are apart: what a simulation has yet to meet.

use crate::Rdm;

/// What is compared of a set of maps: all cells, and how power lies along velocity and range.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct MapSample {
    /// Cells, dB, in ascending order.
    cells_db: Vec<f32>,
    /// Mean power of each Doppler row and of each range column.
    doppler: Vec<f64>,
    range: Vec<f64>,
}

/// Differences between two samples: the second less the first where there is a sign.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Distance {
    /// Of the means over all cells, dB.
    pub mean_db: f64,
    /// Of the standard deviations over all cells, dB.
    pub sigma_db: f64,
    /// Kolmogorov's and Smirnov's distance of the distributions of cells, 0..1.
    pub kolmogorov_smirnov: f64,
    /// Wasserstein's distance of order one between them, dB.
    pub wasserstein_db: f64,
    /// The same between the profiles of power along velocity, in cells, and along range, in cells.
    pub doppler_cells: f64,
    /// Along range.
    pub range_cells: f64,
}

impl MapSample {
    /// One receiver's maps, without its first range bins, which hold leakage.
    pub fn of<'a>(maps: impl IntoIterator<Item = &'a Rdm>, rx: usize, first_bin: usize) -> Self {
        let mut sample = MapSample::default();
        for map in maps {
            let (doppler, range) = (map.shape.doppler, map.shape.range);
            sample.doppler.resize(doppler, 0.0);
            sample.range.resize(range, 0.0);
            for (row, cells) in map.db.chunks(range.max(1)).skip(rx * doppler).take(doppler).enumerate() {
                for (bin, &cell) in cells.iter().enumerate().skip(first_bin).filter(|(_, cell)| cell.is_finite()) {
                    let power = 10f64.powf(0.1 * f64::from(cell));
                    sample.cells_db.push(cell);
                    sample.doppler[row] += power;
                    sample.range[bin] += power;
                }
            }
        }
        sample.cells_db.sort_unstable_by(f32::total_cmp);
        sample
    }

    /// Mean of the cells, dB.
    pub fn mean_db(&self) -> f64 {
        self.cells_db.iter().map(|&c| f64::from(c)).sum::<f64>() / self.cells_db.len().max(1) as f64
    }

    /// Their standard deviation, dB.
    pub fn sigma_db(&self) -> f64 {
        let mean = self.mean_db();
        let square = |&c: &f32| (f64::from(c) - mean).powi(2);
        (self.cells_db.iter().map(square).sum::<f64>() / self.cells_db.len().max(1) as f64).sqrt()
    }

    /// How far another sample is from this one; `None` where either is empty.
    pub fn distance_to(&self, other: &MapSample) -> Option<Distance> {
        if self.cells_db.is_empty() || other.cells_db.is_empty() {
            return None;
        }
        let (kolmogorov_smirnov, wasserstein_db) = distances(&self.cells_db, &other.cells_db);
        Some(Distance {
            mean_db: other.mean_db() - self.mean_db(),
            sigma_db: other.sigma_db() - self.sigma_db(),
            kolmogorov_smirnov,
            wasserstein_db,
            doppler_cells: profile_distance(&self.doppler, &other.doppler),
            range_cells: profile_distance(&self.range, &other.range),
        })
    }
}

/// The greatest difference between two distribution functions, and the area between them. Both in ascending order.
fn distances(a: &[f32], b: &[f32]) -> (f64, f64) {
    let (mut i, mut j, mut greatest, mut area) = (0, 0, 0f64, 0.0);
    let mut last = f64::from(a[0].min(b[0]));
    while i < a.len() || j < b.len() {
        let next = match (a.get(i), b.get(j)) {
            (Some(&x), Some(&y)) => x.min(y),
            (Some(&x), None) | (None, Some(&x)) => x,
            (None, None) => break,
        };
        let apart = (i as f64 / a.len() as f64 - j as f64 / b.len() as f64).abs();
        area += apart * (f64::from(next) - last);
        greatest = greatest.max(apart);
        last = f64::from(next);
        i += a[i..].iter().take_while(|&&x| x <= next).count();
        j += b[j..].iter().take_while(|&&x| x <= next).count();
    }
    (greatest, area)
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

    #[test]
    fn a_shift_is_its_own_distance() {
        let a: Vec<f32> = (0..1000).map(|i| i as f32 * 0.01).collect();
        let b: Vec<f32> = a.iter().map(|x| x + 2.0).collect();
        let (ks, w1) = distances(&a, &b);
        assert!((w1 - 2.0).abs() < 1e-4, "{w1}");
        assert!((ks - 0.2).abs() < 2e-3, "{ks}");
        assert_eq!(distances(&a, &a), (0.0, 0.0));
        // Of other lengths.
        let halves: Vec<f32> = a.iter().step_by(2).copied().collect();
        assert!(distances(&a, &halves).1 < 0.01);
    }

    #[test]
    fn power_that_moves_by_cells_is_that_far_apart() {
        let mut a = vec![0.0; 32];
        let mut b = a.clone();
        (a[4], b[9]) = (3.0, 7.0);
        assert!((profile_distance(&a, &b) - 5.0).abs() < 1e-12);
    }
}
