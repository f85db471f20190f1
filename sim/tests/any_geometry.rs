//! Rooms of any shape with paths found by rays, compared with boxes, whose images are known, and with geometry by hand.

mod hard_cases;

use std::path::Path;
use std::sync::Arc;

use glam::{DMat3, DVec3};
use num_complex::Complex64;
use radome_sim::Scene;
use radome_sim::em::image::{BoxRoom, Element, ImageIndex, Wall};
use radome_sim::em::pattern::Pattern;
use radome_sim::path_list::{ListedPath, PathList, PathListOptions};
use radome_sim::paths::{Environment, Facet, ImagePaths, LaunchOptions, Surroundings};
use radome_sim::prepared_scene::PreparedScene;

use crate::common::{self, WAVENUMBER, scene};
use crate::surfaces::rooms::{SIZE_M, box_keys, faces, mesh_table, room_files, room_scene, stl, triangles};
use crate::surfaces::{RECTANGLE, plan_keys};

/// Person who walks through the room of most tests, away from its walls.
const WALKER: &str =
    "[[people.actor]]\nstep = [{ walk_to_m = [4.0, 3.2] }, { walk_to_m = [1.5, 1.9], speed_m_per_s = 1.0 }]\n";

/// Loads a fixture with replacements in its text.
fn changed_fixture(name: &str, changes: &[(&str, &str)]) -> Scene {
    let (path, mut text) = common::fixture(name);
    for (from, to) in changes {
        assert!(text.contains(from), "{from}");
        text = text.replace(from, to);
    }
    Scene::parse(&text, &path).expect("a good scene")
}

/// The same room of plasterboard as a plan and from files, all of them represented by faces.
fn rooms_of_faces(tables: &str, folder: &Path) -> Vec<(&'static str, Scene)> {
    let by_rays = |keys: &str| room_scene(&format!("solver = \"rays\"\n{keys}"), tables, folder);
    let mut all = vec![("plan", room_scene(&plan_keys(&RECTANGLE, ""), tables, folder))];
    all.push(("box by rays", by_rays(&box_keys("plasterboard"))));
    all.extend(room_files().map(|file| (file.0, by_rays(&mesh_table(folder, &file)))));
    all
}

fn listed_paths(scene: &Scene, margin_db: f64) -> Vec<ListedPath> {
    let options = PathListOptions { margin_db, time_s: 0.5, ..PathListOptions::default() };
    PathList::new(scene, &options).expect("a list").paths
}

/// Asserts that every path of one list is in the other, within a micrometre and 0.01 dB.
fn assert_contains_paths(some: &[ListedPath], all: &[ListedPath], what: &str) {
    for path in some {
        let is_same = |other: &&ListedPath| {
            other.rx == path.rx
                && other.kind == path.kind
                && (other.length_m - path.length_m).abs() < 1e-6
                && (other.gain_db - path.gain_db).abs() < 0.01
        };
        assert!(all.iter().any(|other| is_same(&other)), "{what}: {path:?}");
    }
}

/// Regression test: the surface of a path that is diffracted beside a plate was `wall` in a room without walls.
#[test]
fn paths_beside_a_plate_are_by_way_of_the_plate() {
    let walls = ["x_low", "x_high", "y_low", "y_high", "floor", "ceiling"]
        .map(|wall| format!("{wall} = {{ material = \"open\" }}\n"));
    let room = format!("size_m = [20.0, 20.0, 3.0]\nsolver = \"rays\"\nmax_reflections = 1\n{}", walls.concat());
    // The mirror point is 5 cm beside the plate.
    let plate = "[[furniture]]\nname = \"plate\"\nposition_m = [3.5, 1.05, 1.1]\nsize_m = [0.02, 0.2, 0.2]\nmaterial = \"metal\"\n";
    let scene = common::parse(&common::hall_with_room(&room, &format!("{plate}{WALKER}")));
    let options = PathListOptions { people: Some(0), margin_db: 60.0, ..PathListOptions::default() };
    let paths = PathList::new(&scene, &options).expect("a list").paths;
    let surfaces: Vec<&Vec<String>> =
        paths.iter().map(|path| &path.surfaces).filter(|names| !names.is_empty()).collect();
    assert!(!surfaces.is_empty() && surfaces.iter().all(|names| **names == ["plate x_low"]), "{surfaces:?}");
}

