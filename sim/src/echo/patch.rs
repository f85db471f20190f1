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
        let positions: Vec<f64> = chirps_s.iter().map(|t| (t - first_s) / length_s).collect();
        let intervals = intervals_of(&positions, keys_s.len().saturating_sub(1));
        FrameTimes { keys_s, chirps_s, intervals }
    }

    /// Returns the same times with additional key times half-way between.
    pub(super) fn with_midpoints(&self) -> Self {
        let but_last = self.keys_s.windows(2).flat_map(|pair| [pair[0], 0.5 * (pair[0] + pair[1])]);
        FrameTimes::new(but_last.chain(self.keys_s.last().copied()).collect(), self.chirps_s.clone())
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
    positions: Vec<PatchPosition>,
}

/// Position of a patch at a key time: means over its triangles, weighted by power.
#[derive(Clone, Copy)]
struct PatchPosition {
    point: DVec3,
    /// Length of the path by the antennas' midpoints, m, and its rate, m/s.
    length_m: f64,
    rate_m_per_s: f64,
}

impl Patch {
    /// Sums the triangles in every chirp on the path from one image to another, given their fields at the key times.
    /// Returns `None` if the total power is not positive and finite. Triangle positions are relative to `origin`.
    pub(super) fn new(
        fields: &[PatchField],
        origin: DVec3,
        images: [&ImagePositions; 2],
        times: &FrameTimes,
        wavelength_m: f64,
        sums: &mut PatchSums,
    ) -> Option<Self> {
        // The weights are the same at all key times, so that the patch position moves smoothly.
        let mut weights = [0f32; LANES];
        for field in fields {
            let powers = field.powers();
            (0..LANES).for_each(|l| weights[l] += powers[l]);
        }
        let total: f32 = weights.iter().sum();
        if !(total > 0.0 && total.is_finite()) {
            return None;
        }
        weights.iter_mut().for_each(|weight| *weight /= total);
        // Because of rounding, the sum of the weights is not one. The difference would be visible in path lengths.
        let weight_sum = weights.iter().map(|&weight| f64::from(weight)).sum::<f64>();
        let position = |field: &PatchField| {
            let mean = |row: &Row| f64::from((0..LANES).map(|l| row[l] * weights[l]).sum::<f32>());
            let length_m = (0..LANES).map(|l| field.length_m[l] * f64::from(weights[l])).sum::<f64>();
            let middle = DVec3::new(mean(&field.middles[0]), mean(&field.middles[1]), mean(&field.middles[2]));
            let rate_m_per_s = mean(&field.rate_m_per_s);
            PatchPosition { point: origin + middle, length_m: length_m / weight_sum, rate_m_per_s }
        };
        let positions: Vec<_> = fields.iter().map(position).collect();
        let middle = positions.get(positions.len() / 2)?.point;
        let gradient_rad_per_m = detour_gradient(images, middle) * (std::f64::consts::TAU / wavelength_m);
        let step_s = times.step_s();
        let end = |(field, position): (&PatchField, &PatchPosition)| {
            track_rows(field, position, origin, gradient_rad_per_m, step_s, wavelength_m)
        };
        let ends: Vec<TrackRows> = fields.iter().zip(&positions).map(end).collect();
        sums.clear(times.chirps_s.len());
        for ((ends, positions), chirps) in ends.windows(2).zip(positions.windows(2)).zip(&times.intervals) {
            let ([first, second], [begin, end]) = (ends, positions) else { continue };
            let path = |position: &PatchPosition| (position.length_m, position.rate_m_per_s);
            sums.set_common_path([path(begin), path(end)], step_s, chirps);
            sums.add([first, second], chirps);
        }
        Some(Patch { positions })
    }

    /// Computes the factors of the patch's echo at each receiver for a pair of images. If `is_both`, the reverse path
    /// is included.
    pub(super) fn echo_factors(
        &self,
        prepared: &PreparedScene,
        images: [&ImagePositions; 2],
        is_both: bool,
        chirps: usize,
        out: &mut Vec<EchoFactors>,
    ) {
        out.clear();
        let last = self.positions.len().saturating_sub(1);
        let (Some(begin), Some(middle), Some(end)) =
            (self.positions.first(), self.positions.get(last / 2), self.positions.last())
        else {
            return;
        };
        let [at_begin, at_end] = [begin, end].map(|position| position.response(prepared));
        let middle_fraction = if last > 0 { (last / 2) as f32 / last as f32 } else { 0.0 };
        let responses = [at_begin, at_begin + (at_end - at_begin) * middle_fraction, at_end];
        // The forward path and its reverse.
        let paths = [images, [images[1], images[0]]];
        let positions = [begin, middle, end];
        let detours = positions.map(|position| paths.map(|path| position.detour_without_receiver_m(path)));
        for (rx, lsb) in prepared.lsb.iter().enumerate().take(prepared.rx.len()) {
            let mut factors = [(Complex::default(), Complex::default()); 3];
            for (((factor, response), position), detours_m) in
                factors.iter_mut().zip(responses).zip(positions).zip(&detours)
            {
                let response = response * *lsb as f32;
                let detour_phasor = |path: usize| {
                    let to_receiver_m = paths[path][1].rx.get(rx).map_or(0.0, |sink| sink.distance(position.point));
                    position.detour_phasor(prepared, detours_m[path] + to_receiver_m)
                };
                let forward = response * detour_phasor(0);
                let reverse = if is_both { response * detour_phasor(1) } else { Complex::default() };
                *factor = (forward + reverse, forward - reverse);
            }
            out.push(EchoFactors {
                sum: parabola(factors.map(|(sum, _)| sum), last, chirps),
                difference: parabola(factors.map(|(_, difference)| difference), last, chirps),
            });
        }
    }
}

