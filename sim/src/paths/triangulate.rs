//! Triangles of a simple polygon with holes, by ear clipping (G. Meisters, "Polygons have ears", 1975).

use glam::DVec2;

use crate::geometry::polygon::{doubled_area, sides};

/// Twice the signed area of a triangle, positive counter-clockwise.
fn turn(a: DVec2, b: DVec2, c: DVec2) -> f64 {
    (b - a).perp_dot(c - a)
}

/// Triangulates a polygon. Indices count the outline's corners first and then those of the holes, in order; triangles
/// are counter-clockwise. `None` where the outlines cross themselves or each other.
pub(super) fn triangulate(outline: &[DVec2], holes: &[Vec<DVec2>]) -> Option<Vec<[u32; 3]>> {
    let points: Vec<DVec2> = outline.iter().chain(holes.iter().flatten()).copied().collect();
    let ring = bridged(&points, outline, holes)?;
    clip_ears(&points, ring)
}

/// Single ring of corners around the polygon: holes are joined to the outline by pairs of coincident sides.
fn bridged(points: &[DVec2], outline: &[DVec2], holes: &[Vec<DVec2>]) -> Option<Vec<usize>> {
    let oriented = |first: usize, corners: &[DVec2], positive: bool| -> Vec<usize> {
        let all = first..first + corners.len();
        if (doubled_area(corners) > 0.0) == positive { all.collect() } else { all.rev().collect() }
    };
    let mut ring = oriented(0, outline, true);
    let mut first = outline.len();
    let mut remaining: Vec<Vec<usize>> = Vec::with_capacity(holes.len());
    for hole in holes {
        remaining.push(oriented(first, hole, false));
        first += hole.len();
    }
    while !remaining.is_empty() {
        let Bridge { hole, in_ring, in_hole } = shortest_bridge(points, &ring, &remaining)?;
        let hole = remaining.swap_remove(hole);
        let mut joined = Vec::with_capacity(ring.len() + hole.len() + 2);
        joined.extend_from_slice(ring.get(..=in_ring)?);
        joined.extend_from_slice(hole.get(in_hole..)?);
        joined.extend_from_slice(hole.get(..=in_hole)?);
        joined.extend_from_slice(ring.get(in_ring..)?);
        ring = joined;
    }
    Some(ring)
}

/// Segment from a corner of the ring to a corner of a hole.
struct Bridge {
    /// Index of the hole.
    hole: usize,
    /// Index of the corner in the ring.
    in_ring: usize,
    /// Index of the corner in the hole.
    in_hole: usize,
}

/// Shortest bridge from the ring to a hole that crosses no side.
fn shortest_bridge(points: &[DVec2], ring: &[usize], holes: &[Vec<usize>]) -> Option<Bridge> {
    let sides: Vec<(DVec2, DVec2)> = std::iter::once(ring)
        .chain(holes.iter().map(Vec::as_slice))
        .flat_map(|corners| sides(corners).map(move |[a, b]| (points[a], points[b])))
        .collect();
    let mut best: Option<(f64, Bridge)> = None;
    for (number, hole) in holes.iter().enumerate() {
        for (in_ring, &from) in ring.iter().enumerate() {
            let before = points[ring[(in_ring + ring.len() - 1) % ring.len()]];
            let after = points[ring[(in_ring + 1) % ring.len()]];
            for (in_hole, &to) in hole.iter().enumerate() {
                let (p, q) = (points[from], points[to]);
                let length = p.distance_squared(q);
                if best.as_ref().is_none_or(|(least, _)| length < *least)
                    && begins_inside(before, p, after, q)
                    && !sides.iter().any(|&(a, b)| crosses(p, q, a, b))
                {
                    best = Some((length, Bridge { hole: number, in_ring, in_hole }));
                }
            }
        }
    }
    best.map(|(_, bridge)| bridge)
}

/// Returns whether the segment from a corner to a point begins inside the polygon.
fn begins_inside(before: DVec2, corner: DVec2, after: DVec2, to: DVec2) -> bool {
    if turn(before, corner, after) >= 0.0 {
        turn(corner, to, before) > 0.0 && turn(to, corner, after) > 0.0
    } else {
        !(turn(corner, to, after) >= 0.0 && turn(to, corner, before) >= 0.0)
    }
}

