//! Many weak echoes of random phases over a run of up to 32 chirps: on grids of delay and rate.
//!
//! Over a run an echo is a tone from sample to sample, and another from chirp to chirp, whose frequency is its rate. It is laid on
//! four cells by delay times eight by rate, with taps of least squares, and one transform along rates gives all chirps of a run.
//! With ten thousand echoes this takes about a third of the time of [`super::held`], which lays them down in each block. Three
//! things are not a tone:
//!
//! - The rate changes. A phase of `q` turns that grows with the square of the time from the run's middle to its ends is
//!   `exp(j pi q) exp(j pi q T2)`, of which two terms are kept beside the constant (Jacobi and Anger): what is left out is
//!   `(pi q)^3 / 24` of the amplitude.
//! - The delay moves on. To first order a tone that moves by `d` cells until the run's ends is itself, and its derivatives by both
//!   frequencies: `(0.9 d)^2 / 2` is left out.
//! - Amplitude, and differences between receivers, are those of the run's middle.
//!
//! Echoes for which one of these is too much are left to [`super::held`].

use std::sync::Arc;

use num_complex::Complex;
use radome_dsp::spectrum::complex_fft_f32;
use rustfft::Fft;

use super::fitted_taps::{Point, fitted_taps};
use super::held::{ECHOES, FIRST_TAP, HeldEchoes, PLACES, Pack, RECEIVERS, TAPS, under};
use super::spread::{CHIRPS, Grids};
use super::{Synthesiser, nearest_integer, on_circle};
use crate::chirp::Chirp;
use crate::lanes::{compiled_for_levels, cos_sin_of_turns};

/// Chirps of a run at most.
pub const RUN: usize = 32;
/// Half of that: times are counted in it from the run's middle.
const HALF: usize = RUN / 2;
/// Cells by rate.
const RATES: usize = 2 * RUN;
/// Cells by rate that an echo lies on.
const RATE_TAPS: usize = 8;
/// Factors of an echo: constant, both terms of its bend, and its move.
const FACTORS: usize = 4;

/// The most that a phase may bend until the run's ends, turns.
const MOST_BEND: f32 = 0.2;
/// The most that a delay may move until the run's ends, cells.
const MOST_MOVED: f32 = 0.3;
/// The most that both may be together: the move of a bent tone is left out.
const MOST_BENT_MOVE: f32 = 0.02;
/// The most by which receivers may drift apart until the run's ends, turns.
const MOST_APART: f32 = 0.01;
/// The most by which the amplitude may change until the run's ends, relative to it.
const MOST_CHANGE: f32 = 0.04;

/// Real and imaginary parts of an echo's cells by rate, one after the other.
type Wide = [f32; 2 * RATE_TAPS];

/// Cells by rate at one delay, with margins.
#[derive(Debug, Clone, Copy)]
#[repr(C, align(64))]
struct RateRow([f32; 2 * (RATES + RATE_TAPS)]);

const EMPTY: RateRow = RateRow([0.0; 2 * (RATES + RATE_TAPS)]);

/// Taps of echoes on grids of delay and rate, and the transform along rates.
#[derive(Clone)]
pub(super) struct RateTaps {
    /// Taps by rate of each factor at the places between cells that are kept.
    by_rate: Vec<[Wide; FACTORS]>,
    /// Taps by delay, and those of their derivative by the tone's place, rad.
    by_delay: Vec<[f32; TAPS]>,
    slopes: Vec<[f32; TAPS]>,
    fft: Arc<dyn Fft<f32>>,
}

impl RateTaps {
    /// For chirps whose samples are at these points.
    pub(super) fn new(samples: &[Point]) -> Self {
        let chirps: Vec<Point> = (0..RUN)
            .map(|n| Point { weight: 1.0, angle: std::f64::consts::TAU * (n as f64 - HALF as f64) / RATES as f64 })
            .collect();
        let time = |point: &Point| point.angle * RATES as f64 / (std::f64::consts::TAU * HALF as f64);
        let wide = |taps: [f32; RATE_TAPS]| -> Wide { std::array::from_fn(|i| taps[i / 2]) };
        let constant = fitted_taps(&chirps, |_, angle| angle.cos());
        let second = fitted_taps(&chirps, |point, angle| (2.0 * time(point).powi(2) - 1.0) * angle.cos());
        let fourth = fitted_taps(&chirps, |point, angle| {
            let square = time(point).powi(2);
            (8.0 * square * (square - 1.0) + 1.0) * angle.cos()
        });
        let moved = fitted_taps(&chirps, |point, angle| time(point) * angle.sin());
        let by_rate = (0..PLACES as usize)
            .map(|place| [&constant, &second, &fourth, &moved].map(|taps: &Vec<_>| wide(taps[place])))
            .collect();
        RateTaps {
            by_rate,
            by_delay: fitted_taps(samples, |_, angle| angle.cos()),
            slopes: fitted_taps(samples, |point, angle| point.angle * angle.sin()),
            fft: complex_fft_f32(RATES),
        }
    }

