//! Adapted layers of a network, with their parameters as one vector, and the frames that they are fitted to.

use candle_core::{Device, Tensor};
use radome_dsp::Occupancy;

use super::error::AdaptError;
use super::recording::{AdaptFrame, AdaptRecording, LONG_S, MOST_FRAMES, learnable_classes};
use crate::evidence_mean::EvidenceMean;
use crate::layer::{backward, softmax};
use crate::metrics::{CLASSES, Confusion, Metrics, add_confusion, most_probable};
use crate::model::{ModelCard, Scores};
use crate::network::{Layer, Mode, Network, Node, Parameter, Value};
use crate::occupancy_filter::OccupancyFilter;
use crate::train::full_batch::{cross_entropy, one_hot};
use crate::train::head_start::{is_trained, parameters_behind};
use crate::train::minimise::minimise;
use crate::train::parameter_vector::ParameterVector;

/// Largest strength of the penalty on biases, s of labelled frames for a squared deviation. Half a minute of labels determines a
/// few biases; weights would overfit to the few people in it.
pub(super) const BIAS_STRENGTH: f64 = 100.0;
/// Strength of the penalty on the common shift of the logits of the shown classes, as a share of the labelled seconds. A longer
/// recording of the empty room must not make the model miss people.
const EMPTY_STRENGTH_SHARE: f64 = 1.0 / 12.0;
/// The same where people are shown. It is larger, because a recording shows a few of all people, but the whole empty room.
const PEOPLE_STRENGTH_SHARE: f64 = 1.0;
/// Least deviation that a feature is divided by, as in training (`train/start.rs`).
const LEAST_SIGMA: f64 = 0.1;
/// Largest number of steps of a fit, and least gain of a step as a share of the loss. Smaller gains are below the
/// rounding errors of f32 sums.
const MOST_STEPS: usize = 100;
const LEAST_GAIN: f64 = 1e-6;
/// Frames of a forward pass without gradients.
const BATCH: usize = 4096;

/// Confusion of a model on labelled frames, for single frames and behind the filter.
#[derive(Default)]
pub(super) struct Confusions {
    by_frame: Confusion,
    filtered: Confusion,
}

impl Confusions {
    /// Scores over several recordings.
    pub(super) fn scores<'a>(recordings: impl Iterator<Item = &'a Confusions>) -> Scores {
        let mut all = Confusions::default();
        for recording in recordings {
            add_confusion(&mut all.by_frame, &recording.by_frame);
            add_confusion(&mut all.filtered, &recording.filtered);
        }
        let score = |confusion| Metrics::from_confusion(confusion).balanced_accuracy;
        Scores { by_frame: score(all.by_frame), filtered: score(all.filtered) }
    }
}

/// Strength of the penalty on the shift of the classes that these recordings show.
pub(super) fn shift_strength(recordings: &[&AdaptRecording]) -> f64 {
    let seconds = recordings.iter().map(|recording| recording.seconds());
    let seconds = seconds.fold([0.0; CLASSES], |sum, s| std::array::from_fn(|class| sum[class] + s[class]));
    let is_shown = learnable_classes(seconds);
    let [_, one, two] = is_shown;
    let share = if one || two { PEOPLE_STRENGTH_SHARE } else { EMPTY_STRENGTH_SHARE };
    share * seconds.iter().zip(is_shown).filter(|(_, shown)| *shown).map(|(seconds, _)| seconds).sum::<f64>()
}

/// Group of each class; a fit distinguishes groups. A class without samples is in the group of its neighbour: two people with one
/// person, one person with two people, the empty room with one person.
fn groups(shown: [bool; CLASSES]) -> [usize; CLASSES] {
    match shown {
        [true, true, true] => [0, 1, 2],
        [true, false, true] | [true, true, false] => [0, 1, 1],
        [false, true, true] => [1, 1, 2],
        _ => [0; CLASSES],
    }
}

