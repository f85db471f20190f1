//! Specification of a map.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::axes::{AxesCoverage, PhysicalAxes};
use super::error::{LEAST_TIME_S, MOST_CELLS, MOST_FFT_POINTS, MOST_TIME_S, MapMismatch, SpecError};
use super::map::RdmShape;
use crate::{Frame, Waveform, WaveformMismatch, Window};

/// Conversion of codes to numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum SampleScale {
    /// `(code - 2048) / 2048`, the default: a full-scale sine has amplitude 1.
    FullScale,
    /// `code / 4095`, as in the vendor's Avian API.
    ZeroToOne,
    /// `2 code / 4095 - 1`, as in the vendor's FMCW API and in [`RdmSpec::paper`].
    MinusOneToOne,
}

impl SampleScale {
    /// `(factor, offset)` of `x = code * factor + offset`.
    pub fn affine(self) -> (f64, f64) {
        match self {
            SampleScale::FullScale => (1.0 / 2048.0, -1.0),
            SampleScale::ZeroToOne => (1.0 / 4095.0, 0.0),
            SampleScale::MinusOneToOne => (2.0 / 4095.0, -1.0),
        }
    }
}

/// Selection of receive channels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Channels {
    /// One map for each channel of the frame.
    All,
    /// One channel by its 0-based index in the frame. On [`PhysicalAxes`], if that receiver gives no signal
    /// ([`Frame::is_receiver_dead`](crate::Frame::is_receiver_dead)), the first one that gives a signal replaces it: all
    /// receivers of a board see the same room.
    One(usize),
    /// One map of the mean power of all channels. On [`PhysicalAxes`] receivers that give no signal are left out: all of their
    /// samples are the same, or at least half of them lie at the ends of the ADC's range.
    IncoherentSum,
}

/// Removal of static echoes before the Doppler FFT, per channel and range.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum StaticRemoval {
    /// No removal.
    None,
    /// The mean over slow time is subtracted.
    SlowTimeMean,
    /// Recursive moving-target indication on raw samples from frame to frame: `y = x - h; h <- alpha x + (1 - alpha) h`, as in
    /// the vendor's examples (0.8 there). The first frame, and the first frame after a gap, pass unsuppressed.
    RecursiveMti {
        /// Weight of the newest frame in the background, in (0, 1].
        alpha: f64,
    },
}

/// Contents of the slow-time axis.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum SlowTime {
    /// The chirps of one frame.
    Chirps,
    /// The last `frames` frames, each as the mean of its chirps: seconds of slow time, for people who sit and breathe.
    Frames {
        /// Length of the window.
        frames: usize,
    },
}

/// Amplitude that reads 0 dB.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum AmplitudeScale {
    /// `2|X| / (sum of window products)`, factor 1 at DC and Nyquist: a full-scale sine reads 0 dBFS.
    FullScaleSine,
    /// `|X|` without normalisation, as in [`RdmSpec::paper`].
    Unnormalised,
    /// `2/N |X|` in range, also at DC, and `1/M` in Doppler without window correction, as in the vendor's examples.
    Vendor,
}

