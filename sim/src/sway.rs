//! Small swaying reflectors, such as cables, plants, curtains, fans and objects on a desk, and motions of this kind.
//!
//! Real rooms move a little while they are empty. Consider a weak reflector that moves at centimetres a second, beside
//! a static echo 25 dB above it. It turns the phase of their sum by some 0.05 rad within a frame of 25 ms. After
//! removal of the mean over the frame, echoes remain beside zero Doppler. A [`Sway`] is a sum of a few sinusoids with
//! analytic derivatives, so that an echo follows it exactly in every chirp. [`SwayingReflectors`] adds the echoes of
//! all reflectors of a room to the paths of a frame.

use std::f64::consts::TAU;

use glam::DVec3;
use num_complex::Complex64;
use radome_dsp::SPEED_OF_LIGHT_M_PER_S;
use rand::Rng;
use rand_distr::{Distribution, StandardNormal};
use rand_xoshiro::Xoshiro256PlusPlus;

use crate::diffraction::{self, Column};
use crate::math::neighbours;
use crate::path_segment::{PathDerivatives, PathSample};
use crate::paths::Surroundings;
use crate::prepared_scene::PreparedScene;
use crate::random::{Purpose, generator};
use crate::scene::Scene;
use crate::scene_file::{SwayFile, SwayPlaceFile};
use crate::tracks::{Track, Tracks};

/// Number of sinusoids of a motion with a bandwidth above zero.
const WAVES: usize = 6;
/// Largest factor between the frequency of a wave and that of the motion.
const MAX_FREQUENCY_FACTOR: f64 = 4.0;
/// Periods of the fastest wave between two samples: over such a segment a septic polynomial follows a sinusoid to 4
/// millionths of its amplitude.
const PERIODS_AN_INTERVAL: f64 = 0.25;
/// Largest number of halvings of a frame.
const MAX_HALVINGS: u32 = 6;
/// Paths weaker than this fraction of the threshold of a single path are inaudible even together.
const AUDIBLE_FRACTION: f64 = 0.5;
/// Largest azimuth and elevation off the boresight in which walls are searched, rad.
const MAX_OFF_BORESIGHT_RAD: [f64; 2] = [0.87, 0.44];

/// Random motion along a line: a sum of sinusoids about one frequency.
#[derive(Debug, Clone, PartialEq)]
pub struct Sway {
    /// Amplitude, m, angular frequency, rad/s, and phase, rad, of each sinusoid.
    waves: Vec<[f64; 3]>,
}

impl Sway {
    /// Draws a motion of this displacement (rms over all phases). `bandwidth` is the standard deviation of the
    /// logarithm of the waves' frequencies; with 0 the motion is a single sinusoid.
    pub fn draw(rms_m: f64, frequency_hz: f64, bandwidth: f64, rng: &mut Xoshiro256PlusPlus) -> Self {
        let count = if bandwidth > 0.0 { WAVES } else { 1 };
        let amplitude_m = rms_m * (2.0 / count as f64).sqrt();
        let mut waves = Vec::with_capacity(count);
        for _ in 0..count {
            let normal: f64 = StandardNormal.sample(rng);
            let factor = (bandwidth * normal).exp().clamp(1.0 / MAX_FREQUENCY_FACTOR, MAX_FREQUENCY_FACTOR);
            waves.push([amplitude_m, TAU * frequency_hz * factor, rng.random_range(0.0..TAU)]);
        }
        Sway { waves }
    }

    /// Displacement, m, and its first three derivatives with respect to time.
    pub fn at(&self, time_s: f64) -> [f64; 4] {
        let mut sum = [0.0; 4];
        for &[amplitude_m, rate, phase] in &self.waves {
            let (sin, cos) = (rate * time_s + phase).sin_cos();
            let (first, second) = (amplitude_m * rate, amplitude_m * rate * rate);
            sum[0] += amplitude_m * sin;
            sum[1] += first * cos;
            sum[2] -= second * sin;
            sum[3] -= second * rate * cos;
        }
        sum
    }

    /// Frequency of the fastest wave, Hz.
    fn fastest_hz(&self) -> f64 {
        self.waves.iter().map(|wave| wave[1] / TAU).fold(0.0, f64::max)
    }
}

