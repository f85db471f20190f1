//! Routes around furniture: the shortest route that keeps a distance from obstacles in the room.

/// A box on the ground plan: low and high corner, m.
pub(crate) type Block = [[f64; 2]; 2];

/// Margin by which the corners of a route are farther off than requested, m. Routes may run along blocks.
const ROUTE_MARGIN_M: f64 = 1e-6;

/// Ground on which people may walk.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Ground {
    size_m: [f64; 2],
    blocks: Vec<Block>,
    keep_off_m: f64,
    /// Whether some blocks are walls. Rather than cross a wall, people pass closer to it.
    has_walls: bool,
}

/// Fractions of the keep-off distance. They are tried in this order if there are walls and no route is found farther
/// off.
const KEEP_OFF_FRACTIONS: [f64; 3] = [1.0, 0.5, 0.1];

impl Ground {
    /// A room with blocks. Hips keep a distance of `keep_off_m` from the blocks and from the room's walls.
    pub fn new(size_m: [f64; 2], blocks: Vec<Block>, keep_off_m: f64) -> Self {
        Ground { size_m, blocks, keep_off_m, has_walls: false }
    }

    /// Marks some of the blocks as walls. Where no route keeps the requested distance, routes come closer.
    pub fn with_walls(self) -> Self {
        Ground { has_walls: true, ..self }
    }

    /// Whether a person may stand at a position.
    pub fn is_free(&self, position: [f64; 2]) -> bool {
        let is_off_walls =
            (0..2).all(|i| position[i] >= self.keep_off_m && position[i] <= self.size_m[i] - self.keep_off_m);
        is_off_walls && self.blocks.iter().all(|block| distance_m(block, position) >= self.keep_off_m)
    }

    /// Returns the corners of a route between two positions, the last one included. The distance to a block is reduced
    /// if the route begins or ends close to it. The route is straight if there is no way around.
    pub fn route(&self, from: [f64; 2], to: [f64; 2]) -> Vec<[f64; 2]> {
        self.find_route(from, to).unwrap_or_else(|| vec![to])
    }

    /// Returns the corners of a route as [`Ground::route`]; `None` if there is no way around.
    pub fn find_route(&self, from: [f64; 2], to: [f64; 2]) -> Option<Vec<[f64; 2]>> {
        let attempts = if self.has_walls { KEEP_OFF_FRACTIONS.len() } else { 1 };
        KEEP_OFF_FRACTIONS
            .iter()
            .take(attempts)
            .find_map(|fraction| self.route_at_distance(from, to, fraction * self.keep_off_m))
    }

    /// Returns a route with a given distance to the blocks; `None` if there is none.
    fn route_at_distance(&self, from: [f64; 2], to: [f64; 2], keep_off_m: f64) -> Option<Vec<[f64; 2]>> {
        let grown_blocks: Vec<Block> = self
            .blocks
            .iter()
            .filter_map(|block| {
                // The distance is taken along the axes, as blocks are grown, so that route ends near a corner stay
                // outside.
                let free_m = clearance_m(block, from).min(clearance_m(block, to));
                let margin_m = keep_off_m.min(free_m - ROUTE_MARGIN_M);
                (free_m > 0.0).then(|| grown(block, margin_m.max(0.0)))
            })
            .collect();
        let is_clear = |a: [f64; 2], b: [f64; 2]| !grown_blocks.iter().any(|block| crosses(block, a, b));
        if is_clear(from, to) {
            return Some(vec![to]);
        }
        let mut nodes = vec![from, to];
        // Bodies fit between the room's walls and corners at half the distance.
        let margin_m = 0.5 * keep_off_m;
        let is_in_room =
            |corner: &[f64; 2]| (0..2).all(|i| corner[i] >= margin_m && corner[i] <= self.size_m[i] - margin_m);
        for [low, high] in grown_blocks.iter().map(|block| grown(block, ROUTE_MARGIN_M)) {
            let corners = [[low[0], low[1]], [low[0], high[1]], [high[0], low[1]], [high[0], high[1]]];
            nodes.extend(corners.into_iter().filter(is_in_room));
        }
        // A route has no corner within another block.
        let is_within = |[low, high]: &Block, node: &[f64; 2]| (0..2).all(|i| node[i] > low[i] && node[i] < high[i]);
        let mut count = 0;
        nodes.retain(|node| {
            count += 1;
            count <= 2 || !grown_blocks.iter().any(|block| is_within(block, node))
        });
        shortest(&nodes, is_clear)
    }
}

/// Returns the shortest route from the first node to the second through the others, if any, by Dijkstra's algorithm.
/// `is_clear` states whether two nodes are connected by a straight line.
fn shortest(nodes: &[[f64; 2]], is_clear: impl Fn([f64; 2], [f64; 2]) -> bool) -> Option<Vec<[f64; 2]>> {
    const START: usize = 0;
    const GOAL: usize = 1;
    // Length of the shortest known route to each node, and the node before it on that route.
    let mut lengths_m = vec![f64::INFINITY; nodes.len()];
    let mut previous = vec![START; nodes.len()];
    let mut is_visited = vec![false; nodes.len()];
    lengths_m[START] = 0.0;
    while let Some(current) = (0..nodes.len())
        .filter(|&i| !is_visited[i] && lengths_m[i].is_finite())
        .min_by(|&a, &b| lengths_m[a].total_cmp(&lengths_m[b]))
    {
        is_visited[current] = true;
        if current == GOAL {
            break;
        }
        for next in (0..nodes.len()).filter(|&i| !is_visited[i]) {
            let (a, b) = (nodes[current], nodes[next]);
            let length_m = lengths_m[current] + (a[0] - b[0]).hypot(a[1] - b[1]);
            if length_m < lengths_m[next] && is_clear(a, b) {
                (lengths_m[next], previous[next]) = (length_m, current);
            }
        }
    }
    if !lengths_m[GOAL].is_finite() {
        return None;
    }
    let mut route = vec![nodes[GOAL]];
    let mut node = previous[GOAL];
    while node != START {
        route.push(nodes[node]);
        node = previous[node];
    }
    route.reverse();
    Some(route)
}

