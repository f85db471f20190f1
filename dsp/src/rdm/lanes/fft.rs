//! Complex FFT of power-of-two length over vectors of lanes: decimation in frequency, radix 8 and 4, in place.
//!
//! Gentleman and Sande, "Fast Fourier Transforms: for fun and profit", AFIPS 29, 1966. Every lane is a transform of
//! its own, so an element is a whole register, order in memory costs nothing, and results are left in
//! digit-reversed order ([`Plan::position_of_bin`]).

use std::f64::consts::{FRAC_1_SQRT_2, TAU};
use std::ops::{Add, Sub};

use super::vector::Vector;

/// A complex number in each lane.
#[derive(Debug, Clone, Copy)]
pub(super) struct Complex<V> {
    pub re: V,
    pub im: V,
}

impl<V: Add<Output = V>> Add for Complex<V> {
    type Output = Self;
    #[inline(always)]
    fn add(self, other: Self) -> Self {
        Complex { re: self.re + other.re, im: self.im + other.im }
    }
}

impl<V: Sub<Output = V>> Sub for Complex<V> {
    type Output = Self;
    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        Complex { re: self.re - other.re, im: self.im - other.im }
    }
}

/// `(a + j b, a - j b)`. The multiplication by j swaps real and imaginary part and changes one sign, so it needs no operation.
#[inline(always)]
fn plus_minus_j<V: Copy + Add<Output = V> + Sub<Output = V>>(a: Complex<V>, b: Complex<V>) -> (Complex<V>, Complex<V>) {
    (Complex { re: a.re - b.im, im: a.im + b.re }, Complex { re: a.re + b.im, im: a.im - b.re })
}

/// `x (cos + j sin)`.
#[inline(always)]
fn rotate<const L: usize, V: Vector<L>>(x: Complex<V>, (cos, sin): (f32, f32)) -> Complex<V> {
    let (c, s) = (V::splat(cos), V::splat(sin));
    Complex { re: x.im.neg_mul_add(s, x.re * c), im: x.re.mul_add(s, x.im * c) }
}

#[inline(always)]
fn butterfly_4<const L: usize, V: Vector<L>>(x: [Complex<V>; 4]) -> [Complex<V>; 4] {
    let (a, b) = (x[0] + x[2], x[0] - x[2]);
    let (c, d) = (x[1] + x[3], x[1] - x[3]);
    let (plus, minus) = plus_minus_j(b, d);
    [a + c, minus, a - c, plus]
}

#[inline(always)]
fn butterfly_8<const L: usize, V: Vector<L>>(x: [Complex<V>; 8]) -> [Complex<V>; 8] {
    let even = butterfly_4([x[0] + x[4], x[1] + x[5], x[2] + x[6], x[3] + x[7]]);
    let [a, b, c, d] = [x[0] - x[4], x[1] - x[5], x[2] - x[6], x[3] - x[7]];
    // Rows 1 and 3 turn by -45 and -135 degrees, row 2 by -90.
    let (half, minus_half) = (V::splat(FRAC_1_SQRT_2 as f32), V::splat(-FRAC_1_SQRT_2 as f32));
    let b = Complex { re: (b.re + b.im) * half, im: (b.im - b.re) * half };
    let d = Complex { re: (d.im - d.re) * half, im: (d.re + d.im) * minus_half };
    let (a_plus, a_minus) = plus_minus_j(a, c);
    let sum = b + d;
    let (plus, minus) = plus_minus_j(a_plus, b - d);
    [even[0], a_minus + sum, even[1], minus, even[2], a_minus - sum, even[3], plus]
}

pub(super) trait Source<const L: usize, V: Vector<L>> {
    fn get(&self, index: usize) -> Complex<V>;
}

pub(super) trait Sink<const L: usize, V: Vector<L>> {
    fn put(&mut self, position: usize, value: Complex<V>);
}

/// One pass: all butterflies of one radix.
#[derive(Debug, Clone)]
enum Pass {
    Radix4(Vec<[(f32, f32); 4]>),
    Radix8(Vec<[(f32, f32); 8]>),
}

