//! Conversion of a waveform to the chip's register list and back.
//!
//! The list has the vendor's 38 registers in the vendor's order. The vendor's default (58-63 GHz, 64 samples, 64
//! chirps, three receivers, 2 MS/s, 23 dB) compiles to exactly the list captured on the wire.
//!
//! # Derived from the waveform
//! `ADC_DIV`, `CREF` (from the slice), receivers (`CS1_U_0`, `BBCH_SEL`), `TX1_DAC`, gain and high-pass (`CS1_U_2`),
//! `FSU`, `RSU`, `RTU`, `APU`, `FRAME_LEN`, `T_SED` (chirp interval) and `TFED` (frame interval). In units of the
//! 80 MHz clock:
//! - a ramp starts `8 TMRSTRT + 10 = 90` cycles into the chirp, the transmitter goes on at `8 T_PAEN = 240`. The ramp
//!   starts 150 cycles (1.875 us) early, so `FSU` lies `150 RSU` below the requested start. Sampling starts
//!   `8 T_SSTRT + 1 = 249` cycles after the transmitter;
//! - `RTU` is the time from ramp start to the last sample, rounded up to 8 cycles;
//! - a chirp lasts `90 + 8 RTU + 8 TMREND + INIT0 + INIT1 + 8 T_SED 2^T_SED_MUL + 32` cycles. The last number is
//!   the sum of the state machine's overheads, fitted to the captured list (591.125 us);
//! - a frame lasts its chirps, less the end delay of the last one, plus `8 TFED 2^TFED_MUL` and the wake-up. This
//!   gives the captured list's 77.269 ms within 26 us, which is what `TFED` can resolve at that length.
//!
//! Both delays are stored as an 8-bit mantissa and an exponent. Like the vendor's library, the code takes the nearest
//! representable delay, and of equal ones the one with the largest exponent. Chirp intervals are thus coarser than 8
//! cycles: up to 0.4 % of the end delay off.
//!
//! # Fixed as in the captured list
//! Wake-up 1 ms, `INIT0` 45 us, `INIT1` 7 us, PA delay 3 us, ADC delay, baseband reset, post-chirp delay 1.4 us, PLL
//! and ADC trims.
//!
//! # Not confirmed by any capture
//! - Receivers that are off get no mixer, no baseband channel and zero gain fields.
//! - `HP_GAIN` 0 stands for 30 dB (the capture has 7 for 18 dB in all channels).
//! - If the chirp interval leaves no room for `INIT0` and `INIT1`, the chip stays active between chirps (`PD_MODE` 0).
//!   If the frame interval leaves no room for the wake-up, it idles between frames (`PD_MODE` 1).
//! - The anti-alias filter is not programmed: the list has no field for it.

use radome_dsp::{
    ADC_START_DELAY_S, FIFO_SAMPLES, LEAST_BAND_HZ, REFERENCE_CLOCK_HZ, RF_BAND_HZ, RxMask, SLOPE_STEP_HZ_PER_S,
    Waveform, WaveformRequest,
};
use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::address::*;
use super::field::*;
use super::{Field, RegisterFile, SpiWord, register};

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

/// Register and its content.
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

impl From<&RegisterList> for RegisterFile {
    /// Returns the contents after a reset and the writing of these registers.
    fn from(list: &RegisterList) -> Self {
        let mut file = RegisterFile::default();
        list.iter().for_each(|register| file.set(register.address, register.value));
        file
    }
}

impl RegisterValue {
    /// Returns the name of the register, and its fields that are not zero with their values.
    pub fn named(self) -> Option<(&'static str, Vec<(&'static str, u32)>)> {
        let register = register(self.address)?;
        let fields = register.fields.iter().map(|f| (f.name, f.of(self.value))).filter(|(_, value)| *value != 0);
        Some((register.name, fields.collect()))
    }
}

