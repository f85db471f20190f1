//! Adaptation of a trained model to one room by a few labelled minutes, without forgetting other rooms.
//!
//! In a network of descriptors all layers behind the descriptors are adapted, in any other network its last linear layer. Their
//! inputs are computed once for each frame ([`Adapter::features`]). The objective is
//!
//! ```text
//! sum_i w_i cross_entropy_i + strength / 2 |theta - theta_before|^2
//! ```
//! with `theta` the parameters for features of mean 0 and deviation 1: the most probable parameters under a Gaussian prior about
//! those before. The strength for biases is at most 100 s, because half a minute of labels determines a few biases, but not
//! weights. The weights of the samples sum to the labelled seconds, because frames within a second are one piece of evidence. Each
//! class has the same share of them; within a class, recordings of more than 10 s have nearly the same share. Simulated maps, if
//! there are any, weigh as much as all recordings together.
//!
//! The strength is chosen by cross-validation over recordings. With less labelled time fewer weak strengths are tried: all
//! recordings of a minute show the same people, so held-out recordings do not show the loss on other people.
//!
//! A class without recordings and simulated maps is grouped with its neighbour, and the fit distinguishes groups only: within a
//! group, it keeps the ratios of the probabilities before. If that class is one person or two, only the logits are shifted, because
//! weights that are fitted without its frames change its predictions. (A network of two qubits that distinguished the empty room
//! from two people better called one person two.) Then one common shift of the logits of the shown classes is fitted, to frames
//! weighted by the probability of the other classes. So recordings of the empty room alone do not change a model that is right
//! about them. One or two people who are labelled for a few seconds only count as a class that is not shown.
//!
//! [`adapted_layers`] has the adapted layers and the samples.

use std::collections::BTreeSet;

use candle_core::{Device, Tensor};
use radome_dsp::rdm::Motion;
use radome_dsp::{Rdm, RdmShape};

use crate::dataset::{Dataset, Split, sequence_hash};
use crate::metrics::CLASSES;
use crate::model::{Adapted, BeforeAfter, ClassifyError, Model, Scores};
use crate::network::{Layer, Mode, Value, names};
use adapted_layers::{AdaptedLayers, BIAS_STRENGTH, Confusions, last_node, shift_strength};
use recording::{MOST_FRAMES, learnable_classes};

mod adapted_layers;
mod error;
mod recording;

pub use error::AdaptError;
pub use recording::{AdaptFrame, AdaptRecording};

/// Strengths of the penalty that are tried, the strongest first, s of labelled frames for a squared deviation.
const STRENGTHS: [f64; 6] = [3000.0, 1000.0, 300.0, 100.0, 30.0, 10.0];
/// Strength that is always tried, and the only one if no recording can be held out.
const SAFE_STRENGTH: f64 = 1000.0;
/// Weakest strength that is tried, times the square of the labelled seconds, s^3: 100 s at two minutes. Measured on simulated rooms
/// (`radome model adapt --curve`).
const WEAKEST_BY_TIME: f64 = 1.44e6;
/// Largest number of parts of the recordings that are held out in turn.
const MOST_FOLDS: usize = 10;

/// Result of an adaptation.
pub struct Adaptation {
    /// The adapted model; its card has an [`Adapted`] entry.
    pub model: Model,
    /// Entry of the card.
    pub adapted: Adapted,
    /// Scores of each recording by a model that was adapted on others; absent if the others do not show one of its classes for long
    /// enough to learn from.
    pub held_out: Vec<Option<BeforeAfter>>,
    /// Recordings that show empty, one and two.
    pub recordings_by_class: [usize; CLASSES],
    /// Whether a recording that shows empty, one and two was held out.
    pub is_measured: [bool; CLASSES],
    /// Whether empty, one and two are labelled, but for too short a time to learn from: they count as classes without labels. The empty
    /// room never is.
    pub is_too_short: [bool; CLASSES],
    /// Whether the simulated maps that were mixed in show empty, one and two. Such a class is learnt also without labels.
    pub is_simulated: [bool; CLASSES],
}

