//! Materials of a room, and rooms from meshes.
//!
//! In meshes, the six largest axis-parallel planes that face each other form the box around the room. Each wall has the
//! material of the mesh that contributes most of its area. Connected pieces inside the box are furniture. People walk
//! around the bounding boxes of furniture, and around walls (`ground.rs`).
//!
//! If `[room] solver` finds paths by rays, planes of meshes reflect, occlude and diffract at their true position.
//! Pieces without planes scatter from points. If the solver uses images of the box, walls reflect as a whole, and all
//! pieces scatter from points on their bounding boxes. The cross-section is the mean of a convex body in random
//! orientation, a quarter of its area, times the reflectivity of its material.

use std::collections::BTreeMap;
use std::path::Path;

use glam::DVec3;
use radome_dsp::{SPEED_OF_LIGHT_M_PER_S, Waveform};
use radome_files::named_by_spec;

use super::check::{InvalidValue, invalid, room_surfaces};
use super::{SceneError, file_error};
use crate::em::image::Wall;
use crate::file_error::FileError;
use crate::first_warning::is_first_warning;
use crate::geometry::import::{ImportError, LengthUnit, Part, UpAxis, import};
use crate::geometry::polygon::bounds;
use crate::geometry::{Mesh, edges, overlaps, planes, weld};
use crate::material::{Material, OPEN};
use crate::math::DisjointSets;
use crate::scene_file::{FurnitureFile, RoomMeshFile, SceneFile, SurfaceFile};

/// Distance within which vertices are merged, and within which triangles belong to a plane, m. Modelling programs store
/// floats.
pub(super) const WELD_M: f64 = 1e-4;
/// Distance within which planes form one wall, m.
const SAME_WALL_M: f64 = 0.01;
/// Least cosine of the angle between a wall's normal and an axis: 2 degrees.
const LEAST_AXIS_COSINE: f64 = 0.9994;
/// Least area of a wall, as a part of its side of the meshes' bounding box.
const LEAST_WALL_FRACTION: f64 = 0.3;
/// Largest thickness of a solid wall, m.
const THICKEST_M: f64 = 0.6;
/// Least and largest size of a room, m.
const SIZES_M: [f64; 2] = [0.5, 100.0];
/// Upper limit of pieces of furniture, of which the largest are kept, and number of scattering points per square metre
/// of each.
const MOST_PIECES: usize = 64;
const POINTS_PER_M2: f64 = 4.0;
/// Upper limit of triangles in one mesh: as many as in a scan of a flat. More cannot be welded and searched within
/// seconds.
const MOST_TRIANGLES: usize = 1_000_000;
/// Names of the six walls, with axis and end of each.
pub(super) const WALLS: [(&str, usize, bool); 6] = [
    ("x_low", 0, false),
    ("x_high", 0, true),
    ("y_low", 1, false),
    ("y_high", 1, true),
    ("floor", 2, false),
    ("ceiling", 2, true),
];

/// Reflection and transmission of the six surfaces. Warns of materials whose constants are for another band.
pub(super) fn walls(file: &SceneFile, waveform: &Waveform) -> Result<[Wall; 6], InvalidValue> {
    let mut walls = [Wall::Open; 6];
    for ((key, surface), wall) in room_surfaces(&file.room).into_iter().zip(&mut walls) {
        *wall = slab(file, surface, waveform.centre_frequency_hz())
            .map_or_else(|| invalid(key, &surface.material, "a material"), Ok)?;
        warn_of_band(file, &surface.material, waveform);
    }
    Ok(walls)
}

/// Warns of a material whose constants are for another band than the waveform's.
fn warn_of_band(file: &SceneFile, material: &str, waveform: &Waveform) {
    let [low, high] = match (Material::named(material), file.materials.get(material)) {
        (Some(material), _) => material.band_ghz(),
        (None, own_material) => own_material.and_then(|m| m.band_ghz).unwrap_or([0.0, f64::INFINITY]),
    };
    let ghz = waveform.centre_frequency_hz() * 1e-9;
    if !(low..=high).contains(&ghz) && is_first_warning(&["band", material]) {
        tracing::warn!(
            "the constants of {material} hold from {low} to {high} GHz and are extrapolated to the waveform's {ghz:.2} GHz"
        );
    }
}

