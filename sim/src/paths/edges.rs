//! Diffracting edges: free edges of sheets, outward corners, and seams of two walls in one plane. Seams of one wall do
//! not diffract, because the next facet reflects what the previous one loses. Inner corners are in `corner_runs.rs`.

use glam::DVec3;

use super::flat::{FacetId, Flat};
use super::groups::groups;
use crate::geometry::polygon;

/// Largest distance of a point from a plane in which it lies, m.
pub(super) const SAME_M: f64 = 1e-6;
/// Ends of edges nearer to each other than this coincide, m: the welding tolerance of mesh vertices, and a fiftieth of
/// a wavelength.
const SAME_END_M: f64 = 1e-4;
/// Sine of the angle up to which two facets are coplanar.
const FLAT: f64 = 1e-6;
/// Sine of the angle between a path and a facet up to which the path lies in the facet's plane.
const GRAZING: f64 = 1e-9;
/// Extent of a facet across a path, as a part of its own extent, up to which the path sees the facet edge-on.
const EDGE_ON: f64 = 1e-4;

/// Edge that diffracts.
#[derive(Debug, Clone, PartialEq)]
pub struct DiffractingEdge {
    /// Ends, m.
    pub ends: [DVec3; 2],
    /// Whether the edge continues beyond each end, as an edge between floor and ceiling does in their mirror images. It
    /// does not continue beyond an end at which another diffracting edge begins.
    pub continues: [bool; 2],
    facets: Vec<FacetId>,
    planes: Vec<u32>,
    /// Unit vectors from the edge into each of its facets.
    inwards: Vec<DVec3>,
    normals: Vec<DVec3>,
    middle: DVec3,
    reach_m: f64,
}

impl DiffractingEdge {
    /// Edge of an inner corner, with its facets and the unit vectors from it into them. It continues beyond an end if
    /// `may_continue` allows it and no diffracting edge of these facets ends there. `all` are the diffracting edges by
    /// their numbers.
    pub(super) fn of_corner(
        ends: [DVec3; 2],
        sides: [(FacetId, &Flat, DVec3); 2],
        all: &[DiffractingEdge],
        may_continue: [bool; 2],
    ) -> Self {
        let edges = || sides.iter().flat_map(|(_, flat, _)| &flat.edges).filter_map(|&number| all.get(number as usize));
        let is_end = |end: DVec3| {
            let is_same = |other: &DVec3| other.distance_squared(end) < SAME_END_M * SAME_END_M;
            edges().flat_map(|edge| &edge.ends).any(is_same)
        };
        DiffractingEdge {
            ends,
            continues: [0, 1].map(|i| may_continue[i] && !is_end(ends[i])),
            facets: sides.iter().map(|&(facet, ..)| facet).collect(),
            planes: sides.iter().map(|(_, flat, _)| flat.plane).collect(),
            inwards: sides.iter().map(|&(.., inwards)| inwards).collect(),
            normals: sides.iter().map(|(_, flat, _)| flat.normal).collect(),
            middle: 0.5 * (ends[0] + ends[1]),
            reach_m: 0.5 * ends[0].distance(ends[1]),
        }
    }

    /// Facets that the edge bounds.
    pub fn facets(&self) -> &[FacetId] {
        &self.facets
    }

    /// Returns whether the edge bounds a facet in a plane.
    pub(super) fn bounds_plane(&self, plane: u32) -> bool {
        self.planes.contains(&plane)
    }

    /// Returns whether no point of the edge lies before a facet. It is then beside no path that ends on the facet.
    pub(super) fn is_behind(&self, flat: &Flat) -> bool {
        self.ends.iter().all(|end| flat.height(*end) <= SAME_M)
    }

    /// Unit vector from the edge into one of its facets.
    pub(super) fn inwards(&self, facet: FacetId) -> DVec3 {
        let number = self.facets.iter().position(|f| *f == facet).unwrap_or(0);
        self.inwards.get(number).copied().unwrap_or(DVec3::ZERO)
    }

    /// Returns whether another facet begins at the edge before a facet with this normal. The backs of both may still
    /// form a wedge, if both are sheets.
    pub(super) fn is_inner_before(&self, normal: DVec3) -> bool {
        self.inwards.iter().any(|inwards| inwards.dot(normal) > FLAT)
    }

    /// Unit vector from the edge into that of its facets that extends farthest across a direction.
    pub(super) fn widest_inwards(&self, direction: DVec3) -> DVec3 {
        let across = direction.cross(self.ends[1] - self.ends[0]);
        let width = |inwards: &DVec3| inwards.dot(across).abs();
        let widest = self.inwards.iter().max_by(|a, b| width(a).total_cmp(&width(b)));
        widest.copied().unwrap_or(DVec3::ZERO)
    }

