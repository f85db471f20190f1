//! Which instructions the inner loops use, chosen at run time.
//!
//! All levels do the same sums; AVX2 and AVX-512 fuse multiply and add, and tiles have other sizes: unlike machines
//! agree bit for bit only at the same level, so the level is recorded with every trained model and can be chosen.

use serde::{Deserialize, Serialize};

/// Which instructions the inner loops use.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum KernelLevel {
    /// Plain Rust: separate multiply and add.
    Portable,
    /// AVX2 with fused multiply-add; falls back to `Portable` where the processor lacks it.
    Avx2,
    /// AVX-512; falls back to `Avx2` where the processor lacks it.
    Avx512,
}

impl KernelLevel {
    /// From the slowest to the fastest.
    pub const ALL: [KernelLevel; 3] = [KernelLevel::Portable, KernelLevel::Avx2, KernelLevel::Avx512];

    /// The fastest that this machine has.
    pub fn detect() -> Self {
        #[cfg(target_arch = "x86_64")]
        if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
            let wide = is_x86_feature_detected!("avx512f")
                && is_x86_feature_detected!("avx512bw")
                && is_x86_feature_detected!("avx512dq")
                && is_x86_feature_detected!("avx512vl");
            return if wide { KernelLevel::Avx512 } else { KernelLevel::Avx2 };
        }
        KernelLevel::Portable
    }

    /// This level, or the next below that the processor has.
    pub fn available(self) -> Self {
        let best = Self::detect();
        if (self as u8) < best as u8 { self } else { best }
    }
}

/// Calls the generic function with `FUSED` true inside a function compiled for AVX2 or AVX-512, or false in plain code.
macro_rules! dispatch {
    ($(#[$doc:meta])* $vis:vis fn $name:ident($($arg:ident: $type:ty),* $(,)?) $(-> $ret:ty)? = $generic:ident) => {
        $(#[$doc])*
        #[allow(clippy::too_many_arguments)]
        $vis fn $name(level: $crate::layer::KernelLevel, $($arg: $type),*) $(-> $ret)? {
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
                    $crate::layer::KernelLevel::Avx512 => return unsafe { avx512($($arg),*) },
                    // SAFETY: as above.
                    $crate::layer::KernelLevel::Avx2 => return unsafe { avx2($($arg),*) },
                    $crate::layer::KernelLevel::Portable => {}
                }
            }
            let _ = level;
            $generic::<false>($($arg),*)
        }
    };
}
pub(super) use dispatch;

#[inline(always)]
pub(super) fn multiply_add<const FUSED: bool>(a: f32, b: f32, c: f32) -> f32 {
    if FUSED { a.mul_add(b, c) } else { a * b + c }
}
