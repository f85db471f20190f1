//! Motion of one person: a script's corners ([`MotionBuilder`]) smoothed by [`Track`]s, or the motion of a wandering
//! person (`wander.rs`). Gait and small motions are added.

mod builder;

use super::body::Posture;
pub use super::cycle::Walk;
use super::gait;
use super::motion_state::MotionState;
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
    walk_intensity: Track,
    sit_fraction: Track,
    /// Heights of seats, m, each with the time from which it holds.
    seats: Vec<(f64, f64)>,
    /// Intensity of steps on the spot.
    march_intensity: Track,
    /// Fraction of the descent into a crouch.
    crouch_fraction: Track,
    /// Fraction of the motion from a crouch to lying.
    lying_fraction: Track,
    /// Crouches and places to lie, each with the time from which it holds.
    descents: Vec<(f64, Descent)>,
    /// Source of the motion that replaces the tracks.
    wanderer: Option<Wanderer>,
    /// Time from which the person is present, s.
    pub start_s: f64,
    /// Time until which the person is present, s.
    pub end_s: f64,
}

/// Crouch, and place to lie after it.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Descent {
    crouch: Crouch,
    lying: Option<Lying>,
}

/// Returns the value that holds at a time. Each value holds from a time on; the first one also holds before.
fn value_at<T: Copy>(values: &[(f64, T)], time_s: f64) -> Option<T> {
    let begun = values.partition_point(|(from_s, _)| *from_s <= time_s);
    values.get(begun.saturating_sub(1)).map(|(_, value)| *value)
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

    fn state(&self, time_s: f64) -> MotionState {
        if let Some(wanderer) = &self.wanderer {
            return wanderer.state(time_s);
        }
        let descent = value_at(&self.descents, time_s);
        MotionState {
            position_m: [self.x.at(time_s), self.y.at(time_s)],
            heading_rad: self.heading.at(time_s),
            phase: self.phase.at(time_s),
            walk_intensity: self.walk_intensity.at(time_s),
            sit_fraction: self.sit_fraction.at(time_s),
            march_intensity: self.march_intensity.at(time_s),
            crouch_fraction: self.crouch_fraction.at(time_s),
            crouch: descent.map(|descent| descent.crouch),
            lying_fraction: self.lying_fraction.at(time_s),
            lying: descent.and_then(|descent| descent.lying),
            small_motion: None,
        }
    }

    /// Joint angles and position at a time.
    pub fn posture(&self, time_s: f64) -> Posture {
        let build = &self.person.build;
        let state = self.state(time_s);
        let MotionState { heading_rad, phase, sit_fraction: sit, march_intensity, .. } = state;
        // A person that walks by a clip or as an actor stands here.
        let walks_by_gait = matches!(self.person.steps, Steps::Gait);
        let walk_intensity = if walks_by_gait { state.walk_intensity.max(0.0) } else { 0.0 };
        let (forward, left) = gait::sway(phase, walk_intensity);
        let (sway_x, sway_y) = self.person.sway_m(time_s);
        let (sine, cosine) = heading_rad.sin_cos();
        let x = state.position_m[0] + forward * cosine - left * sine + sway_x;
        let y = state.position_m[1] + forward * sine + left * cosine + sway_y;
        let standing_m = build.standing_hip_height_m();
        let seated_m = value_at(&self.seats, time_s).unwrap_or(0.45) + HIPS_OVER_SEAT_M;
        let mut posture = Posture {
            position_m: [x, y],
            heading_rad,
            hip_height_m: standing_m + (seated_m - standing_m) * sit,
            // The trunk bows when the person stands up or sits down.
            lean_rad: 0.02 + sit * -0.06 + 0.5 * smooth_step(4.0 * sit * (1.0 - sit) * 2.0 - 1.0),
            shoulder_rad: [0.05 + 0.35 * sit; 2],
            elbow_rad: [0.15 + 1.0 * sit; 2],
            hip_rad: [1.5 * sit; 2],
            knee_rad: [1.5 * sit; 2],
            chest_m: self.person.chest_m(time_s),
            ..build.standing()
        };
        gait::walk(&mut posture, phase, walk_intensity * (1.0 - sit), build.height_m, &self.person.style);
        if march_intensity > 0.0 {
            gait::march(&mut posture, phase, march_intensity);
        }
        let mut fidget = self.person.fidget(time_s);
        let (crouch_fraction, lying_fraction) = (state.crouch_fraction, state.lying_fraction);
        if let (true, Some(crouch)) = (crouch_fraction > 0.0, state.crouch) {
            crouch.apply(build, crouch_fraction, &mut posture);
            if let (true, Some(lying)) = (lying_fraction > 0.0, state.lying) {
                lying.apply(build, lying_fraction, &mut posture);
                // On a bed, arms move and the trunk rests.
                fidget.lean_rad *= 1.0 - lying_fraction;
                fidget.twist_rad *= 1.0 - lying_fraction;
            }
        }
        if let Some(desk) = &self.person.at_desk {
            for (i, (shoulder, elbow)) in desk.arms_rad.into_iter().enumerate() {
                posture.shoulder_rad[i] += shoulder;
                posture.elbow_rad[i] += elbow;
            }
            posture.lean_rad += desk.lean_rad;
        }
        if let Some(small_motion) = &state.small_motion {
            small_motion.add_to(build, &mut posture);
        }
        posture.shoulder_rad[fidget.side] += fidget.arm_rad;
        posture.elbow_rad[fidget.side] += 0.8 * fidget.arm_rad;
        posture.lean_rad += fidget.lean_rad;
        posture.twist_rad += fidget.twist_rad;
        posture
    }

    /// Position and phase of the steps at a time.
    pub fn walk(&self, time_s: f64) -> Walk {
        let (sway_x, sway_y) = self.person.sway_m(time_s);
        let MotionState { position_m: [x, y], heading_rad, phase, walk_intensity, .. } = self.state(time_s);
        let intensity = walk_intensity.clamp(0.0, 1.0);
        Walk { position_m: [x + sway_x, y + sway_y], heading_rad, phase, intensity }
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
