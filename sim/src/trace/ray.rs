//! Rays, and the answers to them.

use glam::DVec3;

/// A surface as rays know it: a coplanar group of one body.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Surface {
    /// Index of the body.
    pub body: u32,
    /// Coplanar group of its triangles ([`crate::trace::Body::group`]).
    pub group: u32,
}

/// A straight way through the world.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ray {
    /// Place at which it begins, m.
    pub origin: DVec3,
    /// Direction; a unit vector.
    pub direction: DVec3,
    /// Nothing farther than this is met, m.
    pub length_m: f64,
    /// The surfaces on which it begins and ends; they are not met. The origin stays on its surface: 10 um beside it would be
    /// 0.025 rad at 60 GHz.
    pub except: [Option<Surface>; 2],
    /// Unit normal of the surface on which it begins, to the side to which it goes; zero for a free place. Only what f32 makes
    /// of the origin is kept on this side: rounded below a floor, a grazing ray would pass below the wall.
    pub side: DVec3,
}

/// Place at which a ray meets a surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hit {
    /// Index of the body.
    pub body: u32,
    /// Index of the triangle in the body's mesh.
    pub triangle: u32,
    /// Distance along the ray as f32 found it, m. Good enough to order surfaces; see [`crate::trace::World::exact`].
    pub distance_m: f64,
    /// Weights of the triangle's three corners.
    pub barycentric: [f32; 3],
    /// The triangle faces the ray: it is met from outside.
    pub front: bool,
}

/// Number of times that a ray goes into and out of a body.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Crossings {
    /// Triangles met from outside.
    pub entered: u32,
    /// Triangles met from inside.
    pub left: u32,
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

    /// The same ray, beginning on a surface with this normal of either sign.
    pub fn leaving(mut self, surface: Surface, normal: DVec3) -> Self {
        self.except[0] = Some(surface);
        self.side = normal.normalize_or_zero() * self.direction.dot(normal).signum();
        self
    }

    /// The same ray, ending on a surface.
    pub fn reaching(mut self, surface: Surface) -> Self {
        self.except[1] = Some(surface);
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
