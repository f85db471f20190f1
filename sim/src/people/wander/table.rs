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
/// Number of blocks whose nodes are kept.
const KEPT_BLOCKS: usize = 8;

/// Consecutive steps of all people: `[slot][step]`. The last step is also the first of the next block.
#[derive(Debug)]
struct Block {
    nodes: Vec<Vec<Node>>,
}

/// A group of people whose motion is known at any time.
#[derive(Debug)]
pub(super) struct Group {
    setting: Setting,
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

    /// Setting of the group.
    pub fn setting(&self) -> &Setting {
        &self.setting
    }

    fn lock(&self) -> MutexGuard<'_, Table> {
        self.table.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn run(&self, mut state: State) -> (Block, State) {
        let mut nodes: Vec<Vec<Node>> = state
            .nodes()
            .map(|node| {
                let mut all = Vec::with_capacity(BLOCK_STEPS + 1);
                all.push(node);
                all
            })
            .collect();
        for _ in 0..BLOCK_STEPS {
            state.step(&self.setting);
            nodes.iter_mut().zip(state.nodes()).for_each(|(all, node)| all.push(node));
        }
        (Block { nodes }, state)
    }

    fn keep(table: &mut Table, index: usize, block: &Arc<Block>) {
        if table.recent.len() >= KEPT_BLOCKS {
            table.recent.pop_front();
        }
        table.recent.push_back((index, Arc::clone(block)));
    }

    /// Computes the next block.
    fn extend(&self, table: &mut Table) {
        let Some(state) = table.states.last().cloned() else { return };
        let index = table.states.len() - 1;
        let (block, next) = self.run(state);
        Self::keep(table, index, &Arc::new(block));
        table.states.push(next);
    }

    fn block(&self, index: usize) -> Arc<Block> {
        let mut table = self.lock();
        while table.states.len() < index + 2 {
            self.extend(&mut table);
        }
        if let Some((_, block)) = table.recent.iter().find(|(of, _)| *of == index) {
            return Arc::clone(block);
        }
        let state = table.states[index].clone();
        let (block, _) = self.run(state);
        let block = Arc::new(block);
        Self::keep(&mut table, index, &block);
        block
    }

    /// Returns the nodes before and after a time, and the elapsed fraction of the step.
    pub fn around(&self, slot: usize, time_s: f64) -> Option<(Node, Node, f64)> {
        let steps = (time_s.clamp(FIRST_S, LAST_S) - FIRST_S) / STEP_S;
        let whole = steps.floor();
        let (index, at) = (whole as usize / BLOCK_STEPS, whole as usize % BLOCK_STEPS);
        let block = self.block(index);
        let nodes = block.nodes.get(slot)?;
        Some((*nodes.get(at)?, *nodes.get(at + 1)?, steps - whole))
    }

    /// Number of blocks whose nodes are in memory.
    #[cfg(test)]
    pub fn kept_blocks(&self) -> usize {
        self.lock().recent.len()
    }
}
