//! Small numerical functions: smooth steps, Hermite polynomials, angles, medians, interpolation, disjoint sets.

use std::f64::consts::{PI, TAU};

use num_complex::Complex64;

/// Raised-cosine step from 0 (below -1) to 1 (above 1).
pub fn smooth_step(x: f64) -> f64 {
    if x <= -1.0 {
        0.0
    } else if x >= 1.0 {
        1.0
    } else {
        0.5 * (x + 1.0) + (PI * x).sin() / TAU
    }
}

/// Integral of [`smooth_step`]: 0 below -1, x above 1.
pub fn smooth_ramp(x: f64) -> f64 {
    if x <= -1.0 {
        0.0
    } else if x >= 1.0 {
        x
    } else {
        0.25 * (x + 1.0) * (x + 1.0) - (1.0 + (PI * x).cos()) / (2.0 * PI * PI)
    }
}

/// Power coefficients of the quintic Hermite polynomial over 0..1, from values and two derivatives at the ends.
pub fn quintic([y0, v0, w0]: [f64; 3], [y1, v1, w1]: [f64; 3]) -> [f64; 6] {
    // Residual at the second end of the parabola that fits the first end.
    let (y, v, w) = (y1 - y0 - v0 - 0.5 * w0, v1 - v0 - w0, w1 - w0);
    [y0, v0, 0.5 * w0, 10.0 * y - 4.0 * v + 0.5 * w, -15.0 * y + 7.0 * v - w, 6.0 * y - 3.0 * v + 0.5 * w]
}

/// Magnitude of a number whose square neither overflows nor underflows. [`Complex64::norm`] has no such restriction,
/// but takes several times as long.
pub fn magnitude(z: Complex64) -> f64 {
    z.norm_sqr().sqrt()
}

/// Wraps an angle to -pi..pi.
pub fn wrapped(angle_rad: f64) -> f64 {
    (angle_rad + PI).rem_euclid(TAU) - PI
}

/// Median of the values, the larger of the two middle ones for an even count; zero for an empty list.
pub fn median(mut values: Vec<f64>) -> f64 {
    let middle = values.len() / 2;
    if values.is_empty() {
        return 0.0;
    }
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

/// Median of `(value, weight)` pairs: the first value at which the sum of weights exceeds half of the total. With equal
/// weights it is the [`median`]. `None` for an empty list.
pub fn weighted_median(mut values: Vec<(f64, f64)>) -> Option<f64> {
    values.sort_by(|a, b| a.0.total_cmp(&b.0));
    let half_of_sum = 0.5 * values.iter().map(|(_, weight)| weight).sum::<f64>();
    let mut sum = 0.0;
    let is_reached = |&(_, weight): &(f64, f64)| {
        sum += weight;
        sum > half_of_sum
    };
    values.into_iter().find(is_reached).map(|(value, _)| value)
}

/// Values below and above a position from 0 to 1 among evenly spaced values, and the fraction of the interval between
/// them; `None` for an empty list.
pub fn neighbours<T>(values: &[T], position: f64) -> Option<(&T, &T, f64)> {
    let position = position.clamp(0.0, 1.0) * values.len().saturating_sub(1) as f64;
    let index = position as usize;
    let below = values.get(index)?;
    Some((below, values.get(index + 1).unwrap_or(below), position - index as f64))
}

/// Disjoint sets (union-find) of the numbers from 0. The lowest number of each set represents it.
pub struct DisjointSets(Vec<usize>);

impl DisjointSets {
    /// Creates one set for each of `count` numbers.
    pub fn new(count: usize) -> Self {
        DisjointSets((0..count).collect())
    }

    /// Lowest number of the set that contains a number.
    pub fn lowest(&mut self, mut number: usize) -> usize {
        while self.0[number] != number {
            self.0[number] = self.0[self.0[number]];
            number = self.0[number];
        }
        number
    }

    /// Merges the sets that contain two numbers.
    pub fn join(&mut self, a: usize, b: usize) {
        let (a, b) = (self.lowest(a), self.lowest(b));
        self.0[a.max(b)] = a.min(b);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weighted_medians_with_equal_weights_are_medians() {
        for values in [vec![3.0], vec![2.0, 1.0], vec![5.0, 1.0, 3.0], vec![4.0, 2.0, 8.0, 6.0]] {
            let weighted = values.iter().map(|&value| (value, 1.0)).collect();
            assert_eq!(weighted_median(weighted), Some(median(values)));
        }
        assert_eq!(weighted_median(vec![(9.0, 1.0), (1.0, 4.0), (5.0, 2.0)]), Some(1.0));
        assert_eq!(weighted_median(Vec::new()), None);
    }

    #[test]
    fn values_are_interpolated_between_their_neighbours() {
        let between =
            |values: &[f64], position: f64| neighbours(values, position).map(|(a, b, fraction)| a + (b - a) * fraction);
        assert_eq!(between(&[], 0.4), None);
        assert_eq!(between(&[0.3], 0.9), Some(0.3));
        assert_eq!(between(&[1.0, 0.0, 0.5], 0.75), Some(0.25));
        assert_eq!(between(&[1.0, 0.0, 0.5], 1.0), Some(0.5));
    }
}
