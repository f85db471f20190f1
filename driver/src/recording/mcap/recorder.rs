//! Recorder of native recordings.

use std::collections::BTreeMap;
use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};

use crc32fast::Hasher;
use mcap::records::{Channel, Header, MessageHeader, Metadata, MetadataIndex, SchemaHeader, Statistics, op};
use radome_dsp::{Frame, FrameShape, Gap};

use super::chunk_indexes::ChunkIndexes;
use super::encode::{Chunk, SummaryLayout, body_of, record};
use super::syncer::{Failure, SyncOptions, Syncer};
use super::{
    FORMAT_VERSION, FRAME_LAYOUT, FRAMES, FrameResult, GAPS, LABELS, LabelSpan, METADATA_NAME, RESULTS,
    RecordingHeader, encode_frame, staged,
};
use crate::recording::lock::Locked;
use crate::recording::partial::Partial;
use crate::recording::{Existing, RecordingError, WriteReport, check_frame, disk};

/// Number of bytes at which a chunk is written.
const CHUNK_BYTES: usize = 4_000_000;
/// Span of board time at which a chunk is written, ns, unless [`SyncOptions`] say otherwise.
const CHUNK_NS: u64 = 1_000_000_000;

/// Number of results that are written as a chunk; fewer are written with the frames' next chunk.
const RESULTS_OF_A_CHUNK: usize = 4096;

/// Number of bytes at which a part of the summary is written.
const SUMMARY_BLOCK_BYTES: usize = 1 << 16;

/// Descriptions of failed steps, for messages.
const WRITING: &str = "cannot be written";
const FINISHING: &str = "cannot be finished";

/// Name of the encoding of frames, and of its schema.
const FRAME_ENCODING: &str = "radome.frame";
/// Name of the language of [`FRAME_LAYOUT`].
const LAYOUT_ENCODING: &str = "radome.layout";
const FRAME_SCHEMA: u16 = 1;
/// Numbers of the channels.
const FRAME_CHANNEL: u16 = 1;
const GAP_CHANNEL: u16 = 2;
const LABEL_CHANNEL: u16 = 3;
const RESULT_CHANNEL: u16 = 4;

/// Options of a recorder.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RecorderOptions {
    /// Policy for a file that has the name already.
    pub existing: Existing,
    /// Synchronisation with the disk; `None` leaves it to the operating system until the recording is finished.
    pub sync: Option<SyncOptions>,
}

impl Default for RecorderOptions {
    /// Returns options that replace no file and lose at most a second to a power cut.
    fn default() -> Self {
        RecorderOptions { existing: Existing::Refuse, sync: Some(SyncOptions::default()) }
    }
}

/// Writer of a native recording. Without [`Recorder::finish`] the file stays readable up to its last chunk, but is
/// marked unfinished. If the process is killed, every frame older than a second before the last one can be read. A
/// chunk is handed to the system before it spans more. With [`SyncOptions`] that holds for a power cut too.
///
/// Memory does not grow with the recording.
///
/// After an error every further call returns the same error.
pub struct Recorder {
    path: PathBuf,
    file: File,
    /// Lock of the file, held until the recorder is dropped, if the recorder has created the file.
    _lock: Option<Locked>,
    /// Whether the labels that are staged beside the file belong to this recording.
    takes_labels: bool,
    /// Schema and channels, opcode and body: they stand in the first chunk and in the summary.
    definitions: Vec<(u8, Vec<u8>)>,
    /// Body of the record of the summary that holds the position of the metadata.
    metadata_index: Vec<u8>,
    /// Chunk that waits for more messages.
    chunk: Chunk,
    chunk_indexes: ChunkIndexes,
    statistics: Statistics,
    /// Bytes that are not in the file yet.
    pending: Vec<u8>,
    /// Length of the file, bytes.
    end: u64,
    /// CRC of the file.
    crc: Hasher,
    syncer: Option<Syncer>,
    failure: Option<Failure>,
    shape: FrameShape,
    takes_results: bool,
    /// Results that wait for a chunk of their own.
    waiting_results: Vec<FrameResult>,
    buffer: Vec<u8>,
    chunk_bytes: usize,
    chunk_start_ns: u64,
    /// Longest span of a chunk, ns.
    chunk_ns: u64,
    /// Log time of messages that have no time of their own.
    last_time_ns: u64,
    report: WriteReport,
    /// Number of frames in chunks that are in the file.
    frames_written: u64,
    /// Sequence number of the next message.
    next_message: u32,
}

