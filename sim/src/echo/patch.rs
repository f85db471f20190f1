//! Patch of connected skin triangles, summed to one tone per chirp.

// Loops use lane indices: several rows are accessed together, and the compiler vectorises these loops.
#![allow(clippy::needless_range_loop)]

use glam::DVec3;
use num_complex::Complex;
use radome_dsp::{KernelLevel, SPEED_OF_LIGHT_M_PER_S};

use super::patch_field::PatchField;
use super::patch_sum::{IntervalChirps, PatchSums, TrackRows, intervals_of};
use crate::em::image::{Element, ImageIndex};
use crate::lanes::{LANES, Row, compiled_for_levels, cos_sin_of_turns};
use crate::prepared_scene::PreparedScene;
use crate::synthesis::{EchoFactors, phasor};

/// Positions of the antennas' images, m.
pub(super) struct ImagePositions {
    /// Midpoint of transmitter and receivers. Illumination and obstruction are evaluated here for all antennas.
    pub(super) middle: DVec3,
    pub(super) tx: DVec3,
    pub(super) rx: Vec<DVec3>,
}

/// Key times and chirp times of a frame.
#[derive(Debug, Clone, PartialEq)]
pub struct FrameTimes {
    /// Key times, equally far apart: the first no later than the first chirp's middle, the last no earlier than the
    /// last's, s.
    pub keys_s: Vec<f64>,
    /// Middles of the chirps, s.
    pub chirps_s: Vec<f64>,
    /// Chirps grouped by the interval between key times that contains them.
    intervals: Vec<IntervalChirps>,
}

impl FrameTimes {
    /// Builds the times from key times and the middles of chirps, s.
    pub fn new(keys_s: Vec<f64>, chirps_s: Vec<f64>) -> Self {
        let first_s = keys_s.first().copied().unwrap_or_default();
        let length_s = keys_s.last().copied().unwrap_or_default() - first_s;
        let places: Vec<f64> = chirps_s.iter().map(|t| (t - first_s) / length_s).collect();
        let intervals = intervals_of(&places, keys_s.len().saturating_sub(1));
        FrameTimes { keys_s, chirps_s, intervals }
    }

    /// Returns the same times with additional key times half-way between.
    pub(super) fn halved(&self) -> Self {
        let between = self.keys_s.windows(2).flat_map(|pair| [pair[0], 0.5 * (pair[0] + pair[1])]);
        FrameTimes::new(between.chain(self.keys_s.last().copied()).collect(), self.chirps_s.clone())
    }

    /// Returns the interval between key times, s.
    pub(super) fn step_s(&self) -> f64 {
        match self.keys_s.as_slice() {
            [first, second, ..] => second - first,
            _ => 0.0,
        }
    }
}

/// Connected triangles, treated as one moving point.
pub(super) struct Patch {
    /// Position at each key time.
    places: Vec<PatchPlace>,
}

/// Position of a patch at a key time: means over its triangles, weighted by power.
#[derive(Clone, Copy)]
struct PatchPlace {
    place: DVec3,
    /// Length of the path by the antennas' midpoints, m, and its rate, m/s.
    length_m: f64,
    rate_m_per_s: f64,
}

impl Patch {
    /// Sums the triangles in every chirp on the path from one image to another. Returns `None` if the total power is
    /// not positive and finite. Triangle positions are relative to `origin`.
    pub(super) fn new(
        keys: &[PatchField],
        origin: DVec3,
        between: [&ImagePositions; 2],
        times: &FrameTimes,
        wavelength_m: f64,
        sums: &mut PatchSums,
    ) -> Option<Self> {
        // The weights are the same at all key times, so that the patch position moves smoothly.
        let mut weights = [0f32; LANES];
        for key in keys {
            let powers = key.powers();
            (0..LANES).for_each(|l| weights[l] += powers[l]);
        }
        let total: f32 = weights.iter().sum();
        if !(total > 0.0 && total.is_finite()) {
            return None;
        }
        weights.iter_mut().for_each(|weight| *weight /= total);
        // Rounding makes the sum of the weights differ from one, which would be visible in path lengths.
        let whole = weights.iter().map(|&weight| f64::from(weight)).sum::<f64>();
        let place = |key: &PatchField| {
            let mean = |row: &Row| f64::from((0..LANES).map(|l| row[l] * weights[l]).sum::<f32>());
            let length_m = (0..LANES).map(|l| key.length_m[l] * f64::from(weights[l])).sum::<f64>();
            let middle = DVec3::new(mean(&key.middles[0]), mean(&key.middles[1]), mean(&key.middles[2]));
            let rate_m_per_s = mean(&key.rate_m_per_s);
            PatchPlace { place: origin + middle, length_m: length_m / whole, rate_m_per_s }
        };
        let places: Vec<_> = keys.iter().map(place).collect();
        let middle = places.get(places.len() / 2)?.place;
        let gradient_rad_per_m = detour_gradient(between, middle) * (std::f64::consts::TAU / wavelength_m);
        let step_s = times.step_s();
        let end = |(key, place): (&PatchField, &PatchPlace)| {
            track_rows(key, place, origin, gradient_rad_per_m, step_s, wavelength_m)
        };
        let ends: Vec<TrackRows> = keys.iter().zip(&places).map(end).collect();
        sums.clear(times.chirps_s.len());
        for ((ends, places), chirps) in ends.windows(2).zip(places.windows(2)).zip(&times.intervals) {
            let ([first, second], [begin, end]) = (ends, places) else { continue };
            sums.follow([begin, end].map(|place| (place.length_m, place.rate_m_per_s)), step_s, chirps);
            sums.add([first, second], chirps);
        }
        Some(Patch { places })
    }

