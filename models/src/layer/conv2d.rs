//! Two-dimensional convolution, dense or depthwise.

use candle_core::{Error, Result, Shape, Tensor, bail};

use super::operation::{Argument, Gradients, InputGradient, Operation, apply};
use crate::kernel::KernelLevel;
use crate::kernel::buffer::uninitialised;
use crate::kernel::depthwise;
use crate::kernel::implicit_gemm::{ImplicitGemm, KernelOffset};
use crate::kernel::packed::{Packed, Side};
use crate::kernel::tile::Tiles;
use crate::kernel::weight_gradient::{column_sums, weight_gradient};
use crate::kernel::winograd::{Epilogue, Winograd};
use crate::kernel::winograd_gradient;

const NAME: &str = "conv2d";

/// Least number of channels on either side for which Winograd's transforms are worth their cost.
const LEAST_CHANNELS: usize = 16;
/// Least number of rows and columns for which Winograd's transforms are worth their cost. With fewer, large parts of the
/// windows lie outside the map.
const LEAST_CELLS: usize = 4;

/// Stride, padding and groups of a convolution, equal along rows and columns.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct ConvGeometry {
    /// Distance in cells from one output to the next, at least 1.
    pub stride: usize,
    /// Rows and columns of zeros on each side.
    pub padding: usize,
    /// Number of groups: 1, or the number of channels for a depthwise convolution.
    pub groups: usize,
}

impl ConvGeometry {
    /// Geometry of a dense convolution.
    pub const fn dense(stride: usize, padding: usize) -> Self {
        ConvGeometry { stride, padding, groups: 1 }
    }

    /// Geometry of a depthwise convolution.
    pub const fn depthwise(stride: usize, padding: usize, channels: usize) -> Self {
        ConvGeometry { stride, padding, groups: channels }
    }

    /// Cells along an axis of the output; `None` if the kernel does not fit into the padded input.
    pub fn output_length(&self, input: usize, kernel: usize) -> Option<usize> {
        let last_start = (input + 2 * self.padding).checked_sub(kernel)?;
        Some(last_start.checked_div(self.stride)? + 1)
    }
}

/// PyTorch's `conv2d` on channel-last maps.
///
/// `input` is `[batch][row][column][i]`, `weight` `[o][i / groups][kernel row][kernel column]`, `bias` `[o]`; the result
/// is `[batch][row][column][o]`.
///
/// # Errors
/// Shapes differ from those above, an axis or the stride is 0, the groups are neither 1 nor the number of channels, the kernel
/// does not fit into the padded input, or a tensor is not f32 on the CPU.
pub fn conv2d(
    input: &Tensor,
    weight: &Tensor,
    bias: Option<&Tensor>,
    geometry: ConvGeometry,
    input_gradient: InputGradient,
    level: KernelLevel,
) -> Result<Tensor> {
    let operation = Conv2d { geometry, input_gradient, tiles: Tiles::new(level) };
    let inputs: Vec<&Tensor> = [input, weight].into_iter().chain(bias).collect();
    apply(NAME, &inputs, operation)
}

struct Conv2d {
    geometry: ConvGeometry,
    input_gradient: InputGradient,
    tiles: Tiles,
}

/// All sizes of one convolution.
#[derive(Debug, Clone, Copy)]
pub(super) struct ConvSizes {
    pub batch: usize,
    /// Rows and columns.
    pub input: [usize; 2],
    pub output: [usize; 2],
    pub kernel: [usize; 2],
    pub inputs: usize,
    pub outputs: usize,
    pub geometry: ConvGeometry,
}

