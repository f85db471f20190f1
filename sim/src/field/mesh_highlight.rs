//! Highlights on meshes: stationary phase of physical optics on the smooth body that a mesh stands for.
//!
//! A highlight is where the normal bisects the directions to both antennas, that is where the tangential part `g` of their
//! mean vanishes. A facet holds one when `m_bc . (g_b x g_c)`, `m_ca . (g_c x g_a)` and `m_ab . (g_a x g_b)` have one sign,
//! with `m_ij` the sum of the normals at the ends of an edge: both facets of an edge see the same number with opposite signs,
//! so that a highlight on their border belongs to exactly one of them. Coarse facets are cut along their curved edges first,
//! every edge by itself, as far as their normals spread.
//!
//! Place and Hessian are then taken from normals smoothed over the Fresnel zone around the candidate: the zone is what the
//! wave averages over, and what lies below it is roughness, not shape. Each highlight comes with an estimate of what
//! stationary phase leaves out; where that is too much (caustics, flat places, highlights about to merge), facets are to be
//! integrated instead ([`super::facet`]).

use std::f64::consts::PI;

use glam::{DVec2, DVec3};
use num_complex::Complex64;

use super::facet::halfway;
use super::gauss_map::{FitSums, GaussMap};
use super::terminal::Terminal;
use crate::geometry::{Patch, Surface, Topology};

/// Facets whose normals differ by more than this along an edge, rad, are cut before they are judged.
const SPREAD: f64 = 0.06;
/// Cuts of one facet, at most.
const MAX_DEPTH: u32 = 6;
/// Moves highlights off vertices and edges by a billionth of a radius of curvature.
const PUSH: DVec3 = DVec3::new(3.017e-10, 7.231e-10, 6.213e-10);
/// Times that a fit without a stationary point is widened.
const WIDENINGS: usize = 4;
/// Vertices from which normals are smoothed, at most.
const MOST_VERTICES: usize = 400;
/// Cosine between bisector and normal below which nothing is a highlight: grazing incidence.
const LEAST_COSINE: f64 = 0.1;

/// A highlight on a mesh.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MeshHighlight {
    /// Where it is, m.
    pub point: DVec3,
    /// Unit normal there.
    pub normal: DVec3,
    /// Path length `R_t + R_r`, m.
    pub length_m: f64,
    /// Principal values of the Hessian of half the path, 1/m, the larger magnitude first.
    pub hessian_per_m: [f64; 2],
    /// What stationary phase leaves out here, dB; infinite where it does not hold.
    pub estimate_db: f64,
    /// The triangle that holds it.
    pub triangle: u32,
}

impl MeshHighlight {
    /// Physical optics' integral over the surroundings, for an integrand's amplitude here: `(pi/k)/sqrt|det J|` with a
    /// quarter of pi less phase for each positive principal value and more for each negative one, and the path's phase.
    pub fn integral(&self, amplitude: Complex64, wavenumber_per_m: f64) -> Complex64 {
        let [a, b] = self.hessian_per_m;
        let quarter_turns = 0.25 * PI * (a.signum() + b.signum());
        let weight = PI / wavenumber_per_m / (a * b).abs().sqrt();
        amplitude * Complex64::from_polar(weight, -quarter_turns - wavenumber_per_m * self.length_m)
    }
}

/// A vertex with what both antennas make of it.
#[derive(Clone, Copy)]
struct Corner {
    point: DVec3,
    normal: DVec3,
    /// Mean of the unit vectors to the antennas.
    bisector: DVec3,
    /// Its tangential part.
    g: DVec3,
}

/// A facet, cut or whole, that holds a highlight by the linear test.
struct Candidate {
    triangle: u32,
    corners: [Corner; 3],
    weights: DVec3,
    /// +1 for a least or greatest path, -1 for a saddle.
    index: i32,
}

/// A highlight with its Fresnel zone.
struct Zone {
    highlight: MeshHighlight,
    /// Principal directions, each divided by the zone's radius along it.
    axes: [DVec3; 2],
    /// Sum over the candidates in it.
    index: i32,
}

impl Zone {
    /// Whether a point lies within about a zone and a half.
    fn holds(&self, point: DVec3) -> bool {
        let offset = point - self.highlight.point;
        self.axes[0].dot(offset).powi(2) + self.axes[1].dot(offset).powi(2) < 2.0
    }
}

