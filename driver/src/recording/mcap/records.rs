//! Records of a file one after the other, so that places are known and a file without end can be read.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use mcap::records::{Record, op};
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};
use radome_dsp::Waveform;

use super::{FORMAT_VERSION, FRAMES, GAPS, LABELS, METADATA_NAME, RecordingHeader};
use crate::recording::RecordingError;

/// Longest record that makes sense: chunks are a few megabytes.
pub(super) const MAX_RECORD: u64 = 1 << 28;

/// Opcode and length.
pub(super) const RECORD_HEADER: u64 = 9;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Topic {
    Frame,
    Gap,
    Label,
}

pub(super) fn topic(name: &str) -> Option<Topic> {
    [(FRAMES, Topic::Frame), (GAPS, Topic::Gap), (LABELS, Topic::Label)].into_iter().find(|t| t.0 == name).map(|t| t.1)
}

/// Records of a file, one after the other.
#[derive(Debug)]
pub(super) struct Records {
    pub path: PathBuf,
    file: BufReader<File>,
    pub length: u64,
    /// Start of the next record.
    pub offset: u64,
}

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
        let file = File::open(path).map_err(RecordingError::io(path, "cannot be opened"))?;
        let length = file.metadata().map_err(RecordingError::io(path, "cannot be read"))?.len();
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

    /// Goes to the record that starts here.
    pub fn go_to(&mut self, offset: u64) -> Result<(), RecordingError> {
        self.file.seek(SeekFrom::Start(offset)).map_err(RecordingError::io(&self.path, "cannot be read"))?;
        self.offset = offset;
        Ok(())
    }

    /// Bytes from here on, as many as there are.
    pub fn peek(&mut self, offset: u64, bytes: &mut [u8]) -> Result<usize, RecordingError> {
        self.go_to(offset)?;
        let mut filled = 0;
        while let Some(rest) = bytes.get_mut(filled..).filter(|rest| !rest.is_empty()) {
            match self.file.read(rest).map_err(RecordingError::io(&self.path, "cannot be read"))? {
                0 => break,
                count => filled += count,
            }
        }
        self.go_to(offset)?;
        Ok(filled)
    }

    /// The next record; bodies of records that `wanted` refuses are passed over and left empty.
    pub fn next(&mut self, body: &mut Vec<u8>, wanted: impl Fn(u8) -> bool) -> Result<Next, RecordingError> {
        let at = self.offset;
        let left = self.length.saturating_sub(at);
        if left < RECORD_HEADER {
            return Ok(Next::CutShort);
        }
        let mut header = [0; RECORD_HEADER as usize];
        self.file.read_exact(&mut header).map_err(RecordingError::io(&self.path, "cannot be read"))?;
        let [opcode, length @ ..] = header;
        let length = u64::from_le_bytes(length);
        if matches!(opcode, op::DATA_END | op::FOOTER) {
            self.go_to(at)?;
            return Ok(Next::End);
        }
        if opcode == 0 || (opcode < 0x80 && opcode > op::DATA_END) {
            return Err(self.corrupt(at, format!("{opcode:#04x} is no MCAP record")));
        }
        if length > left - RECORD_HEADER {
            return Ok(Next::CutShort);
        }
        if length > MAX_RECORD {
            return Err(self.corrupt(at, format!("a record of {length} bytes, expected at most {MAX_RECORD}")));
        }
        body.clear();
        if wanted(opcode) {
            body.resize(length as usize, 0);
            self.file.read_exact(body).map_err(RecordingError::io(&self.path, "cannot be read"))?;
        } else {
            // Within the buffer where it can be.
            self.file.seek_relative(length as i64).map_err(RecordingError::io(&self.path, "cannot be read"))?;
        }
        self.offset = at + RECORD_HEADER + length;
        Ok(Next::Record(opcode, at))
    }
}

