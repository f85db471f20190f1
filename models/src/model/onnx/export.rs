//! Layers of a network as ONNX operators.

use prost::Message;

use super::circuit;
use super::proto::{self, FLOAT};
use super::writer::{ExportError, Writer, int};
use crate::array_hash;
use crate::layer::{Activation, bin_bounds};
use crate::model::card::{CARD_KEY, ModelCard, input_axes};
use crate::model::file::Model;
use crate::model::onnx_runtime::{INPUT_NAME, OUTPUT_NAME};
use crate::network::{INPUT, Layer, Network, Node, Normalisation, Size, Value};

const OPSET: i64 = 17;
const IR_VERSION: i64 = 8;
/// Name of the map with range and Doppler exchanged, for networks that see it so.
const TRANSPOSED: &str = "map.transposed";

/// Writes a model with its card as the bytes of an ONNX file. Its input is a map by range and Doppler, and the card in the file says so,
/// also where the network sees them exchanged.
///
/// # Errors
/// [`ExportError`] if a layer has no ONNX form, or the card or the numbers cannot be read.
pub fn export(model: &Model) -> Result<Vec<u8>, ExportError> {
    let [_, range, doppler] = model.card.map_shape();
    let graph = graph(&model.network, range, doppler, model.card.is_transposed())?;
    let arrays = graph.initializer.iter().map(|array| (array.name.as_str(), array.raw_data.as_slice()));
    let card = ModelCard { input_shape: model.card.map_shape(), axes: input_axes(false), ..model.card.clone() };
    let card = array_hash::to_json(&card, arrays)?;
    Ok(file(graph, vec![proto::Entry { key: CARD_KEY.to_owned(), value: card }]))
}

/// Writes a network without a card as the bytes of an ONNX file, for maps of `range x doppler` bins.
///
/// # Errors
/// [`ExportError`] if a layer has no ONNX form, or the numbers cannot be read.
pub fn export_network(network: &Network, range: usize, doppler: usize) -> Result<Vec<u8>, ExportError> {
    Ok(file(graph(network, range, doppler, false)?, Vec::new()))
}

fn file(graph: proto::Graph, metadata: Vec<proto::Entry>) -> Vec<u8> {
    let model = proto::Model {
        ir_version: IR_VERSION,
        producer_name: "radome".to_owned(),
        producer_version: env!("CARGO_PKG_VERSION").to_owned(),
        graph: Some(graph),
        opset_import: vec![proto::OperatorSet { domain: String::new(), version: OPSET }],
        metadata,
    };
    model.encode_to_vec()
}

/// Graph of a network for maps of `range x doppler` bins. If `transposed`, the network reads them exchanged.
fn graph(network: &Network, range: usize, doppler: usize, transposed: bool) -> Result<proto::Graph, ExportError> {
    if network.spec().kind.reads_descriptors() {
        return Err(ExportError::Descriptors { network: network.spec().kind });
    }
    let mut writer = Writer { network, graph: proto::Graph::default(), sizes: Vec::new() };
    let layers = network.graph();
    let (rows, columns) = if transposed { (doppler, range) } else { (range, doppler) };
    writer.sizes = match layers.sizes([rows, columns]) {
        Ok(sizes) => sizes,
        Err(node) => {
            let error = format!("maps of {range} x {doppler} bins are too small for layer {}", node.name);
            return Err(ExportError::Network(candle_core::Error::Msg(error)));
        }
    };
    let input = match transposed {
        true => writer.op_with("Transpose", &[INPUT_NAME], TRANSPOSED, vec![permutation(&[0, 1, 3, 2])]),
        false => INPUT_NAME.to_owned(),
    };
    let name_of = |value: Value| match value {
        INPUT => input.clone(),
        value if value == layers.output => OUTPUT_NAME.to_owned(),
        value => format!("v{value}"),
    };
    let needed = layers.needed(&[layers.output], &[]);
    for (index, (node, _)) in layers.nodes.iter().zip(needed).enumerate().filter(|(_, (_, needed))| *needed) {
        let inputs: Vec<String> = node.inputs.iter().map(|&value| name_of(value)).collect();
        writer.layer(node, &inputs, &name_of(index + 1))?;
    }
    let mut graph = writer.graph;
    graph.name = "radome".to_owned();
    let map = [None, Some(1), Some(range), Some(doppler)];
    graph.input = vec![value_info(INPUT_NAME, &map)];
    graph.output = vec![value_info(OUTPUT_NAME, &[None, Some(3)])];
    Ok(graph)
}

