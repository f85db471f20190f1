//! Diffuse echoes: what walls throw in all directions, by their roughness and by what hangs and stands on them, on its way to
//! somebody or back.
//!
//! A wall gives a share of the power that falls on it back by Lambert's law (Degli-Esposti, Fuschini, Vitucci and Falciasecca,
//! IEEE Transactions on Antennas and Propagation 55(1), 2007, section II: the square of their scattering coefficient S, for which
//! they and others measured 0.2 to 0.4 and more). Here it is made of points with random phases, which stay where they are; the
//! ways antenna, point, segment of a body, antenna, and their reverse, are paths as any others, so that their delays and
//! rates are those of the geometry. A segment scatters in all directions what falls on it, as a convex body does on average
//! over its directions: `|Gamma|^2 S / 4` for the surface S (Cauchy). Two diffuse legs in one path are left out: they carry the
//! square of what is little.

use std::f64::consts::{FRAC_1_SQRT_2, PI, TAU};

use glam::DVec3;
use num_complex::Complex64;
use radome_dsp::SPEED_OF_LIGHT_M_PER_S;
use rand::Rng;

use crate::echo::{Snapshot, inside_room};
use crate::field::image::{BoxRoom, Element, Wall};
use crate::field::{fresnel, highlight::Ellipsoid};
use crate::keys::Stretches;
use crate::random::{Purpose, generator};
use crate::scene::material::SKIN_PERMITTIVITY;
use crate::slow_time::{Bend, Key, Stretch};
use crate::stage::Stage;

/// No leg counts as shorter than this, m.
const LEAST_LEG_M: f64 = 0.3;
/// Paths weaker than this over the threshold of a path alone are not heard even together.
const HEARD: f64 = 0.1;

/// A point of a wall.
#[derive(Debug, Clone, PartialEq)]
pub struct WallPoint {
    position: DVec3,
    /// Into the room.
    normal: DVec3,
    /// Transmitter to point: length, m, and what of a unit field the point throws out, times m, but for the cosine on its way
    /// out.
    there: (f64, f64),
    /// The same for the way from the point to each receiver.
    back: Vec<(f64, f64)>,
    phase: Complex64,
}

/// So many points of a room, which throw back `share` of what falls on its walls.
pub fn wall_points(
    room: &BoxRoom,
    (share, count): (f64, usize),
    tx: &Element,
    rx: &[Element],
    seed: u64,
) -> Vec<WallPoint> {
    let size = room.size_m.to_array();
    let area = |wall: usize| match room.walls.get(wall) {
        Some(Wall::Open) | None => 0.0,
        Some(_) => (0..3).filter(|axis| *axis != wall / 2).map(|axis| size[axis]).product(),
    };
    let whole: f64 = (0..6).map(area).sum();
    if !(share > 0.0 && whole > 0.0) {
        return Vec::new();
    }
    let mut rng = generator(seed, Purpose::WallPoints, [0, 0]);
    let mut points = Vec::with_capacity(count);
    for index in 0..count {
        // One in each of as many equal parts of the walls.
        let mut at = (index as f64 + rng.random::<f64>()) / count as f64 * whole;
        let wall = (0..5).find(|wall| {
            let is_here = at < area(*wall);
            at -= if is_here { 0.0 } else { area(*wall) };
            is_here
        });
        let wall = wall.unwrap_or(5);
        let mut position = [0, 1, 2].map(|axis| size[axis] * rng.random::<f64>());
        position[wall / 2] = if wall % 2 == 0 { 0.0 } else { size[wall / 2] };
        let position = DVec3::from_array(position);
        let normal = DVec3::AXES[wall / 2] * if wall % 2 == 0 { 1.0 } else { -1.0 };
        // Lambert: of the power density S on dA goes `share S dA cos_in cos_out / (pi r^2)` out.
        let leg = |element: &Element| {
            let offset = position - element.position;
            let length_m = offset.length().max(LEAST_LEG_M);
            let direction = offset / length_m;
            let cosine = (-direction.dot(normal)).max(0.0);
            let gain = element.pattern.field(element.radar_from_world * direction);
            (length_m, gain * (share * whole / count as f64 * cosine / PI).sqrt() / length_m)
        };
        let phase = Complex64::from_polar(1.0, rng.random_range(0.0..TAU));
        points.push(WallPoint { position, normal, there: leg(tx), back: rx.iter().map(leg).collect(), phase });
    }
    points
}

