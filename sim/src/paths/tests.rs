//! Tests of paths against known results: the lattice of a box, corridors calculated by hand, and brute-force sequences.

use std::sync::Arc;

use glam::{DMat3, DVec2, DVec3};
use num_complex::Complex64;
use rand::{Rng, SeedableRng};
use rand_xoshiro::Xoshiro256PlusPlus;

use super::exhaustive::all_sequences;
use super::rooms::{extruded, l_shape, sheet, slab, star};
use super::{Environment, Facet, ImagePaths, LaunchOptions};
use crate::diffraction::half_plane;
use crate::em::image::{BoxRoom, Element, Wall, images};
use crate::em::pattern::Pattern;
use crate::geometry::polygon::encloses;

/// Wavenumber at 60 GHz, 1/m.
const K: f64 = 1_257.507_013_171_009;

fn isotropic(position: DVec3) -> Element {
    Element { position, polarisation: DVec3::Z, radar_from_world: DMat3::IDENTITY, pattern: Pattern::isotropic() }
}

fn environment(facets: Vec<Facet>) -> Arc<Environment> {
    Arc::new(Environment::new(facets, K).expect("facets"))
}

/// Largest magnitude of the field of an image by which a path of this length arrives.
fn field_by_length(paths: &ImagePaths, antenna: DVec3, point: DVec3, length_m: f64) -> f64 {
    let illumination = |i: usize| paths.illuminate(&isotropic(antenna), i, point);
    let has_length = |i: &usize| (illumination(*i).distance_m - length_m).abs() < 1e-9;
    (0..paths.images().len()).filter(has_length).map(|i| illumination(i).field.magnitude()).fold(0.0, f64::max)
}

#[test]
fn a_box_of_facets_has_the_lattice_of_images_and_its_fields() {
    let walls = [slab(0), slab(1), slab(2), Wall::Conductor, slab(1), slab(0)];
    let room = BoxRoom::new(DVec3::new(5.1, 3.7, 2.6), walls, K, false);
    let mut rng = Xoshiro256PlusPlus::seed_from_u64(11);
    let antenna = Element {
        position: DVec3::new(0.4, 1.9, 1.7),
        polarisation: DVec3::new(0.1, 0.3, 0.9).normalize(),
        radar_from_world: DMat3::from_rotation_z(0.3) * DMat3::from_rotation_y(0.2),
        pattern: Pattern::new(1.0, 1.4, -20.0),
    };
    let paths = ImagePaths::discover(environment(Facet::of_box(&room)), antenna.position, &LaunchOptions::default());
    let lattice = images(3);
    assert_eq!(paths.images().len(), lattice.len(), "{:?}", paths.report());
    // Another element beside the one from which rays were launched has images of its own.
    let beside = Element { position: antenna.position + DVec3::new(0.0, 0.0031, -0.002), ..antenna };
    for index in lattice {
        let position = room.image_position(index, antenna.position);
        let found = paths.images().iter().position(|image| image.position.distance(position) < 1e-9);
        let found = found.unwrap_or_else(|| panic!("no image {index:?}"));
        for _ in 0..20 {
            let fraction = DVec3::from_array(std::array::from_fn(|_| rng.random_range(0.02..0.98)));
            let point = fraction * room.size_m;
            for element in [&antenna, &beside] {
                let (ours, known) = (paths.illuminate(element, found, point), room.illuminate(element, index, point));
                assert!(ours.source.distance(known.source) < 1e-9 && (ours.distance_m - known.distance_m).abs() < 1e-9);
                let error = (ours.field.re - known.field.re).length() + (ours.field.im - known.field.im).length();
                assert!(error < 1e-9 * known.field.magnitude().max(1e-3), "{index:?} {point}: {error:e}");
                let receiver = Element { position: point, ..antenna };
                let (a, b) = (ours.received(&receiver, K), known.received(&receiver, K));
                assert!((a - b).norm() < 1e-9 * b.norm() + 1e-15);
            }
            let (ours, known) =
                (paths.polyline(found, antenna.position, point), room.polyline(index, antenna.position, point));
            assert_eq!(ours.len(), known.len());
            assert!(ours.iter().zip(&known).all(|(p, q)| p.distance(*q) < 1e-8), "{ours:?} {known:?}");
        }
    }
}