/// Returns whether two segments cross between their ends.
fn crosses(p: DVec2, q: DVec2, a: DVec2, b: DVec2) -> bool {
    turn(p, q, a) * turn(p, q, b) < 0.0 && turn(a, b, p) * turn(a, b, q) < 0.0
}

/// Triangles of a ring of corners, from which one ear after another is clipped; `None` if the ring crosses itself.
fn clip_ears(points: &[DVec2], mut ring: Vec<usize>) -> Option<Vec<[u32; 3]>> {
    let mut triangles = Vec::with_capacity(ring.len().saturating_sub(2));
    let corners = |ring: &[usize], i: usize| {
        let n = ring.len();
        [ring[(i + n - 1) % n], ring[i], ring[(i + 1) % n]]
    };
    while ring.len() > 3 {
        if let Some(ear) = (0..ring.len()).find(|&i| is_ear(points, &ring, corners(&ring, i))) {
            triangles.push(corners(&ring, ear).map(|c| c as u32));
            ring.remove(ear);
            continue;
        }
        // A corner within a straight line is no ear, but there may be ears after its removal.
        let is_straight = |i: usize| {
            let [a, b, c] = corners(&ring, i).map(|c| points[c]);
            turn(a, b, c).abs() <= 1e-14 * (1.0 + a.distance_squared(c))
        };
        let straight = (0..ring.len()).find(|&i| is_straight(i))?;
        ring.remove(straight);
    }
    let last = [*ring.first()?, *ring.get(1)?, *ring.get(2)?];
    let [a, b, c] = last.map(|c| points[c]);
    if turn(a, b, c) > 0.0 {
        triangles.push(last.map(|c| c as u32));
    }
    Some(triangles)
}

/// Returns whether a corner with its neighbours is a triangle that contains no other corner of the ring.
fn is_ear(points: &[DVec2], ring: &[usize], [a, b, c]: [usize; 3]) -> bool {
    let (a, b, c) = (points[a], points[b], points[c]);
    if turn(a, b, c) <= 1e-14 * (1.0 + a.distance_squared(c)) {
        return false;
    }
    ring.iter()
        .map(|&i| points[i])
        .all(|p| p == a || p == b || p == c || turn(a, b, p) < 0.0 || turn(b, c, p) < 0.0 || turn(c, a, p) < 0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn area(outline: &[DVec2], holes: &[Vec<DVec2>]) -> f64 {
        let points: Vec<DVec2> = outline.iter().chain(holes.iter().flatten()).copied().collect();
        let triangles = triangulate(outline, holes).expect("triangles");
        triangles.iter().map(|t| t.map(|i| points[i as usize])).map(|[a, b, c]| 0.5 * turn(a, b, c)).sum()
    }

    fn outline(corners: &[[f64; 2]]) -> Vec<DVec2> {
        corners.iter().map(|p| DVec2::from_array(*p)).collect()
    }

    #[test]
    fn an_l_and_a_wall_with_two_windows_keep_their_areas() {
        let l = outline(&[[0.0, 0.0], [8.0, 0.0], [8.0, 8.0], [6.0, 8.0], [6.0, 2.0], [0.0, 2.0]]);
        assert!((area(&l, &[]) - 28.0).abs() < 1e-12);
        let wall = outline(&[[0.0, 0.0], [6.0, 0.0], [6.0, 3.0], [0.0, 3.0]]);
        let window = |x: f64| outline(&[[x, 1.0], [x + 1.0, 1.0], [x + 1.0, 2.0], [x, 2.0]]);
        let turned: Vec<DVec2> = window(3.5).into_iter().rev().collect();
        assert!((area(&wall, &[window(1.0), turned]) - 16.0).abs() < 1e-12);
    }

    #[test]
    fn corners_within_a_straight_side_stay_corners() {
        let square = outline(&[[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [2.0, 2.0], [1.0, 2.0], [0.0, 2.0]]);
        assert!((area(&square, &[]) - 4.0).abs() < 1e-12);
        assert_eq!(triangulate(&square, &[]).expect("triangles").len(), 4);
    }
}
