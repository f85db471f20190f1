//! Which key times the paths of people take.
//!
//! A path is traced at the ends of a frame, in its middle and at its quarters. Where ends and quarters do not predict the middle, in
//! delay and amplitude together, it is cut in halves, and each half is tested in the same way, with quarters of its own. So a trunk
//! has two keys in a frame, a foot two or three, and a limb whose highlight passes behind another one as many as it takes.
//! Quarters are there because shadows are short: one may come and go within half a frame, and middles alone would miss it.
//!
//! A path that is followed in one stretch is traced five times, and four more times for each time that it is cut.

use std::cell::OnceCell;
use std::sync::Arc;

use glam::DVec3;
use num_complex::Complex64;

use crate::actor::body::SEGMENTS;
use crate::actor::motion::Motion;
use crate::echo::{EchoReport, Paths, Snapshot};
use crate::field::highlight::Ellipsoid;
use crate::slow_time::{FiveKeys, Key};
use crate::tracks::{OTHERS, Track, Tracks};

/// Paths are halved no more often than this: sixteenths of a frame.
pub const MOST_HALVINGS: u32 = 4;

/// Everybody in a frame at the times that may be asked for, each looked at once.
pub struct Instants<'a> {
    motions: &'a [Arc<Motion>],
    start_s: f64,
    span_s: f64,
    /// Between the first instant and the last.
    count: usize,
    /// Everybody at each instant that was asked for.
    snapshots: Vec<OnceCell<Vec<Snapshot>>>,
}

impl<'a> Instants<'a> {
    /// Of `span_s` from a time on, which may be halved this often.
    pub fn new(motions: &'a [Arc<Motion>], start_s: f64, span_s: f64, halvings: u32) -> Self {
        let count = 4usize << halvings;
        Instants { motions, start_s, span_s, count, snapshots: vec![OnceCell::new(); count + 1] }
    }

    /// How everybody moves.
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

    /// Everybody at an instant.
    fn people(&self, instant: usize) -> &[Snapshot] {
        let Some(cell) = self.snapshots.get(instant) else { return &[] };
        let time_s = self.time_s(instant);
        cell.get_or_init(|| self.motions.iter().map(|m| Snapshot::new(m, time_s)).collect())
    }

    /// Everybody at the ends of the stretches into which so many halvings cut the frame.
    pub fn at_ends(&self, halvings: u32) -> Vec<Vec<Snapshot>> {
        (0..=1usize << halvings).map(|end| self.people((end * self.count) >> halvings).to_vec()).collect()
    }

    /// Somebody's body at a quarter of the frame, 0 to 4.
    pub fn body_at_quarter(&self, person: usize, quarter: usize) -> Option<[Ellipsoid; SEGMENTS]> {
        let instant = quarter * self.count / 4;
        match self.snapshots.get(instant).and_then(OnceCell::get) {
            Some(people) => people.get(person).map(|snapshot| snapshot.body),
            None => self.motions.get(person).map(|motion| motion.body(self.time_s(instant))),
        }
    }
}

/// What is asked of the key times.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KeyDemand {
    /// A path is heard if it is as strong as this at an end or in the middle of the frame, LSB.
    pub heard_lsb: f64,
    /// What may be missed of a path however weak it is, LSB.
    pub least_lsb: f64,
    /// Part of a path's own amplitude that may be missed.
    pub tolerance: f64,
    /// Every path is halved this often, whatever is missed.
    pub halvings: Option<u32>,
    /// Frequency at which phases are compared, Hz.
    pub frequency_hz: f64,
}

/// Everybody's paths in a frame.
#[derive(Debug, Clone, Default)]
pub struct KeyedPaths {
    /// The paths, to all receivers.
    pub tracks: Tracks,
    /// Paths that were looked at.
    pub traced: usize,
    /// Those of them that are heard.
    pub heard: usize,
    /// Most key times that any of those took.
    pub keys: usize,
    missed: f64,
    power: f64,
}

/// A path at an instant, for each receiver, and where it is met on its segment.
struct Met {
    keys: Vec<Key>,
    place: Option<DVec3>,
}

impl Met {
    /// Key of a receiver; `None` where there is no such path.
    fn existing(&self, receiver: usize) -> Option<&Key> {
        self.keys.get(receiver).filter(|key| self.place.is_some() || key.amplitude != Complex64::ZERO)
    }
}

/// Keys of every receiver at five instants, `apart_s` apart. Where there is no path its delay is that of the nearest instant at
/// which there is one, and goes on at that one's rate.
fn keys_of(five: [&Met; 5], apart_s: f64) -> Vec<FiveKeys> {
    let key = |receiver: usize, at: usize| {
        let own = five[at].keys[receiver];
        if five[at].existing(receiver).is_some() {
            return own;
        }
        let existing = (0..5usize).filter_map(|i| Some((i, five[i].existing(receiver)?)));
        let Some((i, near)) = existing.min_by_key(|(i, _)| i.abs_diff(at)) else { return own };
        let later_s = apart_s * (at as f64 - i as f64);
        Key { delay_s: near.delay_s + near.delay_rate * later_s, delay_rate: near.delay_rate, ..own }
    };
    let receivers = five.iter().map(|met| met.keys.len()).min().unwrap_or(0);
    (0..receivers).map(|receiver| std::array::from_fn(|at| key(receiver, at))).collect()
}