/// Registers in the order of writing, each with the fields that are the same for every waveform, as captured.
const CAPTURED: [(u8, &[(Field, u32)]); 38] = [
    (ADC0, &[(ADC0::TRACK_CFG, 1), (ADC0::BG_TC_TRIM, 4)]),
    // Analog part of the PLL.
    (
        PACR1,
        &[
            (PACR1::OSCCLKEN, 1),
            (PACR1::LFEN, 1),
            (PACR1::CPEN, 1),
            (PACR1::ICPSEL, 4),
            (PACR1::LOCKFORC, 1),
            (PACR1::LOCKSEL, 3),
            (PACR1::RFILTSEL, 1),
            (PACR1::VREFSEL, 3),
            (PACR1::U2IEN, 1),
            (PACR1::BGAPEN, 1),
            (PACR1::VDIGREG, 3),
            (PACR1::DIGPON, 1),
            (PACR1::VANAREG, 2),
            (PACR1::ANAPON, 1),
        ],
    ),
    // Digital part of the PLL. DIVSET 20 sets the frequency at FSU 0.
    (PACR2, &[(PACR2::DTSEL, 2), (PACR2::FSDNTMR, 5), (PACR2::FSTDNEN, 2), (PACR2::DIVEN, 1), (PACR2::DIVSET, 20)]),
    (SFCTL, &[(SFCTL::QSPI_WT, 1), (SFCTL::FIFO_LP_MODE, 1)]),
    // ADC of the temperature sensor.
    (SADC_CTRL, &[(SADC_CTRL::TC_TRIM, 4), (SADC_CTRL::SESP, 1), (SADC_CTRL::OVERS_CFG, 2), (SADC_CTRL::SD_EN, 1)]),
    (CSP_I_0, &[]),
    (CSP_I_1, &[]),
    (CSP_I_2, &[]),
    // Blocks that stay on between chirps.
    (
        CSCI,
        &[
            (CSCI::PLL_ISOPD, 1),
            (CSCI::SADC_ISOPD, 1),
            (CSCI::MADC_ISOPD, 1),
            (CSCI::BG_EN, 1),
            (CSCI::RF_ISOPD, 1),
            (CSCI::ABB_ISOPD, 1),
        ],
    ),
    (CSP_D_0, &[]),
    (CSP_D_1, &[]),
    (CSP_D_2, &[]),
    // Blocks that stay on between frames.
    (
        CSCDS,
        &[
            (CSCDS::PLL_ISOPD, 1),
            (CSCDS::SADC_ISOPD, 1),
            (CSCDS::MADC_ISOPD, 1),
            (CSCDS::RF_ISOPD, 1),
            (CSCDS::ABB_ISOPD, 1),
        ],
    ),
    (
        CS1_U_0,
        &[
            (CS1_U_0::BBCHGLOB_EN, 1),
            (CS1_U_0::LO_DISTRIB_EN, 1),
            (CS1_U_0::LO_MOD1_EN, 1),
            (CS1_U_0::FDIV_EN, 1),
            (CS1_U_0::VCO_EN, 1),
            (CS1_U_0::TX1_EN, 1),
        ],
    ),
    (CS1_U_1, &[(CS1_U_1::BB_RSTCNT, 127), (CS1_U_1::TEMP_MEAS_EN, 1), (CS1_U_1::MADC_EN, 1)]),
    (CS1_U_2, &[]),
    (CS1, &[(CS1::BG_TMRF_EN, 1), (CS1::BG_EN, 1), (CS1::CS_EN, 1)]),
    (CS2, &[(CS2::BG_TMRF_EN, 1), (CS2::BG_EN, 1)]),
    (CS3, &[(CS3::BG_TMRF_EN, 1), (CS3::BG_EN, 1)]),
    (CS4, &[(CS4::BG_TMRF_EN, 1), (CS4::BG_EN, 1)]),
    (CCR0, &[(CCR0::TR_INIT1, 70), (CCR0::REPT, 15), (CCR0::CONT_MODE, 1), (CCR0::TMREND, 14)]),
    (CCR1, &[(CCR1::TMRSTRT, 10)]),
    (CCR2, &[]),
    (CCR3, &[(CCR3::TR_MUL0, 1), (CCR3::TR_INIT0, 225), (CCR3::T_SSTRT, 31), (CCR3::T_PAEN, 30)]),
    (PLL1_0, &[]),
    (PLL1_1, &[]),
    (PLL1_2, &[]),
    (PLL1_3, &[]),
    (PLL1_4, &[]),
    (PLL1_5, &[]),
    (PLL1_6, &[]),
    (PLL1_7, &[(PLL1_7::CONT_MODE, 1), (PLL1_7::SH_EN, 1)]),
    (PLL2_7, &[(PLL2_7::CONT_MODE, 1)]),
    (PLL3_7, &[(PLL3_7::CONT_MODE, 1)]),
    (PLL4_7, &[(PLL4_7::CONT_MODE, 1)]),
    (RFT1, &[]),
    (SDFT0, &[]),
    (
        MAIN,
        &[
            (MAIN::BG_CLK_DIV, 3),
            (MAIN::SADC_CLK_DIV, 3),
            (MAIN::TWKUP_MUL, 8),
            (MAIN::TWKUP, 39),
            (MAIN::FRAME_START, 1),
        ],
    ),
];

