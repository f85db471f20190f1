//! Builds of datasets. An interrupted build can be continued.
//!
//! While a build runs, `NAME.parts` holds its plan and its finished units, each complete or absent. After any
//! interruption the same command continues with them. When all units are there, they are merged; those of a shard only
//! take the shard's name.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use radome_driver::recording::rename_synced;
use radome_files::with_suffix;
use radome_models::dataset::{self, Dataset, DatasetError, SplitSpec};
use rayon::prelude::*;

use super::plan::{self, Plan, PlanCard};
use super::unit;
use crate::output::Interrupted;
use crate::shard::Shard;
use crate::{output, panics};

/// Dataset or shard that a build produced.
pub struct Built {
    /// Folder of the dataset, or of the shard.
    pub folder: PathBuf,
    pub units: usize,
    /// Number of units that an earlier run had finished.
    pub found: usize,
    pub counts: Counts,
}

/// Builds a dataset in the folder `output`, or one shard of it in a folder within. Continues an interrupted build.
///
/// # Errors
/// The spec or a source cannot be read, the folder holds something else, a unit fails, or the user interrupts.
pub fn build(spec: &Path, output: &Path, shard: Option<Shard>) -> anyhow::Result<Built> {
    build_plan(&Plan::new(spec, shard.unwrap_or(Shard::WHOLE))?, output, shard)
}

/// Builds a dataset, or one shard of it, as [`build`] does, by its plan.
///
/// # Errors
/// A source cannot be read, the folder holds something else, a unit fails, or the user interrupts.
pub fn build_plan(plan: &Plan, output: &Path, shard: Option<Shard>) -> anyhow::Result<Built> {
    let target = match shard {
        Some(shard) => output.join(shard.name()),
        None => output.to_owned(),
    };
    let parts = Parts::of(&target);
    // A link that leads nowhere counts: the dataset could not take its name in the end.
    let is_taken = target.symlink_metadata().is_ok();
    let found = match (shard, is_taken) {
        (Some(_), true) => check_finished_shard(plan, &target)?,
        (None, true) if !parts.was_merged(plan, &target) => {
            return Err(DatasetError::Exists { path: target }.into());
        }
        (None, true) => {
            let _lock = dataset::lock_folder(&parts.folder)?;
            parts.remove()?;
            plan.units.len()
        }
        (shard, false) => {
            let _lock = parts.open_or_continue(plan)?;
            let found = parts.make_missing(plan)?;
            match shard {
                Some(_) => rename_synced(&parts.folder, &target)?,
                None => {
                    let merged = merge_units(&target, &plan.card, 1, &target, |_| parts.folder.clone());
                    // Units without a map are useless, and the corrected spec would be refused because of them.
                    if merged.as_ref().map_or_else(|error| error.is::<NoMaps>(), |_| true) {
                        parts.remove()?;
                    }
                    merged?;
                }
            }
            found
        }
    };
    let mut counts = Counts::default();
    match shard {
        None => counts.add(&Dataset::open(&target)?),
        Some(shard) => {
            for unit in plan.units_of(shard) {
                counts.add(&Dataset::open(&target.join(unit_name(unit)))?);
            }
        }
    }
    Ok(Built { folder: target, units: plan.units_of(plan.card.shard).count(), found, counts })
}

/// Checks that an existing shard belongs to this plan. Returns its number of units.
fn check_finished_shard(plan: &Plan, target: &Path) -> anyhow::Result<usize> {
    if let Some(difference) = plan.card.difference(&PlanCard::read(target)?) {
        bail!("{} is there already, but was {difference}\n\nhint: move it away", target.display());
    }
    message!("{} is there already", target.display());
    Ok(plan.units_of(plan.card.shard).count())
}

/// Name of a unit's folder.
pub fn unit_name(unit: usize) -> String {
    format!("unit-{unit:06}")
}

impl Plan {
    /// Units of a shard: every `count`-th, so that long and short sources are spread evenly.
    pub fn units_of(&self, shard: Shard) -> impl Iterator<Item = usize> {
        (shard.index..self.units.len()).step_by(shard.count)
    }
}

/// Folder with the units of an unfinished build.
struct Parts {
    folder: PathBuf,
}

