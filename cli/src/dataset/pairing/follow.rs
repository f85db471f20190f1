//! Tracking of people: the best chains through the echoes of all frames.
//!
//! A chain of echoes that follow from each other by range, speed and direction is a tracklet. The best set of tracklets that
//! do not overlap in time is found for the whole recording at once, by dynamic programming: what makes a tracklet begin or
//! end is not decided frame by frame. A second person is looked for among the echoes that the first does not explain, their
//! repeats off the room's walls included.

use glam::DVec3;
use radome_dsp::detect::Detection;

use super::detections::{Detections, Place};
use super::smooth::{Sensor, Smoothed, smooth};

/// A stretch of time in which somebody was followed.
#[derive(Debug, Clone)]
pub struct Tracklet {
    pub places: Vec<Place>,
    pub track: Vec<Smoothed>,
}

impl Tracklet {
    /// First and last frame.
    pub fn frames(&self) -> (usize, usize) {
        (self.places.first().map_or(0, |p| p.0), self.places.last().map_or(0, |p| p.0))
    }
}

/// Frames without an echo within a tracklet last no longer than this, s.
pub const BRIDGE_S: f64 = 1.0;
/// A tracklet has to be worth as much: an echo 20 dB above noise is worth 1.
const LEAST_WORTH: f64 = 6.0;
/// Worth of a decibel beyond that: repeats are weaker than what they repeat.
const STRONGER: f64 = 0.01;
/// Echoes so near to a stronger one, m, lose so much for each decibel, up to so many.
const LIMBS_M: f64 = 0.4;
const LIMB: f64 = 0.06;
const MOST_LIMB_DB: f64 = 25.0;
/// Nobody goes faster along the radar's sight, m/s.
const FASTEST_M_PER_S: f64 = 2.6;
/// Worth of a frame without an echo, within a tracklet.
const MISS: f64 = -0.3;
/// Weight of still people against those who move: their echoes last.
const STILL: f64 = 0.5;
/// Standard differences between two echoes of a chain: range by their speeds (m), speed (m/s and for each second),
/// direction (cosine and for each second).
const RANGE_M: f64 = 0.12;
const SPEED_M_PER_S: [f64; 2] = [0.25, 1.0];
const COSINE: [f64; 2] = [0.15, 0.5];
/// Echoes within this of somebody are theirs, m.
const BODY_M: f64 = 0.55;
/// Echoes so near to where a wall would repeat somebody are that repeat, m and m/s.
const REPEAT_M: f64 = 0.25;
const REPEAT_M_PER_S: f64 = 0.5;
/// Tolerance of the range of a ghost by a piece of wall, m, about the way by its middle.
const MULTIPATH_M: f64 = 0.25;
/// Level above the average that a fading echo reaches for a while, dB: 2 % of a Rayleigh-fading echo lies above.
const FADING_DB: f64 = 6.0;
/// From one point of the walls that is tried to the next, m.
const WALL_STEP_M: f64 = 0.25;