/// Surface of an ellipsoid, m^2 (Knud Thomsen's formula, good to 1 %).
fn surface_m2(ellipsoid: &Ellipsoid) -> f64 {
    const P: f64 = 1.6075;
    let [a, b, c] = ellipsoid.semi_axes_m.to_array().map(|v| v.powf(P));
    4.0 * PI * ((a * b + a * c + b * c) / 3.0).powf(1.0 / P)
}

/// Adds somebody's diffuse echoes to the paths of each receiver: `at_ends` is everybody at the ends of the stretches, `stretch_s`
/// long each, that the frame is halved into so often.
pub fn add(
    stage: &Stage,
    at_ends: &[Vec<Snapshot>],
    me: usize,
    (halvings, stretch_s): (u32, f64),
    receivers: &mut [Stretches],
) {
    let own: Vec<&Snapshot> = at_ends.iter().filter_map(|people| people.get(me)).collect();
    let share = fresnel::half_space(SKIN_PERMITTIVITY, 1.0).te.norm_sqr();
    let least = HEARD * stage.threshold_lsb;
    for (rx, (receiver, out)) in stage.rx.iter().zip(receivers).enumerate() {
        for segment in 0..own.first().map_or(0, |snapshot| snapshot.body.len()) {
            for point in &stage.wall_points {
                let back = point.back.get(rx).copied().unwrap_or_default();
                for (antenna, leg) in [(receiver, point.there), (&stage.tx, back)] {
                    let keys: Vec<(Key, Bend)> =
                        own.iter().map(|now| key(stage, rx, now, segment, share, point, leg, antenna)).collect();
                    if keys.iter().all(|(key, _)| key.amplitude.norm() < least) {
                        continue;
                    }
                    for (place, ends) in keys.windows(2).enumerate() {
                        out.push(halvings, place, Stretch::between(&ends[0], &ends[1], stretch_s));
                    }
                }
            }
        }
    }
}

