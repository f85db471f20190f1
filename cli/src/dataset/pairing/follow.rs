//! Tracking of people: the best sequences of echoes through all frames.
//!
//! A tracklet is a sequence of echoes that are consistent in range, speed and direction. Dynamic programming finds the
//! best set of tracklets that do not overlap in time, for the whole recording at once. The beginning and the end of a
//! tracklet are thus not decided frame by frame. A second person is searched for among the echoes that the first does
//! not explain, whose ghosts off the room's walls count as explained.

use glam::DVec3;
use radome_dsp::detect::Detection;

use super::detections::{Detections, Place};
use super::smooth::{Sensor, Smoothed, smooth};

/// Time interval in which a person was tracked.
#[derive(Debug, Clone)]
pub struct Tracklet {
    pub places: Vec<Place>,
    pub track: Vec<Smoothed>,
}

impl Tracklet {
    /// Returns the first and the last frame.
    pub fn frames(&self) -> (usize, usize) {
        (self.places.first().map_or(0, |p| p.0), self.places.last().map_or(0, |p| p.0))
    }
}

/// Longest time without an echo within a tracklet, s.
pub const BRIDGE_S: f64 = 1.0;
/// Least score of a tracklet; an echo 20 dB above noise scores 1.
const LEAST_WORTH: f64 = 6.0;
/// Additional score per decibel: ghosts are weaker than the direct echo.
const STRONGER: f64 = 0.01;
/// Distance to a stronger echo, m, within which an echo loses score; loss per decibel; and the largest counted
/// difference, dB.
const LIMBS_M: f64 = 0.4;
const LIMB: f64 = 0.06;
const MOST_LIMB_DB: f64 = 25.0;
/// Largest radial speed of a person, m/s.
const FASTEST_M_PER_S: f64 = 2.6;
/// Score of a frame without an echo, within a tracklet.
const MISS: f64 = -0.3;
/// Weight of still echoes relative to moving ones, since still echoes persist.
const STILL: f64 = 0.5;
/// Standard deviations of the difference between two successive echoes: range predicted by their speeds (m), speed
/// (m/s, and for each second), direction (cosine, and for each second).
const RANGE_M: f64 = 0.12;
const SPEED_M_PER_S: [f64; 2] = [0.25, 1.0];
const COSINE: [f64; 2] = [0.15, 0.5];
/// Distance within which echoes belong to a person, m.
const BODY_M: f64 = 0.55;
/// Tolerances within which an echo is the ghost of a person off a wall, m and m/s.
const REPEAT_M: f64 = 0.25;
const REPEAT_M_PER_S: f64 = 0.5;
/// Tolerance of the range of a ghost off a piece of wall, m, relative to the path via the middle of the piece.
const MULTIPATH_M: f64 = 0.25;
/// Level above the average that a fading echo reaches temporarily, dB: 2 % of a Rayleigh-fading echo lies above.
const FADING_DB: f64 = 6.0;
/// Spacing of the points of the walls that are tried, m.
const WALL_STEP_M: f64 = 0.25;

/// Tracks up to `people` people through the detections.
pub fn follow(detections: &[Detections], people: usize, sensor: &Sensor) -> Vec<Tracklet> {
    let mut free: Vec<Vec<bool>> =
        detections.iter().map(|detected| vec![detected.people > 0; detected.echoes.len()]).collect();
    let mut all: Vec<Tracklet> = Vec::new();
    for person in 0..people {
        let mut chains = best_chains(detections, &free, sensor);
        // The longest tracklets come first: a ghost off a wall can only be recognised once its person is known.
        chains.sort_by_key(|places| std::cmp::Reverse(places.len()));
        for places in chains {
            // A second person is accepted only where labels count one for at least half of the echoes.
            let counted =
                places.iter().filter(|p| detections.get(p.0).is_some_and(|detected| detected.people > person)).count();
            if 2 * counted < places.len() {
                continue;
            }
            let track = smooth(detections, &places, sensor);
            if is_multipath(&track, &all, sensor) {
                continue;
            }
            for state in &track {
                let Some((detected, free)) = detections.get(state.frame).zip(free.get_mut(state.frame)) else {
                    continue;
                };
                for (echo, free) in detected.echoes.iter().zip(free) {
                    *free &= !explains(state, echo, sensor);
                }
            }
            all.push(Tracklet { places, track });
        }
    }
    all.sort_by_key(|tracklet| tracklet.frames());
    all
}

