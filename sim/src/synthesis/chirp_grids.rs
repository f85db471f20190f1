//! Frequency grids of every chirp of a frame, to which moving echoes are added.
//!
//! In a block of eight chirps an echo is added around one position of the grid, the nearest for which taps of the
//! kernel are stored. A chirp's tone may be offset from this position, and the echo's origin from its path. Both
//! offsets use the derivative of the kernel: to first order a displaced tone is the tone plus its derivative times the
//! displacement. For an eighth of a cell the error is 0.9 % of the amplitude (rms over the chirp). An echo that moves
//! by more than a quarter of a cell in a block is added in runs of fewer chirps.
//!
//! Receivers share the phases of the path and the position. Their differences change so slowly that a parabola over the
//! frame represents them.

// Loops use lane indices: several rows are accessed together, and the compiler vectorises these loops.
#![allow(clippy::needless_range_loop)]

use num_complex::Complex;
use radome_dsp::{KernelLevel, SPEED_OF_LIGHT_M_PER_S};

use super::held::{POSITIONS, taps_by_position};
use super::spread::{CHIRPS, Cell, Grids, Row, window};
use super::{DEGREE, PADDED_TAPS, Synthesiser, WIDTH, fraction_of_turn, nearest_integer};
use crate::chirp::Chirp;
use crate::lanes::{compiled_for_levels, cos_sin_of_turns};

/// Largest movement of an echo while its position is held, cells.
const HELD_CELLS: f64 = 0.25;
/// Largest offset of an echo's origin from its path, wavelengths.
const MAX_ORIGIN: f32 = 40.0;

/// Frequency grids of every chirp of a frame, for each receiver: `[receiver][block of chirps]`.
#[derive(Debug, Clone)]
pub struct ChirpGrids {
    blocks: Vec<Vec<Grids>>,
    kernel: EchoKernel,
    level: KernelLevel,
    /// The same echoes times `j` and their delays, if requested.
    by_delay: Option<Box<ChirpGrids>>,
}

/// Kernel for adding echoes: taps at the quantised positions between cells, and their derivatives by the tone's
/// position, in cells.
#[derive(Debug, Clone)]
struct EchoKernel {
    taps: Vec<[f32; PADDED_TAPS]>,
    slopes: Vec<[f32; PADDED_TAPS]>,
    cells: f64,
}

/// Moving echo in eight consecutive chirps, independent of the receiver.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct EchoChirps {
    /// Length of the reference path of phases, m.
    pub length_m: [f64; CHIRPS],
    /// Rate of the reference path, m/s.
    pub rate_m_per_s: [f32; CHIRPS],
    /// Field without the reference path's phase, as it multiplies `exp(-j ...)`: real and imaginary part.
    pub field: [[f32; CHIRPS]; 2],
    /// Moment of the field: the field times the excess length of its paths, in wavelengths. If an echo extends over the
    /// border of a patch, its strength changes with the chirp's frequency. Only with the moment do adjacent patches add
    /// up to the whole.
    pub moment: [[f32; CHIRPS]; 2],
    /// Field times its phase lag with the actual antennas instead of their midpoints, rad, on the forward path. The
    /// reverse path has the opposite sign.
    pub detour: [[f32; CHIRPS]; 2],
}

/// Factors from an echo's field to LSB at one receiver, as it multiplies `exp(+j ...)`, by powers of the chirp index.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EchoFactors {
    /// Sum over the forward path and its reverse.
    pub sum: [Complex<f32>; 3],
    /// Forward path minus its reverse: factor of the detour term.
    pub difference: [Complex<f32>; 3],
}

/// Moving echo in every chirp of a frame.
#[derive(Debug, Clone, Copy)]
pub struct Echo<'a> {
    /// Chirp constants.
    pub chirp: &'a Chirp,
    /// Wavelength at which the field was computed, m.
    pub wavelength_m: f64,
    /// Echo factors for each receiver.
    pub factors: &'a [EchoFactors],
    /// Blocks of chirps.
    pub chirps: &'a [EchoChirps],
}

