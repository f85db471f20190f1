//! Routes around furniture: the shortest route that keeps a distance from obstacles in the room.

/// A box on the ground plan: low and high corner, m.
pub(crate) type Block = [[f64; 2]; 2];

/// Margin by which the corners of a route are farther off than requested, m. Routes may run along blocks.
const BESIDE_M: f64 = 1e-6;

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
const NEARER: [f64; 3] = [1.0, 0.5, 0.1];

impl Ground {
    /// A room with blocks. Hips keep a distance of `keep_off_m` from the blocks and from the room's walls.
    pub fn new(size_m: [f64; 2], blocks: Vec<Block>, keep_off_m: f64) -> Self {
        Ground { size_m, blocks, keep_off_m, has_walls: false }
    }

    /// Marks some of the blocks as walls. Where no route keeps the requested distance, routes come closer.
    pub fn among_walls(self) -> Self {
        Ground { has_walls: true, ..self }
    }

    /// Whether a person may stand at a position.
    pub fn is_free(&self, at: [f64; 2]) -> bool {
        let off_walls = (0..2).all(|i| at[i] >= self.keep_off_m && at[i] <= self.size_m[i] - self.keep_off_m);
        off_walls && self.blocks.iter().all(|block| distance_m(block, at) >= self.keep_off_m)
    }

    /// Returns the corners of a route between two positions, the last one included. The distance to a block is reduced
    /// if the route begins or ends close to it. The route is straight if there is no way around.
    pub fn route(&self, from: [f64; 2], to: [f64; 2]) -> Vec<[f64; 2]> {
        self.way_around(from, to).unwrap_or_else(|| vec![to])
    }

    /// Returns the corners of a route as [`Ground::route`]; `None` if there is no way around.
    pub fn way_around(&self, from: [f64; 2], to: [f64; 2]) -> Option<Vec<[f64; 2]>> {
        let tries = if self.has_walls { NEARER.len() } else { 1 };
        NEARER.iter().take(tries).find_map(|part| self.way(from, to, part * self.keep_off_m))
    }

    /// Returns a route with a given distance to the blocks; `None` if there is none.
    fn way(&self, from: [f64; 2], to: [f64; 2], keep_off_m: f64) -> Option<Vec<[f64; 2]>> {
        let kept: Vec<Block> = self
            .blocks
            .iter()
            .filter_map(|block| {
                // The distance is taken along the axes, as blocks are grown, so that route ends near a corner stay
                // outside.
                let room = clearance_m(block, from).min(clearance_m(block, to));
                let margin = keep_off_m.min(room - BESIDE_M);
                (room > 0.0).then(|| grown(block, margin.max(0.0)))
            })
            .collect();
        let open = |a: [f64; 2], b: [f64; 2]| !kept.iter().any(|block| crosses(block, a, b));
        if open(from, to) {
            return Some(vec![to]);
        }
        let mut places = vec![from, to];
        for [low, high] in kept.iter().map(|block| grown(block, BESIDE_M)) {
            places.extend(
                [[low[0], low[1]], [low[0], high[1]], [high[0], low[1]], [high[0], high[1]]].into_iter().filter(|p| {
                    // Bodies fit between the room's walls and corners at half the distance.
                    let margin = 0.5 * keep_off_m;
                    (0..2).all(|i| p[i] >= margin && p[i] <= self.size_m[i] - margin)
                }),
            );
        }
        // A route has no corner within another block.
        let is_within = |[low, high]: &Block, at: &[f64; 2]| (0..2).all(|i| at[i] > low[i] && at[i] < high[i]);
        let mut number = 0;
        places.retain(|at| {
            number += 1;
            number <= 2 || !kept.iter().any(|block| is_within(block, at))
        });
        shortest(&places, open)
    }
}

