//! What wandering people do, step by step: where they go, how long they pause, how two of them go about together.
//!
//! A person takes a step only if it leaves time to stop before furniture, walls, the radar and the other person. Braking is
//! simulated by the same dynamics as the step itself; if no step that is wanted passes, the person brakes as was found to be
//! possible one step earlier. So nobody ever leaves the ground or comes closer to somebody than the scene allows.

use std::f64::consts::PI;

use rand::Rng;
use rand_distr::{Distribution, StandardNormal};
use rand_xoshiro::Xoshiro256PlusPlus;

use super::super::body::Build;
use super::super::route::Ground;
use super::small::{Arm, Stroke, shift_weight};
use super::table::{FIRST_S, Node};
use super::walker::{Command, Limits, Pose, STEP_S, wrapped};
use super::{chance, draw, heavy_tailed};
use crate::random::{Purpose, generator};
use crate::scene::file::{PeopleFile, WanderFile};

/// Draws of a place to go to.
const PLACES: usize = 200;
/// Draws of a pair of places.
const PAIRS: usize = 12;
/// A corner of a way, or a goal at which nobody stops, is passed at this distance, m.
const PASS_M: f64 = 0.3;
/// A goal at which somebody stops is reached at this distance, m.
const STOP_M: f64 = 0.12;
/// Somebody who does not get on for so long does something else, s.
const PATIENCE_S: f64 = 1.2;
/// Sitting down and getting up take this, s.
const SIT_DOWN_S: f64 = 1.6;
/// People begin at least so far apart, m.
const BEGIN_APART_M: f64 = 1.0;
/// Where people come and go, others have no goals nearer than this to a door, m.
const OFF_DOORS_M: f64 = 0.9;
/// Nobody comes in by a door to which somebody is nearer than this, m.
const CLEAR_DOOR_M: f64 = 1.6;
/// People are avoided from this distance on, m.
const AVOID_M: f64 = 1.6;
/// Deceleration before a goal, m/s^2.
const SOFT_M_PER_S2: f64 = 0.35;
/// Steps of braking that are looked at: more than a stop ever takes.
const BRAKE_STEPS: usize = 200;

/// Part of the ground plan in which the scene lets people wander, as seen from the radar.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct View {
    /// The radar, m.
    pub radar_m: [f64; 2],
    /// Its boresight, rad.
    pub azimuth_rad: f64,
}

/// A door in which somebody can stand without being in anything's way.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Door {
    /// Middle of the doorway, m.
    pub middle_m: [f64; 2],
    /// Unit vector into the room.
    pub inward: [f64; 2],
    /// Width, m.
    pub width_m: f64,
}

impl Door {
    /// Depth behind the door at which people are out of sight and gone, and at which they walk freely, m.
    pub const OUT_M: f64 = -0.75;
    /// See [`Door::OUT_M`].
    pub const IN_M: f64 = 0.75;

    /// Place at a depth behind the door, m.
    pub fn at(&self, depth_m: f64) -> [f64; 2] {
        [0, 1].map(|i| self.middle_m[i] + depth_m * self.inward[i])
    }

    /// Whether a place is in the doorway or right before or behind it.
    fn holds(&self, at: [f64; 2]) -> bool {
        let off = [at[0] - self.middle_m[0], at[1] - self.middle_m[1]];
        let depth = off[0] * self.inward[0] + off[1] * self.inward[1];
        let aside = (off[1] * self.inward[0] - off[0] * self.inward[1]).abs();
        depth <= Self::IN_M + 0.3 && aside <= (0.5 * self.width_m - 0.2).max(0.15)
    }
}

/// A seat, and where one stands to sit down on it.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Seat {
    /// Where the hips come to rest, m.
    pub place_m: [f64; 2],
    /// Where one stands before it, m.
    pub before_m: [f64; 2],
    /// Where one looks, rad.
    pub heading_rad: f64,
    /// From there back to where the hips come to rest, m.
    pub back_m: f64,
    /// Height of the seat, m.
    pub height_m: f64,
}

/// Where people wander and how.
#[derive(Debug)]
pub(super) struct Setting {
    /// How.
    pub file: WanderFile,
    /// What the scene says of all people.
    pub people: PeopleFile,
    /// All draws depend on it.
    pub seed: u64,
    /// Identity of the first person; the others' follow.
    pub first_identity: u64,
    /// Size of the ground plan, m.
    pub size_m: [f64; 2],
    /// Where hips may be.
    pub ground: Ground,
    /// Where ways are laid: farther off everything.
    pub planned: Ground,
    /// Where goals are; anywhere if absent.
    pub view: Option<View>,
    /// Doors that can be used.
    pub doors: Vec<Door>,
    /// Seats that can be used.
    pub seats: Vec<Seat>,
    /// Whether people come in and leave, or are there all the time.
    pub comes_and_goes: bool,
}

