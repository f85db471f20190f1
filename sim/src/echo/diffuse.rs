//! Echoes of a person by paths over the scattering points of walls.
//!
//! An echo consists of two one-way paths between the antennas and a segment, each directly or over one of the points.
//! The transmitter may use either of them and the receivers the other. Both directions have nearly the same length, so
//! they are one echo. Its amplitude at each receiver is the sum of both with their phases
//! ([`AntennaPaths::both_ways`]).
//!
//! All paths end with one of few legs: between a segment and an antenna, or between it and a point. A leg has a length
//! with two time derivatives, and a field. An echo adds the lengths and multiplies the fields of its two legs.
//!
//! An echo weaker than a path that is invisible in any map matters by its mean power only. Of such echoes, only a part
//! is computed, with the same mean power ([`Thinning`]). An echo is computed if its power, relative to that of the
//! invisible path, exceeds a number from an even sequence. It then has the amplitude of that path.

use std::f64::consts::{FRAC_1_SQRT_2, PI};

use glam::DVec3;
use num_complex::Complex64;
use radome_dsp::KernelLevel;

use super::diffuse_legs::{EchoRows, Leg, LegRows, Scatterer, legs, two_leg_echoes};
use super::{Snapshot, inside_room};
use crate::diffuse::{AntennaPaths, BEFORE_M, GOLDEN, LEAST_LEG_M, WallPoint};
use crate::em::fresnel;
use crate::em::image::Element;
use crate::geometry::shape::ellipsoid_area_m2;
use crate::lanes::WIDE;
use crate::lanes::vector::store;
use crate::material::SKIN_PERMITTIVITY;
use crate::people::body::{CHEST, SEGMENTS};
use crate::prepared_scene::PreparedScene;
use crate::synthesis::{HeldEcho, HeldEchoes};
use crate::tracks::RECEIVERS;

/// Smallest number of points for a segment, if there are as many. Fewer and stronger echoes would appear in maps as
/// individual detections, like a second person.
const MIN_POINTS: usize = 64;

/// Tolerance up to which the echoes of all points are computed, dB.
const ALL_POINTS_DB: f64 = 0.5;

/// Part of the diffuse echoes that is computed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Thinning {
    /// Number of the walls' points that each segment of a body takes.
    points_per_segment: usize,
    /// Amplitude at the ADC of a path that is invisible in any map, LSB.
    invisible_lsb: f64,
}

impl Thinning {
    /// Takes all points up to 0.5 dB, and a quarter of them at 1 dB. `threshold_lsb` is the amplitude below which a
    /// path may be neglected at the tolerance. At coarser tolerances than 0.5 dB such a path is visible, so that the
    /// invisible amplitude is the threshold of 0.5 dB.
    pub fn new(points: usize, tolerance_db: f64, threshold_lsb: f64) -> Self {
        let fraction = (ALL_POINTS_DB / tolerance_db).powi(2);
        Thinning {
            points_per_segment: ((points as f64 * fraction).ceil() as usize).clamp(MIN_POINTS.min(points), points),
            invisible_lsb: threshold_lsb * (ALL_POINTS_DB / tolerance_db).min(1.0),
        }
    }

    /// Returns the largest number of a person's diffuse echoes in an interval.
    pub fn max_echoes(&self) -> usize {
        /// Number of echoes for each point, rounded up: one by way of the point and directly, and half of one by way of
        /// two points.
        const ECHOES: usize = 2;
        ECHOES * SEGMENTS * self.points_per_segment
    }
}

/// Returns the indices of the points that a segment takes: evenly spread over all, with another offset for each
/// segment.
fn points_of(segment: usize, taken: usize, points: usize) -> impl Iterator<Item = usize> {
    let shift = (segment as f64 * GOLDEN).fract();
    (0..taken).map(move |i| ((i as f64 + shift) * points as f64 / taken as f64) as usize).filter(move |&i| i < points)
}