/// Fields of each receiver: mixer, buffer of its oscillator, gain, high-pass filter.
const RECEIVERS: [[Field; 4]; 3] = [
    [CS1_U_0::RX1MIX_EN, CS1_U_0::RX1LOBUF_EN, CS1_U_2::VGA_GAIN1, CS1_U_2::HPF_SEL1],
    [CS1_U_0::RX2MIX_EN, CS1_U_0::RX2LOBUF_EN, CS1_U_2::VGA_GAIN2, CS1_U_2::HPF_SEL2],
    [CS1_U_0::RX3MIX_EN, CS1_U_0::RX3LOBUF_EN, CS1_U_2::VGA_GAIN3, CS1_U_2::HPF_SEL3],
];

/// Error of a waveform that the registers cannot hold, or of registers that do not hold a waveform.
#[derive(Debug, Clone, PartialEq, Error)]
#[allow(missing_docs, reason = "the message says what each field is")]
pub enum ChipError {
    /// A register field cannot hold a quantity.
    #[error(
        "chip: {quantity} would be {value:.7} {unit}, register {field} allows {min:.7} to {max:.7} {unit}; change {hint}"
    )]
    FieldRange {
        field: &'static str,
        quantity: &'static str,
        value: f64,
        min: f64,
        max: f64,
        unit: &'static str,
        /// Quantities of the waveform that determine the value.
        hint: &'static str,
    },
    /// An interval is too short.
    #[error("chip: {what} takes {needed_s:.7} s at least, {given_s:.7} s were asked for")]
    TooShort { what: &'static str, needed_s: f64, given_s: f64 },
    /// The registers do not stand for a waveform of this program.
    #[error("chip: registers cannot be read as a waveform: {reason}")]
    NotAWaveform { reason: String },
}

/// Configuration of the chip: a waveform and the FIFO level of the interrupt.
#[derive(Debug, Clone, PartialEq)]
pub struct ChipConfiguration {
    /// Waveform to transmit and sample.
    pub waveform: Waveform,
    /// Number of codes at which the chip requests a read of the FIFO, even.
    pub slice_samples: usize,
}

/// Mantissa and exponent of a delay: value `mantissa << exponent` in units of 8 cycles.
fn delay(units: f64, max_exponent: u32) -> (u32, u32) {
    let (mut best_mantissa, mut best_exponent, mut least_error) = (0, 0, f64::INFINITY);
    for exponent in 0..=max_exponent {
        let mantissa = (units / f64::from(1u32 << exponent)).round().clamp(0.0, 255.0);
        let error = (mantissa * f64::from(1u32 << exponent) - units).abs();
        if error <= least_error {
            (best_mantissa, best_exponent, least_error) = (mantissa as u32, exponent, error);
        }
    }
    // A delay of zero has a zero exponent too.
    if best_mantissa == 0 { (0, 0) } else { (best_mantissa, best_exponent) }
}

/// Quantity in a register field: `origin + step n` in some unit.
struct Quantity {
    name: &'static str,
    unit: &'static str,
    origin: f64,
    step: f64,
    /// Smallest and largest `n`.
    range: (i64, i64),
}

impl Quantity {
    const fn count(name: &'static str, unit: &'static str, origin: f64, range: (i64, i64)) -> Self {
        Quantity { name, unit, origin, step: 1.0, range }
    }

