//! Test cases in which ray tracers usually fail.

use std::sync::{Arc, LazyLock};

use glam::{DMat3, DVec3};
use radome_dsp::KernelLevel;
use rand::Rng;

use super::*;
use crate::geometry::{Mesh, isosurface, planes};
use crate::people::motion::{MotionBuilder, Person};
use crate::people::skin::EDGE_M;
use crate::people::walking_mesh::WalkingMesh;
use crate::random::{Purpose, generator};

fn ball(radius_m: f64, centre: DVec3) -> Mesh {
    let r = DVec3::splat(radius_m + 0.1);
    let mut mesh = isosurface(-r, r, 0.04, |p| p.length() - radius_m);
    mesh.vertices.iter_mut().for_each(|v| *v += centre);
    mesh
}

/// Room of 12 x 2 x 2.5 m seen from within; each wall has `split` by `split` quadrilaterals.
fn corridor(split: u32) -> Mesh {
    let size = DVec3::new(12.0, 2.0, 2.5);
    let mut mesh = Mesh::default();
    for axis in 0..3 {
        for side in [0.0, 1.0] {
            let [n, u, v] = [0, 1, 2].map(|i| DVec3::AXES[(axis + i) % 3] * size);
            for i in 0..split * split {
                let at = |du: u32, dv: u32| {
                    let (a, b) = (f64::from(i % split + du), f64::from(i / split + dv));
                    n * side + (u * a + v * b) / f64::from(split)
                };
                let first = mesh.vertices.len() as u32;
                mesh.vertices.extend([at(0, 0), at(1, 0), at(1, 1), at(0, 1)]);
                let [a, b, c, d] = [0, 1, 2, 3].map(|k| first + k);
                mesh.triangles.extend(if side == 0.0 { [[a, b, c], [a, c, d]] } else { [[a, c, b], [a, d, c]] });
            }
        }
    }
    crate::geometry::weld(&mesh, 1e-9).expect("a good mesh").mesh
}

fn walker() -> &'static WalkingMesh {
    static WALKER: LazyLock<WalkingMesh> = LazyLock::new(|| {
        let person = Person::draw(1, [0, 0], 1.75);
        let motion = MotionBuilder::new(person, 0.0, [2.0, 1.0], 0.0).walk_to([9.0, 1.0], 1.2).stay();
        WalkingMesh::new(Arc::new(motion), EDGE_M)
    });
    &WALKER
}

/// Builds a tracer for which each triangle is a surface of its own.
fn tracer(mesh: &Mesh) -> RayTracer {
    let groups: Vec<u32> = (0..mesh.triangles.len() as u32).collect();
    RayTracer::new(mesh.clone(), &groups).expect("a good mesh")
}

/// Numbers of times that a ray enters a closed mesh and that it leaves it.
fn crossings(tracer: &RayTracer, ray: &Ray) -> (usize, usize) {
    let all = tracer.all(ray);
    let entered = all.iter().filter(|hit| hit.front).count();
    (entered, all.len() - entered)
}

/// Point in f64 where a ray crosses the plane of the triangle that it hits.
fn point(ray: &Ray, mesh: &Mesh, hit: &Hit) -> DVec3 {
    let corners = mesh.corners(hit.triangle as usize).expect("it was hit");
    ray.at(reference::plane(ray, corners).expect("it was hit").0)
}

fn direction(rng: &mut impl Rng) -> DVec3 {
    let z: f64 = rng.random_range(-1.0..1.0);
    let angle = rng.random_range(0.0..std::f64::consts::TAU);
    DVec3::new((1.0 - z * z).sqrt() * angle.cos(), (1.0 - z * z).sqrt() * angle.sin(), z)
}