/// Box that extends farther than a block by a margin on all sides.
fn grown([low, high]: &Block, margin_m: f64) -> Block {
    [low.map(|x| x - margin_m), high.map(|x| x + margin_m)]
}

/// Distance of a position from a block along one axis, m; 0 within the block's extent.
fn axis_gap_m([low, high]: &Block, at: [f64; 2], axis: usize) -> f64 {
    (low[axis] - at[axis]).max(at[axis] - high[axis]).max(0.0)
}

/// Distance of a position from a block, m; 0 within.
fn distance_m(block: &Block, at: [f64; 2]) -> f64 {
    axis_gap_m(block, at, 0).hypot(axis_gap_m(block, at, 1))
}

/// Largest growth of a block along both axes that leaves a position outside, m.
fn clearance_m(block: &Block, at: [f64; 2]) -> f64 {
    axis_gap_m(block, at, 0).max(axis_gap_m(block, at, 1))
}

/// Whether a straight line crosses the inside of a block.
fn crosses([low, high]: &Block, a: [f64; 2], b: [f64; 2]) -> bool {
    let (mut enters, mut leaves) = (0.0f64, 1.0f64);
    for i in 0..2 {
        let along = b[i] - a[i];
        if along.abs() < 1e-12 {
            if a[i] <= low[i] || a[i] >= high[i] {
                return false;
            }
            continue;
        }
        let (near, far) = ((low[i] - a[i]) / along, (high[i] - a[i]) / along);
        enters = enters.max(near.min(far));
        leaves = leaves.min(near.max(far));
    }
    enters < leaves - 1e-12
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ground() -> Ground {
        Ground::new([6.0, 4.0], vec![[[2.0, 0.0], [3.0, 2.5]], [[4.0, 1.5], [4.5, 4.0]]], 0.3)
    }

    #[test]
    fn a_route_keeps_off_blocks_and_is_straight_where_it_can() {
        let ground = ground();
        let route = ground.route([1.0, 1.0], [5.5, 3.0]);
        assert!(route.len() >= 3, "{route:?}");
        let mut from = [1.0, 1.0];
        for to in route {
            for i in 0..=50 {
                let fraction = f64::from(i) / 50.0;
                let position = [0, 1].map(|k| from[k] + fraction * (to[k] - from[k]));
                let nearest_m =
                    ground.blocks.iter().map(|block| distance_m(block, position)).fold(f64::INFINITY, f64::min);
                assert!(nearest_m > 0.299, "{nearest_m} m off at {position:?}");
            }
            from = to;
        }
        assert_eq!(from, [5.5, 3.0]);
        assert_eq!(ground.route([0.5, 0.5], [1.5, 3.0]), [[1.5, 3.0]], "straight where nothing is in the way");
    }

    #[test]
    fn positions_near_walls_and_furniture_are_not_free() {
        let ground = ground();
        assert!(ground.is_free([1.0, 1.0]) && !ground.is_free([0.1, 1.0]) && !ground.is_free([3.2, 1.0]));
        assert!(!ground.is_free([2.5, 1.0]) && !ground.is_free([f64::NAN, 1.0]));
    }

    mod hard_cases {
        use super::*;

        /// The route begins nearer to a corner than requested. It still goes around the other block.
        #[test]
        fn a_route_that_begins_near_a_corner_goes_around_other_blocks() {
            let ground = Ground::new([6.0, 4.0], vec![[[3.0, 3.0], [3.5, 3.5]], [[0.0, 1.5], [2.2, 2.6]]], 0.3);
            let route = ground.route([2.9, 2.93], [1.0, 1.25]);
            assert!(route.len() > 1, "{route:?}");
        }

        /// A person that begins inside a block or in a niche gets out. A room that is cut in two is crossed straight.
        #[test]
        fn a_route_is_returned_even_from_inside_a_block_or_across_a_wall() {
            let ground = ground();
            assert_eq!(ground.route([2.5, 1.0], [1.0, 1.0]), [[1.0, 1.0]]);
            assert_eq!(ground.route([1.95, 1.0], [3.05, 1.0]).last(), Some(&[3.05, 1.0]));
            let wall = Ground::new([6.0, 4.0], vec![[[2.0, 0.0], [2.2, 4.0]]], 0.3);
            assert_eq!(wall.route([1.0, 1.0], [5.0, 1.0]), [[5.0, 1.0]]);
            assert_eq!(wall.find_route([1.0, 1.0], [5.0, 1.0]), None);
            assert_eq!(Ground::default().route([1.0, 1.0], [1.0, 1.0]), [[1.0, 1.0]]);
        }
    }
}
