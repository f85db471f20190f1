//! Traces many paths of a person at one instant: specular points of a segment for pairs of images, vectorised where
//! possible ([`super::path_rows`]). Cases that the vectorised code does not cover, such as rooms that are no boxes, are
//! traced path by path. That method is also the reference for the vectorised code.
//!
//! A path is first traced without people in the room, which bounds its amplitude from above. Obstruction by people is
//! computed only for the audible paths.

use glam::DVec3;
use num_complex::Complex64;
use radome_dsp::SPEED_OF_LIGHT_M_PER_S;

use super::obstruction::{Bystanders, SharedWays, Way, limb_column, opposite};
use super::path_rows::{Drift, LengthRows, ReceivedRows, WideFields, launched, lengths, received, reflected};
use super::{EchoReport, Instant, LEAST_DISTANCE_M, Pair, Paths, Snapshot, VELOCITY_STEP_S, faded, inside_room};
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
const NOTHING: PathSample = PathSample { delay_s: 0.0, delay_rate: 0.0, amplitude: Complex64::ZERO };

/// Path at an instant, to each receiver.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TracedPath {
    keys: [PathSample; RECEIVERS],
    receivers: usize,
    /// Delay, s, and its rate to each receiver in the opposite direction, of the same amplitude, if the path stands for
    /// both.
    exchanged: [[f64; 2]; RECEIVERS],
    /// Specular point on the segment, as a point of the unit sphere; `None` where the path does not exist.
    pub place: Option<DVec3>,
    /// Specular point in the room, m.
    point: DVec3,
    /// Whether obstruction by people has not been applied.
    is_bare: bool,
    /// Whether people, and the limbs and trunk of the person that reflects, leave the path as it is, and no edge of a facet
    /// is beside it.
    pub is_clear: bool,
}

impl TracedPath {
    /// Builds a path from a sample for each receiver.
    pub fn new(keys: &[PathSample], place: Option<DVec3>) -> Self {
        let mut met = TracedPath {
            keys: [NOTHING; RECEIVERS],
            receivers: 0,
            exchanged: [[0.0; 2]; RECEIVERS],
            place,
            point: DVec3::ZERO,
            is_bare: false,
            is_clear: false,
        };
        for (own, key) in met.keys.iter_mut().zip(keys) {
            *own = *key;
            met.receivers += 1;
        }
        met
    }

    /// Returns a sample for each receiver, of amplitude zero where the path does not exist.
    pub fn keys(&self) -> &[PathSample] {
        self.keys.get(..self.receivers).unwrap_or_default()
    }

    /// Returns the samples of the opposite direction of a path that stands for both ([`Paths::is_both_ways`]).
    pub fn exchanged(&self) -> Self {
        let mut exchanged = *self;
        for (key, [delay_s, delay_rate]) in exchanged.keys.iter_mut().zip(self.exchanged) {
            (key.delay_s, key.delay_rate) = (delay_s, delay_rate);
        }
        exchanged
    }
}

/// Returns the vector of one lane.
fn vector(rows: &WideRow3, l: usize) -> DVec3 {
    DVec3::from_array(wide_lane(rows, l))
}

impl Snapshot {
    /// Returns the motion of the surface of a segment.
    fn drift(&self, segment: usize) -> Option<Drift> {
        let (before, after) = (self.before.get(segment)?, self.after.get(segment)?);
        let per_s = |step: DVec3| (step / (2.0 * VELOCITY_STEP_S)).to_array();
        let axis =
            |i: usize| per_s(after.axes.col(i) * after.semi_axes_m[i] - before.axes.col(i) * before.semi_axes_m[i]);
        Some(Drift([per_s(after.centre - before.centre), axis(0), axis(1), axis(2)]))
    }
}

/// Longest time in which no body can pass before a path, s: two people who run past each other take longer.
const PASSING_S: f64 = 0.05;

