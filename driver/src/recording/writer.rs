//! Writer of recordings of any kind, and its report of information that the format cannot hold.

use std::path::Path;

use radome_dsp::{Frame, FrameShape, Gap, MAX_CODE};

use super::infineon::InfineonWriter;
use super::mcap::{FrameResult, LabelSpan, Recorder, RecordingHeader, remove_staged_labels};
use super::partial::Partial;
use super::text::TextWriter;
use super::{Existing, RecordingError};

/// Kinds of recordings.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// The native MCAP file.
    Mcap,
    /// The vendor's folder.
    Infineon,
    /// The vendor's text file.
    Text,
}

impl Format {
    /// Chooses the format by the name of an output: `.mcap`, `.txt`, or a folder: one that exists, or a name without
    /// extension or with a slash at its end.
    pub fn of_output(path: &Path) -> Option<Self> {
        let is_folder = path.is_dir() || path.as_os_str().to_string_lossy().ends_with('/');
        match path.extension().and_then(|e| e.to_str()) {
            _ if is_folder => Some(Format::Infineon),
            Some("mcap") => Some(Format::Mcap),
            Some("txt") => Some(Format::Text),
            None => Some(Format::Infineon),
            Some(_) => None,
        }
    }
}

/// Report of a written recording.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct WriteReport {
    /// Frames written.
    pub frames: u64,
    /// Gaps given to the writer, whether the format holds them or not.
    pub gaps: u64,
    /// Frames known to be lost in the gaps.
    pub frames_lost: u64,
    /// Length of the file with the samples, bytes.
    pub bytes: u64,
    /// Descriptions of the information that the format could not hold; empty if none.
    pub unheld: Vec<String>,
}

/// Counts of a writer whose format holds frames alone.
#[derive(Debug, Default)]
pub(crate) struct Tally {
    frames: u64,
    gaps: u64,
    frames_lost: u64,
    truths: u64,
    pub labels: u64,
    pub results: u64,
    renumbered: bool,
}

impl Tally {
    /// Checks and counts a frame.
    pub fn frame(&mut self, path: &Path, shape: FrameShape, frame: &Frame) -> Result<(), RecordingError> {
        if frame.shape != shape || frame.codes.len() != shape.codes() {
            return Err(RecordingError::FrameShape {
                path: path.to_owned(),
                sequence: frame.sequence,
                got: format!("{} with {} codes", frame.shape, frame.codes.len()),
                expected: shape.to_string(),
            });
        }
        if let Some(code) = frame.codes.iter().find(|code| **code > MAX_CODE) {
            let (offset, code) = (self.frames * 2 * shape.codes() as u64, *code);
            return Err(RecordingError::Code { path: path.to_owned(), offset, frame: frame.sequence, code });
        }
        self.renumbered |= frame.sequence != self.frames;
        self.frames += 1;
        self.truths += u64::from(frame.truth.is_some());
        Ok(())
    }

    pub fn gap(&mut self, gap: &Gap) {
        self.gaps += 1;
        self.frames_lost = self.frames_lost.saturating_add(gap.frames);
    }

    /// Descriptions of the information that the vendor's formats cannot hold.
    pub fn unheld(&self) -> Vec<String> {
        let mut unheld = Vec::new();
        if self.gaps > 0 {
            unheld.push(format!("{} gaps, in which {} frames were lost", self.gaps, self.frames_lost));
        }
        if self.renumbered {
            unheld.push("the numbers of the frames (they count from 0 without gaps)".into());
        }
        if self.truths > 0 {
            unheld.push(format!("the truth of {} frames", self.truths));
        }
        if self.labels > 0 {
            unheld.push(format!("{} labels", self.labels));
        }
        if self.results > 0 {
            unheld.push(format!("what was said about {} frames", self.results));
        }
        unheld
    }

    pub fn report(&self) -> WriteReport {
        let Tally { frames, gaps, frames_lost, .. } = *self;
        WriteReport { frames, gaps, frames_lost, bytes: 0, unheld: Vec::new() }
    }
}

enum Writer {
    Mcap(Box<Recorder>, Partial),
    Infineon(Box<InfineonWriter>),
    Text(Box<TextWriter>),
}

