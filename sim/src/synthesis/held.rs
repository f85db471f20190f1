//! Synthesis of many weak echoes of random phases, with exact phases and held grid positions.
//!
//! Over a run of chirps, at most a block, an echo has constant amplitude and a constant position on the frequency grid,
//! which are those of the run's middle. Its phase at the middle of the band is quadratic over the chirps. A run is
//! split where the echo moves by more than 1/8 of a cell of the grid, 1/16 of a range cell. A tone that is `d` cells
//! off has an error of `0.9 d` of its own amplitude (rms over the chirp). This is -30 dB at the worst speed, -48 dB due
//! to the quantised positions of the taps, and far less where an echo moves slowly. An echo occupies four cells, with
//! least-squares taps, whose error is -50 dB. The six taps of the kernel, which other paths need, have -104 dB.
//! Receivers differ in amplitude and phase only. In a field of echoes with random phases these errors are negligible:
//! the power at each delay and rate is preserved.
//!
//! The values of eight echoes at the run's middle are computed in parallel in f64, then each echo's eight chirps in
//! f32. The bodies are plain Rust, compiled for each instruction set.

use num_complex::Complex64;

use super::spread::{CHIRPS, Cell, ChirpPositions, Grids, Row, window};
use super::{DEGREE, PADDED_TAPS, Synthesiser, WIDTH, fraction_of_turn, nearest_integer};
use crate::chirp::Chirp;
use crate::lanes::{compiled_for_levels, cos_sin_of_turns};
use crate::math::quintic;
use crate::tracks::RECEIVERS;

/// Number of echoes in a pack.
pub(super) const ECHOES: usize = 8;
/// Number of quantised positions between two cells, each with its taps.
pub(super) const POSITIONS: u32 = 64;
/// Largest movement of an echo while its position is held, cells.
const HELD_CELLS: f32 = 1.0 / 8.0;

/// Echo within one interval.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HeldEcho {
    /// Delay, s, and its first and second time derivative, s/s and 1/s, at both ends.
    pub delay: [[f64; 3]; 2],
    /// Amplitude at each receiver at both ends, LSB, as it multiplies `exp(+j 2 pi ...)` of this delay.
    pub amplitudes: [[Complex64; 2]; RECEIVERS],
}

/// Pack of echoes, as polynomials of `u` in 0..1.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Pack {
    delay_s: [[f64; ECHOES]; 6],
    /// Amplitude at each receiver at the beginning, and its change over the interval.
    pub(super) re: [[[f32; ECHOES]; 2]; RECEIVERS],
    pub(super) im: [[[f32; ECHOES]; 2]; RECEIVERS],
}

/// Echoes within one interval.
#[derive(Debug, Clone)]
pub struct HeldEchoes {
    packs: Vec<Pack>,
    count: usize,
    interval_s: f64,
}

impl HeldEchoes {
    /// Creates an empty list for an interval of this duration, s.
    pub fn new(interval_s: f64) -> Self {
        HeldEchoes { packs: Vec::new(), count: 0, interval_s }
    }

    /// Returns the number of echoes.
    pub fn len(&self) -> usize {
        self.count
    }

    /// Returns whether there are no echoes.
    pub fn is_empty(&self) -> bool {
        self.count == 0
    }

    /// Reserves room for more echoes.
    pub fn reserve(&mut self, echoes: usize) {
        self.packs.reserve(echoes.div_ceil(ECHOES));
    }

    /// Returns the echoes in packs of eight.
    pub(super) fn packs(&self) -> &[Pack] {
        &self.packs
    }

    /// Returns the duration of the interval, s.
    pub(super) fn interval_s(&self) -> f64 {
        self.interval_s
    }

    /// Adds an echo, with a delay that is quintic between both ends and amplitudes that are linear.
    pub fn push(&mut self, echo: &HeldEcho) {
        let interval_s = self.interval_s;
        let (pack, e) = self.next_lane();
        let scaled = echo.delay.map(|[y, v, w]| [y, v * interval_s, w * interval_s * interval_s]);
        for (row, c) in pack.delay_s.iter_mut().zip(quintic(scaled[0], scaled[1])) {
            row[e] = c;
        }
        for (receiver, ends) in echo.amplitudes.into_iter().enumerate() {
            pack.set_amplitude(receiver, e, ends);
        }
    }

