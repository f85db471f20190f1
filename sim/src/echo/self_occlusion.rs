//! Self-occlusion: obstruction of an (image) antenna's field at a body's skin by other parts of the body.
//!
//! Geometrical visibility is binary, but the field is not. The field behind a knife edge is a continuous function of
//! the distance to the shadow boundary: half on it, and decaying behind it ([`crate::diffraction::knife_edge`]). Shadow
//! boundaries are the outlines of limbs seen from the antenna: mesh edges between a triangle that faces the antenna and
//! one that faces away. An outline affects only surfaces between it and the next surface that is visible just beside
//! it. Triangles and outlines are projected from the antenna to a plane at the body's distance and entered in a grid. A
//! vertex thus tests only the few of them nearby. Most of a body hides nothing else of it, so the grids hold only what
//! lies in front of a queried point. A test compares the result with rays to each vertex.

// Loops use lane indices: several rows are accessed together, and the compiler vectorises these loops.
#![allow(clippy::needless_range_loop)]

use glam::{DVec3, Vec2};
use radome_dsp::KernelLevel;

use crate::diffraction::knife_edge;
use crate::lanes::{LANES, compiled_for_levels};
use crate::people::skin::{PosedSkin, Skin};

/// Distance across from an outline beyond which there is full field or none, m.
const REACH_M: f32 = 0.06;
/// Width of the cells of outlines, and of triangles, m.
const CELL_M: f32 = 0.04;
const TRIANGLE_CELL_M: f32 = 0.02;
/// Offset beside an outline at which a ray finds the surface behind, m.
const BESIDE_M: f32 = 1e-4;
/// Depth behind a surface within which it casts no shadow, m. There an outline is the curvature of the surface itself.
const BEHIND_M: f32 = 0.02;

/// Vertex projected to the plane, and its distance from the antenna, m.
#[derive(Debug, Clone, Copy, Default)]
struct ProjectedVertex {
    at: Vec2,
    depth_m: f32,
}

/// Segment of an outline on the plane.
#[derive(Debug, Clone, Copy)]
struct OutlineSegment {
    from: Vec2,
    to: Vec2,
    /// Distance from the antenna, m.
    depth_m: f32,
    /// Distance from the antenna to the surface that a ray just beside the outline meets, m.
    behind_m: f32,
}

/// Triangle on the plane, prepared for point location: the weights of the second and third corner at a point are
/// `to_second . (at - first)` and `to_third . (at - first)`.
#[derive(Debug, Clone, Copy)]
struct Facet {
    first: Vec2,
    to_second: Vec2,
    to_third: Vec2,
    /// Depth of the first corner, excess depth of the others, and depth of the nearest, m.
    depth_m: f32,
    deeper_m: [f32; 2],
    nearest_m: f32,
}

/// Grid of lists: each cell lists the entries that touch it and lie in front of a queried point.
struct Cells<T> {
    low: Vec2,
    per_m: f32,
    /// Number of cells along both axes.
    count: [u32; 2],
    cells: Vec<Cell>,
    entries: Vec<T>,
    /// Linked lists: index of an entry, and index of the next link.
    links: Vec<(u32, u32)>,
}

/// A cell's list.
#[derive(Debug, Clone, Copy)]
struct Cell {
    /// Index of the first link.
    head: u32,
    /// Least depth of its members, m. It allows an early exit, because most cells have nothing in front of the queried
    /// point.
    nearest_m: f32,
    /// Largest depth that is queried in this cell, m.
    query_depth_m: f32,
}

/// End of a list.
const END: u32 = u32::MAX;

/// Projection of a body seen from an antenna, reduced to what lies in front of queried points.
struct Projection {
    triangles: Cells<Facet>,
    outlines: Cells<OutlineSegment>,
}

/// Projection plane: perspective from the antenna, in metres at the body's distance.
struct Plane {
    /// Middle of the body.
    middle: DVec3,
    forward: DVec3,
    u: DVec3,
    v: DVec3,
    distance_m: f64,
}

impl Plane {
    /// Creates the plane; `None` where the antenna is so near that parts of the body are beside it.
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
        Some(Plane { middle, forward, u, v, distance_m })
    }
}

