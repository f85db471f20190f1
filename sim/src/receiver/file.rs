//! Receiver files: every constant of one radar chip, in ADC units, with datasheet typicals as defaults.
//!
//! The TOML schema is this module's structs; each field's doc states unit, default and source. A table that is left out
//! is filled with its defaults; an unknown key is an error. Levels are in LSB: one step of the 12-bit ADC.

use std::f64::consts::TAU;

use radome_dsp::Waveform;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Version of the schema that this crate reads and writes.
pub const RECEIVER_FORMAT: u32 = 1;

/// Constants of one chip with its package and antennas.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Receiver {
    /// Version of the schema: 1.
    pub format: u32,
    /// Short name, for messages and provenance.
    pub name: String,
    /// Source of the numbers: a datasheet, or the recording that they were fitted to.
    #[serde(default)]
    pub measured_from: String,
    /// Conducted transmit power at power level 31, dBm. Default 4 (datasheet V2.4.9 table 55: 1..8).
    #[serde(default = "default_transmit_power_dbm")]
    pub transmit_power_dbm: f64,
    /// Loss of transmit power for each power level below 31, dB. Default 15/31 (15 dB over the DAC's range).
    #[serde(default = "default_transmit_power_step_db")]
    pub transmit_power_step_db: f64,
    /// Power-to-voltage conversion gain from antenna port to IF chain, dB (50 ohm). Default 14 (12..16).
    #[serde(default = "default_conversion_gain_db")]
    pub conversion_gain_db: f64,
    /// Single-sideband noise figure, dB. Default 12.
    #[serde(default = "default_noise_figure_db")]
    pub noise_figure_db: f64,
    /// Input range of the ADC over its 4096 codes, V. Default 1.31 (0.145..1.455 V).
    #[serde(default = "default_adc_full_scale_v")]
    pub adc_full_scale_v: f64,
    /// Correction that a calibration adds to every echo's level, dB. Default 0. Noise and leakage do not change with it.
    #[serde(default)]
    pub gain_correction_db: f64,
    /// Factor from nominal to true high-pass cutoff. Default 1 (the datasheet allows 0.6..1.4).
    #[serde(default = "one")]
    pub high_pass_cutoff_scale: f64,
    /// Factor from nominal to true anti-alias cutoff. Default 1 (450..650 kHz about 500 kHz).
    #[serde(default = "one")]
    pub anti_alias_cutoff_scale: f64,
    /// Antennas.
    #[serde(default)]
    pub antenna: Antenna,
    /// Noise at the ADC.
    #[serde(default)]
    pub noise: Noise,
    /// Phase noise of the transmitter. None if absent: most of it cancels, being in the echo as in what it is mixed with.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub phase_noise: Option<PhaseNoise>,
    /// Variation of static echoes over time.
    #[serde(default)]
    pub clutter: ClutterDrift,
    /// Slow changes of the offset.
    #[serde(default)]
    pub drift: OffsetDrift,
    /// One table a physical receiver, RX1 first. Fewer than three: the missing ones are typical.
    #[serde(default = "typical_channels")]
    pub rx: Vec<RxChannel>,
}

/// Antenna elements: gain on boresight and one-way half-power beamwidths of a separable `cos^q` power pattern.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Antenna {
    /// Transmit gain on boresight, dBi. Default 3.5 (2..5).
    pub tx_gain_dbi: f64,
    /// Receive gain on boresight, dBi. Default 3.5 (2..5).
    pub rx_gain_dbi: f64,
    /// One-way half-power beamwidth in azimuth (the radar's own horizontal plane), degrees. Default 30.5.
    pub azimuth_beamwidth_deg: f64,
    /// One-way half-power beamwidth in elevation, degrees. Default 60.5. It is that of the pattern alone. At each antenna the
    /// projection of the vertical polarisation across a path also multiplies its field by the cosine of the elevation, so that
    /// the default makes paths lose half their power within 51 degrees. Diffuse echoes have the pattern alone.
    pub elevation_beamwidth_deg: f64,
    /// Power pattern never falls below this, relative to boresight, one way, dB: side and back lobes. Default -25.
    pub side_lobe_floor_db: f64,
}