/// Returns the draws, 0 to 1, for a segment's echoes by way of one of the points that it takes: with a direct other
/// path, and by way of the point's partner. An echo is computed if its power, relative to that of an invisible path,
/// exceeds its draw. `rank` is the index of the point among those that the segment takes. Over all segments and ranks
/// the draws are spread evenly (Roberts's sequence, multiples of powers of the inverse plastic number).
fn draws(segment: usize, rank: usize) -> [f64; 2] {
    const STEPS: [f64; 2] = [0.754_877_666_246_692_8, 0.569_840_290_998_053_3];
    let draw = (0.5 + rank as f64 * STEPS[0] + segment as f64 * STEPS[1]).fract();
    [draw, (draw + 0.5).fract()]
}

/// Adds a person's diffuse echoes to those of each interval of a frame. `snapshots` is that person at the ends of the
/// intervals. Echoes are scaled so that the mean power does not depend on the part of them that is computed.
pub fn add(prepared: &PreparedScene, thinning: &Thinning, snapshots: &[&Snapshot], intervals: &mut [HeldEchoes]) {
    let (points, points_per_segment) = (&prepared.wall_points, thinning.points_per_segment);
    let share = (points.len() as f64 / points_per_segment.max(1) as f64).sqrt();
    let segments: Vec<Segment> = (0..snapshots.first().map_or(0, |now| now.body.len()))
        .map(|s| Segment::new(prepared, snapshots, s, share))
        .collect();
    let strongest = segments.iter().map(Segment::max_strength).fold(0.0, f64::max);
    let bounds = power_bounds(prepared, thinning, snapshots, strongest);
    // Paths over one point, and over two.
    let mut paths: [Vec<WallPath>; 2] = Default::default();
    for (number, segment) in segments.iter().enumerate() {
        paths.iter_mut().for_each(Vec::clear);
        let weaker = (segment.max_strength() / strongest.max(1e-300)).powi(2);
        for (rank, index) in points_of(number, points_per_segment, points.len()).enumerate() {
            let (Some(point), Some(&[alone, paired])) = (points.get(index), bounds.get(index)) else { continue };
            let [draw, paired_draw] = draws(number, rank);
            if alone * weaker > draw {
                paths[0].push(WallPath { point, partner: None, draw });
            }
            let partner = point.partner.filter(|_| paired * weaker > paired_draw);
            if let Some(partner) = partner.and_then(|number| points.get(number)) {
                paths[1].push(WallPath { point, partner: Some(partner), draw: paired_draw });
            }
        }
        for lanes in paths.iter().flat_map(|of_kind| of_kind.chunks(WIDE)) {
            segment.add(prepared, thinning, lanes, intervals);
        }
    }
}

/// Path over a point, or over it and its partner. Its echo is computed if its power exceeds its draw.
struct WallPath<'a> {
    point: &'a WallPoint,
    partner: Option<&'a WallPoint>,
    draw: f64,
}

impl WallPath<'_> {
    /// Returns the length between the legs other than those to the segment, m.
    fn between_m(&self) -> f64 {
        self.point.antennas.length_m + self.partner.map_or(0.0, |partner| partner.antennas.length_m)
    }

    /// Returns the paths to the antennas at the path's second end, and a factor of the field. `direct` is the segment's
    /// direct path.
    fn second_end<'a>(&'a self, direct: &'a DirectPaths, points: usize) -> (&'a AntennaPaths, f64) {
        match self.partner {
            None => (&direct.paths, 1.0),
            // One pair of points stands for as many pairs as there are points.
            Some(partner) => (&partner.antennas, (points as f64).sqrt()),
        }
    }
}

