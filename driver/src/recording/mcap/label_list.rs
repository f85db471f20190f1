//! Replacement of the labels of a finished recording, without a change of its frames. A chunk with the whole list is
//! written where the data ended, in place of an earlier chunk of this kind. The summary is written behind it. The
//! recording does not grow.

use std::fs::File;
use std::path::{Path, PathBuf};

use crc32fast::Hasher;
use mcap::records::{MessageHeader, Record, Statistics, op};

use super::encode::{Chunk, SummaryLayout, body_of, is_intact, record};
use super::index::{FOOTER, summary_start};
use super::lengths::parse_record;
use super::records::{DATA_END_BYTES, MAX_RECORD, Next, RECORD_HEADER, Records, Topic, topic};
use super::staged::{self, RecordingEnd};
use super::{LABELS, LabelSpan, McapReader};
use crate::recording::lock::{LABELS_LOCK_TIMEOUT, Locked, lock};
use crate::recording::{RecordingError, disk};

/// Editor of the labels of a finished recording, which it locks against other writers.
#[derive(Debug)]
pub struct LabelEditor {
    path: PathBuf,
    locked: Locked,
}

impl LabelEditor {
    /// Locks a recording.
    ///
    /// # Errors
    /// [`RecordingError::Locked`] if another writer holds it for two seconds, [`RecordingError::Unfinished`] if it was
    /// never finished, and another [`RecordingError`] if the file cannot be read.
    pub fn open(path: &Path) -> Result<Self, RecordingError> {
        let open = || File::options().read(true).write(true).open(path);
        let locked = lock(path, LABELS_LOCK_TIMEOUT, open)?;
        // Completes a write that a power cut has interrupted.
        if let Some(end) = staged::read(path)?.and_then(|staged| staged.end) {
            staged::write_end(locked.file(), path, &end).map_err(RecordingError::cannot_write(path))?;
        }
        data_end(&mut Records::open(path)?)?;
        Ok(LabelEditor { path: path.to_owned(), locked })
    }

    /// Reads all labels.
    ///
    /// # Errors
    /// [`RecordingError`] if the labels cannot be read.
    pub fn labels(&self) -> Result<Vec<LabelSpan>, RecordingError> {
        match staged::read(&self.path)? {
            Some(staged) => Ok(staged.labels),
            None => McapReader::open(&self.path)?.labels(),
        }
    }

    /// Replaces all labels of the recording by these, in a file beside it until [`LabelEditor::write`] or
    /// [`LabelEditor::settle`]. The time needed grows with the labels alone. Every reader finds the labels, and they
    /// are on the disk when this returns.
    ///
    /// # Errors
    /// [`RecordingError::Io`]; the earlier labels are then still there.
    pub fn stage(&self, labels: &[LabelSpan]) -> Result<(), RecordingError> {
        let end = data_end(&mut Records::open(&self.path)?)?;
        staged::write(&self.path, end, labels, None)
    }

    /// Replaces all labels of the recording by these. Records of other programs stay. At any moment, and after a power
    /// cut, every reader finds all frames and either the old labels or the new ones.
    ///
    /// # Errors
    /// [`RecordingError::Io`], or [`RecordingError::Corrupt`] if the summary contradicts the file.
    pub fn write(&self, labels: &[LabelSpan]) -> Result<(), RecordingError> {
        let mut records = Records::open(&self.path)?;
        let end = new_end(&mut records, labels)?;
        disk::reserve(self.locked.file(), end.at, end.bytes.len() as u64)
            .map_err(RecordingError::cannot_write(&self.path))?;
        staged::write(&self.path, end.at, labels, Some(&end))?;
        staged::write_end(self.locked.file(), &self.path, &end).map_err(RecordingError::cannot_write(&self.path))
    }

    /// Moves staged labels into the recording.
    ///
    /// # Errors
    /// Those of [`LabelEditor::write`].
    pub fn settle(&self) -> Result<(), RecordingError> {
        match staged::read(&self.path)? {
            Some(staged) => self.write(&staged.labels),
            None => Ok(()),
        }
    }
}

