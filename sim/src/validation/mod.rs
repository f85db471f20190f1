//! Radar cross-sections of canonical targets by the integrators of scenes, compared with independently known values.
//!
//! Round bodies use the specular points of people's ellipsoids ([`crate::em::specular`]). Closed smooth meshes use the
//! patches of skins ([`crate::echo::still`]). Plane faces use the facets, sequences and reflections of rooms
//! ([`images`]). Two parts exist only here, because scenes lack them: radars infinitely far ([`endpoint`]), and
//! physical optics on flat or open surfaces ([`facet`], the last surface of a sequence).
//!
//! A [`Target`] in a [`Setup`] becomes a [`Problem`] for one [`Method`] (meshes are made, normals found), which is then
//! solved to a tolerance. Far from the target the cross-section is the textbook's. Near it, the cross-section is the
//! one that a radar at that range would report: `4 pi (k/2 pi)^2 |I|^2 R^4`. The range is measured to the target's
//! reference point: the middle of a plate or of an aperture, the corner of a dihedral or trihedral, the pole of a
//! mirror, and the surface under the radar of a round body. The radar transmits and receives with one antenna of unit
//! field in every direction.

pub mod cavity;
pub mod closed_form;
pub mod dense;
pub mod edge;
pub mod endpoint;
pub mod facet;
pub mod images;
pub mod mie;
mod problem;
pub mod radar;

use std::f64::consts::{FRAC_PI_4, TAU};

use glam::DVec3;
use num_complex::Complex64;
use radome_dsp::SPEED_OF_LIGHT_M_PER_S;
use thiserror::Error;

use crate::em::image::Wall;
use crate::geometry::Surface;
use crate::paths::EnvironmentError;
pub use closed_form::{ReferenceValue, reference_value};
use endpoint::Endpoint;
pub use problem::{Outcome, Problem};
use radar::Radar;

/// Outline of a trihedral's faces.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Outline {
    /// Right triangles.
    Triangular,
    /// Squares.
    Square,
}

/// Target, in its own axes as described for each kind.
#[derive(Debug, Clone, PartialEq)]
pub enum Target {
    /// Flat rectangle that faces +x, width along y, height along z; reflects on either side.
    Plate {
        /// Width along y, m.
        width_m: f64,
        /// Height along z, m.
        height_m: f64,
    },
    /// Two square faces that meet on the z axis and open towards +x and +y.
    Dihedral {
        /// Width across the edge, m.
        width_m: f64,
        /// Height along the edge, m.
        height_m: f64,
    },
    /// Three faces that meet at the origin, edges on the positive axes.
    Trihedral {
        /// Length of the edges that meet, m.
        edge_m: f64,
        /// Triangles or squares.
        outline: Outline,
    },
    /// Rectangular cavity, its aperture in the plane x = 0 about the origin, open towards +x, closed at its other end.
    Cavity {
        /// Width along y, m.
        width_m: f64,
        /// Height along z, m.
        height_m: f64,
        /// Depth from the aperture to the end, m.
        depth_m: f64,
    },
    /// A sphere about the origin.
    Sphere {
        /// Radius, m.
        radius_m: f64,
    },
    /// Lateral surface of a cylinder about the z axis, without end caps.
    Cylinder {
        /// Radius, m.
        radius_m: f64,
        /// Height along z, m.
        height_m: f64,
    },
    /// An ellipsoid about the origin.
    Ellipsoid {
        /// Semi-axes along x, y, z, m.
        semi_axes_m: DVec3,
    },
    /// Concave spherical mirror that faces +x, its pole at the origin.
    Mirror {
        /// Radius of curvature, m.
        radius_m: f64,
        /// Diameter of the aperture, m.
        aperture_m: f64,
    },
    /// Arbitrary surface.
    Surface {
        /// Triangles with normals.
        surface: Surface,
    },
}

impl Target {
    /// Point from which ranges are measured, for a radar in this direction.
    pub fn reference_point(&self, towards: DVec3) -> DVec3 {
        match self {
            Target::Sphere { radius_m } => towards * *radius_m,
            Target::Cylinder { radius_m, .. } => {
                DVec3::new(towards.x, towards.y, 0.0).normalize_or(DVec3::X) * *radius_m
            }
            Target::Ellipsoid { semi_axes_m } => towards / (towards / *semi_axes_m).length(),
            Target::Surface { surface } => {
                let (low, high) = surface.bounds();
                0.5 * (low + high)
            }
            _ => DVec3::ZERO,
        }
    }

    /// Usual viewing direction of a target, azimuth and elevation, rad: its axis.
    pub fn axis(&self) -> (f64, f64) {
        match self {
            Target::Dihedral { .. } => (FRAC_PI_4, 0.0),
            Target::Trihedral { .. } => (FRAC_PI_4, (1.0 / 3f64.sqrt()).asin()),
            _ => (0.0, 0.0),
        }
    }
}

