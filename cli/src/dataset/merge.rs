//! Merges of shards and of datasets.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{bail, ensure};
use radome_models::dataset::{self, Dataset};

use super::build::{Built, Counts, merge_units};
use super::plan::{self, PlanCard};

/// Merges the shards of a build, or datasets, into one dataset in the folder `target`.
///
/// # Errors
/// A part cannot be read, shards are missing or of different builds, or two datasets hold the same sequence.
pub fn merge(parts: &[PathBuf], target: &Path) -> anyhow::Result<Built> {
    let units = if parts.iter().all(|part| part.join(plan::FILE).exists()) {
        shards(parts, target)?
    } else {
        datasets(parts, target)?
    };
    let mut counts = Counts::default();
    counts.add(&Dataset::open(target)?);
    Ok(Built { folder: target.to_owned(), units, found: 0, counts })
}

/// Merges the shards of a build. The bytes are those of a build on one machine.
fn shards(parts: &[PathBuf], target: &Path) -> anyhow::Result<usize> {
    let mut by_index: BTreeMap<usize, &PathBuf> = BTreeMap::new();
    let mut first: Option<(&PathBuf, PlanCard)> = None;
    for part in parts {
        let card = PlanCard::read(part)?;
        if part.extension().is_some_and(|e| e == "parts") {
            bail!("{}: this shard is not finished\n\nhint: run its build again", part.display());
        }
        if let Some((path, expected)) = &first {
            let (count, expected_count) = (card.shard.count, expected.shard.count);
            if let Some(difference) = expected.difference(&card) {
                bail!("{} is no shard of the build of {}: it was {difference}", part.display(), path.display());
            }
            if count != expected_count {
                bail!("{} is a shard of {count}, {} one of {expected_count}", part.display(), path.display());
            }
        }
        if let Some(other) = by_index.insert(card.shard.index, part) {
            bail!("{} and {} are both shard {}", other.display(), part.display(), card.shard);
        }
        first.get_or_insert((part, card));
    }
    let Some((path, card)) = first else { bail!("nothing to merge") };
    let missing: Vec<String> =
        (0..card.shard.count).filter(|index| !by_index.contains_key(index)).map(|index| index.to_string()).collect();
    ensure!(
        missing.is_empty(),
        "shards {} of {} are missing\n\nhint: radome dataset build SPEC -o DIR --shard {}/{1}",
        missing.join(", "),
        card.shard.count,
        missing.first().map_or("", String::as_str)
    );
    let shard_folder = |shard: usize| by_index.get(&shard).map_or_else(PathBuf::new, |path| path.to_path_buf());
    merge_units(path, &card, card.shard.count, target, shard_folder)?;
    Ok(card.units)
}

fn datasets(parts: &[PathBuf], target: &Path) -> anyhow::Result<usize> {
    if let Some(shard) = parts.iter().find(|part| part.join(plan::FILE).exists()) {
        bail!("{} is a shard, others are not; merge the shards of a build first", shard.display());
    }
    let opened = parts.iter().map(|part| Dataset::open(part)).collect::<Result<Vec<_>, _>>()?;
    let mut folder_by_sequence: BTreeMap<&str, &Path> = BTreeMap::new();
    for (path, part) in parts.iter().zip(&opened) {
        let mut sequences: BTreeMap<&str, &Path> = BTreeMap::new();
        for row in part.rows() {
            sequences.insert(&row.sequence, path);
        }
        if let Some((sequence, other)) =
            sequences.keys().find_map(|sequence| Some((sequence, folder_by_sequence.get(sequence)?)))
        {
            bail!(
                "the sequence '{sequence}' is in {} and in {}\n\nhint: the same maps twice, or two recordings of one name; give \
                 one another `sequence` in its spec",
                other.display(),
                path.display()
            );
        }
        folder_by_sequence.append(&mut sequences);
    }
    let pairs: Vec<(&Path, &Dataset)> = parts.iter().map(PathBuf::as_path).zip(&opened).collect();
    dataset::merge(&pairs, target, None)?;
    Ok(parts.len())
}