/// Specification of a map: with the waveform, it determines the map of a frame. Datasets and models contain it.
///
/// ```
/// use radome_dsp::rdm::{Channels, StaticRemoval};
/// use radome_dsp::{RdmSpec, Waveform, WaveformRequest};
///
/// let spec = RdmSpec {
///     channels: Channels::IncoherentSum,
///     static_removal: StaticRemoval::SlowTimeMean,
///     ..RdmSpec::default()
/// };
/// let waveform = Waveform::realise(WaveformRequest::paper()).expect("the chip can produce it");
/// assert_eq!(spec.shape(&waveform)?.to_string(), "1 rx x 128 doppler x 128 range");
/// # Ok::<(), radome_dsp::rdm::SpecError>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RdmSpec {
    /// Conversion of codes to numbers.
    pub scale: SampleScale,
    /// Selection of receive channels.
    pub channels: Channels,
    /// Whether each chirp's own mean is subtracted before its window.
    pub chirp_mean_removal: bool,
    /// Removal of static echoes.
    pub static_removal: StaticRemoval,
    /// Window over samples.
    pub range_window: Window,
    /// Window over slow time.
    pub doppler_window: Window,
    /// Points of the range FFT; the samples of a chirp if absent. Zeros are appended.
    #[serde(default)]
    pub range_fft_length: Option<usize>,
    /// Points of the Doppler FFT; the length of slow time if absent.
    #[serde(default)]
    pub doppler_fft_length: Option<usize>,
    /// Fixed axes in m and m/s, on which maps of frames of any waveform are comparable; the axes of the waveform if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub physical_axes: Option<PhysicalAxes>,
    /// Time constant of change, s; only with `physical_axes`. If present, cells of zero velocity hold the change from frame to
    /// frame; if absent, they hold slow motion within a frame, as all other cells do.
    ///
    /// Change shows people who stand, sit or breathe: the phase of their echoes turns within a second, that of clutter does not.
    /// For a sum over chirps at zero velocity, from which nothing is removed, `v` is the variance over frames and `m` the mean,
    /// with weights that fall by 1/e over this time. The cell has the power `v * v / (v + |m|^2)`. It reads `floor_db` in the
    /// first frame and after a gap.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub change_over_s: Option<f64>,
    /// Time constant over which the motion of echoes is averaged, s ([`Motion`](super::Motion)); only with one channel, and with the chirps
    /// of a frame as slow time. If absent, maps have no motion.
    ///
    /// Motion tells two people who walk from one person with multipath echoes: echoes of one person keep their distances. Each frame is
    /// compared with the one about 0.3 s before; frames more than 0.6 s apart are not compared. Frames may be missing for up to 1 s.
    /// Levels over noise are those of one receiver. Change nearer than the motion is part of it where `change_over_s` is given; it
    /// falls by 1/e in 0.7 s whatever this time is.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub motion_over_s: Option<f64>,
    /// Greatest range of a cell that is measured, m; only with `physical_axes`. Cells beyond it hold noise, as cells beyond the
    /// unambiguous range of a waveform do. If absent, all cells within the unambiguous range are measured.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_range_m: Option<f64>,
    /// Contents of the slow-time axis.
    pub slow_time: SlowTime,
    /// Amplitude that reads 0 dB.
    pub amplitude: AmplitudeScale,
    /// Lowest level of a cell, dB.
    pub floor_db: f64,
}

impl Default for RdmSpec {
    /// Specification of all channels in dBFS: full scale 2048 about code 2048, periodic Hann on both axes, nothing removed,
    /// floor -200 dB.
    fn default() -> Self {
        RdmSpec {
            scale: SampleScale::FullScale,
            channels: Channels::All,
            chirp_mean_removal: false,
            static_removal: StaticRemoval::None,
            range_window: Window::Hann,
            doppler_window: Window::Hann,
            range_fft_length: None,
            doppler_fft_length: None,
            physical_axes: None,
            change_over_s: None,
            motion_over_s: None,
            max_range_m: None,
            slow_time: SlowTime::Chirps,
            amplitude: AmplitudeScale::FullScaleSine,
            floor_db: -200.0,
        }
    }
}

impl RdmSpec {
    /// Specification for the statistics and the noise sweep of Ratto et al., see [`WaveformRequest::paper`](crate::WaveformRequest::paper).
    pub fn paper() -> Self {
        RdmSpec {
            scale: SampleScale::MinusOneToOne,
            channels: Channels::One(0),
            static_removal: StaticRemoval::SlowTimeMean,
            amplitude: AmplitudeScale::Unnormalised,
            ..RdmSpec::default()
        }
    }

