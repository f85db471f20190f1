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
            for facet in front_facets(face, edges) {
                if face.sides == Sides::Two {
                    facets.push(reversed(&facet));
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
fn front_facets(face: &Face, edges: &[&FaceEdge]) -> Vec<Facet> {
    let polygon = &face.polygon;
    if is_simple(polygon) {
        let (corners, diffracting_sides) = outline(polygon, edges);
        return vec![Facet { corners, holes: polygon.holes.clone(), wall: face.wall, diffracting_sides }];
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
    let in_plane = |corners: &[DVec3]| corners.iter().map(|c| DVec2::new(c.dot(u), c.dot(v))).collect::<Vec<DVec2>>();
    let holes: Vec<Vec<DVec2>> = polygon.holes.iter().map(|hole| in_plane(hole)).collect();
    triangulate(&in_plane(&polygon.outline), &holes).is_some()
}

/// Corners of a face's outline, with further corners where the adjoining object changes. Also whether the side from
/// each corner to the next diffracts.
fn outline(polygon: &PlanarPolygon, edges: &[&FaceEdge]) -> (Vec<DVec3>, Vec<bool>) {
    let (mut corners, mut diffracting) = (Vec::new(), Vec::new());
    for (number, [from, to]) in polygon.edges().take(polygon.outline.len()).enumerate() {
        let along = (to - from).normalize_or_zero();
        let start_m = |edge: &FaceEdge| (edge.ends[0] - from).dot(along);
        let mut parts: Vec<&FaceEdge> = edges.iter().copied().filter(|edge| edge.edge == number).collect();
        parts.sort_by(|a, b| start_m(a).total_cmp(&start_m(b)));
        corners.push(from);
        diffracting.push(parts.first().is_some_and(|part| part.diffracts()));
        for pair in parts.windows(2) {
            if let [before, part] = pair
                && !is_same_edge(&before.kind, &part.kind)
            {
                corners.push(from + along * start_m(part));
                diffracting.push(part.diffracts());
            }
        }
    }
    (corners, diffracting)
}

/// Returns whether two successive parts of an edge diffract as one edge.
fn is_same_edge(before: &EdgeKind, part: &EdgeKind) -> bool {
    match (before, part) {
        (EdgeKind::Wedge { other: a, .. }, EdgeKind::Wedge { other: b, .. }) => a == b,
        (EdgeKind::Seam { other: a }, EdgeKind::Seam { other: b }) => a == b,
        (EdgeKind::Wedge { .. } | EdgeKind::Seam { .. }, _) | (_, EdgeKind::Wedge { .. } | EdgeKind::Seam { .. }) => {
            false
        }
        (a, b) => (*a == EdgeKind::Free) == (*b == EdgeKind::Free),
    }
}

/// Facet on the reverse side of a facet.
fn reversed(facet: &Facet) -> Facet {
    let corners = facet.corners.iter().rev().copied().collect();
    // The last side leads back to the first corner, in either direction.
    let sides = facet.diffracting_sides.len();
    let diffracting_sides =
        (0..sides).filter_map(|i| facet.diffracting_sides.get((2 * sides - 2 - i) % sides).copied()).collect();
    Facet { corners, holes: facet.holes.clone(), wall: facet.wall, diffracting_sides }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::em::image::Wall;
    use crate::geometry::polygon;

    #[test]
    fn the_other_side_of_a_facet_has_its_edges() {
        let corners = vec![DVec3::ZERO, DVec3::X, DVec3::new(1.0, 1.0, 0.0), DVec3::Y];
        let diffracting_sides = vec![true, false, false, true];
        let facet = Facet { corners, holes: Vec::new(), wall: Wall::Conductor, diffracting_sides };
        let back = reversed(&facet);
        let sides = |facet: &Facet| -> Vec<([DVec3; 2], bool)> {
            polygon::sides(&facet.corners).zip(facet.diffracting_sides.iter().copied()).collect()
        };
        for ([a, b], diffracts) in sides(&facet) {
            assert!(sides(&back).contains(&([b, a], diffracts)), "{a} {b}: {back:?}");
        }
    }
}
