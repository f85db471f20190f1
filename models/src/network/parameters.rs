//! Numbers of a network: trained arrays, running statistics of batch normalisations, and constants of normalisations.

use std::collections::{BTreeMap, HashMap};

use candle_core::{Device, Result, Tensor, Var};
use rand::Rng;
use rand_distr::{Distribution, Normal};
use serde::{Deserialize, Serialize};

use super::graph::{Declaration, Graph, Initialisation, Layer};
use super::names;
use crate::layer::{BatchNormConstants, RunningStatistics};
use crate::random::stream;

/// Normalisation of a vector by constants: `(x - mean) / sigma`, element by element. Empty constants change nothing.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Normalisation {
    /// Mean, which is subtracted.
    pub mean: Vec<f32>,
    /// Divisor.
    pub sigma: Vec<f32>,
}

/// One trained array.
pub struct Parameter {
    /// Name in files: the name of the layer and the kind of the array.
    pub name: String,
    /// Values of the array.
    pub variable: Var,
}

/// All numbers of a network.
pub(crate) struct Parameters {
    list: Vec<Parameter>,
    index: HashMap<String, usize>,
    statistics: BTreeMap<String, RunningStatistics>,
    normalisations: BTreeMap<String, Normalisation>,
}

/// Names of the arrays that a batch normalisation keeps besides its parameters, as in PyTorch.
const RUNNING: [&str; 2] = ["running_mean", "running_var"];

/// Returns whether an array exists only in training.
pub(super) fn is_transient(name: &str) -> bool {
    names::layer_of(name) == names::WARM_UP
}

impl Parameters {
    /// Random parameters, each a function of seed, name and attempt.
    ///
    /// # Errors
    /// A tensor operation failed.
    pub fn initialise(graph: &Graph, seed: u64, attempt: u64) -> Result<Self> {
        let start = |declaration: &Declaration, count: usize| {
            let mut rng = stream(seed, &declaration.name, attempt);
            Ok::<Vec<f32>, candle_core::Error>(match declaration.initialisation {
                Initialisation::Uniform(bound) => (0..count).map(|_| rng.random_range(-bound..bound)).collect(),
                Initialisation::Normal(sigma) => {
                    let normal = Normal::new(0.0f32, sigma).map_err(candle_core::Error::wrap)?;
                    (0..count).map(|_| normal.sample(&mut rng)).collect()
                }
                Initialisation::Constant(value) => vec![value; count],
            })
        };
        Self::build(graph, start)
    }

    /// Loads parameters by name. Arrays that only training needs may be missing.
    ///
    /// # Errors
    /// An array is missing or has another length.
    pub fn from_values(graph: &Graph, values: &BTreeMap<String, Vec<f32>>) -> Result<Self> {
        let parameters = Self::build(graph, |_, count| Ok(vec![0.0; count]))?;
        parameters.set_values(values)?;
        Ok(parameters)
    }

    /// Builds parameters, with values from `start(declaration, number of values)`.
    fn build(graph: &Graph, start: impl Fn(&Declaration, usize) -> Result<Vec<f32>>) -> Result<Self> {
        let mut list = Vec::new();
        for declaration in graph.declarations() {
            let values = start(&declaration, declaration.shape.iter().product())?;
            let variable = Var::from_tensor(&Tensor::from_vec(values, declaration.shape, &Device::Cpu)?)?;
            list.push(Parameter { name: declaration.name, variable });
        }
        let index = list.iter().enumerate().map(|(k, parameter)| (parameter.name.clone(), k)).collect();
        let statistics = graph
            .batch_norms()
            .map(|(name, channels)| (name.to_owned(), RunningStatistics::new(channels, BatchNormConstants::default())))
            .collect();
        Ok(Parameters { list, index, statistics, normalisations: BTreeMap::new() })
    }

    /// Trained arrays in the order of the layers.
    pub fn list(&self) -> &[Parameter] {
        &self.list
    }

    /// The array of this name.
    ///
    /// # Errors
    /// There is no array of this name.
    pub fn get(&self, name: &str) -> Result<&Tensor> {
        match self.index.get(name).and_then(|&index| self.list.get(index)) {
            Some(parameter) => Ok(parameter.variable.as_tensor()),
            None => candle_core::bail!("there is no parameter {name}"),
        }
    }

