//! Frequency grids of all chirps of a frame, block by block: static paths, moving paths, held echoes, and skins.

use std::ops::Range;

use num_complex::Complex;

use super::FrameSimulator;
use super::chirp_distortion::ChirpDistortion;
use super::clutter::{NO_STATIC, StaticGrids};
use super::paths::FramePaths;
use crate::synthesis::{CHIRPS, ChirpPositions, Grid, Grids, SynthesisScratch};

impl FrameSimulator {
    /// Visits the frequency grid of every chirp of every receiver: static grids, paths, held echoes and skins, with
    /// the common errors of the chirp, if there are any. Chirps of a receiver come in order.
    pub(super) fn each_chirp(
        &self,
        paths: &FramePaths,
        static_grids: &StaticGrids,
        distortions: &[ChirpDistortion],
        mut visit: impl FnMut(usize, usize, &Grid),
    ) {
        let shape = self.waveform().shape();
        let mut grids = vec![self.synthesiser.grids(); shape.rx];
        let mut grid = self.synthesiser.grid();
        let mut run = (!paths.held.is_empty()).then(|| self.held_run());
        for begin in (0..shape.chirps).step_by(CHIRPS) {
            let end = (begin + CHIRPS).min(shape.chirps);
            match &mut run {
                Some(run) => self.set_held_block(begin..end, &paths.held, run, &mut grids),
                None => grids.iter_mut().for_each(Grids::clear),
            }
            self.add_static_block(begin..end, paths.halvings, static_grids, &mut grids);
            for halvings in (0..=paths.tracks.max_halvings()).filter(|&h| !paths.tracks.is_empty_at(h)) {
                for (interval, positions) in self.intervals_of(begin..end, halvings) {
                    let tracks = paths.tracks.at(halvings, interval);
                    self.synthesiser.spread_tracks(&self.prepared.chirp, tracks, &positions, &mut grids);
                }
            }
            for (rx, grids) in grids.iter_mut().enumerate() {
                if let Some(skins) = &paths.skins {
                    skins.add_block(rx, begin / CHIRPS, grids);
                }
                for (lane, chirp) in (begin..end).enumerate() {
                    grids.extract(lane, &mut grid);
                    if static_grids.is_per_chirp
                        && let Some(own) = static_grids.grids.get(rx).and_then(|grids| grids.get(chirp))
                    {
                        grid.add(own);
                    }
                    if let Some(distortion) = distortions.get(chirp) {
                        let factor = Complex::new(distortion.factor.re as f32, distortion.factor.im as f32);
                        self.synthesiser.rotate(
                            factor,
                            distortion.late_s * self.prepared.chirp.sample_rate_hz,
                            &mut grid,
                        );
                    }
                    visit(rx, chirp, &grid);
                }
            }
        }
    }

    /// Adds static paths to the grids of a block of chirps, interpolated between the ends of intervals.
    fn add_static_block(&self, block: Range<usize>, halvings: u32, static_grids: &StaticGrids, grids: &mut [Grids]) {
        for (rx, grids) in grids.iter_mut().enumerate() {
            let at_ends = static_grids.grids.get(rx).filter(|_| !static_grids.is_per_chirp);
            let Some(at_ends) = at_ends else { continue };
            for (interval, positions) in self.intervals_of(block.clone(), halvings) {
                if let Some([a, b]) = at_ends.get(interval..interval + 2) {
                    grids.add_blend(a, b, &positions);
                }
            }
        }
    }

    /// Returns the interval that contains a chirp in a frame that is halved this often, and the chirp's position in it,
    /// 0..1.
    pub(super) fn position_of(&self, chirp: usize, halvings: u32) -> (usize, f64) {
        let intervals = 1usize << halvings;
        let position = self.middle_s(chirp) / self.active_s() * intervals as f64;
        let interval = (position as usize).min(intervals - 1);
        (interval, position - interval as f64)
    }

    /// Returns the intervals that contain chirps of a block in a frame that is halved this often, each with the
    /// positions of those chirps.
    pub(super) fn intervals_of(&self, block: Range<usize>, halvings: u32) -> Vec<(usize, ChirpPositions)> {
        let mut all = Vec::new();
        let mut begin = block.start;
        while begin < block.end {
            let (interval, _) = self.position_of(begin, halvings);
            let end =
                (begin..block.end).find(|&chirp| self.position_of(chirp, halvings).0 != interval).unwrap_or(block.end);
            let lanes = begin - block.start..end - block.start;
            all.push((interval, ChirpPositions::new(lanes, |lane| self.position_of(block.start + lane, halvings).1)));
            begin = end;
        }
        all
    }

    /// Computes the echoes of people, without static echoes and receiver noise, LSB: `[rx][chirp][sample]`.
    pub(crate) fn echo_samples(&self, index: u64, halvings: Option<u32>) -> Vec<f32> {
        let shape = self.waveform().shape();
        let start_s = self.start_s(index);
        let motions = self.motions(start_s);
        let paths = self.trace_paths(&self.instants(&motions, start_s, halvings), halvings);
        let mut scratch = SynthesisScratch::default();
        let mut all = vec![0f32; shape.codes()];
        self.each_chirp(&paths, &NO_STATIC, &[], |rx, chirp, grid| {
            let first = (rx * shape.chirps + chirp) * shape.samples;
            if let Some(samples) = all.get_mut(first..first + shape.samples) {
                self.synthesiser.transform(grid, samples, &mut scratch);
            }
        });
        all
    }
}
