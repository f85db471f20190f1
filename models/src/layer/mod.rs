//! Layers as candle custom ops with hand-written gradients: f32, CPU, channel-last.
//!
//! candle's own max-pool gradient is wrong (scaled by the share of maxima in a window) and its convolution backward
//! pass several times slower than it need be, so what the networks here are made of is written out:
//! - [`conv_relu_pool`]: 3x3 convolution, ReLU and 2x2 max-pooling in one pass. Only the winner of each pooling window
//!   has a gradient, so the backward pass does a quarter of the dense work or less, and the convolution's output never
//!   touches memory.
//! - [`adaptive_average_pool`], [`linear`], [`circuit_of`], [`cross_entropy`].
//!
//! - [`conv2d`] (dense, pointwise, depthwise), [`batch_norm`] with its activation, [`max_pool2d`], [`add_relu`],
//!   [`scale_channels`], [`dropout`], [`activation`]: what the larger networks are made of. Dense products read maps where
//!   they are, through addresses of cells (`sweep.rs`), a tile of sums in registers at a time (`tile.rs`).
//! - [`PreparedConv`], [`PreparedBlock`], [`PreparedDense`] and [`Feature`]: the same without gradients, with batch norm folded in and buffers used
//!   again; 3x3 convolutions go by windows of cells (`winograd.rs`), and threads stay awake from layer to layer (`crew.rs`).
//! - [`descriptors`]: plain numbers of a map, without parameters or gradients.
//! - [`backward`]: candle's backward pass without its copies.
//!
//! All run in parallel over the batch (or over outputs) and reduce in a fixed order: the same bits for any number of
//! threads. [`mod@reference`] holds the slow obvious versions.

mod activation;
mod apart;
mod average_pool;
mod backward;
mod batch_norm;
mod circuit;
mod conv2d;
mod conv_relu_pool;
mod crew;
mod cross_entropy;
mod depthwise;
mod descriptors;
mod drop_samples;
mod dropout;
mod inference;
mod kernel;
mod level;
mod linear;
mod max_pool;
mod operation;
mod packed;
mod prepared_block;
mod prepared_dense;
pub mod reference;
mod scale_channels;
mod squash;
mod standardise;
mod sum;
mod sweep;
#[cfg(test)]
mod tests;
mod tile;
mod trigonometric;
mod vector;
mod weight_gradient;
mod window;
mod winograd;

pub use activation::{Activation, activation, add_relu};
pub use average_pool::adaptive_average_pool;
pub(crate) use average_pool::bin;
pub use backward::backward;
pub use batch_norm::{BatchNormConstants, BatchNormMode, RunningStatistics, batch_norm};
pub use circuit::{circuit, circuit_of, circuit_of_call};
pub use conv_relu_pool::{InputGradient, conv_relu_pool};
pub use conv2d::{ConvGeometry, conv2d};
pub(crate) use crew::{Crew, for_each_chunk};
pub use cross_entropy::cross_entropy;
pub(crate) use cross_entropy::softmax;
pub use descriptors::{DESCRIPTORS, descriptors, map_descriptors};
pub use drop_samples::drop_samples;
pub use dropout::dropout;
pub use inference::{Affine, Feature, PreparedConv};
pub use level::KernelLevel;
pub use linear::linear;
pub use max_pool::max_pool2d;
pub use prepared_block::PreparedBlock;
pub use prepared_dense::PreparedDense;
pub use scale_channels::scale_channels;
pub use squash::squash;
pub(crate) use squash::squashed;
pub use standardise::standardise;
pub use sum::{add, concatenate};
pub(crate) use trigonometric::features as trigonometric_features;
pub use trigonometric::trigonometric;

use candle_core::{CpuStorage, DType, Error, Layout, Result, Storage, Tensor};

/// The f32 values of a contiguous CPU tensor, or an error that names the layer.
fn values<'a>(layer: &'static str, storage: &'a CpuStorage, layout: &Layout) -> Result<&'a [f32]> {
    let CpuStorage::F32(data) = storage else {
        return Err(Error::UnsupportedDTypeForOp(storage_dtype(storage), layer).bt());
    };
    let Some((start, end)) = layout.contiguous_offsets() else {
        return Err(Error::RequiresContiguous { op: layer }.bt());
    };
    data.get(start..end).ok_or_else(|| Error::Msg(format!("{layer}: layout {start}..{end} exceeds storage")).bt())
}

fn storage_dtype(storage: &CpuStorage) -> DType {
    use candle_core::backend::BackendStorage;
    storage.dtype()
}

/// Runs `f` on the f32 values of a tensor, made contiguous first if need be.
pub(crate) fn with_values<R>(layer: &'static str, tensor: &Tensor, f: impl FnOnce(&[f32]) -> Result<R>) -> Result<R> {
    let tensor = tensor.contiguous()?;
    let (storage, layout) = tensor.storage_and_layout();
    match &*storage {
        Storage::Cpu(cpu) => f(values(layer, cpu, layout)?),
        _ => candle_core::bail!("{layer}: tensor is not on the CPU"),
    }
}
