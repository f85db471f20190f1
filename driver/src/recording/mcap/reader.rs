//! Reader of native recordings.

use std::collections::VecDeque;
use std::path::Path;

use mcap::records::op;
use radome_dsp::{Frame, FrameSource, Gap, GapReason, SourceError, SourceEvent, Waveform};

use super::index::Index;
use super::records::{
    Channels, Next, Records, Topic, holds_messages, messages_at, messages_in, read_head, readable_messages_at,
};
use super::{
    FrameResult, LabelSpan, RESULTS_VERSION, RecordingHeader, apply_label_message, decode_frame, frame_position, staged,
};
use crate::recording::{Extent, Position, RecordingError, first_index, time_ns, warn_once};

/// Reason of an error where a file holds more than one recording.
pub(super) const TRAILING_DATA: &str =
    "the recording ends here, but the file goes on: with another recording, or with bytes that another program added";

/// Reader of a native recording, a [`FrameSource`].
#[derive(Debug)]
pub struct McapReader {
    records: Records,
    /// Labels beside the recording, which replace those in it.
    staged: Result<Option<Vec<LabelSpan>>, RecordingError>,
    header: RecordingHeader,
    index: Index,
    channels: Channels,
    body: Vec<u8>,
    /// Messages of the current chunk and the offset of that chunk.
    pending: VecDeque<(Topic, Vec<u8>)>,
    chunk_offset: u64,
    /// Number of the frame behind the last one that was read; `None` before the first one.
    expected_sequence: Option<u64>,
    ended: bool,
    /// Whether the reader has reported the bytes at the end of the file that it cannot read.
    has_reported_end: bool,
    /// Target of a seek, until it is found.
    seek_target: Option<SeekTarget>,
}

#[derive(Debug, Clone, Copy)]
enum SeekTarget {
    Frame(u64),
    Time { ns: u64 },
}

impl SeekTarget {
    fn is_reached(self, position: Position) -> bool {
        match self {
            SeekTarget::Frame(sequence) => position.sequence >= sequence,
            SeekTarget::Time { ns } => position.time_ns >= ns,
        }
    }

    /// Returns whether a gap ends before the frame that is sought; such a gap is not reported.
    fn is_behind(self, gap: &Gap) -> bool {
        match self {
            SeekTarget::Frame(sequence) => gap.frames > 0 && gap.first_sequence.saturating_add(gap.frames) <= sequence,
            SeekTarget::Time { .. } => false,
        }
    }
}

impl McapReader {
    /// Opens a recording. An unfinished one is read up to its last complete chunk; a gap of unknown length at its end stands for
    /// bytes behind that chunk.
    ///
    /// # Errors
    /// [`RecordingError`] if the file cannot be read, is not a native recording, or its header is damaged.
    pub fn open(path: &Path) -> Result<Self, RecordingError> {
        staged::recover(path);
        // Read before the index: the labels may be moved into the recording meanwhile.
        let staged = staged_labels(path);
        let mut records = Records::open(path)?;
        let (header, mut channels) = read_head(&mut records)?;
        let index = Index::read(&mut records, &mut channels)?;
        if let Some(end) = index.end {
            records.length = end;
        }
        records.go_to(8)?;
        Ok(McapReader {
            records,
            staged,
            header,
            index,
            channels,
            body: Vec::new(),
            pending: VecDeque::new(),
            chunk_offset: 0,
            expected_sequence: None,
            ended: false,
            has_reported_end: false,
            seek_target: None,
        })
    }

    /// Returns whether the recording was finished. An unfinished recording may lack its last chunk.
    pub fn is_complete(&self) -> bool {
        self.index.complete
    }

    /// Returns whether bytes at the end of an unfinished recording cannot be read: frames may be lost with them.
    pub fn is_cut(&self) -> bool {
        self.index.is_cut()
    }

    /// Number of frames in complete chunks.
    pub fn whole_frames(&self) -> u64 {
        self.index.frames
    }

    /// Returns the number of gaps.
    pub fn gap_count(&self) -> u64 {
        self.index.gaps
    }