impl Parts {
    fn of(target: &Path) -> Self {
        Parts { folder: with_suffix(target, ".parts") }
    }

    /// Creates the folder, or continues in it if it holds units of the same plan. The folder is locked for other
    /// processes until the returned file is dropped. A folder with files but without a plan is refused: no build made it.
    fn open_or_continue(&self, plan: &Plan) -> anyhow::Result<fs::File> {
        fs::create_dir_all(&self.folder).with_context(|| format!("cannot make {}", self.folder.display()))?;
        let foreign = self.foreign_file().with_context(|| format!("cannot list {}", self.folder.display()))?;
        // Units appear after the plan, so that the folder of a build that has just begun is not refused.
        if let Some(name) = foreign.filter(|_| !self.folder.join(plan::FILE).exists()) {
            return Err(DatasetError::ForeignFile { path: self.folder.clone(), name }.into());
        }
        let lock = dataset::lock_folder(&self.folder)?;
        if !self.folder.join(plan::FILE).exists() {
            plan.card.write_file(&self.folder.join(plan::FILE))?;
        } else if let Some(difference) = plan.card.difference(&PlanCard::read(&self.folder)?) {
            bail!(
                "{folder} holds the beginning of another build, {difference}\n\nhint: undo the change to go on with it, or \
                 remove {folder} to begin anew",
                folder = self.folder.display()
            );
        }
        Ok(lock)
    }

    /// Returns the name of a file that no build makes before it writes its plan; `None` if there is none.
    fn foreign_file(&self) -> std::io::Result<Option<String>> {
        let unfinished_plan = format!(".{}.partial", plan::FILE);
        for entry in fs::read_dir(&self.folder)? {
            let name = entry?.file_name();
            if name != ".lock" && name != unfinished_plan.as_str() {
                return Ok(Some(name.to_string_lossy().into_owned()));
            }
        }
        Ok(None)
    }

    /// Returns whether only the cleanup is missing: an earlier run ended after it had renamed the dataset.
    fn was_merged(&self, plan: &Plan, target: &Path) -> bool {
        let same = |card: PlanCard| plan.card.difference(&card).is_none();
        target.join("dataset.json").exists() && PlanCard::read(&self.folder).is_ok_and(same)
    }

    /// Makes the missing units on all threads; returns how many existed.
    fn make_missing(&self, plan: &Plan) -> anyhow::Result<usize> {
        let all = plan.units_of(plan.card.shard).count();
        let unit_folder = |unit: &usize| self.folder.join(unit_name(*unit));
        let missing: Vec<usize> = plan.units_of(plan.card.shard).filter(|unit| !unit_folder(unit).exists()).collect();
        let found = all - missing.len();
        if found > 0 {
            message!("{}: {found} of {all} units are there", self.folder.display());
        }
        let bar = output::progress(all as u64, "units");
        bar.set_position(found as u64);
        let make_unit = |unit: &usize, parallel: bool| -> anyhow::Result<()> {
            let Some(source) = plan.units.get(*unit) else { return Ok(()) };
            // A unit that panics ends the build like one that fails: the other units stay.
            panics::catch_panic(|| unit::make(plan, source, &unit_folder(unit), parallel))
                .unwrap_or_else(|panicked| Err(panicked.into()))
                .with_context(|| source.recording.clone())?;
            bar.inc(1);
            Ok(())
        };
        // Many units are made in parallel, each on one thread. Of few units, the frames of each are computed on all
        // threads.
        let result = if missing.len() >= 2 * rayon::current_num_threads() {
            missing.par_iter().with_max_len(1).try_for_each(|unit| make_unit(unit, false))
        } else {
            missing.iter().try_for_each(|unit| make_unit(unit, true))
        };
        bar.finish_and_clear();
        let Err(error) = result else { return Ok(found) };
        let done = plan.units_of(plan.card.shard).filter(|unit| unit_folder(unit).exists()).count();
        if error.is::<Interrupted>() {
            bail!("interrupted: {done} of {all} units are done\n\nhint: the same command goes on with the others")
        }
        message!("{done} of {all} units are done and kept in {}", self.folder.display());
        Err(error)
    }

