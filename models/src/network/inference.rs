//! Inference with a network that is prepared once and run often, without gradients.
//!
//! Batch normalisations are folded into the convolutions and dense layers before them. Activations and residual sums
//! are fused with these layers. Weights are packed, and buffers keep their memory from one run to the next.
//!
//! Results are the same bits for any number of threads and for any batch that a map is in (except circuits with shots, whose draws
//! are numbered by row). They agree with `run.rs` within rounding.

use candle_core::{Result, Tensor, bail};

use super::graph::{INPUT, Layer, Node, Value};
use super::instance::Network;
use super::parameters::Normalisation;
use crate::kernel::spin_pool::{SpinPool, for_each_chunk};
use crate::layer::{
    Activation, Affine, ConvGeometry, Feature, KernelLevel, PreparedBlock, PreparedConv, PreparedDense, run_circuit,
    scaled_sigmoid_of, with_values,
};
use crate::quantum::{Circuit, ClosedForm, expectations_of_rows, features};

/// Number of values that one task processes in a step without sums.
const CHUNK: usize = 1 << 14;

/// Largest number of weights of a dense layer that is summed in f64, on one thread. All dense layers of the HQNN are
/// below it.
const MOST_F64_WEIGHTS: usize = 1 << 17;

/// A network ready to run.
pub struct Inference {
    steps: Vec<Step>,
    /// Results of the steps. A buffer is reused after its last reader.
    buffers: Vec<Feature>,
    output: usize,
    pool: SpinPool,
}

/// One layer or several fused layers, the buffers that it reads, and the buffer that it writes.
struct Step {
    name: String,
    kernel: Kernel,
    inputs: Vec<usize>,
    output: usize,
}

// A network has a few dozen kernels, which run in order.
#[allow(clippy::large_enum_variant)]
enum Kernel {
    Repeat { channels: usize },
    Block(PreparedBlock),
    // A convolution or dense layer. A second input is added before the activation.
    Convolution(PreparedConv),
    Dense(PreparedDense),
    Activate(Activation),
    MaxPool { kernel: usize, stride: usize, padding: usize, level: KernelLevel },
    AveragePool { rows: usize, columns: usize },
    ScaleChannels,
    Add { rectified: bool },
    Affine { scale: Vec<f32>, shift: Vec<f32>, activation: Activation },
    Standardise { mean: Vec<f32>, factor: Vec<f32> },
    ScaledSigmoid,
    ClosedForm(ClosedForm),
    Circuit { circuit: Circuit, theta: Vec<f64> },
    Trigonometric,
    Concatenate,
}

impl Network {
    /// Logits `[batch][3]` for standardised maps `[batch][range][doppler]`, or for descriptors `[batch][1][descriptor]`.
    ///
    /// Prepares an [`Inference`] for this call. Callers with many maps keep one.
    ///
    /// # Errors
    /// `input` has another number of axes or is not f32 on the CPU, or a layer cannot read maps of this size.
    pub fn logits(&self, input: &Tensor) -> Result<Tensor> {
        let (batch, range, doppler) = input.dims3()?;
        let mut inference = Inference::new(self)?;
        let logits =
            with_values("network", input, |maps| Ok(inference.logits(maps, [batch, range, doppler])?.to_vec()))?;
        let classes = logits.len() / batch.max(1);
        Tensor::from_vec(logits, (batch, classes), input.device())
    }
}

impl Inference {
    /// Prepares a network with its present numbers.
    ///
    /// # Errors
    /// A layer's numbers contradict its sizes, or the circuit's settings are out of range.
    pub fn new(network: &Network) -> Result<Self> {
        let graph = network.graph();
        let needed = graph.needed(&[graph.output], &[]);
        let needed_nodes =
            || graph.nodes.iter().enumerate().zip(&needed).filter(|(_, needed)| **needed).map(|(node, _)| node);
        let mut readers: Vec<Vec<usize>> = vec![Vec::new(); graph.nodes.len() + 1];
        for (index, node) in needed_nodes() {
            node.inputs.iter().for_each(|&value| readers[value].push(index));
        }
        let mut plan = Plan { network, readers, results: vec![None; graph.nodes.len() + 1], steps: Vec::new() };
        plan.results[INPUT] = Some(0);
        for (index, node) in needed_nodes() {
            if plan.results[index + 1].is_none() {
                plan.add(index + 1, node).map_err(|error| error.context(node.name.clone()))?;
            }
        }
        let Some(output) = plan.results[graph.output] else { bail!("the network has no output") };
        Ok(share_buffers(plan.steps, output))
    }

