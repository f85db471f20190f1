//! Writing.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufWriter, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use mcap::records::{MessageHeader, Metadata, op};
use mcap::{Compression, McapError, WriteOptions, Writer};
use radome_dsp::{Frame, FrameShape, Gap, MAX_CODE};

use super::{
    FORMAT_VERSION, FRAMES, FrameResult, GAPS, LABELS, LabelSpan, METADATA_NAME, RESULTS, RecordingHeader, encode_frame,
};
use crate::recording::RecordingError;

/// A chunk is written when it holds this many bytes.
const CHUNK_BYTES: usize = 4_000_000;
/// A chunk is written when it spans this much board time, ns.
const CHUNK_NS: u64 = 1_000_000_000;

/// Results are written as a chunk when there are so many, or with the frames' next chunk.
const RESULTS_OF_A_CHUNK: usize = 4096;

/// What a recording holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct RecordingSummary {
    /// Frames written.
    pub frames: u64,
    /// Gaps written.
    pub gaps: u64,
    /// Frames that the gaps are known to stand for.
    pub frames_lost: u64,
    /// Labels written.
    pub labels: u64,
    /// Results written.
    pub results: u64,
    /// Length of the file, bytes.
    pub bytes: u64,
}

/// Writes a recording. Without [`Recorder::finish`] the file stays readable up to its last chunk, but is marked
/// unfinished. However its process ends, every frame older than a second before the last one given to it can be read: a
/// chunk is complete on its way to the disk before it spans more.
pub struct Recorder {
    path: PathBuf,
    /// Taken when finished.
    writer: Option<Writer<BufWriter<File>>>,
    shape: FrameShape,
    channels: Vec<u16>,
    /// Results that wait for a chunk of their own.
    waiting: Vec<FrameResult>,
    buffer: Vec<u8>,
    chunk_bytes: usize,
    chunk_start_ns: u64,
    /// Log time of messages that have no time of their own.
    last_time_ns: u64,
    summary: RecordingSummary,
    message: u32,
}

fn failed(path: &Path, what: &'static str) -> impl FnOnce(McapError) -> RecordingError {
    let path = path.to_owned();
    move |error| {
        let source = match error {
            McapError::Io(source) => source,
            other => std::io::Error::other(other),
        };
        RecordingError::Io { path, what, source }
    }
}

impl Recorder {
    /// Creates the file, or empties it.
    pub fn create(path: &Path, header: &RecordingHeader) -> Result<Self, RecordingError> {
        let io = |source| RecordingError::Io { path: path.to_owned(), what: "cannot be created", source };
        let file = File::options().read(true).write(true).create(true).truncate(true).open(path).map_err(io)?;
        let file = BufWriter::new(file);
        let mut writer = WriteOptions::new()
            // Whole chunks at our word only: that is what survives a crash, and what makes bytes reproducible.
            .disable_seeking(true)
            .chunk_size(None)
            .compression(Some(Compression::Zstd))
            .compression_level(1)
            .compression_threads(0)
            // The summary is put into order afterwards, see `sort_channels`.
            .calculate_summary_section_crc(false)
            .library(concat!("radome ", env!("CARGO_PKG_VERSION")))
            .create(file)
            .map_err(failed(path, "cannot be written"))?;

        let json = |value: serde_json::Result<String>| value.map_err(|e| io(std::io::Error::other(e)));
        let mut metadata = BTreeMap::from([
            ("format_version".to_owned(), FORMAT_VERSION.to_string()),
            ("waveform".to_owned(), json(serde_json::to_string(&header.waveform))?),
            ("board".to_owned(), json(serde_json::to_string(&header.board))?),
            ("registers".to_owned(), json(serde_json::to_string(&header.registers))?),
        ]);
        if let Some(judge) = &header.judge {
            metadata.insert("judge".to_owned(), json(serde_json::to_string(judge))?);
        }
        let begin = || {
            writer.write_metadata(&Metadata { name: METADATA_NAME.to_owned(), metadata })?;
            let schema = writer.add_schema("radome.frame", "", &[])?;
            let none = BTreeMap::new();
            let mut channels = vec![
                writer.add_channel(schema, FRAMES, "radome.frame", &none)?,
                writer.add_channel(0, GAPS, "json", &none)?,
                writer.add_channel(0, LABELS, "json", &none)?,
            ];
            if header.judge.is_some() {
                channels.push(writer.add_channel(0, RESULTS, "json", &none)?);
            }
            writer.flush()?;
            Ok(channels)
        };
        let channels = begin().map_err(failed(path, "cannot be written"))?;
        Ok(Recorder {
            path: path.to_owned(),
            writer: Some(writer),
            shape: header.waveform.shape(),
            channels,
            waiting: Vec::new(),
            buffer: Vec::new(),
            chunk_bytes: 0,
            chunk_start_ns: 0,
            last_time_ns: 0,
            summary: RecordingSummary::default(),
            message: 0,
        })
    }