/// A corridor that turns left: 8 m by 2 m along x, then 2 m by 8 m along y; the inner corner at (6, 2).
fn l_corridor() -> Vec<Facet> {
    let outline = [[0.0, 0.0], [8.0, 0.0], [8.0, 8.0], [6.0, 8.0], [6.0, 2.0], [0.0, 2.0]].map(DVec2::from_array);
    extruded(&outline, 3.0)
}

/// A plate in the open with nothing behind it: the rays launched in all directions may all miss it.
#[test]
fn a_small_plate_in_the_open_is_found_wherever_it_stands() {
    let mut rng = Xoshiro256PlusPlus::seed_from_u64(7);
    for _ in 0..60 {
        let towards = DVec3::from_array(std::array::from_fn(|_| rng.random_range(-1.0..1.0))).normalize_or(DVec3::X);
        let (distance_m, half_m) = (rng.random_range(0.5..8.0), rng.random_range(0.01..0.1));
        let across = half_m * towards.any_orthonormal_vector();
        let (middle, up) = (distance_m * towards, towards.cross(across));
        let corners = [across + up, up - across, -across - up, across - up].map(|offset| middle + offset);
        let facing = |corners: &[DVec3]| (corners[1] - corners[0]).cross(corners[2] - corners[1]).dot(towards) < 0.0;
        let mut corners = corners.to_vec();
        if !facing(&corners) {
            corners.reverse();
        }
        let plate = environment(vec![Facet::new(corners, Wall::Conductor)]);
        let paths = ImagePaths::discover(plate, DVec3::ZERO, &LaunchOptions::default());
        assert_eq!(paths.images().len(), 2, "{half_m} m at {middle}");
        assert!(paths.images()[1].position.distance(2.0 * middle) < 1e-9);
        assert!(
            field_by_length(&paths, DVec3::ZERO, 0.1 * towards, 2.0 * distance_m - 0.1) > 0.0,
            "{half_m} m at {middle}"
        );
    }
}

#[test]
fn around_a_corner_only_reflected_paths_arrive() {
    let antenna = DVec3::new(1.0, 0.3, 1.5);
    let paths = ImagePaths::discover(environment(l_corridor()), antenna, &LaunchOptions::default());
    assert_eq!(paths.environment().diffracting_edges().len(), 1);
    let point = DVec3::new(7.0, 2.7, 1.5);
    // The straight segment passes 28 cm behind the corner.
    let straight = paths.illuminate(&isotropic(antenna), 0, point);
    assert!(straight.field.magnitude() < 10f64.powf(-30.0 / 20.0));
    // One path is by the wall x = 8, with the image of the antenna at x = 15; the other is by that wall and the wall y
    // = 0.
    for (length_m, reflections) in [(8f64.hypot(2.4), 1), (8f64.hypot(3.0), 2)] {
        let field = field_by_length(&paths, antenna, point, length_m);
        assert!(field > 10f64.powf(-15.0 * f64::from(reflections) / 20.0), "{length_m} m: {field}");
    }
    // Three metres into the other arm neither arrives.
    let far = DVec3::new(7.0, 5.0, 1.5);
    assert_eq!(field_by_length(&paths, antenna, far, 8f64.hypot(4.7)), 0.0);
}

#[test]
fn the_field_beside_a_corner_is_that_of_a_half_plane() {
    let antenna = DVec3::new(1.0, 0.3, 1.5);
    let paths = ImagePaths::discover(environment(l_corridor()), antenna, &LaunchOptions::default());
    let wavelength_m = std::f64::consts::TAU / K;
    let mut last: Option<f64> = None;
    for step in -40..=40 {
        // The straight segment to (7, 2.34) just touches the corner.
        let point = DVec3::new(7.0, 2.34 - 0.002 * f64::from(step), 1.5);
        let along = DVec2::new(6.0, point.y - 0.3);
        let corner = DVec2::new(5.0, 1.7);
        let clearance_m = along.perp_dot(corner) / along.length();
        let d1 = along.dot(corner) / along.length();
        let d2 = along.length() - d1;
        let nu = clearance_m * (2.0 * (d1 + d2) / (wavelength_m * d1 * d2)).sqrt();
        let field = paths.illuminate(&isotropic(antenna), 0, point).field;
        let got = Complex64::new(field.re.z, field.im.z);
        if nu.abs() < 2.7 {
            assert!((got - half_plane(nu)).norm() < 0.01, "{nu}: {got} {}", half_plane(nu));
        }
        assert!(last.is_none_or(|last| (got.norm() - last).abs() < 0.12), "a jump at {nu}");
        last = Some(got.norm());
    }
}