/// Half a million rays at edges and half a million at vertices of closed meshes, from all around and along the axes.
/// Each enters as often as it leaves, and rays aimed at front faces do enter.
#[test]
fn a_million_rays_at_edges_and_vertices_neither_leak_nor_hit_twice() {
    let centre = DVec3::new(3.1, 0.7, 1.3);
    let mesh = ball(0.4, centre);
    let tracer = tracer(&mesh);
    let mut rng = generator(1, Purpose::Build, [0, 0]);
    let (mut unequal, mut twice, mut missed) = (0, 0, 0);
    for i in 0..1_000_000 {
        let [a, b, _] = mesh.corners(rng.random_range(0..mesh.triangles.len())).expect("an index in range");
        let aim = if i % 2 == 0 { a } else { a.lerp(b, rng.random_range(0.0..1.0)) };
        let towards = if i % 8 == 0 { -DVec3::AXES[i / 8 % 3] } else { direction(&mut rng) };
        let ray = Ray::new(aim - towards * rng.random_range(1.0..3.0), towards);
        let (entered, left) = crossings(&tracer, &ray);
        unequal += u32::from(entered != left);
        // A convex body is entered once.
        twice += u32::from(entered > 1);
        // Rays past the silhouette, up to three degrees of facets from it, may miss.
        missed += u32::from((aim - centre).dot(ray.direction) < -0.06 && entered == 0);
    }
    assert_eq!((unequal, twice, missed), (0, 0, 0));
}

/// Same test on a person, whose surface is neither convex nor smooth to a ray: limbs before limbs, edges behind edges.
#[test]
fn a_person_is_left_as_often_as_entered() {
    let man = walker().mesh_at(2.7);
    let tracer = tracer(&man);
    let mut rng = generator(2, Purpose::Build, [0, 0]);
    for i in 0..200_000 {
        let [a, b, _] = man.corners(rng.random_range(0..man.triangles.len())).expect("an index in range");
        let aim = if i % 2 == 0 { a } else { a.lerp(b, rng.random_range(0.0..1.0)) };
        let towards = direction(&mut rng);
        let (entered, left) = crossings(&tracer, &Ray::new(aim - towards * 4.0, towards));
        assert_eq!(entered, left, "at {aim} towards {towards}");
    }
}

/// No ray leaves a closed room: rays at walls, edges and corners, with few triangles or many, from the middle and from
/// just beside a corner.
#[test]
fn no_ray_leaves_a_closed_room() {
    for split in [1, 7] {
        let mesh = corridor(split);
        let tracer = tracer(&mesh);
        let mut rng = generator(3, Purpose::Build, [0, 0]);
        for i in 0..100_000 {
            let origin = match i % 3 {
                0 => DVec3::new(6.0, 1.0, 1.25),
                1 => DVec3::new(12.0 - 1e-4, 2.0 - 1e-4, 2.5 - 1e-4),
                _ => DVec3::new(3e-5, rng.random_range(0.1..1.9), 3e-5),
            };
            let aim = mesh.vertices[rng.random_range(0..mesh.vertices.len())];
            let other = mesh.vertices[rng.random_range(0..mesh.vertices.len())];
            let aim = aim.lerp(other, if i % 2 == 0 { 0.0 } else { rng.random_range(0.0..1.0) });
            if aim.distance(origin) > 1e-3 {
                let ray = Ray::new(origin, aim - origin);
                assert!(tracer.closest(&ray).is_some(), "{i}: from {origin} to {aim}");
            }
        }
    }
}

/// The structure finds the same triangles as a brute-force search in f64. Where it names another triangle, the ray
/// passes by an edge of both.
#[test]
fn hits_are_those_of_a_brute_force_search() {
    let man = walker().mesh_at(2.0);
    let mesh = corridor(2).joined(&man);
    let tracer = tracer(&mesh);
    let mut rng = generator(4, Purpose::Build, [0, 0]);
    for _ in 0..1600 {
        let origin = DVec3::new(rng.random_range(0.1..11.9), rng.random_range(0.1..1.9), rng.random_range(0.1..2.4));
        let aim = man.vertices[rng.random_range(0..man.vertices.len())];
        let aim = if rng.random_range(0..4) == 0 { origin + direction(&mut rng) } else { aim };
        let ray = Ray::new(origin, aim - origin);
        let slow = *reference::all(&ray, &mesh).first().expect("the room is closed");
        let hit = tracer.closest(&ray).expect("the room is closed");
        let corners = mesh.corners(hit.triangle as usize).expect("it was hit");
        let (distance, weights) = reference::plane(&ray, corners).expect("it was hit");
        let same = hit.triangle == slow.triangle;
        let at_edge = weights.iter().chain(&slow.barycentric).any(|w| w.abs() < 1e-3);
        assert!(same || at_edge, "{hit:?} instead of {slow:?}");
        if same {
            assert!((distance - slow.distance_m).abs() < 1e-9);
            // f32 is accurate across the surface; along a grazing ray the error is larger.
            let across = mesh.area_vector(hit.triangle as usize).normalize().dot(ray.direction).abs();
            let error_m = (hit.distance_m - slow.distance_m).abs();
            assert!(error_m * across < 5e-6, "{} m and {} m", hit.distance_m, slow.distance_m);
        }
    }
}

