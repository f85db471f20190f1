//! Cutting labels to the frames of a recording.

use std::path::Path;

use radome_driver::LabelSpan;
use radome_driver::recording::{Extent, Recording};

/// Duration below which a span counts as accidental, s.
pub(super) const SHORTEST_S: f64 = 1e-3;

/// Labels that are cut to a recording.
pub(super) struct Cut {
    pub(super) labels: Vec<LabelSpan>,
    /// Number of labels that were left out because they lie before the first frame.
    pub(super) before: usize,
    /// Number of those behind the last one.
    pub(super) behind: usize,
    /// Number of labels that stay although the recording, which was not finished, has no frames for them.
    pub(super) without_frames: usize,
}

/// Cuts labels to the frames of a recording, from the first one to the end of the last one. A recording that was not finished or
/// cannot be read leaves them as they are: a repair may find more frames.
pub(super) fn cut(labels: Vec<LabelSpan>, recording: &Path, interval_s: f64) -> Cut {
    let opened = Recording::open(recording).and_then(|mut opened| Ok((opened.is_complete(), opened.extent()?)));
    let (extent, without_frames) = match opened {
        Ok((true, extent)) => (extent, 0),
        Ok((false, None)) => (None, labels.len()),
        Ok((false, Some(extent))) => (None, labels.len() - cut_to(extent, labels.clone(), interval_s).labels.len()),
        Err(_) => (None, 0),
    };
    match extent {
        Some(extent) => cut_to(extent, labels, interval_s),
        None => Cut { labels, before: 0, behind: 0, without_frames },
    }
}

fn cut_to(extent: Extent, labels: Vec<LabelSpan>, interval_s: f64) -> Cut {
    let (first_s, last_s) = (extent.first.time_s(), extent.last.time_s() + interval_s);
    let cut = labels.into_iter().map(|label| LabelSpan {
        start_s: label.start_s.max(first_s),
        end_s: label.end_s.min(last_s),
        ..label
    });
    let (labels, out): (Vec<_>, Vec<_>) = cut.partition(|label| label.end_s - label.start_s >= SHORTEST_S);
    let behind = out.iter().filter(|label| label.start_s + SHORTEST_S > last_s).count();
    Cut { labels, before: out.len() - behind, behind, without_frames: 0 }
}

#[cfg(test)]
pub(super) mod tests {
    use radome_driver::{Recorder, RecordingHeader};
    use radome_dsp::{Frame, Waveform, WaveformRequest};

    use super::*;

    /// Records frames from 0.3 to 0.9 s at 10 Hz.
    pub fn recorded(path: &Path) -> Recorder {
        let waveform = Waveform::realise(WaveformRequest::paper()).expect("possible");
        let mut frame = Frame::zeroed(waveform.shape());
        let mut recorder = Recorder::create(path, &RecordingHeader::new(waveform)).expect("creates");
        for number in 3..10 {
            (frame.sequence, frame.time_ns) = (number, number * 100_000_000);
            recorder.frame(&frame).expect("records");
        }
        recorder.flush().expect("records");
        recorder
    }

    /// Labels were left out without a word, also of a recording of which a repair finds more.
    #[test]
    fn labels_behind_the_end_are_counted_and_kept_for_a_repair() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("night.mcap");
        let spans = [(0.1, 0.2), (0.5, 0.7), (2.0, 3.0), (4.0, 5.0)];
        let labels = spans.map(|(start_s, end_s)| LabelSpan::new(start_s, end_s, "one")).to_vec();
        let recorder = recorded(&path);
        let unfinished = cut(labels.clone(), &path, 0.1);
        assert_eq!((unfinished.labels, unfinished.before, unfinished.behind), (labels.clone(), 0, 0));
        assert_eq!(unfinished.without_frames, 3);
        recorder.finish().expect("finishes");
        let finished = cut(labels.clone(), &path, 0.1);
        assert_eq!((finished.labels.as_slice(), finished.before, finished.behind), (&labels[1..2], 1, 2));
        assert_eq!(finished.without_frames, 0);
    }
}
