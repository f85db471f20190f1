//! An opened recording of any kind, with what a mere source of frames cannot do: seek, tell its labels.

use std::fs::File;
use std::io::Read;
use std::path::Path;

use radome_dsp::{Frame, FrameSource, SourceError, SourceEvent, Waveform};

use super::infineon::InfineonReader;
use super::mcap::{LabelSpan, McapReader, RecordingHeader, Results};
use super::text::TextReader;
use super::{Extent, RecordingError};

/// An opened recording.
#[derive(Debug)]
pub enum Recording {
    /// The native MCAP file.
    Mcap(Box<McapReader>),
    /// The vendor's folder.
    Infineon(Box<InfineonReader>),
    /// The vendor's text file.
    Text(Box<TextReader>),
}

impl Recording {
    /// Opens a recording: what it is, its content says.
    pub fn open(path: &Path) -> Result<Self, RecordingError> {
        let metadata = std::fs::metadata(path).map_err(RecordingError::io(path, "cannot be opened"))?;
        if metadata.is_dir() {
            return Ok(Recording::Infineon(Box::new(InfineonReader::open(path)?)));
        }
        let mut magic = [0; 8];
        let mut file = File::open(path).map_err(RecordingError::io(path, "cannot be opened"))?;
        if file.read_exact(&mut magic).is_ok() && magic == *::mcap::MAGIC {
            return Ok(Recording::Mcap(Box::new(McapReader::open(path)?)));
        }
        if super::text::config_path(path).is_some() {
            return Ok(Recording::Text(Box::new(TextReader::open(path)?)));
        }
        Err(RecordingError::Unknown { path: path.to_owned() })
    }

    /// What holds for the whole recording; the vendor's formats know the waveform alone.
    pub fn header(&self) -> RecordingHeader {
        match self {
            Recording::Mcap(reader) => reader.header().clone(),
            other => RecordingHeader::new(other.waveform().clone()),
        }
    }

    /// All labels; the vendor's formats have none.
    pub fn labels(&self) -> Result<Vec<LabelSpan>, RecordingError> {
        match self {
            Recording::Mcap(reader) => reader.labels(),
            Recording::Infineon(_) | Recording::Text(_) => Ok(Vec::new()),
        }
    }

    /// What was said about the frames; the vendor's formats cannot hold it.
    pub fn results(&self) -> Result<Option<Results>, RecordingError> {
        match self {
            Recording::Mcap(reader) => reader.results().map(Some),
            Recording::Infineon(_) | Recording::Text(_) => Ok(None),
        }
    }

    /// Goes to the first frame with this sequence number or a later one, without reading what lies between. What comes
    /// next is what a reader from the start finds behind the last earlier frame, less the gaps that end before
    /// `sequence`: a gap that the number falls into is reported. Numbers are taken to increase through the recording.
    pub fn seek_frame(&mut self, sequence: u64) -> Result<(), RecordingError> {
        match self {
            Recording::Mcap(reader) => reader.seek_frame(sequence),
            Recording::Infineon(reader) => reader.seek_frame(sequence),
            Recording::Text(reader) => reader.seek_frame(sequence),
        }
    }

    /// Goes to the first frame at or after this time on the frames' own clock (`Frame::time_ns`), s, without reading what
    /// lies between. What comes next is what a reader from the start finds behind the last earlier frame: the gaps
    /// before the frame too.
    pub fn seek_time_s(&mut self, time_s: f64) -> Result<(), RecordingError> {
        match self {
            Recording::Mcap(reader) => reader.seek_time_s(time_s),
            Recording::Infineon(reader) => reader.seek_time_s(time_s),
            Recording::Text(reader) => reader.seek_time_s(time_s),
        }
    }

    /// First and last frame that can be read, without reading what lies between; `None` if there is none. Reading then starts
    /// anew.
    pub fn extent(&mut self) -> Result<Option<Extent>, RecordingError> {
        match self {
            Recording::Mcap(reader) => reader.extent(),
            Recording::Infineon(reader) => reader.extent(),
            Recording::Text(reader) => reader.extent(),
        }
    }

    fn source(&mut self) -> &mut dyn FrameSource {
        match self {
            Recording::Mcap(reader) => reader.as_mut(),
            Recording::Infineon(reader) => reader.as_mut(),
            Recording::Text(reader) => reader.as_mut(),
        }
    }
}

impl FrameSource for Recording {
    fn waveform(&self) -> &Waveform {
        match self {
            Recording::Mcap(reader) => reader.waveform(),
            Recording::Infineon(reader) => reader.waveform(),
            Recording::Text(reader) => reader.waveform(),
        }
    }

    fn next_frame(&mut self, frame: &mut Frame) -> Result<SourceEvent, SourceError> {
        self.source().next_frame(frame)
    }

    fn frame_count(&self) -> Option<u64> {
        match self {
            Recording::Mcap(reader) => reader.frame_count(),
            Recording::Infineon(reader) => reader.frame_count(),
            Recording::Text(reader) => reader.frame_count(),
        }
    }
}
