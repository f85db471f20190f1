//! Traces many paths of a person at one instant: specular points of a segment for pairs of images, vectorised where
//! possible ([`super::path_rows`]). Cases that the vectorised code does not cover, such as rooms other than boxes, are
//! traced path by path. That method is also the reference for the vectorised code.
//!
//! A path is first traced without people in the room, which bounds its amplitude from above. Obstruction by people is
//! computed only for the audible paths.

use glam::DVec3;
use num_complex::Complex64;
use radome_dsp::SPEED_OF_LIGHT_M_PER_S;

use super::obstruction::{Bystanders, OneWayPath, SharedObstructions, limb_column, opposite_limb};
use super::path_rows::{
    LengthRows, ReceivedRows, SurfaceMotion, WideFields, path_amplitudes, path_lengths, receiver_echoes,
    transmitted_fields,
};
use super::{
    EchoReport, Instant, LEAST_DISTANCE_M, Pair, PathEnds, Paths, Snapshot, VELOCITY_STEP_S, grazing_factor,
    inside_room,
};
use crate::diffraction::attenuate_rows;
use crate::em::Phasor3;
use crate::em::image::{BoxRoom, order};
use crate::em::specular::LEAST_COSINE;
use crate::em::specular_rows::{SpecularRows, specular_points};
use crate::lanes::vector::store;
use crate::lanes::{WIDE, WideRow, WideRow3, compiled_for_levels, wide_lane};
use crate::material::SKIN_PERMITTIVITY;
use crate::path_segment::PathSample;
use crate::paths::Surroundings;
use crate::people::body::SEGMENTS;
use crate::tracks::RECEIVERS;

/// Sample of a path that does not exist.
const NO_PATH: PathSample = PathSample { delay_s: 0.0, delay_rate: 0.0, amplitude: Complex64::ZERO };

/// Path at an instant, to each receiver.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TracedPath {
    samples: [PathSample; RECEIVERS],
    receivers: usize,
    /// Delay, s, and its rate to each receiver of the reverse path, which has the same amplitude, if the path stands
    /// for both directions.
    reverse: [[f64; 2]; RECEIVERS],
    /// Specular point on the segment, as a point of the unit sphere; `None` where the path does not exist.
    pub unit: Option<DVec3>,
    /// Specular point in the room, m.
    point: DVec3,
    /// Whether the obstruction by people must still be applied ([`Paths::obstruct_by_people`]).
    lacks_people: bool,
    /// Whether neither people nor the reflecting person's own limbs and trunk weaken the path, and no edge of a facet
    /// is near it.
    pub is_clear: bool,
}

impl TracedPath {
    /// Builds a path from a sample for each receiver.
    pub fn new(samples: &[PathSample], unit: Option<DVec3>) -> Self {
        let mut path = TracedPath {
            samples: [NO_PATH; RECEIVERS],
            receivers: 0,
            reverse: [[0.0; 2]; RECEIVERS],
            unit,
            point: DVec3::ZERO,
            lacks_people: false,
            is_clear: false,
        };
        for (to, sample) in path.samples.iter_mut().zip(samples) {
            *to = *sample;
            path.receivers += 1;
        }
        path
    }

    /// Returns a sample for each receiver, of amplitude zero where the path does not exist.
    pub fn samples(&self) -> &[PathSample] {
        self.samples.get(..self.receivers).unwrap_or_default()
    }

    /// Returns the reverse of a path that stands for both directions ([`Paths::is_both_ways`]).
    pub fn reversed(&self) -> Self {
        let mut reversed = *self;
        for (sample, [delay_s, delay_rate]) in reversed.samples.iter_mut().zip(self.reverse) {
            (sample.delay_s, sample.delay_rate) = (delay_s, delay_rate);
        }
        reversed
    }
}

/// Returns the vector of one lane.
fn vector(rows: &WideRow3, l: usize) -> DVec3 {
    DVec3::from_array(wide_lane(rows, l))
}

