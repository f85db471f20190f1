//! Skin of a person: one mesh whose vertices follow bones. The skin of the parametric walker is a closed smooth surface
//! around the thirteen ellipsoids of [`super::body`]. It is made once in a pose with limbs apart. The skin of an actor
//! from a file ([`super::imported`]) follows the file's joints.
//!
//! A vertex is a weighted mean of points, each of which moves with one bone. For the walker, a point moves like a point
//! of the ellipsoid's own surface (`sum w_i (centre_i + axes_i (semi_axes_i u_i))`). Its motion therefore includes
//! gait, twist and breath. The velocity of a vertex is the same sum over the bones' rates. These come from the pose in
//! f64 and never from differences of vertices.

use std::ops::Range;

use glam::{DMat3, DVec3};

use super::body::{Build, CHEST, FOOT, FOREARM, HEAD, PELVIS, SEGMENTS, SHANK, THIGH, UPPER_ARM, half_extent};
use crate::em::specular::Ellipsoid;
use crate::geometry::{Edge, Mesh, Surface, edges, isosurface, one_ring_normals};
use crate::lanes::LANES;

/// Length of edges, m. A person of 1.75 m then has about 14000 triangles.
pub const EDGE_M: f64 = 0.020;
/// Scale of the blend between parts, m.
const BLEND_M: f64 = 0.014;
/// Distance beyond the nearest part, in units of [`BLEND_M`], at which another part contributes only 1e-9.
const NEGLIGIBLE_BLENDS: f64 = 20.0;
/// Distance from its own surface up to which a segment moves the skin, m.
const REACH_M: f64 = 0.085;
/// Distance beyond which a part contributes neither to the surface nor to its motion, with blending taken into account,
/// m.
const FAR_M: f64 = 0.15;
/// Upper limit of the number of parts; no body has as many.
const MOST_PARTS: usize = 32;
/// Angles by which arms and legs are raised sideways in the rest pose, rad, so that they do not merge.
const ARM_APART_RAD: f64 = 0.5;
const LEG_APART_RAD: f64 = 0.10;
/// Largest distance in a patch from its first triangle, m. Over it the tones of a chirp differ by a tenth of a cell.
const PATCH_M: f64 = 0.05;
/// Radius of the thinnest limbs, m.
const LIMB_RADIUS_M: f64 = 0.04;
/// Iterations of averaging curvatures over neighbours.
const CURVATURE_SMOOTHING: usize = 4;

/// A solid part of the body, with the segment that moves it.
#[derive(Debug, Clone, Copy)]
enum Part {
    Ellipsoid(usize, Ellipsoid),
    /// Rounded cone between two spheres: centres and radii.
    Cone(usize, [DVec3; 2], [f64; 2]),
}

/// Bounding sphere of a part, and a lower bound of the slope of [`Part::distance_m`] with distance from it.
#[derive(Debug, Clone, Copy)]
struct BoundingSphere {
    centre: DVec3,
    radius_m: f64,
    slope: f64,
}

impl BoundingSphere {
    /// Lower bound of the distance to the part's surface, m.
    fn least_distance_m(&self, p: DVec3) -> f64 {
        (p.distance(self.centre) - self.radius_m).max(0.0) * self.slope
    }
}

impl Part {
    fn bounding_sphere(&self) -> BoundingSphere {
        match *self {
            Part::Ellipsoid(_, e) => {
                let radius_m = e.semi_axes_m.max_element();
                BoundingSphere { centre: e.centre, radius_m, slope: e.semi_axes_m.min_element() / radius_m }
            }
            Part::Cone(_, [a, b], [ra, rb]) => {
                BoundingSphere { centre: 0.5 * (a + b), radius_m: 0.5 * a.distance(b) + ra.max(rb), slope: 1.0 }
            }
        }
    }

    fn segment(&self) -> usize {
        match *self {
            Part::Ellipsoid(segment, _) | Part::Cone(segment, ..) => segment,
        }
    }

