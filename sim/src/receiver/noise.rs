//! Receiver noise with the measured spectrum: white Gaussian bins shaped by the density, with one inverse real FFT per
//! chirp.

use std::sync::Arc;

use num_complex::Complex;
use radome_dsp::spectrum::inverse_real_fft_f32;
use radome_dsp::{KernelLevel, Waveform};
use rand::RngCore;
use rand_xoshiro::Xoshiro256PlusPlus;
use realfft::ComplexToReal;

use super::budget::{Filters, thermal_lsb2};
use super::{Receiver, RxChannel};
use crate::lanes::{compiled_for_levels, cos_sin_of_turns, ln};

/// Variance that rounding adds, LSB^2.
const ROUNDING_LSB2: f64 = 1.0 / 12.0;

/// Density for each fast-time bin 0..=N/2, LSB^2 per sample, including rounding (see [`super::Noise`]).
pub fn density_lsb2(receiver: &Receiver, waveform: &Waveform) -> Vec<f64> {
    let samples = waveform.request.samples_per_chirp;
    let noise = &receiver.noise;
    if let Some(measured) = &noise.psd_lsb2
        && measured.len() == samples / 2 + 1
    {
        return measured.clone();
    }
    let filters = Filters::new(receiver, waveform);
    let thermal_lsb2 = thermal_lsb2(receiver, waveform);
    let bin_hz = waveform.sample_rate_hz / samples as f64;
    (0..=samples / 2)
        .map(|bin| {
            // 1/f has no value at zero, so the lowest bin takes the value at a quarter bin.
            let frequency_hz = (bin as f64 * bin_hz).max(0.25 * bin_hz);
            let amplifier_flicker = (noise.amplifier_flicker_corner_hz / frequency_hz).powf(noise.flicker_exponent);
            let before_filter = |frequency_hz: f64, flicker: f64| {
                (noise.baseband_white_lsb.powi(2) + thermal_lsb2 * (filters.high_pass_power(frequency_hz) + flicker))
                    * filters.anti_alias_power(frequency_hz)
            };
            let folded: f64 = (1..=2)
                .map(|zone| {
                    let zone_hz = f64::from(zone) * waveform.sample_rate_hz;
                    before_filter(zone_hz - frequency_hz, 0.0) + before_filter(zone_hz + frequency_hz, 0.0)
                })
                .sum();
            noise.adc_white_lsb.powi(2)
                + before_filter(frequency_hz, amplifier_flicker)
                + folded
                + noise.flicker_lsb2_at_100khz * (1e5 / frequency_hz).powf(noise.flicker_exponent)
        })
        .collect()
}

/// Density of one channel's noise, LSB^2 per sample, with the channel's own deviations.
pub fn channel_density_lsb2(receiver: &Receiver, channel: &RxChannel, waveform: &Waveform) -> Vec<f64> {
    let factor = 10f64.powf(0.1 * channel.noise_db);
    let bins = waveform.request.samples_per_chirp / 2 + 1;
    let measured = channel.psd_lsb2.clone().filter(|psd| psd.len() == bins);
    measured.unwrap_or_else(|| density_lsb2(receiver, waveform)).iter().map(|density| density * factor).collect()
}

/// Generator of noise with a given density, which it adds to chirps.
#[derive(Clone)]
pub struct NoiseShaper {
    amplitude: Vec<f32>,
    samples: usize,
    inverse: Arc<dyn ComplexToReal<f32>>,
}

/// Buffers of a [`NoiseShaper`].
#[derive(Debug, Default)]
pub struct NoiseScratch {
    bits: Vec<u64>,
    spectrum: Vec<Complex<f32>>,
    chirp: Vec<f32>,
    fft: Vec<Complex<f32>>,
}

impl std::fmt::Debug for NoiseShaper {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("NoiseShaper").field("samples", &self.samples).finish_non_exhaustive()
    }
}

compiled_for_levels! {
    /// Converts random bits to complex normal numbers, of unit variance in each part times an amplitude (Box and Muller,
    /// Ann. Math. Stat. 29, 1958). Half of the bits give the radius, up to 6.7, the other half the angle.
    fn normals(bits: &[u64], amplitudes: &[f32], out: &mut [Complex<f32>]) = normals_body;
}

#[inline(always)]
fn normals_body(bits: &[u64], amplitudes: &[f32], out: &mut [Complex<f32>]) {
    const PER_UNIT: f64 = 1.0 / 4_294_967_296.0;
    for ((&bits, &amplitude), out) in bits.iter().zip(amplitudes).zip(out) {
        let [radius, angle] = [(bits >> 32) as u32, bits as u32];
        let radius = (-2.0 * ln((f64::from(radius) + 0.5) * PER_UNIT)).sqrt() as f32 * amplitude;
        let (cosine, sine) = cos_sin_of_turns((f64::from(angle) * PER_UNIT) as f32);
        *out = Complex::new(radius * cosine, radius * sine);
    }
}

