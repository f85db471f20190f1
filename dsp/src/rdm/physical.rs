//! Maps on [`PhysicalAxes`]: discrete Fourier sums at exactly the ranges and velocities of their cells.
//!
//! Both stages are products of matrices in f32: samples by `[sample][range]`, then `[velocity][chirp]` by the range spectra. The
//! matrices contain windows, scale and the removal of the mean over slow time. The order of the sums is the same at every kernel
//! level, without fused multiply-add, so that all levels give the same powers to the bit.

use std::f64::consts::TAU;
use std::ops::Range;

use num_complex::Complex64;

use super::axes::{AxesCoverage, PhysicalAxes};
use super::change::Change;
use super::plan::MapPlan;
use super::spec::RdmSpec;
use crate::decibel::power_to_db_portable;
use crate::{KernelLevel, MAX_CODE, Waveform, dispatch, split_mix_64};

/// Number of receivers of the chip.
const MOST_RECEIVERS: usize = 3;
/// Lower quartile of the mean noise power of one, two and three receivers, in units of its mean: quartiles of gamma distributions.
/// For one receiver, whose noise power is exponential, it is `ln(4/3)`.
pub(super) const QUARTILES: [f32; MOST_RECEIVERS] = [0.287_682_1, 0.480_639_37, 0.575_766_44];
/// Purpose of the noise draws, which separates them from other draws with the same sequence number.
const PURPOSE: u64 = 0x7068_7973_6963_616c;

pub(super) struct PhysicalTransform {
    level: KernelLevel,
    /// Indices of the samples of a chirp and of the chirps of a frame that are transformed.
    samples: Range<usize>,
    chirps: Range<usize>,
    /// Range cells and velocity cells that are measured.
    range: usize,
    velocity: Range<usize>,
    /// `[sample][real, imaginary][range]`.
    range_matrix: Vec<f32>,
    /// `[velocity][real, imaginary][chirp]`.
    doppler_matrix: Vec<f32>,
    /// `[chirp][real, imaginary][range]`.
    spectra: Vec<f32>,
    /// Sums `[real, imaginary][range]` of the spectra, weighted by the real or the imaginary part of a row of
    /// `doppler_matrix`.
    by_real: Vec<f32>,
    by_imaginary: Vec<f32>,
    /// State of change of each used channel, empty if the spec asks for none.
    change: Vec<Change>,
    /// Cells of zero velocity, which hold the change.
    zero: Range<usize>,
    /// Weights of the chirps at zero velocity, `[chirp]`.
    zero_weights: Vec<f32>,
    /// Whether each of the used channels gives a signal and enters the mean.
    alive: Vec<bool>,
    /// Samples of the lowest and the highest code.
    code_limits: [f32; 2],
    unmeasured: UnmeasuredCells,
}

