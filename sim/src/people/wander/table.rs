//! Table of a simulated group's motion: steps at fixed times, computed in blocks when they are first requested.
//!
//! The table keeps the state at the beginning of each block, and the nodes of the blocks that were requested last. An
//! hour therefore takes little memory, and a time gives the same result in any order of requests.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use super::dynamics::STEP_S;
use super::node::Node;
use super::plan::State;
use super::setting::Setting;

/// Time of the first step, s. At time 0 the group has already moved for a while.
pub(super) const FIRST_S: f64 = -20.0;
/// Time after which nobody moves, s (46 days).
const LAST_S: f64 = 4e6;
/// Number of steps of a block: 32 s.
const BLOCK_STEPS: usize = 640;
/// Largest number of blocks whose nodes are kept.
const MOST_KEPT_BLOCKS: usize = 8;

/// Consecutive steps of all people: `[slot][step]`. The last step is also the first of the next block.
type StepBlock = Vec<Vec<Node>>;

/// A group of people whose motion is known at any time.
#[derive(Debug)]
pub(super) struct Group {
    pub setting: Setting,
    table: Mutex<Table>,
}

#[derive(Debug)]
struct Table {
    /// State at the beginning of each computed block, and at the end of the last one.
    states: Vec<State>,
    /// Blocks that were computed last, with their indices.
    recent_blocks: VecDeque<(usize, Arc<StepBlock>)>,
}

impl Group {
    /// Makes a group of `slots` people in a setting.
    pub fn new(setting: Setting, slots: usize) -> Self {
        let states = vec![State::new(&setting, slots)];
        Group { setting, table: Mutex::new(Table { states, recent_blocks: VecDeque::new() }) }
    }

    fn lock(&self) -> MutexGuard<'_, Table> {
        self.table.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Computes a block from the state at its beginning. Also returns the state at its end.
    fn compute_block(&self, mut state: State) -> (StepBlock, State) {
        let mut block: StepBlock = state.nodes().map(|node| vec![node]).collect();
        for _ in 0..BLOCK_STEPS {
            state.step(&self.setting);
            block.iter_mut().zip(state.nodes()).for_each(|(all, node)| all.push(node));
        }
        (block, state)
    }

    /// Returns a block, which is computed from the last known state before it unless it is kept.
    fn block(&self, requested: usize) -> Arc<StepBlock> {
        let mut table = self.lock();
        if let Some((_, block)) = table.recent_blocks.iter().find(|(block_index, _)| *block_index == requested) {
            return Arc::clone(block);
        }
        loop {
            let index = requested.min(table.states.len() - 1);
            let (block, next) = self.compute_block(table.states[index].clone());
            let block = Arc::new(block);
            if table.recent_blocks.len() >= MOST_KEPT_BLOCKS {
                table.recent_blocks.pop_front();
            }
            table.recent_blocks.push_back((index, Arc::clone(&block)));
            if index + 1 == table.states.len() {
                table.states.push(next);
            }
            if index == requested {
                return block;
            }
        }
    }

    /// Returns the nodes before and after a time, and the elapsed fraction of the step.
    pub fn nodes_around(&self, slot: usize, time_s: f64) -> Option<(Node, Node, f64)> {
        let steps = (time_s.clamp(FIRST_S, LAST_S) - FIRST_S) / STEP_S;
        let whole = steps.floor();
        let (block_index, step) = (whole as usize / BLOCK_STEPS, whole as usize % BLOCK_STEPS);
        let block = self.block(block_index);
        let nodes = block.get(slot)?;
        Some((*nodes.get(step)?, *nodes.get(step + 1)?, steps - whole))
    }

    /// Number of blocks whose nodes are in memory.
    #[cfg(test)]
    pub fn kept_blocks(&self) -> usize {
        self.lock().recent_blocks.len()
    }
}
