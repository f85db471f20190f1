//! Motion of one person: a script's corners ([`MotionBuilder`]) smoothed by [`Track`]s, or the motion of a wandering
//! person (`wander.rs`). Gait and small motions are added.

mod builder;

use super::body::Posture;
pub use super::cycle::Walk;
use super::gait;
use super::moment::Moment;
pub use super::person::{AtDesk, BodyPoint, Person, Steps};
use super::postures::{Crouch, HIPS_OVER_SEAT_M, Lying};
use super::track::Track;
use super::wander::Wanderer;
use crate::em::specular::Ellipsoid;
use crate::math::smooth_step;
pub use builder::{Bed, MotionBuilder};

/// A person's motion over time.
#[derive(Debug, Clone)]
pub struct Motion {
    /// Person that moves.
    pub person: Person,
    x: Track,
    y: Track,
    heading: Track,
    phase: Track,
    vigour: Track,
    sit: Track,
    /// Heights of seats, m, each with the time from which it holds.
    seats: Vec<(f64, f64)>,
    /// Intensity of steps on the spot.
    march: Track,
    /// Fraction of the descent into a crouch, and fraction of the motion from there to lying.
    low: Track,
    lie: Track,
    /// Crouches and places to lie, each with the time from which it holds.
    lows: Vec<(f64, Low)>,
    /// Source of the motion that replaces the tracks.
    wanderer: Option<Wanderer>,
    /// Time from which the person is present, s.
    pub start_s: f64,
    /// Time until which the person is present, s.
    pub end_s: f64,
}

/// Crouch, and place to lie after it.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Low {
    crouch: Crouch,
    lying: Option<Lying>,
}

/// Returns the value that holds at a time. Each value holds from a time on; the first one also holds before.
fn latest<T: Copy>(all: &[(f64, T)], time_s: f64) -> Option<T> {
    let past = all.partition_point(|(from_s, _)| *from_s <= time_s);
    all.get(past.saturating_sub(1)).map(|(_, what)| *what)
}

impl Motion {
    /// Whether the person is present at a time.
    pub fn exists(&self, time_s: f64) -> bool {
        time_s >= self.start_s && time_s <= self.end_s
    }

    /// Makes the motion of a wandering person that is present all the time.
    pub(crate) fn wandering(person: Person, wanderer: Wanderer) -> Self {
        let mut motion = MotionBuilder::new(person, f64::NEG_INFINITY, [0.0; 2], 0.0).stay();
        motion.wanderer = Some(wanderer);
        motion
    }

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

    /// Joint angles and position at a time.
    pub fn posture(&self, time_s: f64) -> Posture {
        let build = &self.person.build;
        let moment = self.moment(time_s);
        let Moment { heading_rad, phase, sit, march, low, lie, .. } = moment;
        // A person that walks by a clip or as an actor stands here.
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
            // The trunk bows when the person stands up or sits down.
            lean_rad: 0.02 + sit * -0.06 + 0.5 * smooth_step(4.0 * sit * (1.0 - sit) * 2.0 - 1.0),
            shoulder_rad: [0.05 + 0.35 * sit; 2],
            elbow_rad: [0.15 + 1.0 * sit; 2],
            hip_rad: [1.5 * sit; 2],
            knee_rad: [1.5 * sit; 2],
            chest_m: self.person.chest_m(time_s),
            ..build.standing()
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
                // On a bed, arms move and the trunk rests.
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

    /// Position and phase of the steps at a time.
    pub fn walk(&self, time_s: f64) -> Walk {
        let (sway_x, sway_y) = self.person.sway_m(time_s);
        let Moment { position_m: [x, y], heading_rad, phase, vigour, .. } = self.moment(time_s);
        Walk { position_m: [x + sway_x, y + sway_y], heading_rad, phase, vigour: vigour.clamp(0.0, 1.0) }
    }

    /// Returns the ellipsoids of the body at a time. For an actor from a file they surround its parts.
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