impl ChirpGrids {
    /// Creates empty grids.
    pub fn new(synthesiser: &Synthesiser, receivers: usize, chirps: usize) -> Self {
        let blocks = vec![vec![synthesiser.grids(); chirps.div_ceil(CHIRPS)]; receivers];
        let mut slopes = [[0f32; PADDED_TAPS]; DEGREE];
        for (power, (slopes, taps)) in slopes.iter_mut().zip(&synthesiser.taps[1..]).enumerate() {
            // The fraction of a cell falls from 1 to -1 while the position advances by a cell.
            *slopes = taps.map(|c| -2.0 * (power + 1) as f32 * c);
        }
        let kernel = EchoKernel {
            taps: synthesiser.taps_by_position.clone(),
            slopes: taps_by_position(&slopes),
            cells: synthesiser.cells as f64,
        };
        ChirpGrids { blocks, kernel, level: synthesiser.level, by_delay: None }
    }

    /// Adds second grids, in which every field is multiplied by `j` and its delay. Phase noise multiplies these.
    pub fn with_delays(mut self) -> Self {
        self.by_delay = Some(Box::new(self.clone()));
        self
    }

    /// Takes the grids multiplied by delay, LSB s.
    pub fn take_by_delay(&mut self) -> Option<ChirpGrids> {
        self.by_delay.take().map(|grids| *grids)
    }

    /// Adds a moving echo to every chirp. The frequency is taken as equal for all receivers and for both directions of
    /// the path, because they are close together.
    pub fn add(&mut self, echo: &Echo) {
        if let Some(grids) = &mut self.by_delay {
            spread_echo(grids.level, &grids.kernel, echo, true, &mut grids.blocks);
        }
        spread_echo(self.level, &self.kernel, echo, false, &mut self.blocks);
    }

    /// Adds a receiver's block of chirps to `grids`.
    pub(crate) fn add_block(&self, receiver: usize, block: usize, grids: &mut Grids) {
        if let Some(own) = self.blocks.get(receiver).and_then(|blocks| blocks.get(block)) {
            grids.add(own);
        }
    }
}

compiled_for_levels! {
    fn spread_echo(kernel: &EchoKernel, echo: &Echo, by_delay: bool, blocks: &mut [Vec<Grids>]) = spread_echo_body;
}

#[inline(always)]
fn spread_echo_body(kernel: &EchoKernel, echo: &Echo, by_delay: bool, blocks: &mut [Vec<Grids>]) {
    for (block, chirps) in echo.chirps.iter().enumerate() {
        let Some(rotated) = rotated(kernel, echo, chirps, by_delay) else { continue };
        let (runs, width) = runs(kernel, &rotated);
        for (factors, blocks) in echo.factors.iter().zip(blocks.iter_mut()) {
            let Some(grids) = blocks.get_mut(block) else { continue };
            let received = received(factors, &rotated, (block * CHIRPS) as f32);
            if width == CHIRPS {
                spread_run(kernel, &runs[0], &rotated.offsets, &received, &mut grids.cells);
            } else {
                spread_in_runs(kernel, &runs, width, &rotated.offsets, &received, &mut grids.cells);
            }
        }
    }
}

/// Echo in a block of chirps with its phase, before any receiver's factor. Arrays hold real and imaginary parts.
struct RotatedEcho {
    field: [Row; 2],
    /// Detour term of the field, without its factor.
    detour: [Row; 2],
    /// Field times the offset of its origin from the position of its tone, cells.
    displacement: [Row; 2],
    /// Position on the grid half-way between the first chirp and the last, cells, and each chirp's offset from it.
    middle: f64,
    offsets: Row,
}