/// Direction of the radar's electric field.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Polarisation {
    /// As close to z as possible.
    Vertical,
    /// Perpendicular to z.
    Horizontal,
}

/// Radar position, polarisation and frequency for a target, and the target's material.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Setup {
    /// Frequency, Hz.
    pub frequency_hz: f64,
    /// Range to the target's reference point, m; `None` for infinitely far.
    pub range_m: Option<f64>,
    /// Azimuth of the radar from the x axis towards y, rad.
    pub azimuth_rad: f64,
    /// Elevation of the radar from the x-y plane towards z, rad.
    pub elevation_rad: f64,
    /// Direction of the electric field.
    pub polarisation: Polarisation,
    /// Material of the target.
    pub boundary: Wall,
}

impl Setup {
    /// Unit vector from the target to the radar.
    pub fn towards(&self) -> DVec3 {
        let ((sa, ca), (se, ce)) = (self.azimuth_rad.sin_cos(), self.elevation_rad.sin_cos());
        DVec3::new(ce * ca, ce * sa, se)
    }

    /// Wavelength, m.
    pub fn wavelength_m(&self) -> f64 {
        SPEED_OF_LIGHT_M_PER_S / self.frequency_hz
    }

    /// Wavenumber, 1/m.
    pub fn wavenumber_per_m(&self) -> f64 {
        TAU / self.wavelength_m()
    }

    /// The radar, for the target's reference point.
    pub fn radar(&self, reference_point: DVec3) -> Radar {
        let d = self.towards();
        let vertical = DVec3::Z.reject_from_normalized(d).normalize_or(-DVec3::X);
        let polarisation = match self.polarisation {
            Polarisation::Vertical => vertical,
            Polarisation::Horizontal => d.cross(vertical),
        };
        let end = match self.range_m {
            Some(range_m) => Endpoint::Near(reference_point + d * range_m),
            None => Endpoint::Far(d),
        };
        Radar { end, polarisation }
    }

    /// Cross-section of a physical-optics integral, m^2: `4 pi (k/2 pi)^2 |I|^2`, times `R^4` in the near field.
    pub fn cross_section_m2(&self, integral: Complex64) -> f64 {
        let k = self.wavenumber_per_m();
        let ranges = self.range_m.map_or(1.0, |r| r.powi(4));
        k * k / std::f64::consts::PI * integral.norm_sqr() * ranges
    }

    /// Cross-section of a far aperture that reflects all power back, m^2: `4 pi A^2/lambda^2`.
    fn aperture_m2(&self, area_m2: f64) -> f64 {
        2.0 * TAU * (area_m2 / self.wavelength_m()).powi(2)
    }

    /// Power reflected at normal incidence.
    fn normal_reflection(&self) -> f64 {
        self.boundary.reflection(self.wavenumber_per_m(), 1.0).te.norm_sqr()
    }

    /// Power reflected by a plane at this cosine of incidence, in a principal plane of the target's axes; `None`
    /// outside, where the polarisations mix.
    fn plane_reflection(&self, cosine: f64) -> Option<f64> {
        let coefficients = self.boundary.reflection(self.wavenumber_per_m(), cosine);
        if self.boundary == Wall::Conductor {
            return Some(1.0);
        }
        let (level, upright) = (self.elevation_rad.abs() < 1e-12, self.azimuth_rad.abs() < 1e-12);
        match (level, upright, self.polarisation) {
            (true, _, Polarisation::Vertical) | (_, true, Polarisation::Horizontal) => Some(coefficients.te.norm_sqr()),
            (true, _, Polarisation::Horizontal) | (_, true, Polarisation::Vertical) => Some(coefficients.tm.norm_sqr()),
            _ => None,
        }
    }
}

/// Method by which a cross-section is computed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Method {
    /// Stationary phase on the exact shape: round bodies.
    Specular,
    /// Patches of curved triangles, as in people's skins: closed smooth meshes.
    Skin,
    /// Physical optics over facets, cut until the phase is nearly linear inside each.
    Facets,
    /// Images by every sequence of plane faces, with physical optics on the last: corners and cavities.
    Images,
    /// Physical optics summed over a grid of patches of constant phase: the slow reference.
    Dense,
}

impl Method {
    /// All methods.
    pub const ALL: [Method; 5] = [Method::Specular, Method::Skin, Method::Facets, Method::Images, Method::Dense];

