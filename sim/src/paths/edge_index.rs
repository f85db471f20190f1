//! Spatial index of edges: a tree of boxes. With it, a path is tested against a few of thousands of edges.

use glam::DVec3;

use super::edges::DiffractingEdge;

/// Largest number of edges in a box that is not divided.
const LEAF_EDGES: usize = 4;
/// Largest number of pending boxes in a search: the depth of a tree over 2^32 edges.
const MOST_PENDING: usize = 64;

/// Box around edges.
#[derive(Debug, Clone, Copy)]
struct Node {
    low: DVec3,
    high: DVec3,
    /// First edge, in the tree's order. For an inner box, the index of the box of its second half; the first half
    /// directly follows the box.
    first: u32,
    /// Number of edges; 0 for an inner box.
    count: u32,
}

/// Tree of boxes over edges.
#[derive(Debug, Clone, Default)]
pub(super) struct EdgeIndex {
    nodes: Vec<Node>,
    order: Vec<u32>,
}

impl EdgeIndex {
    /// Builds a tree over edges, which are identified by their numbers.
    pub fn new(edges: &[DiffractingEdge]) -> Self {
        let ends: Vec<[DVec3; 2]> = edges.iter().map(|edge| edge.ends).collect();
        let mut index = EdgeIndex { nodes: Vec::new(), order: (0..ends.len() as u32).collect() };
        if !ends.is_empty() {
            index.divide(&ends, 0, ends.len());
        }
        index
    }

    /// Makes the box around some edges of the order, and the boxes within it.
    fn divide(&mut self, ends: &[[DVec3; 2]], first: usize, end: usize) {
        let ends_of = |edge: &u32| ends.get(*edge as usize).copied().unwrap_or([DVec3::ZERO; 2]);
        let Some(part) = self.order.get_mut(first..end) else { return };
        let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        for [a, b] in part.iter().map(ends_of) {
            (low, high) = (low.min(a).min(b), high.max(a).max(b));
        }
        let number = self.nodes.len();
        self.nodes.push(Node { low, high, first: first as u32, count: (end - first) as u32 });
        if end - first <= LEAF_EDGES {
            return;
        }
        let axis = (high - low).max_position();
        let middle = |edge: &u32| {
            let [a, b] = ends_of(edge);
            a[axis] + b[axis]
        };
        part.sort_by(|p, q| middle(p).total_cmp(&middle(q)).then(p.cmp(q)));
        let half = first + (end - first) / 2;
        self.divide(ends, first, half);
        let second = self.nodes.len() as u32;
        if let Some(node) = self.nodes.get_mut(number) {
            (node.first, node.count) = (second, 0);
        }
        self.divide(ends, half, end);
    }

    /// Numbers of all edges whose boxes come within a distance, m, of a straight segment, ascending.
    pub fn near(&self, from: DVec3, to: DVec3, distance_m: f64, found: &mut Vec<u32>) {
        found.clear();
        let margin = DVec3::splat(distance_m);
        let per_m = (to - from).to_array().map(|component| (component.abs() >= 1e-12).then(|| 1.0 / component));
        let mut pending = [0u32; MOST_PENDING];
        let mut count = usize::from(!self.nodes.is_empty());
        while count > 0 {
            count -= 1;
            let number = pending.get(count).copied().unwrap_or_default();
            let Some(node) = self.nodes.get(number as usize) else { continue };
            if !segment_meets_box(node.low - margin, node.high + margin, from, &per_m) {
                continue;
            }
            if node.count > 0 {
                let edges = self.order.get(node.first as usize..(node.first + node.count) as usize);
                found.extend_from_slice(edges.unwrap_or_default());
                continue;
            }
            for next in [number + 1, node.first] {
                if let Some(slot) = pending.get_mut(count) {
                    *slot = next;
                    count += 1;
                }
            }
        }
        found.sort_unstable();
    }
}

/// Returns whether a straight segment from a point intersects a box. `per_m` holds the inverses of the segment's
/// nonzero components.
fn segment_meets_box(low: DVec3, high: DVec3, from: DVec3, per_m: &[Option<f64>; 3]) -> bool {
    let (mut entry, mut exit) = (0.0f64, 1.0f64);
    for (axis, per_m) in per_m.iter().enumerate() {
        let Some(per_m) = per_m else {
            if from[axis] < low[axis] || from[axis] > high[axis] {
                return false;
            }
            continue;
        };
        let (a, b) = ((low[axis] - from[axis]) * per_m, (high[axis] - from[axis]) * per_m);
        (entry, exit) = (entry.max(a.min(b)), exit.min(a.max(b)));
    }
    entry <= exit
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
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(4);
        let mut position = || DVec3::from_array(std::array::from_fn(|_| rng.random_range(0.0..10.0)));
        let triangle = |at: DVec3| {
            let corners = [at, at + DVec3::X * 0.3, at + DVec3::new(0.1, 0.2, 0.15)];
            Facet::new(corners.to_vec(), Wall::Conductor)
        };
        let facets: Vec<Facet> = (0..200).map(|_| triangle(position())).collect();
        let environment = Environment::new(facets, 1257.0).expect("facets");
        let edges = environment.diffracting_edges();
        let (mut found, mut all) = (Vec::new(), 0);
        for _ in 0..50 {
            let (from, to, distance_m) = (position(), position(), 0.3);
            environment.edges_near(from, to, distance_m, &mut found);
            assert!(found.windows(2).all(|two| two[0] < two[1]));
            let (direction, length_m) = ((to - from).normalize(), from.distance(to));
            for (number, edge) in (0..).zip(edges) {
                let near = (0..=20).any(|i| {
                    let at = edge.ends[0].lerp(edge.ends[1], f64::from(i) / 20.0);
                    let along = (at - from).dot(direction).clamp(0.0, length_m);
                    at.distance(from + direction * along) < distance_m
                });
                assert!(!near || found.contains(&number));
            }
            all += found.len();
        }
        assert!(all < 50 * edges.len() / 4, "{all} of {}", 50 * edges.len());
    }
}
