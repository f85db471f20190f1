//! Fit of the occupancy filter's settings to labelled recordings.

use rayon::prelude::*;
use serde::Serialize;

use crate::metrics::FramePrediction;
use crate::occupancy_filter::{OccupancyFilter, Smoothing};

/// Lower bound of probabilities in the loss, which limits the weight of a single confident mistake.
const LEAST_PROBABILITY: f64 = 1e-9;
/// Start of the search: dwell and time of evidence, s, and temperature.
const START: [f64; 3] = [4.0, 0.7, 1.4];
/// First and last step size of the search, in logarithms of the settings.
const STEPS: (f64, f64) = (std::f64::consts::LN_2, 0.02);
/// Least gain of a step.
const LEAST_GAIN: f64 = 1e-6;

/// Predictions of a network for a recording, frame by frame.
#[derive(Debug, Clone)]
pub struct FilterSequence {
    /// Time from frame to frame, s.
    pub frame_interval_s: f64,
    /// Predictions for each frame by itself, in the order of time, those without a label too.
    pub frames: Vec<FramePrediction>,
}

/// Fitted settings of the filter.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct SmoothingFit {
    /// The settings.
    pub smoothing: Smoothing,
    /// Loss of the filter's answers with them.
    pub log_loss: f64,
    /// Loss of the frames by themselves.
    pub log_loss_by_frame: f64,
}

/// Sum of losses and number of frames.
type Sums = (f64, u64);

/// Fits the settings of the filter with the least log loss. The loss is the mean over the labelled frames of a group of
/// recordings, and then over the groups. `None` without a labelled frame.
///
/// The method is a compass search on the logarithms of [`Smoothing::dwell_s`], [`Smoothing::independent_s`] and
/// [`Smoothing::temperature`] from `START` (Kolda, Lewis and Torczon, SIAM Review 45(3), 2003, section 1.3). It needs
/// frames that follow each other more closely than errors last, and people who come and go. Frames a second apart do
/// not show how long errors last. The other settings are those of `fixed`: the log loss alone would set [`Smoothing::newest`] near 1,
/// where answers flicker.
pub fn fit_smoothing(groups: &[Vec<FilterSequence>], fixed: Smoothing) -> Option<SmoothingFit> {
    let settings = |logarithms: [f64; 3]| {
        let [dwell_s, independent_s, temperature] = logarithms.map(f64::exp);
        Smoothing { dwell_s, weight: None, independent_s: Some(independent_s), temperature, ..fixed }
    };
    let log_loss_by_frame = log_loss(groups, None)?;
    let mut best = START.map(f64::ln);
    let mut least_loss = log_loss(groups, Some(settings(best)))?;
    let (mut step, last_step) = STEPS;
    while step > last_step {
        let mut has_improved = false;
        for coordinate in 0..best.len() {
            for direction in [step, -step] {
                let mut next = best;
                next[coordinate] += direction;
                let candidate = settings(next);
                if candidate.invalid_setting().is_some() {
                    continue;
                }
                let loss = log_loss(groups, Some(candidate))?;
                if loss < least_loss - LEAST_GAIN {
                    (best, least_loss, has_improved) = (next, loss, true);
                    break;
                }
            }
        }
        if !has_improved {
            step *= 0.5;
        }
    }
    Some(SmoothingFit { smoothing: settings(best), log_loss: least_loss, log_loss_by_frame })
}

/// Log loss of the answers of a filter with these settings, or of single frames without settings. It is the mean over
/// the labelled frames of a group, and then over the groups.
fn log_loss(groups: &[Vec<FilterSequence>], smoothing: Option<Smoothing>) -> Option<f64> {
    let group_mean = |group: &Vec<FilterSequence>| {
        // Summed in the order of the recordings, on any number of threads.
        let sums: Vec<Sums> = group.par_iter().map(|sequence| sequence.sums(smoothing)).collect();
        mean(sums)
    };
    mean(groups.iter().filter_map(group_mean).map(|loss| (loss, 1)))
}

fn mean(sums: impl IntoIterator<Item = Sums>) -> Option<f64> {
    let (sum, count) = sums.into_iter().fold((0.0, 0), |(sum, count), (more, n)| (sum + more, count + n));
    (count > 0).then(|| sum / count as f64)
}

impl FilterSequence {
    /// Sum of the losses of the labelled frames, and their number.
    fn sums(&self, smoothing: Option<Smoothing>) -> Sums {
        let mut filter = smoothing.map(|smoothing| OccupancyFilter::new(smoothing, self.frame_interval_s));
        let (mut loss, mut frames) = (0.0, 0);
        for frame in &self.frames {
            let answer = match &mut filter {
                Some(filter) => filter.update(frame.time_s, frame.probabilities),
                None => frame.probabilities,
            };
            if let Some(truth) = frame.truth {
                // A NaN counts as the lower bound.
                loss -= f64::from(answer[truth.index()]).max(LEAST_PROBABILITY).ln();
                frames += 1;
            }
        }
        (loss, frames)
    }
}

#[cfg(test)]
mod tests {
    use radome_dsp::Occupancy;
    use rand::Rng;

    use super::*;
    use crate::metrics::CLASSES;

