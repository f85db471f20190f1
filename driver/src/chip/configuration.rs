//! Waveform to register list and back.
//!
//! The list has the vendor's 38 registers in the vendor's order. The vendor's default (58-63 GHz, 64 samples, 64 chirps,
//! three receivers, 2 MS/s, 23 dB) compiles to exactly the list captured on the wire.
//!
//! # Derived from the waveform
//! `ADC_DIV`, `CREF` (from the slice), receivers (`CS1_U_0`, `BBCH_SEL`), `TX1_DAC`, gain and high-pass (`CS1_U_2`),
//! `FSU`, `RSU`, `RTU`, `APU`, `FRAME_LEN`, `T_SED` (chirp interval) and `TFED` (frame interval). In units of the 80 MHz
//! clock:
//! - a ramp starts `8 TMRSTRT + 10 = 90` cycles into the chirp, the transmitter goes on at `8 T_PAEN = 240`: the ramp
//!   starts 150 cycles (1.875 us) early, so `FSU` lies `150 RSU` below the requested start. Sampling starts
//!   `8 T_SSTRT + 1 = 249` cycles after the transmitter;
//! - `RTU` is the time from ramp start to the last sample, rounded up to 8 cycles;
//! - a chirp lasts `90 + 8 RTU + 8 TMREND + INIT0 + INIT1 + 8 T_SED 2^T_SED_MUL + 32` cycles. The last number gathers
//!   the state machine's overheads and is fitted to the captured list (591.125 us);
//! - a frame lasts its chirps, less the end delay of the last one, plus `8 TFED 2^TFED_MUL` and the wake-up. This
//!   gives the captured list's 77.269 ms within 26 us, which is what `TFED` can resolve at that length.
//!
//! Both delays are an 8-bit mantissa and an exponent: the nearest representable one is taken, and of equal ones that
//! with the largest exponent, as the vendor's library does. Chirp intervals are thus coarser than 8 cycles: up to
//! 0.4 % of the end delay off.
//!
//! # Fixed as in the captured list
//! Wake-up 1 ms, `INIT0` 45 us, `INIT1` 7 us, PA delay 3 us, ADC delay, baseband reset, post-chirp delay 1.4 us, PLL
//! and ADC trims.
//!
//! # Not confirmed by any capture
//! - Receivers that are off get no mixer, no baseband channel and zero gain fields.
//! - `HP_GAIN` 0 stands for 30 dB (the capture has 7 for 18 dB in all channels).
//! - If the chirp interval leaves no room for `INIT0` and `INIT1` the chip stays active between chirps (`PD_MODE` 0);
//!   if the frame interval leaves none for the wake-up it idles between frames (`PD_MODE` 1).
//! - The anti-alias filter is not programmed: the list has no field for it.

use radome_dsp::{ADC_START_DELAY_S, REFERENCE_CLOCK_HZ, RxMask, SLOPE_STEP_HZ_PER_S, Waveform, WaveformRequest};
use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::RegisterFile;
use super::address::*;
use crate::protocol::strata::SpiWord;

/// One step of FSU, Hz: `640 MHz / 2^20`.
const FREQUENCY_STEP_HZ: f64 = 640e6 / 1_048_576.0;
/// Frequency at FSU = 0 with DIVSET 20, Hz.
const FREQUENCY_ORIGIN_HZ: f64 = 640e6 * 96.0;
/// Cycles from the start of a chirp to that of its ramp (TMRSTRT 10).
const RAMP_START_CYCLES: u64 = 8 * 10 + 10;
/// Cycles from the start of a chirp to TX-on (T_PAEN 30).
const TX_ON_CYCLES: u64 = 8 * 30;
/// Cycles from TX-on to the first sample (T_SSTRT 31).
const ADC_DELAY_CYCLES: u64 = 8 * 31 + 1;
/// Cycles after the ramp (TMREND 14).
const POST_CHIRP_CYCLES: u64 = 8 * 14;
/// Cycles to come back from idle: INIT0 and INIT1.
const INIT_CYCLES: u64 = 8 * 225 * 2 + 8 * 70;
/// Overheads of the state machine in each chirp.
const CHIRP_OVERHEAD_CYCLES: u64 = 32;
/// Cycles to come back from deep sleep (TWKUP 39, TWKUP_MUL 8).
const WAKE_UP_CYCLES: u64 = 8 * 39 * 256;
/// Cutoffs of HPF_SEL 0 to 3, Hz.
const HIGH_PASS_HZ: [f64; 4] = [20e3, 40e3, 70e3, 80e3];

