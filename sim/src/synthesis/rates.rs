//! Synthesis of many weak echoes of random phases over a run of up to 32 chirps, on grids of delay and rate.
//!
//! Over a run an echo is a tone from sample to sample, with its beat frequency, and a tone from chirp to chirp, with
//! its Doppler frequency. It occupies four cells by delay times eight by rate, with least-squares taps. One transform
//! along rates gives all chirps of a run. With ten thousand echoes this takes about a third of the time of
//! [`super::held`], which adds them in each block. Three effects deviate from a tone:
//!
//! - The rate changes. Let a phase of `q` turns grow with the square of the time from the run's middle to its ends. It
//!   is `exp(j pi q) exp(j pi q T2)`, of which two terms are kept beside the constant (Jacobi and Anger). The error is
//!   `(pi q)^3 / 24` of the amplitude.
//! - The delay changes. To first order a tone that moves by `d` cells until the run's ends is itself plus its
//!   derivative by both frequencies; the error is `(0.9 d)^2 / 2`.
//! - The amplitude changes, on a straight line. Its products with a quadratic phase and with the movement are
//!   neglected.
//!
//! Echoes for which one of these effects is too large are rejected, and added by [`super::held`].

use std::sync::Arc;

use num_complex::Complex;
use radome_dsp::spectrum::complex_fft_f32;
use rustfft::Fft;

use super::fitted_taps::{Point, fitted_taps};
use super::held::{ECHOES, FIRST_TAP, HeldEchoes, POSITIONS, Pack, TAPS, quantised_position};
use super::spread::{CHIRPS, Grids};
use super::{Synthesiser, fraction_of_turn, nearest_integer};
use crate::chirp::Chirp;
use crate::lanes::{compiled_for_levels, cos_sin_of_turns};
use crate::tracks::RECEIVERS;

/// Largest number of chirps of a run.
pub const RUN: usize = 32;
/// Half of the longest run: unit of time from the run's middle.
const HALF: usize = RUN / 2;
/// Number of cells by rate.
const RATES: usize = 2 * RUN;
/// Number of cells by rate of one echo.
const RATE_TAPS: usize = 8;
/// Number of functions of time with taps of their own: constant, both terms of a quadratic phase, and a straight line.
const FUNCTIONS: usize = 4;
/// Number of factors of an echo: one for each function, and another one of the straight line, the change of its
/// amplitude.
const FACTORS: usize = 5;

/// Largest quadratic phase at the run's ends, turns.
const MAX_BEND: f32 = 0.2;
/// Largest change of the delay until the run's ends, cells.
const MAX_MOVED: f32 = 0.3;
/// Largest product of both: the movement of a tone with quadratic phase is neglected.
const MAX_BENT_MOVE: f32 = 0.02;
/// Largest product of the quadratic phase and the change of the first receiver's amplitude until the run's ends,
/// relative to it.
const MAX_BENT_CHANGE: f32 = 0.02;
/// Largest product of the movement and that change.
const MAX_MOVED_CHANGE: f32 = 0.1;

/// Interleaved real and imaginary parts of an echo's cells by rate.
type RateCells = [f32; 2 * RATE_TAPS];

/// Cells by rate at one delay, with margins.
#[derive(Debug, Clone, Copy)]
#[repr(C, align(64))]
struct RateRow([f32; 2 * (RATES + RATE_TAPS)]);

const EMPTY: RateRow = RateRow([0.0; 2 * (RATES + RATE_TAPS)]);

/// Taps of echoes on grids of delay and rate, and the transform along rates.
#[derive(Clone)]
pub(super) struct RateTaps {
    /// Taps by rate of each function at the quantised positions between cells.
    by_rate: Vec<[RateCells; FUNCTIONS]>,
    /// Taps by delay, and those of their derivative by the tone's position, rad.
    by_delay: Vec<[f32; TAPS]>,
    slopes: Vec<[f32; TAPS]>,
    fft: Arc<dyn Fft<f32>>,
}

