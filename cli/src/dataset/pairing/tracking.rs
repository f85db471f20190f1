//! Tracking of people: the best sequences of echoes through all frames.
//!
//! A tracklet is a sequence of echoes that are consistent in range, speed and direction. Dynamic programming finds the
//! best set of tracklets that do not overlap in time, for the whole recording at once. The beginning and the end of a
//! tracklet are thus not decided frame by frame. A second person is searched for among the echoes that are neither from the
//! first person nor ghosts of that person off the room's walls.

use glam::DVec3;
use radome_dsp::detect::Detection;

use super::detections::{Detections, EchoIndex};
use super::smooth::{PersonState, Sensor, smooth};

/// Time interval in which a person was tracked.
#[derive(Debug, Clone)]
pub struct Tracklet {
    /// Echoes of the person, in order of time.
    pub echoes: Vec<EchoIndex>,
    /// State of the person in each frame from the first echo to the last.
    pub states: Vec<PersonState>,
}

impl Tracklet {
    /// Returns the first and the last frame.
    pub fn frames(&self) -> (usize, usize) {
        (self.echoes.first().map_or(0, |index| index.frame), self.echoes.last().map_or(0, |index| index.frame))
    }
}

/// Longest time without an echo within a tracklet, s.
pub const BRIDGE_S: f64 = 1.0;
/// Least score of a tracklet; an echo 20 dB above noise scores 1.
const LEAST_SCORE: f64 = 6.0;
/// Additional score per decibel: ghosts are weaker than the direct echo.
const SCORE_PER_DB: f64 = 0.01;
/// Distance to a stronger echo, m, within which an echo loses score; loss per decibel; and the largest counted
/// difference, dB.
const BODY_REACH_M: f64 = 0.4;
const LOSS_PER_DB: f64 = 0.06;
const MOST_LOSS_DB: f64 = 25.0;
/// Largest radial speed of a person, m/s.
const FASTEST_M_PER_S: f64 = 2.6;
/// Score of a frame without an echo, within a tracklet.
const MISSED_SCORE: f64 = -0.3;
/// Weight of still echoes relative to moving ones, since still echoes persist.
const STILL_WEIGHT: f64 = 0.5;
/// Standard deviations of the difference between two successive echoes: range predicted by their speeds (m), speed
/// (m/s, and for each second), direction (cosine, and for each second).
const RANGE_M: f64 = 0.12;
const SPEED_M_PER_S: [f64; 2] = [0.25, 1.0];
const COSINE: [f64; 2] = [0.15, 0.5];
/// Distance within which echoes belong to a person, m.
const BODY_M: f64 = 0.55;
/// Tolerances within which an echo is the ghost of a person off a wall, m and m/s.
const GHOST_M: f64 = 0.25;
const GHOST_M_PER_S: f64 = 0.5;
/// Tolerance of the range of a ghost off a piece of wall, m, relative to the path via the middle of the piece.
const MULTIPATH_M: f64 = 0.25;
/// Level above the average that a fading echo reaches temporarily, dB: 2 % of a Rayleigh-fading echo lies above.
const FADING_DB: f64 = 6.0;
/// Spacing of the points of the walls that are tried, m.
const WALL_STEP_M: f64 = 0.25;

