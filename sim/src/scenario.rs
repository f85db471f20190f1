//! Presence of people over time: written scripts, endless visits, wandering people, or people at a desk. All random
//! values depend on (seed, slot, visit).

use std::cell::Cell;
use std::sync::{Arc, Mutex, PoisonError};

use glam::{DVec3, EulerRot};
use rand::Rng;
use rand_xoshiro::Xoshiro256PlusPlus;

use crate::first_warning::is_first_warning;
use crate::people::motion::{Bed, Motion, MotionBuilder};
use crate::people::person::{AtDesk, BodyPoint, Person, Steps, with_gait};
use crate::people::route::Ground;
use crate::people::wander;
use crate::random::{Purpose, draw, generator};
use crate::scene::Scene;
use crate::scene::ground::{Floor, blocks, is_outside, walls};
use crate::scene_file::{ActorFile, BedFile, DeskFile, DoorFile, SceneFile, SeatFile, StepFile, VisitsFile};

/// The people of a scene over all time.
#[derive(Debug)]
pub struct Scenario {
    /// People whose motions are known from the beginning.
    fixed: Vec<Arc<Motion>>,
    visits: Option<Visits>,
}

/// Visits of each slot. They are drawn when they are first requested.
#[derive(Debug)]
struct Visits {
    seed: u64,
    scene: SceneFile,
    file: VisitsFile,
    ground: Option<Ground>,
    slots: Vec<Mutex<Slot>>,
}

/// Visits of a slot so far, in order of time. Only the motions of those near the last request are kept; others are drawn again if
/// they are requested again.
#[derive(Debug, Default)]
struct Slot {
    visits: Vec<Visit>,
    /// Motions by the number of the visit.
    motions: Vec<(usize, Arc<Motion>)>,
}

/// Visit of a slot.
#[derive(Debug, Clone, Copy)]
struct Visit {
    /// Time from which its motion is drawn, s.
    begin_s: f64,
    start_s: f64,
    end_s: f64,
}

impl Scenario {
    /// Makes the people of a scene. `people` replaces the greatest number of people.
    pub fn new(scene: &Scene, seed: u64, people: Option<usize>) -> Self {
        let file = scene.file();
        let mut scenario = Scenario { fixed: Vec::new(), visits: None };
        if let Some(visits) = &file.people.visits {
            scenario.fixed = passer_by(file, visits, seed).into_iter().map(Arc::new).collect();
            let slots = people.unwrap_or(visits.max_people);
            scenario.visits = Some(Visits {
                seed,
                scene: file.clone(),
                file: visits.clone(),
                ground: ground(scene),
                slots: (0..slots).map(|_| Mutex::default()).collect(),
            });
        } else if let Some(wandering) = &file.people.wander {
            let all = wander::wandering_people(file, wandering, blocks(scene), seed, people).into_iter();
            scenario.fixed = all.map(|(person, wanderer)| Arc::new(Motion::wandering(person, wanderer))).collect();
        } else if let Some(desk) = &file.people.desk {
            scenario.fixed = desk_people(scene, desk, seed, people).into_iter().map(Arc::new).collect();
        } else {
            let actors = file.people.actor.iter().enumerate();
            let count = people.unwrap_or(usize::MAX);
            let steps = |i: usize| scene.steps().get(i).cloned().unwrap_or_default();
            let ground = ground(scene);
            let motion = |(i, actor)| Arc::new(scripted(scene, ground.as_ref(), actor, steps(i), seed, i as u64));
            scenario.fixed = actors.take(count).map(motion).collect();
        }
        scenario
    }

    /// Returns all people that are present at some time of an interval, each with a slot number.
    pub fn between(&self, start_s: f64, end_s: f64) -> Vec<(usize, Arc<Motion>)> {
        let overlaps = |m: &Motion| m.start_s <= end_s && m.end_s >= start_s;
        let mut all: Vec<_> =
            self.fixed.iter().enumerate().filter(|(_, m)| overlaps(m)).map(|(slot, m)| (slot, Arc::clone(m))).collect();
        // People besides visitors have slots after those of the visitors.
        let visitors = self.visits.as_ref().map_or(0, |visits| visits.slots.len());
        all.iter_mut().for_each(|(slot, _)| *slot += visitors);
        if let Some(visits) = &self.visits {
            for slot in 0..visits.slots.len() {
                all.extend(visits.between(slot, start_s, end_s).into_iter().map(|m| (slot, m)));
            }
        }
        all
    }
}