    /// Facets of the edge, each with whether it lies on the side to which a unit vector across a path points.
    pub(super) fn sides_of(&self, outwards: DVec3) -> impl Iterator<Item = (FacetId, bool)> + '_ {
        self.facets.iter().zip(&self.inwards).map(move |(&facet, inwards)| (facet, inwards.dot(outwards) > EDGE_ON))
    }

    /// Returns whether the edge lies on the outline of its facets, seen from a point along a direction. A free edge
    /// always does. A corner does if one of its facets is seen from the front and the other from behind. A corner of
    /// two sheets has no outline for a point between the sheets.
    pub(super) fn is_on_outline(&self, from: DVec3, direction: DVec3) -> bool {
        // A path within rounding of a facet's plane counts as in the plane, and sees both of its edges.
        let cosine =
            |normal: &DVec3| Some(direction.dot(*normal)).filter(|cosine| cosine.abs() > GRAZING).unwrap_or(0.0);
        match (self.normals.as_slice(), self.inwards.as_slice()) {
            ([a, b], _) if a.dot(*b) > FLAT - 1.0 => cosine(a) * cosine(b) <= 0.0,
            ([_, _, _, ..], [first, others @ ..]) => {
                let second = others.iter().find(|inwards| inwards.cross(*first).length_squared() > FLAT * FLAT);
                second.is_none_or(|second| !self.is_between(first, second, from))
            }
            _ => true,
        }
    }

    /// Returns whether a point lies between two sheets that begin at the edge and enclose less than a straight angle.
    fn is_between(&self, first: &DVec3, second: &DVec3, point: DVec3) -> bool {
        let axis = first.cross(*second);
        let offset = point - self.ends[0];
        // Signs of the point's components along both sheets.
        offset.cross(*second).dot(axis) > 0.0 && first.cross(offset).dot(axis) > 0.0
    }

    /// Returns whether a point lies beyond an end at which the edge continues in mirror images.
    pub(super) fn is_beyond(&self, point: DVec3) -> bool {
        let [a, b] = self.ends;
        let fraction = (point - a).dot(b - a) / a.distance_squared(b);
        self.continues[0] && fraction < 0.0 || self.continues[1] && fraction > 1.0
    }

    /// Returns whether part of the edge may be within a distance, m, of a straight segment. This includes extensions
    /// beyond an end of an edge beside the segment.
    pub(super) fn is_near(&self, from: DVec3, direction: DVec3, length_m: f64, distance_m: f64) -> bool {
        let along = (self.middle - from).dot(direction).clamp(0.0, length_m);
        let apart_m2 = self.middle.distance_squared(from + direction * along);
        let reach_m = self.reach_m + distance_m;
        if apart_m2 > reach_m * reach_m {
            return false;
        }
        // Coordinates along the segment, from its origin.
        let [a, b] = self.ends.map(|end| end - from);
        let (at_a, at_b) = (a.dot(direction), b.dot(direction));
        if at_a.max(at_b) <= 0.0 || at_a.min(at_b) >= length_m {
            return false;
        }
        let foot = a - direction * at_a;
        let step = b - direction * at_b - foot;
        let fraction = (-foot.dot(step) / step.length_squared().max(f64::MIN_POSITIVE)).clamp(0.0, 1.0);
        (foot + step * fraction).length_squared() <= distance_m * distance_m
    }
}

/// Side of a facet.
struct Side {
    facet: FacetId,
    ends: [DVec3; 2],
    /// Unit vector from the side into the facet.
    inwards: DVec3,
    /// Whether the side diffracts, if its facet specifies that.
    diffracts: Option<bool>,
}

/// All sides of facets that reflect.
fn sides(flats: &[Flat]) -> Vec<Side> {
    let mut all = Vec::new();
    for (number, flat) in flats.iter().enumerate().filter(|(_, flat)| flat.reflects()) {
        let mut add = |corners: &[DVec3], inward_sign: f64, diffracting: &[bool]| {
            for (i, [a, b]) in polygon::sides(corners).enumerate() {
                let inwards = flat.normal.cross((b - a).normalize_or_zero()) * inward_sign;
                let diffracts = diffracting.get(i).copied();
                all.push(Side { facet: number as FacetId, ends: [a, b], inwards, diffracts });
            }
        };
        add(&flat.facet.corners, 1.0, &flat.facet.diffracting_sides);
        for (i, hole) in flat.facet.holes.iter().enumerate() {
            add(hole, if flat.is_counter_clockwise(i) { -1.0 } else { 1.0 }, &[]);
        }
    }
    all
}

/// Groups sides that coincide, in either direction.
fn coincident(sides: &[Side]) -> Vec<Vec<usize>> {
    let middles: Vec<f64> = sides.iter().map(|side| 0.5 * (side.ends[0].x + side.ends[1].x)).collect();
    let is_same = |p: DVec3, q: DVec3| p.distance_squared(q) < SAME_END_M * SAME_END_M;
    groups(&middles, SAME_END_M, |i, j| {
        let ([a, b], [c, d]) = (sides[i].ends, sides[j].ends);
        is_same(a, c) && is_same(b, d) || is_same(a, d) && is_same(b, c)
    })
}

/// Kind of junction of two facets at an edge.
#[derive(PartialEq)]
enum Junction {
    /// Free edge: the facets end there back to back.
    Sheet,
    /// Outward corner.
    Outward,
    /// Seam of two different walls in one plane.
    Seam,
    /// Inner corner, or seam of one wall.
    Inner,
}

