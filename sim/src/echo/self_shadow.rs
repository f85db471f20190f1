//! What a body's own parts leave of the field that one of (image) antennas throws on its skin.
//!
//! Whether a place is in the light is yes or no, what arrives there is not: a knife edge's field is a continuous function of the
//! distance across to the shadow's edge, half on it, falling behind ([`crate::shadow::knife_edge`]). The shadow's edges are the
//! outlines of limbs as the antenna sees them: edges of the mesh at which triangles turn away, each of which divides light from
//! shadow only on what lies behind it and before the next thing that is seen just beside it. Seen from the antenna all are laid
//! on a plane at the body's distance, in a grid, so that a vertex looks at the few triangles and outlines that are near: what
//! a ray for each vertex and each outline would find, to which a test holds it.

use glam::{DVec3, Vec2};

use crate::actor::skin::{PosedSkin, Skin};
use crate::shadow::knife_edge;

/// Farther across from an outline than this there is all light or none, m.
const REACH_M: f32 = 0.06;
/// Width of the cells of outlines, and of triangles, m.
const CELL_M: f32 = 0.04;
const TRIANGLE_CELL_M: f32 = 0.02;
/// Beside an outline, where a ray looks for what lies behind, m.
const BESIDE_M: f32 = 1e-4;
/// Nothing shades what lies this close behind it, m: there an outline is the surface's own curving away.
const BEHIND_M: f32 = 0.02;

/// A vertex on the plane, and how far away it is, m.
#[derive(Debug, Clone, Copy, Default)]
struct Seen {
    at: Vec2,
    depth_m: f32,
}

/// An outline's piece on the plane.
#[derive(Debug, Clone, Copy)]
struct Piece {
    from: Vec2,
    to: Vec2,
    /// How far away it is, m, and how far what a ray just beside it meets.
    depth_m: f32,
    behind_m: f32,
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

/// Lists of things by the cells of a grid that they touch.
#[derive(Default)]
struct Cells {
    low: Vec2,
    per_m: f32,
    /// Number of cells along both axes.
    count: [u32; 2],
    /// Number of things so far.
    things: u32,
    cells: Vec<Cell>,
    /// Things and where their cells' lists go on.
    links: Vec<(u32, u32)>,
}

/// A cell's list.
#[derive(Debug, Clone, Copy)]
struct Cell {
    /// Where it begins among the links.
    head: u32,
    /// Least depth of its members, m: most cells have nothing in front of what is looked at.
    nearest_m: f32,
}

/// The end of a list.
const END: u32 = u32::MAX;

/// What an antenna sees of a body.
struct View<'a> {
    skin: &'a Skin,
    seen: Vec<Seen>,
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

    #[inline]
    fn seen(&self, point: DVec3) -> Seen {
        let offset = point - self.antenna;
        let scale = self.distance_m / offset.dot(self.forward);
        let at = Vec2::new((offset.dot(self.u) * scale) as f32, (offset.dot(self.v) * scale) as f32);
        Seen { at, depth_m: offset.length() as f32 }
    }
}

/// Factor on the field of an (image) antenna at each vertex that is wanted; 1 at the others.
pub fn weights(skin: &Skin, posed: &PosedSkin, antenna: DVec3, wavelength_m: f64, wanted: &[bool]) -> Vec<f64> {
    let mut all = vec![1.0; posed.vertices.len()];
    let Some(plane) = Plane::new(antenna, &posed.vertices) else { return all };
    let view = View::new(skin, posed, &plane);
    let looked_at = all.iter_mut().zip(&view.seen).zip(posed.vertices.iter().zip(&posed.normals)).zip(wanted);
    for (((weight, seen), (v, normal)), _) in looked_at.filter(|(_, wanted)| **wanted) {
        if normal.dot(antenna - *v) > 0.0 {
            *weight = view.weight(seen, wavelength_m);
        }
    }
    all
}

