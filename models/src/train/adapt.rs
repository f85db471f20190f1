//! Adapting a trained model to one room, by a few labelled minutes of it and without forgetting the others.
//!
//! Of a network of descriptors everything behind the descriptors is adapted, of any other network its last linear layer. Their
//! inputs are computed once a frame ([`Adapter::features`]). The objective is
//!
//! ```text
//! sum_i w_i cross_entropy_i + strength / 2 |theta - theta_before|^2
//! ```
//! with `theta` the parameters for features of mean 0 and deviation 1: the most probable parameters under a Gaussian prior about
//! those before, so that a class without a recording keeps its place by the prior alone. The weights sum to the labelled seconds,
//! because frames within a second are one piece of evidence. Each class has the same share of them; within a class recordings
//! longer than [`LONG_S`] have nearly the same share. Simulated maps, where there are any, weigh as much as all recordings
//! together.
//!
//! Where only the empty room was recorded, one number is fitted: what is added to the logit of `empty`. The relation of the other
//! logits stays as it is.

use std::collections::VecDeque;

use candle_core::{Device, Tensor};
use radome_dsp::{Occupancy, Rdm, RdmShape};
use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::head_start::{is_trained, parameters_behind};
use crate::dataset::{Dataset, DatasetError, Split, SplitSpec};
use crate::evaluate::{Metrics, most_probable};
use crate::layer::{backward, softmax};
use crate::model_file::Model;
use crate::network::{Layer, Mode, Network, NetworkKind, Node, Parameter, Value};
use crate::occupancy_filter::{OccupancyFilter, Smoothing};
use crate::{Classifier, ClassifyError};

const CLASSES: usize = Occupancy::ALL.len();
/// Strengths of the pull that are tried, the strongest first, s of labelled frames for a squared deviation.
const STRENGTHS: [f64; 6] = [300.0, 100.0, 30.0, 10.0, 3.0, 1.0];
/// Strength where no recording can be held out.
const UNMEASURED_STRENGTH: f64 = 100.0;
/// Strength of the pull on the logit of `empty` where only the empty room was recorded, as a share of its seconds: a longer look at
/// nobody is no better reason to take people for nobody.
const EMPTY_SHARE: f64 = 1.0 / 6.0;
/// A frame counts for the time since the frame before it, and for so much at most, s: as in the occupancy filter.
const INDEPENDENT_S: f64 = 1.0;
/// Labelled time of a recording at which its share within a class is half of the largest possible, s.
const LONG_S: f64 = 10.0;
/// Labelled frames that are fitted to, about, and simulated maps at most.
const MOST_FRAMES: usize = 2000;
/// Least deviation that a feature is divided by, as in training ([`super::start`]).
const LEAST_SIGMA: f64 = 0.1;
/// Frames of a forward pass without gradients.
const BATCH: usize = 4096;
/// Steps of the minimisation at most.
const MOST_STEPS: usize = 100;
/// Steps that the minimisation remembers.
const MEMORY: usize = 10;

/// One frame of a recording as the adapted layers see it.
#[derive(Debug, Clone)]
pub struct AdaptFrame {
    /// Start of the frame on the recording's clock, s.
    pub time_s: f64,
    /// Result of [`Adapter::features`].
    pub features: Vec<f32>,
    /// Number of people; absent where nobody has said it.
    pub label: Option<Occupancy>,
}

/// A recording of the room.
#[derive(Debug, Clone)]
pub struct AdaptRecording {
    /// Time from frame to frame, s.
    pub frame_interval_s: f64,
    /// Frames in the order of time.
    pub frames: Vec<AdaptFrame>,
}

impl AdaptRecording {
    /// Labelled seconds of empty, one and two. A frame counts for the time since the frame before it, 1 s at most.
    pub fn seconds(&self) -> [f64; CLASSES] {
        let mut seconds = [0.0; CLASSES];
        let mut last_s = None;
        for frame in &self.frames {
            let elapsed_s = last_s.map_or(self.frame_interval_s, |last_s: f64| frame.time_s - last_s);
            last_s = Some(frame.time_s);
            // A clock that goes back says nothing.
            let elapsed_s = if elapsed_s > 0.0 { elapsed_s } else { self.frame_interval_s };
            if let Some(label) = frame.label {
                seconds[label.index()] += elapsed_s.min(INDEPENDENT_S);
            }
        }
        seconds
    }
}

/// Balanced accuracies over recordings, frame by frame and behind the occupancy filter.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Scores {
    /// Of each frame by itself.
    pub by_frame: f64,
    /// Of the filter's answers.
    pub filtered: f64,
}

/// Scores of the model before and after an adaptation that has not seen the recordings.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct BeforeAfter {
    /// Of the model as it was.
    pub before: Scores,
    /// Of the adapted model.
    pub after: Scores,
}

impl Scores {
    fn sum(self) -> f64 {
        self.by_frame + self.filtered
    }
}

