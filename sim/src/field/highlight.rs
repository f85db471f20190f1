//! The specular highlight of an ellipsoid seen by a (transmitter image, receiver image) pair, in the near field.
//!
//! Stationary phase of physical optics: the highlight is where `R_t + R_r` is least. With `J` the Hessian of
//! `(R_t + R_r)/2` over the tangent plane, the echo's amplitude relative to the transmitted field is
//! `lambda/(4 pi) * cos/(2 sqrt(det J) R_t R_r)` times the reflection coefficient at the true incidence; in the
//! monostatic case `det J = (k1 + 1/R)(k2 + 1/R)`, `sigma = pi / det J`.

use glam::{DMat3, DVec3};

/// An ellipsoid in the room.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ellipsoid {
    /// Centre, m.
    pub centre: DVec3,
    /// Directions of the semi-axes, in columns (a rotation).
    pub axes: DMat3,
    /// Semi-axes, m.
    pub semi_axes_m: DVec3,
}

/// Where a pair of points sees an ellipsoid shine.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Highlight {
    /// The point.
    pub point: DVec3,
    /// The point on the unit sphere of which the ellipsoid is the image: moves with the body's material.
    pub unit: DVec3,
    /// Outward unit normal.
    pub normal: DVec3,
    /// Distances to transmitter and receiver, m.
    pub distances_m: (f64, f64),
    /// Unit vectors from the point to transmitter and receiver.
    pub towards: (DVec3, DVec3),
    /// Cosine of the angle of incidence.
    pub cosine: f64,
    /// Determinant of J, 1/m^2.
    pub det_j: f64,
    /// A source lies inside the body and was moved to its surface.
    pub inside: (bool, bool),
}

/// A source nearer to the centre than this, in units of the ellipsoid's own radius, counts as touching it.
const TOUCHING: f64 = 1.02;

impl Ellipsoid {
    /// Point of the surface for a point of the unit sphere.
    pub fn surface(&self, unit: DVec3) -> DVec3 {
        self.centre + self.axes * (unit * self.semi_axes_m)
    }

    fn unit_from(&self, point: DVec3) -> DVec3 {
        (self.axes.transpose() * (point - self.centre)) / self.semi_axes_m
    }

    fn pushed_out(&self, source: DVec3) -> (DVec3, bool) {
        let unit = self.unit_from(source);
        let radius = unit.length();
        if radius >= TOUCHING {
            return (source, false);
        }
        let outward = if radius > 1e-9 { unit / radius } else { DVec3::X };
        (self.surface(outward * TOUCHING), true)
    }

    /// The highlight for a pair of points. `start` is a point of the unit sphere near the solution, if one is known.
    /// `None` where the pair lies on opposite sides (forward scattering, which has no highlight).
    pub fn highlight(&self, tx: DVec3, rx: DVec3, start: Option<DVec3>) -> Option<Highlight> {
        let (tx, tx_inside) = self.pushed_out(tx);
        let (rx, rx_inside) = self.pushed_out(rx);
        let b = self.semi_axes_m;
        let mut unit = match start {
            Some(unit) => unit,
            None => {
                let bisector = (tx - self.centre).normalize_or_zero() + (rx - self.centre).normalize_or_zero();
                if bisector.length_squared() < 0.04 {
                    return None;
                }
                // Far sources shine where the normal is the bisector, touching ones under themselves.
                let support = (b * (self.axes.transpose() * bisector)).normalize();
                let below = (self.unit_from(tx).normalize() + self.unit_from(rx).normalize()).normalize_or_zero();
                let reach = b.max_element();
                let nearest = (tx - self.centre).length().min((rx - self.centre).length());
                let w = (reach / nearest).clamp(0.0, 1.0).powi(2);
                support.lerp(below, w).normalize_or(support)
            }
        };
        let length_at = |unit: DVec3| {
            let p = self.surface(unit);
            (p - tx).length() + (p - rx).length()
        };
        let mut best = None;
        let mut length = length_at(unit);
        for _ in 0..25 {
            let h = self.local(unit, tx, rx, (tx_inside, rx_inside))?;
            let step = h.1;
            let found = h.0;
            best = Some(found);
            // A path's length errs by the square of the point's error: 1e-7 m is far below a wave.
            if step.length_squared() < 1e-14 {
                break;
            }
            let mut fraction = 1.0;
            loop {
                let candidate = self.unit_from(found.point + step * fraction).normalize_or(unit);
                let candidate_length = length_at(candidate);
                if candidate_length <= length + 1e-12 || fraction < 1e-3 {
                    unit = candidate;
                    length = candidate_length;
                    break;
                }
                fraction *= 0.5;
            }
        }
        best.filter(|h| h.cosine > 0.1)
    }

    /// Geometry at a surface point, and the Newton step in its tangent plane towards the stationary point.
    fn local(&self, unit: DVec3, tx: DVec3, rx: DVec3, inside: (bool, bool)) -> Option<(Highlight, DVec3)> {
        let b = self.semi_axes_m;
        let point = self.surface(unit);
        let gradient = unit / b;
        let scale = gradient.length();
        let normal = self.axes * (gradient / scale);
        let (to_tx, to_rx) = (tx - point, rx - point);
        let (r_t, r_r) = (to_tx.length().max(1e-9), to_rx.length().max(1e-9));
        let (s_t, s_r) = (to_tx / r_t, to_rx / r_r);
        let cosine = 0.5 * (normal.dot(s_t) + normal.dot(s_r));
        let u = normal.any_orthonormal_vector();
        let v = normal.cross(u);
        // Second fundamental form of F = |unit|^2: tangent^T diag(1/b^2) tangent / |grad|.
        let to_body = self.axes.transpose();
        let (ub, vb) = (to_body * u / b, to_body * v / b);
        let curvature = (ub.dot(ub) / scale, ub.dot(vb) / scale, vb.dot(vb) / scale);
        let (tu, tv, ru, rv) = (s_t.dot(u), s_t.dot(v), s_r.dot(u), s_r.dot(v));
        let c = cosine.max(0.05);
        let h_uu = 0.5 * ((1.0 - tu * tu) / r_t + (1.0 - ru * ru) / r_r) + c * curvature.0;
        let h_uv = 0.5 * (-tu * tv / r_t - ru * rv / r_r) + c * curvature.1;
        let h_vv = 0.5 * ((1.0 - tv * tv) / r_t + (1.0 - rv * rv) / r_r) + c * curvature.2;
        let det_j = h_uu * h_vv - h_uv * h_uv;
        if !(det_j.is_finite() && det_j > 0.0) {
            return None;
        }
        let (g_u, g_v) = (0.5 * (tu + ru), 0.5 * (tv + rv));
        let step = u * ((h_vv * g_u - h_uv * g_v) / det_j) + v * ((h_uu * g_v - h_uv * g_u) / det_j);
        let highlight =
            Highlight { point, unit, normal, distances_m: (r_t, r_r), towards: (s_t, s_r), cosine, det_j, inside };
        Some((highlight, step))
    }
}
