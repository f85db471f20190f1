//! A surface that knows its normals: smooth inside each patch, with edges only between patches.

use glam::DVec3;

use super::Mesh;

/// Triangles whose shared vertices carry the normal of the smooth surface that they stand for. Vertices along a crease exist
/// once on either side of it.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Surface {
    /// Positions, m.
    pub vertices: Vec<DVec3>,
    /// Outward unit normals at the vertices.
    pub normals: Vec<DVec3>,
    /// Indices into the vertices, counter-clockwise seen from outside.
    pub triangles: Vec<[u32; 3]>,
    /// A sheet that reflects on either side, rather than a body's skin.
    pub two_sided: bool,
}

impl Surface {
    /// Corners and normals of a triangle; `None` where it or one of its vertices does not exist.
    #[inline]
    pub fn corners(&self, triangle: usize) -> Option<[(DVec3, DVec3); 3]> {
        let [a, b, c] = *self.triangles.get(triangle)?;
        let corner = |i: u32| Some((*self.vertices.get(i as usize)?, *self.normals.get(i as usize)?));
        Some([corner(a)?, corner(b)?, corner(c)?])
    }

    /// The mesh without its normals.
    pub fn mesh(&self) -> Mesh {
        Mesh { vertices: self.vertices.clone(), triangles: self.triangles.clone() }
    }

    /// Lowest and highest coordinates; both zero for no vertex.
    pub fn bounds(&self) -> (DVec3, DVec3) {
        let Some(&first) = self.vertices.first() else { return (DVec3::ZERO, DVec3::ZERO) };
        self.vertices.iter().fold((first, first), |(low, high), &v| (low.min(v), high.max(v)))
    }
}