/// Returns the ground on which people may walk; `None` if they walk straight. Walls are always obstacles. Furniture is
/// one if the scene states the distance that people keep from it.
fn ground(scene: &Scene) -> Option<Ground> {
    /// Distance that hips keep from walls if the scene states none, m.
    const OFF_WALLS_M: f64 = 0.3;
    let [width, depth, _] = scene.file().room.size_m;
    let walls = walls(scene);
    let has_walls = !walls.is_empty();
    let ground = match scene.file().people.keep_off_m {
        Some(keep_off_m) => Some(Ground::new([width, depth], blocks(scene), keep_off_m)),
        None => has_walls.then(|| Ground::new([width, depth], walls, OFF_WALLS_M)),
    };
    ground.map(|ground| if has_walls { ground.with_walls() } else { ground })
}

/// Walks along the corners of a route.
fn walk_along(path: MotionBuilder, route: Vec<[f64; 2]>, speed_m_per_s: f64) -> MotionBuilder {
    route.into_iter().fold(path, |path, corner| path.walk_to(corner, speed_m_per_s))
}

/// Point at a distance ahead of another one, m.
fn point_ahead([x, y]: [f64; 2], heading_rad: f64, by_m: f64) -> [f64; 2] {
    [x + by_m * heading_rad.cos(), y + by_m * heading_rad.sin()]
}

/// Depths behind a door at which a person is outside and inside, m.
const OUTSIDE_M: f64 = -0.75;
const INSIDE_M: f64 = 0.6;

/// Context for converting a script to a motion.
struct Script<'a> {
    scene: &'a Scene,
    file: &'a SceneFile,
    ground: Option<&'a Ground>,
    /// Index of the person.
    index: u64,
    /// Whether there was a warning about a place. Only the first one of a person is given.
    has_warned: Cell<bool>,
}

/// Makes the motion of an actor from a script.
fn scripted(scene: &Scene, ground: Option<&Ground>, actor: &ActorFile, steps: Steps, seed: u64, index: u64) -> Motion {
    let file = scene.file();
    let default_height_m = if let Steps::Actor(actor) = &steps { actor.height_m } else { 1.75 };
    let mut person = Person::draw(seed, [index, 0], actor.height_m.unwrap_or(default_height_m));
    person.steps = steps;
    person = with_gait(person, &file.people, seed);
    person.style.stride = actor.stride.unwrap_or(person.style.stride);
    person.style.arm_swing = actor.arm_swing.unwrap_or(person.style.arm_swing);
    let size_m = file.room.size_m;
    let first = actor.step.first();
    let door = first.and_then(|s| s.enter_door).and_then(|number| file.door.get(number));
    let (place, facing_rad) = match door {
        Some(door) => {
            let [nx, ny] = inward(size_m, door);
            (at_door(size_m, door, OUTSIDE_M, 0.0), ny.atan2(nx))
        }
        None => {
            let place = first.and_then(|s| s.walk_to_m).unwrap_or_default();
            let next = actor.step.iter().skip(1).find_map(|s| s.walk_to_m).unwrap_or(place);
            (place, (next[1] - place[1]).atan2(next[0] - place[0]))
        }
    };
    let turn_rate = file.people.turn_rate_deg_per_s.map(f64::to_radians);
    let path = MotionBuilder::new(person, actor.start_s, place, facing_rad).turning_at(turn_rate);
    let script = Script { scene, file, ground, index, has_warned: Cell::new(false) };
    let steps = actor.step.iter().enumerate();
    let path = steps.fold(path, |path, (number, step)| script.add_step(path, step, number == 0));
    let leaves = actor.step.iter().any(|step| step.leave_door.is_some_and(|number| number < file.door.len()));
    let mut motion = if leaves { path.leave() } else { path.stay() };
    // A person that does not enter by a door waits where the script begins.
    if first.is_none_or(|s| s.enter_door.is_none()) {
        motion.start_s = f64::NEG_INFINITY;
    }
    motion
}

