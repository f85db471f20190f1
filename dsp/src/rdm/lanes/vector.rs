//! Vector of `f32` in which each lane belongs to another transform. The stages are generic over it.

use std::ops::{Add, Mul, Sub};

use crate::decibel::{self, SQRT_HALF_BITS};

/// Vector of `L` numbers.
///
/// Some implementations need registers that not every processor has. Use them only inside functions that are entered
/// after a check of [`KernelLevel::is_available`](crate::KernelLevel::is_available). Only `LaneTransform::transform_channel` of
/// the parent module does so. Every method is inlined into such a function, and so becomes one instruction.
pub(super) trait Vector<const L: usize>:
    Copy + Send + Sync + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self>
{
    /// Returns a vector with the same number in all lanes.
    fn splat(x: f32) -> Self;
    /// Loads the first `L` numbers of a slice.
    fn load(x: &[f32]) -> Self;
    /// Stores the lanes into the first `L` numbers of a slice.
    fn store(self, x: &mut [f32]);
    /// Loads the bits of `2 L` codes, two neighbours in each lane.
    fn load_code_pairs(codes: &[u16]) -> Self;
    /// Converts the two codes of each lane to numbers, the first ones in the first vector.
    fn split_code_pairs(self) -> (Self, Self);
    /// `self * a + b`.
    fn mul_add(self, a: Self, b: Self) -> Self;
    /// `b - self * a`.
    fn neg_mul_add(self, a: Self, b: Self) -> Self;
    /// Returns the larger of `self` and `floor`; NaN stays.
    fn at_least(self, floor: Self) -> Self;
    /// `(e, m)` with `self = m 2^e` and `m` in [sqrt(1/2), sqrt(2)), for positive normal numbers.
    fn split_binade(self) -> (Self, Self);
    /// Returns `self`, but `original` where `original` is NaN or infinite.
    fn unless_non_finite(self, original: Self) -> Self;
    /// Returns whether all lanes are finite, for numbers that are not negative.
    fn is_finite(self) -> bool;
    /// Transposes: lane `i` of vector `j` becomes lane `j` of vector `i`.
    fn transpose(tile: [Self; L]) -> [Self; L];

    /// Converts power to decibels, as [`decibel::power_to_db`] does.
    #[inline(always)]
    fn to_db(self, floor_power: Self) -> Self {
        self.finite_to_db(floor_power).unless_non_finite(self.at_least(floor_power))
    }

    /// Converts finite power to decibels. Results for NaN and infinity are arbitrary numbers.
    #[inline(always)]
    fn finite_to_db(self, floor_power: Self) -> Self {
        let clamped = self.at_least(floor_power);
        let (exponent, mantissa) = clamped.split_binade();
        let t = mantissa - Self::splat(1.0);
        let [a, b, c, d, e, f, g] = decibel::LOG2_POLYNOMIAL;
        let mut sum = Self::splat(g);
        for coefficient in [f, e, d, c, b, a] {
            sum = sum.mul_add(t, Self::splat(coefficient));
        }
        sum.mul_add(t, exponent) * Self::splat(decibel::DB_PER_OCTAVE)
    }
}

/// Four scalars, for processors without a level of their own. Compilers put them into one register where they can.
#[derive(Debug, Clone, Copy)]
#[repr(align(16))]
pub(super) struct Plain([f32; 4]);

impl Plain {
    #[inline(always)]
    fn zip(self, other: Self, f: impl Fn(f32, f32) -> f32) -> Self {
        let ([a, b, c, d], [e, g, h, i]) = (self.0, other.0);
        Plain([f(a, e), f(b, g), f(c, h), f(d, i)])
    }
}

impl Add for Plain {
    type Output = Self;
    #[inline(always)]
    fn add(self, other: Self) -> Self {
        self.zip(other, |a, b| a + b)
    }
}

impl Sub for Plain {
    type Output = Self;
    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        self.zip(other, |a, b| a - b)
    }
}

impl Mul for Plain {
    type Output = Self;
    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        self.zip(other, |a, b| a * b)
    }
}

impl Vector<4> for Plain {
    #[inline(always)]
    fn splat(x: f32) -> Self {
        Plain([x; 4])
    }
    #[inline(always)]
    fn load(x: &[f32]) -> Self {
        Plain([x[0], x[1], x[2], x[3]])
    }
    #[inline(always)]
    fn store(self, x: &mut [f32]) {
        x[..4].copy_from_slice(&self.0);
    }
    #[inline(always)]
    fn load_code_pairs(codes: &[u16]) -> Self {
        let c = &codes[..8];
        let pair = |i: usize| f32::from_bits(u32::from(c[2 * i]) | u32::from(c[2 * i + 1]) << 16);
        Plain([pair(0), pair(1), pair(2), pair(3)])
    }
    #[inline(always)]
    fn split_code_pairs(self) -> (Self, Self) {
        let bits = self.0.map(f32::to_bits);
        (Plain(bits.map(|b| (b & 0xffff) as i32 as f32)), Plain(bits.map(|b| (b >> 16) as i32 as f32)))
    }
    #[inline(always)]
    fn mul_add(self, a: Self, b: Self) -> Self {
        self * a + b
    }
    #[inline(always)]
    fn neg_mul_add(self, a: Self, b: Self) -> Self {
        b - self * a
    }
    #[inline(always)]
    fn at_least(self, floor: Self) -> Self {
        self.zip(floor, |x, floor| if x < floor { floor } else { x })
    }
    #[inline(always)]
    fn split_binade(self) -> (Self, Self) {
        let bits = self.0.map(|x| x.to_bits() as i32);
        let exponent = bits.map(|b| (b - SQRT_HALF_BITS) >> 23);
        let mantissa = std::array::from_fn(|i| f32::from_bits((bits[i] - (exponent[i] << 23)) as u32));
        (Plain(exponent.map(|e| e as f32)), Plain(mantissa))
    }
    #[inline(always)]
    fn unless_non_finite(self, original: Self) -> Self {
        self.zip(original, |x, original| if original < f32::INFINITY { x } else { original })
    }
    #[inline(always)]
    fn is_finite(self) -> bool {
        self.0.iter().all(|x| *x < f32::INFINITY)
    }
    #[inline(always)]
    fn transpose(tile: [Self; 4]) -> [Self; 4] {
        let [a, b, c, d] = tile.map(|v| v.0);
        [
            Plain([a[0], b[0], c[0], d[0]]),
            Plain([a[1], b[1], c[1], d[1]]),
            Plain([a[2], b[2], c[2], d[2]]),
            Plain([a[3], b[3], c[3], d[3]]),
        ]
    }
}
