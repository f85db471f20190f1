//! Echoes of a person by paths over the scattering points of walls.
//!
//! An echo travels from the antennas to a segment and back, by two of these ways: directly, or over one of the points.
//! The transmitter may use either of them and the receivers the other. Both directions have nearly the same length, so
//! they are one echo, whose amplitude at each receiver is their sum with their phases ([`AntennaPaths::both_ways`]).
//!
//! All ways end with few legs: between a segment and each antenna, and between it and each point. A leg has a length
//! with two time derivatives, and a field; an echo adds the lengths and multiplies the fields of its two ways.
//!
//! An echo weaker than a path that is invisible in any map matters by its mean power only. Of such echoes, a part is
//! taken that has the same mean power: each with a probability that is its power relative to that of the invisible path,
//! with the amplitude of that path.

use std::f64::consts::{FRAC_1_SQRT_2, PI};

use glam::DVec3;
use num_complex::Complex64;
use radome_dsp::SPEED_OF_LIGHT_M_PER_S;

use super::{Snapshot, inside_room};
use crate::diffuse::{AntennaPaths, BEFORE_M, GOLDEN, LEAST_LEG_M, WallPoint};
use crate::em::fresnel;
use crate::em::image::Element;
use crate::geometry::shape::ellipsoid_area_m2;
use crate::material::SKIN_PERMITTIVITY;
use crate::math::magnitude;
use crate::people::body::{CHEST, SEGMENTS};
use crate::prepared_scene::PreparedScene;
use crate::synthesis::{HeldEcho, HeldEchoes};
use crate::tracks::RECEIVERS;

/// Smallest number of points for a segment, if there are as many. Fewer and stronger echoes would appear in maps as
/// individual detections, like a second person.
const LEAST_POINTS: usize = 64;

/// Returns the number of the walls' points that each segment of a body takes at a tolerance: all of them up to 0.5 dB,
/// a quarter at 1 dB.
pub fn points_a_segment(points: usize, tolerance_db: f64) -> usize {
    let part = (0.5 / tolerance_db).powi(2);
    ((points as f64 * part).ceil() as usize).clamp(LEAST_POINTS.min(points), points)
}

/// Returns the indices of the points that a segment takes: evenly spread over all, with another offset for each
/// segment.
fn points_of(segment: usize, taken: usize, points: usize) -> impl Iterator<Item = usize> {
    let shift = (segment as f64 * GOLDEN).fract();
    (0..taken).map(move |i| ((i as f64 + shift) * points as f64 / taken as f64) as usize).filter(move |&i| i < points)
}

/// Returns the chances of a segment's echoes by way of a point, 0 to 1: with a direct way back, and by way of its partner.
/// An echo is taken if its power, relative to that of an invisible path, exceeds its chance. For all segments and points
/// the chances are spread evenly (Roberts's sequence, multiples of powers of the inverse plastic number).
fn chances(segment: usize, point: usize) -> [f64; 2] {
    const STEPS: [f64; 2] = [0.754_877_666_246_692_8, 0.569_840_290_998_053_3];
    let chance = (point as f64 * STEPS[0] + segment as f64 * STEPS[1]).fract();
    [chance, (chance + 0.5).fract()]
}

/// Returns the largest number of a person's diffuse echoes in an interval.
pub fn most_echoes(prepared: &PreparedScene, points_a_segment: usize) -> usize {
    /// Number of echoes for each point: by way of the point and directly, and half of an echo by way of two points.
    const ECHOES: usize = 2;
    ECHOES * SEGMENTS * points_a_segment.min(prepared.wall_points.len())
}

