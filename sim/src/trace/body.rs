//! One mesh in an acceleration structure.

use glam::{DVec3, UVec2, Vec3A};
use obvhs::aabb::Aabb;
use obvhs::bvh2::reinsertion::ReinsertionOptimizer;
use obvhs::cwbvh::bvh2_to_cwbvh::bvh2_to_cwbvh;
use obvhs::cwbvh::{CwBvh, node::CwBvhNode};
use obvhs::ploc::PlocBuilder;
use obvhs::triangle::Triangle;
use obvhs::{BvhBuildParams, splits};
use thiserror::Error;

use super::probe::{NONE, Probe};
use super::ray::Crossings;
use super::triangle::{Corners, Meeting};
use crate::geometry::{Mesh, MeshError, check_places};

/// Levels of a structure that traversal has room for.
const DEEPEST: usize = 30;

/// A mesh that rays cannot be traced against.
#[derive(Debug, Error, PartialEq)]
pub enum BodyError {
    /// The mesh is none.
    #[error(transparent)]
    Mesh(#[from] MeshError),
    /// Not the mesh that the structure was built for.
    #[error(
        "a structure over {expected} vertices was given {given}\n\nhint: a refit moves vertices; build again for another mesh"
    )]
    OtherMesh {
        /// Vertices at the build.
        expected: usize,
        /// Vertices given.
        given: usize,
    },
    /// The world has no such body.
    #[error("there is no body {body}, the world has {bodies}")]
    NoSuchBody {
        /// The body asked for.
        body: u32,
        /// Bodies of the world.
        bodies: usize,
    },
    /// More coplanar groups or fewer than triangles.
    #[error("{given} coplanar groups for {expected} triangles, expected one a triangle")]
    Groups {
        /// Triangles of the mesh.
        expected: usize,
        /// Groups given.
        given: usize,
    },
    /// The structure has more levels than can be traversed.
    #[error(
        "the structure over {triangles} triangles is {depth} levels deep, at most {DEEPEST} can be traversed\n\nhint: triangles' sizes differ by too many powers of two; simplify the mesh"
    )]
    TooDeep {
        /// Triangles of the mesh.
        triangles: usize,
        /// Levels.
        depth: usize,
    },
}

/// Time that a structure is worth.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Build {
    /// Built once and never moved: large triangles are split among boxes, all nodes are placed again.
    Static,
    /// Refitted as its vertices move.
    Moving,
}

/// One mesh in an acceleration structure.
#[derive(Debug, Clone)]
pub struct Body {
    mesh: Mesh,
    groups: Vec<u32>,
    pub(super) tree: CwBvh,
    build: Build,
    /// Corners and group of each of the tree's primitives, in its order.
    pub(super) corners: Vec<Corners>,
    leaf_groups: Vec<u32>,
    pub(super) bounds: Aabb,
    /// Largest coordinate of the world, m: what boxes are enlarged for.
    scale_m: f64,
}

/// The nearest meeting so far.
#[derive(Debug, Clone, Copy)]
pub(super) struct Nearest {
    pub meeting: Meeting,
    pub triangle: u32,
}

impl Body {
    /// A structure over a mesh each of whose triangles is a surface of its own.
    ///
    /// # Errors
    /// [`BodyError::Mesh`] for a mesh that [`Mesh::check`] refuses, and [`BodyError::TooDeep`].
    pub fn new(mesh: Mesh, build: Build) -> Result<Self, BodyError> {
        let groups = (0..mesh.triangles.len() as u32).collect();
        Self::with_groups(mesh, groups, build)
    }

    /// A structure over a mesh with one coplanar group a triangle ([`crate::geometry`] finds them).
    ///
    /// # Errors
    /// Those of [`Body::new`], and [`BodyError::Groups`] if there is not one group a triangle.
    pub fn with_groups(mesh: Mesh, groups: Vec<u32>, build: Build) -> Result<Self, BodyError> {
        Self::in_world(mesh, groups, build, 0.0)
    }

    fn in_world(mesh: Mesh, groups: Vec<u32>, build: Build, scale_m: f64) -> Result<Self, BodyError> {
        if groups.len() != mesh.triangles.len() {
            return Err(BodyError::Groups { expected: mesh.triangles.len(), given: groups.len() });
        }
        mesh.check()?;
        let scale_m = largest_m(&mesh.vertices).max(scale_m);
        let tree = build_tree(&mesh, pad_m(scale_m), build);
        let depth = depth(&tree);
        if depth > DEEPEST {
            return Err(BodyError::TooDeep { triangles: mesh.triangles.len(), depth });
        }
        let group = |&t: &u32| groups.get(t as usize).copied().unwrap_or(NONE);
        let leaf_groups = tree.primitive_indices.iter().map(group).collect();
        let corners = vec![Corners::default(); tree.primitive_indices.len()];
        let mut body = Body { mesh, groups, tree, build, corners, leaf_groups, bounds: Aabb::INVALID, scale_m };
        body.load_corners();
        body.bounds = body.corners.iter().fold(Aabb::INVALID, |all, c| all.union(&bounds(c, pad_m(scale_m))));
        Ok(body)
    }

