//! Sums of the triangles of a patch in every chirp.
//!
//! Each is a cubic in path and in strength between two keys. A few thousand of them times a hundred chirps is where a skin's
//! time goes: triangles lie side by side in lanes where their cubics are found, chirps where they are summed.

// Lanes are counted: several rows go together, and loops over their numbers are compiled to vectors.
#![allow(clippy::needless_range_loop)]

use radome_dsp::KernelLevel;

use crate::lanes::{LANES, Row, compiled_for_levels, cos_sin_of_turns};
use crate::synthesis::{CHIRPS, EchoChirps};

/// Small echoes at one end of a stretch between keys, side by side. Lengths in wavelengths, slopes over the whole stretch.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct TrackRows {
    /// Length of the path from the patch's base.
    pub length: [f64; LANES],
    /// Its slope.
    pub length_slope: Row,
    /// Field but for `exp(-j 2 pi length)`, real and imaginary part.
    pub field: [Row; 2],
    /// Its slope.
    pub field_slope: [Row; 2],
    /// Moment of the field about its own length: integral of the field times how much longer its paths are. It changes so little
    /// that it is linear between the ends.
    pub moment: [Row; 2],
    /// How much later this field is than the patch's others by the antennas themselves than by their middles, rad; on the
    /// reverse way it is as much earlier. That of the first end counts.
    pub detour_rad: Row,
}

/// Small echoes between two keys, side by side, by powers.
#[derive(Debug, Clone, Copy, Default)]
struct CubicRows {
    length: [Row; 4],
    field: [[Row; 4]; 2],
    moment: [[Row; 2]; 2],
    detour_rad: Row,
}

/// A row of chirps in a stretch between keys.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ChirpRow {
    /// Its number.
    row: usize,
    /// Places (0..1) between the ends.
    places: Row,
    /// 1 for those that are in this stretch, 0 for others.
    inside: Row,
}

/// The chirps of each of so many stretches of equal length, of which times are fractions of the whole.
pub fn chirp_rows(chirps: &[f64], stretches: usize) -> Vec<Vec<ChirpRow>> {
    let last = stretches.saturating_sub(1);
    let in_stretch = |stretch: usize| {
        let in_row = |(row, chirps): (usize, &[f64])| {
            let (mut places, mut inside) = ([0.0; LANES], [0.0; LANES]);
            for (l, chirp) in chirps.iter().enumerate() {
                let at = chirp * stretches as f64;
                // Those before the first key and after the last go with the stretch that is next to them.
                if (at.max(0.0) as usize).min(last) == stretch {
                    (places[l], inside[l]) = ((at - stretch as f64) as f32, 1.0);
                }
            }
            inside.contains(&1.0).then_some(ChirpRow { row, places, inside })
        };
        chirps.chunks(LANES).enumerate().filter_map(in_row).collect()
    };
    (0..stretches).map(in_stretch).collect()
}

/// Sums over one patch, in a row of chirps.
#[derive(Debug, Clone, Copy, Default)]
struct SumRows {
    field: [Row; 2],
    /// Fields times lengths.
    moment: [Row; 2],
    /// Fields times detours.
    detoured: [Row; 2],
}

/// Sums over one patch, chirp by chirp.
#[derive(Debug)]
pub struct ChirpSums {
    level: KernelLevel,
    sums: Vec<SumRows>,
}

/// Which way round a patch is met.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Direction {
    /// From the first image to the second, as detours are given.
    There,
    /// From the second to the first.
    Reverse,
}

impl ChirpSums {
    /// For a level of instructions that the processor has.
    pub fn new(level: KernelLevel) -> Self {
        let level = if level.is_available() { level } else { KernelLevel::Portable };
        ChirpSums { level, sums: Vec::new() }
    }

    /// Everything to zero.
    pub fn clear(&mut self, chirps: usize) {
        self.sums.clear();
        self.sums.resize(chirps.div_ceil(LANES), SumRows::default());
    }

    /// Adds echoes in the chirps of a stretch, from what they are at its ends.
    pub fn add(&mut self, ends: [&TrackRows; 2], chirps: &[ChirpRow]) {
        add(self.level, ends, chirps, &mut self.sums);
    }

    /// The largest field of any chirp.
    pub fn loudest(&self) -> f32 {
        let mut loudest = [0f32; LANES];
        for sums in &self.sums {
            for l in 0..LANES {
                let square = sums.field[0][l] * sums.field[0][l] + sums.field[1][l] * sums.field[1][l];
                loudest[l] = if square > loudest[l] { square } else { loudest[l] };
            }
        }
        loudest.into_iter().fold(0.0, f32::max).sqrt()
    }

