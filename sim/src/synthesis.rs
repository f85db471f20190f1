//! Synthesis of ADC samples from tones: the sum of many paths in one chirp.
//!
//! Within a chirp a path is a tone: phase and frequency at the middle of the chirp, constant amplitude. Its frequency
//! is the true beat, `S tau + (f0 + S t_c - S tau) tau'`; real sampling folds frequencies beyond half the sample rate.
//! The quadratic phase due to Doppler, `S tau' (t - t_c)^2`, is neglected: 6 mrad at the ends at 2.5 m/s.
//!
//! [`Synthesiser`] grids tones with a type-1 NUFFT (kernel of exponential of semicircle, width 6, twofold oversampling:
//! Barnett, Magland and af Klinteberg, SIAM J. Sci. Comput. 41, 2019) and an inverse real FFT; [`exact_chirp`] sums
//! them one by one.

use std::f64::consts::TAU;
use std::sync::Arc;

use num_complex::Complex;
use radome_dsp::KernelLevel;
use radome_dsp::spectrum::inverse_real_fft_f32;
use realfft::ComplexToReal;

use fitted_taps::Point;
use rates::RateTaps;

mod chirp_grids;
mod fitted_taps;
mod held;
mod rates;
mod spread;

pub use chirp_grids::{ChirpGrids, Echo, EchoChirps, EchoFactors};
pub use held::{HeldEcho, HeldEchoes};
pub use rates::{RUN, RateGrids, Run};
pub use spread::{CHIRPS, ChirpPositions, Grids};

/// Path during one chirp.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tone {
    /// Phase at the middle of the chirp (sample N/2), cycles.
    pub phase_cycles: f64,
    /// Beat frequency, cycles per sample; of either sign, folded by sampling.
    pub cycles_per_sample: f64,
    /// Complex amplitude, LSB.
    pub amplitude: Complex<f32>,
}

/// Computes `Re sum a exp(j 2 pi (phase + frequency (n - N/2)))`, one sample at a time in f64, as the reference.
pub fn exact_chirp(tones: &[Tone], samples: usize) -> Vec<f64> {
    let middle = (samples / 2) as f64;
    (0..samples)
        .map(|n| {
            let t = n as f64 - middle;
            tones
                .iter()
                .map(|tone| {
                    let cycles = tone.phase_cycles + (tone.cycles_per_sample * t);
                    let (s, c) = (TAU * (cycles - cycles.round())).sin_cos();
                    f64::from(tone.amplitude.re) * c - f64::from(tone.amplitude.im) * s
                })
                .sum()
        })
        .collect()
}

/// Width of the kernel in grid cells.
const WIDTH: usize = 6;
/// Steepness of the kernel for twofold oversampling.
const BETA: f64 = 2.30 * WIDTH as f64;
/// Number of polynomial coefficients of each of the kernel's taps.
const DEGREE: usize = 8;
/// Number of taps, rounded up to a vector's width; the last are zero.
const PADDED_TAPS: usize = 8;

fn kernel(x: f64) -> f64 {
    let z = 2.0 * x / WIDTH as f64;
    let inside = 1.0 - z * z;
    if inside < 0.0 { 0.0 } else { (BETA * (inside.sqrt() - 1.0)).exp() }
}

/// Fast synthesis of samples from tones, for one number of samples.
#[derive(Clone)]
pub struct Synthesiser {
    samples: usize,
    /// Number of cells of the frequency grid.
    cells: usize,
    /// Coefficients `[power][tap]` of the taps in the fraction of a cell, mapped to -1..1.
    taps: [[f32; PADDED_TAPS]; DEGREE],
    /// Taps of the kernel at quantised positions between cells.
    taps_by_position: Vec<[f32; PADDED_TAPS]>,
    /// Taps of held echoes.
    rate_taps: RateTaps,
    /// Compensation of the kernel's transform, for samples in order.
    correction: Vec<f32>,
    /// Instruction set of [`Synthesiser::spread_tracks`], available on this processor.
    level: KernelLevel,
    inverse: Arc<dyn ComplexToReal<f32>>,
}