/// Noise at the ADC, as power spectral density in LSB^2 per sample: white noise of variance v has density v at every
/// frequency, and the mean over all frequencies is the variance of a sample. Rounding (1/12 LSB^2) is contained.
///
/// ```text
/// density(f) = adc_white^2 + (baseband_white^2 + thermal (|HPF|^2 + (amplifier_flicker_corner/f)^e)) |AAF|^2
///     + flicker_at_100khz (100 kHz / f)^e
/// ```
///
/// Thermal follows from noise figure, conversion gain and IF gain; what lies above half the
/// sample rate folds.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Noise {
    /// White noise of ADC and rounding, after the anti-alias filter, whatever the gain, LSB rms. Default 0.85.
    pub adc_white_lsb: f64,
    /// White noise ahead of the anti-alias filter, whatever the gain, LSB rms. Default 0.65.
    pub baseband_white_lsb: f64,
    /// Density of the 1/f noise at 100 kHz, whatever the gain, LSB^2. Default 0.37.
    pub flicker_lsb2_at_100khz: f64,
    /// Exponent e of all 1/f noise. Default 1.1.
    pub flicker_exponent: f64,
    /// Frequency at which the 1/f noise of the amplifiers behind the high-pass equals thermal noise, Hz. Default 75 kHz.
    pub amplifier_flicker_corner_hz: f64,
    /// Spurious tones at the ADC ([`super::spurs`]): their frequencies, levels and phases are drawn for each seed. Default 0, at
    /// most 32.
    pub spurs: usize,
    /// Peak level of the strongest spurious tone, LSB; others are drawn up to 20 dB below. Default 1.
    pub spur_lsb: f64,
    /// Phase of all of them from chirp to chirp: "locked", "free" or "random". Drawn for each if absent.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub spur_phase: Option<SpurPhase>,
    /// Measured density for each fast-time bin 0..=N/2, LSB^2. Replaces the whole model for waveforms whose number of
    /// samples is `2 (length - 1)`; for others the model holds. Valid at the gain at which it was measured.
    pub psd_lsb2: Option<Vec<f64>>,
}

/// Phase of a spurious tone from chirp to chirp.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum SpurPhase {
    /// The same in every chirp, as of a clock from which the chirps are timed: it has no Doppler.
    Locked,
    /// Runs on between chirps, as of a clock of its own: it has one Doppler.
    Free,
    /// Anew in every chirp, as of a source that starts with it: it has all Dopplers.
    Random,
}

/// Phase noise of the transmitter, which falls with the square of the offset from the carrier, as a free oscillator's does.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct PhaseNoise {
    /// Power in a hertz on one side of the carrier, relative to it, dBc/Hz. The chip's is -80, at most -75, at 100 kHz
    /// (datasheet V2.4.9 table 54).
    pub level_dbc_per_hz: f64,
    /// Offset from the carrier at which that holds, Hz. Default 100 kHz.
    #[serde(default = "hundred_khz")]
    pub offset_hz: f64,
}

fn hundred_khz() -> f64 {
    1e5
}

/// Deviations of one receive channel and what it sees with nothing in front of it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct RxChannel {
    /// ADC code that no signal gives. Default 2048.
    pub dc_code: f64,
    /// Deviation of the channel's signal gain, dB. Default 0.
    pub gain_db: f64,
    /// Deviation of the channel's noise, dB. Default 0.
    pub noise_db: f64,
    /// Measured density of this channel's noise for each fast-time bin 0..=N/2, LSB^2: as [`Noise::psd_lsb2`], and before it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub psd_lsb2: Option<Vec<f64>>,
    /// TX-to-RX leakage as tones.
    pub leakage: Vec<Leakage>,
    /// Settling at the start of each chirp as exponentials.
    pub transient: Vec<Transient>,
}

/// One leakage path: adds `amplitude_lsb cos(2 pi slope delay t + phase_rad)`, t from the first sample of each chirp.
/// Levels are as seen at the ADC, whatever the IF gain (real chips show about the same span at 23 and at 48 dB).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Leakage {
    /// Delay, s.
    pub delay_s: f64,
    /// Peak level at the ADC, LSB.
    pub amplitude_lsb: f64,
    /// Phase at the first sample of a chirp, rad.
    #[serde(default)]
    pub phase_rad: f64,
}

impl Leakage {
    /// Phase at a time after the first sample of a chirp, rad.
    pub fn phase_at_rad(&self, waveform: &Waveform, time_s: f64) -> f64 {
        TAU * (waveform.slope_hz_per_s * self.delay_s * time_s) + self.phase_rad
    }
}

/// One exponential: adds `amplitude_lsb exp(-t / time_constant_s)`, t from the first sample of each chirp.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Transient {
    /// Level at the first sample, LSB, of either sign.
    pub amplitude_lsb: f64,
    /// Time constant, s.
    pub time_constant_s: f64,
}

