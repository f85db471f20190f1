//! How near a straight way comes to a body's shadow edge: what a knife-edge weight is a function of.
//!
//! Whether something is in the way is yes or no; what a wave loses is not. Seen along the way, a body has an outline; the
//! distance to the outline, positive beside the body and negative behind it, is a continuous function of the way and of the
//! body's pose, and passes through zero just where the ray begins to be blocked.

use glam::{DVec2, DVec3};

use super::body::Body;
use super::packet::Bundle;
use super::probe::Probe;
use super::ray::Ray;

/// Beside the outline by this much, m, a ray is looked for a way past the body: above what f32 rounds, below what waves see.
const BESIDE_M: f64 = 2e-5;

/// How a straight way passes a body.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Clearance {
    /// Distance across to the body's outline, m: positive where the way is clear, negative where it is blocked.
    pub clearance_m: f64,
    /// Where along the way the outline is nearest, m from its beginning.
    pub along_m: f64,
}

impl Clearance {
    /// The Fresnel-Kirchhoff parameter of the edge, positive in shadow: `-clearance sqrt(2 L / (lambda d1 d2))` for a way of
    /// length `L` split into `d1` and `d2` (ITU-R P.526, section 4.1).
    pub fn fresnel_parameter(&self, length_m: f64, wavelength_m: f64) -> f64 {
        let (before, after) = (self.along_m, length_m - self.along_m);
        -self.clearance_m * (2.0 * length_m / (wavelength_m * before * after)).sqrt()
    }
}

/// An edge of the outline where it is nearest to the way.
struct Candidate {
    /// Across, m.
    offset: DVec2,
    along_m: f64,
    /// Clearance in units of the first Fresnel zone, squared, but for constants.
    fresnel: f64,
    /// Away from the triangle.
    outward: DVec2,
    edge: (u32, u8),
}

/// See [`super::World::clearance`].
pub(super) fn clearance(
    body: &Body,
    number: u32,
    ray: &Ray,
    reach_m: f64,
    probe_of: impl Fn(&Ray) -> Probe,
) -> Option<Clearance> {
    let length = ray.length_m;
    // Written so that NaN is refused.
    if !(length > 0.0 && length.is_finite() && reach_m > 0.0 && reach_m.is_finite()) {
        return None;
    }
    let across = ray.direction.any_orthonormal_pair();
    let blocked = body.any(&probe_of(ray), number);
    let mut candidates = outline(body, &probe_of(ray), ray, across, reach_m);
    candidates.sort_by(|a, b| a.fresnel.total_cmp(&b.fresnel).then(a.edge.cmp(&b.edge)));
    if !blocked {
        let nearest = candidates.first()?;
        return Some(Clearance { clearance_m: nearest.offset.length(), along_m: nearest.along_m });
    }
    // Behind the body there are edges of parts before other parts too; the outline is where there is a way past.
    let passes = |c: &&Candidate| {
        let away = if c.offset.length() > BESIDE_M { c.offset.normalize() } else { c.outward };
        let beside = c.offset + away * BESIDE_M;
        let shift = across.0 * beside.x + across.1 * beside.y;
        !body.any(&probe_of(&Ray { origin: ray.origin + shift, ..*ray }), number)
    };
    let depth = candidates.iter().find(passes).map(|c| (-c.offset.length(), c.along_m));
    let (clearance_m, along_m) = depth.unwrap_or((-reach_m, 0.5 * length));
    Some(Clearance { clearance_m, along_m })
}

/// Edges within reach at which triangles turn away from the way, or end.
fn outline(body: &Body, probe: &Probe, ray: &Ray, (u, v): (DVec3, DVec3), reach_m: f64) -> Vec<Candidate> {
    let flat = |p: DVec3| DVec2::new((p - ray.origin).dot(u), (p - ray.origin).dot(v));
    let along = |p: DVec3| (p - ray.origin).dot(ray.direction);
    // Seen along the way: counter-clockwise or not. Exactly on edge counts as away.
    let faces = |t: u32| body.mesh().area_vector(t as usize).dot(ray.direction) < 0.0;
    let nearest = ray.nearest_m();
    let mut candidates = Vec::new();
    let bundle = Bundle::around(probe, reach_m as f32);
    body.visit_bundle(&bundle, probe, |triangle| {
        let (Some([a, b, c]), Some(next)) = (body.mesh().corners(triangle as usize), body.neighbours(triangle)) else {
            return;
        };
        let towards = faces(triangle);
        for (side, ((p, q, third), other)) in [(a, b, c), (b, c, a), (c, a, b)].into_iter().zip(next).enumerate() {
            // An inner edge belongs to its lower triangle.
            let border = other == u32::MAX;
            if !border && (other < triangle || faces(other) == towards) {
                continue;
            }
            let Some((p, q)) = clip(p, q, along(p), along(q), nearest, ray.length_m - nearest) else { continue };
            let (from, to) = (flat(p), flat(q));
            let step = to - from;
            let part = (-from.dot(step) / step.length_squared().max(f64::MIN_POSITIVE)).clamp(0.0, 1.0);
            let offset = from + step * part;
            if offset.length() > reach_m {
                continue;
            }
            let s = along(p.lerp(q, part));
            let side_of_third = step.perp_dot(flat(third) - from);
            let outward = if side_of_third > 0.0 { -step.perp() } else { step.perp() };
            candidates.push(Candidate {
                offset,
                along_m: s,
                fresnel: offset.length_squared() * ray.length_m / (s * (ray.length_m - s)),
                outward: outward.normalize_or_zero(),
                edge: (triangle, side as u8),
            });
        }
    });
    // Split boxes hold a triangle several times; sorting makes that harmless.
    candidates
}

/// The part of an edge between two distances along the way.
fn clip(p: DVec3, q: DVec3, at_p: f64, at_q: f64, least: f64, greatest: f64) -> Option<(DVec3, DVec3)> {
    if at_p.max(at_q) <= least || at_p.min(at_q) >= greatest {
        return None;
    }
    let at = |s: f64| p.lerp(q, ((s - at_p) / (at_q - at_p)).clamp(0.0, 1.0));
    let inside = |s: f64| s > least && s < greatest;
    let ends = |point: DVec3, s: f64| if inside(s) { point } else { at(s.clamp(least, greatest)) };
    Some((ends(p, at_p), ends(q, at_q)))
}
