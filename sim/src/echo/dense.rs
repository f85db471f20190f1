//! Echoes of a skin the slow way: physical optics over all of it that is lit, anew in every chirp, in double precision.
//!
//! The same surface, fields and shadows as [`super::skin`] has, but nothing of its short cuts: no window, no key times, no
//! choice of cuts; strengths are computed wherever a flat piece has a corner, and every piece is a path of its own.

use std::f64::consts::TAU;

use glam::DVec3;
use num_complex::Complex64;
use radome_dsp::SPEED_OF_LIGHT_M_PER_S;

use super::skin::SkinnedPerson;
use super::{LEAST_DISTANCE_M, Snapshot, inside_room, self_shadow};
use crate::actor::skin::PosedSkin;
use crate::actor::track::smooth_step;
use crate::field::boundary::Boundary;
use crate::field::current::{Arrival, heard_by};
use crate::field::image::ImageIndex;
use crate::field::triangle;
use crate::scene::material::SKIN_PERMITTIVITY;
use crate::stage::Stage;

/// An edge is cut into this many: pieces of 5 mm.
const PIECES: usize = 6;
/// Pieces whose paths differ by less than this are one tone in fast time, m; at the carrier each has its own phase.
const BIN_M: f64 = 1e-3;
/// And whose rates do by less than this, m/s.
const BIN_M_PER_S: f64 = 0.2;
/// Bins of rates, and of lengths either way of the first piece's.
const RATES: i64 = 160;
const ROOM: i64 = 5000;

/// Samples of one chirp at every receiver, LSB: `[receiver][sample]`.
pub fn chirp(
    stage: &Stage,
    person: &SkinnedPerson,
    people: &[Snapshot],
    me: usize,
    pairs: &[(ImageIndex, ImageIndex)],
    time_s: f64,
    samples: usize,
) -> Vec<Vec<f64>> {
    let posed = person.mesh().posed(time_s);
    let all = vec![true; posed.vertices.len()];
    let rx_middle = stage.rx.iter().map(|rx| rx.position).sum::<DVec3>() / stage.rx.len().max(1) as f64;
    let mut indices: Vec<ImageIndex> = pairs.iter().flat_map(|&(p, q)| [p, q]).collect();
    indices.sort_unstable();
    indices.dedup();
    let weights: Vec<Vec<f64>> = indices
        .iter()
        .map(|&index| {
            let [tx, rx] = [stage.tx.position, rx_middle].map(|a| stage.room.image_position(index, a));
            let middle = 0.5 * (tx + rx);
            let own = self_shadow::weights(person.mesh().skin(), &posed, middle, stage.wavelength_m, &all);
            let past = person.past_people(stage, people, me, index);
            own.iter().zip(past).map(|(a, b)| a * b).collect()
        })
        .collect();
    let mut bins = Bins::new(stage, samples);
    let mut out = vec![vec![0.0; samples]; stage.rx.len()];
    for &(p, q) in pairs {
        let at = |index: ImageIndex| {
            indices.binary_search(&index).ok().and_then(|i| weights.get(i)).map(Vec::as_slice).unwrap_or_default()
        };
        pair(stage, person, &posed, (p, q), (at(p), at(q)), &mut bins);
        bins.flush(&mut out);
    }
    out
}

/// Corner of a piece.
#[derive(Clone, Copy)]
struct Node {
    point: DVec3,
    velocity: DVec3,
    strength: Complex64,
}