/// Fields of the metadata record of a recording.
fn metadata(header: &RecordingHeader) -> serde_json::Result<BTreeMap<String, String>> {
    let mut fields = BTreeMap::from([
        ("format_version".to_owned(), FORMAT_VERSION.to_string()),
        ("waveform".to_owned(), serde_json::to_string(&header.waveform)?),
        ("board".to_owned(), serde_json::to_string(&header.board)?),
        ("registers".to_owned(), serde_json::to_string(&header.registers)?),
    ]);
    if let Some(judge) = &header.judge {
        fields.insert("judge".to_owned(), serde_json::to_string(judge)?);
    }
    Ok(fields)
}

/// Encodes the bytes before the first chunk, and the body of the summary's record with the position of the metadata.
fn head(header: &RecordingHeader) -> serde_json::Result<(Vec<u8>, Vec<u8>)> {
    let metadata = Metadata { name: METADATA_NAME.to_owned(), metadata: metadata(header)? };
    let library = concat!("radome ", env!("CARGO_PKG_VERSION")).to_owned();
    let mut bytes = mcap::MAGIC.to_vec();
    record(&mut bytes, op::HEADER, &body_of(&Header { profile: String::new(), library }));
    let start = bytes.len();
    record(&mut bytes, op::METADATA, &body_of(&metadata));
    let length = (bytes.len() - start) as u64;
    Ok((bytes, body_of(&MetadataIndex { offset: start as u64, length, name: metadata.name })))
}

/// The schema and the channels of a recording, opcode and body.
fn definitions(takes_results: bool) -> Vec<(u8, Vec<u8>)> {
    let header =
        SchemaHeader { id: FRAME_SCHEMA, name: FRAME_ENCODING.to_owned(), encoding: LAYOUT_ENCODING.to_owned() };
    let mut schema = body_of(&header);
    schema.extend((FRAME_LAYOUT.len() as u32).to_le_bytes());
    schema.extend_from_slice(FRAME_LAYOUT.as_bytes());
    // Schema 0 stands for none.
    let channel = |id, schema_id, topic: &str, encoding: &str| {
        let (topic, message_encoding) = (topic.to_owned(), encoding.to_owned());
        (op::CHANNEL, body_of(&Channel { id, schema_id, topic, message_encoding, metadata: BTreeMap::new() }))
    };
    let mut definitions = vec![
        (op::SCHEMA, schema),
        channel(FRAME_CHANNEL, FRAME_SCHEMA, FRAMES, FRAME_ENCODING),
        channel(GAP_CHANNEL, 0, GAPS, "json"),
        channel(LABEL_CHANNEL, 0, LABELS, "json"),
    ];
    if takes_results {
        definitions.push(channel(RESULT_CHANNEL, 0, RESULTS, "json"));
    }
    definitions
}

impl Recorder {
    /// Creates a recording, in place of a file of that name, and leaves the time of writing to the disk to the
    /// operating system. See [`Recorder::with_options`].
    ///
    /// # Errors
    /// Those of [`Recorder::with_options`].
    pub fn create(path: &Path, header: &RecordingHeader) -> Result<Self, RecordingError> {
        Self::with_options(path, header, &RecorderOptions { existing: Existing::Replace, sync: None })
    }

