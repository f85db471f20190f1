//! One wandering person: a role that lasts for some time, the errands of the role, and small motions.

use rand::Rng;
use rand_distr::{Distribution, StandardNormal};
use rand_xoshiro::Xoshiro256PlusPlus;

use super::dynamics::{Command, Limits, Pose, STEP_S};
use super::node::Node;
use super::setting::Setting;
use super::small::{Arm, Stroke, shift_weight};
use super::{chance, draw, heavy_tailed};
use crate::math::wrapped;
use crate::people::body::Build;
use crate::random::{Purpose, generator};

/// Distance at which a corner of a route, or a goal without a stop, counts as passed, m.
const PASS_M: f64 = 0.3;
/// Distance at which a goal with a stop counts as reached, m.
const STOP_M: f64 = 0.12;
/// Time for which a person is blocked before the errand changes, s.
const PATIENCE_S: f64 = 1.2;
/// Time for sitting down or standing up, s.
const SIT_DOWN_S: f64 = 1.6;

/// Role of a person until the next role is assigned.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Role {
    /// Walks from place to place.
    Wander,
    /// Walks to and fro between two places. The next one is `ends[next]`.
    Pace { ends: [[f64; 2]; 2], next: usize },
    /// Stands.
    Stand,
    /// Walks to the left (1) or right (-1) of the other person.
    Beside { side: f64 },
    /// Follows the other person at a distance.
    Behind { gap_m: f64 },
    /// Walks to a place and waits there for the other person.
    Meet { position_m: [f64; 2] },
}

/// Current part of a role.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Errand {
    /// Walks along a route corner by corner, and stops at its end or passes it.
    Walk { corners: Vec<[f64; 2]>, stops_at_end: bool, route_end: RouteEnd },
    /// Stands for a time, s.
    Stand { remaining_s: f64, facing: Facing },
    /// Sits for a time, s.
    Sit { seat: usize, remaining_s: f64 },
    /// Stays with the other person.
    Accompany,
}

/// Continuation at the end of a route.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum RouteEnd {
    /// Begins the next errand of the role.
    NextErrand,
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
    /// Role of this person while people are independent.
    pub own_role: Role,
    /// Current role.
    pub role: Role,
    /// Current errand.
    pub errand: Errand,
    /// Mean speed of walks, m/s.
    speed_m_per_s: f64,
    /// Mean speed of the current walk, m/s.
    pub walk_speed_m_per_s: f64,
    /// Slow noise of speed and heading, of variance 1.
    pub noise: [f64; 2],
    /// Time for which the first preferred command was unsafe, less the time for which it was safe, s.
    blocked_s: f64,
    arms: [Arm; 2],
    weight_shift: Stroke,
    /// Mean time between gestures when standing alone, s.
    gesture_s: f64,
    /// Fraction of the descent to a seat.
    seat_descent: f64,
    /// Index of that seat.
    seat: usize,
}

impl Walker {
    /// Makes the person of a slot. The person stands for up to two seconds and then begins the role.
    pub fn new(setting: &Setting, slot: usize, pose: Pose) -> Self {
        let identity = setting.identity(slot);
        let person = super::draw_person(setting, identity);
        let mut rng = generator(setting.seed, Purpose::Wander, identity);
        let file = &setting.file;
        let kind = rng.random::<f64>();
        let own_role = if kind < file.stand_probability {
            Role::Stand
        } else if kind < file.stand_probability + file.pace_probability {
            setting.draw_pacing_ends(&mut rng).map_or(Role::Wander, |ends| Role::Pace { ends, next: 0 })
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
            own_role,
            role: own_role,
            errand: Errand::Stand { remaining_s: begin_s, facing: Facing::Same },
            speed_m_per_s,
            walk_speed_m_per_s: speed_m_per_s,
            noise,
            blocked_s: 0.0,
            arms,
            weight_shift: Stroke::constant([0.0; 2]),
            gesture_s,
            seat_descent: 0.0,
            seat: 0,
        }
    }

    /// Whether the person waits for the other person at a meeting place.
    pub fn is_waiting(&self) -> bool {
        matches!(self.errand, Errand::Stand { remaining_s, .. } if remaining_s == f64::INFINITY)
    }

    /// Motion at the end of the step.
    pub fn node(&self) -> Node {
        Node {
            pose: self.pose,
            arms_rad: self.arms.each_ref().map(|arm| arm.stroke.knots()),
            shift_m: self.weight_shift.knots(),
            seat_descent: self.seat_descent,
            seat: self.seat,
        }
    }

    /// Position of the seat that the person sits on, sits down on or gets up from, m.
    pub fn seat_m(&self, setting: &Setting) -> Option<[f64; 2]> {
        if self.seat_descent > 0.0 { setting.seats.get(self.seat).map(|seat| seat.position_m) } else { None }
    }

    /// Assigns a role and begins it. A sitting person gets up first.
    pub fn assign_role(&mut self, role: Role, setting: &Setting) {
        self.role = role;
        if let Errand::Sit { remaining_s, .. } = &mut self.errand {
            *remaining_s = remaining_s.min(0.0);
        } else {
            self.errand = self.next_errand(setting);
        }
    }

