//! Scores by training, and differences between networks under the same seeds.

use serde::{Deserialize, Serialize};

use super::outcome::Job;
use crate::interval::{Interval, t_interval};

/// Score of the model of one training.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Score {
    /// Seed of the training.
    pub seed: u64,
    /// Recording that was its test split, in studies that hold out each in turn.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub held_out: Option<String>,
    /// Balanced accuracy; chance where the training broke off.
    pub balanced_accuracy: f64,
}

impl Score {
    pub(super) fn new(job: &Job, balanced_accuracy: f64) -> Self {
        Score { seed: job.seed, held_out: job.held_out.clone(), balanced_accuracy }
    }

    /// Score in `others` of the training with the same seed and the same recording held out.
    fn partner<'a>(&self, others: &'a [Score]) -> Option<&'a Score> {
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
    let difference = |a: &Score| Some(a.balanced_accuracy - a.partner(b)?.balanced_accuracy);
    let differences: Vec<f64> = a.iter().filter_map(difference).collect();
    t_interval(&differences)
}

/// Mean over sets of the scores of each training that has one on every set.
pub fn mean_scores(sets: &[&[Score]]) -> Vec<Score> {
    let Some((first, _)) = sets.split_first() else { return Vec::new() };
    let mean = |score: &Score| {
        let values: Option<Vec<f64>> = sets.iter().map(|set| Some(score.partner(set)?.balanced_accuracy)).collect();
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

    /// What all networks find hard under one seed is no difference between them.
    #[test]
    fn what_pairs_share_does_not_widen_the_interval() {
        let a = [score(1, None, 0.50), score(2, None, 0.70), score(3, None, 0.90)];
        let b = [score(3, None, 0.88), score(1, None, 0.48), score(2, None, 0.68)];
        let found = paired_difference(&a, &b).expect("pairs");
        assert!((found.mean - 0.02).abs() < 1e-12 && found.half_width.is_some_and(|half| half < 1e-12), "{found:?}");
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn trainings_without_a_partner_are_no_pair() {
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