    /// Returns the header of the recording.
    pub fn header(&self) -> &RecordingHeader {
        &self.header
    }

    /// Reads all labels, in the order of writing. Only chunks that hold labels are read.
    ///
    /// # Errors
    /// [`RecordingError`] if a chunk of labels or the file of staged labels cannot be read.
    pub fn labels(&self) -> Result<Vec<LabelSpan>, RecordingError> {
        let staged = match &self.staged {
            Ok(staged) => staged.clone(),
            Err(_) => staged_labels(&self.records.path)?,
        };
        if let Some(labels) = staged {
            return Ok(labels);
        }
        let mut records = Records::open(&self.records.path)?;
        let mut labels = Vec::new();
        for chunk in self.index.chunks.iter().filter(|chunk| chunk.has_labels) {
            for (topic, data) in messages_at(&mut records, chunk.offset, &mut self.channels.clone())? {
                if topic == Topic::Label {
                    apply_label_message(&data, &mut labels)
                        .map_err(|e| records.corrupt(chunk.offset, format!("a label is malformed: {e}")))?;
                }
            }
        }
        Ok(labels)
    }

    /// Returns an iterator over the results of a classifier, in the order of writing. Only chunks that hold results are
    /// read, one at a time.
    ///
    /// # Errors
    /// [`RecordingError::Io`] if the file cannot be opened again.
    pub fn results(&self) -> Result<Results, RecordingError> {
        if let Some(judge) = self.header.judge.as_ref().filter(|judge| judge.version > RESULTS_VERSION) {
            let got = format!("{} of its results", judge.version);
            return Err(RecordingError::Newer { path: self.records.path.clone(), got, supported: "1" });
        }
        let chunks: Vec<u64> = self.index.chunks.iter().filter(|c| c.has_results).map(|c| c.offset).collect();
        Ok(Results {
            records: Records::open(&self.records.path)?,
            channels: self.channels.clone(),
            chunks: chunks.into(),
            pending: VecDeque::new(),
            chunk_offset: 0,
        })
    }

    /// Seeks the first frame with this sequence number or a later one: see
    /// [`Recording::seek_frame`](crate::recording::Recording::seek_frame).
    ///
    /// # Errors
    /// [`RecordingError`] if the recording cannot be read.
    pub fn seek_frame(&mut self, sequence: u64) -> Result<(), RecordingError> {
        self.seek(SeekTarget::Frame(sequence))
    }

    /// Seeks the first frame at or after this time, s: see
    /// [`Recording::seek_time_s`](crate::recording::Recording::seek_time_s).
    ///
    /// # Errors
    /// [`RecordingError`] if the recording cannot be read.
    pub fn seek_time_s(&mut self, time_s: f64) -> Result<(), RecordingError> {
        self.seek(SeekTarget::Time { ns: time_ns(time_s) })
    }

    /// First and last frame: see [`Recording::extent`](crate::recording::Recording::extent).
    ///
    /// # Errors
    /// [`RecordingError`] if the recording cannot be read.
    pub fn extent(&mut self) -> Result<Option<Extent>, RecordingError> {
        let count = self.index.chunks.len() as u64;
        let first = (0..count).find_map(|chunk| self.first_position(chunk).transpose()).transpose()?;
        let mut last = None;
        for chunk in self.index.chunks.iter().rev() {
            let messages = readable_messages_at(&mut self.records, chunk.offset, &mut self.channels)?;
            let mut frames = messages.iter().rev().filter(|(topic, _)| *topic == Topic::Frame);
            last = frames.find_map(|(_, data)| frame_position(data));
            if last.is_some() {
                break;
            }
        }
        self.seek(SeekTarget::Frame(0))?;
        Ok(first.zip(last).map(|(first, last)| Extent { first, last }))
    }

