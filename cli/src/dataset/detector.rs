//! Labels that the classical detector ([`CfarCounter`]) proposes for a recording. They need correction by hand before training.

use std::path::Path;

use anyhow::ensure;
use radome_driver::LabelSpan;
use radome_driver::recording::Recording;
use radome_dsp::detect::{CfarCounter, Observation};
use radome_dsp::{Frame, FrameSource, Occupancy};

use crate::labels::spans_of;
use crate::source;

/// Time over which frames vote for a class, s.
const AGREEMENT_S: f64 = 1.5;

/// Proposes labels for a recording, each with the fraction of its frames that agreed.
///
/// # Errors
/// The recording cannot be read, holds no frame, or has a waveform that the detector cannot use.
pub fn propose(path: &Path) -> anyhow::Result<Vec<LabelSpan>> {
    let mut recording = Recording::open(path)?;
    let waveform = recording.waveform().clone();
    let mut counter = CfarCounter::new(&waveform)?;
    let frames = counter.slow_frames();
    let mut frame = Frame::zeroed(waveform.shape());
    let mut observations: Vec<(f64, Observation)> = Vec::new();
    while source::next_frame_noting_gaps(&mut recording, &mut frame, || counter.reset())? {
        observations.push((frame.time_s(), counter.observe(&frame)?));
    }
    ensure!(!observations.is_empty(), "{}: no frame", path.display());
    let classify = |index: usize, (time_s, observation): &(f64, Observation)| {
        // People who have just left still affect the window of the detector for breathing. Its result counts only if few frames
        // of the window show a walker.
        let half = frames / 2;
        let window =
            observations.get(index.saturating_sub(half)..(index + half).min(observations.len())).unwrap_or(&[]);
        let walking_frames = window.iter().filter(|(_, observation)| observation.walking > 0).count();
        // At either end of the recording, the first and the last complete window are used.
        let slow_index = (index + half).max(frames - 1).min(observations.len() - 1);
        let breathes = observations.get(slow_index).is_some_and(|(_, observation)| observation.breathes)
            && 4 * walking_frames <= window.len();
        let people = observation.walking.max(usize::from(breathes)).min(2);
        (*time_s, Occupancy::from_index(people).unwrap_or(Occupancy::Two))
    };
    let classes: Vec<(f64, Occupancy)> =
        observations.iter().enumerate().map(|(index, observation)| classify(index, observation)).collect();
    let smoothed_classes = majority_classes(&classes);
    let mut spans = spans_of(&smoothed_classes, waveform.frame_interval_s());
    for span in &mut spans {
        let frames_within = classes.iter().filter(|(time_s, _)| (span.start_s..span.end_s).contains(time_s));
        let (all, same) = frames_within
            .fold((0, 0), |(all, same), (_, class)| (all + 1, same + u32::from(class.name() == span.label)));
        span.who = Some("detector".into());
        span.confidence = Some(f64::from(same) / f64::from(all.max(1)));
    }
    Ok(spans)
}

/// Returns the most frequent class within [`AGREEMENT_S`] around each frame.
fn majority_classes(classes: &[(f64, Occupancy)]) -> Vec<(f64, Occupancy)> {
    let half_s = 0.5 * AGREEMENT_S;
    let (mut from, mut to) = (0, 0);
    let mut votes = [0usize; 3];
    let vote = |frame: Option<&(f64, Occupancy)>, votes: &mut [usize; 3], add: bool| {
        if let Some((_, class)) = frame {
            let votes = &mut votes[class.index()];
            *votes = if add { *votes + 1 } else { votes.saturating_sub(1) };
        }
    };
    classes
        .iter()
        .map(|(time_s, own)| {
            while classes.get(to).is_some_and(|(t, _)| *t <= time_s + half_s) {
                vote(classes.get(to), &mut votes, true);
                to += 1;
            }
            while classes.get(from).is_some_and(|(t, _)| *t < time_s - half_s) {
                vote(classes.get(from), &mut votes, false);
                from += 1;
            }
            let most = votes.iter().copied().max().unwrap_or(0);
            // In a tie, the frame's own class wins.
            let class = if votes[own.index()] == most {
                Some(*own)
            } else {
                Occupancy::ALL.into_iter().find(|o| votes[o.index()] == most)
            };
            (*time_s, class.unwrap_or(*own))
        })
        .collect()
}