/// Follows up to `people` through the detections.
pub fn follow(detections: &[Detections], people: usize, sensor: &Sensor) -> Vec<Tracklet> {
    let mut free: Vec<Vec<bool>> =
        detections.iter().map(|detected| vec![detected.people > 0; detected.echoes.len()]).collect();
    let mut all: Vec<Tracklet> = Vec::new();
    for person in 0..people {
        let mut chains = best_chains(detections, &free, sensor);
        // The longest first: what walls throw of somebody is told by who that is.
        chains.sort_by_key(|places| std::cmp::Reverse(places.len()));
        for places in chains {
            // A second person is where labels say so, for the better part.
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

/// Whether a track is no person but what a wall throws of somebody: for most of it one and the same piece of wall explains its
/// ranges by where that body was, and its levels too. Who walks behind another, in their shadow, is as weak, but not where
/// a wall is that could throw as much; who stands keeps to the range of a piece of wall, but is louder.
fn is_multipath(track: &[Smoothed], others: &[Tracklet], sensor: &Sensor) -> bool {
    // Of each frame somebody, and by how much what is followed is farther (m) and louder (dB) than they are.
    let mut beside: Vec<(Smoothed, f64, f64)> = Vec::new();
    for state in track {
        for (other, is_followed) in others.iter().filter_map(|other| at(other, state)) {
            let farther_m = sensor.expected(state).range_m - sensor.expected(&other).range_m;
            // Nothing so near is told from the echo of a body itself, where there is one.
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

/// Somebody at the time of a state, and whether they were followed then. Who goes nearer to the radar than echoes are told, or out
/// of its beam, is not gone: for a while they go straight on, as loud on walls as they were, and walls throw of them still.
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

/// Whether an echo is a part of somebody, or a repeat of them off a wall.
fn explains(state: &Smoothed, echo: &Detection, sensor: &Sensor) -> bool {
    let own = sensor.expected(state);
    let differs = |range_m: f64, velocity: f64, most_m: f64, most_m_per_s: f64| {
        (echo.range_m - range_m).abs() > most_m
            || sensor.wrapped(echo.velocity_m_per_s - velocity).abs() > most_m_per_s && !echo.is_still
    };
    // Whose trunk has another speed within arm's reach may be somebody who passes by.
    if !differs(own.range_m, own.velocity_m_per_s, BODY_M, 0.6) {
        return true;
    }
    let place = DVec3::new(state.x, state.y, sensor.trunk_height_m);
    let velocity = DVec3::new(state.vx, state.vy, 0.0);
    sensor.images().any(|(_, image)| {
        let way = place - image;
        let (image_m, image_speed) = (way.length(), velocity.dot(way.normalize_or_zero()));
        // There by the wall and back directly, or both ways by it.
        [0.5, 1.0].iter().any(|share| {
            let range_m = own.range_m + share * (image_m - place.distance(sensor.position));
            let speed = own.velocity_m_per_s * (1.0 - share) + share * image_speed;
            !differs(range_m, speed, REPEAT_M, REPEAT_M_PER_S)
        })
    })
}

/// Predecessor of a chain: an echo before, or nothing, after the best set of tracklets that ended by then.
#[derive(Clone, Copy)]
enum Predecessor {
    Echo(Place),
    Ended(Option<Place>),
}

/// The best tracklets that do not overlap, in order of time.
fn best_chains(detections: &[Detections], free: &[Vec<bool>], sensor: &Sensor) -> Vec<Vec<Place>> {
    let mut best: Vec<Vec<(f64, Predecessor)>> =
        detections.iter().map(|l| Vec::with_capacity(l.echoes.len())).collect();
    // By frame, the best set of tracklets that have ended before it.
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

/// Chains from the last echo back, in order of time.
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

/// Worth of an echo: one that clearly stands out is worth 1, and hardly more if it is stronger: else a chain would change over
/// from whom is far to
/// whom is near where they pass each other. Beside a stronger echo within a body's reach it is worth less: that is the trunk's.
fn worth(echo: &Detection, detected: &Detections) -> f64 {
    let near =
        detected.echoes.iter().filter(|e| (e.range_m - echo.range_m).abs() < LIMBS_M && e.is_still == echo.is_still);
    let weaker_db = near.map(|e| e.snr_db - echo.snr_db).fold(0.0, f64::max);
    let worth =
        (0.3 + 0.1 * (echo.snr_db - 12.0)).min(1.0) + STRONGER * echo.snr_db - LIMB * weaker_db.min(MOST_LIMB_DB);
    if echo.is_still { STILL * worth } else { worth }
}

/// Improbability that one echo follows another, as half a sum of squares.
fn step_cost(a: &Detection, b: &Detection, gap_s: f64, sensor: &Sensor) -> f64 {
    // Speeds may be folded: the one that people can have and that carries the first echo nearest to the second counts.
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

    /// The room of the paper, its radar looking into it level.
    fn sensor() -> Sensor {
        let file = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../fixtures/scenes/room.toml");
        let text =
            std::fs::read_to_string(&file).expect("a scene").replace("tilt_down_deg = 30.0", "tilt_down_deg = 5.0");
        let waveform = Waveform::realise(WaveformRequest::paper()).expect("valid");
        Sensor::new(&Scene::parse(&text, &file).expect("a scene"), &waveform, 1.75).0
    }

    /// Fifty frames of somebody by place at a time, 60 dB over noise 1 m away on the boresight and so much less.
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

    /// Ghost of a walker by a piece of wall, as it is followed: on the boresight, fading by 5 dB to and fro.
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

    /// Past the radar, where nobody is followed, a wall beside it throws of them still. Who comes back from there is somebody.
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
        // A child, 8 dB weaker, who stands; someone in the walker's shadow who follows; someone else there who goes.
        for (name, less_db, speed, at) in
            [("child", 8.0, 0.0, [6.5, 3.1]), ("follows", 16.0, -0.9, [7.5, 3.2]), ("goes", 16.0, 0.8, [4.0, 2.0])]
        {
            let somebody = track(&sensor, |_| less_db, |t| [at[0] + speed * t, at[1]]);
            assert!(!is_multipath(&somebody, &others, &sensor), "{name}");
        }
        assert!(!is_multipath(&others[0].track, &[], &sensor));
    }
}