/// Bounds the power of the echoes over each point, relative to that of an invisible path: by way of the point and
/// directly, and by way of it and its partner. The bound uses the distance of the whole body, and the strength of its
/// strongest segment.
fn power_bounds(
    prepared: &PreparedScene,
    thinning: &Thinning,
    snapshots: &[&Snapshot],
    strongest: f64,
) -> Vec<[f64; 2]> {
    let chest = |now: &Snapshot| now.body[CHEST].centre;
    let reach = |now: &Snapshot| now.body.iter().map(|e| e.centre.distance(chest(now))).fold(0.0, f64::max);
    let reach_m = snapshots.iter().map(|now| reach(now)).fold(0.0, f64::max);
    let near = |position: DVec3| {
        let distance_m = snapshots.iter().map(|now| chest(now).distance(position)).fold(f64::INFINITY, f64::min);
        1.0 / (distance_m - reach_m).max(LEAST_LEG_M)
    };
    let relative = prepared.lsb.first().copied().unwrap_or(0.0) * strongest / thinning.invisible_lsb;
    let near_rx = prepared.rx.first().map_or(0.0, |rx| near(rx.position));
    let direct = AntennaPaths::new((0.0, near(prepared.tx.position)), &[(0.0, near_rx)], prepared.wavelength_m);
    let points = &prepared.wall_points;
    // Visibility from the middle of the body is decided once per frame, so that echoes over a point do not switch
    // within it.
    let middle = snapshots.get(snapshots.len() / 2).map_or(DVec3::ZERO, |now| chest(now));
    let is_visible = |point: &WallPoint| {
        let before = point.position + point.normal * BEFORE_M;
        if prepared.room.field_on_segment(before, middle) > 0.5 { 1.0 } else { 0.0 }
    };
    let near_points: Vec<f64> = points.iter().map(|point| near(point.position) * is_visible(point)).collect();
    let weight = (points.len() as f64).sqrt();
    let bound = |(point, near): (&WallPoint, &f64)| {
        let by_two = |partner: usize| {
            let field = points.get(partner).map_or(0.0, |other| point.antennas.stronger_field(&other.antennas));
            weight * field * near_points.get(partner).unwrap_or(&0.0)
        };
        let fields = [point.antennas.stronger_field(&direct), point.partner.map_or(0.0, by_two)];
        fields.map(|field| (field * near * relative).powi(2))
    };
    points.iter().zip(&near_points).map(bound).collect()
}

/// Segment at the ends of a frame's intervals.
struct Segment {
    /// Its motion, by time.
    scatterers: Vec<Scatterer>,
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
    fn new(prepared: &PreparedScene, scatterer: &Scatterer) -> Self {
        let leg = |antenna: &Element| Leg::from_antenna(prepared, scatterer, antenna);
        let (tx, rx) = (leg(&prepared.tx), prepared.rx.iter().map(leg).collect::<Vec<Leg>>());
        let first = rx.first().unwrap_or(&tx);
        let length = std::array::from_fn(|order| 0.5 * (tx.length[order] + first.length[order]));
        let path = |leg: &Leg| (leg.length[0], leg.field);
        let fields: Vec<(f64, f64)> = rx.iter().map(path).collect();
        DirectPaths { paths: AntennaPaths::new(path(&tx), &fields, prepared.wavelength_m), length }
    }
}

/// Echo at one time.
struct EchoState {
    /// Delay, s, with two derivatives.
    delay: [f64; 3],
    /// Amplitude at each receiver, LSB.
    amplitudes: [Complex64; RECEIVERS],
}