impl PhysicalTransform {
    /// Creates the transform for the plan of a spec with these axes and this coverage; `level` must be available.
    pub(super) fn new(
        plan: &MapPlan,
        spec: &RdmSpec,
        axes: &PhysicalAxes,
        coverage: AxesCoverage,
        waveform: &Waveform,
        level: KernelLevel,
    ) -> Self {
        let (range, velocity) = (coverage.range_bins, coverage.velocity_bins);
        let range_cycles = axes.range_step_m / waveform.range_step_m(1);
        let mut range_matrix = Vec::with_capacity(coverage.samples.len() * 2 * range);
        for (sample, weight) in plan.range_window.iter().enumerate() {
            let row: Vec<Complex64> = (0..range)
                .map(|bin| {
                    let gain = if bin == 0 { plan.dc_amplitude } else { 1.0 };
                    phasor(gain * weight, bin as f64 * range_cycles * sample as f64)
                })
                .collect();
            range_matrix.extend(row.iter().map(|x| x.re as f32));
            range_matrix.extend(row.iter().map(|x| x.im as f32));
        }
        let velocity_cycles = axes.velocity_step_m_per_s / waveform.velocity_step_m_per_s(1);
        let zero = (axes.velocity_bins / 2) as f64;
        let mut doppler_matrix = Vec::with_capacity(velocity.len() * 2 * coverage.chirps.len());
        for bin in velocity.clone() {
            let cycles = (bin as f64 - zero) * velocity_cycles;
            let window = plan.doppler_window.iter().enumerate();
            let mut row: Vec<Complex64> =
                window.map(|(chirp, weight)| phasor(*weight, cycles * chirp as f64)).collect();
            if plan.removes_slow_time_mean {
                // The sum of (x - mean of x) times the row is the sum of x times (the row - mean of the row).
                let mean = row.iter().sum::<Complex64>() / row.len() as f64;
                row.iter_mut().for_each(|x| *x -= mean);
            }
            doppler_matrix.extend(row.iter().map(|x| x.re as f32));
            doppler_matrix.extend(row.iter().map(|x| x.im as f32));
        }
        let (factor, offset) = (plan.scale.0 as f32, plan.scale.1 as f32);
        let change = |time_s| Change::new(range, time_s, waveform.frame_interval_s());
        let zero = axes.velocity_bins / 2 * axes.range_bins;
        PhysicalTransform {
            level,
            change: spec
                .change_over_s
                .map_or_else(Vec::new, |time_s| plan.channels.clone().map(|_| change(time_s)).collect()),
            zero: zero..zero + range,
            zero_weights: plan.doppler_window.iter().map(|weight| *weight as f32).collect(),
            spectra: vec![0.0; coverage.chirps.len() * 2 * range],
            by_real: vec![0.0; 2 * range],
            by_imaginary: vec![0.0; 2 * range],
            alive: vec![true; plan.channels.len()],
            code_limits: [0, MAX_CODE].map(|code| f32::from(code) * factor + offset),
            unmeasured: UnmeasuredCells::new(axes, range, &velocity),
            samples: coverage.samples,
            chirps: coverage.chirps,
            range,
            velocity,
            range_matrix,
            doppler_matrix,
        }
    }

    /// Sets the receivers that give a signal, from all samples of the used channels before any removal.
    pub(super) fn set_alive_by_samples(&mut self, plan: &MapPlan, samples: &[f32]) {
        let (length, limits) = (plan.channel_length(), self.code_limits);
        self.set_alive(plan, |rx| {
            samples.chunks_exact(length).nth(rx).is_some_and(|channel| !is_dead(channel, limits))
        });
    }

    /// Sets the receivers that give a signal; all of them if none does. Only a mean over all receivers needs them.
    pub(super) fn set_alive(&mut self, plan: &MapPlan, is_alive: impl Fn(usize) -> bool) {
        if !plan.is_sum {
            return;
        }
        for (rx, alive) in self.alive.iter_mut().enumerate() {
            *alive = is_alive(rx);
        }
        if !self.alive.contains(&true) {
            self.alive.fill(true);
        }
    }

    /// Computes the power of all used channels `[channel][chirp][sample]` into the map's cells.
    pub(super) fn transform_frame(&mut self, plan: &MapPlan, samples: &[f32], sequence: u64, cells: &mut [f32]) {
        let mut adds = false;
        for (index, channel) in samples.chunks_exact(plan.channel_length()).enumerate() {
            if self.alive.get(index) == Some(&true) {
                let cells = &mut cells[plan.cells(index)];
                self.transform_channel(plan, channel, adds, cells);
                self.write_change(index, adds, &mut cells[self.zero.clone()]);
                adds = plan.is_sum;
            }
        }
        let alive = self.alive.iter().filter(|alive| **alive).count();
        if plan.is_sum && alive < plan.channels.len() {
            // The plan's scale is for the mean over all channels.
            let scale = plan.channels.len() as f32 / alive as f32;
            cells.iter_mut().for_each(|cell| *cell *= scale);
        }
        let receivers = if plan.is_sum { alive } else { 1 };
        for index in 0..plan.shape.rx {
            let cells = &mut cells[plan.cells(index)];
            self.unmeasured.fill(plan.shape.range, receivers, [sequence, index as u64], cells);
        }
    }

    /// Clears the state of change.
    pub(super) fn reset(&mut self) {
        self.change.iter_mut().for_each(Change::reset);
    }

