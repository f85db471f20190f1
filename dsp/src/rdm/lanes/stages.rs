//! Codes to power: the range stage and the Doppler stage of one channel.

use std::f64::consts::TAU;

use super::fft::{Complex, Plan, Sink, Source};
use super::vector::Vector;
use super::{Input, Output};
use crate::rdm::chain::ChainPlan;

/// How bin `k` follows from the FFT `Z` of `z[n] = x[2n] + j x[2n+1]`, of length `n`:
/// `2 X[k] = (Z[k] + Z*[n-k]) - j W (Z[k] - Z*[n-k])` with `W = exp(-j pi k / n) = cos - j sin`, hence
/// `2 Re X = (1 - sin) Re Z[k] + (1 + sin) Re Z[n-k] + cos (Im Z[k] + Im Z[n-k])` and
/// `2 Im X = (1 - sin) Im Z[k] - (1 + sin) Im Z[n-k] - cos (Re Z[k] - Re Z[n-k])`.
#[derive(Debug, Clone, Copy)]
struct Untangling {
    /// Position of `Z[k]`.
    own: usize,
    /// Position of `Z[n-k]`.
    mirror: usize,
    one_minus_sin: f32,
    one_plus_sin: f32,
    cos: f32,
}

/// Plans and buffers.
pub(super) struct Stages<const L: usize, V> {
    chirps: usize,
    samples: usize,
    range: usize,
    doppler: usize,
    /// From one tile of `matrix` to the next: no power of two, lest they all compete for the same cache sets.
    tile_length: usize,
    removes_chirp_mean: bool,
    removes_slow_time_mean: bool,
    /// The code that reads as zero.
    zero_code: f32,
    /// Window, scale and the half of [`Untangling`] for even and odd sample; zero in the padding.
    code_gains: Vec<[f32; 2]>,
    sample_gains: Vec<[f32; 2]>,
    range_plan: Plan,
    untangling: Vec<Untangling>,
    doppler_window: Vec<f32>,
    doppler_plan: Plan,
    /// First cell of the map's row in which each Doppler position belongs.
    row_start_of_position: Vec<usize>,
    /// `L` chirps, `[pair]` of codes or `[sample]`.
    transposed: Vec<V>,
    buffer: Vec<Complex<V>>,
    /// `[range / L][chirp]`, padded with zeros to the Doppler FFT and then to `tile_length`.
    matrix: Vec<Complex<V>>,
}

