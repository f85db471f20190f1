//! People who wander about a room as people do: on smooth curves at a speed that varies, with pauses in which they sway, shift
//! their weight and gesture, alone or with each other.
//!
//! [`plan`] moves everybody together in steps of 50 ms, [`walker`] holds the dynamics, [`table`] keeps the steps and gives what is
//! between them, [`small`] adds what a body does besides. Everything is a function of seed and time.

mod plan;
mod small;
mod table;
#[cfg(test)]
mod tests;
mod walker;

use std::sync::{Arc, Mutex, PoisonError};

use rand::Rng;
use rand_xoshiro::Xoshiro256PlusPlus;

use super::low::Crouch;
use super::motion::{Moment, Motion, Person, Small};
use super::program::{at_door, blocks, draw, dressed, inward};
use super::route::{Block, Ground};
use super::track::smooth_step;
use crate::random::{Purpose, generator};
use crate::scene::file::{SceneFile, SeatFile, WanderFile};
use plan::{Door, Seat, Setting, View};
use small::Sway;
use table::{Group, Place};
use walker::{Limits, march, vigour};

/// Hips keep so far from furniture and walls where the scene says nothing else, m.
const KEEP_OFF_M: f64 = 0.35;
/// Ways are laid so much farther off, m: people do not walk them exactly.
const PLANNED_M: f64 = 0.15;
/// Hips go back so far to sit down where the seat says nothing else, m.
const SEAT_BACK_M: f64 = 0.38;
/// Depth of the ground beyond the far wall on which somebody walks about, and its distance from the wall, m.
const BEYOND_M: [f64; 2] = [2.4, 0.6];
/// Identity of somebody who walks about there.
const BEYOND: u64 = 1 << 20;

/// Whether something of a probability happens.
fn chance(rng: &mut Xoshiro256PlusPlus, probability: f64) -> bool {
    rng.random::<f64>() < probability
}

/// A time between two bounds, s: many short ones and a few long ones (a truncated Pareto distribution).
fn heavy_tailed(rng: &mut Xoshiro256PlusPlus, [least_s, longest_s]: [f64; 2]) -> f64 {
    /// Exponent of the tail.
    const TAIL: f64 = 0.7;
    let part = rng.random::<f64>() * (1.0 - (least_s / longest_s).powf(TAIL));
    (least_s * (1.0 - part).powf(-1.0 / TAIL)).min(longest_s)
}

/// The person of an identity in a setting.
fn person(setting: &Setting, identity: [u64; 2]) -> Person {
    let mut rng = generator(setting.seed, Purpose::Wander, [identity[0] | 1 << 40, identity[1]]);
    let person = Person::draw(setting.seed, identity, draw(&mut rng, setting.file.height_m));
    dressed(person, &setting.people, setting.seed)
}

/// Everybody who wanders in a scene.
#[derive(Debug)]
pub(super) struct Wander {
    group: Arc<Group>,
    slots: usize,
    /// People in the room so far, with their slots, in the order in which they leave.
    people: Mutex<Vec<(usize, Arc<Motion>)>>,
    /// Somebody beyond the far wall.
    passer_by: Option<Arc<Motion>>,
    comes_and_goes: bool,
}

impl Wander {
    /// The people of a scene; `people` says how many instead of the seed.
    pub fn new(scene: &SceneFile, file: &WanderFile, seed: u64, people: Option<usize>) -> Self {
        let mut rng = generator(seed, Purpose::Wander, [u64::MAX, 0]);
        let (kind, count) = (rng.random::<f64>(), rng.random_range(0..=file.max_people));
        let mut setting = room(scene, file, seed);
        // Without a door that is clear of furniture nobody can come in.
        setting.comes_and_goes = kind < file.come_and_go_probability && !setting.doors.is_empty();
        let comes_and_goes = setting.comes_and_goes;
        let slots = people.unwrap_or(if comes_and_goes { file.max_people } else { count });
        let group = Arc::new(Group::new(setting, slots));
        let all = if comes_and_goes { 0 } else { slots };
        let everybody = (0..all).map(|slot| (slot, Arc::new(motion(&group, slot, 0, ALWAYS_S, [0.0; 2])))).collect();
        Wander {
            group,
            slots,
            people: Mutex::new(everybody),
            passer_by: passer_by(scene, file, seed, &mut rng).map(Arc::new),
            comes_and_goes,
        }
    }

