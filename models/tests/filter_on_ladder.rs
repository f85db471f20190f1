//! Tests of the occupancy filter on the predictions of a shipped model for all recordings of the ladder.
//!
//! `fixtures/ladder/frames-room-hqnn.jsonl` holds the predictions of room-hqnn for each frame by itself, without the
//! model's memory, so that no frame has to be simulated here. `fixtures/ladder/remake-frames` makes the file. The model's
//! memory is applied before the filter, as in use.

use std::collections::BTreeMap;
use std::path::Path;

use radome_dsp::Occupancy;
use radome_models::ModelCard;
use radome_models::calibration::ReliabilitySums;
use radome_models::evaluate::{FramePrediction, Metrics};
use radome_models::evidence_mean::EvidenceMean;
use radome_models::occupancy_filter::{OccupancyFilter, Smoothing};
use radome_models::train::{FilterSequence, fit_smoothing};
use serde::Deserialize;

/// Predictions of a model for the frames of a recording.
#[derive(Deserialize)]
struct Recording {
    recording: String,
    frame_interval_s: f64,
    /// One letter for each frame: 0, 1 or 2 people, or `-` where someone is entering or leaving.
    labels: String,
    empty_permille: Vec<u16>,
    two_permille: Vec<u16>,
}

impl Recording {
    fn sequence(&self) -> FilterSequence {
        let probabilities = self.empty_permille.iter().zip(&self.two_permille);
        let frames = self.labels.chars().zip(probabilities).enumerate().map(|(index, (label, (empty, two)))| {
            let (empty, two) = (f32::from(*empty) / 1000.0, f32::from(*two) / 1000.0);
            FramePrediction {
                time_s: index as f64 * self.frame_interval_s,
                truth: label.to_digit(10).and_then(|people| Occupancy::from_index(people as usize)),
                probabilities: [empty, (1.0 - empty - two).max(0.0), two],
            }
        });
        FilterSequence { frame_interval_s: self.frame_interval_s, frames: frames.collect() }
    }
}

/// Recordings, grouped by rung.
fn rungs() -> BTreeMap<String, Vec<FilterSequence>> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fixtures/ladder/frames-room-hqnn.jsonl");
    let text = std::fs::read_to_string(path).expect("a fixture");
    let mut rungs: BTreeMap<String, Vec<FilterSequence>> = BTreeMap::new();
    for line in text.lines() {
        let recording: Recording = serde_json::from_str(line).expect("a recording");
        let rung = recording.recording.split('-').next().unwrap_or_default().to_owned();
        rungs.entry(rung).or_default().push(recording.sequence());
    }
    assert_eq!((rungs.len(), rungs.values().map(Vec::len).sum::<usize>()), (12, 118));
    rungs
}

/// Applies the memory of the shipped model to the predictions for single frames.
fn with_memory(sequence: &FilterSequence) -> FilterSequence {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fixtures/models/room-hqnn.safetensors");
    let mut mean = EvidenceMean::new(ModelCard::load(&path).expect("a model").memory_s);
    let averaged = |frame: &FramePrediction| FramePrediction {
        probabilities: mean.update(frame.time_s, frame.probabilities),
        ..*frame
    };
    FilterSequence { frames: sequence.frames.iter().map(averaged).collect(), ..*sequence }
}

fn filtered(sequence: &FilterSequence) -> Vec<FramePrediction> {
    let mut filter = OccupancyFilter::new(Smoothing::default(), sequence.frame_interval_s);
    let filtered = |frame: &FramePrediction| FramePrediction {
        probabilities: filter.update(frame.time_s, frame.probabilities),
        ..*frame
    };
    with_memory(sequence).frames.iter().map(filtered).collect()
}

fn balanced_accuracy<'a>(frames: impl IntoIterator<Item = &'a FramePrediction>) -> f64 {
    let truth_and_prediction = |frame: &FramePrediction| Some((frame.truth?, frame.predicted()));
    Metrics::from_predictions(frames.into_iter().filter_map(truth_and_prediction)).balanced_accuracy
}

