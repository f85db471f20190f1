//! Layers of a network in the order in which they run. Training, inference, costs and ONNX read this list, so that they agree.

use super::names;
use crate::layer::{Activation, ConvGeometry};
use crate::quantum::CircuitSpec;

/// A value that flows through a network: 0 is the input `[batch][range][doppler][channel]`, `k` the result of node `k - 1`. The input of
/// a network of descriptors is `[batch][1][descriptor][1]`.
pub(crate) type Value = usize;
/// The input.
pub(crate) const INPUT: Value = 0;

/// One step of a network. Feature maps are `[batch][range][doppler][channel]`, vectors `[batch][feature]`.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Layer {
    /// All values of a feature map as a vector.
    Flatten,
    /// Copies of the map as channels.
    Repeat { channels: usize },
    /// 3x3 convolution with padding, ReLU and 2x2 max-pooling.
    ConvReluPool { inputs: usize, outputs: usize },
    /// Convolution with a square kernel.
    Convolution { inputs: usize, outputs: usize, kernel: usize, geometry: ConvGeometry, bias: bool },
    /// Batch normalisation of channels or features, then an activation.
    BatchNorm { channels: usize, activation: Activation },
    /// Activation, element by element.
    Activate(Activation),
    /// Largest value of windows.
    MaxPool { kernel: usize, stride: usize, padding: usize },
    /// Means over a grid of bins in range and Doppler, flattened channel-first: a vector.
    AveragePool { rows: usize, columns: usize },
    /// Fully connected layer.
    Linear { inputs: usize, outputs: usize },
    /// Product of a feature map with a vector that has a factor for each channel.
    ScaleChannels,
    /// Sum of two values, then perhaps a ReLU.
    Add { rectified: bool },
    /// Zeroes values at random while training, and scales the others up.
    Dropout { probability: f32 },
    /// Zeroes whole samples at random while training (stochastic depth, Huang et al., ECCV 2016), and scales the others up.
    DropSamples { probability: f32 },
    /// `(x - mean) / sigma` by constants that travel with the model or are folded into the layer behind.
    Standardise { width: usize },
    /// `pi * sigmoid(x)`: radians in (0, pi).
    ScaledSigmoid,
    /// Expectations of a quantum circuit at angles that are trained, or stay as they were drawn.
    Circuit { circuit: CircuitSpec, frozen: bool },
    /// The five features of which the two-qubit circuit is a linear combination (see [`crate::quantum`]).
    Trigonometric,
    /// Concatenation of two vectors.
    Concatenate,
}

/// Layer with its name and its inputs.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Node {
    /// Name of the layer, also the prefix of its parameters' names. Some have a meaning ([`names`]).
    pub name: String,
    pub layer: Layer,
    pub inputs: Vec<Value>,
}

/// Initial distribution of a parameter.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Initialisation {
    /// Uniform between minus and plus this value.
    Uniform(f32),
    /// Gaussian of this standard deviation.
    Normal(f32),
    /// Constant.
    Constant(f32),
}

/// Name, shape and initial distribution of a trained array.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Declaration {
    pub name: String,
    pub shape: Vec<usize>,
    pub initialisation: Initialisation,
}

/// A network's nodes in the order of running.
#[derive(Debug, Clone, PartialEq, Default)]
pub(crate) struct Graph {
    pub nodes: Vec<Node>,
    /// The logits.
    pub output: Value,
}

/// Size of a value for one map.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Size {
    Map { rows: usize, columns: usize, channels: usize },
    Vector(usize),
}

impl Graph {
    /// Adds a node that reads `inputs`. Returns its result.
    pub fn add(&mut self, name: impl Into<String>, layer: Layer, inputs: &[Value]) -> Value {
        self.nodes.push(Node { name: name.into(), layer, inputs: inputs.to_vec() });
        self.nodes.len()
    }

    /// Result of the node of this name, if there is one.
    pub fn value(&self, name: &str) -> Option<Value> {
        self.nodes.iter().position(|node| node.name == name).map(|index| index + 1)
    }

    /// Returns, for each node, whether it has to run to compute `wanted` from the values `given`.
    pub fn needed(&self, wanted: &[Value], given: &[Value]) -> Vec<bool> {
        let mut values = vec![false; self.nodes.len() + 1];
        for &value in wanted {
            if let Some(needed) = values.get_mut(value) {
                *needed = !given.contains(&value);
            }
        }
        for (index, node) in self.nodes.iter().enumerate().rev() {
            if values.get(index + 1) == Some(&true) {
                for &input in &node.inputs {
                    if let Some(needed) = values.get_mut(input) {
                        *needed |= !given.contains(&input);
                    }
                }
            }
        }
        values.into_iter().skip(1).collect()
    }

