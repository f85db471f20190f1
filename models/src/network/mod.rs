//! Networks that tell how many people a map shows.
//!
//! A network is a list of layers (`graph.rs`, one file a network) and the numbers that go with it (`parameters.rs`).
//! `run.rs` runs the list with gradients, [`Inference`] without.

mod descriptor;
mod doppler_net;
mod efficientnet_b0;
mod graph;
mod hqnn;
mod inference;
mod parameters;
mod resnet18;
mod run;
mod torchvision;

use std::collections::BTreeMap;

use candle_core::{Result, Tensor};
use serde::{Deserialize, Serialize};

pub use descriptor::UnreadableMaps;
pub(crate) use graph::{Graph, INPUT, Layer, Node, Size, Value};
pub use hqnn::{Head, MOST_POOLED, PAPER_POOLED, Placement};
pub use inference::Inference;
pub use parameters::{Normalisation, Parameter};
pub use run::{Mode, Values};
pub use torchvision::{TorchvisionWeights, WeightsError};

use crate::layer::{KernelLevel, with_values};
use parameters::Parameters;

/// Which network.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum NetworkKind {
    /// The paper's backbone of two convolutions and a narrow latent, with a [`Head`].
    #[default]
    Hqnn,
    /// Five convolution blocks, three dense layers.
    DopplerNet,
    /// ResNet-18.
    #[serde(rename = "resnet18")]
    ResNet18,
    /// EfficientNet-B0 with a stem for one channel.
    #[serde(rename = "efficientnet_b0")]
    EfficientNetB0,
    /// EfficientNet-B0 with torchvision's stem, of which each of the three channels sees the map.
    #[serde(rename = "efficientnet_b0_rgb")]
    EfficientNetB0Rgb,
    /// Descriptors of a map ([`crate::layer::descriptors`]) and a linear head.
    DescriptorLinear,
    /// Descriptors of a map, a narrow latent and a [`Head`].
    DescriptorHqnn,
}

/// Everything that decides a network's layers.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct NetworkSpec {
    /// Which.
    pub kind: NetworkKind,
    /// Rows and columns that the HQNN's second block is averaged to; without meaning for the others.
    pub pooled: [usize; 2],
    /// What stands behind the latent of the HQNN or of descriptors; without meaning for the others.
    pub head: Head,
}

impl NetworkSpec {
    /// The paper's HQNN with another head.
    pub fn with_head(head: Head) -> Self {
        NetworkSpec { kind: NetworkKind::Hqnn, pooled: PAPER_POOLED, head }
    }

    /// A network by its name: those of [`networks`].
    pub fn named(name: &str) -> Option<Self> {
        named().into_iter().find(|(known, _)| *known == name).map(|(_, spec)| spec)
    }

    /// Names and shapes of what a model file holds, in order.
    pub fn layout(&self) -> Vec<(String, Vec<usize>)> {
        parameters::layout(&self.graph())
    }

    /// Trained numbers.
    pub fn parameter_count(&self) -> usize {
        let declared = self.graph().declarations();
        let kept = declared.iter().filter(|declaration| !declaration.name.starts_with("warm_up."));
        kept.map(|declaration| declaration.shape.iter().product::<usize>()).sum()
    }

    /// Multiply-adds of one map of `range x doppler` bins; 0 where the map is too small for the network.
    pub fn multiply_adds(&self, range: usize, doppler: usize) -> u64 {
        self.graph().multiply_adds(range, doppler)
    }

    /// The layer that maps of `range x doppler` bins are too small for, if there is one.
    pub fn too_small_for(&self, range: usize, doppler: usize) -> Option<String> {
        self.graph().sizes(range, doppler).err().map(|node| node.name.clone())
    }

