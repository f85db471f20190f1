//! What a body's own parts leave of the field that one of (image) antennas throws on its skin.
//!
//! Whether a place is in the light is yes or no, what arrives there is not: a knife edge's field is a continuous function of the
//! distance across to the shadow's edge, half on it, falling behind ([`crate::shadow::knife_edge`]). The shadow's edges are the
//! outlines of limbs as the antenna sees them: edges of the mesh at which triangles turn away, each of which divides light from
//! shadow only on what lies behind it and before the next thing that is seen just beside it. Seen from the antenna all are laid
//! on a plane at the body's distance, in a grid, so that a vertex looks at the few triangles and outlines that are near: what
//! a ray for each vertex and each outline would find, to which a test holds it.

use glam::{DVec2, DVec3, Vec2};

use crate::actor::skin::{PosedSkin, Skin};
use crate::shadow::knife_edge;

/// Farther across from an outline than this there is all light or none, m.
const REACH_M: f64 = 0.06;
/// Width of the cells of outlines, and of triangles, m.
const CELL_M: f64 = 0.04;
const TRIANGLE_CELL_M: f64 = 0.02;
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

/// Lists of things by the cells of a grid that they touch.
struct Cells {
    low: DVec2,
    width_m: f64,
    count: [usize; 2],
    /// Where each cell's members begin.
    starts: Vec<u32>,
    members: Vec<u32>,
}

/// A triangle on the plane, in the form in which a place is put into it: its weights of the second and third corner are
/// `to_second . (at - first)` and `to_third . (at - first)`.
#[derive(Debug, Clone, Copy)]
struct Facet {
    first: Vec2,
    to_second: Vec2,
    to_third: Vec2,
    /// Depth of the first corner, of the others beyond it, and of the nearest, m.
    depth_m: f32,
    deeper_m: [f32; 2],
    nearest_m: f32,
}

/// What an antenna sees of a body.
struct View<'a> {
    skin: &'a Skin,
    /// Each vertex on the plane, and how far away it is, m.
    seen: Vec<(DVec2, f64)>,
    /// Whether each triangle faces the antenna.
    facing: Vec<bool>,
    /// Those that do, and which are where.
    facets: Vec<Facet>,
    triangles: Cells,
    pieces: Vec<Piece>,
    outlines: Cells,
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
}

/// Factor on the field of an (image) antenna at each vertex that is wanted; 1 at the others.
pub fn weights(skin: &Skin, posed: &PosedSkin, antenna: DVec3, wavelength_m: f64, wanted: &[bool]) -> Vec<f64> {
    let mut all = vec![1.0; posed.vertices.len()];
    let Some(plane) = Plane::new(antenna, &posed.vertices) else { return all };
    let view = View::new(skin, posed, plane);
    for (i, ((weight, v), normal)) in all.iter_mut().zip(&posed.vertices).zip(&posed.normals).enumerate() {
        if wanted.get(i) == Some(&true) && normal.dot(antenna - *v) > 0.0 {
            *weight = view.weight(i, wavelength_m);
        }
    }
    all
}

impl Cells {
    /// From the box around each thing.
    fn new(boxes: &[(DVec2, DVec2)], width_m: f64) -> Self {
        let (low, high) = boxes
            .iter()
            .fold((DVec2::INFINITY, DVec2::NEG_INFINITY), |(l, h), (low, high)| (l.min(*low), h.max(*high)));
        if boxes.is_empty() {
            return Cells { low: DVec2::ZERO, width_m, count: [1; 2], starts: vec![0; 2], members: Vec::new() };
        }
        // A body is at most a few metres; what perspective makes larger shares the last cells.
        let across = |length: f64| ((length / width_m) as usize + 1).min(400);
        let count = [across(high.x - low.x), across(high.y - low.y)];
        let mut cells = Cells { low, width_m, count, starts: vec![0; count[0] * count[1] + 1], members: Vec::new() };
        let ranges: Vec<[usize; 4]> = boxes
            .iter()
            .map(|&(low, high)| {
                let ([x0, y0], [x1, y1]) = (cells.cell(low), cells.cell(high));
                [x0, y0, x1, y1]
            })
            .collect();
        for &[x0, y0, x1, y1] in &ranges {
            for y in y0..=y1 {
                for start in &mut cells.starts[y * count[0] + x0 + 1..=y * count[0] + x1 + 1] {
                    *start += 1;
                }
            }
        }
        let mut total = 0;
        for start in &mut cells.starts {
            total += *start;
            *start = total;
        }
        let mut next = cells.starts.clone();
        cells.members = vec![0; total as usize];
        for (number, &[x0, y0, x1, y1]) in (0..).zip(&ranges) {
            for y in y0..=y1 {
                for next in &mut next[y * count[0] + x0..=y * count[0] + x1] {
                    cells.members[*next as usize] = number;
                    *next += 1;
                }
            }
        }
        cells
    }

