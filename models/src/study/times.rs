//! Times of a study's trainings. They differ from run to run and stand apart from the report.

use std::collections::BTreeMap;
use std::fmt::Write;

use serde::{Deserialize, Serialize};

use super::outcome::Outcome;
use super::report::{groups, number};
use super::spec::StudySpec;
use crate::interval::{Interval, median, t_interval};

/// Times of one variant trained on one share of the maps, without trainings that broke off.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CellTimes {
    /// Name of the variant.
    pub variant: String,
    /// Share of the training maps.
    pub label_fraction: f64,
    /// Time of a training's epochs, s.
    pub training_seconds: Option<Interval>,
    /// Median time until the target was reached on the validation split, s.
    pub seconds_to_target: Option<f64>,
    /// Median time of one map through the classifier, ms.
    pub latency_ms: Option<f64>,
    /// Median processor time of a training, s.
    #[serde(default)]
    pub training_cpu_seconds: Option<f64>,
    /// Median processor time of one map through the classifier, ms.
    #[serde(default)]
    pub label_cpu_ms: Option<f64>,
    /// Median energy of one map through the classifier, mJ, where the machine counts it.
    #[serde(default)]
    pub label_energy_mj: Option<f64>,
}

/// Times of a study's trainings.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Times {
    /// Time of the epochs of all trainings that are done, s.
    pub seconds: f64,
    /// Processor time of the same trainings, s, as far as the system reports it. It is lower than the whole time if a
    /// training continued from a checkpoint.
    #[serde(default)]
    pub cpu_seconds: f64,
    /// Times, one for each variant and label fraction.
    pub cells: Vec<CellTimes>,
}

/// Collects the times of outcomes.
pub(super) fn times(spec: &StudySpec, chosen: &BTreeMap<String, f64>, outcomes: &[Outcome]) -> Times {
    let mut cells = Vec::new();
    for group in groups(spec, chosen, outcomes) {
        let completed = || group.outcomes.iter().filter(|outcome| outcome.error.is_none());
        let seconds: Vec<f64> = completed().map(|outcome| outcome.training_seconds).collect();
        cells.push(CellTimes {
            variant: group.variant.to_owned(),
            label_fraction: group.label_fraction,
            training_seconds: t_interval(&seconds),
            seconds_to_target: median(completed().filter_map(|outcome| outcome.seconds_to_target)),
            latency_ms: median(completed().map(|outcome| outcome.latency_ms)),
            training_cpu_seconds: median(completed().filter_map(|outcome| outcome.training_cost.cpu_seconds)),
            label_cpu_ms: median(completed().filter_map(|outcome| Some(1e3 * outcome.label_cost.cpu_seconds?))),
            label_energy_mj: median(completed().filter_map(|outcome| Some(1e3 * outcome.label_cost.energy_joules?))),
        });
    }
    Times {
        seconds: outcomes.iter().map(|outcome| outcome.training_seconds).sum(),
        cpu_seconds: outcomes.iter().filter_map(|outcome| outcome.training_cost.cpu_seconds).sum(),
        cells,
    }
}

impl Times {
    /// The times as Markdown.
    pub fn markdown(&self) -> String {
        let mut text = String::new();
        // Writing to a string does not fail.
        let _ = self.write(&mut text);
        text
    }

    fn write(&self, out: &mut String) -> std::fmt::Result {
        writeln!(
            out,
            "# Times\n\n{:.0} s of training in all, {:.0} s of processor time.\n",
            self.seconds, self.cpu_seconds
        )?;
        writeln!(
            out,
            "| network | labels | training s | its CPU s | s to the target | one map ms | its CPU ms | its mJ |\n\
             |---|---|---|---|---|---|---|---|"
        )?;
        for cell in self.cells.iter().filter(|cell| cell.training_seconds.is_some()) {
            writeln!(
                out,
                "| {} | {:.0} % | {} | {} | {} | {} | {} | {} |",
                cell.variant,
                100.0 * cell.label_fraction,
                number(cell.training_seconds.map(|interval| interval.mean), 1),
                number(cell.training_cpu_seconds, 1),
                number(cell.seconds_to_target, 1),
                number(cell.latency_ms, 2),
                number(cell.label_cpu_ms, 2),
                number(cell.label_energy_mj, 2)
            )?;
        }
        Ok(())
    }
}
