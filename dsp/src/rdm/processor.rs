//! Frames to maps by FFT, without allocation per frame.

use std::sync::Arc;

use num_complex::Complex32;
use realfft::{RealFftPlanner, RealToComplex};
use rustfft::{Fft, FftPlanner};
use thiserror::Error;

use super::{AmplitudeScale, Channels, MapFlags, Rdm, RdmShape, RdmSpec, SlowTime, SpecError, StaticRemoval};
use crate::{Frame, FrameShape, MAX_CODE, Waveform, decibel};

/// Chirps that are transformed before they are scattered into the range-major matrix: a cache line of `Complex32`.
const BLOCK: usize = 8;

/// Whether a map was made.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MapStatus {
    /// The map is valid.
    Ready,
    /// A map over several frames needs more of them; the map is untouched.
    WarmingUp {
        /// Frames in the window so far.
        have: usize,
        /// Frames needed.
        need: usize,
    },
}

/// A frame that does not fit the processor.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum MapError {
    /// Another shape than that of the waveform.
    #[error("frame {sequence} is {got}, expected {expected}: is this from another waveform?")]
    Shape {
        /// Sequence number of the frame.
        sequence: u64,
        /// Shape of the waveform.
        expected: FrameShape,
        /// Shape of the frame.
        got: FrameShape,
    },
    /// Fewer or more samples than the shape says.
    #[error("frame {sequence} holds {got} samples, expected {expected}")]
    Length {
        /// Sequence number of the frame.
        sequence: u64,
        /// Samples that the shape calls for.
        expected: usize,
        /// Samples there are.
        got: usize,
    },
}

/// Makes maps of frames as its [`RdmSpec`] says. Owns its plans and buffers; nothing is allocated per frame.
///
/// Keeps state between frames where the spec calls for it (MTI background, window of frames); it forgets it by itself
/// when sequence numbers do not follow one another, and on [`reset`](Self::reset).
pub struct RdmProcessor {
    spec: RdmSpec,
    frame_shape: FrameShape,
    shape: RdmShape,
    steps: (f64, f64),
    slow_length: usize,
    /// Channels of the frame that are used.
    channels: std::ops::Range<usize>,
    scale: (f32, f32),
    /// Normalised so that power comes out in the spec's amplitude scale.
    range_window: Vec<f32>,
    doppler_window: Vec<f32>,
    range_fft: Arc<dyn RealToComplex<f32>>,
    doppler_fft: Arc<dyn Fft<f32>>,
    range_fft_length: usize,
    floor_power: f32,
    use_library_logarithm: bool,
    // Buffers.
    samples: Vec<f32>,
    windowed: Vec<f32>,
    spectra: Vec<Complex32>,
    range_scratch: Vec<Complex32>,
    /// `[range][slow time]` of one channel.
    matrix: Vec<Complex32>,
    doppler_scratch: Vec<Complex32>,
    // State.
    last_sequence: Option<u64>,
    background: Vec<f32>,
    has_background: bool,
    /// `[channel][range][frame]`, a ring over frames.
    history: Vec<Complex32>,
    history_frames: usize,
    history_next: usize,
}

