//! Phase noise of the transmitter, as far as it does not cancel.
//!
//! Mixer and echo have the same oscillator, with a delay `tau` between them. The phase that remains in a beat is
//! `phi(t) - phi(t - tau)`. For delays of a room it is `tau phi'` (to 0.9 % at 21.7 m and 500 kHz). The exact rate is
//! that of half a delay earlier, which matters only between echoes far apart and at large offsets.
//!
//! A beat `Re a exp(j theta)` receives the additional signal `phi'(t) Re j tau a exp(j theta)`. A second grid of the
//! same tones, each times `j` and its delay, therefore gives the noise of all echoes at once. It includes every
//! cancellation between them. On one side of a beat there is `(2 pi f tau)^2` of the oscillator's noise: -47.6 dB at
//! 1 m and 100 kHz, -33.6 dB at 5 m.
//!
//! For an oscillator whose noise falls with the square of the offset, `phi'` is white. The model neglects that the IF
//! filters act differently on the sidebands and on the beat.

use rand_distr::{Distribution, StandardNormal};
use rand_xoshiro::Xoshiro256PlusPlus;

use super::PhaseNoise;

/// Generator of the transmitter's phase rate, sample by sample.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PhaseRates {
    /// Standard deviation of the rates, rad/s.
    sigma_rad_per_s: f64,
}

impl PhaseRates {
    /// Makes the phase noise of an oscillator, up to half a sample rate: `S_phi' = 2 L (2 pi f)^2`, the same at all
    /// offsets.
    pub fn new(noise: &PhaseNoise, sample_rate_hz: f64) -> Self {
        let level = 10f64.powf(0.1 * noise.level_dbc_per_hz);
        PhaseRates { sigma_rad_per_s: std::f64::consts::TAU * noise.offset_hz * (level * sample_rate_hz).sqrt() }
    }