    /// Returns the offset of the last chunk that begins before the target. The target may be in this chunk. Without such a chunk,
    /// returns the start of the records. The search is a bisection: each step reads one chunk.
    fn offset_before(&mut self, target: SeekTarget) -> Result<u64, RecordingError> {
        let count = self.index.chunks.len() as u64;
        let mut failure = None;
        // First chunk that starts at the target or behind it.
        let after = first_index(count, |middle| {
            if failure.is_some() {
                return true;
            }
            (middle..count)
                .find_map(|chunk| match self.first_position(chunk) {
                    Ok(position) => position.map(|position| target.is_reached(position)),
                    Err(error) => {
                        failure = Some(error);
                        Some(true)
                    }
                })
                .unwrap_or(true)
        });
        if let Some(error) = failure {
            return Err(error);
        }
        // Reading starts at a chunk that is where the index says. Later chunks are found by reading on.
        for chunk in (0..after).rev() {
            if self.first_position(chunk)?.is_some() {
                let known = usize::try_from(chunk).ok().and_then(|chunk| self.index.chunks.get(chunk));
                return Ok(known.map_or(8, |chunk| chunk.offset));
            }
        }
        Ok(8)
    }

    /// Seeks the end of the last frame before the target.
    fn seek(&mut self, target: SeekTarget) -> Result<(), RecordingError> {
        let start = self.offset_before(target)?;
        self.pending.clear();
        (self.ended, self.has_reported_end, self.expected_sequence) = (false, false, None);
        self.records.go_to(start)?;
        self.seek_target = Some(target);
        self.fill_pending()?;
        let is_earlier = |(topic, data): &(Topic, Vec<u8>)| {
            *topic == Topic::Frame && frame_position(data).is_some_and(|position| !target.is_reached(position))
        };
        // Behind the last earlier frame of this chunk, if it has one; gaps at its end belong to the target.
        if let Some(last) = self.pending.iter().rposition(is_earlier) {
            let skipped = self.pending.drain(..=last).next_back();
            let position = skipped.and_then(|(_, data)| frame_position(&data));
            self.expected_sequence = position.and_then(|position| position.sequence.checked_add(1));
        }
        Ok(())
    }

    /// Number and time of the first frame of a chunk; none if it has no frame or is damaged.
    fn first_position(&mut self, chunk: u64) -> Result<Option<Position>, RecordingError> {
        let Some(chunk) = usize::try_from(chunk).ok().and_then(|chunk| self.index.chunks.get_mut(chunk)) else {
            return Ok(None);
        };
        if let Some(position) = chunk.first {
            return Ok(position);
        }
        let messages = readable_messages_at(&mut self.records, chunk.offset, &mut self.channels)?;
        let first =
            messages.iter().find(|(topic, _)| *topic == Topic::Frame).and_then(|(_, data)| frame_position(data));
        chunk.first = Some(first);
        Ok(first)
    }

    /// Reads chunks until a message is pending or the file ends.
    fn fill_pending(&mut self) -> Result<(), RecordingError> {
        while !self.ended && self.pending.is_empty() {
            let end = self.records.offset;
            match self.records.next(&mut self.body, holds_messages)? {
                Next::Record(opcode, at) => {
                    self.chunk_offset = at;
                    self.pending = messages_in(&self.records, opcode, at, &self.body, &mut self.channels)?.into();
                    // A chunk whose opcode is damaged would be skipped silently.
                    if opcode != op::CHUNK && self.pending.is_empty() && self.index.is_chunk(at) {
                        let reason = "the index says that a chunk starts here, but none does";
                        return Err(self.records.corrupt(at, reason.into()));
                    }
                }
                Next::End => self.ended = true,
                Next::CutShort => {
                    self.ended = true;
                    // A file with its footer was not cut: a length is wrong.
                    if self.index.complete {
                        let reason = "a record reaches beyond the file, though the recording was finished";
                        return Err(self.records.corrupt(end, reason.into()));
                    }
                }
            }
        }
        Ok(())
    }

