//! Range stage and Doppler stage of one channel, from codes to cells.

use std::f64::consts::TAU;

use super::fft::{Complex, Plan, Sink, Source};
use super::vector::Vector;
use crate::rdm::plan::MapPlan;

/// One channel of a frame.
#[derive(Clone, Copy)]
pub(in crate::rdm) enum Input<'a> {
    /// Raw codes `[chirp][sample]`; scaling, and removal of each chirp's mean, are part of the transform.
    Codes(&'a [u16]),
    /// Samples `[chirp][sample]` ready for the window.
    Samples(&'a [f32]),
}

/// Form in which the cells of a channel are written.
#[derive(Clone, Copy)]
pub(in crate::rdm) enum Output {
    /// Decibels; power is raised to `floor_power` first.
    Decibels { floor_power: f32 },
    /// Power, written or added to the cells.
    Power { adds: bool },
}

/// Range bins that go through the Doppler stage before their cells are written.
///
/// Rows of a map lie a power of two apart, so cache lines in one column compete for a few cache sets. Writing whole rows, or long
/// pieces of them, is faster than writing columns.
const BINS_AT_ONCE: usize = 128;

/// Coefficients of bin `k` in terms of the FFT `Z` of `z[n] = x[2n] + j x[2n+1]`, of length `n`:
/// `2 X[k] = (Z[k] + Z*[n-k]) - j W (Z[k] - Z*[n-k])` with `W = exp(-j pi k / n) = cos - j sin`, hence
/// `2 Re X = (1 - sin) Re Z[k] + (1 + sin) Re Z[n-k] + cos (Im Z[k] + Im Z[n-k])` and
/// `2 Im X = (1 - sin) Im Z[k] - (1 + sin) Im Z[n-k] - cos (Re Z[k] - Re Z[n-k])`.
#[derive(Debug, Clone, Copy)]
struct Untangling {
    /// Position of `Z[k]`.
    direct: usize,
    /// Position of `Z[n-k]`.
    mirror: usize,
    one_minus_sin: f32,
    one_plus_sin: f32,
    cos: f32,
}

pub(super) struct Stages<const L: usize, V> {
    chirps: usize,
    samples: usize,
    range: usize,
    doppler: usize,
    /// Distance between tiles of `matrix`. It is not a power of two, so that tiles do not compete for the same cache
    /// sets.
    tile_length: usize,
    removes_chirp_mean: bool,
    removes_slow_time_mean: bool,
    /// Code of a sample of zero.
    zero_code: f32,
    /// Window, scale and the half of [`Untangling`] for even and odd sample; zero in the padding.
    code_gains: Vec<[f32; 2]>,
    sample_gains: Vec<[f32; 2]>,
    range_plan: Plan,
    untangling: Vec<Untangling>,
    doppler_window: Vec<f32>,
    doppler_plan: Plan,
    /// Doppler position of each row of the map.
    position_of_row: Vec<usize>,
    /// `L` chirps, `[pair]` of codes or `[sample]`.
    transposed: Vec<V>,
    buffer: Vec<Complex<V>>,
    /// Buffer of `L` bins of `L` chirps that are transposed into `matrix`. It is kept, so that it need not be set to zero each time.
    untangled: Vec<Complex<V>>,
    /// `[range / L][chirp]`, padded with zeros to the Doppler FFT and then to `tile_length`.
    matrix: Vec<Complex<V>>,
    /// `[bins at once / L][doppler position]`
    powers: Vec<V>,
}

impl<const L: usize, V: Vector<L>> Stages<L, V> {
    /// Creates the stages for sizes that [`LaneTransform::new`](super::LaneTransform::new) has checked.
    pub(super) fn new(plan: &MapPlan) -> Self {
        let (range, doppler) = (plan.shape.range, plan.shape.doppler);
        let gains = |factor: f64| {
            let gain = |n: usize| plan.range_window.get(n).map_or(0.0, |w| (0.5 * w * factor) as f32);
            (0..range).map(|pair| [gain(2 * pair), gain(2 * pair + 1)]).collect()
        };
        let range_plan = Plan::new(range);
        let position = range_plan.position_of_bin();
        let untangling = (0..range)
            .map(|k| {
                let (sin, cos) = (0.5 * TAU * k as f64 / range as f64).sin_cos();
                let scale = if k == 0 { plan.dc_amplitude } else { 1.0 };
                Untangling {
                    direct: position[k],
                    mirror: position[(range - k) % range],
                    one_minus_sin: (scale * (1.0 - sin)) as f32,
                    one_plus_sin: (scale * (1.0 + sin)) as f32,
                    cos: (scale * cos) as f32,
                }
            })
            .collect();
        let doppler_plan = Plan::new(doppler);
        // Zero Doppler in the middle.
        let mut position_of_row = doppler_plan.position_of_bin();
        position_of_row.rotate_left(doppler / 2);
        let mut doppler_window: Vec<f32> = plan.doppler_window.iter().map(|w| *w as f32).collect();
        doppler_window.resize(doppler, 0.0);
        let tile_length = doppler + L;
        let (factor, offset) = plan.scale;
        let zero = Complex { re: V::splat(0.0), im: V::splat(0.0) };
        Stages {
            chirps: plan.frame_shape.chirps,
            samples: plan.frame_shape.samples,
            range,
            doppler,
            tile_length,
            removes_chirp_mean: plan.removes_chirp_mean,
            removes_slow_time_mean: plan.removes_slow_time_mean,
            zero_code: (-offset / factor) as f32,
            code_gains: gains(factor),
            sample_gains: gains(1.0),
            range_plan,
            untangling,
            doppler_window,
            doppler_plan,
            position_of_row,
            transposed: vec![V::splat(0.0); 2 * range],
            buffer: vec![zero; range.max(doppler)],
            untangled: vec![zero; L],
            matrix: vec![zero; range / L * tile_length],
            powers: vec![V::splat(0.0); range.min(BINS_AT_ONCE) / L * doppler],
        }
    }

    /// Transforms one channel into `cells`, `[doppler][range]`. Returns whether all are finite.
    #[inline(always)]
    pub(super) fn transform_channel(&mut self, input: Input<'_>, output: Output, cells: &mut [f32]) -> bool {
        for first in (0..self.chirps).step_by(L) {
            match input {
                Input::Codes(codes) => {
                    let rows = &codes[first * self.samples..(first + L) * self.samples];
                    self.transform_codes(rows);
                }
                Input::Samples(samples) => {
                    let rows = &samples[first * self.samples..(first + L) * self.samples];
                    self.transform_samples(rows);
                }
            }
            self.untangle(first);
        }
        let mut is_finite = true;
        for first_bin in (0..self.range).step_by(BINS_AT_ONCE) {
            let is_group_finite = match self.removes_slow_time_mean {
                false => self.doppler_transforms::<false>(first_bin),
                true => self.doppler_transforms::<true>(first_bin),
            };
            self.write_rows(first_bin, output, is_group_finite, cells);
            is_finite &= is_group_finite;
        }
        is_finite
    }

    /// Computes the packed range FFT of `L` chirps of codes into `buffer`.
    #[inline(always)]
    fn transform_codes(&mut self, rows: &[u16]) {
        let samples = self.samples;
        let mut zero_code = V::splat(self.zero_code);
        if self.removes_chirp_mean {
            let mut means = [0.0; L];
            for (mean, row) in means.iter_mut().zip(rows.chunks_exact(samples)) {
                let sum: u32 = row.iter().map(|c| u32::from(*c)).sum();
                *mean = (f64::from(sum) / samples as f64) as f32;
            }
            zero_code = V::load(&means);
        }
        for (tile, target) in self.transposed[..samples / 2].as_chunks_mut::<L>().0.iter_mut().enumerate() {
            let mut block = [V::splat(0.0); L];
            for (i, row) in block.iter_mut().enumerate() {
                *row = V::load_code_pairs(&rows[i * samples + tile * 2 * L..]);
            }
            *target = V::transpose(block);
        }
        let source = CodeSource { pairs: &self.transposed[..self.range], gains: &self.code_gains, zero_code };
        self.range_plan.transform_into(&source, &mut self.buffer[..self.range]);
    }

    /// Computes the packed range FFT of `L` chirps of samples into `buffer`.
    #[inline(always)]
    fn transform_samples(&mut self, rows: &[f32]) {
        let samples = self.samples;
        for (tile, target) in self.transposed[..samples].as_chunks_mut::<L>().0.iter_mut().enumerate() {
            let mut block = [V::splat(0.0); L];
            for (i, row) in block.iter_mut().enumerate() {
                *row = V::load(&rows[i * samples + tile * L..]);
            }
            *target = V::transpose(block);
        }
        let source = SampleSource { samples: self.transposed.as_chunks::<2>().0, gains: &self.sample_gains };
        self.range_plan.transform_into(&source, &mut self.buffer[..self.range]);
    }

    /// Computes the spectra of real chirps from the packed ones in `buffer`, and transposes them into `matrix`.
    #[inline(always)]
    fn untangle(&mut self, first_chirp: usize) {
        let z = &self.buffer[..self.range];
        for (tile, bins) in self.untangling.as_chunks::<L>().0.iter().enumerate() {
            let start = tile * self.tile_length + first_chirp;
            let target = &mut self.matrix[start..start + L];
            let untangled = &mut self.untangled[..L];
            for i in 0..L {
                let bin = bins[i];
                let (direct, mirror) = (z[bin.direct], z[bin.mirror]);
                let (minus, plus) = (V::splat(bin.one_minus_sin), V::splat(bin.one_plus_sin));
                let cos = V::splat(bin.cos);
                untangled[i] = Complex {
                    re: direct.re.mul_add(minus, mirror.re.mul_add(plus, (direct.im + mirror.im) * cos)),
                    im: direct.im.mul_add(minus, mirror.im.neg_mul_add(plus, (mirror.re - direct.re) * cos)),
                };
            }
            let (mut re, mut im) = ([V::splat(0.0); L], [V::splat(0.0); L]);
            for i in 0..L {
                (re[i], im[i]) = (untangled[i].re, untangled[i].im);
            }
            let (re, im) = (V::transpose(re), V::transpose(im));
            for i in 0..L {
                target[i] = Complex { re: re[i], im: im[i] };
            }
        }
    }

    /// Applies static removal, window and Doppler FFT to the range bins from `first_bin` on, and computes their power. Returns
    /// whether all of it is finite.
    #[inline(always)]
    fn doppler_transforms<const REMOVES_MEAN: bool>(&mut self, first_bin: usize) -> bool {
        let buffer = &mut self.buffer[..self.doppler];
        let tiles = self.matrix.chunks_exact(self.tile_length).skip(first_bin / L);
        let mut total = V::splat(0.0);
        for (rows, powers) in tiles.zip(self.powers.chunks_exact_mut(self.doppler)) {
            let rows = &rows[..self.doppler];
            let mut mean = Complex { re: V::splat(0.0), im: V::splat(0.0) };
            if REMOVES_MEAN {
                // Four independent sums, because a single sum would wait for each addition.
                let mut sums = [mean; 4];
                for four in rows[..self.chirps].as_chunks::<4>().0 {
                    for (sum, x) in sums.iter_mut().zip(four) {
                        *sum = *sum + *x;
                    }
                }
                let sum = (sums[0] + sums[1]) + (sums[2] + sums[3]);
                let share = V::splat((1.0 / self.chirps as f64) as f32);
                mean = Complex { re: sum.re * share, im: sum.im * share };
            }
            let source = SlowTimeSource::<V, REMOVES_MEAN> { rows, window: &self.doppler_window[..self.doppler], mean };
            let mut sink = PowerSink { powers, total };
            self.doppler_plan.transform(&source, buffer, &mut sink);
            total = sink.total;
        }
        total.is_finite()
    }

    /// Writes `powers` into the rows of the map, from `first_bin` on.
    #[inline(always)]
    fn write_rows(&self, first_bin: usize, output: Output, is_finite: bool, cells: &mut [f32]) {
        match output {
            // The guarded logarithm below keeps NaN and infinity, and takes longer.
            Output::Decibels { floor_power } if is_finite => {
                let floor_power = V::splat(floor_power);
                self.write_cells(first_bin, cells, |power, _| power.finite_to_db(floor_power));
            }
            Output::Decibels { floor_power } => {
                let floor_power = V::splat(floor_power);
                self.write_cells(first_bin, cells, |power, _| power.to_db(floor_power));
            }
            Output::Power { adds: false } => self.write_cells(first_bin, cells, |power, _| power),
            Output::Power { adds: true } => self.write_cells(first_bin, cells, |power, before| power + V::load(before)),
        }
    }

    /// Writes what `cell` computes from the powers and the previous cells.
    #[inline(always)]
    fn write_cells(&self, first_bin: usize, cells: &mut [f32], cell: impl Fn(V, &[f32]) -> V) {
        for (row, position) in cells.chunks_exact_mut(self.range).zip(&self.position_of_row) {
            let powers = self.powers.chunks_exact(self.doppler);
            for (cells, powers) in row[first_bin..].chunks_exact_mut(L).zip(powers) {
                cell(powers[*position], cells).store(cells);
            }
        }
    }
}

/// Pairs of codes as complex numbers: even sample, odd sample.
struct CodeSource<'a, V> {
    pairs: &'a [V],
    gains: &'a [[f32; 2]],
    zero_code: V,
}

