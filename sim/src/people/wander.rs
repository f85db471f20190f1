//! People that wander about a room. They follow smooth curves at a varying speed, with pauses for sway, weight shifts
//! and gestures, alone or together.
//!
//! [`plan`] moves all people together in steps of 50 ms. [`errand`] is one person, which goes to the places of
//! [`setting`] by the commands of [`steer`]. [`braking`] rejects commands that do not leave time to stop. [`dynamics`]
//! turns commands into motion, [`table`] keeps the steps, [`node`] interpolates between them, and [`small`] adds small
//! motions of the body. Everything is a function of seed and time.

mod braking;
mod dynamics;
mod errand;
mod node;
mod plan;
mod setting;
mod small;
mod steer;
mod table;
#[cfg(test)]
mod tests;

use std::sync::Arc;

use rand::Rng;
use rand_xoshiro::Xoshiro256PlusPlus;

use crate::math::smooth_step;
use crate::people::motion_state::{MotionState, SmallMotion};
use crate::people::person::{Person, with_gait};
use crate::people::postures::Crouch;
use crate::people::route::{Block, Ground};
use crate::random::{Purpose, draw, generator};
use crate::scene_file::{SceneFile, SeatFile, WanderFile};
use dynamics::{Limits, march_intensity, walk_intensity};
use setting::{Seat, Setting, View};
use small::Sway;
use table::Group;

/// Distance that hips keep from furniture and walls if the scene states none, m.
const KEEP_OFF_M: f64 = 0.35;
/// Additional distance of routes from obstacles, m, since people do not follow routes exactly.
const ROUTE_EXTRA_M: f64 = 0.15;
/// Backward motion of the hips for sitting down if the seat states none, m.
const SEAT_BACK_M: f64 = 0.38;
/// Depth of the ground beyond the far wall on which a passer-by walks, and its distance from the wall, m.
const BEYOND_M: [f64; 2] = [2.4, 0.6];
/// Identity of that passer-by.
const BEYOND_IDENTITY: u64 = 1 << 20;

/// Whether an event of a given probability happens.
fn chance(rng: &mut Xoshiro256PlusPlus, probability: f64) -> bool {
    rng.random::<f64>() < probability
}

/// Random time between two bounds, s: mostly short and sometimes long (a truncated Pareto distribution).
fn heavy_tailed(rng: &mut Xoshiro256PlusPlus, [least_s, longest_s]: [f64; 2]) -> f64 {
    /// Exponent of the tail.
    const TAIL: f64 = 0.7;
    let quantile = rng.random::<f64>() * (1.0 - (least_s / longest_s).powf(TAIL));
    (least_s * (1.0 - quantile).powf(-1.0 / TAIL)).min(longest_s)
}

/// Draws the person with an identity.
fn draw_person(setting: &Setting, identity: [u64; 2]) -> Person {
    let mut rng = generator(setting.seed, Purpose::Wander, [identity[0] | 1 << 40, identity[1]]);
    let person = Person::draw(setting.seed, identity, draw(&mut rng, setting.file.height_m));
    with_gait(person, &setting.people, setting.seed)
}

/// Makes all wandering people of a scene with blocks. A passer-by beyond the far wall is last. `people` replaces the
/// number of people in the room that the seed would draw.
pub(crate) fn wandering_people(
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
    let group = Arc::new(Group::new(room_setting(scene, file, blocks, seed), slots));
    let mut all = group_members(&group, slots);
    all.extend(passer_by(scene, file, seed, &mut rng));
    all
}

/// Makes the people of a group.
fn group_members(group: &Arc<Group>, slots: usize) -> Vec<(Person, Wanderer)> {
    (0..slots).map(|slot| member(group, slot, [0.0; 2])).collect()
}

/// Makes the setting of a scene's room with blocks in it.
fn room_setting(scene: &SceneFile, file: &WanderFile, mut blocks: Vec<Block>, seed: u64) -> Setting {
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
    let route_ground = Ground::new(size_m, blocks, keep_off_m + ROUTE_EXTRA_M);
    let seats = scene.seat.iter().map(seat).filter(|seat| ground.is_free(seat.before_m)).collect();
    Setting {
        file: file.clone(),
        people: scene.people.clone(),
        seed,
        first_identity: 0,
        size_m,
        seats,
        ground,
        route_ground,
        view: Some(View { radar_m, azimuth_rad: scene.radar.azimuth_deg.to_radians() }),
    }
}

fn seat(file: &SeatFile) -> Seat {
    let heading_rad = file.heading_deg.to_radians();
    let back_m = if file.back_m > 0.0 { file.back_m } else { SEAT_BACK_M };
    let [x, y] = file.position_m;
    Seat {
        position_m: file.position_m,
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
        first_identity: BEYOND_IDENTITY,
        size_m,
        route_ground: Ground::new(size_m, Vec::new(), ROUTE_EXTRA_M),
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
    let person = draw_person(setting, identity);
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
    pub(super) fn state(&self, time_s: f64) -> MotionState {
        let Some((a, b, step_fraction)) = self.group.nodes_around(self.slot, time_s) else {
            return MotionState::default();
        };
        let pose = a.pose.interpolate(&b.pose, step_fraction, &self.limits);
        let seat_descent = a.seat_descent + step_fraction * (b.seat_descent - a.seat_descent);
        let crouch_fraction = smooth_step(2.0 * seat_descent - 1.0);
        let upright = 1.0 - crouch_fraction;
        let seat = if a.seat_descent > 0.0 { a.seat } else { b.seat };
        let sway = self.sway.at(time_s);
        // A sitting person rests against the seat.
        let sway_factor = 1.0 - 0.7 * crouch_fraction;
        let [forward_m, left_m] = [0, 1].map(|i| a.shift_m[i].interpolate(b.shift_m[i], step_fraction) * upright);
        let arm_rad =
            |side: usize, joint: usize| a.arms_rad[side][joint].interpolate(b.arms_rad[side][joint], step_fraction);
        MotionState {
            position_m: [0, 1].map(|i| pose.position_m[i] + self.offset_m[i]),
            heading_rad: pose.heading_rad,
            phase: pose.phase,
            walk_intensity: walk_intensity(pose.speed_m_per_s) * upright,
            march_intensity: march_intensity(pose.speed_m_per_s, pose.turn_rad_per_s) * upright,
            crouch_fraction,
            crouch: self.crouches.get(seat).copied(),
            small_motion: Some(SmallMotion {
                forward_m: forward_m + upright * sway.forward_m,
                left_m: left_m + sway_factor * sway.left_m,
                lean_rad: sway_factor * sway.lean_rad,
                twist_rad: sway_factor * sway.twist_rad,
                shoulder_rad: [0, 1].map(|side| arm_rad(side, 0) + sway.shoulder_rad[side]),
                elbow_rad: [0, 1].map(|side| arm_rad(side, 1) + sway.elbow_rad[side]),
            }),
            ..MotionState::default()
        }
    }
}
