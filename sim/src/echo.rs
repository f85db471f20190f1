//! Echoes of people: specular points of their body segments for every audible pair of images, at sample times.

mod audible;
pub mod dense;
pub mod diffuse;
mod diffuse_legs;
pub mod error_budget;
mod facing_rows;
mod obstruction;
mod patch;
mod patch_field;
mod patch_pose;
mod patch_solver;
mod patch_sum;
mod path_rows;
pub mod self_occlusion;
mod side_by_side;
pub mod skin;
pub mod still;
mod surface_currents;

pub use audible::{AUDIBLE_FRACTION, AudiblePair, audible_pairs, audible_paths, loud_pairs};
pub use patch::FrameTimes;
pub use side_by_side::TracedPath;

use std::cell::RefCell;
use std::collections::BTreeSet;

use glam::DVec3;
use num_complex::Complex64;
use obstruction::{OneWayPath, PathEdges, SharedObstructions, obstruction_factor, own_body_factor, people_factor};
use radome_dsp::{KernelLevel, SPEED_OF_LIGHT_M_PER_S};

use crate::diffraction::Column;
use crate::em::fresnel::half_space;
use crate::em::image::{BoxRoom, Element, ImageIndex};
use crate::em::specular::Ellipsoid;
use crate::em::{Phasor3, incidence_frame};
use crate::material::SKIN_PERMITTIVITY;
use crate::math::smooth_step;
use crate::path_segment::PathSample;
use crate::paths::Surroundings;
use crate::people::body::{CHEST, PELVIS, SEGMENTS};
use crate::people::motion::{AtDesk, BodyPoint, Motion};
use crate::prepared_scene::PreparedScene;

/// Distances below this are clamped in amplitudes (never in delays), m.
pub const LEAST_DISTANCE_M: f64 = 0.1;
/// Half of the interval of the central differences that give velocities, s.
const VELOCITY_STEP_S: f64 = 2e-4;

/// Pose of a person at one time.
#[derive(Debug, Clone)]
pub struct Snapshot {
    /// Body segments at this time.
    pub body: [Ellipsoid; SEGMENTS],
    before: [Ellipsoid; SEGMENTS],
    after: [Ellipsoid; SEGMENTS],
    /// Column that stands for the whole body as an obstacle to other paths.
    pub column: Column,
    trunk: Column,
}

impl Snapshot {
    /// Computes the pose of a person at a time.
    pub fn new(motion: &Motion, time_s: f64) -> Self {
        let body = motion.body(time_s);
        let middle = 0.5 * (body[CHEST].centre + body[PELVIS].centre);
        let top = body[0].centre.z + body[0].semi_axes_m.z;
        let girth = body[CHEST].semi_axes_m;
        let column = Column { x: middle.x, y: middle.y, radius_m: 0.5 * (girth.x + girth.y), height_m: top };
        Snapshot {
            before: motion.body(time_s - VELOCITY_STEP_S),
            after: motion.body(time_s + VELOCITY_STEP_S),
            body,
            column,
            trunk: Column { radius_m: girth.x, height_m: top - 0.3, ..column },
        }
    }

    /// Returns the centre of a segment, m, its velocity, m/s, and its acceleration, m/s^2.
    pub fn centre(&self, segment: usize) -> (DVec3, DVec3, DVec3) {
        let centre = |body: &[Ellipsoid; SEGMENTS]| body.get(segment).map_or(DVec3::ZERO, |ellipsoid| ellipsoid.centre);
        let (before, now, after) = (centre(&self.before), centre(&self.body), centre(&self.after));
        let twice = 2.0 * VELOCITY_STEP_S;
        (now, (after - before) / twice, (after - 2.0 * now + before) / (VELOCITY_STEP_S * VELOCITY_STEP_S))
    }

    /// Velocity of the material at a specular point, m/s.
    fn velocity(&self, segment: usize, unit: DVec3) -> DVec3 {
        (self.after[segment].surface(unit) - self.before[segment].surface(unit)) / (2.0 * VELOCITY_STEP_S)
    }
}