    /// Approximate distance to the surface, m; negative inside.
    fn distance_m(&self, p: DVec3) -> f64 {
        match self {
            Part::Ellipsoid(_, e) => {
                let local = e.axes.transpose() * (p - e.centre);
                let unit = (local / e.semi_axes_m).length();
                let slope = (local / (e.semi_axes_m * e.semi_axes_m)).length();
                if slope > 1e-9 { unit * (unit - 1.0) / slope } else { -e.semi_axes_m.min_element() }
            }
            Part::Cone(_, [a, b], [ra, rb]) => {
                let axis = *b - *a;
                let along = ((p - *a).dot(axis) / axis.length_squared()).clamp(0.0, 1.0);
                p.distance(*a + axis * along) - (ra + (rb - ra) * along)
            }
        }
    }
}

/// Smooth minimum of the distances to all parts, m: `-BLEND_M ln sum exp(-d / BLEND_M)`, computed relative to the least
/// distance. Farther than [`FAR_M`] from all parts, it is a lower bound.
fn blended_distance_m(point: DVec3, parts: &[(Part, BoundingSphere)]) -> f64 {
    let mut at_least_m = [f64::INFINITY; MOST_PARTS];
    let (mut nearest, mut nearest_m) = (0, f64::INFINITY);
    for (i, (at_least, (_, sphere))) in at_least_m.iter_mut().zip(parts).enumerate() {
        *at_least = sphere.least_distance_m(point);
        (nearest, nearest_m) = if *at_least < nearest_m { (i, *at_least) } else { (nearest, nearest_m) };
    }
    let Some((nearest_part, _)) = parts.get(nearest) else { return f64::INFINITY };
    if nearest_m > FAR_M {
        return nearest_m - BLEND_M * (parts.len() as f64).ln();
    }
    // Parts that are negligible relative to the seemingly nearest part are skipped.
    let farthest = nearest_part.distance_m(point) + NEGLIGIBLE_BLENDS * BLEND_M;
    let (mut least_m, mut sum) = (f64::INFINITY, 0.0);
    for ((part, _), _) in parts.iter().zip(at_least_m).filter(|(_, at_least)| *at_least < farthest) {
        let distance_m = part.distance_m(point);
        if distance_m < least_m {
            sum = sum * ((distance_m - least_m) / BLEND_M).exp() + 1.0;
            least_m = distance_m;
        } else if distance_m - least_m < NEGLIGIBLE_BLENDS * BLEND_M {
            sum += ((least_m - distance_m) / BLEND_M).exp();
        }
    }
    least_m - BLEND_M * f64::ln(sum)
}

/// A skin that can take any posture of its bones.
#[derive(Debug, Clone, PartialEq)]
pub struct Skin {
    rest: Mesh,
    /// Segment of the body to which each bone belongs.
    segment_of: Vec<usize>,
    edges: Vec<SkinEdge>,
    /// Range of each vertex in `influences`.
    bindings: Vec<Range<usize>>,
    /// Influences of all vertices.
    influences: Vec<Influence>,
    patches: Vec<SkinPatch>,
    narrowing: Vec<f32>,
}

/// Influence of a bone on a vertex.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Influence {
    /// Index of the bone.
    pub(super) bone: usize,
    /// Weight; the weights of a vertex sum to one.
    pub(super) weight: f64,
    /// Vertex in the bone's own frame; for the walker's bones in units of the segment's semi-axes.
    pub(super) point: DVec3,
}

/// A connected set of consecutive triangles. Neither the triangles nor their vertices exceed the number of lanes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SkinPatch {
    /// Indices of the triangles.
    pub triangles: Range<usize>,
    /// Indices of the vertices. Unused lanes repeat the first vertex.
    pub vertices: [u32; LANES],
    /// Indices of each triangle's corners into `vertices`; all the same in lanes without a triangle.
    pub corners: [[usize; 3]; LANES],
}

/// An edge of a skin.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SkinEdge {
    /// Indices of its vertices.
    pub vertices: [u32; 2],
    /// Triangles on either side; the same index twice where the surface ends.
    pub triangles: [u32; 2],
}

/// Pose of a skin at one time, for a surface integral.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct PosedSkin {
    /// Positions of the vertices, m.
    pub vertices: Vec<DVec3>,
    /// Velocities of the vertices, m/s.
    pub velocities_m_per_s: Vec<DVec3>,
    /// Unit normals at the vertices.
    pub normals: Vec<DVec3>,
}

