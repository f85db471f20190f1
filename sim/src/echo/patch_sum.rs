//! Echoes of a patch between two key times, and their sum in each chirp.
//!
//! Each echo is a field that is cubic in time between the key times, with the phase of a path length that is cubic as
//! well. Path lengths are relative to a common path that moves with the patch, so the sum varies slowly. Over an
//! interval between key times its phase changes by little more than the members' paths diverge. If that is a cycle or
//! two, the sum is computed at a few nodes of the interval. The polynomial through them gives the sum in every chirp.

// Loops use lane indices: several rows are accessed together, and the compiler vectorises these loops.
#![allow(clippy::needless_range_loop)]

use radome_dsp::KernelLevel;

use crate::lanes::{LANES, Row, compiled_for_levels, cos_sin_of_turns};
use crate::synthesis::{CHIRPS, EchoChirps};

/// Numbers of nodes per interval, for small and for larger phase rates of the echoes relative to the common path.
const FEW: usize = 8;
const MANY: usize = 16;
/// Largest such phase rates for these numbers of nodes, cycles per interval. The error of the polynomial is below a
/// thousandth.
const MAX_TURNS_FEW: f32 = 0.5;
const MAX_TURNS_MANY: f32 = 2.4;

/// Small echoes at one end of an interval between key times, one per lane. Lengths are in wavelengths, slopes are per
/// interval.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct TrackRows {
    /// Length of the path beyond the patch's own.
    pub length: [f64; LANES],
    /// Slope of the length.
    pub length_slope: Row,
    /// Field without `exp(-j 2 pi length)`, real and imaginary part.
    pub field: [Row; 2],
    /// Slope of the field.
    pub field_slope: [Row; 2],
    /// Moment of the field about its own length: integral of the field times the excess length of its paths. It is
    /// interpolated linearly between the ends, because it changes little.
    pub moment: [Row; 2],
    /// Phase lag of this field with the actual antennas instead of their midpoints, rad. The reverse path has the
    /// opposite sign. The value of the first end is used.
    pub detour_rad: Row,
}

/// Polynomial coefficients of small echoes between two key times, one echo per lane.
#[derive(Debug, Clone, Copy, Default)]
struct CubicRows {
    length: [Row; 4],
    field: [[Row; 4]; 2],
    moment: [[Row; 2]; 2],
    detour_rad: Row,
}

/// Block of chirps in an interval between key times.
#[derive(Debug, Clone, Copy, PartialEq)]
struct ChirpRow {
    /// Index of the block.
    row: usize,
    /// First chirp of the block in this interval.
    begin: usize,
    /// Positions (0..1) in the interval.
    positions: [f32; CHIRPS],
    /// 1 for chirps in this interval, 0 for others.
    inside: [f32; CHIRPS],
}

/// Chirps of an interval between key times.
#[derive(Debug, Clone, PartialEq)]
pub struct IntervalChirps {
    rows: Vec<ChirpRow>,
    few: Nodes<FEW>,
    many: Nodes<MANY>,
}

/// Interpolation nodes in an interval, and the weights of their values in the chirps. Weights are zero for chirps
/// outside of the interval.
#[derive(Debug, Clone, PartialEq)]
struct Nodes<const N: usize> {
    positions: [f32; N],
    /// Weights by block of chirps.
    weights: Vec<[[f32; CHIRPS]; N]>,
}

/// Returns Chebyshev nodes between 0 and 1, which keep polynomial interpolation well-conditioned.
fn nodes<const N: usize>() -> [f64; N] {
    std::array::from_fn(|k| 0.5 - 0.5 * ((k as f64 + 0.5) * std::f64::consts::PI / N as f64).cos())
}

