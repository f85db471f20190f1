//! Motion of people: feet that stay, turns with a bounded rate, squats of the requested depth, bodies that lie and
//! breathe, and walks around furniture.

use std::f64::consts::{PI, TAU};
use std::sync::Arc;

use glam::DVec3;
use radome_dsp::Frame;
use radome_sim::people::body::{CHEST, FOOT, FOREARM, HEAD, PELVIS, SEGMENTS, SHANK, THIGH};
use radome_sim::people::motion::{Bed, Motion, MotionBuilder, Person};
use radome_sim::people::skin::EDGE_M;
use radome_sim::people::walking_mesh::WalkingMesh;
use radome_sim::scenario::Scenario;
use radome_sim::scene_file::{BodyFile, SceneFile};
use radome_sim::{Scene, Simulator};

use crate::common::{error_message, hall, map_db, parse, scene, simulator};

const HEIGHT_M: f64 = 1.75;
const TURN_RAD_PER_S: f64 = 1.8;
const BED: Bed = Bed { position_m: [4.0, 3.0], heading_rad: 0.0, height_m: 0.5, edge_m: -0.5 };

fn person() -> Person {
    let mut person = Person::draw(1, [0, 0], HEIGHT_M);
    person.fidget_probability = 0.0;
    person
}

fn builder() -> MotionBuilder {
    MotionBuilder::new(person(), 0.0, [1.0, 1.0], 0.0).turning_at(Some(TURN_RAD_PER_S))
}

/// Motion with all actions, and the time at which they end.
fn motion_with_all_actions() -> (Motion, f64) {
    let path = builder().walk_to([3.0, 1.0], 1.2).walk_to([3.0, 2.0], 1.2).walk_to([1.5, 2.0], 0.9);
    let path = path.stand(1.5).squat(0.4, 5.0).face(0.3).walk_to(BED.stand_m(&person().build), 0.8).lie(&BED, 16.0);
    let path = path.walk_to([1.0, 3.0], 1.0).sit_back(-0.5 * PI, 0.45, 0.38, 6.0).walk_to([2.0, 1.0], 1.3);
    let end_s = path.time_s();
    (path.stay(), end_s)
}

fn rate(position: impl Fn(f64) -> DVec3, t: f64) -> DVec3 {
    let h = 1e-4;
    (position(t + h) - position(t - h)) / (2.0 * h)
}

/// Positions and velocities of body parts have no steps. In a millisecond a foot moves 8 mm at most, and its
/// acceleration is 100 m/s^2 at most, as in a heel strike.
#[test]
fn positions_and_velocities_are_continuous_in_all_actions() {
    let (motion, end_s) = motion_with_all_actions();
    let step_s = 1e-3;
    let at = |i: usize| motion.body(i as f64 * step_s);
    let (mut previous, mut now) = (at(0), at(1));
    let (mut fastest, mut hardest) = (0.0f64, 0.0f64);
    for i in 2..(end_s / step_s) as usize {
        let next = at(i);
        for s in 0..now.len() {
            let surface = DVec3::new(0.6, 0.0, 0.8);
            let [a, b, c] = [&previous[s], &now[s], &next[s]].map(|e| e.surface(surface));
            fastest = fastest.max((c - b).length() / step_s);
            hardest = hardest.max((c - 2.0 * b + a).length() / (step_s * step_s));
        }
        (previous, now) = (now, next);
    }
    assert!(fastest < 8.0 && hardest < 100.0, "{fastest} m/s, {hardest} m/s^2");
}

