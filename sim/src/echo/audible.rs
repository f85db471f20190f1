//! Selection of a person's echoes that may be audible, before any of them is traced.
//!
//! For each pair of images and each segment, a product bounds the amplitude. Its factors bound both images' fields over
//! the segment ([`BoxRoom::most_field`]), the strength of the specular point ([`Ellipsoid::bound`]), skin and clothes,
//! and the filters. In rooms of plane faces the bound includes the obstruction of the segment. A rejected path is
//! weaker throughout the frame than any path that is sampled through it.
//!
//! [`BoxRoom::most_field`]: crate::em::image::BoxRoom::most_field

use std::sync::Arc;

use glam::DVec3;
use radome_dsp::{KernelLevel, SPEED_OF_LIGHT_M_PER_S};

use super::facing_rows::{EllipsoidRows, facing_rows};
use super::obstruction::facing_point;
use super::{EchoReport, LEAST_DISTANCE_M, Snapshot, distinct_images, echoes, grazing_factor};
use crate::em::fresnel::half_space;
use crate::em::image::{BoxRoom, ImageIndex, order};
use crate::em::specular::Ellipsoid;
use crate::lanes::WIDE;
use crate::material::SKIN_PERMITTIVITY;
use crate::paths::{PolygonRoom, Surroundings};
use crate::people::body::{CHEST, SEGMENTS};
use crate::people::motion::Motion;
use crate::prepared_scene::PreparedScene;

/// Bound on the square root of a body's cross-section over 4 pi, m: half the radius of a trunk's flattest side.
const BODY_BOUND_M: f64 = 0.25;
/// Largest distance of any part of a body from the middle of its trunk, m.
const BODY_REACH_M: f64 = 1.2;
/// Fraction of the threshold of a single path below which paths are not traced. Path sampling uses the same limit.
pub const AUDIBLE_FRACTION: f64 = 0.5;
/// Largest factor by which edges increase a field where rays arrive: 1.17 for each of two edges that cross. More is
/// possible only in slits as narrow as a Fresnel zone. Paths that are lost there are weaker than the threshold of a
/// single path.
const MAX_IN_LIGHT: f64 = 1.4;
/// Largest fraction of a field that remains behind a straight edge.
const MAX_IN_SHADOW: f64 = 0.5;
/// Largest factor by which the field in an edge's shadow grows within a frame, where no ray arrives.
const SHADOW_GROWTH: f64 = 2.0;
/// Largest speed of any part of a body along a path, m/s. It limits the Doppler shift in the filter response.
const MAX_SPEED_M_PER_S: f64 = 10.0;

/// Pair of antenna images, and the segments of a person that may be audible through it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct AudiblePair {
    /// Images of the transmitter and of the receivers.
    pub pair: (ImageIndex, ImageIndex),
    /// Bit mask of segments.
    pub segments: u16,
    /// Whether the pair stands for the opposite direction, too: that with exchanged images.
    pub both_ways: bool,
}

impl AudiblePair {
    /// Returns whether a segment may be audible.
    pub fn has(&self, segment: usize) -> bool {
        (self.segments >> segment) & 1 == 1
    }
}

impl From<(ImageIndex, ImageIndex)> for AudiblePair {
    /// Returns the pair with all segments.
    fn from(pair: (ImageIndex, ImageIndex)) -> Self {
        AudiblePair { pair, segments: (1 << SEGMENTS) - 1, both_ways: false }
    }
}

/// Selects image pairs, with the segments of a person that may be audible through them at any of these instants. Each
/// pair of different images stands for both directions. The direct pair is the first and is always kept.
pub fn audible_paths(prepared: &PreparedScene, motion: &Motion, instants_s: &[f64]) -> Vec<AudiblePair> {
    let bodies: Vec<[Ellipsoid; SEGMENTS]> = instants_s.iter().map(|&time_s| motion.body(time_s)).collect();
    let images = Images::near(prepared, &bodies);
    let bounds: Vec<SegmentBound> =
        (0..SEGMENTS).filter_map(|segment| SegmentBound::new(prepared, motion, &images, segment, &bodies)).collect();
    let lights_any = |image: usize| bounds.iter().any(|bound| bound.is_lit_by(image));
    let mut pairs = images.pairs(prepared, lights_any);
    // The list has every pair in both orders.
    pairs.retain(|[p, q]| p <= q);
    let mut segments = vec![0u16; pairs.len()];
    for (segment, bound) in bounds.iter().enumerate() {
        for (segments, &images_of_pair) in segments.iter_mut().zip(&pairs) {
            *segments |= u16::from(bound.is_audible(prepared, images_of_pair)) << segment;
        }
    }
    let audible_pair = |(images_of_pair, segments): ([usize; 2], u16)| {
        let [p, q] = images_of_pair.map(|number| images.indices[number]);
        let is_direct = prepared.room.order(p) + prepared.room.order(q) == 0;
        (segments != 0 || is_direct).then_some(AudiblePair { pair: (p, q), segments, both_ways: p != q })
    };
    pairs.into_iter().zip(segments).filter_map(audible_pair).collect()
}

