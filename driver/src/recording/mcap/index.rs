//! Positions of the chunks: from the summary at the end of a finished file, else from a scan of all records.

use crc32fast::Hasher;
use mcap::records::{ChunkIndex, Record, Statistics, op};

use super::encode::{FOOTER_BODY_BYTES, is_intact};
use super::lengths::parse_record;
use super::records::{
    Channels, Next, RECORD_HEADER, Records, Topic, holds_messages, messages_in, readable_messages_at, topic,
};
use crate::recording::{Position, RecordingError, warn_once};

/// Chunks at the end of a file that may not have reached the disk: seconds of frames.
const UNSYNCED_CHUNKS: usize = 8;

/// Footer record and magic: the end of every finished file.
pub(super) const FOOTER: u64 = RECORD_HEADER + FOOTER_BODY_BYTES + 8;

/// Chunk of a recording, or a message that another program has written without a chunk.
#[derive(Debug)]
pub(super) struct Chunk {
    pub offset: u64,
    pub has_labels: bool,
    pub has_results: bool,
    /// Numbers of frames and gaps, where the file was scanned.
    frames: u64,
    gaps: u64,
    /// First frame of the chunk, `None` until it has been looked up; `Some(None)` if no frame of the chunk can be read.
    pub first: Option<Option<Position>>,
}

impl Chunk {
    fn new(offset: u64) -> Self {
        Chunk { offset, has_labels: false, has_results: false, frames: 0, gaps: 0, first: None }
    }

    fn count(&mut self, topic: Topic, messages: u64) {
        match topic {
            Topic::Frame => self.frames += messages,
            Topic::Gap => self.gaps += messages,
            Topic::Label => self.has_labels = true,
            Topic::Result => self.has_results = true,
        }
    }
}

/// Positions of all chunks of a recording.
#[derive(Debug, Default)]
pub(super) struct Index {
    pub chunks: Vec<Chunk>,
    pub frames: u64,
    pub gaps: u64,
    /// Whether the file was finished.
    pub complete: bool,
    /// End of the readable part of an unfinished file, if that is before its end.
    pub end: Option<u64>,
    /// Whether an unfinished file ends within a record.
    pub ends_within_record: bool,
    /// End of the recording, if other data follow in the file.
    pub trailing_data_offset: Option<u64>,
}

impl Index {
    /// Returns whether bytes at the end of an unfinished file cannot be read, so that frames may be lost with them.
    pub fn is_cut(&self) -> bool {
        self.ends_within_record || self.end.is_some()
    }

    /// Returns whether a chunk starts here.
    pub fn is_chunk(&self, offset: u64) -> bool {
        self.chunks.binary_search_by_key(&offset, |chunk| chunk.offset).is_ok()
    }

    /// Finds the chunks of a file, and the channels that its first chunk does not name.
    pub fn read(records: &mut Records, channels: &mut Channels) -> Result<Self, RecordingError> {
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
        if let Some(end) = index.trailing_data_offset {
            warn_once(format!(
                "{}: the recording ends at byte {end}, but the file goes on; radome recording repair saves the recording",
                records.path.display()
            ));
        }
        index.frames = index.chunks.iter().fold(0, |sum: u64, chunk| sum.saturating_add(chunk.frames));
        index.gaps = index.chunks.iter().fold(0, |sum: u64, chunk| sum.saturating_add(chunk.gaps));
        Ok(index)
    }