/// A standing person sways by millimetres; squatting and sitting down do not move the feet either.
#[test]
fn feet_do_not_slide_while_a_person_stands_squats_or_sits_down() {
    let path = builder().walk_to([3.0, 1.0], 1.2);
    let standing_s = path.time_s() + 0.4;
    let path = path.stand(2.0).squat(0.5, 5.0).stand(1.0).sit_back(0.0, 0.45, 0.38, 6.0);
    let end_s = path.time_s();
    let motion = path.stay();
    for foot in [FOOT, FOOT + 1] {
        let position = |t: f64| motion.body(t)[foot].centre;
        let standing_position = position(standing_s);
        let mut t = standing_s;
        while t < end_s {
            let speed = rate(position, t).length();
            assert!(speed < 0.02, "a foot slides at {speed} m/s, {t} s");
            assert!(
                position(t).distance(standing_position) < 0.02,
                "a foot has moved {} m at {t} s",
                position(t).distance(standing_position)
            );
            t += 0.01;
        }
    }
}

#[test]
fn a_squat_lowers_the_head_by_the_requested_depth() {
    for depth_m in [0.2, 0.4, 0.55] {
        let motion = builder().stand(1.0).squat(depth_m, 6.0).stay();
        let head = |t: f64| motion.body(t)[HEAD].centre.z;
        let (before, during, after) = (head(0.5), head(4.3), head(9.0));
        assert!((before - during - depth_m).abs() < 1e-6, "{} m", before - during);
        assert!((before - after).abs() < 1e-6);
    }
}

fn turning_rate(motion: &Motion, t: f64) -> f64 {
    let h = 1e-4;
    (motion.posture(t + h).heading_rad - motion.posture(t - h).heading_rad) / (2.0 * h)
}

#[test]
fn turns_have_a_bounded_rate_and_end_at_the_requested_heading() {
    for angle in [0.3, 1.2, 2.5, 3.1, -2.0] {
        let path = builder().stand(1.0).face(angle);
        let end_s = path.time_s();
        let motion = path.stay();
        assert!((motion.posture(end_s).heading_rad - angle).abs() < 1e-9);
        let (mut fastest, mut highest_lift_m) = (0.0f64, 0.0f64);
        for i in 0..((end_s + 1.0) * 100.0) as usize {
            let t = i as f64 * 0.01;
            fastest = fastest.max(turning_rate(&motion, t).abs());
            let hips = motion.body(t)[PELVIS].centre;
            assert!((hips.truncate() - glam::DVec2::ONE).length() < 0.05, "turns on the spot");
            for foot in [FOOT, FOOT + 1] {
                highest_lift_m = highest_lift_m.max(motion.body(t)[foot].centre.z - motion.body(0.5)[foot].centre.z);
            }
        }
        assert!(fastest <= TURN_RAD_PER_S * 1.001, "{fastest} rad/s");
        assert!(angle.abs() < 0.4 || highest_lift_m > 0.02, "feet are lifted: {highest_lift_m} m");
    }
    // The path has corners of all kinds, some of them close together.
    let corners = [[3.0, 1.0], [3.0, 2.5], [1.0, 2.5], [3.0, 2.4], [3.3, 2.6], [3.3, 2.3], [1.0, 1.0]];
    let path = corners.iter().fold(builder(), |path, &to| path.walk_to(to, 1.2)).stand(1.0);
    let end_s = path.time_s();
    let motion = path.stay();
    let samples: Vec<f64> = (0..(end_s * 200.0) as usize).map(|i| i as f64 * 0.005).collect();
    for &t in &samples {
        assert!(
            turning_rate(&motion, t).abs() <= TURN_RAD_PER_S * 1.001,
            "{} rad/s at {t} s",
            turning_rate(&motion, t)
        );
    }
    for corner in corners {
        let distance = |t: &f64| (motion.body(*t)[PELVIS].centre.truncate() - glam::DVec2::from_array(corner)).length();
        let nearest = samples.iter().map(distance).fold(f64::INFINITY, f64::min);
        assert!(nearest < 0.3, "{corner:?} is passed {nearest} m off");
    }
}