impl Setting {
    /// The person who comes to a slot as a visitor of this number.
    pub fn identity(&self, slot: usize, number: u64) -> [u64; 2] {
        [self.first_identity + slot as u64, number]
    }

    /// Bounds of the motion of a person with such a body and stride.
    pub fn limits(&self, build: &Build, stride: f64) -> Limits {
        Limits {
            // Along and across the way: together no more than the file says.
            acceleration_m_per_s2: self.file.acceleration_m_per_s2 * 0.5f64.sqrt(),
            turn_rad_per_s: self.people.turn_rate_deg_per_s.unwrap_or(120.0).to_radians(),
            leg_m: build.standing_hip_height_m(),
            stride,
        }
    }

    /// A free place to go to.
    fn goal(&self, rng: &mut Xoshiro256PlusPlus) -> Option<[f64; 2]> {
        for number in 0..2 * PLACES {
            let at = match &self.view {
                Some(view) => {
                    let [nearest, farthest] = self.file.range_m;
                    let range_m = nearest + (farthest - nearest) * rng.random::<f64>().powf(self.file.nearness);
                    let most = self.file.off_boresight_deg.to_radians();
                    let (sine, cosine) = (view.azimuth_rad + draw(rng, [-most, most])).sin_cos();
                    [view.radar_m[0] + range_m * cosine, view.radar_m[1] + range_m * sine]
                }
                None => self.size_m.map(|size| draw(rng, [0.0, size])),
            };
            let ground = if number < PLACES { &self.planned } else { &self.ground };
            let is_off_doors = !self.comes_and_goes
                || self.doors.iter().all(|door| distance_m(at, door.at(Door::IN_M)) >= OFF_DOORS_M);
            if is_off_doors && ground.is_free(at) {
                return Some(at);
            }
        }
        None
    }

    /// Where somebody stands first, off others.
    fn start(&self, rng: &mut Xoshiro256PlusPlus, taken: &[[f64; 2]]) -> [f64; 2] {
        /// Places along each axis where chance finds none.
        const GRID: usize = 40;
        let off = |at: [f64; 2]| taken.iter().map(|other| distance_m(at, *other)).fold(BEGIN_APART_M, f64::min);
        for _ in 0..PLACES {
            let Some(at) = self.goal(rng) else { break };
            if off(at) >= BEGIN_APART_M {
                return at;
            }
        }
        let mut best = (-1.0, self.size_m.map(|size| 0.5 * size));
        for i in 1..GRID * GRID {
            let at =
                [self.size_m[0] * (i % GRID) as f64 / GRID as f64, self.size_m[1] * (i / GRID) as f64 / GRID as f64];
            if self.ground.is_free(at) && off(at) > best.0 {
                best = (off(at), at);
            }
        }
        best.1
    }

    /// Two free places far apart with nothing between them.
    fn ends(&self, rng: &mut Xoshiro256PlusPlus) -> Option<[[f64; 2]; 2]> {
        let mut best: Option<(f64, [[f64; 2]; 2])> = None;
        for _ in 0..PAIRS {
            let (a, b) = (self.goal(rng)?, self.goal(rng)?);
            let length_m = distance_m(a, b);
            if self.planned.route(a, b).len() == 1 && best.is_none_or(|(longest, _)| length_m > longest) {
                best = Some((length_m, [a, b]));
            }
        }
        best.map(|(_, ends)| ends)
    }

    /// Whether hips may be there: on the free ground, or in the doorway that somebody goes through.
    fn lets(&self, passage: Option<usize>, at: [f64; 2]) -> bool {
        self.ground.is_free(at) || passage.and_then(|door| self.doors.get(door)).is_some_and(|door| door.holds(at))
    }
}

fn distance_m(a: [f64; 2], b: [f64; 2]) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

/// What two people do together for a while.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Mode {
    Independent,
    Together,
    Follow,
    Meet,
    Pass,
    StandAndWalk,
}

/// What somebody is about until told otherwise.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Role {
    /// From place to place.
    Wander,
    /// To and fro between two places: the next one is `ends[at]`.
    Pace { ends: [[f64; 2]; 2], at: usize },
    /// Stands.
    Stand,
    /// Goes at the other's left (1) or right (-1).
    Beside { side: f64 },
    /// Goes after the other at a distance.
    Behind { gap_m: f64 },
    /// Goes to a place and waits there for the other.
    Meet { at: [f64; 2] },
    /// Leaves by a door.
    Leave { door: usize },
}

