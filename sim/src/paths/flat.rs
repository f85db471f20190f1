//! Facets: plane polygons with a wall each, and the geometry of their planes.

use std::sync::Arc;

use glam::{DMat3, DVec2, DVec3};
use thiserror::Error;

use super::triangulate::triangulate;
use crate::em::image::{BoxRoom, Wall};
use crate::em::wall::{WallTable, WallTables};
use crate::geometry::polygon::{self, distance_to_segment, doubled_area, encloses, sides};
use crate::rays::RayTracerError;

/// Largest distance of corners from their facet's plane, m: 1 um is 0.003 rad of phase at 60 GHz.
pub(super) const PLANAR_M: f64 = 1e-6;
/// Distance beyond a side up to which a point still lies on a facet, m. A point on the seam of two facets then lies on
/// at least one.
pub(super) const SEAM_M: f64 = 1e-9;
/// Walls transmit waves if they leave more than this part of a field at normal incidence: -40 dB.
const LEAST_TRANSMISSION: f64 = 0.01;

/// Index of a facet in its environment.
pub type FacetId = u32;

/// Plane polygon that reflects on the side of its normal.
#[derive(Debug, Clone, PartialEq)]
pub struct Facet {
    /// Outline, m: a simple polygon, counter-clockwise when the normal points to the viewer.
    pub corners: Vec<DVec3>,
    /// Outlines of holes, m, in any direction.
    pub holes: Vec<Vec<DVec3>>,
    /// Material; [`Wall::Open`] means that there is no surface.
    pub wall: Wall,
    /// Whether each side of the outline diffracts as a free edge or an outward corner does. The first side is from the
    /// first corner to the second. If empty, this is found from the geometry, as it is for sides of holes.
    pub diffracting_sides: Vec<bool>,
}

/// Error in facets from which no environment can be made.
#[derive(Debug, Error, PartialEq)]
pub enum EnvironmentError {
    /// A facet is not a plane polygon.
    #[error("facet {facet}: {why}\n\nhint: an outline has three corners or more, in one plane within {PLANAR_M} m")]
    NoPolygon {
        /// Index of the facet.
        facet: usize,
        /// Reason.
        why: &'static str,
    },
    /// The list of diffracting sides is not as long as the outline.
    #[error("facet {facet}: {given} flags of diffraction for {sides} sides, expected one a side or none")]
    DiffractingSides {
        /// Index of the facet.
        facet: usize,
        /// Number of sides of the outline.
        sides: usize,
        /// Number of flags given.
        given: usize,
    },
    /// Rays cannot be traced among the facets.
    #[error(transparent)]
    Rays(#[from] RayTracerError),
}

impl Facet {
    /// Makes a facet without holes whose diffracting sides are found from the geometry.
    pub fn new(corners: Vec<DVec3>, wall: Wall) -> Self {
        Facet { corners, holes: Vec::new(), wall, diffracting_sides: Vec::new() }
    }

