//! What a map is made of.

use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::{PhysicalAxes, RdmShape};
use crate::{KernelLevel, Waveform, WaveformMismatch, Window};

/// Points of an FFT at most: eight times the samples that a chirp can have.
pub const MOST_FFT_POINTS: usize = 1 << 15;
/// Times over which change is told, s.
const LEAST_CHANGE_S: f64 = 0.01;
const MOST_CHANGE_S: f64 = 1000.0;
/// Cells of a map at most, 256 MiB of them.
pub const MOST_CELLS: usize = 1 << 26;

/// How codes become numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SampleScale {
    /// `(code - 2048) / 2048`: the house scale, in which a full-scale sine has amplitude 1.
    FullScale,
    /// `code / 4095`, as the vendor's Avian API.
    ZeroToOne,
    /// `2 code / 4095 - 1`, as the vendor's FMCW API and the paper.
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

/// Which receive channels a map shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Channels {
    /// One map for each channel of the frame.
    All,
    /// One channel by its index in the frame, 0-based. On [`PhysicalAxes`] the first receiver that gives a signal takes the place of one
    /// that gives none, see [`Frame::is_receiver_dead`](crate::Frame::is_receiver_dead): receivers of a board see the same room.
    One(usize),
    /// One map: the mean power of all channels. On [`PhysicalAxes`] a receiver that gives no signal is left out: one whose samples
    /// are all the same, or half of them at the ends of the ADC.
    IncoherentSum,
}

/// How what does not move is taken out, per channel and range, before the Doppler FFT.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum StaticRemoval {
    /// It is left in.
    None,
    /// The mean over slow time is subtracted.
    SlowTimeMean,
    /// `y = x - h; h <- alpha x + (1 - alpha) h` on raw samples from frame to frame, as the vendor's examples do
    /// (0.8 there). The first frame passes unsuppressed, and so does the first after a gap.
    RecursiveMti {
        /// Weight of the newest frame in the background, in (0, 1].
        alpha: f64,
    },
}

/// What the slow-time axis consists of.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SlowTime {
    /// The chirps of one frame.
    Chirps,
    /// The last `frames` frames, each the mean of its chirps: seconds of slow time, for people who sit and breathe.
    Frames {
        /// Length of the window.
        frames: usize,
    },
}

/// What 0 dB stands for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AmplitudeScale {
    /// `2|X| / (sum of window products)`, factor 1 at DC and Nyquist: a full-scale sine reads 0 dBFS.
    FullScaleSine,
    /// `|X|` as it comes, as the paper's statistics are.
    Unnormalised,
    /// `2/N |X|` in range and `1/M` in Doppler without window correction, as the vendor's examples do.
    Vendor,
}

/// Everything that decides what a map is, except the waveform. Travels inside datasets and models.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RdmSpec {
    /// How codes become numbers.
    pub scale: SampleScale,
    /// Which receive channels.
    pub channels: Channels,
    /// Whether each chirp's own mean is subtracted before its window.
    pub chirp_mean_removal: bool,
    /// How what stands still is removed.
    pub static_removal: StaticRemoval,
    /// Taper over samples.
    pub range_window: Window,
    /// Taper over slow time.
    pub doppler_window: Window,
    /// Points of the range FFT; the samples of a chirp if absent. Zero-padding is done at the end.
    #[serde(default)]
    pub range_fft_length: Option<usize>,
    /// Points of the Doppler FFT; the length of slow time if absent.
    #[serde(default)]
    pub doppler_fft_length: Option<usize>,
    /// Fixed axes in metres and metres a second, on which frames of any waveform make like maps; those of the waveform if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub physical_axes: Option<PhysicalAxes>,
    /// Time over which cells of zero velocity tell change from frame to frame, s; if absent, they tell what moves slowly within a
    /// frame, as all others do. Only with `physical_axes`.
    ///
    /// People who stand, sit or breathe are seen by it: the phase of their echoes turns within a second, that of clutter does not. Of a
    /// sum over chirps at zero velocity, from which nothing is removed, `v` is the variance over frames and `m` the mean, with weights
    /// that fade by 1/e over this time; the cell has the power `v * v / (v + |m|^2)`. It reads `floor_db` in the first frame and after
    /// a gap.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub change_over_s: Option<f64>,
    /// What slow time is.
    pub slow_time: SlowTime,
    /// What 0 dB is.
    pub amplitude: AmplitudeScale,
    /// No cell reads less than this, dB.
    pub floor_db: f64,
}

impl Default for RdmSpec {
    /// The house's map: codes minus 2048 over 2048, periodic Hann on both axes, nothing removed, dBFS, floor -200 dB.
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
            slow_time: SlowTime::Chirps,
            amplitude: AmplitudeScale::FullScaleSine,
            floor_db: -200.0,
        }
    }
}

impl RdmSpec {
    /// The preset in which the paper's statistics and noise sweep are evaluated (DESIGN.md section 3).
    pub fn paper() -> Self {
        RdmSpec {
            scale: SampleScale::MinusOneToOne,
            channels: Channels::One(0),
            static_removal: StaticRemoval::SlowTimeMean,
            amplitude: AmplitudeScale::Unnormalised,
            ..RdmSpec::default()
        }
    }

    /// The vendor's example chain: Avian scale, chirp mean removed, MTI 0.8, symmetric Blackman-Harris, padded twofold
    /// on both axes, its own normalisation.
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