    /// Removes all echoes, and sets the duration of the interval, s.
    pub(super) fn clear(&mut self, interval_s: f64) {
        self.packs.clear();
        self.count = 0;
        self.interval_s = interval_s;
    }

    /// Adds one echo of a pack from an interval of the same duration.
    pub(super) fn push_lane(&mut self, from: &Pack, lane: usize) {
        let (pack, e) = self.next_lane();
        for (to, row) in pack.delay_s.iter_mut().zip(&from.delay_s) {
            to[e] = row[lane];
        }
        let amplitudes = pack.re.iter_mut().chain(&mut pack.im).flatten();
        for (to, row) in amplitudes.zip(from.re.iter().chain(&from.im).flatten()) {
            to[e] = row[lane];
        }
    }

    /// Returns the pack and lane of a new echo.
    fn next_lane(&mut self) -> (&mut Pack, usize) {
        let e = self.count % ECHOES;
        if self.count == ECHOES * self.packs.len() {
            self.packs.push(Pack::default());
        }
        self.count += 1;
        let last = self.packs.len() - 1;
        (&mut self.packs[last], e)
    }

    /// Returns the same echoes with their amplitudes times `j` and their delays at the first receiver, LSB s. Phase
    /// noise multiplies these.
    pub fn by_delay(&self) -> Self {
        let mut echoes = self.clone();
        for pack in &mut echoes.packs {
            for e in 0..ECHOES {
                let delays_s = [pack.delay_s[0][e], pack.delay_s.iter().map(|row| row[e]).sum()];
                for receiver in 0..RECEIVERS {
                    let ends = [0, 1].map(|end| {
                        let at = |[begin, step]: [[f32; ECHOES]; 2]| f64::from(begin[e] + end as f32 * step[e]);
                        let amplitude = Complex64::new(at(pack.re[receiver]), at(pack.im[receiver]));
                        amplitude * Complex64::new(0.0, delays_s[end])
                    });
                    pack.set_amplitude(receiver, e, ends);
                }
            }
        }
        echoes
    }
}

impl Pack {
    /// Returns delays at a position `u` of the interval, s, their derivatives by `u`, and half of their second
    /// derivatives.
    #[inline(always)]
    pub(super) fn delay_at(&self, u: f64) -> [[f64; ECHOES]; 3] {
        let (mut value, mut slope, mut curve) = (self.delay_s[5], [0f64; ECHOES], [0f64; ECHOES]);
        for power in (0..5).rev() {
            for e in 0..ECHOES {
                curve[e] = curve[e] * u + slope[e];
                slope[e] = slope[e] * u + value[e];
                value[e] = value[e] * u + self.delay_s[power][e];
            }
        }
        [value, slope, curve]
    }

    /// Sets the amplitude of an echo at a receiver, from its values at both ends.
    fn set_amplitude(&mut self, receiver: usize, e: usize, [begin, end]: [Complex64; 2]) {
        let (step, [re, im]) = (end - begin, [&mut self.re[receiver], &mut self.im[receiver]]);
        (re[0][e], re[1][e]) = (begin.re as f32, step.re as f32);
        (im[0][e], im[1][e]) = (begin.im as f32, step.im as f32);
    }
}

/// Returns the taps of the kernel at the quantised positions between cells: `[position][tap]`.
pub(super) fn taps_by_position(taps: &[[f32; PADDED_TAPS]; DEGREE]) -> Vec<[f32; PADDED_TAPS]> {
    let taps_at = |position: u32| {
        let u = 2.0 * position as f32 / POSITIONS as f32 - 1.0;
        taps.iter().rev().fold([0f32; PADDED_TAPS], |w, row| std::array::from_fn(|tap| w[tap] * u + row[tap]))
    };
    (0..POSITIONS).map(taps_at).collect()
}

/// Number of cells of a held echo, and the first of them among those of the kernel.
pub(super) const TAPS: usize = 4;
pub(super) const FIRST_TAP: usize = (WIDTH - TAPS) / 2;