/// Radices and twiddle factors of a length.
#[derive(Debug, Clone)]
pub(super) struct Plan {
    length: usize,
    /// All passes but the last, which has no twiddle factors.
    passes: Vec<Pass>,
    last_radix: usize,
}

impl Plan {
    /// Creates the plan for a power of two of 16 and above, with as few passes as radices 8 and 4 allow.
    pub(super) fn new(length: usize) -> Self {
        // Radix 4 first: it leaves registers free for the source, and the last pass has no twiddle factors to wait for.
        let mut radices = match length.trailing_zeros() as usize {
            log2 if log2 % 3 == 0 => vec![8; log2 / 3],
            log2 if log2 % 3 == 2 => [vec![4], vec![8; log2 / 3]].concat(),
            log2 => [vec![4, 4], vec![8; log2 / 3 - 1]].concat(),
        };
        let last_radix = radices.pop().unwrap_or(4);
        let mut block = length;
        let passes = radices
            .into_iter()
            .map(|radix| {
                let columns = block / radix;
                let factor = |column: usize, row: usize| {
                    let angle = -TAU * (column * row) as f64 / block as f64;
                    (angle.cos() as f32, angle.sin() as f32)
                };
                let pass = if radix == 4 {
                    Pass::Radix4((0..columns).map(|c| std::array::from_fn(|r| factor(c, r))).collect())
                } else {
                    Pass::Radix8((0..columns).map(|c| std::array::from_fn(|r| factor(c, r))).collect())
                };
                block = columns;
                pass
            })
            .collect();
        Plan { length, passes, last_radix }
    }

    /// Position at which a transform leaves each bin.
    pub(super) fn position_of_bin(&self) -> Vec<usize> {
        let radices = self.passes.iter().map(|pass| match pass {
            Pass::Radix4(_) => 4,
            Pass::Radix8(_) => 8,
        });
        let radices: Vec<usize> = radices.chain([self.last_radix]).collect();
        (0..self.length)
            .map(|bin| {
                let (mut rest, mut block, mut position) = (bin, self.length, 0);
                for radix in &radices {
                    block /= radix;
                    position += rest % radix * block;
                    rest /= radix;
                }
                position
            })
            .collect()
    }

    /// Transforms `source` by way of `buffer` (of the plan's length) into `sink`.
    #[inline(always)]
    pub(super) fn transform<const L: usize, V: Vector<L>>(
        &self,
        source: &impl Source<L, V>,
        buffer: &mut [Complex<V>],
        sink: &mut impl Sink<L, V>,
    ) {
        self.all_passes_but_last(source, buffer);
        match self.last_radix {
            4 => last_pass_4(buffer, sink),
            _ => last_pass_8(buffer, sink),
        }
    }

    /// Transforms `source` into `buffer` (of the plan's length).
    #[inline(always)]
    pub(super) fn transform_into<const L: usize, V: Vector<L>>(
        &self,
        source: &impl Source<L, V>,
        buffer: &mut [Complex<V>],
    ) {
        self.all_passes_but_last(source, buffer);
        match self.last_radix {
            4 => {
                for block in buffer.as_chunks_mut::<4>().0 {
                    *block = butterfly_4(*block);
                }
            }
            _ => {
                for block in buffer.as_chunks_mut::<8>().0 {
                    *block = butterfly_8(*block);
                }
            }
        }
    }

    #[inline(always)]
    fn all_passes_but_last<const L: usize, V: Vector<L>>(&self, source: &impl Source<L, V>, buffer: &mut [Complex<V>]) {
        let mut passes = self.passes.iter();
        match passes.next() {
            Some(Pass::Radix4(twiddles)) => first_pass_4(twiddles, source, buffer),
            Some(Pass::Radix8(twiddles)) => first_pass_8(twiddles, source, buffer),
            None => {}
        }
        for pass in passes {
            match pass {
                Pass::Radix4(twiddles) => middle_pass_4(twiddles, buffer),
                Pass::Radix8(twiddles) => middle_pass_8(twiddles, buffer),
            }
        }
    }
}