/// Warns of materials outside their band in furniture, floor plans and parts of files, except in the box around the
/// room.
pub(super) fn warn_of_bands_within(file: &SceneFile, meshes: &RoomMeshes, waveform: &Waveform) {
    let own_furniture = file.furniture.iter().take(meshes.own_furniture);
    let furniture = own_furniture.filter_map(|f| f.material.as_deref());
    let plan = file.room.plan.iter().flat_map(|plan| plan.materials());
    let parts = meshes.pieces.iter().map(|piece| piece.surface.material.as_str());
    let is_wall = |material: &str| room_surfaces(&file.room).iter().any(|(_, surface)| surface.material == material);
    for material in furniture.chain(plan).chain(parts).filter(|material| !is_wall(material)) {
        warn_of_band(file, material, waveform);
    }
}

/// Reflection and transmission of a slab of a built-in material or of the scene's own; `None` for an unknown name.
pub(super) fn slab(file: &SceneFile, surface: &SurfaceFile, frequency_hz: f64) -> Option<Wall> {
    let thickness_m = surface.thickness_m;
    let Some(material) = Material::named(&surface.material) else {
        let permittivity = file.materials.get(&surface.material)?.permittivity(frequency_hz);
        return Some(Wall::Slab { permittivity, thickness_m });
    };
    Some(match (material, material.permittivity(frequency_hz)) {
        (_, Some(permittivity)) => Wall::Slab { permittivity, thickness_m },
        (Material::Metal, None) => Wall::Conductor,
        _ => Wall::Open,
    })
}

/// Fraction of a wave's power that a wall of a material reflects at normal incidence; 0 for an open one.
fn reflected_power(file: &SceneFile, surface: &SurfaceFile, frequency_hz: f64) -> f64 {
    let wavenumber_per_m = std::f64::consts::TAU * frequency_hz / SPEED_OF_LIGHT_M_PER_S;
    slab(file, surface, frequency_hz).map_or(0.0, |wall| wall.reflection(wavenumber_per_m, 1.0).te.norm_sqr())
}

/// Mean radar cross-section of a convex body with this surface area in random orientation, dBsm.
fn cross_section_dbsm(area_m2: f64, reflected_power: f64) -> f64 {
    10.0 * (0.25 * area_m2 * reflected_power).max(1e-10).log10()
}

/// Computes the radar cross-section of furniture for which the scene states only the material.
pub(super) fn fill_cross_sections(file: &mut SceneFile, frequency_hz: f64) {
    let by_material = |f: &FurnitureFile| {
        let surface = SurfaceFile { material: f.material.clone()?, thickness_m: f.thickness_m };
        let [x, y, z] = f.size_m;
        Some(cross_section_dbsm(2.0 * (x * y + y * z + z * x), reflected_power(file, &surface, frequency_hz)))
    };
    let all: Vec<Option<f64>> = file.furniture.iter().map(by_material).collect();
    for (furniture, cross_section_dbsm) in file.furniture.iter_mut().zip(all) {
        furniture.cross_section_dbsm = furniture.cross_section_dbsm.or(cross_section_dbsm);
    }
}

/// Lines of a room's mesh in room coordinates.
#[derive(Debug, Clone, PartialEq)]
pub struct Outline {
    /// Name of its material.
    pub material: String,
    /// Edges at which the mesh ends or bends, m.
    pub edges: Vec<[DVec3; 2]>,
}

/// Least angle of edges that are drawn, rad. Surfaces that turn less are curved.
pub(super) const CREASE_RAD: f64 = 0.35;

fn outline(piece: &Piece, corner: DVec3) -> Outline {
    let position = |v: u32| piece.mesh.vertices.get(v as usize).map_or(DVec3::ZERO, |v| *v - corner);
    let creases = edges(&piece.mesh).into_iter().filter(|edge| edge.is_crease(CREASE_RAD));
    Outline {
        material: piece.surface.material.clone(),
        edges: creases.map(|edge| edge.vertices.map(position)).collect(),
    }
}