/// Computes the phase of an echo in a block; `None` where its power is zero.
#[inline(always)]
fn rotated(kernel: &EchoKernel, echo: &Echo, chirps: &EchoChirps, by_delay: bool) -> Option<RotatedEcho> {
    let EchoChirps { length_m, rate_m_per_s, field: [re, im], moment: [moment_re, moment_im], detour } = chirps;
    // Power, and product of the moment with the field.
    let (mut power, mut along) = ([0f32; CHIRPS], [0f32; CHIRPS]);
    for i in 0..CHIRPS {
        power[i] = re[i] * re[i] + im[i] * im[i];
        along[i] = moment_re[i] * re[i] + moment_im[i] * im[i];
    }
    let power = total(&power);
    if power.is_nan() || power <= 0.0 {
        return None;
    }
    // Offset of the echo's origin from its path, wavelengths: the stationary point where there is one.
    let origin = (total(&along) / power).clamp(-MAX_ORIGIN, MAX_ORIGIN);
    let (per_m, cells_per_hz) = (1.0 / SPEED_OF_LIGHT_M_PER_S, kernel.cells / echo.chirp.sample_rate_hz);
    let origin_m = f64::from(origin) * echo.wavelength_m;
    let (mut cosine, mut sine, mut position) = ([0f32; CHIRPS], [0f32; CHIRPS], [0f64; CHIRPS]);
    for i in 0..CHIRPS {
        let delay_s = (length_m[i] + origin_m) * per_m;
        // The field contains the phase from the path to the origin at one frequency. The chirp's frequency is slightly
        // different.
        let cycles = echo.chirp.phase_cycles(delay_s) - f64::from(origin);
        let (c, s) = cos_sin_of_turns((cycles - nearest_integer(cycles)) as f32);
        let delayed = delay_s as f32;
        (cosine[i], sine[i]) = if by_delay { (-s * delayed, c * delayed) } else { (c, s) };
        position[i] = echo.chirp.beat_hz(delay_s, f64::from(rate_m_per_s[i]) * per_m) * cells_per_hz;
    }
    let cells_per_wave = (echo.chirp.slope_hz_per_s * echo.wavelength_m * per_m * cells_per_hz) as f32;
    let middle = 0.5 * (position[0] + position[CHIRPS - 1]);
    let zero = [0f32; CHIRPS];
    let mut out = RotatedEcho { field: [zero; 2], detour: [zero; 2], displacement: [zero; 2], middle, offsets: zero };
    for i in 0..CHIRPS {
        // Conjugates, rotated by the phase.
        let (c, s) = (cosine[i], sine[i]);
        (out.field[0][i], out.field[1][i]) = (re[i] * c + im[i] * s, re[i] * s - im[i] * c);
        // A phase lag is a factor of minus j times the phase, of which the conjugate is taken.
        let (x, y) = (detour[0][i], detour[1][i]);
        (out.detour[0][i], out.detour[1][i]) = (y * c - x * s, x * c + y * s);
        let (x, y) = (moment_re[i] - origin * re[i], moment_im[i] - origin * im[i]);
        let (x, y) = (cells_per_wave * x, cells_per_wave * y);
        (out.displacement[0][i], out.displacement[1][i]) = (x * c + y * s, x * s - y * c);
        out.offsets[i] = (position[i] - middle) as f32;
    }
    Some(out)
}

/// Returns the sum over the chirps.
#[inline(always)]
fn total(row: &Row) -> f32 {
    ((row[0] + row[4]) + (row[2] + row[6])) + ((row[1] + row[5]) + (row[3] + row[7]))
}

/// Consecutive chirps that are added around one position.
#[derive(Clone, Copy, Default)]
struct Run {
    /// First cell under the kernel, and index of the quantised position between cells.
    first: u32,
    position: usize,
    /// Offset of that position from the block's middle position, cells.
    from_middle: f32,
}

/// Returns the runs of a block, and the number of chirps of each.
#[inline(always)]
fn runs(kernel: &EchoKernel, rotated: &RotatedEcho) -> ([Run; CHIRPS], usize) {
    let offsets = &rotated.offsets;
    let moved = f64::from((offsets[CHIRPS - 1] - offsets[0]).abs());
    let width = if moved <= HELD_CELLS {
        CHIRPS
    } else if moved <= 2.0 * HELD_CELLS {
        4
    } else if moved <= 4.0 * HELD_CELLS {
        2
    } else {
        1
    };
    let mut runs = [Run::default(); CHIRPS];
    for (run, begin) in runs.iter_mut().zip((0..CHIRPS).step_by(width)) {
        let middle = 0.5 * (offsets[begin] + offsets[begin + width - 1]);
        let turns = (rotated.middle + f64::from(middle)) / kernel.cells;
        let position = fraction_of_turn(turns) * kernel.cells;
        let quantised = (position * f64::from(POSITIONS) + 0.5) as u32;
        run.first = quantised.div_ceil(POSITIONS);
        run.position = (run.first * POSITIONS - quantised) as usize;
        run.from_middle = middle + (f64::from(quantised) / f64::from(POSITIONS) - position) as f32;
    }
    (runs, width)
}

