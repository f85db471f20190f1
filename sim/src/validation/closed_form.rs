//! Cross-sections of canonical targets without the solver: closed forms, exact series, and quadrature over the exact
//! shape where neither exists.

use std::f64::consts::PI;

use glam::{DMat3, DVec3};
use num_complex::Complex64;

use super::edge::fresnel_integral;
use super::{Outline, Setup, Target, cavity, mie};
use crate::em::image::Wall;
use crate::em::specular::Ellipsoid;
use crate::em::triangle::sinc;
use crate::geometry::polygon;

/// Reference value and its source.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ReferenceValue {
    /// Cross-section, m^2.
    pub sigma_m2: f64,
    /// Name of the formula.
    pub source: &'static str,
}

/// Reference value of a target's cross-section, if there is one.
pub fn reference_value(target: &Target, setup: &Setup) -> Option<ReferenceValue> {
    let d = setup.towards();
    let far = setup.range_m.is_none();
    let (sigma_m2, source) = match *target {
        Target::Plate { width_m, height_m } => {
            let material = setup.plane_reflection(d.x.abs())?;
            match setup.range_m {
                None => (plate_far(setup, width_m, height_m) * material, "physical optics, far field"),
                // In the near field, a plate has no single angle of incidence.
                Some(range_m) => {
                    conductor(setup)?;
                    (panels(setup.wavenumber_per_m(), width_m.max(height_m)) <= MOST_PANELS).then_some(())?;
                    (plate_near(setup, width_m, height_m, range_m), "physical optics, quadrature")
                }
            }
        }
        Target::Dihedral { width_m, height_m } => {
            // Only the double reflection counts, in the plane perpendicular to the edge.
            (far && d.z.abs() < 1e-9 && d.x > 0.0 && d.y > 0.0).then_some(())?;
            let area = 2.0 * width_m * height_m * d.x.min(d.y);
            let material = setup.plane_reflection(d.x)? * setup.plane_reflection(d.y)?;
            (setup.aperture_m2(area) * material, "double reflection, far field")
        }
        Target::Trihedral { edge_m, outline } => {
            conductor(setup)?;
            (far && d.min_element() > 0.0).then_some(())?;
            (setup.aperture_m2(trihedral_aperture_m2(edge_m, outline, d)), "effective aperture, far field")
        }
        Target::Cavity { width_m, height_m, depth_m } => {
            conductor(setup)?;
            (far && d.x > 0.0).then_some(())?;
            (cavity::cross_section_m2(setup, width_m, height_m, depth_m)?, "waveguide modes, far field")
        }
        Target::Sphere { radius_m } => match setup.range_m {
            None => match setup.boundary {
                Wall::Conductor => (mie::cross_section_m2(radius_m, setup.wavelength_m(), None), "Mie"),
                Wall::HalfSpace { permittivity } => {
                    (mie::cross_section_m2(radius_m, setup.wavelength_m(), Some(permittivity)), "Mie")
                }
                Wall::Slab { .. } | Wall::Open => return None,
            },
            Some(range_m) => {
                let curvature = 1.0 / radius_m + 1.0 / range_m;
                (PI / (curvature * curvature) * setup.normal_reflection(), "geometrical optics")
            }
        },
        Target::Cylinder { radius_m, height_m } => (
            cylinder(setup, radius_m, height_m)? * setup.normal_reflection(),
            "stationary phase around, Fresnel integral along",
        ),
        Target::Ellipsoid { semi_axes_m } => {
            (ellipsoid(setup, semi_axes_m)? * setup.normal_reflection(), "geometrical optics")
        }
        Target::Mirror { radius_m, aperture_m } => {
            conductor(setup)?;
            (d.x > 1.0 - 1e-12).then_some(())?;
            (mirror(setup, radius_m, aperture_m), "physical optics, quadrature")
        }
        Target::Surface { .. } => return None,
    };
    Some(ReferenceValue { sigma_m2, source })
}

/// `None` unless the target is a conductor.
fn conductor(setup: &Setup) -> Option<()> {
    (setup.boundary == Wall::Conductor).then_some(())
}

