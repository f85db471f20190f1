//! Rooms with difficult geometry: radar and people at walls, and missing or defective parts in files.
//!
//! | case | where |
//! |---|---|
//! | coplanar and coincident faces, slivers, reversed normals | here, `surfaces.rs`, `geometry/lint.rs`,
//! `rays/hard_cases.rs` |
//! | holes | here, `surfaces.rs`, `paths/environment.rs` |
//! | the radar on a wall and in a corner, a person at a wall, no ceiling | here |
//! | rays along edges and in planes | here, `rays/hard_cases.rs` |
//! | files in millimetres, two million triangles | `rooms.rs`, `geometry/import/hard_cases.rs` |
//! | materials outside their bands | `material_bands.rs` |

use radome_sim::em::image::{images, order};

use super::*;
use crate::common::isotropic;
use crate::surfaces::rooms::{File, METRES, MILLIMETRES, Quad, obj};

/// Keys of a room over an L-shaped plan of plasterboard, with further tables of the plan.
fn l_plan_keys(tables: &str) -> String {
    format!(
        "diffuse_share = 0.1\nfloor = {{ material = \"concrete\" }}\nceiling = {{ material = \"concrete\" }}\n\
         [room.plan]\ncorners_m = [[0.0, 0.0], [5.0, 0.0], [5.0, 4.0], [2.5, 4.0], [2.5, 3.0], [0.0, 3.0]]\n\
         height_m = 2.6\nwalls = {{ material = \"plasterboard\", thickness_m = 0.0125 }}\n{tables}"
    )
}

/// Asserts that the frames of a scene are finite and that a person is visible in them.
fn assert_finite_frames(scene: &Scene, name: &str) {
    let simulator = common::simulator(scene, 1, None);
    for index in [0, 9] {
        let power = common::echo_power(&simulator, index);
        assert!(power.is_finite() && power > 0.0, "{name}, frame {index}: {power}");
        let frame = simulator.frame(index);
        assert_eq!(frame.codes.len(), frame.shape.codes(), "{name}");
    }
}

/// On a wall, in a corner of the room and in the outward corner of an L, the radar is 1 cm off its walls.
#[test]
fn the_radar_may_be_on_a_wall_and_in_a_corner() {
    for (position, azimuth_deg) in
        [("[0.011, 1.5, 1.2]", 0.0), ("[0.011, 0.011, 0.011]", 45.0), ("[2.511, 2.989, 1.2]", -60.0)]
    {
        let text = common::hall_with_room(&l_plan_keys(""), WALKER)
            .replace("[radar]", &format!("[radar]\nazimuth_deg = {azimuth_deg:?}"))
            .replace("[0.5, 1.0, 1.2]", position)
            .replace("[4.0, 3.2]", "[4.0, 2.2]");
        assert_finite_frames(&common::parse(&text), position);
    }
}

/// Shoulders inside the wall are hidden; the rest of the body is visible.
#[test]
fn a_person_may_touch_a_wall() {
    for position in ["[4.9, 2.0]", "[4.0, 0.05]", "[4.95, 3.95]"] {
        let actor = format!("[[people.actor]]\nstep = [{{ walk_to_m = {position} }}, {{ stand_s = 100.0 }}]\n");
        assert_finite_frames(&room_scene(&l_plan_keys(""), &actor, Path::new("")), position);
    }
}

#[test]
fn a_room_may_have_no_ceiling() {
    let open = l_plan_keys("").replace("ceiling = { material = \"concrete\" }", "ceiling = { material = \"open\" }");
    assert_finite_frames(&room_scene(&open, WALKER, Path::new("")), "no ceiling");
    let boxed = format!("solver = \"rays\"\n{}", box_keys("open"));
    assert_finite_frames(&room_scene(&boxed, WALKER, Path::new("")), "no ceiling, by rays");
}

