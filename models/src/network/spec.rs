//! Settings that decide a network's layers, and the networks that have a name.

use serde::{Deserialize, Serialize};

use super::graph::{Graph, Node};
use super::hqnn::{Head, PAPER_POOLED, Placement};
use super::kind::NetworkKind;
use super::{descriptor, doppler_net, efficientnet_b0, hqnn, parameters, resnet18};

/// Settings that decide a network's layers.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct NetworkSpec {
    /// Kind of the network.
    pub kind: NetworkKind,
    /// Rows and columns that the HQNN's second block is averaged to; ignored by other kinds.
    pub pooled: [usize; 2],
    /// Layers behind the latent of the HQNN or of descriptors; ignored by other kinds.
    pub head: Head,
}

impl NetworkSpec {
    /// The paper's HQNN with another head.
    pub fn with_head(head: Head) -> Self {
        NetworkSpec { kind: NetworkKind::Hqnn, pooled: PAPER_POOLED, head }
    }

    /// Finds a network by its name, one of [`networks`].
    pub fn named(name: &str) -> Option<Self> {
        named_specs().into_iter().find(|(known, _)| known == name).map(|(_, spec)| spec)
    }

    /// Names and shapes of the arrays in a model file, in order.
    pub fn layout(&self) -> Vec<(String, Vec<usize>)> {
        parameters::layout(&self.graph())
    }

    /// Number of trained parameters. Frozen angles are none.
    pub fn parameter_count(&self) -> usize {
        let graph = self.graph();
        let trained = graph.nodes.iter().filter(|node| !node.is_frozen()).flat_map(Node::declarations);
        let saved = trained.filter(|declaration| !parameters::is_transient(&declaration.name));
        saved.map(|declaration| declaration.shape.iter().product::<usize>()).sum()
    }

    /// Multiply-adds of one map of `range x doppler` bins; 0 where the map is too small for the network. Descriptors count as five sums
    /// over cells and the correlations of noise.
    pub fn multiply_adds(&self, range: usize, doppler: usize) -> u64 {
        let descriptors = if self.kind.reads_descriptors() { 17 * range * doppler } else { 0 };
        descriptors as u64 + self.graph().multiply_adds(self.kind.input_size([range, doppler]))
    }

    /// Name of the first layer that maps of `range x doppler` bins are too small for, if there is one.
    pub fn too_small_for(&self, range: usize, doppler: usize) -> Option<String> {
        self.graph().sizes(self.kind.input_size([range, doppler])).err().map(|node| node.name.clone())
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

/// Networks with their names, as commands and studies spell them: each kind with the paper's head, and the HQNN with other heads.
pub(super) fn named_specs() -> Vec<(String, NetworkSpec)> {
    let frozen = Head::Circuit { circuit: Default::default(), frozen: true, placement: Placement::Latent };
    let heads = [
        ("estimator_matched", Head::Linear),
        ("dequantization", Head::Dequantization),
        ("squashed_linear", Head::SquashedLinear),
        ("squashed_dequantization", Head::SquashedDequantization),
        ("trigonometric", Head::Trigonometric),
        ("frozen_angles", frozen),
    ];
    let with_head = |(name, head): (&str, Head)| (name.to_owned(), NetworkSpec::with_head(head));
    let with_kind =
        |kind: NetworkKind| (kind.to_string(), NetworkSpec { kind, pooled: PAPER_POOLED, head: Head::default() });
    let others = NetworkKind::ALL.into_iter().filter(|kind| *kind != NetworkKind::Hqnn);
    let hqnns = std::iter::once(with_kind(NetworkKind::Hqnn)).chain(heads.map(with_head));
    hqnns.chain(others.map(with_kind)).collect()
}

/// Name, size and cost of a network.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct NetworkInfo {
    /// Name, as commands and studies spell it.
    pub name: String,
    /// Number of trained parameters.
    pub parameters: usize,
    /// Multiply-adds of one map of the size `input`.
    pub multiply_adds: u64,
    /// `[channel][range][doppler]` that `multiply_adds` is for; other sizes work too.
    pub input: [usize; 3],
}

/// All networks and heads of the paper, of its fair controls, and the plain classifiers of descriptors.
pub fn networks() -> Vec<NetworkInfo> {
    let info = |(name, spec): (String, NetworkSpec)| NetworkInfo {
        name,
        parameters: spec.parameter_count(),
        multiply_adds: spec.multiply_adds(128, 128),
        input: [1, 128, 128],
    };
    named_specs().into_iter().map(info).collect()
}
