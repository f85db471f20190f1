//! Rooms from boxes, floor plans and files as plane faces with edges.

pub mod rooms;

use std::path::Path;

use glam::DVec3;
use radome_sim::Scene;
use radome_sim::em::image::Wall;
use radome_sim::scene::surfaces::{EdgeKind, FaceEdge, Sides, Surfaces};
use rooms::{
    METRES, MILLIMETRES, Quad, SIZE_M, assert_same_surfaces, box_keys, count, face, faces, gltf, is_flat, is_free,
    is_inner, is_seam, is_wedge, obj, parse_room, room_files, small_triangles, stl, surfaces, surfaces_from_file,
    triangles,
};

use crate::common;

/// Diffracting edges, each once: a wedge is represented by the edge that its lower face lists.
fn diffracting_edges(room: &Surfaces) -> impl Iterator<Item = &FaceEdge> {
    room.edges.iter().filter(|edge| match edge.kind {
        EdgeKind::Wedge { other: Some(other), .. } => edge.face < other,
        _ => edge.diffracts(),
    })
}

fn room_quads() -> [Quad; 6] {
    faces([0.0; 3], SIZE_M)
}

/// Keys of a plasterboard room over given corners, with further tables of the plan.
pub fn plan_keys(corners: &[[f64; 2]], tables: &str) -> String {
    format!(
        "floor = {{ material = \"plasterboard\", thickness_m = 0.0125 }}\n\
         ceiling = {{ material = \"plasterboard\", thickness_m = 0.0125 }}\n[room.plan]\ncorners_m = {corners:?}\n\
         height_m = 2.75\nwalls = {{ material = \"plasterboard\", thickness_m = 0.0125 }}\n{tables}"
    )
}

pub const RECTANGLE: [[f64; 2]; 4] = [[0.0, 0.0], [5.25, 0.0], [5.25, 4.5], [0.0, 4.5]];
const L_SHAPE: [[f64; 2]; 6] = [[0.0, 0.0], [8.0, 0.0], [8.0, 2.0], [2.0, 2.0], [2.0, 6.0], [0.0, 6.0]];

fn reversed<const N: usize>(mut corners: [[f64; 2]; N]) -> [[f64; 2]; N] {
    corners.reverse();
    corners
}

#[test]
fn a_box_has_six_inward_faces_and_no_diffracting_edge() {
    let room = surfaces(&box_keys("plasterboard"), "");
    assert_eq!(room.faces.len(), 6);
    let middle = 0.5 * DVec3::from_array(SIZE_M);
    let area_m2: f64 = room.faces.iter().map(|face| face.polygon.area_m2()).sum();
    assert!((area_m2 - 2.0 * (5.25 * 4.5 + 4.5 * 2.75 + 2.75 * 5.25)).abs() < 1e-12);
    for face in &room.faces {
        assert!(face.polygon.height_m(middle) > 1.0 && face.sides == Sides::One, "{face:?}");
        assert!(matches!(face.wall, Wall::Slab { thickness_m: 0.0125, .. }));
    }
    assert_eq!((count(&room, is_inner), room.edges.len(), diffracting_edges(&room).count()), (24, 24, 0));
    assert!(room.small.is_empty());
    let mesh = room.triangles();
    assert_eq!(mesh.triangles.len(), 12);
    assert!((mesh.area_m2() - area_m2).abs() < 1e-12);
}

#[test]
fn a_box_is_the_same_from_toml_obj_stl_gltf_and_a_plan() {
    let expected = surfaces(&box_keys("plasterboard"), "");
    for file in room_files() {
        let name = file.0;
        assert_same_surfaces(&surfaces_from_file("", file), &expected, name);
    }
    // The origin of the file does not matter.
    let moved = faces([-3.0, -2.0, 1.0], [2.25, 2.5, 3.75]);
    assert_same_surfaces(&surfaces_from_file("", ("room.gltf", "", gltf(&moved))), &expected, "moved");
    for corners in [RECTANGLE, reversed(RECTANGLE)] {
        assert_same_surfaces(&surfaces(&plan_keys(&corners, ""), ""), &expected, "plan");
    }
}