/// At points inside and around the room, fields are finite and no stronger than two mirrors allow.
#[test]
fn fields_are_finite_inside_and_around_a_room() {
    let prepared = prepared_polygons(&room_scene(&l_plan_keys(""), WALKER, Path::new("")));
    for index in prepared.room.images(2) {
        for i in 0..300 {
            let fraction = |step: f64| (f64::from(i) * step).fract();
            let point =
                DVec3::new(6.0 * fraction(0.618) - 0.5, 5.0 * fraction(0.755) - 0.5, 3.0 * fraction(0.57) - 0.2);
            let field = prepared.room.illuminate(&prepared.tx, index, point).field.magnitude();
            assert!(field.is_finite() && field < 3.0, "{index:?} {point}: {field}");
        }
    }
}

#[test]
fn frames_of_polygons_are_the_same_on_any_number_of_threads() {
    let scene = room_scene(&l_plan_keys(""), WALKER, Path::new(""));
    let frame = || common::simulator(&scene, 7, None).frame(6).codes;
    assert_eq!(common::on_threads(1, frame), common::on_threads(3, frame));
}

/// Room of plasterboard from a file, with paths found by rays.
fn scene_from_file(file: File) -> Scene {
    let folder = tempfile::tempdir().expect("a folder");
    let keys = format!("solver = \"rays\"\n{}", mesh_table(folder.path(), &file));
    room_scene(&keys, WALKER, folder.path())
}

/// The room of most tests from a file, with other faces instead of the wall at y = 0.
fn scene_with_wall(wall: &[Quad]) -> Scene {
    let quads = faces([0.0; 3], SIZE_M);
    let others = [0, 1, 3, 4, 5].map(|side| quads[side]);
    let all: Vec<(Quad, &str)> = others.iter().chain(wall).map(|&quad| (quad, "plaster")).collect();
    scene_from_file(("room.obj", METRES, obj(&all)))
}

/// Panel of the wall at y = 0 between two places along x.
fn panel(from_m: f64, to_m: f64) -> Quad {
    let height_m = SIZE_M[2];
    [[from_m, 0.0, 0.0], [to_m, 0.0, 0.0], [to_m, 0.0, height_m], [from_m, 0.0, height_m]]
}

/// Wall of needles of 5 m by half a millimetre that begin in one of its corners.
fn scene_with_slivers() -> Scene {
    let [length_m, _, height_m] = SIZE_M;
    let quads = faces([0.0; 3], SIZE_M);
    let mut all = triangles(&[0, 1, 3, 4, 5].map(|side| quads[side]));
    let heights_m: Vec<f64> = (0..=40).map(|i| 5e-4 * f64::from(i)).chain([height_m]).collect();
    all.extend(heights_m.windows(2).map(|ends| [[0.0; 3], [length_m, 0.0, ends[0]], [length_m, 0.0, ends[1]]]));
    all.push([[0.0; 3], [length_m, 0.0, height_m], [0.0, 0.0, height_m]]);
    scene_from_file(("room.stl", MILLIMETRES, stl(&all, 1000.0)))
}

/// A duplicated wall, of two materials of which the first counts, and a duplicated floor, once from below.
fn scene_with_duplicate_faces() -> Scene {
    let quads = faces([0.0; 3], SIZE_M);
    let mut all: Vec<(Quad, &str)> = quads.iter().map(|&quad| (quad, "plaster")).collect();
    let [a, b, c, d] = quads[4];
    all.extend([(quads[1], "pane"), ([d, c, b, a], "plaster")]);
    scene_from_file(("room.obj", METRES, obj(&all)))
}

/// Room in which half of the triangles have reversed normals.
fn scene_with_reversed_normals() -> Scene {
    let triangles_of_room = triangles(&faces([0.0; 3], SIZE_M));
    let reverse_some =
        |(t, [a, b, c]): (usize, [[f64; 3]; 3])| if 0b1010_0110_0101 >> t & 1 == 1 { [a, c, b] } else { [a, b, c] };
    let reversed: Vec<[[f64; 3]; 3]> = triangles_of_room.into_iter().enumerate().map(reverse_some).collect();
    scene_from_file(("room.stl", MILLIMETRES, stl(&reversed, 1000.0)))
}