impl Script<'_> {
    /// Adds a step of the script, which may be the first one.
    fn add_step(&self, mut path: MotionBuilder, step: &StepFile, is_first: bool) -> MotionBuilder {
        let speed = step.speed_m_per_s.unwrap_or(1.2);
        let door = |number: usize| self.file.door.get(number);
        if let Some(to) = step.walk_to_m {
            let is_within =
                |[low, high]: &[[f64; 2]; 2]| (0..2).all(|axis| to[axis] > low[axis] && to[axis] < high[axis]);
            // A place beyond the walls of a plan may lie within the boxes that stand for them.
            let is_outside = self.warn_if_outside(to, if is_first { "stands at" } else { "goes straight to" });
            if !is_outside && blocks(self.scene).iter().any(is_within) {
                self.warn_about(to, "stands at", "lies within furniture or a wall");
            }
            if !is_first {
                path = self.route_to(path, to, speed);
            }
        }
        if let Some(duration_s) = step.stand_s {
            path = path.stand(duration_s);
        }
        if let Some(duration_s) = step.sit_s {
            path = match step.seat.and_then(|number| self.file.seat.get(number)) {
                Some(seat) => sit_on(path, seat, duration_s, |path, to| self.route_to(path, to, speed)),
                None => {
                    let heading_rad = path.heading_rad();
                    path.sit(heading_rad, 0.45, duration_s)
                }
            };
        }
        if let Some(duration_s) = step.squat_s {
            path = path.squat(step.depth_m.unwrap_or(0.45), duration_s);
        }
        if let (Some(duration_s), Some(bed)) = (step.lie_s, self.file.bed.get(step.bed.unwrap_or(0)).map(bed)) {
            path = if is_first {
                path.lying(&bed, duration_s)
            } else {
                let before = bed.stand_m(&path.person().build);
                self.route_to(path, before, speed).lie(&bed, duration_s)
            };
        }
        if let Some(degrees) = step.face_deg {
            path = path.face(degrees.to_radians());
        }
        if let Some(door) = step.enter_door.and_then(door) {
            path = path.walk_to(at_door(self.file.room.size_m, door, INSIDE_M, 0.0), speed);
        }
        if let Some(door) = step.leave_door.and_then(door) {
            path = self.route_to(path, at_door(self.file.room.size_m, door, INSIDE_M, 0.0), speed);
            path = path.walk_to(at_door(self.file.room.size_m, door, OUTSIDE_M, 0.0), speed);
        }
        path
    }

    /// Walks to a place, around obstacles, or straight through them if there is no way around.
    fn route_to(&self, path: MotionBuilder, to: [f64; 2], speed_m_per_s: f64) -> MotionBuilder {
        let route = self.ground.map_or_else(|| Some(vec![to]), |ground| ground.find_route(path.place(), to));
        let is_outside = self.warn_if_outside(to, "goes straight to");
        if !is_outside && route.is_none() {
            self.warn_about(to, "goes straight to", "cannot be reached around walls and furniture");
        }
        walk_along(path, route.unwrap_or_else(|| vec![to]), speed_m_per_s)
    }

    /// Warns of a place outside the room, unless people go there on purpose. Returns whether it lies outside.
    fn warn_if_outside(&self, place: [f64; 2], what: &str) -> bool {
        let is_outside = is_outside(self.scene, place);
        if is_outside && !is_meant_outside(self.file, place) {
            self.warn_about(place, what, "lies outside the room");
        }
        is_outside
    }

    /// Warns of an unusual place, only for the first such place of each person of a scene's file, and only once: a
    /// scene is simulated for many seeds.
    fn warn_about(&self, [x, y]: [f64; 2], what: &str, why: &str) {
        let (path, index) = (self.scene.path().to_string_lossy(), self.index.to_string());
        let goal = format!("[{x:.2}, {y:.2}]");
        if !self.has_warned.replace(true) && is_first_warning(&["goal", &path, &index, &goal]) {
            tracing::warn!("{}: person {index} {what} {goal} m, which {why}", self.file.name);
        }
    }
}