/// Returns whether a track is the multipath ghost of a person. For most of the track, one piece of wall must explain
/// its ranges from the person's positions, and its levels. A person in another's shadow is as weak as a ghost, but is
/// not near a wall that could reflect as much. A standing person stays at the range of a piece of wall, but is louder.
fn is_multipath(track: &[Smoothed], others: &[Tracklet], sensor: &Sensor) -> bool {
    // For each frame a person, with the additional range (m) and the relative level (dB) of the track.
    let mut beside: Vec<(Smoothed, f64, f64)> = Vec::new();
    for state in track {
        for (other, is_followed) in others.iter().filter_map(|other| at(other, state)) {
            let farther_m = sensor.expected(state).range_m - sensor.expected(&other).range_m;
            // A ghost closer than this cannot be told from the echo of the body itself, where there is one.
            let least_m = if is_followed { BODY_M } else { MULTIPATH_M };
            if let (Some(own_db), Some(other_db), true) = (state.snr_db, other.snr_db, farther_m > least_m) {
                beside.push((other, farther_m, own_db - other_db));
            }
        }
    }
    let seen = track.iter().filter(|state| state.snr_db.is_some()).count();
    let is_most = |count: usize| 2 * count > seen;
    is_most(beside.len())
        && sensor.wall_pieces(WALL_STEP_M).any(|piece| {
            let is_explained = |(other, farther_m, louder_db): &&(Smoothed, f64, f64)| {
                let multipath = sensor.multipath(other, &piece);
                (multipath.farther_m - farther_m).abs() < MULTIPATH_M && *louder_db < multipath.louder_db + FADING_DB
            };
            is_most(beside.iter().filter(is_explained).count())
        })
}

/// Returns a person at the time of a state, and whether the person was tracked then. People who are too close to the
/// radar or outside its beam are extrapolated on a straight line for a while: walls still reflect their echoes.
fn at(tracklet: &Tracklet, state: &Smoothed) -> Option<(Smoothed, bool)> {
    let (first, last) = (tracklet.track.first()?, tracklet.track.last()?);
    if (first.frame..=last.frame).contains(&state.frame) {
        return tracklet.track.get(state.frame - first.frame).map(|followed| (*followed, true));
    }
    let end = if state.frame < first.frame { first } else { last };
    let later_s = state.time_s - end.time_s;
    let on = Smoothed { x: end.x + end.vx * later_s, y: end.y + end.vy * later_s, ..*end };
    (later_s.abs() <= BRIDGE_S).then_some((on, false))
}

/// Returns whether an echo is a part of a person, or the person's ghost off a wall.
fn explains(state: &Smoothed, echo: &Detection, sensor: &Sensor) -> bool {
    let own = sensor.expected(state);
    let differs = |range_m: f64, velocity: f64, most_m: f64, most_m_per_s: f64| {
        (echo.range_m - range_m).abs() > most_m
            || sensor.wrapped(echo.velocity_m_per_s - velocity).abs() > most_m_per_s && !echo.is_still
    };
    // An echo within arm's reach but with another speed than the trunk's may be a person passing by.
    if !differs(own.range_m, own.velocity_m_per_s, BODY_M, 0.6) {
        return true;
    }
    let place = DVec3::new(state.x, state.y, sensor.trunk_height_m);
    let velocity = DVec3::new(state.vx, state.vy, 0.0);
    sensor.images().any(|(_, image)| {
        let way = place - image;
        let (image_m, image_speed) = (way.length(), velocity.dot(way.normalize_or_zero()));
        // Paths via the wall in one direction, or in both.
        [0.5, 1.0].iter().any(|share| {
            let range_m = own.range_m + share * (image_m - place.distance(sensor.position));
            let speed = own.velocity_m_per_s * (1.0 - share) + share * image_speed;
            !differs(range_m, speed, REPEAT_M, REPEAT_M_PER_S)
        })
    })
}

/// Predecessor of an echo: an earlier echo, or the best set of tracklets that ended before.
#[derive(Clone, Copy)]
enum Predecessor {
    Echo(Place),
    Ended(Option<Place>),
}

