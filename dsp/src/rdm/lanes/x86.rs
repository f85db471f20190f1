//! Vectors of AVX2 and AVX-512.
//!
//! Every `unsafe` here relies on the same two facts. The instruction exists: the types are private to the lane transform, which
//! is created only for a level that is available. Memory is in bounds: loads and stores are made through slices whose length is
//! checked first.

use std::arch::x86_64::*;
use std::ops::{Add, Mul, Sub};

use super::vector::Vector;
use crate::decibel::SQRT_HALF_BITS;

/// Eight lanes of AVX2 with FMA.
#[derive(Debug, Clone, Copy)]
pub(super) struct F32x8(__m256);

/// Sixteen lanes of AVX-512.
#[derive(Debug, Clone, Copy)]
pub(super) struct F32x16(__m512);

macro_rules! operator {
    ($type:ident, $trait:ident, $method:ident, $instruction:ident) => {
        impl $trait for $type {
            type Output = Self;
            #[inline(always)]
            fn $method(self, other: Self) -> Self {
                // SAFETY: the processor has the instruction (module page).
                $type(unsafe { $instruction(self.0, other.0) })
            }
        }
    };
}
operator!(F32x8, Add, add, _mm256_add_ps);
operator!(F32x8, Sub, sub, _mm256_sub_ps);
operator!(F32x8, Mul, mul, _mm256_mul_ps);
operator!(F32x16, Add, add, _mm512_add_ps);
operator!(F32x16, Sub, sub, _mm512_sub_ps);
operator!(F32x16, Mul, mul, _mm512_mul_ps);

/// Methods that are one instruction of the same kind for both widths.
macro_rules! methods {
    (
        $type:ident, $lanes:literal,
        $splat:ident, $load:ident, $store:ident, $mul_add:ident, $neg_mul_add:ident, $max:ident
    ) => {
        #[inline(always)]
        fn splat(x: f32) -> Self {
            // SAFETY: module page.
            $type(unsafe { $splat(x) })
        }
        #[inline(always)]
        fn load(x: &[f32]) -> Self {
            let x = &x[..$lanes];
            // SAFETY: module page; a number for each lane is there.
            $type(unsafe { $load(x.as_ptr()) })
        }
        #[inline(always)]
        fn store(self, x: &mut [f32]) {
            let x = &mut x[..$lanes];
            // SAFETY: module page; room for a number of each lane is there.
            unsafe { $store(x.as_mut_ptr(), self.0) }
        }
        #[inline(always)]
        fn load_code_pairs(codes: &[u16]) -> Self {
            let codes = &codes[..2 * $lanes];
            // SAFETY: module page; two codes of two bytes for each lane are there, and the load asks for no alignment.
            $type(unsafe { $load(codes.as_ptr().cast()) })
        }
        #[inline(always)]
        fn mul_add(self, a: Self, b: Self) -> Self {
            // SAFETY: module page.
            $type(unsafe { $mul_add(self.0, a.0, b.0) })
        }
        #[inline(always)]
        fn neg_mul_add(self, a: Self, b: Self) -> Self {
            // SAFETY: module page.
            $type(unsafe { $neg_mul_add(self.0, a.0, b.0) })
        }
        #[inline(always)]
        fn at_least(self, floor: Self) -> Self {
            // SAFETY: module page. The instruction returns its second operand if either is NaN.
            $type(unsafe { $max(floor.0, self.0) })
        }
    };
}

impl Vector<8> for F32x8 {
    methods! {
        F32x8, 8,
        _mm256_set1_ps, _mm256_loadu_ps, _mm256_storeu_ps, _mm256_fmadd_ps, _mm256_fnmadd_ps, _mm256_max_ps
    }
    #[inline(always)]
    fn split_code_pairs(self) -> (Self, Self) {
        // SAFETY: module page.
        unsafe {
            let bits = _mm256_castps_si256(self.0);
            let first = _mm256_blend_epi16::<0b1010_1010>(bits, _mm256_setzero_si256());
            let second = _mm256_srli_epi32::<16>(bits);
            (F32x8(_mm256_cvtepi32_ps(first)), F32x8(_mm256_cvtepi32_ps(second)))
        }
    }
    #[inline(always)]
    fn split_binade(self) -> (Self, Self) {
        // SAFETY: module page.
        unsafe {
            let bits = _mm256_castps_si256(self.0);
            let exponent = _mm256_srai_epi32::<23>(_mm256_sub_epi32(bits, _mm256_set1_epi32(SQRT_HALF_BITS)));
            let mantissa = _mm256_sub_epi32(bits, _mm256_slli_epi32::<23>(exponent));
            (F32x8(_mm256_cvtepi32_ps(exponent)), F32x8(_mm256_castsi256_ps(mantissa)))
        }
    }
    #[inline(always)]
    fn unless_non_finite(self, original: Self) -> Self {
        // SAFETY: module page.
        unsafe {
            let is_finite = _mm256_cmp_ps::<_CMP_LT_OQ>(original.0, _mm256_set1_ps(f32::INFINITY));
            F32x8(_mm256_blendv_ps(original.0, self.0, is_finite))
        }
    }
    #[inline(always)]
    fn is_finite(self) -> bool {
        // SAFETY: module page.
        unsafe { _mm256_movemask_ps(_mm256_cmp_ps::<_CMP_LT_OQ>(self.0, _mm256_set1_ps(f32::INFINITY))) == 0xff }
    }
    #[inline(always)]
    fn transpose(tile: [Self; 8]) -> [Self; 8] {
        let zero = Self::splat(0.0);
        let (mut pairs, mut quads, mut out) = ([zero; 8], [zero; 8], [zero; 8]);
        // SAFETY: module page.
        unsafe {
            for i in 0..4 {
                // Rows 2i and 2i+1 interleaved: columns 0, 1 of each half, then 2, 3.
                pairs[2 * i] = F32x8(_mm256_unpacklo_ps(tile[2 * i].0, tile[2 * i + 1].0));
                pairs[2 * i + 1] = F32x8(_mm256_unpackhi_ps(tile[2 * i].0, tile[2 * i + 1].0));
            }
            for i in 0..2 {
                for c in 0..2 {
                    // Rows 4i..4i+4 of columns 2c and 2c+1.
                    let (a, b) = (pairs[4 * i + c].0, pairs[4 * i + 2 + c].0);
                    quads[4 * i + 2 * c] = F32x8(_mm256_shuffle_ps::<0b01_00_01_00>(a, b));
                    quads[4 * i + 2 * c + 1] = F32x8(_mm256_shuffle_ps::<0b11_10_11_10>(a, b));
                }
            }
            for c in 0..4 {
                out[c] = F32x8(_mm256_permute2f128_ps::<0x20>(quads[c].0, quads[4 + c].0));
                out[4 + c] = F32x8(_mm256_permute2f128_ps::<0x31>(quads[c].0, quads[4 + c].0));
            }
        }
        out
    }
}