/// Parameters fitted to recordings, with cross-validated scores.
#[derive(Debug, Clone)]
pub struct Fit {
    numbers: Vec<f64>,
    adapted: Adapted,
    held_out: Vec<Option<BeforeAfter>>,
    recordings_by_class: [usize; CLASSES],
    is_measured: [bool; CLASSES],
    is_too_short: [bool; CLASSES],
}

/// Adaptation of a model.
pub struct Adapter {
    model: Model,
    /// Input of the adapted layers.
    input: Value,
    /// Parameters of the model before the adaptation.
    prior: Vec<f64>,
    /// Features and classes of simulated maps.
    simulated: Vec<(Vec<f32>, usize)>,
    /// Sequences of the simulated maps and of the recordings, by the short hashes of their names.
    sequences: BTreeSet<String>,
}

impl Adapter {
    /// Starts the adaptation of a model.
    ///
    /// # Errors
    /// [`AdaptError::Network`] if the network does not end in a linear layer, [`AdaptError::Layer`] if it reads descriptors and does
    /// not standardise them.
    pub fn new(model: Model) -> Result<Self, AdaptError> {
        let kind = model.card.network;
        let input = if kind.reads_descriptors() {
            Some(model.network.value_of(names::FEATURES)?)
        } else {
            last_node(&model.network).and_then(|node| node.inputs.first().copied())
        };
        let is_linear = last_node(&model.network).is_some_and(|node| matches!(node.layer, Layer::Linear { .. }));
        let input = input.filter(|_| is_linear).ok_or(AdaptError::Network { network: kind })?;
        let mut adapter =
            Adapter { model, input, prior: Vec::new(), simulated: Vec::new(), sequences: BTreeSet::new() };
        adapter.prior = adapter.adapted_layers()?.numbers()?;
        Ok(adapter)
    }

