//! The fused block of [`super::conv_relu_pool()`] prepared once and run often, without gradients.
//!
//! A map is cut into strips of rows, so that several threads share one map. A strip is copied with its border into a little
//! scratch, where the three taps of a kernel's row are contiguous, and whole pooling windows are summed in one tile. Every cell
//! is summed in the same order whoever does it.

use std::cell::RefCell;

use candle_core::{Error, Result};
use rayon::prelude::*;

use super::kernel::{Block, LANES};
use super::level::{dispatch, multiply_add};
use super::packed::{Packed, Side};
use super::tile::{RowTile, Tiles};
use super::{Affine, Feature, KernelLevel};

/// Values that a strip's input is cut to: it stays near the processor, and little of it is copied twice.
const STRIP: usize = 1 << 14;
/// Pooled rows of a strip at most.
const MOST_ROWS: usize = 8;
/// Rows of a tile of sums and values in each at most, at any kernel level.
const MOST_SUMS: usize = 16 * WIDTH;
const WIDTH: usize = 32;

/// `max_pool2(relu((conv3x3(input) + bias) * scale + shift))`, padded by 1.
pub struct PreparedBlock {
    inputs: usize,
    outputs: usize,
    weight: Packed,
    /// What sums start from, padded to the tiles and to lanes.
    start: Vec<f32>,
    /// Weights of a single input channel `[output / 16][row][column][output % 16]`; empty where there are more.
    single: Vec<f32>,
    level: KernelLevel,
}

#[derive(Default)]
struct Scratch {
    padded: Vec<f32>,
    /// Addresses of the operands, `[tile][kernel row][cell of the tile]`.
    cells: Vec<*const f32>,
}

thread_local! {
    static SCRATCH: RefCell<Scratch> = RefCell::default();
}

impl PreparedBlock {
    /// Prepares weights `[o][i][3][3]`, `shape` `[o, i]`.
    pub fn new(
        weight: &[f32],
        shape: [usize; 2],
        bias: Option<&[f32]>,
        affine: Option<Affine<'_>>,
        level: KernelLevel,
    ) -> Result<Self> {
        let [outputs, inputs] = shape;
        let lengths = [bias.map(<[f32]>::len), affine.map(|a| a.scale.len()), affine.map(|a| a.shift.len())];
        if weight.is_empty() || weight.len() != outputs * inputs * 9 || lengths.iter().flatten().any(|&l| l != outputs)
        {
            return Err(Error::Msg(format!(
                "prepared block: expected weight [o, i, 3, 3] and o values of bias, scale and shift; got {} values for \
                 {shape:?}, {lengths:?}",
                weight.len()
            ))
            .bt());
        }
        let scale = |o: usize| affine.map_or(1.0, |a| a.scale[o]);
        let folded: Vec<f32> = weight.iter().enumerate().map(|(k, w)| w * scale(k / (9 * inputs))).collect();
        let start: Vec<f32> =
            (0..outputs).map(|o| bias.map_or(0.0, |b| b[o]) * scale(o) + affine.map_or(0.0, |a| a.shift[o])).collect();
        let tiles = Tiles::new(level);
        let weight = Packed::new(&folded, [outputs, inputs, 9], Side::Forward, tiles);
        let mut start = weight.pad(&start);
        start.resize(start.len().next_multiple_of(LANES), 0.0);
        let block = Block { rows: 0, columns: 0, inputs, outputs };
        let single = if inputs == 1 { block.pack(&folded) } else { Vec::new() };
        Ok(PreparedBlock { inputs, outputs, weight, start, single, level: level.available() })
    }

