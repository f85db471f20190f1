//! Batch normalisation with a fused activation.

use std::sync::{Arc, OnceLock, RwLock};

use candle_core::{Result, Shape, Tensor, bail};
use rayon::prelude::*;

use super::activation::{Activation, activate, activation_gradient, by_activation};
use super::operation::{Argument, Gradients, Operation, apply};
use crate::kernel::KernelLevel;
use crate::kernel::buffer::uninitialised;
use crate::kernel::level::{for_each_level, multiply_add};

const NAME: &str = "batch_norm";

/// Number of values of a block that is summed at once. The block stays in the first-level cache for two passes.
const BLOCK: usize = 1 << 13;

/// Settings of batch normalisation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BatchNormConstants {
    /// Added to the variance.
    pub epsilon: f32,
    /// Share of a new batch in the running statistics.
    pub momentum: f32,
}

impl Default for BatchNormConstants {
    /// The values of PyTorch.
    fn default() -> Self {
        BatchNormConstants { epsilon: 1e-5, momentum: 0.1 }
    }
}

/// Source of mean and variance.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BatchNormMode {
    /// The batch; the running statistics move towards its values.
    Training,
    /// The running statistics.
    Evaluation,
}

/// Running mean and variance of each channel. Clones share them.
#[derive(Debug, Clone)]
pub struct RunningStatistics {
    constants: BatchNormConstants,
    channels: usize,
    shared: Arc<RwLock<Moments>>,
}

#[derive(Debug, Clone)]
struct Moments {
    mean: Vec<f32>,
    variance: Vec<f32>,
}

impl RunningStatistics {
    /// Makes statistics with mean 0 and variance 1.
    pub fn new(channels: usize, constants: BatchNormConstants) -> Self {
        let moments = Moments { mean: vec![0.0; channels], variance: vec![1.0; channels] };
        RunningStatistics { constants, channels, shared: Arc::new(RwLock::new(moments)) }
    }

    /// Settings of the layer.
    pub fn constants(&self) -> BatchNormConstants {
        self.constants
    }

    fn moments(&self) -> Moments {
        self.shared.read().unwrap_or_else(|poisoned| poisoned.into_inner()).clone()
    }

    /// Running mean of each channel.
    pub fn mean(&self) -> Vec<f32> {
        self.moments().mean
    }

    /// Running variance of each channel, unbiased.
    pub fn variance(&self) -> Vec<f32> {
        self.moments().variance
    }

    /// Sets mean and variance of each channel, as read from a file.
    ///
    /// # Errors
    /// The number of means or of variances is not the number of channels.
    pub fn set(&self, mean: Vec<f32>, variance: Vec<f32>) -> Result<()> {
        if mean.len() != self.channels || variance.len() != self.channels {
            bail!(
                "{NAME}: expected running statistics of {} channels, got {} means and {} variances",
                self.channels,
                mean.len(),
                variance.len()
            );
        }
        *self.shared.write().unwrap_or_else(|poisoned| poisoned.into_inner()) = Moments { mean, variance };
        Ok(())
    }

    /// Moves the running statistics towards a batch of `count` values for each channel, whose variance is biased.
    fn update(&self, batch: &Moments, count: usize) {
        let momentum = self.constants.momentum;
        let unbiased = count as f32 / (count as f32 - 1.0);
        let mut moments = self.shared.write().unwrap_or_else(|poisoned| poisoned.into_inner());
        moments.mean.iter_mut().zip(&batch.mean).for_each(|(r, &m)| *r = (1.0 - momentum) * *r + momentum * m);
        let variances = moments.variance.iter_mut().zip(&batch.variance);
        variances.for_each(|(r, &v)| *r = (1.0 - momentum) * *r + momentum * v * unbiased);
    }
}

