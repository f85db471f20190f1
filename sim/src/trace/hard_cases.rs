//! Cases that ray tracers usually get wrong.

use std::sync::{Arc, LazyLock};

use glam::{DMat3, DVec3};
use rand::Rng;

use super::*;
use crate::actor::motion::{MotionBuilder, Person};
use crate::actor::skin::EDGE_M;
use crate::actor::walking_mesh::WalkingMesh;
use crate::geometry::{Mesh, isosurface, planes};
use crate::random::{Purpose, generator};

fn ball(radius_m: f64, centre: DVec3) -> Mesh {
    let r = DVec3::splat(radius_m + 0.1);
    let mut mesh = isosurface(-r, r, 0.04, |p| p.length() - radius_m);
    mesh.vertices.iter_mut().for_each(|v| *v += centre);
    mesh
}

/// A room of 12 x 2 x 2.5 m seen from within; each wall of `split` by `split` quadrilaterals.
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

fn world(bodies: Vec<(Mesh, Build)>) -> World {
    let bodies = bodies.into_iter().map(|(mesh, build)| Body::new(mesh, build).expect("a good mesh")).collect();
    World::new(bodies).expect("a small world")
}

fn direction(rng: &mut impl Rng) -> DVec3 {
    let z: f64 = rng.random_range(-1.0..1.0);
    let angle = rng.random_range(0.0..std::f64::consts::TAU);
    DVec3::new((1.0 - z * z).sqrt() * angle.cos(), (1.0 - z * z).sqrt() * angle.sin(), z)
}

/// Half a million rays at edges and half a million at vertices of closed meshes, from all around and along the axes: each goes
/// in as often as it comes out, and those aimed at what faces them do go in.
#[test]
fn a_million_rays_at_edges_and_vertices_neither_leak_nor_meet_twice() {
    let centre = DVec3::new(3.1, 0.7, 1.3);
    let mesh = ball(0.4, centre);
    let world = world(vec![(mesh.clone(), Build::Moving)]);
    let mut rng = generator(1, Purpose::Build, [0, 0]);
    let (mut unequal, mut twice, mut missed) = (0, 0, 0);
    for i in 0..1_000_000 {
        let [a, b, _] = mesh.corners(rng.random_range(0..mesh.triangles.len())).expect("an index in range");
        let aim = if i % 2 == 0 { a } else { a.lerp(b, rng.random_range(0.0..1.0)) };
        let towards = if i % 8 == 0 { -DVec3::AXES[i / 8 % 3] } else { direction(&mut rng) };
        let ray = Ray::new(aim - towards * rng.random_range(1.0..3.0), towards);
        let crossings = world.crossings(0, &ray);
        unequal += u32::from(crossings.entered != crossings.left);
        // A convex body is entered once.
        twice += u32::from(crossings.entered > 1);
        // Those past the silhouette, up to three degrees of facets from it, may miss.
        missed += u32::from((aim - centre).dot(ray.direction) < -0.06 && crossings.entered == 0);
    }
    assert_eq!((unequal, twice, missed), (0, 0, 0));
}

/// The same on a person, who is neither convex nor smooth to a ray: limbs before limbs, edges behind edges.
#[test]
fn a_person_is_left_as_often_as_entered() {
    let mut walker_world = world(vec![(walker().mesh_at(1.0), Build::Moving)]);
    let moved = walker().mesh_at(2.7);
    walker_world.refit(0, &moved.vertices).expect("the same mesh");
    let mut rng = generator(2, Purpose::Build, [0, 0]);
    for i in 0..200_000 {
        let [a, b, _] = moved.corners(rng.random_range(0..moved.triangles.len())).expect("an index in range");
        let aim = if i % 2 == 0 { a } else { a.lerp(b, rng.random_range(0.0..1.0)) };
        let towards = direction(&mut rng);
        let crossings = walker_world.crossings(0, &Ray::new(aim - towards * 4.0, towards));
        assert_eq!(crossings.entered, crossings.left, "at {aim} towards {towards}");
    }
}

/// From within a closed room nothing gets out: at walls, edges and corners, with few triangles or many, from the middle and
/// from just beside a corner.
#[test]
fn no_ray_leaves_a_closed_room() {
    for split in [1, 7] {
        let mesh = corridor(split);
        let world = world(vec![(mesh.clone(), Build::Static)]);
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
                assert!(world.closest(&ray).is_some(), "{i}: from {origin} to {aim}");
            }
        }
    }
}