fn pair(
    stage: &Stage,
    person: &SkinnedPerson,
    posed: &PosedSkin,
    (p, q): (ImageIndex, ImageIndex),
    (out, back): (&[f64], &[f64]),
    bins: &mut Bins,
) {
    let Some(first) = stage.rx.first() else { return };
    let k = TAU / stage.wavelength_m;
    let aperture = stage.wavelength_m / (4.0 * std::f64::consts::PI);
    let factor = Complex64::new(0.0, -k * aperture / TAU);
    let skin = Boundary::HalfSpace { permittivity: SKIN_PERMITTIVITY };
    let source = stage.room.image_position(p, stage.tx.position);
    let sinks: Vec<DVec3> = stage.rx.iter().map(|rx| stage.room.image_position(q, rx.position)).collect();
    let mesh = person.mesh().skin();
    let at = |of: &[DVec3], i: u32| of.get(i as usize).copied().unwrap_or_default();
    let number = |of: &[f64], i: u32| of.get(i as usize).copied().unwrap_or_default();
    for (corners, sides) in mesh.rest().triangles.iter().zip(mesh.sides()) {
        let normals = corners.map(|v| at(&posed.normals, v));
        let points = corners.map(|v| at(&posed.vertices, v));
        let velocities = corners.map(|v| at(&posed.velocities_m_per_s, v));
        let bulges = sides.map(|e| at(&posed.bulges, e));
        let weights = corners.map(|v| number(out, v) * number(back, v) * number(person.cloth(), v));
        let faces = |i: usize| normals[i].dot(source - points[i]) > 0.0 && normals[i].dot(sinks[0] - points[i]) > 0.0;
        if !(0..3).any(faces) || weights.iter().all(|w| *w == 0.0) {
            continue;
        }
        let place = |[a, b, c]: [f64; 3]| {
            let flat = points[0] * a + points[1] * b + points[2] * c;
            flat + 4.0 * (bulges[0] * (a * b) + bulges[1] * (b * c) + bulges[2] * (c * a))
        };
        // Half-way between two nodes.
        let between = |[i, j]: [usize; 2], [k, l]: [usize; 2]| {
            let (i, j) = ((i + k) as f64 / (2 * PIECES) as f64, (j + l) as f64 / (2 * PIECES) as f64);
            place([1.0 - i - j, j, i])
        };
        let node = |i: usize, j: usize| {
            let [a, b, c] = [PIECES - i - j, j, i].map(|n| n as f64 / PIECES as f64);
            let point = place([a, b, c]);
            let normal = (normals[0] * a + normals[1] * b + normals[2] * c).normalize_or_zero();
            let velocity = velocities[0] * a + velocities[1] * b + velocities[2] * c;
            let there = stage.room.illuminate(&stage.tx, p, point);
            let home = stage.room.illuminate(first, q, point);
            let mut strength = Complex64::ZERO;
            if normal.dot(there.direction) < 0.0 && normal.dot(home.direction) < 0.0 {
                let arrival = Arrival { field: there.field, direction: there.direction };
                let heard = heard_by(&arrival, normal, &skin, k, -home.direction, home.field);
                let spreading = 1.0 / (there.distance_m.max(LEAST_DISTANCE_M) * home.distance_m.max(LEAST_DISTANCE_M));
                let bent = 0.5 * (there.direction + home.direction).length();
                let weight = (weights[0] * a + weights[1] * b + weights[2] * c) * smooth_step((bent - 0.2) / 0.1);
                strength = factor * heard * (spreading * weight * inside_room(stage, point));
            }
            Node { point, velocity, strength }
        };
        let rows: Vec<Vec<Node>> = (0..=PIECES).map(|i| (0..=PIECES - i).map(|j| node(i, j)).collect()).collect();
        let mut piece = |corners: [[usize; 2]; 3]| {
            let [a, b, c] = corners;
            let middles = [between(a, b), between(b, c), between(c, a)];
            bins.add_piece(corners.map(|[i, j]| rows[i][j]), middles, source, &sinks);
        };
        for i in 0..PIECES {
            for j in 0..PIECES - i {
                piece([[i, j], [i, j + 1], [i + 1, j]]);
                if i + j + 2 <= PIECES {
                    piece([[i + 1, j + 1], [i + 1, j], [i, j + 1]]);
                }
            }
        }
    }
}

/// Pieces whose paths have almost the same length and rate.
#[derive(Default)]
struct Tone {
    /// Sum of the amplitudes with the carrier's phase at the middle of the chirp, LSB.
    amplitude: Complex64,
    /// Sum of the beat frequencies, Hz, and their number.
    beats_hz: f64,
    pieces: f64,
}

/// Tones of a chirp.
struct Bins<'a> {
    stage: &'a Stage,
    samples: usize,
    /// Path length of the first bin, in bins, once there is a piece.
    first: Option<i64>,
    /// `[receiver][path * RATES + rate]`.
    tones: Vec<Vec<Tone>>,
}