/// Returns whether people go to a place outside the room on purpose: a place at a door, or behind walls through which
/// they are seen.
fn is_meant_outside(file: &SceneFile, place: [f64; 2]) -> bool {
    /// Largest distance from a doorway, m: mirrors of recordings leave people 0.75 m beyond it.
    const AT_DOOR_M: f64 = 1.0;
    let size_m = file.room.size_m;
    let is_at_door = file.door.iter().any(|door| {
        let [nx, ny] = inward(size_m, door);
        let off = [place[0] - door.position_m[0], place[1] - door.position_m[1]];
        let (out_m, along_m) = (off[0] * nx + off[1] * ny, off[0] * ny - off[1] * nx);
        out_m.hypot((along_m.abs() - 0.5 * door.width_m).max(0.0)) <= AT_DOOR_M
    });
    let mut beyond = [place[0] < 0.0, place[0] > size_m[0], place[1] < 0.0, place[1] > size_m[1]];
    if !beyond.contains(&true) {
        // In the box around a plan, the place is beyond walls that may face any way.
        beyond = [true; 4];
    }
    let mut walls = beyond.into_iter().zip(file.room.passable_walls());
    is_at_door || walls.all(|(is_beyond, is_passable)| !is_beyond || is_passable)
}

/// Bed of a scene's file.
fn bed(file: &BedFile) -> Bed {
    Bed {
        position_m: file.position_m,
        heading_rad: file.heading_deg.to_radians(),
        height_m: file.height_m,
        edge_m: file.edge_m,
    }
}

/// Walks to a seat and sits there for a duration. Afterwards the person stands before the seat.
fn sit_on(
    path: MotionBuilder,
    seat: &SeatFile,
    duration_s: f64,
    route_to: impl Fn(MotionBuilder, [f64; 2]) -> MotionBuilder,
) -> MotionBuilder {
    let heading = seat.heading_deg.to_radians();
    if seat.back_m > 0.0 {
        let before = point_ahead(seat.position_m, heading, seat.back_m);
        return route_to(path, before).sit_back(heading, seat.height_m, seat.back_m, duration_s);
    }
    // The feet stand where the hips come to rest.
    let before = point_ahead(seat.position_m, heading, 0.35);
    let path = route_to(path, before).walk_to(seat.position_m, 0.5);
    path.sit(heading, seat.height_m, duration_s).walk_to(before, 0.6)
}

/// Unit vector from a door into the room.
fn inward(size_m: [f64; 3], door: &DoorFile) -> [f64; 2] {
    let [x, y] = door.position_m;
    if x < 1e-6 {
        [1.0, 0.0]
    } else if x > size_m[0] - 1e-6 {
        [-1.0, 0.0]
    } else if y < 1e-6 {
        [0.0, 1.0]
    } else {
        [0.0, -1.0]
    }
}

/// Point at a depth behind a door (positive: in the room), shifted sideways within the doorway.
fn at_door(size_m: [f64; 3], door: &DoorFile, depth: f64, lateral: f64) -> [f64; 2] {
    let [nx, ny] = inward(size_m, door);
    let max_shift = (0.5 * door.width_m - 0.3).max(0.0);
    let shift = lateral.clamp(-max_shift, max_shift);
    // Sideways is +y for doors in x walls and +x for doors in y walls, for both walking directions.
    let (sx, sy) = if nx == 0.0 { (shift, 0.0) } else { (0.0, shift) };
    [door.position_m[0] + depth * nx + sx, door.position_m[1] + depth * ny + sy]
}

/// Makes a passer-by beyond the far wall, if there is such a wall.
fn passer_by(file: &SceneFile, visits: &VisitsFile, seed: u64) -> Option<Motion> {
    /// Distance beyond the wall, m.
    const BEYOND_M: [f64; 2] = [0.6, 3.0];
    /// Number of walks, which take more than twenty minutes.
    const LEGS: usize = 400;
    let mut rng = generator(seed, Purpose::Visit, [u64::MAX, 0]);
    if rng.random::<f64>() >= visits.passer_by_probability {
        return None;
    }
    let size_m = file.room.size_m;
    let person = Person::draw(seed, [u64::MAX, 0], draw(&mut rng, visits.height_m));
    let mut person = with_gait(person, &file.people, seed);
    let level = 10f64.powf(0.05 * draw(&mut rng, visits.passer_by_level_db));
    person.cloth.iter_mut().for_each(|cloth| *cloth *= level);
    let place = |rng: &mut Xoshiro256PlusPlus| [size_m[0] + draw(rng, BEYOND_M), draw(rng, [0.0, size_m[1]])];
    let mut path = MotionBuilder::new(person, 0.0, place(&mut rng), 0.0);
    for _ in 0..LEGS {
        let (to, speed) = (place(&mut rng), draw(&mut rng, visits.speed_m_per_s));
        path = path.walk_to(to, speed);
        if rng.random::<f64>() < visits.pause_probability {
            path = path.stand(draw(&mut rng, visits.pause_s));
        }
    }
    let mut motion = path.stay();
    motion.start_s = f64::NEG_INFINITY;
    Some(motion)
}

