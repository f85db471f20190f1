//! Sample times of the paths of people.
//!
//! A path is traced at the ends and in the middle of a frame. If nobody obstructs it there, and the ends nearly predict
//! the middle, these three samples suffice ([`PathSegment::through_three`]). Other paths are traced at the quarters,
//! too: diffraction losses are short, and one may begin and end within half a frame. If the ends and quarters do not
//! predict the middle in delay and amplitude together, the segment is halved. Each half is tested in the same way. A
//! limb whose specular point passes behind another limb is halved several times.
//!
//! All paths of a person advance together, instant by instant, so that their specular points are searched side by side
//! ([`Paths::trace_all`]).
//!
//! [`PathSegment::through_three`]: crate::path_segment::PathSegment::through_three

use std::cell::OnceCell;
use std::sync::Arc;

use glam::DVec3;
use num_complex::Complex64;

use crate::chirp::Chirp;
use crate::echo::{EchoReport, Paths, Snapshot, TracedPath};
use crate::em::specular::Ellipsoid;
use crate::math::magnitude;
use crate::path_segment::{FiveSamples, PathSample};
use crate::people::body::SEGMENTS;
use crate::people::motion::Motion;
use crate::synthesis::HeldEchoes;
use crate::tracks::{Track, Tracks};
use crate::weak_track;

/// Largest number of halvings of a path: segments of a sixteenth of a frame.
pub const MOST_HALVINGS: u32 = 4;

/// Snapshots of all people in a frame at the possible sample times, each computed once.
pub struct Instants<'a> {
    motions: &'a [Arc<Motion>],
    start_s: f64,
    span_s: f64,
    /// Number of intervals between the first and the last instant.
    count: usize,
    /// Snapshots of all people at each instant that was requested.
    snapshots: Vec<OnceCell<Vec<Snapshot>>>,
}

impl<'a> Instants<'a> {
    /// Covers `span_s` from a start time; the span may be halved `halvings` times.
    pub fn new(motions: &'a [Arc<Motion>], start_s: f64, span_s: f64, halvings: u32) -> Self {
        let count = 4usize << halvings;
        Instants { motions, start_s, span_s, count, snapshots: vec![OnceCell::new(); count + 1] }
    }

    /// Motions of all people.
    pub fn motions(&self) -> &'a [Arc<Motion>] {
        self.motions
    }

    /// The first instant, s.
    pub fn start_s(&self) -> f64 {
        self.start_s
    }

    fn time_s(&self, instant: usize) -> f64 {
        self.start_s + self.span_s * instant as f64 / self.count as f64
    }

    /// Snapshots of all people at an instant.
    fn people(&self, instant: usize) -> &[Snapshot] {
        let Some(cell) = self.snapshots.get(instant) else { return &[] };
        let time_s = self.time_s(instant);
        cell.get_or_init(|| self.motions.iter().map(|m| Snapshot::new(m, time_s)).collect())
    }

    /// Snapshots of all people at the ends of the segments into which `halvings` halvings cut the frame.
    pub fn at_ends(&self, halvings: u32) -> Vec<Vec<Snapshot>> {
        (0..=1usize << halvings).map(|end| self.people((end * self.count) >> halvings).to_vec()).collect()
    }

    /// Body of a person at a quarter of the frame, 0 to 4.
    pub fn body_at_quarter(&self, person: usize, quarter: usize) -> Option<[Ellipsoid; SEGMENTS]> {
        let instant = quarter * self.count / 4;
        match self.snapshots.get(instant).and_then(OnceCell::get) {
            Some(people) => people.get(person).map(|snapshot| snapshot.body),
            None => self.motions.get(person).map(|motion| motion.body(self.time_s(instant))),
        }
    }
}