/// Radial speeds seen from ahead: the trunk moves at walking speed, while feet stand and overtake it twofold to
/// fourfold. A standing person has almost none.
#[test]
fn trunk_feet_and_arms_of_a_walker_have_their_spread_of_radial_velocity() {
    let walker = |stride: f64, arm_swing: f64| {
        let mut person = person();
        (person.style.stride, person.style.arm_swing) = (stride, arm_swing);
        MotionBuilder::new(person, 0.0, [1.0, 1.0], 0.0).walk_to([9.0, 1.0], 1.2).stand(5.0).stay()
    };
    let span = |motion: &Motion, part: usize, from_s: f64| {
        let speeds = (0..300).map(|i| rate(|t| motion.body(t)[part].centre, from_s + f64::from(i) * 0.01).x);
        speeds.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)))
    };
    let average = walker(1.0, 1.0);
    let (low, high) = span(&average, CHEST, 1.0);
    assert!(low > 0.9 && high < 1.5, "the chest goes at {low} to {high} m/s");
    let (low, high) = span(&average, FOOT, 1.0);
    assert!(low < 0.3 && (2.4..4.8).contains(&high), "a foot goes at {low} to {high} m/s");
    for part in 0..SEGMENTS {
        let (low, high) = span(&average, part, 8.0);
        assert!(low > -0.02 && high < 0.02, "part {part} of who stands goes at {low} to {high} m/s");
    }
    let arms = |swing: f64| {
        let (low, high) = span(&walker(1.0, swing), FOREARM, 1.0);
        high - low
    };
    assert!(arms(0.0) < 0.6 * arms(1.0) && arms(1.5) > 1.25 * arms(1.0), "{} {} {}", arms(0.0), arms(1.0), arms(1.5));
    // Longer strides are fewer.
    let cycles = |stride: f64| {
        let motion = walker(stride, 1.0);
        motion.walk(6.0).phase - motion.walk(1.0).phase
    };
    assert!((cycles(1.25) * 1.25 / cycles(1.0) - 1.0).abs() < 1e-9);
}

/// The front of the chest of a lying person moves up and down with the breath by millimetres, seen from above; the rest
/// of the body is still.
#[test]
fn a_lying_person_moves_only_by_breathing() {
    let motion = builder().lying(&BED, 60.0).stay();
    let chest_front = |t: f64| motion.body(t)[CHEST].surface(DVec3::X);
    let heights: Vec<f64> = (0..2000).map(|i| chest_front(f64::from(i) * 0.02).z).collect();
    let span = |v: &[f64]| {
        v.iter().copied().fold(f64::NEG_INFINITY, f64::max) - v.iter().copied().fold(f64::INFINITY, f64::min)
    };
    assert!((0.0035..0.014).contains(&span(&heights)), "{} m", span(&heights));
    for part in [HEAD, PELVIS, THIGH, SHANK, FOOT] {
        let centre = |t: f64| motion.body(t)[part].centre;
        for i in 0..400 {
            assert!(rate(centre, f64::from(i) * 0.1).length() < 1e-6, "part {part} moves");
        }
    }
    let body = motion.body(20.0);
    assert!(body.iter().all(|e| (0.45..0.9).contains(&e.centre.z)), "all of the body is on the bed");
    assert!(body[HEAD].centre.x < 3.5 && body[FOOT].centre.x > 4.6, "feet point where they should");
    // The person stands up again in front of the bed.
    let standing_body = motion.body(70.0);
    let standing_place = BED.stand_m(&person().build);
    assert!(standing_body[HEAD].centre.z > 1.5, "{}", standing_body[HEAD].centre.z);
    assert!((standing_body[PELVIS].centre.truncate() - glam::DVec2::from_array(standing_place)).length() < 0.05);
}

