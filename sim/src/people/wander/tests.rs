//! Properties of wandering people in every mode.

use std::path::Path;
use std::sync::Arc;

use glam::DVec3;

use super::table::Group;
use super::{group_members, room_setting};
use crate::em::specular::Ellipsoid;
use crate::people::body::{FOOT, FOREARM, PELVIS};
use crate::people::motion::Motion;
use crate::scenario::Scenario;
use crate::scene::Scene;
use crate::scene::ground::blocks;

const SIZE_M: [f64; 2] = [5.0, 4.0];
const RADAR_M: [f64; 2] = [0.2, 2.0];
const TABLE_M: [[f64; 2]; 2] = [[2.6, 2.6], [3.2, 3.2]];
const KEEP_OFF_M: f64 = 0.35;

const SCENE: &str = concat!(
    r#"
format = 1
name = "room"

[room]
size_m = [5.0, 4.0, 2.5]
"#,
    include_str!("../../scene/test_room.toml"),
    r#"
[radar]
position_m = [0.2, 2.0, 1.2]

[[furniture]]
name = "table"
position_m = [2.6, 2.6, 0.0]
size_m = [0.6, 0.6, 0.8]

[[door]]
position_m = [1.4, 0.0]

[[seat]]
position_m = [3.6, 1.0]
heading_deg = 90.0
"#
);

fn parsed(wander: &str) -> Result<Scene, String> {
    Scene::parse(&format!("{SCENE}\n{wander}"), Path::new("room.toml")).map_err(|error| error.to_string())
}

fn scene(wander: &str) -> Scene {
    parsed(&format!("[people.wander]\n{wander}")).expect("a scene")
}

fn people(scene: &Scene, seed: u64, count: usize) -> Vec<Arc<Motion>> {
    Scenario::new(scene, seed, Some(count)).between(0.0, 1.0).into_iter().map(|(_, motion)| motion).collect()
}

/// Keys of a scene file that make one mode certain.
fn mode_weights(mode: &str) -> String {
    let weight = |name: &&str| format!("{name} = {}", if *name == mode { "1.0" } else { "0.0" });
    format!("[people.wander.modes]\n{}\n", MODES.iter().map(weight).collect::<Vec<_>>().join("\n"))
}

const MODES: [&str; 6] = ["independent", "together", "follow", "meet", "pass", "stand_and_walk"];

fn distance_m([ax, ay]: [f64; 2], [bx, by]: [f64; 2]) -> f64 {
    (ax - bx).hypot(ay - by)
}

/// Velocity is continuous and acceleration is bounded at every time, also between steps of the table.
#[test]
fn speed_is_continuous_and_acceleration_is_bounded() {
    let scene = scene("sit_probability = 0.3");
    let h = 5e-3;
    for seed in 0..6 {
        for motion in people(&scene, seed, 2) {
            let at = |i: usize| motion.walk(i as f64 * h).position_m;
            let (mut before, mut now) = (at(0), at(1));
            for i in 2..12_000 {
                let next = at(i);
                let bend = [0, 1].map(|k| (next[k] - 2.0 * now[k] + before[k]) / (h * h));
                let hardest = bend[0].hypot(bend[1]);
                assert!(hardest < 1.3, "{hardest} m/s^2 at {} s", i as f64 * h);
                let speed = distance_m(next, now) / h;
                assert!(speed < 1.5, "{speed} m/s at {} s", i as f64 * h);
                (before, now) = (now, next);
            }
        }
    }
}

#[test]
fn turning_rates_stay_within_the_limit_of_the_scene() {
    let scene = parsed("[people]\nturn_rate_deg_per_s = 100.0\n[people.wander]\n").expect("a scene");
    let h = 0.01;
    for seed in 0..6 {
        let motion = &people(&scene, seed, 1)[0];
        let rate = |i: usize| {
            let heading = |t: f64| motion.walk(t).heading_rad;
            (heading((i + 1) as f64 * h) - heading(i as f64 * h)) / h
        };
        let mut last = rate(0);
        for i in 1..6000 {
            let now = rate(i);
            assert!(now.abs() < 100f64.to_radians() + 1e-6 && (now - last).abs() < 0.15, "{now} rad/s at {i}");
            last = now;
        }
    }
}

