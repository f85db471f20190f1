//! The integrators of scenes, compared with independently computed reference values: closed forms, Mie, dense
//! quadrature.

use std::f64::consts::PI;
use std::sync::Arc;

use glam::DVec3;
use num_complex::Complex64;
use radome_dsp::SPEED_OF_LIGHT_M_PER_S;
use radome_sim::em::image::Wall;
use radome_sim::em::triangle;
use radome_sim::geometry::{Mesh, Surface, shape};
use radome_sim::material::SKIN_PERMITTIVITY;
use radome_sim::paths::{Environment, Facet, ImagePaths};
use radome_sim::validation::endpoint::Endpoint;
use radome_sim::validation::facet::{self, Accuracy};
use radome_sim::validation::radar::Radar;
use radome_sim::validation::{Method, Outcome, Outline, Polarisation, Problem, Setup, Target, mie, reference_value};

use crate::common::{self, number, reference, reference_rows, vector};

const SKIN: Wall = Wall::HalfSpace { permittivity: SKIN_PERMITTIVITY };

fn db(sigma_m2: f64) -> f64 {
    10.0 * sigma_m2.log10()
}

fn setup(range_m: Option<f64>, azimuth_deg: f64, elevation_deg: f64, boundary: Wall) -> Setup {
    Setup {
        frequency_hz: 60e9,
        range_m,
        azimuth_rad: azimuth_deg.to_radians(),
        elevation_rad: elevation_deg.to_radians(),
        polarisation: Polarisation::Vertical,
        boundary,
    }
}

fn solve(target: &Target, setup: &Setup, method: Method, edge_m: Option<f64>, tolerance_db: f64) -> Outcome {
    let problem = Problem::new(target, setup, method, edge_m).expect("valid problem");
    problem.solve(tolerance_db).expect("valid tolerance")
}

fn closed_form_db(target: &Target, setup: &Setup) -> f64 {
    db(reference_value(target, setup).expect("a closed form").sigma_m2)
}

/// Regression test: edges of one face attenuated the field on its way to the other face, and both factors were
/// multiplied. Cross-sections of corners were wrong by up to 6 dB.
#[test]
fn image_paths_of_a_corner_have_the_cross_section_of_a_dihedral() {
    let range_m = 3.0;
    for (edge_m, tolerance_db) in [(0.05, 1.0), (0.08, 0.7), (0.12, 0.7), (0.15, 0.7), (0.3, 0.5), (1.0, 0.2)] {
        let half_m = 0.5 * edge_m;
        let face = |corners: [[f64; 3]; 4]| Facet::new(corners.map(DVec3::from_array).to_vec(), Wall::Conductor);
        let faces = vec![
            face([[0.0, 0.0, -half_m], [0.0, 0.0, half_m], [edge_m, 0.0, half_m], [edge_m, 0.0, -half_m]]),
            face([[0.0, 0.0, -half_m], [0.0, edge_m, -half_m], [0.0, edge_m, half_m], [0.0, 0.0, half_m]]),
        ];
        let environment = Environment::new(faces, 2.0 * PI * 60e9 / SPEED_OF_LIGHT_M_PER_S).expect("two faces");
        let antenna = range_m * DVec3::new(1.0, 1.0, 0.0).normalize();
        let paths = ImagePaths::with_sequences(Arc::new(environment), antenna, [vec![0, 1], vec![1, 0]]);
        assert_eq!(paths.images().len(), 2, "both orders make one image");
        let target = Target::Dihedral { width_m: edge_m, height_m: edge_m };
        let of_dihedral = solve(&target, &setup(Some(range_m), 45.0, 0.0, Wall::Conductor), Method::Images, None, 0.1);
        // A path through the common edge, and one beside it.
        for offset_m in [DVec3::ZERO, DVec3::new(-0.003, 0.003, 0.0)] {
            let field =
                paths.illuminate(&common::isotropic(antenna, DVec3::Z), 1, antenna + offset_m).field.magnitude();
            // The echo of a cross-section that is as strong as an image at twice the range.
            let [found, expected] = [PI * range_m * range_m * field * field, of_dihedral.sigma_m2].map(db);
            assert!(
                (found - expected).abs() < tolerance_db,
                "{edge_m} m, {offset_m}: {found} dBsm, expected {expected}"
            );
        }
    }
}

