//! What a body's own parts leave of the field that one of (image) antennas throws on its skin.
//!
//! Whether a place is in the light is yes or no, what arrives there is not: a knife edge's field is a continuous function of the
//! distance across to the shadow's edge, half on it, falling behind ([`crate::shadow::knife_edge`]). The shadow's edges are the
//! outlines of limbs as the antenna sees them: edges of the mesh at which triangles turn away, each of which divides light from
//! shadow only on what lies behind it and before the next thing that a ray just beside it meets. Seen from the antenna all are
//! laid on a plane at the body's distance, in a grid, so that a vertex looks at the few that are near.

use glam::{DVec2, DVec3};

use crate::actor::skin::{PosedSkin, Skin};
use crate::shadow::knife_edge;
use crate::trace::{Ray, World};

/// Farther across from an outline than this there is all light or none, m.
const REACH_M: f64 = 0.06;
/// Width of the grid's cells, m.
const CELL_M: f64 = 0.04;
/// Beside an outline, where a ray looks for what lies behind, m.
const BESIDE_M: f64 = 1e-4;
/// Nothing shades what lies this close behind it, m: there an outline is the surface's own curving away.
const BEHIND_M: f64 = 0.02;
/// An outline's piece on the plane.
#[derive(Debug, Clone, Copy)]
struct Piece {
    from: DVec2,
    to: DVec2,
    /// How far away it is, m, and how far what a ray just beside it meets.
    depth_m: f64,
    behind_m: f64,
}

/// A body's outlines seen from a place.
struct Outlines {
    pieces: Vec<Piece>,
    low: DVec2,
    cells: [usize; 2],
    /// Where each cell's pieces begin in `members`.
    starts: Vec<u32>,
    members: Vec<u32>,
}

/// The plane on which a body is seen: perspective from the antenna, in metres at the body's distance.
struct Plane {
    antenna: DVec3,
    forward: DVec3,
    u: DVec3,
    v: DVec3,
    distance_m: f64,
}

impl Plane {
    /// `None` where the antenna is so near that parts of the body are beside it.
    fn new(antenna: DVec3, vertices: &[DVec3]) -> Option<Self> {
        let first = *vertices.first()?;
        let (low, high) = vertices.iter().fold((first, first), |(l, h), &v| (l.min(v), h.max(v)));
        let middle = 0.5 * (low + high);
        let distance_m = middle.distance(antenna);
        if distance_m < 0.6 * (high - low).length() {
            return None;
        }
        let forward = (middle - antenna) / distance_m;
        let (u, v) = forward.any_orthonormal_pair();
        Some(Plane { antenna, forward, u, v, distance_m })
    }

    /// Place on the plane, and depth along the line of sight, m.
    #[inline]
    fn seen(&self, point: DVec3) -> (DVec2, f64) {
        let offset = point - self.antenna;
        let scale = self.distance_m / offset.dot(self.forward);
        (DVec2::new(offset.dot(self.u), offset.dot(self.v)) * scale, offset.length())
    }

    /// Direction from the antenna through a place on the plane.
    fn towards(&self, at: DVec2) -> DVec3 {
        self.forward * self.distance_m + self.u * at.x + self.v * at.y
    }
}

/// Factor on the field of an (image) antenna at each vertex that is wanted; 1 at the others. `world` holds the body alone.
pub fn weights(
    skin: &Skin,
    posed: &PosedSkin,
    world: &World,
    antenna: DVec3,
    wavelength_m: f64,
    wanted: &[bool],
) -> Vec<f64> {
    let mut all = vec![1.0; posed.vertices.len()];
    let Some(plane) = Plane::new(antenna, &posed.vertices) else { return all };
    let outlines = Outlines::new(skin, posed, world, &plane);
    let vertices = posed.vertices.iter().zip(&posed.normals).enumerate();
    let indices: Vec<usize> = vertices
        .filter(|(i, (v, normal))| wanted.get(*i) == Some(&true) && normal.dot(antenna - **v) > 0.0)
        .map(|(i, _)| i)
        .collect();
    // From the antenna, so that neighbours' rays go the same way.
    let rays: Vec<Ray> = indices.iter().map(|&i| Ray::between(antenna, posed.vertices[i])).collect();
    world.closest_each(&rays, |i, hit| {
        let Some(&index) = indices.get(i) else { return };
        let (at, depth_m) = plane.seen(posed.vertices[index]);
        let shaded = hit.is_some_and(|hit| hit.distance_m < depth_m - BEHIND_M);
        all[index] = outlines.weight(at, depth_m, shaded, wavelength_m);
    });
    all
}

