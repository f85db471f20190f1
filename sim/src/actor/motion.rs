//! One person's motion: corners laid down by a script ([`MotionBuilder`]), smoothed by [`Track`]s, or the way of somebody who wanders
//! (`wander.rs`), with gait and small motions on top.

mod builder;

use std::f64::consts::{PI, TAU};
use std::sync::Arc;

use glam::DVec3;
use rand::Rng;

use super::body::{Build, Posture};
use super::clip::BodyClip;
use super::clothing::Clothing;
pub use super::cycle::Walk;
use super::gait::{self, Style};
use super::imported::Actor;
use super::low::{Crouch, HIPS_OVER_SEAT_M, Lying};
use super::track::Track;
use super::wander::Wanderer;
use crate::field::highlight::Ellipsoid;
use crate::random::{Purpose, generator};
use crate::smooth::smooth_step;
pub use builder::{Bed, MotionBuilder};

/// Steps on the spot in a second, two in each cycle.
pub(super) const MARCH_HZ: f64 = 0.9;
/// Fidgets happen at most once in an epoch of this length, s.
const FIDGET_EPOCH_S: f64 = 5.0;

/// Source of a person's steps.
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

/// Draws that belong to a person, whatever they do.
#[derive(Debug, Clone, PartialEq)]
pub struct Person {
    /// Size.
    pub build: Build,
    /// Identity for later draws.
    pub identity: [u64; 2],
    /// Amplitude factor of each segment: clothes and folds (-4..+2 dB over skin).
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
    /// Further draws of a person at a desk; `None` elsewhere.
    pub at_desk: Option<AtDesk>,
    /// Whose steps they make.
    pub steps: Steps,
    /// Style of walking by the built-in gait.
    pub style: Style,
    /// Clothes, as fields over the body.
    pub clothing: Clothing,
}

/// Draws of a person close before the radar.
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
            style: Style::AVERAGE,
            clothing: Clothing::default(),
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
    /// Person who moves.
    pub person: Person,
    x: Track,
    y: Track,
    heading: Track,
    phase: Track,
    vigour: Track,
    sit: Track,
    /// Heights of seats, m, each from a time on.
    seats: Vec<(f64, f64)>,
    /// Steps on the spot.
    march: Track,
    /// Down on planted feet, and from there to lying.
    low: Track,
    lie: Track,
    /// Places to go down to, each from a time on.
    lows: Vec<(f64, Low)>,
    /// Instead of the tracks.
    wanderer: Option<Wanderer>,
    /// Nobody is there before this, s.
    pub start_s: f64,
    /// Nor after this, s.
    pub end_s: f64,
}

/// Place to which somebody goes down.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Low {
    crouch: Crouch,
    lying: Option<Lying>,
}

/// State of a motion at a time.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Moment {
    /// Place without sway, m.
    pub position_m: [f64; 2],
    /// Facing, rad.
    pub heading_rad: f64,
    /// Cycles (two steps) made.
    pub phase: f64,
    /// 0 standing, 1 walking.
    pub vigour: f64,
    /// 0 standing, 1 sitting with feet ahead.
    pub sit: f64,
    /// Vigour of steps on the spot.
    pub march: f64,
    /// Part of the way down on feet that stay.
    pub low: f64,
    /// Way down to planted feet.
    pub crouch: Option<Crouch>,
    /// Part of the way from there to lying.
    pub lie: f64,
    /// Place to lie.
    pub lying: Option<Lying>,
    /// Small motions beside those of the person.
    pub small: Option<Small>,
}

/// Small motions of somebody who wanders.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Small {
    /// Hips forward over feet that stay, m.
    pub forward_m: f64,
    /// Hips to the left over feet that stay, m.
    pub left_m: f64,
    /// Trunk forward, rad.
    pub lean_rad: f64,
    /// Shoulders against hips, rad.
    pub twist_rad: f64,
    /// Shoulder flexion (left, right), rad.
    pub shoulder_rad: [f64; 2],
    /// Elbow flexion (left, right), rad.
    pub elbow_rad: [f64; 2],
}

impl Small {
    fn add(&self, build: &Build, posture: &mut Posture) {
        let (sine, cosine) = posture.heading_rad.sin_cos();
        posture.position_m[0] += self.forward_m * cosine - self.left_m * sine;
        posture.position_m[1] += self.forward_m * sine + self.left_m * cosine;
        // Legs lean over feet that stay.
        let leg_m = build.thigh_m() + build.shank_m();
        let tilt_rad = self.forward_m / leg_m;
        posture.legs_left_rad -= self.left_m / leg_m;
        for side in 0..2 {
            posture.hip_rad[side] -= tilt_rad;
            posture.ankle_rad[side] += tilt_rad;
            posture.shoulder_rad[side] += self.shoulder_rad[side];
            posture.elbow_rad[side] = (posture.elbow_rad[side] + self.elbow_rad[side]).max(0.0);
        }
        posture.lean_rad += self.lean_rad;
        posture.twist_rad += self.twist_rad;
    }
}