impl std::fmt::Debug for Synthesiser {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Synthesiser").field("samples", &self.samples).finish_non_exhaustive()
    }
}

/// Frequency grid with margins, to which tones are added.
#[derive(Debug, Clone, Default)]
pub struct Grid {
    cells: Vec<Complex<f32>>,
}

/// Buffers of [`Synthesiser::transform`].
#[derive(Debug, Default)]
pub struct SynthesisScratch {
    half: Vec<Complex<f32>>,
    time: Vec<f32>,
    fft: Vec<Complex<f32>>,
}

impl Grid {
    /// Adds another grid.
    pub fn add(&mut self, other: &Grid) {
        for (cell, other) in self.cells.iter_mut().zip(&other.cells) {
            *cell += *other;
        }
    }
}

impl Synthesiser {
    /// Creates a synthesiser for chirps of this many samples.
    pub fn new(samples: usize) -> Self {
        let cells = 2 * samples.max(WIDTH);
        let mut taps = [[0f32; PADDED_TAPS]; DEGREE];
        for tap in 0..WIDTH {
            let polynomial = fit(|u| kernel(0.5 * (u + 1.0) - 0.5 * WIDTH as f64 + tap as f64));
            for (row, c) in taps.iter_mut().zip(polynomial) {
                row[tap] = c as f32;
            }
        }
        // Transform of the kernel by the midpoint rule, which converges geometrically for this smooth function.
        const POINTS: usize = 600;
        let step = WIDTH as f64 / POINTS as f64;
        let correction: Vec<f32> = (0..samples)
            .map(|n| {
                let t = (n as f64 - (samples / 2) as f64) / cells as f64;
                let transform: f64 = (0..POINTS)
                    .map(|i| {
                        let x = (i as f64 + 0.5) * step - 0.5 * WIDTH as f64;
                        kernel(x) * (TAU * x * t).cos() * step
                    })
                    .sum();
                (1.0 / transform) as f32
            })
            .collect();
        let inverse = inverse_real_fft_f32(cells);
        let point = |(n, weight): (usize, &f32)| Point {
            weight: f64::from(*weight),
            angle: TAU * (n as f64 - (samples / 2) as f64) / cells as f64,
        };
        let points: Vec<Point> = correction.iter().enumerate().map(point).collect();
        Synthesiser {
            samples,
            cells,
            taps_by_position: held::taps_by_position(&taps),
            rate_taps: RateTaps::new(&points),
            taps,
            correction,
            level: KernelLevel::detect(),
            inverse,
        }
    }

    /// Returns an empty grid.
    pub fn grid(&self) -> Grid {
        Grid { cells: vec![Complex::default(); self.cells + PADDED_TAPS] }
    }

    /// Adds a tone to a grid.
    #[inline]
    pub fn add(&self, tone: &Tone, grid: &mut Grid) {
        let phasor = tone.amplitude * phasor(tone.phase_cycles);
        let position = fraction_of_turn(tone.cycles_per_sample) * self.cells as f64;
        // First cell under the kernel, plus half a kernel of margin at the low end.
        let whole = position as usize;
        let first = whole + usize::from(position > whole as f64);
        let u = (2.0 * (first as f64 - position) - 1.0) as f32;
        let mut w = self.taps[DEGREE - 1];
        for row in self.taps[..DEGREE - 1].iter().rev() {
            for (w, c) in w.iter_mut().zip(row) {
                *w = *w * u + c;
            }
        }
        if let Some(cells) = grid.cells.get_mut(first..first + PADDED_TAPS) {
            for (cell, w) in cells.iter_mut().zip(w) {
                cell.re += phasor.re * w;
                cell.im += phasor.im * w;
            }
        }
    }

    /// Multiplies every tone on a grid by a factor, and delays sampling by a part of a sample. A tone of `f` cycles per
    /// sample (taken within half a cycle of zero) rotates by `f` times that in cycles.
    pub fn rotate(&self, factor: Complex<f32>, late_samples: f64, grid: &mut Grid) {
        if late_samples == 0.0 {
            grid.cells.iter_mut().for_each(|cell| *cell *= factor);
            return;
        }
        for (i, cell) in grid.cells.iter_mut().enumerate() {
            // Cell `i` of the buffer is cell `i - WIDTH/2` of the circle.
            let cycles = (i as f64 - (WIDTH / 2) as f64) / self.cells as f64;
            *cell *= factor * phasor(late_samples * (cycles - nearest_integer(cycles)));
        }
    }

