//! Builder of scripted motions: corners of a route, turns, seats, beds and squats, one after another.

use std::f64::consts::PI;

use super::super::body::Build;
use super::super::gait;
use super::super::postures::{Crouch, Lying};
use super::super::track::Track;
use super::{Descent, Motion, Person, Steps};
use crate::math::wrapped;

/// Half the time over which a corner of the route is rounded, s.
const CORNER_S: f64 = 0.35;
/// Half the time for sitting down or standing up, s. Shorter times of sitting are lengthened to four of it, in which a
/// person goes down and stands up at once.
const SIT_S: f64 = 0.8;
/// Half the time for lying down or rising, s.
const LIE_S: f64 = 1.6;
/// Time on the edge of a bed before lying down and before standing up, s.
const EDGE_PAUSE_S: f64 = 0.8;
/// Least angle of a turn that takes steps, rad.
const LEAST_MARCH_RAD: f64 = 0.4;
/// Widest turn made while walking if the turning rate is limited, rad. Wider turns are made on the spot.
const WIDEST_CURVE_RAD: f64 = 1.8;
/// Turning rate of requested turns on the spot if the script states none, rad/s.
const TURN_RAD_PER_S: f64 = 2.1;

/// A bed and the side for getting in and out.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bed {
    /// Position of the hips when lying, m.
    pub position_m: [f64; 2],
    /// Direction of the feet, rad.
    pub heading_rad: f64,
    /// Height of the mattress, m.
    pub height_m: f64,
    /// Distance from `position_m` to the edge for getting in and out, to the left of the heading, m; to the right if
    /// negative.
    pub edge_m: f64,
}

impl Bed {
    /// Distance of the hips from the edge when sitting on it, m.
    const HIPS_FROM_EDGE_M: f64 = 0.12;

    /// Distance of the hips behind the feet when sitting, m. The thighs are level.
    fn back_m(build: &Build) -> f64 {
        0.95 * build.thigh_m()
    }

    /// Heading when sitting on the edge, rad.
    fn outward_rad(&self) -> f64 {
        self.heading_rad + 0.5 * PI * self.edge_m.signum()
    }

    /// Position for standing before the bed, m.
    pub fn stand_m(&self, build: &Build) -> [f64; 2] {
        let from_middle = self.edge_m.abs() - Self::HIPS_FROM_EDGE_M + Self::back_m(build);
        let (sine, cosine) = self.outward_rad().sin_cos();
        [self.position_m[0] + from_middle * cosine, self.position_m[1] + from_middle * sine]
    }

    /// Descent to the edge, and the place to lie after it.
    fn descent(&self, build: &Build) -> Descent {
        let crouch = Crouch::sit(build, self.height_m, Self::back_m(build));
        Descent { crouch, lying: Some(Lying { position_m: self.position_m, height_m: self.height_m }) }
    }
}

/// Builder of a motion, step by step.
#[derive(Debug, Clone)]
pub struct MotionBuilder {
    motion: Motion,
    /// Time reached so far, s.
    time_s: f64,
    /// Position reached so far, m.
    position_m: [f64; 2],
    /// Heading reached so far, not wrapped, rad.
    heading_rad: f64,
    /// Fastest turning rate, rad/s. If `None`, a turn takes the time of a corner.
    turn_rate_rad_per_s: Option<f64>,
    /// Time at which the last turn ends, s.
    turn_end_s: f64,
}

impl MotionBuilder {
    /// Begins at a position and time, facing a direction.
    pub fn new(person: Person, start_s: f64, position_m: [f64; 2], facing_rad: f64) -> Self {
        let motion = Motion {
            person,
            x: Track::constant(position_m[0], CORNER_S),
            y: Track::constant(position_m[1], CORNER_S),
            heading: Track::constant(facing_rad, CORNER_S),
            phase: Track::constant(0.0, CORNER_S),
            walk_intensity: Track::constant(0.0, CORNER_S),
            sit_fraction: Track::constant(0.0, SIT_S),
            seats: Vec::new(),
            march_intensity: Track::constant(0.0, CORNER_S),
            crouch_fraction: Track::constant(0.0, SIT_S),
            lying_fraction: Track::constant(0.0, LIE_S),
            descents: Vec::new(),
            wanderer: None,
            start_s,
            end_s: f64::INFINITY,
        };
        MotionBuilder {
            motion,
            time_s: start_s,
            position_m,
            heading_rad: facing_rad,
            turn_rate_rad_per_s: None,
            turn_end_s: f64::NEG_INFINITY,
        }
    }

    /// Limits the turning rate from here on, rad/s. Wide turns are made on the spot, with steps; others follow a curve.
    pub fn turning_at(mut self, largest_rad_per_s: Option<f64>) -> Self {
        self.turn_rate_rad_per_s = largest_rad_per_s;
        self
    }

    /// Person that moves.
    pub fn person(&self) -> &Person {
        &self.motion.person
    }

    /// Time reached so far, s.
    pub fn time_s(&self) -> f64 {
        self.time_s
    }

