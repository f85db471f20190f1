//! Detection at a constant false-alarm rate (CFAR) by ordered statistics.
//!
//! The noise power in a cell has an exponential distribution; its sum over `L` receivers has a Gamma distribution of
//! shape `L`. A cell is a detection if its power exceeds the level of its training cells by a factor. Noise alone
//! exceeds that factor with the given probability. The training cells surround the cell under test, beyond some guard
//! cells. The level is the `k`-th smallest of the `N` training cells. For `L = 1` the rate is
//! `prod_{i<k} (N-i)/(N-i+a)` (Rohling, "Radar CFAR Thresholding in Clutter and Multiple Target Situations", IEEE T-AES
//! 19, 1983). In general it is an integral over the density of the `k`-th smallest cell. Up to `N - k` strong training
//! cells do not raise the level.
//!
//! The Doppler axis is periodic. At the ends of range only existing cells are counted, with the factor for their
//! number. The rates are exact for independent cells. A Hann window correlates neighbours. Two or more guard cells keep
//! the power of the cell under test out of the training cells. The effective number of training cells is still smaller,
//! and the rate is less than twice the given one.

use thiserror::Error;

use crate::Rdm;

/// Half widths of a window, in cells to either side of the cell under test.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CellReach {
    /// Cells in Doppler.
    pub doppler: usize,
    /// Cells in range.
    pub range: usize,
}

/// Specification of a CFAR detector.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CfarSpec {
    /// Rank of the training cell that is the level, as a share of their number, in (0, 1]; 0.75 is usual.
    pub rank: f64,
    /// Guard cells next to the cell under test, which are left out.
    pub guard: CellReach,
    /// Training cells beyond the guard cells. With 0 in Doppler the detector works along range alone.
    pub training: CellReach,
    /// Probability of a detection in a cell that holds noise alone.
    pub false_alarm_rate: f64,
    /// Number of receivers whose powers are summed or averaged in a cell.
    pub looks: usize,
}

/// Error for a specification of a detector that is invalid or does not fit the maps.
#[derive(Debug, Clone, PartialEq, Error)]
#[allow(missing_docs, reason = "the message says what each field is")]
pub enum CfarError {
    /// The false-alarm rate is out of range.
    #[error("CFAR: the false-alarm rate is {got}, expected above 1e-12 and below 0.5")]
    Rate { got: f64 },
    /// The rank is out of range.
    #[error("CFAR: the rank is {got}, expected above 0 and up to 1")]
    Rank { got: f64 },
    /// The number of receivers is out of range.
    #[error("CFAR: {got} looks, expected 1 to 16")]
    Looks { got: usize },
    /// There are no training cells.
    #[error("CFAR: the training window is empty; it reaches {reach:?} beyond the guard cells")]
    NoTraining { reach: CellReach },
    /// The window is wider than the periodic Doppler axis, or leaves no training cell at some range.
    #[error("CFAR: a window of {doppler} x {range} cells does not fit a map of {of_doppler} x {of_range}")]
    TooWide { doppler: usize, range: usize, of_doppler: usize, of_range: usize },
}

/// Cell above its threshold.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CellDetection {
    /// Doppler index.
    pub doppler: usize,
    /// Range index.
    pub range: usize,
    /// Power, dB.
    pub power_db: f32,
    /// Threshold, dB.
    pub threshold_db: f32,
}

/// CFAR detector for maps of one size.
///
/// ```
/// use radome_dsp::detect::{CellReach, Cfar, CfarSpec};
///
/// let spec = CfarSpec {
///     rank: 0.75,
///     guard: CellReach { doppler: 0, range: 1 },
///     training: CellReach { doppler: 0, range: 8 },
///     false_alarm_rate: 1e-6,
///     looks: 1,
/// };
/// let cfar = Cfar::new(spec, 1, 64)?;
/// let mut power = vec![1.0; 64];
/// power[20] = 1e3;
/// let thresholds = cfar.thresholds(&power).expect("64 cells");
/// assert!(power[20] > thresholds[20] && power[21] < thresholds[21]);
/// # Ok::<(), radome_dsp::detect::CfarError>(())
/// ```
#[derive(Debug, Clone)]
pub struct Cfar {
    spec: CfarSpec,
    doppler: usize,
    range: usize,
    /// Training cells and factor by range index.
    plan: Vec<RangePlan>,
}

#[derive(Debug, Clone)]
struct RangePlan {
    /// Range cells beyond the guard cells on both sides, and those between, including the cell under test.
    low: std::ops::Range<usize>,
    middle: std::ops::Range<usize>,
    high: std::ops::Range<usize>,
    /// Factor of the threshold on the level.
    factor: f64,
    /// 0-based index of the level among the sorted training cells.
    order: usize,
}