    /// Removes the folder. If the process is killed meanwhile, units are still complete or absent, because each is first renamed
    /// to an unfinished one. The plan is removed last, since [`Parts::was_merged`] needs it.
    fn remove(&self) -> anyhow::Result<()> {
        let remove = || -> std::io::Result<()> {
            for entry in fs::read_dir(&self.folder)? {
                let path = entry?.path();
                if path.is_dir() {
                    let unfinished = path.with_extension("partial");
                    fs::rename(&path, &unfinished)?;
                    // Without this file, the folder is that of a killed writer, and no dataset. It may be absent already.
                    let _ = fs::remove_file(unfinished.join("dataset.json"));
                    fs::remove_dir_all(unfinished)?;
                }
            }
            fs::remove_dir_all(&self.folder)
        };
        remove().with_context(|| format!("cannot remove {}", self.folder.display()))
    }
}

/// Error of a build none of whose sources gave a map.
#[derive(Debug, thiserror::Error)]
#[error(
    "{path}: no source gave a map\n\nhint: frames need a label: label the recordings (radome recording label), or give them one in the \
     spec; and recordings need as many frames as a map is made of"
)]
struct NoMaps {
    path: PathBuf,
}

/// Merges all units of a plan into the dataset, in order. `shard_folder` returns the folder with the units of a shard.
///
/// # Errors
/// A unit cannot be read, or none has a map, or the dataset cannot be written.
pub fn merge_units(
    what: &Path,
    card: &PlanCard,
    shards: usize,
    target: &Path,
    shard_folder: impl Fn(usize) -> PathBuf,
) -> anyhow::Result<usize> {
    let folders: Vec<PathBuf> = (0..card.units).map(|unit| shard_folder(unit % shards).join(unit_name(unit))).collect();
    let units = folders.iter().map(|folder| Dataset::open(folder)).collect::<Result<Vec<_>, _>>()?;
    if units.iter().all(Dataset::is_empty) {
        return Err(NoMaps { path: what.to_owned() }.into());
    }
    let units: Vec<(&Path, &Dataset)> = folders.iter().map(PathBuf::as_path).zip(&units).collect();
    let split: Option<SplitSpec> = card.spec.split.clone();
    let rows = units.iter().flat_map(|(_, unit)| unit.rows()).filter(|row| row.split.is_none());
    if let Some(warning) = split.as_ref().and_then(|split| split.by.warning(rows)) {
        message!("warning: {warning}");
    }
    Ok(dataset::merge(&units, target, split.as_ref())?)
}

/// Number of maps by class.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Counts {
    /// Maps of the classes empty, one and two.
    pub classes: [u64; 3],
    /// Maps during which somebody entered or left.
    pub transitions: u64,
}

impl Counts {
    pub fn add(&mut self, dataset: &Dataset) {
        for row in dataset.rows() {
            self.classes[row.label.index()] += 1;
            self.transitions += u64::from(row.transition);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Regression test: a kill during the removal left units without some of their files, or all units without the plan. Then
    /// the same command failed, and a build of another spec used the units.
    #[test]
    fn a_removal_that_stops_leaves_whole_units_and_the_plan() {
        let folder = tempfile::tempdir().expect("a folder");
        let parts = Parts { folder: folder.path().join("set.parts") };
        let files = ["dataset.json", "manifest.jsonl", "maps-00000.npy"];
        for unit in 0..8 {
            let unit = parts.folder.join(unit_name(unit));
            fs::create_dir_all(&unit).expect("a folder");
            files.iter().for_each(|file| fs::write(unit.join(file), "").expect("written"));
        }
        fs::write(parts.folder.join(plan::FILE), "").expect("written");
        // The removal stops here, because no folder takes the name of a file.
        let stop = parts.folder.join(format!("{}.partial", unit_name(3)));
        fs::write(&stop, "").expect("written");
        assert!(parts.remove().is_err());
        assert!(parts.folder.join(plan::FILE).exists() && parts.folder.join(unit_name(3)).exists());
        let units = (0..8).map(|unit| parts.folder.join(unit_name(unit))).filter(|unit| unit.exists());
        units.for_each(|unit| assert!(files.iter().all(|file| unit.join(file).exists()), "{}", unit.display()));
        fs::remove_file(stop).expect("removed");
        parts.remove().expect("nothing is in the way");
        assert!(!parts.folder.exists());
    }
}
