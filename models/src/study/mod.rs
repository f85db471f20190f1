//! A comparison of networks over seeds, label fractions and noise: a plan of jobs, each of which ends in one file, and a report
//! of whatever files there are. A study that was stopped carries on where it was, also within a training.
//!
//! # Equal treatment
//! Every variant is trained by the same recipe ([`crate::train`]) and gets the same grid of learning rates, of which the best
//! by balanced accuracy on the validation split under the first seed is used for all seeds; the test split decides nothing.
//! A training that stops on a number that is not finite, or ends no better than [`FAILED_BELOW`] on its own training maps,
//! counts as failed and stays in the means.

mod noise;
mod report;
mod statistics;

use std::collections::BTreeMap;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::time::Instant;

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use thiserror::Error;

pub use noise::{NoisyMaps, with_noise};
pub use report::{Cell, Report, report};
pub use statistics::{Interval, t_interval};

use crate::bounded_file::{TEXT_LIMIT_BYTES, read_text};
use crate::dataset::{Dataset, DatasetError, Split};
use crate::evaluate::evaluate;
use crate::metrics::Metrics;
use crate::model::{Classifier, ClassifyError};
use crate::network::{Head, NetworkSpec};
use crate::train::{EpochReport, TrainError, TrainSpec, train_with_checkpoint};
use crate::whole_file;

/// Balanced accuracy on the training maps below which a training has failed: chance is a third.
pub const FAILED_BELOW: f64 = 0.45;

/// Longest `study.json` that is read: a spec as JSON is longer than as TOML.
const IDENTITY_LIMIT_BYTES: u64 = 16 << 20;
/// Trainings of a study at most, and variants: a spec of a megabyte could ask for more than fit into memory.
const MOST_JOBS: usize = 1_000_000;
const MOST_VARIANTS: usize = 1000;

/// What is compared.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StudySpec {
    /// Heading of the report.
    pub title: String,
    /// What differs from the protocol of a paper that it is put beside; a paragraph a line.
    #[serde(default)]
    pub remarks: Vec<String>,
    /// Which networks.
    pub variants: Vec<Variant>,
    /// Seeds of initialisation and order.
    pub seeds: Vec<u64>,
    /// Shares of the training maps; all of them if absent.
    #[serde(default = "whole")]
    pub label_fractions: Vec<f64>,
    /// Learning rates to choose from; the one of `train` if absent.
    #[serde(default)]
    pub learning_rates: Vec<f64>,
    /// Gaussian noise on the test maps, dB (paper.md section 4); models of the whole training split only.
    #[serde(default)]
    pub snr_db: Vec<f64>,
    /// Balanced accuracy on the validation split whose first epoch is reported.
    #[serde(default = "target")]
    pub target: f64,
    /// Each recording (sequence) in turn is the test split, as few recordings demand.
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
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Variant {
    /// Name in the report; a network's own name needs nothing else.
    pub name: String,
    /// Network, as `radome models` names it, if the name is another.
    #[serde(default)]
    pub network: Option<String>,
    /// Another head of the HQNN.
    #[serde(default)]
    pub head: Option<Head>,
    /// Exchange range and Doppler of the maps that the network sees.
    #[serde(default)]
    pub transposed: Option<bool>,
}

/// A study that cannot be run.
#[derive(Debug, Error)]
pub enum StudyError {
    /// A setting is out of range.
    #[error("study: {what} is {value}, expected {expected}")]
    Setting {
        /// Which.
        what: String,
        /// What it is.
        value: String,
        /// What it may be.
        expected: String,
    },
    /// A file of the study cannot be written or read.
    #[error("{path}: {reason}")]
    File {
        /// File or folder.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// Results of another study or dataset are in the folder.
    #[error("{path} holds results of another study or dataset\n\nhint: give this one a folder of its own")]
    Foreign {
        /// Folder.
        path: PathBuf,
    },
    /// A training cannot be done at all.
    #[error(transparent)]
    Train(#[from] TrainError),
    /// A model cannot be evaluated.
    #[error(transparent)]
    Classify(#[from] ClassifyError),
    /// The dataset cannot be read or split.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
}

/// One training and its evaluation.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Job {
    /// Name of the variant.
    pub variant: String,
    /// Share of the training maps.
    pub label_fraction: f64,
    /// Learning rate.
    pub learning_rate: f64,
    /// Seed.
    pub seed: u64,
    /// Recording that is the test split, where each in turn is.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub held_out: Option<String>,
}

/// What a job came to.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Outcome {
    /// Which job.
    pub job: Job,
    /// Why the training ended early, if it did.
    pub error: Option<String>,
    /// Balanced accuracy on the training maps, as they were met in the last epoch.
    pub training: f64,
    /// Scores on the validation split.
    pub validation: Option<Metrics>,
    /// Scores on the test split.
    pub test: Option<Metrics>,
    /// Scores on the test split under noise, in the order of the spec.
    pub noisy: Vec<Noisy>,
    /// Epochs until the target was reached on the validation split.
    pub epochs_to_target: Option<usize>,
    /// Time of that, s.
    pub seconds_to_target: Option<f64>,
    /// Time of the epochs, s.
    pub training_seconds: f64,
    /// Median time of one map through the classifier, ms.
    pub latency_ms: f64,
    /// Trained numbers.
    pub parameters: usize,
    /// Multiply-adds of one map.
    pub multiply_adds: u64,
}

impl Outcome {
    /// Whether the training came to nothing.
    pub fn failed(&self) -> bool {
        self.error.is_some() || self.training < FAILED_BELOW
    }
}

/// Scores under noise.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Noisy {
    /// Signal-to-noise ratio, dB.
    pub snr_db: f64,
    /// Scores.
    pub metrics: Metrics,
}