impl Cfar {
    /// Creates a detector for maps of `doppler` times `range` cells.
    ///
    /// # Errors
    /// - [`CfarError::Rate`], [`CfarError::Rank`] or [`CfarError::Looks`] if that value is out of range.
    /// - [`CfarError::NoTraining`] if there are no training cells.
    /// - [`CfarError::TooWide`] if the window does not fit the map.
    pub fn new(spec: CfarSpec, doppler: usize, range: usize) -> Result<Self, CfarError> {
        let CfarSpec { guard, training, .. } = spec;
        if !(spec.false_alarm_rate > 1e-12 && spec.false_alarm_rate < 0.5) {
            return Err(CfarError::Rate { got: spec.false_alarm_rate });
        }
        if !(spec.rank > 0.0 && spec.rank <= 1.0) {
            return Err(CfarError::Rank { got: spec.rank });
        }
        if !(1..=16).contains(&spec.looks) {
            return Err(CfarError::Looks { got: spec.looks });
        }
        if training.doppler == 0 && training.range == 0 {
            return Err(CfarError::NoTraining { reach: training });
        }
        let width = |guard: usize, training: usize| guard.saturating_add(training).saturating_mul(2).saturating_add(1);
        let (doppler_width, range_width) = (width(guard.doppler, training.doppler), width(guard.range, training.range));
        let too_wide =
            CfarError::TooWide { doppler: doppler_width, range: range_width, of_doppler: doppler, of_range: range };
        if doppler_width > doppler || range_width.saturating_sub(1) / 2 > range {
            return Err(too_wide);
        }
        let mut plan: Vec<RangePlan> = Vec::with_capacity(range);
        let mut factors: Vec<(usize, f64)> = Vec::new();
        for cell in 0..range {
            let from = cell.saturating_sub(guard.range);
            let to = (cell + guard.range + 1).min(range);
            let low = from.saturating_sub(training.range)..from;
            let high = to..(to + training.range).min(range);
            // Ranges beyond the guard cells count with all Doppler rows of the window, ranges between with the outer rows only.
            let cells = (low.len() + high.len()) * doppler_width + (to - from) * 2 * training.doppler;
            if cells == 0 {
                return Err(too_wide);
            }
            let order = level_order(&spec, cells);
            let cached_factor = factors.iter().find(|(n, _)| *n == cells).map(|(_, factor)| *factor);
            let factor =
                cached_factor.unwrap_or_else(|| ordered_factor(cells, order, spec.looks, spec.false_alarm_rate));
            factors.push((cells, factor));
            plan.push(RangePlan { low, middle: from..to, high, factor, order: order - 1 });
        }
        Ok(Cfar { spec, doppler, range, plan })
    }

    /// Thresholds of all cells, `[doppler][range]`, for powers (not dB) in the same order; `None` if their number is
    /// not that of the cells. The threshold may not be finite if a training cell is not finite; no power exceeds such a
    /// threshold.
    pub fn thresholds(&self, power: &[f64]) -> Option<Vec<f64>> {
        if power.len() != self.doppler * self.range {
            return None;
        }
        let mut cells = Vec::new();
        let thresholds =
            (0..power.len()).map(|index| self.threshold(power, index / self.range, index % self.range, &mut cells));
        thresholds.collect()
    }

    /// Cells of one channel of a map that exceed their threshold, in order of Doppler and range; none if the map has another size.
    pub fn detect(&self, map: &Rdm, rx: usize) -> Vec<CellDetection> {
        let plane = self.doppler * self.range;
        let fits = (map.shape.doppler, map.shape.range) == (self.doppler, self.range);
        let Some(db) = map.db.get(rx * plane..(rx + 1) * plane).filter(|_| fits) else { return Vec::new() };
        let power: Vec<f64> = db.iter().map(|&db| 10f64.powf(f64::from(db) / 10.0)).collect();
        let mut cells = Vec::new();
        let detections = self.candidates(&power).into_iter().filter_map(|index| {
            let (doppler, range) = (index / self.range, index % self.range);
            let threshold = self.threshold(&power, doppler, range, &mut cells)?;
            (power.get(index)? > &threshold).then(|| CellDetection {
                doppler,
                range,
                power_db: db.get(index).copied().unwrap_or_default(),
                threshold_db: (10.0 * threshold.log10()) as f32,
            })
        });
        detections.collect()
    }

    /// Indices of the cells that may exceed their threshold, including all that do. A cell exceeds its threshold if
    /// more training cells than the rank lie below its power divided by the factor. Counting them is much cheaper than
    /// sorting them.
    fn candidates(&self, power: &[f64]) -> Vec<usize> {
        let mut candidates = Vec::new();
        for doppler in 0..self.doppler {
            for (range, plan) in self.plan.iter().enumerate() {
                let index = doppler * self.range + range;
                // A margin for the rounding of the quotient.
                let bound = power.get(index).copied().unwrap_or(0.0) / plan.factor * (1.0 + 1e-12);
                let below = |cells: Option<&[f64]>| {
                    cells.unwrap_or(&[]).iter().map(|c| usize::from(*c <= bound)).sum::<usize>()
                };
                let mut count = 0;
                for (row, is_outer) in self.rows(doppler) {
                    let row = power.get(row * self.range..(row + 1) * self.range).unwrap_or(&[]);
                    count += below(row.get(plan.low.clone())) + below(row.get(plan.high.clone()));
                    if is_outer {
                        count += below(row.get(plan.middle.clone()));
                    }
                }
                if count > plan.order {
                    candidates.push(index);
                }
            }
        }
        candidates
    }