/// Counters of the computation of echoes.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct EchoReport {
    /// Number of skin patches that exceed the audibility threshold and were synthesised.
    pub synthesised: usize,
    /// Number of amplitudes with a clamped distance or with an antenna inside a body.
    pub clamped: usize,
}

/// Appends all echoes of person number `target` at one time: `[pair][segment][rx]`, then the extra echoes of a person
/// at a desk. Paths that do not exist have amplitude zero.
pub fn echoes(
    prepared: &PreparedScene,
    motion: &Motion,
    people: &[Snapshot],
    target: usize,
    pairs: &[(ImageIndex, ImageIndex)],
    out: &mut Vec<PathSample>,
    report: &mut EchoReport,
) {
    let paths = Paths::new(prepared, motion, target, pairs);
    for path in 0..paths.count() {
        paths.trace(path, people, None, out, report);
    }
}

/// Returns the images without repetition, in ascending order.
fn distinct_images(images: impl Iterator<Item = ImageIndex>) -> Vec<ImageIndex> {
    images.collect::<BTreeSet<_>>().into_iter().collect()
}

/// Image positions of the antennas at both ends of a path.
struct PathEnds {
    /// Position of the transmitter's image.
    source: DVec3,
    /// Positions of the receivers' images.
    sinks: Vec<DVec3>,
}

/// Pair of antenna images: one of the transmitter, one of the receivers.
struct Pair {
    /// Paths from the image of the transmitter and from that of the first receiver.
    outbound: OneWayPath,
    inbound: OneWayPath,
    /// Image positions of the receivers.
    sinks: Vec<DVec3>,
    /// Ends of the reverse path, if the pair stands for it, too. Its amplitude is the same, by reciprocity: the
    /// antennas are some millimetres apart.
    reverse: Option<PathEnds>,
    /// Signs of the axes of both images, outbound and inbound.
    signs: [[f64; 3]; 2],
    /// Indices of both images in the list of the images of all pairs.
    images: [usize; 2],
}

/// Paths of a person, traced one by one or in batches. Their order is `[pair][segment]`, with the audible segments of
/// each pair, then the extra paths of a person at a desk. In rooms of plane faces the paths are valid for one frame,
/// because the edges near each path are determined once.
pub struct Paths<'a> {
    prepared: &'a PreparedScene,
    motion: &'a Motion,
    /// Index of the person whose paths these are.
    target: usize,
    pairs: Vec<Pair>,
    /// Number of distinct images in the pairs.
    images: usize,
    /// Pair index and segment of each specular point, in path order.
    specular_points: Vec<(usize, usize)>,
    /// Instruction set of the vectorised kernels.
    level: KernelLevel,
    /// Edges near the one-way path to each segment in rooms of plane faces, filled on first use: `[image][segment]`.
    path_edges: RefCell<Vec<PathEdges>>,
}

