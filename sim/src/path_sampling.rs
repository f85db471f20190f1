//! Sample times of the paths of people.
//!
//! A path is traced at the ends and in the middle of a frame. If nobody obstructs it there, and the ends nearly predict
//! the middle, these three samples suffice ([`PathSegment::through_three`]). Other paths are traced at the quarters,
//! too: diffraction losses are short, and one may begin and end within half a frame. If the ends and quarters do not
//! predict the middle in delay and amplitude together, the segment is halved. Each half is tested in the same way. The
//! path of a limb that passes behind another limb is halved several times.
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
pub const MAX_HALVINGS: u32 = 4;

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
    /// Covers `span_s` from a start time; the span may be halved up to `halvings` times.
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
    pub audible_lsb: f64,
    /// Error that is allowed for a path of any strength, LSB.
    pub absolute_lsb: f64,
    /// Allowed error relative to a path's own amplitude.
    pub relative: f64,
    /// Amplitude below which a path is invisible in any map, LSB.
    pub threshold_lsb: f64,
    /// Fixed number of halvings of every path, regardless of the error. No path is then held.
    pub fixed_halvings: Option<u32>,
    /// Chirp, at whose first frequency phases are compared.
    pub chirp: Chirp,
}

impl SamplingTolerance {
    /// Allowed error of a path with this amplitude, LSB.
    fn allowed_lsb(&self, amplitude_lsb: f64) -> f64 {
        self.absolute_lsb.max(self.relative * amplitude_lsb)
    }
}

/// Sampled paths of all people in a frame.
#[derive(Debug, Clone, Default)]
pub struct SampledPaths {
    /// The paths, to all receivers.
    pub tracks: Tracks,
    /// Weak paths in each interval of the frame, both directions as one echo. Without intervals, all paths are in
    /// `tracks`.
    pub weak: Vec<HeldEchoes>,
    /// Number of audible paths; both directions count.
    pub audible_count: usize,
}

/// Sample of a receiver; `None` where there is no such path.
fn existing_sample(traced: &TracedPath, receiver: usize) -> Option<&PathSample> {
    traced.samples().get(receiver).filter(|sample| traced.unit.is_some() || sample.amplitude != Complex64::ZERO)
}

/// Samples of every receiver at five instants, `apart_s` apart. Where there is no path, its delay is extrapolated from
/// the nearest instant with a path, at the rate of that sample.
fn samples_by_receiver(five: [&TracedPath; 5], apart_s: f64) -> Vec<FiveSamples> {
    let sample = |receiver: usize, at: usize| {
        let own = five[at].samples()[receiver];
        if existing_sample(five[at], receiver).is_some() {
            return own;
        }
        let existing = (0..5usize).filter_map(|i| Some((i, existing_sample(five[i], receiver)?)));
        let Some((i, near)) = existing.min_by_key(|(i, _)| i.abs_diff(at)) else { return own };
        let later_s = apart_s * (at as f64 - i as f64);
        PathSample { delay_s: near.delay_s + near.delay_rate * later_s, delay_rate: near.delay_rate, ..own }
    };
    let receivers = five.iter().map(|traced| traced.samples().len()).min().unwrap_or(0);
    (0..receivers).map(|receiver| std::array::from_fn(|at| sample(receiver, at))).collect()
}

impl SampledPaths {
    /// Adds the paths of a person.
    pub fn add(&mut self, instants: &Instants, paths: &Paths, tolerance: &SamplingTolerance, report: &mut EchoReport) {
        Tracer { instants, paths, tolerance, report, out: self }.trace_frame();
    }
}

/// Both directions of a path in a segment; the second is absent where the path stands for one.
type BothDirections = [Option<Track>; 2];

/// Path in a segment that may still have to be halved.
#[derive(Debug, Clone, Copy)]
struct PendingPath {
    path: usize,
    /// Path at both ends and in the middle of the segment.
    traced: [TracedPath; 3],
}

/// Traces the paths of a person through a frame.
struct Tracer<'a> {
    instants: &'a Instants<'a>,
    paths: &'a Paths<'a>,
    tolerance: &'a SamplingTolerance,
    report: &'a mut EchoReport,
    out: &'a mut SampledPaths,
}

