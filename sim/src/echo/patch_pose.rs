//! Pose of a skin patch in lanes: quantities that do not depend on the pair of antennas.

use glam::DVec3;
use radome_dsp::KernelLevel;

use super::surface_currents::{DirectionRows, VertexRows, direction_rows};
use crate::em::curved_triangle::{
    HALVES, Integrator, Nodes, TriangleRows, ViewRows, bulge_rows, place_nodes, triangle_rows, view_rows,
};
use crate::lanes::{LANES, Row, Row3};
use crate::people::skin::{PosedSkin, SkinPatch};

/// Index of the quadrature rule of each half of the lanes; `None` where no integral is needed.
pub(super) type Rules = [Option<usize>; HALVES];

/// Pose of a skin patch, with its views from image antennas.
pub(super) struct PatchPose {
    pub(super) vertices: VertexRows,
    pub(super) triangles: TriangleRows,
    /// Velocities of the triangles' middles, m/s.
    pub(super) velocity: Row3,
    /// Velocities of the triangles' corners relative to their middles, m/s: `[corner]`.
    pub(super) corner_velocity: [Row3; 3],
    /// Directions and distances of the vertices by image antenna, valid for images given to [`Self::view_from`].
    pub(super) directions: Vec<DirectionRows>,
    pub(super) views: Vec<ViewRows>,
    /// Nodes of each rule in each half of the lanes, and whether they have been computed.
    nodes: Vec<[(bool, Nodes); HALVES]>,
    /// Empty list, for halves without a rule.
    no_nodes: Nodes,
}

/// Returns the positions of vertices relative to `origin`, m, and their normals.
pub(super) fn vertex_rows(posed: &PosedSkin, patch: &SkinPatch, origin: DVec3) -> [Row3; 2] {
    let mut rows = [[[0.0; LANES]; 3]; 2];
    for (l, &v) in patch.vertices.iter().enumerate() {
        let (position, normal) = (posed.vertices[v as usize] - origin, posed.normals[v as usize]);
        for axis in 0..3 {
            (rows[0][axis][l], rows[1][axis][l]) = (position[axis] as f32, normal[axis] as f32);
        }
    }
    rows
}

/// Gathers a vector quantity of vertices at every corner of triangles: `[corner]`.
fn vectors_at_corners(vectors: &Row3, corners: &[[usize; 3]; LANES]) -> [Row3; 3] {
    let mut rows: [Row3; 3] = Default::default();
    for axis in 0..3 {
        let at = at_corners(&vectors[axis], corners);
        (rows[0][axis], rows[1][axis], rows[2][axis]) = (at[0], at[1], at[2]);
    }
    rows
}

impl PatchPose {
    /// Creates an empty pose with room for a number of images.
    pub(super) fn new(images: usize, integrator: &Integrator) -> Self {
        let zero: Row3 = Default::default();
        let vertices =
            VertexRows { positions: zero, normals: zero, amplitude_factor: [0.0; LANES], narrowing: [1.0; LANES] };
        let level = integrator.level;
        let triangles = triangle_rows(level, &[zero; 3], &[zero; 3], &[zero; 3]);
        PatchPose {
            vertices,
            triangles,
            velocity: zero,
            corner_velocity: [zero; 3],
            directions: vec![direction_rows(level, [0.0; 3], &zero); images],
            views: vec![view_rows(level, DVec3::ZERO, DVec3::ZERO, &triangles, 1.0); images],
            nodes: integrator.rules.iter().map(|_| Default::default()).collect(),
            no_nodes: Nodes::default(),
        }
    }

    /// Computes the pose of a patch, with `amplitude_factor` and `narrowing` of its [`VertexRows`].
    pub(super) fn pose(
        &mut self,
        level: KernelLevel,
        patch: &SkinPatch,
        posed: &PosedSkin,
        origin: DVec3,
        amplitude_factor: Row,
        narrowing: Row,
    ) {
        let [positions, normals] = vertex_rows(posed, patch, origin);
        self.vertices = VertexRows { positions, normals, amplitude_factor, narrowing };
        let mut velocities: Row3 = Default::default();
        for (l, &v) in patch.vertices.iter().enumerate() {
            let velocity = posed.velocities_m_per_s[v as usize];
            (0..3).for_each(|axis| velocities[axis][l] = velocity[axis] as f32);
        }
        let corners = vectors_at_corners(&positions, &patch.corners);
        let corner_normals = vectors_at_corners(&normals, &patch.corners);
        let bulges = bulge_rows(level, &corners, &corner_normals);
        self.triangles = triangle_rows(level, &corners, &corner_normals, &bulges);
        let corner_velocities = vectors_at_corners(&velocities, &patch.corners);
        self.velocity = std::array::from_fn(|axis| {
            std::array::from_fn(|l| {
                (corner_velocities[0][axis][l] + corner_velocities[1][axis][l] + corner_velocities[2][axis][l])
                    * (1.0 / 3.0)
            })
        });
        self.corner_velocity = corner_velocities.map(|corner| {
            std::array::from_fn(|axis| std::array::from_fn(|l| corner[axis][l] - self.velocity[axis][l]))
        });
        self.nodes.iter_mut().flatten().for_each(|(is_computed, _)| *is_computed = false);
    }

    /// Computes directions and distances from an image antenna.
    pub(super) fn view_from(
        &mut self,
        image: usize,
        antenna: DVec3,
        origin: DVec3,
        wavelength_m: f64,
        level: KernelLevel,
    ) {
        let from_origin = (antenna - origin).as_vec3().to_array();
        self.directions[image] = direction_rows(level, from_origin, &self.vertices.positions);
        self.views[image] = view_rows(level, antenna, origin, &self.triangles, wavelength_m);
    }

    /// Computes the nodes of each half's rule, if they are not yet known.
    pub(super) fn compute_nodes(&mut self, rules: Rules, integrator: &Integrator) {
        for (half, rule) in rules.into_iter().enumerate() {
            let Some((rule, nodes)) = rule.and_then(|rule| Some((rule, self.nodes.get_mut(rule)?))) else { continue };
            if let Some((is_computed, nodes)) = nodes.get_mut(half)
                && !*is_computed
            {
                place_nodes(integrator.level, &self.triangles, half, &integrator.rules[rule], nodes);
                *is_computed = true;
            }
        }
    }

    /// Returns the nodes of each half's rule.
    pub(super) fn nodes(&self, rules: Rules) -> [&Nodes; HALVES] {
        let of_half = |half: usize| rules[half].map_or(&self.no_nodes, |rule| &self.nodes[rule][half].1);
        std::array::from_fn(of_half)
    }
}

/// Gathers a scalar quantity of vertices at every corner of triangles.
#[inline(always)]
pub(super) fn at_corners(values: &Row, corners: &[[usize; 3]; LANES]) -> [Row; 3] {
    let mut rows: [Row; 3] = Default::default();
    for l in 0..LANES {
        rows[0][l] = values[corners[l][0] % LANES];
        rows[1][l] = values[corners[l][1] % LANES];
        rows[2][l] = values[corners[l][2] % LANES];
    }
    rows
}
