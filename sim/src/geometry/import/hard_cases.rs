//! Test cases of unusual and damaged mesh files.

use base64::Engine;
use rand::Rng;

use super::*;
use crate::geometry::weld;
use crate::random::{Purpose, generator};

const TETRAHEDRON: &str = "solid a thing
facet normal 0 0 -1
 outer loop
  vertex 0 0 0
  vertex 0 1 0
  vertex 1 0 0
 endloop
endfacet
facet normal 0 -1 0
 outer loop
  vertex 0 0 0
  vertex 1 0 0
  vertex 0 0 1
 endloop
endfacet
facet normal -1 0 0
 outer loop
  vertex 0 0 0
  vertex 0 0 1
  vertex 0 1 0
 endloop
endfacet
facet normal 1 1 1
 outer loop
  vertex 1 0 0
  vertex 0 1 0
  vertex 0 0 1
 endloop
endfacet
endsolid a thing
";

const CUBE: &str = "# a cube of quadrilaterals, two materials
mtllib missing.mtl
o crate
v 0 0 0 1.0 0.5 0.5
v 1 0 0
v 1 1 0
v 0 1 0
v 0 0 1
v 1 0 1
v 1 1 1
v 0 1 1
vt 0 0
vn 0 0 1
usemtl dark wood
f 4/1/1 3/1/1 2/1/1 1/1/1
f 5//1 6//1 7//1 8//1
f 1 2 6 5
usemtl steel
f -7 -6 -2 -3
f 3 4 8 7
f 4 1 5 8
";

/// The same triangles as a binary file, with a header that looks like text.
fn binary() -> Vec<u8> {
    let mesh = &parse_stl(TETRAHEDRON.as_bytes()).expect("a good file")[0].mesh;
    let mut bytes = b"solid but binary".to_vec();
    bytes.resize(80, b' ');
    bytes.extend((mesh.triangles.len() as u32).to_le_bytes());
    for t in &mesh.triangles {
        bytes.extend([0; 12]);
        for v in t.map(|i| mesh.vertices[i as usize]) {
            bytes.extend(v.to_array().into_iter().flat_map(|c| (c as f32).to_le_bytes()));
        }
        bytes.extend([0; 2]);
    }
    bytes
}

#[test]
fn text_and_binary_stl_are_the_same_solid() {
    let text = parse_stl(TETRAHEDRON.as_bytes()).expect("a good file");
    let binary = parse_stl(&binary()).expect("a good file");
    assert_eq!((text[0].name.as_str(), &text[0].mesh), ("a thing", &binary[0].mesh));
    let whole = weld(&text[0].mesh, 1e-6).expect("a good mesh").mesh;
    assert!(whole.is_solid() && (whole.volume_m3() - 1.0 / 6.0).abs() < 1e-12);
    // The file has no name and starts with empty lines.
    let bare = format!("\n\n{}", TETRAHEDRON.replace(" a thing", ""));
    assert_eq!(parse_stl(bare.as_bytes()).expect("a good file")[0].mesh, text[0].mesh);
}

#[test]
fn an_obj_s_parts_have_names_materials_and_triangles() {
    let parts = parse_obj(CUBE.as_bytes()).expect("a good file");
    let found: Vec<_> =
        parts.iter().map(|p| (p.name.as_str(), p.material.as_deref(), p.mesh.triangles.len())).collect();
    assert_eq!(found, [("crate", Some("dark wood"), 6), ("crate", Some("steel"), 6)]);
    let whole = weld(&parts[0].mesh.joined(&parts[1].mesh), 1e-9).expect("a good mesh").mesh;
    assert!(whole.is_solid());
    assert!((whole.volume_m3() - 1.0).abs() < 1e-12);
}

