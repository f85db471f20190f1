//! Instruction sets of the inner loops, chosen at run time.
//!
//! All levels compute the same sums, but AVX2 and AVX-512 fuse multiply and add, and their tiles have other sizes. Different
//! machines agree bit for bit at the same level only. Therefore every trained model records its level, and the level can be set.

pub use radome_dsp::KernelLevel;

/// Defines a function of a level and other arguments that is compiled for each level. In its body, `FUSED` tells whether multiply and
/// add are fused.
macro_rules! for_each_level {
    ($(#[$doc:meta])* $vis:vis fn $name:ident($($arg:ident: $type:ty),* $(,)?) $(-> $ret:ty)? $body:block) => {
        $(#[$doc])*
        #[allow(clippy::too_many_arguments)]
        $vis fn $name(level: $crate::kernel::KernelLevel, $($arg: $type),*) $(-> $ret)? {
            #[inline(always)]
            #[allow(clippy::too_many_arguments)]
            fn generic<const FUSED: bool>($($arg: $type),*) $(-> $ret)? $body
            radome_dsp::dispatch! { fn at_level($($arg: $type),*) $(-> $ret)? = generic }
            at_level(level, $($arg),*)
        }
    };
}
pub(crate) use for_each_level;

#[inline(always)]
pub(crate) fn multiply_add<const FUSED: bool>(a: f32, b: f32, c: f32) -> f32 {
    if FUSED { a.mul_add(b, c) } else { a * b + c }
}