/// Random values that people at a desk share.
struct DeskDraws<'a> {
    scene: &'a Scene,
    desk: &'a DeskFile,
    seed: u64,
    /// Azimuth of the boresight, rad.
    azimuth: f64,
    level_db: f64,
    double_bounce: f64,
    double_bounce_offset_m: f64,
}

/// Makes the people that sit before the radar.
fn desk_people(scene: &Scene, desk: &DeskFile, seed: u64, people: Option<usize>) -> Vec<Motion> {
    let mut rng = generator(seed, Purpose::Desk, [0, 0]);
    let drawn = rng.random_range(0..=desk.max_people);
    let count = people.unwrap_or(drawn);
    let (azimuth, ..) = scene.radar_from_world().transpose().to_euler(EulerRot::ZYX);
    let first_side: f64 = if rng.random::<bool>() { 1.0 } else { -1.0 };
    let [nearest, farthest] = desk.distance_m;
    // The distances of two people differ by a separation within the limits, so that bodies do not overlap.
    let separations = desk.min_separation_m..=desk.max_separation_m.min(farthest - nearest).max(desk.min_separation_m);
    let separation = if count > 1 { rng.random_range(separations) } else { 0.0 };
    let first = draw(&mut rng, [nearest, (farthest - separation).max(nearest)]);
    let draws = DeskDraws {
        scene,
        desk,
        seed,
        azimuth,
        level_db: draw(&mut rng, desk.reflectivity_db),
        double_bounce: desk.double_bounce_db.map_or(0.0, |db| 10f64.powf(0.05 * draw(&mut rng, db))),
        double_bounce_offset_m: draw(&mut rng, desk.double_bounce_offset_m),
    };
    // Two people sit far off the boresight.
    let least_off = if count > 1 { 0.6 } else { 0.0 };
    let person = |slot: usize| {
        let side = if slot.is_multiple_of(2) { first_side } else { -first_side };
        draws.person(slot as u64, [first, first + separation][slot.min(1)], side, least_off)
    };
    (0..count).map(person).collect()
}