/// Echo of a reflector at one receiver.
#[derive(Debug, Clone, Copy, PartialEq)]
struct SwayEcho {
    /// Delay at rest, s.
    delay_s: f64,
    /// Change of the delay per metre of displacement, s/m.
    delay_s_per_m: f64,
    /// Amplitude at the ADC, LSB.
    amplitude: Complex64,
}

/// One path by way of a reflector.
#[derive(Debug, Clone, PartialEq)]
struct SwayPath {
    /// Echo at each receiver.
    receivers: Vec<SwayEcho>,
    /// Corners of the path, radar to radar, for diffraction by people.
    polyline: Vec<DVec3>,
}

/// Reflector: its motion and the paths by way of it.
#[derive(Debug, Clone, PartialEq)]
struct Reflector {
    motion: Sway,
    paths: Vec<SwayPath>,
}

/// The swaying reflectors of a room.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct SwayingReflectors {
    reflectors: Vec<Reflector>,
}

impl SwayingReflectors {
    /// Draws the reflectors of a scene for a seed. The draws of a reflector depend only on its group's index and its
    /// own index in the group.
    pub fn new(scene: &Scene, prepared: &PreparedScene, seed: u64) -> Self {
        let mut reflectors = Vec::new();
        for (g, group) in (0u64..).zip(&scene.file().room.sway) {
            let is_there = generator(seed, Purpose::Sway, [g, 0]).random::<f64>() < group.probability;
            if !is_there {
                continue;
            }
            for r in 0..group.reflectors as u64 {
                let mut rng = generator(seed, Purpose::Sway, [g, 1 + r]);
                let reflector = Reflector::draw(scene, prepared, group, &mut rng);
                if !reflector.paths.is_empty() {
                    reflectors.push(reflector);
                }
            }
        }
        SwayingReflectors { reflectors }
    }

    /// Adds the echoes in `span_s` from a start time to the paths of a frame. `columns` are the people at the ends of
    /// equal parts of the span; diffraction by them weakens the echoes.
    pub fn add(&self, start_s: f64, span_s: f64, columns: &[Vec<Column>], wavelength_m: f64, tracks: &mut Tracks) {
        for reflector in &self.reflectors {
            let halvings = halvings(span_s, reflector.motion.fastest_hz());
            let intervals = 1usize << halvings;
            let interval_s = span_s / intervals as f64;
            let motion: Vec<[f64; 4]> =
                (0..=intervals).map(|end| reflector.motion.at(start_s + interval_s * end as f64)).collect();
            for path in &reflector.paths {
                let factors: Vec<f64> = columns
                    .iter()
                    .map(|people| diffraction::past_columns(&path.polyline, people, wavelength_m))
                    .collect();
                let factor = |at: f64| neighbours(&factors, at).map_or(1.0, |(a, b, fraction)| a + (b - a) * fraction);
                let samples: Vec<Vec<(PathSample, PathDerivatives)>> = motion
                    .iter()
                    .enumerate()
                    .map(|(end, x)| path.samples(x, factor(end as f64 / intervals as f64)))
                    .collect();
                for (segment, ends) in samples.windows(2).enumerate() {
                    if let [a, b] = ends
                        && let Some(track) = Track::between(a, b, interval_s)
                    {
                        tracks.push(halvings, segment, track);
                    }
                }
            }
        }
    }
}

impl SwayPath {
    /// Samples of every receiver for the displacement `x` (m, with three time derivatives) and the factor of
    /// diffraction by people.
    fn samples(&self, x: &[f64; 4], factor: f64) -> Vec<(PathSample, PathDerivatives)> {
        let sample = |&SwayEcho { delay_s, delay_s_per_m, amplitude }: &SwayEcho| {
            let sample = PathSample {
                delay_s: delay_s + delay_s_per_m * x[0],
                delay_rate: delay_s_per_m * x[1],
                amplitude: amplitude * factor,
            };
            let delay = [delay_s_per_m * x[2], delay_s_per_m * x[3]];
            (sample, PathDerivatives { delay, ..PathDerivatives::default() })
        };
        self.receivers.iter().map(sample).collect()
    }
}