impl<const L: usize, V: Vector<L>> Stages<L, V> {
    /// For sizes that [`LaneChain::new`](super::LaneChain::new) has found to suit.
    pub(super) fn new(plan: &ChainPlan) -> Self {
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
                    own: position[k],
                    mirror: position[(range - k) % range],
                    one_minus_sin: (scale * (1.0 - sin)) as f32,
                    one_plus_sin: (scale * (1.0 + sin)) as f32,
                    cos: (scale * cos) as f32,
                }
            })
            .collect();
        let doppler_plan = Plan::new(doppler);
        let mut row_start_of_position = vec![0; doppler];
        for (bin, position) in doppler_plan.position_of_bin().into_iter().enumerate() {
            row_start_of_position[position] = (bin + doppler / 2) % doppler * range;
        }
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
            row_start_of_position,
            transposed: vec![V::splat(0.0); 2 * range],
            buffer: vec![zero; range.max(doppler)],
            matrix: vec![zero; range / L * tile_length],
        }
    }

    /// One channel into `cells` (`[doppler][range]`); whether all are finite.
    #[inline(always)]
    pub(super) fn channel(&mut self, input: Input<'_>, output: Output, cells: &mut [f32]) -> bool {
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
        for tile in 0..self.range / L {
            is_finite &= match self.removes_slow_time_mean {
                false => self.doppler_transform::<false>(tile, output, cells),
                true => self.doppler_transform::<true>(tile, output, cells),
            };
        }
        is_finite
    }

    /// Packed range FFT of `L` chirps into `buffer`.
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

    /// The same for samples.
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

    /// Spectra of real chirps from the packed ones in `buffer`, transposed into `matrix`.
    #[inline(always)]
    fn untangle(&mut self, first_chirp: usize) {
        let z = &self.buffer[..self.range];
        for (tile, bins) in self.untangling.as_chunks::<L>().0.iter().enumerate() {
            let start = tile * self.tile_length + first_chirp;
            let target = &mut self.matrix[start..start + L];
            let (mut re, mut im) = ([V::splat(0.0); L], [V::splat(0.0); L]);
            for i in 0..L {
                let bin = bins[i];
                let (own, mirror) = (z[bin.own], z[bin.mirror]);
                let (minus, plus) = (V::splat(bin.one_minus_sin), V::splat(bin.one_plus_sin));
                let cos = V::splat(bin.cos);
                re[i] = own.re.mul_add(minus, mirror.re.mul_add(plus, (own.im + mirror.im) * cos));
                im[i] = own.im.mul_add(minus, mirror.im.neg_mul_add(plus, (mirror.re - own.re) * cos));
            }
            let (re, im) = (V::transpose(re), V::transpose(im));
            for i in 0..L {
                target[i] = Complex { re: re[i], im: im[i] };
            }
        }
    }

    /// Static removal, window, Doppler FFT and power of `L` range bins; whether all of it is finite.
    #[inline(always)]
    fn doppler_transform<const REMOVES_MEAN: bool>(&mut self, tile: usize, output: Output, cells: &mut [f32]) -> bool {
        let rows = &self.matrix[tile * self.tile_length..tile * self.tile_length + self.doppler];
        let mut mean = Complex { re: V::splat(0.0), im: V::splat(0.0) };
        if REMOVES_MEAN {
            // Four sums at a time: one would wait for each addition.
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
        let (row_starts, buffer) = (&self.row_start_of_position[..], &mut self.buffer[..self.doppler]);
        let (first_bin, total) = (tile * L, V::splat(0.0));
        match output {
            Output::Decibels { floor_power } => {
                let floor_power = V::splat(floor_power);
                let mut sink = DecibelSink::<V, false> { row_starts, cells, first_bin, floor_power, total };
                self.doppler_plan.transform(&source, buffer, &mut sink);
                let is_finite = sink.total.is_finite();
                if !is_finite {
                    // What is no number has been made one: once more, with a look at each.
                    let mut sink = DecibelSink::<V, true> { row_starts, cells, first_bin, floor_power, total };
                    self.doppler_plan.transform(&source, buffer, &mut sink);
                }
                is_finite
            }
            Output::Power { adds } => {
                let mut sink = PowerSink { row_starts, cells, first_bin, adds, total };
                self.doppler_plan.transform(&source, buffer, &mut sink);
                sink.total.is_finite()
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
        // Exact until the product: codes and their zero are small multiples of a half.
        Complex { re: (even - self.zero_code) * V::splat(even_gain), im: (odd - self.zero_code) * V::splat(odd_gain) }
    }
}

/// Pairs of samples.
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

#[inline(always)]
fn power<const L: usize, V: Vector<L>>(x: Complex<V>) -> V {
    x.im.mul_add(x.im, x.re * x.re)
}

/// Decibels into the rows of the map, zero Doppler in the middle; what is not finite stays so if it guards.
struct DecibelSink<'a, V, const GUARDS: bool> {
    row_starts: &'a [usize],
    cells: &'a mut [f32],
    first_bin: usize,
    floor_power: V,
    /// Sum of all powers: finite only if they are.
    total: V,
}

impl<const L: usize, V: Vector<L>, const GUARDS: bool> Sink<L, V> for DecibelSink<'_, V, GUARDS> {
    #[inline(always)]
    fn put(&mut self, position: usize, value: Complex<V>) {
        let start = self.row_starts[position] + self.first_bin;
        let power = power(value);
        self.total = self.total + power;
        let db = if GUARDS { power.to_db(self.floor_power) } else { power.finite_to_db(self.floor_power) };
        db.store(&mut self.cells[start..start + L]);
    }
}

/// Power into the rows of the map, or added to what is there.
struct PowerSink<'a, V> {
    row_starts: &'a [usize],
    cells: &'a mut [f32],
    first_bin: usize,
    adds: bool,
    total: V,
}

impl<const L: usize, V: Vector<L>> Sink<L, V> for PowerSink<'_, V> {
    #[inline(always)]
    fn put(&mut self, position: usize, value: Complex<V>) {
        let start = self.row_starts[position] + self.first_bin;
        let cells = &mut self.cells[start..start + L];
        let power = power(value);
        self.total = self.total + power;
        if self.adds { power + V::load(cells) } else { power }.store(cells);
    }
}