#[test]
fn triangle_integrals_agree_with_25_digit_quadrature() {
    let reference = reference();
    let cases = reference["triangle_integral"]["cases"].as_array().expect("cases");
    assert!(cases.len() >= 12);
    for case in cases {
        let [a, b, c] = [0, 1, 2].map(|i| number(&case["phases"][i]));
        let expected = Complex64::new(number(&case["re"]), number(&case["im"]));
        let error = (triangle::integral(a, b, c) - expected).norm() / 0.5;
        assert!(error < 1e-15, "{case}: {error:e}");
    }
}

#[test]
fn plates_agree_with_the_reference_in_lobes_and_near_nulls() {
    let plate = Target::Plate { width_m: 0.1, height_m: 0.1 };
    for row in reference_rows("plate") {
        let s = setup(None, number(&row["theta_deg"]), 0.0, Wall::Conductor);
        let expected = number(&row["sigma_m2"]);
        for method in [Method::Facets, Method::Images] {
            let found = solve(&plate, &s, method, None, 0.1).sigma_m2;
            assert!((found / expected - 1.0).abs() < 1e-6, "{row} {method:?}: {found}");
        }
        assert!((closed_form_db(&plate, &s) - db(expected)).abs() < 1e-9);
    }
}

#[test]
fn near_field_plates_agree_with_the_reference_within_a_hundredth_of_a_decibel() {
    for row in reference_rows("plate_near_field") {
        let side = number(&row["a_m"]);
        let plate = Target::Plate { width_m: side, height_m: side };
        let s = setup(Some(number(&row["R_m"])), 0.0, 0.0, Wall::Conductor);
        let expected = number(&row["sigma_nf_dBsm"]);
        let outcome = solve(&plate, &s, Method::Facets, None, 0.01);
        let error = db(outcome.sigma_m2) - expected;
        assert!(error.abs() < 0.01, "{row}: {error} dB");
        assert!(outcome.estimate_db.expect("estimate") < 0.01);
        // Quadrature that the program prints beside the result.
        assert!((closed_form_db(&plate, &s) - expected).abs() < 1e-5, "{row}");
    }
}

#[test]
fn a_dihedral_agrees_with_the_reference_in_the_far_and_near_field() {
    let dihedral = Target::Dihedral { width_m: 0.1, height_m: 0.1 };
    let expected = number(&reference()["dihedral"]["dBsm"]);
    for range in [None, Some(100.0), Some(1000.0)] {
        let s = setup(range, 45.0, 0.0, Wall::Conductor);
        let error = db(solve(&dihedral, &s, Method::Images, None, 0.01).sigma_m2) - expected;
        // Sum of all orders: the single bounces off both faces at 45 degrees contribute to it.
        assert!(error.abs() < 0.051, "{range:?}: {error} dB");
    }
    // In the near field wave fronts are curved: 4.9 dB less at 2 m (dense integration of both orders, alone).
    let near = db(solve(&dihedral, &setup(Some(2.0), 45.0, 0.0, Wall::Conductor), Method::Images, None, 0.01).sigma_m2);
    assert!((near - (expected - 4.9)).abs() < 0.3, "{near}");
}

#[test]
fn trihedrals_agree_with_the_reference_at_all_tabulated_angles() {
    for row in reference_rows("trihedral") {
        let s = setup(None, number(&row["az"]), number(&row["el"]), Wall::Conductor);
        for (outline, key) in [(Outline::Triangular, "tri_dBsm"), (Outline::Square, "sq_dBsm")] {
            let target = Target::Trihedral { edge_m: 0.1, outline };
            let expected = number(&row[key]);
            let found = db(solve(&target, &s, Method::Images, None, 0.1).sigma_m2);
            assert!((found - expected).abs() < 0.3, "{row} {outline:?}: {found}");
            // The reference's square apertures are numerical overlaps, good to 0.04 dB.
            assert!((closed_form_db(&target, &s) - expected).abs() < 0.04, "{row} {outline:?}");
        }
    }
}

