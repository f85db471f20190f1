//! Fully connected layer.

use candle_core::{Result, Shape, Tensor, bail};

use super::operation::{Argument, Gradients, Operation, apply};
use crate::kernel::KernelLevel;
use crate::kernel::buffer::uninitialised;
use crate::kernel::implicit_gemm::ImplicitGemm;
use crate::kernel::packed::{Packed, Side};
use crate::kernel::tile::Tiles;
use crate::kernel::weight_gradient::{column_sums, weight_gradient};

const NAME: &str = "linear";

/// `input weight^T + bias`: `input` `[batch][i]`, `weight` `[o][i]`, `bias` `[o]`, result `[batch][o]`.
///
/// # Errors
/// Shapes differ from those above, or a tensor is not f32 on the CPU.
pub fn linear(input: &Tensor, weight: &Tensor, bias: &Tensor, level: KernelLevel) -> Result<Tensor> {
    apply(NAME, &[input, weight, bias], Linear { tiles: Tiles::new(level) })
}

struct Linear {
    tiles: Tiles,
}

fn sizes(inputs: &[Argument<'_>]) -> Result<[usize; 3]> {
    let dims: Vec<_> = inputs.iter().map(|a| a.dims).collect();
    match dims[..] {
        [&[batch, i], &[o, wi], &[bo]] if i == wi && o == bo && i > 0 && o > 0 => Ok([batch, i, o]),
        _ => bail!("{NAME}: expected input [batch, i], weight [o, i], bias [o]; got {dims:?}"),
    }
}

impl Operation for Linear {
    fn forward(&self, inputs: &[Argument<'_>]) -> Result<(Vec<f32>, Shape)> {
        let [batch, i, o] = sizes(inputs)?;
        let [input, weight, bias] = inputs else { bail!("{NAME}: expected three inputs") };
        let weight = Packed::new(weight.values, [o, i, 1], Side::Forward, self.tiles);
        let mut output = uninitialised(batch * o);
        ImplicitGemm::rows(batch, i).run(input.values, &weight, Some(bias.values), &mut output);
        Ok((output, Shape::from((batch, o))))
    }

    fn backward(&self, inputs: &[Argument<'_>], _output: &[f32], gradient: Vec<f32>) -> Result<Gradients> {
        let [batch, i, o] = sizes(inputs)?;
        let [input, weight, _] = inputs else { bail!("{NAME}: expected three inputs") };
        let weight = Packed::new(weight.values, [o, i, 1], Side::Backward, self.tiles);
        let mut input_gradient = uninitialised(batch * i);
        ImplicitGemm::rows(batch, o).run(&gradient, &weight, None, &mut input_gradient);
        let weight_gradient = weight_gradient(&ImplicitGemm::rows(batch, i), input.values, &gradient, o, self.tiles);
        Ok(vec![Some(input_gradient), Some(weight_gradient), Some(column_sums(&gradient, o))])
    }
}