    /// Running statistics of a batch normalisation.
    ///
    /// # Errors
    /// There is no batch normalisation of this name.
    pub fn statistics(&self, name: &str) -> Result<&RunningStatistics> {
        match self.statistics.get(name) {
            Some(statistics) => Ok(statistics),
            None => candle_core::bail!("there is no batch normalisation {name}"),
        }
    }

    /// Constants of a standardisation; `None` if values stay as they are.
    pub fn normalisation(&self, name: &str) -> Option<&Normalisation> {
        self.normalisations.get(name)
    }

    /// Sets the constants of a standardisation; empty ones remove them.
    pub fn set_normalisation(&mut self, name: &str, normalisation: Normalisation) {
        if normalisation.mean.is_empty() {
            self.normalisations.remove(name);
        } else {
            self.normalisations.insert(name.to_owned(), normalisation);
        }
    }

    /// Copy of an array's numbers.
    ///
    /// # Errors
    /// There is no array of this name.
    pub fn numbers(&self, name: &str) -> Result<Vec<f32>> {
        self.get(name)?.flatten_all()?.to_vec1()
    }

    /// Overwrites an array's numbers.
    ///
    /// # Errors
    /// There is no array of this name, or it has another length.
    pub fn set_numbers(&self, name: &str, values: &[f32]) -> Result<()> {
        let Some(parameter) = self.index.get(name).and_then(|&index| self.list.get(index)) else {
            candle_core::bail!("there is no parameter {name}");
        };
        let shape = parameter.variable.shape();
        parameter.variable.set(&Tensor::from_slice(values, shape, &Device::Cpu)?)
    }

    /// Copies of the arrays of a model file, by name; with `all`, also of the arrays that only training needs.
    ///
    /// # Errors
    /// A tensor operation failed.
    pub fn values(&self, all: bool) -> Result<BTreeMap<String, Vec<f32>>> {
        let mut values = BTreeMap::new();
        for Parameter { name, variable } in &self.list {
            if all || !is_transient(name) {
                values.insert(name.clone(), variable.flatten_all()?.to_vec1()?);
            }
        }
        for (name, statistics) in &self.statistics {
            let arrays = [statistics.mean(), statistics.variance()];
            values.extend(RUNNING.iter().zip(arrays).map(|(what, array)| (format!("{name}.{what}"), array)));
        }
        Ok(values)
    }

    /// Overwrites all arrays by the result of an earlier [`Parameters::values`].
    ///
    /// # Errors
    /// An array is missing or has another length.
    pub fn set_values(&self, values: &BTreeMap<String, Vec<f32>>) -> Result<()> {
        for Parameter { name, variable } in &self.list {
            match values.get(name) {
                Some(numbers) if numbers.len() == variable.elem_count() => self.set_numbers(name, numbers)?,
                Some(numbers) => {
                    candle_core::bail!("parameter {name} has {} values, expected {:?}", numbers.len(), variable.dims());
                }
                None if is_transient(name) => {}
                None => candle_core::bail!("parameter {name} {:?} is missing", variable.dims()),
            }
        }
        self.set_statistics(values)
    }

    fn set_statistics(&self, values: &BTreeMap<String, Vec<f32>>) -> Result<()> {
        for (name, statistics) in &self.statistics {
            let [mean, variance] = RUNNING.map(|what| values.get(&format!("{name}.{what}")));
            let (Some(mean), Some(variance)) = (mean, variance) else {
                candle_core::bail!("running statistics of {name} are missing");
            };
            statistics.set(mean.clone(), variance.clone())?;
        }
        Ok(())
    }
}

/// Names and shapes of the arrays that are saved with a model, in the order of files.
pub(crate) fn layout(graph: &Graph) -> Vec<(String, Vec<usize>)> {
    let mut layout = Vec::new();
    for node in &graph.nodes {
        let kept = node.declarations().into_iter().filter(|declaration| !is_transient(&declaration.name));
        layout.extend(kept.map(|declaration| (declaration.name, declaration.shape)));
        if let Layer::BatchNorm { channels, .. } = node.layer {
            layout.extend(RUNNING.map(|what| (format!("{}.{what}", node.name), vec![channels])));
        }
    }
    layout
}