/// Adds a person's diffuse echoes to those of each interval of a frame. `own` is that person at the ends of the
/// intervals. Each segment of the body takes `points_a_segment` of the points, with echoes scaled so that the mean
/// power does not depend on that number.
pub fn add(prepared: &PreparedScene, points_a_segment: usize, own: &[&Snapshot], intervals: &mut [HeldEchoes]) {
    let points = &prepared.wall_points;
    let share = (points.len() as f64 / points_a_segment.max(1) as f64).sqrt();
    let segments: Vec<Segment> =
        (0..own.first().map_or(0, |now| now.body.len())).map(|s| Segment::new(prepared, own, s, share)).collect();
    let strongest = segments.iter().map(Segment::most_strength).fold(0.0, f64::max);
    let audible = audible(prepared, own, strongest);
    let (mut legs, mut keys) = (PointLegs::default(), Vec::new());
    // One pair of points stands for as many pairs as there are points.
    let weight = (points.len() as f64).sqrt();
    for (number, segment) in segments.iter().enumerate() {
        legs.clear(points.len(), own.len());
        let weaker = (segment.most_strength() / strongest.max(1e-300)).powi(2);
        for index in points_of(number, points_a_segment, points.len()) {
            let (Some(point), Some(&[alone, paired])) = (points.get(index), audible.get(index)) else { continue };
            let [chance, paired_chance] = chances(number, index);
            if alone * weaker > chance {
                legs.find(segment, index, point);
                let (legs, paths) = (legs.of(index), &point.antennas);
                let echo = |time: usize| {
                    let (leg, direct) = (legs.get(time)?, segment.antennas.get(time)?);
                    let length = [direct.length[0] + paths.length_m, direct.length[1], direct.length[2]];
                    let stronger = direct.paths.stronger_way(paths);
                    Some(leg.extended(length, stronger, direct.paths.both_ways(paths)))
                };
                segment.add(prepared, chance, echo, &mut keys, intervals);
            }
            let partner = point.partner.filter(|_| paired * weaker > paired_chance);
            if let Some((number, partner)) = partner.and_then(|number| Some((number, points.get(number)?))) {
                legs.find(segment, index, point);
                legs.find(segment, number, partner);
                let (own_legs, legs) = (legs.of(index), legs.of(number));
                let between_m = point.antennas.length_m + partner.antennas.length_m;
                let stronger = weight * point.antennas.stronger_way(&partner.antennas);
                let fields = point.antennas.both_ways(&partner.antennas).map(|field| weight * field);
                let echo = |time: usize| {
                    let (leg, back) = (own_legs.get(time)?, legs.get(time)?);
                    let length = [back.length[0] + between_m, back.length[1], back.length[2]];
                    Some(leg.extended(length, back.field * stronger, fields.map(|field| back.field * field)))
                };
                segment.add(prepared, paired_chance, echo, &mut keys, intervals);
            }
        }
    }
}

/// Bounds the power of the echoes over each point, relative to that of an invisible path: by way of the point and
/// directly, and by way of it and its partner. The bound uses the distance of the whole body, and the strength of its
/// strongest segment.
fn audible(prepared: &PreparedScene, own: &[&Snapshot], strongest: f64) -> Vec<[f64; 2]> {
    let chest = |now: &Snapshot| now.body[CHEST].centre;
    let reach = |now: &Snapshot| now.body.iter().map(|e| e.centre.distance(chest(now))).fold(0.0, f64::max);
    let reach_m = own.iter().map(|now| reach(now)).fold(0.0, f64::max);
    let near = |position: DVec3| {
        let distance_m = own.iter().map(|now| chest(now).distance(position)).fold(f64::INFINITY, f64::min);
        1.0 / (distance_m - reach_m).max(LEAST_LEG_M)
    };
    let relative = prepared.lsb.first().copied().unwrap_or(0.0) * strongest / prepared.threshold_lsb;
    let near_rx = prepared.rx.first().map_or(0.0, |rx| near(rx.position));
    let direct = AntennaPaths::new((0.0, near(prepared.tx.position)), &[(0.0, near_rx)], prepared.wavelength_m);
    let points = &prepared.wall_points;
    // Visibility from the middle of the body is decided once per frame, so that echoes over a point do not switch
    // within it.
    let middle = own.get(own.len() / 2).map_or(DVec3::ZERO, |now| chest(now));
    let seen = |point: &WallPoint| {
        let before = point.position + point.normal * BEFORE_M;
        if prepared.room.straight(before, middle) > 0.5 { 1.0 } else { 0.0 }
    };
    let near_points: Vec<f64> = points.iter().map(|point| near(point.position) * seen(point)).collect();
    let weight = (points.len() as f64).sqrt();
    let bound = |(point, near): (&WallPoint, &f64)| {
        let by_two = |partner: usize| {
            let field = points.get(partner).map_or(0.0, |other| point.antennas.stronger_way(&other.antennas));
            weight * field * near_points.get(partner).unwrap_or(&0.0)
        };
        let fields = [point.antennas.stronger_way(&direct), point.partner.map_or(0.0, by_two)];
        fields.map(|field| (field * near * relative).powi(2))
    };
    points.iter().zip(&near_points).map(bound).collect()
}

