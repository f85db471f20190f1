//! One wandering person: a role that lasts for some time, the errands of the role, and small motions.

use rand::Rng;
use rand_distr::{Distribution, StandardNormal};
use rand_xoshiro::Xoshiro256PlusPlus;

use super::node::Node;
use super::setting::Setting;
use super::small::{Arm, Stroke, shift_weight};
use super::walker::{Command, Limits, Pose, STEP_S};
use super::{chance, draw, heavy_tailed};
use crate::math::wrapped;
use crate::people::body::Build;
use crate::random::{Purpose, generator};

/// Distance at which a corner of a route, or a goal without a stop, counts as passed, m.
const PASS_M: f64 = 0.3;
/// Distance at which a goal with a stop counts as reached, m.
const STOP_M: f64 = 0.12;
/// Time without progress after which the person changes the errand, s.
const PATIENCE_S: f64 = 1.2;
/// Time for sitting down or standing up, s.
const SIT_DOWN_S: f64 = 1.6;

/// Role of a person until the next role is assigned.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Role {
    /// Walks from place to place.
    Wander,
    /// Walks to and fro between two places. The next one is `ends[at]`.
    Pace { ends: [[f64; 2]; 2], at: usize },
    /// Stands.
    Stand,
    /// Walks to the left (1) or right (-1) of the other person.
    Beside { side: f64 },
    /// Follows the other person at a distance.
    Behind { gap_m: f64 },
    /// Walks to a place and waits there for the other person.
    Meet { at: [f64; 2] },
}

/// Current part of a role.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Errand {
    /// Walks along a route corner by corner, and stops at its end or passes it.
    Walk { way: Vec<[f64; 2]>, stops: bool, then: Then },
    /// Stands for a time, s.
    Stand { left_s: f64, facing: Facing },
    /// Sits for a time, s.
    Sit { seat: usize, left_s: f64 },
    /// Stays with the other person.
    Accompany,
}

/// Continuation at the end of a route.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Then {
    /// Begins the next errand of the role.
    Plan,
    /// Pauses.
    Pause,
    /// Waits for the other person.
    Await,
    /// Sits down on a seat.
    Sit(usize),
}

/// Direction in which a standing person looks.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Facing {
    /// Keeps the direction.
    Same,
    /// Looks in a direction, rad.
    Heading(f64),
    /// Looks at the other person, with gestures.
    Other,
}

/// A wandering person.
#[derive(Debug, Clone)]
pub(super) struct Walker {
    rng: Xoshiro256PlusPlus,
    /// Current position and motion.
    pub pose: Pose,
    /// Bounds of the motion.
    pub limits: Limits,
    build: Build,
    /// Role of this person when two people do nothing together.
    pub own: Role,
    /// Current role.
    pub role: Role,
    /// Current errand.
    pub errand: Errand,
    /// Mean speed of walks, m/s.
    speed_m_per_s: f64,
    /// Mean speed of the current walk, m/s.
    pub way_m_per_s: f64,
    /// Slow noise of speed and heading, of variance 1.
    pub noise: [f64; 2],
    blocked_s: f64,
    arms: [Arm; 2],
    shift: Stroke,
    /// Mean time between gestures when standing alone, s.
    gesture_s: f64,
    down: f64,
    seat: usize,
}

impl Walker {
    /// Makes the person of a slot. The person stands at first and soon begins to wander.
    pub fn new(setting: &Setting, slot: usize, pose: Pose) -> Self {
        let identity = setting.identity(slot);
        let person = super::person(setting, identity);
        let mut rng = generator(setting.seed, Purpose::Wander, identity);
        let file = &setting.file;
        let kind = rng.random::<f64>();
        let own = if kind < file.stand_probability {
            Role::Stand
        } else if kind < file.stand_probability + file.pace_probability {
            setting.ends(&mut rng).map_or(Role::Wander, |ends| Role::Pace { ends, at: 0 })
        } else {
            Role::Wander
        };
        let speed_m_per_s = draw(&mut rng, file.speed_m_per_s);
        let gestures = chance(&mut rng, file.gesture_probability);
        let gesture_s = if gestures { draw(&mut rng, [3.0, 15.0]) } else { f64::INFINITY };
        let noise: [f64; 2] = [StandardNormal.sample(&mut rng), StandardNormal.sample(&mut rng)];
        let arms = [Arm::draw(&mut rng), Arm::draw(&mut rng)];
        let begin_s = draw(&mut rng, [0.0, 2.0]);
        Walker {
            rng,
            pose,
            limits: setting.limits(&person.build, person.style.stride),
            build: person.build,
            own,
            role: own,
            errand: Errand::Stand { left_s: begin_s, facing: Facing::Same },
            speed_m_per_s,
            way_m_per_s: speed_m_per_s,
            noise,
            blocked_s: 0.0,
            arms,
            shift: Stroke::resting([0.0; 2]),
            gesture_s,
            down: 0.0,
            seat: 0,
        }
    }