/// Tracks up to `people` people through the detections.
pub fn track_people(detections: &[Detections], people: usize, sensor: &Sensor) -> Vec<Tracklet> {
    let mut available: Vec<Vec<bool>> =
        detections.iter().map(|detected| vec![detected.people > 0; detected.echoes.len()]).collect();
    let mut all: Vec<Tracklet> = Vec::new();
    for person in 0..people {
        let mut sequences = best_sequences(detections, &available, sensor);
        // The longest tracklets come first: a ghost off a wall can only be recognised once its person is known.
        sequences.sort_by_key(|echoes| std::cmp::Reverse(echoes.len()));
        for echoes in sequences {
            // A second person is accepted only where labels count one for at least half of the echoes.
            let is_counted =
                |index: &&EchoIndex| detections.get(index.frame).is_some_and(|detected| detected.people > person);
            if 2 * echoes.iter().filter(is_counted).count() < echoes.len() {
                continue;
            }
            let states = smooth(detections, &echoes, sensor);
            if is_multipath(&states, &all, sensor) {
                continue;
            }
            for state in &states {
                let Some((detected, available)) = detections.get(state.frame).zip(available.get_mut(state.frame))
                else {
                    continue;
                };
                for (echo, available) in detected.echoes.iter().zip(available) {
                    *available &= !belongs_to(state, echo, sensor);
                }
            }
            all.push(Tracklet { echoes, states });
        }
    }
    all.sort_by_key(|tracklet| tracklet.frames());
    all
}

/// Frame in which a track may be the ghost of a person.
struct GhostCandidate {
    person: PersonState,
    /// Range of the track beyond that of the person, m.
    farther_m: f64,
    /// Level of the track relative to that of the person, dB.
    louder_db: f64,
}

/// Returns whether a track is the multipath ghost of a person: for most of the track, reflection at one piece of wall explains
/// its ranges and its levels. A person in another's shadow is as weak as a ghost, but not near a wall that could reflect as
/// much. A standing person may have the range of a ghost, but is stronger.
fn is_multipath(track: &[PersonState], others: &[Tracklet], sensor: &Sensor) -> bool {
    let mut candidates: Vec<GhostCandidate> = Vec::new();
    for state in track {
        for (other, is_tracked) in others.iter().filter_map(|other| person_at(other, state)) {
            let farther_m = sensor.expected(state).range_m - sensor.expected(&other).range_m;
            // A ghost closer than this cannot be distinguished from the echo of the body itself, where there is one.
            let least_m = if is_tracked { BODY_M } else { MULTIPATH_M };
            if let (Some(own_db), Some(other_db), true) = (state.snr_db, other.snr_db, farther_m > least_m) {
                candidates.push(GhostCandidate { person: other, farther_m, louder_db: own_db - other_db });
            }
        }
    }
    let echoes = track.iter().filter(|state| state.snr_db.is_some()).count();
    let is_most = |count: usize| 2 * count > echoes;
    is_most(candidates.len())
        && sensor.wall_pieces(WALL_STEP_M).any(|piece| {
            let is_explained = |candidate: &&GhostCandidate| {
                let multipath = sensor.multipath(&candidate.person, &piece);
                (multipath.farther_m - candidate.farther_m).abs() < MULTIPATH_M
                    && candidate.louder_db < multipath.louder_db + FADING_DB
            };
            is_most(candidates.iter().filter(is_explained).count())
        })
}

/// Returns a person at the time of a state, and whether the person was tracked then. People who are too close to the
/// radar or outside its beam are extrapolated on a straight line for a while: walls still reflect their echoes.
fn person_at(tracklet: &Tracklet, state: &PersonState) -> Option<(PersonState, bool)> {
    let (first, last) = (tracklet.states.first()?, tracklet.states.last()?);
    if (first.frame..=last.frame).contains(&state.frame) {
        return tracklet.states.get(state.frame - first.frame).map(|state| (*state, true));
    }
    let end = if state.frame < first.frame { first } else { last };
    let later_s = state.time_s - end.time_s;
    let extrapolated = PersonState { x: end.x + end.vx * later_s, y: end.y + end.vy * later_s, ..*end };
    (later_s.abs() <= BRIDGE_S).then_some((extrapolated, false))
}