impl Cells {
    /// An empty grid over a box, for so many things.
    fn new(low: Vec2, high: Vec2, width_m: f32, things: usize) -> Self {
        // A body is at most a few metres; what perspective makes larger shares the last cells.
        let across = |length: f32| ((length / width_m) as u32 + 1).min(400);
        let count = [across(high.x - low.x), across(high.y - low.y)];
        let cells = vec![Cell { head: END, nearest_m: f32::INFINITY }; (count[0] * count[1]) as usize];
        Cells { low, per_m: 1.0 / width_m, count, things: 0, cells, links: Vec::with_capacity(4 * things) }
    }

    #[inline]
    fn cell(&self, at: Vec2) -> [u32; 2] {
        // Conversion saturates: what lies outside shares the cells of the rim.
        let place = (at - self.low) * self.per_m;
        [(place.x as u32).min(self.count[0] - 1), (place.y as u32).min(self.count[1] - 1)]
    }

    /// The next thing, by the box around it and its depth, m.
    #[inline]
    fn push(&mut self, low: Vec2, high: Vec2, depth_m: f32) {
        let ([x0, y0], [x1, y1]) = (self.cell(low), self.cell(high));
        let thing = self.things;
        self.things += 1;
        for y in y0..=y1 {
            let row = (y * self.count[0] + x0) as usize..=(y * self.count[0] + x1) as usize;
            for cell in self.cells.get_mut(row).into_iter().flatten() {
                self.links.push((thing, cell.head));
                cell.head = self.links.len() as u32 - 1;
                cell.nearest_m = cell.nearest_m.min(depth_m);
            }
        }
    }

    /// What may be at a place and nearer than this, m.
    #[inline]
    fn at(&self, at: Vec2, than_m: f32) -> impl Iterator<Item = usize> {
        let [x, y] = if self.cells.is_empty() { [0; 2] } else { self.cell(at) };
        let cell = self.cells.get((y * self.count[0] + x) as usize).filter(|cell| cell.nearest_m < than_m);
        let mut next = cell.map_or(END, |cell| cell.head);
        std::iter::from_fn(move || {
            let &(thing, after) = self.links.get(next as usize)?;
            next = after;
            Some(thing as usize)
        })
    }
}

impl<'a> View<'a> {
    fn new(skin: &'a Skin, posed: &PosedSkin, plane: &Plane) -> Self {
        let seen: Vec<Seen> = posed.vertices.iter().map(|&v| plane.seen(v)).collect();
        let corners_seen = skin.rest().triangles.iter().map(|t| t.map(|v| seen[v as usize]));
        let (low, high) =
            seen.iter().fold((Vec2::INFINITY, Vec2::NEG_INFINITY), |(l, h), s| (l.min(s.at), h.max(s.at)));
        let count = skin.rest().triangles.len();
        let (mut facing, mut facets) = (Vec::with_capacity(count), Vec::with_capacity(count));
        let mut triangles = Cells::new(low, high, TRIANGLE_CELL_M, count);
        // Counter-clockwise on the plane, whose third axis points away, is turned away.
        let handed = if plane.u.cross(plane.v).dot(plane.forward) < 0.0 { 1.0 } else { -1.0 };
        for [a, b, c] in corners_seen {
            let (u, v) = (b.at - a.at, c.at - a.at);
            let area = u.perp_dot(v);
            let faces = area * handed > 0.0;
            facing.push(faces);
            if faces {
                let over = 1.0 / area;
                facets.push(Facet {
                    first: a.at,
                    to_second: Vec2::new(v.y, -v.x) * over,
                    to_third: Vec2::new(-u.y, u.x) * over,
                    depth_m: a.depth_m,
                    deeper_m: [b.depth_m - a.depth_m, c.depth_m - a.depth_m],
                    nearest_m: a.depth_m.min(b.depth_m).min(c.depth_m),
                });
                let nearest_m = a.depth_m.min(b.depth_m).min(c.depth_m);
                triangles.push(a.at.min(b.at).min(c.at), a.at.max(b.at).max(c.at), nearest_m);
            }
        }
        let mut view = View { skin, seen, facing, facets, triangles, pieces: Vec::new(), outlines: Cells::default() };
        view.find_outlines(low, high);
        view
    }

