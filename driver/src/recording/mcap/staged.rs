//! Staged labels: a file beside the recording, `.NAME.labels`, holds all of them and replaces those in the recording.
//!
//! While a recording is made, and while a finished one is labelled, each change writes this file anew. The new file is
//! written under another name, synced and renamed: at any moment the old list or the new one exists, and no file grows.
//! The list goes into the recording when it is finished or the editing ends. For a finished recording that overwrites
//! the summary, so the file first takes the new end of the recording too. After a power cut the next opener writes that
//! end once more.
//!
//! The file holds a line of JSON ([`Header`]), then the new end of the recording, if there is one. It states the CRC of
//! the recording's first bytes: a file that belongs to another recording of the same name is ignored.

use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::LabelSpan;
use super::records::MAX_RECORD;
use crate::recording::input::open_file;
use crate::recording::lock::lock;
use crate::recording::partial::{Partial, hidden};
use crate::recording::{Existing, RecordingError, disk};

const VERSION: u32 = 1;
/// Largest number of bytes that are compared at the start of the recording.
const PREFIX_BYTES: u64 = 1 << 16;

#[derive(Debug, Serialize, Deserialize)]
struct Header {
    version: u32,
    /// Length of the recording's start, bytes, and its CRC-32.
    prefix_bytes: u64,
    prefix_crc: u32,
    /// Offset, length and CRC-32 of the recording's new end; absent if the recording needs none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    end: Option<EndHeader>,
    labels: Vec<LabelSpan>,
}

#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
struct EndHeader {
    at: u64,
    bytes: u64,
    crc: u32,
}

/// End of a recording: all bytes from an offset on.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct RecordingEnd {
    /// Offset of the first byte.
    pub at: u64,
    /// Bytes from that offset on.
    pub bytes: Vec<u8>,
}

/// Labels in the file beside a recording.
#[derive(Debug)]
pub(super) struct Staged {
    /// All labels of the recording.
    pub labels: Vec<LabelSpan>,
    /// The end of the recording that holds them.
    pub end: Option<RecordingEnd>,
}

/// Path of the file of staged labels.
fn staged_path(recording: &Path) -> Result<PathBuf, RecordingError> {
    hidden(recording, ".labels")
}

/// CRC-32 of the first bytes of a file; `None` if it has fewer.
fn prefix_crc(recording: &Path, bytes: u64) -> std::io::Result<Option<u32>> {
    let mut start = Vec::new();
    File::open(recording)?.take(bytes).read_to_end(&mut start)?;
    Ok((start.len() as u64 == bytes).then(|| crc32fast::hash(&start)))
}

/// Replaces all labels of a recording, until [`remove`]; they are on the disk when this returns. `data_end` is the
/// length of the part of the recording that will not change.
///
/// # Errors
/// [`RecordingError::Io`]; the earlier labels are then still there.
pub(super) fn write(
    recording: &Path,
    data_end: u64,
    labels: &[LabelSpan],
    end: Option<&RecordingEnd>,
) -> Result<(), RecordingError> {
    let path = staged_path(recording)?;
    let cannot = || RecordingError::cannot_write(&path);
    let prefix_bytes = data_end.min(PREFIX_BYTES);
    let prefix = prefix_crc(recording, prefix_bytes).map_err(RecordingError::cannot_read(recording))?;
    let header = Header {
        version: VERSION,
        prefix_bytes,
        prefix_crc: prefix.unwrap_or(0),
        end: end.map(|end| EndHeader { at: end.at, bytes: end.bytes.len() as u64, crc: crc32fast::hash(&end.bytes) }),
        labels: labels.to_vec(),
    };
    let mut bytes = serde_json::to_vec(&header).map_err(|e| cannot()(e.into()))?;
    bytes.push(b'\n');
    if let Some(end) = end {
        bytes.extend_from_slice(&end.bytes);
    }
    let partial = Partial::file(&path, Existing::Replace)?;
    disk::append(&partial.open()?, &path, 0, &bytes).map_err(cannot())?;
    partial.finish()
}

