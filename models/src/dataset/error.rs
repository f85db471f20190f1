//! What can be wrong with a dataset.

use std::path::{Path, PathBuf};

use radome_dsp::{RdmShape, rdm::SpecError};
use thiserror::Error;

use super::manifest::{Split, SplitBy};

/// A dataset that cannot be read, written or used.
#[derive(Debug, Error)]
pub enum DatasetError {
    /// A sequence that is to be held out is not there.
    #[error("there is no sequence '{sequence}' to hold out")]
    NoSuchSequence {
        /// Its name.
        sequence: String,
    },
    /// A file operation failed.
    #[error("{path}: {action} failed: {source}")]
    Io {
        /// File or folder.
        path: PathBuf,
        /// What was being done.
        action: &'static str,
        /// Why it failed.
        source: std::io::Error,
    },
    /// The folder to create is there already.
    #[error("{path} exists already\n\nhint: choose another name or move it away")]
    Exists {
        /// The folder.
        path: PathBuf,
    },
    /// Another process writes the same folder.
    #[error("{path}: another process is at work here\n\nhint: wait until it has ended, or end it")]
    Busy {
        /// The folder.
        path: PathBuf,
    },
    /// Datasets to be merged hold different kinds of maps.
    #[error("{path}: {what} is not that of {first}; only maps that were made in the same way can be merged")]
    Unlike {
        /// The dataset.
        path: PathBuf,
        /// What differs.
        what: String,
        /// The one that it was compared with.
        first: PathBuf,
    },
    /// A JSON document or line cannot be understood.
    #[error("{path}, line {line}: {source}")]
    Json {
        /// File.
        path: PathBuf,
        /// Line, from 1.
        line: usize,
        /// What is wrong.
        source: serde_json::Error,
    },
    /// Written by a newer program.
    #[error(
        "{path}: dataset format {found} is newer than {supported}, the newest this program reads\n\nhint: update it"
    )]
    Newer {
        /// Header file.
        path: PathBuf,
        /// Version found.
        found: u32,
        /// Newest version that is understood.
        supported: u32,
    },
    /// The map spec does not fit the waveform.
    #[error("{0}")]
    Spec(#[from] SpecError),
    /// The parts of a dataset contradict each other.
    #[error("{path}: expected {expected}, found {found}")]
    Inconsistent {
        /// File.
        path: PathBuf,
        /// What should be there.
        expected: String,
        /// What is there.
        found: String,
    },
    /// A map has another shape than the dataset.
    #[error("map of frame {sequence}: shape is {got}, the dataset holds {expected}")]
    Shape {
        /// Sequence number of the map's frame.
        sequence: u64,
        /// Shape of the dataset.
        expected: RdmShape,
        /// Shape of the map (or its number of cells disagrees).
        got: RdmShape,
    },
    /// A map holds NaN or infinity.
    #[error("map {map}: {cells} cells are not finite\n\nhint: find out what produced them; a dataset holds none")]
    NonFinite {
        /// Index or name of the map.
        map: String,
        /// How many cells.
        cells: usize,
    },
    /// No map with this index.
    #[error("map {index} asked for, the dataset has {maps}")]
    NoSuchMap {
        /// Index.
        index: usize,
        /// Maps there are.
        maps: usize,
    },
    /// A map differs from what was hashed when it was written.
    #[error("{path}: map {index} has SHA-256 {found}, the manifest says {expected}; the file was changed or damaged")]
    Hash {
        /// Shard.
        path: PathBuf,
        /// Map.
        index: usize,
        /// Hash in the manifest.
        expected: String,
        /// Hash of what is there.
        found: String,
    },
    /// Frames of one sequence would be both learnt from and judged by.
    #[error(
        "sequence '{sequence}' is in two splits, {first} and {second}\n\nhint: neighbouring frames are near copies; give all rows of a sequence one split"
    )]
    SequenceInTwoSplits {
        /// The sequence.
        sequence: String,
        /// One split.
        first: Split,
        /// The other.
        second: Split,
    },
    /// A subject or scene would be both learnt from and judged by.
    #[error(
        "sequence '{}' is in {}, and '{}', which hangs together with it by {by}, in {}\n\nhint: split by sequence, or give all rows of a {by} one split",
        sequences[0], splits[0], sequences[1], splits[1]
    )]
    GroupInTwoSplits {
        /// What should stay whole.
        by: SplitBy,
        /// First sequence of the group.
        group: String,
        /// Two of its sequences.
        sequences: [String; 2],
        /// Their splits.
        splits: [Split; 2],
    },
    /// The fractions of a split are no fractions.
    #[error(
        "split: validation {validation} and test {test} must each be in 0..1 and leave something to train on together"
    )]
    Fractions {
        /// Share of validation.
        validation: f64,
        /// Share of test.
        test: f64,
    },
}

impl DatasetError {
    pub(super) fn io(path: &Path, action: &'static str) -> impl FnOnce(std::io::Error) -> DatasetError {
        let path = path.to_owned();
        move |source| DatasetError::Io { path, action, source }
    }
}
