//! Script of a person: converts tracklets, way-points and doors to steps of a scene file.
//!
//! The path follows tracklets, and short gaps are bridged. In longer gaps it follows way-points if there are any, or leads
//! through a door if labels show that the person came or went. Way-points take the place of tracked positions from which nobody could
//! walk there. Where a track jumps by a little, the positions beside the jump are left out. Any other gap or jump is an error that
//! names it.

use glam::DVec2;
use radome_sim::scene_file::{DoorFile, RoomFile, SceneFile, StepFile};
use thiserror::Error;

use super::detections::Detections;
use super::smooth::PersonState;
use super::tracking::Tracklet;
use super::way_points::{OUTSIDE_M, WayPoint, WayPoints};

/// Longest gap that is bridged, s.
pub const BRIDGE_S: f64 = 1.5;
/// Longest time of tracked positions that is left out beside a jump, s.
const LEFT_OUT_S: f64 = 0.5;
/// Largest walking speed that is assumed of a person, m/s.
const FASTEST_M_PER_S: f64 = 2.5;
/// Range of speeds in scripts, m/s (sim/src/scene/check.rs).
const SPEEDS_M_PER_S: [f64; 2] = [0.05, 5.0];
/// Distance from a door at which a body counts as in the doorway, m.
const DOORWAY_M: f64 = 0.3;
/// Largest deviation of the steps from the trajectory, m.
const PATH_TOLERANCE_M: f64 = 0.03;
/// Time by which a standing person starts to walk before the script's first time, s. A person who has arrived faces the
/// radar.
const ARRIVAL_S: f64 = 5.0;

/// Position of a person at a time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PathPoint {
    pub time_s: f64,
    pub position: DVec2,
}

/// One person during the whole recording.
#[derive(Debug, Clone, Default)]
pub struct PersonTrack {
    pub tracklets: Vec<Tracklet>,
    pub path: Vec<PathPoint>,
}

/// Error of a script: time without a known position, or positions too far apart for a walk.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum ScriptError {
    /// The person was not tracked, and there are no way-points.
    #[error(
        "person {person} is in the room from {from_s:.2} to {to_s:.2} s by the labels, but was not followed there, and no \
         door is within reach\n\nhint: give way-points for that time with --waypoints FILE.toml: [[person]] with \
         point = [{{ time_s = {from_s:.2}, position_m = [x, y] }}, ...]; the persons are numbered from 1 in the order of the file"
    )]
    Unknown {
        /// Number of the person, from 1.
        person: usize,
        from_s: f64,
        to_s: f64,
    },
    /// Two successive tracked positions lie farther apart than anybody walks.
    #[error(
        "the track of person {person} jumps from {from_m:.1?} m at {from_s:.2} s to {to_m:.1?} m at {to_s:.2} s\n\nhint: say where the \
         person was with --waypoints FILE.toml: [[person]] with point = [{{ time_s = {from_s:.2}, position_m = [x, y] }}, ...], which take \
         the place of tracked positions from which nobody could walk there; the persons are numbered from 1 in the order of the file"
    )]
    Jump { person: usize, from_m: [f64; 2], to_m: [f64; 2], from_s: f64, to_s: f64 },
    /// The person would move faster than scripts allow.
    #[error("person {person} would have to go {speed_m_per_s:.1} m/s from {from_s:.2} to {to_s:.2} s, more than {most} m/s; correct the way-points", most = SPEEDS_M_PER_S[1])]
    TooFast { person: usize, speed_m_per_s: f64, from_s: f64, to_s: f64 },
}

impl ScriptError {
    /// Returns the error by another clock.
    pub fn shifted(mut self, by_s: f64) -> Self {
        let (ScriptError::Unknown { from_s, to_s, .. }
        | ScriptError::Jump { from_s, to_s, .. }
        | ScriptError::TooFast { from_s, to_s, .. }) = &mut self;
        *from_s += by_s;
        *to_s += by_s;
        self
    }

    /// Time without a known position, s; infinite for other errors, which are mended first.
    fn missing_s(&self) -> f64 {
        match self {
            ScriptError::Unknown { from_s, to_s, .. } | ScriptError::Jump { from_s, to_s, .. } => to_s - from_s,
            ScriptError::TooFast { .. } => f64::INFINITY,
        }
    }
}

