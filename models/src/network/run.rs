//! Running a network's layers one after the other, with gradients.

use candle_core::{Result, Tensor};

use super::graph::{Graph, INPUT, Layer, Node, Value};
use super::instance::Network;
use super::parameters::Normalisation;
use crate::layer::{
    BatchNormMode, InputGradient, activation, adaptive_average_pool, add, add_relu, batch_norm, circuit, concatenate,
    conv_relu_pool, conv2d, drop_samples, dropout, linear, max_pool2d, scale_channels, scaled_sigmoid, standardise,
    trigonometric,
};
use crate::quantum::Circuit;

/// Purpose of a run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Mode {
    /// Gradients, statistics of the batch, and dropout that is a function of seed and step.
    Training {
        /// Seed of the training.
        seed: u64,
        /// Number of the step.
        step: u64,
        /// Weight in the loss of the mean square of the input of [`crate::layer::scaled_sigmoid`]; only its gradient is computed.
        penalty: f32,
    },
    /// Running statistics, nothing dropped, no gradients.
    Evaluation,
}

/// Outputs of the layers that have run.
pub struct Values<'a> {
    graph: &'a Graph,
    tensors: Vec<Option<Tensor>>,
}

impl Values<'_> {
    /// Takes a result that was requested.
    pub(crate) fn take(&mut self, value: Value) -> Result<Tensor> {
        match self.tensors.get_mut(value).and_then(Option::take) {
            Some(tensor) => Ok(tensor),
            None => candle_core::bail!("value {value} was not computed"),
        }
    }

    /// A result that was requested, or any result of a training run.
    pub(crate) fn get(&self, value: Value) -> Result<&Tensor> {
        match self.tensors.get(value) {
            Some(Some(tensor)) => Ok(tensor),
            _ => candle_core::bail!("value {value} was not computed"),
        }
    }

    /// Name of the first layer whose output holds a NaN or an infinity.
    ///
    /// # Errors
    /// A tensor operation failed.
    pub fn first_non_finite(&self) -> Result<Option<&str>> {
        for (node, tensor) in self.graph.nodes.iter().zip(self.tensors.iter().skip(1)) {
            if let Some(tensor) = tensor
                && tensor.flatten_all()?.to_vec1::<f32>()?.iter().any(|v| !v.is_finite())
            {
                return Ok(Some(&node.name));
            }
        }
        Ok(None)
    }
}

impl Network {
    /// The latent before its standardisation, `[batch][width]`; `None` for networks without one.
    ///
    /// # Errors
    /// `input` has another number of axes or is not f32 on the CPU, a layer cannot read maps of this size, or the layer of the
    /// latent is missing.
    pub fn latent(&self, input: &Tensor) -> Result<Option<Tensor>> {
        match self.raw_latent().map_err(candle_core::Error::wrap)? {
            Some(value) => Ok(Some(self.run(input, value, Mode::Evaluation)?.take(value)?)),
            None => Ok(None),
        }
    }

