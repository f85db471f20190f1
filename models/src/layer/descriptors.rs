//! Forty plain numbers that describe a map: what a linear classifier needs to count people, without any training.
//!
//! `dataset/features.rs` is something else: quantiles over many maps, by which simulated rooms are held against real ones.

use candle_core::{Error, Result, Shape, Tensor};

use super::Feature;
use super::crew::for_each_chunk;
use super::operation::{Argument, Gradients, Operation, apply};

/// Numbers that describe a map.
pub const DESCRIPTORS: usize = 40;

/// Levels above which cells are counted, dB over noise.
const CELL_LEVELS_DB: [f32; 6] = [6.0, 10.0, 15.0, 20.0, 25.0, 30.0];
/// Levels above which the strongest cells of range bins are counted, dB over noise.
const BIN_LEVELS_DB: [f32; 6] = [10.0, 15.0, 20.0, 25.0, 30.0, 35.0];
/// Level above which a cell stands out of noise, dB: of 8,192 cells of noise one does.
const STANDS_OUT_DB: f32 = 10.0;
/// The same as `1 + P / N`.
const STANDS_OUT: f64 = 10.0;
/// Strongest cell above which the mean velocity of a range bin is not that of noise, dB: no cell of noise reaches it.
const VELOCITY_KNOWN_DB: f32 = 15.0;
/// Level that stronger cells are taken for, dB, so that sums of powers stay finite.
const MOST_DB: f32 = 350.0;
/// Local maxima that are described.
const MAXIMA: usize = 8;
/// Cells to either side that a local maximum is the largest of, in range and in velocity.
const REACH: usize = 2;
const NAME: &str = "map_descriptors";

/// A cell that stands out of noise.
struct Cell {
    index: usize,
    row: usize,
    range: f64,
    velocity: f64,
    level_db: f32,
    /// `1 + P / N` less that at which cells begin to stand out, so that a cell does not enter a sum with a step.
    excess: f64,
}

