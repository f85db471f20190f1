//! Errors of datasets.

use std::path::{Path, PathBuf};

use radome_dsp::{RdmShape, rdm::SpecError};
use thiserror::Error;

use super::manifest::{Split, SplitBy};

/// A dataset that cannot be read, written or used.
#[derive(Debug, Error)]
pub enum DatasetError {
    /// The sequence to hold out does not exist.
    #[error("there is no sequence '{sequence}' to hold out")]
    NoSuchSequence {
        /// Name of the sequence.
        sequence: String,
    },
    /// A file operation failed.
    #[error("{path}: {action} failed: {source}")]
    Io {
        /// File or folder.
        path: PathBuf,
        /// Operation that failed.
        action: &'static str,
        /// Cause.
        source: std::io::Error,
    },
    /// The folder to create exists already.
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
        /// Name of the difference.
        what: String,
        /// Dataset that it was compared with.
        first: PathBuf,
    },
    /// A JSON document or line is invalid.
    #[error("{path}, line {line}: {source}")]
    Json {
        /// File.
        path: PathBuf,
        /// Line, from 1.
        line: usize,
        /// Cause.
        source: serde_json::Error,
    },
    /// A newer program wrote the dataset.
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
        /// Expected value.
        expected: String,
        /// Value found.
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
    #[error(
        "map {map}: {cells} cells are not finite\n\nhint: check the program that made the map; all cells of a dataset are finite"
    )]
    NonFinite {
        /// Index or name of the map.
        map: String,
        /// Number of these cells.
        cells: usize,
    },
    /// No map with this index.
    #[error("there is no map {index}: the dataset has {maps} maps")]
    NoSuchMap {
        /// Index.
        index: usize,
        /// Number of maps.
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
        /// Hash of the cells.
        found: String,
    },
    /// Frames of one sequence are in two splits.
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
    /// Sequences of one subject, scene or seed are in two splits.
    #[error(
        "sequence '{}' is in {}, and '{}', which belongs to the same group by {by}, in {}\n\nhint: split by sequence, or give all rows of a {by} one split",
        sequences[0], splits[0], sequences[1], splits[1]
    )]
    GroupInTwoSplits {
        /// Kind of group that must stay whole.
        by: SplitBy,
        /// First sequence of the group.
        group: String,
        /// Two of its sequences.
        sequences: [String; 2],
        /// Their splits.
        splits: [Split; 2],
    },
    /// The fractions of a split are out of range.
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