impl DeskDraws<'_> {
    /// Makes the person of a slot. The chest is at a distance from the radar, m, on a side of its boresight. The angle
    /// is at least a fraction `least_off` of the greatest angle.
    fn person(&self, slot: u64, distance: f64, side: f64, least_off: f64) -> Motion {
        let desk = self.desk;
        let mut rng = generator(self.seed, Purpose::Desk, [1, slot]);
        let angle = self.azimuth + side * desk.off_boresight_deg.to_radians() * rng.random_range(least_off..1.0);
        let height = rng.random_range(desk.height_m[0]..=desk.height_m[1]);
        let person = Person::draw(self.seed, [slot, 1 << 20], height);
        let mut person = with_gait(person, &self.scene.file().people, self.seed);
        person.fidget_probability = if rng.random::<f64>() < desk.fidget_probability { 0.7 } else { 0.0 };
        person.at_ease();
        let scatter_db = desk.reflectivity_scatter_db * rng.random_range(-1.0..=1.0);
        let reflectivity = 10f64.powf(0.05 * (self.level_db + scatter_db));
        person.cloth.iter_mut().for_each(|c| *c *= reflectivity);
        let mut arm = || (rng.random_range(-0.35..0.5), rng.random_range(-0.6..0.5));
        let arms_rad = [arm(), arm()];
        person.at_desk = Some(AtDesk {
            double_bounce: self.double_bounce,
            double_bounce_offset_m: self.double_bounce_offset_m,
            points: self.body_points(slot, reflectivity, &mut rng),
            point_decay_db_per_m: draw(&mut rng, desk.body_point_decay_db_per_m),
            arms_rad,
            lean_rad: rng.random_range(-0.12..0.15),
        });
        // The front of the chest is about this far before the hips.
        let hips = distance + 0.115 * person.build.girth;
        let radar = self.scene.radar_position();
        let place = [radar.x + hips * angle.cos(), radar.y + hips * angle.sin()];
        let [is_in, _] = Floor::of(self.scene).meets(DVec3::new(place[0], place[1], 1.0), DVec3::ZERO);
        let path = self.scene.path().to_string_lossy();
        if !is_in && is_first_warning(&["desk", &path]) {
            let ([x, y], name) = (place, &self.scene.file().name);
            tracing::warn!(
                "{name}: the person at the desk sits at [{x:.2}, {y:.2}] m, outside the room: turn the radar (azimuth_deg), or \
                 change distance_m under [people.desk]"
            );
        }
        let facing = angle + std::f64::consts::PI + rng.random_range(-0.3..0.3);
        let mut motion = MotionBuilder::new(person, 0.0, place, facing).seated(0.45).stay();
        motion.start_s = f64::NEG_INFINITY;
        motion
    }

    /// Draws the scattering points on the body of a slot.
    fn body_points(&self, slot: u64, reflectivity: f64, rng: &mut Xoshiro256PlusPlus) -> Vec<BodyPoint> {
        let mut detours = generator(self.seed, Purpose::Desk, [4, slot]);
        let mut point = || BodyPoint {
            place: DVec3::new(rng.random_range(-0.6..0.8), rng.random_range(-1.5..1.5), rng.random_range(-1.6..1.4)),
            scatter_m: reflectivity
                * (10f64.powf(0.1 * draw(rng, self.desk.body_point_dbsm)) / (4.0 * std::f64::consts::PI)).sqrt(),
            detour_m: draw(&mut detours, self.desk.body_point_detour_m),
        };
        (0..self.desk.body_points).map(|_| point()).collect()
    }
}

/// Number of attempts to draw a place.
const MAX_ATTEMPTS: usize = 40;

impl Visits {
    fn between(&self, slot: usize, start_s: f64, end_s: f64) -> Vec<Arc<Motion>> {
        /// Time around a request within which motions are kept, s. Frames are simulated side by side, not quite in order.
        const KEPT_S: f64 = 60.0;
        let Some(state) = self.slots.get(slot) else { return Vec::new() };
        let mut state = state.lock().unwrap_or_else(PoisonError::into_inner);
        let Slot { visits, motions } = &mut *state;
        let is_near = |visit: &Visit| visit.end_s >= start_s - KEPT_S && visit.start_s <= end_s + KEPT_S;
        while visits.last().is_none_or(|visit| visit.start_s <= end_s) {
            let number = visits.len();
            let mut rng = self.generator(slot, number);
            let absence_s = draw(&mut rng, self.absence_s(number));
            let begin_s = visits.last().map_or(0.0, |last| last.end_s) + absence_s;
            let motion = self.visit(slot, number as u64, begin_s, &mut rng);
            let visit = Visit { begin_s, start_s: motion.start_s, end_s: motion.end_s };
            visits.push(visit);
            if is_near(&visit) {
                motions.push((number, Arc::new(motion)));
            }
        }
        motions.retain(|(number, _)| visits.get(*number).is_some_and(is_near));
        let first = visits.partition_point(|visit| visit.end_s < start_s);
        let requested = visits.iter().enumerate().skip(first).take_while(|(_, visit)| visit.start_s <= end_s);
        let motion = |(number, visit): (usize, &Visit)| {
            if let Some((_, motion)) = motions.iter().find(|(kept, _)| *kept == number) {
                return Arc::clone(motion);
            }
            let motion = Arc::new(self.drawn_again(slot, number, visit));
            motions.push((number, Arc::clone(&motion)));
            motion
        };
        requested.map(motion).collect()
    }

    /// Random numbers of a visit: its absence before, then its motion.
    fn generator(&self, slot: usize, number: usize) -> Xoshiro256PlusPlus {
        generator(self.seed, Purpose::Visit, [slot as u64, number as u64])
    }

    /// Bounds of the time before a visit, s.
    fn absence_s(&self, number: usize) -> [f64; 2] {
        if number == 0 { self.file.first_absence_s } else { self.file.absence_s }
    }