    /// Depth of the nearest triangle at a place that is nearer than this, m; that itself where there is none.
    fn nearest_m(&self, at: Vec2, than_m: f32) -> f32 {
        let mut nearest = than_m;
        for number in self.triangles.at(at, than_m) {
            let Some(facet) = self.facets.get(number) else { continue };
            if facet.nearest_m >= nearest {
                continue;
            }
            let offset = at - facet.first;
            let (p, q) = (facet.to_second.dot(offset), facet.to_third.dot(offset));
            if p >= 0.0 && q >= 0.0 && p + q <= 1.0 {
                nearest = nearest.min(facet.depth_m + p * facet.deeper_m[0] + q * facet.deeper_m[1]);
            }
        }
        nearest
    }

    fn find_outlines(&mut self, low: Vec2, high: Vec2) {
        let faces = |t: u32| self.facing.get(t as usize).copied().unwrap_or(false);
        let mut pieces = Vec::new();
        for edge in self.skin.edges() {
            let [left, right] = edge.triangles;
            if faces(left) == faces(right) {
                continue;
            }
            let [p, q] = edge.vertices;
            let (from, to) = (self.seen[p as usize], self.seen[q as usize]);
            let along = to.at - from.at;
            // Both triangles lie on the same side of it; the third corner of either says which.
            let corners = self.skin.rest().triangles.get(left as usize);
            let third = corners.and_then(|t| t.iter().find(|v| **v != p && **v != q));
            let Some(&third) = third else { continue };
            let side = along.perp_dot(self.seen[third as usize].at - from.at);
            let outward = (if side > 0.0 { -along.perp() } else { along.perp() }).normalize_or_zero();
            let depth_m = 0.5 * (from.depth_m + to.depth_m);
            let behind_m = self.nearest_m(0.5 * (from.at + to.at) + outward * BESIDE_M, f32::INFINITY);
            // What is itself hidden hides nothing more.
            if behind_m > depth_m - 1e-3 {
                pieces.push(Piece { from: from.at, to: to.at, depth_m, behind_m });
            }
        }
        self.outlines = Cells::new(low, high, CELL_M, pieces.len());
        for piece in &pieces {
            let (low, high) = (piece.from.min(piece.to) - REACH_M, piece.from.max(piece.to) + REACH_M);
            self.outlines.push(low, high, piece.depth_m);
        }
        self.pieces = pieces;
    }

    /// Field at a vertex.
    fn weight(&self, &Seen { at, depth_m }: &Seen, wavelength_m: f64) -> f64 {
        let least_m = depth_m - BEHIND_M;
        // Squared distance across in units of the first Fresnel zone, and in metres.
        let (mut nearest, mut across_m2) = (f32::INFINITY, f32::INFINITY);
        for member in self.outlines.at(at, least_m) {
            let Some(piece) = self.pieces.get(member) else { continue };
            let behind_m = depth_m - piece.depth_m;
            if behind_m < BEHIND_M || piece.behind_m < least_m {
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
        let shaded = self.nearest_m(at, least_m) < least_m;
        if across_m2 > REACH_M * REACH_M {
            return if shaded { 0.0 } else { 1.0 };
        }
        let nu = (2.0 * f64::from(nearest) / wavelength_m).sqrt();
        if shaded {
            // To nothing at the end of the reach.
            let part = f64::from(across_m2 / (REACH_M * REACH_M));
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
                let is_shaded = hit.is_some_and(|hit| hit.distance_m < depth_m - f64::from(BEHIND_M));
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