    /// Runs the layers that `wanted` needs on standardised maps `[batch][range][doppler]`, or on descriptors `[batch][1][descriptor]`.
    pub(crate) fn run(&self, input: &Tensor, wanted: Value, mode: Mode) -> Result<Values<'_>> {
        let input = input.unsqueeze(3)?;
        self.run_from(INPUT, &input, &[wanted], mode)
    }

    /// Runs the layers that `wanted` needs, from the value `given`, which is `tensor`.
    pub(crate) fn run_from(&self, given: Value, tensor: &Tensor, wanted: &[Value], mode: Mode) -> Result<Values<'_>> {
        let nodes = &self.graph().nodes;
        let needed = self.graph().needed(wanted, &[given]);
        let needed_nodes: Vec<(usize, &Node)> =
            nodes.iter().enumerate().zip(&needed).filter(|(_, needed)| **needed).map(|(node, _)| node).collect();
        // Without gradients, a value is dropped after its last reader.
        let mut last_reader = vec![usize::MAX; nodes.len() + 1];
        if mode == Mode::Evaluation {
            for &(index, node) in &needed_nodes {
                node.inputs.iter().for_each(|&input| last_reader[input] = index);
            }
            wanted.iter().for_each(|&value| last_reader[value] = usize::MAX);
        }
        let mut tensors: Vec<Option<Tensor>> = vec![None; nodes.len() + 1];
        tensors[given] = Some(tensor.clone());
        for &(index, node) in &needed_nodes {
            let result = self.layer(index, node, &tensors, mode).map_err(|error| error.context(node.name.clone()))?;
            tensors[index + 1] = Some(result);
            for &input in node.inputs.iter().filter(|&&input| last_reader[input] == index) {
                tensors[input] = None;
            }
        }
        Ok(Values { graph: self.graph(), tensors })
    }

    fn layer(&self, index: usize, node: &Node, tensors: &[Option<Tensor>], mode: Mode) -> Result<Tensor> {
        let level = self.level();
        let input = |k: usize| match node.inputs.get(k).and_then(|&value| tensors.get(value)) {
            Some(Some(tensor)) => Ok(tensor),
            _ => candle_core::bail!("input {k} was not computed"),
        };
        // Only variables have gradients; detached tensors have none.
        let parameter = |what: &str| {
            let tensor = self.parameters().get(&format!("{}.{what}", node.name))?;
            Ok::<Tensor, candle_core::Error>(if mode == Mode::Evaluation { tensor.detach() } else { tensor.clone() })
        };
        let input_gradient = if node.inputs == [INPUT] { InputGradient::Unused } else { InputGradient::Needed };
        let first = input(0)?;
        match &node.layer {
            Layer::Flatten => first.flatten_from(1),
            Layer::Repeat { channels } => first.repeat((1, 1, 1, *channels)),
            Layer::ConvReluPool { .. } => {
                conv_relu_pool(first, &parameter("weight")?, &parameter("bias")?, input_gradient, level)
            }
            Layer::Convolution { geometry, bias, .. } => {
                let bias = if *bias { Some(parameter("bias")?) } else { None };
                conv2d(first, &parameter("weight")?, bias.as_ref(), *geometry, input_gradient, level)
            }
            Layer::BatchNorm { activation, .. } => {
                let statistics = self.parameters().statistics(&node.name)?;
                let (weight, bias) = (parameter("weight")?, parameter("bias")?);
                let mode = if mode == Mode::Evaluation { BatchNormMode::Evaluation } else { BatchNormMode::Training };
                batch_norm(first, &weight, &bias, statistics, mode, *activation, level)
            }
            Layer::Activate(function) => activation(first, *function, level),
            Layer::MaxPool { kernel, stride, padding } => max_pool2d(first, *kernel, *stride, *padding, level),
            Layer::AveragePool { rows, columns } => adaptive_average_pool(first, *rows, *columns),
            Layer::Linear { .. } => linear(first, &parameter("weight")?, &parameter("bias")?, level),
            Layer::ScaleChannels => scale_channels(first, input(1)?),
            Layer::Add { rectified: true } => add_relu(first, input(1)?, level),
            Layer::Add { rectified: false } => add(first, input(1)?),
            Layer::Dropout { probability } => match mode {
                Mode::Evaluation => Ok(first.clone()),
                Mode::Training { seed, step, .. } => dropout(first, *probability, seed, mask(index, step)),
            },
            Layer::DropSamples { probability } => match mode {
                Mode::Evaluation => Ok(first.clone()),
                Mode::Training { seed, step, .. } => drop_samples(first, *probability, seed, mask(index, step)),
            },
            Layer::Standardise { .. } => match self.parameters().normalisation(&node.name) {
                None => Ok(first.clone()),
                Some(Normalisation { mean, sigma }) => standardise(first, mean, sigma),
            },
            Layer::ScaledSigmoid => {
                scaled_sigmoid(first, if let Mode::Training { penalty, .. } = mode { penalty } else { 0.0 })
            }
            Layer::Circuit { circuit: spec, .. } => {
                let built = Circuit::new(spec).map_err(candle_core::Error::wrap)?;
                let call = if let Mode::Training { step, .. } = mode { step } else { 0 };
                circuit(first, &parameter("theta")?, &built, call)
            }
            Layer::Trigonometric => trigonometric(first),
            Layer::Concatenate => concatenate(first, input(1)?),
        }
    }
}

/// Index of the random draw of a layer's mask in a step of a training.
fn mask(node: usize, step: u64) -> u64 {
    step.wrapping_mul(1 << 16) + node as u64
}
