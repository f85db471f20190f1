//! Small motions of a standing or walking person: sway of the whole body and of its parts, weight shifts and gestures.

use std::f64::consts::{PI, TAU};

use rand::Rng;
use rand_distr::{Distribution, StandardNormal};
use rand_xoshiro::Xoshiro256PlusPlus;

use super::dynamics::STEP_S;
use super::node::Knot;
use super::{chance, draw};
use crate::math::smooth_step;
use crate::people::body::Build;
use crate::people::motion_state::SmallMotion;

/// Number of sinusoids in each part's sway. Each one has a frequency in its own band.
const WAVES: usize = 4;
/// Frequencies of sway, Hz.
const SWAY_HZ: [f64; 2] = [0.1, 1.0];
/// Parts that sway: hips forward and left, lean, twist, two shoulders, two elbows.
const PARTS: usize = 8;

#[derive(Debug, Clone, Copy, PartialEq)]
struct Wave {
    amplitude: f64,
    rad_per_s: f64,
    phase_rad: f64,
}

/// Postural sway of a person: sums of sinusoids with random frequencies.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Sway {
    parts: [[Wave; WAVES]; PARTS],
}

impl Sway {
    /// Draws sway with a given rms excursion at the shoulders, m.
    pub fn draw(rng: &mut Xoshiro256PlusPlus, excursion_m: f64) -> Self {
        // Hips move half as far as shoulders. A trunk is half a metre long, shoulders are 0.17 m wide, an arm is 0.6 m
        // long.
        let [forward, left] = [0.5, 0.4].map(|factor| factor * excursion_m);
        let rms = [forward, left, excursion_m, 3.0 * excursion_m]
            .into_iter()
            .chain([1.5, 1.5, 2.0, 2.0].map(|factor| factor * excursion_m));
        let mut parts = [[Wave { amplitude: 0.0, rad_per_s: 0.0, phase_rad: 0.0 }; WAVES]; PARTS];
        for (waves, rms) in parts.iter_mut().zip(rms) {
            let [low, high] = SWAY_HZ.map(f64::ln);
            let mut power = 0.0;
            for (index, wave) in waves.iter_mut().enumerate() {
                let fraction = (index as f64 + rng.random::<f64>()) / WAVES as f64;
                let hz = (low + fraction * (high - low)).exp();
                // Slow sway has a larger amplitude.
                let amplitude = hz.powf(-0.5);
                power += 0.5 * amplitude * amplitude;
                *wave = Wave { amplitude, rad_per_s: TAU * hz, phase_rad: rng.random_range(0.0..TAU) };
            }
            let scale = rms / power.sqrt();
            waves.iter_mut().for_each(|wave| wave.amplitude *= scale);
        }
        Sway { parts }
    }

    /// Displacements by sway alone, at a time.
    pub fn at(&self, time_s: f64) -> SmallMotion {
        let sum = |waves: &[Wave; WAVES]| -> f64 {
            waves.iter().map(|w| w.amplitude * (w.rad_per_s * time_s + w.phase_rad).sin()).sum()
        };
        let [forward_m, left_m, lean_rad, twist_rad, left_shoulder, right_shoulder, left_elbow, right_elbow] =
            self.parts.each_ref().map(sum);
        SmallMotion {
            forward_m,
            left_m,
            lean_rad,
            twist_rad,
            shoulder_rad: [left_shoulder, right_shoulder],
            elbow_rad: [left_elbow, right_elbow],
        }
    }
}

/// A smooth change of two values at the same time, over whole steps.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Stroke {
    from: [f64; 2],
    to: [f64; 2],
    steps: u32,
    done: u32,
}

impl Stroke {
    /// Makes a constant pair of values.
    pub fn constant(at: [f64; 2]) -> Self {
        Stroke { from: at, to: at, steps: 1, done: 1 }
    }

    /// Whether the change is complete.
    pub fn is_complete(&self) -> bool {
        self.done >= self.steps
    }

    /// Values at the end of the change.
    pub fn end(&self) -> [f64; 2] {
        self.to
    }

    /// Begins another change at the end values of the last one.
    pub fn begin(&mut self, to: [f64; 2], duration_s: f64) {
        let steps = (duration_s / STEP_S).ceil().clamp(4.0, 1000.0) as u32;
        *self = Stroke { from: self.to, to, steps, done: 0 };
    }

    /// Advances by one step.
    pub fn advance(&mut self) {
        self.done = self.steps.min(self.done + 1);
    }

    /// Current values and their rates.
    pub fn knots(&self) -> [Knot; 2] {
        let x = 2.0 * f64::from(self.done) / f64::from(self.steps) - 1.0;
        let fraction = smooth_step(x);
        let rate_per_s = (0.5 + 0.5 * (PI * x).cos()) * 2.0 / (f64::from(self.steps) * STEP_S);
        [0, 1].map(|i| {
            let change = self.to[i] - self.from[i];
            Knot { value: self.from[i] + change * fraction, rate: change * rate_per_s }
        })
    }
}

