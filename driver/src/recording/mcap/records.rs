//! Sequential reader of records. It knows their offsets and also reads unfinished files.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use mcap::records::{Record, op};
use radome_dsp::Waveform;
use serde::de::DeserializeOwned;

use super::encode::FOOTER_BODY_BYTES;
use super::lengths::{ascii_metadata, parse_record, strings_fit};
use super::{FORMAT_VERSION, FRAMES, GAPS, LABELS, METADATA_NAME, RESULTS, RecordingHeader};
use crate::recording::RecordingError;
use crate::recording::input::open_file;

/// Longest record that is accepted, bytes: chunks are a few megabytes.
pub(super) const MAX_RECORD: u64 = 1 << 28;

/// Bytes of opcode and length.
pub(super) const RECORD_HEADER: u64 = 9;

/// Bytes of the record that ends the data, with its header.
pub(super) const DATA_END_BYTES: u64 = RECORD_HEADER + 4;

/// Position of the compression in the body of a chunk.
const COMPRESSION_AT: usize = 28;
/// Compression of MCAP that is not supported, with its length.
const LZ4_MARK: &[u8] = b"\x03\0\0\0lz4";

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Topic {
    Frame,
    Gap,
    Label,
    Result,
}

/// Channels of a file by their numbers; `None` for a channel of another program.
pub(super) type Channels = BTreeMap<u16, Option<Topic>>;

/// Topic of a channel; `None` for a channel of another program.
pub(super) fn topic(name: &str) -> Option<Topic> {
    let topics = [(FRAMES, Topic::Frame), (GAPS, Topic::Gap), (LABELS, Topic::Label), (RESULTS, Topic::Result)];
    topics.into_iter().find(|t| t.0 == name).map(|t| t.1)
}

/// File whose records are read one by one.
#[derive(Debug)]
pub(super) struct Records {
    pub path: PathBuf,
    file: BufReader<File>,
    pub length: u64,
    /// Start of the next record.
    pub offset: u64,
}

/// Outcome of reading the next record.
pub(super) enum Next {
    /// Opcode, and the offset of the record; its body is in the buffer.
    Record(u8, u64),
    /// The data section is over.
    End,
    /// The file ends within a record.
    CutShort,
}

impl Records {
    pub fn open(path: &Path) -> Result<Self, RecordingError> {
        let file = open_file(path)?;
        let length = file.metadata().map_err(RecordingError::cannot_read(path))?.len();
        let mut records = Records { path: path.to_owned(), file: BufReader::new(file), length, offset: 0 };
        let mut magic = [0; 8];
        if records.file.read_exact(&mut magic).is_err() || magic != *mcap::MAGIC {
            return Err(records.corrupt(0, "not an MCAP file: its first eight bytes are not MCAP's".into()));
        }
        records.offset = 8;
        Ok(records)
    }

    pub fn corrupt(&self, offset: u64, reason: String) -> RecordingError {
        RecordingError::Corrupt { path: self.path.clone(), offset, reason }
    }

    /// Seeks the record that starts here.
    pub fn go_to(&mut self, offset: u64) -> Result<(), RecordingError> {
        self.file.seek(SeekFrom::Start(offset)).map_err(RecordingError::cannot_read(&self.path))?;
        self.offset = offset;
        Ok(())
    }

    /// Reads bytes at `offset`; returns how many there are.
    pub fn peek(&mut self, offset: u64, bytes: &mut [u8]) -> Result<usize, RecordingError> {
        self.go_to(offset)?;
        let mut filled = 0;
        while let Some(rest) = bytes.get_mut(filled..).filter(|rest| !rest.is_empty()) {
            match self.file.read(rest).map_err(RecordingError::cannot_read(&self.path))? {
                0 => break,
                count => filled += count,
            }
        }
        self.go_to(offset)?;
        Ok(filled)
    }

