//! Consistent orientation of the triangles of a surface.

use super::Mesh;
use super::edges::{Side, sides};

/// Reverses triangles so that neighbours across an edge of exactly two have the same orientation. The triangle of
/// lowest index in each connected part keeps its own. On surfaces with one side only (a Moebius strip) some edge
/// remains inconsistent.
pub fn oriented(mesh: &Mesh) -> Mesh {
    // Neighbours of each triangle, and whether their orientations differ.
    let mut neighbours: Vec<Vec<(usize, bool)>> = vec![Vec::new(); mesh.triangles.len()];
    for of_edge in sides(mesh).chunk_by(Side::has_same_vertices) {
        let [first, second] = of_edge else { continue };
        // Triangles that run in the same direction along their edge have different orientations.
        let differs = first.is_ascending == second.is_ascending;
        let (t, u) = (first.triangle as usize, second.triangle as usize);
        neighbours[t].push((u, differs));
        neighbours[u].push((t, differs));
    }
    let mut reversed: Vec<Option<bool>> = vec![None; mesh.triangles.len()];
    for first in 0..mesh.triangles.len() {
        if reversed[first].is_some() {
            continue;
        }
        reversed[first] = Some(false);
        let mut pending = vec![(first, false)];
        while let Some((triangle, is_reversed)) = pending.pop() {
            for &(other, differs) in &neighbours[triangle] {
                if reversed[other].is_none() {
                    reversed[other] = Some(is_reversed ^ differs);
                    pending.push((other, is_reversed ^ differs));
                }
            }
        }
    }
    let triangles = mesh.triangles.iter().zip(&reversed).map(|(&[a, b, c], reversed)| match reversed {
        Some(true) => [a, c, b],
        _ => [a, b, c],
    });
    Mesh { vertices: mesh.vertices.clone(), triangles: triangles.collect() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::edges;

    #[test]
    fn a_cube_with_reversed_triangles_is_closed_again() {
        let good = Mesh::cube();
        for pattern in [0b0000_0000_0010u32, 0b1010_0110_0100, 0b0111_1111_1110] {
            let mut bad = good.clone();
            for (t, triangle) in bad.triangles.iter_mut().enumerate() {
                if pattern >> t & 1 == 1 {
                    triangle.swap(0, 1);
                }
            }
            assert!(edges(&bad).iter().any(|edge| edge.is_non_manifold));
            assert!(oriented(&bad).is_solid(), "{pattern:b}");
        }
        assert_eq!(oriented(&good), good);
        assert_eq!(oriented(&Mesh::default()), Mesh::default());
    }
}