impl Skin {
    /// Makes the skin of a build, with edges of about `edge_m` (15 to 25 mm; hands and feet are lost beyond 35 mm).
    pub fn new(build: &Build, edge_m: f64) -> Self {
        let segments = spread_segments(build);
        let parts: Vec<(Part, BoundingSphere)> =
            solid_parts(&segments, build).into_iter().map(|part| (part, part.bounding_sphere())).collect();
        let of_segment = |segment: usize| parts.iter().filter(|(part, _)| part.segment() == segment).copied().collect();
        let by_segment: [Vec<(Part, BoundingSphere)>; SEGMENTS] = std::array::from_fn(of_segment);
        let around = segments.iter().map(|e| (e.centre, half_extent(e)));
        let (least, greatest) =
            around.fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(l, g), (c, half)| (l.min(c - half), g.max(c + half)));
        let margin = DVec3::splat(0.06 + 2.0 * edge_m);
        let rest = isosurface(least - margin, greatest + margin, edge_m, |p| blended_distance_m(p, &parts));
        let (mut skin, _) = Skin::unbound(&rest, (0..SEGMENTS).collect());
        for &vertex in &skin.rest.vertices {
            let first = skin.influences.len();
            let weight = |segment: usize| {
                let distance = blended_distance_m(vertex, &by_segment[segment]).max(0.0);
                (1.0 - distance / REACH_M).max(0.0).powi(3)
            };
            let weights: [f64; SEGMENTS] = std::array::from_fn(weight);
            let total: f64 = weights.iter().sum();
            for ((segment, e), weight) in segments.iter().enumerate().zip(weights).filter(|(_, weight)| *weight > 0.0) {
                let unit = (e.axes.transpose() * (vertex - e.centre)) / e.semi_axes_m;
                skin.influences.push(Influence { bone: segment, weight: weight / total, point: unit });
            }
            skin.bindings.push(first..skin.influences.len());
        }
        skin
    }

    /// Makes a skin from a mesh in a rest pose, every edge with one triangle or two. `influences` states for each
    /// vertex the bones that move it. `segment_of` states the body segment of each bone.
    pub(super) fn bound(rest: &Mesh, influences: &[Vec<Influence>], segment_of: Vec<usize>) -> Self {
        let (mut skin, original) = Skin::unbound(rest, segment_of);
        for of_vertex in original.iter().map(|&v| influences.get(v as usize).map(Vec::as_slice).unwrap_or_default()) {
            let first = skin.influences.len();
            skin.influences.extend_from_slice(of_vertex);
            skin.bindings.push(first..skin.influences.len());
        }
        skin
    }

    /// Makes a skin of a mesh without bindings to bones. Also returns the original index of each of its vertices.
    fn unbound(mesh: &Mesh, segment_of: Vec<usize>) -> (Self, Vec<u32>) {
        let (rest, patches, original) = in_patch_order(mesh);
        let edges = skin_edges(&rest);
        let narrowing = narrowing(&rest, &edges);
        let (bindings, influences) = (Vec::new(), Vec::new());
        (Skin { rest, segment_of, edges, bindings, influences, patches, narrowing }, original)
    }

    /// Makes the skin of a rigid body at a fixed position, and its pose.
    pub(crate) fn still(surface: &Surface) -> (Self, PosedSkin) {
        let (skin, original) = Skin::unbound(&surface.mesh(), Vec::new());
        let posed = PosedSkin {
            vertices: skin.rest.vertices.clone(),
            velocities_m_per_s: vec![DVec3::ZERO; original.len()],
            normals: original.iter().map(|&v| surface.normals.get(v as usize).copied().unwrap_or(DVec3::Z)).collect(),
        };
        (skin, posed)
    }

    /// Mesh in its rest pose, over the origin, facing +x.
    pub fn rest(&self) -> &Mesh {
        &self.rest
    }

    /// Edges of the skin.
    pub fn edges(&self) -> &[SkinEdge] {
        &self.edges
    }

    /// Small connected patches, which together contain every triangle.
    pub fn patches(&self) -> &[SkinPatch] {
        &self.patches
    }

    /// Factor by which the relevant region around a specular point is narrower, as an angle, than on the thinnest limb;
    /// by vertex. Phase grows with the radius of curvature times the square of the angle.
    pub fn narrowing(&self) -> &[f32] {
        &self.narrowing
    }

    /// Returns a quantity of the segments for each vertex, weighted as the vertex follows the segments.
    pub fn blend(&self, of_segment: &[f64; SEGMENTS]) -> Vec<f64> {
        let of_bone: Vec<f64> = self.segment_of.iter().map(|&s| of_segment[s]).collect();
        let weighted = |influence: &Influence| influence.weight * of_bone[influence.bone];
        self.bindings.iter().map(|b| self.influences(b).iter().map(weighted).sum()).collect()
    }

    fn influences(&self, binding: &Range<usize>) -> &[Influence] {
        self.influences.get(binding.clone()).unwrap_or_default()
    }

    /// Returns the vertices for a pose of the bones, or their velocities for its rate.
    pub(super) fn pose(&self, maps: &[BoneMap]) -> Vec<DVec3> {
        let weighted =
            |&Influence { bone, weight, point }: &Influence| (maps[bone].centre + maps[bone].linear * point) * weight;
        self.bindings.iter().map(|b| self.influences(b).iter().map(weighted).sum()).collect()
    }
}

