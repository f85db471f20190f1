//! Pairs of facets that meet in a corner. A wave that both reflect one after the other passes one aperture, which the
//! edges of both bound.

use glam::DVec3;

use super::environment::Environment;
use super::flat::{FacetId, Flat, PLANAR_M};
use crate::geometry::polygon;

/// Largest cosine between the normals of facets that make a corner.
const MOST_COSINE: f64 = 0.99;

/// Pairs of facets that share an edge or a part of one and occur together in some sequence.
#[derive(Debug, Clone, Default)]
pub(super) struct Corners(Vec<(FacetId, FacetId)>);

impl Corners {
    /// Finds the pairs in these sequences.
    pub fn in_sequences<'a>(environment: &Environment, sequences: impl Iterator<Item = &'a Vec<FacetId>>) -> Self {
        let mut all = Vec::new();
        for sequence in sequences {
            for (number, &facet) in sequence.iter().enumerate() {
                all.extend(sequence.iter().skip(number + 1).map(|&other| in_order(facet, other)));
            }
        }
        all.sort_unstable();
        all.dedup();
        all.retain(|&(a, b)| match (environment.flat(a), environment.flat(b)) {
            (Some(a), Some(b)) => make_corner(a, b),
            _ => false,
        });
        Corners(all)
    }

    /// Returns whether two facets meet in a corner.
    pub fn contains(&self, a: FacetId, b: FacetId) -> bool {
        self.0.binary_search(&in_order(a, b)).is_ok()
    }
}

fn in_order(a: FacetId, b: FacetId) -> (FacetId, FacetId) {
    (a.min(b), a.max(b))
}

/// Returns whether two facets make a corner: a side of one lies on the other, and they are not nearly parallel.
fn make_corner(a: &Flat, b: &Flat) -> bool {
    a.normal.dot(b.normal).abs() < MOST_COSINE && (side_on(a, b).is_some() || side_on(b, a).is_some())
}

/// Returns the side of a facet that lies in the plane of another facet and has its middle on that, if there is one. It
/// is cut to the part in common with a side of the other facet on the same line, if there is such a side.
pub(super) fn side_on(one: &Flat, other: &Flat) -> Option<[DVec3; 2]> {
    let lies_on = |p: DVec3, q: DVec3| {
        other.height(p).abs() < PLANAR_M && other.height(q).abs() < PLANAR_M && other.contains(0.5 * (p + q))
    };
    let [p, q] = polygon::sides(&one.facet.corners).find(|&[p, q]| lies_on(p, q))?;
    let (length_m, along) = (p.distance(q), (q - p).normalize_or_zero());
    let common = |[r, s]: [DVec3; 2]| {
        let is_on_line = |end: DVec3| (end - p).cross(along).length_squared() < PLANAR_M * PLANAR_M;
        let [from, to] = [r, s].map(|end| (end - p).dot(along));
        let (from, to) = (from.min(to).max(0.0), from.max(to).min(length_m));
        (is_on_line(r) && is_on_line(s) && to - from > PLANAR_M).then_some([p + along * from, p + along * to])
    };
    Some(polygon::sides(&other.facet.corners).find_map(common).unwrap_or([p, q]))
}