/// Finds the highlights of a surface for any pair of terminals.
#[derive(Debug, Clone)]
pub struct HighlightFinder<'a> {
    surface: &'a Surface,
    topology: &'a Topology,
    wavenumber_per_m: f64,
    /// Diagonal of the box around the surface, m.
    extent_m: f64,
}

impl<'a> HighlightFinder<'a> {
    /// For a surface, its topology and a wave number.
    pub fn new(surface: &'a Surface, topology: &'a Topology, wavenumber_per_m: f64) -> Self {
        let (low, high) = surface.bounds();
        HighlightFinder { surface, topology, wavenumber_per_m, extent_m: (high - low).length() }
    }

    /// The highlights of a patch.
    pub fn find(&self, patch: &Patch, tx: &Terminal, rx: &Terminal) -> Vec<MeshHighlight> {
        let corners: Vec<Corner> = self
            .surface
            .vertices
            .iter()
            .zip(&self.surface.normals)
            .map(|(&point, &normal)| corner(point, normal, tx, rx))
            .collect();
        let mut candidates = Vec::new();
        for &t in &patch.triangles {
            let Some(triangle) = self.surface.triangles.get(t as usize) else { continue };
            if let [Some(a), Some(b), Some(c)] = triangle.map(|i| corners.get(i as usize)) {
                search(t, [a, b, c], tx, rx, 0, &mut candidates);
            }
        }
        self.resolve(&candidates, tx, rx)
    }

    /// Candidates in one Fresnel zone are one highlight, or none where they cancel.
    fn resolve(&self, candidates: &[Candidate], tx: &Terminal, rx: &Terminal) -> Vec<MeshHighlight> {
        let mut zones: Vec<Zone> = Vec::new();
        let mut unresolved: Vec<&Candidate> = Vec::new();
        for candidate in candidates {
            let Some(refined) = self.refine(candidate, tx, rx) else {
                unresolved.push(candidate);
                continue;
            };
            match zones.iter_mut().find(|zone| zone.holds(refined.highlight.point)) {
                Some(zone) => zone.index += candidate.index,
                None => zones.push(refined),
            }
        }
        unresolved.retain(|candidate| match zones.iter_mut().find(|zone| zone.holds(place(candidate))) {
            Some(zone) => {
                zone.index += candidate.index;
                false
            }
            None => true,
        });
        for i in 0..zones.len() {
            let [a, b] = zones[i].highlight.hessian_per_m;
            let sign = if a * b > 0.0 { 1 } else { -1 };
            // Zones that touch interfere, and one whose candidates do not add up holds more than one highlight.
            let touches = (0..zones.len()).any(|j| j != i && zones[j].holds(zones[i].highlight.point));
            if touches || zones[i].index != sign {
                zones[i].highlight.estimate_db = f64::INFINITY;
            }
        }
        let mut found: Vec<MeshHighlight> = zones.into_iter().map(|zone| zone.highlight).collect();
        // What cancels and leaves nothing behind in the smoothed normals was noise.
        if unresolved.iter().map(|candidate| candidate.index).sum::<i32>() != 0 {
            found.extend(unresolved.iter().map(|candidate| self.unresolved(candidate, tx, rx)));
        }
        found
    }

    /// Something shines here, but not as stationary phase has it.
    fn unresolved(&self, candidate: &Candidate, tx: &Terminal, rx: &Terminal) -> MeshHighlight {
        let point = place(candidate);
        MeshHighlight {
            point,
            normal: blend(candidate, |c| c.normal).normalize_or(DVec3::Z),
            length_m: tx.leg(point).length_m + rx.leg(point).length_m,
            hessian_per_m: [f64::INFINITY; 2],
            estimate_db: f64::INFINITY,
            triangle: candidate.triangle,
        }
    }

