//! Scores by seed, and differences between networks under the same seeds.

use serde::{Deserialize, Serialize};

use crate::interval::{Interval, t_interval};
use crate::metrics::{CHANCE, Confusion, Metrics, add_confusion};

/// Score of the model of one training, or of all trainings of a seed in studies that hold out each recording in turn.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Score {
    /// Seed of the training.
    pub seed: u64,
    /// Recording that was its test split, if the score is of one recording. Reports pool the recordings of a seed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub held_out: Option<String>,
    /// Balanced accuracy; chance where the training broke off.
    pub balanced_accuracy: f64,
}

/// Scores of a seed on a set of maps; `None` if a training broke off.
pub(super) struct SeedMetrics {
    seed: u64,
    pub metrics: Option<Metrics>,
}

impl SeedMetrics {
    /// Balanced accuracy; chance where a training broke off.
    pub(super) fn score(&self) -> Score {
        let balanced_accuracy = self.metrics.as_ref().map_or(CHANCE, |metrics| metrics.balanced_accuracy);
        Score { seed: self.seed, held_out: None, balanced_accuracy }
    }
}

/// Scores of each seed with `trainings` trainings: one for each recording that is held out in turn, otherwise one. Their confusions
/// are added before scores are computed, because a recording of one class has no balanced accuracy. Seeds with unfinished trainings
/// are left out.
pub(super) fn seed_metrics<'a>(
    scores: impl IntoIterator<Item = (u64, Option<&'a Metrics>)>,
    trainings: usize,
) -> Vec<SeedMetrics> {
    let complete = by_seed(scores).into_iter().filter(|(_, metrics)| metrics.len() == trainings);
    complete.map(|(seed, metrics)| SeedMetrics { seed, metrics: pooled(&metrics) }).collect()
}

/// Metrics of the summed confusions; `None` if one is missing.
fn pooled(trainings: &[Option<&Metrics>]) -> Option<Metrics> {
    if let [one] = trainings {
        return one.cloned();
    }
    let mut confusion = Confusion::default();
    for metrics in trainings {
        add_confusion(&mut confusion, &(*metrics)?.confusion);
    }
    Some(Metrics::from_confusion(confusion))
}

/// Mean over seeds, with its interval, of the mean over each seed's trainings.
pub(super) fn over_seeds(values: impl IntoIterator<Item = (u64, f64)>) -> Option<Interval> {
    let means = by_seed(values).into_iter().map(|(_, values)| values.iter().sum::<f64>() / values.len() as f64);
    t_interval(&means.collect::<Vec<f64>>())
}

/// Values of each seed, in their order.
fn by_seed<T>(values: impl IntoIterator<Item = (u64, T)>) -> Vec<(u64, Vec<T>)> {
    let mut groups: Vec<(u64, Vec<T>)> = Vec::new();
    for (seed, value) in values {
        match groups.iter_mut().find(|(known, _)| *known == seed) {
            Some((_, group)) => group.push(value),
            None => groups.push((seed, vec![value])),
        }
    }
    groups
}

impl Score {
    /// Score in `others` of the training with the same seed and the same recording held out.
    fn paired_with<'a>(&self, others: &'a [Score]) -> Option<&'a Score> {
        others.iter().find(|other| other.seed == self.seed && other.held_out == self.held_out)
    }
}

/// Mean of `a` less `b` over pairs of trainings with the same seed and the same recording held out, and its 95 % interval; `None`
/// without a pair.
///
/// # Examples
/// ```
/// use radome_models::study::{Score, paired_difference};
///
/// let scores = |values: [f64; 3]| -> Vec<Score> {
///     let score = |(balanced_accuracy, seed)| Score { seed, held_out: None, balanced_accuracy };
///     values.into_iter().zip([11, 22, 33]).map(score).collect()
/// };
/// let difference = paired_difference(&scores([0.75, 0.50, 1.00]), &scores([0.50, 0.25, 0.75])).expect("pairs");
/// assert_eq!((difference.count, difference.mean, difference.half_width), (3, 0.25, Some(0.0)));
/// ```
pub fn paired_difference(a: &[Score], b: &[Score]) -> Option<Interval> {
    let difference = |a: &Score| Some(a.balanced_accuracy - a.paired_with(b)?.balanced_accuracy);
    let differences: Vec<f64> = a.iter().filter_map(difference).collect();
    t_interval(&differences)
}

/// Mean over sets of the scores of each training that has one on every set.
pub fn mean_scores(sets: &[&[Score]]) -> Vec<Score> {
    let Some((first, _)) = sets.split_first() else { return Vec::new() };
    let mean = |score: &Score| {
        let values: Option<Vec<f64>> = sets.iter().map(|set| Some(score.paired_with(set)?.balanced_accuracy)).collect();
        let balanced_accuracy = values?.iter().sum::<f64>() / sets.len() as f64;
        Some(Score { balanced_accuracy, ..score.clone() })
    };
    first.iter().filter_map(mean).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn score(seed: u64, held_out: Option<&str>, balanced_accuracy: f64) -> Score {
        Score { seed, held_out: held_out.map(str::to_owned), balanced_accuracy }
    }

    /// Differences between seeds that both networks share do not widen the interval of their difference.
    #[test]
    fn common_differences_between_seeds_do_not_widen_the_interval() {
        let a = [score(1, None, 0.50), score(2, None, 0.70), score(3, None, 0.90)];
        let b = [score(3, None, 0.88), score(1, None, 0.48), score(2, None, 0.68)];
        let found = paired_difference(&a, &b).expect("pairs");
        assert!((found.mean - 0.02).abs() < 1e-12 && found.half_width.is_some_and(|half| half < 1e-12), "{found:?}");
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn only_trainings_with_a_counterpart_are_pairs() {
            let a = [score(1, Some("x"), 0.5), score(1, Some("y"), 0.7), score(2, None, 0.9)];
            let b = [score(1, Some("y"), 0.6), score(3, None, 0.1)];
            assert_eq!(paired_difference(&a, &b).map(|found| (found.count, found.half_width)), Some((1, None)));
            assert_eq!(paired_difference(&a, &[]), None);
        }

        #[test]
        fn a_training_that_lacks_a_set_has_no_mean() {
            let (a, b) = ([score(1, None, 0.5), score(2, None, 0.7)], [score(2, None, 0.9)]);
            let means = mean_scores(&[&a, &b]);
            assert!(means.len() == 1 && means[0].seed == 2, "{means:?}");
            assert!((means[0].balanced_accuracy - 0.8).abs() < 1e-12, "{means:?}");
            assert!(mean_scores(&[]).is_empty());
        }
    }
}