    /// Returns the field with the value `n`, or an error if `n` is out of range.
    fn in_field(&self, field: Field, n: i64, hint: &'static str) -> Result<(Field, u32), ChipError> {
        let physical = |n: i64| self.origin + self.step * n as f64;
        let (least, most) = self.range;
        if n < least || n > most {
            // A negative step swaps the ends of the interval.
            let (min, max) = (physical(least).min(physical(most)), physical(least).max(physical(most)));
            let (field, quantity, unit) = (field.name, self.name, self.unit);
            return Err(ChipError::FieldRange { field, quantity, value: physical(n), min, max, unit, hint });
        }
        Ok((field, (n & 0xFF_FFFF) as u32))
    }
}

const RAMP_START: Quantity = Quantity {
    name: "the frequency at which the ramp starts",
    unit: "GHz",
    origin: FREQUENCY_ORIGIN_HZ * 1e-9,
    step: FREQUENCY_STEP_HZ * 1e-9,
    range: (-(1 << 23), (1 << 23) - 1),
};
const SLOPE: Quantity = Quantity {
    name: "the slope",
    unit: "MHz/us",
    origin: 0.0,
    step: SLOPE_STEP_HZ_PER_S * 1e-12,
    range: (1, (1 << 23) - 1),
};
const RAMP_TIME: Quantity =
    Quantity { name: "the ramp", unit: "us", origin: 0.0, step: 8e6 / REFERENCE_CLOCK_HZ, range: (1, (1 << 14) - 1) };
const CLOCK_DIVIDER: Quantity = Quantity::count("the ADC's clock divider", "(80 MHz over the rate)", 0.0, (20, 1023));
const SAMPLES: Quantity = Quantity::count("a chirp", "samples", 0.0, (1, 4095));
const CHIRPS: Quantity = Quantity::count("a frame", "chirps", 1.0, (0, 4095));
const SLICE: Quantity =
    Quantity { name: "a slice", unit: "samples", origin: 2.0, step: 2.0, range: (0, FIFO_SAMPLES as i64 / 2 - 1) };

/// Computes RTU and ADC_DIV of a waveform.
fn ramp(waveform: &Waveform) -> (u64, u64) {
    let divider = (REFERENCE_CLOCK_HZ / waveform.sample_rate_hz).round() as u64;
    let sampling = divider * waveform.request.samples_per_chirp as u64;
    ((TX_ON_CYCLES + ADC_DELAY_CYCLES - RAMP_START_CYCLES + sampling).div_ceil(8), divider)
}

fn active_cycles(rtu: u64) -> u64 {
    RAMP_START_CYCLES + 8 * rtu + POST_CHIRP_CYCLES + CHIRP_OVERHEAD_CYCLES
}

impl ChipConfiguration {
    /// Compiles the 38 registers, in the vendor's order.
    ///
    /// # Errors
    /// [`ChipError::FieldRange`] or [`ChipError::TooShort`] if the registers cannot hold the waveform.
    pub fn compile(&self) -> Result<RegisterList, ChipError> {
        let fields = [self.ramp_fields()?, self.interval_fields()?, self.receiver_fields()].concat();
        let register = |(address, captured): &(u8, &[(Field, u32)])| {
            let derived = fields.iter().filter(|(field, _)| field.address == *address);
            let value = captured.iter().chain(derived).fold(0, |content, (field, value)| field.put(content, *value));
            RegisterValue { address: *address, value }
        };
        Ok(CAPTURED.iter().map(register).collect())
    }

