//! Ray tracer: a mesh in an acceleration structure.

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
use super::triangle::{Corners, Intersection};
use crate::geometry::{Mesh, MeshError};
use crate::lanes::compiled_for_levels;

/// Largest depth of the structure that traversal supports.
const MAX_DEPTH: usize = 30;

/// Error for a mesh against which rays cannot be traced.
#[derive(Debug, Error, PartialEq)]
pub enum RayTracerError {
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
        "the structure over {triangles} triangles is {depth} levels deep, at most {MAX_DEPTH} can be traversed\n\nhint: triangles' sizes differ by too many powers of two; simplify the mesh"
    )]
    TooDeep {
        /// Number of triangles of the mesh.
        triangles: usize,
        /// Number of levels.
        depth: usize,
    },
}

/// Traces rays through a mesh in an acceleration structure.
#[derive(Debug, Clone)]
pub struct RayTracer {
    mesh: Mesh,
    tree: CwBvh,
    /// Corners of each of the tree's primitives, in the tree's order.
    corners: Vec<Corners>,
    /// Coplanar group of each of the tree's primitives, in the tree's order.
    groups: Vec<u32>,
    bounds: Aabb,
    /// Largest coordinate of the mesh, m; it determines the enlargement of boxes.
    scale_m: f64,
    level: KernelLevel,
}

/// Triangle that a probe hits, and the intersection.
#[derive(Debug, Clone, Copy)]
struct TriangleHit {
    intersection: Intersection,
    triangle: u32,
}

impl RayTracer {
    /// Builds a tracer of a mesh with one coplanar group per triangle.
    ///
    /// # Errors
    /// [`RayTracerError::Groups`] if there is not one group per triangle, [`RayTracerError::Mesh`] for a mesh that
    /// [`Mesh::check`] refuses, and [`RayTracerError::TooDeep`].
    pub fn new(mesh: Mesh, groups: &[u32]) -> Result<Self, RayTracerError> {
        if groups.len() != mesh.triangles.len() {
            return Err(RayTracerError::Groups { expected: mesh.triangles.len(), given: groups.len() });
        }
        mesh.check()?;
        let scale_m = mesh.vertices.iter().fold(0.0, |l: f64, v| l.max(v.abs().max_element()));
        let tree = build_tree(&mesh, pad_m(scale_m));
        let depth = depth(&tree);
        if depth > MAX_DEPTH {
            return Err(RayTracerError::TooDeep { triangles: mesh.triangles.len(), depth });
        }
        let groups = tree.primitive_indices.iter().map(|&t| groups.get(t as usize).copied().unwrap_or(NONE)).collect();
        let corners: Vec<Corners> = tree.primitive_indices.iter().map(|&t| corners_of(&mesh, t)).collect();
        let bounds = corners.iter().fold(Aabb::INVALID, |all, c| all.union(&bounds(c, pad_m(scale_m))));
        Ok(RayTracer { mesh, tree, corners, groups, bounds, scale_m, level: KernelLevel::detect() })
    }

    /// Nearest triangle that a ray hits; of several at the same distance the one of lowest index.
    pub fn closest(&self, ray: &Ray) -> Option<Hit> {
        self.closest_at(self.level, ray)
    }

    pub(super) fn closest_at(&self, level: KernelLevel, ray: &Ray) -> Option<Hit> {
        let probe = self.probe(ray)?;
        closest(level, self, &probe).map(|found| hit(&found, probe.start))
    }

    /// Returns whether any triangle lies on a ray.
    pub fn blocked(&self, ray: &Ray) -> bool {
        self.probe(ray).is_some_and(|probe| any(self.level, self, &probe))
    }

    /// All triangles that a ray hits, each once, nearest first, including those of its own groups.
    pub fn all(&self, ray: &Ray) -> Vec<Hit> {
        let Some(probe) = self.probe(ray) else { return Vec::new() };
        let mut all = Vec::new();
        self.visit(&probe, |leaf, farthest| {
            if let Some(intersection) = self.corners.get(leaf).and_then(|c| probe.shear.intersect(c, farthest))
                && intersection.distance >= probe.nearest
            {
                let triangle = self.tree.primitive_indices.get(leaf).copied().unwrap_or(NONE);
                all.push(TriangleHit { intersection, triangle });
            }
            farthest
        });
        all.sort_by(|a, b| {
            a.intersection.distance.total_cmp(&b.intersection.distance).then(a.triangle.cmp(&b.triangle))
        });
        // A structure with split boxes holds a triangle several times.
        all.dedup_by_key(|found| found.triangle);
        all.iter().map(|found| hit(found, probe.start)).collect()
    }