/// The skin follows the body in every action. It stays closed, its volume changes only by the folds of bent joints, and
/// its velocities are the rates of its positions.
#[test]
fn skins_keep_their_volume_in_all_actions() {
    let (motion, end_s) = motion_with_all_actions();
    let walker = WalkingMesh::new(Arc::new(motion), EDGE_M);
    let standing_volume_m3 = walker.skin().rest().volume_m3();
    let mut least = f64::INFINITY;
    for i in 0..60 {
        let t = end_s * f64::from(i) / 60.0;
        let ratio = walker.mesh_at(t).volume_m3() / standing_volume_m3;
        least = least.min(ratio);
        assert!((0.80..1.10).contains(&ratio), "{ratio} of the volume at {t} s");
        let (posed, h) = (walker.posed(t), 1e-4);
        let (before, after) = (walker.mesh_at(t - h).vertices, walker.mesh_at(t + h).vertices);
        for ((velocity, a), b) in posed.velocities_m_per_s.iter().zip(&before).zip(&after) {
            assert!((*velocity - (*b - *a) / (2.0 * h)).length() < 1e-3);
        }
    }
    assert!(least < 1.0);
}

const SCRIPT: &str = r#"
[[door]]
position_m = [0.0, 10.0]
[[people.actor]]
start_s = 1.0
step = [{ enter_door = 0 }, { walk_to_m = [4.0, 9.0] }, { leave_door = 0 }]
"#;

#[test]
fn a_visitor_is_absent_before_entering_and_after_leaving() {
    let simulator = simulator(&parse(&hall(SCRIPT)), 1, None);
    let in_room = |frame| simulator.people(frame).iter().filter(|p| p.in_room).count();
    assert_eq!((simulator.people(5).len(), in_room(5)), (0, 0));
    assert_eq!(in_room(30), 1);
    let first = (0..).find(|&i| !simulator.people(i).is_empty()).expect("somebody comes");
    assert!(simulator.people(first)[0].position.x < -0.5, "from outside");
    assert_eq!(simulator.people(200).len(), 0);
}

#[test]
fn past_visits_are_forgotten_and_the_same_again() {
    let scene = scene("hall");
    let scenario = Scenario::new(&scene, 5, Some(2));
    let times = (0..100).map(|i| 0.7 * f64::from(i));
    let bodies = || -> Vec<_> {
        let chests = |t: f64| scenario.between(t, t).into_iter().map(move |(slot, m)| (slot, m.body(t)[CHEST].centre));
        times.clone().flat_map(chests).collect()
    };
    let before = bodies();
    let visits: Vec<_> = scenario.between(0.0, 70.0).iter().map(|(_, motion)| Arc::downgrade(motion)).collect();
    for second in 0..1000 {
        scenario.between(f64::from(second), f64::from(second) + 1.0);
    }
    // A passer-by never leaves.
    let kept = visits.iter().filter(|visit| visit.strong_count() > 0).count();
    assert!(visits.len() > 4 && kept <= 1, "{kept} of {}", visits.len());
    assert_eq!(bodies(), before);
}

/// Least distances of people from furniture and from walls, m.
fn clearances_m(scene: &Scene, seed: u64, until_s: f64) -> (f64, f64) {
    let file: &SceneFile = scene.file();
    let [width, depth, _] = file.room.size_m;
    let near = |p: DVec3, [x, y]: [f64; 2], reach: f64| (p.x - x).hypot(p.y - y) < reach;
    let (mut from_furniture, mut from_walls) = (f64::INFINITY, f64::INFINITY);
    let mut t = 0.0;
    while t < until_s {
        for (_, motion) in Scenario::new(scene, seed, None).between(t, t) {
            let p = motion.body(t)[PELVIS].centre;
            // On seats and beds and in doorways, people may be near furniture and walls.
            let seated = file.seat.iter().any(|s| near(p, s.position_m, 0.55));
            let in_bed = file.bed.iter().any(|b| near(p, b.position_m, b.edge_m.abs() + 0.45));
            if seated || in_bed || file.door.iter().any(|d| near(p, d.position_m, 0.9)) {
                continue;
            }
            from_walls = from_walls.min(p.x).min(p.y).min(width - p.x).min(depth - p.y);
            for f in file.furniture.iter().filter(|f| f.position_m[2] < 1.9) {
                let distance = |i: usize, v: f64| (f.position_m[i] - v).max(v - f.position_m[i] - f.size_m[i]).max(0.0);
                from_furniture = from_furniture.min(distance(0, p.x).hypot(distance(1, p.y)));
            }
        }
        t += 0.05;
    }
    (from_furniture, from_walls)
}