    /// Writes the change of the channel in `spectra` into the cells of zero velocity, or adds it.
    fn write_change(&mut self, index: usize, adds: bool, cells: &mut [f32]) {
        if let Some(change) = self.change.get_mut(index) {
            weighted_sum(self.level, &self.zero_weights, &self.spectra, &mut self.by_real);
            let (real, imaginary) = self.by_real.split_at(self.range);
            change.push(real, imaginary, adds, cells);
        }
    }

    /// Writes the power of one channel `[chirp][sample]` into the measured cells, or adds it.
    fn transform_channel(&mut self, plan: &MapPlan, samples: &[f32], adds: bool, cells: &mut [f32]) {
        let chirps = samples.chunks_exact(plan.frame_shape.samples).skip(self.chirps.start);
        for (chirp, spectrum) in chirps.zip(self.spectra.chunks_exact_mut(2 * self.range)) {
            weighted_sum(self.level, &chirp[self.samples.clone()], &self.range_matrix, spectrum);
        }
        let chirps = self.chirps.len();
        let change_row = if self.change.is_empty() { None } else { Some(self.zero.start / plan.shape.range) };
        for (bin, weights) in self.velocity.clone().zip(self.doppler_matrix.chunks_exact(2 * chirps)) {
            if change_row == Some(bin) {
                continue;
            }
            let (real, imaginary) = weights.split_at(chirps);
            weighted_sum(self.level, real, &self.spectra, &mut self.by_real);
            weighted_sum(self.level, imaginary, &self.spectra, &mut self.by_imaginary);
            let (re_by_re, im_by_re) = self.by_real.split_at(self.range);
            let (re_by_im, im_by_im) = self.by_imaginary.split_at(self.range);
            let first = bin * plan.shape.range;
            let cells = cells[first..first + self.range].iter_mut();
            for ((((cell, re_by_re), im_by_re), re_by_im), im_by_im) in
                cells.zip(re_by_re).zip(im_by_re).zip(re_by_im).zip(im_by_im)
            {
                let (re, im) = (re_by_re - im_by_im, im_by_re + re_by_im);
                let power = re * re + im * im;
                *cell = if adds { *cell + power } else { power };
            }
        }
    }
}

/// `weight * exp(-j 2 pi cycles)`.
fn phasor(weight: f64, cycles: f64) -> Complex64 {
    // Whole cycles are removed first, because the sine of a large phase loses digits.
    let (sin, cos) = (-TAU * cycles.fract()).sin_cos();
    Complex64::new(weight * cos, weight * sin)
}

/// Returns whether a receiver gives no signal: all of its samples are the same, or at least half of them lie at the ends of the
/// ADC's range.
fn is_dead(samples: &[f32], [lowest, highest]: [f32; 2]) -> bool {
    let is_constant = samples.first().is_none_or(|first| samples.iter().all(|x| x == first));
    let at_ends = samples.iter().filter(|x| **x <= lowest || **x >= highest).count();
    is_constant || 2 * at_ends >= samples.len()
}

/// Cells that frames of a waveform do not measure, and the buffers to fill them with noise.
///
/// The noise consists of independent draws from the distribution of noise in the measured cells: the mean power of as
/// many receivers. Its level is that of the noise in the same range bin: the lower quartile of the bin's measured cells
/// over the quartile of the distribution. Range bins without measured cells get the median level of the others. The
/// draws are a function of sequence number, map and cell. A constant would reveal the waveform to a model, and would
/// move the quartile that estimates a bin's noise. One pattern for all frames could be memorised by a model.
struct UnmeasuredCells {
    /// Indices of the cells in a map.
    cells: Vec<usize>,
    range: usize,
    velocity: Range<usize>,
    /// Power of each cell over the mean.
    power: Vec<f32>,
    /// Random number of each cell for one receiver, later its level in dB.
    draw: Vec<f32>,
    /// Noise power by range bin.
    noise: Vec<f32>,
    /// Buffer of the values of which a quantile is taken.
    sorted: Vec<f32>,
}