    /// Reads the next record; the bodies of records that `wanted` refuses are skipped and left empty.
    pub fn next(&mut self, body: &mut Vec<u8>, wanted: impl Fn(u8) -> bool) -> Result<Next, RecordingError> {
        let at = self.offset;
        let remaining = self.length.saturating_sub(at);
        if remaining < RECORD_HEADER {
            return Ok(Next::CutShort);
        }
        let mut header = [0; RECORD_HEADER as usize];
        self.file.read_exact(&mut header).map_err(RecordingError::cannot_read(&self.path))?;
        let [opcode, length @ ..] = header;
        let length = u64::from_le_bytes(length);
        match opcode {
            op::DATA_END => return self.end_of_data(at, length, DATA_END_BYTES - RECORD_HEADER),
            op::FOOTER => return self.end_of_data(at, length, FOOTER_BODY_BYTES),
            _ => {}
        }
        if opcode == 0 || (opcode < 0x80 && opcode > op::DATA_END) {
            return Err(self.corrupt(at, format!("{opcode:#04x} is no MCAP record")));
        }
        if length > remaining - RECORD_HEADER {
            // The file may have grown since: labels are written behind the last frame.
            self.length = self.file.get_ref().metadata().map_err(RecordingError::cannot_read(&self.path))?.len();
            if length > self.length.saturating_sub(at + RECORD_HEADER) {
                return Ok(Next::CutShort);
            }
        }
        if length > MAX_RECORD {
            return Err(self.corrupt(at, format!("a record of {length} bytes, expected at most {MAX_RECORD}")));
        }
        body.clear();
        if wanted(opcode) {
            body.resize(length as usize, 0);
            self.file.read_exact(body).map_err(RecordingError::cannot_read(&self.path))?;
        } else {
            // The seek stays within the buffer if possible.
            self.file.seek_relative(length as i64).map_err(RecordingError::cannot_read(&self.path))?;
        }
        self.offset = at + RECORD_HEADER + length;
        Ok(Next::Record(opcode, at))
    }

    /// Goes back to the record that ends the data. Its length is checked because one damaged opcode would end the recording.
    fn end_of_data(&mut self, at: u64, length: u64, expected: u64) -> Result<Next, RecordingError> {
        self.go_to(at)?;
        if length != expected {
            let reason = format!("a record that ends the data has {length} bytes, expected {expected}");
            return Err(self.corrupt(at, reason));
        }
        Ok(Next::End)
    }
}

/// Reads the header of the recording and its first channels: everything up to the first chunk that names one. Later
/// chunks may name more.
pub(super) fn read_head(records: &mut Records) -> Result<(RecordingHeader, Channels), RecordingError> {
    let (mut body, mut header, mut channels) = (Vec::new(), None, Channels::new());
    while header.is_none() || !channels.values().any(Option::is_some) {
        match records.next(&mut body, |opcode| opcode == op::METADATA || holds_messages(opcode))? {
            Next::Record(op::METADATA, at) => {
                if let Some((found, flaws)) = header_in(records, at, &body)? {
                    if let Some(Flaw { reason, .. }) = flaws.into_iter().next() {
                        return Err(records.corrupt(at, reason));
                    }
                    header = Some(found);
                }
            }
            Next::Record(opcode, at) if holds_messages(opcode) => {
                drop(messages_in(records, opcode, at, &body, &mut channels)?);
            }
            Next::Record(..) => {}
            Next::End => break,
            Next::CutShort => {
                return Err(records.corrupt(records.offset, "the file ends before its first chunk".into()));
            }
        }
    }
    let header = header.ok_or_else(|| records.corrupt(8, "no metadata `radome`: not one of our recordings".into()))?;
    Ok((header, channels))
}

/// Damage of the metadata that leaves the frames readable.
pub(super) struct Flaw {
    pub reason: String,
    /// Length of the damaged field, bytes.
    pub bytes: u64,
}

/// Reads the header of the recording, even if the rest is damaged, and the offset and the flaws of its metadata. Damaged fields
/// that frames can do without are empty.
pub(super) fn read_header_alone(records: &mut Records) -> Result<(RecordingHeader, u64, Vec<Flaw>), RecordingError> {
    let mut body = Vec::new();
    while let Next::Record(opcode, at) = records.next(&mut body, |opcode| opcode == op::METADATA)? {
        if opcode == op::METADATA
            && let Some((header, flaws)) = header_in(records, at, &body)?
        {
            return Ok((header, at, flaws));
        }
    }
    let reason = "no metadata `radome`: not one of our recordings, or cut before its start".into();
    Err(records.corrupt(8, reason))
}

/// Parses the header of the recording from the body of a metadata record; `None` if that is another program's.
fn header_in(records: &Records, at: u64, body: &[u8]) -> Result<Option<(RecordingHeader, Vec<Flaw>)>, RecordingError> {
    let (mut flaws, ascii) = (Vec::new(), ascii_metadata(body));
    let mut parsed = parse_record(op::METADATA, body);
    if let Some(ascii) = ascii.as_deref().filter(|_| parsed.is_err()) {
        flaws.push(Flaw { reason: "the metadata are not UTF-8".into(), bytes: 0 });
        parsed = parse_record(op::METADATA, ascii);
    }
    match parsed {
        Ok(Record::Metadata(metadata)) if metadata.name == METADATA_NAME => {
            let header = parse_header(records, at, &metadata.metadata, &mut flaws)?;
            Ok(Some((header, flaws)))
        }
        _ => Ok(None),
    }
}

