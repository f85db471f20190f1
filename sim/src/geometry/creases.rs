//! Surfaces from meshes: smooth inside, with edges along creases.

use std::collections::HashMap;

use glam::DVec3;

use super::weld::has_area;
use super::{Mesh, Surface, edges};
use crate::math::DisjointSets;

impl Surface {
    /// Makes a surface from a mesh, smooth across every edge whose triangles meet at less than the crease angle.
    /// Vertices at the same position are merged. A vertex normal is the mean of its triangles' normals, weighted by
    /// their angles at the vertex. Triangles without area are left out. A mesh with an open edge is a sheet and
    /// reflects on both sides.
    pub fn from_mesh(mesh: &Mesh, crease_rad: f64) -> Self {
        let mut first_at: HashMap<[u64; 3], u32> = HashMap::new();
        // Adding zero turns -0 into 0.
        let bits = |v: &DVec3| (*v + DVec3::ZERO).to_array().map(f64::to_bits);
        let first_of: Vec<u32> =
            mesh.vertices.iter().zip(0..).map(|(v, i)| *first_at.entry(bits(v)).or_insert(i)).collect();
        let with_area = mesh.triangles.iter().enumerate().filter(|(t, _)| mesh.corners(*t).is_some_and(has_area));
        let triangles = with_area.map(|(_, corners)| corners.map(|i| first_of[i as usize])).collect();
        let welded = Mesh { vertices: mesh.vertices.clone(), triangles };

        let (groups, open) = smooth_corners(&welded, crease_rad);
        let mut surface = Surface { two_sided: open, ..Surface::default() };
        let mut vertex_of: HashMap<u32, u32> = HashMap::new();
        for (t, corners) in welded.all_corners().enumerate() {
            let normal = welded.area_vector(t).normalize();
            let triangle = [0, 1, 2].map(|i| {
                let vertex = *vertex_of.entry(groups[3 * t + i]).or_insert_with(|| {
                    surface.vertices.push(corners[i]);
                    surface.normals.push(DVec3::ZERO);
                    (surface.vertices.len() - 1) as u32
                });
                let (p, q) = (corners[(i + 1) % 3] - corners[i], corners[(i + 2) % 3] - corners[i]);
                surface.normals[vertex as usize] += normal * p.angle_between(q);
                vertex
            });
            surface.triangles.push(triangle);
        }
        for normal in &mut surface.normals {
            *normal = normal.normalize_or(DVec3::Z);
        }
        surface
    }
}

/// For each corner of each triangle, a number that it shares with the corners across smooth edges. Also whether some
/// edge has only one triangle.
fn smooth_corners(mesh: &Mesh, crease_rad: f64) -> (Vec<u32>, bool) {
    let edges = edges(mesh);
    let mut smooth = DisjointSets::new(3 * mesh.triangles.len());
    // No surface continues across a non-manifold edge.
    for edge in edges.iter().filter(|edge| !edge.is_crease(crease_rad)) {
        let Some(right) = edge.right else { continue };
        for vertex in edge.vertices {
            let corner = |triangle: u32| {
                let corners = mesh.triangles[triangle as usize];
                3 * triangle as usize + corners.iter().position(|&v| v == vertex).unwrap_or(0)
            };
            smooth.join(corner(edge.left), corner(right));
        }
    }
    let open = edges.iter().any(|edge| edge.right.is_none() && !edge.is_non_manifold);
    ((0..3 * mesh.triangles.len()).map(|i| smooth.lowest(i) as u32).collect(), open)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::shape;

    #[test]
    fn a_cube_falls_into_six_faces_and_stays_one_surface_when_smoothed() {
        let sharp = Surface::from_mesh(&Mesh::cube(), 0.5);
        assert_eq!((sharp.triangles.len(), sharp.vertices.len()), (12, 24));
        assert!(!sharp.two_sided, "a box has an inside");
        assert!(!sharp.is_smooth());
        let smooth = Surface::from_mesh(&Mesh::cube(), 2.0);
        assert_eq!(smooth.vertices.len(), 8);
        assert!(smooth.is_smooth());
        assert!(smooth.normals.iter().zip(&smooth.vertices).all(|(n, v)| n.dot(*v - DVec3::splat(0.5)) > 0.8));
    }

    /// A triangle soup is welded, triangles without area are dropped, and the normals are those of the sphere.
    #[test]
    fn a_soup_becomes_a_sphere() {
        let sphere = shape::icosphere(DVec3::splat(0.05), 12);
        let mut soup = Mesh::soup(sphere.mesh().all_corners());
        let flat: Vec<[u32; 3]> = soup.triangles.iter().map(|&[a, _, c]| [a, a, c]).collect();
        soup.triangles.extend(flat);
        let surface = Surface::from_mesh(&soup, 0.5);
        assert_eq!(surface.vertices.len(), sphere.vertices.len());
        assert_eq!(surface.triangles.len(), sphere.triangles.len());
        let worst = surface.vertices.iter().zip(&surface.normals).map(|(v, n)| n.angle_between(*v));
        assert!(worst.fold(0.0, f64::max) < 0.01);
        assert!(surface.is_smooth());
    }
}