impl BeforeAfter {
    /// Whether the adaptation makes the mean of both scores lower.
    pub fn is_worse(&self) -> bool {
        self.after.sum() < self.before.sum() - 1e-9
    }
}

/// Entry of a model card: what the model was last adapted on.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Adapted {
    /// Labelled seconds of empty, one and two.
    pub seconds: [f64; CLASSES],
    /// Recordings that they are from.
    pub recordings: usize,
    /// Strength of the pull towards the parameters before, s of labelled frames for a squared deviation.
    pub strength: f64,
    /// Simulated maps that were mixed in.
    pub simulated_maps: usize,
    /// Scores with each recording held out in turn, where that says anything.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub held_out: Option<BeforeAfter>,
}

/// Result of an adaptation.
pub struct Adaptation {
    /// The adapted model; its card has an [`Adapted`] entry.
    pub model: Model,
    /// The entry.
    pub adapted: Adapted,
    /// Scores of each recording, by a model that was adapted on the others; absent where no class of it is in two recordings.
    pub held_out: Vec<Option<BeforeAfter>>,
    /// Recordings that show empty, one and two. A class in fewer than two of them cannot be measured.
    pub recordings_by_class: [usize; CLASSES],
}

/// A model that cannot be adapted.
#[derive(Debug, Error)]
pub enum AdaptError {
    /// The network has no layer to adapt.
    #[error("{network:?} does not end in a linear layer, and nothing else of it can be adapted")]
    Network {
        /// The network.
        network: NetworkKind,
    },
    /// No frame has a label.
    #[error(
        "none of the {recordings} recordings has a labelled frame\n\nhint: label them, or say what all of a recording shows: RECORDING=empty"
    )]
    NoLabels {
        /// Recordings.
        recordings: usize,
    },
    /// The simulated maps are made in another way than the model's.
    #[error(
        "the simulated maps are not those of the model: {what}\n\nhint: build the dataset with the scene's waveform and the map spec that the model was trained with"
    )]
    Simulated {
        /// The difference.
        what: String,
    },
    /// The objective is no number where it begins.
    #[error("the loss on the recordings is not finite")]
    NonFinite,
    /// A map cannot be judged.
    #[error(transparent)]
    Classify(#[from] ClassifyError),
    /// The simulated maps cannot be read.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// A tensor operation failed.
    #[error("network: {0}")]
    Operation(#[from] candle_core::Error),
}

/// A model that is about to be adapted.
pub struct Adapter {
    classifier: Classifier,
    /// Input of the adapted layers.
    given: Value,
    /// Features and classes of simulated maps.
    simulated: Vec<(Vec<f32>, usize)>,
}

impl Adapter {
    /// Takes a model.
    ///
    /// # Errors
    /// [`AdaptError::Network`] if the network does not end in a linear layer.
    pub fn new(model: Model) -> Result<Self, AdaptError> {
        let (kind, graph) = (model.card.network, model.network.graph());
        let given = if kind.reads_descriptors() {
            graph.value("features")
        } else {
            last_node(&model.network).and_then(|node| node.inputs.first().copied())
        };
        let is_linear = last_node(&model.network).is_some_and(|node| matches!(node.layer, Layer::Linear { .. }));
        let given = given.filter(|_| is_linear).ok_or(AdaptError::Network { network: kind })?;
        Ok(Adapter { classifier: Classifier::new(model), given, simulated: Vec::new() })
    }

    /// Inputs of the adapted layers for a map.
    ///
    /// # Errors
    /// The map is not one of the model's, or a cell of it is not finite.
    pub fn features(&self, map: &Rdm) -> Result<Vec<f32>, AdaptError> {
        self.features_of(&map.db, map.shape, map.sequence)
    }

    fn features_of(&self, db: &[f32], shape: RdmShape, sequence: u64) -> Result<Vec<f32>, AdaptError> {
        let input = self.classifier.unlabelled_input(db, shape, sequence)?;
        let [_, rows, columns] = self.classifier.card().input_shape;
        let input = Tensor::from_vec(input, (1, rows, columns), &Device::Cpu)?;
        let features = self.network()?.run(&input, self.given, Mode::Evaluation)?.take(self.given)?;
        Ok(features.flatten_all()?.to_vec1()?)
    }

    fn network(&self) -> Result<&Network, AdaptError> {
        let network = self.classifier.card().network;
        self.classifier.network().ok_or(AdaptError::Network { network })
    }

    /// Mixes in the maps of a dataset's training split, 2,000 of them at most; gives their number.
    ///
    /// # Errors
    /// [`AdaptError::Simulated`] if the maps are made of another waveform or by another map spec, [`AdaptError::Dataset`] if they
    /// cannot be read.
    pub fn mix(&mut self, dataset: &Dataset) -> Result<usize, AdaptError> {
        let (header, card) = (dataset.header(), self.classifier.card());
        if header.rdm_spec != card.rdm_spec {
            return Err(AdaptError::Simulated { what: "their map spec is another".to_owned() });
        }
        if let Err(mismatch) = card.rdm_spec.check_compatible(&header.waveform, &card.waveform) {
            return Err(AdaptError::Simulated { what: mismatch.to_string() });
        }
        let splits = dataset.splits(&SplitSpec::default())?;
        let rows = dataset.rows().iter().zip(&splits).enumerate();
        let wanted: Vec<usize> = rows
            .filter(|(_, (row, split))| **split == Split::Train && !row.transition)
            .map(|(index, _)| index)
            .collect();
        let step = wanted.len().div_ceil(MOST_FRAMES).max(1);
        let mut simulated = Vec::new();
        for &index in wanted.iter().step_by(step) {
            let Some(row) = dataset.rows().get(index) else { continue };
            simulated.push((self.features_of(&dataset.map(index)?, header.shape, row.frame)?, row.label.index()));
        }
        self.simulated = simulated;
        Ok(self.simulated.len())
    }

    /// Adapts the model. Each recording in turn is held out first: that gives the scores, and the strength of the pull is the one
    /// with the best of them, so that they are a little better than those of recordings to come.
    ///
    /// The same model and recordings give the same numbers, on any number of threads.
    ///
    /// # Errors
    /// [`AdaptError::NoLabels`] if no frame has a label, [`AdaptError::NonFinite`] if the loss of the model is no number,
    /// [`AdaptError::Operation`] if features are not those of this model.
    pub fn adapt(self, recordings: &[AdaptRecording]) -> Result<Adaptation, AdaptError> {
        let by_recording: Vec<[f64; CLASSES]> = recordings.iter().map(AdaptRecording::seconds).collect();
        let seconds: [f64; CLASSES] = std::array::from_fn(|class| by_recording.iter().map(|s| s[class]).sum());
        if seconds.iter().sum::<f64>() <= 0.0 {
            return Err(AdaptError::NoLabels { recordings: recordings.len() });
        }
        let recordings_by_class: [usize; CLASSES] =
            std::array::from_fn(|class| by_recording.iter().filter(|s| s[class] > 0.0).count());
        let is_measured = recordings_by_class.map(|count| count >= 2);
        let (kind, smoothing) = (self.classifier.card().network, self.classifier.card().smoothing);
        let tail = Tail::new(self.network()?, self.given, self.classifier.card().temperature);
        let tail = tail.ok_or(AdaptError::Network { network: kind })?;
        let before = tail.numbers()?;

        let mut folds: Vec<Option<Fold>> = Vec::with_capacity(recordings.len());
        for (index, (held_out, seconds)) in recordings.iter().zip(&by_recording).enumerate() {
            if !seconds.iter().zip(is_measured).any(|(seconds, is_measured)| is_measured && *seconds > 0.0) {
                folds.push(None);
                continue;
            }
            let others = recordings.iter().enumerate().filter(|(other, _)| *other != index);
            let others: Vec<&AdaptRecording> = others.map(|(_, recording)| recording).collect();
            let fits = tail.fit(&others, &self.simulated, &STRENGTHS, &before)?;
            let judge = |numbers: &Vec<f64>| tail.judge(numbers, held_out, smoothing, is_measured);
            let after = fits.iter().map(judge).collect::<Result<Vec<_>, _>>()?;
            folds.push(Some(Fold { before: judge(&before)?, after }));
        }
        // The strongest of equals.
        let measured: Vec<&Fold> = folds.iter().flatten().collect();
        let mut chosen: Option<(usize, BeforeAfter)> = None;
        for index in (0..STRENGTHS.len()).filter(|_| !measured.is_empty()) {
            let found = compared(&measured, index);
            if chosen.is_none_or(|(_, best)| found.after.sum() > best.after.sum()) {
                chosen = Some((index, found));
            }
        }
        let all: Vec<&AdaptRecording> = recordings.iter().collect();
        let strength = match chosen {
            _ if !shows_people(&all) => EMPTY_SHARE * seconds[0],
            Some((index, _)) => STRENGTHS[index],
            None => UNMEASURED_STRENGTH,
        };
        if let [numbers] = tail.fit(&all, &self.simulated, &[strength], &before)?.as_slice() {
            tail.set(numbers)?;
        }
        let of_fold = |fold: Option<&Fold>| Some(compared(&[fold?], chosen?.0));
        let held_out = folds.iter().map(|fold| of_fold(fold.as_ref())).collect();
        let adapted = Adapted {
            seconds: seconds.map(|seconds| (10.0 * seconds).round() / 10.0),
            recordings: by_recording.iter().filter(|seconds| seconds.iter().sum::<f64>() > 0.0).count(),
            strength,
            simulated_maps: self.simulated.len(),
            held_out: chosen.map(|(_, compared)| compared),
        };
        let Some(mut model) = self.classifier.into_model() else { return Err(AdaptError::Network { network: kind }) };
        model.card.adapted = Some(adapted.clone());
        Ok(Adaptation { model, adapted, held_out, recordings_by_class })
    }
}

fn last_node(network: &Network) -> Option<&Node> {
    let graph = network.graph();
    graph.nodes.get(graph.output.checked_sub(1)?)
}

/// Whether somebody is there in a labelled frame.
fn shows_people(recordings: &[&AdaptRecording]) -> bool {
    let mut labels = recordings.iter().flat_map(|recording| &recording.frames).filter_map(|frame| frame.label);
    labels.any(|label| label != Occupancy::Empty)
}

/// A recording that was held out: judged by the model before, and by one adapted on the others for each of [`STRENGTHS`].
struct Fold {
    before: Judged,
    after: Vec<Judged>,
}

/// Counts `[truth][label]` of the measured classes.
type Confusion = [[u64; CLASSES]; CLASSES];

#[derive(Default)]
struct Judged {
    by_frame: Confusion,
    filtered: Confusion,
}

fn compared(folds: &[&Fold], strength: usize) -> BeforeAfter {
    let after = scores(folds.iter().filter_map(|fold| fold.after.get(strength)));
    BeforeAfter { before: scores(folds.iter().map(|fold| &fold.before)), after }
}

fn scores<'a>(judged: impl Iterator<Item = &'a Judged>) -> Scores {
    let mut all = Judged::default();
    for judged in judged {
        for (sum, counts) in [(&mut all.by_frame, &judged.by_frame), (&mut all.filtered, &judged.filtered)] {
            sum.iter_mut().flatten().zip(counts.iter().flatten()).for_each(|(sum, count)| *sum += count);
        }
    }
    let score = |confusion| Metrics::from_confusion(confusion).balanced_accuracy;
    Scores { by_frame: score(all.by_frame), filtered: score(all.filtered) }
}

