//! The rows of the design study's table of numerically hard cases that involve several parts. The others are tested
//! beside the code, in modules of the same name:
//!
//! | row | where |
//! |---|---|
//! | facet integral near specular | `em/triangle.rs`, `tests/solver.rs` |
//! | f32 kernel, dynamic range | `synthesis.rs` |
//! | f32 path length | here |
//! | f32 hit point, self-hit, shared edges, coplanar faces | `rays/hard_cases.rs` |
//! | visibility flips | `paths/tests.rs` |
//! | overlapping faces | `geometry/lint.rs` |
//! | degenerate triangles | `geometry/weld.rs`, `tests/solver.rs` |
//! | grazing, total internal reflection, thin slab | `em/fresnel.rs`, `tests/references.rs`, `tests/solver.rs` |
//! | caustic, PO shadow line | `tests/solver.rs` |
//! | dihedral | `validation/images.rs`, `tests/solver.rs` |
//! | R to 0 | `tests/solver.rs`, `tests/physics.rs` |
//! | threads | `tests/stream.rs` |

use glam::DVec3;
use radome_sim::em::image::{BoxRoom, Wall};
use radome_sim::geometry::Mesh;
use radome_sim::random::{Purpose, generator};
use radome_sim::rays::{Ray, RayTracer};
use rand::Rng;

use crate::common::WAVENUMBER;
use crate::surfaces::rooms::{faces, triangles};

/// Path length: the distance of a ray in f32 has errors up to milliradians. The length in f64 from the surfaces that
/// the ray hits equals that of the image to 1e-11 rad, for paths of 10 m and of 20 m.
#[test]
fn path_lengths_from_hit_triangles_are_exact() {
    for (size_m, bound_rad) in [(DVec3::new(5.0, 2.0, 2.5), 1e-11), (DVec3::new(9.5, 6.0, 3.0), 1e-11)] {
        let room = BoxRoom::new(size_m, [Wall::Conductor; 6], WAVENUMBER, false);
        let mesh = box_mesh(size_m);
        let groups: Vec<u32> = (0..mesh.triangles.len() as u32).collect();
        let tracer = RayTracer::new(mesh.clone(), &groups).expect("a good mesh");
        let mut rng = generator(9, Purpose::Build, [0, 0]);
        let (mut ray_error_rad, mut image_error_rad): (f64, f64) = (0.0, 0.0);
        for _ in 0..5000 {
            let mut random_position = || DVec3::new(rng.random(), rng.random(), rng.random()) * (size_m - 0.1) + 0.05;
            let (from, to) = (random_position(), random_position());
            for index in [[-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1]] {
                let polyline = room.polyline(index, from, to);
                let ray = Ray::new(from, polyline[1] - from);
                let hit = tracer.closest(&ray).expect("the room is closed");
                let [corner, ..] = mesh.corners(hit.triangle as usize).expect("a triangle of the mesh");
                let normal = mesh.area_vector(hit.triangle as usize).normalize();
                let image = from - normal * (2.0 * normal.dot(from - corner));
                let exact = room.image_position(index, from).distance(to);
                image_error_rad = image_error_rad.max(WAVENUMBER * (image.distance(to) - exact).abs());
                ray_error_rad =
                    ray_error_rad.max(2.0 * WAVENUMBER * (hit.distance_m - from.distance(polyline[1])).abs());
            }
        }
        assert!(image_error_rad < bound_rad, "{size_m}: {image_error_rad:e} rad");
        assert!(ray_error_rad > 1e-5, "{size_m}: the length of the ray itself is less exact, {ray_error_rad:e} rad");
    }
}

/// Box of twelve triangles.
fn box_mesh(size_m: DVec3) -> Mesh {
    let corners = triangles(&faces([0.0; 3], size_m.to_array()));
    let vertices = corners.iter().flatten().map(|&corner| DVec3::from_array(corner)).collect();
    Mesh { vertices, triangles: (0..12).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect() }
}