/// Inputs of [`held_body`] other than echoes and grids.
struct Inputs<'a> {
    taps: &'a [[f32; TAPS]],
    cells: f64,
    chirp: &'a Chirp,
    /// Position of the run's middle in the interval, 0..1, and step from chirp to chirp.
    middle: f64,
    step: f64,
    /// Index of each chirp, relative to the run's middle.
    numbers: Row,
    /// 1 for chirps in the run, 0 for others.
    within: &'a Row,
    /// Number of chirps in the run.
    chirps: f32,
}

impl Synthesiser {
    /// Adds echoes to the grids of each receiver, in the chirps that lie in the echoes' interval, with held positions.
    pub fn spread_held(&self, chirp: &Chirp, echoes: &HeldEchoes, positions: &ChirpPositions, grids: &mut [Grids]) {
        let lanes = positions.lanes();
        let Some(last) = lanes.end.checked_sub(1).filter(|last| *last >= lanes.start) else { return };
        let (begin, end) = (positions.at[lanes.start], positions.at[last]);
        let middle_lane = 0.5 * (lanes.start + last) as f32;
        let inputs = Inputs {
            taps: self.rate_taps.by_delay(),
            cells: self.cells as f64,
            chirp,
            middle: 0.5 * (begin + end),
            step: (end - begin) / (last - lanes.start).max(1) as f64,
            numbers: std::array::from_fn(|i| i as f32 - middle_lane),
            within: &positions.within,
            chirps: lanes.len() as f32,
        };
        spread_held(self.level, &inputs, echoes, grids);
    }
}

compiled_for_levels! {
    fn spread_held(inputs: &Inputs, echoes: &HeldEchoes, grids: &mut [Grids]) = held_body;
}

#[inline(always)]
fn held_body(inputs: &Inputs, echoes: &HeldEchoes, grids: &mut [Grids]) {
    let mut left = echoes.count;
    for pack in &echoes.packs {
        let at_middle = values_at_middle(inputs, pack, 1.0 / echoes.interval_s, grids.len().min(RECEIVERS));
        for e in 0..left.min(ECHOES) {
            spread_echo(inputs, &at_middle, e, grids);
        }
        left = left.saturating_sub(ECHOES);
    }
}

/// Pack of echoes at the middle of a run.
struct MiddleValues {
    /// Phase by powers of the chirp index, turns.
    turns: [[f32; ECHOES]; 3],
    /// Position on the grid, cells, and its change from chirp to chirp.
    position: [f32; ECHOES],
    moved: [f32; ECHOES],
    /// Amplitude at each receiver: `[receiver][echo]`.
    re: [[f32; ECHOES]; RECEIVERS],
    im: [[f32; ECHOES]; RECEIVERS],
}

#[inline(always)]
fn values_at_middle(inputs: &Inputs, pack: &Pack, per_s: f64, receivers: usize) -> MiddleValues {
    let Chirp { start_hz, slope_hz_per_s, middle_s, sample_rate_hz } = *inputs.chirp;
    let (u, cells_per_hz) = (inputs.middle, inputs.cells / sample_rate_hz);
    let [value, slope, curve] = pack.delay_at(u);
    let (mut turn, mut rate, mut bend) = ([0f32; ECHOES], [0f32; ECHOES], [0f32; ECHOES]);
    let (mut position, mut moved) = ([0f32; ECHOES], [0f32; ECHOES]);
    for e in 0..ECHOES {
        let cycles = inputs.chirp.phase_cycles(value[e]);
        let carrier = start_hz + slope_hz_per_s * (middle_s - value[e]);
        turn[e] = (cycles - nearest_integer(cycles)) as f32;
        rate[e] = (carrier * slope[e] * inputs.step) as f32;
        bend[e] = (carrier * curve[e] * inputs.step * inputs.step) as f32;
        let turns_a_sample = inputs.chirp.beat_hz(value[e], slope[e] * per_s) / sample_rate_hz;
        position[e] = (fraction_of_turn(turns_a_sample) * inputs.cells) as f32;
        moved[e] = (slope_hz_per_s * slope[e] * inputs.step * cells_per_hz) as f32;
    }
    let u_f32 = u as f32;
    let (mut re, mut im) = ([[0f32; ECHOES]; RECEIVERS], [[0f32; ECHOES]; RECEIVERS]);
    for receiver in 0..receivers {
        for e in 0..ECHOES {
            re[receiver][e] = pack.re[receiver][0][e] + u_f32 * pack.re[receiver][1][e];
            im[receiver][e] = pack.im[receiver][0][e] + u_f32 * pack.im[receiver][1][e];
        }
    }
    MiddleValues { turns: [turn, rate, bend], position, moved, re, im }
}