    /// Converts a ray to f32 ([`Probe::new`]). The probe of a ray from far away begins a metre before the mesh, where
    /// f32 still resolves small distances.
    #[inline(always)]
    fn probe(&self, ray: &Ray) -> Option<Probe> {
        let is_far = ray.origin.abs().max_element() > largest_origin_m(self.scale_m);
        Probe::new(ray, if is_far { self.far_start_m(ray) } else { 0.0 })
    }

    /// Distance along a ray from far away at which its probe begins, m.
    #[cold]
    fn far_start_m(&self, ray: &Ray) -> f64 {
        let reach = 3f64.sqrt() * self.scale_m + 1.0;
        let start = -ray.origin.dot(ray.direction) - reach;
        if start.is_finite() { start.max(0.0) } else { 0.0 }
    }

    /// Visits all triangles whose boxes a probe crosses up to its end. The visitor takes the leaf and the end, and
    /// returns the new end; a negative number ends the visit.
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

    /// Returns an intersection as a hit if it counts and replaces the best hit so far. The caller has excluded farther
    /// ones; of two at the same distance, the one of lower triangle index is better.
    #[inline(always)]
    fn better_hit(
        &self,
        leaf: usize,
        intersection: Intersection,
        probe: &Probe,
        best: &Option<TriangleHit>,
    ) -> Option<TriangleHit> {
        if self.groups.get(leaf).is_none_or(|group| probe.excluded_groups.contains(group)) {
            return None;
        }
        let triangle = self.tree.primitive_indices.get(leaf).copied()?;
        if intersection.distance < probe.nearest && !probe.is_real_near_hit(self.mesh.corners(triangle as usize)) {
            return None;
        }
        let better = match best {
            Some(best) if best.intersection.distance == intersection.distance => triangle < best.triangle,
            _ => true,
        };
        better.then_some(TriangleHit { intersection, triangle })
    }
}

compiled_for_levels! {
    fn closest(tracer: &RayTracer, probe: &Probe) -> Option<TriangleHit> = closest_body;
}

#[inline(always)]
fn closest_body(tracer: &RayTracer, probe: &Probe) -> Option<TriangleHit> {
    let mut best = None;
    tracer.visit(probe, |leaf, farthest| {
        let Some(intersection) = tracer.corners.get(leaf).and_then(|c| probe.shear.intersect(c, farthest)) else {
            return farthest;
        };
        let Some(better) = tracer.better_hit(leaf, intersection, probe, &best) else { return farthest };
        best = Some(better);
        intersection.distance
    });
    best
}

compiled_for_levels! {
    /// Returns whether the probe hits any triangle.
    fn any(tracer: &RayTracer, probe: &Probe) -> bool = any_body;
}

#[inline(always)]
fn any_body(tracer: &RayTracer, probe: &Probe) -> bool {
    let mut any = false;
    tracer.visit(probe, |leaf, farthest| {
        let Some(intersection) = tracer.corners.get(leaf).and_then(|c| probe.shear.intersect(c, farthest)) else {
            return farthest;
        };
        any = tracer.better_hit(leaf, intersection, probe, &None).is_some();
        if any { -1.0 } else { farthest }
    });
    any
}

/// Converts a hit of a probe that begins at `start` to a hit of its ray.
fn hit(found: &TriangleHit, start: f64) -> Hit {
    let weights = found.intersection.weights;
    Hit {
        triangle: found.triangle,
        distance_m: start + f64::from(found.intersection.distance).max(0.0),
        front: (weights.x + weights.y) + weights.z > 0.0,
    }
}

fn corners_of(mesh: &Mesh, triangle: u32) -> Corners {
    mesh.corners(triangle as usize).map_or_else(Corners::default, |[a, b, c]| {
        [0, 1, 2].map(|axis| Vec3A::new(a[axis] as f32, b[axis] as f32, c[axis] as f32))
    })
}

/// Largest coordinate of a ray's origin from which its probe begins there, m. `scale_m` is the largest coordinate of
/// the mesh.
fn largest_origin_m(scale_m: f64) -> f64 {
    8.0 + 2.0 * scale_m
}

/// Enlargement of boxes, m: twice the f32 rounding error of the ray-box test over the longest ray.
fn pad_m(scale_m: f64) -> f32 {
    (8.0 * f64::from(f32::EPSILON) * (largest_origin_m(scale_m) + scale_m)) as f32
}

/// Bounding box of a triangle, enlarged by `pad` on all sides, m.
fn bounds(corners: &Corners, pad: f32) -> Aabb {
    let least = Vec3A::from_array(corners.map(|c| c.min_element()));
    let greatest = Vec3A::from_array(corners.map(|c| c.max_element()));
    Aabb::new(least - pad, greatest + pad)
}

/// Builds a structure of high quality, which takes long: large triangles are split among boxes, and all nodes are
/// re-inserted.
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
