//! Sums of many small echoes in every chirp.
//!
//! Each is a cubic in path and in strength between two keys. A few thousand of them times a hundred chirps is where a skin's
//! time goes, so the chirps lie side by side in lanes and the bodies are plain Rust, compiled once more for each instruction
//! set.

use num_complex::{Complex, Complex64};
use radome_dsp::KernelLevel;

use crate::slow_time::cubic;
use crate::synthesis::{CHIRPS, EchoChirps};

/// Chirps side by side.
const LANES: usize = 16;

type Row = [f32; LANES];

/// A small echo at one end of a stretch between keys. Lengths in wavelengths, slopes over the whole stretch.
#[derive(Debug, Clone, Copy)]
pub struct Track {
    /// Length of the path from the patch's base.
    pub length: f64,
    /// Its slope.
    pub length_slope: f64,
    /// Field but for `exp(-j 2 pi length)`.
    pub field: Complex64,
    /// Its slope.
    pub field_slope: Complex64,
    /// Moment of the field about its own length: integral of the field times how much longer its paths are. It changes so little
    /// that it is linear between the ends.
    pub moment: Complex64,
    /// How much later this field is than the patch's others by the antennas themselves than by their middles, rad; on the
    /// reverse way it is as much earlier.
    pub detour_rad: f64,
}

/// A small echo between two keys, by powers.
#[derive(Debug, Clone, Copy)]
struct Cubics {
    length: [f32; 4],
    re: [f32; 4],
    im: [f32; 4],
    moment_re: [f32; 2],
    moment_im: [f32; 2],
    detour_rad: f32,
}

/// What is summed over echoes in a chirp.
#[derive(Debug, Clone, Copy, Default)]
struct Sum {
    field: Complex<f32>,
    /// Fields times lengths.
    moment: Complex<f32>,
    /// Fields times detours.
    detoured: Complex<f32>,
}

/// Sums over one patch, chirp by chirp.
#[derive(Debug)]
pub struct ChirpSums {
    level: KernelLevel,
    tracks: Vec<Cubics>,
    sums: Vec<Sum>,
}

impl ChirpSums {
    /// For a level of instructions that the processor has.
    pub fn new(level: KernelLevel) -> Self {
        let level = if level.is_available() { level } else { KernelLevel::Portable };
        ChirpSums { level, tracks: Vec::new(), sums: Vec::new() }
    }

    /// Everything to zero.
    pub fn clear(&mut self, chirps: usize) {
        self.sums.clear();
        self.sums.resize(chirps, Default::default());
    }

    /// The echoes of the next [`Self::add`]: first and second end of each.
    pub fn load(&mut self, tracks: impl Iterator<Item = (Track, Track)>) {
        self.tracks.clear();
        let cubic = |y0, m0, y1, m1| cubic(y0, m0, y1, m1).map(|c| c as f32);
        let line = |y0: f64, y1: f64| [y0 as f32, (y1 - y0) as f32];
        self.tracks.extend(tracks.map(|(a, b)| Cubics {
            length: cubic(a.length, a.length_slope, b.length, b.length_slope),
            re: cubic(a.field.re, a.field_slope.re, b.field.re, b.field_slope.re),
            im: cubic(a.field.im, a.field_slope.im, b.field.im, b.field_slope.im),
            moment_re: line(a.moment.re, b.moment.re),
            moment_im: line(a.moment.im, b.moment.im),
            detour_rad: a.detour_rad as f32,
        }));
    }

    /// Adds them in chirps, each with its place (0..1) between the ends.
    pub fn add(&mut self, chirps: impl Iterator<Item = (usize, f64)>) {
        let (mut numbers, mut places) = ([0; LANES], [0f32; LANES]);
        let mut filled = 0;
        for (number, place) in chirps {
            (numbers[filled], places[filled]) = (number, place as f32);
            filled += 1;
            if filled == LANES {
                self.add_row(&numbers, &places);
                filled = 0;
            }
        }
        if filled > 0 {
            self.add_row(&numbers[..filled], &places);
        }
    }