/// Assigns tracklets to this number of people. Each goes to the person whose predicted position is nearest to its beginning, of those
/// who are not tracked then. If that person could not walk there, it goes to one whose tracklet was there just before and follows a weaker
/// echo from then on, such as a ghost: the rest of that tracklet is left out.
pub fn assign(tracklets: Vec<Tracklet>, people: usize) -> Vec<PersonTrack> {
    let mut tracks = vec![PersonTrack::default(); people];
    for tracklet in tracklets {
        let Some(begin) = tracklet.states.first().copied() else { continue };
        let distance_from = |track: &PersonTrack| -> Option<f64> {
            let Some(last) = track.tracklets.last().and_then(|s| s.states.last()) else { return Some(10.0) };
            let gap_s = begin.time_s - last.time_s;
            let predicted = position(last) + velocity(last) * gap_s.min(1.0);
            (gap_s > 0.0).then(|| predicted.distance(position(&begin)))
        };
        let nearest = tracks
            .iter()
            .enumerate()
            .filter_map(|(person, track)| Some((distance_from(track)?, person)))
            .min_by(|a, b| a.0.total_cmp(&b.0));
        let nearest = nearest.map(|(_, person)| person);
        let comes_from = |person: usize| {
            let last = tracks.get(person).and_then(|track| track.tracklets.last()?.states.last());
            last.is_none_or(|last| could_walk(last, &begin))
        };
        let chosen = if nearest.is_some_and(comes_from) {
            nearest
        } else {
            let is_continued =
                |track: &PersonTrack| track.tracklets.last().is_some_and(|last| is_continued_by(last, &tracklet));
            tracks.iter().position(is_continued).or(nearest)
        };
        let Some(track) = chosen.and_then(|person| tracks.get_mut(person)) else { continue };
        if let Some(before) = track.tracklets.last_mut() {
            let kept = states_before(before, begin.frame);
            before.states.truncate(kept);
            before.echoes.retain(|index| index.frame < begin.frame);
        }
        track.tracklets.push(tracklet);
    }
    tracks
}

/// Number of states of a tracklet up to its last echo before a frame.
fn states_before(tracklet: &Tracklet, frame: usize) -> usize {
    let last = tracklet.states.iter().rposition(|state| state.frame < frame && state.snr_db.is_some());
    last.map_or(0, |last| last + 1)
}

/// Returns whether a tracklet begins where another one was just before, and is stronger than the rest of that one.
fn is_continued_by(before: &Tracklet, after: &Tracklet) -> bool {
    let Some(start) = after.states.first() else { return false };
    let (own, rest) = before.states.split_at(states_before(before, start.frame));
    let level = |states: &[PersonState]| -> f64 { states.iter().filter_map(|state| state.snr_db).sum() };
    own.last().is_some_and(|end| could_walk(end, start)) && level(rest) < level(&after.states)
}

/// Returns whether a person could walk from one tracked position to a later one, if positions beside the jump are left out.
fn could_walk(from: &PersonState, to: &PersonState) -> bool {
    position(from).distance(position(to)) <= FASTEST_M_PER_S * (to.time_s - from.time_s + LEFT_OUT_S)
}

fn position(state: &PersonState) -> DVec2 {
    DVec2::new(state.x, state.y)
}

fn velocity(state: &PersonState) -> DVec2 {
    DVec2::new(state.vx, state.vy)
}

/// Number of other people who are tracked in a frame.
fn tracked_others(tracks: &[PersonTrack], person: usize, frame: usize) -> usize {
    let contains = |s: &Tracklet| (s.frames().0..=s.frames().1).contains(&frame);
    tracks.iter().enumerate().filter(|(i, track)| *i != person && track.tracklets.iter().any(contains)).count()
}

/// Computes the paths of all people. People who were tracked in or beyond a wall that hides them are moved to where the mirror
/// shows their echoes. Paths through a door stay as they are.
///
/// # Errors
/// [`ScriptError::Unknown`] if a person's position is unknown for a time, and [`ScriptError::Jump`] if a track jumps too far; among
/// several people, for the one who is missing longest.
pub fn complete(
    tracks: &mut [PersonTrack],
    detections: &[Detections],
    scene: &SceneFile,
    points: &WayPoints,
) -> Result<(), ScriptError> {
    let size = DVec2::new(scene.room.size_m[0], scene.room.size_m[1]);
    let [low, high] = visible_region(&scene.room);
    let is_visible = |s: &PersonState| position(s).clamp(low, high) == position(s);
    let is_in_doorway = |s: &PersonState| {
        scene.door.iter().any(|door| {
            let (nearest, out) = doorway(door, position(s), size);
            let off = position(s) - nearest;
            off.dot(out) > -DOORWAY_M && off.perp_dot(out).abs() < DOORWAY_M
        })
    };
    for tracklet in tracks.iter_mut().flat_map(|track| &mut track.tracklets) {
        let runs = tracklet.states.chunk_by_mut(|a, b| is_visible(a) == is_visible(b));
        for state in runs.filter(|run| !run.iter().any(is_in_doorway)).flatten() {
            let at = position(state).clamp(low, high);
            (state.x, state.y) = (at.x, at.y);
        }
    }
    let (mut all, mut errors) = (Vec::new(), Vec::new());
    for person in 0..tracks.len() {
        match path(tracks, person, detections, scene, points) {
            Ok(path) => all.push(path),
            Err(error) => errors.push(error),
        }
    }
    if let Some(error) = errors.into_iter().max_by(|a, b| a.missing_s().total_cmp(&b.missing_s())) {
        return Err(error);
    }
    tracks.iter_mut().zip(all).for_each(|(track, path)| track.path = path);
    Ok(())
}