    /// Returns the next errand of the role.
    fn next_errand(&mut self, setting: &Setting) -> Errand {
        let file = &setting.file;
        self.walk_speed_m_per_s = self.speed_m_per_s * draw(&mut self.rng, [0.8, 1.2]);
        match self.role {
            Role::Wander => {
                if !setting.seats.is_empty() && chance(&mut self.rng, file.sit_probability) {
                    let seat_index = self.rng.random_range(0..setting.seats.len());
                    return self.walk(setting, setting.seats[seat_index].before_m, true, RouteEnd::Sit(seat_index));
                }
                match setting.draw_goal(&mut self.rng) {
                    Some(goal) => self.walk_or_pause(setting, goal, false),
                    None => self.pause(setting),
                }
            }
            Role::Pace { ends, next } => {
                self.role = Role::Pace { ends, next: 1 - next };
                self.walk_or_pause(setting, ends[next], true)
            }
            Role::Stand => {
                let remaining_s = heavy_tailed(&mut self.rng, [2.0, 60.0]);
                Errand::Stand { remaining_s, facing: self.draw_facing() }
            }
            Role::Beside { .. } | Role::Behind { .. } => Errand::Accompany,
            Role::Meet { position_m } => self.walk(setting, position_m, true, RouteEnd::Await),
        }
    }

    fn walk(&self, setting: &Setting, to: [f64; 2], stops_at_end: bool, route_end: RouteEnd) -> Errand {
        Errand::Walk { corners: setting.route_ground.route(self.pose.position_m, to), stops_at_end, route_end }
    }

    fn walk_or_pause(&mut self, setting: &Setting, to: [f64; 2], stops_at_end: bool) -> Errand {
        let pauses = chance(&mut self.rng, setting.file.pause_probability);
        self.walk(setting, to, stops_at_end || pauses, if pauses { RouteEnd::Pause } else { RouteEnd::NextErrand })
    }

    fn pause(&mut self, setting: &Setting) -> Errand {
        let remaining_s = heavy_tailed(&mut self.rng, setting.file.pause_s);
        Errand::Stand { remaining_s, facing: self.draw_facing() }
    }

    fn draw_facing(&mut self) -> Facing {
        let part = self.rng.random::<f64>();
        if part < 0.35 {
            Facing::Heading(self.draw_gaze_rad())
        } else if part < 0.6 {
            Facing::Other
        } else {
            Facing::Same
        }
    }

    /// Draws another direction for looking, rad.
    fn draw_gaze_rad(&mut self) -> f64 {
        let unit: f64 = StandardNormal.sample(&mut self.rng);
        self.pose.heading_rad + 0.9 * unit
    }

    /// Returns the commands for this step, in order of preference. The first safe one is carried out.
    pub fn preferred_commands(&mut self, setting: &Setting, other: Option<Pose>) -> [Command; 3] {
        /// Correlation times of the noise of speed and heading, s.
        const CORRELATION_S: [f64; 2] = [2.0, 1.5];
        for (noise, correlation_s) in self.noise.iter_mut().zip(CORRELATION_S) {
            let unit: f64 = StandardNormal.sample(&mut self.rng);
            *noise += -*noise * STEP_S / correlation_s + (2.0 * STEP_S / correlation_s).sqrt() * unit;
        }
        if self.blocked_s > PATIENCE_S {
            self.blocked_s = 0.0;
            if matches!(self.errand, Errand::Walk { .. }) {
                self.errand = if chance(&mut self.rng, 0.4) {
                    Errand::Stand { remaining_s: draw(&mut self.rng, [0.5, 2.0]), facing: Facing::Same }
                } else {
                    self.next_errand(setting)
                };
            }
        }
        let errand = std::mem::replace(&mut self.errand, Errand::Accompany);
        let (errand, commands) = self.advance_errand(setting, errand, other);
        self.errand = errand;
        commands
    }

