//! Rooms from meshes, and materials defined by a scene.

use std::fmt::Write as _;
use std::path::Path;

use radome_sim::Scene;
use radome_sim::em::image::Wall;
use radome_sim::material::Material;

use crate::common;
use crate::surfaces::rooms::{self, Quad, faces};

/// Text STL of quadrilaterals, with `per_metre` units a metre.
fn stl(quads: &[Quad], per_metre: f64) -> String {
    rooms::stl(&rooms::triangles(quads), per_metre)
}

const MESHES: &str = r#"
[[room.mesh]]
file = "walls.stl"
unit = "mm"
up = "z"
material = "plasterboard"
thickness_m = 0.0125
[[room.mesh]]
file = "floor.stl"
unit = "mm"
up = "z"
material = "oak"
thickness_m = 0.02
[[room.mesh]]
file = "ceiling.stl"
unit = "m"
up = "z"
material = "concrete"
thickness_m = 0.2
[[room.mesh]]
file = "desk.stl"
unit = "m"
up = "z"
material = "metal"
[materials.oak]
permittivity = [2.4, 0.15]
band_ghz = [50, 70]
"#;

/// Folder with a room of 5 by 4 by 2.5 m whose low corner is at (-1, -2, 0), and a metal box in it.
fn folder() -> tempfile::TempDir {
    let folder = tempfile::tempdir().expect("a folder");
    let room = faces([-1.0, -2.0, 0.0], [4.0, 2.0, 2.5]);
    let write = |name: &str, text: String| std::fs::write(folder.path().join(name), text).expect("written");
    write("walls.stl", stl(&room[..4], 1000.0));
    write("floor.stl", stl(&room[4..5], 1000.0));
    write("ceiling.stl", stl(&room[5..], 1.0));
    write("desk.stl", stl(&faces([1.0, 0.0, 0.0], [2.0, 0.5, 0.7]), 1.0));
    folder
}

/// Scene in that folder.
fn scene_in_folder(folder: &tempfile::TempDir, meshes: &str) -> Result<Scene, radome_sim::SceneError> {
    rooms::parse_room(meshes, "", folder.path())
}

#[test]
fn an_stl_room_of_three_materials_is_a_box_with_their_walls() {
    let folder = folder();
    let scene = scene_in_folder(&folder, MESHES).expect("a good scene");
    let room = scene.room();
    assert!((room.size_m - glam::DVec3::new(5.0, 4.0, 2.5)).length() < 1e-6, "{}", room.size_m);
    let frequency_hz = scene.waveform().centre_frequency_hz();
    let slab = |material: Material, thickness_m| Wall::Slab {
        permittivity: material.permittivity(frequency_hz).expect("a dielectric"),
        thickness_m,
    };
    assert_eq!(room.walls[..4], [slab(Material::Plasterboard, 0.0125); 4]);
    assert_eq!(room.walls[4], Wall::Slab { permittivity: num_complex::Complex64::new(2.4, -0.15), thickness_m: 0.02 });
    assert_eq!(room.walls[5], slab(Material::Concrete, 0.2));
    // The desk keeps its place relative to the corner of the room.
    let [desk] = scene.file().furniture.as_slice() else { panic!("{:?}", scene.file().furniture) };
    let are_near = |a: [f64; 3], b: [f64; 3]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-6);
    assert!(are_near(desk.position_m, [2.0, 2.0, 0.0]) && are_near(desk.size_m, [1.0, 0.5, 0.7]), "{desk:?}");
    // A quarter of the sides and the top; an object on the floor has no underside.
    let area_m2 = 2.0 * 0.7 * 1.5 + 0.5;
    assert!((desk.cross_section_dbsm() - 10.0 * f64::log10(0.25 * area_m2)).abs() < 1e-6);
    let simulator = common::simulator(&scene, 1, None);
    assert!(simulator.frame_with_report(0).1.static_paths > 10);
}

