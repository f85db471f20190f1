//! Splits into training, validation and test, by whole sequences, subjects, scenes or seeds.

use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet};

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::error::DatasetError;
use super::manifest::{Domain, ManifestRow, Split, SplitBy, quoted_names};

/// Rule that assigns splits to maps without one.
///
/// # Examples
/// ```
/// use radome_dsp::Occupancy;
/// use radome_models::dataset::{Domain, ManifestRow, SplitSpec};
///
/// let row = |k: u64| ManifestRow::new(Domain::Sim, "hall", "run", &format!("sequence {k}"), 0, Occupancy::One);
/// let rows: Vec<ManifestRow> = (0..10).map(row).collect();
/// assert_eq!(SplitSpec::default().assign(&rows)?.len(), 10);
/// # Ok::<(), radome_models::dataset::DatasetError>(())
/// ```
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct SplitSpec {
    /// Seed of the assignment.
    pub seed: u64,
    /// Share of sequences (or of groups of them) for validation.
    pub validation: f64,
    /// Share for test.
    pub test: f64,
    /// Kind of group that stays whole, besides sequences, which always do.
    #[serde(skip_serializing_if = "crate::is_default")]
    pub by: SplitBy,
    /// Sequence whose group alone is the test split, regardless of the rows and of `test`: for leave-one-out evaluation of few
    /// recordings.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub held_out: Option<String>,
}

/// Hash by which groups are ordered, and name of the group.
type HashedName<'a> = ([u8; 32], &'a str);

/// Group of sequences that stay in one split.
#[derive(Default)]
struct Group<'a> {
    /// Fixed split, and the sequence that fixes it.
    fixed: Option<(Split, &'a str)>,
    /// Whether a map of the group is of a sensor.
    is_real: bool,
    /// Whether the group has maps of empty, one and two.
    classes: [bool; 3],
}

impl Default for SplitSpec {
    fn default() -> Self {
        SplitSpec { seed: 0, validation: 0.15, test: 0.2, by: SplitBy::Sequence, held_out: None }
    }
}

impl SplitSpec {
    /// Checks the shares, which need no rows.
    ///
    /// # Errors
    /// [`DatasetError::Fractions`] if they leave nothing to train on.
    pub fn check(&self) -> Result<(), DatasetError> {
        let (validation, test) = (self.validation, self.test);
        let are_shares = [validation, test].iter().all(|share| (0.0..1.0).contains(share));
        if are_shares && validation + test < 1.0 { Ok(()) } else { Err(DatasetError::Fractions { validation, test }) }
    }

    /// Assigns a split to each row, in order.
    ///
    /// With `by`, sequences that share a subject, a scene or a seed form a group; otherwise each sequence is a group.
    /// Rows with a split keep it, and so does the rest of their group. The other groups are stratified by domain and by
    /// the set of their classes. Within a stratum they are ordered by a seeded hash of their name, and assigned to test
    /// first, then to validation. Each number is rounded to the nearest whole group, and at least one group is left for
    /// training. The result does not depend on threads, order of rows or machine. Every split contains every class if
    /// there are enough groups.
    ///
    /// # Errors
    /// [`DatasetError::Fractions`] if the shares leave nothing to train on, [`DatasetError::NoSuchSequence`] if there is no
    /// sequence to hold out, and [`DatasetError::SequenceInTwoSplits`] or [`DatasetError::GroupInTwoSplits`] if rows of one
    /// sequence or group have different splits.
    pub fn assign(&self, rows: &[ManifestRow]) -> Result<Vec<Split>, DatasetError> {
        self.check()?;
        let group_names = group_names(rows, self.by);
        let group_of_sequence = |sequence: &String| {
            let group = group_names.get(sequence.as_str()).copied();
            group.ok_or_else(|| DatasetError::NoSuchSequence {
                sequence: sequence.clone(),
                known: quoted_names(group_names.keys().copied()),
            })
        };
        let held_out = self.held_out.as_ref().map(group_of_sequence).transpose()?;
        let group_of = |row: &ManifestRow| group_names.get(row.sequence.as_str()).copied().unwrap_or_default();
        let groups = self.groups(rows, group_of, held_out.is_none())?;
        // Groups by domain and classes.
        let mut strata: BTreeMap<(bool, [bool; 3]), Vec<HashedName>> = BTreeMap::new();
        for (name, group) in &groups {
            if group.fixed.is_none() && held_out != Some(*name) {
                let mut hash = Sha256::new();
                hash.update(self.seed.to_le_bytes());
                hash.update(name.as_bytes());
                strata.entry((group.is_real, group.classes)).or_default().push((hash.finalize().into(), name));
            }
        }
        let mut assigned: BTreeMap<&str, Split> = BTreeMap::new();
        for mut stratum in strata.into_values() {
            stratum.sort_unstable();
            let (test, validation) = self.split_counts(stratum.len());
            for (index, (_, name)) in stratum.into_iter().enumerate() {
                let split = match index {
                    i if i < test => Split::Test,
                    i if i < test + validation => Split::Validation,
                    _ => Split::Train,
                };
                assigned.insert(name, split);
            }
        }
        let split = |row: &ManifestRow| {
            let name = group_of(row);
            if held_out == Some(name) {
                return Split::Test;
            }
            let fixed = groups.get(name).and_then(|group| Some(group.fixed?.0));
            fixed.or_else(|| assigned.get(name).copied()).unwrap_or(Split::Train)
        };
        Ok(rows.iter().map(split).collect())
    }