#[test]
fn faces_have_the_materials_of_their_parts() {
    let quads = room_quads();
    let names = ["plaster", "plaster", "plaster", "pane", "steel", "plaster"];
    let named: Vec<(Quad, &str)> = quads.into_iter().zip(names).collect();
    let keys = box_keys("plasterboard")
        .replace("y_high = { material = \"plasterboard\"", "y_high = { material = \"glass\"")
        .replace("floor = { material = \"plasterboard\"", "floor = { material = \"metal\"");
    assert_same_surfaces(&surfaces_from_file("", ("room.obj", METRES, obj(&named))), &surfaces(&keys, ""), "materials");
}

/// A cupboard on the floor and against a wall: two of its sides lie on those, five of its edges are free to diffract.
#[test]
fn furniture_of_a_material_has_faces_and_wedges() {
    let cupboard = "[[furniture]]\nname = \"cupboard\"\nposition_m = [2.0, 0.0, 0.0]\nsize_m = [0.8, 0.4, 1.9]\n";
    let with_metal = format!("{cupboard}material = \"metal\"\n");
    let room = surfaces(&box_keys("plasterboard"), &with_metal);
    let names: Vec<&str> = room.faces.iter().map(|face| face.name.as_str()).collect();
    let walls = ["x_low", "x_high", "y_low", "y_high", "floor", "ceiling"];
    assert_eq!(names[..6], walls);
    assert_eq!(names[6..], ["cupboard x_low", "cupboard x_high", "cupboard y_high", "cupboard top"]);
    let (_, front) = face(&room, "cupboard y_high");
    assert_eq!((front.polygon.normal, front.wall, front.sides), (DVec3::Y, Wall::Conductor, Sides::One));
    assert_eq!((diffracting_edges(&room).count(), count(&room, is_wedge), count(&room, is_free)), (5, 10, 0));
    for edge in diffracting_edges(&room) {
        let length_m = edge.ends[0].distance(edge.ends[1]);
        assert!([0.4, 0.8, 1.9].iter().any(|m| (m - length_m).abs() < 1e-9), "{edge:?}");
    }
    // Furniture with only a cross-section remains a set of points.
    assert_eq!(surfaces(&box_keys("plasterboard"), cupboard).faces.len(), 6);
    // A board without depth is one sheet with air on both sides.
    let board = "[[furniture]]\nname = \"board\"\nposition_m = [2.0, 2.0, 0.5]\nsize_m = [0.8, 0.0, 1.0]\n\
                 material = \"wood\"\n";
    let room = surfaces(&box_keys("plasterboard"), board);
    assert_eq!((room.faces.len(), diffracting_edges(&room).count(), count(&room, is_free)), (7, 4, 4));
    assert_eq!(room.faces[6].sides, Sides::Two);
}

#[test]
fn an_l_shaped_room_has_one_wedge_at_its_inner_corner() {
    for corners in [L_SHAPE, reversed(L_SHAPE)] {
        let scene = parse_room(&plan_keys(&corners, ""), "", Path::new("")).expect("a good scene");
        assert_eq!(scene.room().size_m, DVec3::new(8.0, 6.0, 2.75));
        let room = scene.surfaces();
        assert_eq!(room.faces.len(), 8);
        assert!(room.faces.iter().all(|face| face.sides == Sides::One));
        let all: Vec<_> = diffracting_edges(&room).collect();
        let [edge] = all.as_slice() else { panic!("{all:?}") };
        assert!(edge.ends.iter().all(|end| end.truncate().distance(glam::DVec2::splat(2.0)) < 1e-9), "{edge:?}");
        assert!(is_wedge(&edge.kind), "{edge:?}");
        // The normals point into the room.
        for face in &room.faces {
            let inside = face.polygon.inner_point() + face.polygon.normal * 0.01;
            let floor = &room.faces.iter().find(|face| face.name == "floor").expect("a floor").polygon;
            assert!(floor.contains(inside.with_z(0.0)) && (0.0..2.75).contains(&inside.z), "{face:?}");
        }
    }
}

