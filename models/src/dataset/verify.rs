//! Verification of a dataset: maps against the manifest, duplicates, and leaks between splits.

use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet};

use radome_dsp::Occupancy;
use serde::Serialize;

use super::error::DatasetError;
use super::manifest::{Domain, ManifestRow, Split, SplitBy};
use super::reader::Dataset;
use super::split::SplitSpec;

/// Map that cannot be read or differs from its hash.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Damage {
    /// Index of the map.
    pub map: usize,
    /// Cause, with the file.
    pub what: String,
}

/// Maps with equal cells, or rows of the same frame.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Duplicate {
    /// Indices of the maps, two or more.
    pub maps: Vec<usize>,
    /// Common property: `cells`, or `frame` for a frame of a recording that is listed twice.
    pub what: &'static str,
    /// Splits of these maps, each once.
    pub splits: Vec<Split>,
    /// Labels of these maps, each once. More than one label is a contradiction.
    pub labels: Vec<Occupancy>,
}

/// Group of sequences that lies in more than one split.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Leak {
    /// Kind of the group.
    pub by: SplitBy,
    /// Name of the group.
    pub name: String,
    /// Splits that the group lies in.
    pub splits: Vec<Split>,
}

/// Recording and simulation of a pair that do not match.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct PairMismatch {
    /// Name of the pair.
    pub pair: String,
    /// Cause.
    pub what: String,
}

/// Findings of [`verify`].
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct VerifyReport {
    /// Number of maps.
    pub maps: usize,
    /// Number of sequences.
    pub sequences: usize,
    /// Number of maps in training, validation and test.
    pub split_maps: [usize; 3],
    /// Damaged maps.
    pub damaged: Vec<Damage>,
    /// Maps that occur more than once.
    pub duplicates: Vec<Duplicate>,
    /// Sequences and other groups in more than one split.
    pub leaks: Vec<Leak>,
    /// Sequences with people that lack the property which is checked besides the sequence ([`SplitBy::ungrouped`]): no leak of theirs
    /// can be found.
    pub ungrouped: Vec<String>,
    /// Number of pairs of a recording and its simulation.
    pub pairs: usize,
    /// Pairs whose two sides do not match.
    pub unpaired: Vec<PairMismatch>,
}

impl VerifyReport {
    /// Returns whether there are no findings.
    pub fn is_sound(&self) -> bool {
        self.damaged.is_empty() && self.duplicates.is_empty() && self.leaks.is_empty() && self.unpaired.is_empty()
    }
}

/// Reads every map, compares it with its hash, and finds duplicates and groups that lie in more than one split.
///
/// Subjects, scenes or seeds are checked if `spec` divides by them. Sequences without a split are divided by sequence in any case,
/// as a training without settings does. If they were divided by the checked property, no leak could be found.
///
/// # Errors
/// Those of [`SplitSpec::assign`], except groups in two splits, which are reported as leaks.
pub fn verify(dataset: &Dataset, spec: &SplitSpec) -> Result<VerifyReport, DatasetError> {
    let rows = dataset.rows();
    let damaged = (0..rows.len())
        .filter_map(|map| dataset.map(map).err().map(|error| Damage { map, what: error.to_string() }))
        .collect();
    let splits = match (SplitSpec { by: SplitBy::Sequence, ..spec.clone() }).assign(rows) {
        Ok(splits) => splits,
        // Splits are used as written, and the report lists the leaks.
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

    let mut group_kinds = vec![SplitBy::Sequence];
    group_kinds.extend((spec.by != SplitBy::Sequence).then_some(spec.by));
    let leaks = group_kinds.into_iter().flat_map(|by| leaks(rows, &splits, by)).collect();
    let mut split_maps = [0; 3];
    splits.iter().for_each(|split| split_maps[*split as usize] += 1);
    let sequences = rows.iter().map(|row| row.sequence.as_str()).collect::<BTreeSet<_>>().len();
    let (pairs, unpaired) = check_pairs(rows);
    let ungrouped = spec.by.ungrouped(rows).into_iter().map(str::to_owned).collect();
    Ok(VerifyReport { maps: rows.len(), sequences, split_maps, damaged, duplicates, leaks, ungrouped, pairs, unpaired })
}

/// Frame on one side of a pair.
#[derive(PartialEq)]
struct PairedFrame {
    time_ns: Option<u64>,
    label: Occupancy,
    transition: bool,
}

/// Frames on both sides of a pair, by frame number, and their sequences.
#[derive(Default)]
struct Pair<'a> {
    real: BTreeMap<u64, PairedFrame>,
    sim: BTreeMap<u64, PairedFrame>,
    sequences: BTreeSet<&'a str>,
}