    /// Computes the fields of the ramp, of its samples and of the counts of chirps and codes.
    fn ramp_fields(&self) -> Result<Vec<(Field, u32)>, ChipError> {
        let r = &self.waveform.request;
        let rsu = (self.waveform.slope_hz_per_s / SLOPE_STEP_HZ_PER_S).round() as i64;
        let start = ((r.start_frequency_hz - FREQUENCY_ORIGIN_HZ) / FREQUENCY_STEP_HZ).round() as i64;
        let fsu = start - rsu * (TX_ON_CYCLES - RAMP_START_CYCLES) as i64;
        let (rtu, divider) = ramp(&self.waveform);
        Ok(vec![
            RAMP_START.in_field(PLL1_0::FSU, fsu, "start_frequency_hz")?,
            SLOPE.in_field(PLL1_1::RSU, rsu, "end_frequency_hz or samples_per_chirp")?,
            RAMP_TIME.in_field(PLL1_2::RTU, rtu as i64, "samples_per_chirp or sample_rate_hz")?,
            CLOCK_DIVIDER.in_field(ADC0::ADC_DIV, divider as i64, "sample_rate_hz")?,
            SAMPLES.in_field(PLL1_3::APU, r.samples_per_chirp as i64, "samples_per_chirp")?,
            CHIRPS.in_field(CCR2::FRAME_LEN, r.chirps_per_frame as i64 - 1, "chirps_per_frame")?,
            SLICE.in_field(SFCTL::FIFO_CREF, (self.slice_samples / 2) as i64 - 1, "the slice")?,
        ])
    }

    /// Computes the delays after a chirp and after a frame, and the power modes in which the chip spends them.
    fn interval_fields(&self) -> Result<Vec<(Field, u32)>, ChipError> {
        let (chirp_interval_s, r) = (self.waveform.chirp_interval_s, &self.waveform.request);
        let too_short = |what: &'static str, cycles: f64, given_s: f64| ChipError::TooShort {
            what,
            needed_s: cycles / REFERENCE_CLOCK_HZ,
            given_s,
        };
        let chirp_cycles = chirp_interval_s * REFERENCE_CLOCK_HZ;
        let (rtu, _) = ramp(&self.waveform);
        let active = active_cycles(rtu);
        let (chirp_power_mode, fixed_cycles) =
            if chirp_cycles >= (active + INIT_CYCLES) as f64 { (1, active + INIT_CYCLES) } else { (0, active) };
        if chirp_cycles + 4.0 < fixed_cycles as f64 {
            return Err(too_short("a chirp", fixed_cycles as f64, chirp_interval_s));
        }
        let (sed, sed_mul) = delay((chirp_cycles - fixed_cycles as f64) / 8.0, 16);
        let end_delay = u64::from(sed) << sed_mul << 3;
        let all_chirps_cycles = ((fixed_cycles + end_delay) * r.chirps_per_frame as u64 - end_delay) as f64;

