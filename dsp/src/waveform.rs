//! Waveforms: the request, the realisation by the chip, and every quantity that follows from it.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::FrameShape;

/// Speed of light in vacuum, m/s.
pub const SPEED_OF_LIGHT_M_PER_S: f64 = 299_792_458.0;
/// Reference clock of the BGT60TR13C; all its timers count its cycles.
pub const REFERENCE_CLOCK_HZ: f64 = 80e6;
/// Delay of the first sample after the ramp has passed the requested start frequency, s: `(8*31 + 1) / 80 MHz` with the
/// vendor's default timing. The first part of the requested band is therefore never sampled.
pub const ADC_START_DELAY_S: f64 = 249.0 / REFERENCE_CLOCK_HZ;
/// Step of the ramp register RSU, Hz/s: `640 MHz / 2^20` in each reference clock cycle.
pub const SLOPE_STEP_HZ_PER_S: f64 = 640e6 / 1_048_576.0 * REFERENCE_CLOCK_HZ;
/// Shortest and longest ADC clock divider.
pub const ADC_DIVIDER_RANGE: (u32, u32) = (20, 1023);
/// Step of the realised chirp intervals, s: eight reference clock cycles.
pub const CHIRP_INTERVAL_STEP_S: f64 = 8.0 / REFERENCE_CLOCK_HZ;
/// Time that the chip needs in each chirp beside its samples, s: ramp start, ADC delay, end delay and baseband reset.
pub const CHIRP_OVERHEAD_S: f64 = 8.0e-6;
/// Lowest and highest frequency of the synthesiser, Hz (datasheet: RF band).
pub const RF_BAND_HZ: (f64, f64) = (57.4e9, 63.6e9);
/// Narrowest band of a waveform, Hz.
pub const LEAST_BAND_HZ: f64 = 1e6;
/// Samples that the chip's FIFO holds.
pub const FIFO_SAMPLES: usize = 16_384;

/// Set of receive antennas in use: bit 0 is RX1. Serialised as the list of their 1-based numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(try_from = "Vec<u8>", into = "Vec<u8>")]
pub struct RxMask(u8);

impl RxMask {
    /// All three receivers.
    pub const ALL: RxMask = RxMask(0b111);

    /// Set of these 1-based antenna numbers.
    ///
    /// # Errors
    /// [`WaveformError::Antennas`] if the list is empty, repeats a number, or has a number out of 1 to 3.
    pub fn from_antennas(antennas: &[u8]) -> Result<Self, WaveformError> {
        let mut mask = 0u8;
        for &antenna in antennas {
            if !(1..=3).contains(&antenna) || mask & (1 << (antenna - 1)) != 0 {
                return Err(WaveformError::Antennas { got: antennas.to_vec() });
            }
            mask |= 1 << (antenna - 1);
        }
        if mask == 0 {
            return Err(WaveformError::Antennas { got: antennas.to_vec() });
        }
        Ok(RxMask(mask))
    }

    /// 1-based numbers of the enabled antennas, ascending.
    pub fn antennas(self) -> Vec<u8> {
        (1..=3).filter(|a| self.0 & (1 << (a - 1)) != 0).collect()
    }

    /// Subset of the first `index + 1` enabled antennas; all of them if there are fewer.
    pub fn up_to(self, index: usize) -> Self {
        let beyond = self.antennas().into_iter().skip(index + 1);
        RxMask(beyond.fold(self.0, |mask, antenna| mask & !(1 << (antenna - 1))))
    }

    /// Number of enabled receivers.
    pub fn count(self) -> usize {
        self.0.count_ones() as usize
    }

    /// The bits, RX1 lowest.
    pub fn bits(self) -> u8 {
        self.0
    }
}

impl TryFrom<Vec<u8>> for RxMask {
    type Error = WaveformError;
    fn try_from(antennas: Vec<u8>) -> Result<Self, Self::Error> {
        RxMask::from_antennas(&antennas)
    }
}

impl From<RxMask> for Vec<u8> {
    fn from(mask: RxMask) -> Self {
        mask.antennas()
    }
}