const DOORWAY: &str = "[[room.plan.opening]]\nwall = 0\nfrom_m = 3.0\nto_m = 3.9\nhead_m = 2.0\n";
const WINDOW: &str = "[[room.plan.opening]]\nwall = 2\nfrom_m = 1.0\nto_m = 2.5\nsill_m = 1.0\nhead_m = 2.0\n";

#[test]
fn openings_reduce_their_wall_and_have_free_edges() {
    let room = surfaces(&plan_keys(&RECTANGLE, DOORWAY), "");
    let (_, wall) = face(&room, "wall 0");
    assert_eq!((wall.polygon.outline.len(), wall.polygon.holes.len(), wall.sides), (8, 0, Sides::Two));
    assert!((wall.polygon.area_m2() - (5.25 * 2.75 - 0.9 * 2.0)).abs() < 1e-9);
    // Two jambs, the head, and the floor at the threshold.
    assert_eq!(count(&room, is_free), 4, "{:?}", room.edges);
    let room = surfaces(&plan_keys(&RECTANGLE, WINDOW), "");
    let (_, wall) = face(&room, "wall 2");
    assert_eq!((wall.polygon.outline.len(), wall.polygon.holes.len(), wall.sides), (4, 1, Sides::Two));
    assert_eq!(count(&room, is_free), 4);
    // Wall 2 leads from (5.25, 4.5) towards lower x.
    assert!(!wall.polygon.contains(DVec3::new(3.5, 4.5, 1.5)) && wall.polygon.contains(DVec3::new(1.5, 4.5, 1.5)));
}

#[test]
fn panes_and_shut_doors_close_a_room() {
    let tables = format!("{WINDOW}material = \"glass\"\n{DOORWAY}door = {{ hinge = \"to\", material = \"wood\" }}\n");
    let room = surfaces(&plan_keys(&RECTANGLE, &tables), "");
    // Both faces list a seam: four around the pane, three around the leaf.
    assert_eq!((room.faces.len(), diffracting_edges(&room).count(), count(&room, is_free)), (8, 14, 0));
    assert!(room.faces.iter().all(|face| face.sides == Sides::One));
    let (pane, of_pane) = face(&room, "pane in wall 2");
    let (wall, _) = face(&room, "wall 2");
    assert!(matches!(of_pane.wall, Wall::Slab { thickness_m: 0.006, .. }));
    let is_of_wall = |edge: &FaceEdge| edge.kind == EdgeKind::Seam { other: wall };
    assert!(room.edges.iter().filter(|edge| edge.face == pane).all(is_of_wall));
    let (_, leaf) = face(&room, "door in wall 0");
    assert!((leaf.polygon.normal - DVec3::Y).length() < 1e-12 && (leaf.polygon.area_m2() - 1.8).abs() < 1e-12);
    assert_eq!((count(&room, is_seam), count(&room, is_flat)), (14, 0));
    // A pane of what the wall is made of changes nothing for waves.
    let tables = format!("{WINDOW}material = \"plasterboard\"\nthickness_m = 0.0125\n");
    let room = surfaces(&plan_keys(&RECTANGLE, &tables), "");
    assert_eq!((diffracting_edges(&room).count(), count(&room, is_flat)), (0, 8));
}