/// Far-field cross-section of a plate: `4 pi A^2/lambda^2 cos^2 sinc^2 sinc^2`.
fn plate_far(setup: &Setup, width_m: f64, height_m: f64) -> f64 {
    let (k, d) = (setup.wavenumber_per_m(), setup.towards());
    setup.aperture_m2(width_m * height_m * d.x * sinc(k * width_m * d.y) * sinc(k * height_m * d.z))
}

/// Largest number of panels along a side of a plate. For larger plates, the quadrature takes minutes.
const MOST_PANELS: f64 = 2000.0;

/// Number of panels of about a radian along a side of a plate.
fn panels(wavenumber_per_m: f64, length_m: f64) -> f64 {
    (2.0 * wavenumber_per_m * length_m / 4.0).ceil()
}

/// Near-field cross-section of a plate: Gauss-Legendre quadrature in both directions, with panels of about a radian.
fn plate_near(setup: &Setup, width_m: f64, height_m: f64, range_m: f64) -> f64 {
    let (k, radar) = (setup.wavenumber_per_m(), setup.towards() * range_m);
    let panels = |length_m: f64| panels(k, length_m).max(4.0) as usize;
    let across: Vec<_> = gauss_legendre(panels(width_m)).collect();
    let along: Vec<_> = gauss_legendre(panels(height_m)).collect();
    let mut integral = Complex64::ZERO;
    for &(u, wu) in &across {
        for &(v, wv) in &along {
            let offset = radar - DVec3::new(0.0, width_m * (u - 0.5), height_m * (v - 0.5));
            let range = offset.length();
            // Phase relative to that of the middle.
            let amplitude = wu * wv * offset.x.abs() / range.powi(3);
            integral += Complex64::from_polar(amplitude, -2.0 * k * (range - range_m));
        }
    }
    setup.cross_section_m2(integral * (width_m * height_m))
}

/// Aperture of a trihedral seen from a direction inside its octant: the intersection of the outline, projected along
/// the direction, with its own point reflection in the corner (Siegel and others' theorem; each ray that enters at r
/// leaves at -r).
pub fn trihedral_aperture_m2(edge_m: f64, outline: Outline, towards: DVec3) -> f64 {
    let corners: Vec<DVec3> = match outline {
        Outline::Triangular => vec![DVec3::X, DVec3::Y, DVec3::Z],
        Outline::Square => vec![
            DVec3::X,
            DVec3::new(1.0, 1.0, 0.0),
            DVec3::Y,
            DVec3::new(0.0, 1.0, 1.0),
            DVec3::Z,
            DVec3::new(1.0, 0.0, 1.0),
        ],
    };
    let projected: Vec<DVec3> = corners.iter().map(|&c| c * edge_m).map(|c| c - towards * towards.dot(c)).collect();
    let mut intersection: Vec<DVec3> = projected.iter().map(|&c| -c).collect();
    for [a, b] in polygon::sides(&projected) {
        // Corners run counter-clockwise seen from the octant.
        intersection = polygon::clipped(&intersection, a, towards.cross(b - a));
    }
    polygon::area_m2(&intersection)
}

/// Cross-section of a cylinder near the plane across the axis; `None` elsewhere in the near field.
fn cylinder(setup: &Setup, radius_m: f64, height_m: f64) -> Option<f64> {
    let (k, d) = (setup.wavenumber_per_m(), setup.towards());
    match setup.range_m {
        None => {
            let cosine = d.x.hypot(d.y);
            let along = height_m * sinc(k * height_m * d.z);
            Some(k * radius_m * cosine * along * along)
        }
        Some(range_m) => {
            (d.z.abs() < 1e-9).then_some(())?;
            // int e^{-jk z^2/R} dz over the height, by u^2 pi/2 = k z^2/R.
            let scale = (2.0 * k / (PI * range_m)).sqrt();
            let along = 2.0 * fresnel_integral(0.5 * height_m * scale).norm() / scale;
            let around = (PI / k / (1.0 / range_m + 1.0 / radius_m)).sqrt();
            Some(setup.cross_section_m2(Complex64::from(around * along / (range_m * range_m))))
        }
    }
}

