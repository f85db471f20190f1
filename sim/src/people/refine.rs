//! Refinement of an actor's mesh for a surface integral: one vertex at texture seams, at most two triangles at an edge,
//! and short edges. Edges are short enough that the surface between them is close to a cubic.

use std::collections::{BTreeMap, BTreeSet};

use glam::DVec3;

use super::rig::MOST_TRIANGLES;
use super::skin::{BoneMap, EDGE_M};
use crate::file_error::FileError;
use crate::geometry::polygon::bounds;
use crate::geometry::{Mesh, bulge, edges, one_ring_normals, split, weld};

/// Edges longer than this are halved, m. It is a little above the target, so that edges near the target are kept.
const LONGEST_EDGE_M: f64 = 1.4 * EDGE_M;
/// Distance within which vertices are merged, as a part of the mesh's size.
const WELD_TOLERANCE: f64 = 1e-5;
/// Largest number of halvings: from metres to millimetres.
const MOST_HALVINGS: usize = 10;
/// Largest displacement of a halved edge's midpoint onto the curved surface, as a part of the edge's length. It
/// protects creases.
const MOST_BULGE: f64 = 0.1;

/// A mesh whose vertices follow bones.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct BoundMesh {
    /// Mesh in the skin's own frame.
    pub mesh: Mesh,
    /// For each vertex, bones and weights that sum to one.
    pub weights: Vec<Vec<(usize, f64)>>,
    /// Number of edges at which the surface ends.
    pub open_edges: usize,
}

impl BoundMesh {
    /// Returns the positions of the vertices in a pose.
    pub fn posed(&self, maps: &[BoneMap]) -> Vec<DVec3> {
        self.mesh.vertices.iter().zip(&self.weights).map(|(&p, w)| posed_position(p, w, maps)).collect()
    }
}

/// Returns the position of a vertex in a pose.
pub(super) fn posed_position(position: DVec3, weights: &[(usize, f64)], maps: &[BoneMap]) -> DVec3 {
    let weighted = |&(bone, weight): &(usize, f64)| {
        maps.get(bone).map_or(DVec3::ZERO, |m| (m.centre + m.linear * position) * weight)
    };
    weights.iter().map(weighted).sum()
}

/// Welds vertices, separates non-manifold edges and halves edges that are too long in a pose in metres.
pub(super) fn refine(mesh: &Mesh, weights: &[Vec<(usize, f64)>], pose: &[BoneMap]) -> Result<BoundMesh, FileError> {
    let mut bound = welded(mesh, weights)?;
    separate_tangled(&mut bound);
    // A mesh that is inside out, or mirrored by a negative scale, is reversed.
    if (Mesh { vertices: bound.posed(pose), triangles: bound.mesh.triangles.clone() }).volume_m3() < 0.0 {
        bound.mesh.triangles.iter_mut().for_each(|t| t.swap(1, 2));
    }
    for _ in 0..MOST_HALVINGS {
        if bound.mesh.triangles.len() > MOST_TRIANGLES {
            let problem = format!("more than {MOST_TRIANGLES} triangles with edges of {EDGE_M} m");
            let hint = "reduce the mesh before exporting it: 5 mm detail is below the wavelength; and check its size";
            return Err(FileError::new("skin", problem, hint));
        }
        if !halve_long_edges(&mut bound, pose) {
            break;
        }
    }
    bound.open_edges = edges(&bound.mesh).iter().filter(|e| e.right.is_none()).count();
    Ok(bound)
}

/// Vertices of an edge, independent of its direction.
fn undirected(a: u32, b: u32) -> (u32, u32) {
    (a.min(b), a.max(b))
}

/// Welds vertices and drops duplicated triangles.
fn welded(mesh: &Mesh, weights: &[Vec<(usize, f64)>]) -> Result<BoundMesh, FileError> {
    let [low, high] = bounds(&mesh.vertices);
    let size = (high - low).length();
    if !(size > 0.0 && size.is_finite()) {
        let problem = "all its vertices are at one place";
        return Err(FileError::new("skin", problem, "check the scale of the mesh and export it again"));
    }
    let scaled =
        Mesh { vertices: mesh.vertices.iter().map(|&v| (v - low) / size).collect(), triangles: mesh.triangles.clone() };
    let welded =
        weld(&scaled, WELD_TOLERANCE).map_err(|e| FileError::new("skin", e.to_string(), "export the mesh again"))?;
    // Original index of each vertex, from the triangles that remain.
    let mut original = vec![0u32; welded.mesh.vertices.len()];
    for (triangle, &original_triangle) in welded.mesh.triangles.iter().zip(&welded.triangle_of) {
        for (&vertex, original_vertex) in triangle.iter().zip(mesh.triangles[original_triangle as usize]) {
            original[vertex as usize] = original_vertex;
        }
    }
    let vertices = original.iter().map(|&v| mesh.vertices[v as usize]).collect();
    let weights = original.iter().map(|&v| weights[v as usize].clone()).collect();
    let mut bound = BoundMesh { mesh: Mesh { vertices, triangles: Vec::new() }, weights, ..BoundMesh::default() };
    // Double-sided sheets contain each triangle twice.
    let mut seen = BTreeSet::new();
    for &triangle in &welded.mesh.triangles {
        let mut corners = triangle;
        corners.sort_unstable();
        if seen.insert(corners) {
            bound.mesh.triangles.push(triangle);
        }
    }
    if bound.mesh.triangles.is_empty() {
        return Err(FileError::new("skin", "no triangle of it has an area", "check the scale of the mesh"));
    }
    Ok(bound)
}

