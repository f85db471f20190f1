//! A triangle mesh.

use glam::DVec3;
use thiserror::Error;

/// Largest accepted coordinate, m: beyond it, rays in f32 would not resolve a wavelength.
pub const MAX_COORDINATE_M: f64 = 10_000.0;

/// Error for an invalid mesh.
#[derive(Debug, Error, PartialEq)]
pub enum MeshError {
    /// A triangle names a vertex that does not exist.
    #[error("triangle {triangle} names vertex {vertex}, but there are {vertices}")]
    NoSuchVertex {
        /// Index of the triangle.
        triangle: usize,
        /// Index of the vertex that it names.
        vertex: u32,
        /// Number of vertices of the mesh.
        vertices: usize,
    },
    /// A vertex has no valid position.
    #[error("vertex {vertex} is at {position}, expected finite coordinates of at most {MAX_COORDINATE_M} m")]
    InvalidPosition {
        /// Index of the vertex.
        vertex: usize,
        /// Position, m.
        position: DVec3,
    },
}

/// Triangle mesh with shared vertices, counter-clockwise seen from outside, in metres.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Mesh {
    /// Positions, m.
    pub vertices: Vec<DVec3>,
    /// Indices into the vertices.
    pub triangles: Vec<[u32; 3]>,
}

impl Mesh {
    /// Mesh of triangles that share no vertex.
    pub(crate) fn soup(triangles: impl IntoIterator<Item = [DVec3; 3]>) -> Self {
        let vertices: Vec<DVec3> = triangles.into_iter().flatten().collect();
        let triangles = (0..vertices.len() as u32 / 3).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect();
        Mesh { vertices, triangles }
    }

    /// Checks that every index has a vertex and every vertex a valid position.
    ///
    /// # Errors
    /// [`MeshError::NoSuchVertex`] and [`MeshError::InvalidPosition`].
    pub fn check(&self) -> Result<(), MeshError> {
        self.check_within(MAX_COORDINATE_M)
    }

    /// Checks a mesh whose coordinates are not yet in metres, and may have any finite value.
    ///
    /// # Errors
    /// [`MeshError::NoSuchVertex`] and [`MeshError::InvalidPosition`].
    pub(crate) fn check_unscaled(&self) -> Result<(), MeshError> {
        self.check_within(f64::MAX)
    }

    fn check_within(&self, max_coordinate: f64) -> Result<(), MeshError> {
        let is_valid = |v: &DVec3| v.is_finite() && v.abs().max_element() <= max_coordinate;
        if let Some((vertex, &position)) = self.vertices.iter().enumerate().find(|(_, v)| !is_valid(v)) {
            return Err(MeshError::InvalidPosition { vertex, position });
        }
        let vertices = self.vertices.len();
        for (triangle, corners) in self.triangles.iter().enumerate() {
            if let Some(&vertex) = corners.iter().find(|&&v| v as usize >= vertices) {
                return Err(MeshError::NoSuchVertex { triangle, vertex, vertices });
            }
        }
        Ok(())
    }

    /// Twice the area times the unit normal of a triangle, m^2; zero for one that does not exist.
    pub fn area_vector(&self, triangle: usize) -> DVec3 {
        self.corners(triangle).map_or(DVec3::ZERO, |[a, b, c]| (b - a).cross(c - a))
    }

    /// Corners of a triangle, m; `None` where it or one of them does not exist.
    pub fn corners(&self, triangle: usize) -> Option<[DVec3; 3]> {
        let [a, b, c] = *self.triangles.get(triangle)?;
        let vertex = |index: u32| self.vertices.get(index as usize).copied();
        Some([vertex(a)?, vertex(b)?, vertex(c)?])
    }

    /// Corners of all triangles, m.
    pub fn all_corners(&self) -> impl Iterator<Item = [DVec3; 3]> {
        (0..self.triangles.len()).filter_map(|t| self.corners(t))
    }

    /// Mesh of other triangles over this mesh's vertices. It has only the vertices that they use, in order of first
    /// use. Also returns the original index of each vertex.
    pub(crate) fn of_triangles(&self, triangles: impl IntoIterator<Item = [u32; 3]>) -> (Mesh, Vec<u32>) {
        let mut new_indices = vec![u32::MAX; self.vertices.len()];
        let (mut mesh, mut original_indices) = (Mesh::default(), Vec::new());
        for triangle in triangles {
            mesh.triangles.push(triangle.map(|v| {
                let new_index = &mut new_indices[v as usize];
                if *new_index == u32::MAX {
                    *new_index = original_indices.len() as u32;
                    mesh.vertices.push(self.vertices[v as usize]);
                    original_indices.push(v);
                }
                *new_index
            }));
        }
        (mesh, original_indices)
    }

    /// Sum of the triangles' areas, m^2.
    pub fn area_m2(&self) -> f64 {
        self.all_corners().map(|[a, b, c]| (b - a).cross(c - a).length() / 2.0).sum()
    }

    /// Signed volume, m^3: positive for a closed mesh whose triangles face outwards (divergence theorem).
    pub fn volume_m3(&self) -> f64 {
        self.all_corners().map(|[a, b, c]| a.dot(b.cross(c)) / 6.0).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tetrahedron_has_its_area_and_volume() {
        let vertices = vec![DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z];
        let mesh = Mesh { vertices, triangles: vec![[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]] };
        assert!((mesh.volume_m3() - 1.0 / 6.0).abs() < 1e-15);
        assert!((mesh.area_m2() - (1.5 + 0.75f64.sqrt())).abs() < 1e-15);
        assert_eq!(mesh.corners(4), None);
    }
}