/// Echo at a receiver in a block of chirps: the field, and the field times the offset of its origin from the tone's
/// position, cells.
struct Received {
    field: [Row; 2],
    displacement: [Row; 2],
}

/// Applies a receiver's factors. `first` is the index of the block's first chirp.
#[inline(always)]
fn received(factors: &EchoFactors, rotated: &RotatedEcho, first: f32) -> Received {
    let ([a, b, c], [d, e, f]) = (factors.sum, factors.difference);
    let (field, detour, displacement) = (&rotated.field, &rotated.detour, &rotated.displacement);
    // Separate rows: in-place sums would be computed one lane at a time.
    let (mut re, mut im) = ([0f32; CHIRPS], [0f32; CHIRPS]);
    let (mut beside_re, mut beside_im) = ([0f32; CHIRPS], [0f32; CHIRPS]);
    for i in 0..CHIRPS {
        let n = first + i as f32;
        let (x, y) = (a.re + n * (b.re + n * c.re), a.im + n * (b.im + n * c.im));
        let (u, v) = (d.re + n * (e.re + n * f.re), d.im + n * (e.im + n * f.im));
        re[i] = (field[0][i] * x - field[1][i] * y) + (detour[0][i] * u - detour[1][i] * v);
        im[i] = (field[0][i] * y + field[1][i] * x) + (detour[0][i] * v + detour[1][i] * u);
        beside_re[i] = displacement[0][i] * x - displacement[1][i] * y;
        beside_im[i] = displacement[0][i] * y + displacement[1][i] * x;
    }
    Received { field: [re, im], displacement: [beside_re, beside_im] }
}

/// Adds an echo around one position of the grid.
#[inline(always)]
fn spread_run(kernel: &EchoKernel, run: &Run, offsets: &Row, received: &Received, cells: &mut [Cell]) {
    let (Some(taps), Some(slopes)) = (kernel.taps.get(run.position), kernel.slopes.get(run.position)) else { return };
    let Some([c0, c1, c2, c3, c4, c5]) = window::<WIDTH>(cells, run.first) else { return };
    let [re, im] = &received.field;
    let (mut moved_re, mut moved_im) = ([0f32; CHIRPS], [0f32; CHIRPS]);
    for i in 0..CHIRPS {
        let offset = offsets[i] - run.from_middle;
        moved_re[i] = received.displacement[0][i] + offset * re[i];
        moved_im[i] = received.displacement[1][i] + offset * im[i];
    }
    // Unrolled, like all loops over taps.
    add(c0, [re, im], taps[0], [&moved_re, &moved_im], slopes[0]);
    add(c1, [re, im], taps[1], [&moved_re, &moved_im], slopes[1]);
    add(c2, [re, im], taps[2], [&moved_re, &moved_im], slopes[2]);
    add(c3, [re, im], taps[3], [&moved_re, &moved_im], slopes[3]);
    add(c4, [re, im], taps[4], [&moved_re, &moved_im], slopes[4]);
    add(c5, [re, im], taps[5], [&moved_re, &moved_im], slopes[5]);
}

/// Adds phasors times a tap, and their displacement times its slope.
#[inline(always)]
fn add(cell: &mut Cell, [re, im]: [&Row; 2], tap: f32, [moved_re, moved_im]: [&Row; 2], slope: f32) {
    for i in 0..CHIRPS {
        cell.re[i] += re[i] * tap + moved_re[i] * slope;
        cell.im[i] += im[i] * tap + moved_im[i] * slope;
    }
}

/// Adds an echo in runs of `width` chirps, each around its position.
#[inline(always)]
fn spread_in_runs(
    kernel: &EchoKernel,
    runs: &[Run; CHIRPS],
    width: usize,
    offsets: &Row,
    received: &Received,
    cells: &mut [Cell],
) {
    let zero = [0f32; CHIRPS];
    for (run, begin) in runs.iter().zip((0..CHIRPS).step_by(width)) {
        let mut own = Received { field: [zero; 2], displacement: [zero; 2] };
        for part in 0..2 {
            for i in 0..CHIRPS {
                let within = if i >= begin && i < begin + width { 1.0 } else { 0.0 };
                own.field[part][i] = within * received.field[part][i];
                own.displacement[part][i] = within * received.displacement[part][i];
            }
        }
        spread_run(kernel, run, offsets, &own, cells);
    }
}