/// Registers and contents, in the order of writing; the last one, MAIN, starts frames.
pub type RegisterList = Vec<RegisterValue>;

/// A register and what it is to hold.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct RegisterValue {
    /// Address, 0..=0x7F.
    pub address: u8,
    /// 24-bit content.
    pub value: u32,
}

impl From<RegisterValue> for SpiWord {
    fn from(register: RegisterValue) -> Self {
        SpiWord::write(register.address, register.value)
    }
}

/// A waveform that the registers cannot hold, or registers that hold no waveform.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum ChipError {
    /// A register field overflows.
    #[error("chip: {field} would be {value}, the register holds {min} to {max}; change {hint}")]
    FieldRange {
        /// Register field.
        field: &'static str,
        /// Value needed.
        value: i64,
        /// Smallest possible.
        min: i64,
        /// Largest possible.
        max: i64,
        /// Quantity of the waveform that it comes from.
        hint: &'static str,
    },
    /// The interval is shorter than what happens in it.
    #[error("chip: {what} takes {needed_s:.7} s at least, {given_s:.7} s were asked for")]
    TooShort {
        /// Chirp or frame.
        what: &'static str,
        /// Time needed, s.
        needed_s: f64,
        /// Time given, s.
        given_s: f64,
    },
    /// The registers hold something that no waveform of this program stands for.
    #[error("chip: registers cannot be read as a waveform: {reason}")]
    NotAWaveform {
        /// What is wrong.
        reason: String,
    },
}

/// What the chip is told: a waveform and how full the FIFO may get before it calls.
#[derive(Debug, Clone, PartialEq)]
pub struct ChipConfiguration {
    /// What is transmitted and sampled.
    pub waveform: Waveform,
    /// Codes at which the chip calls for the FIFO to be read, even.
    pub slice_samples: usize,
}

/// Mantissa and exponent of a delay: value `mantissa << exponent` in units of 8 cycles.
fn delay(units: f64, max_exponent: u32) -> (u32, u32) {
    let mut best = (0, 0, f64::INFINITY);
    for exponent in 0..=max_exponent {
        let mantissa = (units / f64::from(1u32 << exponent)).round().clamp(0.0, 255.0);
        let error = (mantissa * f64::from(1u32 << exponent) - units).abs();
        if error <= best.2 {
            best = (mantissa as u32, exponent, error);
        }
    }
    // A delay of nothing is written as nothing.
    if best.0 == 0 { (0, 0) } else { (best.0, best.1) }
}

fn fits(field: &'static str, value: i64, (min, max): (i64, i64), hint: &'static str) -> Result<u32, ChipError> {
    if value < min || value > max {
        return Err(ChipError::FieldRange { field, value, min, max, hint });
    }
    Ok((value & 0xFF_FFFF) as u32)
}

/// RTU and ADC_DIV of a waveform.
fn ramp(waveform: &Waveform) -> (u64, u64) {
    let divider = (REFERENCE_CLOCK_HZ / waveform.sample_rate_hz).round() as u64;
    let sampling = divider * waveform.request.samples_per_chirp as u64;
    ((TX_ON_CYCLES + ADC_DELAY_CYCLES - RAMP_START_CYCLES + sampling).div_ceil(8), divider)
}

fn active_cycles(rtu: u64) -> u64 {
    RAMP_START_CYCLES + 8 * rtu + POST_CHIRP_CYCLES + CHIRP_OVERHEAD_CYCLES
}

