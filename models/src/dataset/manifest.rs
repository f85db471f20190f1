//! `manifest.jsonl`: a row for each map.

use std::borrow::Cow;

use radome_dsp::Occupancy;
use serde::{Deserialize, Serialize};

/// Where frames came from.
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
        f.write_str(match self {
            Domain::Sim => "sim",
            Domain::Real => "real",
        })
    }
}

/// What a map may be used for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Split {
    /// To learn from.
    Train,
    /// To choose by.
    Validation,
    /// To judge by, once.
    Test,
}

impl std::fmt::Display for Split {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Split::Train => "train",
            Split::Validation => "validation",
            Split::Test => "test",
        })
    }
}

/// What is known of one map.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ManifestRow {
    /// Where the frame came from.
    pub domain: Domain,
    /// Scene or place.
    pub scene: String,
    /// Recording (file or simulation run).
    pub recording: String,
    /// Who is in it, where known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub subject: Option<String>,
    /// Stretch of frames that belong together: no two splits share one.
    pub sequence: String,
    /// Sequence number of the (last) frame within its recording.
    pub frame: u64,
    /// When that frame began, by its recording's clock, ns.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub time_ns: Option<u64>,
    /// Common name of a recording and of the simulation that mirrors it: maps of the two with the same frame are of the same
    /// moment.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pair: Option<String>,
    /// The class.
    pub label: Occupancy,
    /// Someone is entering or leaving.
    #[serde(default)]
    pub transition: bool,
    /// Split, where fixed by whoever made the dataset.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub split: Option<Split>,
    /// Seed of the simulation.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub seed: Option<u64>,
    /// SHA-256 of the map's cells (f32, little-endian), hex; filled in by the writer.
    #[serde(default)]
    pub hash: String,
}

impl ManifestRow {
    /// A row with what must be known; the rest is empty.
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
            hash: String::new(),
        }
    }
}

/// What stays whole.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SplitBy {
    /// Sequences: who is judged may have been seen on another day.
    #[default]
    Sequence,
    /// Subjects: who is judged has never been seen. Sequences without a subject stand for themselves.
    Subject,
    /// Scenes: where is judged has never been seen.
    Scene,
    /// Seeds of a scene, where what it draws makes another place of each: runs of one seed with nobody, one and two people
    /// share their room. Recordings stand for themselves.
    Seed,
}

impl SplitBy {
    /// Its name in a row; `None` where the row has none.
    pub(super) fn name(self, row: &ManifestRow) -> Option<Cow<'_, str>> {
        match self {
            SplitBy::Sequence => Some(Cow::from(&row.sequence)),
            SplitBy::Subject => row.subject.as_ref().map(Cow::from),
            SplitBy::Scene => Some(Cow::from(&row.scene)),
            SplitBy::Seed => row.seed.map(|seed| Cow::from(format!("{}, seed {seed}", row.scene))),
        }
    }

    /// As files spell it.
    pub fn label(self) -> &'static str {
        match self {
            SplitBy::Sequence => "sequence",
            SplitBy::Subject => "subject",
            SplitBy::Scene => "scene",
            SplitBy::Seed => "seed",
        }
    }

    pub(super) fn is_sequence(&self) -> bool {
        *self == SplitBy::Sequence
    }
}

impl std::fmt::Display for SplitBy {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.label())
    }
}