impl Tracer<'_> {
    /// Traces paths at an instant. Each request gives the path's index and a nearby specular point, if one is known. In
    /// box rooms people do not yet obstruct these paths.
    fn trace_all(&mut self, instant: usize, requests: &[(usize, Option<DVec3>)]) -> Vec<TracedPath> {
        self.paths.trace_all(requests, self.instants.people(instant), self.report)
    }

    /// Traces paths as `trace_all` does, and applies the obstruction by people.
    fn trace_obstructed(&mut self, instant: usize, requests: &[(usize, Option<DVec3>)]) -> Vec<TracedPath> {
        let mut traced = self.trace_all(instant, requests);
        let numbered = requests.iter().map(|&(path, _)| path).zip(&mut traced);
        self.paths.obstruct_by_people(numbered, self.instants.people(instant));
        traced
    }

    /// Traces all paths from one end of the frame to the other.
    fn trace_frame(&mut self) {
        let pending = self.audible_paths();
        let directions = |pending: &PendingPath| 1 + usize::from(self.paths.is_both_ways(pending.path));
        self.out.audible_count += pending.iter().map(directions).sum::<usize>();
        // The lists are ordered by segment, and within a segment by path.
        let (mut halvings, mut level) = (0, vec![pending]);
        while level.iter().any(|pending| !pending.is_empty()) {
            let mut next: Vec<Vec<PendingPath>> = vec![Vec::new(); 2 * level.len()];
            for (segment, pending) in level.iter().enumerate().filter(|(_, pending)| !pending.is_empty()) {
                self.sample_segment(halvings, segment, pending, &mut next);
            }
            (halvings, level) = (halvings + 1, next);
        }
    }

    /// Paths that are audible at an end of the frame or in its middle.
    fn audible_paths(&mut self) -> Vec<PendingPath> {
        let instants = [0, self.instants.count / 2, self.instants.count];
        let mut requests: Vec<(usize, Option<DVec3>)> = (0..self.paths.count()).map(|path| (path, None)).collect();
        let mut trace_at = |instant: usize| {
            let traced = self.trace_all(instant, &requests);
            requests.iter_mut().zip(&traced).for_each(|((_, near), traced)| *near = traced.unit);
            traced
        };
        let [first, middle, last] = instants.map(&mut trace_at);
        let least_power = self.tolerance.audible_lsb * self.tolerance.audible_lsb;
        // The receivers are so close together that the first represents all, here and in `sample_segment`.
        let is_audible = |traced: &TracedPath| {
            traced.samples().first().is_some_and(|sample| sample.amplitude.norm_sqr() > least_power)
        };
        // Obstruction by people makes no path louder.
        let may_be_audible = |&path: &usize| [&first, &middle, &last].into_iter().any(|at| is_audible(&at[path]));
        let pending = |path: usize| PendingPath { path, traced: [first[path], middle[path], last[path]] };
        let mut audible = Vec::with_capacity((0..first.len()).filter(may_be_audible).count());
        audible.extend((0..first.len()).filter(may_be_audible).map(pending));
        for (i, instant) in instants.into_iter().enumerate() {
            let numbered = audible.iter_mut().map(|pending| (pending.path, &mut pending.traced[i]));
            self.paths.obstruct_by_people(numbered, self.instants.people(instant));
        }
        audible.retain(|pending| pending.traced.iter().any(is_audible));
        audible
    }

    /// Keeps a path, in one direction or both, in number `segment` of the segments of a frame that is halved `halvings`
    /// times.
    fn keep(&mut self, halvings: u32, segment: usize, directions: BothDirections) {
        let SamplingTolerance { threshold_lsb, chirp, .. } = self.tolerance;
        let out = &mut *self.out;
        let is_exact = self.tolerance.fixed_halvings.is_some();
        let position = [halvings as usize, segment];
        if is_exact || !weak_track::add(&directions, position, chirp, *threshold_lsb, &mut out.weak) {
            directions.into_iter().flatten().for_each(|track| out.tracks.push(halvings, segment, track));
        }
    }

    /// Keeps the paths of a segment that few samples represent well enough. Passes the others to the segment's halves
    /// in `next`.
    fn sample_segment(&mut self, halvings: u32, segment: usize, all: &[PendingPath], next: &mut [Vec<PendingPath>]) {
        let interval_s = self.instants.span_s / f64::from(1u32 << halvings);
        let instant = |quarter: usize| ((4 * segment + quarter) * self.instants.count) >> (halvings + 2);
        let [before, middle, after] = [1, 2, 3].map(instant);
        let may_be_obstructed = self.paths.may_be_obstructed(self.instants.people(middle), 0.5 * interval_s);
        let mut rest = Vec::with_capacity(all.len());
        for pending in all {
            match self.through_three(pending, &may_be_obstructed, interval_s) {
                Some(directions) => self.keep(halvings, segment, directions),
                None => rest.push(*pending),
            }
        }
        if rest.is_empty() {
            return;
        }
        let requests = |end: usize| -> Vec<(usize, Option<DVec3>)> {
            rest.iter().map(|pending| (pending.path, pending.traced[end].unit)).collect()
        };
        let (before, after) = (self.trace_obstructed(before, &requests(0)), self.trace_obstructed(after, &requests(2)));
        for ((pending, before), after) in rest.iter().zip(before).zip(after) {
            let [first, middle, last] = pending.traced;
            let five = [first, before, middle, after, last];
            let through = |five: [TracedPath; 5]| {
                let samples = samples_by_receiver(five.each_ref(), 0.25 * interval_s);
                Track::through(&samples, interval_s, self.tolerance.chirp.start_hz)
            };
            let Some((track, error_lsb)) = through(five) else { continue };
            let is_accurate = error_lsb <= self.tolerance.allowed_lsb(loudest_lsb(&[before, middle, after]));
            let is_done = match self.tolerance.fixed_halvings {
                Some(fixed) => halvings == fixed,
                None => is_accurate || halvings == MAX_HALVINGS,
            };
            if is_done {
                let reverse =
                    self.paths.is_both_ways(pending.path).then(|| through(five.map(|traced| traced.reversed())));
                self.keep(halvings, segment, [Some(track), reverse.flatten().map(|(track, _)| track)]);
                continue;
            }
            next[2 * segment].push(PendingPath { traced: [first, before, middle], ..*pending });
            next[2 * segment + 1].push(PendingPath { traced: [middle, after, last], ..*pending });
        }
    }

    /// Interpolates a path by its samples at both ends and in the middle, if these suffice: the error bound is that of
    /// other paths, and nothing can obstruct the path only between two samples. `may_be_obstructed` tells this by body
    /// segment.
    fn through_three(
        &self,
        pending: &PendingPath,
        may_be_obstructed: &[bool; SEGMENTS],
        interval_s: f64,
    ) -> Option<BothDirections> {
        let is_clear = |traced: &TracedPath| traced.is_clear && traced.unit.is_some();
        let body_segment = self.paths.segment(pending.path);
        let may_be_obstructed = body_segment.is_none_or(|body_segment| may_be_obstructed[body_segment]);
        if self.tolerance.fixed_halvings.is_some() || may_be_obstructed || !pending.traced.iter().all(is_clear) {
            return None;
        }
        let through = |traced: &[TracedPath; 3]| {
            let samples = traced.each_ref().map(|traced| traced.samples());
            Track::through_three(samples, interval_s, self.tolerance.chirp.start_hz)
        };
        let (track, error_lsb) = through(&pending.traced)?;
        if error_lsb > self.tolerance.allowed_lsb(loudest_lsb(&pending.traced)) {
            return None;
        }
        let is_both_ways = self.paths.is_both_ways(pending.path);
        let reverse = is_both_ways.then(|| through(&pending.traced.map(|traced| traced.reversed()))).flatten();
        Some([Some(track), reverse.map(|(track, _)| track)])
    }
}