    pub(crate) fn graph(&self) -> Graph {
        match self.kind {
            NetworkKind::Hqnn => hqnn::graph(self.pooled, &self.head),
            NetworkKind::DopplerNet => doppler_net::graph(),
            NetworkKind::ResNet18 => resnet18::graph(),
            NetworkKind::EfficientNetB0 => efficientnet_b0::graph(1),
            NetworkKind::EfficientNetB0Rgb => efficientnet_b0::graph(3),
            NetworkKind::DescriptorLinear => descriptor::linear(),
            NetworkKind::DescriptorHqnn => descriptor::hqnn(&self.head),
        }
    }
}

fn named() -> Vec<(&'static str, NetworkSpec)> {
    let head = NetworkSpec::with_head;
    let kind = |kind| NetworkSpec { kind, pooled: PAPER_POOLED, head: Head::default() };
    let circuit = |frozen| Head::Circuit { circuit: Default::default(), frozen, placement: Placement::Latent };
    vec![
        ("hqnn", head(Head::default())),
        ("estimator_matched", head(Head::Linear)),
        ("dequantization", head(Head::Dequantization)),
        ("squashed_linear", head(Head::SquashedLinear)),
        ("squashed_dequantization", head(Head::SquashedDequantization)),
        ("trigonometric", head(Head::Trigonometric)),
        ("frozen_angles", head(circuit(true))),
        ("doppler_net", kind(NetworkKind::DopplerNet)),
        ("resnet18", kind(NetworkKind::ResNet18)),
        ("efficientnet_b0", kind(NetworkKind::EfficientNetB0)),
        ("efficientnet_b0_rgb", kind(NetworkKind::EfficientNetB0Rgb)),
        ("descriptor_linear", kind(NetworkKind::DescriptorLinear)),
        ("descriptor_hqnn", kind(NetworkKind::DescriptorHqnn)),
    ]
}

/// What a network is and costs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct NetworkInfo {
    /// Name, as commands and studies spell it.
    pub name: String,
    /// Trained numbers.
    pub parameters: usize,
    /// Multiply-adds of one map of the size `input`.
    pub multiply_adds: u64,
    /// `[channel][range][doppler]` that `multiply_adds` is for; other sizes work too.
    pub input: [usize; 3],
}

/// All networks and heads of the paper, of its fair controls, and the plain classifiers of descriptors.
pub fn networks() -> Vec<NetworkInfo> {
    let info = |(name, spec): (&str, NetworkSpec)| NetworkInfo {
        name: name.to_owned(),
        parameters: spec.parameter_count(),
        multiply_adds: spec.multiply_adds(128, 128),
        input: [1, 128, 128],
    };
    named().into_iter().map(info).collect()
}

/// A network and its numbers.
pub struct Network {
    spec: NetworkSpec,
    graph: Graph,
    parameters: Parameters,
    level: KernelLevel,
}

impl Network {
    /// A network with random parameters: functions of seed, name of the array and attempt.
    ///
    /// # Errors
    /// A tensor operation failed.
    pub fn initialise(spec: &NetworkSpec, seed: u64, attempt: u64, level: KernelLevel) -> Result<Self> {
        let graph = spec.graph();
        let parameters = Parameters::initialise(&graph, seed, attempt)?;
        Ok(Network { spec: spec.clone(), graph, parameters, level: level.available() })
    }

    /// A network with these numbers, named and as long as [`NetworkSpec::layout`] says.
    ///
    /// # Errors
    /// An array is missing or has another length.
    pub fn from_values(spec: &NetworkSpec, values: &BTreeMap<String, Vec<f32>>, level: KernelLevel) -> Result<Self> {
        let graph = spec.graph();
        let parameters = Parameters::from_values(&graph, values)?;
        Ok(Network { spec: spec.clone(), graph, parameters, level: level.available() })
    }

    /// What it is.
    pub fn spec(&self) -> &NetworkSpec {
        &self.spec
    }

    /// Instructions of its inner loops.
    pub fn level(&self) -> KernelLevel {
        self.level
    }

    /// Trained arrays in the order of the layers.
    pub fn trained(&self) -> &[Parameter] {
        self.parameters.list()
    }

    /// Everything that travels with a model, by name.
    ///
    /// # Errors
    /// A tensor operation failed.
    pub fn values(&self) -> Result<BTreeMap<String, Vec<f32>>> {
        self.parameters.values(false)
    }