/// Cross-section of an ellipsoid: `pi/det J` at the point whose normal is the line of sight.
fn ellipsoid(setup: &Setup, semi_axes_m: DVec3) -> Option<f64> {
    let d = setup.towards();
    match setup.range_m {
        None => {
            let product = semi_axes_m.element_product();
            Some(PI * (product / (semi_axes_m * d).length_squared()).powi(2))
        }
        Some(range_m) => {
            let body = Ellipsoid { centre: DVec3::ZERO, axes: DMat3::IDENTITY, semi_axes_m };
            let reference = Target::Ellipsoid { semi_axes_m }.reference_point(d);
            let radar = reference + d * range_m;
            let specular = body.specular_point(radar, radar, None)?;
            // Gaussian and mean curvature of an ellipsoid (Goldman, "Curvature formulas for implicit curves and
            // surfaces", Computer Aided Geometric Design 22(7), 2005).
            let p = specular.point;
            let gradient = (p / (semi_axes_m * semi_axes_m)).length();
            let product = semi_axes_m.element_product();
            let gaussian = 1.0 / (product * gradient * gradient).powi(2);
            let mean =
                (semi_axes_m.length_squared() - p.length_squared()) / (2.0 * product * product * gradient.powi(3));
            let range = specular.distances_m.0;
            let det_j = gaussian + 2.0 * mean / range + 1.0 / (range * range);
            Some(PI / det_j * (range_m / range).powi(4))
        }
    }
}

/// Cross-section of a mirror: one-dimensional quadrature over the rings of a spherical cap, seen from its axis.
fn mirror(setup: &Setup, radius_m: f64, aperture_m: f64) -> f64 {
    let k = setup.wavenumber_per_m();
    let reach = (0.5 * aperture_m / radius_m).clamp(0.0, 1.0).asin();
    let panels = (2.0 * k * aperture_m * reach).ceil().clamp(8.0, 1e5) as usize;
    let mut integral = Complex64::ZERO;
    for (t, weight) in gauss_legendre(panels) {
        let (sine, cosine) = (t * reach).sin_cos();
        let (depth, across) = (radius_m * (1.0 - cosine), radius_m * sine);
        let (length, incidence, spreading) = match setup.range_m {
            None => (-depth, cosine, 1.0),
            Some(range_m) => {
                let length = (range_m - depth).hypot(across);
                let incidence = (cosine * (range_m - depth) + sine * across) / length;
                (length - range_m, incidence, 1.0 / length)
            }
        };
        // The normal leans towards the axis: its cosine to the line of sight is cos t (R - x) + (-sin t)(-r).
        let ring = 2.0 * PI * radius_m * radius_m * sine * reach * weight;
        integral += Complex64::from_polar(ring * incidence * spreading * spreading, -2.0 * k * length);
    }
    setup.cross_section_m2(integral)
}

/// Nodes and weights of the 10-point rule on equal panels of 0..1.
fn gauss_legendre(panels: usize) -> impl Iterator<Item = (f64, f64)> {
    const NODES: [f64; 5] = [
        0.148_874_338_981_631_22,
        0.433_395_394_129_247_2,
        0.679_409_568_299_024_4,
        0.865_063_366_688_984_5,
        0.973_906_528_517_171_7,
    ];
    const WEIGHTS: [f64; 5] = [
        0.295_524_224_714_752_87,
        0.269_266_719_309_996_35,
        0.219_086_362_515_982_04,
        0.149_451_349_150_580_6,
        0.066_671_344_308_688_14,
    ];
    let width = 1.0 / panels.max(1) as f64;
    (0..panels.max(1)).flat_map(move |panel| {
        let centre = (panel as f64 + 0.5) * width;
        (0..10).map(move |i| {
            let (node, weight) = (NODES[i % 5], WEIGHTS[i % 5]);
            let sign = if i < 5 { 1.0 } else { -1.0 };
            (centre + 0.5 * width * sign * node, 0.5 * width * weight)
        })
    })
}