/// Replaces the labels of a finished recording by these: see [`LabelEditor`].
///
/// # Errors
/// Those of [`LabelEditor::open`] and [`LabelEditor::write`].
pub fn set_labels(path: &Path, labels: &[LabelSpan]) -> Result<(), RecordingError> {
    LabelEditor::open(path)?.write(labels)
}

/// Replaces all labels of a recording that this process is making: a file beside it holds them until its recorder
/// finishes. They are on the disk when this returns, and every reader finds them.
///
/// # Errors
/// [`RecordingError::Io`], also if there is no recording yet; the earlier labels are then still there.
pub fn stage_labels(path: &Path, labels: &[LabelSpan]) -> Result<(), RecordingError> {
    let file =
        File::options().read(true).write(true).open(path).map_err(RecordingError::io(path, "cannot be opened"))?;
    let length = file.metadata().map_err(RecordingError::cannot_read(path))?.len();
    // Staged labels name the recording by its first bytes, which must survive a power cut.
    disk::sync(&file, path).map_err(RecordingError::cannot_write(path))?;
    staged::write(path, length, labels, None)
}

/// Offset of the DATA_END record of a finished recording.
fn data_end(records: &mut Records) -> Result<u64, RecordingError> {
    let length = records.length;
    let unfinished = RecordingError::Unfinished { path: records.path.clone() };
    let Some(summary_start) = summary_start(records)? else { return Err(unfinished) };
    let no_summary = || records.corrupt(length, "its summary is not where its footer says".into());
    let end = summary_start.checked_sub(DATA_END_BYTES).filter(|_| summary_start <= length - FOOTER);
    let end = end.ok_or_else(no_summary)?;
    let mut data_end = [0; RECORD_HEADER as usize];
    records.peek(end, &mut data_end)?;
    if data_end != [op::DATA_END, 4, 0, 0, 0, 0, 0, 0, 0] {
        return Err(records.corrupt(end, "no end of the data where the summary starts".into()));
    }
    Ok(end)
}

/// Encodes the end of a recording with these labels, from its last frames on.
fn new_end(records: &mut Records, labels: &[LabelSpan]) -> Result<RecordingEnd, RecordingError> {
    let (end, length) = (data_end(records)?, records.length);
    // Checked before memory is allocated: a footer may be wrong.
    if length - end > MAX_RECORD {
        let reason = format!("a summary of {} bytes, expected at most {MAX_RECORD} where labels change", length - end);
        return Err(records.corrupt(end, reason));
    }
    let mut bytes = vec![0; usize::try_from(length - end).unwrap_or(0)];
    records.peek(end, &mut bytes)?;
    let (before_footer, footer) = bytes.split_at(bytes.len().saturating_sub(FOOTER as usize));
    let summary = before_footer.get(DATA_END_BYTES as usize..).unwrap_or(&[]);
    let summary_start = end + DATA_END_BYTES;
    let mut crc = Hasher::new();
    crc.update(summary);
    if !is_intact(crc, footer) {
        let reason =
            "the summary is damaged, so that labels cannot be written; radome recording repair makes a new one";
        return Err(records.corrupt(summary_start, reason.into()));
    }
    let mut summary = Summary::parse(summary).map_err(|reason| records.corrupt(summary_start, reason))?;
    let at = summary.drop_label_chunks(records, end)?;
    // The chunk of the labels would be the only one in the index, by which other programs find messages.
    let has_chunks = summary.records.iter().any(|(opcode, _)| *opcode == op::CHUNK_INDEX);
    if !has_chunks && summary.statistics.message_count > 0 {
        let reason =
            "there is no index of chunks, without which labels cannot be written; radome recording repair makes one";
        return Err(records.corrupt(summary_start, reason.into()));
    }
    let json = serde_json::to_vec(labels).map_err(|e| RecordingError::cannot_write(&records.path)(e.into()))?;
    let bytes = summary.with_labels(at, &json).map_err(RecordingError::cannot_write(&records.path))?;
    Ok(RecordingEnd { at, bytes })
}