impl<'a> Paths<'a> {
    /// Builds the paths of these pairs of images, of which the first is the direct one. The pairs are pairs of indices
    /// for all segments, or [`AudiblePair`]s.
    pub fn new<P: Copy + Into<AudiblePair>>(
        prepared: &'a PreparedScene,
        motion: &'a Motion,
        target: usize,
        pairs: &[P],
    ) -> Self {
        let pairs: Vec<AudiblePair> = pairs.iter().map(|&pair| pair.into()).collect();
        let images = distinct_images(pairs.iter().flat_map(|&AudiblePair { pair: (p, q), .. }| [p, q]));
        let pair = |&AudiblePair { pair: (p, q), both_ways, .. }: &AudiblePair| {
            let ends = |p: ImageIndex, q: ImageIndex| {
                let sinks = prepared.rx.iter().map(|rx| prepared.room.image_position(q, rx.position));
                PathEnds {
                    source: prepared.room.image_position(p, prepared.tx.position),
                    sinks: sinks.collect::<Vec<DVec3>>(),
                }
            };
            let PathEnds { source, sinks } = ends(p, q);
            let first_rx = prepared.rx.first().unwrap_or(&prepared.tx);
            let outbound = OneWayPath { image: p, source, antenna: prepared.tx.position };
            let inbound =
                OneWayPath { image: q, source: *sinks.first().unwrap_or(&source), antenna: first_rx.position };
            let signs = [p, q].map(|image| BoxRoom::image_vector(image, DVec3::ONE).to_array());
            // The list holds every image of the pairs.
            let image_numbers = [p, q].map(|image| images.binary_search(&image).unwrap_or_default());
            Pair { outbound, inbound, sinks, reverse: both_ways.then(|| ends(q, p)), signs, images: image_numbers }
        };
        let points_of_pair = |(number, pair): (usize, &AudiblePair)| {
            let pair = *pair;
            (0..SEGMENTS).filter(move |&segment| pair.has(segment)).map(move |segment| (number, segment))
        };
        let specular_points = pairs.iter().enumerate().flat_map(points_of_pair).collect();
        let pairs = pairs.iter().map(pair).collect();
        let level = KernelLevel::detect();
        let entries = match prepared.room {
            Surroundings::Box(_) => 0,
            Surroundings::Polygons(_) => images.len() * SEGMENTS,
        };
        let (images, path_edges) = (images.len(), RefCell::new(vec![PathEdges::default(); entries]));
        Paths { prepared, motion, target, pairs, images, specular_points, level, path_edges }
    }

    /// Returns the number of paths.
    pub fn count(&self) -> usize {
        let desk_paths = self.motion.person.at_desk.as_ref().map_or(0, |desk| {
            let double_bounces = if desk.double_bounce > 0.0 { SEGMENTS } else { 0 };
            double_bounces + desk.points.len()
        });
        self.specular_points.len() + desk_paths
    }

    /// Traces one path at one time and appends a path sample for each receiver, of amplitude zero where the path does
    /// not exist. `near` is the specular point on the unit sphere of the segment at a neighbouring time. Returns the
    /// specular point at this time.
    pub fn trace(
        &self,
        path: usize,
        people: &[Snapshot],
        near: Option<DVec3>,
        out: &mut Vec<PathSample>,
        report: &mut EchoReport,
    ) -> Option<DVec3> {
        let mut instant = Instant { people, snapshot: people.get(self.target)?, obstructions: None };
        self.trace_at(path, &mut instant, near, out, report).map(|traced| traced.unit)
    }

    /// Traces one path as [`Self::trace`] does, at an instant whose obstructions may be shared between paths.
    fn trace_at(
        &self,
        path: usize,
        instant: &mut Instant,
        near: Option<DVec3>,
        out: &mut Vec<PathSample>,
        report: &mut EchoReport,
    ) -> Option<TracedPoint> {
        if let Some(&(number, segment)) = self.specular_points.get(path) {
            return self.specular_point(self.pairs.get(number)?, segment, instant, near, out, report);
        }
        let (desk, direct_pair) = (self.motion.person.at_desk.as_ref()?, self.pairs.first()?);
        let desk_path = path - self.specular_points.len();
        let double_bounces = if desk.double_bounce > 0.0 { SEGMENTS } else { 0 };
        let segment = if desk_path < double_bounces { desk_path } else { CHEST };
        let mut direct_samples = Vec::with_capacity(direct_pair.sinks.len());
        let traced = self.specular_point(direct_pair, segment, instant, near, &mut direct_samples, report);
        match desk.points.get(desk_path.wrapping_sub(double_bounces)) {
            Some(point) => body_point(self.prepared, desk, point, instant.people, self.target, &direct_samples, out),
            None => {
                direct_samples.iter().for_each(|sample| out.push(double_bounce(self.prepared, desk, segment, sample)))
            }
        }
        traced
    }