/// Returns whether an echo is a part of a person, or the person's ghost off a wall.
fn belongs_to(state: &PersonState, echo: &Detection, sensor: &Sensor) -> bool {
    let own = sensor.expected(state);
    let differs = |range_m: f64, velocity: f64, most_m: f64, most_m_per_s: f64| {
        (echo.range_m - range_m).abs() > most_m
            || sensor.wrap_speed(echo.velocity_m_per_s - velocity).abs() > most_m_per_s && !echo.is_still
    };
    // A near echo with another speed than the trunk may be from a person who passes by.
    if !differs(own.range_m, own.velocity_m_per_s, BODY_M, 0.6) {
        return true;
    }
    let trunk = DVec3::new(state.x, state.y, sensor.trunk_height_m);
    let velocity = DVec3::new(state.vx, state.vy, 0.0);
    sensor.images().any(|(_, image)| {
        let path = trunk - image;
        let (image_m, image_speed) = (path.length(), velocity.dot(path.normalize_or_zero()));
        // Paths via the wall in one direction, or in both.
        [0.5, 1.0].iter().any(|share| {
            let range_m = own.range_m + share * (image_m - trunk.distance(sensor.position));
            let speed = own.velocity_m_per_s * (1.0 - share) + share * image_speed;
            !differs(range_m, speed, GHOST_M, GHOST_M_PER_S)
        })
    })
}

/// Predecessor of an echo.
#[derive(Clone, Copy)]
enum Predecessor {
    /// Earlier echo of the same tracklet.
    Echo(EchoIndex),
    /// None: the echo begins a tracklet. The value is the last echo of the tracklet before it.
    TrackletBefore(Option<EchoIndex>),
}

/// Best sequence that ends with an echo.
#[derive(Clone, Copy)]
struct BestSequence {
    score: f64,
    predecessor: Predecessor,
}

/// Best set of tracklets that end before a time.
#[derive(Clone, Copy)]
struct BestSet {
    score: f64,
    /// Last echo of its last tracklet.
    last: Option<EchoIndex>,
}

/// Finds the best tracklets that do not overlap, in order of time.
fn best_sequences(detections: &[Detections], available: &[Vec<bool>], sensor: &Sensor) -> Vec<Vec<EchoIndex>> {
    let mut best: Vec<Vec<BestSequence>> =
        detections.iter().map(|detected| Vec::with_capacity(detected.echoes.len())).collect();
    let mut before = BestSet { score: 0.0, last: None };
    for (k, detected) in detections.iter().enumerate() {
        let mut after = before;
        for (i, echo) in detected.echoes.iter().enumerate() {
            if !available.get(k).and_then(|row| row.get(i)).is_some_and(|is_available| *is_available) {
                if let Some(row) = best.get_mut(k) {
                    row.push(BestSequence { score: f64::NEG_INFINITY, predecessor: Predecessor::TrackletBefore(None) });
                }
                continue;
            }
            let mut sequence = BestSequence {
                score: before.score - LEAST_SCORE,
                predecessor: Predecessor::TrackletBefore(before.last),
            };
            for (j, earlier) in detections.iter().enumerate().take(k).rev() {
                let gap_s = detected.time_s - earlier.time_s;
                if gap_s > BRIDGE_S {
                    break;
                }
                let missed = MISSED_SCORE * (k - j - 1) as f64;
                for (n, (other, other_best)) in earlier.echoes.iter().zip(best.get(j).into_iter().flatten()).enumerate()
                {
                    let score = other_best.score + missed - step_cost(other, echo, gap_s, sensor);
                    if score > sequence.score {
                        let predecessor = Predecessor::Echo(EchoIndex { frame: j, echo: n });
                        sequence = BestSequence { score, predecessor };
                    }
                }
            }
            sequence.score += echo_score(echo, detected);
            if let Some(row) = best.get_mut(k) {
                row.push(sequence);
            }
            if sequence.score > after.score {
                after = BestSet { score: sequence.score, last: Some(EchoIndex { frame: k, echo: i }) };
            }
        }
        before = after;
    }
    trace_back(&best, before.last)
}

