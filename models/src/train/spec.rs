//! Settings of a training.

use std::path::PathBuf;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::augmentation::Augmentation;
use super::error::TrainError;
use crate::dataset::SplitSpec;
use crate::kernel::KernelLevel;
use crate::network::{Head, MOST_POOLED, NetworkKind, NetworkSpec, PAPER_POOLED};
use crate::occupancy_filter::Smoothing;
use crate::standardise::MapReference;

/// Most epochs, maps in a step and initialisations: far beyond any training, and their products do not overflow.
const MOST_EPOCHS: usize = 100_000;
const MOST_IN_BATCH: usize = 65_536;
const MOST_STARTS: u64 = 1000;

/// Standardisation of the latent before `pi * sigmoid`, which the paper leaves open. The constants have no gradient and are
/// saved with the model.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum LatentStandardisation {
    /// None: the initialisation alone sets mean and sigma of the latent.
    None,
    /// Mean and sigma over the training split, measured before each epoch.
    FrozenByEpoch,
    /// Running mean and variance, updated with each batch.
    Running {
        /// Weight of the newest batch, in (0, 1].
        momentum: f32,
    },
}

/// Settings of the minimisation over all training maps.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct FullBatch {
    /// Steps at most.
    pub steps: usize,
    /// Weight in the loss of the sum of the squares of all weights of dense layers, for descriptors of deviation 1.
    pub weight_penalty: f64,
}

/// Settings of a training: with the data, they decide its result.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct TrainSpec {
    /// Seed of initialisation, order and augmentation.
    pub seed: u64,
    /// Kind of the network.
    pub network: NetworkKind,
    /// Layers behind the latent.
    pub head: Head,
    /// Share of the training split's maps that is trained on, drawn by class; 1 for all.
    pub label_fraction: f64,
    /// Maps that are trained on at most, a share of each class; all if absent.
    pub most_training_maps: Option<usize>,
    /// Rule that divides sequences into splits.
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
    /// Number of first epochs in which a linear head reads the latent directly (see [the recipe](super)); half of all epochs if
    /// absent.
    pub linear_epochs: Option<usize>,
    /// Standard deviation that features are scaled to while training.
    pub feature_sigma: f32,
    /// Standard deviation of each component of the latent at the start.
    pub latent_sigma: f32,
    /// Weight of the mean square of the standardised latent in the loss, which keeps it off the flat ends of the sigmoid.
    pub latent_penalty: f64,
    /// Decoupled decay of the weights: share of them that is taken away in a step, as a multiple of the step size. 0 for none.
    pub weight_decay: f64,
    /// Standardisation of the latent.
    pub latent: LatentStandardisation,
    /// Reference level of the maps' cells.
    pub reference: MapReference,
    /// Whether maps are standardised by scene and class, as in the paper, which leaks the label of every map to the network. Such
    /// models classify maps with labels only.
    pub label_leaking_cells: bool,
    /// Settings of the filter over frames, saved with the model.
    pub smoothing: Smoothing,
    /// Rows and columns (range, Doppler) that the second block's output is averaged to; the paper's are 2 and 15.
    pub pooled: [usize; 2],
    /// Whether the network sees maps with range and Doppler exchanged.
    pub transposed: bool,
    /// Whether classes are weighted by the inverse of their number.
    pub class_weights: bool,
    /// Factors of the weights of empty, one and two: how much a frame of each matters beyond how many there are.
    pub label_weights: [f64; 3],
    /// Minimisation over all training maps after the epochs; none if absent. For networks of descriptors, without augmentation.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub full_batch: Option<FullBatch>,
    /// Whether maps in which someone is entering or leaving are used.
    pub transitions: bool,
    /// Augmentation of training maps.
    pub augmentation: Augmentation,
    /// Instruction set of the inner loops; the fastest available one if absent.
    pub kernel_level: Option<KernelLevel>,
    /// torchvision's weights for ResNet-18 or EfficientNet-B0 to start from, as safetensors
    /// ([`TorchvisionWeights`](crate::network::TorchvisionWeights)). What they hold decides the outcome, not where they lie. In a
    /// file, relative to that file.
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
            label_weights: [1.0; 3],
            full_batch: None,
            transitions: true,
            augmentation: Augmentation::default(),
            kernel_level: None,
            weights: None,
        }
    }
}

impl TrainSpec {
    /// Settings of the network that is trained.
    pub fn network_spec(&self) -> NetworkSpec {
        NetworkSpec { kind: self.network, pooled: self.pooled, head: self.head.clone() }
    }

    /// Number of epochs with the linear head.
    pub(super) fn linear_epochs(&self) -> usize {
        self.linear_epochs.unwrap_or(self.epochs / 2)
    }

    /// Checks that [`TrainSpec::full_batch`] goes with the network, which a settings file may leave to the caller.
    ///
    /// # Errors
    /// [`TrainError::Setting`] if not.
    pub(super) fn check_full_batch(&self) -> Result<(), TrainError> {
        let is_fixed = self.network.reads_descriptors() && self.augmentation == Augmentation::default();
        match self.full_batch {
            Some(FullBatch { steps, .. }) if !is_fixed => Err(TrainError::Setting {
                name: "full_batch",
                value: format!("{steps} steps for network {:?}", self.network),
                expected: "a network of descriptors without augmentation, whose inputs stay the same",
            }),
            _ => Ok(()),
        }
    }

    /// Checks all settings.
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
        if !self.label_weights.iter().all(|weight| (1e-3..=1e3).contains(weight)) {
            return fail("label_weights", format!("{:?}", self.label_weights), "0.001 to 1000 each");
        }
        if let Some(FullBatch { steps, weight_penalty }) = self.full_batch {
            if !(1..=MOST_EPOCHS).contains(&steps) {
                return fail("full_batch.steps", steps.to_string(), "1 to 100000");
            }
            if !(weight_penalty.is_finite() && weight_penalty >= 0.0) {
                return fail("full_batch.weight_penalty", weight_penalty.to_string(), "0 or more");
            }
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