    /// Creates a recording. It has its name as soon as its header is on the disk, and can be read at any moment from
    /// then on. It is locked against other writers. A file that is replaced exists until then. A device or a pipe is
    /// opened and written to.
    ///
    /// # Errors
    /// [`RecordingError::Occupied`] if the file exists and must not be replaced, [`RecordingError::Locked`] if another
    /// writer has it, [`RecordingError::NoReader`] for a pipe that nobody reads, and [`RecordingError::Io`].
    pub fn with_options(
        path: &Path,
        header: &RecordingHeader,
        options: &RecorderOptions,
    ) -> Result<Self, RecordingError> {
        if std::fs::metadata(path).is_ok_and(|metadata| !metadata.is_file() && !metadata.is_dir()) {
            return Self::start(open_device(path)?, path, header, None);
        }
        Self::in_partial(Partial::file(path, options.existing)?, header, options.sync)
    }

    /// Creates a recording as [`Recorder::with_options`] does, of a file that was started before, which kept its name from
    /// other writers.
    ///
    /// # Errors
    /// [`RecordingError::Occupied`] if the name has been taken all the same and must not be replaced, and
    /// [`RecordingError::Io`].
    pub fn in_partial(
        partial: Partial,
        header: &RecordingHeader,
        sync: Option<SyncOptions>,
    ) -> Result<Self, RecordingError> {
        let path = partial.target().to_owned();
        let mut recorder = Self::start(partial.open()?, &path, header, sync)?;
        recorder._lock = partial.publish()?;
        // The labels belong to an earlier recording of this name.
        staged::remove(&path).map_err(RecordingError::cannot_write(&path))?;
        recorder.takes_labels = true;
        Ok(recorder)
    }

    /// Starts a recording in an empty file, which may have another name than `path` yet.
    pub(super) fn start(
        file: File,
        path: &Path,
        header: &RecordingHeader,
        sync: Option<SyncOptions>,
    ) -> Result<Self, RecordingError> {
        let cannot = |source| RecordingError::Io { path: path.to_owned(), what: "cannot be written", source };
        let (pending, metadata_index) = head(header).map_err(|e| cannot(io::Error::other(e)))?;
        let takes_results = header.judge.is_some();
        let definitions = definitions(takes_results);
        let mut chunk = Chunk::new().map_err(cannot)?;
        for (opcode, body) in &definitions {
            chunk.record(*opcode, &[body.as_slice()]).map_err(cannot)?;
        }
        let chunk_indexes = ChunkIndexes::create(&file, path).map_err(cannot)?;
        let syncer = sync.map(|options| Syncer::start(file.try_clone()?, path.to_owned(), options)).transpose();
        let mut recorder = Recorder {
            path: path.to_owned(),
            file,
            _lock: None,
            takes_labels: false,
            metadata_index,
            chunk,
            chunk_indexes,
            statistics: Statistics {
                schema_count: 1,
                channel_count: definitions.len() as u32 - 1,
                metadata_count: 1,
                ..Statistics::default()
            },
            definitions,
            pending,
            end: 0,
            crc: Hasher::new(),
            syncer: syncer.map_err(cannot)?,
            failure: None,
            shape: header.waveform.shape(),
            takes_results,
            waiting_results: Vec::new(),
            buffer: Vec::new(),
            chunk_bytes: 0,
            chunk_start_ns: 0,
            chunk_ns: sync.map_or(CHUNK_NS, |sync| sync.chunk.as_nanos().clamp(1, u128::from(u64::MAX)) as u64),
            last_time_ns: 0,
            report: WriteReport::default(),
            frames_written: 0,
            next_message: 0,
        };
        recorder.end_chunk()?;
        Ok(recorder)
    }

    /// Keeps an error if it is the first; returns the first.
    fn fail(&mut self, failure: Failure) -> RecordingError {
        self.failure.get_or_insert(failure).error(&self.path)
    }