impl Outlines {
    fn new(skin: &Skin, posed: &PosedSkin, world: &World, plane: &Plane) -> Self {
        let corner = |v: u32| posed.vertices.get(v as usize).copied().unwrap_or_default();
        let facing: Vec<bool> = skin
            .rest()
            .triangles
            .iter()
            .map(|&[a, b, c]| {
                let (a, b, c) = (corner(a), corner(b), corner(c));
                (b - a).cross(c - a).dot(plane.antenna - a) > 0.0
            })
            .collect();
        let faces = |t: u32| facing.get(t as usize).copied().unwrap_or(false);
        let mut pieces = Vec::new();
        let mut rays = Vec::new();
        for edge in skin.edges() {
            let [left, right] = edge.triangles;
            if faces(left) == faces(right) {
                continue;
            }
            let [p, q] = edge.vertices;
            let ((from, depth_p), (to, depth_q)) = (plane.seen(corner(p)), plane.seen(corner(q)));
            let along = to - from;
            // Both triangles lie on the same side of it; the third corner of either says which.
            let third = skin.rest().triangles.get(left as usize).and_then(|t| t.iter().find(|v| **v != p && **v != q));
            let Some(&third) = third else { continue };
            let side = along.perp_dot(plane.seen(corner(third)).0 - from);
            let outward = (if side > 0.0 { -along.perp() } else { along.perp() }).normalize_or_zero();
            let beside = 0.5 * (from + to) + outward * BESIDE_M;
            rays.push(Ray::new(plane.antenna, plane.towards(beside)));
            pieces.push(Piece { from, to, depth_m: 0.5 * (depth_p + depth_q), behind_m: f64::INFINITY });
        }
        world.closest_each(&rays, |i, hit| {
            if let (Some(piece), Some(hit)) = (pieces.get_mut(i), hit) {
                piece.behind_m = hit.distance_m;
            }
        });
        // What is itself hidden hides nothing more.
        pieces.retain(|piece| piece.behind_m > piece.depth_m - 1e-3);
        Self::sorted(pieces)
    }

    /// With their grid.
    fn sorted(pieces: Vec<Piece>) -> Self {
        let reach = DVec2::splat(REACH_M);
        let bounds = |piece: &Piece| (piece.from.min(piece.to) - reach, piece.from.max(piece.to) + reach);
        let (low, high) = pieces
            .iter()
            .map(bounds)
            .fold((DVec2::INFINITY, DVec2::NEG_INFINITY), |(l, h), (low, high)| (l.min(low), h.max(high)));
        if pieces.is_empty() {
            return Outlines { pieces, low: DVec2::ZERO, cells: [0; 2], starts: Vec::new(), members: Vec::new() };
        }
        // A body is at most a few metres; what perspective makes larger shares the last cells.
        let count = |length: f64| ((length / CELL_M) as usize + 1).min(200);
        let cells = [count(high.x - low.x), count(high.y - low.y)];
        let mut outlines = Outlines { pieces, low, cells, starts: vec![0; cells[0] * cells[1] + 1], members: Vec::new() };
        let ranges: Vec<[usize; 4]> = outlines
            .pieces
            .iter()
            .map(|piece| {
                let (low, high) = bounds(piece);
                let ([x0, y0], [x1, y1]) = (outlines.cell(low), outlines.cell(high));
                [x0, y0, x1, y1]
            })
            .collect();
        let across = cells[0];
        let visit = |range: &[usize; 4], visitor: &mut dyn FnMut(usize)| {
            let &[x0, y0, x1, y1] = range;
            for y in y0..=y1 {
                for x in x0..=x1 {
                    visitor(y * across + x);
                }
            }
        };
        for range in &ranges {
            visit(range, &mut |cell| outlines.starts[cell + 1] += 1);
        }
        for i in 1..outlines.starts.len() {
            outlines.starts[i] += outlines.starts[i - 1];
        }
        let mut next = outlines.starts.clone();
        outlines.members = vec![0; outlines.starts.last().map_or(0, |&n| n as usize)];
        for (number, range) in ranges.iter().enumerate() {
            visit(range, &mut |cell| {
                outlines.members[next[cell] as usize] = number as u32;
                next[cell] += 1;
            });
        }
        outlines
    }

    fn cell(&self, at: DVec2) -> [usize; 2] {
        let offset = (at - self.low) / CELL_M;
        let index = |x: f64, count: usize| (x.max(0.0) as usize).min(count.saturating_sub(1));
        [index(offset.x, self.cells[0]), index(offset.y, self.cells[1])]
    }

    /// Field at a place of this depth.
    fn weight(&self, at: DVec2, depth_m: f64, shaded: bool, wavelength_m: f64) -> f64 {
        let far = if shaded { 0.0 } else { 1.0 };
        if self.pieces.is_empty() {
            return far;
        }
        let [x, y] = self.cell(at);
        let cell = y * self.cells[0] + x;
        let range = self.starts[cell] as usize..self.starts[cell + 1] as usize;
        // Squared distance across in units of the first Fresnel zone, and in metres.
        let (mut nearest, mut across_m2) = (f64::INFINITY, f64::INFINITY);
        for &member in &self.members[range] {
            let piece = &self.pieces[member as usize];
            let behind_m = depth_m - piece.depth_m;
            if behind_m < BEHIND_M || piece.behind_m < depth_m - BEHIND_M {
                continue;
            }
            let along = piece.to - piece.from;
            let part = ((at - piece.from).dot(along) / along.length_squared().max(1e-18)).clamp(0.0, 1.0);
            // On the plane of the body's distance: what is a little nearer is seen a little larger, which is left alone.
            let distance2 = (piece.from + along * part).distance_squared(at);
            let zones = distance2 * depth_m / (piece.depth_m * behind_m);
            if zones < nearest {
                (nearest, across_m2) = (zones, distance2);
            }
        }
        if across_m2 > REACH_M * REACH_M {
            return far;
        }
        let nu = (2.0 * nearest / wavelength_m).sqrt();
        if shaded {
            // To nothing at the end of the reach.
            let part = across_m2 / (REACH_M * REACH_M);
            knife_edge(nu) * (1.0 - part) * (1.0 - part)
        } else {
            knife_edge(-nu)
        }
    }
}
