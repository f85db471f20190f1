//! Errors of maps, and the limits that they name.

use thiserror::Error;

use crate::{KernelLevel, WaveformMismatch};

/// Largest number of points of an FFT: eight times the samples that a chirp can have.
pub(super) const MOST_FFT_POINTS: usize = 1 << 15;
/// Shortest time constant of change and of motion, s.
pub(super) const LEAST_TIME_S: f64 = 0.01;
/// Longest time constant of change and of motion, s.
pub(super) const MOST_TIME_S: f64 = 1000.0;
/// Largest number of cells of a map: 256 MiB of them.
pub(super) const MOST_CELLS: usize = 1 << 26;

/// Error for frames whose maps cannot be compared with those of another waveform.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum MapMismatch {
    /// The waveforms differ, and the axes of the maps with them.
    #[error(transparent)]
    Waveform(#[from] WaveformMismatch),
    /// The waveform is out of the limits of physical axes.
    #[error(transparent)]
    Spec(#[from] SpecError),
}

/// Error for a specification that cannot be applied to a waveform.
#[derive(Debug, Clone, PartialEq, Error)]
#[allow(missing_docs, reason = "the message says what each field is")]
pub enum SpecError {
    /// A key of [`PhysicalAxes`](super::PhysicalAxes) is out of range.
    #[error("map spec: physical_axes.{key} is {value}, expected {expected}")]
    Axis { key: &'static str, value: f64, expected: &'static str },
    /// Physical axes and another key contradict each other.
    #[error("map spec: physical_axes and {key} exclude each other\n\nhint: leave one of them out")]
    AxesExclude { key: &'static str },
    /// Frames of the waveform cannot be brought onto physical axes.
    #[error(
        "waveform: {quantity} is {given}, maps on physical axes need {needed}\n\nhint: capture with a waveform within this limit; \
         `radome board config` shows the sampled band of one"
    )]
    Waveform { quantity: &'static str, given: String, needed: String },
    /// The channel does not exist.
    #[error("map spec: channel index {index} asked for, but frames have {rx} channels (0 to {max})", max = rx - 1)]
    NoSuchChannel { index: usize, rx: usize },
    /// An FFT is shorter than its data.
    #[error("map spec: the {axis} FFT has {fft} points but there are {data} samples; zero-padding only lengthens")]
    FftTooShort { axis: &'static str, fft: usize, data: usize },
    /// An FFT is longer than the limit.
    #[error("map spec: the {axis} FFT has {fft} points, at most {MOST_FFT_POINTS} are computed")]
    FftTooLong { axis: &'static str, fft: usize },
    /// A map has more cells than the limit.
    #[error("map spec: a map would have {cells} cells, at most {MOST_CELLS} are computed")]
    TooManyCells { cells: usize },
    /// An axis has fewer than two samples.
    #[error("map spec: {axis} has {length} samples, at least 2 are needed")]
    TooShort { axis: &'static str, length: usize },
    /// The MTI weight is out of range.
    #[error("map spec: MTI alpha is {alpha}, allowed is above 0 and up to 1")]
    Alpha { alpha: f64 },
    /// Change is requested without physical axes.
    #[error("map spec: change_over_s needs physical_axes\n\nhint: give physical_axes, or leave change_over_s out")]
    ChangeWithoutAxes,
    /// The time constant of change or of motion is out of range.
    #[error("map spec: {key} is {time_s}, allowed is {LEAST_TIME_S} to {MOST_TIME_S} s")]
    Time { key: &'static str, time_s: f64 },
    /// Motion is requested for maps of several channels.
    #[error(
        "map spec: motion_over_s needs maps of one channel\n\nhint: give channels = {{ one = 0 }} or \"incoherent_sum\", or leave \
         motion_over_s out"
    )]
    MotionOfChannels,
    /// Motion is requested for maps whose slow time is across frames: echoes then hardly move from map to map.
    #[error(
        "map spec: motion_over_s needs the chirps of a frame as slow_time\n\nhint: leave slow_time out, or leave motion_over_s out"
    )]
    MotionAcrossFrames,
    /// A greatest range is requested without physical axes.
    #[error("map spec: max_range_m needs physical_axes\n\nhint: give physical_axes, or leave max_range_m out")]
    MaxRangeWithoutAxes,
    /// The greatest range is out of range.
    #[error("map spec: max_range_m is {range_m}, expected a finite number above zero")]
    MaxRange { range_m: f64 },
    /// The floor is not a level that f32 power can represent.
    #[error("map spec: floor_db is {floor_db}, allowed is -370 to 370 dB")]
    Floor { floor_db: f64 },
    /// The requested kernel level is not available on this machine.
    #[error("map kernel: {level} asked for, but the best this processor has is {detected}; force that or a lower one")]
    Kernel { level: KernelLevel, detected: KernelLevel },
}