/// Waveform as a user, a scene or a recording requests it. Field names are the keys in TOML and JSON.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct WaveformRequest {
    /// Frequency at which the transmitter is switched on, Hz.
    pub start_frequency_hz: f64,
    /// Frequency at which the ramp ends, Hz.
    pub end_frequency_hz: f64,
    /// ADC samples in a chirp.
    pub samples_per_chirp: usize,
    /// Chirps in a frame.
    pub chirps_per_frame: usize,
    /// ADC rate, Hz.
    pub sample_rate_hz: f64,
    /// Time from the start of one chirp to the start of the next, s.
    pub chirp_interval_s: f64,
    /// Time from the start of one frame to the start of the next, s.
    pub frame_interval_s: f64,
    /// Enabled receivers, 1-based; `[1, 2, 3]` by default.
    #[serde(default = "all_receivers")]
    pub rx_antennas: RxMask,
    /// Transmit power setting, 0..=31 (31 is about 4 dBm).
    #[serde(default = "full_power")]
    pub tx_power_level: u8,
    /// Gain from mixer to ADC, dB: 18..=60 in steps of 5 or so.
    #[serde(default = "default_gain")]
    pub if_gain_db: f64,
    /// First-order high-pass of the IF chain, Hz.
    #[serde(default = "default_high_pass")]
    pub high_pass_cutoff_hz: f64,
    /// Anti-alias filter of the IF chain, Hz.
    #[serde(default = "default_anti_alias")]
    pub anti_alias_cutoff_hz: f64,
}

fn all_receivers() -> RxMask {
    RxMask::ALL
}
fn full_power() -> u8 {
    31
}
fn default_gain() -> f64 {
    33.0
}
fn default_high_pass() -> f64 {
    80e3
}
fn default_anti_alias() -> f64 {
    500e3
}

impl WaveformRequest {
    /// Waveform of Ratto et al., "Indoor Occupancy Classification using a Compact Hybrid Quantum-Classical Model Enabled by a
    /// Physics-Informed Radar Digital Twin", section 3: 882.35 MHz about 60 GHz, 256 samples at 1 MHz, 128 chirps.
    ///
    /// That publication states neither the chirp interval nor the frame interval; they are 500 us and 100 ms here.
    pub fn paper() -> Self {
        WaveformRequest {
            start_frequency_hz: 60e9 - 441.175e6,
            end_frequency_hz: 60e9 + 441.175e6,
            samples_per_chirp: 256,
            chirps_per_frame: 128,
            sample_rate_hz: 1e6,
            chirp_interval_s: 500e-6,
            frame_interval_s: 0.1,
            rx_antennas: RxMask::ALL,
            tx_power_level: 31,
            if_gain_db: 48.0,
            high_pass_cutoff_hz: 20e3,
            anti_alias_cutoff_hz: 500e3,
        }
    }
}

/// Waveform as the chip realises it: the request, and the values on the grids of the chip's registers.
///
/// The band that is *sampled* is narrower than the requested one. All axes follow from the sampled band.
///
/// ```
/// use radome_dsp::{Waveform, WaveformRequest};
///
/// let request = WaveformRequest { samples_per_chirp: 128, ..WaveformRequest::paper() };
/// let waveform = Waveform::realise(request)?;
/// assert_eq!(waveform.shape().to_string(), "3 rx x 128 chirps x 128 samples");
/// assert!(waveform.sampled_bandwidth_hz() < 882.35e6);
/// assert!(waveform.range_resolution_m() > 0.17);
/// # Ok::<(), radome_dsp::WaveformError>(())
/// ```
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Waveform {
    /// Waveform that was requested.
    pub request: WaveformRequest,
    /// Slope of the ramp, Hz/s, on the grid of the ramp register.
    pub slope_hz_per_s: f64,
    /// Realised ADC rate, Hz.
    pub sample_rate_hz: f64,
    /// Realised chirp interval, s.
    pub chirp_interval_s: f64,
    /// Transmit frequency at the first sample of a chirp, Hz.
    pub sampled_start_frequency_hz: f64,
}