/// Returns the way-points of a person.
fn way_points_of(points: &WayPoints, person: usize) -> Vec<PathPoint> {
    let to_path = |point: &WayPoint| PathPoint { time_s: point.time_s, position: DVec2::from_array(point.position_m) };
    points.person.get(person).map_or(Vec::new(), |person| person.point.iter().map(to_path).collect())
}

/// Runs of successive tracked positions of a person. Way-points take the place of positions from which nobody could walk to them in
/// time, and divide runs.
fn tracked_runs<'a>(track: &'a PersonTrack, given: &[PathPoint]) -> Vec<&'a [PersonState]> {
    let is_kept = |state: &PersonState| {
        given.iter().all(|point| {
            let time_s = (point.time_s - state.time_s).abs();
            position(state).distance(point.position) <= FASTEST_M_PER_S * time_s
        })
    };
    let is_one_run = |a: &PersonState, b: &PersonState| {
        let is_between = |point: &PathPoint| (a.time_s..=b.time_s).contains(&point.time_s);
        is_kept(a) && is_kept(b) && !given.iter().any(is_between)
    };
    let runs = track.tracklets.iter().flat_map(|tracklet| tracklet.states.chunk_by(is_one_run));
    runs.filter(|run| run.first().is_some_and(is_kept)).collect()
}

/// Leaves out positions beside a jump, on its two sides in turn, until a person could walk from one side to the other. The tracker may
/// follow another echo for some frames before it loses a person. `None` if too much would be left out.
fn around_jump<'a>(
    mut before: &'a [PersonState],
    mut after: &'a [PersonState],
) -> Option<(&'a [PersonState], &'a [PersonState])> {
    let jump_s = after.first()?.time_s - before.last()?.time_s;
    for left_out in 0.. {
        let (end, start) = (before.last()?, after.first()?);
        let gap_s = start.time_s - end.time_s;
        if gap_s > BRIDGE_S || gap_s > jump_s + LEFT_OUT_S {
            return None;
        }
        if position(end).distance(position(start)) <= FASTEST_M_PER_S * gap_s {
            break;
        }
        if left_out % 2 == 0 {
            before = before.split_last()?.1;
        } else {
            after = after.split_first()?.1;
        }
    }
    Some((before, after))
}

/// First and last time within an interval at which the labels count only the other people who are tracked, s.
fn absence(
    tracks: &[PersonTrack],
    person: usize,
    detections: &[Detections],
    from_s: f64,
    to_s: f64,
) -> Option<(f64, f64)> {
    let within = detections.iter().enumerate().filter(|(_, l)| l.time_s > from_s && l.time_s < to_s);
    let mut away = within.filter(|(k, l)| l.people <= tracked_others(tracks, person, *k)).map(|(_, l)| l.time_s);
    let first_s = away.next()?;
    Some((first_s, away.next_back().unwrap_or(first_s)))
}