    /// Specification of the vendor's example: Avian scale, chirp mean removed, MTI 0.8, symmetric Blackman-Harris, padded
    /// twofold on both axes, vendor's normalisation.
    pub fn sdk(waveform: &Waveform) -> Self {
        RdmSpec {
            scale: SampleScale::ZeroToOne,
            chirp_mean_removal: true,
            static_removal: StaticRemoval::RecursiveMti { alpha: 0.8 },
            range_window: Window::BlackmanHarrisSymmetric,
            doppler_window: Window::BlackmanHarrisSymmetric,
            range_fft_length: Some(2 * waveform.request.samples_per_chirp),
            doppler_fft_length: Some(2 * waveform.request.chirps_per_frame),
            amplitude: AmplitudeScale::Vendor,
            ..RdmSpec::default()
        }
    }

    /// Number of samples of slow time in one map.
    pub fn slow_time_length(&self, waveform: &Waveform) -> usize {
        match self.slow_time {
            SlowTime::Chirps => waveform.request.chirps_per_frame,
            SlowTime::Frames { frames } => frames,
        }
    }

    /// Returns whether the receivers that a map of this frame needs give a signal. On physical axes one receiver is enough, because
    /// the others are left out. Other maps would show a dead receiver as echoes, or as nothing.
    pub fn has_signal(&self, frame: &Frame) -> bool {
        let is_alive = |rx: usize| !frame.is_receiver_dead(rx);
        match self.channels {
            _ if self.physical_axes.is_some() => (0..frame.shape.rx).any(is_alive),
            Channels::One(index) => is_alive(index),
            Channels::All | Channels::IncoherentSum => (0..frame.shape.rx).all(is_alive),
        }
    }

    /// Returns whether a map depends on its own frame alone, and not on the frames before.
    pub fn is_of_single_frames(&self) -> bool {
        self.slow_time == SlowTime::Chirps
            && self.change_over_s.is_none()
            && self.motion_over_s.is_none()
            && !matches!(self.static_removal, StaticRemoval::RecursiveMti { .. })
    }

    /// Shape of the maps of a waveform's frames.
    ///
    /// # Errors
    /// [`SpecError`] if a value of the spec is out of range, if two of its keys exclude each other, if a channel does not exist in
    /// the waveform, if an FFT is shorter than its data or too long, if the map has too many cells, or if the waveform is out of
    /// the limits of [`PhysicalAxes`].
    pub fn shape(&self, waveform: &Waveform) -> Result<RdmShape, SpecError> {
        let frame = waveform.shape();
        let rx = match self.channels {
            Channels::All => frame.rx,
            Channels::IncoherentSum => 1,
            Channels::One(index) if index < frame.rx => 1,
            Channels::One(index) => return Err(SpecError::NoSuchChannel { index, rx: frame.rx }),
        };
        let slow = self.slow_time_length(waveform);
        if slow < 2 {
            return Err(SpecError::TooShort { axis: "slow time", length: slow });
        }
        let range_fft = self.range_fft_length.unwrap_or(frame.samples);
        let doppler = self.doppler_fft_length.unwrap_or(slow);
        for (axis, fft, data) in [("range", range_fft, frame.samples), ("Doppler", doppler, slow)] {
            if data < 2 {
                return Err(SpecError::TooShort { axis, length: data });
            }
            if fft < data {
                return Err(SpecError::FftTooShort { axis, fft, data });
            }
            if fft > MOST_FFT_POINTS {
                return Err(SpecError::FftTooLong { axis, fft });
            }
        }
        if let StaticRemoval::RecursiveMti { alpha } = self.static_removal
            && !(alpha > 0.0 && alpha <= 1.0)
        {
            return Err(SpecError::Alpha { alpha });
        }
        if !(-370.0..=370.0).contains(&self.floor_db) {
            return Err(SpecError::Floor { floor_db: self.floor_db });
        }
        if self.change_over_s.is_some() && self.physical_axes.is_none() {
            return Err(SpecError::ChangeWithoutAxes);
        }
        if self.motion_over_s.is_some() && rx != 1 {
            return Err(SpecError::MotionOfChannels);
        }
        if self.motion_over_s.is_some() && self.slow_time != SlowTime::Chirps {
            return Err(SpecError::MotionAcrossFrames);
        }
        for (key, time_s) in [("change_over_s", self.change_over_s), ("motion_over_s", self.motion_over_s)] {
            if let Some(time_s) = time_s.filter(|time_s| !(LEAST_TIME_S..=MOST_TIME_S).contains(time_s)) {
                return Err(SpecError::Time { key, time_s });
            }
        }
        if let Some(range_m) = self.max_range_m {
            if self.physical_axes.is_none() {
                return Err(SpecError::MaxRangeWithoutAxes);
            }
            if !(range_m.is_finite() && range_m > 0.0) {
                return Err(SpecError::MaxRange { range_m });
            }
        }
        let (doppler, range) = match self.physical_axes {
            None => (doppler, range_fft / 2),
            Some(axes) => {
                self.check_axes(&axes, waveform)?;
                (axes.velocity_bins, axes.range_bins)
            }
        };
        let cells = rx * doppler * range;
        if cells > MOST_CELLS {
            return Err(SpecError::TooManyCells { cells });
        }
        Ok(RdmShape { rx, doppler, range })
    }

