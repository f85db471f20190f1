//! Scores of models on a ladder, as one object or as tables.

use std::path::{Path, PathBuf};

use radome_dsp::Occupancy;
use radome_models::calibration::{Reliability, ReliabilitySums};
use radome_models::evaluate::{Confusion, FalseAlarms, FoundTimes, Metrics, RecordingScores, add_confusion};
use radome_models::train::{FilterSequence, SmoothingFit};
use serde::Serialize;

use super::super::candidate::{Predictions, Refusal, add_reliability};
use super::rung::Rung;
use crate::output::{self, or_dash};

/// Scores of a model on the accepted recordings of a rung.
#[derive(Default)]
pub(super) struct RungScores {
    filtered: Confusion,
    single_frames: Confusion,
    recordings: Vec<RecordingResult>,
    scores: Vec<RecordingScores>,
    reliability: ReliabilitySums,
    /// Number of labelled frames without a prediction.
    unanswered: u64,
    pub(super) refused: Vec<Refusal>,
    /// Frames that a filter is fitted to, by recording.
    pub(super) sequences: Vec<FilterSequence>,
}

/// Predictions for a recording, after the filter.
#[derive(Debug, Clone, Serialize)]
struct RecordingResult {
    recording: String,
    /// Its label, or "mixed" where it has several.
    label: &'static str,
    majority: Occupancy,
    frames: u64,
    /// Fraction of the frames that were predicted correctly.
    right: f64,
    is_right: bool,
}

impl RungScores {
    pub(super) fn add(&mut self, name: &str, predictions: &Predictions) {
        let scores = predictions.filtered_scores();
        self.unanswered += predictions.unanswered;
        if scores.frames() == 0 {
            return;
        }
        add_confusion(&mut self.filtered, &scores.confusion);
        add_confusion(&mut self.single_frames, &predictions.single_frame_scores().confusion);
        add_reliability(&predictions.filtered, &mut self.reliability);
        self.sequences.push(predictions.sequence());
        self.recordings.push(RecordingResult {
            recording: name.to_owned(),
            label: scores.label().map_or("mixed", Occupancy::name),
            majority: scores.majority(),
            frames: scores.frames(),
            right: scores.right() as f64 / scores.frames() as f64,
            is_right: scores.is_right(),
        });
        self.scores.push(scores);
    }

    fn merge(&mut self, other: &RungScores) {
        add_confusion(&mut self.filtered, &other.filtered);
        add_confusion(&mut self.single_frames, &other.single_frames);
        self.reliability.merge(&other.reliability);
        self.unanswered += other.unanswered;
        self.recordings.extend_from_slice(&other.recordings);
        self.scores.extend_from_slice(&other.scores);
        self.refused.extend_from_slice(&other.refused);
    }
}

/// Scores of a model on a rung, or on all of them.
#[derive(Serialize)]
struct Row {
    rung: String,
    /// Balanced accuracy after the filter; absent if the model refused all recordings.
    balanced_accuracy: Option<f64>,
    balanced_accuracy_by_single_frames: Option<f64>,
    /// Number of frames after the filter, `[truth][predicted]`.
    confusion: Confusion,
    /// Number of labelled frames without a prediction, which do not count in any score.
    unanswered: u64,
    recordings_right: usize,
    recordings_judged: usize,
    /// Time from the start of an interval of `two` to its first frame that was predicted two.
    second_person_found: FoundTimes,
    /// False alarms after the filter.
    #[serde(flatten)]
    false_alarms: FalseAlarms,
    /// Reliability of the filter's largest probability.
    reliability: Reliability,
    recordings: Vec<RecordingResult>,
    refused: Vec<Refusal>,
}

impl Row {
    fn new(rung: &str, scores: &RungScores) -> Self {
        let balanced = |confusion: Confusion| {
            (!scores.recordings.is_empty()).then(|| Metrics::from_confusion(confusion).balanced_accuracy)
        };
        Row {
            rung: rung.to_owned(),
            balanced_accuracy: balanced(scores.filtered),
            balanced_accuracy_by_single_frames: balanced(scores.single_frames),
            confusion: scores.filtered,
            unanswered: scores.unanswered,
            recordings_right: scores.recordings.iter().filter(|recording| recording.is_right).count(),
            recordings_judged: scores.recordings.len(),
            second_person_found: FoundTimes::of(Occupancy::Two, scores.scores.iter().flat_map(|of| &of.stretches)),
            false_alarms: FalseAlarms::of(&scores.scores),
            reliability: scores.reliability.reliability(),
            recordings: scores.recordings.clone(),
            refused: scores.refused.clone(),
        }
    }
}

/// Scores of a model on a ladder.
#[derive(Serialize)]
pub(super) struct ModelScores {
    model: PathBuf,
    rungs: Vec<Row>,
    /// Scores on all rungs. Accuracies are means over the rungs, so that each weighs the same. All other scores are
    /// over all recordings.
    all: Row,
}