/// The cavity of Ling, Chou and Lee (1989): rays and physical optics, compared with waveguide modes. Rays ignore
/// diffraction at the rim and along the walls, whose share falls with the square root of the wavelength. It is larger
/// where the electric field is perpendicular to the side walls.
#[test]
fn cavities_agree_with_waveguide_modes() {
    // Ten wavelengths wide and five or ten deep at 60 GHz.
    let error_db = |depth_m: f64, frequency_hz: f64, azimuth_deg: f64, polarisation: Polarisation| {
        let target = Target::Cavity { width_m: 0.05, height_m: 0.05, depth_m };
        let s = Setup { frequency_hz, polarisation, ..setup(None, azimuth_deg, 0.0, Wall::Conductor) };
        db(solve(&target, &s, Method::Images, None, 0.1).sigma_m2) - closed_form_db(&target, &s)
    };
    for depth_m in [0.025, 0.05] {
        for azimuth_deg in [15.0, 20.0, 25.0, 30.0, 35.0, 40.0] {
            let error = |frequency_hz, polarisation| error_db(depth_m, frequency_hz, azimuth_deg, polarisation);
            let vertical = error(60e9, Polarisation::Vertical);
            assert!(vertical.abs() < 1.0, "{depth_m} m, {azimuth_deg} degrees: {vertical}");
            let vertical = error(960e9, Polarisation::Vertical);
            assert!(vertical.abs() < 0.25, "{depth_m} m, {azimuth_deg} degrees: {vertical}");
            let horizontal = [60e9, 960e9].map(|f| error(f, Polarisation::Horizontal));
            assert!(
                horizontal[0].abs() < 2.7 && horizontal[1].abs() < 0.7,
                "{depth_m} m, {azimuth_deg} degrees: {horizontal:?}"
            );
        }
    }
    // A cavity as deep as it is wide returns nothing at 45 degrees: each ray leaves by two side walls, to the other side.
    let deep = Target::Cavity { width_m: 0.05, height_m: 0.05, depth_m: 0.05 };
    let at = |azimuth_deg: f64| setup(None, azimuth_deg, 0.0, Wall::Conductor);
    let solved_and_exact_db = |azimuth_deg: f64| {
        let s = at(azimuth_deg);
        [db(solve(&deep, &s, Method::Images, None, 0.1).sigma_m2), closed_form_db(&deep, &s)]
    };
    let (lobe, null) = (solved_and_exact_db(25.0), solved_and_exact_db(45.0));
    assert!(lobe[0] - null[0] > 15.0 && lobe[1] - null[1] > 15.0, "{lobe:?} {null:?}");
    // A flat one returns what a plate of its aperture does, but for the modes that it does not carry.
    let flat = Target::Cavity { width_m: 0.05, height_m: 0.05, depth_m: 1e-4 };
    let plate = Target::Plate { width_m: 0.05, height_m: 0.05 };
    let above = Setup { frequency_hz: 960e9, ..at(0.0) };
    assert!((closed_form_db(&flat, &above) - closed_form_db(&plate, &above)).abs() < 0.05);
    // More bounces than sequences have facets, and a radar beside the aperture.
    for azimuth_deg in [80.0, 90.0, 120.0] {
        assert!(Problem::new(&deep, &at(azimuth_deg), Method::Images, None).is_err(), "{azimuth_deg}");
    }
}

#[test]
fn mie_series_agree_with_the_reference() {
    let wavelength_m = 299_792_458.0 / 60e9;
    for row in reference_rows("sphere") {
        let radius = number(&row["r_m"]);
        let metal = db(mie::cross_section_m2(radius, wavelength_m, None));
        assert!((metal - number(&row["mie_dBsm"])).abs() < 1e-9, "{row}: {metal}");
        let skin = db(mie::cross_section_m2(radius, wavelength_m, Some(SKIN_PERMITTIVITY)));
        assert!((skin - number(&row["skin_mie_dBsm"])).abs() < 1e-9, "{row}: {skin}");
    }
}

