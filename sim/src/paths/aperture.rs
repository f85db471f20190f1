//! Reflection of facets of finite size, relative to that of their infinite planes.

use glam::DVec3;
use num_complex::Complex64;

use super::corner_runs::CornerPassage;
use super::discovery::ImagePaths;
use super::flat::FacetId;
use super::leg::{Leg, RelativeField, UNSURE_M, fade};

/// Clearance from an edge below which f64 does not tell the side, m, for a point on a facet or beside it.
const UNSURE_ON_FACET_M: f64 = 1e-8;
/// Normalised distance from the nearest edge from which on a path is clear of edges.
const CLEAR_NU: f64 = 0.5;

/// Reflection of facets relative to that of their infinite planes: of one facet, or of those that meet in a corner.
#[derive(Debug, Clone, Copy)]
pub(super) struct Aperture {
    pub relative: RelativeField,
    /// Sum of the edges' parts of the field.
    edge_field: Complex64,
    /// Weight of a path that all facets reflect: 1 clear of their edges, less near an edge, and 0 from the edge on.
    inner_weight: f64,
}

impl Aperture {
    /// Combines facets that meet in a corner. A path inside passes one aperture, which the edges of all facets bound,
    /// so that their parts of the field add up (Kirchhoff's approximation). The product of the facets' fields also has
    /// the products of these parts, which are subtracted.
    pub fn joined(self, other: Aperture) -> Aperture {
        let RelativeField { field, is_geometric } = self.relative.and(other.relative);
        let inner_weight = self.inner_weight * other.inner_weight;
        let field = field - self.edge_field * other.edge_field * inner_weight;
        let relative = RelativeField { field, is_geometric };
        Aperture { relative, edge_field: self.edge_field + other.edge_field, inner_weight }
    }
}

impl ImagePaths {
    /// Reflection of a facet relative to that of its infinite plane; `None` where nothing is left. `reflection_point`
    /// is that of the path in the plane, and `corners` are the facet's inner corners beside the path.
    pub(super) fn facet_aperture<'a>(
        &self,
        facet: FacetId,
        leg: &Leg,
        reflection_point: DVec3,
        corners: impl Iterator<Item = &'a CornerPassage>,
    ) -> Option<Aperture> {
        let flat = self.environment.flat(facet)?;
        let cosine = flat.normal.dot(leg.direction).abs().max(1e-6);
        if flat.is_far(reflection_point, leg.path_reach_m(&self.environment) / cosine + UNSURE_M) {
            return None;
        }
        let mut is_on = flat.contains(reflection_point);
        // The path continues behind the mirror: edges may lie beyond the point of reflection.
        let unfolded = Leg { length_m: leg.total_m - leg.before_m, ..*leg };
        let (wavelength_m, reach) = (self.environment.wavelength_m(), self.environment.edge_reach());
        let mut edge_field = Complex64::ZERO;
        let mut inner_weight = if is_on { 1.0 } else { 0.0 };
        let mut has_field = is_on;
        for corner in corners {
            edge_field += if corner.is_behind { -corner.other_side_part } else { corner.other_side_part };
            // A path that passes beyond the corner's edge is taken to meet the facet at the edge.
            is_on &= !corner.is_beyond;
            let corner_weight = if corner.is_behind { fade(corner.nu / CLEAR_NU) } else { 0.0 };
            inner_weight = f64::min(inner_weight, corner_weight);
        }
        // On an edge, two facets of a seam each reflect their half of the field.
        let mut is_on_edge = false;
        for &number in &flat.edges {
            let Some(edge) = self.environment.diffracting_edges().get(number as usize) else { continue };
            // The field that leaves a facet beyond an inner corner meets the next facet, in a separate sequence.
            if !is_on && edge.is_beyond(reflection_point) {
                continue;
            }
            let passage = unfolded.passage(edge, edge.inwards(facet), wavelength_m);
            let Some(passage) = passage.filter(|passage| passage.nu < reach) else { continue };
            let is_on_line = passage.clearance_m < UNSURE_ON_FACET_M;
            is_on_edge |= is_on_line && passage.ends_along[0] <= 0.0 && passage.ends_along[1] >= 0.0;
            let is_behind = if is_on_line { is_on } else { passage.is_behind };
            let part = passage.diffracted_part(reach);
            edge_field += if is_behind { -part } else { part };
            inner_weight = f64::min(inner_weight, fade(passage.nu / CLEAR_NU));
            has_field |= !is_behind;
        }
        let field = edge_field + if is_on { 1.0 } else { 0.0 };
        let relative = RelativeField { field, is_geometric: is_on && !is_on_edge };
        has_field.then_some(Aperture { relative, edge_field, inner_weight })
    }
}