    /// Everybody who is there at some time of an interval, with a slot number.
    pub fn between(&self, start_s: f64, end_s: f64) -> Vec<(usize, Arc<Motion>)> {
        let mut people = self.people.lock().unwrap_or_else(PoisonError::into_inner);
        if self.comes_and_goes {
            for visit in self.group.visits(end_s, people.len()) {
                let come = motion(&self.group, visit.slot, visit.number, visit.span_s, [0.0; 2]);
                people.push((visit.slot, Arc::new(come)));
            }
        }
        let is_there = |motion: &Motion| motion.start_s <= end_s && motion.end_s >= start_s;
        let mut all: Vec<_> = people.iter().filter(|(_, motion)| is_there(motion)).cloned().collect();
        all.sort_by(|a, b| a.0.cmp(&b.0).then(a.1.start_s.total_cmp(&b.1.start_s)));
        all.extend(self.passer_by.iter().map(|motion| (self.slots, Arc::clone(motion))));
        all
    }
}

/// The span of somebody who is always there, s.
const ALWAYS_S: [f64; 2] = [f64::NEG_INFINITY, f64::INFINITY];

/// Where people wander in a scene's room.
fn room(scene: &SceneFile, file: &WanderFile, seed: u64) -> Setting {
    let size_m = [scene.room.size_m[0], scene.room.size_m[1]];
    let radar_m = [scene.radar.position_m[0], scene.radar.position_m[1]];
    let keep_off_m = scene.people.keep_off_m.unwrap_or(KEEP_OFF_M);
    let mut blocks: Vec<Block> = blocks(scene);
    let nearest_m = file.range_m[0];
    if nearest_m > 0.0 {
        // Hips keep off a block by more than it takes to keep off the radar.
        let half_m = (nearest_m - keep_off_m).max(0.0);
        blocks.push([radar_m.map(|x| x - half_m), radar_m.map(|x| x + half_m)]);
    }
    let ground = Ground::new(size_m, blocks.clone(), keep_off_m);
    let planned = Ground::new(size_m, blocks, keep_off_m + PLANNED_M);
    let doors = scene.door.iter().map(|door| Door {
        middle_m: at_door(size_m, door, 0.0, 0.0),
        inward: inward(size_m, door),
        width_m: door.width_m,
    });
    // Who comes in goes on straight for a while.
    let is_clear = |door: &Door| [0.0, 0.15, 0.3, 0.5].iter().all(|more| ground.is_free(door.at(Door::IN_M + more)));
    let seats = scene.seat.iter().map(seat).filter(|seat| ground.is_free(seat.before_m)).collect();
    Setting {
        file: file.clone(),
        people: scene.people.clone(),
        seed,
        first_identity: 0,
        size_m,
        doors: doors.filter(is_clear).collect(),
        seats,
        ground,
        planned,
        view: Some(View { radar_m, azimuth_rad: scene.radar.azimuth_deg.to_radians() }),
        comes_and_goes: false,
    }
}

fn seat(file: &SeatFile) -> Seat {
    let heading_rad = file.heading_deg.to_radians();
    let back_m = if file.back_m > 0.0 { file.back_m } else { SEAT_BACK_M };
    let [x, y] = file.position_m;
    Seat {
        place_m: file.position_m,
        before_m: [x + back_m * heading_rad.cos(), y + back_m * heading_rad.sin()],
        heading_rad,
        back_m,
        height_m: file.height_m,
    }
}

