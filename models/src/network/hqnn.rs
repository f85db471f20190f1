//! The hybrid quantum-classical network of the paper, 66,447 parameters, and the heads that it is compared with.
//!
//! ```text
//! map [1][range][doppler]
//!   conv 3x3  1 -> 16, ReLU, max-pool 2        160
//!   conv 3x3 16 -> 32, ReLU, max-pool 2      4,640
//!   adaptive average pool to (2, 15)
//!   linear 960 -> 64, ReLU                  61,504
//!   linear 64 -> 2: the latent                 130
//!   standardise by constants, pi * sigmoid
//!   two-qubit circuit, <ZI> and <IZ>             4
//!   linear 2 -> 3: logits                        9
//! ```
//! These are the paper's sizes. The pooled grid is a setting, because in some maps only half of the ranges lie inside the room. The
//! layers behind the latent are a setting as well ([`Head`]).
//!
//! The paper does not say whether there is a nonlinearity between the two dense layers. Without one they would be a single linear
//! map, and 61,504 of the parameters would be redundant, so there is a ReLU here.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::graph::{Graph, INPUT, Layer, Value};
use super::names;
use crate::layer::Activation;
use crate::metrics::CLASSES;
use crate::quantum::CircuitSpec;

/// Rows and columns (range, Doppler) after the adaptive pooling, in the paper.
pub const PAPER_POOLED: [usize; 2] = [2, 15];
/// Largest number of rows or columns that can be pooled to.
pub const MOST_POOLED: usize = 64;
/// Channels of the second block.
const CHANNELS: usize = 32;
const HIDDEN: usize = 64;

/// Position of the circuit in the network.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Placement {
    /// Between latent and head: the paper's.
    #[default]
    Latent,
    /// Beside the latent: the head sees the latent and the expectations.
    Beside,
    /// Before the dense layers: pooled features to a latent to the circuit to the hidden layer.
    Front,
}

/// Layers behind the latent. Heads with `pi * sigmoid` see the same standardised and scaled latent as the circuit does.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum Head {
    /// `pi * sigmoid`, circuit, linear: the HQNN.
    Circuit {
        /// Settings of the circuit; the paper's if absent.
        #[serde(default)]
        circuit: CircuitSpec,
        /// Whether the angles stay as they were drawn.
        #[serde(default)]
        frozen: bool,
        /// Position of the circuit.
        #[serde(default)]
        placement: Placement,
    },
    /// Linear 2 -> 3, 9 parameters: the paper's "Estimator-matched".
    Linear,
    /// Linear 2 -> 2, ReLU, linear 2 -> 3, 15 parameters: the paper's "Dequantization".
    Dequantization,
    /// `pi * sigmoid`, linear 2 -> 3.
    SquashedLinear,
    /// `pi * sigmoid`, linear 2 -> 2, ReLU, linear 2 -> 3.
    SquashedDequantization,
    /// `pi * sigmoid`, the circuit's five trigonometric features, linear 5 -> 3: contains every function that the circuit can be.
    Trigonometric,
}

impl Default for Head {
    fn default() -> Self {
        Head::Circuit { circuit: CircuitSpec::default(), frozen: false, placement: Placement::Latent }
    }
}

impl Head {
    /// Width of the latent.
    pub fn width(&self) -> usize {
        match self {
            Head::Circuit { circuit, .. } => circuit.qubits,
            _ => 2,
        }
    }

    /// Returns whether the latent goes through `pi * sigmoid`.
    pub fn uses_scaled_sigmoid(&self) -> bool {
        !matches!(self, Head::Linear | Head::Dequantization)
    }
}

