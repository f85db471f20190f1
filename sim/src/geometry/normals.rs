//! Vertex normals at the scale at which waves see a surface.
//!
//! A highlight gathers a patch of the Fresnel radius (11 mm for 5 cm of curvature at 60 GHz); normals from one ring of
//! triangles carry the mesh's noise, and the error of an echo is that noise over curvature and edge length, growing as the mesh
//! is refined. Here a normal is that of a plane's worth of surface: over all vertices within the radius their one-ring normals
//! are fitted by a linear function of place, weighted by area and distance, and read at the vertex. A linear function follows
//! curvature exactly, so smoothing does not lean towards where vertices happen to be dense.

use glam::{DMat3, DVec3};

use super::{Mesh, MeshError};

/// Unit normals at the vertices, smoothed over a radius; vertices without a triangle have none (zero). Only what hangs
/// together over the surface counts, and only what faces within 60 degrees of the vertex's own: across a fold there is another
/// surface.
///
/// # Errors
/// [`MeshError`] for a mesh that [`Mesh::check`] refuses, and for a radius that is negative or not finite.
pub fn smooth_normals(mesh: &Mesh, radius_m: f64) -> Result<Vec<DVec3>, MeshError> {
    mesh.check()?;
    // Written so that NaN is refused.
    if !(radius_m >= 0.0 && radius_m.is_finite()) {
        return Err(MeshError::Length { what: "the radius of smoothing", given_m: radius_m });
    }
    let (ring, areas) = ring_normals(mesh);
    let around = adjacency(mesh);
    let mut marks = vec![u32::MAX; mesh.vertices.len()];
    let mut smooth = Vec::with_capacity(mesh.vertices.len());
    let mut patch: Vec<u32> = Vec::new();
    for (index, (&centre, &own)) in mesh.vertices.iter().zip(&ring).enumerate() {
        patch.clear();
        patch.push(index as u32);
        if let Some(mark) = marks.get_mut(index) {
            *mark = index as u32;
        }
        let mut reached = 0;
        while let Some(&at) = patch.get(reached) {
            reached += 1;
            for &n in around.of(at) {
                let near = mesh.vertices.get(n as usize).is_some_and(|p| p.distance(centre) < radius_m)
                    && ring.get(n as usize).is_some_and(|m| m.dot(own) > 0.5);
                if let Some(mark) = marks.get_mut(n as usize)
                    && *mark != index as u32
                    && near
                {
                    *mark = index as u32;
                    patch.push(n);
                }
            }
        }
        smooth.push(fit(mesh, &ring, &areas, &patch, centre, own, radius_m));
    }
    Ok(smooth)
}

/// The linear fit of a patch's normals at its centre.
fn fit(mesh: &Mesh, ring: &[DVec3], areas: &[f64], patch: &[u32], centre: DVec3, own: DVec3, radius_m: f64) -> DVec3 {
    if patch.len() < 5 {
        return own;
    }
    let (u, v) = own.any_orthonormal_pair();
    // Normal equations of N = c0 + c1 x + c2 y, for the three coordinates of N at once.
    let (mut left, mut right) = (DMat3::ZERO, DMat3::ZERO);
    for &index in patch {
        let at = index as usize;
        let (Some(&p), Some(&normal), Some(&area)) = (mesh.vertices.get(at), ring.get(at), areas.get(at)) else {
            continue;
        };
        let offset = (p - centre) / radius_m;
        let weight = area * (1.0 - offset.length_squared()).max(0.0).powi(2);
        let row = DVec3::new(1.0, offset.dot(u), offset.dot(v));
        left += DMat3::from_cols(row * row.x, row * row.y, row * row.z) * weight;
        right += DMat3::from_cols(row * normal.x, row * normal.y, row * normal.z) * weight;
    }
    // A patch that is a line has no slope across it.
    if left.determinant().abs() <= 1e-6 * left.x_axis.x.powi(3) {
        return own;
    }
    let fitted = left.inverse() * right;
    DVec3::new(fitted.x_axis.x, fitted.y_axis.x, fitted.z_axis.x).try_normalize().unwrap_or(own)
}

/// Unit normals at the vertices of triangles from one ring alone: enough where a mesh is as smooth as what it stands for.
pub(crate) fn one_ring_normals(vertices: &[DVec3], triangles: &[[u32; 3]]) -> Vec<DVec3> {
    let mut normals = vec![DVec3::ZERO; vertices.len()];
    for &corners in triangles {
        let [a, b, c] = corners.map(|v| vertices.get(v as usize).copied().unwrap_or_default());
        let (ab, bc, ca) = (b - a, c - b, a - c);
        let area_vector = ab.cross(-ca);
        let [ab, bc, ca] = [ab, bc, ca].map(DVec3::length_squared);
        // Over the squares of the two sides that meet in a corner. Of no area: of no weight.
        let product = ab * bc * ca;
        let weighted = if product > 0.0 { area_vector * (1.0 / product) } else { DVec3::ZERO };
        for (at, square) in corners.into_iter().zip([bc, ca, ab]) {
            if let Some(normal) = normals.get_mut(at as usize) {
                *normal += weighted * square;
            }
        }
    }
    normals.into_iter().map(DVec3::normalize_or_zero).collect()
}