    /// Logits `[batch][3]` of standardised maps `[batch][range][doppler]`, or of descriptors `[batch][1][descriptor]`.
    ///
    /// # Errors
    /// The number of cells is not that of `shape` or is 0, or a layer cannot read maps of this size.
    pub fn logits(&mut self, maps: &[f32], shape: [usize; 3]) -> Result<&[f32]> {
        self.logits_step_by_step(maps, shape, |_| ())
    }

    /// [`Inference::logits`] that calls `after` with the name of each completed step, to measure times.
    ///
    /// # Errors
    /// Those of [`Inference::logits`].
    pub fn logits_step_by_step(
        &mut self,
        maps: &[f32],
        [batch, range, doppler]: [usize; 3],
        mut after: impl FnMut(&str),
    ) -> Result<&[f32]> {
        if batch * range * doppler != maps.len() || maps.is_empty() {
            bail!("expected {batch} maps of {range} x {doppler} bins, got {} values", maps.len());
        }
        if let Some(input) = self.buffers.first_mut() {
            input.reshape([batch, range, doppler, 1]);
            input.values_mut().copy_from_slice(maps);
        }
        let Inference { steps, buffers, output, pool } = self;
        pool.run(|| {
            steps.iter().try_for_each(|step| {
                let mut output = std::mem::take(&mut buffers[step.output]);
                let result = step.run(buffers, &mut output);
                buffers[step.output] = output;
                after(&step.name);
                result.map_err(|error| error.context(step.name.clone()))
            })
        })?;
        Ok(buffers[*output].values())
    }
}

/// Assigns a buffer to each result. Results of steps are numbered from 1, in order; 0 is the input.
fn share_buffers(mut steps: Vec<Step>, output: usize) -> Inference {
    let mut last_reader = vec![0; steps.len() + 1];
    for (index, step) in steps.iter().enumerate() {
        step.inputs.iter().for_each(|&input| last_reader[input] = index);
    }
    last_reader[output] = usize::MAX;
    // The input's own buffer is written before every run.
    let (mut buffer_of, mut free, mut count) = (vec![0usize; steps.len() + 1], Vec::new(), 1);
    for (index, step) in steps.iter_mut().enumerate() {
        let mut freed: Vec<usize> =
            step.inputs.iter().filter(|&&input| last_reader[input] == index).map(|&input| buffer_of[input]).collect();
        freed.sort_unstable();
        freed.dedup();
        for input in &mut step.inputs {
            *input = buffer_of[*input];
        }
        // The last reader of a buffer may overwrite it.
        let in_place = step.inputs.first().copied().filter(|first| step.kernel.is_in_place() && freed.contains(first));
        step.output = in_place.or_else(|| free.pop()).unwrap_or_else(|| {
            count += 1;
            count - 1
        });
        buffer_of[index + 1] = step.output;
        free.extend(freed.into_iter().filter(|&buffer| buffer != step.output));
    }
    Inference { steps, buffers: vec![Feature::default(); count], output: buffer_of[output], pool: SpinPool::default() }
}

/// Steps added so far.
struct Plan<'a> {
    network: &'a Network,
    /// Nodes that read each value.
    readers: Vec<Vec<usize>>,
    /// Number (from 1) of the step that computes each value, also for values inside a fused step.
    results: Vec<Option<usize>>,
    steps: Vec<Step>,
}