/// Kind of junction of two coincident sides.
fn junction(flats: &[Flat], a: &Side, b: &Side) -> Junction {
    let (Some(flat_a), Some(flat_b)) = (flats.get(a.facet as usize), flats.get(b.facet as usize)) else {
        return Junction::Inner;
    };
    // Rise of each facet over the plane of the other, before its front.
    let (rise_b, rise_a) = (b.inwards.dot(flat_a.normal), a.inwards.dot(flat_b.normal));
    let is_coplanar = rise_a.abs() <= FLAT && rise_b.abs() <= FLAT;
    let is_one_side = a.inwards.dot(b.inwards) > 0.0;
    if rise_a < -FLAT && rise_b < -FLAT {
        Junction::Outward
    } else if is_coplanar && is_one_side && flat_a.normal.dot(flat_b.normal) < 0.0 {
        Junction::Sheet
    } else if is_coplanar && !is_one_side && flat_a.facet.wall != flat_b.facet.wall {
        Junction::Seam
    } else {
        Junction::Inner
    }
}

/// Returns whether an edge lies on a facet of another plane, as the lower edge of a partition lies on the floor.
fn lies_on_another(flats: &[Flat], sides: &[&Side]) -> bool {
    let Some(first) = sides.first() else { return false };
    let middle = 0.5 * (first.ends[0] + first.ends[1]);
    let own_planes: Vec<u32> =
        sides.iter().filter_map(|s| flats.get(s.facet as usize)).map(|flat| flat.plane).collect();
    flats.iter().any(|flat| {
        let on_plane = |p: DVec3| flat.height(p).abs() < SAME_M;
        flat.reflects()
            && !own_planes.contains(&flat.plane)
            && on_plane(first.ends[0])
            && on_plane(first.ends[1])
            && flat.contains(middle)
    })
}

/// Returns whether an edge of these sides diffracts.
fn is_diffracting(flats: &[Flat], sides: &[&Side]) -> bool {
    if sides.iter().any(|side| side.diffracts.is_some()) {
        return sides.iter().any(|side| side.diffracts == Some(true));
    }
    let mut is_diffracting = false;
    for (i, a) in sides.iter().enumerate() {
        for b in sides.iter().skip(i + 1) {
            match junction(flats, a, b) {
                Junction::Inner => return false,
                Junction::Outward | Junction::Seam => is_diffracting = true,
                Junction::Sheet => {}
            }
        }
    }
    is_diffracting || !lies_on_another(flats, sides)
}

/// Finds the diffracting edges of facets.
pub(super) fn find_diffracting_edges(flats: &[Flat]) -> Vec<DiffractingEdge> {
    let sides = sides(flats);
    let mut groups = coincident(&sides);
    groups.iter_mut().for_each(|group| group.sort_unstable());
    groups.sort();
    let mut edges: Vec<DiffractingEdge> = Vec::new();
    for group in groups {
        let members: Vec<&Side> = group.iter().filter_map(|&i| sides.get(i)).collect();
        let Some(first) = members.first().filter(|_| is_diffracting(flats, &members)) else { continue };
        let flat_of = |side: &&Side| flats.get(side.facet as usize);
        edges.push(DiffractingEdge {
            ends: first.ends,
            continues: [true; 2],
            facets: members.iter().map(|side| side.facet).collect(),
            planes: members.iter().filter_map(flat_of).map(|flat| flat.plane).collect(),
            inwards: members.iter().map(|side| side.inwards).collect(),
            normals: members.iter().filter_map(flat_of).map(|flat| flat.normal).collect(),
            middle: 0.5 * (first.ends[0] + first.ends[1]),
            reach_m: 0.5 * first.ends[0].distance(first.ends[1]),
        });
    }
    let are_shared = shared_ends(&edges);
    for (edge, is_shared) in edges.iter_mut().zip(are_shared) {
        edge.continues = is_shared.map(|is_shared| !is_shared);
    }
    edges
}

/// Returns, for each end of each edge, whether another edge has an end there.
fn shared_ends(edges: &[DiffractingEdge]) -> Vec<[bool; 2]> {
    /// End of an edge: position, number of the edge, and index of the end.
    type End = (DVec3, usize, usize);
    let mut ends: Vec<End> =
        edges.iter().enumerate().flat_map(|(i, edge)| [(edge.ends[0], i, 0), (edge.ends[1], i, 1)]).collect();
    ends.sort_by(|(p, i, end), (q, j, other_end)| p.x.total_cmp(&q.x).then((i, end).cmp(&(j, other_end))));
    let mut are_shared = vec![[false; 2]; edges.len()];
    for (number, &(position, i, end)) in ends.iter().enumerate() {
        let near = ends.iter().skip(number + 1).take_while(|(other, ..)| other.x - position.x < SAME_END_M);
        for &(other_position, j, other_end) in near {
            if j != i && other_position.distance_squared(position) < SAME_END_M * SAME_END_M {
                for (edge, end) in [(i, end), (j, other_end)] {
                    if let Some(slot) = are_shared.get_mut(edge).and_then(|ends| ends.get_mut(end)) {
                        *slot = true;
                    }
                }
            }
        }
    }
    are_shared
}