impl<const N: usize> Nodes<N> {
    fn new(rows: &[ChirpRow]) -> Self {
        let positions = nodes::<N>();
        // Weights are Lagrange polynomials.
        let below = positions.map(|own| others(&positions, own).map(|other| own - other).product::<f64>());
        let weights = |row: &ChirpRow| -> [[f32; CHIRPS]; N] {
            std::array::from_fn(|k| {
                let weight = |i: usize| {
                    let u = f64::from(row.positions[i]);
                    let above: f64 = others(&positions, positions[k]).map(|other| u - other).product();
                    row.inside[i] * (above / below[k]) as f32
                };
                std::array::from_fn(weight)
            })
        };
        Nodes { positions: positions.map(|position| position as f32), weights: rows.iter().map(weights).collect() }
    }
}

/// Returns all nodes but one.
fn others(positions: &[f64], own: f64) -> impl Iterator<Item = f64> {
    positions.iter().copied().filter(move |position| *position != own)
}

/// Divides chirps into `intervals` intervals of equal length. Chirp times are fractions of the whole, in ascending
/// order.
pub fn intervals_of(chirps: &[f64], intervals: usize) -> Vec<IntervalChirps> {
    let last = intervals.saturating_sub(1);
    // Chirps before the first key time or after the last belong to the nearest interval.
    let interval_of = |chirp: f64| ((chirp * intervals as f64).max(0.0) as usize).min(last);
    let interval_chirps = |interval: usize| {
        let in_row = |(row, chirps): (usize, &[f64])| {
            let begin = chirps.iter().position(|&chirp| interval_of(chirp) == interval)?;
            let (mut positions, mut inside) = ([0.0; CHIRPS], [0.0; CHIRPS]);
            for i in 0..CHIRPS {
                // An incomplete last block is padded with its last chirp.
                let Some(&chirp) = chirps.get(i).or(chirps.last()) else { continue };
                positions[i] = (chirp * intervals as f64 - interval as f64) as f32;
                inside[i] = if i < chirps.len() && interval_of(chirp) == interval { 1.0 } else { 0.0 };
            }
            Some(ChirpRow { row, begin, positions, inside })
        };
        let rows: Vec<ChirpRow> = chirps.chunks(CHIRPS).enumerate().filter_map(in_row).collect();
        IntervalChirps { few: Nodes::new(&rows), many: Nodes::new(&rows), rows }
    };
    (0..intervals).map(interval_chirps).collect()
}

/// Sums of the echoes of one patch in each chirp.
#[derive(Debug)]
pub struct PatchSums {
    level: KernelLevel,
    sums: Vec<EchoChirps>,
}

impl PatchSums {
    /// Creates empty sums for an instruction set that the processor has.
    pub fn new(level: KernelLevel) -> Self {
        PatchSums { level, sums: Vec::new() }
    }

    /// Resets all sums to zero for a number of chirps.
    pub fn clear(&mut self, chirps: usize) {
        self.sums.clear();
        self.sums.resize(chirps.div_ceil(CHIRPS), EchoChirps::default());
    }

    /// Sets the common path, to which lengths are relative, in the chirps of an interval of `interval_s` seconds.
    /// `ends` are its length, m, and rate, m/s, at both ends. Intervals must be given in order.
    pub fn set_common_path(&mut self, ends: [(f64, f64); 2], interval_s: f64, chirps: &IntervalChirps) {
        set_common_path(self.level, ends, interval_s, chirps, &mut self.sums);
    }

    /// Adds echoes in the chirps of an interval, from their values at its ends.
    pub fn add(&mut self, ends: [&TrackRows; 2], chirps: &IntervalChirps) {
        add(self.level, ends, chirps, &mut self.sums);
    }

    /// Returns the largest field magnitude of any chirp.
    pub fn loudest(&self) -> f32 {
        let mut loudest = [0f32; CHIRPS];
        for sums in &self.sums {
            for i in 0..CHIRPS {
                let square = sums.field[0][i] * sums.field[0][i] + sums.field[1][i] * sums.field[1][i];
                loudest[i] = if square > loudest[i] { square } else { loudest[i] };
            }
        }
        loudest.into_iter().fold(0.0, f32::max).sqrt()
    }

