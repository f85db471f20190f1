//! The ground on which people wander, its seats, and random draws of positions on it.

use std::f64::consts::PI;

use rand::Rng;
use rand_xoshiro::Xoshiro256PlusPlus;

use super::draw;
use super::dynamics::{Limits, Pose};
use crate::first_warning::is_first_warning;
use crate::people::body::Build;
use crate::people::route::Ground;
use crate::scene_file::{PeopleFile, WanderFile};

/// Number of attempts to draw a goal.
const GOAL_ATTEMPTS: usize = 200;
/// Number of attempts to draw a pair of goals.
const PAIR_ATTEMPTS: usize = 12;
/// Least distance between people at the beginning, m.
const LEAST_START_DISTANCE_M: f64 = 1.0;

/// Part of the ground plan in which the scene lets people wander, as seen from the radar.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct View {
    /// Position of the radar, m.
    pub radar_m: [f64; 2],
    /// Azimuth of its boresight, rad.
    pub azimuth_rad: f64,
}

/// A seat, and the position for standing before it.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Seat {
    /// Position at which the hips come to rest, m.
    pub position_m: [f64; 2],
    /// Position for standing before it, m.
    pub before_m: [f64; 2],
    /// Heading of a sitting person, rad.
    pub heading_rad: f64,
    /// Distance from `before_m` back to the resting position of the hips, m.
    pub back_m: f64,
    /// Height of the seat, m.
    pub height_m: f64,
}

/// Ground and behaviour of wandering people.
#[derive(Debug)]
pub(super) struct Setting {
    /// Behaviour, as the scene file states it.
    pub file: WanderFile,
    /// The scene's options for all people.
    pub people: PeopleFile,
    /// Seed of all draws.
    pub seed: u64,
    /// Identity of the first person. The identities of the others follow.
    pub first_identity: u64,
    /// Size of the ground plan, m.
    pub size_m: [f64; 2],
    /// Free ground for hips.
    pub ground: Ground,
    /// Free ground for routes, farther from all obstacles than `ground`.
    pub route_ground: Ground,
    /// Part of the ground that contains the goals; all of it if absent.
    pub view: Option<View>,
    /// Seats that can be used.
    pub seats: Vec<Seat>,
}

impl Setting {
    /// Identity of the person in a slot.
    pub fn identity(&self, slot: usize) -> [u64; 2] {
        [self.first_identity + slot as u64, 0]
    }

    /// Bounds of the motion of a person with this body and stride.
    pub fn limits(&self, build: &Build, stride: f64) -> Limits {
        Limits {
            // The accelerations along and across the route together do not exceed the file's value.
            acceleration_m_per_s2: self.file.acceleration_m_per_s2 * 0.5f64.sqrt(),
            turn_rad_per_s: self.people.turn_rate_deg_per_s.unwrap_or(120.0).to_radians(),
            leg_m: build.standing_hip_height_m(),
            stride,
        }
    }

    /// Draws a free place as a goal.
    pub fn draw_goal(&self, rng: &mut Xoshiro256PlusPlus) -> Option<[f64; 2]> {
        for attempt in 0..2 * GOAL_ATTEMPTS {
            let position = match &self.view {
                Some(view) => {
                    let [nearest, farthest] = self.file.range_m;
                    let range_m = nearest + (farthest - nearest) * rng.random::<f64>().powf(self.file.nearness);
                    let largest_rad = self.file.off_boresight_deg.to_radians();
                    let (sine, cosine) = (view.azimuth_rad + draw(rng, [-largest_rad, largest_rad])).sin_cos();
                    [view.radar_m[0] + range_m * cosine, view.radar_m[1] + range_m * sine]
                }
                None => self.size_m.map(|size| draw(rng, [0.0, size])),
            };
            let ground = if attempt < GOAL_ATTEMPTS { &self.route_ground } else { &self.ground };
            if ground.is_free(position) {
                return Some(position);
            }
        }
        None
    }

    /// Draws the first position of a person, away from others.
    pub fn draw_start(&self, rng: &mut Xoshiro256PlusPlus, taken: &[[f64; 2]]) -> [f64; 2] {
        /// Number of grid places along each axis, for rooms where random draws find none.
        const GRID: usize = 40;
        let distance_to_others = |position: [f64; 2]| {
            taken.iter().map(|other| distance_m(position, *other)).fold(LEAST_START_DISTANCE_M, f64::min)
        };
        let mut has_goal = true;
        for _ in 0..GOAL_ATTEMPTS {
            let Some(position) = self.draw_goal(rng) else {
                has_goal = false;
                break;
            };
            if distance_to_others(position) >= LEAST_START_DISTANCE_M {
                return position;
            }
        }
        if self.view.is_some() && !has_goal && is_first_warning(&["wander"]) {
            let WanderFile { range_m: [nearest, farthest], off_boresight_deg, .. } = self.file;
            tracing::warn!(
                "no free place is {nearest} to {farthest} m from the radar and within {off_boresight_deg} degrees of its boresight, so \
                 people stand elsewhere, perhaps behind it: turn the radar (azimuth_deg), or widen range_m or off_boresight_deg"
            );
        }
        let (mut farthest_m, mut farthest) = (-1.0, self.size_m.map(|size| 0.5 * size));
        for i in 1..GRID * GRID {
            let position =
                [self.size_m[0] * (i % GRID) as f64 / GRID as f64, self.size_m[1] * (i / GRID) as f64 / GRID as f64];
            if self.ground.is_free(position) && distance_to_others(position) > farthest_m {
                (farthest_m, farthest) = (distance_to_others(position), position);
            }
        }
        farthest
    }

    /// Draws two free places far apart with a free line between them.
    pub fn draw_pacing_ends(&self, rng: &mut Xoshiro256PlusPlus) -> Option<[[f64; 2]; 2]> {
        let mut longest: Option<(f64, [[f64; 2]; 2])> = None;
        for _ in 0..PAIR_ATTEMPTS {
            let (a, b) = (self.draw_goal(rng)?, self.draw_goal(rng)?);
            let length_m = distance_m(a, b);
            let is_straight = self.route_ground.find_route(a, b).is_some_and(|route| route.len() == 1);
            if is_straight && longest.is_none_or(|(best_m, _)| length_m > best_m) {
                longest = Some((length_m, [a, b]));
            }
        }
        longest.map(|(_, ends)| ends)
    }

    /// Draws two free places at talking distance. The first one is nearer to the given person.
    pub fn draw_meeting(&self, rng: &mut Xoshiro256PlusPlus, person: &Pose) -> Option<[[f64; 2]; 2]> {
        for _ in 0..GOAL_ATTEMPTS {
            let centre = self.draw_goal(rng)?;
            // A person may stop a little beyond the place.
            let distance_m = self.file.least_distance_m + draw(rng, [0.4, 1.0]);
            let (sine, cosine) = draw(rng, [-PI, PI]).sin_cos();
            let positions = [0.5, -0.5]
                .map(|factor| [centre[0] + factor * distance_m * cosine, centre[1] + factor * distance_m * sine]);
            if positions.iter().all(|position| self.route_ground.is_free(*position)) {
                let [near, far] = positions;
                let is_sorted = person.distance_m(near) <= person.distance_m(far);
                return Some(if is_sorted { [near, far] } else { [far, near] });
            }
        }
        None
    }
}

fn distance_m(a: [f64; 2], b: [f64; 2]) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}