/// Target probabilities of a fit for a label. Within a group they keep the ratios of these `probabilities`, so that frames of one class
/// do not change how the model distinguishes the classes of its group.
fn group_targets(groups: [usize; CLASSES], label: usize, probabilities: &[f64]) -> [f64; CLASSES] {
    let group = |class: usize| if groups[class] == groups[label] { probabilities[class] } else { 0.0 };
    let sum: f64 = (0..CLASSES).map(group).sum();
    if sum > 0.0 { std::array::from_fn(|class| group(class) / sum) } else { one_hot(label) }
}

/// The last layer of a network.
pub(super) fn last_node(network: &Network) -> Option<&Node> {
    let graph = network.graph();
    graph.nodes.get(graph.output.checked_sub(1)?)
}

/// Frame in a fit.
#[derive(Clone)]
struct Sample<'a> {
    features: &'a [f32],
    label: usize,
    /// Target probabilities of the classes.
    targets: [f64; CLASSES],
    weight: f64,
}

impl<'a> Sample<'a> {
    fn new(features: &'a [f32], label: usize, weight: f64) -> Self {
        Sample { features, label, targets: one_hot(label), weight }
    }
}

/// Labelled frames of recordings and simulated maps with their weights. The weights of each of the two sum to the
/// labelled seconds.
fn samples<'a>(recordings: &[&'a AdaptRecording], simulated: &'a [(Vec<f32>, usize)]) -> Vec<Sample<'a>> {
    let seconds: Vec<[f64; CLASSES]> = recordings.iter().map(|recording| recording.seconds()).collect();
    let total_s: f64 = seconds.iter().flatten().sum();
    let is_shown = learnable_classes(std::array::from_fn(|class| seconds.iter().map(|s| s[class]).sum()));
    let share = |seconds: f64| seconds / (seconds + LONG_S);
    let class_shares: [f64; CLASSES] = std::array::from_fn(|class| seconds.iter().map(|s| share(s[class])).sum());
    let classes = is_shown.iter().filter(|shown| **shown).count();
    let labelled = recordings.iter().flat_map(|recording| &recording.frames).filter(|f| f.label.is_some()).count();
    let step = labelled.div_ceil(MOST_FRAMES).max(1);
    let mut samples = Vec::new();
    for (recording, seconds) in recordings.iter().copied().zip(&seconds) {
        for class in (0..CLASSES).filter(|class| is_shown[*class] && seconds[*class] > 0.0) {
            let frames = recording.frames.iter().filter(|frame| frame.label.map(Occupancy::index) == Some(class));
            let frames: Vec<&AdaptFrame> = frames.step_by(step).collect();
            let recording_weight = total_s / classes as f64 * share(seconds[class]) / class_shares[class];
            let weight = recording_weight / frames.len().max(1) as f64;
            samples.extend(frames.into_iter().map(|f| Sample::new(&f.features, class, weight)));
        }
    }
    let counts: [usize; CLASSES] = std::array::from_fn(|class| simulated.iter().filter(|s| s.1 == class).count());
    let classes = counts.iter().filter(|count| **count > 0).count();
    let simulated = simulated.iter().filter(|(_, label)| *label < CLASSES);
    samples.extend(
        simulated.map(|(features, label)| Sample::new(features, *label, total_s / (classes * counts[*label]) as f64)),
    );
    samples
}

/// Mean and deviation of each feature, by the samples' weights.
fn normalisation(samples: &[Sample], inputs: usize) -> Vec<(f64, f64)> {
    let total: f64 = samples.iter().map(|sample| sample.weight).sum();
    let mut moments = vec![(0.0f64, 0.0f64); inputs];
    for sample in samples {
        for ((mean, _), &x) in moments.iter_mut().zip(sample.features) {
            *mean += sample.weight / total * f64::from(x);
        }
    }
    for sample in samples {
        for ((mean, variance), &x) in moments.iter_mut().zip(sample.features) {
            *variance += sample.weight / total * (f64::from(x) - *mean).powi(2);
        }
    }
    moments.into_iter().map(|(mean, variance)| (mean, variance.sqrt().max(LEAST_SIGMA))).collect()
}