    /// Keeps an error of the system, or of an encoder, if it is the first; returns the first.
    fn fail_io(&mut self, what: &'static str, source: impl Into<io::Error>) -> RecordingError {
        self.fail(Failure::io(what, &source.into()))
    }

    /// Returns the first error, if there was one.
    fn check(&mut self) -> Result<(), RecordingError> {
        if let Some(failure) = &self.failure {
            return Err(failure.error(&self.path));
        }
        match self.syncer.as_ref().map_or(Ok(()), Syncer::check) {
            Ok(()) => Ok(()),
            Err(failure) => Err(self.fail(failure)),
        }
    }

    /// Writes the bytes that are pending to the file, at once.
    fn write_out(&mut self, what: &'static str) -> Result<(), RecordingError> {
        disk::check_length(&self.file, self.end).map_err(|source| self.fail_io(what, source))?;
        if let Err(source) = disk::append(&self.file, &self.path, self.end, &self.pending) {
            // A chunk that is cut short is useless. If the disk refuses this change too, readers skip the chunk.
            let _ = disk::set_length(&self.file, &self.path, self.end);
            return Err(self.fail_io(what, source));
        }
        self.crc.update(&self.pending);
        self.end += self.pending.len() as u64;
        self.pending.clear();
        if let Some(syncer) = &self.syncer {
            syncer.request();
        }
        Ok(())
    }

    /// Waits until all data of the file are on the disk.
    fn sync(&mut self) -> Result<(), RecordingError> {
        let result = match &self.syncer {
            Some(syncer) => syncer.wait(),
            None => disk::sync(&self.file, &self.path).map_err(|e| Failure::io("cannot be brought to the disk", &e)),
        };
        result.map_err(|failure| self.fail(failure))
    }

    /// Adds a message with its log time and publish time to the chunk.
    fn write(&mut self, channel_id: u16, times: Option<(u64, u64)>, data: &[u8]) -> Result<(), RecordingError> {
        self.check()?;
        // This matters for sources with gaps only; frames end their chunk earlier.
        if self.chunk_bytes >= CHUNK_BYTES {
            self.end_chunk()?;
        }
        let (log_time, publish_time) = times.unwrap_or((self.last_time_ns, self.last_time_ns));
        self.last_time_ns = log_time;
        let header = MessageHeader { channel_id, sequence: self.next_message, log_time, publish_time };
        self.next_message = self.next_message.wrapping_add(1);
        self.chunk_bytes += data.len();
        let statistics = &mut self.statistics;
        if statistics.message_count == 0 {
            (statistics.message_start_time, statistics.message_end_time) = (log_time, log_time);
        }
        statistics.message_start_time = statistics.message_start_time.min(log_time);
        statistics.message_end_time = statistics.message_end_time.max(log_time);
        statistics.message_count += 1;
        *statistics.channel_message_counts.entry(channel_id).or_default() += 1;
        self.chunk.message(&header, data).map_err(|e| self.fail_io(WRITING, e))
    }

    /// Adds a message in JSON to the chunk.
    fn write_json(&mut self, channel_id: u16, value: &impl serde::Serialize) -> Result<(), RecordingError> {
        let json = serde_json::to_vec(value).map_err(|e| self.fail_io(WRITING, e))?;
        self.write(channel_id, None, &json)
    }

    /// Writes the pending messages as a chunk, which survives the end of this process. A recording does so by itself
    /// every second of board time; call it for sources that have fallen silent.
    ///
    /// # Errors
    /// The recording's first error.
    pub fn flush(&mut self) -> Result<(), RecordingError> {
        self.check()?;
        self.end_chunk()?;
        self.write_results()
    }

    /// Path of the file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Number of frames that the file holds: those of the chunk that waits in memory are not among them. After an error no
    /// more are added.
    pub fn frames_written(&self) -> u64 {
        self.frames_written
    }