impl RateTaps {
    /// Computes the taps for chirps whose samples are at these points.
    pub(super) fn new(samples: &[Point]) -> Self {
        let chirps: Vec<Point> = (0..RUN)
            .map(|n| Point { weight: 1.0, angle: std::f64::consts::TAU * (n as f64 - HALF as f64) / RATES as f64 })
            .collect();
        let time = |point: &Point| point.angle * RATES as f64 / (std::f64::consts::TAU * HALF as f64);
        let wide = |taps: [f32; RATE_TAPS]| -> RateCells { std::array::from_fn(|i| taps[i / 2]) };
        let constant = fitted_taps(&chirps, |_, angle| angle.cos());
        let second = fitted_taps(&chirps, |point, angle| (2.0 * time(point).powi(2) - 1.0) * angle.cos());
        let fourth = fitted_taps(&chirps, |point, angle| {
            let square = time(point).powi(2);
            (8.0 * square * (square - 1.0) + 1.0) * angle.cos()
        });
        let line = fitted_taps(&chirps, |point, angle| time(point) * angle.sin());
        let by_rate = (0..POSITIONS as usize)
            .map(|position| [&constant, &second, &fourth, &line].map(|taps: &Vec<_>| wide(taps[position])))
            .collect();
        RateTaps {
            by_rate,
            by_delay: fitted_taps(samples, |_, angle| angle.cos()),
            slopes: fitted_taps(samples, |point, angle| point.angle * angle.sin()),
            fft: complex_fft_f32(RATES),
        }
    }

    /// Returns the taps by delay at the quantised positions between cells.
    pub(super) fn by_delay(&self) -> &[[f32; TAPS]] {
        &self.by_delay
    }
}

/// Consecutive chirps within one interval, at most [`RUN`], by their positions in the interval, 0..1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Run {
    /// Position of the first chirp.
    pub first: f64,
    /// Step from chirp to chirp.
    pub step: f64,
    /// Number of chirps.
    pub chirps: usize,
}

/// Grids of delay and rate for each receiver.
pub struct RateGrids {
    /// Cells by rate: `[receiver][cell by delay]`.
    rows: Vec<Vec<RateRow>>,
    /// Whether a cell by delay is occupied.
    is_occupied: Vec<bool>,
    /// Echoes that were rejected.
    rejected: HeldEchoes,
    buffer: Vec<Complex<f32>>,
    scratch: Vec<Complex<f32>>,
}

/// Inputs of [`spread_rates_body`] other than echoes and grids.
struct Inputs<'a> {
    taps: &'a RateTaps,
    cells: f64,
    chirp: &'a Chirp,
    /// Position of the run's middle in the interval, and step from chirp to chirp.
    middle: f64,
    step: f64,
    /// Inverse duration of the interval, 1/s.
    per_s: f64,
}

impl Synthesiser {
    /// Returns empty grids of delay and rate.
    pub fn rate_grids(&self, receivers: usize) -> RateGrids {
        let cells = self.grids().cells.len();
        RateGrids {
            rows: vec![vec![EMPTY; cells]; receivers],
            is_occupied: vec![false; cells],
            rejected: HeldEchoes::new(0.0),
            buffer: vec![Complex::default(); RATES],
            scratch: vec![Complex::default(); self.rate_taps.fft.get_inplace_scratch_len()],
        }
    }

    /// Adds echoes to the chirps of a run, `[receiver][block of chirps]`, except for those that change too much within
    /// it ([`RateGrids::rejected`]).
    pub fn spread_rates(
        &self,
        chirp: &Chirp,
        echoes: &HeldEchoes,
        run: &Run,
        rates: &mut RateGrids,
        blocks: &mut [Vec<Grids>],
    ) {
        let middle = run.first + run.step * (run.chirps / 2) as f64;
        let (cells, per_s) = (self.cells as f64, 1.0 / echoes.interval_s());
        let inputs = Inputs { taps: &self.rate_taps, cells, chirp, middle, step: run.step, per_s };
        rates.rejected.clear(echoes.interval_s());
        spread_rates(self.level, &inputs, echoes, rates);
        rates.transform(&*self.rate_taps.fft, run.chirps, blocks);
    }
}

