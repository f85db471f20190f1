//! Recordings of any kind as one type, with seeking, labels and results.

use std::path::Path;

use radome_dsp::{Frame, FrameSource, SourceError, SourceEvent, Waveform};

use super::infineon::InfineonReader;
use super::mcap::{LabelSpan, McapReader, RecordingHeader, Results};
use super::text::TextReader;
use super::{Extent, Format, Position, RecordingError, first_index, time_ns};

/// Open recording.
///
/// ```no_run
/// use std::path::Path;
///
/// use radome_driver::recording::Recording;
/// use radome_dsp::{Frame, FrameSource};
///
/// # fn main() -> Result<(), Box<dyn std::error::Error + Send + Sync>> {
/// let mut recording = Recording::open(Path::new("night.mcap"))?;
/// recording.seek_time_s(60.0)?;
/// let mut frame = Frame::zeroed(recording.waveform().shape());
/// recording.next_frame(&mut frame)?;
/// println!("{} labels", recording.labels()?.len());
/// # Ok(())
/// # }
/// ```
#[derive(Debug)]
pub enum Recording {
    /// The native MCAP file.
    Mcap(Box<McapReader>),
    /// The vendor's folder.
    Infineon(Box<InfineonReader>),
    /// The vendor's text file.
    Text(Box<TextReader>),
}

/// Evaluates an expression of the reader, whatever its format.
macro_rules! with_reader {
    ($recording:expr, $reader:ident => $call:expr) => {
        match $recording {
            Recording::Mcap($reader) => $call,
            Recording::Infineon($reader) => $call,
            Recording::Text($reader) => $call,
        }
    };
}

impl Recording {
    /// Opens a recording; its content decides the format.
    ///
    /// # Errors
    /// [`RecordingError`] if the path cannot be read or is not a recording; [`RecordingError::NotRegular`] for a pipe.
    pub fn open(path: &Path) -> Result<Self, RecordingError> {
        Ok(match Format::of_content(path)? {
            Some(Format::Mcap) => Recording::Mcap(Box::new(McapReader::open(path)?)),
            Some(Format::Infineon) => Recording::Infineon(Box::new(InfineonReader::open(path)?)),
            Some(Format::Text) => Recording::Text(Box::new(TextReader::open(path)?)),
            None => return Err(RecordingError::Unknown { path: path.to_owned() }),
        })
    }

    /// Returns the format of the recording.
    pub fn format(&self) -> Format {
        match self {
            Recording::Mcap(_) => Format::Mcap,
            Recording::Infineon(_) => Format::Infineon,
            Recording::Text(_) => Format::Text,
        }
    }

    /// Returns the reader of an MCAP file. The other formats hold frames alone.
    fn mcap(&self) -> Option<&McapReader> {
        match self {
            Recording::Mcap(reader) => Some(reader),
            Recording::Infineon(_) | Recording::Text(_) => None,
        }
    }

    /// Returns the header of the recording; in the vendor's formats it holds the waveform alone.
    pub fn header(&self) -> RecordingHeader {
        let header = self.mcap().map(|reader| reader.header().clone());
        header.unwrap_or_else(|| RecordingHeader::new(self.waveform().clone()))
    }

    /// Returns the number of whole frames. [`FrameSource::frame_count`] may be more for a folder that is cut.
    pub fn whole_frames(&self) -> u64 {
        with_reader!(self, reader => reader.whole_frames())
    }

    /// Returns whether the recording was finished and has not been cut since.
    pub fn is_complete(&self) -> bool {
        with_reader!(self, reader => reader.is_complete())
    }

    /// Returns whether the end of an unfinished MCAP file cannot be read; the last event is then a gap of unknown length. Readers of
    /// the vendor's formats end with an error instead.
    pub fn is_cut(&self) -> bool {
        self.mcap().is_some_and(McapReader::is_cut)
    }

    /// Returns the number of gaps; `None` for the vendor's formats, which cannot hold them.
    pub fn gap_count(&self) -> Option<u64> {
        self.mcap().map(McapReader::gap_count)
    }

    /// Reads all labels; the vendor's formats have none.
    ///
    /// # Errors
    /// [`RecordingError`] if the labels cannot be read.
    pub fn labels(&self) -> Result<Vec<LabelSpan>, RecordingError> {
        self.mcap().map_or(Ok(Vec::new()), McapReader::labels)
    }

    /// Returns an iterator over the results of a classifier; `None` for the vendor's formats, which cannot hold them.
    ///
    /// # Errors
    /// [`RecordingError`] if the file cannot be opened again.
    pub fn results(&self) -> Result<Option<Results>, RecordingError> {
        self.mcap().map(McapReader::results).transpose()
    }

    /// Seeks the first frame with this sequence number or a later one, without reading the frames between. The next
    /// events are those that a reader from the start finds behind the last earlier frame, without the gaps that end
    /// before `sequence`. A gap that contains the number is reported. Numbers are taken to increase through the
    /// recording.
    ///
    /// # Errors
    /// [`RecordingError`] if the recording cannot be read.
    pub fn seek_frame(&mut self, sequence: u64) -> Result<(), RecordingError> {
        with_reader!(self, reader => reader.seek_frame(sequence))
    }

    /// Seeks the first frame at or after this time on the frames' own clock (`Frame::time_ns`), s, without reading the
    /// frames between. The next events are those that a reader from the start finds behind the last earlier frame, gaps
    /// included.
    ///
    /// # Errors
    /// [`RecordingError`] if the recording cannot be read.
    pub fn seek_time_s(&mut self, time_s: f64) -> Result<(), RecordingError> {
        if let Recording::Mcap(reader) = self {
            return reader.seek_time_s(time_s);
        }
        let (count, target_ns) = (self.frame_count().unwrap_or(0), time_ns(time_s));
        self.seek_frame(first_index(count, |index| self.time_of_numbered_ns(index) >= target_ns))
    }

    /// Finds the first and the last readable frame, without reading the frames between; `None` if there is none. The
    /// next frame read is then the first one.
    ///
    /// # Errors
    /// [`RecordingError`] if the recording cannot be read.
    pub fn extent(&mut self) -> Result<Option<Extent>, RecordingError> {
        if let Recording::Mcap(reader) = self {
            return reader.extent();
        }
        self.seek_frame(0)?;
        let at = |sequence| Position { sequence, time_ns: self.time_of_numbered_ns(sequence) };
        Ok(self.whole_frames().checked_sub(1).map(|last| Extent { first: at(0), last: at(last) }))
    }

    /// Time of a frame of the vendor's formats, ns. They number frames from 0 without gaps.
    fn time_of_numbered_ns(&self, sequence: u64) -> u64 {
        match self {
            Recording::Infineon(reader) => reader.time_ns(sequence),
            Recording::Mcap(_) | Recording::Text(_) => self.waveform().frame_time_ns(sequence),
        }
    }
}

impl FrameSource for Recording {
    fn waveform(&self) -> &Waveform {
        with_reader!(self, reader => reader.waveform())
    }

    fn next_frame(&mut self, frame: &mut Frame) -> Result<SourceEvent, SourceError> {
        with_reader!(self, reader => reader.next_frame(frame))
    }

    fn frame_count(&self) -> Option<u64> {
        with_reader!(self, reader => reader.frame_count())
    }
}