    /// Writes the chunk and starts another one.
    fn end_chunk(&mut self) -> Result<(), RecordingError> {
        if self.chunk.is_empty() {
            return Ok(());
        }
        self.chunk_bytes = 0;
        let result = Chunk::new().and_then(|next| {
            let chunk = std::mem::replace(&mut self.chunk, next);
            chunk.finish(&mut self.pending, self.end)
        });
        let index = result.map_err(|e| self.fail_io(WRITING, e))?;
        self.write_out(WRITING)?;
        self.frames_written = self.report.frames;
        self.statistics.chunk_count += 1;
        self.chunk_indexes.push(&index).map_err(|e| self.fail_io(WRITING, e))
    }

    /// Writes the results that wait, as a chunk of their own. Frames must not be waiting.
    fn write_results(&mut self) -> Result<(), RecordingError> {
        if self.waiting_results.is_empty() {
            return Ok(());
        }
        let mut json = std::mem::take(&mut self.buffer);
        let last_time_ns = self.last_time_ns;
        for result in std::mem::take(&mut self.waiting_results) {
            json.clear();
            serde_json::to_writer(&mut json, &result).map_err(|e| self.fail_io(WRITING, e))?;
            let log_time = if result.host_time_ns > 0 { result.host_time_ns } else { result.time_ns };
            self.write(RESULT_CHANNEL, Some((log_time, result.time_ns)), &json)?;
        }
        self.buffer = json;
        self.last_time_ns = last_time_ns;
        self.end_chunk()
    }

    /// Adds a frame. It must have the waveform's shape.
    ///
    /// # Errors
    /// [`RecordingError::FrameShape`] or [`RecordingError::Code`] for a frame that does not belong here, which changes
    /// nothing; else the recording's first error.
    pub fn frame(&mut self, frame: &Frame) -> Result<(), RecordingError> {
        check_frame(&self.path, self.end, self.shape, frame)?;
        // A clock that goes backwards has started again.
        let span_ns = frame.time_ns.checked_sub(self.chunk_start_ns).unwrap_or(self.chunk_ns);
        if self.chunk_bytes > 0 && (self.chunk_bytes >= CHUNK_BYTES || span_ns >= self.chunk_ns) {
            self.flush()?;
        }
        if self.chunk_bytes == 0 {
            self.chunk_start_ns = frame.time_ns;
        }
        let mut buffer = std::mem::take(&mut self.buffer);
        encode_frame(frame, &mut buffer);
        let log_time = if frame.host_time_ns > 0 { frame.host_time_ns } else { frame.time_ns };
        let result = self.write(FRAME_CHANNEL, Some((log_time, frame.time_ns)), &buffer);
        self.buffer = buffer;
        result?;
        self.report.frames += 1;
        tracing::trace!(sequence = frame.sequence, time_ns = frame.time_ns, "frame recorded");
        Ok(())
    }

    /// Adds a gap.
    ///
    /// # Errors
    /// The recording's first error.
    pub fn gap(&mut self, gap: &Gap) -> Result<(), RecordingError> {
        self.write_json(GAP_CHANNEL, gap)?;
        self.report.count_gap(gap);
        Ok(())
    }

    /// Adds a label. Labels that change while the recording is made are staged beside it instead
    /// ([`stage_labels`](super::stage_labels)).
    ///
    /// # Errors
    /// The recording's first error.
    pub fn label(&mut self, label: &LabelSpan) -> Result<(), RecordingError> {
        self.write_json(LABEL_CHANNEL, label)?;
        self.report.labels += 1;
        Ok(())
    }

    /// Adds the result of a classifier for a frame; the recording must have been created with a judge.
    ///
    /// # Errors
    /// The recording's first error.
    pub fn result(&mut self, result: &FrameResult) -> Result<(), RecordingError> {
        if !self.takes_results {
            return Err(self.fail_io(WRITING, io::Error::other("a result in a recording that names no judge")));
        }
        self.waiting_results.push(*result);
        self.report.results += 1;
        if self.waiting_results.len() >= RESULTS_OF_A_CHUNK {
            self.flush()?;
        }
        Ok(())
    }