impl UnmeasuredCells {
    fn new(axes: &PhysicalAxes, range: usize, velocity: &Range<usize>) -> Self {
        let is_measured = |cell: &usize| velocity.contains(&(cell / axes.range_bins)) && cell % axes.range_bins < range;
        let cells: Vec<usize> = (0..axes.velocity_bins * axes.range_bins).filter(|cell| !is_measured(cell)).collect();
        UnmeasuredCells {
            range,
            velocity: velocity.clone(),
            power: vec![0.0; cells.len()],
            draw: vec![0.0; cells.len()],
            noise: vec![0.0; axes.range_bins],
            sorted: Vec::with_capacity(axes.velocity_bins.max(axes.range_bins)),
            cells,
        }
    }

    /// Fills the cells of a map `[velocity][range]` with `bins` range bins, whose measured cells are the mean power of
    /// `receivers` receivers. `key` is the sequence number and the index of the map.
    fn fill(&mut self, bins: usize, receivers: usize, key: [u64; 2], map: &mut [f32]) {
        if self.cells.is_empty() {
            return;
        }
        let receivers = receivers.clamp(1, MOST_RECEIVERS);
        for bin in 0..self.range {
            self.sorted.clear();
            self.sorted.extend(self.velocity.clone().map(|row| map[row * bins + bin]));
            self.noise[bin] = quantile(&mut self.sorted, 4) / QUARTILES[receivers - 1];
        }
        self.sorted.clear();
        self.sorted.extend_from_slice(&self.noise[..self.range]);
        let median = quantile(&mut self.sorted, 2);
        self.noise[self.range..].fill(median);

        let [sequence, index] = key;
        let seed = split_mix_64(sequence ^ split_mix_64(index ^ PURPOSE));
        self.power.fill(0.0);
        for receiver in 0..receivers {
            for (draw, cell) in self.draw.iter_mut().zip(&self.cells) {
                let bits = split_mix_64(seed ^ split_mix_64((cell * MOST_RECEIVERS + receiver) as u64));
                // Above 0, up to 1, on a grid of 2^-24.
                *draw = ((bits >> 40) + 1) as f32 / 16_777_216.0;
            }
            // The portable logarithm gives the same bits on every machine.
            power_to_db_portable(&mut self.draw, f32::MIN_POSITIVE);
            let share = std::f32::consts::LN_10 / 10.0 / receivers as f32;
            self.power.iter_mut().zip(&self.draw).for_each(|(power, draw)| *power -= share * draw);
        }
        for (cell, power) in self.cells.iter().zip(&self.power) {
            map[*cell] = self.noise[cell % bins] * power;
        }
    }
}

/// Value below which the share `1 / parts` of the values lies; 0 if there are no values.
pub(super) fn quantile(values: &mut [f32], parts: usize) -> f32 {
    let index = values.len() / parts;
    if index >= values.len() {
        return 0.0;
    }
    *values.select_nth_unstable_by(index, f32::total_cmp).1
}

dispatch! {
    /// Sums `rows`, each as long as `sums`, each times its weight.
    fn weighted_sum(weights: &[f32], rows: &[f32], sums: &mut [f32]) = sum_rows
}

#[inline(always)]
fn sum_rows<const FUSED: bool>(weights: &[f32], rows: &[f32], sums: &mut [f32]) {
    let width = sums.len().max(1);
    sums.fill(0.0);
    // Four rows at a time: the sums are read and written a quarter as often.
    let (fours, rest) = weights.as_chunks::<4>();
    let (rows_of_fours, rows_of_rest) = rows.split_at((fours.len() * 4 * width).min(rows.len()));
    for ([u, v, w, x], four) in fours.iter().zip(rows_of_fours.chunks_exact(4 * width)) {
        let (a, four) = four.split_at(width);
        let (b, four) = four.split_at(width);
        let (c, d) = four.split_at(width);
        for ((((sum, a), b), c), d) in sums.iter_mut().zip(a).zip(b).zip(c).zip(d) {
            *sum += (u * a + v * b) + (w * c + x * d);
        }
    }
    for (weight, row) in rest.iter().zip(rows_of_rest.chunks_exact(width)) {
        for (sum, x) in sums.iter_mut().zip(row) {
            *sum += weight * x;
        }
    }
}