    /// The stationary point on normals smoothed around a candidate; `None` where there is none.
    fn refine(&self, candidate: &Candidate, tx: &Terminal, rx: &Terminal) -> Option<Zone> {
        let k = self.wavenumber_per_m;
        let edge_m = self.edge_at(candidate);
        let mut centre = place(candidate);
        let mut normal = blend(candidate, |c| c.normal).normalize_or(DVec3::Z);
        // The zone needs the Hessian, and the Hessian normals smoothed over the zone: from the nearest rings, then again.
        let mut zone_m = edge_m;
        let mut pass = 0;
        let (fit, at, principal) = loop {
            // With its weights a disc of 1.2 radii averages over about half the zone; less than two rings hold no cubic.
            let mut radius_m = (1.2 * zone_m).max(2.3 * edge_m);
            // A plane first: it takes little to be found, and less to be misled by noise. What a cubic cannot make
            // stationary a lesser fit may, or one over more of the surface.
            let mut attempt = None;
            for _ in 0..WIDENINGS {
                let sums = self.gather(candidate, centre, normal, radius_m);
                let sizes = if pass == 0 { &[3][..] } else { sums.sizes() };
                attempt = sizes.iter().find_map(|&size| {
                    let fit = sums.solve(size)?;
                    let at = stationary(&fit, tx, rx, radius_m)?;
                    Some((fit, at))
                });
                if attempt.is_some() {
                    break;
                }
                radius_m *= 1.6;
            }
            let (fit, at) = attempt?;
            let principal = principal_values(hessian(&fit, &at, tx, rx));
            zone_m = fresnel_radius(k, principal[0].0).min(20.0 * edge_m);
            (centre, normal) = (at.point, at.normal);
            pass += 1;
            if pass == 3 || (pass == 2 && at.offset.length() < 0.05 * radius_m) {
                break (fit, at, principal);
            }
        };
        // A zone wider than the body is flat or in focus: there is nothing stationary about it.
        let widest = fresnel_radius(k, principal[1].0);
        let estimate_db =
            if widest > 0.5 * self.extent_m { f64::INFINITY } else { estimate_db(&fit, &principal, k, at.cosine) };
        let (point, length_m) = on_facet(candidate, at.point, tx, rx);
        let hessian_per_m = [principal[0].0, principal[1].0];
        let highlight = MeshHighlight {
            point,
            normal: at.normal,
            length_m,
            hessian_per_m,
            estimate_db,
            triangle: candidate.triangle,
        };
        let axes = principal.map(|(sigma, d)| (fit.u * d.x + fit.v * d.y) * (sigma.abs() * k / PI).sqrt());
        Some(Zone { highlight, axes, index: candidate.index })
    }

    /// Mean length of the sides of the mesh's triangle under a candidate.
    fn edge_at(&self, candidate: &Candidate) -> f64 {
        self.surface
            .corners(candidate.triangle as usize)
            .map_or(0.0, |[a, b, c]| (a.0.distance(b.0) + b.0.distance(c.0) + c.0.distance(a.0)) / 3.0)
    }

    /// Least squares over the normals of the vertices within a radius, weighted down to nothing at its rim.
    fn gather(&self, candidate: &Candidate, centre: DVec3, normal: DVec3, radius_m: f64) -> FitSums {
        let u = normal.any_orthonormal_vector();
        let v = normal.cross(u);
        let mut sums = FitSums::new(centre, [normal, u, v], radius_m);
        let start = self.surface.triangles.get(candidate.triangle as usize);
        let mut queue: Vec<u32> = start.map_or_else(Vec::new, |t| t.to_vec());
        let mut next = 0;
        // Rings outwards; a list of a few hundred is searched faster than a table is cleared.
        while next < queue.len() && queue.len() < MOST_VERTICES {
            let vertex = queue[next];
            next += 1;
            let (Some(&p), Some(&n)) =
                (self.surface.vertices.get(vertex as usize), self.surface.normals.get(vertex as usize))
            else {
                continue;
            };
            let offset = p - centre;
            let reach = offset.length_squared() / (radius_m * radius_m);
            if reach >= 1.0 || n.dot(normal) < 0.2 {
                continue;
            }
            let weight = (1.0 - reach) * (1.0 - reach) / (reach + 0.3);
            sums.add(offset.dot(u) / radius_m, offset.dot(v) / radius_m, weight, n.dot(u), n.dot(v));
            for &neighbour in self.topology.neighbours(vertex) {
                if !queue.contains(&neighbour) {
                    queue.push(neighbour);
                }
            }
        }
        sums
    }
}