    /// Returns fields, moments and detour-weighted fields in all chirps, by blocks.
    pub fn chirps(&self) -> &[EchoChirps] {
        &self.sums
    }
}

compiled_for_levels! {
    fn set_common_path(
        ends: [(f64, f64); 2],
        interval_s: f64,
        chirps: &IntervalChirps,
        sums: &mut [EchoChirps],
    ) = set_common_path_body;
}

#[inline(always)]
fn set_common_path_body(ends: [(f64, f64); 2], interval_s: f64, chirps: &IntervalChirps, sums: &mut [EchoChirps]) {
    let [(begin_m, begin_rate), (end_m, end_rate)] = ends;
    let (first, second, step_m) = (begin_rate * interval_s, end_rate * interval_s, end_m - begin_m);
    let (square, cube) = (3.0 * step_m - 2.0 * first - second, first + second - 2.0 * step_m);
    let per_s = 1.0 / interval_s;
    for ChirpRow { row, begin, positions, .. } in &chirps.rows {
        let Some(sums) = sums.get_mut(*row) else { continue };
        for i in 0..CHIRPS {
            let u = f64::from(positions[i]);
            let length_m = begin_m + u * (first + u * (square + u * cube));
            let rate_m_per_s = ((first + u * (2.0 * square + u * (3.0 * cube))) * per_s) as f32;
            // Later intervals overwrite the rest of the block.
            let is_ahead = i >= *begin;
            sums.length_m[i] = if is_ahead { length_m } else { sums.length_m[i] };
            sums.rate_m_per_s[i] = if is_ahead { rate_m_per_s } else { sums.rate_m_per_s[i] };
        }
    }
}

compiled_for_levels! {
    fn add(ends: [&TrackRows; 2], chirps: &IntervalChirps, sums: &mut [EchoChirps]) = add_body;
}

#[inline(always)]
fn add_body(ends: [&TrackRows; 2], chirps: &IntervalChirps, sums: &mut [EchoChirps]) {
    let cubics = CubicRows::between(ends);
    let [a, b] = ends.map(|end| end.field);
    let is_live = |l: usize| (a[0][l] != 0.0) | (a[1][l] != 0.0) | (b[0][l] != 0.0) | (b[1][l] != 0.0);
    let mut live = [0; LANES];
    let mut count = 0;
    for l in 0..LANES {
        live[count] = l;
        count += usize::from(is_live(l));
    }
    let live = &live[..count];
    let (turns, rows) = (cubics.max_turns(live), chirps.rows.len());
    // The sums at the nodes cost as much as those in one or two blocks. Evaluating the polynomial costs little.
    if turns <= MAX_TURNS_FEW && rows > 1 {
        add_by_nodes(&cubics, live, &chirps.few, &chirps.rows, sums);
    } else if turns <= MAX_TURNS_MANY && rows > 3 {
        add_by_nodes(&cubics, live, &chirps.many, &chirps.rows, sums);
    } else {
        for ChirpRow { row, positions, inside, .. } in &chirps.rows {
            let Some(sums) = sums.get_mut(*row) else { continue };
            let [re, im, moment_re, moment_im, detoured_re, detoured_im] = sum(&cubics, live, positions);
            for i in 0..CHIRPS {
                sums.field[0][i] += inside[i] * re[i];
                sums.field[1][i] += inside[i] * im[i];
                sums.moment[0][i] += inside[i] * moment_re[i];
                sums.moment[1][i] += inside[i] * moment_im[i];
                sums.detour[0][i] += inside[i] * detoured_re[i];
                sums.detour[1][i] += inside[i] * detoured_im[i];
            }
        }
    }
}

