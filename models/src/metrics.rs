//! Scores of predictions: balanced accuracy first, as in the paper.

use radome_dsp::Occupancy;
use serde::{Deserialize, Serialize};

/// Number of classes.
pub(crate) const CLASSES: usize = Occupancy::ALL.len();
/// Balanced accuracy and accuracy of random guesses.
pub(crate) const CHANCE: f64 = 1.0 / CLASSES as f64;

/// Counts `[truth][prediction]`.
pub type Confusion = [[u64; CLASSES]; CLASSES];

/// Adds the counts of `other` to `sum`.
pub fn add_confusion(sum: &mut Confusion, other: &Confusion) {
    sum.iter_mut().flatten().zip(other.iter().flatten()).for_each(|(sum, count)| *sum += count);
}

/// Scores over a set of maps. Classes of which there is no map are left out of every mean and listed in `absent`.
///
/// # Examples
/// ```
/// use radome_dsp::Occupancy::{Empty, One, Two};
/// use radome_models::Metrics;
///
/// let metrics = Metrics::from_predictions([(Empty, Empty), (One, One), (Two, One), (Two, Two)]);
/// assert_eq!(metrics.accuracy, 0.75);
/// assert_eq!(metrics.balanced_accuracy, 2.5 / 3.0);
/// ```
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Metrics {
    /// Number of maps.
    pub samples: usize,
    /// `confusion[truth][prediction]`, counts.
    pub confusion: [[u64; CLASSES]; CLASSES],
    /// Mean recall over the classes present.
    pub balanced_accuracy: f64,
    /// Mean F1 over the classes present.
    pub macro_f1: f64,
    /// Share of maps that are classified correctly.
    pub accuracy: f64,
    /// Share of populated maps that are not classified as empty. Absent without any.
    pub populated_recall: Option<f64>,
    /// Recall of each class; absent where there is no map of it.
    pub recall: [Option<f64>; CLASSES],
    /// Classes without a map: the means above are over the others.
    pub absent: Vec<Occupancy>,
}

impl Metrics {
    /// Computes scores from pairs (truth, prediction). Without any pair, the scores are zero and all classes absent.
    pub fn from_predictions(pairs: impl IntoIterator<Item = (Occupancy, Occupancy)>) -> Self {
        let mut confusion = [[0u64; CLASSES]; CLASSES];
        for (truth, prediction) in pairs {
            confusion[truth.index()][prediction.index()] += 1;
        }
        Self::from_confusion(confusion)
    }

    /// Computes scores from counts `confusion[truth][prediction]`.
    pub fn from_confusion(confusion: [[u64; CLASSES]; CLASSES]) -> Self {
        let total: u64 = confusion.iter().flatten().sum();
        let row = |c: usize| confusion[c].iter().sum::<u64>();
        let column = |c: usize| confusion.iter().map(|r| r[c]).sum::<u64>();
        let ratio = |a: u64, b: u64| if b == 0 { 0.0 } else { a as f64 / b as f64 };
        let recall: [Option<f64>; CLASSES] =
            std::array::from_fn(|c| (row(c) > 0).then(|| ratio(confusion[c][c], row(c))));
        let present: Vec<usize> = (0..CLASSES).filter(|&c| row(c) > 0).collect();
        let mean = |f: &dyn Fn(usize) -> f64| match present.len() {
            0 => 0.0,
            n => present.iter().map(|&c| f(c)).sum::<f64>() / n as f64,
        };
        let populated = [Occupancy::One, Occupancy::Two].map(Occupancy::index);
        let people: u64 = populated.iter().map(|&c| row(c)).sum();
        let missed: u64 = populated.iter().map(|&c| confusion[c][Occupancy::Empty.index()]).sum();
        Metrics {
            samples: total as usize,
            confusion,
            balanced_accuracy: mean(&|c| recall[c].unwrap_or(0.0)),
            // 2 TP / (2 TP + FP + FN) = 2 TP / (row + column)
            macro_f1: mean(&|c| ratio(2 * confusion[c][c], row(c) + column(c))),
            accuracy: ratio((0..CLASSES).map(|c| confusion[c][c]).sum(), total),
            populated_recall: (people > 0).then(|| ratio(people - missed, people)),
            recall,
            absent: Occupancy::ALL.into_iter().filter(|o| row(o.index()) == 0).collect(),
        }
    }
}

/// Prediction of one frame of a recording, beside its label.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FramePrediction {
    /// Time of the frame on its recording's clock, s.
    pub time_s: f64,
    /// Label; `None` where the frame has none, or where someone is entering or leaving.
    pub truth: Option<Occupancy>,
    /// Probabilities of empty, one and two.
    pub probabilities: [f32; CLASSES],
}