    /// Ends an unfinished file before the first damaged one of its last chunks, which a power cut has kept from the
    /// disk.
    fn drop_torn_end(&mut self, records: &mut Records, channels: &Channels) -> Result<(), RecordingError> {
        let mut body = Vec::new();
        for position in self.chunks.len().saturating_sub(UNSYNCED_CHUNKS)..self.chunks.len() {
            let Some(offset) = self.chunks.get(position).map(|chunk| chunk.offset) else { break };
            records.go_to(offset)?;
            let reason = match records.next(&mut body, holds_messages) {
                Ok(Next::Record(opcode, at)) if holds_messages(opcode) => {
                    match messages_in(records, opcode, at, &body, &mut channels.clone()) {
                        Ok(_) => continue,
                        Err(RecordingError::Corrupt { reason, .. }) => reason,
                        Err(error) => return Err(error),
                    }
                }
                Ok(_) => "no chunk where there was one".into(),
                Err(RecordingError::Corrupt { reason, .. }) => reason,
                Err(error) => return Err(error),
            };
            warn_of_damaged_end(records, offset, &reason);
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
    let ([opcode, rest @ ..], has_magic) = (&footer, footer.ends_with(mcap::MAGIC));
    let number = |at: usize| rest.get(at..).and_then(|b| b.first_chunk()).map_or(0, |b| u64::from_le_bytes(*b));
    Ok((has_magic && *opcode == op::FOOTER && number(0) == 20).then(|| number(8)))
}

/// Reads the index in the summary; `None` if it is damaged, contradicts the file or itself, or does not name all
/// channels.
fn from_summary(records: &mut Records, start: u64, channels: &mut Channels) -> Result<Option<Index>, RecordingError> {
    if start >= records.length {
        return Ok(None);
    }
    records.go_to(start)?;
    let (mut body, mut crc) = (Vec::new(), Hasher::new());
    let mut summary = SummaryIndex::new(start, channels.clone());
    loop {
        match records.next(&mut body, |_| true) {
            Ok(Next::Record(opcode, _)) => {
                crc.update(&[opcode]);
                crc.update(&(body.len() as u64).to_le_bytes());
                crc.update(&body);
                if !summary.add(opcode, &body) {
                    return Ok(None);
                }
            }
            Ok(Next::End) => break,
            Ok(Next::CutShort) | Err(RecordingError::Corrupt { .. }) => return Ok(None),
            Err(error) => return Err(error),
        }
    }
    // The summary may be that of another recording in the file.
    let (mut footer, footer_at) = ([0; FOOTER as usize], records.length.saturating_sub(FOOTER));
    if records.offset != footer_at {
        return Ok(None);
    }
    records.peek(footer_at, &mut footer)?;
    if !is_intact(crc, &footer) {
        return Ok(None);
    }
    let Some((frames, gaps)) = summary.frames_and_gaps() else { return Ok(None) };
    *channels = summary.channels;
    Ok(Some(Index { chunks: summary.chunks, frames, gaps, complete: true, ..Index::default() }))
}

/// Index in a summary, as far as its records have been read.
struct SummaryIndex {
    /// Offset of the summary in the file.
    start: u64,
    channels: Channels,
    chunks: Vec<Chunk>,
    /// Offset behind the last chunk.
    chunks_end: u64,
    /// Time of the first message in the chunks, ns.
    first_ns: Option<u64>,
    statistics: Option<Statistics>,
}

impl SummaryIndex {
    /// Creates an empty index; `channels` are those that the file has named before it.
    fn new(start: u64, channels: Channels) -> Self {
        // The chunks stand behind the magic.
        SummaryIndex { start, channels, chunks: Vec::new(), chunks_end: 8, first_ns: None, statistics: None }
    }

    /// Adds a record; returns `false` if it is damaged, or contradicts the file or an earlier record.
    fn add(&mut self, opcode: u8, body: &[u8]) -> bool {
        if !matches!(opcode, op::CHANNEL | op::CHUNK_INDEX | op::STATISTICS) {
            return true;
        }
        match parse_record(opcode, body) {
            Ok(Record::Channel(channel)) => {
                let topic = topic(&channel.topic);
                self.channels.insert(channel.id, topic).is_none_or(|other| other == topic)
            }
            Ok(Record::ChunkIndex(index)) => self.add_chunk(&index),
            Ok(Record::Statistics(statistics)) => {
                self.statistics = Some(statistics);
                true
            }
            _ => false,
        }
    }

    /// Adds a chunk; returns `false` if it is out of order, overlaps another one, or has a channel that is not named.
    fn add_chunk(&mut self, index: &ChunkIndex) -> bool {
        let offset = index.chunk_start_offset;
        if offset < self.chunks_end || offset >= self.start {
            return false;
        }
        self.chunks_end = offset.saturating_add(index.chunk_length);
        // The recorder's first chunk holds channels alone, and has no time.
        if !index.message_index_offsets.is_empty() {
            let start_ns = index.message_start_time;
            self.first_ns = Some(self.first_ns.map_or(start_ns, |first| first.min(start_ns)));
        }
        let mut chunk = Chunk::new(offset);
        for id in index.message_index_offsets.keys() {
            let Some(topic) = self.channels.get(id) else { return false };
            chunk.has_labels |= *topic == Some(Topic::Label);
            chunk.has_results |= *topic == Some(Topic::Result);
        }
        self.chunks.push(chunk);
        true
    }

    /// Returns the numbers of frames and gaps by the statistics; `None` if these are absent or contradict the chunks.
    fn frames_and_gaps(&self) -> Option<(u64, u64)> {
        let statistics = self.statistics.as_ref().filter(|s| s.chunk_count as usize == self.chunks.len())?;
        let counts = &statistics.channel_message_counts;
        let count = |wanted: Option<Topic>| {
            let counts = counts.iter().filter(|(id, _)| self.channels.get(id).copied().flatten() == wanted);
            counts.fold(0, |sum: u64, (_, count)| sum.saturating_add(*count))
        };
        let [frames, gaps, labels, results] =
            [Topic::Frame, Topic::Gap, Topic::Label, Topic::Result].map(|topic| count(Some(topic)));
        let total = [gaps, labels, results, count(None)].into_iter().fold(frames, u64::saturating_add);
        // The counts disagree if messages are outside of chunks, or chunks lack an index of their messages.
        let is_consistent = counts.keys().all(|id| self.channels.contains_key(id))
            && total == statistics.message_count
            && (total == 0 || !self.chunks.is_empty())
            && self.first_ns.is_none_or(|first| first == statistics.message_start_time)
            && (labels > 0) == self.chunks.iter().any(|chunk| chunk.has_labels)
            && (results > 0) == self.chunks.iter().any(|chunk| chunk.has_results);
        is_consistent.then_some((frames, gaps))
    }
}

/// Source of the counts of a chunk.
#[derive(Clone, Copy, PartialEq, Eq)]
enum CountSource {
    /// The chunk is not counted yet.
    None,
    ByIndexes,
    ByContent,
}

/// Scans the records of the file. The content of a chunk is skipped if it has indexes of its messages.
fn scan(records: &mut Records, has_footer: bool, channels: &mut Channels) -> Result<Index, RecordingError> {
    records.go_to(8)?;
    let mut body = Vec::new();
    // There is no chunk yet.
    let mut scan = Scan { records, channels, index: Index::default(), count_source: CountSource::ByContent };
    loop {
        let at = scan.records.offset;
        let wanted = |opcode: u8| matches!(opcode, op::MESSAGE_INDEX | op::CHANNEL | op::MESSAGE);
        let next = match scan.records.next(&mut body, wanted) {
            // The remains of the last second after a power cut need not be a record.
            Err(RecordingError::Corrupt { reason, .. }) if !has_footer => {
                warn_of_damaged_end(scan.records, at, &reason);
                scan.index.end = Some(at);
                Next::CutShort
            }
            next => next?,
        };
        // The last chunk ends without an index of its messages.
        if scan.count_source == CountSource::None && !matches!(next, Next::Record(op::MESSAGE_INDEX, _)) {
            scan.count_content()?;
        }
        match next {
            Next::Record(op::CHUNK, offset) => {
                scan.index.chunks.push(Chunk::new(offset));
                scan.count_source = CountSource::None;
            }
            Next::Record(op::MESSAGE_INDEX, _) if scan.count_source != CountSource::ByContent => {
                scan.count_indexed(&body)?;
            }
            Next::Record(opcode @ (op::CHANNEL | op::MESSAGE), offset) => scan.add_unchunked(opcode, offset, &body),
            Next::Record(..) => {}
            Next::End => {
                scan.index.complete = has_footer;
                scan.index.trailing_data_offset = end_before_file(scan.records, at)?;
                return Ok(scan.index);
            }
            Next::CutShort => {
                scan.index.ends_within_record = at < scan.records.length;
                return Ok(scan.index);
            }
        }
    }
}

/// Scan of a file, with what has been found so far.
struct Scan<'a> {
    records: &'a mut Records,
    channels: &'a mut Channels,
    index: Index,
    /// Source of the counts of the last chunk.
    count_source: CountSource,
}

impl Scan<'_> {
    /// Counts the messages of the last chunk by its content, which also names their channels. A damaged chunk has none.
    fn count_content(&mut self) -> Result<(), RecordingError> {
        let Some(chunk) = self.index.chunks.last_mut() else { return Ok(()) };
        let next = self.records.offset;
        *chunk = Chunk::new(chunk.offset);
        for (topic, _) in readable_messages_at(self.records, chunk.offset, self.channels)? {
            chunk.count(topic, 1);
        }
        self.count_source = CountSource::ByContent;
        self.records.go_to(next)
    }

