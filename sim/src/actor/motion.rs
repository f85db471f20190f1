//! One person's motion: corners laid down by a script, smoothed by [`Track`]s, with gait and small motions on top.

use std::f64::consts::{PI, TAU};
use std::sync::Arc;

use glam::DVec3;
use rand::Rng;

use super::body::{Build, Posture};
use super::clip::BodyClip;
use super::gait;
use super::imported::Actor;
use super::track::{Track, smooth_step};
use crate::field::highlight::Ellipsoid;
use crate::random::{Purpose, generator};

/// Corners of the path are rounded over this time either way, s.
const CORNER_S: f64 = 0.35;
/// Sitting down and getting up take twice this, s.
const SIT_S: f64 = 0.8;
/// Fidgets happen at most once in an epoch of this length, s.
const FIDGET_EPOCH_S: f64 = 5.0;

/// Where a person's steps come from.
#[derive(Debug, Clone, Default, PartialEq)]
pub enum Steps {
    /// The gait of [`gait`].
    #[default]
    Gait,
    /// A captured clip, on the parametric body.
    Clip(Arc<BodyClip>),
    /// An actor from a file, with a body of its own.
    Actor(Arc<Actor>),
}

/// Where somebody is on the ground plan, and in the cycle of steps, at a time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Walk {
    /// Place, m.
    pub position_m: [f64; 2],
    /// Facing, from +x towards +y, rad.
    pub heading_rad: f64,
    /// Cycles (two steps) made.
    pub phase: f64,
    /// 0 standing, 1 walking.
    pub vigour: f64,
}

/// What makes a person this person: all draws that do not depend on what they do.
#[derive(Debug, Clone, PartialEq)]
pub struct Person {
    /// Size.
    pub build: Build,
    /// Identity for later draws.
    pub identity: [u64; 2],
    /// Amplitude factor of each segment: clothes and folds (-4..+2 dB over skin, sbr.md section 6).
    pub cloth: [f64; super::body::SEGMENTS],
    seed: u64,
    breath_m: f64,
    breath_hz: f64,
    heart_m: f64,
    heart_hz: f64,
    sway_m: f64,
    phases: [f64; 6],
    /// Probability of a fidget in an epoch.
    pub fidget_probability: f64,
    /// What a person at a desk has besides. None elsewhere.
    pub at_desk: Option<AtDesk>,
    /// How they walk.
    pub steps: Steps,
}

/// What is known of a person close before the radar.
#[derive(Debug, Clone, PartialEq)]
pub struct AtDesk {
    /// Amplitude of the double bounce relative to the direct echo; 0 for none.
    pub double_bounce: f64,
    /// Length of one way that it is longer than twice the direct one, m.
    pub double_bounce_offset_m: f64,
    /// Shoulders, arms, lap.
    pub points: Vec<BodyPoint>,
    /// Loss of the points for each metre behind the chest, dB.
    pub point_decay_db_per_m: f64,
    /// Shoulder and elbow flexion over that of sitting, rad: `[left, right]`.
    pub arms_rad: [(f64, f64); 2],
    /// Lean over that of sitting, rad.
    pub lean_rad: f64,
}

/// A point that scatters, fixed to the chest.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BodyPoint {
    /// Place in units of the chest's semi-axes (forward, left, up): its forward part breathes with the chest.
    pub place: DVec3,
    /// Square root of cross-section over 4 pi, m.
    pub scatter_m: f64,
    /// Detour of its echo, as a length of one way, m.
    pub detour_m: f64,
}

