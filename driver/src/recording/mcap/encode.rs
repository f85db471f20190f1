//! Encoders of records: chunks with their message indexes, and the summary.

use std::collections::BTreeMap;
use std::io::{self, Write};

use crc32fast::Hasher;
use mcap::records::{ChunkIndex, MessageHeader, Statistics, op};

/// Compression level of chunks: fast enough for the frames of a board.
const COMPRESSION_LEVEL: i32 = 1;
const COMPRESSION: &str = "zstd";
/// Length of the body of a footer: two offsets and a CRC.
pub(super) const FOOTER_BODY_BYTES: u64 = 20;

/// Appends a record.
pub(super) fn record(out: &mut Vec<u8>, opcode: u8, body: &[u8]) {
    out.push(opcode);
    out.extend((body.len() as u64).to_le_bytes());
    out.extend_from_slice(body);
}

/// Appends a length and a text.
pub(super) fn string(out: &mut Vec<u8>, text: &str) {
    out.extend((text.len() as u32).to_le_bytes());
    out.extend_from_slice(text.as_bytes());
}

/// Appends a map from channels to numbers.
fn channel_map(out: &mut Vec<u8>, entries: &BTreeMap<u16, u64>) {
    out.extend((10 * entries.len() as u32).to_le_bytes());
    for (key, value) in entries {
        out.extend(key.to_le_bytes());
        out.extend(value.to_le_bytes());
    }
}

/// Body of a header record: no profile, and the program that writes the file.
pub(super) fn header_body(library: &str) -> Vec<u8> {
    let mut out = Vec::new();
    string(&mut out, "");
    string(&mut out, library);
    out
}

pub(super) fn metadata_body(name: &str, fields: &BTreeMap<String, String>) -> Vec<u8> {
    let mut pairs = Vec::new();
    for (key, value) in fields {
        string(&mut pairs, key);
        string(&mut pairs, value);
    }
    let mut out = Vec::new();
    string(&mut out, name);
    out.extend((pairs.len() as u32).to_le_bytes());
    out.extend(pairs);
    out
}

/// Body of the record that holds the position of metadata.
pub(super) fn metadata_index_body(offset: u64, length: u64, name: &str) -> Vec<u8> {
    let mut out = [offset.to_le_bytes(), length.to_le_bytes()].concat();
    string(&mut out, name);
    out
}

pub(super) fn schema_body(id: u16, name: &str, encoding: &str, data: &str) -> Vec<u8> {
    let mut out = id.to_le_bytes().to_vec();
    string(&mut out, name);
    string(&mut out, encoding);
    string(&mut out, data);
    out
}

/// Body of a channel record; schema 0 stands for none.
pub(super) fn channel_body(id: u16, schema: u16, topic: &str, encoding: &str) -> Vec<u8> {
    let mut out = [id.to_le_bytes(), schema.to_le_bytes()].concat();
    string(&mut out, topic);
    string(&mut out, encoding);
    // The channel has no metadata.
    out.extend([0u8; 4]);
    out
}

pub(super) fn statistics_body(statistics: &Statistics) -> Vec<u8> {
    let mut out = statistics.message_count.to_le_bytes().to_vec();
    out.extend(statistics.schema_count.to_le_bytes());
    for count in
        [statistics.channel_count, statistics.attachment_count, statistics.metadata_count, statistics.chunk_count]
    {
        out.extend(count.to_le_bytes());
    }
    out.extend(statistics.message_start_time.to_le_bytes());
    out.extend(statistics.message_end_time.to_le_bytes());
    channel_map(&mut out, &statistics.channel_message_counts);
    out
}

pub(super) fn chunk_index_body(index: &ChunkIndex) -> Vec<u8> {
    let mut out = Vec::new();
    for number in [index.message_start_time, index.message_end_time, index.chunk_start_offset, index.chunk_length] {
        out.extend(number.to_le_bytes());
    }
    channel_map(&mut out, &index.message_index_offsets);
    out.extend(index.message_index_length.to_le_bytes());
    string(&mut out, &index.compression);
    out.extend(index.compressed_size.to_le_bytes());
    out.extend(index.uncompressed_size.to_le_bytes());
    out
}

/// Chunk that compresses its records as they come.
pub(super) struct Chunk {
    encoder: zstd::Encoder<'static, Vec<u8>>,
    crc: Hasher,
    /// Length without compression, bytes.
    length: u64,
    /// Log times of the first and the last message.
    times: Option<(u64, u64)>,
    /// Entries of the message index of each channel: log time and offset, as bytes.
    messages: BTreeMap<u16, Vec<u8>>,
}

impl Chunk {
    /// Starts an empty chunk.
    pub fn new() -> io::Result<Self> {
        let encoder = zstd::Encoder::new(Vec::new(), COMPRESSION_LEVEL)?;
        Ok(Chunk { encoder, crc: Hasher::new(), length: 0, times: None, messages: BTreeMap::new() })
    }

    /// Returns whether the chunk holds no record yet.
    pub fn is_empty(&self) -> bool {
        self.length == 0
    }

    fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.crc.update(bytes);
        self.length += bytes.len() as u64;
        self.encoder.write_all(bytes)
    }

    /// Adds a record whose body consists of these parts.
    pub fn record(&mut self, opcode: u8, parts: &[&[u8]]) -> io::Result<()> {
        let length = parts.iter().map(|part| part.len() as u64).sum::<u64>();
        self.write(&[opcode])?;
        self.write(&length.to_le_bytes())?;
        parts.iter().try_for_each(|part| self.write(part))
    }

    /// Adds a message.
    pub fn message(&mut self, header: &MessageHeader, data: &[u8]) -> io::Result<()> {
        let MessageHeader { channel_id, sequence, log_time, publish_time } = *header;
        let entries = self.messages.entry(channel_id).or_default();
        entries.extend(log_time.to_le_bytes());
        entries.extend(self.length.to_le_bytes());
        let (first, last) = self.times.unwrap_or((log_time, log_time));
        self.times = Some((first.min(log_time), last.max(log_time)));
        let (id, number) = (channel_id.to_le_bytes(), sequence.to_le_bytes());
        let (log_time, publish_time) = (log_time.to_le_bytes(), publish_time.to_le_bytes());
        self.record(op::MESSAGE, &[id.as_slice(), number.as_slice(), &log_time, &publish_time, data])
    }

    /// Appends the chunk and its message indexes to `out`, whose first byte has the offset `start` in the file. Returns
    /// its entry in the index of chunks.
    ///
    /// # Errors
    /// The compressor fails; `out` is then as it was.
    pub fn finish(self, out: &mut Vec<u8>, start: u64) -> io::Result<ChunkIndex> {
        let Chunk { encoder, crc, length, times, messages } = self;
        let compressed = encoder.finish()?;
        let (first, last) = times.unwrap_or((0, 0));
        let mut header = [first.to_le_bytes(), last.to_le_bytes(), length.to_le_bytes()].concat();
        header.extend(crc.finalize().to_le_bytes());
        string(&mut header, COMPRESSION);
        header.extend((compressed.len() as u64).to_le_bytes());

        let chunk_start_offset = start + out.len() as u64;
        out.push(op::CHUNK);
        out.extend(((header.len() + compressed.len()) as u64).to_le_bytes());
        out.extend_from_slice(&header);
        out.extend_from_slice(&compressed);
        let chunk_end = start + out.len() as u64;
        let mut message_index_offsets = BTreeMap::new();
        for (channel, entries) in messages {
            message_index_offsets.insert(channel, start + out.len() as u64);
            let mut body = channel.to_le_bytes().to_vec();
            body.extend((entries.len() as u32).to_le_bytes());
            body.extend(entries);
            record(out, op::MESSAGE_INDEX, &body);
        }
        Ok(ChunkIndex {
            message_start_time: first,
            message_end_time: last,
            chunk_start_offset,
            chunk_length: chunk_end - chunk_start_offset,
            message_index_offsets,
            message_index_length: start + out.len() as u64 - chunk_end,
            compression: COMPRESSION.to_owned(),
            compressed_size: compressed.len() as u64,
            uncompressed_size: length,
        })
    }
}

/// Returns whether the CRC in `footer` is that of the summary, or 0, which stands for none. `crc` is that of the summary's
/// records; the start of the footer is added here. Files by earlier versions have none.
pub(super) fn is_intact(mut crc: Hasher, footer: &[u8]) -> bool {
    // Opcode, length and two offsets stand before the CRC.
    let (covered, rest) = footer.split_at(footer.len().min(25));
    crc.update(covered);
    rest.first_chunk::<4>().is_some_and(|stated| *stated == [0; 4] || *stated == crc.finalize().to_le_bytes())
}

/// Records of one kind in a summary.
struct RecordGroup {
    opcode: u8,
    /// Offset in the file.
    start: u64,
    /// Length, bytes.
    length: u64,
}

/// Layout of a summary: positions of its records, kind by kind, and their CRC. It holds no record itself.
pub(super) struct SummaryLayout {
    /// Offset of the first record in the file.
    start: u64,
    /// Offset of the next record.
    end: u64,
    /// Records of each kind.
    groups: Vec<RecordGroup>,
    crc: Hasher,
}

impl SummaryLayout {
    /// Creates the layout of a summary whose first record has this offset in the file.
    pub fn new(start: u64) -> Self {
        SummaryLayout { start, end: start, groups: Vec::new(), crc: Hasher::new() }
    }

    /// Appends a record to `out`, which ends where the summary ends so far.
    pub fn record(&mut self, out: &mut Vec<u8>, opcode: u8, body: &[u8]) {
        let record_start = out.len();
        record(out, opcode, body);
        self.add(opcode, out.get(record_start..).unwrap_or(&[]));
    }

    /// Counts bytes of records of a kind that the caller writes itself.
    pub fn add(&mut self, opcode: u8, records: &[u8]) {
        let length = records.len() as u64;
        self.crc.update(records);
        match self.groups.last_mut().filter(|group| group.opcode == opcode) {
            Some(group) => group.length += length,
            None => self.groups.push(RecordGroup { opcode, start: self.end, length }),
        }
        self.end += length;
    }

    /// Appends the offsets of the kinds to `out`. Returns the end of the file: the footer and the magic.
    pub fn finish(self, out: &mut Vec<u8>) -> Vec<u8> {
        let SummaryLayout { start, end, groups, mut crc } = self;
        let offsets_start = out.len();
        for RecordGroup { opcode, start, length } in groups {
            let body = [&[opcode][..], &start.to_le_bytes(), &length.to_le_bytes()].concat();
            record(out, op::SUMMARY_OFFSET, &body);
        }
        crc.update(out.get(offsets_start..).unwrap_or(&[]));
        // The CRC covers the footer too, up to the CRC itself.
        let mut footer = vec![op::FOOTER];
        footer.extend(FOOTER_BODY_BYTES.to_le_bytes());
        footer.extend(start.to_le_bytes());
        footer.extend(end.to_le_bytes());
        crc.update(&footer);
        footer.extend(crc.finalize().to_le_bytes());
        footer.extend_from_slice(mcap::MAGIC);
        footer
    }
}