impl Snapshot {
    /// Returns the motion of the surface of a segment.
    fn surface_motion(&self, segment: usize) -> Option<SurfaceMotion> {
        let (before, after) = (self.before.get(segment)?, self.after.get(segment)?);
        let per_s = |step: DVec3| (step / (2.0 * VELOCITY_STEP_S)).to_array();
        let axis =
            |i: usize| per_s(after.axes.col(i) * after.semi_axes_m[i] - before.axes.col(i) * before.semi_axes_m[i]);
        Some(SurfaceMotion([per_s(after.centre - before.centre), axis(0), axis(1), axis(2)]))
    }
}

/// Time in which no body can begin and end to obstruct a path, s: two people who run past each other take longer.
const PASSING_S: f64 = 0.05;

impl Paths<'_> {
    /// Returns the segment on which a path has its specular point; `None` for the extra paths of a person at a desk.
    pub fn segment(&self, path: usize) -> Option<usize> {
        self.specular_points.get(path).map(|&(_, segment)| segment)
    }

    /// Returns whether a path stands for both directions.
    pub fn is_both_ways(&self, path: usize) -> bool {
        let pair = self.specular_points.get(path).and_then(|&(number, _)| self.pairs.get(number));
        pair.is_some_and(|pair| pair.reverse.is_some())
    }

    /// Returns the delays of the reverse path, s, and their rates, for the specular point of a path.
    fn reverse_delays(&self, path: usize, snapshot: &Snapshot, unit: DVec3) -> Option<[[f64; 2]; RECEIVERS]> {
        let &(number, segment) = self.specular_points.get(path)?;
        let PathEnds { source, sinks } = self.pairs.get(number)?.reverse.as_ref()?;
        let (point, velocity) = (snapshot.body.get(segment)?.surface(unit), snapshot.velocity(segment, unit));
        let length = |end: DVec3| {
            let offset = point - end;
            [offset.length(), offset.normalize_or_zero().dot(velocity)]
        };
        let (outbound, mut delays) = (length(*source), [[0.0; 2]; RECEIVERS]);
        for (delay, sink) in delays.iter_mut().zip(sinks) {
            let inbound = length(*sink);
            *delay = [0, 1].map(|order| (outbound[order] + inbound[order]) / SPEED_OF_LIGHT_M_PER_S);
        }
        Some(delays)
    }

    /// Returns for each segment whether a body or the opposite limb may begin and end to obstruct it within a time.
    /// `people` are snapshots near that time.
    pub fn may_be_obstructed(&self, people: &[Snapshot], within_s: f64) -> [bool; SEGMENTS] {
        let Some(snapshot) = people.get(self.target).filter(|_| within_s <= PASSING_S) else {
            return [true; SEGMENTS];
        };
        std::array::from_fn(|segment| {
            let Some(other) = opposite_limb(segment) else { return false };
            let Some(limb) = snapshot.body.get(other) else { return false };
            let speed = (snapshot.centre(segment).1 - snapshot.centre(other).1).truncate().length();
            speed * within_s > 2.0 * limb_column(limb).radius_m
        })
    }

    /// Traces paths at one instant. In box rooms they are traced without obstruction by people, which
    /// [`Paths::obstruct_by_people`] applies afterwards. Each request gives the path's index and its specular point at
    /// a neighbouring time.
    pub fn trace_all(
        &self,
        requests: &[(usize, Option<DVec3>)],
        people: &[Snapshot],
        report: &mut EchoReport,
    ) -> Vec<TracedPath> {
        let mut traced = vec![TracedPath::new(&[], None); requests.len()];
        if let Surroundings::Box(room) = &self.prepared.room {
            let mut by_segment: [Vec<usize>; SEGMENTS] = Default::default();
            for (request, &(path, _)) in requests.iter().enumerate() {
                if let Some(&(_, segment)) = self.specular_points.get(path) {
                    by_segment[segment].push(request);
                }
            }
            for (segment, of_segment) in by_segment.iter().enumerate() {
                for lanes in of_segment.chunks(WIDE) {
                    self.trace_lanes(room, segment, lanes, requests, people, &mut traced, report);
                }
            }
        }
        let Some(snapshot) = people.get(self.target) else { return traced };
        let obstructions = match &self.prepared.room {
            Surroundings::Box(_) => None,
            Surroundings::Polygons(room) => {
                Some(SharedObstructions::new(self.prepared, room, people, self.target, &self.path_edges))
            }
        };
        let mut instant = Instant { people, snapshot, obstructions };
        // The remaining paths: those that lanes do not cover, and the extra paths of a person at a desk.
        let mut samples = Vec::with_capacity(RECEIVERS);
        for (traced, &(path, near)) in traced.iter_mut().zip(requests).filter(|(traced, _)| traced.receivers == 0) {
            samples.clear();
            let found = self.trace_at(path, &mut instant, near, &mut samples, report);
            *traced = TracedPath::new(&samples, found.map(|found| found.unit));
            traced.is_clear = found.is_some_and(|found| found.is_clear);
            if let Some(reverse) = traced.unit.and_then(|unit| self.reverse_delays(path, snapshot, unit)) {
                traced.reverse = reverse;
            }
        }
        traced
    }

    /// Applies the obstruction by people to paths at one instant, once. Paths are given with their indices.
    pub fn obstruct_by_people<'m>(
        &self,
        traced: impl IntoIterator<Item = (usize, &'m mut TracedPath)>,
        people: &[Snapshot],
    ) {
        // In other rooms tracing already includes the people.
        let Surroundings::Box(room) = &self.prepared.room else { return };
        let mut bystanders = Bystanders::new(self.prepared, room, people, self.target, 2 * self.images);
        for (path, traced) in traced.into_iter().filter(|(_, traced)| traced.lacks_people) {
            traced.lacks_people = false;
            let pair = self.specular_points.get(path).and_then(|&(number, _)| self.pairs.get(number));
            let Some(Pair { outbound, inbound, images, .. }) = pair else { continue };
            // Images of the transmitter and of the receivers are some millimetres apart, so they have separate entries.
            let factor = bystanders.factor(2 * images[0], outbound, traced.point)
                * bystanders.factor(2 * images[1] + 1, inbound, traced.point);
            traced.is_clear &= factor == 1.0;
            traced.samples.iter_mut().for_each(|sample| sample.amplitude *= factor);
        }
    }

    /// Traces paths over one segment in lanes: those of `requests` at the indices `lanes`, at most one per lane. Paths
    /// that cannot be traced in lanes keep zero receivers.
    #[allow(clippy::too_many_arguments)]
    fn trace_lanes(
        &self,
        room: &BoxRoom,
        segment: usize,
        lanes: &[usize],
        requests: &[(usize, Option<DVec3>)],
        people: &[Snapshot],
        traced: &mut [TracedPath],
        report: &mut EchoReport,
    ) {
        let Some(snapshot) = people.get(self.target) else { return };
        let (Some(ellipsoid), Some(motion)) = (snapshot.body.get(segment), snapshot.surface_motion(segment)) else {
            return;
        };
        let pair = |lane: usize| {
            let &(path, _) = requests.get(*lanes.get(lane)?)?;
            let &(number, _) = self.specular_points.get(path)?;
            self.pairs.get(number)
        };
        // Unused lanes repeat the first pair.
        let Some(first) = pair(0) else { return };
        let pairs: [&Pair; WIDE] = std::array::from_fn(|l| pair(l).unwrap_or(first));
        let mut sources = [[[0.0; WIDE]; 3]; 2];
        for (l, pair) in pairs.iter().enumerate() {
            store(&mut sources[0], l, pair.outbound.source.to_array());
            store(&mut sources[1], l, pair.inbound.source.to_array());
        }
        let mut specular = SpecularRows::default();
        specular_points(self.level, ellipsoid, &sources, &mut specular);
        let unobstructed = self.unobstructed_factors(segment, &specular);
        let factors = self.obstructed_by_own_body(segment, snapshot, &sources, &specular, &unobstructed);
        let fields = self.fields(room, &pairs, &factors, &specular);
        let mut amplitude = [[0.0; WIDE]; 2];
        path_amplitudes(self.level, SKIN_PERMITTIVITY, &specular, &fields, &factors, &mut amplitude);
        for (l, &request) in lanes.iter().enumerate().filter(|&(l, _)| specular.found[l] != 0.0) {
            let Some(traced) = traced.get_mut(request) else { continue };
            traced.receivers = self.prepared.rx.len().min(RECEIVERS);
            if specular.cosine[l] <= LEAST_COSINE {
                let delay_s = (pairs[l].outbound.source.distance(ellipsoid.centre) * 2.0) / SPEED_OF_LIGHT_M_PER_S;
                traced.samples = [PathSample { delay_s, ..NO_PATH }; RECEIVERS];
                continue;
            }
            let nearest_m = specular.distances_m[0][l].min(specular.distances_m[1][l]);
            report.clamped += usize::from(nearest_m < LEAST_DISTANCE_M);
            traced.unit = Some(vector(&specular.unit, l));
            traced.point = vector(&specular.point, l);
            traced.is_clear = factors[l] == unobstructed[l];
            traced.lacks_people = amplitude[0][l] != 0.0 || amplitude[1][l] != 0.0;
        }
        self.store_samples(lanes, &pairs, &specular, &motion, &amplitude, traced);
    }

    /// Writes the samples of each receiver for the paths that were found.
    fn store_samples(
        &self,
        lanes: &[usize],
        pairs: &[&Pair; WIDE],
        specular: &SpecularRows,
        motion: &SurfaceMotion,
        amplitude: &[WideRow; 2],
        traced: &mut [TracedPath],
    ) {
        let ends = |end: &dyn Fn(&Pair) -> Option<DVec3>| {
            let mut ends = [[0.0; WIDE]; 3];
            for (l, pair) in pairs.iter().enumerate() {
                store(&mut ends, l, end(pair).unwrap_or_default().to_array());
            }
            ends
        };
        let has_reverse = pairs.iter().any(|pair| pair.reverse.is_some());
        // Lengths of the reverse paths on their way to the specular points and back.
        let (mut outbound, mut inbound) = (LengthRows::default(), LengthRows::default());
        let mut rows = ReceivedRows::default();
        if has_reverse {
            let sources = ends(&|pair| Some(pair.reverse.as_ref()?.source));
            path_lengths(self.level, specular, motion, &sources, &mut outbound);
        }
        for (rx, &lsb) in self.prepared.lsb.iter().enumerate().take(RECEIVERS) {
            receiver_echoes(
                self.level,
                self.prepared,
                lsb,
                specular,
                motion,
                &ends(&|pair| pair.sinks.get(rx).copied()),
                amplitude,
                &mut rows,
            );
            if has_reverse {
                let sinks = ends(&|pair| pair.reverse.as_ref()?.sinks.get(rx).copied());
                path_lengths(self.level, specular, motion, &sinks, &mut inbound);
            }
            for (l, &request) in lanes.iter().enumerate() {
                let Some(traced) = traced.get_mut(request).filter(|traced| traced.unit.is_some()) else { continue };
                let amplitude = Complex64::new(rows.amplitude[0][l], rows.amplitude[1][l]);
                traced.samples[rx] = PathSample { delay_s: rows.delay_s[l], delay_rate: rows.delay_rate[l], amplitude };
                let length_m = outbound.length_m[l] + inbound.length_m[l];
                let rate_m_per_s = outbound.rate[l] + inbound.rate[l];
                traced.reverse[rx] = [length_m, rate_m_per_s].map(|value| value / SPEED_OF_LIGHT_M_PER_S);
            }
        }
    }

    /// Computes factors of amplitudes other than fields, spreading and obstruction: aperture, clothes, walls of the
    /// room, grazing incidence. They are zero where no specular point was found.
    fn unobstructed_factors(&self, segment: usize, specular: &SpecularRows) -> WideRow {
        let prepared = self.prepared;
        let cloth = self.motion.person.cloth.get(segment).copied().unwrap_or(1.0);
        let common = 0.5 * prepared.aperture_m() * cloth;
        let mut factors = [0.0; WIDE];
        for (l, factor) in factors.iter_mut().enumerate().filter(|&(l, _)| specular.found[l] != 0.0) {
            *factor = common * grazing_factor(specular.cosine[l]) * inside_room(prepared, vector(&specular.point, l));
        }
        factors
    }

    /// Returns factors times the obstruction by the person's own limbs and trunk
    /// ([`super::obstruction::own_body_factor`]).
    fn obstructed_by_own_body(
        &self,
        segment: usize,
        snapshot: &Snapshot,
        sources: &[WideRow3; 2],
        specular: &SpecularRows,
        unobstructed: &WideRow,
    ) -> WideRow {
        let mut factors = *unobstructed;
        if segment >= 3 {
            let other = opposite_limb(segment).and_then(|other| snapshot.body.get(other)).map(limb_column);
            for column in [Some(snapshot.trunk), other].iter().flatten() {
                for source in sources {
                    attenuate_rows(
                        self.level,
                        &specular.point,
                        source,
                        column,
                        self.prepared.wavelength_m,
                        &mut factors,
                    );
                }
            }
        }
        factors
    }

    /// Computes the fields of both antennas' images at the specular points, without spreading.
    fn fields(
        &self,
        room: &BoxRoom,
        pairs: &[&Pair; WIDE],
        factors: &WideRow,
        specular: &SpecularRows,
    ) -> [WideFields; 2] {
        let prepared = self.prepared;
        let mut fields = [WideFields::default(); 2];
        let antennas = [&prepared.tx, prepared.rx.first().unwrap_or(&prepared.tx)];
        for (side, (antenna, fields)) in antennas.into_iter().zip(&mut fields).enumerate() {
            let mut signs = [[0.0; WIDE]; 3];
            for (l, pair) in pairs.iter().enumerate() {
                store(&mut signs, l, pair.signs[side]);
            }
            transmitted_fields(self.level, antenna, &signs, &specular.towards[side], &mut fields.re);
            let paths: [&OneWayPath; WIDE] = pairs.map(|pair| if side == 0 { &pair.outbound } else { &pair.inbound });
            propagate(self.level, room, &paths, factors, &specular.towards[side], &specular.point, fields);
        }
        fields
    }
}

compiled_for_levels! {
    /// Propagates fields from images to points of the room, where the factor of the path is not zero.
    fn propagate(
        room: &BoxRoom,
        paths: &[&OneWayPath; WIDE],
        factors: &WideRow,
        towards: &WideRow3,
        points: &WideRow3,
        fields: &mut WideFields,
    ) = propagate_body;
}

#[inline(always)]
fn propagate_body(
    room: &BoxRoom,
    paths: &[&OneWayPath; WIDE],
    factors: &WideRow,
    towards: &WideRow3,
    points: &WideRow3,
    fields: &mut WideFields,
) {
    for (l, path) in paths.iter().enumerate().filter(|&(l, _)| factors[l] != 0.0) {
        if order(path.image) == 0 && !room.transmission {
            continue;
        }
        let (direction, point) = (-vector(towards, l), vector(points, l));
        let field = Phasor3::real(vector(&fields.re, l));
        let field = room.propagated(path.antenna, path.image, path.source, direction, point, field);
        store(&mut fields.re, l, field.re.to_array());
        store(&mut fields.im, l, field.im.to_array());
    }
}