/// Computes the path of a person from tracklets, way-points and doors.
fn path(
    tracks: &[PersonTrack],
    person: usize,
    detections: &[Detections],
    scene: &SceneFile,
    points: &WayPoints,
) -> Result<Vec<PathPoint>, ScriptError> {
    let Some(track) = tracks.get(person) else { return Ok(Vec::new()) };
    let given = way_points_of(points, person);
    let between = |from_s: f64, to_s: f64| -> Vec<PathPoint> {
        given.iter().copied().filter(|k| k.time_s > from_s && k.time_s < to_s).collect()
    };
    let unknown = |from_s: f64, to_s: f64| ScriptError::Unknown { person: person + 1, from_s, to_s };
    let (Some(begin), Some(end)) = (detections.first(), detections.last()) else { return Ok(given) };
    let (begin_s, end_s) = (begin.time_s, end.time_s);
    let ends = |run: &[PersonState]| Some((*run.first()?, *run.last()?));
    let absent = |from_s: f64, to_s: f64| absence(tracks, person, detections, from_s, to_s);
    let mut runs: Vec<&[PersonState]> = Vec::new();
    for mut run in tracked_runs(track, &given) {
        if let Some(before) = runs.last_mut()
            && let (Some((_, end)), Some((start, _))) = (ends(before), ends(run))
            && between(end.time_s, start.time_s).is_empty()
            && absent(end.time_s, start.time_s).is_none()
            && let Some(around) = around_jump(before, run)
        {
            (*before, run) = around;
        }
        runs.push(run);
    }
    let (Some(first), Some(last)) = (runs.first(), runs.last()) else {
        let there = detections.iter().enumerate().filter(|(k, l)| l.people > tracked_others(tracks, person, *k));
        let (from, to) = there.fold((f64::INFINITY, 0.0), |(a, b), (_, l)| (l.time_s.min(a), l.time_s.max(b)));
        // A person without a tracked position is an error only if the labels count that person and there are no way-points.
        return if given.is_empty() && to - from > BRIDGE_S { Err(unknown(from, to)) } else { Ok(given) };
    };
    let mut path: Vec<PathPoint> = Vec::new();
    if let Some((start, _)) = ends(first) {
        path = between(f64::NEG_INFINITY, start.time_s);
        if path.is_empty() {
            let since = absent(begin_s - 1.0, start.time_s).map(|(_, last_s)| last_s);
            let arrival = path_in(&start, since, begin_s, scene);
            path = arrival.ok_or_else(|| unknown(since.unwrap_or(begin_s), start.time_s))?;
        }
    }
    for (i, run) in runs.iter().enumerate() {
        path.extend(run.iter().map(|s| PathPoint { time_s: s.time_s, position: position(s) }));
        let Some(next) = runs.get(i + 1) else { break };
        let (Some((_, end)), Some((start, _))) = (ends(run), ends(next)) else { continue };
        let given = between(end.time_s, start.time_s);
        let gap_s = start.time_s - end.time_s;
        if !given.is_empty() {
            path.extend(given);
        } else if let Some((from_s, to_s)) = absent(end.time_s, start.time_s) {
            path.extend(path_out(&end, Some(from_s), end_s, scene).ok_or_else(|| unknown(end.time_s, from_s))?);
            path.extend(path_in(&start, Some(to_s), begin_s, scene).ok_or_else(|| unknown(to_s, start.time_s))?);
        } else if gap_s > BRIDGE_S {
            return Err(unknown(end.time_s, start.time_s));
        } else if position(&end).distance(position(&start)) > FASTEST_M_PER_S * gap_s {
            let (from_m, to_m) = (position(&end).to_array(), position(&start).to_array());
            return Err(ScriptError::Jump { person: person + 1, from_m, to_m, from_s: end.time_s, to_s: start.time_s });
        }
    }
    if let Some((_, end)) = ends(last) {
        let mut after = between(end.time_s, f64::INFINITY);
        if after.is_empty() {
            let from = absent(end.time_s, end_s + 1.0).map(|(first_s, _)| first_s);
            let exit = path_out(&end, from, end_s, scene);
            after = exit.ok_or_else(|| unknown(end.time_s, from.unwrap_or(end_s)))?;
        }
        path.extend(after);
    }
    // A person who waits outside may return by another door, invisible on the way.
    path.dedup_by(|b, a| b.time_s <= a.time_s + 1e-6);
    Ok(path)
}

/// Path to a person's first tracked position: from a door since the time that the labels give, or straight from the first frame.
fn path_in(start: &PersonState, since: Option<f64>, begin_s: f64, scene: &SceneFile) -> Option<Vec<PathPoint>> {
    let Some(since_s) = since else {
        let lead_s = start.time_s - begin_s;
        return (lead_s <= BRIDGE_S).then(|| extrapolate(start, begin_s, scene));
    };
    Some(path_through_door(start, start.time_s - since_s, -1.0, scene)?.into_iter().rev().collect())
}

/// Path from a person's last tracked position: through a door until the time that the labels give, or straight until the last
/// frame.
fn path_out(end: &PersonState, until: Option<f64>, end_s: f64, scene: &SceneFile) -> Option<Vec<PathPoint>> {
    let Some(until_s) = until else {
        let tail_s = end_s - end.time_s;
        return (tail_s <= BRIDGE_S).then(|| extrapolate(end, end_s, scene));
    };
    path_through_door(end, until_s - end.time_s, 1.0, scene)
}

/// Extrapolates on a straight line to a time, but not through walls. A person beyond a wall that does not hide stays there.
fn extrapolate(state: &PersonState, time_s: f64, scene: &SceneFile) -> Vec<PathPoint> {
    if (time_s - state.time_s).abs() < 1e-6 {
        return Vec::new();
    }
    let (at, [low, high], [least, most]) = (position(state), inside_walls(&scene.room), visible_region(&scene.room));
    let (low, high) = (low.min(at.max(least)), high.max(at.min(most)));
    vec![PathPoint { time_s, position: (at + velocity(state) * (time_s - state.time_s)).clamp(low, high) }]
}

/// Low and high corner of the part of a room in which a body is in no upright wall.
fn inside_walls(room: &RoomFile) -> [DVec2; 2] {
    let size = DVec2::new(room.size_m[0], room.size_m[1]);
    [DVec2::splat(0.2).min(size * 0.5), (size - 0.2).max(size * 0.5)]
}

/// Low and high corner of the region in which no upright wall hides a body; infinite on sides without such a wall.
fn visible_region(room: &RoomFile) -> [DVec2; 2] {
    let ([low, high], [x_low, x_high, y_low, y_high]) = (inside_walls(room), room.hiding_walls());
    let bound = |hides: bool, at_m: f64, else_m: f64| if hides { at_m } else { else_m };
    [
        DVec2::new(bound(x_low, low.x, f64::NEG_INFINITY), bound(y_low, low.y, f64::NEG_INFINITY)),
        DVec2::new(bound(x_high, high.x, f64::INFINITY), bound(y_high, high.y, f64::INFINITY)),
    ]
}