#[test]
fn a_box_has_the_same_paths_from_toml_plan_obj_stl_and_gltf() {
    let folder = tempfile::tempdir().expect("a folder");
    let of_box = room_scene(&box_keys("plasterboard"), WALKER, folder.path());
    assert!(matches!(PreparedScene::new(&of_box, 1, 10.0).room, Surroundings::Box(_)));
    // Paths at the threshold may be in only one of the lists.
    let [expected, wider] = [10.0, 13.0].map(|margin_db| listed_paths(&of_box, margin_db));
    assert!(expected.len() > 20, "{} paths", expected.len());
    for (name, scene) in rooms_of_faces(WALKER, folder.path()) {
        assert!(matches!(PreparedScene::new(&scene, 1, 10.0).room, Surroundings::Polygons(_)), "{name}");
        assert_contains_paths(&expected, &listed_paths(&scene, 13.0), name);
        assert_contains_paths(&listed_paths(&scene, 10.0), &wider, name);
    }
}

/// Frames of a walker differ by less than a thousandth of the power of the box's frame.
#[test]
fn a_box_has_the_same_frames_from_toml_plan_obj_stl_and_gltf() {
    let folder = tempfile::tempdir().expect("a folder");
    let echoes = |scene: &Scene| common::simulator(scene, 3, None).echo_samples(4);
    let expected = echoes(&room_scene(&box_keys("plasterboard"), WALKER, folder.path()));
    let power = |samples: &mut dyn Iterator<Item = f64>| samples.map(|x| x * x).sum::<f64>();
    let of_box = power(&mut expected.iter().map(|&x| f64::from(x)));
    assert!(of_box > 0.0);
    for (name, scene) in rooms_of_faces(WALKER, folder.path()) {
        let found = echoes(&scene);
        let difference = power(&mut found.iter().zip(&expected).map(|(a, b)| f64::from(a - b)));
        let difference_db = 10.0 * (difference / of_box).max(1e-30).log10();
        assert!(difference_db < -30.0, "{name}: {difference_db:.1} dB");
    }
}

/// Meshes that are a box and nothing else use its images, unless the scene requests rays.
#[test]
fn a_mesh_of_a_box_is_simulated_by_the_images_of_the_box() {
    let folder = tempfile::tempdir().expect("a folder");
    let quads = faces([0.0; 3], SIZE_M);
    std::fs::write(folder.path().join("room.stl"), stl(&triangles(&quads), 1.0)).expect("written");
    let keys = "[[room.mesh]]\nfile = \"room.stl\"\nmaterial = \"plasterboard\"\nunit = \"m\"\nup = \"z\"\n";
    let room = |keys: &str| PreparedScene::new(&room_scene(keys, WALKER, folder.path()), 1, 10.0).room;
    assert!(matches!(room(keys), Surroundings::Box(_)));
    assert!(matches!(room(&format!("solver = \"rays\"\n{keys}")), Surroundings::Polygons(_)));
    assert!(matches!(PreparedScene::new(&scene("room-mesh"), 1, 10.0).room, Surroundings::Polygons(_)));
    let by_images = changed_fixture("room-mesh", &[("[[room.mesh]]", "[room]\nsolver = \"images\"\n[[room.mesh]]")]);
    assert!(matches!(PreparedScene::new(&by_images, 1, 10.0).room, Surroundings::Box(_)));
}

/// Strongest path with matching surfaces, at the first receiver.
fn strongest_path(all: &[ListedPath], matches_surfaces: impl Fn(&[String]) -> bool) -> Option<&ListedPath> {
    let matching = all.iter().filter(|path| path.rx == 1 && matches_surfaces(&path.surfaces));
    matching.max_by(|a, b| a.gain_db.total_cmp(&b.gain_db))
}

/// A walker beyond the corner is seen by way of the wall at x = 0, and by way of that and the wall at y = 0. The direct
/// path is weak. Lengths are those of mirror geometry.
#[test]
fn a_person_beyond_a_corner_is_seen_by_way_of_walls() {
    let l = changed_fixture(
        "l-corridor",
        &[
            ("max_body_reflections = 2", "max_body_reflections = 3"),
            ("[7.65, 1.0, 1.5]", "[7.65, 0.4, 1.5]"),
            ("{ walk_to_m = [6.0, 1.2] }", "{ walk_to_m = [1.5, 2.75] },\n    { stand_s = 100.0 }"),
        ],
    );
    let (tx, rx) = l.elements();
    let list =
        PathList::new(&l, &PathListOptions { margin_db: 50.0, time_s: 10.0, person: Some(0), ..Default::default() });
    let all = list.expect("a list").paths;
    let is_body = |name: &str| name.starts_with("person 0");
    let by_one_wall = strongest_path(&all, |s| matches!(s, [a, b, c] if a == "wall 5" && is_body(b) && c == "wall 5"));
    let by_one_wall = by_one_wall.expect("a path by the wall, there and back");
    let straight = strongest_path(&all, |s| matches!(s, [a] if is_body(a)));
    let straight_db = straight.map_or(f64::NEG_INFINITY, |path| path.gain_db);
    // The direct path is diffracted by the edge, twice.
    assert!(straight_db < by_one_wall.gain_db - 10.0, "{straight_db} {}", by_one_wall.gain_db);
    let path_point = |path: &ListedPath, number: usize| DVec3::from_array(path.points_m[number]);
    let mirrored = |p: DVec3| DVec3::new(-p.x, p.y, p.z);
    let body = path_point(by_one_wall, 2);
    let length_m = mirrored(tx.position).distance(body) + mirrored(rx[0].position).distance(body);
    assert!((by_one_wall.length_m - length_m).abs() < 1e-6, "{} {length_m}", by_one_wall.length_m);
    let by_two_walls = strongest_path(
        &all,
        |s| matches!(s, [a, b, c, d] if a == "wall 0" && b == "wall 5" && is_body(c) && d == "wall 5"),
    );
    let by_two_walls = by_two_walls.expect("a path by two walls");
    let body = path_point(by_two_walls, 3);
    let corner = DVec3::new(-tx.position.x, -tx.position.y, tx.position.z);
    let length_m = corner.distance(body) + mirrored(rx[0].position).distance(body);
    assert!((by_two_walls.length_m - length_m).abs() < 1e-6, "{} {length_m}", by_two_walls.length_m);
    assert!(by_two_walls.gain_db < by_one_wall.gain_db);
}

