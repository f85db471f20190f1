//! One person's motion: corners laid down by a script ([`MotionBuilder`]), smoothed by [`Track`]s, or the way of somebody who wanders
//! (`wander.rs`), with gait and small motions on top.

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
    pub(crate) fn wandering(person: Person, wanderer: Wanderer) -> Self {
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