/// Square root of every vertex's least radius of curvature, smoothed, relative to that of a thin limb.
fn narrowing(mesh: &Mesh, edges: &[SkinEdge]) -> Vec<f32> {
    let normals = one_ring_normals(&mesh.vertices, &mesh.triangles);
    let mut curvatures = vec![0f64; mesh.vertices.len()];
    for edge in edges {
        let [a, b] = edge.vertices.map(|v| v as usize);
        let d = mesh.vertices[b] - mesh.vertices[a];
        let curvature = (normals[b] - normals[a]).dot(d).abs() / d.length_squared();
        for v in [a, b] {
            curvatures[v] = curvatures[v].max(curvature);
        }
    }
    for _ in 0..CURVATURE_SMOOTHING {
        let mut sums: Vec<(f64, f64)> = curvatures.iter().map(|&c| (c, 1.0)).collect();
        for edge in edges {
            let [a, b] = edge.vertices.map(|v| v as usize);
            sums[a] = (sums[a].0 + curvatures[b], sums[a].1 + 1.0);
            sums[b] = (sums[b].0 + curvatures[a], sums[b].1 + 1.0);
        }
        curvatures = sums.into_iter().map(|(sum, count)| sum / count).collect();
    }
    curvatures.iter().map(|c| (1.0 / (c * LIMB_RADIUS_M).max(1e-3)).sqrt().clamp(1.0, 3.0) as f32).collect()
}

fn skin_edges(mesh: &Mesh) -> Vec<SkinEdge> {
    let edge =
        |edge: &Edge| SkinEdge { vertices: edge.vertices, triangles: [edge.left, edge.right.unwrap_or(edge.left)] };
    edges(mesh).iter().map(edge).collect()
}

/// Returns the mesh with triangles sorted by patch and vertices in order of use, so that each patch is contiguous in
/// memory. Also returns the patches, and the original index of every vertex.
fn in_patch_order(mesh: &Mesh) -> (Mesh, Vec<SkinPatch>, Vec<u32>) {
    let patch_of = patch_numbers(mesh, &skin_edges(mesh));
    let mut order: Vec<usize> = (0..mesh.triangles.len()).collect();
    order.sort_by_key(|&t| patch_of[t]);
    let (sorted, original) = mesh.of_triangles(order.iter().map(|&t| mesh.triangles[t]));
    let mut patches = Vec::new();
    let mut begin = 0;
    for members in order.chunk_by(|&a, &b| patch_of[a] == patch_of[b]) {
        let triangles = begin..begin + members.len();
        begin = triangles.end;
        patches.push(SkinPatch::new(triangles.clone(), &sorted.triangles[triangles]));
    }
    (sorted, patches, original)
}