/// The network that pools to `pooled` rows and columns.
pub(crate) fn graph(pooled: [usize; 2], head: &Head) -> Graph {
    let mut g = Graph::default();
    let block1 = g.add("conv1", Layer::ConvReluPool { inputs: 1, outputs: 16 }, &[INPUT]);
    let block2 = g.add("conv2", Layer::ConvReluPool { inputs: 16, outputs: CHANNELS }, &[block1]);
    let averages = g.add(names::POOL, Layer::AveragePool { rows: pooled[0], columns: pooled[1] }, &[block2]);
    let count = CHANNELS * pooled[0] * pooled[1];
    let features = g.add(names::FEATURES, Layer::Standardise { width: count }, &[averages]);
    add_latent_and_head(g, features, count, true, head)
}

/// Completes a network of `count` features with the latent, the head, and the linear head of the warm-up. A hidden layer
/// precedes the latent if `deep`, and follows the circuit if that is at the front.
pub(super) fn add_latent_and_head(mut g: Graph, features: Value, count: usize, deep: bool, head: &Head) -> Graph {
    let width = head.width();
    if let Head::Circuit { circuit, frozen, placement: Placement::Front } = head {
        let latent = latent(&mut g, count, width, features);
        let squashed = g.add("squash", Layer::ScaledSigmoid, &[latent]);
        let expectations = circuit_node(&mut g, circuit, *frozen, squashed);
        let hidden = hidden(&mut g, width, expectations);
        g.output = linear(&mut g, names::HEAD, HIDDEN, CLASSES, hidden);
        linear(&mut g, names::WARM_UP, width, CLASSES, latent);
        return g;
    }
    let (inputs, from) = if deep { (HIDDEN, hidden(&mut g, count, features)) } else { (count, features) };
    let latent = latent(&mut g, inputs, width, from);
    let head_input = if head.uses_scaled_sigmoid() { g.add("squash", Layer::ScaledSigmoid, &[latent]) } else { latent };
    g.output = match head {
        Head::Circuit { circuit, frozen, placement } => {
            let expectations = circuit_node(&mut g, circuit, *frozen, head_input);
            if *placement == Placement::Beside {
                let both = g.add("beside", Layer::Concatenate, &[latent, expectations]);
                linear(&mut g, names::HEAD, 2 * width, CLASSES, both)
            } else {
                linear(&mut g, names::HEAD, width, CLASSES, expectations)
            }
        }
        Head::Linear | Head::SquashedLinear => linear(&mut g, names::HEAD, width, CLASSES, head_input),
        Head::Dequantization | Head::SquashedDequantization => {
            let dense = linear(&mut g, names::HEAD_HIDDEN, width, width, head_input);
            let hidden = g.add("head_relu", Layer::Activate(Activation::Relu), &[dense]);
            linear(&mut g, names::HEAD, width, CLASSES, hidden)
        }
        Head::Trigonometric => {
            let products = g.add("trigonometric", Layer::Trigonometric, &[head_input]);
            linear(&mut g, names::HEAD, 5, CLASSES, products)
        }
    };
    linear(&mut g, names::WARM_UP, width, CLASSES, latent);
    g
}

fn linear(g: &mut Graph, name: &str, inputs: usize, outputs: usize, from: Value) -> Value {
    g.add(name, Layer::Linear { inputs, outputs }, &[from])
}

fn hidden(g: &mut Graph, inputs: usize, from: Value) -> Value {
    let dense = linear(g, names::HIDDEN_DENSE, inputs, HIDDEN, from);
    g.add(names::HIDDEN, Layer::Activate(Activation::Relu), &[dense])
}

/// The latent after its standardisation.
fn latent(g: &mut Graph, inputs: usize, width: usize, from: Value) -> Value {
    let raw = linear(g, names::LATENT_DENSE, inputs, width, from);
    g.add(names::LATENT, Layer::Standardise { width }, &[raw])
}

fn circuit_node(g: &mut Graph, circuit: &CircuitSpec, frozen: bool, squashed: Value) -> Value {
    g.add(names::CIRCUIT, Layer::Circuit { circuit: circuit.clone(), frozen }, &[squashed])
}