    /// Adds the samples of a grid's tones to `out`.
    pub fn transform(&self, grid: &Grid, out: &mut [f32], scratch: &mut SynthesisScratch) {
        let cells = self.cells;
        // Margin: cell `i` of the buffer is cell `i - WIDTH/2` of the circle.
        let margin = WIDTH / 2;
        let at = |k: usize| {
            let i = k + margin;
            let mut sum = grid.cells.get(i).copied().unwrap_or_default();
            // Both ends of the buffer wrap around the circle.
            if i >= cells {
                sum += grid.cells.get(i - cells).copied().unwrap_or_default();
            }
            if let Some(again) = grid.cells.get(i + cells) {
                sum += again;
            }
            sum
        };
        let half = cells / 2;
        let paired = |low: Complex<f32>, high: Complex<f32>| (low + high.conj()) * 0.5;
        let at_edge = |k: usize| paired(at(k), at((cells - k) % cells));
        scratch.half.clear();
        scratch.half.extend((0..PADDED_TAPS.min(half + 1)).map(at_edge));
        if half >= PADDED_TAPS {
            // Cells beyond the margins are used once.
            let low = grid.cells.get(PADDED_TAPS + margin..half + margin).unwrap_or_default();
            let high = grid.cells.get(half + margin + 1..=cells - PADDED_TAPS + margin).unwrap_or_default();
            scratch.half.extend(low.iter().zip(high.iter().rev()).map(|(low, high)| paired(*low, *high)));
            scratch.half.push(at_edge(half));
        }
        for end in [0, half] {
            if let Some(value) = scratch.half.get_mut(end) {
                value.im = 0.0;
            }
        }
        scratch.time.resize(cells, 0.0);
        scratch.fft.resize(self.inverse.get_scratch_len(), Complex::default());
        // Lengths agree by construction, so this cannot fail.
        if self.inverse.process_with_scratch(&mut scratch.half, &mut scratch.time, &mut scratch.fft).is_err() {
            return;
        }
        let before = self.samples / 2;
        let (past, future) = (&scratch.time[cells - before..], &scratch.time[..self.samples - before]);
        for ((x, t), c) in out.iter_mut().zip(past.iter().chain(future)).zip(&self.correction) {
            *x += t * c;
        }
    }
}

/// 1.5 times 2^52. Adding it to a number of at most 2^51 removes the fraction and leaves the integer in the sum's last
/// bits.
const SHIFT: f64 = 6_755_399_441_055_744.0;

/// Returns the nearest integer of a number below 2^51, without the library call that baseline x86-64 needs for `round`.
#[inline(always)]
fn nearest_integer(x: f64) -> f64 {
    (x + SHIFT) - SHIFT
}

/// Returns the fractional part of a number of turns, 0..1.
#[inline(always)]
fn fraction_of_turn(turns: f64) -> f64 {
    let nearest = turns - nearest_integer(turns);
    if nearest < 0.0 { nearest + 1.0 } else { nearest }
}

/// Computes `exp(j 2 pi cycles)` to f32 precision: the fraction in f64, then Taylor series of half the angle and its
/// doubling.
#[inline(always)]
pub(crate) fn phasor(cycles: f64) -> Complex<f32> {
    let y = ((cycles - nearest_integer(cycles)) * std::f64::consts::PI) as f32;
    let z = y * y;
    let sine = y
        * (1.0
            + z * (-1.0 / 6.0
                + z * (1.0 / 120.0 + z * (-1.0 / 5040.0 + z * (1.0 / 362_880.0 - z * (1.0 / 39_916_800.0))))));
    let cosine = 1.0
        + z * (-0.5
            + z * (1.0 / 24.0
                + z * (-1.0 / 720.0 + z * (1.0 / 40_320.0 + z * (-1.0 / 3_628_800.0 + z * (1.0 / 479_001_600.0))))));
    Complex::new(1.0 - 2.0 * sine * sine, 2.0 * sine * cosine)
}