/// Adds one echo in the chirps of a run.
#[inline(always)]
fn spread_echo(inputs: &Inputs, at_middle: &MiddleValues, e: usize, grids: &mut [Grids]) {
    let [turn, rate, bend] = [at_middle.turns[0][e], at_middle.turns[1][e], at_middle.turns[2][e]];
    let (mut cosine, mut sine) = ([0f32; CHIRPS], [0f32; CHIRPS]);
    for i in 0..CHIRPS {
        let number = inputs.numbers[i];
        let (c, s) = cos_sin_of_turns(turn + number * (rate + number * bend));
        (cosine[i], sine[i]) = (c * inputs.within[i], s * inputs.within[i]);
    }
    let (position, moved) = (at_middle.position[e], at_middle.moved[e].abs());
    let width = if moved * inputs.chirps <= HELD_CELLS {
        CHIRPS
    } else if moved * 4.0 <= HELD_CELLS {
        4
    } else if moved * 2.0 <= HELD_CELLS {
        2
    } else {
        1
    };
    for (receiver, grids) in grids.iter_mut().enumerate().take(RECEIVERS) {
        let (x, y) = (at_middle.re[receiver][e], at_middle.im[receiver][e]);
        let (mut re, mut im) = ([0f32; CHIRPS], [0f32; CHIRPS]);
        for i in 0..CHIRPS {
            re[i] = x * cosine[i] - y * sine[i];
            im[i] = x * sine[i] + y * cosine[i];
        }
        if width == CHIRPS {
            spread_taps(inputs, position, &re, &im, &mut grids.cells);
        } else {
            spread_in_runs(inputs, [position, at_middle.moved[e]], width, [&re, &im], &mut grids.cells);
        }
    }
}

/// Adds phasors in runs of `width` chirps, each at its position: `position` and its change from chirp to chirp.
#[inline(always)]
fn spread_in_runs(inputs: &Inputs, [position, moved]: [f32; 2], width: usize, [re, im]: [&Row; 2], cells: &mut [Cell]) {
    let circle = inputs.cells as f32;
    for begin in (0..CHIRPS).step_by(width) {
        let position = position + moved * (inputs.numbers[begin] + 0.5 * (width - 1) as f32);
        let position = if position < 0.0 { position + circle } else { position };
        let position = if position > circle { position - circle } else { position };
        let (mut own_re, mut own_im) = ([0f32; CHIRPS], [0f32; CHIRPS]);
        for i in 0..CHIRPS {
            let is_in_run = i >= begin && i < begin + width;
            own_re[i] = if is_in_run { re[i] } else { 0.0 };
            own_im[i] = if is_in_run { im[i] } else { 0.0 };
        }
        spread_taps(inputs, position, &own_re, &own_im, cells);
    }
}

/// Returns the first cell under the taps at a grid position, and the index of the quantised position between cells.
#[inline(always)]
pub(super) fn quantised_position(position: f32) -> (u32, usize) {
    let quantised = (position * POSITIONS as f32 + 0.5) as u32;
    let first = quantised.div_ceil(POSITIONS);
    (first, (first * POSITIONS - quantised) as usize)
}

/// Adds phasors around one position of the grid, cells.
#[inline(always)]
fn spread_taps(inputs: &Inputs, position: f32, re: &Row, im: &Row, cells: &mut [Cell]) {
    let (first, place) = quantised_position(position);
    let Some(taps) = inputs.taps.get(place) else { return };
    let Some([c0, c1, c2, c3]) = window::<TAPS>(cells, first + FIRST_TAP as u32) else { return };
    // Unrolled, like all loops over taps.
    c0.add(re, im, &[taps[0]; CHIRPS]);
    c1.add(re, im, &[taps[1]; CHIRPS]);
    c2.add(re, im, &[taps[2]; CHIRPS]);
    c3.add(re, im, &[taps[3]; CHIRPS]);
}

