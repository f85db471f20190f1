//! Reflection of facets of finite size, relative to that of their infinite planes.

use glam::DVec3;
use num_complex::Complex64;

use super::corner_runs::PastCorner;
use super::discovery::ImagePaths;
use super::flat::FacetId;
use super::leg::{Kept, Leg, UNSURE_M, fade};

/// Clearance from an edge below which f64 does not tell the side, m, for a point on a facet or beside it.
const UNSURE_ON_FACET_M: f64 = 1e-8;
/// Normalised distance from the nearest edge from which on a path is clear of edges.
const CLEAR_NU: f64 = 0.5;

/// Reflection of facets relative to that of their infinite planes: of one facet, or of those that meet in a corner.
#[derive(Debug, Clone, Copy)]
pub(super) struct Aperture {
    pub kept: Kept,
    /// Sum of the edges' parts of the field.
    by_edges: Complex64,
    /// Whether the path meets all facets clear of their edges: 1, or less near an edge, and 0 from the edge on.
    inside: f64,
}

impl Aperture {
    /// Combines facets that meet in a corner. Inside, their edges bound one aperture, so their parts of the field add up
    /// (Kirchhoff's approximation): the product has the products of these parts besides.
    pub fn beside(self, other: Aperture) -> Aperture {
        let Kept { field, is_whole } = self.kept.and(other.kept);
        let inside = self.inside * other.inside;
        let field = field - self.by_edges * other.by_edges * inside;
        Aperture { kept: Kept { field, is_whole }, by_edges: self.by_edges + other.by_edges, inside }
    }
}

impl ImagePaths {
    /// Reflection of a facet relative to that of its infinite plane. `corners` are its inner corners beside the path.
    pub(super) fn on_facet<'a>(
        &self,
        facet: FacetId,
        leg: &Leg,
        met: DVec3,
        corners: impl Iterator<Item = &'a PastCorner>,
    ) -> Option<Aperture> {
        let flat = self.environment.flat(facet)?;
        let cosine = flat.normal.dot(leg.direction).abs().max(1e-6);
        if flat.is_far(met, leg.reach_m(&self.environment) / cosine + UNSURE_M) {
            return None;
        }
        let mut is_on = flat.contains(met);
        // The path continues behind the mirror: edges may lie beyond the point of reflection.
        let unfolded = Leg { length_m: leg.total_m - leg.before_m, ..*leg };
        let (wavelength_m, reach) = (self.environment.wavelength_m(), self.environment.edge_reach());
        let mut by_edges = Complex64::ZERO;
        let mut inside = if is_on { 1.0 } else { 0.0 };
        let mut is_left = is_on;
        for corner in corners {
            by_edges += if corner.is_behind { -corner.part } else { corner.part };
            // Such a path is taken to meet the facet at the edge.
            is_on &= !corner.is_beyond;
            let from_edge = if corner.is_behind { fade(corner.nu / CLEAR_NU) } else { 0.0 };
            inside = f64::min(inside, from_edge);
        }
        // On an edge, two facets of a seam each reflect their half of the field.
        let mut is_on_edge = false;
        for &number in &flat.soft {
            let Some(edge) = self.environment.soft_edges().get(number as usize) else { continue };
            // The field that leaves a facet beyond an inner corner meets the next facet, in a separate sequence.
            if !is_on && edge.is_beyond(met) {
                continue;
            }
            let passage = unfolded.past(edge, edge.inwards(facet), wavelength_m);
            let Some(passage) = passage.filter(|passage| passage.nu < reach) else { continue };
            let is_on_line = passage.clearance_m < UNSURE_ON_FACET_M;
            is_on_edge |= is_on_line && passage.along[0] <= 0.0 && passage.along[1] >= 0.0;
            let is_over = if is_on_line { is_on } else { passage.is_behind };
            by_edges += if is_over { -passage.part(reach) } else { passage.part(reach) };
            inside = f64::min(inside, fade(passage.nu / CLEAR_NU));
            is_left |= !is_over;
        }
        let field = by_edges + if is_on { 1.0 } else { 0.0 };
        let kept = Kept { field, is_whole: is_on && !is_on_edge };
        is_left.then_some(Aperture { kept, by_edges, inside })
    }
}