    /// The mesh.
    pub fn mesh(&self) -> &Mesh {
        &self.mesh
    }

    /// Coplanar group of a triangle.
    pub fn group(&self, triangle: u32) -> Option<u32> {
        self.groups.get(triangle as usize).copied()
    }

    /// Moves the vertices and fits the boxes to them again. A structure built as [`Build::Static`] is built again, since its
    /// boxes hold parts of triangles.
    ///
    /// # Errors
    /// [`BodyError::OtherMesh`] for another number of vertices, [`BodyError::Mesh`] for a vertex without a place, and
    /// [`BodyError::TooDeep`] where the structure is built again.
    pub fn refit(&mut self, vertices: &[DVec3]) -> Result<(), BodyError> {
        if vertices.len() != self.mesh.vertices.len() {
            return Err(BodyError::OtherMesh { expected: self.mesh.vertices.len(), given: vertices.len() });
        }
        check_places(vertices)?;
        if self.build == Build::Static {
            let mesh = Mesh { vertices: vertices.to_vec(), triangles: self.mesh.triangles.clone() };
            *self = Self::in_world(mesh, self.groups.clone(), self.build, self.scale_m)?;
            return Ok(());
        }
        self.mesh.vertices.copy_from_slice(vertices);
        self.fit(largest_m(vertices))
    }

    /// Largest coordinate, m, for which boxes are enlarged enough.
    pub(super) fn scale_m(&self) -> f64 {
        self.scale_m
    }

    /// Fits the boxes to the vertices, in a world of at least this size.
    pub(super) fn fit(&mut self, scale_m: f64) -> Result<(), BodyError> {
        self.scale_m = self.scale_m.max(scale_m);
        if self.build == Build::Static {
            *self = Self::in_world(self.mesh.clone(), self.groups.clone(), self.build, self.scale_m)?;
            return Ok(());
        }
        self.load_corners();
        self.bounds = refit_tree(&mut self.tree, &self.corners, pad_m(self.scale_m));
        Ok(())
    }

    fn load_corners(&mut self) {
        for (corners, &triangle) in self.corners.iter_mut().zip(&self.tree.primitive_indices) {
            if let Some([a, b, c]) = self.mesh.corners(triangle as usize) {
                let lanes = |axis: usize| Vec3A::new(a[axis] as f32, b[axis] as f32, c[axis] as f32);
                *corners = [lanes(0), lanes(1), lanes(2)];
            }
        }
    }

    /// The box around the body: its least and greatest corner, m.
    pub fn bounds(&self) -> (DVec3, DVec3) {
        (self.bounds.min.as_dvec3(), self.bounds.max.as_dvec3())
    }

