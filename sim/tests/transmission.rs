//! Transmission through thin walls: the echo of a person behind plasterboard is weaker by two transmissions.

use std::f64::consts::TAU;
use std::sync::Arc;

use glam::{DMat3, DVec3};
use num_complex::Complex64;
use radome_sim::Scene;
use radome_sim::echo::{EchoReport, Snapshot, audible_pairs, echoes, reflect_at_skin};
use radome_sim::em::image::{BoxRoom, Wall, images};
use radome_sim::em::specular::Ellipsoid;
use radome_sim::material::Material;
use radome_sim::people::body::CHEST;
use radome_sim::people::motion::{MotionBuilder, Person};
use radome_sim::prepared_scene::PreparedScene;

use crate::common::{NOBODY, WAVENUMBER, hall, isotropic, parse};

const THICKNESS_M: f64 = 0.0125;

/// Transmission of a board relative to the air that it displaces, wave by wave: entry, crossing, and each pair of
/// internal reflections.
fn board_transmission(permittivity: Complex64, cosine: f64, tm: bool, wavenumber: f64) -> Complex64 {
    let q = (permittivity - (1.0 - cosine * cosine)).sqrt();
    let (air, inside) = if tm { (permittivity * cosine, q) } else { (Complex64::from(cosine), q) };
    let reflection = (air - inside) / (air + inside);
    let crossing = (Complex64::new(0.0, -wavenumber * THICKNESS_M) * q).exp();
    let bounce_pair = reflection * reflection * crossing * crossing;
    let bounces: Complex64 = (0..200).map(|i| bounce_pair.powu(i)).sum();
    (1.0 - reflection * reflection) * crossing * bounces * Complex64::from_polar(1.0, wavenumber * THICKNESS_M * cosine)
}

fn db(ratio: Complex64) -> f64 {
    20.0 * ratio.norm().log10()
}

fn room(wall: Wall, transmission: bool) -> BoxRoom {
    let mut walls = [Wall::Open; 6];
    walls[1] = wall;
    BoxRoom::new(DVec3::new(4.0, 8.0, 3.0), walls, WAVENUMBER, transmission)
}

fn plasterboard() -> Complex64 {
    Material::Plasterboard.permittivity(60e9).expect("dielectric")
}

/// Echo of a torso of skin behind the wall at x = 4 m, seen from the middle of the room.
fn torso_echo(room: &BoxRoom, radar: DVec3, polarisation: DVec3, centre: DVec3) -> (Complex64, f64) {
    let body = Ellipsoid { centre, axes: DMat3::IDENTITY, semi_axes_m: DVec3::new(0.115, 0.165, 0.22) };
    let element = isotropic(radar, polarisation);
    let specular = body.specular_point(radar, radar, None).expect("visible");
    let field = room.illuminate(&element, [0; 3], specular.point).field;
    (reflect_at_skin(field, -specular.towards.0, specular.normal).received_by(field), specular.towards.0.x.abs())
}

/// At normal incidence and at 40 degrees, with the electric field perpendicular to the plane of incidence and in it.
/// The ratio of the echoes with and without the wall is the board's transmission squared, in amplitude and phase.
#[test]
fn a_torso_behind_plasterboard_is_two_transmissions_weaker() {
    let radar = DVec3::new(1.0, 4.0, 1.2);
    let wall = Wall::Slab { permittivity: plasterboard(), thickness_m: THICKNESS_M };
    let (without_wall, with_wall) = (room(Wall::Open, false), room(wall, true));
    for degrees in [0.0f64, 40.0] {
        let (sine, cosine) = degrees.to_radians().sin_cos();
        let centre = radar + DVec3::new(cosine, sine, 0.0) * 5.0;
        for (polarisation, tm) in [(DVec3::Z, false), (DVec3::new(-sine, cosine, 0.0), true)] {
            let (without, _) = torso_echo(&without_wall, radar, polarisation, centre);
            let (with, cosine) = torso_echo(&with_wall, radar, polarisation, centre);
            let expected = board_transmission(plasterboard(), cosine, tm, WAVENUMBER).powu(2);
            let error_db = db(with / without) - db(expected);
            assert!(error_db.abs() < 1e-6, "{degrees} degrees, TM {tm}: {error_db} dB");
            assert!(((with / without) / expected - 1.0).norm() < 1e-6, "{degrees} degrees, TM {tm}: phase");
        }
    }
    // The design study's figure for a board of 12.5 mm, one way.
    assert!((db(board_transmission(plasterboard(), 1.0, false, WAVENUMBER)) + 5.5).abs() < 0.1);
}

fn scene(material: &str, transmission: bool) -> Scene {
    let wall = format!("x_high = {{ material = \"{material}\", thickness_m = {THICKNESS_M} }}");
    let text = hall(NOBODY)
        .replace("size_m = [20.0, 20.0, 3.0]", &format!("transmission = {transmission}\nsize_m = [4.0, 20.0, 3.0]"))
        .replace("x_high = { material = \"open\" }", &wall);
    parse(&text)
}

