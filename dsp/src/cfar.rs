//! Detection at a constant false-alarm rate (CFAR): each cell against what surrounds it.
//!
//! The power of noise in a cell is exponential, in the sum of `L` receivers a Gamma of shape `L`. A cell is a detection if
//! it exceeds the level of its training cells, which lie in a frame about it beyond some guard cells, by a factor that noise
//! alone exceeds with the stated probability:
//! - *cell averaging* (CA): the level is the sum of the `N` training cells. For `L = 1` the rate is `(1 + a)^-N`; in general
//!   `sum_{k<L} C(NL+k-1, k) a^k / (1+a)^(NL+k)`. Best in noise alone; a second target among the training cells raises the
//!   level and hides the first.
//! - *ordered statistic* (OS): the level is the `k`-th smallest of them. For `L = 1` the rate is
//!   `prod_{i<k} (N-i)/(N-i+a)` (Rohling, IEEE T-AES 19, 1983); in general an integral over the density of the `k`-th. Up to
//!   `N - k` strong training cells do no harm.
//!
//! Doppler goes round; at the ends of range the cells that are there count, with the factor for their number. The rates are
//! exact for independent cells. A Hann window correlates neighbours: guard cells of 2 and more keep the cell itself free of
//! it, but the training cells are fewer in effect. Measured on white samples with Hann windows on both axes, training on
//! 4 x 6 cells beyond 2 x 2: 1.5e-3 by CA where 1e-3 was asked for.

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::Rdm;

/// What the level is taken from.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum CfarMethod {
    /// The sum of the training cells.
    CellAveraging,
    /// One of them in order of power.
    OrderedStatistic {
        /// Which, as a share of their number, in (0, 1]: 0.75 is usual.
        rank: f64,
    },
}

/// Half widths of a window in cells, to either side of the cell under test.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct CellReach {
    /// In Doppler.
    pub doppler: usize,
    /// In range.
    pub range: usize,
}

/// A detector.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct CfarSpec {
    /// What the level is taken from.
    pub method: CfarMethod,
    /// Cells next to the one under test that are left out.
    pub guard: CellReach,
    /// Cells beyond those that are trained on. Zero in Doppler makes a detector along range alone.
    pub training: CellReach,
    /// Probability that noise alone is a detection, in a cell.
    pub false_alarm_rate: f64,
    /// Receivers whose powers are summed (or averaged) in a cell.
    pub looks: usize,
}

/// A detector that cannot be.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum CfarError {
    /// The rate is no probability that can be met.
    #[error("CFAR: the false-alarm rate is {got}, expected above 1e-12 and below 0.5")]
    Rate {
        /// What was given.
        got: f64,
    },
    /// The rank is no share.
    #[error("CFAR: the rank is {got}, expected above 0 and up to 1")]
    Rank {
        /// What was given.
        got: f64,
    },
    /// No receivers, or more than a chip could have.
    #[error("CFAR: {got} looks, expected 1 to 16")]
    Looks {
        /// What was given.
        got: usize,
    },
    /// There is nothing to train on.
    #[error("CFAR: the training window is empty; it reaches {reach:?} beyond the guard cells")]
    NoTraining {
        /// What was given.
        reach: CellReach,
    },
    /// The window goes round in Doppler and meets itself, or leaves no training cell somewhere along range.
    #[error("CFAR: a window of {doppler} x {range} cells does not fit a map of {of_doppler} x {of_range}")]
    TooWide {
        /// Doppler cells of the window.
        doppler: usize,
        /// Range cells of the window.
        range: usize,
        /// Doppler cells of the map.
        of_doppler: usize,
        /// Range cells of the map.
        of_range: usize,
    },
}

/// A cell above its threshold.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Detection {
    /// Doppler index.
    pub doppler: usize,
    /// Range index.
    pub range: usize,
    /// Power, dB.
    pub power_db: f32,
    /// What it had to exceed, dB.
    pub threshold_db: f32,
}

/// A detector for maps of one size: window and factors, worked out once.
#[derive(Debug, Clone)]
pub struct Cfar {
    spec: CfarSpec,
    doppler: usize,
    range: usize,
    /// By range index.
    plan: Vec<RangePlan>,
}

#[derive(Debug, Clone)]
struct RangePlan {
    /// Range cells beyond the guard cells, on both sides, and those between, the cell's own among them.
    low: std::ops::Range<usize>,
    middle: std::ops::Range<usize>,
    high: std::ops::Range<usize>,
    /// On the sum of the training cells, or on the cell of the rank.
    factor: f64,
    /// Index of the rank's cell.
    order: usize,
}

