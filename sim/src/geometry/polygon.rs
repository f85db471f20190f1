//! Plane polygons: clipping of convex polygons by planes, areas, and point-in-polygon tests.

use glam::{DVec2, DVec3};

/// Clips a convex polygon to the side of a plane to which its normal points (Sutherland and Hodgman).
pub fn clipped(polygon: &[DVec3], on_plane: DVec3, normal: DVec3) -> Vec<DVec3> {
    let mut kept = Vec::with_capacity(polygon.len() + 1);
    let Some(&last) = polygon.last() else { return kept };
    let mut from = last;
    let mut from_height = normal.dot(from - on_plane);
    for &to in polygon {
        let to_height = normal.dot(to - on_plane);
        if (from_height < 0.0) != (to_height < 0.0) {
            kept.push(from.lerp(to, from_height / (from_height - to_height)));
        }
        if to_height >= 0.0 {
            kept.push(to);
        }
        (from, from_height) = (to, to_height);
    }
    if kept.len() < 3 { Vec::new() } else { kept }
}

/// Ends of the sides of a closed outline.
pub(crate) fn sides<T: Copy>(outline: &[T]) -> impl Iterator<Item = [T; 2]> {
    outline.iter().zip(outline.iter().cycle().skip(1)).map(|(&a, &b)| [a, b])
}

/// Twice the signed area of a closed outline, positive counter-clockwise.
pub(crate) fn doubled_area(outline: &[DVec2]) -> f64 {
    sides(outline).map(|[a, b]| a.perp_dot(b)).sum()
}

/// Distance of a point from a segment between two points.
pub(crate) fn distance_to_segment(point: DVec2, [a, b]: [DVec2; 2]) -> f64 {
    let along = b - a;
    let fraction = ((point - a).dot(along) / along.length_squared().max(f64::MIN_POSITIVE)).clamp(0.0, 1.0);
    point.distance(a + along * fraction)
}

/// Returns whether a point lies within a closed outline: whether a ray from it towards +x crosses an odd number of
/// sides.
pub(crate) fn encloses(outline: &[DVec2], p: DVec2) -> bool {
    let mut inside = false;
    for [a, b] in sides(outline) {
        if (a.y > p.y) != (b.y > p.y) && p.x < a.x + (p.y - a.y) / (b.y - a.y) * (b.x - a.x) {
            inside = !inside;
        }
    }
    inside
}

/// Unit normal, by the right-hand rule along the corners; zero for a polygon without area.
pub fn normal(polygon: &[DVec3]) -> DVec3 {
    area_vector(polygon).normalize_or_zero()
}

/// Area, m^2.
pub fn area_m2(polygon: &[DVec3]) -> f64 {
    area_vector(polygon).length()
}

/// Area times the unit normal, m^2.
fn area_vector(polygon: &[DVec3]) -> DVec3 {
    let Some(&first) = polygon.first() else { return DVec3::ZERO };
    polygon.windows(2).map(|w| (w[0] - first).cross(w[1] - first) * 0.5).sum()
}

/// Low and high corner of the box around points.
pub(crate) fn bounds<'a>(points: impl IntoIterator<Item = &'a DVec3>) -> [DVec3; 2] {
    points.into_iter().fold([DVec3::INFINITY, DVec3::NEG_INFINITY], |[l, h], &p| [l.min(p), h.max(p)])
}

/// Mean of the corners.
pub fn centroid(polygon: &[DVec3]) -> DVec3 {
    polygon.iter().sum::<DVec3>() / polygon.len().max(1) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    const SQUARE: [DVec3; 4] = [DVec3::ZERO, DVec3::X, DVec3::new(1.0, 1.0, 0.0), DVec3::Y];

    #[test]
    fn clipping_leaves_the_area_on_the_side_of_the_normal() {
        let triangle = clipped(&SQUARE, DVec3::new(0.5, 0.5, 0.0), DVec3::new(1.0, 1.0, 0.0));
        assert!((area_m2(&triangle) - 0.5).abs() < 1e-15);
        assert!(clipped(&SQUARE, DVec3::splat(2.0), DVec3::X).is_empty());
        assert_eq!(clipped(&SQUARE, DVec3::ZERO, DVec3::X).len(), 4);
    }
}
