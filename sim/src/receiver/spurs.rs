//! Spurious tones at the ADC: clocks and supplies that couple into the baseband, independently of the scene.

use std::f64::consts::TAU;

use rand::Rng;
use rand_xoshiro::Xoshiro256PlusPlus;

use super::{Noise, SpurPhase};
use crate::random::{Purpose, draw, generator};

/// Level of the weakest possible spur below the strongest one, dB.
const SPREAD_DB: f64 = 20.0;
/// Least and greatest frequency, as a part of the sample rate.
const BAND: [f64; 2] = [0.02, 0.5];

/// One tone in one receiver.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Spur {
    amplitude_lsb: f64,
    cycles_per_sample: f64,
    phase_cycles: f64,
    phase: SpurPhase,
}

/// The spurious tones of one receiver.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Spurs {
    spurs: Vec<Spur>,
    sample_rate_hz: f64,
    seed: u64,
    rx: u64,
}

impl Spurs {
    /// Draws the tones of a receiver. Frequencies are the same in all receivers of a chip; each receiver has its own
    /// levels and phases.
    pub fn draw(noise: &Noise, sample_rate_hz: f64, seed: u64, rx: usize) -> Self {
        let rx = rx as u64;
        let mut chip_rng = generator(seed, Purpose::Spur, [0, 0]);
        let mut channel_rng = generator(seed, Purpose::Spur, [0, 1 + rx]);
        let mut spurs = Vec::with_capacity(noise.spurs);
        for index in 0..noise.spurs {
            let cycles_per_sample = draw(&mut chip_rng, BAND);
            let drawn_phase = match chip_rng.random_range(0..3u32) {
                0 => SpurPhase::Locked,
                1 => SpurPhase::Free,
                _ => SpurPhase::Random,
            };
            let below_db = SPREAD_DB * channel_rng.random::<f64>();
            let below_db = if index == 0 { 0.0 } else { below_db };
            spurs.push(Spur {
                amplitude_lsb: noise.spur_lsb * 10f64.powf(-0.05 * below_db),
                cycles_per_sample,
                phase_cycles: channel_rng.random::<f64>(),
                phase: noise.spur_phase.unwrap_or(drawn_phase),
            });
        }
        Spurs { spurs, sample_rate_hz, seed, rx }
    }

    /// Returns the generator of phases that are new in every chirp of a frame.
    pub fn phases(&self, index: u64) -> Xoshiro256PlusPlus {
        generator(self.seed, Purpose::Spur, [1 + index, self.rx])
    }

    /// Adds the tones to a chirp. `first_s` is the time of its first sample in the scene.
    pub fn add(&self, first_s: f64, phases: &mut Xoshiro256PlusPlus, out: &mut [f32]) {
        for spur in &self.spurs {
            let start_cycles = match spur.phase {
                SpurPhase::Locked => spur.phase_cycles,
                SpurPhase::Free => {
                    (spur.phase_cycles + spur.cycles_per_sample * self.sample_rate_hz * first_s).rem_euclid(1.0)
                }
                SpurPhase::Random => phases.random::<f64>(),
            };
            for (n, x) in out.iter_mut().enumerate() {
                let angle_rad = TAU * (start_cycles + spur.cycles_per_sample * n as f64);
                *x += (spur.amplitude_lsb * angle_rad.cos()) as f32;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SAMPLES: usize = 128;
    const RATE_HZ: f64 = 2e6;

    /// Chirps of a frame, 64 samples each, with only spurs.
    fn chirps(phase: SpurPhase, rx: usize) -> Vec<Vec<f32>> {
        let noise = Noise { spurs: 3, spur_lsb: 2.0, spur_phase: Some(phase), ..Noise::default() };
        let spurs = Spurs::draw(&noise, RATE_HZ, 5, rx);
        let mut phases = spurs.phases(7);
        let chirp = |chirp: i32| {
            let mut out = vec![0f32; SAMPLES];
            spurs.add(0.7 + 391.55e-6 * f64::from(chirp), &mut phases, &mut out);
            out
        };
        (0..64).map(chirp).collect()
    }

    fn power(chirp: &[f32]) -> f64 {
        chirp.iter().map(|x| f64::from(*x).powi(2)).sum::<f64>() / chirp.len() as f64
    }

    #[test]
    fn locked_spurs_are_the_same_in_every_chirp_and_others_are_not() {
        let locked = chirps(SpurPhase::Locked, 0);
        assert!(locked.iter().all(|chirp| *chirp == locked[0]));
        // Half of the square of the strongest tone, plus the power of tones that are up to 20 dB weaker.
        assert!((1.5..7.0).contains(&power(&locked[0])), "{}", power(&locked[0]));
        for phase in [SpurPhase::Free, SpurPhase::Random] {
            let unlocked = chirps(phase, 0);
            let mean: Vec<f32> =
                (0..SAMPLES).map(|n| unlocked.iter().map(|chirp| chirp[n]).sum::<f32>() / 64.0).collect();
            assert!(power(&mean) < 0.3 * power(&unlocked[3]), "{phase:?}: {}", power(&mean));
            assert_eq!(unlocked, chirps(phase, 0));
        }
        assert_ne!(locked, chirps(SpurPhase::Locked, 1));
    }

    #[test]
    fn without_spurs_a_chirp_is_unchanged() {
        let spurs = Spurs::draw(&Noise::default(), RATE_HZ, 5, 0);
        let mut out = vec![3f32; SAMPLES];
        spurs.add(0.1, &mut spurs.phases(0), &mut out);
        assert_eq!(out, vec![3f32; SAMPLES]);
    }
}
