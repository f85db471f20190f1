//! Search for coplanar triangles that overlap. Both would be lit, so that their area would count twice.

use glam::DVec3;

use super::{Mesh, polygon};

/// Least common area of two coplanar triangles that counts as an overlap, m^2.
const LEAST_OVERLAP_M2: f64 = 1e-6;
/// Largest distance of triangles from each other's planes to count as coplanar, m.
const SAME_PLANE_M: f64 = 1e-5;

/// Number of overlaps after which the search ends. A damaged mesh may have as many as the square of its number of
/// triangles.
const MAX_OVERLAPS: usize = 1000;
/// Number of pairs of triangles after which the search ends.
const MAX_PAIRS: usize = 50_000_000;

/// Bounding box of a triangle.
struct TriangleBox {
    triangle: u32,
    least: DVec3,
    greatest: DVec3,
}

/// Number of pairs of coplanar triangles that overlap by more than 1 mm^2, at most a thousand. They are found by a
/// sweep along x over their bounding boxes.
pub fn overlaps(mesh: &Mesh) -> usize {
    let bounding_box = |t: usize| {
        let [a, b, c] = mesh.corners(t)?;
        Some(TriangleBox { triangle: t as u32, least: a.min(b).min(c), greatest: a.max(b).max(c) })
    };
    let mut boxes: Vec<TriangleBox> = (0..mesh.triangles.len()).filter_map(bounding_box).collect();
    boxes.sort_by(|a, b| a.least.x.total_cmp(&b.least.x).then(a.triangle.cmp(&b.triangle)));
    let (mut found, mut pairs) = (0, 0);
    'search: for (i, first) in boxes.iter().enumerate() {
        let reach = first.greatest + SAME_PLANE_M;
        for second in boxes.iter().skip(i + 1).take_while(|other| other.least.x <= reach.x) {
            pairs += 1;
            if found == MAX_OVERLAPS || pairs > MAX_PAIRS {
                break 'search;
            }
            if second.least.cmpgt(reach).any() || (second.greatest + SAME_PLANE_M).cmplt(first.least).any() {
                continue;
            }
            if common_area_m2(mesh, first.triangle, second.triangle) > LEAST_OVERLAP_M2 {
                found += 1;
            }
        }
    }
    found
}

/// Common area of two triangles in the plane of the first; zero unless they are coplanar.
fn common_area_m2(mesh: &Mesh, first: u32, second: u32) -> f64 {
    let (Some(p), Some(q)) = (mesh.corners(first as usize), mesh.corners(second as usize)) else { return 0.0 };
    let normal = (p[1] - p[0]).cross(p[2] - p[0]).normalize_or_zero();
    let other = (q[1] - q[0]).cross(q[2] - q[0]).normalize_or_zero();
    if normal.cross(other).length() > 1e-3 || q.iter().any(|c| (*c - p[0]).dot(normal).abs() > SAME_PLANE_M) {
        return 0.0;
    }
    let mut shape = q.to_vec();
    for [from, to] in polygon::sides(&p) {
        shape = polygon::clipped(&shape, from, normal.cross(to - from));
    }
    polygon::area_m2(&shape)
}

#[cfg(test)]
mod hard_cases {
    use super::*;

    /// Two cubes side by side share a whole face; a cube one millimetre away shares none.
    #[test]
    fn faces_that_cover_each_other_are_found_with_their_area() {
        let near = Mesh::cube();
        let cube_at = |position: DVec3| {
            let mut cube = Mesh::cube();
            cube.vertices.iter_mut().for_each(|v| *v += position);
            cube
        };
        let area_m2 = |mesh: &Mesh| {
            let pairs = (0..24).flat_map(|first| (first + 1..24).map(move |second| (first, second)));
            pairs.map(|(first, second)| common_area_m2(mesh, first, second)).sum::<f64>()
        };
        let touching = near.joined(&cube_at(DVec3::new(1.0, 0.25, 0.0)));
        assert!((area_m2(&touching) - 0.75).abs() < 1e-9 && overlaps(&touching) > 0, "{}", area_m2(&touching));
        assert_eq!(overlaps(&near.joined(&cube_at(DVec3::new(1.001, 0.25, 0.0)))), 0);
        // With the same cube twice, every face overlaps.
        let twice = near.joined(&near);
        assert!((area_m2(&twice) - 6.0).abs() < 1e-9 && overlaps(&twice) >= 12, "{}", area_m2(&twice));
        assert_eq!(overlaps(&Mesh::default()), 0);
    }
}