fn value_info(name: &str, shape: &[Option<usize>]) -> proto::ValueInfo {
    let dim = |size: &Option<usize>| match size {
        Some(size) => proto::Dimension { value: Some(*size as i64), name: None },
        None => proto::Dimension { value: None, name: Some("batch".to_owned()) },
    };
    let shape = proto::Shape { dim: shape.iter().map(dim).collect() };
    let tensor = proto::TensorType { element: FLOAT, shape: Some(shape) };
    proto::ValueInfo { name: name.to_owned(), value_type: Some(proto::Type { tensor: Some(tensor) }) }
}

impl Writer<'_> {
    /// Adds the operators of a layer. Returns the name of its result.
    fn layer(&mut self, node: &Node, inputs: &[String], output: &str) -> Result<String, ExportError> {
        let (name, network) = (&node.name, self.network);
        let first = inputs.first().map(String::as_str).unwrap_or_default();
        let second = inputs.get(1).map(String::as_str).unwrap_or_default();
        let prefixed = |what: &str| format!("{name}.{what}");
        Ok(match &node.layer {
            Layer::Flatten => self.op("Flatten", &[first], output),
            Layer::Repeat { channels } => self.op_with("Concat", &vec![first; *channels], output, vec![int("axis", 1)]),
            Layer::ConvReluPool { .. } => {
                let [weight, bias] = self.weight_and_bias(name)?;
                let convolved = self.op_with("Conv", &[first, &weight, &bias], &prefixed("convolved"), window(3, 1, 1));
                let rectified = self.op("Relu", &[&convolved], &prefixed("rectified"));
                self.op_with("MaxPool", &[&rectified], output, window(2, 2, 0))
            }
            Layer::Convolution { kernel, geometry, bias, .. } => {
                let mut attributes = window(*kernel, geometry.stride, geometry.padding);
                attributes.push(int("group", geometry.groups as i64));
                if !bias {
                    let weight = self.parameter(&prefixed("weight"))?;
                    return Ok(self.op_with("Conv", &[first, &weight], output, attributes));
                }
                let [weight, bias] = self.weight_and_bias(name)?;
                self.op_with("Conv", &[first, &weight, &bias], output, attributes)
            }
            Layer::BatchNorm { channels, activation } => {
                self.batch_norm(name, *channels, *activation, first, output)?
            }
            Layer::Activate(function) => self.activate(*function, first, output),
            Layer::MaxPool { kernel, stride, padding } => {
                self.op_with("MaxPool", &[first], output, window(*kernel, *stride, *padding))
            }
            Layer::AveragePool { rows, columns } => self.average_pool(node, *rows, *columns, first, output),
            Layer::Linear { .. } => {
                let [weight, bias] = self.weight_and_bias(name)?;
                self.op_with("Gemm", &[first, &weight, &bias], output, vec![int("transB", 1)])
            }
            Layer::ScaleChannels => self.scale_channels(name, first, second, output),
            Layer::Add { rectified } => {
                let function = if *rectified { Activation::Relu } else { Activation::None };
                self.activated("Add", &[first, second], output, Vec::new(), function)
            }
            Layer::Dropout { .. } | Layer::DropSamples { .. } => self.activate(Activation::None, first, output),
            Layer::Standardise { width } => match network.parameters().normalisation(name) {
                None => self.activate(Activation::None, first, output),
                Some(constants) => self.standardise(name, *width, constants, first, output),
            },
            Layer::ScaledSigmoid => {
                let pi = self.constant(&prefixed("pi"), &[1], &[std::f32::consts::PI]);
                let sigmoid = self.op("Sigmoid", &[first], &prefixed("sigmoid"));
                self.op("Mul", &[&sigmoid, &pi], output)
            }
            Layer::Circuit { circuit, .. } => {
                let theta = network.parameters().numbers(&prefixed("theta"))?;
                circuit::write(self, name, circuit, &theta, first, output)?
            }
            Layer::Trigonometric => circuit::write_features(self, name, first, output),
            Layer::Concatenate => self.op_with("Concat", &[first, second], output, vec![int("axis", 1)]),
        })
    }

    fn scale_channels(&mut self, name: &str, maps: &str, factors: &str, output: &str) -> String {
        // ONNX takes axes as integers here, so they are written as a shape.
        let shape = self.whole_numbers(&format!("{name}.axes"), &[0, -1, 1, 1]);
        let factors = self.op("Reshape", &[factors, &shape], &format!("{name}.factors"));
        self.op("Mul", &[maps, &factors], output)
    }

    fn standardise(
        &mut self,
        name: &str,
        width: usize,
        constants: &Normalisation,
        input: &str,
        output: &str,
    ) -> String {
        let prefixed = |what: &str| format!("{name}.{what}");
        let mean = self.constant(&prefixed("mean"), &[width], &constants.mean);
        let sigma = self.constant(&prefixed("sigma"), &[width], &constants.sigma);
        let centred = self.op("Sub", &[input, &mean], &prefixed("centred"));
        self.op("Div", &[&centred, &sigma], output)
    }

    fn batch_norm(
        &mut self,
        name: &str,
        channels: usize,
        activation: Activation,
        input: &str,
        output: &str,
    ) -> Result<String, ExportError> {
        let [weight, bias] = self.weight_and_bias(name)?;
        let network = self.network;
        let statistics = network.parameters().statistics(name)?;
        let mean = self.constant(&format!("{name}.running_mean"), &[channels], &statistics.mean());
        let variance = self.constant(&format!("{name}.running_var"), &[channels], &statistics.variance());
        let inputs = [input, &weight, &bias, &mean, &variance];
        let epsilon = vec![float("epsilon", statistics.constants().epsilon)];
        Ok(self.activated("BatchNormalization", &inputs, output, epsilon, activation))
    }

    /// Adds adaptive mean pooling: products with matrices of means over rows and over columns.
    fn average_pool(&mut self, node: &Node, rows: usize, columns: usize, input: &str, output: &str) -> String {
        let prefixed = |what: &str| format!("{}.{what}", node.name);
        let (height, width) = match node.inputs.first().and_then(|&value| self.sizes.get(value)) {
            Some(&Size::Map { rows, columns, .. }) => (rows, columns),
            _ => (1, 1),
        };
        let by_columns = self.constant(&prefixed("columns"), &[width, columns], &means(width, columns, true));
        let by_rows = self.constant(&prefixed("rows"), &[rows, height], &means(height, rows, false));
        let narrow = self.op("MatMul", &[input, &by_columns], &prefixed("narrow"));
        let pooled = self.op("MatMul", &[&by_rows, &narrow], &prefixed("pooled"));
        self.op_with("Flatten", &[&pooled], output, vec![int("axis", 1)])
    }
}

