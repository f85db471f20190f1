//! A ray in the precision of traversal.

use glam::Vec3A;

use super::body::BACK_M;
use super::ray::Ray;
use super::triangle::Shear;

/// No triangle, no group.
pub(super) const NONE: u32 = u32::MAX;

/// A ray as structures and triangles take it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Probe {
    /// For boxes: begins [`BACK_M`] behind the origin.
    pub ray: obvhs::ray::Ray,
    /// For triangles.
    pub shear: Shear,
    pub direction: Vec3A,
    pub nearest: f32,
    pub farthest: f32,
    /// Where the probe begins along the ray, m.
    pub start: f64,
    /// (body, group) of surfaces that are not met.
    except: [(u32, u32); 2],
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
        except: [(NONE, NONE); 2],
    };

    /// A probe that begins at a distance along a ray; one that meets nothing for a ray without place or direction.
    #[inline(always)]
    pub fn new(ray: &Ray, start: f64) -> Self {
        let origin = ray.origin + ray.direction * start;
        let length = ray.direction.length_squared();
        // Written so that NaN is refused.
        if !(origin.abs().max_element() < f64::from(f32::MAX) && length > 0.5 && length < 2.0) {
            return Self::NOWHERE;
        }
        let (origin, direction) = (origin.as_vec3a(), ray.direction.as_vec3a());
        let nearest = if start > 0.0 { 0.0 } else { ray.nearest_m() as f32 };
        let mut except = [(NONE, NONE); 2];
        for (slot, surface) in except.iter_mut().zip(&ray.except) {
            if let Some(s) = surface {
                *slot = (s.body, s.group);
            }
        }
        // As far from the surface on which it ends as from the one on which it begins.
        let farthest = (ray.length_m - start) as f32 - if ray.except[1].is_some() { nearest } else { 0.0 };
        Probe {
            ray: obvhs::ray::Ray::new(origin - direction * BACK_M, direction, 0.0, farthest + BACK_M),
            shear: Shear::new(origin, direction, nearest),
            direction,
            nearest,
            farthest,
            start,
            except,
        }
    }

    /// Groups of a body that are not met.
    #[inline(always)]
    pub fn except(&self, body: u32) -> [u32; 2] {
        let [(a, group_a), (b, group_b)] = self.except;
        [if a == body { group_a } else { NONE }, if b == body { group_b } else { NONE }]
    }
}