    /// Whether the person waits for the other person at a meeting place.
    pub fn is_waiting(&self) -> bool {
        matches!(self.errand, Errand::Stand { left_s, .. } if left_s == f64::INFINITY)
    }

    /// Motion at the end of the step.
    pub fn node(&self) -> Node {
        Node {
            pose: self.pose,
            arms_rad: self.arms.each_ref().map(|arm| arm.stroke.knots()),
            shift_m: self.shift.knots(),
            down: self.down,
            seat: self.seat,
        }
    }

    /// Position of the seat that the person sits on, sits down on or gets up from, m.
    pub fn seat_m(&self, setting: &Setting) -> Option<[f64; 2]> {
        if self.down > 0.0 { setting.seats.get(self.seat).map(|seat| seat.place_m) } else { None }
    }

    /// Assigns a role and begins it. A sitting person gets up first.
    pub fn take(&mut self, role: Role, setting: &Setting) {
        self.role = role;
        if let Errand::Sit { left_s, .. } = &mut self.errand {
            *left_s = left_s.min(0.0);
        } else {
            self.errand = self.plan(setting);
        }
    }

    /// Returns the next errand of the role.
    fn plan(&mut self, setting: &Setting) -> Errand {
        let file = &setting.file;
        self.way_m_per_s = self.speed_m_per_s * draw(&mut self.rng, [0.8, 1.2]);
        match self.role {
            Role::Wander => {
                if !setting.seats.is_empty() && chance(&mut self.rng, file.sit_probability) {
                    let number = self.rng.random_range(0..setting.seats.len());
                    return self.walk(setting, setting.seats[number].before_m, true, Then::Sit(number));
                }
                match setting.goal(&mut self.rng) {
                    Some(goal) => self.walk_or_pause(setting, goal, false),
                    None => self.pause(setting),
                }
            }
            Role::Pace { ends, at } => {
                self.role = Role::Pace { ends, at: 1 - at };
                self.walk_or_pause(setting, ends[at], true)
            }
            Role::Stand => {
                let left_s = heavy_tailed(&mut self.rng, [2.0, 60.0]);
                Errand::Stand { left_s, facing: self.facing() }
            }
            Role::Beside { .. } | Role::Behind { .. } => Errand::Accompany,
            Role::Meet { at } => self.walk(setting, at, true, Then::Await),
        }
    }

    fn walk(&self, setting: &Setting, to: [f64; 2], stops: bool, then: Then) -> Errand {
        Errand::Walk { way: setting.planned.route(self.pose.position_m, to), stops, then }
    }

    fn walk_or_pause(&mut self, setting: &Setting, to: [f64; 2], stops: bool) -> Errand {
        let pauses = chance(&mut self.rng, setting.file.pause_probability);
        self.walk(setting, to, stops || pauses, if pauses { Then::Pause } else { Then::Plan })
    }

    fn pause(&mut self, setting: &Setting) -> Errand {
        let left_s = heavy_tailed(&mut self.rng, setting.file.pause_s);
        Errand::Stand { left_s, facing: self.facing() }
    }

    fn facing(&mut self) -> Facing {
        let part = self.rng.random::<f64>();
        if part < 0.35 {
            Facing::Heading(self.elsewhere())
        } else if part < 0.6 {
            Facing::Other
        } else {
            Facing::Same
        }
    }

    /// Draws another direction in which to look, rad.
    fn elsewhere(&mut self) -> f64 {
        let unit: f64 = StandardNormal.sample(&mut self.rng);
        self.pose.heading_rad + 0.9 * unit
    }

    /// Returns the motions that the person wants in this step, in order of preference. The first safe one is made.
    pub fn decide(&mut self, setting: &Setting, other: Option<Pose>) -> [Command; 3] {
        /// Correlation times of the noise of speed and heading, s.
        const FORGETS_S: [f64; 2] = [2.0, 1.5];
        for (noise, forgets_s) in self.noise.iter_mut().zip(FORGETS_S) {
            let unit: f64 = StandardNormal.sample(&mut self.rng);
            *noise += -*noise * STEP_S / forgets_s + (2.0 * STEP_S / forgets_s).sqrt() * unit;
        }
        if self.blocked_s > PATIENCE_S {
            self.blocked_s = 0.0;
            if matches!(self.errand, Errand::Walk { .. }) {
                self.errand = if chance(&mut self.rng, 0.4) {
                    Errand::Stand { left_s: draw(&mut self.rng, [0.5, 2.0]), facing: Facing::Same }
                } else {
                    self.plan(setting)
                };
            }
        }
        let errand = std::mem::replace(&mut self.errand, Errand::Accompany);
        let (errand, commands) = self.pursue(setting, errand, other);
        self.errand = errand;
        commands
    }