    const FIXED: Smoothing =
        Smoothing { dwell_s: 1.0, weight: None, independent_s: None, temperature: 1.0, newest: 0.0, one_share: 0.5 };

    /// Probability that a frame's most probable class is the truth.
    const RIGHT: f64 = 0.5;

    /// Recordings drawn from the model that the filter assumes: people come and go at its rates, and frames are independent. Each frame
    /// is a fraction of a piece of evidence.
    fn recordings(dwell_s: f64, independent_s: f64, interval_s: f64) -> Vec<FilterSequence> {
        (0..24).map(|index| recording(dwell_s, independent_s, interval_s, index)).collect()
    }

    fn recording(dwell_s: f64, independent_s: f64, interval_s: f64, index: u64) -> FilterSequence {
        let mut rng = crate::random::stream(17, "recording", index);
        let leaves = 1.0 - (-interval_s / dwell_s).exp();
        let mut truth = (index % 3) as usize;
        let mut frames = Vec::new();
        for frame in 1..=(240.0 / interval_s) as u32 {
            if rng.random::<f64>() < leaves {
                truth = if truth == 1 { 2 * rng.random_range(0..2usize) } else { 1 };
            }
            let observed =
                if rng.random::<f64>() < RIGHT { truth } else { (truth + rng.random_range(1..3usize)) % CLASSES };
            let likelihood = |class: usize| if class == observed { RIGHT } else { 0.5 * (1.0 - RIGHT) };
            // The filter raises probabilities to the power of interval over independent time, which gives the likelihood.
            let powers: [f64; CLASSES] =
                std::array::from_fn(|class| likelihood(class).powf(independent_s / interval_s));
            let norm: f64 = powers.iter().sum();
            frames.push(FramePrediction {
                time_s: f64::from(frame) * interval_s,
                truth: Occupancy::from_index(truth),
                probabilities: powers.map(|power| (power / norm) as f32),
            });
        }
        FilterSequence { frame_interval_s: interval_s, frames }
    }

    /// A fit to recordings from the filter's own model finds its settings, with a loss no larger than that of the true settings.
    #[test]
    fn the_true_settings_are_found() {
        for (dwell_s, independent_s) in [(6.0, 0.5), (12.0, 0.8)] {
            let groups = vec![recordings(dwell_s, independent_s, 0.2)];
            let fit = fit_smoothing(&groups, FIXED).expect("labels");
            let true_settings =
                Smoothing { dwell_s, weight: None, independent_s: Some(independent_s), temperature: 1.0, ..FIXED };
            assert!(Some(fit.log_loss) <= log_loss(&groups, Some(true_settings)).map(|loss| loss + 2e-3), "{fit:?}");
            assert!(fit.log_loss < fit.log_loss_by_frame, "{fit:?}");
            let Smoothing { dwell_s: found_dwell_s, independent_s: found_s, temperature, .. } = fit.smoothing;
            let found_s = found_s.expect("by time");
            for (found, expected, within) in
                [(found_dwell_s, dwell_s, 1.6), (found_s, independent_s, 1.3), (temperature, 1.0, 1.3)]
            {
                let ratio: f64 = found / expected;
                assert!(ratio < within && ratio > 1.0 / within, "{fit:?}, made with {dwell_s} s, {independent_s} s");
            }
        }
    }

    /// The weight of a group does not depend on its number of frames.
    #[test]
    fn the_loss_is_a_mean_over_groups() {
        let frame = |truth, probabilities| FramePrediction { time_s: 0.0, truth: Some(truth), probabilities };
        let one_right =
            FilterSequence { frame_interval_s: 0.1, frames: vec![frame(Occupancy::One, [0.25, 0.5, 0.25]); 3] };
        let mut frames = one_right.frames.clone();
        frames.push(frame(Occupancy::Two, [0.5, 0.25, 0.25]));
        frames.push(FramePrediction { truth: None, ..frames[0] });
        let mixed = FilterSequence { frame_interval_s: 0.1, frames };
        let groups = [vec![one_right.clone(), one_right], Vec::new(), vec![mixed]];
        // Of the first group ln 2, of the second three times that and once ln 4.
        let expected = 0.5 * (1.0 + 1.25) * std::f64::consts::LN_2;
        assert!((log_loss(&groups, None).expect("labels") - expected).abs() < 1e-9);
    }

    mod hard_cases {
        use super::*;

        #[test]
        fn without_labels_there_is_no_fit() {
            assert_eq!(fit_smoothing(&[], FIXED), None);
            let mut unlabelled = recording(5.0, 0.5, 0.2, 0);
            unlabelled.frames.iter_mut().for_each(|frame| frame.truth = None);
            assert_eq!(fit_smoothing(&[vec![unlabelled]], FIXED), None);
        }

        /// Frames with NaN, and a recording with a constant number of people.
        #[test]
        fn fits_to_odd_recordings_are_valid() {
            let mut odd = recording(1e9, 0.5, 0.2, 1);
            odd.frames.iter_mut().step_by(3).for_each(|frame| frame.probabilities = [f32::NAN, 0.0, f32::INFINITY]);
            odd.frames.truncate(100);
            let fit = fit_smoothing(&[vec![odd]], FIXED).expect("labels");
            assert!(fit.smoothing.invalid_setting().is_none() && fit.log_loss.is_finite(), "{fit:?}");
        }
    }
}