impl KeyedPaths {
    /// What is missed at most within stretches relative to the echoes, rms by power.
    pub fn error(&self) -> f64 {
        if self.power > 0.0 { (self.missed / self.power).sqrt() } else { 0.0 }
    }

    /// Adds somebody's paths.
    pub fn add(&mut self, instants: &Instants, paths: &Paths, demand: &KeyDemand, report: &mut EchoReport) {
        for path in 0..paths.count() {
            self.traced += 1;
            Tracer { instants, paths, path, demand, report, out: self }.follow();
        }
    }
}

/// Follows one path through a frame.
struct Tracer<'a> {
    instants: &'a Instants<'a>,
    paths: &'a Paths<'a>,
    path: usize,
    demand: &'a KeyDemand,
    report: &'a mut EchoReport,
    out: &'a mut KeyedPaths,
}

impl Tracer<'_> {
    fn trace(&mut self, instant: usize, near: Option<DVec3>) -> Met {
        let mut keys = Vec::with_capacity(1 + OTHERS);
        let place = self.paths.trace(self.path, self.instants.people(instant), near, &mut keys, self.report);
        Met { keys, place }
    }

    /// From one end of the frame to the other.
    fn follow(&mut self) {
        let count = self.instants.count;
        let first = self.trace(0, None);
        let middle = self.trace(count / 2, first.place);
        let last = self.trace(count, middle.place);
        let least = self.demand.heard_lsb * self.demand.heard_lsb;
        // Receivers are so close together that the first stands for all, here and in `cut`.
        let is_heard = |met: &Met| met.keys.first().is_some_and(|key| key.amplitude.norm_sqr() > least);
        if is_heard(&first) || is_heard(&middle) || is_heard(&last) {
            let stretches = self.cut(0, 0, [&first, &middle, &last]);
            self.out.heard += 1;
            self.out.keys = self.out.keys.max(stretches + 1);
        }
    }

    /// Halves a stretch for as long as it takes, given the path at its ends and in its middle; returns the number of stretches.
    fn cut(&mut self, halvings: u32, place: usize, [first, middle, last]: [&Met; 3]) -> usize {
        let stretch_s = self.instants.span_s / f64::from(1u32 << halvings);
        let instant = |quarter: usize| ((4 * place + quarter) * self.instants.count) >> (halvings + 2);
        let [before, after] = [1, 3].map(instant);
        let (before, after) = (self.trace(before, first.place), self.trace(after, last.place));
        let five = [first, &before, middle, &after, last];
        let keys = keys_of(five, 0.25 * stretch_s);
        let Some((track, missed_lsb)) = Track::through(&keys, stretch_s, self.demand.frequency_hz) else { return 1 };
        let between = [&before, middle, &after].into_iter().filter_map(|met| met.keys.first());
        let loudest_lsb = between.map(|key| key.amplitude.norm()).fold(0.0, f64::max);
        let is_met = missed_lsb <= self.demand.least_lsb.max(self.demand.tolerance * loudest_lsb);
        if self.demand.halvings.map_or(is_met || halvings == MOST_HALVINGS, |asked| halvings == asked) {
            self.out.missed += missed_lsb * missed_lsb * stretch_s;
            self.out.power += loudest_lsb * loudest_lsb * stretch_s;
            self.out.tracks.push(halvings, place, track);
            return 1;
        }
        self.cut(halvings + 1, 2 * place, [first, &before, middle])
            + self.cut(halvings + 1, 2 * place + 1, [middle, &after, last])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Beside instants without a path, delays go on as they were, and nothing is heard.
    #[test]
    fn delays_go_on_where_paths_end_to_be() {
        let key = |delay_s: f64, amplitude: f64| Key { delay_s, delay_rate: 2.0, amplitude: amplitude.into() };
        let met =
            |delay_s: f64, amplitude: f64, place: Option<DVec3>| Met { keys: vec![key(delay_s, amplitude)], place };
        let (here, gone) = (|delay_s| met(delay_s, 1.0, Some(DVec3::X)), || met(99.0, 0.0, None));
        let five = [gone(), here(1.0), here(3.0), gone(), gone()];
        let keys = keys_of(five.each_ref(), 0.5)[0];
        assert_eq!(keys.map(|key| key.delay_s), [0.0, 1.0, 3.0, 4.0, 5.0]);
        assert_eq!(keys.map(|key| key.amplitude.re), [0.0, 1.0, 1.0, 0.0, 0.0]);
        // A path without a place of its own on a segment is one nevertheless.
        let five = [met(7.0, 1.0, None), here(1.0), here(3.0), here(4.0), here(5.0)];
        assert_eq!(keys_of(five.each_ref(), 0.5)[0][0].delay_s, 7.0);
    }
}
