//! The table of a simulated group's motion: steps at fixed times, made in blocks when they are first asked for, and what is
//! between two steps.
//!
//! The state at the beginning of each block is kept, and the nodes of the blocks that were asked for last: an hour takes little
//! memory, and every time gives the same answer in whatever order times are asked for.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use super::plan::State;
use super::setting::Setting;
use super::walker::{Limits, Pose, STEP_S};

/// Time of the first step, s: at 0 the group has been moving for a while.
pub(super) const FIRST_S: f64 = -20.0;
/// Nobody moves after this, s (46 days).
const LAST_S: f64 = 4e6;
/// Steps of a block: 32 s.
const BLOCK_STEPS: usize = 640;
/// Blocks whose nodes are kept.
const KEPT_BLOCKS: usize = 8;

/// A value and its rate.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Knot {
    /// Value.
    pub value: f64,
    /// Rate, 1/s.
    pub rate: f64,
}

impl Knot {
    /// Cubic through two knots that are a step apart, at a part of the step.
    pub fn between(self, next: Knot, part: f64) -> f64 {
        let (square, rest) = (part * part, 1.0 - part);
        let change = (next.value - self.value) * square * (3.0 - 2.0 * part);
        self.value + change + STEP_S * (self.rate * part * rest * rest - next.rate * square * rest)
    }
}

/// Motion of one person at the end of a step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Node {
    /// Place and motion on the ground plan.
    pub pose: Pose,
    /// Shoulder and elbow flexion beside those of the gait: `[side]`, rad.
    pub arms_rad: [[Knot; 2]; 2],
    /// Hips (forward, left) off the middle of the feet, m.
    pub shift_m: [Knot; 2],
    /// Part of the way down to a seat.
    pub down: f64,
    /// Index of the seat.
    pub seat: usize,
}

/// Motion on the ground plan between two steps.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Place {
    /// Place, m.
    pub position_m: [f64; 2],
    /// Speed along the heading, m/s.
    pub speed_m_per_s: f64,
    /// Heading, rad.
    pub heading_rad: f64,
    /// Rate of the heading, rad/s.
    pub turn_rad_per_s: f64,
    /// Cycles (two steps) made.
    pub phase: f64,
}

impl Place {
    /// Motion at a part of a step. Position, velocity and acceleration are continuous from step to step.
    pub fn between(a: &Pose, b: &Pose, part: f64, limits: &Limits) -> Place {
        let (first, last) = (a.velocity_m_per_s(), b.velocity_m_per_s());
        let (bend, next_bend) = (a.ground_acceleration_m_per_s2(), b.ground_acceleration_m_per_s2());
        let position_m = [0, 1].map(|i| {
            // Quintic through place, velocity and acceleration at both ends.
            let (velocity, half) = (first[i] * STEP_S, 0.5 * bend[i] * STEP_S * STEP_S);
            let d = b.position_m[i] - a.position_m[i] - velocity - half;
            let e = last[i] * STEP_S - velocity - 2.0 * half;
            let f = next_bend[i] * STEP_S * STEP_S - 2.0 * half;
            let third = 10.0 * d - 4.0 * e + 0.5 * f;
            let fourth = -15.0 * d + 7.0 * e - f;
            let fifth = 6.0 * d - 3.0 * e + 0.5 * f;
            a.position_m[i] + part * (velocity + part * (half + part * (third + part * (fourth + part * fifth))))
        });
        let knot = |value: f64, rate: f64| Knot { value, rate };
        let speed = |p: &Pose| knot(p.speed_m_per_s, p.acceleration_m_per_s2);
        let heading = |p: &Pose| knot(p.heading_rad, p.turn_rad_per_s);
        let phase = |p: &Pose| knot(p.phase, limits.cycles_per_s(p.speed_m_per_s, p.turn_rad_per_s));
        Place {
            position_m,
            speed_m_per_s: speed(a).between(speed(b), part).max(0.0),
            heading_rad: heading(a).between(heading(b), part),
            turn_rad_per_s: a.turn_rad_per_s + part * (b.turn_rad_per_s - a.turn_rad_per_s),
            phase: phase(a).between(phase(b), part),
        }
    }
}

/// Consecutive steps of everybody: `[slot][step]`, the last one also being the next block's first.
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
    /// State at the beginning of each block that was made, and at the end of the last one.
    states: Vec<State>,
    recent: VecDeque<(usize, Arc<Block>)>,
}

impl Group {
    /// Creates as many people in a setting.
    pub fn new(setting: Setting, slots: usize) -> Self {
        let states = vec![State::new(&setting, slots)];
        Group { setting, table: Mutex::new(Table { states, recent: VecDeque::new() }) }
    }

    /// The setting.
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

    /// Makes the next block.
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

    /// The nodes before and after a time, and the part of the step that has passed.
    pub fn around(&self, slot: usize, time_s: f64) -> Option<(Node, Node, f64)> {
        let steps = (time_s.clamp(FIRST_S, LAST_S) - FIRST_S) / STEP_S;
        let whole = steps.floor();
        let (index, at) = (whole as usize / BLOCK_STEPS, whole as usize % BLOCK_STEPS);
        let block = self.block(index);
        let nodes = block.nodes.get(slot)?;
        Some((*nodes.get(at)?, *nodes.get(at + 1)?, steps - whole))
    }

    /// Blocks whose nodes are in memory.
    #[cfg(test)]
    pub fn kept_blocks(&self) -> usize {
        self.lock().recent.len()
    }
}