/// Returns the polynomial through a function at Chebyshev points of -1..1, by powers.
fn fit(f: impl Fn(f64) -> f64) -> [f64; DEGREE] {
    let n = DEGREE as f64;
    // Chebyshev coefficients, then their polynomials by recurrence.
    let mut result = [0f64; DEGREE];
    let (mut previous, mut current) = ([0f64; DEGREE], [0f64; DEGREE]);
    current[0] = 1.0;
    for order in 0..DEGREE {
        let coefficient = (0..DEGREE)
            .map(|i| {
                let angle = std::f64::consts::PI * (i as f64 + 0.5) / n;
                f(angle.cos()) * (order as f64 * angle).cos()
            })
            .sum::<f64>()
            * if order == 0 { 1.0 / n } else { 2.0 / n };
        for (r, c) in result.iter_mut().zip(current) {
            *r += coefficient * c;
        }
        let mut next = [0f64; DEGREE];
        for power in 0..DEGREE {
            let shifted = if power > 0 { current[power - 1] } else { 0.0 };
            next[power] = if order == 0 { shifted } else { 2.0 * shifted - previous[power] };
        }
        previous = current;
        current = next;
    }
    result
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Purpose, generator};
    use rand::Rng;

    /// Returns the samples of a grid's tones.
    pub(super) fn samples_of(synthesiser: &Synthesiser, grid: &Grid) -> Vec<f32> {
        let mut samples = vec![0f32; synthesiser.samples];
        synthesiser.transform(grid, &mut samples, &mut SynthesisScratch::default());
        samples
    }

    /// Returns the samples of one chirp of a block.
    pub(super) fn samples_of_chirp(synthesiser: &Synthesiser, grids: &Grids, chirp: usize) -> Vec<f32> {
        let mut grid = synthesiser.grid();
        grids.extract(chirp, &mut grid);
        samples_of(synthesiser, &grid)
    }

    /// Returns the bits of all cells of blocks of chirps.
    pub(super) fn bits<'a>(blocks: impl IntoIterator<Item = &'a Grids>) -> Vec<[[u32; CHIRPS]; 2]> {
        let cells = blocks.into_iter().flat_map(|grids| &grids.cells);
        cells.map(|cell| [cell.re.map(f32::to_bits), cell.im.map(f32::to_bits)]).collect()
    }

    fn compare(samples: usize, tones: &[Tone]) -> f64 {
        let synthesiser = Synthesiser::new(samples);
        let mut grid = synthesiser.grid();
        for tone in tones {
            synthesiser.add(tone, &mut grid);
        }
        error_db(&exact_chirp(tones, samples), &samples_of(&synthesiser, &grid))
    }

    /// Error of samples relative to their rms, dB.
    pub(super) fn error_db(exact: &[f64], fast: &[f32]) -> f64 {
        let error: f64 = exact.iter().zip(fast).map(|(e, f)| (e - f64::from(*f)).powi(2)).sum();
        let power: f64 = exact.iter().map(|e| e * e).sum();
        10.0 * (error / power).log10()
    }

    #[test]
    fn gridded_tones_are_within_minus_90_dbc_of_the_sum() {
        for samples in [16, 63, 64, 128, 256] {
            let mut rng = generator(1, Purpose::Noise, [samples as u64, 0]);
            let mut tones = Vec::new();
            for _ in 0..200 {
                tones.push(Tone {
                    phase_cycles: rng.random_range(-1e4..1e4),
                    cycles_per_sample: rng.random_range(-1.3..1.3),
                    amplitude: Complex::new(rng.random_range(-1.0..1.0), rng.random_range(-1.0..1.0)),
                });
            }
            let error_db = compare(samples, &tones);
            assert!(error_db < -90.0, "{samples} samples: {error_db} dBc");
        }
    }

    #[test]
    fn a_turned_grid_is_the_later_samples_times_the_factor() {
        let (samples, late_samples) = (128, 0.02);
        let synthesiser = Synthesiser::new(samples);
        let factor = Complex::new(0.9f32, -0.2);
        let tone = |cycles_per_sample: f64| Tone {
            phase_cycles: 0.3 + 7.0 * cycles_per_sample,
            cycles_per_sample,
            amplitude: Complex::new(1.0, 0.4),
        };
        let tones: Vec<Tone> = [0.004, 0.03, 0.11, 0.249, 0.4].map(tone).to_vec();
        let mut grid = synthesiser.grid();
        tones.iter().for_each(|tone| synthesiser.add(tone, &mut grid));
        synthesiser.rotate(factor, late_samples, &mut grid);
        let later: Vec<Tone> = tones
            .iter()
            .map(|tone| Tone {
                phase_cycles: tone.phase_cycles + late_samples * tone.cycles_per_sample,
                amplitude: tone.amplitude * factor,
                ..*tone
            })
            .collect();
        let error_db = error_db(&exact_chirp(&later, samples), &samples_of(&synthesiser, &grid));
        assert!(error_db < -50.0, "{error_db:.1} dB");
    }

    mod hard_cases {
        use super::*;

        fn tones(count: usize, range_db: f64, cycles: f64) -> Vec<Tone> {
            let mut rng = generator(3, Purpose::Build, [7, 0]);
            let mut tone = || {
                let strength = 10f64.powf(-0.05 * rng.random_range(0.0..=range_db)) as f32;
                let (sine, cosine) = rng.random_range(0.0..TAU as f32).sin_cos();
                Tone {
                    phase_cycles: rng.random_range(-cycles..cycles),
                    cycles_per_sample: rng.random_range(0.01..0.49),
                    amplitude: Complex::new(cosine, sine) * strength,
                }
            };
            (0..count).map(|_| tone()).collect()
        }

        /// f32 kernel: its phases are reduced in f64, so it has the same accuracy at 5e3 radians and at a million times
        /// that. Phases reduced in f32 would be wrong by 1e-4 and miss that bound.
        #[test]
        fn f32_phasors_of_long_ways_keep_their_digits() {
            for cycles in [1.0, 800.0, 1e9] {
                let tones = tones(300, 20.0, cycles);
                assert!(compare(256, &tones) < -90.0, "{cycles} cycles: {} dBc", compare(256, &tones));
            }
            let round = |tone: &Tone| Tone { phase_cycles: f64::from(tone.phase_cycles as f32), ..*tone };
            let long = tones(300, 20.0, 800.0);
            let rounded: Vec<Tone> = long.iter().map(round).collect();
            let (a, b) = (exact_chirp(&long, 256), exact_chirp(&rounded, 256));
            let lost: f64 = a.iter().zip(&b).map(|(a, b)| (a - b).powi(2)).sum();
            assert!(10.0 * (lost / a.iter().map(|v| v * v).sum::<f64>()).log10() > -85.0, "what is avoided is there");
        }

        /// Dynamic range: the sum of a million phasors over 120 dB agrees with their sum in f64 to -90 dB of it.
        #[test]
        fn a_million_phasors_over_120_db_add_up() {
            let error = compare(32, &tones(1_000_000, 120.0, 800.0));
            assert!(error < -90.0, "{error} dBc");
        }

        /// Covers frequencies on a cell, at zero, at half the rate, at its multiples, and slightly to either side.
        #[test]
        fn frequencies_at_the_seams_of_the_grid() {
            for f in [0.0, 0.5, 1.0, -0.5, 1.0 / 512.0, 1e-12, -1e-12, 0.5 - 1e-12, 1.0 - 1e-15, 0.25] {
                for phase in [0.0, 0.25, 0.123] {
                    let tone = Tone { phase_cycles: phase, cycles_per_sample: f, amplitude: Complex::new(1.0, 0.5) };
                    let error_db = compare(256, &[tone]);
                    assert!(error_db < -90.0, "{f} cycles per sample, phase {phase}: {error_db} dBc");
                }
            }
        }
    }
}
