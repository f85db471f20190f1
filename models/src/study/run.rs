//! The jobs of a study, run one after the other in a folder that other processes may share.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use radome_files::{TEXT_LIMIT_BYTES, read_text};
use serde::Serialize;

use super::condition::{self, Condition, ConditionReport, ConditionScores};
use super::cost::{Cost, Meter};
use super::error::StudyError;
use super::jobs::{name, shard_jobs};
use super::noise::add_noise;
use super::outcome::{Job, Noisy, Outcome};
use super::report::{Report, report};
use super::spec::StudySpec;
use super::times::{Times, times};
use crate::atomic_file;
use crate::dataset::{Dataset, DatasetError, lock_file, lock_folder, share_folder};
use crate::evaluate::{evaluate, evaluate_changed};
use crate::interval::median;
use crate::model::{Classifier, Model, input_shape};
use crate::train::{EpochReport, Indices, Maps, TrainError, TrainOutcome, TrainSpec, check_memory, train_on};

/// Longest `study.json` that is read: a spec as JSON is longer than as TOML.
const IDENTITY_LIMIT_BYTES: u64 = 16 << 20;
/// Longest result that is read: its curve has up to 100,000 epochs of about 400 bytes.
const RESULT_LIMIT_BYTES: u64 = 64 << 20;
/// Interval between two checks of jobs that other processes run.
const OTHERS_WAIT: Duration = Duration::from_millis(200);
/// Number of maps that are classified before the timed ones.
const WARM_UP_MAPS: usize = 3;
/// Least number of timed maps.
const LEAST_TIMED_MAPS: usize = 30;
/// Least timed duration: energy counters advance every millisecond.
const LEAST_TIMED_DURATION: Duration = Duration::from_millis(300);

/// Progress of a study.
pub enum Progress<'a> {
    /// Start of a job: its number, and the number of jobs known so far.
    Job(&'a Job, usize, usize),
    /// End of an epoch of the job.
    Epoch(&'a EpochReport),
    /// End of the job.
    Done(&'a Outcome),
    /// Start of an evaluation of the job's model under a condition: name of the condition, number of this evaluation,
    /// and of all evaluations that are done in turn.
    Evaluation(&'a Job, &'a str, usize, usize),
    /// End of such an evaluation.
    Evaluated(&'a ConditionScores),
}

/// Task with one result file: a training, or the evaluation of its model under a condition.
#[derive(Clone, Copy)]
struct Task<'j> {
    job: &'j Job,
    condition: Option<&'j Condition>,
}

impl Task<'_> {
    /// Name in files.
    fn name(self) -> String {
        match self.condition {
            None => name(self.job),
            Some(condition) => format!("{}@{}", name(self.job), condition.file_name),
        }
    }
}

fn trainings(jobs: &[Job]) -> Vec<Task<'_>> {
    jobs.iter().map(|job| Task { job, condition: None }).collect()
}

/// Study in a folder.
pub struct Study<'a> {
    pub(super) spec: &'a StudySpec,
    pub(super) dataset: &'a Dataset,
    /// The dataset's maps, which all trainings share.
    pub(super) maps: Maps<'a>,
    conditions: &'a [Condition],
    folder: PathBuf,
    /// Index of this shard, and number of shards.
    shard: (usize, usize),
}