/// What somebody does now.
#[derive(Debug, Clone, PartialEq)]
enum Errand {
    /// Walks a way corner by corner, and stops at its end or passes it.
    Walk { way: Vec<[f64; 2]>, stops: bool, then: Then },
    /// Stands for a time, s.
    Stand { left_s: f64, facing: Facing },
    /// Sits for a time, s.
    Sit { seat: usize, left_s: f64 },
    /// Keeps to the other.
    Accompany,
}

/// What comes at the end of a way.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Then {
    /// Whatever the role says.
    Plan,
    /// A pause.
    Pause,
    /// Waiting for the other.
    Await,
    /// A seat.
    Sit(usize),
    /// The way out by a door.
    GoOut(usize),
    /// Nothing: the person has left.
    Vanish,
}

/// Where somebody looks who stands.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Facing {
    /// As before.
    Same,
    /// In a direction, rad.
    Heading(f64),
    /// At the other, with gestures.
    Other,
}

/// What a person sees of the other.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Seen {
    pose: Pose,
    /// Whether the other is coming or going through a doorway.
    is_in_doorway: bool,
}

/// Somebody whom others must not come near while both brake.
#[derive(Debug, Clone, Copy)]
struct Braking {
    pose: Pose,
    limits: Limits,
    /// Where they sit besides.
    seat_m: Option<[f64; 2]>,
}

/// A person who wanders.
#[derive(Debug, Clone)]
struct Walker {
    number: u64,
    since_s: f64,
    leaves_s: f64,
    rng: Xoshiro256PlusPlus,
    pose: Pose,
    limits: Limits,
    build: Build,
    /// What this person is about when nobody else decides.
    own: Role,
    role: Role,
    errand: Errand,
    speed_m_per_s: f64,
    /// The same for the way at hand.
    way_m_per_s: f64,
    /// Slow noise of speed and heading, of variance 1.
    noise: [f64; 2],
    blocked_s: f64,
    /// The door that the person is coming or going through.
    passage: Option<usize>,
    is_gone: bool,
    arms: [Arm; 2],
    shift: Stroke,
    /// Mean time between gestures of somebody who stands alone, s.
    gesture_s: f64,
    down: f64,
    seat: usize,
}

impl Walker {
    fn new(setting: &Setting, slot: usize, number: u64, pose: Pose, since_s: f64) -> Self {
        let identity = setting.identity(slot, number);
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
        let leaves_s = if setting.comes_and_goes { since_s + draw(&mut rng, file.stay_s) } else { f64::INFINITY };
        let arms = [Arm::draw(&mut rng), Arm::draw(&mut rng)];
        let begin_s = draw(&mut rng, [0.0, 2.0]);
        Walker {
            number,
            since_s,
            leaves_s,
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
            passage: None,
            is_gone: false,
            arms,
            shift: Stroke::resting([0.0; 2]),
            gesture_s,
            down: 0.0,
            seat: 0,
        }
    }

    /// Whether the person may be asked to do something with the other.
    fn is_free(&self) -> bool {
        self.passage.is_none() && !matches!(self.role, Role::Leave { .. })
    }

    /// What the other sees of the person.
    fn seen(&self) -> Seen {
        Seen { pose: self.pose, is_in_doorway: self.passage.is_some() }
    }

    fn is_waiting(&self) -> bool {
        matches!(self.errand, Errand::Stand { left_s, .. } if left_s == f64::INFINITY)
    }

    fn node(&self) -> Node {
        Node {
            pose: self.pose,
            arms_rad: self.arms.each_ref().map(|arm| arm.stroke.knots()),
            shift_m: self.shift.knots(),
            down: self.down,
            seat: self.seat,
        }
    }

    fn seat_m(&self, setting: &Setting) -> Option<[f64; 2]> {
        if self.down > 0.0 { setting.seats.get(self.seat).map(|seat| seat.place_m) } else { None }
    }

    /// Takes a role and begins with it; who sits gets up first.
    fn take(&mut self, role: Role, setting: &Setting) {
        self.role = role;
        if let Errand::Sit { left_s, .. } = &mut self.errand {
            *left_s = left_s.min(0.0);
        } else {
            self.errand = self.plan(setting);
        }
    }

    /// The next errand of the role.
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
            // Who stands all the time stands somewhere in the room, not in the doorway.
            Role::Stand if self.passage.is_some() => match setting.goal(&mut self.rng) {
                Some(goal) => self.walk(setting, goal, true, Then::Plan),
                None => self.pause(setting),
            },
            Role::Stand => {
                let left_s = heavy_tailed(&mut self.rng, [2.0, 60.0]);
                Errand::Stand { left_s, facing: self.facing() }
            }
            Role::Beside { .. } | Role::Behind { .. } => Errand::Accompany,
            Role::Meet { at } => self.walk(setting, at, true, Then::Await),
            Role::Leave { door } => match setting.doors.get(door) {
                Some(way_out) => self.walk(setting, way_out.at(Door::IN_M), true, Then::GoOut(door)),
                None => self.pause(setting),
            },
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

