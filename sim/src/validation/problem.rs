//! Target prepared for one method, and its solution.

use std::f64::consts::PI;

use glam::{DMat3, DVec3};
use num_complex::Complex64;

use super::endpoint::Endpoint;
use super::facet::{self, Accuracy, Integral};
use super::images::{self, Images};
use super::radar::{Radar, transverse};
use super::{Method, Outline, RcsError, Setup, Target, dense};
use crate::echo::error_budget::IntegrationSettings;
use crate::echo::still::{StillSkin, StillView};
use crate::em::Phasor3;
use crate::em::curved_triangle::Integrator;
use crate::em::image::Wall;
use crate::em::specular::Ellipsoid;
use crate::geometry::{Surface, polygon, shape};
use crate::paths::discovery::MAX_ORDER;

/// Largest number of triangles. The limit for a skin is lower, because a skin is prepared patch by patch.
const MOST_TRIANGLES: f64 = 4e6;
const MOST_OF_SKIN: f64 = 1e6;
/// Phase deviation below which phases are linear within rounding, rad.
const STRAIGHT_RAD: f64 = 1e-9;
/// Largest number of bounces between plane faces.
const MOST_BOUNCES: usize = 3;
/// Distance that represents infinity, in sizes of a round body.
const FAR: f64 = 1e7;
/// Sines of the angles from the specular point up to which a skin counts fully and beyond which it would not count.
///
/// A single body must be more accurate than people ([`IntegrationSettings::for_tolerance`]), so that its window is
/// wider. Where the radius of curvature is a few wavelengths, the first Fresnel zone ends at such angles. Without
/// contributions from 0.97 on, the end of a limb is 0.26 dB too weak.
const WINDOW: [f64; 2] = [0.5, 1.2];
/// Factor on the ease of its quadrature rules, which makes them more exact.
const EASE: f32 = 0.5;
/// Permittivity that represents a conductor in functions that take only permittivities.
const CONDUCTOR: Complex64 = Complex64::new(1.0, -1e12);
/// Largest number of times that facets are halved to meet a tolerance.
const ROUNDS: usize = 7;
/// Number of facets from which on an integral that has an error estimate is not repeated with finer ones. They take
/// about a second.
const MANY_FACETS: usize = 10_000_000;

/// Target prepared for one method.
#[derive(Debug, Clone)]
pub struct Problem {
    setup: Setup,
    method: Method,
    radar: Radar,
    shape: Shape,
}

/// Closed smooth surface, and the same with every triangle cut into four.
#[derive(Debug, Clone)]
struct Skin {
    surface: Surface,
    levels: [StillSkin; 2],
    permittivity: Complex64,
}

/// Shape of a target, as its method needs it.
#[derive(Debug, Clone)]
enum Shape {
    Faces(Box<Images>),
    Body(Ellipsoid),
    Surface(Surface),
    Skin(Box<Skin>),
}

/// Solution and its cost.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Outcome {
    /// Cross-section, m^2.
    pub sigma_m2: f64,
    /// The method's own estimate of its numerical error, dB; `None` where it has none.
    pub estimate_db: Option<f64>,
    /// Number of facets (patches, triangles, specular points) that were evaluated.
    pub facets: usize,
}

/// Checks that a quantity is within limits.
fn check(what: &'static str, value: f64, unit: &'static str, low: f64, high: f64) -> Result<(), RcsError> {
    if value >= low && value <= high { Ok(()) } else { Err(RcsError::OutOfRange { what, value, unit, low, high }) }
}