/// A part of a mesh file with its material.
#[derive(Debug)]
pub(super) struct Piece {
    /// Name in the file, of the part or else of its material; if it has neither, the file's name and the scene's material.
    pub name: String,
    pub surface: SurfaceFile,
    pub mesh: Mesh,
}

/// Meshes of a room as read from files.
#[derive(Debug, Default)]
pub(super) struct RoomMeshes {
    pub pieces: Vec<Piece>,
    /// Position of the scene's origin in the meshes, m.
    pub corner: DVec3,
    /// Number of pieces of furniture from the scene file itself. The later ones stand for triangles of the meshes.
    pub own_furniture: usize,
}

/// Faces that lie in one plane.
#[derive(Default)]
struct Face {
    area_m2: f64,
    /// Sum of the planes' offsets, each times its area, m * m^2.
    weighted_offset: f64,
    /// Area of each piece's part of the face.
    area_by_piece_m2: BTreeMap<usize, f64>,
}

/// Reads the meshes, if any, and fills in the room's size, surfaces and furniture. Returns the outlines and the meshes.
pub(super) fn read_meshes(
    file: &mut SceneFile,
    path: &Path,
    text: &str,
    frequency_hz: f64,
) -> Result<(Vec<Outline>, RoomMeshes), SceneError> {
    let own_furniture = file.furniture.len();
    let mut pieces = Vec::new();
    for mesh in &file.room.mesh {
        pieces.extend(read_pieces(mesh, path, text)?);
    }
    let Some(first) = file.room.mesh.first() else {
        return Ok((Vec::new(), RoomMeshes { own_furniture, ..RoomMeshes::default() }));
    };
    let mesh_error = |source: FileError| file_error(path, text, &first.file, source);
    let [low, high] = bounds(pieces.iter().flat_map(|p| &p.mesh.vertices));
    if !(0..3).all(|i| (SIZES_M[0]..=2.0 * SIZES_M[1]).contains(&(high - low)[i])) {
        let size = high - low;
        let problem =
            format!("all meshes together are {:.4} x {:.4} x {:.4} m, expected {SIZES_M:?} m", size.x, size.y, size.z);
        let hint =
            "say which unit the file is in: unit = \"mm\", \"cm\" or \"m\"; of glTF, which is in metres, remove it";
        return Err(mesh_error(FileError::new("size", problem, hint)));
    }
    let (positions_m, surfaces) = six_walls(file, &pieces, [low, high]).map_err(mesh_error)?;
    let [corner, end] = [0, 1].map(|e| DVec3::new(positions_m[e], positions_m[2 + e], positions_m[4 + e]));
    let room = &mut file.room;
    room.size_m = (end - corner).to_array();
    [room.x_low, room.x_high, room.y_low, room.y_high, room.floor, room.ceiling] = surfaces;
    let furniture = furniture(file, &pieces, corner, end, frequency_hz);
    tracing::info!(size_m = ?file.room.size_m, %corner, furniture = furniture.len(), "a room from meshes; its low corner is the origin");
    file.furniture.extend(furniture);
    let outlines = pieces.iter().map(|piece| outline(piece, corner)).collect();
    Ok((outlines, RoomMeshes { pieces, corner, own_furniture }))
}