    /// Another direction to look, rad.
    fn elsewhere(&mut self) -> f64 {
        let unit: f64 = StandardNormal.sample(&mut self.rng);
        self.pose.heading_rad + 0.9 * unit
    }

    /// What somebody wants to do in this step: the first of these motions that is safe.
    fn decide(&mut self, setting: &Setting, time_s: f64, other: Option<Seen>) -> [Command; 3] {
        /// Times in which noise of speed and heading is forgotten, s.
        const FORGETS_S: [f64; 2] = [2.0, 1.5];
        for (noise, forgets_s) in self.noise.iter_mut().zip(FORGETS_S) {
            let unit: f64 = StandardNormal.sample(&mut self.rng);
            *noise += -*noise * STEP_S / forgets_s + (2.0 * STEP_S / forgets_s).sqrt() * unit;
        }
        // Two who meet in a doorway would wait for each other.
        let is_way_free = !other.is_some_and(|other| other.is_in_doorway);
        if time_s >= self.leaves_s && self.is_free() && is_way_free && !setting.doors.is_empty() {
            let door = self.rng.random_range(0..setting.doors.len());
            self.take(Role::Leave { door }, setting);
        }
        if self.blocked_s > PATIENCE_S {
            self.blocked_s = 0.0;
            if matches!(self.errand, Errand::Walk { .. }) {
                let waits = chance(&mut self.rng, 0.4);
                self.errand = match (waits, self.passage) {
                    (_, Some(_)) => self.once_more(setting),
                    (true, None) => Errand::Stand { left_s: draw(&mut self.rng, [0.5, 2.0]), facing: Facing::Same },
                    (false, None) => self.plan(setting),
                };
            }
        }
        let errand = std::mem::replace(&mut self.errand, Errand::Accompany);
        let (errand, commands) = self.pursue(setting, errand, other);
        self.errand = errand;
        commands
    }

    /// Another attempt at a doorway: who leaves goes back to before its middle first, for from beside it the wall is in the way.
    fn once_more(&mut self, setting: &Setting) -> Errand {
        match (self.role, self.passage.and_then(|door| setting.doors.get(door))) {
            (Role::Leave { door }, Some(place)) => {
                Errand::Walk { way: vec![place.at(Door::IN_M)], stops: true, then: Then::GoOut(door) }
            }
            _ => self.through(setting),
        }
    }

    /// The way through a doorway, in or out.
    fn through(&mut self, setting: &Setting) -> Errand {
        match (self.role, self.passage.and_then(|door| setting.doors.get(door))) {
            (Role::Leave { .. }, Some(door)) => {
                // Who passes this at a distance is out.
                let way = vec![door.at(Door::OUT_M - PASS_M)];
                Errand::Walk { way, stops: false, then: Then::Vanish }
            }
            (_, Some(door)) => Errand::Walk { way: vec![door.at(Door::IN_M + PASS_M)], stops: false, then: Then::Plan },
            (_, None) => self.plan(setting),
        }
    }

