//! Echoes of a person by paths over the scattering points of walls.
//!
//! All echoes of a segment consist of few legs: between it and each antenna, and between it and each point. A leg has a
//! length with two time derivatives, and a field; a path adds the lengths and multiplies the fields of its two legs.
//! The paths to further receivers differ only in the leg that ends at them.

use std::f64::consts::{FRAC_1_SQRT_2, PI};

use glam::DVec3;
use num_complex::Complex64;
use radome_dsp::SPEED_OF_LIGHT_M_PER_S;

use super::{Snapshot, inside_room};
use crate::diffuse::{LEAST_LEG_M, WallPoint};
use crate::em::image::Element;
use crate::em::{fresnel, specular::Ellipsoid};
use crate::material::SKIN_PERMITTIVITY;
use crate::people::body::{CHEST, SEGMENTS};
use crate::prepared_scene::PreparedScene;
use crate::synthesis::{HeldEcho, HeldEchoes};
use crate::tracks::OTHERS;

/// Part of the threshold of a single path below which paths are inaudible even together.
const HEARD: f64 = 0.1;
/// Offset of points before their walls in visibility tests, m.
const BEFORE_M: f64 = 1e-4;
/// Smallest number of points for a segment, if there are as many. Fewer and stronger echoes would appear in maps as
/// individual detections, like a second person.
const LEAST_POINTS: usize = 64;
/// Fractional part of the golden ratio, whose multiples are evenly distributed between 0 and 1.
const GOLDEN: f64 = 0.618_033_988_749_894_9;

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

/// Computes the surface area of an ellipsoid, m^2 (Knud Thomsen's formula, accurate to 1 %).
fn surface_m2(ellipsoid: &Ellipsoid) -> f64 {
    const P: f64 = 1.6075;
    let [a, b, c] = ellipsoid.semi_axes_m.to_array().map(|v| v.powf(P));
    4.0 * PI * ((a * b + a * c + b * c) / 3.0).powf(1.0 / P)
}

/// Returns the largest number of a person's diffuse echoes in an interval.
pub fn most_echoes(prepared: &PreparedScene, points_a_segment: usize) -> usize {
    /// Number of paths over a point.
    const WAYS: usize = 3;
    WAYS * SEGMENTS * points_a_segment.min(prepared.wall_points.len())
}

/// Adds a person's diffuse echoes to those of each interval of a frame. `own` is that person at the ends of the
/// intervals. Each segment of the body takes `points_a_segment` of the points, with echoes scaled so that the mean
/// power does not depend on that number.
pub fn add(prepared: &PreparedScene, points_a_segment: usize, own: &[&Snapshot], intervals: &mut [HeldEchoes]) {
    let points = &prepared.wall_points;
    let share = (points.len() as f64 / points_a_segment.max(1) as f64).sqrt();
    let segments: Vec<Segment> =
        (0..own.first().map_or(0, |now| now.body.len())).map(|s| Segment::new(prepared, own, s, share)).collect();
    let audible = audible(prepared, own, &segments);
    let (mut legs, mut keys) = (PointLegs::default(), Vec::new());
    // One pair of points stands for as many pairs as there are points.
    let weight = (points.len() as f64).sqrt();
    for (number, segment) in segments.iter().enumerate() {
        legs.clear(points.len(), own.len());
        for index in points_of(number, points_a_segment, points.len()) {
            let (Some(point), Some(audible)) = (points.get(index), audible.get(index)) else { continue };
            if *audible == [false; 3] {
                continue;
            }
            legs.find(segment, index, point);
            let partner = points.get(point.partner).filter(|_| audible[2]);
            if let Some(partner) = partner {
                legs.find(segment, point.partner, partner);
            }
            let own_legs = legs.of(index);
            let mut add = |way: Way, beside: &dyn Fn(usize, usize) -> Beside| {
                segment.add(prepared, &way, beside, &mut keys, intervals);
            };
            let phase = point.phase;
            if let (true, Some(back)) = (audible[0], segment.rx.first()) {
                let way = Way { legs: [own_legs, back], behind_m: point.there.0, scattered: point.there.1, phase };
                add(way, &|receiver, time| segment.beside(receiver, time));
            }
            if let (true, Some(first)) = (audible[1], point.back.first()) {
                let way = Way { legs: [&segment.tx, own_legs], behind_m: first.0, scattered: first.1, phase };
                add(way, &|receiver, _| beside_by_point(point, receiver));
            }
            if let Some((partner, first)) = partner.and_then(|partner| Some((partner, partner.back.first()?))) {
                let legs_of_partner = legs.of(point.partner);
                let (behind_m, scattered) = (point.there.0 + first.0, weight * point.there.1 * first.1);
                let phase = phase * partner.phase;
                add(Way { legs: [own_legs, legs_of_partner], behind_m, scattered, phase }, &|receiver, _| {
                    beside_by_point(partner, receiver)
                });
            }
        }
    }
}