impl Segment {
    /// Builds a segment of a person. `share` is the amplitude factor that compensates for the reduced number of points.
    fn new(prepared: &PreparedScene, snapshots: &[&Snapshot], segment: usize, share: f64) -> Self {
        let skin = fresnel::half_space(SKIN_PERMITTIVITY, 1.0).te.norm_sqr();
        let aperture = prepared.aperture_m();
        let scatterer = |now: &&Snapshot| {
            let (centre, velocity, acceleration) = now.centre(segment);
            Scatterer { centre, velocity, acceleration }
        };
        let strength = |now: &&Snapshot| {
            let area_m2 = now.body.get(segment).map_or(0.0, |e| ellipsoid_area_m2(e.semi_axes_m));
            let scattered = (skin * area_m2 / (16.0 * PI)).sqrt();
            // An antenna receives one polarisation of the diffuse field.
            share * scattered * aperture * FRAC_1_SQRT_2 * inside_room(prepared, now.centre(segment).0)
        };
        let scatterers: Vec<Scatterer> = snapshots.iter().map(scatterer).collect();
        let first_lsb = prepared.lsb.first().copied().unwrap_or(1.0);
        let mut gains = [0.0; RECEIVERS];
        gains.iter_mut().zip(&prepared.lsb).for_each(|(gain, lsb)| *gain = lsb / first_lsb);
        let antennas = scatterers.iter().map(|scatterer| DirectPaths::new(prepared, scatterer)).collect();
        Segment { strength: snapshots.iter().map(strength).collect(), antennas, gains, scatterers }
    }

    /// Largest amplitude at an antenna for unit fields on both legs.
    fn max_strength(&self) -> f64 {
        self.strength.iter().copied().fold(0.0, f64::max)
    }

