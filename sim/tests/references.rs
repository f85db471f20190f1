//! Fields against reference values that were computed independently (mpmath, dense integration, closed forms).

use std::f64::consts::{PI, TAU};

use glam::{DMat3, DVec3};
use num_complex::Complex64;
use radome_sim::em::fresnel::{half_space, slab};
use radome_sim::em::image::{BoxRoom, Wall, images, order};
use radome_sim::em::specular::Ellipsoid;

use crate::common::{WAVENUMBER, isotropic, number, reference, reference_rows, vector};

fn complex(value: &serde_json::Value) -> Complex64 {
    Complex64::new(number(&value[0]), number(&value[1]))
}

#[test]
fn slabs_agree_with_the_40_digit_characteristic_matrix() {
    let rows = reference_rows("fresnel_slab");
    assert!(rows.len() >= 60);
    for row in rows {
        let permittivity = complex(&row["eps"]);
        let cosine = number(&row["theta_deg"]).to_radians().cos();
        let thickness = number(&row["d_m"]);
        let (face, layer) = (half_space(permittivity, cosine), slab(permittivity, thickness, WAVENUMBER, cosine));
        let (face, reflection, transmission) = match row["pol"].as_str() {
            Some("TE") => (face.te, layer.reflection.te, layer.transmission.te),
            _ => (face.tm, layer.reflection.tm, layer.transmission.tm),
        };
        for (found, key) in [(face, "half_space"), (reflection, "slab_R"), (transmission, "slab_T")] {
            assert!((found - complex(&row[key])).norm() < 1e-12, "{row} {key} {found}");
        }
    }
}

fn conducting_box() -> BoxRoom {
    BoxRoom::new(DVec3::new(12.0, 2.0, 2.7), [Wall::Conductor; 6], WAVENUMBER, false)
}

#[test]
fn images_of_the_corridor_are_at_the_reference_positions() {
    let room = conducting_box();
    let (tx, rx) = (DVec3::new(0.2, 1.0, 1.5), DVec3::new(0.2, 1.0025, 1.5));
    let rows = reference_rows("image_corridor");
    for row in &rows {
        let n = [0, 1, 2].map(|i| row["n"][i].as_i64().expect("index") as i32);
        assert_eq!(u64::from(order(n)), row["order"].as_u64().expect("order"));
        assert!(images(3).contains(&n), "{n:?}");
        let length = room.image_position(n, tx).distance(rx);
        let expected = number(&row["path_m"]);
        assert!((length - expected).abs() < 1e-12, "{row}: {length}");
        let phase = (-WAVENUMBER * length).rem_euclid(TAU);
        let difference = (phase - number(&row["phase_rad"]) + PI).rem_euclid(TAU) - PI;
        // Phase of the length alone: the conductors' signs are in the field, see below.
        assert!(difference.abs() < 1e-6, "{row} {difference}");
        assert!((1.0 / length - number(&row["amp_1_over_d"])).abs() < 1e-9, "{row}");
    }
    assert!(rows.len() >= 60);
}

/// The field of an image is that of the mirrored dipole, with the sign -1 for each conductor.
#[test]
fn conductors_mirror_a_dipole_with_its_sign() {
    let room = conducting_box();
    let tx = isotropic(DVec3::new(0.2, 0.7, 1.5), DVec3::new(0.36, 0.48, 0.8));
    let target = DVec3::new(5.0, 1.3, 0.8);
    for index in images(3) {
        let found = room.illuminate(&tx, index, target);
        let mirrored = BoxRoom::image_vector(index, tx.polarisation);
        let sign = if order(index).is_multiple_of(2) { 1.0 } else { -1.0 };
        let expected = sign * (mirrored - found.direction * found.direction.dot(mirrored));
        assert!((found.field.re - expected).length() < 1e-12 && found.field.im.length() < 1e-12, "{index:?}");
    }
}