/// A fan over a wall with a doorway covers the doorway or the wall beside it twice, unless the face begins at the right
/// corner.
#[test]
fn a_doorway_in_a_wall_of_one_face_stays_open() {
    let outline = [[0.0, 0.0], [1.0, 0.0], [1.0, 2.0], [2.0, 2.0], [2.0, 0.0], [4.0, 0.0], [4.0, 3.0], [0.0, 3.0]];
    let vertices: String = outline.iter().map(|[x, z]| format!("v {x} 0.5 {z}\n")).collect();
    for first in 0..8 {
        for (is_reversed, area_m2) in [(false, -10.0), (true, 10.0)] {
            let mut corners: Vec<String> = (0..8).map(|i| ((first + i) % 8 + 1).to_string()).collect();
            if is_reversed {
                corners.reverse();
            }
            let text = format!("{vertices}f {}\n", corners.join(" "));
            let mesh = &parse_obj(text.as_bytes()).expect("a good file")[0].mesh;
            let areas: Vec<DVec3> = (0..mesh.triangles.len()).map(|t| mesh.area_vector(t) / 2.0).collect();
            let whole_m2: f64 = areas.iter().map(|area| area.length()).sum();
            let along_m2: f64 = areas.iter().map(|area| area.y).sum();
            assert!((whole_m2 - 10.0).abs() < 1e-12, "{text}: {whole_m2} m^2");
            assert!((along_m2 - area_m2).abs() < 1e-12, "{text}: {along_m2} m^2 along y");
        }
    }
}

/// glTF document of three nodes in two scenes: a strip with a fan as its child in the default scene, and another strip in
/// the first one. Strip and fan are a square across z with sides of this length. Points beside the strip are no surface.
fn strip_and_fan(side: f32) -> serde_json::Value {
    let places: [[f32; 3]; 4] = [[0.0, 0.0, 0.0], [side, 0.0, 0.0], [0.0, side, 0.0], [side, side, 0.0]];
    let mut bytes: Vec<u8> = places.iter().flatten().flat_map(|c| c.to_le_bytes()).collect();
    bytes.extend([0u16, 1, 3, 2].iter().flat_map(|i| i.to_le_bytes()));
    let data = base64::engine::general_purpose::STANDARD.encode(&bytes);
    serde_json::json!({
        "asset": { "version": "2.0" }, "scene": 1, "scenes": [{ "nodes": [2] }, { "nodes": [0] }],
        "nodes": [
            { "name": "strip", "mesh": 0, "children": [1] }, { "name": "fan", "mesh": 1 }, { "name": "other", "mesh": 0 }
        ],
        "meshes": [
            { "primitives": [
                { "attributes": { "POSITION": 0 }, "mode": 5 }, { "attributes": { "POSITION": 0 }, "mode": 0 }
            ] },
            { "primitives": [{ "attributes": { "POSITION": 0 }, "indices": 1, "mode": 6 }] },
        ],
        "accessors": [
            { "bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3", "min": [0, 0, 0], "max": [side, side, 0] },
            { "bufferView": 1, "componentType": 5123, "count": 4, "type": "SCALAR" },
        ],
        "bufferViews": [
            { "buffer": 0, "byteOffset": 0, "byteLength": 48 }, { "buffer": 0, "byteOffset": 48, "byteLength": 8 }
        ],
        "buffers": [{ "byteLength": bytes.len(), "uri": format!("data:application/octet-stream;base64,{data}") }],
    })
}

fn gltf_parts(document: &serde_json::Value) -> Vec<Part> {
    super::gltf::parse_gltf(document.to_string().as_bytes(), Path::new("")).expect("a good file")
}

/// Strips and fans were no surface, without a word.
#[test]
fn strips_and_fans_of_gltf_are_surfaces() {
    let parts = gltf_parts(&strip_and_fan(1.0));
    assert_eq!(parts.len(), 2, "{parts:?}");
    for Part { name, mesh, .. } in parts {
        let areas: Vec<DVec3> = (0..mesh.triangles.len()).map(|t| mesh.area_vector(t) / 2.0).collect();
        assert_eq!(areas, [DVec3::Z / 2.0; 2], "{name}");
    }
}