    fn pursue(&mut self, setting: &Setting, errand: Errand, other: Option<Seen>) -> (Errand, [Command; 3]) {
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
                (Role::Beside { side }, Some(other)) => (Errand::Accompany, self.go_beside(setting, side, &other.pose)),
                (Role::Behind { gap_m }, Some(other)) => {
                    (Errand::Accompany, self.go_behind(setting, gap_m, &other.pose))
                }
                _ => {
                    if matches!(self.role, Role::Beside { .. } | Role::Behind { .. }) {
                        self.role = self.own;
                    }
                    (self.plan(setting), going_on)
                }
            },
        }
    }

    /// What comes at the end of a way.
    fn after(&mut self, setting: &Setting, then: Then, other: Option<Seen>) -> Errand {
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
            Then::GoOut(door) => {
                self.passage = Some(door);
                self.through(setting)
            }
            Then::Vanish => {
                self.is_gone = true;
                Errand::Stand { left_s: f64::INFINITY, facing: Facing::Same }
            }
        }
    }

    fn stand(&self, facing: Facing, other: Option<Seen>) -> [Command; 3] {
        let heading_rad = match (facing, other) {
            (Facing::Heading(heading_rad), _) => Some(heading_rad),
            (Facing::Other, Some(other)) => Some(self.pose.bearing_rad(other.pose.position_m)),
            _ => None,
        };
        [Command { speed_m_per_s: 0.0, heading_rad }, Command::STOP, Command::STOP]
    }

    fn sit(&mut self, setting: &Setting, number: usize, left_s: f64, other: Option<Seen>) -> (Errand, [Command; 3]) {
        let stop = [Command::STOP; 3];
        let Some(seat) = setting.seats.get(number) else { return (self.plan(setting), stop) };
        let step = STEP_S / SIT_DOWN_S;
        if left_s > 0.0 && self.down <= 0.0 {
            // Turns round before the seat, and takes it if nobody is near.
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

    /// Fastest that anybody walks, m/s.
    fn fastest_m_per_s(setting: &Setting) -> f64 {
        1.3 * setting.file.speed_m_per_s[1]
    }

    /// A walk to a place: at the walker's own speed, slower before stops and in curves, around the other.
    fn steer(&self, setting: &Setting, goal: [f64; 2], stops: bool, other: Option<Seen>) -> [Command; 3] {
        let (distance_m, bearing_rad) = (self.pose.distance_m(goal), self.pose.bearing_rad(goal));
        let [noise_of_speed, noise_of_heading] = self.noise;
        let mut speed = self.way_m_per_s * (1.0 + 0.35 * noise_of_speed).max(0.2);
        speed = speed.min(Self::fastest_m_per_s(setting));
        if stops {
            speed = speed.min((2.0 * SOFT_M_PER_S2 * distance_m).sqrt());
        }
        let wobble_rad = if self.passage.is_some() { 0.0 } else { 0.35 * noise_of_heading * distance_m.min(1.0) };
        let mut heading_rad = bearing_rad + wobble_rad;
        if let Some(other) = other {
            let off_m = self.pose.distance_m(other.pose.position_m);
            let aside_rad = wrapped(bearing_rad - self.pose.bearing_rad(other.pose.position_m));
            if off_m < AVOID_M && off_m < distance_m + 0.3 && aside_rad.abs() < 1.2 && self.passage.is_none() {
                let side = if aside_rad >= 0.0 { 1.0 } else { -1.0 };
                heading_rad += side * (1.0 - off_m / AVOID_M);
            }
        }
        let off_rad = wrapped(heading_rad - self.pose.heading_rad);
        // The circle on which the goal lies, tangent to the heading, must be wide enough for the speed.
        let radius_m = distance_m / (2.0 * off_rad.sin().abs().max(0.05));
        let speed = (speed * turning_share(off_rad))
            .min(0.9 * (self.limits.acceleration_m_per_s2 * radius_m).sqrt())
            .min(0.9 * self.limits.turn_rad_per_s * radius_m);
        [
            Command { speed_m_per_s: speed, heading_rad: Some(heading_rad) },
            Command { speed_m_per_s: 0.5 * speed, heading_rad: Some(bearing_rad) },
            Command { speed_m_per_s: 0.0, heading_rad: Some(heading_rad) },
        ]
    }

    /// A walk at the other's side.
    fn go_beside(&self, setting: &Setting, side: f64, lead: &Pose) -> [Command; 3] {
        let beside_m = setting.file.least_distance_m + 0.25;
        let places = [lead.beside(0.0, side * beside_m), lead.beside(0.0, -side * beside_m), lead.beside(-1.0, 0.0)];
        let slot = places.into_iter().find(|at| setting.ground.is_free(*at)).unwrap_or(self.pose.position_m);
        let off_m = self.pose.distance_m(slot);
        if lead.speed_m_per_s < 0.05 && off_m < 0.35 {
            return self.stand(Facing::Other, Some(Seen { pose: *lead, is_in_doorway: false }));
        }
        let corner = self.corner_towards(setting, slot, off_m);
        let velocity = lead.velocity_m_per_s();
        let gain = 0.8 * off_m / self.pose.distance_m(corner).max(1e-3);
        let wanted = [0, 1].map(|i| velocity[i] + gain * (corner[i] - self.pose.position_m[i]));
        self.head_for(setting, wanted[1].atan2(wanted[0]), wanted[0].hypot(wanted[1]))
    }

    /// A walk after the other.
    fn go_behind(&self, setting: &Setting, gap_m: f64, lead: &Pose) -> [Command; 3] {
        let off_m = self.pose.distance_m(lead.position_m);
        if lead.speed_m_per_s < 0.05 && off_m < gap_m + 0.2 {
            return self.stand(Facing::Other, Some(Seen { pose: *lead, is_in_doorway: false }));
        }
        let corner = self.corner_towards(setting, lead.position_m, off_m);
        let speed = (lead.speed_m_per_s + 0.8 * (off_m - gap_m)).max(0.0);
        self.head_for(setting, self.pose.bearing_rad(corner), speed)
    }

    /// The next corner on the way to a place so far away.
    fn corner_towards(&self, setting: &Setting, to: [f64; 2], off_m: f64) -> [f64; 2] {
        if off_m < 1.0 {
            return to;
        }
        setting.planned.route(self.pose.position_m, to).first().copied().unwrap_or(to)
    }

    fn head_for(&self, setting: &Setting, heading_rad: f64, speed_m_per_s: f64) -> [Command; 3] {
        let off_rad = wrapped(heading_rad - self.pose.heading_rad);
        let speed = speed_m_per_s.min(Self::fastest_m_per_s(setting)) * turning_share(off_rad);
        [1.0, 0.4, 0.0].map(|part| Command { speed_m_per_s: part * speed, heading_rad: Some(heading_rad) })
    }

    /// The first of some motions that leaves time to stop, and its place among them; braking if none does.
    fn choose(&self, setting: &Setting, commands: &[Command; 3], others: &[Braking]) -> (Pose, usize) {
        for (number, command) in commands.iter().enumerate() {
            let next = self.pose.advance(command, &self.limits);
            if self.stops_in_time(setting, next, others) {
                return (next, number);
            }
        }
        (self.pose.advance(&Command::STOP, &self.limits), commands.len())
    }

    /// Whether somebody who brakes from a pose on stays on the ground and off others who brake as well.
    fn stops_in_time(&self, setting: &Setting, from: Pose, others: &[Braking]) -> bool {
        let least_m = setting.file.least_distance_m;
        let (mut pose, mut others) = (from, others.to_vec());
        for _ in 0..BRAKE_STEPS {
            if !setting.lets(self.passage, pose.position_m) {
                return false;
            }
            let is_near = |at: [f64; 2]| pose.distance_m(at) < least_m;
            if others.iter().any(|o| is_near(o.pose.position_m) || o.seat_m.is_some_and(is_near)) {
                return false;
            }
            if pose.speed_m_per_s <= 0.0 && others.iter().all(|o| o.pose.speed_m_per_s <= 0.0) {
                return true;
            }
            pose = pose.advance(&Command::STOP, &self.limits);
            others.iter_mut().for_each(|o| o.pose = o.pose.advance(&Command::STOP, &o.limits));
        }
        false
    }

    /// Goes on to the end of the step.
    fn apply(&mut self, setting: &Setting, pose: Pose, refused: usize) {
        self.pose = pose;
        let change_s = if refused == 0 { -STEP_S } else { STEP_S };
        self.blocked_s = (self.blocked_s + change_s).max(0.0);
        let leaves = matches!(self.role, Role::Leave { .. });
        if self.passage.is_some() && !leaves && self.is_inside(setting) {
            self.passage = None;
        }
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

    /// Whether the doorway is not needed any more.
    fn is_inside(&self, setting: &Setting) -> bool {
        let mut pose = self.pose;
        for _ in 0..BRAKE_STEPS {
            if !setting.ground.is_free(pose.position_m) {
                return false;
            }
            if pose.speed_m_per_s <= 0.0 {
                return true;
            }
            pose = pose.advance(&Command::STOP, &self.limits);
        }
        false
    }
}

/// Share of the speed that is left while the heading is off by an angle.
fn turning_share(off_rad: f64) -> f64 {
    (0.5 + 0.5 * off_rad.cos()).powi(2)
}

/// Whether a seat can be taken: the other is far from it, the farther the faster.
fn is_clear(seat_m: [f64; 2], other: Option<Seen>) -> bool {
    other.is_none_or(|o| o.pose.distance_m(seat_m) > 1.3 + 1.5 * o.pose.speed_m_per_s)
}

/// A visit that has ended.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Visit {
    /// Slot.
    pub slot: usize,
    /// Number of the visit in its slot.
    pub number: u64,
    /// Beginning and end, s.
    pub span_s: [f64; 2],
}

/// One of the people who can be there at a time.
#[derive(Debug, Clone)]
struct Slot {
    walker: Option<Walker>,
    /// Visits that have begun.
    visits: u64,
    /// When the next one begins, s.
    returns_s: f64,
    last: Node,
}

/// Everybody at the end of a step.
#[derive(Debug, Clone)]
pub(super) struct State {
    steps: u64,
    slots: Vec<Slot>,
    mode: Option<Mode>,
    mode_left_s: f64,
    rng: Xoshiro256PlusPlus,
}

impl State {
    /// The first state of a group.
    pub fn new(setting: &Setting, slots: usize) -> Self {
        let mut rng = generator(setting.seed, Purpose::Wander, [setting.first_identity, u64::MAX]);
        let mut taken: Vec<[f64; 2]> = Vec::new();
        let [stay_s, absence_s] = [setting.file.stay_s, setting.file.absence_s].map(|[low, high]| 0.5 * (low + high));
        let mut all = Vec::with_capacity(slots);
        for slot in 0..slots {
            let place = setting.start(&mut rng, &taken);
            let pose = Pose::standing(place, draw(&mut rng, [-PI, PI]));
            let walker = Walker::new(setting, slot, 0, pose, FIRST_S);
            let last = walker.node();
            // As many are there as at any other time.
            let is_there = !setting.comes_and_goes || chance(&mut rng, stay_s / (stay_s + absence_s));
            let returns_s = FIRST_S + draw(&mut rng, setting.file.absence_s);
            if is_there {
                taken.push(place);
                all.push(Slot { walker: Some(walker), visits: 1, returns_s, last });
            } else {
                all.push(Slot { walker: None, visits: 0, returns_s, last });
            }
        }
        State { steps: 0, slots: all, mode: None, mode_left_s: 0.0, rng }
    }

    /// Time reached, s.
    pub fn time_s(&self) -> f64 {
        FIRST_S + self.steps as f64 * STEP_S
    }

    /// Everybody's motion at that time, in the order of the slots; of those who are not there, where they were last.
    pub fn nodes(&self) -> impl Iterator<Item = Node> {
        self.slots.iter().map(|slot| slot.last)
    }

    /// Whether somebody who came up to a time is there still.
    pub fn is_anybody_there_since(&self, until_s: f64) -> bool {
        self.slots.iter().filter_map(|slot| slot.walker.as_ref()).any(|walker| walker.since_s <= until_s)
    }

    /// Goes on by a step; adds visits that end with it.
    pub fn step(&mut self, setting: &Setting, visits: &mut Vec<Visit>) {
        let time_s = self.time_s();
        self.set_mode(setting);
        let seen: Vec<Option<Seen>> = self.slots.iter().map(|slot| slot.walker.as_ref().map(Walker::seen)).collect();
        let mut wanted = Vec::with_capacity(seen.len());
        for (i, slot) in self.slots.iter_mut().enumerate() {
            let other = seen.iter().enumerate().find_map(|(j, seen)| if j == i { None } else { *seen });
            let commands = slot.walker.as_mut().map(|walker| walker.decide(setting, time_s, other));
            wanted.push(commands.unwrap_or([Command::STOP; 3]));
        }
        // One after the other: those whose step is not yet chosen are taken to brake, which they can.
        let mut chosen: Vec<Option<(Pose, usize)>> = vec![None; wanted.len()];
        for (i, commands) in wanted.iter().enumerate() {
            let Some(walker) = &self.slots[i].walker else { continue };
            let others: Vec<Braking> = self
                .slots
                .iter()
                .enumerate()
                .filter(|(j, _)| *j != i)
                .filter_map(|(j, slot)| {
                    let other = slot.walker.as_ref()?;
                    let brakes = || other.pose.advance(&Command::STOP, &other.limits);
                    let pose = chosen[j].map_or_else(brakes, |(pose, _)| pose);
                    Some(Braking { pose, limits: other.limits, seat_m: other.seat_m(setting) })
                })
                .collect();
            chosen[i] = Some(walker.choose(setting, commands, &others));
        }
        self.steps += 1;
        let time_s = self.time_s();
        for (number, (slot, chosen)) in self.slots.iter_mut().zip(chosen).enumerate() {
            let (Some(walker), Some((pose, refused))) = (&mut slot.walker, chosen) else { continue };
            walker.apply(setting, pose, refused);
            slot.last = walker.node();
            if walker.is_gone {
                visits.push(Visit { slot: number, number: walker.number, span_s: [walker.since_s, time_s] });
                slot.walker = None;
                slot.returns_s = time_s + draw(&mut self.rng, setting.file.absence_s).max(1.0);
            }
        }
        for number in 0..self.slots.len() {
            self.welcome(setting, number, time_s);
        }
    }

    /// Lets the next visitor of a slot begin, outside a door, if it is time and nobody is near.
    fn welcome(&mut self, setting: &Setting, number: usize, time_s: f64) {
        if self.slots[number].walker.is_some() || time_s < self.slots[number].returns_s || setting.doors.is_empty() {
            return;
        }
        let at = self.rng.random_range(0..setting.doors.len());
        let door = &setting.doors[at];
        let place = door.at(Door::OUT_M);
        let mut there = self.slots.iter().filter_map(|slot| slot.walker.as_ref());
        let is_near = |walker: &Walker| walker.pose.distance_m(place) < CLEAR_DOOR_M;
        if there.any(|walker| is_near(walker) || matches!(walker.role, Role::Leave { door } if door == at)) {
            self.slots[number].returns_s = time_s + 1.0;
            return;
        }
        let slot = &mut self.slots[number];
        let pose = Pose::standing(place, door.inward[1].atan2(door.inward[0]));
        let mut walker = Walker::new(setting, number, slot.visits, pose, time_s);
        walker.passage = Some(at);
        walker.errand = walker.through(setting);
        slot.visits += 1;
        slot.last = walker.node();
        slot.walker = Some(walker);
    }

    /// Draws what two people do together, when that is due; alone everybody does what is their own.
    fn set_mode(&mut self, setting: &Setting) {
        let State { slots, mode, mode_left_s, rng, .. } = self;
        let (mut first, mut second) = (None, None);
        if let [a, b] = slots.as_mut_slice() {
            (first, second) = (a.walker.as_mut(), b.walker.as_mut());
        }
        let pair = match (first, second) {
            (Some(a), Some(b)) if a.is_free() && b.is_free() => Some((a, b)),
            _ => None,
        };
        let Some((a, b)) = pair else {
            if mode.take().is_some() {
                let all = slots.iter_mut().filter_map(|slot| slot.walker.as_mut());
                for walker in all.filter(|walker| walker.is_free()) {
                    walker.take(walker.own, setting);
                }
            }
            return;
        };
        *mode_left_s -= STEP_S;
        if *mode == Some(Mode::Meet) && a.is_waiting() && b.is_waiting() {
            // They have met: they talk, and then part.
            let talk_s = heavy_tailed(rng, [3.0, 40.0]);
            for walker in [a, b] {
                walker.role = Role::Wander;
                walker.errand = Errand::Stand { left_s: talk_s + draw(rng, [0.1, 0.8]), facing: Facing::Other };
            }
            *mode = Some(Mode::Independent);
            *mode_left_s = talk_s + draw(rng, setting.file.mode_s);
            return;
        }
        if mode.is_some() && *mode_left_s > 0.0 {
            return;
        }
        let drawn = draw_mode(setting, rng);
        *mode = Some(drawn);
        *mode_left_s = draw(rng, setting.file.mode_s);
        let (lead, other) = if chance(rng, 0.5) { (a, b) } else { (b, a) };
        let side = if chance(rng, 0.5) { 1.0 } else { -1.0 };
        let gap_m = setting.file.least_distance_m + draw(rng, [0.3, 1.2]);
        let ends = if drawn == Mode::Pass { setting.ends(rng) } else { None };
        let spots = if drawn == Mode::Meet { meeting(setting, rng, &lead.pose) } else { None };
        let pace = |at: usize| ends.map(|ends| Role::Pace { ends, at });
        let meet = |which: usize| spots.map(|spots| Role::Meet { at: spots[which] });
        let (of_lead, of_other) = match drawn {
            Mode::Independent => (None, None),
            Mode::Together => (Some(Role::Wander), Some(Role::Beside { side })),
            Mode::Follow => (Some(Role::Wander), Some(Role::Behind { gap_m })),
            Mode::Meet => (meet(0), meet(1)),
            Mode::Pass => (pace(0), pace(1)),
            Mode::StandAndWalk => (Some(Role::Stand), Some(Role::Wander)),
        };
        if drawn == Mode::Meet && spots.is_none() {
            *mode = Some(Mode::Independent);
        }
        lead.take(of_lead.unwrap_or(lead.own), setting);
        other.take(of_other.unwrap_or(other.own), setting);
    }
}

fn draw_mode(setting: &Setting, rng: &mut Xoshiro256PlusPlus) -> Mode {
    let weights = &setting.file.modes;
    let all = [
        (Mode::Independent, weights.independent),
        (Mode::Together, weights.together),
        (Mode::Follow, weights.follow),
        (Mode::Meet, weights.meet),
        (Mode::Pass, weights.pass),
        (Mode::StandAndWalk, weights.stand_and_walk),
    ];
    let mut left = rng.random::<f64>() * all.iter().map(|(_, weight)| weight).sum::<f64>();
    for (mode, weight) in all {
        left -= weight;
        if left < 0.0 {
            return mode;
        }
    }
    Mode::Independent
}

/// Where two people meet: free places at talking distance, the first of them the nearer one to a person.
fn meeting(setting: &Setting, rng: &mut Xoshiro256PlusPlus, person: &Pose) -> Option<[[f64; 2]; 2]> {
    for _ in 0..PLACES {
        let middle = setting.goal(rng)?;
        // Who stops may do so a little beyond the place.
        let apart_m = setting.file.least_distance_m + draw(rng, [0.4, 1.0]);
        let (sine, cosine) = draw(rng, [-PI, PI]).sin_cos();
        let spots = [0.5, -0.5].map(|part| [middle[0] + part * apart_m * cosine, middle[1] + part * apart_m * sine]);
        if spots.iter().all(|at| setting.planned.is_free(*at)) {
            let [near, far] = spots;
            let is_sorted = person.distance_m(near) <= person.distance_m(far);
            return Some(if is_sorted { [near, far] } else { [far, near] });
        }
    }
    None
}
