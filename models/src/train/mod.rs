//! Training: from a dataset to a model, reliably and reproducibly.
//!
//! # The recipe, and why
//! The squash before the circuit makes training fragile. From a cold start it is easier for the first steps to shift the
//! common mean of the latent than to draw classes apart; the mean runs onto the flat end of `pi * sigmoid`, no gradient
//! is left, and the loss stays at ln 3. What is done about it:
//! 1. *Centred features.* See [`crate::network::Network::fold_features`]: measured at the start, folded into the weights at the
//!    end.
//! 2. *A linear warm-up.* For the first `linear_epochs` the head sees the latent itself, without squash and
//!    circuit. This control head trains reliably.
//! 3. *A fitted circuit.* Then angles, head and an affine map of the latent (folded into the last dense layer) are
//!    fitted to the latents as they are, from 24 random starts, and the best fit is carried on with: 19 numbers on 256
//!    points, well under a second.
//! 4. *A penalty* on the mean square of the latent keeps it off the ends of the squash.
//! 5. *Several starts* ([`TrainSpec::starts`]); the one with the least validation loss after
//!    [`TrainSpec::start_epochs`] is carried on with. Own step sizes for angles and head; warm-up, then a cosine to a
//!    twentieth.
//! 6. *The best epoch* by balanced accuracy on the validation split, by loss among equals.
//! 7. *Calibration.* One temperature, fitted on the validation split (Guo et al., ICML 2017).
//!
//! What it reaches over seeds, and how it compares with other heads under the same treatment: `docs/studies`. Networks without a
//! narrow latent are trained by the same steps but for 1 to 4, from one start.

mod adam;
mod adapt;
mod augmentation;
mod checkpoint;
mod data;
mod head_start;
mod run;
mod smoothing;
mod start;
mod temperature;
mod trainer;

use std::path::{Path, PathBuf};

pub use crate::model::{Adapted, BeforeAfter, Scores};
pub use adapt::{AdaptError, AdaptFrame, AdaptRecording, Adaptation, Adapter, Fit};
pub use augmentation::{Augmentation, Superpose, Sway};
pub use smoothing::{FilterSequence, SmoothingFit, fit_smoothing};
pub use trainer::Trainer;

use radome_dsp::Occupancy;
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::dataset::{Dataset, DatasetError, Split, SplitSpec};
use crate::evaluate::evaluate;
use crate::layer::KernelLevel;
use crate::metrics::Metrics;
use crate::model::{
    Classifier, ClassifyError, MODEL_FORMAT_VERSION, Model, ModelCard, ModelError, TrainingSummary, input_axes,
    input_shape,
};
use crate::network::{
    Head, MOST_POOLED, NetworkKind, NetworkSpec, PAPER_POOLED, TorchvisionWeights, UnreadableMaps, WeightsError,
};
use crate::occupancy_filter::Smoothing;
use crate::standardise::{MapReference, StandardiseError};

/// Epochs, maps in a step and initialisations at most: far beyond any training, and products of them are still numbers.
const MOST_EPOCHS: usize = 100_000;
const MOST_IN_BATCH: usize = 65_536;
const MOST_STARTS: u64 = 1000;

/// How the latent is standardised before the squash (paper.md section 6 leaves it open). The constants are never
/// differentiated through, and are saved with the model.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LatentStandardisation {
    /// Not at all: the start alone puts the latent where it belongs.
    None,
    /// By mean and sigma over the training split, measured anew before each epoch.
    FrozenByEpoch,
    /// By running mean and variance, updated with each batch.
    Running {
        /// Weight of the newest batch, in (0, 1].
        momentum: f32,
    },
}

