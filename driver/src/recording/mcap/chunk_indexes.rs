//! Index of the chunks of a running recording. It is on the disk, so that memory does not grow with the recording.

use std::fs::File;
use std::io::{self, Read, Seek};
use std::path::{Path, PathBuf};

use mcap::records::{ChunkIndex, op};

use super::encode::{body_of, record};
use super::records::RECORD_HEADER;
use crate::recording::disk;

/// Largest number of bytes of entries in memory: some forty entries.
pub(super) const MAX_BUFFERED_BYTES: usize = 4096;
/// Largest number of bytes that are read at once.
const BLOCK_BYTES: u64 = 1 << 16;

/// Chunk index records in the order of the chunks. They are in a file without a name, which vanishes when the list is
/// dropped or the process ends. Readers find the chunks of an unfinished recording without it.
pub(super) struct ChunkIndexes {
    file: File,
    /// Path of the recording.
    path: PathBuf,
    /// Number of bytes in the file; during reading, number of bytes left.
    stored: u64,
    /// Records that are not in the file yet.
    buffer: Vec<u8>,
}

impl ChunkIndexes {
    /// Starts an empty list for a recording: `recording` is its file, `path` its name.
    pub fn create(recording: &File, path: &Path) -> io::Result<Self> {
        let file = disk::unnamed(recording, path)?;
        Ok(ChunkIndexes { file, path: path.to_owned(), stored: 0, buffer: Vec::with_capacity(MAX_BUFFERED_BYTES) })
    }

    /// Adds the entry of a chunk.
    pub fn push(&mut self, index: &ChunkIndex) -> io::Result<()> {
        let body = body_of(index);
        if self.buffer.len() + RECORD_HEADER as usize + body.len() > MAX_BUFFERED_BYTES {
            disk::append(&self.file, &self.path, self.stored, &self.buffer)?;
            self.stored += self.buffer.len() as u64;
            self.buffer.clear();
        }
        record(&mut self.buffer, op::CHUNK_INDEX, &body);
        Ok(())
    }

    /// Number of bytes of entries in memory.
    #[cfg(test)]
    pub fn buffered_bytes(&self) -> usize {
        self.buffer.len()
    }

    /// Seeks the first record, to read all of them. Nothing can be added from then on.
    pub fn rewind(&mut self) -> io::Result<()> {
        self.file.rewind()
    }

    /// Appends the next records to `out`, at most one block; returns their length in bytes, 0 behind the last.
    pub fn read(&mut self, out: &mut Vec<u8>) -> io::Result<u64> {
        let count = self.file.by_ref().take(BLOCK_BYTES).read_to_end(out)?;
        self.stored = self.stored.checked_sub(count as u64).ok_or(io::ErrorKind::InvalidData)?;
        if count > 0 {
            return Ok(count as u64);
        }
        if self.stored > 0 {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        let buffer = std::mem::take(&mut self.buffer);
        out.extend_from_slice(&buffer);
        Ok(buffer.len() as u64)
    }
}