/// Largest amplitude of a path at the first receiver at three instants, LSB.
fn loudest_lsb(traced: &[TracedPath; 3]) -> f64 {
    let samples = traced.iter().filter_map(|traced| traced.samples().first());
    samples.map(|sample| magnitude(sample.amplitude)).fold(0.0, f64::max)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// At instants without a path the delay is extrapolated and the amplitude is zero.
    #[test]
    fn delays_are_extrapolated_where_a_path_ends() {
        let sample =
            |delay_s: f64, amplitude: f64| PathSample { delay_s, delay_rate: 2.0, amplitude: amplitude.into() };
        let traced =
            |delay_s: f64, amplitude: f64, unit: Option<DVec3>| TracedPath::new(&[sample(delay_s, amplitude)], unit);
        let (path, no_path) = (|delay_s| traced(delay_s, 1.0, Some(DVec3::X)), || traced(99.0, 0.0, None));
        let five = [no_path(), path(1.0), path(3.0), no_path(), no_path()];
        let samples = samples_by_receiver(five.each_ref(), 0.5)[0];
        assert_eq!(samples.map(|sample| sample.delay_s), [0.0, 1.0, 3.0, 4.0, 5.0]);
        assert_eq!(samples.map(|sample| sample.amplitude.re), [0.0, 1.0, 1.0, 0.0, 0.0]);
        // A path without a specular point on a segment is still a path.
        let five = [traced(7.0, 1.0, None), path(1.0), path(3.0), path(4.0), path(5.0)];
        assert_eq!(samples_by_receiver(five.each_ref(), 0.5)[0][0].delay_s, 7.0);
    }
}
