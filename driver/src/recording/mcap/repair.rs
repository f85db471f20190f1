//! Repair of cut or damaged files: the readable part as a complete file, and a report of the rest.

use std::path::Path;

use mcap::records::{Record, op};
use radome_dsp::{Frame, Gap, GapReason};

use super::index::end_before_file;
use super::lengths::{CHUNK_MARK, content_length, has_valid_content, parse_record};
use super::reader::{TRAILING_DATA, parse_result};
use super::records::{Channels, Flaw, MAX_RECORD, Next, RECORD_HEADER, Records, Topic, messages_in, read_header_alone};
use super::{LabelSpan, McapWriter, RecordingHeader, apply_label_message, decode_frame, staged};
use crate::recording::{Existing, RecordingError};

/// Length of the head of a chunk: everything before its compressed records.
const CHUNK_HEAD: usize = RECORD_HEADER as usize + 44;
/// Position of the compression in the head of a chunk.
const CHUNK_MARK_AT: std::ops::Range<usize> = 37..45;
/// Bytes that are read of a record between chunks, to find the end of its content.
const RECORD_BLOCK: usize = 1 << 16;
/// Shortest duration of a label that was clipped, s; shorter ones are left out.
const SHORTEST_LABEL_S: f64 = 1e-3;

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
    /// Labels left out, because no frame that was written is theirs.
    pub labels_left_out: u64,
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
/// right. Unreadable parts become gaps. Format version and waveform in the file's header must be intact. Labels that are
/// staged beside the input are taken in place of those in it. Labels are cut to the frames that are written, from the first one to the
/// end of the last one. `existing` decides whether a file at `output` is replaced.
///
/// # Errors
/// [`RecordingError`] if format version or waveform of the input are damaged, both are the same file, the output exists and
/// must not be replaced or has another writer, and [`RecordingError::Io`].
pub fn repair(input: &Path, output: &Path, existing: Existing) -> Result<RepairReport, RecordingError> {
    repair_unless(input, output, None, existing, || false)
}

/// Repairs a file as [`repair`] does, unless `is_interrupted` returns true before the end: nothing is written then. Where the
/// input's own header is damaged, `header` takes its place; its waveform has to be that of the frames.
///
/// # Errors
/// Those of [`repair`], and [`RecordingError::Interrupted`].
pub fn repair_unless(
    input: &Path,
    output: &Path,
    header: Option<RecordingHeader>,
    existing: Existing,
    is_interrupted: impl Fn() -> bool,
) -> Result<RepairReport, RecordingError> {
    let is_same = |a: &Path, b: &Path| a.canonicalize().is_ok_and(|a| b.canonicalize().is_ok_and(|b| a == b));
    if is_same(input, output) {
        return Err(RecordingError::Occupied { path: output.to_owned() });
    }
    let mut records = Records::open(input)?;
    let (header, header_at, flaws) = match (read_header_alone(&mut records), header) {
        (Err(RecordingError::Corrupt { offset, reason, .. }), Some(header)) => {
            (header, offset, vec![Flaw { reason, bytes: 0 }])
        }
        (read, _) => read?,
    };
    let writer = McapWriter::create(output, &header, existing)?;
    let frame = Frame::zeroed(header.waveform.shape());
    let damage =
        flaws.into_iter().map(|Flaw { reason, bytes }| Damage { offset: header_at, bytes, frames: Some(0), reason });
    let report = RepairReport { damage: damage.collect(), ..RepairReport::default() };
    let mut repair = Repair {
        writer,
        header,
        frame,
        report,
        expected_sequence: None,
        extent_s: None,
        unread: None,
        labels: Vec::new(),
        staged: None,
        has_loose_messages: false,
    };
    repair.staged = staged::read(input)?.map(|staged| staged.labels);
    let check = || match is_interrupted() {
        true => Err(RecordingError::Interrupted { path: output.to_owned() }),
        false => Ok(()),
    };
    repair.copy(&mut records, &check)?;
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
    expected_sequence: Option<u64>,
    /// Start of the earliest frame that was written, and end of the latest one, s.
    extent_s: Option<(f64, f64)>,
    /// Frames that could not be read since the last good one.
    unread: Option<Unread>,
    /// Labels so far; later ones may take the place of earlier ones.
    labels: Vec<LabelSpan>,
    /// Labels beside the input, in place of all in it.
    staged: Option<Vec<LabelSpan>>,
    /// Whether messages outside of chunks were read.
    has_loose_messages: bool,
}

