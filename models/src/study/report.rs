//! Report of a study: tables in Markdown and JSON, with the paper's numbers for comparison.

use std::collections::BTreeMap;
use std::fmt::Write;

use radome_dsp::Occupancy;
use serde::{Deserialize, Serialize};

use super::condition::ConditionReport;
use super::outcome::{FAILED_BELOW, Job, Outcome};
use super::score::{Score, SeedMetrics, over_seeds, seed_metrics};
use super::spec::StudySpec;
use crate::dataset::{Dataset, SplitBy};
use crate::interval::{Interval, median, t_interval};
use crate::metrics::{CHANCE, Confusion, Metrics, add_confusion};
use crate::train::EpochReport;

/// One variant trained on one share of the maps.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Cell {
    /// Name of the variant.
    pub variant: String,
    /// Share of the training maps.
    pub label_fraction: f64,
    /// Learning rate, chosen on the validation split where there was a choice.
    pub learning_rate: f64,
    /// Number of trainings that are done.
    pub done: usize,
    /// Number of them that failed; they stay in the means.
    pub failed: usize,
    /// Balanced accuracy on the test split; chance where a training broke off.
    pub test: Option<Interval>,
    /// Balanced accuracy on the test split by training, or by seed if the study holds out each recording in turn.
    #[serde(default)]
    pub scores: Vec<Score>,
    /// Accuracy on the test split.
    pub accuracy: Option<Interval>,
    /// Macro-F1 on the test split.
    pub macro_f1: Option<Interval>,
    /// Share of populated test maps that are not classified as empty.
    pub populated_recall: Option<Interval>,
    /// Balanced accuracy on the training maps in the last epoch.
    pub training: Option<Interval>,
    /// Balanced accuracy on the validation split.
    pub validation: Option<Interval>,
    /// Confusion on the test split, summed over trainings.
    pub confusion: Confusion,
    /// Balanced accuracy under noise, by signal-to-noise ratio.
    pub noisy: Vec<(f64, Option<Interval>)>,
    /// Means over seeds by epoch.
    #[serde(default)]
    pub curve: Vec<CurvePoint>,
    /// Trainings that reached the target on the validation split.
    pub reached_target: usize,
    /// Median number of epochs until the target was reached.
    pub epochs_to_target: Option<f64>,
    /// Number of trained parameters.
    pub parameters: usize,
    /// Multiply-adds of one map.
    pub multiply_adds: u64,
}

impl Cell {
    /// Number of seeds with a score; of trainings, in studies without a test split and in old reports.
    fn seeds(&self) -> usize {
        if self.scores.is_empty() { self.done } else { self.scores.len() }
    }
}

/// One epoch of a variant's trainings, each by the initialisation that was chosen.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CurvePoint {
    /// Epoch, from 1.
    pub epoch: usize,
    /// Balanced accuracy on the training maps over the epoch, measured batch by batch.
    pub training: Option<Interval>,
    /// Balanced accuracy on the validation split after the epoch.
    pub validation: Option<Interval>,
    /// Mean loss on the training maps.
    pub training_loss: Option<Interval>,
    /// Loss on the validation split.
    pub validation_loss: Option<Interval>,
}

/// Training that failed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Failure {
    /// The training.
    pub job: Job,
    /// Cause, or how little it learnt.
    pub reason: String,
}

/// Results of a study. They do not depend on how the trainings were spread and interrupted. [`Times`](super::Times) has
/// the values that differ from run to run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Report {
    /// Heading.
    pub title: String,
    /// Differences from the protocol that it is compared with.
    pub remarks: Vec<String>,
    /// Hash of the dataset.
    pub dataset_hash: String,
    /// Maps of the dataset.
    pub maps: usize,
    /// Number of trainings that are done.
    pub done: usize,
    /// Trainings of the plan, less those that only choose learning rates.
    pub planned: usize,
    /// Target of balanced accuracy: the report gives the first epoch that reaches it.
    pub target: f64,
    /// Results, one for each variant and label fraction.
    pub cells: Vec<Cell>,
    /// All trainings that failed, those that learning rates were chosen by included.
    #[serde(default)]
    pub failures: Vec<Failure>,
    /// Scores of the models of all labels on other sets, one for each condition.
    #[serde(default)]
    pub conditions: Vec<ConditionReport>,
}

/// Outcomes of one variant on one share of the maps.
pub(super) struct Group<'a> {
    pub variant: &'a str,
    pub label_fraction: f64,
    pub learning_rate: f64,
    pub outcomes: Vec<&'a Outcome>,
}