/// The adapted layers of a network.
pub(super) struct AdaptedLayers<'a> {
    network: &'a Network,
    /// Input of the layers.
    input: Value,
    parameters: ParameterVector<'a>,
    temperature: f64,
    /// Number of features of a frame.
    features: usize,
    /// Position in the vector of the first layer's weight `[output][feature]`.
    weight_offset: usize,
    /// Position in the vector of the first layer's bias.
    bias_offset: usize,
    /// Number of outputs of the first layer.
    outputs: usize,
    /// Position in the vector of the biases of the logits.
    logit_offset: usize,
}

impl<'a> AdaptedLayers<'a> {
    /// Selects the layers of a network behind the value `input`. `None` if no linear layer reads `input`, or the network does not end
    /// in one.
    pub(super) fn new(network: &'a Network, input: Value, temperature: f64) -> Option<Self> {
        let parameters = parameters_behind(network, input);
        let parameters = ParameterVector::new(parameters.into_iter().filter(|p| is_trained(network, p)).collect());
        let reads_input = |node: &&Node| node.inputs == [input] && matches!(node.layer, Layer::Linear { .. });
        let first = network.graph().nodes.iter().find(reads_input)?;
        let Layer::Linear { inputs: features, outputs } = first.layer else { return None };
        let weight_offset = parameters.offset(&format!("{}.weight", first.name))?;
        let bias_offset = parameters.offset(&format!("{}.bias", first.name))?;
        let logit_offset = parameters.offset(&format!("{}.bias", last_node(network)?.name))?;
        Some(AdaptedLayers {
            network,
            input,
            parameters,
            temperature,
            features,
            weight_offset,
            bias_offset,
            outputs,
            logit_offset,
        })
    }

    pub(super) fn numbers(&self) -> Result<Vec<f64>, AdaptError> {
        Ok(self.parameters.numbers()?)
    }

    pub(super) fn set(&self, numbers: &[f64]) -> Result<(), AdaptError> {
        Ok(self.parameters.set(numbers)?)
    }

    /// Converts parameters for features `x` to those for features `(x - mean) / sigma`.
    fn standardised(&self, numbers: &[f64], normalisation: &[(f64, f64)]) -> Vec<f64> {
        let mut numbers = numbers.to_vec();
        for row in 0..self.outputs {
            for (column, (mean, sigma)) in normalisation.iter().enumerate() {
                let weight = self.weight_offset + row * self.features + column;
                numbers[self.bias_offset + row] += numbers[weight] * mean;
                numbers[weight] *= sigma;
            }
        }
        numbers
    }

    /// Probabilities of the classes for features, with the present parameters.
    fn probabilities(&self, features: &Tensor) -> Result<Vec<Vec<f64>>, AdaptError> {
        let output = self.network.graph().output;
        let logits = self.network.run_from(self.input, features, &[output], Mode::Evaluation)?.take(output)?;
        Ok(logits.to_vec2::<f32>()?.iter().map(|logits| softmax(logits, self.temperature)).collect())
    }

    /// Classifies a recording frame by frame and through the filter, which also uses frames without a label.
    pub(super) fn confusions(
        &self,
        numbers: &[f64],
        recording: &AdaptRecording,
        card: &ModelCard,
    ) -> Result<Confusions, AdaptError> {
        self.set(numbers)?;
        let mut mean = EvidenceMean::new(card.memory_s);
        let mut filter = OccupancyFilter::new(card.smoothing, recording.frame_interval_s);
        let mut confusions = Confusions::default();
        for frames in recording.frames.chunks(BATCH) {
            let features: Vec<f32> = frames.iter().flat_map(|frame| &frame.features).copied().collect();
            let features = Tensor::from_vec(features, (frames.len(), self.features), &Device::Cpu)?;
            for (frame, probabilities) in frames.iter().zip(self.probabilities(&features)?) {
                let &[empty, one, two] = probabilities.as_slice() else { continue };
                let by_frame = mean.update(frame.time_s, [empty as f32, one as f32, two as f32]);
                let filtered = filter.update(frame.time_s, by_frame);
                if let Some(label) = frame.label.map(Occupancy::index) {
                    confusions.by_frame[label][most_probable(&by_frame).index()] += 1;
                    confusions.filtered[label][most_probable(&filtered).index()] += 1;
                }
            }
        }
        Ok(confusions)
    }

