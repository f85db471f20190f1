//! Ray in f32, the precision of traversal.

use glam::{DVec3, Vec3A};

use super::ray::Ray;
use super::triangle::Shear;

/// Least distance behind a ray's origin at which box traversal begins, m: obvhs skips boxes that end within 0.1 mm of
/// the origin.
const BACK_M: f32 = 2e-4;

/// Index that means no triangle or no group.
pub(super) const NONE: u32 = u32::MAX;

/// Ray in the form used by the box and triangle tests.
#[derive(Debug, Clone, Copy)]
pub(super) struct Probe {
    /// Ray for the box tests, which begins behind the origin.
    pub ray: obvhs::ray::Ray,
    /// Shear for the triangle tests.
    pub shear: Shear,
    pub direction: Vec3A,
    /// Distance that f32 cannot resolve ([`Ray::nearest_m`]), m.
    pub nearest: f32,
    /// Largest distance of an intersection, m.
    pub farthest: f32,
    /// Distance along the ray at which the probe begins, m.
    pub start: f64,
    /// Coplanar groups that the probe does not hit.
    pub excluded_groups: [u32; 2],
    /// Distance behind the origin at which the box ray begins, m.
    pub back: f32,
    /// Origin of the ray itself.
    ray_origin: DVec3,
    /// Direction of the ray itself.
    ray_direction: DVec3,
    /// Whether the ray begins on a surface.
    is_from_surface: bool,
}

impl Probe {
    /// Makes a probe that begins at a distance along a ray; `None` for a ray without a finite origin or direction,
    /// which hits nothing.
    #[inline(always)]
    pub fn new(ray: &Ray, start: f64) -> Option<Self> {
        let nearest_m = if start > 0.0 { 0.0 } else { ray.nearest_m() };
        let origin = ray.origin + ray.direction * start + ray.side_normal * nearest_m;
        let length = ray.direction.length_squared();
        // This form of the test rejects NaN.
        if !(origin.abs().max_element() < f64::from(f32::MAX) && length > 0.5 && length < 2.0) {
            return None;
        }
        // The sum turns -0 into +0; for -0 the box test would take the direction as negative by its inverse and
        // positive by its sign.
        let nearest = nearest_m as f32;
        let (origin, direction) = (origin.as_vec3a(), ray.direction.as_vec3a() + Vec3A::ZERO);
        let back = BACK_M.max(2.0 * nearest);
        // The gap at the end surface equals the gap at the start surface.
        let farthest = (ray.length_m - start) as f32 - if ray.end_groups[1].is_some() { nearest } else { 0.0 };
        Some(Probe {
            ray: obvhs::ray::Ray::new(origin - direction * back, direction, 0.0, farthest + back),
            back,
            ray_origin: ray.origin,
            ray_direction: ray.direction,
            is_from_surface: ray.end_groups[0].is_some(),
            shear: Shear::new(origin, direction, nearest),
            direction,
            nearest,
            farthest,
            start,
            excluded_groups: ray.end_groups.map(|group| group.unwrap_or(NONE)),
        })
    }

    /// Returns whether an intersection nearer to the origin than f32 resolves is real. A ray from a point in the air
    /// has no such intersections. A ray that leaves a surface has one if the triangle faces it, which f64 decides. Such
    /// a triangle is the other wall of a corner, and not the back of a neighbour behind which rounding put the origin.
    #[cold]
    pub fn is_real_near_hit(&self, corners: Option<[DVec3; 3]>) -> bool {
        let Some([a, b, c]) = corners.filter(|_| self.is_from_surface) else { return false };
        let normal = (b - a).cross(c - a);
        let height = (self.ray_origin - a).dot(normal);
        // A height of zero within rounding counts as a hit, so that a ray from the crease itself stays in the room.
        self.ray_direction.dot(normal) < 0.0 && height >= -1e-12 * normal.length()
    }
}
