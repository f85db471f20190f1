//! Conversion of path amplitudes to LSB: link budget and analogue IF filters, before sampling.

use num_complex::Complex64;
use radome_dsp::Waveform;

use super::Receiver;

/// Impedance for which conversion gain is stated, ohm.
const REFERENCE_OHM: f64 = 50.0;
/// Poles of the anti-alias filter (datasheet: four; Butterworth assumed).
const ANTI_ALIAS_POLES: i32 = 4;
/// Damping of the pole pairs of a Butterworth filter of order four: `2 sin(pi/8)` and `2 sin(3 pi/8)`.
const DAMPING: [f64; 2] = [0.765_366_864_730_179_6, 1.847_759_065_022_573_5];

/// High-pass (first order) and anti-alias filter of the IF chain.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Filters {
    high_pass_hz: f64,
    anti_alias_hz: f64,
}

impl Filters {
    /// Makes the filters that the waveform sets, with the receiver's deviations.
    pub fn new(receiver: &Receiver, waveform: &Waveform) -> Self {
        Filters {
            high_pass_hz: waveform.request.high_pass_cutoff_hz * receiver.high_pass_cutoff_scale,
            anti_alias_hz: waveform.request.anti_alias_cutoff_hz * receiver.anti_alias_cutoff_scale,
        }
    }

    /// Complex response at a true beat frequency (before folding), of either sign.
    pub fn response(&self, frequency_hz: f64) -> Complex64 {
        let [re, im] = self.response_in_lane(frequency_hz);
        Complex64::new(re, im)
    }

    /// Real and imaginary part of the same response, for loops over SIMD lanes. All factors share one denominator, so
    /// there is a single division.
    #[inline(always)]
    pub(crate) fn response_in_lane(&self, frequency_hz: f64) -> [f64; 2] {
        let (x, y) = (frequency_hz / self.high_pass_hz, frequency_hz / self.anti_alias_hz);
        let quadratic = 1.0 - y * y;
        // Product of both pole pairs, then with the high-pass `j x / (1 + j x)`.
        let pole_pairs =
            [quadratic * quadratic - DAMPING[0] * DAMPING[1] * y * y, (DAMPING[0] + DAMPING[1]) * y * quadratic];
        let denominator = [pole_pairs[0] - x * pole_pairs[1], pole_pairs[1] + x * pole_pairs[0]];
        let factor = x / (denominator[0] * denominator[0] + denominator[1] * denominator[1]);
        [denominator[1] * factor, denominator[0] * factor]
    }

    /// Power response of the high-pass alone.
    pub fn high_pass_power(&self, frequency_hz: f64) -> f64 {
        let x = frequency_hz / self.high_pass_hz;
        x * x / (1.0 + x * x)
    }

    /// Power response of the anti-alias filter alone.
    pub fn anti_alias_power(&self, frequency_hz: f64) -> f64 {
        1.0 / (1.0 + (frequency_hz / self.anti_alias_hz).powi(2 * ANTI_ALIAS_POLES))
    }
}

/// LSB per volt.
pub fn lsb_per_volt(receiver: &Receiver) -> f64 {
    4096.0 / receiver.adc_full_scale_v
}

/// Peak LSB at the ADC of a path whose amplitude (isotropic antennas, aperture `lambda/4 pi` contained) is 1, before
/// the filters: `sqrt(2 * 50 ohm * P_tx G_t G_r) * 10^((conversion + IF + correction)/20)`.
pub fn lsb_per_unit_amplitude(receiver: &Receiver, waveform: &Waveform) -> f64 {
    let power_dbm = receiver.transmit_power_dbm
        - receiver.transmit_power_step_db * f64::from(31 - waveform.request.tx_power_level.min(31))
        + receiver.antenna.tx_gain_dbi
        + receiver.antenna.rx_gain_dbi;
    let gain_db = receiver.conversion_gain_db + waveform.request.if_gain_db + receiver.gain_correction_db;
    let watt = 1e-3 * 10f64.powf(0.1 * power_dbm);
    (2.0 * REFERENCE_OHM * watt).sqrt() * 10f64.powf(0.05 * gain_db) * lsb_per_volt(receiver)
}

/// Thermal noise density at the ADC before the filters, LSB^2 per sample: `k T0 F G * fs/2`.
pub fn thermal_lsb2(receiver: &Receiver, waveform: &Waveform) -> f64 {
    const BOLTZMANN_T0_DBM_PER_HZ: f64 = -173.975;
    let density_dbm =
        BOLTZMANN_T0_DBM_PER_HZ + receiver.noise_figure_db + receiver.conversion_gain_db + waveform.request.if_gain_db;
    let volt2_per_hz = 1e-3 * 10f64.powf(0.1 * density_dbm) * REFERENCE_OHM;
    volt2_per_hz * 0.5 * waveform.sample_rate_hz * lsb_per_volt(receiver).powi(2)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Compares with the product of a high-pass and two pole pairs, each as a separate complex quotient.
    #[test]
    fn the_response_is_the_product_of_all_filter_sections() {
        let filters = Filters { high_pass_hz: 80e3, anti_alias_hz: 500e3 };
        for i in -2000..2000 {
            let frequency_hz = 1e3 * f64::from(i);
            let (x, y) = (frequency_hz / filters.high_pass_hz, frequency_hz / filters.anti_alias_hz);
            let high_pass = Complex64::new(0.0, x) / Complex64::new(1.0, x);
            let section = |damping: f64| Complex64::new(1.0 - y * y, damping * y);
            let expected = high_pass / section(DAMPING[0]) / section(DAMPING[1]);
            let got = filters.response(frequency_hz);
            assert!((got - expected).norm() < 1e-14, "{frequency_hz} Hz: {got} {expected}");
            let power = filters.high_pass_power(frequency_hz) * filters.anti_alias_power(frequency_hz);
            assert!((got.norm_sqr() - power).abs() < 1e-12, "{frequency_hz} Hz: {got} {power}");
        }
    }
}