    /// Fits parameters to recordings and simulated maps, for each strength of the penalty on the distance from `prior`; each fit starts
    /// from the result of the preceding one. The fit distinguishes [`groups`] of classes. If samples do not show both one person and
    /// two, only logits are shifted, whatever the strength.
    pub(super) fn fit(
        &self,
        recordings: &[&AdaptRecording],
        simulated: &[(Vec<f32>, usize)],
        strengths: &[f64],
        prior: &[f64],
    ) -> Result<Vec<Vec<f64>>, AdaptError> {
        let mut samples = samples(recordings, simulated);
        let total: f64 = samples.iter().map(|sample| sample.weight).sum();
        let is_shown: [bool; CLASSES] = std::array::from_fn(|class| samples.iter().any(|sample| sample.label == class));
        let groups = groups(is_shown);
        let normalisation = normalisation(&samples, self.features);
        let standardise = |sample: &Sample| -> Vec<f32> {
            let normalised = |(x, (mean, sigma)): (&f32, &(f64, f64))| ((f64::from(*x) - mean) / sigma) as f32;
            sample.features.iter().zip(&normalisation).map(normalised).collect()
        };
        let features: Vec<f32> = samples.iter().flat_map(standardise).collect();
        let features = Tensor::from_vec(features, (samples.len(), self.features), &Device::Cpu)?;
        let standardised_prior = self.standardised(prior, &normalisation);
        self.set(&standardised_prior)?;
        for (sample, probabilities) in samples.iter_mut().zip(self.probabilities(&features)?) {
            sample.targets = group_targets(groups, sample.label, &probabilities);
        }
        let shift_strength = shift_strength(recordings);
        if is_shown[1..].contains(&false) {
            let between = self.shift_between(&standardised_prior, &features, &samples, groups)?;
            let shifted = self.shifted(&standardised_prior, between);
            let common = self.shift_shown(&shifted, &features, &samples, is_shown, shift_strength)?;
            return Ok(vec![self.shifted(&self.shifted(prior, between), common); strengths.len()]);
        }
        let largest_strength = |p: &Parameter| if p.name.ends_with(".bias") { BIAS_STRENGTH } else { f64::INFINITY };
        let largest_strengths = self.parameters.by_parameter(largest_strength);
        let minimum = |start: Vec<f64>, strength: f64| {
            let numbers = minimise(start, MOST_STEPS, LEAST_GAIN, |numbers| {
                let (mut value, mut gradient) = self.loss(numbers, &features, &samples)?;
                for (index, g) in gradient.iter_mut().enumerate() {
                    let change = numbers[index] - standardised_prior[index];
                    let strength = strength.min(largest_strengths[index]);
                    value += 0.5 * strength * change.powi(2);
                    *g = (*g + strength * change) / total;
                }
                Ok::<_, AdaptError>((value / total, gradient))
            })?;
            numbers.ok_or(AdaptError::NonFinite)
        };
        let inverse: Vec<(f64, f64)> = normalisation.iter().map(|(mean, sigma)| (-mean / sigma, 1.0 / sigma)).collect();
        let (mut numbers, mut fits) = (standardised_prior.clone(), Vec::with_capacity(strengths.len()));
        for strength in strengths {
            numbers = minimum(numbers, *strength)?;
            let common = self.shift_shown(&numbers, &features, &samples, is_shown, shift_strength)?;
            fits.push(self.shifted(&self.standardised(&numbers, &inverse), common));
        }
        Ok(fits)
    }

    /// Finds the shift of the logits of the first group of classes. It is zero if there is only one group.
    fn shift_between(
        &self,
        numbers: &[f64],
        features: &Tensor,
        samples: &[Sample],
        groups: [usize; CLASSES],
    ) -> Result<[f64; CLASSES], AdaptError> {
        let first = groups.map(|group| group == groups[0]);
        if !first.contains(&false) {
            Ok([0.0; CLASSES])
        } else {
            self.shift(numbers, features, samples, first, BIAS_STRENGTH)
        }
    }