impl SkinPatch {
    fn new(triangles: Range<usize>, corners: &[[u32; 3]]) -> Self {
        let mut vertices: Vec<u32> = corners.iter().flatten().copied().collect();
        vertices.sort_unstable();
        vertices.dedup();
        let lane_of = |v: u32| vertices.binary_search(&v).unwrap_or(0);
        SkinPatch {
            triangles,
            vertices: std::array::from_fn(|lane| vertices.get(lane).or(vertices.first()).copied().unwrap_or(0)),
            corners: std::array::from_fn(|lane| corners.get(lane).map_or([0; 3], |corners| corners.map(lane_of))),
        }
    }
}

/// Groups triangles into connected patches and returns the number of each triangle's patch. A patch begins at the
/// triangle with the fewest free neighbours and adds the triangle nearest to its centre. It ends when it is full or
/// reaches [`PATCH_M`] from its beginning.
fn patch_numbers(mesh: &Mesh, edges: &[SkinEdge]) -> Vec<u32> {
    /// Number of triangles that are not in a patch yet.
    const FREE: u32 = u32::MAX;
    let mut neighbours: Vec<Vec<u32>> = vec![Vec::new(); mesh.triangles.len()];
    for edge in edges {
        let [left, right] = edge.triangles;
        neighbours[left as usize].push(right);
        neighbours[right as usize].push(left);
    }
    let centroid = |t: u32| mesh.corners(t as usize).map_or(DVec3::ZERO, |[a, b, c]| (a + b + c) / 3.0);
    let mut patch_of = vec![FREE; mesh.triangles.len()];
    // Free triangles beside finished patches.
    let (mut count, mut frontier) = (0, std::collections::BTreeSet::new());
    let mut search_from = 0;
    let free_neighbours =
        |patch_of: &[u32], t: u32| neighbours[t as usize].iter().filter(|&&o| patch_of[o as usize] == FREE).count();
    loop {
        // The next patch begins beside finished patches, where a triangle could be left isolated; otherwise anywhere.
        let beside = frontier.iter().copied().min_by_key(|&t| (free_neighbours(&patch_of, t), t));
        let start = beside.or_else(|| (search_from..patch_of.len() as u32).find(|&t| patch_of[t as usize] == FREE));
        let Some(start) = start else { break };
        search_from = if frontier.is_empty() { start } else { search_from };
        let (mut members, mut centroid_sum) = (vec![start], centroid(start));
        let mut vertices = mesh.triangles[start as usize].to_vec();
        patch_of[start as usize] = count;
        frontier.remove(&start);
        while members.len() < LANES {
            let centre = centroid_sum / members.len() as f64;
            let fits = |t: u32| {
                let more = mesh.triangles[t as usize].iter().filter(|v| !vertices.contains(v)).count();
                vertices.len() + more <= LANES && centroid(t).distance(centroid(start)) < PATCH_M
            };
            let around = members.iter().flat_map(|&t| &neighbours[t as usize]);
            let candidates = around.filter(|&&t| patch_of[t as usize] == FREE && fits(t));
            // Triangles that would be left isolated come first.
            let cost = |t: u32| centroid(t).distance(centre) * (1.0 + 0.3 * free_neighbours(&patch_of, t) as f64);
            let cheapest = candidates.min_by(|&&a, &&b| cost(a).total_cmp(&cost(b)).then(a.cmp(&b)));
            let Some(&next) = cheapest else { break };
            patch_of[next as usize] = count;
            frontier.remove(&next);
            centroid_sum += centroid(next);
            let more: Vec<u32> = mesh.triangles[next as usize].into_iter().filter(|v| !vertices.contains(v)).collect();
            vertices.extend(more);
            members.push(next);
        }
        let around = members.iter().flat_map(|&t| &neighbours[t as usize]);
        frontier.extend(around.filter(|&&t| patch_of[t as usize] == FREE));
        count += 1;
    }
    patch_of
}

/// Map from a bone's own frame (for an ellipsoid, the unit sphere) to the room; or the rate of such a map.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct BoneMap {
    /// Image of the origin.
    pub(super) centre: DVec3,
    /// Linear part.
    pub(super) linear: DMat3,
}

impl BoneMap {
    /// Zero map, which adds nothing.
    pub(super) const ZERO: BoneMap = BoneMap { centre: DVec3::ZERO, linear: DMat3::ZERO };

