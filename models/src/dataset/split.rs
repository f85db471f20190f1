//! Splits into training, validation and test, by whole sequences, subjects, scenes or seeds.

use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet};

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::error::DatasetError;
use super::manifest::{Domain, ManifestRow, Split, SplitBy, named};

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

/// Hash that orders a group, and name of the group.
type Ranked<'a> = ([u8; 32], &'a str);

/// Group of sequences that stay in one split.
#[derive(Default)]
struct Group<'a> {
    /// Fixed split, and the sequence that fixes it.
    fixed: Option<(Split, &'a str)>,
    is_real: bool,
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
        match are_shares && validation + test < 1.0 {
            true => Ok(()),
            false => Err(DatasetError::Fractions { validation, test }),
        }
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
    /// sequence to hold out, and [`DatasetError::SequenceInTwoSplits`] or [`DatasetError::GroupInTwoSplits`] if rows divide what
    /// must stay whole.
    pub fn assign(&self, rows: &[ManifestRow]) -> Result<Vec<Split>, DatasetError> {
        self.check()?;
        let names = group_names(rows, self.by);
        let group_of_name = |name: &String| {
            let group = names.get(name.as_str()).copied();
            group.ok_or_else(|| DatasetError::NoSuchSequence {
                sequence: name.clone(),
                known: named(names.keys().copied()),
            })
        };
        let held_out = self.held_out.as_ref().map(group_of_name).transpose()?;
        let group_of = |row: &ManifestRow| names.get(row.sequence.as_str()).copied().unwrap_or_default();
        let groups = self.groups(rows, group_of, held_out.is_none())?;
        let mut strata: BTreeMap<(bool, [bool; 3]), Vec<Ranked>> = BTreeMap::new();
        for (name, group) in &groups {
            if group.fixed.is_none() && held_out != Some(*name) {
                let mut hash = Sha256::new();
                hash.update(self.seed.to_le_bytes());
                hash.update(name.as_bytes());
                strata.entry((group.is_real, group.classes)).or_default().push((hash.finalize().into(), name));
            }
        }
        let mut dealt: BTreeMap<&str, Split> = BTreeMap::new();
        for mut names in strata.into_values() {
            names.sort_unstable();
            let (test, validation) = self.shares_of(names.len());
            for (index, (_, name)) in names.into_iter().enumerate() {
                let split = match index {
                    i if i < test => Split::Test,
                    i if i < test + validation => Split::Validation,
                    _ => Split::Train,
                };
                dealt.insert(name, split);
            }
        }
        let split = |row: &ManifestRow| {
            let name = group_of(row);
            if held_out == Some(name) {
                return Split::Test;
            }
            let fixed = groups.get(name).and_then(|group| Some(group.fixed?.0));
            fixed.or_else(|| dealt.get(name).copied()).unwrap_or(Split::Train)
        };
        Ok(rows.iter().map(split).collect())
    }

    /// Alphabetically first sequence of each group. If each of them is held out in turn, each sequence is in one test split.
    pub(crate) fn first_sequences<'a>(&self, rows: &'a [ManifestRow]) -> BTreeSet<&'a str> {
        group_names(rows, self.by).into_values().collect()
    }

    /// Warning that names the sequences that are held out with [`SplitSpec::held_out`] because they are of its group; `None` if there
    /// are none.
    pub(crate) fn group_warning(&self, rows: &[ManifestRow]) -> Option<String> {
        let held_out = self.held_out.as_deref()?;
        let names = group_names(rows, self.by);
        let group = names.get(held_out)?;
        let others = names.iter().filter(|(name, of)| **name != held_out && *of == group);
        let others: Vec<&str> = others.map(|(name, _)| *name).collect();
        (!others.is_empty()).then(|| {
            let (by, others) = (self.by, named(others.iter().copied()));
            format!("sequence '{held_out}' is held out with the other sequences of its {by}: {others}")
        })
    }

    /// Groups of the rows with their contents. Splits of rows count only if `rows_decide`.
    fn groups<'a>(
        &self,
        rows: &'a [ManifestRow],
        group_of: impl Fn(&ManifestRow) -> &'a str,
        rows_decide: bool,
    ) -> Result<BTreeMap<&'a str, Group<'a>>, DatasetError> {
        let mut groups: BTreeMap<&str, Group> = BTreeMap::new();
        for row in rows {
            let group = groups.entry(group_of(row)).or_default();
            match (group.fixed, row.split.filter(|_| rows_decide)) {
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
    fn shares_of(&self, groups: usize) -> (usize, usize) {
        // A share above zero gets at least one group if one is left to train on. This needs three sequences, or two
        // subjects, scenes or seeds, because there may be few of them.
        let least_room = if self.by == SplitBy::Sequence { 2 } else { 1 };
        let number = |share: f64, room: usize| {
            let wanted = (share * groups as f64).round() as usize;
            wanted.max(usize::from(share > 0.0 && room >= least_room))
        };
        let most = groups.saturating_sub(1);
        let test = number(if self.held_out.is_some() { 0.0 } else { self.test }, most).min(most);
        let room = groups - test;
        (test, number(self.validation, room).min(room.saturating_sub(1)))
    }
}

/// Name of each sequence's group: the alphabetically first sequence of the group.
fn group_names(rows: &[ManifestRow], by: SplitBy) -> BTreeMap<&str, &str> {
    // Union-find: every sequence points to an earlier one of its group, or to itself.
    let mut before: BTreeMap<&str, &str> =
        rows.iter().map(|row| (row.sequence.as_str(), row.sequence.as_str())).collect();
    fn first<'a>(before: &BTreeMap<&'a str, &'a str>, mut name: &'a str) -> &'a str {
        while let Some(earlier) = before.get(name).filter(|earlier| **earlier != name) {
            name = earlier;
        }
        name
    }
    if by != SplitBy::Sequence {
        let mut holders: BTreeMap<Cow<str>, &str> = BTreeMap::new();
        for row in rows {
            let Some(name) = by.name(row) else { continue };
            let holder = holders.entry(name).or_insert(&row.sequence);
            let (a, b) = (first(&before, holder), first(&before, &row.sequence));
            before.insert(a.max(b), a.min(b));
        }
    }
    before.keys().map(|name| (*name, first(&before, name))).collect()
}