#[test]
fn door_leaves_turn_about_their_hinges() {
    let leaf_ends = |hinge: &str, open_deg: f64, corners: &[[f64; 2]], wall: usize| {
        let doorway = DOORWAY.replace("wall = 0", &format!("wall = {wall}"));
        let tables = format!("{doorway}door = {{ hinge = {hinge:?}, open_deg = {open_deg:?}, material = \"wood\" }}\n");
        let room = surfaces(&plan_keys(corners, &tables), "");
        let (face_index, leaf) = face(&room, &format!("door in wall {wall}"));
        assert_eq!(leaf.sides, Sides::Two);
        let mut lower_corners: Vec<DVec3> = leaf.polygon.outline.iter().filter(|c| c.z == 0.0).copied().collect();
        lower_corners.sort_by(|a, b| a.y.abs().total_cmp(&b.y.abs()));
        // Free edges: the jamb of the lock, the head, the threshold, the leaf's far edge and its top; for a door that
        // opens outwards, also the leaf's lower edge.
        assert_eq!(count(&room, is_free), if open_deg > 0.0 { 5 } else { 6 }, "{:?}", room.edges);
        let edges_at_hinge = room.edges.iter().filter(|edge| edge.face == face_index && is_wedge(&edge.kind)).count();
        assert_eq!(edges_at_hinge, 1, "{:?}", room.edges);
        lower_corners
    };
    let assert_near = |found: &[DVec3], expected: [[f64; 2]; 2]| {
        let expected = expected.map(|[x, y]| DVec3::new(x, y, 0.0));
        assert!(found.iter().zip(expected).all(|(a, b)| a.distance(b) < 1e-9) && found.len() == 2, "{found:?}");
    };
    let (cosine, sine) = (0.9 * 0.5, 0.9 * f64::sqrt(0.75));
    assert_near(&leaf_ends("from", 60.0, &RECTANGLE, 0), [[3.0, 0.0], [3.0 + cosine, sine]]);
    assert_near(&leaf_ends("to", 60.0, &RECTANGLE, 0), [[3.9, 0.0], [3.9 - cosine, sine]]);
    assert_near(&leaf_ends("from", -60.0, &RECTANGLE, 0), [[3.0, 0.0], [3.0 + cosine, -sine]]);
    // With reversed corners, wall 2 leads from (5.25, 0) to the origin.
    assert_near(&leaf_ends("from", 60.0, &reversed(RECTANGLE), 2), [[2.25, 0.0], [2.25 - cosine, sine]]);
}

#[test]
fn partitions_have_air_on_both_sides_and_a_free_edge() {
    let partition = "[[room.plan.partition]]\nfrom_m = [3.0, 0.0]\nto_m = [3.0, 2.5]\nmaterial = \"glass\"\n\
                     thickness_m = 0.01\n";
    let room = surfaces(&plan_keys(&RECTANGLE, partition), "");
    let (number, glass) = face(&room, "partition 0");
    assert_eq!((room.faces.len(), glass.sides), (7, Sides::Two));
    assert!(matches!(glass.wall, Wall::Slab { thickness_m: 0.01, .. }));
    let kinds: Vec<EdgeKind> = room.edges.iter().filter(|e| e.face == number).map(|e| e.kind).collect();
    assert_eq!(kinds.len(), 4);
    assert_eq!(kinds.iter().filter(|kind| is_inner(kind)).count(), 3, "{kinds:?}");
    assert_eq!((count(&room, is_free), diffracting_edges(&room).count()), (1, 1));
    // Walls remain closed.
    assert_eq!(room.faces.iter().filter(|face| face.sides == Sides::One).count(), 6);
    // Partition with its own opening, lower than the room.
    let low = format!(
        "{partition}height_m = 2.0\n[[room.plan.partition.opening]]\nfrom_m = 1.0\nto_m = 1.5\nsill_m = 1.0\nhead_m = 1.5\n"
    );
    let room = surfaces(&plan_keys(&RECTANGLE, &low), "");
    let (_, glass) = face(&room, "partition 0");
    assert!((glass.polygon.area_m2() - (5.0 - 0.25)).abs() < 1e-9 && glass.polygon.holes.len() == 1);
    assert_eq!(count(&room, is_free), 2 + 4);
}