    /// Finds the common shift of the logits of the shown classes; it is zero if all are shown. Frames are weighted by the probability
    /// of other classes, so that a model that is right about these frames does not change.
    fn shift_shown(
        &self,
        numbers: &[f64],
        features: &Tensor,
        samples: &[Sample],
        is_shown: [bool; CLASSES],
        strength: f64,
    ) -> Result<[f64; CLASSES], AdaptError> {
        if !is_shown.contains(&false) {
            return Ok([0.0; CLASSES]);
        }
        self.set(numbers)?;
        let mut samples = samples.to_vec();
        for (sample, probabilities) in samples.iter_mut().zip(self.probabilities(features)?) {
            sample.targets = one_hot(sample.label);
            let others = probabilities.iter().zip(is_shown).filter(|(_, is_shown)| !is_shown);
            sample.weight *= others.map(|(p, _)| p).sum::<f64>();
        }
        self.shift(numbers, features, &samples, is_shown, strength)
    }

    /// Finds the common shift of the logits of these classes with the least loss, with a penalty of this strength.
    fn shift(
        &self,
        numbers: &[f64],
        features: &Tensor,
        samples: &[Sample],
        classes: [bool; CLASSES],
        strength: f64,
    ) -> Result<[f64; CLASSES], AdaptError> {
        let by_class = |shift: &[f64]| {
            classes.map(|is_shifted| if is_shifted { shift.first().copied().unwrap_or(0.0) } else { 0.0 })
        };
        let total: f64 = samples.iter().map(|sample| sample.weight).sum::<f64>().max(f64::MIN_POSITIVE);
        let best = minimise(vec![0.0], MOST_STEPS, LEAST_GAIN, |shift| {
            let (mut value, gradient) = self.loss(&self.shifted(numbers, by_class(shift)), features, samples)?;
            let slopes = gradient.iter().skip(self.logit_offset).zip(classes);
            let mut slope: f64 = slopes.filter(|(_, is_shifted)| *is_shifted).map(|(g, _)| g).sum();
            for shift in shift {
                value += 0.5 * strength * shift * shift;
                slope += strength * shift;
            }
            Ok::<_, AdaptError>((value / total, vec![slope / total]))
        })?;
        Ok(by_class(&best.ok_or(AdaptError::NonFinite)?))
    }

    /// Parameters with `shifts` added to the logits.
    fn shifted(&self, numbers: &[f64], shifts: [f64; CLASSES]) -> Vec<f64> {
        let mut numbers = numbers.to_vec();
        numbers.iter_mut().skip(self.logit_offset).zip(shifts).for_each(|(bias, shift)| *bias += shift);
        numbers
    }