/// Returns the positions of the six walls of meshes between two corners, m, and the surface of each wall.
fn six_walls(
    file: &SceneFile,
    pieces: &[Piece],
    [low, high]: [DVec3; 2],
) -> Result<([f64; 6], [SurfaceFile; 6]), FileError> {
    let faces = faces(pieces);
    let mut positions_m: [f64; 6] = [0.0; 6];
    let mut surfaces: [SurfaceFile; 6] = Default::default();
    let is_open = room_surfaces(&file.room).map(|(_, surface)| surface.material == OPEN);
    for (i, &(name, axis, is_high)) in WALLS.iter().enumerate() {
        if is_open[i] {
            // Without a wall, the room ends where the meshes end.
            positions_m[i] = if is_high { high[axis] } else { low[axis] };
            surfaces[i].material = OPEN.to_owned();
            continue;
        }
        let face = innermost_wall(&faces[axis], axis, is_high, [low, high]).map_err(|largest_m2| {
            let side_m2 = (high - low)[(axis + 1) % 3] * (high - low)[(axis + 2) % 3];
            let problem = format!(
                "{name} is missing: the largest plane there is {largest_m2:.2} m^2, expected at least {:.2} m^2 of {side_m2:.2} m^2",
                LEAST_WALL_FRACTION * side_m2
            );
            let hint = format!(
                "rooms have six plane walls along the axes: add the one that is missing, turn the model, check up, or say that \
                 there is none: {name} = {{ material = \"open\" }} in [room]"
            );
            FileError::new("walls", problem, hint)
        })?;
        positions_m[i] = face.weighted_offset / face.area_m2;
        let main_piece =
            face.area_by_piece_m2.iter().max_by(|a, b| a.1.total_cmp(b.1)).and_then(|(&piece, _)| pieces.get(piece));
        surfaces[i] = main_piece.map(|p| p.surface.clone()).unwrap_or_default();
    }
    Ok((positions_m, surfaces))
}

/// Reads a mesh file: its welded parts, each with a material.
fn read_pieces(mesh: &RoomMeshFile, path: &Path, text: &str) -> Result<Vec<Piece>, SceneError> {
    let folder = path.parent().unwrap_or(Path::new(""));
    let file = folder.join(&mesh.file);
    let parts = import_parts(mesh, folder, &file).and_then(|parts| {
        let triangles: usize = parts.iter().map(|part| part.mesh.triangles.len()).sum();
        if triangles > MOST_TRIANGLES {
            let problem = format!("it has {triangles} triangles, expected {MOST_TRIANGLES} at most");
            let hint = "reduce the mesh: walls and furniture are looked at as planes and boxes";
            return Err(FileError::new("mesh", problem, hint));
        }
        check_names(mesh, &parts)?;
        parts.into_iter().map(|part| piece(mesh, &file, part)).collect()
    });
    parts.map_err(|source| file_error(path, text, &mesh.file, source))
}

/// Checks that the file contains the names to which the scene assigns materials.
fn check_names(mesh: &RoomMeshFile, parts: &[Part]) -> Result<(), FileError> {
    let mut names: Vec<&str> =
        parts.iter().flat_map(|p| [p.material.as_deref().unwrap_or_default(), p.name.as_str()]).collect();
    names.retain(|name| !name.is_empty());
    names.sort_unstable();
    names.dedup();
    match mesh.materials.keys().find(|key| !names.contains(&key.as_str())) {
        Some(key) => {
            let problem = format!("materials names {key:?}, and the file has only {names:?}");
            Err(FileError::new(
                "material",
                problem,
                "write a name of the file, of a material or of a part, or remove it",
            ))
        }
        None => Ok(()),
    }
}

/// Reads the parts of a mesh file, in metres, z up.
fn import_parts(mesh: &RoomMeshFile, folder: &Path, file: &Path) -> Result<Vec<Part>, FileError> {
    let extension = file.extension().map(|e| e.to_string_lossy().to_lowercase()).unwrap_or_default();
    let states_unit_and_axis = ["gltf", "glb"].contains(&extension.as_str());
    let (unit, up) = match (mesh.unit, mesh.up) {
        (Some(unit), Some(up)) => (unit, up),
        (unit, up) if states_unit_and_axis => (unit.unwrap_or(LengthUnit::Metre), up.unwrap_or(UpAxis::Y)),
        (unit, _) => {
            let missing_key = if unit.is_none() { "unit" } else { "up" };
            let problem = format!("{missing_key} is not said, and the format does not say it either");
            let hint = "add unit = \"m\" (or \"cm\", \"mm\", \"in\") and up = \"z\" (or \"y\") to this [[room.mesh]]";
            return Err(FileError::new(missing_key, problem, hint));
        }
    };
    // `import` refuses other formats by their extension.
    if states_unit_and_axis || ["stl", "obj"].contains(&extension.as_str()) {
        named_by_spec(folder, Path::new(&mesh.file)).map_err(|e| FileError::unreadable(&e))?;
    }
    import(file, unit, up).map_err(|e| match &e {
        ImportError::Read { source, .. } => FileError::unreadable(source),
        ImportError::Content { source, .. } => FileError::new("content", source.to_string(), source.hint()),
        ImportError::Format { extension, .. } => {
            let problem = format!("it ends in {extension:?}, expected .stl, .obj, .gltf or .glb");
            FileError::new("name", problem, "export it in one of these formats")
        }
    })
}

