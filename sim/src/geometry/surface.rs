//! Surface with normals: smooth inside each patch, with edges only between patches.

use std::collections::HashMap;

use glam::DVec3;

use super::{Mesh, edges};

/// Triangles whose shared vertices carry the normal of the smooth surface that they represent. Vertices along a crease
/// are duplicated, one for each side.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Surface {
    /// Positions, m.
    pub vertices: Vec<DVec3>,
    /// Outward unit normals at the vertices.
    pub normals: Vec<DVec3>,
    /// Indices into the vertices, counter-clockwise seen from outside.
    pub triangles: Vec<[u32; 3]>,
    /// Whether the surface is a sheet that reflects on both sides, and not the skin of a body.
    pub two_sided: bool,
}

impl Surface {
    /// Mean length of the triangles' edges, m; 0 without triangles.
    pub fn mean_edge_m(&self) -> f64 {
        let corners = (0..self.triangles.len()).filter_map(|t| self.corners(t));
        let lengths = corners.flat_map(|corners| [0, 1, 2].map(|i| corners[i].0.distance(corners[(i + 1) % 3].0)));
        let (sum, count) = lengths.fold((0.0, 0usize), |(sum, count), length| (sum + length, count + 1));
        sum / count.max(1) as f64
    }

    /// Corners and normals of a triangle; `None` where it or one of its vertices does not exist.
    #[inline]
    pub fn corners(&self, triangle: usize) -> Option<[(DVec3, DVec3); 3]> {
        let [a, b, c] = *self.triangles.get(triangle)?;
        let corner = |i: u32| Some((*self.vertices.get(i as usize)?, *self.normals.get(i as usize)?));
        Some([corner(a)?, corner(b)?, corner(c)?])
    }

    /// Returns the mesh without its normals.
    pub fn mesh(&self) -> Mesh {
        Mesh { vertices: self.vertices.clone(), triangles: self.triangles.clone() }
    }

    /// Returns whether the surface has no edge: every side of every triangle has exactly one adjacent triangle, with
    /// the same normals.
    pub fn is_smooth(&self) -> bool {
        edges(&self.mesh()).iter().all(|edge| edge.right.is_some())
    }

    /// Returns the same surface with each triangle cut into four. The middle of an edge lies on the curve defined by
    /// the normals at its ends.
    pub fn halved(&self) -> Self {
        let mut finer = Surface { triangles: Vec::new(), ..self.clone() };
        let corner = |v: u32| Some((*self.vertices.get(v as usize)?, *self.normals.get(v as usize)?));
        let mut middles: HashMap<[u32; 2], u32> = HashMap::with_capacity(2 * self.triangles.len());
        for corners in &self.triangles {
            let [Some(ab), Some(bc), Some(ca)] = [(0, 1), (1, 2), (2, 0)].map(|(i, j)| {
                let ends = [corners[i].min(corners[j]), corners[i].max(corners[j])];
                if let Some(&middle) = middles.get(&ends) {
                    return Some(middle);
                }
                let (a, b) = (corner(ends[0])?, corner(ends[1])?);
                let (position, normal) = halfway(a.0, a.1, b.0, b.1);
                let index = finer.vertices.len() as u32;
                finer.vertices.push(position);
                finer.normals.push(normal);
                middles.insert(ends, index);
                Some(index)
            }) else {
                continue;
            };
            let [a, b, c] = *corners;
            finer.triangles.extend([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]);
        }
        finer
    }

    /// Lowest and highest coordinates; both zero for an empty surface.
    pub fn bounds(&self) -> (DVec3, DVec3) {
        let Some(&first) = self.vertices.first() else { return (DVec3::ZERO, DVec3::ZERO) };
        self.vertices.iter().fold((first, first), |(low, high), &v| (low.min(v), high.max(v)))
    }
}

/// Offset of the surface from the middle of an edge, m, from the edge's ends and the unit normals there. The surface is
/// the cubic over the edge that is tangential to it at both ends.
pub(crate) fn bulge([a, b]: [DVec3; 2], [normal_a, normal_b]: [DVec3; 2]) -> DVec3 {
    let d = b - a;
    0.125 * (normal_b * d.dot(normal_b) - normal_a * d.dot(normal_a))
}

/// Midpoint between two points of a surface with these normals, and the normal there, on the cubic that is tangential
/// to the surface at both ends. The result is bit-identical if the ends are swapped.
pub(crate) fn halfway(a: DVec3, normal_a: DVec3, b: DVec3, normal_b: DVec3) -> (DVec3, DVec3) {
    let d = b - a;
    let chord = d.length_squared();
    let mean = normal_a + normal_b;
    // Normal of a parabola over the edge: the mean normal, less the slope in the middle as estimated from the slopes at
    // the ends.
    let tilt = if chord > 0.0 { d * (1.5 * d.dot(mean) / chord) } else { DVec3::ZERO };
    (0.5 * (a + b) + bulge([a, b], [normal_a, normal_b]), (mean - tilt).normalize_or(normal_a))
}

/// Divides a triangle whose sides may be cut at their middles. The sides are from the first corner to the second, and
/// so on. A quadrangle that remains is divided along its shorter diagonal.
pub(crate) fn split<T: Copy>(corners: [T; 3], middles: [Option<T>; 3], distance: impl Fn(T, T) -> f64) -> Vec<[T; 3]> {
    // Corners are counted from one at which the first side is cut and, of two cut sides, the last is not.
    let first = match middles.map(|middle| middle.is_some()) {
        [true, _, false] | [true, true, true] | [false, false, false] => 0,
        [false, true, _] => 1,
        [_, false, true] => 2,
    };
    let [a, b, c] = [0, 1, 2].map(|i| corners[(i + first) % 3]);
    match [0, 1, 2].map(|i| middles[(i + first) % 3]) {
        [Some(ab), Some(bc), Some(ca)] => vec![[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]],
        [Some(ab), Some(bc), None] if distance(ab, c) < distance(a, bc) => vec![[ab, b, bc], [a, ab, c], [ab, bc, c]],
        [Some(ab), Some(bc), None] => vec![[ab, b, bc], [a, ab, bc], [a, bc, c]],
        [Some(ab), None, _] => vec![[a, ab, c], [ab, b, c]],
        _ => vec![[a, b, c]],
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use crate::geometry::shape;

    #[test]
    fn a_sphere_whose_triangles_are_cut_is_a_sphere() {
        let sphere = shape::icosphere(DVec3::splat(0.05), 8);
        let finer = sphere.halved();
        assert_eq!(finer.triangles.len(), 4 * sphere.triangles.len());
        assert!(finer.is_smooth());
        for (vertex, normal) in finer.vertices.iter().zip(&finer.normals) {
            assert!((vertex.length() - 0.05).abs() < 2e-6 && vertex.normalize().distance(*normal) < 1e-9, "{vertex}");
        }
    }
}
