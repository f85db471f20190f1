//! Settings of a study.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::error::StudyError;
use super::outcome::Job;
use crate::network::{Head, NetworkSpec, networks};
use crate::train::TrainSpec;

/// Most trainings and variants of a study. A spec of a megabyte could list more than fit into memory.
const MOST_JOBS: usize = 1_000_000;
const MOST_VARIANTS: usize = 1000;

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
    #[serde(default = "whole")]
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
    /// Whether each recording (sequence) in turn is the test split, for datasets of few recordings.
    #[serde(default)]
    pub leave_one_recording_out: bool,
    /// Settings of all trainings; its network and seed are those of the variants and seeds.
    #[serde(default)]
    pub train: TrainSpec,
}

fn whole() -> Vec<f64> {
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
        let fail = |what: &str, value: String, expected: &str| {
            Err(StudyError::Setting { what: what.to_owned(), value, expected: expected.to_owned() })
        };
        if self.variants.is_empty() || self.seeds.is_empty() {
            return fail("variants and seeds", "none".to_owned(), "at least one of each");
        }
        if self.variants.len() > MOST_VARIANTS {
            return fail("variants", self.variants.len().to_string(), "1000 at most");
        }
        let counts = [self.seeds.len(), self.label_fractions.len(), self.learning_rates.len().max(1)];
        let jobs = counts.into_iter().fold(self.variants.len(), usize::saturating_mul);
        if jobs > MOST_JOBS {
            return fail(
                "variants, seeds, label_fractions and learning_rates",
                jobs.to_string(),
                "1000000 trainings at most",
            );
        }
        self.train.check()?;
        for (index, variant) in self.variants.iter().enumerate() {
            if self.variants.iter().take(index).any(|other| other.name == variant.name) {
                return fail("variants", format!("'{}' twice", variant.name), "names of their own");
            }
            let name = &variant.name;
            if name.is_empty() || !name.chars().all(|c| c.is_ascii_alphanumeric() || "_-.".contains(c)) {
                return fail("a variant's name", format!("'{name}'"), "letters, digits, '_', '-' and '.'");
            }
            let network = self.network(variant)?;
            if let Head::Circuit { circuit, .. } = &network.head
                && let Err(error) = circuit.check()
            {
                return fail(&format!("circuit of variant {name}"), error.to_string(), "a circuit that can be run");
            }
        }
        if let Some(bad) = self.label_fractions.iter().find(|f| !(**f > 0.0 && **f <= 1.0)) {
            return fail("label_fractions", bad.to_string(), "above 0 and up to 1");
        }
        if self.label_fractions.is_empty() {
            return fail("label_fractions", "none".to_owned(), "at least one");
        }
        if let Some(bad) = self.learning_rates.iter().find(|r| !(r.is_finite() && **r > 0.0)) {
            return fail("learning_rates", bad.to_string(), "finite numbers above 0");
        }
        if let Some(bad) = self.snr_db.iter().find(|s| !s.is_finite()) {
            return fail("snr_db", bad.to_string(), "finite numbers");
        }
        Ok(())
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

    /// Learning rates that are tried.
    pub(super) fn rates(&self) -> Vec<f64> {
        if self.learning_rates.is_empty() { vec![self.train.learning_rate] } else { self.learning_rates.clone() }
    }
}