/// Normals of one ring with Max's weights, which are exact on a sphere ("Weights for computing vertex normals from facet
/// normals", J. Graphics Tools 4(2), 1999), and a third of the area around each vertex.
fn ring_normals(mesh: &Mesh) -> (Vec<DVec3>, Vec<f64>) {
    let mut normals = vec![DVec3::ZERO; mesh.vertices.len()];
    let mut areas = vec![0.0; mesh.vertices.len()];
    for (triangle, &[a, b, c]) in mesh.triangles.iter().enumerate() {
        let area_vector = mesh.area_vector(triangle);
        for [at, next, last] in [[a, b, c], [b, c, a], [c, a, b]] {
            let place = |v: u32| mesh.vertices.get(v as usize).copied().unwrap_or_default();
            let squares = place(at).distance_squared(place(next)) * place(at).distance_squared(place(last));
            if let (Some(normal), Some(area)) = (normals.get_mut(at as usize), areas.get_mut(at as usize))
                && squares > 0.0
            {
                *normal += area_vector / squares;
                *area += area_vector.length() / 6.0;
            }
        }
    }
    (normals.into_iter().map(DVec3::normalize_or_zero).collect(), areas)
}

/// Vertices that edges join to each vertex.
struct Adjacency {
    starts: Vec<u32>,
    others: Vec<u32>,
}

impl Adjacency {
    fn of(&self, vertex: u32) -> &[u32] {
        let bounds = (self.starts.get(vertex as usize), self.starts.get(vertex as usize + 1));
        let (Some(&from), Some(&to)) = bounds else { return &[] };
        self.others.get(from as usize..to as usize).unwrap_or(&[])
    }
}

fn adjacency(mesh: &Mesh) -> Adjacency {
    let mut pairs: Vec<[u32; 2]> =
        mesh.triangles.iter().flat_map(|&[a, b, c]| [[a, b], [b, a], [b, c], [c, b], [c, a], [a, c]]).collect();
    pairs.sort_unstable();
    pairs.dedup();
    let mut starts = vec![0; mesh.vertices.len() + 1];
    for &[from, _] in &pairs {
        if let Some(count) = starts.get_mut(from as usize + 1) {
            *count += 1;
        }
    }
    let mut total = 0;
    for start in &mut starts {
        total += *start;
        *start = total;
    }
    Adjacency { starts, others: pairs.into_iter().map(|[_, to]| to).collect() }
}

#[cfg(test)]
mod tests {
    use rand::Rng;

    use super::*;
    use crate::geometry::isosurface;
    use crate::random::{Purpose, generator};

    fn ball(radius_m: f64) -> Mesh {
        let r = DVec3::splat(radius_m + 0.04);
        isosurface(-r, r, 0.015, |p| p.length() - radius_m)
    }

    fn worst_rad(mesh: &Mesh, normals: &[DVec3]) -> f64 {
        let angle = |(v, n): (&DVec3, &DVec3)| v.cross(*n).length().atan2(v.dot(*n));
        mesh.vertices.iter().zip(normals).map(angle).fold(0.0, f64::max)
    }

    #[test]
    fn a_sphere_s_normals_are_its_radii_at_any_radius_of_smoothing() {
        let mesh = ball(0.15);
        for radius_m in [0.0, 0.01, 0.02, 0.04] {
            let normals = smooth_normals(&mesh, radius_m).expect("a good mesh");
            assert!(worst_rad(&mesh, &normals) < 0.003, "{radius_m}: {} rad", worst_rad(&mesh, &normals));
        }
    }

    /// 0.1 mm of noise on 15 mm edges tilts one-ring normals by half a degree; the wider the radius, the less.
    #[test]
    fn noise_of_the_mesh_is_smoothed_away() {
        let mut mesh = ball(0.15);
        let mut rng = generator(3, Purpose::Build, [0, 0]);
        for vertex in &mut mesh.vertices {
            *vertex *= 1.0 + rng.random_range(-1e-4..1e-4) / 0.15;
        }
        let mut last = worst_rad(&mesh, &smooth_normals(&mesh, 0.0).expect("a good mesh"));
        for radius_m in [0.03, 0.05] {
            let worst = worst_rad(&mesh, &smooth_normals(&mesh, radius_m).expect("a good mesh"));
            assert!(worst < 0.75 * last, "{worst} rad at {radius_m} m after {last}");
            last = worst;
        }
    }

    #[test]
    fn faces_of_a_cube_do_not_bleed_into_each_other() {
        let mesh = isosurface(DVec3::splat(-0.2), DVec3::splat(0.2), 0.015, |p| (p.abs() - 0.1).max_element());
        let normals = smooth_normals(&mesh, 0.03).expect("a good mesh");
        let middle = mesh.vertices.iter().zip(&normals).filter(|(v, _)| v.x > 0.099 && v.y.abs().max(v.z.abs()) < 0.06);
        for (vertex, normal) in middle {
            assert!(normal.x > 0.9999, "{normal} at {vertex}");
        }
    }
}