#[test]
fn paths_of_people_keep_their_distance_from_furniture_and_walls() {
    for name in ["bedroom", "bathroom"] {
        for seed in 0..12 {
            let drawn = scene(name).drawn(seed).expect("a draw");
            let (furniture, walls) = clearances_m(&drawn, seed, 60.0);
            assert!(furniture > 0.14 && walls > 0.2, "{name} {seed}: {furniture} m, {walls} m");
        }
    }
    let text = hall(
        r#"
[[furniture]]
name = "shelf"
position_m = [6.0, 7.0, 0.0]
size_m = [1.0, 5.0, 2.0]
[[furniture]]
name = "table"
position_m = [9.0, 9.0, 0.0]
size_m = [2.0, 2.0, 0.8]
[[door]]
position_m = [0.0, 10.0]
[[door]]
position_m = [20.0, 10.0]
[people]
keep_off_m = 0.4
turn_rate_deg_per_s = 120.0
[people.visits]
pace_probability = 0.5
pace_area_m = [[4.0, 6.0], [13.0, 13.0]]
"#,
    );
    for seed in 0..10 {
        let (furniture, walls) = clearances_m(&parse(&text), seed, 60.0);
        assert!(furniture > 0.2 && walls > 0.3, "{seed}: {furniture} m, {walls} m");
    }
}

const WALKS: &str = "[people]\nactor = [{ step = [{ walk_to_m = [3.0, 10.2] }, { walk_to_m = [9.0, 10.4] }] }]\n";

fn codes(scene: &Scene, seed: u64) -> Vec<u16> {
    let simulator = simulator(scene, seed, None);
    (20..22).flat_map(|i| simulator.frame(i).codes).collect()
}

/// Neutral keys change no byte, for both kinds of bodies. Other values do, and frames depend on the seed alone.
#[test]
fn neutral_keys_of_people_change_no_byte() {
    for body in [BodyFile::Ellipsoids, BodyFile::Mesh] {
        let scene_with = |keys: &str| parse(&hall(&format!("{}\n{keys}", WALKS.trim()))).with_body(body);
        let (plain, neutral) = (scene_with(""), scene_with("stride = [1.0, 1.0]\narm_swing = [1.0, 1.0]"));
        assert!(codes(&plain, 5) == codes(&neutral, 5), "{body:?}: neutral keys change bytes");
        let with_arm_swing = scene_with("arm_swing = [0.5, 2.0]");
        assert!(codes(&with_arm_swing, 5) == codes(&with_arm_swing, 5), "{body:?}: the same seed, other bytes");
        assert!(codes(&with_arm_swing, 5) != codes(&plain, 5), "{body:?}: arm_swing does nothing");
    }
}

/// Strongest cell around a person's range relative to the median of the map, dB.
fn contrast_db(simulator: &Simulator, frame: u64) -> f64 {
    let rendered: Frame = simulator.frame(frame);
    let map = map_db(&rendered, 0);
    let ranges = rendered.shape.samples / 2;
    let person = simulator.people(frame)[0];
    let waveform = simulator.scene().waveform();
    let bin = (person.range_m / waveform.range_step_m(rendered.shape.samples)).round() as usize;
    let mut sorted = map.clone();
    sorted.sort_by(f64::total_cmp);
    let near = map.iter().enumerate().filter(|(i, _)| (i % ranges).abs_diff(bin) <= 3).map(|(_, v)| *v);
    near.fold(f64::NEG_INFINITY, f64::max) - sorted[sorted.len() / 2]
}

