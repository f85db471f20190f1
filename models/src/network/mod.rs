//! Networks that count the people in a map.
//!
//! A network is a list of layers (`graph.rs`, with one file for each network) and its numbers (`parameters.rs`). `run.rs` runs the
//! list with gradients, [`Inference`] without. Some layers are found by their names (`names.rs`).

mod descriptor;
mod doppler_net;
mod efficientnet_b0;
mod graph;
mod hqnn;
mod inference;
mod instance;
mod kind;
pub(crate) mod names;
mod parameters;
mod resnet18;
mod run;
mod spec;
mod torchvision;

pub(crate) use graph::{INPUT, Layer, Node, Size, Value};
pub use hqnn::{Head, MOST_POOLED, PAPER_POOLED, Placement};
pub use inference::Inference;
pub use instance::{MissingLayer, Network};
pub use kind::{NetworkKind, UnreadableMaps};
pub use parameters::{Normalisation, Parameter};
pub use run::{Mode, Values};
pub use spec::{NetworkInfo, NetworkSpec, networks};
pub use torchvision::{TorchvisionWeights, WeightsError};

#[cfg(test)]
mod tests;