/// Required accuracy of the path samples.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SamplingTolerance {
    /// A path is audible if it is as strong as this at an end or in the middle of the frame, LSB.
    pub heard_lsb: f64,
    /// Error that is allowed for a path of any strength, LSB.
    pub least_lsb: f64,
    /// Allowed error as a part of a path's own amplitude.
    pub tolerance: f64,
    /// Amplitude below which a path is invisible in any map, LSB.
    pub threshold_lsb: f64,
    /// Fixed number of halvings of every path, regardless of the error. No path is then held.
    pub halvings: Option<u32>,
    /// Chirp, at whose first frequency phases are compared.
    pub chirp: Chirp,
}

/// Sampled paths of all people in a frame.
#[derive(Debug, Clone, Default)]
pub struct KeyedPaths {
    /// The paths, to all receivers.
    pub tracks: Tracks,
    /// Weak paths in each interval of the frame, both directions as one echo. Without intervals, all paths are in `tracks`.
    pub weak: Vec<HeldEchoes>,
    /// Number of traced paths that are audible.
    pub received: usize,
}

/// Sample of a receiver; `None` where there is no such path.
fn existing(met: &TracedPath, receiver: usize) -> Option<&PathSample> {
    met.keys().get(receiver).filter(|key| met.place.is_some() || key.amplitude != Complex64::ZERO)
}

/// Samples of every receiver at five instants, `apart_s` apart. Where there is no path, its delay is extrapolated from
/// the nearest instant with a path, at the rate of that sample.
fn keys_of(five: [&TracedPath; 5], apart_s: f64) -> Vec<FiveSamples> {
    let key = |receiver: usize, at: usize| {
        let own = five[at].keys()[receiver];
        if existing(five[at], receiver).is_some() {
            return own;
        }
        let existing = (0..5usize).filter_map(|i| Some((i, existing(five[i], receiver)?)));
        let Some((i, near)) = existing.min_by_key(|(i, _)| i.abs_diff(at)) else { return own };
        let later_s = apart_s * (at as f64 - i as f64);
        PathSample { delay_s: near.delay_s + near.delay_rate * later_s, delay_rate: near.delay_rate, ..own }
    };
    let receivers = five.iter().map(|met| met.keys().len()).min().unwrap_or(0);
    (0..receivers).map(|receiver| std::array::from_fn(|at| key(receiver, at))).collect()
}

impl KeyedPaths {
    /// Adds the paths of a person.
    pub fn add(&mut self, instants: &Instants, paths: &Paths, demand: &SamplingTolerance, report: &mut EchoReport) {
        Tracer { instants, paths, demand, report, out: self }.follow();
    }
}

/// Both directions of a path in a segment; the second is absent where the path stands for one.
type Ways = [Option<Track>; 2];

/// Path in a segment for which the need to halve is not yet known.
#[derive(Debug, Clone, Copy)]
struct Open {
    path: usize,
    /// Path at both ends and in the middle of the segment.
    met: [TracedPath; 3],
}

/// Traces the paths of a person through a frame.
struct Tracer<'a> {
    instants: &'a Instants<'a>,
    paths: &'a Paths<'a>,
    demand: &'a SamplingTolerance,
    report: &'a mut EchoReport,
    out: &'a mut KeyedPaths,
}

