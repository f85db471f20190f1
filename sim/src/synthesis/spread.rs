//! Vectorised synthesis of paths in eight consecutive chirps.
//!
//! In eight chirps a path moves by a fraction of a cell of the grid, so its kernel mostly covers the same cells in all
//! of them. One aligned row of eight chirps is added to each cell, and all steps from polynomials to taps are the same
//! arithmetic in eight lanes. The bodies are plain Rust, compiled for each instruction set without fused multiply-add.
//! All instruction sets thus give the bits of [`Synthesiser::add`].
//!
//! Further receivers use the first one's phasors, rotated by their own delays. The kernel's taps are computed once for
//! all receivers whose tones are close enough.

use std::ops::Range;

use num_complex::Complex;

use super::{DEGREE, Grid, PADDED_TAPS, SHIFT, Synthesiser, WIDTH, fraction_of_turn, nearest_integer, phasor};
use crate::chirp::Chirp;
use crate::lanes::{compiled_for_levels, cos_sin_of_turns};
use crate::path_segment::PathSegment;
use crate::tracks::{ReceiverOffset, Track};

/// Number of chirps in a block.
pub const CHIRPS: usize = 8;
/// Distance of tones below which receivers share the kernel's taps, cells. The phase error of a tone is at most 6 mrad
/// at the ends of a chirp, 3.5 mrad rms (-49 dB).
const SHARED_CELLS: f32 = 1.0 / 256.0;

pub(super) type Row = [f32; CHIRPS];

/// Cell of the frequency grid in all chirps.
#[derive(Debug, Clone, Copy, Default)]
#[repr(C, align(64))]
pub(super) struct Cell {
    pub(super) re: Row,
    pub(super) im: Row,
}

impl Cell {
    /// Adds phasors times weights.
    #[inline(always)]
    pub(super) fn add(&mut self, re: &Row, im: &Row, weights: &Row) {
        for i in 0..CHIRPS {
            self.re[i] += re[i] * weights[i];
            self.im[i] += im[i] * weights[i];
        }
    }
}

/// Frequency grids of a block of chirps; [`Grid`] is the grid of one chirp.
#[derive(Debug, Clone, Default)]
pub struct Grids {
    pub(super) cells: Vec<Cell>,
}

impl Grids {
    /// Sets all cells to zero.
    pub fn clear(&mut self) {
        self.cells.fill(Cell::default());
    }

    /// Adds the grids of another block.
    pub fn add(&mut self, other: &Grids) {
        for (to, cell) in self.cells.iter_mut().zip(&other.cells) {
            for i in 0..CHIRPS {
                to.re[i] += cell.re[i];
                to.im[i] += cell.im[i];
            }
        }
    }

    /// Adds `a (1 - u) + b u` to the chirps at positions `u`.
    pub fn add_blend(&mut self, a: &Grid, b: &Grid, positions: &ChirpPositions) {
        let u: Row = std::array::from_fn(|i| positions.at[i] as f32 * positions.within[i]);
        for ((cell, a), b) in self.cells.iter_mut().zip(&a.cells).zip(&b.cells) {
            let step = b - a;
            for i in 0..CHIRPS {
                cell.re[i] += a.re * positions.within[i] + step.re * u[i];
                cell.im[i] += a.im * positions.within[i] + step.im * u[i];
            }
        }
    }

    /// Copies one chirp's grid to `grid`.
    pub fn extract(&self, chirp: usize, grid: &mut Grid) {
        let at = |row: &Row| row.get(chirp).copied().unwrap_or_default();
        grid.cells.clear();
        grid.cells.extend(self.cells.iter().map(|cell| Complex::new(at(&cell.re), at(&cell.im))));
    }
}

/// Chirps of a block that lie in one interval between two key times, and their positions in it.
#[derive(Debug, Clone, PartialEq)]
pub struct ChirpPositions {
    /// Position of each chirp in the interval, 0..1; that of the first one for chirps outside.
    pub(super) at: [f64; CHIRPS],
    /// 1 for chirps in the interval, 0 for others.
    pub(super) within: Row,
    lanes: Range<usize>,
}

impl ChirpPositions {
    /// Selects the evenly spaced chirps `lanes` of a block, at `position(chirp)` of their interval.
    pub fn new(lanes: Range<usize>, position: impl Fn(usize) -> f64) -> Self {
        let at = std::array::from_fn(|i| position(if lanes.contains(&i) { i } else { lanes.start }));
        let within = std::array::from_fn(|i| if lanes.contains(&i) { 1.0 } else { 0.0 });
        ChirpPositions { at, within, lanes: lanes.start.min(CHIRPS)..lanes.end.min(CHIRPS) }
    }

    /// Returns the indices of the chirps in the block.
    pub(super) fn lanes(&self) -> Range<usize> {
        self.lanes.clone()
    }
}

/// Inputs of [`tracks_body`] other than paths and grids.
struct Inputs<'a> {
    taps: &'a [[f32; PADDED_TAPS]; DEGREE],
    cells: f64,
    chirp: &'a Chirp,
    positions: &'a ChirpPositions,
}

