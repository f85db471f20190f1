//! Rays and their hits.

use glam::DVec3;

/// Straight ray.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ray {
    /// Start point, m.
    pub origin: DVec3,
    /// Direction; a unit vector.
    pub direction: DVec3,
    /// Largest distance of an intersection, m.
    pub length_m: f64,
    /// Coplanar groups of triangles on which the ray begins and ends; it does not hit them. The origin stays on its
    /// surface: 10 um beside it would be 0.025 rad at 60 GHz.
    pub end_groups: [Option<u32>; 2],
    /// Unit normal of the surface on which the ray begins, on the side to which the ray goes; zero for a point in the
    /// air. It keeps the f32 rounding of the origin on this side. An origin rounded below a floor would let a grazing
    /// ray pass below the wall.
    pub side_normal: DVec3,
}

/// Intersection of a ray with a surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hit {
    /// Index of the triangle in the mesh.
    pub triangle: u32,
    /// Distance along the ray in f32, m; accurate enough to order surfaces.
    pub distance_m: f64,
    /// Whether the triangle faces the ray, so that the ray hits it from outside.
    pub front: bool,
}

impl Ray {
    /// Makes an infinite ray from a point in a direction of any nonzero length.
    pub fn new(origin: DVec3, towards: DVec3) -> Self {
        Ray {
            origin,
            direction: towards.normalize_or_zero(),
            length_m: f64::INFINITY,
            end_groups: [None; 2],
            side_normal: DVec3::ZERO,
        }
    }

    /// Makes a ray from one point to another.
    pub fn between(from: DVec3, to: DVec3) -> Self {
        Ray { length_m: from.distance(to), ..Ray::new(from, to - from) }
    }

    /// Returns the same ray, beginning on a coplanar group with this normal of either sign.
    pub fn leaving(mut self, group: u32, normal: DVec3) -> Self {
        self.end_groups[0] = Some(group);
        self.side_normal = normal.normalize_or_zero() * self.direction.dot(normal).signum();
        self
    }

    /// Returns the same ray, ending on a coplanar group.
    pub fn reaching(mut self, group: u32) -> Self {
        self.end_groups[1] = Some(group);
        self
    }

    /// Point at a distance along the ray, m.
    pub fn at(&self, distance_m: f64) -> DVec3 {
        self.origin + self.direction * distance_m
    }

    /// Distance from the origin that f32 cannot resolve, m. A ray from a point in the air hits nothing nearer. A ray
    /// that leaves a surface hits only facing triangles there.
    pub fn nearest_m(&self) -> f64 {
        4e-6 * (1.0 + self.origin.abs().max_element())
    }
}