/// Traces the tracklets back from the last echo; returns them in order of time.
fn trace_back(best: &[Vec<BestSequence>], last: Option<EchoIndex>) -> Vec<Vec<EchoIndex>> {
    let mut sequences = Vec::new();
    let mut next = last;
    let mut sequence = Vec::new();
    while let Some(index) = next {
        sequence.push(index);
        let of_echo = best.get(index.frame).and_then(|row| row.get(index.echo));
        next = match of_echo.map(|sequence| sequence.predecessor) {
            Some(Predecessor::Echo(earlier)) => Some(earlier),
            Some(Predecessor::TrackletBefore(earlier)) => {
                sequence.reverse();
                sequences.push(std::mem::take(&mut sequence));
                earlier
            }
            None => None,
        };
    }
    sequences.reverse();
    sequences
}

/// Score of an echo. An echo that clearly stands out scores 1, and a stronger one hardly more. Otherwise a tracklet would
/// change from the far to the near person where they pass each other. Near a stronger echo, within a body's reach, the
/// score is lower, since the stronger echo is that of the trunk.
fn echo_score(echo: &Detection, detected: &Detections) -> f64 {
    let near = detected
        .echoes
        .iter()
        .filter(|e| (e.range_m - echo.range_m).abs() < BODY_REACH_M && e.is_still == echo.is_still);
    let weaker_db = near.map(|e| e.snr_db - echo.snr_db).fold(0.0, f64::max);
    let score = (0.3 + 0.1 * (echo.snr_db - 12.0)).min(1.0) + SCORE_PER_DB * echo.snr_db
        - LOSS_PER_DB * weaker_db.min(MOST_LOSS_DB);
    if echo.is_still { STILL_WEIGHT * score } else { score }
}