    /// Heading reached so far, rad.
    pub fn heading_rad(&self) -> f64 {
        self.heading_rad
    }

    /// Position reached so far, m.
    pub fn place(&self) -> [f64; 2] {
        self.position_m
    }

    /// Change of heading for facing a direction, rad.
    fn change_to(&self, heading_rad: f64) -> f64 {
        wrapped(heading_rad - self.heading_rad)
    }

    /// Turns to a heading about a time, over a window before and after it.
    fn turn(&mut self, time_s: f64, heading_rad: f64, window_s: f64) {
        let change = self.change_to(heading_rad);
        self.motion.heading.change_level_over(time_s, change, window_s);
        self.heading_rad += change;
    }

    /// Turns on the spot to a heading, rad.
    pub fn face(mut self, facing_rad: f64) -> Self {
        let change = self.change_to(facing_rad);
        if change.abs() < 1e-3 {
            return self;
        }
        let window_s = (change.abs() / self.turn_rate_rad_per_s.unwrap_or(TURN_RAD_PER_S)).max(CORNER_S);
        let begin_s = self.time_s.max(self.turn_end_s);
        let end_s = begin_s + 2.0 * window_s;
        self.turn(begin_s + window_s, facing_rad, window_s);
        if change.abs() > LEAST_MARCH_RAD && matches!(self.motion.person.steps, Steps::Gait) {
            // The steps lie within the turn, so that both feet are down when it ends.
            for (t, sign) in [(begin_s + CORNER_S, 1.0), (end_s - CORNER_S, -1.0)] {
                self.motion.march_intensity.change_level(t, sign);
                self.motion.phase.change_slope(t, sign * gait::MARCH_HZ);
            }
        }
        (self.time_s, self.turn_end_s) = (end_s, end_s);
        self
    }

    /// Turns for a straight line that begins now. Also returns half the time over which the corner is rounded, s.
    fn turn_into(mut self, heading_rad: f64) -> (Self, f64) {
        let Some(rate) = self.turn_rate_rad_per_s else {
            self.turn(self.time_s, heading_rad, CORNER_S);
            return (self, CORNER_S);
        };
        let angle = self.change_to(heading_rad).abs();
        let window_s = (angle / rate).max(CORNER_S);
        if angle > WIDEST_CURVE_RAD || self.time_s - window_s < self.turn_end_s {
            return (self.face(heading_rad), CORNER_S);
        }
        self.turn(self.time_s, heading_rad, window_s);
        self.turn_end_s = self.time_s + window_s;
        (self, window_s)
    }

    /// Walks straight to a position.
    pub fn walk_to(self, to_m: [f64; 2], speed_m_per_s: f64) -> Self {
        let (dx, dy) = (to_m[0] - self.position_m[0], to_m[1] - self.position_m[1]);
        let distance_m = dx.hypot(dy);
        if distance_m < 1e-3 {
            return self;
        }
        let (mut this, corner_s) = self.turn_into(dy.atan2(dx));
        let (begin_s, end_s) = (this.time_s, this.time_s + distance_m / speed_m_per_s);
        let (vx, vy) = (dx / distance_m * speed_m_per_s, dy / distance_m * speed_m_per_s);
        // The line that ends here is rounded over the same time as the one that begins.
        if corner_s > CORNER_S {
            for track in [&mut this.motion.x, &mut this.motion.y] {
                track.widen_slopes(begin_s, corner_s);
            }
        }
        let motion = &mut this.motion;
        let leg_m = motion.person.build.standing_hip_height_m();
        // The phase of a clip advances with the ground covered, so that feet do not slide.
        let (walk_intensity, cycles_per_s) = match &motion.person.steps {
            Steps::Gait => {
                let walk_intensity = (speed_m_per_s / 1.3).sqrt().min(1.35);
                (walk_intensity, gait::cycles_per_second(speed_m_per_s, leg_m) / motion.person.style.stride)
            }
            Steps::Clip(clip) => (1.0, speed_m_per_s / clip.cycle_m(leg_m)),
            Steps::Actor(actor) => (1.0, speed_m_per_s / actor.cycle_m),
        };
        for (t, sign, window_s) in [(begin_s, 1.0, corner_s), (end_s, -1.0, CORNER_S)] {
            motion.x.change_slope_over(t, sign * vx, window_s);
            motion.y.change_slope_over(t, sign * vy, window_s);
            motion.phase.change_slope(t, sign * cycles_per_s);
            motion.walk_intensity.change_level(t, sign * walk_intensity);
        }
        this.time_s = end_s;
        this.position_m = to_m;
        this
    }

    /// Stands still.
    pub fn stand(mut self, duration_s: f64) -> Self {
        self.time_s += duration_s;
        self
    }

