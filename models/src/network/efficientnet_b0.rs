//! EfficientNet-B0 (Tan and Le, ICML 2019, table 1) for three classes: 4,010,815 parameters with a stem for one channel,
//! 4,011,391 with torchvision's for three, of which each sees the map. Names and layout are torchvision's, so that its weights
//! fit.

use super::graph::{Graph, INPUT, Layer, Value};
use crate::layer::{Activation, ConvGeometry};
use crate::metrics::CLASSES;

struct Stage {
    expansion: usize,
    kernel: usize,
    stride: usize,
    outputs: usize,
    blocks: usize,
}

const fn stage(expansion: usize, kernel: usize, stride: usize, outputs: usize, blocks: usize) -> Stage {
    Stage { expansion, kernel, stride, outputs, blocks }
}

const STAGES: [Stage; 7] = [
    stage(1, 3, 1, 16, 1),
    stage(6, 3, 2, 24, 2),
    stage(6, 5, 2, 40, 2),
    stage(6, 3, 2, 80, 3),
    stage(6, 5, 1, 112, 3),
    stage(6, 5, 2, 192, 4),
    stage(6, 3, 1, 320, 1),
];
const BLOCKS: usize = 16;
const STEM: usize = 32;
const LAST: usize = 1280;
/// Probability that the last block is skipped while training; earlier ones in proportion.
const STOCHASTIC_DEPTH: f32 = 0.2;

pub(crate) fn graph(channels: usize) -> Graph {
    let mut g = Graph::default();
    let mut value = INPUT;
    if channels > 1 {
        value = g.add("repeat", Layer::Repeat { channels }, &[value]);
    }
    value = conv_norm(&mut g, "features.0", [channels, STEM, 1], 3, 2, Activation::Silu, value);
    let (mut inputs, mut block) = (STEM, 0);
    for (index, stage) in STAGES.iter().enumerate() {
        for repeat in 0..stage.blocks {
            let stride = if repeat == 0 { stage.stride } else { 1 };
            let name = format!("features.{}.{repeat}", index + 1);
            let skip = STOCHASTIC_DEPTH * block as f32 / BLOCKS as f32;
            value = inverted_residual(&mut g, &name, inputs, stage, stride, skip, value);
            (inputs, block) = (stage.outputs, block + 1);
        }
    }
    value = conv_norm(&mut g, "features.8", [inputs, LAST, 1], 1, 1, Activation::Silu, value);
    value = g.add("avgpool", Layer::AveragePool { rows: 1, columns: 1 }, &[value]);
    value = g.add("classifier.0", Layer::Dropout { probability: 0.2 }, &[value]);
    g.output = g.add("classifier.1", Layer::Linear { inputs: LAST, outputs: CLASSES }, &[value]);
    g
}

/// Expansion, depthwise convolution, squeeze-and-excitation, projection (MBConv).
fn inverted_residual(
    g: &mut Graph,
    name: &str,
    inputs: usize,
    stage: &Stage,
    stride: usize,
    skip: f32,
    from: Value,
) -> Value {
    let (wide, mut value, mut part) = (inputs * stage.expansion, from, 0);
    let mut next = || {
        part += 1;
        format!("{name}.block.{}", part - 1)
    };
    if stage.expansion > 1 {
        value = conv_norm(g, &next(), [inputs, wide, 1], 1, 1, Activation::Silu, value);
    }
    value = conv_norm(g, &next(), [wide, wide, wide], stage.kernel, stride, Activation::Silu, value);
    value = squeeze_and_excite(g, &next(), wide, (inputs / 4).max(1), value);
    value = conv_norm(g, &next(), [wide, stage.outputs, 1], 1, 1, Activation::None, value);
    if stride == 1 && inputs == stage.outputs {
        value = g.add(format!("{name}.skip"), Layer::DropSamples { probability: skip }, &[value]);
        value = g.add(format!("{name}.add"), Layer::Add { rectified: false }, &[value, from]);
    }
    value
}

fn squeeze_and_excite(g: &mut Graph, name: &str, channels: usize, squeezed: usize, from: Value) -> Value {
    let mut value = g.add(format!("{name}.avgpool"), Layer::AveragePool { rows: 1, columns: 1 }, &[from]);
    value = g.add(format!("{name}.fc1"), Layer::Linear { inputs: channels, outputs: squeezed }, &[value]);
    value = g.add(format!("{name}.silu"), Layer::Activate(Activation::Silu), &[value]);
    value = g.add(format!("{name}.fc2"), Layer::Linear { inputs: squeezed, outputs: channels }, &[value]);
    value = g.add(format!("{name}.sigmoid"), Layer::Activate(Activation::Sigmoid), &[value]);
    g.add(format!("{name}.scale"), Layer::ScaleChannels, &[from, value])
}

/// Convolution and batch normalisation, `[inputs, outputs, groups]`.
fn conv_norm(
    g: &mut Graph,
    name: &str,
    [inputs, outputs, groups]: [usize; 3],
    kernel: usize,
    stride: usize,
    activation: Activation,
    from: Value,
) -> Value {
    let geometry = ConvGeometry { stride, padding: kernel / 2, groups };
    let convolution = Layer::Convolution { inputs, outputs, kernel, geometry, bias: false };
    let value = g.add(format!("{name}.0"), convolution, &[from]);
    g.add(format!("{name}.1"), Layer::BatchNorm { channels: outputs, activation }, &[value])
}
