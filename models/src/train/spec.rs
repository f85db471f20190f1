//! Settings of a training.

use std::path::PathBuf;

use schemars::JsonSchema;
use serde::de::{Error, IntoDeserializer};
use serde::{Deserialize, Deserializer, Serialize};

use super::augmentation::Augmentation;
use super::error::{TrainError, check_setting};
use crate::dataset::SplitSpec;
use crate::evidence_mean::{MEMORY_RANGE, is_valid_memory};
use crate::kernel::KernelLevel;
use crate::metrics::CLASSES;
use crate::network::{Head, MOST_POOLED, NetworkKind, NetworkSpec, PAPER_POOLED};
use crate::occupancy_filter::Smoothing;
use crate::standardise::{MapReference, TRAINED_BOUNDS_DB};

/// Largest number of epochs, of maps in a step, and of initialisations. They are far beyond any training, and their
/// products do not overflow.
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

/// Reads the kind of a network. If the name stands for a network with a head, the error says how to write both.
fn network_kind<'de, D: Deserializer<'de>>(deserializer: D) -> Result<NetworkKind, D::Error> {
    let name = String::deserialize(deserializer)?;
    let kind = NetworkKind::deserialize(IntoDeserializer::<D::Error>::into_deserializer(name.as_str()));
    kind.map_err(|unknown| match NetworkSpec::named(&name) {
        Some(NetworkSpec { kind, head, .. }) => {
            let head = serde_json::to_value(&head).unwrap_or_default();
            let frozen = if head["frozen"] == true { ", frozen = true" } else { "" };
            let head = format!("{{ kind = {}{frozen} }}", head["kind"]);
            D::Error::custom(format!("`{name}` is a network with a head: network = \"{kind}\" and head = {head}"))
        }
        None => unknown,
    })
}