impl ConvSizes {
    /// Checks the sizes of a convolution. Errors name `layer`.
    ///
    /// # Errors
    /// The sizes contradict each other, one of them is 0, or the kernel does not fit into the padded input.
    pub fn new(
        layer: &str,
        input: &[usize],
        weight: &[usize],
        bias: Option<&[usize]>,
        geometry: ConvGeometry,
    ) -> Result<Self> {
        let wrong = |why: &str| {
            Error::Msg(format!(
                "{layer}: {why}: expected input [batch, rows, columns, i], weight [o, i / groups, kernel rows, kernel \
                 columns], bias [o], kernel within the padded input; got input {input:?}, weight {weight:?}, bias \
                 {bias:?} with {geometry:?}"
            ))
            .bt()
        };
        let (&[batch, rows, columns, inputs], &[outputs, weight_inputs, kernel_rows, kernel_columns]) = (input, weight)
        else {
            return Err(wrong("wrong number of axes"));
        };
        if [rows, columns, inputs, outputs, weight_inputs, kernel_rows, kernel_columns, geometry.stride].contains(&0) {
            return Err(wrong("an empty axis or a stride of 0"));
        }
        let depthwise = geometry.groups == inputs && geometry.groups == outputs;
        if geometry.groups != 1 && !depthwise {
            return Err(wrong("groups must be 1 or the number of input and of output channels"));
        }
        if weight_inputs * geometry.groups != inputs {
            return Err(wrong("channels of input and weight differ"));
        }
        if bias.is_some_and(|b| b != [outputs]) {
            return Err(wrong("the bias has another number of outputs"));
        }
        let length =
            |input, kernel| geometry.output_length(input, kernel).ok_or_else(|| wrong("the kernel does not fit"));
        Ok(ConvSizes {
            batch,
            input: [rows, columns],
            output: [length(rows, kernel_rows)?, length(columns, kernel_columns)?],
            kernel: [kernel_rows, kernel_columns],
            inputs,
            outputs,
            geometry,
        })
    }

    /// Returns whether the convolution is depthwise. A convolution with a single channel is dense.
    pub fn is_depthwise(&self) -> bool {
        self.geometry.groups > 1
    }

    /// Returns whether a training step computes the convolution by Winograd's algorithm.
    fn uses_winograd(&self) -> bool {
        self.kernel == [3, 3]
            && self.geometry == ConvGeometry::dense(1, 1)
            && self.inputs.min(self.outputs) >= LEAST_CHANNELS
            && self.input[0].min(self.input[1]) >= LEAST_CELLS
    }

    /// Batch, rows and columns of the input.
    fn input_cells(&self) -> [usize; 3] {
        [self.batch, self.input[0], self.input[1]]
    }

    /// Number of cells of the kernel.
    pub fn offsets(&self) -> usize {
        self.kernel[0] * self.kernel[1]
    }

    /// Shape of the output, `[batch][row][column][o]`.
    pub fn output_shape(&self) -> [usize; 4] {
        [self.batch, self.output[0], self.output[1], self.outputs]
    }

    /// Number of values of the output.
    pub fn output_count(&self) -> usize {
        self.output_shape().iter().product()
    }

    /// Product from the input to the output.
    pub fn forward_gemm(&self) -> ImplicitGemm {
        let padding = -(self.geometry.padding as isize);
        let offsets = (0..self.offsets())
            .map(|t| KernelOffset {
                shift: [(t / self.kernel[1]) as isize, (t % self.kernel[1]) as isize],
                index: t as u32,
            })
            .collect();
        ImplicitGemm {
            batch: self.batch,
            grid: self.output,
            source: self.input,
            channels: self.inputs,
            source_step: self.geometry.stride as isize,
            source_start: [padding; 2],
            offsets,
            target: self.output,
            target_step: 1,
            target_start: [0; 2],
        }
    }

    /// Products from the output's gradient to the input's. With a stride of s, input cells have s x s phases, each of which is
    /// read by other kernel offsets. Each phase is one product. Cells that no offset reads are in none.
    pub fn backward_gemms(&self) -> Vec<ImplicitGemm> {
        let ConvGeometry { stride, padding, .. } = self.geometry;
        let mut gemms = Vec::new();
        for phase in 0..stride * stride {
            let start = [phase / stride, phase % stride];
            let mut grid = [0; 2];
            // For each axis, pairs of shift in the output and kernel offset.
            let mut offsets_along: [Vec<(isize, usize)>; 2] = Default::default();
            for axis in 0..2 {
                grid[axis] = self.input[axis].saturating_sub(start[axis]).div_ceil(stride);
                // Kernel offset k of output cell (y + padding - k) / stride reads input cell y, if this is a whole number.
                offsets_along[axis] = (0..self.kernel[axis])
                    .filter(|k| (start[axis] + padding + stride * self.kernel[axis] - k).is_multiple_of(stride))
                    .map(|k| (((start[axis] + padding) as isize - k as isize).div_euclid(stride as isize), k))
                    .collect();
            }
            let offsets: Vec<KernelOffset> = offsets_along[0]
                .iter()
                .flat_map(|&(y, ky)| {
                    offsets_along[1]
                        .iter()
                        .map(move |&(x, kx)| KernelOffset { shift: [y, x], index: (ky * self.kernel[1] + kx) as u32 })
                })
                .collect();
            if offsets.is_empty() || grid.contains(&0) {
                continue;
            }
            gemms.push(ImplicitGemm {
                batch: self.batch,
                grid,
                source: self.output,
                channels: self.outputs,
                source_step: 1,
                source_start: [0; 2],
                offsets,
                target: self.input,
                target_step: stride,
                target_start: start,
            });
        }
        gemms
    }
}