    fn adapted_layers(&self) -> Result<AdaptedLayers<'_>, AdaptError> {
        let Model { card, network } = &self.model;
        let layers = AdaptedLayers::new(network, self.input, card.temperature);
        layers.ok_or(AdaptError::Network { network: card.network })
    }

    /// Inputs of the adapted layers for a map.
    ///
    /// # Errors
    /// The map has another shape than the model's, or a cell of it is not finite.
    pub fn features(&self, map: &Rdm) -> Result<Vec<f32>, AdaptError> {
        self.features_of_cells(&map.db, map.shape, map.motion, map.sequence)
    }

    fn features_of_cells(
        &self,
        db: &[f32],
        shape: RdmShape,
        motion: Option<Motion>,
        sequence: u64,
    ) -> Result<Vec<f32>, AdaptError> {
        let Model { card, network } = &self.model;
        let input = card.unlabelled_input(db, shape, motion, sequence)?;
        let [_, rows, columns] = card.input_shape;
        let [rows, columns] = card.network.input_size([rows, columns]);
        let input = Tensor::from_vec(input, (1, rows, columns), &Device::Cpu)?;
        let features = network.run(&input, self.input, Mode::Evaluation)?.take(self.input)?;
        Ok(features.flatten_all()?.to_vec1()?)
    }

    /// Mixes in the maps of a dataset's training split, at most 2,000. Returns their number. The rule of the split is
    /// [`ModelCard::split_rule`](crate::ModelCard::split_rule), and the card of the adapted model lists the sequences: the model is not
    /// evaluated on maps that it was adapted to.
    ///
    /// # Errors
    /// [`AdaptError::Simulated`] if the maps are made of another waveform or by another map spec, [`AdaptError::Dataset`] if they
    /// cannot be read.
    pub fn mix(&mut self, dataset: &Dataset) -> Result<usize, AdaptError> {
        let header = dataset.header();
        let checked = self.model.card.check_maps(&header.rdm_spec, &header.waveform);
        checked.map_err(|error| match error {
            ClassifyError::OtherMaps { what } => AdaptError::Simulated { what },
            other => AdaptError::Simulated { what: other.to_string() },
        })?;
        let splits = dataset.splits(&self.model.card.split_rule(dataset))?;
        let rows = dataset.rows().iter().zip(&splits).enumerate();
        let training: Vec<usize> = rows
            .filter(|(_, (row, split))| **split == Split::Train && !row.transition)
            .map(|(index, _)| index)
            .collect();
        let step = training.len().div_ceil(MOST_FRAMES).max(1);
        let mut simulated = Vec::new();
        for &index in training.iter().step_by(step) {
            let Some(row) = dataset.rows().get(index) else { continue };
            let features = self.features_of_cells(&dataset.map(index)?, header.shape, row.motion, row.frame)?;
            simulated.push((features, row.label.index()));
            self.sequences.insert(sequence_hash(&row.sequence));
        }
        self.simulated = simulated;
        Ok(self.simulated.len())
    }

    /// Adds the name that a recording has as a sequence of a dataset. The card of the adapted model lists it.
    pub fn add_sequence(&mut self, name: &str) {
        self.sequences.insert(sequence_hash(name));
    }

    /// Adapts the model: runs [`fit`](Self::fit) and sets the fitted parameters.
    ///
    /// The same model and recordings give the same numbers, on any number of threads.
    ///
    /// # Errors
    /// The errors of [`fit`](Self::fit).
    pub fn adapt(self, recordings: &[AdaptRecording]) -> Result<Adaptation, AdaptError> {
        let Fit { numbers, adapted, held_out, recordings_by_class, is_measured, is_too_short } =
            self.fit(recordings)?;
        let is_simulated = self.is_simulated();
        self.adapted_layers()?.set(&numbers)?;
        let mut model = self.model;
        model.card.adapted = Some(adapted.clone());
        let seen = &mut model.card.training.seen_sequences;
        // An empty list stays empty: without the sequences of the training it would be incomplete.
        if !seen.is_empty() {
            seen.extend(self.sequences);
        }
        Ok(Adaptation { model, adapted, held_out, recordings_by_class, is_measured, is_too_short, is_simulated })
    }

    /// Returns whether the simulated maps show empty, one and two.
    fn is_simulated(&self) -> [bool; CLASSES] {
        std::array::from_fn(|class| self.simulated.iter().any(|(_, label)| *label == class))
    }

    /// Fits parameters to recordings. First, each recording, or each tenth of more than ten, is held out in turn, which gives the
    /// scores. The strength with the best scores is chosen, so they are slightly optimistic. A recording with a class that the others
    /// do not show for long enough is not held out, because the scores would be those of a model that never saw the class.
    ///
    /// # Errors
    /// [`AdaptError::NoLabels`] if no frame has a label, [`AdaptError::NonFinite`] if the loss of the model is not finite,
    /// [`AdaptError::Operation`] if features are not those of this model.
    pub fn fit(&self, recordings: &[AdaptRecording]) -> Result<Fit, AdaptError> {
        let by_recording: Vec<[f64; CLASSES]> = recordings.iter().map(AdaptRecording::seconds).collect();
        let seconds: [f64; CLASSES] = std::array::from_fn(|class| by_recording.iter().map(|s| s[class]).sum());
        let total_s: f64 = seconds.iter().sum();
        if total_s <= 0.0 {
            return Err(AdaptError::NoLabels { recordings: recordings.len() });
        }
        let recordings_by_class: [usize; CLASSES] =
            std::array::from_fn(|class| by_recording.iter().filter(|s| s[class] > 0.0).count());
        let layers = self.adapted_layers()?;
        let is_labelled = learnable_classes(seconds);
        let is_simulated = self.is_simulated();
        let is_shown: [bool; CLASSES] = std::array::from_fn(|class| is_labelled[class] || is_simulated[class]);
        let is_too_short = std::array::from_fn(|class| seconds[class] > 0.0 && !is_labelled[class]);
        let weakest = WEAKEST_BY_TIME / total_s.powi(2);
        let at_least = |weakest: f64| STRENGTHS.into_iter().filter(|strength| *strength >= weakest).collect();
        let strengths: Vec<f64> = match is_shown {
            [true, true, true] => at_least(weakest.min(SAFE_STRENGTH)),
            // The empty room loses most to weak strengths, and held-out recordings do not show it.
            [false, true, true] => at_least(SAFE_STRENGTH),
            [_, _, _] => vec![BIAS_STRENGTH],
        };

        let (folds, is_measured) = self.hold_out(&layers, recordings, &by_recording, is_labelled, &strengths)?;
        // Of equal scores, the strongest penalty is chosen.
        let measured: Vec<&Fold> = folds.iter().flatten().collect();
        let mut chosen: Option<(usize, BeforeAfter)> = None;
        for index in (0..strengths.len()).filter(|_| !measured.is_empty()) {
            let scores = Fold::scores(&measured, index);
            if chosen.is_none_or(|(_, best)| scores.after.sum() > best.after.sum()) {
                chosen = Some((index, scores));
            }
        }
        let all: Vec<&AdaptRecording> = recordings.iter().collect();
        let strength = match chosen {
            _ if is_shown.iter().filter(|shown| **shown).count() == 1 => shift_strength(&all),
            Some((index, _)) => strengths[index],
            None if is_shown[1..].contains(&false) => BIAS_STRENGTH,
            None => SAFE_STRENGTH,
        };
        let numbers = layers.fit(&all, &self.simulated, &[strength], &self.prior)?.into_iter().next();
        let fold_scores = |fold: Option<&Fold>| Some(Fold::scores(&[fold?], chosen?.0));
        let held_out = folds.iter().map(|fold| fold_scores(fold.as_ref())).collect();
        let adapted = Adapted {
            seconds: seconds.map(|seconds| (10.0 * seconds).round() / 10.0),
            recordings: by_recording.iter().filter(|seconds| seconds.iter().sum::<f64>() > 0.0).count(),
            strength,
            simulated_maps: self.simulated.len(),
            held_out: chosen.map(|(_, scores)| scores),
        };
        let numbers = numbers.unwrap_or_else(|| self.prior.clone());
        Ok(Fit { numbers, adapted, held_out, recordings_by_class, is_measured, is_too_short })
    }

    /// Holds out each part of the recordings in turn. `by_recording` are the labelled seconds of each recording, `is_labelled` the
    /// classes that all together show. Returns the predictions on each recording that was held out, and the classes that those
    /// recordings show.
    fn hold_out(
        &self,
        layers: &AdaptedLayers,
        recordings: &[AdaptRecording],
        by_recording: &[[f64; CLASSES]],
        is_labelled: [bool; CLASSES],
        strengths: &[f64],
    ) -> Result<(Vec<Option<Fold>>, [bool; CLASSES]), AdaptError> {
        let card = &self.model.card;
        let mut is_measured = [false; CLASSES];
        let mut folds: Vec<Option<Fold>> = recordings.iter().map(|_| None).collect();
        let parts = recordings.len().min(MOST_FOLDS);
        for part in 0..parts {
            let is_held_out = |index: usize| index % parts == part;
            let seconds_of = |class: usize, held_out: bool| -> f64 {
                let all = by_recording.iter().enumerate().filter(|(index, _)| is_held_out(*index) == held_out);
                all.map(|(_, seconds)| seconds[class]).sum()
            };
            let is_known = learnable_classes(std::array::from_fn(|class| seconds_of(class, false)));
            let is_in_part = |class: &usize| is_labelled[*class] && seconds_of(*class, true) > 0.0;
            let in_part: Vec<usize> = (0..CLASSES).filter(is_in_part).collect();
            if in_part.is_empty() || !in_part.iter().all(|class| is_known[*class]) {
                continue;
            }
            in_part.iter().for_each(|class| is_measured[*class] = true);
            let others = recordings.iter().enumerate().filter(|(index, _)| !is_held_out(*index));
            let others: Vec<&AdaptRecording> = others.map(|(_, recording)| recording).collect();
            let fits = layers.fit(&others, &self.simulated, strengths, &self.prior)?;
            for (index, recording) in recordings.iter().enumerate().filter(|(index, _)| is_held_out(*index)) {
                // A recording without labels has no scores.
                if by_recording[index].iter().sum::<f64>() > 0.0 {
                    let evaluate = |numbers: &Vec<f64>| layers.confusions(numbers, recording, card);
                    let after = fits.iter().map(evaluate).collect::<Result<Vec<_>, _>>()?;
                    folds[index] = Some(Fold { before: evaluate(&self.prior)?, after });
                }
            }
        }
        Ok((folds, is_measured))
    }

    /// Computes scores on recordings with fitted parameters, or those of the model before.
    ///
    /// # Errors
    /// [`AdaptError::Operation`] if features or parameters are not those of this model.
    pub fn scores(&self, fit: Option<&Fit>, recordings: &[AdaptRecording]) -> Result<Scores, AdaptError> {
        let (layers, card) = (self.adapted_layers()?, &self.model.card);
        let numbers = fit.map_or(&self.prior, |fit| &fit.numbers);
        let evaluate = |recording: &AdaptRecording| layers.confusions(numbers, recording, card);
        let confusions = recordings.iter().map(evaluate).collect::<Result<Vec<_>, _>>()?;
        Ok(Confusions::scores(confusions.iter()))
    }
}

