//! Facets of a scene's surfaces. A face with air on both sides becomes two facets, and surfaces that are not faces
//! become obstacles.

use glam::{DVec2, DVec3};

use super::environment::{Environment, EnvironmentError, Facet};
use super::triangulate::triangulate;
use crate::geometry::PlanarPolygon;
use crate::scene::surfaces::{EdgeKind, Face, FaceEdge, Sides, Surfaces};

/// Triangles of a damaged face smaller than this are left out, m^2.
const LEAST_TRIANGLE_M2: f64 = 1e-8;

impl Environment {
    /// Builds the environment of a scene's surfaces, which scatter a share of the incident power in all directions, and
    /// the name of each of its facets.
    ///
    /// # Errors
    /// If rays cannot be traced among the surfaces: places beyond 10 km, or triangles whose sizes differ by too many
    /// powers of two.
    pub fn of_surfaces(
        surfaces: &Surfaces,
        wavenumber_per_m: f64,
        diffuse_share: f64,
    ) -> Result<(Self, Vec<String>), EnvironmentError> {
        let mut edges: Vec<Vec<&FaceEdge>> = vec![Vec::new(); surfaces.faces.len()];
        for edge in &surfaces.edges {
            if let Some(of_face) = edges.get_mut(edge.face) {
                of_face.push(edge);
            }
        }
        let (mut facets, mut names) = (Vec::new(), Vec::new());
        for (face, edges) in surfaces.faces.iter().zip(&edges) {
            for facet in facets_of(face, edges) {
                if face.sides == Sides::Two {
                    facets.push(turned(&facet));
                    names.push(face.name.clone());
                }
                facets.push(facet);
                names.push(face.name.clone());
            }
        }
        let obstacles: Vec<[DVec3; 3]> = surfaces.small.iter().flat_map(|part| part.mesh.all_corners()).collect();
        Ok((Environment::with_obstacles(facets, &obstacles, wavenumber_per_m, diffuse_share)?, names))
    }
}

/// Facets of a face's front: one facet, or the face's triangles where its outlines cross.
fn facets_of(face: &Face, edges: &[&FaceEdge]) -> Vec<Facet> {
    let polygon = &face.polygon;
    if is_simple(polygon) {
        let (corners, soft_edges) = outline(polygon, edges);
        return vec![Facet { corners, holes: polygon.holes.clone(), wall: face.wall, soft_edges }];
    }
    tracing::warn!(face = face.name, "its outlines cross: its triangles are taken one by one");
    let area_m2 = |[a, b, c]: &[DVec3; 3]| 0.5 * (*b - *a).cross(*c - *a).length();
    let triangles = polygon.triangulate().into_iter().filter(|triangle| area_m2(triangle) > LEAST_TRIANGLE_M2);
    triangles.map(|corners| Facet::new(corners.to_vec(), face.wall)).collect()
}

/// Returns whether no outline of a polygon crosses itself or another.
fn is_simple(polygon: &PlanarPolygon) -> bool {
    if polygon.holes.is_empty() && polygon.outline.len() <= 3 {
        return true;
    }
    let u = polygon.normal.any_orthonormal_vector();
    let v = polygon.normal.cross(u);
    let flat = |corners: &[DVec3]| corners.iter().map(|c| DVec2::new(c.dot(u), c.dot(v))).collect::<Vec<DVec2>>();
    let holes: Vec<Vec<DVec2>> = polygon.holes.iter().map(|hole| flat(hole)).collect();
    triangulate(&flat(&polygon.outline), &holes).is_some()
}

/// Corners of a face's outline, with further corners where the adjoining object changes. Also whether the side from
/// each corner to the next diffracts.
fn outline(polygon: &PlanarPolygon, edges: &[&FaceEdge]) -> (Vec<DVec3>, Vec<bool>) {
    let (mut corners, mut soft) = (Vec::new(), Vec::new());
    for (number, [from, to]) in polygon.edges().take(polygon.outline.len()).enumerate() {
        let along = (to - from).normalize_or_zero();
        let place_m = |edge: &FaceEdge| (edge.ends[0] - from).dot(along);
        let mut parts: Vec<&FaceEdge> = edges.iter().copied().filter(|edge| edge.edge == number).collect();
        parts.sort_by(|a, b| place_m(a).total_cmp(&place_m(b)));
        corners.push(from);
        soft.push(parts.first().is_some_and(|part| part.diffracts()));
        for two in parts.windows(2) {
            if let [before, part] = two
                && !goes_on(&before.kind, &part.kind)
            {
                corners.push(from + along * place_m(part));
                soft.push(part.diffracts());
            }
        }
    }
    (corners, soft)
}

/// Returns whether two parts of an edge are one edge for waves.
fn goes_on(before: &EdgeKind, part: &EdgeKind) -> bool {
    match (before, part) {
        (EdgeKind::Wedge { other: a, .. }, EdgeKind::Wedge { other: b, .. }) => a == b,
        (EdgeKind::Seam { other: a }, EdgeKind::Seam { other: b }) => a == b,
        (EdgeKind::Wedge { .. } | EdgeKind::Seam { .. }, _) | (_, EdgeKind::Wedge { .. } | EdgeKind::Seam { .. }) => {
            false
        }
        (a, b) => (*a == EdgeKind::Free) == (*b == EdgeKind::Free),
    }
}

/// Reverse side of a facet.
fn turned(facet: &Facet) -> Facet {
    let corners = facet.corners.iter().rev().copied().collect();
    // The last side leads back to the first corner, in either direction.
    let sides = facet.soft_edges.len();
    let soft_edges = (0..sides).filter_map(|i| facet.soft_edges.get((2 * sides - 2 - i) % sides).copied()).collect();
    Facet { corners, holes: facet.holes.clone(), wall: facet.wall, soft_edges }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::em::image::Wall;
    use crate::geometry::polygon;

    #[test]
    fn the_other_side_of_a_facet_has_its_edges() {
        let corners = vec![DVec3::ZERO, DVec3::X, DVec3::new(1.0, 1.0, 0.0), DVec3::Y];
        let soft_edges = vec![true, false, false, true];
        let facet = Facet { corners, holes: Vec::new(), wall: Wall::Conductor, soft_edges };
        let back = turned(&facet);
        let sides = |facet: &Facet| -> Vec<([DVec3; 2], bool)> {
            polygon::sides(&facet.corners).zip(facet.soft_edges.iter().copied()).collect()
        };
        for ([a, b], is_soft) in sides(&facet) {
            assert!(sides(&back).contains(&([b, a], is_soft)), "{a} {b}: {back:?}");
        }
    }
}
