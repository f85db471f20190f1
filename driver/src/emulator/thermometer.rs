//! Temperature sensor of the emulated chip behind its slow ADC (SADC).
//!
//! A code stands for a voltage, and the voltage for a temperature, by the formula that the vendor's library applies:
//! `V = code 1.21 V / 1023`, `T = (V - 0.78984 V) / 0.00286 V/C`, so that a code is 0.41 C. The temperature is
//! synthetic: an offset by the seed, a warm-up over some minutes, a slow drift, and noise below a code.

use std::f64::consts::TAU;
use std::time::Instant;

use radome_dsp::split_mix_64;

const REFERENCE_V: f64 = 1.21;
const LARGEST_CODE: f64 = 1023.0;
const OFFSET_V: f64 = 0.789_84;
const SLOPE_V_PER_C: f64 = 0.002_86;
/// Temperature rise of a powered board, degrees Celsius, and its time constant.
const WARM_UP_C: f64 = 3.0;
const WARM_UP_S: f64 = 120.0;
/// Amplitude and period of the drift.
const DRIFT_C: f64 = 0.5;
const DRIFT_PERIOD_S: f64 = 300.0;
/// Largest noise of a conversion.
const NOISE_C: f64 = 0.4;

pub(super) struct Thermometer {
    seed: u64,
    /// Time at which the board got power.
    start: Instant,
}

impl Thermometer {
    pub fn new(seed: u64) -> Self {
        Thermometer { seed, start: Instant::now() }
    }

    /// Code of a conversion made now. The number of the conversion selects its noise.
    pub fn code(&self, conversion: u64) -> u32 {
        code(self.celsius(self.start.elapsed().as_secs_f64(), conversion))
    }

    fn celsius(&self, elapsed_s: f64, conversion: u64) -> f64 {
        let offset_c = 34.0 + 4.0 * unit(self.seed, u64::MAX);
        let warm_up_c = WARM_UP_C * (1.0 - (-elapsed_s / WARM_UP_S).exp());
        let drift_c = DRIFT_C * (TAU * (elapsed_s / DRIFT_PERIOD_S + unit(self.seed, u64::MAX - 1))).sin();
        offset_c + warm_up_c + drift_c + NOISE_C * (2.0 * unit(self.seed, conversion) - 1.0)
    }
}

fn code(celsius: f64) -> u32 {
    let volts = OFFSET_V + SLOPE_V_PER_C * celsius;
    (volts / REFERENCE_V * LARGEST_CODE).round().clamp(0.0, LARGEST_CODE) as u32
}

/// Computes a number from 0 to 1 from a seed and an index (SplitMix64).
fn unit(seed: u64, index: u64) -> f64 {
    split_mix_64(seed.wrapping_add(index.wrapping_mul(0x9E37_79B9_7F4A_7C15))) as f64 / u64::MAX as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Temperature that the vendor's library computes from a code.
    fn celsius(code: u32) -> f64 {
        (f64::from(code) * 1.21 / 1023.0 - 0.789_84) / 0.002_86
    }

    #[test]
    fn readings_are_plausible_and_differ_between_boards() {
        let mut first = Vec::new();
        for seed in 0..100 {
            let thermometer = Thermometer::new(seed);
            let reading = |i: u32| code(thermometer.celsius(f64::from(i) * 30.0, u64::from(i)));
            let readings: Vec<u32> = (0..100).map(reading).collect();
            assert!(readings.iter().all(|code| (30.0..45.0).contains(&celsius(*code))), "seed {seed}: {readings:?}");
            assert!(readings.iter().any(|code| *code != readings[0]), "seed {seed}: it never changes");
            first.push(readings[0]);
        }
        first.sort_unstable();
        first.dedup();
        assert!(first.len() > 5, "{first:?}");
    }

    #[test]
    fn readings_follow_from_the_seed_and_change_slowly() {
        let (a, b) = (Thermometer::new(7), Thermometer::new(7));
        for i in 0..1000 {
            let elapsed_s = i as f64 * 0.1;
            assert_eq!(a.celsius(elapsed_s, i), b.celsius(elapsed_s, i));
            let change = a.celsius(elapsed_s + 1.0, i) - a.celsius(elapsed_s, i);
            assert!(change.abs() < 0.1, "{change} in a second");
        }
    }

    #[test]
    fn temperatures_round_trip_within_half_a_code() {
        for tenths in 300..450_u32 {
            let expected = f64::from(tenths) / 10.0;
            assert!((celsius(code(expected)) - expected).abs() < 0.21, "{expected}");
        }
    }
}