    fn check_axes(&self, axes: &PhysicalAxes, waveform: &Waveform) -> Result<(), SpecError> {
        for (is_given, key) in [
            (self.range_fft_length.is_some(), "range_fft_length"),
            (self.doppler_fft_length.is_some(), "doppler_fft_length"),
            (self.slow_time != SlowTime::Chirps, "a slow_time across frames"),
        ] {
            if is_given {
                return Err(SpecError::AxesExclude { key });
            }
        }
        axes.check()?;
        axes.check_waveform(waveform)
    }

    /// Part of the physical axes that frames of a waveform measure, for specs and waveforms that [`shape`](Self::shape) accepts;
    /// `None` without physical axes.
    pub fn coverage(&self, waveform: &Waveform) -> Option<AxesCoverage> {
        let axes = self.physical_axes?;
        let mut coverage = axes.coverage(waveform);
        if let Some(range_m) = self.max_range_m {
            coverage.range_bins = coverage.range_bins.min(axes.range_bins_up_to(range_m));
        }
        Some(coverage)
    }

    /// Checks that maps of `given` frames are comparable with maps of `nominal` frames, which a model was trained on or a dataset
    /// begins with. The waveforms must be compatible ([`Waveform::check_compatible`]), or, with physical axes, within their
    /// limits.
    ///
    /// # Errors
    /// - [`MapMismatch::Waveform`] if the waveforms, or the shapes of the maps, differ.
    /// - [`MapMismatch::Spec`] if the spec cannot be applied to one of the waveforms.
    pub fn check_compatible(&self, given: &Waveform, nominal: &Waveform) -> Result<(), MapMismatch> {
        if self.physical_axes.is_none() {
            return Ok(given.check_compatible(nominal)?);
        }
        let (got, expected) = (self.shape(given)?, self.shape(nominal)?);
        if got != expected {
            let (what, expected, got) = ("map shape", expected.to_string(), got.to_string());
            return Err(WaveformMismatch { what, expected, got }.into());
        }
        Ok(())
    }

    /// Range step and velocity step of the maps of a waveform's frames: (m, m/s).
    pub fn steps(&self, waveform: &Waveform) -> (f64, f64) {
        if let Some(axes) = self.physical_axes {
            return (axes.range_step_m, axes.velocity_step_m_per_s);
        }
        let range_fft = self.range_fft_length.unwrap_or(waveform.request.samples_per_chirp);
        let doppler_fft = self.doppler_fft_length.unwrap_or(self.slow_time_length(waveform));
        let velocity = match self.slow_time {
            SlowTime::Chirps => waveform.velocity_step_m_per_s(doppler_fft),
            SlowTime::Frames { .. } => waveform.slow_time_velocity_step_m_per_s(doppler_fft),
        };
        (waveform.range_step_m(range_fft), velocity)
    }
}