/// What holds for the whole file, and its channels: everything up to the end of the first chunk.
pub(super) fn read_head(records: &mut Records) -> Result<(RecordingHeader, BTreeMap<u16, Topic>), RecordingError> {
    let (mut body, mut header, mut channels) = (Vec::new(), None, BTreeMap::new());
    while header.is_none() || channels.is_empty() {
        match records.next(&mut body, |opcode| matches!(opcode, op::METADATA | op::CHUNK))? {
            Next::Record(op::METADATA, at) => {
                if let Ok(Record::Metadata(metadata)) = mcap::parse_record(op::METADATA, &body)
                    && metadata.name == METADATA_NAME
                {
                    header = Some(parse_header(records, at, &metadata.metadata)?);
                }
            }
            Next::Record(op::CHUNK, at) => {
                read_chunk(records, at, &body, &mut channels)?;
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

/// What holds for the whole file, whatever state the rest of it is in.
pub(super) fn read_header_alone(records: &mut Records) -> Result<RecordingHeader, RecordingError> {
    let mut body = Vec::new();
    loop {
        match records.next(&mut body, |opcode| opcode == op::METADATA)? {
            Next::Record(op::METADATA, at) => {
                if let Ok(Record::Metadata(metadata)) = mcap::parse_record(op::METADATA, &body)
                    && metadata.name == METADATA_NAME
                {
                    return parse_header(records, at, &metadata.metadata);
                }
            }
            Next::Record(..) => {}
            Next::End | Next::CutShort => {
                let reason = "no metadata `radome`: not one of our recordings, or cut before its start".into();
                return Err(records.corrupt(8, reason));
            }
        }
    }
}

/// The messages of a chunk, once all of it has been decompressed and its CRC checked: until then no length in
/// it can be believed.
pub(super) fn read_chunk(
    records: &Records,
    at: u64,
    body: &[u8],
    channels: &mut BTreeMap<u16, Topic>,
) -> Result<Vec<(Topic, Vec<u8>)>, RecordingError> {
    // Two times of eight bytes, then the length without compression.
    let claimed = body.get(16..24).and_then(|b| b.first_chunk()).map_or(0, |b| u64::from_le_bytes(*b));
    if claimed > MAX_RECORD {
        let reason = format!("a chunk is damaged: it claims {claimed} bytes, expected at most {MAX_RECORD}");
        return Err(records.corrupt(at, reason));
    }
    let damaged = |e: mcap::McapError| records.corrupt(at, format!("a chunk is damaged: {e}"));
    let options = LinearReaderOptions::default()
        .with_skip_start_magic(true)
        .with_skip_end_magic(true)
        .with_prevalidate_chunk_crcs(true)
        .with_record_length_limit(MAX_RECORD as usize);
    let mut reader = LinearReader::new_with_options(options);
    let mut input = reader.insert(RECORD_HEADER as usize + body.len());
    // The buffer is as long as asked for; were it not, the chunk would read as damaged.
    let mut fed = 0;
    for part in [&[op::CHUNK][..], &(body.len() as u64).to_le_bytes(), body] {
        fed += input.write(part).unwrap_or(0);
    }
    reader.notify_read(fed);
    let mut messages = Vec::new();
    let mut fed_all = false;
    while let Some(event) = reader.next_event() {
        match event.map_err(damaged)? {
            // The chunk is all there is: the reader is told so once and then ends, or reports what is missing.
            LinearReadEvent::ReadRequest(_) if fed_all => break,
            LinearReadEvent::ReadRequest(_) => {
                fed_all = true;
                reader.notify_read(0);
            }
            LinearReadEvent::Record { data, opcode } => match mcap::parse_record(opcode, data).map_err(damaged)? {
                Record::Channel(channel) => {
                    if let Some(topic) = topic(&channel.topic) {
                        channels.insert(channel.id, topic);
                    }
                }
                Record::Message { header, data } => {
                    if let Some(topic) = channels.get(&header.channel_id) {
                        messages.push((*topic, data.into_owned()));
                    }
                }
                _ => {}
            },
        }
    }
    Ok(messages)
}

pub(super) fn parse_header(
    records: &Records,
    at: u64,
    metadata: &BTreeMap<String, String>,
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
    let wrong = |name: &'static str| move |e| records.corrupt(at, format!("metadata `{name}` is malformed: {e}"));
    let stored: Waveform = serde_json::from_str(field("waveform")?).map_err(wrong("waveform"))?;
    // A stored waveform is believed only as far as the chip could produce it.
    let mut waveform = Waveform::realise(stored.request.clone())
        .map_err(|source| RecordingError::Waveform { path: records.path.clone(), source })?;
    if (stored.chirp_interval_s / waveform.chirp_interval_s - 1.0).abs() < 0.05 {
        waveform.chirp_interval_s = stored.chirp_interval_s;
    }
    Ok(RecordingHeader {
        waveform,
        board: serde_json::from_str(field("board")?).map_err(wrong("board"))?,
        registers: serde_json::from_str(field("registers")?).map_err(wrong("registers"))?,
    })
}