    fn add_row(&mut self, numbers: &[usize], places: &Row) {
        let rows = match self.level {
            KernelLevel::Portable => body(&self.tracks, places),
            // SAFETY: `level` is only ever one that the processor has.
            #[cfg(target_arch = "x86_64")]
            KernelLevel::Avx2 => unsafe { body_avx2(&self.tracks, places) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            KernelLevel::Avx512 => unsafe { body_avx512(&self.tracks, places) },
            #[cfg(not(target_arch = "x86_64"))]
            KernelLevel::Avx2 | KernelLevel::Avx512 => body(&self.tracks, places),
        };
        for (lane, &number) in numbers.iter().enumerate() {
            if let Some(sum) = self.sums.get_mut(number) {
                sum.field += Complex::new(rows[0][lane], rows[1][lane]);
                sum.moment += Complex::new(rows[2][lane], rows[3][lane]);
                sum.detoured += Complex::new(rows[4][lane], rows[5][lane]);
            }
        }
    }

    /// The largest field of any chirp.
    pub fn loudest(&self) -> f32 {
        self.sums.iter().map(|s| s.field.norm_sqr()).fold(0.0, f32::max).sqrt()
    }

    /// Field in a chirp by a way or by its reverse.
    pub fn at(&self, chirp: usize, direction: Direction) -> ChirpField {
        /// Patches reach no farther, wavelengths.
        const REACH: f32 = 40.0;
        let sum = self.sums.get(chirp).copied().unwrap_or_default();
        // To first order: detours differ by less than a tenth of a radian over a patch.
        let later = match direction {
            Direction::There => Complex::new(0.0, -1.0),
            Direction::Reverse => Complex::new(0.0, 1.0),
        };
        let field = sum.field + sum.detoured * later;
        let beside = (sum.moment * field.conj()).re / field.norm_sqr();
        let beside = if beside.is_finite() { beside.clamp(-REACH, REACH) } else { 0.0 };
        ChirpField { field, beside, rest: sum.moment - field * beside }
    }

    /// The same for all chirps, side by side.
    pub fn chirps(&self, direction: Direction, out: &mut Vec<EchoChirps>) {
        out.clear();
        for begin in (0..self.sums.len()).step_by(CHIRPS) {
            let mut some = EchoChirps::default();
            for i in 0..CHIRPS.min(self.sums.len() - begin) {
                let ChirpField { field, beside, rest } = self.at(begin + i, direction);
                (some.re[i], some.im[i], some.beside[i]) = (field.re, field.im, beside);
                (some.rest_re[i], some.rest_im[i]) = (rest.re, rest.im);
            }
            out.push(some);
        }
    }
}

/// Which way round a patch is met.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Direction {
    /// From the first image to the second, as detours are given.
    There,
    /// From the second to the first.
    Reverse,
}