#[test]
fn hips_keep_their_distance_from_walls_furniture_and_the_radar() {
    /// Margin for sway, m.
    const SWAY_M: f64 = 0.03;
    for mode in MODES {
        let scene = scene(&format!("sit_probability = 0.0\n{}", mode_weights(mode)));
        for seed in 0..4 {
            for motion in people(&scene, seed, 2) {
                for i in 0..1200 {
                    let t = f64::from(i) * 0.1;
                    let at = motion.walk(t).position_m;
                    let off_walls = (0..2).map(|k| at[k].min(SIZE_M[k] - at[k])).fold(f64::INFINITY, f64::min);
                    assert!(off_walls > KEEP_OFF_M - SWAY_M, "{mode} {seed}: {off_walls} m off a wall at {t} s");
                    let [low, high] = TABLE_M;
                    let axis_gaps_m = [0, 1].map(|k| (low[k] - at[k]).max(at[k] - high[k]).max(0.0));
                    let off_table = axis_gaps_m[0].hypot(axis_gaps_m[1]);
                    assert!(off_table > KEEP_OFF_M - SWAY_M, "{mode} {seed}: {off_table} m off the table at {t} s");
                    assert!(distance_m(at, RADAR_M) > 0.5 - SWAY_M, "{mode} {seed}: at the radar at {t} s");
                }
            }
        }
    }
}

/// Goals lie within the scene's ranges and angles. Curves between them go a little beyond.
#[test]
fn people_stay_near_the_ranges_and_angles_of_the_scene() {
    let scene = scene("range_m = [0.8, 3.0]\noff_boresight_deg = 30.0\nsit_probability = 0.0");
    let (mut beyond, mut all) = (0, 0);
    for seed in 0..12 {
        let motion = &people(&scene, seed, 1)[0];
        for i in 0..600 {
            let at = motion.walk(f64::from(i) * 0.2).position_m;
            let [along, across] = [at[0] - RADAR_M[0], at[1] - RADAR_M[1]];
            let (range_m, off_rad) = (along.hypot(across), across.atan2(along).abs());
            assert!(range_m < 3.6, "{at:?}");
            beyond += usize::from(range_m > 3.1 || off_rad > 35f64.to_radians());
            all += 1;
        }
    }
    assert!(beyond * 8 < all, "{beyond} of {all}");
}

#[test]
fn two_people_keep_their_distance_and_keep_moving_in_every_mode() {
    for mode in MODES {
        let scene = scene(&format!("sit_probability = 0.2\n{}", mode_weights(mode)));
        let (mut walked_m, mut nearest_m) = (0.0, f64::INFINITY);
        for seed in 0..6 {
            let both = people(&scene, seed, 2);
            let hips = |person: usize, t: f64| {
                let p = both[person].body(t)[PELVIS].centre;
                [p.x, p.y]
            };
            let mut last = [hips(0, 0.0), hips(1, 0.0)];
            for i in 1..1800 {
                let t = f64::from(i) * 0.1;
                let now = [hips(0, t), hips(1, t)];
                nearest_m = distance_m(now[0], now[1]).min(nearest_m);
                walked_m += distance_m(now[0], last[0]) + distance_m(now[1], last[1]);
                last = now;
            }
        }
        assert!(nearest_m > 0.35, "{mode}: {nearest_m} m");
        let speed = walked_m / (6.0 * 2.0 * 180.0);
        assert!(speed > 0.03, "{mode}: {speed} m/s on average, pauses included");
    }
}

