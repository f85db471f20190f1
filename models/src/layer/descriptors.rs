//! Descriptors of a map: numbers without trained parameters, from which a linear classifier counts people.
//!
//! A person moves in one direction at a time, and so do most multipath echoes of this person: they spread over ranges, not over
//! directions. A second person mostly moves in another direction or at another speed. The number of cells above a level does not
//! distinguish a near person with many such echoes from two people. Therefore nearly all descriptors are relative to the level, the
//! range and the velocity of the strongest cell. In real rooms, only this separates one person from two; in simulated rooms, counts
//! of cells do as well.
//!
//! Cells of zero velocity are treated separately. They hold the change from frame to frame
//! ([`change_over_s`](radome_dsp::RdmSpec::change_over_s)), which shows people who stand, sit or breathe. Four descriptors use them.
//! The first measures change without motion, the second change at much shorter range than the motion. The last two measure change at
//! slightly shorter range that is as strong as the motion: with motion in any direction, and with approaching motion only.
//! At longer range than a walking person, change is not used: shadows change the echoes of the room there, and the distribution of
//! change over ranges differs between simulated and real rooms.
//!
//! The width of an echo depends on the resolution of the waveform. On fixed axes, the noise shows the resolution: if it is coarser than
//! a bin, neighbouring cells of noise are correlated. Four descriptors measure this correlation.
//!
//! The last descriptors are the [`Motion`] of echoes over about a second, which the map processor measures: echoes of one person keep
//! their distances, two people move independently. They include change nearer than the motion over the last frames, and its products with
//! the other quantities.
//!
//! The features in `dataset/features.rs` are different: they are quantiles over many maps, which compare simulated rooms with real
//! ones.

use radome_dsp::rdm::{Motion, nearer_change};

/// Number of descriptors of the cells of a map.
const OF_CELLS: usize = 50;
/// Number of quantities of motion that describe the moving echoes. The one after them is change nearer than the motion.
const OF_MOVING: usize = Motion::QUANTITIES - 1;
/// Number of descriptors of a map with its motion.
pub const DESCRIPTORS: usize = OF_CELLS + Motion::QUANTITIES + OF_MOVING;
/// Numbers of descriptors in earlier models. These had only the first descriptors of a map: without the correlations of the noise,
/// without change much nearer than the motion, without change slightly nearer than the motion, without the motion over frames, and
/// without change nearer than the motion over frames.
pub(crate) const EARLIER_DESCRIPTORS: [usize; 5] = [43, 47, 48, OF_CELLS, OF_CELLS + OF_MOVING];

/// Level above which a cell counts as an echo, dB. One of 8,192 cells of noise exceeds it.
const ECHO_THRESHOLD_DB: f32 = 10.0;
/// The same level as `1 + P / N`.
const ECHO_THRESHOLD: f64 = 10.0;
/// Level of the strongest cell of a range bin above which the bin has a mean velocity, dB. No cell of noise reaches it.
const VELOCITY_KNOWN_DB: f32 = 15.0;
/// Upper bound of levels, dB, which keeps sums of powers finite.
const MOST_DB: f32 = 350.0;
/// Number of range bins on either side of the strongest cell that count as its range.
const SAME_RANGE_BINS: i64 = 2;
/// Number of range bins by which change must be nearer than the strongest cell to be that of another person. Limbs and the window
/// of the range transform extend over fewer bins.
const OTHER_PERSON_BINS: usize = 6;
/// The same for strong change, if the strongest cell is not slow. Change of limbs and of the window is weaker, and a single standing
/// person has a slow strongest cell.
const CLOSE_PERSON_BINS: usize = 2;
/// Number of velocity bins on either side of the strongest cell that count as its velocity. Limbs are that much faster and slower.
const SAME_VELOCITY_BINS: i64 = 4;
/// Number of velocity bins on either side of zero that are slow. Echoes of a room at rest extend over them.
const SLOW_BINS: i64 = 1;
/// Levels below the strongest cell down to which cells are counted, dB.
const COUNTED_DB: [f32; 5] = [10.0, 15.0, 20.0, 25.0, 30.0];
/// Change from frame to frame, dB over noise: up to the first value a room counts as empty, from the second on as occupied.
/// Rooms at rest have up to 19 dB, sitting people 30 dB and more.
const CHANGE_DB: [f32; 2] = [20.0, 35.0];
/// Level of the strongest cell, dB: up to the first value a map has no motion within the frame, from the second on it has.
const MOTION_DB: [f32; 2] = [10.0, 25.0];
/// Distances at which cells of noise are compared, bins.
const NOISE_LAGS: [usize; 2] = [1, 2];
/// Difference by which one direction must exceed the other in a range bin to dominate it, dB.
const DOMINANCE_DB: f32 = 3.0;

/// Range of a cell relative to the strongest one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum RelativeRange {
    Nearer,
    Farther,
    Same,
}

/// Cell above the noise.
#[derive(Clone, Copy)]
struct Cell {
    row: usize,
    /// Signed number of velocity bins from zero. It is not 0, except for the default peak.
    velocity_bin: i64,
    level_db: f32,
    /// `1 + P / N` minus the threshold, so that sums change continuously when a cell crosses the threshold.
    excess: f64,
}

