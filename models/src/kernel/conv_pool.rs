//! Inner loops of the fused layer of convolution, ReLU and pooling.

use super::level::{for_each_level, multiply_add};

/// Output channels that the convolution kernel handles at once.
pub(crate) const LANES: usize = 16;
/// Index for a pooling window whose maximum is not above zero. ReLU passes no gradient to it.
pub(crate) const DEAD: u8 = 4;

/// Sizes of a 3x3 convolution with padding 1, followed by 2x2 pooling.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Block {
    /// Rows of the input.
    pub rows: usize,
    /// Columns of the input.
    pub columns: usize,
    /// Input channels.
    pub inputs: usize,
    /// Output channels.
    pub outputs: usize,
}

impl Block {
    /// Length of a padded input: one cell more on each side.
    pub fn padded_length(&self) -> usize {
        (self.rows + 2) * (self.columns + 2) * self.inputs
    }

    /// Length of the pooled output.
    pub fn pooled_length(&self) -> usize {
        (self.rows / 2) * (self.columns / 2) * self.outputs
    }

    /// Number of weights of one output channel.
    pub fn kernel_length(&self) -> usize {
        9 * self.inputs
    }

    /// Length of weights packed by [`Block::pack`].
    pub fn packed_length(&self) -> usize {
        self.outputs.div_ceil(LANES) * self.kernel_length() * LANES
    }

    /// Copies an input `[row][column][channel]` into the middle of a padded one whose border is zero.
    pub fn pad(&self, input: &[f32], padded: &mut [f32]) {
        let (line, padded_line) = (self.columns * self.inputs, (self.columns + 2) * self.inputs);
        for (source, target) in input.chunks_exact(line).zip(padded.chunks_exact_mut(padded_line).skip(1)) {
            target[self.inputs..self.inputs + line].copy_from_slice(source);
        }
    }

    /// Reverse of [`Block::pad`].
    pub fn crop(&self, padded: &[f32], input: &mut [f32]) {
        let (line, padded_line) = (self.columns * self.inputs, (self.columns + 2) * self.inputs);
        for (target, source) in input.chunks_exact_mut(line).zip(padded.chunks_exact(padded_line).skip(1)) {
            target.copy_from_slice(&source[self.inputs..self.inputs + line]);
        }
    }

    /// Packs weights `[output][input][row][column]` as `[output / 16][row][column][input][output % 16]`, zero-filled,
    /// for the forward pass.
    pub fn pack(&self, weight: &[f32]) -> Vec<f32> {
        let mut packed = vec![0.0; self.packed_length()];
        for (o, kernel) in weight.chunks_exact(self.kernel_length()).enumerate() {
            for (i, plane) in kernel.chunks_exact(9).enumerate() {
                for (t, &w) in plane.iter().enumerate() {
                    packed[((o / LANES) * self.kernel_length() + t * self.inputs + i) * LANES + o % LANES] = w;
                }
            }
        }
        packed
    }

    /// Converts weights `[output][input][row][column]` to channel-last `[output][row][column][input]`, for the backward
    /// pass.
    pub fn to_channel_last(self, weight: &[f32]) -> Vec<f32> {
        let mut out = vec![0.0; weight.len()];
        for (source, target) in
            weight.chunks_exact(self.kernel_length()).zip(out.chunks_exact_mut(self.kernel_length()))
        {
            for (k, value) in target.iter_mut().enumerate() {
                *value = source[(k % self.inputs) * 9 + k / self.inputs];
            }
        }
        out
    }

    /// Reverse of [`Block::to_channel_last`].
    pub fn to_channel_first(self, weight: &[f32]) -> Vec<f32> {
        let mut out = vec![0.0; weight.len()];
        for (source, target) in
            weight.chunks_exact(self.kernel_length()).zip(out.chunks_exact_mut(self.kernel_length()))
        {
            for (k, &value) in source.iter().enumerate() {
                target[(k % self.inputs) * 9 + k / self.inputs] = value;
            }
        }
        out
    }
}

