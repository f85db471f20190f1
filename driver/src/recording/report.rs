//! Report of a written recording, and of information that its format cannot hold.

use std::path::Path;

use radome_dsp::{Frame, FrameShape, Gap, MAX_CODE, Waveform};

use super::RecordingError;

/// Report of a written recording.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct WriteReport {
    /// Frames written.
    pub frames: u64,
    /// Gaps given to the writer, whether the format holds them or not.
    pub gaps: u64,
    /// Frames known to be lost in the gaps.
    pub frames_lost: u64,
    /// Gaps of unknown length, whose frames are not counted.
    pub unknown_gaps: u64,
    /// Labels given to the writer, whether the format holds them or not.
    pub labels: u64,
    /// Results of a classifier given to the writer, whether the format holds them or not.
    pub results: u64,
    /// Length of the file with the samples, bytes.
    pub bytes: u64,
    /// Greatest difference between the time of a frame and the time that a reader gives it, ns; 0 if the format holds
    /// the times.
    pub time_shift_ns: u64,
    /// Descriptions of the information that the format could not hold; empty if none.
    pub omitted: Vec<String>,
}

impl WriteReport {
    /// Counts a gap.
    pub fn count_gap(&mut self, gap: &Gap) {
        self.gaps += 1;
        self.frames_lost = self.frames_lost.saturating_add(gap.frames);
        self.unknown_gaps += u64::from(gap.frames == 0);
    }
}

/// Checks that a frame has the shape of its recording and codes of 12 bits; `offset` is its place in the file, bytes.
pub(super) fn check_frame(path: &Path, offset: u64, shape: FrameShape, frame: &Frame) -> Result<(), RecordingError> {
    if frame.shape != shape || frame.codes.len() != shape.codes() {
        return Err(RecordingError::FrameShape {
            path: path.to_owned(),
            sequence: frame.sequence,
            got: format!("{} with {} codes", frame.shape, frame.codes.len()),
            expected: shape.to_string(),
        });
    }
    match frame.codes.iter().find(|code| **code > MAX_CODE) {
        Some(&code) => Err(RecordingError::Code { path: path.to_owned(), offset, frame: frame.sequence, code }),
        None => Ok(()),
    }
}

/// Relative difference above which two chirp intervals differ.
const ROUNDING: f64 = 1e-9;

/// Counts of a writer whose format holds frames alone.
#[derive(Debug, Default)]
pub(super) struct Tally {
    pub report: WriteReport,
    truths: u64,
    is_renumbered: bool,
}

impl Tally {
    /// Checks and counts a frame.
    pub fn count_frame(&mut self, path: &Path, shape: FrameShape, frame: &Frame) -> Result<(), RecordingError> {
        let frames = &mut self.report.frames;
        check_frame(path, *frames * 2 * shape.codes() as u64, shape, frame)?;
        self.is_renumbered |= frame.sequence != *frames;
        *frames += 1;
        self.truths += u64::from(frame.truth.is_some());
        Ok(())
    }

    /// Descriptions of the information that the vendor's formats cannot hold, with those of the waveform.
    pub fn omitted(&self, waveform: &Waveform) -> Vec<String> {
        let WriteReport { gaps, frames_lost, unknown_gaps, labels, results, .. } = self.report;
        let count_text = |count: u64, noun: &str| format!("{count} {noun}{}", if count == 1 { "" } else { "s" });
        let mut omitted = Vec::new();
        if gaps > 0 {
            let unknown_text = match unknown_gaps {
                0 => String::new(),
                unknown => format!("; gaps of unknown length: {unknown}"),
            };
            omitted.push(format!("{}, lost frames: {frames_lost}{unknown_text}", count_text(gaps, "gap")));
        }
        if self.is_renumbered {
            omitted.push("the numbers of the frames (they count from 0 without gaps)".into());
        }
        if self.truths > 0 {
            omitted.push(format!("the truth of {}", count_text(self.truths, "frame")));
        }
        if labels > 0 {
            omitted.push(count_text(labels, "label"));
        }
        if results > 0 {
            omitted.push(format!("the answers of {}", count_text(results, "frame")));
        }
        // The configuration states the requested waveform, from which the registers of a board may differ.
        if let Ok(read) = Waveform::realise(waveform.request.clone())
            && (waveform.chirp_interval_s / read.chirp_interval_s - 1.0).abs() > ROUNDING
        {
            let [realised_us, read_us] = [waveform, &read].map(|waveform| 1e6 * waveform.chirp_interval_s);
            omitted.push(format!("the chirp interval of {realised_us:.4} us (readers take {read_us:.4} us)"));
        }
        omitted
    }
}