impl PatchPosition {
    /// Returns the delay of the path by the antennas' midpoints, s.
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
    fn detour_without_receiver_m(&self, [out, back]: [&ImagePositions; 2]) -> f64 {
        let by_middles_m = out.middle.distance(self.point) + back.middle.distance(self.point);
        out.tx.distance(self.point) - by_middles_m
    }

    /// Returns the phasor of the phase that a detour adds to the path, m.
    fn detour_phasor(&self, prepared: &PreparedScene, detour_m: f64) -> Complex<f32> {
        let (delay_s, detour_s) = (self.delay_s(), detour_m / SPEED_OF_LIGHT_M_PER_S);
        phasor(prepared.chirp.phase_cycles(delay_s + detour_s) - prepared.chirp.phase_cycles(delay_s))
    }
}

/// Returns the gradient of the excess length of the path by the transmitter and the receivers' midpoint over the path
/// by both midpoints. It vanishes between an image and itself; otherwise the phase varies by up to a tenth of a radian
/// over a patch.
fn detour_gradient([out, back]: [&ImagePositions; 2], point: DVec3) -> DVec3 {
    let away = |antenna: DVec3| (point - antenna).normalize_or_zero();
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
    field: &PatchField,
    patch: &PatchPosition,
    origin: DVec3,
    detour_rad_per_m: DVec3,
    step_s: f64,
    wavelength_m: f64,
) -> TrackRows {
    let per_wavelength = 1.0 / wavelength_m;
    let [slope, step, per_m] = [step_s * per_wavelength, step_s, per_wavelength].map(|factor| factor as f32);
    let (point, gradient) = ((patch.point - origin).as_vec3().to_array(), detour_rad_per_m.as_vec3().to_array());
    let rate_m_per_s = patch.rate_m_per_s as f32;
    let mut rows = TrackRows { field: field.field, ..TrackRows::default() };
    for l in 0..LANES {
        rows.length[l] = (field.length_m[l] - patch.length_m) * per_wavelength;
        rows.length_slope[l] = (field.rate_m_per_s[l] - rate_m_per_s) * slope;
    }
    for part in 0..2 {
        for l in 0..LANES {
            rows.field_slope[part][l] = field.field_rate[part][l] * step;
            rows.moment[part][l] = field.moment[part][l] * per_m;
        }
    }
    for axis in 0..3 {
        for l in 0..LANES {
            rows.detour_rad[l] += gradient[axis] * (field.middles[axis][l] - point[axis]);
        }
    }
    rows
}

/// Returns the squared error of cubic interpolation of the triangles' fields when every second key time is left out,
/// and the squared fields.
pub(super) fn interpolation_error(
    level: KernelLevel,
    fields: &[PatchField],
    step_s: f64,
    wavelength_m: f64,
) -> (f64, f64) {
    let (mut error, mut power) = (0.0, 0.0);
    for triple in fields.windows(3).step_by(2) {
        let [first, middle, last] = triple else { continue };
        let (interval_error, interval_power) = interval_error(level, [first, middle, last], step_s, wavelength_m);
        (error, power) = (error + interval_error, power + interval_power);
    }
    (error, power)
}

compiled_for_levels! {
    fn interval_error(fields: [&PatchField; 3], step_s: f64, wavelength_m: f64) -> (f64, f64) = interval_error_body;
}

#[inline(always)]
fn interval_error_body([a, b, c]: [&PatchField; 3], step_s: f64, wavelength_m: f64) -> (f64, f64) {
    let slope = (0.25 * step_s) as f32;
    let mut error = [0f32; LANES];
    for l in 0..LANES {
        let bend_m = slope * (a.rate_m_per_s[l] - c.rate_m_per_s[l]);
        let length_m = 0.5 * (a.length_m[l] + c.length_m[l]) + f64::from(bend_m) - b.length_m[l];
        let (cosine, sine) = cos_sin_of_turns((-length_m / wavelength_m) as f32);
        let interpolated = |part: usize| {
            0.5 * (a.field[part][l] + c.field[part][l]) + slope * (a.field_rate[part][l] - c.field_rate[part][l])
        };
        let (x, y) = (interpolated(0), interpolated(1));
        let (re, im) = (x * cosine - y * sine - b.field[0][l], x * sine + y * cosine - b.field[1][l]);
        error[l] = re * re + im * im;
    }
    let sum = |row: Row| f64::from(row.iter().sum::<f32>());
    (sum(error), sum(b.powers()))
}

/// Returns an antenna at the midpoint of transmitter and receivers.
pub(super) fn middle_antenna(prepared: &PreparedScene) -> Element {
    let rx: DVec3 = prepared.rx.iter().map(|rx| rx.position).sum::<DVec3>() / prepared.rx.len().max(1) as f64;
    let position = if prepared.rx.is_empty() { prepared.tx.position } else { 0.5 * (prepared.tx.position + rx) };
    Element { position, ..prepared.tx }
}

impl ImagePositions {
    pub(super) fn new(prepared: &PreparedScene, middle: &Element, index: ImageIndex) -> Self {
        let image = |position: DVec3| prepared.room.image_position(index, position);
        let rx = prepared.rx.iter().map(|rx| image(rx.position)).collect();
        ImagePositions { middle: image(middle.position), tx: image(prepared.tx.position), rx }
    }
}