#[cfg(test)]
mod tests {
    use num_complex::Complex64;
    use rand::Rng;

    use super::super::tests::{bits, error_db, samples_of_chirp};
    use super::*;
    use crate::lanes::tests::assert_same_at_every_level;
    use crate::random::{Purpose, generator};
    use crate::synthesis::{Tone, exact_chirp};

    const SAMPLES: usize = 256;
    /// Number of chirps, which is not a multiple of a block.
    const COUNT: usize = 60;
    const INTERVAL_S: f64 = 5e-4;
    const CHIRP: Chirp = Chirp { start_hz: 59.6e9, slope_hz_per_s: 3.45e12, sample_rate_hz: 1e6, middle_s: 128e-6 };

    /// Two points close together whose path length is quadratic in time.
    struct Source {
        /// Path length by powers of time.
        length_m: [f64; 3],
        /// Excess length of the path, m, field, and phase lag due to the actual antennas, rad.
        places: [(f64, Complex64, f64); 2],
        /// Factor of each receiver, and its excess length on the forward path and on the reverse, m.
        receivers: [(f64, [f64; 2]); 2],
    }

    fn wavelength_m() -> f64 {
        SPEED_OF_LIGHT_M_PER_S / (CHIRP.start_hz + CHIRP.slope_hz_per_s * CHIRP.middle_s)
    }

    /// Returns sources with paths of 2 to 20 m and rates up to `speed_m_per_s`.
    fn sources(count: usize, speed_m_per_s: f64) -> Vec<Source> {
        let mut rng = generator(8, Purpose::Noise, [0, 0]);
        let mut source = || {
            let mut number = |limit: f64| rng.random_range(-limit..limit);
            Source {
                length_m: [11.0 + number(9.0), number(speed_m_per_s), number(10.0)],
                places: [0; 2].map(|_| (number(0.01), Complex64::new(number(1.0), number(1.0)), number(0.05))),
                receivers: [0; 2].map(|_| (1.0 + number(0.2), [number(0.001), number(0.001)])),
            }
        };
        (0..count).map(|_| source()).collect()
    }

    fn length_m(source: &Source, chirp: usize) -> [f64; 2] {
        let (t, [a, b, c]) = (chirp as f64 * INTERVAL_S, source.length_m);
        [a + t * (b + t * c), b + 2.0 * t * c]
    }

    /// Returns a separate tone for every point and path.
    fn tones(source: &Source, receiver: usize, chirp: usize) -> Vec<Tone> {
        let [length_m, rate_m_per_s] = length_m(source, chirp);
        let (factor, later_m) = source.receivers[receiver];
        let mut tones = Vec::new();
        for (beside_m, field, detour_rad) in source.places {
            for (later_m, sign) in [(later_m[0], 1.0), (later_m[1], -1.0)] {
                let delay_s = (length_m + beside_m + later_m) / SPEED_OF_LIGHT_M_PER_S;
                // The field already contains the phase of the offset, so that phase is removed.
                let cycles = CHIRP.phase_cycles(delay_s) - beside_m / wavelength_m();
                let amplitude = field.conj() * Complex64::from_polar(factor, sign * detour_rad);
                tones.push(Tone {
                    phase_cycles: cycles,
                    cycles_per_sample: CHIRP.beat_hz(delay_s, rate_m_per_s / SPEED_OF_LIGHT_M_PER_S)
                        / CHIRP.sample_rate_hz,
                    amplitude: Complex::new(amplitude.re as f32, amplitude.im as f32),
                });
            }
        }
        tones
    }