/// Error for a waveform that the chip cannot produce.
#[derive(Debug, Clone, PartialEq, Error)]
#[allow(missing_docs, reason = "the message says what each field is")]
pub enum WaveformError {
    /// A value of the [`WaveformRequest`], or the slope that follows from it, is out of the chip's range.
    #[error("waveform: {name} is {value} {unit}, allowed is {min} to {max} {unit}")]
    OutOfRange { name: &'static str, value: f64, min: f64, max: f64, unit: &'static str },
    /// The antenna list is empty, repeats one, or names one that the chip lacks.
    #[error("waveform: rx_antennas is {got:?}, expected one to three different numbers out of 1, 2, 3")]
    Antennas { got: Vec<u8> },
    /// The chirps do not fit between the start of two chirps or frames.
    #[error("waveform: {what} take {needed_s:.6} s, but {interval} is {given_s:.6} s; lengthen it or sample less")]
    DoesNotFit { what: &'static str, interval: &'static str, needed_s: f64, given_s: f64 },
}

/// Error for frames whose waveform differs too much from the one that is needed.
#[derive(Debug, Clone, PartialEq, Error)]
#[error(
    "waveforms differ in {what}: {expected} is needed, {got} was given\n\nhint: capture with the waveform that the model names, or train a model for this one"
)]
pub struct WaveformMismatch {
    /// Quantity that differs.
    pub what: &'static str,
    /// Value needed, with unit.
    pub expected: String,
    /// Value given, with unit.
    pub got: String,
}

fn check_range(
    name: &'static str,
    value: f64,
    (min, max): (f64, f64),
    unit: &'static str,
) -> Result<(), WaveformError> {
    // The negated form also refuses NaN.
    if !(value >= min && value <= max) {
        return Err(WaveformError::OutOfRange { name, value, min, max, unit });
    }
    Ok(())
}

impl Waveform {
    /// Longest chirp interval of a request, s.
    pub const LONGEST_CHIRP_INTERVAL_S: f64 = 1.0;
    /// Longest frame interval of a request, s.
    pub const LONGEST_FRAME_INTERVAL_S: f64 = 100.0;