        let frame_cycles = r.frame_interval_s * REFERENCE_CLOCK_HZ;
        let (frame_power_mode, rest_cycles) = match frame_cycles - all_chirps_cycles - WAKE_UP_CYCLES as f64 {
            rest_cycles if rest_cycles >= 0.0 => (2, rest_cycles),
            _ => (1, frame_cycles - all_chirps_cycles),
        };
        if rest_cycles < -8.0 {
            return Err(too_short("a frame", all_chirps_cycles, r.frame_interval_s));
        }
        let (fed, fed_mul) = delay(rest_cycles / 8.0, 22);
        Ok(vec![
            (PLL1_7::PD_MODE, chirp_power_mode),
            (PLL1_7::T_SED, sed),
            (PLL1_7::T_SED_MUL, sed_mul),
            (CCR1::PD_MODE, frame_power_mode),
            (CCR1::TFED, fed),
            (CCR1::TFED_MUL, fed_mul),
        ])
    }

    /// Computes the fields of the receivers and of the transmitter's power.
    fn receiver_fields(&self) -> Vec<(Field, u32)> {
        let r = &self.waveform.request;
        let mask = u32::from(r.rx_antennas.bits());
        let (hp_gain, high_pass_db) = if r.if_gain_db >= 30.0 { (0, 30.0) } else { (mask, 18.0) };
        let vga = (((r.if_gain_db - high_pass_db) / 5.0).round().clamp(0.0, 6.0)) as u32;
        let distance = |i: &u32| (HIGH_PASS_HZ[*i as usize] - r.high_pass_cutoff_hz).abs();
        let hpf = (0..4).min_by(|a, b| distance(a).total_cmp(&distance(b))).unwrap_or(3);
        let antennas = r.rx_antennas.antennas();
        let receivers = antennas.iter().filter_map(|antenna| RECEIVERS.get(usize::from(*antenna) - 1));
        let fields = receivers.flat_map(|receiver| receiver.iter().copied().zip([1, 1, vga, hpf]));
        let common =
            [(CS1_U_1::BBCH_SEL, mask), (CS1_U_1::TX1_DAC, u32::from(r.tx_power_level)), (CS1_U_2::HP_GAIN, hp_gain)];
        fields.chain(common).collect()
    }

    /// Returns the registers of a chip that has been programmed with this configuration.
    pub(super) fn programmed(&self) -> Result<RegisterFile, ChipError> {
        Ok(RegisterFile::from(&self.compile()?))
    }

    /// Time in active mode in each chirp, from its start to the end of the post-chirp delay, s.
    pub(super) fn active_chirp_s(&self) -> f64 {
        let (rtu, _) = ramp(&self.waveform);
        active_cycles(rtu) as f64 / REFERENCE_CLOCK_HZ
    }

    /// Returns the waveform that the registers realise: the requested one on their grids, rounded by the vendor's rules. The gain
    /// need not be the nearest that exists.
    ///
    /// # Errors
    /// Those of [`ChipConfiguration::compile`] and [`ChipConfiguration::decode`].
    pub fn realised(&self) -> Result<Waveform, ChipError> {
        Ok(ChipConfiguration::decode(&self.programmed()?)?.waveform)
    }

    /// Returns the waveform with the chirp and frame intervals that the registers realise. Everything else is as
    /// requested.
    ///
    /// # Errors
    /// Those of [`ChipConfiguration::realised`].
    pub fn with_realised_intervals(&self) -> Result<Waveform, ChipError> {
        let realised = self.realised()?;
        let mut waveform = self.waveform.clone();
        waveform.chirp_interval_s = realised.chirp_interval_s;
        waveform.request.chirp_interval_s = realised.request.chirp_interval_s;
        waveform.request.frame_interval_s = realised.request.frame_interval_s;
        Ok(waveform)
    }

    /// Decodes the waveform of a chip with these registers. The anti-alias filter, which they do not hold, is taken as
    /// 500 kHz.
    ///
    /// # Errors
    /// [`ChipError::NotAWaveform`] if the registers do not stand for a waveform.
    pub fn decode(registers: &RegisterFile) -> Result<Self, ChipError> {
        let not_a_waveform = |reason: String| ChipError::NotAWaveform { reason };
        let divider = registers.field(ADC0::ADC_DIV);
        let samples = registers.field(PLL1_3::APU) as usize;
        let rsu = registers.field(PLL1_1::RSU);
        if divider < 20 || samples == 0 || rsu == 0 || rsu >= 1 << 23 {
            return Err(not_a_waveform(format!(
                "ADC_DIV {divider}, APU {samples}, RSU {rsu}; is the chip configured?"
            )));
        }
        let sample_rate_hz = REFERENCE_CLOCK_HZ / f64::from(divider);
        let [start_frequency_hz, end_frequency_hz] =
            decode_band(registers, rsu, samples as f64 / sample_rate_hz + ADC_START_DELAY_S);
        let chirps = registers.field(CCR2::FRAME_LEN) as usize + 1;
        let [chirp_interval_s, frame_interval_s] = decode_intervals(registers, chirps);

        let mask = registers.field(CS1_U_1::BBCH_SEL) & 7;
        let antennas: Vec<u8> = (1..=3).filter(|a| mask >> (a - 1) & 1 == 1).collect();
        let first = antennas.first().copied().unwrap_or(1) - 1;
        let [_, _, vga, high_pass] = RECEIVERS[usize::from(first)].map(|field| registers.field(field));
        let high_pass_db = if registers.field(CS1_U_2::HP_GAIN) >> u32::from(first) & 1 == 1 { 18.0 } else { 30.0 };
        let request = WaveformRequest {
            start_frequency_hz,
            end_frequency_hz,
            samples_per_chirp: samples,
            chirps_per_frame: chirps,
            sample_rate_hz,
            chirp_interval_s,
            frame_interval_s,
            rx_antennas: RxMask::from_antennas(&antennas).map_err(|e| not_a_waveform(e.to_string()))?,
            tx_power_level: registers.field(CS1_U_1::TX1_DAC) as u8,
            if_gain_db: high_pass_db + 5.0 * f64::from(vga).min(6.0),
            high_pass_cutoff_hz: HIGH_PASS_HZ[(high_pass & 3) as usize],
            anti_alias_cutoff_hz: 500e3,
        };
        let waveform = Waveform::realise(request).map_err(|e| not_a_waveform(e.to_string()))?;
        Ok(ChipConfiguration { waveform, slice_samples: 2 * (registers.field(SFCTL::FIFO_CREF) as usize + 1) })
    }
}

