//! Writer of recordings of any kind.

use std::path::Path;

use radome_dsp::{Frame, Gap};

use super::infineon::InfineonWriter;
use super::mcap::{FrameResult, LabelSpan, McapWriter, Recorder, RecordingHeader};
use super::text::TextWriter;
use super::{Existing, Format, RecordingError, WriteReport};

enum Writer {
    Mcap(Box<McapWriter>),
    Infineon(Box<InfineonWriter>),
    Text(Box<TextWriter>),
}

/// Destination of gaps, labels and results.
enum OtherData<'a> {
    /// The format holds them.
    Stored(&'a mut Recorder),
    /// The format holds only frames; other data are counted.
    Counted(&'a mut WriteReport),
}

impl Writer {
    fn other_data(&mut self) -> OtherData<'_> {
        match self {
            Writer::Mcap(writer) => OtherData::Stored(&mut writer.recorder),
            Writer::Infineon(writer) => OtherData::Counted(&mut writer.tally.report),
            Writer::Text(writer) => OtherData::Counted(&mut writer.tally.report),
        }
    }
}

/// Writer of a recording of any kind. The recording appears under its name when [`RecordingWriter::finish`] has
/// completed it, and not at all otherwise.
///
/// ```no_run
/// use std::path::Path;
///
/// use radome_driver::RecordingHeader;
/// use radome_driver::recording::{Format, RecordingWriter};
/// use radome_dsp::{Frame, Waveform, WaveformRequest};
///
/// # fn main() -> Result<(), Box<dyn std::error::Error + Send + Sync>> {
/// let waveform = Waveform::realise(WaveformRequest::paper())?;
/// let frame = Frame::zeroed(waveform.shape());
/// let mut writer = RecordingWriter::create(Path::new("room.mcap"), Format::Mcap, &RecordingHeader::new(waveform))?;
/// writer.frame(&frame)?;
/// let report = writer.finish()?;
/// assert_eq!(report.frames, 1);
/// # Ok(())
/// # }
/// ```
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
            Format::Mcap => Writer::Mcap(Box::new(McapWriter::create(path, header, existing)?)),
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
            Writer::Mcap(writer) => writer.recorder.frame(frame),
            Writer::Infineon(writer) => writer.frame(frame),
            Writer::Text(writer) => writer.frame(frame),
        }
    }

    /// Adds a gap.
    ///
    /// # Errors
    /// [`RecordingError::Io`].
    pub fn gap(&mut self, gap: &Gap) -> Result<(), RecordingError> {
        match self.writer.other_data() {
            OtherData::Stored(recorder) => recorder.gap(gap)?,
            OtherData::Counted(report) => report.count_gap(gap),
        }
        Ok(())
    }

    /// Adds a label.
    ///
    /// # Errors
    /// [`RecordingError::Io`].
    pub fn label(&mut self, label: &LabelSpan) -> Result<(), RecordingError> {
        match self.writer.other_data() {
            OtherData::Stored(recorder) => recorder.label(label)?,
            OtherData::Counted(report) => report.labels += 1,
        }
        Ok(())
    }

    /// Adds the result of a classifier for a frame; the header must name the classifier.
    ///
    /// # Errors
    /// [`RecordingError::Io`].
    pub fn result(&mut self, result: &FrameResult) -> Result<(), RecordingError> {
        match self.writer.other_data() {
            OtherData::Stored(recorder) => recorder.result(result)?,
            OtherData::Counted(report) => report.results += 1,
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
            Writer::Mcap(writer) => writer.finish(),
            Writer::Infineon(writer) => writer.finish(),
            Writer::Text(writer) => writer.finish(),
        }
    }
}