    /// Alphabetically first sequence of each group. If each of them is held out in turn, every sequence is in one test split.
    pub(crate) fn first_sequences<'a>(&self, rows: &'a [ManifestRow]) -> BTreeSet<&'a str> {
        group_names(rows, self.by).into_values().collect()
    }

    /// Returns whether the rule decides the split of any row.
    pub(crate) fn is_used(&self, rows: &[ManifestRow]) -> bool {
        self.held_out.is_some() || rows.iter().any(|row| row.split.is_none())
    }

    /// Returns whether the rule says anything about these rows: it decides the split of any, or names the groups that must stay together
    /// ([`SplitSpec::by`]), in other datasets too.
    pub(crate) fn counts(&self, rows: &[ManifestRow]) -> bool {
        self.is_used(rows) || self.by != SplitBy::default()
    }

    /// Warning that the splits of the rows count and not the rule. `None` if the rule is used, names no shares or seed of its own, or would
    /// give the same splits.
    pub(crate) fn unused_warning(&self, rows: &[ManifestRow]) -> Option<String> {
        // `by` always counts: no group may be in two splits.
        let is_default = *self == SplitSpec { by: self.by, ..SplitSpec::default() };
        if is_default || self.is_used(rows) {
            return None;
        }
        let undivided: Vec<ManifestRow> = rows.iter().map(|row| ManifestRow { split: None, ..row.clone() }).collect();
        let by_rule = self.assign(&undivided).ok()?;
        let is_same = rows.iter().zip(by_rule).all(|(row, split)| row.split == Some(split));
        (!is_same).then(|| {
            format!(
                "all {} maps have a split in the dataset, so seed and shares of the settings' rule (split) do not count",
                rows.len()
            )
        })
    }

    /// Warning that names the other sequences in the group of [`SplitSpec::held_out`], which are held out with it. `None` if there
    /// are none.
    pub(crate) fn group_warning(&self, rows: &[ManifestRow]) -> Option<String> {
        let held_out = self.held_out.as_deref()?;
        let group_names = group_names(rows, self.by);
        let held_out_group = group_names.get(held_out)?;
        let others = group_names.iter().filter(|(name, group)| **name != held_out && *group == held_out_group);
        let others: Vec<&str> = others.map(|(name, _)| *name).collect();
        (!others.is_empty()).then(|| {
            let (by, others) = (self.by, quoted_names(others.iter().copied()));
            format!("sequence '{held_out}' is held out with the other sequences of its {by}: {others}")
        })
    }

    /// Groups of the rows, by name. Splits of rows count only if `use_row_splits`.
    fn groups<'a>(
        &self,
        rows: &'a [ManifestRow],
        group_of: impl Fn(&ManifestRow) -> &'a str,
        use_row_splits: bool,
    ) -> Result<BTreeMap<&'a str, Group<'a>>, DatasetError> {
        let mut groups: BTreeMap<&str, Group> = BTreeMap::new();
        for row in rows {
            let group = groups.entry(group_of(row)).or_default();
            match (group.fixed, row.split.filter(|_| use_row_splits)) {
                (Some((first, sequence)), Some(second)) if first != second => {
                    return Err(if sequence == row.sequence {
                        DatasetError::SequenceInTwoSplits { sequence: row.sequence.clone(), first, second }
                    } else {
                        DatasetError::GroupInTwoSplits {
                            by: self.by,
                            group: group_of(row).to_owned(),
                            sequences: [sequence.to_owned(), row.sequence.clone()],
                            splits: [first, second],
                        }
                    });
                }
                (None, Some(split)) => group.fixed = Some((split, &row.sequence)),
                _ => {}
            }
            group.is_real |= row.domain == Domain::Real;
            group.classes[row.label.index()] = true;
        }
        Ok(groups)
    }

    /// Number of groups of a stratum for test and for validation.
    fn split_counts(&self, groups: usize) -> (usize, usize) {
        // A share above zero gets at least one group if one is left to train on. This needs three sequences, or two
        // subjects, scenes or seeds, because there may be few of them.
        let least_available = if self.by == SplitBy::Sequence { 2 } else { 1 };
        let count = |share: f64, available: usize| {
            let rounded = (share * groups as f64).round() as usize;
            rounded.max(usize::from(share > 0.0 && available >= least_available))
        };
        let most = groups.saturating_sub(1);
        let test = count(if self.held_out.is_some() { 0.0 } else { self.test }, most).min(most);
        let available = groups - test;
        (test, count(self.validation, available).min(available.saturating_sub(1)))
    }
}

/// Group of each sequence, named after the alphabetically first sequence in it.
fn group_names(rows: &[ManifestRow], by: SplitBy) -> BTreeMap<&str, &str> {
    // Union-find: the parent of a sequence is an earlier one of its group, or itself.
    let mut parents: BTreeMap<&str, &str> =
        rows.iter().map(|row| (row.sequence.as_str(), row.sequence.as_str())).collect();
    fn root<'a>(parents: &BTreeMap<&'a str, &'a str>, mut sequence: &'a str) -> &'a str {
        while let Some(parent) = parents.get(sequence).filter(|parent| **parent != sequence) {
            sequence = parent;
        }
        sequence
    }
    if by != SplitBy::Sequence {
        // First sequence with each value of the property.
        let mut first_sequences: BTreeMap<Cow<str>, &str> = BTreeMap::new();
        for row in rows {
            let Some(property) = by.group_name(row) else { continue };
            let first = first_sequences.entry(property).or_insert(&row.sequence);
            let (a, b) = (root(&parents, first), root(&parents, &row.sequence));
            parents.insert(a.max(b), a.min(b));
        }
    }
    parents.keys().map(|sequence| (*sequence, root(&parents, sequence))).collect()
}
