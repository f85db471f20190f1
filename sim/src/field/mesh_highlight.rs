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
use super::terminal::Terminal;
use crate::geometry::{Patch, Surface, Topology};

/// Facets whose normals differ by more than this along an edge, rad, are cut before they are judged.
const SPREAD: f64 = 0.06;
/// Cuts of one facet, at most.
const MAX_DEPTH: u32 = 6;
/// Fresnel zones of fewer edges than this are not smoothed over: the mesh says no more than its normals do.
const NO_SMOOTHING: f64 = 1.5;
/// From this many edges on, smoothing alone speaks.
const FULL_SMOOTHING: f64 = 2.5;
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

/// Finds the highlights of a surface for any pair of terminals.
#[derive(Debug, Clone)]
pub struct HighlightFinder<'a> {
    surface: &'a Surface,
    topology: &'a Topology,
    wavenumber_per_m: f64,
}

impl<'a> HighlightFinder<'a> {
    /// For a surface, its topology and a wave number.
    pub fn new(surface: &'a Surface, topology: &'a Topology, wavenumber_per_m: f64) -> Self {
        HighlightFinder { surface, topology, wavenumber_per_m }
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
        self.resolve(candidates, tx, rx)
    }

    /// Candidates within each other's Fresnel zone are one highlight, or none where they cancel.
    fn resolve(&self, candidates: Vec<Candidate>, tx: &Terminal, rx: &Terminal) -> Vec<MeshHighlight> {
        let mut found: Vec<(MeshHighlight, f64)> = Vec::new();
        let mut taken = vec![false; candidates.len()];
        for i in 0..candidates.len() {
            if taken[i] {
                continue;
            }
            taken[i] = true;
            let candidate = &candidates[i];
            let (highlight, zone_m) = self.refine(candidate, tx, rx);
            let mut index = candidate.index;
            let mut crowded = false;
            for j in i + 1..candidates.len() {
                if !taken[j] && place(&candidates[j]).distance(place(candidate)) < zone_m {
                    taken[j] = true;
                    crowded = true;
                    index += candidates[j].index;
                }
            }
            let Some(mut highlight) = highlight else {
                // A pair that cancels and leaves nothing behind in the smoothed normals was noise.
                if !(crowded && index == 0) {
                    found.push((self.unresolved(candidate, tx, rx), zone_m));
                }
                continue;
            };
            let sign = if highlight.hessian_per_m[0] * highlight.hessian_per_m[1] > 0.0 { 1 } else { -1 };
            if crowded && index == 0 {
                continue;
            }
            if crowded && index != sign {
                highlight.estimate_db = f64::INFINITY;
            }
            found.push((highlight, zone_m));
        }
        // Zones that overlap interfere: neither is a highlight by itself.
        for i in 0..found.len() {
            for j in i + 1..found.len() {
                if found[i].0.point.distance(found[j].0.point) < found[i].1 + found[j].1 {
                    found[i].0.estimate_db = f64::INFINITY;
                    found[j].0.estimate_db = f64::INFINITY;
                }
            }
        }
        found.into_iter().map(|(highlight, _)| highlight).collect()
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

    /// The stationary point on normals smoothed around a candidate, and the lesser radius of its Fresnel zone.
    fn refine(&self, candidate: &Candidate, tx: &Terminal, rx: &Terminal) -> (Option<MeshHighlight>, f64) {
        let k = self.wavenumber_per_m;
        let edge_m = self.edge_at(candidate);
        let mut centre = place(candidate);
        let mut normal = blend(candidate, |c| c.normal).normalize_or(DVec3::Z);
        // The zone needs the Hessian, and the Hessian normals smoothed over the zone: from the facet's own slope, then again.
        let mut zone_m = edge_m;
        let mut last = None;
        for pass in 0..3 {
            let radius_m = (1.2 * zone_m).max(2.3 * edge_m);
            let Some(mut fit) = self.fit(candidate, centre, normal, radius_m) else { return (None, zone_m) };
            let smoothing = (zone_m / edge_m.max(1e-12) - NO_SMOOTHING) / (FULL_SMOOTHING - NO_SMOOTHING);
            if smoothing < 1.0 {
                fit.blend(candidate, smooth_step(smoothing.max(0.0)));
            }
            let Some(at) = stationary(&fit, tx, rx, radius_m) else { return (None, zone_m) };
            let j = hessian(&fit, &at, tx, rx);
            let principal = principal_values(j);
            zone_m = fresnel_radius(k, principal[0].0).min(20.0 * edge_m);
            (centre, normal) = (at.point, at.normal);
            last = Some((fit, at, principal));
            if pass > 0 && at.offset.length() < 0.05 * radius_m {
                break;
            }
        }
        let Some((fit, at, principal)) = last else { return (None, zone_m) };
        let estimate_db = estimate_db(&fit, &principal, k, at.cosine);
        let (point, length_m) = on_facet(candidate, at.point, tx, rx);
        let highlight = MeshHighlight {
            point,
            normal: at.normal,
            length_m,
            hessian_per_m: [principal[0].0, principal[1].0],
            estimate_db,
            triangle: candidate.triangle,
        };
        (Some(highlight), zone_m)
    }

    /// Mean length of the sides of the mesh's triangle under a candidate.
    fn edge_at(&self, candidate: &Candidate) -> f64 {
        self.surface.corners(candidate.triangle as usize).map_or(0.0, |[a, b, c]| {
            (a.0.distance(b.0) + b.0.distance(c.0) + c.0.distance(a.0)) / 3.0
        })
    }

    /// Least squares over the normals of the vertices within a radius, weighted down to nothing at its rim.
    fn fit(&self, candidate: &Candidate, centre: DVec3, normal: DVec3, radius_m: f64) -> Option<GaussMap> {
        let u = normal.any_orthonormal_vector();
        let v = normal.cross(u);
        let mut sums = Normal6::default();
        let start = *self.surface.triangles.get(candidate.triangle as usize)?;
        let mut queue: Vec<u32> = start.to_vec();
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
            let weight = (1.0 - reach) * (1.0 - reach);
            sums.add(offset.dot(u) / radius_m, offset.dot(v) / radius_m, weight, n.dot(u), n.dot(v));
            for &neighbour in self.topology.neighbours(vertex) {
                if !queue.contains(&neighbour) {
                    queue.push(neighbour);
                }
            }
        }
        let (along_u, along_v) = sums.solve()?;
        Some(GaussMap { centre, normal, u, v, radius_m, along_u, along_v })
    }
}