impl Person {
    /// A person drawn from (seed, identity).
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
        }
    }

    /// Slow breath as of somebody who sits, and half the sway: the back rests.
    pub fn at_ease(&mut self) {
        let mut rng = generator(self.seed, Purpose::MicroMotion, [self.identity[0], self.identity[1] | 1 << 40]);
        self.breath_hz = rng.random_range(0.15..0.35);
        self.sway_m *= rng.random_range(0.2..0.7);
    }

    /// Chest surface outward of its mean, m: breath peak to peak 4..12 mm, heart 0.2..0.5 mm.
    fn chest_m(&self, t: f64) -> f64 {
        let breath = TAU * self.breath_hz * t + self.phases[0];
        let heart = TAU * self.heart_hz * t + self.phases[1];
        let beat = (3.0 * (heart.cos() - 1.0)).exp() - 0.25;
        0.5 * self.breath_m * (breath.sin() + 0.15 * (2.0 * breath).cos()) + self.heart_m * beat
    }

    /// Slow sway, m.
    fn sway_m(&self, t: f64) -> (f64, f64) {
        let wave = |hz: f64, phase: f64| (TAU * hz * t + phase).sin();
        let p = &self.phases;
        (
            self.sway_m * (0.7 * wave(0.31, p[2]) + 0.4 * wave(0.13, p[3])),
            self.sway_m * (0.7 * wave(0.23, p[4]) + 0.4 * wave(0.11, p[5])),
        )
    }

    /// Arms and trunk now and then: (side, arm flexion, lean, twist).
    fn fidget(&self, t: f64) -> (usize, f64, f64, f64) {
        let epoch = (t / FIDGET_EPOCH_S).floor();
        let index = [self.identity[0] << 32 | self.identity[1], (epoch + 1e6).max(0.0) as u64];
        let mut rng = generator(self.seed, Purpose::Fidget, index);
        if rng.random::<f64>() >= self.fidget_probability {
            return (0, 0.0, 0.0, 0.0);
        }
        let width_s = rng.random_range(0.5..1.1);
        let centre_s = rng.random_range(width_s..FIDGET_EPOCH_S - width_s);
        let x = ((t - epoch * FIDGET_EPOCH_S - centre_s) / width_s).clamp(-1.0, 1.0);
        let bump = (0.5 * (1.0 + (PI * x).cos())).powi(2);
        let side = usize::from(rng.random::<bool>());
        let amplitudes = (rng.random_range(0.1..0.5), rng.random_range(-0.06..0.06), rng.random_range(-0.08..0.08));
        (side, bump * amplitudes.0, bump * amplitudes.1, bump * amplitudes.2)
    }
}

/// A person's motion over time.
#[derive(Debug, Clone, PartialEq)]
pub struct Motion {
    /// Who.
    pub person: Person,
    x: Track,
    y: Track,
    heading: Track,
    phase: Track,
    vigour: Track,
    sit: Track,
    seat_height_m: f64,
    /// Nobody is there before this, s.
    pub start_s: f64,
    /// Nor after this, s.
    pub end_s: f64,
}

/// Lays down a motion step by step.
#[derive(Debug, Clone)]
pub struct MotionBuilder {
    motion: Motion,
    time_s: f64,
    place: [f64; 2],
    facing: f64,
}

impl MotionBuilder {
    /// Begins at a place and time, facing a direction.
    pub fn new(person: Person, start_s: f64, place: [f64; 2], facing_rad: f64) -> Self {
        let motion = Motion {
            person,
            x: Track::constant(place[0], CORNER_S),
            y: Track::constant(place[1], CORNER_S),
            heading: Track::constant(facing_rad, CORNER_S),
            phase: Track::constant(0.0, CORNER_S),
            vigour: Track::constant(0.0, CORNER_S),
            sit: Track::constant(0.0, SIT_S),
            seat_height_m: 0.45,
            start_s,
            end_s: f64::INFINITY,
        };
        MotionBuilder { motion, time_s: start_s, place, facing: facing_rad }
    }

    /// Time reached, s.
    pub fn time_s(&self) -> f64 {
        self.time_s
    }

    /// Place reached, m.
    pub fn place(&self) -> [f64; 2] {
        self.place
    }

    fn turn_to(&mut self, facing: f64) {
        let change = (facing - self.facing + PI).rem_euclid(TAU) - PI;
        self.motion.heading.step(self.time_s, change);
        self.facing += change;
    }

    /// Walks straight to a place.
    pub fn walk_to(mut self, to: [f64; 2], speed_m_per_s: f64) -> Self {
        let (dx, dy) = (to[0] - self.place[0], to[1] - self.place[1]);
        let distance = dx.hypot(dy);
        if distance < 1e-3 {
            return self;
        }
        self.turn_to(dy.atan2(dx));
        let (begin, end) = (self.time_s, self.time_s + distance / speed_m_per_s);
        let (vx, vy) = (dx / distance * speed_m_per_s, dy / distance * speed_m_per_s);
        let m = &mut self.motion;
        let leg_m = m.person.build.standing_hip_height_m();
        // A clip goes with the ground covered, so that feet rest on it.
        let (vigour, cycles) = match &m.person.steps {
            Steps::Gait => {
                let vigour = (speed_m_per_s / 1.3).sqrt().min(1.35);
                (vigour, gait::cycles_per_second(speed_m_per_s, leg_m))
            }
            Steps::Clip(clip) => (1.0, speed_m_per_s / clip.cycle_m(leg_m)),
            Steps::Actor(actor) => (1.0, speed_m_per_s / actor.cycle_m()),
        };
        for (t, sign) in [(begin, 1.0), (end, -1.0)] {
            m.x.bend(t, sign * vx);
            m.y.bend(t, sign * vy);
            m.phase.bend(t, sign * cycles);
            m.vigour.step(t, sign * vigour);
        }
        self.time_s = end;
        self.place = to;
        self
    }

