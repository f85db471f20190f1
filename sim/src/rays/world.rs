//! Acceleration structure over one mesh, for ray tracing.

use glam::{UVec2, Vec3A};
use obvhs::aabb::Aabb;
use obvhs::bvh2::reinsertion::ReinsertionOptimizer;
use obvhs::cwbvh::bvh2_to_cwbvh::bvh2_to_cwbvh;
use obvhs::cwbvh::{CwBvh, node::CwBvhNode};
use obvhs::ploc::PlocBuilder;
use obvhs::triangle::Triangle;
use obvhs::{BvhBuildParams, splits};
use radome_dsp::KernelLevel;
use thiserror::Error;

use super::probe::{NONE, Probe};
use super::ray::{Hit, Ray};
use super::triangle::{Corners, Meeting};
use crate::geometry::{Mesh, MeshError};
use crate::lanes::compiled_for_levels;

/// Largest depth of the structure that traversal supports.
const DEEPEST: usize = 30;

/// Error for a mesh against which rays cannot be traced.
#[derive(Debug, Error, PartialEq)]
pub enum WorldError {
    /// The mesh is invalid.
    #[error(transparent)]
    Mesh(#[from] MeshError),
    /// The number of coplanar groups differs from the number of triangles.
    #[error("{given} coplanar groups for {expected} triangles, expected one a triangle")]
    Groups {
        /// Number of triangles of the mesh.
        expected: usize,
        /// Number of groups given.
        given: usize,
    },
    /// The structure has more levels than traversal supports.
    #[error(
        "the structure over {triangles} triangles is {depth} levels deep, at most {DEEPEST} can be traversed\n\nhint: triangles' sizes differ by too many powers of two; simplify the mesh"
    )]
    TooDeep {
        /// Number of triangles of the mesh.
        triangles: usize,
        /// Number of levels.
        depth: usize,
    },
}

/// Mesh in an acceleration structure.
#[derive(Debug, Clone)]
pub struct World {
    mesh: Mesh,
    tree: CwBvh,
    /// Corners and coplanar group of each of the tree's primitives, in its order.
    corners: Vec<Corners>,
    groups: Vec<u32>,
    bounds: Aabb,
    /// Largest coordinate of the mesh, m; it determines the enlargement of boxes.
    scale_m: f64,
    level: KernelLevel,
}

/// Triangle that a probe meets, and the intersection.
#[derive(Debug, Clone, Copy)]
struct Nearest {
    meeting: Meeting,
    triangle: u32,
}

impl World {
    /// Builds a structure over a mesh with one coplanar group per triangle.
    ///
    /// # Errors
    /// [`WorldError::Groups`] if there is not one group per triangle, [`WorldError::Mesh`] for a mesh that
    /// [`Mesh::check`] refuses, and [`WorldError::TooDeep`].
    pub fn new(mesh: Mesh, groups: &[u32]) -> Result<Self, WorldError> {
        if groups.len() != mesh.triangles.len() {
            return Err(WorldError::Groups { expected: mesh.triangles.len(), given: groups.len() });
        }
        mesh.check()?;
        let scale_m = mesh.vertices.iter().fold(0.0, |l: f64, v| l.max(v.abs().max_element()));
        let tree = build_tree(&mesh, pad_m(scale_m));
        let depth = depth(&tree);
        if depth > DEEPEST {
            return Err(WorldError::TooDeep { triangles: mesh.triangles.len(), depth });
        }
        let groups = tree.primitive_indices.iter().map(|&t| groups.get(t as usize).copied().unwrap_or(NONE)).collect();
        let corners: Vec<Corners> = tree.primitive_indices.iter().map(|&t| corners_of(&mesh, t)).collect();
        let bounds = corners.iter().fold(Aabb::INVALID, |all, c| all.union(&bounds(c, pad_m(scale_m))));
        Ok(World { mesh, tree, corners, groups, bounds, scale_m, level: KernelLevel::detect() })
    }

    /// Nearest triangle that a ray meets; of several at the same distance the lowest index.
    pub fn closest(&self, ray: &Ray) -> Option<Hit> {
        self.closest_at(self.level, ray)
    }

    pub(super) fn closest_at(&self, level: KernelLevel, ray: &Ray) -> Option<Hit> {
        let probe = self.probe(ray)?;
        closest(level, self, &probe).map(|nearest| hit(&nearest, probe.start))
    }

    /// Returns whether any triangle lies on a ray.
    pub fn blocked(&self, ray: &Ray) -> bool {
        self.probe(ray).is_some_and(|probe| any(self.level, self, &probe))
    }