/// A frame that is fitted to.
struct Sample<'a> {
    features: &'a [f32],
    label: usize,
    weight: f64,
}

/// Labelled frames of recordings and simulated maps with their weights; those of each of the two sum to the labelled seconds.
fn samples<'a>(recordings: &[&'a AdaptRecording], simulated: &'a [(Vec<f32>, usize)]) -> Vec<Sample<'a>> {
    let seconds: Vec<[f64; CLASSES]> = recordings.iter().map(|recording| recording.seconds()).collect();
    let total_s: f64 = seconds.iter().flatten().sum();
    let share = |seconds: f64| seconds / (seconds + LONG_S);
    let of_class: [f64; CLASSES] = std::array::from_fn(|class| seconds.iter().map(|s| share(s[class])).sum());
    let classes = of_class.iter().filter(|shares| **shares > 0.0).count();
    let labelled = recordings.iter().flat_map(|recording| &recording.frames).filter(|f| f.label.is_some()).count();
    let step = labelled.div_ceil(MOST_FRAMES).max(1);
    let mut samples = Vec::new();
    for (recording, seconds) in recordings.iter().copied().zip(&seconds) {
        for class in (0..CLASSES).filter(|class| seconds[*class] > 0.0) {
            let frames = recording.frames.iter().filter(|frame| frame.label.map(Occupancy::index) == Some(class));
            let frames: Vec<&AdaptFrame> = frames.step_by(step).collect();
            let of_recording = total_s / classes as f64 * share(seconds[class]) / of_class[class];
            let weight = of_recording / frames.len().max(1) as f64;
            samples.extend(frames.into_iter().map(|f| Sample { features: &f.features, label: class, weight }));
        }
    }
    let counts: [usize; CLASSES] = std::array::from_fn(|class| simulated.iter().filter(|s| s.1 == class).count());
    let classes = counts.iter().filter(|count| **count > 0).count();
    samples.extend(simulated.iter().filter(|(_, label)| *label < CLASSES).map(|(features, label)| Sample {
        features,
        label: *label,
        weight: total_s / (classes * counts[*label]) as f64,
    }));
    samples
}