/// Walls drawn as solids have an outer face as well; the room is their interior.
#[test]
fn an_obj_room_of_solid_walls_is_their_interior() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut text = String::new();
    let mut count = 0;
    let slabs = [
        ("brickwork", [-0.2, -0.2, 0.0], [0.0, 4.2, 3.0]),
        ("brickwork", [5.0, -0.2, 0.0], [5.2, 4.2, 3.0]),
        ("drywall", [0.0, -0.2, 0.0], [5.0, 0.0, 3.0]),
        ("drywall", [0.0, 4.0, 0.0], [5.0, 4.2, 3.0]),
        ("boards", [-0.2, -0.2, -0.1], [5.2, 4.2, 0.0]),
        ("boards", [-0.2, -0.2, 3.0], [5.2, 4.2, 3.1]),
    ];
    for (material, low, high) in slabs {
        writeln!(text, "o slab\nusemtl {material}").expect("text");
        for quad in faces(low, high) {
            // y up: (x, y, z) with z up is (x, z, -y).
            quad.iter().for_each(|[x, y, z]| writeln!(text, "v {x} {z} {}", -y).expect("text"));
            writeln!(text, "f {} {} {} {}", count + 1, count + 2, count + 3, count + 4).expect("text");
            count += 4;
        }
    }
    std::fs::write(folder.path().join("house.obj"), text).expect("written");
    let meshes = "[[room.mesh]]\nfile = \"house.obj\"\nunit = \"m\"\nup = \"y\"\n\
                  materials = { brickwork = \"brick\", drywall = \"plasterboard\", boards = \"floorboard\" }\n";
    let scene = scene_in_folder(&folder, meshes).expect("a good scene");
    assert!((scene.room().size_m - glam::DVec3::new(5.0, 4.0, 3.0)).length() < 1e-6, "{}", scene.room().size_m);
    let room = &scene.file().room;
    let names =
        [&room.x_low, &room.x_high, &room.y_low, &room.y_high, &room.floor, &room.ceiling].map(|s| s.material.as_str());
    assert_eq!(names, ["brick", "brick", "plasterboard", "plasterboard", "floorboard", "floorboard"]);
    assert!(scene.file().furniture.is_empty());
}

mod hard_cases {
    use super::*;

    /// Regression test: lists of paths had empty names for such surfaces.
    #[test]
    fn parts_without_a_name_are_named_by_their_material_or_file() {
        let [stl, obj, _] = rooms::room_files();
        for ((name, unit, text), expected) in [(stl, "room plasterboard"), (obj, "plaster")] {
            let lines = text.lines().filter(|line| !line.starts_with("o "));
            let nameless = lines.map(|line| line.replace(" part", "") + "\n").collect();
            let surfaces = rooms::surfaces_from_file("", (name, unit, nameless));
            assert!(surfaces.faces.iter().all(|face| face.name == expected), "{name}: {:?}", surfaces.faces);
        }
    }

    fn assert_scene_error(result: Result<Scene, radome_sim::SceneError>, expected: &[&str]) {
        common::assert_refused(result, &[expected, &["scene.toml:"]].concat());
    }

    #[test]
    fn invalid_room_tables_are_refused_with_a_hint() {
        let folder = folder();
        let assert_change_refused = |from: &str, to: &str, expected: &[&str]| {
            assert!(MESHES.contains(from), "{from}");
            assert_scene_error(scene_in_folder(&folder, &MESHES.replacen(from, to, 1)), expected);
        };
        assert_change_refused("unit = \"mm\"\n", "", &["walls.stl", "unit is not said", "hint: add unit"]);
        assert_change_refused("up = \"z\"\n", "", &["walls.stl", "up is not said", "hint: "]);
        assert_scene_error(
            scene_in_folder(&folder, &MESHES.replace("\"mm\"", "\"m\"")),
            &["5000.0000 x 4000", "unit = \"mm\"", "hint: "],
        );
        assert_change_refused("\"mm\"", "\"furlong\"", &["furlong", "`mm`"]);
        assert_change_refused("\"plasterboard\"", "\"cheese\"", &["material", "cheese", "concrete", "oak"]);
        assert_change_refused(
            "material = \"plasterboard\"\n",
            "",
            &["walls.stl", "has none in the scene", "materials = {"],
        );
        let named = "material = \"plasterboard\"\nmaterials = { deks = \"wood\" }\n";
        assert_change_refused(
            "material = \"plasterboard\"\n",
            named,
            &["walls.stl", "deks", "the file has only", "hint: "],
        );
        assert_change_refused("walls.stl", "walls.step", &["walls.step", "\"step\"", ".stl", "hint: "]);
        assert_change_refused("walls.stl", "walks.stl", &["walks.stl", "cannot be read", "relative to the scene file"]);
        assert_change_refused(
            "[[room.mesh]]",
            "size_m = [5, 4, 2.5]\n[[room.mesh]]",
            &["size_m", "beside [[room.mesh]]"],
        );
        assert_change_refused(
            "[[room.mesh]]",
            "x_low = { material = \"wood\" }\n[[room.mesh]]",
            &["x_low", "beside [[room.mesh]]"],
        );
        assert_change_refused("[materials.oak]", "[materials.wood]", &["materials", "wood"]);
        assert_change_refused("[2.4, 0.15]", "[2.4, -0.15]", &["permittivity", "-0.15", "positive"]);
        assert_change_refused("permittivity = [2.4, 0.15]", "", &["materials", "oak", "p2040"]);
        assert_change_refused("thickness_m = 0.02", "thickness_m = -0.02", &["thickness_m", "0 to 10 m"]);
    }

