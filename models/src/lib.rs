//! Datasets of labelled range-Doppler maps, networks that count people in them, training and evaluation.
//!
//! This crate knows maps and labels, never where they came from.
//!
//! What flows: [`dataset::Dataset`] -> [`train::train`] -> model file -> [`Classifier`] -> probabilities.
//!
//! # Conventions
//! - A network's input is one map, `[1][range][doppler]`: the transpose of [`radome_dsp::Rdm`]'s `[rx][doppler][range]`
//!   for one channel. Inside, feature maps are channel-last: `[batch][range][doppler][channel]`.
//! - Classes are [`radome_dsp::Occupancy`] in the order of its index.
//! - Every random draw is a function of (seed, purpose, index): results are bit-identical for any number of threads on
//!   the same kernel level ([`layer::KernelLevel`]).

#![warn(clippy::missing_errors_doc, clippy::missing_panics_doc)]

pub mod ablation;
pub mod bounded_file;
pub mod calibration;
pub mod dataset;
pub mod evaluate;
mod kernel;
mod large_blocks;
pub mod layer;
pub mod metrics;
pub mod model;
pub mod network;
pub mod occupancy_filter;
pub mod quantum;
mod random;
pub mod standardise;
pub mod study;
pub mod train;
mod whole_file;

pub use bounded_file::MODEL_LIMIT_BYTES;
pub use dataset::Dataset;
pub use large_blocks::LargeBlocks;
pub use metrics::Metrics;
pub use model::{
    Classifier, ClassifyError, MODEL_FORMAT_VERSION, Model, ModelCard, ModelError, TrainingSummary, onnx, onnx_runtime,
};
pub use network::{NetworkInfo, NetworkSpec, networks};
pub use random::stream;
pub use train::{EpochReport, TrainError, TrainOutcome, TrainSpec, train, train_with_checkpoint};