impl<'a> Bins<'a> {
    fn new(stage: &'a Stage, samples: usize) -> Self {
        Bins { stage, samples, first: None, tones: stage.rx.iter().map(|_| Vec::new()).collect() }
    }

    /// A piece between its corners: strength is linear over it, and its path but for a mean.
    fn add_piece(&mut self, [a, b, c]: [Node; 3], middles: [DVec3; 3], source: DVec3, sinks: &[DVec3]) {
        if [a, b, c].iter().all(|n| n.strength == Complex64::ZERO) {
            return;
        }
        let k = TAU / self.stage.wavelength_m;
        let twice_area = (b.point - a.point).cross(c.point - a.point).length();
        let middle = (a.point + b.point + c.point) / 3.0;
        let velocity = (a.velocity + b.velocity + c.velocity) / 3.0;
        let Some(first) = sinks.first() else { return };
        let length = |p: DVec3, sink: DVec3| source.distance(p) + sink.distance(p);
        // Within millimetres all receivers see the same differences.
        let lengths = [a, b, c].map(|n| length(n.point, *first) - length(middle, *first));
        // What the curved path is longer than the linear one, on the mean over the piece.
        let beside: f64 = middles.iter().map(|m| length(*m, *first) - length(middle, *first)).sum();
        let longer = (beside - (lengths[0] + lengths[1] + lengths[2])) / 3.0;
        let phases = lengths.map(|l| -k * (l + longer));
        let [x, y, z] = triangle::moments(phases[0], phases[1], phases[2]);
        let strength = (x * a.strength + y * b.strength + z * c.strength) * twice_area;
        for (rx, sink) in sinks.iter().enumerate() {
            let length_m = length(middle, *sink);
            let rate = ((middle - source).normalize_or_zero() + (middle - *sink).normalize_or_zero()).dot(velocity);
            let (delay_s, delay_rate) = (length_m / SPEED_OF_LIGHT_M_PER_S, rate / SPEED_OF_LIGHT_M_PER_S);
            let chirp = &self.stage.chirp;
            let beat_hz = chirp.beat_hz(delay_s, delay_rate);
            let phase = TAU * chirp.phase_cycles(delay_s).rem_euclid(1.0);
            // As the ADC has it: conjugated, with the filters at the bin's beat.
            let amplitude = strength.conj() * Complex64::from_polar(1.0, phase);
            let path = (length_m / BIN_M).floor() as i64;
            let first = *self.first.get_or_insert(path);
            // A body reaches a metre or two either way of any of its pieces.
            let path = (path - first + ROOM).clamp(0, 2 * ROOM) as usize;
            let rate = ((rate / BIN_M_PER_S).round() as i64 + RATES / 2).clamp(0, RATES - 1) as usize;
            let bin = path * RATES as usize + rate;
            if let Some(tones) = self.tones.get_mut(rx) {
                if tones.len() <= bin {
                    tones.resize_with(bin + 1, Tone::default);
                }
                if let Some(tone) = tones.get_mut(bin) {
                    tone.amplitude += amplitude;
                    tone.beats_hz += beat_hz;
                    tone.pieces += 1.0;
                }
            }
        }
    }

    /// Adds what is in the bins to samples, and empties them.
    fn flush(&mut self, out: &mut [Vec<f64>]) {
        self.first = None;
        let middle = (self.samples / 2) as f64;
        for (rx, (tones, out)) in self.tones.iter_mut().zip(out).enumerate() {
            for tone in tones.drain(..).filter(|tone| tone.pieces > 0.0) {
                let beat_hz = tone.beats_hz / tone.pieces;
                let cycles = beat_hz / self.stage.chirp.sample_rate_hz;
                let amplitude = tone.amplitude * self.stage.at_adc(rx, Complex64::ONE, beat_hz);
                let turn = |samples: f64| Complex64::from_polar(1.0, TAU * cycles * samples);
                // Four samples side by side.
                let mut four: [Complex64; 4] = std::array::from_fn(|i| amplitude * turn(i as f64 - middle));
                let step = turn(4.0);
                for chunk in out.chunks_mut(4) {
                    for (x, value) in chunk.iter_mut().zip(&mut four) {
                        *x += value.re;
                        *value *= step;
                    }
                }
            }
        }
    }
}