    /// Motion of a visit that has been drawn before.
    fn drawn_again(&self, slot: usize, number: usize, visit: &Visit) -> Motion {
        let mut rng = self.generator(slot, number);
        draw(&mut rng, self.absence_s(number));
        self.visit(slot, number as u64, visit.begin_s, &mut rng)
    }

    /// Draws a place to which a pacing person walks.
    fn draw_pace_point(&self, rng: &mut Xoshiro256PlusPlus) -> [f64; 2] {
        let [w, d, _] = self.scene.room.size_m;
        let inner_area = |x: f64, y: f64| [[x, y], [w - x, d - y]];
        let by_margin = |margin: f64| inner_area(margin.min(0.5 * w), margin.min(0.5 * d));
        let area = self.file.pace_area_m.or(self.file.pace_margin_m.map(by_margin));
        let [low, high] = area.unwrap_or(inner_area(0.25 * w, 0.25 * d));
        let mut at = [0.0; 2];
        // An unsuitable place is drawn again. After the last attempt the last place is used.
        for _ in 0..MAX_ATTEMPTS {
            at = [draw(rng, [low[0], high[0]]), draw(rng, [low[1], high[1]])];
            if self.is_in_view(at) && self.is_free(at) {
                return at;
            }
        }
        let name = &self.scene.name;
        if is_first_warning(&["pace", name]) {
            tracing::warn!(
                "{name}: {MAX_ATTEMPTS} attempts found no place to pace, so people go where they should not, perhaps all to one place: \
                 widen pace_range_m, pace_off_boresight_deg or the area (pace_area_m, pace_margin_m) under [people.visits], or turn \
                 the radar (azimuth_deg)"
            );
        }
        at
    }

    /// Whether the file lets people pace at a place.
    fn is_in_view(&self, [x, y]: [f64; 2]) -> bool {
        let [radar_x, radar_y, _] = self.scene.radar.position_m;
        let (east, north) = (x - radar_x, y - radar_y);
        let (sine, cosine) = self.scene.radar.azimuth_deg.to_radians().sin_cos();
        let (along, across) = (east * cosine + north * sine, north * cosine - east * sine);
        let off_deg = across.atan2(along).to_degrees().abs();
        self.file.pace_off_boresight_deg.is_none_or(|most| off_deg <= most)
            && self.file.pace_range_m.is_none_or(|[least, most]| (least..=most).contains(&along.hypot(across)))
    }

    /// Walks to a place, around obstacles.
    fn route_to(&self, path: MotionBuilder, to: [f64; 2], speed: f64) -> MotionBuilder {
        let route = self.ground.as_ref().map_or_else(|| vec![to], |ground| ground.route(path.place(), to));
        walk_along(path, route, speed)
    }

    /// Whether a place is free of obstacles.
    fn is_free(&self, at: [f64; 2]) -> bool {
        self.ground.as_ref().is_none_or(|ground| ground.is_free(at))
    }

    /// Draws a visit of a slot. The person enters by a door, walks to a seat, to and fro or through the room, and
    /// leaves.
    fn visit(&self, slot: usize, number: u64, begin_s: f64, rng: &mut Xoshiro256PlusPlus) -> Motion {
        let f = &self.file;
        let speed = draw(rng, f.speed_m_per_s);
        let person = Person::draw(self.seed, [slot as u64, number], draw(rng, f.height_m));
        let person = with_gait(person, &self.scene.people, self.seed);
        let side = if slot.is_multiple_of(2) { 1.0 } else { -1.0 };
        let lateral = side * draw(rng, f.lateral_m);
        let [entry, exit] = self.entry_and_exit(rng);
        let at_door = |door: &DoorFile, depth: f64| at_door(self.scene.room.size_m, door, depth, lateral);
        let turn_rate = self.scene.people.turn_rate_deg_per_s.map(f64::to_radians);
        let [nx, ny] = inward(self.scene.room.size_m, &entry);
        let path = MotionBuilder::new(person, begin_s, at_door(&entry, OUTSIDE_M), ny.atan2(nx)).turning_at(turn_rate);
        let mut path = path.walk_to(at_door(&entry, INSIDE_M), speed);

        let sits = rng.random::<f64>() < f.sit_probability && !self.scene.seat.is_empty();
        let paces = rng.random::<f64>() < f.pace_probability;
        let turns = rng.random::<f64>() < f.turn_probability;
        let pause_s = if rng.random::<f64>() < f.pause_probability { draw(rng, f.pause_s) } else { 0.0 };
        let mut leave_by = &exit;
        if sits {
            path = self.sit(path, slot, speed, rng);
        } else if paces {
            path = self.pace(path, speed, rng);
        } else if self.scene.door.len() > 1 {
            let stop = self.draw_stop(path.place(), at_door(&exit, INSIDE_M), rng);
            if turns {
                leave_by = &entry;
            }
            if turns || pause_s > 0.0 {
                path = self.route_to(path, stop, speed).stand(pause_s);
            }
        } else {
            let to = self.draw_pace_point(rng);
            path = self.route_to(path, to, speed).stand(pause_s);
        }
        path = self.route_to(path, at_door(leave_by, INSIDE_M), speed);
        path.walk_to(at_door(leave_by, OUTSIDE_M), speed).leave()
    }