    /// Moves the labels that are staged beside the recording into it, as a chunk of their own. They replace the labels
    /// in the recording.
    fn move_staged_labels(&mut self) -> Result<bool, RecordingError> {
        if !self.takes_labels {
            return Ok(false);
        }
        match staged::read(&self.path) {
            Ok(None) => Ok(false),
            Ok(Some(staged)) => {
                self.write_json(LABEL_CHANNEL, &staged.labels)?;
                self.report.labels = staged.labels.len() as u64;
                self.end_chunk()?;
                Ok(true)
            }
            Err(error) => {
                tracing::error!(%error, "labels stay beside the recording");
                Ok(false)
            }
        }
    }

    /// Ends the data and writes the summary, block by block. Returns the end of the file, which marks it finished.
    fn write_summary(&mut self) -> Result<Vec<u8>, RecordingError> {
        self.chunk_indexes.rewind().map_err(|e| self.fail_io(FINISHING, e))?;
        let data_crc = self.crc.clone().finalize();
        record(&mut self.pending, op::DATA_END, &data_crc.to_le_bytes());
        let mut summary = SummaryLayout::new(self.end + self.pending.len() as u64);
        for (opcode, body) in &self.definitions {
            summary.record(&mut self.pending, *opcode, body);
        }
        summary.record(&mut self.pending, op::STATISTICS, &body_of(&self.statistics));
        loop {
            let start = self.pending.len();
            let read = self.chunk_indexes.read(&mut self.pending);
            match read.map_err(|e| self.fail_io(FINISHING, e))? {
                0 => break,
                _ => summary.add(op::CHUNK_INDEX, self.pending.get(start..).unwrap_or(&[])),
            }
            if self.pending.len() >= SUMMARY_BLOCK_BYTES {
                self.write_out(FINISHING)?;
            }
        }
        summary.record(&mut self.pending, op::METADATA_INDEX, &self.metadata_index);
        let footer = summary.finish(&mut self.pending);
        self.write_out(FINISHING)?;
        Ok(footer)
    }

    /// Completes the file, takes in the labels that are staged beside it, and waits until it is on the disk. If the
    /// process ends meanwhile, the file can be read up to its last chunk.
    ///
    /// # Errors
    /// The recording's first error.
    pub fn finish(mut self) -> Result<WriteReport, RecordingError> {
        self.flush()?;
        let took_labels = self.move_staged_labels()?;
        let data_end = self.end;
        let footer = self.write_summary().inspect_err(|_| {
            // A part of a summary is of no use.
            let _ = disk::set_length(&self.file, &self.path, data_end);
        })?;
        // A footer marks a finished file: it is written when everything before it is on the disk.
        if self.syncer.is_some() {
            self.sync()?;
        }
        self.pending = footer;
        self.write_out(FINISHING)?;
        self.sync()?;
        if took_labels {
            staged::remove(&self.path).map_err(|e| self.fail_io(FINISHING, e))?;
        }
        self.report.bytes = self.end;
        Ok(std::mem::take(&mut self.report))
    }
}

impl Drop for Recorder {
    /// Writes the last chunk, but leaves the file marked unfinished: only [`Recorder::finish`] completes it.
    fn drop(&mut self) {
        // A finished recording has no pending messages.
        if self.failure.is_none()
            && let Err(error) = self.flush()
        {
            tracing::error!(%error, path = %self.path.display(), "the last chunk of a recording is lost");
        }
    }
}

