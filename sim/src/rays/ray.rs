//! Rays and their hits.

use glam::DVec3;

/// Straight ray through the world.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ray {
    /// Start point, m.
    pub origin: DVec3,
    /// Direction; a unit vector.
    pub direction: DVec3,
    /// Largest distance of an intersection, m.
    pub length_m: f64,
    /// Coplanar groups of triangles on which the ray begins and ends; it does not meet them. The origin stays on its
    /// surface: 10 um beside it would be 0.025 rad at 60 GHz.
    pub except: [Option<u32>; 2],
    /// Unit normal of the surface on which the ray begins, to the side to which it goes; zero for a free place. Only
    /// the f32 rounding of the origin is kept on this side: if rounded below a floor, a grazing ray would pass below
    /// the wall.
    pub side: DVec3,
}

/// Intersection of a ray with a surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hit {
    /// Index of the triangle in the mesh.
    pub triangle: u32,
    /// Distance along the ray in f32, m; accurate enough to order surfaces.
    pub distance_m: f64,
    /// Whether the triangle faces the ray, so that it is met from outside.
    pub front: bool,
}

impl Ray {
    /// Makes an infinite ray from a point in a direction of any nonzero length.
    pub fn new(origin: DVec3, towards: DVec3) -> Self {
        Ray {
            origin,
            direction: towards.normalize_or_zero(),
            length_m: f64::INFINITY,
            except: [None; 2],
            side: DVec3::ZERO,
        }
    }

    /// Makes a ray from one point to another.
    pub fn between(from: DVec3, to: DVec3) -> Self {
        Ray { length_m: from.distance(to), ..Ray::new(from, to - from) }
    }

    /// Returns the same ray, beginning on a coplanar group with this normal of either sign.
    pub fn leaving(mut self, group: u32, normal: DVec3) -> Self {
        self.except[0] = Some(group);
        self.side = normal.normalize_or_zero() * self.direction.dot(normal).signum();
        self
    }

    /// Returns the same ray, ending on a coplanar group.
    pub fn reaching(mut self, group: u32) -> Self {
        self.except[1] = Some(group);
        self
    }

    /// Point at a distance along the ray, m.
    pub fn at(&self, distance_m: f64) -> DVec3 {
        self.origin + self.direction * distance_m
    }

    /// Distance from the origin that f32 cannot resolve, m. A ray from a free place meets nothing nearer. A ray that
    /// leaves a surface meets only facing triangles there.
    pub fn nearest_m(&self) -> f64 {
        4e-6 * (1.0 + self.origin.abs().max_element())
    }
}
