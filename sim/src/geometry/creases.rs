//! Surfaces from meshes: smooth inside, with edges along creases.

use std::collections::HashMap;

use glam::DVec3;

use super::{Mesh, Surface};
use crate::math::Sets;

impl Surface {
    /// Makes a surface from a mesh, smooth across every side whose triangles meet at less than the crease angle.
    /// Vertices at the same place are merged. A vertex normal is the mean of its triangles' normals, weighted by their
    /// angles at the vertex. Triangles without area are left out. A mesh with an open side is a sheet and reflects on
    /// either side.
    pub fn from_mesh(mesh: &Mesh, crease_rad: f64) -> Self {
        let mut places: HashMap<[u64; 3], u32> = HashMap::new();
        let place_of: Vec<u32> = mesh
            .vertices
            .iter()
            .map(|v| {
                let next = places.len() as u32;
                // Adding zero turns -0 into 0.
                *places.entry((*v + DVec3::ZERO).to_array().map(f64::to_bits)).or_insert(next)
            })
            .collect();
        let mut kept: Vec<([u32; 3], [DVec3; 3], DVec3)> = Vec::with_capacity(mesh.triangles.len());
        for (t, triangle) in mesh.triangles.iter().enumerate() {
            let Some([a, b, c]) = mesh.corners(t) else { continue };
            let cross = (b - a).cross(c - a);
            let longest = a.distance_squared(b).max(b.distance_squared(c)).max(c.distance_squared(a));
            if cross.is_finite() && cross.length() > 1e-12 * longest {
                let places = triangle.map(|i| place_of.get(i as usize).copied().unwrap_or(0));
                kept.push((places, [a, b, c], cross.normalize()));
            }
        }
        let (groups, open) = smooth_corners(&kept, crease_rad);
        let mut surface = Surface { two_sided: open, ..Surface::default() };
        let mut vertex_of: HashMap<u32, u32> = HashMap::new();
        for (t, (_, corners, normal)) in kept.iter().enumerate() {
            let triangle = [0, 1, 2].map(|i| {
                let vertex = *vertex_of.entry(groups[3 * t + i]).or_insert_with(|| {
                    surface.vertices.push(corners[i]);
                    surface.normals.push(DVec3::ZERO);
                    (surface.vertices.len() - 1) as u32
                });
                let (p, q) = (corners[(i + 1) % 3] - corners[i], corners[(i + 2) % 3] - corners[i]);
                surface.normals[vertex as usize] += *normal * p.angle_between(q);
                vertex
            });
            surface.triangles.push(triangle);
        }
        for (normal, fallback) in surface.normals.iter_mut().zip(std::iter::repeat(DVec3::Z)) {
            *normal = normal.normalize_or(fallback);
        }
        surface
    }
}

/// For each corner of each triangle, a number shared by all corners that it is smooth with. Also whether some side has
/// no triangle behind it.
fn smooth_corners(triangles: &[([u32; 3], [DVec3; 3], DVec3)], crease_rad: f64) -> (Vec<u32>, bool) {
    let mut smooth = Sets::new(3 * triangles.len());
    let mut sides: Vec<((u32, u32), usize, usize)> = Vec::with_capacity(3 * triangles.len());
    for (t, (places, ..)) in triangles.iter().enumerate() {
        for i in 0..3 {
            let (a, b) = (places[i], places[(i + 1) % 3]);
            sides.push(((a.min(b), a.max(b)), t, i));
        }
    }
    sides.sort_unstable();
    let mut open = false;
    for run in sides.chunk_by(|p, q| p.0 == q.0) {
        open |= run.len() == 1;
        // With more than two triangles on a side, no surface continues there.
        let [(_, t, i), (_, u, j)] = *run else { continue };
        if triangles[t].2.angle_between(triangles[u].2) >= crease_rad {
            continue;
        }
        for (k, l) in [(i, (j + 1) % 3), ((i + 1) % 3, j)] {
            // The side runs in the opposite direction in the neighbour; otherwise the two triangles are not one sheet.
            if triangles[t].0[k] != triangles[u].0[l] {
                continue;
            }
            smooth.join(3 * t + k, 3 * u + l);
        }
    }
    ((0..3 * triangles.len()).map(|i| smooth.lowest(i) as u32).collect(), open)
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