impl Conv2d {
    fn sizes(&self, inputs: &[Argument<'_>]) -> Result<ConvSizes> {
        match inputs {
            [input, weight] => ConvSizes::new(NAME, input.dims, weight.dims, None, self.geometry),
            [input, weight, bias] => ConvSizes::new(NAME, input.dims, weight.dims, Some(bias.dims), self.geometry),
            _ => bail!("{NAME}: expected input, weight and perhaps bias"),
        }
    }

    /// Gradient of the input, from that of the output.
    fn input_gradient(&self, sizes: &ConvSizes, weight: &[f32], gradient: &[f32]) -> Vec<f32> {
        let cells: usize = sizes.input_cells().iter().product();
        if sizes.uses_winograd() {
            let mut target = uninitialised(cells * sizes.inputs);
            let winograd = Winograd::backward(weight, [sizes.outputs, sizes.inputs], self.tiles);
            winograd.run(gradient, sizes.input_cells(), Epilogue::NONE, &mut target);
            return target;
        }
        let gemms = sizes.backward_gemms();
        // With a stride longer than the kernel, no product writes the cells that no offset reads.
        let all_written = gemms.iter().map(ImplicitGemm::cells).sum::<usize>() == cells;
        let mut target =
            if all_written { uninitialised(cells * sizes.inputs) } else { vec![0.0; cells * sizes.inputs] };
        if sizes.is_depthwise() {
            let weight = depthwise::transposed(weight, sizes.offsets());
            for gemm in &gemms {
                depthwise::run(gemm, gradient, &weight, None, &mut target, self.tiles);
            }
        } else {
            let weight =
                Packed::new(weight, [sizes.outputs, sizes.inputs, sizes.offsets()], Side::Backward, self.tiles);
            for gemm in &gemms {
                gemm.run(gradient, &weight, None, &mut target);
            }
        }
        target
    }
}

impl Operation for Conv2d {
    fn forward(&self, inputs: &[Argument<'_>]) -> Result<(Vec<f32>, Shape)> {
        let sizes = self.sizes(inputs)?;
        let [input, weight, ..] = inputs else { bail!("{NAME}: no weight") };
        let bias = inputs.get(2).map(|b| b.values);
        let mut output = uninitialised(sizes.output_count());
        let gemm = sizes.forward_gemm();
        if sizes.is_depthwise() {
            let weight = depthwise::transposed(weight.values, sizes.offsets());
            depthwise::run(&gemm, input.values, &weight, bias, &mut output, self.tiles);
        } else if sizes.uses_winograd() {
            let channels = [sizes.outputs, sizes.inputs];
            let winograd = Winograd::new(weight.values, channels, bias.unwrap_or_default(), self.tiles);
            winograd.run(input.values, sizes.input_cells(), Epilogue::NONE, &mut output);
        } else {
            let weight =
                Packed::new(weight.values, [sizes.outputs, sizes.inputs, sizes.offsets()], Side::Forward, self.tiles);
            gemm.run(input.values, &weight, bias, &mut output);
        }
        Ok((output, Shape::from(sizes.output_shape().to_vec())))
    }

    fn backward(&self, inputs: &[Argument<'_>], _output: &[f32], gradient: Vec<f32>) -> Result<Gradients> {
        let sizes = self.sizes(inputs)?;
        let [input, weight, ..] = inputs else { bail!("{NAME}: no weight") };
        let gemm = sizes.forward_gemm();
        let weight_gradient = if sizes.is_depthwise() {
            depthwise::weight_gradient(&gemm, input.values, &gradient, self.tiles)
        } else if sizes.uses_winograd() {
            let channels = [sizes.outputs, sizes.inputs];
            winograd_gradient::weight_gradient(input.values, sizes.input_cells(), &gradient, channels, self.tiles)
        } else {
            weight_gradient(&gemm, input.values, &gradient, sizes.outputs, self.tiles)
        };
        let needed = self.input_gradient == InputGradient::Needed;
        let input_gradient = needed.then(|| self.input_gradient(&sizes, weight.values, &gradient));
        let mut gradients = vec![input_gradient, Some(weight_gradient)];
        if inputs.len() == 3 {
            gradients.push(Some(column_sums(&gradient, sizes.outputs)));
        }
        Ok(gradients)
    }
}