/// Computes the descriptors of a map: energies, ranges and velocities, and cells away from the strongest one.
///
/// `map_db` is `[range][velocity]`, `10 log10(1 + P / N)` of power over noise
/// ([`OverNoise`](crate::standardise::MapReference::OverNoise)). `motion` is that of [`Rdm`](radome_dsp::Rdm), or the default.
///
/// | index | what | unit |
/// |---|---|---|
/// | 0 | total energy of the cells above the noise, over noise | dB |
/// | 1, 2 | energy-weighted mean and spread of range | that of `range_step` |
/// | 3, 4 | magnitude of the energy-weighted mean of velocity, and its spread | that of `velocity_step` |
/// | 5 | spread over range bins of the bins' mean velocity | that of `velocity_step` |
/// | 6 | level of the strongest cell | dB |
/// | 7, 8 | its range, and `ln(1 + range bin)` | that of `range_step`, 1 |
/// | 9 | magnitude of its velocity | that of `velocity_step` |
/// | 10 to 15 | cells of the opposite direction, nearer, farther and at the same range: strongest level less that of the strongest cell, energy less the total energy | dB |
/// | 16 to 21 | the same for cells of another velocity | dB |
/// | 22 to 25 | the same for cells of the same velocity, nearer and farther | dB |
/// | 26 to 28 | strongest slow cell nearer, farther and at the same range, less the strongest cell | dB |
/// | 29 | energy of slow cells less the total energy | dB |
/// | 30, 31 | range bins in which the opposite direction is the stronger one by 3 dB, and in which it is the weaker one, `ln(1 + count)` | 1 |
/// | 32 to 36 | cells of the opposite direction down to 10, 15, 20, 25 and 30 dB below the strongest cell, `ln(1 + count)` | 1 |
/// | 37 to 41 | the same for cells of another velocity that are not at the same range | 1 |
/// | 42 | person without motion: strongest cell of zero velocity, 0 up to 20 dB and 1 from 35 dB on, times 1 where no other cell is above the noise, and 0 where the strongest one has 25 dB | 1 |
/// | 43, 44 | correlation of the levels of noise one and two velocity bins apart | 1 |
/// | 45, 46 | the same one and two range bins apart | 1 |
/// | 47 | person without motion nearer than one with motion: strongest cell of zero velocity more than six bins nearer than the strongest cell, 0 up to 20 dB and 1 from 35 dB on, times 0 where the strongest cell has 10 dB, and 1 where it has 25 dB | 1 |
/// | 48 | person without motion slightly nearer than one with motion: [`nearer_change`] of the strongest cell of zero velocity more than two bins nearer than the strongest cell; 0 where the strongest cell is slow | 1 |
/// | 49 | the same where the strongest cell approaches, 0 otherwise: change near a receding person may be caused by this person | 1 |
/// | 50 to 56 | quantities of [`Motion`] | rad, m, m, m, 1, m/s, 1 |
/// | 57 to 62 | 50 to 55 times 56: where somebody sits nearer than a walking person, the motion is that of one person | rad, m, m, m, 1, m/s |
///
/// Cells of zero velocity are used by 42 and 47 to 49, and by 56 to 62 through the motion. Cells of noise are those above 0 dB and up to
/// 10 dB that are not slow. Range bins whose cells are all equal hold no noise. A correlation is 0 without two different pairs of cells.
///
/// The same range is within two bins of the strongest cell, the same velocity within four, and slow is one bin from zero. The
/// opposite direction is more than a bin beyond zero as seen from the strongest cell.
///
/// Descriptor 49 is the only one of a single map that changes when approaching and receding are exchanged about zero Doppler. Otherwise the
/// direction of motion carries no information on the number of people. Magnitudes of velocities are inputs, because a linear classifier
/// cannot compute them.
///
/// Zero velocity is at index `velocity_bins / 2`, range 0 at row 0. Cells of an incomplete last row are left out. Only
/// cells above 10 dB count, and energies are `1 + P / N` less 10, so that cells of noise do not count. Means and
/// spreads of range and velocity are multiplied by `energy / (energy + 10)`, so that a single cell of noise moves them
/// little. For the mean of range, this factor applies to its distance from the middle of the axis. Without any energy,
/// the mean of range is the middle of the axis and the others are 0. The spread over range bins is the standard
/// deviation over bins whose strongest cell is above 15 dB, or 0 without such bins.
///
/// Among equal cells, the strongest cell is the one with the smallest index. A map without cells above 10 dB has a
/// strongest cell of 10 dB in the middle of the range axis, at velocity 0. A region without cells has a strongest level
/// of 10 dB and no energy.
///
/// Finite for any finite cells and motion; all are NaN if a cell is not finite.
pub fn descriptors(
    map_db: &[f32],
    motion: Motion,
    velocity_bins: usize,
    range_step: f64,
    velocity_step: f64,
) -> [f32; DESCRIPTORS] {
    if map_db.iter().any(|level| !level.is_finite()) {
        return [f32::NAN; DESCRIPTORS];
    }
    let columns = velocity_bins.max(1);
    let rows = map_db.len() / columns;
    let cells: Vec<Cell> = map_db[..rows * columns]
        .iter()
        .enumerate()
        .filter(|(index, level_db)| **level_db > ECHO_THRESHOLD_DB && index % columns != columns / 2)
        .map(|(index, &level_db)| {
            let level_db = level_db.min(MOST_DB);
            Cell {
                row: index / columns,
                velocity_bin: (index % columns) as i64 - (columns / 2) as i64,
                level_db,
                excess: 10f64.powf(0.1 * f64::from(level_db)) - ECHO_THRESHOLD,
            }
        })
        .collect();
    let peak = find_peak(&cells, rows);
    let strongest_change_db =
        |rows: usize| map_db.iter().skip(columns / 2).step_by(columns).take(rows).copied().fold(f32::MIN, f32::max);
    let moving = ramp(MOTION_DB, peak.level_db);
    let mut values = moments(&cells, rows, range_step, velocity_step);
    values.extend(relative_to_peak(&cells, &peak, range_step, velocity_step));
    values.push(ramp(CHANGE_DB, strongest_change_db(rows)) * (1.0 - moving));
    values.extend(noise_correlations(&map_db[..rows * columns], columns));
    let nearer_db = strongest_change_db(peak.row.saturating_sub(OTHER_PERSON_BINS));
    values.push(ramp(CHANGE_DB, nearer_db) * moving);
    let close_db = strongest_change_db(peak.row.saturating_sub(CLOSE_PERSON_BINS));
    let is_moving = peak.velocity_bin.abs() > SLOW_BINS;
    let close_person = nearer_change(close_db, peak.level_db);
    values.push(if is_moving { close_person } else { 0.0 });
    values.push(if is_moving && peak.velocity_bin < 0 { close_person } else { 0.0 });
    let motion = motion.to_array().map(f64::from);
    values.extend(motion);
    values.extend(motion[..OF_MOVING].iter().map(|quantity| quantity * motion[OF_MOVING]));
    std::array::from_fn(|k| values.get(k).map_or(f32::NAN, |&value| value as f32))
}