#[test]
fn spheres_of_twenty_thousand_triangles_agree_with_mie_series() {
    for radius_m in [0.02, 0.03, 0.04, 0.05, 0.06, 0.08, 0.1] {
        let target = Target::Sphere { radius_m };
        let tolerance = if radius_m < 0.025 { 0.2 } else { 0.1 };
        for boundary in [Wall::Conductor, SKIN] {
            for (azimuth, elevation) in [(0.0, 0.0), (17.0, 31.0), (222.0, -65.0)] {
                let s = setup(None, azimuth, elevation, boundary);
                let edge = radius_m * (4.0 * PI / (20480.0 * 0.433)).sqrt();
                let problem = Problem::new(&target, &s, Method::Skin, Some(edge)).expect("valid");
                assert_eq!(problem.triangles(), 20480);
                let outcome = problem.solve(0.1).expect("valid");
                assert!(outcome.estimate_db.expect("estimate") < 0.1, "{radius_m} m {boundary:?}");
                let error = db(outcome.sigma_m2) - closed_form_db(&target, &s);
                assert!(error.abs() < tolerance, "{radius_m} m {boundary:?}: {error} dB");
            }
        }
    }
}

#[test]
fn facets_of_spheres_agree_with_the_closed_form_of_physical_optics() {
    for row in reference_rows("sphere") {
        let radius_m = number(&row["r_m"]);
        let s = setup(None, 20.0, 10.0, Wall::Conductor);
        let outcome = solve(&Target::Sphere { radius_m }, &s, Method::Facets, Some(0.04 * radius_m), 0.02);
        let error = db(outcome.sigma_m2) - number(&row["po_dBsm"]);
        assert!(error.abs() < 0.05, "{row}: {error} dB, estimate {:?}", outcome.estimate_db);
    }
}

/// Meshes of every reference body, at its directions, agree with the specular point formula that dense integration
/// confirmed.
#[test]
fn meshes_of_ellipsoids_agree_with_the_specular_point_formula() {
    for row in reference_rows("ellipsoid_highlight") {
        let semi_axes_m = vector(&row["axes"]);
        let target = Target::Ellipsoid { semi_axes_m };
        let towards = vector(&row["dir"]).normalize();
        // The reference's range begins at the largest semi-axis from the centre.
        let range_m = number(&row["R0"]) + semi_axes_m.max_element() - target.reference_point(towards).length();
        let (azimuth, elevation) = (towards.y.atan2(towards.x).to_degrees(), towards.z.asin().to_degrees());
        let s = setup(Some(range_m), azimuth, elevation, Wall::Conductor);
        let edge_m = 0.2 * semi_axes_m.min_element();
        let error = db(solve(&target, &s, Method::Skin, Some(edge_m), 0.1).sigma_m2) - closed_form_db(&target, &s);
        assert!(error.abs() < 0.1, "{row}: {error} dB");
    }
}

/// A torso on a 14 mm mesh, all around, near and far: the requirement is 0.2 dB, and the error is within a tenth of it.
#[test]
fn a_torso_of_14_mm_triangles_agrees_with_the_closed_form() {
    let target = Target::Ellipsoid { semi_axes_m: DVec3::new(0.12, 0.17, 0.3) };
    for range in [None, Some(1.0), Some(4.0)] {
        for i in 0..24 {
            let s = setup(range, 15.0 * f64::from(i), -60.0 + 5.0 * f64::from(i), SKIN);
            let outcome = solve(&target, &s, Method::Skin, Some(0.014), 0.2);
            let error = db(outcome.sigma_m2) - closed_form_db(&target, &s);
            assert!(error.abs() < 0.02, "{range:?} view {i}: {error} dB");
        }
    }
}