impl Problem {
    /// Prepares a target. Without an edge length, meshes are as coarse as the shape allows, and facets follow the shape
    /// by their normals.
    ///
    /// # Errors
    /// [`RcsError`] if a length or an angle is out of range, the radar is inside the target or beside its aperture, the
    /// method does not suit the target, waves bounce too often in it, or the mesh would be empty or too fine.
    pub fn new(target: &Target, setup: &Setup, method: Method, mesh_edge_m: Option<f64>) -> Result<Self, RcsError> {
        check("the frequency", setup.frequency_hz, "Hz", 1e8, 1e12)?;
        // Rounded, so that angles of radians are within the bounds where those of degrees are.
        let degrees = |angle_rad: f64| (angle_rad.to_degrees() * 1e6).round() / 1e6;
        check("the azimuth", degrees(setup.azimuth_rad), "degrees", -720.0, 720.0)?;
        check("the elevation", degrees(setup.elevation_rad), "degrees", -90.0, 90.0)?;
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
        let radar = setup.radar(target.reference_point(setup.towards()));
        let shape = match (method, target) {
            (Method::Images, _) => {
                let faces = faces(target);
                let (bounces, aperture) = match *target {
                    Target::Cavity { width_m, height_m, depth_m } => {
                        let bounces = cavity_bounces(setup, [width_m, height_m], depth_m)?;
                        (bounces, Some(images::aperture(width_m, height_m)))
                    }
                    _ => (faces.len().min(MOST_BOUNCES), None),
                };
                let k = setup.wavenumber_per_m();
                Shape::Faces(Box::new(Images::new(faces, aperture, setup.boundary, radar, k, bounces)?))
            }
            (Method::Specular, &Target::Sphere { radius_m }) => Shape::Body(body(DVec3::splat(radius_m))),
            (Method::Specular, &Target::Ellipsoid { semi_axes_m }) => Shape::Body(body(semi_axes_m)),
            (Method::Skin, _) => Shape::Skin(Box::new(Skin::new(mesh(target, mesh_edge_m)?, setup.boundary)?)),
            _ => Shape::Surface(mesh(target, mesh_edge_m)?),
        };
        Ok(Problem { setup: *setup, method, radar, shape })
    }