impl RateGrids {
    /// Returns the echoes that the last run rejected.
    pub fn rejected(&self) -> &HeldEchoes {
        &self.rejected
    }

    /// Transforms the grids to the chirps of a run, and clears the grids.
    fn transform(&mut self, fft: &dyn Fft<f32>, chirps: usize, blocks: &mut [Vec<Grids>]) {
        const MARGIN: usize = RATE_TAPS / 2;
        for (cell, _) in self.is_occupied.iter().enumerate().filter(|(_, is_occupied)| **is_occupied) {
            for (rows, blocks) in self.rows.iter_mut().zip(blocks.iter_mut()) {
                let Some(RateRow(row)) = rows.get_mut(cell) else { continue };
                let (pairs, _) = row.as_chunks::<2>();
                let at = |i: usize| pairs.get(i).map_or(Complex::default(), |[re, im]| Complex::new(*re, *im));
                for (rate, value) in self.buffer.iter_mut().enumerate() {
                    *value = at(rate + MARGIN);
                }
                for i in 0..MARGIN {
                    // Both ends of a row wrap around the circle.
                    self.buffer[RATES - MARGIN + i] += at(i);
                    self.buffer[i] += at(RATES + MARGIN + i);
                }
                row.fill(0.0);
                fft.process_with_scratch(&mut self.buffer, &mut self.scratch);
                for n in 0..chirps {
                    let Some(to) = blocks.get_mut(n / CHIRPS).and_then(|grids| grids.cells.get_mut(cell)) else {
                        break;
                    };
                    // The transform has the opposite sign, so time is reversed in it.
                    let value = self.buffer[(RATES + chirps / 2 - n) % RATES];
                    to.re[n % CHIRPS] += value.re;
                    to.im[n % CHIRPS] += value.im;
                }
            }
        }
        self.is_occupied.fill(false);
    }
}

compiled_for_levels! {
    fn spread_rates(inputs: &Inputs, echoes: &HeldEchoes, grids: &mut RateGrids) = spread_rates_body;
}

#[inline(always)]
fn spread_rates_body(inputs: &Inputs, echoes: &HeldEchoes, grids: &mut RateGrids) {
    let RateGrids { rows, is_occupied, rejected, .. } = grids;
    let (mut count, receivers) = (echoes.len(), rows.len().min(RECEIVERS));
    for pack in echoes.packs() {
        let at_middle = values_at_middle(inputs, pack, receivers);
        let factors = factors(&at_middle, receivers);
        for e in 0..count.min(ECHOES) {
            if at_middle.is_rejected[e] {
                rejected.push_lane(pack, e);
            } else {
                spread_echo(inputs, [at_middle.position[e], at_middle.rate[e]], &factors, e, is_occupied, rows);
            }
        }
        count = count.saturating_sub(ECHOES);
    }
}

type Lane = [f32; ECHOES];

/// Pack of echoes at the middle of a run.
struct MiddleValues {
    /// Positions on the grid by delay and by rate, cells.
    position: Lane,
    rate: Lane,
    /// Change of the delay until the run's ends, cells.
    moved: Lane,
    /// Quadratic part of the phase at the run's ends, turns.
    bend: Lane,
    /// Phasor at each receiver, and its change until the run's end due to the amplitude.
    re: [Lane; RECEIVERS],
    im: [Lane; RECEIVERS],
    change_re: [Lane; RECEIVERS],
    change_im: [Lane; RECEIVERS],
    /// Whether the echo changes too much within the run.
    is_rejected: [bool; ECHOES],
}