fn corner(point: DVec3, normal: DVec3, tx: &Terminal, rx: &Terminal) -> Corner {
    let bisector =
        if tx == rx { tx.leg(point).towards } else { 0.5 * (tx.leg(point).towards + rx.leg(point).towards) };
    Corner { point, normal, bisector, g: bisector - normal * normal.dot(bisector) }
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
    if cosine < LEAST_COSINE {
        return;
    }
    let index = if wa > 0.0 { 1 } else { -1 };
    found.push(Candidate { triangle: t, corners: [*a, *b, *c], weights, index });
}

/// The normals around a point as quadratic functions of the place: `n . u` and `n . v` over `1, x, y, x^2, xy, y^2`, with x
/// and y in units of the radius.
struct GaussMap {
    centre: DVec3,
    normal: DVec3,
    u: DVec3,
    v: DVec3,
    radius_m: f64,
    along_u: [f64; 6],
    along_v: [f64; 6],
}

impl GaussMap {
    /// Mixes the fit with the plane through the normals of a candidate's own corners.
    fn blend(&mut self, candidate: &Candidate, share: f64) {
        let places = candidate.corners.map(|c| {
            let offset = c.point - self.centre;
            DVec2::new(offset.dot(self.u), offset.dot(self.v)) / self.radius_m
        });
        let (p, q) = (places[1] - places[0], places[2] - places[0]);
        let det = p.perp_dot(q);
        if det == 0.0 {
            return;
        }
        for (fitted, axis) in [(&mut self.along_u, self.u), (&mut self.along_v, self.v)] {
            let [a, b, c] = candidate.corners.map(|corner| corner.normal.dot(axis));
            let x = ((b - a) * q.y - (c - a) * p.y) / det;
            let y = ((c - a) * p.x - (b - a) * q.x) / det;
            let own = [a - x * places[0].x - y * places[0].y, x, y, 0.0, 0.0, 0.0];
            for (f, o) in fitted.iter_mut().zip(own) {
                *f = share * *f + (1.0 - share) * o;
            }
        }
    }

    /// Tangential components of the normal at a place (in radii).
    fn tilt(&self, at: DVec2) -> DVec2 {
        let value = |c: &[f64; 6]| {
            c[0] + c[1] * at.x + c[2] * at.y + c[3] * at.x * at.x + c[4] * at.x * at.y + c[5] * at.y * at.y
        };
        DVec2::new(value(&self.along_u), value(&self.along_v))
    }