/// People that walk together stay together, followers are close behind, and people that meet stand face to face.
#[test]
fn people_walk_together_follow_and_meet_in_the_modes_of_these_names() {
    let time_share = |mode: &str, of: &dyn Fn(&Motion, &Motion, f64) -> bool| {
        let scene = scene(&format!(
            "stand_probability = 0.0\npace_probability = 0.0\nsit_probability = 0.0\n{}",
            mode_weights(mode)
        ));
        let mut count = 0;
        for seed in 0..6 {
            let both = people(&scene, seed, 2);
            count += (200..1400).filter(|i| of(&both[0], &both[1], f64::from(*i) * 0.1)).count();
        }
        count as f64 / (6.0 * 1200.0)
    };
    let is_close = |limit_m: f64| {
        move |a: &Motion, b: &Motion, t: f64| distance_m(a.walk(t).position_m, b.walk(t).position_m) < limit_m
    };
    let independent = time_share("independent", &is_close(1.2));
    let together = time_share("together", &is_close(1.2));
    let follows = time_share("follow", &is_close(2.2));
    assert!(together > 0.6 && together > independent + 0.2, "{together} together, {independent} independent");
    assert!(follows > 0.6, "{follows}");
    let face_to_face = |a: &Motion, b: &Motion, t: f64| {
        let (a, b) = (a.walk(t), b.walk(t));
        let to_other = [b.position_m[0] - a.position_m[0], b.position_m[1] - a.position_m[1]];
        let facing = a.heading_rad.cos() * to_other[0] + a.heading_rad.sin() * to_other[1];
        let facing_back = -(b.heading_rad.cos() * to_other[0] + b.heading_rad.sin() * to_other[1]);
        let distance = to_other[0].hypot(to_other[1]);
        distance < 2.0 && facing > 0.8 * distance && facing_back > 0.8 * distance && a.intensity.max(b.intensity) < 0.1
    };
    let (meeting, independent_share) = (time_share("meet", &face_to_face), time_share("independent", &face_to_face));
    assert!(meeting > 0.05 && meeting > independent_share, "{meeting} face to face, {independent_share} otherwise");
}

/// At every time some point of a body moves faster than half a millimetre a second. The feet of a standing person stay
/// in place.
#[test]
fn a_standing_person_always_moves_a_little_and_feet_do_not_slide() {
    let scene = scene("stand_probability = 1.0\npace_probability = 0.0");
    let h = 1e-3;
    let (mut gesture_count, mut standing_count) = (0, 0);
    for seed in 0..8 {
        let motion = &people(&scene, seed, 1)[0];
        for i in 0..1500 {
            let t = f64::from(i) * 0.05;
            let (before, after) = (motion.body(t - h), motion.body(t + h));
            let speed = |s: usize| {
                let point = |e: &Ellipsoid| e.surface(DVec3::new(0.6, 0.0, 0.8));
                point(&after[s]).distance(point(&before[s])) / (2.0 * h)
            };
            let fastest = (0..before.len()).map(speed).fold(0.0, f64::max);
            assert!(fastest > 5e-4, "seed {seed}: {fastest} m/s at {t} s");
            let forearm_speed = speed(FOREARM).max(speed(FOREARM + 1));
            assert!(forearm_speed < 2.5, "seed {seed}: an arm moves at {forearm_speed} m/s at {t} s");
            gesture_count += usize::from(forearm_speed > 0.2);
            let (a, b) = (motion.walk(t - h), motion.walk(t + h));
            if (b.heading_rad - a.heading_rad).abs() < 1e-9 {
                standing_count += 1;
                let foot = |side: usize| after[FOOT + side].centre.distance(before[FOOT + side].centre) / (2.0 * h);
                let sliding = foot(0).max(foot(1));
                assert!(sliding < 0.03, "seed {seed}: a foot slides at {sliding} m/s at {t} s");
            }
        }
    }
    assert!(
        standing_count > 4000 && gesture_count > 100,
        "{standing_count} times standing, {gesture_count} with gestures"
    );
}

