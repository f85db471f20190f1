//! Plan of a map: sizes, windows and switches that follow from a spec and a waveform.

use super::error::SpecError;
use super::map::RdmShape;
use super::spec::{AmplitudeScale, Channels, RdmSpec, SlowTime, StaticRemoval};
use crate::{FrameShape, Waveform};

/// Sizes, weights and switches of the computation from samples to power.
pub(super) struct MapPlan {
    pub frame_shape: FrameShape,
    pub shape: RdmShape,
    /// Samples of slow time in a map.
    pub slow_time_length: usize,
    pub range_fft_length: usize,
    /// Indices of the channels of the frame that are used.
    pub channels: std::ops::Range<usize>,
    /// `(factor, offset)` from code to sample.
    pub scale: (f64, f64),
    /// Window over the transformed samples. With `doppler_window` it is normalised so that power comes out in the spec's amplitude
    /// scale, as a share of the mean if channels are summed.
    pub range_window: Vec<f64>,
    /// Window over the transformed samples of slow time.
    pub doppler_window: Vec<f64>,
    /// Factor on range bin 0: a one-sided amplitude counts DC once, not twice.
    pub dc_amplitude: f64,
    pub is_sum: bool,
    pub is_across_frames: bool,
    pub removes_chirp_mean: bool,
    pub removes_slow_time_mean: bool,
}

impl MapPlan {
    pub(super) fn new(spec: &RdmSpec, waveform: &Waveform) -> Result<Self, SpecError> {
        let shape = spec.shape(waveform)?;
        let frame_shape = waveform.shape();
        let slow_time_length = spec.slow_time_length(waveform);
        let channels = match spec.channels {
            Channels::One(index) => index..index + 1,
            Channels::All | Channels::IncoherentSum => 0..frame_shape.rx,
        };
        let is_sum = spec.channels == Channels::IncoherentSum;
        // On physical axes, only a part of the frame may be used.
        let coverage = spec.coverage(waveform);
        let (samples, chirps) =
            coverage.map_or((frame_shape.samples, slow_time_length), |c| (c.samples.len(), c.chirps.len()));
        let range_weights = spec.range_window.weights(samples);
        let doppler_weights = spec.doppler_window.weights(chirps);
        let (range_norm, doppler_norm) = match spec.amplitude {
            AmplitudeScale::FullScaleSine => {
                (2.0 / range_weights.iter().sum::<f64>(), 1.0 / doppler_weights.iter().sum::<f64>())
            }
            AmplitudeScale::Unnormalised => (1.0, 1.0),
            AmplitudeScale::Vendor => (2.0 / samples as f64, 1.0 / chirps as f64),
        };
        let share = if is_sum { (1.0 / channels.len() as f64).sqrt() } else { 1.0 };
        Ok(MapPlan {
            frame_shape,
            shape,
            slow_time_length,
            range_fft_length: spec.range_fft_length.unwrap_or(frame_shape.samples),
            channels,
            scale: spec.scale.affine(),
            range_window: range_weights.iter().map(|w| w * range_norm).collect(),
            doppler_window: doppler_weights.iter().map(|w| w * doppler_norm * share).collect(),
            dc_amplitude: if spec.amplitude == AmplitudeScale::FullScaleSine { 0.5 } else { 1.0 },
            is_sum,
            is_across_frames: matches!(spec.slow_time, SlowTime::Frames { .. }),
            removes_chirp_mean: spec.chirp_mean_removal,
            removes_slow_time_mean: spec.static_removal == StaticRemoval::SlowTimeMean,
        })
    }

    pub(super) fn channel_length(&self) -> usize {
        self.frame_shape.chirps * self.frame_shape.samples
    }

    /// Range of the samples of the channels in use, within a frame.
    pub(super) fn used_samples(&self) -> std::ops::Range<usize> {
        self.channels.start * self.channel_length()..self.channels.end * self.channel_length()
    }

    /// Range of the map's cells for the used channel with this index.
    pub(super) fn cells(&self, index: usize) -> std::ops::Range<usize> {
        let cells = self.shape.doppler * self.shape.range;
        let first = if self.is_sum { 0 } else { index * cells };
        first..first + cells
    }

    /// Returns whether the used channel with this index adds to the cells of those before it.
    pub(super) fn adds(&self, index: usize) -> bool {
        self.is_sum && index > 0
    }
}
