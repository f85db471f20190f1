//! Canonical shapes as surfaces, with the exact normals of the shape at every vertex.
//!
//! Plates and mirrors face +x, cylinders stand along z, and corners have their edges on the positive axes. A requested
//! edge length is the mean edge of the triangles.

use std::collections::HashMap;
use std::f64::consts::TAU;

use glam::DVec3;

use super::Surface;

/// Number of pieces of about `edge_m` into which a length is cut.
fn pieces(length_m: f64, edge_m: f64) -> usize {
    ((length_m / edge_m).round() as usize).clamp(1, 4096)
}

/// Grid of quadrangles, each cut in two: `(columns + 1) x (rows + 1)` vertices given by a function of (column, row).
fn grid(columns: usize, rows: usize, vertex: impl Fn(usize, usize) -> (DVec3, DVec3)) -> Surface {
    let mut surface = Surface::default();
    for row in 0..=rows {
        for column in 0..=columns {
            let (position, normal) = vertex(column, row);
            surface.vertices.push(position);
            surface.normals.push(normal);
        }
    }
    let at = |column: usize, row: usize| (row * (columns + 1) + column) as u32;
    for row in 0..rows {
        for column in 0..columns {
            let [a, b, c, d] = [at(column, row), at(column + 1, row), at(column + 1, row + 1), at(column, row + 1)];
            surface.triangles.extend([[a, b, c], [a, c, d]]);
        }
    }
    surface
}

/// Flat rectangle about the origin, `width_m` along y and `height_m` along z, that reflects on either side.
pub fn plate(width_m: f64, height_m: f64, edge_m: f64) -> Surface {
    let (columns, rows) = (pieces(width_m, edge_m), pieces(height_m, edge_m));
    let fraction = |i: usize, n: usize| i as f64 / n as f64 - 0.5;
    let mut surface = grid(columns, rows, |column, row| {
        (DVec3::new(0.0, width_m * fraction(column, columns), height_m * fraction(row, rows)), DVec3::X)
    });
    surface.two_sided = true;
    surface
}

/// Lateral surface of a cylinder about the z axis, without end caps.
pub fn cylinder(radius_m: f64, height_m: f64, edge_m: f64) -> Surface {
    let columns = pieces(TAU * radius_m, edge_m).max(3);
    let rows = pieces(height_m, edge_m);
    let mut surface = grid(columns, rows, |column, row| {
        let (sine, cosine) = (TAU * column as f64 / columns as f64).sin_cos();
        let normal = DVec3::new(cosine, sine, 0.0);
        (normal * radius_m + DVec3::Z * (height_m * (row as f64 / rows as f64 - 0.5)), normal)
    });
    // The last column coincides with the first one.
    let stride = columns as u32 + 1;
    for index in surface.triangles.iter_mut().flatten() {
        if *index % stride == columns as u32 {
            *index -= columns as u32;
        }
    }
    surface
}

/// Concave spherical mirror: pole at the origin, centre of curvature on +x, with an aperture of this radius. Its rim is
/// a polygon with the area of the circle. The area missing from an inscribed polygon would cause 0.3 dB where the other
/// contributions cancel.
pub fn mirror(radius_m: f64, aperture_radius_m: f64, edge_m: f64) -> Surface {
    let reach = (aperture_radius_m / radius_m).clamp(0.0, 1.0).asin();
    let rings = pieces(reach * radius_m, edge_m);
    let sectors = 6;
    // Ring i has 6 i vertices; the triangles between two rings are as even as possible.
    let mut surface = Surface { two_sided: true, ..Surface::default() };
    let mut add_vertex = |tilt: f64, azimuth: f64| {
        let outwards = DVec3::new(0.0, azimuth.cos(), azimuth.sin()) * tilt.sin();
        surface.vertices.push(DVec3::new(radius_m * (1.0 - tilt.cos()), 0.0, 0.0) + outwards * radius_m);
        surface.normals.push(DVec3::new(tilt.cos(), 0.0, 0.0) - outwards);
    };
    add_vertex(0.0, 0.0);
    for ring in 1..=rings {
        let spacing = TAU / (sectors * ring) as f64;
        // Geodesics between the rim's vertices lie inside its circle, on average by two thirds of the maximum.
        let excess = if ring == rings { reach.sin() * reach.cos() * spacing * spacing / 12.0 } else { 0.0 };
        for i in 0..sectors * ring {
            add_vertex(reach * ring as f64 / rings as f64 + excess, spacing * i as f64);
        }
    }
    let first = |ring: usize| if ring == 0 { 0 } else { 1 + sectors * ring * (ring - 1) / 2 };
    let at = |ring: usize, i: usize| (first(ring) + if ring == 0 { 0 } else { i % (sectors * ring) }) as u32;
    for ring in 1..=rings {
        for sector in 0..sectors {
            for i in 0..ring {
                let (outer, inner) = (sector * ring + i, sector * (ring - 1) + i);
                surface.triangles.push([at(ring - 1, inner), at(ring, outer), at(ring, outer + 1)]);
                if i + 1 < ring {
                    surface.triangles.push([at(ring - 1, inner), at(ring, outer + 1), at(ring - 1, inner + 1)]);
                }
            }
        }
    }
    surface
}

/// Surface area of an ellipsoid, m^2 (Knud Thomsen's formula, accurate to 1 %).
pub(crate) fn ellipsoid_area_m2(semi_axes_m: DVec3) -> f64 {
    const P: f64 = 1.6075;
    let [a, b, c] = semi_axes_m.to_array().map(|s| s.powf(P));
    2.0 * TAU * ((a * b + a * c + b * c) / 3.0).powf(1.0 / P)
}

