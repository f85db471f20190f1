//! Spatial index of edges: rows of sixteen edges, and a tree of rows of sixteen boxes above them. With it, a path is tested
//! against a few of thousands of edges.

use glam::DVec3;
use radome_dsp::KernelLevel;

use super::edges::DiffractingEdge;
use crate::lanes::{LANES, Row, Row3, compiled_for_levels, lane};

/// Margin of all distances, because positions are in single precision, as a part of the largest coordinate.
const MARGIN: f64 = 1e-5;
/// Place of lanes without an edge, m: far from everything, and its square is finite in single precision.
const NOWHERE_M: DVec3 = DVec3::splat(1e15);

/// Boxes, one in each lane.
#[derive(Debug, Clone)]
struct Boxes {
    low: Row3,
    high: Row3,
}

/// Ends of edges, one edge in each lane, m.
type Ends = [Row3; 2];

/// Tree of boxes over edges.
#[derive(Debug, Clone)]
pub(super) struct EdgeIndex {
    /// Numbers of the edges. Neighbours in space are near each other.
    order: Vec<u32>,
    /// Edges in that order.
    edges: Vec<Ends>,
    /// Boxes by levels, the largest last. A box of the first level surrounds a row of edges, and one of any other level a row
    /// of the level before it.
    levels: Vec<Vec<Boxes>>,
    /// Largest coordinate of an edge, m.
    scale_m: f64,
    kernel_level: KernelLevel,
}

/// Straight segment that edges are near to, in single precision.
#[derive(Debug, Clone, Copy)]
struct Segment {
    from: [f32; 3],
    direction: [f32; 3],
    length_m: f32,
    /// Distance within which edges are searched, with the margin, m.
    distance_m: f32,
    margin_m: f32,
    /// Inverses of the vector from its beginning to its end, 1/m; large where a component is zero.
    per_m: [f32; 3],
}

impl EdgeIndex {
    /// Builds a tree over edges, which are identified by their numbers.
    pub fn new(edges: &[DiffractingEdge]) -> Self {
        let mut order: Vec<u32> = (0..edges.len() as u32).collect();
        let ends_of = |edge: u32| edges.get(edge as usize).map_or([NOWHERE_M; 2], |edge| edge.ends);
        sort_in_space(&mut order, &ends_of);
        let row = |numbers: &[u32]| {
            let ends = |l: usize| numbers.get(l).map_or([NOWHERE_M; 2], |&edge| ends_of(edge));
            [0, 1].map(|end| rows(|l| ends(l)[end]))
        };
        let boxes = |numbers: &[u32]| {
            let ends = numbers.iter().flat_map(|&edge| ends_of(edge));
            ends.fold([DVec3::INFINITY, DVec3::NEG_INFINITY], |[low, high], end| [low.min(end), high.max(end)])
        };
        let mut below: Vec<[DVec3; 2]> = order.chunks(LANES).map(boxes).collect();
        let mut levels = Vec::new();
        while below.len() > 1 {
            levels.push(below.chunks(LANES).map(Boxes::new).collect());
            let union = |all: &[[DVec3; 2]]| {
                all.iter().copied().reduce(|a, b| [a[0].min(b[0]), a[1].max(b[1])]).unwrap_or_default()
            };
            below = below.chunks(LANES).map(union).collect();
        }
        let scale_m =
            edges.iter().flat_map(|edge| edge.ends).fold(0.0, |most: f64, end| most.max(end.abs().max_element()));
        let edges = order.chunks(LANES).map(row).collect();
        EdgeIndex { order, edges, levels, scale_m, kernel_level: KernelLevel::detect() }
    }

    /// Finds the numbers of all edges that are near a straight segment ([`DiffractingEdge::is_near`]) and of a few more, ascending.
    pub fn near(&self, from: DVec3, to: DVec3, distance_m: f64, found: &mut Vec<u32>) {
        found.clear();
        let scale_m = self.scale_m.max(from.abs().max_element()).max(to.abs().max_element());
        near(self.kernel_level, self, &Segment::new(from, to, distance_m, MARGIN * scale_m), found);
        found.sort_unstable();
    }