for_each_level! {
    /// Computes convolution, bias, ReLU and pooling of one sample. For each window, `winner` receives the row-major index
    /// 0..4 of its largest cell, or [`DEAD`]. Of equal cells the first counts; a NaN is larger than any number.
    pub(crate) fn forward(
        block: Block, padded: &[f32], packed: &[f32], bias: &[f32], pooled: &mut [f32], winner: &mut [u8]
    ) {
        let Block { rows, columns, inputs, outputs } = block;
        let line = (columns + 2) * inputs;
        let tile = block.kernel_length() * LANES;
        for (group, weights) in packed.chunks_exact(tile).enumerate() {
            let first = group * LANES;
            let lanes = LANES.min(outputs - first);
            let mut init = [0.0f32; LANES];
            init[..lanes].copy_from_slice(&bias[first..first + lanes]);
            for y in 0..rows / 2 {
                for x in 0..columns / 2 {
                    let corner = 2 * y * line + 2 * x * inputs;
                    let mut sums = [init; 4];
                    for ky in 0..3 {
                        // Three offsets of one row are contiguous in channel-last order; so are their weights.
                        let at = |row: usize, column: usize| {
                            let from = corner + (ky + row) * line + column * inputs;
                            &padded[from..from + 3 * inputs]
                        };
                        let cells = [at(0, 0), at(0, 1), at(1, 0), at(1, 1)];
                        let weights = &weights[ky * 3 * inputs * LANES..(ky + 1) * 3 * inputs * LANES];
                        accumulate::<FUSED>(&mut sums, cells, weights);
                    }
                    let at = (y * (columns / 2) + x) * outputs + first;
                    let (pooled, winner) = (&mut pooled[at..at + lanes], &mut winner[at..at + lanes]);
                    for lane in 0..lanes {
                        let (mut best, mut index) = (sums[0][lane], 0u8);
                        for (candidate, sum) in sums.iter().enumerate().skip(1) {
                            // A NaN is taken and stays, because comparisons with it are false.
                            if (sum[lane] > best) | sum[lane].is_nan() {
                                (best, index) = (sum[lane], candidate as u8);
                            }
                        }
                        let dead = best <= 0.0;
                        pooled[lane] = if dead { 0.0 } else { best };
                        winner[lane] = if dead { DEAD } else { index };
                    }
                }
            }
        }
    }
}

/// `sums[p][lane] += cells[p][k] * weights[k][lane]` over all k, in order.
#[inline(always)]
fn accumulate<const FUSED: bool>(sums: &mut [[f32; LANES]; 4], cells: [&[f32]; 4], weights: &[f32]) {
    let mut acc = *sums;
    let length = weights.len() / LANES;
    let [c0, c1, c2, c3] = cells.map(|c| &c[..length]);
    let (weights, _) = weights.as_chunks::<LANES>();
    for k in 0..length {
        let w = &weights[k];
        for (sum, cell) in acc.iter_mut().zip([c0[k], c1[k], c2[k], c3[k]]) {
            for lane in 0..LANES {
                sum[lane] = multiply_add::<FUSED>(cell, w[lane], sum[lane]);
            }
        }
    }
    *sums = acc;
}