    /// Sizes of all values for an input of `rows x columns`.
    ///
    /// # Errors
    /// The first node that cannot read its input, because the map is too small for it or the shapes do not fit.
    pub fn sizes(&self, [rows, columns]: [usize; 2]) -> Result<Vec<Size>, &Node> {
        let mut sizes = vec![Size::Map { rows, columns, channels: 1 }];
        for node in &self.nodes {
            let input = |k: usize| node.inputs.get(k).and_then(|&value| sizes.get(value)).copied();
            let size = input(0).and_then(|first| node.layer.size(first, input(1))).ok_or(node)?;
            sizes.push(size);
        }
        Ok(sizes)
    }

    /// Multiply-adds of one input of this size; 0 where it is too small. Convolutions, dense layers and circuits are counted, as is
    /// usual; a circuit as the multiplications of its state vector.
    pub fn multiply_adds(&self, input: [usize; 2]) -> u64 {
        let Ok(sizes) = self.sizes(input) else { return 0 };
        let needed = self.needed(&[self.output], &[]);
        let nodes = self.nodes.iter().zip(sizes.windows(2)).zip(needed).filter(|(_, needed)| *needed);
        let count = |((node, _), _): ((&Node, &[Size]), bool)| {
            let input = node.inputs.first().and_then(|&value| sizes.get(value)).copied();
            let cells = |size: Option<Size>| match size {
                Some(Size::Map { rows, columns, .. }) => rows * columns,
                _ => 1,
            };
            match &node.layer {
                Layer::ConvReluPool { inputs, outputs } => 9 * inputs * outputs * cells(input),
                Layer::Convolution { inputs, outputs, kernel, geometry, .. } => {
                    let out = input.and_then(|input| node.layer.size(input, None));
                    kernel * kernel * inputs / geometry.groups.max(1) * outputs * cells(out)
                }
                Layer::Linear { inputs, outputs } => inputs * outputs,
                Layer::Circuit { circuit, .. } => state_vector_multiplications(circuit),
                Layer::Trigonometric => 5,
                _ => 0,
            }
        };
        nodes.map(count).sum::<usize>() as u64
    }

    /// Memory that a training step on `batch` inputs of this size takes at least, bytes; 0 where the input is too small. It
    /// holds the results of all layers, which the backward pass reads, and each parameter with its gradient and Adam's moments.
    pub fn least_training_bytes(&self, input: [usize; 2], batch: usize) -> u64 {
        let Ok(sizes) = self.sizes(input) else { return 0 };
        // These layers may return their input.
        let is_free = |layer: &Layer| {
            matches!(layer, Layer::Dropout { .. } | Layer::DropSamples { .. } | Layer::Standardise { .. })
        };
        let results = self.nodes.iter().zip(sizes.iter().skip(1)).filter(|(node, _)| !is_free(&node.layer));
        let cells = |size: &Size| match *size {
            Size::Map { rows, columns, channels } => rows * columns * channels,
            Size::Vector(width) => width,
        };
        let values_per_map: usize = results.map(|(_, size)| cells(size)).sum();
        let parameters: usize = self.declarations().iter().map(|d| d.shape.iter().product::<usize>()).sum();
        4 * (values_per_map as u64 * batch as u64 + 4 * parameters as u64)
    }

    /// All trained arrays, in the order of the nodes.
    pub fn declarations(&self) -> Vec<Declaration> {
        self.nodes.iter().flat_map(Node::declarations).collect()
    }

    /// Names and widths of the batch normalisations. Model files hold their running statistics beside the parameters.
    pub fn batch_norms(&self) -> impl Iterator<Item = (&str, usize)> {
        self.nodes.iter().filter_map(|node| match node.layer {
            Layer::BatchNorm { channels, .. } => Some((node.name.as_str(), channels)),
            _ => None,
        })
    }
}

/// Multiplications of a state vector of `2^qubits` amplitudes by a circuit's gates, four a gate and amplitude.
fn state_vector_multiplications(circuit: &CircuitSpec) -> usize {
    let pairs = circuit.qubits * circuit.qubits.saturating_sub(1) / 2;
    let encoding = circuit.repetitions * (2 * circuit.qubits + pairs);
    (encoding + circuit.angle_count()) * (4 << circuit.qubits)
}

