//! Which key times the paths of people take.
//!
//! A path is traced at the ends of a frame, in its middle and at its quarters. Where the ends do not predict the others, in delay
//! and amplitude together, it is cut in halves, and each half is tested in the same way. So a trunk has two keys in a frame, a
//! foot two or three, and a limb whose highlight passes behind another one as many as it takes. Quarters are there because shadows are
//! short: one may come and go within half a frame, and middles alone would miss it.

use std::cell::OnceCell;
use std::sync::Arc;

use glam::DVec3;

use crate::actor::motion::Motion;
use crate::echo::{EchoReport, Paths, Snapshot};
use crate::slow_time::{Bend, Key};
use crate::tracks::{OTHERS, Track, Tracks};

/// Paths are halved no more often than this: sixteenths of a frame.
pub const MOST_HALVINGS: u32 = 4;
/// From a key to the times at which it is looked how the paths bend there, s.
const APART_S: f64 = 1e-3;

/// Everybody at the times that may be asked for: fractions of a frame.
pub struct Instants<'a> {
    motions: &'a [Arc<Motion>],
    start_s: f64,
    span_s: f64,
    /// Between the first instant and the last.
    count: usize,
    /// `[instant]`: before, at, and after it.
    snapshots: Vec<[OnceCell<Vec<Snapshot>>; 3]>,
}

impl<'a> Instants<'a> {
    /// Of `span_s` from a time on, which may be halved this often.
    pub fn new(motions: &'a [Arc<Motion>], start_s: f64, span_s: f64, halvings: u32) -> Self {
        let count = 4usize << halvings;
        Instants { motions, start_s, span_s, count, snapshots: (0..=count).map(|_| Default::default()).collect() }
    }

    /// Everybody before (0), at (1) or after (2) an instant.
    fn people(&self, instant: usize, which: usize) -> &[Snapshot] {
        let Some(cell) = self.snapshots.get(instant).and_then(|three| three.get(which)) else { return &[] };
        let time_s = self.start_s + self.span_s * instant as f64 / self.count as f64 + APART_S * (which as f64 - 1.0);
        cell.get_or_init(|| self.motions.iter().map(|m| Snapshot::new(m, time_s)).collect())
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
struct Met<T> {
    keys: Vec<T>,
    place: Option<DVec3>,
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
    fn trace(&mut self, instant: usize, which: usize, near: Option<DVec3>) -> Met<Key> {
        let mut keys = Vec::with_capacity(1 + OTHERS);
        let place = self.paths.trace(self.path, self.instants.people(instant, which), near, &mut keys, self.report);
        Met { keys, place }
    }

    /// From one end of the frame to the other.
    fn follow(&mut self) {
        let count = self.instants.count;
        let first = self.trace(0, 1, None);
        let middle = self.trace(count / 2, 1, first.place);
        let last = self.trace(count, 1, middle.place);
        let least = self.demand.heard_lsb * self.demand.heard_lsb;
        // Receivers are so close together that the first stands for all, here and in `cut`.
        let is_heard = |met: &Met<Key>| met.keys.first().is_some_and(|key| key.amplitude.norm_sqr() > least);
        if is_heard(&first) || is_heard(&middle) || is_heard(&last) {
            let (first, last) = (self.bent(0, &first), self.bent(count, &last));
            let stretches = self.cut(0, 0, &first, &middle, &last);
            self.out.heard += 1;
            self.out.keys = self.out.keys.max(stretches + 1);
        }
    }

    /// How what was traced at an instant bends there; not at all where it begins or ends to be.
    fn bent(&mut self, instant: usize, now: &Met<Key>) -> Met<(Key, Bend)> {
        let (before, after) = (self.trace(instant, 0, now.place), self.trace(instant, 2, now.place));
        let exists = before.place.is_some() && now.place.is_some() && after.place.is_some();
        let three = before.keys.iter().zip(&now.keys).zip(&after.keys);
        let bend = |((before, now), after): ((&Key, &Key), &Key)| {
            (*now, if exists { Bend::between(before, now, after, APART_S) } else { Bend::default() })
        };
        Met { keys: three.map(bend).collect(), place: now.place }
    }

    /// Halves a stretch for as long as it takes; returns the number of stretches.
    fn cut(
        &mut self,
        halvings: u32,
        place: usize,
        first: &Met<(Key, Bend)>,
        middle: &Met<Key>,
        last: &Met<(Key, Bend)>,
    ) -> usize {
        let stretch_s = self.instants.span_s / f64::from(1u32 << halvings);
        let track = Track::between(&first.keys, &last.keys, stretch_s);
        let instant = |quarter: usize| ((4 * place + quarter) * self.instants.count) >> (halvings + 2);
        let instants = [1, 2, 3].map(instant);
        let quarters = [self.trace(instants[0], 1, first.place), self.trace(instants[2], 1, last.place)];
        let between = [(0.25, &quarters[0]), (0.5, middle), (0.75, &quarters[1])];
        let (mut missed_lsb, mut loudest_lsb) = (0.0f64, 0.0f64);
        for (u, met) in between {
            if let (Some(track), Some(key)) = (&track, met.keys.first()) {
                missed_lsb = missed_lsb.max(track.first.error_lsb(u, key, self.demand.frequency_hz));
                loudest_lsb = loudest_lsb.max(key.amplitude.norm());
            }
        }
        let is_met = missed_lsb <= self.demand.least_lsb.max(self.demand.tolerance * loudest_lsb);
        if self.demand.halvings.map_or(is_met || halvings == MOST_HALVINGS, |asked| halvings == asked) {
            self.out.missed += missed_lsb * missed_lsb * stretch_s;
            self.out.power += loudest_lsb * loudest_lsb * stretch_s;
            if let Some(track) = track {
                self.out.tracks.push(halvings, place, track);
            }
            return 1;
        }
        let [left, right] = quarters;
        let middle = self.bent(instants[1], middle);
        self.cut(halvings + 1, 2 * place, first, &left, &middle)
            + self.cut(halvings + 1, 2 * place + 1, &middle, &right, last)
    }
}