/// Adds the sum of echoes by interpolation between a few nodes.
#[inline(always)]
fn add_by_nodes<const N: usize>(
    cubics: &CubicRows,
    live: &[usize],
    nodes: &Nodes<N>,
    rows: &[ChirpRow],
    sums: &mut [EchoChirps],
) {
    let [re, im, moment_re, moment_im, detoured_re, detoured_im] = sum(cubics, live, &nodes.positions);
    for (ChirpRow { row, .. }, weights) in rows.iter().zip(&nodes.weights) {
        let Some(sums) = sums.get_mut(*row) else { continue };
        add_weighted(&re, weights, &mut sums.field[0]);
        add_weighted(&im, weights, &mut sums.field[1]);
        add_weighted(&moment_re, weights, &mut sums.moment[0]);
        add_weighted(&moment_im, weights, &mut sums.moment[1]);
        add_weighted(&detoured_re, weights, &mut sums.detour[0]);
        add_weighted(&detoured_im, weights, &mut sums.detour[1]);
    }
}

/// Adds the polynomial through the node values.
#[inline(always)]
fn add_weighted<const N: usize>(values: &[f32; N], weights: &[[f32; CHIRPS]; N], out: &mut [f32; CHIRPS]) {
    let mut row = [0f32; CHIRPS];
    for k in 0..N {
        for i in 0..CHIRPS {
            row[i] += values[k] * weights[k][i];
        }
    }
    for i in 0..CHIRPS {
        out[i] += row[i];
    }
}

impl CubicRows {
    /// Computes the Hermite cubics as power series.
    #[inline(always)]
    fn between([a, b]: [&TrackRows; 2]) -> Self {
        let mut rows = CubicRows { detour_rad: a.detour_rad, ..CubicRows::default() };
        for l in 0..LANES {
            let (first, second) = (f64::from(a.length_slope[l]), f64::from(b.length_slope[l]));
            let step = b.length[l] - a.length[l];
            rows.length[0][l] = a.length[l] as f32;
            rows.length[1][l] = a.length_slope[l];
            rows.length[2][l] = (3.0 * step - 2.0 * first - second) as f32;
            rows.length[3][l] = (first + second - 2.0 * step) as f32;
        }
        for part in 0..2 {
            for l in 0..LANES {
                let (first, second) = (a.field_slope[part][l], b.field_slope[part][l]);
                let step = b.field[part][l] - a.field[part][l];
                rows.field[part][0][l] = a.field[part][l];
                rows.field[part][1][l] = first;
                rows.field[part][2][l] = 3.0 * step - 2.0 * first - second;
                rows.field[part][3][l] = first + second - 2.0 * step;
                rows.moment[part][0][l] = a.moment[part][l];
                rows.moment[part][1][l] = b.moment[part][l] - a.moment[part][l];
            }
        }
        rows
    }

    /// Returns the largest rate of a length at the ends and in the middle, cycles per interval.
    #[inline(always)]
    fn max_turns(&self, live: &[usize]) -> f32 {
        let [_, first, square, cube] = &self.length;
        let mut most = 0f32;
        for &t in live {
            let t = t % LANES;
            let begin = first[t].abs();
            let middle = (first[t] + square[t] + 0.75 * cube[t]).abs();
            let end = (first[t] + 2.0 * square[t] + 3.0 * cube[t]).abs();
            most = most.max(begin).max(middle).max(end);
        }
        most
    }
}