    /// The six surfaces of a box room, numbered as its walls are.
    pub fn of_box(room: &BoxRoom) -> Vec<Facet> {
        let s = room.size_m;
        let at = |x: u8, y: u8, z: u8| s * DVec3::new(f64::from(x), f64::from(y), f64::from(z));
        let corners = [
            [at(0, 0, 0), at(0, 1, 0), at(0, 1, 1), at(0, 0, 1)],
            [at(1, 0, 0), at(1, 0, 1), at(1, 1, 1), at(1, 1, 0)],
            [at(0, 0, 0), at(0, 0, 1), at(1, 0, 1), at(1, 0, 0)],
            [at(0, 1, 0), at(1, 1, 0), at(1, 1, 1), at(0, 1, 1)],
            [at(0, 0, 0), at(1, 0, 0), at(1, 1, 0), at(0, 1, 0)],
            [at(0, 0, 1), at(0, 1, 1), at(1, 1, 1), at(1, 0, 1)],
        ];
        corners.into_iter().zip(room.walls).map(|(corners, wall)| Facet::new(corners.to_vec(), wall)).collect()
    }
}

/// Facet with its plane.
#[derive(Debug, Clone)]
pub(super) struct Flat {
    pub facet: Facet,
    pub normal: DVec3,
    pub offset_m: f64,
    /// Plane number, shared by all facets in the same plane, of either side.
    pub plane: u32,
    /// Numbers of its diffracting edges, except those at which another facet begins before it.
    pub edges: Vec<u32>,
    /// Coefficients of its wall.
    pub table: Arc<WallTable>,
    /// Whether its wall transmits so much of a wave that the transmitted path counts.
    pub transmits: bool,
    /// Centre and radius of a bounding sphere, m.
    pub middle: DVec3,
    pub radius_m: f64,
    /// Perpendicular unit vectors in the plane.
    pub axes: [DVec3; 2],
    /// Lowest and highest coordinates along the axes, with a margin for points on the sides, m.
    pub extent_m: [DVec2; 2],
    outline: Vec<DVec2>,
    holes: Vec<Vec<DVec2>>,
}

impl Flat {
    /// Prepares a facet.
    ///
    /// # Errors
    /// [`EnvironmentError`] if the facet is not a plane polygon, or its list of diffracting sides has another length.
    pub fn new(number: usize, facet: Facet, tables: &mut WallTables) -> Result<Self, EnvironmentError> {
        let error = |why| EnvironmentError::NoPolygon { facet: number, why };
        let all_corners = || facet.corners.iter().chain(facet.holes.iter().flatten());
        if facet.corners.len() < 3 || facet.holes.iter().any(|hole| hole.len() < 3) {
            return Err(error("an outline has fewer than three corners"));
        }
        if !all_corners().all(|c| c.is_finite()) {
            return Err(error("a corner is not finite"));
        }
        if !facet.diffracting_sides.is_empty() && facet.diffracting_sides.len() != facet.corners.len() {
            let (sides, given) = (facet.corners.len(), facet.diffracting_sides.len());
            return Err(EnvironmentError::DiffractingSides { facet: number, sides, given });
        }
        let normal = polygon::normal(&facet.corners);
        if normal == DVec3::ZERO {
            return Err(error("the outline has no area"));
        }
        let offset_m = facet.corners.iter().map(|c| c.dot(normal)).sum::<f64>() / facet.corners.len() as f64;
        if all_corners().any(|c| (c.dot(normal) - offset_m).abs() > PLANAR_M) {
            return Err(error("a corner lies out of the plane of the others"));
        }
        let u = normal.any_orthonormal_vector();
        let axes = [u, normal.cross(u)];
        let in_plane = |corners: &[DVec3]| -> Vec<DVec2> {
            corners.iter().map(|c| DVec2::new(c.dot(axes[0]), c.dot(axes[1]))).collect()
        };
        let outline = in_plane(&facet.corners);
        let low = outline.iter().fold(DVec2::INFINITY, |low, &corner| low.min(corner));
        let high = outline.iter().fold(DVec2::NEG_INFINITY, |high, &corner| high.max(corner));
        let holes = facet.holes.iter().map(|hole| in_plane(hole)).collect();
        let middle = facet.corners.iter().sum::<DVec3>() / facet.corners.len() as f64;
        let radius_m = facet.corners.iter().map(|corner| corner.distance(middle)).fold(0.0, f64::max);
        let transmission = facet.wall.transmission(tables.wavenumber_per_m, 1.0).te.norm();
        Ok(Flat {
            normal,
            offset_m,
            plane: 0,
            edges: Vec::new(),
            table: tables.of(facet.wall),
            transmits: transmission > LEAST_TRANSMISSION,
            middle,
            radius_m,
            axes,
            extent_m: [low - 2.0 * SEAM_M, high + 2.0 * SEAM_M],
            outline,
            holes,
            facet,
        })
    }

    /// Signed distance of a point from the plane, m.
    pub fn height(&self, point: DVec3) -> f64 {
        self.normal.dot(point) - self.offset_m
    }

    /// Mirror image of a point.
    pub fn mirrored(&self, point: DVec3) -> DVec3 {
        point - self.normal * (2.0 * self.height(point))
    }

    /// Mirror matrix of vectors.
    pub fn mirror(&self) -> DMat3 {
        let n = self.normal;
        DMat3::from_cols(DVec3::X - n * (2.0 * n.x), DVec3::Y - n * (2.0 * n.y), DVec3::Z - n * (2.0 * n.z))
    }

    /// Returns whether there is a surface, which reflects waves.
    pub fn reflects(&self) -> bool {
        self.facet.wall != Wall::Open
    }

    /// Coordinates of a point along the axes, m.
    fn plane_coordinates(&self, point: DVec3) -> DVec2 {
        DVec2::new(point.dot(self.axes[0]), point.dot(self.axes[1]))
    }

    /// Sides of the outline and of the holes, in coordinates along the axes, m.
    fn sides(&self) -> impl Iterator<Item = [DVec2; 2]> + '_ {
        std::iter::once(&self.outline).chain(&self.holes).flat_map(|outline| sides(outline))
    }

    /// Returns whether a point of the plane lies on the facet.
    pub fn contains(&self, point: DVec3) -> bool {
        let p = self.plane_coordinates(point);
        let is_inside = encloses(&self.outline, p) && !self.holes.iter().any(|hole| encloses(hole, p));
        is_inside || self.sides().any(|side| distance_to_segment(p, side) < SEAM_M)
    }

    /// Distance of a point of the plane from the nearest side, m.
    pub fn distance_to_sides_m(&self, point: DVec3) -> f64 {
        let p = self.plane_coordinates(point);
        self.sides().map(|side| distance_to_segment(p, side)).fold(f64::INFINITY, f64::min)
    }

    /// Returns whether a point of the plane lies farther than a distance, m, from the bounding sphere.
    pub fn is_far(&self, point: DVec3, distance_m: f64) -> bool {
        let reach_m = self.radius_m + distance_m;
        self.middle.distance_squared(point) > reach_m * reach_m
    }

    /// Returns whether a hole is counter-clockwise seen against the normal, as the outline is.
    pub fn is_counter_clockwise(&self, hole: usize) -> bool {
        self.holes.get(hole).is_some_and(|hole| doubled_area(hole) > 0.0)
    }

    /// Triangles that cover the facet, as indices of its corners and then those of its holes; `None` where its outlines
    /// cross.
    pub fn triangles(&self) -> Option<Vec<[u32; 3]>> {
        triangulate(&self.outline, &self.holes)
    }
}