    /// Visits all triangles whose boxes a ray goes through up to `farthest`, which the visitor may lower by what it returns;
    /// a negative number ends the visit.
    #[inline(always)]
    fn visit(&self, probe: &Probe, mut farthest: f32, mut visitor: impl FnMut(usize, f32) -> f32) {
        let mut ray = probe.ray;
        ray.tmax = farthest + probe.back;
        if self.tree.nodes.is_empty() || self.bounds.intersect_ray(&ray) > ray.tmax {
            return;
        }
        let mut state = self.tree.new_traversal(probe.direction);
        let mut node: &CwBvhNode;
        'all: {
            obvhs::traverse!(self.tree, node, state, node.intersect_ray(&ray, state.oct_inv4), {
                farthest = visitor(state.primitive_id as usize, farthest);
                if farthest < 0.0 {
                    break 'all;
                }
                ray.tmax = farthest + probe.back;
            });
        }
    }

    /// A meeting that is not farther than the best so far, if it is to replace it: nearest first, then the lowest
    /// (body, triangle).
    #[inline(always)]
    pub(super) fn judge(
        &self,
        leaf: usize,
        meeting: Meeting,
        probe: &Probe,
        except: [u32; 2],
        number: u32,
        best: &Option<(u32, Nearest)>,
    ) -> Option<Nearest> {
        if self.leaf_groups.get(leaf).is_none_or(|group| except.contains(group)) {
            return None;
        }
        let triangle = self.tree.primitive_indices.get(leaf).copied()?;
        if meeting.distance < probe.nearest && !probe.meets_near(self.mesh.corners(triangle as usize)) {
            return None;
        }
        let better = match best {
            Some((body, n)) if n.meeting.distance == meeting.distance => (number, triangle) < (*body, n.triangle),
            _ => true,
        };
        better.then_some(Nearest { meeting, triangle })
    }

    /// The nearest triangle, if it is nearer than the best so far.
    #[inline(always)]
    pub(super) fn closest(&self, probe: &Probe, number: u32, best: &mut Option<(u32, Nearest)>) {
        let except = probe.except(number);
        let farthest = best.map_or(probe.farthest, |(_, n)| n.meeting.distance);
        self.visit(probe, farthest, |leaf, farthest| {
            let Some(meeting) = self.corners.get(leaf).and_then(|c| probe.shear.meet(c, farthest)) else {
                return farthest;
            };
            let Some(nearest) = self.judge(leaf, meeting, probe, except, number, best) else { return farthest };
            *best = Some((number, nearest));
            meeting.distance
        });
    }

    /// Whether anything is met.
    #[inline(always)]
    pub(super) fn any(&self, probe: &Probe, number: u32) -> bool {
        let except = probe.except(number);
        let mut any = false;
        self.visit(probe, probe.farthest, |leaf, farthest| {
            let Some(meeting) = self.corners.get(leaf).and_then(|c| probe.shear.meet(c, farthest)) else {
                return farthest;
            };
            any = self.judge(leaf, meeting, probe, except, number, &None).is_some();
            if any { -1.0 } else { farthest }
        });
        any
    }

    /// All meetings, each triangle once, by distance and then triangle.
    pub(super) fn all(&self, probe: &Probe) -> Vec<Nearest> {
        let mut all = Vec::new();
        self.visit(probe, probe.farthest, |leaf, farthest| {
            if let Some(meeting) = self.corners.get(leaf).and_then(|c| probe.shear.meet(c, farthest))
                && meeting.distance >= probe.nearest
            {
                let triangle = self.tree.primitive_indices.get(leaf).copied().unwrap_or(NONE);
                all.push(Nearest { meeting, triangle });
            }
            farthest
        });
        all.sort_by(|a, b| a.meeting.distance.total_cmp(&b.meeting.distance).then(a.triangle.cmp(&b.triangle)));
        // A structure with split boxes holds a triangle several times.
        all.dedup_by_key(|n| n.triangle);
        all
    }

    /// Number of times that a line goes in and out.
    pub(super) fn crossings(&self, probe: &Probe) -> Crossings {
        let mut crossings = Crossings::default();
        if self.build == Build::Static {
            for n in self.all(probe) {
                count(&mut crossings, &n.meeting);
            }
            return crossings;
        }
        self.visit(probe, probe.farthest, |leaf, farthest| {
            if let Some(meeting) = self.corners.get(leaf).and_then(|c| probe.shear.meet(c, farthest))
                && meeting.distance >= probe.nearest
            {
                count(&mut crossings, &meeting);
            }
            farthest
        });
        crossings
    }
}

fn count(crossings: &mut Crossings, meeting: &Meeting) {
    if meeting.weights.element_sum() > 0.0 {
        crossings.entered += 1;
    } else {
        crossings.left += 1;
    }
}

/// Largest coordinate, m.
fn largest_m(vertices: &[DVec3]) -> f64 {
    vertices.iter().fold(0.0, |l, v| l.max(v.abs().max_element()))
}

/// Coordinates of a ray's origin are at most this, m, where those of the world are at most `scale_m`.
pub(super) fn roaming_m(scale_m: f64) -> f64 {
    8.0 + 2.0 * scale_m
}

/// Length by which boxes are enlarged, m: twice what f32 loses in the ray-box test over the longest way.
fn pad_m(scale_m: f64) -> f32 {
    (8.0 * f64::from(f32::EPSILON) * (roaming_m(scale_m) + scale_m)) as f32
}

fn bounds(corners: &Corners, pad: f32) -> Aabb {
    let least = Vec3A::from_array(corners.map(|c| c.min_element()));
    let greatest = Vec3A::from_array(corners.map(|c| c.max_element()));
    Aabb::new(least - pad, greatest + pad)
}