for_each_level! {
    /// Gradients of one sample. `gradient` belongs to the pooled output; weights and `weight_gradient` are
    /// channel-last. `input_gradient` is padded, or empty if it is not needed. All gradients are accumulated.
    pub(crate) fn backward(
        block: Block, padded: &[f32], weight: &[f32], winner: &[u8], gradient: &[f32],
        weight_gradient: &mut [f32], bias_gradient: &mut [f32], input_gradient: &mut [f32]
    ) {
        let Block { rows, columns, inputs, outputs } = block;
        if inputs == 1 && input_gradient.is_empty() {
            return backward_of_data::<FUSED>(block, padded, winner, gradient, weight_gradient, bias_gradient);
        }
        let line = (columns + 2) * inputs;
        let (length, run) = (block.kernel_length(), 3 * inputs);
        for y in 0..rows / 2 {
            for x in 0..columns / 2 {
                let at = (y * (columns / 2) + x) * outputs;
                let (winner, gradient) = (&winner[at..at + outputs], &gradient[at..at + outputs]);
                for o in 0..outputs {
                    let (index, g) = (winner[o] as usize, gradient[o]);
                    if index == DEAD as usize {
                        continue;
                    }
                    bias_gradient[o] += g;
                    let corner = (2 * y + index / 2) * line + (2 * x + index % 2) * inputs;
                    let kernel_gradient = &mut weight_gradient[o * length..(o + 1) * length];
                    for (ky, kernel_gradient) in kernel_gradient.chunks_exact_mut(run).enumerate() {
                        let from = corner + ky * line;
                        add_scaled::<FUSED>(kernel_gradient, g, &padded[from..from + run]);
                    }
                    if !input_gradient.is_empty() {
                        let kernel = &weight[o * length..(o + 1) * length];
                        for (ky, kernel) in kernel.chunks_exact(run).enumerate() {
                            let from = corner + ky * line;
                            add_scaled::<FUSED>(&mut input_gradient[from..from + run], g, kernel);
                        }
                    }
                }
            }
        }
    }
}

/// Computes [`backward`] for a single input channel that is data. Runs of three offsets are too short for vectors, so the
/// vector lanes are outputs. The gradient is expanded to the four cells of the window; all but the winner's cell are zero.
#[inline(always)]
fn backward_of_data<const FUSED: bool>(
    block: Block,
    padded: &[f32],
    winner: &[u8],
    gradient: &[f32],
    weight_gradient: &mut [f32],
    bias_gradient: &mut [f32],
) {
    let Block { rows, columns, outputs, .. } = block;
    let line = columns + 2;
    for first in (0..outputs).step_by(LANES) {
        let lanes = LANES.min(outputs - first);
        let mut weight_sums = [[0.0f32; LANES]; 9];
        let mut bias_sums = [0.0f32; LANES];
        for y in 0..rows / 2 {
            for x in 0..columns / 2 {
                let at = (y * (columns / 2) + x) * outputs + first;
                let (mut g, mut w) = ([0.0f32; LANES], [DEAD; LANES]);
                g[..lanes].copy_from_slice(&gradient[at..at + lanes]);
                w[..lanes].copy_from_slice(&winner[at..at + lanes]);
                for candidate in 0..4u8 {
                    let mut cell_gradient = [0.0f32; LANES];
                    for lane in 0..LANES {
                        cell_gradient[lane] = if w[lane] == candidate { g[lane] } else { 0.0 };
                        bias_sums[lane] += cell_gradient[lane];
                    }
                    let corner = (2 * y + candidate as usize / 2) * line + 2 * x + candidate as usize % 2;
                    for (ky, row_sums) in weight_sums.chunks_exact_mut(3).enumerate() {
                        let cells = &padded[corner + ky * line..corner + ky * line + 3];
                        for (sums, &cell) in row_sums.iter_mut().zip(cells) {
                            for lane in 0..LANES {
                                sums[lane] = multiply_add::<FUSED>(cell, cell_gradient[lane], sums[lane]);
                            }
                        }
                    }
                }
            }
        }
        for lane in 0..lanes {
            bias_gradient[first + lane] += bias_sums[lane];
            for (offset, sums) in weight_sums.iter().enumerate() {
                weight_gradient[(first + lane) * 9 + offset] += sums[lane];
            }
        }
    }
}

/// `target += factor * source`.
#[inline(always)]
fn add_scaled<const FUSED: bool>(target: &mut [f32], factor: f32, source: &[f32]) {
    let ((targets, target_rest), (sources, source_rest)) =
        (target.as_chunks_mut::<LANES>(), source.as_chunks::<LANES>());
    for (t, s) in targets.iter_mut().zip(sources) {
        for lane in 0..LANES {
            t[lane] = multiply_add::<FUSED>(factor, s[lane], t[lane]);
        }
    }
    for (t, &s) in target_rest.iter_mut().zip(source_rest) {
        *t = multiply_add::<FUSED>(factor, s, *t);
    }
}