/// Everything that decides what a training does, except the data.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TrainSpec {
    /// Seed of initialisation, order and augmentation.
    pub seed: u64,
    /// Which network.
    pub network: NetworkKind,
    /// What stands behind the HQNN's latent.
    pub head: Head,
    /// Share of the training split's maps that is trained on, drawn by class; 1 for all.
    pub label_fraction: f64,
    /// Maps that are trained on at most, a share of each class; all if absent.
    pub most_training_maps: Option<usize>,
    /// How sequences are divided.
    pub split: SplitSpec,
    /// Passes over the training split.
    pub epochs: usize,
    /// Maps in a step.
    pub batch_size: usize,
    /// Adam's step size.
    pub learning_rate: f64,
    /// Step size of the circuit's angles, as a multiple of `learning_rate`.
    pub angle_rate: f64,
    /// Step size of the last layer, as a multiple of `learning_rate`.
    pub head_rate: f64,
    /// Steps over which the step size rises to its full value.
    pub warm_up_steps: usize,
    /// Initialisations that are tried.
    pub starts: u64,
    /// Epochs that each is given before one is chosen, at most `epochs`.
    pub start_epochs: usize,
    /// Of all epochs, the first ones, in which the head sees the latent directly (see the recipe above); half of them if
    /// absent.
    pub linear_epochs: Option<usize>,
    /// Standard deviation that features are scaled to while training.
    pub feature_sigma: f32,
    /// Standard deviation of each component of the latent at the start.
    pub latent_sigma: f32,
    /// Weight of the mean square of the standardised latent in the loss: what keeps it off the flat ends of the squash.
    pub latent_penalty: f64,
    /// Decoupled decay of the weights: share of them that is taken away in a step, as a multiple of the step size. 0 for none.
    pub weight_decay: f64,
    /// Standardisation of the latent.
    pub latent: LatentStandardisation,
    /// What the maps' cells are measured against.
    pub reference: MapReference,
    /// Standardise by scene and class, as the paper does, which tells the network the label of every map; its models answer to
    /// maps with labels only.
    pub label_leaking_cells: bool,
    /// How answers to frames are put together where the model is put to work.
    pub smoothing: Smoothing,
    /// Rows and columns (range, Doppler) that the second block's output is averaged to; the paper's are 2 and 15.
    pub pooled: [usize; 2],
    /// Show the network maps with range and Doppler exchanged.
    pub transposed: bool,
    /// Weigh classes by the inverse of their number.
    pub class_weights: bool,
    /// Train on maps in which someone is just entering or leaving.
    pub transitions: bool,
    /// Changes to training maps.
    pub augmentation: Augmentation,
    /// Instructions of the inner loops; the fastest there are if absent.
    pub kernel_level: Option<KernelLevel>,
    /// torchvision's weights for ResNet-18 or EfficientNet-B0 to start from, as safetensors ([`TorchvisionWeights`]). What they
    /// hold decides the outcome, not where they lie. In a file, relative to that file.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub weights: Option<PathBuf>,
}

impl Default for TrainSpec {
    fn default() -> Self {
        TrainSpec {
            seed: 11,
            network: NetworkKind::Hqnn,
            head: Head::default(),
            label_fraction: 1.0,
            most_training_maps: None,
            split: SplitSpec::default(),
            epochs: 15,
            batch_size: 32,
            learning_rate: 1e-3,
            angle_rate: 5.0,
            head_rate: 5.0,
            warm_up_steps: 20,
            starts: 2,
            start_epochs: 2,
            linear_epochs: None,
            feature_sigma: 0.3,
            latent_sigma: 0.5,
            latent_penalty: 0.05,
            weight_decay: 0.0,
            latent: LatentStandardisation::None,
            reference: MapReference::Absolute,
            label_leaking_cells: false,
            smoothing: Smoothing::default(),
            pooled: PAPER_POOLED,
            transposed: false,
            class_weights: true,
            transitions: true,
            augmentation: Augmentation::default(),
            kernel_level: None,
            weights: None,
        }
    }
}