/// Nodes that no scene shows were walls, such as a second state of a room beside the first one.
#[test]
fn nodes_of_other_scenes_are_no_surfaces() {
    let names =
        |document: &serde_json::Value| gltf_parts(document).into_iter().map(|part| part.name).collect::<Vec<_>>();
    let mut document = strip_and_fan(1.0);
    assert_eq!(names(&document), ["strip", "fan"]);
    document.as_object_mut().expect("an object").remove("scene");
    assert_eq!(names(&document), ["other"], "the first scene");
    document.as_object_mut().expect("an object").remove("scenes");
    assert_eq!(names(&document), ["strip", "other", "fan"], "no scene");
}

#[test]
fn errors_name_the_line_or_the_byte() {
    let error = |text: String| parse_stl(text.as_bytes()).expect_err("damaged").to_string();
    let message = error(TETRAHEDRON.replace("vertex 0 0 1\n  vertex 0 1 0", "vertex 0 o 1\n"));
    assert!(message.starts_with("line 19: "), "{message}");
    let message = error(TETRAHEDRON.replace("endsolid a thing\n", ""));
    assert!(message.starts_with("line 29: EOF"), "{message}");
    assert!(error(TETRAHEDRON.replace("facet normal 1 1 1", "facet 1 1 1")).starts_with("line 23: invalid facet"));
    assert_eq!(parse_stl(b"solid x\nendsolid x\n"), Err(ParseError::Empty));
    let whole = binary();
    for cut in [0, 50, 84, 133, whole.len() - 2] {
        let error = parse_stl(&[b"x".as_slice(), &whole[1..=cut]].concat()).expect_err("cut off").to_string();
        assert!(error.starts_with("byte "), "{cut}: {error}");
    }
    let mut huge = whole.clone();
    huge[0] = b'x';
    huge[80..84].copy_from_slice(&u32::MAX.to_le_bytes());
    assert!(parse_stl(&huge).expect_err("cut off").to_string().starts_with("byte 284: "));

    let error = |text: String| parse_obj(text.as_bytes()).expect_err("damaged").to_string();
    assert_eq!(error(CUBE.replace("v 1 1 0\n", "v 1 l 0\n")), "line 6: a vertex is not three numbers");
    assert_eq!(error(CUBE.replace("f 1 2 6 5", "f 1 2")), "line 17: a face of fewer than three corners");
    assert_eq!(error(CUBE.replace("f 1 2 6 5", "f 1 2 x")), "line 17: a face is not a list of vertex numbers");
    assert!(error(CUBE.replace("f 3 4 8 7", "f 3 4 8 9")).contains("names a vertex that does not exist"));
    assert_eq!(parse_obj(b"# nothing\n"), Err(ParseError::Empty));
}

/// A file of one concave face took the square of its corners to read.
#[test]
fn concave_faces_have_a_thousand_corners_at_most() {
    let face = |inner: f64, count: usize| {
        let corner = |i: usize| {
            let (y, x) = (std::f64::consts::TAU * i as f64 / count as f64).sin_cos();
            let radius = if i.is_multiple_of(2) { 1.0 } else { inner };
            format!("v {} {} 0\n", radius * x, radius * y)
        };
        let corners: Vec<String> = (1..=count).map(|i| i.to_string()).collect();
        format!("o star\n{}f {}\n", (0..count).map(corner).collect::<String>(), corners.join(" "))
    };
    let triangles = |text: String| parse_obj(text.as_bytes()).map(|parts| parts[0].mesh.triangles.len());
    assert_eq!(triangles(face(1.0, 1002)), Ok(1000));
    assert!(triangles(face(0.5, 1000)).is_ok_and(|count| count > 900));
    let error = triangles(face(0.5, 1002)).expect_err("too many").to_string();
    assert_eq!(error, "object \"star\": a concave face has 1002 corners, expected 1000 at most");
}