    /// `input` `[batch][row][column][i]`; `output` becomes `[batch][row / 2][column / 2][o]` and keeps its memory.
    pub fn run(&self, input: &Feature, output: &mut Feature) -> Result<()> {
        let [batch, rows, columns, inputs] = input.dims();
        if inputs != self.inputs || rows < 2 || columns < 2 {
            return Err(Error::Msg(format!(
                "prepared block: expected input [batch, rows >= 2, columns >= 2, {}], got {:?}",
                self.inputs,
                input.dims()
            ))
            .bt());
        }
        let [pooled_rows, pooled_columns] = [rows / 2, columns / 2];
        output.reshape([batch, pooled_rows, pooled_columns, self.outputs]);
        let line = (columns + 2) * inputs;
        let strip_rows = ((STRIP / line).saturating_sub(2) / 2).clamp(1, MOST_ROWS);
        let row = pooled_columns * self.outputs;
        output
            .values_mut()
            .par_chunks_exact_mut(pooled_rows * row)
            .zip(input.values().par_chunks_exact(rows * columns * inputs))
            .for_each(|(output, input)| {
                output.par_chunks_mut(strip_rows * row).enumerate().for_each(|(strip, output)| {
                    SCRATCH.with_borrow_mut(|scratch| {
                        pad(input, columns * inputs, inputs, 2 * strip * strip_rows, 2 * output.len() / row, scratch);
                        if self.inputs == 1 {
                            let (padded, start) = (&scratch.padded, &self.start);
                            single(self.level, padded, pooled_columns, &self.single, start, self.outputs, line, output);
                        } else {
                            self.strip(scratch, line, pooled_columns, output);
                        }
                    });
                });
            });
        Ok(())
    }

    /// The pooled rows of a padded strip.
    fn strip(&self, scratch: &mut Scratch, line: usize, pooled_columns: usize, output: &mut [f32]) {
        let Scratch { padded, cells } = scratch;
        let tiles = self.weight.tiles;
        let windows = output.len() / self.outputs;
        let per_tile = (tiles.rows / 4).max(1);
        // The last cell of the last window's last tap ends where the strip does, or before.
        assert!(
            padded.len() >= (2 * windows / pooled_columns + 2) * line && 2 * pooled_columns + 2 <= line / self.inputs
        );
        cells.clear();
        for first in (0..windows).step_by(per_tile) {
            let of_tile = first..windows.min(first + per_tile);
            for kernel_row in 0..3 {
                for window in of_tile.clone() {
                    let row = 2 * (window / pooled_columns) + kernel_row;
                    let corner = row * line + 2 * (window % pooled_columns) * self.inputs;
                    // SAFETY: checked above.
                    let at = |from: usize| unsafe { padded.as_ptr().add(from) };
                    let below = corner + line;
                    cells.extend([at(corner), at(corner + self.inputs), at(below), at(below + self.inputs)]);
                }
            }
        }
        let mut sums = [0.0f32; MOST_SUMS];
        debug_assert!(4 * per_tile * tiles.width() <= MOST_SUMS && tiles.width() <= WIDTH);
        for panel in 0..self.weight.panels() {
            let column = panel * tiles.width();
            let columns = tiles.width().min(self.outputs - column);
            for first in (0..windows).step_by(per_tile) {
                let count = per_tile.min(windows - first);
                let mut targets = [std::ptr::null_mut(); MOST_SUMS / WIDTH];
                for (target, row) in targets.iter_mut().zip(sums.chunks_exact_mut(WIDTH)) {
                    *target = row.as_mut_ptr();
                }
                let tile = RowTile {
                    cells: cells[12 * first..].as_ptr(),
                    cell_stride: 4 * count,
                    taps: [0u32, 1, 2].as_ptr(),
                    tap_count: 3,
                    channels: 3 * self.inputs,
                    panel: self.weight.values[column * self.weight.depth..].as_ptr(),
                    start: self.start[column..].as_ptr(),
                    targets: targets.as_ptr(),
                    first: 0,
                    columns,
                };
                // SAFETY: every address is of three cells of the strip, as checked above; panel and start are padded
                // to the tile's width; targets are rows of `sums`, each as wide as the widest tile.
                unsafe { tiles.row_tile(4 * count, &tile) };
                let output = &mut output[first * self.outputs..(first + count) * self.outputs];
                pool(self.level, &sums, columns, self.outputs, column, output);
            }
        }
    }
}