/// Writer of a recording of any kind. The recording appears under its name when [`RecordingWriter::finish`] has
/// completed it, and not at all otherwise.
pub struct RecordingWriter {
    writer: Writer,
}

impl RecordingWriter {
    /// Starts a recording. A file that exists is replaced at the end, a folder must be empty.
    ///
    /// # Errors
    /// Those of [`RecordingWriter::create_with`].
    pub fn create(path: &Path, format: Format, header: &RecordingHeader) -> Result<Self, RecordingError> {
        Self::create_with(path, format, header, Existing::Replace)
    }

    /// Starts a recording; `existing` decides whether a file that exists is replaced at the end. A folder must be
    /// empty.
    ///
    /// # Errors
    /// [`RecordingError::Occupied`] if the name exists and must not be replaced, [`RecordingError::Locked`] if another
    /// writer has it, and [`RecordingError::Io`].
    pub fn create_with(
        path: &Path,
        format: Format,
        header: &RecordingHeader,
        existing: Existing,
    ) -> Result<Self, RecordingError> {
        let writer = match format {
            Format::Mcap => {
                let partial = Partial::file(path, existing)?;
                Writer::Mcap(Box::new(Recorder::start(partial.open()?, path, header, None)?), partial)
            }
            Format::Infineon => Writer::Infineon(Box::new(InfineonWriter::create(path, header)?)),
            Format::Text => Writer::Text(Box::new(TextWriter::create(path, header, existing)?)),
        };
        Ok(RecordingWriter { writer })
    }

    /// Adds a frame.
    ///
    /// # Errors
    /// [`RecordingError::FrameShape`] or [`RecordingError::Code`] for a frame that does not fit;
    /// [`RecordingError::Io`].
    pub fn frame(&mut self, frame: &Frame) -> Result<(), RecordingError> {
        match &mut self.writer {
            Writer::Mcap(recorder, _) => recorder.frame(frame),
            Writer::Infineon(writer) => writer.frame(frame),
            Writer::Text(writer) => writer.frame(frame),
        }
    }

    /// Adds a gap.
    ///
    /// # Errors
    /// [`RecordingError::Io`].
    pub fn gap(&mut self, gap: &Gap) -> Result<(), RecordingError> {
        match &mut self.writer {
            Writer::Mcap(recorder, _) => recorder.gap(gap)?,
            Writer::Infineon(writer) => writer.gap(gap),
            Writer::Text(writer) => writer.gap(gap),
        }
        Ok(())
    }

    /// Adds a label.
    ///
    /// # Errors
    /// [`RecordingError::Io`].
    pub fn label(&mut self, label: &LabelSpan) -> Result<(), RecordingError> {
        match &mut self.writer {
            Writer::Mcap(recorder, _) => recorder.label(label)?,
            Writer::Infineon(writer) => writer.label(label),
            Writer::Text(writer) => writer.label(label),
        }
        Ok(())
    }

    /// Adds the result of a classifier for a frame; the header must name the classifier.
    ///
    /// # Errors
    /// [`RecordingError::Io`].
    pub fn result(&mut self, result: &FrameResult) -> Result<(), RecordingError> {
        match &mut self.writer {
            Writer::Mcap(recorder, _) => recorder.result(result)?,
            Writer::Infineon(writer) => writer.result(result),
            Writer::Text(writer) => writer.result(result),
        }
        Ok(())
    }

    /// Completes the recording and waits until it is on the disk.
    ///
    /// # Errors
    /// [`RecordingError::Occupied`] if a file has taken the name meanwhile and must not be replaced, and
    /// [`RecordingError::Io`].
    pub fn finish(self) -> Result<WriteReport, RecordingError> {
        match self.writer {
            Writer::Mcap(recorder, partial) => {
                let path = partial.target().to_owned();
                let summary = recorder.finish()?;
                partial.finish()?;
                // Labels of a recording that had this name before.
                remove_staged_labels(&path)?;
                let (frames, gaps, frames_lost, bytes) =
                    (summary.frames, summary.gaps, summary.frames_lost, summary.bytes);
                Ok(WriteReport { frames, gaps, frames_lost, bytes, unheld: Vec::new() })
            }
            Writer::Infineon(writer) => writer.finish(),
            Writer::Text(writer) => writer.finish(),
        }
    }
}
