//! Consistent orientation of the triangles of a surface.

use super::Mesh;
use super::edges::sides;

/// Reverses triangles so that neighbours across an edge of exactly two have the same orientation. The lowest triangle
/// of each connected part determines it. On surfaces with one side only (a Moebius strip) some edge remains
/// inconsistent.
pub fn oriented(mesh: &Mesh) -> Mesh {
    let mut next: Vec<Vec<(usize, bool)>> = vec![Vec::new(); mesh.triangles.len()];
    for run in sides(mesh).chunk_by(|p, q| (p.0, p.1) == (q.0, q.1)) {
        let [(.., t, up), (.., u, other_up)] = *run else { continue };
        let (t, u) = (t as usize, u as usize);
        // Two triangles that run in the same direction along their edge face different ways.
        next[t].push((u, up == other_up));
        next[u].push((t, up == other_up));
    }
    let mut turned: Vec<Option<bool>> = vec![None; mesh.triangles.len()];
    for first in 0..mesh.triangles.len() {
        if turned[first].is_some() {
            continue;
        }
        turned[first] = Some(false);
        let mut reached = vec![(first, false)];
        while let Some((triangle, is_turned)) = reached.pop() {
            for &(other, differs) in &next[triangle] {
                if turned[other].is_none() {
                    turned[other] = Some(is_turned ^ differs);
                    reached.push((other, is_turned ^ differs));
                }
            }
        }
    }
    let triangles = mesh.triangles.iter().zip(&turned).map(|(&[a, b, c], turned)| match turned {
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
    fn a_cube_with_turned_triangles_is_closed_again() {
        let good = Mesh::cube();
        for pattern in [0b0000_0000_0010u32, 0b1010_0110_0100, 0b0111_1111_1110] {
            let mut bad = good.clone();
            for (t, triangle) in bad.triangles.iter_mut().enumerate() {
                if pattern >> t & 1 == 1 {
                    triangle.swap(0, 1);
                }
            }
            assert!(edges(&bad).iter().any(|edge| edge.tangled));
            assert!(oriented(&bad).is_solid(), "{pattern:b}");
        }
        assert_eq!(oriented(&good), good);
        assert_eq!(oriented(&Mesh::default()), Mesh::default());
    }
}