/// Edges that are left out for a part of the field change it by no more than that part, on either side of a corner.
#[test]
fn edges_that_are_left_out_change_little() {
    let antenna = DVec3::new(1.0, 0.3, 1.5);
    let [all, some @ ..] = [0.0, 0.059, 0.122].map(|part| {
        let environment = Environment::new(l_corridor(), K).expect("facets").with_least_part(part);
        (part, ImagePaths::discover(Arc::new(environment), antenna, &LaunchOptions::default()))
    });
    let (mut most, mut changed) = (0.0f64, 0);
    for step in -150..=150 {
        let point = DVec3::new(7.0, 2.34 - 0.004 * f64::from(step), 1.5);
        let field = |paths: &ImagePaths| {
            let field = paths.illuminate(&isotropic(antenna), 0, point).field;
            Complex64::new(field.re.z, field.im.z)
        };
        for (part, paths) in &some {
            let change = (field(paths) - field(&all.1)).norm();
            assert!(change <= *part, "{change} for {part} at {point}");
            most = most.max(change);
            changed += usize::from(change > 0.0);
        }
    }
    assert!(most > 0.05 && changed > 50, "{most} {changed}");
}

/// Level mirror from one x to another.
fn mirror(x0: f64, x1: f64, wall: Wall) -> Facet {
    let corners = [[x0, -3.0], [x1, -3.0], [x1, 3.0], [x0, 3.0]].map(|[x, y]| DVec3::new(x, y, 0.0));
    Facet::new(corners.to_vec(), wall)
}

/// Field at (x, 0), along the polarisation y of an antenna at (-1, 0), by level mirrors 2 m below both.
fn mirrored(facets: Vec<Facet>, x: f64) -> Complex64 {
    let antenna = Element { polarisation: DVec3::Y, ..isotropic(DVec3::new(-1.0, 0.0, 2.0)) };
    let sequences = (0..facets.len() as u32).map(|facet| vec![facet]);
    let paths = ImagePaths::with_sequences(environment(facets), antenna.position, sequences);
    assert_eq!(paths.images().len(), 2);
    let field = paths.illuminate(&antenna, 1, DVec3::new(x, 0.0, 2.0)).field;
    Complex64::new(field.re.y, field.im.y)
}

/// A finite mirror fades at its edge: half the field remains where the point of reflection lies on the edge.
#[test]
fn a_mirror_fades_at_its_edge_and_not_at_a_seam() {
    let mirror = |x0: f64, x1: f64| mirror(x0, x1, Wall::Conductor);
    let field = |facets: Vec<Facet>, x: f64| mirrored(facets, x).norm();
    // The point of reflection lies halfway.
    let whole = |x: f64| field(vec![mirror(-4.0, 6.0)], x);
    for (x, part) in [(1.0, 0.5), (0.2, 1.0), (2.4, 0.0)] {
        let got = field(vec![mirror(-4.0, 0.0)], x) / whole(x);
        assert!((got - part).abs() < 0.06, "{x}: {got}");
    }
    for x in [0.8, 0.9, 0.999, 1.0, 1.001, 1.2] {
        let split = field(vec![mirror(-4.0, 0.0), mirror(0.0, 6.0)], x);
        assert!((split / whole(x) - 1.0).abs() < 1e-9, "{x}: {split} {}", whole(x));
    }
    // Slot of 4 m in a mirror.
    assert!(field(vec![mirror(-4.0, -2.0), mirror(2.0, 6.0)], 1.0) < 0.06 * whole(1.0));
}