    /// Traces the path over the specular point of a segment for a pair of images.
    fn specular_point(
        &self,
        pair: &Pair,
        segment: usize,
        instant: &mut Instant,
        near: Option<DVec3>,
        out: &mut Vec<PathSample>,
        report: &mut EchoReport,
    ) -> Option<TracedPoint> {
        let (prepared, sinks) = (self.prepared, &pair.sinks);
        let snapshot = instant.snapshot;
        let ellipsoid = snapshot.body.get(segment)?;
        let found = if instant.is_fully_obstructed(pair, segment) {
            None
        } else {
            ellipsoid.specular_point(pair.outbound.source, pair.inbound.source, near)
        };
        let Some(specular) = found else {
            let delay_s = (pair.outbound.source.distance(ellipsoid.centre) * 2.0) / SPEED_OF_LIGHT_M_PER_S;
            let nothing = PathSample { delay_s, delay_rate: 0.0, amplitude: Complex64::ZERO };
            out.extend(sinks.iter().map(|_| nothing));
            return None;
        };
        let [outbound, inbound] = self.incident_fields(pair, segment, specular.point, instant)?;
        let weight = inside_room(prepared, specular.point)
            * outbound.obstruction_factor
            * inbound.obstruction_factor
            * grazing_factor(specular.cosine);
        let reflected = reflect_at_skin(outbound.field, -specular.towards.0, specular.normal);
        let clamped = specular.distances_m.0 < LEAST_DISTANCE_M || specular.distances_m.1 < LEAST_DISTANCE_M;
        report.clamped += usize::from(clamped || specular.inside.0 || specular.inside.1);
        let (r_t, r_r) = (specular.distances_m.0.max(LEAST_DISTANCE_M), specular.distances_m.1.max(LEAST_DISTANCE_M));
        let aperture = prepared.aperture_m();
        let spreading = 0.5 * aperture * specular.cosine / (specular.det_j.sqrt() * r_t * r_r);
        let cloth = self.motion.person.cloth.get(segment).copied().unwrap_or(1.0);
        let amplitude = reflected.received_by(inbound.field) * (spreading * cloth * weight);
        let velocity = snapshot.velocity(segment, specular.unit);
        for (rx, sink) in sinks.iter().enumerate() {
            let to_rx = *sink - specular.point;
            let distance_r = if specular.inside.1 { specular.distances_m.1 } else { to_rx.length() };
            let rate_t = if specular.inside.0 { 0.0 } else { -specular.towards.0.dot(velocity) };
            let rate_r = if specular.inside.1 { 0.0 } else { -(to_rx / distance_r.max(1e-9)).dot(velocity) };
            let delay_s = (specular.distances_m.0 + distance_r) / SPEED_OF_LIGHT_M_PER_S;
            let delay_rate = (rate_t + rate_r) / SPEED_OF_LIGHT_M_PER_S;
            let beat_hz = prepared.chirp.beat_hz(delay_s, delay_rate);
            out.push(PathSample { delay_s, delay_rate, amplitude: prepared.at_adc(rx, amplitude, beat_hz) });
        }
        Some(TracedPoint { unit: specular.unit, is_clear: outbound.is_clear && inbound.is_clear })
    }