impl<const L: usize, V: Vector<L>> Source<L, V> for CodeSource<'_, V> {
    #[inline(always)]
    fn get(&self, index: usize) -> Complex<V> {
        let (even, odd) = self.pairs[index].split_code_pairs();
        let [even_gain, odd_gain] = self.gains[index];
        // Exact up to the product, unless chirp means are removed: codes and `zero_code` are small multiples of a half.
        Complex { re: (even - self.zero_code) * V::splat(even_gain), im: (odd - self.zero_code) * V::splat(odd_gain) }
    }
}

/// Pairs of samples as complex numbers: even sample, odd sample.
struct SampleSource<'a, V> {
    samples: &'a [[V; 2]],
    gains: &'a [[f32; 2]],
}

impl<const L: usize, V: Vector<L>> Source<L, V> for SampleSource<'_, V> {
    #[inline(always)]
    fn get(&self, index: usize) -> Complex<V> {
        let [even, odd] = self.samples[index];
        let [even_gain, odd_gain] = self.gains[index];
        Complex { re: even * V::splat(even_gain), im: odd * V::splat(odd_gain) }
    }
}

/// Slow time of `L` range bins under its window.
struct SlowTimeSource<'a, V, const REMOVES_MEAN: bool> {
    rows: &'a [Complex<V>],
    window: &'a [f32],
    mean: Complex<V>,
}

impl<const L: usize, V: Vector<L>, const REMOVES_MEAN: bool> Source<L, V> for SlowTimeSource<'_, V, REMOVES_MEAN> {
    #[inline(always)]
    fn get(&self, index: usize) -> Complex<V> {
        let mut x = self.rows[index];
        if REMOVES_MEAN {
            x = x - self.mean;
        }
        let weight = V::splat(self.window[index]);
        Complex { re: x.re * weight, im: x.im * weight }
    }
}

/// Power of the results, at the positions where the FFT leaves them.
struct PowerSink<'a, V> {
    powers: &'a mut [V],
    /// Sum of all powers: finite only if they are.
    total: V,
}

impl<const L: usize, V: Vector<L>> Sink<L, V> for PowerSink<'_, V> {
    #[inline(always)]
    fn put(&mut self, position: usize, value: Complex<V>) {
        let power = value.im.mul_add(value.im, value.re * value.re);
        self.total = self.total + power;
        self.powers[position] = power;
    }
}
