//! Plan of a group, step by step: the activity of two people together, and the order in which people take their steps.
//!
//! A person takes a step only if it leaves time to stop before furniture, walls, the radar and the other person.
//! Braking is simulated by the dynamics of the step itself. If no preferred step passes this test, the person brakes;
//! the previous step made sure that this is possible. So a person never leaves the ground or comes closer to another
//! person than the scene allows ([`choose`]).

use std::f64::consts::PI;

use rand::Rng;
use rand_xoshiro::Xoshiro256PlusPlus;

use super::braking::{Braking, choose};
use super::dynamics::{Command, Pose, STEP_S};
use super::errand::{Errand, Facing, Role, Walker};
use super::node::Node;
use super::setting::Setting;
use super::{chance, draw, heavy_tailed};
use crate::random::{Purpose, generator};

/// Activity of two people together for some time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Mode {
    /// Each has a role of its own.
    Independent,
    /// They walk side by side.
    Together,
    /// One follows the other.
    Follow,
    /// They meet, talk and part.
    Meet,
    /// They pace between the same two places.
    Pass,
    /// One stands while the other walks.
    StandAndWalk,
}

/// State of all people at the end of a step.
#[derive(Debug, Clone)]
pub(super) struct State {
    walkers: Vec<Walker>,
    /// Activity of two people; `None` before the first one is drawn.
    mode: Option<Mode>,
    mode_remaining_s: f64,
    rng: Xoshiro256PlusPlus,
}

impl State {
    /// Draws the first state of a group.
    pub fn new(setting: &Setting, slots: usize) -> Self {
        let mut rng = generator(setting.seed, Purpose::Wander, [setting.first_identity, u64::MAX]);
        let mut positions: Vec<[f64; 2]> = Vec::new();
        let mut walkers = Vec::with_capacity(slots);
        for slot in 0..slots {
            let position = setting.draw_start(&mut rng, &positions);
            let pose = Pose::standing(position, draw(&mut rng, [-PI, PI]));
            // Not used. Without this draw, all later draws would change, and so would the motion of every seed.
            let _: f64 = rng.random();
            positions.push(position);
            walkers.push(Walker::new(setting, slot, pose));
        }
        State { walkers, mode: None, mode_remaining_s: 0.0, rng }
    }

    /// Returns the motion of all people, in the order of the slots.
    pub fn nodes(&self) -> impl Iterator<Item = Node> {
        self.walkers.iter().map(Walker::node)
    }

    /// Advances by one step.
    pub fn step(&mut self, setting: &Setting) {
        self.update_mode(setting);
        let poses: Vec<Pose> = self.walkers.iter().map(|walker| walker.pose).collect();
        let mut preferred = Vec::with_capacity(poses.len());
        for (index, walker) in self.walkers.iter_mut().enumerate() {
            let other =
                poses.iter().enumerate().find_map(|(other_index, pose)| (other_index != index).then_some(*pose));
            preferred.push(walker.preferred_commands(setting, other));
        }
        // People choose one after another. A person whose step is not chosen yet is assumed to brake, which is always
        // possible.
        let mut chosen: Vec<(Pose, usize)> = Vec::with_capacity(preferred.len());
        for (index, (walker, commands)) in self.walkers.iter().zip(&preferred).enumerate() {
            let others: Vec<Braking> = self
                .walkers
                .iter()
                .enumerate()
                .filter(|(other_index, _)| *other_index != index)
                .map(|(other_index, other)| {
                    let braking_pose = || other.pose.advance(&Command::STOP, &other.limits);
                    let pose = chosen.get(other_index).map_or_else(braking_pose, |(pose, _)| *pose);
                    Braking { pose, limits: other.limits, seat_m: other.seat_m(setting) }
                })
                .collect();
            chosen.push(choose(setting, &walker.pose, &walker.limits, commands, &others));
        }
        for (walker, (pose, rejected)) in self.walkers.iter_mut().zip(chosen) {
            walker.finish_step(setting, pose, rejected);
        }
    }

    /// Draws the activity of two people when the last one ends. A single person, or more than two people, keep their
    /// own roles.
    fn update_mode(&mut self, setting: &Setting) {
        let State { walkers, mode, mode_remaining_s, rng } = self;
        let [a, b] = walkers.as_mut_slice() else { return };
        *mode_remaining_s -= STEP_S;
        if *mode == Some(Mode::Meet) && a.is_waiting() && b.is_waiting() {
            // The two people have met: they talk, and then part.
            let talk_s = heavy_tailed(rng, [3.0, 40.0]);
            for walker in [a, b] {
                walker.role = Role::Wander;
                walker.errand = Errand::Stand { remaining_s: talk_s + draw(rng, [0.1, 0.8]), facing: Facing::Other };
            }
            *mode = Some(Mode::Independent);
            *mode_remaining_s = talk_s + draw(rng, setting.file.mode_s);
            return;
        }
        if mode.is_some() && *mode_remaining_s > 0.0 {
            return;
        }
        let drawn = draw_mode(setting, rng);
        *mode = Some(drawn);
        *mode_remaining_s = draw(rng, setting.file.mode_s);
        let (lead, other) = if chance(rng, 0.5) { (a, b) } else { (b, a) };
        let side = if chance(rng, 0.5) { 1.0 } else { -1.0 };
        let gap_m = setting.file.least_distance_m + draw(rng, [0.3, 1.2]);
        let ends = if drawn == Mode::Pass { setting.draw_pacing_ends(rng) } else { None };
        let meeting_positions = if drawn == Mode::Meet { setting.draw_meeting(rng, &lead.pose) } else { None };
        let pacing = |next: usize| ends.map(|ends| Role::Pace { ends, next });
        let meeting = |index: usize| meeting_positions.map(|positions| Role::Meet { position_m: positions[index] });
        let (lead_role, other_role) = match drawn {
            Mode::Independent => (None, None),
            Mode::Together => (Some(Role::Wander), Some(Role::Beside { side })),
            Mode::Follow => (Some(Role::Wander), Some(Role::Behind { gap_m })),
            Mode::Meet => (meeting(0), meeting(1)),
            Mode::Pass => (pacing(0), pacing(1)),
            Mode::StandAndWalk => (Some(Role::Stand), Some(Role::Wander)),
        };
        if drawn == Mode::Meet && meeting_positions.is_none() {
            *mode = Some(Mode::Independent);
        }
        lead.assign_role(lead_role.unwrap_or(lead.own_role), setting);
        other.assign_role(other_role.unwrap_or(other.own_role), setting);
    }
}

/// Draws a mode with the probabilities that the scene states.
fn draw_mode(setting: &Setting, rng: &mut Xoshiro256PlusPlus) -> Mode {
    let weights = &setting.file.modes;
    let modes = [
        (Mode::Independent, weights.independent),
        (Mode::Together, weights.together),
        (Mode::Follow, weights.follow),
        (Mode::Meet, weights.meet),
        (Mode::Pass, weights.pass),
        (Mode::StandAndWalk, weights.stand_and_walk),
    ];
    let mut remaining = rng.random::<f64>() * modes.iter().map(|(_, weight)| weight).sum::<f64>();
    for (mode, weight) in modes {
        remaining -= weight;
        if remaining < 0.0 {
            return mode;
        }
    }
    Mode::Independent
}