compiled_for_levels! {
    /// Appends the projections of vertices.
    fn project_vertices(plane: &Plane, vertices: &[DVec3], projected: &mut Vec<ProjectedVertex>) = project_body;
}

#[inline(always)]
fn project_body(plane: &Plane, vertices: &[DVec3], projected: &mut Vec<ProjectedVertex>) {
    let (f, u, v) = (plane.forward.as_vec3(), plane.u.as_vec3(), plane.v.as_vec3());
    let distance_m = plane.distance_m as f32;
    for vertices in vertices.chunks(LANES) {
        // Coordinates are relative to the middle of the body, where single precision resolves a tenth of a micrometre.
        let (mut x, mut y, mut z) = ([0f32; LANES], [0f32; LANES], [0f32; LANES]);
        for (l, &vertex) in vertices.iter().enumerate() {
            let offset = vertex - plane.middle;
            (x[l], y[l], z[l]) = (offset.x as f32, offset.y as f32, offset.z as f32);
        }
        let (mut right, mut up, mut depth_m) = ([0f32; LANES], [0f32; LANES], [0f32; LANES]);
        for l in 0..LANES {
            let ahead = distance_m + (x[l] * f.x + y[l] * f.y + z[l] * f.z);
            let across = x[l] * u.x + y[l] * u.y + z[l] * u.z;
            let above = x[l] * v.x + y[l] * v.y + z[l] * v.z;
            let scale = distance_m / ahead;
            (right[l], up[l]) = (across * scale, above * scale);
            depth_m[l] = (ahead * ahead + (across * across + above * above)).sqrt();
        }
        for l in 0..vertices.len() {
            projected.push(ProjectedVertex { at: Vec2::new(right[l], up[l]), depth_m: depth_m[l] });
        }
    }
}

/// Returns the factor on the field of an (image) antenna at each vertex in `is_wanted`; 1 at the others.
pub fn factors(skin: &Skin, posed: &PosedSkin, antenna: DVec3, wavelength_m: f64, is_wanted: &[bool]) -> Vec<f64> {
    let mut factors = vec![1.0; posed.vertices.len()];
    let Some(plane) = Plane::new(antenna, &posed.vertices) else { return factors };
    let mut projected = Vec::with_capacity(posed.vertices.len());
    project_vertices(KernelLevel::detect(), &plane, &posed.vertices, &mut projected);
    let is_queried = |&v: &usize| is_wanted[v] && posed.normals[v].dot(antenna - posed.vertices[v]) > 0.0;
    let queried: Vec<usize> = (0..projected.len()).filter(is_queried).collect();
    let projection = Projection::new(skin, &plane, &projected, &queried);
    for v in queried {
        factors[v] = projection.factor_at(&projected[v], wavelength_m);
    }
    factors
}

impl<T> Cells<T> {
    /// Creates an empty grid over a box.
    fn new(low: Vec2, high: Vec2, width_m: f32) -> Self {
        // The grid covers a body of a few metres; points enlarged by perspective beyond it share the last cells.
        let across = |length: f32| ((length / width_m) as u32 + 1).min(400);
        let count = [across(high.x - low.x), across(high.y - low.y)];
        let empty = Cell { head: END, nearest_m: f32::INFINITY, query_depth_m: f32::NEG_INFINITY };
        let cells = vec![empty; (count[0] * count[1]) as usize];
        Cells { low, per_m: 1.0 / width_m, count, cells, entries: Vec::new(), links: Vec::new() }
    }

    #[inline]
    fn cell(&self, at: Vec2) -> [u32; 2] {
        // Points outside share the border cells.
        let cells = (at - self.low) * self.per_m;
        let number = |cells: f32, count: u32| (cells as i32).clamp(0, count as i32 - 1) as u32;
        [number(cells.x, self.count[0]), number(cells.y, self.count[1])]
    }

    fn number(&self, at: Vec2) -> usize {
        let [x, y] = self.cell(at);
        (y * self.count[0] + x) as usize
    }

    /// Registers a query at a point for everything nearer than a depth, m.
    fn register_query(&mut self, at: Vec2, depth_m: f32) {
        let number = self.number(at);
        if let Some(cell) = self.cells.get_mut(number) {
            cell.query_depth_m = cell.query_depth_m.max(depth_m);
        }
    }