    /// Number of triangles of the mesh, if there is one.
    pub fn triangles(&self) -> usize {
        match &self.shape {
            Shape::Surface(surface) => surface.triangles.len(),
            Shape::Skin(skin) => skin.surface.triangles.len(),
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
            Shape::Body(body) => self.specular_point(body),
            Shape::Faces(images) => self.refined(tolerance_db, |accuracy| {
                let mut all = Integral::default();
                for integral in images.sequences().iter().map(|sequence| images.integrate(sequence, accuracy)) {
                    all.value += integral.value;
                    all.facets += integral.facets;
                    all.deviation_rad = all.deviation_rad.max(integral.deviation_rad);
                }
                all
            }),
            Shape::Skin(skin) => self.skin(skin, tolerance_db),
            Shape::Surface(surface) => match self.method {
                Method::Dense => self.dense(surface, tolerance_db),
                _ => self.refined(tolerance_db, |accuracy| self.facets(surface, accuracy)),
            },
        })
    }

    /// Integrates over the facets of a surface.
    fn facets(&self, surface: &Surface, accuracy: Accuracy) -> Integral {
        let k = accuracy.wavenumber_per_m;
        let boundary = self.setup.boundary;
        facet::integrate(surface, accuracy, |p, n| self.radar.sample(p, n, surface.two_sided, &boundary, k))
    }

    /// Computes finer integrals until the result changes by no more than the tolerance, or until there is no finer one.
    /// The last change is the error estimate.
    fn converged(
        &self,
        tolerance_db: f64,
        mut coarse: Integral,
        mut finer: impl FnMut(&Integral) -> Option<Integral>,
    ) -> Outcome {
        let mut facets = coarse.facets;
        let mut estimate_db = 0.0;
        for _ in 0..ROUNDS {
            let Some(fine) = finer(&coarse) else { break };
            facets += fine.facets;
            estimate_db = (20.0 * (coarse.value.norm() / fine.value.norm()).log10()).abs();
            coarse = fine;
            // The estimate is NaN if the whole surface is in shadow; finer facets do not change that.
            if estimate_db <= tolerance_db || estimate_db.is_nan() {
                break;
            }
        }
        let estimate_db = Some(estimate_db).filter(|e| e.is_finite());
        Outcome { sigma_m2: self.setup.cross_section_m2(coarse.value), estimate_db, facets }
    }

    /// Integrates over facets with a phase tolerance, then repeatedly with a quarter of their phase deviation.
    fn refined(&self, tolerance_db: f64, integrate: impl Fn(Accuracy) -> Integral) -> Outcome {
        let at =
            |tolerance_rad: f64| integrate(Accuracy { wavenumber_per_m: self.setup.wavenumber_per_m(), tolerance_rad });
        let mut tolerance_rad = (2.0 * tolerance_db).min(0.4);
        let mut is_first = true;
        self.converged(tolerance_db, at(4.0 * tolerance_rad), |coarse| {
            // Without phase deviation there is nothing to cut: flat faces seen from far are exact.
            if coarse.deviation_rad < STRAIGHT_RAD || !is_first && coarse.facets > MANY_FACETS {
                return None;
            }
            is_first = false;
            // The new tolerance is finer than the previous deviation; otherwise nothing would change.
            tolerance_rad = tolerance_rad.min(0.25 * coarse.deviation_rad);
            Some(at(tolerance_rad))
        })
    }

    /// Sums patches of a wavelength and less, halved until the result converges.
    fn dense(&self, surface: &Surface, tolerance_db: f64) -> Outcome {
        let k = self.setup.wavenumber_per_m();
        let boundary = self.setup.boundary;
        let at = |patch_m: f64| {
            dense::integrate(surface, k, patch_m, |p, n| self.radar.sample(p, n, surface.two_sided, &boundary, k))
        };
        let mut patch_m = 0.5 * self.setup.wavelength_m();
        // A finer request would give the same patches, and their sum no information about the error.
        let finest_m = dense::finest_patch_m(surface);
        let outcome = self.converged(tolerance_db, at(patch_m), |_| {
            patch_m *= 0.5;
            (patch_m >= finest_m).then(|| at(patch_m))
        });
        let is_estimated = 0.25 * self.setup.wavelength_m() >= finest_m;
        Outcome { estimate_db: outcome.estimate_db.filter(|_| is_estimated), ..outcome }
    }

    /// Integrates the patches of a skin, whose triangles are cut into four until the result converges.
    fn skin(&self, skin: &Skin, tolerance_db: f64) -> Outcome {
        let (low, high) = skin.surface.bounds();
        let (setup, antenna) = self.near((high - low).length());
        let polarisation = self.radar.polarisation;
        let field = |at: DVec3| Phasor3::real(transverse(polarisation, (at - antenna).normalize_or_zero()));
        let ease = EASE * IntegrationSettings::for_tolerance(tolerance_db).ease;
        let view = StillView {
            antenna,
            field: &field,
            wavelength_m: setup.wavelength_m(),
            permittivity: skin.permittivity,
            settings: IntegrationSettings { window: WINDOW, ease },
        };
        let integrator = Integrator::default();
        let [coarse, fine] = skin.levels.each_ref();
        let mut facets = coarse.triangles() + fine.triangles();
        let (mut previous, mut value) = (coarse.integral(&integrator, &view), fine.integral(&integrator, &view));
        let change_db = |a: Complex64, b: Complex64| (20.0 * (a.norm() / b.norm()).log10()).abs();
        let mut surface: Option<Surface> = None;
        while change_db(previous, value) > tolerance_db {
            let finer = surface.as_ref().map_or_else(|| skin.surface.halved().halved(), Surface::halved);
            if finer.triangles.len() as f64 > MOST_OF_SKIN {
                break;
            }
            let still = StillSkin::new(&finer);
            facets += still.triangles();
            (previous, value) = (value, still.integral(&integrator, &view));
            surface = Some(finer);
        }
        let estimate_db = Some(change_db(previous, value)).filter(|change| change.is_finite());
        Outcome { sigma_m2: setup.cross_section_m2(value), estimate_db, facets }
    }

    /// Near-field setup and antenna position; an infinitely far radar is placed at a large multiple of the body's size.
    fn near(&self, size_m: f64) -> (Setup, DVec3) {
        match self.radar.end {
            Endpoint::Near(radar) => (self.setup, radar),
            Endpoint::Far(towards) => {
                let range_m = FAR * size_m;
                (Setup { range_m: Some(range_m), ..self.setup }, towards * range_m)
            }
        }
    }

    /// Stationary phase on the exact shape.
    fn specular_point(&self, body: &Ellipsoid) -> Outcome {
        let (setup, antenna) = self.near(body.semi_axes_m.max_element());
        let Some(specular) = body.specular_point(antenna, antenna, None) else {
            return Outcome { sigma_m2: 0.0, estimate_db: None, facets: 0 };
        };
        let k = setup.wavenumber_per_m();
        let radar = Radar { end: Endpoint::Near(antenna), ..self.radar };
        let sample = radar.sample(specular.point, specular.normal, false, &setup.boundary, k);
        let value = sample.amplitude * Complex64::from(PI / k / specular.det_j.sqrt());
        Outcome { sigma_m2: setup.cross_section_m2(value), estimate_db: None, facets: 1 }
    }
}