fn corner(point: DVec3, normal: DVec3, tx: &Terminal, rx: &Terminal) -> Corner {
    let bisector = if tx == rx { tx.leg(point).towards } else { 0.5 * (tx.leg(point).towards + rx.leg(point).towards) };
    // A view along an axis of symmetry puts the highlight right on a vertex, where all the signs are zero: a push too small to
    // matter, the same everywhere, lets one facet have it.
    let pushed = bisector + PUSH;
    Corner { point, normal, bisector, g: pushed - normal * normal.dot(pushed) }
}

/// Weighted mean over a candidate's corners.
fn blend(candidate: &Candidate, of: impl Fn(&Corner) -> DVec3) -> DVec3 {
    let [a, b, c] = &candidate.corners;
    of(a) * candidate.weights.x + of(b) * candidate.weights.y + of(c) * candidate.weights.z
}

fn place(candidate: &Candidate) -> DVec3 {
    blend(candidate, |c| c.point)
}

/// Judges a facet, cutting it first where its normals spread.
fn search(t: u32, [a, b, c]: [&Corner; 3], tx: &Terminal, rx: &Terminal, depth: u32, found: &mut Vec<Candidate>) {
    let front = |p: &Corner| p.normal.dot(p.bisector);
    if front(a) < 0.0 && front(b) < 0.0 && front(c) < 0.0 {
        return;
    }
    let spread = |p: &Corner, q: &Corner| p.normal.distance_squared(q.normal);
    let (ab, bc, ca) = (spread(a, b), spread(b, c), spread(c, a));
    if depth >= MAX_DEPTH || ab.max(bc).max(ca) <= SPREAD * SPREAD {
        judge(t, [a, b, c], found);
        return;
    }
    // Where every corner's normal lies further from the bisector than normals and bisectors spread, none inside meets it.
    let drift = |p: &Corner, q: &Corner| p.bisector.distance(q.bisector);
    let reach = 1.5 * ab.max(bc).max(ca).sqrt() + drift(a, b).max(drift(b, c)).max(drift(c, a));
    let least = [a, b, c].map(|p| p.g.length()).into_iter().fold(f64::INFINITY, f64::min);
    if least > reach && [a, b, c].iter().all(|p| front(p) > 0.0) {
        return;
    }
    let middle = |p: &Corner, q: &Corner| {
        let (point, normal) = halfway(p.point, p.normal, q.point, q.normal);
        corner(point, normal, tx, rx)
    };
    let limit = SPREAD * SPREAD;
    let next = depth + 1;
    let (mab, mbc, mca) = (middle(a, b), middle(b, c), middle(c, a));
    let mut go = |p: &Corner, q: &Corner, r: &Corner| search(t, [p, q, r], tx, rx, next, found);
    match (ab > limit, bc > limit, ca > limit) {
        (false, false, false) => {}
        (true, true, true) => {
            go(a, &mab, &mca);
            go(&mab, b, &mbc);
            go(&mca, &mbc, c);
            go(&mab, &mbc, &mca);
        }
        (true, false, false) => {
            go(a, &mab, c);
            go(&mab, b, c);
        }
        (false, true, false) => {
            go(b, &mbc, a);
            go(&mbc, c, a);
        }
        (false, false, true) => {
            go(c, &mca, b);
            go(&mca, a, b);
        }
        (true, true, false) => {
            go(b, &mbc, &mab);
            go(&mab, &mbc, c);
            go(&mab, c, a);
        }
        (false, true, true) => {
            go(c, &mca, &mbc);
            go(&mbc, &mca, a);
            go(&mbc, a, b);
        }
        (true, false, true) => {
            go(a, &mab, &mca);
            go(&mca, &mab, b);
            go(&mca, b, c);
        }
    }
}