impl FramePrediction {
    /// The most probable class.
    pub fn predicted(&self) -> Occupancy {
        most_probable(&self.probabilities)
    }
}

/// Labelled frames of one label that follow each other in a recording. Frames without a label do not end it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Stretch {
    /// The label.
    pub label: Occupancy,
    /// Time of its first frame, s.
    pub start_s: f64,
    /// Time from its first frame to the end of its last one, s.
    pub duration_s: f64,
    /// Time from its first frame to the first one of it that was predicted right, s; `None` if none was.
    pub found_within_s: Option<f64>,
}

/// Scores over the labelled frames of one recording.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct RecordingScores {
    /// `confusion[truth][prediction]`, counts.
    pub confusion: [[u64; CLASSES]; CLASSES],
    /// Stretches of one label, in the order of time.
    pub stretches: Vec<Stretch>,
    /// Number of false alarms: frames labelled empty that are predicted populated, unless the labelled frame before was predicted
    /// populated too. A prediction that persists after people have left is no alarm: it counts among the wrong frames.
    pub false_alarms: u64,
    /// Total length of the frames labelled empty, s.
    pub empty_s: f64,
}

impl RecordingScores {
    /// Scores of predictions in the order of time, one each frame interval.
    pub fn new(predictions: &[FramePrediction], frame_interval_s: f64) -> Self {
        let mut scores = RecordingScores::default();
        let mut previous: Option<Occupancy> = None;
        for prediction in predictions {
            let Some(truth) = prediction.truth else { continue };
            let (predicted, time_s) = (prediction.predicted(), prediction.time_s);
            scores.confusion[truth.index()][predicted.index()] += 1;
            if scores.stretches.last().is_none_or(|stretch| stretch.label != truth) {
                let stretch = Stretch { label: truth, start_s: time_s, duration_s: 0.0, found_within_s: None };
                scores.stretches.push(stretch);
            }
            if let Some(stretch) = scores.stretches.last_mut() {
                stretch.duration_s = time_s + frame_interval_s - stretch.start_s;
                if predicted == truth && stretch.found_within_s.is_none() {
                    stretch.found_within_s = Some(time_s - stretch.start_s);
                }
            }
            if truth == Occupancy::Empty {
                scores.empty_s += frame_interval_s;
                let was_empty = previous.is_none_or(|previous| previous == Occupancy::Empty);
                scores.false_alarms += u64::from(was_empty && predicted != Occupancy::Empty);
            }
            previous = Some(predicted);
        }
        scores
    }

    /// Number of labelled frames.
    pub fn frames(&self) -> u64 {
        self.confusion.iter().flatten().sum()
    }

    /// Label of all labelled frames; `None` if there is no label or more than one.
    pub fn label(&self) -> Option<Occupancy> {
        match self.stretches.as_slice() {
            [stretch] => Some(stretch.label),
            _ => None,
        }
    }

    /// Number of predictions of each class.
    pub fn predicted(&self) -> [u64; CLASSES] {
        std::array::from_fn(|class| self.confusion.iter().map(|row| row[class]).sum())
    }

    /// Class predicted for most labelled frames; of equal counts, the first class.
    pub fn majority(&self) -> Occupancy {
        let predicted = self.predicted();
        let most = predicted.iter().copied().max().unwrap_or_default();
        Occupancy::ALL.into_iter().find(|class| predicted[class.index()] == most).unwrap_or(Occupancy::Empty)
    }

    /// Number of labelled frames with a correct prediction.
    pub fn right(&self) -> u64 {
        (0..CLASSES).map(|class| self.confusion[class][class]).sum()
    }

    /// Returns whether the recording as a whole is correct. With one label, the majority of predictions must be that
    /// label. With several labels, more than half of the labelled frames must be correct.
    pub fn is_right(&self) -> bool {
        match self.label() {
            Some(label) => self.majority() == label,
            None => 2 * self.right() > self.frames(),
        }
    }
}

/// False alarms over the frames of recordings that are labelled empty.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct FalseAlarms {
    /// Number of false alarms, see [`RecordingScores::false_alarms`].
    pub false_alarms: u64,
    /// Length of the frames labelled empty, s.
    pub empty_s: f64,
    /// False alarms per hour of empty room; `None` without any frame labelled empty.
    pub false_alarms_per_hour: Option<f64>,
    /// Share of the frames labelled empty that were predicted populated; `None` without any.
    pub false_alarm_share: Option<f64>,
}

