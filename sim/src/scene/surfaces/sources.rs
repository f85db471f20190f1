//! Sources of a scene's surfaces: its box, its floor plan or its files, and its furniture.

use std::path::Path;

use glam::DVec3;

use super::{LEAST_FACE_M2, SmallPart, Surfaces};
use crate::em::image::Wall;
use crate::first_warning::is_first_warning;
use crate::geometry::{Mesh, PlanarPolygon, edges, oriented, planes};
use crate::material::Material;
use crate::scene::draft::{Draft, ROOM, closed_wall};
use crate::scene::plan;
use crate::scene::room::{CREASE_RAD, Piece, RoomMeshes, WALLS, WELD_M};
use crate::scene_file::{SceneFile, SolverFile, SurfaceFile};

/// Thickness up to which furniture is a sheet, m.
const SHEET_M: f64 = 1e-6;
/// Least area of a metal face whose missing mirror echo is reported, m^2. At 60 GHz a mirror of this area has -3 dBsm,
/// about as much as a person.
const LEAST_REPORTED_M2: f64 = 0.001;

pub(in crate::scene) fn surfaces(
    file: &SceneFile,
    walls: &[Wall; 6],
    meshes: &RoomMeshes,
    frequency_hz: f64,
) -> Surfaces {
    let mut drafts = Vec::new();
    let mut small = Vec::new();
    if let Some(plan) = &file.room.plan {
        (drafts, _) = plan::faces(file, plan, frequency_hz);
    } else if meshes.pieces.is_empty() {
        drafts = room_box(DVec3::from_array(file.room.size_m), walls);
    } else {
        for piece in &meshes.pieces {
            if let Some(wall) = closed_wall(file, &piece.surface, frequency_hz) {
                add_piece(piece, meshes.corner, wall, &mut drafts, &mut small);
            }
        }
    }
    let first = drafts.iter().map(|draft| draft.group + 1).max().unwrap_or(1);
    drafts.extend(furniture(file, meshes.own_furniture, first, frequency_hz));
    Surfaces::assemble(drafts, small, DVec3::from_array(file.radar.position_m))
}

/// Returns the box `0..size`, with faces that point inwards.
fn room_box(size_m: DVec3, walls: &[Wall; 6]) -> Vec<Draft> {
    let named = WALLS.iter().zip(walls).filter(|(_, wall)| **wall != Wall::Open);
    named
        .filter_map(|(&(name, axis, is_high), &wall)| {
            let polygon = box_side([DVec3::ZERO, size_m], axis, is_high)?.flipped();
            Some(Draft { polygon, wall, name: name.to_owned(), group: ROOM })
        })
        .collect()
}

/// Returns a side of a box, which points outwards; `None` if it has no area.
fn box_side([low, high]: [DVec3; 2], axis: usize, is_high: bool) -> Option<PlanarPolygon> {
    let (i, j) = ((axis + 1) % 3, (axis + 2) % 3);
    let corner = |at_i: f64, at_j: f64| {
        let mut corner = if is_high { high } else { low };
        (corner[i], corner[j]) = (at_i, at_j);
        corner
    };
    let corners = [corner(low[i], low[j]), corner(high[i], low[j]), corner(high[i], high[j]), corner(low[i], high[j])];
    let polygon = PlanarPolygon::from_corners(&corners)?;
    Some(if is_high { polygon } else { polygon.flipped() })
}

/// Returns the sides of the scene file's own furniture that has a material. Each piece is a group.
fn furniture(file: &SceneFile, own_count: usize, first_group: usize, frequency_hz: f64) -> Vec<Draft> {
    let mut drafts = Vec::new();
    for (furniture, group) in file.furniture.iter().take(own_count).zip(first_group..) {
        let Some(material) = furniture.material.clone() else { continue };
        let surface = SurfaceFile { material, thickness_m: furniture.thickness_m };
        let Some(wall) = closed_wall(file, &surface, frequency_hz) else { continue };
        let low = DVec3::from_array(furniture.position_m);
        let size_m = DVec3::from_array(furniture.size_m);
        for (name, axis, is_high) in WALLS {
            // Furniture without depth has a single side for both ends.
            if size_m[axis] <= SHEET_M && is_high {
                continue;
            }
            let name = match name {
                "floor" => "bottom",
                "ceiling" => "top",
                upright => upright,
            };
            if let Some(polygon) = box_side([low, low + size_m], axis, is_high) {
                drafts.push(Draft { polygon, wall, name: format!("{} {name}", furniture.name), group });
            }
        }
    }
    drafts
}

