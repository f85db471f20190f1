//! Datasets of labelled range-Doppler maps, networks that count people in them, training and evaluation.
//!
//! This crate handles maps and labels. It does not depend on the source of the maps.
//!
//! "The paper" in this crate is Ratto et al., University of Waterloo, "Indoor Occupancy Classification using a Compact Hybrid
//! Quantum-Classical Model Enabled by a Physics-Informed Radar Digital Twin".
//!
//! # Examples
//! A network with random parameters classifies a map of zeros:
//! ```
//! use radome_models::layer::KernelLevel;
//! use radome_models::network::{Inference, Network, NetworkSpec};
//!
//! let spec = NetworkSpec::named("hqnn").expect("a name of `networks`");
//! let network = Network::initialise(&spec, 1, 0, KernelLevel::detect())?;
//! let logits = Inference::new(&network)?.logits(&[0.0; 64 * 64], [1, 64, 64])?.to_vec();
//! assert_eq!(logits.len(), 3);
//! # Ok::<(), candle_core::Error>(())
//! ```
//! A model is trained on a dataset and gives probabilities:
//! ```no_run
//! use std::path::Path;
//!
//! use radome_models::{Classifier, Dataset, TrainSpec, train};
//!
//! let dataset = Dataset::open(Path::new("dataset"))?;
//! let outcome = train(&dataset, &TrainSpec::default(), &mut |epoch| println!("{}", epoch.validation_loss))?;
//! outcome.model.save(Path::new("model.safetensors"))?;
//! let mut classifier = Classifier::load(Path::new("model.safetensors"))?;
//! let [empty, one, two] = classifier.classify_row(&dataset.map(0)?, dataset.header().shape, &dataset.rows()[0])?;
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # Conventions
//! - A network's input is one map, `[1][range][doppler]`: the transpose of [`radome_dsp::Rdm`]'s `[rx][doppler][range]`
//!   for one channel. Inside, feature maps are channel-last: `[batch][range][doppler][channel]`.
//! - Classes are [`radome_dsp::Occupancy`] in the order of its index.
//! - Every random draw is a function of (seed, purpose, index): results are bit-identical for any number of threads on
//!   the same kernel level ([`layer::KernelLevel`]).

#![warn(clippy::missing_errors_doc, clippy::missing_panics_doc)]

pub mod ablation;
mod array_hash;
mod atomic_file;
pub mod calibration;
pub mod dataset;
pub mod evaluate;
pub mod evidence_mean;
pub mod interval;
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

pub use dataset::Dataset;
pub use large_blocks::LargeBlocks;
pub use metrics::Metrics;
pub use model::{
    Classifier, ClassifyError, MODEL_FORMAT_VERSION, Model, ModelCard, ModelError, TrainingSummary, onnx, onnx_runtime,
};
pub use network::{NetworkInfo, NetworkSpec, networks};
pub use radome_files::MODEL_LIMIT_BYTES;
pub use random::stream;
pub use train::{
    CheckpointLock, EpochReport, TrainError, TrainOutcome, TrainSpec, train, train_with_checkpoint, training_warnings,
};

/// Returns whether a setting is the default, which files leave out.
pub(crate) fn is_default<T: Default + PartialEq>(value: &T) -> bool {
    *value == T::default()
}