#[test]
fn structure_and_order_do_not_matter() {
    let man = walker().mesh_at(2.0);
    let mut reversed = man.clone();
    reversed.triangles.reverse();
    let (forwards, backwards) = (tracer(&man), tracer(&reversed));
    let count = man.triangles.len() as u32;
    let greatest = man.vertices.iter().fold(DVec3::NEG_INFINITY, |greatest, v| greatest.max(*v));
    let mut hits = 0;
    for i in 0..20_000 {
        let (y, z) = (f64::from(i % 100) / 50.0 - 1.0, f64::from(i / 100) / 100.0 - 1.0);
        let ray = Ray::new(greatest + DVec3::new(2.0, 0.0, -0.8), DVec3::new(-1.0, 0.2 * y - 0.1, 0.4 * z));
        let hit = forwards.closest(&ray);
        let mirrored = backwards.closest(&ray).map(|h| Hit { triangle: count - 1 - h.triangle, ..h });
        assert_eq!(mirrored, hit);
        hits += usize::from(hit.is_some());
    }
    assert!(hits > 300, "{hits}");
}

#[test]
fn the_processor_does_not_matter() {
    let room = corridor(2);
    let tracer = tracer(&room.joined(&walker().mesh_at(2.0)));
    let mut on_man = 0;
    for i in 0..20_000 {
        let (y, z) = (f64::from(i % 200) / 100.0 - 1.0, f64::from(i / 200) / 50.0 - 1.0);
        let ray = Ray::new(DVec3::new(0.05, 1.0, 1.2), DVec3::new(1.0, 0.4 * y, 0.4 * z));
        let everywhere = tracer.closest_at(KernelLevel::Portable, &ray).expect("the room is closed");
        for level in KernelLevel::ALL.into_iter().filter(|level| level.is_available()) {
            assert_eq!(tracer.closest_at(level, &ray), Some(everywhere));
        }
        on_man += usize::from(everywhere.triangle as usize >= room.triangles.len());
    }
    assert!(on_man > 300, "{on_man}");
}

/// Coplanar faces: of several triangles at the same distance, the lowest index is hit, everywhere.
#[test]
fn of_coincident_faces_the_first_is_hit() {
    let sheet = Mesh {
        vertices: vec![DVec3::ZERO, DVec3::Y, DVec3::new(0.0, 1.0, 1.0), DVec3::Z],
        triangles: vec![[0, 1, 2], [0, 2, 3]],
    };
    let tracer = tracer(&sheet.joined(&sheet).joined(&sheet));
    let mut rng = generator(5, Purpose::Build, [0, 0]);
    for _ in 0..10_000 {
        let origin = DVec3::new(rng.random_range(0.5..4.0), rng.random_range(-1.0..2.0), rng.random_range(-1.0..2.0));
        let aim = DVec3::new(0.0, rng.random_range(0.01..0.99), rng.random_range(0.01..0.99));
        let hit = tracer.closest(&Ray::new(origin, aim - origin)).expect("it is aimed at");
        assert!(hit.triangle < 2, "{hit:?}");
    }
}

/// Self-hit: the origin is not moved. A ray that leaves a surface hits neither it nor coplanar faces, and hits
/// everything else at its true distance.
#[test]
fn a_ray_does_not_hit_the_surface_that_it_leaves() {
    let mesh = corridor(5);
    let groups = planes(&mesh, 1e-6);
    assert_eq!(groups.planes.len(), 6);
    let tracer = RayTracer::new(mesh.clone(), &groups.of_triangle).expect("a good mesh");
    let mut rng = generator(6, Purpose::Build, [0, 0]);
    let mut ray = Ray::new(DVec3::new(5.0, 1.0, 1.2), direction(&mut rng));
    for _ in 0..20_000 {
        let hit = tracer.closest(&ray).expect("the room is closed");
        let (group, point) = (groups.of_triangle[hit.triangle as usize], point(&ray, &mesh, &hit));
        assert!(ray.end_groups[0] != Some(group), "left and hit the same wall");
        assert!(hit.front, "a room is seen from within");
        // Directions away from the wall, down to grazing by a hundredth of a degree.
        let normal = groups.planes[group as usize].normal;
        let along = direction(&mut rng);
        let along = (along - normal * along.dot(normal)).normalize();
        ray = Ray::new(point, along + normal * 10f64.powf(rng.random_range(-4.0..1.0))).leaving(group, normal);
    }
}