/// Asserts that the filter loses no more than its delay on any rung, where most frames of a stretch of one label are
/// right. Where most are wrong, accumulated evidence leads any filter away from the truth. Over all frames the filter
/// may therefore lose the few right frames of such stretches.
#[test]
fn the_filter_is_not_worse_than_frames_on_any_rung() {
    let mut gains = Vec::new();
    for (rung, sequences) in rungs() {
        let (mut all_frames, mut all_filtered) = (Vec::new(), Vec::new());
        // Labelled frames of stretches whose frames are mostly right: their number, those right by themselves, and
        // those right after the filter.
        let (mut frames, mut right, mut right_filtered) = (0usize, 0usize, 0usize);
        for sequence in &sequences {
            let labelled: Vec<(FramePrediction, FramePrediction)> = (sequence.frames.iter().copied())
                .zip(filtered(sequence))
                .filter(|(frame, _)| frame.truth.is_some())
                .collect();
            for stretch in labelled.chunk_by(|(a, _), (b, _)| a.truth == b.truth) {
                let count_right = |select: &dyn Fn(&(FramePrediction, FramePrediction)) -> FramePrediction| {
                    stretch.iter().map(select).filter(|frame| frame.truth == Some(frame.predicted())).count()
                };
                let right_by_frame = count_right(&|(frame, _)| *frame);
                if 2 * right_by_frame > stretch.len() {
                    frames += stretch.len();
                    right += right_by_frame;
                    right_filtered += count_right(&|(_, filtered)| *filtered);
                }
            }
            let (by_frame, filtered): (Vec<_>, Vec<_>) = labelled.into_iter().unzip();
            all_frames.extend(by_frame);
            all_filtered.extend(filtered);
        }
        let (by_frame, filtered) = (balanced_accuracy(&all_frames), balanced_accuracy(&all_filtered));
        let [right, right_filtered] = [right, right_filtered].map(|count| count as f64 / frames as f64);
        assert!(right_filtered > right - 0.01, "{rung}: {right} by frame, {right_filtered} filtered");
        assert!(filtered > by_frame - 0.05, "{rung}: {by_frame} by frame, {filtered} filtered");
        gains.push(filtered - by_frame);
    }
    let gain = gains.iter().sum::<f64>() / gains.len() as f64;
    assert!(gain > 0.03, "{gain} of {gains:?}");
}

#[test]
fn the_confidence_is_calibrated() {
    let mut sums = ReliabilitySums::default();
    for sequence in rungs().values().flatten() {
        for frame in filtered(sequence) {
            if let Some(truth) = frame.truth {
                sums.add(&frame.probabilities, truth);
            }
        }
    }
    let error = sums.reliability().expected_calibration_error.expect("frames");
    assert!(error < 0.07, "{error}");
}

/// Asserts that the defaults are near the settings with the best log loss on these recordings, which is better than
/// that of single frames.
#[test]
fn the_default_settings_are_near_those_of_the_best_log_loss() {
    let fit_groups = |groups: Vec<Vec<FilterSequence>>| fit_smoothing(&groups, Smoothing::default()).expect("labels");
    let by_frame = fit_groups(rungs().into_values().collect()).log_loss_by_frame;
    let fit = fit_groups(rungs().into_values().map(|rung| rung.iter().map(with_memory).collect()).collect());
    assert!(fit.log_loss < by_frame, "{fit:?}, {by_frame} by frame");
    let default = Smoothing::default();
    let is_near = |found: f64, default: f64| (0.5..2.0).contains(&(found / default));
    assert!(is_near(fit.smoothing.dwell_s, default.dwell_s), "{fit:?}");
    assert!(is_near(fit.smoothing.temperature, default.temperature), "{fit:?}");
    let independent_s = |smoothing: Smoothing| smoothing.independent_s.expect("by time");
    assert!(is_near(independent_s(fit.smoothing), independent_s(default)), "{fit:?}");
}