/// The points at which the wall of three panels reflects the radar lie on a seam of two.
#[test]
fn defects_of_files_change_no_path() {
    let plain = scene_with_wall(&[panel(0.0, SIZE_M[0])]);
    let [expected, wider] = [10.0, 13.0].map(|margin_db| listed_paths(&plain, margin_db));
    assert!(expected.len() > 20, "{} paths", expected.len());
    let in_panels = scene_with_wall(&[panel(0.0, 0.5), panel(0.5, 2.0), panel(2.0, SIZE_M[0])]);
    let all = [
        ("panels", in_panels),
        ("slivers", scene_with_slivers()),
        ("faces twice", scene_with_duplicate_faces()),
        ("turned normals", scene_with_reversed_normals()),
    ];
    for (name, scene) in all {
        assert_contains_paths(&expected, &listed_paths(&scene, 13.0), name);
        assert_contains_paths(&listed_paths(&scene, 10.0), &wider, name);
    }
}

/// Static paths of a scene.
fn static_paths(scene: &Scene, margin_db: f64) -> Vec<ListedPath> {
    let options = PathListOptions { margin_db, people: Some(0), ..PathListOptions::default() };
    PathList::new(scene, &options).expect("a list").paths
}

/// Returns whether a path goes to the wall at y = 0 and straight back: the radar is 1 m in front of it, and no other
/// surface is at that distance.
fn is_straight_from_wall(path: &ListedPath) -> bool {
    (path.length_m - 2.0).abs() < 0.01
}

/// Two overlapping panels that reflect the radar act as one mirror, not two.
#[test]
fn overlapping_panels_reflect_once() {
    let straight_paths = |wall: &[Quad], margin_db: f64| -> Vec<ListedPath> {
        static_paths(&scene_with_wall(wall), margin_db).into_iter().filter(is_straight_from_wall).collect()
    };
    let whole = straight_paths(&[panel(0.0, SIZE_M[0])], 10.0);
    let overlapping = straight_paths(&[panel(0.0, 1.25), panel(0.25, SIZE_M[0])], 10.0);
    assert!(!whole.is_empty());
    assert_eq!(overlapping.len(), whole.len());
    assert_contains_paths(&whole, &overlapping, "overlapping panels");
}

/// Sum of the straight paths to the wall at 6 m and back. Before the radar the wall has a kink at `kink_m`.
fn kinked_wall_echo(kink_m: f64) -> Complex64 {
    let corners = [[0.0, 0.0], [6.0, 0.0], [kink_m, 1.0], [6.0, 2.0], [0.0, 2.0]];
    let scene = room_scene(&plan_keys(&corners, ""), common::NOBODY, Path::new(""));
    let straight =
        static_paths(&scene, 20.0).into_iter().filter(|path| path.rx == 1 && (path.length_m - 11.0).abs() < 0.05);
    straight.map(|path| Complex64::from_polar(10f64.powf(path.gain_db / 20.0), path.phase_rad)).sum()
}

/// The same sum by physical optics across the wall in two dimensions, without a factor that all kinks share.
fn kinked_wall_physical_optics(kink_m: f64) -> Complex64 {
    let step_m = 2e-4;
    let strip_echo = |number: i32| {
        let across_m = f64::from(number) * step_m;
        let wall_m = kink_m - 0.5 + (6.0 - kink_m) * across_m.abs();
        let taper = (0.5 * std::f64::consts::PI * across_m).cos().powi(2);
        Complex64::from_polar(taper * step_m, -2.0 * WAVENUMBER * wall_m.hypot(across_m))
    };
    (-5000..=5000).map(strip_echo).sum()
}