fn build_tree(mesh: &Mesh, pad: f32, build: Build) -> CwBvh {
    let triangles: Vec<Triangle> = (0..mesh.triangles.len())
        .filter_map(|t| mesh.corners(t))
        .map(|[a, b, c]| Triangle { v0: a.as_vec3a(), v1: b.as_vec3a(), v2: c.as_vec3a() })
        .collect();
    let mut boxes: Vec<Aabb> = triangles.iter().map(obvhs::Boundable::aabb).collect();
    let mut indices: Vec<u32> = (0..triangles.len() as u32).collect();
    let parameters = match build {
        Build::Static => BvhBuildParams::very_slow_build(),
        Build::Moving => BvhBuildParams::medium_build(),
    };
    if build == Build::Static {
        let half_area = |b: &Aabb| b.half_area();
        let mean = boxes.iter().map(half_area).sum::<f32>() / boxes.len().max(1) as f32;
        let largest = boxes.iter().map(half_area).fold(0.0, f32::max);
        splits::split_aabbs_preset(&mut boxes, &mut indices, &triangles, mean, largest);
    }
    for b in &mut boxes {
        *b = Aabb::new(b.min - pad, b.max + pad);
    }
    let mut tree = PlocBuilder::with_capacity(boxes.len()).build(
        parameters.ploc_search_distance,
        &boxes,
        indices,
        parameters.sort_precision,
        parameters.search_depth_threshold,
    );
    tree.uses_spatial_splits = build == Build::Static;
    ReinsertionOptimizer::default().run(&mut tree, parameters.reinsertion_batch_ratio, None);
    bvh2_to_cwbvh(&tree, 3, true, false)
}

/// Levels of a structure. Children come after their parents.
fn depth(tree: &CwBvh) -> usize {
    let mut depths = vec![0usize; tree.nodes.len()];
    let mut deepest = 0;
    for (index, node) in tree.nodes.iter().enumerate() {
        let depth = depths.get(index).copied().unwrap_or(0) + 1;
        deepest = deepest.max(depth);
        for child in (0..8).filter(|&c| !node.is_child_empty(c) && !node.is_leaf(c)) {
            if let Some(slot) = depths.get_mut(node.child_node_index(child) as usize) {
                *slot = depth;
            }
        }
    }
    deepest
}

/// Fits all boxes to moved corners, children before parents; the shape of the tree stays. Returns the box around all.
fn refit_tree(tree: &mut CwBvh, corners: &[Corners], pad: f32) -> Aabb {
    let mut boxes = vec![Aabb::INVALID; tree.nodes.len()];
    for index in (0..tree.nodes.len()).rev() {
        let Some(node) = tree.nodes.get_mut(index) else { continue };
        let mut children = [Aabb::INVALID; 8];
        let mut whole = Aabb::INVALID;
        for (child, around) in children.iter_mut().enumerate().filter(|&(c, _)| !node.is_child_empty(c)) {
            if node.is_leaf(child) {
                let (first, count) = node.child_primitives(child);
                for c in corners.iter().skip(first as usize).take(count as usize) {
                    *around = around.union(&bounds(c, pad));
                }
            } else if let Some(inner) = boxes.get(node.child_node_index(child) as usize) {
                *around = *inner;
            }
            whole = whole.union(around);
        }
        quantise(node, &whole, &children);
        if let Some(slot) = boxes.get_mut(index) {
            *slot = whole;
        }
    }
    boxes.first().copied().unwrap_or(Aabb::INVALID)
}

/// Writes children's boxes into a node: eight bits a plane over a grid of a power of two, rounded outwards (Ylitie, Karras
/// and Laine, "Efficient incoherent ray traversal on GPUs through compressed wide BVHs", HPG 2017).
fn quantise(node: &mut CwBvhNode, whole: &Aabb, children: &[Aabb; 8]) {
    node.p = whole.min.into();
    for axis in 0..3 {
        let (low, extent) = (whole.min[axis], whole.max[axis] - whole.min[axis]);
        let step = (extent.max(1e-20) / 255.0).log2().ceil().exp2();
        if let Some(e) = node.e.get_mut(axis) {
            *e = (step.to_bits() >> 23) as u8;
        }
        let (least, greatest) = match axis {
            0 => (&mut node.child_min_x, &mut node.child_max_x),
            1 => (&mut node.child_min_y, &mut node.child_max_y),
            _ => (&mut node.child_min_z, &mut node.child_max_z),
        };
        for ((around, least), greatest) in children.iter().zip(least).zip(greatest) {
            // A conversion to u8 saturates; an empty child's box is inside out and stays unused.
            *least = ((around.min[axis] - low) / step).floor() as u8;
            *greatest = ((around.max[axis] - low) / step).ceil() as u8;
        }
    }
}
