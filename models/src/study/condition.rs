//! Conditions of a study: other sets of maps on which its trained models are evaluated.

use std::collections::BTreeSet;

use serde::{Deserialize, Serialize};

use super::error::{StudyError, check_setting};
use super::outcome::Job;
use super::score::{Score, SeedMetrics, seed_metrics};
use super::spec::StudySpec;
use crate::dataset::{Dataset, Split};
use crate::interval::{Interval, t_interval};
use crate::metrics::{CHANCE, Confusion, Metrics, add_confusion};

/// Longest name of a condition or of its group, in characters: names are headings of tables, and parts of file names.
const LONGEST_NAME: usize = 100;

/// Set of maps on which the models of a study are evaluated. No model is trained on it.
#[derive(Debug, Clone)]
pub struct Condition {
    pub(super) name: String,
    group: Option<String>,
    pub(super) dataset: Dataset,
    /// Hash of the dataset.
    pub(super) hash: String,
    pub(super) file_name: String,
}

impl Condition {
    /// Makes a condition of a dataset. `group` is the heading of its table in the report; conditions without one share a table.
    ///
    /// # Errors
    /// Those of [`condition_file_name`], for either name.
    pub fn new(name: &str, group: Option<&str>, dataset: Dataset) -> Result<Self, StudyError> {
        group.map_or(Ok(()), |group| check_name("group of a condition", group))?;
        Ok(Condition {
            name: name.to_owned(),
            group: group.map(str::to_owned),
            hash: dataset.hash(),
            dataset,
            file_name: condition_file_name(name)?,
        })
    }

    /// Indices of the maps on which a model is evaluated: all except those of sequences that the training used, for
    /// training or for validation. `splits` are those of the training, one for each map of the study's dataset.
    ///
    /// # Errors
    /// [`StudyError::NothingUnseen`] if no map is left.
    pub(super) fn unseen(&self, study: &Dataset, splits: &[Split]) -> Result<Vec<usize>, StudyError> {
        let rows = study.rows().iter().zip(splits);
        let seen: BTreeSet<&str> =
            rows.filter(|(_, split)| **split != Split::Test).map(|(row, _)| row.sequence.as_str()).collect();
        let rows = self.dataset.rows().iter().enumerate();
        let unseen: Vec<usize> =
            rows.filter(|(_, row)| !seen.contains(row.sequence.as_str())).map(|(index, _)| index).collect();
        if unseen.is_empty() {
            return Err(StudyError::NothingUnseen { condition: self.name.clone() });
        }
        Ok(unseen)
    }
}

/// Name of a condition in files: letters, digits, `-` and `+` stay, anything else becomes `_`.
///
/// # Errors
/// [`StudyError::Setting`] if the name has no letter or digit of ASCII, is longer than 100 characters, or has a character that a
/// table of the report cannot hold.
pub fn condition_file_name(name: &str) -> Result<String, StudyError> {
    check_name("name of a condition", name)?;
    Ok(name.chars().map(|c| if c.is_ascii_alphanumeric() || c == '-' || c == '+' { c } else { '_' }).collect())
}

fn check_name(what: &str, name: &str) -> Result<(), StudyError> {
    let is_plain = !name.chars().any(|c| c.is_control() || c == '|');
    let has_letter = name.chars().any(|c| c.is_ascii_alphanumeric());
    let is_short = name.chars().count() <= LONGEST_NAME;
    let expected = format!("a letter or digit, no '|', and {LONGEST_NAME} characters at most");
    check_setting(is_plain && has_letter && is_short, what, format!("{name:?}"), expected)
}

/// Checks that the models of a study can be evaluated under conditions.
///
/// # Errors
/// [`StudyError::Setting`] if two conditions have one name in files, or if the study trains no model on all labels, and
/// [`StudyError::Maps`] if the maps of one are of another kind than the study's.
pub(super) fn check(spec: &StudySpec, study: &Dataset, conditions: &[Condition]) -> Result<(), StudyError> {
    if !conditions.is_empty() {
        spec.check_models()?;
    }
    let mut names = BTreeSet::new();
    for condition in conditions {
        let is_new = names.insert(condition.file_name.to_ascii_lowercase());
        let expected = "names that differ in letters and digits, '-' and '+'";
        check_setting(is_new, "name of a condition", format!("'{}', like another", condition.name), expected)?;
        let (expected, got) = (study.header(), condition.dataset.header());
        let mismatch = |what: String| Err(StudyError::Maps { condition: condition.name.clone(), what });
        if got.shape != expected.shape {
            return mismatch(format!("its maps are {}, the study's are {}", got.shape, expected.shape));
        }
        if got.rdm_spec != expected.rdm_spec {
            return mismatch("its maps were made by another map spec than the study's".to_owned());
        }
        if let Err(error) = expected.rdm_spec.check_compatible(&got.waveform, &expected.waveform) {
            return mismatch(error.to_string());
        }
    }
    Ok(())
}

