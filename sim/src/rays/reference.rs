//! Brute-force reference: tests every triangle in f64, directly from the definition.

use glam::DVec3;

use super::ray::Ray;
use crate::geometry::Mesh;

/// Intersection of a ray with a mesh.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Intersection {
    /// Index of the triangle.
    pub triangle: u32,
    /// Distance, m.
    pub distance_m: f64,
    /// Weights of the corners.
    pub barycentric: [f64; 3],
}

/// Intersection of a ray with the plane of a triangle: distance, m, and weights of the corners. `None` for a ray
/// parallel to the plane.
pub fn plane(ray: &Ray, [a, b, c]: [DVec3; 3]) -> Option<(f64, [f64; 3])> {
    let normal = (b - a).cross(c - a);
    let distance = (a - ray.origin).dot(normal) / ray.direction.dot(normal);
    let point = ray.at(distance);
    let area = normal.length_squared();
    let weight = |p: DVec3, q: DVec3| (p - point).cross(q - point).dot(normal) / area;
    let weights = [weight(b, c), weight(c, a), weight(a, b)];
    (distance.is_finite() && weights.iter().all(|w| w.is_finite())).then_some((distance, weights))
}

/// All triangles that a ray hits, including hits on their edges, by distance and then index.
pub fn all(ray: &Ray, mesh: &Mesh) -> Vec<Intersection> {
    let mut all: Vec<Intersection> = (0..mesh.triangles.len())
        .filter_map(|t| Some((t, plane(ray, mesh.corners(t)?)?)))
        .filter(|(_, (distance, weights))| {
            *distance >= ray.nearest_m() && *distance <= ray.length_m && weights.iter().all(|&w| w >= 0.0)
        })
        .map(|(t, (distance_m, barycentric))| Intersection { triangle: t as u32, distance_m, barycentric })
        .collect();
    all.sort_by(|a, b| a.distance_m.total_cmp(&b.distance_m).then(a.triangle.cmp(&b.triangle)));
    all
}
