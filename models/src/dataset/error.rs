//! Errors of datasets.

use std::path::{Path, PathBuf};

use radome_dsp::{RdmShape, rdm::SpecError};
use thiserror::Error;

use super::manifest::{Split, SplitBy};

/// A dataset that cannot be read, written or used.
#[derive(Debug, Error)]
#[allow(missing_docs, reason = "the message says what each field is")]
pub enum DatasetError {
    /// The sequence to hold out does not exist.
    #[error("there is no sequence '{sequence}' to hold out\n\nhint: the dataset has {known}")]
    NoSuchSequence { sequence: String, known: String },
    /// A file operation failed.
    #[error("{path}: {action} failed: {source}")]
    Io { path: PathBuf, action: &'static str, source: std::io::Error },
    /// There is no dataset here.
    #[error(
        "{path}: this is no dataset, which is a folder with dataset.json in it\n\nhint: radome dataset build SPEC.toml -o DIR makes one"
    )]
    NoDataset { path: PathBuf },
    /// The folder to create exists already.
    #[error("{path} exists already\n\nhint: choose another name or move it away")]
    Exists { path: PathBuf },
    /// The temporary folder of the dataset holds a file that no dataset writer made.
    #[error(
        "{path}: the dataset is made in this folder, which must be empty, but holds {name}\n\nhint: move the folder away, or choose another name for the dataset"
    )]
    ForeignFile { path: PathBuf, name: String },
    /// Another process has locked the folder.
    #[error("{path}: another process is at work here\n\nhint: wait until it has ended, or end it")]
    Busy { path: PathBuf },
    /// Datasets to be merged hold different kinds of maps.
    #[error("{path}: {what} is not that of {first}; only maps that were made in the same way can be merged")]
    DifferentMaps { path: PathBuf, what: String, first: PathBuf },
    /// A JSON document or line is invalid. Lines count from 1.
    #[error(
        "{path}, line {line}: {source}\n\nhint: the file is damaged or of an earlier version of this program; build the dataset again"
    )]
    Json { path: PathBuf, line: usize, source: serde_json::Error },
    /// A newer program wrote the dataset.
    #[error(
        "{path}: dataset format {found} is newer than {supported}, the newest this program reads\n\nhint: update it"
    )]
    Newer { path: PathBuf, found: u32, supported: u32 },
    /// The map spec does not fit the waveform.
    #[error("{0}")]
    Spec(#[from] SpecError),
    /// The parts of a dataset contradict each other.
    #[error("{path}: expected {expected}, found {found}")]
    Inconsistent { path: PathBuf, expected: String, found: String },
    /// A map has another shape than the dataset, or another number of cells than its shape says.
    #[error("map of frame {sequence}: shape is {got}, the dataset holds {expected}")]
    Shape { sequence: u64, expected: RdmShape, got: RdmShape },
    /// A map, identified by its index or name, holds NaN or infinity.
    #[error(
        "map {map}: {cells} cells are not finite\n\nhint: check the program that made the map; all cells of a dataset are finite"
    )]
    NonFinite { map: String, cells: usize },
    /// The map spec asks for motion and a map has none that is finite, or the other way round. Maps are identified by index or name.
    #[error("map {map}: expected {expected}\n\nhint: make the map by the map spec of the dataset")]
    Motion { map: String, expected: &'static str },
    /// The dataset has no map with this index.
    #[error("there is no map {index}: the dataset has {maps} maps")]
    NoSuchMap { index: usize, maps: usize },
    /// A map or its motion does not match the hash that was computed when it was written.
    #[error(
        "{path}: map {index} has SHA-256 {found}, the manifest says {expected}; this file or the manifest was changed or damaged"
    )]
    Hash { path: PathBuf, index: usize, expected: String, found: String },
    /// Frames of one sequence are in two splits.
    #[error(
        "sequence '{sequence}' is in two splits, {first} and {second}\n\nhint: neighbouring frames are near copies; give all rows of a sequence one split"
    )]
    SequenceInTwoSplits { sequence: String, first: Split, second: Split },
    /// Sequences of one subject, scene or seed are in two splits.
    #[error(
        "sequence '{}' is in {}, and '{}', which belongs to the same group by {by}, in {}\n\nhint: split by sequence, or give all rows of a {by} one split",
        sequences[0], splits[0], sequences[1], splits[1]
    )]
    GroupInTwoSplits { by: SplitBy, group: String, sequences: [String; 2], splits: [Split; 2] },
    /// The fractions of a split are out of range.
    #[error(
        "split: validation {validation} and test {test} must each be in 0..1 and leave something to train on together"
    )]
    Fractions { validation: f64, test: f64 },
}

impl DatasetError {
    pub(super) fn io(path: &Path, action: &'static str) -> impl FnOnce(std::io::Error) -> DatasetError {
        let path = path.to_owned();
        move |source| DatasetError::Io { path, action, source }
    }
}
