//! Vertex normals of meshes.

use glam::DVec3;

/// Unit normals at the vertices of triangles, from the triangles around each vertex. This suffices for meshes as smooth
/// as the surface that they represent. Weights are Max's, which are exact on a sphere ("Weights for computing vertex
/// normals from facet normals", J. Graphics Tools 4(2), 1999).
pub(crate) fn one_ring_normals(vertices: &[DVec3], triangles: &[[u32; 3]]) -> Vec<DVec3> {
    let mut normals = vec![DVec3::ZERO; vertices.len()];
    for &corners in triangles {
        let [a, b, c] = corners.map(|v| vertices[v as usize]);
        let (ab, bc, ca) = (b - a, c - b, a - c);
        let area_vector = ab.cross(-ca);
        let [ab, bc, ca] = [ab, bc, ca].map(DVec3::length_squared);
        // At a corner, the area vector is divided by the squares of the two sides that meet there. A triangle without
        // area has no weight.
        let product = ab * bc * ca;
        let weighted = if product > 0.0 { area_vector * (1.0 / product) } else { DVec3::ZERO };
        for (vertex, opposite_square) in corners.into_iter().zip([bc, ca, ab]) {
            normals[vertex as usize] += weighted * opposite_square;
        }
    }
    normals.into_iter().map(DVec3::normalize_or_zero).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::isosurface;

    #[test]
    fn a_sphere_s_normals_are_its_radii() {
        let (radius_m, reach) = (0.15, DVec3::splat(0.19));
        let mesh = isosurface(-reach, reach, 0.015, |p| p.length() - radius_m);
        let normals = one_ring_normals(&mesh.vertices, &mesh.triangles);
        assert_eq!(normals.len(), mesh.vertices.len());
        let angle = |(v, n): (&DVec3, &DVec3)| v.cross(*n).length().atan2(v.dot(*n));
        let worst_rad = mesh.vertices.iter().zip(&normals).map(angle).fold(0.0, f64::max);
        assert!(worst_rad < 0.003, "{worst_rad} rad");
    }
}