/// Structures, packets and single rays find what trying all triangles in f64 finds. Where they name another triangle, the ray
/// goes by an edge of both.
#[test]
fn what_is_met_is_what_trying_everything_meets() {
    let (room, man) = (corridor(2), walker().mesh_at(2.0));
    let world = world(vec![(room.clone(), Build::Static), (man.clone(), Build::Moving)]);
    let mut rng = generator(4, Purpose::Build, [0, 0]);
    let mut rays: Vec<Ray> = (0..800)
        .map(|_| {
            let origin =
                DVec3::new(rng.random_range(0.1..11.9), rng.random_range(0.1..1.9), rng.random_range(0.1..2.4));
            let aim = man.vertices[rng.random_range(0..man.vertices.len())];
            let aim = if rng.random_range(0..4) == 0 { origin + direction(&mut rng) } else { aim };
            Ray::new(origin, aim - origin)
        })
        .collect();
    // A fan, which goes in packets.
    rays.extend((0..800).map(|i| {
        let (y, z) = (f64::from(i % 40) / 20.0 - 1.0, f64::from(i / 40) / 10.0 - 1.0);
        Ray::new(DVec3::new(0.05, 1.0, 1.2), DVec3::new(1.0, 0.2 * y, 0.3 * z))
    }));
    let mut hits = vec![None; rays.len()];
    world.closest_each(&rays, |i, hit| hits[i] = hit);
    for (ray, hit) in rays.iter().zip(&hits) {
        let first = |mesh: &Mesh, body: u32| reference::all(ray, mesh).first().map(|m| (m.distance_m, body, *m));
        let (in_room, in_man) = (first(&room, 0), first(&man, 1));
        let slow = in_room.into_iter().chain(in_man).min_by(|a, b| a.0.total_cmp(&b.0)).expect("the room is closed");
        let hit = hit.expect("the room is closed");
        let (distance, weights) = world.exact(ray, &hit).expect("it was met");
        let same = (hit.body, hit.triangle) == (slow.1, slow.2.triangle);
        let at_edge = weights.iter().chain(&slow.2.barycentric).any(|w| w.abs() < 1e-3);
        assert!(same || at_edge, "{hit:?} instead of {slow:?}");
        if same {
            assert!((distance - slow.0).abs() < 1e-9);
            // Across the surface f32 is sharp; along a grazing ray that is longer.
            let mesh = world.bodies()[hit.body as usize].mesh();
            let across = mesh.area_vector(hit.triangle as usize).normalize().dot(ray.direction).abs();
            assert!((hit.distance_m - slow.0).abs() * across < 5e-6, "{} m and {} m", hit.distance_m, slow.0);
        }
        assert_eq!(world.closest(ray), Some(hit), "alone and in a packet");
    }
}

/// The hit does not depend on the order of triangles, on the way the structure was built, or on refitting.
#[test]
fn structure_and_order_do_not_matter() {
    let walker = walker();
    let (early, late) = (walker.mesh_at(1.0), walker.mesh_at(2.0));
    let mut refitted = world(vec![(early, Build::Moving)]);
    refitted.refit(0, &late.vertices).expect("the same mesh");
    let mut reversed = late.clone();
    reversed.triangles.reverse();
    let others = [Build::Moving, Build::Static].map(|build| world(vec![(late.clone(), build)]));
    let backwards = world(vec![(reversed, Build::Moving)]);
    let count = late.triangles.len() as u32;
    let (_, greatest) = refitted.bodies()[0].bounds();
    for i in 0..20_000 {
        let (y, z) = (f64::from(i % 100) / 50.0 - 1.0, f64::from(i / 100) / 100.0 - 1.0);
        let ray = Ray::new(greatest + DVec3::new(2.0, 0.0, -0.8), DVec3::new(-1.0, 0.2 * y - 0.1, 0.4 * z));
        let hit = refitted.closest(&ray);
        for other in &others {
            assert_eq!(other.closest(&ray), hit);
        }
        let mirrored = backwards.closest(&ray).map(|h| Hit { triangle: count - 1 - h.triangle, ..h });
        assert_eq!(mirrored, hit);
    }
}