/// Path from a tracked position through the door whose distance fits the time best. `sign` is -1 for a path backwards in time.
/// Without a door, the path leads straight out of the room.
fn path_through_door(state: &PersonState, time_s: f64, sign: f64, scene: &SceneFile) -> Option<Vec<PathPoint>> {
    let (from, usual_speed) = (position(state), velocity(state).length().clamp(0.5, 2.0));
    let size = DVec2::new(scene.room.size_m[0], scene.room.size_m[1]);
    let mut exits: Vec<(DVec2, DVec2)> = scene.door.iter().map(|door| doorway(door, from, size)).collect();
    if exits.is_empty() {
        let on = (velocity(state) * sign).normalize_or((from - 0.5 * size).normalize_or(DVec2::X));
        let out_m = (0..2)
            .map(|i| {
                if on[i] > 0.0 {
                    (size[i] - from[i]) / on[i]
                } else if on[i] < 0.0 {
                    -from[i] / on[i]
                } else {
                    1e9
                }
            })
            .fold(1e9, f64::min);
        exits.push((from + on * out_m.max(0.0), on));
    }
    // The body becomes visible before its middle is in the door.
    let timed = exits.into_iter().filter_map(|(door, out)| {
        let way_m = (door + out * DOORWAY_M).distance(from);
        let speed = way_m / time_s.max(way_m / FASTEST_M_PER_S);
        // The tracked position has the uncertainty of the smoother's estimate.
        let least_m = (way_m - 3.0 * state.sigma_m).max(0.0);
        let is_likely = least_m / time_s < FASTEST_M_PER_S + 1.0 && (speed > 0.3 || time_s < BRIDGE_S);
        is_likely.then_some(((speed / usual_speed).ln().abs(), speed.max(0.3), door, out))
    });
    let (_, speed, door, out) = timed.min_by(|a, b| a.0.total_cmp(&b.0))?;
    // A person who was tracked beyond the door does not come in first.
    let beyond_m = (from - door).dot(out);
    let mut path = Vec::new();
    let (mut time_s, mut at) = (state.time_s, from);
    for (position, is_ahead) in [(door, beyond_m < 0.0), (door + out * OUTSIDE_M, beyond_m < OUTSIDE_M)] {
        if is_ahead {
            time_s += sign * at.distance(position) / speed;
            at = position;
            path.push(PathPoint { time_s, position });
        }
    }
    Some(path)
}

/// Returns the nearest point of a door, and the outward direction.
fn doorway(door: &DoorFile, from: DVec2, size: DVec2) -> (DVec2, DVec2) {
    let [x, y] = door.position_m;
    let room = (0.5 * door.width_m - 0.3).max(0.0);
    if x < 1e-6 || x > size.x - 1e-6 {
        let out = if x < 1e-6 { -DVec2::X } else { DVec2::X };
        (DVec2::new(x, from.y.clamp(y - room, y + room)), out)
    } else {
        let out = if y < 1e-6 { -DVec2::Y } else { DVec2::Y };
        (DVec2::new(from.x.clamp(x - room, x + room), y), out)
    }
}

/// Converts the path of a person to a start time and the steps of a scene file. Times are those of the scene.
///
/// # Errors
/// [`ScriptError::TooFast`] if a person would have to go faster than scripts allow.
pub fn steps(
    person: usize,
    path: &[PathPoint],
    radar: DVec2,
    seated: bool,
) -> Result<Option<(f64, Vec<StepFile>)>, ScriptError> {
    let path = simplified(path);
    let Some(first) = path.first() else { return Ok(None) };
    let walk = |to: DVec2, speed_m_per_s: Option<f64>| StepFile {
        walk_to_m: Some(to.to_array()),
        speed_m_per_s,
        ..StepFile::default()
    };
    // The person starts a little farther away and walks towards the radar, so that a standing person faces it.
    let away = (first.position - radar).normalize_or(DVec2::X);
    let moves =
        |a: &PathPoint, b: &PathPoint| a.position.distance(b.position) >= SPEEDS_M_PER_S[0] * (b.time_s - a.time_s);
    let waits = match path.as_slice() {
        [a, b, ..] => !moves(a, b),
        _ => true,
    };
    let mut steps = Vec::new();
    let mut start_s = first.time_s;
    if waits {
        start_s -= ARRIVAL_S;
        steps.push(walk(first.position + 0.25 * away, None));
        steps.push(walk(first.position, Some(0.25)));
        steps.push(still_step(ARRIVAL_S - 1.0, seated));
    } else {
        steps.push(walk(first.position, None));
    }
    let (mut at, mut now_s) = (first.position, first.time_s);
    for point in path.iter().skip(1) {
        let (way_m, time_s) = (at.distance(point.position), point.time_s - now_s);
        if time_s <= 0.0 {
            continue;
        }
        let speed = way_m / time_s;
        if speed > SPEEDS_M_PER_S[1] {
            let (from_s, to_s) = (now_s, point.time_s);
            return Err(ScriptError::TooFast { person: person + 1, speed_m_per_s: speed, from_s, to_s });
        }
        now_s = point.time_s;
        if speed < SPEEDS_M_PER_S[0] || way_m < 2e-3 {
            match steps.last_mut() {
                Some(StepFile { stand_s: Some(s), .. } | StepFile { sit_s: Some(s), .. }) => *s += time_s,
                _ => steps.push(still_step(time_s, seated)),
            }
        } else {
            steps.push(walk(point.position, Some(speed)));
            at = point.position;
        }
    }
    if seated {
        // A person who sits at the end does not get up.
        if let Some(StepFile { sit_s: Some(s), .. }) = steps.last_mut() {
            *s += ARRIVAL_S;
        }
    }
    Ok(Some((start_s, steps)))
}

