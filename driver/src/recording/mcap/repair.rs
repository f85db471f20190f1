//! Repair of cut or damaged files: the readable part as a complete file, and a report of the rest.

use std::collections::BTreeMap;
use std::path::Path;

use mcap::records::{Record, op};
use radome_dsp::{Frame, Gap, GapReason};

use super::lengths::{is_filled, parse_record};
use super::reader::parse_result;
use super::records::{MAX_RECORD, Next, RECORD_HEADER, Records, Topic, read_chunk, read_header_alone};
use super::{LabelSpan, McapWriter, RecordingHeader, decode_frame, staged, take_labels};
use crate::recording::{Existing, RecordingError};

/// Part of a file that cannot be read.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Damage {
    /// Offset of its start, bytes.
    pub offset: u64,
    /// Length, bytes.
    pub bytes: u64,
    /// Frames in the part, if the file still tells their number.
    pub frames: Option<u64>,
    /// Description of the damage.
    pub reason: String,
}

/// Report of a repair.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct RepairReport {
    /// Frames written.
    pub frames: u64,
    /// Labels written.
    pub labels: u64,
    /// Results written.
    pub results: u64,
    /// Gaps that the recording had already.
    pub gaps: u64,
    /// Gaps written for the lost frames; 0 frames if their number is unknown.
    pub lost: Vec<Gap>,
    /// Damaged parts of the file.
    pub damage: Vec<Damage>,
    /// Whether the recording was finished by its recorder.
    pub was_finished: bool,
}

impl RepairReport {
    /// Frames that are known to be lost.
    pub fn frames_lost(&self) -> u64 {
        self.lost.iter().fold(0, |sum: u64, gap| sum.saturating_add(gap.frames))
    }

    /// Bytes that cannot be read.
    pub fn bytes_lost(&self) -> u64 {
        self.damage.iter().map(|damage| damage.bytes).sum()
    }
}

/// Writes the readable part of `input`, which stays as it is, to `output`: all frames of chunks whose check sum is
/// right. Unreadable parts become gaps. The file's header must be intact. Labels that are staged beside the input are
/// taken in place of those in it. `existing` decides whether a file at `output` is replaced.
///
/// # Errors
/// [`RecordingError`] if the header of the input is damaged, both are the same file, the output exists and must not be
/// replaced or has another writer, and [`RecordingError::Io`].
pub fn repair(input: &Path, output: &Path, existing: Existing) -> Result<RepairReport, RecordingError> {
    let is_same = |a: &Path, b: &Path| a.canonicalize().is_ok_and(|a| b.canonicalize().is_ok_and(|b| a == b));
    if is_same(input, output) {
        return Err(RecordingError::Occupied { path: output.to_owned() });
    }
    let mut records = Records::open(input)?;
    let header = read_header_alone(&mut records)?;
    let writer = McapWriter::create(output, &header, existing)?;
    let frame = Frame::zeroed(header.waveform.shape());
    let report = RepairReport::default();
    let mut repair =
        Repair { writer, header, frame, report, expected: None, unread: None, labels: Vec::new(), staged: None };
    repair.staged = staged::read(input)?.map(|staged| staged.labels);
    repair.copy(&mut records)?;
    repair.writer.finish()?;
    Ok(repair.report)
}

/// Frames that could not be read.
#[derive(Clone, Copy, Default)]
struct Unread {
    /// Number of frames by an index.
    frames: u64,
    /// Whether further frames are lost that no index counts.
    uncounted: bool,
}

struct Repair {
    writer: McapWriter,
    header: RecordingHeader,
    frame: Frame,
    report: RepairReport,
    /// Number of the frame that should come next.
    expected: Option<u64>,
    /// Frames that could not be read since the last good one.
    unread: Option<Unread>,
    /// Labels so far; later ones may take the place of earlier ones.
    labels: Vec<LabelSpan>,
    /// Labels beside the input, in place of all in it.
    staged: Option<Vec<LabelSpan>>,
}