/// Makes a piece from a part of a mesh file, with the material that the scene assigns to it.
fn piece(mesh: &RoomMeshFile, file: &Path, part: Part) -> Result<Piece, FileError> {
    let names = [part.material.as_deref().unwrap_or_default(), part.name.as_str()];
    let material = names.iter().find_map(|n| mesh.materials.get(*n)).or(mesh.material.as_ref());
    let material = material.ok_or_else(|| {
        let problem = format!("the part {:?} with the material {:?} has none in the scene", part.name, names[0]);
        FileError::new("material", problem, "add material = \"...\", or its name to materials = { ... }")
    })?;
    let welded = weld(&part.mesh, WELD_M)
        .map_err(|e| FileError::new("mesh", e.to_string(), "export the mesh again; check its unit"))?;
    if welded.mesh.triangles.is_empty() {
        let problem = format!("no triangle of the part {:?} has an area in this unit", part.name);
        return Err(FileError::new("mesh", problem, "check unit: the numbers may be in metres"));
    }
    let name = [part.name, part.material.unwrap_or_default()].into_iter().find(|name| !name.is_empty());
    let name = name.unwrap_or_else(|| {
        let stem = file.file_stem().unwrap_or_default().to_string_lossy();
        format!("{stem} {material}")
    });
    let overlaps = overlaps(&welded.mesh);
    if overlaps > 0 {
        tracing::warn!(
            file = %file.display(),
            part = name,
            overlaps,
            "the mesh meets itself: of faces that lie on each other only one counts"
        );
    }
    let surface = SurfaceFile { material: material.clone(), thickness_m: mesh.thickness_m };
    Ok(Piece { name, surface, mesh: welded.mesh })
}

/// Returns the planes along each axis, in order of position.
fn faces(pieces: &[Piece]) -> [Vec<Face>; 3] {
    let mut all: [Vec<(f64, f64, usize)>; 3] = Default::default();
    for (number, piece) in pieces.iter().enumerate() {
        for plane in planes(&piece.mesh, WELD_M).planes {
            let Some(axis) = (0..3).find(|&axis| plane.normal[axis].abs() > LEAST_AXIS_COSINE) else { continue };
            // The offset is along the normal, which may point in the negative direction.
            all[axis].push((plane.offset_m * plane.normal[axis].signum(), plane.area_m2, number));
        }
    }
    all.map(|mut planes| {
        planes.sort_by(|a, b| a.0.total_cmp(&b.0));
        planes
            .chunk_by(|a, b| b.0 - a.0 < SAME_WALL_M)
            .map(|same| {
                let mut face = Face::default();
                for &(offset_m, area_m2, piece) in same {
                    face.area_m2 += area_m2;
                    face.weighted_offset += offset_m * area_m2;
                    *face.area_by_piece_m2.entry(piece).or_default() += area_m2;
                }
                face
            })
            .collect()
    })
}