    /// Threshold of one cell; `cells` is a buffer.
    fn threshold(&self, power: &[f64], doppler: usize, range: usize, cells: &mut Vec<f64>) -> Option<f64> {
        let plan = self.plan.get(range)?;
        cells.clear();
        for (row, is_outer) in self.rows(doppler) {
            let row = power.get(row * self.range..(row + 1) * self.range).unwrap_or(&[]);
            let middle = if is_outer { plan.middle.clone() } else { 0..0 };
            for part in [plan.low.clone(), middle, plan.high.clone()] {
                cells.extend_from_slice(row.get(part).unwrap_or(&[]));
            }
        }
        // `new` has counted the cells: there is at least one more than `order`.
        let order = plan.order.min(cells.len().checked_sub(1)?);
        let (_, level, _) = cells.select_nth_unstable_by(order, f64::total_cmp);
        Some(plan.factor * *level)
    }

    /// Rows of the window around a row, each with a flag that is true beyond the guard cells.
    fn rows(&self, doppler: usize) -> impl Iterator<Item = (usize, bool)> + use<'_> {
        let CfarSpec { guard, training, .. } = self.spec;
        let reach = guard.doppler + training.doppler;
        (0..2 * reach + 1)
            .map(move |i| ((doppler + self.doppler + i - reach) % self.doppler, i.abs_diff(reach) > guard.doppler))
    }
}

/// 1-based order of the level among this number of training cells.
fn level_order(spec: &CfarSpec, cells: usize) -> usize {
    ((spec.rank * cells as f64).ceil() as usize).clamp(1, cells)
}

/// Factor on the `order`-th smallest (from 1) of `cells` training cells of `looks` looks each.
fn ordered_factor(cells: usize, order: usize, looks: usize, false_alarm_rate: f64) -> f64 {
    if looks == 1 {
        return factor_at_rate(false_alarm_rate, |factor| {
            (0..order).map(|i| (cells - i) as f64).map(|left| left / (left + factor)).product()
        });
    }
    ordered_factor_by_integral(cells, order, looks, false_alarm_rate)
}

/// [`ordered_factor`] for any number of looks: the rate is the mean of the probability above the scaled level, over the level's
/// density.
fn ordered_factor_by_integral(cells: usize, order: usize, looks: usize, false_alarm_rate: f64) -> f64 {
    // The density of the order-th smallest on a grid of ln x.
    const STEPS: usize = 6000;
    let (low, high) = (-30.0f64, 6.0f64);
    let step = (high - low) / STEPS as f64;
    let ln_choose: f64 =
        (1..order).map(|i| ((cells - order + i) as f64 / i as f64).ln()).sum::<f64>() + (cells as f64).ln();
    let weights: Vec<(f64, f64)> = (0..=STEPS)
        .map(|i| {
            let x = (low + i as f64 * step).exp();
            let (above, below) = erlang(looks, x);
            let ln_density = (looks as f64 - 1.0) * x.ln() - x - (1..looks).map(|k| (k as f64).ln()).sum::<f64>();
            let ln =
                ln_choose + (order - 1) as f64 * below.ln() + (cells - order) as f64 * above.ln() + ln_density + x.ln();
            (x, ln.exp())
        })
        .collect();
    let total: f64 = weights.iter().map(|(_, weight)| weight).sum();
    factor_at_rate(false_alarm_rate, |factor| {
        weights.iter().map(|(x, weight)| weight * erlang(looks, factor * x).0).sum::<f64>() / total
    })
}

/// Probabilities that a Gamma variable of integer shape and unit scale lies above `x`, and below.
fn erlang(shape: usize, x: f64) -> (f64, f64) {
    let mut term = (-x).exp();
    let mut above = term;
    for k in 1..shape {
        term *= x / k as f64;
        above += term;
    }
    // The remainder of the series, because a difference from one would lose all digits where x is small.
    let (mut below, mut k) = (0.0, shape);
    while k < shape + 500 {
        term *= x / k as f64;
        below += term;
        if term < below * 1e-17 {
            break;
        }
        k += 1;
    }
    (above, if x > 50.0 { 1.0 - above } else { below })
}

/// Factor at which the rate, which falls with the factor, is the given one; by bisection.
fn factor_at_rate(false_alarm_rate: f64, rate: impl Fn(f64) -> f64) -> f64 {
    let (mut low, mut high) = (-40.0f64, 40.0f64);
    for _ in 0..100 {
        let middle = 0.5 * (low + high);
        if rate(middle.exp()) > false_alarm_rate { low = middle } else { high = middle }
    }
    (0.5 * (low + high)).exp()
}

#[cfg(test)]
mod tests;
