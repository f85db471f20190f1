//! Rays a second on one thread: `rays [ROUNDS]`, a man of about 14000 triangles walking in a corridor of 12 x 2 x 2.5 m, beside
//! `obvhs` with everything in one structure and its own triangle test, on the same rays in the same run.
#![allow(clippy::print_stdout)]

use std::sync::Arc;
use std::time::{Duration, Instant};

use glam::DVec3;
use obvhs::BvhBuildParams;
use obvhs::cwbvh::builder::build_cwbvh_from_tris;
use obvhs::ray::RayHit;
use obvhs::triangle::Triangle;
use radome_sim::actor::motion::{MotionBuilder, Person};
use radome_sim::actor::skin::EDGE_M;
use radome_sim::actor::walking_mesh::WalkingMesh;
use radome_sim::geometry::Mesh;
use radome_sim::trace::{Body, Build, Hit, Ray, World};

/// Rays of a set: 512 x 512.
const SIDE: usize = 512;
/// Rays timed at once.
const PIECE: usize = 2048;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let rounds = std::env::args().nth(1).map_or(Ok(15), |s| s.parse())?;
    let person = Person::draw(1, [0, 0], 1.75);
    let motion = MotionBuilder::new(person, 0.0, [2.0, 1.0], 0.0).walk_to([9.0, 1.0], 1.2).stay();
    let (walker, made) = timed(|| WalkingMesh::new(Arc::new(motion), EDGE_M));
    let man = walker.mesh_at(2.0);
    println!("man: {} triangles, {} vertices, made in {:.0} ms", man.triangles.len(), man.vertices.len(), ms(made));
    let (room, room_built) = timed(|| Body::new(corridor(), Build::Static));
    let (body, built) = timed(|| Body::new(man.clone(), Build::Moving));
    let mut world = World::new(vec![room?, body?])?;
    let mut posed = Duration::MAX;
    let mut refitted = Duration::MAX;
    for i in 0..20 {
        let (moving, pose) = timed(|| walker.at(1.9 + 0.01 * f64::from(i)));
        let (done, refit) = timed(|| world.refit(1, &moving.vertices));
        done?;
        (posed, refitted) = (posed.min(pose), refitted.min(refit));
    }
    println!(
        "build: room {:.2} ms, man {:.2} ms; a pose: vertices and velocities {:.2} ms, refit {:.2} ms",
        ms(room_built),
        ms(built),
        ms(posed),
        ms(refitted)
    );
    world.refit(1, &man.vertices)?;

    let mut all: Vec<Triangle> = Vec::new();
    for mesh in [&corridor(), &man] {
        let corners = (0..mesh.triangles.len()).filter_map(|t| mesh.corners(t));
        all.extend(corners.map(|[a, b, c]| Triangle { v0: a.as_vec3a(), v1: b.as_vec3a(), v2: c.as_vec3a() }));
    }
    let (peer, peer_built) =
        timed(|| build_cwbvh_from_tris(&all, BvhBuildParams::medium_build(), &mut Duration::default()));
    // In the order of its leaves, as its authors' examples lay them out.
    let leaves: Vec<Triangle> = peer.primitive_indices.iter().filter_map(|&i| all.get(i as usize).copied()).collect();
    println!("peer: obvhs, one structure over all, built in {:.2} ms", ms(peer_built));

    let primary = primary();
    let (mirror, diffuse) = bounces(&world, &primary);
    println!("\n{:<22}{:>10}{:>12}{:>12}{:>10}", "Mray/s, one thread", "radome", "obvhs", "ratio", "on man");
    for (name, rays) in [("primary", &primary), ("mirror bounce", &mirror), ("diffuse bounce", &diffuse)] {
        let (mut our_sum, mut their_sum, mut on_man) = (0.0, 0.0, 0u32);
        let ours = fastest(rays, rounds, |rays| {
            world.closest_each(rays, |_, hit| {
                our_sum += hit.map_or(0.0, |h| h.distance_m);
                on_man += u32::from(hit.is_some_and(|h| h.body == 1));
            });
        });
        let theirs = fastest(rays, rounds, |rays| {
            for ray in rays {
                let (origin, direction) = (ray.origin.as_vec3a(), ray.direction.as_vec3a());
                let ray = obvhs::ray::Ray::new(origin, direction, 1e-4, f32::INFINITY);
                let mut hit = RayHit::none();
                let met = peer.ray_traverse(ray, &mut hit, |ray, leaf| {
                    leaves.get(leaf).map_or(f32::INFINITY, |t| t.intersect(ray))
                });
                their_sum += if met { f64::from(hit.t) } else { 0.0 };
            }
        });
        let traced = (rays.len() * rounds) as f64;
        let rate = |time: Duration| rays.len() as f64 / time.as_secs_f64() / 1e6;
        println!(
            "{name:<22}{:>10.1}{:>12.1}{:>12.2}{:>9.1}%   mean distance {:.4} m, {:.4} m",
            rate(ours),
            rate(theirs),
            rate(ours) / rate(theirs),
            100.0 * f64::from(on_man) / traced,
            our_sum / traced,
            their_sum / traced,
        );
    }
    // Ways from the radar past the man, as shadows are asked for.
    let ways: Vec<Ray> = primary.iter().step_by(997).map(|r| Ray::between(r.origin, r.at(6.0))).collect();
    let mut blocked = 0;
    let (_, time) = timed(|| ways.iter().for_each(|w| blocked += usize::from(world.blocked(w))));
    println!(
        "\n{} ways of 6 m: blocked? {:.0} ns each ({blocked} are)",
        ways.len(),
        1e9 * time.as_secs_f64() / ways.len() as f64
    );
    Ok(())
}