impl Repair {
    fn copy(&mut self, records: &mut Records) -> Result<(), RecordingError> {
        // Numbers that the recorder uses; the first chunk states them, if it can be read.
        let mut channels = BTreeMap::from([(1, Topic::Frame), (2, Topic::Gap), (3, Topic::Label), (4, Topic::Result)]);
        let mut body = Vec::new();
        records.go_to(8)?;
        loop {
            let at = records.offset;
            let reason = match records.next(&mut body, |opcode| opcode < 0x80) {
                Ok(Next::Record(op::CHUNK, _)) => match read_chunk(records, at, &body, &mut channels) {
                    Ok(messages) => {
                        for (topic, data) in messages {
                            self.message(at, topic, &data)?;
                        }
                        continue;
                    }
                    Err(RecordingError::Corrupt { reason, .. }) => reason,
                    Err(error) => return Err(error),
                },
                // A damaged length may reach over chunks that are intact.
                Ok(Next::Record(opcode, _)) if !is_filled(opcode, &body) => {
                    "the length of a record is not that of its content".to_owned()
                }
                // Records of other programs are skipped; a damaged length looks like one.
                Ok(Next::Record(opcode, _)) if opcode < 0x80 => continue,
                Ok(Next::Record(opcode, _)) => format!("{opcode:#04x} is no record of a recording"),
                Ok(Next::End) => {
                    self.report.was_finished = true;
                    break;
                }
                Ok(Next::CutShort) if at == records.length => break,
                Ok(Next::CutShort) => "the file ends within a record".to_owned(),
                Err(RecordingError::Corrupt { reason, .. }) => reason,
                Err(error) => return Err(error),
            };
            let mut opcode = [0];
            records.peek(at, &mut opcode)?;
            let is_chunk = opcode == [op::CHUNK];
            let frames = if is_chunk { frames_by_index(records, at, &channels)? } else { None };
            let next = next_chunk(records, at + 1)?;
            let bytes = next.unwrap_or(records.length) - at;
            let damage = Damage { offset: at, bytes, frames, reason };
            match is_chunk || next.is_some() {
                true => self.damaged(damage),
                // Behind the last chunk there are no frames.
                false => self.report.damage.push(damage),
            }
            match next {
                Some(next) => records.go_to(next)?,
                None => break,
            }
        }
        // Frames lost at the end.
        self.found(None)?;
        if let Some(staged) = self.staged.take() {
            self.labels = staged;
        }
        self.report.labels = self.labels.len() as u64;
        self.labels.iter().try_for_each(|label| self.writer.recorder.label(label))
    }

    fn damaged(&mut self, damage: Damage) {
        let unread = self.unread.get_or_insert_default();
        unread.frames += damage.frames.unwrap_or(0);
        unread.uncounted |= damage.frames.is_none();
        self.report.damage.push(damage);
    }

    fn message(&mut self, at: u64, topic: Topic, data: &[u8]) -> Result<(), RecordingError> {
        let malformed = |reason| Damage { offset: at, bytes: data.len() as u64, frames: None, reason };
        match topic {
            Topic::Frame => match decode_frame(data, self.header.waveform.shape(), &mut self.frame) {
                Ok(()) => {
                    self.found(Some(self.frame.sequence))?;
                    self.writer.recorder.frame(&self.frame)?;
                    self.expected = self.frame.sequence.checked_add(1);
                    self.report.frames += 1;
                }
                Err(reason) => self.damaged(Damage { frames: Some(1), ..malformed(reason) }),
            },
            Topic::Gap => match serde_json::from_slice::<Gap>(data) {
                Ok(gap) => {
                    self.found(Some(gap.first_sequence))?;
                    self.writer.recorder.gap(&gap)?;
                    self.expected = gap.first_sequence.checked_add(gap.frames);
                    self.report.gaps += 1;
                }
                Err(error) => self.damaged(malformed(format!("a gap is malformed: {error}"))),
            },
            Topic::Label => {
                if let Err(error) = take_labels(data, &mut self.labels) {
                    self.report.damage.push(malformed(format!("a label is malformed: {error}")));
                }
            }
            Topic::Result => match parse_result(data) {
                Ok(_) if self.header.judge.is_none() => {
                    self.report.damage.push(malformed("a result, but the header names no judge".into()));
                }
                Ok(result) => {
                    self.writer.recorder.result(&result)?;
                    self.report.results += 1;
                }
                Err(reason) => self.report.damage.push(malformed(reason)),
            },
        }
        Ok(())
    }