/// Number of halvings of a span that resolves a wave of this frequency.
fn halvings(span_s: f64, fastest_hz: f64) -> u32 {
    (0..MAX_HALVINGS)
        .find(|&h| span_s * fastest_hz <= PERIODS_AN_INTERVAL * f64::from(1u32 << h))
        .unwrap_or(MAX_HALVINGS)
}

/// Draws a value of an interval, uniformly in its logarithm.
fn logarithmic([low, high]: [f64; 2], rng: &mut Xoshiro256PlusPlus) -> f64 {
    low * (high / low).powf(rng.random::<f64>())
}

impl Reflector {
    fn draw(scene: &Scene, prepared: &PreparedScene, group: &SwayFile, rng: &mut Xoshiro256PlusPlus) -> Self {
        let drawn = draw_position(scene, prepared, group.at, rng);
        let point = group.position_m.map_or(drawn, DVec3::from_array);
        let off_db = group.spread_db * (2.0 * rng.random::<f64>() - 1.0);
        let cross_section_m2 = 10f64.powf(0.1 * (group.cross_section_dbsm + off_db));
        let phase = rng.random_range(0.0..TAU);
        let rms_m = logarithmic(group.amplitude_m, rng);
        let frequency_hz = logarithmic(group.frequency_hz, rng);
        let motion = Sway::draw(rms_m, frequency_hz, group.bandwidth, rng);
        let line_of_sight = (point - prepared.tx.position).try_normalize().unwrap_or(DVec3::X);
        let mut paths = Vec::new();
        for &(p, q) in prepared.pairs_near(point, 0.0).iter() {
            let receivers: Vec<SwayEcho> = prepared
                .point_echoes(point, cross_section_m2, phase, p, q)
                .iter()
                .enumerate()
                .map(|(rx, echo)| {
                    let delay_s = echo.length_m / SPEED_OF_LIGHT_M_PER_S;
                    let delay_s_per_m = echo.directions.dot(line_of_sight) / SPEED_OF_LIGHT_M_PER_S;
                    let beat_hz = prepared.chirp.beat_hz(delay_s, 0.0);
                    SwayEcho { delay_s, delay_s_per_m, amplitude: prepared.at_adc(rx, echo.amplitude, beat_hz) }
                })
                .collect();
            // The first receiver represents all, as for static paths.
            let least_lsb = AUDIBLE_FRACTION * prepared.threshold_lsb;
            if receivers.first().is_some_and(|echo| echo.amplitude.norm() > least_lsb) {
                let polyline = prepared.point_polyline(point, p, q, prepared.tx.position);
                paths.push(SwayPath { receivers, polyline });
            }
        }
        Reflector { motion, paths }
    }
}

/// Draws the position of a reflector in the room.
fn draw_position(scene: &Scene, prepared: &PreparedScene, at: SwayPlaceFile, rng: &mut Xoshiro256PlusPlus) -> DVec3 {
    let (choice, fraction): (f64, f64) = (rng.random(), rng.random());
    let furniture = &scene.file().furniture;
    let at = match at {
        SwayPlaceFile::Clutter if choice < 0.15 => SwayPlaceFile::Radar,
        SwayPlaceFile::Clutter if choice < 0.6 => SwayPlaceFile::Furniture,
        SwayPlaceFile::Clutter => SwayPlaceFile::Walls,
        other => other,
    };
    match (at, furniture.get((fraction * furniture.len() as f64) as usize)) {
        (SwayPlaceFile::Furniture, Some(piece)) => prepared.point_on(piece, rng),
        (SwayPlaceFile::Radar, _) => {
            let offset = draw_direction(rng) * rng.random_range(0.15..0.9);
            let position = prepared.tx.position + scene.radar_from_world().transpose() * offset;
            position.clamp(DVec3::ZERO, prepared.room.size_m())
        }
        (kind, _) => {
            let direction = scene.radar_from_world().transpose() * draw_direction(rng);
            let wall_m = distance_to_wall_m(prepared, direction);
            let before_m = if kind == SwayPlaceFile::Anywhere {
                wall_m * 0.9 * rng.random::<f64>()
            } else {
                rng.random_range(0.0..0.3)
            };
            let position = prepared.tx.position + direction * (wall_m - before_m).max(0.1);
            position.clamp(DVec3::ZERO, prepared.room.size_m())
        }
    }
}

