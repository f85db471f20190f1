//! ResNet-18 (He et al., CVPR 2016, table 1) for one-channel maps and three classes, 11,171,779 parameters; names and layout are
//! torchvision's, so that its weights fit.

use super::graph::{Graph, INPUT, Layer, Value};
use crate::layer::{Activation, ConvGeometry};
use crate::metrics::CLASSES;

const STAGES: [usize; 4] = [64, 128, 256, 512];

pub(crate) fn graph() -> Graph {
    let mut g = Graph::default();
    let stem = conv(&mut g, "conv1", 1, 64, 7, 2, INPUT);
    let stem = norm(&mut g, "bn1", 64, Activation::Relu, stem);
    let mut value = g.add("maxpool", Layer::MaxPool { kernel: 3, stride: 2, padding: 1 }, &[stem]);
    let mut inputs = 64;
    for (stage, outputs) in STAGES.into_iter().enumerate() {
        for block in 0..2 {
            let stride = if stage > 0 && block == 0 { 2 } else { 1 };
            value = basic_block(&mut g, &format!("layer{}.{block}", stage + 1), inputs, outputs, stride, value);
            inputs = outputs;
        }
    }
    let pooled = g.add("avgpool", Layer::AveragePool { rows: 1, columns: 1 }, &[value]);
    g.output = g.add("fc", Layer::Linear { inputs, outputs: CLASSES }, &[pooled]);
    g
}

fn basic_block(g: &mut Graph, name: &str, inputs: usize, outputs: usize, stride: usize, from: Value) -> Value {
    let first = conv(g, &format!("{name}.conv1"), inputs, outputs, 3, stride, from);
    let first = norm(g, &format!("{name}.bn1"), outputs, Activation::Relu, first);
    let second = conv(g, &format!("{name}.conv2"), outputs, outputs, 3, 1, first);
    let second = norm(g, &format!("{name}.bn2"), outputs, Activation::None, second);
    let mut shortcut = from;
    if stride != 1 || inputs != outputs {
        shortcut = conv(g, &format!("{name}.downsample.0"), inputs, outputs, 1, stride, from);
        shortcut = norm(g, &format!("{name}.downsample.1"), outputs, Activation::None, shortcut);
    }
    g.add(format!("{name}.add"), Layer::Add { rectified: true }, &[second, shortcut])
}

fn conv(g: &mut Graph, name: &str, inputs: usize, outputs: usize, kernel: usize, stride: usize, from: Value) -> Value {
    let geometry = ConvGeometry::dense(stride, kernel / 2);
    g.add(name, Layer::Convolution { inputs, outputs, kernel, geometry, bias: false }, &[from])
}

fn norm(g: &mut Graph, name: &str, channels: usize, activation: Activation, from: Value) -> Value {
    g.add(name, Layer::BatchNorm { channels, activation }, &[from])
}
