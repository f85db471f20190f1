//! Table of a simulated group's motion: steps at fixed times, computed in blocks when they are first requested.
//!
//! The table keeps the state at the beginning of each block, and the nodes of the blocks that were requested last. An
//! hour therefore takes little memory, and a time gives the same result in any order of requests.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use super::node::Node;
use super::plan::State;
use super::setting::Setting;
use super::walker::STEP_S;

/// Time of the first step, s. At time 0 the group has already moved for a while.
pub(super) const FIRST_S: f64 = -20.0;
/// Time after which nobody moves, s (46 days).
const LAST_S: f64 = 4e6;
/// Number of steps of a block: 32 s.
const BLOCK_STEPS: usize = 640;
const KEPT_BLOCKS: usize = 8;

/// Consecutive steps of all people: `[slot][step]`. The last step is also the first of the next block.
type Block = Vec<Vec<Node>>;

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
    recent: VecDeque<(usize, Arc<Block>)>,
}

impl Group {
    /// Makes a group of `slots` people in a setting.
    pub fn new(setting: Setting, slots: usize) -> Self {
        let states = vec![State::new(&setting, slots)];
        Group { setting, table: Mutex::new(Table { states, recent: VecDeque::new() }) }
    }

    fn lock(&self) -> MutexGuard<'_, Table> {
        self.table.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn run(&self, mut state: State) -> (Block, State) {
        let mut block: Block = state.nodes().map(|node| vec![node]).collect();
        for _ in 0..BLOCK_STEPS {
            state.step(&self.setting);
            block.iter_mut().zip(state.nodes()).for_each(|(all, node)| all.push(node));
        }
        (block, state)
    }

    /// Returns a block, which is computed from the last known state before it unless it is kept.
    fn block(&self, wanted: usize) -> Arc<Block> {
        let mut table = self.lock();
        if let Some((_, block)) = table.recent.iter().find(|(of, _)| *of == wanted) {
            return Arc::clone(block);
        }
        loop {
            let index = wanted.min(table.states.len() - 1);
            let (block, next) = self.run(table.states[index].clone());
            let block = Arc::new(block);
            if table.recent.len() >= KEPT_BLOCKS {
                table.recent.pop_front();
            }
            table.recent.push_back((index, Arc::clone(&block)));
            if index + 1 == table.states.len() {
                table.states.push(next);
            }
            if index == wanted {
                return block;
            }
        }
    }

    /// Returns the nodes before and after a time, and the elapsed fraction of the step.
    pub fn around(&self, slot: usize, time_s: f64) -> Option<(Node, Node, f64)> {
        let steps = (time_s.clamp(FIRST_S, LAST_S) - FIRST_S) / STEP_S;
        let whole = steps.floor();
        let (index, at) = (whole as usize / BLOCK_STEPS, whole as usize % BLOCK_STEPS);
        let block = self.block(index);
        let nodes = block.get(slot)?;
        Some((*nodes.get(at)?, *nodes.get(at + 1)?, steps - whole))
    }

    /// Number of blocks whose nodes are in memory.
    #[cfg(test)]
    pub fn kept_blocks(&self) -> usize {
        self.lock().recent.len()
    }
}
