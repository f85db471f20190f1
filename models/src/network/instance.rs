//! A network and its numbers.

use std::collections::BTreeMap;

use candle_core::Result;
use thiserror::Error;

use super::graph::{Graph, Layer, Value};
use super::kind::NetworkKind;
use super::names;
use super::parameters::{Normalisation, Parameter, Parameters};
use super::spec::NetworkSpec;
use crate::kernel::KernelLevel;

/// Error: a network has no layer of a name that training or adaptation looks for.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error(
    "{network} has no layer named {layer}\n\nhint: name its layers as models/src/network/names.rs says, or correct \
     NetworkKind::has_latent and reads_descriptors"
)]
pub struct MissingLayer {
    /// The network.
    pub network: NetworkKind,
    /// The name.
    pub layer: &'static str,
}

/// Network with its numbers.
pub struct Network {
    spec: NetworkSpec,
    graph: Graph,
    parameters: Parameters,
    level: KernelLevel,
}

impl Network {
    /// Builds a network with random parameters, which are a function of seed, name of the array and attempt.
    ///
    /// # Errors
    /// A tensor operation failed.
    pub fn initialise(spec: &NetworkSpec, seed: u64, attempt: u64, level: KernelLevel) -> Result<Self> {
        let graph = spec.graph();
        let parameters = Parameters::initialise(&graph, seed, attempt)?;
        Ok(Network { spec: spec.clone(), graph, parameters, level: level.available() })
    }

    /// Builds a network with these numbers, with names and lengths of [`NetworkSpec::layout`].
    ///
    /// # Errors
    /// An array is missing or has another length.
    pub fn from_values(spec: &NetworkSpec, values: &BTreeMap<String, Vec<f32>>, level: KernelLevel) -> Result<Self> {
        let graph = spec.graph();
        let parameters = Parameters::from_values(&graph, values)?;
        Ok(Network { spec: spec.clone(), graph, parameters, level: level.available() })
    }

    /// Settings of the network.
    pub fn spec(&self) -> &NetworkSpec {
        &self.spec
    }

    /// Instruction set of its inner loops.
    pub fn level(&self) -> KernelLevel {
        self.level
    }

    /// The same network with inner loops of this level, or of the fastest below it that the machine has.
    pub(crate) fn at_level(self, level: KernelLevel) -> Self {
        Network { level: level.available(), ..self }
    }

    /// Trained arrays in the order of the layers.
    pub fn trained(&self) -> &[Parameter] {
        self.parameters.list()
    }

    /// Arrays of a model file, by name.
    ///
    /// # Errors
    /// A tensor operation failed.
    pub fn values(&self) -> Result<BTreeMap<String, Vec<f32>>> {
        self.parameters.values(false)
    }

    /// Result of a layer that this network must have.
    ///
    /// # Errors
    /// The network has no layer of this name.
    pub(crate) fn value_of(&self, layer: &'static str) -> std::result::Result<Value, MissingLayer> {
        self.graph.value(layer).ok_or(MissingLayer { network: self.spec.kind, layer })
    }

    /// The value that [`Network::latent`] gives; `None` for networks without a latent.
    ///
    /// # Errors
    /// The network must have a latent and lacks the layer.
    pub(crate) fn raw_latent(&self) -> std::result::Result<Option<Value>, MissingLayer> {
        self.spec.kind.has_latent().then(|| self.value_of(names::LATENT_DENSE)).transpose()
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

    /// Constants that standardise the latent before `pi * sigmoid`; empty if it is not standardised.
    pub fn latent_constants(&self) -> Normalisation {
        self.parameters.normalisation(names::LATENT).cloned().unwrap_or_default()
    }

    /// Sets [`Network::latent_constants`].
    pub fn set_latent_constants(&mut self, constants: Normalisation) {
        self.parameters.set_normalisation(names::LATENT, constants);
    }

    /// Folds the normalisation of the features into the weights and the bias of the dense layer behind them.
    ///
    /// Averages of rectified values are all positive, with means far larger than the differences between maps, and descriptors have
    /// different units. Both make the dense layer behind them badly conditioned in training. The normalisation is a change of
    /// variables of that layer: the folded network computes the same function.
    ///
    /// # Errors
    /// No dense layer reads the features, or a tensor operation failed.
    pub fn fold_features(&mut self) -> Result<()> {
        let Some(normalisation) = self.parameters.normalisation(names::FEATURES).cloned() else { return Ok(()) };
        let dense = self.graph.value(names::FEATURES).and_then(|value| {
            self.graph.nodes.iter().find(|node| node.inputs == [value] && matches!(node.layer, Layer::Linear { .. }))
        });
        let Some(node) = dense else { candle_core::bail!("no dense layer reads the features") };
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
        self.parameters.set_normalisation(names::FEATURES, Normalisation::default());
        Ok(())
    }
}