/// The linear test on one facet.
#[inline]
fn judge(t: u32, [a, b, c]: [&Corner; 3], found: &mut Vec<Candidate>) {
    let edge = |p: &Corner, q: &Corner| (p.normal + q.normal).dot(p.g.cross(q.g));
    let wa = edge(b, c);
    let wb = edge(c, a);
    if (wa > 0.0) != (wb > 0.0) {
        return;
    }
    let wc = edge(a, b);
    if (wb > 0.0) != (wc > 0.0) {
        return;
    }
    // The sign of the facet itself decides where the weights lie.
    let normal = (b.point - a.point).cross(c.point - a.point);
    let raw = DVec3::new(normal.dot(b.g.cross(c.g)), normal.dot(c.g.cross(a.g)), normal.dot(a.g.cross(b.g)));
    let sum = raw.x + raw.y + raw.z;
    let weights = raw / sum;
    let weights = if weights.is_finite() { weights } else { DVec3::splat(1.0 / 3.0) };
    let weights = weights.clamp(DVec3::ZERO, DVec3::ONE);
    let weights = weights / (weights.x + weights.y + weights.z);
    let cosine = (a.bisector.dot(a.normal) + b.bisector.dot(b.normal) + c.bisector.dot(c.normal)) / 3.0;
    // Where `g` is large and noisy the three signs may agree by chance; it vanishes nowhere then.
    let rest = (a.g * weights.x + b.g * weights.y + c.g * weights.z).length_squared();
    let largest = a.g.length_squared().max(b.g.length_squared()).max(c.g.length_squared());
    if cosine < LEAST_COSINE || rest > 0.25 * largest {
        return;
    }
    let index = if wa > 0.0 { 1 } else { -1 };
    found.push(Candidate { triangle: t, corners: [*a, *b, *c], weights, index });
}

/// Where a fit is stationary.
#[derive(Clone, Copy)]
struct Stationary {
    offset: DVec2,
    point: DVec3,
    normal: DVec3,
    cosine: f64,
}

/// Newton's iteration for the place where the normal bisects; `None` where there is none within the radius.
fn stationary(fit: &GaussMap, tx: &Terminal, rx: &Terminal, radius_m: f64) -> Option<Stationary> {
    let mut at = DVec2::ZERO;
    for _ in 0..12 {
        let point = fit.point(at);
        let (t, r) = (tx.leg(point), rx.leg(point));
        let mean = 0.5 * (t.towards + r.towards);
        let cosine = mean.length();
        let bisector = mean / cosine.max(1e-9);
        let miss = fit.tilt(at) - DVec2::new(bisector.dot(fit.u), bisector.dot(fit.v));
        let [uu, uv, vv] = hessian_at(fit, at, tx, rx, cosine);
        let det = uu * vv - uv * uv;
        if !(det.abs() > 0.0 && cosine > LEAST_COSINE) {
            return None;
        }
        let m = miss * cosine;
        let step = DVec2::new(vv * m.x - uv * m.y, uu * m.y - uv * m.x) / (det * radius_m);
        let step = if step.length() > 0.5 { step * (0.5 / step.length()) } else { step };
        at -= step;
        if at.length() >= 1.0 || !at.is_finite() {
            return None;
        }
        if step.length() < 1e-9 {
            let point = fit.point(at);
            let mean = 0.5 * (tx.leg(point).towards + rx.leg(point).towards);
            return Some(Stationary { offset: at * radius_m, point, normal: mean.normalize(), cosine: mean.length() });
        }
    }
    None
}

/// Hessian of half the path over the tangent plane at a place, uu, uv, vv, 1/m.
fn hessian_at(fit: &GaussMap, at: DVec2, tx: &Terminal, rx: &Terminal, cosine: f64) -> [f64; 3] {
    let point = fit.point(at);
    let [mut uu, mut uv, mut vv] = fit.curvature(at).map(|w| w * cosine);
    for leg in [tx.leg(point), rx.leg(point)] {
        let (su, sv) = (leg.towards.dot(fit.u), leg.towards.dot(fit.v));
        let half = 0.5 * leg.curvature_per_m;
        uu += half * (1.0 - su * su);
        uv -= half * su * sv;
        vv += half * (1.0 - sv * sv);
    }
    [uu, uv, vv]
}

fn hessian(fit: &GaussMap, at: &Stationary, tx: &Terminal, rx: &Terminal) -> [f64; 3] {
    hessian_at(fit, at.offset / fit.radius_m, tx, rx, at.cosine)
}