/// Returns, for each point, whether its echoes may be audible on each of three paths: point and antenna, antenna and
/// point, point and partner. The bound uses the distance of the whole body.
fn audible(prepared: &PreparedScene, own: &[&Snapshot], segments: &[Segment]) -> Vec<[bool; 3]> {
    let chest = |now: &Snapshot| now.body[CHEST].centre;
    let reach = |now: &Snapshot| now.body.iter().map(|e| e.centre.distance(chest(now))).fold(0.0, f64::max);
    let reach_m = own.iter().map(|now| reach(now)).fold(0.0, f64::max);
    let near = |position: DVec3| {
        let distance_m = own.iter().map(|now| chest(now).distance(position)).fold(f64::INFINITY, f64::min);
        1.0 / (distance_m - reach_m).max(LEAST_LEG_M)
    };
    let strongest = segments.iter().flat_map(|segment| &segment.strength).copied().fold(0.0, f64::max);
    let least = HEARD * prepared.threshold_lsb / (prepared.lsb.first().copied().unwrap_or(0.0) * strongest).max(1e-300);
    let near_tx = near(prepared.tx.position);
    let near_rx = prepared.rx.first().map_or(0.0, |rx| near(rx.position));
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
    let back = |point: &WallPoint| point.back.first().map_or(0.0, |back| back.1);
    let bound = |(point, near): (&WallPoint, &f64)| {
        let partner = points.get(point.partner).map_or(0.0, back) * near_points.get(point.partner).unwrap_or(&0.0);
        let there = point.there.1 * near;
        [there * near_rx, back(point) * near * near_tx, weight * there * partner].map(|field| field >= least)
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
    /// Leg from the transmitter, by time.
    tx: Vec<Leg>,
    /// Leg to each receiver: `[receiver][time]`.
    rx: Vec<Vec<Leg>>,
    /// Gain of each receiver relative to the first.
    gains: Vec<f64>,
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

/// Difference of the path to another receiver from that to the first.
struct Beside {
    length_m: f64,
    ratio: f64,
}

/// Returns the difference of the path from a point to a receiver from that to the first receiver.
fn beside_by_point(point: &WallPoint, receiver: usize) -> Beside {
    match (point.back.first(), point.back.get(receiver)) {
        (Some(first), Some(own)) if first.1 > 0.0 => Beside { length_m: own.0 - first.0, ratio: own.1 / first.1 },
        _ => Beside { length_m: 0.0, ratio: 0.0 },
    }
}

/// Path from antenna to antenna over a segment.
struct Way<'a> {
    /// Legs at the segment, each by time.
    legs: [&'a [Leg]; 2],
    /// Length of the path between points and antennas, m.
    behind_m: f64,
    /// Product of the fields that its points scatter for unit fields, times m.
    scattered: f64,
    phase: Complex64,
}

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
            let scattered = now.body.get(segment).map_or(0.0, |e| (skin * surface_m2(e) / (16.0 * PI)).sqrt());
            // An antenna receives one polarisation of the diffuse field.
            share * scattered * aperture * FRAC_1_SQRT_2 * inside_room(prepared, now.centre(segment).0)
        };
        let lit: Vec<Scatterer> = own.iter().map(lit).collect();
        let legs = |antenna: &Element| lit.iter().map(|lit| Leg::from_antenna(prepared, lit, antenna)).collect();
        let first_lsb = prepared.lsb.first().copied().unwrap_or(1.0);
        Segment {
            strength: own.iter().map(strength).collect(),
            tx: legs(&prepared.tx),
            rx: prepared.rx.iter().map(legs).collect(),
            gains: prepared.lsb.iter().map(|lsb| lsb / first_lsb).collect(),
            lit,
        }
    }

    /// Returns the difference of the leg to a receiver from that to the first receiver at a time.
    fn beside(&self, receiver: usize, time: usize) -> Beside {
        let leg = |receiver: usize| self.rx.get(receiver).and_then(|legs| legs.get(time));
        match (leg(0), leg(receiver)) {
            (Some(first), Some(own)) if first.field > 0.0 => {
                Beside { length_m: own.length[0] - first.length[0], ratio: own.field / first.field }
            }
            _ => Beside { length_m: 0.0, ratio: 0.0 },
        }
    }

    /// Adds the echo of a path if it is audible at any of the times. `beside` is the difference of a receiver at a
    /// time.
    fn add(
        &self,
        prepared: &PreparedScene,
        way: &Way,
        beside: &dyn Fn(usize, usize) -> Beside,
        keys: &mut Vec<([f64; 3], Complex64)>,
        intervals: &mut [HeldEchoes],
    ) {
        let least = HEARD * prepared.threshold_lsb;
        let lsb = prepared.lsb.first().copied().unwrap_or(0.0);
        let legs = || way.legs[0].iter().zip(way.legs[1]);
        let strength = |(strength, (a, b)): (&f64, (&Leg, &Leg))| strength * a.field * b.field * way.scattered;
        // The filters only attenuate, so this bound precedes their evaluation.
        if self.strength.iter().zip(legs()).map(strength).all(|field| lsb * field < least) {
            return;
        }
        keys.clear();
        keys.extend(self.strength.iter().zip(legs()).map(|(by_segment, (a, b))| {
            let length = [0, 1, 2].map(|order| a.length[order] + b.length[order]);
            let delay = [length[0] + way.behind_m, length[1], length[2]].map(|l| l / SPEED_OF_LIGHT_M_PER_S);
            let field = way.phase * strength((by_segment, (a, b)));
            (delay, prepared.at_adc(0, field, prepared.chirp.beat_hz(delay[0], delay[1])))
        }));
        if keys.iter().all(|(_, amplitude)| amplitude.norm_sqr() < least * least) {
            return;
        }
        for (time, (ends, interval)) in keys.windows(2).zip(intervals).enumerate() {
            let mut others = [([0.0; 2], 0.0); OTHERS];
            for ((other, gain), receiver) in others.iter_mut().zip(self.gains.iter().skip(1)).zip(1..) {
                let [begin, end] = [time, time + 1].map(|time| beside(receiver, time));
                let delays_s = [begin.length_m, end.length_m].map(|length_m| length_m / SPEED_OF_LIGHT_M_PER_S);
                *other = (delays_s, gain * begin.ratio);
            }
            let [(begin, from), (end, to)] = [ends[0], ends[1]];
            interval.push(&HeldEcho { delay: [begin, end], amplitude: [from, to], others });
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

    /// The formula is exact for a sphere, and close for an elongated ellipsoid.
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