/// The same bits with the processor's widest instructions as with those that every processor has.
#[test]
fn the_processor_does_not_matter() {
    let world = world(vec![(corridor(2), Build::Static), (walker().mesh_at(2.0), Build::Moving)]);
    let rays: Vec<Ray> = (0..20_003)
        .map(|i| {
            let (y, z) = (f64::from(i % 200) / 100.0 - 1.0, f64::from(i / 200) / 50.0 - 1.0);
            Ray::new(DVec3::new(0.05, 1.0, 1.2), DVec3::new(1.0, 0.4 * y, 0.4 * z))
        })
        .collect();
    let (mut here, mut everywhere) = (vec![None; rays.len()], vec![None; rays.len()]);
    world.closest_each(&rays, |i, hit| here[i] = hit);
    super::world::closest_body(&world, &rays, &mut |i, hit| everywhere[i] = hit);
    assert_eq!(here, everywhere);
    assert!(here.iter().all(|h| h.is_some()) && here.iter().flatten().filter(|h| h.body == 1).count() > 300);
}

/// Coplanar faces: of two at the same distance the lowest (body, triangle) is met, everywhere.
#[test]
fn of_two_faces_at_one_place_the_first_is_met() {
    let sheet = |flip: bool| {
        let vertices = vec![DVec3::ZERO, DVec3::Y, DVec3::new(0.0, 1.0, 1.0), DVec3::Z];
        let triangles = if flip { vec![[0, 1, 3], [1, 2, 3]] } else { vec![[0, 1, 2], [0, 2, 3]] };
        Mesh { vertices, triangles }
    };
    // Twice the same in one body, and the same again as another body.
    let mut double = sheet(false);
    double.triangles.extend(double.triangles.clone());
    let one = world(vec![(double, Build::Moving), (sheet(false), Build::Moving)]);
    let mut rng = generator(5, Purpose::Build, [0, 0]);
    for _ in 0..10_000 {
        let origin = DVec3::new(rng.random_range(0.5..4.0), rng.random_range(-1.0..2.0), rng.random_range(-1.0..2.0));
        let aim = DVec3::new(0.0, rng.random_range(0.01..0.99), rng.random_range(0.01..0.99));
        let hit = one.closest(&Ray::new(origin, aim - origin)).expect("it is aimed at");
        assert!(hit.body == 0 && hit.triangle < 2, "{hit:?}");
    }
}

/// Self-hit: nothing is moved; a ray that leaves a surface does not meet it or what is coplanar with it, and
/// meets everything else at its true distance.
#[test]
fn a_ray_does_not_meet_the_surface_that_it_leaves() {
    let mesh = corridor(5);
    let groups = planes(&mesh, 1e-6);
    assert_eq!(groups.planes.len(), 6);
    let body = Body::with_groups(mesh, groups.of_triangle, Build::Static).expect("a good mesh");
    let world = World::new(vec![body]).expect("a small world");
    let mut rng = generator(6, Purpose::Build, [0, 0]);
    let mut ray = Ray::new(DVec3::new(5.0, 1.0, 1.2), direction(&mut rng));
    for _ in 0..20_000 {
        let hit = world.closest(&ray).expect("the room is closed");
        let (surface, point) = (world.surface(&hit).expect("it was met"), world.point(&hit).expect("it was met"));
        assert!(ray.except[0] != Some(surface), "left and met the same wall");
        assert!(hit.front, "a room is seen from within");
        // Away from the wall, down to grazing by a hundredth of a degree.
        let normal = groups.planes[surface.group as usize].normal;
        let along = direction(&mut rng);
        let along = (along - normal * along.dot(normal)).normalize();
        ray = Ray::new(point, along + normal * 10f64.powf(rng.random_range(-4.0..1.0))).leaving(surface, normal);
    }
}

/// F32 hit point as path vertex: f32 puts it 5.8 um beside a wall 12 m away, 0.015 rad of phase a bounce. The
/// point that is given lies on the triangle to 1e-14 m, and the exact distance ends on its plane.
#[test]
fn a_point_that_was_met_lies_on_its_triangle_in_f64() {
    let world = world(vec![(corridor(3), Build::Static), (walker().mesh_at(2.0), Build::Moving)]);
    let mut rng = generator(10, Purpose::Build, [0, 0]);
    for _ in 0..20_000 {
        let ray = Ray::new(DVec3::new(rng.random_range(0.1..11.9), 0.3, 1.1), direction(&mut rng));
        let hit = world.closest(&ray).expect("the room is closed");
        let mesh = world.bodies()[hit.body as usize].mesh();
        let [corner, ..] = mesh.corners(hit.triangle as usize).expect("it was met");
        let normal = mesh.area_vector(hit.triangle as usize).normalize();
        let point = world.point(&hit).expect("it was met");
        assert!((point - corner).dot(normal).abs() < 1e-14, "{}", (point - corner).dot(normal));
        let across = normal.dot(ray.direction).abs();
        let (distance, weights) = world.exact(&ray, &hit).expect("it was met");
        assert!((ray.at(distance) - corner).dot(normal).abs() < 1e-13);
        assert!((distance - hit.distance_m).abs() * across < 5e-6);
        assert!((weights.iter().sum::<f64>() - 1.0).abs() < 1e-9);
        assert!((point - ray.at(distance)).length() * across < 1e-5, "beside the ray by what f32 loses");
    }
}

