//! What rays usually get wrong.

use glam::DVec3;
use rand::Rng;

use super::*;
use crate::geometry::Mesh;
use crate::random::{Purpose, generator};

/// A closed sphere of `20 * 4^level` triangles.
fn icosphere(level: usize, radius_m: f64, centre: DVec3) -> Mesh {
    let g = 0.5 * (1.0 + 5f64.sqrt());
    let mut vertices: Vec<DVec3> = [
        [-1.0, g, 0.0],
        [1.0, g, 0.0],
        [-1.0, -g, 0.0],
        [1.0, -g, 0.0],
        [0.0, -1.0, g],
        [0.0, 1.0, g],
        [0.0, -1.0, -g],
        [0.0, 1.0, -g],
        [g, 0.0, -1.0],
        [g, 0.0, 1.0],
        [-g, 0.0, -1.0],
        [-g, 0.0, 1.0],
    ]
    .into_iter()
    .map(|p| DVec3::from(p).normalize())
    .collect();
    let mut triangles: Vec<[u32; 3]> = vec![
        [0, 11, 5],
        [0, 5, 1],
        [0, 1, 7],
        [0, 7, 10],
        [0, 10, 11],
        [1, 5, 9],
        [5, 11, 4],
        [11, 10, 2],
        [10, 7, 6],
        [7, 1, 8],
        [3, 9, 4],
        [3, 4, 2],
        [3, 2, 6],
        [3, 6, 8],
        [3, 8, 9],
        [4, 9, 5],
        [2, 4, 11],
        [6, 2, 10],
        [8, 6, 7],
        [9, 8, 1],
    ];
    for _ in 0..level {
        let mut middles = std::collections::BTreeMap::new();
        let mut next = Vec::new();
        for [a, b, c] in triangles {
            let mut middle = |p: u32, q: u32| {
                *middles.entry((p.min(q), p.max(q))).or_insert_with(|| {
                    vertices.push((vertices[p as usize] + vertices[q as usize]).normalize());
                    vertices.len() as u32 - 1
                })
            };
            let (ab, bc, ca) = (middle(a, b), middle(b, c), middle(c, a));
            next.extend([[a, ab, ca], [b, bc, ab], [c, ca, bc], [ab, bc, ca]]);
        }
        triangles = next;
    }
    let vertices = vertices.into_iter().map(|v| centre + v * radius_m).collect();
    Mesh { vertices, triangles }
}

/// Half a million rays at edges and half a million at vertices of a closed mesh: each goes in as often as it comes out, and
/// the first thing it meets is no farther than what was aimed at.
#[test]
fn a_million_rays_at_edges_and_vertices_neither_leak_nor_meet_twice() {
    let mesh = icosphere(4, 0.4, DVec3::new(3.1, 0.7, 1.3));
    let world = World::new(vec![Body::new(mesh.clone(), Build::Moving).expect("a good mesh")]).expect("a small world");
    let mut rng = generator(1, Purpose::Build, [0, 0]);
    let (mut leaks, mut doubles, mut missed) = (0, 0, 0);
    for i in 0..1_000_000 {
        let [a, b, _] = mesh.corners(rng.random_range(0..mesh.triangles.len())).expect("an index in range");
        let aim = if i % 2 == 0 { a } else { a.lerp(b, rng.random_range(0.0..1.0)) };
        let origin = DVec3::new(rng.random_range(0.0..6.0), rng.random_range(-2.0..3.0), rng.random_range(2.0..4.0));
        let ray = Ray::new(origin, aim - origin);
        let crossings = world.crossings(0, &ray);
        leaks += u32::from(crossings.entered < crossings.left);
        doubles += u32::from(crossings.entered > crossings.left || crossings.entered > 1);
        // A ray to the silhouette may pass beside it; one to the front may not.
        let front = (aim - DVec3::new(3.1, 0.7, 1.3)).dot(ray.direction) < -0.02;
        missed += u32::from(front && crossings.entered == 0);
    }
    assert_eq!((leaks, doubles, missed), (0, 0, 0));
}