/// Outcomes at the chosen learning rates, in the order of the report.
pub(super) fn groups<'a>(
    spec: &'a StudySpec,
    chosen: &BTreeMap<String, f64>,
    outcomes: &'a [Outcome],
) -> Vec<Group<'a>> {
    let mut groups = Vec::new();
    for variant in &spec.variants {
        for &label_fraction in &spec.label_fractions {
            let learning_rate = chosen.get(&variant.name).copied().unwrap_or(f64::NAN);
            let is_of_group = |outcome: &&Outcome| {
                let job = &outcome.job;
                let is_ours = job.variant == variant.name && job.label_fraction == label_fraction;
                is_ours && job.learning_rate == learning_rate && spec.seeds.contains(&job.seed)
            };
            let outcomes = outcomes.iter().filter(is_of_group).collect();
            groups.push(Group { variant: &variant.name, label_fraction, learning_rate, outcomes });
        }
    }
    groups
}

/// Makes the report of outcomes, without conditions.
pub fn report(spec: &StudySpec, dataset: &Dataset, chosen: &BTreeMap<String, f64>, outcomes: &[Outcome]) -> Report {
    let trainings = spec.held_out(dataset).len();
    let cells: Vec<Cell> = groups(spec, chosen, outcomes).iter().map(|group| cell(spec, group, trainings)).collect();
    let pooling = spec.leave_one_recording_out.then(|| pooling_remark(spec.train.split.by));
    Report {
        title: spec.title.clone(),
        remarks: spec.remarks.iter().cloned().chain(pooling).collect(),
        dataset_hash: dataset.hash(),
        maps: dataset.rows().len(),
        done: cells.iter().map(|cell| cell.done).sum(),
        planned: cells.len() * spec.seeds.len() * trainings,
        target: spec.target,
        cells,
        failures: outcomes.iter().filter_map(failure).collect(),
        conditions: Vec::new(),
    }
}

fn failure(outcome: &Outcome) -> Option<Failure> {
    let reason = match &outcome.error {
        Some(error) => error.lines().next().unwrap_or_default().to_owned(),
        None if outcome.failed() => {
            format!("balanced accuracy {:.3} on its own training maps at the end", outcome.training)
        }
        None => return None,
    };
    Some(Failure { job: outcome.job.clone(), reason })
}

/// Remark on studies that hold out each recording, or each group of a split, in turn.
fn pooling_remark(by: SplitBy) -> String {
    let each = match by {
        SplitBy::Sequence => "Each recording".to_owned(),
        by => format!("Each group of recordings of one {by}"),
    };
    format!(
        "{each} in turn is the test split. Test scores are computed once for each seed, from the predictions on all recordings \
         together; those of training and validation are means over the trainings of a seed."
    )
}