impl Synthesiser {
    /// Returns empty grids of a block of chirps.
    pub fn grids(&self) -> Grids {
        Grids { cells: vec![Cell::default(); self.cells + PADDED_TAPS] }
    }

    /// Adds paths to the grids of all receivers, in the chirps that lie in the paths' interval.
    pub fn spread_tracks(&self, chirp: &Chirp, tracks: &[Track], positions: &ChirpPositions, grids: &mut [Grids]) {
        let inputs = Inputs { taps: &self.taps, cells: self.cells as f64, chirp, positions };
        spread_tracks(self.level, &inputs, tracks, grids);
    }
}

compiled_for_levels! {
    fn spread_tracks(inputs: &Inputs, tracks: &[Track], grids: &mut [Grids]) = tracks_body;
}

#[inline(always)]
fn tracks_body(inputs: &Inputs, tracks: &[Track], grids: &mut [Grids]) {
    let Some((grids_of_first, grids_of_others)) = grids.split_first_mut() else { return };
    for track in tracks {
        let tones = tones(inputs, &track.first);
        let weights = weights(inputs.taps, &tones.u);
        spread_weighted(&weights, &mut grids_of_first.cells, &tones.re, &tones.im, &tones.first);
        for (offset, grids) in track.others.iter().zip(grids_of_others.iter_mut()) {
            spread_other_receiver(inputs, &tones, &weights, offset, track.first.interval_s(), &mut grids.cells);
        }
    }
}

/// Adds the tones of a path at another receiver, from those at the first one.
#[inline(always)]
fn spread_other_receiver(
    inputs: &Inputs,
    tones: &Tones,
    weights_of_first: &[Row; WIDTH],
    offset: &ReceiverOffset,
    interval_s: f64,
    cells: &mut [Cell],
) {
    let [a, b, c, d] = offset.delay_s;
    let [begin, step] = offset.ratio;
    let slope = inputs.chirp.slope_hz_per_s as f32;
    let (per_s, cells_per_hz) = ((1.0 / interval_s) as f32, (inputs.cells / inputs.chirp.sample_rate_hz) as f32);
    // Separate rows: in-place sums would be computed one lane at a time.
    let (mut re, mut im, mut moved) = ([0f32; CHIRPS], [0f32; CHIRPS], [0f32; CHIRPS]);
    for i in 0..CHIRPS {
        let u = inputs.positions.at[i] as f32;
        let delay_s = a + u * (b + u * (c + u * d));
        let rate = (b + u * (2.0 * c + u * (3.0 * d))) * per_s;
        let (cosine, sine) = cos_sin_of_turns(delay_s * tones.carrier_hz[i]);
        let (x, y) = (begin.re + u * step.re, begin.im + u * step.im);
        let (x, y) = (x * cosine - y * sine, x * sine + y * cosine);
        re[i] = tones.re[i] * x - tones.im[i] * y;
        im[i] = tones.re[i] * y + tones.im[i] * x;
        moved[i] = (slope * delay_s + tones.carrier_hz[i] * rate) * cells_per_hz;
    }
    let max_moved = moved.iter().fold(0f32, |most, moved| most.max(moved.abs()));
    if max_moved < SHARED_CELLS {
        spread_weighted(weights_of_first, cells, &re, &im, &tones.first);
        return;
    }
    let (mut u, mut first) = ([0f32; CHIRPS], [0u32; CHIRPS]);
    for i in 0..CHIRPS {
        let position = tones.position[i] + f64::from(moved[i]);
        let position = if position < 0.0 { position + inputs.cells } else { position };
        (u[i], first[i]) = cell_under(position);
    }
    spread_weighted(&weights(inputs.taps, &u), cells, &re, &im, &first);
}

/// Tones of a path in every chirp of a block.
struct Tones {
    /// Phasor at the middle of the chirp; zero outside of the interval.
    re: Row,
    im: Row,
    /// Position on the grid, cells.
    position: [f64; CHIRPS],
    /// First cell under the kernel, and position within it, -1..1.
    first: [u32; CHIRPS],
    u: Row,
    /// Derivative of the phase by delay, cycles per second of delay.
    carrier_hz: Row,
}

#[inline(always)]
fn tones(inputs: &Inputs, path: &PathSegment) -> Tones {
    let Chirp { start_hz, slope_hz_per_s, middle_s, .. } = *inputs.chirp;
    let (mut re, mut im, mut u, mut carrier_hz) = ([0f32; CHIRPS], [0f32; CHIRPS], [0f32; CHIRPS], [0f32; CHIRPS]);
    let (mut position, mut first) = ([0f64; CHIRPS], [0u32; CHIRPS]);
    for i in 0..CHIRPS {
        let (delay_s, rate) = path.delay(inputs.positions.at[i]);
        let cycles_per_sample = inputs.chirp.beat_hz(delay_s, rate) / inputs.chirp.sample_rate_hz;
        let a = path.amplitude(inputs.positions.at[i]) * phasor(inputs.chirp.phase_cycles(delay_s));
        (re[i], im[i]) = (a.re * inputs.positions.within[i], a.im * inputs.positions.within[i]);
        position[i] = fraction_of_turn(cycles_per_sample) * inputs.cells;
        (u[i], first[i]) = cell_under(position[i]);
        carrier_hz[i] = (start_hz + slope_hz_per_s * (middle_s - delay_s)) as f32;
    }
    Tones { re, im, position, first, u, carrier_hz }
}

