//! Reliability of probabilities: share of correct predictions by confidence.

use radome_dsp::Occupancy;
use serde::{Deserialize, Serialize};

use crate::metrics::most_probable;

/// Bins of confidence, of equal width from 0 to 1. With three classes those below 1/3 stay empty.
pub const BINS: usize = 10;

/// Reliability curve of predictions, and the expected calibration error (Guo et al., On Calibration of Modern Neural Networks,
/// 2017, equation 5). The confidence of a prediction is its largest probability.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Reliability {
    /// Number of predictions.
    pub frames: u64,
    /// Mean over the predictions of the absolute difference between mean confidence and share of right predictions in their bin.
    /// Absent without predictions.
    pub expected_calibration_error: Option<f64>,
    /// The curve, [`BINS`] long.
    pub bins: Vec<ReliabilityBin>,
}

/// Predictions whose confidence lies in one bin.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ReliabilityBin {
    /// Least confidence of the bin.
    pub from: f64,
    /// Largest confidence of the bin.
    pub to: f64,
    /// Number of predictions.
    pub frames: u64,
    /// Mean confidence of these predictions; absent in an empty bin.
    pub confidence: Option<f64>,
    /// Share of these predictions that are right; absent in an empty bin.
    pub right: Option<f64>,
}

/// Sums from which a [`Reliability`] follows.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ReliabilitySums {
    bins: [BinSums; BINS],
}

/// Sums over the predictions of one bin.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct BinSums {
    frames: u64,
    right: u64,
    confidence: f64,
}

impl ReliabilitySums {
    /// Counts one prediction. Probabilities that are NaN are ignored.
    pub fn add(&mut self, probabilities: &[f32; Occupancy::ALL.len()], truth: Occupancy) {
        let predicted = most_probable(probabilities);
        let confidence = f64::from(probabilities[predicted.index()]);
        if !confidence.is_finite() {
            return;
        }
        let bin = &mut self.bins[((confidence * BINS as f64) as usize).min(BINS - 1)];
        bin.frames += 1;
        bin.right += u64::from(predicted == truth);
        bin.confidence += confidence;
    }

    /// Adds the predictions of other sums.
    pub fn merge(&mut self, other: &ReliabilitySums) {
        for (bin, other) in self.bins.iter_mut().zip(&other.bins) {
            bin.frames += other.frames;
            bin.right += other.right;
            bin.confidence += other.confidence;
        }
    }

    /// Reliability of the counted predictions.
    pub fn reliability(&self) -> Reliability {
        let frames: u64 = self.bins.iter().map(|bin| bin.frames).sum();
        let gaps: f64 = self.bins.iter().map(|bin| (bin.confidence - bin.right as f64).abs()).sum();
        let bins = self.bins.iter().enumerate().map(|(index, bin)| {
            let mean = |sum: f64| (bin.frames > 0).then(|| sum / bin.frames as f64);
            ReliabilityBin {
                from: index as f64 / BINS as f64,
                to: (index + 1) as f64 / BINS as f64,
                frames: bin.frames,
                confidence: mean(bin.confidence),
                right: mean(bin.right as f64),
            }
        });
        let expected_calibration_error = (frames > 0).then(|| gaps / frames as f64);
        Reliability { frames, expected_calibration_error, bins: bins.collect() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Ten predictions with 0.95, eight of them right, and ten with 0.55, six of them right:
    /// (10 |0.95 - 0.8| + 10 |0.55 - 0.6|) / 20 = 0.1.
    #[test]
    fn the_error_is_the_mean_gap_between_confidence_and_share_of_right_ones() {
        let mut sums = ReliabilitySums::default();
        for i in 0..10 {
            sums.add(&[0.95, 0.03, 0.02], if i < 8 { Occupancy::Empty } else { Occupancy::One });
        }
        let mut others = ReliabilitySums::default();
        for i in 0..10 {
            others.add(&[0.25, 0.2, 0.55], if i < 6 { Occupancy::Two } else { Occupancy::Empty });
        }
        sums.merge(&others);
        let reliability = sums.reliability();
        assert_eq!((reliability.frames, reliability.bins.len()), (20, BINS));
        assert!((reliability.expected_calibration_error.expect("frames") - 0.1).abs() < 1e-6, "{reliability:?}");
        let last = &reliability.bins[9];
        assert_eq!((last.frames, last.right), (10, Some(0.8)));
        assert!(
            (last.confidence.expect("frames") - 0.95).abs() < 1e-6 && last.from == 0.9 && last.to == 1.0,
            "{last:?}"
        );
        assert_eq!((reliability.bins[5].frames, reliability.bins[0].right), (10, None));
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn nothing_and_nonsense_have_no_error() {
            let mut sums = ReliabilitySums::default();
            sums.add(&[f32::NAN; 3], Occupancy::One);
            assert_eq!(sums.reliability().expected_calibration_error, None);
            // A confidence of 1 or more belongs to the last bin.
            sums.add(&[1.0, 0.0, 0.0], Occupancy::Empty);
            sums.add(&[1.5, 0.0, 0.0], Occupancy::Empty);
            assert_eq!(sums.reliability().bins[9].frames, 2);
        }
    }
}