fn timed<T>(work: impl FnOnce() -> T) -> (T, Duration) {
    let begin = Instant::now();
    let result = work();
    (result, begin.elapsed())
}

/// Sum over small pieces of the fastest of some rounds: what the work takes while nobody else has the processor.
fn fastest(rays: &[Ray], rounds: usize, mut work: impl FnMut(&[Ray])) -> Duration {
    let pieces = rays.chunks(PIECE);
    let mut fastest = vec![Duration::MAX; pieces.len()];
    for _ in 0..rounds {
        for (piece, fastest) in rays.chunks(PIECE).zip(&mut fastest) {
            *fastest = timed(|| work(piece)).1.min(*fastest);
        }
    }
    fastest.iter().sum()
}

fn ms(time: Duration) -> f64 {
    time.as_secs_f64() * 1e3
}

/// Twelve triangles that face inwards.
fn corridor() -> Mesh {
    let size = DVec3::new(12.0, 2.0, 2.5);
    let vertices =
        (0..8).map(|i| size * DVec3::new(f64::from(i & 1), f64::from(i >> 1 & 1), f64::from(i >> 2))).collect();
    let quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]];
    let triangles = quads.into_iter().flat_map(|[a, b, c, d]| [[a, b, c], [a, c, d]]).collect();
    Mesh { vertices, triangles }
}

/// From a radar at the corridor's end, 70 x 60 degrees, row by row.
fn primary() -> Vec<Ray> {
    let origin = DVec3::new(0.05, 1.0, 1.2);
    let at = |i: usize, half: f64| ((i as f64 + 0.5) / SIDE as f64 * 2.0 - 1.0) * half.to_radians().tan();
    (0..SIDE * SIDE).map(|i| Ray::new(origin, DVec3::new(1.0, at(i % SIDE, 35.0), at(i / SIDE, 30.0)))).collect()
}

/// The rays after a mirror's and a matt surface's bounce.
fn bounces(world: &World, rays: &[Ray]) -> (Vec<Ray>, Vec<Ray>) {
    let mut state = 1u64;
    let mut random = || {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (state >> 11) as f64 / (1u64 << 53) as f64 * 2.0 - 1.0
    };
    let bounce = |ray: &Ray, hit: Hit| {
        let [a, b, c] = world.bodies().get(hit.body as usize)?.mesh().corners(hit.triangle as usize)?;
        let normal = (b - a).cross(c - a).normalize();
        let normal = if normal.dot(ray.direction) < 0.0 { normal } else { -normal };
        Some((world.point(&hit)?, normal, world.surface(&hit)?))
    };
    let (mut mirror, mut diffuse) = (Vec::new(), Vec::new());
    for ray in rays {
        let Some((point, normal, surface)) = world.closest(ray).and_then(|hit| bounce(ray, hit)) else { continue };
        let reflected = ray.direction - 2.0 * ray.direction.dot(normal) * normal;
        mirror.push(Ray::new(point, reflected).leaving(surface, normal));
        let scattered = normal + DVec3::new(random(), random(), random()).normalize_or_zero() * 0.99;
        diffuse.push(Ray::new(point, scattered).leaving(surface, normal));
    }
    (mirror, diffuse)
}