    /// Advances an errand by one step. Returns the errand that follows, and the commands for the step.
    fn advance_errand(&mut self, setting: &Setting, errand: Errand, other: Option<Pose>) -> (Errand, [Command; 3]) {
        let same_speed = Command { speed_m_per_s: self.pose.speed_m_per_s, heading_rad: None };
        let keep_moving = [same_speed, Command::STOP, Command::STOP];
        match errand {
            Errand::Walk { mut corners, stops_at_end, route_end } => {
                let Some(&goal) = corners.first() else {
                    return (self.errand_after_route(setting, route_end, other), keep_moving);
                };
                let is_last = corners.len() == 1;
                let distance_m = self.pose.distance_m(goal);
                let has_stopped = distance_m < 1.7 * STOP_M && self.pose.speed_m_per_s < 0.05;
                let is_there =
                    if stops_at_end && is_last { distance_m < STOP_M || has_stopped } else { distance_m < PASS_M };
                if !is_there {
                    let commands = self.steer(setting, goal, stops_at_end && is_last, other);
                    return (Errand::Walk { corners, stops_at_end, route_end }, commands);
                }
                if is_last {
                    return (self.errand_after_route(setting, route_end, other), keep_moving);
                }
                corners.remove(0);
                (Errand::Walk { corners, stops_at_end, route_end }, keep_moving)
            }
            Errand::Stand { remaining_s, facing } => {
                let remaining_s = remaining_s - STEP_S;
                if remaining_s <= 0.0 {
                    return (self.next_errand(setting), [Command::STOP; 3]);
                }
                let turns = facing != Facing::Other && chance(&mut self.rng, STEP_S / 15.0);
                let facing = if turns { Facing::Heading(self.draw_gaze_rad()) } else { facing };
                (Errand::Stand { remaining_s, facing }, self.stand(facing, other))
            }
            Errand::Sit { seat, remaining_s } => self.sit(setting, seat, remaining_s, other),
            Errand::Accompany => match (self.role, other) {
                (Role::Beside { side }, Some(other)) => (Errand::Accompany, self.go_beside(setting, side, &other)),
                (Role::Behind { gap_m }, Some(other)) => (Errand::Accompany, self.go_behind(setting, gap_m, &other)),
                _ => {
                    if matches!(self.role, Role::Beside { .. } | Role::Behind { .. }) {
                        self.role = self.own_role;
                    }
                    (self.next_errand(setting), keep_moving)
                }
            },
        }
    }

    /// Returns the errand that follows a route.
    fn errand_after_route(&mut self, setting: &Setting, route_end: RouteEnd, other: Option<Pose>) -> Errand {
        match route_end {
            RouteEnd::NextErrand => self.next_errand(setting),
            RouteEnd::Pause => self.pause(setting),
            RouteEnd::Await => Errand::Stand { remaining_s: f64::INFINITY, facing: Facing::Other },
            RouteEnd::Sit(seat) => {
                let is_clear = setting.seats.get(seat).is_some_and(|s| is_seat_clear(s.position_m, other));
                if is_clear {
                    Errand::Sit { seat, remaining_s: draw(&mut self.rng, setting.file.sit_s) }
                } else {
                    self.pause(setting)
                }
            }
        }
    }

    /// Advances sitting: turns to the seat, sits down, sits, and gets up when no time remains.
    fn sit(
        &mut self,
        setting: &Setting,
        seat_index: usize,
        remaining_s: f64,
        other: Option<Pose>,
    ) -> (Errand, [Command; 3]) {
        let stop = [Command::STOP; 3];
        let Some(seat) = setting.seats.get(seat_index) else { return (self.next_errand(setting), stop) };
        let descent_step = STEP_S / SIT_DOWN_S;
        if remaining_s > 0.0 && self.seat_descent <= 0.0 {
            // The person turns with the back to the seat, and sits down if nobody is near.
            if !is_seat_clear(seat.position_m, other) {
                return (self.pause(setting), stop);
            }
            let turn_rad = wrapped(seat.heading_rad - self.pose.heading_rad);
            let is_ready = turn_rad.abs() < 0.05 && self.pose.speed_m_per_s <= 0.0;
            if is_ready {
                (self.seat, self.seat_descent) = (seat_index, descent_step);
            }
            let turn = Command { speed_m_per_s: 0.0, heading_rad: Some(seat.heading_rad) };
            return (Errand::Sit { seat: seat_index, remaining_s }, [turn, Command::STOP, Command::STOP]);
        }
        if remaining_s > 0.0 {
            self.seat_descent = (self.seat_descent + descent_step).min(1.0);
            return (Errand::Sit { seat: seat_index, remaining_s: remaining_s - STEP_S }, stop);
        }
        self.seat_descent = (self.seat_descent - descent_step).max(0.0);
        if self.seat_descent > 0.0 {
            (Errand::Sit { seat: seat_index, remaining_s }, stop)
        } else {
            (self.next_errand(setting), stop)
        }
    }

    /// Completes the step with the pose that was chosen. `rejected` is the number of preferred commands that were not
    /// safe.
    pub fn finish_step(&mut self, setting: &Setting, pose: Pose, rejected: usize) {
        self.pose = pose;
        let change_s = if rejected == 0 { -STEP_S } else { STEP_S };
        self.blocked_s = (self.blocked_s + change_s).max(0.0);
        let is_standing = self.pose.speed_m_per_s < 0.05;
        let is_talking = matches!(self.errand, Errand::Stand { facing: Facing::Other, .. });
        let idle_s = match (is_standing, is_talking) {
            (true, true) => 0.5 * self.gesture_s,
            (true, false) => self.gesture_s,
            (false, _) => 3.0 * self.gesture_s,
        };
        for arm in &mut self.arms {
            arm.advance(&mut self.rng, &self.build, idle_s, setting.file.gesture_m_per_s);
        }
        shift_weight(&mut self.weight_shift, &mut self.rng, is_standing && self.seat_descent <= 0.0);
    }
}

/// Whether a seat can be used. The other person must be far from it; the distance grows with that person's speed.
fn is_seat_clear(seat_m: [f64; 2], other: Option<Pose>) -> bool {
    other.is_none_or(|other| other.distance_m(seat_m) > 1.3 + 1.5 * other.speed_m_per_s)
}
