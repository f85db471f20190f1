//! Triangles of a skin that hang together, as one tone in every chirp.

use glam::DVec3;
use num_complex::{Complex, Complex64};
use radome_dsp::SPEED_OF_LIGHT_M_PER_S;

use super::chirp_sum::{ChirpSums, Track};
use crate::field::image::{Element, ImageIndex};
use crate::stage::Stage;
use crate::synthesis::{EchoWay, phasor};

/// Where the antennas behind an image are.
pub(super) struct Place {
    /// Middle of transmitter and receivers: what they are lit by and what hides them is taken to be the same.
    pub(super) middle: DVec3,
    pub(super) tx: DVec3,
    pub(super) rx: Vec<DVec3>,
}

/// When a frame's keys and chirps are, s.
#[derive(Debug, Clone, PartialEq)]
pub struct FrameTimes {
    /// Key times, equally far apart: the first no later than the first chirp's middle, the last no earlier than the last's.
    pub keys_s: Vec<f64>,
    /// Middles of the chirps.
    pub chirps_s: Vec<f64>,
}

impl FrameTimes {
    /// With keys half-way between as well.
    pub(super) fn halved(&self) -> Self {
        let between = self.keys_s.windows(2).flat_map(|pair| [pair[0], 0.5 * (pair[0] + pair[1])]);
        FrameTimes { keys_s: between.chain(self.keys_s.last().copied()).collect(), chirps_s: self.chirps_s.clone() }
    }
}

/// A triangle at a key.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct TriangleKey {
    pub(super) middle: DVec3,
    /// Path by the antennas' middles, m, and its rate, m/s.
    pub(super) length_m: f64,
    pub(super) rate_m_per_s: f64,
    /// Integral of the field relative to the path by the middle, and its rate.
    pub(super) field: Complex64,
    pub(super) field_rate: Complex64,
    /// Moment of the field about that path: integral of the field times how much longer its own path is, m.
    pub(super) moment: Complex64,
}

/// Triangles that hang together, as one moving place.
pub(super) struct Patch {
    /// At each key: mean place by power, path there, m, and its rate, m/s.
    places: Vec<(DVec3, f64, f64)>,
    /// Paths are counted from here, m.
    base_m: f64,
}

impl Patch {
    /// Sums the triangles in every chirp, on their way from one image to another; `None` where there is nothing.
    pub(super) fn new(
        keys: &[Vec<TriangleKey>],
        members: std::ops::Range<usize>,
        between: [&Place; 2],
        times: &FrameTimes,
        wavelength_m: f64,
        sums: &mut ChirpSums,
    ) -> Option<Self> {
        let of: Vec<&[TriangleKey]> = keys.iter().filter_map(|key| key.get(members.clone())).collect();
        // The same weights at all keys, so that the place moves smoothly.
        let weights: Vec<f64> =
            (0..members.len()).map(|i| of.iter().map(|key| key[i].field.norm_sqr()).sum()).collect();
        let total: f64 = weights.iter().sum();
        if !(total > 0.0 && total.is_finite()) {
            return None;
        }
        let place = |key: &&[TriangleKey]| {
            let (mut middle, mut length_m, mut rate) = (DVec3::ZERO, 0.0, 0.0);
            for (triangle, weight) in key.iter().zip(&weights) {
                middle += triangle.middle * (weight / total);
                length_m += triangle.length_m * (weight / total);
                rate += triangle.rate_m_per_s * (weight / total);
            }
            (middle, length_m, rate)
        };
        let places: Vec<_> = of.iter().map(place).collect();
        let base_m = places.get(places.len() / 2)?.1;
        let gradient_rad_per_m =
            detour_gradient(between, places.get(places.len() / 2)?.0) * (std::f64::consts::TAU / wavelength_m);
        sums.clear(times.chirps_s.len());
        let step_s = times.keys_s.get(1)? - times.keys_s.first()?;
        for (stretch, pair) in of.windows(2).enumerate() {
            let [first, second] = pair else { continue };
            let here = places.get(stretch)?.0;
            let end = |t: &TriangleKey| Track {
                length: (t.length_m - base_m) / wavelength_m,
                length_slope: t.rate_m_per_s * step_s / wavelength_m,
                field: t.field,
                field_slope: t.field_rate * step_s,
                moment: t.moment / wavelength_m,
                detour_rad: gradient_rad_per_m.dot(t.middle - here),
            };
            let tracks =
                first.iter().zip(*second).filter(|(a, b)| a.field != Complex64::ZERO || b.field != Complex64::ZERO);
            sums.load(tracks.map(|(a, b)| (end(a), end(b))));
            let from_s = times.keys_s.first()? + stretch as f64 * step_s;
            let last = stretch + 2 == of.len();
            sums.add(
                times
                    .chirps_s
                    .iter()
                    .map(|t| (t - from_s) / step_s)
                    .enumerate()
                    .filter(|&(_, u)| (stretch == 0 || u >= 0.0) && (last || u < 1.0)),
            );
        }
        Some(Patch { places, base_m })
    }

