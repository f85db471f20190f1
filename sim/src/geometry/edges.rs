//! Edges of a mesh: adjacent triangles and the angle between them.

use super::Mesh;

/// Edge of a mesh.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Edge {
    /// Vertices of the edge, in the winding direction of `left`.
    pub vertices: [u32; 2],
    /// Triangle that has the edge on its border; of several the first.
    pub left: u32,
    /// Adjacent triangle, whose winding runs along the edge in the opposite direction. `None` at a border and at a
    /// non-manifold edge.
    pub right: Option<u32>,
    /// Angle between the two triangles' normals, rad. It is positive where the surface is convex (an outer corner: pi/2
    /// for a cube) and negative where it is concave (a corner of a room seen from within). It is zero without a
    /// triangle `right`.
    pub turn_rad: f64,
    /// Whether three or more triangles share the edge, or two of opposite orientation.
    pub is_non_manifold: bool,
}

impl Edge {
    /// Returns whether the surface turns at the edge by more than an angle, or ends there.
    pub fn is_crease(&self, least_turn_rad: f64) -> bool {
        self.right.is_none() || self.turn_rad.abs() > least_turn_rad
    }
}

/// Side of a triangle. Sides are sorted by their vertices, then by triangle.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Side {
    /// Vertex of lower index.
    low: u32,
    /// Vertex of higher index.
    high: u32,
    pub triangle: u32,
    /// Whether the triangle's winding leads from the lower vertex to the higher one.
    pub is_ascending: bool,
}

impl Side {
    /// Returns whether both sides lie on one edge.
    pub fn has_same_vertices(&self, other: &Side) -> bool {
        (self.low, self.high) == (other.low, other.high)
    }
}

/// Sides of all triangles, sorted.
pub(super) fn sides(mesh: &Mesh) -> Vec<Side> {
    let mut sides = Vec::with_capacity(3 * mesh.triangles.len());
    for (triangle, &[a, b, c]) in mesh.triangles.iter().enumerate() {
        for (from, to) in [(a, b), (b, c), (c, a)] {
            let (low, high) = (from.min(to), from.max(to));
            sides.push(Side { low, high, triangle: triangle as u32, is_ascending: from < to });
        }
    }
    sides.sort_unstable();
    sides
}

/// All edges of a mesh, sorted by their lower and then their higher vertex. Every edge of a closed surface has a
/// triangle `right`.
pub fn edges(mesh: &Mesh) -> Vec<Edge> {
    sides(mesh)
        .chunk_by(Side::has_same_vertices)
        .filter_map(|sides| {
            let &Side { low, high, triangle: left, is_ascending } = sides.first()?;
            let vertices = if is_ascending { [low, high] } else { [high, low] };
            let opposite = sides.get(1).filter(|other| other.is_ascending != is_ascending);
            let is_non_manifold = sides.len() > 2 || (sides.len() == 2 && opposite.is_none());
            let right = opposite.filter(|_| !is_non_manifold).map(|other| other.triangle);
            let turn_rad = right.map_or(0.0, |right| turn_rad(mesh, vertices, left, right));
            Some(Edge { vertices, left, right, turn_rad, is_non_manifold })
        })
        .collect()
}

/// Signed angle between the normals of two triangles at an edge, rad ([`Edge::turn_rad`]).
fn turn_rad(mesh: &Mesh, [from, to]: [u32; 2], left: u32, right: u32) -> f64 {
    let [Some(from), Some(to)] = [from, to].map(|v| mesh.vertices.get(v as usize)) else { return 0.0 };
    let [n, m] = [left, right].map(|t| mesh.area_vector(t as usize).normalize_or_zero());
    // At an outer corner the normal turns about the edge in the direction in which the left triangle runs along it.
    let along = (*to - *from).normalize_or_zero();
    n.cross(m).dot(along).atan2(n.dot(m))
}

/// Adjacent triangles of every triangle, per edge (first to second corner, second to third, third to first); `u32::MAX`
/// where there is none.
pub fn neighbours(mesh: &Mesh) -> Vec<[u32; 3]> {
    let mut all = vec![[u32::MAX; 3]; mesh.triangles.len()];
    for edge in edges(mesh) {
        let Some(right) = edge.right else { continue };
        let [from, to] = edge.vertices;
        for (triangle, other, (p, q)) in [(edge.left, right, (from, to)), (right, edge.left, (to, from))] {
            let [a, b, c] = mesh.triangles[triangle as usize];
            if let Some(side) = [(a, b), (b, c), (c, a)].iter().position(|&s| s == (p, q)) {
                all[triangle as usize][side] = other;
            }
        }
    }
    all
}

#[cfg(test)]
mod tests {
    use std::f64::consts::FRAC_PI_2;

    use super::*;

    #[test]
    fn a_cube_turns_outwards_and_a_room_inwards() {
        let mut room = Mesh::cube();
        room.triangles.iter_mut().for_each(|t| t.swap(1, 2));
        for (mesh, turn) in [(Mesh::cube(), FRAC_PI_2), (room, -FRAC_PI_2)] {
            let edges = edges(&mesh);
            assert_eq!(edges.len(), 18, "Euler: 12 edges and 6 diagonals");
            let creases: Vec<_> = edges.iter().filter(|e| e.is_crease(0.1)).collect();
            assert_eq!(creases.len(), 12);
            assert!(creases.iter().all(|e| (e.turn_rad - turn).abs() < 1e-12));
            assert!(edges.iter().all(|e| e.right.is_some()));
        }
    }

    #[test]
    fn a_hole_has_a_boundary_and_a_flipped_triangle_is_non_manifold() {
        let mut open = Mesh::cube();
        open.triangles.pop();
        assert_eq!(edges(&open).iter().filter(|e| e.right.is_none() && !e.is_non_manifold).count(), 3);
        let mut flipped = Mesh::cube();
        flipped.triangles[0].swap(0, 1);
        assert_eq!(edges(&flipped).iter().filter(|e| e.is_non_manifold).count(), 3);
    }

    #[test]
    fn neighbours_are_mutual() {
        let mesh = Mesh::cube();
        let all = neighbours(&mesh);
        for (t, next) in all.iter().enumerate() {
            assert!(next.iter().all(|&n| all[n as usize].contains(&(t as u32))));
        }
    }
}