/// Mean and deviation of each feature, by the samples' weights.
fn centring(samples: &[Sample], inputs: usize) -> Vec<(f64, f64)> {
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

/// The adapted layers of a network, with their parameters as one vector.
struct Tail<'a> {
    network: &'a Network,
    given: Value,
    parameters: Vec<&'a Parameter>,
    temperature: f64,
    /// Features of a frame.
    inputs: usize,
    /// Where weight `[output][input]` and bias of the first layer begin in the vector.
    weight: usize,
    bias: usize,
    outputs: usize,
    /// Where the bias of the logit of `empty` is.
    empty: usize,
}

impl<'a> Tail<'a> {
    /// `None` if `given` is not followed by a linear layer, or the network does not end in one.
    fn new(network: &'a Network, given: Value, temperature: f64) -> Option<Self> {
        let parameters = parameters_behind(network, given);
        let parameters: Vec<&Parameter> = parameters.into_iter().filter(|p| is_trained(network, p)).collect();
        let offset = |name: String| {
            let index = parameters.iter().position(|parameter| parameter.name == name)?;
            Some(parameters[..index].iter().map(|parameter| parameter.variable.elem_count()).sum::<usize>())
        };
        let reads_given = |node: &&Node| node.inputs == [given] && matches!(node.layer, Layer::Linear { .. });
        let first = network.graph().nodes.iter().find(reads_given)?;
        let Layer::Linear { inputs, outputs } = first.layer else { return None };
        let weight = offset(format!("{}.weight", first.name))?;
        let bias = offset(format!("{}.bias", first.name))?;
        let empty = offset(format!("{}.bias", last_node(network)?.name))?;
        Some(Tail { network, given, parameters, temperature, inputs, weight, bias, outputs, empty })
    }

