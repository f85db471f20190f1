//! Paths by way of a body and a wall: specular points for pairs of image antennas, compared chirp by chirp with
//! physical optics over the whole body. One image illuminates the body and the other receives.
#![allow(clippy::print_stderr)]

use std::f64::consts::{PI, TAU};

use glam::{DMat3, DVec3};
use num_complex::Complex64;
use radome_dsp::SPEED_OF_LIGHT_M_PER_S;
use radome_sim::echo::{EchoReport, Snapshot, echoes, reflect_at_skin};
use radome_sim::em::current::{Arrival, received};
use radome_sim::em::image::{BoxRoom, Element, ImageIndex, Wall};
use radome_sim::em::specular::Ellipsoid;
use radome_sim::material::{Material, SKIN_PERMITTIVITY};
use radome_sim::path_segment::{PathSample, PathSegment};
use radome_sim::people::body::CHEST;
use radome_sim::people::motion::{MotionBuilder, Person};
use radome_sim::prepared_scene::PreparedScene;
use rayon::prelude::*;

use crate::common::{NOBODY, WAVENUMBER, hall, isotropic, parse};

const FRAME_S: f64 = 0.064;

/// Field at a receiver's image relative to the transmitted field, without phase, and the path length: the specular
/// point's closed form.
fn specular_point_field(
    room: &BoxRoom,
    (tx, p): (&Element, ImageIndex),
    (rx, q): (&Element, ImageIndex),
    body: &Ellipsoid,
) -> (Complex64, f64) {
    let (source, sink) = (room.image_position(p, tx.position), room.image_position(q, rx.position));
    let specular = body.specular_point(source, sink, None).expect("visible");
    let incident = room.illuminate(tx, p, specular.point);
    let received_illumination = room.illuminate(rx, q, specular.point);
    let (r_t, r_r) = specular.distances_m;
    let reflected = reflect_at_skin(incident.field, -specular.towards.0, specular.normal);
    (
        reflected.received_by(received_illumination.field)
            * (0.5 * specular.cosine / (specular.det_j.sqrt() * r_t * r_r)),
        r_t + r_r,
    )
}

/// Radar 0.9 m beside a wall, and a body that moves and rotates in front of it.
struct BodyBesideWall {
    room: BoxRoom,
    tx: Element,
    rx: Element,
    semi_axes_m: DVec3,
}

impl BodyBesideWall {
    fn new(wall: Wall, semi_axes_m: DVec3) -> Self {
        let mut walls = [Wall::Open; 6];
        walls[2] = wall;
        let size_m = DVec3::new(6.0, 4.0, 3.0);
        // The polarisation is oblique, so that both polarisations contribute at the wall and at the body.
        let element = |position| isotropic(position, DVec3::new(0.0, 0.6, 0.8));
        BodyBesideWall {
            room: BoxRoom::new(size_m, walls, WAVENUMBER, false),
            tx: element(DVec3::new(0.3, 0.9, 1.4)),
            rx: element(DVec3::new(0.3, 0.9075, 1.4)),
            semi_axes_m,
        }
    }

    /// Body at a time of the frame: it approaches at 1.1 m/s and swings by 3 rad/s about an axis through one end.
    fn body(&self, time_s: f64) -> Ellipsoid {
        let axes = DMat3::from_rotation_z(0.2) * DMat3::from_rotation_y(0.15 + 3.0 * time_s);
        let joint = DVec3::new(2.4, 1.3, 1.4) + DVec3::new(-1.1, 0.2, 0.0) * time_s;
        Ellipsoid { centre: joint - axes * DVec3::Z * (0.6 * self.semi_axes_m.z), axes, semi_axes_m: self.semi_axes_m }
    }

    /// Closed form of the moving body ([`specular_point_field`]).
    fn specular_point(&self, p: ImageIndex, q: ImageIndex, time_s: f64) -> (Complex64, f64) {
        specular_point_field(&self.room, (&self.tx, p), (&self.rx, q), &self.body(time_s))
    }