/// Ellipsoid with semi-axes along x, y, z; triangles have a mean edge of about `edge_m`.
pub fn ellipsoid(semi_axes_m: DVec3, edge_m: f64) -> Surface {
    // A triangle of edge h has the area sqrt(3)/4 h^2.
    let triangles = ellipsoid_area_m2(semi_axes_m) / (0.433 * edge_m * edge_m);
    icosphere(semi_axes_m, (triangles / 20.0).sqrt().round().clamp(1.0, 512.0) as usize)
}

/// Corners of an icosahedron with edges of 2, and its triangles, counter-clockwise seen from outside.
pub(crate) fn icosahedron() -> (Vec<DVec3>, Vec<[usize; 3]>) {
    let g = 0.5 * (1.0 + 5f64.sqrt());
    let mut corners: Vec<DVec3> = Vec::with_capacity(12);
    for (x, y) in [(1.0, g), (-1.0, g), (1.0, -g), (-1.0, -g)] {
        corners.extend([DVec3::new(0.0, x, y), DVec3::new(x, y, 0.0), DVec3::new(y, 0.0, x)]);
    }
    let are_adjacent = |i: usize, j: usize| (corners[i].distance(corners[j]) - 2.0).abs() < 1e-6;
    let mut triangles = Vec::with_capacity(20);
    for (i, j) in (0..12).flat_map(|i| (i + 1..12).map(move |j| (i, j))).filter(|&(i, j)| are_adjacent(i, j)) {
        for k in (j + 1..12).filter(|&k| are_adjacent(j, k) && are_adjacent(k, i)) {
            let is_left = corners[i].dot(corners[j].cross(corners[k])) > 0.0;
            triangles.push(if is_left { [i, j, k] } else { [i, k, j] });
        }
    }
    (corners, triangles)
}

/// Ellipsoid from an icosahedron whose edges are cut into `cuts` pieces: `20 cuts^2` triangles.
pub fn icosphere(semi_axes_m: DVec3, cuts: usize) -> Surface {
    let cuts = cuts.max(1);
    let (corners, faces) = icosahedron();
    let mut surface = Surface::default();
    let mut index_of: HashMap<[i64; 3], u32> = HashMap::new();
    let mut vertex = |point: DVec3| {
        // A point on an edge is computed for both of its faces, with the same result within rounding.
        let key = (point * 1e9).to_array().map(|v| v.round() as i64);
        *index_of.entry(key).or_insert_with(|| {
            let unit = point.normalize();
            surface.vertices.push(unit * semi_axes_m);
            surface.normals.push((unit / semi_axes_m).normalize());
            (surface.vertices.len() - 1) as u32
        })
    };
    let mut triangles = Vec::with_capacity(20 * cuts * cuts);
    for face in faces {
        let [a, b, c] = face.map(|corner| corners[corner]);
        let mut at = |u: usize, v: usize| {
            let (u, v, w) = (u as f64, v as f64, (cuts - u - v) as f64);
            vertex((a * w + b * u + c * v) / cuts as f64)
        };
        for u in 0..cuts {
            for v in 0..cuts - u {
                triangles.push([at(u, v), at(u + 1, v), at(u, v + 1)]);
                if u + v + 1 < cuts {
                    triangles.push([at(u + 1, v), at(u + 1, v + 1), at(u, v + 1)]);
                }
            }
        }
    }
    surface.triangles = triangles;
    surface
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shapes_have_their_areas_and_face_outwards() {
        let cases = [
            (plate(0.1, 0.2, 0.01), 0.02),
            (cylinder(0.05, 0.3, 0.003), TAU * 0.05 * 0.3),
            // Area of a cap: 2 pi rho times its depth.
            (mirror(1.0, 0.1, 0.005), TAU * (1.0 - 0.99f64.sqrt())),
            (ellipsoid(DVec3::splat(0.05), 0.002), 2.0 * TAU * 0.0025),
        ];
        for (surface, area) in cases {
            assert!((surface.mesh().area_m2() / area - 1.0).abs() < 2e-3, "{} {area}", surface.mesh().area_m2());
            for t in 0..surface.triangles.len() {
                let [a, b, c] = surface.corners(t).expect("in range");
                let normal = (b.0 - a.0).cross(c.0 - a.0).normalize();
                assert!([a, b, c].iter().all(|corner| corner.1.dot(normal) > 0.9));
            }
        }
    }

    /// The formula is exact for a sphere, and close for an elongated ellipsoid.
    #[test]
    fn areas_of_ellipsoids_are_those_of_known_shapes() {
        assert!((ellipsoid_area_m2(DVec3::splat(0.3)) / (2.0 * TAU * 0.09) - 1.0).abs() < 1e-12);
        // Prolate 4 : 1, 2 pi a^2 (1 + c / (a e) asin e).
        let (a, c) = (0.1f64, 0.4f64);
        let e = (1.0 - a * a / (c * c)).sqrt();
        let exact = TAU * a * a * (1.0 + c / (a * e) * e.asin());
        let found = ellipsoid_area_m2(DVec3::new(a, a, c));
        assert!((found / exact - 1.0).abs() < 0.012, "{found} {exact}");
    }

    #[test]
    fn a_sphere_is_closed_and_as_fine_as_requested() {
        let sphere = icosphere(DVec3::splat(0.05), 32);
        assert_eq!(sphere.triangles.len(), 20 * 32 * 32);
        // Euler: V - E + F = 2 with E = 3 F / 2.
        assert_eq!(sphere.vertices.len(), 2 + sphere.triangles.len() / 2);
        let mean_m = ellipsoid(DVec3::new(0.12, 0.17, 0.3), 0.014).mean_edge_m();
        assert!((mean_m / 0.014 - 1.0).abs() < 0.1, "{mean_m}");
    }
}