/// Limits a value to the range of a request if it lies outside by no more than `tolerance`, which rounding to the grids of
/// the registers can cause.
fn clamp_within(value: f64, [low, high]: [f64; 2], tolerance: f64) -> f64 {
    let clamped = value.max(low).min(high);
    if (clamped - value).abs() <= tolerance { clamped } else { value }
}

/// Decodes the frequencies at which the transmitter goes on and at which sampling ends, `ramp_s` later, Hz. `rsu` is the
/// register RSU, below 2^23.
fn decode_band(registers: &RegisterFile, rsu: u32, ramp_s: f64) -> [f64; 2] {
    // FSU is a signed 24-bit number.
    let fsu = ((registers.field(PLL1_0::FSU) << 8) as i32) >> 8;
    let start = fsu + (rsu * (TX_ON_CYCLES - RAMP_START_CYCLES) as u32) as i32;
    let start_hz = FREQUENCY_ORIGIN_HZ + f64::from(start) * FREQUENCY_STEP_HZ;
    let end_hz = start_hz + f64::from(rsu) * SLOPE_STEP_HZ_PER_S * ramp_s;
    let start_hz = clamp_within(start_hz, [RF_BAND_HZ.0, RF_BAND_HZ.1 - LEAST_BAND_HZ], FREQUENCY_STEP_HZ);
    // Rounding changes the end by half a step of slope and a step of frequency.
    let tolerance_hz = 0.5 * SLOPE_STEP_HZ_PER_S * ramp_s + FREQUENCY_STEP_HZ;
    [start_hz, clamp_within(end_hz, [start_hz + LEAST_BAND_HZ, RF_BAND_HZ.1], tolerance_hz)]
}