    /// Writes the frames that are missing before this number as a gap; `None` at the end of the file.
    fn found(&mut self, sequence: Option<u64>) -> Result<(), RecordingError> {
        let Some(unread) = self.unread.take() else { return Ok(()) };
        let (first_sequence, frames) = match (self.expected, sequence) {
            // Sequence numbers count more than the index: gaps may be lost with the frames.
            (Some(expected), Some(sequence)) => (expected, sequence.saturating_sub(expected)),
            (Some(expected), None) => (expected, unread.frames),
            // Nothing could be read before it: numbers start at 0 unless the index counts the frames.
            (None, Some(sequence)) if unread.uncounted => (0, sequence),
            (None, Some(sequence)) => (sequence.saturating_sub(unread.frames), unread.frames.min(sequence)),
            (None, None) => (0, unread.frames),
        };
        if sequence.is_some() && frames == 0 {
            return Ok(());
        }
        let gap = Gap { first_sequence, frames, reason: GapReason::Recorded };
        self.writer.recorder.gap(&gap)?;
        self.report.lost.push(gap);
        Ok(())
    }
}

/// Number of frames of a chunk, by the message indexes that follow it.
fn frames_by_index(
    records: &mut Records,
    at: u64,
    channels: &BTreeMap<u16, Topic>,
) -> Result<Option<u64>, RecordingError> {
    records.go_to(at)?;
    let (mut body, mut frames) = (Vec::new(), None);
    let mut is_first = true;
    loop {
        match records.next(&mut body, |opcode| opcode == op::MESSAGE_INDEX) {
            Ok(Next::Record(op::MESSAGE_INDEX, _)) => match parse_record(op::MESSAGE_INDEX, &body) {
                Ok(Record::MessageIndex(index)) => {
                    let is_frames = channels.get(&index.channel_id) == Some(&Topic::Frame);
                    frames = Some(frames.unwrap_or(0) + if is_frames { index.records.len() as u64 } else { 0 });
                }
                _ => return Ok(None),
            },
            Ok(Next::Record(..)) if is_first => is_first = false,
            Ok(_) | Err(RecordingError::Corrupt { .. }) => return Ok(frames),
            Err(error) => return Err(error),
        }
    }
}

/// Finds the start of the first chunk from here on. A chunk has an opcode, a length, and 28 bytes later the
/// compression's name and a length that agrees with the first.
fn next_chunk(records: &mut Records, from: u64) -> Result<Option<u64>, RecordingError> {
    const BLOCK: usize = 1 << 20;
    const HEAD: usize = RECORD_HEADER as usize + 44;
    let mut block = vec![0; BLOCK];
    let mut start = from;
    while start < records.length {
        let filled = records.peek(start, &mut block)?;
        let bytes = block.get(..filled).unwrap_or(&[]);
        for (index, head) in bytes.windows(HEAD).enumerate() {
            if head.first() != Some(&op::CHUNK) || head.get(37..45) != Some(b"\x04\0\0\0zstd") {
                continue;
            }
            let number = |at: usize| head.get(at..).and_then(|b| b.first_chunk()).map_or(0, |b| u64::from_le_bytes(*b));
            let length = number(1);
            if length <= MAX_RECORD && number(45).checked_add(44) == Some(length) {
                return Ok(Some(start + index as u64));
            }
        }
        if filled < BLOCK {
            break;
        }
        start += (BLOCK - HEAD + 1) as u64;
    }
    Ok(None)
}
