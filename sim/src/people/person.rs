//! Random properties of a person that do not depend on the motion: body, clothes, small motions and walking style.

use std::f64::consts::{PI, TAU};
use std::sync::Arc;

use glam::DVec3;
use rand::Rng;

use super::body::{Build, SEGMENTS};
use super::clip::BodyClip;
use super::gait::Style;
use super::imported::Actor;
use crate::random::{Purpose, draw, generator};
use crate::scene_file::PeopleFile;

/// Interval in which at most one fidget happens, s.
const FIDGET_INTERVAL_S: f64 = 5.0;

/// Source of a person's steps.
#[derive(Debug, Clone, Default, PartialEq)]
pub enum Steps {
    /// The built-in gait ([`super::gait`]).
    #[default]
    Gait,
    /// A captured clip, on the parametric body.
    Clip(Arc<BodyClip>),
    /// An actor from a file, with its own body.
    Actor(Arc<Actor>),
}

/// Random properties of a person that do not depend on the motion.
#[derive(Debug, Clone, PartialEq)]
pub struct Person {
    /// Size of the body.
    pub build: Build,
    /// Key for later random draws.
    pub identity: [u64; 2],
    /// Amplitude factor of each segment for clothes (-4..+2 dB relative to skin).
    pub cloth: [f64; SEGMENTS],
    seed: u64,
    breath_m: f64,
    breath_hz: f64,
    heart_m: f64,
    heart_hz: f64,
    sway_m: f64,
    phases: [f64; 6],
    /// Probability of a fidget in one interval of `FIDGET_INTERVAL_S`.
    pub fidget_probability: f64,
    /// Further properties of a person at a desk; `None` elsewhere.
    pub at_desk: Option<AtDesk>,
    /// Source of the steps.
    pub steps: Steps,
    /// Walking style for the built-in gait.
    pub style: Style,
}

/// Properties of a person that sits close to the radar.
#[derive(Debug, Clone, PartialEq)]
pub struct AtDesk {
    /// Amplitude of the double bounce relative to the direct echo; 0 for none.
    pub double_bounce: f64,
    /// Excess of the double bounce's one-way length over twice the direct one, m.
    pub double_bounce_offset_m: f64,
    /// Scattering points of shoulders, arms and lap.
    pub points: Vec<BodyPoint>,
    /// Loss of the points for each metre behind the chest, dB.
    pub point_decay_db_per_m: f64,
    /// Shoulder and elbow flexion added to those of sitting, rad: `[left, right]`.
    pub arms_rad: [(f64, f64); 2],
    /// Lean added to that of sitting, rad.
    pub lean_rad: f64,
}

/// A scattering point fixed to the chest.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BodyPoint {
    /// Position in units of the chest's semi-axes (forward, left, up). Breath moves its forward component with the
    /// chest.
    pub place: DVec3,
    /// Square root of the radar cross-section over 4 pi, m.
    pub scatter_m: f64,
    /// Detour of the point's echo, as a one-way length, m.
    pub detour_m: f64,
}

/// Occasional movement of an arm and the trunk, in addition to the posture.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Fidget {
    /// Side of the arm: 0 left, 1 right.
    pub(super) side: usize,
    /// Shoulder flexion of the arm, rad.
    pub(super) arm_rad: f64,
    /// Forward lean of the trunk, rad.
    pub(super) lean_rad: f64,
    /// Rotation of the shoulders relative to the hips, rad.
    pub(super) twist_rad: f64,
}

impl Person {
    /// Draws a person from a seed and an identity.
    pub fn draw(seed: u64, identity: [u64; 2], height_m: f64) -> Self {
        let mut rng = generator(seed, Purpose::Build, identity);
        let build = Build { height_m, girth: rng.random_range(0.88..1.15) };
        let cloth = std::array::from_fn(|_| 10f64.powf(rng.random_range(-4.0..2.0) / 20.0));
        let mut rng = generator(seed, Purpose::MicroMotion, identity);
        Person {
            build,
            identity,
            cloth,
            seed,
            breath_m: rng.random_range(0.004..0.012),
            breath_hz: rng.random_range(0.20..0.35),
            heart_m: rng.random_range(0.0002..0.0005),
            heart_hz: rng.random_range(0.95..1.45),
            sway_m: rng.random_range(0.0015..0.004),
            phases: std::array::from_fn(|_| rng.random_range(0.0..TAU)),
            fidget_probability: 0.4,
            at_desk: None,
            steps: Steps::Gait,
            style: Style::AVERAGE,
        }
    }

    /// Sets the slow breath of a sitting person, and reduces the sway, since the back is supported.
    pub fn at_ease(&mut self) {
        let mut rng = generator(self.seed, Purpose::MicroMotion, [self.identity[0], self.identity[1] | 1 << 40]);
        self.breath_hz = rng.random_range(0.15..0.35);
        self.sway_m *= rng.random_range(0.2..0.7);
    }

    /// Chest surface outward of its mean, m: breath 4..12 mm peak to peak, heart 0.2..0.5 mm.
    pub(super) fn chest_m(&self, time_s: f64) -> f64 {
        let breath = TAU * self.breath_hz * time_s + self.phases[0];
        let heart = TAU * self.heart_hz * time_s + self.phases[1];
        let beat = (3.0 * (heart.cos() - 1.0)).exp() - 0.25;
        0.5 * self.breath_m * (breath.sin() + 0.15 * (2.0 * breath).cos()) + self.heart_m * beat
    }

    /// Slow sway at a time, m.
    pub(super) fn sway_m(&self, time_s: f64) -> (f64, f64) {
        let wave = |hz: f64, phase: f64| (TAU * hz * time_s + phase).sin();
        let phases = &self.phases;
        (
            self.sway_m * (0.7 * wave(0.31, phases[2]) + 0.4 * wave(0.13, phases[3])),
            self.sway_m * (0.7 * wave(0.23, phases[4]) + 0.4 * wave(0.11, phases[5])),
        )
    }

    /// Occasional movement of an arm and the trunk at a time.
    pub(super) fn fidget(&self, time_s: f64) -> Fidget {
        let interval = (time_s / FIDGET_INTERVAL_S).floor();
        let index = [self.identity[0] << 32 | self.identity[1], (interval + 1e6).max(0.0) as u64];
        let mut rng = generator(self.seed, Purpose::Fidget, index);
        if rng.random::<f64>() >= self.fidget_probability {
            return Fidget::default();
        }
        let width_s = rng.random_range(0.5..1.1);
        let centre_s = rng.random_range(width_s..FIDGET_INTERVAL_S - width_s);
        let offset = ((time_s - interval * FIDGET_INTERVAL_S - centre_s) / width_s).clamp(-1.0, 1.0);
        let bump = (0.5 * (1.0 + (PI * offset).cos())).powi(2);
        let side = usize::from(rng.random::<bool>());
        let arm_rad: f64 = rng.random_range(0.1..0.5);
        let lean_rad: f64 = rng.random_range(-0.06..0.06);
        let twist_rad: f64 = rng.random_range(-0.08..0.08);
        Fidget { side, arm_rad: bump * arm_rad, lean_rad: bump * lean_rad, twist_rad: bump * twist_rad }
    }
}

/// Applies the scene's gait to a person.
pub(crate) fn with_gait(mut person: Person, people: &PeopleFile, seed: u64) -> Person {
    let mut rng = generator(seed, Purpose::Gait, person.identity);
    person.style = Style { stride: draw(&mut rng, people.stride), arm_swing: draw(&mut rng, people.arm_swing) };
    person
}
