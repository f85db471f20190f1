//! Plan of a study: how many trainings there are, how many are done, and how long the others take.

use std::collections::{BTreeMap, BTreeSet};

use serde::Serialize;

use super::error::StudyError;
use super::jobs::name;
use super::outcome::Job;
use super::run::Study;
use crate::train::{Indices, StepTimes, time_steps};

/// Trainings of one network of a study.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PlannedNetwork {
    /// Name of the variant.
    pub variant: String,
    /// Trainings in all, those that only choose learning rates included.
    pub trainings: usize,
    /// Number of them that are done.
    pub done: usize,
    /// Number of steps of the remaining trainings.
    pub steps: usize,
    /// Measured time of a step, s; absent where all trainings are done.
    pub step_seconds: Option<f64>,
    /// Time of the remaining trainings on this machine, hours.
    pub hours: f64,
}

/// Trainings of a study.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Plan {
    /// Trainings in all, those that only choose learning rates included.
    pub trainings: usize,
    /// Number of them that are done.
    pub done: usize,
    /// Threads of a training.
    pub threads: usize,
    /// Time of the remaining trainings, one after the other on this machine, hours.
    pub hours: f64,
    /// Product of `hours` and the number of threads, hours.
    pub cpu_hours: f64,
    /// Number of remaining evaluations of models under conditions. Their time is not in the hours.
    pub judgings_left: usize,
    /// Trainings of each variant.
    pub networks: Vec<PlannedNetwork>,
}

impl Study<'_> {
    /// Counts the trainings of all shards, and times a few steps of each network with remaining trainings. `report` gets
    /// the name of each network before it is timed. `conditions` is the number of the study's conditions, including
    /// those whose datasets are not built yet.
    ///
    /// Times are those of steps, of fitting the head and of the validation after each epoch. They exclude reading maps and computing
    /// the scores at the end.
    ///
    /// # Errors
    /// [`StudyError`] if the results cannot be read, or a network cannot be trained on the dataset.
    pub fn plan(&self, conditions: usize, report: &mut dyn FnMut(&str)) -> Result<Plan, StudyError> {
        let held_out = self.spec.held_out(self.dataset);
        let (rates, chosen) = (self.spec.rates(), self.chosen_rates()?);
        // For any chosen rate, one of the compared trainings is also a training that chooses rates.
        let rate = |name: &str| chosen.get(name).or(rates.first()).copied().unwrap_or_default();
        let compared = self.spec.compared_jobs(&held_out, rate);
        let models = compared.iter().filter(|job| job.label_fraction == 1.0).count();
        let judgings_left = (conditions * models).saturating_sub(self.completed_evaluations(&compared));
        let mut jobs = self.spec.rate_jobs(&held_out);
        jobs.extend(compared);
        let mut seen = BTreeSet::new();
        jobs.retain(|job| seen.insert(name(job)));

        let mut sizes = BTreeMap::new();
        let mut networks = Vec::new();
        for variant in &self.spec.variants {
            let jobs: Vec<&Job> = jobs.iter().filter(|job| job.variant == variant.name).collect();
            let remaining: Vec<&Job> = jobs.iter().copied().filter(|job| !self.has_result(job)).collect();
            let (mut steps, mut validation_maps) = (0, 0);
            for job in &remaining {
                let (job_steps, job_maps) = self.size(job, &mut sizes)?;
                steps += job_steps;
                validation_maps += job_maps;
            }
            // The largest of them has a full batch to time.
            let largest = remaining.iter().max_by(|a, b| a.label_fraction.total_cmp(&b.label_fraction));
            let times = match largest {
                Some(job) => {
                    report(&variant.name);
                    Some(time_steps(&self.maps, &self.spec.train_spec(job)?)?)
                }
                None => None,
            };
            let seconds = times.map_or(0.0, |StepTimes { head_s, step_s, validation_map_s }| {
                remaining.len() as f64 * head_s + steps as f64 * step_s + validation_maps as f64 * validation_map_s
            });
            networks.push(PlannedNetwork {
                variant: variant.name.clone(),
                trainings: jobs.len(),
                done: jobs.len() - remaining.len(),
                steps,
                step_seconds: times.map(|times| times.step_s),
                hours: seconds / 3600.0,
            });
        }
        let threads = rayon::current_num_threads();
        let hours: f64 = networks.iter().map(|network| network.hours).sum();
        Ok(Plan {
            trainings: jobs.len(),
            done: networks.iter().map(|network| network.done).sum(),
            threads,
            hours,
            cpu_hours: hours * threads as f64,
            judgings_left,
            networks,
        })
    }

    /// Number of steps of a job, and number of maps that it validates on over all epochs. `sizes` caches the number of
    /// maps of earlier jobs.
    fn size(&self, job: &Job, sizes: &mut Sizes) -> Result<(usize, usize), StudyError> {
        let spec = self.spec.train_spec(job)?;
        let key = (job.held_out.clone(), job.label_fraction.to_bits());
        let [training, validation] = match sizes.get(&key) {
            Some(&size) => size,
            None => {
                let Indices { train, validation, .. } = Indices::choose(self.dataset, &spec)?;
                let size = [train.len(), validation.len()];
                sizes.insert(key, size);
                size
            }
        };
        let epochs = spec.all_epochs();
        Ok((epochs * training.div_ceil(spec.batch_size.max(1)), epochs * validation))
    }
}

/// Numbers of training and validation maps, by the held-out recording and the share of the maps, which determine both.
type Sizes = BTreeMap<(Option<String>, u64), [usize; 2]>;
