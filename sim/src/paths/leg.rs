//! Legs of paths, the straight pieces between two reflections, and how they pass an edge.

use glam::DVec3;
use num_complex::Complex64;

use super::edge_field::side_integral;
use super::edges::DiffractingEdge;
use super::environment::Environment;

/// Lower limit of the distance from an edge to the ends of a path, m.
const LEAST_DISTANCE_M: f64 = 1e-3;
/// Clearance from an edge below which a traced ray decides on which side a path passes, m. Rays are traced in f32, and
/// must agree with that decision.
pub(super) const UNSURE_M: f64 = 5e-5;
/// Distance from an edge at which a leg from it begins, m.
const OFF_EDGE_M: f64 = 1e-4;

/// Field relative to that of a free path with infinite facets.
#[derive(Debug, Clone, Copy)]
pub(super) struct RelativeField {
    pub field: Complex64,
    /// Whether the path is one of geometrical optics, which a ray takes.
    pub is_geometric: bool,
}

impl RelativeField {
    /// Field of a free path.
    pub const FREE: RelativeField = RelativeField { field: Complex64::ONE, is_geometric: true };

    /// Combines two successive relative fields.
    pub fn and(self, other: RelativeField) -> RelativeField {
        RelativeField { field: self.field * other.field, is_geometric: self.is_geometric && other.is_geometric }
    }
}

/// Straight piece of a path.
#[derive(Debug, Clone, Copy)]
pub(super) struct Leg {
    pub from: DVec3,
    /// Unit vector along the leg.
    pub direction: DVec3,
    pub length_m: f64,
    /// Length of the path before the leg, m.
    pub before_m: f64,
    /// Length of the whole path, m.
    pub total_m: f64,
}

impl Leg {
    /// Returns the same leg from a little farther on. The leg after one without length begins in the common edge of two
    /// facets. A ray excludes only the second of them, and the back of the first would block it.
    pub fn off_edge(&self) -> Leg {
        let off_m = OFF_EDGE_M.min(0.5 * self.length_m);
        Leg { from: self.from + self.direction * off_m, length_m: self.length_m - off_m, ..*self }
    }
}

/// Passage of a leg by an edge. Normalised lengths across the leg are in the unit of [`super::edge_field`].
pub(super) struct Passage {
    /// Normalised distance of the leg from the edge.
    pub nu: f64,
    /// Normalised distance of the leg from the line of the edge.
    pub line_nu: f64,
    /// Normalised positions of the edge's ends along its line, from the point nearest to the leg.
    pub ends_along: [f64; 2],
    /// Distance of the leg from the line of the edge, m.
    pub clearance_m: f64,
    /// Whether the leg passes on the side of the facets that the edge bounds.
    pub is_behind: bool,
    /// Point of the edge nearest to the leg, m.
    pub nearest: DVec3,
    /// Unit vector across leg and edge, away from the facets that the edge bounds.
    pub outwards: DVec3,
}

impl Passage {
    /// Part of the field that the edge diffracts, up to its sign; zero from a normalised distance of `reach` on.
    pub fn diffracted_part(&self, reach: f64) -> Complex64 {
        if self.nu >= reach {
            return Complex64::ZERO;
        }
        side_integral(self.line_nu, self.ends_along) * fade((reach - self.nu) / (reach / 3.0))
    }
}

impl Leg {
    /// Largest distance at which an edge affects the path, anywhere along it, m.
    pub fn path_reach_m(&self, environment: &Environment) -> f64 {
        let wavelength_m = environment.wavelength_m();
        environment.edge_reach() * 0.5 * (0.5 * wavelength_m * self.total_m).sqrt()
    }

    /// Largest distance at which an edge beside this leg affects the path, m. Fresnel zones are widest in the middle of
    /// a path.
    pub fn leg_reach_m(&self, environment: &Environment) -> f64 {
        let wavelength_m = environment.wavelength_m();
        let d1 = (0.5 * self.total_m).max(self.before_m).min(self.before_m + self.length_m);
        let (d1, d2) = (d1.max(LEAST_DISTANCE_M), (self.total_m - d1).max(LEAST_DISTANCE_M));
        environment.edge_reach() * (0.5 * wavelength_m * d1 * d2 / (d1 + d2)).sqrt() + UNSURE_M
    }

    /// Passage of the leg by an edge; `None` where the edge is not beside the leg. `inwards` is the unit vector from
    /// the edge into a facet that it bounds.
    pub fn passage(&self, edge: &DiffractingEdge, inwards: DVec3, wavelength_m: f64) -> Option<Passage> {
        let &Leg { from, direction, length_m, before_m, total_m } = self;
        let along = |p: DVec3| (p - from).dot(direction);
        let across = |v: DVec3| v - direction * v.dot(direction);
        let [(a, is_a_cut), (b, is_b_cut)] = clipped(edge.ends, edge.ends.map(along), length_m)?;
        let (foot_a, step) = (across(a - from), across(b - a));
        let length = step.length();
        if length < 1e-9 {
            return None;
        }
        let unit = step / length;
        // Coordinates of the ends along the edge, from the foot of the perpendicular from the leg.
        let (start, end) = (foot_a.dot(unit), foot_a.dot(unit) + length);
        let nearest = a.lerp(b, (-start / length).clamp(0.0, 1.0));
        let (d1, d2) = (before_m + along(nearest), total_m - before_m - along(nearest));
        let (d1, d2) = (d1.max(LEAST_DISTANCE_M), d2.max(LEAST_DISTANCE_M));
        let nu_per_m = (2.0 * (d1 + d2) / (wavelength_m * d1 * d2)).sqrt();
        let nu = across(nearest - from).length() * nu_per_m;
        let perpendicular = foot_a - unit * start;
        let clearance_m = perpendicular.length();
        let into = across(inwards) - unit * across(inwards).dot(unit);
        let continues = |end: usize, is_cut: bool| is_cut || edge.continues.get(end).copied().unwrap_or(false);
        let low = if continues(0, is_a_cut) { f64::NEG_INFINITY } else { start * nu_per_m };
        let high = if continues(1, is_b_cut) { f64::INFINITY } else { end * nu_per_m };
        Some(Passage {
            nu,
            line_nu: clearance_m * nu_per_m,
            ends_along: [low, high],
            clearance_m,
            is_behind: -perpendicular.dot(into) > 0.0,
            nearest,
            outwards: -into.normalize_or_zero(),
        })
    }
}

/// Ends of the part of an edge beside a leg, each with whether it was cut off. `along_a` and `along_b` are the
/// coordinates of the edge's ends along the leg, m. `None` if no part is beside the leg.
fn clipped([a, b]: [DVec3; 2], [along_a, along_b]: [f64; 2], length_m: f64) -> Option<[(DVec3, bool); 2]> {
    if along_a.max(along_b) <= 0.0 || along_a.min(along_b) >= length_m {
        return None;
    }
    let clip = |end: DVec3, along: f64| {
        let clamped = along.clamp(0.0, length_m);
        if clamped == along {
            return (end, false);
        }
        (a.lerp(b, ((clamped - along_a) / (along_b - along_a)).clamp(0.0, 1.0)), true)
    };
    Some([clip(a, along_a), clip(b, along_b)])
}

/// Smooth step from 0 at 0 to 1 at 1.
pub(super) fn fade(x: f64) -> f64 {
    let x = x.clamp(0.0, 1.0);
    x * x * (3.0 - 2.0 * x)
}
