//! Manifest of a dataset: `manifest.jsonl`, with a row for each map.

use std::borrow::Cow;
use std::collections::BTreeSet;

use radome_dsp::Occupancy;
use radome_dsp::rdm::Motion;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

/// Source of frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Domain {
    /// The simulator.
    Sim,
    /// A sensor.
    Real,
}

impl std::fmt::Display for Domain {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.serialize(f)
    }
}

/// Purpose of a map.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Split {
    /// Training.
    Train,
    /// Choice of models and settings.
    Validation,
    /// Final evaluation.
    Test,
}

impl std::fmt::Display for Split {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.serialize(f)
    }
}

/// Row of the manifest: metadata of one map.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ManifestRow {
    /// Source of the frame.
    pub domain: Domain,
    /// Scene or place.
    pub scene: String,
    /// Recording (file or simulation run).
    pub recording: String,
    /// Person in it, if known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub subject: Option<String>,
    /// Sequence of frames that belong together: no two splits share one.
    pub sequence: String,
    /// Sequence number of the (last) frame within its recording.
    pub frame: u64,
    /// Start of that frame on its recording's clock, ns.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub time_ns: Option<u64>,
    /// Common name of a recording and of the simulation that mirrors it: maps of the two with the same frame are of the same
    /// moment.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pair: Option<String>,
    /// The class.
    pub label: Occupancy,
    /// Whether someone is entering or leaving.
    #[serde(default)]
    pub transition: bool,
    /// Split, if the author of the dataset fixed it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub split: Option<Split>,
    /// Seed of the simulation.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub seed: Option<u64>,
    /// Motion of echoes up to that frame, if the map spec asks for it; filled in by the writer.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub motion: Option<Motion>,
    /// SHA-256 of the map's cells and of the quantities of its motion (f32, little-endian), hex; filled in by the writer.
    #[serde(default)]
    pub hash: String,
}

impl ManifestRow {
    /// Makes a row with the required fields; the others are empty.
    pub fn new(domain: Domain, scene: &str, recording: &str, sequence: &str, frame: u64, label: Occupancy) -> Self {
        ManifestRow {
            domain,
            scene: scene.to_owned(),
            recording: recording.to_owned(),
            subject: None,
            sequence: sequence.to_owned(),
            frame,
            time_ns: None,
            pair: None,
            label,
            transition: false,
            split: None,
            seed: None,
            motion: None,
            hash: String::new(),
        }
    }
}

/// Short hash of a sequence's name, 16 hex digits. Model files list the sequences of their training by it.
pub(crate) fn sequence_hash(sequence: &str) -> String {
    let mut hash = format!("{:x}", Sha256::digest(sequence.as_bytes()));
    hash.truncate(16);
    hash
}

/// Kind of group that stays within one split.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum SplitBy {
    /// Sequences: people in the test split may be in the training split on another day.
    #[default]
    Sequence,
    /// Subjects: people in the test split are in no other split. A sequence without a subject is a group of its own.
    Subject,
    /// Scenes: rooms in the test split are in no other split.
    Scene,
    /// Seeds of a scene that draws a different room for each seed: runs of one seed with different numbers of people share their
    /// room. A recording without a seed is a group of its own.
    Seed,
}

/// Largest number of sequences that a message lists.
const MOST_LISTED: usize = 5;

/// Quoted names of the first sequences, for a message.
pub(super) fn quoted_names<'a>(sequences: impl ExactSizeIterator<Item = &'a str>) -> String {
    let others = if sequences.len() > MOST_LISTED { " and others" } else { "" };
    let names: Vec<String> = sequences.take(MOST_LISTED).map(|sequence| format!("'{sequence}'")).collect();
    format!("{}{others}", names.join(", "))
}

impl SplitBy {
    /// Sequences that show people and lack this property. A split treats each of them as a separate group.
    pub fn ungrouped<'a>(self, rows: impl IntoIterator<Item = &'a ManifestRow>) -> BTreeSet<&'a str> {
        let is_ungrouped = |row: &&ManifestRow| row.label != Occupancy::Empty && self.group_name(row).is_none();
        rows.into_iter().filter(is_ungrouped).map(|row| row.sequence.as_str()).collect()
    }

    /// Warning that names the sequences of [`SplitBy::ungrouped`]; `None` if there are none.
    pub fn warning<'a>(self, rows: impl IntoIterator<Item = &'a ManifestRow>) -> Option<String> {
        let sequences = self.ungrouped(rows);
        (!sequences.is_empty()).then(|| {
            format!(
                "{} sequences with people have no {self}: {}; a split by {self} takes each for a group of its own, and may part \
                 it from others of the same {self}",
                sequences.len(),
                quoted_names(sequences.iter().copied())
            )
        })
    }

    /// Name of the group of a row; `None` if the row has none.
    pub(super) fn group_name(self, row: &ManifestRow) -> Option<Cow<'_, str>> {
        match self {
            SplitBy::Sequence => Some(Cow::from(&row.sequence)),
            SplitBy::Subject => row.subject.as_ref().map(Cow::from),
            SplitBy::Scene => Some(Cow::from(&row.scene)),
            SplitBy::Seed => row.seed.map(|seed| Cow::from(format!("{}, seed {seed}", row.scene))),
        }
    }
}

impl std::fmt::Display for SplitBy {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.serialize(f)
    }
}