impl Skin {
    fn new(surface: Surface, boundary: Wall) -> Result<Self, RcsError> {
        let permittivity = match boundary {
            Wall::Conductor => CONDUCTOR,
            Wall::HalfSpace { permittivity } => permittivity,
            Wall::Slab { .. } | Wall::Open => return Err(RcsError::NotSolid),
        };
        let triangles = 4.0 * surface.triangles.len() as f64;
        if triangles > MOST_OF_SKIN {
            return Err(RcsError::TooFine { edge_m: 0.5 * surface.mean_edge_m(), triangles, most: MOST_OF_SKIN });
        }
        let levels = [StillSkin::new(&surface), StillSkin::new(&surface.halved())];
        Ok(Skin { surface, levels, permittivity })
    }
}

/// Ellipsoid about the origin.
fn body(semi_axes_m: DVec3) -> Ellipsoid {
    Ellipsoid { centre: DVec3::ZERO, axes: DMat3::IDENTITY, semi_axes_m }
}

/// Outlines of a target's plane faces, counter-clockwise seen from the reflecting side.
fn faces(target: &Target) -> Vec<Vec<DVec3>> {
    match *target {
        Target::Dihedral { width_m, height_m } => images::dihedral(width_m, height_m),
        Target::Trihedral { edge_m, outline } => images::trihedral(edge_m, outline == Outline::Square),
        Target::Cavity { width_m, height_m, depth_m } => images::cavity(width_m, height_m, depth_m),
        Target::Plate { width_m, height_m } => {
            let corners = images::aperture(width_m, height_m);
            let back = corners.iter().rev().copied().collect();
            vec![corners, back]
        }
        Target::Surface { ref surface } => {
            let triangles = (0..surface.triangles.len()).filter_map(|t| surface.corners(t));
            let sides = if surface.two_sided { 2 } else { 1 };
            let both =
                triangles.flat_map(|[a, b, c]| [vec![a.0, b.0, c.0], vec![c.0, b.0, a.0]].into_iter().take(sides));
            both.filter(|corners| polygon::normal(corners) != DVec3::ZERO).collect()
        }
        _ => Vec::new(),
    }
}

/// Largest number of bounces of a wave in a cavity, from the aperture and back.
///
/// # Errors
/// If they are more than sequences have facets, or the radar does not look into the aperture.
fn cavity_bounces(setup: &Setup, across_m: [f64; 2], depth_m: f64) -> Result<usize, RcsError> {
    let towards = setup.towards();
    let (half_width_m, half_height_m) = (0.5 * across_m[0], 0.5 * across_m[1]);
    // Rays of a near radar are steepest at the far rim.
    let [y_m, z_m, x_m] = match setup.range_m {
        None => [towards.y.abs(), towards.z.abs(), towards.x],
        Some(r) => [r * towards.y.abs() + half_width_m, r * towards.z.abs() + half_height_m, r * towards.x],
    };
    if x_m < 1e-6 {
        return Err(RcsError::BesideAperture);
    }
    let across = |slope_m: f64, size_m: f64| (2.0 * depth_m * slope_m / (x_m * size_m)).ceil();
    let bounces = 1.0 + across(y_m, across_m[0]) + across(z_m, across_m[1]);
    if bounces > MAX_ORDER as f64 {
        return Err(RcsError::TooManyBounces { bounces, most: MAX_ORDER });
    }
    Ok(bounces as usize)
}