/// Leg between an antenna or a point and the middle of a segment, at one time.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Leg {
    /// Length, m, and its first and second time derivative.
    length: [f64; 3],
    /// Field at the segment for a unit field at 1 m.
    field: f64,
}

impl Leg {
    /// Computes a leg from a position that radiates a field, times m, in a direction.
    fn new(lit: &Scatterer, from: DVec3, sends: impl Fn(DVec3) -> f64) -> Self {
        let offset = lit.centre - from;
        let distance_m = offset.length();
        let direction = offset / distance_m.max(1e-9);
        let least_m = distance_m.max(LEAST_LEG_M);
        let rate = direction.dot(lit.velocity);
        // Transverse motion increases the second derivative.
        let across = (lit.velocity.length_squared() - rate * rate) / least_m;
        let length = [distance_m, rate, direction.dot(lit.acceleration) + across];
        Leg { length, field: sends(direction) / least_m }
    }

    /// Returns the echo over this leg and a way back of this length, with the field at the first receiver in the stronger
    /// direction, and the field at each receiver.
    fn extended(&self, length: [f64; 3], stronger: f64, fields: [Complex64; RECEIVERS]) -> Echo {
        let length = std::array::from_fn(|order| self.length[order] + length[order]);
        Echo { length, stronger: self.field * stronger, fields: fields.map(|field| self.field * field) }
    }

    fn from_antenna(prepared: &PreparedScene, lit: &Scatterer, antenna: &Element) -> Self {
        let straight = prepared.room.straight(antenna.position, lit.centre);
        let sends = |direction: DVec3| antenna.pattern.field(antenna.radar_from_world * direction) * straight;
        Leg::new(lit, antenna.position, sends)
    }

    fn from_point(lit: &Scatterer, point: &WallPoint) -> Self {
        Leg::new(lit, point.position, |direction| direction.dot(point.normal).max(0.0).sqrt())
    }
}

/// Motion of a segment at one time.
struct Scatterer {
    centre: DVec3,
    velocity: DVec3,
    acceleration: DVec3,
}

/// Segment at the ends of a frame's intervals.
struct Segment {
    lit: Vec<Scatterer>,
    /// Amplitude of its echo at an antenna for unit fields on both legs, by time.
    strength: Vec<f64>,
    /// Direct paths to the antennas, by time.
    antennas: Vec<DirectPaths>,
    /// Gain of each receiver relative to the first.
    gains: [f64; RECEIVERS],
}

/// Direct paths between a segment and the antennas at one time.
struct DirectPaths {
    paths: AntennaPaths,
    /// Their mean length, m, and its first and second time derivative.
    length: [f64; 3],
}

impl DirectPaths {
    fn new(prepared: &PreparedScene, lit: &Scatterer) -> Self {
        let leg = |antenna: &Element| Leg::from_antenna(prepared, lit, antenna);
        let (tx, rx) = (leg(&prepared.tx), prepared.rx.iter().map(leg).collect::<Vec<Leg>>());
        let first = rx.first().unwrap_or(&tx);
        let length = std::array::from_fn(|order| 0.5 * (tx.length[order] + first.length[order]));
        let path = |leg: &Leg| (leg.length[0], leg.field);
        let fields: Vec<(f64, f64)> = rx.iter().map(path).collect();
        DirectPaths { paths: AntennaPaths::new(path(&tx), &fields, prepared.wavelength_m), length }
    }
}

/// Legs between a segment and the walls' points. Each is computed once, although a point is also the partner of
/// another.
#[derive(Default)]
struct PointLegs {
    /// `[point][time]`.
    legs: Vec<Leg>,
    is_known: Vec<bool>,
    times: usize,
}

impl PointLegs {
    /// Resets to no legs, for a number of points and times.
    fn clear(&mut self, points: usize, times: usize) {
        const NONE: Leg = Leg { length: [0.0; 3], field: 0.0 };
        self.legs.resize(points * times, NONE);
        self.is_known.clear();
        self.is_known.resize(points, false);
        self.times = times;
    }

    /// Computes the legs of a point, unless they are known.
    fn find(&mut self, segment: &Segment, index: usize, point: &WallPoint) {
        let Some(is_known) = self.is_known.get_mut(index).filter(|known| !**known) else { return };
        *is_known = true;
        let legs = self.legs.iter_mut().skip(index * self.times);
        for (leg, lit) in legs.zip(&segment.lit) {
            *leg = Leg::from_point(lit, point);
        }
    }