    /// Samples of slow time that go into one map.
    pub fn slow_time_length(&self, waveform: &Waveform) -> usize {
        match self.slow_time {
            SlowTime::Chirps => waveform.request.chirps_per_frame,
            SlowTime::Frames { frames } => frames,
        }
    }

    /// Whether a map tells of its frame alone: it is the same whichever frames came before.
    pub fn is_of_single_frames(&self) -> bool {
        self.slow_time == SlowTime::Chirps
            && self.change_over_s.is_none()
            && !matches!(self.static_removal, StaticRemoval::RecursiveMti { .. })
    }

    /// Shape of the maps that this makes of a waveform's frames.
    ///
    /// # Errors
    /// [`SpecError`] if the spec contradicts itself or cannot be applied to the waveform.
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
        if !self.floor_db.is_finite() || self.floor_db < -370.0 {
            return Err(SpecError::Floor { floor_db: self.floor_db });
        }
        if let Some(time_s) = self.change_over_s {
            if self.physical_axes.is_none() {
                return Err(SpecError::ChangeWithoutAxes);
            }
            if !(LEAST_CHANGE_S..=MOST_CHANGE_S).contains(&time_s) {
                return Err(SpecError::ChangeTime { time_s });
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

    /// Checks whether maps of `given` frames may stand beside those of `nominal` frames, which a model was trained on or a dataset
    /// begins with: the waveforms must be alike ([`Waveform::check_compatible`]), or with physical axes within their limits.
    ///
    /// # Errors
    /// [`MapMismatch`] that names the quantity, what is needed and what was given.
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

    /// Range and velocity step of the maps that this makes of a waveform's frames: (m, m/s).
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

/// Frames whose maps cannot stand beside those of another waveform.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum MapMismatch {
    /// The waveforms differ, and the axes of the maps with them.
    #[error(transparent)]
    Waveform(#[from] WaveformMismatch),
    /// The waveform is out of the limits of physical axes.
    #[error(transparent)]
    Spec(#[from] SpecError),
}

/// A spec that cannot be applied to a waveform.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum SpecError {
    /// A physical axis is out of range.
    #[error("map spec: physical_axes.{key} is {value}, expected {expected}")]
    Axis {
        /// Key of [`PhysicalAxes`].
        key: &'static str,
        /// What was given.
        value: f64,
        /// What is allowed.
        expected: &'static str,
    },
    /// Physical axes and another key contradict each other.
    #[error("map spec: physical_axes and {key} exclude each other\n\nhint: leave one of them out")]
    AxesExclude {
        /// The other key.
        key: &'static str,
    },
    /// Frames of the waveform cannot be brought onto physical axes.
    #[error(
        "waveform: {quantity} is {given}, maps on physical axes need {needed}\n\nhint: capture with a waveform within this limit; \
         `radome config` shows the sampled band of one"
    )]
    Waveform {
        /// Quantity that is out of the limits.
        quantity: &'static str,
        /// Its value, with unit.
        given: String,
        /// Values that are allowed, with unit.
        needed: String,
    },
    /// The channel does not exist.
    #[error("map spec: channel index {index} asked for, but frames have {rx} channels (0 to {max})", max = rx - 1)]
    NoSuchChannel {
        /// Index asked for.
        index: usize,
        /// Channels that a frame has.
        rx: usize,
    },
    /// An FFT would cut data off.
    #[error("map spec: the {axis} FFT has {fft} points but there are {data} samples; zero-padding only lengthens")]
    FftTooShort {
        /// Which axis.
        axis: &'static str,
        /// Points asked for.
        fft: usize,
        /// Samples there are.
        data: usize,
    },
    /// An FFT is longer than any that is computed.
    #[error("map spec: the {axis} FFT has {fft} points, at most {MOST_FFT_POINTS} are computed")]
    FftTooLong {
        /// Which axis.
        axis: &'static str,
        /// Points asked for.
        fft: usize,
    },
    /// A map would not fit into memory.
    #[error("map spec: a map would have {cells} cells, at most {MOST_CELLS} are computed")]
    TooManyCells {
        /// Cells of a map.
        cells: usize,
    },
    /// An axis needs at least two samples.
    #[error("map spec: {axis} has {length} samples, at least 2 are needed")]
    TooShort {
        /// Which axis.
        axis: &'static str,
        /// Samples there are.
        length: usize,
    },
    /// The MTI weight is out of range.
    #[error("map spec: MTI alpha is {alpha}, allowed is above 0 and up to 1")]
    Alpha {
        /// Weight that was given.
        alpha: f64,
    },
    /// Change is asked for without physical axes.
    #[error(
        "map spec: change_over_s is only told on physical_axes\n\nhint: give physical_axes, or leave change_over_s out"
    )]
    ChangeWithoutAxes,
    /// The time over which change is told is out of range.
    #[error("map spec: change_over_s is {time_s}, allowed is {LEAST_CHANGE_S} to {MOST_CHANGE_S} s")]
    ChangeTime {
        /// Time that was given, s.
        time_s: f64,
    },
    /// The floor is not a number that f32 power can hold.
    #[error("map spec: floor_db is {floor_db}, allowed is -370 dB and above")]
    Floor {
        /// Floor that was given, dB.
        floor_db: f64,
    },
    /// The kernel level was forced, and the processor lacks it.
    #[error("map kernel: {level} asked for, but the best this processor has is {detected}; force that or a lower one")]
    Kernel {
        /// Level asked for.
        level: KernelLevel,
        /// Best there is.
        detected: KernelLevel,
    },
}