/// What the one who waits is told.
pub enum Progress<'a> {
    /// A job begins: its number of all that are known so far.
    Job(&'a Job, usize, usize),
    /// An epoch of it is done.
    Epoch(&'a EpochReport),
    /// It is done.
    Done(&'a Outcome),
}

impl StudySpec {
    /// Checks every setting.
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
                let known: Vec<String> = crate::network::networks().into_iter().map(|network| network.name).collect();
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

    fn train_spec(&self, job: &Job) -> Result<TrainSpec, StudyError> {
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
        // Only heads behind a narrow latent need several starts to choose from; others would be given none of it.
        if !network.kind.has_latent() {
            spec.starts = 1;
        }
        Ok(spec)
    }

    fn rates(&self) -> Vec<f64> {
        if self.learning_rates.is_empty() { vec![self.train.learning_rate] } else { self.learning_rates.clone() }
    }
}

/// A study on its way in a folder.
pub struct Study<'a> {
    spec: &'a StudySpec,
    dataset: &'a Dataset,
    folder: PathBuf,
    /// Of so many workers this is the one of this number, and takes its share of the jobs.
    shard: (usize, usize),
}

impl<'a> Study<'a> {
    /// Opens or begins a study in a folder.
    ///
    /// # Errors
    /// Those of [`StudySpec::check`], [`StudyError::Foreign`] if the folder holds another study, and [`StudyError::File`] if it cannot
    /// be written or read.
    pub fn open(
        spec: &'a StudySpec,
        dataset: &'a Dataset,
        folder: &Path,
        shard: (usize, usize),
    ) -> Result<Self, StudyError> {
        spec.check()?;
        for part in ["results", "checkpoints"] {
            let path = folder.join(part);
            std::fs::create_dir_all(&path).map_err(|e| file(&path, e))?;
        }
        let identity = format!("{} {}\n", serde_json::to_string(spec).map_err(|e| file(folder, e))?, dataset.hash());
        let path = folder.join("study.json");
        match read_text(&path, IDENTITY_LIMIT_BYTES) {
            Ok(found) if found == identity => {}
            Ok(_) => return Err(StudyError::Foreign { path: folder.to_owned() }),
            Err(error) if error.kind() == ErrorKind::NotFound => write_whole(&path, identity.as_bytes())?,
            Err(error) => return Err(file(&path, error)),
        }
        Ok(Study { spec, dataset, folder: folder.to_owned(), shard })
    }

    /// Runs what is not done yet until `go_on` says no; gives all outcomes there are.
    ///
    /// # Errors
    /// [`StudyError`] for the first training that cannot be done, model that cannot be evaluated, or file that cannot be written or
    /// read. A training that ends in a number that is not finite is an outcome and no error.
    pub fn run(&self, go_on: &dyn Fn() -> bool, tell: &mut dyn FnMut(Progress)) -> Result<Vec<Outcome>, StudyError> {
        let held_out = self.held_out();
        let rates = self.spec.rates();
        // First the rates, which decide what the other jobs are.
        let mut jobs = Vec::new();
        for variant in &self.spec.variants {
            for &learning_rate in &rates {
                jobs.push(Job {
                    variant: variant.name.clone(),
                    label_fraction: 1.0,
                    learning_rate,
                    seed: self.spec.seeds.first().copied().unwrap_or_default(),
                    held_out: held_out.first().cloned().flatten(),
                });
            }
        }
        if rates.len() > 1 {
            self.work(&jobs, go_on, tell)?;
        }
        let chosen = self.chosen_rates()?;
        let mut jobs = Vec::new();
        // Seed by seed, so that what is there early is the whole comparison with few seeds.
        for &seed in &self.spec.seeds {
            for &label_fraction in &self.spec.label_fractions {
                for variant in &self.spec.variants {
                    let Some(&learning_rate) = chosen.get(&variant.name) else { continue };
                    jobs.extend(held_out.iter().map(|held_out| Job {
                        variant: variant.name.clone(),
                        label_fraction,
                        learning_rate,
                        seed,
                        held_out: held_out.clone(),
                    }));
                }
            }
        }
        self.work(&jobs, go_on, tell)?;
        self.outcomes()
    }

    /// Learning rate of each variant: the best on the validation split, once all rates have been tried.
    ///
    /// # Errors
    /// Those of [`Study::outcomes`].
    pub fn chosen_rates(&self) -> Result<BTreeMap<String, f64>, StudyError> {
        let rates = self.spec.rates();
        if let [rate] = rates[..] {
            return Ok(self.spec.variants.iter().map(|variant| (variant.name.clone(), rate)).collect());
        }
        let outcomes = self.outcomes()?;
        let mut chosen = BTreeMap::new();
        for variant in &self.spec.variants {
            let score = |rate: f64| {
                let tried = outcomes.iter().find(|outcome| {
                    let job = &outcome.job;
                    let first = self.spec.seeds.first() == Some(&job.seed);
                    job.variant == variant.name && job.learning_rate == rate && job.label_fraction == 1.0 && first
                })?;
                Some(tried.validation.as_ref().map_or(0.0, |metrics| metrics.balanced_accuracy))
            };
            let scores: Option<Vec<f64>> = rates.iter().map(|&rate| score(rate)).collect();
            let best = scores.and_then(|scores| {
                let mut best: Option<(f64, f64)> = None;
                for (&rate, score) in rates.iter().zip(scores) {
                    if best.is_none_or(|(_, found)| score > found) {
                        best = Some((rate, score));
                    }
                }
                best
            });
            if let Some((rate, _)) = best {
                chosen.insert(variant.name.clone(), rate);
            }
        }
        Ok(chosen)
    }

    /// All outcomes that are there, in the order of their files' names.
    ///
    /// # Errors
    /// [`StudyError::File`] if the folder or a file of it cannot be read or understood.
    pub fn outcomes(&self) -> Result<Vec<Outcome>, StudyError> {
        let folder = self.folder.join("results");
        let mut paths: Vec<PathBuf> = std::fs::read_dir(&folder)
            .map_err(|e| file(&folder, e))?
            .filter_map(|entry| Some(entry.ok()?.path()))
            .filter(|path| path.extension().is_some_and(|extension| extension == "json"))
            .collect();
        paths.sort();
        let read = |path: &PathBuf| {
            let text = read_text(path, TEXT_LIMIT_BYTES).map_err(|e| file(path, e))?;
            serde_json::from_str(&text).map_err(|e| file(path, e))
        };
        paths.iter().map(read).collect()
    }

    /// The report of what is there.
    ///
    /// # Errors
    /// Those of [`Study::outcomes`].
    pub fn report(&self) -> Result<Report, StudyError> {
        Ok(report(self.spec, self.dataset, &self.chosen_rates()?, &self.outcomes()?))
    }

    /// Recordings that are held out in turn, or nothing once.
    fn held_out(&self) -> Vec<Option<String>> {
        if !self.spec.leave_one_recording_out {
            return vec![None];
        }
        let names: std::collections::BTreeSet<&str> =
            self.dataset.rows().iter().map(|row| row.sequence.as_str()).collect();
        names.into_iter().map(|name| Some(name.to_owned())).collect()
    }

    fn work(&self, jobs: &[Job], go_on: &dyn Fn() -> bool, tell: &mut dyn FnMut(Progress)) -> Result<(), StudyError> {
        let (worker, workers) = self.shard;
        for (index, job) in jobs.iter().enumerate().filter(|(index, _)| index % workers.max(1) == worker) {
            let path = self.folder.join("results").join(format!("{}.json", name(job)));
            if path.exists() {
                continue;
            }
            if !go_on() {
                return Ok(());
            }
            tell(Progress::Job(job, index + 1, jobs.len()));
            let outcome = self.train(job, tell)?;
            let text = serde_json::to_string_pretty(&outcome).map_err(|e| file(&path, e))?;
            write_whole(&path, text.as_bytes())?;
            tell(Progress::Done(&outcome));
        }
        Ok(())
    }

    fn train(&self, job: &Job, tell: &mut dyn FnMut(Progress)) -> Result<Outcome, StudyError> {
        let spec = self.spec.train_spec(job)?;
        let shape = self.dataset.header().shape;
        let network = spec.network_spec();
        let [range, doppler] =
            if spec.transposed { [shape.doppler, shape.range] } else { [shape.range, shape.doppler] };
        let mut outcome = Outcome {
            job: job.clone(),
            error: None,
            training: 0.0,
            validation: None,
            test: None,
            noisy: Vec::new(),
            epochs_to_target: None,
            seconds_to_target: None,
            training_seconds: 0.0,
            latency_ms: 0.0,
            parameters: network.parameter_count(),
            multiply_adds: network.multiply_adds(range, doppler),
        };
        let checkpoint = self.folder.join("checkpoints").join(format!("{}.safetensors", name(job)));
        let trained = train_with_checkpoint(self.dataset, &spec, Some(&checkpoint), &mut |r| tell(Progress::Epoch(&r)));
        let trained = match trained {
            Ok(trained) => trained,
            // A training that runs away is a result; one that cannot be done is not.
            Err(error @ TrainError::NonFinite { .. }) => {
                let _ = std::fs::remove_file(&checkpoint);
                outcome.error = Some(error.to_string());
                return Ok(outcome);
            }
            Err(error) => return Err(error.into()),
        };
        outcome.training = trained.history.last().map_or(0.0, |epoch| epoch.training_balanced_accuracy);
        outcome.training_seconds = trained.history.iter().map(|epoch| epoch.seconds).sum();
        let mut seconds = 0.0;
        for (index, epoch) in trained.history.iter().enumerate() {
            seconds += epoch.seconds;
            if epoch.validation_balanced_accuracy >= self.spec.target && outcome.epochs_to_target.is_none() {
                outcome.epochs_to_target = Some(index + 1);
                outcome.seconds_to_target = Some(seconds);
            }
        }
        outcome.validation = Some(trained.validation);
        outcome.test = trained.test;
        let test: Vec<usize> = self
            .dataset
            .splits(&spec.split)?
            .iter()
            .enumerate()
            .filter(|&(_, &split)| split == Split::Test)
            .map(|(index, _)| index)
            .collect();
        let mut classifier = Classifier::new(trained.model);
        if job.label_fraction == 1.0 {
            for &snr_db in &self.spec.snr_db {
                let noisy = with_noise(self.dataset, &test, snr_db)?;
                outcome.noisy.push(Noisy { snr_db, metrics: noisy.evaluate(&mut classifier)? });
            }
        }
        outcome.latency_ms = self.latency_ms(&mut classifier, &test)?;
        Ok(outcome)
    }

    /// Median time of one map, ms, over up to 30 maps after a few to warm up.
    fn latency_ms(&self, classifier: &mut Classifier, test: &[usize]) -> Result<f64, StudyError> {
        let maps = test.iter().cycle().take(if test.is_empty() { 0 } else { 33 });
        let mut times = Vec::new();
        for index in maps {
            let one = [*index];
            let began = Instant::now();
            evaluate(classifier, self.dataset, &one)?;
            times.push(1e3 * began.elapsed().as_secs_f64());
        }
        let mut times = times.split_off(times.len().min(3));
        times.sort_by(f64::total_cmp);
        Ok(times.get(times.len() / 2).copied().unwrap_or_default())
    }
}

/// A job's name in files.
fn name(job: &Job) -> String {
    let held_out = job.held_out.as_ref().map_or_else(String::new, |sequence| {
        let hash = Sha256::digest(sequence.as_bytes());
        format!("-without-{:02x}{:02x}{:02x}{:02x}", hash[0], hash[1], hash[2], hash[3])
    });
    format!("{}-{}-{}-{}{held_out}", job.variant, job.label_fraction, job.learning_rate, job.seed)
}

fn write_whole(path: &Path, bytes: &[u8]) -> Result<(), StudyError> {
    whole_file::write(path, bytes).map_err(|e| file(path, e))
}

fn file(path: &Path, reason: impl std::fmt::Display) -> StudyError {
    StudyError::File { path: path.to_owned(), reason: reason.to_string() }
}