/// The walker of the corridor is visible in its frames before the corner and where the corner hides most of the body.
#[test]
fn a_walker_of_the_l_corridor_has_echoes() {
    let simulator = common::simulator(&scene("l-corridor"), 2, None);
    let (_, report) = simulator.frame_with_report(5);
    assert!(report.static_paths > 3 && report.moving_paths > 3, "{report:?}");
    for frame in [20, 52] {
        let power = common::echo_power(&simulator, frame);
        assert!(power.is_finite() && power > 0.0, "frame {frame}: {power}");
    }
}

fn prepared_polygons(scene: &Scene) -> PreparedScene {
    let prepared = PreparedScene::new(scene, 1, 10.0);
    assert!(matches!(prepared.room, Surroundings::Polygons(_)));
    prepared
}

/// Field of a transmitter image at a point, relative to that of the pattern, dB.
fn relative_field_db(prepared: &PreparedScene, index: ImageIndex, point: DVec3) -> f64 {
    let illumination = prepared.room.illuminate(&prepared.tx, index, point);
    let towards = prepared.tx.radar_from_world * (point - prepared.tx.position).normalize();
    20.0 * (illumination.field.magnitude() / prepared.tx.pattern.field(towards)).max(1e-15).log10()
}

/// First-order images of the transmitter whose path to a point reflects at the surface with a name.
fn images_by_way_of(prepared: &PreparedScene, name: &str, point: DVec3) -> Vec<ImageIndex> {
    let of_first_order = prepared.room.images(1).into_iter().skip(1);
    let is_by_way_of_surface = |index: &ImageIndex| {
        let polyline = prepared.room.polyline(*index, prepared.tx.position, point);
        polyline
            .get(1)
            .filter(|_| polyline.len() == 3)
            .is_some_and(|reflection_point| prepared.room.surface_names(*reflection_point).contains(&name))
    };
    of_first_order.filter(is_by_way_of_surface).collect()
}

/// The gap passes the full field, the wall the part that plasterboard transmits, and the leaf the part that wood
/// transmits. The leaf also reflects.
#[test]
fn a_half_open_door_has_a_gap_and_reflects() {
    let prepared = prepared_polygons(&scene("half-open-door"));
    let direct = [0; 3];
    let gap_db = relative_field_db(&prepared, direct, DVec3::new(5.0, 2.3, 1.3));
    assert!(gap_db.abs() < 2.0, "{gap_db}");
    let wall_db = relative_field_db(&prepared, direct, DVec3::new(5.0, 3.6, 1.3));
    assert!((-9.0..-3.0).contains(&wall_db), "{wall_db}");
    let leaf_db = relative_field_db(&prepared, direct, DVec3::new(5.0, 1.6, 1.3));
    assert!((-40.0..-10.0).contains(&leaf_db), "{leaf_db}");
    let mirrored = DVec3::new(3.3, 0.8, 1.3);
    let [image] = images_by_way_of(&prepared, "door in partition 0", mirrored)[..] else {
        panic!("no image in the leaf")
    };
    let length_m = prepared.room.illuminate(&prepared.tx, image, mirrored).distance_m;
    // The leaf lies in the plane x + y = 5, which maps the transmitter's x and y to 5 minus the other coordinate.
    let tx = prepared.tx.position;
    let expected_m = DVec3::new(5.0 - tx.y, 5.0 - tx.x, tx.z).distance(mirrored);
    assert!((length_m - expected_m).abs() < 1e-6, "{length_m} {expected_m}");
}