/// The path by way of a wall's point, whose `leg` to one antenna is known, and a segment to the other `antenna`.
#[allow(clippy::too_many_arguments)]
fn key(
    stage: &Stage,
    rx: usize,
    now: &Snapshot,
    segment: usize,
    share: f64,
    point: &WallPoint,
    (leg_m, thrown): (f64, f64),
    antenna: &Element,
) -> (Key, Bend) {
    let (centre, velocity, acceleration) = now.centre(segment);
    let (from_wall, to_antenna) = (centre - point.position, antenna.position - centre);
    let (wall_m, antenna_m) = (from_wall.length(), to_antenna.length());
    let (from, to) = (from_wall / wall_m.max(1e-9), to_antenna / antenna_m.max(1e-9));
    let delay_s = (leg_m + wall_m + antenna_m) / SPEED_OF_LIGHT_M_PER_S;
    let along = from - to;
    let delay_rate = along.dot(velocity) / SPEED_OF_LIGHT_M_PER_S;
    let aperture = stage.wavelength_m / (4.0 * PI);
    let scattered = now.body.get(segment).map_or(0.0, |e| (share * surface_m2(e) / (16.0 * PI)).sqrt());
    let gain = antenna.pattern.field(antenna.radar_from_world * -to);
    let out = from.dot(point.normal).max(0.0).sqrt();
    // Of what is thrown in all directions an antenna takes one polarisation.
    let strength = thrown * out * gain * aperture * scattered * FRAC_1_SQRT_2 * inside_room(stage, centre)
        / (wall_m.max(LEAST_LEG_M) * antenna_m.max(LEAST_LEG_M));
    let amplitude = stage.at_adc(rx, point.phase * strength, stage.chirp.beat_hz(delay_s, delay_rate));
    let bend = Bend { delay: [along.dot(acceleration) / SPEED_OF_LIGHT_M_PER_S, 0.0], ..Bend::default() };
    (Key { delay_s, delay_rate, amplitude }, bend)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::pattern::Pattern;

    /// What reaches a place by way of the points is on average what every piece of the walls throws there.
    #[test]
    fn points_throw_what_walls_do() {
        let room = BoxRoom {
            size_m: DVec3::new(5.0, 4.0, 2.6),
            walls: [Wall::Conductor, Wall::Conductor, Wall::Conductor, Wall::Open, Wall::Conductor, Wall::Conductor],
            wavenumber_per_m: 1257.0,
            transmission: false,
        };
        let antenna = Element {
            position: DVec3::new(1.0, 1.5, 1.2),
            polarisation: DVec3::Z,
            radar_from_world: glam::DMat3::IDENTITY,
            pattern: Pattern::new(1.1, 0.9, -15.0),
        };
        let (share, place) = (0.1, DVec3::new(3.2, 2.1, 1.0));
        let density = |position: DVec3, normal: DVec3, area_m2: f64| {
            let (there, on) = (position - antenna.position, place - position);
            let cosines = (-there.normalize().dot(normal)).max(0.0) * on.normalize().dot(normal).max(0.0);
            let gain = antenna.pattern.field(there.normalize()).powi(2);
            share * gain * area_m2 * cosines / (PI * there.length_squared() * on.length_squared())
        };
        let mut exact = 0.0;
        const CUTS: usize = 160;
        for wall in [0, 1, 2, 4, 5usize] {
            let (axis, size) = (wall / 2, room.size_m.to_array());
            let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
            let area_m2 = size[u] * size[v] / (CUTS * CUTS) as f64;
            for i in 0..CUTS * CUTS {
                let mut position = [0.0; 3];
                position[axis] = if wall % 2 == 0 { 0.0 } else { size[axis] };
                position[u] = size[u] * ((i % CUTS) as f64 + 0.5) / CUTS as f64;
                position[v] = size[v] * ((i / CUTS) as f64 + 0.5) / CUTS as f64;
                let normal = DVec3::AXES[axis] * if wall % 2 == 0 { 1.0 } else { -1.0 };
                exact += density(DVec3::from_array(position), normal, area_m2);
            }
        }
        const SEEDS: u64 = 3000;
        let drawn: f64 = (0..SEEDS)
            .flat_map(|seed| wall_points(&room, (share, 32), &antenna, &[], seed))
            .map(|point| {
                let on = place - point.position;
                point.there.1.powi(2) * on.normalize().dot(point.normal).max(0.0) / on.length_squared()
            })
            .sum();
        let ratio = drawn / SEEDS as f64 / exact;
        assert!((ratio - 1.0).abs() < 0.03, "{ratio}");
        assert!(wall_points(&room, (0.0, 32), &antenna, &[antenna], 1).is_empty());
    }

    /// A sphere is its own average; of a needle nothing is left but its side.
    #[test]
    fn surfaces_are_those_of_known_shapes() {
        let of = |axes: [f64; 3]| {
            surface_m2(&Ellipsoid {
                centre: DVec3::ZERO,
                axes: glam::DMat3::IDENTITY,
                semi_axes_m: DVec3::from_array(axes),
            })
        };
        assert!((of([0.3; 3]) / (4.0 * PI * 0.09) - 1.0).abs() < 1e-12);
        // Prolate 4 : 1, 2 pi a^2 (1 + c / (a e) asin e).
        let (a, c) = (0.1f64, 0.4f64);
        let e = (1.0 - a * a / (c * c)).sqrt();
        let exact = 2.0 * PI * a * a * (1.0 + c / (a * e) * e.asin());
        assert!((of([a, a, c]) / exact - 1.0).abs() < 0.012, "{}", of([a, a, c]) / exact);
    }
}