/// Scores of one trained model under one condition.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ConditionScores {
    /// The training.
    pub job: Job,
    /// Name of the condition.
    pub condition: String,
    /// Hash of the condition's dataset. If it changes, the models are evaluated again.
    pub dataset_hash: String,
    /// Scores; absent where the training broke off and left no model.
    pub metrics: Option<Metrics>,
}

/// Scores of all networks under one condition.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ConditionReport {
    /// Name of the condition.
    pub name: String,
    /// Heading of its table.
    pub group: Option<String>,
    /// Hash of its dataset.
    pub dataset_hash: String,
    /// Largest number of maps on which a model was evaluated. Test splits of studies that hold out each recording
    /// differ.
    pub maps: usize,
    /// Number of models that were evaluated, trainings that broke off included.
    pub done: usize,
    /// Number of trainings on all labels.
    pub planned: usize,
    /// Scores of the networks, one for each variant.
    pub cells: Vec<ConditionCell>,
}

/// Scores of one network under one condition.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ConditionCell {
    /// Name of the variant.
    pub variant: String,
    /// Number of its models that were evaluated, trainings that broke off included.
    pub done: usize,
    /// Balanced accuracy; chance where a training broke off.
    pub balanced_accuracy: Option<Interval>,
    /// Balanced accuracy of each training, or of each seed if the study holds out each recording in turn.
    #[serde(default)]
    pub scores: Vec<Score>,
    /// Accuracy; chance where a training broke off.
    pub accuracy: Option<Interval>,
    /// `confusion[truth][prediction]`, summed over models.
    pub confusion: Confusion,
}

impl ConditionReport {
    /// Makes the report of one condition. `jobs` are the trainings on all labels, of which each seed has `trainings`, and
    /// `scores_of` reads the scores of one, if they exist.
    pub(super) fn new(
        spec: &StudySpec,
        jobs: &[Job],
        trainings: usize,
        condition: &Condition,
        scores_of: &dyn Fn(&Job) -> Option<ConditionScores>,
    ) -> Self {
        let mut maps = 0;
        let mut cells = Vec::new();
        for variant in &spec.variants {
            let of_variant = jobs.iter().filter(|job| job.variant == variant.name);
            let by_model: Vec<ConditionScores> = of_variant.filter_map(scores_of).collect();
            let metrics = by_model.iter().map(|scores| (scores.job.seed, scores.metrics.as_ref()));
            let by_seed = seed_metrics(metrics, trainings);
            let interval = |score: &dyn Fn(&Metrics) -> f64| {
                let values = by_seed.iter().map(|seed| seed.metrics.as_ref().map_or(CHANCE, score));
                t_interval(&values.collect::<Vec<f64>>())
            };
            let mut confusion = Confusion::default();
            for metrics in by_model.iter().filter_map(|scores| scores.metrics.as_ref()) {
                maps = maps.max(metrics.samples);
                add_confusion(&mut confusion, &metrics.confusion);
            }
            cells.push(ConditionCell {
                variant: variant.name.clone(),
                done: by_model.len(),
                balanced_accuracy: interval(&|metrics| metrics.balanced_accuracy),
                scores: by_seed.iter().map(SeedMetrics::score).collect(),
                accuracy: interval(&|metrics| metrics.accuracy),
                confusion,
            });
        }
        ConditionReport {
            name: condition.name.clone(),
            group: condition.group.clone(),
            dataset_hash: condition.hash.clone(),
            maps,
            done: cells.iter().map(|cell| cell.done).sum(),
            planned: jobs.len(),
            cells,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_in_files_keep_signs() {
        let name = |name: &str| condition_file_name(name).expect("a name");
        assert_eq!(name("thermal noise +10 dB"), "thermal_noise_+10_dB");
        assert_eq!(name("thermal noise -10 dB"), "thermal_noise_-10_dB");
        assert_eq!(name("../gait.parts"), "___gait_parts");
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn invalid_names_are_errors() {
            for name in ["", " ", "..", "a|b", "a\nb", &"a".repeat(101)] {
                let error = condition_file_name(name).expect_err(name).to_string();
                assert!(error.contains("name of a condition") && error.contains("100 characters"), "{error}");
            }
        }
    }
}