    /// All triangles that a ray meets, each once, nearest first, including those of its own groups.
    pub fn all(&self, ray: &Ray) -> Vec<Hit> {
        let Some(probe) = self.probe(ray) else { return Vec::new() };
        let mut all = Vec::new();
        self.visit(&probe, |leaf, farthest| {
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
        all.iter().map(|nearest| hit(nearest, probe.start)).collect()
    }

    /// Converts the ray to f32 ([`Probe::new`]). Rays from far away begin a metre before the mesh, where f32 still
    /// resolves small distances.
    #[inline(always)]
    fn probe(&self, ray: &Ray) -> Option<Probe> {
        let is_far = ray.origin.abs().max_element() > roaming_m(self.scale_m);
        Probe::new(ray, if is_far { self.approach_m(ray) } else { 0.0 })
    }

    #[cold]
    fn approach_m(&self, ray: &Ray) -> f64 {
        let reach = 3f64.sqrt() * self.scale_m + 1.0;
        let start = -ray.origin.dot(ray.direction) - reach;
        if start.is_finite() { start.max(0.0) } else { 0.0 }
    }

    /// Visits all triangles whose boxes a ray crosses up to its end. The visitor returns the new end; a negative number
    /// ends the visit.
    #[inline(always)]
    fn visit(&self, probe: &Probe, mut visitor: impl FnMut(usize, f32) -> f32) {
        let mut farthest = probe.farthest;
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

    /// Returns an intersection if it replaces the best so far: the nearer one, then the lower triangle index.
    #[inline(always)]
    fn judge(&self, leaf: usize, meeting: Meeting, probe: &Probe, best: &Option<Nearest>) -> Option<Nearest> {
        if self.groups.get(leaf).is_none_or(|group| probe.except.contains(group)) {
            return None;
        }
        let triangle = self.tree.primitive_indices.get(leaf).copied()?;
        if meeting.distance < probe.nearest && !probe.meets_near(self.mesh.corners(triangle as usize)) {
            return None;
        }
        let better = match best {
            Some(n) if n.meeting.distance == meeting.distance => triangle < n.triangle,
            _ => true,
        };
        better.then_some(Nearest { meeting, triangle })
    }
}

compiled_for_levels! {
    fn closest(world: &World, probe: &Probe) -> Option<Nearest> = closest_body;
}

#[inline(always)]
fn closest_body(world: &World, probe: &Probe) -> Option<Nearest> {
    let mut best = None;
    world.visit(probe, |leaf, farthest| {
        let Some(meeting) = world.corners.get(leaf).and_then(|c| probe.shear.meet(c, farthest)) else {
            return farthest;
        };
        let Some(nearest) = world.judge(leaf, meeting, probe, &best) else { return farthest };
        best = Some(nearest);
        meeting.distance
    });
    best
}

compiled_for_levels! {
    /// Returns whether the probe meets any triangle.
    fn any(world: &World, probe: &Probe) -> bool = any_body;
}

#[inline(always)]
fn any_body(world: &World, probe: &Probe) -> bool {
    let mut any = false;
    world.visit(probe, |leaf, farthest| {
        let Some(meeting) = world.corners.get(leaf).and_then(|c| probe.shear.meet(c, farthest)) else {
            return farthest;
        };
        any = world.judge(leaf, meeting, probe, &None).is_some();
        if any { -1.0 } else { farthest }
    });
    any
}

fn hit(nearest: &Nearest, start: f64) -> Hit {
    let weights = nearest.meeting.weights;
    Hit {
        triangle: nearest.triangle,
        distance_m: start + f64::from(nearest.meeting.distance).max(0.0),
        front: (weights.x + weights.y) + weights.z > 0.0,
    }
}

fn corners_of(mesh: &Mesh, triangle: u32) -> Corners {
    mesh.corners(triangle as usize).map_or_else(Corners::default, |[a, b, c]| {
        [0, 1, 2].map(|axis| Vec3A::new(a[axis] as f32, b[axis] as f32, c[axis] as f32))
    })
}

/// Largest coordinate of a ray's origin, m, where those of the mesh are at most `scale_m`.
fn roaming_m(scale_m: f64) -> f64 {
    8.0 + 2.0 * scale_m
}

/// Enlargement of boxes, m: twice the f32 rounding error of the ray-box test over the longest ray.
fn pad_m(scale_m: f64) -> f32 {
    (8.0 * f64::from(f32::EPSILON) * (roaming_m(scale_m) + scale_m)) as f32
}

fn bounds(corners: &Corners, pad: f32) -> Aabb {
    let least = Vec3A::from_array(corners.map(|c| c.min_element()));
    let greatest = Vec3A::from_array(corners.map(|c| c.max_element()));
    Aabb::new(least - pad, greatest + pad)
}

/// Builds a high-quality structure slowly: large triangles are split among boxes, and all nodes are re-inserted.
fn build_tree(mesh: &Mesh, pad: f32) -> CwBvh {
    let triangles: Vec<Triangle> =
        mesh.all_corners().map(|[a, b, c]| Triangle { v0: a.as_vec3a(), v1: b.as_vec3a(), v2: c.as_vec3a() }).collect();
    let mut boxes: Vec<Aabb> = triangles.iter().map(obvhs::Boundable::aabb).collect();
    let mut indices: Vec<u32> = (0..triangles.len() as u32).collect();
    let parameters = BvhBuildParams::very_slow_build();
    let half_area = |b: &Aabb| b.half_area();
    let mean = boxes.iter().map(half_area).sum::<f32>() / boxes.len().max(1) as f32;
    let largest = boxes.iter().map(half_area).fold(0.0, f32::max);
    splits::split_aabbs_preset(&mut boxes, &mut indices, &triangles, mean, largest);
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
    tree.uses_spatial_splits = true;
    ReinsertionOptimizer::default().run(&mut tree, parameters.reinsertion_batch_ratio, None);
    bvh2_to_cwbvh(&tree, 3, true, false)
}

/// Number of levels of a structure; children follow their parents.
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
