//! People and the walls of rooms that are not boxes: nobody walks through walls, and people beyond them are not in the
//! room.

use std::path::Path;

use radome_dsp::Occupancy;
use radome_sim::Scene;
use radome_sim::people::body::CHEST;
use radome_sim::scenario::Scenario;

use crate::common;
use crate::surfaces::rooms::{Quad, obj, room_scene};

/// Corridor that turns: two arms of 6 x 2 m. Its inner corner is at (2, 2), and the region beyond 2 m on both axes is
/// outside.
const CORNERS: [[f64; 2]; 6] = [[0.0, 0.0], [6.0, 0.0], [6.0, 2.0], [2.0, 2.0], [2.0, 6.0], [0.0, 6.0]];
const HEIGHT_M: f64 = 2.6;

/// The L-shaped room as a plan and from a file, with the steps of one person.
fn l_shaped_rooms(steps: &str, folder: &Path) -> [(&'static str, Scene); 2] {
    let plan = format!(
        "floor = {{ material = \"concrete\" }}\nceiling = {{ material = \"concrete\" }}\n[room.plan]\n\
         corners_m = {CORNERS:?}\nheight_m = {HEIGHT_M:?}\nwalls = {{ material = \"concrete\" }}\n"
    );
    let wall = |i: usize| -> Quad {
        let ([a, b], [c, d]) = (CORNERS[i], CORNERS[(i + 1) % 6]);
        [[a, b, 0.0], [c, d, 0.0], [c, d, HEIGHT_M], [a, b, HEIGHT_M]]
    };
    let level = |[x, y]: [f64; 2], z: f64, [w, d]: [f64; 2]| -> Quad {
        [[x, y, z], [x + w, y, z], [x + w, y + d, z], [x, y + d, z]]
    };
    let arms = [([0.0, 0.0], [6.0, 2.0]), ([0.0, 2.0], [2.0, 4.0])];
    let floors =
        arms.iter().flat_map(|&(position, size)| [level(position, 0.0, size), level(position, HEIGHT_M, size)]);
    let quads: Vec<(Quad, &str)> = (0..6).map(wall).chain(floors).map(|quad| (quad, "concrete")).collect();
    std::fs::write(folder.join("l.obj"), obj(&quads)).expect("written");
    let file =
        "[[room.mesh]]\nfile = \"l.obj\"\nmaterial = \"concrete\"\nthickness_m = 0.2\nunit = \"m\"\nup = \"z\"\n";
    let person = format!("[[people.actor]]\nstep = [{steps}]\n");
    [("plan", room_scene(&plan, &person, folder)), ("file", room_scene(file, &person, folder))]
}

/// Positions of the only person's chest every 50 ms, m.
fn chest_positions(scene: &Scene, until_s: f64) -> Vec<[f64; 2]> {
    let scenario = Scenario::new(&scene.drawn(1).expect("a scene"), 1, None);
    let steps = (until_s / 0.05) as usize;
    let position = |step: usize| {
        let time_s = 0.05 * step as f64;
        let (_, motion) = scenario.between(time_s, time_s).pop().expect("somebody");
        let middle = motion.body(time_s)[CHEST].centre;
        [middle.x, middle.y]
    };
    (0..steps).map(position).collect()
}

/// The straight line from one arm into the other crosses both inner walls.
#[test]
fn a_walker_in_an_l_shaped_room_crosses_no_wall() {
    let folder = tempfile::tempdir().expect("a folder");
    let steps = "{ walk_to_m = [5.2, 1.0] }, { walk_to_m = [1.0, 5.2] }, { walk_to_m = [5.2, 1.0] }";
    for (name, scene) in l_shaped_rooms(steps, folder.path()) {
        let positions = chest_positions(&scene, 20.0);
        let arrives = |target: [f64; 2]| {
            positions.iter().any(|position| (position[0] - target[0]).hypot(position[1] - target[1]) < 0.2)
        };
        assert!(arrives([5.2, 1.0]) && arrives([1.0, 5.2]), "{name}: {:?}", positions.last());
        for [x, y] in positions {
            assert!(!(x > 1.9 && y > 1.9), "{name}: in the wall at ({x}, {y})");
            assert!(x > 0.1 && y > 0.1 && x < 5.9 && y < 5.9, "{name}: out of the room at ({x}, {y})");
        }
    }
}

#[test]
fn a_person_beyond_a_wall_is_not_in_the_room() {
    let folder = tempfile::tempdir().expect("a folder");
    for (position, occupancy) in [("[4.0, 4.0]", Occupancy::Empty), ("[1.0, 4.0]", Occupancy::One)] {
        let steps = format!("{{ walk_to_m = {position} }}, {{ stand_s = 100.0 }}");
        for (name, scene) in l_shaped_rooms(&steps, folder.path()) {
            let simulator = common::simulator(&scene, 1, None);
            let truth = simulator.truth(5);
            assert_eq!((truth.occupancy, truth.transition), (occupancy, false), "{name}, at {position}");
            assert_eq!(simulator.people(5)[0].in_room, occupancy == Occupancy::One, "{name}, at {position}");
        }
    }
}

/// The leaf of the half-open door is in the line x + y = 5, from its hinge at (3.5, 1.5) 0.9 m into the room.
#[test]
fn nobody_walks_through_a_door_leaf() {
    let (path, text) = common::fixture("half-open-door");
    let (before, _) = text.split_once("[[people.actor]]").expect("somebody");
    let text =
        format!("{before}[[people.actor]]\nstep = [{{ walk_to_m = [3.0, 1.2] }}, {{ walk_to_m = [3.0, 3.0] }}]\n");
    let positions = chest_positions(&Scene::parse(&text, &path).expect("a good scene"), 8.0);
    let [x, y] = *positions.last().expect("steps");
    assert!((x - 3.0).abs() < 0.2 && (y - 3.0).abs() < 0.2, "({x}, {y})");
    let end_x = 3.5 - 0.9 * 0.5f64.sqrt();
    for pair in positions.windows(2) {
        let [before, after] = [0, 1].map(|i| pair[i][0] + pair[i][1] - 5.0);
        let crosses_line = (before < 0.0) != (after < 0.0);
        assert!(!crosses_line || pair[0][0] < end_x, "through the leaf at {:?}", pair[0]);
    }
}