/// PyTorch's batch normalisation over all axes but the last, and an activation of the result:
/// `activation((x - mean) / sqrt(variance + epsilon) * weight + bias)` for each channel.
///
/// `input` is `[batch][..][channel]`, `weight` and `bias` `[channel]`. A batch with a single value for each channel has no
/// variance: an error in training.
///
/// # Errors
/// Shapes differ from those above, a training batch has one value for each channel, or a tensor is not f32 on the CPU.
pub fn batch_norm(
    input: &Tensor,
    weight: &Tensor,
    bias: &Tensor,
    statistics: &RunningStatistics,
    mode: BatchNormMode,
    activation: Activation,
    level: KernelLevel,
) -> Result<Tensor> {
    let operation = BatchNorm {
        statistics: statistics.clone(),
        mode,
        activation,
        level: level.available(),
        forward_moments: OnceLock::new(),
    };
    apply(NAME, &[input, weight, bias], operation)
}

struct BatchNorm {
    statistics: RunningStatistics,
    mode: BatchNormMode,
    activation: Activation,
    level: KernelLevel,
    forward_moments: OnceLock<ForwardMoments>,
}

/// Mean and scale of each channel that the forward pass used.
struct ForwardMoments {
    mean: Vec<f32>,
    /// One over the standard deviation.
    inverse_sigma: Vec<f32>,
}

/// Repeats values of the channels, so that loops over them are long enough for vectors.
fn repeat_channels(values: &[f32]) -> Vec<f32> {
    values.repeat((256 / values.len().max(1)).max(1))
}

/// Elements of an array made by [`repeat_channels`], each with its channel.
fn with_channel(sums: &[f32], channels: usize) -> impl Iterator<Item = (usize, f64)> + '_ {
    sums.iter().enumerate().map(move |(k, &s)| (k % channels, f64::from(s)))
}

for_each_level! {
    /// Computes for each channel of `[row][channel]` the mean and the sum of squared deviations from it. Both are repeated as by
    /// [`repeat_channels`]; the repetitions of `square` are partial sums.
    fn block_moments(block: &[f32], channels: usize, mean: &mut [f32], square: &mut [f32]) {
        mean.fill(0.0);
        square.fill(0.0);
        let rows = (block.len() / channels) as f32;
        let length = mean.len();
        for chunk in block.chunks(length) {
            mean.iter_mut().zip(chunk).for_each(|(m, &x)| *m += x);
        }
        for k in channels..length {
            mean[k % channels] += mean[k];
        }
        for k in 0..length {
            mean[k] = if k < channels { mean[k] / rows } else { mean[k - channels] };
        }
        for chunk in block.chunks(length) {
            for ((s, &m), &x) in square.iter_mut().zip(&*mean).zip(chunk) {
                *s = multiply_add::<FUSED>(x - m, x - m, *s);
            }
        }
    }
}

for_each_level! {
    fn normalise(activation: Activation, input: &[f32], scale: &[f32], shift: &[f32], output: &mut [f32]) {
        let length = scale.len();
        by_activation!(activation, A => {
            for (input, output) in input.chunks(length).zip(output.chunks_mut(length)) {
                for (((y, &x), &a), &b) in output.iter_mut().zip(input).zip(scale).zip(shift) {
                    *y = activate::<FUSED>(A, multiply_add::<FUSED>(x, a, b));
                }
            }
        })
    }
}

for_each_level! {
    /// Replaces the gradient of the output by the gradient before the activation. Adds the latter to `sum` and its product
    /// with the centred input to `product`, for each channel. `constants` are mean, scale and shift.
    fn gradient_sums(
        activation: Activation, input: &[f32], constants: [&[f32]; 3], gradient: &mut [f32],
        sum: &mut [f32], product: &mut [f32],
    ) {
        let length = constants[0].len();
        let [mean, scale, shift] = constants.map(|constant| &constant[..length]);
        let (sum, product) = (&mut sum[..length], &mut product[..length]);
        by_activation!(activation, A => {
            for (input, gradient) in input.chunks(length).zip(gradient.chunks_mut(length)) {
                for (k, (&x, g)) in input.iter().zip(gradient).enumerate() {
                    *g = activation_gradient::<FUSED>(A, multiply_add::<FUSED>(x, scale[k], shift[k]), *g);
                    sum[k] += *g;
                    product[k] = multiply_add::<FUSED>(*g, x - mean[k], product[k]);
                }
            }
        })
    }
}