    /// Map from the unit sphere to an ellipsoid.
    pub(super) fn of_ellipsoid(e: &Ellipsoid) -> Self {
        BoneMap { centre: e.centre, linear: e.axes * DMat3::from_diagonal(e.semi_axes_m) }
    }

    pub(super) fn is_finite(&self) -> bool {
        self.centre.is_finite() && self.linear.is_finite()
    }
}

impl std::ops::Add for BoneMap {
    type Output = BoneMap;
    fn add(self, other: BoneMap) -> BoneMap {
        BoneMap { centre: self.centre + other.centre, linear: self.linear + other.linear }
    }
}

impl std::ops::Sub for BoneMap {
    type Output = BoneMap;
    fn sub(self, other: BoneMap) -> BoneMap {
        BoneMap { centre: self.centre - other.centre, linear: self.linear - other.linear }
    }
}

impl std::ops::Mul<f64> for BoneMap {
    type Output = BoneMap;
    fn mul(self, factor: f64) -> BoneMap {
        BoneMap { centre: self.centre * factor, linear: self.linear * factor }
    }
}

/// Segments of a body that stands over the origin with limbs apart.
fn spread_segments(build: &Build) -> [Ellipsoid; SEGMENTS] {
    let mut segments = build.segments(&build.standing());
    for side in 0..2 {
        let sign = if side == 0 { 1.0 } else { -1.0 };
        let limbs = [(ARM_APART_RAD, &[UPPER_ARM, FOREARM][..]), (LEG_APART_RAD, &[THIGH, SHANK, FOOT][..])];
        for (angle, limb) in limbs {
            let [joint, _] = joints(&segments[limb[0] + side]);
            let rotation = DMat3::from_rotation_x(sign * angle);
            for &segment in limb {
                let e = &mut segments[segment + side];
                *e = Ellipsoid { centre: joint + rotation * (e.centre - joint), axes: rotation * e.axes, ..*e };
            }
        }
    }
    segments
}

/// Upper and lower joint of a limb. Its ellipsoid extends beyond each joint by 0.3 of its thickness.
fn joints(e: &Ellipsoid) -> [DVec3; 2] {
    let half = e.axes * DVec3::Z * (e.semi_axes_m.z - 0.3 * e.semi_axes_m.x);
    [e.centre + half, e.centre - half]
}