#[test]
fn fixture_scenes_have_the_expected_surfaces() {
    let surfaces_of = |name: &str| -> Surfaces { common::scene(name).surfaces() };
    assert_eq!(surfaces_of("corridor").faces.len(), 6);
    let corridor = surfaces_of("l-corridor");
    assert_eq!((corridor.faces.len(), diffracting_edges(&corridor).count()), (8, 1));
    let cupboard = surfaces_of("cupboard");
    assert!(cupboard.faces.iter().filter(|face| face.wall == Wall::Conductor).count() >= 4);
    assert!(diffracting_edges(&cupboard).count() >= 5);
    assert_eq!(face(&surfaces_of("half-open-door"), "door in partition 0").1.sides, Sides::Two);
    assert_eq!(face(&surfaces_of("glass-wall"), "partition 0").1.sides, Sides::Two);
    // A table within the walls: all six sides of the room, and those of the table.
    assert_eq!(surfaces_of("room-mesh").faces.iter().filter(|face| face.sides == Sides::One).count(), 12);
}

#[test]
fn most_triangles_of_an_open_plan_room_belong_to_faces() {
    let scene = common::scene("open-plan");
    let room = scene.surfaces();
    let mesh = room.triangles();
    assert!((8_000..12_000).contains(&mesh.triangles.len()), "{}", mesh.triangles.len());
    assert!(small_triangles(&room) * 2 < mesh.triangles.len(), "{}", small_triangles(&room));
    assert!(diffracting_edges(&room).count() > 1000);
}

mod hard_cases {
    use super::*;

    #[test]
    fn reversed_triangles_change_no_surface() {
        let expected = surfaces(&box_keys("plasterboard"), "");
        let all_triangles = triangles(&room_quads());
        for pattern in [0u32, 0xFFF, 0b0000_0001_0000, 0b1010_0110_0101, 0b0011_0011_0011] {
            let reversed_triangles: Vec<[[f64; 3]; 3]> = all_triangles
                .iter()
                .enumerate()
                .map(|(t, &[a, b, c])| if pattern >> t & 1 == 1 { [a, c, b] } else { [a, b, c] })
                .collect();
            assert_same_surfaces(
                &surfaces_from_file("", ("room.stl", MILLIMETRES, stl(&reversed_triangles, 1000.0))),
                &expected,
                &format!("{pattern:b}"),
            );
        }
    }

    #[test]
    fn a_room_without_ceiling_is_five_sheets() {
        let expected = surfaces(&box_keys("open"), "");
        assert_eq!(expected.faces.len(), 5);
        assert!(expected.faces.iter().all(|face| face.sides == Sides::Two));
        // From inside, only the rim diffracts; the corners of the sheets diffract outside.
        assert_eq!((count(&expected, is_free), diffracting_edges(&expected).count()), (4, 4 + 8));
        let keys = "ceiling = { material = \"open\" }\n";
        let all = room_quads();
        let by_stl = surfaces_from_file(keys, ("room.stl", MILLIMETRES, stl(&triangles(&all[..5]), 1000.0)));
        assert_same_surfaces(&by_stl, &expected, "stl");
        let plan = plan_keys(&RECTANGLE, "").replacen(
            "ceiling = { material = \"plasterboard\"",
            "ceiling = { material = \"open\"",
            1,
        );
        assert_same_surfaces(&surfaces(&plan, ""), &expected, "plan");
    }

    /// A wall of many triangles beside walls of two: edges are found along parts of edges.
    #[test]
    fn finely_split_walls_are_one_face() {
        let expected = surfaces(&box_keys("plasterboard"), "");
        let quads = room_quads();
        let mut all = triangles(&quads[1..]);
        // x = 0 in 7 by 5 quadrilaterals.
        let at = |i: usize, j: usize| [0.0, SIZE_M[1] * i as f64 / 7.0, SIZE_M[2] * j as f64 / 5.0];
        for (i, j) in (0..7).flat_map(|i| (0..5).map(move |j| (i, j))) {
            all.extend(triangles(&[[at(i, j), at(i, j + 1), at(i + 1, j + 1), at(i + 1, j)]]));
        }
        // The file is f32: corners within edges are off by its rounding, those of the room are not.
        assert_same_surfaces(&surfaces_from_file("", ("room.stl", MILLIMETRES, stl(&all, 1000.0))), &expected, "split");
    }