/// Variation of static echoes over time (real recordings: jitter 20..60 mrad between frames, drift 0.1..0.6 rad in
/// ten seconds, amplitude 0.6..4 %, and now and then a step of 0.6 rad). Keys whose default is 0 and that act within a frame change
/// all echoes alike, those of people too.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ClutterDrift {
    /// Standard deviation of an echo's phase from frame to frame, rad. Default 0.03. Of this and of the drift half of the power
    /// is common to all echoes: were each echo's its own, those that share a range bin would beat by more than 4 % of their
    /// amplitude.
    pub phase_jitter_rad: f64,
    /// Typical change of an echo's phase over ten seconds, rad. Default 0.3.
    pub phase_drift_rad_per_10s: f64,
    /// Standard deviation of an echo's amplitude from frame to frame, relative. Default 0.01.
    pub amplitude_jitter: f64,
    /// Typical step of an echo's phase when something has been touched, rad: all echoes step at once, each by its own amount.
    /// Default 0, for none.
    pub phase_step_rad: f64,
    /// Mean time between such steps, s. Default 60.
    pub phase_step_interval_s: f64,
    /// Typical change of the receiver's gain over ten seconds, relative: of all echoes alike. Default 0.
    pub gain_drift_per_10s: f64,
    /// Phase of all echoes at the start of each frame, over that at its end, rad, of either sign: a chip that sleeps between
    /// frames settles within each. It decays with `settling_time_s`. Default 0.
    pub settling_phase_rad: f64,
    /// Amplitude of all echoes at the start of each frame, relative to that at its end, less 1. Default 0.
    pub settling_gain: f64,
    /// Transmit frequency at the start of each frame, over that at its end, Hz: echoes turn by `2 pi` times this and their
    /// delay, 0.06 rad at 3 m and 500 kHz. Default 0.
    pub settling_frequency_hz: f64,
    /// Time constant of all three, s. Default 0.01.
    pub settling_time_s: f64,
    /// Standard deviation of the time at which a chirp is sampled, s: echoes turn by `2 pi` times this and their beat frequency.
    /// Default 0.
    pub chirp_jitter_s: f64,
    /// Standard deviation of the leakage's amplitude from frame to frame, relative. Default 0.0005.
    pub leakage_jitter: f64,
    /// Typical change of the leakage's amplitude over ten seconds, relative. Default 0.003.
    pub leakage_drift_per_10s: f64,
}

/// Slow changes of the offset.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct OffsetDrift {
    /// Steady drift of the offset, LSB/s. Default 0.08 (43 LSB in nine minutes).
    pub dc_lsb_per_s: f64,
    /// The drift stops at this distance from its start, LSB, and turns back. Default 60.
    pub dc_limit_lsb: f64,
    /// Standard deviation of the offset from frame to frame, LSB. Default 0.3.
    pub dc_jitter_lsb: f64,
}

fn default_transmit_power_dbm() -> f64 {
    4.0
}
fn default_transmit_power_step_db() -> f64 {
    15.0 / 31.0
}
fn default_conversion_gain_db() -> f64 {
    14.0
}
fn default_noise_figure_db() -> f64 {
    12.0
}
fn default_adc_full_scale_v() -> f64 {
    1.31
}
fn one() -> f64 {
    1.0
}

/// Offsets and leakage that are similar to recordings of this chip at 64 samples and 2 MHz.
fn typical_channels() -> Vec<RxChannel> {
    let channel = |dc_code, leakage_lsb, phase_rad, transient_lsb| RxChannel {
        dc_code,
        leakage: vec![Leakage { delay_s: 0.25e-9, amplitude_lsb: leakage_lsb, phase_rad }],
        transient: vec![Transient { amplitude_lsb: transient_lsb, time_constant_s: 6e-6 }],
        ..RxChannel::default()
    };
    vec![channel(1620.0, 90.0, 2.1, 320.0), channel(1945.0, 60.0, 1.4, -220.0), channel(2045.0, 40.0, -0.6, 140.0)]
}

impl Default for Antenna {
    fn default() -> Self {
        Antenna {
            tx_gain_dbi: 3.5,
            rx_gain_dbi: 3.5,
            azimuth_beamwidth_deg: 30.5,
            elevation_beamwidth_deg: 60.5,
            side_lobe_floor_db: -25.0,
        }
    }
}