    /// Draws the doors by which a person enters and leaves: different ones if there are two. A person that turns round
    /// leaves by the first.
    fn entry_and_exit(&self, rng: &mut Xoshiro256PlusPlus) -> [DoorFile; 2] {
        let count = self.scene.door.len();
        let pick = rng.random_range(0..count.max(1));
        let other = if count > 1 { (pick + 1 + rng.random_range(0..count - 1)) % count } else { pick };
        // `check` refuses visits without a door. The default only makes this function total.
        let fallback = DoorFile { position_m: [0.0, 0.5 * self.scene.room.size_m[1]], width_m: 0.9 };
        [pick, other].map(|number| self.scene.door.get(number).copied().unwrap_or(fallback))
    }

    /// Walks to the seat of a slot and sits there for a duration. Each slot has its own seat, so two people never share
    /// one.
    fn sit(&self, path: MotionBuilder, slot: usize, speed: f64, rng: &mut Xoshiro256PlusPlus) -> MotionBuilder {
        let Some(seat) = self.scene.seat.get(slot % self.scene.seat.len()) else { return path };
        sit_on(path, seat, draw(rng, self.file.sit_s), |path, to| self.route_to(path, to, speed))
    }

    /// Paces to and fro between random places.
    fn pace(&self, mut path: MotionBuilder, speed: f64, rng: &mut Xoshiro256PlusPlus) -> MotionBuilder {
        for _ in 0..draw(rng, self.file.pace_legs).round() as usize {
            let to = self.draw_pace_point(rng);
            path = self.route_to(path, to, speed);
            if rng.random::<f64>() < self.file.pause_probability {
                path = path.stand(draw(rng, self.file.pause_s));
            }
        }
        path
    }

    /// Draws a free place on the line between two places. If no attempt finds one, the last place is used.
    fn draw_stop(&self, from: [f64; 2], to: [f64; 2], rng: &mut Xoshiro256PlusPlus) -> [f64; 2] {
        let mut stop = from;
        for _ in 0..MAX_ATTEMPTS {
            let fraction = rng.random_range(0.3..0.8);
            stop = [from[0] + fraction * (to[0] - from[0]), from[1] + fraction * (to[1] - from[1])];
            if self.is_free(stop) {
                break;
            }
        }
        stop
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every mirror of someone who used a door warned of the goal beyond it.
    #[test]
    fn goals_beyond_doors_and_passable_walls_are_meant() {
        let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../fixtures/scenes/corridor.toml");
        let mut file = Scene::load(&path).expect("a scene").file().clone();
        for (place, is_meant) in [
            ([-0.75, 1.01], true),
            ([12.75, 1.5], true),
            ([-1.2, 1.0], false),
            ([5.0, 2.75], false),
            ([-0.75, 9.0], false),
        ] {
            assert_eq!(is_meant_outside(&file, place), is_meant, "{place:?}");
        }
        assert!(!is_meant_outside(&file, [5.0, 1.0]), "in the box around a plan");
        file.room.y_high.material = "open".to_owned();
        assert!(is_meant_outside(&file, [5.0, 2.75]));
        assert!(!is_meant_outside(&file, [-1.2, 2.75]), "one of the two walls is closed");
        file.room.transmission = true;
        assert!(is_meant_outside(&file, [-1.2, 2.75]) && is_meant_outside(&file, [5.0, 1.0]));
    }
}