    /// Taps by delay at the places between cells that are kept.
    pub(super) fn by_delay(&self) -> &[[f32; TAPS]] {
        &self.by_delay
    }
}

/// Consecutive chirps within one stretch, as many as [`RUN`] at most: where they lie in the stretch, 0..1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Run {
    /// Place of the first chirp.
    pub first: f64,
    /// From chirp to chirp.
    pub step: f64,
    /// Number of chirps.
    pub chirps: usize,
}

/// Grids of delay and rate for each receiver.
pub struct RateGrids {
    /// `[receiver][cell by delay]`.
    rows: Vec<Vec<RateRow>>,
    /// Whether anything lies on a cell by delay.
    touched: Vec<bool>,
    /// Echoes that were not laid down.
    left: HeldEchoes,
    line: Vec<Complex<f32>>,
    scratch: Vec<Complex<f32>>,
}

/// Inputs of a level's instance of [`rates_body`] beside echoes and grids.
struct Kernel<'a> {
    taps: &'a RateTaps,
    cells: f64,
    chirp: &'a Chirp,
    /// Place of the run's middle in the stretch, and step from chirp to chirp.
    middle: f64,
    step: f64,
    /// Places of the stretch a second.
    per_s: f64,
}

impl Synthesiser {
    /// Empty grids of delay and rate.
    pub fn rate_grids(&self, receivers: usize) -> RateGrids {
        let cells = self.grids().cells.len();
        RateGrids {
            rows: vec![vec![EMPTY; cells]; receivers],
            touched: vec![false; cells],
            left: HeldEchoes::new(0.0),
            line: vec![Complex::default(); RATES],
            scratch: vec![Complex::default(); self.rate_taps.fft.get_inplace_scratch_len()],
        }
    }

    /// Adds echoes to the chirps of a run, `[receiver][block of chirps]`, but for those that change too much within it
    /// ([`RateGrids::left`]).
    pub fn spread_rates(
        &self,
        chirp: &Chirp,
        echoes: &HeldEchoes,
        run: &Run,
        rates: &mut RateGrids,
        blocks: &mut [Vec<Grids>],
    ) {
        let middle = run.first + run.step * (run.chirps / 2) as f64;
        let (cells, per_s) = (self.cells as f64, 1.0 / echoes.stretch_s());
        let kernel = Kernel { taps: &self.rate_taps, cells, chirp, middle, step: run.step, per_s };
        rates.left.clear(echoes.stretch_s());
        lay_rates(self.level, &kernel, echoes, rates);
        rates.transform(&*self.rate_taps.fft, run.chirps, blocks);
    }
}

impl RateGrids {
    /// The echoes that were left out last.
    pub fn left(&self) -> &HeldEchoes {
        &self.left
    }

    /// Adds the chirps of a run, and empties the grids.
    fn transform(&mut self, fft: &dyn Fft<f32>, chirps: usize, blocks: &mut [Vec<Grids>]) {
        const MARGIN: usize = RATE_TAPS / 2;
        for (cell, _) in self.touched.iter().enumerate().filter(|(_, touched)| **touched) {
            for (rows, blocks) in self.rows.iter_mut().zip(blocks.iter_mut()) {
                let Some(RateRow(row)) = rows.get_mut(cell) else { continue };
                let (pairs, _) = row.as_chunks::<2>();
                let at = |i: usize| pairs.get(i).map_or(Complex::default(), |[re, im]| Complex::new(*re, *im));
                for (rate, value) in self.line.iter_mut().enumerate() {
                    *value = at(rate + MARGIN);
                }
                for i in 0..MARGIN {
                    // Both ends of a row are other turns of the circle.
                    self.line[RATES - MARGIN + i] += at(i);
                    self.line[i] += at(RATES + MARGIN + i);
                }
                row.fill(0.0);
                fft.process_with_scratch(&mut self.line, &mut self.scratch);
                for n in 0..chirps {
                    let Some(to) = blocks.get_mut(n / CHIRPS).and_then(|grids| grids.cells.get_mut(cell)) else {
                        break;
                    };
                    // The transform turns the other way: time runs backwards in it.
                    let value = self.line[(RATES + chirps / 2 - n) % RATES];
                    to.re[n % CHIRPS] += value.re;
                    to.im[n % CHIRPS] += value.im;
                }
            }
        }
        self.touched.fill(false);
    }
}