impl ChipConfiguration {
    /// The 38 registers, in the vendor's order.
    pub fn compile(&self) -> Result<RegisterList, ChipError> {
        let w = &self.waveform;
        let r = &w.request;
        let rsu = (w.slope_hz_per_s / SLOPE_STEP_HZ_PER_S).round() as i64;
        let start = ((r.start_frequency_hz - FREQUENCY_ORIGIN_HZ) / FREQUENCY_STEP_HZ).round() as i64;
        let fsu = start - rsu * (TX_ON_CYCLES - RAMP_START_CYCLES) as i64;
        let (rtu, divider) = ramp(w);

        let fsu = fits("FSU", fsu, (-(1 << 23), (1 << 23) - 1), "start_frequency_hz")?;
        let rsu = fits("RSU", rsu, (1, (1 << 23) - 1), "end_frequency_hz or samples_per_chirp")?;
        let rtu_field = fits("RTU", rtu as i64, (1, (1 << 14) - 1), "samples_per_chirp or sample_rate_hz")?;
        let divider = fits("ADC_DIV", divider as i64, (20, 1023), "sample_rate_hz")?;
        let apu = fits("APU", r.samples_per_chirp as i64, (1, 4095), "samples_per_chirp")?;
        let frame_len = fits("FRAME_LEN", r.chirps_per_frame as i64 - 1, (0, 4095), "chirps_per_frame")?;
        let cref = fits("FIFO_CREF", (self.slice_samples / 2) as i64 - 1, (0, 8191), "the slice")?;

        let chirp = w.chirp_interval_s * REFERENCE_CLOCK_HZ;
        let active = active_cycles(rtu);
        let (chirp_power_mode, used) =
            if chirp >= (active + INIT_CYCLES) as f64 { (1, active + INIT_CYCLES) } else { (0, active) };
        if chirp + 4.0 < used as f64 {
            let needed_s = used as f64 / REFERENCE_CLOCK_HZ;
            return Err(ChipError::TooShort { what: "a chirp", needed_s, given_s: w.chirp_interval_s });
        }
        let (sed, sed_mul) = delay((chirp - used as f64) / 8.0, 16);
        let chirps = (used + (u64::from(sed) << sed_mul) * 8) * r.chirps_per_frame as u64;

        let frame = r.frame_interval_s * REFERENCE_CLOCK_HZ;
        let chirps = (chirps - (u64::from(sed) << sed_mul) * 8) as f64;
        let (frame_power_mode, rest) = match frame - chirps - WAKE_UP_CYCLES as f64 {
            rest if rest >= 0.0 => (2, rest),
            _ => (1, frame - chirps),
        };
        if rest < -8.0 {
            let needed_s = chirps / REFERENCE_CLOCK_HZ;
            return Err(ChipError::TooShort { what: "a frame", needed_s, given_s: r.frame_interval_s });
        }
        let (fed, fed_mul) = delay(rest / 8.0, 22);

        let mask = u32::from(r.rx_antennas.bits());
        let receivers = r.rx_antennas.antennas();
        let mixers = receivers.iter().fold(0, |bits, a| bits | 0b11 << (12 + 2 * (a - 1)));
        let (hp_gain, high_pass_db) = if r.if_gain_db >= 30.0 { (0, 30.0) } else { (mask, 18.0) };
        let vga = (((r.if_gain_db - high_pass_db) / 5.0).round().clamp(0.0, 6.0)) as u32;
        let distance = |i: &u32| (HIGH_PASS_HZ[*i as usize] - r.high_pass_cutoff_hz).abs();
        let hpf = (0..4).min_by(|a, b| distance(a).total_cmp(&distance(b))).unwrap_or(3);
        let gains = receivers.iter().fold(0, |bits, a| bits | (vga << 2 | hpf) << (5 * (a - 1)));

        let list = [
            (ADC0, divider << 14 | 0x0210),
            (PACR1, 0xE9_67FD),
            (PACR2, 0x08_05B4),
            (SFCTL, 0x10_2000 | cref),
            (SADC_CTRL, 0x01_0D00),
            (0x08, 0),
            (0x09, 0),
            (0x0A, 0),
            (CSCI, 0xBE0),
            (0x0C, 0),
            (0x0D, 0),
            (0x0E, 0),
            (CSCDS, 0xB60),
            (CS1_U_0, 0x10_0C51 | mixers),
            (CS1_U_1, mask << 20 | 127 << 13 | 1 << 12 | 1 << 10 | u32::from(r.tx_power_level & 31)),
            (CS1_U_2, hp_gain << 20 | gains),
            (CS1, 0x490),
            (CS2, 0x480),
            (CS3, 0x480),
            (CS4, 0x480),
            (CCR0, 70 << 14 | 15 << 10 | 1 << 9 | 14),
            (CCR1, fed_mul << 19 | fed << 11 | frame_power_mode << 9 | 10),
            (CCR2, frame_len << 12),
            (CCR3, 1 << 22 | 225 << 14 | 31 << 9 | 30),
            (PLL1_0, fsu),
            (PLL1_1, rsu),
            (PLL1_2, rtu_field),
            (PLL1_3, apu),
            (0x34, 0),
            (0x35, 0),
            (0x36, 0),
            (PLL1_7, sed_mul << 19 | sed << 11 | chirp_power_mode << 9 | 1 << 8 | 1 << 4),
            (PLL2_7, 0x100),
            (PLL3_7, 0x100),
            (PLL4_7, 0x100),
            (RFT1, 0),
            (SDFT0, 0),
            (MAIN, 0x1E_8271),
        ];
        Ok(list.into_iter().map(|(address, value)| RegisterValue { address, value }).collect())
    }