impl NoiseShaper {
    /// Makes a generator for a density from [`density_lsb2`]. The noise that rounding adds later is subtracted.
    pub fn new(density_lsb2: &[f64], samples: usize) -> Self {
        let inverse = inverse_real_fft_f32(samples);
        let bins = samples / 2 + 1;
        let amplitude = (0..bins)
            .map(|bin| {
                let density = (density_lsb2.get(bin).copied().unwrap_or(0.0) - ROUNDING_LSB2).max(0.0);
                let unpaired = bin == 0 || 2 * bin == samples;
                (density / (samples as f64 * if unpaired { 1.0 } else { 2.0 })).sqrt() as f32
            })
            .collect();
        NoiseShaper { amplitude, samples, inverse }
    }

    /// Adds one chirp of noise, multiplied by `scale`.
    pub fn add(&self, rng: &mut Xoshiro256PlusPlus, scale: f32, out: &mut [f32], scratch: &mut NoiseScratch) {
        scratch.bits.clear();
        scratch.bits.extend(self.amplitude.iter().map(|_| rng.next_u64()));
        scratch.spectrum.resize(self.amplitude.len(), Complex::default());
        normals(KernelLevel::detect(), &scratch.bits, &self.amplitude, &mut scratch.spectrum);
        // These bins are their own mirror images.
        if let Some(first) = scratch.spectrum.first_mut() {
            first.im = 0.0;
        }
        if let Some(last) = scratch.spectrum.last_mut().filter(|_| self.samples.is_multiple_of(2)) {
            last.im = 0.0;
        }
        scratch.chirp.resize(self.samples, 0.0);
        scratch.fft.resize(self.inverse.get_scratch_len(), Complex::default());
        // The lengths are consistent by construction, so this cannot fail.
        let is_transformed =
            self.inverse.process_with_scratch(&mut scratch.spectrum, &mut scratch.chirp, &mut scratch.fft).is_ok();
        if is_transformed {
            for (x, n) in out.iter_mut().zip(&scratch.chirp) {
                *x += scale * n;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lanes::tests::assert_same_at_every_level;
    use crate::random::{Purpose, generator};

    /// Moments of the standard normal distribution, and the share beyond three standard deviations.
    #[test]
    fn normals_have_the_moments_of_the_normal_distribution() {
        const COUNT: usize = 400_000;
        let mut rng = generator(4, Purpose::Noise, [0, 0]);
        let bits: Vec<u64> = (0..COUNT).map(|_| rng.next_u64()).collect();
        let mut all = vec![Complex::default(); COUNT];
        normals(KernelLevel::detect(), &bits, &vec![1.0; COUNT], &mut all);
        let mean = |of: &dyn Fn(f64) -> f64| {
            all.iter().flat_map(|z| [z.re, z.im]).map(|x| of(f64::from(x))).sum::<f64>() / (2 * COUNT) as f64
        };
        let moments = [1, 2, 3, 4, 6].map(|power| mean(&|x| x.powi(power)));
        for (moment, (expected, most)) in
            moments.into_iter().zip([(0.0, 0.005), (1.0, 0.008), (0.0, 0.02), (3.0, 0.05), (15.0, 0.7)])
        {
            assert!((moment - expected).abs() < most, "{moments:?}");
        }
        let beyond = mean(&|x| f64::from(u8::from(x.abs() > 3.0)));
        assert!((beyond / 0.002_699_8 - 1.0).abs() < 0.1, "{beyond}");
        let product = all.iter().map(|z| f64::from(z.re * z.im)).sum::<f64>() / COUNT as f64;
        assert!(product.abs() < 0.008, "both parts are independent: {product}");
    }

    #[test]
    fn extreme_bits_give_finite_numbers() {
        let mut out = [Complex::default(); 4];
        let bits = [0, u64::MAX, u64::from(u32::MAX), u64::from(u32::MAX) << 32];
        normals(KernelLevel::detect(), &bits, &[1.0; 4], &mut out);
        assert!(out.iter().all(|z| z.norm() < 6.8), "{out:?}");
    }

    #[test]
    fn every_instruction_set_gives_the_same_bits() {
        let mut rng = generator(4, Purpose::Noise, [0, 1]);
        let bits: Vec<u64> = (0..1000).map(|_| rng.next_u64()).collect();
        assert_same_at_every_level(|level| {
            let mut out = vec![Complex::default(); bits.len()];
            normals(level, &bits, &vec![0.7; bits.len()], &mut out);
            out.iter().map(|z| [z.re.to_bits(), z.im.to_bits()]).collect::<Vec<_>>()
        });
    }
}
