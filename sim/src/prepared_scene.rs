//! Prepared scene: everything about a scene that does not change while people move.

use std::borrow::Cow;

use glam::DVec3;
use num_complex::Complex64;
use radome_dsp::{SPEED_OF_LIGHT_M_PER_S, Waveform};
use rand::Rng;
use rand_xoshiro::Xoshiro256PlusPlus;

use crate::chirp::Chirp;
use crate::diffuse::{Diffuse, WallPoint, wall_points};
use crate::em::image::{Element, ImageIndex, images, order};
use crate::paths::Surroundings;
use crate::random::{Purpose, generator};
use crate::receiver::budget::{Filters, lsb_per_unit_amplitude};
use crate::receiver::noise::density_lsb2;
use crate::receiver::{Receiver, RxChannel};
use crate::scene::Scene;
use crate::scene_file::FurnitureFile;

/// Tone of a static path at one receiver.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StaticTone {
    /// Phase at the middle of a chirp, cycles.
    pub phase_cycles: f64,
    /// Beat frequency, cycles per sample.
    pub cycles_per_sample: f64,
    /// Amplitude at the ADC, LSB.
    pub amplitude: Complex64,
}

/// Path by way of a point, reflected by walls before and after it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PointPath {
    /// The point, m.
    pub point: DVec3,
    /// Image of the transmitter.
    pub tx_image: ImageIndex,
    /// Image of the receiver.
    pub rx_image: ImageIndex,
}

/// Static path: a wall reflection or an echo of furniture.
#[derive(Debug, Clone, PartialEq)]
pub struct StaticPath {
    /// Tone at each receiver.
    pub tones: Vec<StaticTone>,
    /// Corners of the path, radar to radar, for diffraction by people. A path by way of furniture ends at the
    /// transmitter: the receivers are millimetres beside it.
    pub polyline: Vec<DVec3>,
    /// Path by way of a point of furniture; `None` for a reflection of walls alone.
    pub point: Option<PointPath>,
    /// Phases of the path's slow drift, rad.
    pub drift: [f64; 3],
}

/// Echo of a point by a pair of images at one receiver.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct PointEcho {
    /// Field amplitude without the propagation phase.
    pub(crate) amplitude: Complex64,
    /// Length of the path, m.
    pub(crate) length_m: f64,
    /// Sum of the unit vectors from both images to the point: the increase of the path length per metre of motion of
    /// the point along each axis.
    pub(crate) directions: DVec3,
}

/// Geometry, link budget and static paths of a scene for one seed.
#[derive(Debug, Clone)]
pub struct PreparedScene {
    /// The room.
    pub room: Surroundings,
    /// The transmitter.
    pub tx: Element,
    /// The enabled receivers.
    pub rx: Vec<Element>,
    /// All receivers of the board, enabled or not.
    board_receivers: Vec<Element>,
    /// Amplitude at the ADC of a field of unit amplitude, by a receiver without a gain of its own, LSB.
    lsb_without_gain: f64,
    /// Constants of each enabled receiver.
    pub channels: Vec<RxChannel>,
    /// IF filters.
    pub filters: Filters,
    /// Chirp constants.
    pub chirp: Chirp,
    /// Peak amplitude of a unit field amplitude, for each receiver, LSB.
    pub lsb: Vec<f64>,
    /// Wavelength, m.
    pub wavelength_m: f64,
    /// Image pairs (transmitter, receiver) for paths by way of a body in a box room. Empty in other rooms, where the
    /// pairs depend on the place ([`PreparedScene::pairs_near`]).
    pub body_pairs: Vec<(ImageIndex, ImageIndex)>,
    /// Points of the walls that scatter in all directions.
    pub wall_points: Vec<WallPoint>,
    /// Static paths.
    pub static_paths: Vec<StaticPath>,
    /// Phases of the slow drift that all static paths share, rad.
    pub common_drift: [f64; 3],
    /// Amplitude at the ADC below which a path is invisible in any map, LSB.
    pub threshold_lsb: f64,
}

/// Amplitude (LSB) of a tone at `margin_db` below the mean thermal noise of a cell of the range-Doppler map: `2 sigma
/// sqrt(1/(N M)) 10^(-margin/20)`, with sigma^2 the least density of the noise over the band.
pub fn threshold_lsb(receiver: &Receiver, waveform: &Waveform, margin_db: f64) -> f64 {
    let density = density_lsb2(receiver, waveform);
    let least = density.iter().copied().fold(f64::INFINITY, f64::min).max(1e-3);
    let cells = (waveform.request.samples_per_chirp * waveform.request.chirps_per_frame) as f64;
    2.0 * (least / cells).sqrt() * 10f64.powf(-0.05 * margin_db)
}