    /// What a chip with these registers does. The anti-alias filter, which they do not hold, is taken as 500 kHz.
    pub fn decode(registers: &RegisterFile) -> Result<Self, ChipError> {
        let wrong = |reason: String| ChipError::NotAWaveform { reason };
        let divider = registers.field(ADC0, 23, 14);
        let samples = registers.field(PLL1_3, 11, 0) as usize;
        let chirps = registers.field(CCR2, 23, 12) as usize + 1;
        let rsu = registers.get(PLL1_1);
        if divider < 20 || samples == 0 || rsu == 0 || rsu >= 1 << 23 {
            return Err(wrong(format!("ADC_DIV {divider}, APU {samples}, RSU {rsu}; is the chip configured?")));
        }
        // FSU is a signed 24-bit number.
        let fsu = ((registers.get(PLL1_0) << 8) as i32) >> 8;
        let start = fsu + (rsu * (TX_ON_CYCLES - RAMP_START_CYCLES) as u32) as i32;
        let start_frequency_hz = FREQUENCY_ORIGIN_HZ + f64::from(start) * FREQUENCY_STEP_HZ;
        let slope = f64::from(rsu) * SLOPE_STEP_HZ_PER_S;
        let sample_rate_hz = REFERENCE_CLOCK_HZ / f64::from(divider);

        let mode = registers.field(PLL1_7, 10, 9);
        let used = active_cycles(u64::from(registers.field(PLL1_2, 13, 0))) + if mode == 0 { 0 } else { INIT_CYCLES };
        let end_delay = u64::from(registers.field(PLL1_7, 18, 11)) << registers.field(PLL1_7, 23, 19) << 3;
        let chirp = used + end_delay;
        let wake_up = if registers.field(CCR1, 10, 9) >= 2 { WAKE_UP_CYCLES } else { 0 };
        let frame_delay = u64::from(registers.field(CCR1, 18, 11)) << registers.field(CCR1, 23, 19) << 3;
        let frame = chirp * chirps as u64 - end_delay + wake_up + frame_delay;
        // Where the frame's delay could not make up for the last chirp's end delay the interval is the chirps' own.
        let frame = frame.max(chirp * chirps as u64);

        let mask = registers.field(CS1_U_1, 23, 20) & 7;
        let antennas: Vec<u8> = (1..=3).filter(|a| mask >> (a - 1) & 1 == 1).collect();
        let first = antennas.first().copied().unwrap_or(1) - 1;
        let gains = registers.get(CS1_U_2) >> (5 * u32::from(first));
        let high_pass_db = if registers.get(CS1_U_2) >> (20 + u32::from(first)) & 1 == 1 { 18.0 } else { 30.0 };
        let seconds = |cycles: u64| cycles as f64 / REFERENCE_CLOCK_HZ;
        let request = WaveformRequest {
            start_frequency_hz,
            end_frequency_hz: start_frequency_hz + slope * (samples as f64 / sample_rate_hz + ADC_START_DELAY_S),
            samples_per_chirp: samples,
            chirps_per_frame: chirps,
            sample_rate_hz,
            chirp_interval_s: seconds(chirp),
            frame_interval_s: seconds(frame),
            rx_antennas: RxMask::from_antennas(&antennas).map_err(|e| wrong(e.to_string()))?,
            tx_power_level: registers.field(CS1_U_1, 4, 0) as u8,
            if_gain_db: high_pass_db + 5.0 * f64::from(gains >> 2 & 7).min(6.0),
            high_pass_cutoff_hz: HIGH_PASS_HZ[(gains & 3) as usize],
            anti_alias_cutoff_hz: 500e3,
        };
        let waveform = Waveform::realise(request).map_err(|e| wrong(e.to_string()))?;
        Ok(ChipConfiguration { waveform, slice_samples: 2 * (registers.field(SFCTL, 12, 0) as usize + 1) })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    pub fn vendor_default() -> WaveformRequest {
        WaveformRequest {
            start_frequency_hz: 58e9,
            end_frequency_hz: 63e9,
            samples_per_chirp: 64,
            chirps_per_frame: 64,
            sample_rate_hz: 2e6,
            chirp_interval_s: 0.0005911249900236726,
            frame_interval_s: 0.07726884633302689,
            if_gain_db: 23.0,
            high_pass_cutoff_hz: 80e3,
            ..WaveformRequest::paper()
        }
    }

    fn registers(list: &RegisterList) -> RegisterFile {
        let mut file = RegisterFile::default();
        list.iter().for_each(|r| file.set(r.address, r.value));
        file
    }

    /// The list that the vendor's client wrote (hardware notes section 4).
    #[test]
    fn vendor_default_compiles_to_the_captured_list() {
        let captured = "01:0A0210 04:E967FD 05:0805B4 06:102BFF 07:010D00 08:0 09:0 0A:0 0B:000BE0 0C:0 0D:0 0E:0 \
            0F:000B60 10:13FC51 11:7FF41F 12:701CE7 16:000490 1D:000480 24:000480 2B:000480 2C:11BE0E 2D:62FC0A \
            2E:03F000 2F:787E1E 30:A35368 31:000B64 32:000172 33:000040 34:0 35:0 36:0 37:393B10 3F:000100 47:000100 \
            4F:000100 56:0 5B:0 00:1E8271";
        let waveform = Waveform::realise(vendor_default()).expect("valid");
        let list = ChipConfiguration { waveform, slice_samples: 6144 }.compile().expect("fits");
        let hex = |text: &str| u32::from_str_radix(text, 16).expect("hex");
        for (register, expected) in list.iter().zip(captured.split_whitespace()) {
            let (address, value) = expected.split_once(':').expect("pair");
            assert_eq!((u32::from(register.address), register.value), (hex(address), hex(value)), "{expected}");
        }
        assert_eq!(list.len(), 38);
    }

    #[test]
    fn registers_give_the_waveform_back() {
        let base = WaveformRequest::paper();
        let one = RxMask::from_antennas(&[2]).expect("valid");
        let two = RxMask::from_antennas(&[1, 3]).expect("valid");
        for request in [
            vendor_default(),
            base.clone(),
            WaveformRequest { rx_antennas: one, if_gain_db: 33.0, high_pass_cutoff_hz: 40e3, ..base.clone() },
            WaveformRequest { rx_antennas: two, chirps_per_frame: 8, ..base.clone() },
            WaveformRequest { chirp_interval_s: 290e-6, frame_interval_s: 0.0375, ..base.clone() },
        ] {
            let waveform = Waveform::realise(request).expect("valid");
            let slice_samples = 4096;
            let list = ChipConfiguration { waveform: waveform.clone(), slice_samples }.compile().expect("fits");
            let back = ChipConfiguration::decode(&registers(&list)).expect("decodes");
            assert_eq!(back.slice_samples, slice_samples);
            let (a, b) = (&back.waveform, &waveform);
            a.check_compatible(b).expect("compatible");
            b.check_compatible(a).expect("compatible");
            assert_eq!(a.slope_hz_per_s, b.slope_hz_per_s);
            assert!((a.request.start_frequency_hz - b.request.start_frequency_hz).abs() < 700.0);
            assert!((a.request.if_gain_db - b.request.if_gain_db).abs() <= 2.5);
            assert_eq!(a.request.high_pass_cutoff_hz, b.request.high_pass_cutoff_hz);
            assert_eq!(a.request.rx_antennas, b.request.rx_antennas);
        }
    }

    /// The captured list decodes to the times that the vendor's tool states for it.
    #[test]
    fn captured_timing_is_reproduced() {
        let waveform = Waveform::realise(vendor_default()).expect("valid");
        let list = ChipConfiguration { waveform, slice_samples: 6144 }.compile().expect("fits");
        let back = ChipConfiguration::decode(&registers(&list)).expect("decodes").waveform;
        assert!((back.request.chirp_interval_s - 591.125e-6).abs() < 1e-9);
        assert!((back.request.frame_interval_s - 0.0772688).abs() < 30e-6);
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn reset_registers_are_no_waveform() {
            let error = ChipConfiguration::decode(&RegisterFile::default()).expect_err("nothing there");
            assert!(error.to_string().contains("APU 0"), "{error}");
        }

        #[test]
        fn any_registers_decode_without_panic() {
            let mut seed = 1u64;
            for _ in 0..20_000 {
                let mut file = RegisterFile::default();
                for address in 0..0x60 {
                    seed = seed.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
                    file.set(address, (seed >> 33) as u32);
                }
                let _ = ChipConfiguration::decode(&file);
            }
        }

        #[test]
        fn ramp_longer_than_its_timer_is_refused() {
            let request = WaveformRequest {
                samples_per_chirp: 2048,
                chirps_per_frame: 4,
                chirp_interval_s: 4e-3,
                ..WaveformRequest::paper()
            };
            let waveform = Waveform::realise(request).expect("valid");
            let error = ChipConfiguration { waveform, slice_samples: 8192 }.compile().expect_err("RTU overflows");
            assert!(error.to_string().contains("RTU would be 20"), "{error}");
        }
    }
}
