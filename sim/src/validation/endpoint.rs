//! Where a wave comes from or goes to: an antenna in the near field, or a direction in the far field.
//!
//! Far endpoints measure path lengths against the origin and leave spreading out, so that a near-field integral times
//! `R_t R_r` tends to the far-field one.

use glam::DVec3;

/// One end of a scattered path.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Endpoint {
    /// An antenna at a position, m: spherical waves `e^{-jkR}/R`.
    Near(DVec3),
    /// An antenna infinitely far in the direction of this unit vector: plane waves.
    Far(DVec3),
}

/// The way between a point and a endpoint.
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
    /// The way from a point.
    #[inline]
    pub fn leg(&self, point: DVec3) -> Leg {
        match *self {
            Endpoint::Near(antenna) => {
                let offset = antenna - point;
                // Nothing is nearer than the nearest that a division survives.
                let length_m = offset.length().max(1e-9);
                let inverse = 1.0 / length_m;
                Leg { length_m, spreading: inverse, towards: offset * inverse }
            }
            Endpoint::Far(towards) => Leg { length_m: -towards.dot(point), spreading: 1.0, towards },
        }
    }

    /// Image in the plane through a point with this unit normal.
    pub fn mirrored(&self, on_plane: DVec3, normal: DVec3) -> Self {
        match *self {
            Endpoint::Near(antenna) => Endpoint::Near(antenna - normal * (2.0 * normal.dot(antenna - on_plane))),
            Endpoint::Far(towards) => Endpoint::Far(towards - normal * (2.0 * normal.dot(towards))),
        }
    }

    /// Something positive exactly when the endpoint lies on the side of the plane to which the normal points.
    pub fn side(&self, on_plane: DVec3, normal: DVec3) -> f64 {
        match *self {
            Endpoint::Near(antenna) => normal.dot(antenna - on_plane),
            Endpoint::Far(towards) => normal.dot(towards),
        }
    }
}