/// Principal values and directions of a symmetric matrix, the larger magnitude first.
fn principal_values([uu, uv, vv]: [f64; 3]) -> [(f64, DVec2); 2] {
    let (mean, half) = (0.5 * (uu + vv), 0.5 * (uu - vv));
    let radius = half.hypot(uv);
    let angle = 0.5 * uv.atan2(half);
    let direction = DVec2::from_angle(angle);
    let (plus, minus) = ((mean + radius, direction), (mean - radius, direction.perp()));
    if plus.0.abs() >= minus.0.abs() { [plus, minus] } else { [minus, plus] }
}

/// Radius of the first Fresnel zone along a principal direction: `sqrt(pi/(k sigma))`.
fn fresnel_radius(wavenumber_per_m: f64, sigma_per_m: f64) -> f64 {
    (PI / (wavenumber_per_m * sigma_per_m.abs().max(1e-12))).sqrt()
}

/// The next terms of the expansion, from how the Hessian changes along each principal direction: where it is
/// `sigma + t x + c x^2` they are `5 t^2/(24 k sigma^3)` and `c/(8 k sigma^2)` of the first. A change by a third over the
/// Fresnel zone comes to a tenth of a decibel.
fn estimate_db(fit: &GaussMap, principal: &[(f64, DVec2); 2], wavenumber_per_m: f64, cosine: f64) -> f64 {
    let mut relative: f64 = 0.0;
    for &(sigma, d) in principal {
        let reach_m = fresnel_radius(wavenumber_per_m, sigma).min(0.8 * fit.radius_m);
        let along = |shift_m: f64| {
            let [uu, uv, vv] = fit.curvature(d * (shift_m / fit.radius_m));
            cosine * (uu * d.x * d.x + 2.0 * uv * d.x * d.y + vv * d.y * d.y)
        };
        let (before, here, after) = (along(-reach_m), along(0.0), along(reach_m));
        let t = 0.5 * (after - before) / reach_m;
        let c = 0.5 * (after + before - 2.0 * here) / (reach_m * reach_m);
        let k_sigma = wavenumber_per_m * sigma.abs();
        relative += 5.0 * t * t / (24.0 * k_sigma * sigma * sigma) + c.abs() / (8.0 * k_sigma * sigma.abs());
    }
    20.0 * relative.ln_1p() / std::f64::consts::LN_10
}

/// A place near a candidate's facet, put onto its curved surface: the point, and the path there, m.
fn on_facet(candidate: &Candidate, near: DVec3, tx: &Terminal, rx: &Terminal) -> (DVec3, f64) {
    let [a, b, c] = &candidate.corners;
    let (ab, ac) = (b.point - a.point, c.point - a.point);
    let cross = ab.cross(ac);
    let area = cross.length_squared();
    if area == 0.0 {
        return (near, tx.leg(near).length_m + rx.leg(near).length_m);
    }
    let offset = near - a.point;
    let (u, v) = (offset.cross(ac).dot(cross) / area, ab.cross(offset).dot(cross) / area);
    let w = 1.0 - u - v;
    let bulge = |p: &Corner, q: &Corner| halfway(p.point, p.normal, q.point, q.normal).0 - 0.5 * (p.point + q.point);
    let curved = 4.0 * (bulge(a, b) * (w * u) + bulge(b, c) * (u * v) + bulge(c, a) * (v * w));
    let point = a.point * w + b.point * u + c.point * v + curved;
    (point, tx.leg(point).length_m + rx.leg(point).length_m)
}

#[cfg(test)]
mod hard_cases {
    use super::*;
    use crate::geometry::shape;

    const K: f64 = 1_257.507_013_171_009;

    fn views(count: usize) -> impl Iterator<Item = DVec3> {
        (0..count).map(move |i| {
            let (i, n) = (i as f64, count as f64);
            let z = 0.94 * (2.0 * (i + 0.5) / n - 1.0);
            let (sine, cosine) = (2.399_963 * i).sin_cos();
            let across = (1.0 - z * z).sqrt();
            DVec3::new(across * cosine, across * sine, z)
        })
    }

    fn find(surface: &Surface, topology: &Topology, end: &Terminal) -> Vec<MeshHighlight> {
        HighlightFinder::new(surface, topology, K).find(&topology.patches[0], end, end)
    }