impl Tracer<'_> {
    /// Traces paths at an instant; each request gives a nearby specular point if one is known.
    fn trace_all(&mut self, instant: usize, asked: &[(usize, Option<DVec3>)]) -> Vec<TracedPath> {
        self.paths.trace_all(asked, self.instants.people(instant), self.report)
    }

    /// Traces paths as `trace_all` does, and applies the diffraction by people in the way.
    fn trace_shaded(&mut self, instant: usize, asked: &[(usize, Option<DVec3>)]) -> Vec<TracedPath> {
        let mut met = self.trace_all(instant, asked);
        let numbered = asked.iter().map(|&(path, _)| path).zip(&mut met);
        self.paths.shade(numbered, self.instants.people(instant));
        met
    }

    /// Traces all paths from one end of the frame to the other.
    fn follow(&mut self) {
        let open = self.received();
        self.out.received += open.iter().map(|open| 1 + usize::from(self.paths.is_both_ways(open.path))).sum::<usize>();
        // The lists are ordered by segment, and within a segment by path.
        let (mut halvings, mut level) = (0, vec![open]);
        while level.iter().any(|open| !open.is_empty()) {
            let mut next: Vec<Vec<Open>> = vec![Vec::new(); 2 * level.len()];
            for (place, open) in level.iter().enumerate().filter(|(_, open)| !open.is_empty()) {
                self.cut(halvings, place, open, &mut next);
            }
            (halvings, level) = (halvings + 1, next);
        }
    }

    /// Paths that are audible at an end of the frame or in its middle.
    fn received(&mut self) -> Vec<Open> {
        let at = [0, self.instants.count / 2, self.instants.count];
        let mut asked: Vec<(usize, Option<DVec3>)> = (0..self.paths.count()).map(|path| (path, None)).collect();
        let mut met_at = |instant: usize| {
            let met = self.trace_all(instant, &asked);
            asked.iter_mut().zip(&met).for_each(|((_, near), met)| *near = met.place);
            met
        };
        let [first, middle, last] = at.map(&mut met_at);
        let least = self.demand.heard_lsb * self.demand.heard_lsb;
        // The receivers are so close together that the first represents all, here and in `cut`.
        let is_loud = |met: &TracedPath| met.keys().first().is_some_and(|key| key.amplitude.norm_sqr() > least);
        // Diffraction by people in the way makes no path louder.
        let may_be_heard = |&path: &usize| [&first, &middle, &last].into_iter().any(|met| is_loud(&met[path]));
        let open = |path: usize| Open { path, met: [first[path], middle[path], last[path]] };
        let mut received = Vec::with_capacity((0..first.len()).filter(may_be_heard).count());
        received.extend((0..first.len()).filter(may_be_heard).map(open));
        for (i, instant) in at.into_iter().enumerate() {
            let numbered = received.iter_mut().map(|open| (open.path, &mut open.met[i]));
            self.paths.shade(numbered, self.instants.people(instant));
        }
        received.retain(|open| open.met.iter().any(is_loud));
        received
    }

    /// Keeps a path, in one direction or both, in segment `place` of a frame that is halved `halvings` times.
    fn keep(&mut self, halvings: u32, place: usize, ways: Ways) {
        let SamplingTolerance { threshold_lsb, chirp, .. } = self.demand;
        let (out, segment) = (&mut *self.out, [halvings as usize, place]);
        let is_exact = self.demand.halvings.is_some();
        if is_exact || !weak_track::add(&ways, segment, chirp, *threshold_lsb, &mut out.weak) {
            ways.into_iter().flatten().for_each(|track| out.tracks.push(halvings, place, track));
        }
    }

    /// Keeps the paths of a segment whose samples predict its middle, and passes the others to its halves in `next`.
    fn cut(&mut self, halvings: u32, place: usize, all: &[Open], next: &mut [Vec<Open>]) {
        let interval_s = self.instants.span_s / f64::from(1u32 << halvings);
        let mut rest = Vec::with_capacity(all.len());
        let middle = ((4 * place + 2) * self.instants.count) >> (halvings + 2);
        let exposed = self.paths.exposed(self.instants.people(middle), 0.5 * interval_s);
        for open in all {
            match self.calm(open, &exposed, interval_s) {
                Some(ways) => self.keep(halvings, place, ways),
                None => rest.push(*open),
            }
        }
        if rest.is_empty() {
            return;
        }
        let all = rest;
        let instant = |quarter: usize| ((4 * place + quarter) * self.instants.count) >> (halvings + 2);
        let asked = |end: usize| -> Vec<(usize, Option<DVec3>)> {
            all.iter().map(|open| (open.path, open.met[end].place)).collect()
        };
        let [before, after] = [1, 3].map(instant);
        let (before, after) = (self.trace_shaded(before, &asked(0)), self.trace_shaded(after, &asked(2)));
        for ((open, before), after) in all.iter().zip(before).zip(after) {
            let [first, middle, last] = open.met;
            let five = [first, before, middle, after, last];
            let through = |five: [TracedPath; 5]| {
                let keys = keys_of(five.each_ref(), 0.25 * interval_s);
                Track::through(&keys, interval_s, self.demand.chirp.start_hz)
            };
            let Some((track, missed_lsb)) = through(five) else { continue };
            let between = [&before, &middle, &after].into_iter().filter_map(|met| met.keys().first());
            let loudest_lsb = between.map(|key| magnitude(key.amplitude)).fold(0.0, f64::max);
            let is_met = missed_lsb <= self.demand.least_lsb.max(self.demand.tolerance * loudest_lsb);
            if self.demand.halvings.map_or(is_met || halvings == MOST_HALVINGS, |asked| halvings == asked) {
                let exchanged = self.paths.is_both_ways(open.path).then(|| through(five.map(|met| met.exchanged())));
                self.keep(halvings, place, [Some(track), exchanged.flatten().map(|(track, _)| track)]);
                continue;
            }
            next[2 * place].push(Open { met: [first, before, middle], ..*open });
            next[2 * place + 1].push(Open { met: [middle, after, last], ..*open });
        }
    }

    /// Interpolates a path by its samples at both ends and in the middle, if these suffice: it has the same error bound
    /// as others, and nothing can obstruct it between two samples alone. `exposed` tells this by segment.
    fn calm(&self, open: &Open, exposed: &[bool; SEGMENTS], interval_s: f64) -> Option<Ways> {
        let is_clear = |met: &TracedPath| met.is_clear && met.place.is_some();
        let is_exposed = self.paths.segment(open.path).is_none_or(|segment| exposed[segment]);
        if self.demand.halvings.is_some() || is_exposed || !open.met.iter().all(is_clear) {
            return None;
        }
        let through = |met: &[TracedPath; 3]| {
            Track::through_three(met.each_ref().map(|met| met.keys()), interval_s, self.demand.chirp.start_hz)
        };
        let (track, missed_lsb) = through(&open.met)?;
        let loudest_lsb = open
            .met
            .iter()
            .filter_map(|met| met.keys().first())
            .map(|key| magnitude(key.amplitude))
            .fold(0.0, f64::max);
        if missed_lsb > self.demand.least_lsb.max(self.demand.tolerance * loudest_lsb) {
            return None;
        }
        let is_both_ways = self.paths.is_both_ways(open.path);
        let exchanged = is_both_ways.then(|| through(&open.met.map(|met| met.exchanged()))).flatten();
        Some([Some(track), exchanged.map(|(track, _)| track)])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// At instants without a path the delay is extrapolated and the amplitude is zero.
    #[test]
    fn delays_go_on_where_paths_end_to_be() {
        let key = |delay_s: f64, amplitude: f64| PathSample { delay_s, delay_rate: 2.0, amplitude: amplitude.into() };
        let met =
            |delay_s: f64, amplitude: f64, place: Option<DVec3>| TracedPath::new(&[key(delay_s, amplitude)], place);
        let (here, gone) = (|delay_s| met(delay_s, 1.0, Some(DVec3::X)), || met(99.0, 0.0, None));
        let five = [gone(), here(1.0), here(3.0), gone(), gone()];
        let keys = keys_of(five.each_ref(), 0.5)[0];
        assert_eq!(keys.map(|key| key.delay_s), [0.0, 1.0, 3.0, 4.0, 5.0]);
        assert_eq!(keys.map(|key| key.amplitude.re), [0.0, 1.0, 1.0, 0.0, 0.0]);
        // A path without a specular point on a segment is still a path.
        let five = [met(7.0, 1.0, None), here(1.0), here(3.0), here(4.0), here(5.0)];
        assert_eq!(keys_of(five.each_ref(), 0.5)[0][0].delay_s, 7.0);
    }
}