/// Echoes of a person who stands at a place, `[pair][segment]`, first receiver.
fn person_echoes(scene: &Scene, position: [f64; 2]) -> Vec<Complex64> {
    let prepared = PreparedScene::new(scene, 0, 20.0);
    let motion = Arc::new(MotionBuilder::new(Person::draw(1, [0, 0], 1.75), 0.0, position, 3.0).stand(9.0).stay());
    let people = [Snapshot::new(&motion, 1.0)];
    let mut keys = Vec::new();
    let pairs = audible_pairs(&prepared, &motion, 1.0);
    echoes(&prepared, &motion, &people, 0, &pairs, &mut keys, &mut EchoReport::default());
    keys.iter().step_by(prepared.rx.len()).map(|k| k.amplitude).collect()
}

/// A whole simulated person behind the board: the chest's echo is within a tenth of a decibel of the closed form at its
/// angle, straight ahead and 40 degrees off.
#[test]
fn a_person_behind_plasterboard_has_the_echo_of_the_closed_form() {
    for offset_m in [0.0f64, 4.2] {
        let position = [6.0, 10.0 + offset_m];
        let (open, with_wall) =
            (person_echoes(&scene("open", true), position), person_echoes(&scene("plasterboard", true), position));
        let cosine = 5.0 / 5f64.hypot(offset_m);
        let waveform = scene("open", true).waveform().clone();
        let k = TAU * waveform.centre_frequency_hz() / 299_792_458.0;
        let permittivity = Material::Plasterboard.permittivity(waveform.centre_frequency_hz()).expect("dielectric");
        let error_db =
            db(with_wall[CHEST] / open[CHEST]) - 2.0 * db(board_transmission(permittivity, cosine, false, k));
        assert!(error_db.abs() < 0.1, "{offset_m} m: {error_db} dB");
    }
}

#[test]
fn without_transmission_a_person_behind_a_wall_has_no_echo() {
    for (material, transmission) in [("plasterboard", false), ("metal", true)] {
        let echoes = person_echoes(&scene(material, transmission), [6.0, 10.0]);
        assert!(echoes.iter().all(|a| a.norm() == 0.0), "{material} {transmission}");
    }
    assert!(!parse(&hall("[people.desk]\nmax_people = 0\n")).room().transmission, "transmission is off by default");
}

/// Regression test: an open wall hid people. Echoes from behind it are the same with and without transmission.
#[test]
fn an_open_wall_obstructs_no_path() {
    let (without, with) =
        (person_echoes(&scene("open", false), [6.0, 10.0]), person_echoes(&scene("open", true), [6.0, 10.0]));
    assert!(without.iter().any(|a| a.norm() > 0.0));
    assert_eq!(without, with);
    // Regression test: the plane of a neighbouring wall obstructed paths beside that wall.
    let metal = ["x_high", "y_low", "y_high"].map(|wall| format!("{wall} = {{ material = \"metal\" }}"));
    let mut text = hall(NOBODY)
        .replace("[20.0, 20.0, 3.0]", "[4.0, 4.0, 3.0]")
        .replace("[1.0, 10.0, 1.2]", "[1.0, 3.0, 1.2]\nazimuth_deg = -121.0");
    for wall in &metal {
        let (key, _) = wall.split_once(" =").expect("a key");
        text = text.replace(&format!("{key} = {{ material = \"open\" }}"), wall);
    }
    let scene = parse(&text);
    let has_echo = |position: [f64; 2]| person_echoes(&scene, position).iter().any(|a| a.norm() > 0.0);
    assert!(has_echo([-1.0, -0.3]), "the straight path crosses the open wall at y = 1.35 m");
    assert!(!has_echo([0.2, -2.0]), "the straight path crosses the metal wall");
}

#[test]
fn transmission_does_not_change_echoes_inside_the_room() {
    for position in [[2.0, 9.0], [3.0, 12.0]] {
        let (without, with) = (
            person_echoes(&scene("plasterboard", false), position),
            person_echoes(&scene("plasterboard", true), position),
        );
        assert!(without.iter().any(|a| a.norm() > 0.0));
        assert_eq!(without, with);
    }
}

mod hard_cases {
    use super::*;

    /// A path from in front of the wall through it and beyond, and around the room's corner. The field has no step from
    /// one millimetre to the next, no image exists beyond, and values on the planes themselves are finite.
    #[test]
    fn the_field_is_continuous_through_a_wall() {
        let wall = Wall::Slab { permittivity: plasterboard(), thickness_m: THICKNESS_M };
        let room = BoxRoom::new(DVec3::new(4.0, 8.0, 3.0), [wall; 6], WAVENUMBER, true);
        let element = isotropic(DVec3::new(1.0, 4.0, 1.2), DVec3::new(0.0, 0.6, 0.8));
        for index in images(2) {
            let field_at = |x: f64| room.illuminate(&element, index, DVec3::new(x, 5.0, 1.0)).field;
            let mut previous = field_at(3.9);
            for step in 1..=400 {
                let x = 3.9 + 1e-3 * f64::from(step);
                let field = field_at(x);
                let change = (field.re - previous.re).length() + (field.im - previous.im).length();
                assert!(change < 0.05, "{index:?} at {x} m: {change}");
                assert!(index == [0; 3] || x < 4.11 || field.magnitude() == 0.0, "{index:?} at {x} m");
                previous = field;
            }
        }
        for corner in [DVec3::new(4.0, 8.0, 1.0), DVec3::new(0.0, 0.0, 0.0), DVec3::new(5.0, 9.0, 1.0), DVec3::ZERO] {
            assert!(room.illuminate(&element, [0; 3], corner).field.magnitude().is_finite(), "{corner}");
        }
    }
}
