//! Meshes and mesh checks for tests.

use glam::DVec3;

use super::{Mesh, edges, overlaps};

impl Mesh {
    /// The unit cube `0..1`, facing outwards.
    pub(crate) fn cube() -> Self {
        let vertices = (0..8).map(|i| DVec3::new(f64::from(i & 1), f64::from(i >> 1 & 1), f64::from(i >> 2))).collect();
        let quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
        Mesh { vertices, triangles: quads.into_iter().flat_map(|[a, b, c, d]| [[a, b, c], [a, c, d]]).collect() }
    }

    /// Sheet `0..n` by `0..n` of unit squares in the plane z = 0, facing +z, without some of the squares. Squares and
    /// vertices are numbered along x first.
    pub(crate) fn sheet(n: u32, left_out: &[u32]) -> Self {
        let side = n + 1;
        let vertices = (0..side * side).map(|i| DVec3::new(f64::from(i % side), f64::from(i / side), 0.0)).collect();
        let square = |i: u32| {
            let a = i % n + i / n * side;
            [[a, a + 1, a + side + 1], [a, a + side + 1, a + side]]
        };
        Mesh { vertices, triangles: (0..n * n).filter(|i| !left_out.contains(i)).flat_map(square).collect() }
    }

    /// Joins two meshes, the triangles of this one before those of the other.
    pub(crate) fn joined(&self, other: &Mesh) -> Self {
        let first = self.vertices.len() as u32;
        let moved = other.triangles.iter().map(|corners| corners.map(|corner| corner + first));
        Mesh {
            vertices: [self.vertices.as_slice(), &other.vertices].concat(),
            triangles: self.triangles.iter().copied().chain(moved).collect(),
        }
    }

    /// Returns whether the mesh is one closed surface that faces outwards without overlaps.
    pub(crate) fn is_solid(&self) -> bool {
        let is_closed = edges(self).iter().all(|edge| edge.right.is_some());
        is_closed && self.volume_m3() > 0.0 && overlaps(self) == 0
    }
}