/// Sums the fields, moments and detour-weighted fields of the live echoes at positions between the ends.
#[inline(always)]
fn sum<const N: usize>(cubics: &CubicRows, live: &[usize], positions: &[f32; N]) -> [[f32; N]; 6] {
    let mut rows = [[0f32; N]; 6];
    for &t in live {
        let t = t % LANES;
        let length = [cubics.length[0][t], cubics.length[1][t], cubics.length[2][t], cubics.length[3][t]];
        let [re, im] = [&cubics.field[0], &cubics.field[1]];
        let (re, im) = ([re[0][t], re[1][t], re[2][t], re[3][t]], [im[0][t], im[1][t], im[2][t], im[3][t]]);
        let moment_re = [cubics.moment[0][0][t], cubics.moment[0][1][t]];
        let moment_im = [cubics.moment[1][0][t], cubics.moment[1][1][t]];
        let detour_rad = cubics.detour_rad[t];
        for i in 0..N {
            let u = positions[i];
            let l = length[0] + u * (length[1] + u * (length[2] + u * length[3]));
            let a = re[0] + u * (re[1] + u * (re[2] + u * re[3]));
            let b = im[0] + u * (im[1] + u * (im[2] + u * im[3]));
            let (c, s) = cos_sin_of_turns(-l);
            let (x, y) = (a * c - b * s, a * s + b * c);
            rows[0][i] += x;
            rows[1][i] += y;
            rows[4][i] += x * detour_rad;
            rows[5][i] += y * detour_rad;
            let a = a * l + (moment_re[0] + u * moment_re[1]);
            let b = b * l + (moment_im[0] + u * moment_im[1]);
            rows[2][i] += a * c - b * s;
            rows[3][i] += a * s + b * c;
        }
    }
    rows
}

#[cfg(test)]
mod tests {
    use num_complex::Complex64;
    use rand::Rng;

    use super::*;
    use crate::random::{Purpose, generator};

    /// Returns echoes whose paths diverge by up to `turns` cycles over the interval.
    fn ends(turns: f32) -> [TrackRows; 2] {
        let mut rng = generator(5, Purpose::Noise, [0, 0]);
        let mut row = |limit: f32| -> Row { std::array::from_fn(|_| rng.random_range(-limit..limit)) };
        let mut end = || TrackRows {
            length: [0.0; LANES],
            length_slope: row(turns),
            field: [row(1.0), row(1.0)],
            field_slope: [row(2.0), row(2.0)],
            moment: [row(1.0), row(1.0)],
            detour_rad: row(0.05),
        };
        let (mut first, mut second) = (end(), end());
        first.length = row(20.0).map(f64::from);
        for l in 0..LANES {
            // The length step is consistent with the rates at the ends.
            second.length[l] = first.length[l] + 0.5 * f64::from(first.length_slope[l] + second.length_slope[l]);
        }
        // One lane has no triangle.
        for part in 0..2 {
            (first.field[part][3], second.field[part][3]) = (0.0, 0.0);
        }
        [first, second]
    }

    /// Computes the field, moment and detour-weighted field in double precision, one echo after the other.
    fn exact([a, b]: &[TrackRows; 2], u: f64) -> [Complex64; 3] {
        let hermite = |y0: f64, m0: f64, y1: f64, m1: f64| {
            let [a, b, c, d] = [y0, m0, 3.0 * (y1 - y0) - 2.0 * m0 - m1, 2.0 * (y0 - y1) + m0 + m1];
            a + u * (b + u * (c + u * d))
        };
        let complex = |of: &[Row; 2], l: usize| Complex64::new(of[0][l].into(), of[1][l].into());
        let mut sums = [Complex64::ZERO; 3];
        for l in (0..LANES).filter(|&l| l != 3) {
            let length = hermite(a.length[l], a.length_slope[l].into(), b.length[l], b.length_slope[l].into());
            let part = |part: usize| {
                let of = |end: &TrackRows| (f64::from(end.field[part][l]), f64::from(end.field_slope[part][l]));
                hermite(of(a).0, of(a).1, of(b).0, of(b).1)
            };
            let turn = Complex64::from_polar(1.0, -std::f64::consts::TAU * length);
            let value = Complex64::new(part(0), part(1)) * turn;
            let own = (complex(&a.moment, l) * (1.0 - u) + complex(&b.moment, l) * u) * turn;
            sums[0] += value;
            sums[1] += value * length + own;
            sums[2] += value * f64::from(a.detour_rad[l]);
        }
        sums
    }