    /// Returns the first and the last cell along both axes that a box touches.
    fn around(&self, (low, high): (Vec2, Vec2)) -> [[u32; 2]; 2] {
        let ([x0, y0], [x1, y1]) = (self.cell(low), self.cell(high));
        [[x0, x1], [y0, y1]]
    }

    /// Returns whether any query in these cells covers this depth, m.
    #[inline]
    fn has_query(&self, [[x0, x1], [y0, y1]]: [[u32; 2]; 2], depth_m: f32) -> bool {
        let query_depth_m = |x: u32, y: u32| {
            let cell = self.cells.get((y * self.count[0] + x) as usize);
            cell.map_or(f32::NEG_INFINITY, |cell| cell.query_depth_m)
        };
        // In most cases the corner cells are all cells.
        if x1 - x0 < 2 && y1 - y0 < 2 {
            let below = (depth_m < query_depth_m(x0, y0)) | (depth_m < query_depth_m(x1, y0));
            return below | (depth_m < query_depth_m(x0, y1)) | (depth_m < query_depth_m(x1, y1));
        }
        (y0..=y1).any(|y| (x0..=x1).any(|x| depth_m < query_depth_m(x, y)))
    }

    /// Adds an entry to those of these cells that have a query beyond its depth.
    #[inline]
    fn push(&mut self, [[x0, x1], [y0, y1]]: [[u32; 2]; 2], depth_m: f32, entry: T) {
        let number = self.entries.len() as u32;
        for y in y0..y1 + 1 {
            let row = (y * self.count[0] + x0) as usize..(y * self.count[0] + x1 + 1) as usize;
            for cell in
                self.cells.get_mut(row).unwrap_or_default().iter_mut().filter(|cell| depth_m < cell.query_depth_m)
            {
                self.links.push((number, cell.head));
                cell.head = self.links.len() as u32 - 1;
                cell.nearest_m = cell.nearest_m.min(depth_m);
            }
        }
        self.entries.push(entry);
    }

    /// Iterates over the entries of a point's cell, if any of them is nearer than a depth, m.
    #[inline]
    fn at(&self, at: Vec2, depth_m: f32) -> impl Iterator<Item = &T> {
        let cell = self.cells.get(self.number(at)).filter(|cell| cell.nearest_m < depth_m);
        let mut next = cell.map_or(END, |cell| cell.head);
        std::iter::from_fn(move || {
            let &(entry, after) = self.links.get(next as usize)?;
            next = after;
            self.entries.get(entry as usize)
        })
    }
}

impl Projection {
    fn new(skin: &Skin, plane: &Plane, projected: &[ProjectedVertex], queried: &[usize]) -> Self {
        let (low, high) =
            projected.iter().fold((Vec2::INFINITY, Vec2::NEG_INFINITY), |(l, h), s| (l.min(s.at), h.max(s.at)));
        let (mut triangles, mut outlines) = (Cells::new(low, high, TRIANGLE_CELL_M), Cells::new(low, high, CELL_M));
        for ProjectedVertex { at, depth_m } in queried.iter().map(|&v| projected[v]) {
            triangles.register_query(at, depth_m - BEHIND_M);
            outlines.register_query(at, depth_m - BEHIND_M);
        }
        let corners = |t: usize| {
            let [a, b, c] = skin.rest().triangles[t];
            [projected[a as usize], projected[b as usize], projected[c as usize]]
        };
        // Counter-clockwise triangles face away, as the third axis of the plane points away from the antenna.
        let handedness = if plane.u.cross(plane.v).dot(plane.forward) < 0.0 { 1.0 } else { -1.0 };
        let faces = |[a, b, c]: [ProjectedVertex; 3]| (b.at - a.at).perp_dot(c.at - a.at) * handedness > 0.0;
        let facing: Vec<bool> = (0..skin.rest().triangles.len()).map(|t| faces(corners(t))).collect();
        let outline_segments = outline_segments(skin, projected, &facing, &outlines);
        for (_, beside) in &outline_segments {
            triangles.register_query(*beside, f32::INFINITY);
        }
        let cells: Vec<[u32; 2]> = projected.iter().map(|s| triangles.cell(s.at)).collect();
        for t in (0..facing.len()).filter(|&t| facing[t]) {
            let [p, q, r] = skin.rest().triangles[t];
            let (p, q, r) = (cells[p as usize], cells[q as usize], cells[r as usize]);
            let along = |axis: usize| [p[axis].min(q[axis]).min(r[axis]), p[axis].max(q[axis]).max(r[axis])];
            let around = [along(0), along(1)];
            let [a, b, c] = corners(t);
            let nearest_m = a.depth_m.min(b.depth_m).min(c.depth_m);
            if triangles.has_query(around, nearest_m) {
                triangles.push(around, nearest_m, Facet::new([a, b, c]));
            }
        }
        let mut projection = Projection { triangles, outlines };
        for (mut outline, beside) in outline_segments {
            outline.behind_m = projection.nearest_m(beside, f32::INFINITY);
            // A hidden outline casts no further shadow.
            if outline.behind_m > outline.depth_m - 1e-3 {
                projection.outlines.push(projection.outlines.around(outline.affected_box()), outline.depth_m, outline);
            }
        }
        projection
    }