impl<'a> Study<'a> {
    /// Opens a study in a folder, or starts one. `shard` is the index of the part of the jobs that is run, from 0, and the number of
    /// parts.
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
        for part in ["results", "checkpoints", "models", "judged"] {
            let path = folder.join(part);
            std::fs::create_dir_all(&path).map_err(|e| file(&path, e))?;
        }
        let identity = format!("{} {}\n", serde_json::to_string(spec).map_err(|e| file(folder, e))?, dataset.hash());
        let path = folder.join("study.json");
        match read_text(&path, IDENTITY_LIMIT_BYTES) {
            Ok(found) if found == identity => {}
            Ok(_) => return Err(StudyError::Foreign { path: folder.to_owned() }),
            Err(error) if error.kind() == ErrorKind::NotFound => write_file(&path, identity.as_bytes())?,
            Err(error) => return Err(file(&path, error)),
        }
        let maps = Maps::new(dataset, spec.train.reference);
        Ok(Study { spec, dataset, maps, conditions: &[], folder: folder.to_owned(), shard })
    }

    /// The study with conditions under which the models of its trainings are evaluated.
    ///
    /// # Errors
    /// [`StudyError::Setting`] if two conditions have one name in files, or if no training is on all labels, and
    /// [`StudyError::Maps`] if the maps of a condition are of another kind than the study's.
    pub fn with_conditions(self, conditions: &'a [Condition]) -> Result<Self, StudyError> {
        condition::check(self.spec, self.dataset, conditions)?;
        Ok(Study { conditions, ..self })
    }

    /// Runs the remaining jobs of this shard until `should_continue` returns `false`, and evaluates the model of each under the
    /// conditions as soon as it is trained. Returns all outcomes that exist.
    ///
    /// Shards may run at once, in any order and in any number of processes: a job is run by the process that locks it
    /// first. A shard tries the learning rates that it needs and that no other shard has tried, or waits for them.
    ///
    /// # Errors
    /// [`DatasetError::Busy`] if another process works on the study as a whole, or on a shard where this is no shard, and otherwise
    /// [`StudyError`] for the first training that cannot be done, model that cannot be evaluated, or file that cannot be written or
    /// read. A training that ends in a number that is not finite is an outcome and no error.
    pub fn run(
        &self,
        should_continue: &dyn Fn() -> bool,
        report: &mut dyn FnMut(Progress),
    ) -> Result<Vec<Outcome>, StudyError> {
        let _lock = if self.shard.1 > 1 { share_folder(&self.folder) } else { lock_folder(&self.folder) }?;
        let held_out = self.spec.held_out(self.dataset);
        for variant in &self.spec.variants {
            let rate = self.spec.train.learning_rate;
            check_memory(self.dataset, &self.spec.train_spec(&self.spec.rate_job(&variant.name, rate, &held_out))?)?;
        }
        let rate_jobs = self.spec.rate_jobs(&held_out);
        self.run_tasks(&trainings(&shard_jobs(&rate_jobs, self.shard)), should_continue, report)?;
        self.run_tasks(&trainings(&rate_jobs), should_continue, report)?;
        let chosen = self.chosen_rates()?;
        // A rate is missing only if the study was stopped.
        if chosen.len() == self.spec.variants.len() {
            let rate = |name: &str| chosen.get(name).copied().unwrap_or(f64::NAN);
            let jobs = shard_jobs(&self.spec.compared_jobs(&held_out, rate), self.shard);
            // Evaluations that an earlier run did not complete come first.
            let trained: Vec<Job> = jobs.iter().filter(|job| self.has_result(job)).cloned().collect();
            self.run_tasks(&self.evaluations(&trained), should_continue, report)?;
            self.run_tasks(&trainings(&jobs), should_continue, report)?;
            self.run_tasks(&self.evaluations(&jobs), should_continue, report)?;
        }
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
        let held_out = self.spec.held_out(self.dataset);
        let mut chosen = BTreeMap::new();
        for variant in &self.spec.variants {
            let score = |rate: f64| {
                let job = self.spec.rate_job(&variant.name, rate, &held_out);
                let outcome = outcomes.iter().find(|outcome| outcome.job == job)?;
                Some(outcome.validation.as_ref().map_or(0.0, |metrics| metrics.balanced_accuracy))
            };
            let scores: Option<Vec<f64>> = rates.iter().map(|&rate| score(rate)).collect();
            // The first of the best rates is chosen.
            let better = |a: (f64, f64), b: (f64, f64)| if b.1 > a.1 { b } else { a };
            let best = scores.and_then(|scores| rates.iter().copied().zip(scores).reduce(better));
            if let Some((rate, _)) = best {
                chosen.insert(variant.name.clone(), rate);
            }
        }
        Ok(chosen)
    }

    /// All outcomes that exist, in the order of their file names. Earlier versions held out every sequence of a group in turn; outcomes
    /// of sequences other than the first do not count.
    ///
    /// # Errors
    /// [`StudyError::File`] if the folder or a file of it cannot be read, and [`StudyError::DamagedResult`] if a file is not a result, or
    /// is the result of another training than its name says.
    pub fn outcomes(&self) -> Result<Vec<Outcome>, StudyError> {
        let folder = self.folder.join("results");
        let mut paths: Vec<PathBuf> = std::fs::read_dir(&folder)
            .map_err(|e| file(&folder, e))?
            .filter_map(|entry| Some(entry.ok()?.path()))
            .filter(|path| path.extension().is_some_and(|extension| extension == "json"))
            .collect();
        paths.sort();
        let held_out = self.spec.held_out(self.dataset);
        let mut outcomes = paths.iter().map(|path| read_outcome(path)).collect::<Result<Vec<_>, _>>()?;
        outcomes.retain(|outcome| held_out.contains(&outcome.job.held_out));
        Ok(outcomes)
    }

    /// Makes the report on the outcomes that exist.
    ///
    /// # Errors
    /// Those of [`Study::outcomes`].
    pub fn report(&self) -> Result<Report, StudyError> {
        let chosen = self.chosen_rates()?;
        let mut report = report(self.spec, self.dataset, &chosen, &self.outcomes()?);
        // A training at a rate that is not chosen yet has no files.
        let rate = |name: &str| chosen.get(name).copied().unwrap_or(f64::NAN);
        let held_out = self.spec.held_out(self.dataset);
        let mut jobs = self.spec.compared_jobs(&held_out, rate);
        jobs.retain(|job| job.label_fraction == 1.0);
        let condition_report = |condition: &Condition| {
            let scores = |job: &Job| self.condition_scores(job, condition);
            ConditionReport::new(self.spec, &jobs, held_out.len(), condition, &scores)
        };
        report.conditions = self.conditions.iter().map(condition_report).collect();
        Ok(report)
    }

    /// Times of the trainings that are done.
    ///
    /// # Errors
    /// Those of [`Study::outcomes`].
    pub fn times(&self) -> Result<Times, StudyError> {
        Ok(times(self.spec, &self.chosen_rates()?, &self.outcomes()?))
    }

    /// Evaluations under each condition of the models of `jobs`; only trainings on all labels keep models.
    fn evaluations<'j>(&'j self, jobs: &'j [Job]) -> Vec<Task<'j>> {
        let with_models = jobs.iter().filter(|job| job.label_fraction == 1.0);
        let of_job = |job| self.conditions.iter().map(move |condition| Task { job, condition: Some(condition) });
        with_models.flat_map(of_job).collect()
    }

    /// Number of existing scores of the models among `jobs` under the conditions.
    pub(super) fn completed_evaluations(&self, jobs: &[Job]) -> usize {
        self.evaluations(jobs).into_iter().filter(|task| self.is_done(*task)).count()
    }

    /// Runs the tasks that have no result: first those that no other process works on, then those whose process ended
    /// without a result.
    fn run_tasks(
        &self,
        tasks: &[Task],
        should_continue: &dyn Fn() -> bool,
        report: &mut dyn FnMut(Progress),
    ) -> Result<(), StudyError> {
        let mut remaining: Vec<(usize, Task)> = tasks.iter().copied().enumerate().collect();
        loop {
            let mut locked_by_others = Vec::new();
            for (index, task) in remaining {
                if self.is_done(task) {
                    continue;
                }
                if !should_continue() {
                    return Ok(());
                }
                match self.lock(task)? {
                    Some(_lock) => self.run_locked(task, (index + 1, tasks.len()), report)?,
                    None => locked_by_others.push((index, task)),
                }
            }
            if locked_by_others.is_empty() {
                return Ok(());
            }
            remaining = locked_by_others;
            std::thread::sleep(OTHERS_WAIT);
        }
    }

    fn is_done(&self, Task { job, condition }: Task) -> bool {
        match condition {
            None => self.has_result(job),
            Some(condition) => self.condition_scores(job, condition).is_some(),
        }
    }

    pub(super) fn has_result(&self, job: &Job) -> bool {
        self.result_path(job).exists()
    }

    fn result_path(&self, job: &Job) -> PathBuf {
        self.folder.join("results").join(format!("{}.json", name(job)))
    }

    /// Path of the model of a job on all training maps. It is kept for evaluations on other sets.
    fn model_path(&self, job: &Job) -> PathBuf {
        self.folder.join("models").join(format!("{}.safetensors", name(job)))
    }

    fn checkpoint_path(&self, job: &Job) -> PathBuf {
        self.folder.join("checkpoints").join(format!("{}.safetensors", name(job)))
    }

    fn condition_scores_path(&self, task: Task) -> PathBuf {
        self.folder.join("judged").join(format!("{}.json", task.name()))
    }

    /// Scores of a job's model under a condition; `None` if there are none for the present content of its dataset.
    fn condition_scores(&self, job: &Job, condition: &Condition) -> Option<ConditionScores> {
        let path = self.condition_scores_path(Task { job, condition: Some(condition) });
        let scores: ConditionScores = serde_json::from_str(&read_text(&path, TEXT_LIMIT_BYTES).ok()?).ok()?;
        (scores.dataset_hash == condition.hash && scores.job == *job).then_some(scores)
    }

    fn lock_path(&self, task: Task) -> PathBuf {
        self.folder.join("checkpoints").join(format!("{}.lock", task.name()))
    }

    /// Locks a task until the returned file is dropped; `None` if another process works on it.
    fn lock(&self, task: Task) -> Result<Option<File>, StudyError> {
        match lock_file(&self.lock_path(task)) {
            Ok(file) => Ok(Some(file)),
            Err(DatasetError::Busy { .. }) => Ok(None),
            Err(error) => Err(error.into()),
        }
    }

    /// Runs a locked task, unless another process has completed it meanwhile, and writes the result.
    fn run_locked(
        &self,
        task: Task,
        (number, count): (usize, usize),
        report: &mut dyn FnMut(Progress),
    ) -> Result<(), StudyError> {
        let job = task.job;
        if !self.is_done(task) {
            match task.condition {
                None => {
                    report(Progress::Job(job, number, count));
                    let outcome = self.train(job, report)?;
                    write_json(&self.result_path(job), &outcome)?;
                    // The checkpoint is removed only now: a kill before the result is written must not lose the training.
                    let _ = std::fs::remove_file(self.checkpoint_path(job));
                    report(Progress::Done(&outcome));
                    self.evaluate_new_model(job, report)?;
                }
                Some(condition) => {
                    report(Progress::Evaluation(job, &condition.name, number, count));
                    let scores = self.evaluate_under(job, condition)?;
                    write_json(&self.condition_scores_path(task), &scores)?;
                    report(Progress::Evaluated(&scores));
                }
            }
        }
        // A process that opened the file before it was removed finds the result. A file that remains does no harm.
        let _ = std::fs::remove_file(self.lock_path(task));
        Ok(())
    }

    /// Evaluates the model of a job that has just been trained under all conditions, so that a stopped study has all scores of its
    /// trainings.
    fn evaluate_new_model(&self, job: &Job, report: &mut dyn FnMut(Progress)) -> Result<(), StudyError> {
        let tasks = self.evaluations(std::slice::from_ref(job));
        // Trainings that only choose a learning rate are not compared.
        if tasks.is_empty() || self.chosen_rates()?.get(&job.variant) != Some(&job.learning_rate) {
            return Ok(());
        }
        for (index, task) in tasks.iter().enumerate() {
            if let Some(_lock) = self.lock(*task)? {
                self.run_locked(*task, (index + 1, tasks.len()), report)?;
            }
        }
        Ok(())
    }

    /// Evaluates the model of a job on the maps of a condition, with the instruction set that it was trained with.
    fn evaluate_under(&self, job: &Job, condition: &Condition) -> Result<ConditionScores, StudyError> {
        let (path, result) = (self.model_path(job), self.result_path(job));
        let metrics = if path.exists() {
            let splits = self.dataset.splits(&self.spec.train_spec(job)?.split)?;
            let maps = condition.unseen(self.dataset, &splits)?;
            let loaded = Model::load(&path);
            let Model { card, network } =
                loaded.map_err(|source| StudyError::DamagedModel { source: Box::new(source), result })?;
            let network = network.at_level(card.training.kernel_level);
            let mut classifier = Classifier::new(Model { card, network });
            Some(evaluate(&mut classifier, &condition.dataset, &maps)?)
        } else if read_outcome(&result)?.error.is_some() {
            None
        } else {
            return Err(StudyError::NoModel { path, result });
        };
        Ok(ConditionScores {
            job: job.clone(),
            condition: condition.name.clone(),
            dataset_hash: condition.hash.clone(),
            metrics,
        })
    }

    fn train(&self, job: &Job, report: &mut dyn FnMut(Progress)) -> Result<Outcome, StudyError> {
        let spec = self.spec.train_spec(job)?;
        let shape = self.dataset.header().shape;
        let [_, rows, columns] = input_shape(shape.range, shape.doppler, spec.transposed);
        let network = spec.network_spec();
        let mut outcome = Outcome {
            job: job.clone(),
            parameters: network.parameter_count(),
            multiply_adds: network.multiply_adds(rows, columns),
            ..Outcome::default()
        };
        let meter = Meter::start();
        let trained = match self.train_or_restart(job, &spec, report) {
            Ok(trained) => trained,
            // A training that diverges is a result; one that cannot be run is an error.
            Err(error @ TrainError::NonFinite { .. }) => {
                outcome.error = Some(error.to_string());
                return Ok(outcome);
            }
            Err(error) => return Err(error.into()),
        };
        outcome.training_cost = meter.read();
        outcome.training = trained.history.last().map_or(0.0, |epoch| epoch.training_balanced_accuracy);
        outcome.training_seconds = trained.history.iter().map(|epoch| epoch.seconds).sum();
        let reached = |epoch: &EpochReport| epoch.validation_balanced_accuracy >= self.spec.target;
        if let Some(index) = trained.history.iter().position(reached) {
            outcome.epochs_to_target = Some(index + 1);
            outcome.seconds_to_target = Some(trained.history.iter().take(index + 1).map(|epoch| epoch.seconds).sum());
        }
        let chosen = trained.model.card.training.chosen_start;
        outcome.curve = trained.history.into_iter().filter(|epoch| epoch.start == chosen).collect();
        outcome.validation = Some(trained.validation);
        outcome.test = trained.test;
        if job.label_fraction == 1.0 {
            trained.model.save(&self.model_path(job))?;
        }
        let test = Indices::choose(self.dataset, &spec)?.test;
        let mut classifier = Classifier::new(trained.model);
        if job.label_fraction == 1.0 {
            for &snr_db in &self.spec.snr_db {
                let add_noise = |index, map: &mut [f32]| add_noise(map, index, snr_db);
                let metrics = evaluate_changed(&mut classifier, self.dataset, &test, add_noise)?;
                outcome.noisy.push(Noisy { snr_db, metrics });
            }
        }
        (outcome.latency_ms, outcome.label_cost) = self.time_classification(&mut classifier, &test)?;
        Ok(outcome)
    }

    /// Trains a job from its checkpoint, or from the start if that cannot be continued.
    fn train_or_restart(
        &self,
        job: &Job,
        spec: &TrainSpec,
        report: &mut dyn FnMut(Progress),
    ) -> Result<TrainOutcome, TrainError> {
        let checkpoint = self.checkpoint_path(job);
        let mut train = || train_on(&self.maps, spec, Some(&checkpoint), &mut |epoch| report(Progress::Epoch(&epoch)));
        let trained = train();
        let is_unusable = matches!(trained, Err(TrainError::Checkpoint { .. } | TrainError::OtherTraining { .. }));
        if is_unusable && std::fs::remove_file(&checkpoint).is_ok() {
            // The checkpoint may come from a machine with other instructions.
            tracing::warn!("{} cannot be continued: this training begins again", checkpoint.display());
            return train();
        }
        trained
    }

    /// Median time of classifying one map, ms, and its mean cost. A few maps warm up first, then enough are timed for energy
    /// counters.
    fn time_classification(&self, classifier: &mut Classifier, test: &[usize]) -> Result<(f64, Cost), StudyError> {
        let (shape, rows) = (self.dataset.header().shape, self.dataset.rows());
        // Read beforehand, because only the classifier is timed.
        let read = |&index: &usize| Ok::<_, DatasetError>((self.dataset.map(index)?, rows.get(index)));
        let maps = test.iter().take(LEAST_TIMED_MAPS).map(read).collect::<Result<Vec<_>, _>>()?;
        let mut maps = maps.iter().filter_map(|(map, row)| Some((map, (*row)?))).cycle();
        for (map, row) in maps.by_ref().take(WARM_UP_MAPS) {
            classifier.classify_row(map, shape, row)?;
        }
        let (meter, start) = (Meter::start(), Instant::now());
        let mut times = Vec::new();
        for (map, row) in maps {
            let map_start = Instant::now();
            classifier.classify_row(map, shape, row)?;
            times.push(1e3 * map_start.elapsed().as_secs_f64());
            if times.len() >= LEAST_TIMED_MAPS && start.elapsed() >= LEAST_TIMED_DURATION {
                break;
            }
        }
        let cost = meter.read().mean_of(times.len());
        Ok((median(times.into_iter()).unwrap_or_default(), cost))
    }
}

/// Reads a result, and checks that it is of the training that its file is named after.
fn read_outcome(path: &Path) -> Result<Outcome, StudyError> {
    let text = read_text(path, RESULT_LIMIT_BYTES).map_err(|e| file(path, e))?;
    let damaged = |reason: String| StudyError::DamagedResult { path: path.to_owned(), reason };
    let outcome: Outcome = serde_json::from_str(&text).map_err(|e| damaged(format!("it is no result: {e}")))?;
    let job_name = name(&outcome.job);
    if path.file_stem().is_none_or(|stem| stem != job_name.as_str()) {
        return Err(damaged(format!("it holds the result of another training, {job_name}")));
    }
    Ok(outcome)
}

fn write_json(path: &Path, value: &impl Serialize) -> Result<(), StudyError> {
    let text = serde_json::to_string_pretty(value).map_err(|e| file(path, e))?;
    write_file(path, text.as_bytes())
}

fn write_file(path: &Path, bytes: &[u8]) -> Result<(), StudyError> {
    atomic_file::write(path, bytes).map_err(|e| file(path, e))
}

fn file(path: &Path, reason: impl std::fmt::Display) -> StudyError {
    StudyError::File { path: path.to_owned(), reason: reason.to_string() }
}