/// Parts of a field on the low and on the high side of a seam, and the normalised clearance. The path crosses the plane
/// of the seam halfway, `offset_m` to its high side, and goes 4 m across that plane and `along_m` along it.
fn on_either_side(offset_m: f64, along_m: f64) -> (f64, [Complex64; 2]) {
    let (wavelength_m, length_m) = (std::f64::consts::TAU / K, 4f64.hypot(along_m));
    let (sine, cosine) = (along_m / length_m, 4.0 / length_m);
    let (clearance_m, d1) = (offset_m * cosine, 0.5 * length_m - offset_m * sine);
    let d2 = length_m - d1;
    let nu = clearance_m * (2.0 * (d1 + d2) / (wavelength_m * d1 * d2)).sqrt();
    (nu, [half_plane(-nu), half_plane(nu)])
}

/// Where the material of a mirror changes, the field changes from that of one wall to that of the other as fields
/// beside half-planes do. Regression test: it had a step there.
#[test]
fn a_mirror_of_two_walls_has_no_step_at_their_seam() {
    let walls = [Wall::Conductor, slab(0)];
    let mut compared = 0;
    for step in -60..=60 {
        // The point of reflection lies halfway, and on the seam for x = 1.
        let x = 1.0 + 0.01 * f64::from(step);
        let (nu, parts) = on_either_side(0.5 * (x - 1.0), x + 1.0);
        if nu.abs() > 2.7 {
            continue;
        }
        let [low, high] = walls.map(|wall| mirrored(vec![mirror(-4.0, 6.0, wall)], x));
        let both = mirrored(vec![mirror(-4.0, 0.0, walls[0]), mirror(0.0, 6.0, walls[1])], x);
        let expected = low * parts[0] + high * parts[1];
        assert!((both - expected).norm() < 0.02, "{nu}: {both} {expected}");
        compared += 1;
    }
    assert!(compared > 30, "{compared}");
}

/// Direct field at (2, y) of an antenna at (-2, 0.1), 1.5 m over the floor, past walls that transmit.
fn transmitted(facets: Vec<Facet>, y: f64) -> Complex64 {
    let antenna = isotropic(DVec3::new(-2.0, 0.1, 1.5));
    let environment = Environment::new(facets, K).expect("facets").with_transmission(true);
    let paths = ImagePaths::with_sequences(Arc::new(environment), antenna.position, Vec::<Vec<u32>>::new());
    let field = paths.illuminate(&antenna, 0, DVec3::new(2.0, y, 1.5)).field;
    Complex64::new(field.re.z, field.im.z)
}

fn glass() -> Wall {
    Wall::Slab { permittivity: Complex64::new(6.31, -0.26), thickness_m: 0.006 }
}

/// Behind a pane beside metal, and behind two panes, the field is the sum of what each transmits, as beside
/// half-planes. Regression test: behind metal it was zero right up to the pane.
#[test]
fn a_wall_of_two_materials_transmits_without_a_step() {
    let part = |from: f64, to: f64, wall: Wall| sheet(DVec2::new(0.0, from), DVec2::new(0.0, to), 3.0, wall);
    for walls in [[Wall::Conductor, glass()], [glass(), Wall::Conductor], [slab(0), glass()], [glass(), slab(0)]] {
        let mut compared = 0;
        for step in -100..=60 {
            let y = 0.005 * f64::from(step);
            let (nu, parts) = on_either_side(0.5 * (y + 0.1), y - 0.1);
            if nu.abs() > 2.7 {
                continue;
            }
            let [low, high] = walls.map(|wall| transmitted(part(-4.0, 4.0, wall).to_vec(), y));
            let both = transmitted([part(-4.0, 0.0, walls[0]), part(0.0, 4.0, walls[1])].concat(), y);
            let expected = low * parts[0] + high * parts[1];
            assert!((both - expected).norm() < 0.02, "{walls:?} {nu}: {both} {expected}");
            compared += 1;
        }
        assert!(compared > 50, "{compared}");
    }
}

