//! Slow-time lines of moving people in the recordings and in their simulated copies.

use radome_dsp::statistics::MotionLine;
use serde::Serialize;

/// Strongest slow-time line, real and simulated.
#[derive(Serialize)]
pub struct Lines {
    pub real: Option<MotionLine>,
    pub before: Option<CopyLines>,
    pub after: Option<CopyLines>,
}

/// Lines of the copies, each of which draws another person.
#[derive(Serialize)]
pub struct CopyLines {
    /// Mean power, dBFS, and the lower and upper quartile.
    pub level_dbfs: f64,
    pub level_quartiles_dbfs: [f64; 2],
    /// Median range, m, and the lower and upper quartile.
    pub range_m: f64,
    pub range_quartiles_m: [f64; 2],
    /// Median breathing rate, Hz.
    pub breath_hz: Option<f64>,
    /// Number of copies that have a line.
    pub copies: usize,
    /// Level relative to the recordings' line; `None` where they have none.
    pub level_difference_db: Option<f64>,
    pub range_difference_m: Option<f64>,
}

impl Lines {
    pub fn new(real: Option<MotionLine>, before: &[Option<MotionLine>], after: &[Option<MotionLine>]) -> Self {
        Lines { real, before: CopyLines::of(before, real), after: CopyLines::of(after, real) }
    }
}

impl CopyLines {
    fn of(lines: &[Option<MotionLine>], real: Option<MotionLine>) -> Option<Self> {
        let sorted = |of: &dyn Fn(&MotionLine) -> Option<f64>| {
            let mut values: Vec<f64> = lines.iter().flatten().filter_map(of).collect();
            values.sort_unstable_by(f64::total_cmp);
            values
        };
        let quantile = |values: &[f64], part: f64| values.get((part * values.len() as f64) as usize).copied();
        let levels = sorted(&|line| Some(line.level_dbfs));
        let (ranges, rates) = (sorted(&|line| Some(line.range_m)), sorted(&|line| line.breath_hz));
        let power = levels.iter().map(|db| 10f64.powf(0.1 * db)).sum::<f64>() / levels.len().max(1) as f64;
        let level_dbfs = 10.0 * power.log10();
        let range_m = quantile(&ranges, 0.5)?;
        Some(CopyLines {
            level_dbfs,
            level_quartiles_dbfs: [quantile(&levels, 0.25)?, quantile(&levels, 0.75)?],
            range_m,
            range_quartiles_m: [quantile(&ranges, 0.25)?, quantile(&ranges, 0.75)?],
            breath_hz: quantile(&rates, 0.5),
            copies: levels.len(),
            level_difference_db: real.map(|real| level_dbfs - real.level_dbfs),
            range_difference_m: real.map(|real| range_m - real.range_m),
        })
    }
}