/// Between two surfaces nothing is in the way but what is between: not the surfaces themselves, nor their edges.
#[test]
fn neither_end_blocks_a_way() {
    let mesh = corridor(1);
    let groups = planes(&mesh, 1e-6).of_triangle;
    let plate = Mesh {
        vertices: vec![DVec3::new(6.0, 0.5, 0.5), DVec3::new(6.0, 1.5, 0.5), DVec3::new(6.0, 1.0, 1.5)],
        triangles: vec![[0, 1, 2]],
    };
    let room = Body::with_groups(mesh, groups, Build::Static).expect("a good mesh");
    let world = World::new(vec![room, Body::new(plate, Build::Moving).expect("a good mesh")]).expect("a small world");
    let mut rng = generator(7, Purpose::Build, [0, 0]);
    let mut blocked = 0;
    for _ in 0..20_000 {
        let (y, z) = (rng.random_range(0.01..1.99), rng.random_range(0.01..2.49));
        let from = Ray::new(DVec3::new(6.5, y, z), -DVec3::X);
        let to = Ray::new(DVec3::new(5.5, rng.random_range(0.01..1.99), rng.random_range(0.01..2.49)), DVec3::X);
        let Some([end, begin]) = [to, from]
            .map(|r| {
                let away = Ray::new(r.origin, -r.direction);
                world.closest(&away).and_then(|h| Some((world.point(&h)?, world.surface(&h)?, away.direction)))
            })
            .into_iter()
            .collect::<Option<Vec<_>>>()
            .and_then(|v| <[_; 2]>::try_from(v).ok())
        else {
            panic!("the room is closed");
        };
        let way = Ray::between(begin.0, end.0).leaving(begin.1, begin.2).reaching(end.1);
        let crossing = way.at((begin.0.x - 6.0) / (begin.0.x - end.0.x) * way.length_m);
        let (y, z) = (crossing.y - 0.5, crossing.z - 0.5);
        let margin = z.min(2.0 * y - z).min(2.0 - 2.0 * y - z);
        if margin.abs() > 1e-4 {
            assert_eq!(world.blocked(&way), margin > 0.0, "through {crossing}");
            blocked += u32::from(margin > 0.0);
        }
    }
    assert!(blocked > 500);
}

/// Rays along axes, in the planes of edges, and with directions of zero and of denormal components.
#[test]
fn rays_along_axes_and_in_planes_are_met() {
    let mesh = Mesh {
        vertices: (0..8).map(|i| DVec3::new(f64::from(i & 1), f64::from(i >> 1 & 1), f64::from(i >> 2))).collect(),
        triangles: [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]
            .into_iter()
            .flat_map(|[a, b, c, d]| [[a, b, c], [a, c, d]])
            .collect(),
    };
    for build in [Build::Moving, Build::Static] {
        let world = world(vec![(mesh.clone(), build)]);
        for tiny in [0.0, 1e-40, -1e-40, 1e-9, -1e-9] {
            for aim in [DVec3::splat(0.5), DVec3::new(0.5, 0.25, 0.25), DVec3::new(0.5, 0.0, 0.0), DVec3::splat(0.0)] {
                for axis in DVec3::AXES {
                    for sign in [1.0, -1.0] {
                        let towards = axis * sign + DVec3::splat(tiny);
                        let ray = Ray::new(aim - towards * 3.0, towards);
                        let crossings = world.crossings(0, &ray);
                        assert_eq!(crossings.entered, crossings.left, "{aim} {towards}");
                        let inside = aim - axis * aim.dot(axis);
                        if inside.to_array().iter().filter(|&&c| c > 0.1).count() == 2 {
                            assert_eq!(crossings.entered, 1, "{aim} {towards}");
                        }
                    }
                }
            }
        }
    }
}