impl RdmProcessor {
    /// Plans the transforms for frames of `waveform`.
    pub fn new(spec: &RdmSpec, waveform: &Waveform) -> Result<Self, SpecError> {
        let shape = spec.shape(waveform)?;
        let frame_shape = waveform.shape();
        let slow_length = spec.slow_time_length(waveform);
        let range_fft_length = spec.range_fft_length.unwrap_or(frame_shape.samples);
        let channels = match spec.channels {
            Channels::One(index) => index..index + 1,
            Channels::All | Channels::IncoherentSum => 0..frame_shape.rx,
        };
        let range_weights = spec.range_window.weights(frame_shape.samples);
        let doppler_weights = spec.doppler_window.weights(slow_length);
        let (range_norm, doppler_norm) = match spec.amplitude {
            AmplitudeScale::FullScaleSine => {
                (2.0 / range_weights.iter().sum::<f64>(), 1.0 / doppler_weights.iter().sum::<f64>())
            }
            AmplitudeScale::Unnormalised => (1.0, 1.0),
            AmplitudeScale::Vendor => (2.0 / frame_shape.samples as f64, 1.0 / slow_length as f64),
        };
        let mut planner = RealFftPlanner::<f32>::new();
        let range_fft = planner.plan_fft_forward(range_fft_length);
        let mut planner = FftPlanner::<f32>::new();
        let doppler_fft = planner.plan_fft_forward(shape.doppler);
        let (factor, offset) = spec.scale.affine();
        let zero = Complex32::new(0.0, 0.0);
        let is_across_frames = matches!(spec.slow_time, SlowTime::Frames { .. });
        let is_recursive = matches!(spec.static_removal, StaticRemoval::RecursiveMti { .. });
        let bins = range_fft_length / 2 + 1;
        let range_scratch = vec![zero; range_fft.get_scratch_len()];
        let doppler_scratch = vec![zero; doppler_fft.get_inplace_scratch_len()];
        Ok(RdmProcessor {
            spec: *spec,
            frame_shape,
            shape,
            steps: spec.steps(waveform),
            slow_length,
            scale: (factor as f32, offset as f32),
            range_window: range_weights.iter().map(|w| (w * range_norm) as f32).collect(),
            doppler_window: doppler_weights.iter().map(|w| (w * doppler_norm) as f32).collect(),
            range_fft,
            doppler_fft,
            range_fft_length,
            floor_power: 10f64.powf(spec.floor_db / 10.0) as f32,
            use_library_logarithm: false,
            samples: vec![0.0; frame_shape.codes()],
            windowed: vec![0.0; range_fft_length],
            spectra: vec![zero; BLOCK * bins],
            range_scratch,
            matrix: vec![zero; shape.range.next_multiple_of(BLOCK) * shape.doppler],
            doppler_scratch,
            last_sequence: None,
            background: vec![0.0; if is_recursive { frame_shape.codes() } else { 0 }],
            has_background: false,
            history: vec![zero; if is_across_frames { channels.len() * shape.range * slow_length } else { 0 }],
            history_frames: 0,
            history_next: 0,
            channels,
        })
    }

    /// Uses the library's `log10` instead of the polynomial: for benchmarks that compare the two.
    pub fn use_library_logarithm(&mut self) {
        self.use_library_logarithm = true;
    }

    /// The spec.
    pub fn spec(&self) -> &RdmSpec {
        &self.spec
    }

    /// Shape of the maps.
    pub fn shape(&self) -> RdmShape {
        self.shape
    }

    /// A map to process into.
    pub fn empty_map(&self) -> Rdm {
        Rdm {
            shape: self.shape,
            db: vec![self.spec.floor_db as f32; self.shape.cells()],
            range_step_m: self.steps.0,
            velocity_step_m_per_s: self.steps.1,
            sequence: 0,
            flags: MapFlags::default(),
        }
    }

    /// Forgets background and window: call it at a gap or when the scene jumps.
    pub fn reset(&mut self) {
        self.last_sequence = None;
        self.has_background = false;
        self.history_frames = 0;
        self.history_next = 0;
    }

    /// Makes the map of `frame` (and, if the spec says so, of those before it).
    ///
    /// # Errors
    /// [`MapError`] if the frame's shape is not the waveform's; state and map are then untouched.
    pub fn process(&mut self, frame: &Frame, map: &mut Rdm) -> Result<MapStatus, MapError> {
        if frame.shape != self.frame_shape {
            let (expected, got) = (self.frame_shape, frame.shape);
            return Err(MapError::Shape { sequence: frame.sequence, expected, got });
        }
        self.check_length(frame.sequence, frame.codes.len())?;
        let used = self.used();
        let codes = &frame.codes[used.clone()];
        let (factor, offset) = self.scale;
        for (x, code) in self.samples[used].iter_mut().zip(codes) {
            *x = f32::from(*code) * factor + offset;
        }
        let saturated = codes.iter().map(|c| u32::from(*c == 0) + u32::from(*c >= MAX_CODE)).sum();
        Ok(self.transform(frame.sequence, saturated, map))
    }

    /// The same for samples that are already numbers in the spec's scale, `[rx][chirp][sample]` of all channels.
    /// NaN and infinity go through and are counted in the map's flags.
    pub fn process_samples(&mut self, sequence: u64, samples: &[f32], map: &mut Rdm) -> Result<MapStatus, MapError> {
        self.check_length(sequence, samples.len())?;
        self.samples.copy_from_slice(samples);
        Ok(self.transform(sequence, 0, map))
    }

