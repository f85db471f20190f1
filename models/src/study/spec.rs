//! Settings of a study.

use std::collections::BTreeSet;
use std::fmt::Display;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::error::{StudyError, check_setting};
use super::outcome::Job;
use crate::network::{Head, NetworkSpec, networks};
use crate::train::TrainSpec;

/// Largest number of trainings and variants of a study. A spec of a megabyte could list more than fit into memory.
const MOST_JOBS: usize = 1_000_000;
const MOST_VARIANTS: usize = 1000;
/// Largest magnitude of a signal-to-noise ratio, dB, as of datasets. Far beyond it cells are infinite.
const MOST_SNR_DB: f64 = 100.0;

/// Settings of a study.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct StudySpec {
    /// Heading of the report.
    pub title: String,
    /// Differences from the protocol of the paper that it is compared with, one paragraph for each line.
    #[serde(default)]
    pub remarks: Vec<String>,
    /// Networks that are compared.
    pub variants: Vec<Variant>,
    /// Seeds of initialisation and order.
    pub seeds: Vec<u64>,
    /// Shares of the training maps; all of them if absent.
    #[serde(default = "all_labels")]
    pub label_fractions: Vec<f64>,
    /// Learning rates to choose from; the one of `train` if absent.
    #[serde(default)]
    pub learning_rates: Vec<f64>,
    /// Gaussian noise on the test maps, dB; models of the whole training split only.
    #[serde(default)]
    pub snr_db: Vec<f64>,
    /// Balanced accuracy on the validation split whose first epoch is reported.
    #[serde(default = "target")]
    pub target: f64,
    /// Whether each recording (sequence), or each group of them if `train.split` has `by`, in turn is the test split, for datasets of
    /// few recordings. The report scores the predictions on all recordings together, once for each seed.
    #[serde(default)]
    pub leave_one_recording_out: bool,
    /// Settings of all trainings; its network and seed are those of the variants and seeds.
    #[serde(default)]
    pub train: TrainSpec,
}

/// Checks that the values of a list differ.
fn check_distinct<T: Copy + Display, K: Ord>(what: &str, values: &[T], key: impl Fn(T) -> K) -> Result<(), StudyError> {
    let mut seen = BTreeSet::new();
    let twice = values.iter().find(|value| !seen.insert(key(**value)));
    twice.map_or(Ok(()), |value| check_setting(false, what, format!("{value} twice"), "each value once"))
}

fn all_labels() -> Vec<f64> {
    vec![1.0]
}

fn target() -> f64 {
    0.9
}

/// One network of a comparison.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Variant {
    /// Name in the report; a network's own name needs nothing else.
    pub name: String,
    /// Network, as `radome model list` names it, if the name is another.
    #[serde(default)]
    pub network: Option<String>,
    /// Another head of the HQNN.
    #[serde(default)]
    pub head: Option<Head>,
    /// Whether the network sees maps with range and Doppler exchanged.
    #[serde(default)]
    pub transposed: Option<bool>,
}

