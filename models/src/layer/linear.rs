//! Fully connected layer.

use candle_core::{CpuStorage, CustomOp3, Error, Layout, Result, Shape, Tensor};
use rayon::prelude::*;

use super::{KernelLevel, kernel, values, with_values};

const NAME: &str = "linear";

/// `input weight^T + bias`: `input` `[batch][i]`, `weight` `[o][i]`, `bias` `[o]`, result `[batch][o]`.
pub fn linear(input: &Tensor, weight: &Tensor, bias: &Tensor, level: KernelLevel) -> Result<Tensor> {
    input.apply_op3(weight, bias, Linear { level })
}

struct Linear {
    level: KernelLevel,
}

fn sizes(input: &[usize], weight: &[usize], bias: &[usize]) -> Result<(usize, usize, usize)> {
    match (input, weight, bias) {
        (&[batch, i], &[o, wi], &[bo]) if i == wi && o == bo && i > 0 && o > 0 => Ok((batch, i, o)),
        _ => Err(Error::Msg(format!(
            "{NAME}: expected input [batch, i], weight [o, i], bias [o]; got {input:?}, {weight:?}, {bias:?}"
        ))
        .bt()),
    }
}

impl CustomOp3 for Linear {
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
        let (batch, inputs, outputs) = sizes(input_layout.dims(), weight_layout.dims(), bias_layout.dims())?;
        let input = values(NAME, input, input_layout)?;
        let weight = values(NAME, weight, weight_layout)?;
        let bias = values(NAME, bias, bias_layout)?;
        let mut result = vec![0.0f32; batch * outputs];
        result.par_chunks_exact_mut(outputs).zip(input.par_chunks_exact(inputs)).for_each(|(row, x)| {
            for ((y, w), b) in row.iter_mut().zip(weight.chunks_exact(inputs)).zip(bias) {
                *y = b + kernel::dot(self.level, x, w);
            }
        });
        Ok((CpuStorage::F32(result), Shape::from((batch, outputs))))
    }

    fn bwd(
        &self,
        input: &Tensor,
        weight: &Tensor,
        bias: &Tensor,
        _result: &Tensor,
        gradient: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let (batch, inputs, outputs) = sizes(input.dims(), weight.dims(), bias.dims())?;
        let mut input_gradient = vec![0.0f32; batch * inputs];
        let mut weight_gradient = vec![0.0f32; outputs * inputs];
        let mut bias_gradient = vec![0.0f32; outputs];
        with_values(NAME, input, |x| {
            with_values(NAME, weight, |w| {
                with_values(NAME, gradient, |g| {
                    input_gradient.par_chunks_exact_mut(inputs).zip(g.par_chunks_exact(outputs)).for_each(|(dx, g)| {
                        for (&g, w) in g.iter().zip(w.chunks_exact(inputs)) {
                            kernel::axpy(self.level, dx, g, w);
                        }
                    });
                    // Each output sums over the batch in its order, whoever computes it.
                    weight_gradient
                        .par_chunks_exact_mut(inputs)
                        .zip(bias_gradient.par_iter_mut())
                        .enumerate()
                        .for_each(|(o, (dw, db))| {
                            for (x, g) in x.chunks_exact(inputs).zip(g.chunks_exact(outputs)) {
                                kernel::axpy(self.level, dw, g[o], x);
                                *db += g[o];
                            }
                        });
                    Ok(())
                })
            })
        })?;
        let device = input.device();
        Ok((
            Some(Tensor::from_vec(input_gradient, input.shape(), device)?),
            Some(Tensor::from_vec(weight_gradient, weight.shape(), device)?),
            Some(Tensor::from_vec(bias_gradient, bias.shape(), device)?),
        ))
    }
}
