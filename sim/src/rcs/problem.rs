//! A target made ready for one method, and its solution.

use std::f64::consts::PI;

use glam::{DMat3, DVec3};
use num_complex::Complex64;

use super::{Method, RcsError, Setup, Target, dense};
use crate::field::boundary::Boundary;
use crate::field::chain::{self, Face};
use crate::field::facet::{self, Accuracy, Integral};
use crate::field::highlight::Ellipsoid;
use crate::field::link::Link;
use crate::field::mesh_highlight::{HighlightFinder, MeshHighlight};
use crate::field::terminal::Terminal;
use crate::geometry::{Surface, Topology, shape};

/// More triangles than this are not made.
const MOST_TRIANGLES: f64 = 4e6;
/// Phases that bend less than this, rad, are straight but for rounding.
const STRAIGHT_RAD: f64 = 1e-9;
/// Bounces between plane faces, at most.
const MOST_BOUNCES: usize = 3;
/// Where far is, in sizes of an exact shape.
const FAR: f64 = 1e7;
/// Most times that facets are halved for the sake of a tolerance.
const ROUNDS: usize = 7;

/// A target made ready for one method.
#[derive(Debug, Clone)]
pub struct Problem {
    setup: Setup,
    method: Method,
    link: Link,
    shape: Shape,
}

/// A surface with its topology, each patch by itself, and whether one part may hide another.
#[derive(Debug, Clone)]
struct Mesh {
    surface: Surface,
    topology: Topology,
    parts: Vec<Surface>,
    may_hide: bool,
}

#[derive(Debug, Clone)]
enum Shape {
    Faces(Vec<Face>),
    Body(Ellipsoid),
    Surface(Surface),
    Mesh(Box<Mesh>),
}

/// Solution and its cost.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Outcome {
    /// Cross-section, m^2.
    pub sigma_m2: f64,
    /// The method's own estimate of its numerical error, dB; `None` where it has none.
    pub estimate_db: Option<f64>,
    /// Facets (patches, highlights) that were evaluated.
    pub facets: usize,
    /// Rays that were traced.
    pub rays: usize,
}

fn check(what: &'static str, value: f64, unit: &'static str, low: f64, high: f64) -> Result<(), RcsError> {
    if value >= low && value <= high { Ok(()) } else { Err(RcsError::OutOfRange { what, value, unit, low, high }) }
}

fn check_length(what: &'static str, value: f64) -> Result<(), RcsError> {
    check(what, value, "m", 1e-4, 100.0)
}

impl Problem {
    /// Makes a target ready. Without an edge length meshes are as coarse as the shape allows, and facets follow the shape by
    /// their normals.
    ///
    /// # Errors
    /// [`RcsError`] if a length or an angle is out of range, the radar is inside the target, the method does not suit the target, or
    /// the mesh would be empty or too fine.
    pub fn new(target: &Target, setup: &Setup, method: Method, mesh_edge_m: Option<f64>) -> Result<Self, RcsError> {
        check("the frequency", setup.frequency_hz, "Hz", 1e8, 1e12)?;
        check("the azimuth", setup.azimuth_rad, "rad", -10.0, 10.0)?;
        check("the elevation", setup.elevation_rad, "rad", -0.5 * PI - 1e-12, 0.5 * PI + 1e-12)?;
        let reach_m = check_sizes(target)?;
        if let Some(range_m) = setup.range_m {
            check("the range", range_m, "m", 1e-3, 1e6)?;
            if range_m <= reach_m {
                return Err(RcsError::Inside { range_m, reach_m });
            }
        }
        if !method.suits(target) {
            let suitable: Vec<&str> = Method::ALL.iter().filter(|m| m.suits(target)).map(|m| m.name()).collect();
            return Err(RcsError::Unsuitable { method: method.name(), suitable: suitable.join(", ") });
        }
        let shape = match (method, target) {
            (Method::Chain, _) => Shape::Faces(faces(target, setup.boundary)),
            (Method::Highlight, &Target::Sphere { radius_m }) => Shape::Body(body(DVec3::splat(radius_m))),
            (Method::Highlight, &Target::Ellipsoid { semi_axes_m }) => Shape::Body(body(semi_axes_m)),
            (Method::MeshHighlight, _) => {
                let surface = mesh(target, mesh_edge_m)?;
                let topology = Topology::new(&surface);
                let parts = topology.patches.iter().map(|patch| surface.patch(patch)).collect();
                let may_hide = matches!(target, Target::Surface { .. });
                Shape::Mesh(Box::new(Mesh { surface, topology, parts, may_hide }))
            }
            _ => Shape::Surface(mesh(target, mesh_edge_m)?),
        };
        let link = setup.link(target.reference_point(setup.towards()));
        Ok(Problem { setup: *setup, method, link, shape })
    }