    /// Computes the echo of the patch at each receiver between two images. If `is_both`, the reverse path is included.
    pub(super) fn ways(
        &self,
        prepared: &PreparedScene,
        between: [&ImagePositions; 2],
        is_both: bool,
        chirps: usize,
        ways: &mut Vec<EchoFactors>,
    ) {
        ways.clear();
        let last = self.places.len().saturating_sub(1);
        let (Some(begin), Some(middle), Some(end)) =
            (self.places.first(), self.places.get(last / 2), self.places.last())
        else {
            return;
        };
        let [begins, ends] = [begin, end].map(|place| place.response(prepared));
        let at_middle = if last > 0 { (last / 2) as f32 / last as f32 } else { 0.0 };
        let responses = [begins, begins + (ends - begins) * at_middle, ends];
        let passes = [between, [between[1], between[0]]];
        let keys = [begin, middle, end].map(|place| (place, passes.map(|pass| place.detour_but_for_receiver_m(pass))));
        for (rx, lsb) in prepared.lsb.iter().enumerate().take(prepared.rx.len()) {
            let mut factors = [(Complex::default(), Complex::default()); 3];
            for ((factor, response), (place, detours_m)) in factors.iter_mut().zip(responses).zip(&keys) {
                let response = response * *lsb as f32;
                let turn = |pass: usize| {
                    let to_receiver_m = passes[pass][1].rx.get(rx).map_or(0.0, |sink| sink.distance(place.place));
                    place.turn(prepared, detours_m[pass] + to_receiver_m)
                };
                let there = response * turn(0);
                let reverse = if is_both { response * turn(1) } else { Complex::default() };
                *factor = (there + reverse, there - reverse);
            }
            ways.push(EchoFactors {
                both: parabola(factors.map(|(both, _)| both), last, chirps),
                apart: parabola(factors.map(|(_, apart)| apart), last, chirps),
            });
        }
    }
}

impl PatchPlace {
    fn delay_s(&self) -> f64 {
        self.length_m / SPEED_OF_LIGHT_M_PER_S
    }

    /// Returns the filter response at the patch's beat frequency, as a factor of `exp(+j ...)`.
    fn response(&self, prepared: &PreparedScene) -> Complex<f32> {
        let beat_hz = prepared.chirp.beat_hz(self.delay_s(), self.rate_m_per_s / SPEED_OF_LIGHT_M_PER_S);
        let response = prepared.filters.response(beat_hz);
        Complex::new(response.re as f32, response.im as f32)
    }

    /// Returns the path length by the transmitter minus that by the antennas' midpoints, both ways, m. The distance to
    /// the individual receiver must be added.
    fn detour_but_for_receiver_m(&self, [out, back]: [&ImagePositions; 2]) -> f64 {
        let by_middles_m = out.middle.distance(self.place) + back.middle.distance(self.place);
        out.tx.distance(self.place) - by_middles_m
    }

    /// Returns the phasor of the phase by which a path longer by `longer_m` differs.
    fn turn(&self, prepared: &PreparedScene, longer_m: f64) -> Complex<f32> {
        let (delay_s, later_s) = (self.delay_s(), longer_m / SPEED_OF_LIGHT_M_PER_S);
        phasor(prepared.chirp.phase_cycles(delay_s + later_s) - prepared.chirp.phase_cycles(delay_s))
    }
}

/// Returns the gradient of the excess length of the path by the transmitter and the receivers' midpoint over the path
/// by both midpoints. It vanishes between an image and itself; otherwise the phase varies by up to a tenth of a radian
/// over a patch.
fn detour_gradient([out, back]: [&ImagePositions; 2], place: DVec3) -> DVec3 {
    let away = |antenna: DVec3| (place - antenna).normalize_or_zero();
    let receivers = 2.0 * back.middle - back.tx;
    away(out.tx) - away(out.middle) + away(receivers) - away(back.middle)
}