    /// Returns the fields of both antenna images at a point of a segment.
    fn incident_fields(
        &self,
        pair: &Pair,
        segment: usize,
        point: DVec3,
        instant: &mut Instant,
    ) -> Option<[IncidentField; 2]> {
        let (prepared, people) = (self.prepared, instant.people);
        let first_rx = prepared.rx.first()?;
        let outbound = (&prepared.tx, &pair.outbound, pair.images[0]);
        let inbound = (first_rx, &pair.inbound, pair.images[1]);
        if let Some(obstructions) = &mut instant.obstructions {
            let mut shared = |(element, path, number): (&Element, &OneWayPath, usize)| {
                let incident = obstructions.field((number, path.image), element, segment, point)?;
                let own_body = own_body_factor(prepared, instant.snapshot, segment, path.source, point);
                Some(IncidentField {
                    obstruction_factor: incident.obstruction_factor * own_body,
                    is_clear: incident.is_clear && own_body == 1.0,
                    ..incident
                })
            };
            return Some([shared(outbound)?, shared(inbound)?]);
        }
        let fields =
            [outbound, inbound].map(|(element, path, _)| prepared.room.illuminate(element, path.image, point).field);
        // Without an incident field, the obstruction by people does not matter.
        let is_lit = fields.iter().all(|field| field.magnitude() > 0.0);
        let incident = |field: Phasor3, path: &OneWayPath| {
            let factor =
                if is_lit { obstruction_factor(prepared, people, self.target, segment, path, point) } else { 0.0 };
            IncidentField { field, obstruction_factor: factor, is_clear: false }
        };
        let [outbound_field, inbound_field] = fields;
        Some([incident(outbound_field, &pair.outbound), incident(inbound_field, &pair.inbound)])
    }
}

/// Specular point of a traced path.
#[derive(Debug, Clone, Copy)]
struct TracedPoint {
    /// The point on the unit sphere of the segment.
    unit: DVec3,
    /// Whether nothing obstructs the path, and no edge is beside it.
    is_clear: bool,
}

/// Field of an antenna's image at a point of a segment.
#[derive(Debug, Clone, Copy)]
struct IncidentField {
    field: Phasor3,
    /// Factor of obstruction by people.
    obstruction_factor: f64,
    /// Whether it is known that nobody obstructs the path and no edge is beside it.
    is_clear: bool,
}

/// People at the instant at which paths are traced.
struct Instant<'a> {
    people: &'a [Snapshot],
    /// Pose of the person whose echoes are traced.
    snapshot: &'a Snapshot,
    /// Obstructions of the one-way paths to segments, shared by specular points in rooms of plane faces.
    obstructions: Option<SharedObstructions<'a>>,
}

impl Instant<'_> {
    /// Returns whether one of the images is known to be fully obstructed at a segment.
    fn is_fully_obstructed(&mut self, pair: &Pair, segment: usize) -> bool {
        let Some(obstructions) = &mut self.obstructions else { return false };
        let ends = [(pair.images[0], pair.outbound.image), (pair.images[1], pair.inbound.image)];
        ends.into_iter().any(|(number, image)| obstructions.of(number, image, segment).is_none())
    }
}

/// Computes the double-bounce echo from the direct one, `sample`: the wave travels to the person, to the radar's board
/// or the desk under it, to the person again and back.
fn double_bounce(prepared: &PreparedScene, desk: &AtDesk, segment: usize, sample: &PathSample) -> PathSample {
    let delay_s = 2.0 * (sample.delay_s + desk.double_bounce_offset_m / SPEED_OF_LIGHT_M_PER_S);
    let delay_rate = 2.0 * sample.delay_rate;
    let response_once = prepared.filters.response(prepared.chirp.beat_hz(sample.delay_s, sample.delay_rate));
    let response_twice = prepared.filters.response(prepared.chirp.beat_hz(delay_s, delay_rate));
    // The amplitude of the direct echo contains the filter response at its own beat frequency. Only the chest is broad
    // enough to reflect a relevant field back to the small board.
    let amplitude = if response_once.norm_sqr() > 0.0 && segment == CHEST {
        sample.amplitude * (response_twice / response_once) * desk.double_bounce
    } else {
        Complex64::ZERO
    };
    PathSample { delay_s, delay_rate, amplitude }
}

