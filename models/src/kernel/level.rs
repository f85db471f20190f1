//! Instruction sets of the inner loops, chosen at run time.
//!
//! All levels compute the same sums, but AVX2 and AVX-512 fuse multiply and add, and their tiles have other sizes. Different
//! machines agree bit for bit at the same level only. Therefore every trained model records its level, and the level can be set.

pub use radome_dsp::KernelLevel;

/// Calls the generic function with `FUSED` true inside a function compiled for AVX2 or AVX-512, or false in plain code.
macro_rules! dispatch {
    ($(#[$doc:meta])* $vis:vis fn $name:ident($($arg:ident: $type:ty),* $(,)?) $(-> $ret:ty)? = $generic:ident) => {
        $(#[$doc])*
        #[allow(clippy::too_many_arguments)]
        $vis fn $name(level: $crate::kernel::KernelLevel, $($arg: $type),*) $(-> $ret)? {
            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx2,fma")]
                #[allow(clippy::too_many_arguments)]
                fn avx2($($arg: $type),*) $(-> $ret)? {
                    $generic::<true>($($arg),*)
                }
                #[target_feature(enable = "avx2,fma,avx512f,avx512bw,avx512dq,avx512vl")]
                #[allow(clippy::too_many_arguments)]
                fn avx512($($arg: $type),*) $(-> $ret)? {
                    $generic::<true>($($arg),*)
                }
                match level.available() {
                    // SAFETY: `available` returned this level, so the processor has its instructions.
                    $crate::kernel::KernelLevel::Avx512 => return unsafe { avx512($($arg),*) },
                    // SAFETY: as above.
                    $crate::kernel::KernelLevel::Avx2 => return unsafe { avx2($($arg),*) },
                    $crate::kernel::KernelLevel::Portable => {}
                }
            }
            let _ = level;
            $generic::<false>($($arg),*)
        }
    };
}
pub(crate) use dispatch;

#[inline(always)]
pub(crate) fn multiply_add<const FUSED: bool>(a: f32, b: f32, c: f32) -> f32 {
    if FUSED { a.mul_add(b, c) } else { a * b + c }
}