    fn write(&mut self, channel: usize, times: Option<(u64, u64)>, data: &[u8]) -> Result<(), RecordingError> {
        let (log_time, publish_time) = times.unwrap_or((self.last_time_ns, self.last_time_ns));
        self.last_time_ns = log_time;
        let channel_id = self.channels.get(channel).copied().unwrap_or(0);
        let header = MessageHeader { channel_id, sequence: self.message, log_time, publish_time };
        self.message = self.message.wrapping_add(1);
        self.chunk_bytes += data.len();
        let Some(writer) = &mut self.writer else { return Ok(()) };
        writer.write_to_known_channel(&header, data).map_err(failed(&self.path, "cannot be written"))
    }

    /// Writes what is waiting as a chunk of its own, which survives whatever happens to this process. A recording does so
    /// by itself every second of board time; this is for sources that have fallen silent.
    pub fn flush(&mut self) -> Result<(), RecordingError> {
        self.end_chunk()?;
        self.write_results()
    }

    fn end_chunk(&mut self) -> Result<(), RecordingError> {
        if std::mem::take(&mut self.chunk_bytes) == 0 {
            return Ok(());
        }
        let Some(writer) = &mut self.writer else { return Ok(()) };
        writer.flush().map_err(failed(&self.path, "cannot be written"))
    }

    /// Writes the results that wait, as a chunk of their own. Frames must not be waiting.
    fn write_results(&mut self) -> Result<(), RecordingError> {
        if self.waiting.is_empty() {
            return Ok(());
        }
        let mut json = std::mem::take(&mut self.buffer);
        let last_time_ns = self.last_time_ns;
        for result in std::mem::take(&mut self.waiting) {
            json.clear();
            serde_json::to_writer(&mut json, &result)
                .map_err(|e| failed(&self.path, "cannot be written")(McapError::Io(e.into())))?;
            let log_time = if result.host_time_ns > 0 { result.host_time_ns } else { result.time_ns };
            self.write(3, Some((log_time, result.time_ns)), &json)?;
        }
        self.buffer = json;
        self.last_time_ns = last_time_ns;
        self.end_chunk()
    }

    /// Adds a frame. It must have the waveform's shape.
    pub fn frame(&mut self, frame: &Frame) -> Result<(), RecordingError> {
        if frame.shape != self.shape || frame.codes.len() != self.shape.codes() {
            return Err(RecordingError::FrameShape {
                path: self.path.clone(),
                sequence: frame.sequence,
                got: format!("{} with {} codes", frame.shape, frame.codes.len()),
                expected: self.shape.to_string(),
            });
        }
        if let Some(code) = frame.codes.iter().find(|code| **code > MAX_CODE) {
            let offset = self.summary.bytes;
            return Err(RecordingError::Code { path: self.path.clone(), offset, frame: frame.sequence, code: *code });
        }
        // A clock that goes backwards has started again.
        let span_ns = frame.time_ns.checked_sub(self.chunk_start_ns).unwrap_or(CHUNK_NS);
        if self.chunk_bytes > 0 && (self.chunk_bytes >= CHUNK_BYTES || span_ns >= CHUNK_NS) {
            self.flush()?;
        }
        if self.chunk_bytes == 0 {
            self.chunk_start_ns = frame.time_ns;
        }
        let mut buffer = std::mem::take(&mut self.buffer);
        encode_frame(frame, &mut buffer);
        let log_time = if frame.host_time_ns > 0 { frame.host_time_ns } else { frame.time_ns };
        let result = self.write(0, Some((log_time, frame.time_ns)), &buffer);
        self.buffer = buffer;
        result?;
        self.summary.frames += 1;
        tracing::trace!(sequence = frame.sequence, time_ns = frame.time_ns, "frame recorded");
        Ok(())
    }

    /// Adds a gap.
    pub fn gap(&mut self, gap: &Gap) -> Result<(), RecordingError> {
        let json =
            serde_json::to_vec(gap).map_err(|e| failed(&self.path, "cannot be written")(McapError::Io(e.into())))?;
        self.write(1, None, &json)?;
        self.summary.gaps += 1;
        self.summary.frames_lost = self.summary.frames_lost.saturating_add(gap.frames);
        Ok(())
    }