/// Images of the transmitter, which stand for those of all antennas.
struct Images {
    /// The images, ascending.
    indices: Vec<ImageIndex>,
    /// In rooms of plane faces, whether each image may light each segment at each instant, if nothing is hidden:
    /// `[image][segment][instant]`.
    may_light: Vec<bool>,
    instants: usize,
    /// Distance of the farthest receiver from the transmitter, m.
    array_size_m: f64,
}

impl Images {
    /// Finds the images that may light these bodies of a person.
    fn near(prepared: &PreparedScene, bodies: &[[Ellipsoid; SEGMENTS]]) -> Self {
        let antenna = prepared.tx.position;
        let array_size_m = prepared.rx.iter().map(|rx| rx.position.distance(antenna)).fold(0.0, f64::max);
        let instants = bodies.len();
        let (indices, may_light) = match &prepared.room {
            Surroundings::Box(_) => {
                (distinct_images(prepared.body_pairs.iter().flat_map(|&(p, q)| [p, q])), Vec::new())
            }
            Surroundings::Polygons(room) => {
                let middle = bodies.get(instants / 2).map_or(DVec3::ZERO, |body| body[CHEST].centre);
                let reach = |e: &Ellipsoid| e.semi_axes_m.max_element() + e.centre.distance(middle);
                let reach_m = bodies.iter().flatten().map(reach).fold(0.0, f64::max);
                let indices = room.images_near(antenna, middle, reach_m);
                let may_light = may_light(room, antenna, &indices, bodies);
                (indices, may_light)
            }
        };
        Images { indices, may_light, instants, array_size_m }
    }

    /// Returns whether an image may light a segment at each instant.
    fn may_light(&self, image: usize, segment: usize) -> &[bool] {
        let first = (image * SEGMENTS + segment) * self.instants;
        self.may_light.get(first..first + self.instants).unwrap_or_default()
    }

    /// Returns the pairs of images of which both light the body or are the antennas themselves, as indices, in both
    /// orders. The direct pair is the first.
    fn pairs(&self, prepared: &PreparedScene, lights: impl Fn(usize) -> bool) -> Vec<[usize; 2]> {
        let counts: Vec<bool> =
            self.indices.iter().zip(0..).map(|(image, number)| *image == [0; 3] || lights(number)).collect();
        // The list holds every image of the pairs.
        let number_of = |index: &ImageIndex| self.indices.binary_search(index).unwrap_or_default();
        match &prepared.room {
            Surroundings::Box(_) => {
                let all = prepared.body_pairs.iter().map(|(p, q)| [number_of(p), number_of(q)]);
                all.filter(|[p, q]| counts[*p] && counts[*q]).collect()
            }
            Surroundings::Polygons(room) => {
                let kept: Vec<usize> = (0..self.indices.len()).filter(|&number| counts[number]).collect();
                let indices: Vec<ImageIndex> = kept.iter().map(|&number| self.indices[number]).collect();
                room.pairs_among(&indices).into_iter().map(|pair| pair.map(|i| kept[i])).collect()
            }
        }
    }
}

/// Returns whether each image may light the side of each segment that faces it at each instant, if nothing is hidden:
/// `[image][segment][instant]`.
fn may_light(room: &PolygonRoom, antenna: DVec3, images: &[ImageIndex], bodies: &[[Ellipsoid; SEGMENTS]]) -> Vec<bool> {
    let of_segment = |segment: usize| bodies.iter().filter_map(move |body| body.get(segment)).copied();
    let all: Vec<Ellipsoid> = (0..SEGMENTS).flat_map(of_segment).collect();
    let (level, rows) = (KernelLevel::detect(), EllipsoidRows::of(&all));
    let mut points = vec![[[0.0; WIDE]; 3]; rows.len()];
    // Positive in lanes whose points the image may light.
    let mut hits = vec![[0.0; WIDE]; rows.len()];
    let mut may_light = Vec::with_capacity(images.len() * all.len());
    for &index in images {
        let source = room.image_position(index, antenna).to_array();
        rows.iter().zip(&mut points).for_each(|(row, points)| facing_rows(level, row, source, points));
        hits.fill([0.0; WIDE]);
        room.add_reached(level, index, antenna, &points, &mut hits);
        may_light.extend(hits.as_flattened().iter().take(all.len()).map(|&hit| hit > 0.0));
    }
    may_light
}