/// Descriptors of a map: energies, places, counts and the strongest local maxima.
///
/// `map_db` is `[range][velocity]`, `10 log10(1 + P / N)` of power over noise
/// ([`OverNoise`](crate::standardise::MapReference::OverNoise)).
///
/// | index | what | unit |
/// |---|---|---|
/// | 0 | total energy of the cells that stand out of noise, over noise | dB |
/// | 1, 2 | energy-weighted mean and spread of range | that of `range_step` |
/// | 3, 4 | magnitude of the energy-weighted mean of velocity, and its spread | that of `velocity_step` |
/// | 5 | spread over range bins of the bins' mean velocity | that of `velocity_step` |
/// | 6 to 11 | cells above 6, 10, 15, 20, 25 and 30 dB, `ln(1 + count)` | 1 |
/// | 12 to 17 | range bins whose strongest cell is above 10, 15, 20, 25, 30 and 35 dB, `ln(1 + count)` | 1 |
/// | 18 to 25 | levels of the eight strongest local maxima, the strongest first | dB |
/// | 26 to 32 | ranges of the second to the eighth less that of the first | that of `range_step` |
/// | 33 to 39 | distances of their velocities from that of the first | that of `velocity_step` |
///
/// None of them changes when approaching and receding are exchanged about zero Doppler: the direction of motion says nothing
/// about the number of people, and a linear classifier can use the magnitude of a velocity only if it is given one.
///
/// Zero velocity is at index `velocity_bins / 2`, range 0 at row 0; cells of an incomplete last row are left out. Energies are
/// `1 + P / N` less 10, of the cells above 10 dB: cells of noise do not count. Means and spreads of range and velocity are
/// multiplied by `energy / (energy + 10)` (the mean of range as its distance from the middle of the axis), so that a single
/// cell of noise moves them little: without any energy, the mean of range is the middle of the axis and the others are 0.
///
/// A local maximum is above 10 dB and the largest of the 5 x 5 cells about it that the map has; of equals the one of the smallest
/// index. Maxima of equal level are in the order of their indices. Those that a map lacks have a level of 10 dB and the place of
/// the first. The spread over range bins is the standard deviation over bins whose strongest cell is above 15 dB, 0 without any.
///
/// Finite for any finite cells; all are NaN if a cell is not finite.
pub fn descriptors(map_db: &[f32], velocity_bins: usize, range_step: f64, velocity_step: f64) -> [f32; DESCRIPTORS] {
    if map_db.iter().any(|level| !level.is_finite()) {
        return [f32::NAN; DESCRIPTORS];
    }
    let columns = velocity_bins.max(1);
    let rows = map_db.len() / columns;
    let map = &map_db[..rows * columns];
    let cells: Vec<Cell> = map
        .iter()
        .enumerate()
        .filter(|(_, level_db)| **level_db > STANDS_OUT_DB)
        .map(|(index, &level_db)| {
            let (row, level_db) = (index / columns, level_db.min(MOST_DB));
            Cell {
                index,
                row,
                range: row as f64 * range_step,
                velocity: ((index % columns) as f64 - (columns / 2) as f64) * velocity_step,
                level_db,
                excess: 10f64.powf(0.1 * f64::from(level_db)) - STANDS_OUT,
            }
        })
        .collect();
    let bins: Vec<&[Cell]> = cells.chunk_by(|a, b| a.row == b.row).collect();
    let mut maxima: Vec<&Cell> = cells.iter().filter(|cell| is_maximum(map, columns, cell.index)).collect();
    // Stable: of equals the first stays first.
    maxima.sort_by(|a, b| b.level_db.total_cmp(&a.level_db));

    let energy: f64 = cells.iter().map(|cell| cell.excess).sum();
    let share = energy / (energy + STANDS_OUT);
    let (range, velocity) = (weighted_mean(&cells, |cell| cell.range), weighted_mean(&cells, |cell| cell.velocity));
    let range_variance = weighted_mean(&cells, |cell| (cell.range - range).powi(2));
    let velocity_variance = weighted_mean(&cells, |cell| (cell.velocity - velocity).powi(2));
    let middle = 0.5 * rows.saturating_sub(1) as f64 * range_step;
    let known = bins.iter().copied().filter(|bin| strongest_db(bin) > VELOCITY_KNOWN_DB);
    let velocities: Vec<f64> = known.map(|bin| weighted_mean(bin, |cell| cell.velocity)).collect();

    let mut values = vec![
        10.0 * (1.0 + energy).log10(),
        middle + share * (range - middle),
        share * range_variance.sqrt(),
        share * velocity.abs(),
        share * velocity_variance.sqrt(),
        standard_deviation(&velocities),
    ];
    values.extend(CELL_LEVELS_DB.map(|least| logarithm_of(map.iter().filter(|level| **level > least).count())));
    values.extend(BIN_LEVELS_DB.map(|least| logarithm_of(bins.iter().filter(|bin| strongest_db(bin) > least).count())));
    values.extend((0..MAXIMA).map(|k| f64::from(maxima.get(k).map_or(STANDS_OUT_DB, |cell| cell.level_db))));
    let from_first = |k: usize, of: fn(&Cell) -> f64| match (maxima.first(), maxima.get(k)) {
        (Some(first), Some(cell)) => of(cell) - of(first),
        _ => 0.0,
    };
    values.extend((1..MAXIMA).map(|k| from_first(k, |cell| cell.range)));
    values.extend((1..MAXIMA).map(|k| from_first(k, |cell| cell.velocity).abs()));
    std::array::from_fn(|k| values.get(k).map_or(f32::NAN, |&value| value as f32))
}

/// Mean of `of` over cells, weighted by their energy; 0 without any.
fn weighted_mean(cells: &[Cell], of: impl Fn(&Cell) -> f64) -> f64 {
    let energy: f64 = cells.iter().map(|cell| cell.excess).sum();
    let sum: f64 = cells.iter().map(|cell| cell.excess * of(cell)).sum();
    sum / energy.max(f64::MIN_POSITIVE)
}

