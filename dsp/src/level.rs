//! Levels of vector instructions.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Instruction set of the kernels that compute maps and networks.
///
/// The same binary at the same level gives the same bits on any machine that has the level. Different levels differ in
/// rounding (fused multiply-add or not), by about -140 dBc. Levels are ordered from slow to fast.
///
/// ```
/// use radome_dsp::KernelLevel;
///
/// let level = KernelLevel::detect();
/// assert!(level.is_available() && level >= KernelLevel::Portable);
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum KernelLevel {
    /// Scalar arithmetic of every processor, without fused multiply-add.
    Portable,
    /// x86-64 with AVX2 and FMA: 8 lanes.
    Avx2,
    /// x86-64 with AVX2, FMA and AVX-512 F, BW, DQ and VL: 16 lanes.
    Avx512,
}

impl KernelLevel {
    /// All levels, slow to fast.
    pub const ALL: [KernelLevel; 3] = [KernelLevel::Portable, KernelLevel::Avx2, KernelLevel::Avx512];

    /// Returns the fastest level that this machine has.
    pub fn detect() -> Self {
        Self::ALL.into_iter().rfind(|level| level.is_available()).unwrap_or(KernelLevel::Portable)
    }

    /// Returns whether this machine has the level.
    #[cfg(target_arch = "x86_64")]
    pub fn is_available(self) -> bool {
        let has_avx2 = || std::is_x86_feature_detected!("avx2") && std::is_x86_feature_detected!("fma");
        match self {
            KernelLevel::Portable => true,
            KernelLevel::Avx2 => has_avx2(),
            KernelLevel::Avx512 => {
                has_avx2()
                    && std::is_x86_feature_detected!("avx512f")
                    && std::is_x86_feature_detected!("avx512bw")
                    && std::is_x86_feature_detected!("avx512dq")
                    && std::is_x86_feature_detected!("avx512vl")
            }
        }
    }

    /// Returns whether this machine has the level.
    #[cfg(not(target_arch = "x86_64"))]
    pub fn is_available(self) -> bool {
        self == KernelLevel::Portable
    }

    /// Returns this level, or the fastest level below it that the machine has.
    pub fn available(self) -> Self {
        Self::ALL.into_iter().rfind(|level| *level <= self && level.is_available()).unwrap_or(KernelLevel::Portable)
    }

    /// Name for people to read.
    pub fn name(self) -> &'static str {
        match self {
            KernelLevel::Portable => "portable",
            KernelLevel::Avx2 => "AVX2",
            KernelLevel::Avx512 => "AVX-512",
        }
    }
}

impl std::fmt::Display for KernelLevel {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

/// Defines a function of a level and other arguments that calls a generic function, compiled for the level.
///
/// The generic parameter, `FUSED`, is true in the code for AVX2 and AVX-512, and false in portable code.
#[doc(hidden)]
#[macro_export]
macro_rules! dispatch {
    ($(#[$doc:meta])* $vis:vis fn $name:ident($($arg:ident: $type:ty),* $(,)?) $(-> $ret:ty)? = $generic:ident) => {
        $(#[$doc])*
        #[allow(clippy::too_many_arguments)]
        $vis fn $name(level: $crate::KernelLevel, $($arg: $type),*) $(-> $ret)? {
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
                    $crate::KernelLevel::Avx512 => return unsafe { avx512($($arg),*) },
                    // SAFETY: as above.
                    $crate::KernelLevel::Avx2 => return unsafe { avx2($($arg),*) },
                    $crate::KernelLevel::Portable => {}
                }
            }
            let _ = level;
            $generic::<false>($($arg),*)
        }
    };
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn detected_level_is_the_last_available() {
        assert!(KernelLevel::Portable.is_available());
        let detected = KernelLevel::detect();
        assert!(detected.is_available());
        for level in KernelLevel::ALL {
            assert!(level <= detected || !level.is_available());
            assert_eq!(level.available(), level.min(detected));
        }
    }

    /// Tests of kernels leave out levels that the processor lacks. This test counts them as skipped, once for all tests.
    #[test]
    fn levels_that_are_not_tested_count_as_skipped() {
        for (level, name) in KernelLevel::ALL.into_iter().zip(["portable", "avx2", "avx512"]) {
            if !level.is_available() {
                radome_skip::skip(name, &format!("no kernel is tested at the level {level}: the processor lacks it"));
            }
        }
    }
}