    /// The shape operator at a place, made symmetric: uu, uv, vv, 1/m.
    fn curvature(&self, at: DVec2) -> [f64; 3] {
        let x = |c: &[f64; 6]| c[1] + 2.0 * c[3] * at.x + c[4] * at.y;
        let y = |c: &[f64; 6]| c[2] + c[4] * at.x + 2.0 * c[5] * at.y;
        let (a, b) = (&self.along_u, &self.along_v);
        [x(a), 0.5 * (y(a) + x(b)), y(b)].map(|w| w / self.radius_m)
    }

    /// The surface's point at a place: the normals' slopes, summed up from the centre.
    fn point(&self, at: DVec2) -> DVec3 {
        let start = DVec2::new(self.along_u[0], self.along_v[0]);
        let depth = at.dot(0.5 * (self.tilt(at) + start));
        self.centre + self.radius_m * (self.u * at.x + self.v * at.y - self.normal * depth)
    }
}

fn smooth_step(x: f64) -> f64 {
    x * x * (3.0 - 2.0 * x)
}

/// Sums of a weighted least-squares fit of two functions by quadratics.
#[derive(Default)]
struct Normal6 {
    matrix: [[f64; 6]; 6],
    right: [[f64; 2]; 6],
    count: usize,
}

impl Normal6 {
    fn add(&mut self, x: f64, y: f64, weight: f64, u: f64, v: f64) {
        let row = [1.0, x, y, x * x, x * y, y * y];
        for i in 0..6 {
            for j in 0..=i {
                self.matrix[i][j] += weight * row[i] * row[j];
            }
            self.right[i][0] += weight * row[i] * u;
            self.right[i][1] += weight * row[i] * v;
        }
        self.count += 1;
    }

    /// Quadratics, or planes where the points are too few for them.
    fn solve(self) -> Option<([f64; 6], [f64; 6])> {
        if self.count >= 9
            && let Some(solution) = self.cholesky(6)
        {
            return Some(solution);
        }
        if self.count >= 3 { self.cholesky(3) } else { None }
    }

    fn cholesky(&self, size: usize) -> Option<([f64; 6], [f64; 6])> {
        let mut l = [[0.0; 6]; 6];
        for i in 0..size {
            for j in 0..=i {
                let dot: f64 = (0..j).map(|k| l[i][k] * l[j][k]).sum();
                let rest = self.matrix[i][j] - dot;
                if i == j {
                    // Points on a line or a conic section: no unique answer.
                    if rest <= 1e-9 * self.matrix[i][i] {
                        return None;
                    }
                    l[i][i] = rest.sqrt();
                } else {
                    l[i][j] = rest / l[j][j];
                }
            }
        }
        let solve = |column: usize| {
            let mut x = [0.0; 6];
            for i in 0..size {
                let dot: f64 = (0..i).map(|k| l[i][k] * x[k]).sum();
                x[i] = (self.right[i][column] - dot) / l[i][i];
            }
            for i in (0..size).rev() {
                let dot: f64 = (i + 1..size).map(|k| l[k][i] * x[k]).sum();
                x[i] = (x[i] - dot) / l[i][i];
            }
            x
        };
        Some((solve(0), solve(1)))
    }
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
        if !(at.length() < 1.0) {
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

/// The next term of the expansion, from how fast the Hessian changes along each principal direction: for a phase
/// `k (sigma x^2 + t x^3/3)` it is `5 t^2/(24 k sigma^3)` of the first.
fn estimate_db(fit: &GaussMap, principal: &[(f64, DVec2); 2], wavenumber_per_m: f64, cosine: f64) -> f64 {
    let mut relative = 0.0;
    for &(sigma, direction) in principal {
        let step = 1e-3;
        let along = |sign: f64| {
            let [uu, uv, vv] = fit.curvature(direction * (sign * step));
            let d = direction;
            uu * d.x * d.x + 2.0 * uv * d.x * d.y + vv * d.y * d.y
        };
        let t = cosine * (along(1.0) - along(-1.0)) / (2.0 * step * fit.radius_m);
        relative += 5.0 * t * t / (24.0 * wavenumber_per_m * sigma.abs().powi(3));
        // A zone wider than everything that was seen of the surface is flat or focused.
        if fresnel_radius(wavenumber_per_m, sigma) > 0.5 / (wavenumber_per_m * 1e-9).sqrt() {
            return f64::INFINITY;
        }
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
    let bulge = |p: &Corner, q: &Corner| {
        halfway(p.point, p.normal, q.point, q.normal).0 - 0.5 * (p.point + q.point)
    };
    let curved = 4.0 * (bulge(a, b) * (w * u) + bulge(b, c) * (u * v) + bulge(c, a) * (v * w));
    let point = a.point * w + b.point * u + c.point * v + curved;
    (point, tx.leg(point).length_m + rx.leg(point).length_m)
}
