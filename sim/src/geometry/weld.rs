//! Welding: merges coincident vertices and removes triangles without area.

use std::collections::HashMap;

use glam::DVec3;

use super::mesh::{Mesh, MeshError};

/// Least height of a triangle over its longest edge, as a part of that edge. Lower triangles are dropped, because their
/// normals would be rounding errors.
const LEAST_HEIGHT: f64 = 1e-12;

/// Mesh after welding.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Welded {
    /// The mesh.
    pub mesh: Mesh,
    /// Original index of every remaining triangle; triangles without area are removed.
    pub triangle_of: Vec<u32>,
}

/// Merges vertices within a tolerance, which is positive and finite. Each moves to the first of its group, so no vertex
/// moves farther than the tolerance.
///
/// Files without indices (STL) and texture seams have separate vertices along an edge. Unless these are merged, rays
/// leak there and normals are wrong.
///
/// # Errors
/// [`MeshError`] for a mesh that [`Mesh::check`] refuses.
pub fn weld(mesh: &Mesh, tolerance_m: f64) -> Result<Welded, MeshError> {
    mesh.check()?;
    // Cells are as wide as the tolerance, so all near vertices are in the same or an adjacent cell.
    let cell = |v: DVec3| (v / tolerance_m).floor();
    let mut firsts: HashMap<[u64; 3], Vec<u32>> = HashMap::new();
    let key = |cell: DVec3| (cell + 0.0).to_array().map(f64::to_bits);
    let mut merged_into: Vec<u32> = Vec::with_capacity(mesh.vertices.len());
    for (index, &vertex) in mesh.vertices.iter().enumerate() {
        let own_cell = cell(vertex);
        let near = (0..27).filter_map(|n| {
            let step = DVec3::new(f64::from(n % 3 - 1), f64::from(n / 3 % 3 - 1), f64::from(n / 9 - 1));
            firsts.get(&key(own_cell + step))
        });
        let same = near
            .flatten()
            .filter(|&&f| mesh.vertices.get(f as usize).is_some_and(|p| p.distance(vertex) <= tolerance_m))
            .min();
        match same {
            Some(&first) => merged_into.push(first),
            None => {
                firsts.entry(key(own_cell)).or_default().push(index as u32);
                merged_into.push(index as u32);
            }
        }
    }

    let (mut triangles, mut triangle_of) = (Vec::new(), Vec::new());
    for (index, corners) in mesh.triangles.iter().enumerate() {
        let corners = corners.map(|c| merged_into.get(c as usize).copied().unwrap_or(c));
        if has_area(corners.map(|c| mesh.vertices.get(c as usize).copied().unwrap_or_default())) {
            triangles.push(corners);
            triangle_of.push(index as u32);
        }
    }
    Ok(Welded { mesh: mesh.of_triangles(triangles).0, triangle_of })
}

/// Returns whether a triangle has an area, and therefore a normal.
pub(super) fn has_area([a, b, c]: [DVec3; 3]) -> bool {
    let cross = (b - a).cross(c - a);
    let longest = a.distance_squared(b).max(b.distance_squared(c)).max(c.distance_squared(a));
    cross.is_finite() && cross.length() > LEAST_HEIGHT * longest
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::edges;

    /// Cube in the form of an STL file: 36 separate corners, slightly displaced.
    fn soup() -> Mesh {
        let mut mesh = Mesh::soup(Mesh::cube().all_corners());
        mesh.vertices.iter_mut().zip(0..).for_each(|(vertex, i)| *vertex += f64::from(i / 3) * 3e-9);
        mesh
    }

    #[test]
    fn a_soup_of_triangles_becomes_a_closed_cube() {
        let welded = weld(&soup(), 1e-6).expect("a good mesh");
        assert_eq!(welded.mesh.vertices.len(), 8);
        assert!((welded.mesh.volume_m3() - 1.0).abs() < 1e-6);
        assert!(edges(&welded.mesh).iter().all(|e| e.right.is_some()));
        assert_eq!(welded.triangle_of, (0..12).collect::<Vec<_>>());
    }

    #[test]
    fn welding_again_changes_nothing() {
        let once = weld(&soup(), 1e-6).expect("a good mesh").mesh;
        assert_eq!(weld(&once, 1e-6).expect("a good mesh").mesh, once);
    }
}

#[cfg(test)]
mod hard_cases {
    use super::*;

    /// A triangle whose normal is 0/0 is dropped; a needle is thin, not degenerate.
    #[test]
    fn triangles_without_area_are_dropped_and_needles_are_kept() {
        let vertices = vec![DVec3::ZERO, DVec3::X, DVec3::X * 2.0, DVec3::new(0.5, 1e-7, 0.0), DVec3::X + 1e-9];
        let triangles = vec![[0, 1, 2], [0, 1, 3], [0, 1, 4], [0, 0, 3]];
        let welded = weld(&Mesh { vertices, triangles }, 1e-8).expect("a good mesh");
        assert_eq!(welded.triangle_of, [1]);
    }

    #[test]
    fn vertices_on_either_side_of_a_cell_and_of_zero_are_found() {
        for base in [-1e-6, -1e-12, 0.0, 1e-6, 7.0] {
            let vertices = vec![DVec3::splat(base), DVec3::splat(base + 3e-7), DVec3::X * 3.0, DVec3::Y * 3.0];
            let mesh = Mesh { vertices, triangles: vec![[0, 2, 3], [1, 2, 3]] };
            assert_eq!(weld(&mesh, 1e-6).expect("a good mesh").mesh.vertices.len(), 3, "{base}");
        }
    }

    #[test]
    fn damaged_meshes_are_refused_by_name() {
        let mesh = Mesh { vertices: vec![DVec3::ZERO], triangles: vec![[0, 0, 7]] };
        assert_eq!(weld(&mesh, 1e-6), Err(MeshError::NoSuchVertex { triangle: 0, vertex: 7, vertices: 1 }));
        let mesh = Mesh { vertices: vec![DVec3::ZERO, DVec3::new(0.0, f64::NAN, 0.0)], triangles: vec![] };
        assert!(matches!(weld(&mesh, 1e-6), Err(MeshError::InvalidPosition { vertex: 1, .. })));
        assert_eq!(weld(&Mesh::default(), 1e-6).expect("nothing is a mesh").mesh, Mesh::default());
    }
}