    /// Triangles of the mesh, if there is one.
    pub fn triangles(&self) -> usize {
        match &self.shape {
            Shape::Surface(surface) => surface.triangles.len(),
            Shape::Mesh(mesh) => mesh.surface.triangles.len(),
            _ => 0,
        }
    }

    /// Solves to a tolerance, on the calling thread.
    ///
    /// # Errors
    /// [`RcsError::OutOfRange`] for a tolerance that is not 0.0001 to 20 dB.
    pub fn solve(&self, tolerance_db: f64) -> Result<Outcome, RcsError> {
        check("the tolerance", tolerance_db, "dB", 1e-4, 20.0)?;
        Ok(match &self.shape {
            Shape::Body(body) => self.highlight(body),
            Shape::Faces(faces) => self.refined(tolerance_db, |accuracy| {
                let mut all = Integral::default();
                for c in chain::contributions(faces, &self.link, accuracy, faces.len().min(MOST_BOUNCES)) {
                    all.value += c.integral.value;
                    all.facets += c.integral.facets;
                    all.bend_rad = all.bend_rad.max(c.integral.bend_rad);
                }
                all
            }),
            Shape::Mesh(mesh) => self.mesh_highlights(mesh, tolerance_db),
            Shape::Surface(surface) => match self.method {
                Method::Dense => self.dense(surface, tolerance_db),
                _ => self.refined(tolerance_db, |accuracy| self.facets(surface, accuracy)),
            },
        })
    }

    fn facets(&self, surface: &Surface, accuracy: Accuracy) -> Integral {
        let k = accuracy.wavenumber_per_m;
        let boundary = self.setup.boundary;
        facet::integrate(surface, accuracy, |p, n| self.link.sample(p, n, surface.two_sided, &boundary, k))
    }

    fn outcome(&self, integral: &Integral, estimate_db: Option<f64>) -> Outcome {
        Outcome { sigma_m2: self.setup.cross_section_m2(integral.value), estimate_db, facets: integral.facets, rays: 0 }
    }

    /// Facets by the tolerance, then with a quarter of their bending until the result stays where it is; the last change is the
    /// estimate.
    fn refined(&self, tolerance_db: f64, integrate: impl Fn(Accuracy) -> Integral) -> Outcome {
        let at =
            |tolerance_rad: f64| integrate(Accuracy { wavenumber_per_m: self.setup.wavenumber_per_m(), tolerance_rad });
        let mut tolerance_rad = (2.0 * tolerance_db).min(0.4);
        let mut coarse = at(4.0 * tolerance_rad);
        let mut facets = coarse.facets;
        let mut estimate_db = 0.0;
        for _ in 0..ROUNDS {
            // Where nothing bends there is nothing to cut: flat faces seen from far are exact.
            if coarse.bend_rad < STRAIGHT_RAD {
                break;
            }
            // Finer than what the last one happened to be, or nothing would be learnt.
            tolerance_rad = tolerance_rad.min(0.25 * coarse.bend_rad);
            let fine = at(tolerance_rad);
            facets += fine.facets;
            estimate_db = (20.0 * (coarse.value.norm() / fine.value.norm()).log10()).abs();
            coarse = fine;
            // No number where everything is dark: that will not change.
            if estimate_db <= tolerance_db || estimate_db.is_nan() {
                break;
            }
        }
        let estimate = Some(estimate_db).filter(|e| e.is_finite());
        Outcome { facets, ..self.outcome(&coarse, estimate) }
    }

    /// Patches of a wavelength and less, halved until the result stays.
    fn dense(&self, surface: &Surface, tolerance_db: f64) -> Outcome {
        let k = self.setup.wavenumber_per_m();
        let boundary = self.setup.boundary;
        let at = |patch_m: f64| {
            dense::integrate(surface, k, patch_m, |p, n| self.link.sample(p, n, surface.two_sided, &boundary, k))
        };
        let mut patch_m = 0.5 * self.setup.wavelength_m();
        let mut coarse = at(patch_m);
        let mut facets = coarse.facets;
        let mut estimate_db = f64::INFINITY;
        for _ in 0..ROUNDS {
            patch_m *= 0.5;
            let fine = at(patch_m);
            facets += fine.facets;
            estimate_db = (20.0 * (coarse.value.norm() / fine.value.norm()).log10()).abs();
            coarse = fine;
            // No number where everything is dark: that will not change.
            if estimate_db <= tolerance_db || estimate_db.is_nan() {
                break;
            }
        }
        Outcome { facets, ..self.outcome(&coarse, Some(estimate_db).filter(|e| e.is_finite())) }
    }