/// Descriptors 0 to 5.
fn moments(cells: &[Cell], rows: usize, range_step: f64, velocity_step: f64) -> Vec<f64> {
    let range_of = |cell: &Cell| cell.row as f64 * range_step;
    let velocity_of = |cell: &Cell| cell.velocity_bin as f64 * velocity_step;
    let energy: f64 = cells.iter().map(|cell| cell.excess).sum();
    let share = energy / (energy + ECHO_THRESHOLD);
    let (range, velocity) = (weighted_mean(cells, range_of), weighted_mean(cells, velocity_of));
    let range_variance = weighted_mean(cells, |cell| (range_of(cell) - range).powi(2));
    let velocity_variance = weighted_mean(cells, |cell| (velocity_of(cell) - velocity).powi(2));
    let middle = 0.5 * rows.saturating_sub(1) as f64 * range_step;
    let strong_bins = cells.chunk_by(|a, b| a.row == b.row).filter(|bin| strongest_db(*bin) > VELOCITY_KNOWN_DB);
    let velocities: Vec<f64> = strong_bins.map(|bin| weighted_mean(bin, velocity_of)).collect();
    vec![
        energy_to_db(energy),
        middle + share * (range - middle),
        share * range_variance.sqrt(),
        share * velocity.abs(),
        share * velocity_variance.sqrt(),
        standard_deviation(&velocities),
    ]
}

/// Strongest cell, or a default one at the threshold in the middle of the range axis.
fn find_peak(cells: &[Cell], rows: usize) -> Cell {
    let default = Cell { row: rows.saturating_sub(1) / 2, velocity_bin: 0, level_db: ECHO_THRESHOLD_DB, excess: 0.0 };
    *cells.iter().fold(&default, |best, cell| if cell.level_db > best.level_db { cell } else { best })
}

/// Descriptors 6 to 41. `peak` is the strongest cell.
fn relative_to_peak(cells: &[Cell], peak: &Cell, range_step: f64, velocity_step: f64) -> Vec<f64> {
    let direction = if peak.velocity_bin < 0 { -1 } else { 1 };
    let relative_range = |cell: &Cell| match cell.row as i64 - peak.row as i64 {
        bins if bins < -SAME_RANGE_BINS => RelativeRange::Nearer,
        bins if bins > SAME_RANGE_BINS => RelativeRange::Farther,
        _ => RelativeRange::Same,
    };
    let is_opposite = |cell: &Cell| cell.velocity_bin * direction < -SLOW_BINS;
    let is_along = |cell: &Cell| cell.velocity_bin * direction > SLOW_BINS;
    let is_slow = |cell: &Cell| cell.velocity_bin.abs() <= SLOW_BINS;
    let has_other_velocity = |cell: &Cell| (cell.velocity_bin - peak.velocity_bin).abs() > SAME_VELOCITY_BINS;
    let total_db = energy_db(cells.iter());

    let mut values = vec![
        f64::from(peak.level_db),
        peak.row as f64 * range_step,
        (peak.row as f64).ln_1p(),
        peak.velocity_bin.abs() as f64 * velocity_step,
    ];
    let relative_level = |region: &dyn Fn(&Cell) -> bool| {
        f64::from(strongest_db(cells.iter().filter(|cell| region(cell))) - peak.level_db)
    };
    let mut push_level_and_energy = |region: &dyn Fn(&Cell) -> bool| {
        values.push(relative_level(region));
        values.push(energy_db(cells.iter().filter(|cell| region(cell))) - total_db);
    };
    let ranges = [RelativeRange::Nearer, RelativeRange::Farther, RelativeRange::Same];
    for range in ranges {
        push_level_and_energy(&|cell| is_opposite(cell) && relative_range(cell) == range);
    }
    for range in ranges {
        push_level_and_energy(&|cell| has_other_velocity(cell) && relative_range(cell) == range);
    }
    for range in [RelativeRange::Nearer, RelativeRange::Farther] {
        push_level_and_energy(&|cell| !has_other_velocity(cell) && relative_range(cell) == range);
    }
    values.extend(ranges.map(|range| relative_level(&|cell| is_slow(cell) && relative_range(cell) == range)));
    values.push(energy_db(cells.iter().filter(|cell| is_slow(cell))) - total_db);

    let (mut opposite_bins, mut along_bins) = (0, 0);
    for bin in cells.chunk_by(|a, b| a.row == b.row) {
        let opposite_db = strongest_db(bin.iter().filter(|cell| is_opposite(cell)));
        let along_db = strongest_db(bin.iter().filter(|cell| is_along(cell)));
        opposite_bins += usize::from(opposite_db > along_db + DOMINANCE_DB);
        along_bins += usize::from(along_db > opposite_db + DOMINANCE_DB);
    }
    values.extend([ln_1p_count(opposite_bins), ln_1p_count(along_bins)]);
    let count = |within_db: f32, region: &dyn Fn(&Cell) -> bool| {
        let least_db = peak.level_db - within_db;
        ln_1p_count(cells.iter().filter(|cell| cell.level_db > least_db && region(cell)).count())
    };
    values.extend(COUNTED_DB.map(|within_db| count(within_db, &is_opposite)));
    let is_elsewhere = |cell: &Cell| has_other_velocity(cell) && relative_range(cell) != RelativeRange::Same;
    values.extend(COUNTED_DB.map(|within_db| count(within_db, &is_elsewhere)));
    values
}