#[inline(always)]
fn values_at_middle(inputs: &Inputs, pack: &Pack, receivers: usize) -> MiddleValues {
    let Chirp { start_hz, slope_hz_per_s, middle_s, sample_rate_hz } = *inputs.chirp;
    let ([value, slope, half_curve], cells_per_hz) = (pack.delay_at(inputs.middle), inputs.cells / sample_rate_hz);
    let half = HALF as f64 * inputs.step;
    let (mut turn, mut position, mut rate) = ([0f32; ECHOES], [0f32; ECHOES], [0f32; ECHOES]);
    let (mut moved, mut bend) = ([0f32; ECHOES], [0f32; ECHOES]);
    for e in 0..ECHOES {
        let carrier = start_hz + slope_hz_per_s * (middle_s - value[e]);
        let cycles = inputs.chirp.phase_cycles(value[e]);
        turn[e] = (cycles - nearest_integer(cycles)) as f32;
        rate[e] = (fraction_of_turn(carrier * slope[e] * inputs.step) * RATES as f64) as f32;
        bend[e] = (carrier * half_curve[e] * half * half) as f32;
        let cycles_per_sample = inputs.chirp.beat_hz(value[e], slope[e] * inputs.per_s) / sample_rate_hz;
        position[e] = (fraction_of_turn(cycles_per_sample) * inputs.cells) as f32;
        moved[e] = (slope_hz_per_s * slope[e] * half * cells_per_hz) as f32;
    }
    let (u_f32, half) = (inputs.middle as f32, half as f32);
    let zero = [[0f32; ECHOES]; RECEIVERS];
    let (mut re, mut im, mut change_re, mut change_im) = (zero, zero, zero, zero);
    let (mut cosine, mut sine) = ([0f32; ECHOES], [0f32; ECHOES]);
    for e in 0..ECHOES {
        // Half of the quadratic phase is constant: a square is half a constant and half a Chebyshev polynomial.
        (cosine[e], sine[e]) = cos_sin_of_turns(turn[e] + 0.5 * bend[e]);
    }
    for receiver in 0..receivers {
        let ([from_x, step_x], [from_y, step_y]) = (&pack.re[receiver], &pack.im[receiver]);
        for e in 0..ECHOES {
            let (x, y) = (from_x[e] + u_f32 * step_x[e], from_y[e] + u_f32 * step_y[e]);
            re[receiver][e] = x * cosine[e] - y * sine[e];
            im[receiver][e] = x * sine[e] + y * cosine[e];
            let (x, y) = (half * step_x[e], half * step_y[e]);
            change_re[receiver][e] = x * cosine[e] - y * sine[e];
            change_im[receiver][e] = x * sine[e] + y * cosine[e];
        }
    }
    let mut is_rejected = [false; ECHOES];
    for e in 0..ECHOES {
        // The receivers are so close together that the first represents all. The result at one receiver then does not
        // depend on which others are enabled.
        let square = re[0][e] * re[0][e] + im[0][e] * im[0][e];
        let change = change_re[0][e] * change_re[0][e] + change_im[0][e] * change_im[0][e];
        is_rejected[e] = (bend[e].abs() > MAX_BEND)
            | (moved[e].abs() > MAX_MOVED)
            | ((bend[e] * moved[e]).abs() > MAX_BENT_MOVE)
            | (bend[e] * bend[e] * change > MAX_BENT_CHANGE * MAX_BENT_CHANGE * square)
            | (moved[e] * moved[e] * change > MAX_MOVED_CHANGE * MAX_MOVED_CHANGE * square);
    }
    MiddleValues { position, rate, moved, bend, re, im, change_re, change_im, is_rejected }
}

/// Real and imaginary part of each factor at each receiver: `[receiver][factor][echo]`.
struct Factors {
    re: [[Lane; FACTORS]; RECEIVERS],
    im: [[Lane; FACTORS]; RECEIVERS],
}