/// An arm: shoulder and elbow flexion in addition to the gait, rad.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Arm {
    /// Current change.
    pub stroke: Stroke,
    rest_rad: [f64; 2],
    /// Remaining strokes of the gesture, the return to rest included.
    strokes: u32,
}

impl Arm {
    /// Share of arms that are held up, as with a telephone, a cup or a bag.
    const RAISED_SHARE: f64 = 0.2;

    /// Draws an arm at rest.
    pub fn draw(rng: &mut Xoshiro256PlusPlus) -> Self {
        let rest_rad = if chance(rng, Self::RAISED_SHARE) {
            [draw(rng, [0.1, 0.6]), draw(rng, [0.8, 1.7])]
        } else {
            [draw(rng, [-0.05, 0.1]), draw(rng, [0.0, 0.3])]
        };
        Arm { stroke: Stroke::constant(rest_rad), rest_rad, strokes: 0 }
    }

    /// Advances by one step. At rest, a gesture begins after a random time with the mean `idle_s`. Peak speeds of the
    /// hand are drawn from an interval.
    pub fn advance(&mut self, rng: &mut Xoshiro256PlusPlus, build: &Build, idle_s: f64, speed_m_per_s: [f64; 2]) {
        self.stroke.advance();
        if !self.stroke.is_complete() {
            return;
        }
        let current = self.stroke.end();
        let target = if self.strokes > 1 {
            let nearby = |angle: f64, rng: &mut Xoshiro256PlusPlus| angle + draw(rng, [-0.45, 0.45]);
            [nearby(current[0], rng).clamp(-0.2, 1.4), nearby(current[1], rng).clamp(0.1, 2.1)]
        } else if self.strokes == 1 {
            self.rest_rad
        } else if chance(rng, STEP_S / idle_s) {
            self.strokes = rng.random_range(2..=7);
            [draw(rng, [0.2, 1.3]), draw(rng, [0.4, 2.0])]
        } else {
            return;
        };
        self.strokes -= 1;
        // The distance of the hand from the shoulder is 0.40 of the height, and from the elbow 0.215.
        let travel_m =
            build.height_m * (0.40 * (target[0] - current[0]).abs() + 0.215 * (target[1] - current[1]).abs());
        // The peak speed of a stroke is twice its mean speed.
        self.stroke.begin(target, 2.0 * travel_m / draw(rng, speed_m_per_s));
    }
}

/// Advances weight shifts between the legs: position of the hips (forward, left) relative to the middle of the feet, m.
pub(super) fn shift_weight(stroke: &mut Stroke, rng: &mut Xoshiro256PlusPlus, is_standing: bool) {
    /// Mean time between weight shifts, s.
    const MEAN_INTERVAL_S: f64 = 7.0;
    stroke.advance();
    if !stroke.is_complete() {
        return;
    }
    if !is_standing {
        if stroke.end() != [0.0; 2] {
            stroke.begin([0.0; 2], 1.0);
        }
    } else if chance(rng, STEP_S / MEAN_INTERVAL_S) {
        let mut normal = |deviation_m: f64, most_m: f64| {
            let unit: f64 = StandardNormal.sample(rng);
            (deviation_m * unit).clamp(-most_m, most_m)
        };
        let target = [normal(0.008, 0.02), normal(0.012, 0.025)];
        let duration_s = draw(rng, [1.4, 3.0]);
        stroke.begin(target, duration_s);
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;

    use super::*;

    #[test]
    fn sway_has_the_requested_excursion_and_is_slow() {
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(3);
        for excursion_m in [0.002, 0.02] {
            let sway = Sway::draw(&mut rng, excursion_m);
            let places: Vec<f64> = (0..60_000).map(|i| sway.at(f64::from(i) * 0.01).forward_m).collect();
            let rms = (places.iter().map(|x| x * x).sum::<f64>() / places.len() as f64).sqrt();
            assert!((rms / (0.5 * excursion_m) - 1.0).abs() < 0.1, "{rms} m");
            let speed = places.windows(2).map(|w| (w[1] - w[0]).abs() / 0.01).fold(0.0, f64::max);
            // The frequency is at most 1 Hz.
            assert!(speed < TAU * 4.0 * rms, "{speed} m/s");
        }
    }

    #[test]
    fn hands_move_at_the_requested_speeds_and_return_to_rest() {
        let build = Build { height_m: 1.75, girth: 1.0 };
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(5);
        let mut arm = Arm::draw(&mut rng);
        let rest = arm.stroke.end();
        let (mut fastest, mut back) = (0.0f64, 0);
        for _ in 0..20_000 {
            arm.advance(&mut rng, &build, 3.0, [0.3, 1.5]);
            let [shoulder, elbow] = arm.stroke.knots();
            fastest = fastest.max(build.height_m * (0.40 * shoulder.rate.abs() + 0.215 * elbow.rate.abs()));
            back += usize::from(arm.stroke.is_complete() && arm.stroke.end() == rest);
        }
        assert!((0.8..=1.51).contains(&fastest), "{fastest} m/s");
        assert!(back > 1000, "{back} steps at rest");
    }
}