    /// Highlights of the closed patches where they hold to the tolerance, facets elsewhere.
    fn mesh_highlights(&self, mesh: &Mesh, tolerance_db: f64) -> Outcome {
        let Mesh { surface, topology, parts, may_hide } = mesh;
        let mut rays = 0;
        let k = self.setup.wavenumber_per_m();
        let finder = HighlightFinder::new(surface, topology, k);
        let mut sum = Integral::default();
        let mut left_out = Vec::new();
        let mut estimate_db: f64 = 0.0;
        for (patch, part) in topology.patches.iter().zip(parts) {
            // What ends somewhere has an edge that a highlight does not know of.
            let found = if patch.closed { finder.find(patch, &self.link.tx, &self.link.rx) } else { Vec::new() };
            if !patch.closed || found.iter().any(|h| h.estimate_db > tolerance_db) {
                left_out.push(part);
                continue;
            }
            for highlight in found {
                if *may_hide {
                    rays += 1;
                    if hidden(surface, &highlight, &self.link.tx) {
                        continue;
                    }
                }
                let sample = self.link.sample(highlight.point, highlight.normal, false, &self.setup.boundary, k);
                sum.value += highlight.integral(sample.amplitude, k);
                sum.facets += 1;
                estimate_db = estimate_db.max(highlight.estimate_db);
            }
        }
        if left_out.is_empty() {
            return Outcome { rays, ..self.outcome(&sum, Some(estimate_db)) };
        }
        let outcome = self.refined(tolerance_db, |accuracy| {
            left_out.iter().fold(sum, |mut sum, part| {
                let integral = self.facets(part, accuracy);
                sum.value += integral.value;
                sum.facets += integral.facets;
                sum.bend_rad = sum.bend_rad.max(integral.bend_rad);
                sum
            })
        });
        Outcome { rays, ..outcome }
    }

    /// Stationary phase on the exact shape.
    fn highlight(&self, body: &Ellipsoid) -> Outcome {
        let d = self.setup.towards();
        let (setup, radar) = match self.link.tx {
            Terminal::Near(radar) => (self.setup, radar),
            Terminal::Far(_) => {
                let range_m = FAR * body.semi_axes_m.max_element();
                (Setup { range_m: Some(range_m), ..self.setup }, d * range_m)
            }
        };
        let Some(h) = body.highlight(radar, radar, None) else {
            return self.outcome(&Integral::default(), None);
        };
        let k = setup.wavenumber_per_m();
        let link = Link::monostatic(Terminal::Near(radar), self.link.tx_polarisation);
        let sample = link.sample(h.point, h.normal, false, &setup.boundary, k);
        let value = sample.amplitude * Complex64::from(PI / k / h.det_j.sqrt());
        let integral = Integral { value, facets: 1, bend_rad: 0.0 };
        Outcome { sigma_m2: setup.cross_section_m2(integral.value), ..self.outcome(&integral, None) }
    }
}

/// Whether a triangle stands between a highlight and the radar. Every triangle is tried: highlights are few.
fn hidden(surface: &Surface, highlight: &MeshHighlight, radar: &Terminal) -> bool {
    let leg = radar.leg(highlight.point);
    let reach_m = if leg.curvature_per_m > 0.0 { leg.length_m } else { f64::INFINITY };
    // The highlight lies on the curved surface, its own triangle a little beside it.
    let own = surface.corners(highlight.triangle as usize);
    let clear_m = own.map_or(0.0, |[a, b, _]| a.0.distance(b.0));
    (0..surface.triangles.len()).filter_map(|t| surface.corners(t)).any(|[a, b, c]| {
        let (u, v) = (b.0 - a.0, c.0 - a.0);
        let across = leg.towards.cross(v);
        let det = u.dot(across);
        let from = highlight.point - a.0;
        let (p, turned) = (from.dot(across) / det, from.cross(u));
        let (q, distance_m) = (leg.towards.dot(turned) / det, v.dot(turned) / det);
        p >= 0.0 && q >= 0.0 && p + q <= 1.0 && distance_m > clear_m && distance_m < reach_m
    })
}

fn body(semi_axes_m: DVec3) -> Ellipsoid {
    Ellipsoid { centre: DVec3::ZERO, axes: DMat3::IDENTITY, semi_axes_m }
}