    /// Checks a request and computes the values that the chip realises.
    ///
    /// # Errors
    /// - [`WaveformError::OutOfRange`] if a value of the request, or the slope that follows from it, is out of the chip's range.
    /// - [`WaveformError::DoesNotFit`] if the samples do not fit into the chirp interval, or the chirps into the frame interval.
    pub fn realise(request: WaveformRequest) -> Result<Self, WaveformError> {
        let r = &request;
        check_range("start_frequency_hz", r.start_frequency_hz, (RF_BAND_HZ.0, RF_BAND_HZ.1 - LEAST_BAND_HZ), "Hz")?;
        let end_limits_hz = (r.start_frequency_hz + LEAST_BAND_HZ, RF_BAND_HZ.1);
        check_range("end_frequency_hz", r.end_frequency_hz, end_limits_hz, "Hz")?;
        check_range("samples_per_chirp", r.samples_per_chirp as f64, (8.0, 4095.0), "samples")?;
        check_range("chirps_per_frame", r.chirps_per_frame as f64, (1.0, 4095.0), "chirps")?;
        let (divider_min, divider_max) = ADC_DIVIDER_RANGE;
        let rate_limits_hz = (REFERENCE_CLOCK_HZ / f64::from(divider_max), REFERENCE_CLOCK_HZ / f64::from(divider_min));
        check_range("sample_rate_hz", r.sample_rate_hz, rate_limits_hz, "Hz")?;
        check_range("tx_power_level", f64::from(r.tx_power_level), (0.0, 31.0), "(setting)")?;
        check_range("if_gain_db", r.if_gain_db, (18.0, 60.0), "dB")?;
        check_range("high_pass_cutoff_hz", r.high_pass_cutoff_hz, (20e3, 80e3), "Hz")?;
        check_range("anti_alias_cutoff_hz", r.anti_alias_cutoff_hz, (400e3, 700e3), "Hz")?;
        check_range("chirp_interval_s", r.chirp_interval_s, (1e-6, Self::LONGEST_CHIRP_INTERVAL_S), "s")?;
        check_range("frame_interval_s", r.frame_interval_s, (1e-6, Self::LONGEST_FRAME_INTERVAL_S), "s")?;

        let sample_rate_hz = REFERENCE_CLOCK_HZ / (REFERENCE_CLOCK_HZ / r.sample_rate_hz).round();
        let sampling_s = r.samples_per_chirp as f64 / sample_rate_hz;
        let requested_slope_hz_per_s = (r.end_frequency_hz - r.start_frequency_hz) / (sampling_s + ADC_START_DELAY_S);
        let slope_limits_hz_per_s = (SLOPE_STEP_HZ_PER_S, 400e12);
        check_range(
            "the slope by end_frequency_hz, samples_per_chirp and sample_rate_hz",
            requested_slope_hz_per_s,
            slope_limits_hz_per_s,
            "Hz/s",
        )?;
        let slope_hz_per_s = (requested_slope_hz_per_s / SLOPE_STEP_HZ_PER_S).round() * SLOPE_STEP_HZ_PER_S;
        let chirp_interval_s = (r.chirp_interval_s / CHIRP_INTERVAL_STEP_S).round() * CHIRP_INTERVAL_STEP_S;

        let needed_s = sampling_s + CHIRP_OVERHEAD_S;
        if needed_s > chirp_interval_s {
            return Err(WaveformError::DoesNotFit {
                what: "the samples of a chirp",
                interval: "chirp_interval_s",
                needed_s,
                given_s: chirp_interval_s,
            });
        }
        // The next frame may begin when the last chirp is over, before its interval is. The chip rounds the end of a
        // chirp by less than one step.
        let needed_s = (r.chirps_per_frame as f64 - 1.0) * chirp_interval_s + needed_s - CHIRP_INTERVAL_STEP_S;
        if needed_s > r.frame_interval_s {
            return Err(WaveformError::DoesNotFit {
                what: "the chirps of a frame",
                interval: "frame_interval_s",
                needed_s,
                given_s: r.frame_interval_s,
            });
        }
        let sampled_start_frequency_hz = r.start_frequency_hz + slope_hz_per_s * ADC_START_DELAY_S;
        Ok(Waveform { slope_hz_per_s, sample_rate_hz, chirp_interval_s, sampled_start_frequency_hz, request })
    }

    /// Shape of a frame: receivers, chirps and samples.
    pub fn shape(&self) -> FrameShape {
        FrameShape {
            rx: self.request.rx_antennas.count(),
            chirps: self.request.chirps_per_frame,
            samples: self.request.samples_per_chirp,
        }
    }

    /// Time from the start of one frame to the start of the next, s.
    pub fn frame_interval_s(&self) -> f64 {
        self.request.frame_interval_s
    }

    /// Time of a frame on a clock that starts with the first one, ns: frames come at their interval.
    pub fn frame_time_ns(&self, sequence: u64) -> u64 {
        (sequence as f64 * self.frame_interval_s() * 1e9).round() as u64
    }

    /// Band swept while samples are taken, Hz.
    pub fn sampled_bandwidth_hz(&self) -> f64 {
        self.slope_hz_per_s * self.request.samples_per_chirp as f64 / self.sample_rate_hz
    }

    /// Middle of the sampled band, Hz: the frequency of the velocity axis.
    pub fn centre_frequency_hz(&self) -> f64 {
        self.sampled_start_frequency_hz + 0.5 * self.sampled_bandwidth_hz()
    }

    /// Wavelength in the middle of the sampled band, m.
    pub fn wavelength_m(&self) -> f64 {
        SPEED_OF_LIGHT_M_PER_S / self.centre_frequency_hz()
    }

    /// Range resolution `c / 2B` of the sampled band, m: one bin of an unpadded range FFT.
    pub fn range_resolution_m(&self) -> f64 {
        SPEED_OF_LIGHT_M_PER_S / (2.0 * self.sampled_bandwidth_hz())
    }

    /// Range at which the beat reaches half the ADC rate, m.
    pub fn max_range_m(&self) -> f64 {
        0.5 * self.request.samples_per_chirp as f64 * self.range_resolution_m()
    }

