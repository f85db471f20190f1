//! Layers as candle custom ops with hand-written gradients: f32, CPU, channel-last.
//!
//! candle's max-pool gradient is wrong (scaled by the share of maxima in a window), and its convolution backward pass
//! takes several times as long as needed. Therefore this crate implements every layer itself:
//! - [`conv_relu_pool()`]: 3x3 convolution, ReLU and 2x2 max-pooling in one pass. The convolution's output is never stored. Only the
//!   largest cell of each pooling window has a gradient, so the backward pass does at most a quarter of the dense work.
//! - [`conv2d`] (dense, pointwise, depthwise), [`batch_norm`] with its activation, [`max_pool2d`], [`add_relu`],
//!   [`scale_channels`], [`dropout`], [`activation`], [`adaptive_average_pool`], [`linear`], [`circuit()`], [`cross_entropy`].
//! - [`PreparedConv`], [`PreparedBlock`], [`PreparedDense`] and [`Feature`]: the same layers for inference, without gradients, with
//!   folded batch normalisation and reused buffers.
//! - [`descriptors`]: numbers that describe a map and its motion, the input of some networks.
//! - [`backward`]: candle's backward pass without its copies.
//!
//! All layers run in parallel over the batch or over outputs, and sum in a fixed order. Results have the same bits for any number of
//! threads. The tests compare them with slow versions in f64 (`tests/reference.rs`).
//!
//! # Examples
//! ```
//! use candle_core::{Device, Tensor};
//! use radome_models::layer::{KernelLevel, linear};
//!
//! let input = Tensor::new(&[[1f32, 2.0]], &Device::Cpu)?;
//! let weight = Tensor::new(&[[3f32, 4.0]], &Device::Cpu)?;
//! let bias = Tensor::new(&[5f32], &Device::Cpu)?;
//! let output = linear(&input, &weight, &bias, KernelLevel::detect())?;
//! assert_eq!(output.to_vec2::<f32>()?, [[16f32]]);
//! # Ok::<(), candle_core::Error>(())
//! ```

mod activation;
mod average_pool;
mod backward;
mod batch_norm;
mod circuit;
mod conv2d;
mod conv_relu_pool;
mod cross_entropy;
mod descriptors;
mod dropout;
mod feature;
mod linear;
mod max_pool;
mod operation;
mod prepared_block;
mod prepared_conv;
mod prepared_dense;
mod scale_channels;
mod scaled_sigmoid;
mod standardise;
mod sum;
mod tensor;
#[cfg(test)]
mod tests;
mod trigonometric;

pub use crate::kernel::KernelLevel;
pub use activation::{Activation, activation, add_relu};
pub use average_pool::adaptive_average_pool;
pub(crate) use average_pool::bin_bounds;
pub use backward::backward;
pub use batch_norm::{BatchNormConstants, BatchNormMode, RunningStatistics, batch_norm};
pub use circuit::circuit;
pub(crate) use circuit::run_circuit;
pub use conv_relu_pool::conv_relu_pool;
pub use conv2d::{ConvGeometry, conv2d};
pub use cross_entropy::cross_entropy;
pub(crate) use cross_entropy::softmax;
pub(crate) use descriptors::EARLIER_DESCRIPTORS;
pub use descriptors::{DESCRIPTORS, descriptors};
pub use dropout::{drop_samples, dropout};
pub use feature::{Affine, Feature};
pub use linear::linear;
pub use max_pool::max_pool2d;
pub use operation::InputGradient;
pub use prepared_block::PreparedBlock;
pub use prepared_conv::PreparedConv;
pub use prepared_dense::PreparedDense;
pub use scale_channels::scale_channels;
pub use scaled_sigmoid::scaled_sigmoid;
pub(crate) use scaled_sigmoid::scaled_sigmoid_of;
pub use standardise::standardise;
pub use sum::{add, concatenate};
pub(crate) use tensor::with_values;
pub use trigonometric::trigonometric;