/// Bound on the field of an image at a segment.
#[derive(Debug, Clone, Copy, Default)]
struct FieldBound {
    source: DVec3,
    /// Distance from the middle of the segment, m.
    distance_m: f64,
    /// Upper bound of field over distance, 1/m.
    max_per_m: f64,
}

/// Bounds of a segment's echoes at some instants.
struct SegmentBound {
    /// The segment at each instant.
    ellipsoids: Vec<Ellipsoid>,
    /// Largest strength of an echo from any side, m.
    max_strength_m: f64,
    /// Bounds of the incident field by image.
    fields: Vec<FieldBound>,
    /// Common factor of the amplitudes, LSB m.
    lsb_m: f64,
    /// Largest distance of any point of the segment at any instant from its centre at the middle instant, m.
    reach_m: f64,
    /// Distance of the farthest receiver from the transmitter, m.
    array_size_m: f64,
}

impl SegmentBound {
    /// Computes the bounds; `None` if there is no instant.
    fn new(
        prepared: &PreparedScene,
        motion: &Motion,
        images: &Images,
        segment: usize,
        bodies: &[[Ellipsoid; SEGMENTS]],
    ) -> Option<Self> {
        let ellipsoids: Vec<Ellipsoid> = bodies.iter().filter_map(|body| body.get(segment)).copied().collect();
        let middle = ellipsoids.get(ellipsoids.len() / 2)?.centre;
        let largest = |of: &dyn Fn(&Ellipsoid) -> f64| ellipsoids.iter().map(of).fold(0.0, f64::max);
        let max_strength_m = largest(&|e| 0.5 * e.semi_axes_m.element_product() / e.semi_axes_m.min_element().powi(2));
        let reach_m = images.array_size_m + largest(&|e| e.semi_axes_m.max_element() + e.centre.distance(middle));
        let cloth = motion.person.cloth.get(segment).copied().unwrap_or(1.0);
        let lsb_m = prepared.lsb.first().copied().unwrap_or_default() * prepared.aperture_m() * cloth;
        let array_size_m = images.array_size_m;
        let mut bound = SegmentBound { ellipsoids, max_strength_m, fields: Vec::new(), lsb_m, reach_m, array_size_m };
        bound.fields = match &prepared.room {
            Surroundings::Box(room) => bound.bounds_in_box(prepared, room, images, middle),
            Surroundings::Polygons(room) => bound.bounds_by_facets(prepared, room, images, segment, middle),
        };
        Some(bound)
    }

    /// Bounds the fields of images of a box.
    fn bounds_in_box(
        &self,
        prepared: &PreparedScene,
        room: &BoxRoom,
        images: &Images,
        middle: DVec3,
    ) -> Vec<FieldBound> {
        let is_behind = self.ellipsoids.iter().all(|e| room.is_behind_walls(e.centre, e.half_widths_m()));
        let bounded = |&index: &ImageIndex| {
            let bound = FieldBound::new(prepared, index, middle, self.reach_m);
            if is_behind && order(index) > 0 { FieldBound { max_per_m: 0.0, ..bound } } else { bound }
        };
        images.indices.iter().map(bounded).collect()
    }

    /// Bounds the fields of images by facets, with their obstruction.
    fn bounds_by_facets(
        &self,
        prepared: &PreparedScene,
        room: &PolygonRoom,
        images: &Images,
        segment: usize,
        middle: DVec3,
    ) -> Vec<FieldBound> {
        let bounded = |(number, &index): (usize, &ImageIndex)| {
            let may_count = room.counts_in_shadow(index) || images.may_light(number, segment).contains(&true);
            if may_count { FieldBound::new(prepared, index, middle, self.reach_m) } else { FieldBound::default() }
        };
        let mut bounds: Vec<FieldBound> = images.indices.iter().enumerate().map(bounded).collect();
        let max_per_m = bounds.iter().map(|bound| bound.max_per_m).fold(0.0, f64::max);
        // Weaker images are inaudible even when paired with the strongest; skip their obstruction.
        let by_edges = room.paths().most_by_edges();
        let threshold_lsb = AUDIBLE_FRACTION * prepared.threshold_lsb;
        let least_per_m = threshold_lsb / (self.lsb_m * self.max_strength_m * max_per_m * by_edges * by_edges);
        for ((number, &index), bound) in images.indices.iter().enumerate().zip(&mut bounds) {
            let may_be_audible = bound.max_per_m > least_per_m;
            let least = least_per_m / bound.max_per_m;
            let may_light = images.may_light(number, segment);
            let obstruction =
                || obstruction_bound(prepared, room, index, bound.source, &self.ellipsoids, may_light, least);
            bound.max_per_m *= if may_be_audible { obstruction() } else { 0.0 };
        }
        bounds
    }

