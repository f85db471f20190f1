//! Endpoints of a path: an antenna in the near field, or a direction in the far field.
//!
//! Far endpoints measure path lengths relative to the origin and omit spreading, so that a near-field integral times
//! `R_t R_r` tends to the far-field one.

use glam::DVec3;

/// Endpoint of a scattered path.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Endpoint {
    /// Antenna at a position, m: spherical waves `e^{-jkR}/R`.
    Near(DVec3),
    /// Antenna infinitely far in the direction of this unit vector: plane waves.
    Far(DVec3),
}

/// Straight path between a point and an endpoint.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Leg {
    /// Length, m; negative for a far endpoint where the point lies ahead of the origin.
    pub length_m: f64,
    /// Factor of the field: `1/R`, or 1 for a far endpoint.
    pub spreading: f64,
    /// Unit vector from the point to the endpoint.
    pub towards: DVec3,
}

impl Endpoint {
    /// Straight path from a point to the endpoint.
    #[inline]
    pub fn leg(&self, point: DVec3) -> Leg {
        match *self {
            Endpoint::Near(antenna) => {
                let offset = antenna - point;
                // The lower limit of the length keeps the division finite.
                let length_m = offset.length().max(1e-9);
                let inverse = 1.0 / length_m;
                Leg { length_m, spreading: inverse, towards: offset * inverse }
            }
            Endpoint::Far(towards) => Leg { length_m: -towards.dot(point), spreading: 1.0, towards },
        }
    }

    /// Mirror image in the plane through a point with this unit normal.
    pub fn mirrored(&self, on_plane: DVec3, normal: DVec3) -> Self {
        match *self {
            Endpoint::Near(antenna) => Endpoint::Near(antenna - normal * (2.0 * normal.dot(antenna - on_plane))),
            Endpoint::Far(towards) => Endpoint::Far(towards - normal * (2.0 * normal.dot(towards))),
        }
    }

    /// Signed value that is positive exactly if the endpoint lies on the side of the plane to which the normal points.
    pub fn side(&self, on_plane: DVec3, normal: DVec3) -> f64 {
        match *self {
            Endpoint::Near(antenna) => normal.dot(antenna - on_plane),
            Endpoint::Far(towards) => normal.dot(towards),
        }
    }
}