#[test]
fn units_and_axes_are_applied_and_the_path_is_named() {
    let folder = std::env::temp_dir().join(format!("radome-import-{}", std::process::id()));
    std::fs::create_dir_all(&folder).expect("a folder");
    let path = folder.join("box.OBJ");
    std::fs::write(&path, "v 1000 2000 3000\nv 0 1 0\nv 1 0 0\nf 1 2 3\n").expect("written");
    let first = |unit, up| import(&path, unit, up).expect("a good file")[0].mesh.vertices[0];
    assert_eq!(first(LengthUnit::Millimetre, UpAxis::Z), DVec3::new(1.0, 2.0, 3.0));
    assert_eq!(first(LengthUnit::Centimetre, UpAxis::Y), DVec3::new(10.0, -30.0, 20.0));
    std::fs::write(&path, "v 1 2 3\nv x\n").expect("written");
    let message = import(&path, LengthUnit::Metre, UpAxis::Z).expect_err("damaged").to_string();
    assert!(message.contains("box.OBJ: line 2: "), "{message}");
    std::fs::write(&path, "v 1e300 2 3\nv 0 1 0\nv 1 0 0\nf 1 2 3\n").expect("written");
    assert!(import(&path, LengthUnit::Metre, UpAxis::Z).is_err(), "farther than the farthest");
    let other = import(&folder.join("box.fbx"), LengthUnit::Metre, UpAxis::Z);
    assert!(matches!(other, Err(ImportError::Format { .. })));
    std::fs::remove_dir_all(&folder).expect("removed");
}

/// Numbers above 10000 were taken for metres, and refused, before the unit or the scale of a node applied to them.
#[test]
fn coordinates_are_limited_in_metres() {
    let folder = tempfile::tempdir().expect("a folder");
    let corner = |name: &str, text: &str, unit| {
        let path = folder.path().join(name);
        std::fs::write(&path, text).expect("written");
        import(&path, unit, UpAxis::Z).map(|parts| parts[0].mesh.vertices[1])
    };
    let obj = "v 0 0 0\nv 12000 0 0\nv 0 12000 0\nf 1 2 3\n";
    assert_eq!(corner("hall.obj", obj, LengthUnit::Millimetre).expect("12 m"), DVec3::X * 12.0);
    let error = corner("hall.obj", obj, LengthUnit::Metre).expect_err("12 km").to_string();
    assert!(error.contains("[12000, 0, 0]") && error.contains("hint: check the unit"), "{error}");
    assert_eq!(error.matches("hint: ").count(), 1, "{error}");

    let mut document = strip_and_fan(12_000.0);
    document["nodes"][0]["scale"] = serde_json::json!([0.001, 0.001, 0.001]);
    let scaled = corner("hall.gltf", &document.to_string(), LengthUnit::Metre).expect("12 m");
    assert!((scaled - DVec3::X * 12.0).length() < 1e-5, "{scaled}");
}

#[test]
fn damaged_files_never_panic() {
    let mut rng = generator(11, Purpose::Build, [0, 0]);
    type Parser = fn(&[u8]) -> Result<Vec<Part>, ParseError>;
    let samples: [(&[u8], Parser); 3] =
        [(TETRAHEDRON.as_bytes(), parse_stl), (&binary(), parse_stl), (CUBE.as_bytes(), parse_obj)];
    for (whole, parse) in samples {
        for _ in 0..3000 {
            let mut bytes = whole.to_vec();
            for _ in 0..rng.random_range(1..4) {
                let at = rng.random_range(0..bytes.len());
                bytes[at] = if rng.random() { rng.random() } else { b"0-/. \nfv9#"[rng.random_range(0..10)] };
            }
            bytes.truncate(rng.random_range(0..=bytes.len()));
            if let Ok(parts) = parse(&bytes) {
                assert!(
                    parts.iter().all(|p| p.mesh.check().is_ok() || p.mesh.vertices.iter().any(|v| v.length() > 1e4))
                );
            }
        }
    }
}
