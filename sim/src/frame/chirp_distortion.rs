//! Errors common to all echoes of a chirp: vibration of the radar, settling of the chip within a frame, slow gain
//! drift, and jitter of the chirp times. Leakage inside the chip has separate errors ([`ClutterDrift`]).

use std::f64::consts::TAU;

use num_complex::Complex64;
use rand::Rng;
use rand_distr::{Distribution, StandardNormal};

use crate::prepared_scene::drift;
use crate::random::{Purpose, generator};
use crate::receiver::ClutterDrift;
use crate::scene::Scene;
use crate::sway::Sway;

/// Error common to all echoes of one chirp.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ChirpDistortion {
    /// Factor on all echoes.
    pub factor: Complex64,
    /// Delay of their sampling, s.
    pub late_s: f64,
}

/// Generator of these errors for a scene and a seed.
#[derive(Debug, Clone, PartialEq)]
pub struct ChirpDistortions {
    seed: u64,
    clutter: ClutterDrift,
    gain_phases: [f64; 3],
    vibration: Option<Sway>,
    /// Phase of an echo on boresight for each metre that the radar moves, rad.
    rad_per_m: f64,
    slope_hz_per_s: f64,
}

impl ChirpDistortions {
    /// Creates the generator; `None` where a scene specifies no such error.
    pub fn new(scene: &Scene, seed: u64) -> Option<Self> {
        let clutter = scene.receiver().clutter.clone();
        let vibration = scene.file().radar.vibration.filter(|vibration| vibration.amplitude_m > 0.0);
        let sizes = [
            clutter.gain_drift_per_10s,
            clutter.settling_phase_rad,
            clutter.settling_gain,
            clutter.settling_frequency_hz,
            clutter.chirp_jitter_s,
        ];
        if vibration.is_none() && sizes.iter().all(|&size| size == 0.0) {
            return None;
        }
        let vibration = vibration.map(|v| {
            let mut rng = generator(seed, Purpose::Vibration, [0, 0]);
            Sway::draw(v.amplitude_m, v.frequency_hz, v.bandwidth, &mut rng)
        });
        let mut rng = generator(seed, Purpose::GainDrift, [0, 0]);
        Some(ChirpDistortions {
            seed,
            clutter,
            gain_phases: std::array::from_fn(|_| rng.random_range(0.0..TAU)),
            vibration,
            rad_per_m: 2.0 * scene.wavenumber_per_m(),
            slope_hz_per_s: scene.waveform().slope_hz_per_s,
        })
    }

    /// Computes the errors of a frame that starts at a scene time, s, for the middles of its chirps, relative to the
    /// start, s.
    pub fn of_frame(&self, index: u64, start_s: f64, middles_s: impl Iterator<Item = f64>) -> Vec<ChirpDistortion> {
        let clutter = &self.clutter;
        let mut rng = generator(self.seed, Purpose::ChirpJitter, [index, 0]);
        let gain = 1.0 + clutter.gain_drift_per_10s * drift(start_s, &self.gain_phases);
        middles_s
            .map(|middle_s| {
                let unsettled = (-middle_s / clutter.settling_time_s).exp();
                // A forward motion by a metre shortens every path by two metres.
                let ahead_m = self.vibration.as_ref().map_or(0.0, |sway| sway.at(start_s + middle_s)[0]);
                let phase = clutter.settling_phase_rad * unsettled - self.rad_per_m * ahead_m;
                let normal: f64 = StandardNormal.sample(&mut rng);
                // A frequency offset rotates an echo in proportion to its delay. Late sampling rotates it in proportion
                // to its beat frequency, slope times delay.
                let by_frequency_s = clutter.settling_frequency_hz * unsettled / self.slope_hz_per_s;
                ChirpDistortion {
                    factor: Complex64::from_polar(gain * (1.0 + clutter.settling_gain * unsettled), phase),
                    late_s: by_frequency_s + clutter.chirp_jitter_s * normal,
                }
            })
            .collect()
    }
}
