//! Echoes of people modelled as skins.

use std::sync::{Arc, PoisonError};

use super::paths::{FIRST_HALVINGS, FramePaths, MAX_SKIN_HALVINGS};
use super::{FrameReport, FrameSimulator};
use crate::echo::dense;
use crate::echo::error_budget::{ErrorBudget, ErrorEstimate};
use crate::echo::skin::SkinnedPerson;
use crate::echo::{EchoReport, FrameTimes, Snapshot, audible_pairs, loud_pairs};
use crate::path_sampling::Instants;
use crate::people::motion::Motion;
use crate::people::skin::EDGE_M;
use crate::people::walking_mesh::WalkingMesh;
use crate::prepared_scene::threshold_lsb;
use crate::scene_file::BodyFile;
use crate::synthesis::ChirpGrids;
use crate::tracks::Tracks;

/// Allowed interpolation error between key times of all of a skin's echoes, relative to them, for half a decibel.
const SKIN_TOLERANCE: f64 = 0.03;
/// Number of skins that are kept: those of people in the room, and of the next ones.
const MAX_SKINS: usize = 8;

impl FrameSimulator {
    /// Returns a person's skin; `None` where people are ellipsoids.
    fn skin(&self, motion: &Arc<Motion>) -> Option<Arc<SkinnedPerson>> {
        if self.scene.file().people.body != BodyFile::Mesh {
            return None;
        }
        let mut skins = self.skins.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(at) = skins.iter().position(|(owner, _)| Arc::ptr_eq(owner, motion)) {
            let kept = skins.remove(at);
            let skin = Arc::clone(&kept.1);
            skins.push(kept);
            return Some(skin);
        }
        let skin = Arc::new(SkinnedPerson::new(WalkingMesh::new(Arc::clone(motion), EDGE_M)));
        if skins.len() >= MAX_SKINS {
            skins.remove(0);
        }
        skins.push((Arc::clone(motion), Arc::clone(&skin)));
        Some(skin)
    }

    fn budget(&self) -> ErrorBudget {
        let noise_lsb = threshold_lsb(self.scene.receiver(), self.waveform(), 0.0);
        ErrorBudget { tolerance_db: self.options.tolerance_db, noise_lsb }
    }

    /// Computes the echoes of all skins, and their errors.
    fn skin_echoes(
        &self,
        motions: &[Arc<Motion>],
        snapshots: &[Vec<Snapshot>],
        keys_s: Vec<f64>,
        report: &mut EchoReport,
    ) -> (ChirpGrids, ErrorEstimate) {
        let shape = self.waveform().shape();
        let (start_s, middle) = (keys_s.first().copied().unwrap_or_default(), keys_s.len() / 2);
        let now = snapshots.get(middle).map(Vec::as_slice).unwrap_or_default();
        let chirp = |i: usize| start_s + i as f64 * self.waveform().chirp_interval_s;
        let chirps_s = (0..shape.chirps).map(|i| chirp(i) + self.prepared.chirp.middle_s).collect();
        let times = FrameTimes::new(keys_s, chirps_s);
        let (budget, prepared, integrator) = (self.budget(), &self.prepared, &self.integrator);
        let mut grids = ChirpGrids::new(&self.synthesiser, shape.rx, shape.chirps);
        if self.phase_rates.is_some() {
            grids = grids.with_delays();
        }
        let mut max_error = ErrorEstimate::default();
        for (target, motion) in motions.iter().enumerate() {
            let Some(skin) = self.skin(motion) else { continue };
            let pairs = audible_pairs(prepared, motion, start_s + 0.5 * self.active_s());
            let loud = loud_pairs(prepared, motion, now, target, &pairs);
            let error =
                skin.add_echoes(prepared, integrator, &budget, &times, snapshots, target, &loud, &mut grids, report);
            max_error = max_error.max(error);
        }
        (grids, max_error)
    }

    /// Traces people who have skins, with key times as close as accuracy requires, or in a frame that is halved
    /// `fixed_halvings` times.
    pub(super) fn trace_skins(&self, instants: &Instants, fixed_halvings: Option<u32>) -> FramePaths {
        let mut halvings = fixed_halvings.unwrap_or(FIRST_HALVINGS);
        loop {
            let mut echo_report = EchoReport::default();
            let ends_s = self.ends_s(instants.start_s(), halvings);
            let snapshots = instants.at_ends(halvings);
            let (grids, error) = self.skin_echoes(instants.motions(), &snapshots, ends_s, &mut echo_report);
            if error.interpolation > SKIN_TOLERANCE && halvings < MAX_SKIN_HALVINGS && fixed_halvings.is_none() {
                halvings += 1;
                continue;
            }
            let report = FrameReport {
                static_paths: self.prepared.static_paths.len(),
                moving_paths: echo_report.synthesised,
                estimate_db: (!instants.motions().is_empty()).then(|| error.db()),
                clamped: echo_report.clamped,
                clipped: 0,
            };
            let held = self.held_echoes(instants.motions().len(), halvings);
            return FramePaths { snapshots, halvings, tracks: Tracks::default(), held, skins: Some(grids), report };
        }
    }

    /// Computes one chirp of people's echoes with the reference method ([`dense`]), LSB: `[rx][sample]`; skins only.
    pub(crate) fn dense_echo_chirp(&self, index: u64, chirp: usize, margin_db: f64) -> Vec<Vec<f64>> {
        let (shape, start_s) = (self.waveform().shape(), self.start_s(index));
        let motions = self.motions(start_s);
        let mut prepared = self.prepared.clone();
        prepared.threshold_lsb = threshold_lsb(self.scene.receiver(), self.waveform(), margin_db);
        let middle_s = start_s + 0.5 * self.active_s();
        let middle: Vec<Snapshot> = motions.iter().map(|m| Snapshot::new(m, middle_s)).collect();
        let time_s = start_s + chirp as f64 * self.waveform().chirp_interval_s + prepared.chirp.middle_s;
        let people: Vec<Snapshot> = motions.iter().map(|m| Snapshot::new(m, time_s)).collect();
        let mut sum = vec![vec![0.0; shape.samples]; shape.rx];
        for (target, motion) in motions.iter().enumerate() {
            let Some(skin) = self.skin(motion) else { continue };
            let pairs = audible_pairs(&prepared, motion, middle_s);
            let pairs = loud_pairs(&prepared, motion, &middle, target, &pairs);
            let pairs: Vec<_> = pairs.into_iter().map(|(pair, _)| pair).collect();
            let echoes = dense::chirp(&prepared, &skin, &people, target, &pairs, time_s, shape.samples);
            for (sum, echo) in sum.iter_mut().flatten().zip(echoes.iter().flatten()) {
                *sum += echo;
            }
        }
        sum
    }
}