/// Steps are counted by distance, not by time.
#[test]
fn the_phase_of_steps_advances_with_the_distance_walked() {
    let scene = scene("stand_probability = 0.0");
    for seed in 0..4 {
        let motion = &people(&scene, seed, 1)[0];
        let mut walked_m = 0.0;
        for i in 0..6000 {
            let (a, b) = (motion.walk(f64::from(i) * 0.02), motion.walk(f64::from(i + 1) * 0.02));
            assert!(b.phase >= a.phase - 1e-4);
            walked_m += distance_m(a.position_m, b.position_m);
        }
        let cycles = motion.walk(120.0).phase - motion.walk(0.0).phase;
        // Turning on the spot takes steps; sway does not.
        let per_cycle_m = walked_m / cycles;
        assert!((0.2..1.6).contains(&per_cycle_m), "{per_cycle_m} m in a cycle");
    }
}

/// The speeds of many people, some of them standing, match measurements of people that walk in a room. There the 90th
/// percentile of the radial speed is 0.5 to 0.6 m/s.
#[test]
fn radial_speeds_match_those_measured_in_rooms() {
    let scene = scene("");
    let mut speeds = Vec::new();
    let mut ranges_m = Vec::new();
    for seed in 0..60 {
        let motion = &people(&scene, seed, 1)[0];
        for i in 0..200 {
            let t = f64::from(i) * 0.3;
            let range = |t: f64| distance_m(motion.walk(t).position_m, RADAR_M);
            speeds.push((range(t + 0.01) - range(t - 0.01)).abs() / 0.02);
            ranges_m.push(range(t));
        }
    }
    speeds.sort_by(f64::total_cmp);
    ranges_m.sort_by(f64::total_cmp);
    let fast = speeds[speeds.len() * 9 / 10];
    assert!((0.35..0.75).contains(&fast), "{fast} m/s");
    let middle_m = ranges_m[ranges_m.len() / 2];
    assert!((1.0..2.8).contains(&middle_m), "{middle_m} m");
}

#[test]
fn motion_depends_on_seed_and_time_but_not_on_the_order_of_requests() {
    let scene = scene("");
    let first: Vec<_> = people(&scene, 3, 2);
    let later: Vec<_> = first.iter().map(|motion| motion.posture(400.0)).collect();
    let early: Vec<_> = first.iter().map(|motion| motion.posture(7.77)).collect();
    let second = people(&scene, 3, 2);
    for i in 0..4000 {
        let _ = second[0].posture(f64::from(i) * 0.1);
    }
    for (i, motion) in second.iter().enumerate() {
        assert_eq!(motion.posture(7.77), early[i]);
        assert_eq!(motion.posture(400.0), later[i]);
    }
    assert_ne!(people(&scene, 4, 2)[0].posture(7.77), early[0]);
}

/// An hour takes a bounded number of blocks in memory, and its end can be requested directly.
#[test]
fn the_end_of_an_hour_is_available_with_few_blocks_in_memory() {
    let scene = scene("");
    let file = scene.file();
    let wander = file.people.wander.as_ref().expect("wander");
    let group = Arc::new(Group::new(room_setting(file, wander, blocks(&scene), 1), 2));
    let members = group_members(&group, 2);
    assert_eq!(members.len(), 2);
    for (person, wanderer) in members {
        let motion = Motion::wandering(person, wanderer);
        let position = motion.walk(3600.0).position_m;
        assert!(
            position[0] > 0.3 && position[0] < SIZE_M[0] - 0.3 && position[1] > 0.3 && position[1] < SIZE_M[1] - 0.3,
            "{position:?}"
        );
        assert!(distance_m(position, motion.walk(0.0).position_m).is_finite());
    }
    assert!(group.kept_blocks() <= 8, "{} blocks", group.kept_blocks());
}

