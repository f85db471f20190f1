//! Writing.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use mcap::records::{MessageHeader, Metadata, op};
use mcap::{Compression, McapError, WriteOptions, Writer};
use radome_dsp::{Frame, FrameShape, Gap, MAX_CODE};

use super::syncer::{Failure, SyncOptions, Syncer};
use super::{
    FORMAT_VERSION, FRAMES, FrameResult, GAPS, LABELS, LabelSpan, METADATA_NAME, RESULTS, RecordingHeader,
    encode_frame, staged,
};
use crate::recording::lock::Locked;
use crate::recording::partial::Partial;
use crate::recording::{Existing, RecordingError, disk};

/// A chunk is written when it holds this many bytes.
const CHUNK_BYTES: usize = 4_000_000;
/// A chunk is written when it spans this much board time, ns, unless [`SyncOptions`] say otherwise.
const CHUNK_NS: u64 = 1_000_000_000;

/// Results are written as a chunk when there are so many, or with the frames' next chunk.
const RESULTS_OF_A_CHUNK: usize = 4096;

/// Footer record and magic.
const FOOTER_BYTES: usize = 9 + 20 + 8;

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

/// Options of a recorder.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RecorderOptions {
    /// Whether a file of its name may be replaced.
    pub existing: Existing,
    /// Synchronisation with the disk; `None` leaves it to the operating system until the recording is finished.
    pub sync: Option<SyncOptions>,
}

impl Default for RecorderOptions {
    /// Replaces nothing; loses at most a second to a power cut.
    fn default() -> Self {
        RecorderOptions { existing: Existing::Refuse, sync: Some(SyncOptions::default()) }
    }
}

/// Writes a recording. Without [`Recorder::finish`] the file stays readable up to its last chunk, but is marked
/// unfinished. However its process ends, every frame older than a second before the last one given to it can be read: a
/// chunk is complete on its way to the disk before it spans more. With [`SyncOptions`] that holds for a power cut too.
///
/// After an error every further call gives that same error.
pub struct Recorder {
    path: PathBuf,
    file: File,
    /// Held as long as the recording is made, by whoever has made the file itself.
    _lock: Option<Locked>,
    /// Whether labels that are staged beside the file are its own.
    takes_labels: bool,
    /// Taken when finished.
    writer: Option<Writer<Pending>>,
    pending: Pending,
    /// Length of the file, bytes.
    end: u64,
    syncer: Option<Syncer>,
    failure: Option<Failure>,
    shape: FrameShape,
    channels: Vec<u16>,
    /// Results that wait for a chunk of their own.
    waiting: Vec<FrameResult>,
    buffer: Vec<u8>,
    chunk_bytes: usize,
    chunk_start_ns: u64,
    /// Longest span of a chunk, ns.
    chunk_ns: u64,
    /// Log time of messages that have no time of their own.
    last_time_ns: u64,
    summary: RecordingSummary,
    message: u32,
}

/// Bytes that the format's library has written and that are not in the file yet. Writing here cannot fail, so that the first error
/// is the disk's and not one that the library makes of it.
#[derive(Clone, Default)]
struct Pending(Arc<Mutex<Bytes>>);

#[derive(Default)]
struct Bytes {
    /// Offset in the file.
    start: u64,
    bytes: Vec<u8>,
}

impl Pending {
    fn get(&self) -> MutexGuard<'_, Bytes> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Write for Pending {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.get().bytes.extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Seek for Pending {
    /// Tells the position alone: the library does not go back.
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        let pending = self.get();
        match to {
            SeekFrom::Current(0) => Ok(pending.start + pending.bytes.len() as u64),
            _ => Err(io::ErrorKind::Unsupported.into()),
        }
    }
}

fn io_error(error: McapError) -> io::Error {
    match error {
        McapError::Io(source) => source,
        other => io::Error::other(other),
    }
}

impl Recorder {
    /// Creates a recording, in place of a file of that name, and leaves it to the operating system when it is on the disk. See
    /// [`Recorder::with_options`].
    ///
    /// # Errors
    /// Those of [`Recorder::with_options`].
    pub fn create(path: &Path, header: &RecordingHeader) -> Result<Self, RecordingError> {
        Self::with_options(path, header, &RecorderOptions { existing: Existing::Replace, sync: None })
    }

