//! Which map is for training, validation and test: by whole sequences only.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::{DatasetError, ManifestRow, Split};

/// How sequences without a split of their own get one.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct SplitSpec {
    /// Seed of the assignment.
    pub seed: u64,
    /// Share of sequences for validation.
    pub validation: f64,
    /// Share of sequences for test.
    pub test: f64,
}

/// A sequence behind the hash that orders it.
type Ranked<'a> = ([u8; 32], &'a str);

impl Default for SplitSpec {
    fn default() -> Self {
        SplitSpec { seed: 0, validation: 0.15, test: 0.2 }
    }
}

impl SplitSpec {
    /// The split of each row, in order.
    ///
    /// Rows with a split keep it, and so does the rest of their sequence. The other sequences are sorted into strata by
    /// domain and by the set of classes that they show, ordered within a stratum by a seeded hash of their name, and
    /// dealt out: test first, then validation, each rounded to the nearest whole sequence, and at least one for
    /// training. So neither thread, order of rows nor machine matters, and every split sees every class where there
    /// are enough sequences.
    pub fn assign(&self, rows: &[ManifestRow]) -> Result<Vec<Split>, DatasetError> {
        let fraction = |f: f64| (0.0..1.0).contains(&f);
        if !fraction(self.validation) || !fraction(self.test) || self.validation + self.test >= 1.0 {
            return Err(DatasetError::Fractions { validation: self.validation, test: self.test });
        }
        let mut sequences: BTreeMap<&str, (Option<Split>, bool, [bool; 3])> = BTreeMap::new();
        for row in rows {
            let (fixed, real, classes) = sequences.entry(&row.sequence).or_default();
            match (*fixed, row.split) {
                (Some(first), Some(second)) if first != second => {
                    return Err(DatasetError::SequenceInTwoSplits { sequence: row.sequence.clone(), first, second });
                }
                (None, Some(split)) => *fixed = Some(split),
                _ => {}
            }
            *real |= row.domain == super::Domain::Real;
            classes[row.label.index()] = true;
        }
        let mut strata: BTreeMap<(bool, [bool; 3]), Vec<Ranked>> = BTreeMap::new();
        for (name, (fixed, real, classes)) in &sequences {
            if fixed.is_none() {
                let mut hash = Sha256::new();
                hash.update(self.seed.to_le_bytes());
                hash.update(name.as_bytes());
                strata.entry((*real, *classes)).or_default().push((hash.finalize().into(), name));
            }
        }
        let mut dealt: BTreeMap<&str, Split> = BTreeMap::new();
        for mut names in strata.into_values() {
            names.sort_unstable();
            let count = names.len() as f64;
            let test = (self.test * count).round() as usize;
            let validation = (self.validation * count).round() as usize;
            // With two sequences and more, a share above zero gets at least one as long as one is left to train on.
            let least = |share: f64, n: usize, room: usize| if share > 0.0 && n == 0 && room > 1 { 1 } else { n };
            let test = least(self.test, test, names.len().saturating_sub(1)).min(names.len().saturating_sub(1));
            let room = names.len() - test;
            let validation = least(self.validation, validation, room).min(room.saturating_sub(1));
            for (index, (_, name)) in names.into_iter().enumerate() {
                let split = match index {
                    i if i < test => Split::Test,
                    i if i < test + validation => Split::Validation,
                    _ => Split::Train,
                };
                dealt.insert(name, split);
            }
        }
        Ok(rows
            .iter()
            .map(|row| {
                let fixed = sequences.get(row.sequence.as_str()).and_then(|s| s.0);
                fixed.or_else(|| dealt.get(row.sequence.as_str()).copied()).unwrap_or(Split::Train)
            })
            .collect())
    }
}