/// Asserts that a field has no step along a line, at points a millimetre apart, and returns its extremes.
fn assert_no_step(what: &str, from_y: f64, to_y: f64, field: impl Fn(f64) -> Complex64) -> [f64; 2] {
    let count = ((to_y - from_y) / 0.001).round() as u32;
    let mut extremes = [f64::INFINITY, 0.0];
    let mut last: Option<Complex64> = None;
    for i in 0..=count {
        let y = from_y + 0.001 * f64::from(i);
        let now = field(y);
        assert!(last.is_none_or(|last| (now - last).norm() < 0.03), "{what}: a step at {y}: {last:?} {now}");
        extremes = [extremes[0].min(now.norm()), extremes[1].max(now.norm())];
        last = Some(now);
    }
    extremes
}

/// An open door leaf points towards the antenna, on a wall of another material: there is no step at the hinge.
#[test]
fn a_hinge_gives_no_step() {
    let wood = Wall::Slab { permittivity: Complex64::new(1.99, -0.11), thickness_m: 0.04 };
    let hinge = DVec2::ZERO;
    let wall = sheet(DVec2::new(0.0, -4.0), hinge, 3.0, slab(0));
    let leaf = sheet(hinge, DVec2::new(-0.64, 0.64), 3.0, wood);
    // In a floor plan a hinge is a wedge of the air behind it.
    let all = [wall, leaf].concat().into_iter().map(|facet| Facet { diffracting_sides: vec![true; 4], ..facet });
    let facets: Vec<Facet> = all.collect();
    let [least, most] = assert_no_step("hinge", -0.9, 0.9, |y| transmitted(facets.clone(), y));
    assert!(least < 0.25 && most > 0.4, "{least} {most}");
}

/// Beside a box that transmits, such as a wooden cupboard, behind its side and behind its back there are no steps.
/// Regression test: behind a corner the field had a step of what the side transmits.
///
/// In the plane of the side, y = 0.3, a step remains. The field that passes the front corner grazes the side there and
/// passes the back corner, and successive edges are not solved together.
#[test]
fn a_box_that_transmits_gives_no_step() {
    // Clockwise, so that its faces look outwards.
    let outline = [[-0.25, -0.3], [-0.25, 0.3], [0.25, 0.3], [0.25, -0.3]].map(DVec2::from_array);
    let facets: Vec<Facet> =
        extruded(&outline, 3.0).into_iter().map(|facet| Facet { wall: slab(0), ..facet }).collect();
    let at = |y: f64| transmitted(facets.clone(), y);
    let behind = assert_no_step("behind the back", 0.1, 0.299, at);
    let beside = assert_no_step("behind the side and beside the box", 0.301, 1.5, at);
    assert!(behind[0] < 0.4 && beside[1] > 1.0, "{behind:?} {beside:?}");
    assert!((at(0.299) - at(0.301)).norm() < 0.15);
}

/// A thin metal partition shadows the region behind it, and an edge near the path gives no step.
#[test]
fn a_partition_shadows_and_mirrors() {
    let outline = [[-4.0, -2.0], [4.0, -2.0], [4.0, 2.0], [-4.0, 2.0]].map(DVec2::from_array);
    let mut facets = extruded(&outline, 2.5);
    facets.extend(sheet(DVec2::new(0.0, 2.0), DVec2::new(0.0, 0.0), 2.5, Wall::Conductor));
    let antenna = DVec3::new(-2.0, 0.6, 1.2);
    let paths = ImagePaths::discover(environment(facets), antenna, &LaunchOptions::default());
    assert_eq!(paths.environment().diffracting_edges().len(), 1);
    let at = |point: DVec3| paths.illuminate(&isotropic(antenna), 0, point).field.magnitude();
    assert_eq!(at(DVec3::new(2.0, 1.2, 1.2)), 0.0);
    assert!((at(DVec3::new(2.0, -1.6, 1.2)) - 1.0).abs() < 0.1);
    assert!((at(DVec3::new(2.0, -0.6, 1.2)) - 0.5).abs() < 0.01);
    // The mirror image at x = 2 is seen before the partition.
    let mirrored = field_by_length(&paths, antenna, DVec3::new(-1.0, 1.0, 1.2), 3f64.hypot(0.4));
    assert!((mirrored - 1.0).abs() < 1e-6, "{mirrored}");
}