    /// Same field from five samples of each half of the frame, with phase, as in the simulator at a chirp.
    fn field_from_path_samples(&self, p: ImageIndex, q: ImageIndex) -> impl Fn(f64) -> Complex64 {
        let (step_s, difference_s) = (0.5 * FRAME_S, 1e-4);
        let sample = |t: f64| {
            let (amplitude, length_m) = self.specular_point(p, q, t);
            let rate = (self.specular_point(p, q, t + difference_s).1 - self.specular_point(p, q, t - difference_s).1)
                / (2.0 * difference_s);
            let delay_s = length_m / SPEED_OF_LIGHT_M_PER_S;
            PathSample { delay_s, delay_rate: rate / SPEED_OF_LIGHT_M_PER_S, amplitude }
        };
        let segment = |begin_s: f64| {
            let samples = [0.0, 0.25, 0.5, 0.75, 1.0].map(|fraction| sample(begin_s + fraction * step_s));
            PathSegment::through(&samples, step_s, 60e9).0
        };
        let segments = [segment(0.0), segment(step_s)];
        move |time_s| {
            let interval = usize::from(time_s >= step_s);
            let u = time_s / step_s - interval as f64;
            let (delay_s, _) = segments[interval].delay(u);
            let a = segments[interval].amplitude(u);
            Complex64::new(a.re.into(), a.im.into())
                * Complex64::from_polar(1.0, -WAVENUMBER * delay_s * SPEED_OF_LIGHT_M_PER_S)
        }
    }

    /// Physical optics, summed densely over the illuminated surface: `-jk/(2 pi) int heard e^{-jk(R_t + R_r)}/(R_t R_r)
    /// dS`. Currents radiate from the whole illuminated surface. A cut-off at the receiver's horizon, where they are
    /// not yet zero, would add a nonphysical edge to the sum (half a decibel on the limb).
    fn physical_optics(&self, p: ImageIndex, q: ImageIndex, time_s: f64) -> Complex64 {
        let e = self.body(time_s);
        let b = e.semi_axes_m;
        // Step of a fifth of the phase period that the path length makes on the surface.
        let step_m = 0.5e-3;
        let rows = (PI * b.max_element() / step_m) as usize;
        let columns = (TAU * b.x.max(b.y) / step_m) as usize;
        let skin = Wall::HalfSpace { permittivity: SKIN_PERMITTIVITY };
        let row = |i: usize| {
            let theta = PI * (i as f64 + 0.5) / rows as f64;
            let mut sum = Complex64::ZERO;
            for j in 0..columns {
                let phi = TAU * (j as f64 + 0.5) / columns as f64;
                let unit = DVec3::new(theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos());
                let point = e.surface(unit);
                let gradient = unit / b;
                let normal = e.axes * gradient.normalize();
                let incident = self.room.image_position(p, self.tx.position) - point;
                if normal.dot(incident) <= 0.0 {
                    continue;
                }
                let incident = self.room.illuminate(&self.tx, p, point);
                let received_illumination = self.room.illuminate(&self.rx, q, point);
                let arrival = Arrival { field: incident.field, direction: incident.direction };
                let current = received(
                    &arrival,
                    normal,
                    &skin,
                    WAVENUMBER,
                    -received_illumination.direction,
                    received_illumination.field,
                );
                let area =
                    theta.sin() * b.element_product() * gradient.length() * (PI / rows as f64) * (TAU / columns as f64);
                let phase = -WAVENUMBER * (incident.distance_m + received_illumination.distance_m);
                sum += current
                    * Complex64::from_polar(area / (incident.distance_m * received_illumination.distance_m), phase);
            }
            sum
        };
        let rows: Vec<Complex64> = (0..rows).into_par_iter().map(row).collect();
        rows.into_iter().sum::<Complex64>() * Complex64::new(0.0, -WAVENUMBER / TAU)
    }
}