impl Plan<'_> {
    /// Only node that reads `value`, and its result. `None` if there are several or none, or if `value` is the output.
    fn only_reader(&self, value: Value) -> Option<(Value, &Node)> {
        match self.readers.get(value).map(Vec::as_slice) {
            Some(&[index]) if value != self.network.graph().output => {
                self.network.graph().nodes.get(index).map(|node| (index + 1, node))
            }
            _ => None,
        }
    }

    fn result(&self, value: Value) -> Result<usize> {
        match self.results.get(value) {
            Some(Some(result)) => Ok(*result),
            _ => bail!("value {value} is read before it is computed"),
        }
    }

    /// Adds a step that computes `values`, of which other steps read the last.
    fn push(&mut self, node: &Node, kernel: Kernel, inputs: Vec<usize>, values: &[Value]) {
        self.steps.push(Step { name: node.name.clone(), kernel, inputs, output: 0 });
        for &value in values {
            self.results[value] = Some(self.steps.len());
        }
    }

    fn numbers(&self, node: &Node, what: &str) -> Result<Vec<f32>> {
        self.network.parameters().numbers(&format!("{}.{what}", node.name))
    }

    /// A batch normalisation as a factor and a summand for each channel.
    fn affine(&self, node: &Node) -> Result<(Vec<f32>, Vec<f32>)> {
        let (weight, bias) = (self.numbers(node, "weight")?, self.numbers(node, "bias")?);
        let statistics = self.network.parameters().statistics(&node.name)?;
        let epsilon = f64::from(statistics.constants().epsilon);
        let factor_and_summand = |((&weight, &bias), (mean, variance)): ((&f32, &f32), (f32, f32))| {
            let scale = f64::from(weight) / (f64::from(variance) + epsilon).sqrt();
            (scale as f32, (f64::from(bias) - f64::from(mean) * scale) as f32)
        };
        let moments = statistics.mean().into_iter().zip(statistics.variance());
        Ok(weight.iter().zip(&bias).zip(moments).map(factor_and_summand).unzip())
    }

    fn add(&mut self, value: Value, node: &Node) -> Result<()> {
        let inputs = node.inputs.iter().map(|&input| self.result(input)).collect::<Result<Vec<_>>>()?;
        let level = self.network.level();
        let kernel = match &node.layer {
            Layer::Convolution { .. } | Layer::Linear { .. } => return self.add_convolution(value, node, inputs),
            Layer::ConvReluPool { inputs: i, outputs } => {
                let (weight, bias) = (self.numbers(node, "weight")?, self.numbers(node, "bias")?);
                Kernel::Block(PreparedBlock::new(&weight, [*outputs, *i], Some(&bias), None, level)?)
            }
            // Layers that read vectors take the values of a feature map in their order.
            Layer::Flatten | Layer::Dropout { .. } | Layer::DropSamples { .. } => {
                return self.pass_through(value, &inputs);
            }
            Layer::Standardise { .. } => match self.network.parameters().normalisation(&node.name) {
                None => return self.pass_through(value, &inputs),
                Some(Normalisation { mean, sigma }) => {
                    Kernel::Standardise { mean: mean.clone(), factor: sigma.iter().map(|sigma| 1.0 / sigma).collect() }
                }
            },
            Layer::BatchNorm { activation, .. } => {
                let (scale, shift) = self.affine(node)?;
                Kernel::Affine { scale, shift, activation: *activation }
            }
            Layer::Repeat { channels } => Kernel::Repeat { channels: *channels },
            Layer::Activate(activation) => Kernel::Activate(*activation),
            &Layer::MaxPool { kernel, stride, padding } => Kernel::MaxPool { kernel, stride, padding, level },
            &Layer::AveragePool { rows, columns } => Kernel::AveragePool { rows, columns },
            Layer::ScaleChannels => Kernel::ScaleChannels,
            Layer::Add { rectified } => Kernel::Add { rectified: *rectified },
            Layer::ScaledSigmoid => Kernel::ScaledSigmoid,
            Layer::Circuit { circuit, .. } => {
                let circuit = Circuit::new(circuit).map_err(candle_core::Error::wrap)?;
                let theta: Vec<f64> = self.numbers(node, "theta")?.into_iter().map(f64::from).collect();
                match *theta.as_slice() {
                    [a, b, c, d] if circuit.is_closed_form() => Kernel::ClosedForm(ClosedForm::new([a, b, c, d])),
                    _ => Kernel::Circuit { circuit, theta },
                }
            }
            Layer::Trigonometric => Kernel::Trigonometric,
            Layer::Concatenate => Kernel::Concatenate,
        };
        self.push(node, kernel, inputs, &[value]);
        Ok(())
    }

    /// Replaces a node that changes nothing in inference by its input.
    fn pass_through(&mut self, value: Value, inputs: &[usize]) -> Result<()> {
        self.results[value] = inputs.first().copied();
        Ok(())
    }

    /// Adds a convolution or dense layer, fused with the layers behind it. These are batch normalisation, a sum with a
    /// value that is already computed, an activation, or the pooling of a fused block.
    fn add_convolution(&mut self, value: Value, node: &Node, mut inputs: Vec<usize>) -> Result<()> {
        let level = self.network.level();
        let weight = self.numbers(node, "weight")?;
        let (dims, geometry, bias) = match node.layer {
            Layer::Convolution { inputs, outputs, kernel, geometry, bias } => {
                ([outputs, inputs / geometry.groups.max(1), kernel, kernel], geometry, bias)
            }
            Layer::Linear { inputs, outputs } => ([outputs, inputs, 1, 1], ConvGeometry::dense(1, 0), true),
            _ => bail!("no convolution"),
        };
        let bias = if bias { Some(self.numbers(node, "bias")?) } else { None };
        let (mut values, mut last) = (vec![value], value);
        let (mut affine, mut activation) = (None, Activation::None);
        if let Some((next, node)) = self.only_reader(last)
            && let Layer::BatchNorm { activation: function, .. } = node.layer
        {
            (affine, activation, last) = (Some(self.affine(node)?), function, next);
            values.push(last);
        }
        let affine = affine.as_ref().map(|(scale, shift)| Affine { scale, shift });
        if activation == Activation::None {
            if let Some((next, node)) = self.only_reader(last)
                && let Layer::Activate(function) = node.layer
            {
                (activation, last) = (function, next);
                values.push(last);
            } else {
                self.fuse_sum(&mut inputs, &mut activation, &mut values);
            }
        } else if activation == Activation::Relu
            && dims[2..] == [3, 3]
            && geometry == ConvGeometry::dense(1, 1)
            && let Some((next, Node { layer: Layer::MaxPool { kernel: 2, stride: 2, padding: 0 }, .. })) =
                self.only_reader(last)
        {
            values.push(next);
            let block = PreparedBlock::new(&weight, [dims[0], dims[1]], bias.as_deref(), affine, level)?;
            self.push(node, Kernel::Block(block), inputs, &values);
            return Ok(());
        }
        if let Layer::Linear { inputs: i, outputs } = node.layer
            && i * outputs <= MOST_F64_WEIGHTS
            && affine.is_none()
            && inputs.len() == 1
            && let Some(bias) = &bias
        {
            let dense = PreparedDense::new(&weight, [outputs, i], bias, activation, level)?;
            self.push(node, Kernel::Dense(dense), inputs, &values);
            return Ok(());
        }
        let convolution = PreparedConv::new(&weight, dims, bias.as_deref(), affine, geometry, activation, level)?;
        self.push(node, Kernel::Convolution(convolution), inputs, &values);
        Ok(())
    }

    /// Fuses the sum behind the last of `values`, if the other summand is already computed.
    fn fuse_sum(&self, inputs: &mut Vec<usize>, activation: &mut Activation, values: &mut Vec<Value>) {
        let (mut last, mut passed) = (values.last().copied().unwrap_or_default(), Vec::new());
        while let Some((next, Node { layer: Layer::DropSamples { .. } | Layer::Dropout { .. }, .. })) =
            self.only_reader(last)
        {
            passed.push(next);
            last = next;
        }
        if let Some((next, Node { layer: Layer::Add { rectified }, inputs: summands, .. })) = self.only_reader(last)
            && let Some(&other) = summands.iter().find(|&&summand| summand != last)
            && let Some(Some(other)) = self.results.get(other)
        {
            inputs.push(*other);
            *activation = if *rectified { Activation::Relu } else { Activation::None };
            values.extend(passed);
            values.push(next);
        }
    }
}