/// What one pass over the training split came to.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EpochReport {
    /// Which initialisation, from 0.
    pub start: u64,
    /// Whether this start has been chosen to be carried on with.
    pub chosen: bool,
    /// Epoch, from 1.
    pub epoch: usize,
    /// Epochs in total.
    pub epochs: usize,
    /// Mean loss over the epoch's steps.
    pub training_loss: f64,
    /// Balanced accuracy over the epoch's batches as they were met.
    pub training_balanced_accuracy: f64,
    /// Loss on the validation split after the epoch.
    pub validation_loss: f64,
    /// Balanced accuracy on the validation split after the epoch.
    pub validation_balanced_accuracy: f64,
    /// Time of the epoch, s.
    pub seconds: f64,
}

/// What a training came to.
pub struct TrainOutcome {
    /// The model, ready to save or to put to work.
    pub model: Model,
    /// One report for each epoch, in order.
    pub history: Vec<EpochReport>,
    /// Scores of the model on the validation split.
    pub validation: Metrics,
    /// Scores on the test split, if there is one.
    pub test: Option<Metrics>,
    /// What the user should know: classes that are missing, and the like.
    pub warnings: Vec<String>,
}

/// A training that cannot start or go on.
#[derive(Debug, Error)]
pub enum TrainError {
    /// A setting is out of range.
    #[error("training: {name} is {value}, expected {expected}")]
    Setting {
        /// Field of [`TrainSpec`].
        name: &'static str,
        /// What was given.
        value: String,
        /// What is allowed.
        expected: &'static str,
    },
    /// Maps with a 0 dB of their own do not say what stands above noise.
    #[error(
        "training: augmentation.{setting} changes what stands above the noise, and maps of an absolute reference do not say how strong that is\n\nhint: add [reference.over_noise] with skip_range_bins = 3 to the training's settings, or take augmentation.{setting} out"
    )]
    NeedsOverNoise {
        /// Field of [`Augmentation`].
        setting: &'static str,
    },
    /// Networks take one channel.
    #[error(
        "the dataset's maps have {rx} channels, a network takes one\n\nhint: build the dataset with channels = {{ one = 0 }} or \"incoherent_sum\" in its map spec"
    )]
    Channels {
        /// Channels of a map.
        rx: usize,
    },
    /// Maps are too small for the network's poolings.
    #[error("maps are {range} range x {doppler} doppler bins, too few for the network's layer {layer}")]
    TooSmall {
        /// Layer that has nothing left to work on.
        layer: String,
        /// Range bins.
        range: usize,
        /// Doppler bins.
        doppler: usize,
    },
    /// A split that is needed holds nothing.
    #[error(
        "the {split} split is empty: {maps} maps in {sequences} sequences\n\nhint: splits are made of whole sequences; record more of them, or give rows a split"
    )]
    EmptySplit {
        /// Which.
        split: Split,
        /// Maps in the dataset.
        maps: usize,
        /// Sequences in the dataset.
        sequences: usize,
    },
    /// There is nothing to tell apart.
    #[error("the training split holds maps of one class only ({class}); at least two are needed")]
    OneClass {
        /// The class.
        class: Occupancy,
    },
    /// The network cannot read such maps.
    #[error(transparent)]
    Maps(#[from] UnreadableMaps),
    /// Maps cannot be standardised.
    #[error(transparent)]
    Standardise(#[from] StandardiseError),
    /// A number became NaN or infinite.
    #[error(
        "{what} is not finite at start {start}, epoch {epoch}, step {step}\n\nhint: the learning rate of {learning_rate} may be too high"
    )]
    NonFinite {
        /// Layer or gradient.
        what: String,
        /// Which initialisation.
        start: u64,
        /// Epoch, from 1.
        epoch: usize,
        /// Step within the start, from 1.
        step: usize,
        /// Learning rate of the spec.
        learning_rate: f64,
    },
    /// Weights to start from do not fit.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// A stopped training cannot be carried on with.
    #[error("checkpoint: {what}\n\nhint: remove the file to begin anew")]
    Checkpoint {
        /// File and reason.
        what: String,
    },
    /// The dataset cannot be read or split.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// The trained model cannot be applied.
    #[error(transparent)]
    Classify(#[from] ClassifyError),
    /// The model cannot be made.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// A tensor operation failed.
    #[error("network: {0}")]
    Network(#[from] candle_core::Error),
}

impl TrainSpec {
    /// The network that is trained.
    pub fn network_spec(&self) -> NetworkSpec {
        NetworkSpec { kind: self.network, pooled: self.pooled, head: self.head.clone() }
    }

    /// Epochs with the linear head.
    fn linear_epochs(&self) -> usize {
        self.linear_epochs.unwrap_or(self.epochs / 2)
    }

    /// Checks every setting.
    ///
    /// # Errors
    /// [`TrainError::Setting`] for the first setting that is out of range.
    pub fn check(&self) -> Result<(), TrainError> {
        let fail = |name, value: String, expected| Err(TrainError::Setting { name, value, expected });
        for (name, value) in
            [("epochs", self.epochs), ("batch_size", self.batch_size), ("starts", self.starts as usize)]
        {
            if value == 0 {
                return fail(name, value.to_string(), "at least 1");
            }
        }
        if self.epochs > MOST_EPOCHS {
            return fail("epochs", self.epochs.to_string(), "100000 at most");
        }
        if self.batch_size > MOST_IN_BATCH {
            return fail("batch_size", self.batch_size.to_string(), "65536 at most");
        }
        if self.starts > MOST_STARTS {
            return fail("starts", self.starts.to_string(), "1000 at most");
        }
        if self.starts > 1 && self.start_epochs == 0 {
            return fail("start_epochs", self.start_epochs.to_string(), "1 or more where there are several starts");
        }
        if self.linear_epochs() > self.epochs {
            return fail("linear_epochs", self.linear_epochs().to_string(), "0 up to epochs");
        }
        if !(0.0..=10.0).contains(&self.weight_decay) {
            return fail("weight_decay", self.weight_decay.to_string(), "0 to 10");
        }
        if !(self.latent_penalty.is_finite() && self.latent_penalty >= 0.0) {
            return fail("latent_penalty", self.latent_penalty.to_string(), "0 or more");
        }
        let rates = [
            ("learning_rate", self.learning_rate),
            ("angle_rate", self.angle_rate),
            ("head_rate", self.head_rate),
            ("feature_sigma", f64::from(self.feature_sigma)),
            ("latent_sigma", f64::from(self.latent_sigma)),
        ];
        for (name, value) in rates {
            if !(value.is_finite() && value > 0.0) {
                return fail(name, value.to_string(), "a finite number above 0");
            }
        }
        if !(self.label_fraction > 0.0 && self.label_fraction <= 1.0) {
            return fail("label_fraction", self.label_fraction.to_string(), "above 0 and up to 1");
        }
        if self.most_training_maps == Some(0) {
            return fail("most_training_maps", "0".to_owned(), "at least 1");
        }
        if let Head::Circuit { circuit, .. } = &self.head
            && let Err(error) = circuit.check()
        {
            return fail("head.circuit", error.to_string(), "a circuit that can be run");
        }
        if let Some((name, value, expected)) = self.reference.fault() {
            return fail(name, value.to_string(), expected);
        }
        self.augmentation.check(self.reference)?;
        if self.augmentation.superpose.is_some() && self.label_leaking_cells {
            return fail("label_leaking_cells", "true".to_owned(), "false where augmentation.superpose changes labels");
        }
        if self.pooled.iter().any(|n| !(1..=MOST_POOLED).contains(n)) {
            return fail("pooled", format!("{:?}", self.pooled), "1 to 64 rows and columns");
        }
        if let Some((name, value, expected)) = self.smoothing.fault() {
            return fail(name, value.to_string(), expected);
        }
        self.network.check_maps(self.reference, self.transposed, self.label_leaking_cells)?;
        match self.latent {
            LatentStandardisation::Running { momentum } if !(momentum > 0.0 && momentum <= 1.0) => {
                fail("latent.running.momentum", momentum.to_string(), "above 0 and up to 1")
            }
            _ => Ok(()),
        }
    }
}

/// Trains a network. `report` is called after each epoch.
///
/// The same dataset, spec and kernel level give the same model, bit for bit, on any number of threads.
///
/// # Errors
/// [`TrainError`] if a setting is out of range, the dataset cannot be read, split or standardised or does not fit the network,
/// weights to start from do not fit, or a number becomes NaN or infinite.
pub fn train(
    dataset: &Dataset,
    spec: &TrainSpec,
    report: &mut dyn FnMut(EpochReport),
) -> Result<TrainOutcome, TrainError> {
    train_with_checkpoint(dataset, spec, None, report)
}

/// [`train`] that writes `checkpoint` after each epoch, carries on from it if it is there, and removes it at the end. A training
/// that was killed and carried on with gives the model that it would have given undisturbed.
///
/// # Errors
/// Those of [`train`], and [`TrainError::Checkpoint`] if the checkpoint cannot be read or written, or is of another training.
pub fn train_with_checkpoint(
    dataset: &Dataset,
    spec: &TrainSpec,
    checkpoint: Option<&Path>,
    report: &mut dyn FnMut(EpochReport),
) -> Result<TrainOutcome, TrainError> {
    spec.check()?;
    let weights =
        spec.weights.as_deref().map(|path| TorchvisionWeights::load(path, &spec.network_spec())).transpose()?;
    let data = data::Data::load(dataset, spec)?;
    let level = spec.kernel_level.unwrap_or_else(KernelLevel::detect).available();
    let (run, history) =
        Training { data: &data, spec, weights: weights.as_ref(), level, checkpoint, dataset_hash: dataset.hash() }
            .run(report)?;

    let chosen_start = run.start_index();
    let (network, best_epoch) = run.finish()?;
    let temperature = temperature::fit(&network, &data)?;
    let header = dataset.header();
    let mut card = ModelCard {
        format_version: MODEL_FORMAT_VERSION,
        network: spec.network,
        head: spec.head.clone(),
        classes: Occupancy::ALL.to_vec(),
        input_shape: input_shape(header.shape.range, header.shape.doppler, spec.transposed),
        axes: input_axes(spec.transposed),
        waveform: header.waveform.clone(),
        rdm_spec: header.rdm_spec,
        standardisation: data.standardisation.clone(),
        smoothing: spec.smoothing,
        pooled: spec.pooled,
        latent: network.latent_constants(),
        temperature,
        dataset_hash: dataset.hash(),
        seed: spec.seed,
        training: TrainingSummary {
            epochs: spec.epochs,
            best_epoch,
            training_maps: data.train.labels.len(),
            weights_hash: weights.as_ref().map(|weights| weights.hash().to_owned()),
            chosen_start,
            kernel_level: level,
            validation: Metrics::from_predictions([]),
            test: None,
        },
        adapted: None,
    };
    let mut warnings = data.warnings.clone();
    warnings.extend(weights.iter().flat_map(TorchvisionWeights::warnings));
    // Scores come from the very path that a live classifier takes.
    let mut classifier = Classifier::new(Model { card: card.clone(), network });
    let validation = evaluate(&mut classifier, dataset, &data.validation.indices)?;
    let test = match data.test.as_slice() {
        [] => None,
        indices => Some(evaluate(&mut classifier, dataset, indices)?),
    };
    card.training.validation = validation.clone();
    card.training.test = test.clone();
    let Some(Model { network, .. }) = classifier.into_model() else {
        return Err(candle_core::Error::Msg("a trained network is no ONNX file".to_owned()).into());
    };
    let model = Model { card, network };
    if let Some(path) = checkpoint {
        // What it was for is done; it being left behind would only cost a repeated last step.
        let _ = std::fs::remove_file(path);
    }
    Ok(TrainOutcome { model, history, validation, test, warnings })
}

/// The epochs of all starts, in their order.
struct Training<'a> {
    data: &'a data::Data,
    spec: &'a TrainSpec,
    weights: Option<&'a TorchvisionWeights>,
    level: KernelLevel,
    checkpoint: Option<&'a Path>,
    dataset_hash: String,
}