impl FalseAlarms {
    /// Sums over recordings.
    pub fn of<'a>(recordings: impl IntoIterator<Item = &'a RecordingScores>) -> Self {
        let (mut alarms, mut wrong, mut frames) = (FalseAlarms::default(), 0, 0);
        for scores in recordings {
            let predicted = scores.confusion[Occupancy::Empty.index()];
            alarms.false_alarms += scores.false_alarms;
            alarms.empty_s += scores.empty_s;
            frames += predicted.iter().sum::<u64>();
            wrong += predicted.iter().sum::<u64>() - predicted[Occupancy::Empty.index()];
        }
        if frames > 0 {
            alarms.false_alarms_per_hour = per_hour(alarms.false_alarms, alarms.empty_s);
            alarms.false_alarm_share = Some(wrong as f64 / frames as f64);
        }
        alarms
    }
}

/// Times until a label is predicted, over stretches of it.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct FoundTimes {
    /// Number of stretches.
    pub stretches: u64,
    /// Number of stretches without a correct prediction.
    pub never: u64,
    /// Median over all stretches of the time until the first right prediction, s. Stretches without one count as longer than
    /// any other: absent if they are the larger half, or if there is no stretch.
    pub median_s: Option<f64>,
}

impl FoundTimes {
    /// Shortest stretch that counts, s. Shorter presences need not be detected.
    pub const LEAST_STRETCH_S: f64 = 1.0;

    /// Computes times over the stretches of a label that last for [`FoundTimes::LEAST_STRETCH_S`] or more.
    pub fn of<'a>(label: Occupancy, stretches: impl IntoIterator<Item = &'a Stretch>) -> Self {
        let counted = stretches.into_iter().filter(|s| s.label == label && s.duration_s >= Self::LEAST_STRETCH_S);
        let mut times: Vec<f64> = counted.map(|stretch| stretch.found_within_s.unwrap_or(f64::INFINITY)).collect();
        times.sort_by(f64::total_cmp);
        let middle = times.len() / 2;
        let median = match times.as_slice() {
            [] => f64::INFINITY,
            times if times.len() % 2 == 1 => times[middle],
            times => 0.5 * (times[middle - 1] + times[middle]),
        };
        FoundTimes {
            stretches: times.len() as u64,
            never: times.iter().filter(|time| time.is_infinite()).count() as u64,
            median_s: median.is_finite().then_some(median),
        }
    }
}

/// Alarms per hour over a time; `None` if the time is 0.
fn per_hour(alarms: u64, time_s: f64) -> Option<f64> {
    (time_s > 0.0).then(|| alarms as f64 * 3600.0 / time_s)
}