    fn pursue(&mut self, setting: &Setting, errand: Errand, other: Option<Pose>) -> (Errand, [Command; 3]) {
        let on = Command { speed_m_per_s: self.pose.speed_m_per_s, heading_rad: None };
        let going_on = [on, Command::STOP, Command::STOP];
        match errand {
            Errand::Walk { mut way, stops, then } => {
                let Some(&goal) = way.first() else { return (self.after(setting, then, other), going_on) };
                let is_last = way.len() == 1;
                let distance_m = self.pose.distance_m(goal);
                let has_stopped = distance_m < 1.7 * STOP_M && self.pose.speed_m_per_s < 0.05;
                let is_there = if stops && is_last { distance_m < STOP_M || has_stopped } else { distance_m < PASS_M };
                if !is_there {
                    let commands = self.steer(setting, goal, stops && is_last, other);
                    return (Errand::Walk { way, stops, then }, commands);
                }
                if is_last {
                    return (self.after(setting, then, other), going_on);
                }
                way.remove(0);
                (Errand::Walk { way, stops, then }, going_on)
            }
            Errand::Stand { left_s, facing } => {
                let left_s = left_s - STEP_S;
                if left_s <= 0.0 {
                    return (self.plan(setting), [Command::STOP; 3]);
                }
                let turns = facing != Facing::Other && chance(&mut self.rng, STEP_S / 15.0);
                let facing = if turns { Facing::Heading(self.elsewhere()) } else { facing };
                (Errand::Stand { left_s, facing }, self.stand(facing, other))
            }
            Errand::Sit { seat, left_s } => self.sit(setting, seat, left_s, other),
            Errand::Accompany => match (self.role, other) {
                (Role::Beside { side }, Some(other)) => (Errand::Accompany, self.go_beside(setting, side, &other)),
                (Role::Behind { gap_m }, Some(other)) => (Errand::Accompany, self.go_behind(setting, gap_m, &other)),
                _ => {
                    if matches!(self.role, Role::Beside { .. } | Role::Behind { .. }) {
                        self.role = self.own;
                    }
                    (self.plan(setting), going_on)
                }
            },
        }
    }

    /// Returns the errand that follows the end of a route.
    fn after(&mut self, setting: &Setting, then: Then, other: Option<Pose>) -> Errand {
        match then {
            Then::Plan => self.plan(setting),
            Then::Pause => self.pause(setting),
            Then::Await => Errand::Stand { left_s: f64::INFINITY, facing: Facing::Other },
            Then::Sit(seat) => {
                let is_clear = setting.seats.get(seat).is_some_and(|s| is_clear(s.place_m, other));
                if is_clear {
                    Errand::Sit { seat, left_s: draw(&mut self.rng, setting.file.sit_s) }
                } else {
                    self.pause(setting)
                }
            }
        }
    }

    fn sit(&mut self, setting: &Setting, number: usize, left_s: f64, other: Option<Pose>) -> (Errand, [Command; 3]) {
        let stop = [Command::STOP; 3];
        let Some(seat) = setting.seats.get(number) else { return (self.plan(setting), stop) };
        let step = STEP_S / SIT_DOWN_S;
        if left_s > 0.0 && self.down <= 0.0 {
            // The person turns with the back to the seat, and sits down if nobody is near.
            if !is_clear(seat.place_m, other) {
                return (self.pause(setting), stop);
            }
            let off_rad = wrapped(seat.heading_rad - self.pose.heading_rad);
            let is_ready = off_rad.abs() < 0.05 && self.pose.speed_m_per_s <= 0.0;
            if is_ready {
                (self.seat, self.down) = (number, step);
            }
            let turn = Command { speed_m_per_s: 0.0, heading_rad: Some(seat.heading_rad) };
            return (Errand::Sit { seat: number, left_s }, [turn, Command::STOP, Command::STOP]);
        }
        if left_s > 0.0 {
            self.down = (self.down + step).min(1.0);
            return (Errand::Sit { seat: number, left_s: left_s - STEP_S }, stop);
        }
        self.down = (self.down - step).max(0.0);
        if self.down > 0.0 { (Errand::Sit { seat: number, left_s }, stop) } else { (self.plan(setting), stop) }
    }

    /// Applies the step.
    pub fn apply(&mut self, setting: &Setting, pose: Pose, refused: usize) {
        self.pose = pose;
        let change_s = if refused == 0 { -STEP_S } else { STEP_S };
        self.blocked_s = (self.blocked_s + change_s).max(0.0);
        let stands = self.pose.speed_m_per_s < 0.05;
        let talks = matches!(self.errand, Errand::Stand { facing: Facing::Other, .. });
        let idle_s = match (stands, talks) {
            (true, true) => 0.5 * self.gesture_s,
            (true, false) => self.gesture_s,
            (false, _) => 3.0 * self.gesture_s,
        };
        for arm in &mut self.arms {
            arm.advance(&mut self.rng, &self.build, idle_s, setting.file.gesture_m_per_s);
        }
        shift_weight(&mut self.shift, &mut self.rng, stands && self.down <= 0.0);
    }
}

/// Whether a seat can be used. The other person must be far from it; the distance grows with that person's speed.
fn is_clear(seat_m: [f64; 2], other: Option<Pose>) -> bool {
    other.is_none_or(|o| o.distance_m(seat_m) > 1.3 + 1.5 * o.speed_m_per_s)
}
