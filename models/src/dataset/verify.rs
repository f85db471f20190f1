//! Whether a dataset is what its manifest says, and whether training has seen what testing asks.

use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet};

use radome_dsp::Occupancy;
use serde::Serialize;

use super::{Dataset, DatasetError, ManifestRow, Split, SplitBy, SplitSpec};

/// A map that cannot be read or is not the one that was written.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Damage {
    /// Index of the map.
    pub map: usize,
    /// What is wrong, and in which file.
    pub what: String,
}

/// Maps that are the same to the bit, or rows of the same frame.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Duplicate {
    /// Indices of the maps, two or more.
    pub maps: Vec<usize>,
    /// What they have in common: `cells`, or `frame` for one frame of a recording that is listed twice.
    pub what: &'static str,
    /// Their splits, each once.
    pub splits: Vec<Split>,
    /// Their labels, each once: more than one is a contradiction.
    pub labels: Vec<Occupancy>,
}

/// Something that lies in more than one split.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Leak {
    /// Of what kind.
    pub by: SplitBy,
    /// Its name.
    pub name: String,
    /// The splits.
    pub splits: Vec<Split>,
}

/// What [`verify`] finds.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct VerifyReport {
    /// Maps.
    pub maps: usize,
    /// Sequences.
    pub sequences: usize,
    /// Maps in training, validation and test.
    pub split_maps: [usize; 3],
    /// Maps that are not as written.
    pub damaged: Vec<Damage>,
    /// Maps that are there more than once.
    pub duplicates: Vec<Duplicate>,
    /// Sequences, and what else was asked about, in more than one split.
    pub leaks: Vec<Leak>,
}

impl VerifyReport {
    /// Nothing was found.
    pub fn is_sound(&self) -> bool {
        self.damaged.is_empty() && self.duplicates.is_empty() && self.leaks.is_empty()
    }
}

/// Reads every map, compares it with its hash, and looks for duplicates and for what lies in more than one split. Whether
/// subjects or scenes are shared among splits is looked at where `spec` splits by them.
///
/// # Errors
/// What [`SplitSpec::assign`] refuses, except what should be whole and lies in two splits, which is reported.
pub fn verify(dataset: &Dataset, spec: &SplitSpec) -> Result<VerifyReport, DatasetError> {
    let rows = dataset.rows();
    let damaged = (0..rows.len())
        .filter_map(|map| dataset.verified_map(map).err().map(|error| Damage { map, what: error.to_string() }))
        .collect();
    let splits = match spec.assign(rows) {
        Ok(splits) => splits,
        // As they are written: the report says where it leaks.
        Err(DatasetError::SequenceInTwoSplits { .. } | DatasetError::GroupInTwoSplits { .. }) => {
            rows.iter().map(|row| row.split.unwrap_or(Split::Train)).collect()
        }
        Err(error) => return Err(error),
    };
    let split_of = |map: usize| splits.get(map).copied().unwrap_or(Split::Train);

    let mut by_hash: BTreeMap<&str, Vec<usize>> = BTreeMap::new();
    let mut by_frame: BTreeMap<(&str, u64), Vec<usize>> = BTreeMap::new();
    for (map, row) in rows.iter().enumerate() {
        by_hash.entry(&row.hash).or_default().push(map);
        by_frame.entry((&row.recording, row.frame)).or_default().push(map);
    }
    let duplicate = |what: &'static str, maps: Vec<usize>| Duplicate {
        splits: maps.iter().map(|&map| split_of(map)).collect::<BTreeSet<_>>().into_iter().collect(),
        labels: maps
            .iter()
            .filter_map(|&map| Some(rows.get(map)?.label))
            .collect::<BTreeSet<_>>()
            .into_iter()
            .collect(),
        maps,
        what,
    };
    let same_cells: Vec<Vec<usize>> = by_hash.into_values().filter(|maps| maps.len() > 1).collect();
    let same_frame = by_frame.into_values().filter(|maps| maps.len() > 1 && !same_cells.contains(maps));
    let same_frame: Vec<Duplicate> = same_frame.map(|maps| duplicate("frame", maps)).collect();
    let mut duplicates: Vec<Duplicate> = same_cells.into_iter().map(|maps| duplicate("cells", maps)).collect();
    duplicates.extend(same_frame);
    duplicates.sort_by(|a, b| a.maps.cmp(&b.maps));

    let mut asked = vec![SplitBy::Sequence];
    asked.extend((spec.by != SplitBy::Sequence).then_some(spec.by));
    let leaks = asked.into_iter().flat_map(|by| leaks(rows, &splits, by)).collect();
    let mut split_maps = [0; 3];
    splits.iter().for_each(|split| split_maps[*split as usize] += 1);
    let sequences = rows.iter().map(|row| row.sequence.as_str()).collect::<BTreeSet<_>>().len();
    Ok(VerifyReport { maps: rows.len(), sequences, split_maps, damaged, duplicates, leaks })
}

fn leaks(rows: &[ManifestRow], splits: &[Split], by: SplitBy) -> Vec<Leak> {
    let mut seen: BTreeMap<Cow<str>, BTreeSet<Split>> = BTreeMap::new();
    for (row, split) in rows.iter().zip(splits) {
        if let Some(name) = by.name(row) {
            seen.entry(name).or_default().insert(*split);
        }
    }
    let leaking = seen.into_iter().filter(|(_, splits)| splits.len() > 1);
    leaking.map(|(name, splits)| Leak { by, name: name.into_owned(), splits: splits.into_iter().collect() }).collect()
}