/// Moving people in the shipped scenes are far above the noise; people who lie or stand still are visible now and then.
#[test]
fn people_are_above_the_noise_in_the_shipped_scenes() {
    for name in ["bedroom", "bathroom"] {
        for seed in [1, 2] {
            let simulator = simulator(&scene(name), seed, None);
            let (mut contrasts_moving_db, mut contrasts_db) = (Vec::new(), Vec::new());
            for frame in (0..400).step_by(8) {
                let Some(person) = simulator.people(frame).into_iter().find(|p| p.in_room) else { continue };
                let contrast = contrast_db(&simulator, frame);
                contrasts_db.push(contrast);
                if person.velocity.length() > 0.3 && person.position.min_element() > 0.3 {
                    contrasts_moving_db.push(contrast);
                }
            }
            contrasts_moving_db.sort_by(f64::total_cmp);
            contrasts_db.sort_by(f64::total_cmp);
            let (weakest_db, median_db) = (contrasts_moving_db[0], contrasts_moving_db[contrasts_moving_db.len() / 2]);
            let median_of_all_db = contrasts_db[contrasts_db.len() / 2];
            let found = format!("{weakest_db:.1} and {median_db:.1} dB while moving, {median_of_all_db:.1} dB of all");
            assert!(
                contrasts_moving_db.len() > 5 && weakest_db > 15.0 && median_db > 30.0 && median_of_all_db > 20.0,
                "{name} {seed}: {found}"
            );
        }
    }
}

mod hard_cases {
    use super::*;

    #[test]
    fn invalid_scripts_are_refused_by_key() {
        let script = |steps: &str| format!("[people]\nactor = [{{ height_m = 1.6, step = [{steps}] }}]\n");
        let walk = "{ walk_to_m = [2.0, 2.0] }";
        for (steps, expected) in [
            ("{ enter_door = 0 }".to_owned(), "[[door]]"),
            (format!("{walk}, {{ leave_door = 3 }}"), "[[door]]"),
            (format!("{walk}, {{ lie_s = 3.0 }}"), "[[bed]]"),
            (format!("{walk}, {{ squat_s = 3.0, depth_m = 0.9 }}"), "0.36 of the body's height"),
            (format!("{walk}, {{ stand_s = 3.0, depth_m = 0.3 }}"), "squat_s"),
            (format!("{walk}, {{ stand_s = 3.0, bed = 0 }}"), "lie_s"),
            (format!("{walk}, {{ face_deg = nan }}"), "face_deg"),
            (
                format!("{walk}, {{ stand_s = 3.0, face_deg = 90.0 }}"),
                "stand_s and face_deg, expected one of walk_to_m",
            ),
            (format!("{walk}, {{ speed_m_per_s = 1.0 }}"), "step is without any of them, expected"),
            (format!("{walk}, {{ walk_to_m = [1.0, 1.0], seat = 0 }}"), "none without sit_s"),
            (format!("{walk}, {{ stand_s = 1.0, speed_m_per_s = 1.0 }}"), "none without a walk"),
            (format!("{walk}, {{ face_deg = 9.0, speed_m_per_s = 1.0 }}"), "none without a walk"),
            (format!("{walk}, {{ sit_s = 9.0, speed_m_per_s = 1.0 }}"), "none without a walk"),
            ("{ face_deg = 90.0 }".to_owned(), "enter_door"),
        ] {
            let message = error_message(&hall(&script(&steps)));
            assert!(message.contains(expected), "{steps}: {message}");
        }
        let door = "[[door]]\nposition_m = [0.0, 10.0]\n";
        for (steps, expected) in [
            (format!("{walk}, {{ enter_door = 0 }}"), "enter_door is 0, expected it in the first step only"),
            (
                format!("{{ enter_door = 0 }}, {{ leave_door = 0 }}, {walk}"),
                "leave_door is 0, expected it in the last step only",
            ),
        ] {
            let message = error_message(&hall(&format!("{door}{}", script(&steps))));
            assert!(message.contains(expected), "{steps}: {message}");
        }
        for (keys, expected) in [
            ("turn_rate_deg_per_s = 0.0", "turn_rate_deg_per_s"),
            ("keep_off_m = -1.0", "keep_off_m"),
            ("stride = [1.2, 0.8]", "stride"),
            ("arm_swing = [0.0, nan]", "arm_swing"),
        ] {
            let message = error_message(&hall(&format!("[people]\n{keys}\nactor = [{{ step = [{walk}] }}]\n")));
            assert!(message.contains(expected), "{keys}: {message}");
        }
    }

