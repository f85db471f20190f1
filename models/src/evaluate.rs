//! How good predictions are: balanced accuracy first (paper.md section 5).

use radome_dsp::Occupancy;
use serde::{Deserialize, Serialize};

use crate::dataset::Dataset;
use crate::{Classifier, ClassifyError};

const CLASSES: usize = Occupancy::ALL.len();

/// Scores over a set of maps. Classes of which there is no map are left out of every mean and listed in `absent`.
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
    /// Share of maps judged right.
    pub accuracy: f64,
    /// Recall of "one" and "two" pooled into "somebody": share of populated maps not called empty. Absent without any.
    pub populated_recall: Option<f64>,
    /// Recall of each class; absent where there is no map of it.
    pub recall: [Option<f64>; CLASSES],
    /// Classes without a map: the means above are over the others.
    pub absent: Vec<Occupancy>,
}

impl Metrics {
    /// From pairs (truth, prediction). Without any pair, the scores are zero and all classes absent.
    pub fn from_predictions(pairs: impl IntoIterator<Item = (Occupancy, Occupancy)>) -> Self {
        let mut confusion = [[0u64; CLASSES]; CLASSES];
        for (truth, prediction) in pairs {
            confusion[truth.index()][prediction.index()] += 1;
        }
        Self::from_confusion(confusion)
    }

    /// From counts `confusion[truth][prediction]`.
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

/// Scores of a classifier over the maps `indices` of a dataset.
pub fn evaluate(classifier: &mut Classifier, dataset: &Dataset, indices: &[usize]) -> Result<Metrics, ClassifyError> {
    let mut pairs = Vec::with_capacity(indices.len());
    for &index in indices {
        let map = dataset.map(index)?;
        let Some(row) = dataset.rows().get(index) else { continue };
        let probabilities = classifier.classify_row(&map, dataset.header().shape, row)?;
        pairs.push((row.label, most_probable(&probabilities)));
    }
    Ok(Metrics::from_predictions(pairs))
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

    mod hard_cases {
        use super::*;

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
