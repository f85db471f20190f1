//! 3x3 convolution with padding 1, ReLU and 2x2 max-pooling as one op.

use std::sync::OnceLock;

use candle_core::{CpuStorage, CustomOp3, Error, Layout, Result, Shape, Tensor};
use rayon::prelude::*;

use super::{
    KernelLevel,
    kernel::{self, Block},
    values, with_values,
};

const NAME: &str = "conv_relu_pool";

/// Whether the backward pass computes the gradient of a layer's input.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum InputGradient {
    /// The input comes from another layer.
    Needed,
    /// The input is data.
    Unused,
}

/// `max_pool2(relu(conv3x3(input) + bias))`.
///
/// `input` is `[batch][row][column][input channel]`, `weight` `[output][input][3][3]`, `bias` `[output]`; the result is
/// `[batch][row / 2][column / 2][output]`. An odd last row or column feeds the convolution but is not pooled.
pub fn conv_relu_pool(
    input: &Tensor,
    weight: &Tensor,
    bias: &Tensor,
    input_gradient: InputGradient,
    level: KernelLevel,
) -> Result<Tensor> {
    input.apply_op3(weight, bias, ConvReluPool { input_gradient, level, winner: OnceLock::new() })
}

struct ConvReluPool {
    input_gradient: InputGradient,
    level: KernelLevel,
    /// Which cell of each pooling window won in the forward pass: all that the backward pass needs of it.
    winner: OnceLock<Vec<u8>>,
}

fn geometry(input: &[usize], weight: &[usize], bias: &[usize]) -> Result<(usize, Block)> {
    match (input, weight, bias) {
        (&[batch, rows, columns, inputs], &[outputs, i, 3, 3], &[o])
            if i == inputs && o == outputs && rows >= 2 && columns >= 2 && inputs > 0 && outputs > 0 =>
        {
            Ok((batch, Block { rows, columns, inputs, outputs }))
        }
        _ => Err(Error::Msg(format!(
            "{NAME}: expected input [batch, rows >= 2, columns >= 2, i], weight [o, i, 3, 3], bias [o]; \
             got {input:?}, {weight:?}, {bias:?}"
        ))
        .bt()),
    }
}

impl CustomOp3 for ConvReluPool {
    fn name(&self) -> &'static str {
        NAME
    }

    fn cpu_fwd(
        &self,
        input: &CpuStorage,
        input_layout: &Layout,
        weight: &CpuStorage,
        weight_layout: &Layout,
        bias: &CpuStorage,
        bias_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (batch, block) = geometry(input_layout.dims(), weight_layout.dims(), bias_layout.dims())?;
        let input = values(NAME, input, input_layout)?;
        let packed = block.pack(values(NAME, weight, weight_layout)?);
        let bias = values(NAME, bias, bias_layout)?;
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
                    kernel::forward(self.level, block, padded, &packed, bias, pooled, winner);
                },
            );
        // Set once per op: candle makes one op for each application.
        let _ = self.winner.set(winner);
        Ok((CpuStorage::F32(pooled), Shape::from((batch, block.rows / 2, block.columns / 2, block.outputs))))
    }

    fn bwd(
        &self,
        input: &Tensor,
        weight: &Tensor,
        bias: &Tensor,
        _result: &Tensor,
        gradient: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let (_, block) = geometry(input.dims(), weight.dims(), bias.dims())?;
        let Some(winner) = self.winner.get() else {
            candle_core::bail!("{NAME}: backward pass without a forward pass");
        };
        let sample = block.rows * block.columns * block.inputs;
        let wanted = self.input_gradient == InputGradient::Needed;
        let mut input_gradient = vec![0.0f32; if wanted { input.elem_count() } else { 0 }];
        let (weight_gradient, bias_gradient) = with_values(NAME, input, |input_values| {
            with_values(NAME, weight, |weight| {
                with_values(NAME, gradient, |gradient| {
                    let weight = block.to_channel_last(weight);
                    // One partial gradient for each sample, added up below in the order of the samples.
                    let job = |scratch: &mut Scratch, index: usize, input_gradient: &mut [f32]| {
                        let pooled = index * block.pooled_length()..(index + 1) * block.pooled_length();
                        block.pad(&input_values[index * sample..(index + 1) * sample], &mut scratch.padded);
                        let mut weights = vec![0.0f32; weight.len()];
                        let mut biases = vec![0.0f32; block.outputs];
                        scratch.gradient.fill(0.0);
                        kernel::backward(
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
                        if wanted {
                            block.crop(&scratch.gradient, input_gradient);
                        }
                        (weights, biases)
                    };
                    let scratch = || Scratch {
                        padded: vec![0.0; block.padded_length()],
                        gradient: vec![0.0; if wanted { block.padded_length() } else { 0 }],
                    };
                    let batch = input_values.len() / sample;
                    let partials: Vec<(Vec<f32>, Vec<f32>)> = if wanted {
                        input_gradient
                            .par_chunks_exact_mut(sample)
                            .enumerate()
                            .map_init(scratch, |s, (index, gradient)| job(s, index, gradient))
                            .collect()
                    } else {
                        (0..batch).into_par_iter().map_init(scratch, |s, index| job(s, index, &mut [])).collect()
                    };
                    let mut weights = vec![0.0f32; weight.len()];
                    let mut biases = vec![0.0f32; block.outputs];
                    for (partial_weights, partial_biases) in &partials {
                        kernel::axpy(self.level, &mut weights, 1.0, partial_weights);
                        kernel::axpy(self.level, &mut biases, 1.0, partial_biases);
                    }
                    Ok((block.to_channel_first(&weights), biases))
                })
            })
        })?;
        let device = input.device();
        let input_gradient = if wanted { Some(Tensor::from_vec(input_gradient, input.shape(), device)?) } else { None };
        Ok((
            input_gradient,
            Some(Tensor::from_vec(weight_gradient, weight.shape(), device)?),
            Some(Tensor::from_vec(bias_gradient, bias.shape(), device)?),
        ))
    }
}

struct Scratch {
    padded: Vec<f32>,
    gradient: Vec<f32>,
}
