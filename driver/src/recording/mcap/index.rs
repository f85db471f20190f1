//! Positions of the chunks: from the summary at the end of a finished file, else from a scan of all records.

use std::collections::BTreeMap;

use mcap::records::{Record, op};

use super::lengths::parse_record;
use super::records::{Next, RECORD_HEADER, Records, Topic, read_chunk};
use crate::recording::{Position, RecordingError, warn_once};

/// Chunks at the end of a file that may not have reached the disk: seconds of frames.
const UNSYNCED_CHUNKS: usize = 8;

/// Footer record and magic: the end of every finished file.
pub(super) const FOOTER: u64 = RECORD_HEADER + 20 + 8;

/// Chunk of a recording.
#[derive(Debug)]
pub(super) struct Chunk {
    pub offset: u64,
    pub has_labels: bool,
    pub has_results: bool,
    /// Numbers of frames and gaps, where the message indexes were read.
    frames: u64,
    gaps: u64,
    /// First frame of the chunk, `None` until it has been looked up; `Some(None)` if no frame of the chunk can be read.
    pub first: Option<Option<Position>>,
}

impl Chunk {
    fn new(offset: u64) -> Self {
        Chunk { offset, has_labels: false, has_results: false, frames: 0, gaps: 0, first: None }
    }
}

#[derive(Debug)]
pub(super) struct Index {
    pub chunks: Vec<Chunk>,
    pub frames: u64,
    pub gaps: u64,
    /// Whether the file was finished.
    pub complete: bool,
    /// End of the readable part of an unfinished file, if that is before its end.
    pub end: Option<u64>,
}

impl Index {
    /// Returns whether a chunk starts here.
    pub fn is_chunk(&self, offset: u64) -> bool {
        self.chunks.binary_search_by_key(&offset, |chunk| chunk.offset).is_ok()
    }

    /// Finds the chunks of a file.
    pub fn read(records: &mut Records, channels: &BTreeMap<u16, Topic>) -> Result<Self, RecordingError> {
        let summary_start = summary_start(records)?;
        if let Some(start) = summary_start.filter(|start| *start > 0)
            && let Some(index) = from_summary(records, start, channels)?
        {
            return Ok(index);
        }
        let mut index = scan(records, summary_start.is_some(), channels)?;
        if summary_start.is_none() {
            index.drop_torn_end(records, channels)?;
        }
        if !index.complete && index.end.is_none() {
            warn_once(format!(
                "{}: not finished, or still being recorded: it is read up to its last whole chunk; radome recording repair makes a finished one",
                records.path.display()
            ));
        }
        index.frames = index.chunks.iter().fold(0, |sum: u64, chunk| sum.saturating_add(chunk.frames));
        index.gaps = index.chunks.iter().fold(0, |sum: u64, chunk| sum.saturating_add(chunk.gaps));
        Ok(index)
    }

    /// Ends an unfinished file before the first damaged one of its last chunks, which a power cut has kept from the
    /// disk.
    fn drop_torn_end(&mut self, records: &mut Records, channels: &BTreeMap<u16, Topic>) -> Result<(), RecordingError> {
        let mut body = Vec::new();
        for position in self.chunks.len().saturating_sub(UNSYNCED_CHUNKS)..self.chunks.len() {
            let Some(offset) = self.chunks.get(position).map(|chunk| chunk.offset) else { break };
            records.go_to(offset)?;
            let reason = match records.next(&mut body, |opcode| opcode == op::CHUNK) {
                Ok(Next::Record(op::CHUNK, at)) => match read_chunk(records, at, &body, &mut channels.clone()) {
                    Ok(_) => continue,
                    Err(RecordingError::Corrupt { reason, .. }) => reason,
                    Err(error) => return Err(error),
                },
                Ok(_) => "no chunk where there was one".into(),
                Err(RecordingError::Corrupt { reason, .. }) => reason,
                Err(error) => return Err(error),
            };
            warn_of_end(records, offset, &reason);
            self.end = Some(offset);
            self.chunks.truncate(position);
            break;
        }
        Ok(())
    }
}

/// Offset of the summary, 0 if the file has none; `None` if the file was never finished.
pub(super) fn summary_start(records: &mut Records) -> Result<Option<u64>, RecordingError> {
    let mut footer = [0; FOOTER as usize];
    let Some(at) = records.length.checked_sub(FOOTER) else { return Ok(None) };
    if records.peek(at, &mut footer)? != footer.len() {
        return Ok(None);
    }
    let ([opcode, rest @ ..], ends) = (&footer, footer.ends_with(mcap::MAGIC));
    let number = |at: usize| rest.get(at..).and_then(|b| b.first_chunk()).map_or(0, |b| u64::from_le_bytes(*b));
    Ok((ends && *opcode == op::FOOTER && number(0) == 20).then(|| number(8)))
}