    /// Fields in all chirps by a way or by its reverse, and where along the path they come from: the mean length weighted by
    /// field. That is the stationary point's where there is one, within the patch in any case.
    pub fn chirps(&self, direction: Direction, out: &mut Vec<EchoChirps>) {
        out.clear();
        for sums in &self.sums {
            out.extend(echo_chirps(self.level, sums, direction));
        }
    }
}

compiled_for_levels! {
    fn add(ends: [&TrackRows; 2], chirps: &[ChirpRow], sums: &mut [SumRows]) = add_body;
}

#[inline(always)]
fn add_body(ends: [&TrackRows; 2], chirps: &[ChirpRow], sums: &mut [SumRows]) {
    let cubics = CubicRows::between(ends);
    let [a, b] = ends.map(|end| end.field);
    let is_live = |l: usize| (a[0][l] != 0.0) | (a[1][l] != 0.0) | (b[0][l] != 0.0) | (b[1][l] != 0.0);
    let mut live = [0; LANES];
    let mut count = 0;
    for l in 0..LANES {
        live[count] = l;
        count += usize::from(is_live(l));
    }
    for ChirpRow { row, places, inside } in chirps {
        let Some(sums) = sums.get_mut(*row) else { continue };
        let [re, im, moment_re, moment_im, detoured_re, detoured_im] = sum(&cubics, &live[..count], places);
        for i in 0..LANES {
            sums.field[0][i] += inside[i] * re[i];
            sums.field[1][i] += inside[i] * im[i];
            sums.moment[0][i] += inside[i] * moment_re[i];
            sums.moment[1][i] += inside[i] * moment_im[i];
            sums.detoured[0][i] += inside[i] * detoured_re[i];
            sums.detoured[1][i] += inside[i] * detoured_im[i];
        }
    }
}

impl CubicRows {
    /// Hermite's cubics by powers.
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
}