    /// Logits `[batch][3]` for standardised maps `[batch][range][doppler]`.
    ///
    /// Prepares an [`Inference`] for this one call; whoever calls often prepares one and keeps it.
    ///
    /// # Errors
    /// `input` has another number of axes or is not f32 on the CPU, or a layer cannot read maps of this size.
    pub fn logits(&self, input: &Tensor) -> Result<Tensor> {
        let (batch, range, doppler) = input.dims3()?;
        let mut inference = Inference::new(self)?;
        let logits =
            with_values("network", input, |maps| Ok(inference.logits(maps, [batch, range, doppler])?.to_vec()))?;
        let classes = logits.len() / batch.max(1);
        Tensor::from_vec(logits, (batch, classes), input.device())
    }

    /// The latent before its standardisation, `[batch][width]`; nothing for networks without one.
    ///
    /// # Errors
    /// `input` has another number of axes or is not f32 on the CPU, or a layer cannot read maps of this size.
    pub fn latent(&self, input: &Tensor) -> Result<Option<Tensor>> {
        match self.raw_latent() {
            Some(value) => Ok(Some(self.run(input, value, Mode::Evaluation)?.take(value)?)),
            None => Ok(None),
        }
    }

    /// The value that [`Network::latent`] gives, where there is one.
    pub(crate) fn raw_latent(&self) -> Option<Value> {
        self.graph.value("fc2").filter(|_| self.spec.kind.has_latent())
    }

    pub(crate) fn graph(&self) -> &Graph {
        &self.graph
    }

    pub(crate) fn parameters(&self) -> &Parameters {
        &self.parameters
    }

    pub(crate) fn parameters_mut(&mut self) -> &mut Parameters {
        &mut self.parameters
    }

    /// Constants that standardise the latent before the squash; empty where it is left as it is.
    pub fn latent_constants(&self) -> Normalisation {
        self.parameters.normalisation("latent").cloned().unwrap_or_default()
    }

    /// Sets [`Network::latent_constants`].
    pub fn set_latent_constants(&mut self, constants: Normalisation) {
        self.parameters.set_normalisation("latent", constants);
    }

    /// Moves the centring and scaling of the features into the weights and the bias of the dense layer behind them.
    ///
    /// Averages of rectified values are all positive, with means far larger than what distinguishes one map from another, and
    /// descriptors are in unlike units: either makes the dense layer behind them badly conditioned. Centring and scaling them is
    /// a change of variables of that layer, so that a network without it is the same network.
    ///
    /// # Errors
    /// No dense layer reads the features, or a tensor operation failed.
    pub fn fold_features(&mut self) -> Result<()> {
        let Some(normalisation) = self.parameters.normalisation("features").cloned() else { return Ok(()) };
        let behind = self.graph.value("features").and_then(|value| {
            self.graph.nodes.iter().find(|node| node.inputs == [value] && matches!(node.layer, Layer::Linear { .. }))
        });
        let Some(node) = behind else { candle_core::bail!("no dense layer reads the features") };
        let [weight_name, bias_name] = ["weight", "bias"].map(|what| format!("{}.{what}", node.name));
        let mut weight = self.parameters.numbers(&weight_name)?;
        let mut bias = self.parameters.numbers(&bias_name)?;
        for (row, bias) in weight.chunks_exact_mut(normalisation.mean.len().max(1)).zip(&mut bias) {
            let mut shift = 0.0f64;
            for ((w, sigma), mean) in row.iter_mut().zip(&normalisation.sigma).zip(&normalisation.mean) {
                *w /= sigma;
                shift += f64::from(*w) * f64::from(*mean);
            }
            *bias -= shift as f32;
        }
        self.parameters.set_numbers(&weight_name, &weight)?;
        self.parameters.set_numbers(&bias_name, &bias)?;
        self.parameters.set_normalisation("features", Normalisation::default());
        Ok(())
    }
}

#[cfg(test)]
mod tests;