impl Repair {
    /// Copies all messages; `check` is asked before each record.
    fn copy(
        &mut self,
        records: &mut Records,
        check: &dyn Fn() -> Result<(), RecordingError>,
    ) -> Result<(), RecordingError> {
        // Numbers that the recorder uses; the first chunk states them, if it can be read.
        let channels = [Topic::Frame, Topic::Gap, Topic::Label, Topic::Result].map(Some);
        let mut channels: Channels = (1..).zip(channels).collect();
        let mut body = Vec::new();
        records.go_to(8)?;
        loop {
            check()?;
            let at = records.offset;
            let goes_on = match self.copy_record(records, &mut body, &mut channels) {
                Err(RecordingError::Corrupt { reason, .. }) => self.skip(records, at, reason, &channels)?,
                result => result?,
            };
            if !goes_on {
                break;
            }
        }
        // Frames lost at the end.
        self.write_gap_before(None)?;
        self.write_labels()
    }

    /// Copies the messages of the next record; returns `false` at the end. A damaged record is [`RecordingError::Corrupt`].
    fn copy_record(
        &mut self,
        records: &mut Records,
        body: &mut Vec<u8>,
        channels: &mut Channels,
    ) -> Result<bool, RecordingError> {
        let at = records.offset;
        let opcode = match records.next(body, |opcode| opcode < 0x80)? {
            Next::Record(opcode, _) => opcode,
            Next::End => {
                self.report.was_finished = true;
                if let Some(end) = end_before_file(records, at)? {
                    let reason = TRAILING_DATA.to_owned();
                    let damage = Damage { offset: end, bytes: records.length - end, frames: None, reason };
                    self.report.damage.push(damage);
                }
                return Ok(false);
            }
            Next::CutShort if at == records.length => return Ok(false),
            Next::CutShort => return Err(records.corrupt(at, "the file ends within a record".into())),
        };
        // Records of other programs look like damaged ones.
        if opcode >= 0x80 {
            return Err(records.corrupt(at, format!("{opcode:#04x} is no record of a recording")));
        }
        // A damaged length may reach over chunks that are intact.
        if opcode != op::CHUNK && !has_exact_length(records, opcode, body)? {
            return Err(records.corrupt(at, "the length of a record is not that of its content".into()));
        }
        let messages = messages_in(records, opcode, at, body, channels)?;
        self.has_loose_messages |= opcode == op::MESSAGE;
        for (topic, data) in messages {
            self.copy_message(at, topic, &data)?;
        }
        Ok(true)
    }

    /// Writes the labels, cut to the frames that were written.
    fn write_labels(&mut self) -> Result<(), RecordingError> {
        let labels = std::mem::take(&mut self.labels);
        for label in self.staged.take().unwrap_or(labels) {
            match self.extent_s.and_then(|extent_s| clip_label(&label, extent_s)) {
                Some(label) => {
                    self.writer.recorder.label(&label)?;
                    self.report.labels += 1;
                }
                None => self.report.labels_left_out += 1,
            }
        }
        Ok(())
    }

    /// Notes the damaged record that starts here, and goes to where the file can be read again; `false` if there is no such place.
    fn skip(
        &mut self,
        records: &mut Records,
        at: u64,
        reason: String,
        channels: &Channels,
    ) -> Result<bool, RecordingError> {
        let mut head = [0u8; CHUNK_HEAD];
        records.peek(at, &mut head)?;
        let [opcode, ..] = head;
        // A chunk whose opcode is damaged shows by its compression.
        let is_chunk = opcode == op::CHUNK || head.get(CHUNK_MARK_AT) == Some(CHUNK_MARK);
        let frames = if is_chunk { frames_by_index(records, at, channels)? } else { None };
        let chunk = next_chunk(records, at + 1)?;
        // Where the content leads to the next record, and over no chunk, only a length is damaged.
        let after_content = if is_chunk { None } else { content_end(records, at, opcode)? };
        let after_content = after_content.filter(|after_content| chunk.is_none_or(|chunk| *after_content <= chunk));
        let next = after_content.or(chunk);
        let damage = Damage { offset: at, bytes: next.unwrap_or(records.length) - at, frames, reason };
        match after_content.is_none() && (is_chunk || chunk.is_some() || self.has_loose_messages) {
            true => self.note_damage(damage),
            // Behind the last chunk there are no frames.
            false => self.report.damage.push(damage),
        }
        if let Some(next) = next {
            records.go_to(next)?;
        }
        Ok(next.is_some())
    }