/// Finds the best tracklets that do not overlap, in order of time.
fn best_chains(detections: &[Detections], free: &[Vec<bool>], sensor: &Sensor) -> Vec<Vec<Place>> {
    let mut best: Vec<Vec<(f64, Predecessor)>> =
        detections.iter().map(|l| Vec::with_capacity(l.echoes.len())).collect();
    // For each frame, the best set of tracklets that have ended before it.
    let mut ended: Vec<(f64, Option<Place>)> = vec![(0.0, None)];
    for (k, detected) in detections.iter().enumerate() {
        let before = ended.last().copied().unwrap_or((0.0, None));
        let mut now = before;
        for (i, echo) in detected.echoes.iter().enumerate() {
            if !free.get(k).and_then(|f| f.get(i)).is_some_and(|f| *f) {
                if let Some(row) = best.get_mut(k) {
                    row.push((f64::NEG_INFINITY, Predecessor::Ended(None)));
                }
                continue;
            }
            let mut reached = (before.0 - LEAST_WORTH, Predecessor::Ended(before.1));
            for (j, earlier) in detections.iter().enumerate().take(k).rev() {
                let gap_s = detected.time_s - earlier.time_s;
                if gap_s > BRIDGE_S {
                    break;
                }
                let missed = MISS * (k - j - 1) as f64;
                for (n, (other, (score, _))) in earlier.echoes.iter().zip(best.get(j).into_iter().flatten()).enumerate()
                {
                    let score = score + missed - step_cost(other, echo, gap_s, sensor);
                    if score > reached.0 {
                        reached = (score, Predecessor::Echo((j, n)));
                    }
                }
            }
            let score = reached.0 + worth(echo, detected);
            if let Some(row) = best.get_mut(k) {
                row.push((score, reached.1));
            }
            if score > now.0 {
                now = (score, Some((k, i)));
            }
        }
        ended.push(now);
    }
    unrolled(&best, ended.last().and_then(|e| e.1))
}

/// Traces the tracklets back from the last echo; returns them in order of time.
fn unrolled(best: &[Vec<(f64, Predecessor)>], last: Option<Place>) -> Vec<Vec<Place>> {
    let mut chains = Vec::new();
    let mut at = last;
    let mut chain = Vec::new();
    while let Some(place) = at {
        chain.push(place);
        at = match best.get(place.0).and_then(|row| row.get(place.1)).map(|b| b.1) {
            Some(Predecessor::Echo(earlier)) => Some(earlier),
            Some(Predecessor::Ended(earlier)) => {
                chain.reverse();
                chains.push(std::mem::take(&mut chain));
                earlier
            }
            None => None,
        };
    }
    chains.reverse();
    chains
}

/// Score of an echo. One that clearly stands out scores 1, and a stronger one hardly more. Otherwise a tracklet would
/// change from the far to the near person where they pass each other. Near a stronger echo, within a body's reach, the
/// score is lower, since that echo is the trunk's.
fn worth(echo: &Detection, detected: &Detections) -> f64 {
    let near =
        detected.echoes.iter().filter(|e| (e.range_m - echo.range_m).abs() < LIMBS_M && e.is_still == echo.is_still);
    let weaker_db = near.map(|e| e.snr_db - echo.snr_db).fold(0.0, f64::max);
    let worth =
        (0.3 + 0.1 * (echo.snr_db - 12.0)).min(1.0) + STRONGER * echo.snr_db - LIMB * weaker_db.min(MOST_LIMB_DB);
    if echo.is_still { STILL * worth } else { worth }
}

/// Cost of one echo following another: half a sum of squares.
fn step_cost(a: &Detection, b: &Detection, gap_s: f64, sensor: &Sensor) -> f64 {
    // Speeds may be aliased. Of those that people can reach, the one that predicts the second echo best from the first
    // counts.
    let span = sensor.span_m_per_s;
    let half = 0.5 * sensor.wrapped(b.velocity_m_per_s - a.velocity_m_per_s);
    let moved = b.range_m - a.range_m;
    let folds = (FASTEST_M_PER_S / span).ceil().min(20.0) as i32;
    let middle = (-folds..=folds)
        .map(|fold| a.velocity_m_per_s + half + span * f64::from(fold))
        .filter(|speed| speed.abs() <= FASTEST_M_PER_S)
        .min_by(|x, y| (moved - x * gap_s).abs().total_cmp(&(moved - y * gap_s).abs()))
        .unwrap_or(a.velocity_m_per_s);
    let range = (moved - middle * gap_s) / (RANGE_M + 0.3 * gap_s);
    let speed = sensor.wrapped(b.velocity_m_per_s - a.velocity_m_per_s) / (SPEED_M_PER_S[0] + SPEED_M_PER_S[1] * gap_s);
    let cosine = match (a.cosines.first(), b.cosines.first()) {
        (Some(Some(a)), Some(Some(b))) => (b - a) / (COSINE[0] + COSINE[1] * gap_s),
        _ => 0.0,
    };
    0.5 * (range * range + speed * speed + cosine * cosine)
}

#[cfg(test)]
mod tests {
    use radome_dsp::{Waveform, WaveformRequest};
    use radome_sim::Scene;

    use super::*;

    /// Room of the paper, with a horizontal radar.
    fn sensor() -> Sensor {
        let file = crate::files::fixture("scenes/room.toml").expect("a fixture");
        let text =
            std::fs::read_to_string(&file).expect("a scene").replace("tilt_down_deg = 30.0", "tilt_down_deg = 5.0");
        let waveform = Waveform::realise(WaveformRequest::paper()).expect("valid");
        Sensor::new(&Scene::parse(&text, &file).expect("a scene"), &waveform, 1.75).0
    }

