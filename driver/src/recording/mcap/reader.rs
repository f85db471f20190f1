//! Reading, record by record, so that places are known and a file without end can be read.

use std::collections::{BTreeMap, VecDeque};
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use mcap::records::{Record, op};
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};
use radome_dsp::{Frame, FrameSource, Gap, SourceError, SourceEvent, Waveform};

use super::{FORMAT_VERSION, FRAMES, GAPS, LABELS, LabelSpan, METADATA_NAME, RecordingHeader, decode_frame};
use crate::recording::RecordingError;

/// Longest record that makes sense: chunks are a few megabytes.
const MAX_RECORD: u64 = 1 << 28;

/// Opcode and length.
const RECORD_HEADER: u64 = 9;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Topic {
    Frame,
    Gap,
    Label,
}

fn topic(name: &str) -> Option<Topic> {
    [(FRAMES, Topic::Frame), (GAPS, Topic::Gap), (LABELS, Topic::Label)].into_iter().find(|t| t.0 == name).map(|t| t.1)
}

/// Records of a file, one after the other.
#[derive(Debug)]
struct Records {
    path: PathBuf,
    file: BufReader<File>,
    length: u64,
    offset: u64,
}

enum Next {
    /// Opcode, and the offset of the record; its body is in the buffer.
    Record(u8, u64),
    /// The data section is over.
    End,
    /// The file ends within a record.
    CutShort,
}

impl Records {
    fn open(path: &Path) -> Result<Self, RecordingError> {
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

    fn corrupt(&self, offset: u64, reason: String) -> RecordingError {
        RecordingError::Corrupt { path: self.path.clone(), offset, reason }
    }

    /// The next record; bodies of records that `wanted` refuses are passed over and left empty.
    fn next(&mut self, body: &mut Vec<u8>, wanted: impl Fn(u8) -> bool) -> Result<Next, RecordingError> {
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
            let skip = SeekFrom::Current(length as i64);
            self.file.seek(skip).map_err(RecordingError::io(&self.path, "cannot be read"))?;
        }
        self.offset = at + RECORD_HEADER + length;
        Ok(Next::Record(opcode, at))
    }
}

/// Reads a native recording as a [`FrameSource`].
#[derive(Debug)]
pub struct McapReader {
    records: Records,
    header: RecordingHeader,
    complete: bool,
    strict: bool,
    frames: u64,
    channels: BTreeMap<u16, Topic>,
    body: Vec<u8>,
    /// Messages of the current chunk and the offset of that chunk.
    pending: VecDeque<(Topic, Vec<u8>)>,
    chunk_offset: u64,
    ended: bool,
}

impl McapReader {
    /// Opens a recording. One that was never finished is read up to its last chunk.
    pub fn open(path: &Path) -> Result<Self, RecordingError> {
        let mut records = Records::open(path)?;
        let mut body = Vec::new();
        let mut header = None;
        let mut channels = BTreeMap::new();
        let mut counts: BTreeMap<u16, u64> = BTreeMap::new();
        let mut cut_short = true;
        // One pass over the records, chunks but the first passed over: waveform, channels, number of frames.
        while header.is_none() || channels.is_empty() {
            match records.next(&mut body, |_| true)? {
                Next::Record(op::METADATA, at) => {
                    if let Ok(Record::Metadata(metadata)) = mcap::parse_record(op::METADATA, &body)
                        && metadata.name == METADATA_NAME
                    {
                        header = Some(parse_header(&records, at, &metadata.metadata)?);
                    }
                }
                Next::Record(op::CHUNK, at) => {
                    read_chunk(&records, at, &body, &mut channels, &mut |_, _| {})?;
                }
                Next::Record(..) => {}
                Next::End => break,
                Next::CutShort => {
                    return Err(records.corrupt(records.offset, "the file ends before its first chunk".into()));
                }
            }
        }
        let header =
            header.ok_or_else(|| records.corrupt(8, "no metadata `radome`: not one of our recordings".into()))?;
        loop {
            match records.next(&mut body, |opcode| opcode == op::MESSAGE_INDEX)? {
                Next::Record(op::MESSAGE_INDEX, _) => {
                    if let Ok(Record::MessageIndex(index)) = mcap::parse_record(op::MESSAGE_INDEX, &body) {
                        *counts.entry(index.channel_id).or_default() += index.records.len() as u64;
                    }
                }
                Next::Record(..) => {}
                Next::End => {
                    cut_short = false;
                    break;
                }
                Next::CutShort => break,
            }
        }
        let frames = counts.iter().filter(|(id, _)| channels.get(id) == Some(&Topic::Frame)).map(|(_, n)| n).sum();
        let complete = !cut_short && ends_with_magic(path, records.length)?;
        Ok(McapReader {
            records: Records::open(path)?,
            header,
            complete,
            strict: false,
            frames,
            channels,
            body,
            pending: VecDeque::new(),
            chunk_offset: 0,
            ended: false,
        })
    }