#[test]
fn two_ray_ground_has_the_reference_gains() {
    let walls = [Wall::Open, Wall::Open, Wall::Open, Wall::Open, Wall::Conductor, Wall::Open];
    let room = BoxRoom::new(DVec3::new(50.0, 50.0, 50.0), walls, WAVENUMBER, false);
    let radar = isotropic(DVec3::new(1.0, 20.0, 1.5), DVec3::Y);
    for row in reference_rows("two_ray") {
        let target = DVec3::new(6.0, 20.0, number(&row["ht"]));
        let direct = room.illuminate(&radar, [0, 0, 0], target);
        let ground = room.illuminate(&radar, [0, 0, -1], target);
        let field = |i: &radome_sim::em::image::Illumination| {
            i.field.along(DVec3::Y) * Complex64::from_polar(1.0 / i.distance_m, -WAVENUMBER * i.distance_m)
        };
        let gain_db = 40.0 * ((field(&direct) + field(&ground)).norm() * direct.distance_m).log10();
        let expected = number(&row["gain_dB_rel_free"]);
        assert!((gain_db - expected).abs() < 1e-6, "{row} {gain_db}");
    }
}

/// Dense sum of physical optics: `int cos e^{-jk(Rt+Rr)}/(Rt Rr) dS` over the surface that is visible from both
/// antennas.
fn dense_physical_optics(e: &Ellipsoid, tx: DVec3, rx: DVec3) -> Complex64 {
    let (rows, columns) = (1400usize, 2800usize);
    let mut sum = Complex64::ZERO;
    for i in 0..rows {
        let theta = PI * (i as f64 + 0.5) / rows as f64;
        for j in 0..columns {
            let phi = TAU * (j as f64 + 0.5) / columns as f64;
            let unit = DVec3::new(theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos());
            let point = e.surface(unit);
            let b = e.semi_axes_m;
            let gradient = unit / b;
            let normal = e.axes * gradient.normalize();
            let area = theta.sin() * b.x * b.y * b.z * gradient.length() * (PI / rows as f64) * (TAU / columns as f64);
            let (t, r) = (tx - point, rx - point);
            let (rt, rr) = (t.length(), r.length());
            let (ct, cr) = (normal.dot(t) / rt, normal.dot(r) / rr);
            if ct > 0.0 && cr > 0.0 {
                sum += Complex64::from_polar(0.5 * (ct + cr) * area / (rt * rr), -WAVENUMBER * (rt + rr));
            }
        }
    }
    sum
}

#[test]
fn specular_points_agree_with_dense_physical_optics_in_amplitude_and_phase() {
    let body = |semi_axes_m| Ellipsoid { centre: DVec3::ZERO, axes: DMat3::from_rotation_z(0.3), semi_axes_m };
    let limb = body(DVec3::new(0.05, 0.07, 0.22));
    let head = body(DVec3::new(0.09, 0.09, 0.12));
    let cases = [
        (limb, DVec3::new(1.0, 0.3, 0.2), DVec3::new(1.0, 0.3, 0.2)),
        (head, DVec3::new(0.5, 0.5, 0.9), DVec3::new(0.5, 0.5, 0.9)),
        // Bistatic cases, as for image pairs: 50 degrees apart, at unequal distances.
        (limb, DVec3::new(1.2, 0.2, 0.1), DVec3::new(0.8, 1.1, 0.0)),
        (head, DVec3::new(0.9, -0.5, 0.3), DVec3::new(0.7, 0.6, 0.2)),
    ];
    for (e, tx, rx) in cases {
        let specular = e.specular_point(tx, rx, None).expect("visible");
        let integral = dense_physical_optics(&e, tx, rx);
        let (rt, rr) = specular.distances_m;
        let amplitude = PI / WAVENUMBER * specular.cosine / (specular.det_j.sqrt() * rt * rr);
        let error_db = 20.0 * (amplitude / integral.norm()).log10();
        // For separate antennas the sum has a border, where the body is no longer visible from one of them. It adds an
        // edge contribution that the specular point does not have.
        let tolerance_db = if tx == rx { 0.05 } else { 0.2 };
        assert!(error_db.abs() < tolerance_db, "{tx} {rx}: {error_db} dB");
        let phase = (integral * Complex64::from_polar(1.0, WAVENUMBER * (rt + rr))).arg();
        assert!((phase + 0.5 * PI).abs() < 0.03, "{tx} {rx}: {phase} rad");
    }
}