    /// A wall around a window: four quadrilaterals between outer and inner corners.
    #[test]
    fn walls_of_files_keep_their_holes() {
        let quads = room_quads();
        let outer = [[0.0, 0.0, 0.0], [5.25, 0.0, 0.0], [5.25, 0.0, 2.75], [0.0, 0.0, 2.75]];
        let inner = [[1.0, 0.0, 1.0], [2.5, 0.0, 1.0], [2.5, 0.0, 2.0], [1.0, 0.0, 2.0]];
        let ring = (0..4).map(|i| [outer[i], outer[(i + 1) % 4], inner[(i + 1) % 4], inner[i]]);
        let mut all: Vec<Quad> = ring.collect();
        all.extend([quads[0], quads[1], quads[3], quads[4], quads[5]]);
        let room = surfaces_from_file("", ("room.stl", MILLIMETRES, stl(&triangles(&all), 1000.0)));
        assert_eq!((room.faces.len(), count(&room, is_free)), (6, 4));
        let walls: Vec<_> = room.faces.iter().filter(|face| !face.polygon.holes.is_empty()).collect();
        let [wall] = walls.as_slice() else { panic!("{walls:?}") };
        assert!((wall.polygon.area_m2() - (5.25 * 2.75 - 1.5)).abs() < 1e-9);
        let same = surfaces(&plan_keys(&RECTANGLE, &WINDOW.replace("wall = 2", "wall = 0")), "");
        let of_plan = &face(&same, "wall 0").1.polygon;
        assert!((of_plan.area_m2() - wall.polygon.area_m2()).abs() < 1e-9);
    }

    #[test]
    fn faces_on_faces_are_left_out() {
        let quads = room_quads();
        let poster: Quad = [[1.0, 0.0, 1.0], [2.0, 0.0, 1.0], [2.0, 0.0, 2.0], [1.0, 0.0, 2.0]];
        let expected = surfaces(&box_keys("plasterboard"), "");
        let mut all: Vec<(Quad, &str)> = quads.iter().map(|&quad| (quad, "plaster")).collect();
        // A duplicated wall, and a poster on another wall.
        all.push((quads[1], "pane"));
        all.push((poster, "steel"));
        let room = surfaces_from_file("", ("room.obj", METRES, obj(&all)));
        assert_same_surfaces(&room, &expected, "once");
    }

    /// Strips a millimetre wide are faces, parts below the least area remain triangles, and both are connected.
    #[test]
    fn slivers_become_faces_and_small_parts_remain_triangles() {
        let quads = room_quads();
        let mut all: Vec<(Quad, &str)> = quads.iter().map(|&quad| (quad, "plaster")).collect();
        let rail = faces([1.0, 2.0, 1.0], [4.0, 2.001, 1.1]);
        let knob = faces([2.0, 3.0, 1.0], [2.05, 3.05, 1.05]);
        all.extend(rail.iter().map(|&quad| (quad, "steel")));
        all.extend(knob.iter().map(|&quad| (quad, "steel")));
        let room = surfaces_from_file("", ("room.obj", METRES, obj(&all)));
        // Two sides of the rail are 0.3 m^2, the other four below 0.01 m^2.
        assert_eq!((room.faces.len(), small_triangles(&room)), (6 + 2, 2 * 4 + 2 * 6));
        // The rail's long edges are wedges with those small sides.
        let wedges = room.edges.iter().filter(|e| matches!(e.kind, EdgeKind::Wedge { other: None })).count();
        assert_eq!(wedges, 8, "{:?}", room.edges);
    }