    fn numbers(&self) -> Result<Vec<f64>, AdaptError> {
        let mut numbers = Vec::new();
        for parameter in &self.parameters {
            numbers.extend(parameter.variable.flatten_all()?.to_vec1::<f32>()?.into_iter().map(f64::from));
        }
        Ok(numbers)
    }

    fn set(&self, numbers: &[f64]) -> Result<(), AdaptError> {
        let mut rest = numbers.iter();
        for Parameter { variable, .. } in self.parameters.iter() {
            let values: Vec<f32> = rest.by_ref().take(variable.elem_count()).map(|&v| v as f32).collect();
            variable.set(&Tensor::from_vec(values, variable.shape(), &Device::Cpu)?)?;
        }
        Ok(())
    }

    /// Parameters for features `(x - mean) / sigma`, of those for features `x`.
    fn standardised(&self, numbers: &[f64], centring: &[(f64, f64)]) -> Vec<f64> {
        let mut numbers = numbers.to_vec();
        for row in 0..self.outputs {
            for (column, (mean, sigma)) in centring.iter().enumerate() {
                let at = self.weight + row * self.inputs + column;
                numbers[self.bias + row] += numbers[at] * mean;
                numbers[at] *= sigma;
            }
        }
        numbers
    }

    /// Judges a recording frame by frame and through the filter, which sees frames without a label too.
    fn judge(
        &self,
        numbers: &[f64],
        recording: &AdaptRecording,
        smoothing: Smoothing,
        is_measured: [bool; CLASSES],
    ) -> Result<Judged, AdaptError> {
        self.set(numbers)?;
        let output = self.network.graph().output;
        let mut filter = OccupancyFilter::new(smoothing, recording.frame_interval_s);
        let mut judged = Judged::default();
        for frames in recording.frames.chunks(BATCH) {
            let features: Vec<f32> = frames.iter().flat_map(|frame| &frame.features).copied().collect();
            let features = Tensor::from_vec(features, (frames.len(), self.inputs), &Device::Cpu)?;
            let mut values = self.network.run_from(self.given, &features, &[output], Mode::Evaluation)?;
            for (frame, logits) in frames.iter().zip(values.take(output)?.to_vec2::<f32>()?) {
                let &[empty, one, two] = softmax(&logits, self.temperature).as_slice() else { continue };
                let alone = [empty as f32, one as f32, two as f32];
                let filtered = filter.update(frame.time_s, alone);
                if let Some(label) = frame.label.map(Occupancy::index).filter(|label| is_measured[*label]) {
                    judged.by_frame[label][most_probable(&alone).index()] += 1;
                    judged.filtered[label][most_probable(&filtered).index()] += 1;
                }
            }
        }
        Ok(judged)
    }

    /// Parameters fitted to recordings and simulated maps, for each strength of the pull towards `before`; of each the next one
    /// starts. Where nobody is there in any recording, the logit of `empty` alone is fitted, whatever the strength.
    fn fit(
        &self,
        recordings: &[&AdaptRecording],
        simulated: &[(Vec<f32>, usize)],
        strengths: &[f64],
        before: &[f64],
    ) -> Result<Vec<Vec<f64>>, AdaptError> {
        let samples = samples(recordings, simulated);
        let total: f64 = samples.iter().map(|sample| sample.weight).sum();
        let centring = centring(&samples, self.inputs);
        let standardise = |sample: &Sample| -> Vec<f32> {
            let of = |(x, (mean, sigma)): (&f32, &(f64, f64))| ((f64::from(*x) - mean) / sigma) as f32;
            sample.features.iter().zip(&centring).map(of).collect()
        };
        let features: Vec<f32> = samples.iter().flat_map(standardise).collect();
        let features = Tensor::from_vec(features, (samples.len(), self.inputs), &Device::Cpu)?;
        let origin = self.standardised(before, &centring);
        let is_empty_only = !shows_people(recordings);
        let minimum = |start: Vec<f64>, strength: f64| {
            minimise(start, |numbers| {
                let (mut value, mut gradient) = self.loss(numbers, &features, &samples)?;
                for (index, g) in gradient.iter_mut().enumerate() {
                    let moved = numbers[index] - origin[index];
                    value += 0.5 * strength * moved.powi(2);
                    *g = if is_empty_only && index != self.empty { 0.0 } else { (*g + strength * moved) / total };
                }
                Ok((value / total, gradient))
            })
        };
        if is_empty_only {
            let mut raised = before.to_vec();
            let strength = EMPTY_SHARE * recordings.iter().map(|recording| recording.seconds()[0]).sum::<f64>();
            raised[self.empty] += minimum(origin.clone(), strength)?[self.empty] - origin[self.empty];
            return Ok(vec![raised; strengths.len()]);
        }
        let back: Vec<(f64, f64)> = centring.iter().map(|(mean, sigma)| (-mean / sigma, 1.0 / sigma)).collect();
        let (mut numbers, mut fits) = (origin.clone(), Vec::with_capacity(strengths.len()));
        for strength in strengths {
            numbers = minimum(numbers, *strength)?;
            fits.push(self.standardised(&numbers, &back));
        }
        Ok(fits)
    }