impl Layer {
    /// Size of the result; `None` if the layer cannot read such a value.
    fn size(&self, first: Size, second: Option<Size>) -> Option<Size> {
        match (self, first) {
            (Layer::Flatten, Size::Map { rows, columns, channels }) => Some(Size::Vector(rows * columns * channels)),
            (Layer::Repeat { channels }, Size::Map { rows, columns, .. }) => {
                Some(Size::Map { rows, columns, channels: *channels })
            }
            (Layer::ConvReluPool { inputs, outputs }, Size::Map { rows, columns, channels }) => {
                let fits = rows >= 2 && columns >= 2 && channels == *inputs;
                fits.then_some(Size::Map { rows: rows / 2, columns: columns / 2, channels: *outputs })
            }
            (Layer::Convolution { inputs, outputs, kernel, geometry, .. }, Size::Map { rows, columns, channels })
                if channels == *inputs =>
            {
                let rows = geometry.output_length(rows, *kernel)?;
                let columns = geometry.output_length(columns, *kernel)?;
                Some(Size::Map { rows, columns, channels: *outputs })
            }
            (Layer::MaxPool { kernel, stride, padding }, Size::Map { rows, columns, channels }) => {
                let window = ConvGeometry::dense(*stride, *padding);
                let (rows, columns) = (window.output_length(rows, *kernel)?, window.output_length(columns, *kernel)?);
                Some(Size::Map { rows, columns, channels })
            }
            (Layer::AveragePool { rows, columns }, Size::Map { channels, .. }) => {
                Some(Size::Vector(rows * columns * channels))
            }
            (Layer::Linear { inputs, outputs }, Size::Vector(width)) if width == *inputs => {
                Some(Size::Vector(*outputs))
            }
            (Layer::Circuit { circuit, .. }, Size::Vector(width)) if width == circuit.qubits => {
                Some(Size::Vector(width))
            }
            (Layer::Trigonometric, Size::Vector(2)) => Some(Size::Vector(5)),
            (Layer::Concatenate, Size::Vector(a)) => match second {
                Some(Size::Vector(b)) => Some(Size::Vector(a + b)),
                _ => None,
            },
            (Layer::Add { .. }, _) if second != Some(first) => None,
            (
                Layer::Add { .. }
                | Layer::BatchNorm { .. }
                | Layer::Activate(_)
                | Layer::ScaleChannels
                | Layer::Dropout { .. }
                | Layer::DropSamples { .. }
                | Layer::Standardise { .. }
                | Layer::ScaledSigmoid,
                _,
            ) => Some(first),
            _ => None,
        }
    }
}

impl Node {
    /// Returns whether the arrays of this layer stay as they were drawn.
    pub fn is_frozen(&self) -> bool {
        matches!(self.layer, Layer::Circuit { frozen: true, .. })
    }

    /// Arrays of this layer, trained unless it [is frozen](Node::is_frozen), with PyTorch's shapes.
    ///
    /// Initial distributions are He's (He et al., ICCV 2015): uniform, scaled by the number of inputs. For convolutions
    /// before a batch normalisation they are Gaussian, scaled by the number of outputs, as in torchvision's networks.
    pub fn declarations(&self) -> Vec<Declaration> {
        let declare = |what: &str, shape: Vec<usize>, initialisation| Declaration {
            name: format!("{}.{what}", self.name),
            shape,
            initialisation,
        };
        match &self.layer {
            Layer::ConvReluPool { inputs, outputs } => vec![
                declare(
                    "weight",
                    vec![*outputs, *inputs, 3, 3],
                    Initialisation::Uniform((6.0 / (9 * inputs) as f32).sqrt()),
                ),
                declare("bias", vec![*outputs], Initialisation::Constant(0.0)),
            ],
            Layer::Convolution { inputs, outputs, kernel, geometry, bias } => {
                let inputs_per_group = inputs / geometry.groups.max(1);
                let fan_out = kernel * kernel * outputs / geometry.groups.max(1);
                let initialisation = Initialisation::Normal((2.0 / fan_out as f32).sqrt());
                let weight = declare("weight", vec![*outputs, inputs_per_group, *kernel, *kernel], initialisation);
                let bias = bias.then(|| declare("bias", vec![*outputs], Initialisation::Constant(0.0)));
                [Some(weight), bias].into_iter().flatten().collect()
            }
            Layer::BatchNorm { channels, .. } => vec![
                declare("weight", vec![*channels], Initialisation::Constant(1.0)),
                declare("bias", vec![*channels], Initialisation::Constant(0.0)),
            ],
            Layer::Linear { inputs, outputs } => {
                // A gain of six before a ReLU, else of three, keeps the variance.
                let gain = if self.name == names::HIDDEN_DENSE { 6.0 } else { 3.0 };
                vec![
                    declare("weight", vec![*outputs, *inputs], Initialisation::Uniform((gain / *inputs as f32).sqrt())),
                    declare("bias", vec![*outputs], Initialisation::Constant(0.0)),
                ]
            }
            Layer::Circuit { circuit, .. } => {
                vec![declare("theta", vec![circuit.angle_count()], Initialisation::Uniform(std::f32::consts::PI))]
            }
            _ => Vec::new(),
        }
    }
}