    #[test]
    fn invalid_plans_are_refused_with_the_expected_value() {
        let assert_refused = |room: &str, tables: &str, expected: &[&str]| {
            let message = parse_room(room, tables, Path::new("a")).map(|_| ()).expect_err(room).to_string();
            assert!(message.starts_with("a/scene.toml:"), "{message}");
            assert!(expected.iter().all(|word| message.contains(word)), "{expected:?}: {message}");
        };
        let plan = |corners: &[[f64; 2]]| plan_keys(corners, "");
        assert_refused(&plan(&[[0.0, 0.0], [5.0, 4.0], [5.0, 0.0], [0.0, 4.0]]), "", &["corners_m", "walls 0 and 2"]);
        assert_refused(&plan(&[[0.0, 0.0], [5.0, 0.0], [2.0, 0.0], [2.0, 4.0]]), "", &["corners_m", "walls 0 and 1"]);
        assert_refused(&plan(&[[0.0, 0.0], [5.0, 0.0]]), "", &["corners_m", "3 to 200 corners"]);
        assert_refused(
            &plan(&[[1.0, 0.0], [5.0, 0.0], [5.0, 4.0], [1.0, 4.0]]),
            "",
            &["corners_m", "0 as the least x"],
        );
        assert_refused(&plan(&[[0.0, 0.0], [0.01, 0.0], [5.0, 4.0], [0.0, 4.0]]), "", &["corners_m", "5 cm"]);
        assert_refused(
            &plan(&[[0.0, 0.0], [f64::NAN, 0.0], [5.0, 4.0]]).replace("NaN", "nan"),
            "",
            &["corners_m", "100 m"],
        );
        let valid = plan(&RECTANGLE);
        assert_refused(&valid.replace("height_m = 2.75", "height_m = 0.1"), "", &["height_m", "0.5 to 100 m"]);
        assert_refused(
            &valid.replace("walls = { material = \"plasterboard\"", "walls = { material = \"cheese\""),
            "",
            &["walls", "cheese"],
        );
        assert_refused(&format!("size_m = [5, 4, 3]\n{valid}"), "", &["size_m", "beside [room.plan]"]);
        assert_refused(&format!("x_low = {{ material = \"wood\" }}\n{valid}"), "", &["x_low", "beside [room.plan]"]);
        assert_refused(&valid.replacen("floor", "#", 1), "", &["floor", "missing"]);
        assert_refused(&format!("{valid}\n[[room.mesh]]\nfile = \"a.stl\"\n"), "", &["plan", "either"]);
        let plan_with = |tables: &str| plan_keys(&RECTANGLE, tables);
        assert_refused(
            &plan_with("[[room.plan.wall]]\nindex = 4\nmaterial = \"wood\"\n"),
            "",
            &["index", "number of walls, 4"],
        );
        let opening = |from: &str, to: &str| plan_with(&DOORWAY.replace(from, to));
        assert_refused(
            &opening("wall = 0", "wall = 7"),
            "",
            &["opening is with wall = 7", "number of walls, 4 (opening 0)"],
        );
        assert_refused(&opening("wall = 0\n", ""), "", &["opening", "wall = an index"]);
        assert_refused(
            &opening("head_m = 2.0", "head_m = 2.0\nthickness_m = 0.1"),
            "",
            &["thickness_m", "pane's material"],
        );
        assert_refused(&opening("to_m = 3.9", "to_m = 5.3"), "", &["opening", "within 0 to 5.25 m"]);
        assert_refused(&opening("to_m = 3.9", "to_m = 2.9"), "", &["opening", "from_m and to_m"]);
        assert_refused(&opening("head_m = 2.0", "head_m = 3.0"), "", &["opening", "within 0 to 2.75 m"]);
        let second = DOORWAY.replace("from_m = 3.0", "from_m = 3.8").replace("to_m = 3.9", "to_m = 4.5");
        assert_refused(
            &plan_with(&format!("{DOORWAY}{second}")),
            "",
            &["opening", "beside the one from 3 to 3.9 m (opening 1, wall 0)"],
        );
        let window = WINDOW.replace("to_m = 2.5", "to_m = 9.0");
        assert_refused(
            &plan_with(&format!("{DOORWAY}{window}")),
            "",
            &["[1.0, 9.0]", "within 0 to 5.25 m (opening 1, wall 2)"],
        );
        let door = "door = { hinge = \"from\", open_deg = 200.0, material = \"wood\" }\n";
        assert_refused(&plan_with(&format!("{DOORWAY}{door}")), "", &["open_deg", "-170 to 170"]);
        assert_refused(
            &plan_with(&format!("{DOORWAY}material = \"glass\"\n{}", door.replace("200", "20"))),
            "",
            &["material or door"],
        );
        let partition = "[[room.plan.partition]]\nfrom_m = [3.0, 0.0]\nto_m = [3.0, 2.5]\nmaterial = \"glass\"\n";
        assert_refused(&plan_with(&partition.replace("2.5]", "5.5]")), "", &["partition", "within the walls"]);
        let hatch = "[[room.plan.partition.opening]]\nfrom_m = 1.0\nto_m = 2.6\nhead_m = 1.5\n";
        assert_refused(&plan_with(&format!("{partition}{hatch}")), "", &["within 0 to 2.5 m (opening 0, partition 0)"]);
        assert_refused(&plan_with(&format!("{partition}height_m = 4.0\n")), "", &["height_m", "the room's"]);
        assert_refused(&plan_with(&partition.replace("3.0", "0.5")), "", &["position_m", "1 cm or more"]);
        let l = plan(&L_SHAPE);
        let shelf = "[[furniture]]\nname = \"a\"\nposition_m = [3.0, 1.5, 0.0]\nsize_m = [1.0, 1.0, 1.0]\n";
        assert_refused(&l, shelf, &["furniture", "walls of [room.plan]"]);
        assert_refused(&l, "[[seat]]\nposition_m = [4.0, 4.0]\nheading_deg = 0.0\n", &["seat", "walls of [room.plan]"]);
        assert_refused(&l, "[[door]]\nposition_m = [8.0, 4.0]\n", &["door", "wall of [room.plan]"]);
    }

