//! Labels that a classical detector ([`CfarCounter`]) proposes for a recording. They are meant for correction by hand,
//! not for training as they are.

use std::path::Path;

use anyhow::ensure;
use radome_driver::LabelSpan;
use radome_driver::recording::Recording;
use radome_dsp::detect::{CfarCounter, Observation};
use radome_dsp::{Frame, FrameSource, Occupancy, SourceEvent};

use crate::labels::spans_of;

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
    let mut looked: Vec<(f64, Observation)> = Vec::new();
    loop {
        match recording.next_frame(&mut frame).map_err(anyhow::Error::from_boxed)? {
            SourceEvent::End => break,
            SourceEvent::Gap(_) => counter.reset(),
            SourceEvent::Frame => looked.push((frame.time_s(), counter.observe(&frame)?)),
        }
    }
    ensure!(!looked.is_empty(), "{}: no frame", path.display());
    let believe = |index: usize, (time_s, seen): &(f64, Observation)| {
        // People who have just left still affect the window of the detector for breathing. Its result counts only where
        // few frames of the window held a walker.
        let half = frames / 2;
        let window = looked.get(index.saturating_sub(half)..(index + half).min(looked.len())).unwrap_or(&[]);
        let walked = window.iter().filter(|(_, seen)| seen.walking > 0).count();
        // At either end of the recording, the first and the last complete window are used.
        let slow = (index + half).max(frames - 1).min(looked.len() - 1);
        let breathes = looked.get(slow).is_some_and(|(_, seen)| seen.breathes) && 4 * walked <= window.len();
        let people = seen.walking.max(usize::from(breathes)).min(2);
        (*time_s, Occupancy::from_index(people).unwrap_or(Occupancy::Two))
    };
    let believed: Vec<(f64, Occupancy)> = looked.iter().enumerate().map(|(index, of)| believe(index, of)).collect();
    let agreed = agree(&believed);
    let mut spans = spans_of(&agreed, waveform.frame_interval_s());
    for span in &mut spans {
        let within = believed.iter().filter(|(time_s, _)| (span.start_s..span.end_s).contains(time_s));
        let (all, same) =
            within.fold((0, 0), |(all, same), (_, class)| (all + 1, same + u32::from(class.name() == span.label)));
        span.who = Some("detector".into());
        span.confidence = Some(f64::from(same) / f64::from(all.max(1)));
    }
    Ok(spans)
}

/// Returns the most frequent class within [`AGREEMENT_S`] around each frame.
fn agree(believed: &[(f64, Occupancy)]) -> Vec<(f64, Occupancy)> {
    let half_s = 0.5 * AGREEMENT_S;
    let (mut from, mut to) = (0, 0);
    let mut votes = [0usize; 3];
    let vote = |frame: Option<&(f64, Occupancy)>, votes: &mut [usize; 3], add: bool| {
        if let Some((_, class)) = frame {
            let votes = &mut votes[class.index()];
            *votes = if add { *votes + 1 } else { votes.saturating_sub(1) };
        }
    };
    believed
        .iter()
        .map(|(time_s, own)| {
            while believed.get(to).is_some_and(|(t, _)| *t <= time_s + half_s) {
                vote(believed.get(to), &mut votes, true);
                to += 1;
            }
            while believed.get(from).is_some_and(|(t, _)| *t < time_s - half_s) {
                vote(believed.get(from), &mut votes, false);
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