#[cfg(test)]
pub(super) mod tests {
    use num_complex::Complex;
    use radome_dsp::{KernelLevel, SPEED_OF_LIGHT_M_PER_S};
    use rand::Rng;

    use super::super::tests::{bits, error_db, samples_of, samples_of_chirp};
    use super::*;
    use crate::lanes::tests::assert_same_at_every_level;
    use crate::random::{Purpose, generator};
    use crate::synthesis::{Tone, exact_chirp};

    pub(in crate::synthesis) const SAMPLES: usize = 256;
    /// Number of chirps of an interval.
    pub(in crate::synthesis) const COUNT: usize = 64;
    pub(in crate::synthesis) const INTERVAL_S: f64 = 0.032;
    pub(in crate::synthesis) const CHIRP: Chirp =
        Chirp { start_hz: 59.6e9, slope_hz_per_s: 3.45e12, sample_rate_hz: 1e6, middle_s: 128e-6 };

    /// Returns echoes at 2 to 20 m with path rates up to 8 m/s and accelerations up to 30 m/s^2.
    pub(in crate::synthesis) fn echoes(count: usize) -> Vec<HeldEcho> {
        let mut rng = generator(6, Purpose::WallPoints, [0, 0]);
        let mut echoes = Vec::new();
        for _ in 0..count {
            let mut number = |limit: f64| rng.random_range(-limit..limit);
            let c = SPEED_OF_LIGHT_M_PER_S;
            let begin = [(22.0 + number(18.0)) / c, number(8.0) / c, number(30.0) / c];
            let end = [
                begin[0] + INTERVAL_S * (begin[1] + 0.5 * INTERVAL_S * begin[2]),
                begin[1] + INTERVAL_S * begin[2],
                begin[2] + number(5.0) / c,
            ];
            let amplitude = Complex64::new(number(1.0), number(1.0));
            // Other receivers differ by some picoseconds and a gain.
            let (beside_s, gain, moved_s) = (number(1.6e-11), 0.9 + number(0.1), number(1e-13));
            let rotated = |delay_s: f64| Complex64::from_polar(1.0, std::f64::consts::TAU * CHIRP.start_hz * delay_s);
            let second = [amplitude * gain * rotated(beside_s); 2];
            let third = [beside_s, beside_s + moved_s].map(|delay_s| amplitude * 1.1 * rotated(delay_s));
            let grown = 1.0 + number(0.05);
            let amplitudes = [[amplitude; 2], second, third].map(|[begin, end]| [begin, end * grown]);
            echoes.push(HeldEcho { delay: [begin, end], amplitudes });
        }
        echoes
    }

    pub(in crate::synthesis) fn place(chirp: usize) -> f64 {
        (chirp as f64 + 0.3) / COUNT as f64
    }

    /// Returns the echo as a separate tone at a receiver in a chirp.
    pub(in crate::synthesis) fn tone(echo: &HeldEcho, receiver: usize, chirp: usize) -> Tone {
        let u = place(chirp);
        let scaled = echo.delay.map(|[y, v, w]| [y, v * INTERVAL_S, w * INTERVAL_S * INTERVAL_S]);
        let c = quintic(scaled[0], scaled[1]);
        let delay_s: f64 = c.iter().rev().fold(0.0, |sum, c| sum * u + c);
        let rate = (1..6).rev().fold(0.0, |sum, p| sum * u + p as f64 * c[p]) / INTERVAL_S;
        let [begin, end] = echo.amplitudes[receiver];
        let a = begin + (end - begin) * u;
        Tone {
            phase_cycles: CHIRP.phase_cycles(delay_s),
            cycles_per_sample: CHIRP.beat_hz(delay_s, rate) / CHIRP.sample_rate_hz,
            amplitude: Complex::new(a.re as f32, a.im as f32),
        }
    }

    pub(in crate::synthesis) fn held(echoes: &[HeldEcho]) -> HeldEchoes {
        let mut held = HeldEchoes::new(INTERVAL_S);
        echoes.iter().for_each(|echo| held.push(echo));
        held
    }