fn still_step(time_s: f64, seated: bool) -> StepFile {
    let (sit_s, stand_s) = if seated { (Some(time_s), None) } else { (None, Some(time_s)) };
    StepFile { sit_s, stand_s, ..StepFile::default() }
}

/// Removes points of a path as long as straight walks at constant speed stay within [`PATH_TOLERANCE_M`] of all of them (Ramer,
/// Douglas and Peucker, over time).
fn simplified(path: &[PathPoint]) -> Vec<PathPoint> {
    let [first, .., last] = path else { return path.to_vec() };
    let at = |t: f64| first.position.lerp(last.position, (t - first.time_s) / (last.time_s - first.time_s));
    let off = |k: &PathPoint| k.position.distance(at(k.time_s));
    let farthest = path.iter().enumerate().max_by(|a, b| off(a.1).total_cmp(&off(b.1)));
    match farthest {
        Some((i, point)) if off(point) > PATH_TOLERANCE_M && i > 0 && i + 1 < path.len() => {
            let mut all = simplified(path.get(..=i).unwrap_or_default());
            all.pop();
            all.extend(simplified(path.get(i..).unwrap_or_default()));
            all
        }
        _ => vec![*first, *last],
    }
}

#[cfg(test)]
mod tests {
    use super::super::way_points::WayPointPerson;
    use super::*;

    fn points(all: &[(f64, f64, f64)]) -> Vec<PathPoint> {
        all.iter().map(|&(time_s, x, y)| PathPoint { time_s, position: DVec2::new(x, y) }).collect()
    }

    fn corridor() -> radome_sim::Scene {
        let file = crate::files::fixture("scenes/corridor.toml").expect("a fixture");
        radome_sim::Scene::load(&file).expect("a scene")
    }

    /// Track of a person at these places, one each 0.1 s.
    fn tracklet(places: &[(f64, f64)]) -> Tracklet {
        tracklet_from(0, places)
    }

    /// Track of a person at these places, from a frame on.
    fn tracklet_from(first: usize, places: &[(f64, f64)]) -> Tracklet {
        let state = |(index, &(x, y)): (usize, &(f64, f64))| PersonState {
            frame: first + index,
            time_s: 0.1 * (first + index) as f64,
            x,
            y,
            vx: 1.0,
            vy: 0.0,
            sigma_m: 0.1,
            snr_db: Some(20.0),
            is_visible: true,
        };
        Tracklet { echoes: Vec::new(), states: places.iter().enumerate().map(state).collect() }
    }

    /// Position on the trajectory of a script's steps, at constant speeds and without rounding.
    fn walked(start_s: f64, steps: &[StepFile], time_s: f64) -> DVec2 {
        let mut at = DVec2::from_array(steps[0].walk_to_m.expect("a place"));
        let mut now_s = start_s;
        for step in &steps[1..] {
            let (to, lasts_s) = match (step.walk_to_m, step.stand_s.or(step.sit_s)) {
                (Some(to), _) => {
                    let to = DVec2::from_array(to);
                    (to, to.distance(at) / step.speed_m_per_s.expect("a speed"))
                }
                (_, still) => (at, still.expect("a duration")),
            };
            if time_s < now_s + lasts_s {
                return at.lerp(to, ((time_s - now_s) / lasts_s).max(0.0));
            }
            (at, now_s) = (to, now_s + lasts_s);
        }
        at
    }

    #[test]
    fn few_steps_follow_a_trajectory_in_position_and_time() {
        let path = |t: f64| match t {
            t if t < 3.0 => (5.0 - t, 1.0 + 0.2 * t),
            t if t < 5.0 => (2.0, 1.6),
            t => (2.0 + 0.8 * (t - 5.0), 1.6 - 0.1 * (t - 5.0).powi(2)),
        };
        let all: Vec<(f64, f64, f64)> =
            (0..90).map(|i| f64::from(i) * 0.1).map(|t| (t + 0.032, path(t).0, path(t).1)).collect();
        let knots = points(&all);
        let (start_s, steps) = steps(0, &knots, DVec2::ZERO, false).expect("possible").expect("a script");
        assert!(steps.len() < 12, "{steps:?}");
        assert!(steps.iter().any(|s| s.stand_s.is_some_and(|s| (s - 2.0).abs() < 0.15)), "{steps:?}");
        for point in &knots {
            let off = walked(start_s, &steps, point.time_s).distance(point.position);
            assert!(off < 0.05, "{off} m at {} s: {steps:?}", point.time_s);
        }
    }