/// Descriptors 43 to 46: correlation of levels of noise at a distance of some velocity bins, and of some range bins.
fn noise_correlations(map_db: &[f32], columns: usize) -> [f64; 2 * NOISE_LAGS.len()] {
    let is_slow = |column: usize| column.abs_diff(columns / 2) <= SLOW_BINS as usize;
    // Levels of noise, and NaN in the other cells.
    let mut noise = vec![f32::NAN; map_db.len()];
    for (levels, row) in noise.chunks_mut(columns).zip(map_db.chunks(columns)) {
        if row.iter().all(|level| *level == row[0]) {
            continue;
        }
        for (column, (level, &cell_db)) in levels.iter_mut().zip(row).enumerate() {
            if cell_db > 0.0 && cell_db <= ECHO_THRESHOLD_DB && !is_slow(column) {
                *level = cell_db;
            }
        }
    }
    let lag_correlation = |range_lag: usize, velocity_lag: usize| {
        let rows = noise.chunks(columns).zip(noise.chunks(columns).skip(range_lag));
        let pairs = rows.flat_map(|(row, other)| row.iter().zip(other.iter().skip(velocity_lag)));
        let noise_pairs = pairs.filter(|(a, b)| !a.is_nan() && !b.is_nan());
        correlation(noise_pairs.map(|(a, b)| [f64::from(*a), f64::from(*b)]))
    };
    let velocity = NOISE_LAGS.map(|lag| lag_correlation(0, lag));
    let range = NOISE_LAGS.map(|lag| lag_correlation(lag, 0));
    [velocity[0], velocity[1], range[0], range[1]]
}

/// Pearson's correlation of pairs; 0 where either side is constant.
fn correlation(pairs: impl Iterator<Item = [f64; 2]>) -> f64 {
    let [mut count, mut a, mut b, mut aa, mut bb, mut ab] = [0.0; 6];
    for [x, y] in pairs {
        count += 1.0;
        a += x;
        b += y;
        aa += x * x;
        bb += y * y;
        ab += x * y;
    }
    let (xx, yy, xy) = (count * aa - a * a, count * bb - b * b, count * ab - a * b);
    // Rounding errors of a constant are below this bound.
    let is_constant = xx <= 1e-9 * count * aa || yy <= 1e-9 * count * bb;
    if is_constant { 0.0 } else { xy / (xx * yy).sqrt() }
}

/// Weight by a level: 0 up to the first level, 1 from the second on, linear between them.
fn ramp([none_db, all_db]: [f32; 2], level_db: f32) -> f64 {
    f64::from(((level_db - none_db) / (all_db - none_db)).clamp(0.0, 1.0))
}

/// Mean of `quantity` over cells, weighted by their energy; 0 without cells.
fn weighted_mean(cells: &[Cell], quantity: impl Fn(&Cell) -> f64) -> f64 {
    let energy: f64 = cells.iter().map(|cell| cell.excess).sum();
    let sum: f64 = cells.iter().map(|cell| cell.excess * quantity(cell)).sum();
    sum / energy.max(f64::MIN_POSITIVE)
}

/// Largest level of the cells, dB; the echo threshold without cells.
fn strongest_db<'a>(cells: impl IntoIterator<Item = &'a Cell>) -> f32 {
    cells.into_iter().fold(ECHO_THRESHOLD_DB, |most, cell| cell.level_db.max(most))
}

fn energy_db<'a>(cells: impl Iterator<Item = &'a Cell>) -> f64 {
    energy_to_db(cells.map(|cell| cell.excess).sum())
}

fn energy_to_db(energy: f64) -> f64 {
    10.0 * (1.0 + energy).log10()
}

fn standard_deviation(values: &[f64]) -> f64 {
    let count = values.len().max(1) as f64;
    let mean = values.iter().sum::<f64>() / count;
    (values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / count).sqrt()
}

