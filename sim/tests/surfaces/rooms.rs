//! Scenes whose room is a box, a floor plan or a file, generated in code.

use std::fmt::Write as _;
use std::path::Path;

use base64::Engine;
use radome_sim::scene::surfaces::{EdgeKind, Face, Surfaces};
use radome_sim::{Scene, SceneError};

use crate::common;

/// Corners of a face of a mesh.
pub type Quad = [[f64; 3]; 4];

/// Units and axes of files.
pub const MILLIMETRES: &str = "unit = \"mm\"\nup = \"z\"";
pub const METRES: &str = "unit = \"m\"\nup = \"z\"";

/// Inner size of the room of most tests, m: numbers that are exact in f32, in metres and in millimetres.
pub const SIZE_M: [f64; 3] = [5.25, 4.5, 2.75];

/// Makes a scene with keys of `[room]` and further tables. The radar is at (0.5, 1, 1.2) and looks along x.
pub fn room_scene(room: &str, tables: &str, folder: &Path) -> Scene {
    let text = common::hall_with_room(room, tables);
    Scene::parse(&text, &folder.join("scene.toml")).expect("a good scene")
}

/// Parses a scene without people, with keys of `[room]` and further tables. The radar is at (0.5, 1, 1.2).
pub fn parse_room(room: &str, tables: &str, folder: &Path) -> Result<Scene, SceneError> {
    let text = common::hall_with_room(room, &format!("[people.desk]\nmax_people = 0\n{tables}"));
    Scene::parse(&text, &folder.join("scene.toml"))
}

pub fn surfaces(room: &str, tables: &str) -> Surfaces {
    parse_room(room, tables, Path::new("")).expect("a good scene").surfaces()
}

/// Keys of a box of plasterboard with another ceiling.
pub fn box_keys(ceiling: &str) -> String {
    let mut keys = format!("size_m = {SIZE_M:?}\nceiling = {{ material = {ceiling:?}, thickness_m = 0.0125 }}\n");
    for side in ["x_low", "x_high", "y_low", "y_high", "floor"] {
        writeln!(keys, "{side} = {{ material = \"plasterboard\", thickness_m = 0.0125 }}").expect("text");
    }
    keys
}

/// Outward faces of a box: low and high x, low and high y, low and high z.
pub fn faces(low: [f64; 3], high: [f64; 3]) -> [Quad; 6] {
    let corner = |i: usize| [0, 1, 2].map(|a| if i >> a & 1 == 0 { low[a] } else { high[a] });
    [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]].map(|q| q.map(corner))
}

pub fn triangles(quads: &[Quad]) -> Vec<[[f64; 3]; 3]> {
    quads.iter().flat_map(|&[a, b, c, d]| [[a, b, c], [a, c, d]]).collect()
}

/// Text STL of triangles, with `per_metre` units a metre.
pub fn stl(triangles: &[[[f64; 3]; 3]], per_metre: f64) -> String {
    let mut text = String::from("solid part\n");
    for triangle in triangles {
        text += "facet normal 0 0 0\nouter loop\n";
        for [x, y, z] in triangle.map(|v| v.map(|c| c * per_metre)) {
            writeln!(text, "vertex {x} {y} {z}").expect("text");
        }
        text += "endloop\nendfacet\n";
    }
    text + "endsolid part\n"
}

/// OBJ of quadrilaterals, each with the name of its material.
pub fn obj(quads: &[(Quad, &str)]) -> String {
    let mut text = String::new();
    for (number, (quad, material)) in quads.iter().enumerate() {
        writeln!(text, "o side{number}\nusemtl {material}").expect("text");
        quad.iter().for_each(|[x, y, z]| writeln!(text, "v {x} {y} {z}").expect("text"));
        let first = 4 * number + 1;
        writeln!(text, "f {} {} {} {}", first, first + 1, first + 2, first + 3).expect("text");
    }
    text
}

/// glTF document of quadrilaterals, y up, with embedded numbers.
pub fn gltf(quads: &[Quad]) -> String {
    // (x, y, z) with z up is (x, z, -y) in the document.
    let positions: Vec<[f32; 3]> = quads.iter().flatten().map(|&[x, y, z]| [x as f32, z as f32, -y as f32]).collect();
    let indices: Vec<u16> = (0..quads.len() as u16).flat_map(|q| [0, 1, 2, 0, 2, 3].map(|i| 4 * q + i)).collect();
    let extreme = |least_or_greatest: fn(f32, f32) -> f32| {
        [0, 1, 2].map(|axis| positions.iter().map(|p| p[axis]).reduce(least_or_greatest).expect("some"))
    };
    let mut bytes: Vec<u8> = positions.iter().flatten().flat_map(|c| c.to_le_bytes()).collect();
    let index_offset = bytes.len();
    bytes.extend(indices.iter().flat_map(|i| i.to_le_bytes()));
    let data = base64::engine::general_purpose::STANDARD.encode(&bytes);
    serde_json::json!({
        "asset": { "version": "2.0" }, "scene": 0, "scenes": [{ "nodes": [0] }],
        "nodes": [{ "name": "room", "mesh": 0 }],
        "meshes": [{ "primitives": [{ "attributes": { "POSITION": 0 }, "indices": 1 }] }],
        "accessors": [
            { "bufferView": 0, "componentType": 5126, "count": positions.len(), "type": "VEC3",
              "min": extreme(f32::min), "max": extreme(f32::max) },
            { "bufferView": 1, "componentType": 5123, "count": indices.len(), "type": "SCALAR" },
        ],
        "bufferViews": [
            { "buffer": 0, "byteOffset": 0, "byteLength": index_offset },
            { "buffer": 0, "byteOffset": index_offset, "byteLength": bytes.len() - index_offset },
        ],
        "buffers": [{ "byteLength": bytes.len(), "uri": format!("data:application/octet-stream;base64,{data}") }],
    })
    .to_string()
}