    /// Makes the end of an unfinished recording an error instead of an end.
    pub fn strict(mut self, strict: bool) -> Self {
        self.strict = strict;
        self
    }

    /// Whether the recording was finished. Of an unfinished one the last chunk may be missing.
    pub fn is_complete(&self) -> bool {
        self.complete
    }

    /// What holds for the whole recording.
    pub fn header(&self) -> &RecordingHeader {
        &self.header
    }

    /// All labels, in the order of writing.
    pub fn labels(&self) -> Result<Vec<LabelSpan>, RecordingError> {
        let mut records = Records::open(&self.records.path)?;
        let (mut body, mut channels, mut labels) = (Vec::new(), BTreeMap::new(), Vec::new());
        while let Next::Record(opcode, at) = records.next(&mut body, |opcode| opcode == op::CHUNK)? {
            if opcode != op::CHUNK {
                continue;
            }
            let mut wrong = None;
            read_chunk(&records, at, &body, &mut channels, &mut |topic, data| {
                if topic == Topic::Label {
                    match serde_json::from_slice(data) {
                        Ok(label) => labels.push(label),
                        Err(e) => wrong = Some(format!("a label is malformed: {e}")),
                    }
                }
            })?;
            if let Some(reason) = wrong {
                return Err(records.corrupt(at, reason));
            }
        }
        Ok(labels)
    }

    fn read_next(&mut self, frame: &mut Frame) -> Result<SourceEvent, RecordingError> {
        loop {
            if let Some((topic, data)) = self.pending.pop_front() {
                match topic {
                    Topic::Label => {}
                    Topic::Gap => {
                        let gap: Gap = serde_json::from_slice(&data)
                            .map_err(|e| self.records.corrupt(self.chunk_offset, format!("a gap is malformed: {e}")))?;
                        return Ok(SourceEvent::Gap(gap));
                    }
                    Topic::Frame => {
                        decode_frame(&data, self.header.waveform.shape(), frame)
                            .map_err(|reason| self.records.corrupt(self.chunk_offset, reason))?;
                        return Ok(SourceEvent::Frame);
                    }
                }
                continue;
            }
            if self.ended {
                return Ok(SourceEvent::End);
            }
            let end = self.records.offset;
            match self.records.next(&mut self.body, |opcode| opcode == op::CHUNK)? {
                Next::Record(op::CHUNK, at) => {
                    self.chunk_offset = at;
                    let pending = &mut self.pending;
                    let mut keep = |topic, data: &[u8]| pending.push_back((topic, data.to_vec()));
                    read_chunk(&self.records, at, &self.body, &mut self.channels, &mut keep)?;
                }
                Next::Record(..) => {}
                Next::End => self.ended = true,
                Next::CutShort => {
                    self.ended = true;
                    if self.strict {
                        return Err(RecordingError::Unfinished { path: self.records.path.clone(), offset: end });
                    }
                }
            }
        }
    }
}

impl FrameSource for McapReader {
    fn waveform(&self) -> &Waveform {
        &self.header.waveform
    }

    fn next_frame(&mut self, frame: &mut Frame) -> Result<SourceEvent, SourceError> {
        Ok(self.read_next(frame)?)
    }

    fn frame_count(&self) -> Option<u64> {
        Some(self.frames)
    }
}

fn ends_with_magic(path: &Path, length: u64) -> Result<bool, RecordingError> {
    let mut end = [0; 8];
    let mut read = || {
        let mut file = File::open(path)?;
        file.seek(SeekFrom::Start(length.saturating_sub(8)))?;
        file.read_exact(&mut end)
    };
    read().map_err(RecordingError::io(path, "cannot be read"))?;
    Ok(end == *mcap::MAGIC)
}

/// Hands out the messages of a chunk, once all of it has been decompressed and its CRC checked: until then no length in
/// it can be believed.
fn read_chunk(
    records: &Records,
    at: u64,
    body: &[u8],
    channels: &mut BTreeMap<u16, Topic>,
    message: &mut dyn FnMut(Topic, &[u8]),
) -> Result<(), RecordingError> {
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
    messages.iter().for_each(|(topic, data)| message(*topic, data));
    Ok(())
}

fn parse_header(
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
