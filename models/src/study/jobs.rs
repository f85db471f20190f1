//! Jobs of a study, in the order in which they are run, and the part of them that a shard runs.

use std::collections::BTreeSet;

use sha2::{Digest, Sha256};

use super::outcome::Job;
use super::spec::StudySpec;
use crate::dataset::Dataset;

impl StudySpec {
    /// Recordings that are held out in turn, or a single `None`. There is one for each group of the split, because the rest of the
    /// group is held out with it.
    pub(super) fn held_out(&self, dataset: &Dataset) -> Vec<Option<String>> {
        if !self.leave_one_recording_out {
            return vec![None];
        }
        let names = self.train.split.first_sequences(dataset.rows());
        names.into_iter().map(|name| Some(name.to_owned())).collect()
    }

    /// The job that tries a learning rate.
    pub(super) fn rate_job(&self, variant: &str, learning_rate: f64, held_out: &[Option<String>]) -> Job {
        Job {
            variant: variant.to_owned(),
            label_fraction: 1.0,
            learning_rate,
            seed: self.seeds.first().copied().unwrap_or_default(),
            held_out: held_out.first().cloned().flatten(),
        }
    }

    /// Jobs that learning rates are chosen by; none where there is one rate only.
    pub(super) fn rate_jobs(&self, held_out: &[Option<String>]) -> Vec<Job> {
        let rates = self.rates();
        if rates.len() < 2 {
            return Vec::new();
        }
        let variant_jobs =
            |name: &str| rates.iter().map(|&rate| self.rate_job(name, rate, held_out)).collect::<Vec<_>>();
        self.variants.iter().flat_map(|variant| variant_jobs(&variant.name)).collect()
    }

    /// Jobs that are compared. `rate` gives the learning rate of a variant.
    pub(super) fn compared_jobs(&self, held_out: &[Option<String>], rate: impl Fn(&str) -> f64) -> Vec<Job> {
        let mut jobs = Vec::new();
        // Seed by seed, so that early results are a complete comparison over few seeds.
        for &seed in &self.seeds {
            for &label_fraction in &self.label_fractions {
                for variant in &self.variants {
                    jobs.extend(held_out.iter().map(|held_out| Job {
                        variant: variant.name.clone(),
                        label_fraction,
                        learning_rate: rate(&variant.name),
                        seed,
                        held_out: held_out.clone(),
                    }));
                }
            }
        }
        jobs
    }
}

/// Jobs of shard `index` of `count`, in their order. Trainings of one network on one share of the maps are distributed
/// one by one, so that all shards take about the same time.
pub(super) fn shard_jobs(jobs: &[Job], (index, count): (usize, usize)) -> Vec<Job> {
    let mut sorted: Vec<&Job> = jobs.iter().collect();
    sorted.sort_by(|a, b| a.variant.cmp(&b.variant).then(b.label_fraction.total_cmp(&a.label_fraction)));
    let names: BTreeSet<String> = sorted.into_iter().skip(index).step_by(count.max(1)).map(name).collect();
    jobs.iter().filter(|job| names.contains(&name(job))).cloned().collect()
}

/// A job's name in files.
pub(super) fn name(job: &Job) -> String {
    let held_out = job.held_out.as_ref().map_or_else(String::new, |sequence| {
        let hash = Sha256::digest(sequence.as_bytes());
        format!("-without-{:02x}{:02x}{:02x}{:02x}", hash[0], hash[1], hash[2], hash[3])
    });
    format!("{}-{}-{}-{}{held_out}", job.variant, job.label_fraction, job.learning_rate, job.seed)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn study(variants: &[&str], seeds: u64, label_fractions: &[f64]) -> StudySpec {
        let variants: Vec<_> = variants.iter().map(|name| serde_json::json!({ "name": name })).collect();
        let seeds: Vec<u64> = (0..seeds).collect();
        let spec = serde_json::json!({
            "title": "Small", "variants": variants, "seeds": seeds, "label_fractions": label_fractions
        });
        serde_json::from_value(spec).expect("a spec")
    }

    /// Every job is in one shard, and the shards' numbers of jobs of a large network differ by one at most.
    #[test]
    fn shards_share_the_jobs_of_each_network() {
        let spec = study(&["hqnn", "resnet18", "doppler_net"], 5, &[1.0, 0.3]);
        let jobs = spec.compared_jobs(&[None], |_| 1e-3);
        assert_eq!(jobs.len(), 30);
        for count in [1, 2, 3, 4, 7, 40] {
            let shards: Vec<Vec<Job>> = (0..count).map(|index| shard_jobs(&jobs, (index, count))).collect();
            let mut all: Vec<String> = shards.iter().flatten().map(name).collect();
            all.sort();
            let mut expected: Vec<String> = jobs.iter().map(name).collect();
            expected.sort();
            assert_eq!(all, expected, "{count} shards");
            let large = |jobs: &Vec<Job>| jobs.iter().filter(|job| job.variant == "resnet18").count();
            let counts: Vec<usize> = shards.iter().map(large).collect();
            let (most, least) = (counts.iter().max().copied(), counts.iter().min().copied());
            assert!(most.unwrap_or_default() <= least.unwrap_or_default() + 1, "{count} shards: {counts:?}");
        }
    }

    #[test]
    fn one_rate_is_not_chosen() {
        let mut spec = study(&["hqnn"], 2, &[1.0]);
        assert!(spec.rate_jobs(&[None]).is_empty());
        spec.learning_rates = vec![1e-3, 1e-2];
        let jobs = spec.rate_jobs(&[None]);
        assert_eq!(jobs.len(), 2);
        // The training at the chosen rate is one of those that are compared.
        assert!(spec.compared_jobs(&[None], |_| 1e-2).contains(&jobs[1]));
    }
}