#[test]
fn cylinders_agree_with_closed_forms_in_the_far_and_near_field() {
    let cylinder = |radius_m, height_m| Target::Cylinder { radius_m, height_m };
    for (s, name) in [
        (setup(None, 20.0, 0.0, Wall::Conductor), "broadside"),
        (setup(None, 20.0, 2.0, Wall::Conductor), "tilted"),
        (setup(Some(3.0), 20.0, 0.0, Wall::Conductor), "near"),
    ] {
        let target = cylinder(0.05, 0.3);
        let error = db(solve(&target, &s, Method::Facets, Some(0.004), 0.05).sigma_m2) - closed_form_db(&target, &s);
        assert!(error.abs() < 0.1, "{name}: {error} dB");
    }
    // The Fresnel integral along an infinite cylinder equals the reference's.
    for row in reference_rows("cylinder_infinite") {
        let s = setup(Some(number(&row["R_surface_m"])), 0.0, 0.0, Wall::Conductor);
        let infinite = closed_form_db(&cylinder(number(&row["a_m"]), 1e5), &s);
        assert!((infinite - number(&row["sigma_eff_dBsm"])).abs() < 1e-2, "{row}: {infinite}");
    }
}

/// Regression test: facets under the radar were as long as half a diagonal of the plate, and the echo was 25 dB too
/// weak. A plate much wider than its range has the cross-section of the radar's mirror image, `pi R^2`.
#[test]
fn a_wide_plate_has_the_echo_of_the_radars_mirror_image() {
    for (width_m, range_m) in [(10.0, 0.3), (4.0, 0.3), (0.3, 0.01), (100.0, 0.3)] {
        let plate = Target::Plate { width_m, height_m: width_m };
        let outcome = solve(&plate, &setup(Some(range_m), 0.0, 0.0, Wall::Conductor), Method::Facets, None, 0.1);
        let error = db(outcome.sigma_m2) - db(PI * range_m * range_m);
        assert!(error.abs() < 0.1, "{width_m} m at {range_m} m: {error} dB, estimate {:?}", outcome.estimate_db);
    }
}

/// The cross-section stays finite through the focus of a concave mirror, where geometrical optics is infinite.
#[test]
fn a_concave_mirror_agrees_with_the_reference_at_its_caustic() {
    let mirror = Target::Mirror { radius_m: 1.0, aperture_m: 0.2 };
    let k = setup(None, 0.0, 0.0, Wall::Conductor).wavenumber_per_m();
    for row in reference_rows("concave_mirror") {
        let range = number(&row["R_m"]);
        let s = setup(Some(range), 0.0, 0.0, Wall::Conductor);
        let expected = db(k * k / PI * number(&row["abs_I"]).powi(2) * range.powi(4));
        assert!((closed_form_db(&mirror, &s) - expected).abs() < 0.001, "{row}");
        let outcome = solve(&mirror, &s, Method::Facets, None, 0.02);
        let error = db(outcome.sigma_m2) - expected;
        assert!(error.abs() < 0.01, "{row}: {error} dB");
        assert_eq!(Method::automatic(&mirror, true), Method::Facets);
    }
}

/// Files contain only triangles: a mesh of a ball acts as a ball, a corner as a corner, and a body hidden behind
/// another is not seen.
#[test]
fn meshes_without_normals_agree_with_the_shapes_that_they_represent() {
    let ball = shape::icosphere(DVec3::splat(0.05), 32);
    let s = setup(None, 12.0, 34.0, Wall::Conductor);
    let surface = Surface::from_mesh(&ball.mesh(), 0.6);
    let target = Target::Surface { surface };
    assert_eq!(Method::automatic(&target, true), Method::Skin);
    let outcome = solve(&target, &s, Method::Skin, None, 0.1);
    let error = db(outcome.sigma_m2) - closed_form_db(&Target::Sphere { radius_m: 0.05 }, &s);
    assert!(error.abs() < 0.1, "{error} dB");

    // With the same ball right behind a larger one, only the larger one is seen.
    let large = shape::icosphere(DVec3::splat(0.2), 32);
    let mut two = large.mesh();
    let count = two.vertices.len() as u32;
    let behind = s.towards() * -0.5;
    two.vertices.extend(ball.vertices.iter().map(|v| *v + behind));
    two.triangles.extend(ball.triangles.iter().map(|t| t.map(|i| i + count)));
    let solve_mesh =
        |mesh: &Mesh| solve(&Target::Surface { surface: Surface::from_mesh(mesh, 0.6) }, &s, Method::Skin, None, 0.1);
    let (one, both) = (solve_mesh(&large.mesh()), solve_mesh(&two));
    assert!((both.sigma_m2 / one.sigma_m2 - 1.0).abs() < 1e-3, "{} {}", both.sigma_m2, one.sigma_m2);

    // Trihedral of three triangles.
    let vertices = vec![DVec3::ZERO, DVec3::X * 0.1, DVec3::Y * 0.1, DVec3::Z * 0.1];
    let mesh = Mesh { vertices, triangles: vec![[0, 1, 2], [0, 2, 3], [0, 3, 1]] };
    let corner = Target::Surface { surface: Surface::from_mesh(&mesh, 0.6) };
    assert_eq!(Method::automatic(&corner, true), Method::Images);
    let axis = setup(None, 45.0, 35.264_389_682_754_654, Wall::Conductor);
    let error = db(solve(&corner, &axis, Method::Images, None, 0.1).sigma_m2) - 12.247_497;
    assert!(error.abs() < 0.3, "{error} dB");
}

