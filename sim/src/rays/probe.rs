//! A ray in the precision of traversal.

use glam::{DVec3, Vec3A};

use super::ray::Ray;
use super::triangle::Shear;

/// Boxes are traversed from at least this far behind a ray's origin, m: obvhs passes over boxes that end within 0.1 mm of it.
const BACK_M: f32 = 2e-4;

/// No triangle, no group.
pub(super) const NONE: u32 = u32::MAX;

/// A ray as structures and triangles take it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Probe {
    /// For boxes: begins behind the origin.
    pub ray: obvhs::ray::Ray,
    /// For triangles.
    pub shear: Shear,
    pub direction: Vec3A,
    pub nearest: f32,
    pub farthest: f32,
    /// Place along the ray at which the probe begins, m.
    pub start: f64,
    /// Coplanar groups that are not met.
    pub except: [u32; 2],
    /// Distance behind the origin at which the boxes' ray begins, m.
    pub back: f32,
    /// Origin and direction of the ray itself.
    exact: (DVec3, DVec3),
    /// True if it begins on a surface.
    leaves: bool,
}

impl Probe {
    /// A probe that meets nothing.
    pub const NOWHERE: Probe = Probe {
        ray: obvhs::ray::Ray {
            origin: Vec3A::ZERO,
            direction: Vec3A::Z,
            inv_direction: Vec3A::ONE,
            tmin: 0.0,
            tmax: f32::NEG_INFINITY,
        },
        shear: Shear::NONE,
        direction: Vec3A::Z,
        nearest: 0.0,
        farthest: f32::NEG_INFINITY,
        start: 0.0,
        except: [NONE; 2],
        back: 0.0,
        exact: (DVec3::ZERO, DVec3::Z),
        leaves: false,
    };

    /// A probe that begins at a distance along a ray; one that meets nothing for a ray without place or direction.
    #[inline(always)]
    pub fn new(ray: &Ray, start: f64) -> Self {
        let nearest_m = if start > 0.0 { 0.0 } else { ray.nearest_m() };
        let origin = ray.origin + ray.direction * start + ray.side * nearest_m;
        let length = ray.direction.length_squared();
        // Written so that NaN is refused.
        if !(origin.abs().max_element() < f64::from(f32::MAX) && length > 0.5 && length < 2.0) {
            return Self::NOWHERE;
        }
        // The sum makes +0 of -0, which the boxes' test takes for a way down at its inverse and a way up at its sign.
        let nearest = nearest_m as f32;
        let (origin, direction) = (origin.as_vec3a(), ray.direction.as_vec3a() + Vec3A::ZERO);
        let back = BACK_M.max(2.0 * nearest);
        // As far from the surface on which it ends as from the one on which it begins.
        let farthest = (ray.length_m - start) as f32 - if ray.except[1].is_some() { nearest } else { 0.0 };
        Probe {
            ray: obvhs::ray::Ray::new(origin - direction * back, direction, 0.0, farthest + back),
            back,
            exact: (ray.origin, ray.direction),
            leaves: ray.except[0].is_some(),
            shear: Shear::new(origin, direction, nearest),
            direction,
            nearest,
            farthest,
            start,
            except: ray.except.map(|group| group.unwrap_or(NONE)),
        }
    }

    /// Whether a meeting nearer than f32 can tell from the origin is one. A ray from a free place meets nothing so near. One
    /// that leaves a surface meets, decided in f64, what faces it: the other wall of a corner, not the back of a neighbour
    /// that rounding put it behind.
    #[cold]
    pub fn meets_near(&self, corners: Option<[DVec3; 3]>) -> bool {
        let Some([a, b, c]) = corners.filter(|_| self.leaves) else { return false };
        let (origin, direction) = self.exact;
        let normal = (b - a).cross(c - a);
        let height = (origin - a).dot(normal);
        // What f64 leaves open is met: a ray from the very crease stays in the room.
        direction.dot(normal) < 0.0 && height >= -1e-12 * normal.length()
    }
}
