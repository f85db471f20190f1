//! The jobs of a study, run one after the other in a folder.

use std::collections::BTreeMap;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::time::Instant;

use sha2::{Digest, Sha256};

use super::error::StudyError;
use super::noise::with_noise;
use super::outcome::{Job, Noisy, Outcome};
use super::report::{Report, report};
use super::spec::StudySpec;
use crate::bounded_file::{TEXT_LIMIT_BYTES, read_text};
use crate::dataset::{Dataset, Split};
use crate::evaluate::evaluate;
use crate::model::Classifier;
use crate::train::{EpochReport, TrainError, train_with_checkpoint};
use crate::whole_file;

/// Longest `study.json` that is read: a spec as JSON is longer than as TOML.
const IDENTITY_LIMIT_BYTES: u64 = 16 << 20;

/// Progress of a study.
pub enum Progress<'a> {
    /// Start of a job: its number, and the number of jobs known so far.
    Job(&'a Job, usize, usize),
    /// End of an epoch of the job.
    Epoch(&'a EpochReport),
    /// End of the job.
    Done(&'a Outcome),
}

/// Study in a folder.
pub struct Study<'a> {
    spec: &'a StudySpec,
    dataset: &'a Dataset,
    folder: PathBuf,
    /// Number of this worker, and number of workers that share the jobs.
    shard: (usize, usize),
}

impl<'a> Study<'a> {
    /// Opens a study in a folder, or starts one.
    ///
    /// # Errors
    /// Those of [`StudySpec::check`], [`StudyError::Foreign`] if the folder holds another study, and [`StudyError::File`] if it
    /// cannot be written or read.
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

    /// Runs the remaining jobs until `go_on` returns `false`. Returns all outcomes that exist.
    ///
    /// # Errors
    /// [`StudyError`] for the first training that cannot be done, model that cannot be evaluated, or file that cannot be written or
    /// read. A training that ends in a number that is not finite is an outcome and no error.
    pub fn run(&self, go_on: &dyn Fn() -> bool, tell: &mut dyn FnMut(Progress)) -> Result<Vec<Outcome>, StudyError> {
        let held_out = self.held_out();
        let rates = self.spec.rates();
        // The jobs for the learning rates come first, because the others depend on them.
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
        // Seed by seed, so that early results are the whole comparison with few seeds.
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

    /// All outcomes that exist, in the order of their file names.
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

    /// Makes the report on the outcomes that exist.
    ///
    /// # Errors
    /// Those of [`Study::outcomes`].
    pub fn report(&self) -> Result<Report, StudyError> {
        Ok(report(self.spec, self.dataset, &self.chosen_rates()?, &self.outcomes()?))
    }

    /// Recordings that are held out in turn, or a single `None`.
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
            // A training that diverges is a result; one that cannot be run is an error.
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
