//! The rows of the design study's table of numerically hard cases that involve several parts. The others are tested
//! beside the code, in modules of the same name:
//!
//! | row | where |
//! |---|---|
//! | facet integral near specular | `em/triangle.rs`, `tests/solver.rs` |
//! | f32 kernel, f32 path length, dynamic range | here |
//! | f32 hit point, self-hit, shared edges, coplanar faces | `rays/hard_cases.rs` |
//! | visibility flips | `paths/tests.rs` |
//! | overlapping faces | `geometry/lint.rs` |
//! | degenerate triangles | `geometry/weld.rs`, `tests/solver.rs` |
//! | grazing, total internal reflection, thin slab | `em/fresnel.rs`, `tests/references.rs`, `tests/solver.rs` |
//! | caustic, PO shadow line | `tests/solver.rs` |
//! | dihedral | `validation/images.rs`, `tests/solver.rs` |
//! | R to 0 | `tests/solver.rs`, `tests/physics.rs` |
//! | threads | `tests/stream.rs` |

use std::f64::consts::TAU;

use glam::DVec3;
use num_complex::Complex;
use radome_sim::em::image::{BoxRoom, Wall};
use radome_sim::geometry::Mesh;
use radome_sim::random::{Purpose, generator};
use radome_sim::rays::{Ray, World};
use radome_sim::synthesis::{SynthesisScratch, Synthesiser, Tone, exact_chirp};
use rand::Rng;

use crate::common::WAVENUMBER;
use crate::surfaces::rooms::{faces, triangles};

/// Rms error of the fast synthesis relative to the rms signal, dB.
fn error_dbc(samples: usize, tones: &[Tone]) -> f64 {
    let synthesiser = Synthesiser::new(samples);
    let mut grid = synthesiser.grid();
    tones.iter().for_each(|tone| synthesiser.add(tone, &mut grid));
    let mut out = vec![0f32; samples];
    synthesiser.transform(&grid, &mut out, &mut SynthesisScratch::default());
    let exact = exact_chirp(tones, samples);
    let error: f64 = out.iter().zip(&exact).map(|(a, b)| (f64::from(*a) - b).powi(2)).sum();
    10.0 * (error / exact.iter().map(|v| v * v).sum::<f64>()).log10()
}

fn tones(count: usize, range_db: f64, cycles: f64) -> Vec<Tone> {
    let mut rng = generator(3, Purpose::Build, [7, 0]);
    let mut tone = || {
        let strength = 10f64.powf(-0.05 * rng.random_range(0.0..=range_db)) as f32;
        let (sine, cosine) = rng.random_range(0.0..TAU as f32).sin_cos();
        Tone {
            phase_cycles: rng.random_range(-cycles..cycles),
            cycles_per_sample: rng.random_range(0.01..0.49),
            amplitude: Complex::new(cosine, sine) * strength,
        }
    };
    (0..count).map(|_| tone()).collect()
}

/// f32 kernel: its phases are reduced in f64, so it has the same accuracy at 5e3 radians and at a million times that.
/// Phases reduced in f32 would be wrong by 1e-4 and miss that bound.
#[test]
fn f32_phasors_of_long_ways_keep_their_digits() {
    for cycles in [1.0, 800.0, 1e9] {
        let tones = tones(300, 20.0, cycles);
        assert!(error_dbc(256, &tones) < -90.0, "{cycles} cycles: {} dBc", error_dbc(256, &tones));
    }
    let round = |tone: &Tone| Tone { phase_cycles: f64::from(tone.phase_cycles as f32), ..*tone };
    let (long, rounded): (Vec<Tone>, Vec<Tone>) = tones(300, 20.0, 800.0).iter().map(|t| (*t, round(t))).unzip();
    let (a, b) = (exact_chirp(&long, 256), exact_chirp(&rounded, 256));
    let lost: f64 = a.iter().zip(&b).map(|(a, b)| (a - b).powi(2)).sum();
    assert!(10.0 * (lost / a.iter().map(|v| v * v).sum::<f64>()).log10() > -85.0, "what is avoided is there");
}

/// Dynamic range: the sum of a million phasors over 120 dB agrees with their sum in f64 to -90 dB of it.
#[test]
fn a_million_phasors_over_120_db_add_up() {
    let error = error_dbc(32, &tones(1_000_000, 120.0, 800.0));
    assert!(error < -90.0, "{error} dBc");
}

/// f32 path length: a ray's own distance, found in f32, is wrong by up to milliradians. The length in f64 from the
/// surfaces that the ray met equals the image's to 1e-11 rad, for paths of 10 m and of 20 m.
#[test]
fn lengths_from_what_was_met_are_exact() {
    for (size_m, bound_rad) in [(DVec3::new(5.0, 2.0, 2.5), 1e-11), (DVec3::new(9.5, 6.0, 3.0), 1e-11)] {
        let room = BoxRoom::new(size_m, [Wall::Conductor; 6], WAVENUMBER, false);
        let mesh = box_mesh(size_m);
        let groups: Vec<u32> = (0..mesh.triangles.len() as u32).collect();
        let world = World::new(mesh.clone(), &groups).expect("a good mesh");
        let mut rng = generator(9, Purpose::Build, [0, 0]);
        let (mut of_ray, mut of_ids): (f64, f64) = (0.0, 0.0);
        for _ in 0..5000 {
            let mut place = || DVec3::new(rng.random(), rng.random(), rng.random()) * (size_m - 0.1) + 0.05;
            let (from, to) = (place(), place());
            for index in [[-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1]] {
                let way = room.polyline(index, from, to);
                let ray = Ray::new(from, way[1] - from);
                let hit = world.closest(&ray).expect("the room is closed");
                let [corner, ..] = mesh.corners(hit.triangle as usize).expect("it was met");
                let normal = mesh.area_vector(hit.triangle as usize).normalize();
                let image = from - normal * (2.0 * normal.dot(from - corner));
                let exact = room.image_position(index, from).distance(to);
                of_ids = of_ids.max(WAVENUMBER * (image.distance(to) - exact).abs());
                of_ray = of_ray.max(2.0 * WAVENUMBER * (hit.distance_m - from.distance(way[1])).abs());
            }
        }
        assert!(of_ids < bound_rad, "{size_m}: {of_ids:e} rad");
        assert!(of_ray > 1e-5, "{size_m}: what is avoided is there, {of_ray:e} rad");
    }
}

/// Box of twelve triangles.
fn box_mesh(size_m: DVec3) -> Mesh {
    let corners = triangles(&faces([0.0; 3], size_m.to_array()));
    let vertices = corners.iter().flatten().map(|&corner| DVec3::from_array(corner)).collect();
    Mesh { vertices, triangles: (0..12).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect() }
}