/// Returns the ellipsoids and the parts that connect them: joints, neck, shoulders, hands and heels. Ellipsoids alone
/// touch only at points.
fn solid_parts(segments: &[Ellipsoid; SEGMENTS], build: &Build) -> Vec<Part> {
    let mut parts: Vec<Part> = Vec::new();
    for (index, &e) in segments.iter().enumerate() {
        // The chest is narrower, to leave space for hanging arms.
        let slim = if index == CHEST { DVec3::new(1.0, 0.88, 1.0) } else { DVec3::ONE };
        parts.push(Part::Ellipsoid(index, Ellipsoid { semi_axes_m: e.semi_axes_m * slim, ..e }));
    }
    let girth = build.girth;
    let head = segments[HEAD].centre - segments[HEAD].axes * DVec3::Z * 0.04;
    let [left, right] = [joints(&segments[UPPER_ARM])[0], joints(&segments[UPPER_ARM + 1])[0]];
    let neck = 0.5 * (left + right);
    parts.push(Part::Cone(CHEST, [neck, head], [0.062 * girth, 0.054 * girth]));
    parts.push(Part::Cone(PELVIS, [segments[PELVIS].centre, segments[CHEST].centre], [0.100 * girth, 0.090 * girth]));
    for (side, shoulder) in [left, right].into_iter().enumerate() {
        parts.push(Part::Cone(CHEST, [neck.lerp(shoulder, 0.3), shoulder], [0.058 * girth, 0.046 * girth]));
        let mut limb = |segment: usize, upper: f64, lower: f64| {
            let ends = joints(&segments[segment + side]);
            parts.push(Part::Cone(segment + side, ends, [upper * girth, lower * girth]));
            ends[1]
        };
        limb(UPPER_ARM, 0.046, 0.038);
        limb(FOREARM, 0.039, 0.033);
        limb(THIGH, 0.078, 0.052);
        let ankle = limb(SHANK, 0.051, 0.038);
        let foot = &segments[FOOT + side];
        parts.push(Part::Cone(FOOT + side, [ankle, foot.centre], [0.040, 0.036]));
    }
    parts
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::people::motion::{MotionBuilder, Person};
    use crate::people::walking_mesh::WalkingMesh;

    fn walker(height_m: f64) -> WalkingMesh {
        let person = Person::draw(1, [0, 0], height_m);
        let motion = MotionBuilder::new(person, 0.0, [1.0, 1.0], 0.0).walk_to([9.0, 1.0], 1.2).stay();
        WalkingMesh::new(Arc::new(motion), EDGE_M)
    }

    /// Every edge has one triangle on either side, and the surface is one piece without holes: V - E + F = 2.
    #[test]
    fn a_skin_is_one_closed_surface_with_the_size_of_a_person() {
        for (identity, height_m) in [(0, 1.55), (1, 1.75), (2, 1.95)] {
            let build = Person::draw(5, [identity, 0], height_m).build;
            let skin = Skin::new(&build, EDGE_M);
            let mesh = skin.rest();
            let edges = edges(mesh);
            for edge in &edges {
                assert!(edge.right.is_some(), "not a closed manifold at {}", mesh.vertices[edge.vertices[0] as usize]);
            }
            assert_eq!(mesh.vertices.len() + mesh.triangles.len(), edges.len() + 2, "not one piece without holes");
            let z = |v: &DVec3| v.z;
            let (low, high) =
                (mesh.vertices.iter().map(z).fold(9.0, f64::min), mesh.vertices.iter().map(z).fold(-9.0, f64::max));
            assert!((high - height_m).abs() < 0.05 && low.abs() < 0.06, "from {low} to {high} m");
            // 1010 kg/m^3 and a body mass index of 18 to 32.
            let index = 1010.0 * mesh.volume_m3() / (height_m * height_m);
            assert!((18.0..32.0).contains(&index), "body mass index {index}");
        }
    }

    #[test]
    fn a_skin_has_about_14000_triangles_of_similar_size() {
        let walker = walker(1.75);
        let mesh = walker.skin().rest();
        assert!((12_000..16_500).contains(&mesh.triangles.len()), "{} triangles", mesh.triangles.len());
        for time_s in [2.0, 2.3, 2.6] {
            let mesh = walker.mesh_at(time_s);
            let mut lengths: Vec<f64> = mesh
                .triangles
                .iter()
                .flat_map(|&[a, b, c]| [(a, b), (b, c), (c, a)])
                .map(|(a, b)| mesh.vertices[a as usize].distance(mesh.vertices[b as usize]))
                .collect();
            lengths.sort_by(f64::total_cmp);
            let at = |part: f64| lengths[(part * (lengths.len() - 1) as f64) as usize];
            assert!(at(0.02) > 0.009 && at(0.98) < 0.030, "2 % to 98 %: {} to {} m", at(0.02), at(0.98));
        }
    }

    #[test]
    fn vertex_velocities_are_derivatives_of_vertex_positions() {
        let walker = walker(1.75);
        let (t, h) = (3.1, 1e-4);
        let moving = walker.posed(t);
        let (before, after) = (walker.mesh_at(t - h).vertices, walker.mesh_at(t + h).vertices);
        let mut fastest = 0.0f64;
        for ((velocity, a), b) in moving.velocities_m_per_s.iter().zip(&before).zip(&after) {
            assert!((*velocity - (*b - *a) / (2.0 * h)).length() < 1e-4, "{velocity}");
            fastest = fastest.max(velocity.length());
        }
        assert!((1.5..7.0).contains(&fastest), "a swinging foot goes at {fastest} m/s");
        assert_eq!(moving.vertices, walker.mesh_at(t).vertices);
    }

    #[test]
    fn the_volume_of_a_skin_is_nearly_constant_while_walking() {
        let walker = walker(1.75);
        let standing = walker.skin().rest().volume_m3();
        for i in 0..20 {
            let ratio = walker.mesh_at(2.0 + 0.05 * f64::from(i)).volume_m3() / standing;
            assert!((0.95..1.03).contains(&ratio), "{ratio} at {i}");
        }
    }
}