    #[test]
    fn invalid_meshes_are_refused_with_a_hint() {
        let assert_change_refused = |name: &str, change: &dyn Fn(String) -> String, expected: &[&str]| {
            let folder = folder();
            let path = folder.path().join(name);
            let text = std::fs::read_to_string(&path).expect("written");
            std::fs::write(&path, change(text)).expect("written");
            assert_scene_error(scene_in_folder(&folder, MESHES), expected);
        };
        let all = faces([-1.0, -2.0, 0.0], [4.0, 2.0, 2.5]);
        let missing = ["x_low is missing", "hint: ", "x_low = { material = \"open\" }"];
        assert_change_refused("walls.stl", &|_| stl(&all[1..4], 1000.0), &missing);
        assert_change_refused("ceiling.stl", &|_| stl(&all[4..5], 1.0), &["ceiling is missing", "hint: "]);
        assert_change_refused("walls.stl", &|t| t.replacen("vertex -1000", "vertex nan", 1), &["walls.stl", "hint: "]);
        assert_change_refused("walls.stl", &|t| t[..t.len() / 2].to_owned(), &["walls.stl", "line ", "hint: "]);
        assert_change_refused(
            "walls.stl",
            &|_| "solid x\nendsolid x\n".to_owned(),
            &["walls.stl", "no triangle", "hint: "],
        );
        assert_change_refused("desk.stl", &|t| t.replace("vertex 1 ", "vertex 1e30 "), &["desk.stl", "hint: "]);
        assert_change_refused("desk.stl", &|_| stl(&[[[0.0; 3]; 4]], 1.0), &["desk.stl", "no triangle", "hint: "]);
        // After a rotation by 30 degrees, only floor and ceiling are perpendicular to an axis.
        let rotated_stl = |quads: &[Quad]| {
            let rotated = |[x, y, z]: [f64; 3]| [0.866 * x - 0.5 * y, 0.5 * x + 0.866 * y, z];
            stl(&quads.iter().map(|q| q.map(rotated)).collect::<Vec<_>>(), 1000.0)
        };
        assert_change_refused("walls.stl", &|_| rotated_stl(&all[..4]), &["is missing", "along the axes", "hint: "]);
    }

    #[test]
    fn a_room_of_millimetres_is_refused_with_a_hint_on_the_unit() {
        let folder = folder();
        let small = MESHES.replace("unit = \"m\"", "unit = \"mm\"");
        let room = faces([-1.0, -2.0, 0.0], [4.0, 2.0, 2.5]);
        for (name, quads) in [("walls.stl", &room[..4]), ("floor.stl", &room[4..5])] {
            std::fs::write(folder.path().join(name), stl(quads, 1.0)).expect("written");
        }
        assert_scene_error(scene_in_folder(&folder, &small), &["0.0050 x 0.0040", "unit = \"mm\"", "hint: "]);
    }

    /// The file has eight corners: the limit counts triangles, not bytes.
    #[test]
    fn two_million_triangles_are_refused_with_the_limit() {
        let folder = folder();
        let mut text = String::new();
        faces([1.0, 0.0, 0.0], [2.0, 0.5, 0.7])[4..].iter().flatten().for_each(|[x, y, z]| {
            writeln!(text, "v {x} {y} {z}").expect("text");
        });
        text += &"f 1 2 3\n".repeat(2_000_000);
        std::fs::write(folder.path().join("desk.obj"), text).expect("written");
        assert_scene_error(
            scene_in_folder(&folder, &MESHES.replace("desk.stl", "desk.obj")),
            &["desk.obj", "2000000", "1000000", "hint: reduce"],
        );
    }

    #[test]
    fn the_error_of_a_scene_without_a_wall_names_it() {
        let text = common::hall("[people.desk]\nmax_people = 0\n").replace("x_high = { material = \"open\" }\n", "");
        let result = Scene::parse(&text, Path::new("scene.toml"));
        common::assert_refused(result, &["x_high", "missing", "[[room.mesh]]"]);
    }
}