/// Value that holds at a time, of values that each hold from a time on; the first one before all.
fn latest<T: Copy>(all: &[(f64, T)], time_s: f64) -> Option<T> {
    let past = all.partition_point(|(from_s, _)| *from_s <= time_s);
    all.get(past.saturating_sub(1)).map(|(_, what)| *what)
}

impl Motion {
    /// Whether there is anybody at a time.
    pub fn exists(&self, time_s: f64) -> bool {
        time_s >= self.start_s && time_s <= self.end_s
    }

    /// The motion of somebody who wanders and is there all the time.
    pub(super) fn wandering(person: Person, wanderer: Wanderer) -> Self {
        let mut motion = MotionBuilder::new(person, f64::NEG_INFINITY, [0.0; 2], 0.0).stay();
        motion.wanderer = Some(wanderer);
        motion
    }

    /// State of the motion at a time.
    fn moment(&self, time_s: f64) -> Moment {
        if let Some(wanderer) = &self.wanderer {
            return wanderer.moment(time_s);
        }
        let to = latest(&self.lows, time_s);
        Moment {
            position_m: [self.x.at(time_s), self.y.at(time_s)],
            heading_rad: self.heading.at(time_s),
            phase: self.phase.at(time_s),
            vigour: self.vigour.at(time_s),
            sit: self.sit.at(time_s),
            march: self.march.at(time_s),
            low: self.low.at(time_s),
            crouch: to.map(|low| low.crouch),
            lie: self.lie.at(time_s),
            lying: to.and_then(|low| low.lying),
            small: None,
        }
    }

    /// Joint angles and place at a time.
    pub fn posture(&self, time_s: f64) -> Posture {
        let build = &self.person.build;
        let moment = self.moment(time_s);
        let Moment { heading_rad, phase, sit, march, low, lie, .. } = moment;
        // What walks by a clip stands here.
        let vigour = if matches!(self.person.steps, Steps::Gait) { moment.vigour.max(0.0) } else { 0.0 };
        let (forward, left) = gait::sway(phase, vigour);
        let (sway_x, sway_y) = self.person.sway_m(time_s);
        let (sine, cosine) = heading_rad.sin_cos();
        let x = moment.position_m[0] + forward * cosine - left * sine + sway_x;
        let y = moment.position_m[1] + forward * sine + left * cosine + sway_y;
        let standing = build.standing_hip_height_m();
        let seated = latest(&self.seats, time_s).unwrap_or(0.45) + HIPS_OVER_SEAT_M;
        let mut posture = Posture {
            position_m: [x, y],
            heading_rad,
            hip_height_m: standing + (seated - standing) * sit,
            // Getting up and sitting down go through a bow.
            lean_rad: 0.02 + sit * -0.06 + 0.5 * smooth_step(4.0 * sit * (1.0 - sit) * 2.0 - 1.0),
            pelvis_rad: 0.0,
            twist_rad: 0.0,
            shoulder_rad: [0.05 + 0.35 * sit; 2],
            elbow_rad: [0.15 + 1.0 * sit; 2],
            hip_rad: [1.5 * sit; 2],
            knee_rad: [1.5 * sit; 2],
            ankle_rad: [0.0; 2],
            legs_left_rad: 0.0,
            chest_m: self.person.chest_m(time_s),
        };
        gait::walk(&mut posture, phase, vigour * (1.0 - sit), build.height_m, &self.person.style);
        if march > 0.0 {
            gait::march(&mut posture, phase, march);
        }
        let (side, arm, mut lean, mut twist) = self.person.fidget(time_s);
        if let (true, Some(crouch)) = (low > 0.0, moment.crouch) {
            crouch.lower(build, low, &mut posture);
            if let (true, Some(lying)) = (lie > 0.0, moment.lying) {
                lying.lower(build, lie, &mut posture);
                // Arms move on a bed, trunks rest.
                (lean, twist) = (lean * (1.0 - lie), twist * (1.0 - lie));
            }
        }
        if let Some(desk) = &self.person.at_desk {
            for (i, (shoulder, elbow)) in desk.arms_rad.into_iter().enumerate() {
                posture.shoulder_rad[i] += shoulder;
                posture.elbow_rad[i] += elbow;
            }
            posture.lean_rad += desk.lean_rad;
        }
        if let Some(small) = &moment.small {
            small.add(build, &mut posture);
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
        let Moment { position_m: [x, y], heading_rad, phase, vigour, .. } = self.moment(time_s);
        Walk { position_m: [x + sway_x, y + sway_y], heading_rad, phase, vigour: vigour.clamp(0.0, 1.0) }
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
