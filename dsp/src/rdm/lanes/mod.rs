//! Fast maps of frames whose sizes are powers of two: vectors across transforms, all stages in the L1 cache.
//!
//! Lanes are chirps in the range stage and range bins in the Doppler stage, so butterflies need no shuffles. Data
//! are transposed in registers before and between the stages. A chirp's even and odd samples are the two parts of a
//! complex number, which halves the range FFT.

mod fft;
mod stages;
mod vector;
#[cfg(target_arch = "x86_64")]
mod x86;

use stages::Stages;
pub(super) use stages::{Input, Output};

use super::plan::MapPlan;
use crate::KernelLevel;

/// Shortest and longest complex FFT on either axis: longer ones leave the cache.
const FFT_LENGTHS: std::ops::RangeInclusive<usize> = 16..=1024;

/// Transform at the level it was created for.
pub(super) struct LaneTransform(Level);

enum Level {
    Portable(Box<Stages<4, vector::Plain>>),
    #[cfg(target_arch = "x86_64")]
    Avx2(Box<Stages<8, x86::F32x8>>),
    #[cfg(target_arch = "x86_64")]
    Avx512(Box<Stages<16, x86::F32x16>>),
}

impl LaneTransform {
    /// Creates the transform; `None` if a size is not supported. `level` must be available.
    pub(super) fn new(plan: &MapPlan, level: KernelLevel) -> Option<Self> {
        let lanes = match level {
            KernelLevel::Portable => 4,
            KernelLevel::Avx2 => 8,
            KernelLevel::Avx512 => 16,
        };
        let is_supported = |length: usize| length.is_power_of_two() && FFT_LENGTHS.contains(&length);
        let sizes_fit = is_supported(plan.shape.range)
            && plan.range_fft_length == 2 * plan.shape.range
            && is_supported(plan.shape.doppler)
            && plan.frame_shape.samples.is_multiple_of(2 * lanes)
            && plan.frame_shape.chirps.is_multiple_of(lanes)
            && !plan.is_across_frames;
        if !sizes_fit {
            return None;
        }
        Some(LaneTransform(match level {
            KernelLevel::Portable => Level::Portable(Box::new(Stages::new(plan))),
            #[cfg(target_arch = "x86_64")]
            KernelLevel::Avx2 => Level::Avx2(Box::new(Stages::new(plan))),
            #[cfg(target_arch = "x86_64")]
            KernelLevel::Avx512 => Level::Avx512(Box::new(Stages::new(plan))),
            #[cfg(not(target_arch = "x86_64"))]
            KernelLevel::Avx2 | KernelLevel::Avx512 => return None,
        }))
    }

    /// Transforms one channel into `cells`, `[doppler][range]`. Returns true only if all cells are finite. It may
    /// return false even though all cells are finite.
    pub(super) fn transform_channel(&mut self, input: Input<'_>, output: Output, cells: &mut [f32]) -> bool {
        match &mut self.0 {
            Level::Portable(stages) => stages.transform_channel(input, output, cells),
            // SAFETY: a transform of this level is only created where the level is available.
            #[cfg(target_arch = "x86_64")]
            Level::Avx2(stages) => unsafe { channel_avx2(stages, input, output, cells) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Level::Avx512(stages) => unsafe { channel_avx512(stages, input, output, cells) },
        }
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn channel_avx2(stages: &mut Stages<8, x86::F32x8>, input: Input<'_>, output: Output, cells: &mut [f32]) -> bool {
    stages.transform_channel(input, output, cells)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma,avx512f,avx512bw,avx512dq,avx512vl")]
fn channel_avx512(stages: &mut Stages<16, x86::F32x16>, input: Input<'_>, output: Output, cells: &mut [f32]) -> bool {
    stages.transform_channel(input, output, cells)
}
