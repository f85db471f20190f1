//! Maps of any size by `realfft` and `rustfft`; also maps with slow time across frames.
//!
//! The transforms are in f64. Beside a strong leakage line, f32 would be 0.02 dB off at -100 dBFS. Speed matters little, because
//! these sizes are small or rare.

use std::sync::Arc;

use num_complex::Complex64;
use rustfft::{Fft, FftPlannerScalar};

use super::map::RdmShape;
use super::plan::MapPlan;
use crate::spectrum::{RangeFft, complex_fft};
use crate::{FrameShape, KernelLevel};

/// Chirps that are transformed before they are scattered into the range-major matrix: two cache lines of `Complex64`.
const BLOCK: usize = 8;

pub(super) struct FourierTransform {
    doppler_window: Vec<f64>,
    range_fft: RangeFft,
    doppler_fft: Arc<dyn Fft<f64>>,
    /// Number of cells of `spectra` for one chirp.
    bins: usize,
    spectra: Vec<Complex64>,
    /// `[range][slow time]` of one channel.
    matrix: Vec<Complex64>,
    doppler_scratch: Vec<Complex64>,
    /// `[channel][range][frame]`, a ring over frames.
    history: Vec<Complex64>,
    history_frames: usize,
    history_next: usize,
}

impl FourierTransform {
    pub(super) fn new(plan: &MapPlan, level: KernelLevel) -> Self {
        let RdmShape { doppler, range, .. } = plan.shape;
        let length = plan.range_fft_length;
        let window = plan.range_window.clone();
        // The library chooses its instructions itself, except in its scalar planner.
        let (range_fft, doppler_fft) = if level == KernelLevel::Portable {
            (RangeFft::scalar(window, length), FftPlannerScalar::<f64>::new().plan_fft_forward(doppler))
        } else {
            (RangeFft::new(window, length), complex_fft(doppler))
        };
        let bins = range_fft.bins();
        let zero = Complex64::new(0.0, 0.0);
        let history = if plan.is_across_frames { plan.channels.len() * range * plan.slow_time_length } else { 0 };
        FourierTransform {
            doppler_window: plan.doppler_window.clone(),
            bins,
            spectra: vec![zero; BLOCK * bins],
            matrix: vec![zero; range.next_multiple_of(BLOCK) * doppler],
            doppler_scratch: vec![zero; doppler_fft.get_inplace_scratch_len()],
            range_fft,
            doppler_fft,
            history: vec![zero; history],
            history_frames: 0,
            history_next: 0,
        }
    }

    /// Empties the window of frames.
    pub(super) fn reset(&mut self) {
        self.history_frames = 0;
        self.history_next = 0;
    }

    /// Computes the range FFT of one chirp into row `row` of `spectra`.
    fn range_transform(&mut self, chirp: &[f32], row: usize) {
        let spectrum = &mut self.spectra[row * self.bins..(row + 1) * self.bins];
        self.range_fft.transform(chirp.iter().map(|x| f64::from(*x)), spectrum);
    }

    /// Computes the power of one channel `[chirp][sample]` into the map's cells.
    pub(super) fn transform_channel(&mut self, plan: &MapPlan, index: usize, samples: &[f32], cells: &mut [f32]) {
        let RdmShape { doppler, range, .. } = plan.shape;
        let chirp_length = plan.frame_shape.samples;
        for (block, chirps) in samples.chunks(BLOCK * chirp_length).enumerate() {
            let rows = chirps.len() / chirp_length;
            for (row, chirp) in chirps.chunks_exact(chirp_length).enumerate() {
                self.range_transform(chirp, row);
            }
            // A block of chirps goes into each range row at once: whole cache lines.
            for bin in 0..range {
                let row_start = bin * doppler + block * BLOCK;
                let target = &mut self.matrix[row_start..row_start + rows];
                for (row, cell) in target.iter_mut().enumerate() {
                    *cell = self.spectra[row * self.bins + bin];
                }
            }
        }
        self.doppler_transform(plan, index, cells);
    }

    /// Adds a frame's mean chirps to the window of frames, and overwrites `samples` of all used channels.
    /// Returns the number of frames in the window.
    pub(super) fn push_frame(&mut self, plan: &MapPlan, samples: &mut [f32]) -> usize {
        let FrameShape { chirps, samples: chirp_length, .. } = plan.frame_shape;
        let range = plan.shape.range;
        for (index, channel) in samples.chunks_exact_mut(plan.channel_length()).enumerate() {
            // The mean over chirps, left in the place of the first chirp.
            let (mean, rest) = channel.split_at_mut(chirp_length);
            for chirp in rest.chunks_exact(chirp_length) {
                mean.iter_mut().zip(chirp).for_each(|(m, x)| *m += x);
            }
            let factor = 1.0 / chirps as f32;
            mean.iter_mut().for_each(|m| *m *= factor);
            self.range_transform(mean, 0);
            for bin in 0..range {
                self.history[(index * range + bin) * plan.slow_time_length + self.history_next] = self.spectra[bin];
            }
        }
        self.history_next = (self.history_next + 1) % plan.slow_time_length;
        self.history_frames = (self.history_frames + 1).min(plan.slow_time_length);
        self.history_frames
    }

    /// Computes the power of one channel's window of frames into the map's cells.
    pub(super) fn transform_window(&mut self, plan: &MapPlan, index: usize, cells: &mut [f32]) {
        let RdmShape { doppler, range, .. } = plan.shape;
        for bin in 0..range {
            let row = (index * range + bin) * plan.slow_time_length;
            let (newest, oldest) = self.history[row..row + plan.slow_time_length].split_at(self.history_next);
            let target = &mut self.matrix[bin * doppler..bin * doppler + plan.slow_time_length];
            target[..oldest.len()].copy_from_slice(oldest);
            target[oldest.len()..].copy_from_slice(newest);
        }
        self.doppler_transform(plan, index, cells);
    }

    /// Applies static removal, window and Doppler FFT to one channel's matrix, and computes its power.
    fn doppler_transform(&mut self, plan: &MapPlan, index: usize, cells: &mut [f32]) {
        let RdmShape { doppler, range, .. } = plan.shape;
        let slow = plan.slow_time_length;
        let adds = plan.adds(index);
        let half = doppler / 2;
        for first in (0..range).step_by(BLOCK) {
            let rows = BLOCK.min(range - first);
            let block = &mut self.matrix[first * doppler..(first + rows) * doppler];
            for row in block.chunks_exact_mut(doppler) {
                let data = &mut row[..slow];
                if plan.removes_slow_time_mean {
                    let sum: Complex64 = data.iter().sum();
                    let mean = sum / slow as f64;
                    data.iter_mut().zip(&self.doppler_window).for_each(|(x, w)| *x = (*x - mean) * w);
                } else {
                    data.iter_mut().zip(&self.doppler_window).for_each(|(x, w)| *x *= w);
                }
                row[slow..].fill(Complex64::new(0.0, 0.0));
            }
            if first == 0 {
                block[..doppler].iter_mut().for_each(|x| *x *= plan.dc_amplitude);
            }
            self.doppler_fft.process_with_scratch(block, &mut self.doppler_scratch);
            for d in 0..doppler {
                let shifted = (d + half) % doppler;
                let target = &mut cells[shifted * range + first..shifted * range + first + rows];
                for (row, cell) in target.iter_mut().enumerate() {
                    let power = block[row * doppler + d].norm_sqr() as f32;
                    *cell = if adds { *cell + power } else { power };
                }
            }
        }
    }
}