/// Somebody beyond the far wall, where there is one.
fn passer_by(scene: &SceneFile, file: &WanderFile, seed: u64, rng: &mut Xoshiro256PlusPlus) -> Option<Motion> {
    if !chance(rng, file.passer_by_probability) {
        return None;
    }
    let level = 10f64.powf(0.05 * draw(rng, file.passer_by_level_db));
    let [depth_m, off_m] = BEYOND_M;
    let size_m = [depth_m, scene.room.size_m[1]];
    let ground = Ground::new(size_m, Vec::new(), 0.0);
    let setting = Setting {
        file: file.clone(),
        people: scene.people.clone(),
        seed,
        first_identity: BEYOND,
        size_m,
        planned: Ground::new(size_m, Vec::new(), PLANNED_M),
        ground,
        view: None,
        doors: Vec::new(),
        seats: Vec::new(),
        comes_and_goes: false,
    };
    let group = Arc::new(Group::new(setting, 1));
    let mut motion = motion(&group, 0, 0, ALWAYS_S, [scene.room.size_m[0] + off_m, 0.0]);
    motion.person.cloth.iter_mut().for_each(|cloth| *cloth *= level);
    Some(motion)
}

/// Motion of a visitor of a slot, all of it moved by an offset.
fn motion(group: &Arc<Group>, slot: usize, number: u64, span_s: [f64; 2], offset_m: [f64; 2]) -> Motion {
    let setting = group.setting();
    let identity = setting.identity(slot, number);
    let person = person(setting, identity);
    let mut rng = generator(setting.seed, Purpose::Wander, [identity[0] | 1 << 41, identity[1]]);
    let [low, high] = setting.file.sway_m.map(f64::ln);
    let excursion_m = draw(&mut rng, [low, high]).exp();
    let sway = Sway::draw(&mut rng, excursion_m);
    let build = &person.build;
    let crouches = setting.seats.iter().map(|seat| Crouch::sit(build, seat.height_m, seat.back_m)).collect();
    let limits = setting.limits(build, person.style.stride);
    let wanderer = Wanderer { group: Arc::clone(group), slot, span_s, offset_m, sway, limits, crouches };
    Motion::wandering(person, wanderer, span_s)
}

/// One person's part in a group's motion.
#[derive(Debug, Clone)]
pub(super) struct Wanderer {
    group: Arc<Group>,
    slot: usize,
    span_s: [f64; 2],
    offset_m: [f64; 2],
    sway: Sway,
    limits: Limits,
    /// Ways down to the seats.
    crouches: Vec<Crouch>,
}

impl PartialEq for Wanderer {
    fn eq(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.group, &other.group) && self.slot == other.slot && self.span_s == other.span_s
    }
}

impl Wanderer {
    /// Motion at a time; before and after the visit as at its ends.
    pub fn moment(&self, time_s: f64) -> Moment {
        let [start_s, end_s] = self.span_s;
        let Some((a, b, part)) = self.group.around(self.slot, time_s.clamp(start_s, end_s)) else {
            return Moment::default();
        };
        let place = Place::between(&a.pose, &b.pose, part, &self.limits);
        let low = smooth_step(2.0 * (a.down + part * (b.down - a.down)) - 1.0);
        let seat = if a.down > 0.0 { a.seat } else { b.seat };
        let swayed = self.sway.at(time_s);
        // Who sits rests against the seat.
        let upright = 1.0 - 0.7 * low;
        let [forward, left] = [0, 1].map(|i| a.shift_m[i].between(b.shift_m[i], part) * (1.0 - low));
        let arm = |side: usize, joint: usize| a.arms_rad[side][joint].between(b.arms_rad[side][joint], part);
        Moment {
            position_m: [0, 1].map(|i| place.position_m[i] + self.offset_m[i]),
            heading_rad: place.heading_rad,
            phase: place.phase,
            vigour: vigour(place.speed_m_per_s) * (1.0 - low),
            march: march(place.speed_m_per_s, place.turn_rad_per_s) * (1.0 - low),
            low,
            crouch: self.crouches.get(seat).copied(),
            small: Some(Small {
                forward_m: forward + (1.0 - low) * swayed.forward_m,
                left_m: left + upright * swayed.left_m,
                lean_rad: upright * swayed.lean_rad,
                twist_rad: upright * swayed.twist_rad,
                shoulder_rad: [0, 1].map(|side| arm(side, 0) + swayed.shoulder_rad[side]),
                elbow_rad: [0, 1].map(|side| arm(side, 1) + swayed.elbow_rad[side]),
            }),
            ..Moment::default()
        }
    }
}
