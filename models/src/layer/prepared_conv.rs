//! Convolution prepared for inference: weights packed or transformed once, batch normalisation and activation fused.

use super::activation::{Activation, CHUNK, activate_in_place, add_and_activate};
use super::conv2d::{ConvGeometry, ConvSizes};
use super::feature::{Affine, Feature, fold_affine};
use crate::kernel::packed::{Packed, Side};
use crate::kernel::spin_pool::for_each_chunk;
use crate::kernel::tile::Tiles;
use crate::kernel::winograd::{Epilogue, Winograd};
use crate::kernel::{KernelLevel, depthwise};
use candle_core::{Result, bail};

/// Least number of input channels for which Winograd's transforms are worth their cost.
const LEAST_CHANNELS: usize = 8;
/// Largest number of weights for which Winograd's transforms are worth their cost. Nine weights become 16 transformed ones,
/// and loading more of these takes longer than the saved sums.
const MOST_TRANSFORMED: usize = 1 << 16;

/// Convolution with folded batch normalisation, bias and activation.
pub struct PreparedConv {
    weight_dims: [usize; 4],
    geometry: ConvGeometry,
    activation: Activation,
    bias: Vec<f32>,
    weight: Weight,
    tiles: Tiles,
    level: KernelLevel,
}

enum Weight {
    Dense(Packed),
    Winograd(Winograd),
    Depthwise(Vec<f32>),
}

impl PreparedConv {
    /// Prepares `activation((conv(x, weight) + bias) * scale + shift)`, `weight` `[o][i / groups][kernel row][kernel
    /// column]`.
    ///
    /// # Errors
    /// A number of values differs from what `weight_dims` asks for, there are no weights, the stride is 0, or the groups are
    /// neither 1 nor the number of outputs.
    pub fn new(
        weight: &[f32],
        weight_dims: [usize; 4],
        bias: Option<&[f32]>,
        affine: Option<Affine<'_>>,
        geometry: ConvGeometry,
        activation: Activation,
        level: KernelLevel,
    ) -> Result<Self> {
        let [outputs, inputs, rows, columns] = weight_dims;
        let lengths = [bias.map(<[f32]>::len), affine.map(|a| a.scale.len()), affine.map(|a| a.shift.len())];
        let groups = [1, outputs].contains(&geometry.groups) && (geometry.groups == 1 || inputs == 1);
        if weight.len() != weight_dims.iter().product::<usize>()
            || weight.is_empty()
            || geometry.stride == 0
            || !groups
            || lengths.iter().flatten().any(|&l| l != outputs)
        {
            bail!(
                "prepared convolution: expected weight [o, i / groups, kernel rows, kernel columns], groups 1 or o, and o \
                 values of bias, scale and shift; got {} values for {weight_dims:?}, {lengths:?} with {geometry:?}",
                weight.len()
            );
        }
        let (folded_weight, bias) = fold_affine(weight, outputs, bias, affine);
        let tiles = Tiles::new(level);
        let uses_winograd = [rows, columns] == [3, 3]
            && geometry == ConvGeometry::dense(1, 1)
            && inputs >= LEAST_CHANNELS
            && inputs * outputs <= MOST_TRANSFORMED;
        let weight = if uses_winograd {
            Weight::Winograd(Winograd::new(&folded_weight, [outputs, inputs], &bias, tiles))
        } else if geometry.groups > 1 {
            Weight::Depthwise(depthwise::transposed(&folded_weight, rows * columns))
        } else {
            Weight::Dense(Packed::new(&folded_weight, [outputs, inputs, rows * columns], Side::Forward, tiles))
        };
        Ok(PreparedConv { weight_dims, geometry, activation, bias, weight, tiles, level: level.available() })
    }

    /// `output = activation(conv(input) + residual)`. `output` takes the shape it needs and keeps its memory.
    ///
    /// # Errors
    /// The input has another number of channels or is smaller than the kernel, or the residual has another shape than the output.
    pub fn run(&self, input: &Feature, residual: Option<&Feature>, output: &mut Feature) -> Result<()> {
        let sizes = ConvSizes::new("prepared convolution", &input.dims, &self.weight_dims, None, self.geometry)?;
        if let Some(residual) = residual
            && residual.dims != sizes.output_shape()
        {
            bail!("prepared convolution: expected a residual {:?}, got {:?}", sizes.output_shape(), residual.dims);
        }
        output.reshape(sizes.output_shape());
        let gemm = sizes.forward_gemm();
        match &self.weight {
            Weight::Dense(weight) => gemm.run(&input.values, weight, Some(&self.bias), &mut output.values),
            Weight::Depthwise(weight) => {
                depthwise::run(&gemm, &input.values, weight, Some(&self.bias), &mut output.values, self.tiles);
            }
            Weight::Winograd(winograd) => {
                let [batch, rows, columns, _] = input.dims;
                let rectified = self.activation == Activation::Relu;
                let is_fused = rectified || self.activation == Activation::None;
                let residual = residual.filter(|_| is_fused).map(|residual| residual.values.as_slice());
                let epilogue = Epilogue::Cells { residual, rectified };
                winograd.run(&input.values, [batch, rows, columns], epilogue, &mut output.values);
                if is_fused {
                    return Ok(());
                }
            }
        }
        if let Some(residual) = residual {
            for_each_chunk(&mut output.values, CHUNK, |index, values| {
                let residual = &residual.values[index * CHUNK..][..values.len()];
                add_and_activate(self.level, self.activation, values, residual);
            });
        } else if self.activation != Activation::None {
            for_each_chunk(&mut output.values, CHUNK, |_, values| {
                activate_in_place(self.level, self.activation, values)
            });
        }
        Ok(())
    }
}