    /// Returns the legs of a point, by time.
    fn of(&self, index: usize) -> &[Leg] {
        self.legs.get(index * self.times..(index + 1) * self.times).unwrap_or(&[])
    }
}

/// Echo at one time, for a segment that reflects every field without loss.
struct Echo {
    /// Length of its path, m, and its first and second time derivative.
    length: [f64; 3],
    /// Field at the first receiver by the stronger direction of the path alone.
    stronger: f64,
    /// Field at each receiver.
    fields: [Complex64; RECEIVERS],
}

/// Delay of an echo, s, with two derivatives, and its amplitude at each receiver, LSB.
type Key = ([f64; 3], [Complex64; RECEIVERS]);

impl Segment {
    /// Builds a segment of a person. `share` is the amplitude factor that compensates for the reduced number of points.
    fn new(prepared: &PreparedScene, own: &[&Snapshot], segment: usize, share: f64) -> Self {
        let skin = fresnel::half_space(SKIN_PERMITTIVITY, 1.0).te.norm_sqr();
        let aperture = prepared.aperture_m();
        let lit = |now: &&Snapshot| {
            let (centre, velocity, acceleration) = now.centre(segment);
            Scatterer { centre, velocity, acceleration }
        };
        let strength = |now: &&Snapshot| {
            let area_m2 = now.body.get(segment).map_or(0.0, |e| ellipsoid_area_m2(e.semi_axes_m));
            let scattered = (skin * area_m2 / (16.0 * PI)).sqrt();
            // An antenna receives one polarisation of the diffuse field.
            share * scattered * aperture * FRAC_1_SQRT_2 * inside_room(prepared, now.centre(segment).0)
        };
        let lit: Vec<Scatterer> = own.iter().map(lit).collect();
        let first_lsb = prepared.lsb.first().copied().unwrap_or(1.0);
        let mut gains = [0.0; RECEIVERS];
        gains.iter_mut().zip(&prepared.lsb).for_each(|(gain, lsb)| *gain = lsb / first_lsb);
        let antennas = lit.iter().map(|lit| DirectPaths::new(prepared, lit)).collect();
        Segment { strength: own.iter().map(strength).collect(), antennas, gains, lit }
    }

    /// Largest amplitude at an antenna for unit fields on both legs.
    fn most_strength(&self) -> f64 {
        self.strength.iter().copied().fold(0.0, f64::max)
    }