compiled_for_levels! {
    fn lay_rates(kernel: &Kernel, echoes: &HeldEchoes, grids: &mut RateGrids) = rates_body;
}

#[inline(always)]
fn rates_body(kernel: &Kernel, echoes: &HeldEchoes, grids: &mut RateGrids) {
    let RateGrids { rows, touched, left, .. } = grids;
    let mut count = echoes.len();
    for pack in echoes.packs() {
        let middle = middle(kernel, pack);
        let factors = factors(&middle);
        for e in 0..count.min(ECHOES) {
            if middle.changes[e] {
                left.push_lane(pack, e);
            } else {
                lay_echo(kernel, [middle.position[e], middle.rate[e]], &factors, e, touched, rows);
            }
        }
        count = count.saturating_sub(ECHOES);
    }
}

type Lane = [f32; ECHOES];

/// Echoes side by side at the middle of a run.
struct Middle {
    /// Places on the grid by delay and by rate, cells.
    position: Lane,
    rate: Lane,
    /// Change of the delay until the run's ends, cells.
    moved: Lane,
    /// Part of the phase that grows with the square of the time, at the run's ends, turns.
    bend: Lane,
    /// Phasor at each receiver.
    re: [Lane; RECEIVERS],
    im: [Lane; RECEIVERS],
    /// Whether the echo changes too much within the run.
    changes: [bool; ECHOES],
}

#[inline(always)]
fn middle(kernel: &Kernel, pack: &Pack) -> Middle {
    let Chirp { start_hz, slope_hz_per_s, middle_s, sample_rate_hz } = *kernel.chirp;
    let ([value, slope, half_curve], cells_per_hz) = (pack.delay_at(kernel.middle), kernel.cells / sample_rate_hz);
    let half = HALF as f64 * kernel.step;
    let (mut turn, mut carrier_hz) = ([0f32; ECHOES], [0f32; ECHOES]);
    let (mut position, mut rate) = ([0f32; ECHOES], [0f32; ECHOES]);
    let (mut moved, mut bend) = ([0f32; ECHOES], [0f32; ECHOES]);
    for e in 0..ECHOES {
        let carrier = start_hz + slope_hz_per_s * (middle_s - value[e]);
        let cycles = kernel.chirp.phase_cycles(value[e]);
        turn[e] = (cycles - nearest_integer(cycles)) as f32;
        rate[e] = (on_circle(carrier * slope[e] * kernel.step) * RATES as f64) as f32;
        bend[e] = (carrier * half_curve[e] * half * half) as f32;
        let cycles_per_sample = kernel.chirp.beat_hz(value[e], slope[e] * kernel.per_s) / sample_rate_hz;
        position[e] = (on_circle(cycles_per_sample) * kernel.cells) as f32;
        moved[e] = (slope_hz_per_s * slope[e] * half * cells_per_hz) as f32;
        carrier_hz[e] = carrier as f32;
    }
    let (place, half) = (kernel.middle as f32, half as f32);
    let (mut re, mut im) = ([[0f32; ECHOES]; RECEIVERS], [[0f32; ECHOES]; RECEIVERS]);
    let mut changes = [false; ECHOES];
    for e in 0..ECHOES {
        let (x, y) = (pack.re[0][e] + place * pack.re[1][e], pack.im[0][e] + place * pack.im[1][e]);
        let (by_x, by_y) = (half * pack.re[1][e], half * pack.im[1][e]);
        let most = MOST_CHANGE * MOST_CHANGE * (x * x + y * y);
        changes[e] = (bend[e].abs() > MOST_BEND)
            | (moved[e].abs() > MOST_MOVED)
            | ((bend[e] * moved[e]).abs() > MOST_BENT_MOVE)
            | (by_x * by_x + by_y * by_y > most);
        // Half of the bend is a phase: a square is half a constant and half a Chebyshev polynomial.
        let (c, s) = cos_sin_of_turns(turn[e] + 0.5 * bend[e]);
        (re[0][e], im[0][e]) = (x * c - y * s, x * s + y * c);
    }
    for (receiver, beside) in pack.others.iter().enumerate() {
        let (mut own_re, mut own_im) = ([0f32; ECHOES], [0f32; ECHOES]);
        for e in 0..ECHOES {
            changes[e] |= (half * beside.delay_s[1][e] * carrier_hz[e]).abs() > MOST_APART;
            let (x, y) = beside.factor(e, place, carrier_hz[e]);
            own_re[e] = re[0][e] * x - im[0][e] * y;
            own_im[e] = re[0][e] * y + im[0][e] * x;
        }
        (re[1 + receiver], im[1 + receiver]) = (own_re, own_im);
    }
    Middle { position, rate, moved, bend, re, im, changes }
}

