//! Many of somebody's paths at one instant: specular points of a segment by pairs of images, some side by side ([`super::path_rows`]).
//! What lanes cannot do, as in rooms that are no boxes, is traced path by path; it is also what lanes are held to.
//!
//! A path is met first as if nobody stood between the walls, and is as loud as that or less: whether people are in its ways need be
//! asked only of those that can be heard.

use glam::DVec3;
use num_complex::Complex64;
use radome_dsp::SPEED_OF_LIGHT_M_PER_S;

use super::obstruction::{Bystanders, SharedWays, limb_column, opposite};
use super::path_rows::{Drift, HeardRows, WideFields, heard, launched, reflected};
use super::{EchoReport, Instant, LEAST_DISTANCE_M, Pair, Paths, Snapshot, VELOCITY_STEP_S, inside_room};
use crate::diffraction::weaken_rows;
use crate::em::Phasor3;
use crate::em::image::{BoxRoom, order};
use crate::em::specular::LEAST_COSINE;
use crate::em::specular_rows::{SpecularRows, specular_points};
use crate::lanes::vector::store;
use crate::lanes::{WIDE, WideRow, WideRow3, wide_lane};
use crate::material::SKIN_PERMITTIVITY;
use crate::math::smooth_step;
use crate::path_segment::PathSample;
use crate::paths::Surroundings;
use crate::people::body::SEGMENTS;
use crate::tracks::OTHERS;

/// Most receivers.
const RECEIVERS: usize = 1 + OTHERS;
/// No path.
const NOTHING: PathSample = PathSample { delay_s: 0.0, delay_rate: 0.0, amplitude: Complex64::ZERO };

/// A path at an instant, to each receiver.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Met {
    keys: [PathSample; RECEIVERS],
    receivers: usize,
    /// Place at which it is met on its segment, a point of the unit sphere; `None` where there is no such path.
    pub place: Option<DVec3>,
    /// The same in the room, m.
    point: DVec3,
    /// Whether people in its ways have not been asked for.
    is_bare: bool,
}

impl Met {
    /// A path with a key for each receiver.
    pub fn new(keys: &[PathSample], place: Option<DVec3>) -> Self {
        let mut met = Met { keys: [NOTHING; RECEIVERS], receivers: 0, place, point: DVec3::ZERO, is_bare: false };
        for (own, key) in met.keys.iter_mut().zip(keys) {
            *own = *key;
            met.receivers += 1;
        }
        met
    }

    /// A key for each receiver, of amplitude zero where there is no such path.
    pub fn keys(&self) -> &[PathSample] {
        self.keys.get(..self.receivers).unwrap_or_default()
    }
}

/// The vector of one lane.
fn vector(rows: &WideRow3, l: usize) -> DVec3 {
    DVec3::from_array(wide_lane(rows, l))
}

impl Snapshot {
    /// Motion of the material of a segment.
    fn drift(&self, segment: usize) -> Option<Drift> {
        let (before, after) = (self.before.get(segment)?, self.after.get(segment)?);
        let per_s = |step: DVec3| (step / (2.0 * VELOCITY_STEP_S)).to_array();
        let axis =
            |i: usize| per_s(after.axes.col(i) * after.semi_axes_m[i] - before.axes.col(i) * before.semi_axes_m[i]);
        Some(Drift([per_s(after.centre - before.centre), axis(0), axis(1), axis(2)]))
    }
}