    #[test]
    fn a_person_who_stays_in_one_place_faces_the_radar_and_may_sit() {
        let (start_s, steps) = steps(0, &points(&[(0.0, 2.0, 1.0), (10.0, 2.0, 1.01)]), DVec2::new(0.0, 1.0), true)
            .expect("fine")
            .expect("one");
        assert_eq!(start_s, -ARRIVAL_S);
        // The start lies behind the place, seen from the radar.
        assert!(steps[0].walk_to_m.expect("a place")[0] > steps[1].walk_to_m.expect("a place")[0]);
        assert!(steps.last().and_then(|s| s.sit_s) > Some(10.0), "{steps:?}");
    }

    /// A person near the door leaves through it. A person in the door or beyond it does not come back in first.
    #[test]
    fn a_person_who_is_tracked_in_a_door_goes_straight_on() {
        let scene = corridor();
        for (x, places) in [(11.8, 2), (12.2, 1), (12.8, 0)] {
            let state = PersonState { time_s: 3.0, ..tracklet(&[(x, 1.2)]).states[0] };
            let path = path_through_door(&state, 0.5, 1.0, scene.file()).expect("a door");
            assert_eq!(path.len(), places, "{path:?}");
            let mut last = (3.0, x);
            for point in path {
                assert!(point.time_s > last.0 && point.position.x > last.1, "{point:?} {last:?}");
                last = (point.time_s, point.position.x);
            }
        }
    }

    mod hard_cases {
        use super::*;

        /// Regression test: the simulation has no echoes of people in and beyond walls, so the mirror lost people whom the
        /// recording showed beside a wall.
        #[test]
        fn a_person_tracked_in_a_wall_is_moved_into_the_room_unless_it_is_a_door() {
            let scene = corridor();
            let through_a_door = [(11.6, 1.0), (11.9, 1.0), (12.4, 1.1), (13.0, 2.5)];
            for (followed, expected) in [
                ([(5.0, 1.5), (5.1, 1.95), (5.2, 2.4), (5.3, 1.6)], [(5.0, 1.5), (5.1, 1.8), (5.2, 1.8), (5.3, 1.6)]),
                (through_a_door, through_a_door),
            ] {
                assert_eq!(completed(&followed, scene.file()), expected);
            }
        }

        /// Regression test: a person who walked beyond an open wall was moved into the room.
        #[test]
        fn a_person_beyond_a_wall_that_does_not_hide_stays_there() {
            let scene = corridor();
            let (mut open, mut thin, mut rays) = (scene.file().clone(), scene.file().clone(), scene.file().clone());
            open.room.y_high.material = "open".to_owned();
            thin.room.transmission = true;
            rays.room.solver = Some(radome_sim::scene_file::SolverFile::Rays);
            let followed = [(5.0, 1.5), (5.1, 2.4), (5.2, -0.4)];
            assert_eq!(completed(&followed, &open), [(5.0, 1.5), (5.1, 2.4), (5.2, 0.2)]);
            assert_eq!(completed(&followed, &thin), followed);
            assert_eq!(completed(&followed, &rays), followed);
            let state = tracklet(&[(5.1, 2.4)]).states[0];
            assert_eq!(extrapolate(&state, 1.0, &open)[0].position, DVec2::new(6.1, 2.4));
            assert_eq!(extrapolate(&state, 1.0, scene.file())[0].position, DVec2::new(6.1, 1.8));
        }

        /// Positions in the mirror of a person who was tracked at these positions.
        fn completed(followed: &[(f64, f64)], scene: &SceneFile) -> Vec<(f64, f64)> {
            let mut tracks = [PersonTrack { tracklets: vec![tracklet(followed)], path: Vec::new() }];
            complete(&mut tracks, &[], scene, &WayPoints::default()).expect("no way-points");
            tracks[0].tracklets[0].states.iter().map(|s| (s.x, s.y)).collect()
        }

        /// The first person is missing for the last three seconds, the second one all the time.
        #[test]
        fn the_person_who_is_missing_longest_is_named() {
            let frame = |frame: i32| Detections { time_s: 0.1 * f64::from(frame), people: 2, echoes: Vec::new() };
            let detections: Vec<Detections> = (0..60).map(frame).collect();
            let followed = PersonTrack { tracklets: vec![tracklet(&[(5.0, 1.0); 30])], path: Vec::new() };
            let complete = |mut tracks: [PersonTrack; 2]| {
                complete(&mut tracks, &detections, corridor().file(), &WayPoints::default())
            };
            for (tracks, missing) in
                [([followed.clone(), PersonTrack::default()], 2), ([PersonTrack::default(), followed], 1)]
            {
                let error = complete(tracks).expect_err("nobody knows where they are");
                assert!(matches!(error, ScriptError::Unknown { person, .. } if person == missing), "{error}");
            }
        }