    fn cell(&self, at: DVec2) -> [usize; 2] {
        let offset = (at - self.low) / self.width_m;
        let index = |x: f64, count: usize| (x.max(0.0) as usize).min(count.saturating_sub(1));
        [index(offset.x, self.count[0]), index(offset.y, self.count[1])]
    }

    /// What may be at a place.
    fn at(&self, at: DVec2) -> &[u32] {
        let [x, y] = self.cell(at);
        let cell = y * self.count[0] + x;
        let range = self.starts.get(cell).zip(self.starts.get(cell + 1));
        range.and_then(|(&from, &to)| self.members.get(from as usize..to as usize)).unwrap_or_default()
    }
}

impl<'a> View<'a> {
    fn new(skin: &'a Skin, posed: &PosedSkin, plane: Plane) -> Self {
        let seen: Vec<(DVec2, f64)> = posed.vertices.iter().map(|&v| plane.seen(v)).collect();
        // Counter-clockwise on the plane, whose third axis points away, is turned away.
        let turned = |&[a, b, c]: &[u32; 3]| {
            let [a, b, c] = [a, b, c].map(|v| seen.get(v as usize).map_or(DVec2::ZERO, |s| s.0));
            (b - a).perp_dot(c - a)
        };
        let forward = plane.u.cross(plane.v).dot(plane.forward);
        let facing: Vec<bool> = skin.rest().triangles.iter().map(|t| turned(t) * forward < 0.0).collect();
        let (mut facets, mut boxes) = (Vec::new(), Vec::new());
        for (corners, _) in skin.rest().triangles.iter().zip(&facing).filter(|(_, facing)| **facing) {
            let [(a, depth_a), (b, depth_b), (c, depth_c)] = corners.map(|v| seen[v as usize]);
            let (u, v) = (b - a, c - a);
            let area = u.perp_dot(v);
            facets.push(Facet {
                first: a.as_vec2(),
                to_second: (DVec2::new(v.y, -v.x) / area).as_vec2(),
                to_third: (DVec2::new(-u.y, u.x) / area).as_vec2(),
                depth_m: depth_a as f32,
                deeper_m: [(depth_b - depth_a) as f32, (depth_c - depth_a) as f32],
                nearest_m: depth_a.min(depth_b).min(depth_c) as f32,
            });
            boxes.push((a.min(b).min(c), a.max(b).max(c)));
        }
        let triangles = Cells::new(&boxes, TRIANGLE_CELL_M);
        let outlines = Cells::new(&[], CELL_M);
        let mut view = View { skin, seen, facing, facets, triangles, pieces: Vec::new(), outlines };
        view.find_outlines();
        view
    }

    /// Depth of the nearest triangle at a place that is nearer than this, m; that itself where there is none.
    fn nearest_m(&self, at: DVec2, than_m: f64) -> f64 {
        let (mut nearest, place) = (than_m as f32, at.as_vec2());
        for &number in self.triangles.at(at) {
            let Some(facet) = self.facets.get(number as usize) else { continue };
            if facet.nearest_m >= nearest {
                continue;
            }
            let offset = place - facet.first;
            let (p, q) = (facet.to_second.dot(offset), facet.to_third.dot(offset));
            if p >= 0.0 && q >= 0.0 && p + q <= 1.0 {
                nearest = nearest.min(facet.depth_m + p * facet.deeper_m[0] + q * facet.deeper_m[1]);
            }
        }
        f64::from(nearest)
    }

    fn find_outlines(&mut self) {
        let faces = |t: u32| self.facing.get(t as usize).copied().unwrap_or(false);
        let mut pieces = Vec::new();
        for edge in self.skin.edges() {
            let [left, right] = edge.triangles;
            if faces(left) == faces(right) {
                continue;
            }
            let [p, q] = edge.vertices;
            let ((from, depth_p), (to, depth_q)) = (self.seen[p as usize], self.seen[q as usize]);
            let along = to - from;
            // Both triangles lie on the same side of it; the third corner of either says which.
            let corners = self.skin.rest().triangles.get(left as usize);
            let third = corners.and_then(|t| t.iter().find(|v| **v != p && **v != q));
            let Some(&third) = third else { continue };
            let side = along.perp_dot(self.seen[third as usize].0 - from);
            let outward = (if side > 0.0 { -along.perp() } else { along.perp() }).normalize_or_zero();
            let depth_m = 0.5 * (depth_p + depth_q);
            let behind_m = self.nearest_m(0.5 * (from + to) + outward * BESIDE_M, f64::INFINITY);
            // What is itself hidden hides nothing more.
            if behind_m > depth_m - 1e-3 {
                pieces.push(Piece { from, to, depth_m, behind_m });
            }
        }
        let reach = DVec2::splat(REACH_M);
        let boxes: Vec<_> = pieces.iter().map(|p| (p.from.min(p.to) - reach, p.from.max(p.to) + reach)).collect();
        self.outlines = Cells::new(&boxes, CELL_M);
        self.pieces = pieces;
    }