/// Real and imaginary part of each factor at each receiver: `[receiver][factor][echo]`.
struct Factors {
    re: [[Lane; FACTORS]; RECEIVERS],
    im: [[Lane; FACTORS]; RECEIVERS],
}

/// `exp(j x T2) = J0(x) + 2 j J1(x) T2 - 2 J2(x) T4` and on (Abramowitz and Stegun 9.1.44 and 45), by series; derivatives are `j`
/// times their taps.
#[inline(always)]
fn factors(middle: &Middle) -> Factors {
    let (mut by_0, mut by_1, mut by_2) = ([0f32; ECHOES], [0f32; ECHOES], [0f32; ECHOES]);
    for e in 0..ECHOES {
        let x = middle.bend[e] * std::f32::consts::PI;
        let square = x * x;
        by_0[e] = 1.0 - square * (0.25 - square * (1.0 / 64.0));
        by_1[e] = x * (1.0 - square * (0.125 - square * (1.0 / 192.0)));
        by_2[e] = square * (0.25 - square * (1.0 / 48.0));
    }
    let zero = [[[0f32; ECHOES]; FACTORS]; RECEIVERS];
    let mut out = Factors { re: zero, im: zero };
    for receiver in 0..RECEIVERS {
        let (x, y) = (&middle.re[receiver], &middle.im[receiver]);
        let (re, im) = (&mut out.re[receiver], &mut out.im[receiver]);
        for e in 0..ECHOES {
            (re[0][e], im[0][e]) = (x[e] * by_0[e], y[e] * by_0[e]);
            (re[1][e], im[1][e]) = (-y[e] * by_1[e], x[e] * by_1[e]);
            (re[2][e], im[2][e]) = (-x[e] * by_2[e], -y[e] * by_2[e]);
            (re[3][e], im[3][e]) = (y[e] * middle.moved[e], -x[e] * middle.moved[e]);
        }
    }
    out
}

/// Lays one echo down at its places by delay and by rate, cells.
#[inline(always)]
fn lay_echo(
    kernel: &Kernel,
    [position, rate]: [f32; 2],
    factors: &Factors,
    e: usize,
    touched: &mut [bool],
    rows: &mut [Vec<RateRow>],
) {
    let [(first, place), (first_rate, rate_place)] = [under(position), under(rate)];
    let (Some(taps), Some(slopes)) = (kernel.taps.by_delay.get(place), kernel.taps.slopes.get(place)) else { return };
    let Some([constant, second, fourth, moving]) = kernel.taps.by_rate.get(rate_place) else { return };
    let (first, first_rate) = (first as usize + FIRST_TAP, first_rate as usize);
    let Some(touched) = touched.get_mut(first..first + TAPS) else { return };
    touched.fill(true);
    for ((rows, re), im) in rows.iter_mut().zip(&factors.re).zip(&factors.im) {
        let factor = |of: usize| alternating(re[of][e], im[of][e]);
        let (by_constant, by_second, by_fourth, by_moving) = (factor(0), factor(1), factor(2), factor(3));
        let (mut field, mut moved) = ([0f32; 2 * RATE_TAPS], [0f32; 2 * RATE_TAPS]);
        for i in 0..2 * RATE_TAPS {
            field[i] = constant[i] * by_constant[i] + second[i] * by_second[i] + fourth[i] * by_fourth[i];
            moved[i] = moving[i] * by_moving[i];
        }
        let Some([r0, r1, r2, r3]) = rows.get_mut(first..first + TAPS) else { return };
        // Written out, as all loops over taps are.
        add(r0, first_rate, [&field, &moved], [taps[0], slopes[0]]);
        add(r1, first_rate, [&field, &moved], [taps[1], slopes[1]]);
        add(r2, first_rate, [&field, &moved], [taps[2], slopes[2]]);
        add(r3, first_rate, [&field, &moved], [taps[3], slopes[3]]);
    }
}

/// A complex number over and over.
#[inline(always)]
fn alternating(re: f32, im: f32) -> Wide {
    [re, im, re, im, re, im, re, im, re, im, re, im, re, im, re, im]
}

/// Adds an echo times a tap, and how it is moved times its slope, to the cells from one rate on.
#[inline(always)]
fn add(row: &mut RateRow, rate: usize, [field, moved]: [&Wide; 2], [tap, slope]: [f32; 2]) {
    let Some(cells) = row.0.get_mut(2 * rate..).and_then(|row| row.first_chunk_mut::<{ 2 * RATE_TAPS }>()) else {
        return;
    };
    for i in 0..2 * RATE_TAPS {
        cells[i] += field[i] * tap + moved[i] * slope;
    }
}

#[cfg(test)]
mod tests;