    /// Name of the method.
    pub fn name(self) -> &'static str {
        match self {
            Method::Specular => "specular",
            Method::Skin => "skin",
            Method::Facets => "facets",
            Method::Images => "images",
            Method::Dense => "dense",
        }
    }

    /// Returns whether the method can be used for a target.
    pub fn suits(self, target: &Target) -> bool {
        match self {
            Method::Specular => matches!(target, Target::Sphere { .. } | Target::Ellipsoid { .. }),
            Method::Skin => match target {
                Target::Sphere { .. } | Target::Ellipsoid { .. } => true,
                Target::Surface { surface } => surface.is_smooth(),
                _ => false,
            },
            Method::Images => match target {
                Target::Dihedral { .. } | Target::Trihedral { .. } | Target::Cavity { .. } | Target::Plate { .. } => {
                    true
                }
                Target::Surface { surface } => few_flat_faces(surface),
                _ => false,
            },
            _ => !matches!(target, Target::Dihedral { .. } | Target::Trihedral { .. } | Target::Cavity { .. }),
        }
    }

    /// Most suitable method for a target, as exact shape or as a mesh.
    pub fn automatic(target: &Target, mesh: bool) -> Self {
        match target {
            Target::Plate { .. } | Target::Cylinder { .. } | Target::Mirror { .. } => Method::Facets,
            Target::Dihedral { .. } | Target::Trihedral { .. } | Target::Cavity { .. } => Method::Images,
            Target::Sphere { .. } | Target::Ellipsoid { .. } if !mesh => Method::Specular,
            Target::Surface { surface } if few_flat_faces(surface) => Method::Images,
            Target::Surface { surface } if !surface.is_smooth() => Method::Facets,
            _ => Method::Skin,
        }
    }
}

/// Returns whether a surface consists of a few plane faces: corners and boxes.
fn few_flat_faces(surface: &Surface) -> bool {
    surface.triangles.len() <= MOST_FACES
        && (0..surface.triangles.len()).filter_map(|t| surface.corners(t)).all(|[a, b, c]| {
            let normal = (b.0 - a.0).cross(c.0 - a.0).normalize_or_zero();
            [a, b, c].iter().all(|corner| corner.1.dot(normal) > 1.0 - 1e-9)
        })
}

/// Largest number of faces between which every sequence is followed.
const MOST_FACES: usize = 64;

/// Error in the definition of a validation problem.
#[derive(Debug, Error)]
pub enum RcsError {
    /// A quantity is not a number or out of range.
    #[error("{what} is {value} {unit}\n\nhint: it must lie between {low} and {high} {unit}")]
    OutOfRange {
        /// Name of the quantity.
        what: &'static str,
        /// Value that was given.
        value: f64,
        /// Unit of the value.
        unit: &'static str,
        /// Lower limit.
        low: f64,
        /// Upper limit.
        high: f64,
    },
    /// The radar would be inside the target.
    #[error(
        "a range of {range_m} m puts the radar into the target, which reaches {reach_m:.3} m from its reference point\n\nhint: choose a longer range, or none for the far field"
    )]
    Inside {
        /// Given range.
        range_m: f64,
        /// Least range.
        reach_m: f64,
    },
    /// The radar does not look into the aperture of a cavity.
    #[error(
        "the radar does not look into the aperture of the cavity, which opens towards +x\n\nhint: choose an azimuth and an elevation that are less than 90 degrees from it"
    )]
    BesideAperture,
    /// A wave takes too many bounces in a cavity.
    #[error(
        "the wave takes {bounces} bounces in the cavity, and at most {most} are followed\n\nhint: look closer along its axis, or make it less deep"
    )]
    TooManyBounces {
        /// Bounces from the aperture and back.
        bounces: f64,
        /// Largest number.
        most: usize,
    },
    /// The method does not suit the target.
    #[error(
        "the method {method} does not suit this target\n\nhint: choose {suitable}, or leave the choice to the program"
    )]
    Unsuitable {
        /// Requested method.
        method: &'static str,
        /// Methods that are suitable.
        suitable: String,
    },
    /// A mesh would be too fine.
    #[error(
        "edges of {edge_m} m would make about {triangles:.1e} triangles\n\nhint: at most {most:.0e} are made; ask for longer edges"
    )]
    TooFine {
        /// Requested edge length.
        edge_m: f64,
        /// Resulting number of triangles.
        triangles: f64,
        /// Largest allowed number.
        most: f64,
    },
    /// A thickness was given for a closed body, which is solid.
    #[error(
        "a closed smooth body is solid: it has no thickness\n\nhint: leave the thickness out, or choose another method"
    )]
    NotSolid,
    /// The target's faces cannot be those of a room.
    #[error(transparent)]
    Faces(#[from] EnvironmentError),
    /// The surface is empty.
    #[error("the surface has no triangle with an area\n\nhint: check the file and its unit, which must be metres")]
    Empty,
}