    /// Adds the edges near a segment, in any order.
    #[inline(always)]
    fn visit(&self, segment: &Segment, found: &mut Vec<u32>) {
        // Rows that are still to be tested, with their levels above the edges. Each level has at most one row's boxes here.
        let mut pending: [(u32, u32); MOST_PENDING] = [(0, 0); MOST_PENDING];
        let mut count = usize::from(!self.edges.is_empty());
        pending[0] = (self.levels.len() as u32, 0);
        while count > 0 {
            count -= 1;
            let (level, row) = pending.get(count).copied().unwrap_or_default();
            let first = row as usize * LANES;
            if level == 0 {
                let Some(ends) = self.edges.get(row as usize) else { continue };
                let mut lanes = edges_near(ends, segment);
                while lanes != 0 {
                    found.extend(self.order.get(first + lanes.trailing_zeros() as usize));
                    lanes &= lanes - 1;
                }
                continue;
            }
            let boxes = self.levels.get(level as usize - 1).and_then(|boxes| boxes.get(row as usize));
            let Some(boxes) = boxes else { continue };
            let mut lanes = boxes_met(boxes, segment);
            while lanes != 0 {
                if let Some(slot) = pending.get_mut(count) {
                    *slot = (level - 1, first as u32 + lanes.trailing_zeros());
                    count += 1;
                }
                lanes &= lanes - 1;
            }
        }
    }
}

/// Largest number of pending rows in a search: those of eight levels, over 2^32 edges.
const MOST_PENDING: usize = 8 * LANES;

impl Segment {
    fn new(from: DVec3, to: DVec3, distance_m: f64, margin_m: f64) -> Self {
        let along = to - from;
        let length_m = along.length();
        Segment {
            from: from.as_vec3().to_array(),
            direction: (along / length_m.max(f64::MIN_POSITIVE)).as_vec3().to_array(),
            length_m: length_m as f32,
            margin_m: margin_m as f32,
            distance_m: (distance_m + margin_m) as f32,
            per_m: along
                .to_array()
                .map(|component| if component.abs() < 1e-12 { 1e12 } else { 1.0 / component } as f32),
        }
    }
}

impl Boxes {
    /// Boxes by their corners.
    fn new(corners: &[[DVec3; 2]]) -> Self {
        let corner = |end: usize, l: usize| corners.get(l).map_or(NOWHERE_M, |both| both[end]);
        Boxes { low: rows(|l| corner(0, l)), high: rows(|l| corner(1, l)) }
    }
}

/// Vectors by lanes.
fn rows(vector: impl Fn(usize) -> DVec3) -> Row3 {
    [0, 1, 2].map(|axis| std::array::from_fn(|l| vector(l)[axis] as f32))
}

/// Sorts edges so that any sixteen, and any power of sixteen, of successive ones are near each other.
fn sort_in_space(order: &mut [u32], ends_of: &impl Fn(u32) -> [DVec3; 2]) {
    if order.len() <= LANES {
        return;
    }
    let middle = |edge: u32| ends_of(edge).iter().sum::<DVec3>();
    let [low, high] = order
        .iter()
        .map(|&edge| middle(edge))
        .fold([DVec3::INFINITY, DVec3::NEG_INFINITY], |[low, high], m| [low.min(m), high.max(m)]);
    let axis = (high - low).max_position();
    order.sort_by(|&p, &q| middle(p)[axis].total_cmp(&middle(q)[axis]).then(p.cmp(&q)));
    // Halves consist of whole rows.
    let half = (order.len() / 2).next_multiple_of(LANES);
    let (first, second) = order.split_at_mut(half.min(order.len()));
    sort_in_space(first, ends_of);
    sort_in_space(second, ends_of);
}

compiled_for_levels! {
    fn near(index: &EdgeIndex, segment: &Segment, found: &mut Vec<u32>) = EdgeIndex::visit;
}

/// Returns the lanes whose boxes, enlarged by the segment's distance, the segment meets, as bits.
#[inline(always)]
fn boxes_met(boxes: &Boxes, segment: &Segment) -> u32 {
    let mut entry: Row = [0.0; LANES];
    let mut exit: Row = [1.0; LANES];
    for axis in 0..3 {
        let (from, per_m) = (segment.from[axis], segment.per_m[axis]);
        for l in 0..LANES {
            let a = (boxes.low[axis][l] - segment.distance_m - from) * per_m;
            let b = (boxes.high[axis][l] + segment.distance_m - from) * per_m;
            let (first, last) = if a < b { (a, b) } else { (b, a) };
            entry[l] = if first > entry[l] { first } else { entry[l] };
            exit[l] = if last < exit[l] { last } else { exit[l] };
        }
    }
    let mut lanes = 0;
    for l in 0..LANES {
        lanes |= u32::from(entry[l] <= exit[l]) << l;
    }
    lanes
}

