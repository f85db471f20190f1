//! People that wander about a room. They follow smooth curves at a varying speed, with pauses for sway, weight shifts
//! and gestures, alone or together.
//!
//! [`plan`] moves all people together in steps of 50 ms. [`errand`] is one person, which goes to the places of
//! [`setting`] by the motions of [`steer`]. [`braking`] refuses motions that do not leave time to stop. [`walker`]
//! holds the dynamics, [`table`] keeps the steps, [`node`] gives the motion between them, and [`small`] adds small
//! motions of the body. Everything is a function of seed and time.

mod braking;
mod errand;
mod node;
mod plan;
mod setting;
mod small;
mod steer;
mod table;
#[cfg(test)]
mod tests;
mod walker;

use std::sync::Arc;

use rand::Rng;
use rand_xoshiro::Xoshiro256PlusPlus;

use crate::math::smooth_step;
use crate::people::moment::{Moment, Small};
use crate::people::person::{Person, with_gait};
use crate::people::postures::Crouch;
use crate::people::route::{Block, Ground};
use crate::random::{Purpose, draw, generator};
use crate::scene_file::{SceneFile, SeatFile, WanderFile};
use setting::{Seat, Setting, View};
use small::Sway;
use table::Group;
use walker::{Limits, march, vigour};

/// Distance that hips keep from furniture and walls if the scene states none, m.
const KEEP_OFF_M: f64 = 0.35;
/// Additional distance of planned routes, m, since people do not follow routes exactly.
const PLANNED_M: f64 = 0.15;
/// Backward motion of the hips for sitting down if the seat states none, m.
const SEAT_BACK_M: f64 = 0.38;
/// Depth of the ground beyond the far wall on which a passer-by walks, and its distance from the wall, m.
const BEYOND_M: [f64; 2] = [2.4, 0.6];
/// Identity of that passer-by.
const BEYOND: u64 = 1 << 20;

/// Whether an event of a given probability happens.
fn chance(rng: &mut Xoshiro256PlusPlus, probability: f64) -> bool {
    rng.random::<f64>() < probability
}

/// Random time between two bounds, s: mostly short and sometimes long (a truncated Pareto distribution).
fn heavy_tailed(rng: &mut Xoshiro256PlusPlus, [least_s, longest_s]: [f64; 2]) -> f64 {
    /// Exponent of the tail.
    const TAIL: f64 = 0.7;
    let part = rng.random::<f64>() * (1.0 - (least_s / longest_s).powf(TAIL));
    (least_s * (1.0 - part).powf(-1.0 / TAIL)).min(longest_s)
}

fn person(setting: &Setting, identity: [u64; 2]) -> Person {
    let mut rng = generator(setting.seed, Purpose::Wander, [identity[0] | 1 << 40, identity[1]]);
    let person = Person::draw(setting.seed, identity, draw(&mut rng, setting.file.height_m));
    with_gait(person, &setting.people, setting.seed)
}

/// Makes all wandering people of a scene with blocks. A passer-by beyond the far wall is last. `people` replaces the
/// number of people in the room that the seed would draw.
pub(crate) fn everybody(
    scene: &SceneFile,
    file: &WanderFile,
    blocks: Vec<Block>,
    seed: u64,
    people: Option<usize>,
) -> Vec<(Person, Wanderer)> {
    let mut rng = generator(seed, Purpose::Wander, [u64::MAX, 0]);
    // Not used. Without this draw, all later draws of every seed would change, and so would its people.
    let _: f64 = rng.random();
    let count = rng.random_range(0..=file.max_people);
    let slots = people.unwrap_or(count);
    let group = Arc::new(Group::new(room(scene, file, blocks, seed), slots));
    let mut all = members(&group, slots);
    all.extend(passer_by(scene, file, seed, &mut rng));
    all
}