    /// Regression test: a script's seat without `back_m` set the height and the heading, but not the place.
    #[test]
    fn a_person_with_a_seat_sits_on_it() {
        for back_key in ["", "back_m = 0.38\n"] {
            let text = hall(&format!(
                "[[seat]]\nposition_m = [6.0, 10.0]\nheading_deg = 0.0\n{back_key}[people]\n[[people.actor]]\n\
                 step = [{{ walk_to_m = [3.0, 10.0] }}, {{ sit_s = 9.0, seat = 0, speed_m_per_s = 1.0 }}]\n"
            ));
            let people = Scenario::new(&parse(&text), 1, None).between(0.0, 20.0);
            let body = people[0].1.body(8.0);
            let (hips, foot) = (body[PELVIS].centre, body[FOOT].centre);
            assert!((hips.x - 6.0).hypot(hips.y - 10.0) < 0.15 && hips.z < 0.7, "{back_key}: hips at {hips}");
            assert!(foot.x > hips.x + 0.2, "{back_key}: the foot is at {foot}, the hips are at {hips}");
            let standing_hips = people[0].1.body(18.0)[PELVIS].centre;
            assert!(
                standing_hips.z > 0.8 && (6.2..6.6).contains(&standing_hips.x),
                "{back_key}: stands before the seat, at {standing_hips}"
            );
        }
    }

    /// Regression test: people sat down with the back to the radar, whatever way they had come.
    #[test]
    fn a_person_without_a_seat_sits_down_in_the_direction_they_look_in() {
        for (turn, knee_ahead) in
            [("", DVec3::X), ("{ face_deg = 180.0 }, ", -DVec3::X), ("{ face_deg = 90.0 }, ", DVec3::Y)]
        {
            let text = hall(&format!(
                "[people]\n[[people.actor]]\nstep = [{{ walk_to_m = [3.0, 10.0] }}, \
                 {{ walk_to_m = [5.0, 10.0], speed_m_per_s = 1.0 }}, {turn}{{ sit_s = 60.0 }}]\n"
            ));
            let people = Scenario::new(&parse(&text), 1, None).between(0.0, 20.0);
            let body = people[0].1.body(18.0);
            let knee = body[SHANK].centre - body[PELVIS].centre;
            assert!(body[PELVIS].centre.z < 0.7 && knee.dot(knee_ahead) > 0.25, "{turn}: the knee is at {knee}");
        }
    }

    /// Steps of zero length or duration, beds against the wall, and turns by zero and by a full circle.
    #[test]
    fn degenerate_scripts_have_finite_bodies() {
        let path = builder().walk_to([1.0, 1.0], 1.0).face(0.0).face(TAU).stand(0.0).squat(0.0, 0.0).squat(9.0, 0.1);
        let path = path.lie(&Bed { edge_m: 0.3, ..BED }, 0.0).sit_back(1.0, 0.2, 0.0, 0.0).face(PI);
        let end_s = path.time_s();
        let motion = path.stay();
        for i in 0..400 {
            for e in motion.body(end_s * f64::from(i) / 400.0) {
                assert!(e.centre.is_finite() && e.axes.is_finite() && e.semi_axes_m.min_element() > 0.0);
            }
        }
    }
}