/// Regression test: a wall with a kink of a milliradian lost or doubled its echo.
#[test]
fn a_wall_with_a_slight_kink_is_a_slightly_bent_mirror() {
    let (straight, optics) = (kinked_wall_echo(6.0).norm(), kinked_wall_physical_optics(6.0).norm());
    for kink_m in [5.98, 5.99, 5.995, 5.999, 5.99999, 6.00001, 6.001, 6.005, 6.01, 6.02] {
        let db = 20.0 * (kinked_wall_echo(kink_m).norm() / straight).log10();
        let expected_db = 20.0 * (kinked_wall_physical_optics(kink_m).norm() / optics).log10();
        assert!((db - expected_db).abs() < 0.2, "{kink_m}: {db:.2} dB, not {expected_db:.2}");
    }
}

/// Sum of the echoes of a small metal plate with this depth, whose middle is beside the radar's axis.
fn plate_echo(depth_m: f64, offset_m: f64) -> Complex64 {
    let walls = ["x_low", "x_high", "y_low", "y_high", "floor", "ceiling"]
        .map(|wall| format!("{wall} = {{ material = \"open\" }}\n"));
    let room = format!("size_m = [20.0, 20.0, 3.0]\nsolver = \"rays\"\nmax_reflections = 1\n{}", walls.concat());
    let plate = format!(
        "[[furniture]]\nname = \"plate\"\nposition_m = [4.5, {}, 1.175]\nsize_m = [{depth_m}, 0.05, 0.05]\nmaterial = \"metal\"\n",
        0.975 + offset_m
    );
    let scene = common::parse(&common::hall_with_room(&room, &format!("{}{plate}", common::NOBODY)));
    let of_plate =
        static_paths(&scene, 60.0).into_iter().filter(|path| path.rx == 1 && (path.length_m - 8.0).abs() < 0.01);
    of_plate.map(|path| Complex64::from_polar(10f64.powf(path.gain_db / 20.0), path.phase_rad)).sum()
}

/// Regression test: the edges behind the front of a box changed its mirror echo by up to 2.3 dB.
#[test]
fn a_box_has_the_mirror_echo_of_its_front() {
    for offset_m in [0.0, 0.01, 0.02, 0.023, 0.024, 0.025, 0.0275, 0.03] {
        let [sheet, shallow, deep] = [0.0, 0.03, 0.3].map(|depth_m| plate_echo(depth_m, offset_m));
        for of_box in [shallow, deep] {
            let difference = (of_box - sheet).norm() / sheet.norm();
            assert!(difference < 0.01, "{offset_m} m: {difference:.3}, {of_box:.3e} {sheet:.3e}");
        }
    }
}

/// A hole at the reflection point of a wall removes that path; paths far from the hole are unchanged.
#[test]
fn a_hole_in_a_wall_removes_only_the_paths_at_it() {
    let [low, high] = [[0.125, 0.75], [1.25, 1.75]];
    let outer = panel(0.0, SIZE_M[0]);
    let inner = [[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]].map(|[x, z]| [x, 0.0, z]);
    let ring: Vec<Quad> = (0..4).map(|i| [outer[i], outer[(i + 1) % 4], inner[(i + 1) % 4], inner[i]]).collect();
    let quads = faces([0.0; 3], SIZE_M);
    let mut all = triangles(&[0, 1, 3, 4, 5].map(|side| quads[side]));
    all.extend(triangles(&ring));
    let holed = scene_from_file(("room.stl", MILLIMETRES, stl(&all, 1000.0)));
    let whole = scene_with_wall(&[outer]);
    // Farther than a metre from the hole no path is within reach of its rim.
    let is_far = |path: &ListedPath| {
        path.points_m.iter().all(|[x, y, _]| y.abs() > 1e-6 || !(low[0] - 1.0..high[0] + 1.0).contains(x))
    };
    let far_paths = |paths: Vec<ListedPath>| -> Vec<ListedPath> { paths.into_iter().filter(is_far).collect() };
    assert!(static_paths(&whole, 10.0).iter().any(is_straight_from_wall));
    assert!(!static_paths(&holed, 13.0).iter().any(is_straight_from_wall));
    let expected = far_paths(static_paths(&whole, 10.0));
    assert!(expected.len() > 5, "{} paths", expected.len());
    assert_contains_paths(&expected, &static_paths(&holed, 13.0), "holed");
    assert_contains_paths(&far_paths(static_paths(&holed, 10.0)), &static_paths(&whole, 13.0), "whole");
}