impl StudySpec {
    /// Checks all settings.
    ///
    /// # Errors
    /// [`StudyError::Setting`] and [`StudyError::Train`] for the first setting that is out of range.
    pub fn check(&self) -> Result<(), StudyError> {
        let has_work = !self.variants.is_empty() && !self.seeds.is_empty();
        check_setting(has_work, "variants and seeds", "none", "at least one of each")?;
        let variants = self.variants.len();
        check_setting(variants <= MOST_VARIANTS, "variants", variants, "1000 at most")?;
        let counts = [self.seeds.len(), self.label_fractions.len(), self.learning_rates.len().max(1)];
        let jobs = counts.into_iter().fold(variants, usize::saturating_mul);
        let what = "variants, seeds, label_fractions and learning_rates";
        check_setting(jobs <= MOST_JOBS, what, jobs, "1000000 trainings at most")?;
        check_distinct("seeds", &self.seeds, |seed| seed)?;
        check_distinct("label_fractions", &self.label_fractions, f64::to_bits)?;
        check_setting((0.0..=1.0).contains(&self.target), "target", self.target, "0 to 1, as balanced accuracy is")?;
        let expected = "1, for label_fractions of the study say which shares are trained on";
        check_setting(self.train.label_fraction == 1.0, "train.label_fraction", self.train.label_fraction, expected)?;
        self.train.check()?;
        for (index, variant) in self.variants.iter().enumerate() {
            let name = &variant.name;
            let is_new = !self.variants.iter().take(index).any(|other| other.name == *name);
            check_setting(is_new, "variants", format!("'{name}' twice"), "names of their own")?;
            let is_plain = !name.is_empty() && name.chars().all(|c| c.is_ascii_alphanumeric() || "_-.".contains(c));
            let expected = "letters, digits, '_', '-' and '.'";
            check_setting(is_plain, "a variant's name", format!("'{name}'"), expected)?;
            let network = self.network(variant)?;
            let has_head = network.kind.has_latent() || variant.head.is_none();
            let expected = "none, for only hqnn and descriptor_hqnn have a head to choose";
            check_setting(has_head, format!("head of variant {name}"), format!("set for {}", network.kind), expected)?;
            if let Head::Circuit { circuit, .. } = &network.head
                && let Err(error) = circuit.check()
            {
                return Err(StudyError::Circuit { variant: name.clone(), error });
            }
        }
        for &share in &self.label_fractions {
            check_setting(share > 0.0 && share <= 1.0, "label_fractions", share, "above 0 and up to 1")?;
        }
        check_setting(!self.label_fractions.is_empty(), "label_fractions", "none", "at least one")?;
        for &rate in &self.learning_rates {
            check_setting(rate.is_finite() && rate > 0.0, "learning_rates", rate, "finite numbers above 0")?;
        }
        let is_ratio = |snr_db: f64| (-MOST_SNR_DB..=MOST_SNR_DB).contains(&snr_db);
        self.snr_db.iter().try_for_each(|&snr_db| check_setting(is_ratio(snr_db), "snr_db", snr_db, "-100 to 100"))
    }

    /// Checks that models are trained on all labels, which conditions need.
    ///
    /// # Errors
    /// [`StudyError::Setting`] if not.
    pub fn check_models(&self) -> Result<(), StudyError> {
        let expected = "1 among them: models of all labels are put to conditions";
        let shares = &self.label_fractions;
        check_setting(shares.contains(&1.0), "label_fractions", format!("{shares:?}"), expected)
    }

    /// The network of a variant.
    ///
    /// # Errors
    /// [`StudyError::Setting`] if there is no network of this name.
    pub fn network(&self, variant: &Variant) -> Result<NetworkSpec, StudyError> {
        let name = variant.network.as_ref().unwrap_or(&variant.name);
        let known = match (NetworkSpec::named(name), &variant.head) {
            (Some(known), _) => known,
            (None, Some(_)) if variant.network.is_none() => NetworkSpec::with_head(Head::default()),
            (None, _) => {
                let known: Vec<String> = networks().into_iter().map(|network| network.name).collect();
                return Err(StudyError::Setting {
                    what: format!("network of variant {}", variant.name),
                    value: format!("'{name}'"),
                    expected: known.join(", "),
                });
            }
        };
        let head = variant.head.clone().unwrap_or(known.head);
        Ok(NetworkSpec { kind: known.kind, pooled: self.train.pooled, head })
    }

    /// Settings of the training of a job.
    pub(super) fn train_spec(&self, job: &Job) -> Result<TrainSpec, StudyError> {
        let Some(variant) = self.variants.iter().find(|variant| variant.name == job.variant) else {
            return Err(StudyError::Setting {
                what: "variant".to_owned(),
                value: job.variant.clone(),
                expected: "one of the study's".to_owned(),
            });
        };
        let network = self.network(variant)?;
        let mut spec = TrainSpec {
            seed: job.seed,
            network: network.kind,
            head: network.head,
            label_fraction: job.label_fraction,
            learning_rate: job.learning_rate,
            transposed: variant.transposed.unwrap_or(self.train.transposed),
            ..self.train.clone()
        };
        if let Some(held_out) = &job.held_out {
            spec.split.held_out = Some(held_out.clone());
        }
        // Only heads behind a narrow latent need several starts.
        if !network.kind.has_latent() {
            spec.starts = 1;
        }
        Ok(spec)
    }

    pub(super) fn rates(&self) -> Vec<f64> {
        if self.learning_rates.is_empty() { vec![self.train.learning_rate] } else { self.learning_rates.clone() }
    }
}