/// Draws a direction about the boresight, in the radar's own axes.
fn draw_direction(rng: &mut Xoshiro256PlusPlus) -> DVec3 {
    let [azimuth, elevation] = MAX_OFF_BORESIGHT_RAD.map(|most| rng.random_range(-most..most));
    DVec3::new(azimuth.cos() * elevation.cos(), azimuth.sin() * elevation.cos(), elevation.sin())
}

/// Distance from the transmitter to the first surface in a direction, m: the walls of the room or an object before
/// them.
fn distance_to_wall_m(prepared: &PreparedScene, direction: DVec3) -> f64 {
    let (from, size_m) = (prepared.tx.position, prepared.room.size_m());
    if let Surroundings::Polygons(room) = &prepared.room
        && let Some(distance_m) = room.paths().environment().distance_m(from, direction)
    {
        return distance_m;
    }
    let mut nearest_m = f64::INFINITY;
    for axis in 0..3 {
        let step = direction[axis];
        if step.abs() > 1e-9 {
            let wall = if step > 0.0 { size_m[axis] } else { 0.0 };
            nearest_m = nearest_m.min((wall - from[axis]) / step);
        }
    }
    if nearest_m.is_finite() { nearest_m.max(0.0) } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::path_segment::PathSegment;

    #[test]
    fn a_motion_has_its_displacement_and_its_derivatives() {
        for (seed, bandwidth) in [(0, 0.0), (1, 0.3), (2, 0.8)] {
            let mut rng = generator(seed, Purpose::Sway, [0, 0]);
            let sway = Sway::draw(2e-3, 1.5, bandwidth, &mut rng);
            let count = 400_000u32;
            let square: f64 = (0..count).map(|i| sway.at(f64::from(i) * 7.3e-3)[0].powi(2)).sum();
            let rms_m = (square / f64::from(count)).sqrt();
            assert!((rms_m / 2e-3 - 1.0).abs() < 0.03, "{bandwidth}: {rms_m} m");
            let h = 1e-4;
            for time_s in [0.0, 0.37, 1234.5] {
                let [before, now, after] = [time_s - h, time_s, time_s + h].map(|t| sway.at(t));
                for (order, ((before, after), derivative)) in before.iter().zip(&after).zip(&now[1..]).enumerate() {
                    let slope = (after - before) / (2.0 * h);
                    let scale = 2e-3 * (TAU * 6.0).powi(order as i32 + 1);
                    assert!((slope - derivative).abs() < 1e-4 * scale, "{bandwidth} {time_s} {order}");
                }
            }
        }
    }

    /// Between samples the polynomial follows the motion, at every frequency that a scene may request.
    #[test]
    fn echoes_follow_the_motion_between_samples() {
        let wavenumber_per_m = TAU / 4.93e-3;
        for (frequency_hz, rms_m, span_s) in
            [(0.5, 0.02, 0.025), (3.0, 0.02, 0.064), (50.0, 1e-4, 0.025), (12.0, 0.1, 0.025)]
        {
            let mut rng = generator(3, Purpose::Sway, [1, 0]);
            let sway = Sway::draw(rms_m, frequency_hz, 0.0, &mut rng);
            let intervals = 1u32 << halvings(span_s, sway.fastest_hz());
            let interval_s = span_s / f64::from(intervals);
            let sample = |time_s: f64| {
                let x = sway.at(time_s);
                let sample = PathSample { delay_s: x[0], delay_rate: x[1], amplitude: Complex64::ONE };
                (sample, PathDerivatives { delay: [x[2], x[3]], ..PathDerivatives::default() })
            };
            for interval in 0..intervals {
                let start_s = 17.0 + interval_s * f64::from(interval);
                let segment = PathSegment::between(&sample(start_s), &sample(start_s + interval_s), interval_s);
                for u in [0.1, 0.3, 0.5, 0.8] {
                    let error_m = segment.delay(u).0 - sway.at(start_s + u * interval_s)[0];
                    let error_rad = 2.0 * wavenumber_per_m * error_m.abs();
                    assert!(error_rad < 0.01, "{frequency_hz} Hz: {error_rad} rad");
                }
            }
        }
    }
}
