//! The fast chain for frames whose sizes are powers of two: vectors across transforms, all stages in the L1 cache.
//!
//! Lanes are chirps in the range stage and range bins in the Doppler stage, so butterflies need no shuffles; a
//! transpose in registers stands before and between the stages. A chirp's even and odd samples are the two parts of a
//! complex number, which halves the range FFT.

mod fft;
mod stages;
mod vector;
#[cfg(target_arch = "x86_64")]
mod x86;

use stages::Stages;

use super::chain::ChainPlan;
use crate::KernelLevel;

/// Shortest and longest complex FFT on either axis: longer ones leave the cache.
const FFT_LENGTHS: std::ops::RangeInclusive<usize> = 16..=1024;

/// One channel of a frame.
#[derive(Clone, Copy)]
pub(super) enum Input<'a> {
    /// Raw codes `[chirp][sample]`; scaling, and removal of each chirp's mean, happen on the way.
    Codes(&'a [u16]),
    /// Samples `[chirp][sample]` ready for the window.
    Samples(&'a [f32]),
}

/// The chain at the level it was made for.
pub(super) enum LaneChain {
    Portable(Box<Stages<4, vector::Plain>>),
    #[cfg(target_arch = "x86_64")]
    Avx2(Box<Stages<8, x86::F32x8>>),
    #[cfg(target_arch = "x86_64")]
    Avx512(Box<Stages<16, x86::F32x16>>),
}

impl LaneChain {
    /// `None` where the sizes do not suit; `level` must be available.
    pub(super) fn new(plan: &ChainPlan, level: KernelLevel) -> Option<Self> {
        let lanes = match level {
            KernelLevel::Portable => 4,
            KernelLevel::Avx2 => 8,
            KernelLevel::Avx512 => 16,
        };
        let suits = |length: usize| length.is_power_of_two() && FFT_LENGTHS.contains(&length);
        let fits = suits(plan.shape.range)
            && plan.range_fft_length == 2 * plan.shape.range
            && suits(plan.shape.doppler)
            && plan.frame_shape.samples.is_multiple_of(2 * lanes)
            && plan.frame_shape.chirps.is_multiple_of(lanes)
            && !plan.is_across_frames;
        if !fits {
            return None;
        }
        Some(match level {
            KernelLevel::Portable => LaneChain::Portable(Box::new(Stages::new(plan))),
            #[cfg(target_arch = "x86_64")]
            KernelLevel::Avx2 => LaneChain::Avx2(Box::new(Stages::new(plan))),
            #[cfg(target_arch = "x86_64")]
            KernelLevel::Avx512 => LaneChain::Avx512(Box::new(Stages::new(plan))),
            #[cfg(not(target_arch = "x86_64"))]
            KernelLevel::Avx2 | KernelLevel::Avx512 => return None,
        })
    }

    /// Power of one channel into `cells` (`[doppler][range]`), or added to what is there.
    pub(super) fn channel(&mut self, input: Input<'_>, cells: &mut [f32], adds: bool) {
        match self {
            LaneChain::Portable(stages) => stages.channel(input, cells, adds),
            // SAFETY: a chain of this level is only made where the level is available.
            #[cfg(target_arch = "x86_64")]
            LaneChain::Avx2(stages) => unsafe { channel_avx2(stages, input, cells, adds) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            LaneChain::Avx512(stages) => unsafe { channel_avx512(stages, input, cells, adds) },
        }
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn channel_avx2(stages: &mut Stages<8, x86::F32x8>, input: Input<'_>, cells: &mut [f32], adds: bool) {
    stages.channel(input, cells, adds);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma,avx512f,avx512bw,avx512dq,avx512vl")]
fn channel_avx512(stages: &mut Stages<16, x86::F32x16>, input: Input<'_>, cells: &mut [f32], adds: bool) {
    stages.channel(input, cells, adds);
}
