//! All labels of a finished recording anew, without touching its frames: a chunk with the whole list goes where the data ended,
//! and the summary behind it. Whatever happens meanwhile, frames and earlier labels stay readable.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Seek, SeekFrom, Write};
use std::path::Path;

use mcap::records::{ChunkIndex, Record, Statistics, op};

use super::index::summary_start;
use super::lengths::parse_record;
use super::records::{MAX_RECORD, RECORD_HEADER, Records, Topic, topic};
use super::{LABELS, LabelSpan};
use crate::recording::RecordingError;

/// DATA_END: opcode, length, CRC.
const DATA_END_BYTES: u64 = RECORD_HEADER + 4;
/// Footer record and magic.
const FOOTER_BYTES: u64 = RECORD_HEADER + 20 + 8;

/// Makes these the labels of a finished recording, in place of those it has: in a time that does not grow with the recording's
/// length. What others have put into the file stays.
pub fn set_labels(path: &Path, labels: &[LabelSpan]) -> Result<(), RecordingError> {
    let mut records = Records::open(path)?;
    let length = records.length;
    let unfinished = RecordingError::Unfinished { path: path.to_owned(), offset: length };
    let Some(summary_start) = summary_start(&mut records)? else { return Err(unfinished) };
    let no_summary = || records.corrupt(length, "its summary is not where its footer says".into());
    let end = summary_start.checked_sub(DATA_END_BYTES).filter(|_| summary_start <= length - FOOTER_BYTES);
    let end = end.ok_or_else(no_summary)?;
    // Before anything is set aside for it: a footer may lie.
    let mut data_end = [0; RECORD_HEADER as usize];
    records.peek(end, &mut data_end)?;
    if data_end != [op::DATA_END, 4, 0, 0, 0, 0, 0, 0, 0] || length - end > MAX_RECORD {
        return Err(records.corrupt(end, "no end of the data where the summary starts".into()));
    }
    let mut bytes = vec![0; usize::try_from(length - end).unwrap_or(0)];
    records.peek(end, &mut bytes)?;
    let summary = bytes.get(DATA_END_BYTES as usize..bytes.len() - FOOTER_BYTES as usize).unwrap_or(&[]);
    let summary = Summary::parse(summary).map_err(|reason| records.corrupt(summary_start, reason))?;
    let json = serde_json::to_vec(labels).map_err(|e| RecordingError::cannot_write(path)(e.into()))?;
    let tail = summary.with_labels(end, &json).map_err(RecordingError::cannot_write(path))?;
    let write = || {
        let mut file = File::options().write(true).open(path)?;
        file.seek(SeekFrom::Start(end))?;
        // At once, so that who reads finds either the old end or the new one.
        file.write_all(&tail)?;
        file.sync_all()
    };
    write().map_err(RecordingError::cannot_write(path))
}