/// Reads the index in the summary; `None` if it contradicts the file or itself.
fn from_summary(
    records: &mut Records,
    start: u64,
    channels: &BTreeMap<u16, Topic>,
) -> Result<Option<Index>, RecordingError> {
    if start >= records.length {
        return Ok(None);
    }
    records.go_to(start)?;
    let (mut body, mut chunks, mut statistics) = (Vec::new(), Vec::new(), None);
    let mut end = 0;
    loop {
        match records.next(&mut body, |opcode| matches!(opcode, op::CHUNK_INDEX | op::STATISTICS)) {
            Ok(Next::Record(opcode @ (op::CHUNK_INDEX | op::STATISTICS), _)) => match parse_record(opcode, &body) {
                Ok(Record::ChunkIndex(chunk)) => {
                    // The chunks must be in order and must not overlap.
                    if chunk.chunk_start_offset < end.max(8) || chunk.chunk_start_offset >= start {
                        return Ok(None);
                    }
                    end = chunk.chunk_start_offset.saturating_add(chunk.chunk_length);
                    let has = |wanted: Topic| {
                        let mut topics = chunk.message_index_offsets.keys().filter_map(|id| channels.get(id));
                        topics.any(|topic| *topic == wanted)
                    };
                    let (has_labels, has_results) = (has(Topic::Label), has(Topic::Result));
                    chunks.push(Chunk { has_labels, has_results, ..Chunk::new(chunk.chunk_start_offset) });
                }
                Ok(Record::Statistics(found)) => statistics = Some(found),
                _ => return Ok(None),
            },
            Ok(Next::Record(..)) => {}
            Ok(Next::End) => break,
            Ok(Next::CutShort) | Err(RecordingError::Corrupt { .. }) => return Ok(None),
            Err(error) => return Err(error),
        }
    }
    let Some(statistics) = statistics.filter(|s| s.chunk_count as usize == chunks.len()) else { return Ok(None) };
    let count = |topic: Topic| {
        let counts = statistics.channel_message_counts.iter().filter(|(id, _)| channels.get(id) == Some(&topic));
        counts.fold(0, |sum: u64, (_, count)| sum.saturating_add(*count))
    };
    let (frames, gaps) = (count(Topic::Frame), count(Topic::Gap));
    Ok(Some(Index { chunks, frames, gaps, complete: true, end: None }))
}

/// Scans the records of the file; the contents of chunks are skipped.
fn scan(records: &mut Records, has_footer: bool, channels: &BTreeMap<u16, Topic>) -> Result<Index, RecordingError> {
    records.go_to(8)?;
    let (mut body, mut index) =
        (Vec::new(), Index { chunks: Vec::new(), frames: 0, gaps: 0, complete: false, end: None });
    loop {
        let at = records.offset;
        let next = match records.next(&mut body, |opcode| opcode == op::MESSAGE_INDEX) {
            // The remains of the last second after a power cut need not be a record.
            Err(RecordingError::Corrupt { reason, .. }) if !has_footer => {
                warn_of_end(records, at, &reason);
                index.end = Some(at);
                return Ok(index);
            }
            next => next?,
        };
        match next {
            Next::Record(op::CHUNK, offset) => index.chunks.push(Chunk::new(offset)),
            Next::Record(op::MESSAGE_INDEX, _) => {
                let Ok(Record::MessageIndex(messages)) = parse_record(op::MESSAGE_INDEX, &body) else { continue };
                let Some(chunk) = index.chunks.last_mut() else { continue };
                match channels.get(&messages.channel_id) {
                    Some(Topic::Frame) => chunk.frames += messages.records.len() as u64,
                    Some(Topic::Label) => chunk.has_labels = true,
                    Some(Topic::Result) => chunk.has_results = true,
                    Some(Topic::Gap) => chunk.gaps += messages.records.len() as u64,
                    None => {}
                }
            }
            Next::Record(..) => {}
            Next::End => {
                index.complete = has_footer;
                return Ok(index);
            }
            Next::CutShort => return Ok(index),
        }
    }
}

fn warn_of_end(records: &Records, offset: u64, reason: &str) {
    tracing::warn!(
        "{}: never finished, and damaged at byte {offset} ({reason}): it is read up to there; radome recording repair looks for more behind it",
        records.path.display()
    );
}