impl Default for Noise {
    fn default() -> Self {
        Noise {
            adc_white_lsb: 0.85,
            baseband_white_lsb: 0.65,
            flicker_lsb2_at_100khz: 0.37,
            flicker_exponent: 1.1,
            amplifier_flicker_corner_hz: 75e3,
            spurs: 0,
            spur_lsb: 1.0,
            spur_phase: None,
            psd_lsb2: None,
        }
    }
}

impl Default for RxChannel {
    fn default() -> Self {
        RxChannel {
            dc_code: 2048.0,
            gain_db: 0.0,
            noise_db: 0.0,
            psd_lsb2: None,
            leakage: Vec::new(),
            transient: Vec::new(),
        }
    }
}

impl Default for ClutterDrift {
    fn default() -> Self {
        ClutterDrift {
            phase_jitter_rad: 0.03,
            phase_drift_rad_per_10s: 0.3,
            amplitude_jitter: 0.01,
            phase_step_rad: 0.0,
            phase_step_interval_s: 60.0,
            gain_drift_per_10s: 0.0,
            settling_phase_rad: 0.0,
            settling_gain: 0.0,
            settling_frequency_hz: 0.0,
            settling_time_s: 0.01,
            chirp_jitter_s: 0.0,
            leakage_jitter: 0.0005,
            leakage_drift_per_10s: 0.003,
        }
    }
}

impl Default for OffsetDrift {
    fn default() -> Self {
        OffsetDrift { dc_lsb_per_s: 0.08, dc_limit_lsb: 60.0, dc_jitter_lsb: 0.3 }
    }
}

/// A constant that is not valid.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct InvalidConstant {
    /// Key of the constant.
    pub key: &'static str,
    /// Value that was given.
    pub value: String,
    /// Description of the allowed values.
    pub expected: String,
}

impl Receiver {
    /// Receiver with typical values of the datasheet.
    pub fn typical() -> Self {
        Receiver {
            format: RECEIVER_FORMAT,
            name: "typical".to_owned(),
            measured_from: "datasheet typicals".to_owned(),
            transmit_power_dbm: default_transmit_power_dbm(),
            transmit_power_step_db: default_transmit_power_step_db(),
            conversion_gain_db: default_conversion_gain_db(),
            noise_figure_db: default_noise_figure_db(),
            adc_full_scale_v: default_adc_full_scale_v(),
            gain_correction_db: 0.0,
            high_pass_cutoff_scale: 1.0,
            anti_alias_cutoff_scale: 1.0,
            antenna: Antenna::default(),
            noise: Noise::default(),
            phase_noise: None,
            clutter: ClutterDrift::default(),
            drift: OffsetDrift::default(),
            rx: typical_channels(),
        }
    }