/// Opens a device or a pipe to write to. A pipe without a reader is refused, because opening it would wait for one and
/// ignore signals.
fn open_device(path: &Path) -> Result<File, RecordingError> {
    use std::os::unix::fs::{FileTypeExt, OpenOptionsExt};

    use rustix::fs::{OFlags, fcntl_getfl, fcntl_setfl};
    use rustix::io::Errno;

    let mut options = File::options();
    options.write(true);
    if !std::fs::metadata(path).is_ok_and(|metadata| metadata.file_type().is_fifo()) {
        return options.open(path).map_err(RecordingError::cannot_write(path));
    }
    let pipe = match options.custom_flags(OFlags::NONBLOCK.bits() as i32).open(path) {
        Err(error) if error.raw_os_error() == Some(Errno::NXIO.raw_os_error()) => {
            return Err(RecordingError::NoReader { path: path.to_owned() });
        }
        result => result.map_err(RecordingError::cannot_write(path))?,
    };
    // Writes wait for the reader.
    fcntl_getfl(&pipe)
        .and_then(|flags| fcntl_setfl(&pipe, flags.difference(OFlags::NONBLOCK)))
        .map_err(|error| RecordingError::cannot_write(path)(error.into()))?;
    Ok(pipe)
}

#[cfg(test)]
mod tests {
    use mcap::records::Footer;
    use mcap::{Compression, Summary, WriteOptions};
    use radome_dsp::GapReason;

    use super::*;
    use crate::pattern::{Pattern, waveform};
    use crate::recording::mcap::chunk_indexes::MAX_BUFFERED_BYTES;
    use crate::recording::mcap::index::FOOTER;
    use crate::recording::mcap::{Judge, RESULTS_VERSION};

    const COUNT: u64 = 300;

    /// Records frames a second apart, so that each has a chunk of its own and so has its result, with a gap and a
    /// label.
    fn record(path: &Path, check: impl Fn(&Recorder)) -> WriteReport {
        let pattern = Pattern::new(waveform(&[1, 2, 3], 8, 64, 1.0), COUNT);
        let judge = Judge {
            version: RESULTS_VERSION,
            model: "a".into(),
            model_hash: "b".into(),
            on_delay_s: 0.5,
            off_delay_s: 3.0,
            max_range_m: None,
        };
        let mut frame = Frame::zeroed(pattern.waveform.shape());
        let header = RecordingHeader { judge: Some(judge), ..RecordingHeader::new(pattern.waveform.clone()) };
        let mut recorder = Recorder::create(path, &header).expect("creates");
        for number in 0..COUNT {
            pattern.fill(number, &mut frame);
            recorder.frame(&frame).expect("records");
            if number == 100 {
                recorder.gap(&Gap { first_sequence: 101, frames: 2, reason: GapReason::Crc }).expect("records");
                recorder.label(&LabelSpan::new(0.0, 1.0, "one")).expect("records");
            }
            let result = FrameResult {
                sequence: number,
                time_ns: frame.time_ns,
                latency_ns: 1_000_000 + number,
                ..FrameResult::default()
            };
            recorder.result(&result).expect("records");
            check(&recorder);
        }
        recorder.finish().expect("finishes")
    }

    /// The same messages in the same chunks, written by the format's own library.
    fn by_the_library(bytes: &[u8], summary: &Summary) -> Vec<u8> {
        let mut writer = WriteOptions::new()
            .disable_seeking(true)
            .chunk_size(None)
            .compression(Some(Compression::Zstd))
            .compression_level(1)
            .compression_threads(0)
            .calculate_summary_section_crc(false)
            .library(concat!("radome ", env!("CARGO_PKG_VERSION")))
            .create(io::Cursor::new(Vec::new()))
            .expect("starts");
        let metadata = mcap::read::metadata(bytes, &summary.metadata_indexes[0]).expect("metadata");
        writer.write_metadata(&metadata).expect("writes");
        let schema = writer.add_schema(FRAME_ENCODING, LAYOUT_ENCODING, FRAME_LAYOUT.as_bytes()).expect("writes");
        let channels = [(schema, FRAMES, FRAME_ENCODING), (0, GAPS, "json"), (0, LABELS, "json"), (0, RESULTS, "json")];
        for (schema, topic, encoding) in channels {
            writer.add_channel(schema, topic, encoding, &BTreeMap::new()).expect("writes");
        }
        writer.flush().expect("writes");
        for index in summary.chunk_indexes.iter().skip(1) {
            for message in summary.stream_chunk(bytes, index).expect("a chunk") {
                let message = message.expect("a message");
                let header = MessageHeader {
                    channel_id: message.channel.id,
                    sequence: message.sequence,
                    log_time: message.log_time,
                    publish_time: message.publish_time,
                };
                writer.write_to_known_channel(&header, &message.data).expect("writes");
            }
            writer.flush().expect("writes");
        }
        writer.finish().expect("finishes");
        writer.into_inner().into_inner()
    }