    /// Adds a label.
    pub fn label(&mut self, label: &LabelSpan) -> Result<(), RecordingError> {
        let json =
            serde_json::to_vec(label).map_err(|e| failed(&self.path, "cannot be written")(McapError::Io(e.into())))?;
        self.write(2, None, &json)?;
        self.summary.labels += 1;
        Ok(())
    }

    /// Makes these the labels in place of those it has, as a chunk of their own: they survive whatever happens to this process
    /// next, and so do the frames so far.
    pub fn set_labels(&mut self, labels: &[LabelSpan]) -> Result<(), RecordingError> {
        let json =
            serde_json::to_vec(labels).map_err(|e| failed(&self.path, "cannot be written")(McapError::Io(e.into())))?;
        self.flush()?;
        self.write(2, None, &json)?;
        self.summary.labels = labels.len() as u64;
        self.end_chunk()
    }

    /// Adds what was said about a frame; the recording must have been created with a judge.
    pub fn result(&mut self, result: &FrameResult) -> Result<(), RecordingError> {
        if self.channels.len() < 4 {
            let source = std::io::Error::other("a result in a recording that names no judge");
            return Err(failed(&self.path, "cannot be written")(McapError::Io(source)));
        }
        self.waiting.push(*result);
        self.summary.results += 1;
        if self.waiting.len() >= RESULTS_OF_A_CHUNK {
            self.flush()?;
        }
        Ok(())
    }

    /// Completes the file.
    pub fn finish(mut self) -> Result<RecordingSummary, RecordingError> {
        if !self.waiting.is_empty() {
            self.flush()?;
        }
        let Some(mut writer) = self.writer.take() else { return Ok(self.summary) };
        let finish = failed(&self.path, "cannot be finished");
        writer.finish().map_err(finish)?;
        let cannot = |source| RecordingError::Io { path: self.path.clone(), what: "cannot be finished", source };
        let mut file = writer.into_inner().into_inner().map_err(|e| cannot(e.into_error()))?;
        sort_channels(&mut file).map_err(cannot)?;
        file.sync_all().map_err(cannot)?;
        self.summary.bytes = file.metadata().map_err(cannot)?.len();
        Ok(self.summary)
    }
}

/// Puts the channels of the summary into the order of their numbers. The library writes them in the order of a hash map
/// with a random seed, so that no two files would be the same.
fn sort_channels(file: &mut File) -> std::io::Result<()> {
    const FOOTER: i64 = 9 + 20;
    const MAGIC: i64 = 8;
    let footer = file.seek(SeekFrom::End(-FOOTER - MAGIC))?;
    let mut bytes = [0; FOOTER as usize];
    file.read_exact(&mut bytes)?;
    let summary = bytes.get(9..).and_then(|b| b.first_chunk()).map_or(0, |b| u64::from_le_bytes(*b));
    if summary == 0 || summary > footer {
        return Ok(());
    }
    file.seek(SeekFrom::Start(summary))?;
    let mut bytes = vec![0; (footer - summary) as usize];
    file.read_exact(&mut bytes)?;
    let (mut records, mut rest) = (Vec::new(), bytes.as_slice());
    while let Some((header, body)) = rest.split_first_chunk::<9>() {
        let [_, length @ ..] = *header;
        let length = 9 + (u64::from_le_bytes(length) as usize).min(body.len());
        let (record, next) = rest.split_at(length);
        records.push(record);
        rest = next;
    }
    // All channels stand together; a stable sort by number that leaves everything else where it is.
    let is_channel = |record: &&[u8]| record.first() == Some(&op::CHANNEL);
    if let Some(first) = records.iter().position(is_channel) {
        let count = records.iter().skip(first).take_while(|r| is_channel(r)).count();
        if let Some(channels) = records.get_mut(first..first + count) {
            channels.sort_by_key(|record| record.get(9..11).map(|id| [id[1], id[0]]));
        }
    }
    let sorted = records.concat();
    file.seek(SeekFrom::Start(summary))?;
    file.write_all(&sorted)
}

impl Drop for Recorder {
    /// Writes the last chunk, but leaves the file marked unfinished: only [`Recorder::finish`] says that all is there.
    fn drop(&mut self) {
        if self.writer.is_some()
            && let Err(error) = self.flush()
        {
            tracing::error!(%error, path = %self.path.display(), "the last chunk of a recording is lost");
        }
        if let Some(writer) = self.writer.take() {
            // The writer would finish the file when dropped.
            drop(writer.into_inner());
        }
    }
}