    /// Adds echoes, one per lane and all of one kind, whose largest power exceeds their draw ([`draws`]).
    fn add(&self, prepared: &PreparedScene, thinning: &Thinning, paths: &[WallPath], intervals: &mut [HeldEchoes]) {
        let Some(first) = paths.first() else { return };
        let (level, lsb) = (KernelLevel::detect(), prepared.lsb.first().copied().unwrap_or(0.0));
        let rows = |of: &dyn Fn(&WallPath) -> Option<DVec3>| {
            let mut rows = [[0.0; WIDE]; 3];
            for l in 0..WIDE {
                // Unused lanes repeat the first path.
                store(&mut rows, l, of(paths.get(l).unwrap_or(first)).unwrap_or_default().to_array());
            }
            rows
        };
        let ends = [rows(&|path| Some(path.point.position)), rows(&|path| Some(path.point.normal))];
        let is_paired = first.partner.is_some();
        let partners =
            is_paired.then(|| [rows(&|path| Some(path.partner?.position)), rows(&|path| Some(path.partner?.normal))]);
        let mut between_m = [0.0; WIDE];
        between_m.iter_mut().zip(paths).for_each(|(between_m, path)| *between_m = path.between_m());
        let points = prepared.wall_points.len();
        let mut power = [0f64; WIDE];
        let mut times = Vec::with_capacity(self.scatterers.len());
        for ((scatterer, strength), direct) in self.scatterers.iter().zip(&self.strength).zip(&self.antennas) {
            let (mut outbound, mut inbound) = (LegRows::default(), LegRows::of_all(direct.length, 1.0));
            legs(level, scatterer, &ends, &mut outbound);
            if let Some(partners) = &partners {
                legs(level, scatterer, partners, &mut inbound);
            }
            let mut echoes = EchoRows::default();
            two_leg_echoes(level, prepared, lsb * strength, [&outbound, &inbound], &between_m, &mut echoes);
            for (l, (power, path)) in power.iter_mut().zip(paths).enumerate() {
                let (antennas, factor) = path.second_end(direct, points);
                let stronger = factor * path.point.antennas.stronger_field(antennas) / thinning.invisible_lsb;
                *power = power.max(echoes.power[l] * stronger * stronger);
            }
            times.push(echoes);
        }
        for (l, (&power, path)) in power.iter().zip(paths).enumerate().filter(|(_, (power, path))| **power > path.draw)
        {
            let louder = power.sqrt().recip().max(1.0);
            let state = |(echoes, direct): (&EchoRows, &DirectPaths)| -> EchoState {
                let (antennas, factor) = path.second_end(direct, points);
                let fields = path.point.antennas.both_ways(antennas);
                let amplitude = Complex64::new(echoes.amplitude[0][l], echoes.amplitude[1][l]) * (factor * louder);
                let gained = |receiver: usize| amplitude * fields[receiver] * self.gains[receiver];
                EchoState { delay: echoes.delay.map(|row| row[l]), amplitudes: std::array::from_fn(gained) }
            };
            let mut states = times.iter().zip(&self.antennas).map(state);
            let Some(mut begin) = states.next() else { continue };
            for (end, interval) in states.zip(intervals.iter_mut()) {
                let amplitudes = std::array::from_fn(|receiver| [begin.amplitudes[receiver], end.amplitudes[receiver]]);
                interval.push(&HeldEcho { delay: [begin.delay, end.delay], amplitudes });
                begin = end;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Subsets cover all points evenly, and all of them at a tight tolerance.
    #[test]
    fn segments_take_points_evenly() {
        let thinning = |points: usize, tolerance_db: f64| Thinning::new(points, tolerance_db, 2.0 * tolerance_db);
        let points = |thinning: Thinning| thinning.points_per_segment;
        assert_eq!([0.1, 0.5, 0.75, 1.0, 5.0].map(|db| points(thinning(256, db))), [256, 256, 114, 64, 64]);
        assert_eq!([0.5, 5.0].map(|db| points(thinning(64, db))), [64, 64]);
        assert_eq!(
            [0.1, 0.5, 1.0, 5.0].map(|db| thinning(256, db).invisible_lsb),
            [0.2, 1.0, 1.0, 1.0],
            "it stays invisible"
        );
        assert!(points_of(5, 100, 100).eq(0..100));
        let mut taken = [0; 256];
        for segment in 0..13 {
            let points: Vec<usize> = points_of(segment, 64, 256).collect();
            assert!(points.len() == 64 && points.windows(2).all(|two| two[1] - two[0] == 4), "{points:?}");
            points.iter().for_each(|&point| taken[point] += 1);
        }
        assert!(taken.iter().all(|&times| (2..=4).contains(&times)), "{taken:?}");
    }

    /// In every segment, the fraction of echoes that is computed equals their power relative to that of an invisible
    /// path. With the power of the invisible path, this fraction has the same mean power as all echoes.
    #[test]
    fn draws_keep_the_mean_power() {
        for (points, most_mean, most) in [(256, 0.001, 0.012), (64, 0.005, 0.05)] {
            for (power, kind) in [0.01, 0.05, 0.2, 0.5, 0.9].into_iter().flat_map(|power| [(power, 0), (power, 1)]) {
                let count = |segment: usize| (0..points).filter(|&rank| power > draws(segment, rank)[kind]).count();
                let fractions: Vec<f64> = (0..SEGMENTS).map(|s| count(s) as f64 / points as f64).collect();
                let mean = fractions.iter().sum::<f64>() / SEGMENTS as f64;
                assert!((mean - power).abs() < most_mean + 0.01 * power, "{points}, {power}: {mean}");
                assert!(fractions.iter().all(|fraction| (fraction - power).abs() < most), "{power}: {fractions:?}");
            }
        }
    }

    /// Compares the echo over a point and directly, in both directions together, with separate paths from the
    /// transmitter to each receiver: at one time, and between the ends of an interval of 25 ms, in which a walker
    /// passes at 1 m.
    #[test]
    fn both_directions_are_one_echo() {
        const WAVELENGTH_M: f64 = 0.005;
        let tx = DVec3::new(0.0, 0.0, 1.1);
        let rx = [[0.0, 0.006, 1.1], [0.0, 0.006, 1.1025], [0.0, 0.0085, 1.1]].map(DVec3::from_array);
        let legs_to = |point: DVec3| -> (f64, [f64; 3]) { (tx.distance(point), rx.map(|rx| rx.distance(point))) };
        let paths = |point: DVec3| {
            let (outbound, inbound) = legs_to(point);
            AntennaPaths::new((outbound, 0.6), &inbound.map(|length_m| (length_m, 0.5)), WAVELENGTH_M)
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