    /// Range of one bin of a range FFT with `fft_length` points, m.
    pub fn range_step_m(&self, fft_length: usize) -> f64 {
        SPEED_OF_LIGHT_M_PER_S * self.sample_rate_hz / (2.0 * self.slope_hz_per_s * fft_length as f64)
    }

    /// Largest radial speed without ambiguity, m/s.
    pub fn max_velocity_m_per_s(&self) -> f64 {
        self.wavelength_m() / (4.0 * self.chirp_interval_s)
    }

    /// Velocity of one bin of a Doppler FFT over the chirps of a frame with `fft_length` points, m/s.
    pub fn velocity_step_m_per_s(&self, fft_length: usize) -> f64 {
        self.wavelength_m() / (2.0 * self.chirp_interval_s * fft_length as f64)
    }

    /// Velocity of one bin of a Doppler FFT over `fft_length` frames, m/s.
    pub fn slow_time_velocity_step_m_per_s(&self, fft_length: usize) -> f64 {
        self.wavelength_m() / (2.0 * self.frame_interval_s() * fft_length as f64)
    }

    /// Rate of packed 12-bit samples from the chip, bit/s.
    pub fn data_rate_bit_per_s(&self) -> f64 {
        self.shape().codes() as f64 * 12.0 / self.frame_interval_s()
    }

