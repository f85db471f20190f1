//! Legs of paths, the straight pieces between two reflections, and how they pass an edge.

use glam::DVec3;
use num_complex::Complex64;

use super::edge_field::side_between;
use super::edges::SoftEdge;
use super::environment::Environment;

/// Lower limit of the distance from an edge to the ends of a path, m.
const LEAST_DISTANCE_M: f64 = 1e-3;
/// Clearance from an edge below which the ray decides whether a path is free, and not f64, m: rays are traced in f32.
pub(super) const UNSURE_M: f64 = 5e-5;
/// Distance from an edge at which a leg from it begins, m.
const OFF_EDGE_M: f64 = 1e-4;

/// Relative field that remains.
#[derive(Debug, Clone, Copy)]
pub(super) struct Kept {
    /// Relative field.
    pub field: Complex64,
    /// Whether rays also take this path, so that edges change the field only a little.
    pub is_whole: bool,
}

impl Kept {
    /// Combines two successive relative fields.
    pub fn and(self, other: Kept) -> Kept {
        Kept { field: self.field * other.field, is_whole: self.is_whole && other.is_whole }
    }
}

/// Straight piece of a path.
#[derive(Debug, Clone, Copy)]
pub(super) struct Leg {
    pub from: DVec3,
    pub direction: DVec3,
    pub length_m: f64,
    /// Length of the path before it, m.
    pub before_m: f64,
    /// Length of the whole path, m.
    pub total_m: f64,
}

impl Leg {
    /// Returns the same leg from a little farther on. A leg behind one without length begins on two facets. It may
    /// leave the second one alone, and the back of the first would then block it.
    pub fn off_edge(&self) -> Leg {
        let off_m = OFF_EDGE_M.min(0.5 * self.length_m);
        Leg { from: self.from + self.direction * off_m, length_m: self.length_m - off_m, ..*self }
    }
}

/// Passage of a leg by an edge.
pub(super) struct Passage {
    /// Normalised distance of the leg from the edge and from the edge's line, and normalised places of the edge's ends
    /// along that line.
    pub nu: f64,
    pub nu_of_line: f64,
    pub along: [f64; 2],
    /// Distance of the leg from the line of the edge, m.
    pub clearance_m: f64,
    /// Whether the leg passes on the side of the facets that the edge bounds.
    pub is_behind: bool,
    /// Nearest point of the edge, m, and the direction across the leg away from the facets that the edge bounds.
    pub nearest: DVec3,
    pub outwards: DVec3,
}

impl Passage {
    /// Contribution of the edge to the field, up to its sign; zero from a normalised clearance of `reach` on.
    pub fn part(&self, reach: f64) -> Complex64 {
        if self.nu >= reach {
            return Complex64::ZERO;
        }
        side_between(self.nu_of_line, self.along) * fade((reach - self.nu) / (reach / 3.0))
    }
}

impl Leg {
    /// Largest distance at which an edge affects the path, anywhere along it, m.
    pub fn reach_m(&self, environment: &Environment) -> f64 {
        let wavelength_m = environment.wavelength_m();
        environment.edge_reach() * 0.5 * (0.5 * wavelength_m * self.total_m).sqrt()
    }

    /// Same limit for edges beside this leg: Fresnel zones are widest in the middle of a path.
    pub fn own_reach_m(&self, environment: &Environment) -> f64 {
        let wavelength_m = environment.wavelength_m();
        let d1 = (0.5 * self.total_m).max(self.before_m).min(self.before_m + self.length_m);
        let (d1, d2) = (d1.max(LEAST_DISTANCE_M), (self.total_m - d1).max(LEAST_DISTANCE_M));
        environment.edge_reach() * (0.5 * wavelength_m * d1 * d2 / (d1 + d2)).sqrt() + UNSURE_M
    }

    /// Computes the passage; `None` where the edge is not beside the leg.
    pub fn past(&self, edge: &SoftEdge, inwards: DVec3, wavelength_m: f64) -> Option<Passage> {
        let &Leg { from, direction, length_m, before_m, total_m } = self;
        let along = |p: DVec3| (p - from).dot(direction);
        let across = |v: DVec3| v - direction * v.dot(direction);
        let [(a, cut_a), (b, cut_b)] = clipped(edge.ends, edge.ends.map(along), length_m)?;
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
        let goes_on = |end: usize, cut: bool| cut || edge.goes_on.get(end).copied().unwrap_or(false);
        let low = if goes_on(0, cut_a) { f64::NEG_INFINITY } else { start * nu_per_m };
        let high = if goes_on(1, cut_b) { f64::INFINITY } else { end * nu_per_m };
        Some(Passage {
            nu,
            nu_of_line: clearance_m * nu_per_m,
            along: [low, high],
            clearance_m,
            is_behind: -perpendicular.dot(into) > 0.0,
            nearest,
            outwards: -into.normalize_or_zero(),
        })
    }
}

/// The part of an edge beside a leg, and whether each end was cut.
fn clipped([a, b]: [DVec3; 2], [at_a, at_b]: [f64; 2], length_m: f64) -> Option<[(DVec3, bool); 2]> {
    if at_a.max(at_b) <= 0.0 || at_a.min(at_b) >= length_m {
        return None;
    }
    let cut = |end: DVec3, at: f64| {
        let within = at.clamp(0.0, length_m);
        if within == at { (end, false) } else { (a.lerp(b, ((within - at_a) / (at_b - at_a)).clamp(0.0, 1.0)), true) }
    };
    Some([cut(a, at_a), cut(b, at_b)])
}

/// Smooth step from 0 at 0 to 1 at 1.
pub(super) fn fade(x: f64) -> f64 {
    let x = x.clamp(0.0, 1.0);
    x * x * (3.0 - 2.0 * x)
}