/// Decodes the intervals of chirps and frames, s.
fn decode_intervals(registers: &RegisterFile, chirps: usize) -> [f64; 2] {
    let init_cycles = if registers.field(PLL1_7::PD_MODE) == 0 { 0 } else { INIT_CYCLES };
    let end_delay = u64::from(registers.field(PLL1_7::T_SED)) << registers.field(PLL1_7::T_SED_MUL) << 3;
    let chirp_cycles = active_cycles(u64::from(registers.field(PLL1_2::RTU))) + init_cycles + end_delay;
    let wake_up_cycles = if registers.field(CCR1::PD_MODE) >= 2 { WAKE_UP_CYCLES } else { 0 };
    let frame_delay = u64::from(registers.field(CCR1::TFED)) << registers.field(CCR1::TFED_MUL) << 3;
    let frame_cycles = chirp_cycles * chirps as u64 - end_delay + wake_up_cycles + frame_delay;
    let seconds = |cycles: u64| cycles as f64 / REFERENCE_CLOCK_HZ;
    // The longest intervals may be rounded up by half a step of their delay, and by 8 cycles for their overheads.
    let interval_s = |cycles: u64, exponent: Field, longest_s: f64| {
        clamp_within(seconds(cycles), [0.0, longest_s], seconds((4u64 << registers.field(exponent)) + 8))
    };
    [
        interval_s(chirp_cycles, PLL1_7::T_SED_MUL, Waveform::LONGEST_CHIRP_INTERVAL_S),
        interval_s(frame_cycles, CCR1::TFED_MUL, Waveform::LONGEST_FRAME_INTERVAL_S),
    ]
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
            let back = ChipConfiguration::decode(&RegisterFile::from(&list)).expect("decodes");
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

    /// Regression test: registers whose rounded ramp ends beyond the band were refused, although the request is within the band.
    #[test]
    fn a_ramp_to_the_edge_of_the_band_is_realised() {
        for megahertz in 0..=12 {
            let end_frequency_hz = RF_BAND_HZ.1 - 1e6 * f64::from(megahertz);
            let request = WaveformRequest { end_frequency_hz, ..WaveformRequest::paper() };
            let waveform = Waveform::realise(request).expect("valid");
            let slope_hz_per_s = waveform.slope_hz_per_s;
            let realised = ChipConfiguration { waveform, slice_samples: 8192 }.realised().expect("a waveform");
            assert_eq!(realised.slope_hz_per_s, slope_hz_per_s, "{end_frequency_hz}");
        }
        // The narrowest bands, whose slope is rounded down below them, and at the end of the chip's band.
        let narrow = [(60e9, 11), (60e9, 12), (60e9, 14), (RF_BAND_HZ.1 - 1e6, 8)];
        for (start_frequency_hz, samples_per_chirp) in narrow {
            let end_frequency_hz = start_frequency_hz + 1e6;
            let (sample_rate_hz, paper) = (2e6, WaveformRequest::paper());
            let request =
                WaveformRequest { start_frequency_hz, end_frequency_hz, samples_per_chirp, sample_rate_hz, ..paper };
            let waveform = Waveform::realise(request).expect("valid");
            let realised = ChipConfiguration { waveform, slice_samples: 8192 }.realised();
            assert!(realised.is_ok(), "{samples_per_chirp}: {realised:?}");
        }
    }

    /// Asserts that a waveform and the one that its registers realise compile to the same registers.
    fn assert_idempotent(request: WaveformRequest) -> Waveform {
        let waveform = Waveform::realise(request).expect("valid");
        let configuration = ChipConfiguration { waveform, slice_samples: 8192 };
        let realised = configuration.realised().expect("a waveform");
        let again = ChipConfiguration { waveform: realised.clone(), slice_samples: 8192 };
        assert_eq!(again.compile(), configuration.compile(), "{:?}", configuration.waveform.request);
        realised
    }

    /// Regression test: the interval of frames that follow each other without a pause was read as too long, and the
    /// next program to use it programmed other registers.
    #[test]
    fn frames_without_a_pause_are_read_back_as_they_are() {
        for chirp_interval_us in [310, 395, 405, 580, 600, 777, 1000] {
            let chirp_interval_s = f64::from(chirp_interval_us) * 1e-6;
            let frame_interval_s = 128.0 * chirp_interval_s;
            let paper = WaveformRequest::paper();
            let realised = assert_idempotent(WaveformRequest { chirp_interval_s, frame_interval_s, ..paper });
            let error_s = (realised.request.frame_interval_s - frame_interval_s).abs();
            assert!(error_s < 10e-6, "{chirp_interval_us} us: {error_s} s");
        }
    }

    /// Regression test: intervals that the registers round up beyond the longest one of a request were an internal
    /// error.
    #[test]
    fn the_longest_intervals_are_realised() {
        let paper = WaveformRequest::paper();
        for (chirps_per_frame, chirp_interval_s, frame_interval_s) in
            [(4, 0.99, 10.0), (4, 1.0, 10.0), (128, 2e-3, 99.8), (128, 2e-3, 99.9), (128, 2e-3, 100.0)]
        {
            let intervals = WaveformRequest { chirp_interval_s, frame_interval_s, ..paper.clone() };
            let realised = assert_idempotent(WaveformRequest { chirps_per_frame, ..intervals }).request;
            assert!((realised.chirp_interval_s / chirp_interval_s - 1.0).abs() < 4e-3, "{realised:?}");
            assert!((realised.frame_interval_s / frame_interval_s - 1.0).abs() < 4e-3, "{realised:?}");
        }
    }

    /// The captured list decodes to the times that the vendor's tool states for it.
    #[test]
    fn captured_timing_is_reproduced() {
        let waveform = Waveform::realise(vendor_default()).expect("valid");
        let list = ChipConfiguration { waveform, slice_samples: 6144 }.compile().expect("fits");
        let back = ChipConfiguration::decode(&RegisterFile::from(&list)).expect("decodes").waveform;
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
            assert!(
                error.to_string().contains("the ramp would be 2053") && error.to_string().contains("1638.3"),
                "{error}"
            );
        }
    }
}