/// Gives triangles vertices of their own at edges of three or more triangles, or of two triangles with different
/// orientation.
fn separate_tangled(bound: &mut BoundMesh) {
    let mut tangled: BTreeSet<(u32, u32)> = BTreeSet::new();
    for edge in edges(&bound.mesh).iter().filter(|e| e.is_non_manifold) {
        let [a, b] = edge.vertices;
        tangled.insert(undirected(a, b));
    }
    let mut separated = 0;
    for t in 0..bound.mesh.triangles.len() {
        let [a, b, c] = bound.mesh.triangles[t];
        if ![(a, b), (b, c), (c, a)].iter().any(|&(a, b)| tangled.contains(&undirected(a, b))) {
            continue;
        }
        separated += 1;
        bound.mesh.triangles[t] = [a, b, c].map(|v| {
            bound.mesh.vertices.push(bound.mesh.vertices[v as usize]);
            bound.weights.push(bound.weights[v as usize].clone());
            bound.mesh.vertices.len() as u32 - 1
        });
    }
    if separated > 0 {
        tracing::warn!(
            triangles = separated,
            "triangles of the actor that meet three at an edge, or face different ways, are loose"
        );
    }
}

/// Halves edges that are too long in a pose. Returns whether there were any.
fn halve_long_edges(bound: &mut BoundMesh, pose: &[BoneMap]) -> bool {
    let posed = bound.posed(pose);
    let normals = one_ring_normals(&bound.mesh.vertices, &bound.mesh.triangles);
    let mut midpoints: BTreeMap<(u32, u32), u32> = BTreeMap::new();
    for edge in edges(&bound.mesh) {
        let [a, b] = edge.vertices;
        let (p, q) = (a as usize, b as usize);
        if posed[p].distance(posed[q]) <= LONGEST_EDGE_M {
            continue;
        }
        let ends = [bound.mesh.vertices[p], bound.mesh.vertices[q]];
        let offset = ends[1] - ends[0];
        // An edge at which the surface ends stays straight.
        let bulge = if edge.right.is_none() { DVec3::ZERO } else { bulge(ends, [normals[p], normals[q]]) };
        let bulge = bulge.clamp_length_max(MOST_BULGE * offset.length());
        midpoints.insert(undirected(a, b), bound.mesh.vertices.len() as u32);
        bound.mesh.vertices.push(ends[0] + 0.5 * offset + bulge);
        let mut weights: BTreeMap<usize, f64> = BTreeMap::new();
        for &(bone, weight) in bound.weights[p].iter().chain(&bound.weights[q]) {
            *weights.entry(bone).or_insert(0.0) += 0.5 * weight;
        }
        bound.weights.push(weights.into_iter().collect());
    }
    if midpoints.is_empty() {
        return false;
    }
    let distance_squared =
        |a: u32, b: u32| bound.mesh.vertices[a as usize].distance_squared(bound.mesh.vertices[b as usize]);
    let mut triangles = Vec::with_capacity(2 * bound.mesh.triangles.len());
    for &[a, b, c] in &bound.mesh.triangles {
        let midpoint = |a: u32, b: u32| midpoints.get(&undirected(a, b)).copied();
        triangles.extend(split([a, b, c], [midpoint(a, b), midpoint(b, c), midpoint(c, a)], distance_squared));
    }
    bound.mesh.triangles = triangles;
    true
}

#[cfg(test)]
mod tests {
    use glam::DMat3;

    use super::*;
    use crate::geometry::shape;

    fn identity_pose() -> Vec<BoneMap> {
        vec![BoneMap { centre: DVec3::ZERO, linear: DMat3::IDENTITY }]
    }

    fn ball() -> Mesh {
        shape::icosphere(DVec3::splat(0.3), 2).mesh()
    }

    /// A ball of 80 triangles with edges of 16 cm becomes one with edges of 2 cm.
    #[test]
    fn refinement_makes_a_coarse_ball_rounder_and_keeps_it_closed() {
        let ball = ball();
        let before = ball.volume_m3();
        let weights = vec![vec![(0, 1.0)]; ball.vertices.len()];
        let refined = refine(&ball, &weights, &identity_pose()).expect("a good mesh");
        assert!(refined.mesh.is_solid() && refined.open_edges == 0);
        let lengths = edges(&refined.mesh).into_iter().map(|e| {
            refined.mesh.vertices[e.vertices[0] as usize].distance(refined.mesh.vertices[e.vertices[1] as usize])
        });
        assert!(lengths.fold(0.0, f64::max) <= LONGEST_EDGE_M);
        let exact = 4.0 / 3.0 * std::f64::consts::PI * 0.3f64.powi(3);
        let after = refined.mesh.volume_m3();
        assert!((after / exact - 1.0).abs() < 0.1 * (before / exact - 1.0).abs(), "{before} to {after} of {exact} m^3");
    }

    #[test]
    fn seams_are_welded_duplicates_dropped_and_non_manifold_edges_separated() {
        let ball = ball();
        // Every triangle has vertices of its own. The first triangle exists twice, and one edge has a third triangle.
        let mut soup = Mesh::soup(ball.all_corners());
        soup.triangles.push([0, 2, 1]);
        soup.vertices.push(DVec3::splat(0.4));
        soup.triangles.push([0, 1, soup.vertices.len() as u32 - 1]);
        let weights = vec![vec![(0, 1.0)]; soup.vertices.len()];
        let refined = refine(&soup, &weights, &identity_pose()).expect("a good mesh");
        assert!(edges(&refined.mesh).iter().all(|e| !e.is_non_manifold));
        assert!(refined.open_edges > 0, "the fin and its neighbours are loose");
    }
}