        /// Regression test: two people walk one behind the other. When the first one was lost, the tracker went on with the second one
        /// in a new tracklet, and the second one's own tracklet went on with a ghost. So the new one went to the first person, 3 m away.
        #[test]
        fn a_tracklet_goes_to_the_person_who_was_there_just_before() {
            let walk = |first: usize, frames: usize, from_m: f64| {
                let place = |index: usize| (from_m - 0.16 * index as f64, 1.0);
                tracklet_from(first, &(0..frames).map(place).collect::<Vec<_>>())
            };
            let assigned = |ghost_db: f64| {
                let mut second = walk(0, 50, 10.0);
                for state in &mut second.states[40..] {
                    (state.x, state.snr_db) = (2.7, Some(ghost_db));
                }
                let tracks = assign(vec![walk(0, 40, 7.0), second, walk(40, 20, 3.6)], 2);
                tracks
                    .iter()
                    .map(|track| track.tracklets.iter().map(|t| t.states.len()).collect())
                    .collect::<Vec<Vec<_>>>()
            };
            assert_eq!(assigned(15.0), [vec![40], vec![40, 20]]);
            // A stronger echo is no ghost.
            assert_eq!(assigned(50.0), [vec![40, 20], vec![50]]);
        }

        /// Path of a person who walks at 1 m/s for 4 s, with these way-points. The track jumps ahead after 2 s.
        fn path_with_jump(jump_m: f64, points: &[WayPoint]) -> Result<Vec<PathPoint>, ScriptError> {
            let walk = |from: usize, ahead_m: f64| {
                let place = |frame: usize| (4.0 + 0.1 * frame as f64 + ahead_m, 1.0);
                tracklet_from(from, &(from..from + 20).map(place).collect::<Vec<_>>())
            };
            let mut tracks = [PersonTrack { tracklets: vec![walk(0, 0.0), walk(20, jump_m)], path: Vec::new() }];
            let frame = |frame: i32| Detections { time_s: 0.1 * f64::from(frame), people: 1, echoes: Vec::new() };
            let detections: Vec<Detections> = (0..40).map(frame).collect();
            let points = WayPoints { person: vec![WayPointPerson { point: points.to_vec() }] };
            complete(&mut tracks, &detections, corridor().file(), &points)?;
            let [PersonTrack { path, .. }] = tracks;
            let is_walk = |two: &[PathPoint]| {
                let speed = two[0].position.distance(two[1].position) / (two[1].time_s - two[0].time_s);
                speed <= FASTEST_M_PER_S + 1e-9
            };
            assert!(path.windows(2).all(is_walk), "{path:?}");
            Ok(path)
        }

        /// Regression test: a track that jumped from one frame to the next could not be mirrored.
        #[test]
        fn a_little_jump_of_a_track_is_walked() {
            let path = path_with_jump(0.5, &[]).expect("0.5 m at 2.5 m/s");
            assert_eq!((path.len(), path[0].position.x), (37, 4.0), "{path:?}");
            assert_eq!(path[36].position.x, 4.0 + 0.1 * 39.0 + 0.5);
        }

        /// Regression test: no way-point changed anything where a person was followed, and one at the time of the message was left out,
        /// since that is rounded.
        #[test]
        fn way_points_take_the_place_of_a_track_that_jumps() {
            let error = path_with_jump(3.0, &[]).expect_err("3 m");
            let said = error.clone().shifted(10.0).to_string();
            assert!(matches!(error, ScriptError::Jump { person: 1, .. }), "{error}");
            assert!(said.contains("jumps from [5.9, 1.0] m at 11.90 s to [9.0, 1.0] m at 12.00 s"), "{said}");
            assert!(said.contains("--waypoints") && said.contains("time_s = 11.90"), "{said}");

            let points = [(1.9, 5.9), (3.0, 7.4)].map(|(time_s, x)| WayPoint { time_s, position_m: [x, 1.0] });
            let path = path_with_jump(3.0, &points).expect("the rest is left out");
            let last = path.last().expect("points");
            assert_eq!((last.time_s, last.position), (3.0, DVec2::new(7.4, 1.0)));
            assert!(path.iter().any(|point| (point.time_s - 1.9).abs() < 1e-9 && point.position.x == 5.9), "{path:?}");
        }

        #[test]
        fn a_speed_above_that_of_scripts_is_an_error() {
            let error = steps(1, &points(&[(0.0, 0.0, 0.0), (1.0, 9.0, 0.0)]), DVec2::ZERO, false).expect_err("9 m/s");
            assert!(matches!(error, ScriptError::TooFast { person: 2, .. }), "{error}");
            assert!(error.to_string().contains("9.0 m/s from 0.00 to 1.00 s"), "{error}");
            assert!(matches!(steps(0, &[], DVec2::ZERO, false), Ok(None)));
        }
    }
}