/// Expands `exp(j x T2) = J0(x) + 2 j J1(x) T2 - 2 J2(x) T4` and so on (Abramowitz and Stegun 9.1.44 and 45), with the
/// Bessel functions by series. Derivatives are `j` times their taps.
#[inline(always)]
fn factors(at_middle: &MiddleValues, receivers: usize) -> Factors {
    let (mut by_0, mut by_1, mut by_2) = ([0f32; ECHOES], [0f32; ECHOES], [0f32; ECHOES]);
    for e in 0..ECHOES {
        let x = at_middle.bend[e] * std::f32::consts::PI;
        let square = x * x;
        by_0[e] = 1.0 - square * (0.25 - square * (1.0 / 64.0));
        by_1[e] = x * (1.0 - square * (0.125 - square * (1.0 / 192.0)));
        by_2[e] = square * (0.25 - square * (1.0 / 48.0));
    }
    let zero = [[[0f32; ECHOES]; FACTORS]; RECEIVERS];
    let mut out = Factors { re: zero, im: zero };
    for receiver in 0..receivers {
        let (x, y) = (&at_middle.re[receiver], &at_middle.im[receiver]);
        let (change_x, change_y) = (&at_middle.change_re[receiver], &at_middle.change_im[receiver]);
        let (re, im) = (&mut out.re[receiver], &mut out.im[receiver]);
        for e in 0..ECHOES {
            (re[0][e], im[0][e]) = (x[e] * by_0[e], y[e] * by_0[e]);
            (re[1][e], im[1][e]) = (-y[e] * by_1[e], x[e] * by_1[e]);
            (re[2][e], im[2][e]) = (-x[e] * by_2[e], -y[e] * by_2[e]);
            (re[3][e], im[3][e]) = (y[e] * at_middle.moved[e], -x[e] * at_middle.moved[e]);
            (re[4][e], im[4][e]) = (change_y[e], -change_x[e]);
        }
    }
    out
}

/// Adds one echo at its positions by delay and by rate, cells.
#[inline(always)]
fn spread_echo(
    inputs: &Inputs,
    [position, rate]: [f32; 2],
    factors: &Factors,
    e: usize,
    is_occupied: &mut [bool],
    rows: &mut [Vec<RateRow>],
) {
    let [(first, index), (first_rate, rate_index)] = [quantised_position(position), quantised_position(rate)];
    let (Some(taps), Some(slopes)) = (inputs.taps.by_delay.get(index), inputs.taps.slopes.get(index)) else { return };
    let Some([constant, second, fourth, line]) = inputs.taps.by_rate.get(rate_index) else { return };
    let (first, first_rate) = (first as usize + FIRST_TAP, first_rate as usize);
    let Some(is_occupied) = is_occupied.get_mut(first..first + TAPS) else { return };
    is_occupied.fill(true);
    for ((rows, re), im) in rows.iter_mut().zip(&factors.re).zip(&factors.im) {
        let factor = |of: usize| alternating(re[of][e], im[of][e]);
        let (by_constant, by_second, by_fourth, by_moving, by_change) =
            (factor(0), factor(1), factor(2), factor(3), factor(4));
        let (mut field, mut moved) = ([0f32; 2 * RATE_TAPS], [0f32; 2 * RATE_TAPS]);
        for i in 0..2 * RATE_TAPS {
            field[i] = constant[i] * by_constant[i]
                + second[i] * by_second[i]
                + fourth[i] * by_fourth[i]
                + line[i] * by_change[i];
            moved[i] = line[i] * by_moving[i];
        }
        let Some([r0, r1, r2, r3]) = rows.get_mut(first..first + TAPS) else { return };
        // Unrolled, like all loops over taps.
        add(r0, first_rate, [&field, &moved], [taps[0], slopes[0]]);
        add(r1, first_rate, [&field, &moved], [taps[1], slopes[1]]);
        add(r2, first_rate, [&field, &moved], [taps[2], slopes[2]]);
        add(r3, first_rate, [&field, &moved], [taps[3], slopes[3]]);
    }
}

/// Repeats a complex number over all cells.
#[inline(always)]
fn alternating(re: f32, im: f32) -> RateCells {
    [re, im, re, im, re, im, re, im, re, im, re, im, re, im, re, im]
}

/// Adds an echo times a tap, and its movement times the slope, to the cells from `rate` on.
#[inline(always)]
fn add(row: &mut RateRow, rate: usize, [field, moved]: [&RateCells; 2], [tap, slope]: [f32; 2]) {
    let Some(cells) = row.0.get_mut(2 * rate..).and_then(|row| row.first_chunk_mut::<{ 2 * RATE_TAPS }>()) else {
        return;
    };
    for i in 0..2 * RATE_TAPS {
        cells[i] += field[i] * tap + moved[i] * slope;
    }
}

#[cfg(test)]
mod tests;