/// Held-out part of the recordings: predictions of the model before, and of one adapted on the others for each strength.
struct Fold {
    before: Confusions,
    after: Vec<Confusions>,
}

impl Fold {
    /// Scores over several folds before and after the adaptation with the strength of this index.
    fn scores(folds: &[&Fold], strength: usize) -> BeforeAfter {
        let after = Confusions::scores(folds.iter().filter_map(|fold| fold.after.get(strength)));
        BeforeAfter { before: Confusions::scores(folds.iter().map(|fold| &fold.before)), after }
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use radome_dsp::Occupancy;
    use rand_distr::{Distribution, Normal};

    use super::*;
    use crate::ModelCard;
    use crate::dataset::{DatasetHeader, Domain, ManifestRow, SplitSpec};
    use crate::layer::{DESCRIPTORS, KernelLevel};
    use crate::network::{Network, NetworkKind, NetworkSpec};
    use crate::standardise::{MapReference, Standardisation};

    /// Kinds of networks that read descriptors.
    fn descriptor_networks() -> impl Iterator<Item = NetworkKind> {
        NetworkKind::ALL.into_iter().filter(|network| network.reads_descriptors())
    }

    /// A model of descriptors with random numbers.
    pub fn model(name: &str) -> Model {
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

    /// A recording of a minute and a half of each class, with features of order one about a centre of the class. Every third frame
    /// has no label.
    pub fn recording(seed: u64, classes: &[Occupancy]) -> AdaptRecording {
        let mut rng = crate::random::stream(seed, "features", 0);
        let normal = Normal::new(0.0f32, 0.6).expect("normal");
        let mut frames = Vec::new();
        for class in classes {
            for frame in 0..90 {
                let centre = |k: usize| f32::from(k % 3 == class.index());
                let features = (0..DESCRIPTORS).map(|k| centre(k) + normal.sample(&mut rng)).collect();
                let label = (frame % 3 > 0).then_some(*class);
                frames.push(AdaptFrame { time_s: frames.len() as f64, features, label });
            }
        }
        AdaptRecording { frame_interval_s: 1.0, frames }
    }

    fn adapt(name: &str, recordings: &[AdaptRecording]) -> Adaptation {
        Adapter::new(model(name)).expect("adaptable").adapt(recordings).expect("adapts")
    }

    #[test]
    fn held_out_recordings_have_better_scores() {
        let recordings: Vec<AdaptRecording> = (0..3).map(|seed| recording(seed, &Occupancy::ALL)).collect();
        for network in descriptor_networks() {
            // A narrow latent with random weights carries less information.
            let (name, least) = (network.to_string(), if network.has_latent() { 0.6 } else { 0.9 });
            let first = adapt(&name, &recordings);
            let BeforeAfter { before, after } = first.adapted.held_out.expect("measured");
            assert!(after.by_frame > least && after.by_frame > before.by_frame + 0.1, "{name}: {before:?} {after:?}");
            assert!(first.held_out.iter().all(Option::is_some), "{name}");
            assert_eq!((first.adapted.recordings, first.recordings_by_class), (3, [3; 3]));
            assert_eq!(first.model.card.adapted.as_ref(), Some(&first.adapted));
            first.adapted.seconds.iter().for_each(|s| assert!((s - 180.0).abs() < 0.11, "{:?}", first.adapted));
            let again = adapt(&name, &recordings);
            assert_eq!(first.model.network.values().expect("values"), again.model.network.values().expect("values"));
            assert_eq!(first.adapted, again.adapted);
        }
    }

    #[test]
    fn recordings_of_an_empty_room_change_only_the_logit_of_empty() {
        for name in descriptor_networks().map(|network| network.to_string()) {
            let before = model(&name).network.values().expect("values");
            let adaptation = adapt(&name, &[recording(1, &[Occupancy::Empty])]);
            assert!(
                adaptation.adapted.held_out.is_none() && (adaptation.adapted.strength - 5.0).abs() < 1e-6,
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

    mod hard_cases {
        use super::*;

        /// Regression test: another dataset was divided by the default rule, and the card did not list the mixed-in sequences, so the
        /// adapted model was scored on maps that it was adapted to.
        #[test]
        fn mixed_maps_are_of_the_models_training_split_and_listed() {
            let mut model = model("descriptor_linear");
            let held_out = Some("elsewhere".to_owned());
            model.card.split = Some(SplitSpec { seed: 3, test: 0.5, held_out, ..SplitSpec::default() });
            let header = DatasetHeader::new(model.card.waveform.clone(), model.card.rdm_spec).expect("a header");
            let normal = Normal::new(-80.0f32, 5.0).expect("normal");
            let mut rng = crate::random::stream(6, "cells", 0);
            let maps = (0..12).map(|index| {
                let label = Occupancy::ALL[index % 3];
                let row = ManifestRow::new(Domain::Sim, "room", "run", &format!("room {index}"), 0, label);
                let db = (0..header.shape.cells()).map(|_| normal.sample(&mut rng)).collect();
                (header.rdm(db, 0), row)
            });
            let maps = maps.collect();
            let dataset = Dataset::from_maps(header, maps).expect("a dataset");
            let rule = SplitSpec { seed: 3, test: 0.5, ..SplitSpec::default() };
            let splits = dataset.splits(&rule).expect("splits");
            let sequences_of = |wanted: Split| -> BTreeSet<&str> {
                let rows = dataset.rows().iter().zip(&splits).filter(|(_, split)| **split == wanted);
                rows.map(|(row, _)| row.sequence.as_str()).collect()
            };
            let (mut train, test) = (sequences_of(Split::Train), sequences_of(Split::Test));

            let adapted_card = |card: ModelCard| {
                let network = self::model("descriptor_linear").network;
                let mut adapter = Adapter::new(Model { card, network }).expect("adaptable");
                assert_eq!(adapter.mix(&dataset).expect("mixed"), sequences_of(Split::Train).len());
                adapter.add_sequence(test.first().expect("a test map"));
                adapter.adapt(&[recording(1, &Occupancy::ALL)]).expect("adapts").model.card
            };
            let card = adapted_card(model.card.clone());
            train.extend(test.first());
            assert_eq!(card.seen_in(&dataset), Some(train));
            // In a dataset, the names of recordings from a folder begin with the folder's name.
            let row = ManifestRow::new(Domain::Real, "room", "run", "captures/room 1", 0, Occupancy::One);
            let db = vec![-80.0; dataset.header().shape.cells()];
            let rdm = dataset.header().rdm(db, 0);
            let other = Dataset::from_maps(dataset.header().clone(), vec![(rdm, row)]).expect("a dataset");
            let mut adapter = Adapter::new(self::model("descriptor_linear")).expect("adaptable");
            adapter.add_sequence("room 1");
            let card = adapter.adapt(&[recording(1, &Occupancy::ALL)]).expect("adapts").model.card;
            assert_eq!(card.seen_in(&other), Some(BTreeSet::from(["captures/room 1"])));
            assert!(card.has_seen("room 1") && !card.has_seen("room 2"));
            // A file of an older program lists nothing.
            model.card.training.seen_sequences.clear();
            assert_eq!(adapted_card(model.card).seen_in(&dataset), None);
        }

        /// Regression test: recordings of one person alone made a model call the empty room one person.
        #[test]
        fn a_class_that_no_recording_shows_is_not_forgotten() {
            use Occupancy::{Empty, One, Two};
            for (name, draw) in descriptor_networks().flat_map(|network| [0, 100, 200, 400].map(|draw| (network, draw)))
            {
                let name = name.to_string();
                let all = [0, 1].map(|seed| recording(draw + seed, &Occupancy::ALL));
                let adapter = Adapter::new(adapt(&name, &all).model).expect("adaptable");
                for shown in [&[One][..], &[Empty, One], &[Empty, Two], &[Two]] {
                    let fit = adapter.fit(&[3, 4].map(|seed| recording(draw + seed, shown))).expect("fits");
                    for class in Occupancy::ALL {
                        let others = [recording(draw + 9, &[class])];
                        let [before, after] =
                            [None, Some(&fit)].map(|fit| adapter.scores(fit, &others).expect("scores").by_frame);
                        assert!(after > before - 0.15, "{name}, {draw}, {shown:?}: {class:?} {before}, then {after}");
                    }
                }
            }
        }

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

        /// If each class is in one recording only, none can be held out, and the model is adapted without scores.
        #[test]
        fn one_recording_of_each_class_is_adapted_to_and_not_measured() {
            let each = Occupancy::ALL.map(|class| recording(class.index() as u64, &[class]));
            let adaptation = adapt("descriptor_linear", &each);
            assert_eq!(adaptation.recordings_by_class, [1; 3]);
            assert!(adaptation.adapted.held_out.is_none() && adaptation.held_out.iter().all(Option::is_none));
            assert_eq!(adaptation.adapted.strength, SAFE_STRENGTH);
        }

        /// The only recording of two people cannot be held out: the scores would be those of a model that has never seen two people.
        #[test]
        fn a_recording_with_the_only_example_of_a_class_is_not_held_out() {
            let recordings = [
                recording(1, &[Occupancy::Empty]),
                recording(2, &[Occupancy::Empty]),
                recording(3, &[Occupancy::One]),
                recording(4, &[Occupancy::One, Occupancy::Two]),
            ];
            let adaptation = adapt("descriptor_linear", &recordings);
            let held_out: Vec<bool> = adaptation.held_out.iter().map(Option::is_some).collect();
            assert_eq!((held_out, adaptation.is_measured), (vec![true, true, true, false], [true, true, false]));
            assert_eq!(adaptation.recordings_by_class, [2, 2, 1]);
        }

        /// Regression test: the score of a recording of two people was that of a model that had learnt nothing from the three seconds
        /// of them in another one.
        #[test]
        fn a_recording_whose_class_the_others_show_for_seconds_is_not_held_out() {
            let mut brief = recording(5, &[Occupancy::One, Occupancy::Two]);
            brief.frames.truncate(95);
            let recordings = [recording(3, &[Occupancy::One]), recording(4, &[Occupancy::One, Occupancy::Two]), brief];
            assert_eq!(recordings[2].seconds(), [0.0, 60.0, 3.0]);
            let adaptation = adapt("descriptor_linear", &recordings);
            let held_out: Vec<bool> = adaptation.held_out.iter().map(Option::is_some).collect();
            assert_eq!((held_out, adaptation.is_measured), (vec![true, false, true], [false, true, true]));
        }

        #[test]
        fn many_recordings_are_held_out_in_ten_parts_and_few_labels_move_the_model_little() {
            let short = |seed: u64| {
                let mut short = recording(seed, &[Occupancy::ALL[seed as usize % 3]]);
                short.frames.truncate(15);
                short
            };
            let recordings: Vec<AdaptRecording> = (0..12).map(short).collect();
            let adaptation = adapt("descriptor_linear", &recordings);
            assert!(adaptation.held_out.iter().all(Option::is_some));
            // Two minutes.
            assert_eq!(adaptation.adapted.seconds, [40.0; 3]);
            assert!(adaptation.adapted.strength >= 100.0, "{:?}", adaptation.adapted);
        }

        #[test]
        fn frames_without_a_valid_time_count_for_the_frame_interval() {
            let mut still = recording(1, &[Occupancy::Two]);
            still.frames.iter_mut().for_each(|frame| frame.time_s = f64::NAN);
            let [_, _, two_s] = still.seconds();
            assert!((two_s - 60.0).abs() < 1e-6, "{two_s}");
            adapt("descriptor_linear", &[still]);
        }
    }
}