    /// Notes damage that may have lost frames.
    fn note_damage(&mut self, damage: Damage) {
        let unread = self.unread.get_or_insert_default();
        unread.frames += damage.frames.unwrap_or(0);
        unread.uncounted |= damage.frames.is_none();
        self.report.damage.push(damage);
    }

    /// Copies a message.
    fn copy_message(&mut self, at: u64, topic: Topic, data: &[u8]) -> Result<(), RecordingError> {
        let malformed = |reason| Damage { offset: at, bytes: data.len() as u64, frames: None, reason };
        match topic {
            Topic::Frame => match decode_frame(data, self.header.waveform.shape(), &mut self.frame) {
                Ok(()) => self.write_frame()?,
                Err(reason) => self.note_damage(Damage { frames: Some(1), ..malformed(reason) }),
            },
            Topic::Gap => match serde_json::from_slice::<Gap>(data) {
                Ok(gap) => {
                    self.write_gap_before(Some(gap.first_sequence))?;
                    self.writer.recorder.gap(&gap)?;
                    self.expected_sequence = gap.first_sequence.checked_add(gap.frames);
                    self.report.gaps += 1;
                }
                Err(error) => self.note_damage(malformed(format!("a gap is malformed: {error}"))),
            },
            Topic::Label => {
                if let Err(error) = apply_label_message(data, &mut self.labels) {
                    self.report.damage.push(malformed(format!("a label is malformed: {error}")));
                }
            }
            Topic::Result => match parse_result(data) {
                Ok(_) if self.header.judge.is_none() => {
                    let damage = malformed("results, but the header names no judge".into());
                    match self.report.damage.last_mut().filter(|last| last.reason == damage.reason) {
                        Some(last) => last.bytes += damage.bytes,
                        None => self.report.damage.push(damage),
                    }
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

    /// Writes the frame that was decoded.
    fn write_frame(&mut self) -> Result<(), RecordingError> {
        self.write_gap_before(Some(self.frame.sequence))?;
        self.writer.recorder.frame(&self.frame)?;
        self.expected_sequence = self.frame.sequence.checked_add(1);
        let (start_s, interval_s) = (self.frame.time_s(), self.header.waveform.frame_interval_s());
        let (first_s, end_s) = self.extent_s.unwrap_or((start_s, start_s));
        self.extent_s = Some((first_s.min(start_s), end_s.max(start_s + interval_s)));
        self.report.frames += 1;
        Ok(())
    }

    /// Writes the frames that are missing before this number as a gap; `None` at the end of the file.
    fn write_gap_before(&mut self, sequence: Option<u64>) -> Result<(), RecordingError> {
        let Some(unread) = self.unread.take() else { return Ok(()) };
        let (first_sequence, frames) = match (self.expected_sequence, sequence) {
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

/// Cuts a label to a span of time; `None` if it lies outside of it. A label within it stays as it is, also one of free text without
/// duration.
fn clip_label(label: &LabelSpan, (first_s, end_s): (f64, f64)) -> Option<LabelSpan> {
    let rest = LabelSpan { start_s: label.start_s.max(first_s), end_s: label.end_s.min(end_s), ..label.clone() };
    (rest == *label || rest.end_s - rest.start_s >= SHORTEST_LABEL_S).then_some(rest)
}

/// Number of frames of a chunk, by the message indexes that follow it.
fn frames_by_index(records: &mut Records, at: u64, channels: &Channels) -> Result<Option<u64>, RecordingError> {
    records.go_to(at)?;
    let (mut body, mut frames) = (Vec::new(), None);
    let mut is_first = true;
    loop {
        match records.next(&mut body, |opcode| opcode == op::MESSAGE_INDEX) {
            Ok(Next::Record(op::MESSAGE_INDEX, _)) => match parse_record(op::MESSAGE_INDEX, &body) {
                Ok(Record::MessageIndex(index)) => {
                    let is_frames = channels.get(&index.channel_id) == Some(&Some(Topic::Frame));
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

/// Returns whether the record that was just read is as long as its content, or longer as later versions of MCAP may make it: then
/// another record follows.
fn has_exact_length(records: &mut Records, opcode: u8, body: &[u8]) -> Result<bool, RecordingError> {
    let end = records.offset;
    // A chunk whose opcode has become another one's.
    if body.get(CHUNK_MARK_AT.start - RECORD_HEADER as usize..).is_some_and(|rest| rest.starts_with(CHUNK_MARK)) {
        return Ok(false);
    }
    let is_exact = content_length(opcode, body).is_none_or(|length| length == body.len());
    Ok(has_valid_content(opcode, body) && (is_exact || starts_record(records, end)?))
}

/// End of the content of the record that starts here, if the next record starts there. The record's own length is not used.
fn content_end(records: &mut Records, at: u64, opcode: u8) -> Result<Option<u64>, RecordingError> {
    let mut block = vec![0; RECORD_BLOCK];
    let filled = records.peek(at + RECORD_HEADER, &mut block)?;
    let Some(length) = content_length(opcode, block.get(..filled).unwrap_or(&[])) else { return Ok(None) };
    let end = at + RECORD_HEADER + length as u64;
    Ok(starts_record(records, end)?.then_some(end))
}

/// Returns whether the file ends here, or a record starts here whose length agrees with its content.
fn starts_record(records: &mut Records, at: u64) -> Result<bool, RecordingError> {
    if at == records.length {
        return Ok(true);
    }
    let mut block = vec![0; RECORD_BLOCK];
    let filled = records.peek(at, &mut block)?;
    let block = block.get(..filled).unwrap_or(&[]);
    let Some((&[opcode, ref length @ ..], body)) = block.split_first_chunk::<{ RECORD_HEADER as usize }>() else {
        return Ok(false);
    };
    let length = u64::from_le_bytes(*length);
    let fits = length <= records.length.saturating_sub(at + RECORD_HEADER);
    Ok(match opcode {
        // The last chunk of an unfinished file may be cut.
        op::CHUNK => block.get(..CHUNK_HEAD).is_some_and(is_chunk_head),
        op::HEADER | op::SCHEMA | op::CHANNEL | op::METADATA | op::MESSAGE_INDEX => {
            fits && content_length(opcode, body).is_some_and(|content| content as u64 <= length)
        }
        _ => fits && (1..=op::DATA_END).contains(&opcode),
    })
}

/// Returns whether these bytes are the head of a chunk, whose two lengths agree.
fn is_chunk_head(head: &[u8]) -> bool {
    if head.first() != Some(&op::CHUNK) || head.get(CHUNK_MARK_AT) != Some(CHUNK_MARK) {
        return false;
    }
    let number = |at: usize| head.get(at..).and_then(|b| b.first_chunk()).map_or(0, |b| u64::from_le_bytes(*b));
    let length = number(1);
    length <= MAX_RECORD && number(CHUNK_MARK_AT.end).checked_add(44) == Some(length)
}

/// Finds the start of the first chunk from here on. A chunk has an opcode, a length, and 28 bytes later the
/// compression's name and a length that agrees with the first.
fn next_chunk(records: &mut Records, from: u64) -> Result<Option<u64>, RecordingError> {
    const BLOCK: usize = 1 << 20;
    let mut block = vec![0; BLOCK];
    let mut start = from;
    while start < records.length {
        let filled = records.peek(start, &mut block)?;
        let bytes = block.get(..filled).unwrap_or(&[]);
        if let Some(index) = bytes.windows(CHUNK_HEAD).position(is_chunk_head) {
            return Ok(Some(start + index as u64));
        }
        if filled < BLOCK {
            break;
        }
        start += (BLOCK - CHUNK_HEAD + 1) as u64;
    }
    Ok(None)
}
