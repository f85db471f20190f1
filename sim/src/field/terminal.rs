//! Endpoint of a wave: an antenna in the near field, or a direction in the far field.
//!
//! Far terminals measure path lengths against the origin and leave spreading out, so that a near-field integral times
//! `R_t R_r` tends to the far-field one.

use glam::DVec3;

use crate::geometry::polygon;

/// One end of a scattered path.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Terminal {
    /// An antenna at a position, m: spherical waves `e^{-jkR}/R`.
    Near(DVec3),
    /// An antenna infinitely far in the direction of this unit vector: plane waves.
    Far(DVec3),
}

/// The way between a point and a terminal.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Leg {
    /// Length, m; negative for a far terminal where the point lies ahead of the origin.
    pub length_m: f64,
    /// Factor of the field: `1/R`, or 1 for a far terminal.
    pub spreading: f64,
    /// Curvature of the wave front at the point, `1/R`, or 0.
    pub curvature_per_m: f64,
    /// Unit vector from the point to the terminal.
    pub towards: DVec3,
}

impl Terminal {
    /// The way from a point.
    #[inline]
    pub fn leg(&self, point: DVec3) -> Leg {
        match *self {
            Terminal::Near(antenna) => {
                let offset = antenna - point;
                // Nothing is nearer than the nearest that a division survives.
                let length_m = offset.length().max(1e-9);
                let inverse = 1.0 / length_m;
                Leg { length_m, spreading: inverse, curvature_per_m: inverse, towards: offset * inverse }
            }
            Terminal::Far(towards) => {
                Leg { length_m: -towards.dot(point), spreading: 1.0, curvature_per_m: 0.0, towards }
            }
        }
    }

    /// Image in the plane through a point with this unit normal.
    pub fn mirrored(&self, on_plane: DVec3, normal: DVec3) -> Self {
        match *self {
            Terminal::Near(antenna) => Terminal::Near(antenna - normal * (2.0 * normal.dot(antenna - on_plane))),
            Terminal::Far(towards) => Terminal::Far(towards - normal * (2.0 * normal.dot(towards))),
        }
    }

    /// Something positive exactly when the terminal lies on the side of the plane to which the normal points.
    pub fn side(&self, on_plane: DVec3, normal: DVec3) -> f64 {
        match *self {
            Terminal::Near(antenna) => normal.dot(antenna - on_plane),
            Terminal::Far(towards) => normal.dot(towards),
        }
    }

    /// The part of a convex polygon that the terminal sees through a convex window, behind it.
    pub fn seen_through(&self, corners: &[DVec3], window: &[DVec3]) -> Vec<DVec3> {
        let normal = polygon::normal(window);
        let middle = polygon::centroid(window);
        let away = if self.side(middle, normal) > 0.0 { -normal } else { normal };
        let mut left = polygon::clipped(corners, middle, away);
        for (i, &a) in window.iter().enumerate() {
            let b = window[(i + 1) % window.len()];
            let side = (b - a).cross(self.leg(a).towards);
            let inwards = if side.dot(middle - a) < 0.0 { -side } else { side };
            left = polygon::clipped(&left, a, inwards);
        }
        left
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SQUARE: [DVec3; 4] = [DVec3::ZERO, DVec3::X, DVec3::new(1.0, 1.0, 0.0), DVec3::Y];

    /// A pinhole camera's window halves what lies twice as far behind it, a far one keeps its size.
    #[test]
    fn windows_throw_shadows_of_the_right_size() {
        let window = [0.4, 0.6, 0.6, 0.4].iter().zip([0.4, 0.4, 0.6, 0.6]).map(|(x, y)| DVec3::new(*x, y, 1.0));
        let window: Vec<DVec3> = window.collect();
        let near = Terminal::Near(DVec3::new(0.5, 0.5, 2.0)).seen_through(&SQUARE, &window);
        assert!((polygon::area_m2(&near) - 0.16).abs() < 1e-12, "{near:?}");
        let far = Terminal::Far(DVec3::Z).seen_through(&SQUARE, &window);
        assert!((polygon::area_m2(&far) - 0.04).abs() < 1e-12);
        // What lies before the window is not seen through it.
        assert!(Terminal::Far(-DVec3::Z).seen_through(&SQUARE, &window).is_empty());
    }
}