    /// Factor from field to LSB at a receiver in the first chirp, and its change from chirp to chirp.
    pub(super) fn response(&self, stage: &Stage, rx: usize, chirps: usize) -> [Complex<f32>; 2] {
        let at = |place: Option<&(DVec3, f64, f64)>| {
            let beat_hz =
                place.map_or(0.0, |p| stage.chirp.beat_hz(p.1 / SPEED_OF_LIGHT_M_PER_S, p.2 / SPEED_OF_LIGHT_M_PER_S));
            let a = stage.at_adc(rx, Complex64::ONE, beat_hz);
            Complex::new(a.re as f32, a.im as f32)
        };
        let (begins, ends) = (at(self.places.first()), at(self.places.last()));
        [begins, (ends - begins) / chirps as f32]
    }

    /// The way between a transmitter's and a receiver's image.
    pub(super) fn way(
        &self,
        stage: &Stage,
        [out, back]: [&Place; 2],
        rx: usize,
        response: [Complex<f32>; 2],
        chirps: usize,
    ) -> EchoWay {
        // What the way by transmitter and receiver is longer than that by their middles.
        let detour = |key: usize| {
            let place = self.places.get(key).map_or(DVec3::ZERO, |p| p.0);
            let by_middles = out.middle.distance(place) + back.middle.distance(place);
            out.tx.distance(place) + back.rx.get(rx).map_or(0.0, |sink| sink.distance(place)) - by_middles
        };
        let rate = |key: usize| self.places.get(key).map_or(0.0, |p| p.2);
        let [base, slope, bend] = parabola(&detour, self.places.len(), chirps);
        EchoWay {
            length_m: [self.base_m + base, slope, bend],
            rate_m_per_s: parabola(&rate, self.places.len(), chirps),
            wavelength_m: stage.wavelength_m,
            response,
        }
    }
}

/// How what a way is longer by the transmitter and the middle of the receivers than by the middles of both changes with the place:
/// between an image and itself not at all, otherwise by up to a tenth of a radian over a patch.
fn detour_gradient([out, back]: [&Place; 2], place: DVec3) -> DVec3 {
    let away = |antenna: DVec3| (place - antenna).normalize_or_zero();
    let receivers = 2.0 * back.middle - back.tx;
    away(out.tx) - away(out.middle) + away(receivers) - away(back.middle)
}

/// Through the first, the middle and the last key, as powers of the chirp's number: keys span the chirps.
fn parabola(of: &dyn Fn(usize) -> f64, keys: usize, chirps: usize) -> [f64; 3] {
    let (last, n) = (keys.saturating_sub(1), chirps as f64);
    let [a, b, c] = [of(0), of(last / 2), of(last)];
    if last < 2 {
        return [a, (c - a) / n, 0.0];
    }
    [a, (4.0 * b - 3.0 * a - c) / n, 2.0 * (a + c - 2.0 * b) / (n * n)]
}

/// Squares of what cubics between keys miss of triangles' fields when every second key is left out, and of the fields.
pub(super) fn missed_between_keys(keys: &[Vec<TriangleKey>], times_s: &[f64], wavelength_m: f64) -> (f64, f64) {
    let [first_s, second_s, ..] = times_s else { return (0.0, 0.0) };
    let span_s = 2.0 * (second_s - first_s);
    let (mut missed, mut power) = (0.0, 0.0);
    for triple in keys.windows(3).step_by(2) {
        let [first, middle, last] = triple else { continue };
        for ((a, b), c) in first.iter().zip(middle).zip(last) {
            let length_m =
                0.5 * (a.length_m + c.length_m) + 0.125 * span_s * (a.rate_m_per_s - c.rate_m_per_s) - b.length_m;
            let field = 0.5 * (a.field + c.field) + 0.125 * span_s * (a.field_rate - c.field_rate);
            let turn = phasor(-length_m / wavelength_m);
            let turn = Complex64::new(turn.re.into(), turn.im.into());
            missed += (field * turn - b.field).norm_sqr();
            power += b.field.norm_sqr();
        }
    }
    (missed, power)
}

/// An antenna in the middle of transmitter and receivers.
pub(super) fn middle_antenna(stage: &Stage) -> Element {
    let rx: DVec3 = stage.rx.iter().map(|rx| rx.position).sum::<DVec3>() / stage.rx.len().max(1) as f64;
    let position = if stage.rx.is_empty() { stage.tx.position } else { 0.5 * (stage.tx.position + rx) };
    Element { position, ..stage.tx }
}

impl Place {
    pub(super) fn new(stage: &Stage, middle: &Element, index: ImageIndex) -> Self {
        let place = |position: DVec3| stage.room.image_position(index, position);
        let rx = stage.rx.iter().map(|rx| place(rx.position)).collect();
        Place { middle: place(middle.position), tx: place(stage.tx.position), rx }
    }
}