/// Fraction of a field that may be neglected where paths `margin_db` below the noise are left out: half a decibel at
/// 10 dB, consistent with [`threshold_lsb`].
fn negligible_fraction(margin_db: f64) -> f64 {
    let tolerance_db = 0.5 * 10f64.powf(0.05 * (10.0 - margin_db));
    10f64.powf(0.05 * tolerance_db) - 1.0
}

/// Initial phases of the waves of a slow drift, rad.
pub fn drift_phases(seed: u64, index: [u64; 2]) -> [f64; 3] {
    let mut rng = generator(seed, Purpose::Drift, index);
    std::array::from_fn(|_| rng.random_range(0.0..std::f64::consts::TAU))
}

/// Slow drift whose change over ten seconds has a standard deviation of about 1.
pub fn drift(time_s: f64, phases: &[f64; 3]) -> f64 {
    const PERIODS_S: [f64; 3] = [17.0, 29.0, 53.0];
    let waves =
        PERIODS_S.iter().zip(phases).map(|(period, phase)| (std::f64::consts::TAU * time_s / period + phase).sin());
    0.5 * waves.sum::<f64>()
}

impl PreparedScene {
    /// Wavelength over 4 pi, m: ratio of the received amplitude of an isotropic antenna to the field times its
    /// distance.
    pub(crate) fn aperture_m(&self) -> f64 {
        self.wavelength_m / (4.0 * std::f64::consts::PI)
    }

    /// Computes the static geometry and paths of a scene.
    pub fn new(scene: &Scene, seed: u64, margin_db: f64) -> Self {
        let (receiver, waveform) = (scene.receiver(), scene.waveform());
        let (tx, rx) = scene.elements();
        let typical = Receiver::typical();
        let channels: Vec<RxChannel> = waveform
            .request
            .rx_antennas
            .antennas()
            .iter()
            .map(|&antenna| {
                let index = usize::from(antenna) - 1;
                receiver.rx.get(index).or_else(|| typical.rx.get(index)).cloned().unwrap_or_default()
            })
            .collect();
        let lsb_without_gain = lsb_per_unit_amplitude(receiver, waveform);
        let max_reflections = scene.file().room.max_body_reflections;
        let room = Surroundings::of_scene(scene, &tx, negligible_fraction(margin_db));
        let body_pairs = match &room {
            Surroundings::Box(_) => lattice_pairs(max_reflections),
            Surroundings::Polygons(_) => Vec::new(),
        };
        let mut prepared = PreparedScene {
            room,
            tx,
            board_receivers: scene.receivers_of_board(),
            lsb_without_gain,
            lsb: channels.iter().map(|c| lsb_without_gain * 10f64.powf(0.05 * c.gain_db)).collect(),
            rx,
            channels,
            filters: Filters::new(receiver, waveform),
            chirp: Chirp::new(waveform),
            wavelength_m: std::f64::consts::TAU / scene.wavenumber_per_m(),
            body_pairs,
            wall_points: Vec::new(),
            static_paths: Vec::new(),
            common_drift: drift_phases(seed, [0, 2]),
            threshold_lsb: threshold_lsb(receiver, waveform, margin_db),
        };
        let diffuse = Diffuse {
            share: scene.file().room.diffuse_share,
            points: scene.file().room.diffuse_points as usize,
            bounces: scene.file().room.diffuse_bounces,
            mirrored: max_reflections,
        };
        prepared.wall_points =
            wall_points(&prepared.room, diffuse, &prepared.tx, &prepared.rx, prepared.wavelength_m, seed);
        prepared.add_walls(scene.file().room.max_reflections);
        prepared.add_furniture(scene, seed);
        prepared.add_desk_objects(scene, seed);
        for (i, path) in prepared.static_paths.iter_mut().enumerate() {
            path.drift = drift_phases(seed, [i as u64, 0]);
        }
        prepared
    }