/// A target behind plasterboard: a skin sphere through 12.5 mm of it, both ways, against the closed form.
#[test]
fn a_sphere_behind_plasterboard_is_two_transmissions_weaker() {
    use radome_sim::em::fresnel::{slab, straight_through};
    use radome_sim::material::Material;
    let eps = Material::Plasterboard.permittivity(60e9).expect("dielectric");
    let k = setup(None, 0.0, 0.0, SKIN).wavenumber_per_m();
    let sphere = Target::Sphere { radius_m: 0.1 };
    let s = setup(Some(3.0), 0.0, 0.0, SKIN);
    let free = solve(&sphere, &s, Method::Skin, Some(0.005), 0.05).sigma_m2;
    let through = straight_through(eps, 0.0125, k, 1.0).te;
    let behind = db(free * through.norm_sqr().powi(2));
    let expected = closed_form_db(&sphere, &s) + 40.0 * slab(eps, 0.0125, k, 1.0).transmission.te.norm().log10();
    assert!((behind - expected).abs() < 0.1, "{behind} {expected}");
    // 5.5 dB each way, according to the design study.
    assert!((40.0 * through.norm().log10() + 11.0).abs() < 0.2);
}

/// The field-related rows of the design study's table of numerically hard cases.
mod hard_cases {
    use super::*;

    /// Caustic: through the focus of a concave mirror in steps of half a per cent, where geometrical optics is infinite
    /// and up to 18 dB wrong beside it. The solver follows the exact integral everywhere, without special settings.
    #[test]
    fn a_concave_mirror_agrees_with_the_exact_integral_through_its_focus() {
        let mirror = Target::Mirror { radius_m: 1.0, aperture_m: 0.2 };
        for step in -6..=6 {
            let s = setup(Some(1.0 + 0.005 * f64::from(step)), 0.0, 0.0, Wall::Conductor);
            let automatic = Method::automatic(&mirror, false);
            let error = db(solve(&mirror, &s, automatic, None, 0.02).sigma_m2) - closed_form_db(&mirror, &s);
            assert!(error.abs() < 0.1, "step {step}, {automatic:?}: {error} dB");
        }
    }

    /// Facet integral near specular: a plate rotated through its specular direction by steps down to 1e-16 rad gives a
    /// smooth result.
    #[test]
    fn plate_echoes_are_smooth_at_the_specular_direction() {
        let plate = Target::Plate { width_m: 0.1, height_m: 0.1 };
        let echo_db = |degrees: f64| {
            db(solve(&plate, &setup(None, degrees, 0.0, Wall::Conductor), Method::Facets, None, 0.1).sigma_m2)
        };
        let peak = echo_db(0.0);
        for exponent in 3..16 {
            let offset_deg = 10f64.powi(-exponent);
            // sinc^2 at k a sin(angle) is quadratic in the angle.
            let u = 125.750_7 * offset_deg.to_radians().sin();
            assert!((echo_db(offset_deg) - peak + 10.0 * u * u / 3.0 / 10f64.ln()).abs() < 1e-7, "{offset_deg}");
        }
    }