/// Returns the innermost large plane at one end of an axis that may form one wall with the outermost plane. Solid walls
/// also have an outer plane, and rooms that are not boxes have walls farther in. Without such a plane, returns the
/// largest area.
fn innermost_wall(faces: &[Face], axis: usize, is_high: bool, [low, high]: [DVec3; 2]) -> Result<&Face, f64> {
    let middle = 0.5 * (low + high)[axis];
    let side_m2 = (high - low)[(axis + 1) % 3] * (high - low)[(axis + 2) % 3];
    let is_at_end = |f: &&Face| (f.weighted_offset / f.area_m2 > middle) == is_high;
    let largest = faces.iter().filter(is_at_end).map(|f| f.area_m2).fold(0.0, f64::max);
    let is_wall = |f: &&Face| f.area_m2 >= LEAST_WALL_FRACTION * side_m2 && f.area_m2 >= 0.5 * largest;
    let middle_distance_m = |f: &&Face| (f.weighted_offset / f.area_m2 - middle).abs();
    let walls = || faces.iter().filter(is_at_end).filter(is_wall);
    let outermost_m = walls().map(|face| middle_distance_m(&face)).fold(0.0, f64::max);
    let is_outer = |f: &&Face| middle_distance_m(f) >= outermost_m - THICKEST_M;
    walls().filter(is_outer).min_by(|a, b| middle_distance_m(a).total_cmp(&middle_distance_m(b))).ok_or(largest)
}

/// Returns the furniture within the walls.
fn furniture(file: &SceneFile, pieces: &[Piece], corner: DVec3, end: DVec3, frequency_hz: f64) -> Vec<FurnitureFile> {
    let mut all: Vec<(f64, FurnitureFile)> = Vec::new();
    for piece in pieces {
        let reflected_power = reflected_power(file, &piece.surface, frequency_hz);
        if reflected_power == 0.0 {
            continue;
        }
        let is_in_wall = |t: u32| {
            let corners = piece.mesh.corners(t as usize).unwrap_or_default();
            let near = |wall_m: f64, i: usize| corners.iter().all(|c| (c[i] - wall_m).abs() < SAME_WALL_M);
            (0..3).any(|i| near(corner[i], i) || near(end[i], i))
        };
        for shell in shells(&piece.mesh, |t| !is_in_wall(t)) {
            let positions = shell.iter().filter_map(|&t| piece.mesh.corners(t as usize)).flatten().collect::<Vec<_>>();
            let [low, high] = bounds(&positions);
            if !(0..3).all(|i| low[i] > corner[i] - SAME_WALL_M && high[i] < end[i] + SAME_WALL_M) {
                continue;
            }
            let area_m2: f64 = shell.iter().map(|&t| 0.5 * piece.mesh.area_vector(t as usize).length()).sum();
            let low = (low - corner).max(DVec3::ZERO);
            let high = (high - corner).min(end - corner);
            let furniture = FurnitureFile {
                name: format!("{} {}", piece.surface.material, all.len() + 1),
                position_m: low.to_array(),
                size_m: (high - low).max(DVec3::ZERO).to_array(),
                material: Some(piece.surface.material.clone()),
                thickness_m: piece.surface.thickness_m,
                cross_section_dbsm: Some(cross_section_dbsm(area_m2, reflected_power)),
                points: ((area_m2 * POINTS_PER_M2) as usize).clamp(6, 64),
            };
            all.push((area_m2 * reflected_power, furniture));
        }
    }
    all.sort_by(|a, b| b.0.total_cmp(&a.0));
    if all.len() > MOST_PIECES {
        tracing::warn!(pieces = all.len(), "only the {MOST_PIECES} largest pieces of furniture are kept");
        all.truncate(MOST_PIECES);
    }
    all.into_iter().map(|(_, furniture)| furniture).collect()
}

/// Returns the connected sets of the triangles for which `is_counted` holds. Triangles are connected by vertices.
fn shells(mesh: &Mesh, is_counted: impl Fn(u32) -> bool) -> Vec<Vec<u32>> {
    let mut sets = DisjointSets::new(mesh.vertices.len());
    let counted = || (0u32..).zip(&mesh.triangles).filter(|(t, _)| is_counted(*t));
    for (_, triangle) in counted() {
        let [a, b, c] = triangle.map(|v| v as usize);
        sets.join(a, b);
        sets.join(b, c);
    }
    let mut shells: BTreeMap<usize, Vec<u32>> = BTreeMap::new();
    for (t, triangle) in counted() {
        shells.entry(sets.lowest(triangle[0] as usize)).or_default().push(t);
    }
    shells.into_values().collect()
}