/// Test scores of each seed. `metrics` are those of an outcome; trainings that broke off have none.
fn test_scores<'a>(
    outcomes: &[&'a Outcome],
    trainings: usize,
    metrics: impl Fn(&'a Outcome) -> Option<&'a Metrics>,
) -> Vec<SeedMetrics> {
    let with_metrics = outcomes.iter().map(|&outcome| (outcome, metrics(outcome)));
    let counted = with_metrics.filter(|(outcome, metrics)| outcome.error.is_some() || metrics.is_some());
    seed_metrics(counted.map(|(outcome, metrics)| (outcome.job.seed, metrics)), trainings)
}

/// Results of one group, with this number of trainings for each seed.
fn cell(spec: &StudySpec, group: &Group, trainings: usize) -> Cell {
    let Group { variant, label_fraction, learning_rate, outcomes } = group;
    let (label_fraction, learning_rate) = (*label_fraction, *learning_rate);
    let interval = |value: &dyn Fn(&Outcome) -> Option<f64>| {
        over_seeds(outcomes.iter().filter_map(|outcome| Some((outcome.job.seed, value(outcome)?))))
    };
    let scores = test_scores(outcomes, trainings, |outcome| outcome.test.as_ref());
    let test = |value: &dyn Fn(&Metrics) -> Option<f64>, if_broken_off: Option<f64>| {
        let values = scores.iter().filter_map(|seed| seed.metrics.as_ref().map_or(if_broken_off, value));
        t_interval(&values.collect::<Vec<f64>>())
    };
    let mut confusion = Confusion::default();
    for metrics in outcomes.iter().filter_map(|outcome| outcome.test.as_ref()) {
        add_confusion(&mut confusion, &metrics.confusion);
    }
    let under_noise = |snr_db: f64| {
        let scores = test_scores(outcomes, trainings, |outcome| {
            outcome.noisy.iter().find(|noisy| noisy.snr_db == snr_db).map(|noisy| &noisy.metrics)
        });
        let values = scores.iter().map(|seed| seed.score().balanced_accuracy);
        t_interval(&values.collect::<Vec<f64>>())
    };
    let noise_levels: &[f64] = if label_fraction == 1.0 { spec.snr_db.as_slice() } else { &[] };
    let noisy = noise_levels.iter().map(|&snr_db| (snr_db, under_noise(snr_db))).collect();
    Cell {
        variant: (*variant).to_owned(),
        label_fraction,
        learning_rate,
        done: outcomes.len(),
        failed: outcomes.iter().filter(|outcome| outcome.failed()).count(),
        test: test(&|metrics| Some(metrics.balanced_accuracy), Some(CHANCE)),
        scores: scores.iter().map(SeedMetrics::score).collect(),
        accuracy: test(&|metrics| Some(metrics.accuracy), Some(CHANCE)),
        macro_f1: test(&|metrics| Some(metrics.macro_f1), Some(0.0)),
        populated_recall: test(&|metrics| metrics.populated_recall, None),
        training: interval(&|outcome| Some(outcome.training)),
        validation: interval(&|outcome| Some(outcome.validation.as_ref()?.balanced_accuracy)),
        confusion,
        noisy,
        curve: curve(outcomes),
        reached_target: outcomes.iter().filter(|outcome| outcome.epochs_to_target.is_some()).count(),
        epochs_to_target: median(outcomes.iter().filter_map(|outcome| Some(outcome.epochs_to_target? as f64))),
        parameters: outcomes.first().map_or(0, |outcome| outcome.parameters),
        multiply_adds: outcomes.first().map_or(0, |outcome| outcome.multiply_adds),
    }
}

/// Means over outcomes by epoch, up to the last epoch of any outcome.
fn curve(outcomes: &[&Outcome]) -> Vec<CurvePoint> {
    let epochs = outcomes.iter().map(|outcome| outcome.curve.len()).max().unwrap_or_default();
    let point = |index: usize| {
        let mean = |value: &dyn Fn(&EpochReport) -> f64| {
            over_seeds(outcomes.iter().filter_map(|outcome| Some((outcome.job.seed, value(outcome.curve.get(index)?)))))
        };
        CurvePoint {
            epoch: index + 1,
            training: mean(&|epoch| epoch.training_balanced_accuracy),
            validation: mean(&|epoch| epoch.validation_balanced_accuracy),
            training_loss: mean(&|epoch| epoch.training_loss),
            validation_loss: mean(&|epoch| epoch.validation_loss),
        }
    };
    (0..epochs).map(point).collect()
}

/// Clean accuracy of the paper on synthetic data by network, test and training, %.
pub const PAPER_CLEAN: [(&str, f64, f64); 6] = [
    ("doppler_net", 99.9, 99.8),
    ("resnet18", 99.8, 100.0),
    ("efficientnet_b0", 99.6, 99.9),
    ("hqnn", 99.7, 100.0),
    ("estimator_matched", 71.7, 73.8),
    ("dequantization", 60.2, 55.4),
];
/// Balanced accuracy of the paper on synthetic data by network, under noise of [`PAPER_SNR_DB`].
pub const PAPER_NOISE: [(&str, [f64; 4]); 4] = [
    ("doppler_net", [0.333, 0.333, 0.415, 0.904]),
    ("resnet18", [0.333, 0.325, 0.755, 0.978]),
    ("efficientnet_b0", [0.407, 0.280, 0.594, 0.903]),
    ("hqnn", [0.378, 0.321, 0.792, 0.988]),
];
/// Signal-to-noise ratios of the paper, dB.
pub const PAPER_SNR_DB: [f64; 4] = [-20.0, -10.0, 10.0, 20.0];
/// Balanced accuracy of the paper on synthetic data by network, on [`PAPER_SHARES`] of the training maps.
pub const PAPER_FRACTIONS: [(&str, [f64; 3]); 4] = [
    ("hqnn", [0.47, 0.82, 0.85]),
    ("doppler_net", [0.76, 0.85, 0.86]),
    ("resnet18", [0.75, 0.83, 0.87]),
    ("efficientnet_b0", [0.73, 0.83, 0.86]),
];
/// Shares of the training maps in the paper.
pub const PAPER_SHARES: [f64; 3] = [0.1, 0.3, 0.5];

impl Report {
    /// The report as Markdown.
    pub fn markdown(&self) -> String {
        let mut text = String::new();
        // Writing to a string does not fail.
        let _ = self.write(&mut text);
        text
    }

    /// Cells of trainings on all labels that are done.
    fn cells_of_all_labels(&self) -> impl Iterator<Item = &Cell> {
        self.cells.iter().filter(|cell| cell.label_fraction == 1.0 && cell.done > 0)
    }

    fn write(&self, out: &mut String) -> std::fmt::Result {
        writeln!(out, "# {}\n", self.title)?;
        writeln!(
            out,
            "{} of {} trainings. Dataset {} of {} maps.",
            self.done,
            self.planned,
            self.dataset_hash.get(..12).unwrap_or(&self.dataset_hash),
            self.maps
        )?;
        writeln!(
            out,
            "Balanced accuracy with 95 % intervals of the mean over seeds (Student's t); [least, most]. Trainings that failed \
             (broke off, or ended below {} on their own training maps) are counted and stay in the means.\n",
            FAILED_BELOW
        )?;
        for remark in &self.remarks {
            writeln!(out, "{remark}\n")?;
        }
        self.write_clean(out)?;
        self.write_noise(out)?;
        self.write_fractions(out)?;
        self.write_conditions(out)?;
        self.write_cost(out)?;
        self.write_confusion(out)?;
        self.write_failures(out)
    }

    fn write_clean(&self, out: &mut String) -> std::fmt::Result {
        writeln!(out, "## Clean\n")?;
        writeln!(
            out,
            "| network | rate | seeds | failed | test | training | accuracy % | macro-F1 | paper % test/training |"
        )?;
        writeln!(out, "|---|---|---|---|---|---|---|---|---|")?;
        for cell in self.cells_of_all_labels() {
            let paper = PAPER_CLEAN.iter().find(|(name, ..)| *name == cell.variant);
            writeln!(
                out,
                "| {} | {} | {} | {} | {} | {} | {} | {} | {} |",
                cell.variant,
                cell.learning_rate,
                cell.seeds(),
                cell.failed,
                interval_and_range(cell.test),
                interval(cell.training),
                cell.accuracy.map_or("-".to_owned(), |a| format!("{:.1}", 100.0 * a.mean)),
                interval(cell.macro_f1),
                paper.map_or("-".to_owned(), |(_, test, training)| format!("{test} / {training}"))
            )?;
        }
        writeln!(out)
    }

    fn write_noise(&self, out: &mut String) -> std::fmt::Result {
        let first = self.cells_of_all_labels().next();
        let ratios: Vec<f64> =
            first.map(|cell| cell.noisy.iter().map(|(ratio, _)| *ratio).collect()).unwrap_or_default();
        if ratios.is_empty() {
            return Ok(());
        }
        writeln!(out, "## Gaussian noise on the test maps\n\nIn brackets the paper's.\n")?;
        write_row(out, "network", ratios.iter().map(|ratio| format!("{ratio:+} dB")))?;
        writeln!(out, "|---|{}", "---|".repeat(ratios.len()))?;
        for cell in self.cells_of_all_labels() {
            let columns = cell.noisy.iter().map(|&(ratio, score)| {
                let paper = paper_value(&PAPER_NOISE, &PAPER_SNR_DB, &cell.variant, ratio);
                format!("{}{}", interval(score), paper.map_or(String::new(), |v| format!(" ({v:.3})")))
            });
            write_row(out, &cell.variant, columns)?;
        }
        writeln!(out)
    }

    fn write_fractions(&self, out: &mut String) -> std::fmt::Result {
        let mut shares: Vec<f64> = self.cells.iter().map(|cell| cell.label_fraction).collect();
        shares.sort_by(f64::total_cmp);
        shares.dedup();
        if shares.len() < 2 {
            return Ok(());
        }
        writeln!(out, "## Shares of the training maps\n\nIn brackets the paper's.\n")?;
        write_row(out, "network", shares.iter().map(|share| format!("{:.0} %", 100.0 * share)))?;
        writeln!(out, "|---|{}", "---|".repeat(shares.len()))?;
        let mut names: Vec<&str> = Vec::new();
        for cell in &self.cells {
            if !names.contains(&cell.variant.as_str()) {
                names.push(&cell.variant);
            }
        }
        for name in names {
            let columns = shares.iter().map(|&share| {
                let cell = self.cells.iter().find(|c| c.variant == name && c.label_fraction == share);
                let paper = paper_value(&PAPER_FRACTIONS, &PAPER_SHARES, name, share);
                let ours = interval(cell.and_then(|cell| cell.test));
                format!("{ours}{}", paper.map_or(String::new(), |v| format!(" ({v:.2})")))
            });
            write_row(out, name, columns)?;
        }
        writeln!(out)
    }

    fn write_conditions(&self, out: &mut String) -> std::fmt::Result {
        let mut groups: Vec<Option<&str>> = Vec::new();
        for condition in &self.conditions {
            if !groups.contains(&condition.group.as_deref()) {
                groups.push(condition.group.as_deref());
            }
        }
        for group in groups {
            let conditions: Vec<&ConditionReport> =
                self.conditions.iter().filter(|condition| condition.group.as_deref() == group).collect();
            writeln!(out, "## {}\n", group.unwrap_or("Other sets"))?;
            writeln!(
                out,
                "Balanced accuracy of the models of all labels, on maps of sequences that they have not seen.\n"
            )?;
            write_row(out, "network | test split", conditions.iter().map(|condition| condition.name.clone()))?;
            writeln!(out, "|---|---|{}", "---|".repeat(conditions.len()))?;
            for cell in self.cells_of_all_labels() {
                let columns = conditions.iter().map(|condition| {
                    let scores = condition.cells.iter().find(|other| other.variant == cell.variant);
                    interval(scores.and_then(|scores| scores.balanced_accuracy))
                });
                write_row(out, &format!("{} | {}", cell.variant, interval(cell.test)), columns)?;
            }
            write_row(out, "maps |", conditions.iter().map(|condition| condition.maps.to_string()))?;
            writeln!(out)?;
        }
        Ok(())
    }

    fn write_cost(&self, out: &mut String) -> std::fmt::Result {
        writeln!(out, "## Cost\n")?;
        writeln!(out, "| network | parameters | multiply-adds | reached {} | epochs to it |", self.target)?;
        writeln!(out, "|---|---|---|---|---|")?;
        for cell in self.cells_of_all_labels() {
            writeln!(
                out,
                "| {} | {} | {:.1} M | {} of {} | {} |",
                cell.variant,
                cell.parameters,
                cell.multiply_adds as f64 * 1e-6,
                cell.reached_target,
                cell.done,
                number(cell.epochs_to_target, 0)
            )?;
        }
        writeln!(out)
    }

    fn write_confusion(&self, out: &mut String) -> std::fmt::Result {
        writeln!(out, "## Confusion on the test split, all seeds\n")?;
        writeln!(out, "| network | truth | called empty | one | two |\n|---|---|---|---|---|")?;
        for cell in self.cells_of_all_labels() {
            for (truth, row) in Occupancy::ALL.iter().zip(cell.confusion) {
                let [a, b, c] = row;
                writeln!(out, "| {} | {truth} | {a} | {b} | {c} |", cell.variant)?;
            }
        }
        Ok(())
    }

    fn write_failures(&self, out: &mut String) -> std::fmt::Result {
        if self.failures.is_empty() {
            return Ok(());
        }
        writeln!(out, "\n## Trainings that failed\n")?;
        writeln!(out, "| network | labels | rate | seed | without | reason |\n|---|---|---|---|---|---|")?;
        for Failure { job, reason } in &self.failures {
            let Job { variant, label_fraction, learning_rate, seed, held_out } = job;
            let held_out = held_out.as_deref().unwrap_or("-");
            let labels = 100.0 * label_fraction;
            writeln!(out, "| {variant} | {labels:.0} % | {learning_rate} | {seed} | {held_out} | {reason} |")?;
        }
        Ok(())
    }
}

/// Writes a row of a table.
fn write_row(out: &mut String, name: &str, cells: impl Iterator<Item = String>) -> std::fmt::Result {
    writeln!(out, "| {name} | {} |", cells.collect::<Vec<_>>().join(" | "))
}

/// The paper's value for a network in the column of `key`, if it has one.
fn paper_value<const N: usize>(table: &[(&str, [f64; N])], keys: &[f64; N], network: &str, key: f64) -> Option<f64> {
    let (_, values) = table.iter().find(|(name, _)| *name == network)?;
    Some(values[keys.iter().position(|known| *known == key)?])
}

/// Formats an optional number; `-` if it is absent.
pub(super) fn number(value: Option<f64>, digits: usize) -> String {
    value.map_or("-".to_owned(), |v| format!("{v:.digits$}"))
}

/// Formats a mean with the half width of its interval.
fn interval(interval: Option<Interval>) -> String {
    match interval {
        None => "-".to_owned(),
        Some(Interval { mean, half_width: Some(half), .. }) => format!("{mean:.3} ± {half:.3}"),
        Some(Interval { mean, .. }) => format!("{mean:.3}"),
    }
}

/// Formats a mean with the half width of its interval and the range of its values.
fn interval_and_range(value: Option<Interval>) -> String {
    let range = value.filter(|i| i.count > 1).map(|i| format!(" [{:.3}, {:.3}]", i.least, i.most));
    format!("{}{}", interval(value), range.unwrap_or_default())
}