/// Settings of a training: with the data, they decide its result.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct TrainSpec {
    /// Seed of initialisation, order and augmentation.
    pub seed: u64,
    /// Kind of the network.
    #[serde(deserialize_with = "network_kind")]
    pub network: NetworkKind,
    /// Layers behind the latent, which only hqnn and descriptor_hqnn have.
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
    /// Step size of the layers `head`, `head_hidden` and `warm_up`, and of `fc2` in a network of descriptors, as a multiple of
    /// `learning_rate`. Networks with neither latent nor descriptors have none of these layers.
    pub head_rate: f64,
    /// Steps over which the step size rises to its full value.
    pub warm_up_steps: usize,
    /// Initialisations that are tried.
    pub starts: u64,
    /// Epochs that each is given before one is chosen, at most `epochs`.
    pub start_epochs: usize,
    /// Number of first epochs in which a linear head reads the latent directly; half of all epochs if absent.
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
    /// Time over which the model averages the evidence of frames, s, saved with it. The training sees single maps. 0 if absent.
    #[serde(skip_serializing_if = "crate::is_default")]
    pub memory_s: f64,
    /// Settings of the filter over frames, saved with the model.
    #[serde(deserialize_with = "Smoothing::of_spec")]
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
    /// Whether maps in which someone is entering or leaving are trained on. They stay in the validation and test splits.
    pub transitions: bool,
    /// Augmentation of training maps.
    pub augmentation: Augmentation,
    /// Instruction set of the inner loops; the fastest available one if absent.
    pub kernel_level: Option<KernelLevel>,
    /// torchvision's weights for ResNet-18 or EfficientNet-B0 to start from, as safetensors. What they hold decides the outcome,
    /// not where they lie. In a file, relative to that file.
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
            memory_s: 0.0,
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

    /// Number of epochs that each start is given before one is chosen; 0 where there is one start.
    pub(super) fn trial_epochs(&self) -> usize {
        if self.starts > 1 { self.start_epochs.min(self.epochs) } else { 0 }
    }

    /// Number of epochs of all starts together.
    pub fn all_epochs(&self) -> usize {
        let others = (self.starts as usize).saturating_sub(1);
        self.epochs.saturating_add(others.saturating_mul(self.trial_epochs()))
    }

    /// Sets the network of a name ([`NetworkSpec::named`]). The head stays, unless the name stands for another one.
    ///
    /// # Errors
    /// [`TrainError::Setting`] if both the name and the settings choose a head.
    pub fn set_network(&mut self, named: NetworkSpec) -> Result<(), TrainError> {
        if named.head != Head::default() {
            let is_free = self.head == Head::default() || self.head == named.head;
            let expected = "none where the name of the network stands for a head, as estimator_matched does";
            check_setting(is_free, "head", "set beside the name of a network with another head", expected)?;
            self.head = named.head;
        }
        self.network = named.kind;
        Ok(())
    }

    /// Checks that [`TrainSpec::head`] and [`TrainSpec::full_batch`] go with the network, which a settings file may leave to the
    /// caller.
    ///
    /// # Errors
    /// [`TrainError::Setting`] if not.
    pub(super) fn check_network(&self) -> Result<(), TrainError> {
        let has_head = self.network.has_latent() || self.head == Head::default();
        let expected = "none, for only hqnn and descriptor_hqnn have a head to choose";
        check_setting(has_head, "head", format!("set for network {}", self.network), expected)?;
        let Some(FullBatch { steps, .. }) = self.full_batch else { return Ok(()) };
        check_setting(
            self.network.reads_descriptors() && self.augmentation == Augmentation::default(),
            "full_batch",
            format!("{steps} steps for network {}", self.network),
            "a network of descriptors without augmentation, whose inputs stay the same",
        )
    }

    /// Checks all settings.
    ///
    /// # Errors
    /// [`TrainError::Setting`] or [`TrainError::Circuit`] for the first setting that is out of range, and [`TrainError::Dataset`] for shares
    /// of a split that leave nothing to train on.
    pub fn check(&self) -> Result<(), TrainError> {
        let is_penalty = |value: f64| value.is_finite() && value >= 0.0;
        let (epochs, batch_size, starts) = (self.epochs, self.batch_size, self.starts);
        check_setting(epochs > 0, "epochs", epochs, "at least 1")?;
        check_setting(batch_size > 0, "batch_size", batch_size, "at least 1")?;
        check_setting(starts > 0, "starts", starts, "at least 1")?;
        check_setting(epochs <= MOST_EPOCHS, "epochs", epochs, "100000 at most")?;
        check_setting(batch_size <= MOST_IN_BATCH, "batch_size", batch_size, "65536 at most")?;
        check_setting(starts <= MOST_STARTS, "starts", starts, "1000 at most")?;
        let expected = "1 or more where there are several starts";
        check_setting(starts == 1 || self.start_epochs > 0, "start_epochs", self.start_epochs, expected)?;
        check_setting(self.linear_epochs() <= epochs, "linear_epochs", self.linear_epochs(), "0 up to epochs")?;
        let is_weighted = self.label_weights.iter().all(|weight| (1e-3..=1e3).contains(weight));
        check_setting(is_weighted, "label_weights", format!("{:?}", self.label_weights), "0.001 to 1000 each")?;
        if let Some(FullBatch { steps, weight_penalty }) = self.full_batch {
            check_setting((1..=MOST_EPOCHS).contains(&steps), "full_batch.steps", steps, "1 to 100000")?;
            check_setting(is_penalty(weight_penalty), "full_batch.weight_penalty", weight_penalty, "0 or more")?;
        }
        self.split.check()?;
        check_setting((0.0..=10.0).contains(&self.weight_decay), "weight_decay", self.weight_decay, "0 to 10")?;
        check_setting(is_penalty(self.latent_penalty), "latent_penalty", self.latent_penalty, "0 or more")?;
        for (name, value) in [
            ("learning_rate", self.learning_rate),
            ("angle_rate", self.angle_rate),
            ("head_rate", self.head_rate),
            ("feature_sigma", f64::from(self.feature_sigma)),
            ("latent_sigma", f64::from(self.latent_sigma)),
        ] {
            check_setting(value.is_finite() && value > 0.0, name, value, "a finite number above 0")?;
        }
        let is_share = self.label_fraction > 0.0 && self.label_fraction <= 1.0;
        check_setting(is_share, "label_fraction", self.label_fraction, "above 0 and up to 1")?;
        let most_maps = self.most_training_maps.unwrap_or(usize::MAX);
        check_setting(most_maps >= CLASSES, "most_training_maps", most_maps, "at least 3, one of each class")?;
        if let Head::Circuit { circuit, .. } = &self.head
            && let Err(error) = circuit.check()
        {
            return Err(TrainError::Circuit { error });
        }
        // Cards of earlier trainings may have other bounds.
        if let MapReference::OverNoise { most_db: Some(most_db), .. } = self.reference {
            let expected = "3 to 350 dB: cells of noise have a mean of 2.6 dB";
            let is_bound = TRAINED_BOUNDS_DB.contains(&most_db);
            check_setting(is_bound, "reference.over_noise.most_db", most_db, expected)?;
        }
        self.augmentation.check(self.reference)?;
        let is_labelled = self.augmentation.superpose.is_none() || !self.label_leaking_cells;
        let expected = "false where augmentation.superpose changes labels";
        check_setting(is_labelled, "label_leaking_cells", true, expected)?;
        let is_pooled = self.pooled.iter().all(|n| (1..=MOST_POOLED).contains(n));
        check_setting(is_pooled, "pooled", format!("{:?}", self.pooled), "1 to 64 rows and columns")?;
        check_setting(is_valid_memory(self.memory_s), "memory_s", self.memory_s, MEMORY_RANGE)?;
        if let Some((name, value, expected)) = self.smoothing.invalid_setting() {
            return check_setting(false, name, value, expected);
        }
        self.network.check_maps(self.reference, self.transposed, self.label_leaking_cells)?;
        let LatentStandardisation::Running { momentum } = self.latent else { return Ok(()) };
        let is_share = momentum > 0.0 && momentum <= 1.0;
        check_setting(is_share, "latent.running.momentum", momentum, "above 0 and up to 1")
    }
}