    /// Returns whether an image may light the segment.
    fn is_lit_by(&self, image: usize) -> bool {
        self.fields.get(image).is_some_and(|bound| bound.max_per_m > 0.0)
    }

    /// Returns whether the segment may be audible through a pair of images.
    fn is_audible(&self, prepared: &PreparedScene, [outbound, inbound]: [usize; 2]) -> bool {
        let (Some(outbound), Some(inbound)) = (self.fields.get(outbound), self.fields.get(inbound)) else {
            return false;
        };
        if outbound.max_per_m * inbound.max_per_m == 0.0 {
            return false;
        }
        let length_m = outbound.distance_m + inbound.distance_m;
        let response = max_filter_response(prepared, length_m - 2.0 * self.reach_m, length_m + 2.0 * self.reach_m);
        let per_m = self.lsb_m * outbound.max_per_m * inbound.max_per_m * response;
        let threshold_lsb = AUDIBLE_FRACTION * prepared.threshold_lsb;
        // This cheap test rejects most paths: even the flattest side of the segment is too weak.
        if per_m * self.max_strength_m <= threshold_lsb {
            return false;
        }
        self.ellipsoids.iter().any(|ellipsoid| {
            let bound = ellipsoid.bound(outbound.source, inbound.source, self.array_size_m);
            let Some(bound) = bound else { return false };
            let amplitude = per_m * bound.strength_m * grazing_factor(bound.most_cosine);
            // The reflection coefficient of skin is largest at the smallest cosine of incidence, for TE.
            let skin = || half_space(SKIN_PERMITTIVITY, bound.least_cosine.clamp(0.0, 1.0)).te.norm();
            amplitude > threshold_lsb && amplitude * skin() > threshold_lsb
        })
    }
}

impl FieldBound {
    /// Bounds the unobstructed field within a distance of a point.
    fn new(prepared: &PreparedScene, index: ImageIndex, middle: DVec3, reach_m: f64) -> Self {
        let source = prepared.room.image_position(index, prepared.tx.position);
        let offset = middle - source;
        let distance_m = offset.length();
        let nearest_m = (distance_m - reach_m).max(LEAST_DISTANCE_M);
        let field = match &prepared.room {
            _ if distance_m <= reach_m => 1.0,
            Surroundings::Polygons(room) => room.most_free_field(&prepared.tx, index, middle, reach_m),
            Surroundings::Box(room) => {
                let spread_rad = (reach_m / distance_m).asin();
                room.most_field(&prepared.tx, index, offset / distance_m, spread_rad)
            }
        };
        FieldBound { source, distance_m, max_per_m: field / nearest_m }
    }
}

/// Bounds the factor of obstruction on an image's field, at any of these segments or instants; `may_light` tells where
/// the image may light one. Specular points of frames have the same obstructions
/// ([`SharedObstructions`](super::obstruction::SharedObstructions)). A field below the fraction `least` is inaudible.
fn obstruction_bound(
    prepared: &PreparedScene,
    room: &PolygonRoom,
    index: ImageIndex,
    source: DVec3,
    ellipsoids: &[Ellipsoid],
    may_light: &[bool],
    least: f64,
) -> f64 {
    let (antenna, middle) = (prepared.tx.position, ellipsoids.len() / 2);
    let all = ellipsoids.iter().zip(may_light);
    // Start with the middle, which most often decides.
    let mut all = all.clone().skip(middle).chain(all.take(middle)).filter(|(_, may_light)| **may_light);
    if all.any(|(ellipsoid, _)| room.is_lit(index, antenna, facing_point(ellipsoid, source))) {
        return room.paths().most_by_edges().min(MAX_IN_LIGHT);
    }
    if least > MAX_IN_SHADOW || !room.counts_in_shadow(index) {
        return 0.0;
    }
    let factor_in_shadow =
        |ellipsoid: &Ellipsoid| room.obstruction(index, antenna, facing_point(ellipsoid, source), None).bound();
    ellipsoids.get(middle).map_or(0.0, |ellipsoid| SHADOW_GROWTH * factor_in_shadow(ellipsoid))
}

