//! Encoders of records: chunks with their message indexes, and the summary.

use std::collections::BTreeMap;
use std::io::{self, Cursor, Write};

use binrw::{BinWrite, Endian};
use crc32fast::Hasher;
use mcap::records::{ChunkHeader, ChunkIndex, MessageHeader, MessageIndex, MessageIndexEntry, SummaryOffset, op};

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

/// Encodes the body of a record.
pub(super) fn body_of<T: BinWrite<Args<'static> = ()>>(record: &T) -> Vec<u8> {
    let mut out = Cursor::new(Vec::new());
    // Writing to memory does not fail.
    let _ = record.write_options(&mut out, Endian::Little, ());
    out.into_inner()
}

/// Chunk that compresses its records as they come.
pub(super) struct Chunk {
    encoder: zstd::Encoder<'static, Vec<u8>>,
    crc: Hasher,
    /// Length without compression, bytes.
    length: u64,
    /// Log times of the first and the last message.
    times: Option<(u64, u64)>,
    /// Entries of the message index of each channel.
    messages: BTreeMap<u16, Vec<MessageIndexEntry>>,
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
        let entry = MessageIndexEntry { log_time, offset: self.length };
        self.messages.entry(channel_id).or_default().push(entry);
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
        let header = body_of(&ChunkHeader {
            message_start_time: first,
            message_end_time: last,
            uncompressed_size: length,
            uncompressed_crc: crc.finalize(),
            compression: COMPRESSION.to_owned(),
            compressed_size: compressed.len() as u64,
        });
        let chunk_start_offset = start + out.len() as u64;
        out.push(op::CHUNK);
        out.extend(((header.len() + compressed.len()) as u64).to_le_bytes());
        out.extend_from_slice(&header);
        out.extend_from_slice(&compressed);
        let chunk_end = start + out.len() as u64;
        let mut message_index_offsets = BTreeMap::new();
        for (channel_id, records) in messages {
            message_index_offsets.insert(channel_id, start + out.len() as u64);
            record(out, op::MESSAGE_INDEX, &body_of(&MessageIndex { channel_id, records }));
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

/// Layout of a summary: positions of its records, kind by kind, and their CRC. It holds no record itself.
pub(super) struct SummaryLayout {
    /// Offset of the first record in the file.
    start: u64,
    /// Offset of the next record.
    end: u64,
    /// Records of each kind.
    groups: Vec<SummaryOffset>,
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
        match self.groups.last_mut().filter(|group| group.group_opcode == opcode) {
            Some(group) => group.group_length += length,
            None => {
                self.groups.push(SummaryOffset { group_opcode: opcode, group_start: self.end, group_length: length })
            }
        }
        self.end += length;
    }

    /// Appends the offsets of the kinds to `out`. Returns the end of the file: the footer and the magic.
    pub fn finish(self, out: &mut Vec<u8>) -> Vec<u8> {
        let SummaryLayout { start, end, groups, mut crc } = self;
        let offsets_start = out.len();
        for group in groups {
            record(out, op::SUMMARY_OFFSET, &body_of(&group));
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
