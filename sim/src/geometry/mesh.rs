//! A triangle mesh.

use glam::DVec3;

/// Triangles over shared vertices, counter-clockwise seen from outside, metres.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Mesh {
    /// Positions, m.
    pub vertices: Vec<DVec3>,
    /// Indices into the vertices.
    pub triangles: Vec<[u32; 3]>,
}

impl Mesh {
    /// Corners of a triangle, m; `None` where it or one of them does not exist.
    pub fn corners(&self, triangle: usize) -> Option<[DVec3; 3]> {
        let [a, b, c] = *self.triangles.get(triangle)?;
        let vertex = |index: u32| self.vertices.get(index as usize).copied();
        Some([vertex(a)?, vertex(b)?, vertex(c)?])
    }

    /// Sum of the triangles' areas, m^2.
    pub fn area_m2(&self) -> f64 {
        (0..self.triangles.len())
            .filter_map(|t| self.corners(t))
            .map(|[a, b, c]| (b - a).cross(c - a).length() / 2.0)
            .sum()
    }

    /// Signed volume, m^3: positive for a closed mesh whose triangles face outwards (divergence theorem).
    pub fn volume_m3(&self) -> f64 {
        (0..self.triangles.len()).filter_map(|t| self.corners(t)).map(|[a, b, c]| a.dot(b.cross(c)) / 6.0).sum()
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