/// Warns of plane faces of metal in a scene's files that are too small to mirror: one warning for all of them.
pub(in crate::scene) fn warn_of_small_faces(file: &SceneFile, meshes: &RoomMeshes, path: &Path) {
    if file.room.solver == Some(SolverFile::Images) {
        return;
    }
    let is_metal = |piece: &&Piece| Material::named(&piece.surface.material) == Some(Material::Metal);
    let (mut count, mut largest) = (0, (0.0, ""));
    for piece in meshes.pieces.iter().filter(is_metal) {
        for area_m2 in small_plane_faces_m2(&oriented(&piece.mesh)) {
            count += 1;
            if area_m2 > largest.0 {
                largest = (area_m2, piece.name.as_str());
            }
        }
    }
    if count > 0 && is_first_warning(&["small faces", &path.to_string_lossy()]) {
        let (name, (area_m2, part)) = (&file.name, largest);
        tracing::warn!(
            "{name}: plane faces of metal smaller than {LEAST_FACE_M2} m^2 have no mirror echo and no echo of their \
             corners: {count}, the largest of {area_m2:.4} m^2 in {part:?}; as [[furniture]], plates along the axes have \
             both at any size"
        );
    }
}

/// Areas of the plane faces of a mesh from [`LEAST_REPORTED_M2`] up to [`LEAST_FACE_M2`], m^2, without the facets of
/// curved surfaces.
fn small_plane_faces_m2(mesh: &Mesh) -> Vec<f64> {
    let planes = planes(mesh, WELD_M);
    let plane_of = |triangle: u32| planes.of_triangle[triangle as usize] as usize;
    let mut is_plane: Vec<bool> =
        planes.planes.iter().map(|plane| (LEAST_REPORTED_M2..LEAST_FACE_M2).contains(&plane.area_m2)).collect();
    for edge in edges(mesh) {
        if let Some(right) = edge.right
            && plane_of(edge.left) != plane_of(right)
            && !edge.is_crease(CREASE_RAD)
        {
            is_plane[plane_of(edge.left)] = false;
            is_plane[plane_of(right)] = false;
        }
    }
    planes.planes.iter().zip(is_plane).filter(|(_, is_plane)| *is_plane).map(|(plane, _)| plane.area_m2).collect()
}

/// Adds the planes of a part of a file as faces, and its other triangles as a small part.
fn add_piece(piece: &Piece, corner: DVec3, wall: Wall, drafts: &mut Vec<Draft>, small: &mut Vec<SmallPart>) {
    let mut mesh = oriented(&piece.mesh);
    mesh.vertices.iter_mut().for_each(|vertex| *vertex -= corner);
    let mut rest = Vec::new();
    for plane in planes(&mesh, WELD_M).planes {
        let polygons = if plane.area_m2 >= LEAST_FACE_M2 { PlanarPolygon::of_plane(&mesh, &plane) } else { Vec::new() };
        if polygons.is_empty() {
            rest.extend(plane.triangles.iter().filter_map(|&t| mesh.triangles.get(t as usize).copied()));
        }
        let name = &piece.name;
        drafts.extend(polygons.into_iter().map(|polygon| Draft { polygon, wall, name: name.clone(), group: ROOM }));
    }
    if !rest.is_empty() {
        small.push(SmallPart { mesh: mesh.of_triangles(rest).0 });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Surface;
    use crate::geometry::shape::cylinder;

    /// A face of 5 cm loses its mirror echo. One of 1 cm is weaker than a person, and facets of a cylinder are no
    /// mirrors.
    #[test]
    fn small_faces_are_those_of_boxes_and_not_of_curves() {
        let scaled = |mut mesh: Mesh, factor: f64| {
            mesh.vertices.iter_mut().for_each(|vertex| *vertex *= factor);
            small_plane_faces_m2(&mesh)
        };
        let of_cube = scaled(Mesh::cube(), 0.05);
        assert!(of_cube.len() == 6 && of_cube.iter().all(|area_m2| (area_m2 - 0.0025).abs() < 1e-9), "{of_cube:?}");
        assert!(scaled(Mesh::cube(), 0.2).is_empty() && scaled(Mesh::cube(), 0.01).is_empty());
        // Facets of 6 by 10 cm.
        let Surface { vertices, triangles, .. } = cylinder(0.3, 0.1, 0.06);
        assert!(small_plane_faces_m2(&Mesh { vertices, triangles }).is_empty());
    }
}