/// Summary of a file, with its records in their order.
struct Summary<'a> {
    records: Vec<(u8, &'a [u8])>,
    statistics: Statistics,
    /// Number and record of the channel of labels.
    channel: (u16, &'a [u8]),
}

impl<'a> Summary<'a> {
    fn parse(mut rest: &'a [u8]) -> Result<Self, String> {
        let (mut records, mut statistics, mut channel) = (Vec::new(), None, None);
        while let Some((header, behind)) = rest.split_first_chunk::<{ RECORD_HEADER as usize }>() {
            let [opcode, length @ ..] = *header;
            let length = usize::try_from(u64::from_le_bytes(length)).ok();
            let (body, next) =
                length.and_then(|n| behind.split_at_checked(n)).ok_or("a record of the summary is cut")?;
            rest = next;
            match opcode {
                op::STATISTICS | op::CHANNEL => match parse_record(opcode, body).map_err(|e| e.to_string())? {
                    Record::Statistics(parsed) => statistics = Some(parsed),
                    Record::Channel(parsed) if topic(&parsed.topic) == Some(Topic::Label) => {
                        channel = Some((parsed.id, body))
                    }
                    _ => {}
                },
                // The offsets will change.
                op::SUMMARY_OFFSET => continue,
                _ => {}
            }
            records.push((opcode, body));
        }
        let statistics = statistics.ok_or("the summary has no statistics")?;
        let channel = channel.ok_or_else(|| {
            format!(
                "the summary has no channel {LABELS}, so that labels cannot be written; radome recording repair makes a file that has it"
            )
        })?;
        Ok(Summary { records, statistics, channel })
    }

    /// Removes the chunks at the end of the data that hold labels alone: a new list replaces them. Returns the new end
    /// of the data.
    fn drop_label_chunks(&mut self, records: &mut Records, mut end: u64) -> Result<u64, RecordingError> {
        let label_channel = self.channel.0;
        let mut body = Vec::new();
        while let Some(last) = self.records.iter().rposition(|(opcode, _)| *opcode == op::CHUNK_INDEX) {
            let index = self.records.get(last).map(|(_, body)| parse_record(op::CHUNK_INDEX, body));
            let Some(Ok(Record::ChunkIndex(index))) = index else { break };
            let start = index.chunk_start_offset;
            let length = index.chunk_length.checked_add(index.message_index_length);
            let index_offset = index.message_index_offsets.get(&label_channel).copied();
            let (Some(length), Some(index_offset), 1) = (length, index_offset, index.message_index_offsets.len())
            else {
                break;
            };
            if start.checked_add(length) != Some(end) || start.checked_add(index.chunk_length) != Some(index_offset) {
                break;
            }
            // The index may be wrong.
            records.go_to(start)?;
            match records.next(&mut body, |_| false) {
                Ok(Next::Record(op::CHUNK, _)) if records.offset == index_offset => {}
                Ok(_) | Err(RecordingError::Corrupt { .. }) => break,
                Err(error) => return Err(error),
            }
            let messages = match records.next(&mut body, |opcode| opcode == op::MESSAGE_INDEX) {
                Ok(Next::Record(op::MESSAGE_INDEX, _)) => match parse_record(op::MESSAGE_INDEX, &body) {
                    Ok(Record::MessageIndex(index)) if index.channel_id == label_channel => index.records.len() as u64,
                    _ => break,
                },
                Ok(_) | Err(RecordingError::Corrupt { .. }) => break,
                Err(error) => return Err(error),
            };
            let statistics = &mut self.statistics;
            statistics.message_count = statistics.message_count.saturating_sub(messages);
            statistics.chunk_count = statistics.chunk_count.saturating_sub(1);
            let count = statistics.channel_message_counts.entry(label_channel).or_default();
            *count = count.saturating_sub(messages);
            self.records.remove(last);
            end = start;
        }
        Ok(end)
    }

    /// Encodes the file from the end of the data on, with a chunk of this message added at `end`.
    fn with_labels(self, end: u64, json: &[u8]) -> std::io::Result<Vec<u8>> {
        let (id, channel) = self.channel;
        let time = self.statistics.message_end_time;
        let mut chunk = Chunk::new()?;
        chunk.record(op::CHANNEL, &[channel])?;
        chunk.message(&MessageHeader { channel_id: id, sequence: 0, log_time: time, publish_time: time }, json)?;
        let mut tail = Vec::new();
        let new_index = body_of(&chunk.finish(&mut tail, end)?);
        // The record has no CRC, because the data were not read.
        record(&mut tail, op::DATA_END, &[0; 4]);

        let mut statistics = self.statistics;
        statistics.message_count += 1;
        statistics.chunk_count += 1;
        *statistics.channel_message_counts.entry(id).or_default() += 1;
        let statistics = body_of(&statistics);
        // The new entry goes behind the last record of its kind, or behind all records.
        let last = self.records.iter().rposition(|(opcode, _)| *opcode == op::CHUNK_INDEX);
        let insert_position = last.map_or(self.records.len(), |last| last + 1);
        let (before, after) = self.records.split_at(insert_position);
        let all = before.iter().copied().chain([(op::CHUNK_INDEX, new_index.as_slice())]).chain(after.iter().copied());
        let mut summary = SummaryLayout::new(end + tail.len() as u64);
        for (opcode, body) in all {
            summary.record(&mut tail, opcode, if opcode == op::STATISTICS { &statistics } else { body });
        }
        let footer = summary.finish(&mut tail);
        tail.extend(footer);
        Ok(tail)
    }
}

#[cfg(test)]
mod tests {
    use std::io::{Seek, SeekFrom, Write};

    use radome_dsp::Frame;

    use super::*;
    use crate::pattern::{rewritten, waveform};
    use crate::recording::mcap::{Recorder, RecordingHeader};

    /// Asserts that the reader finds the messages outside of chunks if labels are the only chunk in the index.
    #[test]
    fn labels_in_the_only_chunk_of_a_file_hide_no_frame() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("a.mcap");
        let header = RecordingHeader::new(waveform(&[1], 8, 64, 0.1));
        let labels = [LabelSpan::new(0.0, 0.2, "one")];
        let mut recorder = Recorder::create(&path, &header).expect("creates");
        let mut frame = Frame::zeroed(header.waveform.shape());
        for sequence in 0..3 {
            (frame.sequence, frame.time_ns) = (sequence, header.waveform.frame_time_ns(sequence));
            recorder.frame(&frame).expect("records");
        }
        recorder.label(&labels[0]).expect("records");
        recorder.finish().expect("finishes");

        // The same messages without chunks, as another program may write them.
        let bytes = rewritten(&std::fs::read(&path).expect("reads"), mcap::WriteOptions::new().use_chunks(false));
        std::fs::write(&path, &bytes).expect("writes");

        let end = data_end(&mut Records::open(&path).expect("opens")).expect("finished");
        let (data, rest) = bytes.split_at(end as usize);
        let summary = &rest[DATA_END_BYTES as usize..rest.len() - FOOTER as usize];
        let json = serde_json::to_vec(&labels).expect("JSON");
        let tail = Summary::parse(summary).expect("a summary").with_labels(end, &json).expect("encodes");
        std::fs::write(&path, [data, tail.as_slice()].concat()).expect("writes");
        let reader = McapReader::open(&path).expect("opens");
        assert_eq!((reader.whole_frames(), reader.labels().expect("labels")), (3, labels.to_vec()));
    }

    /// Recordings of several months have such a summary. The test uses a sparse file.
    #[test]
    fn labels_of_a_recording_with_a_huge_summary_stay_beside_it() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("a.mcap");
        let header = RecordingHeader::new(waveform(&[1], 8, 64, 0.1));
        Recorder::create(&path, &header).and_then(Recorder::finish).expect("records");
        let bytes = std::fs::read(&path).expect("reads");
        let footer = bytes.split_at(bytes.len() - FOOTER as usize).1;
        let mut file = File::options().write(true).open(&path).expect("opens");
        file.seek(SeekFrom::Start(bytes.len() as u64 + MAX_RECORD)).expect("seeks");
        file.write_all(footer).expect("writes");

        let editor = LabelEditor::open(&path).expect("opens");
        editor.settle().expect("there is nothing to settle");
        let labels = [LabelSpan::new(0.0, 1.0, "one")];
        editor.stage(&labels).expect("stages");
        assert_eq!(editor.labels().expect("labels"), labels);
        let error = editor.settle().expect_err("refused").to_string();
        assert!(error.contains("a.mcap") && error.contains("a summary of"), "{error}");
        assert_eq!(editor.labels().expect("labels"), labels);
    }
}