    pub(super) fn read_next(&mut self, frame: &mut Frame) -> Result<SourceEvent, RecordingError> {
        loop {
            self.fill_pending()?;
            let Some((topic, data)) = self.pending.pop_front() else { return self.report_end() };
            match topic {
                Topic::Label | Topic::Result => {}
                Topic::Gap => {
                    let gap: Gap = serde_json::from_slice(&data)
                        .map_err(|e| self.records.corrupt(self.chunk_offset, format!("a gap is malformed: {e}")))?;
                    self.expected_sequence = gap.first_sequence.checked_add(gap.frames);
                    if self.seek_target.is_some_and(|target| target.is_behind(&gap)) {
                        continue;
                    }
                    return Ok(SourceEvent::Gap(gap));
                }
                Topic::Frame => {
                    // If the index lacks a chunk, the seek has led to an earlier frame.
                    let position = frame_position(&data);
                    let is_earlier = |target: SeekTarget| position.is_some_and(|at| !target.is_reached(at));
                    if self.seek_target.is_some_and(is_earlier) {
                        self.expected_sequence = position.and_then(|at| at.sequence.checked_add(1));
                        continue;
                    }
                    self.seek_target = None;
                    if let (Some(expected_sequence), Some(Position { sequence, .. })) =
                        (self.expected_sequence, position)
                        && sequence != expected_sequence
                    {
                        // Other programs write such recordings. Their frames are handed out unchanged.
                        warn_once(format!(
                            "{}: the numbers of frames do not go up by one, and no gap says why: frames are missing, twice there or \
                             in another order",
                            self.records.path.display()
                        ));
                    }
                    decode_frame(&data, self.header.waveform.shape(), frame)
                        .map_err(|reason| self.records.corrupt(self.chunk_offset, reason))?;
                    self.expected_sequence = frame.sequence.checked_add(1);
                    return Ok(SourceEvent::Frame);
                }
            }
        }
    }

    /// Reports once the bytes behind the last chunk, then the end of the recording.
    fn report_end(&mut self) -> Result<SourceEvent, RecordingError> {
        if std::mem::replace(&mut self.has_reported_end, true) {
            return Ok(SourceEvent::End);
        }
        if let Some(at) = self.index.trailing_data_offset {
            return Err(self.records.corrupt(at, TRAILING_DATA.into()));
        }
        Ok(match self.index.is_cut() {
            true => SourceEvent::Gap(Gap {
                first_sequence: self.expected_sequence.unwrap_or(0),
                frames: 0,
                reason: GapReason::Recorded,
            }),
            false => SourceEvent::End,
        })
    }
}

fn staged_labels(path: &Path) -> Result<Option<Vec<LabelSpan>>, RecordingError> {
    Ok(staged::read(path)?.map(|staged| staged.labels))
}

impl FrameSource for McapReader {
    fn waveform(&self) -> &Waveform {
        &self.header.waveform
    }

    fn next_frame(&mut self, frame: &mut Frame) -> Result<SourceEvent, SourceError> {
        Ok(self.read_next(frame)?)
    }

    fn frame_count(&self) -> Option<u64> {
        Some(self.whole_frames())
    }
}

/// Iterator over the results of a recording; a damaged chunk gives an error and ends the iteration.
#[derive(Debug)]
pub struct Results {
    records: Records,
    channels: Channels,
    /// Offsets of the chunks that are still to be read.
    chunks: VecDeque<u64>,
    pending: VecDeque<(Topic, Vec<u8>)>,
    chunk_offset: u64,
}

impl Results {
    fn read_next(&mut self) -> Result<Option<FrameResult>, RecordingError> {
        loop {
            while let Some((topic, data)) = self.pending.pop_front() {
                if topic == Topic::Result {
                    return parse_result(&data).map(Some).map_err(|e| self.records.corrupt(self.chunk_offset, e));
                }
            }
            let Some(offset) = self.chunks.pop_front() else { return Ok(None) };
            self.chunk_offset = offset;
            self.pending = messages_at(&mut self.records, offset, &mut self.channels)?.into();
        }
    }
}

impl Iterator for Results {
    type Item = Result<FrameResult, RecordingError>;

    fn next(&mut self) -> Option<Self::Item> {
        let next = self.read_next().transpose();
        if matches!(next, Some(Err(_))) {
            self.chunks.clear();
            self.pending.clear();
        }
        next
    }
}

/// Parses a result from a message; the error describes the reason.
pub(super) fn parse_result(data: &[u8]) -> Result<FrameResult, String> {
    serde_json::from_slice(data).map_err(|e| format!("a result is malformed: {e}"))
}