/// Returns whether records of this kind hold messages, or channels that messages need: chunks, and what other programs
/// write without chunks.
pub(super) fn holds_messages(opcode: u8) -> bool {
    matches!(opcode, op::CHUNK | op::CHANNEL | op::MESSAGE)
}

/// Reads the messages of a record: of a chunk, or a single message without a chunk. Other records have none.
pub(super) fn messages_in(
    records: &Records,
    opcode: u8,
    at: u64,
    body: &[u8],
    channels: &mut Channels,
) -> Result<Vec<(Topic, Vec<u8>)>, RecordingError> {
    if opcode == op::CHUNK {
        return read_chunk(records, at, body, channels);
    }
    let mut messages = Vec::new();
    if holds_messages(opcode) {
        collect_record(opcode, body, channels, &mut messages)
            .map_err(|error| records.corrupt(at, format!("a record outside of chunks is damaged: {error}")))?;
    }
    Ok(messages)
}

/// Reads the messages of a chunk, or of a message without a chunk, that the index names.
pub(super) fn messages_at(
    records: &mut Records,
    offset: u64,
    channels: &mut Channels,
) -> Result<Vec<(Topic, Vec<u8>)>, RecordingError> {
    let mut body = Vec::new();
    records.go_to(offset)?;
    match records.next(&mut body, holds_messages)? {
        Next::Record(opcode @ (op::CHUNK | op::MESSAGE), at) => messages_in(records, opcode, at, &body, channels),
        _ => Err(records.corrupt(offset, "the index says that a chunk starts here, but none does".into())),
    }
}

/// Reads messages as [`messages_at`] does; a damaged chunk has none.
pub(super) fn readable_messages_at(
    records: &mut Records,
    offset: u64,
    channels: &mut Channels,
) -> Result<Vec<(Topic, Vec<u8>)>, RecordingError> {
    match messages_at(records, offset, channels) {
        Err(RecordingError::Corrupt { .. }) => Ok(Vec::new()),
        result => result,
    }
}

/// Reads the messages of a chunk. The whole chunk is decompressed and its CRC checked first, because its lengths may be
/// wrong.
fn read_chunk(
    records: &Records,
    at: u64,
    body: &[u8],
    channels: &mut Channels,
) -> Result<Vec<(Topic, Vec<u8>)>, RecordingError> {
    if body.get(COMPRESSION_AT..).is_some_and(|rest| rest.starts_with(LZ4_MARK)) {
        return Err(RecordingError::Compression { path: records.path.clone(), offset: at });
    }
    let damaged = |reason: String| records.corrupt(at, format!("a chunk is damaged: {reason}"));
    let content = chunk_content(body).map_err(damaged)?;
    let mut rest = content.as_slice();
    let mut messages = Vec::new();
    while let Some((&[opcode, ref length @ ..], behind)) = rest.split_first_chunk::<{ RECORD_HEADER as usize }>() {
        let length = u64::from_le_bytes(*length);
        let split = usize::try_from(length).ok().and_then(|length| behind.split_at_checked(length));
        let (record, next) = split.ok_or_else(|| damaged(format!("a record of {length} bytes reaches beyond it")))?;
        rest = next;
        match opcode {
            op::CHANNEL | op::MESSAGE => {}
            op::SCHEMA | 0x80.. => continue,
            _ => return Err(damaged(format!("it holds a record {opcode:#04x}"))),
        }
        collect_record(opcode, record, channels, &mut messages).map_err(|e| damaged(e.to_string()))?;
    }
    if rest.is_empty() { Ok(messages) } else { Err(damaged(format!("{} bytes behind its last record", rest.len()))) }
}

/// Takes a channel or a message from its record. Messages of other programs' channels are left out.
fn collect_record(
    opcode: u8,
    body: &[u8],
    channels: &mut Channels,
    messages: &mut Vec<(Topic, Vec<u8>)>,
) -> mcap::McapResult<()> {
    match parse_record(opcode, body)? {
        Record::Channel(channel) => {
            channels.insert(channel.id, topic(&channel.topic));
        }
        Record::Message { header, data } => {
            if let Some(Some(topic)) = channels.get(&header.channel_id) {
                messages.push((*topic, data.into_owned()));
            }
        }
        _ => {}
    }
    Ok(())
}