macro_rules! passes {
    ($radix:literal, $butterfly:ident, $first:ident, $middle:ident, $last:ident) => {
        #[inline(always)]
        fn $first<const L: usize, V: Vector<L>>(
            twiddles: &[[(f32, f32); $radix]],
            source: &impl Source<L, V>,
            buffer: &mut [Complex<V>],
        ) {
            let columns = twiddles.len();
            let buffer = &mut buffer[..$radix * columns];
            for (column, twiddle) in twiddles.iter().enumerate() {
                let mut x = [source.get(column); $radix];
                for row in 1..$radix {
                    x[row] = source.get(column + row * columns);
                }
                let y = $butterfly(x);
                buffer[column] = y[0];
                for row in 1..$radix {
                    buffer[column + row * columns] = rotate(y[row], twiddle[row]);
                }
            }
        }

        #[inline(always)]
        fn $middle<const L: usize, V: Vector<L>>(twiddles: &[[(f32, f32); $radix]], buffer: &mut [Complex<V>]) {
            let columns = twiddles.len();
            for block in buffer.chunks_exact_mut($radix * columns) {
                for (column, twiddle) in twiddles.iter().enumerate() {
                    let mut x = [block[column]; $radix];
                    for row in 1..$radix {
                        x[row] = block[column + row * columns];
                    }
                    let y = $butterfly(x);
                    block[column] = y[0];
                    for row in 1..$radix {
                        block[column + row * columns] = rotate(y[row], twiddle[row]);
                    }
                }
            }
        }

        #[inline(always)]
        fn $last<const L: usize, V: Vector<L>>(buffer: &[Complex<V>], sink: &mut impl Sink<L, V>) {
            for (i, block) in buffer.as_chunks::<$radix>().0.iter().enumerate() {
                let y = $butterfly(*block);
                for row in 0..$radix {
                    sink.put($radix * i + row, y[row]);
                }
            }
        }
    };
}
passes!(4, butterfly_4, first_pass_4, middle_pass_4, last_pass_4);
passes!(8, butterfly_8, first_pass_8, middle_pass_8, last_pass_8);

#[cfg(test)]
mod tests {
    use super::super::vector::Plain;
    use super::*;

    struct Tones(Vec<Complex<Plain>>);
    impl Source<4, Plain> for Tones {
        fn get(&self, index: usize) -> Complex<Plain> {
            self.0[index]
        }
    }
    struct Collected(Vec<Complex<Plain>>);
    impl Sink<4, Plain> for Collected {
        fn put(&mut self, position: usize, value: Complex<Plain>) {
            self.0[position] = value;
        }
    }

    /// A tone on a bin gives the length of the FFT in this bin and nothing in others, separately in every lane, at every length.
    #[test]
    fn each_lane_finds_its_own_tone() {
        for length in [16, 32, 64, 128, 256, 512, 1024] {
            let plan = Plan::new(length);
            let bins = [0, 1, length / 2 + 3, length - 1];
            let lanes = |part: fn(f64) -> f64, n: usize| {
                let values = bins.map(|bin| part(TAU * (bin * n % length) as f64 / length as f64) as f32);
                Plain::load(&values)
            };
            let tones =
                Tones((0..length).map(|n| Complex { re: lanes(f64::cos, n), im: lanes(f64::sin, n) }).collect());
            let zero = Complex { re: Plain::splat(0.0), im: Plain::splat(0.0) };
            let (mut buffer, mut out) = (vec![zero; length], Collected(vec![zero; length]));
            plan.transform(&tones, &mut buffer, &mut out);
            plan.transform_into(&tones, &mut buffer);
            let position = plan.position_of_bin();
            for k in 0..length {
                for result in [out.0[position[k]], buffer[position[k]]] {
                    let (mut re, mut im) = ([0.0; 4], [0.0; 4]);
                    result.re.store(&mut re);
                    result.im.store(&mut im);
                    for lane in 0..4 {
                        let expected = if bins[lane] == k { length as f32 } else { 0.0 };
                        let error = (re[lane] - expected).hypot(im[lane]);
                        assert!(error < 2e-6 * length as f32, "{error} in bin {k} of {length}, lane {lane}");
                    }
                }
            }
        }
    }
}