#[test]
fn the_same_is_found_on_any_number_of_threads() {
    let facets = environment(l_corridor());
    let antenna = DVec3::new(1.0, 0.3, 1.5);
    let found = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
        pool.install(|| ImagePaths::discover(Arc::clone(&facets), antenna, &LaunchOptions::default()))
    };
    let (one, three) = (found(1), found(3));
    assert_eq!(one.report(), three.report());
    assert_eq!(one.images(), three.images());
}

/// Power at a point by all images.
fn power(paths: &ImagePaths, antenna: &Element, point: DVec3) -> f64 {
    let by_image = |i: usize| {
        let arrival = paths.illuminate(antenna, i, point);
        (arrival.field.magnitude() / arrival.distance_m).powi(2)
    };
    (0..paths.images().len()).map(by_image).sum()
}

/// Power that rays miss in 200 rooms (stars, L shapes, and both with a partition): that of all sequences of up to three
/// facets that they do not find.
#[test]
fn rays_miss_less_than_40_db_of_the_power() {
    let options = LaunchOptions { max_order: 3, refinements: 3, max_rays: 40_000 };
    let (mut all, mut missed, mut worst) = (0.0, 0.0, 0.0f64);
    for seed in 0..200 {
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
        let outline = if seed % 3 == 0 { l_shape(&mut rng) } else { star(&mut rng) };
        let height_m = rng.random_range(2.3..3.2);
        let mut facets = extruded(&outline, height_m);
        if seed % 2 == 0 {
            // The partition runs from near the middle halfway to a corner, so that it crosses no wall.
            let from = DVec2::new(0.35, -0.25);
            facets.extend(sheet(from, from.lerp(outline[0], 0.5), height_m, slab(2)));
        }
        let facets = environment(facets);
        let antenna = isotropic(DVec3::new(rng.random_range(-0.2..0.2), rng.random_range(-0.2..0.2), 1.3));
        let paths = ImagePaths::discover(Arc::clone(&facets), antenna.position, &options);
        let found: Vec<&Vec<u32>> = paths.images().iter().flat_map(|image| &image.sequences).collect();
        let missing = all_sequences(&facets, antenna.position, 3).into_iter().filter(|s| !found.contains(&s));
        let missed_paths = ImagePaths::with_sequences(Arc::clone(&facets), antenna.position, missing);
        let (mut found_power, mut missed_power) = (0.0, 0.0);
        for _ in 0..10 {
            let on_plan = DVec2::new(rng.random_range(-5.0..5.0), rng.random_range(-5.0..5.0));
            if !encloses(&outline, on_plan) || on_plan.length() < 0.5 {
                continue;
            }
            let point = on_plan.extend(rng.random_range(0.3..2.0));
            // The first image is the antenna itself, which is among those found.
            let straight = paths.illuminate(&antenna, 0, point);
            missed_power +=
                power(&missed_paths, &antenna, point) - (straight.field.magnitude() / straight.distance_m).powi(2);
            found_power += power(&paths, &antenna, point);
        }
        all += found_power + missed_power;
        missed += missed_power;
        worst = worst.max(missed_power / (found_power + missed_power).max(1e-12));
    }
    assert!(missed < 1e-4 * all, "missed {:.1} dB, in the worst room {:.1} dB", db(missed / all), db(worst));
}

fn db(ratio: f64) -> f64 {
    10.0 * ratio.max(1e-30).log10()
}

#[test]
fn every_sequence_of_a_box_makes_the_lattice() {
    let room = BoxRoom::new(DVec3::new(4.0, 3.0, 2.5), [slab(0); 6], K, false);
    let (facets, origin) = (environment(Facet::of_box(&room)), DVec3::new(1.1, 1.2, 1.3));
    let paths = ImagePaths::with_sequences(Arc::clone(&facets), origin, all_sequences(&facets, origin, 3));
    assert_eq!(paths.images().len(), images(3).len());
}