#[test]
fn a_metal_cupboard_obstructs_and_reflects() {
    let prepared = prepared_polygons(&scene("cupboard"));
    assert!(relative_field_db(&prepared, [0; 3], DVec3::new(4.9, 2.0, 1.0)) < -20.0);
    assert!(relative_field_db(&prepared, [0; 3], DVec3::new(2.3, 1.6, 1.2)).abs() < 0.5);
    let before = DVec3::new(2.3, 1.6, 1.2);
    let [image] = images_by_way_of(&prepared, "cupboard x_low", before)[..] else { panic!("no image in the cupboard") };
    let illumination = prepared.room.illuminate(&prepared.tx, image, before);
    let tx = prepared.tx.position;
    let expected_m = DVec3::new(6.4 - tx.x, tx.y, tx.z).distance(before);
    assert!((illumination.distance_m - expected_m).abs() < 1e-6);
    // Metal reflects the whole field, except for the part that its edges remove.
    let towards = prepared.tx.radar_from_world
        * DVec3::new(-illumination.direction.x, illumination.direction.y, illumination.direction.z);
    let reflected_fraction = illumination.field.magnitude() / prepared.tx.pattern.field(towards);
    assert!((reflected_fraction - 1.0).abs() < 0.2, "{reflected_fraction}");
    // Furniture with faces has no scattering points.
    let list = PathList::new(&scene("cupboard"), &PathListOptions { people: Some(0), ..Default::default() });
    let paths = list.expect("a list").paths;
    assert!(paths.iter().any(|path| path.surfaces.contains(&"cupboard x_low".to_owned())));
    assert!(paths.iter().all(|path| path.kind != radome_sim::path_list::PathKind::Furniture));
}

#[test]
fn facets_transmit_as_walls_of_boxes_do() {
    let glass = Wall::Slab { permittivity: Complex64::new(6.31, -0.26), thickness_m: 0.01 };
    let mut walls = [Wall::Open; 6];
    walls[1] = glass;
    let room = BoxRoom::new(DVec3::new(4.0, 8.0, 3.0), walls, WAVENUMBER, true);
    let antenna = DVec3::new(1.0, 4.0, 1.2);
    let environment = Environment::new(Facet::of_box(&room), WAVENUMBER).expect("facets").with_transmission(true);
    let paths = ImagePaths::discover(Arc::new(environment), antenna, &LaunchOptions::default());
    for polarisation in [DVec3::Z, DVec3::Y, DVec3::new(0.2, 0.6, 0.7).normalize()] {
        let element = Element {
            position: antenna,
            polarisation,
            radar_from_world: DMat3::IDENTITY,
            pattern: Pattern::new(1.2, 1.1, -20.0),
        };
        for point in [DVec3::new(6.0, 4.0, 1.2), DVec3::new(5.5, 6.0, 1.5), DVec3::new(5.0, 2.2, 0.9)] {
            let (of_facets, of_box) = (paths.illuminate(&element, 0, point), room.illuminate(&element, [0; 3], point));
            let difference =
                (of_facets.field.re - of_box.field.re).length() + (of_facets.field.im - of_box.field.im).length();
            assert!(of_box.field.magnitude() > 0.1 && difference < 1e-6, "{point} {polarisation}: {difference:e}");
        }
    }
}

/// A person behind glass is seen through it, directly and by the walls behind it. Without transmission the person is
/// invisible.
#[test]
fn a_person_behind_a_glass_wall_is_seen_through_it() {
    let power = |scene: &Scene| common::echo_power(&common::simulator(scene, 1, None), 10);
    let through = power(&scene("glass-wall"));
    let hidden = power(&changed_fixture("glass-wall", &[("transmission = true", "transmission = false")]));
    let free = power(&changed_fixture("glass-wall", &[("material = \"glass\"", "material = \"open\"")]));
    assert!(hidden < 1e-6 * through, "{hidden} {through}");
    // About 8 dB of glass, twice.
    let lost_db = 10.0 * (through / free).log10();
    assert!((-30.0..-4.0).contains(&lost_db), "{lost_db}");
    let prepared = prepared_polygons(&scene("glass-wall"));
    let behind = DVec3::new(6.0, 2.0, 1.2);
    assert!(!images_by_way_of(&prepared, "wall 1", behind).is_empty(), "by the wall behind");
}

#[test]
fn an_office_of_ten_thousand_triangles_is_simulated() {
    let simulator = common::simulator(&scene("open-plan"), 1, None);
    let (frame, report) = simulator.frame_with_report(3);
    assert!(report.static_paths > 0 && report.moving_paths > 0, "{report:?}");
    assert!(frame.codes.iter().any(|&code| code != frame.codes[0]));
}