/// A room without a ceiling lacks exactly the paths by the ceiling; corners of walls and floor reflect as before.
#[test]
fn an_open_ceiling_removes_only_the_paths_by_way_of_it() {
    let room = |ceiling: &str| room_scene(&format!("solver = \"rays\"\n{}", box_keys(ceiling)), WALKER, Path::new(""));
    let (closed, open) = (room("plasterboard"), room("open"));
    let is_by_ceiling = |path: &ListedPath| path.points_m.iter().any(|[.., z]| *z > SIZE_M[2] - 1e-6);
    // Paths that combine several contributions have no corners.
    let other_paths = |paths: Vec<ListedPath>| -> Vec<ListedPath> {
        paths.into_iter().filter(|path| !path.points_m.is_empty() && !is_by_ceiling(path)).collect()
    };
    let of_closed = listed_paths(&closed, 10.0);
    assert!(of_closed.iter().filter(|path| is_by_ceiling(path)).count() > 5);
    let expected = other_paths(of_closed);
    assert!(expected.len() > 20, "{} paths", expected.len());
    assert_contains_paths(&expected, &listed_paths(&open, 13.0), "open");
    let of_open = listed_paths(&open, 10.0);
    assert!(!of_open.iter().any(is_by_ceiling));
    assert_contains_paths(&other_paths(of_open), &listed_paths(&closed, 13.0), "closed");
}

fn metal_box() -> BoxRoom {
    BoxRoom::new(DVec3::new(5.0, 4.0, 2.6), [Wall::Conductor; 6], WAVENUMBER, false)
}

/// On a wall the antenna and its image in that wall coincide. All other images are those of an antenna a millimetre
/// off.
#[test]
fn an_antenna_on_a_wall_has_the_images_of_one_a_millimetre_before_it() {
    let room = metal_box();
    let environment = Arc::new(Environment::new(Facet::of_box(&room), WAVENUMBER).expect("facets"));
    let (on_wall, before_wall) = (DVec3::new(0.0, 1.5, 1.2), DVec3::new(0.001, 1.5, 1.2));
    let paths = ImagePaths::discover(environment, on_wall, &LaunchOptions::default());
    // Across x, only those whose first reflection is at the far wall: once, then twice and three times in turn.
    let all = images(3).into_iter().filter(|index| [0, 1, -2, 3].contains(&index[0]));
    let all: Vec<ImageIndex> = all.collect();
    assert_eq!(paths.images().len(), all.len(), "{:?}", paths.report());
    for index in all {
        let position = room.image_position(index, before_wall);
        let mut found = paths.images().iter();
        let found = found.position(|i| i.order as u32 == order(index) && i.position.distance(position) < 1.5e-3);
        let found = found.unwrap_or_else(|| panic!("no image {index:?}"));
        for point in [DVec3::new(2.1, 2.9, 0.8), DVec3::new(4.2, 0.7, 1.9), DVec3::new(1.3, 1.1, 1.3)] {
            let on = paths.illuminate(&isotropic(on_wall, DVec3::Z), found, point).field;
            let before = room.illuminate(&isotropic(before_wall, DVec3::Z), index, point).field;
            // Directions differ by a milliradian at most.
            let difference = (on.re - before.re).length() + (on.im - before.im).length();
            assert!(difference < 5e-3, "{index:?} {point}: {difference}");
        }
    }
}