    /// Covers few nodes, many nodes, and direct sums in each chirp.
    #[test]
    fn sums_are_those_of_double_precision_at_every_level() {
        const COUNT: usize = 61;
        let positions: Vec<f64> = (0..COUNT).map(|i| (i as f64 + 0.3) / COUNT as f64).collect();
        const BOUNDS: [f64; 3] = [1e-3, 2e-2, 1e-4];
        for turns in [0.3, 0.45, 0.7, 2.0, 2.4, 30.0] {
            let ends = ends(turns);
            let most = CubicRows::between(ends.each_ref()).max_turns(&std::array::from_fn::<_, LANES, _>(|l| l));
            assert!(most > 0.5 * turns && most < 1.6 * turns, "{most} of {turns}");
            for level in KernelLevel::ALL.into_iter().filter(|level| level.is_available()) {
                let mut sums = PatchSums::new(level);
                sums.clear(COUNT);
                for chirps in intervals_of(&positions, 1) {
                    sums.add(ends.each_ref(), &chirps);
                }
                for (i, &u) in positions.iter().enumerate() {
                    let of = &sums.chirps()[i / CHIRPS];
                    let found = [&of.field, &of.moment, &of.detour];
                    for ((exact, found), most) in exact(&ends, u).into_iter().zip(found).zip(BOUNDS) {
                        let found = Complex64::new(found[0][i % CHIRPS].into(), found[1][i % CHIRPS].into());
                        assert!((found - exact).norm() < most, "{level}, {turns} turns, chirp {i}: {found} {exact}");
                    }
                }
            }
        }
    }

    /// The path in every chirp is the cubic of its interval, and continues to the end of the last block.
    #[test]
    fn the_common_path_is_set_in_all_intervals() {
        let (count, intervals, span_s) = (45, 3, 0.06);
        let positions: Vec<f64> = (0..count).map(|i| (f64::from(i) + 0.4) / f64::from(count)).collect();
        let at = |t: f64| (3.0 + t * (1.5 - 4.0 * t), 1.5 - 8.0 * t);
        let mut sums = PatchSums::new(KernelLevel::detect());
        sums.clear(positions.len());
        for (interval, chirps) in intervals_of(&positions, intervals).iter().enumerate() {
            let interval_s = span_s / intervals as f64;
            let ends = [interval, interval + 1].map(|end| at(end as f64 * interval_s));
            sums.set_common_path(ends, interval_s, chirps);
        }
        for number in 0..positions.len().next_multiple_of(CHIRPS) {
            let position = positions[number.min(positions.len() - 1)];
            let (length_m, rate_m_per_s) = at(position * span_s);
            let (block, i) = (&sums.chirps()[number / CHIRPS], number % CHIRPS);
            assert!((block.length_m[i] - length_m).abs() < 1e-8, "chirp {number}");
            assert!((f64::from(block.rate_m_per_s[i]) - rate_m_per_s).abs() < 1e-5, "chirp {number}");
        }
    }

    #[test]
    fn every_chirp_is_in_one_interval() {
        let chirps: Vec<f64> = (0..45).map(|i| -0.01 + f64::from(i) / 43.0).collect();
        for intervals in [1, 2, 3, 8] {
            let mut found = [0; 45];
            for (interval, of) in intervals_of(&chirps, intervals).iter().enumerate() {
                for (row, i) in of.rows.iter().flat_map(|row| (0..CHIRPS).map(move |i| (row, i))) {
                    if row.inside[i] == 1.0 {
                        let number = row.row * CHIRPS + i;
                        found[number] += 1;
                        let at = (interval as f64 + f64::from(row.positions[i])) / intervals as f64;
                        assert!((at - chirps[number]).abs() < 1e-6 && i >= row.begin);
                    } else {
                        assert_eq!(row.inside[i], 0.0);
                    }
                }
            }
            assert_eq!(found, [1; 45]);
        }
    }
}
