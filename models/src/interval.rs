//! Means of few values, and their 95 % intervals.

use serde::{Deserialize, Serialize};

/// A mean and its 95 % interval.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Interval {
    /// Number of values.
    pub count: usize,
    /// Mean of the values.
    pub mean: f64,
    /// Half width of the interval, by Student's t; absent for one value.
    pub half_width: Option<f64>,
    /// Smallest value.
    pub least: f64,
    /// Largest value.
    pub most: f64,
}

/// 97.5 % quantiles of Student's t for 1 to 30 degrees of freedom (NIST/SEMATECH e-Handbook, section 1.3.6.7.2).
const T_QUANTILES: [f64; 30] = [
    12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228, 2.201, 2.179, 2.160, 2.145, 2.131, 2.120,
    2.110, 2.101, 2.093, 2.086, 2.080, 2.074, 2.069, 2.064, 2.060, 2.056, 2.052, 2.048, 2.045, 2.042,
];
/// 97.5 % quantile of the normal distribution.
const NORMAL_QUANTILE: f64 = 1.959_964;

/// 97.5 % quantile of Student's t. Beyond the table, it is an asymptotic expansion (Abramowitz and Stegun, Handbook of
/// Mathematical Functions, 1964, equation 26.7.5).
fn t_quantile(degrees: usize) -> f64 {
    let tabulated = degrees.checked_sub(1).and_then(|index| T_QUANTILES.get(index));
    tabulated.copied().unwrap_or_else(|| {
        let (z, n) = (NORMAL_QUANTILE, degrees as f64);
        z + (z.powi(3) + z) / (4.0 * n) + (5.0 * z.powi(5) + 16.0 * z.powi(3) + 3.0 * z) / (96.0 * n * n)
    })
}

/// Mean of the values and its 95 % interval; `None` without values.
pub fn t_interval(values: &[f64]) -> Option<Interval> {
    let count = values.len();
    if count == 0 {
        return None;
    }
    let mean = values.iter().sum::<f64>() / count as f64;
    let half_width = (count > 1).then(|| {
        let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / (count - 1) as f64;
        t_quantile(count - 1) * (variance / count as f64).sqrt()
    });
    let least = values.iter().copied().fold(f64::INFINITY, f64::min);
    let most = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    Some(Interval { count, mean, half_width, least, most })
}

/// Median of the values, the larger of the two middle ones for an even count; `None` without values.
pub(crate) fn median(values: impl Iterator<Item = f64>) -> Option<f64> {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// from scipy import stats; stats.t.interval(0.95, 4, 0.9, stats.sem([.9, .92, .88, .91, .89]))
    #[test]
    fn intervals_are_those_of_student() {
        let interval = t_interval(&[0.9, 0.92, 0.88, 0.91, 0.89]).expect("values");
        assert!((interval.mean - 0.9).abs() < 1e-12);
        assert!((interval.half_width.expect("width") - 0.019_632).abs() < 1e-5);
        assert_eq!((interval.least, interval.most), (0.88, 0.92));
    }

    /// from scipy import stats; [stats.t.ppf(0.975, n) for n in (30, 31, 40, 120)]
    #[test]
    fn intervals_of_many_values_are_those_of_student() {
        for (degrees, expected) in [(30, 2.0423), (31, 2.0395), (40, 2.0211), (120, 1.9799)] {
            assert!((t_quantile(degrees) - expected).abs() < 5e-4, "{degrees}: {}", t_quantile(degrees));
        }
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn one_value_has_no_interval_and_none_has_no_mean() {
            assert_eq!(t_interval(&[]), None);
            assert_eq!(t_interval(&[0.5]).expect("one").half_width, None);
            let many = t_interval(&[0.5; 40]).expect("many");
            assert_eq!(many.half_width, Some(0.0));
        }
    }
}