impl<'a> Training<'a> {
    fn run(&self, report: &mut dyn FnMut(EpochReport)) -> Result<(run::Run<'a>, Vec<EpochReport>), TrainError> {
        let Training { data, spec, weights, level, .. } = *self;
        let trials = if spec.starts > 1 { spec.start_epochs.min(spec.epochs) } else { 0 };
        let resume = |state| run::Run::resume(data, spec, state, level);
        let (mut leader, mut trial, mut history, mut next_start) = match self.load()? {
            None => (None, None, Vec::new(), 0),
            Some(found) => (
                found.leader.map(resume).transpose()?,
                found.trial.map(resume).transpose()?,
                found.history,
                found.next_start,
            ),
        };
        while trial.is_some() || next_start < spec.starts {
            let mut run = match trial.take() {
                Some(run) => run,
                None => {
                    next_start += 1;
                    run::Run::start(data, spec, weights, next_start - 1, level)?
                }
            };
            while run.epochs_done() < trials {
                let told = run.epoch(false)?;
                history.push(told.clone());
                report(told);
                self.save(leader.as_ref(), Some(&run), &history, next_start)?;
            }
            if leader.as_ref().is_none_or(|leader: &run::Run| run.validation_loss() < leader.validation_loss()) {
                leader = Some(run);
            }
        }
        let Some(mut run) = leader else {
            return Err(TrainError::Setting { name: "starts", value: "0".into(), expected: "at least 1" });
        };
        while run.epochs_done() < spec.epochs {
            let told = run.epoch(true)?;
            history.push(told.clone());
            report(told);
            self.save(Some(&run), None, &history, next_start)?;
        }
        Ok((run, history))
    }