/// Appends the echo of a shoulder, an arm or the lap, which the ellipsoids do not model: a path sample for each
/// receiver. It decays with the distance behind the nearest point of the chest.
fn body_point(
    prepared: &PreparedScene,
    desk: &AtDesk,
    body_point: &BodyPoint,
    people: &[Snapshot],
    target: usize,
    chest: &[PathSample],
    out: &mut Vec<PathSample>,
) {
    let (Some(snapshot), Some(first_rx)) = (people.get(target), prepared.rx.first()) else { return };
    let chest_m = chest.first().map_or(0.0, |sample| 0.5 * sample.delay_s * SPEED_OF_LIGHT_M_PER_S);
    // The echo has no path by way of walls.
    let direct = ImageIndex::default();
    let point = snapshot.body[CHEST].surface(body_point.place);
    let velocity = snapshot.velocity(CHEST, body_point.place);
    let path = |antenna: DVec3| OneWayPath { image: direct, source: antenna, antenna };
    let weight = inside_room(prepared, point)
        * obstruction_factor(prepared, people, target, CHEST, &path(prepared.tx.position), point)
        * obstruction_factor(prepared, people, target, CHEST, &path(first_rx.position), point);
    let outbound = prepared.room.illuminate(&prepared.tx, direct, point);
    let inbound = prepared.room.illuminate(first_rx, direct, point);
    let (r_t, r_r) = (outbound.distance_m.max(LEAST_DISTANCE_M), inbound.distance_m.max(LEAST_DISTANCE_M));
    let behind_m = (0.5 * (r_t + r_r) + body_point.detour_m - chest_m).max(0.0);
    let aperture = prepared.aperture_m();
    let fading = 10f64.powf(-0.05 * desk.point_decay_db_per_m * behind_m);
    let amplitude =
        outbound.field.received_by(inbound.field) * (aperture * body_point.scatter_m * fading * weight / (r_t * r_r));
    let from_tx = point - prepared.tx.position;
    for (rx, element) in prepared.rx.iter().enumerate() {
        let from_rx = point - element.position;
        let delay_s = (from_tx.length() + from_rx.length() + 2.0 * body_point.detour_m) / SPEED_OF_LIGHT_M_PER_S;
        let rate = from_tx.normalize_or_zero().dot(velocity) + from_rx.normalize_or_zero().dot(velocity);
        let delay_rate = rate / SPEED_OF_LIGHT_M_PER_S;
        let beat_hz = prepared.chirp.beat_hz(delay_s, delay_rate);
        out.push(PathSample { delay_s, delay_rate, amplitude: prepared.at_adc(rx, amplitude, beat_hz) });
    }
}

/// Returns 1 in a box room and 0 outside, with a smooth transition over the first 10 cm behind the planes of the walls.
/// A wall thus hides a person behind a door. An open wall hides nobody if the straight path from the transmitter leads
/// through it. The factor is always 1 where the field itself includes the walls: in rooms of polygons, and in boxes
/// whose walls transmit.
pub fn inside_room(prepared: &PreparedScene, point: DVec3) -> f64 {
    let Surroundings::Box(room) = &prepared.room else { return 1.0 };
    smooth_step((room.depth_within_m(prepared.tx.position, point) + 0.05) / 0.05)
}

/// Factor on a specular point's amplitude: 1 down to a cosine of incidence of 0.3, 0 from 0.1 on. Geometrical optics
/// does not describe forward scattering, so grazing specular points fade out.
fn grazing_factor(cosine: f64) -> f64 {
    smooth_step((cosine - 0.2) / 0.1)
}

/// Computes the field that skin reflects, with separate TE and TM coefficients at the true angle of incidence.
pub fn reflect_at_skin(incident: Phasor3, direction: DVec3, normal: DVec3) -> Phasor3 {
    let cosine = (-direction.dot(normal)).clamp(0.0, 1.0);
    let skin = half_space(SKIN_PERMITTIVITY, cosine);
    let (te, tm) = incidence_frame(direction, normal);
    let outgoing = direction + normal * (2.0 * cosine);
    let tm_out = te.cross(outgoing);
    Phasor3::combine(skin.te * incident.along(te), te, skin.tm * incident.along(tm), tm_out)
}
