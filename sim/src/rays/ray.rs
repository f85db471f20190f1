//! Rays, and the answers to them.

use glam::DVec3;

/// A straight way through the world.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ray {
    /// Place at which it begins, m.
    pub origin: DVec3,
    /// Direction; a unit vector.
    pub direction: DVec3,
    /// Nothing farther than this is met, m.
    pub length_m: f64,
    /// Coplanar groups of triangles on which it begins and ends; they are not met. The origin stays on its surface: 10 um beside
    /// it would be 0.025 rad at 60 GHz.
    pub except: [Option<u32>; 2],
    /// Unit normal of the surface on which it begins, to the side to which it goes; zero for a free place. Only what f32 makes
    /// of the origin is kept on this side: rounded below a floor, a grazing ray would pass below the wall.
    pub side: DVec3,
}

/// Place at which a ray meets a surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hit {
    /// Index of the triangle in the mesh.
    pub triangle: u32,
    /// Distance along the ray as f32 found it, m. Good enough to order surfaces.
    pub distance_m: f64,
    /// The triangle faces the ray: it is met from outside.
    pub front: bool,
}

impl Ray {
    /// From a point towards a direction of any length but zero, without end.
    pub fn new(origin: DVec3, towards: DVec3) -> Self {
        Ray {
            origin,
            direction: towards.normalize_or_zero(),
            length_m: f64::INFINITY,
            except: [None; 2],
            side: DVec3::ZERO,
        }
    }

    /// From one point to another.
    pub fn between(from: DVec3, to: DVec3) -> Self {
        Ray { length_m: from.distance(to), ..Ray::new(from, to - from) }
    }

    /// The same ray, beginning on a coplanar group with this normal of either sign.
    pub fn leaving(mut self, group: u32, normal: DVec3) -> Self {
        self.except[0] = Some(group);
        self.side = normal.normalize_or_zero() * self.direction.dot(normal).signum();
        self
    }

    /// The same ray, ending on a coplanar group.
    pub fn reaching(mut self, group: u32) -> Self {
        self.except[1] = Some(group);
        self
    }

    /// Point at a distance.
    pub fn at(&self, distance_m: f64) -> DVec3 {
        self.origin + self.direction * distance_m
    }

    /// Distance from the origin that f32 cannot resolve, m. A ray from a free place meets nothing nearer; one that leaves a
    /// surface meets only what faces it there.
    pub fn nearest_m(&self) -> f64 {
        4e-6 * (1.0 + self.origin.abs().max_element())
    }
}