    /// Regression test: a radar in a metal box detected only the box, without an error. It may be on a box, or within
    /// one that transmits waves.
    #[test]
    fn a_radar_within_furniture_is_refused() {
        let furniture = |height_m: f64| {
            format!(
                "[[furniture]]\nname = \"chest\"\nposition_m = [0.1, 0.5, 0.0]\nsize_m = [1.0, 1.0, {height_m:?}]\n\
                 material = \"metal\"\n"
            )
        };
        let scene = |keys: &str, height_m: f64| {
            parse_room(&format!("{keys}\n{}", box_keys("plasterboard")), &furniture(height_m), Path::new("a"))
        };
        common::assert_refused(scene("solver = \"rays\"", 2.0), &["position_m", "outside the furniture \"chest\""]);
        common::assert_refused(parse_room(&plan_keys(&RECTANGLE, ""), &furniture(2.0), Path::new("a")), &["chest"]);
        assert!(scene("solver = \"rays\"", 1.2).is_ok());
        assert!(scene("solver = \"rays\"\ntransmission = true", 2.0).is_ok());
        // Where images are those of the box, furniture is points, which hide nothing.
        assert!(scene("", 2.0).is_ok());
    }

    /// Rooms that a box cannot represent are not treated as boxes.
    #[test]
    fn an_l_shaped_plan_is_simulated_without_box_images() {
        let scene: Scene = parse_room(&plan_keys(&L_SHAPE, ""), "", Path::new("")).expect("a good scene");
        let simulator =
            radome_sim::Simulator::new(&scene, radome_sim::SimulateOptions::default()).expect("a simulator");
        assert!(simulator.frame_with_report(0).1.static_paths > 0);
        let boxed = plan_keys(&L_SHAPE, "").replacen("floor", "solver = \"images\"\nfloor", 1);
        common::assert_refused(parse_room(&boxed, "", Path::new("a")), &["solver", "[room.plan]"]);
    }
}