    /// Both polarisations and every direction of the edges (including edge-degenerate ones), compared with a rotated
    /// plate.
    #[test]
    fn the_integral_does_not_depend_on_the_common_orientation() {
        let k = setup(None, 0.0, 0.0, SKIN).wavenumber_per_m();
        let surface = shape::plate(0.1, 0.07, 0.1);
        let radar = DVec3::new(1.2, 0.1, -0.05);
        let integral = |rotation: glam::DQuat| {
            let mut rotated = surface.clone();
            rotated.vertices.iter_mut().for_each(|v| *v = rotation * *v);
            rotated.normals.iter_mut().for_each(|n| *n = rotation * *n);
            let radar = Radar { end: Endpoint::Near(rotation * radar), polarisation: rotation * DVec3::Z };
            let accuracy = Accuracy { wavenumber_per_m: k, tolerance_rad: 0.02 };
            facet::integrate(&rotated, accuracy, |p, n| radar.sample(p, n, true, &SKIN, k)).value
        };
        let unrotated = integral(glam::DQuat::IDENTITY);
        for (axis, angle) in [(DVec3::X, 0.7), (DVec3::new(0.6, 0.0, 0.8), 2.0), (DVec3::Y, -1.1)] {
            let rotated = integral(glam::DQuat::from_axis_angle(axis, angle));
            assert!((rotated - unrotated).norm() < 1e-9 * unrotated.norm(), "{axis} {angle}");
        }
    }

    /// The scalar code path for conductors agrees with the vector form: a conductor as the limit of a dielectric.
    #[test]
    fn the_scalar_integral_of_conductors_agrees_with_the_vector_integral() {
        let k = setup(None, 0.0, 0.0, SKIN).wavenumber_per_m();
        let surface = shape::ellipsoid(DVec3::new(0.05, 0.06, 0.08), 0.01);
        let radar = Radar { end: Endpoint::Near(DVec3::new(0.7, 0.4, 0.2)), polarisation: DVec3::Z };
        let accuracy = Accuracy { wavenumber_per_m: k, tolerance_rad: 0.05 };
        let almost = Wall::HalfSpace { permittivity: Complex64::new(1.0, -1e14) };
        let integral =
            |boundary: Wall| facet::integrate(&surface, accuracy, |p, n| radar.sample(p, n, false, &boundary, k)).value;
        let (scalar, vectors) = (integral(Wall::Conductor), integral(almost));
        assert!((scalar - vectors).norm() < 1e-5 * scalar.norm(), "{scalar} {vectors}");
    }

    #[test]
    fn the_integral_does_not_depend_on_the_order_of_triangles() {
        let k = setup(None, 0.0, 0.0, SKIN).wavenumber_per_m();
        let surface = shape::ellipsoid(DVec3::new(0.05, 0.06, 0.08), 0.01);
        let mut shuffled = surface.clone();
        shuffled.triangles.reverse();
        shuffled.triangles.iter_mut().for_each(|t| t.rotate_left(1));
        let radar = Radar { end: Endpoint::Near(DVec3::new(0.7, 0.4, 0.2)), polarisation: DVec3::Z };
        let accuracy = Accuracy { wavenumber_per_m: k, tolerance_rad: 0.05 };
        let integral = |s| facet::integrate(s, accuracy, |p, n| radar.sample(p, n, false, &Wall::Conductor, k));
        let (a, b) = (integral(&surface), integral(&shuffled));
        assert_eq!(a.facets, b.facets);
        assert!((a.value - b.value).norm() < 1e-12 * a.value.norm());
    }

    /// Needles, triangles without area and coincident points give finite results; only triangles with an area
    /// contribute.
    #[test]
    fn degenerate_triangles_add_nothing() {
        let k = setup(None, 0.0, 0.0, SKIN).wavenumber_per_m();
        let radar = Radar { end: Endpoint::Near(DVec3::new(1.0, 0.02, 0.01)), polarisation: DVec3::Z };
        let accuracy = Accuracy { wavenumber_per_m: k, tolerance_rad: 0.05 };
        let plain = shape::plate(0.1, 0.1, 0.05);
        let mut degenerate = plain.clone();
        degenerate.triangles.extend([[0, 0, 0], [0, 1, 1], [0, 1, 2], [999, 0, 1]]);
        let integral = |s| facet::integrate(s, accuracy, |p, n| radar.sample(p, n, true, &Wall::Conductor, k)).value;
        // Vertices 0, 1 and 2 are collinear, so the triangle has no area.
        assert!((integral(&plain) - integral(&degenerate)).norm() < 1e-12 * integral(&plain).norm());
        assert!(!degenerate.is_smooth());
    }