/// A millimetre from two metal walls, three images cancel most of the antenna's field: the sum is that of a corner
/// reflector antenna. At 45 degrees the path by both walls goes through their edge.
#[test]
fn the_field_of_an_antenna_in_a_corner_agrees_with_the_closed_form() {
    let distance_m = 1e-3;
    let antenna = isotropic(DVec3::new(distance_m, distance_m, 1.2), DVec3::Z);
    let environment = Environment::new(Facet::of_box(&metal_box()), WAVENUMBER).expect("facets");
    let paths = ImagePaths::discover(Arc::new(environment), antenna.position, &LaunchOptions::default());
    let is_near = |i: &usize| paths.images()[*i].position.distance(antenna.position) < 0.01;
    let of_corner: Vec<usize> = (0..paths.images().len()).filter(is_near).collect();
    assert_eq!(of_corner.len(), 4, "{:?}", paths.report());
    for degrees in [20.0f64, 30.0, 45.0, 60.0, 70.0] {
        let (sine, cosine) = degrees.to_radians().sin_cos();
        let point = DVec3::new(3.0 * cosine, 3.0 * sine, 1.2);
        let field_of_image = |&image: &usize| {
            let illumination = paths.illuminate(&antenna, image, point);
            let distance_m = illumination.distance_m;
            let wave = Complex64::from_polar(1.0 / distance_m, -WAVENUMBER * distance_m);
            Complex64::new(illumination.field.re.z, illumination.field.im.z) * wave
        };
        let sum: Complex64 = of_corner.iter().map(field_of_image).sum();
        let factor = |cosine: f64| 2.0 * (WAVENUMBER * distance_m * cosine).sin();
        let expected = factor(cosine) * factor(sine) / 3.0;
        assert!((sum.norm() / expected - 1.0).abs() < 0.01, "{degrees}: {} {expected}", sum.norm());
    }
}

/// Paths across the rim of a sheet, along it, and in the sheet's plane give finite fields, exactly and at offsets below
/// the resolution of rays.
#[test]
fn paths_along_edges_and_in_planes_have_finite_fields() {
    let corners = [[2.0, 0.0, 0.0], [2.0, 1.5, 0.0], [2.0, 1.5, 2.6], [2.0, 0.0, 2.6]].map(DVec3::from_array);
    let mut facets = Facet::of_box(&metal_box());
    facets.push(Facet::new(corners.to_vec(), Wall::Conductor));
    facets.push(Facet::new(corners.into_iter().rev().collect(), Wall::Conductor));
    let environment = Arc::new(Environment::new(facets, WAVENUMBER).expect("facets"));
    assert_eq!(environment.diffracting_edges().len(), 1);
    let straight = |from: DVec3, to: DVec3, polarisation: DVec3| {
        let paths = ImagePaths::with_sequences(Arc::clone(&environment), from, Vec::<Vec<u32>>::new());
        let element = isotropic(from, polarisation);
        paths.illuminate(&element, 0, to).field.magnitude()
    };
    for off_m in [0.0, 1e-9, -1e-9, 1e-6, -1e-6] {
        let aside = |axis: DVec3, point: [f64; 3]| DVec3::from_array(point) + axis * off_m;
        // Half a plane leaves half of the field.
        let across = straight(aside(DVec3::Y, [1.0, 1.5, 1.2]), aside(DVec3::Y, [3.0, 1.5, 1.2]), DVec3::Z);
        assert!((across - 0.5).abs() < 0.01, "{off_m}: {across}");
        let before = straight(aside(DVec3::X, [2.0, 3.5, 1.2]), aside(DVec3::X, [2.0, 2.0, 1.2]), DVec3::Z);
        assert!((before - 1.0).abs() < 1e-3, "{off_m}: {before}");
        for axis in [DVec3::X, DVec3::Y] {
            let in_sheet = straight(aside(axis, [2.0, 3.5, 1.2]), aside(axis, [2.0, 0.5, 1.2]), DVec3::Z);
            let along_rim = straight(aside(axis, [2.0, 1.5, 0.3]), aside(axis, [2.0, 1.5, 2.3]), DVec3::X);
            assert!((0.0..1.2).contains(&in_sheet) && (0.0..1.2).contains(&along_rim), "{in_sheet} {along_rim}");
        }
    }
    let in_crease = straight(DVec3::new(1.0, 4.0, 0.0), DVec3::new(4.0, 4.0, 0.0), DVec3::Z);
    assert!((0.0..1.2).contains(&in_crease), "{in_crease}");
}
