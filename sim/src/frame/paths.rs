//! Paths of all people in a frame: specular points with as many sample times as each needs, diffuse echoes, and swaying
//! reflectors.

use std::sync::Arc;

use super::{FrameReport, FrameSimulator};
use crate::diffraction::Column;
use crate::echo::{AUDIBLE_FRACTION, EchoReport, Paths, Snapshot, audible_paths, diffuse};
use crate::path_sampling::{Instants, MAX_HALVINGS, SampledPaths, SamplingTolerance};
use crate::people::motion::Motion;
use crate::scene_file::BodyFile;
use crate::synthesis::{ChirpGrids, HeldEchoes};
use crate::tracks::Tracks;

/// Initial number of times that a frame is halved into intervals, for shadows and skins. The intervals are halved again
/// (quarters, eighths) while the interpolation error of skins is too large.
pub(super) const FIRST_HALVINGS: u32 = 1;
pub(super) const MAX_SKIN_HALVINGS: u32 = 3;
/// Allowed interpolation error between sample times of an ellipsoid's echo for half a decibel, relative to it (-40 dB
/// of error vector magnitude). Weak paths have cells of their own in a map, where nothing stronger hides their errors.
/// Those that are held have larger errors, below the noise ([`crate::weak_track`]).
const PATH_TOLERANCE: f64 = 0.01;

/// Paths of all people in a frame.
pub(super) struct FramePaths {
    /// Snapshots of people: `[end of an interval][person]`.
    pub(super) snapshots: Vec<Vec<Snapshot>>,
    /// Number of times that the frame is halved into those intervals.
    pub(super) halvings: u32,
    /// Paths to all receivers.
    pub(super) tracks: Tracks,
    /// Diffuse echoes and weak paths in each interval of a frame that may be halved less often; empty where walls do
    /// not scatter.
    pub(super) held: Vec<HeldEchoes>,
    /// Echoes of people who have skins.
    pub(super) skins: Option<ChirpGrids>,
    pub(super) report: FrameReport,
}

impl FramePaths {
    /// Returns the same paths, each times `j` and its delay.
    pub(super) fn by_delay(&mut self) -> Self {
        FramePaths {
            snapshots: Vec::new(),
            halvings: self.halvings,
            tracks: self.tracks.by_delay(),
            held: self.held.iter().map(HeldEchoes::by_delay).collect(),
            skins: self.skins.as_mut().and_then(ChirpGrids::take_by_delay),
            report: self.report,
        }
    }

    /// Returns people as columns that obstruct other paths, at the ends of intervals.
    pub(super) fn columns(&self) -> Vec<Vec<Column>> {
        self.snapshots.iter().map(|people| people.iter().map(|person| person.column).collect()).collect()
    }
}