    /// A radar that touches the surface, or is on it, gives a finite answer.
    #[test]
    fn a_radar_at_the_surface_has_a_finite_integral() {
        let k = setup(None, 0.0, 0.0, SKIN).wavenumber_per_m();
        let surface = shape::plate(0.02, 0.02, 0.02);
        for distance in [0.0, 1e-12, 1e-6, 1e-3] {
            let radar = Radar { end: Endpoint::Near(DVec3::X * distance), polarisation: DVec3::Z };
            let accuracy = Accuracy { wavenumber_per_m: k, tolerance_rad: 0.2 };
            for boundary in [Wall::Conductor, SKIN] {
                let value = facet::integrate(&surface, accuracy, |p, n| radar.sample(p, n, true, &boundary, k)).value;
                assert!(value.is_finite(), "{distance} {boundary:?}: {value}");
            }
        }
    }

    #[test]
    fn the_echo_at_grazing_incidence_is_weak_and_finite() {
        let plate = Target::Plate { width_m: 0.1, height_m: 0.1 };
        for boundary in [Wall::Conductor, SKIN] {
            for off in [1e-3, 1e-6, 1e-9, 0.0] {
                let sigma = solve(&plate, &setup(None, 90.0 - off, 0.0, boundary), Method::Facets, None, 0.1).sigma_m2;
                assert!(sigma.is_finite() && sigma < 1e-3, "{off}: {sigma}");
            }
        }
    }

    /// Half-lit facets: the shadow line of a sphere is invisible in the result for any mesh size.
    #[test]
    fn the_echo_of_a_sphere_does_not_depend_on_the_orientation_of_its_mesh() {
        let target = Target::Sphere { radius_m: 0.05 };
        let mut values = Vec::new();
        for turn in 0..8 {
            let s = setup(None, 7.0 * f64::from(turn), 3.0 * f64::from(turn), Wall::Conductor);
            values.push(db(solve(&target, &s, Method::Facets, Some(0.005), 0.05).sigma_m2));
        }
        let (low, high) =
            (values.iter().copied().fold(f64::MAX, f64::min), values.iter().copied().fold(f64::MIN, f64::max));
        assert!(high - low < 0.1, "{values:?}");
    }

    #[test]
    fn invalid_targets_and_setups_are_refused() {
        let plate = |width_m| Target::Plate { width_m, height_m: 0.1 };
        let s = setup(None, 0.0, 0.0, Wall::Conductor);
        for bad in [0.0, -1.0, f64::NAN, f64::INFINITY, 1e9] {
            assert!(Problem::new(&plate(bad), &s, Method::Facets, None).is_err(), "{bad}");
            let near = Setup { range_m: Some(bad), ..s };
            assert!(Problem::new(&plate(0.1), &near, Method::Facets, None).is_err(), "{bad}");
            assert!(Problem::new(&plate(0.1), &s, Method::Facets, Some(bad)).is_err(), "{bad}");
            let at_invalid_frequency = Setup { frequency_hz: 1e4 * bad, ..s };
            assert!(Problem::new(&plate(0.1), &at_invalid_frequency, Method::Facets, None).is_err(), "{bad}");
        }
        let problem = Problem::new(&plate(0.1), &s, Method::Facets, None).expect("valid");
        assert!(problem.solve(f64::NAN).is_err() && problem.solve(0.0).is_err());
        assert!(Problem::new(&plate(0.1), &s, Method::Specular, None).is_err());
        let inside = Setup { range_m: Some(0.05), ..s };
        let corner = Target::Trihedral { edge_m: 0.1, outline: Outline::Square };
        assert!(Problem::new(&corner, &inside, Method::Images, None).is_err());
        let sphere = Target::Sphere { radius_m: 1.0 };
        assert!(Problem::new(&sphere, &s, Method::Facets, Some(1e-4)).is_err());
    }
}