/// f32 hit point as path vertex: f32 puts it 5.8 um beside a wall 12 m away, which is 0.015 rad of phase per bounce.
/// With the distance in f64 to the plane of the hit triangle, the point lies on the plane to 1e-13 m.
#[test]
fn the_triangle_of_a_hit_gives_the_point_in_f64() {
    let mesh = corridor(3).joined(&walker().mesh_at(2.0));
    let tracer = tracer(&mesh);
    let mut rng = generator(10, Purpose::Build, [0, 0]);
    for _ in 0..20_000 {
        let ray = Ray::new(DVec3::new(rng.random_range(0.1..11.9), 0.3, 1.1), direction(&mut rng));
        let hit = tracer.closest(&ray).expect("the room is closed");
        let corners = mesh.corners(hit.triangle as usize).expect("it was hit");
        let normal = mesh.area_vector(hit.triangle as usize).normalize();
        let (distance, weights) = reference::plane(&ray, corners).expect("it was hit");
        assert!((ray.at(distance) - corners[0]).dot(normal).abs() < 1e-13);
        assert!((distance - hit.distance_m).abs() * normal.dot(ray.direction).abs() < 5e-6);
        assert!((weights.iter().sum::<f64>() - 1.0).abs() < 1e-9);
    }
}

/// The segment between two surfaces is blocked only by objects between them: not by the surfaces themselves, nor by
/// their edges.
#[test]
fn surfaces_at_the_ends_of_a_segment_do_not_block_it() {
    let plate = Mesh {
        vertices: vec![DVec3::new(6.0, 0.5, 0.5), DVec3::new(6.0, 1.5, 0.5), DVec3::new(6.0, 1.0, 1.5)],
        triangles: vec![[0, 1, 2]],
    };
    let mesh = corridor(1).joined(&plate);
    let groups = planes(&mesh, 1e-6).of_triangle;
    let tracer = RayTracer::new(mesh.clone(), &groups).expect("a good mesh");
    let mut rng = generator(7, Purpose::Build, [0, 0]);
    let mut blocked = 0;
    for _ in 0..20_000 {
        // Rays away from the plate find a point of the wall on either side.
        let away_from = |x: f64, towards: DVec3, y: f64, z: f64| {
            let ray = Ray::new(DVec3::new(x, y, z), towards);
            let hit = tracer.closest(&ray).expect("the room is closed");
            (point(&ray, &mesh, &hit), groups[hit.triangle as usize])
        };
        let (y, z) = (rng.random_range(0.01..1.99), rng.random_range(0.01..2.49));
        let (begin, begin_group) = away_from(6.5, DVec3::X, y, z);
        let (y, z) = (rng.random_range(0.01..1.99), rng.random_range(0.01..2.49));
        let (end, end_group) = away_from(5.5, -DVec3::X, y, z);
        let segment = Ray::between(begin, end).leaving(begin_group, DVec3::X).reaching(end_group);
        let crossing = segment.at((begin.x - 6.0) / (begin.x - end.x) * segment.length_m);
        let (y, z) = (crossing.y - 0.5, crossing.z - 0.5);
        let margin = z.min(2.0 * y - z).min(2.0 - 2.0 * y - z);
        if margin.abs() > 1e-4 {
            assert_eq!(tracer.blocked(&segment), margin > 0.0, "through {crossing}");
            blocked += u32::from(margin > 0.0);
        }
    }
    assert!(blocked > 500);
}

/// Rays along axes, in the planes of edges, and with zero or denormal direction components.
#[test]
fn rays_along_axes_and_in_planes_enter_as_often_as_they_leave() {
    let tracer = tracer(&Mesh::cube());
    for tiny in [0.0, 1e-40, -1e-40, 1e-9, -1e-9] {
        for aim in [DVec3::splat(0.5), DVec3::new(0.5, 0.25, 0.25), DVec3::new(0.5, 0.0, 0.0), DVec3::splat(0.0)] {
            for axis in DVec3::AXES {
                for sign in [1.0, -1.0] {
                    let towards = axis * sign + DVec3::splat(tiny);
                    let ray = Ray::new(aim - towards * 3.0, towards);
                    let (entered, left) = crossings(&tracer, &ray);
                    assert_eq!(entered, left, "{aim} {towards}");
                    let inside = aim - axis * aim.dot(axis);
                    if inside.to_array().iter().filter(|&&c| c > 0.1).count() == 2 {
                        assert_eq!(entered, 1, "{aim} {towards}");
                    }
                }
            }
        }
    }
}