impl Pair<'_> {
    /// First violation of the rules for pairs, in words; `None` if the sides match. Both sides must have the same frames with the
    /// same times and labels, and belong to one sequence, so that they are in one split.
    fn mismatch(&self) -> Option<String> {
        let Pair { real, sim, sequences } = self;
        if real.is_empty() || sim.is_empty() {
            return Some(format!("has no {} side", if real.is_empty() { Domain::Real } else { Domain::Sim }));
        }
        let is_single = |frame: &&u64| !(real.contains_key(*frame) && sim.contains_key(*frame));
        if let Some(frame) = real.keys().chain(sim.keys()).find(is_single) {
            let (has, lacks) =
                if real.contains_key(frame) { (Domain::Real, Domain::Sim) } else { (Domain::Sim, Domain::Real) };
            return Some(format!(
                "has {} real and {} simulated frames; frame {frame} is {has} and not {lacks}",
                real.len(),
                sim.len()
            ));
        }
        let differing = real.iter().find_map(|(frame, a)| sim.get(frame).filter(|b| *b != a).map(|b| (frame, a, b)));
        if let Some((frame, real, sim)) = differing {
            let time = |time: Option<u64>| time.map_or("no time".into(), |ns| format!("{:.6} s", ns as f64 * 1e-9));
            return Some(format!(
                "frame {frame} is {} at {} if real, {} at {} if simulated",
                real.label,
                time(real.time_ns),
                sim.label,
                time(sim.time_ns)
            ));
        }
        (sequences.len() > 1).then(|| format!("is in {} sequences, which splits may part", sequences.len()))
    }
}

/// Number of pairs, and those whose sides do not match.
fn check_pairs(rows: &[ManifestRow]) -> (usize, Vec<PairMismatch>) {
    let mut pairs: BTreeMap<&str, Pair> = BTreeMap::new();
    for row in rows {
        let Some(name) = &row.pair else { continue };
        let pair = pairs.entry(name).or_default();
        let side = if row.domain == Domain::Real { &mut pair.real } else { &mut pair.sim };
        side.insert(row.frame, PairedFrame { time_ns: row.time_ns, label: row.label, transition: row.transition });
        pair.sequences.insert(&row.sequence);
    }
    let mismatch = |(name, pair): (&&str, &Pair)| {
        let what = pair.mismatch()?;
        Some(PairMismatch { pair: (*name).to_owned(), what })
    };
    (pairs.len(), pairs.iter().filter_map(mismatch).collect())
}

/// Groups of one kind that lie in more than one split.
fn leaks(rows: &[ManifestRow], splits: &[Split], by: SplitBy) -> Vec<Leak> {
    let mut group_splits: BTreeMap<Cow<str>, BTreeSet<Split>> = BTreeMap::new();
    for (row, split) in rows.iter().zip(splits) {
        if let Some(name) = by.group_name(row) {
            group_splits.entry(name).or_default().insert(*split);
        }
    }
    let leaking = group_splits.into_iter().filter(|(_, splits)| splits.len() > 1);
    leaking.map(|(name, splits)| Leak { by, name: name.into_owned(), splits: splits.into_iter().collect() }).collect()
}