/// `det J = K + 2H/R + 1/R^2` for every body and direction of the reference, whose own comparison of that formula with
/// physical optics must lie within its stated tolerance.
#[test]
fn near_field_cross_section_is_that_of_the_reference_bodies() {
    let tolerance = number(&reference()["ellipsoid_highlight"]["tolerance_dB"]);
    for row in reference_rows("ellipsoid_highlight") {
        assert!(number(&row["GO_over_PO_dB"]).abs() < tolerance);
        let b = vector(&row["axes"]);
        let e = Ellipsoid { centre: DVec3::ZERO, axes: DMat3::IDENTITY, semi_axes_m: b };
        let radar = vector(&row["dir"]).normalize() * (number(&row["R0"]) + b.max_element());
        let specular = e.specular_point(radar, radar, None).expect("visible");
        // At the closest point the line of sight is the normal.
        assert!((specular.normal - (radar - specular.point).normalize()).length() < 1e-5);
        assert!(((specular.point / b).length() - 1.0).abs() < 1e-9);
        // Gaussian and mean curvature of an ellipsoid (Goldman, "Curvature formulas for implicit curves and surfaces").
        let p = specular.point;
        let g = (p / (b * b)).length();
        let product = b.x * b.y * b.z;
        let gaussian = 1.0 / (product * g * g).powi(2);
        let mean = (b.length_squared() - p.length_squared()) / (2.0 * product * product * g.powi(3));
        let range = specular.distances_m.0;
        let expected = gaussian + 2.0 * mean / range + 1.0 / (range * range);
        assert!((specular.det_j / expected - 1.0).abs() < 1e-5, "{row}: {} {expected}", specular.det_j);
    }
}

#[test]
fn skin_has_the_reference_reflection() {
    let found = half_space(radome_sim::material::SKIN_PERMITTIVITY, 1.0).te;
    assert!((found - complex(&reference()["skin"]["Gamma0"])).norm() < 1e-12);
}

mod hard_cases {
    use super::*;

    #[test]
    fn foils_thick_walls_and_grazing_incidence_stay_finite_and_passive() {
        let permittivity = Complex64::new(5.24, -0.34);
        for thickness in [0.0, 1e-12, 1e-9, 1e-3, 0.2, 10.0] {
            for cosine in [1.0, 0.5, 1e-4, 1e-8, 0.0] {
                let s = slab(permittivity, thickness, WAVENUMBER, cosine);
                for (r, t) in [(s.reflection.te, s.transmission.te), (s.reflection.tm, s.transmission.tm)] {
                    let power = r.norm_sqr() + t.norm_sqr();
                    assert!(power.is_finite() && power <= 1.0 + 1e-9, "{thickness} {cosine}: {r} {t}");
                }
            }
        }
        // A foil of 1 pm reflects in proportion to its thickness.
        let one = slab(permittivity, 1e-12, WAVENUMBER, 0.7).reflection.te;
        let two = slab(permittivity, 2e-12, WAVENUMBER, 0.7).reflection.te;
        assert!((two / one - 2.0).norm() < 1e-6);
    }

    /// The specular point must be unique and finite for any position of the pair, including inside the body.
    #[test]
    fn specular_points_of_antennas_at_and_inside_a_body_are_finite() {
        let e = Ellipsoid {
            centre: DVec3::new(2.0, 1.0, 1.2),
            axes: DMat3::from_rotation_y(0.4),
            semi_axes_m: DVec3::new(0.115, 0.165, 0.22),
        };
        let mut previous: Option<f64> = None;
        for step in 0..4000 {
            let radar = e.centre + DVec3::new(1.0 - f64::from(step) * 5e-4, 0.01, 0.02);
            let Some(specular) = e.specular_point(radar, radar + DVec3::Y * 0.003, None) else { continue };
            let range = specular.distances_m.0;
            assert!(specular.det_j.is_finite() && range.is_finite() && range < 1.1, "step {step}");
            if let Some(previous) = previous {
                assert!((range - previous).abs() < 0.02, "step {step}: {previous} to {range}");
            }
            previous = Some(range);
        }
        assert!(previous.is_some());
    }
}
