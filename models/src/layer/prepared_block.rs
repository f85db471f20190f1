//! Fused block of [`super::conv_relu_pool()`], prepared for inference, without gradients.
//!
//! Several threads work on one map. Every cell is summed in the same order on any thread.

use std::cell::RefCell;

use candle_core::{Result, bail};

use super::feature::{Affine, Feature, fold_affine};
use crate::kernel::KernelLevel;
use crate::kernel::conv_pool::{Block, LANES};
use crate::kernel::level::{for_each_level, multiply_add};
use crate::kernel::spin_pool::for_each_chunk;
use crate::kernel::tile::Tiles;
use crate::kernel::winograd::{Epilogue, Winograd};

/// Pooled rows of one task for an input of a single channel.
const STRIP_ROWS: usize = 2;

/// `max_pool2(relu((conv3x3(input) + bias) * scale + shift))`, padded by 1.
pub struct PreparedBlock {
    inputs: usize,
    outputs: usize,
    weight: Weight,
    level: KernelLevel,
}

enum Weight {
    /// Weights for a single input channel, `[output / 16][row][column][output % 16]`, and accumulator init, padded to the same
    /// number of outputs.
    SingleChannel(Vec<f32>, Vec<f32>),
    Winograd(Winograd),
}

thread_local! {
    /// Four input rows with their border of zeros.
    static PADDED: RefCell<Vec<f32>> = RefCell::default();
}

impl PreparedBlock {
    /// Prepares weights `[o][i][3][3]`, `shape` `[o, i]`.
    ///
    /// # Errors
    /// A number of values differs from what `shape` asks for, or there are no weights.
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
            bail!(
                "prepared block: expected weight [o, i, 3, 3] and o values of bias, scale and shift; got {} values for \
                 {shape:?}, {lengths:?}",
                weight.len()
            );
        }
        let (folded_weight, mut init) = fold_affine(weight, outputs, bias, affine);
        let weight = if inputs == 1 {
            init.resize(outputs.next_multiple_of(LANES), 0.0);
            let packed = Block { rows: 0, columns: 0, inputs, outputs }.pack(&folded_weight);
            Weight::SingleChannel(packed, init)
        } else {
            Weight::Winograd(Winograd::new(&folded_weight, shape, &init, Tiles::new(level)))
        };
        Ok(PreparedBlock { inputs, outputs, weight, level: level.available() })
    }

    /// Runs the block on `input` `[batch][row][column][i]`. `output` becomes `[batch][row / 2][column / 2][o]` and
    /// keeps its memory.
    ///
    /// # Errors
    /// The input has another number of channels, or fewer than two rows or columns.
    pub fn run(&self, input: &Feature, output: &mut Feature) -> Result<()> {
        let [batch, rows, columns, inputs] = input.dims();
        if inputs != self.inputs || rows < 2 || columns < 2 {
            bail!(
                "prepared block: expected input [batch, rows >= 2, columns >= 2, {}], got {:?}",
                self.inputs,
                input.dims()
            );
        }
        let [pooled_rows, pooled_columns] = [rows / 2, columns / 2];
        output.reshape([batch, pooled_rows, pooled_columns, self.outputs]);
        match &self.weight {
            Weight::Winograd(winograd) => {
                winograd.run(input.values(), [batch, rows, columns], Epilogue::Pool, output.values_mut());
            }
            Weight::SingleChannel(weight, init) => {
                let row_length = pooled_columns * self.outputs;
                for_each_chunk(output.values_mut(), STRIP_ROWS * row_length, |strip, output| {
                    PADDED.with_borrow_mut(|padded| {
                        for (k, output) in output.chunks_exact_mut(row_length).enumerate() {
                            let (map, row) =
                                ((strip * STRIP_ROWS + k) / pooled_rows, (strip * STRIP_ROWS + k) % pooled_rows);
                            let map = &input.values()[map * rows * columns..][..rows * columns];
                            pad_rows(map, columns, 2 * row, padded);
                            pooled_row(self.level, padded, weight, init, self.outputs, output);
                        }
                    });
                });
            }
        }
        Ok(())
    }
}

/// Copies the four rows from row `first - 1` on, with a zero at both ends of each. Rows outside of the map are zero.
fn pad_rows(input: &[f32], columns: usize, first: usize, padded: &mut Vec<f32>) {
    padded.resize(4 * (columns + 2), 0.0);
    for (k, target) in padded.chunks_exact_mut(columns + 2).enumerate() {
        match (first + k).checked_sub(1).and_then(|row| input.get(row * columns..(row + 1) * columns)) {
            Some(source) => {
                target[0] = 0.0;
                target[1..=columns].copy_from_slice(source);
                target[columns + 1] = 0.0;
            }
            None => target.fill(0.0),
        }
    }
}

for_each_level! {
    /// Computes a pooled row from four padded rows of a single channel.
    fn pooled_row(padded: &[f32], weight: &[f32], init: &[f32], outputs: usize, output: &mut [f32]) {
        let line = padded.len() / 4;
        let lines: [&[f32]; 4] = std::array::from_fn(|k| &padded[k * line..(k + 1) * line]);
        let groups = weight.as_chunks::<LANES>().0.as_chunks::<9>().0.iter().zip(init.as_chunks::<LANES>().0);
        for (group, (weight, init)) in groups.enumerate() {
            let lanes = LANES.min(outputs - group * LANES);
            for (column, output) in output.chunks_exact_mut(outputs).enumerate() {
                let patch: [&[f32; 4]; 4] = lines.map(|line| line[2 * column..].first_chunk().unwrap_or(&[0.0; 4]));
                let mut sums = [*init; 4];
                for (offset, weight) in weight.iter().enumerate() {
                    for (cell, sum) in sums.iter_mut().enumerate() {
                        let value = patch[cell / 2 + offset / 3][cell % 2 + offset % 3];
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