impl Kernel {
    /// Returns whether the first input may be overwritten by the output.
    fn is_in_place(&self) -> bool {
        use Kernel::*;
        matches!(self, Activate(_) | ScaleChannels | Add { .. } | Affine { .. } | Standardise { .. } | ScaledSigmoid)
    }
}

impl Step {
    fn run(&self, buffers: &[Feature], output: &mut Feature) -> Result<()> {
        let in_place = self.inputs.first() == Some(&self.output);
        let input = |k: usize| match self.inputs.get(k).and_then(|&index| buffers.get(index)) {
            Some(input) => Ok(input),
            None => bail!("input {k} is missing"),
        };
        if self.kernel.is_in_place() && !in_place {
            let first = input(0)?;
            output.reshape(first.dims());
            output.values_mut().copy_from_slice(first.values());
        }
        let [batch, rows, columns, channels] = if in_place { output.dims() } else { input(0)?.dims() };
        match &self.kernel {
            Kernel::Block(block) => block.run(input(0)?, output)?,
            Kernel::Convolution(convolution) => convolution.run(input(0)?, input(1).ok(), output)?,
            Kernel::Dense(dense) => dense.run(input(0)?, output)?,
            &Kernel::Repeat { channels } => {
                output.reshape([batch, rows, columns, channels]);
                let cells = output.values_mut().chunks_exact_mut(channels);
                cells.zip(input(0)?.values()).for_each(|(cell, &value)| cell.fill(value));
            }
            &Kernel::MaxPool { kernel, stride, padding, level } => {
                input(0)?.max_pool2d(kernel, stride, padding, level, output)?;
            }
            &Kernel::AveragePool { rows, columns } => input(0)?.adaptive_average_pool(rows, columns, output)?,
            Kernel::ScaleChannels => output.scale_channels(input(1)?)?,
            Kernel::Add { rectified } => add(input(1)?, *rectified, output)?,
            Kernel::Activate(function) => {
                output.values_mut().iter_mut().for_each(|x| *x = function.apply(*x));
            }
            Kernel::Affine { scale, shift, activation } => {
                for cell in output.values_mut().chunks_exact_mut(channels) {
                    let constants = scale.iter().zip(shift);
                    cell.iter_mut().zip(constants).for_each(|(x, (a, b))| *x = activation.apply(*x * a + b));
                }
            }
            Kernel::Standardise { mean, factor } => standardise(mean, factor, output)?,
            Kernel::ScaledSigmoid => output.values_mut().iter_mut().for_each(|x| *x = scaled_sigmoid_of(*x)),
            Kernel::ClosedForm(closed_form) => {
                let input = input(0)?;
                output.reshape(input.dims());
                expectations_of_rows(closed_form, input.values().as_chunks().0, output.values_mut().as_chunks_mut().0);
            }
            Kernel::Circuit { circuit, theta } => {
                let input = input(0)?;
                output.reshape(input.dims());
                run_circuit(circuit, theta, 0, input.values(), output.values_mut())?;
            }
            Kernel::Trigonometric => trigonometric(input(0)?, output),
            Kernel::Concatenate => concatenate(input(0)?, input(1)?, output),
        }
        Ok(())
    }
}