impl Cfar {
    /// A detector for maps of `doppler` times `range` cells.
    pub fn new(spec: CfarSpec, doppler: usize, range: usize) -> Result<Self, CfarError> {
        let CfarSpec { guard, training, .. } = spec;
        if !(spec.false_alarm_rate > 1e-12 && spec.false_alarm_rate < 0.5) {
            return Err(CfarError::Rate { got: spec.false_alarm_rate });
        }
        if let CfarMethod::OrderedStatistic { rank } = spec.method
            && !(rank > 0.0 && rank <= 1.0)
        {
            return Err(CfarError::Rank { got: rank });
        }
        if !(1..=16).contains(&spec.looks) {
            return Err(CfarError::Looks { got: spec.looks });
        }
        if training.doppler == 0 && training.range == 0 {
            return Err(CfarError::NoTraining { reach: training });
        }
        let width = |guard: usize, training: usize| guard.saturating_add(training).saturating_mul(2).saturating_add(1);
        let (across, along) = (width(guard.doppler, training.doppler), width(guard.range, training.range));
        let too_wide = CfarError::TooWide { doppler: across, range: along, of_doppler: doppler, of_range: range };
        if across > doppler || along.saturating_sub(1) / 2 > range {
            return Err(too_wide);
        }
        let mut plan: Vec<RangePlan> = Vec::with_capacity(range);
        let mut factors: Vec<(usize, f64)> = Vec::new();
        for cell in 0..range {
            let from = cell.saturating_sub(guard.range);
            let to = (cell + guard.range + 1).min(range);
            let low = from.saturating_sub(training.range)..from;
            let high = to..(to + training.range).min(range);
            // Ranges beyond the guard cells with all of the window's Doppler, those between with its outer part.
            let cells = (low.len() + high.len()) * across + (to - from) * 2 * training.doppler;
            if cells == 0 {
                return Err(too_wide);
            }
            let order = match spec.method {
                CfarMethod::CellAveraging => 0,
                CfarMethod::OrderedStatistic { rank } => ((rank * cells as f64).ceil() as usize).clamp(1, cells) - 1,
            };
            let known = factors.iter().find(|(n, _)| *n == cells).map(|(_, factor)| *factor);
            let factor = known.unwrap_or_else(|| threshold_factor(&spec, cells));
            factors.push((cells, factor));
            plan.push(RangePlan { low, middle: from..to, high, factor, order });
        }
        Ok(Cfar { spec, doppler, range, plan })
    }

    /// What each cell has to exceed, `[doppler][range]`, for powers (not dB) in the same order; `None` if there are more or
    /// fewer of them than cells. Where a training cell is not finite, neither may the threshold be, and nothing exceeds it.
    pub fn thresholds(&self, power: &[f64]) -> Option<Vec<f64>> {
        if power.len() != self.doppler * self.range {
            return None;
        }
        let mut out = Vec::with_capacity(power.len());
        let mut columns = [vec![0.0; self.range], vec![0.0; self.range]];
        let mut cells = Vec::new();
        for doppler in 0..self.doppler {
            match self.spec.method {
                CfarMethod::CellAveraging => {
                    self.sum_columns(power, doppler, &mut columns);
                    let [all, outer] = &columns;
                    let sum = |columns: &[f64], of: &std::ops::Range<usize>| {
                        columns.get(of.clone()).map_or(0.0, |c| c.iter().sum())
                    };
                    out.extend(self.plan.iter().map(|plan| {
                        let level: f64 = sum(all, &plan.low) + sum(all, &plan.high) + sum(outer, &plan.middle);
                        plan.factor * level
                    }));
                }
                CfarMethod::OrderedStatistic { .. } => {
                    for range in 0..self.range {
                        out.push(self.ordered_threshold(power, doppler, range, &mut cells)?);
                    }
                }
            }
        }
        Some(out)
    }

    /// Cells of one channel of a map that exceed their threshold, by Doppler and range; none if the map has another size.
    pub fn detect(&self, map: &Rdm, rx: usize) -> Vec<Detection> {
        let plane = self.doppler * self.range;
        let fits = (map.shape.doppler, map.shape.range) == (self.doppler, self.range);
        let Some(db) = map.db.get(rx * plane..(rx + 1) * plane).filter(|_| fits) else { return Vec::new() };
        let power: Vec<f64> = db.iter().map(|&db| 10f64.powf(f64::from(db) / 10.0)).collect();
        let detection = |index: usize, threshold: f64| Detection {
            doppler: index / self.range,
            range: index % self.range,
            power_db: db.get(index).copied().unwrap_or_default(),
            threshold_db: (10.0 * threshold.log10()) as f32,
        };
        match self.spec.method {
            CfarMethod::CellAveraging => {
                let Some(thresholds) = self.thresholds(&power) else { return Vec::new() };
                let all = power.iter().zip(&thresholds).enumerate();
                all.filter(|(_, (power, threshold))| power > threshold).map(|(i, (_, t))| detection(i, *t)).collect()
            }
            CfarMethod::OrderedStatistic { .. } => {
                let mut cells = Vec::new();
                let exact = self.candidates(&power).into_iter().filter_map(|index| {
                    let threshold =
                        self.ordered_threshold(&power, index / self.range, index % self.range, &mut cells)?;
                    (power.get(index)? > &threshold).then(|| detection(index, threshold))
                });
                exact.collect()
            }
        }
    }