    /// Returns the key, value, least and greatest allowed value of each constant.
    fn constants_with_ranges(&self) -> [(&'static str, f64, f64, f64); 36] {
        let (antenna, noise, clutter, drift) = (&self.antenna, &self.noise, &self.clutter, &self.drift);
        [
            ("transmit_power_dbm", self.transmit_power_dbm, -60.0, 60.0),
            ("transmit_power_step_db", self.transmit_power_step_db, 0.0, 10.0),
            ("conversion_gain_db", self.conversion_gain_db, -60.0, 60.0),
            ("noise_figure_db", self.noise_figure_db, 0.0, 60.0),
            ("adc_full_scale_v", self.adc_full_scale_v, 1e-3, 100.0),
            ("gain_correction_db", self.gain_correction_db, -60.0, 60.0),
            ("high_pass_cutoff_scale", self.high_pass_cutoff_scale, 0.1, 10.0),
            ("anti_alias_cutoff_scale", self.anti_alias_cutoff_scale, 0.1, 10.0),
            ("tx_gain_dbi", antenna.tx_gain_dbi, -40.0, 60.0),
            ("rx_gain_dbi", antenna.rx_gain_dbi, -40.0, 60.0),
            ("azimuth_beamwidth_deg", antenna.azimuth_beamwidth_deg, 1.0, 179.0),
            ("elevation_beamwidth_deg", antenna.elevation_beamwidth_deg, 1.0, 179.0),
            ("side_lobe_floor_db", antenna.side_lobe_floor_db, -200.0, 0.0),
            ("adc_white_lsb", noise.adc_white_lsb, 0.0, 1e3),
            ("baseband_white_lsb", noise.baseband_white_lsb, 0.0, 1e3),
            ("flicker_lsb2_at_100khz", noise.flicker_lsb2_at_100khz, 0.0, 1e6),
            ("flicker_exponent", noise.flicker_exponent, 0.0, 3.0),
            ("amplifier_flicker_corner_hz", noise.amplifier_flicker_corner_hz, 0.0, 1e7),
            ("spurs", noise.spurs as f64, 0.0, 32.0),
            ("spur_lsb", noise.spur_lsb, 0.0, 1e3),
            ("phase_jitter_rad", clutter.phase_jitter_rad, 0.0, 10.0),
            ("phase_drift_rad_per_10s", clutter.phase_drift_rad_per_10s, 0.0, 100.0),
            ("amplitude_jitter", clutter.amplitude_jitter, 0.0, 1.0),
            ("phase_step_rad", clutter.phase_step_rad, 0.0, 10.0),
            ("phase_step_interval_s", clutter.phase_step_interval_s, 0.1, 1e6),
            ("gain_drift_per_10s", clutter.gain_drift_per_10s, 0.0, 0.5),
            ("settling_phase_rad", clutter.settling_phase_rad, -10.0, 10.0),
            ("settling_gain", clutter.settling_gain, -1.0, 1.0),
            ("settling_frequency_hz", clutter.settling_frequency_hz, -1e8, 1e8),
            ("settling_time_s", clutter.settling_time_s, 1e-5, 10.0),
            ("chirp_jitter_s", clutter.chirp_jitter_s, 0.0, 1e-7),
            ("leakage_jitter", clutter.leakage_jitter, 0.0, 1.0),
            ("leakage_drift_per_10s", clutter.leakage_drift_per_10s, 0.0, 1.0),
            ("dc_lsb_per_s", drift.dc_lsb_per_s, -1e3, 1e3),
            ("dc_limit_lsb", drift.dc_limit_lsb, 0.0, 4096.0),
            ("dc_jitter_lsb", drift.dc_jitter_lsb, 0.0, 1e3),
        ]
    }

    /// Returns the first constant that is not valid.
    pub fn first_invalid(&self) -> Option<InvalidConstant> {
        let invalid =
            |key, value: String, expected: &str| Some(InvalidConstant { key, value, expected: expected.to_owned() });
        if self.format != RECEIVER_FORMAT {
            return invalid("format", self.format.to_string(), "format = 1, the only version that this program reads");
        }
        for (key, value, min, max) in self.constants_with_ranges() {
            if !(value >= min && value <= max) {
                return invalid(key, value.to_string(), &format!("a physical value, {min} to {max}"));
            }
        }
        if let Some(PhaseNoise { level_dbc_per_hz, offset_hz }) = self.phase_noise {
            if !(-300.0..=-20.0).contains(&level_dbc_per_hz) {
                return invalid("level_dbc_per_hz", level_dbc_per_hz.to_string(), "-300 to -20 dBc/Hz");
            }
            if !(1.0..=1e9).contains(&offset_hz) {
                return invalid("offset_hz", offset_hz.to_string(), "1 to 1e9 Hz");
            }
        }
        if self.rx.is_empty() || self.rx.len() > 3 {
            return invalid("rx", self.rx.len().to_string(), "one to three [[rx]] tables");
        }
        for rx in &self.rx {
            if !(rx.dc_code >= 0.0 && rx.dc_code <= 4095.0) {
                return invalid("dc_code", rx.dc_code.to_string(), "a code from 0 to 4095");
            }
            if !(rx.gain_db.abs() <= 60.0 && rx.noise_db.abs() <= 60.0) {
                return invalid("gain_db", format!("{} / {}", rx.gain_db, rx.noise_db), "at most 60 dB either way");
            }
            for l in &rx.leakage {
                if !(l.delay_s >= 0.0 && l.delay_s < 1e-6 && l.amplitude_lsb.is_finite() && l.phase_rad.is_finite()) {
                    return invalid("leakage", format!("{l:?}"), "delay 0..1e-6 s, finite amplitude and phase");
                }
            }
            for t in &rx.transient {
                if !(t.amplitude_lsb.is_finite() && t.time_constant_s > 0.0 && t.time_constant_s.is_finite()) {
                    return invalid("transient", format!("{t:?}"), "finite amplitude, positive time constant");
                }
            }
        }
        for psd in self.rx.iter().map(|rx| &rx.psd_lsb2).chain([&self.noise.psd_lsb2]).flatten() {
            if psd.len() < 5 || psd.iter().any(|v| !(*v >= 0.0 && *v < 1e9)) {
                return invalid("psd_lsb2", format!("{} values", psd.len()), "N/2 + 1 finite densities of at least 0");
            }
        }
        None
    }
}