/// Adds `other`, and rectifies the sum if asked to.
fn add(other: &Feature, rectified: bool, output: &mut Feature) -> Result<()> {
    if other.dims() != output.dims() {
        bail!("expected equal shapes, got {:?} and {:?}", output.dims(), other.dims());
    }
    let function = if rectified { Activation::Relu } else { Activation::None };
    for_each_chunk(output.values_mut(), CHUNK, |index, values| {
        let other = &other.values()[index * CHUNK..];
        values.iter_mut().zip(other).for_each(|(x, y)| *x = function.apply(*x + y));
    });
    Ok(())
}

fn standardise(mean: &[f32], factor: &[f32], output: &mut Feature) -> Result<()> {
    let width: usize = output.dims()[1..].iter().product();
    if mean.len() != width {
        bail!("expected {} values, got {width}", mean.len());
    }
    for row in output.values_mut().chunks_exact_mut(width) {
        let constants = mean.iter().zip(factor);
        row.iter_mut().zip(constants).for_each(|(x, (mean, factor))| *x = (*x - mean) * factor);
    }
    Ok(())
}

fn trigonometric(input: &Feature, output: &mut Feature) {
    output.reshape([input.dims()[0], 1, 1, 5]);
    for (&x, result) in input.values().as_chunks::<2>().0.iter().zip(output.values_mut().as_chunks_mut::<5>().0) {
        *result = features(x.map(f64::from)).0.map(|value| value as f32);
    }
}

/// Concatenates the rows of two inputs.
fn concatenate(first: &Feature, second: &Feature, output: &mut Feature) {
    let [width, other] = [first, second].map(|input| input.dims()[1..].iter().product::<usize>());
    output.reshape([first.dims()[0], 1, 1, width + other]);
    let parts = first.values().chunks_exact(width).zip(second.values().chunks_exact(other));
    for (row, (a, b)) in output.values_mut().chunks_exact_mut(width + other).zip(parts) {
        row[..width].copy_from_slice(a);
        row[width..].copy_from_slice(b);
    }
}

#[cfg(test)]
mod tests;