/// Decompresses a chunk and checks its length and CRC. Memory grows with the actual data, not with the length in the
/// header.
fn chunk_content(body: &[u8]) -> Result<Vec<u8>, String> {
    let short = || "its header is cut short".to_owned();
    strings_fit(op::CHUNK, body).ok_or_else(short)?;
    // Times of the first and the last message, length without compression, CRC, compression, length; the records.
    let u64_at = |at: usize| body.get(at..)?.first_chunk().map(|b| u64::from_le_bytes(*b));
    let u32_at = |at: usize| body.get(at..)?.first_chunk().map(|b| u32::from_le_bytes(*b));
    let (stated_length, crc, name_length) =
        (u64_at(16).ok_or_else(short)?, u32_at(24).ok_or_else(short)?, u32_at(28).unwrap_or(0));
    let behind_name = 32 + name_length as usize;
    let compression = body.get(32..behind_name).unwrap_or(&[]);
    let length = u64_at(behind_name).ok_or_else(short)?;
    let records = body.get(behind_name + 8..).unwrap_or(&[]);
    if length != records.len() as u64 {
        return Err(format!("it has {} bytes of records, its header says {length}", records.len()));
    }
    if stated_length > MAX_RECORD {
        return Err(format!("it claims {stated_length} bytes, expected at most {MAX_RECORD}"));
    }
    let content = match compression {
        b"" => records.to_vec(),
        b"zstd" => {
            let mut content = Vec::with_capacity((stated_length as usize).min(32 * records.len()));
            let result = zstd::Decoder::with_buffer(records).and_then(|decoder| {
                // One byte more than stated is read, to detect excess data.
                decoder.take(stated_length + 1).read_to_end(&mut content)
            });
            result.map_err(|e| e.to_string())?;
            content
        }
        other => return Err(format!("its compression is '{}', expected zstd or none", String::from_utf8_lossy(other))),
    };
    if content.len() as u64 != stated_length {
        return Err(format!("it claims {stated_length} bytes, but there are {}", content.len()));
    }
    // A CRC of zero stands for none.
    let found = crc32fast::hash(&content);
    if crc != 0 && crc != found {
        return Err(format!("its CRC is {found:08x}, expected {crc:08x}"));
    }
    Ok(content)
}

fn parse_header(
    records: &Records,
    at: u64,
    metadata: &BTreeMap<String, String>,
    flaws: &mut Vec<Flaw>,
) -> Result<RecordingHeader, RecordingError> {
    let field = |name: &str| {
        metadata.get(name).ok_or_else(|| records.corrupt(at, format!("the metadata lack the field `{name}`")))
    };
    let version = field("format_version")?;
    match version.parse::<u32>() {
        Ok(1..=FORMAT_VERSION) => {}
        Ok(0) | Err(_) => return Err(records.corrupt(at, format!("format version '{version}', expected a number"))),
        Ok(_) => {
            return Err(RecordingError::Newer { path: records.path.clone(), got: version.clone(), supported: "1" });
        }
    }
    let stored: Waveform =
        serde_json::from_str(field("waveform")?).map_err(|e| records.corrupt(at, malformed("waveform", &e)))?;
    // A stored waveform is used only as far as the chip can produce it.
    let mut waveform = Waveform::realise(stored.request.clone())
        .map_err(|source| RecordingError::Waveform { path: records.path.clone(), source })?;
    if (stored.chirp_interval_s / waveform.chirp_interval_s - 1.0).abs() < 0.05 {
        waveform.chirp_interval_s = stored.chirp_interval_s;
    }
    Ok(RecordingHeader {
        waveform,
        board: parsed_or_empty(metadata, "board", flaws),
        registers: parsed_or_empty(metadata, "registers", flaws),
        judge: metadata.get("judge").and_then(|_| parsed_or_empty(metadata, "judge", flaws)),
    })
}

fn malformed(name: &str, error: &serde_json::Error) -> String {
    format!("metadata `{name}` is malformed: {error}")
}

/// Parses a field that frames can do without. It is empty if it is damaged.
fn parsed_or_empty<T: DeserializeOwned + Default>(
    metadata: &BTreeMap<String, String>,
    name: &str,
    flaws: &mut Vec<Flaw>,
) -> T {
    let flaw = match metadata.get(name) {
        Some(text) => match serde_json::from_str(text) {
            Ok(value) => return value,
            Err(error) => Flaw { reason: malformed(name, &error), bytes: text.len() as u64 },
        },
        None => Flaw { reason: format!("the metadata lack the field `{name}`"), bytes: 0 },
    };
    flaws.push(flaw);
    T::default()
}