/// From a kilometre away, where f32 has steps of 0.06 mm, a ball of 4 cm triangles is still met where it is, edges and all.
#[test]
fn rays_from_far_away_are_as_sharp_as_from_near() {
    let mesh = ball(0.4, DVec3::ZERO);
    let world = world(vec![(mesh.clone(), Build::Moving)]);
    let mut rng = generator(8, Purpose::Build, [0, 0]);
    for far in [50.0, 1e3, 1e5] {
        for _ in 0..2000 {
            let towards = direction(&mut rng);
            let aim = mesh.vertices[rng.random_range(0..mesh.vertices.len())];
            let ray = Ray::new(aim - towards * far, towards);
            let crossings = world.crossings(0, &ray);
            assert_eq!(crossings.entered, crossings.left);
            if aim.dot(towards) < -0.06 {
                let hit = world.closest(&ray).expect("it is aimed at");
                assert!((hit.distance_m - far).abs() < 1e-5, "{} m instead of {far} m", hit.distance_m);
            }
        }
    }
}

#[test]
fn rays_without_place_or_direction_meet_nothing() {
    let world = world(vec![(corridor(1), Build::Static)]);
    let good = DVec3::new(1.0, 1.0, 1.0);
    for (origin, towards) in [
        (good, DVec3::ZERO),
        (good, DVec3::new(f64::NAN, 0.0, 1.0)),
        (DVec3::new(f64::INFINITY, 0.0, 0.0), DVec3::X),
        (DVec3::splat(f64::NAN), DVec3::X),
        (DVec3::splat(1e300), DVec3::X),
    ] {
        let ray = Ray { direction: towards, ..Ray::new(origin, DVec3::X) };
        assert_eq!(world.closest(&ray), None);
        assert!(!world.blocked(&ray));
        assert_eq!(world.crossings(0, &ray), Crossings::default());
    }
    let nothing = World::new(Vec::new()).expect("nothing is small");
    assert_eq!(nothing.closest(&Ray::new(good, DVec3::X)), None);
    let empty = World::new(vec![Body::new(Mesh::default(), Build::Static).expect("nothing is a mesh")]);
    assert_eq!(empty.expect("nothing is small").closest(&Ray::new(good, DVec3::X)), None);
}

#[test]
fn damaged_meshes_are_refused_and_leave_a_body_as_it_was() {
    let bad = Mesh { vertices: vec![DVec3::ZERO; 3], triangles: vec![[0, 1, 3]] };
    assert!(matches!(Body::new(bad, Build::Moving), Err(BodyError::Mesh(_))));
    let mut world = world(vec![(ball(0.4, DVec3::ZERO), Build::Moving)]);
    let ray = Ray::new(DVec3::X * 3.0, -DVec3::X);
    let before = world.closest(&ray);
    let mut vertices = world.bodies()[0].mesh().vertices.clone();
    vertices[5].y = f64::NAN;
    assert!(world.refit(0, &vertices).is_err());
    assert!(matches!(world.refit(0, &vertices[1..]), Err(BodyError::OtherMesh { .. })));
    assert!(matches!(world.refit(1, &vertices), Err(BodyError::NoSuchBody { body: 1, bodies: 1 })));
    assert_eq!(world.closest(&ray), before);
}

/// A body grown by refitting beyond the size it was built for is met as well as before.
#[test]
fn a_body_may_move_far_and_grow() {
    let mesh = ball(0.4, DVec3::ZERO);
    let mut world = world(vec![(mesh.clone(), Build::Moving)]);
    for (scale, shift) in [(1.0, DVec3::new(80.0, -40.0, 3.0)), (30.0, DVec3::ZERO), (0.1, DVec3::splat(2.0))] {
        let turn = DMat3::from_rotation_z(0.7);
        let vertices: Vec<DVec3> = mesh.vertices.iter().map(|v| turn * *v * scale + shift).collect();
        world.refit(0, &vertices).expect("the same mesh");
        let mut rng = generator(9, Purpose::Build, [0, 0]);
        for _ in 0..5000 {
            let aim = vertices[rng.random_range(0..vertices.len())];
            let towards = direction(&mut rng);
            let crossings = world.crossings(0, &Ray::new(aim - towards * 3.0 * scale, towards));
            assert_eq!(crossings.entered, crossings.left, "{scale} {shift}");
            let inwards = (aim - shift).normalize().dot(towards) < -0.1;
            assert!(crossings.entered == 1 || !inwards, "{scale} {shift}");
        }
    }
}
