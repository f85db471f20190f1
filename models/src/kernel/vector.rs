//! Vector registers of each kernel level.

/// Vector of f32 with the operations of the inner loops.
///
/// # Safety
/// All methods: the processor has the instructions of the implementing type, and pointers are valid for the lanes that
/// are touched.
#[allow(clippy::missing_safety_doc)]
pub(crate) trait Vector: Copy {
    /// Number of values in a vector.
    const LANES: usize;
    /// Rows of a tile of sums, two vectors wide, that stay in registers.
    const ROWS: usize;
    unsafe fn splat(value: f32) -> Self;
    unsafe fn load(from: *const f32) -> Self;
    /// Loads the first `count` lanes. The other lanes are zero, and their memory is not touched.
    unsafe fn load_first(from: *const f32, count: usize) -> Self;
    unsafe fn store(self, to: *mut f32);
    /// Writes the first `count` lanes only.
    unsafe fn store_first(self, to: *mut f32, count: usize);
    unsafe fn add(self, other: Self) -> Self;
    unsafe fn subtract(self, other: Self) -> Self;
    /// The larger value of each lane; `other`'s if one of them is a NaN.
    unsafe fn larger(self, other: Self) -> Self;
    /// `self * factor + sum`.
    unsafe fn multiply_add(self, factor: Self, sum: Self) -> Self;
}

/// Vector in portable Rust.
#[derive(Clone, Copy)]
pub(crate) struct Plain([f32; 8]);

impl Vector for Plain {
    const LANES: usize = 8;
    // Portable code can rely only on registers of half this length.
    const ROWS: usize = 3;

    #[inline(always)]
    unsafe fn splat(value: f32) -> Self {
        Plain([value; 8])
    }

    #[inline(always)]
    unsafe fn load(from: *const f32) -> Self {
        // SAFETY: the caller's pointer is valid for eight values; no alignment is needed.
        Plain(unsafe { from.cast::<[f32; 8]>().read_unaligned() })
    }

    #[inline(always)]
    unsafe fn load_first(from: *const f32, count: usize) -> Self {
        let mut lanes = [0.0; 8];
        // SAFETY: the caller's pointer is valid for `count` values.
        unsafe { std::ptr::copy_nonoverlapping(from, lanes.as_mut_ptr(), count.min(8)) };
        Plain(lanes)
    }

    #[inline(always)]
    unsafe fn store(self, to: *mut f32) {
        // SAFETY: the caller's pointer is valid for eight values.
        unsafe { to.cast::<[f32; 8]>().write_unaligned(self.0) };
    }

    #[inline(always)]
    unsafe fn store_first(self, to: *mut f32, count: usize) {
        // SAFETY: the caller's pointer is valid for `count` values.
        unsafe { std::ptr::copy_nonoverlapping(self.0.as_ptr(), to, count.min(8)) };
    }

    #[inline(always)]
    unsafe fn add(self, other: Self) -> Self {
        Plain(std::array::from_fn(|k| self.0[k] + other.0[k]))
    }

    #[inline(always)]
    unsafe fn subtract(self, other: Self) -> Self {
        Plain(std::array::from_fn(|k| self.0[k] - other.0[k]))
    }

    #[inline(always)]
    unsafe fn larger(self, other: Self) -> Self {
        Plain(std::array::from_fn(|k| if self.0[k] > other.0[k] { self.0[k] } else { other.0[k] }))
    }

    #[inline(always)]
    unsafe fn multiply_add(self, factor: Self, sum: Self) -> Self {
        Plain(std::array::from_fn(|k| self.0[k] * factor.0[k] + sum.0[k]))
    }
}

#[cfg(target_arch = "x86_64")]
pub(crate) use x86::{Avx2, Avx512};

#[cfg(target_arch = "x86_64")]
mod x86 {
    use super::{Plain, Vector};
    use std::arch::x86_64::*;

    /// Implements the methods of [`Vector`] that are a single instruction, by the names of the instructions.
    macro_rules! operations {
        ($splat:ident, $load:ident, $store:ident, $add:ident, $subtract:ident, $larger:ident, $fused:ident) => {
            #[inline(always)]
            unsafe fn splat(value: f32) -> Self {
                Self(unsafe { $splat(value) })
            }

            #[inline(always)]
            unsafe fn load(from: *const f32) -> Self {
                Self(unsafe { $load(from) })
            }

            #[inline(always)]
            unsafe fn store(self, to: *mut f32) {
                unsafe { $store(to, self.0) };
            }

            #[inline(always)]
            unsafe fn add(self, other: Self) -> Self {
                Self(unsafe { $add(self.0, other.0) })
            }

            #[inline(always)]
            unsafe fn subtract(self, other: Self) -> Self {
                Self(unsafe { $subtract(self.0, other.0) })
            }

            #[inline(always)]
            unsafe fn larger(self, other: Self) -> Self {
                Self(unsafe { $larger(self.0, other.0) })
            }

            #[inline(always)]
            unsafe fn multiply_add(self, factor: Self, sum: Self) -> Self {
                Self(unsafe { $fused(self.0, factor.0, sum.0) })
            }
        };
    }

    #[derive(Clone, Copy)]
    pub(crate) struct Avx2(__m256);

    // SAFETY of all blocks: the trait's contract gives the instructions and the pointers.
    #[allow(clippy::undocumented_unsafe_blocks)]
    impl Vector for Avx2 {
        const LANES: usize = 8;
        const ROWS: usize = 6;
        operations! {
            _mm256_set1_ps, _mm256_loadu_ps, _mm256_storeu_ps,
            _mm256_add_ps, _mm256_sub_ps, _mm256_max_ps, _mm256_fmadd_ps
        }

        #[inline(always)]
        unsafe fn load_first(from: *const f32, count: usize) -> Self {
            if count >= Self::LANES {
                return unsafe { Self::load(from) };
            }
            let mut lanes = [0.0f32; 8];
            unsafe { Plain::load_first(from, count).store(lanes.as_mut_ptr()) };
            unsafe { Self::load(lanes.as_ptr()) }
        }

        #[inline(always)]
        unsafe fn store_first(self, to: *mut f32, count: usize) {
            if count >= Self::LANES {
                return unsafe { self.store(to) };
            }
            let mut lanes = [0.0f32; 8];
            unsafe { self.store(lanes.as_mut_ptr()) };
            unsafe { Plain::load(lanes.as_ptr()).store_first(to, count) };
        }
    }

    #[derive(Clone, Copy)]
    pub(crate) struct Avx512(__m512);

    #[inline(always)]
    fn mask(count: usize) -> __mmask16 {
        if count >= 16 { !0 } else { (1u16 << count) - 1 }
    }

    // SAFETY of all blocks: the trait's contract gives the instructions and the pointers.
    #[allow(clippy::undocumented_unsafe_blocks)]
    impl Vector for Avx512 {
        const LANES: usize = 16;
        const ROWS: usize = 14;
        operations! {
            _mm512_set1_ps, _mm512_loadu_ps, _mm512_storeu_ps,
            _mm512_add_ps, _mm512_sub_ps, _mm512_max_ps, _mm512_fmadd_ps
        }

        #[inline(always)]
        unsafe fn load_first(from: *const f32, count: usize) -> Self {
            Avx512(unsafe { _mm512_maskz_loadu_ps(mask(count), from) })
        }

        #[inline(always)]
        unsafe fn store_first(self, to: *mut f32, count: usize) {
            unsafe { _mm512_mask_storeu_ps(to, mask(count), self.0) };
        }
    }
}