/// Reads the labels beside a recording, if there are any.
///
/// # Errors
/// [`RecordingError`] if the file cannot be read, is damaged or was written by a newer program.
pub(super) fn read(recording: &Path) -> Result<Option<Staged>, RecordingError> {
    let path = staged_path(recording)?;
    let file = match open_file(&path) {
        Err(RecordingError::Missing { .. }) => return Ok(None),
        file => file?,
    };
    let mut bytes = Vec::new();
    file.take(2 * MAX_RECORD).read_to_end(&mut bytes).map_err(RecordingError::cannot_read(&path))?;
    let corrupt = |reason: String| RecordingError::Corrupt { path: path.clone(), offset: 0, reason };
    let line = bytes.iter().position(|byte| *byte == b'\n').ok_or_else(|| corrupt("no line with labels".into()))?;
    let (line, rest) = bytes.split_at(line);
    let version: Version = serde_json::from_slice(line).map_err(|e| corrupt(format!("malformed labels: {e}")))?;
    if version.version > VERSION {
        let got = format!("{} of staged labels", version.version);
        return Err(RecordingError::Newer { path: path.clone(), got, supported: "1" });
    }
    let header: Header = serde_json::from_slice(line).map_err(|e| corrupt(format!("malformed labels: {e}")))?;
    let prefix = prefix_crc(recording, header.prefix_bytes.min(PREFIX_BYTES));
    if prefix.map_err(RecordingError::cannot_read(recording))? != Some(header.prefix_crc) {
        tracing::warn!("{}: labels of another recording of this name; they are left out", path.display());
        return Ok(None);
    }
    let rest = rest.get(1..).unwrap_or(&[]);
    let end = match header.end {
        Some(end) if (rest.len() as u64, crc32fast::hash(rest)) == (end.bytes, end.crc) => {
            Some(RecordingEnd { at: end.at, bytes: rest.to_vec() })
        }
        Some(_) => return Err(corrupt("the recording's end in it is damaged".into())),
        None => None,
    };
    Ok(Some(Staged { labels: header.labels, end }))
}

#[derive(Deserialize)]
struct Version {
    version: u32,
}

/// Removes the labels beside a recording, once they are in it, or are those of a recording that was replaced.
pub(super) fn remove(recording: &Path) -> std::io::Result<()> {
    let Ok(path) = staged_path(recording) else { return Ok(()) };
    if !path.exists() {
        return Ok(());
    }
    disk::remove(&path)?;
    disk::sync_folder(&path)
}

/// Writes the end of a recording that its staged labels hold, and removes them. The caller has locked `file`.
pub(super) fn write_end(file: &File, recording: &Path, end: &RecordingEnd) -> std::io::Result<()> {
    disk::overwrite(file, recording, end.at, &end.bytes)?;
    disk::set_length(file, recording, end.at + end.bytes.len() as u64)?;
    disk::sync(file, recording)?;
    remove(recording)
}

/// Completes a write of labels into a finished recording that a power cut or a kill has interrupted. A recording that
/// has another writer, or that may only be read, is left as it is: its frames can be read anyway.
pub(super) fn recover(recording: &Path) {
    let is_interrupted = || matches!(read(recording), Ok(Some(Staged { end: Some(_), .. })));
    if !is_interrupted() {
        return;
    }
    let open = || File::options().read(true).write(true).open(recording);
    let Ok(locked) = lock(recording, Duration::ZERO, open) else { return };
    // The earlier holder of the lock may have completed it.
    if let Ok(Some(Staged { end: Some(end), .. })) = read(recording)
        && let Err(error) = write_end(locked.file(), recording, &end)
    {
        tracing::warn!(%error, "{}: labels are beside the recording and cannot be put into it", recording.display());
    }
}