/// Name, keys of unit and axis, and content of a file.
pub type File<'a> = (&'a str, &'a str, String);

/// The room of most tests as files of the three formats, of plasterboard.
pub fn room_files() -> [File<'static>; 3] {
    let quads = faces([0.0; 3], SIZE_M);
    [
        ("room.stl", MILLIMETRES, stl(&triangles(&quads), 1000.0)),
        ("room.obj", METRES, obj(&quads.map(|quad| (quad, "plaster")))),
        ("room.gltf", "", gltf(&quads)),
    ]
}

/// Writes a file of a plasterboard room into a folder, and returns the table that names it.
pub fn mesh_table(folder: &Path, (name, unit, content): &File) -> String {
    std::fs::write(folder.join(name), content).expect("written");
    let all = [("plaster", "plasterboard"), ("pane", "glass"), ("steel", "metal")];
    let named = all.into_iter().filter(|(name, _)| content.contains(&format!("usemtl {name}\n")));
    let materials = named.map(|(name, material)| format!("{name} = {material:?}")).collect::<Vec<_>>().join(", ");
    format!(
        "[[room.mesh]]\nfile = {name:?}\nmaterial = \"plasterboard\"\nthickness_m = 0.0125\n{unit}\n\
         materials = {{ {materials} }}\n"
    )
}

/// Surfaces of a plasterboard room from a file, in a folder of its own; `keys` precede its table.
pub fn surfaces_from_file(keys: &str, file: File) -> Surfaces {
    let folder = tempfile::tempdir().expect("a folder");
    let room = format!("{keys}{}", mesh_table(folder.path(), &file));
    parse_room(&room, "", folder.path()).expect("a good scene").surfaces()
}

/// Returns whether two faces have the same corners within a nanometre, the same material and the same air.
fn is_same_face(a: &Face, b: &Face) -> bool {
    const TOLERANCE_M: f64 = 1e-9;
    let (p, q) = (&a.polygon, &b.polygon);
    let corners = |face: &Face| face.polygon.loops().flatten().copied().collect::<Vec<_>>();
    let (from, to) = (corners(a), corners(b));
    from.len() == to.len()
        && p.holes.len() == q.holes.len()
        && p.normal.distance(q.normal) < TOLERANCE_M
        && (p.offset_m - q.offset_m).abs() < TOLERANCE_M
        && from.iter().all(|c| to.iter().any(|d| c.distance(*d) < TOLERANCE_M))
        && (a.wall, a.sides) == (b.wall, b.sides)
}

/// Asserts that two descriptions agree: the same faces in any order, and as many edges of each kind.
pub fn assert_same_surfaces(found: &Surfaces, expected: &Surfaces, name: &str) {
    assert_eq!(found.faces.len(), expected.faces.len(), "{name}: {:?}", found.faces);
    for face in &expected.faces {
        assert_eq!(
            found.faces.iter().filter(|other| is_same_face(face, other)).count(),
            1,
            "{name}: {face:?} in {found:?}"
        );
    }
    for kind in [is_inner, is_flat, is_seam, is_wedge, is_free] {
        assert_eq!(count(found, kind), count(expected, kind), "{name}");
    }
    assert_eq!(small_triangles(found), small_triangles(expected), "{name}");
}

/// Number of triangles that are not part of faces.
pub fn small_triangles(surfaces: &Surfaces) -> usize {
    surfaces.small.iter().map(|part| part.mesh.triangles.len()).sum()
}

pub fn is_inner(kind: &EdgeKind) -> bool {
    *kind == EdgeKind::Inner
}

pub fn is_flat(kind: &EdgeKind) -> bool {
    *kind == EdgeKind::Flat
}

pub fn is_seam(kind: &EdgeKind) -> bool {
    matches!(kind, EdgeKind::Seam { .. })
}

pub fn is_wedge(kind: &EdgeKind) -> bool {
    matches!(kind, EdgeKind::Wedge { .. })
}

pub fn is_free(kind: &EdgeKind) -> bool {
    *kind == EdgeKind::Free
}

pub fn count(surfaces: &Surfaces, kind: fn(&EdgeKind) -> bool) -> usize {
    surfaces.edges.iter().filter(|edge| kind(&edge.kind)).count()
}

/// Index and face with a unique name.
pub fn face<'a>(surfaces: &'a Surfaces, name: &str) -> (usize, &'a Face) {
    let mut named = surfaces.faces.iter().enumerate().filter(|(_, face)| face.name == name);
    let found = named.next().unwrap_or_else(|| panic!("no {name} in {surfaces:?}"));
    assert!(named.next().is_none(), "{name} twice");
    found
}
