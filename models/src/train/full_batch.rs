//! Minimisation of the loss over all training maps at once, after the epochs.
//!
//! A network of descriptors has about a hundred parameters. With steps over batches, the result depends on the order of
//! the maps: of five seeds of room-hqnn, the best was right in 50 % more frames of a real person than the worst. The
//! minimum over all maps hardly depends on the seed. Descriptors are computed once, so that a step takes milliseconds.

use candle_core::{Device, Tensor};

use super::data::Data;
use super::error::TrainError;
use super::head_start::is_trained;
use super::minimise::minimise;
use super::parameter_vector::ParameterVector;
use super::spec::FullBatch;
use super::start::rows_of;
use crate::layer::{backward, softmax};
use crate::metrics::CLASSES;
use crate::network::{Mode, Network, Parameter, names};

/// Least gain of a step, as a share of the loss.
const LEAST_GAIN: f64 = 1e-7;

/// Returns whether an array holds the weights of a dense layer or a kernel, which decay and are penalised. Biases,
/// constants of normalisations and angles are not.
pub(super) fn is_weight(parameter: &Parameter) -> bool {
    parameter.name.ends_with(".weight") && parameter.variable.rank() > 1
}

/// Moves the parameters of a network of descriptors to a minimum of the loss over the training split.
///
/// The loss is the cross-entropy with the weights of the classes, `latent_penalty` times the mean square of the latent, and
/// [`FullBatch::weight_penalty`]. Returns whether it was finite at the start.
pub(super) fn fit(
    network: &Network,
    data: &Data,
    settings: FullBatch,
    latent_penalty: f64,
) -> Result<bool, TrainError> {
    let graph = network.graph();
    let input = network.value_of(names::DESCRIPTORS)?;
    let positions: Vec<usize> = (0..data.train.maps.len()).collect();
    let rows = rows_of(network, data, &data.train, &positions, input)?;
    let width = rows.first().map_or(0, Vec::len);
    let descriptors = Tensor::from_vec(rows.concat(), (rows.len(), width), &Device::Cpu)?;
    let weight = |&label: &usize| data.class_weights.get(label).copied().map_or(0.0, f64::from);
    let total: f64 = data.train.labels.iter().map(weight).sum();
    let samples: Vec<_> = data.train.labels.iter().map(|label| (one_hot(*label), weight(label) / total)).collect();

    let is_fitted = |p: &&Parameter| is_trained(network, p) && names::layer_of(&p.name) != names::WARM_UP;
    let parameters = ParameterVector::new(network.trained().iter().filter(is_fitted).collect());
    let penalties = parameters.by_parameter(|p| if is_weight(p) { settings.weight_penalty } else { 0.0 });
    let latent = (latent_penalty > 0.0).then(|| network.value_of(names::LATENT)).transpose()?;
    let wanted: Vec<_> = [graph.output].into_iter().chain(latent).collect();
    let mode = Mode::Training { seed: 0, step: 0, penalty: latent_penalty as f32 };
    let minimum = minimise(parameters.numbers()?, settings.steps, LEAST_GAIN, |numbers| {
        parameters.set(numbers)?;
        let mut values = network.run_from(input, &descriptors, &wanted, mode)?;
        let square = match latent {
            Some(latent) => f64::from(values.get(latent)?.sqr()?.mean_all()?.to_scalar::<f32>()?),
            None => 0.0,
        };
        let logits = values.take(graph.output)?;
        let (mut loss, by_logit) = cross_entropy(&logits.to_vec2()?, &samples, 1.0);
        let by_logit = Tensor::from_vec(by_logit, logits.shape(), &Device::Cpu)?;
        // This sum is linear in the logits and has the same gradient at this point.
        let mut gradient = parameters.gradient(&backward(&(&logits * &by_logit)?.sum_all()?)?)?;
        loss += latent_penalty * square;
        for ((g, number), penalty) in gradient.iter_mut().zip(numbers).zip(&penalties) {
            loss += penalty * number * number;
            *g += 2.0 * penalty * number;
        }
        Ok::<_, TrainError>((loss, gradient))
    })?;
    let is_finite = minimum.is_some();
    if let Some(numbers) = minimum {
        parameters.set(&numbers)?;
    }
    Ok(is_finite)
}

/// Weighted sum of the cross-entropies of samples at a temperature, and its derivative by each logit, row by row. A sample is its
/// target probabilities and its weight.
pub(super) fn cross_entropy(
    logits: &[Vec<f32>],
    samples: &[([f64; CLASSES], f64)],
    temperature: f64,
) -> (f64, Vec<f32>) {
    let (mut loss, mut by_logit) = (0.0, Vec::with_capacity(CLASSES * samples.len()));
    for ((targets, weight), row) in samples.iter().zip(logits) {
        for (target, p) in targets.iter().zip(softmax(row, temperature)) {
            loss -= weight * target * p.max(f64::MIN_POSITIVE).ln();
            by_logit.push((weight * (p - target) / temperature) as f32);
        }
    }
    (loss, by_logit)
}

/// Probabilities that are 1 for one class and 0 for the others.
pub(super) fn one_hot(class: usize) -> [f64; CLASSES] {
    std::array::from_fn(|other| f64::from(u8::from(other == class)))
}
