//! People in each other's way: a person is an upright column, and a leg of a path that comes near it is weakened by
//! knife-edge diffraction (ITU-R P.526's approximation), smoothly with clearance: a path never switches off within a frame.

use glam::DVec3;

use crate::actor::track::smooth_ramp;

/// An upright obstacle standing on the floor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Column {
    /// Axis on the ground plan, m.
    pub x: f64,
    /// Axis on the ground plan, m.
    pub y: f64,
    /// Radius, m.
    pub radius_m: f64,
    /// Height, m.
    pub height_m: f64,
}

/// Half of the loss over which the knife edge's onset is rounded, dB.
const ONSET_DB: f64 = 3.0;

/// Field behind a knife edge relative to free space: ITU-R P.526 `J(nu) = 6.9 + 20 log10(sqrt((nu - 0.1)^2 + 1) + nu - 0.1)`
/// dB, which begins at `nu = -0.78` with a corner. That is rounded here while `J` is within 3 dB of none: no loss below
/// `nu = -1.24`, and half a decibel at the corner.
pub fn knife_edge(nu: f64) -> f64 {
    let x = nu - 0.1;
    // 10^(-6.9/20), and the logarithm undone.
    let field = 0.451_855_944_374_922_4 / ((x * x + 1.0).sqrt() + x);
    // 3 dB either way.
    if field < 0.708 {
        return field;
    }
    if field > 1.413 {
        return 1.0;
    }
    let loss_db = -20.0 * field.log10();
    10f64.powf(-0.05 * ONSET_DB * smooth_ramp(loss_db / ONSET_DB))
}

/// Field left on the straight leg from `a` to `b` past a column.
pub fn past(a: DVec3, b: DVec3, column: &Column, wavelength_m: f64) -> f64 {
    let (ax, ay) = (a.x - column.x, a.y - column.y);
    let (dx, dy) = (b.x - a.x, b.y - a.y);
    let plan = dx * dx + dy * dy;
    let fraction = if plan > 1e-12 { (-(ax * dx + ay * dy) / plan).clamp(0.0, 1.0) } else { 0.5 };
    let sideways = ((ax + fraction * dx).powi(2) + (ay + fraction * dy).powi(2)).sqrt() - column.radius_m;
    if sideways > 0.5 {
        return 1.0;
    }
    let above = a.z + fraction * (b.z - a.z) - column.height_m;
    let clearance = sideways.max(above);
    let length = (b - a).length();
    let (d1, d2) = ((fraction * length).max(0.05), ((1.0 - fraction) * length).max(0.05));
    knife_edge(-clearance * (2.0 * (d1 + d2) / (wavelength_m * d1 * d2)).sqrt())
}

/// Field left on a folded path past columns.
pub fn along(polyline: &[DVec3], columns: &[Column], wavelength_m: f64) -> f64 {
    let mut weight = 1.0;
    for leg in polyline.windows(2) {
        if let [a, b] = leg {
            for column in columns {
                weight *= past(*a, *b, column, wavelength_m);
            }
        }
    }
    weight
}

#[cfg(test)]
mod tests {
    use super::*;

    /// At grazing incidence half the field is left (-6 dB); well clear nothing is lost; deep in the shadow `1/(2.2 nu)` or so.
    #[test]
    fn knife_edge_has_its_textbook_values() {
        assert!((20.0 * knife_edge(0.0).log10() + 6.02).abs() < 0.1);
        assert_eq!(knife_edge(-2.0), 1.0);
        assert!((20.0 * knife_edge(2.4).log10() + 20.5).abs() < 0.5);
        let [mut before, mut last] = [1.0; 2];
        for i in -200..300 {
            let now = knife_edge(f64::from(i) * 0.01);
            assert!(now <= last && last - now < 0.01, "falling");
            assert!((now - 2.0 * last + before).abs() < 2e-4, "no corner at {i}");
            (before, last) = (last, now);
        }
    }

    #[test]
    fn a_person_between_shades_and_one_beside_does_not() {
        let column = |y| Column { x: 2.0, y, radius_m: 0.18, height_m: 1.75 };
        let (a, b) = (DVec3::new(0.0, 0.0, 1.0), DVec3::new(4.0, 0.0, 1.0));
        assert!(past(a, b, &column(0.0), 0.005) < 0.1);
        assert_eq!(past(a, b, &column(0.8), 0.005), 1.0);
        let high = DVec3::new(0.0, 0.0, 2.5);
        assert_eq!(past(high, DVec3::new(4.0, 0.0, 2.5), &column(0.0), 0.005), 1.0);
    }
}