/// Returns the lanes whose edges are near a segment, as bits. The method is that of [`DiffractingEdge::is_near`].
#[inline(always)]
fn edges_near(ends: &Ends, segment: &Segment) -> u32 {
    let Segment { from, direction: d, length_m, distance_m, margin_m, .. } = *segment;
    let mut lanes = 0;
    let mut is_near = [0u32; LANES];
    for l in 0..LANES {
        let ([ax, ay, az], [bx, by, bz]) = (lane(&ends[0], l), lane(&ends[1], l));
        let (a, b) = ([ax - from[0], ay - from[1], az - from[2]], [bx - from[0], by - from[1], bz - from[2]]);
        let at_a = a[0] * d[0] + a[1] * d[1] + a[2] * d[2];
        let at_b = b[0] * d[0] + b[1] * d[1] + b[2] * d[2];
        let foot = [a[0] - d[0] * at_a, a[1] - d[1] * at_a, a[2] - d[2] * at_a];
        let step = [b[0] - d[0] * at_b - foot[0], b[1] - d[1] * at_b - foot[1], b[2] - d[2] * at_b - foot[2]];
        let square = step[0] * step[0] + step[1] * step[1] + step[2] * step[2];
        let along = -(foot[0] * step[0] + foot[1] * step[1] + foot[2] * step[2]) / (square + f32::MIN_POSITIVE);
        let fraction = along.clamp(0.0, 1.0);
        let [x, y, z] = [foot[0] + step[0] * fraction, foot[1] + step[1] * fraction, foot[2] + step[2] * fraction];
        let (nearest, farthest) = if at_a < at_b { (at_a, at_b) } else { (at_b, at_a) };
        let is_beside = (farthest >= -margin_m) & (nearest <= length_m + margin_m);
        is_near[l] = u32::from(is_beside & (x * x + y * y + z * z <= distance_m * distance_m));
    }
    for (l, is_near) in is_near.iter().enumerate() {
        lanes |= is_near << l;
    }
    lanes
}

#[cfg(test)]
mod tests {
    use rand::{Rng, SeedableRng};
    use rand_xoshiro::Xoshiro256PlusPlus;

    use super::super::environment::{Environment, Facet};
    use super::*;
    use crate::em::image::Wall;

    #[test]
    fn all_edges_near_a_segment_are_found() {
        for (triangles, corner_m) in [(1, 0.0), (5, 0.0), (90, -5.0), (200, 2000.0), (1400, 0.0)] {
            all_edges_of_triangles_are_found(triangles, corner_m);
        }
    }

    /// Segments are along an axis or not. All coordinates are from `corner_m` to 10 m more.
    fn all_edges_of_triangles_are_found(triangles: usize, corner_m: f64) {
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(triangles as u64);
        let mut position = || DVec3::from_array(std::array::from_fn(|_| corner_m + rng.random_range(0.0..10.0)));
        let triangle = |at: DVec3| {
            let corners = [at, at + DVec3::X * 0.3, at + DVec3::new(0.1, 0.2, 0.15)];
            Facet::new(corners.to_vec(), Wall::Conductor)
        };
        let facets: Vec<Facet> = (0..triangles).map(|_| triangle(position())).collect();
        let environment = Environment::new(facets, 1257.0).expect("facets");
        let edges = environment.diffracting_edges();
        let (mut found, mut all, mut more) = (Vec::new(), 0, 0);
        for i in 0..60 {
            let (from, distance_m) = (position(), 0.3);
            let to = if i % 3 == 0 { from + DVec3::AXES[i / 3 % 3] * 5.0 } else { position() };
            environment.edges_near(from, to, distance_m, &mut found);
            assert!(found.windows(2).all(|two| two[0] < two[1]));
            let (direction, length_m) = ((to - from).normalize(), from.distance(to));
            let is_near =
                |distance_m: f64| move |edge: &DiffractingEdge| edge.is_near(from, direction, length_m, distance_m);
            let numbered = || (0..).zip(edges);
            let near: Vec<u32> = numbered().filter(|(_, e)| is_near(distance_m)(e)).map(|(number, _)| number).collect();
            assert!(near.iter().all(|number| found.contains(number)), "{near:?} {found:?}");
            all += near.len();
            more += found.len() - near.len();
        }
        // Single precision adds more far from the origin.
        assert!(more <= 1 + all / 4, "{more} beside {all}");
    }
}
