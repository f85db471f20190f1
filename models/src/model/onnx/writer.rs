//! ONNX graph that grows node by node.

use thiserror::Error;

use super::proto::{self, FLOAT};
use crate::layer::Activation;
use crate::network::{Network, NetworkKind, Size};
use crate::quantum::CircuitError;

/// Error: a network cannot be written as ONNX.
#[derive(Debug, Error)]
#[allow(missing_docs, reason = "the message says what each field is")]
pub enum ExportError {
    /// The circuit is too large, noisy or measured with shots.
    #[error(
        "layer {layer}: {reason}\n\nhint: export a model whose circuit is exact, without gate errors, of at most {most} qubits"
    )]
    Circuit { layer: String, reason: String, most: usize },
    /// The network reads descriptors of maps.
    #[error(
        "{network}: the descriptors of a map have no ONNX form\n\nhint: use the model file (--model \
         FILE.safetensors), or export a network that reads the cells of maps"
    )]
    Descriptors { network: NetworkKind },
    /// The settings of the circuit are invalid.
    #[error(transparent)]
    Spec(#[from] CircuitError),
    /// The card cannot be written.
    #[error("model card: {0}")]
    Card(#[from] serde_json::Error),
    /// The network's numbers cannot be read.
    #[error("network: {0}")]
    Network(#[from] candle_core::Error),
}

/// A graph that grows node by node.
pub(super) struct Writer<'a> {
    pub network: &'a Network,
    pub graph: proto::Graph,
    pub sizes: Vec<Size>,
}

impl Writer<'_> {
    /// Adds an operator without attributes. Returns the name of its result.
    pub fn op(&mut self, kind: &str, inputs: &[&str], output: &str) -> String {
        self.op_with(kind, inputs, output, Vec::new())
    }

    /// Adds an operator. Returns the name of its result.
    pub fn op_with(&mut self, kind: &str, inputs: &[&str], output: &str, attributes: Vec<proto::Attribute>) -> String {
        self.graph.node.push(proto::Node {
            input: inputs.iter().map(|&input| input.to_owned()).collect(),
            output: vec![output.to_owned()],
            name: output.to_owned(),
            op_type: kind.to_owned(),
            attribute: attributes,
        });
        output.to_owned()
    }

    /// Adds constant numbers. Returns their name.
    pub fn constant(&mut self, name: &str, shape: &[usize], values: &[f32]) -> String {
        let dims = shape.iter().map(|&size| size as i64).collect();
        self.initializer(name, dims, FLOAT, values.iter().flat_map(|v| v.to_le_bytes()).collect())
    }

    /// Adds constant 64-bit integers. Returns their name.
    pub fn whole_numbers(&mut self, name: &str, values: &[i64]) -> String {
        const INT64: i32 = 7;
        let raw_data = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        self.initializer(name, vec![values.len() as i64], INT64, raw_data)
    }

    fn initializer(&mut self, name: &str, dims: Vec<i64>, data_type: i32, raw_data: Vec<u8>) -> String {
        self.graph.initializer.push(proto::Tensor { dims, data_type, name: name.to_owned(), raw_data });
        name.to_owned()
    }

    /// Adds a trained array. Returns its name.
    ///
    /// # Errors
    /// [`ExportError`] if the network has no array of this name, or its numbers cannot be read.
    pub fn parameter(&mut self, name: &str) -> Result<String, ExportError> {
        let tensor = self.network.parameters().get(name)?;
        let values: Vec<f32> = tensor.flatten_all()?.to_vec1()?;
        let shape = tensor.dims().to_vec();
        Ok(self.constant(name, &shape, &values))
    }

    /// Adds weight and bias of a layer. Returns their names.
    ///
    /// # Errors
    /// Those of [`Writer::parameter`].
    pub fn weight_and_bias(&mut self, layer: &str) -> Result<[String; 2], ExportError> {
        Ok([self.parameter(&format!("{layer}.weight"))?, self.parameter(&format!("{layer}.bias"))?])
    }

    pub fn activate(&mut self, function: Activation, input: &str, output: &str) -> String {
        match function {
            Activation::None => self.op("Identity", &[input], output),
            Activation::Relu => self.op("Relu", &[input], output),
            Activation::Sigmoid => self.op("Sigmoid", &[input], output),
            Activation::Silu => {
                let sigmoid = self.op("Sigmoid", &[input], &format!("{output}.sigmoid"));
                self.op("Mul", &[input, &sigmoid], output)
            }
        }
    }

    /// Adds an operator and the activation behind it, if there is one.
    pub fn activated(
        &mut self,
        kind: &str,
        inputs: &[&str],
        output: &str,
        attributes: Vec<proto::Attribute>,
        function: Activation,
    ) -> String {
        match function {
            Activation::None => self.op_with(kind, inputs, output, attributes),
            function => {
                let bare = self.op_with(kind, inputs, &format!("{output}.bare"), attributes);
                self.activate(function, &bare, output)
            }
        }
    }
}

/// Attribute with one whole number.
pub(super) fn int(name: &str, value: i64) -> proto::Attribute {
    proto::Attribute { name: name.to_owned(), i: Some(value), kind: 2, ..Default::default() }
}