    /// Image pairs (transmitter, receiver) that may see points within a distance of a place, the direct pair first.
    pub fn pairs_near(&self, middle: DVec3, reach_m: f64) -> Cow<'_, [(ImageIndex, ImageIndex)]> {
        match &self.room {
            Surroundings::Box(_) => Cow::Borrowed(&self.body_pairs),
            Surroundings::Polygons(room) => {
                let images = room.images_near(self.tx.position, middle, reach_m);
                let pairs = room.pairs_among(&images);
                Cow::Owned(pairs.into_iter().map(|[p, q]| (images[p], images[q])).collect())
            }
        }
    }

    /// Amplitude at the ADC of a path (as the factor of `exp(+j...)`) from its field amplitude: conjugated, with link
    /// budget and the IF filters at the path's true beat frequency.
    pub fn at_adc(&self, rx: usize, amplitude: Complex64, beat_hz: f64) -> Complex64 {
        let lsb = self.lsb.get(rx).copied().unwrap_or(0.0);
        amplitude.conj() * lsb * self.filters.response(beat_hz)
    }

    /// Tone of a path at a receiver, from its field amplitude and length, m.
    fn static_tone(&self, rx: usize, amplitude: Complex64, length_m: f64) -> StaticTone {
        let delay_s = length_m / SPEED_OF_LIGHT_M_PER_S;
        let beat_hz = self.chirp.beat_hz(delay_s, 0.0);
        StaticTone {
            phase_cycles: self.chirp.phase_cycles(delay_s),
            cycles_per_sample: beat_hz / self.chirp.sample_rate_hz,
            amplitude: self.at_adc(rx, amplitude, beat_hz),
        }
    }

    /// Adds a static path if it is louder than the threshold.
    fn add_if_visible(
        &mut self,
        loudness_lsb: f64,
        tones: Vec<StaticTone>,
        point: Option<PointPath>,
        polyline: impl FnOnce(&Self) -> Vec<DVec3>,
    ) {
        if loudness_lsb > self.threshold_lsb {
            let polyline = polyline(self);
            self.static_paths.push(StaticPath { tones, polyline, point, drift: [0.0; 3] });
        }
    }

    /// Amplitude of the reflection by an image at the loudest of the board's receivers, LSB. Receivers that are not
    /// enabled count, too: a wall may end between them, and neither the choice of paths nor any draw may depend on the
    /// enabled receivers.
    pub(crate) fn wall_loudness_lsb(&self, index: ImageIndex) -> f64 {
        let loudness = |rx: &Element| {
            let (amplitude, length_m) = self.room.direct(&self.tx, index, rx);
            let beat_hz = self.chirp.beat_hz(length_m / SPEED_OF_LIGHT_M_PER_S, 0.0);
            self.lsb_without_gain * (amplitude * self.filters.response(beat_hz)).norm()
        };
        self.board_receivers.iter().map(loudness).fold(0.0, f64::max)
    }

    /// Adds the paths that only walls reflect: geometrical optics, exact for infinite planes.
    fn add_walls(&mut self, max_reflections: u32) {
        for index in self.room.images(max_reflections).into_iter().skip(1) {
            let tone = |(receiver, rx): (usize, &Element)| {
                let (amplitude, length_m) = self.room.direct(&self.tx, index, rx);
                self.static_tone(receiver, amplitude, length_m)
            };
            let tones = self.rx.iter().enumerate().map(tone).collect();
            // The corners of the path to the first receiver that it reaches stand for all receivers.
            let corners = |prepared: &Self| {
                let to_receiver = |rx: &Element| prepared.room.polyline(index, prepared.tx.position, rx.position);
                prepared.rx.iter().map(to_receiver).find(|corners| !corners.is_empty()).unwrap_or_default()
            };
            self.add_if_visible(self.wall_loudness_lsb(index), tones, None, corners);
        }
    }

    /// Echoes of an isotropic point with this cross-section and phase, by a pair of images, at each receiver.
    pub(crate) fn point_echoes(
        &self,
        point: DVec3,
        cross_section_m2: f64,
        phase: f64,
        p: ImageIndex,
        q: ImageIndex,
    ) -> Vec<PointEcho> {
        let outbound = self.room.illuminate(&self.tx, p, point);
        self.rx
            .iter()
            .map(|rx| {
                let inbound = self.room.illuminate(rx, q, point);
                let (r_t, r_r) = (outbound.distance_m.max(0.1), inbound.distance_m.max(0.1));
                let aperture = self.aperture_m();
                let scatter = (cross_section_m2 / (4.0 * std::f64::consts::PI)).sqrt();
                let amplitude = outbound.field.received_by(inbound.field)
                    * Complex64::from_polar(aperture * scatter / (r_t * r_r), phase);
                let length_m = outbound.distance_m + inbound.distance_m;
                PointEcho { amplitude, length_m, directions: outbound.direction + inbound.direction }
            })
            .collect()
    }

    /// Corners of the path from the transmitter to a point and on to an end by a pair of images, folded into the room.
    /// Empty where there is no such path.
    pub(crate) fn point_polyline(&self, point: DVec3, p: ImageIndex, q: ImageIndex, end: DVec3) -> Vec<DVec3> {
        let mut polyline = self.room.polyline(p, self.tx.position, point);
        let mut back = self.room.polyline(q, end, point);
        if polyline.is_empty() || back.is_empty() {
            return Vec::new();
        }
        back.reverse();
        polyline.extend(back.into_iter().skip(1));
        polyline
    }

    /// Adds the paths by way of an isotropic point.
    fn add_point(&mut self, point: DVec3, cross_section_m2: f64, phase: f64) {
        for (p, q) in self.pairs_near(point, 0.0).into_owned() {
            let echoes = self.point_echoes(point, cross_section_m2, phase, p, q);
            let tones: Vec<_> =
                echoes.iter().enumerate().map(|(i, e)| self.static_tone(i, e.amplitude, e.length_m)).collect();
            let path = Some(PointPath { point, tx_image: p, rx_image: q });
            // The receivers are so close together that the first represents all.
            let loudness_lsb = tones.first().map_or(0.0, |tone: &StaticTone| tone.amplitude.norm());
            let corners = |prepared: &Self| prepared.point_polyline(point, p, q, prepared.tx.position);
            self.add_if_visible(loudness_lsb, tones, path, corners);
        }
    }

    /// Draws a point on a face of furniture towards the radar: one of the two nearer upright ones, or the top.
    pub(crate) fn point_on(&self, piece: &FurnitureFile, rng: &mut Xoshiro256PlusPlus) -> DVec3 {
        let corner = DVec3::from_array(piece.position_m);
        let size = DVec3::from_array(piece.size_m);
        let to_radar = self.tx.position - (corner + 0.5 * size);
        let mut fractions = DVec3::new(rng.random(), rng.random(), rng.random());
        let axis = rng.random_range(0..3usize);
        fractions[axis] = if to_radar[axis] > 0.0 { 1.0 } else { 0.0 };
        corner + fractions * size
    }

    /// Adds the echoes of furniture.
    fn add_furniture(&mut self, scene: &Scene, seed: u64) {
        for (f, furniture) in scene.file().furniture.iter().enumerate() {
            // Furniture with mirroring faces does not scatter from points as well.
            if self.room.has_faces_of(f) {
                continue;
            }
            let mut rng = generator(seed, Purpose::Furniture, [f as u64, 0]);
            let cross_section_m2 = 10f64.powf(0.1 * furniture.cross_section_dbsm()) / furniture.points as f64;
            for _ in 0..furniture.points {
                let point = self.point_on(furniture, &mut rng);
                self.add_point(point, cross_section_m2, rng.random_range(0.0..std::f64::consts::TAU));
            }
        }
    }

    /// Adds the echoes of objects on a desk, if the scene has one and the seed puts objects there.
    fn add_desk_objects(&mut self, scene: &Scene, seed: u64) {
        let Some(desk) = &scene.file().people.desk else { return };
        let mut rng = generator(seed, Purpose::Desk, [2, 0]);
        if rng.random::<f64>() >= desk.objects_probability {
            return;
        }
        let world_from_radar = scene.radar_from_world().transpose();
        for _ in 0..rng.random_range(1..4) {
            let distance_m = rng.random_range(0.15..0.9);
            let azimuth_rad = rng.random_range(-0.6..0.6f64);
            let offset = DVec3::new(azimuth_rad.cos(), azimuth_rad.sin(), -0.15) * distance_m;
            let point = (scene.radar_position() + world_from_radar * offset).clamp(DVec3::ZERO, self.room.size_m());
            let cross_section_m2 = 10f64.powf(rng.random_range(-3.5..-2.0));
            self.add_point(point, cross_section_m2, rng.random_range(0.0..std::f64::consts::TAU));
        }
    }
}

/// Pairs of lattice images with at most `max_reflections` reflections together, the direct pair first.
fn lattice_pairs(max_reflections: u32) -> Vec<(ImageIndex, ImageIndex)> {
    let all = images(max_reflections);
    all.iter()
        .flat_map(|&p| all.iter().map(move |&q| (p, q)))
        .filter(|&(p, q)| order(p) + order(q) <= max_reflections)
        .collect()
}