fn faces(target: &Target, boundary: Boundary) -> Vec<Face> {
    match *target {
        Target::Dihedral { width_m, height_m } => chain::dihedral(width_m, height_m, boundary),
        Target::Trihedral { edge_m, outline } => chain::trihedral(edge_m, outline == super::Outline::Square, boundary),
        Target::Plate { width_m, height_m } => {
            let (w, h) = (0.5 * width_m, 0.5 * height_m);
            let corners: Vec<DVec3> =
                [(-w, -h), (w, -h), (w, h), (-w, h)].iter().map(|&(y, z)| DVec3::new(0.0, y, z)).collect();
            let back = corners.iter().rev().copied().collect();
            vec![Face { corners, boundary }, Face { corners: back, boundary }]
        }
        Target::Surface { ref surface } => {
            let triangles = (0..surface.triangles.len()).filter_map(|t| surface.corners(t));
            let sides = if surface.two_sided { 2 } else { 1 };
            let both =
                triangles.flat_map(|[a, b, c]| [vec![a.0, b.0, c.0], vec![c.0, b.0, a.0]].into_iter().take(sides));
            both.map(|corners| Face { corners, boundary }).collect()
        }
        _ => Vec::new(),
    }
}

/// Checks a target's sizes; how far it reaches towards a radar.
fn check_sizes(target: &Target) -> Result<f64, RcsError> {
    match *target {
        Target::Plate { width_m, height_m } => {
            check_length("the width", width_m)?;
            check_length("the height", height_m)?;
            Ok(0.0)
        }
        Target::Dihedral { width_m, height_m } => {
            check_length("the width", width_m)?;
            check_length("the height", height_m)?;
            Ok(width_m.hypot(0.5 * height_m))
        }
        Target::Trihedral { edge_m, .. } => {
            check_length("the edge", edge_m)?;
            Ok(edge_m)
        }
        Target::Sphere { radius_m } => {
            check_length("the radius", radius_m)?;
            Ok(0.0)
        }
        Target::Cylinder { radius_m, height_m } => {
            check_length("the radius", radius_m)?;
            check_length("the height", height_m)?;
            Ok(0.0)
        }
        Target::Ellipsoid { semi_axes_m } => {
            for axis in semi_axes_m.to_array() {
                check_length("a semi-axis", axis)?;
            }
            Ok(0.0)
        }
        Target::Mirror { radius_m, aperture_m } => {
            check_length("the radius", radius_m)?;
            check_length("the aperture", aperture_m)?;
            check("the aperture", aperture_m, "m", 1e-4, 2.0 * radius_m)?;
            Ok(radius_m - (radius_m * radius_m - 0.25 * aperture_m * aperture_m).max(0.0).sqrt())
        }
        Target::Surface { ref surface } => {
            let largest = (0..surface.triangles.len())
                .filter_map(|t| surface.corners(t))
                .map(|[a, b, c]| (b.0 - a.0).cross(c.0 - a.0).length())
                .fold(0.0, f64::max);
            if !(largest > 0.0 && largest.is_finite()) {
                return Err(RcsError::Empty);
            }
            let middle = target.reference_point(DVec3::X);
            Ok(surface.vertices.iter().map(|v| v.distance(middle)).fold(0.0, f64::max))
        }
    }
}

/// The target as a mesh.
fn mesh(target: &Target, edge_m: Option<f64>) -> Result<Surface, RcsError> {
    if let Some(edge_m) = edge_m {
        check("the edge of the mesh", edge_m, "m", 1e-5, 10.0)?;
    }
    let fine_enough = |area_m2: f64, default_m: f64| {
        let edge_m = edge_m.unwrap_or(default_m);
        let triangles = area_m2 / (0.433 * edge_m * edge_m);
        if triangles > MOST_TRIANGLES {
            return Err(RcsError::TooFine { edge_m, triangles, most: MOST_TRIANGLES });
        }
        Ok(edge_m)
    };
    Ok(match *target {
        Target::Plate { width_m, height_m } => {
            shape::plate(width_m, height_m, fine_enough(width_m * height_m, width_m.max(height_m))?)
        }
        Target::Sphere { radius_m } => {
            shape::ellipsoid(DVec3::splat(radius_m), fine_enough(4.0 * PI * radius_m * radius_m, 0.1 * radius_m)?)
        }
        Target::Ellipsoid { semi_axes_m } => {
            let [low, high] = [semi_axes_m.min_element(), semi_axes_m.max_element()];
            shape::ellipsoid(semi_axes_m, fine_enough(4.0 * PI * high * high, 0.1 * low)?)
        }
        Target::Cylinder { radius_m, height_m } => {
            shape::cylinder(radius_m, height_m, fine_enough(2.0 * PI * radius_m * height_m, 0.1 * radius_m)?)
        }
        Target::Mirror { radius_m, aperture_m } => {
            let edge_m = fine_enough(PI * aperture_m * aperture_m, (0.1 * radius_m).min(aperture_m / 80.0))?;
            shape::mirror(radius_m, 0.5 * aperture_m, edge_m)
        }
        Target::Surface { ref surface } => surface.clone(),
        // Corners are faces, never meshes.
        Target::Dihedral { .. } | Target::Trihedral { .. } => Surface::default(),
    })
}
