//! The ground on which people wander: free places for hips, goals and seats, and random draws of them.

use std::f64::consts::PI;

use rand::Rng;
use rand_xoshiro::Xoshiro256PlusPlus;

use super::draw;
use super::walker::{Limits, Pose};
use crate::first_warning::is_first_warning;
use crate::people::body::Build;
use crate::people::route::Ground;
use crate::scene_file::{PeopleFile, WanderFile};

/// Number of attempts to draw a goal.
const PLACES: usize = 200;
/// Number of attempts to draw a pair of goals.
const PAIRS: usize = 12;
/// Least distance between people at the beginning, m.
const BEGIN_APART_M: f64 = 1.0;

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
    pub place_m: [f64; 2],
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
    /// Free ground for planned routes, farther from all obstacles.
    pub planned: Ground,
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
    pub fn goal(&self, rng: &mut Xoshiro256PlusPlus) -> Option<[f64; 2]> {
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
            if ground.is_free(at) {
                return Some(at);
            }
        }
        None
    }

    /// Draws the first position of a person, away from others.
    pub fn start(&self, rng: &mut Xoshiro256PlusPlus, taken: &[[f64; 2]]) -> [f64; 2] {
        /// Number of grid places along each axis, for rooms where random draws find none.
        const GRID: usize = 40;
        let off = |at: [f64; 2]| taken.iter().map(|other| distance_m(at, *other)).fold(BEGIN_APART_M, f64::min);
        let mut is_found = true;
        for _ in 0..PLACES {
            let Some(at) = self.goal(rng) else {
                is_found = false;
                break;
            };
            if off(at) >= BEGIN_APART_M {
                return at;
            }
        }
        if self.view.is_some() && !is_found && is_first_warning(&["wander"]) {
            let WanderFile { range_m: [nearest, farthest], off_boresight_deg, .. } = self.file;
            tracing::warn!(
                "no free place is {nearest} to {farthest} m from the radar and within {off_boresight_deg} degrees of its boresight, so \
                 people stand elsewhere, perhaps behind it: turn the radar (azimuth_deg), or widen range_m or off_boresight_deg"
            );
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

    /// Draws two free places far apart with a free line between them.
    pub fn ends(&self, rng: &mut Xoshiro256PlusPlus) -> Option<[[f64; 2]; 2]> {
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

    /// Draws two free places at talking distance. The first one is nearer to the given person.
    pub fn meeting(&self, rng: &mut Xoshiro256PlusPlus, person: &Pose) -> Option<[[f64; 2]; 2]> {
        for _ in 0..PLACES {
            let middle = self.goal(rng)?;
            // A person may stop a little beyond the place.
            let apart_m = self.file.least_distance_m + draw(rng, [0.4, 1.0]);
            let (sine, cosine) = draw(rng, [-PI, PI]).sin_cos();
            let spots =
                [0.5, -0.5].map(|part| [middle[0] + part * apart_m * cosine, middle[1] + part * apart_m * sine]);
            if spots.iter().all(|at| self.planned.is_free(*at)) {
                let [near, far] = spots;
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
