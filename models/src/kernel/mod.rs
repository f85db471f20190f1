//! Inner loops of the layers: SIMD vectors, tiles of sums in registers, convolution algorithms, and threads.
//!
//! This module does not depend on tensors and networks. Every loop is compiled for each [`KernelLevel`] and sums in a fixed order.
//! Results have the same bits for any number of threads.

mod affinity;
pub(crate) mod buffer;
pub(crate) mod conv_pool;
pub(crate) mod depthwise;
pub(crate) mod implicit_gemm;
pub(crate) mod level;
pub(crate) mod packed;
pub(crate) mod spin_pool;
pub(crate) mod tile;
mod vector;
pub(crate) mod weight_gradient;
pub(crate) mod winograd;
pub(crate) mod winograd_gradient;
mod winograd_transform;
mod winograd_weights;

pub use level::KernelLevel;
