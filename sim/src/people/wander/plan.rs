//! Plan of a group, step by step: the activity of two people together, and the order in which people take their steps.
//!
//! A person takes a step only if it leaves time to stop before furniture, walls, the radar and the other person.
//! Braking is simulated by the dynamics of the step itself. If no wanted step passes this test, the person brakes; the
//! previous step made sure that this is possible. So a person never leaves the ground or comes closer to another person
//! than the scene allows ([`choose`]).

use std::f64::consts::PI;

use rand::Rng;
use rand_xoshiro::Xoshiro256PlusPlus;

use super::braking::{Braking, choose};
use super::errand::{Errand, Facing, Role, Walker};
use super::node::Node;
use super::setting::Setting;
use super::walker::{Command, Pose, STEP_S};
use super::{chance, draw, heavy_tailed};
use crate::random::{Purpose, generator};

/// Activity of two people together for some time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Mode {
    Independent,
    Together,
    Follow,
    Meet,
    Pass,
    StandAndWalk,
}

/// State of all people at the end of a step.
#[derive(Debug, Clone)]
pub(super) struct State {
    walkers: Vec<Walker>,
    mode: Option<Mode>,
    mode_left_s: f64,
    rng: Xoshiro256PlusPlus,
}

impl State {
    /// Draws the first state of a group.
    pub fn new(setting: &Setting, slots: usize) -> Self {
        let mut rng = generator(setting.seed, Purpose::Wander, [setting.first_identity, u64::MAX]);
        let mut taken: Vec<[f64; 2]> = Vec::new();
        let mut walkers = Vec::with_capacity(slots);
        for slot in 0..slots {
            let place = setting.start(&mut rng, &taken);
            let pose = Pose::standing(place, draw(&mut rng, [-PI, PI]));
            // Not used. Without this draw, all later draws would change, and so would the motion of every seed.
            let _: f64 = rng.random();
            taken.push(place);
            walkers.push(Walker::new(setting, slot, pose));
        }
        State { walkers, mode: None, mode_left_s: 0.0, rng }
    }

    /// Returns the motion of all people, in the order of the slots.
    pub fn nodes(&self) -> impl Iterator<Item = Node> {
        self.walkers.iter().map(Walker::node)
    }

    /// Advances by one step.
    pub fn step(&mut self, setting: &Setting) {
        self.set_mode(setting);
        let seen: Vec<Pose> = self.walkers.iter().map(|walker| walker.pose).collect();
        let mut wanted = Vec::with_capacity(seen.len());
        for (i, walker) in self.walkers.iter_mut().enumerate() {
            let other = seen.iter().enumerate().find_map(|(j, pose)| (j != i).then_some(*pose));
            wanted.push(walker.decide(setting, other));
        }
        // People choose one after another. A person whose step is not chosen yet is assumed to brake, which is always
        // possible.
        let mut chosen: Vec<(Pose, usize)> = Vec::with_capacity(wanted.len());
        for (i, (walker, commands)) in self.walkers.iter().zip(&wanted).enumerate() {
            let others: Vec<Braking> = self
                .walkers
                .iter()
                .enumerate()
                .filter(|(j, _)| *j != i)
                .map(|(j, other)| {
                    let brakes = || other.pose.advance(&Command::STOP, &other.limits);
                    let pose = chosen.get(j).map_or_else(brakes, |(pose, _)| *pose);
                    Braking { pose, limits: other.limits, seat_m: other.seat_m(setting) }
                })
                .collect();
            chosen.push(choose(setting, &walker.pose, &walker.limits, commands, &others));
        }
        for (walker, (pose, refused)) in self.walkers.iter_mut().zip(chosen) {
            walker.apply(setting, pose, refused);
        }
    }

    /// Draws the activity of two people when the last one ends. A single person, or more than two people, keep their
    /// own roles.
    fn set_mode(&mut self, setting: &Setting) {
        let State { walkers, mode, mode_left_s, rng } = self;
        let [a, b] = walkers.as_mut_slice() else { return };
        *mode_left_s -= STEP_S;
        if *mode == Some(Mode::Meet) && a.is_waiting() && b.is_waiting() {
            // The two people have met: they talk, and then part.
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
        let spots = if drawn == Mode::Meet { setting.meeting(rng, &lead.pose) } else { None };
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