/// From a kilometre away, where f32 has steps of 0.06 mm, rays still hit a ball of 4 cm triangles at the correct
/// distances, including edges.
#[test]
fn rays_from_far_away_are_as_sharp_as_from_near() {
    let mesh = ball(0.4, DVec3::ZERO);
    let tracer = tracer(&mesh);
    let mut rng = generator(8, Purpose::Build, [0, 0]);
    for far in [50.0, 1e3, 1e5] {
        for _ in 0..2000 {
            let towards = direction(&mut rng);
            let aim = mesh.vertices[rng.random_range(0..mesh.vertices.len())];
            let ray = Ray::new(aim - towards * far, towards);
            let (entered, left) = crossings(&tracer, &ray);
            assert_eq!(entered, left);
            if aim.dot(towards) < -0.06 {
                let hit = tracer.closest(&ray).expect("it is aimed at");
                assert!((hit.distance_m - far).abs() < 1e-5, "{} m instead of {far} m", hit.distance_m);
            }
        }
    }
}

#[test]
fn rays_without_origin_or_direction_hit_nothing() {
    let tracer = tracer(&corridor(1));
    let good = DVec3::new(1.0, 1.0, 1.0);
    for (origin, towards) in [
        (good, DVec3::ZERO),
        (good, DVec3::new(f64::NAN, 0.0, 1.0)),
        (DVec3::new(f64::INFINITY, 0.0, 0.0), DVec3::X),
        (DVec3::splat(f64::NAN), DVec3::X),
        (DVec3::splat(1e300), DVec3::X),
    ] {
        let ray = Ray { direction: towards, ..Ray::new(origin, DVec3::X) };
        assert_eq!(tracer.closest(&ray), None);
        assert!(!tracer.blocked(&ray));
        assert!(tracer.all(&ray).is_empty());
    }
    let nothing = RayTracer::new(Mesh::default(), &[]).expect("nothing is a mesh");
    let ray = Ray::new(good, DVec3::X);
    assert_eq!(nothing.closest(&ray), None);
    assert!(!nothing.blocked(&ray) && nothing.all(&ray).is_empty());
}

#[test]
fn damaged_meshes_are_refused() {
    let bad = Mesh { vertices: vec![DVec3::ZERO; 3], triangles: vec![[0, 1, 3]] };
    assert!(matches!(RayTracer::new(bad, &[0]), Err(RayTracerError::Mesh(_))));
    let mut not_finite = ball(0.4, DVec3::ZERO);
    not_finite.vertices[5].y = f64::NAN;
    let groups = vec![0; not_finite.triangles.len()];
    assert!(matches!(RayTracer::new(not_finite, &groups), Err(RayTracerError::Mesh(_))));
    assert!(matches!(RayTracer::new(corridor(1), &[0]), Err(RayTracerError::Groups { expected: 12, given: 1 })));
}

#[test]
fn a_body_may_be_far_large_or_small() {
    let mesh = ball(0.4, DVec3::ZERO);
    for (scale, shift) in [(1.0, DVec3::new(80.0, -40.0, 3.0)), (30.0, DVec3::ZERO), (0.1, DVec3::splat(2.0))] {
        let turn = DMat3::from_rotation_z(0.7);
        let vertices: Vec<DVec3> = mesh.vertices.iter().map(|v| turn * *v * scale + shift).collect();
        let tracer = tracer(&Mesh { vertices: vertices.clone(), triangles: mesh.triangles.clone() });
        let mut rng = generator(9, Purpose::Build, [0, 0]);
        for _ in 0..5000 {
            let aim = vertices[rng.random_range(0..vertices.len())];
            let towards = direction(&mut rng);
            let (entered, left) = crossings(&tracer, &Ray::new(aim - towards * 3.0 * scale, towards));
            assert_eq!(entered, left, "{scale} {shift}");
            let inwards = (aim - shift).normalize().dot(towards) < -0.1;
            assert!(entered == 1 || !inwards, "{scale} {shift}");
        }
    }
}