    /// Creates a recording. It has its name as soon as its header is on the disk, can be read at any moment from then on, and is
    /// locked against other writers. A file that is replaced is there until then. A device or a pipe is written to as it is.
    ///
    /// # Errors
    /// [`RecordingError::Occupied`] if the file exists and must not be replaced, [`RecordingError::Locked`] if another writer has
    /// it, and an input/output error.
    pub fn with_options(
        path: &Path,
        header: &RecordingHeader,
        options: &RecorderOptions,
    ) -> Result<Self, RecordingError> {
        if std::fs::metadata(path).is_ok_and(|metadata| !metadata.is_file() && !metadata.is_dir()) {
            let device = File::options().write(true).open(path).map_err(RecordingError::cannot_write(path))?;
            return Self::start(device, path, header, None);
        }
        let partial = Partial::file(path, options.existing)?;
        let mut recorder = Self::start(partial.open()?, path, header, options.sync)?;
        recorder._lock = partial.publish()?;
        // Those of a recording that had this name before.
        staged::remove_staged_labels(path)?;
        recorder.takes_labels = true;
        Ok(recorder)
    }

    /// Writes to an empty file, which may have another name than `path` yet.
    pub(in crate::recording) fn start(
        file: File,
        path: &Path,
        header: &RecordingHeader,
        sync: Option<SyncOptions>,
    ) -> Result<Self, RecordingError> {
        let cannot = |source| RecordingError::Io { path: path.to_owned(), what: "cannot be written", source };
        let pending = Pending::default();
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
            .create(pending.clone())
            .map_err(|e| cannot(io_error(e)))?;

        let json = |value: serde_json::Result<String>| value.map_err(|e| cannot(io::Error::other(e)));
        let mut metadata = BTreeMap::from([
            ("format_version".to_owned(), FORMAT_VERSION.to_string()),
            ("waveform".to_owned(), json(serde_json::to_string(&header.waveform))?),
            ("board".to_owned(), json(serde_json::to_string(&header.board))?),
            ("registers".to_owned(), json(serde_json::to_string(&header.registers))?),
        ]);
        if let Some(judge) = &header.judge {
            metadata.insert("judge".to_owned(), json(serde_json::to_string(judge))?);
        }
        let begin = || -> mcap::McapResult<Vec<u16>> {
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
        let channels = begin().map_err(|e| cannot(io_error(e)))?;
        let syncer = sync.map(|options| Syncer::start(file.try_clone()?, path.to_owned(), options)).transpose();
        let mut recorder = Recorder {
            path: path.to_owned(),
            file,
            _lock: None,
            takes_labels: false,
            writer: Some(writer),
            pending,
            end: 0,
            syncer: syncer.map_err(cannot)?,
            failure: None,
            shape: header.waveform.shape(),
            channels,
            waiting: Vec::new(),
            buffer: Vec::new(),
            chunk_bytes: 0,
            chunk_start_ns: 0,
            chunk_ns: sync.map_or(CHUNK_NS, |sync| sync.chunk.as_nanos().clamp(1, u128::from(u64::MAX)) as u64),
            last_time_ns: 0,
            summary: RecordingSummary::default(),
            message: 0,
        };
        recorder.write_out("cannot be written")?;
        Ok(recorder)
    }

    /// Takes note of an error, unless it is the consequence of an earlier one, and gives the first.
    fn fail(&mut self, failure: Failure) -> RecordingError {
        self.failure.get_or_insert(failure).error(&self.path)
    }

    /// The first error, if there was one.
    fn check(&mut self) -> Result<(), RecordingError> {
        if let Some(failure) = &self.failure {
            return Err(failure.error(&self.path));
        }
        match self.syncer.as_ref().map_or(Ok(()), Syncer::check) {
            Ok(()) => Ok(()),
            Err(failure) => Err(self.fail(failure)),
        }
    }

    /// Writes what the library has made ready to the file, at once.
    fn write_out(&mut self, what: &'static str) -> Result<(), RecordingError> {
        let written = {
            let mut pending = self.pending.get();
            let written = disk::append(&self.file, &self.path, self.end, &pending.bytes);
            if written.is_ok() {
                self.end += pending.bytes.len() as u64;
                pending.start = self.end;
                pending.bytes.clear();
            }
            written
        };
        if let Err(source) = written {
            // A chunk that is cut short is of no use. Where the disk does not even take this, readers pass over it.
            let _ = disk::set_length(&self.file, &self.path, self.end);
            return Err(self.fail(Failure::io(what, &source)));
        }
        if let Some(syncer) = &self.syncer {
            syncer.request();
        }
        Ok(())
    }

    /// Waits until all that is in the file is on the disk.
    fn sync(&mut self) -> Result<(), RecordingError> {
        let synced = match &self.syncer {
            Some(syncer) => syncer.wait(),
            None => disk::sync(&self.file, &self.path).map_err(|e| Failure::io("cannot be brought to the disk", &e)),
        };
        synced.map_err(|failure| self.fail(failure))
    }

    fn write(&mut self, channel: usize, times: Option<(u64, u64)>, data: &[u8]) -> Result<(), RecordingError> {
        self.check()?;
        let (log_time, publish_time) = times.unwrap_or((self.last_time_ns, self.last_time_ns));
        self.last_time_ns = log_time;
        let channel_id = self.channels.get(channel).copied().unwrap_or(0);
        let header = MessageHeader { channel_id, sequence: self.message, log_time, publish_time };
        self.message = self.message.wrapping_add(1);
        self.chunk_bytes += data.len();
        let Some(writer) = &mut self.writer else { return Ok(()) };
        let written = writer.write_to_known_channel(&header, data);
        written.map_err(|e| self.fail(Failure::io("cannot be written", &io_error(e))))
    }

    fn write_json(&mut self, channel: usize, value: &impl serde::Serialize) -> Result<(), RecordingError> {
        match serde_json::to_vec(value) {
            Ok(json) => self.write(channel, None, &json),
            Err(error) => Err(self.fail(Failure::io("cannot be written", &error.into()))),
        }
    }

    /// Writes what is waiting as a chunk of its own, which survives whatever happens to this process. A recording does so
    /// by itself every second of board time; this is for sources that have fallen silent.
    ///
    /// # Errors
    /// The recording's first error.
    pub fn flush(&mut self) -> Result<(), RecordingError> {
        self.check()?;
        self.end_chunk()?;
        self.write_results()
    }

    fn end_chunk(&mut self) -> Result<(), RecordingError> {
        if std::mem::take(&mut self.chunk_bytes) == 0 {
            return Ok(());
        }
        let Some(writer) = &mut self.writer else { return Ok(()) };
        if let Err(error) = writer.flush() {
            return Err(self.fail(Failure::io("cannot be written", &io_error(error))));
        }
        self.write_out("cannot be written")
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
            if let Err(error) = serde_json::to_writer(&mut json, &result) {
                return Err(self.fail(Failure::io("cannot be written", &error.into())));
            }
            let log_time = if result.host_time_ns > 0 { result.host_time_ns } else { result.time_ns };
            self.write(3, Some((log_time, result.time_ns)), &json)?;
        }
        self.buffer = json;
        self.last_time_ns = last_time_ns;
        self.end_chunk()
    }