/// The summary of a file, its records in their order.
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
                    Record::Statistics(found) => statistics = Some(found),
                    Record::Channel(found) if topic(&found.topic) == Some(Topic::Label) => {
                        channel = Some((found.id, body))
                    }
                    _ => {}
                },
                // Places, which will be others.
                op::SUMMARY_OFFSET => continue,
                _ => {}
            }
            records.push((opcode, body));
        }
        let statistics = statistics.ok_or("the summary has no statistics")?;
        let channel = channel.ok_or_else(|| format!("the summary has no channel {LABELS}"))?;
        Ok(Summary { records, statistics, channel })
    }

    /// What stands from the end of the data on when a chunk with this message has been added at `end`.
    fn with_labels(self, end: u64, json: &[u8]) -> std::io::Result<Vec<u8>> {
        let (id, channel) = self.channel;
        let time = self.statistics.message_end_time;
        let mut content = Vec::new();
        record(&mut content, op::CHANNEL, channel);
        let message_at = content.len() as u64;
        // Channel, number within it, both times.
        let head = [&id.to_le_bytes()[..], &0u32.to_le_bytes(), &time.to_le_bytes(), &time.to_le_bytes()].concat();
        record(&mut content, op::MESSAGE, &[head.as_slice(), json].concat());
        let packed = zstd::encode_all(content.as_slice(), 1)?;

        let mut tail = Vec::new();
        let (crc, sizes) = (crc32fast::hash(&content), (packed.len() as u64, content.len() as u64));
        let mut chunk = [time.to_le_bytes(), time.to_le_bytes(), sizes.1.to_le_bytes()].concat();
        chunk.extend(crc.to_le_bytes());
        string(&mut chunk, "zstd");
        chunk.extend(sizes.0.to_le_bytes());
        chunk.extend(&packed);
        record(&mut tail, op::CHUNK, &chunk);
        let chunk_length = tail.len() as u64;
        let index = [&id.to_le_bytes()[..], &16u32.to_le_bytes(), &time.to_le_bytes(), &message_at.to_le_bytes()];
        record(&mut tail, op::MESSAGE_INDEX, &index.concat());
        let chunk_index = ChunkIndex {
            message_start_time: time,
            message_end_time: time,
            chunk_start_offset: end,
            chunk_length,
            message_index_offsets: BTreeMap::from([(id, end + chunk_length)]),
            message_index_length: tail.len() as u64 - chunk_length,
            compression: "zstd".to_owned(),
            compressed_size: sizes.0,
            uncompressed_size: sizes.1,
        };
        // No CRC over data that were not read.
        record(&mut tail, op::DATA_END, &[0; 4]);

        let summary_start = end + tail.len() as u64;
        let mut statistics = self.statistics;
        statistics.message_count += 1;
        statistics.chunk_count += 1;
        *statistics.channel_message_counts.entry(id).or_default() += 1;
        let statistics = statistics_body(&statistics);
        let new_index = chunk_index_body(&chunk_index);
        // Behind the last of its kind, or behind everything.
        let last = self.records.iter().rposition(|(opcode, _)| *opcode == op::CHUNK_INDEX);
        let place = last.map_or(self.records.len(), |last| last + 1);
        let (before, after) = self.records.split_at(place);
        let all = before.iter().copied().chain([(op::CHUNK_INDEX, new_index.as_slice())]).chain(after.iter().copied());
        let mut groups: Vec<(u8, u64, u64)> = Vec::new();
        for (opcode, body) in all {
            let at = end + tail.len() as u64;
            record(&mut tail, opcode, if opcode == op::STATISTICS { &statistics } else { body });
            let length = end + tail.len() as u64 - at;
            match groups.last_mut().filter(|group| group.0 == opcode) {
                Some(group) => group.2 += length,
                None => groups.push((opcode, at, length)),
            }
        }
        let offsets_start = end + tail.len() as u64;
        for (opcode, start, length) in groups {
            let body = [&[opcode][..], &start.to_le_bytes(), &length.to_le_bytes()].concat();
            record(&mut tail, op::SUMMARY_OFFSET, &body);
        }
        let footer = [&summary_start.to_le_bytes()[..], &offsets_start.to_le_bytes(), &[0; 4]].concat();
        record(&mut tail, op::FOOTER, &footer);
        tail.extend(mcap::MAGIC);
        Ok(tail)
    }
}

fn record(out: &mut Vec<u8>, opcode: u8, body: &[u8]) {
    out.push(opcode);
    out.extend((body.len() as u64).to_le_bytes());
    out.extend(body);
}

fn string(out: &mut Vec<u8>, text: &str) {
    out.extend((text.len() as u32).to_le_bytes());
    out.extend(text.as_bytes());
}

fn map(out: &mut Vec<u8>, entries: &BTreeMap<u16, u64>) {
    out.extend((10 * entries.len() as u32).to_le_bytes());
    for (key, value) in entries {
        out.extend(key.to_le_bytes());
        out.extend(value.to_le_bytes());
    }
}

fn statistics_body(statistics: &Statistics) -> Vec<u8> {
    let mut out = statistics.message_count.to_le_bytes().to_vec();
    out.extend(statistics.schema_count.to_le_bytes());
    for count in
        [statistics.channel_count, statistics.attachment_count, statistics.metadata_count, statistics.chunk_count]
    {
        out.extend(count.to_le_bytes());
    }
    out.extend(statistics.message_start_time.to_le_bytes());
    out.extend(statistics.message_end_time.to_le_bytes());
    map(&mut out, &statistics.channel_message_counts);
    out
}

fn chunk_index_body(index: &ChunkIndex) -> Vec<u8> {
    let mut out = Vec::new();
    for number in [index.message_start_time, index.message_end_time, index.chunk_start_offset, index.chunk_length] {
        out.extend(number.to_le_bytes());
    }
    map(&mut out, &index.message_index_offsets);
    out.extend(index.message_index_length.to_le_bytes());
    string(&mut out, &index.compression);
    out.extend(index.compressed_size.to_le_bytes());
    out.extend(index.uncompressed_size.to_le_bytes());
    out
}