    /// Adds the noise of the next samples. `by_delay` is the factor of `phi'`: the sum of tones times `j` and their
    /// delays, LSB s.
    pub fn add(&self, rng: &mut Xoshiro256PlusPlus, by_delay: &[f32], out: &mut [f32]) {
        for (x, factor) in out.iter_mut().zip(by_delay) {
            let rate: f64 = StandardNormal.sample(rng);
            *x += (self.sigma_rad_per_s * rate) as f32 * factor;
        }
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::TAU;

    use num_complex::{Complex, Complex64};
    use radome_dsp::SPEED_OF_LIGHT_M_PER_S;
    use rand::Rng;

    use super::*;
    use crate::random::{Purpose, generator};
    use crate::synthesis::{SynthesisScratch, Synthesiser, Tone};

    const SAMPLES: usize = 256;
    const RATE_HZ: f64 = 2e6;
    const START_HZ: f64 = 60e9;
    const SLOPE_HZ_PER_S: f64 = 20e12;

    /// Phase as a sum of sinusoids up to 500 kHz, rad: its value and its rate.
    fn phase(parts: &[(f64, f64, f64)], time_s: f64) -> (f64, f64) {
        parts.iter().fold((0.0, 0.0), |(value, rate), (hz, amplitude, at)| {
            let (sine, cosine) = (TAU * hz * time_s + at).sin_cos();
            (value + amplitude * sine, rate + amplitude * TAU * hz * cosine)
        })
    }

    /// Powers of the noise of echoes between 0.3 and 20 m, with oscillator noise up to `most_hz` from the carrier. They
    /// are that of `exp(j (theta + phi(t) - phi(t - tau)))`, that of the second grid, and that of their difference.
    fn powers(most_hz: f64) -> [f64; 3] {
        let mut rng = generator(5, Purpose::PhaseNoise, [0, 0]);
        let parts: Vec<(f64, f64, f64)> =
            (0..60).map(|_| (rng.random_range(1e3..most_hz), 2e-4, rng.random_range(0.0..TAU))).collect();
        let echoes: Vec<(f64, Complex64)> = (0..40)
            .map(|_| {
                let delay_s = 2.0 * rng.random_range(0.3..20.0) / SPEED_OF_LIGHT_M_PER_S;
                (delay_s, Complex64::from_polar(rng.random_range(1.0..300.0), rng.random_range(0.0..TAU)))
            })
            .collect();
        let middle_s = (SAMPLES / 2) as f64 / RATE_HZ;
        let synthesiser = Synthesiser::new(SAMPLES);
        let mut grid = synthesiser.grid();
        for (delay_s, a) in &echoes {
            let a = a * Complex64::new(0.0, *delay_s);
            synthesiser.add(
                &Tone {
                    phase_cycles: delay_s * (START_HZ + SLOPE_HZ_PER_S * middle_s),
                    cycles_per_sample: SLOPE_HZ_PER_S * delay_s / RATE_HZ,
                    amplitude: Complex::new(a.re as f32, a.im as f32),
                },
                &mut grid,
            );
        }
        let mut by_delay = vec![0f32; SAMPLES];
        synthesiser.transform(&grid, &mut by_delay, &mut SynthesisScratch::default());
        let mut powers = [0.0; 3];
        for (n, by_delay) in by_delay.iter().enumerate() {
            let t = n as f64 / RATE_HZ;
            let (now, rate) = phase(&parts, t);
            let exact: f64 = echoes
                .iter()
                .map(|(delay_s, a)| {
                    let theta = TAU * delay_s * (START_HZ + SLOPE_HZ_PER_S * t);
                    let beat = a * Complex64::from_polar(1.0, theta);
                    (beat * (Complex64::from_polar(1.0, now - phase(&parts, t - delay_s).0) - 1.0)).re
                })
                .sum();
            let gridded = rate * f64::from(*by_delay);
            for (power, x) in powers.iter_mut().zip([exact, gridded, exact - gridded]) {
                *power += x * x;
            }
        }
        powers
    }

    /// The signals agree if the phase changes little within a delay. The powers agree everywhere in the band.
    #[test]
    fn the_grid_of_tones_times_their_delays_gives_the_noise_of_all_echoes() {
        let [exact, _, missed] = powers(1e5);
        // The largest error is pi f tau, 4.2 %, for the farthest echo at the highest frequency.
        assert!(missed / exact < 0.03f64.powi(2), "{:.1} dB", 10.0 * (missed / exact).log10());
        let [exact, gridded, _] = powers(5e5);
        assert!((10.0 * (gridded / exact).log10()).abs() < 0.5, "{gridded} {exact}");
    }

    /// Sidebands of a beat at 100 kHz from it, from the drawn rates, relative to the oscillator's own.
    #[test]
    fn noise_cancels_by_47_6_db_at_a_metre_and_33_6_db_at_five() {
        let oscillator = PhaseNoise { level_dbc_per_hz: -80.0, offset_hz: 1e5 };
        let rates = PhaseRates::new(&oscillator, RATE_HZ);
        // At an offset of ten kilohertz the oscillator has 20 dB more noise, and the delay cancels 20 dB more.
        for (range_m, offset_hz, cancelled_db) in [(1.0, 1e5, -47.6), (5.0, 1e5, -33.6), (1.0, 1e4, -67.6)] {
            let delay_s = 2.0 * range_m / SPEED_OF_LIGHT_M_PER_S;
            let chirp = vec![delay_s as f32; 8 * SAMPLES];
            let mut density = 0.0;
            const CHIRPS: u64 = 3000;
            for index in 0..CHIRPS {
                // Phase that remains in a beat, independently of its frequency.
                let mut remaining = vec![0f32; chirp.len()];
                rates.add(&mut generator(1, Purpose::PhaseNoise, [index, 0]), &chirp, &mut remaining);
                let step_rad = -TAU * offset_hz / RATE_HZ;
                let sum: Complex64 = remaining
                    .iter()
                    .enumerate()
                    .map(|(n, x)| Complex64::from_polar(f64::from(*x), step_rad * n as f64))
                    .sum();
                density += sum.norm_sqr() / (chirp.len() as f64 * RATE_HZ) / CHIRPS as f64;
            }
            let oscillator_db = -80.0 - 20.0 * (offset_hz / 1e5).log10();
            let remaining_db = 10.0 * density.log10() - oscillator_db;
            assert!((remaining_db - cancelled_db).abs() < 0.3, "{range_m} m, {offset_hz} Hz: {remaining_db} dB");
        }
    }
}