impl ModelScores {
    pub(super) fn new(model: &Path, rungs: &[Rung], scores: &[RungScores]) -> Self {
        let rows: Vec<Row> = rungs.iter().zip(scores).map(|(rung, scores)| Row::new(&rung.name, scores)).collect();
        let mut sum = RungScores::default();
        scores.iter().for_each(|scores| sum.merge(scores));
        let mean = |of: fn(&Row) -> Option<f64>| {
            let values: Vec<f64> = rows.iter().filter_map(of).collect();
            (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
        };
        let all = Row {
            balanced_accuracy: mean(|row| row.balanced_accuracy),
            balanced_accuracy_by_single_frames: mean(|row| row.balanced_accuracy_by_single_frames),
            // Recordings are listed in their rungs.
            recordings: Vec::new(),
            ..Row::new("all", &sum)
        };
        ModelScores { model: model.to_owned(), rungs: rows, all }
    }
}

pub(super) fn print(models: &[ModelScores]) -> anyhow::Result<()> {
    message!("frames in which someone enters or leaves are left out; `two` means two people or more");
    for model in models {
        output::text_line(&model.model.display().to_string())?;
        output::text_line(&format!(
            "  {:<12} {:>9} {:>9} {:>11} {:>12} {:>9} {:>9} {:>9} {:>12}",
            "rung",
            "by frame",
            "filtered",
            "recordings",
            "two found, s",
            "empty, h",
            "alarms/h",
            "alarm, %",
            "calibration"
        ))?;
        for row in model.rungs.iter().chain([&model.all]) {
            let mut notes = match row.refused.len() {
                0 => String::new(),
                refused => format!("  {refused} refused"),
            };
            if row.unanswered > 0 {
                notes += &format!("  {} frames without an answer", row.unanswered);
            }
            if row.recordings_judged == 0 {
                let why = if row.refused.is_empty() { "no answer" } else { "refused" };
                output::text_line(&format!("  {:<12} {why}", row.rung))?;
                continue;
            }
            output::text_line(&format!(
                "  {:<12} {:>9} {:>9} {:>11} {:>12} {:>9.3} {:>9} {:>9} {:>12}{notes}",
                row.rung,
                or_dash(row.balanced_accuracy_by_single_frames, 3),
                or_dash(row.balanced_accuracy, 3),
                format!("{} of {}", row.recordings_right, row.recordings_judged),
                or_dash(row.second_person_found.median_s, 1),
                row.false_alarms.empty_s / 3600.0,
                or_dash(row.false_alarms.false_alarms_per_hour, 1),
                or_dash(row.false_alarms.false_alarm_share.map(|share| 100.0 * share), 2),
                or_dash(row.reliability.expected_calibration_error, 3),
            ))?;
        }
        for row in &model.rungs {
            if let Some(first) = row.refused.first() {
                message!("{}: {} refused: {}", model.model.display(), first.recording, first.reason);
            }
        }
    }
    Ok(())
}

/// Prints the filter settings in the format of a training file.
pub(super) fn print_fit(fit: &SmoothingFit) -> anyhow::Result<()> {
    message!(
        "log loss, the mean over models and rungs: {:.3} by frame, {:.3} through the fitted filter",
        fit.log_loss_by_frame,
        fit.log_loss
    );
    if fit.log_loss > fit.log_loss_by_frame {
        message!(
            "the fitted filter is worse than single frames: its settings are the best that were found, and no good ones"
        );
    }
    output::text_line("[smoothing]")?;
    output::text_line(&format!("dwell_s = {}", three_digits(fit.smoothing.dwell_s)))?;
    let independent_s = fit.smoothing.independent_s.unwrap_or_default();
    output::text_line(&format!("independent_s = {}", three_digits(independent_s)))?;
    output::text_line(&format!("temperature = {}", three_digits(fit.smoothing.temperature)))?;
    output::text_line(&format!("newest = {:.2}", fit.smoothing.newest))?;
    output::text_line(&format!("one_share = {:.2}", fit.smoothing.one_share))
}

/// Formats a number above zero with three significant digits, and at least one behind the point.
fn three_digits(value: f64) -> String {
    let decimals = 2i32.saturating_sub(value.log10().floor() as i32).clamp(1, 9) as usize;
    format!("{value:.decimals$}")
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Regression test: a short time was printed as 0.00, which no training takes.
    #[test]
    fn fitted_settings_have_three_digits() {
        for (value, expected) in
            [(0.001_009_5, "0.00101"), (0.36, "0.360"), (2.3, "2.30"), (12.34, "12.3"), (1e4, "10000.0")]
        {
            assert_eq!(three_digits(value), expected);
        }
    }
}
