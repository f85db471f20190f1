//! DopplerNet, a reconstruction: the paper gives five convolution blocks, three dense layers and 2.558 million parameters, not
//! the layout. This is the simplest layout with that number: 2,558,307 parameters.
//!
//! ```text
//!   5 x [conv 3x3, batch norm, ReLU, max-pool 2], channels 16, 32, 64, 128, 256
//!   average pool to (4, 4), which for maps of 128 x 128 changes nothing
//!   linear 4096 -> 512 and 512 -> 128, each with batch norm, ReLU, dropout 0.5
//!   linear 128 -> 3
//! ```

use super::graph::{Graph, INPUT, Layer};
use crate::layer::{Activation, ConvGeometry};
use crate::metrics::CLASSES;

const CHANNELS: [usize; 5] = [16, 32, 64, 128, 256];
const DENSE: [usize; 2] = [512, 128];

pub(crate) fn graph() -> Graph {
    let mut g = Graph::default();
    let (mut value, mut inputs) = (INPUT, 1);
    for (index, outputs) in CHANNELS.into_iter().enumerate() {
        let geometry = ConvGeometry::dense(1, 1);
        let k = index + 1;
        value = g.add(
            format!("conv{k}"),
            Layer::Convolution { inputs, outputs, kernel: 3, geometry, bias: true },
            &[value],
        );
        value = g.add(format!("bn{k}"), Layer::BatchNorm { channels: outputs, activation: Activation::Relu }, &[value]);
        value = g.add(format!("pool{k}"), Layer::MaxPool { kernel: 2, stride: 2, padding: 0 }, &[value]);
        inputs = outputs;
    }
    value = g.add("average", Layer::AveragePool { rows: 4, columns: 4 }, &[value]);
    inputs *= 16;
    for (index, outputs) in DENSE.into_iter().enumerate() {
        let k = index + 1;
        // The first of them is `names::HIDDEN_DENSE`.
        value = g.add(format!("fc{k}"), Layer::Linear { inputs, outputs }, &[value]);
        value =
            g.add(format!("fc_bn{k}"), Layer::BatchNorm { channels: outputs, activation: Activation::Relu }, &[value]);
        value = g.add(format!("dropout{k}"), Layer::Dropout { probability: 0.5 }, &[value]);
        inputs = outputs;
    }
    g.output = g.add("fc3", Layer::Linear { inputs, outputs: CLASSES }, &[value]);
    g
}