/// Matrix `[length][bins]` (or transposed) that computes the means over the bins of an adaptive pooling.
fn means(length: usize, bins: usize, bins_last: bool) -> Vec<f32> {
    let mut matrix = vec![0.0; length * bins];
    for index in 0..bins {
        let (from, to) = bin_bounds(index, bins, length);
        for cell in from..to {
            let at = if bins_last { cell * bins + index } else { index * length + cell };
            matrix[at] = 1.0 / (to - from) as f32;
        }
    }
    matrix
}

/// Attributes of a convolution or pooling.
fn window(kernel: usize, stride: usize, padding: usize) -> Vec<proto::Attribute> {
    vec![ints("kernel_shape", kernel, 2), ints("strides", stride, 2), ints("pads", padding, 4)]
}

fn float(name: &str, value: f32) -> proto::Attribute {
    proto::Attribute { name: name.to_owned(), f: Some(value), kind: 1, ..Default::default() }
}

fn ints(name: &str, value: usize, count: usize) -> proto::Attribute {
    proto::Attribute { name: name.to_owned(), ints: vec![value as i64; count], kind: 7, ..Default::default() }
}

/// Attribute with the order of axes.
fn permutation(axes: &[i64]) -> proto::Attribute {
    proto::Attribute { name: "perm".to_owned(), ints: axes.to_vec(), kind: 7, ..Default::default() }
}