impl Paths<'_> {
    /// Paths at one instant, each as if no person stood between its walls ([`Paths::shade`]). They are asked for by number and by
    /// where on its segment each was met a little earlier or later.
    pub fn meet(&self, asked: &[(usize, Option<DVec3>)], people: &[Snapshot], report: &mut EchoReport) -> Vec<Met> {
        let mut met = vec![Met::new(&[], None); asked.len()];
        if let Surroundings::Box(room) = &self.prepared.room {
            let mut of_segments: [Vec<usize>; SEGMENTS] = Default::default();
            for (at, &(path, _)) in asked.iter().enumerate() {
                if let Some(&(_, segment)) = self.specular_points.get(path) {
                    of_segments[segment].push(at);
                }
            }
            for (segment, all) in of_segments.iter().enumerate() {
                for lanes in all.chunks(WIDE) {
                    self.meet_lanes(room, segment, lanes, asked, people, &mut met, report);
                }
            }
        }
        let Some(own) = people.get(self.me) else { return met };
        let ways = match &self.prepared.room {
            Surroundings::Box(_) => None,
            Surroundings::Polygons(room) => Some(SharedWays::new(self.prepared, room, people, self.me, &self.beside)),
        };
        let mut instant = Instant { people, own, ways };
        // What lanes leave, and what a person at a desk has besides.
        let mut keys = Vec::with_capacity(RECEIVERS);
        for (met, &(path, near)) in met.iter_mut().zip(asked).filter(|(met, _)| met.receivers == 0) {
            keys.clear();
            let place = self.trace_at(path, &mut instant, near, &mut keys, report);
            *met = Met::new(&keys, place);
        }
        met
    }

    /// Weakens paths at one instant by the people in their ways, once. They come with their numbers.
    pub fn shade<'m>(&self, met: impl IntoIterator<Item = (usize, &'m mut Met)>, people: &[Snapshot]) {
        // Others are traced with everybody in their ways.
        let Surroundings::Box(room) = &self.prepared.room else { return };
        let mut bystanders = Bystanders::new(self.prepared, room, people, self.me, 2 * self.images);
        for (path, met) in met.into_iter().filter(|(_, met)| met.is_bare) {
            met.is_bare = false;
            let pair = self.specular_points.get(path).and_then(|&(number, _)| self.pairs.get(number));
            let Some(Pair { there, back, images, .. }) = pair else { continue };
            // Images of the transmitter and of the receivers are some millimetres apart.
            let left =
                bystanders.past(2 * images[0], there, met.point) * bystanders.past(2 * images[1] + 1, back, met.point);
            met.keys.iter_mut().for_each(|key| key.amplitude *= left);
        }
    }

    /// Paths by way of one segment side by side: those of `asked` at these places, no more than there are lanes. Paths that lanes
    /// cannot trace stay without receivers.
    #[allow(clippy::too_many_arguments)]
    fn meet_lanes(
        &self,
        room: &BoxRoom,
        segment: usize,
        lanes: &[usize],
        asked: &[(usize, Option<DVec3>)],
        people: &[Snapshot],
        met: &mut [Met],
        report: &mut EchoReport,
    ) {
        let Some(own) = people.get(self.me) else { return };
        let (Some(ellipsoid), Some(drift)) = (own.body.get(segment), own.drift(segment)) else { return };
        let pair = |lane: usize| {
            let &(path, _) = asked.get(*lanes.get(lane)?)?;
            let &(number, _) = self.specular_points.get(path)?;
            self.pairs.get(number)
        };
        // Lanes to spare repeat the first.
        let Some(first) = pair(0) else { return };
        let pairs: [&Pair; WIDE] = std::array::from_fn(|l| pair(l).unwrap_or(first));
        let mut sources = [[[0.0; WIDE]; 3]; 2];
        for (l, pair) in pairs.iter().enumerate() {
            store(&mut sources[0], l, pair.there.source.to_array());
            store(&mut sources[1], l, pair.back.source.to_array());
        }
        let mut seen = SpecularRows::default();
        specular_points(self.level, ellipsoid, &sources, &mut seen);
        let factors = self.factors(segment, own, &sources, &seen);
        let fields = self.fields(room, &pairs, &factors, &seen);
        let mut amplitude = [[0.0; WIDE]; 2];
        reflected(self.level, SKIN_PERMITTIVITY, &seen, &fields, &factors, &mut amplitude);
        for (l, &at) in lanes.iter().enumerate().filter(|&(l, _)| seen.found[l] != 0.0) {
            let Some(met) = met.get_mut(at) else { continue };
            report.paths += 1;
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
            met.is_bare = amplitude[0][l] != 0.0 || amplitude[1][l] != 0.0;
        }
        self.hear_lanes(lanes, &pairs, &seen, &drift, &amplitude, met);
    }

    /// Writes what each receiver hears of paths that were found.
    fn hear_lanes(
        &self,
        lanes: &[usize],
        pairs: &[&Pair; WIDE],
        seen: &SpecularRows,
        drift: &Drift,
        amplitude: &[WideRow; 2],
        met: &mut [Met],
    ) {
        let mut rows = HeardRows::default();
        for (rx, &lsb) in self.prepared.lsb.iter().enumerate().take(RECEIVERS) {
            let mut sinks = [[0.0; WIDE]; 3];
            for (l, pair) in pairs.iter().enumerate() {
                store(&mut sinks, l, pair.sinks.get(rx).copied().unwrap_or_default().to_array());
            }
            heard(self.level, self.prepared, lsb, seen, drift, &sinks, amplitude, &mut rows);
            for (l, &at) in lanes.iter().enumerate() {
                let Some(met) = met.get_mut(at).filter(|met| met.place.is_some()) else { continue };
                let amplitude = Complex64::new(rows.amplitude[0][l], rows.amplitude[1][l]);
                met.keys[rx] = PathSample { delay_s: rows.delay_s[l], delay_rate: rows.delay_rate[l], amplitude };
            }
        }
    }

    /// Factors of amplitudes beside fields and spreading: aperture, clothes, walls about the room, grazing incidence, and the own
    /// limbs and trunk. Zero where nothing was found.
    fn factors(&self, segment: usize, own: &Snapshot, sources: &[WideRow3; 2], seen: &SpecularRows) -> WideRow {
        let prepared = self.prepared;
        let cloth = self.motion.person.cloth.get(segment).copied().unwrap_or(1.0);
        let common = 0.5 * prepared.aperture_m() * cloth;
        let mut factors = [0.0; WIDE];
        for (l, factor) in factors.iter_mut().enumerate().filter(|&(l, _)| seen.found[l] != 0.0) {
            // Grazing specular points fade: forward scattering is no specular point.
            let faded = smooth_step((seen.cosine[l] - 0.2) / 0.1);
            *factor = common * faded * inside_room(prepared, vector(&seen.point, l));
        }
        if segment >= 3 {
            let other = opposite(segment).and_then(|other| own.body.get(other)).map(limb_column);
            for column in [Some(own.trunk), other].iter().flatten() {
                for source in sources {
                    weaken_rows(self.level, &seen.point, source, column, prepared.wavelength_m, &mut factors);
                }
            }
        }
        factors
    }

    /// Fields of both antennas' images at the specular points, but for spreading.
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
            for (l, pair) in pairs.iter().enumerate().filter(|&(l, _)| factors[l] != 0.0) {
                let way = if side == 0 { &pair.there } else { &pair.back };
                if order(way.image) == 0 && !room.transmission {
                    continue;
                }
                let (direction, point) = (-vector(&seen.towards[side], l), vector(&seen.point, l));
                let field = Phasor3::real(vector(&fields.re, l));
                let field = room.carried(way.antenna, way.image, way.source, direction, point, field);
                store(&mut fields.re, l, field.re.to_array());
                store(&mut fields.im, l, field.im.to_array());
            }
        }
        fields
    }
}