    fn check_length(&self, sequence: u64, got: usize) -> Result<(), MapError> {
        let expected = self.frame_shape.codes();
        if got == expected { Ok(()) } else { Err(MapError::Length { sequence, expected, got }) }
    }

    /// Samples of the channels in use.
    fn used(&self) -> std::ops::Range<usize> {
        let per_channel = self.frame_shape.chirps * self.frame_shape.samples;
        self.channels.start * per_channel..self.channels.end * per_channel
    }

    fn transform(&mut self, sequence: u64, saturated_samples: u32, map: &mut Rdm) -> MapStatus {
        if self.last_sequence.is_some_and(|last| last + 1 != sequence) {
            self.reset();
        }
        self.last_sequence = Some(sequence);
        if self.spec.chirp_mean_removal {
            let used = self.used();
            for chirp in self.samples[used].chunks_exact_mut(self.frame_shape.samples) {
                let mean = (chirp.iter().map(|x| f64::from(*x)).sum::<f64>() / chirp.len() as f64) as f32;
                chirp.iter_mut().for_each(|x| *x -= mean);
            }
        }
        if let StaticRemoval::RecursiveMti { alpha } = self.spec.static_removal {
            self.subtract_background(alpha as f32);
        }
        match self.spec.slow_time {
            SlowTime::Chirps => self.within_frame(map),
            SlowTime::Frames { frames } => {
                self.push_history();
                if self.history_frames < frames {
                    return MapStatus::WarmingUp { have: self.history_frames, need: frames };
                }
                self.across_frames(map);
            }
        }
        self.finish(sequence, saturated_samples, map);
        MapStatus::Ready
    }

    fn subtract_background(&mut self, alpha: f32) {
        let used = self.used();
        let (samples, background) = (&mut self.samples[used.clone()], &mut self.background[used]);
        if !self.has_background {
            // As in the vendor's examples the first frame passes unsuppressed (h starts at zero).
            background.fill(0.0);
            self.has_background = true;
        }
        for (x, h) in samples.iter_mut().zip(background) {
            let raw = *x;
            *x = raw - *h;
            *h = alpha * raw + (1.0 - alpha) * *h;
        }
    }

    /// Range FFT of one chirp into row `row` of `spectra`.
    fn range_transform(&mut self, first_sample: usize, row: usize) {
        let n = self.frame_shape.samples;
        let bins = self.range_fft_length / 2 + 1;
        let chirp = &self.samples[first_sample..first_sample + n];
        let input = &mut self.windowed;
        for ((y, x), w) in input[..n].iter_mut().zip(chirp).zip(&self.range_window) {
            *y = x * w;
        }
        input[n..].fill(0.0);
        let output = &mut self.spectra[row * bins..(row + 1) * bins];
        let planned = self.range_fft.process_with_scratch(input, output, &mut self.range_scratch);
        debug_assert!(planned.is_ok(), "buffers have the planned lengths");
    }

    fn within_frame(&mut self, map: &mut Rdm) {
        let FrameShape { chirps, samples, .. } = self.frame_shape;
        let bins = self.range_fft_length / 2 + 1;
        let RdmShape { doppler, range, .. } = self.shape;
        for (index, channel) in self.channels.clone().enumerate() {
            for first in (0..chirps).step_by(BLOCK) {
                let rows = BLOCK.min(chirps - first);
                for row in 0..rows {
                    self.range_transform((channel * chirps + first + row) * samples, row);
                }
                // A block of chirps goes into each range row at once: whole cache lines.
                for bin in 0..range {
                    let row_start = bin * doppler + first;
                    let target = &mut self.matrix[row_start..row_start + rows];
                    for (row, cell) in target.iter_mut().enumerate() {
                        *cell = self.spectra[row * bins + bin];
                    }
                }
            }
            self.doppler_transform(index, map);
        }
    }