    /// Fifty frames of a person whose position is a function of time, 60 dB over noise at 1 m on the boresight, reduced
    /// by `less_db`.
    fn track(sensor: &Sensor, less_db: impl Fn(usize) -> f64, at: impl Fn(f64) -> [f64; 2]) -> Vec<Smoothed> {
        let state = |frame: usize| {
            let time_s = 0.1 * frame as f64;
            let ([x, y], [later_x, later_y]) = (at(time_s), at(time_s + 0.01));
            let (vx, vy) = ((later_x - x) / 0.01, (later_y - y) / 0.01);
            let mut state = Smoothed { frame, time_s, x, y, vx, vy, sigma_m: 0.0, snr_db: None, is_visible: true };
            state.snr_db = Some(60.0 - 40.0 * sensor.expected(&state).range_m.log10() - less_db(frame));
            state
        };
        (0..50).map(state).collect()
    }

    fn walker(sensor: &Sensor, at: impl Fn(f64) -> [f64; 2]) -> [Tracklet; 1] {
        [Tracklet { places: Vec::new(), track: track(sensor, |_| 0.0, at) }]
    }

    /// The ghost of a walker off a piece of wall, as tracked: on the boresight, fading by 5 dB up and down.
    #[test]
    fn what_a_wall_throws_of_a_walker_is_nobody() {
        let sensor = sensor();
        for walker in [walker(&sensor, |t| [6.0 - 0.9 * t, 3.2]), walker(&sensor, |t| [1.5 + 0.9 * t, 2.6])] {
            let pieces = [
                (DVec3::new(6.1, 3.1, 0.0), DVec3::Z),
                (DVec3::new(5.2, 2.2, 2.7), -DVec3::Z),
                (DVec3::new(8.0, 2.6, 0.7), -DVec3::X),
            ];
            for piece in pieces {
                let of = |frame: usize| sensor.multipath(&walker[0].track[frame], &piece);
                let range = |frame: usize| sensor.expected(&walker[0].track[frame]).range_m + of(frame).farther_m;
                let at = |t: f64| [sensor.position.x + range(((10.0 * t) as usize).min(49)) + 0.115, sensor.position.y];
                let mut ghost = track(&sensor, |_| 0.0, at);
                for (frame, state) in ghost.iter_mut().enumerate() {
                    let fading_db = 5.0 * (0.7 * frame as f64).sin();
                    state.snr_db = walker[0].track[frame].snr_db.map(|db| db + of(frame).louder_db + fading_db);
                }
                assert!(is_multipath(&ghost, &walker, &sensor), "{piece:?}");
            }
        }
    }

    /// Near the radar, where nobody is tracked, a wall beside it still reflects a person. A track that comes back from
    /// there is a person.
    #[test]
    fn what_a_wall_throws_of_who_was_followed_just_before_is_nobody() {
        let sensor = sensor();
        let mut walker = walker(&sensor, |t| [6.0 - 1.2 * t, 3.3]);
        let piece = (DVec3::new(0.6, 3.5, 2.7), -DVec3::Z);
        let whole = walker[0].track.split_off(46);
        let level = walker[0].track[45].snr_db;
        let mut ghost: Vec<Smoothed> = whole;
        for state in &mut ghost {
            let multipath = sensor.multipath(state, &piece);
            let range_m = sensor.expected(state).range_m + multipath.farther_m;
            let (x, y) = (sensor.position.x + range_m + 0.115, sensor.position.y);
            *state = Smoothed { x, y, vx: 0.0, vy: 0.0, snr_db: level.map(|db| db + multipath.louder_db), ..*state };
        }
        assert!(is_multipath(&ghost, &walker, &sensor));
        let back = track(&sensor, |_| 0.0, |t| [0.7 + 1.2 * (t - 4.6), 3.3]);
        assert!(!is_multipath(&back[46..], &walker, &sensor));
    }

    #[test]
    fn whoever_is_as_loud_as_a_person_or_goes_their_own_way_is_somebody() {
        let sensor = sensor();
        let others = walker(&sensor, |t| [6.0 - 0.9 * t, 3.2]);
        // Three people who are not ghosts: a standing child, 8 dB weaker; a follower in the walker's shadow; another
        // person there who walks.
        for (name, less_db, speed, at) in
            [("child", 8.0, 0.0, [6.5, 3.1]), ("follows", 16.0, -0.9, [7.5, 3.2]), ("goes", 16.0, 0.8, [4.0, 2.0])]
        {
            let somebody = track(&sensor, |_| less_db, |t| [at[0] + speed * t, at[1]]);
            assert!(!is_multipath(&somebody, &others, &sensor), "{name}");
        }
        assert!(!is_multipath(&others[0].track, &[], &sensor));
    }
}