/// Copies `rows` rows from row `first` on, and one more on each side, with a cell of zeros at both ends of each.
fn pad(input: &[f32], row: usize, inputs: usize, first: usize, rows: usize, scratch: &mut Scratch) {
    let line = row + 2 * inputs;
    scratch.padded.resize((rows + 2) * line, 0.0);
    for (k, target) in scratch.padded.chunks_exact_mut(line).enumerate() {
        let source = (first + k).checked_sub(1).and_then(|from| input.get(from * row..(from + 1) * row));
        match source {
            Some(source) => {
                target[..inputs].fill(0.0);
                target[inputs..inputs + row].copy_from_slice(source);
                target[inputs + row..].fill(0.0);
            }
            None => target.fill(0.0),
        }
    }
}

dispatch! {
    /// Largest of four rows of sums, or zero, for each window: `columns` of the output's `outputs` from `first` on. A NaN stays
    /// where it would in training.
    fn pool(sums: &[f32; MOST_SUMS], columns: usize, outputs: usize, first: usize, output: &mut [f32]) = pool_generic
}

#[inline(always)]
fn pool_generic<const FUSED: bool>(
    sums: &[f32; MOST_SUMS],
    columns: usize,
    outputs: usize,
    first: usize,
    output: &mut [f32],
) {
    let windows = sums.as_chunks::<{ 4 * WIDTH }>().0;
    for (window, output) in windows.iter().zip(output.chunks_exact_mut(outputs)) {
        let output = &mut output[first..first + columns];
        let mut all = [0.0; WIDTH];
        for lane in 0..WIDTH {
            let mut best = window[lane];
            for candidate in 1..4 {
                let value = window[candidate * WIDTH + lane];
                best = if value > best { value } else { best };
            }
            all[lane] = if best <= 0.0 { 0.0 } else { best };
        }
        output.copy_from_slice(&all[..columns]);
    }
}

dispatch! {
    /// The pooled rows of a padded strip of a single channel, whose every cell is read once for a window.
    fn single(
        padded: &[f32], pooled_columns: usize, weight: &[f32], start: &[f32], outputs: usize, line: usize, output: &mut [f32]
    ) = single_generic
}

#[inline(always)]
fn single_generic<const FUSED: bool>(
    padded: &[f32],
    pooled_columns: usize,
    weight: &[f32],
    start: &[f32],
    outputs: usize,
    line: usize,
    output: &mut [f32],
) {
    let groups = weight.as_chunks::<LANES>().0.as_chunks::<9>().0.iter().zip(start.as_chunks::<LANES>().0);
    for (group, (weight, start)) in groups.enumerate() {
        let lanes = LANES.min(outputs - group * LANES);
        for (row, output) in output.chunks_exact_mut(pooled_columns * outputs).enumerate() {
            let lines: [&[f32]; 4] = std::array::from_fn(|k| &padded[(2 * row + k) * line..][..2 * pooled_columns + 2]);
            for (column, output) in output.chunks_exact_mut(outputs).enumerate() {
                let patch: [&[f32; 4]; 4] = lines.map(|line| line[2 * column..].first_chunk().unwrap_or(&[0.0; 4]));
                let mut sums = [*start; 4];
                for (tap, weight) in weight.iter().enumerate() {
                    for (cell, sum) in sums.iter_mut().enumerate() {
                        let value = patch[cell / 2 + tap / 3][cell % 2 + tap % 3];
                        for lane in 0..LANES {
                            sum[lane] = multiply_add::<FUSED>(value, weight[lane], sum[lane]);
                        }
                    }
                }
                let mut best = [0.0f32; LANES];
                for lane in 0..LANES {
                    let mut largest = sums[0][lane];
                    for sum in &sums[1..] {
                        largest = if sum[lane] > largest { sum[lane] } else { largest };
                    }
                    best[lane] = if largest <= 0.0 { 0.0 } else { largest };
                }
                let output = &mut output[group * LANES..];
                match output.first_chunk_mut::<LANES>() {
                    Some(output) => *output = best,
                    None => output[..lanes].copy_from_slice(&best[..lanes]),
                }
            }
        }
    }
}