    /// Adds an echo, given at each time, if its largest power exceeds its chance ([`chances`]).
    fn add(
        &self,
        prepared: &PreparedScene,
        chance: f64,
        echo: impl Fn(usize) -> Option<Echo>,
        keys: &mut Vec<Key>,
        intervals: &mut [HeldEchoes],
    ) {
        let lsb = prepared.lsb.first().copied().unwrap_or(0.0);
        let relative = |amplitude_lsb: f64| (amplitude_lsb / prepared.threshold_lsb).powi(2);
        let echoes = || self.strength.iter().enumerate().filter_map(|(time, strength)| Some((strength, echo(time)?)));
        // The filters only attenuate, so this bound precedes their evaluation.
        if echoes().all(|(strength, echo)| relative(lsb * strength * echo.stronger) <= chance) {
            return;
        }
        keys.clear();
        let mut power = 0f64;
        keys.extend(echoes().map(|(strength, echo)| {
            let delay = echo.length.map(|l| l / SPEED_OF_LIGHT_M_PER_S);
            let beat_hz = prepared.chirp.beat_hz(delay[0], delay[1]);
            let factor = prepared.at_adc(0, Complex64::new(*strength, 0.0), beat_hz);
            power = power.max(relative(magnitude(factor) * echo.stronger));
            (delay, std::array::from_fn(|receiver| factor * echo.fields[receiver] * self.gains[receiver]))
        }));
        if power <= chance {
            return;
        }
        let louder = power.sqrt().recip().max(1.0);
        for (ends, interval) in keys.windows(2).zip(intervals) {
            let [(begin, from), (end, to)] = [ends[0], ends[1]];
            let amplitudes = std::array::from_fn(|receiver| [from[receiver], to[receiver]].map(|end| end * louder));
            interval.push(&HeldEcho { delay: [begin, end], amplitudes });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Subsets cover all points evenly, and all of them at a tight tolerance.
    #[test]
    fn segments_take_points_evenly() {
        assert_eq!([0.1, 0.5, 0.75, 1.0, 5.0].map(|db| points_a_segment(256, db)), [256, 256, 114, 64, 64]);
        assert_eq!([0.5, 5.0].map(|db| points_a_segment(64, db)), [64, 64]);
        assert!(points_of(5, 100, 100).eq(0..100));
        let mut taken = [0; 256];
        for segment in 0..13 {
            let points: Vec<usize> = points_of(segment, 64, 256).collect();
            assert!(points.len() == 64 && points.windows(2).all(|two| two[1] - two[0] == 4), "{points:?}");
            points.iter().for_each(|&point| taken[point] += 1);
        }
        assert!(taken.iter().all(|&times| (2..=4).contains(&times)), "{taken:?}");
    }

    /// A leg's derivatives are those of its length.
    #[test]
    fn legs_bend_as_their_lengths_do() {
        let (velocity, acceleration) = (DVec3::new(1.0, -2.0, 0.5), DVec3::new(-4.0, 3.0, 9.0));
        let at = |time_s: f64| {
            let centre = DVec3::new(1.0, 0.4, 1.0) + velocity * time_s + 0.5 * acceleration * time_s * time_s;
            Leg::new(&Scatterer { centre, velocity, acceleration }, DVec3::new(3.0, 1.0, 0.0), |_| 1.0).length
        };
        let h = 1e-4;
        let [before, now, after] = [-h, 0.0, h].map(|time_s| at(time_s)[0]);
        let [length, rate, bend] = at(0.0);
        assert_eq!(length, now);
        assert!((rate - (after - before) / (2.0 * h)).abs() < 1e-6, "{rate}");
        assert!((bend - (after - 2.0 * now + before) / (h * h)).abs() < 1e-5, "{bend}");
    }

    /// Compares the echo over a point and directly, in both directions together, with separate paths from the transmitter
    /// to each receiver: at one time, and between the ends of an interval of 25 ms, in which a walker passes at 1 m.
    #[test]
    fn both_directions_are_one_echo() {
        const WAVELENGTH_M: f64 = 0.005;
        let tx = DVec3::new(0.0, 0.0, 1.1);
        let rx = [[0.0, 0.006, 1.1], [0.0, 0.006, 1.1025], [0.0, 0.0085, 1.1]].map(DVec3::from_array);
        let legs_to = |place: DVec3| -> (f64, [f64; 3]) { (tx.distance(place), rx.map(|rx| rx.distance(place))) };
        let paths = |place: DVec3| {
            let (there, back) = legs_to(place);
            AntennaPaths::new((there, 0.6), &back.map(|length_m| (length_m, 0.5)), WAVELENGTH_M)
        };
        let turned = |length_m: f64| Complex64::from_polar(1.0, 2.0 * PI * length_m / WAVELENGTH_M);
        let point = DVec3::new(2.5, 1.8, 0.4);
        let body = |u: f64| DVec3::new(0.9, -0.2 + 1.5 * 0.025 * u, 1.3);
        let separate = |u: f64, receiver: usize| {
            let ((a, b), (c, d)) = (legs_to(body(u)), legs_to(point));
            0.3 * (turned(a + d[receiver]) + turned(c + b[receiver])) * turned(body(u).distance(point))
        };
        let together = |u: f64, fields: [Complex64; RECEIVERS], receiver: usize| {
            let mean_m = paths(body(u)).length_m + paths(point).length_m;
            turned(mean_m + body(u).distance(point)) * fields[receiver]
        };
        let fields = |u: f64| paths(body(u)).both_ways(&paths(point));
        let [begin, end] = [0.0, 1.0].map(fields);
        for receiver in 0..RECEIVERS {
            for u in [0.0, 0.3, 0.5, 1.0] {
                let exact = separate(u, receiver);
                assert!((together(u, fields(u), receiver) - exact).norm() < 1e-9, "{receiver}, {u}");
                let between = std::array::from_fn(|r| begin[r] + (end[r] - begin[r]) * u);
                let error = (together(u, between, receiver) - exact).norm() / 0.6;
                assert!(error < 0.02, "{receiver}, {u}: {error}");
            }
        }
    }
}
