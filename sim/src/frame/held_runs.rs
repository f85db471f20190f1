//! Held echoes of a frame (diffuse echoes and weak paths), added in runs of chirps. Echoes that change too much for a
//! run are added block by block.

use std::ops::Range;

use super::FrameSimulator;
use crate::synthesis::{CHIRPS, Grids, HeldEchoes, RUN, RateGrids, Run};

/// Most recent run of chirps with synthesised held echoes.
pub(super) struct HeldRun {
    /// Chirps of the run; empty where a single block is not worth a run.
    chirps: Range<usize>,
    rates: RateGrids,
    /// Grids: `[receiver][block of the run]`.
    blocks: Vec<Vec<Grids>>,
}

impl FrameSimulator {
    /// Creates the state before the first run.
    pub(super) fn held_run(&self) -> HeldRun {
        let (synthesiser, receivers) = (&self.synthesiser, self.waveform().shape().rx);
        let blocks = vec![vec![synthesiser.grids(); RUN / CHIRPS]; receivers];
        HeldRun { chirps: 0..0, rates: synthesiser.rate_grids(receivers), blocks }
    }

    /// Replaces the grids of a block of chirps by the held echoes of each interval of a frame. Blocks must be given in
    /// order.
    pub(super) fn set_held_block(
        &self,
        block: Range<usize>,
        held: &[HeldEchoes],
        run: &mut HeldRun,
        grids: &mut [Grids],
    ) {
        let Some(halvings) = held.len().checked_ilog2() else { return };
        if block.start >= run.chirps.end {
            self.begin_run(&block, halvings, held, run);
        }
        let in_run = run.chirps.contains(&block.start);
        let number = block.start.saturating_sub(run.chirps.start) / CHIRPS;
        for (grids, blocks) in grids.iter_mut().zip(&mut run.blocks) {
            match blocks.get_mut(number).filter(|_| in_run) {
                // Each block of a run is needed once.
                Some(block) => std::mem::swap(grids, block),
                None => grids.clear(),
            }
        }
        for (interval, positions) in self.intervals_of(block.clone(), halvings) {
            let echoes = if in_run { Some(run.rates.rejected()) } else { held.get(interval) };
            if let Some(echoes) = echoes {
                self.synthesiser.spread_held(&self.prepared.chirp, echoes, &positions, grids);
            }
        }
    }

    /// Synthesises a run that starts at a block, with all following blocks in its interval that fit. A run of one block
    /// would not save work.
    fn begin_run(&self, block: &Range<usize>, halvings: u32, held: &[HeldEchoes], run: &mut HeldRun) {
        let chirps = self.waveform().shape().chirps;
        let (interval, first) = self.position_of(block.start, halvings);
        let is_inside = |end: usize| self.position_of(end - 1, halvings).0 == interval;
        let ends = (block.start + CHIRPS..block.start + RUN + CHIRPS).step_by(CHIRPS).map(|end| end.min(chirps));
        let end = ends.take_while(|&end| is_inside(end) && end - block.start <= RUN).last().unwrap_or(block.start);
        run.chirps = block.start..end;
        if run.chirps.len() <= CHIRPS {
            run.chirps.end = run.chirps.start;
            return;
        }
        let Some(echoes) = held.get(interval) else { return };
        let (_, last) = self.position_of(end - 1, halvings);
        let step = (last - first) / (run.chirps.len() - 1) as f64;
        let spread = Run { first, step, chirps: run.chirps.len() };
        run.blocks.iter_mut().flatten().for_each(Grids::clear);
        self.synthesiser.spread_rates(&self.prepared.chirp, echoes, &spread, &mut run.rates, &mut run.blocks);
    }
}