/// Limb and torso, walls of concrete and metal, by way of the wall on the way out or on the way back. Each chirp's echo
/// from path samples is within a tenth of a decibel of physical optics at that chirp; half a decibel is required. The
/// same holds for the sum of both orders in the frame's Doppler spectrum.
#[test]
fn a_body_by_way_of_a_wall_agrees_with_physical_optics_in_every_chirp() {
    let concrete =
        Wall::Slab { permittivity: Material::Concrete.permittivity(60e9).expect("dielectric"), thickness_m: 0.1 };
    let (direct, by_way_of_wall): (ImageIndex, ImageIndex) = ([0; 3], [0, -1, 0]);
    let limb = (DVec3::new(0.05, 0.05, 0.2), "limb", 12);
    let torso = (DVec3::new(0.115, 0.165, 0.22), "torso", 3);
    for (semi_axes_m, body, chirps) in [limb, torso] {
        for (wall, name) in [(concrete, "concrete"), (Wall::Conductor, "metal")] {
            let setup = BodyBesideWall::new(wall, semi_axes_m);
            let (mut sampled, mut exact) = (vec![Complex64::ZERO; chirps], vec![Complex64::ZERO; chirps]);
            for (p, q) in [(direct, by_way_of_wall), (by_way_of_wall, direct)] {
                let sampled_field = setup.field_from_path_samples(p, q);
                let (mut worst_db, mut worst_rad): (f64, f64) = (0.0, 0.0);
                for i in 0..chirps {
                    let time_s = FRAME_S * (i as f64 + 0.5) / chirps as f64;
                    let (a, b) = (sampled_field(time_s), setup.physical_optics(p, q, time_s));
                    worst_db = worst_db.max((20.0 * (a / b).norm().log10()).abs());
                    worst_rad = worst_rad.max((a / b).arg().abs());
                    sampled[i] += a;
                    exact[i] += b;
                }
                eprintln!("{body} by {name}, {p:?} to {q:?}: {worst_db:.3} dB, {worst_rad:.3} rad");
                assert!(worst_db < 0.1 && worst_rad < 0.02, "{body} by {name}, {p:?} to {q:?}: {worst_db} dB");
            }
            let spectrum = |x: &[Complex64], bin: usize| {
                let terms = x.iter().enumerate();
                terms
                    .map(|(i, v)| v * Complex64::from_polar(1.0, TAU * (i * bin) as f64 / chirps as f64))
                    .sum::<Complex64>()
            };
            let peak = (0..chirps).max_by(|&a, &b| spectrum(&exact, a).norm().total_cmp(&spectrum(&exact, b).norm()));
            let bin = peak.expect("bins");
            let error_db = 20.0 * (spectrum(&sampled, bin) / spectrum(&exact, bin)).norm().log10();
            eprintln!("{body} by {name}, both orders, Doppler peak: {error_db:.3} dB");
            assert!(error_db.abs() < 0.1, "{body} by {name}: {error_db} dB");
        }
    }
}

/// The simulated echo of a chest by way of a wall equals that closed form: field times aperture, link budget and
/// filter.
#[test]
fn simulated_echoes_by_way_of_a_wall_agree_with_the_closed_form() {
    let text = hall(NOBODY)
        .replace("y_low = { material = \"open\" }", "y_low = { material = \"concrete\" }")
        .replace("position_m = [1.0, 10.0, 1.2]", "position_m = [1.0, 1.5, 1.2]");
    let scene = parse(&text);
    let (room, prepared) = (scene.room(), PreparedScene::new(&scene, 0, 20.0));
    let motion = MotionBuilder::new(Person::draw(1, [0, 0], 1.75), 0.0, [4.0, 1.0], 3.0).stand(9.0).stay();
    let people = [Snapshot::new(&motion, 1.0)];
    let (tx, rx) = (prepared.tx, prepared.rx[0]);
    for pair in [([0; 3], [0, -1, 0]), ([0, -1, 0], [0; 3]), ([0, -1, 0], [0, -1, 0]), ([0; 3], [0; 3])] {
        let mut samples = Vec::new();
        echoes(&prepared, &motion, &people, 0, &[pair], &mut samples, &mut EchoReport::default());
        let sample = samples[CHEST * prepared.rx.len()];
        let (field, length_m) = specular_point_field(&room, (&tx, pair.0), (&rx, pair.1), &people[0].body[CHEST]);
        let aperture = prepared.wavelength_m / (4.0 * PI) * motion.person.cloth[CHEST];
        let expected = prepared.at_adc(0, field * aperture, prepared.chirp.beat_hz(sample.delay_s, sample.delay_rate));
        assert!((sample.amplitude / expected - 1.0).norm() < 1e-6, "{pair:?}: {} {expected}", sample.amplitude);
        assert!((sample.delay_s * SPEED_OF_LIGHT_M_PER_S - length_m).abs() < 1e-9, "{pair:?}");
    }
}