/// Checks a target's sizes and returns its extent towards a radar.
fn check_sizes(target: &Target) -> Result<f64, RcsError> {
    let (lengths_m, reach_m) = match *target {
        Target::Plate { width_m, height_m } => (vec![("the width", width_m), ("the height", height_m)], 0.0),
        Target::Dihedral { width_m, height_m } => {
            (vec![("the width", width_m), ("the height", height_m)], width_m.hypot(0.5 * height_m))
        }
        Target::Trihedral { edge_m, .. } => (vec![("the edge", edge_m)], edge_m),
        Target::Cavity { width_m, height_m, depth_m } => {
            (vec![("the width", width_m), ("the height", height_m), ("the depth", depth_m)], 0.0)
        }
        Target::Sphere { radius_m } => (vec![("the radius", radius_m)], 0.0),
        Target::Cylinder { radius_m, height_m } => (vec![("the radius", radius_m), ("the height", height_m)], 0.0),
        Target::Ellipsoid { semi_axes_m } => (semi_axes_m.to_array().map(|axis| ("a semi-axis", axis)).to_vec(), 0.0),
        Target::Mirror { radius_m, aperture_m } => {
            let depth_m = radius_m - (radius_m * radius_m - 0.25 * aperture_m * aperture_m).max(0.0).sqrt();
            (vec![("the radius", radius_m), ("the aperture", aperture_m)], depth_m)
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
            (Vec::new(), surface.vertices.iter().map(|v| v.distance(middle)).fold(0.0, f64::max))
        }
    };
    for (what, length_m) in lengths_m {
        check(what, length_m, "m", 1e-4, 100.0)?;
    }
    if let Target::Mirror { radius_m, aperture_m } = *target {
        check("the aperture", aperture_m, "m", 1e-4, 2.0 * radius_m)?;
    }
    Ok(reach_m)
}

/// Mesh of a target with edges of this length, or as coarse as its shape allows.
fn mesh(target: &Target, edge_m: Option<f64>) -> Result<Surface, RcsError> {
    if let Some(edge_m) = edge_m {
        check("the edge of the mesh", edge_m, "m", 1e-5, 10.0)?;
    }
    // Edge length for a surface of an area, if it does not make too many triangles.
    let edge_for = |area_m2: f64, default_m: f64| {
        let edge_m = edge_m.unwrap_or(default_m);
        let triangles = area_m2 / (0.433 * edge_m * edge_m);
        if triangles > MOST_TRIANGLES {
            return Err(RcsError::TooFine { edge_m, triangles, most: MOST_TRIANGLES });
        }
        Ok(edge_m)
    };
    Ok(match *target {
        Target::Plate { width_m, height_m } => {
            shape::plate(width_m, height_m, edge_for(width_m * height_m, width_m.max(height_m))?)
        }
        Target::Sphere { radius_m } => {
            shape::ellipsoid(DVec3::splat(radius_m), edge_for(4.0 * PI * radius_m * radius_m, 0.1 * radius_m)?)
        }
        Target::Ellipsoid { semi_axes_m } => {
            let [low, high] = [semi_axes_m.min_element(), semi_axes_m.max_element()];
            shape::ellipsoid(semi_axes_m, edge_for(4.0 * PI * high * high, 0.1 * low)?)
        }
        Target::Cylinder { radius_m, height_m } => {
            shape::cylinder(radius_m, height_m, edge_for(2.0 * PI * radius_m * height_m, 0.1 * radius_m)?)
        }
        Target::Mirror { radius_m, aperture_m } => {
            // The area of a cap.
            let half_m = 0.5 * aperture_m;
            let area_m2 = 2.0 * PI * radius_m * (radius_m - (radius_m * radius_m - half_m * half_m).max(0.0).sqrt());
            let edge_m = edge_for(area_m2, (0.1 * radius_m).min(aperture_m / 80.0))?;
            shape::mirror(radius_m, half_m, edge_m)
        }
        Target::Surface { ref surface } => surface.clone(),
        // Corners and cavities are represented by faces, never by meshes.
        Target::Dihedral { .. } | Target::Trihedral { .. } | Target::Cavity { .. } => Surface::default(),
    })
}