/// The number of people is the requested one, or the one that the seed draws. A passer-by beyond the wall does not
/// count.
#[test]
fn the_number_of_people_is_the_requested_or_drawn_one() {
    let scene = scene("passer_by_probability = 1.0");
    let mut counts = [0; 3];
    for seed in 0..40 {
        let all = Scenario::new(&scene, seed, None).between(5.0, 6.0);
        let (beyond, inside): (Vec<_>, Vec<_>) =
            all.iter().partition(|(_, motion)| motion.walk(5.0).position_m[0] > SIZE_M[0]);
        assert_eq!(beyond.len(), 1);
        counts[inside.len()] += 1;
        assert_eq!(Scenario::new(&scene, seed, Some(1)).between(5.0, 6.0).len(), 2);
    }
    assert!(counts.iter().all(|count| *count > 4), "{counts:?}");
}

#[test]
fn a_person_who_sits_is_on_the_seat() {
    let scene = scene("sit_probability = 1.0\nsit_s = [5.0, 10.0]\nstand_probability = 0.0\npace_probability = 0.0");
    let motion = &people(&scene, 2, 1)[0];
    let mut seated = 0;
    for i in 0..1200 {
        let hips = motion.body(f64::from(i) * 0.1)[PELVIS].centre;
        if hips.z < 0.65 {
            seated += 1;
            assert!(distance_m([hips.x, hips.y], [3.6, 1.0]) < 0.35, "{hips:?}");
        }
    }
    assert!(seated > 200, "{seated} of 1200");
}

mod hard_cases {
    use super::*;

    #[test]
    fn invalid_keys_are_refused_by_name() {
        let cases = [
            ("[people.visits]\n[people.wander]\n", "exactly one"),
            ("[people.wander]\nmax_people = 3\n", "two"),
            ("[people.wander]\nspeed_m_per_s = [1.0, 0.5]\n", "speed_m_per_s"),
            ("[people.wander]\npause_probability = 1.5\n", "pause_probability"),
            ("[people.wander]\nstand_probability = 0.8\npace_probability = 0.4\n", "pace_probability"),
            ("[people.wander]\nleast_distance_m = 0.1\n", "least_distance_m"),
            ("[people.wander]\nsway_m = [0.0, 0.01]\n", "sway_m"),
            ("[people.wander.modes]\nmeet = -1.0\n", "meet"),
            ("[people.wander.modes]\ndance = 1.0\n", "dance"),
            ("[people.wander]\nnearness = nan\n", "nearness"),
        ];
        for (people, expected) in cases {
            let message = parsed(people).map(|_| ()).expect_err(people);
            assert!(message.contains(expected), "{people}: {message}");
        }
    }

    /// A room without space for two people, or for any, still has moving people. Times beyond all bounds have results.
    #[test]
    fn rooms_without_space_and_extreme_times_give_finite_bodies() {
        for (keep_off_m, size) in [(0.35, "[1.2, 1.2, 2.5]"), (2.0, "[3.0, 3.0, 2.5]")] {
            let text = SCENE
                .replace("size_m = [5.0, 4.0, 2.5]", &format!("size_m = {size}"))
                .replace("position_m = [0.2, 2.0, 1.2]", "position_m = [0.2, 0.5, 1.2]")
                .replace(
                    "[[furniture]]\nname = \"table\"\nposition_m = [2.6, 2.6, 0.0]\nsize_m = [0.6, 0.6, 0.8]\n",
                    "",
                )
                .replace("[[seat]]\nposition_m = [3.6, 1.0]\nheading_deg = 90.0\n", "")
                .replace("[[door]]\nposition_m = [1.4, 0.0]\n", "");
            let text = format!("{text}\n[people]\nkeep_off_m = {keep_off_m:?}\n[people.wander]\n");
            let scene = Scene::parse(&text, Path::new("room.toml")).expect("a scene");
            for motion in people(&scene, 1, 2) {
                for t in [-1e9, -0.001, 0.0, 10.0, 50.0] {
                    assert!(motion.body(t).iter().all(|part| part.centre.is_finite()), "{t} s");
                }
            }
        }
    }
}