    /// Adds a frame. It must have the waveform's shape.
    ///
    /// # Errors
    /// [`RecordingError::FrameShape`] or [`RecordingError::Code`] for a frame that does not belong here, which changes nothing;
    /// else the recording's first error.
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
            let offset = self.end;
            return Err(RecordingError::Code { path: self.path.clone(), offset, frame: frame.sequence, code: *code });
        }
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
        let result = self.write(0, Some((log_time, frame.time_ns)), &buffer);
        self.buffer = buffer;
        result?;
        self.summary.frames += 1;
        tracing::trace!(sequence = frame.sequence, time_ns = frame.time_ns, "frame recorded");
        Ok(())
    }

    /// Adds a gap.
    ///
    /// # Errors
    /// The recording's first error.
    pub fn gap(&mut self, gap: &Gap) -> Result<(), RecordingError> {
        self.write_json(1, gap)?;
        self.summary.gaps += 1;
        self.summary.frames_lost = self.summary.frames_lost.saturating_add(gap.frames);
        Ok(())
    }

    /// Adds a label. Labels that change while the recording is made are staged beside it instead
    /// ([`stage_labels`](super::stage_labels)).
    ///
    /// # Errors
    /// The recording's first error.
    pub fn label(&mut self, label: &LabelSpan) -> Result<(), RecordingError> {
        self.write_json(2, label)?;
        self.summary.labels += 1;
        Ok(())
    }

    /// Adds what was said about a frame; the recording must have been created with a judge.
    ///
    /// # Errors
    /// The recording's first error.
    pub fn result(&mut self, result: &FrameResult) -> Result<(), RecordingError> {
        if self.channels.len() < 4 {
            let source = io::Error::other("a result in a recording that names no judge");
            return Err(self.fail(Failure::io("cannot be written", &source)));
        }
        self.waiting.push(*result);
        self.summary.results += 1;
        if self.waiting.len() >= RESULTS_OF_A_CHUNK {
            self.flush()?;
        }
        Ok(())
    }

    /// Takes the labels that are staged beside the recording into it, in place of those it has, as a chunk of their own.
    fn take_staged(&mut self) -> Result<bool, RecordingError> {
        if !self.takes_labels {
            return Ok(false);
        }
        match staged::read(&self.path) {
            Ok(None) => Ok(false),
            Ok(Some(staged)) => {
                self.write_json(2, &staged.labels)?;
                self.summary.labels = staged.labels.len() as u64;
                self.end_chunk()?;
                Ok(true)
            }
            Err(error) => {
                tracing::error!(%error, "labels stay beside the recording");
                Ok(false)
            }
        }
    }

    /// Completes the file: labels that are staged beside it go into it, and it is on the disk. It can be read up to its last chunk
    /// whatever happens meanwhile.
    ///
    /// # Errors
    /// The recording's first error.
    pub fn finish(mut self) -> Result<RecordingSummary, RecordingError> {
        self.flush()?;
        let has_taken = self.take_staged()?;
        let Some(mut writer) = self.writer.take() else { return Ok(self.summary) };
        let finished = writer.finish();
        drop(writer.into_inner());
        if let Err(error) = finished {
            return Err(self.fail(Failure::io("cannot be finished", &io_error(error))));
        }
        let footer = {
            let mut pending = self.pending.get();
            sort_channels(&mut pending.bytes, self.end);
            let place = pending.bytes.len().saturating_sub(FOOTER_BYTES);
            pending.bytes.split_off(place)
        };
        self.write_out("cannot be finished")?;
        // A file with a footer says that all is there: it comes when that is true of the disk too.
        if self.syncer.is_some() {
            self.sync()?;
        }
        self.pending.get().bytes = footer;
        self.write_out("cannot be finished")?;
        self.sync()?;
        if has_taken && let Err(error) = staged::remove(&self.path) {
            return Err(self.fail(Failure::io("cannot be finished", &error)));
        }
        self.summary.bytes = self.end;
        Ok(self.summary)
    }
}

/// Puts the channels of the summary into the order of their numbers. The library writes them in the order of a hash map
/// with a random seed, so that no two files would be the same. `bytes` are the end of a finished file, from `start` on.
fn sort_channels(bytes: &mut [u8], start: u64) {
    let Some(footer) = bytes.len().checked_sub(FOOTER_BYTES) else { return };
    let place = bytes.get(footer + 9..).and_then(|b| b.first_chunk()).map_or(0, |b| u64::from_le_bytes(*b));
    let Some(summary) = place.checked_sub(start).and_then(|place| usize::try_from(place).ok()) else { return };
    let Some(section) = bytes.get_mut(summary..footer) else { return };
    let (mut records, mut rest) = (Vec::new(), &*section);
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
    let mut sorted = records.concat();
    sorted.extend_from_slice(rest);
    section.copy_from_slice(&sorted);
}

impl Drop for Recorder {
    /// Writes the last chunk, but leaves the file marked unfinished: only [`Recorder::finish`] says that all is there.
    fn drop(&mut self) {
        if self.writer.is_some()
            && self.failure.is_none()
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