    /// Field at a vertex.
    fn weight(&self, vertex: usize, wavelength_m: f64) -> f64 {
        let Some(&(at, depth_m)) = self.seen.get(vertex) else { return 1.0 };
        let least_m = depth_m - BEHIND_M;
        let shaded = self.nearest_m(at, least_m) < f64::from(least_m as f32);
        let far = if shaded { 0.0 } else { 1.0 };
        // Squared distance across in units of the first Fresnel zone, and in metres.
        let (mut nearest, mut across_m2) = (f64::INFINITY, f64::INFINITY);
        for &member in self.outlines.at(at) {
            let Some(piece) = self.pieces.get(member as usize) else { continue };
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

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::actor::motion::{MotionBuilder, Person};
    use crate::actor::skin::{EDGE_M, WalkingMesh};
    use crate::trace::{Body, Build, Ray, World};

    const WAVELENGTH_M: f64 = 0.005;

    fn walker() -> WalkingMesh {
        let person = Person::draw(1, [0, 0], 1.75);
        let motion = MotionBuilder::new(person, 0.0, [1.0, 0.0], 0.4).walk_to([7.0, 2.0], 1.2).stay();
        WalkingMesh::new(Arc::new(motion), EDGE_M)
    }

    /// More than half of the field arrives where a ray does, and less where none does.
    #[test]
    fn light_is_where_rays_are() {
        let walker = walker();
        let all = vec![true; walker.skin().rest().vertices.len()];
        for (time_s, antenna) in [(2.0, DVec3::new(0.0, 0.0, 1.5)), (2.4, DVec3::new(8.0, -1.0, 0.9))] {
            let posed = walker.posed(time_s);
            let mesh = walker.mesh_at(time_s);
            let world = World::new(vec![Body::new(mesh, Build::Static).expect("body")]).expect("world");
            let weights = weights(walker.skin(), &posed, antenna, WAVELENGTH_M, &all);
            let (mut shaded, mut wrong, mut facing) = (0, 0, 0);
            for ((weight, v), normal) in weights.iter().zip(&posed.vertices).zip(&posed.normals) {
                let depth_m = v.distance(antenna);
                if normal.dot(antenna - *v) <= 0.3 * depth_m {
                    continue;
                }
                let hit = world.closest(&Ray::between(antenna, *v));
                let is_shaded = hit.is_some_and(|hit| hit.distance_m < depth_m - BEHIND_M);
                facing += 1;
                shaded += i32::from(is_shaded);
                wrong += i32::from(is_shaded != (*weight < 0.5));
            }
            assert!(shaded >= 30 && facing > 1000, "{shaded} of {facing}: a walker shades himself");
            // A knife edge leaves 0.496 at grazing incidence, and outlines end in pieces of an edge's length.
            assert!(wrong <= facing / 100, "{wrong} of {facing}");
        }
    }

    /// No vertex jumps between light and shadow while the body moves by a millimetre.
    #[test]
    fn shadows_move_smoothly() {
        let walker = walker();
        let all = vec![true; walker.skin().rest().vertices.len()];
        let antenna = DVec3::new(0.0, 0.0, 1.5);
        let at = |time_s: f64| weights(walker.skin(), &walker.posed(time_s), antenna, WAVELENGTH_M, &all);
        let (mut jumps, mut before) = (0, at(2.0));
        for i in 1..20 {
            let now = at(2.0 + 0.0005 * f64::from(i));
            jumps += before.iter().zip(&now).filter(|(a, b)| (*a - *b).abs() > 0.35).count();
            before = now;
        }
        // Of six thousand vertices in twenty steps.
        assert!(jumps < 60, "{jumps} jumps");
    }

    mod hard_cases {
        use super::*;

        /// Beside a foot, inside the chest, and very far away.
        #[test]
        fn antennas_anywhere_leave_finite_weights() {
            let walker = walker();
            let posed = walker.posed(2.0);
            let all = vec![true; posed.vertices.len()];
            let inside = posed.vertices.iter().sum::<DVec3>() / posed.vertices.len() as f64;
            for antenna in [posed.vertices[0] + DVec3::Z * 1e-3, inside, DVec3::new(1e3, -2e3, 5.0)] {
                let weights = weights(walker.skin(), &posed, antenna, WAVELENGTH_M, &all);
                assert!(weights.iter().all(|w| (0.0..=1.0).contains(w)));
            }
        }
    }
}