fn strongest_db(cells: &[Cell]) -> f32 {
    cells.iter().fold(0.0, |most, cell| cell.level_db.max(most))
}

fn standard_deviation(values: &[f64]) -> f64 {
    let count = values.len().max(1) as f64;
    let mean = values.iter().sum::<f64>() / count;
    (values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / count).sqrt()
}

fn logarithm_of(count: usize) -> f64 {
    (count as f64).ln_1p()
}

/// Whether a cell is the largest of those about it, and the first of equals.
fn is_maximum(map: &[f32], columns: usize, index: usize) -> bool {
    let level = map[index];
    let near = |at: usize, length: usize| at.saturating_sub(REACH)..(at + REACH + 1).min(length);
    near(index / columns, map.len() / columns).all(|row| {
        near(index % columns, columns).all(|column| {
            let other = row * columns + column;
            map[other] < level || (map[other] == level && other >= index)
        })
    })
}

/// [`descriptors`] of each of the maps `[batch][range][velocity][1]`, dB over noise: `[batch][40]`, ranges and velocities in bins.
///
/// The input has no gradient: to ask for one is an error of the backward pass.
///
/// # Errors
/// The input has another shape, more than one channel, or maps without cells.
pub fn map_descriptors(input: &Tensor) -> Result<Tensor> {
    apply(&[input], MapDescriptors)
}

/// Batch, rows and columns of maps that can be described.
fn sizes_of(dims: &[usize]) -> Result<[usize; 3]> {
    match *dims {
        [batch, rows, columns, 1] if rows > 0 && columns > 0 => Ok([batch, rows, columns]),
        _ => Err(Error::Msg(format!("{NAME}: expected [batch, range, velocity, 1], got {dims:?}")).bt()),
    }
}

fn run([_, rows, columns]: [usize; 3], maps: &[f32], output: &mut [f32]) {
    for_each_chunk(output, DESCRIPTORS, |index, output| {
        let map = &maps[index * rows * columns..][..rows * columns];
        output.copy_from_slice(&descriptors(map, columns, 1.0, 1.0));
    });
}

impl Feature {
    /// [`map_descriptors`] without a graph of gradients: `[batch][1][1][40]`.
    ///
    /// # Errors
    /// Maps have more than one channel or no cells.
    pub fn map_descriptors(&self, output: &mut Feature) -> Result<()> {
        let sizes @ [batch, ..] = sizes_of(&self.dims())?;
        output.reshape([batch, 1, 1, DESCRIPTORS]);
        run(sizes, self.values(), output.values_mut());
        Ok(())
    }
}

struct MapDescriptors;

