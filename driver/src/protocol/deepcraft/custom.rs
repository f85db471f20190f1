//! Blob of the option "Custom data": a waveform as the firmware's settings and the chip's registers.
//!
//! The blob consists of 32-bit words, little-endian: number of registers; index of the first register's word; start and
//! end frequency in Hz, 64 bits each; samples, chirps, receivers, transmitters; ADC rate; chirp and frame interval in
//! seconds, 32-bit floats. From the index on follow the registers as words that are written over SPI (address in bits
//! 31:25, write bit 24, content).

use radome_dsp::{Waveform, WaveformError, WaveformRequest};
use thiserror::Error;

use crate::chip::{
    ChipConfiguration, ChipError, RegisterFile, RegisterList, RegisterValue, SpiWord, address, main_bits,
};

/// Index of the first register's word in the blobs of the vendor's tool.
const FIRST_REGISTER: usize = 16;
/// Words of the header, before the registers.
const HEADER_WORDS: usize = 13;
/// FIFO level at which the chip interrupts the firmware, regardless of its registers, codes.
pub const FIFO_LEVEL_CODES: usize = 6144;

/// Error of a blob that does not hold a waveform.
#[derive(Debug, Clone, PartialEq, Error)]
#[allow(missing_docs, reason = "the message says what each field is")]
pub enum CustomError {
    /// The blob is too short.
    #[error("custom data: {words} words, {needed} are needed")]
    Short { words: usize, needed: usize },
    /// A word of the register list is not a write.
    #[error("custom data: register word {word:#010x} does not write")]
    NoWrite { word: u32 },
    /// Settings and registers contradict each other.
    #[error("custom data: {what} is {stated} by the settings and {registers} by the registers")]
    Contradiction { what: &'static str, stated: u64, registers: u64 },
    /// The registers do not hold a waveform.
    #[error(transparent)]
    Chip(#[from] ChipError),
    /// The settings are not a waveform.
    #[error(transparent)]
    Waveform(#[from] WaveformError),
}

/// Custom waveform of the host, compiled for the option.
#[derive(Debug, Clone, PartialEq)]
pub struct Custom {
    /// The waveform, with the chirp interval that the registers realise.
    pub waveform: Waveform,
    /// Register list for the chip. Frames are started separately.
    pub registers: RegisterList,
}

/// Returns the number with the fewest digits among those that round to this 32-bit float.
fn shortest_decimal(value: f32) -> f64 {
    value.to_string().parse().unwrap_or(f64::from(value))
}

fn decode_registers(registers: &RegisterList) -> Result<Waveform, ChipError> {
    Ok(ChipConfiguration::decode(&RegisterFile::from(registers))?.waveform)
}

impl Custom {
    /// Compiles a waveform.
    ///
    /// # Errors
    /// [`ChipError`] if the registers cannot hold the waveform.
    pub fn compile(waveform: &Waveform) -> Result<Self, ChipError> {
        let configuration = ChipConfiguration { waveform: waveform.clone(), slice_samples: FIFO_LEVEL_CODES };
        let mut registers = configuration.compile()?;
        registers.iter_mut().filter(|r| r.address == address::MAIN).for_each(|r| r.value &= !main_bits::ALL);
        let mut waveform = waveform.clone();
        waveform.chirp_interval_s = decode_registers(&registers)?.chirp_interval_s;
        Ok(Custom { waveform, registers })
    }

    /// Encodes the blob.
    pub fn encode(&self) -> Vec<u8> {
        let r = &self.waveform.request;
        let frequencies = [r.start_frequency_hz, r.end_frequency_hz].map(|f| f.round() as u64);
        let [start, end] = frequencies.map(|f| [f as u32, (f >> 32) as u32]);
        let shape = self.waveform.shape();
        let header = [
            self.registers.len() as u32,
            FIRST_REGISTER as u32,
            start[0],
            start[1],
            end[0],
            end[1],
            shape.samples as u32,
            shape.chirps as u32,
            shape.rx as u32,
            1,
            self.waveform.sample_rate_hz.round() as u32,
            (r.chirp_interval_s as f32).to_bits(),
            (r.frame_interval_s as f32).to_bits(),
        ];
        let registers = self.registers.iter().map(|r| u32::from_be_bytes(SpiWord::from(*r).to_bytes()));
        let padding = [0; FIRST_REGISTER - HEADER_WORDS];
        header.into_iter().chain(padding).chain(registers).flat_map(u32::to_le_bytes).collect()
    }

    /// Decodes the blob. Intervals and band are those of its settings, receivers and gains those of its registers;
    /// values that both state must agree.
    ///
    /// # Errors
    /// [`CustomError`] if the blob is too short, contradicts itself or does not hold a waveform.
    pub fn decode(blob: &[u8]) -> Result<Self, CustomError> {
        let words: Vec<u32> = blob.as_chunks::<4>().0.iter().map(|word| u32::from_le_bytes(*word)).collect();
        let short = |needed| CustomError::Short { words: words.len(), needed };
        let header: &[u32; HEADER_WORDS] = words.first_chunk().ok_or(short(HEADER_WORDS))?;
        let &[count, first, s0, s1, e0, e1, samples, chirps, rx, _, rate, chirp_s, frame_s] = header;
        let needed = (first as usize).saturating_add(count as usize);
        let list = words.get(first as usize..needed).ok_or(short(needed))?;
        let registers = list
            .iter()
            .map(|word| match SpiWord::from_bytes(word.to_be_bytes()) {
                SpiWord { write: true, address, value } => Ok(RegisterValue { address, value }),
                _ => Err(CustomError::NoWrite { word: *word }),
            })
            .collect::<Result<RegisterList, CustomError>>()?;
        let chip = decode_registers(&registers)?;
        let shape = chip.shape();
        for (what, stated, realised) in [
            ("samples in a chirp", samples, shape.samples),
            ("chirps in a frame", chirps, shape.chirps),
            ("number of receivers", rx, shape.rx),
        ] {
            let (stated, registers) = (u64::from(stated), realised as u64);
            if stated != registers {
                return Err(CustomError::Contradiction { what, stated, registers });
            }
        }
        let frequency_hz = |low: u32, high: u32| (u64::from(high) << 32 | u64::from(low)) as f64;
        // The settings round the rate to a whole number, which may lie below the lowest rate of the chip.
        let is_rounded = chip.sample_rate_hz.round() == f64::from(rate);
        let sample_rate_hz = if is_rounded { chip.sample_rate_hz } else { f64::from(rate) };
        let mut waveform = Waveform::realise(WaveformRequest {
            start_frequency_hz: frequency_hz(s0, s1),
            end_frequency_hz: frequency_hz(e0, e1),
            sample_rate_hz,
            chirp_interval_s: shortest_decimal(f32::from_bits(chirp_s)),
            frame_interval_s: shortest_decimal(f32::from_bits(frame_s)),
            ..chip.request.clone()
        })?;
        waveform.chirp_interval_s = chip.chirp_interval_s;
        let step = |w: &Waveform| (w.slope_hz_per_s / radome_dsp::SLOPE_STEP_HZ_PER_S).round() as u64;
        if step(&waveform) != step(&chip) {
            let (stated, registers) = (step(&waveform), step(&chip));
            return Err(CustomError::Contradiction { what: "slope (RSU)", stated, registers });
        }
        Ok(Custom { waveform, registers })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use radome_dsp::RxMask;

    proptest! {
        #[test]
        fn blobs_round_trip(
            samples in 16usize..256, chirps in 1usize..64, mask in 1u8..8, band in 3u32..40, gain in 4u32..13,
            rest_us in 70u32..800,
        ) {
            let antennas: Vec<u8> = (1..=3).filter(|a| mask >> (a - 1) & 1 == 1).collect();
            let chirp_interval_s = samples as f64 / 2e6 + f64::from(rest_us) * 1e-6;
            let waveform = Waveform::realise(WaveformRequest {
                start_frequency_hz: 58.2e9,
                end_frequency_hz: 58.2e9 + f64::from(band) * 1e8,
                samples_per_chirp: samples,
                chirps_per_frame: chirps,
                sample_rate_hz: 2e6,
                chirp_interval_s,
                frame_interval_s: chirps as f64 * 1.1 * chirp_interval_s + 0.0125,
                rx_antennas: RxMask::from_antennas(&antennas).expect("valid"),
                if_gain_db: f64::from(gain) * 5.0 - if gain < 6 { 2.0 } else { 0.0 },
                ..WaveformRequest::paper()
            });
            let Ok(waveform) = waveform else { return Ok(()) };
            let Ok(custom) = Custom::compile(&waveform) else { return Ok(()) };
            let back = Custom::decode(&custom.encode()).expect("decodes");
            prop_assert_eq!(&back.registers, &custom.registers);
            let (a, b) = (&back.waveform, &custom.waveform);
            prop_assert_eq!(a.slope_hz_per_s, b.slope_hz_per_s);
            prop_assert_eq!(a.chirp_interval_s, b.chirp_interval_s);
            prop_assert_eq!(a.shape(), b.shape());
            prop_assert_eq!(a.request.rx_antennas, b.request.rx_antennas);
            prop_assert!((a.request.frame_interval_s / b.request.frame_interval_s - 1.0).abs() < 1e-7);
            prop_assert!(a.check_compatible(b).is_ok() && b.check_compatible(a).is_ok());
            // The decoded waveform is the same after another round trip.
            prop_assert_eq!(Custom::decode(&back.encode()).expect("decodes"), back);
        }

        #[test]
        fn any_blob_is_decoded_without_panic(words in prop::collection::vec(any::<u32>(), 0..80)) {
            let blob: Vec<u8> = words.iter().flat_map(|w| w.to_le_bytes()).collect();
            let _ = Custom::decode(&blob);
        }
    }

    mod hard_cases {
        use super::*;

        /// Regression test: the lowest sample rate, 78201.37 Hz, was read back as 78201 Hz, which was refused.
        #[test]
        fn the_lowest_and_the_highest_sample_rate_are_read_back() {
            for sample_rate_hz in [80e6 / 1023.0, 80e6 / 1022.0, 80e6 / 34.0, 4e6] {
                let request = WaveformRequest {
                    samples_per_chirp: 64,
                    chirps_per_frame: 4,
                    sample_rate_hz,
                    chirp_interval_s: 2e-3,
                    ..WaveformRequest::paper()
                };
                let custom = Custom::compile(&Waveform::realise(request).expect("valid")).expect("fits");
                let back = Custom::decode(&custom.encode()).expect("decodes");
                assert_eq!(back.waveform.sample_rate_hz, sample_rate_hz);
                assert_eq!(back.registers, custom.registers);
            }
        }

        #[test]
        fn contradictory_blobs_are_refused_with_both_values() {
            let waveform = Waveform::realise(WaveformRequest::paper()).expect("valid");
            let blob = Custom::compile(&waveform).expect("fits").encode();
            let with = |index: usize, word: u32| {
                let mut blob = blob.clone();
                blob[4 * index..4 * index + 4].copy_from_slice(&word.to_le_bytes());
                Custom::decode(&blob).expect_err("refused").to_string()
            };
            assert!(with(7, 99).contains("chirps in a frame is 99 by the settings and 128"), "{}", with(7, 99));
            assert!(with(5, 15).contains("slope") || with(5, 15).contains("Hz"), "{}", with(5, 15));
            assert!(with(16, 0).contains("does not write"), "{}", with(16, 0));
            assert!(with(0, u32::MAX).contains("are needed"), "{}", with(0, u32::MAX));
            assert!(with(12, f32::NAN.to_bits()).contains("frame_interval_s"), "{}", with(12, f32::NAN.to_bits()));
            for length in 0..blob.len() {
                Custom::decode(&blob[..length]).expect_err("too short");
            }
        }
    }
}