    /// Stands still.
    pub fn stand(mut self, duration_s: f64) -> Self {
        self.time_s += duration_s;
        self
    }

    /// Turns to a heading, rad, and sits down for a while (sitting down and getting up included).
    pub fn sit(mut self, heading_rad: f64, seat_height_m: f64, duration_s: f64) -> Self {
        self.turn_to(heading_rad);
        self.motion.seat_height_m = seat_height_m;
        let duration_s = duration_s.max(2.5 * SIT_S);
        self.motion.sit.step(self.time_s + SIT_S, 1.0);
        self.motion.sit.step(self.time_s + duration_s - SIT_S, -1.0);
        self.time_s += duration_s;
        self
    }

    /// Sits from the very beginning, for good.
    pub fn seated(mut self, seat_height_m: f64) -> Self {
        self.motion.seat_height_m = seat_height_m;
        self.motion.sit = Track::constant(1.0, SIT_S);
        self
    }

    /// The person vanishes at the time reached.
    pub fn leave(mut self) -> Motion {
        self.motion.end_s = self.time_s;
        self.motion
    }

    /// The person stays for good.
    pub fn stay(self) -> Motion {
        self.motion
    }
}

impl Motion {
    /// Whether there is anybody at a time.
    pub fn exists(&self, time_s: f64) -> bool {
        time_s >= self.start_s && time_s <= self.end_s
    }

    /// Joint angles and place at a time.
    pub fn posture(&self, time_s: f64) -> Posture {
        let build = &self.person.build;
        let heading_rad = self.heading.at(time_s);
        let (phase, vigour, sit) = (self.phase.at(time_s), self.vigour.at(time_s).max(0.0), self.sit.at(time_s));
        // What walks by a clip stands here.
        let vigour = if matches!(self.person.steps, Steps::Gait) { vigour } else { 0.0 };
        let (forward, left) = gait::sway(phase, vigour);
        let (sway_x, sway_y) = self.person.sway_m(time_s);
        let (sine, cosine) = heading_rad.sin_cos();
        let x = self.x.at(time_s) + forward * cosine - left * sine + sway_x;
        let y = self.y.at(time_s) + forward * sine + left * cosine + sway_y;
        let standing = build.standing_hip_height_m();
        let seated = self.seat_height_m + 0.09;
        let mut posture = Posture {
            position_m: [x, y],
            heading_rad,
            hip_height_m: standing + (seated - standing) * sit,
            // Getting up and sitting down go through a bow.
            lean_rad: 0.02 + sit * -0.06 + 0.5 * smooth_step(4.0 * sit * (1.0 - sit) * 2.0 - 1.0),
            twist_rad: 0.0,
            shoulder_rad: [0.05 + 0.35 * sit; 2],
            elbow_rad: [0.15 + 1.0 * sit; 2],
            hip_rad: [1.5 * sit; 2],
            knee_rad: [1.5 * sit; 2],
            ankle_rad: [0.0; 2],
            chest_m: self.person.chest_m(time_s),
        };
        gait::walk(&mut posture, phase, vigour * (1.0 - sit), build.height_m);
        let (side, arm, lean, twist) = self.person.fidget(time_s);
        if let Some(desk) = &self.person.at_desk {
            for (i, (shoulder, elbow)) in desk.arms_rad.into_iter().enumerate() {
                posture.shoulder_rad[i] += shoulder;
                posture.elbow_rad[i] += elbow;
            }
            posture.lean_rad += desk.lean_rad;
        }
        posture.shoulder_rad[side] += arm;
        posture.elbow_rad[side] += 0.8 * arm;
        posture.lean_rad += lean;
        posture.twist_rad += twist;
        posture
    }

    /// Place and steps at a time.
    pub fn walk(&self, time_s: f64) -> Walk {
        let (sway_x, sway_y) = self.person.sway_m(time_s);
        Walk {
            position_m: [self.x.at(time_s) + sway_x, self.y.at(time_s) + sway_y],
            heading_rad: self.heading.at(time_s),
            phase: self.phase.at(time_s),
            vigour: self.vigour.at(time_s).clamp(0.0, 1.0),
        }
    }

    /// The body at a time; of an actor from a file, ellipsoids about its parts.
    pub fn body(&self, time_s: f64) -> [Ellipsoid; super::body::SEGMENTS] {
        let build = &self.person.build;
        match &self.person.steps {
            Steps::Gait => build.segments(&self.posture(time_s)),
            Steps::Clip(clip) => {
                let walk = self.walk(time_s);
                clip.body(build, &self.posture(time_s), &walk)
            }
            Steps::Actor(actor) => actor.body(&self.walk(time_s)),
        }
    }
}