    #[test]
    fn a_recording_of_many_chunks_equals_that_of_the_library() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("a.mcap");
        let recorded = record(&path, |_| {});
        let bytes = std::fs::read(&path).expect("reads");
        let summary = Summary::read(&bytes).expect("reads").expect("a summary");
        let expected = by_the_library(&bytes, &summary);
        let footer = mcap::read::footer(&bytes).expect("a footer");
        let crc = crc32fast::hash(&bytes[footer.summary_start as usize..bytes.len() - 12]);
        assert_eq!(footer, Footer { summary_crc: crc, ..mcap::read::footer(&expected).expect("a footer") });
        assert_eq!((recorded.bytes, bytes.len()), (bytes.len() as u64, expected.len()));
        let (summary_start, offsets) = (footer.summary_start as usize, footer.summary_offset_start as usize);
        assert!(bytes[..summary_start] == expected[..summary_start], "the data and their CRC");
        // The library puts the channels of the summary into any order, so that its CRC differs.
        assert!(summary == Summary::read(&expected).expect("reads").expect("a summary"), "{summary:?}");
        let footer_start = bytes.len() - FOOTER as usize;
        assert!(bytes[offsets..footer_start] == expected[offsets..footer_start], "the offsets of the summary");
        let topics = mcap::MessageStream::new(&bytes).expect("opens").map(|m| m.expect("whole").channel.topic.clone());
        assert_eq!(topics.filter(|topic| topic == FRAMES).count() as u64, COUNT);
        assert_eq!(summary.stats.expect("statistics").message_count, 2 * COUNT + 2);
    }

    #[test]
    fn memory_of_the_index_does_not_grow_with_the_recording() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("a.mcap");
        record(&path, |recorder| assert!(recorder.chunk_indexes.buffered_bytes() <= MAX_BUFFERED_BYTES));
        let bytes = std::fs::read(&path).expect("reads");
        let summary = Summary::read(&bytes).expect("reads").expect("a summary");
        // An entry has more than 80 bytes.
        assert!(80 * summary.chunk_indexes.len() > 8 * MAX_BUFFERED_BYTES, "{} chunks", summary.chunk_indexes.len());
        assert_eq!(std::fs::read_dir(folder.path()).expect("lists").count(), 1, "nothing is left beside it");
    }

    #[test]
    fn gaps_without_frames_end_their_chunk_too() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("a.mcap");
        let header = RecordingHeader::new(waveform(&[1], 8, 64, 0.1));
        let mut recorder = Recorder::create(&path, &header).expect("creates");
        let mut most = 0;
        for first_sequence in 0..150_000 {
            recorder.gap(&Gap { first_sequence, frames: 1, reason: GapReason::Crc }).expect("records");
            most = most.max(recorder.chunk_bytes);
        }
        assert!(most < 2 * CHUNK_BYTES, "{most} bytes in a chunk");
        recorder.finish().expect("finishes");
        let bytes = std::fs::read(&path).expect("reads");
        let summary = Summary::read(&bytes).expect("reads").expect("a summary");
        assert!(summary.chunk_indexes.len() > 2, "{} chunks", summary.chunk_indexes.len());
    }
}
