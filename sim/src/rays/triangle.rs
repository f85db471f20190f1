//! Watertight test of a ray against a triangle.

use glam::Vec3A;
use glam::swizzles::Vec3Swizzles;

/// Corners by coordinate: `[x, y, z]`, each holding that coordinate of the three corners.
pub(super) type Corners = [Vec3A; 3];

/// Intersection of a ray with a triangle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Intersection {
    pub distance: f32,
    /// Weights of the corners, not yet divided by their sum; negative if the ray comes from behind.
    pub weights: Vec3A,
}

/// Transform to coordinates in which a ray runs along z through the origin. Axes are permuted so that z is the longest
/// component of its direction, then sheared.
#[derive(Debug, Clone, Copy)]
pub(super) struct Shear {
    pub axes: [usize; 3],
    pub origin: [Vec3A; 3],
    pub shear_x: Vec3A,
    pub shear_y: Vec3A,
    pub scale_z: f32,
    nearest: f32,
}

impl Shear {
    #[inline(always)]
    pub fn new(origin: Vec3A, direction: Vec3A, nearest: f32) -> Self {
        let d = direction.to_array();
        let size = direction.abs();
        let kz = if size.x > size.y && size.x > size.z {
            0
        } else if size.y > size.z {
            1
        } else {
            2
        };
        let (next, after) = ([1, 2, 0][kz], [2, 0, 1][kz]);
        // The swap keeps the winding.
        let (kx, ky) = if d[kz] < 0.0 { (after, next) } else { (next, after) };
        let o = origin.to_array();
        Shear {
            axes: [kx, ky, kz],
            origin: [Vec3A::splat(o[kx]), Vec3A::splat(o[ky]), Vec3A::splat(o[kz])],
            shear_x: Vec3A::splat(d[kx] / d[kz]),
            shear_y: Vec3A::splat(d[ky] / d[kz]),
            scale_z: 1.0 / d[kz],
            nearest,
        }
    }

    /// Corners in ray coordinates: across (x, y) and along (z). The same corner gives the same numbers in every
    /// triangle.
    #[inline(always)]
    pub fn transformed(&self, corners: &Corners) -> [Vec3A; 3] {
        let [kx, ky, kz] = self.axes;
        let z = corners[kz] - self.origin[2];
        let x = (corners[kx] - self.origin[0]) - self.shear_x * z;
        let y = (corners[ky] - self.origin[1]) - self.shear_y * z;
        [x, y, z]
    }

    /// Intersection with the triangle, at a distance of at most `farthest`, and behind the origin by at most the
    /// resolution of f32.
    #[inline(always)]
    pub fn intersect(&self, corners: &Corners, farthest: f32) -> Option<Intersection> {
        let [x, y, z] = self.transformed(corners);
        // Weight of the edge opposite each corner, from P to Q: Qx Py - Qy Px, which the edge's other triangle computes
        // negated.
        let mut weights = x.zxy() * y.yzx() - y.zxy() * x.yzx();
        let positive = weights.cmpgt(Vec3A::ZERO).bitmask();
        let negative = weights.cmplt(Vec3A::ZERO).bitmask();
        if positive != 7 && negative != 7 {
            if positive != 0 && negative != 0 {
                return None;
            }
            weights = exact_weights(x, y)?;
        }
        // The order of the sum is the same on every processor.
        let sum = (weights.x + weights.y) + weights.z;
        let moment = weights * z;
        let distance = ((moment.x + moment.y) + moment.z) * self.scale_z / sum;
        // This form of the test treats NaN as a miss.
        (distance >= -self.nearest && distance <= farthest).then_some(Intersection { distance, weights })
    }
}

/// Weights of the corners in f64, where in f32 no two differ in sign and some are zero; `None` for a miss.
///
/// Products of two f32 are exact in f64, and their difference has the right sign. Where that is zero too, the ray hits
/// the edge itself. The ray is then treated as passing at (h, h^2), h infinitesimal: `h (Qy - Py) + h^2 (Px - Qx)`
/// changes sign with the edge's direction.
#[cold]
fn exact_weights(x: Vec3A, y: Vec3A) -> Option<Vec3A> {
    let (x, y) = (x.as_dvec3(), y.as_dvec3());
    let exact = x.zxy() * y.yzx() - y.zxy() * x.yzx();
    let mut positive = 0;
    for (lane, (q, p)) in [(2, 1), (0, 2), (1, 0)].into_iter().enumerate() {
        let sign = [exact[lane], y[q] - y[p], x[p] - x[q]].into_iter().find(|&s| s != 0.0)?;
        positive += u32::from(sign > 0.0);
    }
    if positive != 0 && positive != 3 {
        return None;
    }
    // The weights are scaled, because they may be too small for f32. All are zero for a triangle seen edge-on.
    let largest = exact.abs().max_element();
    (largest > 0.0).then(|| (exact / largest).as_vec3a())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shear(origin: Vec3A, direction: Vec3A) -> Shear {
        Shear::new(origin, direction.normalize(), 0.0)
    }

    fn corners(a: [f32; 3], b: [f32; 3], c: [f32; 3]) -> Corners {
        std::array::from_fn(|axis| Vec3A::new(a[axis], b[axis], c[axis]))
    }

    #[test]
    fn a_triangle_is_hit_at_its_distance_from_both_sides() {
        let triangle = corners([0.0, 0.0, 2.0], [0.0, 1.0, 2.0], [1.0, 0.0, 2.0]);
        let up = shear(Vec3A::new(0.25, 0.25, 0.0), Vec3A::Z);
        let hit = up.intersect(&triangle, 9.0).expect("it is above");
        assert_eq!(hit.distance, 2.0);
        assert!(hit.weights.x > 0.0, "normal is -z, the ray sees its front");
        let w = hit.weights / hit.weights.element_sum();
        assert_eq!(w.to_array(), [0.5, 0.25, 0.25]);
        assert_eq!(up.intersect(&triangle, 1.9), None);
        let down = shear(Vec3A::new(0.25, 0.25, 5.0), -Vec3A::Z);
        assert!(down.intersect(&triangle, 9.0).expect("it is below").weights.x < 0.0);
    }

    /// Rays at the hub of a fan and at points of its spokes hit exactly one triangle.
    #[test]
    fn a_fan_is_hit_once_at_its_hub_and_along_its_spokes() {
        for axis in [Vec3A::X, Vec3A::Y, Vec3A::Z, Vec3A::new(1.0, 1.0, 1.0), Vec3A::new(-3.0, 2.0, 0.5)] {
            let (u, v) = axis.normalize().any_orthonormal_pair();
            for spokes in 3..12 {
                let rim = |i: usize| {
                    let angle = i as f32 / spokes as f32 * std::f32::consts::TAU;
                    (u * angle.cos() + v * angle.sin()).to_array()
                };
                let aims = (0..spokes).map(|i| Vec3A::from(rim(i)) * 0.5).chain([Vec3A::ZERO]);
                for aim in aims {
                    let shear = shear(aim - axis * 4.0, axis);
                    let hits = (0..spokes)
                        .filter(|&i| shear.intersect(&corners([0.0; 3], rim(i), rim((i + 1) % spokes)), 1e9).is_some())
                        .count();
                    assert_eq!(hits, 1, "{spokes} spokes, axis {axis}, aim {aim}");
                }
            }
        }
    }
}