impl FrameSimulator {
    /// Returns the motions of people in a frame, at the times that its paths may need if the frame is halved this
    /// often.
    pub(super) fn instants<'a>(&self, motions: &'a [Arc<Motion>], start_s: f64, halvings: Option<u32>) -> Instants<'a> {
        let max_halvings = MAX_HALVINGS.max(MAX_SKIN_HALVINGS).max(halvings.unwrap_or(0));
        Instants::new(motions, start_s, self.active_s(), max_halvings)
    }

    /// Traces the paths of all people in a frame, with as many sample times as accuracy requires, or halved `halvings`
    /// times.
    pub(super) fn trace_paths(&self, instants: &Instants, halvings: Option<u32>) -> FramePaths {
        let mut paths = match self.scene.file().people.body {
            BodyFile::Mesh => self.trace_skins(instants, halvings),
            BodyFile::Ellipsoids => self.trace_specular_points(instants, halvings),
        };
        self.add_diffuse(instants.motions().len(), &mut paths);
        paths
    }

    /// Returns empty lists of held echoes for the intervals of a frame that is halved this often, at most into halves.
    /// A quintic over a half follows the centre of a segment even where skins need shorter intervals. There is no list
    /// where walls do not scatter: the transforms of these lists are not worth their time for a few weak paths.
    pub(super) fn held_echoes(&self, people: usize, halvings: u32) -> Vec<HeldEchoes> {
        if self.prepared.wall_points.is_empty() {
            return Vec::new();
        }
        let halvings = halvings.min(FIRST_HALVINGS);
        let mut held = vec![HeldEchoes::new(self.active_s() / f64::from(1u32 << halvings)); 1 << halvings];
        let max_echoes = people * self.thinning.max_echoes();
        held.iter_mut().for_each(|interval| interval.reserve(max_echoes));
        held
    }

    /// Adds the diffuse echoes of walls.
    fn add_diffuse(&self, people: usize, paths: &mut FramePaths) {
        let Some(intervals) = paths.snapshots.len().checked_sub(1).filter(|_| !paths.held.is_empty()) else { return };
        let step = intervals / paths.held.len();
        for target in 0..people {
            let snapshots: Vec<&Snapshot> =
                paths.snapshots.iter().step_by(step).filter_map(|people| people.get(target)).collect();
            diffuse::add(&self.prepared, &self.thinning, &snapshots, &mut paths.held);
        }
    }

    /// Traces the specular points of people modelled as ellipsoids.
    fn trace_specular_points(&self, instants: &Instants, halvings: Option<u32>) -> FramePaths {
        let (paths, echo_report) = self.sampled_paths(instants, halvings);
        let report = FrameReport {
            static_paths: self.prepared.static_paths.len(),
            moving_paths: paths.audible_count,
            estimate_db: None,
            clamped: echo_report.clamped,
            clipped: 0,
        };
        let snapshots = instants.at_ends(FIRST_HALVINGS);
        let SampledPaths { tracks, weak: held, .. } = paths;
        FramePaths { snapshots, halvings: FIRST_HALVINGS, tracks, held, skins: None, report }
    }

    /// Samples the paths of all people, each at as many times as it needs.
    fn sampled_paths(&self, instants: &Instants, halvings: Option<u32>) -> (SampledPaths, EchoReport) {
        let tolerance = SamplingTolerance {
            // The limit is 6 dB below a path alone in its cell, since many weak paths add up. Errors may be 20 dB below
            // such a path.
            audible_lsb: AUDIBLE_FRACTION * self.prepared.threshold_lsb,
            absolute_lsb: 0.1 * self.prepared.threshold_lsb,
            relative: PATH_TOLERANCE * self.options.tolerance_db / 0.5,
            threshold_lsb: self.prepared.threshold_lsb,
            fixed_halvings: halvings,
            chirp: self.prepared.chirp,
        };
        let weak = self.held_echoes(instants.motions().len(), FIRST_HALVINGS);
        let mut paths = SampledPaths { weak, ..SampledPaths::default() };
        let mut report = EchoReport::default();
        // Audibility is tested at the ends and in the middle of the frame.
        let instants_s = [0.0, 0.5, 1.0].map(|fraction| instants.start_s() + fraction * self.active_s());
        for (target, motion) in instants.motions().iter().enumerate() {
            let pairs = audible_paths(&self.prepared, motion, &instants_s);
            paths.add(instants, &Paths::new(&self.prepared, motion, target, &pairs), &tolerance, &mut report);
        }
        (paths, report)
    }

    /// Adds the echoes of swaying reflectors to the paths of a frame.
    pub(super) fn add_sway(&self, start_s: f64, paths: &mut FramePaths) {
        let columns = paths.columns();
        self.sway.add(start_s, self.active_s(), &columns, self.prepared.wavelength_m, &mut paths.tracks);
    }

    /// Returns the ends of a frame's intervals, s.
    pub(super) fn ends_s(&self, start_s: f64, halvings: u32) -> Vec<f64> {
        let intervals = 1u32 << halvings;
        (0..=intervals).map(|k| start_s + self.active_s() * f64::from(k) / f64::from(intervals)).collect()
    }
}