/// Returns the parabola through values at the first, middle and last key time, as powers of the chirp number. `last` is
/// the index of the last key time; key times span the chirps.
fn parabola([a, b, c]: [Complex<f32>; 3], last: usize, chirps: usize) -> [Complex<f32>; 3] {
    let n = chirps as f32;
    if last < 2 {
        return [a, (c - a) / n, Complex::default()];
    }
    [a, (b * 4.0 - a * 3.0 - c) / n, (a + c - b * 2.0) * (2.0 / (n * n))]
}

/// Converts the triangles at a key time to one end of an interval of `step_s` seconds, with lengths relative to the
/// patch's length.
fn track_rows(
    key: &PatchField,
    patch: &PatchPlace,
    origin: DVec3,
    detour_rad_per_m: DVec3,
    step_s: f64,
    wavelength_m: f64,
) -> TrackRows {
    let per_wavelength = 1.0 / wavelength_m;
    let [slope, step, per_m] = [step_s * per_wavelength, step_s, per_wavelength].map(|factor| factor as f32);
    let (place, gradient) = ((patch.place - origin).as_vec3().to_array(), detour_rad_per_m.as_vec3().to_array());
    let rate_m_per_s = patch.rate_m_per_s as f32;
    let mut rows = TrackRows { field: key.field, ..TrackRows::default() };
    for l in 0..LANES {
        rows.length[l] = (key.length_m[l] - patch.length_m) * per_wavelength;
        rows.length_slope[l] = (key.rate_m_per_s[l] - rate_m_per_s) * slope;
    }
    for part in 0..2 {
        for l in 0..LANES {
            rows.field_slope[part][l] = key.field_rate[part][l] * step;
            rows.moment[part][l] = key.moment[part][l] * per_m;
        }
    }
    for axis in 0..3 {
        for l in 0..LANES {
            rows.detour_rad[l] += gradient[axis] * (key.middles[axis][l] - place[axis]);
        }
    }
    rows
}

/// Returns the squared error of cubic interpolation of the triangles' fields when every second key time is left out,
/// and the squared fields.
pub(super) fn missed_between_keys(
    level: KernelLevel,
    keys: &[PatchField],
    step_s: f64,
    wavelength_m: f64,
) -> (f64, f64) {
    let (mut missed, mut power) = (0.0, 0.0);
    for triple in keys.windows(3).step_by(2) {
        let [first, middle, last] = triple else { continue };
        let (more, of) = missed_in_interval(level, [first, middle, last], step_s, wavelength_m);
        (missed, power) = (missed + more, power + of);
    }
    (missed, power)
}

compiled_for_levels! {
    fn missed_in_interval(keys: [&PatchField; 3], step_s: f64, wavelength_m: f64) -> (f64, f64) = missed_body;
}

#[inline(always)]
fn missed_body([a, b, c]: [&PatchField; 3], step_s: f64, wavelength_m: f64) -> (f64, f64) {
    let slope = (0.25 * step_s) as f32;
    let mut missed = [0f32; LANES];
    for l in 0..LANES {
        let bend_m = slope * (a.rate_m_per_s[l] - c.rate_m_per_s[l]);
        let length_m = 0.5 * (a.length_m[l] + c.length_m[l]) + f64::from(bend_m) - b.length_m[l];
        let (cosine, sine) = cos_sin_of_turns((-length_m / wavelength_m) as f32);
        let between = |part: usize| {
            0.5 * (a.field[part][l] + c.field[part][l]) + slope * (a.field_rate[part][l] - c.field_rate[part][l])
        };
        let (x, y) = (between(0), between(1));
        let (re, im) = (x * cosine - y * sine - b.field[0][l], x * sine + y * cosine - b.field[1][l]);
        missed[l] = re * re + im * im;
    }
    let sum = |row: Row| f64::from(row.iter().sum::<f32>());
    (sum(missed), sum(b.powers()))
}

/// Returns an antenna at the midpoint of transmitter and receivers.
pub(super) fn middle_antenna(prepared: &PreparedScene) -> Element {
    let rx: DVec3 = prepared.rx.iter().map(|rx| rx.position).sum::<DVec3>() / prepared.rx.len().max(1) as f64;
    let position = if prepared.rx.is_empty() { prepared.tx.position } else { 0.5 * (prepared.tx.position + rx) };
    Element { position, ..prepared.tx }
}

impl ImagePositions {
    pub(super) fn new(prepared: &PreparedScene, middle: &Element, index: ImageIndex) -> Self {
        let place = |position: DVec3| prepared.room.image_position(index, position);
        let rx = prepared.rx.iter().map(|rx| place(rx.position)).collect();
        ImagePositions { middle: place(middle.position), tx: place(prepared.tx.position), rx }
    }
}