/// Returns the largest filter response to a path with a length in this range, m.
fn max_filter_response(prepared: &PreparedScene, low_m: f64, high_m: f64) -> f64 {
    let hz_per_m = prepared.chirp.slope_hz_per_s.abs() / SPEED_OF_LIGHT_M_PER_S;
    let doppler_hz = 2.0 * MAX_SPEED_M_PER_S / prepared.wavelength_m;
    let (low_hz, high_hz) = ((hz_per_m * low_m - doppler_hz).max(0.0), hz_per_m * high_m + doppler_hz);
    (prepared.filters.high_pass_power(high_hz) * prepared.filters.anti_alias_power(low_hz)).sqrt()
}

/// Selects the image pairs through which a person may be audible, by a bound at the trunk.
pub fn audible_pairs(prepared: &PreparedScene, motion: &Arc<Motion>, time_s: f64) -> Vec<(ImageIndex, ImageIndex)> {
    let body = motion.body(time_s);
    let centre = body[CHEST].centre;
    let aperture = prepared.aperture_m();
    let lsb = prepared.lsb.first().copied().unwrap_or(0.0) * aperture * BODY_BOUND_M;
    let images = Images::near(prepared, &[body]);
    // Bound of the field over distance, 1/m, and distance, m.
    let field_bound = |(number, &index): (usize, &ImageIndex)| match &prepared.room {
        Surroundings::Box(room) => {
            let illumination = room.illuminate(&prepared.tx, index, centre);
            (illumination.field.magnitude() / illumination.distance_m.max(0.2), illumination.distance_m)
        }
        // An arm may be visible where the trunk is hidden.
        Surroundings::Polygons(room) => {
            let source = prepared.room.image_position(index, prepared.tx.position);
            let offset = centre - source;
            let distance_m = offset.length();
            let most = room.most_free_field(&prepared.tx, index, centre, BODY_REACH_M);
            let may_light = images.may_light.get(number * SEGMENTS..).unwrap_or_default();
            let obstruction =
                if most > 0.0 { obstruction_bound(prepared, room, index, source, &body, may_light, 0.0) } else { 0.0 };
            (most * obstruction / (distance_m - BODY_REACH_M).max(0.2), distance_m)
        }
    };
    let field_bounds: Vec<(f64, f64)> = images.indices.iter().enumerate().map(field_bound).collect();
    let is_audible = |&[outbound, inbound]: &[usize; 2]| {
        if prepared.room.order(images.indices[outbound]) + prepared.room.order(images.indices[inbound]) == 0 {
            return true;
        }
        let ((outbound_per_m, outbound_m), (inbound_per_m, inbound_m)) =
            (field_bounds[outbound], field_bounds[inbound]);
        let beat_hz = prepared.chirp.beat_hz((outbound_m + inbound_m) / SPEED_OF_LIGHT_M_PER_S, 0.0);
        lsb * outbound_per_m * inbound_per_m * prepared.filters.response(beat_hz).norm() > prepared.threshold_lsb
    };
    let pairs = images.pairs(prepared, |image| field_bounds[image].0 > 0.0).into_iter().filter(is_audible);
    pairs.map(|[p, q]| (images.indices[p], images.indices[q])).collect()
}

/// Selects the image pairs through which all echoes of person number `target`, approximated by ellipsoids, are together
/// above the threshold. Returns them with the strength of these echoes, LSB, the strongest first.
pub fn loud_pairs(
    prepared: &PreparedScene,
    motion: &Motion,
    people: &[Snapshot],
    target: usize,
    pairs: &[(ImageIndex, ImageIndex)],
) -> Vec<((ImageIndex, ImageIndex), f64)> {
    let (mut samples, mut report) = (Vec::new(), EchoReport::default());
    let mut loud: Vec<_> = pairs
        .iter()
        .map(|&pair| {
            samples.clear();
            echoes(prepared, motion, people, target, &[pair], &mut samples, &mut report);
            let of_first_receiver = samples.iter().step_by(prepared.rx.len().max(1));
            let power: f64 = of_first_receiver.map(|sample| sample.amplitude.norm_sqr()).sum();
            (pair, power.sqrt())
        })
        .filter(|(_, strength_lsb)| *strength_lsb > prepared.threshold_lsb)
        .collect();
    loud.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
    loud
}