/// The class with the largest probability; the first of equals.
pub fn most_probable(probabilities: &[f32; CLASSES]) -> Occupancy {
    let mut best = Occupancy::Empty;
    for class in Occupancy::ALL {
        if probabilities[class.index()] > probabilities[best.index()] {
            best = class;
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;

    /// from sklearn.metrics import *; y = [0]*5+[1]*4+[2]*3; p = [0,0,0,0,1, 1,1,0,2, 2,2,1]
    /// balanced_accuracy_score 0.65556, f1_score macro 0.65556, accuracy_score 0.66667
    #[test]
    fn scores_agree_with_scikit_learn() {
        let m = Metrics::from_confusion([[4, 1, 0], [1, 2, 1], [0, 1, 2]]);
        assert_eq!(m.samples, 12);
        assert!((m.balanced_accuracy - (0.8 + 0.5 + 2.0 / 3.0) / 3.0).abs() < 1e-12);
        assert!((m.macro_f1 - (0.8 + 0.5 + 2.0 / 3.0) / 3.0).abs() < 1e-12);
        assert!((m.accuracy - 8.0 / 12.0).abs() < 1e-12);
        assert!((m.populated_recall.expect("people") - 6.0 / 7.0).abs() < 1e-12);
        assert!(m.absent.is_empty());
    }

    /// Predictions every 0.1 s. Labels and predicted classes are given by their first letters, `-` for no label.
    fn predictions(labels: &str, predicted: &str) -> Vec<FramePrediction> {
        let class = |letter: char| Occupancy::ALL.into_iter().find(|class| class.name().starts_with(letter));
        let frames = labels.chars().zip(predicted.chars()).enumerate();
        let frames = frames.map(|(index, (label, predicted))| {
            let mut probabilities = [0.1; CLASSES];
            probabilities[class(predicted).expect("a class").index()] = 0.8;
            FramePrediction { time_s: 2.0 + 0.1 * index as f64, truth: class(label), probabilities }
        });
        frames.collect()
    }

    /// A person enters at 2.5 s (after a frame of transition), is detected 0.2 s later, leaves at 2.9 s and is predicted for
    /// another frame. There is one false alarm at the beginning and one of two frames at the end.
    #[test]
    fn a_recording_is_scored_by_label() {
        let scores = RecordingScores::new(&predictions("eeee-ooooeeeee", "oeeeoeeoooeeto"), 0.1);
        assert_eq!(scores.confusion, [[5, 3, 1], [2, 2, 0], [0, 0, 0]]);
        assert_eq!((scores.frames(), scores.right(), scores.predicted()), (13, 7, [7, 5, 1]));
        assert_eq!((scores.label(), scores.majority(), scores.is_right()), (None, Occupancy::Empty, true));
        assert_eq!(scores.false_alarms, 2);
        assert!((scores.empty_s - 0.9).abs() < 1e-9);
        let labels: Vec<Occupancy> = scores.stretches.iter().map(|stretch| stretch.label).collect();
        assert_eq!(labels, [Occupancy::Empty, Occupancy::One, Occupancy::Empty]);
        let found: Vec<f64> = scores.stretches.iter().filter_map(|stretch| stretch.found_within_s).collect();
        assert!(
            found.iter().zip([0.1, 0.2, 0.1]).all(|(found, expected)| (found - expected).abs() < 1e-9),
            "{found:?}"
        );
        let one = &scores.stretches[1];
        assert!((one.start_s - 2.5).abs() < 1e-9 && (one.duration_s - 0.4).abs() < 1e-9, "{one:?}");
        assert_eq!(per_hour(2, 1800.0), Some(4.0));
        let alarms = FalseAlarms::of([&scores, &scores]);
        assert_eq!((alarms.false_alarms, alarms.false_alarm_share), (4, Some(4.0 / 9.0)));
        assert!((alarms.empty_s - 1.8).abs() < 1e-9);
        assert!((alarms.false_alarms_per_hour.expect("empty frames") - 8000.0).abs() < 1e-6);
    }

    #[test]
    fn recordings_without_an_empty_frame_have_no_rate_of_false_alarms() {
        let scores = RecordingScores::new(&predictions("oo", "ee"), 0.1);
        assert_eq!(FalseAlarms::of([&scores]), FalseAlarms::default());
        assert_eq!(FalseAlarms::of([]), FalseAlarms::default());
    }

    #[test]
    fn a_recording_of_one_label_is_right_by_majority() {
        let scores = RecordingScores::new(&predictions("oo-ooo", "eeooot"), 0.1);
        // Two each of empty and one: the first of equals.
        assert_eq!((scores.label(), scores.majority()), (Some(Occupancy::One), Occupancy::Empty));
        assert!(!scores.is_right());
        assert!(RecordingScores::new(&predictions("ooooo", "eootto"), 0.1).is_right());
    }

    #[test]
    fn times_until_somebody_is_found_have_a_median() {
        let stretch = |label, duration_s, found_within_s| Stretch { label, start_s: 0.0, duration_s, found_within_s };
        let two = |found| stretch(Occupancy::Two, 5.0, found);
        let others = [stretch(Occupancy::One, 5.0, Some(9.0)), stretch(Occupancy::Two, 0.5, None)];
        let all = [two(Some(1.0)), two(None), two(Some(3.0)), others[0], others[1]];
        let found = FoundTimes::of(Occupancy::Two, &all);
        assert_eq!(found, FoundTimes { stretches: 3, never: 1, median_s: Some(3.0) });
        assert_eq!(FoundTimes::of(Occupancy::Two, &all[..2]).median_s, None);
        assert_eq!(FoundTimes::of(Occupancy::Two, [&all[0], &all[2]]).median_s, Some(2.0));
        assert_eq!(FoundTimes::of(Occupancy::Two, &others), FoundTimes::default());
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn a_recording_without_a_label_has_no_scores() {
            let scores = RecordingScores::new(&predictions("---", "eot"), 0.1);
            assert_eq!((scores.frames(), scores.label(), scores.is_right()), (0, None, false));
            assert_eq!(per_hour(scores.false_alarms, scores.empty_s), None);
        }

        #[test]
        fn an_empty_class_is_left_out_and_named() {
            let m = Metrics::from_confusion([[3, 1, 0], [0, 0, 0], [1, 0, 1]]);
            assert_eq!(m.absent, [Occupancy::One]);
            assert_eq!(m.recall[1], None);
            assert!((m.balanced_accuracy - (0.75 + 0.5) / 2.0).abs() < 1e-12);
            let m = Metrics::from_confusion([[3, 1, 0], [0; 3], [0; 3]]);
            assert_eq!(m.populated_recall, None);
            let m = Metrics::from_predictions([]);
            assert_eq!((m.samples, m.balanced_accuracy, m.absent.len()), (0, 0.0, 3));
            assert!(serde_json::to_string(&m).expect("JSON").contains("\"populated_recall\":null"));
        }
    }
}