/// A patch in one chirp.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct ChirpField {
    /// Its field.
    pub field: Complex<f32>,
    /// Where along the path that comes from: the mean length weighted by field, in wavelengths from the base. That is the
    /// stationary point's where there is one; within the patch in any case.
    pub beside: f32,
    /// The field's moment about there, wavelengths: see [`EchoChirps::rest_re`].
    pub rest: Complex<f32>,
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn body_avx2(tracks: &[Cubics], places: &Row) -> [Row; 6] {
    body(tracks, places)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,avx512f,avx512bw,avx512dq,avx512vl")]
fn body_avx512(tracks: &[Cubics], places: &Row) -> [Row; 6] {
    body(tracks, places)
}

/// Fields, their moments and what detours make of them in every lane.
#[inline(always)]
fn body(tracks: &[Cubics], places: &Row) -> [Row; 6] {
    /// 1.5 times 2^23: adding it leaves the nearest integer in a number's last bits.
    const SHIFT: f32 = 12_582_912.0;
    let mut rows = [[0f32; LANES]; 6];
    for Cubics { length, re, im, moment_re, moment_im, detour_rad } in tracks {
        for i in 0..LANES {
            let u = places[i];
            let l = length[0] + u * (length[1] + u * (length[2] + u * length[3]));
            let a = re[0] + u * (re[1] + u * (re[2] + u * re[3]));
            let b = im[0] + u * (im[1] + u * (im[2] + u * im[3]));
            // Sine and cosine of half of -2 pi l, and their doubling.
            let y = (((l + SHIFT) - SHIFT) - l) * std::f32::consts::PI;
            let z = y * y;
            let sine = y
                * (1.0
                    + z * (-1.0 / 6.0
                        + z * (1.0 / 120.0 + z * (-1.0 / 5040.0 + z * (1.0 / 362_880.0 - z * (1.0 / 39_916_800.0))))));
            let cosine = 1.0
                + z * (-0.5 + z * (1.0 / 24.0 + z * (-1.0 / 720.0 + z * (1.0 / 40_320.0 - z * (1.0 / 3_628_800.0)))));
            let (c, s) = (1.0 - 2.0 * sine * sine, 2.0 * sine * cosine);
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
    use rand::Rng;

    use super::*;
    use crate::random::{Purpose, generator};

    fn tracks() -> Vec<(Track, Track)> {
        let mut rng = generator(5, Purpose::Noise, [0, 0]);
        let mut number = |limit: f64| rng.random_range(-limit..limit);
        let mut track = |detour_rad: f64| Track {
            length: number(20.0),
            length_slope: number(30.0),
            field: Complex64::new(number(1.0), number(1.0)),
            field_slope: Complex64::new(number(2.0), number(2.0)),
            moment: Complex64::new(number(1.0), number(1.0)),
            detour_rad,
        };
        (0..50).map(|i| 0.002 * f64::from(i - 20)).map(|detour| (track(detour), track(detour))).collect()
    }

    /// Field and moment by the cubic and its turn in double precision, one echo after the other.
    fn exact(tracks: &[(Track, Track)], u: f64, sign: f64) -> [Complex64; 2] {
        let hermite = |y0: f64, m0: f64, y1: f64, m1: f64| {
            let [a, b, c, d] = [y0, m0, 3.0 * (y1 - y0) - 2.0 * m0 - m1, 2.0 * (y0 - y1) + m0 + m1];
            a + u * (b + u * (c + u * d))
        };
        tracks.iter().fold(Default::default(), |[field, moment]: [Complex64; 2], (a, b)| {
            let length = hermite(a.length, a.length_slope, b.length, b.length_slope);
            let re = hermite(a.field.re, a.field_slope.re, b.field.re, b.field_slope.re);
            let im = hermite(a.field.im, a.field_slope.im, b.field.im, b.field_slope.im);
            let turn = Complex64::from_polar(1.0, -std::f64::consts::TAU * length);
            let value = Complex64::new(re, im) * turn;
            let own = (a.moment * (1.0 - u) + b.moment * u) * turn;
            [field + value * Complex64::new(1.0, -sign * a.detour_rad), moment + value * length + own]
        })
    }

    #[test]
    fn sums_are_those_of_double_precision_at_every_level() {
        let tracks = tracks();
        let double = |x: Complex<f32>| Complex64::new(x.re.into(), x.im.into());
        for level in KernelLevel::ALL.into_iter().filter(|level| level.is_available()) {
            let mut sums = ChirpSums::new(level);
            sums.clear(37);
            sums.load(tracks.iter().copied());
            sums.add((0..37).map(|i| (i, i as f64 / 36.0)));
            for (i, (direction, sign)) in
                (0..37).flat_map(|i| [(i, (Direction::There, 1.0)), (i, (Direction::Reverse, -1.0))])
            {
                let [field, moment] = exact(&tracks, i as f64 / 36.0, sign);
                let got = sums.at(i, direction);
                let off = double(got.field) - field;
                assert!(off.norm() < 2e-3, "{level}, chirp {i}: {got:?} {field}");
                let expected = (moment / field).re.clamp(-40.0, 40.0);
                let off = f64::from(got.beside) - expected;
                assert!(off.abs() < 0.02 * (1.0 + expected.abs()), "{level}, chirp {i}");
                let off = double(got.field * got.beside + got.rest) - moment;
                assert!(off.norm() < 2e-2, "{level}, chirp {i}: {got:?} {moment}");
            }
        }
    }
}