impl Operation for MapDescriptors {
    fn name(&self) -> &'static str {
        NAME
    }

    fn forward(&self, inputs: &[Argument<'_>]) -> Result<(Vec<f32>, Shape)> {
        let [input] = inputs else { candle_core::bail!("{NAME}: expected one input") };
        let sizes @ [batch, ..] = sizes_of(input.dims)?;
        let mut output = vec![0.0; batch * DESCRIPTORS];
        run(sizes, input.values, &mut output);
        Ok((output, Shape::from((batch, DESCRIPTORS))))
    }

    fn backward(&self, _inputs: &[Argument<'_>], _output: &[f32], _gradient: Vec<f32>) -> Result<Gradients> {
        candle_core::bail!("{NAME}: the maps have no gradient")
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::{Device, Var};
    use rand::Rng;

    const RANGE_STEP_M: f64 = 0.15;
    const VELOCITY_STEP_M_PER_S: f64 = 0.1;
    const CELLS: usize = 6;
    const BINS: usize = 12;
    const LEVELS: usize = 18;
    const RANGES: usize = 26;
    const VELOCITIES: usize = 33;

    fn describe(map: &[f32], columns: usize) -> [f32; DESCRIPTORS] {
        descriptors(map, columns, RANGE_STEP_M, VELOCITY_STEP_M_PER_S)
    }

    /// A map of 64 x 64 cells without any power but echoes of so many dB at range and velocity bins.
    fn echoes(at: &[(usize, usize, f32)]) -> Vec<f32> {
        let mut map = vec![0.0; 64 * 64];
        at.iter().for_each(|&(row, column, level)| map[row * 64 + column] = level);
        map
    }

    fn noise(rows: usize, columns: usize, seed: u64) -> Vec<f32> {
        let mut rng = crate::stream(seed, "noise", 0);
        let mut cell = || 10.0 * (1.0 - rng.random_range(f32::MIN_POSITIVE..1.0).ln()).log10();
        (0..rows * columns).map(|_| cell()).collect()
    }

    fn near(what: &str, found: f32, expected: f64, tolerance: f64) {
        assert!((f64::from(found) - expected).abs() <= tolerance, "{what}: {found}, expected {expected}");
    }

    #[test]
    fn one_echo_has_its_level_range_and_speed() {
        for (column, speed) in [(40, 0.8), (24, 0.8), (32, 0.0)] {
            let found = describe(&echoes(&[(20, column, 40.0)]), 64);
            near("energy", found[0], 40.0, 0.01);
            near("range", found[1], 20.0 * RANGE_STEP_M, 0.01);
            near("speed", found[3], speed, 0.01);
            for spread in [2, 4, 5] {
                near("spread", found[spread], 0.0, 1e-6);
            }
            found[CELLS..LEVELS].iter().for_each(|&count| near("count", count, 2f64.ln(), 1e-6));
            assert_eq!(found[LEVELS], 40.0);
            assert!(found[LEVELS + 1..RANGES].iter().all(|&level| level == STANDS_OUT_DB), "{found:?}");
            assert!(found[RANGES..].iter().all(|&difference| difference == 0.0), "{found:?}");
        }
    }

    #[test]
    fn an_echo_that_moves_moves_the_means_by_as_much() {
        let of = |row, column| describe(&echoes(&[(row, column, 50.0)]), 64);
        for bins in 1..20 {
            let (near_by, further) = (of(10, 33), of(10 + bins, 33 + bins));
            near("range", further[1] - near_by[1], bins as f64 * RANGE_STEP_M, 1e-3);
            near("speed", further[3] - near_by[3], bins as f64 * VELOCITY_STEP_M_PER_S, 1e-3);
        }
    }

    #[test]
    fn two_echoes_are_described_by_level_and_by_where_the_second_is() {
        let found = describe(&echoes(&[(20, 40, 37.0), (12, 30, 40.0), (13, 31, 39.0)]), 64);
        // The third is beside the second, so no local maximum.
        assert_eq!(found[LEVELS..LEVELS + 3], [40.0, 37.0, STANDS_OUT_DB]);
        near("range of the second", found[RANGES], 8.0 * RANGE_STEP_M, 1e-6);
        near("speed of the second", found[VELOCITIES], 10.0 * VELOCITY_STEP_M_PER_S, 1e-6);
        let velocities = [-0.2, -0.1, 0.8];
        let mean = velocities.iter().sum::<f64>() / 3.0;
        let variance = velocities.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / 3.0;
        near("spread over bins", found[5], variance.sqrt(), 1e-6);
        found[CELLS..LEVELS].iter().for_each(|&count| near("count", count, 4f64.ln(), 1e-6));
    }

    /// The definition, cell by cell and over the whole map for each.
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
        let energy: f64 = map.iter().map(|&level| excess(level)).sum();
        near("energy", found[0], 10.0 * (1.0 + energy).log10(), 1e-4);
        for (axis, middle) in [(0, 11.5 * RANGE_STEP_M), (1, 0.0)] {
            let weighted = |f: &dyn Fn(f64) -> f64| {
                map.iter().enumerate().map(|(k, &level)| excess(level) * f(of(k)[axis])).sum::<f64>() / energy
            };
            let mean = weighted(&|x| x);
            let share = energy / (energy + 10.0);
            near("mean", found[1 + 2 * axis], (middle + share * (mean - middle)).abs(), 1e-5);
            near("spread", found[2 + 2 * axis], share * weighted(&|x| (x - mean).powi(2)).sqrt(), 1e-5);
        }
        for (k, least) in CELL_LEVELS_DB.into_iter().enumerate() {
            let count = map.iter().filter(|&&level| level > least).count();
            near("cells", found[CELLS + k], (1.0 + count as f64).ln(), 1e-6);
        }
        for (k, least) in BIN_LEVELS_DB.into_iter().enumerate() {
            let count = map.chunks_exact(columns).filter(|row| row.iter().any(|&level| level > least)).count();
            near("bins", found[BINS + k], (1.0 + count as f64).ln(), 1e-6);
        }
    }

    /// Every cell against all cells of the map.
    fn slow_maxima(map: &[f32], columns: usize) -> Vec<usize> {
        let place = |k: usize| ((k / columns) as i64, (k % columns) as i64);
        let beaten = |k: usize, other: usize| {
            let ((a, b), (c, d)) = (place(k), place(other));
            let beside = k != other && (a - c).abs() <= 2 && (b - d).abs() <= 2;
            beside && (map[other] > map[k] || (map[other] == map[k] && other < k))
        };
        let whole = 0..map.len();
        let mut found: Vec<usize> =
            whole.clone().filter(|&k| map[k] > 10.0 && !whole.clone().any(|other| beaten(k, other))).collect();
        found.sort_by(|&a, &b| map[b].total_cmp(&map[a]).then(a.cmp(&b)));
        found
    }

    #[test]
    fn maxima_are_those_of_the_slow_search() {
        for (rows, columns, seed) in [(20, 17, 1), (1, 40, 2), (33, 1, 3), (7, 8, 4), (2, 2, 5)] {
            // Whole numbers of dB, so that there are equals.
            let map: Vec<f32> = noise(rows, columns, seed).iter().map(|level| (level * 3.0).round()).collect();
            let expected = slow_maxima(&map, columns);
            let found = describe(&map, columns);
            for k in 0..MAXIMA {
                let level = expected.get(k).map_or(STANDS_OUT_DB, |&cell| map[cell]);
                assert_eq!(found[LEVELS + k], level, "{rows} x {columns}: maximum {k}");
                let (Some(&first), true) = (expected.first(), k > 0) else { continue };
                let cell = expected.get(k).copied().unwrap_or(first);
                let [row, column] = [(first / columns, cell / columns), (first % columns, cell % columns)]
                    .map(|(first, cell)| cell as f64 - first as f64);
                near("range", found[RANGES + k - 1], row * RANGE_STEP_M, 1e-6);
                near("speed", found[VELOCITIES + k - 1], column.abs() * VELOCITY_STEP_M_PER_S, 1e-6);
            }
        }
    }

    #[test]
    fn noise_alone_is_hardly_counted() {
        for seed in 0..5 {
            let found = describe(&noise(64, 64, seed), 64);
            // One cell in 8,000 is above 10 dB, none above 15 dB.
            assert!(found[CELLS + 1] < 8f32.ln() && found[BINS] < 8f32.ln(), "{found:?}");
            assert!(found[CELLS + 2..CELLS + 6].iter().chain(&found[BINS + 1..LEVELS]).all(|&v| v == 0.0), "{found:?}");
            assert!(found[0] < 20.0 && found[LEVELS] < 13.0 && found[5] == 0.0, "{found:?}");
        }
    }

    /// Exchanging approaching and receding about zero Doppler changes nothing.
    #[test]
    fn directions_can_be_exchanged() {
        let (rows, columns) = (40, 33);
        let mut map: Vec<f32> = noise(rows, columns, 9).iter().map(|level| 3.0 * level).collect();
        let found = describe(&map, columns);
        map.chunks_exact_mut(columns).for_each(<[f32]>::reverse);
        for (a, b) in found.iter().zip(describe(&map, columns)) {
            assert!((a - b).abs() < 1e-5 * a.abs().max(1.0), "{a} {b}");
        }
    }

    #[test]
    fn steps_are_units() {
        let map: Vec<f32> = noise(20, 30, 4).iter().map(|level| 3.0 * level).collect();
        let (bins, metres) = (descriptors(&map, 30, 1.0, 1.0), describe(&map, 30));
        for (k, (a, b)) in bins.iter().zip(metres).enumerate() {
            let unit = match k {
                1 | 2 | RANGES..VELOCITIES => RANGE_STEP_M,
                3..=5 | VELOCITIES..DESCRIPTORS => VELOCITY_STEP_M_PER_S,
                _ => 1.0,
            };
            near("unit", b, f64::from(*a) * unit, 1e-4);
        }
    }

    /// Alone, in a batch and in a prepared network: the same numbers. A gradient of the input is refused.
    #[test]
    fn the_layer_is_the_function() {
        let (rows, columns) = (12, 16);
        let maps: Vec<f32> = (0..3).flat_map(|k| noise(rows, columns, k)).map(|level| 4.0 * level).collect();
        let expected: Vec<f32> =
            maps.chunks_exact(rows * columns).flat_map(|map| descriptors(map, columns, 1.0, 1.0)).collect();
        let tensor = Tensor::from_slice(&maps, (3, rows, columns, 1), &Device::Cpu).expect("tensor");
        let input = Var::from_tensor(&tensor).expect("variable");
        let output = map_descriptors(input.as_tensor()).expect("descriptors");
        assert_eq!(output.dims(), [3, DESCRIPTORS]);
        assert_eq!(output.flatten_all().and_then(|t| t.to_vec1::<f32>()).expect("numbers"), expected);
        let loss = output.sum_all().expect("loss");
        let error = crate::layer::backward(&loss).expect_err("refused").to_string();
        assert!(error.contains("no gradient"), "{error}");
        let (feature, mut prepared) = (Feature::new([3, rows, columns, 1], maps).expect("maps"), Feature::default());
        feature.map_descriptors(&mut prepared).expect("descriptors");
        assert_eq!(prepared.dims(), [3, 1, 1, DESCRIPTORS]);
        assert_eq!(prepared.values(), expected);
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn odd_maps_stay_finite() {
            let constant = |level: f32| vec![level; 24];
            for map in [Vec::new(), vec![50.0], constant(0.0), constant(12.0), constant(f32::MAX), constant(f32::MIN)] {
                for columns in [0, 1, 4, 7, 24, 100] {
                    let found = descriptors(&map, columns, RANGE_STEP_M, VELOCITY_STEP_M_PER_S);
                    assert!(found.iter().all(|value| value.is_finite()), "{map:?} {columns}: {found:?}");
                }
            }
            // Equal cells have one maximum, the first.
            let found = describe(&constant(12.0), 4);
            assert_eq!(found[LEVELS..LEVELS + 2], [12.0, STANDS_OUT_DB]);
            // Nothing is in the middle of the range axis and stands still.
            let found = describe(&constant(0.0), 4);
            near("range", found[1], 2.5 * RANGE_STEP_M, 1e-6);
            assert!(found[0] == 0.0 && found[2..LEVELS].iter().all(|&value| value == 0.0), "{found:?}");
        }

        #[test]
        fn a_cell_that_is_no_number_is_not_hidden() {
            for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
                let mut map = vec![3.0; 24];
                map[7] = bad;
                assert!(describe(&map, 4).iter().all(|value| value.is_nan()), "{bad}");
            }
        }

        #[test]
        fn other_shapes_are_refused() {
            for shape in [&[2usize, 3, 4][..], &[2, 3, 4, 2], &[2, 0, 4, 1]] {
                let zeros = Tensor::zeros(shape, candle_core::DType::F32, &Device::Cpu).expect("zeros");
                let error = map_descriptors(&zeros).expect_err("refused").to_string();
                assert!(error.contains("expected [batch, range, velocity, 1]"), "{error}");
            }
            let mut output = Feature::default();
            assert!(Feature::default().map_descriptors(&mut output).is_err());
        }
    }
}