    /// Turns to a heading, rad, and sits down for a duration, which includes sitting down and standing up.
    pub fn sit(self, heading_rad: f64, seat_height_m: f64, duration_s: f64) -> Self {
        let mut this = if self.turn_rate_rad_per_s.is_some() { self.face(heading_rad) } else { self };
        this.turn(this.time_s, heading_rad, CORNER_S);
        this.motion.seats.push((this.time_s, seat_height_m));
        let duration_s = duration_s.max(4.0 * SIT_S);
        this.motion.sit_fraction.change_level(this.time_s + SIT_S, 1.0);
        this.motion.sit_fraction.change_level(this.time_s + duration_s - SIT_S, -1.0);
        this.time_s += duration_s;
        this
    }

    /// Sits from the beginning, without end.
    pub fn seated(mut self, seat_height_m: f64) -> Self {
        self.motion.seats.push((f64::NEG_INFINITY, seat_height_m));
        self.motion.sit_fraction = Track::constant(1.0, SIT_S);
        self
    }

    /// Goes down for a duration, which includes going down and standing up. The feet stay in place.
    fn crouch(mut self, crouch: Crouch, duration_s: f64) -> Self {
        let duration_s = duration_s.max(4.0 * SIT_S);
        // The last walk has ended, and the feet stand.
        let begin_s = self.time_s + CORNER_S;
        self.motion.descents.push((begin_s, Descent { crouch, lying: None }));
        self.motion.crouch_fraction.change_level(begin_s + SIT_S, 1.0);
        self.motion.crouch_fraction.change_level(begin_s + duration_s - SIT_S, -1.0);
        self.time_s = begin_s + duration_s + CORNER_S;
        self
    }

    /// Squats for a duration, which includes going down and standing up. The head sinks by `depth_m`.
    pub fn squat(self, depth_m: f64, duration_s: f64) -> Self {
        let crouch = Crouch::squat(&self.motion.person.build, depth_m);
        self.crouch(crouch, duration_s)
    }

    /// Turns with the back to a seat, and sits down on it for a duration, which includes sitting down and standing up.
    /// The feet stay in place; the hips move back by `back_m`.
    pub fn sit_back(self, heading_rad: f64, seat_height_m: f64, back_m: f64, duration_s: f64) -> Self {
        let this = self.face(heading_rad);
        let crouch = Crouch::sit(&this.motion.person.build, seat_height_m, back_m);
        this.crouch(crouch, duration_s)
    }

    /// Turns with the back to a bed ([`Bed::stand_m`]), sits down on its edge, lies down, and gets up the same way. All
    /// of this happens within the duration, s.
    pub fn lie(self, bed: &Bed, duration_s: f64) -> Self {
        let mut this = self.face(bed.outward_rad());
        let begin_s = this.time_s + CORNER_S;
        this.motion.descents.push((begin_s, bed.descent(&this.motion.person.build)));
        this.motion.crouch_fraction.change_level(begin_s + SIT_S, 1.0);
        let lie_s = begin_s + 2.0 * SIT_S + EDGE_PAUSE_S + LIE_S;
        this.motion.lying_fraction.change_level(lie_s, 1.0);
        this.turn(lie_s, bed.heading_rad, LIE_S);
        this.time_s = lie_s;
        let rise_s = (begin_s + duration_s - 2.0 * SIT_S - EDGE_PAUSE_S - LIE_S).max(lie_s + 2.5 * LIE_S);
        this.rise(bed, rise_s)
    }

    /// Lies on a bed from before the beginning, and rises after a duration, s.
    pub fn lying(mut self, bed: &Bed, duration_s: f64) -> Self {
        let build = self.motion.person.build;
        self.position_m = bed.stand_m(&build);
        let m = &mut self.motion;
        (m.x, m.y) = (Track::constant(self.position_m[0], CORNER_S), Track::constant(self.position_m[1], CORNER_S));
        m.heading = Track::constant(bed.heading_rad, CORNER_S);
        self.heading_rad = bed.heading_rad;
        m.crouch_fraction = Track::constant(1.0, SIT_S);
        m.lying_fraction = Track::constant(1.0, LIE_S);
        m.descents.push((f64::NEG_INFINITY, bed.descent(&build)));
        let rise_s = self.time_s + duration_s.max(LIE_S);
        self.rise(bed, rise_s)
    }

    /// Gets up from lying; the motion is half done at `rise_s`.
    fn rise(mut self, bed: &Bed, rise_s: f64) -> Self {
        self.motion.lying_fraction.change_level(rise_s, -1.0);
        self.turn(rise_s, bed.outward_rad(), LIE_S);
        let up_s = rise_s + LIE_S + EDGE_PAUSE_S + SIT_S;
        self.motion.crouch_fraction.change_level(up_s, -1.0);
        self.time_s = up_s + SIT_S + CORNER_S;
        self.turn_end_s = rise_s + LIE_S;
        self
    }

    /// Ends the motion: the person disappears at the time reached.
    pub fn leave(mut self) -> Motion {
        self.motion.end_s = self.time_s;
        self.motion
    }

    /// Ends the motion: the person stays without end.
    pub fn stay(self) -> Motion {
        self.motion
    }
}
