//! 3x3 convolution with padding 1, ReLU and 2x2 max-pooling as one operation.

use std::sync::OnceLock;

use candle_core::{Result, Shape, Tensor, bail};
use rayon::prelude::*;

use super::operation::{Argument, Gradients, InputGradient, Operation, apply};
use crate::kernel::KernelLevel;
use crate::kernel::conv_pool::{self, Block};

const NAME: &str = "conv_relu_pool";
/// Batches below this size are divided into bands of rows, so that all threads have work.
const FEW_SAMPLES: usize = 8;
/// Rows of the pooled output in a band.
const BAND: usize = 8;

/// `max_pool2(relu(conv3x3(input) + bias))`.
///
/// `input` is `[batch][row][column][input channel]`, `weight` `[output][input][3][3]`, `bias` `[output]`; the result is
/// `[batch][row / 2][column / 2][output]`. An odd last row or column feeds the convolution but is not pooled.
///
/// # Errors
/// Shapes differ from those above, the input has fewer than two rows or columns, or a tensor is not f32 on the CPU.
pub fn conv_relu_pool(
    input: &Tensor,
    weight: &Tensor,
    bias: &Tensor,
    input_gradient: InputGradient,
    level: KernelLevel,
) -> Result<Tensor> {
    apply(NAME, &[input, weight, bias], ConvReluPool { input_gradient, level, winner: OnceLock::new() })
}

struct ConvReluPool {
    input_gradient: InputGradient,
    level: KernelLevel,
    /// Index of the largest cell of each pooling window in the forward pass, for the backward pass.
    winner: OnceLock<Vec<u8>>,
}

/// Checks the shapes. Returns the batch size and the sizes of a sample.
fn sizes(inputs: &[Argument<'_>]) -> Result<(usize, Block)> {
    let dims: Vec<_> = inputs.iter().map(|a| a.dims).collect();
    match dims[..] {
        [&[batch, rows, columns, inputs], &[outputs, i, 3, 3], &[o]]
            if i == inputs && o == outputs && rows >= 2 && columns >= 2 && inputs > 0 && outputs > 0 =>
        {
            Ok((batch, Block { rows, columns, inputs, outputs }))
        }
        _ => bail!(
            "{NAME}: expected input [batch, rows >= 2, columns >= 2, i], weight [o, i, 3, 3], bias [o]; got {dims:?}"
        ),
    }
}

impl Operation for ConvReluPool {
    fn forward(&self, inputs: &[Argument<'_>]) -> Result<(Vec<f32>, Shape)> {
        let (batch, block) = sizes(inputs)?;
        let [input, weight, bias] = inputs else { bail!("{NAME}: expected three inputs") };
        let (input, packed, bias) = (input.values, block.pack(weight.values), bias.values);
        let mut pooled = vec![0.0f32; batch * block.pooled_length()];
        let mut winner = vec![0u8; pooled.len()];
        let sample = block.rows * block.columns * block.inputs;
        pooled
            .par_chunks_exact_mut(block.pooled_length())
            .zip(winner.par_chunks_exact_mut(block.pooled_length()))
            .zip(input.par_chunks_exact(sample))
            .for_each_init(
                || vec![0.0; block.padded_length()],
                |padded, ((pooled, winner), input)| {
                    block.pad(input, padded);
                    if batch >= FEW_SAMPLES {
                        conv_pool::forward(self.level, block, padded, &packed, bias, pooled, winner);
                        return;
                    }
                    // A band of rows is a separate block. Its cells are the same sums as in the whole map.
                    let pooled_line = block.columns / 2 * block.outputs;
                    let line = (block.columns + 2) * block.inputs;
                    let bands =
                        pooled.par_chunks_mut(BAND * pooled_line).zip(winner.par_chunks_mut(BAND * pooled_line));
                    bands.enumerate().for_each(|(band, (pooled, winner))| {
                        let rows = 2 * (pooled.len() / pooled_line);
                        let padded = &padded[2 * BAND * band * line..][..(rows + 2) * line];
                        let block = Block { rows, ..block };
                        conv_pool::forward(self.level, block, padded, &packed, bias, pooled, winner);
                    });
                },
            );
        // Set once, because candle makes an operation for each application.
        let _ = self.winner.set(winner);
        Ok((pooled, Shape::from((batch, block.rows / 2, block.columns / 2, block.outputs))))
    }

    fn backward(&self, inputs: &[Argument<'_>], _output: &[f32], gradient: Vec<f32>) -> Result<Gradients> {
        let (_, block) = sizes(inputs)?;
        let [input, weight, _] = inputs else { bail!("{NAME}: expected three inputs") };
        let Some(winner) = self.winner.get() else {
            bail!("{NAME}: backward pass without a forward pass");
        };
        let (input_values, weight) = (input.values, weight.values);
        let sample = block.rows * block.columns * block.inputs;
        let needs_input_gradient = self.input_gradient == InputGradient::Needed;
        let mut input_gradient = vec![0.0f32; if needs_input_gradient { input_values.len() } else { 0 }];
        let weight = block.to_channel_last(weight);
        // Each sample has partial gradients, which are added below in the order of the samples.
        let sample_gradients = |scratch: &mut Scratch, index: usize, input_gradient: &mut [f32]| {
            let pooled = index * block.pooled_length()..(index + 1) * block.pooled_length();
            block.pad(&input_values[index * sample..(index + 1) * sample], &mut scratch.padded);
            let mut weights = vec![0.0f32; weight.len()];
            let mut biases = vec![0.0f32; block.outputs];
            scratch.gradient.fill(0.0);
            conv_pool::backward(
                self.level,
                block,
                &scratch.padded,
                &weight,
                &winner[pooled.clone()],
                &gradient[pooled],
                &mut weights,
                &mut biases,
                &mut scratch.gradient,
            );
            if needs_input_gradient {
                block.crop(&scratch.gradient, input_gradient);
            }
            (weights, biases)
        };
        let scratch = || Scratch {
            padded: vec![0.0; block.padded_length()],
            gradient: vec![0.0; if needs_input_gradient { block.padded_length() } else { 0 }],
        };
        let batch = input_values.len() / sample;
        let partials: Vec<(Vec<f32>, Vec<f32>)> = if needs_input_gradient {
            input_gradient
                .par_chunks_exact_mut(sample)
                .enumerate()
                .map_init(scratch, |s, (index, gradient)| sample_gradients(s, index, gradient))
                .collect()
        } else {
            (0..batch).into_par_iter().map_init(scratch, |s, index| sample_gradients(s, index, &mut [])).collect()
        };
        let mut weights = vec![0.0f32; weight.len()];
        let mut biases = vec![0.0f32; block.outputs];
        for (partial_weights, partial_biases) in &partials {
            weights.iter_mut().zip(partial_weights).for_each(|(sum, part)| *sum += part);
            biases.iter_mut().zip(partial_biases).for_each(|(sum, part)| *sum += part);
        }
        Ok(vec![needs_input_gradient.then_some(input_gradient), Some(block.to_channel_first(&weights)), Some(biases)])
    }
}

struct Scratch {
    padded: Vec<f32>,
    gradient: Vec<f32>,
}
