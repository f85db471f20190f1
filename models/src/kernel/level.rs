//! Instruction sets of the inner loops, chosen at run time.
//!
//! All levels compute the same sums, but AVX2 and AVX-512 fuse multiply and add, and their tiles have other sizes. Different
//! machines agree bit for bit at the same level only. Therefore every trained model records its level, and the level can be set.

pub use radome_dsp::KernelLevel;
pub(crate) use radome_dsp::dispatch;

#[inline(always)]
pub(crate) fn multiply_add<const FUSED: bool>(a: f32, b: f32, c: f32) -> f32 {
    if FUSED { a.mul_add(b, c) } else { a * b + c }
}