    /// Weighted cross-entropy of samples with these parameters for standardised features, and its gradient.
    fn loss(&self, numbers: &[f64], features: &Tensor, samples: &[Sample]) -> Result<(f64, Vec<f64>), AdaptError> {
        self.set(numbers)?;
        let output = self.network.graph().output;
        let mode = Mode::Training { seed: 0, step: 0, penalty: 0.0 };
        let logits = self.network.run_from(self.given, features, &[output], mode)?.take(output)?;
        let (mut loss, mut by_logit) = (0.0, Vec::with_capacity(CLASSES * samples.len()));
        for (sample, row) in samples.iter().zip(logits.to_vec2::<f32>()?) {
            for (class, p) in softmax(&row, self.temperature).into_iter().enumerate() {
                let target = if class == sample.label { 1.0 } else { 0.0 };
                loss -= target * sample.weight * p.max(f64::MIN_POSITIVE).ln();
                by_logit.push((sample.weight * (p - target) / self.temperature) as f32);
            }
        }
        // A sum that is linear in the logits has the same gradient here.
        let by_logit = Tensor::from_vec(by_logit, (samples.len(), CLASSES), &Device::Cpu)?;
        let gradients = backward(&(&logits * &by_logit)?.sum_all()?)?;
        let mut gradient = Vec::with_capacity(numbers.len());
        for Parameter { variable, .. } in self.parameters.iter().copied() {
            match gradients.get(variable) {
                Some(found) => gradient.extend(found.flatten_all()?.to_vec1::<f32>()?.into_iter().map(f64::from)),
                None => gradient.extend(vec![0.0; variable.elem_count()]),
            }
        }
        Ok((loss, gradient))
    }
}