fn ln_1p_count(count: usize) -> f64 {
    (count as f64).ln_1p()
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::Rng;

    const RANGE_STEP_M: f64 = 0.15;
    const VELOCITY_STEP_M_PER_S: f64 = 0.1;
    // Indices of the first descriptor of each group.
    const PEAK: usize = 6;
    const OPPOSITE: usize = 10;
    const OTHER_VELOCITY: usize = 16;
    const SAME_VELOCITY: usize = 22;
    const SLOW: usize = 26;
    const DOMINATED_BINS: usize = 30;
    const COUNTS: usize = 32;
    const CHANGE: usize = 42;
    const NOISE: usize = 43;
    const CHANGE_NEARER: usize = 47;
    const CHANGE_CLOSE: usize = 48;
    const CHANGE_CLOSE_APPROACHING: usize = 49;

    fn describe(map: &[f32], columns: usize) -> [f32; DESCRIPTORS] {
        descriptors(map, Motion::default(), columns, RANGE_STEP_M, VELOCITY_STEP_M_PER_S)
    }

    /// Map of 64 x 64 cells with echoes of these range bins, velocity bins and levels, and no other power.
    fn echoes(echoes: &[(usize, usize, f32)]) -> Vec<f32> {
        let mut map = vec![0.0; 64 * 64];
        echoes.iter().for_each(|&(row, column, level)| map[row * 64 + column] = level);
        map
    }

    fn noise(rows: usize, columns: usize, seed: u64) -> Vec<f32> {
        let mut rng = crate::random::stream(seed, "noise", 0);
        let mut cell = || 10.0 * (1.0 - rng.random_range(f32::MIN_POSITIVE..1.0).ln()).log10();
        (0..rows * columns).map(|_| cell()).collect()
    }

    fn assert_near(what: &str, found: f32, expected: f64, tolerance: f64) {
        assert!((f64::from(found) - expected).abs() <= tolerance, "{what}: {found}, expected {expected}");
    }

    #[test]
    fn one_echo_has_its_level_range_and_speed() {
        let speed = 0.8;
        for column in [40, 24] {
            let found = describe(&echoes(&[(20, column, 40.0)]), 64);
            assert_near("energy", found[0], 40.0, 0.01);
            assert_near("range", found[1], 20.0 * RANGE_STEP_M, 0.01);
            assert_near("speed", found[3], speed, 0.01);
            for spread in [2, 4, 5] {
                assert_near("spread", found[spread], 0.0, 1e-6);
            }
            assert_eq!(found[PEAK], 40.0);
            assert_near("range", found[PEAK + 1], 20.0 * RANGE_STEP_M, 1e-6);
            assert_near("logarithm of range", found[PEAK + 2], 21f64.ln(), 1e-6);
            assert_near("speed", found[PEAK + 3], speed, 1e-6);
            // Without other echoes, levels are those of the threshold, 30 dB lower, and there is no energy.
            for k in 0..8 {
                assert_near("level apart", found[OPPOSITE + 2 * k], -30.0, 1e-6);
                assert_near("energy apart", found[OPPOSITE + 2 * k + 1], -40.0, 0.01);
            }
            assert_near("slow at the range", found[SLOW + 2], -30.0, 1e-6);
            assert_near("slow energy", found[SLOW + 3], -40.0, 0.01);
            assert_near("bins along", found[DOMINATED_BINS + 1], 2f64.ln(), 1e-6);
            assert!(
                found[DOMINATED_BINS] == 0.0 && found[COUNTS..OF_CELLS].iter().all(|&count| count == 0.0),
                "{found:?}"
            );
        }
    }

    /// Maps of a sitting person, alone or with a walking one.
    #[test]
    fn change_at_zero_velocity_stands_apart() {
        for (level, change) in [(15.0, 0.0), (20.0, 0.0), (27.5, 0.5), (35.0, 1.0), (60.0, 1.0)] {
            let (sits, nobody) = (describe(&echoes(&[(5, 32, level)]), 64), describe(&echoes(&[]), 64));
            assert_eq!(sits[..CHANGE], nobody[..CHANGE]);
            assert_eq!((sits[CHANGE], nobody[CHANGE]), (change, 0.0));
            for (walker_db, still) in [(12.0, 1.0 - 2.0 / 15.0), (40.0, 0.0)] {
                let walks = describe(&echoes(&[(5, 32, level), (20, 40, walker_db)]), 64);
                assert_eq!(walks[..CHANGE], describe(&echoes(&[(20, 40, walker_db)]), 64)[..CHANGE]);
                assert_near("change beside who walks", walks[CHANGE], f64::from(change) * still, 1e-6);
            }
        }
    }

    /// Maps of a sitting person who is nearer than a walking one, at the same range, or farther.
    #[test]
    fn change_nearer_than_the_motion_is_another_person() {
        for (row, walker_db, expected) in
            [(5, 40.0, 0.5), (13, 40.0, 0.5), (14, 40.0, 0.0), (20, 40.0, 0.0), (30, 40.0, 0.0), (5, 17.5, 0.25)]
        {
            let found = describe(&echoes(&[(row, 32, 27.5), (20, 40, walker_db)]), 64);
            assert_near("change nearer than who walks", found[CHANGE_NEARER], expected, 1e-6);
        }
        assert_eq!(describe(&echoes(&[(5, 32, 60.0)]), 64)[CHANGE_NEARER], 0.0);
        assert_eq!(describe(&echoes(&[(5, 40, 60.0), (2, 32, 60.0)]), 64)[CHANGE_NEARER], 0.0);
    }

    /// Maps of a person who sits slightly nearer than a walking one. The change is strong, at least as strong as the motion, and the
    /// motion is not slow.
    #[test]
    fn strong_change_close_to_the_motion_is_another_person() {
        // Row and level of the change; velocity bin and level of the walker in row 20.
        for (row, change_db, bin, walker_db, expected) in [
            (5, 45.0, 40, 40.0, 1.0),
            (17, 45.0, 40, 40.0, 1.0),
            (18, 45.0, 40, 40.0, 0.0),
            (17, 37.5, 40, 26.0, 0.5),
            (17, 33.0, 40, 26.0, 0.0),
            (17, 45.0, 40, 50.0, 0.5),
            (17, 45.0, 40, 55.0, 0.0),
            (17, 45.0, 40, 20.0, 0.5),
            (17, 45.0, 40, 14.0, 0.0),
            (17, 45.0, 34, 40.0, 1.0),
            (17, 45.0, 33, 40.0, 0.0),
        ] {
            let change = (row, 32, change_db);
            let recedes = describe(&echoes(&[change, (20, bin, walker_db)]), 64);
            assert_near("change close to who recedes", recedes[CHANGE_CLOSE], expected, 1e-6);
            assert_eq!(recedes[CHANGE_CLOSE_APPROACHING], 0.0);
            let approaches = describe(&echoes(&[change, (20, 64 - bin, walker_db)]), 64);
            assert_near("change close to who approaches", approaches[CHANGE_CLOSE], expected, 1e-6);
            assert_eq!(approaches[CHANGE_CLOSE_APPROACHING], approaches[CHANGE_CLOSE]);
        }
        assert_eq!(describe(&echoes(&[(5, 32, 60.0)]), 64)[CHANGE_CLOSE..OF_CELLS], [0.0; 2]);
    }

    #[test]
    fn means_shift_by_as_much_as_the_echo() {
        let of_echo = |row, column| describe(&echoes(&[(row, column, 50.0)]), 64);
        for bins in 1..20 {
            let (original, shifted) = (of_echo(10, 33), of_echo(10 + bins, 33 + bins));
            for range in [1, PEAK + 1] {
                assert_near("range", shifted[range] - original[range], bins as f64 * RANGE_STEP_M, 1e-3);
            }
            for speed in [3, PEAK + 3] {
                assert_near("speed", shifted[speed] - original[speed], bins as f64 * VELOCITY_STEP_M_PER_S, 1e-3);
            }
        }
    }

    /// Maps of a receding person, a multipath echo of the same motion, and an approaching person.
    #[test]
    fn people_in_opposite_directions_are_separated() {
        let (first, ghost, second) = ((20, 40, 40.0), (30, 41, 25.0), (12, 26, 31.0));
        let alone = describe(&echoes(&[first, ghost]), 64);
        assert_near("the ghost", alone[SAME_VELOCITY + 2], -15.0, 1e-6);
        for (k, level) in
            [(OPPOSITE, -30.0), (OPPOSITE + 2, -30.0), (OTHER_VELOCITY, -30.0), (OTHER_VELOCITY + 2, -30.0)]
        {
            assert_near("apart", alone[k], level, 1e-6);
        }
        let two = describe(&echoes(&[first, ghost, second]), 64);
        assert_near("nearer and opposite", two[OPPOSITE], -9.0, 1e-6);
        assert_near("farther and opposite", two[OPPOSITE + 2], -30.0, 1e-6);
        assert_near("nearer and of another velocity", two[OTHER_VELOCITY], -9.0, 1e-6);
        assert_near("bins against", two[DOMINATED_BINS], 2f64.ln(), 1e-6);
        assert_near("bins along", two[DOMINATED_BINS + 1], 3f64.ln(), 1e-6);
        for counts in [COUNTS, COUNTS + COUNTED_DB.len()] {
            assert_near("cells within 10 dB", two[counts], 2f64.ln(), 1e-6);
        }
        // At twice the power and another range, all relative descriptors stay the same.
        let moved = describe(&echoes(&[(23, 40, 43.0), (33, 41, 28.0), (15, 26, 34.0)]), 64);
        assert_near("nearer and opposite", moved[OPPOSITE], -9.0, 1e-6);
        assert_eq!(moved[DOMINATED_BINS..], two[DOMINATED_BINS..]);
    }

    /// Compares sums with their definition, cell by cell.
    #[test]
    fn sums_are_those_of_the_definition() {
        let (rows, columns) = (24, 33);
        let mut map = noise(rows, columns, 3);
        for (k, level) in map.iter_mut().enumerate() {
            *level += ((k * 7919) % 31) as f32;
        }
        let found = describe(&map, columns);
        let of =
            |k: usize| [(k / columns) as f64 * RANGE_STEP_M, ((k % columns) as f64 - 16.0) * VELOCITY_STEP_M_PER_S];
        let excess = |level: f32| (10f64.powf(f64::from(level) / 10.0) - 10.0).max(0.0);
        map.iter_mut().skip(columns / 2).step_by(columns).for_each(|level| *level = 0.0);
        let energy: f64 = map.iter().map(|&level| excess(level)).sum();
        assert_near("energy", found[0], 10.0 * (1.0 + energy).log10(), 1e-4);
        for (axis, middle) in [(0, 11.5 * RANGE_STEP_M), (1, 0.0)] {
            let weighted = |f: &dyn Fn(f64) -> f64| {
                map.iter().enumerate().map(|(k, &level)| excess(level) * f(of(k)[axis])).sum::<f64>() / energy
            };
            let mean = weighted(&|x| x);
            let share = energy / (energy + 10.0);
            assert_near("mean", found[1 + 2 * axis], (middle + share * (mean - middle)).abs(), 1e-5);
            assert_near("spread", found[2 + 2 * axis], share * weighted(&|x| (x - mean).powi(2)).sqrt(), 1e-5);
        }
    }

    /// Compares regions with a search over the whole map by their definition. Maps have noise, echoes of any level, and equal cells.
    #[test]
    fn regions_are_those_of_the_slow_search() {
        for (rows, columns, seed) in [(20, 17, 1), (1, 40, 2), (33, 1, 3), (7, 8, 4), (64, 64, 5)] {
            let mut map: Vec<f32> = noise(rows, columns, seed).iter().map(|level| (level * 3.0).round()).collect();
            let found = describe(&map, columns);
            let change = map.iter().skip(columns / 2).step_by(columns).fold(0.0, |most: f32, level| most.max(*level));
            let change = f64::from((change - 20.0) / 15.0).clamp(0.0, 1.0);
            map.iter_mut().skip(columns / 2).step_by(columns).for_each(|level| *level = 0.0);
            let position = |k: usize| ((k / columns) as i64, (k % columns) as i64 - (columns / 2) as i64);
            let level = |k: usize| f64::from(map[k]);
            let peak = (0..map.len()).filter(|&k| map[k] > 10.0).rev().max_by(|&a, &b| map[a].total_cmp(&map[b]));
            let top = peak.map_or(10.0, level);
            assert_near("change of who stands", found[CHANGE], change * ((25.0 - top) / 15.0).clamp(0.0, 1.0), 1e-6);
            let Some(peak) = peak else { continue };
            let (row, speed) = position(peak);
            let excess = |k: usize| (10f64.powf(level(k) / 10.0) - 10.0).max(0.0);
            let db = |energy: f64| 10.0 * (1.0 + energy).log10();
            let total: f64 = (0..map.len()).map(excess).sum();
            let direction = speed.signum();
            let ranges: [&dyn Fn(i64) -> bool; 3] = [&|r| r < row - 2, &|r| r > row + 2, &|r| (r - row).abs() <= 2];
            let velocities: [&dyn Fn(i64) -> bool; 3] =
                [&|v| v * direction < -1, &|v| (v - speed).abs() > 4, &|v| (v - speed).abs() <= 4];
            for (at, (velocity, range)) in
                velocities.iter().flat_map(|v| ranges.iter().map(move |r| (v, r))).take(8).enumerate()
            {
                let inside: Vec<usize> =
                    (0..map.len()).filter(|&k| range(position(k).0) && velocity(position(k).1)).collect();
                let strongest = inside.iter().fold(10.0, |most: f64, &k| most.max(level(k)));
                let energy: f64 = inside.iter().map(|&k| excess(k)).sum();
                assert_near("level", found[OPPOSITE + 2 * at], strongest - top, 1e-5);
                assert_near("energy", found[OPPOSITE + 2 * at + 1], db(energy) - db(total), 1e-3);
            }
            for (at, range) in ranges.iter().enumerate() {
                let slow = (0..map.len()).filter(|&k| range(position(k).0) && position(k).1.abs() <= 1);
                assert_near("slow", found[SLOW + at], slow.fold(10.0, |most: f64, k| most.max(level(k))) - top, 1e-5);
            }
            for (at, within) in COUNTED_DB.into_iter().enumerate() {
                let count = |region: &dyn Fn(usize) -> bool| {
                    let counted = |&k: &usize| map[k] > 10.0 && level(k) > top - f64::from(within) && region(k);
                    ((0..map.len()).filter(counted).count() as f64).ln_1p()
                };
                let opposite = |k: usize| position(k).1 * direction < -1;
                let other = |k: usize| (position(k).1 - speed).abs() > 4 && (position(k).0 - row).abs() > 2;
                assert_near("opposite cells", found[COUNTS + at], count(&opposite), 1e-5);
                assert_near("other cells", found[COUNTS + COUNTED_DB.len() + at], count(&other), 1e-5);
            }
        }
    }

    #[test]
    fn noise_alone_is_hardly_counted() {
        for seed in 0..5 {
            let found = describe(&noise(64, 64, seed), 64);
            // One cell in 8,000 is above 10 dB, none above 15 dB.
            assert!(found[0] < 20.0 && found[PEAK] < 13.0 && found[5] == 0.0, "{found:?}");
            assert!(found[COUNTS..].iter().all(|&count| count < 8f32.ln()), "{found:?}");
        }
    }

    /// Cells of noise are repeated along an axis, as on axes of twice the resolution. Correlations are also compared with their
    /// definition, cell by cell.
    #[test]
    fn correlations_of_noise_show_the_resolution() {
        /// Three standard deviations of a correlation over a thousand cells, some of which are used twice.
        const SPREAD: f64 = 0.12;
        let cells = noise(64, 64, 6);
        let repeated = |rows: usize, columns: usize| -> Vec<f32> {
            (0..64 * 64).map(|k| cells[k / 64 / rows * 64 + k % 64 / columns]).collect()
        };
        for (rows, columns, expected) in
            [(1, 1, [0.0, 0.0]), (1, 2, [0.5, 0.0]), (2, 1, [0.0, 0.5]), (2, 2, [0.5, 0.5])]
        {
            let found = describe(&repeated(rows, columns), 64);
            for (axis, expected) in expected.into_iter().enumerate() {
                assert_near("one bin apart", found[NOISE + 2 * axis], expected, SPREAD);
                assert_near("two bins apart", found[NOISE + 2 * axis + 1], 0.0, SPREAD);
            }
        }
        // An echo, its range bin and bins without noise only reduce the number of pairs.
        let mut map = repeated(1, 2);
        map[..5 * 64].fill(3.0);
        (0..64).for_each(|column| map[30 * 64 + column] += 40.0);
        let found = describe(&map, 64);
        assert_near("beside an echo", found[NOISE], 0.5, SPREAD);
        let is_noise = |row: usize, column: usize| {
            row >= 5 && row != 30 && !(31..=33).contains(&column) && (1e-9..=10.0).contains(&map[row * 64 + column])
        };
        for (k, [rows, columns]) in [[0, 1], [0, 2], [1, 0], [2, 0]].into_iter().enumerate() {
            let pairs: Vec<[f64; 2]> = (0..64 - rows)
                .flat_map(|row| (0..64 - columns).map(move |column| [row, column]))
                .filter(|&[row, column]| is_noise(row, column) && is_noise(row + rows, column + columns))
                .map(|[row, column]| [map[row * 64 + column], map[(row + rows) * 64 + column + columns]].map(f64::from))
                .collect();
            let mean = |f: &dyn Fn(&[f64; 2]) -> f64| pairs.iter().map(f).sum::<f64>() / pairs.len() as f64;
            let centre = [mean(&|pair| pair[0]), mean(&|pair| pair[1])];
            let product = |a: usize, b: usize| mean(&|pair| (pair[a] - centre[a]) * (pair[b] - centre[b]));
            assert_near(
                "by definition",
                found[NOISE + k],
                product(0, 1) / (product(0, 0) * product(1, 1)).sqrt(),
                1e-5,
            );
        }
    }

    /// Descriptors 0 to 48 stay the same if approaching and receding are exchanged about zero Doppler.
    #[test]
    fn directions_can_be_exchanged() {
        let (rows, columns) = (40, 33);
        let mut map: Vec<f32> = noise(rows, columns, 9).iter().map(|level| 3.0 * level).collect();
        let found = describe(&map, columns);
        map.chunks_exact_mut(columns).for_each(<[f32]>::reverse);
        let reversed = describe(&map, columns);
        for (a, b) in found[..CHANGE_CLOSE_APPROACHING].iter().zip(reversed) {
            assert!((a - b).abs() < 1e-5 * a.abs().max(1.0), "{a} {b}");
        }
    }

    #[test]
    fn steps_are_units() {
        let map: Vec<f32> = noise(20, 30, 4).iter().map(|level| 3.0 * level).collect();
        let (bins, metres) = (descriptors(&map, Motion::default(), 30, 1.0, 1.0), describe(&map, 30));
        for (k, (a, b)) in bins.iter().zip(metres).enumerate() {
            let unit = match k {
                1 | 2 | 7 => RANGE_STEP_M,
                3..=5 | 9 => VELOCITY_STEP_M_PER_S,
                _ => 1.0,
            };
            assert_near("unit", b, f64::from(*a) * unit, 1e-4);
        }
    }

    #[test]
    fn motion_comes_last() {
        let quantities = [0.5, 0.1, 0.2, 0.3, 0.9, 1.2, 0.5];
        let map = noise(20, 30, 4);
        let found = descriptors(&map, Motion::from_array(quantities), 30, RANGE_STEP_M, VELOCITY_STEP_M_PER_S);
        assert_eq!(found[..OF_CELLS], describe(&map, 30)[..OF_CELLS]);
        assert_eq!(found[OF_CELLS..][..Motion::QUANTITIES], quantities);
        let products = &found[OF_CELLS + Motion::QUANTITIES..];
        assert_eq!(products.len(), OF_MOVING);
        for (product, quantity) in products.iter().zip(quantities) {
            assert_eq!(*product, 0.5 * quantity);
        }
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn odd_maps_stay_finite() {
            let constant = |level: f32| vec![level; 24];
            for map in [Vec::new(), vec![50.0], constant(0.0), constant(12.0), constant(f32::MAX), constant(f32::MIN)] {
                for columns in [0, 1, 4, 7, 24, 100] {
                    let found = describe(&map, columns);
                    assert!(found.iter().all(|value| value.is_finite()), "{map:?} {columns}: {found:?}");
                }
            }
            // Of equal cells, the first is the strongest.
            let found = describe(&constant(12.0), 4);
            assert_eq!(found[PEAK..PEAK + 2], [12.0, 0.0]);
            // Without echoes, the strongest cell is in the middle of the range axis, at velocity 0.
            let found = describe(&constant(0.0), 4);
            assert_near("range", found[1], 2.5 * RANGE_STEP_M, 1e-6);
            assert_eq!((found[0], found[PEAK], found[PEAK + 3]), (0.0, 10.0, 0.0));
            assert!(found[2..PEAK].iter().chain(&found[OPPOSITE..OF_CELLS]).all(|&value| value == 0.0), "{found:?}");
        }

        #[test]
        fn a_cell_that_is_not_finite_is_not_hidden() {
            for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
                let mut map = vec![3.0; 24];
                map[7] = bad;
                assert!(describe(&map, 4).iter().all(|value| value.is_nan()), "{bad}");
            }
        }
    }
}