    /// Cells that may exceed their ordered threshold, all that do among them: a cell does if more training cells than the rank
    /// says lie below its power over the factor, and counting is much cheaper than ordering.
    fn candidates(&self, power: &[f64]) -> Vec<usize> {
        let mut candidates = Vec::new();
        for doppler in 0..self.doppler {
            for (range, plan) in self.plan.iter().enumerate() {
                let index = doppler * self.range + range;
                // A little more than exact, for the rounding of the quotient.
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

    /// The ordered threshold of one cell.
    fn ordered_threshold(&self, power: &[f64], doppler: usize, range: usize, cells: &mut Vec<f64>) -> Option<f64> {
        let plan = self.plan.get(range)?;
        cells.clear();
        for (row, is_outer) in self.rows(doppler) {
            let row = power.get(row * self.range..(row + 1) * self.range).unwrap_or(&[]);
            let middle = if is_outer { plan.middle.clone() } else { 0..0 };
            for part in [plan.low.clone(), middle, plan.high.clone()] {
                cells.extend_from_slice(row.get(part).unwrap_or(&[]));
            }
        }
        // The plan has counted them: there is at least one more than `order`.
        let order = plan.order.min(cells.len().checked_sub(1)?);
        let (_, level, _) = cells.select_nth_unstable_by(order, f64::total_cmp);
        Some(plan.factor * *level)
    }

    /// Rows of the window about a row, and whether each lies beyond the guard cells.
    fn rows(&self, doppler: usize) -> impl Iterator<Item = (usize, bool)> + use<'_> {
        let CfarSpec { guard, training, .. } = self.spec;
        let reach = guard.doppler + training.doppler;
        (0..2 * reach + 1)
            .map(move |i| ((doppler + self.doppler + i - reach) % self.doppler, i.abs_diff(reach) > guard.doppler))
    }

    /// Sums over the window's rows, and over those beyond the guard cells alone. Nothing is ever subtracted: a strong target
    /// leaves no trace in the sums of others.
    fn sum_columns(&self, power: &[f64], doppler: usize, [all, outer]: &mut [Vec<f64>; 2]) {
        all.fill(0.0);
        outer.fill(0.0);
        for (row, is_outer) in self.rows(doppler) {
            let row = power.get(row * self.range..(row + 1) * self.range).unwrap_or(&[]);
            all.iter_mut().zip(row).for_each(|(sum, power)| *sum += power);
            if is_outer {
                outer.iter_mut().zip(row).for_each(|(sum, power)| *sum += power);
            }
        }
    }
}

/// The factor for so many training cells.
fn threshold_factor(spec: &CfarSpec, cells: usize) -> f64 {
    match spec.method {
        CfarMethod::CellAveraging => averaging_factor(cells, spec.looks, spec.false_alarm_rate),
        CfarMethod::OrderedStatistic { rank } => {
            let order = ((rank * cells as f64).ceil() as usize).clamp(1, cells);
            ordered_factor(cells, order, spec.looks, spec.false_alarm_rate)
        }
    }
}

/// Factor on the sum of `cells` training cells of `looks` looks each.
pub fn averaging_factor(cells: usize, looks: usize, false_alarm_rate: f64) -> f64 {
    if looks == 1 {
        return false_alarm_rate.powf(-1.0 / cells as f64) - 1.0;
    }
    let shape = (cells * looks) as f64;
    solve(false_alarm_rate, |factor| {
        let ratio = factor / (1.0 + factor);
        let mut term = (-shape * factor.ln_1p()).exp();
        let mut sum = term;
        for k in 1..looks {
            term *= (shape + k as f64 - 1.0) / k as f64 * ratio;
            sum += term;
        }
        sum
    })
}

/// Factor on the `order`-th smallest, from 1, of `cells` training cells of `looks` looks each.
pub fn ordered_factor(cells: usize, order: usize, looks: usize, false_alarm_rate: f64) -> f64 {
    if looks == 1 {
        return solve(false_alarm_rate, |factor| {
            (0..order).map(|i| (cells - i) as f64).map(|left| left / (left + factor)).product()
        });
    }
    ordered_factor_by_integral(cells, order, looks, false_alarm_rate)
}

/// The same for any number of looks: the rate is the mean of what lies above the scaled level, over the level's density.
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
    solve(false_alarm_rate, |factor| {
        weights.iter().map(|(x, weight)| weight * erlang(looks, factor * x).0).sum::<f64>() / total
    })
}

/// Probability that a Gamma variable of whole shape and unit scale lies above `x`, and below.
fn erlang(shape: usize, x: f64) -> (f64, f64) {
    let mut term = (-x).exp();
    let mut above = term;
    for k in 1..shape {
        term *= x / k as f64;
        above += term;
    }
    // The rest of the same series: a difference from one would lose all digits where x is small.
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

/// The factor at which a falling probability has this value, by halving.
fn solve(false_alarm_rate: f64, rate: impl Fn(f64) -> f64) -> f64 {
    let (mut low, mut high) = (-40.0f64, 40.0f64);
    for _ in 0..100 {
        let middle = 0.5 * (low + high);
        if rate(middle.exp()) > false_alarm_rate { low = middle } else { high = middle }
    }
    (0.5 * (low + high)).exp()
}

#[cfg(test)]
mod tests;