    /// Returns the depth of the nearest triangle at a point, m, but no more than `depth_m`.
    fn nearest_m(&self, at: Vec2, depth_m: f32) -> f32 {
        let mut nearest = depth_m;
        for facet in self.triangles.at(at, depth_m) {
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

    /// Returns the factor on the field at a vertex.
    fn factor_at(&self, &ProjectedVertex { at, depth_m }: &ProjectedVertex, wavelength_m: f64) -> f64 {
        let least_m = depth_m - BEHIND_M;
        // Squared distance across in units of the first Fresnel zone, and in metres.
        let (mut nearest, mut across_m2) = (f32::INFINITY, f32::INFINITY);
        for outline in self.outlines.at(at, least_m) {
            let behind_m = depth_m - outline.depth_m;
            if behind_m < BEHIND_M || outline.behind_m < least_m {
                continue;
            }
            let along = outline.to - outline.from;
            let fraction = ((at - outline.from).dot(along) / along.length_squared().max(1e-18)).clamp(0.0, 1.0);
            // Distances are measured on the plane at the body's distance. The slight magnification of nearer parts is
            // neglected.
            let distance2 = (outline.from + along * fraction).distance_squared(at);
            let zones = distance2 * depth_m / (outline.depth_m * behind_m);
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
            // The factor falls to zero at the end of the reach.
            let fraction = f64::from(across_m2 / (REACH_M * REACH_M));
            knife_edge(nu) * (1.0 - fraction) * (1.0 - fraction)
        } else {
            knife_edge(-nu)
        }
    }
}

/// Returns the outline segments near which something behind them is queried. Each comes with the point just beside it
/// at which the surface behind is to be found; `behind_m` is not yet set.
fn outline_segments(
    skin: &Skin,
    projected: &[ProjectedVertex],
    facing: &[bool],
    outlines: &Cells<OutlineSegment>,
) -> Vec<(OutlineSegment, Vec2)> {
    let mut outline_segments = Vec::new();
    for edge in skin.edges() {
        let [left, right] = edge.triangles;
        // The border of an open surface is an outline of its facing triangles.
        let ends = left == right && facing[left as usize];
        if facing[left as usize] == facing[right as usize] && !ends {
            continue;
        }
        let [p, q] = edge.vertices;
        let (from, to) = (projected[p as usize], projected[q as usize]);
        let depth_m = 0.5 * (from.depth_m + to.depth_m);
        let outline = OutlineSegment { from: from.at, to: to.at, depth_m, behind_m: f32::INFINITY };
        if !outlines.has_query(outlines.around(outline.affected_box()), depth_m) {
            continue;
        }
        // Both triangles lie on the same side of the outline; the third corner of either gives the side.
        let corners = skin.rest().triangles.get(left as usize);
        let third = corners.and_then(|t| t.iter().find(|v| **v != p && **v != q));
        let Some(&third) = third else { continue };
        let along = to.at - from.at;
        let side = along.perp_dot(projected[third as usize].at - from.at);
        let outward = (if side > 0.0 { -along.perp() } else { along.perp() }).normalize_or_zero();
        outline_segments.push((outline, 0.5 * (from.at + to.at) + outward * BESIDE_M));
    }
    outline_segments
}

impl OutlineSegment {
    /// Returns the box within which the segment affects the field.
    fn affected_box(&self) -> (Vec2, Vec2) {
        (self.from.min(self.to) - REACH_M, self.from.max(self.to) + REACH_M)
    }
}

impl Facet {
    fn new([a, b, c]: [ProjectedVertex; 3]) -> Self {
        let (u, v) = (b.at - a.at, c.at - a.at);
        let over = 1.0 / u.perp_dot(v);
        Facet {
            first: a.at,
            to_second: Vec2::new(v.y, -v.x) * over,
            to_third: Vec2::new(-u.y, u.x) * over,
            depth_m: a.depth_m,
            deeper_m: [b.depth_m - a.depth_m, c.depth_m - a.depth_m],
            nearest_m: a.depth_m.min(b.depth_m).min(c.depth_m),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::people::motion::{MotionBuilder, Person};
    use crate::people::skin::EDGE_M;
    use crate::people::walking_mesh::WalkingMesh;
    use crate::rays::{Ray, RayTracer};

    const WAVELENGTH_M: f64 = 0.005;

    fn walker() -> WalkingMesh {
        let person = Person::draw(1, [0, 0], 1.75);
        let motion = MotionBuilder::new(person, 0.0, [1.0, 0.0], 0.4).walk_to([7.0, 2.0], 1.2).stay();
        WalkingMesh::new(Arc::new(motion), EDGE_M)
    }

    /// The field exceeds one half where a ray reaches the vertex, and is below one half elsewhere.
    #[test]
    fn vertices_reached_by_rays_are_lit() {
        let walker = walker();
        let all = vec![true; walker.skin().rest().vertices.len()];
        for (time_s, antenna) in [(2.0, DVec3::new(0.0, 0.0, 1.5)), (2.4, DVec3::new(8.0, -1.0, 0.9))] {
            let posed = walker.posed(time_s);
            let mesh = walker.mesh_at(time_s);
            let groups: Vec<u32> = (0..mesh.triangles.len() as u32).collect();
            let tracer = RayTracer::new(mesh, &groups).expect("tracer");
            let factors = factors(walker.skin(), &posed, antenna, WAVELENGTH_M, &all);
            let (mut shaded, mut wrong, mut facing) = (0, 0, 0);
            for ((factor, v), normal) in factors.iter().zip(&posed.vertices).zip(&posed.normals) {
                let depth_m = v.distance(antenna);
                if normal.dot(antenna - *v) <= 0.3 * depth_m {
                    continue;
                }
                let hit = tracer.closest(&Ray::between(antenna, *v));
                let is_shaded = hit.is_some_and(|hit| hit.distance_m < depth_m - f64::from(BEHIND_M));
                facing += 1;
                shaded += i32::from(is_shaded);
                wrong += i32::from(is_shaded != (*factor < 0.5));
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
        let at = |time_s: f64| factors(walker.skin(), &walker.posed(time_s), antenna, WAVELENGTH_M, &all);
        let (mut jumps, mut before) = (0, at(2.0));
        for i in 1..20 {
            let now = at(2.0 + 0.0005 * f64::from(i));
            jumps += before.iter().zip(&now).filter(|(a, b)| (*a - *b).abs() > 0.35).count();
            before = now;
        }
        // This is out of six thousand vertices in twenty steps.
        assert!(jumps < 60, "{jumps} jumps");
    }

    mod hard_cases {
        use super::*;

        /// Factors stay between 0 and 1 for antennas beside a foot, inside the chest, and very far away.
        #[test]
        fn antennas_anywhere_give_finite_factors() {
            let walker = walker();
            let posed = walker.posed(2.0);
            let all = vec![true; posed.vertices.len()];
            let inside = posed.vertices.iter().sum::<DVec3>() / posed.vertices.len() as f64;
            for antenna in [posed.vertices[0] + DVec3::Z * 1e-3, inside, DVec3::new(1e3, -2e3, 5.0)] {
                let factors = factors(walker.skin(), &posed, antenna, WAVELENGTH_M, &all);
                assert!(factors.iter().all(|w| (0.0..=1.0).contains(w)));
            }
        }
    }
}