/// Returns the position within a cell, -1..1, and the first cell under the kernel, for a tone at a grid position,
/// cells.
#[inline(always)]
fn cell_under(position: f64) -> (f32, u32) {
    let whole = nearest_integer(position);
    let ceiling = if whole < position { whole + 1.0 } else { whole };
    // The integer is read from the last bits, because a conversion would be one lane at a time.
    ((2.0 * (ceiling - position) - 1.0) as f32, (ceiling + SHIFT).to_bits() as u32)
}

/// Computes the weight of each tap in every chirp. The taps are unrolled, because a loop would be vectorised across
/// taps, with gathers and scatters.
#[inline(always)]
fn weights(taps: &[[f32; PADDED_TAPS]; DEGREE], u: &Row) -> [Row; WIDTH] {
    [tap::<0>(taps, u), tap::<1>(taps, u), tap::<2>(taps, u), tap::<3>(taps, u), tap::<4>(taps, u), tap::<5>(taps, u)]
}

/// Adds a path's phasors with the weights of the taps. `first` is the first cell under the taps in each chirp.
#[inline(always)]
fn spread_weighted(weights: &[Row; WIDTH], cells: &mut [Cell], re: &Row, im: &Row, first: &[u32; CHIRPS]) {
    let [t0, t1, t2, t3, t4, t5] = weights;
    let lowest = first.iter().fold(u32::MAX, |lowest, &f| lowest.min(f));
    let spread = first.iter().fold(0, |all, f| all | (f - lowest));
    if spread == 0 {
        let Some([c0, c1, c2, c3, c4, c5]) = window(cells, lowest) else { return };
        c0.add(re, im, t0);
        c1.add(re, im, t1);
        c2.add(re, im, t2);
        c3.add(re, im, t3);
        c4.add(re, im, t4);
        c5.add(re, im, t5);
    } else if spread == 1 {
        // The path enters the next cell at some chirp; from there the taps lie one row further.
        let Some([c0, c1, c2, c3, c4, c5, c6]) = window(cells, lowest) else { return };
        let is_before: [bool; CHIRPS] = first.map(|f| f == lowest);
        c0.add(re, im, &choose(&is_before, t0, &[0.0; CHIRPS]));
        c1.add(re, im, &choose(&is_before, t1, t0));
        c2.add(re, im, &choose(&is_before, t2, t1));
        c3.add(re, im, &choose(&is_before, t3, t2));
        c4.add(re, im, &choose(&is_before, t4, t3));
        c5.add(re, im, &choose(&is_before, t5, t4));
        c6.add(re, im, &choose(&is_before, &[0.0; CHIRPS], t5));
    } else {
        add_one_by_one(cells, first, re, im, &[t0, t1, t2, t3, t4, t5]);
    }
}

/// Computes one tap of the kernel at positions within a cell.
#[inline(always)]
fn tap<const TAP: usize>(taps: &[[f32; PADDED_TAPS]; DEGREE], u: &Row) -> Row {
    let step = |w: Row, power: usize| -> Row { std::array::from_fn(|i| w[i] * u[i] + taps[power][TAP]) };
    let w = step([taps[7][TAP]; CHIRPS], 6);
    step(step(step(step(step(step(w, 5), 4), 3), 2), 1), 0)
}

/// Returns `N` cells from `first` on.
#[inline(always)]
pub(super) fn window<const N: usize>(cells: &mut [Cell], first: u32) -> Option<&mut [Cell; N]> {
    cells.get_mut(first as usize..)?.first_chunk_mut()
}

/// Returns `a` where `condition` holds, `b` elsewhere.
#[inline(always)]
fn choose(condition: &[bool; CHIRPS], a: &Row, b: &Row) -> Row {
    std::array::from_fn(|i| if condition[i] { a[i] } else { b[i] })
}

/// Adds a path whose chirps lie on distant cells, one chirp at a time. It is kept out of vectorisation, which would use
/// slower gathers.
#[cold]
#[inline(never)]
fn add_one_by_one(cells: &mut [Cell], first: &[u32; CHIRPS], re: &Row, im: &Row, taps: &[&Row; WIDTH]) {
    for i in 0..CHIRPS {
        let Some(window) = window::<WIDTH>(cells, first[i]) else { continue };
        for (cell, weights) in window.iter_mut().zip(taps) {
            cell.re[i] += re[i] * weights[i];
            cell.im[i] += im[i] * weights[i];
        }
    }
}

#[cfg(test)]
mod tests;