/// Makes the people of a group.
fn members(group: &Arc<Group>, slots: usize) -> Vec<(Person, Wanderer)> {
    (0..slots).map(|slot| member(group, slot, [0.0; 2])).collect()
}

/// Makes the setting of a scene's room with blocks in it.
fn room(scene: &SceneFile, file: &WanderFile, mut blocks: Vec<Block>, seed: u64) -> Setting {
    let size_m = [scene.room.size_m[0], scene.room.size_m[1]];
    let radar_m = [scene.radar.position_m[0], scene.radar.position_m[1]];
    let keep_off_m = scene.people.keep_off_m.unwrap_or(KEEP_OFF_M);
    let nearest_m = file.range_m[0];
    if nearest_m > 0.0 {
        // Hips keep `keep_off_m` from a block, so the block covers the rest of the least distance to the radar.
        let half_m = (nearest_m - keep_off_m).max(0.0);
        blocks.push([radar_m.map(|x| x - half_m), radar_m.map(|x| x + half_m)]);
    }
    let ground = Ground::new(size_m, blocks.clone(), keep_off_m);
    let planned = Ground::new(size_m, blocks, keep_off_m + PLANNED_M);
    let seats = scene.seat.iter().map(seat).filter(|seat| ground.is_free(seat.before_m)).collect();
    Setting {
        file: file.clone(),
        people: scene.people.clone(),
        seed,
        first_identity: 0,
        size_m,
        seats,
        ground,
        planned,
        view: Some(View { radar_m, azimuth_rad: scene.radar.azimuth_deg.to_radians() }),
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

/// Makes a passer-by beyond the far wall, if there is such a wall.
fn passer_by(
    scene: &SceneFile,
    file: &WanderFile,
    seed: u64,
    rng: &mut Xoshiro256PlusPlus,
) -> Option<(Person, Wanderer)> {
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
        seats: Vec::new(),
    };
    let group = Arc::new(Group::new(setting, 1));
    let (mut person, wanderer) = member(&group, 0, [scene.room.size_m[0] + off_m, 0.0]);
    person.cloth.iter_mut().for_each(|cloth| *cloth *= level);
    Some((person, wanderer))
}

/// Makes the person of a slot, whose whole motion is shifted by an offset.
fn member(group: &Arc<Group>, slot: usize, offset_m: [f64; 2]) -> (Person, Wanderer) {
    let setting = &group.setting;
    let identity = setting.identity(slot);
    let person = person(setting, identity);
    let mut rng = generator(setting.seed, Purpose::Wander, [identity[0] | 1 << 41, identity[1]]);
    let [low, high] = setting.file.sway_m.map(f64::ln);
    let excursion_m = draw(&mut rng, [low, high]).exp();
    let sway = Sway::draw(&mut rng, excursion_m);
    let build = &person.build;
    let crouches = setting.seats.iter().map(|seat| Crouch::sit(build, seat.height_m, seat.back_m)).collect();
    let limits = setting.limits(build, person.style.stride);
    let wanderer = Wanderer { group: Arc::clone(group), slot, offset_m, sway, limits, crouches };
    (person, wanderer)
}

/// Motion of one person within a group's motion.
#[derive(Debug, Clone)]
pub(crate) struct Wanderer {
    group: Arc<Group>,
    slot: usize,
    offset_m: [f64; 2],
    sway: Sway,
    limits: Limits,
    /// Descents to the seats.
    crouches: Vec<Crouch>,
}

impl Wanderer {
    /// Returns the motion at a time.
    pub(super) fn moment(&self, time_s: f64) -> Moment {
        let Some((a, b, part)) = self.group.around(self.slot, time_s) else { return Moment::default() };
        let place = a.pose.between(&b.pose, part, &self.limits);
        let low = smooth_step(2.0 * (a.down + part * (b.down - a.down)) - 1.0);
        let seat = if a.down > 0.0 { a.seat } else { b.seat };
        let swayed = self.sway.at(time_s);
        // A sitting person rests against the seat.
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