    /// Counts messages of the last chunk by the body of their index.
    fn count_indexed(&mut self, body: &[u8]) -> Result<(), RecordingError> {
        let Ok(Record::MessageIndex(messages)) = parse_record(op::MESSAGE_INDEX, body) else { return Ok(()) };
        let Some(topic) = self.channels.get(&messages.channel_id) else {
            // The chunk itself names the channel, or the index is damaged.
            return self.count_content();
        };
        if let (Some(topic), Some(chunk)) = (topic, self.index.chunks.last_mut()) {
            chunk.count(*topic, messages.records.len() as u64);
        }
        self.count_source = CountSource::ByIndexes;
        Ok(())
    }

    /// Adds a channel or a message outside of chunks. A damaged message is an error where it is read.
    fn add_unchunked(&mut self, opcode: u8, offset: u64, body: &[u8]) {
        for (topic, _) in messages_in(self.records, opcode, offset, body, self.channels).unwrap_or_default() {
            let mut message = Chunk::new(offset);
            message.count(topic, 1);
            self.index.chunks.push(message);
            self.count_source = CountSource::ByContent;
        }
    }
}

/// End of the recording whose data end at `data_end`, if the file goes on behind it: two recordings in one file, or bytes that
/// another program added. `None` if the recording ends with the file, or its summary is cut.
pub(super) fn end_before_file(records: &mut Records, data_end: u64) -> Result<Option<u64>, RecordingError> {
    let mut at = data_end;
    loop {
        let mut header = [0; RECORD_HEADER as usize];
        if at >= records.length || records.peek(at, &mut header)? != header.len() {
            return Ok(None);
        }
        let [opcode, length @ ..] = header;
        let Some(next) = at.checked_add(RECORD_HEADER).and_then(|at| at.checked_add(u64::from_le_bytes(length))) else {
            return Ok(None);
        };
        at = next;
        if opcode == op::FOOTER {
            let mut magic = [0; mcap::MAGIC.len()];
            let is_end = at < records.length && records.peek(at, &mut magic)? == magic.len() && magic == *mcap::MAGIC;
            let end = at + magic.len() as u64;
            return Ok((is_end && end < records.length).then_some(end));
        }
    }
}

/// Logs that an unfinished file is damaged from this offset on.
fn warn_of_damaged_end(records: &Records, offset: u64, reason: &str) {
    tracing::warn!(
        "{}: never finished, and damaged at byte {offset} ({reason}): it is read up to there; radome recording repair looks for more behind it",
        records.path.display()
    );
}