    /// `pi/det J` against the exact ellipsoid's, dB.
    fn error_db(found: &MeshHighlight, semi_axes: DVec3, radar: DVec3) -> f64 {
        let exact = crate::field::highlight::Ellipsoid {
            centre: DVec3::ZERO,
            axes: glam::DMat3::IDENTITY,
            semi_axes_m: semi_axes,
        }
        .highlight(radar, radar, None)
        .expect("visible");
        let det = found.hessian_per_m[0] * found.hessian_per_m[1];
        10.0 * (exact.det_j / det).log10()
    }

    /// Order of convergence on a torso, to a hundredth of a decibel at 14 mm, and the path to a hundredth of a wavelength.
    #[test]
    fn a_torso_converges() {
        let semi_axes = DVec3::new(0.12, 0.17, 0.3);
        for (edge, worst_db, worst_m) in [(0.028, 0.15, 5e-5), (0.014, 0.02, 5e-6), (0.007, 0.01, 1e-6)] {
            let surface = shape::ellipsoid(semi_axes, edge);
            let topology = Topology::new(&surface);
            for towards in views(60) {
                let radar = towards * 2.0;
                let found = find(&surface, &topology, &Terminal::Near(radar));
                assert_eq!(found.len(), 1, "{towards}");
                let error = error_db(&found[0], semi_axes, radar);
                assert!(error.abs() < worst_db, "{edge} m, {towards}: {error} dB");
                let body = crate::field::highlight::Ellipsoid {
                    centre: DVec3::ZERO,
                    axes: glam::DMat3::IDENTITY,
                    semi_axes_m: semi_axes,
                };
                let exact = body.highlight(radar, radar, None).expect("visible");
                let off = 0.5 * found[0].length_m - exact.distances_m.0;
                assert!(off.abs() < worst_m, "{edge} m, {towards}: {off} m");
            }
        }
    }

    /// Edges as long as the body is thick: every view still has its highlight, and just one.
    #[test]
    fn a_slender_limb_on_a_coarse_mesh_loses_no_highlight() {
        let semi_axes = DVec3::new(0.05, 0.07, 0.22);
        for edge in [0.030, 0.015] {
            let surface = shape::ellipsoid(semi_axes, edge);
            let topology = Topology::new(&surface);
            for towards in views(400) {
                for end in [Terminal::Near(towards * 1.3), Terminal::Far(towards)] {
                    assert_eq!(find(&surface, &topology, &end).len(), 1, "{edge} m, {end:?}");
                }
            }
        }
    }

    /// Normals that are a degree off, each by itself, on a fine mesh: smoothed over the Fresnel zone they cost less than a
    /// decibel (unsmoothed, five).
    #[test]
    fn noisy_normals_are_smoothed_over_the_fresnel_zone() {
        let semi_axes = DVec3::new(0.12, 0.17, 0.3);
        let mut surface = shape::ellipsoid(semi_axes, 0.007);
        let mut state = 1u64;
        let mut random = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 40) as f64 / (1u64 << 24) as f64 - 0.5
        };
        for normal in &mut surface.normals {
            // Uniform over +-s has a deviation of s/sqrt 3: a degree rms along each axis.
            let push = DVec3::new(random(), random(), random()) * (2.0 * 3f64.sqrt() * 1f64.to_radians());
            *normal = (*normal + push).normalize();
        }
        let topology = Topology::new(&surface);
        let mut squares = 0.0;
        for towards in views(60) {
            let radar = towards * 2.0;
            let found = find(&surface, &topology, &Terminal::Near(radar));
            assert_eq!(found.len(), 1, "{towards}");
            squares += error_db(&found[0], semi_axes, radar).powi(2);
        }
        let rms = (squares / 60.0f64).sqrt();
        assert!(rms < 1.0, "{rms} dB");
    }

    /// A flat closed box has no highlight that stationary phase may claim.
    #[test]
    fn flat_faces_are_refused() {
        // An ellipsoid whose end is nearly flat: its Fresnel zone is wider than the body.
        let semi_axes = DVec3::new(0.005, 0.1, 0.1);
        let surface = shape::ellipsoid(semi_axes, 0.004);
        let topology = Topology::new(&surface);
        let found = find(&surface, &topology, &Terminal::Far(DVec3::X));
        assert!(found.iter().all(|h| h.estimate_db > 0.1), "{found:?}");
    }
}