    fn chirps(source: &Source) -> Vec<EchoChirps> {
        let mut blocks = vec![EchoChirps::default(); COUNT.div_ceil(CHIRPS)];
        for chirp in 0..COUNT.next_multiple_of(CHIRPS) {
            let (block, i) = (&mut blocks[chirp / CHIRPS], chirp % CHIRPS);
            let [length_m, rate_m_per_s] = length_m(source, chirp);
            (block.length_m[i], block.rate_m_per_s[i]) = (length_m, rate_m_per_s as f32);
            for (beside_m, field, detour_rad) in source.places.into_iter().filter(|_| chirp < COUNT) {
                let parts = [1.0, beside_m / wavelength_m(), detour_rad].map(|factor| field * factor);
                for (rows, part) in [&mut block.field, &mut block.moment, &mut block.detour].into_iter().zip(parts) {
                    rows[0][i] += part.re as f32;
                    rows[1][i] += part.im as f32;
                }
            }
        }
        blocks
    }

    fn factors(source: &Source) -> Vec<EchoFactors> {
        let of_receiver = |&(factor, later_m): &(f64, [f64; 2])| {
            let delay_s = source.length_m[0] / SPEED_OF_LIGHT_M_PER_S;
            let [forward, reverse] = later_m.map(|later_m| {
                let later =
                    CHIRP.phase_cycles(delay_s + later_m / SPEED_OF_LIGHT_M_PER_S) - CHIRP.phase_cycles(delay_s);
                let rotated = Complex64::from_polar(factor, std::f64::consts::TAU * later);
                Complex::new(rotated.re as f32, rotated.im as f32)
            });
            let constant = |value| [value, Complex::default(), Complex::default()];
            EchoFactors { sum: constant(forward + reverse), difference: constant(forward - reverse) }
        };
        source.receivers.iter().map(of_receiver).collect()
    }

    fn grids_at(level: KernelLevel, sources: &[Source]) -> ChirpGrids {
        let synthesiser = Synthesiser { level, ..Synthesiser::new(SAMPLES) };
        let mut grids = ChirpGrids::new(&synthesiser, 2, COUNT).with_delays();
        for source in sources {
            let (factors, chirps) = (factors(source), chirps(source));
            grids.add(&Echo { chirp: &CHIRP, wavelength_m: wavelength_m(), factors: &factors, chirps: &chirps });
        }
        grids
    }

    fn samples(grids: &ChirpGrids, receiver: usize, chirp: usize) -> Vec<f32> {
        let synthesiser = Synthesiser::new(SAMPLES);
        let mut block = synthesiser.grids();
        grids.add_block(receiver, chirp / CHIRPS, &mut block);
        samples_of_chirp(&synthesiser, &block, chirp % CHIRPS)
    }

    /// Compares slow echoes, and fast ones added in runs, with separate tones for every point and path.
    #[test]
    fn echoes_are_those_of_their_places_and_ways() {
        for (speed_m_per_s, most_db) in [(3.0, -40.0), (60.0, -34.0)] {
            let sources = sources(40, speed_m_per_s);
            let grids = grids_at(KernelLevel::detect(), &sources);
            for receiver in 0..2 {
                let (mut exact, mut found) = (Vec::new(), Vec::new());
                for chirp in 0..COUNT {
                    let tones: Vec<Tone> = sources.iter().flat_map(|source| tones(source, receiver, chirp)).collect();
                    exact.extend(exact_chirp(&tones, SAMPLES));
                    found.extend(samples(&grids, receiver, chirp));
                }
                let error_db = error_db(&exact, &found);
                assert!(error_db < most_db, "up to {speed_m_per_s} m/s, receiver {receiver}: {error_db} dB");
            }
        }
    }

    #[test]
    fn echoes_by_delay_are_as_much_stronger_as_they_are_late() {
        let sources = sources(1, 1.0);
        let mut grids = grids_at(KernelLevel::detect(), &sources);
        let by_delay = grids.take_by_delay().expect("asked for");
        let power = |grids: &ChirpGrids| samples(grids, 0, 7).iter().map(|x| f64::from(*x).powi(2)).sum::<f64>();
        let delay_s = sources[0].length_m[0] / SPEED_OF_LIGHT_M_PER_S;
        let ratio = (power(&by_delay) / power(&grids)).sqrt() / delay_s;
        assert!((ratio - 1.0).abs() < 0.05, "{ratio}");
    }

    #[test]
    fn every_level_gives_the_same_bits() {
        let sources = sources(20, 60.0);
        assert_same_at_every_level(|level| bits(grids_at(level, &sources).blocks.iter().flatten()));
    }
}