    /// Weighted cross-entropy of samples with these parameters for standardised features, and its gradient.
    fn loss(&self, numbers: &[f64], features: &Tensor, samples: &[Sample]) -> Result<(f64, Vec<f64>), AdaptError> {
        self.set(numbers)?;
        let output = self.network.graph().output;
        let mode = Mode::Training { seed: 0, step: 0, penalty: 0.0 };
        let logits = self.network.run_from(self.input, features, &[output], mode)?.take(output)?;
        let targets: Vec<_> = samples.iter().map(|sample| (sample.targets, sample.weight)).collect();
        let (loss, by_logit) = cross_entropy(&logits.to_vec2()?, &targets, self.temperature);
        // This sum is linear in the logits and has the same gradient at this point.
        let by_logit = Tensor::from_vec(by_logit, (samples.len(), CLASSES), &Device::Cpu)?;
        let gradients = backward(&(&logits * &by_logit)?.sum_all()?)?;
        let gradient = self.parameters.gradient(&gradients)?;
        Ok((loss, gradient))
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::{model, recording};
    use super::*;
    use crate::layer::DESCRIPTORS;

    /// Weights of a class do not depend on its recorded time, and weights of a recording do not depend on its frame rate.
    #[test]
    fn classes_weigh_the_same_and_weights_sum_to_the_labelled_seconds() {
        let short = recording(1, &[Occupancy::Empty]);
        let mut long = recording(2, &[Occupancy::One, Occupancy::One, Occupancy::One, Occupancy::Empty]);
        long.frames.iter_mut().for_each(|frame| frame.time_s *= 2.0);
        let simulated = vec![(vec![0.0; DESCRIPTORS], 2), (vec![0.0; DESCRIPTORS], 2), (vec![0.0; DESCRIPTORS], 0)];
        let seconds: f64 = [&short, &long].iter().flat_map(|recording| recording.seconds()).sum();
        let all = samples(&[&short, &long], &simulated);
        let (real, simulated) = all.split_at(all.len() - simulated.len());
        let weight = |samples: &[Sample], class| -> f64 {
            samples.iter().filter(|sample| sample.label == class).map(|sample| sample.weight).sum()
        };
        for (found, expected) in [(weight(real, 0), 0.5), (weight(real, 1), 0.5), (weight(real, 2), 0.0)] {
            assert!((found / seconds - expected).abs() < 1e-9, "{found} of {seconds}");
        }
        for (found, expected) in [(weight(simulated, 0), 0.5), (weight(simulated, 1), 0.0), (weight(simulated, 2), 0.5)]
        {
            assert!((found / seconds - expected).abs() < 1e-9, "{found} of {seconds}");
        }
    }

    #[test]
    fn targets_keep_the_ratios_within_a_group() {
        let assert_near = |found: [f64; CLASSES], expected: [f64; CLASSES]| {
            assert!(found.iter().zip(expected).all(|(found, expected)| (found - expected).abs() < 1e-12), "{found:?}");
        };
        assert_near(group_targets([0, 1, 1], 1, &[0.2, 0.6, 0.2]), [0.0, 0.75, 0.25]);
        assert_near(group_targets([0, 1, 1], 0, &[0.2, 0.6, 0.2]), [1.0, 0.0, 0.0]);
        // The label's probability has underflowed.
        assert_near(group_targets([1, 1, 2], 2, &[0.5, 0.5, 0.0]), [0.0, 0.0, 1.0]);
    }

    #[test]
    fn gradients_are_those_of_differences() {
        let model = model("descriptor_hqnn");
        let input = model.network.graph().value("features").expect("features");
        let layers = AdaptedLayers::new(&model.network, input, 1.3).expect("layers");
        let recording = recording(3, &Occupancy::ALL);
        let mut samples = samples(&[&recording], &[]);
        samples.iter_mut().step_by(2).for_each(|sample| sample.targets = [0.2, 0.5, 0.3]);
        let features: Vec<f32> = samples.iter().flat_map(|sample| sample.features.to_vec()).collect();
        let features = Tensor::from_vec(features, (samples.len(), DESCRIPTORS), &Device::Cpu).expect("tensor");
        let numbers = layers.numbers().expect("numbers");
        let normalisation: Vec<(f64, f64)> = (0..DESCRIPTORS).map(|k| (k as f64 - 7.0, 0.1 + k as f64)).collect();
        let inverse: Vec<(f64, f64)> = normalisation.iter().map(|(mean, sigma)| (-mean / sigma, 1.0 / sigma)).collect();
        let round_trip = layers.standardised(&layers.standardised(&numbers, &normalisation), &inverse);
        assert!(numbers.len() > 90 && round_trip.iter().zip(&numbers).all(|(a, b)| (a - b).abs() < 1e-9));
        let (_, gradient) = layers.loss(&numbers, &features, &samples).expect("loss");
        for k in (0..numbers.len()).step_by(7) {
            let at = |by: f64| {
                let mut moved = numbers.clone();
                moved[k] += by;
                layers.loss(&moved, &features, &samples).expect("loss").0
            };
            let difference = (at(5e-3) - at(-5e-3)) / 1e-2;
            assert!(
                (gradient[k] - difference).abs() < 0.02 * difference.abs().max(1.0),
                "{k}: {} {difference}",
                gradient[k]
            );
        }
    }
}