/// A minimum near `start` of a function that is given with its gradient: L-BFGS (Nocedal and Wright, Numerical Optimization, 2006,
/// algorithm 7.5) with steps that are halved until the function falls.
fn minimise(
    start: Vec<f64>,
    mut function: impl FnMut(&[f64]) -> Result<(f64, Vec<f64>), AdaptError>,
) -> Result<Vec<f64>, AdaptError> {
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let sum = |a: &[f64], factor: f64, b: &[f64]| a.iter().zip(b).map(|(a, b)| a + factor * b).collect::<Vec<f64>>();
    let mut at = start;
    let (mut value, mut gradient) = function(&at)?;
    if !value.is_finite() || gradient.iter().any(|g| !g.is_finite()) {
        return Err(AdaptError::NonFinite);
    }
    // Steps and the changes of the gradient over them, the oldest first.
    let mut past: VecDeque<(Vec<f64>, Vec<f64>)> = VecDeque::new();
    for _ in 0..MOST_STEPS {
        let mut direction: Vec<f64> = gradient.iter().map(|g| -g).collect();
        let mut shares = Vec::with_capacity(past.len());
        for (step, change) in past.iter().rev() {
            let share = dot(step, &direction) / dot(step, change);
            direction = sum(&direction, -share, change);
            shares.push(share);
        }
        let scale = match past.back() {
            Some((step, change)) => dot(step, change) / dot(change, change),
            None => 1.0 / dot(&gradient, &gradient).sqrt().max(1.0),
        };
        direction.iter_mut().for_each(|d| *d *= scale);
        for ((step, change), share) in past.iter().zip(shares.iter().rev()) {
            let back = dot(change, &direction) / dot(step, change);
            direction = sum(&direction, share - back, step);
        }
        let slope = dot(&direction, &gradient);
        if slope.is_nan() || slope >= 0.0 {
            break;
        }
        let mut length = 1.0;
        let found = loop {
            let next = sum(&at, length, &direction);
            let (next_value, next_gradient) = function(&next)?;
            if next_value <= value + 1e-4 * length * slope && next_gradient.iter().all(|g| g.is_finite()) {
                break Some((next, next_value, next_gradient));
            }
            length *= 0.5;
            if length < 1e-6 {
                break None;
            }
        };
        let Some((next, next_value, next_gradient)) = found else { break };
        let (step, change) = (sum(&next, -1.0, &at), sum(&next_gradient, -1.0, &gradient));
        if dot(&step, &change) > 1e-10 * dot(&change, &change) {
            past.push_back((step, change));
            if past.len() > MEMORY {
                past.pop_front();
            }
        }
        let gain = value - next_value;
        (at, value, gradient) = (next, next_value, next_gradient);
        // Sums of f32 say no more.
        if gain < 1e-6 * value.abs() {
            break;
        }
    }
    Ok(at)
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use rand_distr::{Distribution, Normal};

    use super::*;
    use crate::layer::{DESCRIPTORS, KernelLevel};
    use crate::model_file::ModelCard;
    use crate::network::NetworkSpec;
    use crate::standardise::{MapReference, Standardisation};

    /// A model of descriptors with random numbers.
    fn model(name: &str) -> Model {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fixtures/models/paper-hqnn.safetensors");
        let card = ModelCard::load(&path).expect("a fixture");
        let NetworkSpec { kind, pooled, head } = NetworkSpec::named(name).expect("known");
        let reference = MapReference::OverNoise { skip_range_bins: 3, most_db: None };
        let standardisation =
            Standardisation { reference, mean_db: 0.0, sigma_db: 1.0, label_leaking_cells: Vec::new() };
        let latent = Default::default();
        let card = ModelCard { network: kind, pooled, head, standardisation, latent, temperature: 1.3, ..card };
        let network = Network::initialise(&card.network_spec(), 5, 0, KernelLevel::detect()).expect("a network");
        Model { card, network }
    }

    /// Features of order one about a centre of each class, of which every third frame has no label.
    fn recording(seed: u64, classes: &[Occupancy]) -> AdaptRecording {
        let mut rng = crate::stream(seed, "features", 0);
        let normal = Normal::new(0.0f32, 0.6).expect("normal");
        let mut frames = Vec::new();
        for class in classes {
            for frame in 0..90 {
                let centre = |k: usize| f32::from(k % 3 == class.index());
                let features = (0..DESCRIPTORS).map(|k| centre(k) + normal.sample(&mut rng)).collect();
                let label = (frame % 3 > 0).then_some(*class);
                frames.push(AdaptFrame { time_s: 0.1 * frames.len() as f64, features, label });
            }
        }
        AdaptRecording { frame_interval_s: 0.1, frames }
    }

    fn adapt(name: &str, recordings: &[AdaptRecording]) -> Adaptation {
        Adapter::new(model(name)).expect("adaptable").adapt(recordings).expect("adapts")
    }

    #[test]
    fn recordings_that_are_held_out_are_judged_better() {
        let recordings: Vec<AdaptRecording> = (0..3).map(|seed| recording(seed, &Occupancy::ALL)).collect();
        for (name, least) in [("descriptor_linear", 0.9), ("descriptor_hqnn", 0.6)] {
            let first = adapt(name, &recordings);
            let BeforeAfter { before, after } = first.adapted.held_out.expect("measured");
            assert!(after.by_frame > least && after.by_frame > before.by_frame + 0.1, "{name}: {before:?} {after:?}");
            assert!(first.held_out.iter().all(Option::is_some), "{name}");
            assert_eq!((first.adapted.recordings, first.recordings_by_class), (3, [3; 3]));
            assert_eq!(first.model.card.adapted.as_ref(), Some(&first.adapted));
            first.adapted.seconds.iter().for_each(|s| assert!((s - 18.0).abs() < 0.11, "{:?}", first.adapted));
            let again = adapt(name, &recordings);
            assert_eq!(first.model.network.values().expect("values"), again.model.network.values().expect("values"));
            assert_eq!(first.adapted, again.adapted);
        }
    }

    #[test]
    fn of_an_empty_room_alone_only_the_logit_of_empty_changes() {
        for name in ["descriptor_linear", "descriptor_hqnn"] {
            let before = model(name).network.values().expect("values");
            let adaptation = adapt(name, &[recording(1, &[Occupancy::Empty])]);
            assert!(
                adaptation.adapted.held_out.is_none() && (adaptation.adapted.strength - 1.0).abs() < 1e-6,
                "{name}"
            );
            assert_eq!(adaptation.recordings_by_class, [1, 0, 0]);
            let after = adaptation.model.network.values().expect("values");
            for (key, before) in &before {
                let changed: Vec<usize> = (0..before.len()).filter(|&k| before[k] != after[key][k]).collect();
                assert_eq!(changed, if key == "head.bias" { vec![0] } else { Vec::new() }, "{name} {key}");
            }
            assert!(after["head.bias"][0] > before["head.bias"][0], "{name}");
        }
    }

    /// The share of a class does not depend on how long it was recorded, nor that of a recording on its frame rate.
    #[test]
    fn classes_weigh_the_same_and_weights_sum_to_the_labelled_seconds() {
        let short = recording(1, &[Occupancy::Empty]);
        let mut long = recording(2, &[Occupancy::One, Occupancy::One, Occupancy::One, Occupancy::Empty]);
        long.frames.iter_mut().for_each(|frame| frame.time_s *= 2.0);
        let simulated = vec![(vec![0.0; DESCRIPTORS], 2), (vec![0.0; DESCRIPTORS], 2), (vec![0.0; DESCRIPTORS], 0)];
        let seconds: f64 = [&short, &long].iter().flat_map(|recording| recording.seconds()).sum();
        let all = samples(&[&short, &long], &simulated);
        let (real, simulated) = all.split_at(all.len() - simulated.len());
        let of = |samples: &[Sample], class| -> f64 {
            samples.iter().filter(|sample| sample.label == class).map(|sample| sample.weight).sum()
        };
        for (found, expected) in [(of(real, 0), 0.5), (of(real, 1), 0.5), (of(real, 2), 0.0)] {
            assert!((found / seconds - expected).abs() < 1e-9, "{found} of {seconds}");
        }
        for (found, expected) in [(of(simulated, 0), 0.5), (of(simulated, 1), 0.0), (of(simulated, 2), 0.5)] {
            assert!((found / seconds - expected).abs() < 1e-9, "{found} of {seconds}");
        }
    }

    /// The gradient beside differences, and the minimum of a narrow valley (Rosenbrock's).
    #[test]
    fn gradients_are_those_of_differences_and_lead_to_a_minimum() {
        let model = model("descriptor_hqnn");
        let given = model.network.graph().value("features").expect("features");
        let tail = Tail::new(&model.network, given, 1.3).expect("a tail");
        let recording = recording(3, &Occupancy::ALL);
        let samples = samples(&[&recording], &[]);
        let features: Vec<f32> = samples.iter().flat_map(|sample| sample.features.to_vec()).collect();
        let features = Tensor::from_vec(features, (samples.len(), DESCRIPTORS), &Device::Cpu).expect("tensor");
        let numbers = tail.numbers().expect("numbers");
        let centring: Vec<(f64, f64)> = (0..DESCRIPTORS).map(|k| (k as f64 - 7.0, 0.1 + k as f64)).collect();
        let back: Vec<(f64, f64)> = centring.iter().map(|(mean, sigma)| (-mean / sigma, 1.0 / sigma)).collect();
        let there_and_back = tail.standardised(&tail.standardised(&numbers, &centring), &back);
        assert!(numbers.len() > 90 && there_and_back.iter().zip(&numbers).all(|(a, b)| (a - b).abs() < 1e-9));
        let (_, gradient) = tail.loss(&numbers, &features, &samples).expect("loss");
        for k in (0..numbers.len()).step_by(7) {
            let at = |by: f64| {
                let mut moved = numbers.clone();
                moved[k] += by;
                tail.loss(&moved, &features, &samples).expect("loss").0
            };
            let difference = (at(5e-3) - at(-5e-3)) / 1e-2;
            assert!(
                (gradient[k] - difference).abs() < 0.02 * difference.abs().max(1.0),
                "{k}: {} {difference}",
                gradient[k]
            );
        }
        let valley = |x: &[f64]| {
            let (a, b) = (1.0 - x[0], x[1] - x[0] * x[0]);
            Ok((a * a + 100.0 * b * b + 1.0, vec![-2.0 * a - 400.0 * x[0] * b, 200.0 * b]))
        };
        let found = minimise(vec![-1.2, 1.0], valley).expect("a minimum");
        assert!(found.iter().all(|x| (x - 1.0).abs() < 0.02), "{found:?}");
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn no_label_and_features_of_another_model_are_refused() {
            let mut unlabelled = recording(1, &Occupancy::ALL);
            unlabelled.frames.iter_mut().for_each(|frame| frame.label = None);
            let adapter = || Adapter::new(model("descriptor_linear")).expect("adaptable");
            let error = adapter().adapt(&[unlabelled]).err().expect("refused");
            assert!(matches!(error, AdaptError::NoLabels { recordings: 1 }), "{error}");
            assert!(error.to_string().contains("hint: "), "{error}");
            let mut other = recording(1, &Occupancy::ALL);
            other.frames.iter_mut().for_each(|frame| frame.features.truncate(3));
            let error = adapter().adapt(&[other]).err().expect("refused");
            assert!(matches!(error, AdaptError::Operation(_)), "{error}");
        }

        /// Nothing can be held out where each class is in one recording; the model is adapted all the same.
        #[test]
        fn one_recording_of_each_class_is_adapted_to_and_not_measured() {
            let each = Occupancy::ALL.map(|class| recording(class.index() as u64, &[class]));
            let adaptation = adapt("descriptor_linear", &each);
            assert_eq!(adaptation.recordings_by_class, [1; 3]);
            assert!(adaptation.adapted.held_out.is_none() && adaptation.held_out.iter().all(Option::is_none));
            assert_eq!(adaptation.adapted.strength, UNMEASURED_STRENGTH);
        }

        #[test]
        fn a_clock_that_stands_still_counts_the_frame_interval() {
            let mut still = recording(1, &[Occupancy::Two]);
            still.frames.iter_mut().for_each(|frame| frame.time_s = f64::NAN);
            let [_, _, two_s] = still.seconds();
            assert!((two_s - 6.0).abs() < 1e-6, "{two_s}");
            adapt("descriptor_linear", &[still]);
        }
    }
}