/// Returns the shortest route from the first position to the second through the others, if any, by Dijkstra's
/// algorithm.
fn shortest(places: &[[f64; 2]], open: impl Fn([f64; 2], [f64; 2]) -> bool) -> Option<Vec<[f64; 2]>> {
    let mut best = vec![(f64::INFINITY, 0usize); places.len()];
    let mut done = vec![false; places.len()];
    best[0].0 = 0.0;
    while let Some(here) = (0..places.len())
        .filter(|&i| !done[i] && best[i].0.is_finite())
        .min_by(|&a, &b| best[a].0.total_cmp(&best[b].0))
    {
        done[here] = true;
        if here == 1 {
            break;
        }
        for next in (0..places.len()).filter(|&i| !done[i]) {
            let (a, b) = (places[here], places[next]);
            let length = best[here].0 + (a[0] - b[0]).hypot(a[1] - b[1]);
            if length < best[next].0 && open(a, b) {
                best[next] = (length, here);
            }
        }
    }
    if !best[1].0.is_finite() {
        return None;
    }
    let mut way = vec![places[1]];
    let mut at = best[1].1;
    while at != 0 {
        way.push(places[at]);
        at = best[at].1;
    }
    way.reverse();
    Some(way)
}

fn grown([low, high]: &Block, by: f64) -> Block {
    [low.map(|x| x - by), high.map(|x| x + by)]
}

fn off([low, high]: &Block, at: [f64; 2], axis: usize) -> f64 {
    (low[axis] - at[axis]).max(at[axis] - high[axis]).max(0.0)
}

/// Distance from a block's edge, m; 0 within.
fn distance_m(block: &Block, at: [f64; 2]) -> f64 {
    off(block, at, 0).hypot(off(block, at, 1))
}

/// Largest growth of a block along both axes that leaves a position outside, m.
fn clearance_m(block: &Block, at: [f64; 2]) -> f64 {
    off(block, at, 0).max(off(block, at, 1))
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
    fn ways_go_around_by_the_shorter_side_and_keep_off() {
        let ground = ground();
        let way = ground.route([1.0, 1.0], [5.5, 3.0]);
        assert!(way.len() >= 3, "{way:?}");
        let mut from = [1.0, 1.0];
        for to in way {
            for i in 0..=50 {
                let part = f64::from(i) / 50.0;
                let at = [0, 1].map(|k| from[k] + part * (to[k] - from[k]));
                let off = ground.blocks.iter().map(|block| distance_m(block, at)).fold(f64::INFINITY, f64::min);
                assert!(off > 0.299, "{off} m off at {at:?}");
            }
            from = to;
        }
        assert_eq!(from, [5.5, 3.0]);
        assert_eq!(ground.route([0.5, 0.5], [1.5, 3.0]), [[1.5, 3.0]], "straight where nothing is in the way");
    }

    #[test]
    fn places_by_walls_and_furniture_are_not_free() {
        let ground = ground();
        assert!(ground.is_free([1.0, 1.0]) && !ground.is_free([0.1, 1.0]) && !ground.is_free([3.2, 1.0]));
        assert!(!ground.is_free([2.5, 1.0]) && !ground.is_free([f64::NAN, 1.0]));
    }

    mod hard_cases {
        use super::*;

        /// The route begins nearer to a corner than requested. It still goes around the other block.
        #[test]
        fn who_stands_by_a_corner_walks_around_the_rest() {
            let ground = Ground::new([6.0, 4.0], vec![[[3.0, 3.0], [3.5, 3.5]], [[0.0, 1.5], [2.2, 2.6]]], 0.3);
            let way = ground.route([2.9, 2.93], [1.0, 1.25]);
            assert!(way.len() > 1, "{way:?}");
        }

        /// A person that begins inside a block or in a niche gets out. A room cut in two is crossed straight.
        #[test]
        fn there_is_always_a_way() {
            let ground = ground();
            assert_eq!(ground.route([2.5, 1.0], [1.0, 1.0]), [[1.0, 1.0]]);
            assert_eq!(ground.route([1.95, 1.0], [3.05, 1.0]).last(), Some(&[3.05, 1.0]));
            let wall = Ground::new([6.0, 4.0], vec![[[2.0, 0.0], [2.2, 4.0]]], 0.3);
            assert_eq!(wall.route([1.0, 1.0], [5.0, 1.0]), [[5.0, 1.0]]);
            assert_eq!(wall.way_around([1.0, 1.0], [5.0, 1.0]), None);
            assert_eq!(Ground::default().route([1.0, 1.0], [1.0, 1.0]), [[1.0, 1.0]]);
        }
    }
}
