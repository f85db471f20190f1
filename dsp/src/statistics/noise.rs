//! Noise floor of a map.

use crate::Rdm;

/// Mean noise power of each range bin of one channel, `[range]`, dB: the median of the power over Doppler, divided by `ln 2`.
///
/// The power of complex Gaussian noise is exponential, and its median is `ln 2` of its mean. Targets and clutter fill few Doppler
/// cells and hardly change the median. `guard_bins` cells on either side of zero Doppler, zero Doppler itself and cells that are
/// not finite are left out. A bin without any cell reads NaN.
///
/// # Panics
/// If the map has no channel `rx`.
pub fn noise_floor_db(map: &Rdm, rx: usize, guard_bins: usize) -> Vec<f32> {
    let zero = map.shape.doppler / 2;
    let mut column = Vec::with_capacity(map.shape.doppler);
    (0..map.shape.range)
        .map(|range| {
            column.clear();
            let levels = (0..map.shape.doppler).filter(|d| d.abs_diff(zero) > guard_bins).map(|d| map.at(rx, d, range));
            column.extend(levels.filter(|v| v.is_finite()));
            if column.is_empty() {
                return f32::NAN;
            }
            column.sort_unstable_by(f32::total_cmp);
            let middle = column.len() / 2;
            let median_db =
                if column.len() % 2 == 1 { column[middle] } else { 0.5 * (column[middle - 1] + column[middle]) };
            median_db - 10.0 * std::f32::consts::LN_2.log10()
        })
        .collect()
}