impl Paths<'_> {
    /// Returns the segment on which a path has its specular point; `None` for the extra paths of a person at a desk.
    pub fn segment(&self, path: usize) -> Option<usize> {
        self.specular_points.get(path).map(|&(_, segment)| segment)
    }

    /// Returns whether a path stands for both directions.
    pub fn is_both_ways(&self, path: usize) -> bool {
        let pair = self.specular_points.get(path).and_then(|&(number, _)| self.pairs.get(number));
        pair.is_some_and(|pair| pair.exchanged.is_some())
    }

    /// Returns the delays of a path in the opposite direction, s, and their rates, for its specular point.
    fn exchanged(&self, path: usize, own: &Snapshot, unit: DVec3) -> Option<[[f64; 2]; RECEIVERS]> {
        let &(number, segment) = self.specular_points.get(path)?;
        let (source, sinks) = self.pairs.get(number)?.exchanged.as_ref()?;
        let (point, velocity) = (own.body.get(segment)?.surface(unit), own.velocity(segment, unit));
        let length = |end: DVec3| {
            let offset = point - end;
            [offset.length(), offset.normalize_or_zero().dot(velocity)]
        };
        let (there, mut all) = (length(*source), [[0.0; 2]; RECEIVERS]);
        for (all, sink) in all.iter_mut().zip(sinks) {
            let back = length(*sink);
            *all = [0, 1].map(|order| (there[order] + back[order]) / SPEED_OF_LIGHT_M_PER_S);
        }
        Some(all)
    }

    /// Returns for each segment whether a body or the person's other limb may begin and end to obstruct it within a
    /// time. `people` are those of about this time.
    pub fn exposed(&self, people: &[Snapshot], within_s: f64) -> [bool; SEGMENTS] {
        let Some(own) = people.get(self.me).filter(|_| within_s <= PASSING_S) else { return [true; SEGMENTS] };
        std::array::from_fn(|segment| {
            let Some((other, limb)) = opposite(segment).and_then(|other| Some((other, own.body.get(other)?))) else {
                return false;
            };
            let speed = (own.centre(segment).1 - own.centre(other).1).truncate().length();
            speed * within_s > 2.0 * limb_column(limb).radius_m
        })
    }

    /// Traces paths at one instant, each without obstruction by people ([`Paths::shade`]). Each request gives the
    /// path's index and its specular point at a neighbouring time.
    pub fn trace_all(
        &self,
        asked: &[(usize, Option<DVec3>)],
        people: &[Snapshot],
        report: &mut EchoReport,
    ) -> Vec<TracedPath> {
        let mut met = vec![TracedPath::new(&[], None); asked.len()];
        if let Surroundings::Box(room) = &self.prepared.room {
            let mut of_segments: [Vec<usize>; SEGMENTS] = Default::default();
            for (at, &(path, _)) in asked.iter().enumerate() {
                if let Some(&(_, segment)) = self.specular_points.get(path) {
                    of_segments[segment].push(at);
                }
            }
            for (segment, all) in of_segments.iter().enumerate() {
                for lanes in all.chunks(WIDE) {
                    self.trace_lanes(room, segment, lanes, asked, people, &mut met, report);
                }
            }
        }
        let Some(own) = people.get(self.me) else { return met };
        let ways = match &self.prepared.room {
            Surroundings::Box(_) => None,
            Surroundings::Polygons(room) => Some(SharedWays::new(self.prepared, room, people, self.me, &self.beside)),
        };
        let mut instant = Instant { people, own, ways };
        // The remaining paths: those that lanes do not cover, and the extra paths of a person at a desk.
        let mut keys = Vec::with_capacity(RECEIVERS);
        for (met, &(path, near)) in met.iter_mut().zip(asked).filter(|(met, _)| met.receivers == 0) {
            keys.clear();
            let found = self.trace_at(path, &mut instant, near, &mut keys, report);
            *met = TracedPath::new(&keys, found.map(|found| found.unit));
            met.is_clear = found.is_some_and(|found| found.is_clear);
            if let Some(exchanged) = met.place.and_then(|unit| self.exchanged(path, own, unit)) {
                met.exchanged = exchanged;
            }
        }
        met
    }

    /// Applies the obstruction by people to paths at one instant, once. Paths are given with their indices.
    pub fn shade<'m>(&self, met: impl IntoIterator<Item = (usize, &'m mut TracedPath)>, people: &[Snapshot]) {
        // In other rooms tracing already includes the people.
        let Surroundings::Box(room) = &self.prepared.room else { return };
        let mut bystanders = Bystanders::new(self.prepared, room, people, self.me, 2 * self.images);
        for (path, met) in met.into_iter().filter(|(_, met)| met.is_bare) {
            met.is_bare = false;
            let pair = self.specular_points.get(path).and_then(|&(number, _)| self.pairs.get(number));
            let Some(Pair { there, back, images, .. }) = pair else { continue };
            // Images of the transmitter and of the receivers are some millimetres apart, so they have separate entries.
            let left =
                bystanders.past(2 * images[0], there, met.point) * bystanders.past(2 * images[1] + 1, back, met.point);
            met.is_clear &= left == 1.0;
            met.keys.iter_mut().for_each(|key| key.amplitude *= left);
        }
    }

    /// Traces paths over one segment in lanes: those of `asked` at the indices `lanes`, at most one per lane. Paths
    /// that cannot be traced in lanes keep zero receivers.
    #[allow(clippy::too_many_arguments)]
    fn trace_lanes(
        &self,
        room: &BoxRoom,
        segment: usize,
        lanes: &[usize],
        asked: &[(usize, Option<DVec3>)],
        people: &[Snapshot],
        met: &mut [TracedPath],
        report: &mut EchoReport,
    ) {
        let Some(own) = people.get(self.me) else { return };
        let (Some(ellipsoid), Some(drift)) = (own.body.get(segment), own.drift(segment)) else { return };
        let pair = |lane: usize| {
            let &(path, _) = asked.get(*lanes.get(lane)?)?;
            let &(number, _) = self.specular_points.get(path)?;
            self.pairs.get(number)
        };
        // Unused lanes repeat the first pair.
        let Some(first) = pair(0) else { return };
        let pairs: [&Pair; WIDE] = std::array::from_fn(|l| pair(l).unwrap_or(first));
        let mut sources = [[[0.0; WIDE]; 3]; 2];
        for (l, pair) in pairs.iter().enumerate() {
            store(&mut sources[0], l, pair.there.source.to_array());
            store(&mut sources[1], l, pair.back.source.to_array());
        }
        let mut seen = SpecularRows::default();
        specular_points(self.level, ellipsoid, &sources, &mut seen);
        let bare = self.bare_factors(segment, &seen);
        let factors = self.past_limbs(segment, own, &sources, &seen, &bare);
        let fields = self.fields(room, &pairs, &factors, &seen);
        let mut amplitude = [[0.0; WIDE]; 2];
        reflected(self.level, SKIN_PERMITTIVITY, &seen, &fields, &factors, &mut amplitude);
        for (l, &at) in lanes.iter().enumerate().filter(|&(l, _)| seen.found[l] != 0.0) {
            let Some(met) = met.get_mut(at) else { continue };
            met.receivers = self.prepared.rx.len().min(RECEIVERS);
            if seen.cosine[l] <= LEAST_COSINE {
                let delay_s = (pairs[l].there.source.distance(ellipsoid.centre) * 2.0) / SPEED_OF_LIGHT_M_PER_S;
                met.keys = [PathSample { delay_s, ..NOTHING }; RECEIVERS];
                continue;
            }
            let nearest_m = seen.distances_m[0][l].min(seen.distances_m[1][l]);
            report.clamped += usize::from(nearest_m < LEAST_DISTANCE_M);
            met.place = Some(vector(&seen.unit, l));
            met.point = vector(&seen.point, l);
            met.is_clear = factors[l] == bare[l];
            met.is_bare = amplitude[0][l] != 0.0 || amplitude[1][l] != 0.0;
        }
        self.hear_lanes(lanes, &pairs, &seen, &drift, &amplitude, met);
    }

    /// Writes the samples of each receiver for the paths that were found.
    fn hear_lanes(
        &self,
        lanes: &[usize],
        pairs: &[&Pair; WIDE],
        seen: &SpecularRows,
        drift: &Drift,
        amplitude: &[WideRow; 2],
        met: &mut [TracedPath],
    ) {
        let ends = |of: &dyn Fn(&Pair) -> Option<DVec3>| {
            let mut ends = [[0.0; WIDE]; 3];
            for (l, pair) in pairs.iter().enumerate() {
                store(&mut ends, l, of(pair).unwrap_or_default().to_array());
            }
            ends
        };
        let has_both = pairs.iter().any(|pair| pair.exchanged.is_some());
        let (mut rows, mut there, mut back) = (ReceivedRows::default(), LengthRows::default(), LengthRows::default());
        if has_both {
            lengths(self.level, seen, drift, &ends(&|pair| Some(pair.exchanged.as_ref()?.0)), &mut there);
        }
        for (rx, &lsb) in self.prepared.lsb.iter().enumerate().take(RECEIVERS) {
            received(
                self.level,
                self.prepared,
                lsb,
                seen,
                drift,
                &ends(&|pair| pair.sinks.get(rx).copied()),
                amplitude,
                &mut rows,
            );
            if has_both {
                let sinks = ends(&|pair| pair.exchanged.as_ref()?.1.get(rx).copied());
                lengths(self.level, seen, drift, &sinks, &mut back);
            }
            for (l, &at) in lanes.iter().enumerate() {
                let Some(met) = met.get_mut(at).filter(|met| met.place.is_some()) else { continue };
                let amplitude = Complex64::new(rows.amplitude[0][l], rows.amplitude[1][l]);
                met.keys[rx] = PathSample { delay_s: rows.delay_s[l], delay_rate: rows.delay_rate[l], amplitude };
                let (length_m, rate) = (there.length_m[l] + back.length_m[l], there.rate[l] + back.rate[l]);
                met.exchanged[rx] = [length_m, rate].map(|of| of / SPEED_OF_LIGHT_M_PER_S);
            }
        }
    }

    /// Computes factors of amplitudes other than fields, spreading and obstruction: aperture, clothes, walls of the
    /// room, grazing incidence. They are zero where no specular point was found.
    fn bare_factors(&self, segment: usize, seen: &SpecularRows) -> WideRow {
        let prepared = self.prepared;
        let cloth = self.motion.person.cloth.get(segment).copied().unwrap_or(1.0);
        let common = 0.5 * prepared.aperture_m() * cloth;
        let mut factors = [0.0; WIDE];
        for (l, factor) in factors.iter_mut().enumerate().filter(|&(l, _)| seen.found[l] != 0.0) {
            *factor = common * faded(seen.cosine[l]) * inside_room(prepared, vector(&seen.point, l));
        }
        factors
    }

    /// Returns these factors times the obstruction by the person's own limbs and trunk.
    fn past_limbs(
        &self,
        segment: usize,
        own: &Snapshot,
        sources: &[WideRow3; 2],
        seen: &SpecularRows,
        bare: &WideRow,
    ) -> WideRow {
        let mut factors = *bare;
        if segment >= 3 {
            let other = opposite(segment).and_then(|other| own.body.get(other)).map(limb_column);
            for column in [Some(own.trunk), other].iter().flatten() {
                for source in sources {
                    attenuate_rows(self.level, &seen.point, source, column, self.prepared.wavelength_m, &mut factors);
                }
            }
        }
        factors
    }

    /// Computes the fields of both antennas' images at the specular points, without spreading.
    fn fields(&self, room: &BoxRoom, pairs: &[&Pair; WIDE], factors: &WideRow, seen: &SpecularRows) -> [WideFields; 2] {
        let prepared = self.prepared;
        let mut fields = [WideFields::default(); 2];
        let antennas = [&prepared.tx, prepared.rx.first().unwrap_or(&prepared.tx)];
        for (side, (antenna, fields)) in antennas.into_iter().zip(&mut fields).enumerate() {
            let mut signs = [[0.0; WIDE]; 3];
            for (l, pair) in pairs.iter().enumerate() {
                store(&mut signs, l, pair.signs[side]);
            }
            launched(self.level, antenna, &signs, &seen.towards[side], &mut fields.re);
            let ways: [&Way; WIDE] = pairs.map(|pair| if side == 0 { &pair.there } else { &pair.back });
            propagate(self.level, room, &ways, factors, &seen.towards[side], &seen.point, fields);
        }
        fields
    }
}

compiled_for_levels! {
    /// Propagates fields from images to points of the room, where the factor of the path is not zero.
    fn propagate(
        room: &BoxRoom,
        ways: &[&Way; WIDE],
        factors: &WideRow,
        towards: &WideRow3,
        points: &WideRow3,
        fields: &mut WideFields,
    ) = propagate_body;
}

#[inline(always)]
fn propagate_body(
    room: &BoxRoom,
    ways: &[&Way; WIDE],
    factors: &WideRow,
    towards: &WideRow3,
    points: &WideRow3,
    fields: &mut WideFields,
) {
    for (l, way) in ways.iter().enumerate().filter(|&(l, _)| factors[l] != 0.0) {
        if order(way.image) == 0 && !room.transmission {
            continue;
        }
        let (direction, point) = (-vector(towards, l), vector(points, l));
        let field = Phasor3::real(vector(&fields.re, l));
        let field = room.propagated(way.antenna, way.image, way.source, direction, point, field);
        store(&mut fields.re, l, field.re.to_array());
        store(&mut fields.im, l, field.im.to_array());
    }
}