    /// What decides the outcome.
    fn fingerprint(&self) -> Result<String, TrainError> {
        let spec = TrainSpec { weights: None, ..self.spec.clone() };
        let spec = serde_json::to_string(&spec).map_err(|e| TrainError::Checkpoint { what: e.to_string() })?;
        let weights = self.weights.map(|weights| format!(" {}", weights.hash())).unwrap_or_default();
        Ok(format!("{spec} {:?} {}{weights}", self.level, self.dataset_hash))
    }

    fn load(&self) -> Result<Option<checkpoint::Checkpoint>, TrainError> {
        let Some(path) = self.checkpoint else { return Ok(None) };
        let Some(found) = checkpoint::Checkpoint::load(path)? else { return Ok(None) };
        if found.fingerprint != self.fingerprint()? {
            let what = format!("{} is of a training with other settings, data or instructions", path.display());
            return Err(TrainError::Checkpoint { what });
        }
        Ok(Some(found))
    }

    fn save(
        &self,
        leader: Option<&run::Run>,
        trial: Option<&run::Run>,
        history: &[EpochReport],
        next_start: u64,
    ) -> Result<(), TrainError> {
        let Some(path) = self.checkpoint else { return Ok(()) };
        let state = |run: Option<&run::Run>| run.map(run::Run::state).transpose();
        let history = history.to_vec();
        checkpoint::Checkpoint {
            fingerprint: self.fingerprint()?,
            leader: state(leader)?,
            trial: state(trial)?,
            history,
            next_start,
        }
        .save(path)
    }
}