impl Vector<16> for F32x16 {
    methods! {
        F32x16, 16,
        _mm512_set1_ps, _mm512_loadu_ps, _mm512_storeu_ps, _mm512_fmadd_ps, _mm512_fnmadd_ps, _mm512_max_ps
    }
    #[inline(always)]
    fn split_code_pairs(self) -> (Self, Self) {
        // SAFETY: module page.
        unsafe {
            let bits = _mm512_castps_si512(self.0);
            let first = _mm512_and_si512(bits, _mm512_set1_epi32(0xffff));
            let second = _mm512_srli_epi32::<16>(bits);
            (F32x16(_mm512_cvtepi32_ps(first)), F32x16(_mm512_cvtepi32_ps(second)))
        }
    }
    #[inline(always)]
    fn split_binade(self) -> (Self, Self) {
        // SAFETY: module page.
        unsafe {
            let bits = _mm512_castps_si512(self.0);
            let exponent = _mm512_srai_epi32::<23>(_mm512_sub_epi32(bits, _mm512_set1_epi32(SQRT_HALF_BITS)));
            let mantissa = _mm512_sub_epi32(bits, _mm512_slli_epi32::<23>(exponent));
            (F32x16(_mm512_cvtepi32_ps(exponent)), F32x16(_mm512_castsi512_ps(mantissa)))
        }
    }
    #[inline(always)]
    fn unless_non_finite(self, original: Self) -> Self {
        // SAFETY: module page.
        unsafe {
            let is_finite = _mm512_cmp_ps_mask::<_CMP_LT_OQ>(original.0, _mm512_set1_ps(f32::INFINITY));
            F32x16(_mm512_mask_blend_ps(is_finite, original.0, self.0))
        }
    }
    #[inline(always)]
    fn is_finite(self) -> bool {
        // SAFETY: module page.
        unsafe { _mm512_cmp_ps_mask::<_CMP_LT_OQ>(self.0, _mm512_set1_ps(f32::INFINITY)) == 0xffff }
    }
    #[inline(always)]
    fn transpose(tile: [Self; 16]) -> [Self; 16] {
        let zero = Self::splat(0.0);
        let (mut pairs, mut quads, mut out) = ([zero; 16], [zero; 16], [zero; 16]);
        // SAFETY: module page.
        unsafe {
            for i in 0..8 {
                pairs[2 * i] = F32x16(_mm512_unpacklo_ps(tile[2 * i].0, tile[2 * i + 1].0));
                pairs[2 * i + 1] = F32x16(_mm512_unpackhi_ps(tile[2 * i].0, tile[2 * i + 1].0));
            }
            for i in 0..4 {
                for c in 0..2 {
                    let (a, b) = (pairs[4 * i + c].0, pairs[4 * i + 2 + c].0);
                    quads[4 * i + 2 * c] = F32x16(_mm512_shuffle_ps::<0b01_00_01_00>(a, b));
                    quads[4 * i + 2 * c + 1] = F32x16(_mm512_shuffle_ps::<0b11_10_11_10>(a, b));
                }
            }
            // quads[4i + c]: rows 4i..4i+4 of columns c, c+4, c+8, c+12, one in each quarter. Transpose the quarters.
            for c in 0..4 {
                let [a, b, d, e] = [quads[c].0, quads[4 + c].0, quads[8 + c].0, quads[12 + c].0];
                let (low_ab, high_ab) =
                    (_mm512_shuffle_f32x4::<0b01_00_01_00>(a, b), _mm512_shuffle_f32x4::<0b11_10_11_10>(a, b));
                let (low_de, high_de) =
                    (_mm512_shuffle_f32x4::<0b01_00_01_00>(d, e), _mm512_shuffle_f32x4::<0b11_10_11_10>(d, e));
                out[c] = F32x16(_mm512_shuffle_f32x4::<0b10_00_10_00>(low_ab, low_de));
                out[4 + c] = F32x16(_mm512_shuffle_f32x4::<0b11_01_11_01>(low_ab, low_de));
                out[8 + c] = F32x16(_mm512_shuffle_f32x4::<0b10_00_10_00>(high_ab, high_de));
                out[12 + c] = F32x16(_mm512_shuffle_f32x4::<0b11_01_11_01>(high_ab, high_de));
            }
        }
        out
    }
}
