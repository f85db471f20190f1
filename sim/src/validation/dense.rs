//! Plain physical optics: a surface cut into small, equal patches of constant phase. It is the reference for the
//! solver's error and run time.

use glam::DVec3;
use num_complex::Complex64;

use super::facet::{Integral, Sample};
use crate::geometry::Surface;

/// Largest number of parts of a facet's edge.
const MOST_CUTS: f64 = 2048.0;

/// Longest edge of a triangle, m.
fn longest_edge_m(a: DVec3, b: DVec3, c: DVec3) -> f64 {
    a.distance(b).max(b.distance(c)).max(c.distance(a))
}

/// Returns the smallest `patch_m` that [`integrate`] can meet for all facets.
pub fn finest_patch_m(surface: &Surface) -> f64 {
    let corners = (0..surface.triangles.len()).filter_map(|t| surface.corners(t));
    corners.map(|[(a, _), (b, _), (c, _)]| longest_edge_m(a, b, c)).fold(0.0, f64::max) / MOST_CUTS
}

/// Sums the integrand over patches, each with the value at its middle. Their edges are at most `patch_m`, but not below
/// [`finest_patch_m`]. The patches of a facet lie on the curved surface defined by its corners' normals.
pub fn integrate(
    surface: &Surface,
    wavenumber_per_m: f64,
    patch_m: f64,
    sample: impl Fn(DVec3, DVec3) -> Sample,
) -> Integral {
    let mut sum = Integral::default();
    for corners in (0..surface.triangles.len()).filter_map(|t| surface.corners(t)) {
        let [(a, na), (b, nb), (c, nc)] = corners;
        let cuts = (longest_edge_m(a, b, c) / patch_m.max(1e-9)).ceil().clamp(1.0, MOST_CUTS) as usize;
        // Offset of the middle of each edge from the chord.
        let bulge = |p: DVec3, n: DVec3, q: DVec3, m: DVec3| 0.5 * ((q - p).dot(m) * m - (q - p).dot(n) * n);
        let (ab, bc, ca) = (bulge(a, na, b, nb), bulge(b, nb, c, nc), bulge(c, nc, a, na));
        let at = |u: f64, v: f64| {
            let w = 1.0 - u - v;
            (a * w + b * u + c * v + ab * (w * u) + bc * (u * v) + ca * (v * w), na * w + nb * u + nc * v)
        };
        let area = 0.5 * (b - a).cross(c - a).length() / (cuts * cuts) as f64;
        let size = 1.0 / cuts as f64;
        for i in 0..cuts {
            for j in 0..cuts - i {
                let mut add_patch = |shift: f64| {
                    let (point, normal) = at((i as f64 + shift) * size, (j as f64 + shift) * size);
                    let sample = sample(point, normal.normalize_or(na));
                    sum.facets += 1;
                    sum.value += sample.amplitude * Complex64::from_polar(area, -wavenumber_per_m * sample.length_m);
                };
                add_patch(1.0 / 3.0);
                if i + j + 1 < cuts {
                    add_patch(2.0 / 3.0);
                }
            }
        }
    }
    sum
}