    fn push_history(&mut self) {
        let FrameShape { chirps, samples, .. } = self.frame_shape;
        let RdmShape { range, .. } = self.shape;
        for (index, channel) in self.channels.clone().enumerate() {
            // The mean over chirps, left in the place of the first chirp.
            let start = channel * chirps * samples;
            let (mean, rest) = self.samples[start..start + chirps * samples].split_at_mut(samples);
            for chirp in rest.chunks_exact(samples) {
                mean.iter_mut().zip(chirp).for_each(|(m, x)| *m += x);
            }
            let factor = 1.0 / chirps as f32;
            mean.iter_mut().for_each(|m| *m *= factor);
            self.range_transform(start, 0);
            for bin in 0..range {
                self.history[(index * range + bin) * self.slow_length + self.history_next] = self.spectra[bin];
            }
        }
        self.history_next = (self.history_next + 1) % self.slow_length;
        self.history_frames = (self.history_frames + 1).min(self.slow_length);
    }

    fn across_frames(&mut self, map: &mut Rdm) {
        let RdmShape { doppler, range, .. } = self.shape;
        for index in 0..self.channels.len() {
            for bin in 0..range {
                let row = (index * range + bin) * self.slow_length;
                let (newest, oldest) = self.history[row..row + self.slow_length].split_at(self.history_next);
                let target = &mut self.matrix[bin * doppler..bin * doppler + self.slow_length];
                target[..oldest.len()].copy_from_slice(oldest);
                target[oldest.len()..].copy_from_slice(newest);
            }
            self.doppler_transform(index, map);
        }
    }

    /// Static removal, window, Doppler FFT and power of one channel's matrix.
    fn doppler_transform(&mut self, index: usize, map: &mut Rdm) {
        let RdmShape { doppler, range, .. } = self.shape;
        let slow = self.slow_length;
        let removes_mean = self.spec.static_removal == StaticRemoval::SlowTimeMean;
        let is_sum = self.spec.channels == Channels::IncoherentSum;
        let weight = if is_sum { 1.0 / self.channels.len() as f32 } else { 1.0 };
        let dc_factor = if self.spec.amplitude == AmplitudeScale::Unnormalised { 1.0 } else { 0.25 };
        let first_cell = if is_sum { 0 } else { index * doppler * range };
        let cells = &mut map.db[first_cell..first_cell + doppler * range];
        if is_sum && index == 0 {
            cells.fill(0.0);
        }
        let half = doppler / 2;
        for first in (0..range).step_by(BLOCK) {
            let rows = BLOCK.min(range - first);
            let block = &mut self.matrix[first * doppler..(first + rows) * doppler];
            for row in block.chunks_exact_mut(doppler) {
                let data = &mut row[..slow];
                if removes_mean {
                    let sum: Complex32 = data.iter().sum();
                    let mean = sum / slow as f32;
                    data.iter_mut().zip(&self.doppler_window).for_each(|(x, w)| *x = (*x - mean) * w);
                } else {
                    data.iter_mut().zip(&self.doppler_window).for_each(|(x, w)| *x *= w);
                }
                row[slow..].fill(Complex32::new(0.0, 0.0));
            }
            self.doppler_fft.process_with_scratch(block, &mut self.doppler_scratch);
            let mut power = |d: usize, shifted: usize| {
                let target = &mut cells[shifted * range + first..shifted * range + first + rows];
                for (row, cell) in target.iter_mut().enumerate() {
                    let p = block[row * doppler + d].norm_sqr() * weight;
                    *cell = if is_sum { *cell + p } else { p };
                }
                if first == 0 {
                    // A one-sided amplitude counts DC once, not twice.
                    let cell = &mut target[0];
                    if !is_sum {
                        *cell *= dc_factor;
                    } else {
                        let p = block[d].norm_sqr() * weight;
                        *cell += p * (dc_factor - 1.0);
                    }
                }
            };
            (0..doppler - half).for_each(|d| power(d, d + half));
            (doppler - half..doppler).for_each(|d| power(d, d + half - doppler));
        }
    }

    fn finish(&self, sequence: u64, saturated_samples: u32, map: &mut Rdm) {
        if self.use_library_logarithm {
            decibel::power_to_db_library(&mut map.db, self.floor_power);
        } else {
            decibel::power_to_db(&mut map.db, self.floor_power);
        }
        map.sequence = sequence;
        map.flags =
            MapFlags { saturated_samples, non_finite_cells: map.db.iter().map(|v| u32::from(!v.is_finite())).sum() };
    }
}