    /// Returns every receiver's grids of a block that is split at some chirp.
    fn spread_at(level: KernelLevel, held: &HeldEchoes, block: usize, cut: usize) -> Vec<Grids> {
        let synthesiser = Synthesiser { level, ..Synthesiser::new(SAMPLES) };
        let mut grids = vec![synthesiser.grids(); RECEIVERS];
        for lanes in [0..cut, cut..CHIRPS] {
            let positions = ChirpPositions::new(lanes, |lane| place(CHIRPS * block + lane));
            synthesiser.spread_held(&CHIRP, held, &positions, &mut grids);
        }
        grids
    }

    /// Compares with a separate tone for every echo in every chirp: the error is below -26 dB, and the power is
    /// preserved.
    #[test]
    fn held_echoes_are_within_minus_26_db_of_the_sum() {
        let echoes = echoes(60);
        let held = held(&echoes);
        assert!(held.len() == 60 && !held.is_empty());
        let synthesiser = Synthesiser::new(SAMPLES);
        for receiver in 0..RECEIVERS {
            let (mut exact, mut fast) = (Vec::new(), Vec::new());
            for block in 0..COUNT / CHIRPS {
                // Some blocks are split, as at the end of an interval.
                let grids = spread_at(synthesiser.level, &held, block, if block % 3 == 1 { 3 } else { CHIRPS });
                for lane in 0..CHIRPS {
                    let chirp = CHIRPS * block + lane;
                    let tones: Vec<Tone> = echoes.iter().map(|echo| tone(echo, receiver, chirp)).collect();
                    exact.extend(exact_chirp(&tones, SAMPLES));
                    fast.extend(samples_of_chirp(&synthesiser, &grids[receiver], lane));
                }
            }
            let error_db = error_db(&exact, &fast);
            assert!(error_db < -26.0, "receiver {receiver}: {error_db} dB");
            let [power, found]: [f64; 2] =
                [exact.iter().map(|e| e * e).sum(), fast.iter().map(|f| f64::from(*f).powi(2)).sum()];
            let power_db = 10.0 * (found / power).log10();
            assert!(power_db.abs() < 0.02, "receiver {receiver}: {power_db} dB");
        }
    }

    /// Four cells represent a tone at any position to -40 dB of its samples, for any number of samples.
    #[test]
    fn four_cells_hold_a_tone() {
        for samples in [1, 16, 63, 256] {
            let synthesiser = Synthesiser::new(samples);
            for (place, taps) in synthesiser.rate_taps.by_delay().iter().enumerate() {
                let position = 7.0 - place as f64 / f64::from(POSITIONS);
                let mut grid = synthesiser.grid();
                for (tap, weight) in taps.iter().enumerate() {
                    grid.cells[7 + FIRST_TAP + tap] = Complex::new(*weight, 0.0);
                }
                let tone = Tone {
                    phase_cycles: 0.0,
                    cycles_per_sample: position / synthesiser.cells as f64,
                    amplitude: Complex::new(1.0, 0.0),
                };
                let error_db = error_db(&exact_chirp(&[tone], samples), &samples_of(&synthesiser, &grid));
                assert!(error_db < -40.0, "{samples} samples, place {place}: {error_db} dB");
            }
        }
    }

    #[test]
    fn every_level_gives_the_same_bits() {
        let held = held(&echoes(21));
        assert_same_at_every_level(|level| bits(&spread_at(level, &held, 2, 5)));
    }

    /// Echoes by delay are the same paths, times `j` and their delays.
    #[test]
    fn echoes_by_delay_are_their_own_times_their_delays() {
        let echo = echoes(1)[0];
        let held = held(&[echo]).by_delay();
        for (end, (u, [delay_s, ..])) in [0f32, 1.0].into_iter().zip(echo.delay).enumerate() {
            for receiver in 0..RECEIVERS {
                let expected = echo.amplitudes[receiver][end] * Complex64::new(0.0, delay_s);
                let [re, im] = [held.packs[0].re, held.packs[0].im]
                    .map(|rows| rows[receiver])
                    .map(|[begin, step]| begin[0] + u * step[0]);
                let found = Complex64::new(re.into(), im.into());
                assert!((found - expected).norm() < 1e-5 * expected.norm(), "{found} {expected}");
            }
        }
    }
}