/// Cost of two successive echoes in a tracklet: half the sum of squares of their standardised differences.
fn step_cost(a: &Detection, b: &Detection, gap_s: f64, sensor: &Sensor) -> f64 {
    // Speeds may be aliased. Of all aliases that people can reach, the one that best predicts the second range from the first
    // is taken.
    let span = sensor.span_m_per_s;
    let half_change = 0.5 * sensor.wrap_speed(b.velocity_m_per_s - a.velocity_m_per_s);
    let range_change_m = b.range_m - a.range_m;
    let aliases = (FASTEST_M_PER_S / span).ceil().min(20.0) as i32;
    let mean_speed = (-aliases..=aliases)
        .map(|alias| a.velocity_m_per_s + half_change + span * f64::from(alias))
        .filter(|speed| speed.abs() <= FASTEST_M_PER_S)
        .min_by(|x, y| (range_change_m - x * gap_s).abs().total_cmp(&(range_change_m - y * gap_s).abs()))
        .unwrap_or(a.velocity_m_per_s);
    let range = (range_change_m - mean_speed * gap_s) / (RANGE_M + 0.3 * gap_s);
    let speed =
        sensor.wrap_speed(b.velocity_m_per_s - a.velocity_m_per_s) / (SPEED_M_PER_S[0] + SPEED_M_PER_S[1] * gap_s);
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

    use super::super::smooth::WallPiece;
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
    fn track(
        sensor: &Sensor,
        less_db: impl Fn(usize) -> f64,
        position_at: impl Fn(f64) -> [f64; 2],
    ) -> Vec<PersonState> {
        let state = |frame: usize| {
            let time_s = 0.1 * frame as f64;
            let ([x, y], [later_x, later_y]) = (position_at(time_s), position_at(time_s + 0.01));
            let (vx, vy) = ((later_x - x) / 0.01, (later_y - y) / 0.01);
            let mut state = PersonState { frame, time_s, x, y, vx, vy, sigma_m: 0.0, snr_db: None, is_visible: true };
            state.snr_db = Some(60.0 - 40.0 * sensor.expected(&state).range_m.log10() - less_db(frame));
            state
        };
        (0..50).map(state).collect()
    }

    fn walker(sensor: &Sensor, position_at: impl Fn(f64) -> [f64; 2]) -> [Tracklet; 1] {
        [Tracklet { echoes: Vec::new(), states: track(sensor, |_| 0.0, position_at) }]
    }

    /// The ghost of a walker off a piece of wall, as tracked: on the boresight, fading by 5 dB up and down.
    #[test]
    fn the_ghost_of_a_walker_off_a_wall_is_no_person() {
        let sensor = sensor();
        for walker in [walker(&sensor, |t| [6.0 - 0.9 * t, 3.2]), walker(&sensor, |t| [1.5 + 0.9 * t, 2.6])] {
            let pieces = [
                WallPiece { center: DVec3::new(6.1, 3.1, 0.0), normal: DVec3::Z },
                WallPiece { center: DVec3::new(5.2, 2.2, 2.7), normal: -DVec3::Z },
                WallPiece { center: DVec3::new(8.0, 2.6, 0.7), normal: -DVec3::X },
            ];
            for piece in pieces {
                let multipath = |frame: usize| sensor.multipath(&walker[0].states[frame], &piece);
                let range =
                    |frame: usize| sensor.expected(&walker[0].states[frame]).range_m + multipath(frame).farther_m;
                let position_at =
                    |t: f64| [sensor.position.x + range(((10.0 * t) as usize).min(49)) + 0.115, sensor.position.y];
                let mut ghost = track(&sensor, |_| 0.0, position_at);
                for (frame, state) in ghost.iter_mut().enumerate() {
                    let fading_db = 5.0 * (0.7 * frame as f64).sin();
                    state.snr_db = walker[0].states[frame].snr_db.map(|db| db + multipath(frame).louder_db + fading_db);
                }
                assert!(is_multipath(&ghost, &walker, &sensor), "{piece:?}");
            }
        }
    }

    /// Near the radar, where nobody is tracked, a wall beside it still reflects a person. A track that comes back from
    /// there is a person.
    #[test]
    fn the_ghost_of_a_person_who_was_tracked_just_before_is_no_person() {
        let sensor = sensor();
        let mut walker = walker(&sensor, |t| [6.0 - 1.2 * t, 3.3]);
        let piece = WallPiece { center: DVec3::new(0.6, 3.5, 2.7), normal: -DVec3::Z };
        let rest = walker[0].states.split_off(46);
        let level = walker[0].states[45].snr_db;
        let mut ghost: Vec<PersonState> = rest;
        for state in &mut ghost {
            let multipath = sensor.multipath(state, &piece);
            let range_m = sensor.expected(state).range_m + multipath.farther_m;
            let (x, y) = (sensor.position.x + range_m + 0.115, sensor.position.y);
            *state = PersonState { x, y, vx: 0.0, vy: 0.0, snr_db: level.map(|db| db + multipath.louder_db), ..*state };
        }
        assert!(is_multipath(&ghost, &walker, &sensor));
        let back = track(&sensor, |_| 0.0, |t| [0.7 + 1.2 * (t - 4.6), 3.3]);
        assert!(!is_multipath(&back[46..], &walker, &sensor));
    }

    #[test]
    fn tracks_as_strong_as_a_person_or_with_another_motion_are_people() {
        let sensor = sensor();
        let others = walker(&sensor, |t| [6.0 - 0.9 * t, 3.2]);
        // Three people who are not ghosts: a standing child, 8 dB weaker; a follower in the walker's shadow; another
        // person there who walks.
        for (name, less_db, speed, start) in
            [("child", 8.0, 0.0, [6.5, 3.1]), ("follows", 16.0, -0.9, [7.5, 3.2]), ("goes", 16.0, 0.8, [4.0, 2.0])]
        {
            let somebody = track(&sensor, |_| less_db, |t| [start[0] + speed * t, start[1]]);
            assert!(!is_multipath(&somebody, &others, &sensor), "{name}");
        }
        assert!(!is_multipath(&others[0].states, &[], &sensor));
    }
}