    /// Checks that frames of `self` can be given to a model that was trained on frames of `needed`.
    ///
    /// More receivers than needed are allowed.
    ///
    /// # Errors
    /// [`WaveformMismatch`] with the first quantity that differs: the number of chirps or samples, a missing receiver, a range
    /// step or an unambiguous velocity off by more than 1 %, or a frame interval off by more than 5 %.
    pub fn check_compatible(&self, needed: &Waveform) -> Result<(), WaveformMismatch> {
        let mismatch = |what, value_of: &dyn Fn(&Waveform) -> String| {
            Err(WaveformMismatch { what, expected: value_of(needed), got: value_of(self) })
        };
        let is_near = |quantity: &dyn Fn(&Waveform) -> f64, tolerance: f64| {
            (quantity(self) / quantity(needed) - 1.0).abs() <= tolerance
        };
        let size = |w: &Waveform| (w.request.chirps_per_frame, w.request.samples_per_chirp);
        if size(self) != size(needed) {
            return mismatch("map size", &|w| format!("{} chirps x {} samples", size(w).0, size(w).1));
        }
        if needed.request.rx_antennas.bits() & !self.request.rx_antennas.bits() != 0 {
            return mismatch("receivers", &|w| format!("{:?}", w.request.rx_antennas.antennas()));
        }
        if !is_near(&|w| w.range_resolution_m(), 0.01) {
            return mismatch("range step", &|w| format!("{:.4} m", w.range_resolution_m()));
        }
        if !is_near(&|w| w.velocity_step_m_per_s(1), 0.01) {
            return mismatch("unambiguous velocity span", &|w| format!("{:.4} m/s", w.velocity_step_m_per_s(1)));
        }
        if !is_near(&|w| w.frame_interval_s(), 0.05) {
            return mismatch("frame interval", &|w| format!("{:.4} s", w.frame_interval_s()));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn vendor_default() -> Waveform {
        Waveform::realise(WaveformRequest {
            start_frequency_hz: 58e9,
            end_frequency_hz: 63e9,
            samples_per_chirp: 64,
            chirps_per_frame: 64,
            sample_rate_hz: 2e6,
            ..WaveformRequest::paper()
        })
        .expect("valid")
    }

    /// Register dump of the vendor's default list: RSU 0x0B64, sampled band 58.441..62.998 GHz = 4.556 GHz.
    #[test]
    fn sampled_band_of_the_vendor_default_is_narrower_than_requested() {
        let w = vendor_default();
        assert_eq!((w.slope_hz_per_s / SLOPE_STEP_HZ_PER_S).round() as u32, 0x0B64);
        assert!((w.sampled_bandwidth_hz() - 4.556e9).abs() < 1e6);
        assert!((w.sampled_start_frequency_hz - 58.441e9).abs() < 3e6);
    }

    /// The recording of a breathing person: 58-63.5 GHz, 64 samples at 2 MHz, bins of 29.9 mm up to 0.957 m.
    #[test]
    fn axes_of_a_real_recording_follow_the_sampled_band() {
        let request = WaveformRequest { end_frequency_hz: 63.5e9, ..vendor_default().request };
        let w = Waveform::realise(request).expect("valid");
        assert!((w.range_resolution_m() - 0.0299).abs() < 5e-5, "{}", w.range_resolution_m());
        assert!((w.max_range_m() - 0.957).abs() < 1e-3, "{}", w.max_range_m());
    }

    #[test]
    fn a_subset_of_antennas_keeps_the_first_ones() {
        let some = RxMask::from_antennas(&[1, 3]).expect("antennas");
        assert_eq!([0, 1, 5].map(|index| some.up_to(index).antennas()), [vec![1], vec![1, 3], vec![1, 3]]);
        assert_eq!(RxMask::ALL.up_to(1).antennas(), [1, 2]);
    }

    #[test]
    fn paper_waveform_is_realised_within_one_percent() {
        let w = Waveform::realise(WaveformRequest::paper()).expect("valid");
        assert!((w.range_resolution_m() / 0.17 - 1.0).abs() < 0.02);
        assert!((w.max_velocity_m_per_s() - 2.5).abs() < 0.01);
        // Slope as requested (band over sampling plus delay) against the register's grid: about half a percent here.
        let wanted = 882.35e6 / (256e-6 + ADC_START_DELAY_S);
        let deviation = (w.slope_hz_per_s / wanted - 1.0).abs();
        assert!(deviation > 0.001 && deviation < 0.01, "{deviation}");
    }

    mod hard_cases {
        use super::*;

        /// The registers realise frames that end with the last chirp, without the rest of its interval.
        #[test]
        fn the_rest_of_the_last_chirp_is_not_part_of_the_frame() {
            // 128 chirps take 64 ms; the last of them needs 264 us of its 500 us.
            let paper = WaveformRequest::paper();
            let with = |frame_interval_s| Waveform::realise(WaveformRequest { frame_interval_s, ..paper.clone() });
            assert!(with(0.0638).is_ok());
            let error = with(0.0637).expect_err("the last chirp is cut short").to_string();
            assert!(error.contains("the chirps of a frame take 0.06376"), "{error}");
        }

        #[test]
        fn values_out_of_range_name_field_and_interval() {
            let request = WaveformRequest { sample_rate_hz: f64::NAN, ..WaveformRequest::paper() };
            let message = Waveform::realise(request).expect_err("NaN").to_string();
            assert!(message.contains("sample_rate_hz") && message.contains("4000000"), "{message}");
            let request = WaveformRequest { chirp_interval_s: 200e-6, ..WaveformRequest::paper() };
            let message = Waveform::realise(request).expect_err("too short").to_string();
            assert!(message.contains("chirp_interval_s"), "{message}");
            // The end would have had to be above 63.601 and below 63.6 GHz.
            let request =
                WaveformRequest { start_frequency_hz: 63.6e9, end_frequency_hz: 63.6e9, ..WaveformRequest::paper() };
            let message = Waveform::realise(request).expect_err("no band").to_string();
            assert!(message.contains("start_frequency_hz") && message.contains("to 63599000000 Hz"), "{message}");
            let request = WaveformRequest { samples_per_chirp: 8, sample_rate_hz: 4e6, ..WaveformRequest::paper() };
            let request = WaveformRequest { end_frequency_hz: 63e9, ..request };
            let message = Waveform::realise(request).expect_err("too steep").to_string();
            assert!(message.contains("end_frequency_hz") && message.contains("samples_per_chirp"), "{message}");
        }

        #[test]
        fn antennas_are_checked() {
            for bad in [&[][..], &[4], &[1, 1], &[0]] {
                assert!(RxMask::from_antennas(bad).is_err(), "{bad:?}");
            }
        }
    }
}