for_each_level! {
    /// `gradient = gradient scale + (input - mean) slope + offset`.
    fn input_gradient(
        input: &[f32], mean: &[f32], scale: &[f32], slope: &[f32], offset: &[f32], gradient: &mut [f32],
    ) {
        let length = mean.len();
        let (scale, slope, offset) = (&scale[..length], &slope[..length], &offset[..length]);
        for (input, gradient) in input.chunks(length).zip(gradient.chunks_mut(length)) {
            for (k, (&x, g)) in input.iter().zip(gradient).enumerate() {
                let centred = multiply_add::<FUSED>(x - mean[k], slope[k], offset[k]);
                *g = multiply_add::<FUSED>(*g, scale[k], centred);
            }
        }
    }
}

impl BatchNorm {
    fn channels(&self, inputs: &[Argument<'_>]) -> Result<usize> {
        if let [input, weight, bias] = inputs
            && let Some(&channels) = input.dims.last()
            && input.dims.len() >= 2
            && channels > 0
            && weight.dims == [channels]
            && bias.dims == [channels]
            && self.statistics.channels == channels
        {
            return Ok(channels);
        }
        let dims: Vec<_> = inputs.iter().map(|a| a.dims).collect();
        bail!(
            "{NAME}: expected input [batch, .., c], weight [c], bias [c] and running statistics of c channels; got {dims:?} \
             and {} channels",
            self.statistics.channels
        )
    }

    /// Mean and biased variance of each channel, in f64 over blocks (Chan, Golub and LeVeque, 1979).
    fn moments(&self, input: &[f32], channels: usize) -> Moments {
        let block = (BLOCK / channels).max(1) * channels;
        let pattern = repeat_channels(&vec![0.0; channels]).len();
        let partials: Vec<(usize, Vec<f32>, Vec<f32>)> = input
            .par_chunks(block)
            .map(|block| {
                let (mut mean, mut square) = (vec![0.0; pattern], vec![0.0; pattern]);
                block_moments(self.level, block, channels, &mut mean, &mut square);
                (block.len() / channels, mean, square)
            })
            .collect();
        let (mut mean, mut square, mut count) = (vec![0.0f64; channels], vec![0.0f64; channels], 0.0f64);
        for (rows, block_mean, block_square) in &partials {
            let rows = *rows as f64;
            let total = count + rows;
            for (k, (mean, square)) in mean.iter_mut().zip(&mut square).enumerate() {
                let difference = f64::from(block_mean[k]) - *mean;
                *mean += difference * rows / total;
                *square += difference * difference * count * rows / total;
            }
            with_channel(block_square, channels).for_each(|(k, s)| square[k] += s);
            count = total;
        }
        let variance = square.iter().map(|s| (s / count) as f32).collect();
        Moments { mean: mean.iter().map(|&m| m as f32).collect(), variance }
    }
}

impl Operation for BatchNorm {
    fn forward(&self, inputs: &[Argument<'_>]) -> Result<(Vec<f32>, Shape)> {
        let channels = self.channels(inputs)?;
        let [input, weight, bias] = inputs else { bail!("{NAME}: expected three inputs") };
        let count = input.values.len() / channels;
        let Moments { mean, variance } = match self.mode {
            BatchNormMode::Evaluation => self.statistics.moments(),
            BatchNormMode::Training if count < 2 => {
                bail!(
                    "{NAME}: expected more than one value for each channel in training, got input {:?}: a single value \
                     has no variance; use larger batches",
                    input.dims
                );
            }
            BatchNormMode::Training => {
                let moments = self.moments(input.values, channels);
                self.statistics.update(&moments, count);
                moments
            }
        };
        let epsilon = f64::from(self.statistics.constants.epsilon);
        let inverse_sigma: Vec<f32> =
            variance.iter().map(|&v| (1.0 / (f64::from(v) + epsilon).sqrt()) as f32).collect();
        let (scale, shift) = scale_and_shift(weight.values, bias.values, &mean, &inverse_sigma);
        let mut output = uninitialised(input.values.len());
        let chunk = scale.len() * (BLOCK / scale.len()).max(1);
        output
            .par_chunks_mut(chunk)
            .zip(input.values.par_chunks(chunk))
            .for_each(|(output, input)| normalise(self.level, self.activation, input, &scale, &shift, output));
        let _ = self.forward_moments.set(ForwardMoments { mean, inverse_sigma });
        Ok((output, Shape::from(input.dims)))
    }

    fn backward(&self, inputs: &[Argument<'_>], _output: &[f32], mut gradient: Vec<f32>) -> Result<Gradients> {
        let channels = self.channels(inputs)?;
        let [input, weight, bias] = inputs else { bail!("{NAME}: expected three inputs") };
        let Some(ForwardMoments { mean, inverse_sigma }) = self.forward_moments.get() else {
            bail!("{NAME}: backward pass without a forward pass");
        };
        let (scale, shift) = scale_and_shift(weight.values, bias.values, mean, inverse_sigma);
        let means = repeat_channels(mean);
        let chunk = scale.len() * (BLOCK / scale.len()).max(1);
        let partials: Vec<(Vec<f32>, Vec<f32>)> = gradient
            .par_chunks_mut(chunk)
            .zip(input.values.par_chunks(chunk))
            .map(|(gradient, input)| {
                let (mut sum, mut product) = (vec![0.0; scale.len()], vec![0.0; scale.len()]);
                let constants = [&means[..], &scale, &shift];
                gradient_sums(self.level, self.activation, input, constants, gradient, &mut sum, &mut product);
                (sum, product)
            })
            .collect();
        let (mut sum, mut product) = (vec![0.0f64; channels], vec![0.0f64; channels]);
        for (partial_sum, partial_product) in &partials {
            with_channel(partial_sum, channels).for_each(|(k, s)| sum[k] += s);
            with_channel(partial_product, channels).for_each(|(k, s)| product[k] += s);
        }
        // The sums above use centred inputs, not normalised ones.
        product.iter_mut().zip(inverse_sigma).for_each(|(p, &i)| *p *= f64::from(i));
        let count = (input.values.len() / channels) as f64;
        // In training, mean and variance of the batch depend on every input.
        let batch_weight = if self.mode == BatchNormMode::Training { 1.0 / count } else { 0.0 };
        let offset: Vec<f32> = (0..channels).map(|k| (-f64::from(scale[k]) * sum[k] * batch_weight) as f32).collect();
        let slope: Vec<f32> = (0..channels)
            .map(|k| (-f64::from(scale[k]) * f64::from(inverse_sigma[k]) * product[k] * batch_weight) as f32)
            .collect();
        let (offset, slope) = (repeat_channels(&offset), repeat_channels(&slope));
        gradient
            .par_chunks_mut(chunk)
            .zip(input.values.par_chunks(chunk))
            .for_each(|(gradient, input)| input_gradient(self.level, input, &means, &scale, &slope, &offset, gradient));
        let to_f32 = |values: Vec<f64>| values.into_iter().map(|v| v as f32).collect::<Vec<f32>>();
        Ok(vec![Some(gradient), Some(to_f32(product)), Some(to_f32(sum))])
    }
}

/// Scale and shift of each channel, repeated: `x scale + shift` is the normalised `x`.
fn scale_and_shift(weight: &[f32], bias: &[f32], mean: &[f32], inverse_sigma: &[f32]) -> (Vec<f32>, Vec<f32>) {
    let scale: Vec<f32> = weight.iter().zip(inverse_sigma).map(|(w, i)| w * i).collect();
    let shift: Vec<f32> = bias.iter().zip(mean).zip(&scale).map(|((b, m), s)| b - m * s).collect();
    (repeat_channels(&scale), repeat_channels(&shift))
}