/// Fields, their moments and what detours make of them, of echoes that are there, in a row of chirps.
#[inline(always)]
fn sum(cubics: &CubicRows, live: &[usize], places: &Row) -> [Row; 6] {
    let mut rows = [[0f32; LANES]; 6];
    for &t in live {
        let t = t % LANES;
        let length = [cubics.length[0][t], cubics.length[1][t], cubics.length[2][t], cubics.length[3][t]];
        let [re, im] = [&cubics.field[0], &cubics.field[1]];
        let (re, im) = ([re[0][t], re[1][t], re[2][t], re[3][t]], [im[0][t], im[1][t], im[2][t], im[3][t]]);
        let moment_re = [cubics.moment[0][0][t], cubics.moment[0][1][t]];
        let moment_im = [cubics.moment[1][0][t], cubics.moment[1][1][t]];
        let detour_rad = cubics.detour_rad[t];
        for i in 0..LANES {
            let u = places[i];
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

compiled_for_levels! {
    fn echo_chirps(sums: &SumRows, direction: Direction) -> [EchoChirps; LANES / CHIRPS] = echo_chirps_body;
}

#[inline(always)]
fn echo_chirps_body(sums: &SumRows, direction: Direction) -> [EchoChirps; LANES / CHIRPS] {
    /// Patches reach no farther, wavelengths.
    const REACH: f32 = 40.0;
    // To first order: detours differ by less than a tenth of a radian over a patch.
    let later = match direction {
        Direction::There => -1.0,
        Direction::Reverse => 1.0,
    };
    let mut all = [EchoChirps::default(); LANES / CHIRPS];
    for (part, out) in all.iter_mut().enumerate() {
        for i in 0..CHIRPS {
            let l = part * CHIRPS + i;
            let re = sums.field[0][l] - later * sums.detoured[1][l];
            let im = sums.field[1][l] + later * sums.detoured[0][l];
            let (moment_re, moment_im) = (sums.moment[0][l], sums.moment[1][l]);
            let power = re * re + im * im;
            let beside = (moment_re * re + moment_im * im) / power;
            let beside = if power > 0.0 { beside.clamp(-REACH, REACH) } else { 0.0 };
            (out.re[i], out.im[i], out.beside[i]) = (re, im, beside);
            (out.rest_re[i], out.rest_im[i]) = (moment_re - re * beside, moment_im - im * beside);
        }
    }
    all
}

#[cfg(test)]
mod tests {
    use num_complex::Complex64;
    use rand::Rng;

    use super::*;
    use crate::random::{Purpose, generator};

    fn ends() -> [TrackRows; 2] {
        let mut rng = generator(5, Purpose::Noise, [0, 0]);
        let mut row = |limit: f32| -> Row { std::array::from_fn(|_| rng.random_range(-limit..limit)) };
        let mut end = || TrackRows {
            length: row(20.0).map(f64::from),
            length_slope: row(30.0),
            field: [row(1.0), row(1.0)],
            field_slope: [row(2.0), row(2.0)],
            moment: [row(1.0), row(1.0)],
            detour_rad: row(0.05),
        };
        let (mut first, mut second) = (end(), end());
        // A lane without a triangle.
        for part in 0..2 {
            (first.field[part][3], second.field[part][3]) = (0.0, 0.0);
        }
        [first, second]
    }

    /// Field and moment by the cubic and its turn in double precision, one echo after the other.
    fn exact([a, b]: &[TrackRows; 2], u: f64, sign: f64) -> [Complex64; 2] {
        let hermite = |y0: f64, m0: f64, y1: f64, m1: f64| {
            let [a, b, c, d] = [y0, m0, 3.0 * (y1 - y0) - 2.0 * m0 - m1, 2.0 * (y0 - y1) + m0 + m1];
            a + u * (b + u * (c + u * d))
        };
        let complex = |of: &[Row; 2], l: usize| Complex64::new(of[0][l].into(), of[1][l].into());
        let mut sums = [Complex64::ZERO; 2];
        for l in (0..LANES).filter(|&l| l != 3) {
            let length = hermite(a.length[l], a.length_slope[l].into(), b.length[l], b.length_slope[l].into());
            let part = |part: usize| {
                let of = |end: &TrackRows| (f64::from(end.field[part][l]), f64::from(end.field_slope[part][l]));
                hermite(of(a).0, of(a).1, of(b).0, of(b).1)
            };
            let turn = Complex64::from_polar(1.0, -std::f64::consts::TAU * length);
            let value = Complex64::new(part(0), part(1)) * turn;
            let own = (complex(&a.moment, l) * (1.0 - u) + complex(&b.moment, l) * u) * turn;
            sums[0] += value * Complex64::new(1.0, -sign * f64::from(a.detour_rad[l]));
            sums[1] += value * length + own;
        }
        sums
    }

    #[test]
    fn sums_are_those_of_double_precision_at_every_level() {
        let ends = ends();
        let places: Vec<f64> = (0..37).map(|i| f64::from(i) / 36.0).collect();
        for level in KernelLevel::ALL.into_iter().filter(|level| level.is_available()) {
            let mut sums = ChirpSums::new(level);
            sums.clear(37);
            for rows in chirp_rows(&places, 1) {
                sums.add([&ends[0], &ends[1]], &rows);
            }
            for (direction, sign) in [(Direction::There, 1.0), (Direction::Reverse, -1.0)] {
                let mut chirps = Vec::new();
                sums.chirps(direction, &mut chirps);
                for (i, &u) in places.iter().enumerate() {
                    let [field, moment] = exact(&ends, u, sign);
                    let (of, at) = (&chirps[i / CHIRPS], i % CHIRPS);
                    let double = |re: &[f32; CHIRPS], im: &[f32; CHIRPS]| Complex64::new(re[at].into(), im[at].into());
                    let (got, rest) = (double(&of.re, &of.im), double(&of.rest_re, &of.rest_im));
                    assert!((got - field).norm() < 1e-3, "{level}, chirp {i}: {got:?} {field}");
                    let expected = (moment / field).re.clamp(-40.0, 40.0);
                    let off = f64::from(of.beside[at]) - expected;
                    assert!(off.abs() < 0.02 * (1.0 + expected.abs()), "{level}, chirp {i}");
                    let off = got * f64::from(of.beside[at]) + rest - moment;
                    assert!(off.norm() < 2e-2, "{level}, chirp {i}: {got:?} {moment}");
                }
            }
        }
    }

    /// Every chirp is in one stretch, at the place that its time says; those beyond the ends too.
    #[test]
    fn every_chirp_is_in_one_stretch() {
        let chirps: Vec<f64> = (0..45).map(|i| -0.01 + f64::from(i) / 43.0).collect();
        for stretches in [1, 2, 3, 8] {
            let mut found = [0; 45];
            for (stretch, rows) in chirp_rows(&chirps, stretches).iter().enumerate() {
                for (row, l) in rows.iter().flat_map(|row| (0..LANES).map(move |l| (row, l))) {
                    if row.inside[l] == 1.0 {
                        let number = row.row * LANES + l;
                        found[number] += 1;
                        let at = (stretch as f64 + f64::from(row.places[l])) / stretches as f64;
                        assert!((at - chirps[number]).abs() < 1e-6);
                    } else {
                        assert_eq!(row.inside[l], 0.0);
                    }
                }
            }
            assert_eq!(found, [1; 45]);
        }
    }
}
